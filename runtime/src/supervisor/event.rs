//! What happened during a run beside the messages: processes that died, restarted or complained,
//! and what each said at its end. Plain data that hosts exchange.

use std::collections::BTreeMap;

use hil_models::time::Instant;
use serde::{Deserialize, Serialize};

use crate::card_clock::CardStory;
use crate::clock_discipline::HostDiscipline;
use crate::process::pipe::ProcessReport;

/// One thing that happened.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Event {
    /// When it was noticed, on that host's monotonic clock.
    pub at: Instant,
    /// The host it happened on.
    pub host: String,
    /// The process concerned; empty for the host as a whole.
    pub process: String,
    /// What happened, in words.
    pub what: String,
    /// Set when the process carried no messages for a while.
    pub interruption: Option<Interruption>,
}

/// A time in which a process was not there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Interruption {
    /// Last moment it was known to live, less what its queues may have held.
    pub from: Instant,
    /// When its successor was ready; `None` if there was none.
    pub until: Option<Instant>,
}

/// What a process of a run is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ProcessKind {
    /// Plays a role of the case in this program.
    Component,
    /// Carries the messages of a link.
    Gateway,
    /// Exchanges clocks over a path of their own and carries no message.
    ClockPath,
    /// Lets a foreign program play a role over that program's own protocol.
    Adapter,
    /// A program of the user's.
    OwnProgram,
}

impl ProcessKind {
    /// True for what runs by a timer whose ticks this program counts. Without that count nobody can tell
    /// the host's delays from the network's.
    pub const fn counts_ticks(self) -> bool {
        match self {
            Self::Component => true,
            Self::Gateway | Self::ClockPath | Self::Adapter | Self::OwnProgram => false,
        }
    }

    /// What a report calls a process of this kind that plays `role`.
    pub fn label(self, role: Option<&str>) -> String {
        let role = role.unwrap_or_default();
        match self {
            Self::Component => role.to_owned(),
            Self::Gateway => "gateway".to_owned(),
            Self::ClockPath => "clock path".to_owned(),
            Self::Adapter => format!("{role} by foreign program"),
            Self::OwnProgram => "own program".to_owned(),
        }
    }
}

/// One process of the run, as its supervisor knows it at the end.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProcessStory {
    /// Name in the topology, or of a gateway.
    pub name: String,
    /// The host it ran on.
    pub host: String,
    /// What it was.
    pub kind: ProcessKind,
    /// The role of the case that it played, or that a foreign program played through it.
    pub role: Option<String>,
    /// How it ended, in words.
    pub end: String,
    /// How often it was started again.
    pub restart_count: u32,
    /// What it said last; `None` when it did not end in order.
    pub report: Option<ProcessReport>,
}

/// What one host tells of its share of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct HostStory {
    /// The hosts that ran under one supervisor, and so on one clock.
    pub hosts: Vec<String>,
    /// Start and end of the run on that clock.
    pub span: (Instant, Instant),
    /// What happened, in order of time.
    pub events: Vec<Event>,
    /// Who steers the system clock; `None` when not even the kernel says.
    #[serde(default)]
    pub discipline: Option<HostDiscipline>,
    /// How the processes fared.
    pub processes: Vec<ProcessStory>,
    /// What became of the network cards it armed.
    #[serde(default)]
    pub cards: Vec<CardStory>,
}

/// Who steers the system clock, by host.
pub(super) fn disciplines(stories: &[HostStory]) -> BTreeMap<String, HostDiscipline> {
    let told = stories.iter().flat_map(|story| {
        let discipline = story.discipline.as_ref();
        let hosts = story.hosts.iter();
        hosts.filter_map(move |host| Some((host.clone(), discipline?.clone())))
    });
    told.collect()
}
