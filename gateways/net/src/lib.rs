//! The border to the kernel's network: what sockets and cards stamp, which clocks those stamps are of,
//! and the ring of packets that a tap looks into. All `unsafe` of the network is here. It knows no
//! datagram layout, no transport and no capture file.
//!
//! - [`timestamping`], [`control`] and [`reply_stamps`]: what the kernel and the card can stamp, and the
//!   messages that bring the stamps.
//! - [`nic_arming`] and [`nic_clock`]: setting a card up to stamp, and reading its clock.
//! - [`clock_pair`]: from the real-time clock of the stamps to the monotonic clock of the run.
//! - [`radio`]: whether the peer radio acknowledged each datagram.
//! - [`packet_ring`], [`ring_frame`] and [`filter`]: a tap of an interface, and the end of a cable.
//! - [`offload`]: what an interface leaves to hardware.
//! - [`handover`]: descriptors from one process to another.
//! - [`tcp_info`]: what the kernel tells of a TCP connection.
//! - [`mod@interface`]: which interface has an address.

pub mod clock_pair;
pub mod control;
pub mod filter;
pub mod handover;
pub mod interface;
pub mod nic_arming;
pub mod nic_clock;
pub mod offload;
pub mod packet_ring;
mod packet_socket;
pub mod radio;
pub mod reply_stamps;
pub mod ring_frame;
pub mod tcp_info;
pub mod timestamping;

/// The stamps the kernel attached to one datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct KernelStamps {
    /// Taken by the kernel, in nanoseconds of this host's `CLOCK_REALTIME`; `None` when the
    /// kernel gave none. [`clock_pair`] relates it to the monotonic clock.
    pub software_ns: Option<i64>,
    /// Taken by the network card, in nanoseconds of the card's own clock; `None` when the card
    /// gave none.
    pub hardware_ns: Option<i64>,
}

/// Names one successful send of one sender: 0, 1, 2, … modulo 2^32. A refused send takes none,
/// as the kernel's own counter (`SOF_TIMESTAMPING_OPT_ID`) does not advance then either.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct TxToken(pub u32);

/// Where on its way out a datagram was when the kernel stamped it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TransmitStage {
    /// Before the queueing discipline (`SCM_TSTAMP_SCHED`).
    Scheduled,
    /// After it: by the driver just before the card took it, or by the card (`SCM_TSTAMP_SND`).
    Sent,
}

/// A transmit stamp. One datagram may yield several: per stage, and software and hardware apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TransmitStamp {
    /// Which send it belongs to.
    pub token: TxToken,
    /// Where it was taken.
    pub stage: TransmitStage,
    /// The stamps.
    pub stamps: KernelStamps,
}

/// Numbers of `https://www.tcpdump.org/linktypes.html` that a capture may have.
pub mod link_type {
    /// BSD loopback: the address family in the capturing host's byte order.
    pub const NULL: u16 = 0;
    /// Ethernet.
    pub const ETHERNET: u16 = 1;
    /// PPP, with or without address and control bytes.
    pub const PPP: u16 = 9;
    /// [`RAW`] as some systems number it.
    pub const RAW_12: u16 = 12;
    /// [`RAW`] as OpenBSD numbers it.
    pub const RAW_14: u16 = 14;
    /// PPP in HDLC-like framing.
    pub const PPP_SERIAL: u16 = 50;
    /// A `PPPoE` session without the Ethernet header.
    pub const PPP_ETHER: u16 = 51;
    /// IPv4 or IPv6 without anything before it.
    pub const RAW: u16 = 101;
    /// 802.11 without radio information.
    pub const IEEE802_11: u16 = 105;
    /// OpenBSD loopback: the address family in network byte order.
    pub const LOOP: u16 = 108;
    /// 802.11 behind a radiotap header.
    pub const RADIOTAP: u16 = 127;
    /// Linux cooked capture, version 1.
    pub const LINUX_SLL: u16 = 113;
    /// IPv4.
    pub const IPV4: u16 = 228;
    /// IPv6.
    pub const IPV6: u16 = 229;
    /// Linux cooked capture, version 2.
    pub const LINUX_SLL2: u16 = 276;
}

hil_core::labelled! {
    /// Which way a packet passed its interface.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
    pub enum Direction, label {
        /// The capture does not say.
        #[default]
        Unknown = "unknown",
        /// It came in.
        Inbound = "in",
        /// It went out.
        Outbound = "out",
    }
}
