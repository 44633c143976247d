//! Loss laws: which messages a link loses by chance. What it loses because it is down is in
//! [`outages`](super::outages), and what it loses because it is full in [`rate`](super::rate).

pub mod bursts;
pub mod gilbert_elliott;

#[cfg(test)]
mod tests;

use core::fmt;

use serde::{Deserialize, Serialize};

use self::bursts::States;
use self::gilbert_elliott::Chain;
use hil_core::case_study::ParameterError;
use hil_core::random::RandomStream;
use hil_core::time::Instant;

pub use bursts::Bursts;
pub use gilbert_elliott::GilbertElliott;

/// Each message is lost by itself, as in the static model of the seed paper (Lv et al., section
/// II.B).
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bernoulli {
    /// Probability of a loss, 0..=1.
    pub ratio: f64,
}

/// How a link loses messages by chance.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "law", rename_all = "kebab-case")]
pub enum LossLaw {
    /// Each by itself.
    Bernoulli(Bernoulli),
    /// In bursts of so many messages.
    GilbertElliott(GilbertElliott),
    /// In bursts of so much time, the same on all channels.
    Bursts(Bursts),
}

impl LossLaw {
    /// Each message by itself with probability `ratio`.
    pub const fn bernoulli(ratio: f64) -> Self {
        Self::Bernoulli(Bernoulli { ratio })
    }

    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first key outside its range.
    pub fn check(&self) -> Result<(), ParameterError> {
        match self {
            Self::Bernoulli(law) => {
                ParameterError::check("loss_ratio", law.ratio, 0.0..=1.0, "0 to 1")
            }
            Self::GilbertElliott(law) => law.check(),
            Self::Bursts(law) => law.check(),
        }
    }

    /// Share of the messages lost in the long run.
    pub fn loss_ratio(&self) -> f64 {
        match self {
            Self::Bernoulli(law) => law.ratio,
            Self::GilbertElliott(law) => law.loss_ratio(),
            Self::Bursts(law) => law.loss_ratio(),
        }
    }
}

/// The shares of the messages lost in either state of a law with two.
fn check_loss_ratios(bad: f64, good: f64) -> Result<(), ParameterError> {
    for (key, ratio) in [("bad_loss_ratio", bad), ("good_loss_ratio", good)] {
        ParameterError::check(key, ratio, 0.0..=1.0, "0 to 1")?;
    }
    Ok(())
}

impl Default for LossLaw {
    /// No loss.
    fn default() -> Self {
        Self::bernoulli(0.0)
    }
}

/// The law in words.
impl fmt::Display for LossLaw {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Bernoulli(law) => write!(formatter, "loss ratio {}", law.ratio),
            Self::GilbertElliott(law) => write!(
                formatter,
                "Gilbert-Elliott loss, per message good to bad {} and back {}, lost {} in bad and {} \
                 in good (loss ratio {:.6})",
                law.to_bad,
                law.to_good,
                law.bad_loss_ratio,
                law.good_loss_ratio,
                law.loss_ratio()
            ),
            Self::Bursts(law) => write!(
                formatter,
                "loss in bursts, {} ms good and {} ms bad on average, lost {} in bad and {} in good \
                 (loss ratio {:.6}), on all channels of the link at the same times",
                law.good_mean.as_secs_f64() * 1e3,
                law.bad_mean.as_secs_f64() * 1e3,
                law.bad_loss_ratio,
                law.good_loss_ratio,
                law.loss_ratio()
            ),
        }
    }
}

/// A checked law at work on one channel.
#[derive(Debug, Clone)]
pub(super) struct LossProcess {
    law: Process,
    random: RandomStream,
}

#[derive(Debug, Clone)]
enum Process {
    Bernoulli(f64),
    Chain(Chain),
    States(States),
}

impl LossProcess {
    /// `own` is the channel's stream, `shared` one that all channels of the link have alike.
    ///
    /// # Errors
    /// The first key of `law` outside its range.
    pub(super) fn new(
        law: LossLaw,
        mut own: RandomStream,
        shared: RandomStream,
    ) -> Result<Self, ParameterError> {
        law.check()?;
        let law = match law {
            LossLaw::Bernoulli(law) => Process::Bernoulli(law.ratio),
            LossLaw::GilbertElliott(law) => Process::Chain(Chain::new(law, &mut own)),
            LossLaw::Bursts(law) => Process::States(States::new(law, shared)),
        };
        Ok(Self { law, random: own })
    }

    /// Decides the fate of the next message, at `now`; calls come in non-decreasing `now`. The
    /// stream advances for every message, so the fate of the n-th depends on the seed, on n and on
    /// the time alone.
    pub(super) fn is_lost(&mut self, now: Instant) -> bool {
        match &mut self.law {
            Process::Bernoulli(ratio) => self.random.chance(*ratio),
            Process::Chain(chain) => chain.is_lost(&mut self.random),
            Process::States(states) => self.random.chance(states.loss_ratio_at(now)),
        }
    }
}
