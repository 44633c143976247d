//! What becomes of a run's events while it goes: topics and their messages, the same as
//! [`crate::convert`] makes of the folder afterwards. Where they go is the [`Sink`]'s.

mod beside;

use std::collections::BTreeMap;
use std::time::Instant;

use hil_models::message::Envelope;
use hil_models::record::UNAVAILABLE;
use hil_runtime::watch::{Event, Feed, Origin, Record, Seen, Source, WatchedChannel};
use prost::Message as _;

use crate::conditions::Conditions;
use crate::encode::Encoder;
use crate::joining::Joining;
use crate::live_clocks::LiveClocks;
use crate::net::{self, LinkDecision, MessageLatency};
use crate::run::Run;
use crate::scene::waiting::LiveScene;
use crate::scene::{Heard, Scene, Scenery};
use crate::schema;
use crate::sink::{Sink, Topic};
use crate::topics::{self, Names, View, topic_of};
use crate::writer::Stamp;

/// One channel and what is made of it.
#[derive(Debug)]
struct ChannelTopics {
    /// Host of its producer; empty when the manifest does not tell.
    host: String,
    receiving_host: String,
    message: String,
    own: Topic,
    encoder: Encoder,
    /// Why its messages are kept as bytes, if they are.
    untyped: Option<String>,
    views: Vec<(View, Topic)>,
    latency: Topic,
    link: Topic,
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
    channels: BTreeMap<String, ChannelTopics>,
    names: Names,
    events: Topic,
    conditions: Conditions,
    scene: Option<LiveScene>,
    clocks: LiveClocks,
    buffer: Vec<u8>,
    counts: Counts,
}

/// What was made, and what could not be.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Counts {
    /// Messages of the run's own channels.
    pub(crate) message_count: u64,
    /// Messages whose size is not that of their channel, left out.
    pub(crate) misfit_count: u64,
    /// Messages and records without a time on the recording's clock, left out.
    pub(crate) timeless_count: u64,
    /// When the newest message was published, on the recording's clock.
    pub(crate) newest_ns: u64,
}

impl LiveTopics {
    /// Names the topics of a run; they appear with their first message. Without a scene, what it takes
    /// to draw one is not worked out.
    pub(crate) fn of(feed: &Feed, scenery: Scenery) -> Self {
        let mut names = Names::default();
        let mut channels: BTreeMap<String, ChannelTopics> = BTreeMap::new();
        // Before the derived names, so that the run's own keep theirs.
        let own: Vec<(&WatchedChannel, String)> = feed
            .channels()
            .map(|channel| (channel, names.claim(topic_of(&channel.description.name))))
            .collect();
        for (channel, topic) in own {
            let name = channel.description.name.clone();
            channels.insert(name, ChannelTopics::of(feed, channel, topic, &mut names));
        }
        let events = names.claim("/score/events".to_owned());
        let topology = &feed.manifest().topology;
        let conditions = Conditions::of(topology, &mut names);
        let case = &topology["case"];
        let scene = scenery.is_drawn().then(|| {
            let scene = Scene::new(case["name"].as_str(), &case["parameters"], &mut names);
            LiveScene::new(scene)
        });
        Self {
            channels,
            names,
            events: Topic::new(events, topics::event_schema(), &[]),
            conditions,
            scene,
            clocks: LiveClocks::of(feed),
            buffer: Vec::new(),
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
            Event::Message {
                channel,
                origin,
                envelope,
                payload,
            } => {
                let name = channel.description.name.as_str();
                self.message(name, *origin, (envelope, payload), sink)
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

    fn message<S: Sink>(
        &mut self,
        name: &str,
        origin: Origin,
        (envelope, payload): (&Envelope, &[u8]),
        sink: &mut S,
    ) -> Result<(), S::Error> {
        let Some(channel) = self.channels.get_mut(name) else {
            return Ok(());
        };
        let Some(at_ns) = self.clocks.message_ns(&channel.host, envelope) else {
            self.counts.timeless_count += 1;
            return Ok(());
        };
        self.buffer.clear();
        if !channel.encoder.encode(payload, &mut self.buffer) {
            self.counts.misfit_count += 1;
            return Ok(());
        }
        let at = Stamp::new(at_ns, envelope.sequence);
        channel.own.write(sink, at, &self.buffer)?;
        channel.note_written(envelope);
        self.counts.message_count += 1;
        if origin != Origin::OtherHost {
            self.counts.newest_ns = self.counts.newest_ns.max(at_ns);
        }
        for (view, topic) in &mut channel.views {
            if let Some(shown) = view.show(name, at_ns, payload) {
                topic.write(sink, at, &shown)?;
            }
        }
        // What another host sends at the end was long ago: the pictures of that time are drawn.
        let is_news = origin != Origin::OtherHost;
        if let Some(scene) = self.scene.as_mut().filter(|_| is_news) {
            let channel = (name, channel.message.as_str());
            scene.take(&Heard::of(channel, at_ns, (envelope, payload)), sink)?;
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
        self.give_out_of(name, &mut Joining::next, sink)
    }

    fn latency<S: Sink>(
        &mut self,
        name: &str,
        mut one: MessageLatency,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        let Some(channel) = self.channels.get_mut(name) else {
            return Ok(());
        };
        let Some(at_ns) = self.clocks.latency_ns(&channel.host, &one) else {
            self.counts.timeless_count += 1;
            return Ok(());
        };
        if self.clocks.compares() || channel.host == channel.receiving_host {
            let ends = one.taken_ns.zip(one.published_ns);
            one.delay_ns = ends.and_then(|(taken, published)| taken.checked_sub(published));
        }
        self.buffer.clear();
        one.encode_raw(&mut self.buffer);
        channel
            .latency
            .write(sink, Stamp::new(at_ns, one.sequence), &self.buffer)
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
        let names: Vec<String> = self.channels.keys().cloned().collect();
        for name in names {
            self.give_out_of(&name, next, sink)?;
        }
        Ok(())
    }

    fn give_out_of<S: Sink>(
        &mut self,
        name: &str,
        next: &mut dyn FnMut(&mut Joining) -> Option<MessageLatency>,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        while let Some(one) = self
            .channels
            .get_mut(name)
            .and_then(|one| next(&mut one.joining))
        {
            self.latency(name, one, sink)?;
        }
        Ok(())
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
                self.buffer.clear();
                LinkDecision::of(record).encode_raw(&mut self.buffer);
                let at = Stamp::new(at_ns, record.sequence);
                channel.link.write(sink, at, &self.buffer)?;
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

    /// What was made so far.
    pub(crate) const fn counts(&self) -> Counts {
        self.counts
    }

    /// The clocks of the recording.
    pub(crate) fn clocks(&mut self) -> &mut LiveClocks {
        &mut self.clocks
    }

    /// The names that were not free.
    pub(crate) const fn names(&self) -> &Names {
        &self.names
    }

    /// Messages that should be there and are not, by channel. `is_silent` says that all records of
    /// the run have come, so that what is not there will not come.
    pub(crate) fn missed(&self, feed: &Feed, is_silent: bool) -> BTreeMap<String, u64> {
        let of = |name: &String, channel: &ChannelTopics| {
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
        let of = |name: &String, channel: &ChannelTopics| {
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
        self.channels.values().map(|one| one.message.as_str())
    }

    /// By channel: its message, and whether it is typed.
    pub(crate) fn channel_words(&self) -> BTreeMap<String, String> {
        let describe = |(name, channel): (&String, &ChannelTopics)| {
            let how = match &channel.untyped {
                _ if channel.written.count() == 0 => "no message was recorded".to_owned(),
                None => "typed".to_owned(),
                Some(why) => format!("kept as bytes: {why}"),
            };
            (name.clone(), format!("{}; {how}", channel.message))
        };
        self.channels.iter().map(describe).collect()
    }
}

impl ChannelTopics {
    fn of(feed: &Feed, channel: &WatchedChannel, topic: String, names: &mut Names) -> Self {
        let one = &channel.description;
        let (name, message) = (one.name.as_str(), one.message.as_str());
        let host = one.from_host.clone().unwrap_or_default();
        let mut untyped = None;
        let typed = Encoder::typed(message, &one.fields, one.size_bytes);
        let (encoder, schema) = typed.unwrap_or_else(|fault| {
            untyped = Some(format!("{message}: {fault}"));
            (Encoder::Opaque, schema::opaque())
        });
        let size = one.size_bytes.to_string();
        let metadata = [
            ("channel", name),
            ("message", message),
            ("size_bytes", &size),
            ("clock_host", &host),
        ];
        let own = Topic::new(topic, schema, &metadata);
        let metadata = [("channel", name)];
        let mut derived =
            |wanted: String, schema| Topic::new(names.claim(wanted), schema, &metadata);
        let views = View::of(message, one.size_bytes).iter();
        let views = views.map(|view| {
            let wanted = format!("{}{}", view.prefix(), topic_of(name));
            (*view, derived(wanted, view.schema()))
        });
        let views = views.collect();
        let base = format!("/net{}", topic_of(name));
        let announced = feed.run().channels.iter().find(|one| one.name == name);
        Self {
            own,
            encoder,
            untyped,
            views,
            latency: derived(format!("{base}/latency"), net::latency_schema()),
            link: derived(format!("{base}/link"), net::decision_schema()),
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
            receiving_host: one.to_host.clone().unwrap_or_default(),
            message: message.to_owned(),
            host,
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
