//! Law of a shifted log-normal delay: `min`, plus a time whose logarithm is normal. The usual
//! description of delays across many hops and of Wi-Fi under load: a floor, most values near it, a
//! long tail. It models no dependence of successive delays.
//!
//! delay = min + median exp(sigma N), N standard normal; without a limit the mean is
//! min + median exp(sigma^2 / 2) and the deviation median sqrt((exp(sigma^2) - 1) exp(sigma^2)).
//! A draw above `max` is drawn anew.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use super::normal_distribution::distribution;
use super::{DELAY_MAX, Law, check_max, check_time};
use hil_core::case_study::ParameterError;
use hil_core::random::RandomStream;

/// `min` plus a log-normal time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LogNormal {
    /// What every message takes at least, 0..=10 s.
    #[serde(default)]
    pub min: Duration,
    /// Median of what comes on top, 1 ns..=10 s.
    pub median: Duration,
    /// Standard deviation of the natural logarithm of what comes on top, 0.001..=3.
    pub sigma: f64,
    /// Longest delay, up to 10 s; at least half of all draws are below it.
    #[serde(default = "super::delay_max")]
    pub max: Duration,
}

impl LogNormal {
    /// As long as a delay may be.
    pub const fn new(min: Duration, median: Duration, sigma: f64) -> Self {
        Self {
            min,
            median,
            sigma,
            max: DELAY_MAX,
        }
    }

    /// The standard normal value that makes `delay_s`.
    fn standard(&self, delay_s: f64) -> f64 {
        let on_top_s = (delay_s - self.min.as_secs_f64()).max(0.0);
        (on_top_s / self.median.as_secs_f64()).ln() / self.sigma
    }
}

impl Law for LogNormal {
    fn check(&self) -> Result<(), ParameterError> {
        check_time("min", self.min, Duration::ZERO)?;
        check_time("median", self.median, Duration::from_nanos(1))?;
        ParameterError::check("sigma", self.sigma, 0.001..=3.0, "0.001 to 3")?;
        let kept = distribution(self.standard(self.max.as_secs_f64()));
        check_max(self.max, kept, 0.5)
    }

    fn draw_s(&self, random: &mut RandomStream) -> f64 {
        let on_top_s = self.median.as_secs_f64() * (self.sigma * random.normal()).exp();
        self.min.as_secs_f64() + on_top_s
    }

    fn distribution(&self, delay_s: f64) -> f64 {
        let kept = distribution(self.standard(self.max.as_secs_f64()));
        (distribution(self.standard(delay_s)) / kept).min(1.0)
    }

    fn mean_s(&self) -> f64 {
        let end = self.standard(self.max.as_secs_f64());
        let cut = distribution(end - self.sigma) / distribution(end);
        let uncut_s = self.median.as_secs_f64() * (0.5 * self.sigma * self.sigma).exp();
        self.min.as_secs_f64() + uncut_s * cut
    }

    fn longest(&self) -> Duration {
        self.max
    }
}
