//! From what the faces of a run recorded and reported to their part of the summary.

use super::records::RunRecords;
use crate::{face::FaceSummary, face_figures::figures, summary::Fact};
use hil_arm::egm::messages::Side;
use hil_rundir::pipe::FaceReport;
use hil_rundir::run_result::RunResult;
use hil_topology::{EgmFace, FaceKind, Process, Program, command_channel, feedback_channel};

/// Every arm of every face, in the order of the topology.
pub(super) fn face_summaries(records: &RunRecords<'_>) -> Vec<FaceSummary> {
    let mut summaries = Vec::new();
    for process in records.topology.processes() {
        let Program::Egm { face, .. } = &process.program else {
            continue;
        };
        for side in Side::BOTH {
            if face.address(side).is_some() {
                summaries.push(face_summary(records, process, face, side));
            }
        }
    }
    summaries
}

fn face_summary(
    records: &RunRecords<'_>,
    process: &Process,
    face: &EgmFace,
    side: Side,
) -> FaceSummary {
    let (out, back) = match face.kind {
        FaceKind::Robot => (feedback_channel(side), command_channel(side)),
        FaceKind::Sensor => (command_channel(side), feedback_channel(side)),
    };
    let sent = records.of_kind(out, |files| files.face_sent.as_ref());
    let received = records.of_kind(back, |files| files.face_received.as_ref());
    let (sent, received) = (sent.collect::<Vec<_>>(), received.collect::<Vec<_>>());
    let figures = figures(face.kind, &sent, &received);
    let report = report_of(records.result, &process.name, side);
    FaceSummary {
        process: process.name.clone(),
        host: process.host.clone(),
        kind: face.kind,
        arm: side,
        address: face
            .address(side)
            .map(|one| one.to_string())
            .unwrap_or_default(),
        peer_state: report.map_or_else(
            || "unavailable: the face left no report".to_owned(),
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

fn report_of<'a>(result: &'a RunResult, process: &str, side: Side) -> Option<&'a FaceReport> {
    let mut stories = result.processes.iter();
    let story = stories.find(|story| story.name == process)?;
    let mut faces = story.report.as_ref()?.faces.iter();
    faces.find(|face| face.arm == side)
}
