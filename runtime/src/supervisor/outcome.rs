//! How a run can end, what it leaves in memory, and why it may not come about. It decides nothing
//! by itself.

use std::collections::BTreeMap;
use std::io;
use std::path::PathBuf;

use hil_models::layout::Field;
use hil_models::time::Instant;

use super::crew::CrewError;
use super::domains::DomainsError;
use super::event::{Event, ProcessStory};
use super::frame::{EndMeaning, PeerMessage};
use super::meet::PeerError;
use crate::card_clock::CardStory;
use crate::channel::DomainError;
use crate::clock_discipline::HostDiscipline;
use crate::host_facts::HostFacts;
use crate::process::launch::EmulationError;
use crate::run_folder::RunFolder;
use crate::security::{KeyFileError, RunSecurity};

/// What the command line asks of a run beyond the topology.
#[derive(Debug, Clone, Default)]
pub struct RunOptions {
    /// Names of the hosts that run here; at least one.
    pub hosts: Vec<String>,
    /// Folder for shared-memory domains, if not the default.
    pub domain_root: Option<PathBuf>,
    /// The command line, for the manifest.
    pub command_line: Vec<String>,
    /// The fields of the channels whose messages are known, by channel, for the manifest.
    pub layouts: BTreeMap<String, &'static [Field]>,
}

/// Why a run did not come about.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The run folder cannot be written.
    #[error("no run folder can be made below {folder}: {source}; run.record names another place")]
    Folder {
        /// Parent folder.
        folder: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// Shared memory cannot be set up.
    #[error(transparent)]
    Domains(#[from] DomainsError),
    /// The host's identity cannot be read.
    #[error(transparent)]
    Identity(#[from] DomainError),
    /// The other hosts did not come.
    #[error(transparent)]
    Peer(#[from] PeerError),
    /// A process cannot be started.
    #[error("{0}")]
    Start(String),
    /// The topology does not say whether strangers may read and forge its messages.
    #[error("{0}")]
    SecurityUnsaid(String),
    /// The key file cannot be used.
    #[error(transparent)]
    Key(KeyFileError),
    /// The system gives no random numbers.
    #[error("cannot draw the run's secret: {0}")]
    Random(io::Error),
    /// The first host did not give the run's secret.
    #[error("the run's secret did not come: {0}")]
    SecretMissing(String),
    /// An emulated link asks for more than a gateway can hold.
    #[error("the emulated link cannot be kept: {0}")]
    Emulation(EmulationError),
}

impl From<CrewError> for RunError {
    fn from(error: CrewError) -> Self {
        Self::Start(error.to_string())
    }
}

/// How a run ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// The planned time passed.
    Completed,
    /// A process ended by itself without a fault.
    EndedEarly(String),
    /// The user ended it.
    Interrupted(String),
    /// A process failed and its policy ended the run.
    Failed(String),
    /// Another host ended it.
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
            Self::Failed(text) => format!("failed: {text}"),
            Self::EndedByPeer(text) => format!("ended by another host: {text}"),
            Self::PeerLost(text) => format!("another host vanished: {text}"),
        }
    }

    /// Why it ended so, to be said after a word for how.
    pub fn reason(&self) -> String {
        match self {
            Self::Completed => "as planned".to_owned(),
            Self::Failed(text) => text.clone(),
            other => other.text(),
        }
    }

    /// How the other hosts are to take it.
    pub(super) fn meaning(&self) -> EndMeaning {
        match self {
            Self::Completed => EndMeaning::Planned,
            Self::EndedEarly(_) => EndMeaning::Early,
            Self::Interrupted(_) | Self::Failed(_) | Self::EndedByPeer(_) | Self::PeerLost(_) => {
                EndMeaning::Broken
            }
        }
    }
}

/// Everything a finished run knows, before any figure is computed.
#[derive(Debug)]
pub struct RunResult {
    /// Where its files are.
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
    pub processes: Vec<ProcessStory>,
    /// What became of the network cards of all hosts; empty unless hardware stamps were asked
    /// for.
    pub cards: Vec<CardStory>,
    /// True when all hosts read one clock.
    pub has_one_clock: bool,
    /// How the hops between hosts are protected; `None` when there are none.
    pub security: Option<RunSecurity>,
    /// Who steers each host's system clock, of the hosts that told.
    pub disciplines: BTreeMap<String, HostDiscipline>,
    /// Hosts that ran here.
    pub own_hosts: Vec<String>,
    /// What spoils the completeness of the report.
    pub problems: Vec<String>,
    /// Facts of this host.
    pub facts: HostFacts,
}

impl RunResult {
    /// True when records are missing, or something could not be taken down: the report is not
    /// what the run should have left.
    pub fn has_gaps(&self) -> bool {
        let reports = self
            .processes
            .iter()
            .filter_map(|process| process.report.as_ref());
        let mut failures = reports.flat_map(|report| &report.recorder_failures);
        !self.problems.is_empty() || failures.next().is_some()
    }
}

/// What came from a peer during the run.
pub(super) enum Heard {
    Said(PeerMessage),
    Stopped {
        host: String,
        reason: String,
        meaning: EndMeaning,
    },
    Lost(String),
}

impl Heard {
    pub(super) fn named(self, host: &str) -> Self {
        match self {
            Self::Said(PeerMessage::Stop { reason, meaning }) => Self::Stopped {
                host: host.to_owned(),
                reason,
                meaning,
            },
            other => other,
        }
    }

    /// What it means for the run here; `None` when nothing.
    pub(super) fn outcome(self) -> Option<Outcome> {
        match self {
            Self::Said(_) => None,
            Self::Stopped {
                host,
                reason,
                meaning,
            } => Some(match meaning {
                EndMeaning::Planned => Outcome::Completed,
                EndMeaning::Early => Outcome::EndedEarly(format!("on {host}, {reason}")),
                EndMeaning::Broken => Outcome::EndedByPeer(format!("{host} {reason}")),
            }),
            Self::Lost(text) => Some(Outcome::PeerLost(text)),
        }
    }
}
