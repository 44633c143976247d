//! The shared memory of one run on one host: an iceoryx2 domain of its own, so that runs side by
//! side cannot see each other and everything a dead run left behind can be thrown away.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs;
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use iceoryx2::config::Config;
use iceoryx2::node::{Node, NodeBuilder};
use iceoryx2::prelude::{
    FileName, LogLevel, NodeName, Path as IceoryxPath, SemanticString, SignalHandlingMode, ipc,
    set_log_level,
};
use nix::errno::Errno;
use nix::fcntl::{Flock, FlockArg};
use nix::unistd::Uid;

use super::capacity::reserve;
use super::error::{DomainError, explain};
use super::identity::{SHARED_MEMORY_DIRECTORY, fingerprint};
use super::members;
use super::sequence::OPEN_WITHIN;
use hil_core::time::Instant;
use hil_platform::clock::MonotonicClock;
use hil_platform::domain_address::{
    DomainAddress, DomainAddressError, checked_root_path, is_prefix,
};
use hil_platform::own_folder::{OwnFolder, OwnFolderError};
use hil_platform::plain_file;
use hil_platform::random::random_bytes;

/// File in the root path that says whose it is; its content is the prefix of the run.
const MARKER: &str = "hil-domain";

/// Ended writers of a channel whose unread samples a reader keeps; at least the samples a reader may
/// borrow.
const ENDED_WRITERS_MAX: usize = 4;

/// Membership of this process in the domain of a run.
///
/// The launcher [creates](Domain::create) it and owns it: it alone holds the lock on the root
/// path, and with it the domain goes. Workers [open](Domain::open) it. One per process is enough;
/// it can be shared by threads, while the ports opened from it cannot.
#[derive(Debug)]
pub struct Domain {
    address: DomainAddress,
    config: Config,
    node: Mutex<Option<Node<ipc::Service>>>,
    /// What the launcher holds; `None` in a worker and after removal.
    held: Option<HeldRoot>,
    /// Files of this domain without a length, with when each was first seen so.
    lengthless: Mutex<BTreeMap<PathBuf, (u64, Instant)>>,
    open_within: Duration,
}

/// The root path of a domain and the launcher's lock on it.
#[derive(Debug)]
struct HeldRoot {
    around: OwnFolder,
    name: OsString,
    root: OwnFolder,
    _lock: Flock<OwnedFd>,
}

impl HeldRoot {
    /// Deletes what the files in the root path say is left of a run.
    ///
    /// # Errors
    /// When the folder holds what is not a run's.
    fn clear(&self) -> Result<(), DomainError> {
        let root_path = self.root.path();
        match self.root.read(MARKER) {
            Ok(prefix) if is_prefix(&prefix) => delete_shared_memory(&prefix),
            Ok(_) => {}
            Err(_) => {
                let names = self.root.names();
                if !names
                    .map_err(DomainError::io("read", root_path))?
                    .is_empty()
                {
                    return Err(DomainError::ForeignDirectory {
                        root_path: root_path.to_owned(),
                    });
                }
            }
        }
        self.empty();
        Ok(())
    }

    /// Empties the root path; the marker goes last, so that an interrupted removal is resumed. What refuses is
    /// found by looking.
    fn empty(&self) {
        let names = self.root.names().unwrap_or_default();
        let (marker, others): (Vec<_>, Vec<_>) = names.into_iter().partition(|name| name == MARKER);
        for name in others.iter().chain(&marker) {
            let _is_gone = self.root.remove(name).is_ok();
        }
    }

    /// Removes the empty root path while the lock is held, so that the next launcher starts clean.
    fn leave(self) {
        let _is_gone = self.around.remove_empty(&self.name).is_ok();
    }
}

/// What [`Domain::remove`] found and left.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Removal {
    /// Processes of the run that were still members; their channels are gone under their hands.
    pub live_member_count: u64,
    /// Files that could not be deleted.
    pub remained: Vec<PathBuf>,
}

/// What [`Domain::cleanup_dead_nodes`] did.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Cleanup {
    /// Dead processes whose slots, samples and files were freed.
    pub freed_count: u64,
    /// Dead processes another process is cleaning up, or whose files refuse.
    pub failed_count: u64,
    /// Nothing was done, because a file has no length yet: ask again soon. Such a file is either
    /// being made, or of a process killed while making it.
    pub is_postponed: bool,
}

impl Domain {
    /// Creates the domain of a run below `root_path`, for the launcher.
    ///
    /// Directories are made as needed. What a dead run of the same name left is removed first.
    ///
    /// # Errors
    /// When the path is unusable, too long, locked by a living run, or holds foreign files.
    pub fn create(root_path: &Path) -> Result<Self, DomainError> {
        let root_path = checked_root_path(root_path)?;
        let held = hold(&root_path)?;
        held.clear()?;
        let prefix =
            fresh_prefix().map_err(DomainError::io("name files in", SHARED_MEMORY_DIRECTORY))?;
        let marked = held.root.write_new(MARKER, &prefix);
        marked.map_err(DomainError::io("write", root_path.join(MARKER)))?;
        let mut domain = Self::join(DomainAddress::new(root_path, prefix), None)?;
        domain.held = Some(held);
        domain.keep_others_out()?;
        Ok(domain)
    }

    /// Takes from other users the right to write the file in which processes that join are counted: iceoryx2 0.10 gives
    /// it to everybody, and whoever cuts it ends each process that joins after that.
    fn keep_others_out(&self) -> Result<(), DomainError> {
        for file in shared_memory_files(self.address.prefix()) {
            let allowed = fs::Permissions::from_mode(0o600);
            fs::set_permissions(&file, allowed)
                .map_err(DomainError::io("keep others out of", &file))?;
        }
        Ok(())
    }

    /// Deletes what a run that was killed left at `root_path`, if it is that of a domain.
    ///
    /// # Errors
    /// As [`Domain::create`].
    pub fn clear(root_path: &Path) -> Result<(), DomainError> {
        let held = hold(&checked_root_path(root_path)?)?;
        held.clear()?;
        held.leave();
        Ok(())
    }

    /// True when `folder` is, or was, the root of a domain.
    pub fn is_in(folder: &OwnFolder) -> bool {
        folder.read(MARKER).is_ok()
    }

    /// The prefix of the domain whose root is, or was, `root_path`; `None` where there is none.
    pub fn prefix_at(root_path: &Path) -> Option<String> {
        let prefix = plain_file::read_to_string(&root_path.join(MARKER)).ok()?;
        is_prefix(&prefix).then_some(prefix)
    }

    /// Joins the domain a launcher created.
    ///
    /// # Errors
    /// When the root path does not exist here or iceoryx2 refuses, e.g. for another user's domain.
    pub fn open(address: &DomainAddress) -> Result<Self, DomainError> {
        Self::join_existing(address, None)
    }

    /// As [`Domain::open`], for a program that only looks on: the run ends without regard to it.
    ///
    /// # Errors
    /// As [`Domain::open`].
    pub fn observe(address: &DomainAddress) -> Result<Self, DomainError> {
        Self::join_existing(address, Some(members::observer_name()))
    }

    fn join_existing(address: &DomainAddress, name: Option<NodeName>) -> Result<Self, DomainError> {
        let marker = address.root_path().join(MARKER);
        fs::metadata(&marker).map_err(DomainError::io("find the run's", &marker))?;
        Self::join(address.clone(), name)
    }

    fn join(address: DomainAddress, name: Option<NodeName>) -> Result<Self, DomainError> {
        // Below this level iceoryx2 prints nothing we do not report ourselves; at it, some
        // failures would be visible nowhere else.
        set_log_level(LogLevel::Warn);
        let config = configuration(&address)?;
        let builder = name.map_or_else(NodeBuilder::new, |name| NodeBuilder::new().name(&name));
        let node = builder
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<ipc::Service>()
            .map_err(|error| DomainError::Node {
                root_path: address.root_path().to_owned(),
                reason: explain(&format!("{error:?}")),
            })?;
        Ok(Self {
            address,
            config,
            node: Mutex::new(Some(node)),
            held: None,
            lengthless: Mutex::default(),
            open_within: OPEN_WITHIN,
        })
    }

    /// Sets how long opening a channel waits for the launcher to create it; 5 s unless set.
    #[must_use]
    pub fn with_open_within(mut self, open_within: Duration) -> Self {
        self.open_within = open_within;
        self
    }

    /// What another process needs to [open](Domain::open) this domain.
    pub fn address(&self) -> &DomainAddress {
        &self.address
    }

    /// Sixteen bytes that two processes have in common exactly when they share this domain's
    /// memory. Network namespaces do not isolate shared memory: a gateway whose two ends agree
    /// here is being bypassed.
    ///
    /// # Errors
    /// When the root path, `/dev/shm` or `/proc` cannot be inspected.
    pub fn fingerprint(&self) -> Result<[u8; 16], DomainError> {
        fingerprint(self.address.root_path(), self.address.prefix())
    }

    /// Frees what dead processes of this domain held. Readers hear of a dead writer, and a
    /// restarted process finds its slot, only after somebody called this or joined anew: the
    /// launcher calls it about ten times a second.
    pub fn cleanup_dead_nodes(&self) -> Cleanup {
        // iceoryx2 0.10 waits without end for a file to get a length.
        if !self.is_clear_of_lengthless_files() {
            return Cleanup {
                is_postponed: true,
                ..Cleanup::default()
            };
        }
        let node = self.node();
        let done = node_of(node.as_ref()).try_cleanup_dead_nodes();
        Cleanup {
            freed_count: done.cleanups,
            failed_count: done.failed_cleanups,
            is_postponed: false,
        }
    }

    /// As [`Domain::cleanup_dead_nodes`], but waits, a second at most, rather than postpone.
    pub fn cleanup_dead_nodes_now(&self) -> Cleanup {
        let deadline = MonotonicClock::now() + 2 * LENGTHLESS_MAX;
        loop {
            let cleanup = self.cleanup_dead_nodes();
            if !cleanup.is_postponed || MonotonicClock::now() > deadline {
                return cleanup;
            }
            std::thread::sleep(LENGTHLESS_MAX / 20);
        }
    }

    /// Observers that have not left yet.
    pub fn observer_count(&self) -> u64 {
        members::living(&self.config).observer_count
    }

    /// Leaves the domain and, in the launcher, deletes its files. Drop all ports and
    /// [`ChannelHolder`](super::ChannelHolder)s and end all workers before.
    pub fn remove(mut self) -> Removal {
        self.leave()
    }

    fn leave(&mut self) -> Removal {
        let node = self.node.get_mut().unwrap_or_else(PoisonError::into_inner);
        drop(node.take());
        let Some(held) = self.held.take() else {
            return Removal::default();
        };
        let live_member_count = members::living(&self.config).process_count;
        delete_shared_memory(self.address.prefix());
        held.empty();
        held.leave();
        let root_path = self.address.root_path();
        let mut remained = shared_memory_files(self.address.prefix());
        if root_path.exists() {
            remained.push(root_path.to_owned());
        }
        Removal {
            live_member_count,
            remained,
        }
    }

    /// Deletes files that a process was killed over before it could give them a length; false while
    /// one is young enough that its maker may live, by the time that this process has seen it. Takes the memory
    /// of files that another program than ours made, which does not do so itself.
    fn is_clear_of_lengthless_files(&self) -> bool {
        let now = MonotonicClock::now();
        let mut known = self
            .lengthless
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let mut seen = BTreeMap::new();
        for file in shared_memory_files(self.address.prefix()) {
            let Ok(metadata) = fs::symlink_metadata(&file) else {
                continue;
            };
            if metadata.len() > 0 {
                // Where there is too little nothing can be done about it here.
                let _is_taken = reserve(&file, &metadata).is_ok();
                continue;
            }
            let first = known
                .get(&file)
                .filter(|(inode, _)| *inode == metadata.ino());
            let since = first.map_or(now, |(_, since)| *since);
            let is_old = now.saturating_duration_since(since) > LENGTHLESS_MAX;
            if !(is_old && fs::remove_file(&file).is_ok()) {
                seen.insert(file, (metadata.ino(), since));
            }
        }
        *known = seen;
        known.is_empty()
    }

    pub(crate) fn config(&self) -> &Config {
        &self.config
    }

    pub(crate) const fn open_within(&self) -> Duration {
        self.open_within
    }

    /// Runs `act` with this process's node; ports keep their own share of it.
    pub(crate) fn with_node<T>(&self, act: impl FnOnce(&Node<ipc::Service>) -> T) -> T {
        act(node_of(self.node().as_ref()))
    }

    fn node(&self) -> MutexGuard<'_, Option<Node<ipc::Service>>> {
        self.node.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Domain {
    /// A launcher that fails half-way leaves nothing behind either.
    fn drop(&mut self) {
        self.leave();
    }
}

fn node_of(node: Option<&Node<ipc::Service>>) -> &Node<ipc::Service> {
    node.expect("the node is taken only by `leave`, which ends the domain")
}

fn configuration(address: &DomainAddress) -> Result<Config, DomainError> {
    let unusable = || {
        DomainError::Address(DomainAddressError::UnusableRootPath {
            root_path: address.root_path().to_owned(),
        })
    };
    let root_path = format!("{}/", address.root_path().display());
    let mut config = Config::default();
    config.global.prefix =
        FileName::new(address.prefix().as_bytes()).map_err(|_refused_character| unusable())?;
    let root_path =
        IceoryxPath::new(root_path.as_bytes()).map_err(|_refused_character| unusable())?;
    config.global.set_root_path(&root_path);
    // A service is created by the launcher before any worker starts; whoever waits longer for a
    // half-created one waits for a dead process, and our own retry covers the rest.
    config.global.creation_timeout = Duration::from_millis(250);
    // A reader that finds nothing has looked at the place of every connection it could have, and
    // iceoryx2 reserves 128 for ended writers alone: a kilobyte per look. What an ended writer left
    // unread is of its last start, or of the one before; anything older is discarded anyway.
    let reading = &mut config.defaults.publish_subscribe;
    reading.subscriber_expired_connection_buffer = ENDED_WRITERS_MAX;
    Ok(config)
}

/// Makes the root path where it is missing and takes the launcher's lock on it.
fn hold(root_path: &Path) -> Result<HeldRoot, DomainError> {
    const ATTEMPTS: usize = 16;
    let (Some(around), Some(name)) = (root_path.parent(), root_path.file_name()) else {
        return Err(DomainError::Address(DomainAddressError::UnusableRootPath {
            root_path: root_path.to_owned(),
        }));
    };
    let around = OwnFolder::create_around(around)?;
    let io = |operation| DomainError::io(operation, root_path);
    for _ in 0..ATTEMPTS {
        let root = match around.enter_or_make(name) {
            Ok(root) => root,
            // The previous owner has deleted it in between.
            Err(OwnFolderError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => {
                continue;
            }
            Err(error) => return Err(error.into()),
        };
        let descriptor = root.descriptor().map_err(io("open"))?;
        let lock = match Flock::lock(descriptor, FlockArg::LockExclusiveNonblock) {
            Ok(lock) => lock,
            Err((_, Errno::EWOULDBLOCK)) => {
                return Err(DomainError::Locked {
                    root_path: root_path.to_owned(),
                });
            }
            Err((_, errno)) => return Err(io("lock")(errno.into())),
        };
        // The same between our open and our lock.
        if around.has(name, &root) {
            return Ok(HeldRoot {
                name: name.to_owned(),
                around,
                root,
                _lock: lock,
            });
        }
    }
    Err(DomainError::Locked {
        root_path: root_path.to_owned(),
    })
}

/// A prefix no file in `/dev/shm` has, and that nobody can know before. Hosts emulated on one machine may
/// share `/dev/shm`.
fn fresh_prefix() -> io::Result<String> {
    loop {
        let number = u32::from_le_bytes(random_bytes()?);
        let prefix = format!("h{number:08x}_");
        let is_taken = entries_with(&prefix, "").next().is_some();
        if !is_taken {
            return Ok(prefix);
        }
    }
}

fn shared_memory_files(prefix: &str) -> Vec<PathBuf> {
    shared_memory_files_with(prefix, "")
}

/// Those whose names have `part` behind the prefix. A gateway asks for each of its ports, so a name that
/// has not costs a look at its bytes. Others may make files of any name in a folder that is everybody's;
/// only this user's count.
pub(super) fn shared_memory_files_with(prefix: &str, part: &str) -> Vec<PathBuf> {
    let own = Uid::effective().as_raw();
    let entries = entries_with(prefix, part);
    let is_own = |entry: &fs::DirEntry| entry.metadata().is_ok_and(|data| data.uid() == own);
    entries.filter(is_own).map(|entry| entry.path()).collect()
}

fn entries_with(prefix: &str, part: &str) -> impl Iterator<Item = fs::DirEntry> {
    let entries = fs::read_dir(SHARED_MEMORY_DIRECTORY);
    entries
        .into_iter()
        .flatten()
        .flatten()
        .filter(move |entry| {
            let name = entry.file_name();
            let behind = name.to_str().and_then(|name| name.strip_prefix(prefix));
            behind.is_some_and(|name| name.contains(part))
        })
}

/// A living process gives a file its length within microseconds of making it.
const LENGTHLESS_MAX: Duration = Duration::from_millis(500);

/// Deletes a run's shared memory. What refuses is found by looking.
fn delete_shared_memory(prefix: &str) {
    for file in shared_memory_files(prefix) {
        let _is_gone = fs::remove_file(file).is_ok();
    }
}
