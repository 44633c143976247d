//! The parts of a report that are not about one channel: how the run ended, score, links, processes, host.

use hil_present::units::{duration_s, seconds};
use hil_present::{Block, Cell, Event, EventList, Row, Section, Table, Tone, UNAVAILABLE};

use super::channel::stall_words;
use crate::answer::Answer;
use crate::assessment::Assessment;
use crate::summary::{
    DirectionSummary, Outcome, ProcessSummary, RunEvent, RunEventKind, RunFacts, RunSummary,
    host_words,
};
use hil_platform::text::grouped;
use hil_platform::words::counted;
use hil_rundir::event::EventKind;
use hil_rundir::protection::HopProtection;

/// Shorter preparations are not shown.
const PREPARATION_S_MIN: f64 = 0.01;
/// Changes of links that are listed; all of them are in the summary and in events.log.
const CHANGES_SHOWN_COUNT: usize = 10;
/// Warnings of processes that are listed, the first ones; all of them are in the summary.
const WARNINGS_SHOWN_COUNT: usize = 200;

/// How metrics came about, for every run.
const METHOD: [&str; 3] = [
    "Each message is joined across records by the producer's start and its sequence number. It \
     closes when every stage is recorded, in order, and the segments add up to published → taken \
     within 1 µs; on one clock the wire is the difference of raw kernel stamps.",
    "Quantiles are from histograms with three digits, of messages that were taken; of the network, of \
     messages that arrived. Intervals are 95 %. Losses come in bursts and successive delays are correlated, so that a \
     sample is as good as fewer independent ones: these are its effective sample, on which intervals rest, and none is \
     given where it is too small (docs/intervals.md); Clopper and Pearson where a score says so. The error of the clocks' alignment is in no interval; it stands beside the metrics as a bound.",
    "The network begins where the sending gateway hands a message to the kernel and ends where the \
     receiving gateway's receive call returned. What a host lost is not among its losses. That an \
     event stands beside an outage or follows a series is a matter of time, not of cause.",
];

/// How the run ended, whether its measurement is valid, and what was changed meanwhile.
pub(super) fn outcome(summary: &RunSummary, assessment: &Assessment) -> Section {
    let mut section = Section::new("outcome", "Outcome", "");
    let (tone, word) = outcome_words(summary.run.outcome);
    section.fact(
        "outcome",
        tone,
        format!("{word}: {}", summary.run.exit_reason),
    );
    let answer = Answer::of(summary, assessment);
    let (tone, words) = answer.measurement_words(&assessment.network);
    section.fact("measurement", tone, words);
    if let Some(security) = &summary.run.security {
        let tone = match security.hops {
            HopProtection::Plain => Tone::Caution,
            HopProtection::Sealed { .. } => Tone::Good,
        };
        section.fact("security", tone, security.to_string());
    }
    // What was measured after a change is about another link.
    for (index, change) in summary
        .link_changes
        .iter()
        .take(CHANGES_SHOWN_COUNT)
        .enumerate()
    {
        let label = if index == 0 { "changed" } else { "" };
        let text = format!("{}: {}", change.time(), change.what());
        section.fact(label, Tone::Caution, text);
    }
    let hidden = summary
        .link_changes
        .len()
        .saturating_sub(CHANGES_SHOWN_COUNT) as u64;
    if hidden > 0 {
        let text = format!("{} more in events.log and summary.json", grouped(hidden));
        section.fact("", Tone::Caution, text);
    }
    section
}

/// How a run ended, in a word.
pub(crate) const fn outcome_words(outcome: Outcome) -> (Tone, &'static str) {
    match outcome {
        // That a run ended as planned says nothing of what it found.
        Outcome::Completed => (Tone::Plain, "completed"),
        Outcome::CriterionFailed => (Tone::Bad, "criterion failed"),
        Outcome::Stopped => (Tone::Caution, "stopped early"),
        Outcome::Failed => (Tone::Bad, "failed"),
    }
}

/// What a reader must know before the numbers.
pub(super) fn warnings(assessment: &Assessment) -> Section {
    let mut section = Section::new("warnings", "Warnings", "");
    if !assessment.warnings.is_empty() {
        let items = assessment.warnings.clone();
        let tone = Tone::Caution;
        section.blocks.push(Block::List { tone, items });
    }
    section
}

/// What the robot did.
pub(super) fn score(summary: &RunSummary) -> Section {
    let mut section = Section::new("score", "Score", "what the robot did");
    if summary.run.case.is_empty() {
        return section;
    }
    if summary.score.is_empty() {
        let words = summary.no_score_words();
        section.note(
            Tone::Faint,
            words.unwrap_or_else(|| "no figure but its events".to_owned()),
        );
        return section;
    }
    for one in &summary.score {
        section.metric(one.shown());
    }
    section
}

/// The gateways at both ends of each way of each link, and what they refused.
pub(super) fn links(directions: &[DirectionSummary]) -> Section {
    let mut section = Section::new("links", "Links", "the gateways at both ends");
    let mut shown: Vec<&str> = Vec::new();
    for first in directions {
        if shown.contains(&first.flow.as_str()) {
            continue;
        }
        shown.push(&first.flow);
        let channels = counted(first.channels.len() as u64, "channel");
        let mut link = Section::new("link", first.label(), channels);
        for end in directions.iter().filter(|one| one.flow == first.flow) {
            let refused = end.refusal_words();
            if !refused.is_empty() {
                let text = format!("datagrams: {}", refused.join(" · "));
                link.fact("refused", Tone::Caution, text);
            }
            link.fact(end.direction.word(), Tone::Faint, end.words().join(" · "));
            // Whether a stream stood still is a result, and not one to be looked for among options.
            if let Some(stalls) = &end.stalls {
                link.fact("stalls", Tone::Plain, stall_words(stalls));
            }
        }
        section.children.push(link);
    }
    section
}

pub(super) fn processes(processes: &[ProcessSummary]) -> Section {
    let mut section = Section::new("processes", "Processes", "");
    if processes.is_empty() {
        section.note(Tone::Faint, "none were started");
        return section;
    }
    let columns = ["process", "host", "role", "restarts", "ticks", "skipped"];
    let mut table = Table::new("", &columns);
    for one in processes {
        let ticks = |count: Option<u64>| Cell::count(count.filter(|_| one.kind.counts_ticks()));
        let is_raised = one.restart_count > 0 || one.skipped_tick_count.unwrap_or(0) > 0;
        table.rows.push(Row {
            cells: vec![
                one.name.clone().into(),
                one.host.clone().into(),
                one.label().into(),
                Cell::Count(one.restart_count),
                ticks(one.tick_count),
                ticks(one.skipped_tick_count),
            ],
            tone: if is_raised {
                Tone::Caution
            } else {
                Tone::Plain
            },
            bar: None,
        });
    }
    section.table(table);
    for one in processes {
        let mut words = vec![one.exit.clone()];
        if let Some(s) = one.preparation_s.filter(|s| *s >= PREPARATION_S_MIN) {
            words.push(format!("case prepared in {}", duration_s(s)));
        }
        if let Some(s) = one.cpu_time_s {
            words.push(format!("{} of CPU time", duration_s(s)));
        }
        if let Some((own, forced)) = one.voluntary_switch_count.zip(one.involuntary_switch_count) {
            let [own, forced] = [own, forced].map(grouped);
            words.push(format!(
                "context switches {own} voluntary, {forced} involuntary"
            ));
        }
        section.fact(&one.name, Tone::Faint, words.join("; "));
    }
    section
}

/// What happened to processes and hosts.
pub(super) fn events(events: &[RunEvent]) -> Section {
    let mut section = Section::new("run-events", "Events of the run", "");
    if events.is_empty() {
        return section;
    }
    let mut warning_count = 0;
    let mut listed = Vec::new();
    for event in events {
        if let RunEventKind::Process(EventKind::Warning { .. }) = event.kind {
            warning_count += 1;
            if warning_count > WARNINGS_SHOWN_COUNT {
                continue;
            }
        }
        let what = event.what();
        listed.push(Event {
            at: event
                .at_s
                .map_or_else(|| "time unknown".to_owned(), seconds),
            severity: "run",
            tone: Tone::Plain,
            what: match event.cause() {
                Some(cause) => format!("{what} ({cause})"),
                None => what,
            },
            beside: Vec::new(),
        });
    }
    let hidden = warning_count.saturating_sub(WARNINGS_SHOWN_COUNT) as u64;
    let note = match hidden {
        0 => String::new(),
        _ => format!("{}, in summary.json", counted(hidden, "more warning")),
    };
    let events = listed;
    section
        .blocks
        .push(Block::Events(EventList { events, note }));
    section
}

/// Run, real-time grants and host.
pub(super) fn facts(summary: &RunSummary) -> Section {
    let mut section = Section::new("facts", "Run facts", "");
    let run = &summary.run;
    let hosts = summary.processes.iter().map(|one| one.host.as_str());
    let hosts: std::collections::BTreeSet<&str> = hosts.collect();
    let hosts: Vec<&str> = hosts.into_iter().collect();
    let mut about = Section::new("run", "Run", "");
    let mut fact = |label: &str, value: String| about.fact(label, Tone::Plain, value);
    fact("started", run.started.clone());
    fact("length", seconds(run.duration_s));
    let hosts = if hosts.is_empty() {
        UNAVAILABLE.to_owned()
    } else {
        hosts.join(", ")
    };
    fact("hosts", hosts);
    fact("written by", run.host.clone());
    fact(
        "topology",
        format!("{} ({})", run.topology_file, run.topology_hash),
    );
    fact("seed", run.seed.to_string());
    fact("folder", run.folder.clone());
    section.children.push(about);
    let mut realtime = Section::new("real-time", "Real time", "what the kernel granted");
    for one in &summary.realtime.refused {
        realtime.fact("refused", Tone::Caution, one.to_string());
    }
    for one in &summary.realtime.granted {
        realtime.fact("granted", Tone::Plain, one.to_string());
    }
    if realtime.is_empty() {
        realtime.note(Tone::Faint, "nothing was asked for");
    }
    section.children.push(realtime);
    let mut host = Section::new("host", "Host that wrote this", "");
    for one in host_words(&summary.host_facts) {
        host.fact(one.label, Tone::Plain, one.value);
    }
    section.children.push(host);
    section
}

pub(super) fn method(summary: &RunSummary) -> Section {
    let mut section = Section::new("method", "How to read this", "");
    if !summary.channels.is_empty() {
        for text in METHOD {
            section.note(Tone::Faint, text);
        }
    }
    section
}

/// The run's folder and what is in it.
pub(super) fn files(run: &RunFacts) -> Section {
    let mut section = Section::new("files", "Files", "");
    section.fact("folder", Tone::Plain, &run.folder);
    for file in &run.files {
        section.fact(&file.label, Tone::Plain, &file.value);
    }
    section
}

/// The command that makes the run again.
pub(crate) fn repeat(command: Option<&str>) -> Section {
    let mut section = Section::new("repeat", "Repeat this run", "");
    match command.filter(|command| !command.is_empty()) {
        Some(command) => section.blocks.push(Block::Command {
            text: command.to_owned(),
        }),
        None => section.note(
            Tone::Faint,
            "unavailable: the folder does not say with which command it was made",
        ),
    }
    section
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link_change::{ChangedTo, LinkChange};
    use crate::terminal::{Style, render};
    use crate::tests::sample;
    use hil_link::spec::Way;

    #[test]
    fn of_many_warnings_the_first_are_shown_and_the_others_counted() {
        let mut summary = sample::full();
        let event = |index| RunEvent {
            at_s: Some(1.0),
            process: "robot".to_owned(),
            kind: RunEventKind::Process(EventKind::Warning {
                text: format!("said: {index}."),
            }),
            absence: None,
        };
        summary.events.splice(0..0, (0..100_000).map(event));
        let page = render(&summary, 100, Style::Plain);
        assert!(page.contains("said: 199.") && !page.contains("said: 200."));
        assert!(page.contains("99,800 more warnings, in summary.json"));
        assert!(
            page.contains("restart 1 of at most 3"),
            "what came after them"
        );
    }

    #[test]
    fn a_report_names_every_change_or_how_many_more_there_were() {
        let mut summary = sample::full();
        let change = |number: u64| LinkChange {
            link: "hop".to_owned(),
            way: Way::Backward,
            number,
            at_s: Some(number as f64),
            unsure_s: 0.0,
            to: ChangedTo::Cut,
            refused: None,
        };
        summary.link_changes = (1..=12).map(change).collect();
        let page = render(&summary, 100, Style::Plain);
        assert!(
            page.contains("at 1.000 s: link hop.backward changed by hand: cut"),
            "{page}"
        );
        assert!(page.contains("2 more in events.log"), "{page}");
        summary.link_changes.clear();
        assert!(!render(&summary, 100, Style::Plain).contains("by hand"));
    }
}
