//! Joins what the robot did with what the network did: looks up the fate of every message that an
//! event of the score names. Which messages led to an event is the case's to say.

use std::collections::{BTreeMap, BTreeSet};

use hil_account::{EventTime, MessageFate, MessageHistory, Side, each_history};
use hil_core::case_study::{ChannelSpec, MessageRef, Score, ScoreEvent};
use hil_core::time::{Instant, RemoteInstant};

use super::axis::RunAxis;
use super::outages::OutageHistory;
use super::records::RunRecords;
use crate::network::within;
use crate::score_event::{EventOutage, ExplainedEvent, ExplainedMessage, ScoreEvents};
use crate::summary::{ChannelSummary, CounterGroup, LinkKind};
use hil_present::units::duration_s;
use hil_topology::{Channel, Topology};

/// The events of `score` with the fates of their messages and the outages before them.
pub(super) fn explained(
    score: &Score,
    records: &RunRecords<'_>,
    axis: &RunAxis<'_>,
    channels: &[ChannelSummary],
    specs: &[ChannelSpec],
    outages: &[OutageHistory],
) -> ScoreEvents {
    let mut wanted: BTreeMap<&str, BTreeSet<(u32, u64)>> = BTreeMap::new();
    for message in score.events.iter().flat_map(|event| &event.messages) {
        let of_channel = wanted.entry(message.channel).or_default();
        of_channel.insert((message.epoch, message.sequence));
    }
    let topology = records.topology;
    let ways = wanted.iter().filter_map(|(name, wanted)| {
        let channel = topology.channel(name)?;
        let way = Way {
            axis,
            host: topology.process(&channel.from).map(|one| one.host.as_str()),
            messages: if channel.is_recorded_only() {
                BTreeMap::new()
            } else {
                named_messages(records, channel, wanted)
            },
            channel,
            summary: channels.iter().find(|one| one.name == *name)?,
        };
        Some((*name, way))
    });
    let ways: BTreeMap<&str, Way<'_>> = ways.collect();
    let events = score.events.iter();
    let all = ScoreEvents {
        events: events
            .map(|event| ExplainedEvent {
                outages: outages_before(event, records, specs, outages, &ways),
                ..explain(event, topology, axis, &ways)
            })
            .collect(),
        clocks_differ: axis.is_split(),
        ..ScoreEvents::default()
    };
    let host_of = |channel| {
        Some(
            topology
                .process(&topology.channel(channel)?.from)?
                .host
                .as_str(),
        )
    };
    let left_out = score.left_out.iter();
    all.without(left_out.map(|one| {
        let at_s = host_of(one.clock_of).and_then(|host| axis.place_s(host, one.at));
        (one.severity, at_s)
    }))
}

fn explain(
    event: &ScoreEvent,
    topology: &Topology,
    axis: &RunAxis<'_>,
    ways: &BTreeMap<&str, Way<'_>>,
) -> ExplainedEvent {
    let clock_of = topology.channel(event.clock_of);
    let process = clock_of.and_then(|channel| topology.process(&channel.from));
    let messages = event.messages.iter().map(|message| {
        ways.get(message.channel).map_or_else(
            || unavailable(message, "the run has no such channel"),
            |way| way.explain(message),
        )
    });
    ExplainedEvent {
        at_s: process.and_then(|process| axis.place_s(&process.host, event.at)),
        clock: process.map_or_else(|| "unknown".to_owned(), |process| process.host.clone()),
        severity: event.severity,
        what: event.what.clone(),
        outages: Vec::new(),
        network: None,
        messages: messages.collect(),
        messages_dropped_count: event.messages_dropped_count,
    }
}

/// What the channels that `event` concerns went through when it happened.
fn outages_before(
    event: &ScoreEvent,
    records: &RunRecords<'_>,
    specs: &[ChannelSpec],
    stories: &[OutageHistory],
    ways: &BTreeMap<&str, Way<'_>>,
) -> Vec<EventOutage> {
    let topology = records.topology;
    let host_of = |process: &str| topology.process(process).map(|one| &one.host);
    let teller = topology.channel(event.clock_of);
    let Some(here) = teller.and_then(|one| host_of(&one.from)) else {
        return Vec::new();
    };
    let before = |spec: &ChannelSpec| {
        let story = stories.iter().find(|one| one.channel == spec.name)?;
        let channel = topology.channel(spec.name)?;
        let is_here = |process: &str| host_of(process) == Some(here);
        let is_consumers = channel.to.as_deref().is_some_and(is_here);
        let on_producers_clock = host_of(&channel.from).and_then(|producers| {
            let remote = RemoteInstant::from_ns(event.at.as_ns());
            let (at, bound_ns) = records.clocks.path(here, producers).localise(remote)?;
            Some((at, Side::Producer, bound_ns))
        });
        let lost_published_ns = ways
            .get(spec.name)
            .map_or_else(Vec::new, |way| way.lost_published_ns(event));
        // A time compares only with times of its own clock.
        let sides = [
            is_consumers.then_some((event.at, Side::Consumer, 0)),
            on_producers_clock,
        ];
        let mut sides = sides.into_iter().flatten().map(Some).chain([None]);
        sides.find_map(|side| {
            let mut found = story.before(&EventTime {
                at: side.map(|(at, side, _)| (at, side)),
                lost_published_ns: &lost_published_ns,
            })?;
            found.put_clock_bound(side.map_or(0, |(.., bound_ns)| bound_ns));
            Some(found)
        })
    };
    let concerned = event.concerned_channels(specs);
    let mut outages: Vec<_> = concerned.into_iter().filter_map(before).collect();
    EventOutage::put_own_channels_first(&mut outages, &event.what);
    outages
}

fn unavailable(message: &MessageRef, why: &str) -> ExplainedMessage {
    ExplainedMessage {
        channel: message.channel.to_owned(),
        epoch: message.epoch,
        sequence: message.sequence,
        published_at_s: None,
        fate: None,
        delay_s: None,
        delay_bound_s: None,
        words: format!("unavailable: {why}"),
    }
}

/// A message that an event of the score names.
struct NamedMessage {
    history: MessageHistory,
    /// Published to taken and how far that may be off, nanoseconds; `None` for a message that was not
    /// taken, and between hosts whose clocks are not aligned.
    delay_ns: Option<(i64, u64)>,
}

/// Those of `wanted`, by the producer's start and the number, of which `channel` has a record.
fn named_messages(
    records: &RunRecords<'_>,
    channel: &Channel,
    wanted: &BTreeSet<(u32, u64)>,
) -> BTreeMap<(u32, u64), NamedMessage> {
    let mut found = BTreeMap::new();
    records.consult(channel, |files, context| {
        each_history(files, context, |message| {
            let key = (message.epoch, message.key.sequence);
            if message.is_recorded() && wanted.contains(&key) {
                let named = NamedMessage {
                    history: *message,
                    delay_ns: message.delay_ns(context.path),
                };
                found.insert(key, named);
            }
        });
    });
    found
}

/// All that is known of one channel's messages.
struct Way<'a> {
    channel: &'a Channel,
    summary: &'a ChannelSummary,
    messages: BTreeMap<(u32, u64), NamedMessage>,
    axis: &'a RunAxis<'a>,
    /// Of its producer.
    host: Option<&'a str>,
}

impl Way<'_> {
    fn explain(&self, message: &MessageRef) -> ExplainedMessage {
        if self.channel.is_recorded_only() {
            return unavailable(message, "its channel is only recorded and crosses no link");
        }
        let Some(named) = self.messages.get(&(message.epoch, message.sequence)) else {
            return unavailable(message, "no process left a record of it");
        };
        let published = named.history.published_ns().map(Instant::from_ns);
        ExplainedMessage {
            published_at_s: published
                .zip(self.host)
                .and_then(|(published, host)| self.axis.place_s(host, published)),
            fate: Some(named.history.fate),
            delay_s: named.delay_ns.map(|(ns, _)| ns as f64 * 1e-9),
            delay_bound_s: named.delay_ns.map(|(_, bound_ns)| bound_ns as f64 * 1e-9),
            words: self.words(named),
            ..unavailable(message, "")
        }
    }

    /// Publications of the messages that `event` names and that were lost on this channel.
    fn lost_published_ns(&self, event: &ScoreEvent) -> Vec<i64> {
        let messages = event.messages.iter();
        let named = messages.filter(|message| message.channel == self.channel.name);
        let known =
            named.filter_map(|message| self.messages.get(&(message.epoch, message.sequence)));
        let lost = known.filter(|one| one.history.fate.is_loss());
        lost.filter_map(|one| one.history.published_ns()).collect()
    }

    fn words(&self, named: &NamedMessage) -> String {
        let link = self.channel.link.as_deref().unwrap_or_default();
        match named.history.fate {
            MessageFate::Taken => {
                let how = match named.delay_ns {
                    Some((ns, bound_ns)) => {
                        let bound = within(bound_ns, ns);
                        format!("delivered after {}{bound}", duration_s(ns as f64 * 1e-9))
                    }
                    None => "delivered; delay unavailable: clocks not aligned".to_owned(),
                };
                let overtaken = if named.history.is_overtaken() {
                    ", overtaken by a later message"
                } else {
                    ""
                };
                format!("{how}{overtaken}")
            }
            MessageFate::LostOnWire if self.is_all_loss_emulated() => {
                format!("lost on link {link}: emulated loss")
            }
            MessageFate::LostOnWire => format!("lost on link {link}"),
            MessageFate::Incomplete if self.is_all_loss_emulated() => {
                format!("incomplete, pieces of it lost on link {link}: emulated loss")
            }
            MessageFate::Incomplete => {
                format!("incomplete, pieces of it lost on link {link}")
            }
            MessageFate::LostInInterruption => self.words_of_interruption(&named.history),
            MessageFate::InFlight => "still in flight at the end of the run".to_owned(),
            MessageFate::UnknownPeerRecordsUnavailable => {
                "unavailable: no records of the other host".to_owned()
            }
            fate => fate.label().to_owned(),
        }
    }

    fn words_of_interruption(&self, message: &MessageHistory) -> String {
        let account = self.summary.account.as_ref();
        let interruption = account
            .zip(message.interruption_index)
            .and_then(|(account, index)| account.interruptions.get(index));
        interruption.map_or_else(
            || message.fate.label().to_owned(),
            |one| format!("lost while {} was down ({})", one.process, one.cause),
        )
    }

    /// True when the link's model counted at least as many losses as the account has: then none
    /// is left that anything else could have caused.
    fn is_all_loss_emulated(&self) -> bool {
        let emulated_count = self.summary.count(CounterGroup::Socket, "link_lost_count");
        let account = self.summary.account.as_ref();
        let lost_count = account.map(|account| {
            let fates = &account.fates;
            fates.of(MessageFate::LostOnWire) + fates.of(MessageFate::Incomplete)
        });
        self.summary.link == LinkKind::Emulated
            && lost_count.is_some_and(|lost_count| lost_count <= emulated_count)
    }
}
