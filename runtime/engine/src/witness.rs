//! The process beside the programs of the user's on a host, who record nothing themselves: it holds the start of the
//! run until they have joined their channels, then reads these channels beside them and records what they publish
//! and what they are given. What a program makes of a message, only the program knows.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant as WallInstant};

use hil_core::message::Envelope;
use hil_core::record::{PublishedRecord, TakenRecord};
use hil_core::time::Instant;
use hil_platform::clock::MonotonicClock;
use hil_platform::words::named;
use hil_rundir::launch::{WITNESS_LOOK_PERIOD, WitnessWork, WitnessedChannel, WorkerLaunch};
use hil_rundir::pipe::{FromProcess, Orders, ProcessReport, say};
use hil_rundir::record::{RecordFileError, RecordKind, RecordSink, Recorder, SharedSink};
use hil_shm::{Attendance, ChannelError, Domain, RawInput, SequenceTracker, Waiter};

use crate::gateway::poll_descriptors;
use crate::process::recording::{published_record, taken_record};
use crate::process::worker::{Counter, Job, JobWork, Opened, WorkerError, open_domain};

/// Records of one kind that wait for the disk at most: so many for each channel, and of all together.
const RING_RECORDS: usize = 16_384;
const RING_RECORDS_MAX: usize = 65_536;
/// Channels that are named where many are not joined.
const NAMED_COUNT: usize = 3;
const LOOK_PERIOD: Duration = Duration::from_millis(10);
/// How often every channel is looked at, since a program of the user's need not announce what it publishes.
const SWEEP_PERIOD: Duration = Duration::from_millis(10);
/// Messages of one channel that are taken in one look at most.
const LOOK_COUNT_MAX: usize = 1_024;
/// A publication that comes so long after the run's begin with a stamp from before it has a clock of its own.
const FOREIGN_CLOCK: Duration = Duration::from_secs(2);

/// Opens the record files.
///
/// # Errors
/// When a file cannot be made.
pub(crate) fn open<'a>(
    launch: &'a WorkerLaunch,
    work: &'a WitnessWork,
    orders: &Orders,
    recorder: &mut Recorder,
) -> Result<Opened<'a>, WorkerError> {
    let mut counters = Vec::new();
    let noted = work.channels.iter();
    let mut places = [0; 2];
    let noted = noted.map(|channel| Noted::of(channel, &mut places, recorder, &mut counters));
    let noted: Vec<Noted> = noted.collect::<Result<_, _>>()?;
    let sinks = Sinks::open(work, recorder)?;
    let stop = Arc::clone(orders.stop_flag());
    let start = orders.run_start();
    let job = Job {
        name: "channels".to_owned(),
        counters,
        is_watched: true,
        connect: Box::new(move |_thread| {
            let domain = open_domain(launch)?;
            let streams = work.channels.iter().zip(noted).map(|(channel, noted)| {
                let attendance = Attendance::of(&domain, &channel.name)?;
                let input = RawInput::open(&domain, &channel.name, attendance.depth_max())?;
                Ok(Stream {
                    channel,
                    attendance,
                    input,
                    noted,
                })
            });
            let streams = streams.collect::<Result<Vec<_>, ChannelError>>()?;
            let names: Vec<&str> = work.channels.iter().map(|one| one.name.as_str()).collect();
            let waiter = Waiter::open(&domain, &names)?;
            await_programs(work.patience, &streams, &stop);
            Ok(Box::new(Witness {
                streams,
                sinks,
                waiter,
                begun: move || start.get().expect("the run has begun"),
                sweep_due: Instant::ZERO,
                readers_due: Instant::ZERO,
                _domain: domain,
            }))
        }),
    };
    Ok(Opened {
        jobs: vec![job],
        ..Opened::default()
    })
}

/// Waits until the programs have joined their channels, or said to stop, or for `patience`.
fn await_programs(patience: Duration, streams: &[Stream<'_>], stop: &AtomicBool) {
    let deadline = WallInstant::now() + patience;
    let mut awaited: Vec<&Stream<'_>> = streams.iter().collect();
    loop {
        awaited.retain(|stream| !stream.absent().is_empty());
        if awaited.is_empty() || stop.load(Ordering::Acquire) {
            return;
        }
        if WallInstant::now() >= deadline {
            let absent = awaited.iter().flat_map(|stream| stream.absent());
            let programs: BTreeSet<&str> = absent.collect();
            let programs: Vec<&str> = programs.into_iter().collect();
            let channels = awaited.iter().map(|stream| stream.channel.name.as_str());
            let channels: Vec<&str> = channels.collect();
            say(&FromProcess::Warning(format!(
                "within {} s {} did not join {}: the run begins without",
                patience.as_secs_f64(),
                named(&programs, NAMED_COUNT),
                named(&channels, NAMED_COUNT),
            )));
            return;
        }
        thread::sleep(LOOK_PERIOD);
    }
}

/// Where the records go that are alike for all channels.
struct Sinks {
    published: SharedSink,
    taken: SharedSink,
}

impl Sinks {
    fn open(work: &WitnessWork, recorder: &mut Recorder) -> Result<Self, RecordFileError> {
        let mut of = |is_noted: fn(&WitnessedChannel) -> bool, kind, size| {
            let channels = work.channels.iter().filter(|one| is_noted(one));
            let names: Vec<&str> = channels.map(|one| one.name.as_str()).collect();
            let capacity = (RING_RECORDS * names.len()).clamp(1, RING_RECORDS_MAX);
            recorder.shared_sink(kind, names.into_iter(), size, capacity)
        };
        Ok(Self {
            published: of(
                |one| one.publisher.is_some(),
                RecordKind::Published,
                size_of::<PublishedRecord>(),
            )?,
            taken: of(
                |one| one.reader.is_some(),
                RecordKind::Taken,
                size_of::<TakenRecord>(),
            )?,
        })
    }
}

/// What is noted of one channel.
struct Noted {
    /// Its place among the channels of the sink.
    published: Option<usize>,
    taken: Option<usize>,
    /// Whether its reader was there when it was looked for last: else nobody takes anything.
    has_reader: bool,
    messages: Option<RecordSink>,
    count: Arc<AtomicU64>,
    /// Follows the numbers of a publisher of this host.
    tracker: SequenceTracker,
    /// Publications that came in the run with a stamp from long before it.
    foreign_clock_count: u64,
}

impl Noted {
    /// `places` are those behind the channels before it.
    fn of(
        channel: &WitnessedChannel,
        places: &mut [usize; 2],
        recorder: &mut Recorder,
        counters: &mut Vec<Counter>,
    ) -> Result<Self, RecordFileError> {
        let mut place = |index: usize, is_noted: bool| {
            let place = places[index];
            places[index] += usize::from(is_noted);
            is_noted.then_some(place)
        };
        let published = place(0, channel.publisher.is_some());
        let taken = place(1, channel.reader.is_some());
        let count = Arc::new(AtomicU64::new(0));
        let what = if published.is_some() {
            "published"
        } else {
            "given"
        };
        counters.push(Counter::new(&channel.name, what, &count));
        let message_size = size_of::<Envelope>() + channel.message_size_bytes;
        let messages = channel.has_messages.then(|| {
            recorder.sink(
                RecordKind::Message,
                &channel.name,
                message_size,
                RING_RECORDS,
            )
        });
        Ok(Self {
            published,
            taken,
            has_reader: false,
            messages: messages.transpose()?,
            count,
            tracker: SequenceTracker::default(),
            foreign_clock_count: 0,
        })
    }

    fn note(&mut self, sinks: &mut Sinks, begun: Instant, envelope: &Envelope, payload: &[u8]) {
        let now = MonotonicClock::now();
        // What a program on this host said before is no message of the run.
        let run_ns = begun.as_ns()..=now.as_ns();
        if !envelope.is_forwarded() && !run_ns.contains(&envelope.published_ns) {
            let is_of_another_clock =
                envelope.published_ns > now.as_ns() || now > begun + FOREIGN_CLOCK;
            self.foreign_clock_count += u64::from(is_of_another_clock);
            return;
        }
        if let Some(place) = self.published {
            self.tracker.accept(envelope);
            sinks.published.push(place, &published_record(envelope));
        }
        if let Some(place) = self.taken.filter(|_| self.has_reader) {
            sinks.taken.push(place, &taken_record(envelope, now));
        }
        if let Some(messages) = &mut self.messages {
            messages.push_message(envelope, payload);
        }
        self.count.fetch_add(1, Ordering::Relaxed);
    }

    /// What is not in the records, and why.
    fn complain(&self, channel: &str) {
        let missed = self.tracker.counters().missed_count;
        if self.published.is_some() && missed > 0 {
            say(&FromProcess::Warning(format!(
                "{channel}: {missed} messages were published and replaced before they could be recorded"
            )));
        }
        if self.foreign_clock_count > 0 {
            say(&FromProcess::Warning(format!(
                "{channel}: {} messages are in no record, as their publication stamps are not of the run: \
                 `published_ns` is of CLOCK_MONOTONIC",
                self.foreign_clock_count
            )));
        }
    }
}

/// One channel.
struct Stream<'a> {
    channel: &'a WitnessedChannel,
    attendance: Attendance,
    input: RawInput,
    noted: Noted,
}

impl Stream<'_> {
    /// Programs that have not joined it.
    fn absent(&self) -> Vec<&str> {
        let publisher = self.channel.publisher.as_deref();
        let publisher = publisher.filter(|_| self.attendance.census().writer_count == 0);
        let reader = self.channel.reader.as_deref();
        let reader = reader.filter(|_| !self.attendance.has_consumer());
        publisher.into_iter().chain(reader).collect()
    }

    /// Takes what waits.
    fn read(&mut self, sinks: &mut Sinks, begun: Instant) -> Result<(), ChannelError> {
        for _ in 0..LOOK_COUNT_MAX {
            let Self { input, noted, .. } = self;
            if !input
                .receive(&mut |envelope, payload| noted.note(sinks, begun, envelope, payload))?
            {
                break;
            }
        }
        Ok(())
    }
}

/// Reads the channels.
struct Witness<'a, F> {
    streams: Vec<Stream<'a>>,
    sinks: Sinks,
    waiter: Waiter,
    /// When the run began.
    begun: F,
    sweep_due: Instant,
    readers_due: Instant,
    /// Outlives the ports.
    _domain: Domain,
}

impl<F: Fn() -> Instant> Witness<'_, F> {
    fn look_for_readers(&mut self) {
        for stream in &mut self.streams {
            if stream.channel.reader.is_some() {
                stream.noted.has_reader = stream.attendance.has_consumer();
            }
        }
    }

    fn sweep(&mut self) -> Result<(), ChannelError> {
        let begun = (self.begun)();
        let mut streams = self.streams.iter_mut();
        streams.try_for_each(|stream| stream.read(&mut self.sinks, begun))
    }
}

impl<F: Fn() -> Instant> JobWork for Witness<'_, F> {
    fn begin(&mut self, orders: &Orders) -> Result<bool, WorkerError> {
        self.look_for_readers();
        Ok(orders.wait_for_start())
    }

    fn step(&mut self) -> Result<bool, WorkerError> {
        let now = MonotonicClock::now();
        if self.readers_due <= now {
            self.readers_due = now + WITNESS_LOOK_PERIOD;
            self.look_for_readers();
        }
        if self.sweep_due <= now {
            self.sweep_due = now + SWEEP_PERIOD;
            self.sweep()?;
            return Ok(false);
        }
        let begun = (self.begun)();
        let mut has_moved = false;
        for index in self.waiter.announced()? {
            has_moved |= self.waiter.drain(index)?;
            self.streams[index].read(&mut self.sinks, begun)?;
        }
        Ok(has_moved)
    }

    fn rest(&mut self) -> Result<(), WorkerError> {
        let descriptor = std::iter::once(self.waiter.descriptor());
        poll_descriptors(descriptor, self.sweep_due)?;
        Ok(())
    }

    fn finish(&mut self, stepped: Result<(), WorkerError>) -> Result<(), WorkerError> {
        stepped?;
        self.sweep()?;
        for stream in &self.streams {
            stream.noted.complain(&stream.channel.name);
        }
        Ok(())
    }

    fn report(&mut self) -> ProcessReport {
        let streams = self.streams.iter();
        let failures = streams.map(|stream| stream.input.connection_failure_count());
        ProcessReport {
            connection_failures: failures.sum(),
            ..ProcessReport::default()
        }
    }
}
