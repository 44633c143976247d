//! Law of a normal delay, cut off at zero: `mean` and `deviation` are those of the uncut normal;
//! a draw below zero or above `max` is drawn anew. It models a delay that many small independent
//! causes make up; real tails are heavier.
//!
//! With a = -mean / deviation, b = (max - mean) / deviation and Z = P(b) - P(a), P the standard
//! normal distribution and p its density, the mean that comes out is
//! mean + deviation (p(a) - p(b)) / Z (Johnson, Kotz and Balakrishnan 1994, section 13.10.1): 2.8 %
//! more than asked at mean = 2 deviations, 0.15 % at 3.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use super::normal_distribution::{density, distribution};
use super::{DELAY_MAX, Law, check_max, check_time};
use hil_core::case_study::ParameterError;
use hil_core::random::RandomStream;

/// Normal, cut off at zero and at `max`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Normal {
    /// Mean before it is cut, 0..=10 s.
    pub mean: Duration,
    /// Standard deviation before it is cut, 1 ns..=10 s.
    pub deviation: Duration,
    /// Longest delay, up to 10 s; at least a quarter of all draws is below it.
    #[serde(default = "super::delay_max")]
    pub max: Duration,
}

impl Normal {
    /// With this mean and deviation, as long as a delay may be.
    pub const fn new(mean: Duration, deviation: Duration) -> Self {
        Self {
            mean,
            deviation,
            max: DELAY_MAX,
        }
    }

    fn standard(&self, delay_s: f64) -> f64 {
        (delay_s - self.mean.as_secs_f64()) / self.deviation.as_secs_f64()
    }
}

impl Law for Normal {
    fn check(&self) -> Result<(), ParameterError> {
        check_time("mean", self.mean, Duration::ZERO)?;
        check_time("deviation", self.deviation, Duration::from_nanos(1))?;
        let kept = distribution(self.standard(self.max.as_secs_f64()));
        // What is below zero is at most half already.
        check_max(self.max, kept - distribution(self.standard(0.0)), 0.25)
    }

    fn draw_s(&self, random: &mut RandomStream) -> f64 {
        self.mean.as_secs_f64() + self.deviation.as_secs_f64() * random.normal()
    }

    fn distribution(&self, delay_s: f64) -> f64 {
        let low = distribution(self.standard(0.0));
        let high = distribution(self.standard(self.max.as_secs_f64()));
        let at = delay_s.clamp(0.0, self.max.as_secs_f64());
        (distribution(self.standard(at)) - low) / (high - low)
    }

    fn mean_s(&self) -> f64 {
        let (a, b) = (self.standard(0.0), self.standard(self.max.as_secs_f64()));
        let kept = distribution(b) - distribution(a);
        let shift = self.deviation.as_secs_f64() * (density(a) - density(b)) / kept;
        self.mean.as_secs_f64() + shift
    }

    fn longest(&self) -> Duration {
        self.max
    }
}
