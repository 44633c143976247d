//! The gateway protocol, sans IO: datagram format, accounting and the two halves of a bridge.
//!
//! Nothing here opens a socket, reads a clock or owns a thread, and nothing allocates once a
//! bridge is constructed. The loop that owns a bridge hands it messages, datagrams and `now`, and
//! sends what `poll_transmit` gives. Read in this order:
//!
//! 1. [`wire`] and [`body`]: the datagram, byte by byte; [`refusal`]: every way to refuse one.
//! 2. [`sequence`]: lost, reordered, duplicate, late; [`fragment`]: messages above the path MTU.
//! 3. [`egress`]: the sending host's half of a flow.
//! 4. [`ingress`]: the receiving host's half.
//! 5. [`seal`]: encryption and authentication, between a bridge and its transport.
//! 6. [`transport`]: what is known of a transport before it is opened.
//!
//! A flow carries the messages of any number of channels one way. Replies (acknowledged greetings, clock
//! exchanges) travel the other way on the same pair of addresses. What is agreed and exchanged once is the
//! flow's: session, seal, clock exchanges; sequences, pieces and what became of messages are a channel's.
//!
//! A message from one host to the other, without a network:
//!
//! ```
//! use std::time::Duration;
//! use hil_protocol::{
//!     ArrivalStamps, ChannelIdentity, Delivery, Destination, EgressBridge, EgressSettings,
//!     FlowIdentity, IngressBridge, IngressSettings, Payload, Piece,
//! };
//! use hil_core::message::Envelope;
//! use hil_core::time::Instant;
//!
//! /// Takes messages that come in one datagram.
//! #[derive(Default)]
//! struct Received(Vec<u8>);
//!
//! impl Destination for Received {
//!     fn store(&mut self, _piece: &Piece<'_>) -> bool {
//!         false
//!     }
//!
//!     fn deliver(&mut self, _delivery: &Delivery, payload: Payload<'_>) {
//!         if let Payload::Datagram(bytes) = payload {
//!             self.0.extend_from_slice(bytes);
//!         }
//!     }
//! }
//!
//! let channel = ChannelIdentity::new(0, "arm/command", "example.Command.v1", 8, 8);
//! let name = "link/hop/forward".to_owned();
//! let flow = FlowIdentity { flow: 65_535, name, channels: vec![channel] };
//! let mut ingress = IngressBridge::new(IngressSettings::new(flow.clone(), 7, [2; 16], 22))?;
//! let mut egress = EgressBridge::new(EgressSettings {
//!     flow,
//!     session: 5,
//!     domain: [1; 16],
//!     clock_id: 11,
//!     datagram_max_bytes: 1472,
//!     sync_period: Duration::from_millis(20),
//! })?;
//! let now = Instant::from_ns(1_000);
//! let arrival = ArrivalStamps::application(1_000);
//! let mut destination = Received::default();
//!
//! let hello = egress.poll_transmit(now).expect("a greeting comes first").datagram;
//! ingress.on_datagram(now, arrival, hello, &mut destination)?;
//! let answer = ingress.poll_transmit(now).expect("a greeting is answered").datagram;
//! egress.on_datagram(now, arrival, answer)?;
//!
//! let envelope = Envelope { published_ns: 900, ..Envelope::default() };
//! egress.on_local(now, 0, &envelope, &[42; 8])?;
//! let data = egress.poll_transmit(now).expect("the message was staged").datagram;
//! ingress.on_datagram(now, arrival, data, &mut destination)?;
//! assert_eq!(destination.0, [42; 8]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![forbid(unsafe_code)]

pub mod body;
pub mod channel;
mod counters;
pub mod egress;
pub mod fragment;
pub mod ingress;
#[cfg(any(test, feature = "lab"))]
#[path = "tests/lab.rs"]
pub mod lab;
pub mod refusal;
pub mod seal;
pub mod sequence;
pub mod stamps;
pub mod transport;
pub mod wire;

pub use channel::{ChannelIdentity, FlowIdentity, SettingsError};
pub use egress::{
    EgressBridge, EgressEvent, EgressSettings, LocalRefusal, LongPiece, PeerState, Transmit,
    TransmitFailure, TransmitKey,
};
pub use ingress::{
    Delivery, Destination, Disposition, Incomplete, IngressBridge, IngressSettings, MessageInfo,
    Payload, Piece, Reply,
};
#[cfg(any(test, feature = "lab"))]
pub use lab::InMemory;
pub use refusal::{Refusal, RefusalCounts};
pub use stamps::{ArrivalStamps, StampSource};

#[cfg(test)]
mod tests;
