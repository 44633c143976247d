//! Where the records of a served run come from: a finished run's folder, each record when it happened, or a
//! live run, as its feed tells of it.

use std::collections::BTreeSet;
use std::fs;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::Path;
use std::time::{Duration, Instant};

use hil_core::record::stamp;
use hil_core::time::duration_ns;
use hil_platform::clock::MonotonicClock;
use hil_platform::plain_file;
use hil_report::assessment::Assessment;
use hil_report::summary::RunSummary;
use hil_rundir::live_run::{LiveRun, Stage};
use hil_rundir::record::RecordKind;
use hil_rundir::status::{self, Overruns};
use hil_watch::{Event, Feed, FeedError, Origin, Poll, WatchedChannel};
use serde::Serialize;

use super::engine::REST;
use crate::clocks::Clocks;
use crate::failure::Failure;
use crate::net::{self, Noted};
use crate::pace::Pace;
use crate::run::Run;
use crate::timeline::{Step, What, noted_steps};
use crate::view::facts::RunFacts;
use crate::view::{Body, LiveRecord};

/// How it goes on after a look.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Progress {
    /// More will come.
    Going,
    /// It begins again.
    Rewound,
    /// No more will come, and how the run ended.
    Ended(String),
}

/// Something that is amiss.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Warning {
    /// With which process, where that is known.
    pub(crate) process: Option<String>,
    /// What.
    pub(crate) what: String,
}

impl Warning {
    /// Of no single process.
    pub(crate) const fn of_the_run(what: String) -> Self {
        let process = None;
        Self { process, what }
    }
}

/// A run's records as they come.
pub(crate) trait Source {
    /// Now, on the axis of the records' times.
    fn now_ns(&self) -> i64;

    /// Gives out what came since the last look.
    fn poll(&mut self, take: &mut dyn FnMut(&LiveRecord)) -> Progress;

    /// Numbers that were never seen on channels read from shared memory; `None` where none is.
    fn missed_count(&self) -> Option<u64> {
        None
    }

    /// How long to rest before the next look, where that hangs on what was found.
    fn rest(&mut self) -> Option<Duration> {
        None
    }

    /// True when the stamps of all hosts compare; may become true while a run goes on.
    fn has_one_clock(&self) -> bool;

    /// What is amiss with the run or its host, as far as it is known by now.
    fn warnings(&self) -> Vec<Warning>;

    /// Ticks that the processes of the run skipped so far, and which hosts are heard; `None` where nobody tells, as of a finished run,
    /// whose report has them among its warnings.
    fn overruns(&mut self) -> Option<Overruns> {
        None
    }

    /// What could not be read since the last call.
    fn take_problems(&mut self) -> Vec<String> {
        Vec::new()
    }
}

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
        let clocks = Clocks::of_run(&run);
        let (name, manifest) = (run.folder.name(), run.manifest.as_ref());
        let mut facts = RunFacts::new(&name, manifest, &run.channels(), &clocks);
        for channel in &mut facts.channels {
            let mut files = run.files.iter();
            channel.is_by_message = !files.any(|file| {
                file.header.kind == RecordKind::Published && file.header.channel == channel.name
            });
        }
        let place = |name: &str| facts.channel(name).map(|(place, _)| place);
        let mut steps = noted_steps(&run, place, &mut |channel, noted| {
            let [sender, receiver] = facts.channels[channel].offsets_ns;
            let offset_ns = match noted.stage {
                Stage::Published | Stage::Sent => sender,
                Stage::Received | Stage::Taken => receiver,
            };
            let at_ns = stamp(noted.at_ns)?.saturating_add(offset_ns);
            u64::try_from(at_ns).ok()
        });
        steps.retain(|step| step.at_ns.is_some());
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
        self.steps.first().map_or(0, at_ns)
    }

    fn end_ns(&self) -> i64 {
        self.steps.last().map_or(0, at_ns)
    }

    fn how(&self) -> String {
        let unknown = || "no summary: it was killed, or goes on elsewhere".to_owned();
        self.run.summary.as_ref().map_or_else(unknown, how_ended)
    }
}

fn at_ns(step: &Step) -> i64 {
    step.at_ns.map_or(0, u64::cast_signed)
}

/// How a run ended, in words.
fn how_ended(summary: &RunSummary) -> String {
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
                .filter(|step| at_ns(step) <= now_ns)
            else {
                break;
            };
            self.next += 1;
            let body = match step.what {
                What::Record { file, index } => {
                    net::record(&self.run.files[file], index).map(Body::Record)
                }
                What::Message { file, index } => self.run.files[file]
                    .message(index)
                    .map(|(_, payload)| Body::Message(payload.to_vec())),
                _ => None,
            };
            if let Some(body) = body {
                take(&LiveRecord {
                    at_ns: at_ns(step),
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
        let summary = self.run.summary.iter();
        let warnings = summary.flat_map(|summary| Assessment::of(summary).warnings);
        warnings.map(Warning::of_the_run).collect()
    }
}

/// Between two looks, when something is read from shared memory that comes only once.
const MEMORY_REST: Duration = Duration::from_millis(10);
/// Polls per look, so that a long past does not keep signals and pictures waiting.
const POLLS_MAX: usize = 16;
/// Lines shown of what a process said.
const LINES_MAX: usize = 3;
/// As much of the end of a log is read: it is looked at every second, and may become long.
const LOG_END_BYTES: u64 = 64 * 1024;

/// A run that has not ended.
#[derive(Debug)]
pub(crate) struct Running {
    feed: Feed,
    pace: Pace,
    /// The channels in the order of the facts.
    channels: Vec<String>,
    /// From this host's monotonic clock to the axis, nanoseconds.
    offset_ns: i64,
    is_silent: bool,
    ended: Option<String>,
    problems: Vec<String>,
    /// As they were told last: the supervisor takes them away with the run's end.
    overruns: Option<Overruns>,
}

impl Running {
    /// Begins to watch `run`.
    ///
    /// # Errors
    /// When its manifest or its shared memory cannot be had.
    pub(crate) fn open(run: LiveRun) -> Result<(Self, RunFacts), FeedError> {
        let name = run.name.clone();
        let feed = Feed::open(run)?;
        let manifest = feed.manifest();
        let mut facts = RunFacts::new(&name, Some(manifest), &[], &Clocks::default());
        let offset_ns = manifest.realtime_minus_monotonic_ns.unwrap_or(0);
        for channel in &mut facts.channels {
            channel.offsets_ns = [offset_ns; 2];
            let watched = feed.channel(&channel.name);
            channel.is_by_message |= watched.is_some_and(WatchedChannel::is_unrecorded);
        }
        let is_here = |host: &String| facts.hosts_here.contains(host);
        facts.has_one_clock = facts.hosts.iter().all(is_here) || feed.has_one_clock() == Some(true);
        let names = facts.channels.iter().map(|channel| channel.name.clone());
        let running = Self {
            channels: names.collect(),
            pace: Pace::of(&feed, MEMORY_REST, REST),
            feed,
            offset_ns,
            is_silent: false,
            ended: None,
            problems: Vec::new(),
            overruns: None,
        };
        Ok((running, facts))
    }

    /// The topology with every default spelled out.
    pub(crate) const fn topology(&self) -> &serde_json::Value {
        &self.feed.manifest().topology
    }

    /// What the account at the end says of how it ended.
    fn how(&self, has_summary: bool) -> String {
        let path = self.feed.run().run_folder().summary();
        let text = plain_file::read_to_string(&path)
            .ok()
            .filter(|_| has_summary);
        let summary = text.and_then(|text| RunSummary::from_json(&text).ok());
        summary.map_or_else(
            || "its supervisor was killed".to_owned(),
            |summary| how_ended(&summary),
        )
    }
}

impl Source for Running {
    fn now_ns(&self) -> i64 {
        MonotonicClock::now().as_ns().saturating_add(self.offset_ns)
    }

    fn poll(&mut self, take: &mut dyn FnMut(&LiveRecord)) -> Progress {
        let (offset_ns, mut has_summary) = (self.offset_ns, None);
        let now_ns = MonotonicClock::now().as_ns();
        let place = |name: &str| self.channels.iter().position(|known| known == name);
        let mut give = |channel: &str, own_ns: Option<i64>, body: Body| {
            if let Some(channel) = place(channel) {
                // Of another host's clock nothing is known but that it was before now.
                let at_ns = own_ns.unwrap_or(now_ns).saturating_add(offset_ns);
                take(&LiveRecord {
                    at_ns,
                    channel,
                    body,
                });
            }
        };
        for _ in 0..POLLS_MAX {
            let poll = self.feed.poll(&mut |event| match event {
                Event::Message {
                    channel,
                    origin,
                    envelope,
                    payload,
                } => {
                    let own_ns = match origin {
                        Origin::Records => Some(envelope.published_ns),
                        Origin::SharedMemory => None,
                        // What another host sends at the end has been, and is not shown as new.
                        Origin::OtherHost => return,
                    };
                    let body = Body::Message(payload.to_vec());
                    give(&channel.description.name, own_ns, body);
                }
                Event::Record {
                    channel,
                    is_of_this_host: true,
                    record,
                    ..
                } => {
                    if let Some(noted) = Noted::of(&record) {
                        give(channel, Some(noted.at_ns), Body::Record(record));
                    }
                }
                Event::Record { .. } => {}
                Event::Problem(text) => self.problems.push(text.to_owned()),
                Event::Silent => self.is_silent = true,
                Event::Ended { has_summary: has } => has_summary = Some(has),
            });
            if poll != Poll::Busy {
                break;
            }
        }
        if let Some(has_summary) = has_summary {
            self.ended = Some(self.how(has_summary));
        }
        match (&self.ended, self.is_silent) {
            (Some(how), _) => Progress::Ended(how.clone()),
            (None, true) => Progress::Ended(
                "all processes have ended; the account is being drawn up".to_owned(),
            ),
            (None, false) => Progress::Going,
        }
    }

    fn missed_count(&self) -> Option<u64> {
        let missed = self.channels.iter().map(|name| {
            let is_shared = self.feed.counters(name).is_some();
            is_shared.then(|| self.feed.missed_count(name))
        });
        missed.flatten().reduce(u64::saturating_add)
    }

    fn rest(&mut self) -> Option<Duration> {
        Some(self.pace.after(self.feed.take_fill_ratio()))
    }

    fn take_problems(&mut self) -> Vec<String> {
        core::mem::take(&mut self.problems)
    }

    fn has_one_clock(&self) -> bool {
        self.feed.has_one_clock() == Some(true)
    }

    fn overruns(&mut self) -> Option<Overruns> {
        let now = MonotonicClock::now();
        if let Ok(told) = status::overruns(&self.feed.run().folder, now) {
            self.overruns = Some(told);
        }
        self.overruns.clone()
    }

    /// What the processes said last on their standard error.
    fn warnings(&self) -> Vec<Warning> {
        let folder = self.feed.run().folder.join("logs");
        let entries = fs::read_dir(folder).into_iter().flatten().flatten();
        let paths: BTreeSet<_> = entries.map(|entry| entry.path()).collect();
        let mut warnings = Vec::new();
        for path in paths {
            let process = path
                .file_stem()
                .map(|name| name.to_string_lossy().into_owned());
            let text = end_of(&path).unwrap_or_default();
            let lines = text.lines().filter(|line| !line.trim().is_empty());
            let lines: Vec<&str> = lines.collect();
            let last = lines[lines.len().saturating_sub(LINES_MAX)..].iter();
            warnings.extend(last.map(|line| Warning {
                process: process.clone(),
                what: (*line).to_owned(),
            }));
        }
        warnings
    }
}

/// The last lines of the log at `path`, whatever bytes a program wrote there.
fn end_of(path: &Path) -> io::Result<String> {
    let mut file = plain_file::open(path)?;
    let begin = file.metadata()?.len().saturating_sub(LOG_END_BYTES);
    file.seek(SeekFrom::Start(begin))?;
    let mut bytes = Vec::new();
    file.take(LOG_END_BYTES).read_to_end(&mut bytes)?;
    let text = String::from_utf8_lossy(&bytes);
    let whole_lines = text.split_once('\n').filter(|_| begin > 0);
    Ok(whole_lines.map_or(&*text, |(_, rest)| rest).to_owned())
}
