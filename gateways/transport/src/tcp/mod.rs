//! TCP: one connection per channel direction, from the sending gateway to the receiving one; the
//! replies come back on it. The protocol above is the one of the other transports, datagram by
//! datagram ([`frame`] has the layout); order and exactly-once delivery hold per connection.
//!
//! - A peer that is not there is a state: the sender tries again, first after 20 ms, then after
//!   twice as long each time up to 250 ms. What was under way when a connection ended is
//!   lost, and the sequence accounting counts it.
//! - Nothing blocks. What the kernel does not take waits in a bounded buffer; a message that finds
//!   no room there is refused and counted.
//! - Every message leaves at once (`TCP_NODELAY`), and what it then waits for is measured: see
//!   [`StreamFigures`].
//! - There are no kernel stamps. The kernel stamps bytes of a stream, not messages: segments are
//!   joined and cut on the way, and a joined one keeps only the newer of two stamps.

mod figures;
pub mod frame;
mod receiver;
mod sender;
mod socket;
mod stall;
mod stream;

#[cfg(test)]
mod tests;

use std::net::SocketAddr;

use hil_core::time::Instant;

pub use figures::{ConnectionTally, StreamFigures};
pub use receiver::TcpReceiver;
pub use sender::TcpSender;
pub use socket::{KEEP_ALIVE_COUNT, KEEP_ALIVE_IDLE, KEEP_ALIVE_INTERVAL, USER_TIMEOUT};

/// How to set up either end. Everything optional stays at the kernel's default when `None`.
#[derive(Debug, Clone)]
pub struct TcpSettings {
    /// Where this end is: where a receiver listens, and the address, but not the port, that a
    /// sender connects from.
    pub local: SocketAddr,
    /// The other end: where a sender connects to. A receiver takes connections from this address
    /// alone, whatever their port, and names it as the source of every datagram.
    pub peer: SocketAddr,
    /// Interface to bind to (`SO_BINDTODEVICE`).
    pub interface: Option<String>,
    /// Differentiated services code point of outgoing packets, 0..=63 (RFC 2474).
    pub dscp: Option<u8>,
    /// Priority in the queueing discipline (`SO_PRIORITY`); above 6 needs `CAP_NET_ADMIN`.
    pub priority: Option<u32>,
    /// Send buffer in bytes (`SO_SNDBUF`): what may wait in the kernel.
    pub send_buffer_bytes: Option<usize>,
    /// Receive buffer in bytes (`SO_RCVBUF`).
    pub receive_buffer_bytes: Option<usize>,
    /// Largest IP packet the path takes; segments are cut to fit it (`TCP_MAXSEG`).
    pub path_mtu_bytes: Option<usize>,
    /// Reads the monotonic clock: how long a byte waits counts from when it was sent.
    pub clock: fn() -> Instant,
}

impl TcpSettings {
    /// The kernel's defaults.
    pub const fn new(local: SocketAddr, peer: SocketAddr, clock: fn() -> Instant) -> Self {
        Self {
            local,
            peer,
            interface: None,
            dscp: None,
            priority: None,
            send_buffer_bytes: None,
            receive_buffer_bytes: None,
            path_mtu_bytes: None,
            clock,
        }
    }
}
