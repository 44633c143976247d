//! Recording a run while it goes: events of the run become topics, topics go to files, files are flushed
//! by the clock. What a topic holds is decided in [`crate::run_topics`], what a file is in
//! [`crate::split`].

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::thread;
use std::time::{Duration, Instant};

use hil_platform::words::counted_plainly;
use hil_rundir::live_run::LiveRun;
use hil_rundir::select::{SelectError, select, select_below};
use hil_watch::{Event, Feed, Poll};

use crate::cli::RecordOptions;
use crate::facts::{self, Words};
use crate::failure::Failure;
use crate::pace::Pace;
use crate::run::Run;
use crate::run_topics::RunTopics;
use crate::split::{Files, prepare, target};
use crate::writer::WriteError;

/// How long a recorder with nothing to do sleeps when it reads shared memory, whose buffers are short,
/// and how long at least when what it misses there comes again.
const PAUSE: Duration = Duration::from_millis(10);
/// The same when all it reads are files, and at most when what it misses comes again. Every wake-up empties the caches of a processor that carries
/// messages in the next moment: two a second are felt less than a hundred.
const LONG_PAUSE: Duration = Duration::from_millis(500);
/// How often it looks whether a run has begun.
const WAIT_PAUSE: Duration = Duration::from_millis(50);
/// How often it says how far it is.
const PROGRESS_PERIOD: Duration = Duration::from_millis(500);
/// What the processes of a run have in their rings is in their files after this time.
const RINGS_EMPTY_WITHIN: Duration = Duration::from_millis(60);
/// How long what waits is read after a signal: a run that goes on may write faster than it is read.
const CATCH_UP_WITHIN: Duration = Duration::from_secs(30);
/// How long the ground of a fleet is waited for at the end, and how often it is asked for.
const GROUND_WITHIN: Duration = Duration::from_secs(30);
const GROUND_PAUSE: Duration = Duration::from_millis(20);
/// Problems that the file tells in words; further ones are counted.
const PROBLEMS_MAX: usize = 1000;

/// What a recording, of a run that goes or of a folder, came to.
#[derive(Debug, Default)]
pub(crate) struct Recorded {
    /// The files, in order.
    pub(crate) paths: Vec<PathBuf>,
    /// Messages in them, of all topics.
    pub(crate) written_count: u64,
    /// Messages of the run's own channels among them.
    pub(crate) message_count: u64,
    /// Topics.
    pub(crate) topic_count: usize,
    /// Messages that should be in them and are not, by channel.
    pub(crate) missed: BTreeMap<String, u64>,
    /// What a reader must know.
    pub(crate) words: Vec<String>,
    /// Something of the run is not in them.
    pub(crate) has_gaps: bool,
    /// The signal that ended the recording before its run.
    pub(crate) signal: Option<&'static str>,
}

impl Recorded {
    /// The files, and what is in them.
    pub(crate) fn files(&self) -> String {
        let paths = self.paths.iter().map(|path| path.display().to_string());
        let paths = paths.collect::<Vec<_>>().join(", ");
        let messages = counted_plainly(self.message_count, "message");
        format!("{paths}: {messages} of the run")
    }
}

/// How far a recording is.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Progress<'a> {
    /// The run; empty while none has begun.
    pub(crate) run: &'a str,
    /// Messages per second of late.
    pub(crate) rate_hz: f64,
    /// Size so far, bytes.
    pub(crate) size_bytes: u64,
    /// Files so far.
    pub(crate) file_count: usize,
    /// Messages missed so far.
    pub(crate) missed_count: u64,
}

/// Hears how far the recording is and gives the signal that came.
pub(crate) type Look<'a> = &'a mut dyn FnMut(&Progress<'_>) -> Option<&'static str>;

/// Records a run until it ends, or `look` gives a signal.
///
/// # Errors
/// When there is no run to record or no file can be written; what was written is beside its place
/// then.
pub(crate) fn record(options: &RecordOptions, look: Look<'_>) -> Result<Recorded, Failure> {
    let (split_bytes, force) = (options.split_size, options.force);
    prepare(&options.output, split_bytes, force)?;
    let run = find(options, look)?;
    let target = target(&options.output, &run.name);
    let mut feed = Feed::open(run).map_err(Failure::failed)?;
    if options.from_now {
        feed.skip_to_now();
    }
    let files = Files::begin(&target, split_bytes, force)?;
    let topics = RunTopics::of_feed(&feed, !options.no_scene);
    let mut recording = LiveRecording::begin(feed, topics, files)?;
    let signal = recording.run(options.flush, look)?;
    recording.finish(signal)
}

fn find(options: &RecordOptions, look: Look<'_>) -> Result<LiveRun, Failure> {
    if let Some(folder) = &options.folder {
        return LiveRun::read(folder).map_err(|why| {
            let folder = folder.display();
            Failure::failed(format!("the run in {folder} does not go any more: {why}"))
        });
    }
    let wanted = options.run.as_deref();
    loop {
        let selected = match &options.below {
            Some(below) => select_below(below, wanted),
            None => select(wanted),
        };
        match selected {
            Ok(run) => return Ok(run),
            Err(SelectError::NoneRuns | SelectError::NoSuch { .. }) if options.wait => {}
            Err(error @ (SelectError::NoneRuns | SelectError::NoSuch { .. })) => {
                let cure = "--wait waits for one to begin";
                return Err(Failure::usage(format!("{error}; {cure}")));
            }
            Err(error) => return Err(Failure::usage(error)),
        }
        if let Some(signal) = look(&Progress::default()) {
            let words = format!("ended by {signal}; no run had begun and no file was written");
            return Err(Failure::interrupted(words));
        }
        thread::sleep(WAIT_PAUSE);
    }
}

/// What went wrong: the first problems in words, all of them counted.
#[derive(Debug, Default)]
struct Problems {
    words: Vec<String>,
    count: u64,
}

impl Problems {
    fn note(&mut self, text: &str) {
        self.count += 1;
        if self.words.len() < PROBLEMS_MAX {
            self.words.push(text.to_owned());
        }
    }
}

struct LiveRecording {
    feed: Feed,
    topics: RunTopics,
    files: Files,
    /// All records of the run have come.
    is_silent: bool,
    has_summary: bool,
    problems: Problems,
    /// What the open file says of the clocks.
    told_clocks: Words,
}

impl LiveRecording {
    fn begin(feed: Feed, topics: RunTopics, files: Files) -> Result<Self, WriteError> {
        let mut recording = Self {
            topics,
            feed,
            files,
            is_silent: false,
            has_summary: false,
            problems: Problems::default(),
            told_clocks: Words::new(),
        };
        recording.describe_run()?;
        recording.files.flush()?;
        Ok(recording)
    }

    /// Records until the run ends or a signal comes, which it gives back.
    fn run(&mut self, flush: Duration, look: Look<'_>) -> Result<Option<&'static str>, WriteError> {
        // A message waits for the ring of its process, for the next look, and for the flush.
        let flush_period = flush / 2;
        let mut pace = Pace::of(&self.feed, PAUSE, LONG_PAUSE.min(flush_period));
        let (mut flushed, mut told) = (Instant::now(), Instant::now());
        let (mut told_count, mut has_caught_up) = (0, false);
        loop {
            let polled = self.poll()?;
            let now = Instant::now();
            if polled != Poll::Busy {
                self.topics.settle(now, &mut self.files)?;
            }
            // What was there before the recorder is not to wait for its first period.
            let is_abreast = polled == Poll::Idle && !has_caught_up;
            has_caught_up |= is_abreast;
            if is_abreast || now.duration_since(flushed) >= flush_period {
                flushed = now;
                if self.files.flush()? {
                    self.next_file()?;
                }
            }
            // Before a signal is asked for: a run that is over was not interrupted.
            if polled == Poll::Over {
                return Ok(None);
            }
            let since_told = now.duration_since(told);
            if since_told >= PROGRESS_PERIOD {
                let count = self.topics.counts.message_count;
                let rate_hz = (count - told_count) as f64 / since_told.as_secs_f64();
                (told, told_count) = (now, count);
                if let Some(signal) = look(&self.progress(rate_hz)) {
                    let is_over = self.catch_up()? == Poll::Over;
                    return Ok((!is_over).then_some(signal));
                }
            }
            if polled == Poll::Idle {
                thread::sleep(pace.after(self.feed.take_fill_ratio()));
            }
        }
    }

    fn progress(&self, rate_hz: f64) -> Progress<'_> {
        let missed = self.topics.missed(&self.feed, false);
        Progress {
            run: &self.feed.run().name,
            rate_hz,
            size_bytes: self.files.size_bytes(),
            file_count: self.files.number(),
            missed_count: missed.values().sum(),
        }
    }

    fn poll(&mut self) -> Result<Poll, WriteError> {
        self.topics.clocks.has_one_clock = self.feed.has_one_clock();
        let mut failed = None;
        let polled = self.feed.poll(&mut |event| {
            match &event {
                Event::Problem(text) => self.problems.note(text),
                Event::Silent => self.is_silent = true,
                Event::Ended { has_summary } => self.has_summary = *has_summary,
                Event::Message { .. } | Event::Record { .. } => {}
            }
            if failed.is_none() {
                failed = self.topics.take(&event, &mut self.files).err();
            }
        });
        failed.map_or(Ok(polled), Err)
    }

    /// What was published before the signal is to be in the file; what the last poll came to.
    fn catch_up(&mut self) -> Result<Poll, WriteError> {
        thread::sleep(RINGS_EMPTY_WITHIN);
        let polled = read_up(Instant::now() + CATCH_UP_WITHIN, || self.poll())?;
        if polled == Poll::Busy {
            let within_s = CATCH_UP_WITHIN.as_secs();
            self.problems.note(&format!(
                "more than could be read in {within_s} s after the signal was there; the rest is not in the file"
            ));
        }
        self.topics.flush_joins(&mut self.files)?;
        Ok(polled)
    }

    fn next_file(&mut self) -> Result<(), WriteError> {
        self.describe_recording("goes on in the next file")?;
        self.files.next()?;
        self.describe_run()?;
        self.files.flush()?;
        Ok(())
    }

    fn finish(mut self, signal: Option<&'static str>) -> Result<Recorded, Failure> {
        // A run may be over before the ground of its fleet was made.
        let since = Instant::now();
        if let Some(scene) = &mut self.topics.scene {
            while scene.awaits_ground() && since.elapsed() < GROUND_WITHIN {
                thread::sleep(GROUND_PAUSE);
            }
            scene.finish(&mut self.files)?;
            for problem in scene.problems() {
                self.problems.note(&problem);
            }
        }
        let mut run = Run::without_records(self.feed.run().run_folder());
        if self.has_summary {
            // A folder that cannot be listed is one more thing to say, and no reason to lose the rest.
            if let Err(error) = run.read_traces() {
                run.gaps.leave_out(error.to_string());
            }
            self.topics.conclude(&run, &mut self.files)?;
        }
        let how = match signal {
            Some(signal) => format!("the recorder was ended by {signal}, the run went on"),
            None if self.has_summary => "the run ended".to_owned(),
            None => "the run was killed".to_owned(),
        };
        self.describe_recording(&how)?;
        let mut end = facts::run_words(&run);
        if signal.is_some() {
            end.insert("exit_reason".to_owned(), how);
        }
        self.files.open().describe("hil.end", end)?;
        facts::attach(self.files.open(), &run.folder)?;
        let counts = self.topics.counts;
        let missed = self.topics.missed(&self.feed, self.is_silent);
        let mut words = self.problems.words.clone();
        if self.has_summary {
            words.extend(run.gaps.words.iter().cloned());
        }
        let has_gaps = !missed.is_empty()
            || counts.misfit_count + counts.timeless_count + self.problems.count > 0
            || (self.has_summary && run.gaps.is_any());
        let topic_count = self.files.topic_count();
        let (paths, written_count) = self.files.finish()?;
        Ok(Recorded {
            paths,
            written_count,
            message_count: counts.message_count,
            topic_count,
            missed,
            words,
            has_gaps,
            signal,
        })
    }

    /// What ran, at the beginning of each file, so that one that is cut short has it too.
    fn describe_run(&mut self) -> Result<(), WriteError> {
        let run = Run::without_records(self.feed.run().run_folder());
        let mut words = facts::run_words(&run);
        words.insert(
            "exit_reason".to_owned(),
            "recorded while it went".to_owned(),
        );
        self.told_clocks = self.topics.clocks.words();
        let file = self.files.open();
        file.describe("hil.clocks", self.told_clocks.clone())?;
        file.describe("hil.run", words)?;
        facts::describe_manifest(file, self.feed.manifest())?;
        facts::attach_robot(file, self.topics.messages())
    }

    /// What was recorded so far, at the end of each file.
    fn describe_recording(&mut self, how: &str) -> Result<(), WriteError> {
        let counts = self.topics.counts;
        let mut words = facts::recording_words(&self.problems.words, &self.topics.names);
        words.extend(facts::table(&[
            ("file_number", &self.files.number()),
            ("message_count", &counts.message_count),
            ("misfit_message_count", &counts.misfit_count),
            ("timeless_record_count", &counts.timeless_count),
            ("late_record_count", &self.topics.late_count()),
            ("unordered_latency_count", &self.topics.unordered_count()),
            ("problem_count", &self.problems.count),
            ("mode", &"live"),
            ("ended", &how),
        ]));
        for (channel, count) in self.topics.missed(&self.feed, self.is_silent) {
            words.insert(format!("missed {channel}"), count.to_string());
        }
        for (channel, count) in self.topics.earlier(&self.feed) {
            words.insert(format!("before {channel}"), count.to_string());
        }
        let clocks = self.topics.clocks.words();
        let channels = self.topics.channel_words();
        let file = self.files.open();
        // Offsets of other clocks come with the last records.
        if clocks != self.told_clocks {
            file.describe("hil.clocks", clocks)?;
        }
        file.describe("hil.channels", channels)?;
        file.describe("hil.recording", words)
    }
}

/// Polls until nothing waits, or until `deadline`; what the last poll came to.
fn read_up<E>(deadline: Instant, mut poll: impl FnMut() -> Result<Poll, E>) -> Result<Poll, E> {
    loop {
        let polled = poll()?;
        if polled != Poll::Busy || Instant::now() >= deadline {
            return Ok(polled);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_never_ceases_to_come_is_read_until_a_deadline() {
        let deadline = Instant::now() + Duration::from_millis(20);
        let polled = read_up(deadline, || Ok::<_, ()>(Poll::Busy));
        assert_eq!(polled, Ok(Poll::Busy));
        assert!(Instant::now() >= deadline);
        let mut left = 3;
        let polled = read_up(Instant::now() + Duration::from_mins(1), || {
            left -= 1;
            Ok::<_, ()>(if left > 0 { Poll::Busy } else { Poll::Idle })
        });
        assert_eq!((polled, left), (Ok(Poll::Idle), 0));
    }
}
