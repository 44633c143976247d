//! What an adapter notes of each datagram, in records of fixed size: pushed into a ring on the measured
//! path, joined after the run by the report. It computes nothing.

use bytemuck::{Pod, Zeroable};
use hil_core::record::UNAVAILABLE;

/// A datagram that was handed to the kernel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct AdapterSentRecord {
    /// When the message it carries was published on this host, monotonic clock.
    pub published_ns: i64,
    /// When the adapter took that message, monotonic clock.
    pub taken_ns: i64,
    /// Just before the send call, monotonic clock.
    pub handed_ns: i64,
    /// Kernel software transmit stamp, *real-time* clock; [`UNAVAILABLE`] when none came.
    pub tx_software_ns: i64,
    /// Real-time minus monotonic clock, read as a pair next to this datagram.
    pub realtime_offset_ns: i64,
    /// Bits below.
    pub flags: u64,
}

impl AdapterSentRecord {
    /// The message went out before: nothing newer was there when a datagram was due.
    pub const REPEATED: u64 = 1;
    /// The kernel refused it.
    pub const REFUSED_BY_KERNEL: u64 = 1 << 1;

    /// When it left, real-time clock: the kernel's stamp, or else when it was handed over.
    pub fn left_ns(&self) -> i64 {
        if self.tx_software_ns == UNAVAILABLE {
            self.handed_ns.saturating_add(self.realtime_offset_ns)
        } else {
            self.tx_software_ns
        }
    }
}

/// A datagram that came, and was what the protocol allows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct AdapterReceivedRecord {
    /// Kernel software receive stamp, *real-time* clock; [`UNAVAILABLE`] when there was none.
    pub rx_software_ns: i64,
    /// When the receive call returned, monotonic clock.
    pub received_ns: i64,
    /// When the message lay in shared memory and its reader was told, monotonic clock.
    pub published_ns: i64,
    /// Real-time minus monotonic clock, read as a pair next to this datagram.
    pub realtime_offset_ns: i64,
}

impl AdapterReceivedRecord {
    /// When it came, real-time clock: the kernel's stamp, or else when it was received.
    pub fn came_ns(&self) -> i64 {
        if self.rx_software_ns == UNAVAILABLE {
            self.received_ns.saturating_add(self.realtime_offset_ns)
        } else {
            self.rx_software_ns
        }
    }
}
