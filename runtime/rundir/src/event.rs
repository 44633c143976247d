//! What happened during a run beside the messages: processes that died, restarted or complained,
//! and what each said at its end. Plain data that hosts exchange.

use std::collections::BTreeMap;
use std::fmt;
use std::net::IpAddr;

use hil_core::time::Instant;
use serde::{Deserialize, Serialize};

use crate::file_fault::FileFault;
use crate::nic_history::NicHistory;
use crate::pipe::ProcessReport;
use hil_platform::clock_discipline::HostDiscipline;

/// One thing that happened.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Event {
    /// When it was noticed, on that host's monotonic clock.
    pub at: Instant,
    /// The host it happened on.
    pub host: String,
    /// The process concerned; the host's name for the host as a whole.
    pub process: String,
    /// What happened.
    pub kind: EventKind,
    /// Set when the process carried no messages for a while.
    pub interruption: Option<Interruption>,
}

/// What happened to a process.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum EventKind {
    /// It ended and was started again.
    Restarted {
        /// How it ended.
        end: String,
        /// Which start after the first this is.
        restart: u32,
        /// How many there may be.
        limit: u32,
    },
    /// It could not be started again.
    StartFailed {
        /// Why.
        error: String,
    },
    /// It ended, and the run needs it no more: a clock path, beside which data paths exchange clocks.
    GivenUp {
        /// How it ended.
        end: String,
    },
    /// It ended, and with it the run.
    EndedRun {
        /// How it ended.
        end: String,
    },
    /// It cannot record any more, and with that the run ends. How the run ended tells why.
    Unrecorded {
        /// The first of its files that was not written.
        fault: FileFault,
    },
    /// It did not end when it was told to.
    Killed {
        /// How long it was waited for, seconds.
        patience_s: u64,
    },
    /// It hangs, or gets no processor.
    Silent {
        /// How long it gave no sign of life, seconds.
        limit_s: u64,
    },
    /// It was silent and gives signs of life again.
    Responsive,
    /// It printed more than its log keeps.
    OutputCut {
        /// What was left out of the middle, bytes.
        left_out_bytes: u64,
    },
    /// It complained more often than is kept.
    WarningsLeftOut {
        /// How many of its warnings are not told.
        count: u64,
    },
    /// The supervisor's connection to another host was cut and came back; what was said was said once, in order.
    Reconnected {
        /// The other host.
        peer: String,
        /// How long there was no connection, milliseconds.
        away_ms: u64,
        /// How it was cut.
        cause: String,
    },
    /// Another link address answers for another host on the network, and gets what is sent to it.
    NeighbourChanged {
        /// The other host.
        peer: String,
        /// Its address.
        address: IpAddr,
        /// The interface by which it is reached.
        interface: String,
        /// Its link address so far.
        before: String,
        /// The one from now on.
        now: String,
    },
    /// It complained.
    Warning {
        /// What it said.
        text: String,
    },
}

impl fmt::Display for EventKind {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Restarted {
                end,
                restart,
                limit,
            } => write!(formatter, "{end}; restart {restart} of at most {limit}"),
            Self::StartFailed { error } => formatter.write_str(error),
            Self::GivenUp { end } => write!(
                formatter,
                "{end}; policy: the run goes on, with the clock exchanges of the data path"
            ),
            Self::EndedRun { end } => write!(formatter, "{end}; policy: end the run"),
            Self::Unrecorded { fault } => write!(
                formatter,
                "cannot record any more, first in {}; policy: end the run",
                fault.file_name()
            ),
            Self::Killed { patience_s } => {
                write!(
                    formatter,
                    "did not stop within {patience_s} s and was killed"
                )
            }
            Self::Silent { limit_s } => write!(
                formatter,
                "gave no sign of life for {limit_s} s: it hangs, or gets no processor"
            ),
            Self::Responsive => formatter.write_str("gives signs of life again"),
            Self::OutputCut { left_out_bytes } => write!(
                formatter,
                "printed more than its log keeps: {left_out_bytes} bytes in the middle were left out"
            ),
            Self::WarningsLeftOut { count } => write!(
                formatter,
                "{count} more warnings of it found no room among the events"
            ),
            Self::Reconnected {
                peer,
                away_ms,
                cause,
            } => write!(
                formatter,
                "the connection to {peer} was cut ({cause}) and is back after {away_ms} ms, with nothing missing"
            ),
            Self::NeighbourChanged {
                peer,
                address,
                interface,
                before,
                now,
            } => write!(
                formatter,
                "{peer} ({address}) is at {now} on {interface}, no longer at {before}: what is sent to it goes there"
            ),
            Self::Warning { text } => formatter.write_str(text),
        }
    }
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
    /// Records what programs of the user's publish and are given.
    Witness,
}

impl ProcessKind {
    /// True for what runs by a timer whose ticks this program counts.
    pub const fn counts_ticks(self) -> bool {
        matches!(self, Self::Component)
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
            Self::Witness => "records of own programs".to_owned(),
        }
    }
}

/// One process of the run, as its supervisor knows it at the end.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProcessHistory {
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
pub struct HostHistory {
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
    pub processes: Vec<ProcessHistory>,
    /// What became of the network cards it armed.
    #[serde(default)]
    pub cards: Vec<NicHistory>,
}

/// Who steers the system clock, by host.
pub fn disciplines(stories: &[HostHistory]) -> BTreeMap<String, HostDiscipline> {
    let told = stories.iter().flat_map(|story| {
        let discipline = story.discipline.as_ref();
        let hosts = story.hosts.iter();
        hosts.filter_map(move |host| Some((host.clone(), discipline?.clone())))
    });
    told.collect()
}
