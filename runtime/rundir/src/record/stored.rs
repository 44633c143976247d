//! Record files that are read when their records are asked for, piece by piece and as often as that is, so
//! that the records of a long run need not be in memory. What cannot be read is noted for the report.

use std::fs::{self, File};
use std::io::{self, BufReader, Read};
use std::path::{Path, PathBuf};
use std::slice;
use std::sync::{Arc, Mutex, PoisonError};

use bytemuck::Pod;
use hil_account::RecordSource;
use hil_core::message::Envelope;
use hil_core::run_log::{MessageReader, StoredMessages};

use super::file::{HEADER_BYTES, RecordFileError, RecordHeader, written_bytes};

/// Bytes read at a time.
const PIECE_BYTES: usize = 1 << 16;

/// What went wrong while record files were read, each file once.
#[derive(Debug, Clone, Default)]
pub struct ReadFaults(Arc<Mutex<Vec<String>>>);

impl ReadFaults {
    fn note(&self, path: &Path, source: io::Error) {
        let path = path.to_owned();
        let text = RecordFileError::Io { path, source }.to_string();
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if !known.contains(&text) {
            known.push(text);
        }
    }

    /// In words.
    pub fn texts(&self) -> Vec<String> {
        let known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        known.clone()
    }
}

/// One record file, as it was when it was opened first.
#[derive(Debug, Clone)]
pub struct StoredFile {
    path: PathBuf,
    /// What it says it holds.
    pub header: RecordHeader,
    /// Whole records in it.
    count: u64,
}

impl StoredFile {
    /// Reads the header.
    ///
    /// # Errors
    /// When the file cannot be read or its header is not that of a record file.
    pub fn open(path: &Path) -> Result<Self, RecordFileError> {
        let read = || -> io::Result<(Vec<u8>, u64)> {
            let mut start = Vec::new();
            let file = File::open(path)?;
            let bytes = written_bytes(&file, 0)?;
            file.take(HEADER_BYTES as u64).read_to_end(&mut start)?;
            Ok((start, bytes))
        };
        let (start, bytes) = read().map_err(|source| RecordFileError::Io {
            path: path.to_owned(),
            source,
        })?;
        let header = RecordHeader::decode(path, &start)?;
        let payload_bytes = bytes.saturating_sub(HEADER_BYTES as u64);
        Ok(Self {
            path: path.to_owned(),
            count: payload_bytes / u64::from(header.record_bytes),
            header,
        })
    }

    /// Whole records in it.
    #[cfg(test)]
    pub(super) fn record_count(&self) -> u64 {
        self.count
    }

    /// Past the header.
    fn records(&self) -> io::Result<BufReader<File>> {
        let mut file = BufReader::with_capacity(PIECE_BYTES, File::open(&self.path)?);
        file.read_exact(&mut [0; HEADER_BYTES])?;
        Ok(file)
    }
}

/// The record files of one kind and channel, one after the other.
#[derive(Debug, Clone, Default)]
pub struct StoredRecords {
    files: Vec<StoredFile>,
    faults: ReadFaults,
}

impl StoredRecords {
    /// None yet; what cannot be read later is noted in `faults`.
    pub fn new(faults: &ReadFaults) -> Self {
        Self {
            files: Vec::new(),
            faults: faults.clone(),
        }
    }

    /// Puts `file` behind the others.
    pub fn push(&mut self, file: StoredFile) {
        self.files.push(file);
    }

    /// Whole records in all files.
    pub fn record_count(&self) -> u64 {
        self.files.iter().map(|file| file.count).sum()
    }

    /// All records as `R`; none of files whose records have another size.
    pub fn records<R: Pod>(&self) -> impl Iterator<Item = R> + '_ {
        let mut pieces = Pieces::of(self);
        core::iter::from_fn(move || {
            let mut record = R::zeroed();
            let size = size_of::<R>();
            let is_read = pieces.read(&mut |file, reader| {
                if file.header.record_bytes as usize == size {
                    reader.read_exact(bytemuck::bytes_of_mut(&mut record))?;
                    return Ok(true);
                }
                Ok(false)
            });
            is_read.then_some(record)
        })
    }
}

impl<R: Pod + core::fmt::Debug> RecordSource<R> for StoredRecords {
    fn count(&self) -> u64 {
        self.record_count()
    }

    fn each(&self) -> Box<dyn Iterator<Item = R> + '_> {
        Box::new(self.records())
    }
}

impl StoredMessages for StoredRecords {
    fn count(&self) -> usize {
        usize::try_from(self.record_count()).unwrap_or(usize::MAX)
    }

    fn reader(&self) -> Box<dyn MessageReader + '_> {
        Box::new(Pieces::of(self))
    }
}

/// Reads the records of some files in order, a piece at a time.
struct Pieces<'a> {
    files: slice::Iter<'a, StoredFile>,
    /// The file under way and its records that are left.
    current: Option<(&'a StoredFile, BufReader<File>, u64)>,
    faults: &'a ReadFaults,
}

/// Takes a record from a file; false when it has none to offer.
type Take<'t> = &'t mut dyn FnMut(&StoredFile, &mut BufReader<File>) -> io::Result<bool>;

impl<'a> Pieces<'a> {
    fn of(records: &'a StoredRecords) -> Self {
        Self {
            files: records.files.iter(),
            current: None,
            faults: &records.faults,
        }
    }

    /// Lets `take` have the next record; false behind the last. A file that cannot be read on is left.
    fn read(&mut self, take: Take<'_>) -> bool {
        loop {
            if let Some((file, reader, left)) = &mut self.current
                && *left > 0
            {
                *left -= 1;
                match take(file, reader) {
                    Ok(true) => return true,
                    Ok(false) => {}
                    Err(error) => self.faults.note(&file.path, error),
                }
            }
            let Some(file) = self.files.next() else {
                self.current = None;
                return false;
            };
            match file.records() {
                Ok(reader) => self.current = Some((file, reader, file.count)),
                Err(error) => {
                    self.current = None;
                    self.faults.note(&file.path, error);
                }
            }
        }
    }
}

impl MessageReader for Pieces<'_> {
    fn next(&mut self, payload: &mut Vec<u8>) -> Option<Envelope> {
        let mut envelope = Envelope::default();
        let is_read = self.read(&mut |file, reader| {
            reader.read_exact(bytemuck::bytes_of_mut(&mut envelope))?;
            payload.resize(file.header.record_bytes as usize - size_of::<Envelope>(), 0);
            reader.read_exact(payload)?;
            Ok(true)
        });
        is_read.then_some(envelope)
    }
}

/// Puts record files in the order in which the starts of each process wrote them.
pub fn sort_by_start(paths: &mut [PathBuf]) {
    paths.sort_by_cached_key(|path| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let parts = name
            .strip_suffix(".rec")
            .and_then(|name| name.rsplit_once('.'))
            .and_then(|(start, instance)| Some((start.to_owned(), instance.parse().ok()?)));
        let unnumbered = (name.clone().into_owned(), 0_u32);
        parts.unwrap_or(unnumbered)
    });
}

/// Bytes of a file; 0 when it is not there.
pub fn file_bytes(path: &Path) -> u64 {
    fs::metadata(path).map_or(0, |file| file.len())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::RecordKind;
    use hil_core::record::PublishedRecord;
    use std::io::Write;
    use std::{env, process};

    fn write(folder: &Path, instance: u32, sequences: core::ops::Range<u64>) -> PathBuf {
        let header = RecordHeader {
            kind: RecordKind::Published,
            channel: "a/b".to_owned(),
            record_bytes: u32::try_from(size_of::<PublishedRecord>()).unwrap(),
            instance,
        };
        let (path, mut file) = header.create(folder, "robot").unwrap();
        for sequence in sequences {
            let record = PublishedRecord {
                sequence,
                published_ns: 5,
                epoch: instance,
                reserved: 0,
            };
            file.write_all(bytemuck::bytes_of(&record)).unwrap();
        }
        path
    }

    #[test]
    fn files_are_read_in_the_order_of_starts_and_what_vanishes_is_noted() {
        let folder = env::temp_dir().join(format!("hil-stored-{}", process::id()));
        fs::create_dir_all(&folder).unwrap();
        let mut paths: Vec<PathBuf> = [10, 9, 2]
            .map(|instance| write(&folder, instance, 0..u64::from(instance)))
            .to_vec();
        sort_by_start(&mut paths);
        let faults = ReadFaults::default();
        let mut records = StoredRecords::new(&faults);
        for path in &paths {
            records.push(StoredFile::open(path).unwrap());
        }
        let epochs = |records: &StoredRecords| -> Vec<u32> {
            let mut all: Vec<u32> = records
                .records()
                .map(|one: PublishedRecord| one.epoch)
                .collect();
            all.dedup();
            all
        };
        assert_eq!(epochs(&records), [2, 9, 10]);
        assert_eq!(records.record_count(), 21);
        assert_eq!(records.records::<u64>().count(), 0, "another size");
        assert_eq!(faults.texts(), Vec::<String>::new());
        let cut = fs::OpenOptions::new().write(true).open(&paths[0]).unwrap();
        cut.set_len(HEADER_BYTES as u64 + 30).unwrap();
        fs::remove_file(&paths[1]).unwrap();
        for _ in 0..2 {
            assert_eq!(epochs(&records), [2, 10]);
        }
        assert_eq!(faults.texts().len(), 2, "{:?}", faults.texts());
        fs::remove_dir_all(&folder).unwrap();
    }
}
