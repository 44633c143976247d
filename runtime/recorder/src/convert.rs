//! A finished run's folder as one recording: its steps in order of time, through the topics that a run
//! that goes has. What each topic looks like is decided there.

use std::path::Path;
use std::thread;
use std::time::Duration;

use crate::facts;
use crate::failure::Failure;
use crate::record::Recorded;
use crate::run::Run;
use crate::run_topics::RunTopics;
use crate::scene::Scene;
use crate::timeline::Step;
use crate::writer::Recording;

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
    let mut look = |share, words: &str| match look(share, words) {
        Some(signal) => Err(Failure::interrupted(format!(
            "ended by {signal}; no file was written"
        ))),
        None => Ok(()),
    };
    let mut looked = Ok(());
    let mut run = Run::read(from, &mut |share, path| {
        looked = look(Some(share), &format!("reading {path}"));
        looked.is_ok()
    })?;
    looked?;
    run.count_missing();
    let mut recording = Recording::create(to)?;
    let mut topics = RunTopics::of_run(&run, has_scene);
    let steps = topics.steps(&run);
    topics.declare(&run, &steps, &mut recording)?;
    // Descriptions of topics in a chunk of their own: damage to a message cannot take them along.
    recording.flush()?;
    // Something may still be made that the pictures need.
    while !topics.scene.as_mut().is_none_or(Scene::is_ready) {
        look(None, "making the fleet's ground")?;
        thread::sleep(PAUSE);
    }
    let (all, mut done_count) = (steps.len(), 0);
    for (count, moment) in steps.chunk_by(Step::is_beside).enumerate() {
        if count % 4096 == 0 {
            let share = done_count as f64 / all.max(1) as f64;
            look(Some(share), &format!("writing {done_count} of {all}"))?;
        }
        topics.moment(&run, moment, &mut recording)?;
        done_count += moment.len();
    }
    let timeless_count = topics.counts.timeless_count;
    run.gaps.misfit_count = topics.counts.misfit_count;
    run.gaps.timeless_count = timeless_count;
    if timeless_count > 0 {
        run.gaps.words.push(format!(
            "{timeless_count} messages and records have no time on the recording's clock; left out"
        ));
    }
    if let Some(scene) = &mut topics.scene {
        scene.finish(&mut recording)?;
        run.gaps.words.extend(scene.problems());
    }
    facts::write(&mut recording, &run, &topics)?;
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
