//! The process beside the programs of the user's on a host, who record nothing themselves: it holds the start of the
//! run until they have joined their channels, then reads these channels beside them and records what they publish
//! and what they are given. What a program makes of a message, only the program knows.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant as WallInstant};

use hil_core::message::Envelope;
use hil_core::record::{PublishedRecord, TakenRecord};
use hil_core::time::Instant;
use hil_platform::clock::MonotonicClock;
use hil_platform::words::named;
use hil_rundir::launch::{WitnessWork, WitnessedChannel, WorkerLaunch};
use hil_rundir::pipe::{FromProcess, Orders, ProcessReport, say};
use hil_rundir::record::{RecordFileError, RecordKind, RecordSink, Recorder, SharedSink};
use hil_shm::{Census, ChannelError, Domain, RawInput, Waiter, observer_depth};

use crate::process::recording::forwarded_ns;
use crate::process::worker::{Counter, Job, JobWork, Opened, WorkerError, open_domain};

/// Records of one kind that wait for the disk at most: so many for each channel, and of all together.
const RING_RECORDS: usize = 16_384;
const RING_RECORDS_MAX: usize = 65_536;
/// Channels that are named where many are not joined.
const NAMED_COUNT: usize = 3;
const LOOK_PERIOD: Duration = Duration::from_millis(10);
/// Longest sleep while nothing passes.
const REST: Duration = Duration::from_millis(100);

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
            let streams = work.channels.iter().zip(noted);
            let streams = streams.map(|(channel, noted)| {
                let depth = observer_depth(channel.message_size_bytes);
                let input = RawInput::open(&domain, &channel.name, depth)?;
                Ok((input, noted))
            });
            let streams = streams.collect::<Result<Vec<_>, ChannelError>>()?;
            let names: Vec<&str> = work.channels.iter().map(|one| one.name.as_str()).collect();
            let waiter = Waiter::open(&domain, &names)?;
            await_programs(work, &domain, &stop)?;
            Ok(Box::new(Witness {
                channels: &work.channels,
                streams,
                sinks,
                waiter,
                begun: move || start.get().unwrap_or(Instant::ZERO),
                domain,
            }))
        }),
    };
    Ok(Opened {
        jobs: vec![job],
        ..Opened::default()
    })
}

/// Waits until the programs have joined their channels, or said to stop, or for its patience.
fn await_programs(
    work: &WitnessWork,
    domain: &Domain,
    stop: &AtomicBool,
) -> Result<(), ChannelError> {
    let deadline = WallInstant::now() + work.patience;
    let mut awaited: Vec<&WitnessedChannel> = work.channels.iter().collect();
    loop {
        let mut missing = Vec::new();
        for channel in awaited {
            let has_writer =
                !channel.has_publisher || Census::of(domain, &channel.name)?.writer_count > 0;
            if !has_writer || !has_joined(domain, channel)? {
                missing.push(channel);
            }
        }
        awaited = missing;
        if awaited.is_empty() || stop.load(Ordering::Acquire) {
            return Ok(());
        }
        if WallInstant::now() >= deadline {
            let names: Vec<&str> = awaited.iter().map(|one| one.name.as_str()).collect();
            let (names, patience_s) = (named(&names, NAMED_COUNT), work.patience.as_secs_f64());
            say(&FromProcess::Warning(format!(
                "programs of the user's did not join {names} within {patience_s} s; the run begins without"
            )));
            return Ok(());
        }
        thread::sleep(LOOK_PERIOD);
    }
}

/// Whether the program that reads `channel`, if one does, has joined it.
fn has_joined(domain: &Domain, channel: &WitnessedChannel) -> Result<bool, ChannelError> {
    // This process is a reader, too.
    Ok(!channel.has_reader || Census::of(domain, &channel.name)?.reader_count > 1)
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
                |one| one.has_publisher,
                RecordKind::Published,
                size_of::<PublishedRecord>(),
            )?,
            taken: of(
                |one| one.has_reader,
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
    /// Whether its reader was there when it was looked for: until then nobody takes anything.
    has_joined: bool,
    messages: Option<RecordSink>,
    count: Arc<AtomicU64>,
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
        let published = place(0, channel.has_publisher);
        let taken = place(1, channel.has_reader);
        let count = Arc::new(AtomicU64::new(0));
        counters.push(Counter {
            channel: channel.name.clone(),
            what: if published.is_some() {
                "published"
            } else {
                "given"
            },
            count: Arc::clone(&count),
        });
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
            has_joined: false,
            messages: messages.transpose()?,
            count,
        })
    }

    fn note(&mut self, sinks: &mut Sinks, envelope: &Envelope, payload: &[u8]) {
        if let Some(place) = self.published {
            let record = PublishedRecord {
                sequence: envelope.sequence,
                published_ns: envelope.published_ns,
                epoch: envelope.epoch,
                reserved: 0,
            };
            sinks.published.push(place, &record);
        }
        if let Some(messages) = &mut self.messages {
            messages.push_message(envelope, payload);
        }
        if let Some(place) = self.taken.filter(|_| self.has_joined) {
            let record = TakenRecord {
                sequence: envelope.sequence,
                published_ns: envelope.published_ns,
                forwarded_ns: forwarded_ns(envelope),
                taken_ns: MonotonicClock::now().as_ns(),
                epoch: envelope.epoch,
                reserved: 0,
            };
            sinks.taken.push(place, &record);
        }
        self.count.fetch_add(1, Ordering::Relaxed);
    }
}

/// Reads the channels.
struct Witness<'a, F> {
    channels: &'a [WitnessedChannel],
    streams: Vec<(RawInput, Noted)>,
    sinks: Sinks,
    waiter: Waiter,
    /// When the run began.
    begun: F,
    /// Outlives the ports.
    domain: Domain,
}

impl<F> Witness<'_, F> {
    fn look_for_readers(&mut self) -> Result<(), ChannelError> {
        for (channel, (_, noted)) in self.channels.iter().zip(&mut self.streams) {
            noted.has_joined = noted.has_joined || has_joined(&self.domain, channel)?;
        }
        Ok(())
    }
}

impl<F: Fn() -> Instant> JobWork for Witness<'_, F> {
    fn begin(&mut self, orders: &Orders) -> Result<bool, WorkerError> {
        self.look_for_readers()?;
        Ok(orders.wait_for_start())
    }

    fn step(&mut self) -> Result<bool, WorkerError> {
        let begun_ns = (self.begun)().as_ns();
        let mut has_moved = false;
        for (input, noted) in &mut self.streams {
            has_moved |= input.receive(&mut |envelope, payload| {
                // What a program on this host said before is no message of the run.
                if envelope.is_forwarded() || envelope.published_ns >= begun_ns {
                    noted.note(&mut self.sinks, envelope, payload);
                }
            })?;
        }
        Ok(has_moved)
    }

    fn rest(&mut self) -> Result<(), WorkerError> {
        self.look_for_readers()?;
        self.waiter.wait(REST)?;
        Ok(())
    }

    fn finish(&mut self, stepped: Result<(), WorkerError>) -> Result<(), WorkerError> {
        stepped?;
        while self.step()? {}
        Ok(())
    }

    fn report(&mut self) -> ProcessReport {
        let streams = self.streams.iter();
        let failures = streams.map(|(input, _)| input.connection_failure_count());
        ProcessReport {
            connection_failures: failures.sum(),
            ..ProcessReport::default()
        }
    }
}
