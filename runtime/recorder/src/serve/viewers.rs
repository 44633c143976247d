//! Everybody who looks on, over the Foxglove WebSocket: topics are offered and fed here. A viewer
//! that is too slow loses its oldest messages; nobody waits for it. What a topic says is decided in
//! [`crate::view`].

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use foxglove::websocket::{ChannelView, Client, ParameterHandler, ServerListener};
use foxglove::{
    ChannelBuilder, Context, FoxgloveError, PartialMetadata, RawChannel, SinkId, WebSocketServer,
    WebSocketServerHandle,
};
use serde_json::{Value, json};
use tokio::runtime::Handle;

use super::gate::{Gate, hidden_address};
use crate::net::MessageLatency;
use crate::run_topics::{ChannelTopics, Wanted};
use crate::schema::Schema;
use crate::sink::Sink;
use crate::topics::Names;
use crate::view::facts::RunFacts;
use crate::writer::Stamp;

/// Messages that the library keeps for one viewer at most; the door takes them at once, and bounds what waits
/// by bytes.
const WAITING_MAX: usize = 512;

/// How long a viewer may take to hear that it is over.
const CLOSED_WITHIN: Duration = Duration::from_secs(1);

/// Topics of JSON, all of them offered from the beginning.
pub(crate) const LIVE_TOPICS: [&str; 6] = [
    "/live/run",
    "/live/map",
    "/live/channels",
    "/live/losses",
    "/live/fleet",
    "/live/arms",
];

/// The only one whose last message is not sent to each new subscriber.
const LOSSES: &str = "/live/losses";

/// New subscribers of live topics; however often one subscribes, it is there once.
#[derive(Debug, Clone, Default)]
struct Newcomers(Arc<Mutex<BTreeSet<(SinkId, &'static str)>>>);

impl Newcomers {
    fn set(&self) -> MutexGuard<'_, BTreeSet<(SinkId, &'static str)>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ServerListener for Newcomers {
    fn on_subscribe(&self, client: Client, channel: ChannelView<'_>) {
        let topic = LIVE_TOPICS.iter().find(|topic| **topic == channel.topic());
        if let (Some(sink), Some(topic)) = (client.sink_id(), topic) {
            self.set().insert((sink, topic));
        }
    }
}

/// A topic of JSON.
struct Live {
    channel: Arc<RawChannel>,
    last: Option<Vec<u8>>,
    number: u64,
}

/// Topics of the run's channels as the socket has them, by number.
struct Offered {
    context: Arc<Context>,
    topics: Vec<Arc<RawChannel>>,
}

impl Sink for Offered {
    type Error = FoxgloveError;

    fn add_topic(
        &mut self,
        topic: &str,
        schema: &Schema,
        _metadata: &BTreeMap<String, String>,
    ) -> Result<u16, FoxgloveError> {
        let number = u16::try_from(self.topics.len());
        let full = |_| FoxgloveError::ValueError("too many topics".to_owned());
        let number = number.map_err(full)?;
        let schema = foxglove::Schema::new(&schema.name, "protobuf", schema.data.clone());
        let channel = ChannelBuilder::new(topic)
            .schema(schema)
            .message_encoding("protobuf")
            .context(&self.context)
            .build_raw()?;
        self.topics.push(channel);
        Ok(number)
    }

    fn wants(&self, topic: u16) -> bool {
        self.topics[usize::from(topic)].has_sinks()
    }

    fn write(&mut self, topic: u16, at: Stamp, data: &[u8]) -> Result<(), FoxgloveError> {
        let stamp = PartialMetadata::with_log_time(at.log_ns);
        self.topics[usize::from(topic)].log_with_meta(data, stamp);
        Ok(())
    }
}

/// All viewers.
pub(crate) struct Viewers {
    /// The socket, to tell viewers of changed parameters.
    pub(crate) server: WebSocketServerHandle,
    /// Where the library listens, to nobody but the door.
    pub(crate) gate: Gate,
    live: BTreeMap<&'static str, Live>,
    channels: Vec<ChannelTopics>,
    offered: Offered,
    newcomers: Newcomers,
}

impl Viewers {
    /// Offers the live topics behind a gate, to nobody yet; links are changed through
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
        let newcomers = Newcomers::default();
        let ip = hidden_address().map_err(FoxgloveError::Bind)?;
        let server = WebSocketServer::new()
            .name(concat!("hil-recorder ", env!("CARGO_PKG_VERSION")))
            .bind(ip.to_string(), 0)
            .message_backlog_size(WAITING_MAX)
            .listener(Arc::new(newcomers.clone()))
            .parameter_handler(parameters)
            .tokio_runtime(runtime)
            .context(&context);
        let server = runtime.block_on(server.start())?;
        let address = SocketAddr::new(ip.into(), server.port());
        Ok(Self {
            gate: Gate::shut(address).map_err(FoxgloveError::Bind)?,
            server,
            live,
            channels: Vec::new(),
            offered: Offered {
                context,
                topics: Vec::new(),
            },
            newcomers,
        })
    }

    /// Offers the topics of a run's channels in place of those before; what is kept as bytes, and
    /// why.
    ///
    /// # Errors
    /// When a topic cannot be offered.
    pub(crate) fn offer(&mut self, facts: &RunFacts) -> Result<Vec<String>, FoxgloveError> {
        for live in self.live.values_mut() {
            live.last = None;
        }
        for channel in self.offered.topics.drain(..) {
            channel.close();
        }
        self.channels.clear();
        let mut names = Names::default();
        for topic in LIVE_TOPICS {
            names.claim(topic.to_owned());
        }
        let wanted = facts.channels.iter().map(|one| Wanted {
            name: &one.name,
            described: one.described.as_ref(),
            ..Wanted::default()
        });
        let mut words = Vec::new();
        for mut channel in ChannelTopics::of_all(wanted.collect(), &mut names) {
            channel.own.declare(&mut self.offered)?;
            channel.declare_views(&mut self.offered)?;
            // Of others the manifest says that they are recorded only.
            let described = facts.channel(&channel.name).map(|(_, one)| &one.described);
            if described.is_some_and(|one| one.as_ref().is_none_or(|one| one.to_host.is_some())) {
                channel.latency.declare(&mut self.offered)?;
            }
            if let Some(why) = channel.untyped() {
                words.push(format!("{}: shown as bytes: {why}", channel.name));
            }
            self.channels.push(channel);
        }
        Ok(words)
    }

    /// A message of the channel with this place, published at `at_ns` on the axis of a recording.
    pub(crate) fn message(&mut self, place: usize, at_ns: i64, payload: &[u8]) {
        if let Some(topics) = self.channels.get_mut(place) {
            let at = Stamp::new(u64::try_from(at_ns).unwrap_or(0), 0);
            // What is declared takes everything.
            let _is_shown = topics.write_message(at, payload, &mut self.offered).is_ok();
        }
    }

    /// Stamps of a message of the channel with this place.
    pub(crate) fn latency(&mut self, place: usize, at_ns: i64, stamps: &MessageLatency) {
        let topics = self.channels.get_mut(place);
        if let Some(topics) = topics.filter(|topics| topics.latency.is_declared()) {
            let at_ns = u64::try_from(at_ns).unwrap_or(0);
            // What is declared takes everything.
            let shown = topics.write_latency(at_ns, stamps, &mut self.offered);
            let _is_shown = shown.is_ok();
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
        live.last = (topic != LOSSES).then_some(text);
    }

    /// Tells those who came since the last call what the others know already.
    pub(crate) fn welcome(&mut self, at_ns: i64) {
        let stamp = PartialMetadata::with_log_time(u64::try_from(at_ns).unwrap_or(0));
        let newcomers = core::mem::take(&mut *self.newcomers.set());
        for (sink, topic) in newcomers {
            let live = self.live.get(topic);
            if let Some((live, last)) = live.and_then(|live| Some((live, live.last.as_ref()?))) {
                live.channel.log_with_meta_to_sink(last, stamp, Some(sink));
            }
        }
    }

    /// Sends all of them the closing frame.
    pub(crate) fn end(self, runtime: &Handle) {
        let stopped = self.server.stop();
        // One that does not read would keep it for ever.
        let closed = async { tokio::time::timeout(CLOSED_WITHIN, stopped.wait()).await };
        let _is_closed = runtime.block_on(closed).is_ok();
    }
}
