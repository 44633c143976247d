//! From the records of a finished run to its summary: reads the record files, draws up the
//! account of each channel, and lets the case score what the robot did.

mod adapters;
mod axis;
mod clock_path;
mod clocks;
mod events;
mod frame_lengths;
mod interruptions;
pub(crate) mod link_changes;
#[cfg(test)]
mod memory_tests;
pub(crate) mod metrics;
pub(crate) mod network;
mod nics;
pub(crate) mod outages;
mod radio;
pub(crate) mod records;
mod robot_series;
mod score_clock;
mod storage;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::{fs, io};

use hil_account::MessageFate;
use hil_account::flow::{DeadlineFold, DeadlineMetrics, FlowKey, FlowPassages, NamedFlow};
use hil_account::radio::RadioMetrics;
use hil_core::case_study::Score;
use hil_core::plot::PlotSeries;

use axis::RunAxis;
use clocks::HostClocks;
use metrics::{
    ChannelReading, channel_summary, process_summary, realtime_facts, run_event, run_facts,
};
use outages::OutageHistory;
use records::RunRecords;

use crate::answer::HarmCount;
use crate::summary::{ChannelFlows, CountByName, Fact, Outcome, RunSummary, SummaryError};
use crate::terminal;
use crate::trace::capture;
use crate::{event_log, own_programs};
use hil_platform::text::grouped;
use hil_rundir::file_fault::FileFault;
use hil_rundir::manifest::{Manifest, ManifestTopologyError};
use hil_rundir::pipe::InletReport;
use hil_rundir::run_folder::RunFolder;
use hil_rundir::run_result::{RunResult, RunResultError};
use hil_rundir::series::{self, SeriesError};
use hil_topology::Topology;
use hil_topology::registry::{Case, CaseError, Registry};

/// Why no summary could be made.
#[derive(Debug, thiserror::Error)]
pub enum AnalysisError {
    /// The records cannot be read.
    #[error("records folder {folder}: {source}")]
    Folder {
        /// Where they are.
        folder: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The case cannot be made.
    #[error(transparent)]
    Case(#[from] CaseError),
    /// The summary cannot be written.
    #[error(transparent)]
    Summary(#[from] SummaryError),
    /// The manifest cannot be read.
    #[error("{path}: {source}")]
    Manifest {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: io::Error,
    },
    /// The manifest does not give back the topology.
    #[error("{path}: {source}")]
    Topology {
        /// The manifest.
        path: PathBuf,
        /// Why not.
        source: ManifestTopologyError,
    },
    /// The result of the run cannot be read or written.
    #[error(transparent)]
    Result(#[from] RunResultError),
    /// A file of the report cannot be written.
    #[error("cannot write {path}: {source}")]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

/// The account of a finished run.
#[derive(Debug)]
pub struct Concluded {
    /// Every figure of the report.
    pub summary: RunSummary,
    /// Why the run folder lacks it, e.g. because its disk is full; it can be shown all the same.
    pub unwritten: Option<AnalysisError>,
}

/// Draws up the summary of the finished run in `folder` from nothing but the files there, and writes
/// it with its report beside them.
///
/// # Errors
/// When the manifest, the result or the records cannot be read.
pub fn analyse(folder: &RunFolder, registry: &Registry) -> Result<Concluded, AnalysisError> {
    let path = folder.manifest();
    let manifest = match Manifest::read(folder) {
        Ok(manifest) => manifest,
        Err(source) => return Err(AnalysisError::Manifest { path, source }),
    };
    let topology = match manifest.read_topology(registry.known()) {
        Ok(topology) => topology,
        Err(source) => return Err(AnalysisError::Topology { path, source }),
    };
    let result = RunResult::read(folder)?;
    let file = Path::new(&manifest.topology_file);
    conclude(&topology, &result, registry, file, &manifest.command_line)
}

/// Draws up the summary of a finished run and writes it with its report into the run's folder.
///
/// # Errors
/// When the records cannot be read at all.
pub fn conclude(
    topology: &Topology,
    result: &RunResult,
    registry: &Registry,
    topology_file: &Path,
    command_line: &[String],
) -> Result<Concluded, AnalysisError> {
    let mut records = RunRecords::read(topology, result)?;
    records.clocks = HostClocks::of(&records);
    let case = registry.make_case(topology)?;
    let unscored = score_clock::apply(&mut records, case.as_ref());
    let score_host = score_clock::host(topology, case.as_ref());
    let axis = RunAxis::of(&records.clocks, &result.spans, score_host);
    let mut summary = RunSummary::new(run_facts(topology, result, topology_file, command_line));
    summary.host_facts = result.facts.clone();
    for process in &result.processes {
        summary.processes.push(process_summary(process));
    }
    summary.clocks = Some(records.clocks.section.clone());
    summary.realtime = realtime_facts(&result.processes);
    summary.events = result
        .events
        .iter()
        .map(|event| run_event(&axis, event))
        .collect();
    summary.link_changes = link_changes::of_run(&records, &axis);
    let channels = topology.channels().iter();
    summary.channels = channels
        .map(|channel| channel_summary(&records, channel))
        .collect();
    let found = read_channels(&mut summary, &records, &axis);
    summary.flows = found.flows;
    summary.deadlines = found.deadlines;
    summary.directions = metrics::directions(result);
    let mut unwritten_files = capture::write(&mut summary, &records);
    summary.faces = adapters::adapter_summaries(&records);
    summary.hardware_stamps = nics::hardware_stamps(&records);
    let (specs, score) = match &case {
        Some((entry, case)) => (entry.channels, case.score(&records.log)),
        None => (&[][..], Score::default()),
    };
    summary.put_score(&score);
    // Programs between which nothing is crossed put no network to the test.
    let has_crossed = summary.flows.iter().any(|flows| {
        let mut channels = summary.channels.iter();
        channels.any(|one| one.name == flows.channel && one.link.is_crossing())
    });
    let deadlines = summary.deadlines.iter().filter(|_| has_crossed);
    summary.harms.extend(deadlines.map(HarmCount::from));
    summary.score_events = events::explained(
        &score,
        &records,
        &axis,
        &summary.channels,
        specs,
        &found.outages,
    );
    let errors = case.as_ref().map(|(_, case)| case.errors(&records.log));
    let network = network::of_run(
        &records,
        &axis,
        errors.unwrap_or_default(),
        &mut summary.score_events,
        &mut summary.warnings,
    );
    let (network, network_series) = network.unzip();
    summary.network = network;
    radio::add(&mut summary, &records, &axis, found.acknowledgements);
    add_warnings(&mut summary, &records);
    summary.warnings.extend(unscored);
    let case = case.as_ref().map(|(_, case)| case.as_ref());
    let network_series = network_series.unwrap_or_default();
    unwritten_files.extend(write_series(&mut summary, case, network_series, records));
    summary.record_gaps.clone_from(&result.gaps);
    summary.record_gaps.extend(storage::own_gaps(result));
    let storage = storage::warnings(result, &unwritten_files);
    summary.warnings.splice(0..0, storage);
    let unwritten = write_texts(&summary, result).err();
    Ok(Concluded { summary, unwritten })
}

/// Writes the summary, the events and the report into the run's folder.
fn write_texts(summary: &RunSummary, result: &RunResult) -> Result<(), AnalysisError> {
    let path = result.folder.events();
    let text = event_log::of(summary);
    write_whole(&path, &text).map_err(|source| AnalysisError::Write { path, source })?;
    summary.write(&result.folder.summary())?;
    for (path, text) in terminal::text_files(&result.folder, summary) {
        write_whole(&path, &text).map_err(|source| AnalysisError::Write { path, source })?;
    }
    Ok(())
}

/// Writes `text` to `path`; of a file that cannot be written in full nothing is left.
pub(crate) fn write_whole(path: &Path, text: &str) -> io::Result<()> {
    let written = fs::write(path, text);
    if written.is_err() {
        // The error that is told is the first one.
        let _left = fs::remove_file(path).is_err();
    }
    written
}

/// What is found in the messages of all channels beside what a summary shows of each.
struct MessageFindings {
    outages: Vec<OutageHistory>,
    /// What radios acknowledged, by channel.
    acknowledgements: BTreeMap<String, RadioMetrics>,
    /// Of the channels of frames.
    flows: Vec<ChannelFlows>,
    /// Of the flows that have one.
    deadlines: Vec<DeadlineMetrics>,
}

/// Reads the messages of every channel and puts its account and its outages into the summary.
fn read_channels(
    summary: &mut RunSummary,
    records: &RunRecords<'_>,
    axis: &RunAxis<'_>,
) -> MessageFindings {
    let mut found = MessageFindings {
        outages: Vec::new(),
        acknowledgements: BTreeMap::new(),
        flows: Vec::new(),
        deadlines: Vec::new(),
    };
    let named = records.topology.named_flows();
    let mut passages = FlowPassages::new();
    for (summary, channel) in summary.channels.iter_mut().zip(records.topology.channels()) {
        let Some(reading) = ChannelReading::of(records, channel, &named) else {
            continue;
        };
        let unknown = MessageFate::UnknownPeerRecordsUnavailable;
        let is_partial = reading.account.fates.of(unknown) > 0;
        summary.account = Some(reading.account);
        summary.demand = reading.demand;
        for (key, frames) in reading.passages {
            passages.entry(key).or_default().extend(frames);
        }
        if channel.carries_frames() {
            let processes = records.result.processes.iter();
            let reports = processes.filter_map(|one| one.report.as_ref());
            let inlets = reports.flat_map(|report| &report.inlets);
            found.flows.push(ChannelFlows {
                channel: channel.name.clone(),
                inlet_lost: inlet_lost(inlets, &channel.name),
                flows: reading.flows,
            });
        }
        let history = OutageHistory::of(records, axis, channel, reading.outages, is_partial);
        summary.outages = history.as_ref().and_then(OutageHistory::metrics);
        found.outages.extend(history);
        let radio = reading.acknowledgements;
        found
            .acknowledgements
            .extend(radio.map(|radio| (channel.name.clone(), radio)));
    }
    // A frame that is not known may have been an answer.
    let is_doubted = passages.contains_key(&FlowKey::Unrecorded)
        || found.flows.iter().any(|one| one.inlet_lost_count() > 0);
    found.deadlines = deadlines(&named, &passages, is_doubted);
    found
}

/// How the requests of the flows with a deadline were answered; `is_doubted` where an inlet lost frames.
fn deadlines(
    named: &[NamedFlow],
    passages: &FlowPassages,
    is_doubted: bool,
) -> Vec<DeadlineMetrics> {
    let timed = named.iter().filter_map(|one| Some((one, one.deadline_ns?)));
    timed
        .map(|(flow, limit_ns)| {
            let mut fold = DeadlineFold::new(&flow.name, limit_ns);
            if is_doubted {
                fold.doubt_program();
            }
            // As a frame has one flow.
            let is_its = |key: &FlowKey| {
                let mut named = named.iter();
                named.find(|one| one.filter.takes(key)) == Some(flow)
            };
            for (key, requests) in passages.iter().filter(|(key, _)| is_its(key)) {
                let Some(back) = key.reversed() else {
                    fold.add_unanswerable(requests);
                    continue;
                };
                fold.add(requests, passages.get(&back).map_or(&[], Vec::as_slice));
            }
            fold.finish()
        })
        .collect()
}

/// What the inlets lost of the frames of `channel`, beside those that have a fate.
fn inlet_lost<'a>(
    inlets: impl Iterator<Item = &'a InletReport>,
    channel: &str,
) -> Vec<CountByName> {
    let inlets = inlets.filter(|inlet| inlet.channel == channel);
    let (refused, mut lost): (Vec<CountByName>, Vec<_>) = inlets
        .flat_map(|inlet| inlet.lost.iter().cloned())
        .partition(|one| one.label() == InletReport::REFUSED);
    let refused_count: u64 = refused.iter().map(|one| one.count).sum();
    // One interface takes the frames of a channel.
    let mut dropped = lost.iter_mut();
    if let Some(one) = dropped.find(|one| one.label() == InletReport::DROPPED_GIVEN) {
        one.count = one.count.saturating_sub(refused_count);
    }
    lost.retain(|one| one.count > 0);
    lost
}

/// Writes what the case and the network have to plot; gives the file that could not be written. A run whose
/// plots cannot be written has its report still.
fn write_series(
    summary: &mut RunSummary,
    case: Option<&dyn Case>,
    network: Vec<PlotSeries>,
    records: RunRecords<'_>,
) -> Option<FileFault> {
    let folder = records.result.folder.series();
    let mut made = case.map_or_else(Vec::new, |case| case.series(&records.log));
    made.extend(network);
    // They are as large as the messages; only one of the two need be in memory.
    drop(records);
    match series::write(&folder, made) {
        Ok(names) if names.is_empty() => {}
        Ok(names) => {
            let what = format!("{}; columns in series/series.json", names.join(", "));
            summary.run.files.push(Fact::new("series/", what));
        }
        Err(SeriesError::Write { path, source }) => return Some(FileFault::new(&path, &source)),
        Err(error) => summary
            .warnings
            .push(format!("series are missing or not whole: {error}")),
    }
    None
}

/// What spoils the run or the reading of its figures.
fn add_warnings(summary: &mut RunSummary, records: &RunRecords<'_>) {
    let result = records.result;
    summary
        .warnings
        .extend(result.problems.iter().cloned().chain(records.problems()));
    for process in &result.processes {
        let unconnected = process
            .report
            .as_ref()
            .map_or(0, |report| report.connection_failures);
        if unconnected > 0 {
            let name = &process.name;
            summary.warnings.push(format!(
                "{name} failed {unconnected} times to connect to the other end of a channel; do \
                 all processes run as one user?"
            ));
        }
    }
    summary
        .warnings
        .extend(own_programs::witness_warnings(result));
    let channels = records.topology.channels().iter().zip(&summary.channels);
    let silent = channels.filter_map(|(channel, of)| {
        let program = records.topology.process(&channel.from)?;
        let account = of.account.as_ref().filter(|_| program.is_witnessed())?;
        own_programs::silence_warning(&channel.name, &channel.from, account)
    });
    let silent: Vec<String> = silent.collect();
    summary.warnings.extend(silent);
    for one in &summary.flows {
        if one.inlet_lost_count() > 0 {
            let lost = one.inlet_lost.iter();
            let lost = lost.map(|one| format!("{} {}", grouped(one.count), one.name));
            let lost = lost.collect::<Vec<_>>().join(", ");
            summary.warnings.push(format!(
                "{}: frames were lost on this host and in no network, beside those of the account: {lost}",
                one.channel
            ));
        }
    }
    for NamedFlow { name, .. } in records.topology.named_flows() {
        let mut flows = summary.flows.iter().flat_map(|one| &one.flows);
        let has_run = summary.run.outcome != Outcome::Failed;
        if has_run && !flows.any(|flow| flow.name == name) {
            summary.warnings.push(format!(
                "flows.{name}: no frame matches, or those that do belong to a flow that stands before it"
            ));
        }
    }
    summary.warnings.extend(records.clocks.warnings());
    let pairs = &records.clocks.section.pairs;
    let paths = pairs.iter().filter_map(clock_path::warning);
    summary.warnings.extend(paths);
}

#[cfg(test)]
mod tests {
    use hil_rundir::pipe::CounterGroup;

    use super::*;

    #[test]
    fn what_the_receiver_refused_is_no_further_loss_and_what_the_sender_dropped_is() {
        let inlet = |channel: &str, name, count| InletReport {
            channel: channel.to_owned(),
            lost: CountByName::all(CounterGroup::Own, [(name, count)]).collect(),
        };
        let lost = |given_count, refused_count| {
            let all = [
                inlet("a", InletReport::DROPPED_SENT, 5),
                inlet("a", InletReport::DROPPED_GIVEN, given_count),
                inlet("a", InletReport::REFUSED, refused_count),
                inlet("b", InletReport::REFUSED, 100),
            ];
            let found = inlet_lost(all.iter(), "a");
            let found = found.iter().map(|one| (one.label(), one.count));
            found.collect::<Vec<_>>()
        };
        let sent = (InletReport::DROPPED_SENT.to_owned(), 5);
        let given = |count| (InletReport::DROPPED_GIVEN.to_owned(), count);
        assert_eq!(lost(7, 3), [sent.clone(), given(4)]);
        // The interface does not count what it refused.
        assert_eq!(lost(2, 3), [sent]);
    }
}
