//! Law of a uniform delay: every time from `min` to `max` is equally likely. A range without a
//! theory behind it; no real link has these edges.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use super::{Law, check_time};
use hil_core::case_study::ParameterError;
use hil_core::random::RandomStream;

/// Uniform from `min` to `max`; the mean is (min + max) / 2, the variance (max - min)^2 / 12.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Uniform {
    /// Shortest delay, 0..=10 s.
    pub min: Duration,
    /// Longest delay, from `min` to 10 s.
    pub max: Duration,
}

impl Law for Uniform {
    fn check(&self) -> Result<(), ParameterError> {
        check_time("min", self.min, Duration::ZERO)?;
        check_time("max", self.max, self.min)
    }

    fn draw_s(&self, random: &mut RandomStream) -> f64 {
        let (min_s, max_s) = (self.min.as_secs_f64(), self.max.as_secs_f64());
        min_s + random.uniform() * (max_s - min_s)
    }

    fn distribution(&self, delay_s: f64) -> f64 {
        let (min_s, max_s) = (self.min.as_secs_f64(), self.max.as_secs_f64());
        if delay_s >= max_s {
            return 1.0;
        }
        ((delay_s - min_s) / (max_s - min_s)).max(0.0)
    }

    fn mean_s(&self) -> f64 {
        0.5 * (self.min.as_secs_f64() + self.max.as_secs_f64())
    }

    fn longest(&self) -> Duration {
        self.max
    }
}
