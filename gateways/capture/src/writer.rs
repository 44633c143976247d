//! Writes pcapng with nanosecond stamps, as Wireshark opens it: a section, an interface block each,
//! packets with their direction, and statistics at the end. Little-endian; appends to a buffer that
//! the owner writes out. It decides nothing about which packets are kept.

use super::CaptureInterface;
use super::pcapng::{BYTE_ORDER_MAGIC, ENHANCED_PACKET, INTERFACE, SECTION, STATISTICS};
use hil_net::Direction;

const NANOSECONDS: u8 = 9;

/// Begins a file: who wrote it, and on what. All blocks go to the end of `out`.
pub fn begin(out: &mut Vec<u8>, application: &str, operating_system: &str) {
    block(out, SECTION, |body| {
        body.extend_from_slice(&BYTE_ORDER_MAGIC.to_le_bytes());
        body.extend_from_slice(&1_u16.to_le_bytes());
        body.extend_from_slice(&0_u16.to_le_bytes());
        // Length unknown: the file may be cut off at any time.
        body.extend_from_slice(&(-1_i64).to_le_bytes());
        option(body, 3, operating_system.as_bytes());
        option(body, 4, application.as_bytes());
        option(body, 0, &[]);
    });
}

/// Describes an interface; packets name it by its position among those described. `filter` is what
/// a packet had to be to be kept.
pub fn interface(out: &mut Vec<u8>, interface: &CaptureInterface, filter: &str) {
    block(out, INTERFACE, |body| {
        body.extend_from_slice(&interface.link_type.to_le_bytes());
        body.extend_from_slice(&0_u16.to_le_bytes());
        body.extend_from_slice(&interface.snap_bytes.to_le_bytes());
        if let Some(name) = &interface.name {
            option(body, 2, name.as_bytes());
        }
        if let Some(description) = &interface.description {
            option(body, 3, description.as_bytes());
        }
        option(body, 9, &[NANOSECONDS]);
        // 0: the filter is a text.
        let mut text = vec![0];
        text.extend_from_slice(filter.as_bytes());
        option(body, 11, &text);
        option(body, 0, &[]);
    });
}

/// One packet to write.
#[derive(Debug, Clone, Copy)]
pub struct PacketToWrite<'a> {
    /// Position of its interface among those described.
    pub interface_index: u32,
    /// Nanoseconds since 1970.
    pub stamp_ns: u64,
    /// Length on the wire.
    pub original_bytes: u32,
    /// Which way it went.
    pub direction: Direction,
    /// Its bytes in up to two pieces, the second following the first without a gap.
    pub data: [&'a [u8]; 2],
}

/// Appends a packet.
pub fn packet(out: &mut Vec<u8>, packet: &PacketToWrite<'_>) {
    let captured: usize = packet.data.iter().map(|piece| piece.len()).sum();
    block(out, ENHANCED_PACKET, |body| {
        body.extend_from_slice(&packet.interface_index.to_le_bytes());
        body.extend_from_slice(&halves(packet.stamp_ns));
        body.extend_from_slice(&length(captured).to_le_bytes());
        body.extend_from_slice(&packet.original_bytes.to_le_bytes());
        for piece in packet.data {
            body.extend_from_slice(piece);
        }
        pad(body, captured);
        let direction = match packet.direction {
            Direction::Unknown => return,
            Direction::Inbound => 1_u32,
            Direction::Outbound => 2,
        };
        option(body, 2, &direction.to_le_bytes());
        option(body, 0, &[]);
    });
}

/// What an interface saw between two times (nanoseconds since 1970). The counts are of packets that
/// passed the filter, and of those that found no room.
pub fn statistics(
    out: &mut Vec<u8>,
    interface_index: u32,
    from_ns: u64,
    to_ns: u64,
    received_count: u64,
    dropped_count: u64,
    comment: Option<&str>,
) {
    block(out, STATISTICS, |body| {
        body.extend_from_slice(&interface_index.to_le_bytes());
        body.extend_from_slice(&halves(to_ns));
        if let Some(comment) = comment {
            option(body, 1, comment.as_bytes());
        }
        option(body, 2, &halves(from_ns));
        option(body, 3, &halves(to_ns));
        option(body, 4, &received_count.to_le_bytes());
        option(body, 7, &dropped_count.to_le_bytes());
        option(body, 0, &[]);
    });
}

fn block(out: &mut Vec<u8>, kind: u32, fill: impl FnOnce(&mut Vec<u8>)) {
    let start = out.len();
    out.extend_from_slice(&kind.to_le_bytes());
    out.extend_from_slice(&[0; 4]);
    fill(out);
    let total = length(out.len() - start + 4).to_le_bytes();
    out[start + 4..start + 8].copy_from_slice(&total);
    out.extend_from_slice(&total);
}

fn option(body: &mut Vec<u8>, code: u16, value: &[u8]) {
    let kept = &value[..value.len().min(usize::from(u16::MAX))];
    body.extend_from_slice(&code.to_le_bytes());
    let value_bytes = u16::try_from(kept.len()).expect("cut to what fits");
    body.extend_from_slice(&value_bytes.to_le_bytes());
    body.extend_from_slice(kept);
    pad(body, kept.len());
}

fn pad(body: &mut Vec<u8>, length_bytes: usize) {
    body.extend_from_slice(&[0; 3][..length_bytes.next_multiple_of(4) - length_bytes]);
}

/// A stamp: the upper half comes first, whatever the byte order.
fn halves(units: u64) -> [u8; 8] {
    units.rotate_left(32).to_le_bytes()
}

fn length(bytes: usize) -> u32 {
    u32::try_from(bytes).expect("a packet is far below 4 GiB")
}
