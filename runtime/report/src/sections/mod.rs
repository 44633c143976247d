//! A run as the sections of a report: what each says is made here once. CSV takes their metrics, LaTeX score and
//! channels. Nothing is measured or judged here.

mod adapter;
mod answer;
pub(crate) mod channel;
mod clocks;
mod demand;
pub(crate) mod events;
mod flows;
mod network;
mod nics;
mod radio;
mod run;
mod timeline;

pub(crate) use answer::{AnswerFacts, link_words, transports};
pub(crate) use channel::Sources;
pub use channel::quantile_table;
pub(crate) use flows::{deadlines, flows};
pub(crate) use run::{outcome_words, repeat};
pub(crate) use timeline::strips;

use hil_present::{Block, Section};

use crate::assessment::Assessment;
use crate::summary::RunSummary;

/// Flows of a report in full; `summary.json` has all.
const FLOWS_SHOWN: usize = 100;

/// Every section of a run that has something to say, in the order of reading.
pub(crate) fn of_run(summary: &RunSummary, assessment: &Assessment) -> Vec<Section> {
    let network = summary.network.as_ref();
    let mut sections = vec![
        run::outcome(summary, assessment),
        run::warnings(assessment),
        run::score(summary),
        events::robot(summary),
    ];
    if let Some(report) = network {
        let mut over_time = Section::new(
            "over-time",
            report.timeline.title(),
            "largest value a column, own scale a row, · unknown",
        );
        let strips = strips(&report.timeline, &summary.link_changes);
        over_time.blocks.extend(strips.map(Block::Strips));
        sections.push(over_time);
        if report.timeline.has_robot() {
            sections.push(network::preceding(report, &summary.score_events));
        }
        sections.push(network::network(report));
        sections.push(events::network(report));
    }
    sections.push(flows(summary, FLOWS_SHOWN));
    sections.push(deadlines(summary, usize::MAX));
    sections.push(channel::channels(summary));
    sections.push(run::links(&summary.directions));
    sections.push(adapter::adapters(&summary.faces));
    sections.extend(summary.hardware_stamps.as_ref().map(nics::hardware_stamps));
    sections.extend(summary.clocks.as_ref().map(clocks::clocks));
    sections.push(radio::hops(&summary.radio));
    sections.push(run::processes(&summary.processes));
    sections.push(run::events(&summary.events));
    sections.push(run::facts(summary));
    sections.push(run::method(summary));
    sections.push(run::files(&summary.run));
    sections.push(repeat(Some(&summary.run.repeat_command)));
    sections.retain(|section| !section.is_empty());
    sections
}
