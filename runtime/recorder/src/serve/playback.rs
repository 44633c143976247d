//! A finished run's folder as a run that goes on: its records, each when it happened.

use std::path::Path;
use std::time::Instant;

use hil_core::record::UNAVAILABLE;
use hil_core::time::duration_ns;
use hil_report::assessment::Assessment;
use hil_report::summary::RunSummary;
use hil_rundir::live_run::Stage;
use hil_rundir::record::{RecordFile, RecordKind};
use hil_watch::Record;

use super::source::{Progress, Source, Warning};
use crate::clocks::Clocks;
use crate::failure::Failure;
use crate::net::{self, Noted};
use crate::run::Run;
use crate::view::facts::RunFacts;
use crate::view::{Body, LiveRecord};

/// Records given out per call at most, so that a signal is heard and pictures are drawn.
const RECORDS_MAX: usize = 50_000;
/// How long the end is shown before a run begins again, seconds of its own time.
const PAUSE_S: f64 = 2.0;

/// A run that is played back.
#[derive(Debug)]
pub(crate) struct Playback {
    run: Run,
    steps: Vec<Step>,
    next: usize,
    /// When the present round began.
    began: Instant,
    speed: f64,
    repeats: bool,
    has_one_clock: bool,
}

/// A record and its time on the recording's axis.
#[derive(Debug)]
struct Step {
    at_ns: i64,
    channel: usize,
    what: What,
}

/// Messages stay in their file, they are the most of it.
#[derive(Debug)]
enum What {
    Message { file: usize, index: usize },
    Record(Record),
}

impl Playback {
    /// Reads the run at `path`; `goes_on` hears the share that is read and the name of each file, and
    /// ends it with false.
    ///
    /// # Errors
    /// When it is no run's folder.
    pub(crate) fn read(
        path: &Path,
        speed: f64,
        repeats: bool,
        goes_on: &mut dyn FnMut(f64, &str) -> bool,
    ) -> Result<(Self, RunFacts), Failure> {
        let run = Run::read(path, goes_on)?;
        let clocks = Clocks::of(&run);
        let (name, manifest) = (run.folder.name(), run.manifest.as_ref());
        let mut facts = RunFacts::new(&name, manifest, &run.channels(), &clocks);
        for channel in &mut facts.channels {
            let mut files = run.files.iter();
            channel.is_by_message = !files.any(|file| {
                file.header.kind == RecordKind::Published && file.header.channel == channel.name
            });
        }
        let mut steps = Vec::new();
        for (index, file) in run.files.iter().enumerate() {
            if let Some((channel, described)) = facts.channel(&file.header.channel) {
                plan(index, file, channel, described.offsets_ns, &mut steps);
            }
        }
        steps.sort_by_key(|step| step.at_ns);
        let playback = Self {
            run,
            steps,
            next: 0,
            began: Instant::now(),
            speed,
            repeats,
            has_one_clock: facts.has_one_clock,
        };
        Ok((playback, facts))
    }

    /// What of the run could not be read, in words.
    pub(crate) fn words(&self) -> &[String] {
        &self.run.gaps.words
    }

    fn begin_ns(&self) -> i64 {
        self.steps.first().map_or(0, |step| step.at_ns)
    }

    fn end_ns(&self) -> i64 {
        self.steps.last().map_or(0, |step| step.at_ns)
    }

    fn how(&self) -> String {
        let unknown = || "no summary: it was killed, or goes on elsewhere".to_owned();
        self.run.summary.as_ref().map_or_else(unknown, how_ended)
    }
}

/// How a run ended, in words.
pub(super) fn how_ended(summary: &RunSummary) -> String {
    let outcome = serde_json::to_value(summary.run.outcome).unwrap_or_default();
    let outcome = outcome.as_str().unwrap_or("ended");
    format!("{outcome}: {}", summary.run.exit_reason)
}

impl Source for Playback {
    fn now_ns(&self) -> i64 {
        let since = self.began.elapsed().mul_f64(self.speed);
        self.begin_ns().saturating_add(duration_ns(since))
    }

    fn poll(&mut self, take: &mut dyn FnMut(&LiveRecord)) -> Progress {
        let now_ns = self.now_ns();
        for _ in 0..RECORDS_MAX {
            let Some(step) = self
                .steps
                .get(self.next)
                .filter(|step| step.at_ns <= now_ns)
            else {
                break;
            };
            self.next += 1;
            let body = match &step.what {
                What::Record(record) => Some(Body::Record(*record)),
                What::Message { file, index } => self.run.files[*file]
                    .message(*index)
                    .map(|(_, payload)| Body::Message(payload.to_vec())),
            };
            if let Some(body) = body {
                take(&LiveRecord {
                    at_ns: step.at_ns,
                    channel: step.channel,
                    body,
                });
            }
        }
        if self.next < self.steps.len() {
            return Progress::Going;
        }
        let over_s = (now_ns - self.end_ns()) as f64 / 1e9;
        if self.repeats && over_s > PAUSE_S {
            self.next = 0;
            self.began = Instant::now();
            return Progress::Rewound;
        }
        Progress::Ended(self.how())
    }

    fn has_one_clock(&self) -> bool {
        self.has_one_clock
    }

    fn warnings(&self) -> Vec<Warning> {
        let Some(summary) = &self.run.summary else {
            return Vec::new();
        };
        let warnings = Assessment::of(summary).warnings.into_iter();
        warnings
            .map(|what| Warning {
                process: None,
                what,
            })
            .collect()
    }
}

/// Adds what is in `file`, the `number`th, to the steps; what has no time is left out.
fn plan(
    number: usize,
    file: &RecordFile,
    channel: usize,
    offsets_ns: [i64; 2],
    steps: &mut Vec<Step>,
) {
    let [sender, receiver] = offsets_ns;
    let mut add = |ns: i64, offset_ns: i64, what: What| {
        if ns != UNAVAILABLE {
            steps.push(Step {
                at_ns: ns.saturating_add(offset_ns),
                channel,
                what,
            });
        }
    };
    if file.header.kind == RecordKind::Message {
        for index in 0..file.record_count() {
            if let Some((envelope, _)) = file.message(index) {
                let what = What::Message {
                    file: number,
                    index,
                };
                add(envelope.published_ns, sender, what);
            }
        }
    }
    for record in net::records(file) {
        if let Some(noted) = Noted::of(&record) {
            let shift_ns = match noted.stage {
                Stage::Published | Stage::Sent => sender,
                Stage::Received | Stage::Taken => receiver,
            };
            add(noted.at_ns, shift_ns, What::Record(record));
        }
    }
}
