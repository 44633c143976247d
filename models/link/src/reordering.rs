//! Reordering and duplication: a message now and then is held back, so that later ones overtake
//! it, or arrives once more. Both strike each message by itself; neither models why.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use hil_core::case_study::ParameterError;
use hil_core::random::RandomStream;

/// Longest time a message is held back, or its copy comes later.
pub const LATER_MAX: Duration = Duration::from_secs(10);

/// Messages held back.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reordering {
    /// Probability that a message is held back, 0..=1.
    pub ratio: f64,
    /// For how long, 0..=10 s. At a period T it is overtaken by those of the next `hold` / T
    /// messages that are not held back themselves.
    pub hold: Duration,
}

/// Messages that arrive twice.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Duplication {
    /// Probability that a message arrives twice, 0..=1.
    pub ratio: f64,
    /// The second arrival comes so much later, 0..=10 s.
    #[serde(default)]
    pub lag: Duration,
}

impl Reordering {
    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first key outside its range.
    pub fn check(&self) -> Result<(), ParameterError> {
        check(self.ratio, ("hold", self.hold))
    }
}

impl Duplication {
    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first key outside its range.
    pub fn check(&self) -> Result<(), ParameterError> {
        check(self.ratio, ("lag", self.lag))
    }
}

fn check(ratio: f64, (key, later): (&str, Duration)) -> Result<(), ParameterError> {
    ParameterError::check("ratio", ratio, 0.0..=1.0, "0 to 1")?;
    if later <= LATER_MAX {
        return Ok(());
    }
    let problem = format!("{later:?} is outside 0 s to {LATER_MAX:?}");
    Err(ParameterError::new(key, problem))
}

/// Something that strikes some messages and makes them later.
#[derive(Debug, Clone)]
pub(super) struct Strikes {
    ratio: f64,
    later: Duration,
    random: RandomStream,
}

impl Strikes {
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
