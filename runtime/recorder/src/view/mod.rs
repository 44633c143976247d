//! The state of a run while it goes on, worked out from its records as they come: figures of each
//! channel, losses, the fleet on its ground, the arms. It reads nothing, sends nothing and looks at
//! no clock: records and "now" are arguments, results are JSON as docs/live-view.md lists it.
//!
//! All times are nanoseconds on one axis, that of a recording: a host's monotonic clock plus its
//! offset (see [`crate::clocks`]).

mod account;
pub(crate) mod arms;
pub(crate) mod collisions;
pub(crate) mod facts;
pub(crate) mod fleet;
pub(crate) mod ground;
pub(crate) mod sections;
pub(crate) mod state;

use hil_watch::Record;

/// Something that a process of the run recorded.
#[derive(Debug, Clone)]
pub(crate) struct LiveRecord {
    /// When it was known: of a played back run, when it happened.
    pub(crate) at_ns: i64,
    /// Which channel, by its place in [`facts::RunFacts`].
    pub(crate) channel: usize,
    /// What.
    pub(crate) body: Body,
}

/// What a record says.
#[derive(Debug, Clone)]
pub(crate) enum Body {
    /// A message itself.
    Message(Vec<u8>),
    /// What became of one on its way.
    Record(Record),
}

/// To the millimetre, or to the thousandth of whatever else: enough for a picture, half the bytes.
pub(crate) fn rounded(value: f64) -> f64 {
    (value * 1000.0).round() / 1000.0
}

/// Seconds, to the millisecond.
pub(crate) fn seconds(ns: i64) -> f64 {
    rounded(ns as f64 / 1e9)
}
