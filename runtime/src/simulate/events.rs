//! What happened to the robot in virtual time, with the outages before it. Virtual time keeps no
//! record of single messages, so their fates are not known here.

use core::time::Duration;
use std::collections::BTreeSet;

use hil_models::case_study::{ChannelSpec, Score, ScoreEvent};
use hil_models::measure::account::{Happening, Outage, Side};
use hil_models::run_log::{LoggedMessage, RunLog};
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
    log: &RunLog,
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
            outages: outages_before(event, channels, stories, log),
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
    log: &RunLog,
) -> Vec<EventOutage> {
    let before = |spec: &ChannelSpec| {
        let story = stories.iter().find(|one| one.channel == spec.name)?;
        let lost_published_ns = published_ns(event, spec.name, log);
        // A channel that never delivered anything has no consumer's view of its outage.
        let mut sides = [Side::Consumer, Side::Producer].into_iter();
        sides.find_map(|side| {
            story.before(&Happening {
                at: Some((event.at, side)),
                lost_published_ns: &lost_published_ns,
            })
        })
    };
    let concerned = event.concerned_channels(channels);
    concerned.into_iter().filter_map(before).collect()
}

/// Publications of the messages of `channel` that `event` names. A delivered one lies in no outage,
/// so it does no harm among the lost ones.
fn published_ns(event: &ScoreEvent, channel: &str, log: &RunLog) -> Vec<i64> {
    let named: BTreeSet<(u32, u64)> = event
        .messages
        .iter()
        .filter(|message| message.channel == channel)
        .map(|message| (message.epoch, message.sequence))
        .collect();
    // A producer numbers its messages in order, and in virtual time it never starts anew.
    let messages = log.raw(channel);
    let key = |message: &LoggedMessage| (message.envelope.epoch, message.envelope.sequence);
    let find = |wanted: &(u32, u64)| messages.binary_search_by_key(wanted, key).ok();
    let found = named.iter().filter_map(find);
    found
        .map(|index| messages[index].envelope.published_ns)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_models::case_study::{CaseStudy, MessageRef, Severity};
    use hil_models::measure::account::Standing;
    use hil_models::message::Envelope;
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
        // Told of its beginning, it names a message that was lost after it.
        let mut log = RunLog::default();
        for sequence in 0..2_000_u64 {
            let envelope = Envelope {
                sequence,
                published_ns: i64::try_from(sequence).unwrap() * 10_000_000,
                ..Envelope::default()
            };
            log.push("shuttle/command", envelope, &[]);
        }
        let named = log.raw("shuttle/command")[1_005].envelope;
        let early = Instant::from_ns(9_900_000_000);
        let early = ScoreEvent::new(Severity::Hazard, early, "shuttle/status", "held");
        score.add_event(early.naming(MessageRef::of("shuttle/command", &named)));
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
        let events = explained(&score, Shuttle::CHANNELS, &stories, &log).events;
        assert!(events[0].outages.is_empty());
        let found = &events[1].outages[0];
        assert_eq!((found.from_s, found.until_s), (Some(10.0), Some(10.9)));
        assert_eq!(found.standing, Standing::OverFor(1_050_000_000));
        assert_eq!(found.lost_count, 90);
        assert_eq!(events[2].outages[0].standing, Standing::BegunLater);
    }
}
