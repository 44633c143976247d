//! The binary form of a trace: a header of 384 bytes and records of 64, all little-endian, each
//! with its place and a check sum of its own: CRC-32 of ISO/IEC 3309, that of Ethernet and zip, which
//! guards against damage, not against an adversary. So damage is found where it is, and everything
//! before it is kept. Bytes in, bytes out: it opens no file.

use super::csv::SIZE_BYTES_MAX;
use super::fault::{EncodeError, FaultKind, TraceFault};
use super::{
    Trace, TraceArrival, TraceDirection, TraceFate, TraceHeader, TraceRecord, UNAVAILABLE_NS,
    UNBOUNDED_NS,
};
use crc32fast::hash as crc32;

/// First bytes of a trace.
pub const MAGIC: [u8; 8] = *b"HILTRACE";
/// The only version there is.
pub const VERSION: u32 = 1;
/// Bytes of the header.
pub const HEADER_BYTES: usize = 384;
/// Bytes of a record.
pub const RECORD_BYTES: usize = 64;
/// Most records a file may have: what a place of 32 bits can number.
pub const RECORD_COUNT_MAX: u64 = u32::MAX as u64;

const RUN_AT: usize = 56;
const CHANNEL_AT: usize = RUN_AT + TraceHeader::RUN_BYTES;
const LINK_AT: usize = CHANNEL_AT + TraceHeader::CHANNEL_BYTES;
const CLOCK_AT: usize = LINK_AT + TraceHeader::LINK_BYTES;
const HEADER_SUM_AT: usize = HEADER_BYTES - 4;
const RECORD_SUM_AT: usize = RECORD_BYTES - 4;

const _: () = assert!(CLOCK_AT + TraceHeader::CLOCK_BYTES <= HEADER_SUM_AT);

/// What could be read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Decoded {
    /// Header and every record before the first fault.
    pub trace: Trace,
    /// The first fault; `None` when the file is whole.
    pub fault: Option<TraceFault>,
}

/// The bytes of `trace`.
///
/// # Errors
/// [`EncodeError`], for whatever [`decode`] would refuse or read otherwise.
pub fn encode(trace: &Trace) -> Result<Vec<u8>, EncodeError> {
    let count = trace.records.len();
    let mut bytes = Vec::with_capacity(HEADER_BYTES + count * RECORD_BYTES);
    let (mut encoder, header) = TraceEncoder::new(&trace.header, count)?;
    bytes.extend_from_slice(&header);
    for record in &trace.records {
        bytes.extend_from_slice(&encoder.record(record)?);
    }
    Ok(bytes)
}

/// Writes a trace piece by piece; holds none of it.
#[derive(Debug)]
pub struct TraceEncoder {
    next: u32,
    before_ns: Option<i64>,
}

impl TraceEncoder {
    /// The bytes of the header of a trace of `count` records, and what makes those of the records.
    ///
    /// # Errors
    /// When a name does not fit, or there are too many records.
    pub fn new(
        header: &TraceHeader,
        count: usize,
    ) -> Result<(Self, [u8; HEADER_BYTES]), EncodeError> {
        if count as u64 > RECORD_COUNT_MAX {
            return Err(EncodeError::TooMany { count });
        }
        let encoder = Self {
            next: 0,
            before_ns: None,
        };
        Ok((encoder, encode_header(header, count as u64)?))
    }

    /// The bytes of the next record.
    ///
    /// # Errors
    /// When it was published before the last one, or its fields cannot be read together.
    pub fn record(&mut self, record: &TraceRecord) -> Result<[u8; RECORD_BYTES], EncodeError> {
        let index = self.next;
        let is_earlier = |before_ns: i64| record.published_ns < before_ns;
        if self.before_ns.is_some_and(is_earlier) {
            let index = index as usize;
            return Err(EncodeError::OutOfOrder { index });
        }
        check_record(record).map_err(|(_, what)| EncodeError::Record { index, what })?;
        self.before_ns = Some(record.published_ns);
        self.next = index.saturating_add(1);
        Ok(encode_record(record, index))
    }
}

fn encode_header(header: &TraceHeader, count: u64) -> Result<[u8; HEADER_BYTES], EncodeError> {
    let mut bytes = [0; HEADER_BYTES];
    bytes[..8].copy_from_slice(&MAGIC);
    put(&mut bytes, 8, &VERSION.to_le_bytes());
    put(&mut bytes, 12, &to_u32(HEADER_BYTES).to_le_bytes());
    put(&mut bytes, 16, &to_u32(RECORD_BYTES).to_le_bytes());
    bytes[20] = header.direction as u8;
    bytes[21] = header.arrival as u8;
    put(&mut bytes, 22, &header.link_change_count.to_le_bytes());
    put(&mut bytes, 24, &count.to_le_bytes());
    put(&mut bytes, 32, &header.origin_ns.to_le_bytes());
    put(&mut bytes, 40, &header.duration_ns.to_le_bytes());
    let names = [
        ("run", &header.run, RUN_AT, TraceHeader::RUN_BYTES),
        (
            "channel",
            &header.channel,
            CHANNEL_AT,
            TraceHeader::CHANNEL_BYTES,
        ),
        ("link", &header.link, LINK_AT, TraceHeader::LINK_BYTES),
        ("clock", &header.clock, CLOCK_AT, TraceHeader::CLOCK_BYTES),
    ];
    for (what, name, at, limit) in names {
        let length = name.len();
        if length > limit {
            return Err(EncodeError::NameTooLong {
                what,
                length,
                limit,
            });
        }
        // Zeros end a name when it is read.
        if name.bytes().any(|byte| byte == 0) {
            return Err(EncodeError::NameWithNul { what });
        }
        put(&mut bytes, at, name.as_bytes());
    }
    let sum = crc32(&bytes[..HEADER_SUM_AT]);
    put(&mut bytes, HEADER_SUM_AT, &sum.to_le_bytes());
    Ok(bytes)
}

fn encode_record(record: &TraceRecord, index: u32) -> [u8; RECORD_BYTES] {
    let mut bytes = [0; RECORD_BYTES];
    put(&mut bytes, 0, &record.published_ns.to_le_bytes());
    put(&mut bytes, 8, &record.departure_ns.to_le_bytes());
    put(&mut bytes, 16, &record.delay_ns.to_le_bytes());
    put(&mut bytes, 24, &record.bound_ns.to_le_bytes());
    put(&mut bytes, 32, &record.second_delay_ns.to_le_bytes());
    put(&mut bytes, 40, &record.sequence.to_le_bytes());
    put(&mut bytes, 48, &record.size_bytes.to_le_bytes());
    put(&mut bytes, 52, &record.start.to_le_bytes());
    bytes[54] = record.fate as u8;
    bytes[55] = record.flags;
    put(&mut bytes, 56, &index.to_le_bytes());
    let sum = crc32(&bytes[..RECORD_SUM_AT]);
    put(&mut bytes, RECORD_SUM_AT, &sum.to_le_bytes());
    bytes
}

fn put(bytes: &mut [u8], at: usize, part: &[u8]) {
    bytes[at..at + part.len()].copy_from_slice(part);
}

fn to_u32(size: usize) -> u32 {
    u32::try_from(size).expect("the sizes of the format are small")
}

/// Reads a trace.
///
/// # Errors
/// When not even the header can be read; every later fault is beside what could be.
pub fn decode(bytes: &[u8]) -> Result<Decoded, TraceFault> {
    let Some((head, rest)) = bytes.split_at_checked(HEADER_BYTES) else {
        let begin = &bytes[..bytes.len().min(MAGIC.len())];
        let what = if MAGIC.starts_with(begin) {
            FaultKind::Truncated {
                found: bytes.len() as u64,
                expected: HEADER_BYTES as u64,
                unit: "bytes of the header",
            }
        } else {
            let found = begin.to_vec();
            FaultKind::Foreign { found }
        };
        return Err(TraceFault { offset: 0, what });
    };
    let (header, count) =
        decode_header(head).map_err(|(offset, what)| TraceFault { offset, what })?;
    let mut records: Vec<TraceRecord> = Vec::new();
    let fault = decode_records(rest, count, &mut records).err();
    let fault = fault.map(|(at, what)| TraceFault {
        offset: (HEADER_BYTES + records.len() * RECORD_BYTES) as u64 + at,
        what,
    });
    let trace = Trace { header, records };
    Ok(Decoded { trace, fault })
}

/// Reads `count` records, which are all there is in `bytes`; the place of a fault counts from the record it is in.
fn decode_records(
    mut bytes: &[u8],
    count: u64,
    records: &mut Vec<TraceRecord>,
) -> Result<(), (u64, FaultKind)> {
    for expected in 0..u32::try_from(count).unwrap_or(u32::MAX) {
        let Some((part, rest)) = bytes.split_at_checked(RECORD_BYTES) else {
            let what = FaultKind::Truncated {
                found: expected.into(),
                expected: count,
                unit: "records",
            };
            return Err((0, what));
        };
        check_sum(part, RECORD_SUM_AT, "record")?;
        let found = u32_at(part, 56);
        if found != expected {
            return Err((56, FaultKind::Place { found, expected }));
        }
        let record = decode_record(part)?;
        let published_ns = record.published_ns;
        let before = records.last().map(|before| before.published_ns);
        if let Some(before_ns) = before.filter(|before_ns| published_ns < *before_ns) {
            let what = FaultKind::Order {
                published_ns,
                before_ns,
            };
            return Err((0, what));
        }
        records.push(record);
        bytes = rest;
    }
    match bytes.len() as u64 {
        0 => Ok(()),
        count => Err((0, FaultKind::Trailing { count })),
    }
}

fn check_sum(bytes: &[u8], at: usize, part: &'static str) -> Result<(), (u64, FaultKind)> {
    let (found, computed) = (u32_at(bytes, at), crc32(&bytes[..at]));
    if found == computed {
        return Ok(());
    }
    let what = FaultKind::CheckSum {
        part,
        found,
        computed,
    };
    // The sum covers the whole part; which of its bytes is wrong it does not tell.
    Err((0, what))
}

fn decode_header(bytes: &[u8]) -> Result<(TraceHeader, u64), (u64, FaultKind)> {
    if bytes[..8] != MAGIC {
        let found = bytes[..8].to_vec();
        return Err((0, FaultKind::Foreign { found }));
    }
    let version = u32_at(bytes, 8);
    if version != VERSION {
        return Err((8, FaultKind::Version { found: version }));
    }
    check_sum(bytes, HEADER_SUM_AT, "header")?;
    let (header, record) = (u32_at(bytes, 12), u32_at(bytes, 16));
    if (header as usize, record as usize) != (HEADER_BYTES, RECORD_BYTES) {
        return Err((12, FaultKind::Sizes { header, record }));
    }
    let count = u64::from_le_bytes(array_at(bytes, 24));
    if count > RECORD_COUNT_MAX {
        let (value, allowed) = (count, "0 to 4294967295");
        let field = "record_count";
        let what = FaultKind::Field {
            field,
            value,
            allowed,
        };
        return Err((24, what));
    }
    let header = TraceHeader {
        run: text_at(bytes, "run", RUN_AT, TraceHeader::RUN_BYTES)?,
        channel: text_at(bytes, "channel", CHANNEL_AT, TraceHeader::CHANNEL_BYTES)?,
        link: text_at(bytes, "link", LINK_AT, TraceHeader::LINK_BYTES)?,
        clock: text_at(bytes, "clock", CLOCK_AT, TraceHeader::CLOCK_BYTES)?,
        direction: code(&TraceDirection::ALL, bytes, 20, "direction")?,
        arrival: code(&TraceArrival::ALL, bytes, 21, "arrival")?,
        link_change_count: u16::from_le_bytes(array_at(bytes, 22)),
        origin_ns: i64::from_le_bytes(array_at(bytes, 32)),
        duration_ns: i64::from_le_bytes(array_at(bytes, 40)),
    };
    Ok((header, count))
}

fn decode_record(bytes: &[u8]) -> Result<TraceRecord, (u64, FaultKind)> {
    let record = TraceRecord {
        published_ns: i64::from_le_bytes(array_at(bytes, 0)),
        departure_ns: i64::from_le_bytes(array_at(bytes, 8)),
        delay_ns: i64::from_le_bytes(array_at(bytes, 16)),
        bound_ns: u64::from_le_bytes(array_at(bytes, 24)),
        second_delay_ns: i64::from_le_bytes(array_at(bytes, 32)),
        sequence: u64::from_le_bytes(array_at(bytes, 40)),
        size_bytes: u32_at(bytes, 48),
        start: u16::from_le_bytes(array_at(bytes, 52)),
        fate: code(&TraceFate::ALL, bytes, 54, "fate")?,
        flags: bytes[55],
    };
    check_record(&record)?;
    Ok(record)
}

// In the words of a fault.
const _: () = assert!(SIZE_BYTES_MAX == 67_107_840);

/// What the fields of a record say together.
fn check_record(record: &TraceRecord) -> Result<(), (u64, FaultKind)> {
    let field = |at, field, value, allowed| {
        let what = FaultKind::Field {
            field,
            value,
            allowed,
        };
        Err((at, what))
    };
    if record.flags & !TraceRecord::FLAGS != 0 {
        return field(55, "flags", u64::from(record.flags), "0 to 31");
    }
    if record.size_bytes > SIZE_BYTES_MAX {
        return field(
            48,
            "size_bytes",
            u64::from(record.size_bytes),
            "0 to 67107840",
        );
    }
    if record.published_ns == UNAVAILABLE_NS {
        return field(0, "published_ns", 1 << 63, "any instant");
    }
    let has_delay = record.delay_ns != UNAVAILABLE_NS;
    if has_delay
        && matches!(
            record.fate,
            TraceFate::LostInNetwork | TraceFate::LostBeforeLink
        )
    {
        let delay = record.delay_ns.cast_unsigned();
        return field(
            16,
            "delay_ns",
            delay,
            "none for a message that never arrived",
        );
    }
    if !has_delay && record.bound_ns != UNBOUNDED_NS {
        return field(24, "bound_ns", record.bound_ns, "none without a delay");
    }
    Ok(())
}

fn code<T: Copy>(
    all: &[T],
    bytes: &[u8],
    at: usize,
    field: &'static str,
) -> Result<T, (u64, FaultKind)> {
    let value = bytes[at];
    let allowed = if all.len() == 5 { "0 to 4" } else { "0 to 2" };
    let what = FaultKind::Field {
        field,
        value: u64::from(value),
        allowed,
    };
    all.get(usize::from(value))
        .copied()
        .ok_or((at as u64, what))
}

fn text_at(
    bytes: &[u8],
    what: &'static str,
    at: usize,
    limit: usize,
) -> Result<String, (u64, FaultKind)> {
    let field = &bytes[at..at + limit];
    let length = field.iter().position(|byte| *byte == 0).unwrap_or(limit);
    match core::str::from_utf8(&field[..length]) {
        Ok(text) => Ok(text.to_owned()),
        Err(error) => Err(((at + error.valid_up_to()) as u64, FaultKind::Text { what })),
    }
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(array_at(bytes, at))
}

fn array_at<const N: usize>(bytes: &[u8], at: usize) -> [u8; N] {
    let mut array = [0; N];
    array.copy_from_slice(&bytes[at..at + N]);
    array
}

#[cfg(test)]
#[path = "wire_tests.rs"]
mod tests;
