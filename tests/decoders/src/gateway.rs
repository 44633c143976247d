//! Datagrams between gateways, their fragments, their frames in a TCP stream, and what the kernel
//! says beside them. Two gateways in conversation are in [`crate::bridges`].

use std::cell::RefCell;
use std::time::Duration;

use hil_core::time::Instant;
use hil_net::control::ControlData;
use hil_protocol::InMemory;
use hil_protocol::fragment::{FragmentPlan, Reassembler};
use hil_protocol::ingress::Piece;
use hil_protocol::wire::{Body, Datagram, HEADER_BYTES, Header, Kind, decode};
use hil_transport::tcp::frame::{DATAGRAM_BYTES_MAX, FrameReader, PREFIX_BYTES, prefix};

use crate::Verdict;
use crate::input::Input;

/// Where the number of an earlier datagram stands, which means nothing without a stamp.
const FOLLOW_UP_AT: std::ops::Range<usize> = 48..52;

/// What is accepted is exactly what an encoder writes, and any other length of it is refused.
pub(crate) fn datagram(bytes: &[u8]) -> Verdict {
    let Ok(datagram) = decode(bytes) else {
        return Verdict::Refused;
    };
    let again = encode(&datagram, bytes.len());
    let mut canonical = bytes.to_vec();
    if datagram.header.follow_up.is_none() {
        canonical[FOLLOW_UP_AT].fill(0);
    }
    assert_eq!(again, canonical, "an accepted datagram is not canonical");
    assert_eq!(decode(&again), Ok(datagram));
    let shorter = &bytes[..bytes.len() - 1];
    assert!(decode(shorter).is_err(), "its last byte is not needed");
    canonical.push(0);
    assert!(decode(&canonical).is_err(), "a byte too many is accepted");
    Verdict::Accepted
}

/// The bytes of `datagram`, which are `length` in all.
pub(crate) fn encode(datagram: &Datagram<'_>, length: usize) -> Vec<u8> {
    let mut bytes = vec![0; length];
    datagram.header.encode(&mut bytes);
    let body = &mut bytes[HEADER_BYTES..];
    let body_bytes = body.len();
    let written_bytes = match datagram.body {
        Body::Data(payload) => {
            body.copy_from_slice(payload);
            payload.len()
        }
        // Its body is as it was made: zeros.
        Body::SyncRequest => body_bytes,
        Body::SyncResponse(response) => response.encode(body),
        // Zeros may follow it.
        Body::Hello(hello) => hello.encode(body).max(body_bytes),
        Body::HelloAck(answer) => answer.encode(body),
        Body::PieceAck(ack) => ack.encode(body),
        Body::Bye => 0,
    };
    assert_eq!(written_bytes, body_bytes, "bytes behind the body");
    bytes
}

const SLOT_COUNT: usize = 3;
const MESSAGE_BYTES_MAX: usize = 2000;

/// What comes out is the message that went in, whatever order, copies and gaps its pieces had, and
/// every message that was begun is completed, given up or open.
pub(crate) fn reassembly(bytes: &[u8]) -> Verdict {
    let mut input = Input::new(bytes);
    let mut reassembler =
        Reassembler::new(0, SLOT_COUNT, MESSAGE_BYTES_MAX, Duration::from_micros(100));
    let mut memory = InMemory::default();
    let mut now = Instant::from_ns(0);
    let mut storage = Vec::with_capacity(MESSAGE_BYTES_MAX);
    let mut completed_count = 0;
    while !input.is_empty() {
        let head = input.byte();
        let (index, count) = (u16::from(input.byte()), u16::from(input.byte()));
        let total_bytes = usize::from(input.short()) % (MESSAGE_BYTES_MAX + 10);
        now = now + Duration::from_micros(u64::from(head >> 4));
        let (epoch, sequence) = (u32::from(head & 1), u64::from(head >> 1 & 3));
        let total_len = u32::try_from(total_bytes).unwrap_or(u32::MAX);
        let range = FragmentPlan::from_wire(total_len, count).and_then(|plan| plan.range(index));
        let range = range.unwrap_or(0..usize::from(index));
        storage.clear();
        storage.extend(range.map(|at| pattern(epoch, sequence, total_bytes, at)));
        if head & 8 != 0 {
            // A piece of another length than its place has.
            storage.pop();
        }
        let header = Header {
            sequence,
            total_len,
            fragment_index: index,
            fragment_count: count,
            handed_ns: i64::from(index),
            epoch,
            ..Header::new(Kind::Data, 1, 0)
        };
        if let Ok(place) = reassembler.place(now, &header, storage.len()) {
            let slot = place.slot;
            memory.store(&Piece {
                channel: 0,
                slot,
                is_first: place.is_first,
                offset_bytes: place.offset_bytes,
                payload: &storage,
            });
            if let Some(whole) = reassembler.stored(place) {
                completed_count += 1;
                assert_eq!(whole.length_bytes, total_bytes);
                let expected = (0..total_bytes).map(|at| pattern(epoch, sequence, total_bytes, at));
                let bytes = memory.message(0, slot).iter();
                assert!(bytes.copied().eq(expected), "mixed pieces");
                assert_eq!(
                    whole.message.handed.as_ns(),
                    0,
                    "not the stamp of the first piece"
                );
            }
        }
        assert!(reassembler.open_count() <= SLOT_COUNT);
    }
    let counts = *reassembler.counts();
    assert_eq!(counts.completed_count, completed_count);
    let settled = counts.completed_count + counts.evicted_count + counts.timed_out_count;
    assert_eq!(
        counts.started_count,
        settled + reassembler.open_count() as u64
    );
    Verdict::of(completed_count > 0)
}

/// The byte at `at` of a message that is like no other.
fn pattern(epoch: u32, sequence: u64, total_bytes: usize, at: usize) -> u8 {
    let key = u64::from(epoch) << 60 ^ sequence << 50 ^ (total_bytes as u64) << 20 ^ at as u64;
    key.wrapping_mul(0x9e37_79b9_7f4a_7c15).to_be_bytes()[0]
}

/// However the stream is cut into portions, its datagrams are those of the whole, and a length that
/// cannot be ends it for good.
pub(crate) fn tcp_stream(bytes: &[u8]) -> Verdict {
    thread_local! {
        /// Two of the longest frames: not to be set aside for every input.
        static READER: RefCell<FrameReader> = RefCell::default();
    }
    let mut input = Input::new(bytes);
    let portion = 1 + usize::from(input.byte());
    let stream = input.rest();
    let (expected, is_broken) = plain_frames(stream);
    READER.with_borrow_mut(|reader| {
        reader.clear();
        let mut found = 0;
        let mut has_failed = false;
        for part in stream.chunks(portion) {
            let room = reader.room();
            room[..part.len()].copy_from_slice(part);
            reader.filled(part.len());
            loop {
                match reader.next_datagram() {
                    Ok(Some(datagram)) => {
                        assert_eq!(Some(&datagram), expected.get(found), "datagram {found}");
                        found += 1;
                    }
                    Ok(None) => break,
                    Err(fault) => {
                        assert!(fault.length_bytes as usize > DATAGRAM_BYTES_MAX);
                        has_failed = true;
                        break;
                    }
                }
            }
            if has_failed {
                break;
            }
        }
        assert_eq!((found, has_failed), (expected.len(), is_broken));
        Verdict::of(found > 0)
    })
}

/// The frames of a stream, read in the plainest way there is, and whether it ends in a bad length.
fn plain_frames(mut stream: &[u8]) -> (Vec<&[u8]>, bool) {
    let mut found = Vec::new();
    while let Some((head, rest)) = stream.split_first_chunk::<PREFIX_BYTES>() {
        let length = u32::from_le_bytes(*head) as usize;
        if length > DATAGRAM_BYTES_MAX {
            assert_eq!(prefix(length), None);
            return (found, true);
        }
        assert_eq!(prefix(length), Some(*head));
        let Some((datagram, rest)) = rest.split_at_checked(length) else {
            break;
        };
        found.push(datagram);
        stream = rest;
    }
    (found, false)
}

/// Reading has no memory, and cutting the end off never adds anything but the word "damaged".
pub(crate) fn control_messages(bytes: &[u8]) -> Verdict {
    let data = ControlData::decode(bytes);
    assert_eq!(ControlData::decode(bytes), data);
    let is_told = data.stamps != hil_net::KernelStamps::default()
        || data.drop_count.is_some()
        || data.extended_error.is_some()
        || data.is_acknowledged.is_some()
        || data.traffic_class.is_some();
    if let Some(shorter) = bytes.len().checked_sub(1) {
        let cut = ControlData::decode(&bytes[..shorter]);
        let grew = [
            cut.drop_count.is_some() && data.drop_count.is_none() && !data.is_damaged,
            cut.extended_error.is_some() && data.extended_error.is_none() && !data.is_damaged,
        ];
        assert_eq!(grew, [false; 2], "less told more");
    }
    if let Some(error) = data.extended_error {
        // Whatever the kernel says, it is sorted.
        let _entry = error.entry();
    }
    Verdict::of(is_told)
}
