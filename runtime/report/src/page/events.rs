//! The events of a run as lists: those of the score with what stood beside them, those of the network,
//! and what follows what.

use hil_account::network::NetworkEventKind;
use hil_core::case_study::Severity;

use super::data::{Event, EventList};
use super::words::UNAVAILABLE;
use crate::network::{Correlation, NetworkReport, TimedEvent};
use crate::score_event::{ExplainedEvent, ScoreEvents};
use crate::terminal::{self, percent, seconds};
use hil_platform::text::grouped;

/// Events of the score that a page lists.
const EVENTS_MAX: usize = 200;
/// Events of the network that a page lists: under independent losses there are hundreds alike.
const NETWORK_EVENTS_MAX: usize = 40;

pub(super) fn score_events(events: &ScoreEvents) -> EventList {
    let total = events.events.len();
    let grave = events
        .events
        .iter()
        .filter(|event| event.severity != Severity::Notice);
    let grave_count = grave.count() as u64;
    let mut chosen: Vec<&ExplainedEvent> = events.events.iter().collect();
    // The gravest stay, in order of time.
    if total > EVENTS_MAX {
        chosen.sort_by_key(|event| core::cmp::Reverse(event.severity));
        chosen.truncate(EVENTS_MAX);
        let time_s = |event: &ExplainedEvent| event.at_s.unwrap_or(f64::MAX);
        chosen.sort_by(|a, b| time_s(a).total_cmp(&time_s(b)));
    }
    let mut notes = Vec::new();
    if total > EVENTS_MAX {
        notes.push(format!(
            "the {EVENTS_MAX} gravest of {}; all are in events.log",
            grouped(total as u64)
        ));
    }
    if events.dropped_count > 0 {
        notes.push(format!(
            "{} more found no room in the score",
            grouped(events.dropped_count)
        ));
    }
    if events.clocks_differ {
        notes.push(
            "the hosts' clocks are not aligned: each time is on the clock of the host named"
                .to_owned(),
        );
    }
    EventList {
        grave_count,
        events: chosen
            .into_iter()
            .map(|event| score_event(event, events.clocks_differ))
            .collect(),
        note: notes.join("; "),
    }
}

fn score_event(event: &ExplainedEvent, clocks_differ: bool) -> Event {
    let outages = event.outages.iter().map(|one| one.words.clone());
    let network = event.network_beside().into_iter();
    let mut beside: Vec<String> = outages
        .chain(network.map(|one| one.words.clone()))
        .collect();
    if let Some(network) = &event.network {
        if network.more_count > 0 {
            beside.push(format!("{} more", grouped(network.more_count)));
        }
        if beside.is_empty() {
            beside.push(network.nothing_words());
        }
    }
    let at = event.at_s.map_or_else(|| UNAVAILABLE.to_owned(), seconds);
    let clock = if clocks_differ {
        format!(" ({})", event.clock)
    } else {
        String::new()
    };
    Event {
        at: format!("{at}{clock}"),
        severity: event.severity_word(),
        what: event.what.clone(),
        beside,
    }
}

pub(super) fn network_events(report: &NetworkReport) -> EventList {
    let chosen = longest(&report.events);
    let shown = chosen.len() as u64;
    let listed = chosen.into_iter().map(|event| Event {
        at: seconds(event.from_s),
        severity: "network",
        what: event.words(),
        beside: Vec::new(),
    });
    let total = report.events.len() as u64 + report.events_dropped_count;
    let chance = percent(report.foregoing_chance_ratio);
    let window = terminal::duration_s(report.foregoing_s);
    let mut note = format!(
        "{chance} of all moments of the run have such an event in the {window} before them: so much would \
         stand before an event of the score by chance."
    );
    if total > shown {
        let (shown, total) = (grouped(shown), grouped(total));
        note.push_str(&[" The ", &shown, " longest of ", &total, " events"].concat());
        note.push_str(&[": ", &kinds(&report.events), ". All are in summary.json"].concat());
        if report.events_dropped_count > 0 {
            let dropped = grouped(report.events_dropped_count);
            note.push_str(&[", but for ", &dropped, " that found no room"].concat());
        }
        note.push('.');
    }
    EventList {
        grave_count: 0,
        events: listed.collect(),
        note,
    }
}

/// The longest events, in order of time; what lasts to the end is the longest.
fn longest(events: &[TimedEvent]) -> Vec<&TimedEvent> {
    let mut chosen: Vec<&TimedEvent> = events.iter().collect();
    if chosen.len() > NETWORK_EVENTS_MAX {
        chosen.sort_by(|a, b| b.length_s().total_cmp(&a.length_s()));
        chosen.truncate(NETWORK_EVENTS_MAX);
        chosen.sort_by(|a, b| a.from_s.total_cmp(&b.from_s));
    }
    chosen
}

/// How many there are of each kind.
fn kinds(events: &[TimedEvent]) -> String {
    let words = [
        "outage",
        "burst of losses",
        "delay",
        "reordering",
        "process down",
        "clock step",
    ];
    let mut counts = [0_u64; 6];
    for event in events {
        let index = match event.kind {
            NetworkEventKind::Outage { .. } => 0,
            NetworkEventKind::LossBurst { .. } => 1,
            NetworkEventKind::Delay { .. } => 2,
            NetworkEventKind::Reordering { .. } => 3,
            NetworkEventKind::ProcessDown { .. } => 4,
            NetworkEventKind::ClockStep { .. } => 5,
        };
        counts[index] += 1;
    }
    let of = words.iter().zip(counts).filter(|(_, count)| *count > 0);
    let of = of.map(|(word, count)| format!("{word} {}", grouped(count)));
    of.collect::<Vec<_>>().join(", ")
}

pub(super) fn correlation(report: &NetworkReport) -> Vec<String> {
    match &report.correlation {
        Correlation::Unavailable { reason } => vec![format!("{UNAVAILABLE}: {reason}")],
        Correlation::Tested(tests) => {
            let count = tests.pairs.len();
            let found = tests.significant();
            let words = found
                .iter()
                .map(|pair| pair.words(count, tests.shuffle_count));
            let mut words: Vec<String> = words.collect();
            if words.is_empty() {
                words.push(format!(
                    "no pair of {count} correlates more than chance may give (p ≤ 0.05 in view of all pairs)"
                ));
            }
            words.push("Correlation is not cause: both may follow a third thing.".to_owned());
            words
        }
    }
}
