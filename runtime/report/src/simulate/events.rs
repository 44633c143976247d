//! What happened to the robot in virtual time, with the outages before it and what the link's
//! model did to the messages concerned. When a message was taken is not known here.

use core::time::Duration;

use hil_account::{EventTime, MessageFate, Outage, Side};
use hil_core::case_study::{ChannelSpec, MessageRef, Score, ScoreEvent};
use hil_core::run_log::{LoggedMessage, RunLog};
use hil_core::time::Instant;

use crate::analysis::outages::{OutageHistory, placed};
use crate::score_event::{EventOutage, ExplainedEvent, ExplainedMessage, ScoreEvents};

/// The outages of `channel` in a run of `duration`, which begins at instant zero.
pub(super) fn history(channel: String, outages: Vec<Outage>, duration: Duration) -> OutageHistory {
    OutageHistory {
        channel,
        // Virtual time begins with the run.
        placed_ns: placed(&outages, Some),
        outages,
        end: Some(Instant::ZERO + duration),
        interrupted: Vec::new(),
        is_partial: false,
    }
}

/// The events of a run in virtual time.
pub(super) fn explained(
    score: &Score,
    channels: &[ChannelSpec],
    stories: &[OutageHistory],
    log: &RunLog,
) -> ScoreEvents {
    let events = score.events.iter().map(|event| {
        let messages = event.messages.iter();
        let messages = messages.map(|message| explain(message, stories, log));
        ExplainedEvent {
            at_s: Some(event.at.as_ns() as f64 * 1e-9),
            clock: "virtual time".to_owned(),
            severity: event.severity,
            what: event.what.clone(),
            outages: outages_before(event, channels, stories, log),
            network: None,
            messages: messages.collect(),
            messages_dropped_count: event.messages_dropped_count,
        }
    });
    let all = ScoreEvents {
        events: events.collect(),
        ..ScoreEvents::default()
    };
    let left_out = score.left_out.iter();
    all.without(left_out.map(|one| (one.severity, Some(one.at.as_ns() as f64 * 1e-9))))
}

fn outages_before(
    event: &ScoreEvent,
    channels: &[ChannelSpec],
    stories: &[OutageHistory],
    log: &RunLog,
) -> Vec<EventOutage> {
    let before = |spec: &ChannelSpec| {
        let story = stories.iter().find(|one| one.channel == spec.name)?;
        let messages = event.messages.iter();
        let named = messages.filter(|message| message.channel == spec.name);
        let lost_published_ns: Vec<i64> = named
            .filter_map(|message| published_ns(message, log))
            .filter(|ns| is_lost(*ns, &story.outages))
            .collect();
        // A channel that never delivered anything has no consumer's view of its outage.
        let mut sides = [Side::Consumer, Side::Producer].into_iter();
        sides.find_map(|side| {
            story.before(&EventTime {
                at: Some((event.at, side)),
                lost_published_ns: &lost_published_ns,
            })
        })
    };
    let concerned = event.concerned_channels(channels);
    let mut outages: Vec<_> = concerned.into_iter().filter_map(before).collect();
    EventOutage::put_own_channels_first(&mut outages, &event.what);
    outages
}

/// What the link's model did to `message`.
fn explain(message: &MessageRef, stories: &[OutageHistory], log: &RunLog) -> ExplainedMessage {
    let published_ns = published_ns(message, log);
    let story = stories.iter().find(|one| one.channel == message.channel);
    let is_lost = published_ns
        .zip(story)
        .map(|(ns, story)| is_lost(ns, &story.outages));
    let words = match (published_ns, is_lost) {
        (None, _) => "unavailable: the log has no such message",
        (Some(_), None) => "carried by no link",
        (Some(_), Some(true)) => "lost by the link's model",
        (Some(_), Some(false)) => "not lost by the link's model",
    };
    ExplainedMessage {
        channel: message.channel.to_owned(),
        epoch: message.epoch,
        sequence: message.sequence,
        published_at_s: published_ns.map(|ns| ns as f64 * 1e-9),
        fate: is_lost.unwrap_or(false).then_some(MessageFate::LostOnWire),
        delay_s: None,
        delay_bound_s: None,
        words: words.to_owned(),
    }
}

/// In virtual time every message of an outage is lost, and outages are in order of time.
fn is_lost(published_ns: i64, outages: &[Outage]) -> bool {
    let next = outages.partition_point(|one| one.from_ns <= Some(published_ns));
    let before = next.checked_sub(1).map(|index| outages[index]);
    before.is_some_and(|outage| outage.contains(published_ns))
}

/// When `message` was published. A producer numbers its messages in order, and in virtual time it
/// never starts anew.
fn published_ns(message: &MessageRef, log: &RunLog) -> Option<i64> {
    // A simulation holds its messages.
    let messages = log.raw(message.channel).held()?;
    let key = |logged: &LoggedMessage| (logged.envelope.epoch, logged.envelope.sequence);
    let wanted = (message.epoch, message.sequence);
    let index = messages.binary_search_by_key(&wanted, key).ok()?;
    Some(messages[index].envelope.published_ns)
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_account::Standing;
    use hil_core::case_study::{CaseStudy, Severity};
    use hil_core::message::Envelope;
    use hil_shuttle::Shuttle;

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
        let named = log.raw("shuttle/command").held().unwrap()[1_005].envelope;
        let early = Instant::from_ns(9_900_000_000);
        let early = ScoreEvent::new(Severity::Hazard, early, "shuttle/status", "held");
        score.add_event(early.naming(MessageRef::of("shuttle/command", &named)));
        let outage = Outage {
            lost_count: 90,
            lost_by_network_count: 90,
            first_sequence: 1_000,
            from_ns: Some(10_000_000_000),
            until_ns: Some(10_900_000_000),
            silent_from_ns: Some(10_040_000_000),
            silent_until_ns: Some(10_950_000_000),
            interruption_index: None,
        };
        let name = "shuttle/command".to_owned();
        let stories = [history(name, vec![outage], Duration::from_secs(20))];
        let events = explained(&score, Shuttle::CHANNELS, &stories, &log).events;
        assert!(events[0].outages.is_empty());
        let found = &events[1].outages[0];
        assert_eq!((found.from_s, found.until_s), (Some(10.0), Some(10.9)));
        assert_eq!(found.standing, Standing::OverFor(1_050_000_000));
        assert_eq!((found.lost_count, found.lost_by_network_count), (90, 90));
        assert_eq!(events[2].outages[0].standing, Standing::BegunLater);
        let lost = &events[2].messages[0];
        assert_eq!(lost.fate, Some(MessageFate::LostOnWire));
        assert_eq!(lost.words, "lost by the link's model");
        assert!((lost.published_at_s.unwrap() - 10.05).abs() < 1e-9);
    }
}
