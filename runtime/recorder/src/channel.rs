//! One channel of a run as topics: its messages, what viewers make of them, the stamps of each, and
//! the verdicts of its link. When each was is decided by whoever reads the run.

use hil_rundir::manifest::ChannelDescription;
use hil_trace::TraceRecord;
use prost::Message as _;

use crate::codec::Codec;
use crate::net::{LinkDecision, MessageLatency};
use crate::schema::Schema;
use crate::sink::{Sink, Topic};
use crate::topics::{Names, View, topic_of};
use crate::writer::Stamp;

/// How the messages of a channel are written field by field, with their schema; or why they cannot
/// be.
pub(crate) type Typed = Result<(Codec, Schema), String>;

/// By what the manifest says of a channel.
pub(crate) fn typed(described: Option<&ChannelDescription>) -> Typed {
    let one = described.ok_or("the manifest does not tell of this channel")?;
    Codec::typed(&one.message, &one.fields, one.size_bytes)
        .map_err(|fault| format!("{}: {fault}", one.message))
}

/// A channel that is to have topics.
#[derive(Debug)]
pub(crate) struct Wanted<'a> {
    /// The channel.
    pub(crate) name: &'a str,
    /// What the manifest says of it.
    pub(crate) described: Option<&'a ChannelDescription>,
    /// How its messages are written.
    pub(crate) typed: Typed,
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
        both.map(|(one, own)| Self::of(one, own, names)).collect()
    }

    fn of(wanted: Wanted<'_>, own: String, names: &mut Names) -> Self {
        let (name, described) = (wanted.name, wanted.described);
        let mut untyped = None;
        let (codec, schema) = wanted.typed.unwrap_or_else(|why| {
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
