//! A finished run's folder as one recording. Everything is put on one axis of time, the instants of
//! publication; what each topic looks like is decided in the modules it calls.

mod beside;

use std::path::Path;
use std::thread;
use std::time::Duration;

use hil_models::link::condition::LinkConditionRecord;
use hil_models::message::Envelope;
use hil_models::trace::Trace;
use hil_runtime::rundir::record::{RecordFile, RecordKind};
use prost::Message as _;

use crate::clocks::Clocks;
use crate::conditions::Conditions;
use crate::encode::Encoder;
use crate::facts;
use crate::net::{self, Latencies, LinkDecision, MessageLatency};
use crate::run::{Run, RunError};
use crate::scene::{Heard, Scene, Scenery};
use crate::schema::{self, Schema};
use crate::topics::{self, Names, View, topic_of};
use crate::writer::{Recording, Stamp, WriteError};

/// How often it looks whether something that takes its time is done.
const PAUSE: Duration = Duration::from_millis(20);

/// How a conversion went wrong.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ConvertError {
    /// Nothing to convert.
    #[error(transparent)]
    Run(#[from] RunError),
    /// Nowhere to put it.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// A signal came.
    #[error("ended by {0}; no file was written")]
    Interrupted(&'static str),
}

/// What a conversion came to.
#[derive(Debug)]
pub(crate) struct Converted {
    /// Messages in the file, of all topics.
    pub(crate) written_count: u64,
    /// Messages of the run's own channels among them.
    pub(crate) message_count: u64,
    /// Topics.
    pub(crate) topic_count: usize,
    /// What of the run is not in it.
    pub(crate) has_gaps: bool,
    /// The same in words, and what else a reader must know.
    pub(crate) words: Vec<String>,
}

/// One channel of the run, and its topics.
pub(crate) struct ChannelTopics {
    /// The channel.
    pub(crate) name: String,
    /// Its message, where the manifest names it.
    pub(crate) message: Option<String>,
    /// Its topic and how it is written; `None` when no message of it was recorded.
    pub(crate) own: Option<(u16, Encoder)>,
    /// Why its messages are kept as bytes, if they are.
    pub(crate) untyped: Option<String>,
    views: Vec<(View, u16)>,
    latency: Option<u16>,
    link: Option<u16>,
}

/// Something to write, before it is encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum What {
    Message { file: usize, index: usize },
    Latency { key: (u32, u64) },
    Link { trace: usize, index: usize },
    Condition { file: usize, index: usize },
    Event { index: usize },
}

/// Its place: time, then the channel, so that the order is the same each time.
type Item = (u64, usize, What);

/// Converts the run at `from` to the file `to`, with its scene if that is wanted; `look` hears how
/// far it is, in words, and gives the signal that came.
///
/// # Errors
/// When there is no run to read or no file can be written; there is no file then.
pub(crate) fn convert(
    from: &Path,
    to: &Path,
    scenery: Scenery,
    look: &mut dyn FnMut(Option<f64>, &str) -> Option<&'static str>,
) -> Result<Converted, ConvertError> {
    let mut stopped = None;
    let mut run = Run::read(from, &mut |(share, path)| {
        stopped = look(Some(share), &format!("reading {path}"));
        stopped.is_none()
    })?;
    if let Some(signal) = stopped {
        return Err(ConvertError::Interrupted(signal));
    }
    run.count_missing();
    let clocks = Clocks::of(&run);
    let mut conversion = Conversion::begin(to, &run, &clocks, scenery)?;
    while !conversion.is_ready() {
        if let Some(signal) = look(None, "making the fleet's ground") {
            return Err(ConvertError::Interrupted(signal));
        }
        thread::sleep(PAUSE);
    }
    let items = conversion.plan(&run, &clocks);
    run.gaps.timeless_count = conversion.timeless_count;
    if conversion.timeless_count > 0 {
        run.gaps.words.push(format!(
            "{} messages and records have no time on the recording's clock; left out",
            conversion.timeless_count
        ));
    }
    for (count, item) in items.iter().enumerate() {
        if count % 4096 == 0 {
            let (done, all) = (count as u64, items.len() as u64);
            let words = format!("writing {done} of {all}");
            let share = done as f64 / all.max(1) as f64;
            if let Some(signal) = look(Some(share), &words) {
                return Err(ConvertError::Interrupted(signal));
            }
        }
        conversion.write(&mut run, *item)?;
    }
    conversion.finish_scene(&mut run)?;
    let Conversion {
        mut recording,
        channels,
        message_count,
        topic_count,
        names,
        ..
    } = conversion;
    facts::write(&mut recording, &run, &clocks, &channels, &names)?;
    let written_count = recording.finish()?;
    let untyped = channels.iter().filter_map(|channel| {
        let why = channel.untyped.as_ref()?;
        Some(format!("{}: kept as bytes: {why}", channel.name))
    });
    let mut words = run.gaps.words.clone();
    words.extend(untyped);
    Ok(Converted {
        written_count,
        message_count,
        topic_count,
        has_gaps: run.gaps.is_any(),
        words,
    })
}

struct Conversion {
    recording: Recording,
    channels: Vec<ChannelTopics>,
    names: Names,
    events: Option<u16>,
    scene: Option<Scene>,
    conditions: Conditions,
    latencies: Vec<Latencies>,
    topic_count: usize,
    message_count: u64,
    timeless_count: u64,
    buffer: Vec<u8>,
}

impl Conversion {
    /// Opens the file and declares every topic in it.
    fn begin(to: &Path, run: &Run, clocks: &Clocks, scenery: Scenery) -> Result<Self, WriteError> {
        let mut conversion = Self {
            recording: Recording::create(to)?,
            channels: Vec::new(),
            names: Names::default(),
            events: None,
            scene: None,
            conditions: Conditions::default(),
            latencies: Vec::new(),
            topic_count: 0,
            message_count: 0,
            timeless_count: 0,
            buffer: Vec::new(),
        };
        // Before the run's own names, so that these keep theirs.
        let names = run.channels();
        for name in &names {
            let channel = conversion.own_topic(run, name)?;
            conversion.channels.push(channel);
        }
        for index in 0..names.len() {
            conversion.derived_topics(run, clocks, index)?;
        }
        let events = run.summary.as_ref().map(|one| &one.score_events.events);
        if events.is_some_and(|events| !events.is_empty()) {
            let schema = topics::event_schema();
            conversion.events = Some(conversion.topic("/score/events".to_owned(), &schema, &[])?);
        }
        conversion.begin_conditions(run)?;
        if scenery.is_drawn() {
            conversion.begin_scene(run)?;
        }
        // Descriptions of topics in a chunk of their own: damage to a message cannot take them along.
        conversion.recording.flush()?;
        Ok(conversion)
    }

    fn topic(
        &mut self,
        wanted: String,
        schema: &Schema,
        metadata: &[(&str, &str)],
    ) -> Result<u16, WriteError> {
        let topic = self.names.claim(wanted);
        let pairs = metadata.iter();
        let pairs = pairs.map(|(key, value)| ((*key).to_owned(), (*value).to_owned()));
        self.topic_count += 1;
        self.recording.add_topic(&topic, schema, &pairs.collect())
    }

    fn own_topic(&mut self, run: &Run, name: &str) -> Result<ChannelTopics, WriteError> {
        let described = run.described(name);
        let message = described.map(|one| one.message.clone());
        let mut files = run.files.iter();
        let is_recorded = files.any(|file| is_of(file, name, RecordKind::Message));
        let mut channel = ChannelTopics {
            name: name.to_owned(),
            message,
            own: None,
            untyped: None,
            views: Vec::new(),
            latency: None,
            link: None,
        };
        if !is_recorded {
            return Ok(channel);
        }
        let typed = typed_encoder(run, name);
        let (encoder, schema) = typed.unwrap_or_else(|why| {
            channel.untyped = Some(why);
            (Encoder::Opaque, schema::opaque())
        });
        let message = channel.message.clone().unwrap_or_default();
        let size = described.map_or(String::new(), |one| one.size_bytes.to_string());
        let metadata = [
            ("channel", name),
            ("message", &message),
            ("size_bytes", &size),
            (
                "clock_host",
                described
                    .and_then(|one| one.from_host.as_deref())
                    .unwrap_or_default(),
            ),
        ];
        let topic = self.topic(topic_of(name), &schema, &metadata)?;
        channel.own = Some((topic, encoder));
        Ok(channel)
    }

    /// The topics that are made of a channel's messages and records.
    fn derived_topics(
        &mut self,
        run: &Run,
        clocks: &Clocks,
        index: usize,
    ) -> Result<(), WriteError> {
        let name = self.channels[index].name.clone();
        let metadata = [("channel", name.as_str())];
        let described = run
            .described(&name)
            .filter(|_| self.channels[index].own.is_some());
        if let Some(one) = described {
            for view in View::of(&one.message, one.size_bytes) {
                let wanted = format!("{}{}", view.prefix(), topic_of(&name));
                let topic = self.topic(wanted, &view.schema(), &metadata)?;
                self.channels[index].views.push((*view, topic));
            }
        }
        let trace = trace_of(run, &name).map(|(_, trace)| trace);
        let files = run.files.iter();
        let files = files.filter(|file| file.header.channel == name);
        let compares = clocks.has_one_clock == Some(true);
        let latencies = net::latencies(&files, trace, compares);
        let base = format!("/net{}", topic_of(&name));
        if !latencies.is_empty() {
            let wanted = format!("{base}/latency");
            let topic = self.topic(wanted, &net::latency_schema(), &metadata)?;
            self.channels[index].latency = Some(topic);
        }
        self.latencies.push(latencies);
        if trace.is_some() {
            let topic = self.topic(format!("{base}/link"), &net::decision_schema(), &metadata)?;
            self.channels[index].link = Some(topic);
        }
        Ok(())
    }

    /// Everything there is to write, in order of time.
    fn plan(&mut self, run: &Run, clocks: &Clocks) -> Vec<Item> {
        let mut items = Vec::new();
        let mut timeless_count = 0;
        let mut put = |at_ns: Option<u64>, channel, what| match at_ns {
            Some(at_ns) => items.push((at_ns, channel, what)),
            None => timeless_count += 1,
        };
        for (channel, topics) in self.channels.iter().enumerate() {
            let name = topics.name.as_str();
            for (file, records) in run.files.iter().enumerate() {
                if !is_of(records, name, RecordKind::Message) {
                    continue;
                }
                for index in 0..records.record_count() {
                    let envelope = records.message(index).map(|(envelope, _)| envelope);
                    let at_ns = envelope.and_then(|one| clocks.time_ns(name, one.published_ns));
                    put(at_ns, channel, What::Message { file, index });
                }
            }
            for (key, one) in &self.latencies[channel] {
                let at_ns = one.published_ns.and_then(|ns| clocks.time_ns(name, ns));
                put(at_ns, channel, What::Latency { key: *key });
            }
            if let Some((trace, whole)) = trace_of(run, name) {
                for index in 0..whole.records.len() {
                    let at_ns = net::published_ns(whole, index);
                    let at_ns = at_ns.and_then(|ns| clocks.time_ns(name, ns));
                    put(at_ns, channel, What::Link { trace, index });
                }
            }
        }
        let after_all = self.channels.len();
        for (file, records) in run.files.iter().enumerate() {
            if !is_order_file(records) {
                continue;
            }
            let host = self.conditions.host_of(&records.header.channel);
            for (index, one) in records.records::<LinkConditionRecord>().enumerate() {
                let at_ns = host.and_then(|host| clocks.host_time_ns(host, one.from_ns));
                put(at_ns, after_all, What::Condition { file, index });
            }
        }
        let mut time_ns = |host: &str, at_ns| clocks.host_time_ns(host, at_ns);
        let events = facts::event_times(run, clocks.has_one_clock, &mut time_ns);
        for (index, at_ns) in events.into_iter().enumerate() {
            put(at_ns, after_all, What::Event { index });
        }
        self.timeless_count = timeless_count;
        items.sort_unstable();
        items
    }

    fn write(&mut self, run: &mut Run, (at_ns, channel, what): Item) -> Result<(), WriteError> {
        self.buffer.clear();
        match what {
            What::Message { file, index } => {
                return self.write_message(run, (at_ns, channel), (file, index));
            }
            What::Latency { key } => {
                let one: Option<&MessageLatency> = self.latencies[channel].get(&key);
                if let Some((topic, one)) = self.channels[channel].latency.zip(one) {
                    one.encode_raw(&mut self.buffer);
                    self.recording
                        .write(topic, Stamp::new(at_ns, key.1), &self.buffer)?;
                }
            }
            What::Link { trace, index } => {
                let record = &run.traces[trace].records[index];
                if let Some(topic) = self.channels[channel].link {
                    LinkDecision::of(record).encode_raw(&mut self.buffer);
                    let at = Stamp::new(at_ns, record.sequence);
                    self.recording.write(topic, at, &self.buffer)?;
                }
            }
            What::Condition { file, index } => {
                let file = &run.files[file];
                if let Some(record) = file.record::<LinkConditionRecord>(index) {
                    let one = (at_ns, &record);
                    self.conditions
                        .write(&file.header.channel, one, &mut self.recording)?;
                }
            }
            What::Event { index } => {
                let events = run.summary.as_ref().map(|one| &one.score_events.events);
                let event = events.and_then(|events| events.get(index));
                let line = event.and_then(|event| topics::event_line(event, at_ns));
                if let Some((topic, line)) = self.events.zip(line) {
                    let at = Stamp::new(at_ns, index as u64);
                    self.recording.write(topic, at, &line)?;
                }
            }
        }
        Ok(())
    }

    fn write_message(
        &mut self,
        run: &mut Run,
        (at_ns, channel): (u64, usize),
        (file, index): (usize, usize),
    ) -> Result<(), WriteError> {
        let topics = &self.channels[channel];
        let message = run.files[file].message(index);
        let Some(((topic, encoder), (envelope, payload))) = topics.own.as_ref().zip(message) else {
            return Ok(());
        };
        let at = Stamp::new(at_ns, envelope.sequence);
        if !encoder.encode(payload, &mut self.buffer) {
            run.gaps.misfit_count += 1;
            return Ok(());
        }
        self.recording.write(*topic, at, &self.buffer)?;
        self.message_count += 1;
        for (view, topic) in &topics.views {
            if let Some(shown) = view.show(&topics.name, at_ns, payload) {
                self.recording.write(*topic, at, &shown)?;
            }
        }
        let Some((scene, message)) = self.scene.as_mut().zip(topics.message.as_deref()) else {
            return Ok(());
        };
        let heard = Heard::of((&topics.name, message), at_ns, (&envelope, payload));
        scene.take(&heard, &mut self.recording)
    }
}

/// How the messages of a channel are written field by field, or why they cannot be.
fn typed_encoder(run: &Run, channel: &str) -> Result<(Encoder, Schema), String> {
    let described = run.described(channel);
    let one = described.ok_or("the manifest does not tell of this channel")?;
    let files = run.files.iter();
    let mut files = files.filter(|file| is_of(file, channel, RecordKind::Message));
    let expected = one.size_bytes.saturating_add(size_of::<Envelope>());
    let other = files.find(|file| file.header.record_bytes as usize != expected);
    if let Some(other) = other {
        let (message, size) = (&one.message, one.size_bytes);
        let found = (other.header.record_bytes as usize).saturating_sub(size_of::<Envelope>());
        return Err(format!(
            "{message} has {size} bytes by the manifest, and {found} by its record file"
        ));
    }
    Encoder::typed(&one.message, &one.fields, one.size_bytes)
        .map_err(|fault| format!("{}: {fault}", one.message))
}

fn is_of(file: &RecordFile, channel: &str, kind: RecordKind) -> bool {
    file.header.kind == kind && file.header.channel == channel
}

fn is_order_file(file: &RecordFile) -> bool {
    file.header.kind == RecordKind::LinkCondition
}

/// The trace of a channel, and its number among all.
fn trace_of<'a>(run: &'a Run, channel: &str) -> Option<(usize, &'a Trace)> {
    let mut traces = run.traces.iter().enumerate();
    traces.find(|(_, trace)| trace.header.channel == channel)
}
