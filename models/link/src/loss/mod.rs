//! Loss laws: which messages a link loses by chance. What it loses because it is down is in
//! [`outages`](super::outages), and what it loses because it is full in [`rate`](super::rate).

mod bernoulli;
mod bursts;
mod gilbert_elliott;

#[cfg(test)]
mod tests;

use core::fmt::{self, Debug};

use crate::laws::laws;
use hil_core::case_study::ParameterError;
use hil_core::options::Options;
use hil_core::random::RandomStream;
use hil_core::time::Instant;

pub use bernoulli::Bernoulli;
pub use bursts::Bursts;
pub use gilbert_elliott::GilbertElliott;

laws! {
    /// Law of a link's losses by chance.
    #[derive(Copy)]
    pub enum LossLaw: Law {
        /// Each by itself.
        Bernoulli = "bernoulli",
        /// In bursts of so many messages.
        GilbertElliott = "gilbert-elliott",
        /// In bursts of so much time, the same on all channels.
        Bursts = "bursts",
    }
}

/// A loss law as it is configured.
trait Law: Options {
    /// Share of the messages lost in the long run.
    fn loss_ratio(&self) -> f64;

    /// The law in words.
    fn text(&self) -> String;

    /// The law at work; see [`LossLaw::start`].
    fn start(&self, own: RandomStream, shared: RandomStream) -> Box<dyn Losses>;
}

/// A loss law at work on one channel.
pub(super) trait Losses: Debug + Send {
    /// Decides the fate of the next message, at `now`; calls come in non-decreasing `now`. The
    /// channel's stream advances for every message, so the fate of the n-th depends on the seed, on n
    /// and on the time alone.
    fn is_lost(&mut self, now: Instant) -> bool;
}

impl LossLaw {
    /// Each message by itself with probability `ratio`.
    pub const fn bernoulli(ratio: f64) -> Self {
        Self::Bernoulli(Bernoulli { ratio })
    }

    /// Share of the messages lost in the long run.
    pub fn loss_ratio(&self) -> f64 {
        self.law().loss_ratio()
    }

    /// The law at work on one channel; `own` is the channel's stream, `shared` one that all channels
    /// of the link have alike.
    ///
    /// # Errors
    /// The first key outside its range.
    pub(super) fn start(
        &self,
        own: RandomStream,
        shared: RandomStream,
    ) -> Result<Box<dyn Losses>, ParameterError> {
        self.check()?;
        Ok(self.law().start(own, shared))
    }
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
        formatter.write_str(&self.law().text())
    }
}
