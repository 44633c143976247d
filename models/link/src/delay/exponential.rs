//! Law of a shifted exponential delay: `min`, plus a time without memory. What waiting behind
//! Poisson traffic in a single queue looks like; real queues remember, this law does not.
//!
//! `P(delay > min + x) = exp(-x / mean_excess)`; a draw above `max` is drawn anew.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use super::{DELAY_MAX, Law, check_max, check_time};
use hil_core::case_study::ParameterError;
use hil_core::random::RandomStream;

/// `min` plus an exponential time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Exponential {
    /// What every message takes at least, 0..=10 s.
    #[serde(default)]
    pub min: Duration,
    /// Mean of what comes on top, before it is cut at `max`; 1 ns..=10 s.
    pub mean_excess: Duration,
    /// Longest delay, up to 10 s; at least half of all draws are below it.
    #[serde(default = "super::delay_max")]
    pub max: Duration,
}

impl Exponential {
    /// As long as a delay may be.
    pub const fn new(min: Duration, mean_excess: Duration) -> Self {
        Self {
            min,
            mean_excess,
            max: DELAY_MAX,
        }
    }

    fn uncut(&self, delay_s: f64) -> f64 {
        let on_top_s = (delay_s - self.min.as_secs_f64()).max(0.0);
        -(-on_top_s / self.mean_excess.as_secs_f64()).exp_m1()
    }
}

impl Law for Exponential {
    fn check(&self) -> Result<(), ParameterError> {
        check_time("min", self.min, Duration::ZERO)?;
        check_time("mean_excess", self.mean_excess, Duration::from_nanos(1))?;
        check_max(self.max, self.uncut(self.max.as_secs_f64()), 0.5)
    }

    fn draw_s(&self, random: &mut RandomStream) -> f64 {
        let on_top_s = -self.mean_excess.as_secs_f64() * (1.0 - random.uniform()).ln();
        self.min.as_secs_f64() + on_top_s
    }

    fn distribution(&self, delay_s: f64) -> f64 {
        (self.uncut(delay_s) / self.uncut(self.max.as_secs_f64())).min(1.0)
    }

    fn mean_s(&self) -> f64 {
        let (scale_s, max_s) = (self.mean_excess.as_secs_f64(), self.max.as_secs_f64());
        let span_s = max_s - self.min.as_secs_f64();
        let missing_s = span_s * (-span_s / scale_s).exp() / self.uncut(max_s);
        self.min.as_secs_f64() + scale_s - missing_s
    }

    fn longest(&self) -> Duration {
        self.max
    }
}
