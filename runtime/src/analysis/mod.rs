//! From the records of a finished run to its summary: reads the record files, draws up the
//! account of each channel, and lets the case score what the robot did.

mod events;
mod faces;
mod figures;
mod records;

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use hil_models::case_study::Score;
use hil_models::run_log::RunLog;

use figures::{channel_summary, process_summary, realtime_facts, run_event, run_facts};
use records::RunRecords;

use crate::registry::{CaseError, Registry};
use crate::report::summary::{Fact, RunSummary, ScoreMetric, SummaryError};
use crate::report::terminal::{self, Style};
use crate::supervisor::RunResult;
use crate::topology::Topology;

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
    let mut records = RunRecords::read(&result.folder.records())?;
    if !result.has_one_clock {
        records.set_clocks_differ();
    }
    let mut summary = RunSummary::new(run_facts(topology, result, topology_file, command_line));
    summary.host_facts = result
        .facts
        .facts
        .iter()
        .map(|fact| Fact::new(fact.label.replace('_', " "), fact.value.to_text()))
        .collect();
    for process in &result.processes {
        summary.processes.push(process_summary(process));
    }
    summary.realtime = realtime_facts(&result.processes);
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
    summary.faces = faces::face_summaries(topology, result, &records);
    let score = score(topology, registry, records.log())?;
    summary.score = ScoreMetric::all_of(&score);
    summary.score_events =
        events::explained(&score, (topology, result), &records, &summary.channels);
    add_warnings(&mut summary, result, &records);
    summary.write(&result.folder.summary())?;
    let plain = terminal::render(&summary, REPORT_FILE_WIDTH, Style::Plain);
    let path = result.folder.report();
    fs::write(&path, plain).map_err(|source| AnalysisError::Write { path, source })?;
    Ok(summary)
}

/// What spoils the run or the reading of its figures.
fn add_warnings(summary: &mut RunSummary, result: &RunResult, records: &RunRecords) {
    summary
        .warnings
        .extend(result.problems.iter().chain(&records.problems).cloned());
    for process in &result.processes {
        let failures = process
            .report
            .iter()
            .flat_map(|report| &report.recorder_failures);
        let named = failures.map(|failure| format!("{} could not write {failure}", process.name));
        summary.warnings.extend(named);
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
    if !result.has_one_clock {
        summary.warnings.push(
            "clocks not aligned: no figure crosses from one host to the other; segments on one \
             host and round trips are given"
                .to_owned(),
        );
    }
}

/// Width of `report.txt`.
const REPORT_FILE_WIDTH: usize = 100;
