//! What the owner of a socket knows about a datagram that arrived. It reads no clock and no
//! socket; the owner fills it in.

use core::net::SocketAddr;

/// Which clock reading a stamp is. All stamps of this module are already on the host's
/// *monotonic* clock; the owner of the socket converts kernel and hardware stamps first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, bytemuck::CheckedBitPattern)]
#[repr(u8)]
pub enum StampSource {
    /// Read by the program, just before the send or just after the receive call.
    #[default]
    Application = 0,
    /// Taken by the kernel in the driver or on entry to the network stack.
    KernelSoftware = 1,
    /// Taken by the network card.
    Hardware = 2,
}

/// When and from where a datagram arrived.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ArrivalStamps {
    /// Arrival on this host's monotonic clock, nanoseconds: the best stamp there is.
    pub received_ns: i64,
    /// What kind of stamp [`ArrivalStamps::received_ns`] is.
    pub received_source: StampSource,
    /// Sender's address; `None` where the transport has no addresses or the socket is connected
    /// and the kernel has already checked it.
    pub peer: Option<SocketAddr>,
}

impl ArrivalStamps {
    /// An arrival at `received_ns` that only the program stamped, on a connected transport.
    pub const fn application(received_ns: i64) -> Self {
        Self {
            received_ns,
            received_source: StampSource::Application,
            peer: None,
        }
    }
}
