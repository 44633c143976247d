//! What a recording says of its run beside the messages: what ran, on what, by which clocks, and what
//! is missing. Names and keys are in `docs/recordings.md`; all values are text.

use std::collections::BTreeMap;
use std::fmt::Display;

use hil_arm::yumi::description::Urdf;
use hil_platform::plain_file;
use hil_rundir::manifest::Manifest;
use hil_rundir::run_folder::RunFolder;
use serde_json::json;

use crate::clocks::{self, Clocks};
use crate::run::Run;
use crate::run_topics::RunTopics;
use crate::scene::is_of_arms;
use crate::topics::Names;
use crate::writer::{Recording, WriteError};

pub(crate) type Words = BTreeMap<String, String>;

/// When each event of the score was, on the recording's axis; `None` where that is unknown.
/// `time_ns` gives the time of an instant on the clock of a host.
pub(crate) fn event_times(
    run: &Run,
    time_ns: &mut dyn FnMut(&str, i64) -> Option<u64>,
) -> Vec<Option<u64>> {
    let Some(summary) = &run.summary else {
        return Vec::new();
    };
    let starts = &summary.run.starts_ns;
    let is_one = clocks::has_one_clock(run) == Some(true);
    // On one clock an event's time counts from the earliest start, else from that of its own host.
    let earliest = starts.iter().min_by_key(|(_, start_ns)| **start_ns);
    let mut at = |at_s: f64, clock: &str| {
        let own = starts.get_key_value(clock);
        let (host, start_ns) = own.filter(|_| !is_one).or(earliest)?;
        let since_start_ns = (at_s * 1e9).round();
        // Beyond this a number of seconds is none that a run could have.
        if !since_start_ns.is_finite() || since_start_ns.abs() > 1e18 {
            return None;
        }
        #[allow(clippy::cast_possible_truncation, reason = "checked just above")]
        let at_ns = start_ns.checked_add(since_start_ns as i64)?;
        time_ns(host, at_ns)
    };
    let events = summary.score_events.events.iter();
    events.map(|event| at(event.at_s?, &event.clock)).collect()
}

/// Writes all of it.
///
/// # Errors
/// When the file cannot be written.
pub(crate) fn write(
    recording: &mut Recording,
    run: &Run,
    topics: &RunTopics,
) -> Result<(), WriteError> {
    recording.describe("hil.run", run_words(run))?;
    if let Some(manifest) = &run.manifest {
        describe_manifest(recording, manifest)?;
    }
    recording.describe("hil.clocks", clock_words(run, &topics.clocks))?;
    recording.describe("hil.channels", topics.channel_words())?;
    recording.describe("hil.recording", gap_words(run, &topics.names))?;
    attach(recording, &run.folder)?;
    attach_robot(recording, topics.messages())
}

/// A table of words.
pub(crate) fn table(pairs: &[(&str, &dyn Display)]) -> Words {
    let pairs = pairs.iter();
    let pairs = pairs.map(|(key, value)| ((*key).to_owned(), value.to_string()));
    pairs.collect()
}

/// What ran.
pub(crate) fn run_words(run: &Run) -> Words {
    let mut words = table(&[
        ("name", &run.folder.name()),
        (
            "exit_reason",
            &"no summary: the run was killed, or it cannot be read",
        ),
    ]);
    if let Some(manifest) = &run.manifest {
        words.extend(table(&[
            ("topology_hash", &manifest.topology_hash),
            ("seed", &manifest.seed),
            ("program", &manifest.program.name),
            ("program_version", &manifest.program.version),
            ("created", &manifest.created),
            ("hosts_here", &manifest.hosts_here.join(", ")),
            ("command_line", &json!(manifest.command_line)),
        ]));
    }
    if let Some(summary) = &run.summary {
        words.extend(table(&[
            ("case", &summary.run.case),
            ("started", &summary.run.started),
            ("duration_s", &summary.run.duration_s),
            ("exit_reason", &summary.run.exit_reason),
        ]));
    }
    words
}

fn clock_words(run: &Run, clocks: &Clocks) -> Words {
    let mut words = clocks.words();
    let section = run.summary.as_ref().and_then(|one| one.clocks.as_ref());
    if let Some(text) = section.and_then(|section| serde_json::to_string(section).ok()) {
        words.insert("alignment_json".to_owned(), text);
    }
    words
}

fn gap_words(run: &Run, names: &Names) -> Words {
    let gaps = &run.gaps;
    let mut words = recording_words(&gaps.words, names);
    words.extend(table(&[
        ("unreadable_file_count", &gaps.unreadable_file_count),
        ("truncated_file_count", &gaps.truncated_file_count),
        ("truncated_bytes", &gaps.truncated_bytes),
        ("misfit_message_count", &gaps.misfit_count),
        ("timeless_record_count", &gaps.timeless_count),
    ]));
    for (channel, count) in &gaps.missing {
        words.insert(format!("missing {channel}"), count.to_string());
    }
    words
}

/// What a recording says of itself: gaps in words, and topics that could not have the name that they
/// should.
pub(crate) fn recording_words(gaps: &[String], names: &Names) -> Words {
    let mut words = table(&[("recorder_version", &env!("CARGO_PKG_VERSION"))]);
    for (gap, number) in gaps.iter().zip(1..) {
        words.insert(format!("gap_{number:04}"), gap.clone());
    }
    for (given, wanted) in &names.changed {
        words.insert(format!("renamed {given}"), format!("{wanted} was taken"));
    }
    words
}

/// What was run, and on what.
///
/// # Errors
/// When the file cannot be written.
pub(crate) fn describe_manifest(
    recording: &mut Recording,
    manifest: &Manifest,
) -> Result<(), WriteError> {
    let (topology, host) = (&manifest.topology, &manifest.host_facts);
    for (name, value) in [("hil.topology", topology), ("hil.host_facts", host)] {
        recording.describe(name, table(&[("json", value)]))?;
    }
    Ok(())
}

/// The description of the robot, if any of `messages` is about its arms.
///
/// # Errors
/// When the file cannot be written.
pub(crate) fn attach_robot<'a>(
    recording: &mut Recording,
    messages: impl IntoIterator<Item = &'a str>,
) -> Result<(), WriteError> {
    if !messages.into_iter().any(is_of_arms) {
        return Ok(());
    }
    let urdf = Urdf.to_string().into_bytes();
    recording.attach_file("yumi.urdf", "application/xml", urdf)
}

/// Report and figures as they are: whoever has only this file has them too.
///
/// # Errors
/// When the file cannot be written.
pub(crate) fn attach(recording: &mut Recording, folder: &RunFolder) -> Result<(), WriteError> {
    for (path, media_type) in [
        (folder.manifest(), "application/json"),
        (folder.summary(), "application/json"),
        (folder.report(), "text/plain"),
        (folder.full_report(), "text/plain"),
        (folder.events(), "text/plain"),
    ] {
        // A killed run lacks some of them, which the metadata say.
        let Ok(data) = plain_file::read(&path) else {
            continue;
        };
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        recording.attach_file(&name, media_type, data)?;
    }
    Ok(())
}
