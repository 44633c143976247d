//! What happened during a run beside the messages: processes that died, restarted or complained,
//! and what each said at its end. Plain data that hosts exchange.

use std::collections::BTreeMap;

use hil_models::time::Instant;
use serde::{Deserialize, Serialize};

use crate::platform::clock_discipline::HostDiscipline;
use crate::rundir::card_story::CardStory;
use crate::rundir::pipe::ProcessReport;

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

/// One process of the run, as its supervisor knows it at the end.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProcessStory {
    /// Name in the topology, or of a gateway.
    pub name: String,
    /// The host it ran on.
    pub host: String,
    /// The role it played.
    pub role: String,
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
pub fn disciplines(stories: &[HostStory]) -> BTreeMap<String, HostDiscipline> {
    let told = stories.iter().flat_map(|story| {
        let discipline = story.discipline.as_ref();
        let hosts = story.hosts.iter();
        hosts.filter_map(move |host| Some((host.clone(), discipline?.clone())))
    });
    told.collect()
}
