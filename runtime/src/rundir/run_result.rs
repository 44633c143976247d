//! How a run ended, and everything it knows before any figure is computed.

use std::collections::BTreeMap;

use hil_models::time::Instant;

use super::card_story::CardStory;
use super::event::{Event, ProcessStory};
use super::run_folder::RunFolder;
use crate::platform::clock_discipline::HostDiscipline;
use crate::platform::host_facts::HostFacts;

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
    /// How the hops between hosts are protected, in words; `None` when there are none.
    pub security: Option<String>,
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
