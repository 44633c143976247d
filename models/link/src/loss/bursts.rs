//! Loss law of Gilbert and Elliott in continuous time: a link is good and bad in turn, for
//! exponential times, and each state loses messages with a probability of its own. When the state
//! changes is a function of the link's own random stream and of time, so all channels of a link see
//! the same bursts, whatever their rates, and both directions do when their mean times are equal.
//!
//! The states of two instants t apart agree more than by chance by
//! `exp(-t (1 / good_mean + 1 / bad_mean))`. What is lost of a message that comes alone is as in the
//! per-message law: the long-run ratio. It models no retransmission and no delay.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use super::check_loss_ratios;
use hil_core::case_study::ParameterError;
use hil_core::random::RandomStream;
use hil_core::time::Instant;

/// A link that is good and bad in turn.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bursts {
    /// Mean time in the good state, exponential, 1 us..=1 h.
    pub good_mean: Duration,
    /// Mean time in the bad state, exponential, 1 us..=1 h.
    pub bad_mean: Duration,
    /// Probability of a loss in the bad state, 0..=1.
    #[serde(default = "one")]
    pub bad_loss_ratio: f64,
    /// Probability of a loss in the good state, 0..=1.
    #[serde(default)]
    pub good_loss_ratio: f64,
}

const fn one() -> f64 {
    1.0
}

const SHORTEST: Duration = Duration::from_micros(1);
const LONGEST: Duration = Duration::from_hours(1);

impl Bursts {
    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first key outside its range.
    pub fn check(&self) -> Result<(), ParameterError> {
        for (key, mean) in [("good_mean", self.good_mean), ("bad_mean", self.bad_mean)] {
            if !(SHORTEST..=LONGEST).contains(&mean) {
                let problem = format!("{mean:?} is outside {SHORTEST:?} to {LONGEST:?}");
                return Err(ParameterError::new(key, problem));
            }
        }
        check_loss_ratios(self.bad_loss_ratio, self.good_loss_ratio)
    }

    /// Share of the time in the bad state in the long run.
    pub fn bad_ratio(&self) -> f64 {
        let (good_s, bad_s) = (self.good_mean.as_secs_f64(), self.bad_mean.as_secs_f64());
        bad_s / (good_s + bad_s)
    }

    /// Share of the messages lost in the long run.
    pub fn loss_ratio(&self) -> f64 {
        let bad = self.bad_ratio();
        bad * self.bad_loss_ratio + (1.0 - bad) * self.good_loss_ratio
    }
}

/// The states of a link, from time zero on.
#[derive(Debug, Clone)]
pub(super) struct States {
    law: Bursts,
    random: RandomStream,
    is_bad: bool,
    until: Instant,
}

impl States {
    /// The states as `random` has them; equal laws and streams have equal states.
    pub(super) fn new(law: Bursts, mut random: RandomStream) -> Self {
        let is_bad = random.chance(law.bad_ratio());
        let mut states = Self {
            law,
            random,
            is_bad,
            until: Instant::ZERO,
        };
        states.until = Instant::ZERO + states.stay();
        states
    }

    /// Exponential, of the state's mean; what is left of a state at time zero has the same law.
    fn stay(&mut self) -> Duration {
        let mean = if self.is_bad {
            self.law.bad_mean
        } else {
            self.law.good_mean
        };
        Duration::from_secs_f64(-mean.as_secs_f64() * (1.0 - self.random.uniform()).ln())
    }

    /// Probability of a loss at `now`. Calls come in non-decreasing `now`.
    pub(super) fn loss_ratio_at(&mut self, now: Instant) -> f64 {
        while now >= self.until && self.until < END_OF_TIME {
            self.is_bad = !self.is_bad;
            self.until = self.until + self.stay();
        }
        if self.is_bad {
            self.law.bad_loss_ratio
        } else {
            self.law.good_loss_ratio
        }
    }
}

/// Where adding to an [`Instant`] saturates.
const END_OF_TIME: Instant = Instant::from_ns(i64::MAX);
