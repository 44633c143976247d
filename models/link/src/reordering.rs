//! Reordering and duplication: a message now and then is held back, so that later ones overtake
//! it, or arrives once more. Both strike each message by itself; neither models why.

use core::time::Duration;

use hil_core::options;
use hil_core::random::RandomStream;

/// Longest time a message is held back, or its copy comes later.
pub const LATER_MAX: Duration = Duration::from_secs(10);

options! {
    /// Messages held back.
    #[derive(Copy)]
    pub struct Reordering {
        /// Probability that a message is held back.
        ratio: f64, in 0.0..=1.0;
        /// For how long. At a period T it is overtaken by those of the next `hold` / T messages that
        /// are not held back themselves.
        hold: Duration, in Duration::ZERO..=LATER_MAX;
    }
}

options! {
    /// Messages that arrive twice.
    #[derive(Copy)]
    pub struct Duplication {
        /// Probability that a message arrives twice.
        ratio: f64, in 0.0..=1.0;
        /// The second arrival comes so much later.
        lag: Duration = Duration::ZERO, in Duration::ZERO..=LATER_MAX;
    }
}

/// Something that strikes some messages and makes them later.
#[derive(Debug, Clone)]
pub(super) struct RandomHits {
    ratio: f64,
    later: Duration,
    random: RandomStream,
}

impl RandomHits {
    /// With probability `ratio`, by `later`, both checked.
    pub(super) fn new(ratio: f64, later: Duration, random: RandomStream) -> Self {
        Self {
            ratio,
            later,
            random,
        }
    }

    /// How much later the next message is; `None` when it is spared. It takes one number of the
    /// stream for every message.
    pub(super) fn next(&mut self) -> Option<Duration> {
        self.random.chance(self.ratio).then_some(self.later)
    }
}
