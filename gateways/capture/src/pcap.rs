//! The pcap file: a header of 24 bytes, then records of 16 bytes and the packet
//! (draft-ietf-opsawg-pcap). It has one interface, no names and no way back after a broken length.

use super::bytes::ByteOrder;
use super::reader::{Found, Next, Window};
use super::{CaptureInterface, Problem};
use hil_net::Direction;

/// Largest record taken for one: the largest that libpcap writes.
const CAPTURED_BYTES_MAX: u32 = 262_144;
const RECORD_HEADER_BYTES: usize = 16;

/// What the magic number told.
#[derive(Debug)]
pub(super) struct PcapFile {
    order: ByteOrder,
    fraction_ns: i64,
}

impl PcapFile {
    pub(super) const HEADER_BYTES: u64 = 24;

    pub(super) const fn new(order: ByteOrder, fraction_ns: i64) -> Self {
        Self { order, fraction_ns }
    }

    /// The interface of the file header; `Ok(None)` while it is not all there.
    pub(super) fn header(&self, window: &Window) -> Result<Option<CaptureInterface>, Problem> {
        let bytes = window.bytes();
        let fields = (
            self.order.u16(bytes, 4),
            self.order.u16(bytes, 6),
            self.order.u32(bytes, 16),
            self.order.u32(bytes, 20),
        );
        let (Some(major), Some(minor), Some(snap_bytes), Some(network)) = fields else {
            if !window.is_complete() {
                return Ok(None);
            }
            return Err(Problem::Truncated {
                what: "the file header",
                available_bytes: bytes.len() as u64,
                expected_bytes: Self::HEADER_BYTES,
            });
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
        let bytes = window.bytes();
        if bytes.is_empty() {
            return Next::NeedsMore;
        }
        let fields = (
            self.order.u32(bytes, 0),
            self.order.u32(bytes, 4),
            self.order.u32(bytes, 8),
            self.order.u32(bytes, 12),
        );
        let (Some(seconds), Some(fraction), Some(captured), Some(original_bytes)) = fields else {
            return missing(window, "a record header", RECORD_HEADER_BYTES as u64);
        };
        if captured > CAPTURED_BYTES_MAX {
            return Next::Fault(
                Problem::Length {
                    what: "a record's captured length",
                    length: captured.into(),
                    min: 0,
                    max: CAPTURED_BYTES_MAX.into(),
                },
                None,
            );
        }
        let fraction_ns = i64::from(fraction) * self.fraction_ns;
        if fraction_ns >= 1_000_000_000 {
            return Next::Fault(
                Problem::Malformed("a stamp's fraction is a second or more"),
                None,
            );
        }
        let end = RECORD_HEADER_BYTES + captured as usize;
        if bytes.len() < end {
            return missing(window, "a record", end as u64);
        }
        Next::Packet(Found {
            offset: window.offset(),
            interface_index: 0,
            stamp_ns: Some(i64::from(seconds) * 1_000_000_000 + fraction_ns),
            original_bytes,
            direction: Direction::Unknown,
            data: (RECORD_HEADER_BYTES, end),
            record_bytes: end as u64,
        })
    }
}

/// More is needed, or, when there is no more, what is missing.
pub(super) fn missing(window: &Window, what: &'static str, expected_bytes: u64) -> Next {
    if !window.is_complete() {
        return Next::NeedsMore;
    }
    Next::Fault(
        Problem::Truncated {
            what,
            available_bytes: window.bytes().len() as u64,
            expected_bytes,
        },
        None,
    )
}
