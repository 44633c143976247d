//! Law of a fixed delay: every message takes the same time, as in the static model of the seed
//! paper (Lv et al., section II.B). It models no variation at all.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use super::{Law, check_time};
use hil_core::case_study::ParameterError;
use hil_core::random::RandomStream;

/// Every message takes `delay`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fixed {
    /// One-way delay, 0..=10 s.
    pub delay: Duration,
}

impl Law for Fixed {
    fn check(&self) -> Result<(), ParameterError> {
        check_time("delay", self.delay, Duration::ZERO)
    }

    fn draw_s(&self, _random: &mut RandomStream) -> f64 {
        self.delay.as_secs_f64()
    }

    fn distribution(&self, delay_s: f64) -> f64 {
        f64::from(delay_s >= self.delay.as_secs_f64())
    }

    fn mean_s(&self) -> f64 {
        self.delay.as_secs_f64()
    }

    fn longest(&self) -> Duration {
        self.delay
    }
}
