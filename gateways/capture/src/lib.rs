//! A second opinion on the wire: captures of packets read and written, and what they say of a
//! flow seen at two points. Bytes go in and figures come out; no file is opened, no socket, and no
//! clock is read. The live tap is [`hil_net::packet_ring`].
//!
//! ```text
//! file bytes -> CaptureReader -> packet -> esl -> link -> flow -> Observation, Watch
//!                                                                    |
//!                              point::single_point_metrics <--- per stream ---> pairing::join_all
//! ```
#![forbid(unsafe_code)]

mod bytes;
pub mod esl;
pub mod flow;
pub mod join;
mod kept;
pub mod link;
pub mod observe;
pub mod pairing;
mod pcap;
mod pcapng;
mod pieces;
pub mod point;
pub mod reader;
pub mod watch;
pub mod writer;

#[cfg(test)]
mod tests;

use thiserror::Error;

use hil_net::Direction;

/// How the description of an interface begins whose packets have the card's stamps.
pub const CARD_CLOCK: &str = "stamps of the network card's own clock";

/// A time on a point's clock, nanoseconds since 1970, both ends included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Span {
    /// When it begins.
    pub first_ns: i64,
    /// When it ends.
    pub last_ns: i64,
}

impl Span {
    /// From the earlier beginning to the later end.
    pub(crate) fn hull(self, other: Self) -> Self {
        Self {
            first_ns: self.first_ns.min(other.first_ns),
            last_ns: self.last_ns.max(other.last_ns),
        }
    }
}

/// An interface that packets were captured on.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct CaptureInterface {
    /// Its name, when the file has one.
    pub name: Option<String>,
    /// What the file says of it; see [`CARD_CLOCK`].
    pub description: Option<String>,
    /// See [`hil_net::link_type`].
    pub link_type: u16,
    /// Bytes kept of a packet; 0 without limit.
    pub snap_bytes: u32,
    /// Nanoseconds to one unit of its stamps, as numerator and denominator.
    pub unit_ns: (u64, u64),
    /// What to add to its stamps, nanoseconds.
    pub offset_ns: i64,
    /// What a packet had to be to be kept, in words; `None` when the file does not say.
    pub filter: Option<String>,
    /// When it was watched, as its statistics state it: taken in its own unit, and in microseconds.
    /// Wireshark and dumpcap write microseconds whatever the unit; which was meant, the packets tell.
    pub watch: [Option<Span>; 2],
    /// The interface of an earlier section that this one describes again: rotated or joined files.
    pub repeats: Option<usize>,
    /// Its file was put together from several, maybe of several hosts: it shares no clock with the others.
    pub is_merged: bool,
    /// Packets it says it received.
    pub received_count: Option<u64>,
    /// Packets it says were dropped for want of room, by the system or by the interface.
    pub dropped_count: Option<u64>,
}

impl CaptureInterface {
    /// Its stamps are of the network card, on a clock of its own: no other interface's compare
    /// with them.
    pub fn has_nic_clock(&self) -> bool {
        let description = self.description.as_deref();
        description.is_some_and(|text| text.starts_with(CARD_CLOCK))
    }
}

/// One packet of a capture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CapturedPacket<'a> {
    /// Where its record or block begins in the file.
    pub offset: u64,
    /// Which of [`reader::CaptureReader::interfaces`].
    pub interface_index: usize,
    /// Number of the interface on its host, where the record says it.
    pub interface_number: Option<u32>,
    /// That interface's [`hil_net::link_type`].
    pub link_type: u16,
    /// Nanoseconds since 1970, on the clock of the capturing host; `None` in a simple packet
    /// block, which has none, and where the fraction of a second is two seconds or more.
    pub stamp_ns: Option<i64>,
    /// Length on the wire; more than `data` when the packet was cut short.
    pub original_bytes: u32,
    /// Its check sequence or shape was wrong when it was captured, as the file says.
    pub is_damaged: bool,
    /// Its stamp is of the network card; see [`CaptureInterface::has_nic_clock`].
    pub is_nic_stamped: bool,
    /// Which way it went.
    pub direction: Direction,
    /// What was kept of it, from the link layer on.
    pub data: &'a [u8],
}

/// What is wrong with a capture, and where. What came before it stays good.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("byte {offset}: {problem}")]
pub struct CaptureFault {
    /// Offset in the file of the record or block concerned.
    pub offset: u64,
    /// What is wrong with it.
    pub problem: Problem,
    /// True when reading goes on behind it: only pcapng blocks with sound lengths allow that.
    pub is_passed: bool,
}

/// Faults of a capture file.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum Problem {
    /// Not one of the formats.
    #[error("not a capture: begins with {0:02x?}, neither pcap nor pcapng")]
    Foreign([u8; 4]),
    /// No bytes at all.
    #[error("the file is empty")]
    Empty,
    /// The file ends within a record or block.
    #[error("cut short: {available_bytes} of {expected_bytes} bytes of {what} are there")]
    Truncated {
        /// Of what.
        what: &'static str,
        /// How many are there.
        available_bytes: u64,
        /// How many there should be.
        expected_bytes: u64,
    },
    /// A version nobody reads.
    #[error("version {major}.{minor} is not supported; pcap 2.4 and pcapng 1.x are")]
    Version {
        /// Major.
        major: u16,
        /// Minor.
        minor: u16,
    },
    /// A length that cannot be.
    #[error("{what} is {length}, outside {min} to {max}")]
    Length {
        /// Which length.
        what: &'static str,
        /// Its value.
        length: u64,
        /// Smallest allowed.
        min: u64,
        /// Largest allowed.
        max: u64,
    },
    /// The second length of a pcapng block is not the first.
    #[error("block lengths differ: {first} before, {second} after")]
    LengthsDiffer {
        /// Before the body.
        first: u32,
        /// After it.
        second: u32,
    },
    /// A packet of an interface that was not described.
    #[error("packet of interface {index}, but the section has described {count}")]
    UnknownInterface {
        /// Its number in the section.
        index: u32,
        /// Interfaces described so far.
        count: usize,
    },
    /// A stamp beyond what 64 bits of nanoseconds hold.
    #[error("time stamp {units} does not fit into nanoseconds since 1970")]
    Stamp {
        /// In the interface's units.
        units: u64,
    },
    /// Anything else that is wrong with a block's body.
    #[error("{0}")]
    Malformed(&'static str),
}
