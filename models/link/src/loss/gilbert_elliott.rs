//! Loss law of Gilbert (1960) and Elliott (1963), per message: a chain of a good and a bad state
//! takes one step per message, and each state loses messages with a probability of its own. The
//! same process as `gemodel` of Linux `tc-netem`, with p = `to_bad`, r = `to_good`,
//! 1-h = `bad_loss_ratio` and 1-k = `good_loss_ratio`.
//!
//! As the chain knows messages and no time, channels of different rates see bursts of equal
//! numbers of messages, not of equal length, and each channel has a chain of its own; the law in
//! [`bursts`](super::bursts) is the other way round. Unlike netem, the first state is drawn from
//! the long-run shares, so that the promised ratio holds from the first message on.

use serde::{Deserialize, Serialize};

use super::check_loss_ratios;
use hil_core::case_study::ParameterError;
use hil_core::random::RandomStream;

/// A chain that takes one step per message.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GilbertElliott {
    /// Probability of a step from good to bad, 1e-9..=1.
    pub to_bad: f64,
    /// Probability of a step from bad to good, 1e-9..=1; the bad state lasts 1 / `to_good`
    /// messages on average.
    pub to_good: f64,
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

impl GilbertElliott {
    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first key outside its range.
    pub fn check(&self) -> Result<(), ParameterError> {
        for (key, step) in [("to_bad", self.to_bad), ("to_good", self.to_good)] {
            ParameterError::check(key, step, 1e-9..=1.0, "1e-9 to 1")?;
        }
        check_loss_ratios(self.bad_loss_ratio, self.good_loss_ratio)
    }

    /// Share of the messages that meet the bad state in the long run.
    pub fn bad_ratio(&self) -> f64 {
        self.to_bad / (self.to_bad + self.to_good)
    }

    /// Share of the messages lost in the long run.
    pub fn loss_ratio(&self) -> f64 {
        let bad = self.bad_ratio();
        bad * self.bad_loss_ratio + (1.0 - bad) * self.good_loss_ratio
    }
}

/// The chain at work.
#[derive(Debug, Clone)]
pub(super) struct Chain {
    law: GilbertElliott,
    is_bad: bool,
}

impl Chain {
    pub(super) fn new(law: GilbertElliott, random: &mut RandomStream) -> Self {
        Self {
            law,
            is_bad: random.chance(law.bad_ratio()),
        }
    }

    /// Decides the fate of the next message; always takes two numbers of the stream.
    pub(super) fn is_lost(&mut self, random: &mut RandomStream) -> bool {
        let law = &self.law;
        let (loss_ratio, step) = if self.is_bad {
            (law.bad_loss_ratio, law.to_good)
        } else {
            (law.good_loss_ratio, law.to_bad)
        };
        let is_lost = random.chance(loss_ratio);
        self.is_bad ^= random.chance(step);
        is_lost
    }
}
