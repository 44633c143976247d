//! What happened to the robot in virtual time, with the outages before it. Virtual time keeps no
//! record of single messages, so their fates are not known here.

use core::time::Duration;

use hil_models::case_study::{ChannelSpec, Score, ScoreEvent};
use hil_models::measure::account::{Outage, Side};
use hil_models::time::Instant;

use crate::analysis::outages::OutageStory;
use crate::report::score_event::{EventOutage, ExplainedEvent, ExplainedMessage, ScoreEvents};

/// The outages of `channel` in a run of `duration`, which begins at instant zero.
pub(super) fn story(channel: String, outages: Vec<Outage>, duration: Duration) -> OutageStory {
    OutageStory {
        channel,
        outages,
        start: Some(Instant::ZERO),
        end: Some(Instant::ZERO + duration),
        interrupted: Vec::new(),
        is_partial: false,
    }
}

/// The events of a run in virtual time.
pub(super) fn explained(
    score: &Score,
    channels: &[ChannelSpec],
    stories: &[OutageStory],
) -> ScoreEvents {
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
            outages: outages_before(event, channels, stories),
            messages: messages.collect(),
            messages_dropped_count: event.messages_dropped_count,
        }
    });
    ScoreEvents {
        events: events.collect(),
        dropped_count: score.events_dropped_count,
        clocks_differ: false,
    }
}

fn outages_before(
    event: &ScoreEvent,
    channels: &[ChannelSpec],
    stories: &[OutageStory],
) -> Vec<EventOutage> {
    let before = |spec: &ChannelSpec| {
        let story = stories.iter().find(|one| one.channel == spec.name)?;
        story.before(event.at, Side::Consumer)
    };
    let concerned = event.concerned_channels(channels);
    concerned.into_iter().filter_map(before).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_models::case_study::{CaseStudy, Severity};
    use hil_models::shuttle::Shuttle;

    #[test]
    fn an_event_in_virtual_time_stands_beside_the_outage_before_it() {
        let mut score = Score::default();
        for at_s in [1, 12] {
            let at = Instant::from_ns(at_s * 1_000_000_000);
            let clock_of = "shuttle/status";
            score.add_event(ScoreEvent::new(
                Severity::Incident,
                at,
                clock_of,
                "stood still",
            ));
        }
        let outage = Outage {
            lost_count: 90,
            first_sequence: 1_000,
            from_ns: Some(10_000_000_000),
            until_ns: Some(10_900_000_000),
            silent_from_ns: Some(10_040_000_000),
            silent_until_ns: Some(10_950_000_000),
            interruption_index: None,
        };
        let name = "shuttle/command".to_owned();
        let stories = [story(name, vec![outage], Duration::from_secs(20))];
        let events = explained(&score, Shuttle::CHANNELS, &stories).events;
        assert!(events[0].outages.is_empty());
        let found = &events[1].outages[0];
        assert_eq!((found.from_s, found.until_s), (Some(10.0), Some(10.9)));
        assert!((found.since_end_s - 1.05).abs() < 1e-9);
        assert!(!found.is_under_way && found.lost_count == 90);
    }
}
