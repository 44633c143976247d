//! A cable: a program runs in a network namespace of its own with one Ethernet interface, and every frame
//! that it sends or receives passes through threads of ours, which need no right for it.
//!
//! ```text
//!   program's namespace          cable's namespace        threads of ours, in the host's namespace
//!   ┌─────────────────┐          ┌──────────────┐         ┌────────┐
//!   │ program ─► eth0 ┼── veth ──┼► end ─► ring ┼─────────┼► Inlet │
//!   └─────────────────┘          └──────────────┘         └────────┘
//! ```
//!
//! A helper process [`enter`]s both namespaces, [`hand_over`]s the socket of the cable's end and becomes the
//! program. The process that started it keeps the socket in a [`CableServer`], where the threads that carry the frames
//! fetch it as an [`Inlet`]. How frames get from one inlet to another is outside this crate: nothing here knows a channel,
//! a link or a datagram.
//!
//! [`pcs`] are whole hosts made in the same way, with a plain pair of interfaces between each two.
#![forbid(unsafe_code)]

mod inlet;
mod inside;
mod netlink;
pub mod pcs;
mod refusal;
mod server;

pub use inlet::{CableClient, GivenEnd, Inlet};
pub use inside::{CableEnd, Inside, await_go, enter, hand_over, refuse};
pub use refusal::{Refusal, Step};
pub use server::{CableError, CableServer, InterfaceDrops};

use hil_net::packet_ring::{RingSettings, RingStamps};

/// The program's interface.
pub const INTERFACE: &str = "eth0";
/// Largest IP packet of the program: what Ethernet carries. A frame that is longer than a datagram of the link
/// below has room for goes in two pieces.
pub const MTU_BYTES: u32 = 1500;

/// Memory of an inlet for frames that wait to be fetched: 4096.
pub const RING_BYTES: usize = 8 << 20;

const RING: RingSettings = RingSettings {
    snap_bytes: 1900,
    ring_bytes: RING_BYTES,
    stamps: RingStamps::Kernel,
};
