//! What happened to the robot, as a summary keeps it: each event of the score beside the fates of
//! the messages it names. Fates are found elsewhere, in the analysis.

use std::collections::BTreeMap;

use hil_account::network::NetworkEventKind;
use hil_account::{MessageFate, Standing};
use hil_core::case_study::Severity;
use serde::{Deserialize, Serialize};

use super::network::{PrecedingEvent, PrecedingNetwork};
use hil_present::units::duration_s;

/// The events of a run's score.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ScoreEvents {
    /// In the order of the score.
    pub events: Vec<ExplainedEvent>,
    /// Events the score had no room for.
    pub dropped_count: u64,
    /// These by severity.
    #[serde(default)]
    pub dropped_by_severity: BTreeMap<Severity, u64>,
    /// When they were, of those whose time is known; seconds as [`ExplainedEvent::at_s`]. A summary that was read
    /// has none.
    #[serde(skip)]
    pub(crate) dropped_at_s: Vec<(Severity, f64)>,
    /// True when the hosts' clocks differ and are not aligned: times of events on different
    /// hosts do not compare.
    pub clocks_differ: bool,
}

impl ScoreEvents {
    /// Counts what the score had no room for, each with its time where that is known.
    #[must_use]
    pub(crate) fn without(
        mut self,
        dropped: impl Iterator<Item = (Severity, Option<f64>)>,
    ) -> Self {
        for (severity, at_s) in dropped {
            self.dropped_count += 1;
            *self.dropped_by_severity.entry(severity).or_default() += 1;
            self.dropped_at_s.extend(at_s.map(|at_s| (severity, at_s)));
        }
        self
    }

    /// Events of this severity, listed or not.
    pub(crate) fn count_of(&self, severity: Severity) -> u64 {
        let listed = self.events.iter().filter(|one| one.severity == severity);
        let dropped = self.dropped_by_severity.get(&severity);
        listed.count() as u64 + dropped.copied().unwrap_or(0)
    }

    /// All of them.
    pub(crate) fn total_count(&self) -> u64 {
        self.events.len() as u64 + self.dropped_count
    }
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
    /// What the channels that the event concerns went through about then, where there was an
    /// outage.
    #[serde(default)]
    pub outages: Vec<EventOutage>,
    /// What happened on any network in the seconds before; `None` when the run crossed none, or
    /// the event has no time.
    #[serde(default)]
    pub network: Option<PrecedingNetwork>,
    /// The messages concerned.
    pub messages: Vec<ExplainedMessage>,
    /// Messages the event had no room for.
    pub messages_dropped_count: u64,
}

impl ExplainedEvent {
    /// The word for its severity.
    pub(crate) const fn severity_word(&self) -> &'static str {
        match self.severity {
            Severity::Notice => "notice",
            Severity::Hazard => "hazard",
            Severity::Incident => "incident",
        }
    }

    /// What came before it on any network, without outages that [`Self::outages`] tell of.
    pub(crate) fn network_beside(&self) -> Vec<&PrecedingEvent> {
        let is_told = |one: &&PrecedingEvent| {
            let is_outage = matches!(one.event.kind, NetworkEventKind::Outage { .. });
            let mut outages = self.outages.iter();
            is_outage && outages.any(|outage| outage.channel == one.event.channel)
        };
        let network = self.network.iter().flat_map(|network| &network.events);
        network.filter(|one| !is_told(one)).collect()
    }
}

/// What a channel went through when an event happened: the outage that has most to do with it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EventOutage {
    /// The channel.
    pub channel: String,
    /// Publication of the first lost message, seconds after the start of the run as in
    /// [`ExplainedMessage::published_at_s`].
    pub from_s: Option<f64>,
    /// Publication of the next message that arrived; `None` when none did.
    pub until_s: Option<f64>,
    /// From the one to the other, or to the end of the run, seconds.
    pub length_s: Option<f64>,
    /// Messages lost in it.
    pub lost_count: u64,
    /// Of these, lost by the network for certain.
    pub lost_by_network_count: u64,
    /// How it stands to the event in time, as far as the process that tells of it could see;
    /// nanoseconds.
    pub standing: Standing,
    /// Largest error of `standing` from the alignment of two hosts' clocks, seconds; 0 where both times
    /// were read from one.
    #[serde(default)]
    pub clock_bound_s: f64,
    /// Other outages of the channel about then.
    pub other_count: u64,
    /// All of it in words.
    pub words: String,
}

impl EventOutage {
    /// Notes how far the two hosts' clocks may have led its standing astray.
    pub(crate) fn put_clock_bound(&mut self, bound_ns: u64) {
        let is_measured = matches!(self.standing, Standing::OverFor(_) | Standing::BegunLater);
        self.clock_bound_s = bound_ns as f64 * 1e-9;
        if is_measured && bound_ns > 0 {
            let bound = duration_s(self.clock_bound_s);
            self.words
                .push_str(&[" (±", &bound, " by the clocks)"].concat());
        }
    }

    /// Puts those first whose channel's name has most words in common with `what` happened: an
    /// event of the right arm is about the right arm's channels before it is about the other's.
    pub(crate) fn put_own_channels_first(outages: &mut [Self], what: &str) {
        let words: Vec<&str> = what.split(|c: char| !c.is_alphanumeric()).collect();
        let strangers = |outage: &Self| {
            let parts = outage.channel.split('/');
            let own_count = parts.filter(|part| words.contains(part)).count();
            core::cmp::Reverse(own_count)
        };
        outages.sort_by_key(strangers);
    }
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
    /// Largest error of `delay_s` from the alignment of two hosts' clocks, seconds; 0 on one clock,
    /// `None` without a delay.
    #[serde(default)]
    pub delay_bound_s: Option<f64>,
    /// Its fate in words, with the link and the cause where they are known, or why it is
    /// unavailable.
    pub words: String,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_outage_on_another_clock_says_how_far_its_standing_may_be_off() {
        let told = |standing, bound_ns| {
            let mut outage = EventOutage {
                channel: "a/b".to_owned(),
                from_s: None,
                until_s: None,
                length_s: None,
                lost_count: 1,
                lost_by_network_count: 1,
                standing,
                clock_bound_s: 0.0,
                other_count: 0,
                words: "over for 5 ms".to_owned(),
            };
            outage.put_clock_bound(bound_ns);
            outage.words.replace('\u{a0}', " ")
        };
        let over = Standing::OverFor(5_000_000);
        assert_eq!(told(over, 15_700), "over for 5 ms (±15.7 µs by the clocks)");
        assert_eq!(told(over, 0), "over for 5 ms");
        assert_eq!(told(Standing::UnderWay, 15_700), "over for 5 ms");
    }

    #[test]
    fn an_events_own_arm_comes_first() {
        let outage = |channel: &str| EventOutage {
            channel: channel.to_owned(),
            from_s: None,
            until_s: None,
            length_s: None,
            lost_count: 1,
            lost_by_network_count: 1,
            standing: Standing::Unknown,
            clock_bound_s: 0.0,
            other_count: 0,
            words: String::new(),
        };
        let mut outages = ["egm/right/command", "egm/left/command", "motion/request"].map(outage);
        EventOutage::put_own_channels_first(&mut outages, "left arm: no command for 0.044 s");
        let names = outages.map(|one| one.channel);
        let expected = ["egm/left/command", "egm/right/command", "motion/request"];
        assert_eq!(names, expected);
    }
}
