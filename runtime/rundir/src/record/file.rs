//! The record file: a 128-byte header, then records of one fixed size. Not a database: a file
//! cut short by a crash is read up to its last whole record.
//!
//! | offset | size | field (little-endian) |
//! |---|---|---|
//! | 0 | 8 | magic `HILREC01` |
//! | 8 | 4 | kind, see [`RecordKind`] |
//! | 12 | 4 | size of one record in bytes |
//! | 16 | 4 | instance: 0 for a process's first start, counting its restarts |
//! | 20 | 4 | zero |
//! | 24 | 8 | at which byte the records end; 0: with the file |
//! | 32 | 96 | channel name, UTF-8, padded with zeros |

use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use bytemuck::{CheckedBitPattern, Pod};
use hil_account::nic_clock::NicClockRecord;
use hil_core::message::Envelope;
use hil_core::record::{
    EgressRecord, FrameRecord, IngressRecord, PublishedRecord, RoundTripRecord, TakenRecord,
};
use hil_core::run_log::RunLog;
use hil_link::condition::LinkConditionRecord;
use hil_platform::plain_file;

use crate::adapter_record::{AdapterReceivedRecord, AdapterSentRecord};
use crate::radio_record::RadioRecord;
use hil_topology::CHANNEL_NAME_BYTES_MAX;

const MAGIC: &[u8; 8] = b"HILREC01";
/// Size of the file header.
pub const HEADER_BYTES: usize = 128;
/// Where in the header it says at which byte the records end, in eight bytes. It says 0 where they end with the
/// file: a file that grows by the page is longer than its records, and so is one whose writer was killed.
pub(super) const END_AT: usize = 24;

hil_core::labelled! {
    /// What a record file holds; its number stands for it in the header.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, CheckedBitPattern)]
    #[repr(u32)]
    pub enum RecordKind, name {
        /// [`PublishedRecord`]s of a producer.
        Published: 1 = "published",
        /// [`TakenRecord`]s of a consumer.
        Taken: 2 = "taken",
        /// [`EgressRecord`]s of a sending gateway.
        Egress: 3 = "egress",
        /// [`IngressRecord`]s of a receiving gateway.
        Ingress: 4 = "ingress",
        /// Messages: an [`Envelope`] and the payload.
        Message: 6 = "message",
        /// [`RoundTripRecord`]s of a sending gateway.
        RoundTrip: 7 = "round-trip",
        /// [`AdapterSentRecord`]s of an adapter: datagrams to a foreign program.
        AdapterSent: 8 = "face-sent",
        /// [`AdapterReceivedRecord`]s of an adapter: datagrams of a foreign program.
        AdapterReceived: 9 = "face-received",
        /// [`NicClockRecord`]s of a supervisor; the channel is `<host>/<interface>` of the card.
        NicClock: 10 = "card-clock",
        /// [`RadioRecord`]s of a gateway on a wireless hop; the channel is `<process>/<interface>`.
        Radio: 15 = "radio",
        /// [`LinkConditionRecord`]s of a gateway that emulates a link; the channel is that of the orders,
        /// `hil/link/<link>/<direction>`.
        LinkCondition: 16 = "link-condition",
        /// [`FrameRecord`]s of an inlet.
        Frame: 17 = "frame",
    }
}

impl RecordKind {
    /// How the names of all files begin that hold such records of `channel`.
    pub fn file_name_start(self, channel: &str) -> String {
        format!("{}.{}.", channel.replace('/', "."), self.name())
    }

    /// Size of one record; `None` where it depends on the channel.
    fn record_bytes(self) -> Option<usize> {
        match self {
            Self::Published => Some(size_of::<PublishedRecord>()),
            Self::Taken => Some(size_of::<TakenRecord>()),
            Self::Egress => Some(size_of::<EgressRecord>()),
            Self::Ingress => Some(size_of::<IngressRecord>()),
            Self::RoundTrip => Some(size_of::<RoundTripRecord>()),
            Self::AdapterSent => Some(size_of::<AdapterSentRecord>()),
            Self::AdapterReceived => Some(size_of::<AdapterReceivedRecord>()),
            Self::NicClock => Some(size_of::<NicClockRecord>()),
            Self::Radio => Some(size_of::<RadioRecord>()),
            Self::LinkCondition => Some(size_of::<LinkConditionRecord>()),
            Self::Frame => Some(size_of::<FrameRecord>()),
            Self::Message => None,
        }
    }
}

/// Why a record file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RecordFileError {
    /// Reading or writing failed.
    #[error("record file {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The bytes are not what a record file holds.
    #[error("record file {path}, byte {offset}: {problem}")]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Where.
        offset: usize,
        /// What is wrong.
        problem: &'static str,
    },
    /// The records are laid out in another way than this program's.
    #[error(
        "record file {path}, byte 12: {kind} records of {found_bytes} bytes, where this program \
         has {expected}; written by another version of hil-runtime?"
    )]
    OtherLayout {
        /// The file.
        path: PathBuf,
        /// Of what, as in file names.
        kind: &'static str,
        /// Size of one record as the header says it.
        found_bytes: u32,
        /// Size or sizes this program knows.
        expected: String,
    },
}

/// Identity of a record file: what its header says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordHeader {
    /// What it holds.
    pub kind: RecordKind,
    /// The channel.
    pub channel: String,
    /// Size of one record.
    pub record_bytes: u32,
    /// Which start of the process wrote it.
    pub instance: u32,
}

impl RecordHeader {
    /// File name below the run's `records` folder: unique per channel, kind, writer, instance.
    pub fn file_name(&self, writer: &str) -> String {
        let start = self.kind.file_name_start(&self.channel);
        format!("{start}{writer}.{}.rec", self.instance)
    }

    /// The header's bytes.
    ///
    /// # Errors
    /// When the channel name is longer than [`CHANNEL_NAME_BYTES_MAX`].
    pub fn encode(&self, path: &Path) -> Result<[u8; HEADER_BYTES], RecordFileError> {
        let name = self.channel.as_bytes();
        if name.len() > CHANNEL_NAME_BYTES_MAX {
            let problem = "the channel name is longer than 96 bytes";
            return Err(malformed(path, 32, problem));
        }
        let mut bytes = [0; HEADER_BYTES];
        bytes[..8].copy_from_slice(MAGIC);
        bytes[8..12].copy_from_slice(&(self.kind as u32).to_le_bytes());
        bytes[12..16].copy_from_slice(&self.record_bytes.to_le_bytes());
        bytes[16..20].copy_from_slice(&self.instance.to_le_bytes());
        bytes[32..32 + name.len()].copy_from_slice(name);
        Ok(bytes)
    }

    /// Makes the file of `writer` in `folder`, with the header in it; its path as well.
    ///
    /// # Errors
    /// When it exists or cannot be written, or the channel name is too long.
    pub fn create(&self, folder: &Path, writer: &str) -> Result<(PathBuf, File), RecordFileError> {
        let path = folder.join(self.file_name(writer));
        let bytes = self.encode(&path)?;
        let made =
            File::create_new(&path).and_then(|mut file| file.write_all(&bytes).map(|()| file));
        match made {
            Ok(file) => Ok((path, file)),
            Err(source) => {
                if source.kind() != io::ErrorKind::AlreadyExists {
                    // A file without a header would only be one more thing to tell of.
                    let _left = fs::remove_file(&path).is_err();
                }
                Err(RecordFileError::Io { path, source })
            }
        }
    }

    /// The name of the process that wrote the file called `name`, which has this header; `None`
    /// when the name is not made as [`RecordHeader::file_name`] makes it.
    pub fn writer<'a>(&self, name: &'a str) -> Option<&'a str> {
        let start = self.kind.file_name_start(&self.channel);
        let end = format!(".{}.rec", self.instance);
        name.strip_prefix(&start)?.strip_suffix(&end)
    }

    /// Reads a header off the beginning of a file.
    ///
    /// # Errors
    /// When they are none.
    ///
    /// # Panics
    /// Never: the fields lie within the header.
    pub fn decode(path: &Path, bytes: &[u8]) -> Result<Self, RecordFileError> {
        let Some(header) = bytes.first_chunk::<HEADER_BYTES>() else {
            return Err(malformed(
                path,
                bytes.len(),
                "the file is shorter than its header",
            ));
        };
        if header[..8] != MAGIC[..] {
            return Err(malformed(path, 0, "not a record file"));
        }
        let word = |at: usize| u32::from_le_bytes(core::array::from_fn(|byte| header[at + byte]));
        let kind: RecordKind = bytemuck::checked::try_cast(word(8))
            .map_err(|_unknown| malformed(path, 8, "unknown record kind"))?;
        let record_bytes = word(12);
        let least = size_of::<Envelope>();
        let (fits, expected) = match kind.record_bytes() {
            Some(size) => (record_bytes as usize == size, format!("{size} bytes")),
            None => (
                record_bytes as usize >= least,
                format!("at least {least} bytes"),
            ),
        };
        if !fits {
            return Err(RecordFileError::OtherLayout {
                path: path.to_owned(),
                kind: kind.name(),
                found_bytes: record_bytes,
                expected,
            });
        }
        let name = header[32..].split(|byte| *byte == 0).next().unwrap_or(&[]);
        let channel = str::from_utf8(name)
            .map_err(|_utf8| malformed(path, 32, "the channel name is not UTF-8"))?
            .to_owned();
        Ok(Self {
            kind,
            channel,
            record_bytes,
            instance: word(16),
        })
    }
}

fn malformed(path: &Path, offset: usize, problem: &'static str) -> RecordFileError {
    RecordFileError::Malformed {
        path: path.to_owned(),
        offset,
        problem,
    }
}

/// How many bytes of `file` are header and whole or begun records, as it says now; `known` is what it said before,
/// or 0.
///
/// # Errors
/// When it cannot be read.
pub fn written_bytes(file: &File, known: u64) -> io::Result<u64> {
    let read = || {
        let mut end = [0; 8];
        match file.read_exact_at(&mut end, END_AT as u64) {
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Ok(0),
            read => read.map(|()| u64::from_le_bytes(end)),
        }
    };
    let before = file.metadata()?.len();
    let mut said = read()?;
    // Its writer stores it at once, and who reads it by the kernel may yet find a half of it.
    while said != 0 && said != known {
        let again = read()?;
        if again == said {
            break;
        }
        said = again;
    }
    // The writer says where they end before it makes room behind them, and 0 again after it has cut that off.
    let file_bytes = match said {
        0 => before.min(file.metadata()?.len()),
        _ => before,
    };
    Ok(end_of(said, file_bytes))
}

fn end_of(said: u64, file_bytes: u64) -> u64 {
    if said == 0 {
        file_bytes
    } else {
        said.min(file_bytes)
    }
}

/// A record file in memory.
#[derive(Debug)]
pub struct RecordFile {
    /// What the header says.
    pub header: RecordHeader,
    bytes: Vec<u8>,
    /// Bytes of an unfinished last record, left out.
    pub truncated_bytes: usize,
}

impl RecordFile {
    /// Reads a whole file.
    ///
    /// # Errors
    /// When it cannot be read or its header is not that of a record file.
    pub fn read(path: &Path) -> Result<Self, RecordFileError> {
        let bytes = plain_file::read(path).map_err(|source| RecordFileError::Io {
            path: path.to_owned(),
            source,
        })?;
        Self::from_bytes(path, bytes)
    }

    /// Reads a whole file that is in memory; `path` stands in what is said of it.
    ///
    /// # Errors
    /// When its header is not that of a record file.
    pub fn from_bytes(path: &Path, mut bytes: Vec<u8>) -> Result<Self, RecordFileError> {
        let header = RecordHeader::decode(path, &bytes)?;
        let said: [u8; 8] = core::array::from_fn(|byte| bytes[END_AT + byte]);
        let written = end_of(u64::from_le_bytes(said), bytes.len() as u64);
        let written = usize::try_from(written).unwrap_or(usize::MAX);
        bytes.truncate(written.max(HEADER_BYTES));
        let truncated_bytes = (bytes.len() - HEADER_BYTES) % header.record_bytes as usize;
        Ok(Self {
            header,
            bytes,
            truncated_bytes,
        })
    }

    /// The records as `T`; empty when `T` has another size.
    pub fn records<T: Pod>(&self) -> impl Iterator<Item = T> + '_ {
        self.raw()
            .filter_map(|bytes| bytemuck::try_pod_read_unaligned(bytes).ok())
    }

    /// The record with `index` in the order of the file as `T`; `None` beyond the last, and when
    /// `T` has another size.
    pub fn record<T: Pod>(&self, index: usize) -> Option<T> {
        let bytes = self.raw().nth(index)?;
        bytemuck::try_pod_read_unaligned(bytes).ok()
    }

    /// How many whole records there are.
    pub fn record_count(&self) -> usize {
        self.raw().len()
    }

    /// The message with `index` in the order of the file; `None` beyond the last, and when the
    /// file holds records of another kind.
    pub fn message(&self, index: usize) -> Option<(Envelope, &[u8])> {
        if self.header.kind != RecordKind::Message {
            return None;
        }
        let bytes = self.raw().nth(index)?;
        let (envelope, payload) = bytes.split_at(size_of::<Envelope>());
        Some((bytemuck::pod_read_unaligned(envelope), payload))
    }

    /// The messages, appended to a run log under the channel's name; nothing when the file holds
    /// records of another kind.
    pub fn append_messages(&self, log: &mut RunLog) {
        if self.header.kind != RecordKind::Message {
            return;
        }
        for bytes in self.raw() {
            let (envelope, payload) = bytes.split_at(size_of::<Envelope>());
            log.push(
                &self.header.channel,
                bytemuck::pod_read_unaligned(envelope),
                payload,
            );
        }
    }

    fn raw(&self) -> impl ExactSizeIterator<Item = &[u8]> {
        self.bytes[HEADER_BYTES..].chunks_exact(self.header.record_bytes as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Vec<u8> {
        let header = RecordHeader {
            kind: RecordKind::Published,
            channel: "arm/command".to_owned(),
            record_bytes: u32::try_from(size_of::<PublishedRecord>()).unwrap(),
            instance: 2,
        };
        let mut bytes = header.encode(Path::new("x")).unwrap().to_vec();
        for sequence in 0..3 {
            let record = PublishedRecord {
                sequence,
                published_ns: 9,
                epoch: 4,
                reserved: 0,
            };
            bytes.extend_from_slice(bytemuck::bytes_of(&record));
        }
        bytes
    }

    #[test]
    fn a_file_gives_back_its_header_and_records() {
        let file = RecordFile::from_bytes(Path::new("x"), sample()).unwrap();
        assert_eq!(file.header.channel, "arm/command");
        let sequence = |index| Some(file.record::<PublishedRecord>(index)?.sequence);
        assert_eq!([0, 2, 3].map(sequence), [Some(0), Some(2), None]);
        assert!(file.record::<u64>(0).is_none(), "another size");
        assert_eq!(
            file.header.file_name("robot"),
            "arm.command.published.robot.2.rec"
        );
        let sequences: Vec<u64> = file
            .records::<PublishedRecord>()
            .map(|record| record.sequence)
            .collect();
        assert_eq!(sequences, [0, 1, 2]);
    }

    #[test]
    fn a_file_cut_short_keeps_its_whole_records() {
        let mut bytes = sample();
        bytes.truncate(bytes.len() - 5);
        let file = RecordFile::from_bytes(Path::new("x"), bytes).unwrap();
        assert_eq!(file.records::<PublishedRecord>().count(), 2);
        assert_eq!(file.truncated_bytes, size_of::<PublishedRecord>() - 5);
    }

    #[test]
    fn a_file_of_another_layout_names_both_sizes_and_where_it_comes_from() {
        let mut bytes = sample();
        bytes[12] += 8;
        let error = RecordFile::from_bytes(Path::new("x"), bytes).unwrap_err();
        let size = size_of::<PublishedRecord>();
        let expected = format!(
            "record file x, byte 12: published records of {} bytes, where this program has {size} \
             bytes; written by another version of hil-runtime?",
            size + 8
        );
        assert_eq!(error.to_string(), expected);
        let mut bytes = sample();
        bytes[8] = 6;
        bytes[12..16].copy_from_slice(&1_u32.to_le_bytes());
        let error = RecordFile::from_bytes(Path::new("x"), bytes).unwrap_err();
        let text = error.to_string();
        assert!(
            text.contains("message records of 1 bytes, where this program has at least"),
            "{text}"
        );
    }
}
