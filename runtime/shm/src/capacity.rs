//! Room in the memory that channels live in: what a channel takes of it, what there is, and taking it
//! before it is written to. A page of a file in `/dev/shm` is taken when it is first touched, and where
//! none is left the process that touches it dies of SIGBUS.

use core::fmt;
use std::fs::{self, Metadata, OpenOptions};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use hil_core::message::Envelope;
use nix::fcntl::posix_fallocate;
use nix::sys::statvfs::statvfs;

use super::domain::{Domain, shared_memory_files_with};
use super::error::ChannelError;
use super::holder::ChannelSettings;
use super::identity::SHARED_MEMORY_DIRECTORY;
use hil_platform::words;

/// Messages a reader may hold at a time.
pub(crate) const BORROWED_MAX: usize = 2;
/// Messages a writer fills at a time, beside those that it puts together from pieces.
const NEXT_MAX: usize = 1;

// How iceoryx2 0.10 lays its files out; the test beside compares.

/// Before the envelope of each message.
const SAMPLE_HEADER_BYTES: usize = 48;
/// Of each message in a writer's list of free ones.
const SAMPLE_ENTRY_BYTES: usize = 4;
/// Of a connection for each message that may wait in it.
const WAITING_BYTES: usize = 16;
/// Of a service for each process that may have it open, and for each port that it may have.
const MEMBER_BYTES: usize = 72;
const PORT_BYTES: usize = 96;
/// Of each file beside what grows.
const FIXED_BYTES: usize = 512;

/// Room in `/dev/shm`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Room {
    /// Bytes.
    pub bytes: u64,
    /// Files.
    pub files: u64,
}

impl Room {
    /// What is free in the memory of channels.
    ///
    /// # Errors
    /// When the kernel does not tell.
    pub fn free() -> io::Result<Self> {
        Self::free_in(Path::new(SHARED_MEMORY_DIRECTORY))
    }

    /// What is free for this user in `folder`.
    ///
    /// # Errors
    /// As [`Room::free`].
    pub fn free_in(folder: &Path) -> io::Result<Self> {
        let status = statvfs(folder)?;
        // A file system without a bound on files says that it has none.
        let files = if status.files() == 0 {
            u64::MAX
        } else {
            status.files_available()
        };
        Ok(Self {
            bytes: status.blocks_available() * status.fragment_size(),
            files,
        })
    }

    /// How large the memory of channels would have to be for `need` beside what is in it now, bytes.
    ///
    /// # Errors
    /// When the kernel does not tell.
    pub fn size_with(need: Self) -> io::Result<u64> {
        let status = statvfs(SHARED_MEMORY_DIRECTORY)?;
        let taken = status.blocks().saturating_sub(status.blocks_available());
        Ok((taken * status.fragment_size()).saturating_add(need.bytes))
    }

    /// Both together.
    #[must_use]
    pub const fn and(self, other: Self) -> Self {
        Self {
            bytes: self.bytes.saturating_add(other.bytes),
            files: self.files.saturating_add(other.files),
        }
    }

    /// As much `count` times.
    #[must_use]
    pub const fn times(self, count: u64) -> Self {
        Self {
            bytes: self.bytes.saturating_mul(count),
            files: self.files.saturating_mul(count),
        }
    }

    /// True when `need` fits into it.
    pub const fn holds(self, need: Self) -> bool {
        self.bytes >= need.bytes && self.files >= need.files
    }

    /// One file of at most `bytes`.
    fn file(bytes: usize) -> Self {
        const PAGE_BYTES: u64 = 4096;
        let bytes = u64::try_from(bytes).unwrap_or(u64::MAX);
        Self {
            bytes: bytes.div_ceil(PAGE_BYTES).saturating_mul(PAGE_BYTES),
            files: 1,
        }
    }
}

impl fmt::Display for Room {
    /// `3.2 MiB in 15 files`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} in {} files", words::bytes(self.bytes), self.files)
    }
}

impl ChannelSettings {
    /// Messages that a writer fills at a time.
    pub(crate) const fn lent_max(&self) -> usize {
        NEXT_MAX.saturating_add(self.assembled_max)
    }

    /// Messages that a writer has memory for.
    fn sample_count(&self) -> usize {
        let waiting = self.depth_max.saturating_add(BORROWED_MAX);
        self.readers_max
            .saturating_mul(waiting)
            .saturating_add(self.lent_max())
    }

    /// What the channel takes before it has a writer or a reader.
    pub fn own_room(&self) -> Room {
        let members = self.nodes_max().saturating_mul(MEMBER_BYTES);
        let ports = self.writers_max.saturating_add(self.readers_max);
        let ports = ports.saturating_mul(PORT_BYTES);
        let service = Room::file(FIXED_BYTES.saturating_add(members).saturating_add(ports));
        service.times(2)
    }

    /// What a writer of it takes.
    pub fn writer_room(&self) -> Room {
        let alignment = self.message.alignment_bytes.max(align_of::<Envelope>());
        let before = (SAMPLE_HEADER_BYTES + size_of::<Envelope>()).next_multiple_of(alignment);
        let sample = before.saturating_add(self.message.size_bytes);
        let sample = sample.checked_next_multiple_of(alignment);
        let each = sample
            .unwrap_or(usize::MAX)
            .saturating_add(SAMPLE_ENTRY_BYTES);
        let samples = self.sample_count().saturating_mul(each);
        Room::file(FIXED_BYTES.saturating_add(samples))
    }

    /// What a reader of it takes: its connection with one writer, and where it is woken.
    pub fn reader_room(&self) -> Room {
        let waiting = self.depth_max.saturating_add(BORROWED_MAX);
        let waiting = waiting.saturating_mul(WAITING_BYTES);
        let connection = FIXED_BYTES
            .saturating_add(waiting)
            .saturating_add(self.sample_count());
        Room::file(connection).and(Room::file(FIXED_BYTES))
    }

    /// What it takes with one writer and as many readers as it may have.
    pub fn room(&self) -> Room {
        let readers = u64::try_from(self.readers_max).unwrap_or(u64::MAX);
        let readers = self.reader_room().times(readers);
        self.own_room().and(self.writer_room()).and(readers)
    }
}

/// Checks that `need` is free before a port of `channel` takes it.
pub(crate) fn check_room(channel: &str, need: Room) -> Result<(), ChannelError> {
    match Room::free() {
        Ok(free) if !free.holds(need) => Err(ChannelError::NoRoom {
            channel: channel.to_owned(),
            need,
            free,
        }),
        // What the kernel does not tell is found out by use.
        Ok(_) | Err(_) => Ok(()),
    }
}

/// Takes the memory of everything that the port called `port` has so far, `need` at most, before a page
/// of it is written to: no process dies of one that is not there. What is taken already costs nothing.
pub(crate) fn take_room(
    domain: &Domain,
    channel: &str,
    port: u128,
    need: Room,
) -> Result<(), ChannelError> {
    // iceoryx2 0.10 names a writer's memory by its number, and a connection by those of both ends.
    let port = port.to_string();
    for path in shared_memory_files_with(domain.address().prefix(), &port) {
        match fs::metadata(&path).and_then(|file| reserve(&path, &file)) {
            Ok(()) => {}
            // Of another port that has just been closed.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) if error.kind() == io::ErrorKind::StorageFull => {
                return Err(ChannelError::NoRoom {
                    channel: channel.to_owned(),
                    need,
                    free: Room::free().unwrap_or_default(),
                });
            }
            Err(source) => {
                return Err(ChannelError::Reserve {
                    channel: channel.to_owned(),
                    source,
                });
            }
        }
    }
    Ok(())
}

/// Takes the memory of the file at `path`, unless all of it is taken.
pub(super) fn reserve(path: &Path, metadata: &Metadata) -> io::Result<()> {
    const BLOCK_BYTES: u64 = 512;
    if metadata.blocks() * BLOCK_BYTES >= metadata.len() {
        return Ok(());
    }
    let file = OpenOptions::new().write(true).open(path)?;
    let length = metadata.len().try_into().map_err(io::Error::other)?;
    Ok(posix_fallocate(file, 0, length)?)
}
