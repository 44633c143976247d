//! Traces of what a link did: the binary form, the text, and delivery opportunities.

use hil_core::text_file::TextFile;
use hil_trace::metrics::TraceMetrics;
use hil_trace::wire::{HEADER_BYTES, RECORD_BYTES};
use hil_trace::{Trace, TraceHeader, csv, netem, opportunities as mahimahi, wire};

use crate::Verdict;
use crate::input::Input;

/// Records of a trace whose figures are worked out: they shuffle and sort.
const FIGURED_RECORDS_MAX: usize = 24;
/// Opportunities that are written out.
const OPPORTUNITIES_MAX: u64 = 4096;

/// What is read is written and read as the same.
///
/// The first byte says whether the check sums of the file are made right first: no search finds those.
pub(crate) fn binary(bytes: &[u8]) -> Verdict {
    let mut input = Input::new(bytes);
    let mode = input.byte();
    let mut file = input.rest().to_vec();
    if mode & 1 == 0 {
        make_sums_right(&mut file, mode & 2 == 0);
    }
    let whole = wire::decode(&file);
    match &whole {
        Ok(decoded) => {
            let read_bytes = HEADER_BYTES + decoded.trace.records.len() * RECORD_BYTES;
            assert!(
                read_bytes <= file.len(),
                "more was read than the file holds"
            );
            check_trace(&decoded.trace);
        }
        Err(fault) => {
            assert!(fault.offset <= file.len() as u64, "a fault beyond the end");
            assert!(!fault.to_string().is_empty());
        }
    }
    Verdict::of(whole.is_ok_and(|decoded| decoded.fault.is_none()))
}

/// Gives header and records the check sums and, with `places`, the numbers that belong to them.
pub(crate) fn make_sums_right(file: &mut [u8], places: bool) {
    let split = file.len().min(HEADER_BYTES);
    let (header, records) = file.split_at_mut(split);
    if let Ok(header) = <&mut [u8; HEADER_BYTES]>::try_from(header) {
        let count = (records.len() / RECORD_BYTES) as u64;
        if places {
            header[24..32].copy_from_slice(&count.to_le_bytes());
        }
        let sum = crc32(&header[..HEADER_BYTES - 4]).to_le_bytes();
        header[HEADER_BYTES - 4..].copy_from_slice(&sum);
    }
    for (record, index) in records.chunks_exact_mut(RECORD_BYTES).zip(0_u32..) {
        if places {
            record[56..60].copy_from_slice(&index.to_le_bytes());
        }
        let sum = crc32(&record[..RECORD_BYTES - 4]).to_le_bytes();
        record[RECORD_BYTES - 4..].copy_from_slice(&sum);
    }
}

/// CRC-32 of ISO/IEC 3309, in the plainest way: a second opinion on the decoder's own.
fn crc32(bytes: &[u8]) -> u32 {
    let mut sum = u32::MAX;
    for byte in bytes {
        sum ^= u32::from(*byte);
        for _ in 0..8 {
            let carry = 0_u32.wrapping_sub(sum & 1);
            sum = sum >> 1 ^ (0xedb8_8320 & carry);
        }
    }
    !sum
}

/// What every trace that was read allows: writing, counting, figures, exports.
fn check_trace(trace: &Trace) {
    assert!(trace.records.is_sorted_by_key(|record| record.published_ns));
    let counts = trace.counts();
    assert!(counts.lost_count() <= trace.records.len() as u64);
    if let Ok(bytes) = wire::encode(trace) {
        let again = wire::decode(&bytes).expect("what is encoded can be decoded");
        assert_eq!((again.fault, &again.trace), (None, trace));
    }
    let text = csv::encode(trace);
    let again = csv::decode(&text.as_str().into()).expect("what is written as text can be read");
    assert_eq!(again.fault, None, "{text}");
    assert_eq!(again.trace.records.len(), trace.records.len());
    assert_eq!(csv::encode(&again.trace), text, "the text changes");
    if trace.records.len() <= FIGURED_RECORDS_MAX {
        let figures = TraceMetrics::of(trace);
        assert!(
            figures.rate_hz.is_none_or(|rate| rate >= 0.0),
            "{figures:?}"
        );
        if let Some(table) = netem::table(trace) {
            let lines = table.text.lines().filter(|line| !line.starts_with('#'));
            let numbers = lines.flat_map(str::split_whitespace);
            let numbers: Vec<i32> = numbers
                .map(|number| number.parse().expect("a table of whole numbers"))
                .collect();
            assert_eq!(numbers.len(), netem::TABLE_COUNT);
            assert!(
                numbers
                    .iter()
                    .all(|number| (-32_768..=32_767).contains(number))
            );
        }
    }
    let packets = trace.records.iter().map(|record| {
        let size = u64::from(record.size_bytes);
        size.div_ceil(mahimahi::OPPORTUNITY_BYTES).max(1)
    });
    if packets.fold(0_u64, u64::saturating_add) <= OPPORTUNITIES_MAX
        && let Ok(text) = mahimahi::encode(trace)
    {
        let (_, fault) = mahimahi::decode(&text.as_str().into());
        assert_eq!(fault, None, "{text}");
    }
}

/// A text that is read can be written and read as the same.
pub(crate) fn csv(bytes: &[u8]) -> Verdict {
    let Ok(text) = TextFile::decode(bytes) else {
        return Verdict::Refused;
    };
    match csv::decode(&text) {
        Ok(decoded) => {
            if let Some(fault) = &decoded.fault {
                assert!(fault.offset <= bytes.len() as u64, "a fault beyond the end");
                assert!(!fault.what.is_empty());
            }
            assert!(decoded.trace.records.len() <= bytes.len());
            check_trace(&decoded.trace);
            Verdict::Accepted
        }
        Err(fault) => {
            assert!(fault.offset <= bytes.len() as u64 && !fault.what.is_empty());
            Verdict::Refused
        }
    }
}

/// Times that are read are written as the same times.
pub(crate) fn opportunities(bytes: &[u8]) -> Verdict {
    let Ok(text) = TextFile::decode(bytes) else {
        return Verdict::Refused;
    };
    let (trace, fault) = mahimahi::decode(&text);
    assert!(trace.records.is_sorted_by_key(|record| record.published_ns));
    if let Some(fault) = &fault {
        assert!(fault.offset <= bytes.len() as u64 && !fault.what.is_empty());
    }
    check_trace(&trace);
    if fault.is_some() {
        return Verdict::Refused;
    }
    let written = mahimahi::encode(&trace).expect("each is an opportunity");
    let first = trace
        .records
        .first()
        .map_or(0, |record| record.published_ns);
    let told = text
        .lines()
        .map(|line| line.content.trim().trim_matches('"'));
    let told = told.filter(|line| !line.is_empty());
    let told = told.map(|line| line.parse::<i64>().expect("it was read") - first / 1_000_000);
    let again = written
        .lines()
        .map(|line| line.parse::<i64>().expect("it was written"));
    assert!(told.eq(again), "{written}");
    Verdict::Accepted
}

/// A trace for the corpus.
pub(crate) fn header(channel: &str) -> TraceHeader {
    let mut header = TraceHeader::new(channel);
    "one clock".clone_into(&mut header.clock);
    "hop".clone_into(&mut header.link);
    header.duration_ns = 1_000_000_000;
    header
}
