//! How a run ended, and everything it knows before any figure is computed: `result.json` in the run's
//! folder. With the manifest and the records beside it, every figure can be computed again.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Write as _};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::PathBuf;
use std::time::Duration;

use hil_core::time::Instant;
use nix::errno::Errno;
use nix::fcntl::{FallocateFlags, OFlag, fallocate};
use serde::{Deserialize, Serialize};

use super::event::{Event, ProcessHistory};
use super::file_fault::{FileFault, RecordGap};
use super::nic_history::NicHistory;
use super::pipe::Failure;
use super::run_folder::RunFolder;
use crate::protection::RunSecurity;
use hil_platform::clock_discipline::HostDiscipline;
use hil_platform::host_facts::HostFacts;
use hil_platform::plain_file;

/// What `result.json` says it is.
pub const RUN_RESULT_FORMAT: &str = "hil-run-result";
/// Version of the layout of `result.json`. Within one, fields are only added.
pub const RUN_RESULT_VERSION: u32 = 3;

/// How a run ended.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// The planned time passed.
    Completed,
    /// A process ended by itself without a fault.
    EndedEarly(String),
    /// The user ended it.
    Interrupted(String),
    /// A process failed and its policy ended the run.
    Failed(Failure),
    /// A host could not write what the run needs or records. All hosts have the same.
    Unwritable {
        /// The host.
        host: String,
        /// The file that was refused first.
        fault: FileFault,
    },
    /// It failed on another host.
    PeerFailed {
        /// The host.
        host: String,
        /// Why it failed there.
        reason: String,
    },
    /// It was ended on another host.
    EndedByPeer(String),
    /// Another host vanished.
    PeerLost(String),
}

impl Outcome {
    /// In words.
    pub fn text(&self) -> String {
        match self {
            Self::Completed => "completed as planned".to_owned(),
            Self::EndedEarly(text) => format!("ended early: {text}"),
            Self::Interrupted(by) => format!("interrupted by {by}"),
            Self::Failed(_) | Self::Unwritable { .. } => format!("failed: {}", self.reason()),
            Self::PeerFailed { .. } => format!("failed {}", self.reason()),
            Self::EndedByPeer(text) => format!("ended by another host: {text}"),
            Self::PeerLost(text) => format!("another host vanished: {text}"),
        }
    }

    /// Why it ended so, to be said after a word for how.
    pub fn reason(&self) -> String {
        match self {
            Self::Completed => "as planned".to_owned(),
            Self::Failed(failure) => failure.text.clone(),
            Self::Unwritable { host, fault } => format!("{host} cannot write {fault}"),
            Self::PeerFailed { host, reason } => format!("on {host}: {reason}"),
            other => other.text(),
        }
    }
}

/// Everything a finished run knows, before any figure is computed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunResult {
    /// Where its files are: not in the file, which lies there.
    #[serde(skip)]
    pub folder: RunFolder,
    /// How it ended.
    pub outcome: Outcome,
    /// Start and end of the run on each host, on that host's own monotonic clock.
    pub spans: BTreeMap<String, (Instant, Instant)>,
    /// When it started, as people write it.
    pub started: String,
    /// What happened, on all hosts.
    pub events: Vec<Event>,
    /// How the processes of all hosts fared.
    pub processes: Vec<ProcessHistory>,
    /// What became of the network cards of all hosts; empty unless hardware stamps were asked
    /// for.
    pub cards: Vec<NicHistory>,
    /// True when all hosts read one clock.
    pub has_one_clock: bool,
    /// How the hops between hosts are protected; `None` when there are none.
    pub security: Option<RunSecurity>,
    /// Who steers each host's system clock, of the hosts that told.
    pub disciplines: BTreeMap<String, HostDiscipline>,
    /// Hosts that ran here.
    pub own_hosts: Vec<String>,
    /// Records that hosts lack after the exchange: of all hosts, as far as they could tell each other.
    #[serde(default)]
    pub gaps: Vec<RecordGap>,
    /// What else spoils the completeness of the report.
    pub problems: Vec<String>,
    /// Facts of this host.
    pub facts: HostFacts,
    /// The longest delay of each trace that a link replayed, by channel.
    pub trace_delays: BTreeMap<String, Duration>,
}

/// `result.json` cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum RunResultError {
    /// The file cannot be read or written.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// It does not say what it should.
    #[error("{path}: {source}")]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: serde_json::Error,
    },
    /// It is another file, or of another version.
    #[error(
        "{path}: format {format:?} version {version}; this program reads {RUN_RESULT_FORMAT:?} \
         version {RUN_RESULT_VERSION}"
    )]
    Version {
        /// The file.
        path: PathBuf,
        /// What it says it is.
        format: String,
        /// Its version.
        version: u32,
    },
}

/// The file: its kind and version, and beside them the fields of the result.
#[derive(Serialize)]
struct Written<'a> {
    format: &'static str,
    version: u32,
    #[serde(flatten)]
    result: &'a RunResult,
}

/// The part of the file that says whether the rest can be read.
#[derive(Deserialize)]
struct Head {
    format: String,
    version: u32,
}

/// Has the disk hold room for the `result.json` of the run in `folder`, so that a run that fills the disk
/// can be read afterwards. Where the file system cannot do that, nothing is held.
///
/// # Errors
/// When there is no room.
pub fn hold_room(folder: &RunFolder, bytes: u64) -> io::Result<()> {
    let file = plain_file::create_anew(&new_file(folder))?;
    let bytes = i64::try_from(bytes).map_err(io::Error::other)?;
    match fallocate(&file, FallocateFlags::empty(), 0, bytes) {
        Err(Errno::EOPNOTSUPP | Errno::ENOSYS) => Ok(()),
        other => other.map_err(io::Error::from),
    }
}

/// Where `result.json` is written before it gets its name.
fn new_file(folder: &RunFolder) -> PathBuf {
    folder.result().with_extension("json.new")
}

impl RunResult {
    /// Writes it into the run's folder, so that a reader finds it whole or not at all: into the room that
    /// was held for it, if there is some.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(&self) -> Result<(), RunResultError> {
        let path = self.folder.result();
        let written = Written {
            format: RUN_RESULT_FORMAT,
            version: RUN_RESULT_VERSION,
            result: self,
        };
        let text = match serde_json::to_string_pretty(&written) {
            Ok(text) => text,
            Err(source) => return Err(RunResultError::Content { path, source }),
        };
        // The room that was held is taken once.
        if fs::read_to_string(&path).is_ok_and(|there| there == text) {
            return Ok(());
        }
        let new = new_file(&self.folder);
        let options = File::options()
            .write(true)
            .create(true)
            .truncate(false)
            .custom_flags(OFlag::O_NOFOLLOW.bits())
            .open(&new);
        let written = options.and_then(|mut file| {
            file.write_all(text.as_bytes())?;
            file.set_len(text.len() as u64)
        });
        let done = written.and_then(|()| fs::rename(&new, &path));
        if done.is_err() {
            // The error that is told is the first one.
            let _left = fs::remove_file(&new).is_err();
        }
        done.map_err(|source| RunResultError::Io { path, source })
    }

    /// Reads that of the run in `folder`.
    ///
    /// # Errors
    /// When it is not there, not of this version, or damaged.
    pub fn read(folder: &RunFolder) -> Result<Self, RunResultError> {
        let path = folder.result();
        let text = match fs::read_to_string(&path) {
            Ok(text) => text,
            Err(source) => return Err(RunResultError::Io { path, source }),
        };
        let head = match serde_json::from_str::<Head>(&text) {
            Ok(head) => head,
            Err(source) => return Err(RunResultError::Content { path, source }),
        };
        if head.format != RUN_RESULT_FORMAT || head.version != RUN_RESULT_VERSION {
            let Head { format, version } = head;
            return Err(RunResultError::Version {
                path,
                format,
                version,
            });
        }
        match serde_json::from_str::<Self>(&text) {
            Ok(result) => Ok(Self {
                folder: folder.clone(),
                ..result
            }),
            Err(source) => Err(RunResultError::Content { path, source }),
        }
    }

    /// True when records are missing, or something could not be taken down: the report is not
    /// what the run should have left.
    pub fn has_gaps(&self) -> bool {
        let reports = self
            .processes
            .iter()
            .filter_map(|process| process.report.as_ref());
        let mut failures = reports.flat_map(|report| &report.recorder_failures);
        !self.problems.is_empty() || !self.gaps.is_empty() || failures.next().is_some()
    }
}
