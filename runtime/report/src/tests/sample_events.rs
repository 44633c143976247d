//! What happened to the robot of a run that never was, and the channel that only its record
//! heard, for the reports that are checked in.

use std::collections::BTreeMap;

use hil_account::{MessageFate, Standing};
use hil_core::case_study::Severity;

use super::sample::link;
use crate::assessment::{Assessment, NetworkVerdict};
use crate::score_event::{EventOutage, ExplainedEvent, ExplainedMessage, ScoreEvents};
use crate::summary::{
    ChannelSummary, Fact, LinkKind, Outcome, ProcessSummary, RecordedMetrics, RunFacts, RunSummary,
};
use crate::terminal::{Style, render};
use hil_rundir::event::ProcessKind;

fn message(sequence: u64, fate: Option<MessageFate>, words: &str) -> ExplainedMessage {
    ExplainedMessage {
        channel: "fleet/authority".to_owned(),
        epoch: 1,
        sequence,
        published_at_s: fate.map(|_| sequence as f64 * 0.004),
        fate,
        delay_s: None,
        delay_bound_s: None,
        words: words.to_owned(),
    }
}

fn event(
    at_s: f64,
    severity: Severity,
    what: &str,
    messages: Vec<ExplainedMessage>,
) -> ExplainedEvent {
    ExplainedEvent {
        at_s: Some(at_s),
        clock: "robot-pc".to_owned(),
        severity,
        what: what.to_owned(),
        outages: Vec::new(),
        network: None,
        messages,
        messages_dropped_count: 0,
    }
}

/// A collision with its causes, and a message that came late.
pub(crate) fn few_events() -> ScoreEvents {
    let lost = message(
        900,
        Some(MessageFate::LostOnWire),
        "lost on link hop: emulated loss",
    );
    let late = message(1_012, Some(MessageFate::Taken), "delivered after 812 ms");
    let unknown = message(1_013, None, "unavailable: no process left a record of it");
    let outage = EventOutage {
        channel: "fleet/authority".to_owned(),
        from_s: Some(3.6),
        until_s: Some(4.4),
        length_s: Some(0.8),
        lost_count: 20,
        lost_by_network_count: 20,
        standing: Standing::OverFor(521_000_000),
        clock_bound_s: 0.0,
        other_count: 3,
        words: "outage of 800 ms on fleet/authority, 3.600 s to 4.400 s, 20 messages lost, over \
                for 521 ms (3 others about then)"
            .to_owned(),
    };
    let collision = "robots 3 and 5 of fleet 0 met in their section, 0.41 m into each other";
    let mut incident = event(
        4.921,
        Severity::Incident,
        collision,
        vec![lost, late.clone(), unknown],
    );
    incident.outages.push(outage);
    ScoreEvents {
        events: vec![
            event(
                3.75,
                Severity::Hazard,
                "robot 2 of fleet 1 was told to stop where it no longer could",
                vec![late],
            ),
            incident,
        ],
        ..ScoreEvents::default()
    }
}

/// More than fit, on clocks that do not compare; the last one is the gravest.
pub(crate) fn many_events(long: &str) -> ScoreEvents {
    let mut events: Vec<ExplainedEvent> = (0..20_u8)
        .map(|index| event(f64::from(index), Severity::Notice, "braked", Vec::new()))
        .collect();
    let mut lost = message(7, Some(MessageFate::LostInInterruption), long);
    lost.channel = long.to_owned();
    let mut gravest = event(20.0, Severity::Incident, long, vec![lost]);
    let named = |sequence| message(sequence, Some(MessageFate::Taken), "delivered");
    gravest.messages.extend((8..16).map(named));
    gravest.messages_dropped_count = 3;
    gravest.at_s = None;
    events.push(gravest);
    let all = ScoreEvents {
        events,
        clocks_differ: true,
        ..ScoreEvents::default()
    };
    // Without their times: a summary that is read has none.
    all.without([(Severity::Notice, None); 17].into_iter())
}

/// A channel that only the record heard.
pub(crate) fn recorded_channel() -> ChannelSummary {
    ChannelSummary {
        name: "fleet/truth".to_owned(),
        from: "robots".to_owned(),
        to: None,
        link: LinkKind::RecordOnly,
        account: None,
        outages: None,
        demand: None,
        emulation: None,
        trace_replay: None,
        recorded: Some(RecordedMetrics {
            message_count: 12_345,
            missing_count: 0,
        }),
        ends: Vec::new(),
    }
}

pub(crate) fn summary(channel: ChannelSummary) -> RunSummary {
    let mut summary = RunSummary::new(RunFacts {
        name: "fleet".to_owned(),
        case: "fleet".to_owned(),
        topology_file: "fleet-split.toml".to_owned(),
        topology_hash: String::new(),
        links: Vec::new(),
        seed: 1,
        security: None,
        host: "control-pc".to_owned(),
        started: String::new(),
        starts_ns: BTreeMap::new(),
        duration_s: 1.0,
        outcome: Outcome::Completed,
        exit_reason: "as planned".to_owned(),
        folder: String::new(),
        files: Vec::<Fact>::new(),
        is_virtual: false,
        repeat_command: String::new(),
    });
    summary.channels.push(channel);
    summary
}

#[test]
fn a_recorded_channel_needs_no_account_but_every_message() {
    let whole = summary(recorded_channel());
    assert_eq!(Assessment::of(&whole).warnings, Vec::<String>::new());
    assert!(render(&whole, 100, Style::Plain).contains("12,345 messages recorded\n"));

    let mut torn = recorded_channel();
    if let Some(recorded) = &mut torn.recorded {
        recorded.missing_count = 4;
    }
    let torn = summary(torn);
    assert_eq!(
        Assessment::of(&torn).warnings,
        ["fleet/truth: 4 messages missing in its record"]
    );
    let text = render(&torn, 100, Style::Plain);
    assert!(text.contains("12,345 messages recorded, 4 missing in the record"));

    let mut absent = recorded_channel();
    absent.recorded = None;
    let absent = summary(absent);
    assert_eq!(
        Assessment::of(&absent).warnings,
        ["fleet/truth left no record"]
    );
}

#[test]
fn one_emulated_link_among_real_ones_makes_no_network_result() {
    let mut run = summary(recorded_channel());
    for link in ["udp", "tcp", "emulated"].map(link) {
        run.channels.push(ChannelSummary {
            link,
            ..recorded_channel()
        });
    }
    run.processes.push(ticking());
    assert_eq!(Assessment::of(&run).network, NetworkVerdict::EmulatedLink);
    run.channels.pop();
    assert_eq!(Assessment::of(&run).network, NetworkVerdict::NetworkResult);
}

pub(crate) fn ticking() -> ProcessSummary {
    ProcessSummary {
        name: "robots".to_owned(),
        host: "robot-pc".to_owned(),
        kind: ProcessKind::Component,
        role: Some("robots".to_owned()),
        exit: "ended".to_owned(),
        restart_count: 0,
        preparation_s: Some(0.001),
        tick_count: Some(1_000),
        skipped_tick_count: Some(0),
        cpu_time_s: Some(1.0),
        voluntary_switch_count: None,
        involuntary_switch_count: None,
        malformed_count: None,
        outbox_drop_count: None,
        recorder_drop_count: None,
    }
}

#[test]
fn the_report_has_every_event_and_counts_those_without_room() {
    let mut all = summary(recorded_channel());
    all.score_events = many_events("met");
    let text = render(&all, 100, Style::Plain);
    assert!(
        text.contains("1 incident (must not happen), 0 hazards (nearly one), 37 notices"),
        "{text}"
    );
    assert!(text.contains("met (clock of robot-pc)"), "{text}");
    assert_eq!(text.matches("braked (clock of robot-pc)").count(), 20);
    assert!(
        text.contains("17 of 38 events found no room in the score"),
        "{text}"
    );
    assert!(text.contains("Clocks are not aligned"));
    assert!(text.contains("and 6 more messages"));
}

#[test]
fn a_summary_of_before_events_can_still_be_read() {
    let whole = summary(recorded_channel());
    let mut value: serde_json::Value = serde_json::from_str(&whole.to_json().unwrap()).unwrap();
    value.as_object_mut().unwrap().remove("score_events");
    let channel = value["channels"][0].as_object_mut().unwrap();
    channel.remove("recorded");
    channel.insert("to".to_owned(), "controller".into());
    let read = RunSummary::from_json(&value.to_string()).unwrap();
    assert_eq!(read.score_events, ScoreEvents::default());
    assert_eq!(read.channels[0].to.as_deref(), Some("controller"));
}
