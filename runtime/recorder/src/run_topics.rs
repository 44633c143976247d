//! The topics of a whole run: of each channel its messages, what viewers make of them, the stamps of each
//! and the verdicts of its link; of the run its links' orders, its score and its scene. A run that goes
//! comes as the events of its feed, a finished run's folder as steps in order of time; both go through the
//! same methods.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use hil_core::message::Envelope;
use hil_core::record::{IngressRecord, UNAVAILABLE};
use hil_link::condition::LinkConditionRecord;
use hil_rundir::live_run::Stage;
use hil_rundir::manifest::ChannelDescription;
use hil_rundir::record::RecordKind;
use hil_trace::TraceRecord;
use hil_watch::{Event, Feed, Origin, Record, Seen};
use serde_json::Value;

use crate::clocks::Clocks;
use crate::codec::Codec;
use crate::conditions::Conditions;
use crate::facts::{self, Words};
use crate::joining::Joining;
use crate::net::{self, LinkDecision, MessageLatency};
use crate::run::Run;
use crate::scene::{Heard, Scene};
use crate::sink::{Sink, Topic};
use crate::timeline::{self, Step, What};
use crate::topics::{self, Names, View, topic_of};
use crate::view::Told;
use crate::writer::Stamp;

/// A channel that is to have topics.
#[derive(Debug, Default)]
pub(crate) struct Wanted<'a> {
    /// The channel.
    pub(crate) name: &'a str,
    /// What the manifest says of it.
    pub(crate) described: Option<&'a ChannelDescription>,
    /// Sizes of its messages by its record files.
    pub(crate) recorded_bytes: Vec<usize>,
    /// What processes here note of its messages while the run goes.
    pub(crate) noted: &'a [Stage],
    /// A program of the user's writes it, which keeps no records.
    pub(crate) is_unrecorded: bool,
}

impl Wanted<'_> {
    /// How its messages are written field by field; or why they cannot be.
    fn typed(&self) -> Result<Codec, String> {
        let described = self
            .described
            .ok_or("the manifest does not tell of this channel")?;
        let (message, size) = (&described.message, described.size_bytes);
        let mut recorded_bytes = self.recorded_bytes.iter();
        if let Some(found) = recorded_bytes.find(|found| **found != size) {
            return Err(format!(
                "{message} has {size} bytes by the manifest, and {found} by its record file"
            ));
        }
        Codec::typed(message, &described.fields, size)
            .map_err(|fault| format!("{message}: {fault}"))
    }
}

/// A channel and its topics, each of which appears with its first message unless it is declared.
#[derive(Debug)]
pub(crate) struct ChannelTopics {
    /// The channel.
    pub(crate) name: String,
    /// Hosts of its producer and its consumer, where the manifest tells.
    hosts: [Option<String>; 2],
    /// Its message, where the manifest names it.
    pub(crate) message: Option<String>,
    /// Its messages.
    pub(crate) own: Topic,
    codec: Codec,
    untyped: Option<String>,
    views: Vec<(View, Topic)>,
    /// The stamps of each message.
    pub(crate) latency: Topic,
    /// The verdicts of its link.
    link: Topic,
    joining: Joining,
    written: Seen,
    /// Messages that were to come, by what the processes noted.
    due: Seen,
    /// Of these, how many have not come.
    outstanding_count: u64,
    is_unrecorded: bool,
}

impl ChannelTopics {
    /// The topics of all channels of a run.
    pub(crate) fn of_all(wanted: Vec<Wanted<'_>>, names: &mut Names) -> Vec<Self> {
        // Before the derived names, so that the run's own keep theirs.
        let own = wanted.iter().map(|one| names.claim(topic_of(one.name)));
        let own: Vec<String> = own.collect();
        let both = wanted.into_iter().zip(own);
        both.map(|(one, own)| Self::of(&one, own, names)).collect()
    }

    fn of(wanted: &Wanted<'_>, own: String, names: &mut Names) -> Self {
        let (name, described) = (wanted.name, wanted.described);
        let mut untyped = None;
        let codec = wanted.typed().unwrap_or_else(|why| {
            untyped = Some(why);
            Codec::opaque(0)
        });
        let message = described.map_or("", |one| &one.message);
        let size = described.map_or(String::new(), |one| one.size_bytes.to_string());
        let hosts = described.map(|one| [one.from_host.clone(), one.to_host.clone()]);
        let hosts = hosts.unwrap_or_default();
        let metadata = [
            ("channel", name),
            ("message", message),
            ("size_bytes", &size),
            ("clock_host", hosts[0].as_deref().unwrap_or_default()),
        ];
        let own = Topic::new(own, codec.schema.clone(), &metadata);
        let base = topic_of(name);
        let mut derived =
            |wanted: String, schema| Topic::new(names.claim(wanted), schema, &[("channel", name)]);
        let views = described.map_or(&[][..], |one| View::of(message, one.size_bytes));
        let views = views.iter().map(|view| {
            let wanted = format!("{}{base}", view.prefix);
            (*view, derived(wanted, (view.schema)()))
        });
        Self {
            name: name.to_owned(),
            hosts,
            message: described.map(|one| one.message.clone()),
            own,
            codec,
            untyped,
            views: views.collect(),
            latency: derived(format!("/net{base}/latency"), MessageLatency::schema()),
            link: derived(format!("/net{base}/link"), LinkDecision::schema()),
            joining: Joining::new(wanted.noted),
            written: Seen::default(),
            due: Seen::default(),
            outstanding_count: 0,
            is_unrecorded: wanted.is_unrecorded,
        }
    }

    /// Host of its producer; empty when the manifest does not tell.
    fn host(&self) -> &str {
        self.hosts[0].as_deref().unwrap_or_default()
    }

    /// Lets `sink` hear now of the topics that are made of the messages.
    ///
    /// # Errors
    /// When it has no room for them.
    pub(crate) fn declare_views<S: Sink>(&mut self, sink: &mut S) -> Result<(), S::Error> {
        for (_, topic) in &mut self.views {
            topic.declare(sink)?;
        }
        Ok(())
    }

    /// Writes a message and what viewers make of it; false when its size is not that of the channel,
    /// and it was left out.
    ///
    /// # Errors
    /// When the sink cannot take it.
    pub(crate) fn write_message<S: Sink>(
        &mut self,
        at: Stamp,
        payload: &[u8],
        sink: &mut S,
    ) -> Result<bool, S::Error> {
        if self.own.is_wanted(sink) {
            let encode = |buffer: &mut Vec<u8>| self.codec.encode(payload, buffer);
            if !self.own.write_with(sink, at, encode)? {
                return Ok(false);
            }
        }
        for (view, topic) in &mut self.views {
            if topic.is_wanted(sink)
                && let Some(shown) = view.show(&self.name, at.log_ns, payload)
            {
                topic.write(sink, at, &shown)?;
            }
        }
        Ok(true)
    }

    /// Writes the stamps of a message.
    ///
    /// # Errors
    /// When the sink cannot take them.
    pub(crate) fn write_latency<S: Sink>(
        &mut self,
        at_ns: u64,
        stamps: &MessageLatency,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        if !self.latency.is_wanted(sink) {
            return Ok(());
        }
        let at = Stamp::new(at_ns, stamps.sequence);
        self.latency.put(sink, at, stamps)
    }

    /// Why its messages are kept as bytes, if there are any that are.
    pub(crate) fn untyped(&self) -> Option<&str> {
        self.untyped.as_deref().filter(|_| self.own.is_declared())
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

/// The topics of a run.
#[derive(Debug)]
pub(crate) struct RunTopics {
    /// Those of each channel.
    pub(crate) channels: Vec<ChannelTopics>,
    /// Their places, by name.
    places: BTreeMap<String, usize>,
    /// Names that were not free among them.
    pub(crate) names: Names,
    /// Events of the score.
    events: Topic,
    /// Orders to emulated links.
    conditions: Conditions,
    /// What viewers draw, if that is wanted.
    pub(crate) scene: Option<Scene>,
    /// The clocks of the recording.
    pub(crate) clocks: Clocks,
    /// What was written so far.
    pub(crate) counts: Counts,
}

/// What was written, and what could not be.
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

impl Counts {
    /// The time of something, which is counted when there is none.
    const fn timed(&mut self, at_ns: Option<u64>) -> Option<u64> {
        self.timeless_count += at_ns.is_none() as u64;
        at_ns
    }
}

impl RunTopics {
    /// Names the topics of a run with this resolved topology. Without a scene, what it takes to draw one
    /// is not worked out.
    fn new(wanted: Vec<Wanted<'_>>, topology: &Value, clocks: Clocks, has_scene: bool) -> Self {
        let mut names = Names::default();
        let case = &topology["case"];
        let channels = ChannelTopics::of_all(wanted, &mut names);
        let places = channels.iter().map(|one| one.name.clone());
        Self {
            places: places.zip(0..).collect(),
            channels,
            events: topics::event_topic(&mut names),
            conditions: Conditions::of(topology, &mut names),
            scene: has_scene
                .then(|| Scene::new(case["name"].as_str(), &case["parameters"], &mut names)),
            names,
            clocks,
            counts: Counts::default(),
        }
    }

    /// The topics of a run that goes; they appear with their first message.
    pub(crate) fn of_feed(feed: &Feed, has_scene: bool) -> Self {
        let wanted = feed.channels().map(|channel| {
            let name = &channel.description.name;
            let mut announced = feed.run().channels.iter();
            let announced = announced.find(|announced| announced.name == *name);
            Wanted {
                name,
                described: Some(&channel.description),
                recorded_bytes: Vec::new(),
                noted: announced.map_or(&[], |one| &one.noted),
                is_unrecorded: channel.is_unrecorded(),
            }
        });
        let (wanted, topology) = (wanted.collect(), &feed.manifest().topology);
        Self::new(wanted, topology, Clocks::of_feed(feed), has_scene)
    }

    /// The topics of a run's folder.
    pub(crate) fn of_run(run: &Run, has_scene: bool) -> Self {
        let names = run.channels();
        let wanted = names.iter().map(|name| Wanted {
            name,
            described: run.described(name),
            recorded_bytes: run
                .files_of(name, RecordKind::Message)
                .map(|(_, file)| file.header.record_bytes as usize)
                .map(|bytes| bytes.saturating_sub(size_of::<Envelope>()))
                .collect(),
            ..Wanted::default()
        });
        Self::new(
            wanted.collect(),
            run.topology(),
            Clocks::of_run(run),
            has_scene,
        )
    }

    /// The names of the messages, a channel each.
    pub(crate) fn messages(&self) -> impl Iterator<Item = &str> {
        let channels = self.channels.iter();
        channels.filter_map(|one| one.message.as_deref())
    }

    /// Of each channel its message, and whether it is typed.
    pub(crate) fn channel_words(&self) -> Words {
        let describe = |channel: &ChannelTopics| {
            let message = channel.message.as_deref().unwrap_or("unknown message");
            let how = match channel.untyped() {
                _ if !channel.own.is_declared() => "no message was recorded".to_owned(),
                None => "typed".to_owned(),
                Some(why) => format!("kept as bytes: {why}"),
            };
            (channel.name.clone(), format!("{message}; {how}"))
        };
        self.channels.iter().map(describe).collect()
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
                // Of what another host sends at the end the pictures are drawn already.
                let is_drawn = *origin != Origin::OtherHost;
                self.message(place, envelope, payload, is_drawn, sink)
            }
            Event::Record {
                channel,
                record: Record::LinkCondition(record),
                ..
            } => self.condition(channel, record, sink),
            Event::Record {
                channel,
                is_of_this_host,
                record,
                ..
            } => match self.places.get(*channel).copied() {
                Some(place) => self.record(place, record, *is_of_this_host, sink),
                None => Ok(()),
            },
            Event::Silent => self.flush_joins(sink),
            Event::Problem(_) | Event::Ended { .. } => Ok(()),
        }
    }

    fn message<S: Sink>(
        &mut self,
        place: usize,
        envelope: &Envelope,
        payload: &[u8],
        is_drawn: bool,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        let channel = &mut self.channels[place];
        let at_ns = self.clocks.message_ns(channel.host(), envelope);
        let Some(at_ns) = self.counts.timed(at_ns) else {
            return Ok(());
        };
        if !channel.write_message(Stamp::new(at_ns, envelope.sequence), payload, sink)? {
            self.counts.misfit_count += 1;
            return Ok(());
        }
        self.counts.message_count += 1;
        channel.note_written(envelope);
        let (name, message) = (&channel.name, channel.message.as_deref());
        if let Some((scene, message)) = self.scene.as_mut().zip(message)
            && let Some(told) = Told::of(name, message, payload).filter(|_| is_drawn)
        {
            let heard = Heard {
                told,
                at_ns,
                published_ns: envelope.published_ns,
            };
            scene.hold(&heard, sink)?;
        }
        Ok(())
    }

    fn record<S: Sink>(
        &mut self,
        place: usize,
        record: &Record,
        is_of_this_host: bool,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        let channel = &mut self.channels[place];
        let hosts = channel.hosts.each_ref().map(Option::as_deref);
        self.clocks.note(hosts, record);
        channel.note_due(record, is_of_this_host);
        channel
            .joining
            .take(record, is_of_this_host, Instant::now());
        self.give_out(place, &mut Joining::next, sink)
    }

    fn condition<S: Sink>(
        &mut self,
        name: &str,
        record: &LinkConditionRecord,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        let host = self.conditions.host_of(name);
        let at_ns = host.and_then(|host| self.clocks.time_ns(host, record.from_ns));
        match self.counts.timed(at_ns) {
            Some(at_ns) => self.conditions.write(name, at_ns, record, sink),
            None => Ok(()),
        }
    }

    /// Writes what `decision` says, after the stamps of the message that it is about.
    fn decision<S: Sink>(
        &mut self,
        place: usize,
        at_ns: Option<u64>,
        decision: &TraceRecord,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        let sequence = decision.sequence;
        if let Some(one) = self.channels[place].joining.waiting_with(sequence) {
            one.note_decision(decision);
        }
        self.give_out(place, &mut Joining::earliest, sink)?;
        let Some(at_ns) = self.counts.timed(at_ns) else {
            return Ok(());
        };
        let link = &mut self.channels[place].link;
        link.put(
            sink,
            Stamp::new(at_ns, sequence),
            &LinkDecision::of(decision),
        )
    }

    /// Nothing more is to be read by `now`: gives out the stamps of messages that were held for long
    /// enough, and draws the scene as far as it is known.
    ///
    /// # Errors
    /// When the sink cannot take them.
    pub(crate) fn settle<S: Sink>(&mut self, now: Instant, sink: &mut S) -> Result<(), S::Error> {
        if let Some(scene) = &mut self.scene {
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
        let channel = &mut self.channels[place];
        while let Some(mut one) = next(&mut channel.joining) {
            let at_ns = self.clocks.latency_ns(channel.host(), &one);
            let Some(at_ns) = self.counts.timed(at_ns) else {
                continue;
            };
            let [from, to] = &channel.hosts;
            if self.clocks.compares() || (from.is_some() && from == to) {
                one.compare_ends();
            }
            channel.write_latency(at_ns, &one, sink)?;
        }
        Ok(())
    }

    /// All that is in the folder of `run`, in order of time.
    pub(crate) fn steps(&mut self, run: &Run) -> Vec<Step> {
        let Self {
            channels,
            clocks,
            places,
            conditions,
            ..
        } = self;
        let place = |name: &str| places.get(name).copied();
        let mut steps = timeline::noted_steps(run, place, &mut |channel, noted| {
            clocks.time_ns(channels[channel].host(), noted.published_ns)
        });
        for (file, records) in run.files.iter().enumerate() {
            let host = conditions.host_of(&records.header.channel);
            let orders = records.records::<LinkConditionRecord>().enumerate();
            let is_of_link = records.header.kind == RecordKind::LinkCondition;
            steps.extend(orders.filter(|_| is_of_link).map(|(index, one)| Step {
                at_ns: host.and_then(|host| clocks.time_ns(host, one.from_ns)),
                channel: channels.len(),
                what: What::Condition { file, index },
            }));
        }
        steps.extend(self.end_steps(run));
        steps.sort_unstable();
        steps
    }

    /// What only the end of a run tells: the verdicts of its links and the events of its score.
    fn end_steps(&mut self, run: &Run) -> Vec<Step> {
        let mut steps = Vec::new();
        for (trace, whole) in run.traces.iter().enumerate() {
            let Some(channel) = self.places.get(&whole.header.channel).copied() else {
                continue;
            };
            let host = self.channels[channel].host();
            steps.extend((0..whole.records.len()).map(|index| Step {
                at_ns: net::published_ns(whole, index).and_then(|ns| self.clocks.time_ns(host, ns)),
                channel,
                what: What::Decision { trace, index },
            }));
        }
        let times = facts::event_times(run, &mut |host, ns| self.clocks.time_ns(host, ns));
        steps.extend(times.into_iter().enumerate().map(|(index, at_ns)| Step {
            at_ns,
            channel: self.channels.len(),
            what: What::Event { index },
        }));
        steps
    }

    /// Takes what the folder of `run` has of one channel and one moment, and writes all of it.
    ///
    /// # Errors
    /// When the sink cannot take it.
    pub(crate) fn moment<S: Sink>(
        &mut self,
        run: &Run,
        steps: &[Step],
        sink: &mut S,
    ) -> Result<(), S::Error> {
        for step in steps {
            self.step(run, step, sink)?;
        }
        match steps
            .first()
            .filter(|one| one.channel < self.channels.len())
        {
            Some(step) => self.give_out(step.channel, &mut Joining::earliest, sink),
            None => Ok(()),
        }
    }

    fn step<S: Sink>(&mut self, run: &Run, step: &Step, sink: &mut S) -> Result<(), S::Error> {
        let Step { at_ns, channel, .. } = *step;
        match step.what {
            What::Message { file, index } => {
                if let Some((envelope, payload)) = run.files[file].message(index) {
                    self.message(channel, &envelope, payload, true, sink)?;
                    // They come in order of time.
                    if let Some(scene) = &mut self.scene {
                        scene.draw_held(sink)?;
                    }
                }
            }
            What::Record { file, index } => {
                if let Some(record) = net::record(&run.files[file], index) {
                    let joining = &mut self.channels[channel].joining;
                    joining.take(&record, true, Instant::now());
                }
            }
            What::LateStamp { file, index } => {
                let with_late = run.files[file].record::<IngressRecord>(index);
                if let Some(late) = with_late.and_then(|one| one.follow_up())
                    && let Some(one) = self.channels[channel].joining.waiting_with(late.sequence)
                {
                    one.note_late(late);
                }
            }
            What::Decision { trace, index } => {
                let decision = &run.traces[trace].records[index];
                self.decision(channel, at_ns, decision, sink)?;
            }
            What::Condition { file, index } => {
                let file = &run.files[file];
                if let Some(record) = file.record(index) {
                    self.condition(&file.header.channel, &record, sink)?;
                }
            }
            What::Event { index } => {
                let events = run.summary.as_ref().map(|one| &one.score_events.events);
                if let Some(at_ns) = self.counts.timed(at_ns)
                    && let Some(event) = events.and_then(|events| events.get(index))
                    && let Some(line) = topics::event_line(event, at_ns)
                {
                    self.events
                        .put(sink, Stamp::new(at_ns, index as u64), &line)?;
                }
            }
        }
        Ok(())
    }

    /// Lets `sink` hear now of every topic that the folder of `run` has something for, `steps` of it.
    ///
    /// # Errors
    /// When it has no room for them.
    pub(crate) fn declare<S: Sink>(
        &mut self,
        run: &Run,
        steps: &[Step],
        sink: &mut S,
    ) -> Result<(), S::Error> {
        for channel in &mut self.channels {
            let mut files = run.files_of(&channel.name, RecordKind::Message);
            if files.next().is_some() {
                channel.own.declare(sink)?;
            }
        }
        let stamped = steps.iter().filter_map(|step| match step.what {
            What::Record { .. } => Some(step.channel),
            _ => None,
        });
        let stamped: BTreeSet<usize> = stamped.collect();
        for (place, channel) in self.channels.iter_mut().enumerate() {
            if channel.own.is_declared() {
                channel.declare_views(sink)?;
            }
            if stamped.contains(&place) {
                channel.latency.declare(sink)?;
            }
            let mut traces = run.traces.iter();
            if traces.any(|trace| trace.header.channel == channel.name) {
                channel.link.declare(sink)?;
            }
        }
        let told = run.summary.as_ref().map(|one| &one.score_events.events);
        if told.is_some_and(|events| !events.is_empty()) {
            self.events.declare(sink)?;
        }
        for file in &run.files {
            self.conditions.declare(&file.header.channel, sink)?;
        }
        if let Some(scene) = &mut self.scene {
            let recorded = self.channels.iter().filter(|one| one.own.is_declared());
            scene.declare(recorded.filter_map(|one| one.message.as_deref()), sink)?;
        }
        Ok(())
    }

    /// Writes what only the end of the run tells: the verdicts of its links, and the events of its
    /// score.
    ///
    /// # Errors
    /// When the sink cannot take it.
    pub(crate) fn conclude<S: Sink>(&mut self, run: &Run, sink: &mut S) -> Result<(), S::Error> {
        let steps = self.end_steps(run);
        steps.iter().try_for_each(|step| self.step(run, step, sink))
    }

    /// Messages that should be there and are not, by channel. `is_silent` says that all records of
    /// the run have come, so that what is not there will not come.
    pub(crate) fn missed(&self, feed: &Feed, is_silent: bool) -> BTreeMap<String, u64> {
        let counts = self.channels.iter().map(|channel| {
            let is_known = is_silent && channel.due.count() > 0;
            let unseen_count = feed.missed_count(&channel.name);
            let count = if is_known {
                channel.outstanding_count
            } else {
                unseen_count
            };
            (channel.name.clone(), count)
        });
        counts.filter(|(_, count)| *count > 0).collect()
    }

    /// Messages that were published before anybody looked, by channel: of own programs, whose
    /// messages nobody records.
    pub(crate) fn earlier(&self, feed: &Feed) -> BTreeMap<String, u64> {
        let unrecorded = self.channels.iter().filter(|channel| channel.is_unrecorded);
        let counts = unrecorded.filter_map(|channel| {
            let count = feed.counters(&channel.name)?.earlier_count;
            Some((channel.name.clone(), count))
        });
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
}
