//! One recording on its way into a file: topics, messages, metadata. The file appears under its name
//! only when it is whole; until then it lies beside it, and goes when the work is given up.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::{io, process};

use hil_platform::plain_file;
use mcap::records::{MessageHeader, Metadata};
use mcap::write::NoSeek;
use mcap::{Attachment, Compression, McapError, WriteOptions, Writer};
use nix::unistd::{AccessFlags, access};

use crate::disk::QueuedFile;
use crate::failure::Failure;
use crate::schema::Schema;
use crate::sink::Sink;

/// Messages of about this size are compressed together. The smaller, the less is lost when a file
/// is damaged; the larger, the better they compress.
const CHUNK_BYTES: u64 = 1 << 20;

/// Why nothing could be written.
#[derive(Debug, thiserror::Error)]
pub(crate) enum WriteError {
    /// There is something already.
    #[error("{path} exists already; --force replaces it")]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// Another recorder writes it, or a killed one left it.
    #[error(
        "{path} is there: unless a recorder still writes it, `hil-recorder recover` makes a whole \
         file of it; then remove it"
    )]
    Unfinished {
        /// The file.
        path: PathBuf,
    },
    /// What is to be read would be replaced.
    #[error("{path} is what is read; give the result another name")]
    IsInput {
        /// The file.
        path: PathBuf,
    },
    /// No room, no right, no folder.
    #[error("cannot write {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The file is whole, but its place is not to be had.
    #[error("cannot write {path}: {source}; the recording is whole and in {partial}")]
    Unplaced {
        /// The file.
        path: PathBuf,
        /// Where it is.
        partial: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The container refused it.
    #[error("cannot write {path}: {source}")]
    Container {
        /// The file.
        path: PathBuf,
        /// Why.
        source: McapError,
    },
}

impl From<WriteError> for Failure {
    fn from(error: WriteError) -> Self {
        match error {
            WriteError::Exists { .. } | WriteError::Unfinished { .. } => Self::usage(error),
            _ => Self::failed(error),
        }
    }
}

/// When a message was, nanoseconds, and its number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Stamp {
    /// Its place on the recording's axis.
    pub(crate) log_ns: u64,
    /// When it was published.
    pub(crate) publish_ns: u64,
    /// Number on its topic.
    pub(crate) sequence: u32,
}

impl Stamp {
    /// Published at `at_ns`, number `sequence`, which wraps as the container's does.
    pub(crate) fn new(at_ns: u64, sequence: u64) -> Self {
        Self {
            log_ns: at_ns,
            publish_ns: at_ns,
            sequence: u32::try_from(sequence & u64::from(u32::MAX)).unwrap_or(u32::MAX),
        }
    }
}

/// A file being written.
pub(crate) struct Recording {
    writer: Option<Writer<NoSeek<QueuedFile>>>,
    partial: PathBuf,
    path: PathBuf,
    message_count: u64,
    topic_count: usize,
    /// What is not completed stays beside the place where it was to go.
    is_live: bool,
    length: Arc<AtomicU64>,
}

/// Says that `path` may be written, before any work is done for it.
///
/// # Errors
/// When it is the input, or exists and may not be replaced.
pub(crate) fn check_target(path: &Path, input: &Path, may_replace: bool) -> Result<(), WriteError> {
    let path = path.to_owned();
    let same = path.canonicalize().ok().zip(input.canonicalize().ok());
    if same.is_some_and(|(path, input)| path == input) {
        return Err(WriteError::IsInput { path });
    }
    if path.is_dir() {
        let source = io::Error::from(io::ErrorKind::IsADirectory);
        return Err(WriteError::Io { path, source });
    }
    if fs::symlink_metadata(&path).is_ok() && !may_replace {
        return Err(WriteError::Exists { path });
    }
    Ok(())
}

/// Where a recording that will be called `path` lies until this process has made it whole.
pub(crate) fn partial(path: &Path) -> PathBuf {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!(".{name}.{}.partial", process::id()))
}

/// Where a live recording that will be called `path` lies until it is whole.
fn live_partial(path: &Path) -> PathBuf {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!("{name}.partial"))
}

/// Says that a live recording may go to `path`, as [`check_target`] does.
///
/// # Errors
/// As there, and when a recorder writes it or left it unfinished, or its folder is not there or not
/// to be written into.
pub(crate) fn check_live_target(path: &Path, may_replace: bool) -> Result<(), WriteError> {
    check_target(path, Path::new(""), may_replace)?;
    let partial = live_partial(path);
    if fs::symlink_metadata(&partial).is_ok() {
        return Err(WriteError::Unfinished { path: partial });
    }
    let folder = path.parent().filter(|one| !one.as_os_str().is_empty());
    check_folder(folder.unwrap_or(Path::new(".")), path)
}

/// Says that `path` may be made in `folder`.
///
/// # Errors
/// When the folder is none, or not to be written into.
pub(crate) fn check_folder(folder: &Path, path: &Path) -> Result<(), WriteError> {
    let failed = |source: io::Error| WriteError::Io {
        path: path.to_owned(),
        source,
    };
    if !fs::metadata(folder).map_err(failed)?.is_dir() {
        return Err(failed(io::ErrorKind::NotADirectory.into()));
    }
    access(folder, AccessFlags::W_OK | AccessFlags::X_OK).map_err(|errno| failed(errno.into()))
}

impl Recording {
    /// Begins a file that will be called `path`.
    ///
    /// # Errors
    /// When there is no room, no right or no folder for it.
    pub(crate) fn create(path: &Path) -> Result<Self, WriteError> {
        let partial = partial(path);
        Self::begin(path, partial, false)
    }

    /// Begins a file that will be called `path` and is called `<path>.partial` until then, where
    /// whoever looks for it after a kill finds it.
    ///
    /// # Errors
    /// When there is no room, no right or no folder for it, or such a file is there already: what a
    /// killed recorder left is not written over.
    pub(crate) fn create_live(path: &Path) -> Result<Self, WriteError> {
        Self::begin(path, live_partial(path), true)
    }

    fn begin(path: &Path, partial: PathBuf, is_live: bool) -> Result<Self, WriteError> {
        let file = if is_live {
            // Whoever makes it has it: two recorders that begin together must not write one file.
            File::options().write(true).create_new(true).open(&partial)
        } else {
            plain_file::create_anew(&partial)
        };
        let file = file.and_then(QueuedFile::new).map_err(|source| {
            if is_live && source.kind() == io::ErrorKind::AlreadyExists {
                let path = partial.clone();
                WriteError::Unfinished { path }
            } else {
                // The name that was asked for: of the other one nobody has heard.
                let path = path.to_owned();
                WriteError::Io { path, source }
            }
        })?;
        let library = concat!("hil-recorder ", env!("CARGO_PKG_VERSION"));
        let mut recording = Self {
            writer: None,
            partial,
            path: path.to_owned(),
            message_count: 0,
            topic_count: 0,
            is_live,
            length: file.length(),
        };
        let writer = WriteOptions::new()
            .compression(Some(Compression::Zstd))
            .chunk_size(Some(CHUNK_BYTES))
            .library(library)
            // A chunk reaches the file whole.
            .disable_seeking(true)
            .create(NoSeek::new(file))
            .map_err(|source| recording.refused(source))?;
        recording.writer = Some(writer);
        Ok(recording)
    }

    /// Where the file will be.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Messages so far.
    pub(crate) const fn message_count(&self) -> u64 {
        self.message_count
    }

    /// Topics so far.
    pub(crate) const fn topic_count(&self) -> usize {
        self.topic_count
    }

    /// Size of the file, bytes; what is not compressed yet is not in it.
    pub(crate) fn size_bytes(&self) -> u64 {
        self.length.load(Ordering::Relaxed)
    }

    /// The error of having more topics than the container can number.
    pub(crate) fn full(&self) -> WriteError {
        self.refused(McapError::TooManyChannels)
    }

    /// What to call the file in an error: what is left of a live one lies under its partial name, of
    /// another nothing is left.
    fn told_path(&self) -> &Path {
        if self.is_live {
            &self.partial
        } else {
            &self.path
        }
    }

    fn refused(&self, source: McapError) -> WriteError {
        let path = self.told_path().to_owned();
        match source {
            McapError::Io(source) => WriteError::Io { path, source },
            source => WriteError::Container { path, source },
        }
    }

    fn with<T>(
        &mut self,
        work: impl FnOnce(&mut Writer<NoSeek<QueuedFile>>) -> Result<T, McapError>,
    ) -> Result<T, WriteError> {
        let writer = self.writer.as_mut();
        let worked = writer.map_or(Err(McapError::AttemptedWriteAfterFailure), work);
        worked.map_err(|source| self.refused(source))
    }

    /// A topic with the number and schema that it had elsewhere.
    ///
    /// # Errors
    /// When the file cannot be written, or the number means something else already.
    pub(crate) fn copy_topic(&mut self, channel: &mcap::Channel<'_>) -> Result<(), WriteError> {
        self.with(|writer| {
            let schema_id = match &channel.schema {
                Some(schema) => {
                    let (name, encoding) = (&schema.name, &schema.encoding);
                    writer.add_schema_with_id(schema.id, name, encoding, &schema.data)?
                }
                None => 0,
            };
            let (topic, encoding) = (&channel.topic, &channel.message_encoding);
            writer.add_channel_with_id(
                channel.id,
                schema_id,
                topic,
                encoding,
                &channel.metadata,
            )?;
            Ok(())
        })
    }

    /// Ends what is compressed together, so that all before is safe from damage to what follows.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub(crate) fn flush(&mut self) -> Result<(), WriteError> {
        self.with(Writer::flush)
    }

    /// A table of words about the recording.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub(crate) fn describe(
        &mut self,
        name: &str,
        metadata: BTreeMap<String, String>,
    ) -> Result<(), WriteError> {
        let name = name.to_owned();
        self.with(|writer| writer.write_metadata(&Metadata { name, metadata }))
    }

    /// A whole file beside the messages, of no time.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub(crate) fn attach_file(
        &mut self,
        name: &str,
        media_type: &str,
        data: Vec<u8>,
    ) -> Result<(), WriteError> {
        self.attach(&Attachment {
            log_time: 0,
            create_time: 0,
            name: name.to_owned(),
            media_type: media_type.to_owned(),
            data: Cow::Owned(data),
        })
    }

    /// The same as it was elsewhere.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub(crate) fn attach(&mut self, attachment: &Attachment<'_>) -> Result<(), WriteError> {
        self.with(|writer| writer.attach(attachment))
    }

    /// Completes the file, puts it in its place and says how many messages it has.
    ///
    /// # Errors
    /// When the file cannot be written; nothing is in its place then.
    pub(crate) fn finish(mut self) -> Result<u64, WriteError> {
        self.with(|writer| writer.finish().map(|_| ()))?;
        let failed = |path: &Path, source| WriteError::Io {
            path: path.to_owned(),
            source,
        };
        if let Some(writer) = self.writer.take() {
            let written = writer.into_inner().into_inner().finish();
            written.map_err(|error| failed(self.told_path(), error))?;
        }
        fs::rename(&self.partial, &self.path).map_err(|source| {
            if self.is_live {
                let (path, partial) = (self.path.clone(), self.partial.clone());
                return WriteError::Unplaced {
                    path,
                    partial,
                    source,
                };
            }
            failed(&self.path, source)
        })?;
        Ok(self.message_count)
    }
}

impl Sink for Recording {
    type Error = WriteError;

    fn add_topic(
        &mut self,
        topic: &str,
        schema: &Schema,
        metadata: &BTreeMap<String, String>,
    ) -> Result<u16, WriteError> {
        self.topic_count += 1;
        self.with(|writer| {
            let schema = writer.add_schema(&schema.name, "protobuf", &schema.data)?;
            writer.add_channel(schema, topic, "protobuf", metadata)
        })
    }

    fn write(&mut self, topic: u16, at: Stamp, data: &[u8]) -> Result<(), WriteError> {
        let header = MessageHeader {
            channel_id: topic,
            sequence: at.sequence,
            log_time: at.log_ns,
            publish_time: at.publish_ns,
        };
        self.with(|writer| writer.write_to_known_channel(&header, data))?;
        self.message_count += 1;
        Ok(())
    }
}

impl Drop for Recording {
    fn drop(&mut self) {
        // Before the file goes: the writer completes it when it is dropped.
        drop(self.writer.take());
        if self.is_live {
            return;
        }
        // After `finish` there is none any more.
        let _is_gone = fs::remove_file(&self.partial).is_ok();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schema;

    fn folder(name: &str) -> PathBuf {
        let folder = std::env::temp_dir().join(format!("hil-writer-{name}-{}", process::id()));
        fs::create_dir_all(&folder).unwrap();
        folder
    }

    #[test]
    fn a_file_appears_whole_or_not_at_all() {
        let folder = folder("whole");
        let path = folder.join("a.mcap");
        let begin = || {
            let mut recording = Recording::create(&path).unwrap();
            let nothing = BTreeMap::new();
            let topic = recording.add_topic("/a", &schema::opaque(), &nothing);
            recording
                .write(topic.unwrap(), Stamp::new(5, u64::from(u32::MAX) + 3), b"x")
                .unwrap();
            recording
        };
        drop(begin());
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 0);
        assert_eq!(begin().finish().unwrap(), 1);
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 1);
        let bytes = fs::read(&path).unwrap();
        let messages: Vec<_> = mcap::MessageStream::new(&bytes)
            .unwrap()
            .map(Result::unwrap)
            .collect();
        assert_eq!((messages[0].log_time, messages[0].sequence), (5, 2));
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_live_file_has_one_writer_and_what_a_kill_left_is_kept() {
        let folder = folder("live");
        let path = folder.join("a.mcap");
        let partial = folder.join("a.mcap.partial");
        let begin = || Recording::create_live(&path);
        let first = begin().unwrap();
        let second = begin().map(|_| ());
        assert!(matches!(second, Err(WriteError::Unfinished { .. })));
        assert_eq!(first.finish().unwrap(), 0);
        assert!(path.is_file() && !partial.exists());
        fs::write(&partial, "left").unwrap();
        let again = begin().map(|_| ());
        assert!(matches!(again, Err(WriteError::Unfinished { .. })));
        assert_eq!(fs::read(&partial).unwrap(), b"left");
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn nothing_is_replaced_unasked_and_the_input_never() {
        let folder = folder("target");
        let (old, input) = (folder.join("old.mcap"), folder.join("in.mcap"));
        fs::write(&old, "").unwrap();
        fs::write(&input, "").unwrap();
        let check = |path: &Path, force| check_target(path, &input, force);
        assert!(matches!(check(&old, false), Err(WriteError::Exists { .. })));
        assert!(check(&old, true).is_ok());
        let same = folder.join("../").join(folder.file_name().unwrap());
        let same = same.join("in.mcap");
        assert!(matches!(
            check(&same, true),
            Err(WriteError::IsInput { .. })
        ));
        assert!(matches!(check(&folder, true), Err(WriteError::Io { .. })));
        fs::remove_dir_all(folder).unwrap();
    }
}
