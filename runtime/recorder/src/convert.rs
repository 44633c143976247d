//! A finished run's folder as one recording. Everything is put on one axis of time, the instants of
//! publication; what each topic looks like is decided in the modules it calls.

use std::path::Path;
use std::thread;
use std::time::Duration;

use hil_core::message::Envelope;
use hil_link::condition::LinkConditionRecord;
use hil_rundir::record::{RecordFile, RecordKind};
use hil_trace::Trace;

use crate::channel::{ChannelTopics, Typed, Wanted, typed};
use crate::clocks::Clocks;
use crate::conditions::Conditions;
use crate::facts;
use crate::net::{self, Latencies, MessageId};
use crate::run::{Run, RunError};
use crate::scene::{Heard, Scene};
use crate::sink::Topic;
use crate::topics::{self, Names};
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

/// Something to write, before it is encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum What {
    Message { file: usize, index: usize },
    Latency { message: MessageId },
    Link { trace: usize, index: usize },
    Condition { file: usize, index: usize },
    Event { index: usize },
}

/// Something and its place: by time, then the channel, so that the order is the same each time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Item {
    at_ns: u64,
    channel: usize,
    what: What,
}

/// Converts the run at `from` to the file `to`, with its scene if that is wanted; `look` hears how
/// far it is, in words, and gives the signal that came.
///
/// # Errors
/// When there is no run to read or no file can be written; there is no file then.
pub(crate) fn convert(
    from: &Path,
    to: &Path,
    has_scene: bool,
    look: &mut dyn FnMut(Option<f64>, &str) -> Option<&'static str>,
) -> Result<Converted, ConvertError> {
    let mut stopped = None;
    let mut run = Run::read(from, &mut |share, path| {
        stopped = look(Some(share), &format!("reading {path}"));
        stopped.is_none()
    })?;
    if let Some(signal) = stopped {
        return Err(ConvertError::Interrupted(signal));
    }
    run.count_missing();
    let clocks = Clocks::of(&run);
    let mut conversion = Conversion::begin(to, &run, &clocks, has_scene)?;
    // Something may still be made that the pictures need.
    while !conversion.scene.as_mut().is_none_or(Scene::is_ready) {
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
    let channels = &conversion.channels;
    let recording = &mut conversion.recording;
    facts::write(recording, &run, &clocks, channels, &conversion.names)?;
    let topic_count = recording.topic_count();
    let untyped = channels.iter().filter_map(|channel| {
        let why = channel.untyped()?;
        Some(format!("{}: kept as bytes: {why}", channel.name))
    });
    let mut words = run.gaps.words.clone();
    words.extend(untyped);
    Ok(Converted {
        written_count: conversion.recording.finish()?,
        message_count: conversion.message_count,
        topic_count,
        has_gaps: run.gaps.is_any(),
        words,
    })
}

struct Conversion {
    recording: Recording,
    channels: Vec<ChannelTopics>,
    names: Names,
    events: Topic,
    scene: Option<Scene>,
    conditions: Conditions,
    latencies: Vec<Latencies>,
    message_count: u64,
    timeless_count: u64,
}

impl Conversion {
    /// Opens the file and declares every topic in it.
    fn begin(to: &Path, run: &Run, clocks: &Clocks, has_scene: bool) -> Result<Self, WriteError> {
        let mut recording = Recording::create(to)?;
        let mut names = Names::default();
        let recorded = run.channels();
        let wanted = recorded.iter().map(|name| Wanted {
            name,
            described: run.described(name),
            typed: typed_as_recorded(run, name),
        });
        let mut channels = ChannelTopics::of_all(wanted.collect(), &mut names);
        for channel in &mut channels {
            let mut files = run.files.iter();
            if files.any(|file| is_of(file, &channel.name, RecordKind::Message)) {
                channel.own.declare(&mut recording)?;
            }
        }
        let mut latencies = Vec::new();
        for channel in &mut channels {
            if channel.own.is_declared() {
                channel.declare_views(&mut recording)?;
            }
            let trace = trace_of(run, &channel.name).map(|(_, trace)| trace);
            let files = run.files.iter();
            let files = files.filter(|file| file.header.channel == channel.name);
            let joined = net::latencies(&files, trace, clocks.has_one_clock == Some(true));
            if !joined.is_empty() {
                channel.latency.declare(&mut recording)?;
            }
            latencies.push(joined);
            if trace.is_some() {
                channel.link.declare(&mut recording)?;
            }
        }
        let mut events = topics::event_topic(&mut names);
        let told = run.summary.as_ref().map(|one| &one.score_events.events);
        if told.is_some_and(|events| !events.is_empty()) {
            events.declare(&mut recording)?;
        }
        let mut conditions = Conditions::of(run.topology(), &mut names);
        for file in &run.files {
            conditions.declare(&file.header.channel, &mut recording)?;
        }
        let mut scene = has_scene.then(|| {
            let case = &run.topology()["case"];
            Scene::new(case["name"].as_str(), &case["parameters"], &mut names)
        });
        if let Some(scene) = &mut scene {
            let recorded = channels.iter().filter(|channel| channel.own.is_declared());
            let messages = recorded.filter_map(|channel| channel.message.as_deref());
            scene.declare(messages, &mut recording)?;
        }
        // Descriptions of topics in a chunk of their own: damage to a message cannot take them along.
        recording.flush()?;
        Ok(Self {
            recording,
            channels,
            names,
            events,
            scene,
            conditions,
            latencies,
            message_count: 0,
            timeless_count: 0,
        })
    }

    /// Draws the last of the scene, and says why it lacks its ground, if it does.
    fn finish_scene(&mut self, run: &mut Run) -> Result<(), WriteError> {
        let Some(scene) = &mut self.scene else {
            return Ok(());
        };
        scene.finish(&mut self.recording)?;
        run.gaps.words.extend(scene.problem().map(str::to_owned));
        Ok(())
    }

    /// Everything there is to write, in order of time.
    fn plan(&mut self, run: &Run, clocks: &Clocks) -> Vec<Item> {
        let mut items = Vec::new();
        let mut timeless_count = 0;
        let mut put = |at_ns: Option<u64>, channel, what| match at_ns {
            Some(at_ns) => items.push(Item {
                at_ns,
                channel,
                what,
            }),
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
            for (message, one) in &self.latencies[channel] {
                let at_ns = one.published_ns.and_then(|ns| clocks.time_ns(name, ns));
                put(at_ns, channel, What::Latency { message: *message });
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
            if records.header.kind != RecordKind::LinkCondition {
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

    fn write(&mut self, run: &mut Run, item: Item) -> Result<(), WriteError> {
        let (at_ns, recording) = (item.at_ns, &mut self.recording);
        match item.what {
            What::Message { file, index } => {
                let Some((envelope, payload)) = run.files[file].message(index) else {
                    return Ok(());
                };
                let topics = &mut self.channels[item.channel];
                let at = Stamp::new(at_ns, envelope.sequence);
                if !topics.write_message(at, payload, recording)? {
                    run.gaps.misfit_count += 1;
                    return Ok(());
                }
                self.message_count += 1;
                if let Some((scene, message)) = self.scene.as_mut().zip(topics.message.as_deref()) {
                    let heard = Heard {
                        channel: &topics.name,
                        message,
                        payload,
                        at_ns,
                        published_ns: envelope.published_ns,
                    };
                    scene.take(&heard, recording)?;
                }
            }
            What::Latency { message } => {
                if let Some(stamps) = self.latencies[item.channel].get(&message) {
                    self.channels[item.channel].write_latency(at_ns, stamps, recording)?;
                }
            }
            What::Link { trace, index } => {
                let record = &run.traces[trace].records[index];
                self.channels[item.channel].write_decision(at_ns, record, recording)?;
            }
            What::Condition { file, index } => {
                let file = &run.files[file];
                if let Some(record) = file.record::<LinkConditionRecord>(index) {
                    let channel = &file.header.channel;
                    self.conditions.write(channel, at_ns, &record, recording)?;
                }
            }
            What::Event { index } => {
                let events = run.summary.as_ref().map(|one| &one.score_events.events);
                let event = events.and_then(|events| events.get(index));
                if let Some(line) = event.and_then(|event| topics::event_line(event, at_ns)) {
                    let at = Stamp::new(at_ns, index as u64);
                    self.events.write(recording, at, &line)?;
                }
            }
        }
        Ok(())
    }
}

/// How the messages of a channel are written, if their size in the record files is that of the
/// manifest.
fn typed_as_recorded(run: &Run, channel: &str) -> Typed {
    let described = run.described(channel);
    if let Some(one) = described {
        let mut files = run.files.iter();
        let expected = one.size_bytes.saturating_add(size_of::<Envelope>());
        let other = files.find(|file| {
            is_of(file, channel, RecordKind::Message)
                && file.header.record_bytes as usize != expected
        });
        if let Some(other) = other {
            let (message, size) = (&one.message, one.size_bytes);
            let found = (other.header.record_bytes as usize).saturating_sub(size_of::<Envelope>());
            return Err(format!(
                "{message} has {size} bytes by the manifest, and {found} by its record file"
            ));
        }
    }
    typed(described)
}

fn is_of(file: &RecordFile, channel: &str, kind: RecordKind) -> bool {
    file.header.kind == kind && file.header.channel == channel
}

/// The trace of a channel, and its number among all.
fn trace_of<'a>(run: &'a Run, channel: &str) -> Option<(usize, &'a Trace)> {
    let mut traces = run.traces.iter().enumerate();
    traces.find(|(_, trace)| trace.header.channel == channel)
}
