//! How another host's clock relates to this host's, from four-stamp exchanges, with a bound that
//! holds whatever the network did. It disciplines no clock and talks to no network: exchanges come
//! in as numbers, a [`ClockMap`] goes out.
//!
//! The relation sought is `local = remote + offset`. Two numbers are given for every instant:
//!
//! - the **guaranteed interval**, from causality alone: nothing arrives before it was sent, so each
//!   direction of an exchange bounds the offset from one side (the round trip of an exchange is the
//!   width of what it allows). No symmetry of the path is assumed. A bound found at one moment holds
//!   at another after being widened by the drift allowance for the time between.
//! - the **estimate**, which assumes that the fastest exchanges took equally long both ways
//!   (RFC 5905 section 8, "clock filter": smallest round trips). A path that is always slower in
//!   one direction shifts the estimate by half the difference and nothing on these two hosts can
//!   tell; the guaranteed interval contains that error.
//!
//! What the guarantee assumes: stamps err by at most [`ClockSettings::stamp_error_ns`], and the two
//! clocks' rates differ by at most [`ClockSettings::drift_ppb`], except where one of them is
//! stepped. Exchanges that contradict the limit withdraw the guarantee: then nothing converts, and
//! [`ClockMetrics::drift_contradiction`] says why. What was learnt before an instant and what was learnt after it are kept apart, and the
//! interval is the hull of both. So one step of any size cannot spoil it, be it noticed or not:
//! either all that went before or all that came after is of the same side of the step. A
//! step that no constant offset explains is noticed, and instants around it have no alignment at
//! all.
//!
//! This needs an exchange on either side. Before the first exchange is over, and once the last one
//! has begun, there is one side only: there, a step between an instant and the exchanges is not
//! covered, and [`BEYOND_NS_MAX`] outside them the alignment ends. The same holds at the ends of
//! every stretch between noticed steps.
#![forbid(unsafe_code)]

mod anchors;
mod band;
mod drift;
mod exchange;
mod map;
#[cfg(test)]
mod tests;

pub use drift::DriftContradiction;
pub use exchange::{Exchange, Requester, StampKind};

pub use map::{ClockMap, ClockMetrics, ClockStep, Localised, OffsetMetrics};

use serde::{Deserialize, Serialize};

/// How long before the first exchange began and after the last one was over instants still convert.
///
/// Gateways exchange clocks ten times a second, and an exchange counts only once its response is
/// back. So a run begins and ends with messages without an exchange beyond them: a period's worth,
/// and a round trip's on top, which is most of a second on the slowest paths. What is assumed for
/// them beyond the drift allowance is that no clock is stepped in that second; a monotonic clock
/// cannot be set and steps only when its host stood still.
pub const BEYOND_NS_MAX: i64 = 1_000_000_000;

/// What the estimator takes for granted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockSettings {
    /// Largest difference of the two clocks' rates, in parts per billion.
    ///
    /// Oscillators of computers keep within 100 ppm of nominal (the kernel steers up to 500 ppm,
    /// `MAXFREQ` of `adjtimex(2)`); two of them differ by at most twice that.
    pub drift_ppb: u32,
    /// Of each span of this length the exchange with the smallest round trip is used for the
    /// estimate, nanoseconds.
    pub window_ns: i64,
    /// Largest error of a stamp that was taken by the kernel on its real-time clock and converted
    /// to the monotonic clock, nanoseconds. A program's own stamps are taken as exact.
    pub stamp_error_ns: i64,
}

impl Default for ClockSettings {
    fn default() -> Self {
        Self {
            drift_ppb: 200_000,
            window_ns: 1_000_000_000,
            stamp_error_ns: 1_000,
        }
    }
}

impl ClockSettings {
    /// How far the offset may have moved in `span_ns`, rounded up.
    pub fn drift_ns(&self, span_ns: i64) -> i64 {
        let product = i128::from(span_ns.unsigned_abs()) * i128::from(self.drift_ppb);
        let drift = (product + 999_999_999) / 1_000_000_000;
        i64::try_from(drift).unwrap_or(i64::MAX)
    }
}
