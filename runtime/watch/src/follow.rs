//! The record files of a run while they grow: what came since the last look, in whole records. It
//! knows no run; it follows a folder.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fs::{self, File};
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant as WallInstant};

use bytemuck::Pod;
use hil_core::message::Envelope;
use hil_platform::plain_file;

use hil_rundir::record::RecordKind;
use hil_rundir::record::file::{HEADER_BYTES, RecordHeader, written_bytes};

/// How often it looks for new files: processes that start again write new ones.
const LOOK_PERIOD: Duration = Duration::from_millis(100);
/// Largest piece read at once, unless one record is larger: a file that grew long does not keep
/// the others waiting.
const PIECE_BYTES: usize = 128 << 10;
/// Most records read at once, so that each file gets the same number of them at its turn: with as many
/// bytes, the files of short records would run ahead while one catches up, and messages would look
/// as if they had been lost.
pub(super) const PIECE_RECORDS: usize = 512;

/// Whole records of one file, in the order in which they were written.
#[derive(Debug, Clone, Copy)]
pub struct Batch<'a> {
    /// What the file holds, and of which channel.
    pub header: &'a RecordHeader,
    /// The process that wrote it; empty when the file's name does not tell.
    pub writer: &'a str,
    bytes: &'a [u8],
}

impl<'a> Batch<'a> {
    /// The records as `T`; empty when `T` has another size.
    pub fn records<T: Pod>(&self) -> impl Iterator<Item = T> + 'a {
        self.raw()
            .filter_map(|bytes| bytemuck::try_pod_read_unaligned(bytes).ok())
    }

    /// The messages; none when the file holds records of another kind.
    pub fn messages(&self) -> impl Iterator<Item = (Envelope, &'a [u8])> + 'a {
        let is_message = self.header.kind == RecordKind::Message;
        self.raw().filter(move |_| is_message).map(|bytes| {
            let (envelope, payload) = bytes.split_at(size_of::<Envelope>());
            (bytemuck::pod_read_unaligned(envelope), payload)
        })
    }

    fn raw(&self) -> impl Iterator<Item = &'a [u8]> + 'a {
        self.bytes.chunks_exact(self.header.record_bytes as usize)
    }
}

#[derive(Debug)]
struct Followed {
    file: File,
    writer: String,
    /// `None` until the file is as long as its header.
    header: Option<RecordHeader>,
    path: PathBuf,
    /// The file's name up to the instance: those of one process's starts have it in common.
    series: String,
    /// Which start of the process wrote it; 0 when the file's name does not tell.
    instance: u32,
    /// The present poll has read it to its end.
    is_read: bool,
    /// Of the first byte that was not given out.
    offset: u64,
    /// Whole records before this many bytes are passed over.
    passed_bytes: u64,
    is_given_up: bool,
}

/// Follows the record files of one folder.
#[derive(Debug)]
pub struct RecordFollower {
    folder: PathBuf,
    /// Those of one series next to one another, by instance.
    files: Vec<Followed>,
    known: BTreeSet<OsString>,
    looked: Option<WallInstant>,
    /// The file whose turn it is.
    next: usize,
    buffer: Vec<u8>,
    problems: Vec<String>,
    /// What is in files found now was written before.
    passes_over: bool,
    /// The only channels whose messages are given out, and nothing else; `None` for all that there is.
    messages_of: Option<&'static [&'static str]>,
}

impl RecordFollower {
    /// Follows the files in `folder` from their beginning.
    pub fn new(folder: &Path) -> Self {
        Self::of(folder, false)
    }

    /// Follows the files in `folder` from what is written next: for who looks at the present of a
    /// run that may have gone for hours.
    pub fn from_now(folder: &Path) -> Self {
        let mut follower = Self::of(folder, true);
        follower.look_for_files();
        follower.passes_over = false;
        follower
    }

    /// The same of the messages of these channels alone.
    #[must_use]
    pub fn with_messages_of(mut self, channels: &'static [&'static str]) -> Self {
        self.messages_of = Some(channels);
        self
    }

    fn of(folder: &Path, passes_over: bool) -> Self {
        Self {
            passes_over,
            messages_of: None,
            folder: folder.to_owned(),
            files: Vec::new(),
            known: BTreeSet::new(),
            looked: None,
            next: 0,
            buffer: vec![0; PIECE_BYTES],
            problems: Vec::new(),
        }
    }

    /// Gives out what came since the last look, `bytes_max` of it or little more; true when more
    /// may be waiting. The files take turns, but what a process wrote after it was started again
    /// comes after all that it wrote before. Files that cannot be read are left out from then on,
    /// see [`Self::take_problems`].
    pub fn poll(&mut self, bytes_max: usize, take: &mut dyn FnMut(&Batch<'_>)) -> bool {
        self.look_for_files();
        let mut left = bytes_max;
        let mut quiet_count = 0;
        for file in &mut self.files {
            file.is_read = false;
        }
        while quiet_count < self.files.len() {
            if left == 0 {
                return true;
            }
            self.next %= self.files.len();
            let index = self.next;
            self.next += 1;
            let (before, from) = self.files.split_at_mut(index);
            let file = &mut from[0];
            let waits = |earlier: &Followed| earlier.series == file.series && !earlier.is_read;
            if before.last().is_some_and(waits) {
                continue;
            }
            match read_piece(file, &mut self.buffer, self.messages_of, take) {
                Ok(0) => {
                    file.is_read = true;
                    quiet_count += 1;
                }
                Ok(count) => {
                    quiet_count = 0;
                    left = left.saturating_sub(count);
                }
                Err(text) => {
                    self.problems.push(text);
                    file.is_given_up = true;
                    file.is_read = true;
                    quiet_count += 1;
                }
            }
        }
        false
    }

    /// Passes over what is there by now.
    pub fn skip_to_end(&mut self) {
        self.look_again();
        self.look_for_files();
        for file in &mut self.files {
            // A file without a header holds nothing yet; one that cannot be read says so at the poll.
            if let (Ok(true), Ok(written)) = (has_header(file), written_bytes(&file.file, 0))
                && let Some(header) = &file.header
            {
                let record_bytes = u64::from(header.record_bytes);
                let written = written.saturating_sub(HEADER_BYTES as u64);
                file.offset = HEADER_BYTES as u64 + written - written % record_bytes;
            }
        }
    }

    /// Looks for new files at the next poll, however short a time has passed.
    pub fn look_again(&mut self) {
        self.looked = None;
    }

    /// What went wrong since the last call, each file once.
    pub fn take_problems(&mut self) -> Vec<String> {
        core::mem::take(&mut self.problems)
    }

    /// What the files at hand hold, and of which channels, also where nothing came from them yet.
    pub fn headers(&self) -> impl Iterator<Item = &RecordHeader> {
        self.files.iter().filter_map(|one| one.header.as_ref())
    }

    fn look_for_files(&mut self) {
        if self.looked.is_some_and(|at| at.elapsed() < LOOK_PERIOD) {
            return;
        }
        self.looked = Some(WallInstant::now());
        let entries = match fs::read_dir(&self.folder) {
            Ok(entries) => entries,
            Err(error) => {
                if self.known.insert(OsString::new()) {
                    let folder = self.folder.display();
                    self.problems.push(format!("{folder}: {error}"));
                }
                return;
            }
        };
        let starts = self.messages_of.map(|channels| {
            let channels = channels.iter();
            let starts = channels.map(|channel| RecordKind::Message.file_name_start(channel));
            starts.collect::<Vec<_>>()
        });
        let is_wanted = |name: &OsString| {
            let name = name.as_encoded_bytes();
            let begins = |start: &String| name.starts_with(start.as_bytes());
            let starts = starts.as_ref();
            name.ends_with(b".rec") && starts.is_none_or(|starts| starts.iter().any(begins))
        };
        let new: Vec<OsString> = entries
            .flatten()
            .map(|entry| entry.file_name())
            .filter(|name| is_wanted(name) && !self.known.contains(name))
            .collect();
        let has_new = !new.is_empty();
        for name in new {
            let path = self.folder.join(&name);
            let (series, instance) = series_of(&name.to_string_lossy());
            self.known.insert(name);
            match plain_file::open(&path) {
                Ok(file) => self.files.push(Followed {
                    passed_bytes: if self.passes_over {
                        written_bytes(&file, 0).unwrap_or(0)
                    } else {
                        0
                    },
                    file,
                    writer: String::new(),
                    header: None,
                    path,
                    series,
                    instance,
                    is_read: false,
                    offset: 0,
                    is_given_up: false,
                }),
                Err(error) => self.problems.push(format!("{}: {error}", path.display())),
            }
        }
        if has_new {
            let order = |one: &Followed| (one.series.clone(), one.instance);
            self.files.sort_by_cached_key(order);
        }
    }
}

/// What the names of the files of one process's starts have in common, and which start `name` is of.
fn series_of(name: &str) -> (String, u32) {
    let stem = name.strip_suffix(".rec").unwrap_or(name);
    let parts = stem.rsplit_once('.');
    let found = parts.and_then(|(series, instance)| Some((series, instance.parse().ok()?)));
    found.map_or_else(
        || (name.to_owned(), 0),
        |(series, instance)| (series.to_owned(), instance),
    )
}

/// Gives out the next piece of one file; its length in bytes, 0 when nothing whole waits.
fn read_piece(
    one: &mut Followed,
    buffer: &mut Vec<u8>,
    messages_of: Option<&[&str]>,
    take: &mut dyn FnMut(&Batch<'_>),
) -> Result<usize, String> {
    if one.is_given_up || !has_header(one)? {
        return Ok(0);
    }
    let Some(header) = &one.header else {
        return Ok(0);
    };
    let is_wanted = |channels: &[&str]| {
        header.kind == RecordKind::Message && channels.contains(&header.channel.as_str())
    };
    if !messages_of.is_none_or(is_wanted) {
        one.is_given_up = true;
        return Ok(0);
    }
    let record_bytes = header.record_bytes as usize;
    if buffer.len() < record_bytes {
        buffer.resize(record_bytes, 0);
    }
    let failed = |error: io::Error| format!("{}: {error}", one.path.display());
    let written = written_bytes(&one.file, one.offset).map_err(failed)?;
    let left = usize::try_from(written.saturating_sub(one.offset)).unwrap_or(usize::MAX);
    let count = (buffer.len() / record_bytes).clamp(1, PIECE_RECORDS);
    let whole = count.min(left / record_bytes) * record_bytes;
    if whole == 0 {
        return Ok(0);
    }
    let count = read_up_to(&one.file, &mut buffer[..whole], one.offset).map_err(failed)?;
    let count = count - count % record_bytes;
    if count > 0 {
        take(&Batch {
            header,
            writer: &one.writer,
            bytes: &buffer[..count],
        });
        one.offset += count as u64;
    }
    Ok(count)
}

/// Reads the header as soon as it is there.
fn has_header(one: &mut Followed) -> Result<bool, String> {
    if one.header.is_some() {
        return Ok(true);
    }
    let mut bytes = [0; HEADER_BYTES];
    let failed = |error: io::Error| format!("{}: {error}", one.path.display());
    if read_up_to(&one.file, &mut bytes, 0).map_err(failed)? < HEADER_BYTES {
        return Ok(false);
    }
    let header = RecordHeader::decode(&one.path, &bytes).map_err(|error| error.to_string())?;
    let name = one.path.file_name().and_then(|name| name.to_str());
    one.writer = name
        .and_then(|name| header.writer(name))
        .unwrap_or_default()
        .to_owned();
    let record_bytes = u64::from(header.record_bytes).max(1);
    let passed_bytes = one.passed_bytes.saturating_sub(HEADER_BYTES as u64);
    one.offset = HEADER_BYTES as u64 + passed_bytes - passed_bytes % record_bytes;
    one.header = Some(header);
    Ok(true)
}

fn read_up_to(file: &File, buffer: &mut [u8], offset: u64) -> io::Result<usize> {
    let mut count = 0;
    while count < buffer.len() {
        match file.read_at(&mut buffer[count..], offset + count as u64) {
            Ok(0) => break,
            Ok(more) => count += more,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(count)
}
