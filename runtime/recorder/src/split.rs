//! A live recording as one file or several, each whole by itself: topics and schemas are repeated in
//! each, and what a kill leaves can be recovered up to the last flush.

use std::collections::{BTreeMap, VecDeque};
use std::fs;
use std::panic::resume_unwind;
use std::path::{Path, PathBuf};
use std::thread::{self, JoinHandle};

use crate::schema::Schema;
use crate::sink::{Sink, Topic};
use crate::writer::{Recording, Stamp, WriteError, check_folder, check_live_target, check_target};

/// Files that may be on their way to the disk beside the open one: each has a queue of its own in
/// memory.
const CLOSING_MAX: usize = 2;
/// Names that are tried for one file.
const NUMBERS_MAX: usize = 10_000;

/// The first file of a recording called `target`, which may be split.
fn first(target: &Path, split_bytes: Option<u64>) -> PathBuf {
    if split_bytes.is_some() {
        numbered(target, 1)
    } else {
        target.to_owned()
    }
}

/// True when `output` means a folder, whose files get the names of their runs: it is one, or it ends
/// in `/`.
fn is_folder(output: &Path) -> bool {
    output.is_dir() || output.as_os_str().as_encoded_bytes().ends_with(b"/")
}

/// The file for a run: the one named, or one with the run's name in the folder named.
pub(crate) fn target(output: &Path, run: &str) -> PathBuf {
    if is_folder(output) {
        output.join(format!("{run}.mcap"))
    } else {
        output.to_owned()
    }
}

/// Where the `number`th recording of one server goes, from 1: to `output` itself, or beside it under a
/// name with the first number that is free there. In a folder each run has its own name anyway.
pub(crate) fn another(output: &Path, number: usize) -> PathBuf {
    if is_folder(output) || number <= 1 {
        return output.to_owned();
    }
    let is_free = |path: &PathBuf| check_live_target(path, false).is_ok();
    let mut names = (number..).map(|number| suffixed(output, &format!("-{number}")));
    // Where none can be written, the recording says why.
    let found = names.by_ref().take(NUMBERS_MAX).find(is_free);
    found.unwrap_or_else(|| output.to_owned())
}

/// Says that a recording may go to `output` before anything is waited for, and makes the folder that
/// it names with `/` at its end.
///
/// # Errors
/// When it may not, in the words that the recording itself would end with.
pub(crate) fn prepare(
    output: &Path,
    split_bytes: Option<u64>,
    may_replace: bool,
) -> Result<(), WriteError> {
    if !is_folder(output) {
        return check_live_target(&first(output, split_bytes), may_replace);
    }
    fs::create_dir_all(output).map_err(|source| WriteError::Io {
        path: output.to_owned(),
        source,
    })?;
    check_folder(output, output)
}

/// Files on their way to the disk, which takes its time; oldest first. None of them is left alone:
/// when the process ended before them, they would not be whole.
#[derive(Debug, Default)]
struct Closing {
    files: VecDeque<JoinHandle<Result<u64, WriteError>>>,
    /// Messages in those that have arrived.
    written_count: u64,
}

impl Closing {
    /// Waits for all, whatever became of one; how many messages they hold, or the first failure.
    fn join_all(&mut self) -> Result<u64, WriteError> {
        let mut first = Ok(());
        while !self.files.is_empty() {
            let joined = self.join_oldest();
            first = first.and(joined);
        }
        first.map(|()| self.written_count)
    }

    fn join_oldest(&mut self) -> Result<(), WriteError> {
        if let Some(file) = self.files.pop_front() {
            let closed = file.join();
            self.written_count += closed.unwrap_or_else(|panic| resume_unwind(panic))?;
        }
        Ok(())
    }
}

impl Drop for Closing {
    /// After a failure elsewhere, which is what is said then.
    fn drop(&mut self) {
        for file in self.files.drain(..) {
            let _is_joined = file.join().is_ok();
        }
    }
}

/// Files of one recording, one open at a time.
pub(crate) struct Files {
    target: PathBuf,
    split_bytes: Option<u64>,
    may_replace: bool,
    open: Recording,
    /// Each is in the file that is open once a message of it has come.
    topics: Vec<Topic>,
    done: Vec<PathBuf>,
    done_bytes: u64,
    closing: Closing,
}

/// Where the `number`th file of a recording that is split goes: before the extension.
fn numbered(target: &Path, number: usize) -> PathBuf {
    suffixed(target, &format!("_{number:04}"))
}

/// The path with `suffix` before its extension.
fn suffixed(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.file_stem().unwrap_or_default().to_owned();
    name.push(suffix);
    if let Some(extension) = path.extension() {
        name.push(".");
        name.push(extension);
    }
    path.with_file_name(name)
}

impl Files {
    /// Begins the first file; `target` is its name, or what the names of several begin with.
    ///
    /// # Errors
    /// When it exists and may not be replaced, or cannot be written.
    pub(crate) fn begin(
        target: &Path,
        split_bytes: Option<u64>,
        may_replace: bool,
    ) -> Result<Self, WriteError> {
        let first = first(target, split_bytes);
        check_target(&first, Path::new(""), may_replace)?;
        Ok(Self {
            target: target.to_owned(),
            split_bytes,
            may_replace,
            open: Recording::create_live(&first)?,
            topics: Vec::new(),
            done: Vec::new(),
            done_bytes: 0,
            closing: Closing::default(),
        })
    }

    /// The file that is open, for metadata.
    pub(crate) fn open(&mut self) -> &mut Recording {
        &mut self.open
    }

    /// Puts everything so far within reach of `recover`; true when it is time for another file.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub(crate) fn flush(&mut self) -> Result<bool, WriteError> {
        self.open.flush()?;
        let size_bytes = self.open.size_bytes();
        let is_large = self.split_bytes.is_some_and(|most| size_bytes >= most);
        // A file without a message would say nothing that the next one does not.
        Ok(is_large && self.open.message_count() > 0)
    }

    /// Begins the next file and completes the one that was open meanwhile; waits when the disk is
    /// more than so many files behind.
    ///
    /// # Errors
    /// When the next cannot be begun, or one of those before was not completed; how the others
    /// ended is said by [`Self::finish`].
    pub(crate) fn next(&mut self) -> Result<(), WriteError> {
        while self.closing.files.len() >= CLOSING_MAX {
            self.closing.join_oldest()?;
        }
        let path = numbered(&self.target, self.done.len() + 2);
        check_target(&path, Path::new(""), self.may_replace)?;
        let next = Recording::create_live(&path)?;
        let finished = core::mem::replace(&mut self.open, next);
        self.done_bytes += finished.size_bytes();
        self.done.push(finished.path().to_owned());
        let closing = thread::spawn(move || finished.finish());
        self.closing.files.push_back(closing);
        for topic in &mut self.topics {
            topic.forget();
        }
        Ok(())
    }

    /// Completes the open file and waits for those before; the paths of all, and how many messages
    /// they hold.
    ///
    /// # Errors
    /// When one cannot be written; the others are complete then.
    pub(crate) fn finish(mut self) -> Result<(Vec<PathBuf>, u64), WriteError> {
        let last = self.open.path().to_owned();
        // Both before either failure is said.
        let last_count = self.open.finish();
        let earlier_count = self.closing.join_all();
        let written_count = earlier_count? + last_count?;
        self.done.push(last);
        Ok((self.done, written_count))
    }

    /// Bytes of all files so far, as of the last flush.
    pub(crate) fn size_bytes(&self) -> u64 {
        self.done_bytes + self.open.size_bytes()
    }

    /// Topics of all files.
    pub(crate) fn topic_count(&self) -> usize {
        self.topics.len()
    }

    /// Number of the open file, from 1.
    pub(crate) fn number(&self) -> usize {
        self.done.len() + 1
    }
}

impl Sink for Files {
    type Error = WriteError;

    /// The number stays the same for all files of the recording.
    fn add_topic(
        &mut self,
        topic: &str,
        schema: &Schema,
        metadata: &BTreeMap<String, String>,
    ) -> Result<u16, WriteError> {
        let number = u16::try_from(self.topics.len()).map_err(|_many| self.open.full())?;
        let topic = Topic::with_metadata(topic.to_owned(), schema.clone(), metadata.clone());
        self.topics.push(topic);
        Ok(number)
    }

    fn write(&mut self, topic: u16, at: Stamp, data: &[u8]) -> Result<(), WriteError> {
        self.topics[usize::from(topic)].write(&mut self.open, at, data)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schema;
    use std::fs;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::time::Duration;

    #[test]
    fn each_run_of_a_server_gets_a_file_of_its_own() {
        let folder = std::env::temp_dir().join(format!("hil-another-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let file = folder.join("a.mcap");
        assert_eq!(another(&file, 1), file);
        assert_eq!(another(&file, 2), folder.join("a-2.mcap"));
        fs::write(folder.join("a-2.mcap"), "taken").unwrap();
        fs::write(folder.join("a-3.mcap.partial"), "left").unwrap();
        assert_eq!(another(&file, 2), folder.join("a-4.mcap"));
        assert_eq!(another(&folder, 7), folder);
        assert_eq!(another(&folder.join("a"), 7), folder.join("a-7"));
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn every_file_of_a_split_recording_is_whole_by_itself() {
        let folder = std::env::temp_dir().join(format!("hil-split-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let split = Some(1);
        let mut files = Files::begin(&folder.join("a.mcap"), split, false).unwrap();
        let nothing = BTreeMap::new();
        let topic = files.add_topic("/a", &schema::opaque(), &nothing).unwrap();
        for number in 0..5 {
            if number > 0 {
                assert!(files.flush().unwrap());
                files.next().unwrap();
                assert!(files.closing.files.len() <= CLOSING_MAX);
            }
            files.write(topic, Stamp::new(5, number), b"x").unwrap();
        }
        let (paths, count) = files.finish().unwrap();
        let names: Vec<_> = paths.iter().filter_map(|path| path.file_name()).collect();
        let expected = [1, 2, 3, 4, 5].map(|number| format!("a_000{number}.mcap"));
        assert_eq!(names, expected.each_ref().map(String::as_str));
        assert_eq!((fs::read_dir(&folder).unwrap().count(), count), (5, 5));
        for path in &paths {
            let bytes = fs::read(path).unwrap();
            let mut messages = mcap::MessageStream::new(&bytes).unwrap();
            assert_eq!(messages.next().unwrap().unwrap().channel.topic, "/a");
            assert!(messages.next().is_none());
        }
        let taken = prepare(&folder.join("a.mcap"), split, false);
        assert!(matches!(taken, Err(WriteError::Exists { .. })));
        prepare(&folder.join("a.mcap"), split, true).unwrap();
        // A name that is taken ends it, and what is open is kept beside it.
        assert!(matches!(
            Files::begin(&folder.join("a.mcap"), split, false).map(|_| ()),
            Err(WriteError::Exists { .. })
        ));
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn where_a_recording_goes_is_looked_at_before_there_is_one() {
        let folder = std::env::temp_dir().join(format!("hil-prepare-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let one = None;
        let named = |name: &str| folder.join(name);
        // Only `/` at the end says that what is not there is to be a folder.
        let absent = named("new/deep/");
        prepare(&absent, one, false).unwrap();
        assert!(absent.is_dir());
        assert_eq!(target(&absent, "run-1"), named("new/deep/run-1.mcap"));
        assert_eq!(
            target(&named("new/deep"), "run-1"),
            named("new/deep/run-1.mcap")
        );
        assert_eq!(target(&named("file"), "run-1"), named("file"));
        prepare(&named("file"), one, false).unwrap();
        assert!(!named("file").exists());
        let nowhere = prepare(&named("none/a.mcap"), one, false).unwrap_err();
        assert!(
            nowhere.to_string().contains("none/a.mcap: No such file"),
            "{nowhere}"
        );
        fs::write(named("a.mcap"), "").unwrap();
        let words = |name: &str| prepare(&named(name), one, false).unwrap_err().to_string();
        assert!(words("a.mcap").contains("exists already; --force"));
        assert!(
            words("a.mcap/").contains("cannot write"),
            "{}",
            words("a.mcap/")
        );
        assert!(
            words("a.mcap/b").contains("cannot write"),
            "{}",
            words("a.mcap/b")
        );
        prepare(&named("a.mcap"), one, true).unwrap();
        fs::write(named("b.mcap.partial"), "").unwrap();
        assert!(words("b.mcap").contains("recover"), "{}", words("b.mcap"));
        fs::remove_dir_all(folder).unwrap();
    }

    /// A file that takes a while to close, and then says so.
    fn slow(is_closed: &Arc<AtomicBool>) -> JoinHandle<Result<u64, WriteError>> {
        let is_closed = Arc::clone(is_closed);
        thread::spawn(move || {
            thread::sleep(Duration::from_millis(50));
            is_closed.store(true, Ordering::Relaxed);
            Ok(1)
        })
    }

    #[test]
    fn every_file_is_waited_for_whatever_became_of_another() {
        let is_closed = Arc::new(AtomicBool::new(false));
        let mut closing = Closing::default();
        let path = PathBuf::from("a.mcap");
        let failed = thread::spawn(move || Err(WriteError::Exists { path }));
        closing.files.extend([failed, slow(&is_closed)]);
        assert!(matches!(closing.join_all(), Err(WriteError::Exists { .. })));
        assert!(is_closed.load(Ordering::Relaxed));
        let is_closed = Arc::new(AtomicBool::new(false));
        let mut closing = Closing::default();
        closing.files.push_back(slow(&is_closed));
        drop(closing);
        assert!(is_closed.load(Ordering::Relaxed));
    }
}
