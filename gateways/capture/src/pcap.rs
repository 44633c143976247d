//! The pcap file: a header of 24 bytes, then records of 16 bytes and the packet
//! (draft-ietf-opsawg-pcap), or of 24 bytes in the modified format of old Linux distributions. It has one interface, no names and no way back after a broken length.

use super::bytes::{ByteOrder, Numbers};
use super::reader::{Found, Next, Window};
use super::{CaptureInterface, Problem};
use hil_net::Direction;

/// Largest record taken for one: the largest that libpcap writes.
const CAPTURED_BYTES_MAX: u32 = 262_144;
const RECORD_HEADER_BYTES: usize = 16;
/// The same of the modified format: interface number, protocol and packet type more.
const MODIFIED_HEADER_BYTES: usize = 24;

/// What the magic number told.
#[derive(Debug)]
pub(super) struct PcapFile {
    pub(super) order: ByteOrder,
    /// Nanoseconds to one unit of a stamp's fraction.
    pub(super) fraction_ns: i64,
    /// Its records say on which interface and which way (Kuznetsov's libpcap).
    pub(super) is_modified: bool,
}

impl PcapFile {
    pub(super) const HEADER_BYTES: u64 = 24;

    fn numbers<'a>(&self, window: &'a Window) -> Numbers<'a> {
        let (order, bytes) = (self.order, window.bytes());
        Numbers { order, bytes }
    }

    /// The interface of the file header; `Ok(None)` while it is not all there.
    pub(super) fn header(&self, window: &Window) -> Result<Option<CaptureInterface>, Problem> {
        let bytes = self.numbers(window);
        let (Some(major), Some(minor), Some(snap_bytes), Some(network)) =
            (bytes.u16(4), bytes.u16(6), bytes.u32(16), bytes.u32(20))
        else {
            let missing = window.missing("the file header", Self::HEADER_BYTES);
            return missing.map_or(Ok(None), Err);
        };
        if (major, minor) != (2, 4) {
            return Err(Problem::Version { major, minor });
        }
        Ok(Some(CaptureInterface {
            // The upper bits tell of frame check sequences.
            link_type: (network & 0xffff) as u16,
            snap_bytes,
            unit_ns: (self.fraction_ns.unsigned_abs(), 1),
            ..CaptureInterface::default()
        }))
    }

    pub(super) fn next(&self, window: &Window) -> Next {
        let bytes = self.numbers(window);
        if bytes.bytes.is_empty() {
            return Next::NeedsMore;
        }
        let (Some(seconds), Some(fraction), Some(captured), Some(original_bytes)) =
            (bytes.u32(0), bytes.u32(4), bytes.u32(8), bytes.u32(12))
        else {
            return window.needs("a record header", RECORD_HEADER_BYTES as u64);
        };
        let header_bytes = if self.is_modified {
            MODIFIED_HEADER_BYTES
        } else {
            RECORD_HEADER_BYTES
        };
        if captured > CAPTURED_BYTES_MAX {
            let problem = Problem::Length {
                what: "a record's captured length",
                length: captured.into(),
                min: 0,
                max: CAPTURED_BYTES_MAX.into(),
            };
            return Next::Fault(problem, None);
        }
        let end = header_bytes + captured as usize;
        if bytes.bytes.len() < end {
            return window.needs("a record", end as u64);
        }
        let (mut interface_number, mut direction) = (None, Direction::Unknown);
        if self.is_modified {
            interface_number = bytes.u32(16);
            direction = match bytes.bytes[22] {
                0..=3 => Direction::Inbound,
                4 => Direction::Outbound,
                _ => Direction::Unknown,
            };
        }
        // Some writers round up to a whole second without carrying it; more than that is no fraction.
        let fraction_ns = i64::from(fraction) * self.fraction_ns;
        let stamp_ns = i64::from(seconds) * 1_000_000_000 + fraction_ns;
        let found = Found {
            interface_index: 0,
            interface_number,
            stamp_ns: (fraction_ns < 2_000_000_000).then_some(stamp_ns),
            original_bytes,
            direction,
            is_damaged: false,
            data: header_bytes..end,
        };
        Next::Packet(found, end as u64)
    }
}
