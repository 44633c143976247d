//! From the records of a finished run to its summary: reads the record files, draws up the
//! account of each channel, and lets the case score what the robot did.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use hil_models::case_study::Score;
use hil_models::measure::account::{
    AccountContext, ChannelAccount, ChannelPath, ChannelRecords, FLIGHT_TIME_MAX, Interruption,
    PathProcess, RunSpan, account,
};
use hil_models::measure::record::{
    EgressRecord, FollowUpRecord, IngressRecord, PublishedRecord, TakenRecord,
};
use hil_models::run_log::RunLog;
use hil_models::time::Alignment;

use crate::realtime::GrantOutcome;
use crate::record::{RecordFile, RecordFileError, RecordKind};
use crate::registry::{CaseError, Registry};
use crate::report::summary::{
    ChannelSummary, CountByName, DirectionSummary, Fact, LinkKind, Outcome, ProcessSummary,
    RunEvent, RunFacts, RunSummary, ScoreMetric, SummaryError,
};
use crate::report::terminal::{self, Style};
use crate::supervisor::event::{Event, ProcessStory};
use crate::supervisor::{self, RunResult};
use crate::topology::{Channel, Topology};

/// Why no summary could be made.
#[derive(Debug, thiserror::Error)]
pub(crate) enum AnalysisError {
    #[error("records folder {folder}: {source}")]
    Folder { folder: PathBuf, source: io::Error },
    #[error(transparent)]
    Case(#[from] CaseError),
    #[error(transparent)]
    Summary(#[from] SummaryError),
    #[error("cannot write {path}: {source}")]
    Write { path: PathBuf, source: io::Error },
}

/// All records of one channel.
#[derive(Debug, Default)]
pub(crate) struct ChannelFiles {
    published: Option<Vec<PublishedRecord>>,
    egress: Option<Vec<EgressRecord>>,
    ingress: Option<Vec<IngressRecord>>,
    follow_up: Option<Vec<FollowUpRecord>>,
    taken: Option<Vec<TakenRecord>>,
    round_trips_ns: Vec<i64>,
}

/// Every record file of a run.
#[derive(Debug, Default)]
pub(crate) struct RunRecords {
    channels: BTreeMap<String, ChannelFiles>,
    log: RunLog,
    /// Files that could not be read, with the reason.
    pub(crate) problems: Vec<String>,
}

impl RunRecords {
    /// Reads the records folder.
    pub(crate) fn read(folder: &Path) -> Result<Self, AnalysisError> {
        let failed = |source| AnalysisError::Folder {
            folder: folder.to_owned(),
            source,
        };
        let mut paths: Vec<PathBuf> = fs::read_dir(folder)
            .and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect())
            .map_err(failed)?;
        // By name, so that the instances of a restarted process come in order.
        paths.sort();
        let mut records = Self::default();
        for path in paths {
            match RecordFile::read(&path) {
                Ok(file) => records.add(&file),
                // A process killed while it opened its files leaves one without a header.
                Err(error @ RecordFileError::Malformed { offset: 0, .. }) => {
                    records.problems.push(format!("{error}; left out"));
                }
                Err(error) => records.problems.push(error.to_string()),
            }
        }
        Ok(records)
    }

    fn add(&mut self, file: &RecordFile) {
        let channel = self
            .channels
            .entry(file.header.channel.clone())
            .or_default();
        match file.header.kind {
            RecordKind::Published => extend(&mut channel.published, file.records()),
            RecordKind::Taken => extend(&mut channel.taken, file.records()),
            RecordKind::Egress => extend(&mut channel.egress, file.records()),
            RecordKind::Ingress => extend(&mut channel.ingress, file.records()),
            RecordKind::FollowUp => extend(&mut channel.follow_up, file.records()),
            RecordKind::RoundTrip => {
                channel
                    .round_trips_ns
                    .extend(file.records::<[i64; 2]>().map(|[rtt, _]| rtt));
            }
            RecordKind::Message => file.append_messages(&mut self.log),
        }
    }

    /// True when anything was recorded of `channel`.
    fn has(&self, channel: &str) -> bool {
        self.channels.contains_key(channel)
    }

    /// Every message of the run.
    pub(crate) fn log(&self) -> &RunLog {
        &self.log
    }

    /// The account of `channel`.
    pub(crate) fn account(
        &self,
        topology: &Topology,
        result: &RunResult,
        channel: &Channel,
    ) -> ChannelAccount {
        let nothing = ChannelFiles::default();
        let files = self.channels.get(&channel.name).unwrap_or(&nothing);
        let interruptions = interruptions(topology, result, channel);
        let span = RunSpan {
            start: result.span.0,
            end: result.span.1,
        };
        let crossing = topology.crossing(channel);
        let path = if crossing.is_some() {
            let alignment = result.has_one_clock.then_some(Alignment::SAME_CLOCK);
            ChannelPath::Gateway { alignment }
        } else {
            ChannelPath::SharedMemory
        };
        // A link that delays on purpose keeps messages under way for that much longer.
        let delay = crossing
            .and_then(|crossing| crossing.impairment)
            .map(|one| one.delay);
        let is_on_this_clock =
            |process: &str| result.has_one_clock || is_here(topology, result, process);
        let context = AccountContext {
            interruptions: &interruptions,
            producer_run: is_on_this_clock(&channel.from).then_some(span),
            consumer_run: is_on_this_clock(&channel.to).then_some(span),
            flight_time_max: FLIGHT_TIME_MAX + delay.unwrap_or(Duration::ZERO),
            round_trips_ns: &files.round_trips_ns,
            seed: topology.run().seed,
            ..AccountContext::new(path)
        };
        let records = ChannelRecords {
            published: files.published.as_deref(),
            egress: files.egress.as_deref(),
            ingress: files.ingress.as_deref(),
            follow_up: files.follow_up.as_deref(),
            taken: files.taken.as_deref(),
        };
        account(&records, &context)
    }
}

fn extend<T>(records: &mut Option<Vec<T>>, more: impl Iterator<Item = T>) {
    records.get_or_insert_default().extend(more);
}

fn is_here(topology: &Topology, result: &RunResult, process: &str) -> bool {
    topology
        .process(process)
        .is_some_and(|process| result.own_hosts.contains(&process.host))
}

/// The times in which a process on the channel's way was not there.
fn interruptions(topology: &Topology, result: &RunResult, channel: &Channel) -> Vec<Interruption> {
    let gateway = |process: &str| {
        let host = &topology.process(process)?.host;
        Some(format!("gateway-{}-{host}", channel.link.as_deref()?))
    };
    let places = [
        (Some(channel.from.clone()), PathProcess::Producer),
        (gateway(&channel.from), PathProcess::SendingGateway),
        (gateway(&channel.to), PathProcess::ReceivingGateway),
        (Some(channel.to.clone()), PathProcess::Consumer),
    ];
    let mut found = Vec::new();
    for event in &result.events {
        let Some(gap) = event.interruption else {
            continue;
        };
        for (_, place) in places
            .iter()
            .filter(|(name, _)| name.as_ref() == Some(&event.process))
        {
            found.push(Interruption {
                process: event.process.clone(),
                place: *place,
                from: gap.from,
                until: gap.until.unwrap_or(result.span.1),
                cause: event.what.clone(),
            });
        }
    }
    found
}

/// What the case says of the run.
pub(crate) fn score(
    topology: &Topology,
    registry: &Registry,
    log: &RunLog,
) -> Result<Score, CaseError> {
    let Some((case, entry)) = topology
        .case()
        .and_then(|case| Some((case, registry.find(&case.name)?)))
    else {
        return Ok(Score::default());
    };
    let parameters = serde_json::to_value(&case.parameters).unwrap_or_default();
    Ok(entry.make(parameters, topology.run().seed)?.score(log))
}

/// Draws up the summary of a finished run and writes it with its report into the run's folder.
///
/// # Errors
/// When the records cannot be read at all, or the run folder cannot be written.
pub(crate) fn conclude(
    topology: &Topology,
    result: &RunResult,
    registry: &Registry,
    (topology_file, command_line): (&Path, &[String]),
) -> Result<RunSummary, AnalysisError> {
    let records = RunRecords::read(&result.folder.records())?;
    let mut summary = RunSummary::new(run_facts(topology, result, topology_file, command_line));
    summary.host_facts = result
        .facts
        .facts
        .iter()
        .map(|fact| Fact::new(fact.label.clone(), fact.value.to_text()))
        .collect();
    for process in &result.processes {
        add_realtime(&mut summary, process);
        summary.processes.push(process_summary(process));
    }
    summary.events = result
        .events
        .iter()
        .map(|event| run_event(result, event))
        .collect();
    summary.channels = topology
        .channels()
        .iter()
        .map(|channel| channel_summary(topology, result, channel, &records))
        .collect();
    summary.score = ScoreMetric::all_of(&score(topology, registry, records.log())?);
    summary
        .warnings
        .extend(result.problems.iter().chain(&records.problems).cloned());
    if !result.has_one_clock {
        summary.warnings.push(
            "clocks not aligned: no figure crosses from one host to the other; lag and error of \
             the score mix two clocks, so take them as unavailable"
                .to_owned(),
        );
    }
    summary.write(&result.folder.summary())?;
    let plain = terminal::render(&summary, REPORT_FILE_WIDTH, Style::Plain);
    let path = result.folder.report();
    fs::write(&path, plain).map_err(|source| AnalysisError::Write { path, source })?;
    Ok(summary)
}

/// Width of `report.txt`.
const REPORT_FILE_WIDTH: usize = 100;

fn run_facts(
    topology: &Topology,
    result: &RunResult,
    topology_file: &Path,
    command_line: &[String],
) -> RunFacts {
    let outcome = match &result.outcome {
        supervisor::Outcome::Completed | supervisor::Outcome::EndedEarly(_) => Outcome::Completed,
        supervisor::Outcome::Interrupted(_) | supervisor::Outcome::EndedByPeer(_) => {
            Outcome::Stopped
        }
        supervisor::Outcome::Failed(_) | supervisor::Outcome::PeerLost(_) => Outcome::Failed,
    };
    let files = [
        ("summary.json", "every figure of this report"),
        (
            "manifest.json",
            "topology as resolved, versions, host, seed",
        ),
        (
            "records/",
            "one record per message and stage; layout in the runtime's docs",
        ),
        ("logs/", "what each process said on standard error"),
    ];
    RunFacts {
        name: result.folder.name(),
        case: topology
            .case()
            .map(|case| case.name.clone())
            .unwrap_or_default(),
        topology_file: topology_file.display().to_string(),
        topology_hash: format!("{:016x}", topology.hash()),
        seed: topology.run().seed,
        host: result.own_hosts.join(", "),
        started: result.started.clone(),
        duration_s: result.span.1.seconds_since(result.span.0),
        outcome,
        exit_reason: result.outcome.text(),
        folder: result.folder.root().display().to_string(),
        files: files.map(|(name, what)| Fact::new(name, what)).to_vec(),
        repeat_command: command_line.join(" "),
    }
}

fn add_realtime(summary: &mut RunSummary, process: &ProcessStory) {
    let Some(report) = &process.report else {
        return;
    };
    for (thread, grant) in &report.realtime {
        for item in &grant.items {
            let who = format!("{} / {thread}", process.name);
            let fact = Fact::new(who, item.to_string());
            match item.outcome {
                GrantOutcome::Granted => summary.realtime.granted.push(fact),
                GrantOutcome::Refused { .. } => summary.realtime.refused.push(fact),
            }
        }
    }
}

fn process_summary(process: &ProcessStory) -> ProcessSummary {
    let report = process.report.as_ref();
    // A gateway has no period of its own.
    let ticking = report.filter(|report| report.directions.is_empty());
    ProcessSummary {
        name: process.name.clone(),
        host: process.host.clone(),
        role: process.role.clone(),
        exit: process.end.clone(),
        restart_count: u64::from(process.restart_count),
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

fn run_event(result: &RunResult, event: &Event) -> RunEvent {
    let gap = event.interruption.map(|gap| match gap.until {
        Some(until) => format!("away for {:.0} ms", until.seconds_since(gap.from) * 1e3),
        None => "never came back".to_owned(),
    });
    RunEvent {
        at_s: event.at.seconds_since(result.span.0),
        what: format!("{}: {}", event.process, event.what),
        cause: gap.unwrap_or_default(),
    }
}

fn channel_summary(
    topology: &Topology,
    result: &RunResult,
    channel: &Channel,
    records: &RunRecords,
) -> ChannelSummary {
    let crossing = topology.crossing(channel);
    let directions = directions(result, &channel.name);
    let refusals = directions
        .iter()
        .flat_map(|direction| &direction.counters)
        .filter(|counter| counter.count > 0)
        .filter_map(|counter| {
            let name = counter.name.strip_prefix("refused: ")?.to_owned();
            Some(CountByName {
                name,
                count: counter.count,
            })
        })
        .collect();
    ChannelSummary {
        name: channel.name.clone(),
        from: channel.from.clone(),
        to: channel.to.clone(),
        link: match crossing.map(|crossing| crossing.impairment.is_some()) {
            None => LinkKind::SharedMemory,
            Some(false) => LinkKind::Udp,
            Some(true) => LinkKind::Emulated,
        },
        account: records
            .has(&channel.name)
            .then(|| records.account(topology, result, channel)),
        refusals,
        directions,
    }
}

fn directions(result: &RunResult, channel: &str) -> Vec<DirectionSummary> {
    let mut found = Vec::new();
    for process in &result.processes {
        let Some(report) = &process.report else {
            continue;
        };
        for direction in report
            .directions
            .iter()
            .filter(|one| one.channel == channel)
        {
            found.push(DirectionSummary {
                process: process.name.clone(),
                direction: direction.direction.clone(),
                peer_state: direction.peer_state.clone(),
                counters: direction
                    .counters
                    .iter()
                    .map(|(name, count)| CountByName {
                        name: name.clone(),
                        count: *count,
                    })
                    .collect(),
                facts: direction
                    .facts
                    .iter()
                    .map(|(label, value)| Fact::new(label.clone(), value.clone()))
                    .collect(),
            });
        }
    }
    found
}
