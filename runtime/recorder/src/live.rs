//! What becomes of a run's events while it goes: topics and their messages, the same as
//! [`crate::convert`] makes of the folder afterwards. Where they go is the [`Sink`]'s.

use std::collections::BTreeMap;
use std::time::Instant;

use hil_core::message::Envelope;
use hil_core::record::UNAVAILABLE;
use hil_link::condition::LinkConditionRecord;
use hil_rundir::live_run::Source;
use hil_watch::{Event, Feed, Origin, Record, Seen, WatchedChannel};

use crate::channel::{ChannelTopics, Wanted, typed};
use crate::conditions::Conditions;
use crate::facts::Words;
use crate::joining::Joining;
use crate::live_clocks::LiveClocks;
use crate::net::{self, MessageLatency};
use crate::run::Run;
use crate::scene::waiting::LiveScene;
use crate::scene::{Heard, Scene};
use crate::sink::{Sink, Topic};
use crate::topics::{self, Names};
use crate::writer::Stamp;

/// One channel and what is made of it.
#[derive(Debug)]
struct LiveChannel {
    topics: ChannelTopics,
    /// Host of its producer; empty when the manifest does not tell.
    host: String,
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
    channels: BTreeMap<String, LiveChannel>,
    /// Those that were not free among them.
    pub(crate) names: Names,
    events: Topic,
    conditions: Conditions,
    scene: Option<LiveScene>,
    /// The clocks of the recording.
    pub(crate) clocks: LiveClocks,
    /// What was made so far.
    pub(crate) counts: Counts,
}

/// What was made, and what could not be.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[allow(clippy::struct_field_names, reason = "the ending of every count")]
pub(crate) struct Counts {
    /// Messages of the run's own channels.
    pub(crate) message_count: u64,
    /// Messages whose size is not that of their channel, left out.
    pub(crate) misfit_count: u64,
    /// Messages and records without a time on the recording's clock, left out.
    pub(crate) timeless_count: u64,
}

impl LiveTopics {
    /// Names the topics of a run; they appear with their first message. Without a scene, what it takes
    /// to draw one is not worked out.
    pub(crate) fn of(feed: &Feed, has_scene: bool) -> Self {
        let mut names = Names::default();
        let wanted = feed.channels().map(|channel| {
            let described = Some(&channel.description);
            Wanted {
                name: &channel.description.name,
                described,
                typed: typed(described),
            }
        });
        let topics = ChannelTopics::of_all(wanted.collect(), &mut names);
        let channels = feed.channels().zip(topics);
        let channels = channels
            .map(|(channel, topics)| (topics.name.clone(), LiveChannel::of(feed, channel, topics)))
            .collect();
        let events = topics::event_topic(&mut names);
        let topology = &feed.manifest().topology;
        let conditions = Conditions::of(topology, &mut names);
        let case = &topology["case"];
        let scene = has_scene.then(|| {
            let scene = Scene::new(case["name"].as_str(), &case["parameters"], &mut names);
            LiveScene::new(scene)
        });
        Self {
            channels,
            names,
            events,
            conditions,
            scene,
            clocks: LiveClocks::of(feed),
            counts: Counts::default(),
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
            Event::Message { .. } => self.message(event, sink),
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

    fn message<S: Sink>(&mut self, event: &Event<'_>, sink: &mut S) -> Result<(), S::Error> {
        let Event::Message {
            channel,
            origin,
            envelope,
            payload,
        } = event
        else {
            return Ok(());
        };
        let name = channel.description.name.as_str();
        let Some(channel) = self.channels.get_mut(name) else {
            return Ok(());
        };
        let Some(at_ns) = self.clocks.message_ns(&channel.host, envelope) else {
            self.counts.timeless_count += 1;
            return Ok(());
        };
        let at = Stamp::new(at_ns, envelope.sequence);
        if !channel.topics.write_message(at, payload, sink)? {
            self.counts.misfit_count += 1;
            return Ok(());
        }
        channel.note_written(envelope);
        self.counts.message_count += 1;
        // What another host sends at the end was long ago: the pictures of that time are drawn.
        if *origin == Origin::OtherHost {
            return Ok(());
        }
        if let Some((scene, message)) = self.scene.as_mut().zip(channel.topics.message.as_deref()) {
            let heard = Heard {
                channel: name,
                message,
                payload,
                at_ns,
                published_ns: envelope.published_ns,
            };
            scene.take(&heard, sink)?;
        }
        Ok(())
    }

    fn record<S: Sink>(
        &mut self,
        name: &str,
        is_of_this_host: bool,
        record: &Record,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        if let Record::LinkCondition(one) = record {
            return self.condition(name, one, sink);
        }
        let Some(channel) = self.channels.get_mut(name) else {
            return Ok(());
        };
        match record {
            Record::Egress(one) => self.clocks.note(&channel.host, one.realtime_offset_ns),
            Record::Ingress(one) => {
                self.clocks
                    .note(&channel.receiving_host, one.realtime_offset_ns);
            }
            _ => {}
        }
        channel.note_due(record, is_of_this_host);
        channel
            .joining
            .take(record, is_of_this_host, Instant::now());
        channel.give_out(&mut Joining::next, &mut self.clocks, &mut self.counts, sink)
    }

    /// Nothing more is to be read by `now`: gives out the stamps of messages that were held for long
    /// enough.
    ///
    /// # Errors
    /// When the sink cannot take them.
    pub(crate) fn settle<S: Sink>(&mut self, now: Instant, sink: &mut S) -> Result<(), S::Error> {
        self.give_out(&mut |joining| joining.next_held(now), sink)
    }

    /// Gives out the stamps of all messages that are still waited for.
    ///
    /// # Errors
    /// When the sink cannot take them.
    pub(crate) fn flush_joins<S: Sink>(&mut self, sink: &mut S) -> Result<(), S::Error> {
        self.give_out(&mut Joining::earliest, sink)
    }

    fn give_out<S: Sink>(
        &mut self,
        next: &mut dyn FnMut(&mut Joining) -> Option<MessageLatency>,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        let (clocks, counts) = (&mut self.clocks, &mut self.counts);
        let mut channels = self.channels.values_mut();
        channels.try_for_each(|channel| channel.give_out(next, clocks, counts, sink))
    }

    /// Writes what only the end of the run tells: the verdicts of its links, and the events of its
    /// score with their times.
    ///
    /// # Errors
    /// When the sink cannot take it.
    pub(crate) fn conclude<S: Sink>(
        &mut self,
        run: &Run,
        events: &[Option<u64>],
        sink: &mut S,
    ) -> Result<(), S::Error> {
        for trace in &run.traces {
            let Some(channel) = self.channels.get_mut(&trace.header.channel) else {
                continue;
            };
            for (index, record) in trace.records.iter().enumerate() {
                let published_ns = net::published_ns(trace, index).unwrap_or(UNAVAILABLE);
                let Some(at_ns) = self.clocks.time_ns(&channel.host, published_ns) else {
                    self.counts.timeless_count += 1;
                    continue;
                };
                channel.topics.write_decision(at_ns, record, sink)?;
            }
        }
        let Some(summary) = &run.summary else {
            return Ok(());
        };
        for (index, event) in summary.score_events.events.iter().enumerate() {
            let Some(at_ns) = events.get(index).copied().flatten() else {
                self.counts.timeless_count += 1;
                continue;
            };
            if let Some(line) = topics::event_line(event, at_ns) {
                self.events
                    .write(sink, Stamp::new(at_ns, index as u64), &line)?;
            }
        }
        Ok(())
    }

    /// Messages that should be there and are not, by channel. `is_silent` says that all records of
    /// the run have come, so that what is not there will not come.
    pub(crate) fn missed(&self, feed: &Feed, is_silent: bool) -> BTreeMap<String, u64> {
        let of = |name: &String, channel: &LiveChannel| {
            let unseen_count = feed.missed_count(name);
            if is_silent && channel.due.count() > 0 {
                channel.outstanding_count
            } else {
                unseen_count
            }
        };
        let all = self
            .channels
            .iter()
            .map(|(name, one)| (name.clone(), of(name, one)));
        all.filter(|(_, count)| *count > 0).collect()
    }

    /// Messages that were published before anybody looked, by channel: of own programs, whose
    /// messages nobody records.
    pub(crate) fn earlier(&self, feed: &Feed) -> BTreeMap<String, u64> {
        let of = |name: &String, channel: &LiveChannel| {
            let counters = feed.counters(name).filter(|_| channel.is_from_memory)?;
            (counters.earlier_count > 0).then(|| (name.clone(), counters.earlier_count))
        };
        self.channels
            .iter()
            .filter_map(|(name, one)| of(name, one))
            .collect()
    }

    /// Stamps that came for messages that had been waited for long enough.
    pub(crate) fn late_count(&self) -> u64 {
        self.channels
            .values()
            .map(|one| one.joining.late_count)
            .sum()
    }

    /// Messages whose stamps were given out after those of a message published later.
    pub(crate) fn unordered_count(&self) -> u64 {
        let channels = self.channels.values();
        channels.map(|one| one.joining.unordered_count).sum()
    }

    /// The names of the messages, a channel each.
    pub(crate) fn messages(&self) -> impl Iterator<Item = &str> {
        self.channels
            .values()
            .filter_map(|one| one.topics.message.as_deref())
    }

    /// By channel: its message, and whether it is typed.
    pub(crate) fn channel_words(&self) -> Words {
        ChannelTopics::words(self.channels.values().map(|one| &one.topics))
    }

    /// Nothing more has come for now: draws the scene as far as it is known.
    ///
    /// # Errors
    /// When the sink cannot take it.
    pub(crate) fn draw<S: Sink>(&mut self, sink: &mut S) -> Result<(), S::Error> {
        self.scene
            .as_mut()
            .map_or(Ok(()), |scene| scene.settle(sink))
    }

    /// False while something is being made that the scene waits for.
    pub(crate) fn is_scene_ready(&mut self) -> bool {
        self.scene.as_mut().is_none_or(LiveScene::is_ready)
    }

    /// Nothing more will come: draws the rest of the scene; what it lacks.
    ///
    /// # Errors
    /// When the sink cannot take it.
    pub(crate) fn finish_scene<S: Sink>(&mut self, sink: &mut S) -> Result<Vec<String>, S::Error> {
        let Some(scene) = &mut self.scene else {
            return Ok(Vec::new());
        };
        scene.finish(sink)?;
        Ok(scene.problems())
    }

    /// An order to an emulated link.
    ///
    /// # Errors
    /// When the sink cannot take it.
    fn condition<S: Sink>(
        &mut self,
        name: &str,
        record: &LinkConditionRecord,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        let host = self.conditions.host_of(name);
        let at_ns = host.and_then(|host| self.clocks.time_ns(host, record.from_ns));
        let Some(at_ns) = at_ns else {
            self.counts.timeless_count += 1;
            return Ok(());
        };
        self.conditions.write(name, at_ns, record, sink)
    }
}

impl LiveChannel {
    fn of(feed: &Feed, channel: &WatchedChannel, topics: ChannelTopics) -> Self {
        let one = &channel.description;
        let mut announced = feed.run().channels.iter();
        let announced = announced.find(|announced| announced.name == one.name);
        Self {
            topics,
            host: one.from_host.clone().unwrap_or_default(),
            receiving_host: one.to_host.clone().unwrap_or_default(),
            joining: Joining::new(announced.map_or(&[], |one| &one.noted)),
            written: Seen::default(),
            due: Seen::default(),
            outstanding_count: 0,
            is_from_memory: matches!(
                channel.source,
                Some(Source::SharedMemory {
                    is_forwarded: false,
                    ..
                })
            ),
        }
    }

    /// Writes the stamps of the messages that `next` gives out.
    fn give_out<S: Sink>(
        &mut self,
        next: &mut dyn FnMut(&mut Joining) -> Option<MessageLatency>,
        clocks: &mut LiveClocks,
        counts: &mut Counts,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        while let Some(mut one) = next(&mut self.joining) {
            let Some(at_ns) = clocks.latency_ns(&self.host, &one) else {
                counts.timeless_count += 1;
                continue;
            };
            if clocks.compares() || self.host == self.receiving_host {
                one.compare_ends();
            }
            self.topics.write_latency(at_ns, &one, sink)?;
        }
        Ok(())
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
