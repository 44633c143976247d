//! What happened to the robot, as a summary keeps it: each event of the score beside the fates of
//! the messages it names. Fates are found elsewhere, in the analysis.

use hil_models::case_study::{Score, Severity};
use hil_models::measure::account::MessageFate;
use serde::{Deserialize, Serialize};

/// The events of a run's score.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ScoreEvents {
    /// In the order of the score.
    pub events: Vec<ExplainedEvent>,
    /// Events the score had no room for.
    pub dropped_count: u64,
    /// True when the hosts' clocks differ and are not aligned: times of events on different
    /// hosts do not compare.
    pub clocks_differ: bool,
}

/// One event.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ExplainedEvent {
    /// When, seconds after the start of the run: the earliest of all hosts where they read one
    /// clock, else that of the host named in `clock`; `None` when it is unknown.
    pub at_s: Option<f64>,
    /// The host on whose clock.
    pub clock: String,
    /// How much it matters.
    pub severity: Severity,
    /// What happened, in words.
    pub what: String,
    /// The messages concerned.
    pub messages: Vec<ExplainedMessage>,
    /// Messages the event had no room for.
    pub messages_dropped_count: u64,
}

/// One message an event names, and what became of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ExplainedMessage {
    /// Its channel.
    pub channel: String,
    /// The producer's start.
    pub epoch: u32,
    /// Its number.
    pub sequence: u64,
    /// When it was published, seconds after the start of the run, as in
    /// [`ExplainedEvent::at_s`] but on its producer's host.
    pub published_at_s: Option<f64>,
    /// Its fate, as the account has it; `None` when that is unavailable.
    pub fate: Option<MessageFate>,
    /// Published to taken, seconds.
    pub delay_s: Option<f64>,
    /// Its fate in words, with the link and the cause where they are known, or why it is
    /// unavailable.
    pub words: String,
}

impl ScoreEvents {
    /// The events of a run in virtual time, which keeps counts but no record of single messages.
    pub(crate) fn in_virtual_time(score: &Score) -> Self {
        let events = score.events.iter().map(|event| {
            let messages = event.messages.iter().map(|message| ExplainedMessage {
                channel: message.channel.to_owned(),
                epoch: message.epoch,
                sequence: message.sequence,
                published_at_s: None,
                fate: None,
                delay_s: None,
                words: "unavailable: virtual time keeps no record of single messages".to_owned(),
            });
            ExplainedEvent {
                at_s: Some(event.at.as_ns() as f64 * 1e-9),
                clock: "virtual time".to_owned(),
                severity: event.severity,
                what: event.what.clone(),
                messages: messages.collect(),
                messages_dropped_count: event.messages_dropped_count,
            }
        });
        Self {
            events: events.collect(),
            dropped_count: score.events_dropped_count,
            clocks_differ: false,
        }
    }
}
