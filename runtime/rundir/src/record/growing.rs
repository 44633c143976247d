//! A record file while it grows. Records of many channels come one at a time, each for another file: written
//! through memory they need no call of the kernel each, and still survive a kill of the process.

use std::fs::File;
use std::io::{self, Write};
use std::os::unix::fs::FileExt;
use std::path::PathBuf;

use hil_platform::file_window::{FileWindow, keeps_its_room};

use super::file::{END_AT, HEADER_BYTES, RecordFileError};
use crate::file_fault::FileFault;

/// Bytes of a file that are in memory for its next records: two pages, of which the first may be begun.
const WINDOW_BYTES: u64 = 2 * PAGE_BYTES;
const PAGE_BYTES: u64 = 4096;

/// Memory that a file takes while it grows.
pub const GROWING_FILE_BYTES: u64 = PAGE_BYTES + WINDOW_BYTES;

/// A record file and the end of its records.
#[derive(Debug)]
pub(super) struct GrowingFile {
    file: File,
    path: PathBuf,
    /// `None` where the records are written by the kernel.
    windows: Option<Windows>,
}

/// The two places of a file that are written: its header, which says where the records end, and the records.
/// Behind them the file is zero as far as room was made.
#[derive(Debug)]
struct Windows {
    header: FileWindow,
    records: FileWindow,
    /// Of the first byte in `records`.
    offset: u64,
    /// Of the first byte behind the last record.
    end: u64,
    /// Of the first byte behind the room that was made.
    room_end: u64,
}

impl Windows {
    /// Of `file`, which holds its header only.
    fn new(file: &File) -> io::Result<Self> {
        let end = HEADER_BYTES as u64;
        let mut header = FileWindow::new(file, 0, HEADER_BYTES)?;
        header.publish(END_AT, end);
        let mut room_end = end;
        let records = next_window(file, end, 0, &mut room_end)?;
        Ok(Self {
            header,
            records,
            offset: end,
            end,
            room_end,
        })
    }

    fn append(&mut self, file: &File, record: &[u8]) -> io::Result<()> {
        let bytes = record.len() as u64;
        if self.end + bytes > self.room_end {
            self.records = next_window(file, self.end, bytes, &mut self.room_end)?;
            self.offset = self.end;
        }
        let at = usize::try_from(self.end - self.offset).expect("it is in memory");
        self.records.write(at, record);
        self.end += bytes;
        self.header.publish(END_AT, self.end);
        Ok(())
    }
}

/// The window behind `end` with room for `bytes` or more, up to the end of a page.
fn next_window(file: &File, end: u64, bytes: u64, room_end: &mut u64) -> io::Result<FileWindow> {
    let until = (end + bytes).max(end - end % PAGE_BYTES + WINDOW_BYTES);
    let length = |bytes| usize::try_from(bytes).map_err(io::Error::other);
    // The file system refuses here what it has no room for, and not when the page is written.
    file.write_all_at(&vec![0; length(until - *room_end)?], *room_end)?;
    *room_end = until;
    FileWindow::new(file, end, length(until - end)?)
}

impl GrowingFile {
    /// `file` at `path`, which holds its header only. It is written through memory where the file system
    /// keeps a page's room.
    ///
    /// # Errors
    /// When there is no room for its first records.
    pub(super) fn new(path: PathBuf, file: File) -> Result<Self, RecordFileError> {
        let windows = keeps_its_room(&file).then(|| Windows::new(&file));
        match windows.transpose() {
            Ok(windows) => Ok(Self {
                file,
                path,
                windows,
            }),
            Err(source) => Err(RecordFileError::Io { path, source }),
        }
    }

    /// The one device of every Linux that takes nothing.
    #[cfg(test)]
    pub(super) fn full() -> Self {
        let path = PathBuf::from("/dev/full");
        Self {
            file: File::options().write(true).open(&path).unwrap(),
            path,
            windows: None,
        }
    }

    /// Puts one record behind the others.
    pub(super) fn append(&mut self, record: &[u8]) -> Result<(), FileFault> {
        let appended = match &mut self.windows {
            Some(windows) => windows.append(&self.file, record),
            None => self.file.write_all(record),
        };
        appended.map_err(|error| FileFault::new(&self.path, &error))
    }
}

impl Drop for GrowingFile {
    /// Cuts off the room behind the records; where that fails the header still says where they end.
    fn drop(&mut self) {
        if let Some(windows) = &mut self.windows
            && self.file.set_len(windows.end).is_ok()
        {
            windows.header.publish(END_AT, 0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::file::{RecordFile, RecordHeader, RecordKind, written_bytes};
    use crate::record::stored::StoredFile;
    use hil_core::record::PublishedRecord;
    use std::{env, fs, process};

    fn header() -> RecordHeader {
        RecordHeader {
            kind: RecordKind::Published,
            channel: "a/b".to_owned(),
            record_bytes: u32::try_from(size_of::<PublishedRecord>()).unwrap(),
            instance: 0,
        }
    }

    fn record(sequence: u64) -> PublishedRecord {
        PublishedRecord {
            sequence,
            published_ns: 1,
            epoch: 0,
            reserved: 0,
        }
    }

    /// In shared memory, whose file system keeps its room wherever the tests run.
    fn growing(name: &str) -> (GrowingFile, PathBuf) {
        let folder = PathBuf::from(format!("/dev/shm/hil-growing-{name}-{}", process::id()));
        fs::create_dir_all(&folder).unwrap();
        let (path, file) = header().create(&folder, "robot").unwrap();
        (GrowingFile::new(path, file).unwrap(), folder)
    }

    fn sequences(bytes: Vec<u8>) -> Vec<u64> {
        let file = RecordFile::from_bytes(&env::temp_dir(), bytes).unwrap();
        let records = file.records::<PublishedRecord>();
        records.map(|one| one.sequence).collect()
    }

    #[test]
    fn each_record_is_in_the_file_at_once_and_nothing_else_at_its_end() {
        let (mut file, folder) = growing("each");
        for count in 0..2_000 {
            let read = fs::read(&file.path).unwrap();
            let end = HEADER_BYTES as u64 + count * size_of::<PublishedRecord>() as u64;
            assert_eq!(written_bytes(&file.file, 0).unwrap(), end);
            // As long as a file that a kill of its writer leaves.
            assert!(read.len() as u64 >= end && read.len() as u64 <= end + WINDOW_BYTES);
            if count % 97 == 0 {
                assert_eq!(sequences(read), (0..count).collect::<Vec<_>>());
                let stored = StoredFile::open(&file.path);
                assert_eq!(stored.unwrap().record_count(), count);
            }
            file.append(bytemuck::bytes_of(&record(count))).unwrap();
        }
        let path = file.path.clone();
        drop(file);
        let mut whole = header().encode(&path).unwrap().to_vec();
        for count in 0..2_000 {
            whole.extend_from_slice(bytemuck::bytes_of(&record(count)));
        }
        assert!(fs::read(&path).unwrap() == whole);
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn an_end_beyond_the_file_is_the_end_of_the_file() {
        let (mut file, folder) = growing("beyond");
        for count in 0..3 {
            file.append(bytemuck::bytes_of(&record(count))).unwrap();
        }
        let mut bytes = fs::read(&file.path).unwrap();
        bytes[END_AT..END_AT + 8].copy_from_slice(&u64::MAX.to_le_bytes());
        bytes.truncate(HEADER_BYTES + 2 * size_of::<PublishedRecord>());
        assert_eq!(sequences(bytes.clone()), [0, 1]);
        bytes[END_AT..END_AT + 8].copy_from_slice(&1_u64.to_le_bytes());
        assert_eq!(sequences(bytes), Vec::<u64>::new());
        fs::remove_dir_all(&folder).unwrap();
    }
}
