//! Tests of the capture decoders: files made byte by byte and figures of flows
//! whose truth is known.

mod carried;
mod cases;
mod containers;
mod frames;
mod joins;
mod limits;
mod programs;

use super::reader::{CaptureReader, Step};
use super::{CaptureFault, CaptureInterface};
use hil_net::Direction;
use hil_protocol::wire::{HEADER_BYTES, Header, Kind};

/// A packet of a file, owned.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Packet {
    offset: u64,
    interface_index: usize,
    stamp_ns: Option<i64>,
    original_bytes: u32,
    is_nic_stamped: bool,
    direction: Direction,
    data: Vec<u8>,
}

/// Reads a whole file fed in pieces of `piece_bytes`.
fn read(
    file: &[u8],
    piece_bytes: usize,
) -> (Vec<Packet>, Vec<CaptureFault>, Vec<CaptureInterface>) {
    let mut reader = CaptureReader::default();
    let (mut packets, mut faults) = (Vec::new(), Vec::new());
    let mut pieces = file.chunks(piece_bytes.max(1));
    loop {
        match reader.next_step() {
            Step::Packet(packet) => packets.push(Packet {
                offset: packet.offset,
                interface_index: packet.interface_index,
                stamp_ns: packet.stamp_ns,
                original_bytes: packet.original_bytes,
                is_nic_stamped: packet.is_nic_stamped,
                direction: packet.direction,
                data: packet.data.to_vec(),
            }),
            Step::NeedsMore => match pieces.next() {
                Some(piece) => reader.feed(piece),
                None => reader.end(),
            },
            Step::Fault(fault) => faults.push(fault),
            Step::Ended => break,
        }
    }
    let interfaces = reader.interfaces().to_vec();
    (packets, faults, interfaces)
}

/// An Ethernet frame with a UDP datagram over IPv4 from 10.77.0.1 to 10.77.0.2.
fn udp_frame(source_port: u16, destination_port: u16, payload: &[u8]) -> Vec<u8> {
    let udp_bytes = u16::try_from(8 + payload.len()).unwrap();
    let mut frame = vec![2, 0, 0, 0, 0, 2, 2, 0, 0, 0, 0, 1, 0x08, 0x00];
    frame.extend([0x45, 0xb8]);
    frame.extend((20 + udp_bytes).to_be_bytes());
    frame.extend([0, 1, 0x40, 0, 64, 17, 0, 0]);
    frame.extend([10, 77, 0, 1, 10, 77, 0, 2]);
    frame.extend(source_port.to_be_bytes());
    frame.extend(destination_port.to_be_bytes());
    frame.extend(udp_bytes.to_be_bytes());
    frame.extend([0, 0]);
    frame.extend(payload);
    frame
}

/// A message of ours.
fn message(sequence: u64) -> Vec<u8> {
    let mut header = Header::new(Kind::Data, 0x51, 3);
    header.sequence = sequence;
    header.total_len = 8;
    header.handed_ns = 1_000 * sequence.cast_signed();
    let mut bytes = vec![0; HEADER_BYTES + 8];
    header.encode(&mut bytes);
    bytes
}
