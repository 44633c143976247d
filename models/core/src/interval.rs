//! An interval of 95 %, or why there is none. How they are computed, and what was measured of each
//! method's coverage, is in the crate of statistics.

use core::fmt;

use serde::{Deserialize, Serialize};

hil_core::labelled! {
    /// How an interval was obtained.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum IntervalMethod, name {
        /// Of a share: beta distribution (Clopper and Pearson 1934, mid-p) on the effective sample.
        EffectiveShare = "beta interval on the effective sample",
        /// Of a quantile: ranks (Woodruff 1952) of the effective sample.
        EffectiveRanks = "ranks of the effective sample",
        /// Of a mean: Student's on the variance of an effective sample.
        EffectiveMean = "Student's interval on the effective sample",
        /// Of a share of independent trials (Clopper and Pearson 1934).
        Exact = "Clopper and Pearson's interval",
        /// Of a mean of repetitions (Student 1908).
        Student = "Student's interval",
        /// Of a difference or ratio of repetitions (Welch 1947).
        Welch = "Welch's interval",
        /// Of a difference or ratio, from the interval of each side (MOVER, Zou and Donner 2008).
        Mover = "MOVER of both sides' intervals",
    }
}

impl IntervalMethod {
    /// What its coverage takes for granted.
    pub const fn assumption(self) -> &'static str {
        match self {
            Self::EffectiveShare | Self::EffectiveRanks | Self::EffectiveMean => {
                "the run is stationary; its memory, fading or long, is weighed by the data"
            }
            Self::Exact => "trials are independent, or their counts divided by their scatter",
            Self::Student | Self::Welch => "repetitions are independent",
            Self::Mover => "both sides are independent, and their own intervals hold",
        }
    }
}

/// A closed interval that holds the true value in 95 of 100 samples.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
    /// How it was obtained.
    pub method: IntervalMethod,
}

impl Interval {
    /// From `low` to `high`.
    pub const fn new(low: f64, high: f64, method: IntervalMethod) -> Self {
        Self { low, high, method }
    }

    /// With both ends changed by a function that does not decrease.
    #[must_use]
    pub fn map(self, change: impl Fn(f64) -> f64) -> Self {
        Self::new(change(self.low), change(self.high), self.method)
    }

    /// True when `value` is in it.
    pub fn holds(self, value: f64) -> bool {
        self.low <= value && value <= self.high
    }
}

/// Why a sample has no interval: it is worth too few independent observations.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
#[error(
    "no interval: {effective} independent value{}, {needed} needed",
    if *.effective == 1 { "" } else { "s" }
)]
pub struct TooSmall {
    /// What it is worth.
    pub effective: u64,
    /// What it takes.
    pub needed: u64,
}

/// An interval, or why the sample has none.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Spread {
    /// The interval.
    Known(Interval),
    /// There is none.
    Unknown(TooSmall),
}

impl Spread {
    /// The interval, where there is one.
    pub const fn known(self) -> Option<Interval> {
        match self {
            Self::Known(interval) => Some(interval),
            Self::Unknown(_) => None,
        }
    }

    /// With both ends changed by a function that does not decrease.
    #[must_use]
    pub fn map(self, change: impl Fn(f64) -> f64) -> Self {
        match self {
            Self::Known(interval) => Self::Known(interval.map(change)),
            Self::Unknown(_) => self,
        }
    }
}

impl From<Result<Interval, TooSmall>> for Spread {
    fn from(found: Result<Interval, TooSmall>) -> Self {
        found.map_or_else(Self::Unknown, Self::Known)
    }
}

impl fmt::Display for Spread {
    /// The method with what it takes for granted, or why there is none.
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Known(Interval { method, .. }) => {
                write!(formatter, "{}: {}", method.name(), method.assumption())
            }
            Self::Unknown(why) => why.fmt(formatter),
        }
    }
}
