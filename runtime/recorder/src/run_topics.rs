//! The topics of a whole run: of each channel its messages, what viewers make of them, the stamps of each
//! and the verdicts of its link; of the run its links' orders, its score and its scene. Both a finished run's
//! folder and a run that still goes are written through this; they differ in when each thing is known.

use hil_core::message::Envelope;
use hil_link::condition::LinkConditionRecord;
use hil_rundir::manifest::ChannelDescription;
use hil_trace::TraceRecord;
use prost::Message as _;
use serde_json::Value;

use crate::codec::Codec;
use crate::conditions::Conditions;
use crate::facts::{self, Words};
use crate::net::{self, LinkDecision, MessageLatency};
use crate::run::Run;
use crate::scene::{Heard, Scene};
use crate::schema::Schema;
use crate::sink::{Sink, Topic};
use crate::topics::{self, Names, View, topic_of};
use crate::writer::Stamp;

/// A channel that is to have topics.
#[derive(Debug)]
pub(crate) struct Wanted<'a> {
    /// The channel.
    pub(crate) name: &'a str,
    /// What the manifest says of it.
    pub(crate) described: Option<&'a ChannelDescription>,
    /// Sizes of its messages by its record files.
    pub(crate) recorded_bytes: Vec<usize>,
}

impl Wanted<'_> {
    /// How its messages are written field by field, with their schema; or why they cannot be.
    fn typed(&self) -> Result<(Codec, Schema), String> {
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
    /// Host of its producer; empty when the manifest does not tell.
    pub(crate) host: String,
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
    pub(crate) link: Topic,
    buffer: Vec<u8>,
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
        let (codec, schema) = wanted.typed().unwrap_or_else(|why| {
            untyped = Some(why);
            Codec::opaque(0)
        });
        let message = described.map_or("", |one| &one.message);
        let size = described.map_or(String::new(), |one| one.size_bytes.to_string());
        let host = described.and_then(|one| one.from_host.as_deref());
        let host = host.unwrap_or_default();
        let metadata = [
            ("channel", name),
            ("message", message),
            ("size_bytes", &size),
            ("clock_host", host),
        ];
        let own = Topic::new(own, schema, &metadata);
        let base = topic_of(name);
        let mut derived =
            |wanted: String, schema| Topic::new(names.claim(wanted), schema, &[("channel", name)]);
        let views = described.map_or(&[][..], |one| View::of(message, one.size_bytes));
        let views = views.iter().map(|view| {
            let wanted = format!("{}{base}", view.prefix());
            (*view, derived(wanted, view.schema()))
        });
        Self {
            name: name.to_owned(),
            host: host.to_owned(),
            message: described.map(|one| one.message.clone()),
            own,
            codec,
            untyped,
            views: views.collect(),
            latency: derived(format!("/net{base}/latency"), MessageLatency::schema()),
            link: derived(format!("/net{base}/link"), LinkDecision::schema()),
            buffer: Vec::new(),
        }
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
            self.buffer.clear();
            if !self.codec.encode(payload, &mut self.buffer) {
                return Ok(false);
            }
            self.own.write(sink, at, &self.buffer)?;
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
        self.buffer.clear();
        stamps.encode_raw(&mut self.buffer);
        let at = Stamp::new(at_ns, stamps.sequence);
        self.latency.write(sink, at, &self.buffer)
    }

    /// Writes what the link did to a message.
    ///
    /// # Errors
    /// When the sink cannot take it.
    pub(crate) fn write_decision<S: Sink>(
        &mut self,
        at_ns: u64,
        record: &TraceRecord,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        self.buffer.clear();
        LinkDecision::of(record).encode_raw(&mut self.buffer);
        let at = Stamp::new(at_ns, record.sequence);
        self.link.write(sink, at, &self.buffer)
    }

    /// Why its messages are kept as bytes, if there are any that are.
    pub(crate) fn untyped(&self) -> Option<&str> {
        self.untyped.as_deref().filter(|_| self.own.is_declared())
    }
}

/// The topics of a run.
#[derive(Debug)]
pub(crate) struct RunTopics {
    /// Those of each channel.
    pub(crate) channels: Vec<ChannelTopics>,
    /// Names that were not free among them.
    pub(crate) names: Names,
    /// Events of the score.
    pub(crate) events: Topic,
    /// Orders to emulated links.
    pub(crate) conditions: Conditions,
    /// What viewers draw, if that is wanted.
    pub(crate) scene: Option<Scene>,
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

/// When a message enters the scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Drawn {
    /// At once: messages come in order of time.
    InOrder,
    /// Once what was published before it has come.
    Later,
    /// Never: the pictures of its time are drawn.
    Never,
}

/// Something of a run's folder that is to be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum What {
    /// A message of a record file.
    Message { file: usize, index: usize },
    /// The stamps of a message.
    Latency { index: usize },
    /// The verdict of a link.
    Link { trace: usize, index: usize },
    /// An order to a link.
    Condition { file: usize, index: usize },
    /// An event of the score.
    Event { index: usize },
}

/// Something and its place: by time, then the channel, so that the order is the same each time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Item {
    at_ns: u64,
    channel: usize,
    what: What,
}

/// What of a run's folder is to be written.
#[derive(Debug, Default)]
pub(crate) struct Plan {
    /// Each with its time.
    pub(crate) items: Vec<Item>,
    /// What has no time on the recording's clock.
    pub(crate) timeless_count: u64,
}

impl Plan {
    /// Adds something of a channel, or what is of none with the number behind the last.
    pub(crate) fn put(&mut self, at_ns: Option<u64>, channel: usize, what: What) {
        match at_ns {
            Some(at_ns) => self.items.push(Item {
                at_ns,
                channel,
                what,
            }),
            None => self.timeless_count += 1,
        }
    }

    /// Adds what only the end of a run tells: the verdicts of its links and the events of its score.
    /// `time_ns` gives the time of an instant on the clock of a host.
    pub(crate) fn put_end(
        &mut self,
        run: &Run,
        channels: &[ChannelTopics],
        time_ns: &mut dyn FnMut(&str, i64) -> Option<u64>,
    ) {
        for (trace, whole) in run.traces.iter().enumerate() {
            let name = &whole.header.channel;
            let Some(channel) = channels.iter().position(|one| one.name == *name) else {
                continue;
            };
            for index in 0..whole.records.len() {
                let published_ns = net::published_ns(whole, index);
                let at_ns = published_ns.and_then(|ns| time_ns(&channels[channel].host, ns));
                self.put(at_ns, channel, What::Link { trace, index });
            }
        }
        for (index, at_ns) in facts::event_times(run, time_ns).into_iter().enumerate() {
            self.put(at_ns, channels.len(), What::Event { index });
        }
    }
}

impl RunTopics {
    /// Names the topics of a run with this resolved topology. Without a scene, what it takes to draw one
    /// is not worked out.
    pub(crate) fn new(wanted: Vec<Wanted<'_>>, topology: &Value, has_scene: bool) -> Self {
        let mut names = Names::default();
        let case = &topology["case"];
        Self {
            channels: ChannelTopics::of_all(wanted, &mut names),
            events: topics::event_topic(&mut names),
            conditions: Conditions::of(topology, &mut names),
            scene: has_scene
                .then(|| Scene::new(case["name"].as_str(), &case["parameters"], &mut names)),
            names,
            counts: Counts::default(),
        }
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

    /// Writes a message of the channel with this place; false when its size is not that of the channel,
    /// and it was left out.
    ///
    /// # Errors
    /// When the sink cannot take it.
    pub(crate) fn message<S: Sink>(
        &mut self,
        place: usize,
        at_ns: u64,
        envelope: &Envelope,
        payload: &[u8],
        drawn: Drawn,
        sink: &mut S,
    ) -> Result<bool, S::Error> {
        let channel = &mut self.channels[place];
        if !channel.write_message(Stamp::new(at_ns, envelope.sequence), payload, sink)? {
            self.counts.misfit_count += 1;
            return Ok(false);
        }
        self.counts.message_count += 1;
        if let Some((scene, message)) = self.scene.as_mut().zip(channel.message.as_deref()) {
            let heard = Heard {
                channel: &channel.name,
                message,
                payload,
                at_ns,
                published_ns: envelope.published_ns,
            };
            match drawn {
                Drawn::InOrder => scene.take(&heard, sink)?,
                Drawn::Later => scene.hold(&heard, sink)?,
                Drawn::Never => {}
            }
        }
        Ok(true)
    }

    /// Writes what was planned of `run`, whose stamps were joined to `latencies`, by channel.
    ///
    /// # Errors
    /// When the sink cannot take it.
    pub(crate) fn write<S: Sink>(
        &mut self,
        run: &Run,
        latencies: &[Vec<MessageLatency>],
        item: Item,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        let Item { at_ns, channel, .. } = item;
        match item.what {
            What::Message { file, index } => {
                if let Some((envelope, payload)) = run.files[file].message(index) {
                    self.message(channel, at_ns, &envelope, payload, Drawn::InOrder, sink)?;
                }
            }
            What::Latency { index } => {
                let stamps = &latencies[channel][index];
                self.channels[channel].write_latency(at_ns, stamps, sink)?;
            }
            What::Link { trace, index } => {
                let record = &run.traces[trace].records[index];
                self.channels[channel].write_decision(at_ns, record, sink)?;
            }
            What::Condition { file, index } => {
                let file = &run.files[file];
                if let Some(record) = file.record::<LinkConditionRecord>(index) {
                    let channel = &file.header.channel;
                    self.conditions.write(channel, at_ns, &record, sink)?;
                }
            }
            What::Event { index } => {
                let events = run.summary.as_ref().map(|one| &one.score_events.events);
                let event = events.and_then(|events| events.get(index));
                if let Some(line) = event.and_then(|event| topics::event_line(event, at_ns)) {
                    let at = Stamp::new(at_ns, index as u64);
                    self.events.write(sink, at, &line)?;
                }
            }
        }
        Ok(())
    }
}
