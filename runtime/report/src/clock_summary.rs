//! How the clocks of a run's hosts relate, as a summary keeps it. What it follows from is decided
//! in the analysis.

use std::collections::BTreeMap;

use hil_clock::ClockMetrics;
use serde::{Deserialize, Serialize};

use hil_platform::clock_discipline::HostDiscipline;
use hil_topology::describe_end;

/// The clocks of all hosts.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ClockSection {
    /// True when all hosts read one clock, so that stamps compare as they are.
    pub has_one_clock: bool,
    /// Who steers each host's system clock, by host; nothing of a host that told nothing.
    pub hosts: BTreeMap<String, HostDiscipline>,
    /// Every pair of hosts with a link between them, once.
    pub pairs: Vec<HostPairClock>,
}

hil_core::labelled! {
    /// What the one-way figures between two hosts rest on.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum ClockRung, label {
        /// Both read one clock: exact.
        OneClock = "one clock",
        /// Both system clocks follow one reference, each within a bound of its own.
        Disciplined = "system clocks disciplined to one reference",
        /// The four-stamp exchanges of the gateways.
        Exchanges = "exchanges beside the data",
        /// Nothing: no figure crosses from one host to the other.
        None = "not aligned",
    }
}

impl ClockRung {
    /// The same, where some of the exchanges may have come over a clock path.
    pub const fn words(self, has_path_exchanges: bool) -> &'static str {
        match self {
            Self::Exchanges if has_path_exchanges => {
                "exchanges over the clock path, and beside the data"
            }
            other => other.label(),
        }
    }
}

/// Two hosts' clocks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct HostPairClock {
    /// Instants of this host ...
    pub from: String,
    /// ... on the clock of this one: `to = from + offset`.
    pub to: String,
    /// What was used.
    pub rung: ClockRung,
    /// Why no rung above it was used, or what it rests on, in words.
    pub basis: String,
    /// What the gateways' exchanges say, whatever was used.
    pub exchanges: Option<ClockMetrics>,
    /// What the disciplined system clocks say, when they say something.
    #[serde(default)]
    pub disciplined: Option<DisciplinedOffset>,
    /// Set when the rungs contradict each other: one-way delays of this run are invalid, and why.
    #[serde(default)]
    pub contradiction: Option<String>,
    /// The clock path between them, where the topology has one.
    #[serde(default)]
    pub clock_path: Option<ClockPathSummary>,
}

impl HostPairClock {
    /// What was used, in the words of a report.
    pub fn rung_words(&self) -> &'static str {
        let path = self.clock_path.as_ref();
        let has_exchanges = path.is_some_and(ClockPathSummary::has_exchanges);
        self.rung.words(has_exchanges)
    }
}

/// What came over a clock path, beside what the data path gave.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ClockPathSummary {
    /// Its name in records, `clock/<host>-<host>`.
    pub name: String,
    /// The end that asks, and the one that answers.
    pub ends: [ClockPathEnd; 2],
    /// How the end that asks stood to the other at the end of the run, in words.
    pub state: String,
    /// What its exchanges say by themselves; `None` when there were none.
    pub exchanges: Option<ClockMetrics>,
    /// What the exchanges of the data path say by themselves; `None` when there were none.
    pub data_path: Option<ClockMetrics>,
    /// The longest time of the run without an exchange over it, nanoseconds on the clock of the host
    /// that asks; `None` when there was none at all, or that host did not say when the run was.
    pub longest_gap_ns: Option<u64>,
}

/// One end of a clock path.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockPathEnd {
    /// The host.
    pub host: String,
    /// Its address on the path.
    pub address: String,
    /// Interface it is bound to, when the topology names one.
    pub interface: Option<String>,
}

impl ClockPathSummary {
    /// True when anything came over it.
    pub const fn has_exchanges(&self) -> bool {
        self.exchanges.is_some()
    }

    /// `clock path 10.78.0.1 (eth1) <-> 10.78.0.2 (eth1)`.
    pub fn describe(&self) -> String {
        let [from, to] = self
            .ends
            .each_ref()
            .map(|end| describe_end(&end.address, end.interface.as_deref()));
        format!("clock path {from} <-> {to}")
    }
}

/// The offset of two monotonic clocks by way of their disciplined system clocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct DisciplinedOffset {
    /// Nanoseconds to add.
    pub offset_ns: i64,
    /// Largest error: that of both hosts together.
    pub bound_ns: u64,
}
