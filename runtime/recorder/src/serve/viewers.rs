//! Everybody who looks on, over the Foxglove WebSocket: topics are offered and fed here. A viewer
//! that is too slow loses its oldest messages; nobody waits for it. What a topic says is decided in
//! [`crate::view`].

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use foxglove::websocket::{ChannelView, Client, ParameterHandler, ServerListener};
use foxglove::{
    ChannelBuilder, Context, FoxgloveError, PartialMetadata, RawChannel, SinkId, WebSocketServer,
    WebSocketServerHandle,
};
use prost::Message as _;
use serde_json::{Value, json};
use tokio::runtime::Handle;

use super::front::hidden_address;
use crate::encode::Encoder;
use crate::net::{self, MessageLatency};
use crate::schema::{self, Schema};
use crate::topics::{Names, View, topic_of};
use crate::view::facts::{ChannelFacts, RunFacts};

/// Messages that wait for one viewer at most; then its oldest go.
const WAITING_MAX: usize = 512;

/// How long a viewer may take to hear that it is over.
const GOODBYE_WITHIN: Duration = Duration::from_secs(1);

/// Topics of JSON, all of them offered from the beginning.
pub(crate) const LIVE_TOPICS: [&str; 6] = [
    "/live/run",
    "/live/map",
    "/live/channels",
    "/live/losses",
    "/live/fleet",
    "/live/arms",
];

/// The last of these is sent to each new subscriber.
const KEPT: [&str; 5] = [
    "/live/run",
    "/live/map",
    "/live/channels",
    "/live/fleet",
    "/live/arms",
];

/// Subscriptions, as they happen.
struct Listener {
    tell: Sender<(SinkId, String)>,
}

impl ServerListener for Listener {
    fn on_subscribe(&self, client: Client, channel: ChannelView<'_>) {
        if let Some(sink) = client.sink_id() {
            // The engine may be gone already, at the end.
            let _is_heard = self.tell.send((sink, channel.topic().to_owned())).is_ok();
        }
    }
}

/// A topic of JSON.
struct Live {
    channel: Arc<RawChannel>,
    last: Option<Vec<u8>>,
    number: u64,
}

/// The topics of one of the run's channels.
struct Topics {
    own: Option<(Arc<RawChannel>, Encoder)>,
    views: Vec<(View, Arc<RawChannel>)>,
    latency: Option<Arc<RawChannel>>,
}

/// All viewers.
pub(crate) struct Viewers {
    context: Arc<Context>,
    server: WebSocketServerHandle,
    /// Where the library listens.
    address: SocketAddr,
    live: BTreeMap<&'static str, Live>,
    channels: Vec<Topics>,
    subscribed: Receiver<(SinkId, String)>,
    buffer: Vec<u8>,
}

impl Viewers {
    /// Offers the live topics at an address that nobody knows; links are changed through
    /// `parameters`.
    ///
    /// # Errors
    /// When no address can be had.
    pub(crate) fn begin(
        runtime: &Handle,
        parameters: Arc<dyn ParameterHandler>,
    ) -> Result<Self, FoxgloveError> {
        let context = Context::new();
        let mut live = BTreeMap::new();
        for topic in LIVE_TOPICS {
            let channel = ChannelBuilder::new(topic)
                .message_encoding("json")
                .context(&context)
                .build_raw()?;
            let one = Live {
                channel,
                last: None,
                number: 0,
            };
            live.insert(topic, one);
        }
        let (tell, subscribed) = channel();
        let ip = hidden_address().map_err(FoxgloveError::Bind)?;
        let server = WebSocketServer::new()
            .name(concat!("hil-recorder ", env!("CARGO_PKG_VERSION")))
            .bind(ip.to_string(), 0)
            .message_backlog_size(WAITING_MAX)
            .listener(Arc::new(Listener { tell }))
            .parameter_handler(parameters)
            .tokio_runtime(runtime)
            .context(&context);
        let server = runtime.block_on(server.start())?;
        Ok(Self {
            context,
            address: SocketAddr::new(ip.into(), server.port()),
            server,
            live,
            channels: Vec::new(),
            subscribed,
            buffer: Vec::new(),
        })
    }

    /// Where the library listens, to nobody but the door.
    pub(crate) const fn address(&self) -> SocketAddr {
        self.address
    }

    /// Viewers that are connected.
    pub(crate) fn count(&self) -> usize {
        self.server.client_count()
    }

    /// Offers the topics of a run's channels in place of those before; what is kept as bytes, and
    /// why.
    ///
    /// # Errors
    /// When a topic cannot be offered.
    pub(crate) fn offer(&mut self, facts: &RunFacts) -> Result<Vec<String>, FoxgloveError> {
        for topics in self.channels.drain(..) {
            let views = topics.views.into_iter().map(|(_, channel)| channel);
            let own = topics.own.map(|(channel, _)| channel);
            for channel in own.into_iter().chain(views).chain(topics.latency) {
                channel.close();
            }
        }
        let mut names = Names::default();
        for topic in LIVE_TOPICS {
            names.claim(topic.to_owned());
        }
        let mut words = Vec::new();
        for facts in &facts.channels {
            let topics = self.topics_of(facts, &mut names, &mut words)?;
            self.channels.push(topics);
        }
        Ok(words)
    }

    fn topics_of(
        &self,
        facts: &ChannelFacts,
        names: &mut Names,
        words: &mut Vec<String>,
    ) -> Result<Topics, FoxgloveError> {
        let message = facts
            .message
            .as_deref()
            .unwrap_or("message of unknown type");
        let typed = Encoder::typed(message, &facts.fields, facts.size_bytes);
        let (encoder, schema) = typed.unwrap_or_else(|fault| {
            words.push(format!(
                "{}: shown as bytes: {message}: {fault}",
                facts.name
            ));
            (Encoder::Opaque, schema::opaque())
        });
        let base = topic_of(&facts.name);
        let channel = self.topic(names.claim(base.clone()), schema)?;
        let mut views = Vec::new();
        for view in View::of(message, facts.size_bytes) {
            let topic = names.claim(format!("{}{base}", view.prefix()));
            views.push((*view, self.topic(topic, view.schema())?));
        }
        let latency = if facts.via == "record" {
            None
        } else {
            let topic = names.claim(format!("/net{base}/latency"));
            Some(self.topic(topic, net::latency_schema())?)
        };
        Ok(Topics {
            own: Some((channel, encoder)),
            views,
            latency,
        })
    }

    fn topic(&self, name: String, schema: Schema) -> Result<Arc<RawChannel>, FoxgloveError> {
        let schema = foxglove::Schema::new(schema.name, "protobuf", schema.data);
        ChannelBuilder::new(name)
            .schema(schema)
            .message_encoding("protobuf")
            .context(&self.context)
            .build_raw()
    }

    /// A message of the channel with this place, published at `at_ns` on the axis of a recording.
    pub(crate) fn message(&mut self, (place, name): (usize, &str), at_ns: i64, payload: &[u8]) {
        let Some(topics) = self.channels.get(place) else {
            return;
        };
        let at_ns = u64::try_from(at_ns).unwrap_or(0);
        let stamp = PartialMetadata::with_log_time(at_ns);
        if let Some((channel, encoder)) = &topics.own
            && channel.has_sinks()
        {
            self.buffer.clear();
            if encoder.encode(payload, &mut self.buffer) {
                channel.log_with_meta(&self.buffer, stamp);
            }
        }
        for (view, channel) in &topics.views {
            if channel.has_sinks()
                && let Some(shown) = view.show(name, at_ns, payload)
            {
                channel.log_with_meta(&shown, stamp);
            }
        }
    }

    /// Stamps of a message of the channel with this place.
    pub(crate) fn latency(&mut self, place: usize, at_ns: i64, stamps: &MessageLatency) {
        let topics = self.channels.get(place);
        let channel = topics.and_then(|topics| topics.latency.as_ref());
        if let Some(channel) = channel.filter(|channel| channel.has_sinks()) {
            let stamp = PartialMetadata::with_log_time(u64::try_from(at_ns).unwrap_or(0));
            channel.log_with_meta(&stamps.encode_to_vec(), stamp);
        }
    }

    /// The present state of a live topic. Each carries a number one higher than that before, so
    /// that a viewer sees what it missed.
    pub(crate) fn live(&mut self, topic: &'static str, at_ns: i64, mut value: Value) {
        let Some(live) = self.live.get_mut(topic) else {
            return;
        };
        value["number"] = json!(live.number);
        live.number += 1;
        let text = value.to_string().into_bytes();
        let stamp = PartialMetadata::with_log_time(u64::try_from(at_ns).unwrap_or(0));
        live.channel.log_with_meta(&text, stamp);
        live.last = KEPT.contains(&topic).then_some(text);
    }

    /// Forgets the last state of a live topic, which is of a run before.
    pub(crate) fn forget(&mut self) {
        for live in self.live.values_mut() {
            live.last = None;
        }
    }

    /// Tells those who came since the last call what the others know already.
    pub(crate) fn welcome(&mut self, at_ns: i64) {
        let stamp = PartialMetadata::with_log_time(u64::try_from(at_ns).unwrap_or(0));
        while let Ok((sink, topic)) = self.subscribed.try_recv() {
            let live = self.live.get(topic.as_str());
            if let Some((live, last)) = live.and_then(|live| Some((live, live.last.as_ref()?))) {
                live.channel.log_with_meta_to_sink(last, stamp, Some(sink));
            }
        }
    }

    /// The socket, to tell viewers of changed parameters.
    pub(crate) const fn server(&self) -> &WebSocketServerHandle {
        &self.server
    }

    /// Says goodbye to all.
    pub(crate) fn end(self, runtime: &Handle) {
        let stopped = self.server.stop();
        // One that does not read would keep it for ever.
        let goodbye = async { tokio::time::timeout(GOODBYE_WITHIN, stopped.wait()).await };
        let _is_polite = runtime.block_on(goodbye).is_ok();
    }
}
