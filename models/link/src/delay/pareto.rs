//! Law of a Pareto delay of the second kind (Lomax): `min`, plus a time with a power-law tail, as
//! measured behind self-similar traffic. With `scale` = `min` it is the classical Pareto law. It
//! models no dependence of successive delays.
//!
//! P(delay > min + x) = (1 + x / scale)^-shape (Johnson, Kotz and Balakrishnan 1994, section
//! 20.3); without a limit the mean is min + scale / (shape - 1), and the variance is infinite up to
//! a shape of 2. A draw above `max` is drawn anew, so mean and variance that come out are finite.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use super::{DELAY_MAX, Law, check_max, check_time};
use hil_core::case_study::ParameterError;
use hil_core::random::RandomStream;

/// `min` plus a time with a power-law tail.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pareto {
    /// What every message takes at least, 0..=10 s.
    #[serde(default)]
    pub min: Duration,
    /// Scale of what comes on top, 1 ns..=10 s.
    pub scale: Duration,
    /// Exponent of the tail, 1.05..=100.
    pub shape: f64,
    /// Longest delay, up to 10 s; at least half of all draws are below it.
    #[serde(default = "super::delay_max")]
    pub max: Duration,
}

impl Pareto {
    /// As long as a delay may be.
    pub const fn new(min: Duration, scale: Duration, shape: f64) -> Self {
        Self {
            min,
            scale,
            shape,
            max: DELAY_MAX,
        }
    }

    fn uncut(&self, delay_s: f64) -> f64 {
        let on_top_s = (delay_s - self.min.as_secs_f64()).max(0.0);
        -(-self.shape * (on_top_s / self.scale.as_secs_f64()).ln_1p()).exp_m1()
    }
}

impl Law for Pareto {
    fn check(&self) -> Result<(), ParameterError> {
        check_time("min", self.min, Duration::ZERO)?;
        check_time("scale", self.scale, Duration::from_nanos(1))?;
        ParameterError::check("shape", self.shape, 1.05..=100.0, "1.05 to 100")?;
        check_max(self.max, self.uncut(self.max.as_secs_f64()), 0.5)
    }

    fn draw_s(&self, random: &mut RandomStream) -> f64 {
        // The inverse of the distribution function; a uniform number below 1 is finite here.
        let rest = (1.0 - random.uniform()).powf(-1.0 / self.shape) - 1.0;
        self.min.as_secs_f64() + self.scale.as_secs_f64() * rest
    }

    fn distribution(&self, delay_s: f64) -> f64 {
        (self.uncut(delay_s) / self.uncut(self.max.as_secs_f64())).min(1.0)
    }

    fn mean_s(&self) -> f64 {
        let (scale_s, max_s) = (self.scale.as_secs_f64(), self.max.as_secs_f64());
        let span_s = max_s - self.min.as_secs_f64();
        let kept = self.uncut(max_s);
        // The integral of what is still to come, less what is beyond the limit.
        let decay = -((1.0 - self.shape) * (span_s / scale_s).ln_1p()).exp_m1();
        let area_s = scale_s / (self.shape - 1.0) * decay;
        self.min.as_secs_f64() + (area_s - span_s * (1.0 - kept)) / kept
    }

    fn longest(&self) -> Duration {
        self.max
    }
}
