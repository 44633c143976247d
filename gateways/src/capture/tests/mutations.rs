//! Every decoder on damaged input: 100 000 cases each, from a seed that a failure names.

use hil_models::random::RandomStream;

use super::super::flow::FlowFilter;
use super::super::observe::Observer;
use super::super::reader::{CaptureReader, Step};
use super::super::writer::{self, PacketToWrite};
use super::super::{CaptureInterface, esl, link};
use super::{message, read, udp_frame};
use crate::net::{Direction, link_type};

const CASE_COUNT: u64 = 100_000;
const SEED: u64 = 20_261_122;

fn index(random: &mut RandomStream, below: usize) -> usize {
    usize::try_from(random.next_u64() % below as u64).unwrap()
}

/// Flips, cuts or repeats some of the bytes.
fn mutate(bytes: &mut Vec<u8>, random: &mut RandomStream) {
    for _ in 0..=random.next_u64() % 4 {
        if bytes.is_empty() {
            return;
        }
        let at = index(random, bytes.len());
        match random.next_u64() % 5 {
            0 => bytes[at] = (random.next_u64() & 0xff) as u8,
            1 => bytes[at] ^= 1 << (random.next_u64() % 8),
            2 => bytes.truncate(at),
            3 => bytes.insert(at, 0xff),
            _ => {
                bytes.remove(at);
            }
        }
    }
}

fn sample_pcapng() -> Vec<u8> {
    let mut file = Vec::new();
    writer::begin(&mut file, "test", "none");
    for name in ["a", "b"] {
        let interface = CaptureInterface {
            name: Some(name.to_owned()),
            link_type: link_type::ETHERNET,
            ..CaptureInterface::default()
        };
        writer::interface(&mut file, &interface, "hil");
    }
    for sequence in 0..3 {
        let frame = udp_frame((1, 2), &message(sequence));
        let packet = PacketToWrite {
            interface_index: (sequence % 2) as u32,
            stamp_ns: 1_000_000 * sequence,
            original_bytes: 130,
            direction: Direction::Inbound,
            data: [&frame, &[]],
        };
        writer::packet(&mut file, &packet);
    }
    writer::statistics(&mut file, 1, (0, 9), (3, 0), None);
    file
}

fn sample_pcap() -> Vec<u8> {
    let mut file = vec![0xd4, 0xc3, 0xb2, 0xa1, 2, 0, 4, 0];
    file.extend([0; 12]);
    file.extend(1_u32.to_le_bytes());
    for sequence in 0..3 {
        let frame = udp_frame((1, 2), &message(sequence));
        let length = u32::try_from(frame.len()).unwrap();
        for word in [u32::try_from(sequence).unwrap(), 5, length, length] {
            file.extend(word.to_le_bytes());
        }
        file.extend(frame);
    }
    file
}

#[test]
fn mutated_captures_end_with_what_could_be_read_and_offsets_inside_the_file() {
    for (name, good) in [("pcapng", sample_pcapng()), ("pcap", sample_pcap())] {
        let mut random = RandomStream::new(SEED, name);
        for case in 0..CASE_COUNT {
            let mut file = good.clone();
            mutate(&mut file, &mut random);
            let (packets, faults, _) = read(&file, 97);
            let is_inside = |offset: u64| offset <= file.len() as u64;
            let is_sound = packets.iter().all(|one| is_inside(one.offset))
                && faults.iter().all(|one| is_inside(one.offset));
            assert!(is_sound, "{name}, seed {SEED}, case {case}: {faults:?}");
            assert!(packets.iter().map(|one| one.data.len()).sum::<usize>() <= file.len());
        }
    }
}

#[test]
fn mutated_frames_never_show_more_than_there_is() {
    let good = udp_frame((6510, 2), &message(1));
    let links = [
        link_type::ETHERNET,
        link_type::LINUX_SLL,
        link_type::LINUX_SLL2,
        link_type::RAW,
        link_type::IPV6,
        999,
    ];
    let mut random = RandomStream::new(SEED, "frames");
    for case in 0..CASE_COUNT {
        let mut frame = good.clone();
        if case % 3 == 0 {
            // The bytes of a bare packet, of either version.
            frame.drain(..14);
            frame[0] = if case % 2 == 0 { 0x45 } else { 0x60 };
        }
        mutate(&mut frame, &mut random);
        let link = links[index(&mut random, links.len())];
        if let Ok(datagram) = link::udp_datagram(link, &frame) {
            let is_sound = datagram.payload.len() <= datagram.payload_bytes
                && datagram.payload.len() < frame.len();
            assert!(is_sound, "seed {SEED}, case {case}");
        }
    }
}

#[test]
fn mutated_esl_headers_are_headers_or_nothing() {
    let header = esl::EslHeader {
        flags: esl::FLAG_BITS[3] | esl::STAMP_ENABLED,
        stamp_ns: 5,
    };
    let frame = udp_frame((1, 2), &message(1));
    let mut random = RandomStream::new(SEED, "esl");
    for case in 0..CASE_COUNT {
        let mut bytes = if case % 2 == 0 {
            [header.encode().to_vec(), frame.clone()].concat()
        } else {
            [frame.clone(), header.encode().to_vec()].concat()
        };
        mutate(&mut bytes, &mut random);
        if let Some((_, inner)) = esl::split(&bytes) {
            assert_eq!(
                inner.len() + esl::HEADER_BYTES,
                bytes.len(),
                "seed {SEED}, case {case}"
            );
        }
    }
}

#[test]
fn mutated_payloads_of_every_flow_are_counted_once() {
    let flows: Vec<FlowFilter> = [
        "hil",
        "egm:port=6510",
        "udp:port=7000,id=3+4le",
        "udp:port=7001",
    ]
    .iter()
    .map(|text| text.parse().unwrap())
    .collect();
    let egm = [10, 6, 8, 1, 16, 2, 24, 2];
    let mut random = RandomStream::new(SEED, "payloads");
    let mut observer = Observer::new(&flows);
    for case in 0..CASE_COUNT {
        let (port, mut payload) = match case % 4 {
            0 => (6510, egm.to_vec()),
            1 => (7000, message(case)),
            2 => (7001, message(case)),
            _ => (1, message(case)),
        };
        mutate(&mut payload, &mut random);
        let mut file = vec![0xd4, 0xc3, 0xb2, 0xa1, 2, 0, 4, 0];
        file.extend([0; 12]);
        file.extend(1_u32.to_le_bytes());
        let frame = udp_frame((port, 2), &payload);
        let kept = frame.len() - index(&mut random, 9).min(frame.len());
        for word in [
            1,
            5,
            u32::try_from(kept).unwrap(),
            u32::try_from(frame.len()).unwrap(),
        ] {
            file.extend(word.to_le_bytes());
        }
        file.extend(&frame[..kept]);
        let mut reader = CaptureReader::default();
        reader.feed(&file);
        let Step::Packet(packet) = reader.next_step() else {
            panic!("seed {SEED}, case {case}");
        };
        observer.take(0, &packet);
    }
    let counts = observer.counts();
    let parts = counts.followed_count
        + counts.other_flow_count
        + counts.foreign_count
        + counts.unidentified_count
        + counts.unreadable_count
        + counts.stampless_count;
    assert_eq!(
        (counts.packet_count, parts),
        (CASE_COUNT, CASE_COUNT),
        "{counts:?}"
    );
    assert!(counts.followed_count > CASE_COUNT / 4, "{counts:?}");
}
