//! Bounded rings between the measured threads and one writer thread. Pushing never blocks,
//! allocates or calls the system; a full ring drops the record and counts it.

use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use bytemuck::Pod;
use hil_core::message::Envelope;

use super::file::{RecordFileError, RecordHeader, RecordKind};
use super::growing::GrowingFile;
use crate::file_fault::FileFault;

/// How often the writer empties the rings: what a kill of the process can lose at most.
const FLUSH_PERIOD: Duration = Duration::from_millis(20);

/// No ring takes more memory than this, unless its records are enormous.
const RING_BYTES_MAX: usize = 8 << 20;
/// Fewer would not bridge the writer's period at a kilohertz.
const RING_RECORDS_MIN: usize = 64;

/// The producing end of one ring: lives in a measured thread.
#[derive(Debug)]
pub struct RecordSink {
    ring: rtrb::Producer<u8>,
    dropped: Arc<AtomicU64>,
}

impl RecordSink {
    /// Stores one record.
    pub fn push<T: Pod>(&mut self, record: &T) {
        let stored = self.ring.push_entire_slice(bytemuck::bytes_of(record));
        self.count_unless(stored.is_ok());
    }

    /// Stores one message: envelope and payload.
    pub fn push_message(&mut self, envelope: &Envelope, payload: &[u8]) {
        let envelope = bytemuck::bytes_of(envelope);
        // Only this end fills the ring, so free slots can only become more between the calls.
        let fits = self.ring.slots() >= envelope.len() + payload.len();
        let stored = fits
            && self.ring.push_entire_slice(envelope).is_ok()
            && self.ring.push_entire_slice(payload).is_ok();
        self.count_unless(stored);
    }

    fn count_unless(&mut self, is_stored: bool) {
        if !is_stored {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// The producing end of a ring whose records go to one file a channel: lives in a measured thread.
#[derive(Debug)]
pub struct SharedSink {
    ring: rtrb::Producer<u8>,
    dropped: Arc<AtomicU64>,
}

impl SharedSink {
    /// Stores one record of the channel with `index`.
    pub fn push<T: Pod>(&mut self, index: usize, record: &T) {
        let index = (index as u64).to_le_bytes();
        let record = bytemuck::bytes_of(record);
        // Not in one step: the other end takes whole entries only.
        let fits = self.ring.slots() >= index.len() + record.len();
        let stored = fits
            && self.ring.push_entire_slice(&index).is_ok()
            && self.ring.push_entire_slice(record).is_ok();
        if !stored {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// Entries of a shared ring whose room is freed together.
const ENTRIES_AT_ONCE: usize = 64;
/// Bytes of a channel's index before each record of a shared ring.
const INDEX_BYTES: usize = size_of::<u64>();

/// The writer's end of a ring.
#[derive(Debug)]
enum Drain {
    Single(SingleDrain),
    Shared(SharedDrain),
}

impl Drain {
    /// Writes what waits and calls `fail` for each file that does not take it: that file gets no more.
    fn flush(&mut self, fail: &mut dyn FnMut(FileFault)) {
        match self {
            Self::Single(drain) => drain.flush(fail),
            Self::Shared(drain) => drain.flush(fail),
        }
    }
}

/// All of it goes to one file, if that can still be written.
#[derive(Debug)]
struct SingleDrain {
    ring: rtrb::Consumer<u8>,
    file: Option<File>,
    path: PathBuf,
}

impl SingleDrain {
    fn flush(&mut self, fail: &mut dyn FnMut(FileFault)) {
        let Some(file) = &mut self.file else {
            return;
        };
        let waiting = self.ring.slots();
        let Ok(chunk) = self.ring.read_chunk(waiting) else {
            return;
        };
        let (first, second) = chunk.as_slices();
        match file.write_all(first).and_then(|()| file.write_all(second)) {
            Ok(()) => chunk.commit_all(),
            Err(error) => {
                self.file = None;
                fail(FileFault::new(&self.path, &error));
            }
        }
    }
}

/// Each record goes to the file of its channel.
#[derive(Debug)]
struct SharedDrain {
    ring: rtrb::Consumer<u8>,
    record_bytes: usize,
    /// One for each channel that can still be written.
    files: Vec<Option<GrowingFile>>,
    dropped: Arc<AtomicU64>,
}

impl SharedDrain {
    fn flush(&mut self, fail: &mut dyn FnMut(FileFault)) {
        let entry_bytes = INDEX_BYTES + self.record_bytes;
        let mut waiting_count = self.ring.slots() / entry_bytes;
        while waiting_count > 0 {
            // Their room is free again before the next are written, which a slow disk may hold up.
            let count = waiting_count.min(ENTRIES_AT_ONCE);
            waiting_count -= count;
            self.write(count * entry_bytes, fail);
        }
    }

    fn write(&mut self, bytes: usize, fail: &mut dyn FnMut(FileFault)) {
        let entry_bytes = INDEX_BYTES + self.record_bytes;
        let Ok(chunk) = self.ring.read_chunk(bytes) else {
            return;
        };
        // The ring is some whole entries long, so none lies across its end.
        let (first, second) = chunk.as_slices();
        let entries = [first, second].into_iter();
        for entry in entries.flat_map(|part| part.chunks_exact(entry_bytes)) {
            let (index, record) = entry.split_at(INDEX_BYTES);
            let index = u64::from_le_bytes(index.try_into().expect("it was split there"));
            let file = &mut self.files[usize::try_from(index).expect("it was one")];
            let is_written = file.as_mut().is_some_and(|file| {
                let appended = file.append(record);
                appended.map_err(&mut *fail).is_ok()
            });
            if !is_written {
                *file = None;
                self.dropped.fetch_add(1, Ordering::Relaxed);
            }
        }
        chunk.commit_all();
    }
}

/// What became of a recorder's files.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RecorderOutcome {
    /// Records dropped because a ring was full, or that were on their way to a file that failed.
    pub dropped_count: u64,
    /// Files that could not be written, in the order in which that was noticed: what was in them
    /// before is whole, and later records are in no file.
    pub failures: Vec<FileFault>,
    /// True when the writer's thread panicked.
    pub has_panicked: bool,
}

/// Owns the files of one process and the thread that writes them.
#[derive(Debug)]
pub struct Recorder {
    folder: PathBuf,
    writer: String,
    instance: u32,
    dropped: Arc<AtomicU64>,
    drains: Vec<Drain>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<Vec<FileFault>>>,
}

impl Recorder {
    /// A recorder for process `writer` below `folder`; opens nothing yet.
    pub fn new(folder: &Path, writer: &str, instance: u32) -> Self {
        Self {
            folder: folder.to_owned(),
            writer: writer.to_owned(),
            instance,
            dropped: Arc::new(AtomicU64::new(0)),
            drains: Vec::new(),
            stop: Arc::new(AtomicBool::new(false)),
            thread: None,
        }
    }

    /// A sink without a file, for records that a thread of its kind may make and this one does not:
    /// every one would count as dropped.
    pub fn closed_sink(&self) -> RecordSink {
        let (ring, _nobody) = rtrb::RingBuffer::new(0);
        RecordSink {
            ring,
            dropped: Arc::clone(&self.dropped),
        }
    }

    /// Opens the file for `kind` records of `channel` and a ring of `capacity_records`, or of
    /// as many as 8 MiB hold. Call
    /// before [`Recorder::start`].
    ///
    /// # Errors
    /// When the file cannot be created.
    ///
    /// # Panics
    /// When a record is 4 GiB long.
    pub fn sink(
        &mut self,
        kind: RecordKind,
        channel: &str,
        record_bytes: usize,
        capacity_records: usize,
    ) -> Result<RecordSink, RecordFileError> {
        let (path, file) = self.create(kind, channel, record_bytes)?;
        let (producer, ring) = rtrb::RingBuffer::new(ring_bytes(record_bytes, capacity_records));
        self.drains.push(Drain::Single(SingleDrain {
            ring,
            file: Some(file),
            path,
        }));
        Ok(RecordSink {
            ring: producer,
            dropped: Arc::clone(&self.dropped),
        })
    }

    /// As [`Recorder::sink`], with a file for each of `channels` and one ring for all.
    ///
    /// # Errors
    /// As [`Recorder::sink`].
    ///
    /// # Panics
    /// As [`Recorder::sink`].
    pub fn shared_sink<'a>(
        &mut self,
        kind: RecordKind,
        channels: impl Iterator<Item = &'a str>,
        record_bytes: usize,
        capacity_records: usize,
    ) -> Result<SharedSink, RecordFileError> {
        let mut files = Vec::new();
        for channel in channels {
            let (path, file) = self.create(kind, channel, record_bytes)?;
            files.push(Some(GrowingFile::new(path, file)?));
        }
        let entry_bytes = INDEX_BYTES + record_bytes;
        let (producer, ring) = in_memory(ring_bytes(entry_bytes, capacity_records));
        self.drains.push(Drain::Shared(SharedDrain {
            ring,
            record_bytes,
            files,
            dropped: Arc::clone(&self.dropped),
        }));
        Ok(SharedSink {
            ring: producer,
            dropped: Arc::clone(&self.dropped),
        })
    }

    fn create(
        &self,
        kind: RecordKind,
        channel: &str,
        record_bytes: usize,
    ) -> Result<(PathBuf, File), RecordFileError> {
        let header = RecordHeader {
            kind,
            channel: channel.to_owned(),
            record_bytes: u32::try_from(record_bytes).expect("records are small"),
            instance: self.instance,
        };
        header.create(&self.folder, &self.writer)
    }

    /// Starts the writer thread. Call from a thread of normal priority: the writer inherits it.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(&mut self) -> io::Result<()> {
        self.start_and_tell(|_fault| ())
    }

    /// As [`Recorder::start`]; `on_failure` is called from the writer thread when a first file can no
    /// longer be written, so that a run does not go on for hours without its account.
    ///
    /// # Errors
    /// As [`Recorder::start`].
    pub fn start_and_tell(
        &mut self,
        on_failure: impl Fn(&FileFault) + Send + 'static,
    ) -> io::Result<()> {
        let mut drains = core::mem::take(&mut self.drains);
        let stop = Arc::clone(&self.stop);
        let builder = thread::Builder::new().name("recorder".to_owned());
        self.thread = Some(builder.spawn(move || {
            let mut failures = Vec::new();
            loop {
                let is_last = stop.load(Ordering::Acquire);
                for drain in &mut drains {
                    drain.flush(&mut |fault| {
                        if failures.is_empty() {
                            on_failure(&fault);
                        }
                        failures.push(fault);
                    });
                }
                if is_last {
                    return failures;
                }
                thread::sleep(FLUSH_PERIOD);
            }
        })?);
        Ok(())
    }

    /// Records dropped so far.
    pub fn dropped_count(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    /// Writes what is left and ends the writer thread.
    pub fn finish(mut self) -> RecorderOutcome {
        self.stop.store(true, Ordering::Release);
        let ended = self.thread.take().map(JoinHandle::join).transpose();
        RecorderOutcome {
            dropped_count: self.dropped_count(),
            has_panicked: ended.is_err(),
            failures: ended.ok().flatten().unwrap_or_default(),
        }
    }
}

/// A ring whose pages are all in memory: a first touch in the measured thread would cost it a page fault.
fn in_memory(bytes: usize) -> (rtrb::Producer<u8>, rtrb::Consumer<u8>) {
    let (mut producer, mut consumer) = rtrb::RingBuffer::new(bytes);
    if let Ok(chunk) = producer.write_chunk(bytes) {
        chunk.commit_all();
    }
    if let Ok(chunk) = consumer.read_chunk(bytes) {
        chunk.commit_all();
    }
    (producer, consumer)
}

/// Of a ring for so many entries, or for as many as [`RING_BYTES_MAX`] holds.
fn ring_bytes(entry_bytes: usize, capacity: usize) -> usize {
    let bounded = capacity.min(RING_BYTES_MAX / entry_bytes);
    entry_bytes * bounded.max(RING_RECORDS_MIN)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::RecordFile;
    use hil_core::record::PublishedRecord;
    use std::{env, fs, process};

    fn record(sequence: u64) -> PublishedRecord {
        PublishedRecord {
            sequence,
            published_ns: 1,
            epoch: 0,
            reserved: 0,
        }
    }

    #[test]
    fn a_closed_sink_leaves_no_file_and_counts_what_it_is_given() {
        let folder = env::temp_dir().join(format!("hil-closed-{}", process::id()));
        fs::create_dir_all(&folder).unwrap();
        let mut recorder = Recorder::new(&folder, "clock", 0);
        let mut sink = recorder.closed_sink();
        recorder.start().unwrap();
        sink.push(&record(0));
        sink.push(&record(1));
        assert_eq!(recorder.finish().dropped_count, 2);
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 0);
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn a_file_that_cannot_be_written_is_told_at_once_and_named() {
        // The one device of every Linux that takes nothing.
        let (mut ring, drained) = rtrb::RingBuffer::new(64);
        ring.push(1).unwrap();
        let path = PathBuf::from("/dev/full");
        let file = File::options().write(true).open(&path).unwrap();
        let mut recorder = Recorder::new(&env::temp_dir(), "robot", 0);
        recorder.drains.push(Drain::Single(SingleDrain {
            ring: drained,
            file: Some(file),
            path,
        }));
        let (teller, told) = std::sync::mpsc::channel();
        let tell = move |fault: &FileFault| teller.send(fault.clone()).unwrap();
        recorder.start_and_tell(tell).unwrap();
        let first = told.recv().unwrap();
        assert_eq!(
            first.to_string(),
            "/dev/full: No space left on device (os error 28)"
        );
        let outcome = recorder.finish();
        assert_eq!(outcome.failures, [first]);
        assert!(told.recv().is_err(), "told once");
    }

    #[test]
    fn records_of_a_shared_ring_are_in_the_files_of_their_channels() {
        let folder = env::temp_dir().join(format!("hil-shared-{}", process::id()));
        fs::create_dir_all(&folder).unwrap();
        let mut recorder = Recorder::new(&folder, "robot", 0);
        let size = size_of::<PublishedRecord>();
        let names = ["a", "b", "full"].into_iter();
        let mut sink = recorder
            .shared_sink(RecordKind::Published, names, size, 100)
            .unwrap();
        let Some(Drain::Shared(drain)) = recorder.drains.last_mut() else {
            panic!("it was made last");
        };
        drain.files[2] = Some(GrowingFile::full());
        // Over the end of the ring more than once, and each time more than it holds.
        let mut fail_count = 0;
        for round in 0..5 {
            for sequence in 0..102 {
                let index = usize::try_from(sequence % 3).unwrap();
                sink.push(index, &record(round * 1_000 + sequence));
            }
            drain.flush(&mut |_| fail_count += 1);
        }
        assert_eq!(fail_count, 1, "the full one is tried no more");
        let outcome = recorder.finish();
        // Two of each round did not fit, and 33 had no file.
        assert_eq!(outcome.dropped_count, 5 * 35);
        for (index, name) in (0..).zip(["a", "b"]) {
            let file = RecordFile::read(&folder.join(format!("{name}.published.robot.0.rec")));
            let read: Vec<PublishedRecord> = file.unwrap().records().collect();
            let expected = (0..5).flat_map(|round| {
                let own = (0..100).filter(move |sequence| sequence % 3 == index);
                own.map(move |sequence| record(round * 1_000 + sequence))
            });
            assert_eq!(read, expected.collect::<Vec<_>>());
        }
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn what_was_pushed_is_in_the_file_and_what_did_not_fit_is_counted() {
        let folder = env::temp_dir().join(format!("hil-ring-{}", process::id()));
        fs::create_dir_all(&folder).unwrap();
        let mut recorder = Recorder::new(&folder, "robot", 0);
        let size = size_of::<PublishedRecord>();
        let mut sink = recorder
            .sink(RecordKind::Published, "a/b", size, 100)
            .unwrap();
        for sequence in 0..130 {
            sink.push(&record(sequence));
        }
        recorder.start().unwrap();
        let outcome = recorder.finish();
        assert_eq!(
            outcome,
            RecorderOutcome {
                dropped_count: 30,
                ..RecorderOutcome::default()
            }
        );
        let file = RecordFile::read(&folder.join("a.b.published.robot.0.rec")).unwrap();
        let read: Vec<PublishedRecord> = file.records().collect();
        assert_eq!(read, (0..100).map(record).collect::<Vec<_>>());
        fs::remove_dir_all(&folder).unwrap();
    }
}
