//! The gateway protocol, sans IO: datagram format, accounting and the two halves of a bridge.
//!
//! Nothing here opens a socket, reads a clock or owns a thread, and nothing allocates once a
//! bridge is constructed. The loop that owns a bridge hands it messages, datagrams and `now`, and
//! sends what `poll_transmit` gives. Read in this order:
//!
//! 1. [`wire`] and [`body`]: the datagram, byte by byte; [`refusal`]: every way to refuse one.
//! 2. [`sequence`]: lost, reordered, duplicate, late; [`fragment`]: messages above the path MTU.
//! 3. [`egress`]: the sending host's half of a channel.
//! 4. [`ingress`]: the receiving host's half.
//!
//! One channel carries messages one way. Replies (acknowledged greetings, clock exchanges) travel
//! the other way on the same pair of addresses.

pub mod body;
pub mod channel;
pub mod egress;
pub mod fragment;
pub mod ingress;
pub mod refusal;
pub mod sequence;
pub mod stamps;
pub mod wire;

pub use channel::{ChannelIdentity, SettingsError};
pub use egress::{EgressBridge, EgressEvent, EgressSettings, LocalRefusal, PeerState, Transmit};
pub use ingress::{Delivery, Disposition, IngressBridge, IngressSettings, Reply};
pub use refusal::{Refusal, RefusalCounts};
pub use stamps::{ArrivalStamps, StampSource};

#[cfg(test)]
mod tests;
