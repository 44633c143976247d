//! A finished run's folder as one recording. Everything is put on one axis of time, the instants of
//! publication; what each topic looks like is decided in the modules it calls.

use std::path::Path;
use std::thread;
use std::time::Duration;

use hil_core::message::Envelope;
use hil_link::condition::LinkConditionRecord;
use hil_rundir::record::{RecordFile, RecordKind};

use crate::clocks::Clocks;
use crate::facts;
use crate::failure::Failure;
use crate::net::{self, MessageLatency};
use crate::record::Recorded;
use crate::run::Run;
use crate::run_topics::{Plan, RunTopics, Wanted, What};
use crate::scene::Scene;
use crate::writer::{Recording, WriteError};

/// How often it looks whether something that takes its time is done.
const PAUSE: Duration = Duration::from_millis(20);

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
) -> Result<Recorded, Failure> {
    let mut stopped = None;
    let mut run = Run::read(from, &mut |share, path| {
        stopped = look(Some(share), &format!("reading {path}"));
        stopped.is_none()
    })?;
    if let Some(signal) = stopped {
        return Err(interrupted(signal));
    }
    run.count_missing();
    let clocks = Clocks::of(&run);
    let mut recording = Recording::create(to)?;
    let recorded = run.channels();
    let wanted = recorded.iter().map(|name| Wanted {
        name,
        described: run.described(name),
        recorded_bytes: run
            .files
            .iter()
            .filter(|file| is_of(file, name, RecordKind::Message))
            .map(|file| (file.header.record_bytes as usize).saturating_sub(size_of::<Envelope>()))
            .collect(),
    });
    let mut topics = RunTopics::new(wanted.collect(), run.topology(), has_scene);
    let latencies = declare(&run, &clocks, &mut topics, &mut recording)?;
    // Something may still be made that the pictures need.
    while !topics.scene.as_mut().is_none_or(Scene::is_ready) {
        if let Some(signal) = look(None, "making the fleet's ground") {
            return Err(interrupted(signal));
        }
        thread::sleep(PAUSE);
    }
    let plan = plan(&run, &clocks, &topics, &latencies);
    for (count, item) in plan.items.iter().enumerate() {
        if count % 4096 == 0 {
            let all = plan.items.len();
            let share = count as f64 / all.max(1) as f64;
            if let Some(signal) = look(Some(share), &format!("writing {count} of {all}")) {
                return Err(interrupted(signal));
            }
        }
        topics.write(&run, &latencies, *item, &mut recording)?;
    }
    run.gaps.misfit_count = topics.counts.misfit_count;
    run.gaps.timeless_count = plan.timeless_count;
    if plan.timeless_count > 0 {
        run.gaps.words.push(format!(
            "{} messages and records have no time on the recording's clock; left out",
            plan.timeless_count
        ));
    }
    if let Some(scene) = &mut topics.scene {
        scene.finish(&mut recording)?;
        run.gaps.words.extend(scene.problems());
    }
    facts::write(&mut recording, &run, &clocks, &topics)?;
    let mut words = run.gaps.words.clone();
    words.extend(topics.channels.iter().filter_map(|channel| {
        let why = channel.untyped()?;
        Some(format!("{}: kept as bytes: {why}", channel.name))
    }));
    Ok(Recorded {
        paths: vec![to.to_owned()],
        topic_count: recording.topic_count(),
        written_count: recording.finish()?,
        message_count: topics.counts.message_count,
        words,
        has_gaps: run.gaps.is_any(),
        ..Recorded::default()
    })
}

fn interrupted(signal: &str) -> Failure {
    Failure::interrupted(format!("ended by {signal}; no file was written"))
}

/// Declares every topic that there is something for; the joined stamps of each channel.
fn declare(
    run: &Run,
    clocks: &Clocks,
    topics: &mut RunTopics,
    recording: &mut Recording,
) -> Result<Vec<Vec<MessageLatency>>, WriteError> {
    for channel in &mut topics.channels {
        let mut files = run.files.iter();
        if files.any(|file| is_of(file, &channel.name, RecordKind::Message)) {
            channel.own.declare(recording)?;
        }
    }
    let mut latencies = Vec::new();
    for channel in &mut topics.channels {
        if channel.own.is_declared() {
            channel.declare_views(recording)?;
        }
        let mut traces = run.traces.iter();
        let trace = traces.find(|trace| trace.header.channel == channel.name);
        let files = run.files.iter();
        let files = files.filter(|file| file.header.channel == channel.name);
        let joined = net::latencies(&files, trace, clocks.has_one_clock == Some(true));
        if !joined.is_empty() {
            channel.latency.declare(recording)?;
        }
        latencies.push(joined.into_values().collect());
        if trace.is_some() {
            channel.link.declare(recording)?;
        }
    }
    let told = run.summary.as_ref().map(|one| &one.score_events.events);
    if told.is_some_and(|events| !events.is_empty()) {
        topics.events.declare(recording)?;
    }
    for file in &run.files {
        topics.conditions.declare(&file.header.channel, recording)?;
    }
    if let Some(scene) = &mut topics.scene {
        let mut recorded = topics.channels.iter();
        let recorded = recorded.by_ref().filter(|one| one.own.is_declared());
        scene.declare(recorded.filter_map(|one| one.message.as_deref()), recording)?;
    }
    // Descriptions of topics in a chunk of their own: damage to a message cannot take them along.
    recording.flush()?;
    Ok(latencies)
}

/// Everything there is to write, in order of time.
fn plan(run: &Run, clocks: &Clocks, topics: &RunTopics, latencies: &[Vec<MessageLatency>]) -> Plan {
    let mut plan = Plan::default();
    for (place, channel) in topics.channels.iter().enumerate() {
        let time_ns = |ns| clocks.time_ns(&channel.host, ns);
        for (file, records) in run.files.iter().enumerate() {
            if is_of(records, &channel.name, RecordKind::Message) {
                for index in 0..records.record_count() {
                    let message = records.message(index);
                    let at_ns = message.and_then(|(envelope, _)| time_ns(envelope.published_ns));
                    plan.put(at_ns, place, What::Message { file, index });
                }
            }
        }
        for (index, one) in latencies[place].iter().enumerate() {
            plan.put(
                one.published_ns.and_then(time_ns),
                place,
                What::Latency { index },
            );
        }
    }
    for (file, records) in run.files.iter().enumerate() {
        if records.header.kind != RecordKind::LinkCondition {
            continue;
        }
        let host = topics.conditions.host_of(&records.header.channel);
        for (index, one) in records.records::<LinkConditionRecord>().enumerate() {
            let at_ns = host.and_then(|host| clocks.time_ns(host, one.from_ns));
            plan.put(
                at_ns,
                topics.channels.len(),
                What::Condition { file, index },
            );
        }
    }
    plan.put_end(run, &topics.channels, &mut |host, ns| {
        clocks.time_ns(host, ns)
    });
    plan.items.sort_unstable();
    plan
}

fn is_of(file: &RecordFile, channel: &str, kind: RecordKind) -> bool {
    file.header.kind == kind && file.header.channel == channel
}
