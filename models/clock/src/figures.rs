//! What an alignment says of itself: plain figures, ready to be written and read back.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::exchange::StampKind;
use hil_stats::bounds::BoundFigures;

/// An alignment in figures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ClockFigures {
    /// Exchanges given, in both directions.
    pub exchange_count: u64,
    /// Those not used: implausible, or under way while a clock was stepped.
    pub unused_count: u64,
    /// Stamps of the exchanges given, four each, by what took them.
    pub stamp_counts: BTreeMap<StampKind, u64>,
    /// Smallest round trip, nanoseconds; 0 when errors of the stamps make it less than nothing.
    pub rtt_min_ns: Option<i64>,
    /// The offset in the middle of the exchanges or, when a clock was stepped just there, at the
    /// nearest instant that has one.
    pub offset: Option<OffsetFigures>,
    /// The offset in the middle of each stretch between noticed steps, in order of time: one
    /// offset cannot be held against a run with steps.
    pub stretch_offsets: Vec<OffsetFigures>,
    /// Standard deviation of the estimate's points about the line between their neighbours,
    /// nanoseconds; says nothing of a path that is always slower one way.
    pub spread_ns: Option<f64>,
    /// How much faster this host's clock runs than the other's, parts per million, over the longest
    /// stretch without a step.
    pub skew_ppm: Option<f64>,
    /// Its standard error: of the line, or of the mean of four parts' slopes, whichever is larger.
    pub skew_error_ppm: Option<f64>,
    /// Largest error of a converted instant, over the time of the exchanges.
    pub bound: Option<BoundFigures>,
    /// Steps of either clock that were noticed.
    pub steps: Vec<ClockStep>,
    /// Drift allowance, parts per billion.
    pub drift_ppb: u32,
}

/// The offset at one instant: `local = remote + offset`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct OffsetFigures {
    /// The instant, on the other host's clock, nanoseconds.
    pub at_ns: i64,
    /// Assuming that the fastest exchanges took equally long both ways.
    pub estimate_ns: i64,
    /// The guaranteed interval, from causality alone.
    pub lowest_ns: i64,
    /// Its other end.
    pub highest_ns: i64,
}

/// A step of one of the two clocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockStep {
    /// It happened after this, on the other host's clock, nanoseconds. Instants from here to
    /// `until_ns` have no alignment.
    pub from_ns: i64,
    /// It happened before this.
    pub until_ns: i64,
    /// What the offset gained by it, as estimated, nanoseconds.
    pub size_ns: Option<i64>,
}
