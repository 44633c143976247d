//! A file that is written by a thread of its own, through a bounded queue: whoever makes a recording of a
//! run that goes must not wait for a disk, for what is in shared memory does not wait either.

use std::fs::File;
use std::io::{self, Write};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};

/// Bytes handed over at a time, at most.
const BLOCK_BYTES: usize = 128 << 10;
/// Blocks that may wait: 64 MiB, or a disk that stands still for half a minute at 2 MiB/s. When they
/// all wait, so does the one who writes.
const BLOCKS_MAX: usize = 512;

type Failure = Arc<Mutex<Option<io::Error>>>;

/// The near end of a file.
#[derive(Debug)]
pub(crate) struct QueuedFile {
    /// `None` once the file is complete.
    blocks: Option<SyncSender<Vec<u8>>>,
    thread: Option<JoinHandle<File>>,
    failure: Failure,
    block: Vec<u8>,
    length: Arc<AtomicU64>,
}

impl QueuedFile {
    /// Writes to `file` from now on.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub(crate) fn new(file: File) -> io::Result<Self> {
        let (blocks, waiting) = sync_channel(BLOCKS_MAX);
        let failure = Failure::default();
        let far = Arc::clone(&failure);
        let builder = thread::Builder::new().name("disk".to_owned());
        let thread = builder.spawn(move || write_all(file, &waiting, &far))?;
        Ok(Self {
            blocks: Some(blocks),
            thread: Some(thread),
            failure,
            block: Vec::with_capacity(BLOCK_BYTES),
            length: Arc::default(),
        })
    }

    /// Its length so far, bytes, written or waiting; it grows with the file.
    pub(crate) fn length(&self) -> Arc<AtomicU64> {
        Arc::clone(&self.length)
    }

    /// Waits until everything is written, and written through to the disk.
    ///
    /// # Errors
    /// Why anything could not be written.
    pub(crate) fn finish(mut self) -> io::Result<()> {
        self.hand_over()?;
        drop(self.blocks.take());
        let file = self.join()?;
        self.check()?;
        file.sync_all()
    }

    fn join(&mut self) -> io::Result<File> {
        let thread = self.thread.take().map(JoinHandle::join);
        thread
            .and_then(Result::ok)
            .ok_or_else(|| io::Error::other("the thread that writes the file is gone"))
    }

    /// Passes a failure on, once.
    fn check(&self) -> io::Result<()> {
        let mut failure = self.failure.lock().unwrap_or_else(PoisonError::into_inner);
        failure.take().map_or(Ok(()), Err)
    }

    fn hand_over(&mut self) -> io::Result<()> {
        self.check()?;
        if self.block.is_empty() {
            return Ok(());
        }
        let block = core::mem::replace(&mut self.block, Vec::with_capacity(BLOCK_BYTES));
        let sent = self.blocks.as_ref().map(|blocks| blocks.send(block));
        if matches!(sent, Some(Ok(()))) {
            return Ok(());
        }
        self.check()?;
        Err(io::Error::other("the file is closed after a failure"))
    }
}

/// Writes what comes until nobody sends any more, or something cannot be written.
fn write_all(mut file: File, waiting: &Receiver<Vec<u8>>, failure: &Failure) -> File {
    for block in waiting {
        if let Err(error) = file.write_all(&block) {
            *failure.lock().unwrap_or_else(PoisonError::into_inner) = Some(error);
            return file;
        }
    }
    file
}

impl Write for QueuedFile {
    /// Takes what has room in the block.
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.block.len() >= BLOCK_BYTES {
            self.hand_over()?;
        }
        // No block is larger than another, however much comes at once: what waits is bounded.
        let count = bytes.len().min(BLOCK_BYTES - self.block.len());
        self.block.extend_from_slice(&bytes[..count]);
        self.length.fetch_add(count as u64, Ordering::Relaxed);
        Ok(count)
    }

    /// Hands over what there is; the disk may take its time.
    fn flush(&mut self) -> io::Result<()> {
        self.hand_over()
    }
}

impl Drop for QueuedFile {
    /// What was handed over is written, so that a recording that was given up can be recovered.
    fn drop(&mut self) {
        if self.thread.is_some() {
            let _is_handed_over = self.hand_over().is_ok();
            drop(self.blocks.take());
            let _is_joined = self.join().is_ok();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn everything_is_in_the_file_in_order() {
        let path = std::env::temp_dir().join(format!("hil-disk-{}", std::process::id()));
        let mut file = QueuedFile::new(File::create(&path).unwrap()).unwrap();
        let mut expected = Vec::new();
        for number in 0..100_000_u32 {
            file.write_all(&number.to_le_bytes()).unwrap();
            expected.extend_from_slice(&number.to_le_bytes());
        }
        let length = file.length().load(Ordering::Relaxed);
        assert_eq!(length, expected.len() as u64);
        file.write_all(&vec![7; 3 * BLOCK_BYTES]).unwrap();
        expected.resize(expected.len() + 3 * BLOCK_BYTES, 7);
        file.finish().unwrap();
        assert!(fs::read(&path).unwrap() == expected);
        fs::remove_file(path).unwrap();
    }

    #[test]
    fn no_more_than_a_block_is_taken_at_once() {
        let nowhere = File::options().write(true).open("/dev/null").unwrap();
        let mut file = QueuedFile::new(nowhere).unwrap();
        let much = vec![7_u8; 3 * BLOCK_BYTES];
        file.write_all(b"x").unwrap();
        assert_eq!(file.write(&much).unwrap(), BLOCK_BYTES - 1);
        assert_eq!(file.write(&much).unwrap(), BLOCK_BYTES);
        assert_eq!(file.block.len(), BLOCK_BYTES);
        let length = file.length().load(Ordering::Relaxed);
        assert_eq!(length, 2 * BLOCK_BYTES as u64);
    }

    #[test]
    fn a_full_disk_is_said() {
        let full = File::options().write(true).open("/dev/full").unwrap();
        let mut file = QueuedFile::new(full).unwrap();
        file.write_all(b"x").unwrap();
        let error = file.finish().unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::StorageFull);
    }
}
