//! What happened to the robot and, beside it, to the messages concerned. Which events matter most
//! is said by their severity alone.

use hil_account::MessageFate;
use hil_core::case_study::Severity;

use super::canvas::{Canvas, INDENT, Tone};
use super::units::{duration_s, seconds};
use crate::score_event::{ExplainedEvent, ExplainedMessage, ScoreEvents};
use hil_platform::text::{grouped, shortened};
use hil_platform::words::counted;

/// Events on the page, and messages of each; all of them are in the summary.
const SHOWN_COUNT: usize = 12;
const MESSAGES_SHOWN_COUNT: usize = 6;
/// Events of the network shown beside each.
const NETWORK_SHOWN_COUNT: usize = 3;

/// Columns of an event's time, of a message's name, and the margin of messages.
const TIME_WIDTH: usize = 14;
const NAME_WIDTH: usize = 40;
const MESSAGE_MARGIN: usize = INDENT + 4;

pub(super) fn score_events(canvas: &mut Canvas, all: &ScoreEvents) {
    if all.events.is_empty() {
        return;
    }
    let aside = severity_counts(&all.events);
    canvas.heading(
        "What the robot did, and what the network had done to it",
        &aside,
    );
    if all.clocks_differ {
        let text = "Clocks are not aligned: each time counts from the start of the run on the \
                    host named with it, and times of different hosts do not compare.";
        canvas.paragraph(INDENT, Tone::Caution, text);
    }
    for event in shown(&all.events) {
        one_event(canvas, event, all.clocks_differ);
    }
    let hidden = all.events.len().saturating_sub(SHOWN_COUNT) as u64;
    let mut more = Vec::new();
    if hidden > 0 {
        more.push(format!(
            "{} more events are in events.log and summary.json, or printed by --json",
            grouped(hidden)
        ));
    }
    if all.dropped_count > 0 {
        let dropped = grouped(all.dropped_count);
        more.push(format!("{dropped} found no room in the score"));
    }
    if !more.is_empty() {
        canvas.paragraph(INDENT, Tone::Faint, &more.join("; "));
    }
}

/// How many there are of each severity, in words.
pub(super) fn severity_counts(events: &[ExplainedEvent]) -> String {
    let count = |severity| {
        let chosen = events.iter().filter(|one| one.severity == severity);
        chosen.count() as u64
    };
    let counts = [
        counted(count(Severity::Incident), "incident"),
        counted(count(Severity::Hazard), "hazard"),
        counted(count(Severity::Notice), "notice"),
    ];
    counts.join(", ")
}

/// The gravest events, the earlier ones first among equals, in the order of the score.
fn shown(events: &[ExplainedEvent]) -> Vec<&ExplainedEvent> {
    let mut order: Vec<usize> = (0..events.len()).collect();
    order.sort_by_key(|index| core::cmp::Reverse(events[*index].severity));
    order.truncate(SHOWN_COUNT);
    order.sort_unstable();
    order.into_iter().map(|index| &events[index]).collect()
}

fn one_event(canvas: &mut Canvas, event: &ExplainedEvent, clocks_differ: bool) {
    let time = event.at_s.map_or_else(|| "unavailable".to_owned(), seconds);
    let tone = match event.severity {
        Severity::Incident => Tone::Bad,
        Severity::Hazard => Tone::Caution,
        Severity::Notice => Tone::Plain,
    };
    let what = if clocks_differ {
        format!("{} (clock of {})", event.what, event.clock)
    } else {
        event.what.clone()
    };
    canvas.field_of(TIME_WIDTH, &time, tone, &what);
    for outage in &event.outages {
        canvas.paragraph(MESSAGE_MARGIN, Tone::Caution, &outage.words);
    }
    network_before(canvas, event);
    for message in event.messages.iter().take(MESSAGES_SHOWN_COUNT) {
        let tone = match message.fate {
            None | Some(MessageFate::UnknownPeerRecordsUnavailable) => Tone::Faint,
            Some(fate) if fate.is_loss() => Tone::Caution,
            Some(_) => Tone::Plain,
        };
        let name = shortened(&name(message), NAME_WIDTH - 1);
        canvas.field_at(MESSAGE_MARGIN, NAME_WIDTH, &name, tone, &message.words);
    }
    let hidden = event.messages.len().saturating_sub(MESSAGES_SHOWN_COUNT) as u64;
    let more = hidden.saturating_add(event.messages_dropped_count);
    if more > 0 {
        let text = format!("and {} more messages", grouped(more));
        canvas.paragraph(MESSAGE_MARGIN, Tone::Faint, &text);
    }
}

/// What the network went through before `event`, unless an outage above says so already.
fn network_before(canvas: &mut Canvas, event: &ExplainedEvent) {
    let Some(network) = &event.network else {
        return;
    };
    if network.events.is_empty() {
        canvas.paragraph(MESSAGE_MARGIN, Tone::Faint, &network.nothing_words());
        return;
    }
    let rest = event.network_beside();
    for one in rest.iter().take(NETWORK_SHOWN_COUNT) {
        canvas.paragraph(MESSAGE_MARGIN, Tone::Caution, &one.words);
    }
    let hidden = rest.len().saturating_sub(NETWORK_SHOWN_COUNT) as u64 + network.more_count;
    if hidden > 0 {
        let window = duration_s(network.foregoing_s);
        let text = format!(
            "and {} more on the network in the {window} before",
            grouped(hidden)
        );
        canvas.paragraph(MESSAGE_MARGIN, Tone::Faint, &text);
    }
}

/// Which message, and when it was published.
fn name(message: &ExplainedMessage) -> String {
    let number = format!("{} {}", message.channel, grouped(message.sequence));
    match message.published_at_s {
        Some(at_s) => format!("{number} at {}", seconds(at_s)),
        None => number,
    }
}
