//! What becomes of a run's events while it goes: topics and their messages, the same as
//! [`crate::convert`] makes of the folder afterwards. Where they go is the [`Sink`]'s.

use std::collections::BTreeMap;
use std::time::Instant;

use hil_core::message::Envelope;
use hil_core::record::UNAVAILABLE;
use hil_watch::{Event, Feed, Origin, Record, Seen, WatchedChannel};

use crate::clocks::LiveClocks;
use crate::joining::Joining;
use crate::net::MessageLatency;
use crate::run::Run;
use crate::run_topics::{Drawn, Plan, RunTopics, Wanted};
use crate::sink::Sink;

/// What is known of one channel while its run goes.
#[derive(Debug, Default)]
struct LiveChannel {
    receiving_host: String,
    joining: Joining,
    written: Seen,
    /// Messages that were to come, by what the processes noted.
    due: Seen,
    /// Of these, how many have not come.
    outstanding_count: u64,
    is_from_memory: bool,
}

/// The topics of a run that goes.
#[derive(Debug)]
pub(crate) struct LiveTopics {
    /// What is written.
    pub(crate) topics: RunTopics,
    /// In the same order.
    channels: Vec<LiveChannel>,
    /// Their places, by name.
    places: BTreeMap<String, usize>,
    /// The clocks of the recording.
    pub(crate) clocks: LiveClocks,
}

impl LiveTopics {
    /// Names the topics of a run; they appear with their first message. Without a scene, what it takes
    /// to draw one is not worked out.
    pub(crate) fn of(feed: &Feed, has_scene: bool) -> Self {
        let wanted = feed.channels().map(|channel| Wanted {
            name: &channel.description.name,
            described: Some(&channel.description),
            recorded_bytes: Vec::new(),
        });
        let names = feed.channels().map(|one| one.description.name.clone());
        Self {
            topics: RunTopics::new(wanted.collect(), &feed.manifest().topology, has_scene),
            channels: feed
                .channels()
                .map(|one| LiveChannel::of(feed, one))
                .collect(),
            places: names.zip(0..).collect(),
            clocks: LiveClocks::of(feed),
        }
    }

    /// Makes of an event what is to be made of it.
    ///
    /// # Errors
    /// When the sink cannot take it.
    pub(crate) fn take<S: Sink>(
        &mut self,
        event: &Event<'_>,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        match event {
            Event::Message {
                channel,
                origin,
                envelope,
                payload,
            } => {
                let Some(place) = self.places.get(&channel.description.name).copied() else {
                    return Ok(());
                };
                let host = &self.topics.channels[place].host;
                let Some(at_ns) = self.clocks.message_ns(host, envelope) else {
                    self.topics.counts.timeless_count += 1;
                    return Ok(());
                };
                let drawn = if *origin == Origin::OtherHost {
                    Drawn::Never
                } else {
                    Drawn::Later
                };
                if self
                    .topics
                    .message(place, at_ns, envelope, payload, drawn, sink)?
                {
                    self.channels[place].note_written(envelope);
                }
                Ok(())
            }
            Event::Record {
                channel,
                is_of_this_host,
                record,
                ..
            } => self.record(channel, *is_of_this_host, record, sink),
            Event::Silent => self.flush_joins(sink),
            Event::Problem(_) | Event::Ended { .. } => Ok(()),
        }
    }

    fn record<S: Sink>(
        &mut self,
        name: &str,
        is_of_this_host: bool,
        record: &Record,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        if let Record::LinkCondition(one) = record {
            let conditions = &mut self.topics.conditions;
            let host = conditions.host_of(name);
            let at_ns = host.and_then(|host| self.clocks.time_ns(host, one.from_ns));
            if let Some(at_ns) = at_ns {
                return conditions.write(name, at_ns, one, sink);
            }
            self.topics.counts.timeless_count += 1;
            return Ok(());
        }
        let Some(place) = self.places.get(name).copied() else {
            return Ok(());
        };
        let channel = &mut self.channels[place];
        match record {
            Record::Egress(one) => {
                let host = &self.topics.channels[place].host;
                self.clocks.note(host, one.realtime_offset_ns);
            }
            Record::Ingress(one) => {
                let host = &channel.receiving_host;
                self.clocks.note(host, one.realtime_offset_ns);
            }
            _ => {}
        }
        channel.note_due(record, is_of_this_host);
        let now = Instant::now();
        channel.joining.take(record, is_of_this_host, now);
        self.give_out(place, &mut Joining::next, sink)
    }

    /// Nothing more is to be read by `now`: gives out the stamps of messages that were held for long
    /// enough, and draws the scene as far as it is known.
    ///
    /// # Errors
    /// When the sink cannot take them.
    pub(crate) fn settle<S: Sink>(&mut self, now: Instant, sink: &mut S) -> Result<(), S::Error> {
        if let Some(scene) = &mut self.topics.scene {
            scene.settle(sink)?;
        }
        let mut places = 0..self.channels.len();
        places
            .try_for_each(|place| self.give_out(place, &mut |joining| joining.next_held(now), sink))
    }

    /// Gives out the stamps of all messages that are still waited for.
    ///
    /// # Errors
    /// When the sink cannot take them.
    pub(crate) fn flush_joins<S: Sink>(&mut self, sink: &mut S) -> Result<(), S::Error> {
        let mut places = 0..self.channels.len();
        places.try_for_each(|place| self.give_out(place, &mut Joining::earliest, sink))
    }

    /// Writes the stamps of the messages that `next` gives out.
    fn give_out<S: Sink>(
        &mut self,
        place: usize,
        next: &mut dyn FnMut(&mut Joining) -> Option<MessageLatency>,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        let (channel, topics) = (&mut self.channels[place], &mut self.topics.channels[place]);
        while let Some(mut one) = next(&mut channel.joining) {
            let Some(at_ns) = self.clocks.latency_ns(&topics.host, &one) else {
                self.topics.counts.timeless_count += 1;
                continue;
            };
            if self.clocks.compares() || topics.host == channel.receiving_host {
                one.compare_ends();
            }
            topics.write_latency(at_ns, &one, sink)?;
        }
        Ok(())
    }

    /// Writes what only the end of the run tells: the verdicts of its links, and the events of its
    /// score.
    ///
    /// # Errors
    /// When the sink cannot take it.
    pub(crate) fn conclude<S: Sink>(&mut self, run: &Run, sink: &mut S) -> Result<(), S::Error> {
        let mut plan = Plan::default();
        let clocks = &mut self.clocks;
        plan.put_end(run, &self.topics.channels, &mut |host, ns| {
            clocks.time_ns(host, ns)
        });
        self.topics.counts.timeless_count += plan.timeless_count;
        let mut items = plan.items.into_iter();
        items.try_for_each(|item| self.topics.write(run, &[], item, sink))
    }

    /// Messages that should be there and are not, by channel. `is_silent` says that all records of
    /// the run have come, so that what is not there will not come.
    pub(crate) fn missed(&self, feed: &Feed, is_silent: bool) -> BTreeMap<String, u64> {
        let counts = self.places.iter().map(|(name, place)| {
            let channel = &self.channels[*place];
            let is_known = is_silent && channel.due.count() > 0;
            let unseen_count = feed.missed_count(name);
            let outstanding_count = channel.outstanding_count;
            (
                name.clone(),
                if is_known {
                    outstanding_count
                } else {
                    unseen_count
                },
            )
        });
        counts.filter(|(_, count)| *count > 0).collect()
    }

    /// Messages that were published before anybody looked, by channel: of own programs, whose
    /// messages nobody records.
    pub(crate) fn earlier(&self, feed: &Feed) -> BTreeMap<String, u64> {
        let from_memory = self.places.iter();
        let from_memory = from_memory.filter(|(_, place)| self.channels[**place].is_from_memory);
        let counts = from_memory
            .filter_map(|(name, _)| Some((name.clone(), feed.counters(name)?.earlier_count)));
        counts.filter(|(_, count)| *count > 0).collect()
    }

    /// Stamps that came for messages that had been waited for long enough.
    pub(crate) fn late_count(&self) -> u64 {
        let channels = self.channels.iter();
        channels.map(|one| one.joining.late_count).sum()
    }

    /// Messages whose stamps were given out after those of a message published later.
    pub(crate) fn unordered_count(&self) -> u64 {
        let channels = self.channels.iter();
        channels.map(|one| one.joining.unordered_count).sum()
    }

    /// False while something is being made that the scene waits for.
    pub(crate) fn is_scene_ready(&mut self) -> bool {
        let scene = self.topics.scene.as_mut();
        scene.is_none_or(|scene| !scene.awaits_ground())
    }
}

impl LiveChannel {
    fn of(feed: &Feed, channel: &WatchedChannel) -> Self {
        let one = &channel.description;
        let mut announced = feed.run().channels.iter();
        let announced = announced.find(|announced| announced.name == one.name);
        Self {
            receiving_host: one.to_host.clone().unwrap_or_default(),
            joining: Joining::new(announced.map_or(&[], |one| &one.noted)),
            is_from_memory: channel.is_unrecorded(),
            ..Self::default()
        }
    }

    fn note_written(&mut self, envelope: &Envelope) {
        let is_new = self.written.insert(envelope.epoch, envelope.sequence);
        if is_new && self.due.contains(envelope.epoch, envelope.sequence) {
            self.outstanding_count -= 1;
        }
    }

    /// Notes that a message is to come: its producer here published it, or a gateway here did.
    fn note_due(&mut self, record: &Record, is_of_this_host: bool) {
        let (epoch, sequence) = match record {
            Record::Published(one) => (one.epoch, one.sequence),
            Record::Ingress(one) if one.forwarded_ns != UNAVAILABLE && is_of_this_host => {
                (one.epoch, one.sequence)
            }
            _ => return,
        };
        if self.due.insert(epoch, sequence) && !self.written.contains(epoch, sequence) {
            self.outstanding_count += 1;
        }
    }
}
