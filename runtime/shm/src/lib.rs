//! Shared-memory channels between the processes of one host, on iceoryx2. Nothing here knows a
//! network: a gateway uses [`RawInput`] and [`RawOutput`] like any other program.
//!
//! Read in this order:
//!
//! 1. [`Domain`]: the shared memory of one run on one host. The launcher creates it, every other
//!    process opens it by its [`DomainAddress`](hil_platform::domain_address::DomainAddress).
//! 2. [`ChannelHolder`]: the launcher creates every channel and holds it open, because a process
//!    killed while *creating* an iceoryx2 service wedges that service for good.
//! 3. [`ShmOutput`] and [`ShmInput`]: the ports of a role, typed at run time. [`TypedOutput`] and
//!    [`TypedInput`]: the same channel for a program that knows its message at compile time.
//! 4. [`RawOutput`] and [`RawInput`]: the same channel without its type, for gateways and
//!    recorders.
//! 5. [`Waiter`]: sleeps until one of several channels has a message.
//!
//! A channel is two iceoryx2 services of one name: publish-subscribe for the samples and an event
//! for the wake-ups. Samples are `Envelope` (user header) plus payload. When a reader is slow the
//! oldest waiting sample is replaced; readers see the gap in the sequence numbers and count it.
//!
//! Ports are not [`Send`]: open each in the thread that uses it. A [`Domain`] can be shared.

mod capacity;
mod census;
mod degradation;
mod domain;
mod error;
mod holder;
mod identity;
mod members;
mod observer;
mod ports;
mod raw;
mod sequence;
mod wake;

#[cfg(test)]
mod tests;

pub use capacity::Room;
pub use census::{Attendance, Census};
pub use domain::{Cleanup, Domain, Removal};
pub use error::{ChannelError, DomainError};
pub use holder::{ChannelHolder, ChannelSettings};
pub use identity::{SHARED_MEMORY_DIRECTORY, clock_id};
pub use members::ForeignNodes;
pub use observer::observer_depth;
pub use ports::{ShmInput, ShmOutput, TypedInput, TypedOutput};
pub use raw::{ENVELOPE_TYPE_NAME, HeldMessage, RawInput, RawOutput};
pub use sequence::{InputCounters, OutputSettings, SequenceTracker, Sequencer, Stamp};
pub use wake::{Waiter, Wake};
