//! The parts of a summary: from what the supervisor and the processes said to what a report shows.
//! It draws up no account itself.

use std::collections::BTreeMap;
use std::path::Path;

use hil_account::flow::{FlowFold, FlowMetrics, FlowPassages, NamedFlow};
use hil_account::radio::{RadioFold, RadioMetrics};
use hil_account::{
    AccountFold, ChannelAccount, DemandFold, DemandMetrics, Outage, OutageFinder, RecordsAtHand,
    each_history,
};
use hil_core::record::IngressRecord;

use super::axis::RunAxis;
use super::records::RunRecords;
use crate::emulation::EmulationMetrics;
use crate::summary::{
    Absence, ChannelEnd, ChannelSummary, CounterGroup, DirectionSummary, Fact, LinkKind, Outcome,
    ProcessSummary, RealtimeFacts, RunEvent, RunEventKind, RunFacts, emulated_links,
};
use hil_platform::realtime::GrantOutcome;
use hil_platform::text::shell_words;
use hil_rundir::event::{Event, ProcessHistory};
use hil_rundir::run_result::{self, RunResult};
use hil_topology::{Channel, Topology};

pub(super) fn run_facts(
    topology: &Topology,
    result: &RunResult,
    topology_file: &Path,
    command_line: &[String],
) -> RunFacts {
    let outcome = match &result.outcome {
        run_result::Outcome::Completed | run_result::Outcome::EndedEarly(_) => Outcome::Completed,
        run_result::Outcome::Interrupted(_) | run_result::Outcome::EndedByPeer(_) => {
            Outcome::Stopped
        }
        run_result::Outcome::Failed(_)
        | run_result::Outcome::Unwritable { .. }
        | run_result::Outcome::PeerFailed { .. }
        | run_result::Outcome::PeerLost(_) => Outcome::Failed,
    };
    let files = [
        ("summary.json", "every figure of this report"),
        (
            "manifest.json",
            "topology as resolved, versions, host, seed",
        ),
        (
            "records/",
            "one record per message and stage; layout in docs/run-folder.md",
        ),
        ("logs/", "what each process said on standard error"),
        (
            "events.log",
            "events of the score with the outage before each, and changes of links, one line each",
        ),
    ];
    // The run on the clock of this supervisor.
    let own_host = result.own_hosts.first();
    let own_span = own_host.and_then(|host| result.spans.get(host));
    RunFacts {
        name: result.folder.name(),
        case: topology
            .case()
            .map(|case| case.name.clone())
            .unwrap_or_default(),
        topology_file: topology_file.display().to_string(),
        topology_hash: format!("{:016x}", topology.hash()),
        links: emulated_links(topology),
        seed: topology.run().seed,
        security: result.security.clone(),
        is_virtual: false,
        host: result.own_hosts.join(", "),
        started: result.started.clone(),
        starts_ns: result
            .spans
            .iter()
            .map(|(host, (start, _))| (host.clone(), start.as_ns()))
            .collect(),
        duration_s: own_span.map_or(0.0, |(start, end)| end.seconds_since(*start)),
        outcome,
        exit_reason: result.outcome.reason(),
        folder: result.folder.root().display().to_string(),
        files: files.map(|(name, what)| Fact::new(name, what)).to_vec(),
        repeat_command: shell_words(command_line),
    }
}

/// What the kernel granted and refused, each item once with the threads it concerns.
pub(super) fn realtime_facts(processes: &[ProcessHistory]) -> RealtimeFacts {
    let mut items: BTreeMap<(bool, String), Vec<String>> = BTreeMap::new();
    let mut thread_count = 0;
    for process in processes {
        for (thread, grant) in process.report.iter().flat_map(|report| &report.realtime) {
            thread_count += 1;
            let who = if thread == "main" {
                process.name.clone()
            } else {
                format!("{} ({thread})", process.name)
            };
            for item in &grant.items {
                let is_refused = item.outcome != GrantOutcome::Granted;
                items
                    .entry((is_refused, item.to_string()))
                    .or_default()
                    .push(who.clone());
            }
        }
    }
    let mut facts = RealtimeFacts::default();
    for ((is_refused, what), who) in items {
        let who = if who.len() == thread_count {
            format!("all {thread_count} measured threads")
        } else {
            who.join(", ")
        };
        let side = if is_refused {
            &mut facts.refused
        } else {
            &mut facts.granted
        };
        side.push(Fact::new(what, who));
    }
    facts
}

pub(super) fn process_summary(process: &ProcessHistory) -> ProcessSummary {
    let report = process.report.as_ref();
    // A gateway has no period of its own, and a component that messages drive has none either.
    let ticking = report.filter(|report| report.ticks + report.skipped_ticks > 0);
    ProcessSummary {
        name: process.name.clone(),
        host: process.host.clone(),
        kind: process.kind,
        role: process.role.clone(),
        exit: process.end.clone(),
        restart_count: u64::from(process.restart_count),
        preparation_s: report.and_then(|report| report.preparation_s),
        tick_count: ticking.map(|report| report.ticks),
        skipped_tick_count: ticking.map(|report| report.skipped_ticks),
        cpu_time_s: report.map(|report| report.cpu_s),
        voluntary_switch_count: report.map(|report| report.voluntary_switches),
        involuntary_switch_count: report.map(|report| report.involuntary_switches),
        malformed_count: report.map(|report| report.malformed_count),
        outbox_drop_count: report.map(|report| report.outbox_dropped),
        recorder_drop_count: report.map(|report| report.recorder_dropped),
    }
}

pub(super) fn run_event(axis: &RunAxis<'_>, event: &Event) -> RunEvent {
    let absence = event.interruption.map(|gap| Absence {
        length_s: gap.until.map(|until| until.seconds_since(gap.from)),
    });
    RunEvent {
        at_s: axis.shown_s(&event.host, event.at),
        process: event.process.clone(),
        kind: RunEventKind::Process(event.kind.clone()),
        absence,
    }
}

/// What one reading of the messages of a channel gives.
#[derive(Debug)]
pub(super) struct ChannelReading {
    pub(super) account: ChannelAccount,
    pub(super) outages: Vec<Outage>,
    pub(super) demand: Option<DemandMetrics>,
    pub(super) acknowledgements: Option<RadioMetrics>,
    /// Of a channel of frames.
    pub(super) flows: Vec<FlowMetrics>,
    /// Its frames that deadlines are about.
    pub(super) passages: FlowPassages,
}

impl ChannelReading {
    /// Reads the messages of `channel`; `None` when it leaves none, or only for the record.
    pub(super) fn of(
        records: &RunRecords<'_>,
        channel: &Channel,
        named: &[NamedFlow],
    ) -> Option<Self> {
        if channel.is_recorded_only() || !records.has(&channel.name) {
            return None;
        }
        Some(records.consult(channel, |files, context| {
            let at_hand = RecordsAtHand::of(files, context);
            let mut account = AccountFold::new(at_hand, context);
            let mut outages = OutageFinder::default();
            let stated = channel.demand.as_ref();
            let mut demand = stated.map(|demand| DemandFold::of_channel(demand, context));
            let mut radio = RadioFold::new(at_hand);
            let mut flows = FlowFold::new(named);
            let frames = records.of_kind(&channel.name, |files| files.frame.as_ref());
            frames.for_each(|frame| flows.add_frame(&frame));
            each_history(files, context, |message| {
                account.add(message);
                outages.add(message);
                if let Some(demand) = &mut demand {
                    demand.add(message, context);
                }
                radio.add(message);
                flows.add(message, context);
            });
            let (flows, passages) = flows.finish();
            Self {
                account: account.finish(),
                outages: outages.finish(),
                demand: demand.map(DemandFold::finish),
                acknowledgements: radio.finish(),
                flows,
                passages,
            }
        }))
    }
}

/// The summary of a channel; its account is still to be put in.
pub(super) fn channel_summary(records: &RunRecords<'_>, channel: &Channel) -> ChannelSummary {
    let result = records.result;
    let mut trace_replay = None;
    let mut ends = Vec::new();
    for process in &result.processes {
        let directions = process.report.iter().flat_map(|report| &report.directions);
        for direction in directions {
            let mut channels = direction.channels.iter();
            let Some(one) = channels.find(|one| one.channel == channel.name) else {
                continue;
            };
            trace_replay = trace_replay.or(one.replay);
            ends.push(ChannelEnd {
                process: process.name.clone(),
                direction: direction.direction,
                counters: one.counters.clone(),
            });
        }
    }
    let overflow_count = ends
        .iter()
        .flat_map(|end: &ChannelEnd| &end.counters)
        .find(|one| one.group == CounterGroup::Socket && one.name == "link_overflow_count")
        .map(|one| one.count);
    ChannelSummary {
        name: channel.name.clone(),
        from: channel.from.clone(),
        to: channel.to.clone(),
        link: LinkKind::of(records.topology, channel),
        account: None,
        outages: None,
        demand: None,
        emulation: EmulationMetrics::of(
            records.of_kind::<IngressRecord>(&channel.name, |files| files.ingress.as_ref()),
            overflow_count,
        ),
        trace_replay,
        recorded: channel
            .is_recorded_only()
            .then(|| records.recorded(&channel.name))
            .flatten(),
        ends,
    }
}

/// Every way of every link that a gateway carried.
pub(super) fn directions(result: &RunResult) -> Vec<DirectionSummary> {
    let mut found = Vec::new();
    for process in &result.processes {
        for direction in process.report.iter().flat_map(|report| &report.directions) {
            // A clock path carries no channel; what it found is told with the clocks.
            if direction.channels.is_empty() {
                continue;
            }
            let channels = direction.channels.iter();
            found.push(DirectionSummary {
                flow: direction.flow.clone(),
                process: process.name.clone(),
                direction: direction.direction,
                channels: channels.map(|one| one.channel.clone()).collect(),
                peer_state: direction.peer_state.clone(),
                counters: direction.counters.clone(),
                facts: direction
                    .facts
                    .iter()
                    .map(|(label, value)| Fact::new(label.clone(), value.clone()))
                    .collect(),
                stalls: direction.stalls,
            });
        }
    }
    found
}
