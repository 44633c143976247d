//! Looking on while a run goes: for recorders, viewers and terminals. It changes nothing of a run and
//! takes nothing from its measured path.
//!
//! Read in this order:
//!
//! 1. [`running_runs`](hil_rundir::select::running_runs) and
//!    [`select`](hil_rundir::select::select): which runs go on this host. Each supervisor announces its
//!    run in a [`LiveRun`](hil_rundir::live_run::LiveRun).
//! 2. [`RecordFollower`]: what the processes of a run wrote into its folder since the last look.
//! 3. [`PassiveReader`]: a channel read from shared memory, without a place in the run.
//! 4. [`Feed`]: both of them as one stream of [`Event`]s, and what was missed.
//!
//! Records first, shared memory for the rest. Messages of a producer that keeps records are
//! followed from its files: that is complete from the first message on, whenever one begins to
//! look, and costs the run nothing. Messages that nobody on this host records, of a user's own
//! program or from another host, are read from shared memory from the moment one begins to look.
#![forbid(unsafe_code)]

mod event;
mod feed;
mod follow;
pub mod link;
pub mod live;
mod passive;
mod seen;
mod shared;
mod since;

#[cfg(test)]
mod tests;

pub use event::{Event, Origin, Record};
pub use feed::{Feed, FeedError, Poll, WatchedChannel};
pub use follow::{Batch, RecordFollower};
pub use passive::{PassiveCounters, PassiveReader};
pub use seen::Seen;
