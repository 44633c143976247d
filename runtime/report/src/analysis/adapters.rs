//! From what the adapters of a run recorded and reported to their part of the summary.

use super::records::RunRecords;
use crate::adapter::AdapterSummary;
use crate::adapter_metrics::metrics;
use crate::summary::Fact;
use hil_arm::egm::messages::Side;
use hil_rundir::pipe::AdapterReport;
use hil_rundir::run_result::RunResult;
use hil_topology::{AdapterKind, EgmAdapter, Process, Program, command_channel, feedback_channel};

/// Every arm of every adapter, in the order of the topology.
pub(super) fn adapter_summaries(records: &RunRecords<'_>) -> Vec<AdapterSummary> {
    let mut summaries = Vec::new();
    for process in records.topology.processes() {
        let Program::Egm { adapter, .. } = &process.program else {
            continue;
        };
        for side in Side::BOTH {
            if adapter.address(side).is_some() {
                summaries.push(adapter_summary(records, process, adapter, side));
            }
        }
    }
    summaries
}

fn adapter_summary(
    records: &RunRecords<'_>,
    process: &Process,
    adapter: &EgmAdapter,
    side: Side,
) -> AdapterSummary {
    let (out, back) = match adapter.kind {
        AdapterKind::Robot => (feedback_channel(side), command_channel(side)),
        AdapterKind::Sensor => (command_channel(side), feedback_channel(side)),
    };
    let sent = records.of_kind(out, |files| files.adapter_sent.as_ref());
    let received = records.of_kind(back, |files| files.adapter_received.as_ref());
    let (sent, received) = (sent.collect::<Vec<_>>(), received.collect::<Vec<_>>());
    let figures = metrics(adapter.kind, &sent, &received);
    let report = report_of(records.result, &process.name, side);
    AdapterSummary {
        process: process.name.clone(),
        host: process.host.clone(),
        kind: adapter.kind,
        arm: side,
        address: adapter
            .address(side)
            .map(|one| one.to_string())
            .unwrap_or_default(),
        peer_state: report.map_or_else(
            || "unavailable: the adapter left no report".to_owned(),
            |report| report.peer_state.clone(),
        ),
        cycle_ns: figures.cycle_ns,
        answers: figures.answers,
        segments: figures.segments,
        refusals: report
            .iter()
            .flat_map(|report| &report.refusals)
            .filter(|refusal| refusal.count > 0)
            .copied()
            .collect(),
        counters: report.map_or_else(Vec::new, |report| report.counters.clone()),
        facts: report
            .iter()
            .flat_map(|report| &report.facts)
            .map(|(label, value)| Fact::new(label.clone(), value.clone()))
            .collect(),
    }
}

fn report_of<'a>(result: &'a RunResult, process: &str, side: Side) -> Option<&'a AdapterReport> {
    let mut stories = result.processes.iter();
    let story = stories.find(|story| story.name == process)?;
    let mut faces = story.report.as_ref()?.faces.iter();
    faces.find(|adapter| adapter.arm == side)
}
