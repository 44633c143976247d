//! Loss law of Gilbert (1960) and Elliott (1963), per message: a chain of a good and a bad state
//! takes one step per message, and each state loses messages with a probability of its own. The
//! same process as `gemodel` of Linux `tc-netem`, with p = `to_bad`, r = `to_good`,
//! 1-h = `bad_loss_ratio` and 1-k = `good_loss_ratio`.
//!
//! As the chain knows messages and no time, channels of different rates see bursts of equal
//! numbers of messages, not of equal length, and each channel has a chain of its own; the law in
//! [`bursts`](super::bursts) is the other way round. Unlike netem, the first state is drawn from
//! the long-run shares, so that the promised ratio holds from the first message on.

use super::{Law, Losses};
use hil_core::options;
use hil_core::random::RandomStream;
use hil_core::time::Instant;

options! {
    /// A chain that takes one step per message.
    #[derive(Copy)]
    pub struct GilbertElliott {
        /// Probability of a step from good to bad.
        to_bad: f64, in 1e-9..=1.0;
        /// Probability of a step from bad to good; the bad state lasts 1 / `to_good` messages on
        /// average.
        to_good: f64, in 1e-9..=1.0;
        /// Probability of a loss in the bad state.
        bad_loss_ratio: f64 = 1.0, in 0.0..=1.0;
        /// Probability of a loss in the good state.
        good_loss_ratio: f64 = 0.0, in 0.0..=1.0;
    }
}

impl GilbertElliott {
    /// Share of the messages that meet the bad state in the long run.
    pub fn bad_ratio(&self) -> f64 {
        self.to_bad / (self.to_bad + self.to_good)
    }
}

impl Law for GilbertElliott {
    fn loss_ratio(&self) -> f64 {
        let bad = self.bad_ratio();
        bad * self.bad_loss_ratio + (1.0 - bad) * self.good_loss_ratio
    }

    fn text(&self) -> String {
        format!(
            "Gilbert-Elliott loss, per message good to bad {} and back {}, lost {} in bad and {} in \
             good (loss ratio {:.6})",
            self.to_bad,
            self.to_good,
            self.bad_loss_ratio,
            self.good_loss_ratio,
            self.loss_ratio()
        )
    }

    fn start(&self, mut own: RandomStream, _shared: RandomStream) -> Box<dyn Losses> {
        Box::new(Chain {
            law: *self,
            is_bad: own.chance(self.bad_ratio()),
            random: own,
        })
    }
}

/// The chain at work.
#[derive(Debug)]
struct Chain {
    law: GilbertElliott,
    is_bad: bool,
    random: RandomStream,
}

impl Losses for Chain {
    /// Always takes two numbers of the stream.
    fn is_lost(&mut self, _now: Instant) -> bool {
        let law = &self.law;
        let (loss_ratio, step) = if self.is_bad {
            (law.bad_loss_ratio, law.to_good)
        } else {
            (law.good_loss_ratio, law.to_bad)
        };
        let is_lost = self.random.chance(loss_ratio);
        self.is_bad ^= self.random.chance(step);
        is_lost
    }
}
