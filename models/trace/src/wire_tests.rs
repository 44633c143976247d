//! The binary form both ways: golden bytes, damage of every kind with its offset, and mutations.

use super::*;
use hil_core::random::RandomStream;

fn sample() -> Trace {
    let mut header = TraceHeader::new("shuttle/command");
    header.run = "shuttle-20261122-101500".to_owned();
    header.link = "hop".to_owned();
    header.clock = "one clock".to_owned();
    header.direction = TraceDirection::Forward;
    header.arrival = TraceArrival::Received;
    header.origin_ns = 77_000_000_000;
    header.duration_ns = 40_000_000;
    let at = |index: i64| TraceRecord::published(index * 10_000_000, index.unsigned_abs(), 16);
    let mut records = vec![
        at(0).delivered(2_000_123, 0),
        at(1),
        at(2).delivered(1_500_000, 40),
        at(3),
    ];
    records[0].departure_ns = 70_000;
    records[1].fate = TraceFate::LostInNetwork;
    records[1].flags = TraceRecord::EMULATED;
    records[2].second_delay_ns = 1_900_000;
    records[2].flags = TraceRecord::REORDERED;
    records[3].fate = TraceFate::LostBeforeLink;
    records[3].flags = TraceRecord::REFUSED;
    records[3].start = 1;
    Trace { header, records }
}

fn bytes() -> Vec<u8> {
    encode(&sample()).unwrap()
}

/// The same bytes with the check sum of record `index` set right again.
fn resealed(mut bytes: Vec<u8>, index: usize) -> Vec<u8> {
    let start = HEADER_BYTES + index * RECORD_BYTES;
    let sum = crc32(&bytes[start..start + RECORD_SUM_AT]);
    put(&mut bytes, start + RECORD_SUM_AT, &sum.to_le_bytes());
    bytes
}

fn fault_of(bytes: &[u8]) -> (usize, u64, FaultKind) {
    let decoded = decode(bytes).unwrap();
    let fault = decoded.fault.unwrap();
    (decoded.trace.records.len(), fault.offset, fault.what)
}

#[test]
fn the_layout_is_the_documented_one() {
    assert_eq!(
        crc32(b"123456789"),
        0xcbf4_3926,
        "the published check value"
    );
    let bytes = bytes();
    assert_eq!(bytes.len(), 384 + 4 * 64);
    assert_eq!(&bytes[..8], b"HILTRACE");
    assert_eq!(bytes[8..20], [1, 0, 0, 0, 0x80, 1, 0, 0, 64, 0, 0, 0]);
    assert_eq!(bytes[20..24], [1, 1, 0, 0]);
    assert_eq!(bytes[24..32], 4_u64.to_le_bytes());
    assert_eq!(bytes[32..40], 77_000_000_000_i64.to_le_bytes());
    assert_eq!(bytes[40..48], 40_000_000_i64.to_le_bytes());
    assert_eq!(&bytes[56..80], b"shuttle-20261122-101500\0");
    assert_eq!(&bytes[152..168], b"shuttle/command\0");
    assert_eq!(&bytes[248..252], b"hop\0");
    assert_eq!(&bytes[312..322], b"one clock\0");
    assert_eq!(bytes[380..384], crc32(&bytes[..380]).to_le_bytes());
    let third = &bytes[384 + 2 * 64..][..64];
    let golden: [&[u8]; 7] = [
        &20_000_000_i64.to_le_bytes(),
        &20_000_000_i64.to_le_bytes(),
        &[0x60, 0xe3, 0x16, 0, 0, 0, 0, 0],
        &[40, 0, 0, 0, 0, 0, 0, 0],
        &[0xe0, 0xfd, 0x1c, 0, 0, 0, 0, 0],
        &[2, 0, 0, 0, 0, 0, 0, 0],
        &[16, 0, 0, 0, 0, 0, 1, 1, 2, 0, 0, 0],
    ];
    assert_eq!(third[..60], golden.concat());
    assert_eq!(third[60..], crc32(&third[..60]).to_le_bytes());
}

#[test]
fn a_trace_comes_back_whole() {
    let (trace, bytes) = (sample(), bytes());
    let read = decode(&bytes).unwrap();
    assert_eq!((read.trace, read.fault), (trace.clone(), None));
    let empty = Trace {
        records: Vec::new(),
        ..trace
    };
    let read = decode(&encode(&empty).unwrap()).unwrap();
    assert_eq!((read.trace, read.fault), (empty, None));
}

#[test]
fn what_is_truncated_says_where_and_keeps_the_rest() {
    let bytes = bytes();
    let truncated = |found, expected, unit| FaultKind::Truncated {
        found,
        expected,
        unit,
    };
    assert_eq!(
        fault_of(&bytes[..bytes.len() - 1]),
        (3, 576, truncated(3, 4, "records"))
    );
    assert_eq!(
        fault_of(&bytes[..448]),
        (1, 448, truncated(1, 4, "records"))
    );
    let header = decode(&bytes[..100]).unwrap_err();
    assert_eq!(header.what, truncated(100, 384, "bytes of the header"));
    let nothing = decode(&[]).unwrap_err();
    assert_eq!(nothing.what, truncated(0, 384, "bytes of the header"));
    let long = [bytes.as_slice(), b"xyz"].concat();
    assert_eq!(fault_of(&long), (4, 640, FaultKind::Trailing { count: 3 }));
}

#[test]
fn what_is_reordered_or_corrupt_says_where_and_keeps_the_rest() {
    let mut swapped = bytes();
    let third = swapped[512..576].to_vec();
    swapped.copy_within(448..512, 512);
    swapped[448..512].copy_from_slice(&third);
    let (found, expected) = (2, 1);
    let misplaced = FaultKind::Place { found, expected };
    assert_eq!(fault_of(&swapped), (1, 448 + 56, misplaced));
    let mut flipped = bytes();
    flipped[512 + 17] ^= 4;
    let (kept, offset, what) = fault_of(&flipped);
    assert_eq!((kept, offset), (2, 512));
    assert!(matches!(what, FaultKind::CheckSum { part: "record", .. }));
    let mut earlier = bytes();
    put(&mut earlier, 512, &9_999_999_i64.to_le_bytes());
    let what = FaultKind::Order {
        published_ns: 9_999_999,
        before_ns: 10_000_000,
    };
    assert_eq!(fault_of(&resealed(earlier, 2)), (2, 512, what));
    for (at, byte, field) in [(54, 9, "fate"), (55, 128, "flags"), (16, 1, "delay_ns")] {
        let mut wrong = bytes();
        wrong[448 + at] = byte;
        let (kept, _, what) = fault_of(&resealed(wrong, 1));
        assert_eq!(kept, 1);
        assert!(matches!(what, FaultKind::Field { field: named, .. } if named == field));
    }
}

#[test]
fn what_is_foreign_is_called_so() {
    let refused = |bytes: &[u8]| decode(bytes).unwrap_err();
    let pcap = [0xd4, 0xc3, 0xb2, 0xa1].repeat(100);
    assert!(matches!(refused(&pcap).what, FaultKind::Foreign { .. }));
    assert!(matches!(refused(b"hello").what, FaultKind::Foreign { .. }));
    let mut newer = bytes();
    newer[8] = 2;
    let fault = refused(&newer);
    assert_eq!(
        (fault.offset, fault.what),
        (8, FaultKind::Version { found: 2 })
    );
    let mut damaged = bytes();
    damaged[60] ^= 1;
    assert!(matches!(
        refused(&damaged).what,
        FaultKind::CheckSum { part: "header", .. }
    ));
    let text = refused(&pcap).to_string();
    assert!(text.starts_with("byte 0: not a trace"), "{text}");
}

#[test]
fn what_cannot_be_written_is_refused() {
    let mut trace = sample();
    trace.header.channel = "x".repeat(97);
    let error = encode(&trace).unwrap_err().to_string();
    assert_eq!(error, "the name of the channel has 97 bytes, at most 96");
    let mut trace = sample();
    trace.records.swap(0, 1);
    assert_eq!(encode(&trace), Err(EncodeError::OutOfOrder { index: 1 }));
}

#[test]
fn what_would_not_be_read_is_not_written() {
    let refused = |change: &dyn Fn(&mut Trace)| {
        let mut trace = sample();
        change(&mut trace);
        encode(&trace).unwrap_err().to_string()
    };
    for (change, says) in [
        (
            &(|trace: &mut Trace| trace.header.link = "h\0p".to_owned()) as &dyn Fn(&mut Trace),
            "the name of the link has a NUL",
        ),
        (
            &|trace| trace.header.run = "x".repeat(97),
            "the name of the run has 97 bytes, at most 96",
        ),
        (
            &|trace| trace.records[2].flags = 64,
            "record 2: flags is 64, allowed are 0 to 31",
        ),
        (
            &|trace| trace.records[1].delay_ns = 5,
            "record 1: delay_ns is 5, allowed are none for a message that never arrived",
        ),
        (
            &|trace| trace.records[1].bound_ns = 5,
            "record 1: bound_ns is 5, allowed are none without a delay",
        ),
        (
            &|trace| trace.records[0].published_ns = UNAVAILABLE_NS,
            "record 0: published_ns",
        ),
        (
            &|trace| trace.records[1].published_ns = -1,
            "record 1 was published before",
        ),
    ] {
        let text = refused(change);
        assert!(text.starts_with(says), "{text}");
    }
}

#[test]
fn whatever_is_written_is_read_as_it_was() {
    let seed = 12;
    let mut random = RandomStream::new(seed, "records");
    let mut written_count = 0;
    for case in 0..20_000 {
        let mut trace = sample();
        let number = random.next_u64();
        let record = &mut trace.records[usize::try_from(number % 4).unwrap()];
        match number >> 8 & 7 {
            0 => record.flags = number.to_le_bytes()[7],
            1 => record.delay_ns = random.next_u64().cast_signed(),
            2 => record.bound_ns = random.next_u64() % 3,
            3 => record.fate = TraceFate::ALL[usize::from(number.to_le_bytes()[7] % 5)],
            4 => record.published_ns = (random.next_u64() % 50_000_000).cast_signed(),
            5 => record.second_delay_ns = UNAVAILABLE_NS,
            6 => trace.header.clock = "µ\0x".chars().take(case % 4).collect(),
            _ => record.start = number.to_le_bytes()[7].into(),
        }
        if let Ok(bytes) = encode(&trace) {
            let read = decode(&bytes).unwrap();
            assert_eq!(
                (read.trace, read.fault),
                (trace, None),
                "seed {seed}, case {case}"
            );
            written_count += 1;
        }
    }
    assert!((5_000..19_000).contains(&written_count), "{written_count}");
}
