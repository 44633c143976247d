//! The serialisable summary of a run, schema version 3. It holds figures, not judgements: those
//! are drawn from them in [`super::assessment`] whenever a summary is written.
//!
//! `summary.json` is one object with the fields of [`RunSummary`] under their own names plus
//! `answer` and `assessment`. Within a schema version fields are only added; a reader ignores what it does
//! not know. Units are part of the names.

use core::fmt;
use hil_core::interval::Spread;
use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};

use hil_account::flow::{DeadlineMetrics, FlowMetrics};
use hil_account::{ChannelAccount, DemandMetrics, MessageFate, OutageMetrics};
use hil_core::case_study::{Metric, Score};
use hil_core::link_model::ReplayCounts;
use hil_link::condition::flow_label;
use hil_link::spec::Way;
use hil_protocol::transport::Description;
use serde::{Deserialize, Serialize};

use super::adapter::AdapterSummary;
use super::answer::{Answer, HarmCount, with_note};
use super::assessment::Assessment;
use super::clock_summary::ClockSection;
use super::emulation::EmulationMetrics;
use super::link_change::LinkChange;
use super::network::NetworkReport;
use super::radio::RadioReport;
use super::score_event::ScoreEvents;
use crate::analysis::write_whole;
use crate::nic_metrics::HardwareStamps;
use crate::sections::channel::with_spread;
use hil_platform::host_facts::HostFacts;
use hil_platform::text::grouped;
use hil_present::UNAVAILABLE;
use hil_present::units::duration_s;
use hil_rundir::event::{EventKind, ProcessKind};
use hil_rundir::file_fault::RecordGap;
use hil_rundir::launch::Side;
use hil_rundir::pipe::StallMetrics;
pub use hil_rundir::pipe::{CountByName, CounterGroup};
use hil_rundir::protection::RunSecurity;
use hil_topology::emulation::EmulationLaunch;
use hil_topology::{Channel, Topology, Via};

/// Version of the `summary.json` layout.
pub const SCHEMA_VERSION: u32 = 3;

/// Everything a finished run has to say.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunSummary {
    /// [`SCHEMA_VERSION`] of the writer.
    pub schema_version: u32,
    /// What was run, when, and how it ended.
    pub run: RunFacts,
    /// What the host is.
    pub host_facts: HostFacts,
    /// What real-time settings the kernel granted and refused.
    pub realtime: RealtimeFacts,
    /// How the hosts' clocks relate, and what that rests on.
    #[serde(default)]
    pub clocks: Option<ClockSection>,
    /// The processes of the run.
    pub processes: Vec<ProcessSummary>,
    /// What happened, in order of time.
    pub events: Vec<RunEvent>,
    /// Changes of emulated links while the run went on, by hand or by a program, in order of time.
    #[serde(default)]
    pub link_changes: Vec<LinkChange>,
    /// The channels, in the order of the case study.
    pub channels: Vec<ChannelSummary>,
    /// The channels of Ethernet frames by flow.
    #[serde(default)]
    pub flows: Vec<ChannelFlows>,
    /// How the requests of flows with a deadline were answered.
    #[serde(default)]
    pub deadlines: Vec<DeadlineMetrics>,
    /// The gateway threads that carried them; empty where none crossed a link.
    #[serde(default)]
    pub directions: Vec<DirectionSummary>,
    /// Arms that went through an adapter to a foreign program.
    #[serde(default)]
    pub faces: Vec<AdapterSummary>,
    /// What the network cards stamped; `None` unless hardware stamps were asked for.
    #[serde(default)]
    pub hardware_stamps: Option<HardwareStamps>,
    /// What the radios of wireless hops said, and where messages were stamped.
    #[serde(default)]
    pub radio: RadioReport,
    /// What the robot did.
    pub score: Vec<ScoreMetric>,
    /// What hurt the robot, the gravest first.
    #[serde(default)]
    pub harms: Vec<HarmCount>,
    /// Names of the figures of the score that a reader wants to see first.
    #[serde(default)]
    pub headline: Vec<String>,
    /// What happened to the robot, and what the network had done to the messages concerned.
    #[serde(default)]
    pub score_events: ScoreEvents,
    /// The network in the field's terms, and on one axis with the robot; `None` when no channel
    /// crossed one.
    #[serde(default)]
    pub network: Option<NetworkReport>,
    /// Records that hosts lack: what is lost cannot be told from what is not known.
    #[serde(default)]
    pub record_gaps: Vec<RecordGap>,
    /// Anything else a reader must know; [`Assessment::warnings`] come on top.
    pub warnings: Vec<String>,
}

impl RunSummary {
    /// A summary with nothing but its run facts.
    pub fn new(run: RunFacts) -> Self {
        Self {
            schema_version: SCHEMA_VERSION,
            run,
            host_facts: HostFacts::default(),
            realtime: RealtimeFacts::default(),
            clocks: None,
            processes: Vec::new(),
            events: Vec::new(),
            link_changes: Vec::new(),
            channels: Vec::new(),
            flows: Vec::new(),
            deadlines: Vec::new(),
            directions: Vec::new(),
            faces: Vec::new(),
            hardware_stamps: None,
            radio: RadioReport::default(),
            score: Vec::new(),
            harms: Vec::new(),
            headline: Vec::new(),
            score_events: ScoreEvents::default(),
            network: None,
            record_gaps: Vec::new(),
            warnings: Vec::new(),
        }
    }

    /// Why nothing is known of the robot of a case; `None` where something is, and of programs alone.
    pub(crate) fn no_score_words(&self) -> Option<String> {
        let has_score = self.score.iter().any(|one| one.value.is_some())
            || self.harms.iter().any(|one| one.count.is_some())
            || self.score_events.total_count() > 0;
        if has_score || self.run.case.is_empty() {
            return None;
        }
        let first = self.score.first();
        let why = first.map_or("the case gave no score", |one| &one.method);
        Some(format!("{UNAVAILABLE}: {why}"))
    }

    /// Takes what the case says of the robot, but the events, which need their messages.
    pub(crate) fn put_score(&mut self, score: &Score) {
        self.score = ScoreMetric::all_of(score);
        self.harms = score.harms.iter().map(HarmCount::from).collect();
        self.headline = score
            .headline
            .iter()
            .map(|name| (*name).to_owned())
            .collect();
    }

    /// The text of `summary.json`, with answer and assessment drawn from the figures.
    ///
    /// # Errors
    /// When a figure cannot be represented.
    pub fn to_json(&self) -> Result<String, SummaryError> {
        #[derive(Serialize)]
        struct Document<'a> {
            answer: Answer,
            #[serde(flatten)]
            summary: &'a RunSummary,
            assessment: Assessment,
        }
        let assessment = Assessment::of(self);
        let document = Document {
            answer: Answer::of(self, &assessment),
            summary: self,
            assessment,
        };
        serde_json::to_string_pretty(&document).map_err(SummaryError::Encode)
    }

    /// Reads the text of `summary.json`.
    ///
    /// # Errors
    /// When it is not JSON of this layout, or of another schema version.
    pub fn from_json(text: &str) -> Result<Self, SummaryError> {
        /// Read first, so that another layout is named as such instead of as a missing field.
        #[derive(Deserialize)]
        struct Version {
            schema_version: u32,
        }
        let version: Version = serde_json::from_str(text).map_err(SummaryError::Decode)?;
        if version.schema_version != SCHEMA_VERSION {
            return Err(SummaryError::OtherSchema {
                found: version.schema_version,
            });
        }
        serde_json::from_str(text).map_err(SummaryError::Decode)
    }

    /// Writes `summary.json` at `path`, whole or not at all: a reader never sees half a file.
    ///
    /// # Errors
    /// When the file cannot be written; names the path.
    pub fn write(&self, path: &Path) -> Result<(), SummaryError> {
        let text = self.to_json()?;
        let partial = path.with_extension("json.partial");
        write_whole(&partial, &text)
            .and_then(|()| std::fs::rename(&partial, path))
            .map_err(|source| SummaryError::Write {
                path: path.to_owned(),
                source,
            })
    }
}

/// Why a summary could not be written or read.
#[derive(Debug, thiserror::Error)]
pub enum SummaryError {
    /// A figure cannot be represented.
    #[error("the summary cannot be encoded")]
    Encode(#[source] serde_json::Error),
    /// Not JSON, or not this layout.
    #[error("not a run summary of schema version {SCHEMA_VERSION}")]
    Decode(#[source] serde_json::Error),
    /// Written by another version of the program.
    #[error("schema version {found} is not {SCHEMA_VERSION}, the one that is read")]
    OtherSchema {
        /// Version of the file.
        found: u32,
    },
    /// The file cannot be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// Which file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
}

/// What was run, when, and how it ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunFacts {
    /// Name of the run.
    pub name: String,
    /// Name of the case study.
    pub case: String,
    /// The topology file, as given.
    pub topology_file: String,
    /// Hash of the topology's text.
    pub topology_hash: String,
    /// The emulated links and what they do, in words.
    #[serde(default)]
    pub links: Vec<Fact>,
    /// Seed of every random stream.
    pub seed: u64,
    /// How the hops between hosts were protected; `None` when there were none.
    #[serde(default)]
    pub security: Option<RunSecurity>,
    /// True for a run in virtual time, which has no host, no process and no record.
    #[serde(default)]
    pub is_virtual: bool,
    /// The host that wrote this summary.
    pub host: String,
    /// Wall-clock time of the start, with its zone.
    pub started: String,
    /// The start on each host's own monotonic clock, nanoseconds; nothing of a host that told
    /// nothing.
    #[serde(default)]
    pub starts_ns: BTreeMap<String, i64>,
    /// Length of the run, seconds.
    pub duration_s: f64,
    /// How it ended.
    pub outcome: Outcome,
    /// Why it ended, in words.
    pub exit_reason: String,
    /// Folder with the records.
    pub folder: String,
    /// Files in the folder and what they hold.
    pub files: Vec<Fact>,
    /// The command that repeats the run.
    pub repeat_command: String,
}

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// Ran its full length.
    Completed,
    /// Ran, but a result failed its criterion.
    CriterionFailed,
    /// Stopped before its end by a person, a signal or the peer.
    Stopped,
    /// Could not go on.
    Failed,
}

/// A label and its value.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fact {
    /// What.
    pub label: String,
    /// Its value.
    pub value: String,
}

impl Fact {
    /// `label` is `value`.
    pub fn new(label: impl Into<String>, value: impl Into<String>) -> Self {
        Self {
            label: label.into(),
            value: value.into(),
        }
    }
}

impl fmt::Display for Fact {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{}: {}", self.label, self.value)
    }
}

/// The emulated links of `topology`: each once, or once a way where the ways differ, and once a trace.
pub(crate) fn emulated_links(topology: &Topology) -> Vec<Fact> {
    let mut by_link: BTreeMap<String, [BTreeSet<String>; 2]> = BTreeMap::new();
    for crossing in topology.crossings() {
        if let Some(emulation) = EmulationLaunch::of(&crossing, topology.run().seed) {
            let words = emulation.describe();
            let [forward, backward] = by_link.entry(emulation.link).or_default();
            match emulation.way {
                Way::Forward => forward.insert(words),
                Way::Backward => backward.insert(words),
            };
        }
    }
    let mut facts = Vec::new();
    for (link, [forward, backward]) in by_link {
        let facts_of = |label: String, all: BTreeSet<String>| {
            all.into_iter()
                .map(move |words| Fact::new(label.clone(), words))
        };
        if forward == backward {
            facts.extend(facts_of(link, forward));
        } else {
            facts.extend(facts_of(
                format!("{link}, {}", Way::Forward.word()),
                forward,
            ));
            facts.extend(facts_of(
                format!("{link}, {}", Way::Backward.word()),
                backward,
            ));
        }
    }
    facts
}

/// The facts of a host, for a reader.
pub(crate) fn host_words(host: &HostFacts) -> Vec<Fact> {
    let facts = host.facts.iter();
    let words = facts.map(|one| Fact::new(one.label.replace('_', " "), one.value.to_text()));
    words.collect()
}

/// What real-time settings the kernel granted and refused.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RealtimeFacts {
    /// Granted: who, and what.
    pub granted: Vec<Fact>,
    /// Refused: who, and what with the reason.
    pub refused: Vec<Fact>,
}

/// One process. `None` where it left no figure, e.g. because it was killed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProcessSummary {
    /// Its name in the topology.
    pub name: String,
    /// The host it ran on.
    pub host: String,
    /// What it was.
    pub kind: ProcessKind,
    /// The role of the case study that it played, or that a foreign program played through it.
    pub role: Option<String>,
    /// How it ended, in words.
    pub exit: String,
    /// Starts after the first.
    pub restart_count: u64,
    /// How long its role took to prepare, seconds; `None` for a process without a role.
    #[serde(default)]
    pub preparation_s: Option<f64>,
    /// Periodic ticks it ran; `None` for a process without a period.
    pub tick_count: Option<u64>,
    /// Ticks it could not run in time and passed over.
    pub skipped_tick_count: Option<u64>,
    /// Processor time, seconds.
    pub cpu_time_s: Option<f64>,
    /// Context switches it asked for.
    pub voluntary_switch_count: Option<u64>,
    /// Context switches forced on it.
    pub involuntary_switch_count: Option<u64>,
    /// Messages of a wrong size or port it refused.
    pub malformed_count: Option<u64>,
    /// Messages its component could not put into a full outbox.
    pub outbox_drop_count: Option<u64>,
    /// Records it could not write because the recorder was full.
    pub recorder_drop_count: Option<u64>,
}

impl ProcessSummary {
    /// What a report calls it.
    pub(crate) fn label(&self) -> String {
        self.kind.label(self.role.as_deref())
    }

    /// Its starts of which nothing was counted: all but the last, and that one if it did not end in order.
    pub(crate) fn uncounted_start_count(&self) -> u64 {
        self.restart_count + u64::from(self.cpu_time_s.is_none())
    }
}

/// Something that happened during the run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunEvent {
    /// When, seconds after the start; `None` when the run's start on its host is unknown.
    pub at_s: Option<f64>,
    /// The process concerned.
    pub process: String,
    /// What happened.
    #[serde(flatten)]
    pub kind: RunEventKind,
    /// Set when the process carried no messages for a while.
    pub absence: Option<Absence>,
}

/// How long a process carried no messages.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Absence {
    /// Seconds; `None` when it never came back.
    pub length_s: Option<f64>,
}

/// What happened during a run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "source", rename_all = "snake_case")]
pub enum RunEventKind {
    /// Its supervisor saw it in a process.
    Process(EventKind),
    /// A gateway's radio reported it.
    Radio {
        /// The network interface.
        interface: String,
        /// What the radio did.
        change: RadioChange,
        /// The station concerned, as its address; `None` where the kernel named none.
        station: Option<String>,
        /// Status or reason code of IEEE 802.11; `None` where the kernel gave none.
        code: Option<u16>,
    },
}

hil_core::labelled! {
    /// What a radio did.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum RadioChange, label {
        /// It associated.
        Associated = "associated",
        /// It went to another access point.
        Roamed = "roamed",
        /// It lost its association.
        Disconnected = "disconnected",
        /// A station left it.
        StationLeft = "station left",
        /// The quality of its connection changed.
        QualityChanged = "connection quality changed",
    }
}

impl RunEvent {
    /// What happened, for a reader.
    pub fn what(&self) -> String {
        let process = &self.process;
        match &self.kind {
            RunEventKind::Process(kind) => format!("{process}: {kind}"),
            RunEventKind::Radio {
                interface,
                change,
                station,
                ..
            } => {
                let what = format!("{process}: {interface} {}", change.label());
                match station {
                    Some(station) => format!("{what} ({station})"),
                    None => what,
                }
            }
        }
    }

    /// Why, or for how long, for a reader; `None` when nothing is known.
    pub fn cause(&self) -> Option<String> {
        if let Some(absence) = self.absence {
            return Some(absence.length_s.map_or_else(
                || "never came back".to_owned(),
                |length_s| format!("away for {}", duration_s(length_s)),
            ));
        }
        match self.kind {
            RunEventKind::Radio { code, .. } => Some(format!("802.11 code {}", code?)),
            RunEventKind::Process(_) => None,
        }
    }
}

/// How a channel is carried; in JSON its word.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "&'static str")]
pub enum LinkKind {
    /// Shared memory of one host.
    SharedMemory,
    /// A gateway pair over a transport.
    Network(&'static Description),
    /// A gateway pair over an emulated link.
    Emulated,
    /// Nothing: its messages go to the run's record only.
    RecordOnly,
}

impl LinkKind {
    /// How `topology` carries `channel`.
    pub(crate) fn of(topology: &Topology, channel: &Channel) -> Self {
        match topology
            .crossing(channel)
            .map(|crossing| &crossing.link.via)
        {
            None if channel.is_recorded_only() => Self::RecordOnly,
            None | Some(Via::SharedMemory) => Self::SharedMemory,
            Some(Via::Network(hop)) => Self::Network(hop.transport),
            Some(Via::Emulated(..)) => Self::Emulated,
        }
    }

    /// The kind that `word` stands for.
    pub fn named(word: &str) -> Option<Self> {
        Some(match word {
            "shared_memory" => Self::SharedMemory,
            "emulated" => Self::Emulated,
            "record_only" => Self::RecordOnly,
            name => Self::Network(hil_topology::transport(name)?),
        })
    }

    /// Its word in JSON.
    pub const fn word(self) -> &'static str {
        match self {
            Self::SharedMemory => "shared_memory",
            Self::Network(transport) => transport.name,
            Self::Emulated => "emulated",
            Self::RecordOnly => "record_only",
        }
    }

    /// The words a report prints.
    pub const fn label(self) -> &'static str {
        match self {
            Self::SharedMemory => "shared memory",
            Self::Network(transport) => transport.label,
            Self::Emulated => "emulated link",
            Self::RecordOnly => "recorded only",
        }
    }

    /// True where messages leave shared memory, for a network or a model of one.
    pub const fn is_crossing(self) -> bool {
        matches!(self, Self::Network(_) | Self::Emulated)
    }

    /// True where the kernel can stamp the messages.
    pub const fn is_stamped(self) -> bool {
        match self {
            Self::Network(transport) => transport.capabilities.unstamped_because.is_none(),
            Self::SharedMemory | Self::Emulated | Self::RecordOnly => true,
        }
    }

    /// The words for a fate of a message on it: what an emulated link lost, no wire did.
    pub const fn fate_label(self, fate: MessageFate) -> &'static str {
        match (self, fate) {
            (Self::Emulated, MessageFate::LostOnWire) => "lost by the emulated link",
            (Self::Emulated, MessageFate::Incomplete) => "incomplete: lost by the emulated link",
            (Self::Emulated, MessageFate::LostOnWireOrByHarness) => {
                "lost by the emulated link or by this program or its host"
            }
            (_, fate) => fate.label(),
        }
    }
}

impl From<LinkKind> for &'static str {
    fn from(kind: LinkKind) -> Self {
        kind.word()
    }
}

impl TryFrom<String> for LinkKind {
    type Error = String;

    fn try_from(word: String) -> Result<Self, String> {
        Self::named(&word).ok_or_else(|| format!("`{word}` carries no channel"))
    }
}

/// One channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChannelSummary {
    /// Its name.
    pub name: String,
    /// The role that publishes.
    pub from: String,
    /// The role that subscribes; `None` for a channel that is only recorded.
    pub to: Option<String>,
    /// How it is carried.
    pub link: LinkKind,
    /// Its latency account; `None` when no records were found or it is only recorded.
    pub account: Option<ChannelAccount>,
    /// Its outages: messages lost in a row, by length; `None` when they are unknown or it is only
    /// recorded.
    #[serde(default)]
    pub outages: Option<OutageMetrics>,
    /// Whether it met the demand that the topology states; `None` where it states none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub demand: Option<DemandMetrics>,
    /// How well the hosts kept its emulated link; `None` on every other link, or when no message
    /// came through it.
    #[serde(default)]
    pub emulation: Option<EmulationMetrics>,
    /// What its emulated link met of the trace that it replays; `None` where it replays none, or
    /// its gateway left no word.
    #[serde(default)]
    pub trace_replay: Option<ReplayCounts>,
    /// What was recorded of a channel that is only recorded; `None` when nothing was.
    #[serde(default)]
    pub recorded: Option<RecordedMetrics>,
    /// What each gateway that carried it counted of it alone; empty on a direct channel.
    #[serde(default)]
    pub ends: Vec<ChannelEnd>,
}

/// The frames of one channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChannelFlows {
    /// The channel.
    pub channel: String,
    /// Frames that were lost between a program and the channel, by where; they are in no flow.
    pub inlet_lost: Vec<CountByName>,
    /// Its flows, those of most frames first.
    pub flows: Vec<FlowMetrics>,
}

impl ChannelFlows {
    /// Frames that were lost between a program and the channel.
    pub fn inlet_lost_count(&self) -> u64 {
        self.inlet_lost.iter().map(|one| one.count).sum()
    }
}

/// One channel in one gateway.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ChannelEnd {
    /// The gateway process.
    pub process: String,
    /// Which way it carried it.
    pub direction: Side,
    /// Everything it counted of it.
    pub counters: Vec<CountByName>,
}

/// What the record holds of a channel that goes nowhere else.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordedMetrics {
    /// Messages in the record.
    pub message_count: u64,
    /// Sequence numbers below the highest of each start that are not: the recorder was full, or
    /// its process was killed.
    pub missing_count: u64,
}

impl ChannelSummary {
    /// What its gateways counted of it by this name, together.
    pub fn count(&self, group: CounterGroup, name: &str) -> u64 {
        let counters = self.ends.iter().flat_map(|one| &one.counters);
        let named = counters.filter(|one| one.group == group && one.name == name);
        named.map(|one| one.count).sum()
    }
}

/// What reports say of [`DirectionSummary::no_room_count`].
pub(super) const NO_ROOM: &str = "no room in the receive buffer";

/// One way of a link in one gateway: its thread and its socket.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DirectionSummary {
    /// What goes that way: the link and the way, or a channel in virtual time.
    pub flow: String,
    /// The gateway process.
    pub process: String,
    /// Which way it carried it.
    pub direction: Side,
    /// Names of the channels.
    pub channels: Vec<String>,
    /// The peer's state at the end, in words.
    pub peer_state: String,
    /// Everything it counted that is of no one channel.
    pub counters: Vec<CountByName>,
    /// What was granted and found: buffers, stamp probe, path MTU.
    pub facts: Vec<Fact>,
    /// How often its stream stood still; `None` where it is none, or receives.
    #[serde(default)]
    pub stalls: Option<StallMetrics>,
}

impl DirectionSummary {
    /// What goes that way, for a reader.
    pub fn label(&self) -> &str {
        flow_label(&self.flow)
    }

    /// How it stood to its peer, and what was granted and found, for a reader.
    pub(crate) fn words(&self) -> Vec<String> {
        let peer = core::iter::once(format!("peer {}", self.peer_state));
        peer.chain(self.facts.iter().map(Fact::to_string)).collect()
    }

    /// What it counted by this name; `None` where it counts no such thing.
    pub fn count(&self, group: CounterGroup, name: &str) -> Option<u64> {
        let mut counters = self.counters.iter();
        let found = counters.find(|one| one.group == group && one.name == name);
        found.map(|one| one.count)
    }

    /// Datagrams that came while the socket's receive buffer was full: their receiver was late. They may
    /// have been anything, also messages.
    pub fn no_room_count(&self) -> u64 {
        let count = self.count(CounterGroup::Socket, "kernel_drop_count");
        count.unwrap_or(0)
    }

    /// What became of datagrams that are no messages, in words, each cause with its count.
    pub(crate) fn refusal_words(&self) -> Vec<String> {
        let counters = self.counters.iter();
        let refused = counters.filter(|one| one.group == CounterGroup::Refused && one.count > 0);
        let refused = refused.map(|one| format!("{} {}", one.name, grouped(one.count)));
        let no_room = Some(self.no_room_count()).filter(|count| *count > 0);
        let no_room = no_room.map(|count| format!("{NO_ROOM} {}", grouped(count)));
        refused.chain(no_room).collect()
    }
}

/// One figure of the score.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ScoreMetric {
    /// Snake-case name with unit suffix.
    pub name: String,
    /// The words a report prints.
    pub label: String,
    /// The figure; `None` when the run did not allow it.
    pub value: Option<f64>,
    /// 95 % interval, or why there is none, when the figure is a statistic.
    pub interval: Option<Spread>,
    /// SI unit, or `1` for a pure number.
    pub unit: String,
    /// How it was obtained, or why it was not.
    pub method: String,
    /// What a reader holds it against, a few words.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub note: String,
}

impl ScoreMetric {
    /// The unit in which a report shows a score of this name: a ratio in per cent, as everywhere.
    pub(crate) fn shown_unit<'a>(name: &str, unit: &'a str) -> &'a str {
        if unit == "1" && name.ends_with("_ratio") {
            "share"
        } else {
            unit
        }
    }

    /// As a report shows it.
    pub(crate) fn shown(&self) -> hil_present::Metric {
        let unit = Self::shown_unit(&self.name, &self.unit);
        let metric =
            hil_present::Metric::maybe(&self.name, &self.label, unit, self.value, &self.method);
        with_spread(metric, self.interval).by(&self.method)
    }

    /// The value with its interval and what it is held against.
    pub(crate) fn words(&self) -> String {
        with_note(self.shown().words(), &self.note)
    }

    /// The figures of a score, in its order.
    pub fn all_of(score: &Score) -> Vec<Self> {
        score.metrics.iter().map(Self::from).collect()
    }
}

impl From<&Metric> for ScoreMetric {
    fn from(metric: &Metric) -> Self {
        Self {
            name: metric.name.to_owned(),
            label: metric.label.to_owned(),
            // JSON has no word for infinity and NaN: both mean that there is no figure.
            value: metric.value.filter(|value| value.is_finite()),
            interval: metric.interval,
            unit: metric.unit.to_owned(),
            method: metric.method.clone(),
            note: metric.note.to_owned(),
        }
    }
}

#[cfg(test)]
mod tests {
    use hil_topology::registry::Registry;

    use super::*;

    #[test]
    fn an_absence_is_told_in_the_unit_of_its_size() {
        let away = |length_s| {
            let event = RunEvent {
                at_s: None,
                process: "gateway".to_owned(),
                kind: RunEventKind::Process(EventKind::Warning {
                    text: String::new(),
                }),
                absence: Some(Absence { length_s }),
            };
            event.cause().unwrap().replace('\u{a0}', " ")
        };
        assert_eq!(away(Some(75.0)), "away for 75.0 s");
        assert_eq!(away(Some(0.757)), "away for 757 ms");
        assert_eq!(away(None), "never came back");
    }

    #[test]
    fn the_emulated_links_are_told_once_or_once_a_way() {
        let text = |link: &str| {
            format!(
                r#"
version = 1
name = "two"
[hosts.a]
[hosts.b]
[processes.one]
host = "a"
run = ["true"]
inside = "10.77.0.1"
[processes.two]
host = "b"
run = ["true"]
inside = "10.77.0.2"
[channels]
out = {{ from = "one", to = "two", link = "hop" }}
back = {{ from = "two", to = "one", link = "hop" }}
[links.hop]
via = "emulated"
between = ["a", "b"]
path_mtu_bytes = 9000
{link}
"#
            )
        };
        let links = |link: &str| {
            let registry = Registry::default();
            let topology = hil_topology::parse("two", &text(link), &[], registry.known());
            emulated_links(&topology.unwrap())
        };
        let both = links("delay = \"5 ms\"\nloss_ratio = 0.01");
        let [both] = &both[..] else {
            panic!("{both:?}");
        };
        assert_eq!(both.label, "hop");
        assert!(
            both.value.contains('5') && both.value.contains("ms"),
            "{both}"
        );
        let ways = links("delay = \"5 ms\"\n[links.hop.backward]\ndelay = \"9 ms\"");
        let labels: Vec<&str> = ways.iter().map(|one| one.label.as_str()).collect();
        assert_eq!(labels, ["hop, forward", "hop, backward"]);
    }
}
