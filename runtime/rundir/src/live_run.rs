//! What a supervisor says of the run it is supervising: the file `live.json`, beside each of the run's
//! domains and in its folder for as long as the run goes. Who wrote it and who finds it is
//! elsewhere.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, BufReader};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use nix::errno::Errno;
use nix::fcntl::{Flock, FlockArg, OFlag};
use serde::{Deserialize, Serialize};

use crate::manifest::Manifest;
use crate::run_folder::RunFolder;
use hil_platform::domain_address::{DomainAddress, DomainAddressError};
use hil_platform::plain_file;

/// Version of the layout of `live.json`. Within one, fields are only added.
pub const LIVE_VERSION: u32 = 1;

/// A run that goes, or went when its supervisor was killed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LiveRun {
    /// [`LIVE_VERSION`] of the writer.
    pub schema_version: u32,
    /// Name of the run: the last part of its folder.
    pub name: String,
    /// Name of its topology.
    pub topology: String,
    /// Its folder.
    pub folder: PathBuf,
    /// The supervisor's process.
    pub pid: u32,
    /// When the supervisor's process began, in clock ticks since boot: a number is used again,
    /// number and beginning are not.
    #[serde(default)]
    pub pid_start_ticks: Option<u64>,
    /// When it was announced, as people write it.
    pub since: String,
    /// All hosts of the run read one clock; `None` before the run has begun.
    #[serde(default)]
    pub has_one_clock: Option<bool>,
    /// The shared-memory domain of each host that runs here.
    pub domains: BTreeMap<String, String>,
    /// Names of the processes that run here.
    #[serde(default)]
    pub processes: Vec<String>,
    /// The channels with an end here.
    #[serde(default)]
    pub channels: Vec<LiveChannel>,
}

/// Where the messages of a channel can be had while the run goes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LiveChannel {
    /// Its name.
    pub name: String,
    /// Where.
    pub source: Source,
    /// What the processes here note of each of its messages.
    #[serde(default)]
    pub noted: Vec<Stage>,
    /// A process of another host records its messages, so that they come again with the records that
    /// hosts exchange at the end.
    #[serde(default)]
    pub comes_again: bool,
}

/// A step on the way of a message that a process notes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// Its producer published it.
    Published,
    /// A gateway sent it.
    Sent,
    /// A gateway received it.
    Received,
    /// Its consumer took it.
    Taken,
}

/// Where the messages of a channel can be had while the run goes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Source {
    /// A process of this host writes them into the run's folder.
    Records {},
    /// Nobody here records them: they are in the shared memory of `host`.
    SharedMemory {
        /// The host.
        host: String,
        /// A gateway brings them, so that gaps in their numbers are the network's.
        is_forwarded: bool,
    },
}

impl LiveRun {
    /// Name of the file.
    pub const FILE_NAME: &'static str = "live.json";

    /// Reads the file in `folder`.
    ///
    /// # Errors
    /// When it is not there or not what a supervisor writes.
    pub fn read(folder: &Path) -> io::Result<Self> {
        let path = folder.join(Self::FILE_NAME);
        // Who looks for runs also looks into folders of others.
        let file = plain_file::open_unlinked(&path)?;
        serde_json::from_reader(BufReader::new(file)).map_err(io::Error::other)
    }

    /// The run's folder.
    pub fn run_folder(&self) -> RunFolder {
        RunFolder::existing(&self.folder)
    }

    /// Hosts of the run that run here.
    pub fn hosts(&self) -> impl Iterator<Item = &str> {
        self.domains.keys().map(String::as_str)
    }

    /// Address of the shared memory of `host`.
    ///
    /// # Errors
    /// When the announcement holds no address that is one.
    pub fn domain(&self, host: &str) -> Result<DomainAddress, DomainAddressError> {
        let address = self.domains.get(host).map_or("", String::as_str);
        address.parse()
    }

    /// What was run: types and fields of channels, topology, seed, host facts.
    ///
    /// # Errors
    /// When `manifest.json` cannot be read.
    pub fn manifest(&self) -> io::Result<Manifest> {
        Manifest::read(&self.run_folder())
    }

    /// True while the supervisor says that the run goes: it takes the word back when all
    /// processes have ended and all records are in the folder. A supervisor that was killed takes
    /// nothing back; see [`Self::is_held`].
    pub fn is_announced(&self) -> bool {
        self.roots().any(|root| root.join(Self::FILE_NAME).exists())
    }

    /// True while the supervisor holds a domain of the run: a killed one does not.
    pub fn is_held(&self) -> bool {
        self.roots().any(|root| is_locked(&root))
    }

    /// True when the supervisor's process is gone.
    pub fn is_supervisor_gone(&self) -> bool {
        let started = start_ticks(self.pid);
        started.is_none() || (self.pid_start_ticks.is_some() && started != self.pid_start_ticks)
    }

    fn roots(&self) -> impl Iterator<Item = PathBuf> + '_ {
        let addresses = self.domains.values();
        let addresses = addresses.filter_map(|text| text.parse::<DomainAddress>().ok());
        addresses.map(|address| address.root_path().to_owned())
    }
}

/// True while another process has the launcher's lock on a domain's folder. Asked only of folders
/// with an announcement, whose lock was taken before: a launcher never meets the question.
fn is_locked(root: &Path) -> bool {
    // Others may announce a pipe.
    let flags = (OFlag::O_DIRECTORY | OFlag::O_NOFOLLOW).bits();
    let mut options = File::options();
    let Ok(directory) = options.read(true).custom_flags(flags).open(root) else {
        return false;
    };
    matches!(
        Flock::lock(directory, FlockArg::LockSharedNonblock),
        Err((_, Errno::EWOULDBLOCK))
    )
}

/// When process `pid` began, in clock ticks since boot; `None` when it is gone or only waits to be
/// cleaned up.
pub fn start_ticks(pid: u32) -> Option<u64> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The name before the last bracket may hold anything. Behind it: state, then the parent, field 4.
    let (_, rest) = stat.rsplit_once(')')?;
    let mut fields = rest.split_whitespace();
    let state = fields.next()?;
    if matches!(state, "Z" | "X") {
        return None;
    }
    fields.nth(18)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_living_process_has_a_beginning_and_a_missing_one_none() {
        assert!(start_ticks(std::process::id()).is_some());
        assert_eq!(start_ticks(u32::MAX), None);
    }

    #[test]
    fn the_announcement_is_read_as_it_was_written_and_with_fields_missing() {
        let run = LiveRun {
            schema_version: LIVE_VERSION,
            name: "x-1".to_owned(),
            topology: "x".to_owned(),
            folder: PathBuf::from("/runs/x-1"),
            pid: 7,
            pid_start_ticks: Some(9),
            since: "today".to_owned(),
            has_one_clock: None,
            domains: BTreeMap::from([("a".to_owned(), "h0123abcd_@/run/hil/x".to_owned())]),
            processes: vec!["robot".to_owned()],
            channels: vec![LiveChannel {
                name: "c".to_owned(),
                source: Source::SharedMemory {
                    host: "a".to_owned(),
                    is_forwarded: true,
                },
                noted: vec![Stage::Received, Stage::Taken],
                comes_again: true,
            }],
        };
        let text = serde_json::to_string(&run).unwrap();
        assert_eq!(serde_json::from_str::<LiveRun>(&text).unwrap(), run);
        let least = r#"{"schema_version": 1, "name": "x-1", "topology": "x", "folder": "/r",
            "pid": 7, "since": "today", "domains": {}}"#;
        let read: LiveRun = serde_json::from_str(least).unwrap();
        assert!(!read.is_announced() && !read.is_held() && read.domain("a").is_err());
    }
}
