//! What a case says of a finished run: figures, and the events a reader will want explained. It
//! names the messages concerned; what the network did to them is not known here.

use core::fmt::Debug;

use serde::{Deserialize, Serialize};

use crate::case_study::ChannelSpec;
use crate::interval::Spread;
use crate::message::Envelope;
use crate::run_log::RunLog;
use crate::time::Instant;

/// Events a score keeps at most.
pub const EVENTS_MAX: usize = 1_000;
/// Messages an event names at most.
pub const EVENT_MESSAGES_MAX: usize = 16;

/// What the robot did.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Score {
    /// The figures, in the order a report prints them.
    pub metrics: Vec<Metric>,
    /// What happened to the robot, in order of time; at most [`EVENTS_MAX`]. Fill it by
    /// [`Score::add_event`].
    pub events: Vec<ScoreEvent>,
    /// Events that found no room: what counts and times are taken from beside [`Self::events`].
    pub left_out: Vec<LeftOut>,
    /// The ways in which the robot can be hurt, the gravest first; none for a case that knows of none.
    pub harms: Vec<Harm>,
    /// Names of the figures that a reader wants to see first, beside the harms.
    pub headline: &'static [&'static str],
}

/// An event that found no room in a score.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct LeftOut {
    /// How much it mattered.
    pub severity: Severity,
    /// When it was, as [`ScoreEvent::at`].
    pub at: Instant,
    /// As [`ScoreEvent::clock_of`].
    pub clock_of: &'static str,
}

impl From<&ScoreEvent> for LeftOut {
    fn from(event: &ScoreEvent) -> Self {
        let ScoreEvent {
            severity,
            at,
            clock_of,
            ..
        } = *event;
        Self {
            severity,
            at,
            clock_of,
        }
    }
}

/// A way in which the robot can be hurt, and how often it was.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Harm {
    /// What happened to it, in the plural, e.g. `motion loops lost`.
    pub what: &'static str,
    /// How often; `None` when the run did not allow to count it.
    pub count: Option<u64>,
    /// Of these, those that limits of the robot itself made, such as the reach of an arm.
    pub own_count: u64,
    /// How often it could have happened; `None` where that cannot be counted.
    pub occasions: Option<Occasions>,
    /// 95 % interval of its share of the occasions, or why there is none.
    pub interval: Option<Spread>,
    /// For a reader who does not know the field's term, a few words; else empty.
    pub note: &'static str,
}

/// What could have hurt the robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Occasions {
    /// What they are, in the plural, e.g. `motion loops sent`.
    pub what: &'static str,
    /// How many there were.
    pub count: u64,
}

impl Harm {
    /// It happened `count` times, on no occasions that could be counted.
    pub const fn new(what: &'static str, count: Option<u64>) -> Self {
        Self {
            what,
            count,
            own_count: 0,
            occasions: None,
            interval: None,
            note: "",
        }
    }

    /// The same of `count` occasions.
    #[must_use]
    pub const fn of(mut self, count: u64, what: &'static str) -> Self {
        self.occasions = Some(Occasions { what, count });
        self
    }
}

/// One figure with its unit, interval and method.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Metric {
    /// Snake-case name with unit suffix, e.g. `joint_error_rad_rms`.
    pub name: &'static str,
    /// The words a report prints.
    pub label: &'static str,
    /// The figure; `None` when the run did not allow it, with the reason in `method`.
    pub value: Option<f64>,
    /// 95 % interval, or why there is none, when the figure is a statistic.
    pub interval: Option<Spread>,
    /// SI unit, or `1` for a pure number.
    pub unit: &'static str,
    /// How it was obtained, or why it was not.
    pub method: String,
    /// What a reader holds it against, a few words as `0 is a collision`; empty where the label says enough.
    pub note: &'static str,
}

/// How much an event matters; where room is short, the higher one is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// Worth knowing: the robot coped.
    Notice,
    /// The robot could not do as it was told: an incident was possible.
    Hazard,
    /// What must not happen, e.g. a collision.
    Incident,
}

/// Something the robot did, with the messages a report shows beside it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ScoreEvent {
    /// How much it matters.
    pub severity: Severity,
    /// When, on the clock of the host that publishes [`ScoreEvent::clock_of`].
    pub at: Instant,
    /// The channel whose producer's clock `at` is read from. With unaligned clocks a time means
    /// nothing without it.
    pub clock_of: &'static str,
    /// What happened, in words without full stop.
    pub what: String,
    /// The messages that led to it, or should have prevented it; at most
    /// [`EVENT_MESSAGES_MAX`]. Fill it by [`ScoreEvent::naming`].
    pub messages: Vec<MessageRef>,
    /// Messages that found no room.
    pub messages_dropped_count: u64,
}

/// Points at one message of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct MessageRef {
    /// Its channel.
    pub channel: &'static str,
    /// The producer's start, as in [`Envelope::epoch`].
    pub epoch: u32,
    /// Its number on the channel, as in [`Envelope::sequence`].
    pub sequence: u64,
}

/// Finds what happens to the robot while its run goes, from the messages of its channels.
pub trait LiveEvents: Debug {
    /// The channels whose messages it takes.
    fn channels(&self) -> &'static [&'static str];

    /// Takes a message of `channel` that was published at `at`; those of one channel come in order.
    fn hear(&mut self, channel: &str, at: Instant, payload: &[u8]);

    /// What happened since the last call, as far as the messages until `now` tell, on their producer's clock.
    fn take(&mut self, now: Instant) -> Vec<ScoreEvent>;
}

/// How far the robot was from what it was to do, over time, to be held against what the network did
/// at the time.
#[derive(Debug, Clone, PartialEq)]
pub struct ErrorSeries {
    /// Snake-case name with unit suffix, e.g. `joint_error_rad`.
    pub name: &'static str,
    /// The words a report prints, e.g. `joint error of the right arm`.
    pub label: &'static str,
    /// SI unit.
    pub unit: &'static str,
    /// The channel whose producer's clock the times are read from, as in
    /// [`ScoreEvent::clock_of`].
    pub clock_of: &'static str,
    /// Times in ascending order, and magnitudes of the error.
    pub samples: Vec<(Instant, f64)>,
}

impl ErrorSeries {
    /// Their mean over the run of `log`.
    pub fn mean(&self, log: &RunLog) -> Metric {
        let count = self.samples.len();
        let sum: f64 = self.samples.iter().map(|sample| sample.1).sum();
        Metric {
            name: self.name,
            label: self.label,
            value: (count > 0).then(|| sum / count as f64),
            interval: None,
            unit: self.unit,
            note: "",
            method: match count {
                0 if !log.has_one_clock() => "the hosts' clocks are not aligned".to_owned(),
                0 => "the run has no sample of it".to_owned(),
                _ => format!("mean of {count} samples; they depend on each other: no interval"),
            },
        }
    }
}

impl MessageRef {
    /// The message of `channel` that was logged with `envelope`.
    pub const fn of(channel: &'static str, envelope: &Envelope) -> Self {
        Self {
            channel,
            epoch: envelope.epoch,
            sequence: envelope.sequence,
        }
    }
}

impl ScoreEvent {
    /// An event that names no message yet.
    pub fn new(
        severity: Severity,
        at: Instant,
        clock_of: &'static str,
        what: impl Into<String>,
    ) -> Self {
        Self {
            severity,
            at,
            clock_of,
            what: what.into(),
            messages: Vec::new(),
            messages_dropped_count: 0,
        }
    }

    /// The channels of a case whose outages may have led to this: those of the messages it names,
    /// and those that the role it is told of hears, unless a message already says which of these
    /// it is about.
    pub fn concerned_channels<'a>(&self, channels: &'a [ChannelSpec]) -> Vec<&'a ChannelSpec> {
        let between_roles = || channels.iter().filter(|one| !one.is_recorded_only());
        let mut tellers = channels.iter().filter(|one| one.name == self.clock_of);
        let teller = tellers.next().map(|one| one.from);
        let is_named = |channel: &ChannelSpec| {
            let mut messages = self.messages.iter();
            messages.any(|message| message.channel == channel.name)
        };
        let is_heard = |channel: &ChannelSpec| channel.to.is_some() && channel.to == teller;
        let knows_which = between_roles().any(|one| is_named(one) && is_heard(one));
        between_roles()
            .filter(|one| is_named(one) || (is_heard(one) && !knows_which))
            .collect()
    }

    /// The same with one more message, unless there is no room.
    #[must_use]
    pub fn naming(mut self, message: MessageRef) -> Self {
        if self.messages.len() < EVENT_MESSAGES_MAX {
            self.messages.push(message);
        } else {
            self.messages_dropped_count += 1;
        }
        self
    }
}

impl Score {
    /// The metric called `name`.
    pub fn get(&self, name: &str) -> Option<&Metric> {
        self.metrics.iter().find(|metric| metric.name == name)
    }

    /// Appends an event. Without room it takes the place of the latest of the least grave events,
    /// if it is graver than they are; of whatever is left out, severity and time are kept.
    pub fn add_event(&mut self, event: ScoreEvent) {
        if self.events.len() >= EVENTS_MAX {
            let severities = self.events.iter().map(|known| known.severity);
            let least = severities.min().filter(|least| *least < event.severity);
            let is_least = |known: &ScoreEvent| Some(known.severity) == least;
            let Some(index) = self.events.iter().rposition(is_least) else {
                self.left_out.push(LeftOut::from(&event));
                return;
            };
            let removed = self.events.remove(index);
            self.left_out.push(LeftOut::from(&removed));
        }
        self.events.push(event);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    crate::message! {
        struct Any = "test.Any.v1" { value: u64 }
    }

    fn event(severity: Severity, at_ns: i64) -> ScoreEvent {
        ScoreEvent::new(severity, Instant::from_ns(at_ns), "a/b", "something")
    }

    #[test]
    fn a_mean_of_no_samples_says_why_there_are_none() {
        let errors = |samples| ErrorSeries {
            name: "error_m",
            label: "error",
            unit: "m",
            clock_of: "a/b",
            samples,
        };
        let mut log = RunLog::default();
        let mean = errors(vec![(Instant::ZERO, 1.0), (Instant::ZERO, 2.0)]).mean(&log);
        assert_eq!(mean.value, Some(1.5));
        assert!(mean.method.starts_with("mean of 2 samples"), "{mean:?}");
        let none = errors(Vec::new()).mean(&log);
        assert_eq!(
            (none.value, none.method.as_str()),
            (None, "the run has no sample of it")
        );
        log.set_clocks_differ();
        let none = errors(Vec::new()).mean(&log);
        assert_eq!(none.method, "the hosts' clocks are not aligned");
    }

    #[test]
    fn a_full_score_keeps_what_is_graver_and_counts_the_rest() {
        let mut score = Score::default();
        for at_ns in 0..1_000 {
            score.add_event(event(Severity::Notice, at_ns));
        }
        score.add_event(event(Severity::Notice, 1_000));
        score.add_event(event(Severity::Hazard, 1_000));
        score.add_event(event(Severity::Incident, 1_001));
        assert_eq!(score.events.len(), EVENTS_MAX);
        let left_out = |score: &Score| -> Vec<_> {
            let all = score.left_out.iter();
            all.map(|one| (one.severity, one.at.as_ns())).collect()
        };
        // The first found no room, and the other two took that of the latest notices.
        assert_eq!(
            left_out(&score),
            [1_000, 999, 998].map(|at_ns| (Severity::Notice, at_ns))
        );
        assert_eq!(score.events.last().unwrap().severity, Severity::Incident);
        assert_eq!(score.events[998].severity, Severity::Hazard);
        assert_eq!(score.events[997].at, Instant::from_ns(997));
        let mut score = Score::default();
        for at_ns in 0..1_005 {
            score.add_event(event(Severity::Incident, at_ns));
        }
        assert_eq!(score.events.len(), 1_000);
        let last = [1_000, 1_001, 1_002, 1_003, 1_004];
        assert_eq!(
            left_out(&score),
            last.map(|at_ns| (Severity::Incident, at_ns))
        );
        assert_eq!(score.events.last().unwrap().at, Instant::from_ns(999));
    }

    #[test]
    fn an_event_concerns_what_its_messages_went_over_or_what_its_teller_hears() {
        let channels = [
            ChannelSpec::of::<Any>("right/command", "controller", "robot"),
            ChannelSpec::of::<Any>("left/command", "controller", "robot"),
            ChannelSpec::of::<Any>("right/feedback", "robot", "controller"),
            ChannelSpec::recorded::<Any>("event", "robot"),
        ];
        let check = |clock_of, named: &[&'static str], expected: &[&str]| {
            let mut event = ScoreEvent::new(Severity::Notice, Instant::ZERO, clock_of, "x");
            for channel in named {
                event = event.naming(MessageRef::of(channel, &Envelope::default()));
            }
            let found = event.concerned_channels(&channels);
            let names: Vec<_> = found.iter().map(|one| one.name).collect();
            assert_eq!(names, expected, "{clock_of} {named:?}");
        };
        let both = ["right/command", "left/command"];
        check("event", &[], &both);
        check("event", &["event"], &both);
        check("event", &["left/command", "event"], &["left/command"]);
        check("right/feedback", &["right/command"], &["right/command"]);
        let all = ["right/command", "left/command", "right/feedback"];
        check("event", &["right/feedback"], &all);
        check("right/command", &[], &["right/feedback"]);
        check("unknown", &[], &[]);
    }

    #[test]
    fn an_event_names_a_bounded_number_of_messages() {
        let mut named = event(Severity::Notice, 0);
        for sequence in 0..20 {
            let envelope = Envelope {
                sequence,
                epoch: 3,
                ..Envelope::default()
            };
            named = named.naming(MessageRef::of("a/b", &envelope));
        }
        assert_eq!(
            (named.messages.len(), named.messages_dropped_count),
            (16, 4)
        );
        assert_eq!(named.messages[15].sequence, 15);
    }
}
