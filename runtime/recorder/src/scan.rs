//! Reads an MCAP file from front to back, record by record, over whatever is damaged: a chunk that
//! fails its check sum is passed over, one that was never finished is decoded as far as it goes. It
//! needs neither footer nor index, and holds one record in memory at a time.

use std::fs::File;
use std::io::{self, BufReader, Read};
use std::path::Path;

use mcap::MAGIC;
use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

use crate::failure::Failure;
use crate::lengths;

/// Largest record, compressed or not: a bound on what a damaged length may ask for.
const RECORD_BYTES_MAX: usize = 1 << 30;
/// Bytes before the body of a record: what it is, and its length.
const RECORD_HEAD_BYTES: u64 = 9;
/// Bytes of a chunk's header without the name of the compression.
const CHUNK_HEAD_BYTES: usize = 40;
/// Where in it the length of that name stands, and the name itself.
const COMPRESSION_AT: usize = 28;

/// Bytes that nothing could be made of.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Loss {
    /// Where the record begins that they belong to.
    pub(crate) offset: u64,
    /// How many bytes of the file that record has.
    pub(crate) size_bytes: u64,
    /// Messages in it, by its index; `None` when nobody knows.
    pub(crate) message_count: Option<u64>,
    /// What is wrong, and what was kept.
    pub(crate) why: String,
}

impl Loss {
    /// Of a record in which nobody knows how many messages were.
    pub(crate) const fn new(offset: u64, size_bytes: u64, why: String) -> Self {
        Self {
            offset,
            size_bytes,
            message_count: None,
            why,
        }
    }
}

/// Hears each record with its place in the file, and says whether it wants more.
pub(crate) type Visit<'a> = dyn FnMut(u64, Record<'_>) -> bool + 'a;

/// How a scan ended.
#[derive(Debug, Default)]
pub(crate) struct ScanEnd {
    /// What was lost, in the order of the file.
    pub(crate) losses: Vec<Loss>,
    /// The footer and what follows it are there.
    pub(crate) is_complete: bool,
    /// Messages the writer counted; `None` without its statistics.
    pub(crate) counted: Option<u64>,
    /// Size of the file, bytes.
    pub(crate) size_bytes: u64,
}

/// Scans the file at `path`; `visit` is given every record of the data section that is whole, those
/// of chunks in their place, and the descriptions of topics that the summary repeats, with the offset of the file at which it (or its chunk) begins, and
/// ends the scan with false.
///
/// # Errors
/// When the file cannot be read, or is no MCAP file.
pub(crate) fn scan(path: &Path, visit: &mut Visit<'_>) -> Result<ScanEnd, Failure> {
    let name = path.display();
    let failed = |source: io::Error| Failure::failed(format!("cannot read {name}: {source}"));
    let file = File::open(path).map_err(failed)?;
    let size_bytes = file.metadata().map_err(failed)?.len();
    let limits = Limits {
        size_bytes,
        record_bytes_max: RECORD_BYTES_MAX,
    };
    let end = scan_from(BufReader::new(file), limits, visit).map_err(failed)?;
    end.ok_or_else(|| {
        Failure::usage(format!(
            "{name}: not an MCAP file, whose first bytes are 89 4D 43 41 50 30 0D 0A"
        ))
    })
}

/// What a scan keeps to.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Limits {
    /// Size of the file, bytes.
    pub(crate) size_bytes: u64,
    /// Largest record, compressed or not.
    pub(crate) record_bytes_max: usize,
}

/// As [`scan`], of bytes from anywhere; `None` when they are no MCAP file.
///
/// # Errors
/// When they cannot be read.
pub(crate) fn scan_from(
    file: impl Read,
    limits: Limits,
    visit: &mut Visit<'_>,
) -> io::Result<Option<ScanEnd>> {
    let mut scanner = Scanner {
        file,
        offset: 0,
        record_bytes_max: limits.record_bytes_max,
        end: ScanEnd {
            size_bytes: limits.size_bytes,
            ..ScanEnd::default()
        },
        damaged: None,
        is_summary: false,
    };
    if scanner.take(MAGIC.len() as u64)? != MAGIC {
        return Ok(None);
    }
    while scanner.next(visit)? {}
    Ok(Some(scanner.end))
}

struct Scanner<R> {
    file: R,
    offset: u64,
    record_bytes_max: usize,
    end: ScanEnd,
    /// The last chunk that was passed over, until its index says how many messages it had.
    damaged: Option<usize>,
    /// Behind the data: what follows repeats it.
    is_summary: bool,
}

impl<R: Read> Scanner<R> {
    /// The next bytes, fewer at the end of the file.
    fn take(&mut self, count: u64) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        (&mut self.file).take(count).read_to_end(&mut bytes)?;
        self.offset += bytes.len() as u64;
        Ok(bytes)
    }

    /// Reads one record; false at the end.
    fn next(&mut self, visit: &mut Visit<'_>) -> io::Result<bool> {
        let start = self.offset;
        let head = self.take(RECORD_HEAD_BYTES)?;
        let Some((opcode, length)) = head.split_first().filter(|(_, rest)| rest.len() == 8) else {
            if head == MAGIC && self.is_summary {
                self.end.is_complete = true;
            } else if !self.is_summary || !head.is_empty() {
                self.lose(start, "the file ends here, without its summary");
            } else {
                self.lose(start, "the file ends within its summary");
            }
            return Ok(false);
        };
        let length = u64::from_le_bytes(length.try_into().unwrap_or_default());
        if *opcode == 0 {
            self.lose(
                start,
                "no record begins with a zero: the rest was never written",
            );
            return Ok(false);
        }
        let left = self.end.size_bytes.saturating_sub(self.offset);
        let is_whole = length <= left;
        if !is_whole && *opcode != op::CHUNK {
            self.lose(start, "a record goes on beyond the end of the file");
            return Ok(false);
        }
        if length.min(left) > self.record_bytes_max as u64 {
            let why = format!("a record is larger than {} bytes", self.record_bytes_max);
            self.lose(start, &why);
            return Ok(false);
        }
        let body = self.take(length.min(left))?;
        if *opcode == op::CHUNK {
            let goes_on = self.chunk(start, is_whole, &body, visit);
            return Ok(goes_on && is_whole);
        }
        Ok(self.record(start, *opcode, &body, visit))
    }

    fn lose(&mut self, offset: u64, why: &str) {
        let size_bytes = self.end.size_bytes.saturating_sub(offset);
        let loss = Loss::new(offset, size_bytes, why.to_owned());
        self.end.losses.push(loss);
    }

    /// A record outside of any chunk; false to end.
    fn record(&mut self, start: u64, opcode: u8, body: &[u8], visit: &mut Visit<'_>) -> bool {
        match parse(opcode, body) {
            Ok(Record::MessageIndex(index)) => {
                let loss = self.damaged.and_then(|at| self.end.losses.get_mut(at));
                if let Some(loss) = loss {
                    let count = index.records.len() as u64;
                    loss.message_count = Some(loss.message_count.unwrap_or(0) + count);
                }
            }
            Ok(Record::DataEnd(_)) => self.is_summary = true,
            Ok(Record::Statistics(statistics)) => {
                self.end.counted = Some(statistics.message_count);
            }
            // The summary repeats them: of use when the chunk that had them is damaged.
            Ok(record @ (Record::Schema { .. } | Record::Channel(_))) => {
                return visit(start, record);
            }
            Ok(_) if self.is_summary => {}
            Ok(record) => return visit(start, record),
            Err(why) => {
                let size_bytes = body.len() as u64 + RECORD_HEAD_BYTES;
                let why = format!("a record of kind {opcode:#04x} is damaged: {why}");
                self.end.losses.push(Loss::new(start, size_bytes, why));
            }
        }
        true
    }

    /// The records of a chunk; false to end.
    fn chunk(&mut self, start: u64, is_whole: bool, body: &[u8], visit: &mut Visit<'_>) -> bool {
        self.damaged = None;
        let mut goes_on = true;
        let mut kept_count = 0_u64;
        let mut take = |opcode, data: &[u8]| -> Result<bool, String> {
            let record = parse(opcode, data)?;
            kept_count += u64::from(matches!(record, Record::Message { .. }));
            goes_on = visit(start, record);
            Ok(goes_on)
        };
        let decoded = if is_whole {
            let bytes = framed(unpadded(body));
            decode(&bytes, true, self.record_bytes_max, &mut take)
        } else {
            // Its header was to be written last, so nothing in it but the compression counts.
            unfinished(body).map_or_else(
                || Err("its header is not whole".to_owned()),
                |bytes| decode(&bytes, false, self.record_bytes_max, &mut take),
            )
        };
        let why = match decoded {
            _ if !goes_on => return false,
            Ok(()) if is_whole => return true,
            Ok(()) => "the file ends here".to_owned(),
            Err(why) if is_whole => why,
            Err(why) => format!("the file ends here ({why})"),
        };
        self.damaged = is_whole.then_some(self.end.losses.len());
        let size_bytes = body.len() as u64 + RECORD_HEAD_BYTES;
        let why = format!("a chunk is not whole: {why}; {kept_count} of its messages were kept");
        self.end.losses.push(Loss::new(start, size_bytes, why));
        true
    }
}

/// As [`mcap::read::parse_record`], with a message in words, of a record that keeps to its length.
fn parse(opcode: u8, body: &[u8]) -> Result<Record<'_>, String> {
    if !lengths::lie_within(opcode, body) {
        return Err("something in it is longer than the record".to_owned());
    }
    mcap::parse_record(opcode, body).map_err(|error| error.to_string())
}

/// Bytes of the header of this chunk's body; `None` when not even the length of the name is there.
fn chunk_head_bytes(body: &[u8]) -> Option<usize> {
    let name_bytes = body.get(COMPRESSION_AT..)?.first_chunk::<4>()?;
    let name_bytes = usize::try_from(u32::from_le_bytes(*name_bytes)).ok()?;
    CHUNK_HEAD_BYTES.checked_add(name_bytes)
}

/// A chunk's body without what may follow its records: the reader would take a record that goes on
/// into that for one of them, and lose count.
fn unpadded(body: &[u8]) -> &[u8] {
    let end = || {
        let head_bytes = chunk_head_bytes(body)?;
        let size = body.get(head_bytes - 8..)?.first_chunk::<8>()?;
        head_bytes.checked_add(usize::try_from(u64::from_le_bytes(*size)).ok()?)
    };
    end().and_then(|end| body.get(..end)).unwrap_or(body)
}

/// A chunk record with this body.
fn framed(body: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(body.len() + 9);
    bytes.push(op::CHUNK);
    bytes.extend_from_slice(&(body.len() as u64).to_le_bytes());
    bytes.extend_from_slice(body);
    bytes
}

/// A chunk record that says of itself what is there of it; `None` when not even the name of the
/// compression is.
fn unfinished(body: &[u8]) -> Option<Vec<u8>> {
    let head_bytes = chunk_head_bytes(body)?;
    let mut body = body.to_vec();
    let data_bytes = body.len().checked_sub(head_bytes)? as u64;
    // Uncompressed, the size is known as well; compressed, it is only not to stand in the way.
    let uncompressed = if head_bytes == CHUNK_HEAD_BYTES {
        data_bytes
    } else {
        u64::MAX
    };
    body[16..24].copy_from_slice(&uncompressed.to_le_bytes());
    body[24..28].fill(0);
    body[head_bytes - 8..head_bytes].copy_from_slice(&data_bytes.to_le_bytes());
    Some(framed(&body))
}

/// Hears kind and body of a record, and says whether it wants more.
type Take<'a> = dyn FnMut(u8, &[u8]) -> Result<bool, String> + 'a;

/// Hands every record of the chunk record `bytes` to `take` until that wants no more.
fn decode(
    bytes: &[u8],
    is_checked: bool,
    record_bytes_max: usize,
    take: &mut Take<'_>,
) -> Result<(), String> {
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_prevalidate_chunk_crcs(is_checked)
        .with_record_length_limit(record_bytes_max);
    let mut reader = LinearReader::new_with_options(options);
    let mut rest = bytes;
    while let Some(event) = reader.next_event() {
        match event.map_err(|error| error.to_string())? {
            LinearReadEvent::ReadRequest(wanted) => {
                let (now, later) = rest.split_at(wanted.min(rest.len()));
                reader.insert(now.len()).copy_from_slice(now);
                reader.notify_read(now.len());
                rest = later;
            }
            LinearReadEvent::Record { data, opcode } => {
                if !take(opcode, data)? {
                    break;
                }
            }
        }
    }
    Ok(())
}
