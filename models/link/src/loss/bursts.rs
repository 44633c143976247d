//! Loss law of Gilbert and Elliott in continuous time: a link is good and bad in turn, for
//! exponential times, and each state loses messages with a probability of its own. When the state
//! changes is a function of the link's own random stream and of time, so all channels of a link see
//! the same bursts, whatever their rates, and both directions do when their mean times are equal.
//!
//! The states of two instants t apart agree more than by chance by
//! `exp(-t (1 / good_mean + 1 / bad_mean))`. What is lost of a message that comes alone is as in the
//! per-message law: the long-run ratio. It models no retransmission and no delay.

use core::ops::RangeInclusive;
use core::time::Duration;

use super::{Law, Losses};
use hil_core::options;
use hil_core::random::RandomStream;
use hil_core::time::Instant;

options! {
    /// A link that is good and bad in turn.
    #[derive(Copy)]
    pub struct Bursts {
        /// Mean time in the good state, exponential.
        good_mean: Duration, in STAYS;
        /// Mean time in the bad state, exponential.
        bad_mean: Duration, in STAYS;
        /// Probability of a loss in the bad state.
        bad_loss_ratio: f64 = 1.0, in 0.0..=1.0;
        /// Probability of a loss in the good state.
        good_loss_ratio: f64 = 0.0, in 0.0..=1.0;
    }
}

/// Range of the mean time in a state.
const STAYS: RangeInclusive<Duration> = Duration::from_micros(1)..=Duration::from_hours(1);

impl Bursts {
    /// Share of the time in the bad state in the long run.
    pub fn bad_ratio(&self) -> f64 {
        let (good_s, bad_s) = (self.good_mean.as_secs_f64(), self.bad_mean.as_secs_f64());
        bad_s / (good_s + bad_s)
    }
}

impl Law for Bursts {
    fn loss_ratio(&self) -> f64 {
        let bad = self.bad_ratio();
        bad * self.bad_loss_ratio + (1.0 - bad) * self.good_loss_ratio
    }

    fn text(&self) -> String {
        format!(
            "loss in bursts, {} ms good and {} ms bad on average, lost {} in bad and {} in good \
             (loss ratio {:.6}), on all channels of the link at the same times",
            self.good_mean.as_secs_f64() * 1e3,
            self.bad_mean.as_secs_f64() * 1e3,
            self.bad_loss_ratio,
            self.good_loss_ratio,
            self.loss_ratio()
        )
    }

    /// The states from time zero on, as `shared` has them.
    fn start(&self, own: RandomStream, mut shared: RandomStream) -> Box<dyn Losses> {
        let is_bad = shared.chance(self.bad_ratio());
        let mut states = States {
            law: *self,
            shared,
            own,
            is_bad,
            until: Instant::ZERO,
        };
        states.until = Instant::ZERO + states.stay();
        Box::new(states)
    }
}

/// The states of a link; equal laws and streams have equal states.
#[derive(Debug)]
struct States {
    law: Bursts,
    shared: RandomStream,
    own: RandomStream,
    is_bad: bool,
    until: Instant,
}

impl States {
    /// Exponential, of the state's mean; what is left of a state at time zero has the same law.
    fn stay(&mut self) -> Duration {
        let mean = if self.is_bad {
            self.law.bad_mean
        } else {
            self.law.good_mean
        };
        Duration::from_secs_f64(-mean.as_secs_f64() * (1.0 - self.shared.uniform()).ln())
    }
}

impl Losses for States {
    fn is_lost(&mut self, now: Instant) -> bool {
        while now >= self.until && self.until < END_OF_TIME {
            self.is_bad = !self.is_bad;
            self.until = self.until + self.stay();
        }
        self.own.chance(if self.is_bad {
            self.law.bad_loss_ratio
        } else {
            self.law.good_loss_ratio
        })
    }
}

/// Where adding to an [`Instant`] saturates.
const END_OF_TIME: Instant = Instant::from_ns(i64::MAX);
