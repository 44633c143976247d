//! How a run can end, what it leaves in memory, and why it may not come about. It decides nothing
//! by itself.

use std::collections::BTreeMap;
use std::io;
use std::path::PathBuf;

use hil_core::layout::Field;

use super::domains::DomainsError;
use super::frame::PeerMessage;
use super::meet::PeerError;
use super::needs::HostTooSmall;
use crate::process::own_program::ProgramsUnfit;
use crate::security::KeyFileError;
use hil_rundir::run_result::Outcome;
use hil_shm::DomainError;
use hil_topology::emulation::EmulationError;

/// What the command line asks of a run beyond the topology.
#[derive(Debug, Clone, Default)]
pub struct RunOptions {
    /// Names of the hosts that run here; at least one.
    pub hosts: Vec<String>,
    /// Folder for shared-memory domains, if not the default.
    pub domain_root: Option<PathBuf>,
    /// The topology file, for the manifest.
    pub topology_file: PathBuf,
    /// The revision of the program's sources, for the manifest; `None` outside a git checkout.
    pub revision: Option<&'static str>,
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
    /// This host gives less than the run takes.
    #[error(transparent)]
    HostTooSmall(#[from] HostTooSmall),
    /// Shared memory cannot be set up.
    #[error(transparent)]
    Domains(#[from] DomainsError),
    /// The host's identity cannot be read.
    #[error(transparent)]
    Identity(#[from] DomainError),
    /// The other hosts did not come.
    #[error(transparent)]
    Peer(#[from] PeerError),
    /// A program of the user's is not there.
    #[error(transparent)]
    Programs(#[from] ProgramsUnfit),
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

/// What came from a peer during the run.
pub(super) enum Heard {
    Said(PeerMessage),
    Stopped { host: String, outcome: Outcome },
    Lost(String),
}

impl Heard {
    pub(super) fn named(self, host: &str) -> Self {
        match self {
            Self::Said(PeerMessage::Stop(outcome)) => Self::Stopped {
                host: host.to_owned(),
                outcome,
            },
            other => other,
        }
    }

    /// What it means for the run here; `None` when nothing.
    pub(super) fn outcome(self) -> Option<Outcome> {
        match self {
            Self::Said(_) => None,
            Self::Stopped { host, outcome } => Some(match outcome {
                Outcome::EndedEarly(reason) => Outcome::EndedEarly(format!("on {host}, {reason}")),
                Outcome::Interrupted(by) => {
                    Outcome::EndedByPeer(format!("{host} interrupted by {by}"))
                }
                Outcome::Failed(failure) => Outcome::PeerFailed {
                    host,
                    reason: failure.text,
                },
                Outcome::PeerLost(reason) => Outcome::PeerFailed {
                    host,
                    reason: Outcome::PeerLost(reason).text(),
                },
                // What the first host heard of a third one.
                same @ (Outcome::Completed
                | Outcome::Unwritable { .. }
                | Outcome::PeerFailed { .. }
                | Outcome::EndedByPeer(_)) => same,
            }),
            Self::Lost(text) => Some(Outcome::PeerLost(text)),
        }
    }
}
