//! The shell of every process of a run that this binary plays: component, gateway, clock path,
//! adapter, cable and witness. It hears the supervisor's orders, starts one thread for each job, tells what they count
//! and that they turn, and reports their outcome. What a job does is its own business.

use std::panic::resume_unwind;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::Duration;
use std::{io, thread};

use hil_cable::CableError;
use hil_core::endpoint::PortError;
use hil_protocol::SettingsError;
use hil_protocol::body::HelloStatus;
use hil_transport::socket::SocketError;
use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::time::TimeValLike;

use super::component;
use super::heartbeat::{Heartbeat, Heartbeats};
use crate::gateway::process::GatewayWatch;
use crate::gateway::timestamping::TimestampingSetup;
use crate::{adapter, cable, gateway, witness};
use hil_platform::clock::MonotonicClock;
use hil_platform::open_files;
use hil_platform::realtime::{self, RealtimeGrant, RealtimeRequest, SpinAdvice};
use hil_platform::wait::WaitMode;
use hil_rundir::file_fault::FileFault;
use hil_rundir::launch::{LaunchError, Work, WorkerLaunch, read};
use hil_rundir::pipe::{
    ChannelProgress, Failure, FailureKind, FromProcess, Orders, ProcessReport, say,
};
use hil_rundir::record::{RecordFileError, Recorder};
use hil_shm::{ChannelError, Domain, DomainError};
use hil_topology::emulation::EmulationError;
use hil_topology::registry::{CaseError, Registry};

const PROGRESS_PERIOD: Duration = Duration::from_millis(250);
/// How often a gateway looks at its peer's answers and at orders to its links.
const WATCH_PERIOD: Duration = Duration::from_millis(5);
/// Stands for the skipped ticks of a role that never ticks.
pub(crate) const NO_TIMER: u64 = u64::MAX;

/// Why a process of the run cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum WorkerError {
    /// One of its threads panicked.
    #[error("a thread panicked")]
    Panicked,
    /// The launch file.
    #[error(transparent)]
    Launch(#[from] LaunchError),
    /// A case that this program does not know.
    #[error("this binary has no case {0}; it was built without the case the supervisor knows")]
    UnknownCase(String),
    /// A role that the case does not have.
    #[error("case {case} has no role {role}")]
    UnknownRole {
        /// The case.
        case: String,
        /// The role asked for.
        role: String,
    },
    /// The case refused its parameters.
    #[error(transparent)]
    Case(#[from] CaseError),
    /// A port of the component and its channel do not fit each other.
    #[error(transparent)]
    Ports(#[from] PortError),
    /// The shared-memory domain.
    #[error(transparent)]
    Domain(#[from] DomainError),
    /// A channel.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// A record file.
    #[error(transparent)]
    Record(#[from] RecordFileError),
    /// A socket could not be set up.
    #[error(transparent)]
    Open(#[from] SocketError),
    /// A transport that this program does not have.
    #[error("there is no transport called `{0}`")]
    UnknownTransport(String),
    /// The kernel does not tell a socket's address.
    #[error("cannot read the address of a socket: {0}")]
    Address(io::Error),
    /// The bridge refused its settings.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// A link model refused its parameters or its trace.
    #[error("emulated link: {0}")]
    Emulation(#[from] EmulationError),
    /// The clocks.
    #[error("cannot read the clocks: {0}")]
    Clock(io::Error),
    /// A socket broke.
    #[error("the socket is broken: {0}")]
    Socket(io::Error),
    /// Waiting failed.
    #[error("cannot wait: {0}")]
    Wait(io::Error),
    /// No thread.
    #[error("cannot start a thread: {0}")]
    Thread(io::Error),
    /// What it has open cannot be kept from processes that the role may start.
    #[error("cannot list its open files: {0}")]
    OpenFiles(io::Error),
    /// The run's secret, without which its hops are not opened.
    #[error("the supervisor did not give the run's secret")]
    SecretMissing,
    /// No random session number.
    #[error("cannot choose a session number: {0}")]
    Session(io::Error),
    /// The other end does not want this channel.
    #[error("the gateway at the other end refused the channel: {}", .0.label())]
    Refused(HelloStatus),
    /// A program's frames cannot be carried.
    #[error(transparent)]
    Cable(#[from] CableError),
    /// The process that becomes a program could not be started.
    #[error("cannot start {program}: {source}")]
    Program {
        /// The program.
        program: String,
        /// What the kernel answered.
        source: io::Error,
    },
    /// A program failed.
    #[error("{program} {end}")]
    ProgramEnded {
        /// The program.
        program: String,
        /// How.
        end: String,
    },
    /// A record file could not be written any more.
    #[error("cannot record: {0}; messages after that would be in no account")]
    Unrecorded(FileFault),
}

impl WorkerError {
    /// What it means for whoever would try again.
    fn kind(&self) -> FailureKind {
        match self {
            Self::Open(SocketError::Refused { source, .. })
            | Self::Address(source)
            | Self::Clock(source)
            | Self::Socket(source)
            | Self::Wait(source)
            | Self::Thread(source)
            | Self::Session(source) => FailureKind::of(source),
            Self::Channel(ChannelError::NoRoom { .. }) => FailureKind::HostTooSmall,
            Self::ProgramEnded { .. } => FailureKind::ProgramEnded,
            _ => FailureKind::Fault,
        }
    }
}

/// One thread of a worker, opened and not yet connected.
pub(crate) struct Job<'a> {
    /// Name of the thread.
    pub(crate) name: String,
    /// What it counts for whoever watches the run.
    pub(crate) counters: Vec<Counter>,
    /// Whether it is watched that its loop turns.
    pub(crate) is_watched: bool,
    /// Joins the channels, in the thread.
    pub(crate) connect: Connect<'a>,
}

/// How a job joins its channels.
pub(crate) type Connect<'a> =
    Box<dyn FnOnce(&mut JobThread) -> Result<Box<dyn JobWork + 'a>, WorkerError> + Send + 'a>;

/// The thread of a job as the job sees it.
#[derive(Debug, Default)]
pub(crate) struct JobThread {
    grant: Option<RealtimeGrant>,
}

impl JobThread {
    /// Asks the kernel for what the thread is to have from here on, for the report to tell.
    pub(crate) fn claim(&mut self, request: &RealtimeRequest) {
        self.grant = Some(realtime::apply(request));
    }
}

/// What a connected job does: its thread takes one step after another until the process is told to stop. A
/// step fails when a channel or a socket itself breaks.
pub(crate) trait JobWork {
    /// What comes before the first step; false when told to stop before it.
    fn begin(&mut self, orders: &Orders) -> Result<bool, WorkerError> {
        Ok(orders.wait_for_start())
    }

    /// Does what there is to do now, without waiting; false when there was nothing.
    fn step(&mut self) -> Result<bool, WorkerError>;

    /// Waits for the next thing to do.
    fn rest(&mut self) -> Result<(), WorkerError>;

    /// Ends what is under way after the last step, also where a step failed, as `stepped` says.
    fn finish(&mut self, stepped: Result<(), WorkerError>) -> Result<(), WorkerError> {
        stepped
    }

    /// Its part of the report of the process.
    fn report(&mut self) -> ProcessReport;

    /// The loop of every thread of a worker.
    fn run(&mut self, orders: &Orders, heartbeat: &Heartbeat) -> Result<(), WorkerError> {
        if !self.begin(orders)? {
            return Ok(());
        }
        let mut stepped = Ok(());
        while stepped.is_ok() && !orders.is_stopping() {
            stepped = self
                .step()
                .and_then(|has_moved| if has_moved { Ok(()) } else { self.rest() });
            heartbeat.beat();
        }
        self.finish(stepped)
    }
}

/// How many messages of a channel went which way.
#[derive(Debug, Clone)]
pub(crate) struct Counter {
    pub(crate) channel: String,
    pub(crate) what: &'static str,
    pub(crate) count: Arc<AtomicU64>,
}

impl Counter {
    /// Counts in `count` how many messages of `channel` were, e.g., `"taken"`.
    pub(crate) fn new(channel: &str, what: &'static str, count: &Arc<AtomicU64>) -> Self {
        Self {
            channel: channel.to_owned(),
            what,
            count: Arc::clone(count),
        }
    }
}

/// A worker whose files and sockets are open.
#[derive(Default)]
pub(crate) struct Opened<'a> {
    pub(crate) jobs: Vec<Job<'a>>,
    /// Held until the end, so that the kernel never switches receive stamps off in between.
    pub(crate) armed: Option<TimestampingSetup>,
    /// What a gateway looks after beside its jobs.
    pub(crate) gateway: Option<GatewayWatch<'a>>,
    /// Ticks that passed without the role of a component; [`NO_TIMER`] for one that has none.
    pub(crate) skipped_ticks: Option<Arc<AtomicU64>>,
}

/// What a job's thread tells the process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Word {
    Connected,
    Ended,
}

/// Tells of the thread's end, however it ends.
struct EndTeller(Sender<Word>);

impl Drop for EndTeller {
    fn drop(&mut self) {
        // The process listens until the last thread is joined.
        let _left = self.0.send(Word::Ended).is_err();
    }
}

/// Runs the process described by the launch file until told to stop.
///
/// # Errors
/// When something cannot be opened or breaks; the supervisor is told as well.
pub fn run(launch: &Path, registry: &Registry) -> Result<(), WorkerError> {
    let outcome = open_and_run(launch, registry);
    if let Err(error) = &outcome {
        if let WorkerError::Record(RecordFileError::Io { path, source }) = error {
            say(&FromProcess::Unwritable(FileFault::new(path, source)));
        }
        say(&FromProcess::Failed(Failure {
            kind: error.kind(),
            text: error.to_string(),
        }));
    }
    outcome
}

fn open_and_run(path: &Path, registry: &Registry) -> Result<(), WorkerError> {
    let orders = Orders::listen().map_err(WorkerError::Thread)?;
    let launch: WorkerLaunch = read(path)?;
    let mut recorder = Recorder::new(&launch.records, &launch.process, launch.instance);
    let opened = match &launch.work {
        Work::Component(work) => component::open(&launch, work, registry, &mut recorder),
        Work::Gateway(work) => gateway::process::open(&launch, work, &orders, &mut recorder),
        Work::Adapter(work) => adapter::process::open(&launch, work, &mut recorder),
        Work::Cable(work) => cable::open(&launch, work, &orders, &mut recorder),
        Work::Witness(work) => witness::open(&launch, work, &orders, &mut recorder),
    }?;
    let stop = Arc::clone(orders.stop_flag());
    recorder
        .start_and_tell(move |fault| {
            stop.store(true, Ordering::Release);
            say(&FromProcess::Unwritable(fault.clone()));
        })
        .map_err(WorkerError::Thread)?;
    let mut report = ProcessReport::default();
    let outcome = run_jobs(opened, &orders, &mut report);
    let written = recorder.finish();
    let unrecorded = written.failures.first().cloned();
    report.recorder_dropped = written.dropped_count;
    report.recorder_failures = written.failures;
    add_usage(&mut report);
    say(&FromProcess::Finished(Box::new(report)));
    match (outcome, &launch.work) {
        // A role is the user's code, and its process may be started again; a panic of ours is a fault.
        (Err(WorkerError::Panicked), Work::Component(_)) => resume_unwind(Box::new(())),
        (outcome, _) => outcome,
    }
    .and(if written.has_panicked {
        Err(WorkerError::Panicked)
    } else {
        Ok(())
    })
    .and(unrecorded.map_or(Ok(()), |fault| Err(WorkerError::Unrecorded(fault))))
}

/// The shared memory that `launch` names.
pub(crate) fn open_domain(launch: &WorkerLaunch) -> Result<Domain, WorkerError> {
    let address = launch.domain.parse().map_err(DomainError::Address)?;
    Ok(Domain::open(&address)?)
}

/// Starts a thread for each job, watches them until one ends or the process is told to stop, and adds
/// to `report` what they report.
///
/// # Errors
/// The first of the jobs' errors, or the panic of one.
fn run_jobs(
    opened: Opened<'_>,
    orders: &Orders,
    report: &mut ProcessReport,
) -> Result<(), WorkerError> {
    let Opened {
        jobs,
        armed,
        mut gateway,
        skipped_ticks,
    } = opened;
    let counters = jobs.iter().flat_map(|job| job.counters.clone());
    let mut counters: Vec<(Counter, Option<u64>)> = counters.map(|one| (one, None)).collect();
    let jobs = jobs.into_iter().map(|job| (job, Heartbeat::default()));
    let jobs: Vec<_> = jobs.collect();
    let watched = jobs.iter().filter(|(job, _)| job.is_watched);
    let mut heartbeats = Heartbeats::of(watched.map(|(_, heartbeat)| heartbeat.clone()));
    let job_count = jobs.len();
    let stop = || orders.stop_flag().store(true, Ordering::Release);
    // This end is kept: without a job the process still waits for its orders.
    let (sender, words) = channel();
    let mut facts = armed
        .as_ref()
        .map_or_else(Vec::new, |armed| armed.facts.clone());
    thread::scope(|scope| {
        let mut outcome = Ok(());
        let mut threads = Vec::new();
        for (job, heartbeat) in jobs {
            let (name, sender) = (job.name.clone(), sender.clone());
            let spawned = thread::Builder::new()
                .name(name.clone())
                .spawn_scoped(scope, move || run_job(job, orders, &heartbeat, sender));
            match spawned {
                Ok(thread) => threads.push((name, thread)),
                Err(error) => {
                    outcome = Err(WorkerError::Thread(error));
                    stop();
                }
            }
        }
        let period = gateway.as_ref().map_or(PROGRESS_PERIOD, |_| WATCH_PERIOD);
        let (mut connected_count, mut is_ready) = (0, false);
        let mut told = MonotonicClock::now();
        while !orders.is_stopping() {
            let now = MonotonicClock::now();
            if connected_count == job_count {
                if !is_ready && gateway.as_mut().is_none_or(|one| one.is_ready(now)) {
                    is_ready = true;
                    // A role may start programs, which must not get the shared memory of the run.
                    if let Err(error) = open_files::withhold() {
                        outcome = Err(WorkerError::OpenFiles(error));
                        break;
                    }
                    say(&FromProcess::Ready);
                }
                if let Some(gateway) = &mut gateway {
                    gateway.look_after(now, is_ready);
                }
                if now.saturating_duration_since(told) >= PROGRESS_PERIOD {
                    told = now;
                    say_progress(&mut counters, &mut heartbeats, skipped_ticks.as_deref());
                }
            }
            match words.recv_timeout(period) {
                Ok(Word::Connected) => connected_count += 1,
                Ok(Word::Ended) | Err(RecvTimeoutError::Disconnected) => break,
                Err(RecvTimeoutError::Timeout) => {}
            }
        }
        stop();
        facts.extend(gateway.and_then(GatewayWatch::finish));
        for (name, thread) in threads {
            match thread.join() {
                Ok(ended) => {
                    report.realtime.extend(ended.grant.map(|one| (name, one)));
                    add(report, ended.report, &facts);
                    outcome = outcome.and(ended.outcome);
                }
                // The thread's own message is on standard error.
                Err(_payload) => outcome = Err(WorkerError::Panicked),
            }
        }
        outcome
    })
}

/// How a job ended.
struct Ended {
    grant: Option<RealtimeGrant>,
    report: ProcessReport,
    outcome: Result<(), WorkerError>,
}

fn run_job(job: Job<'_>, orders: &Orders, heartbeat: &Heartbeat, sender: Sender<Word>) -> Ended {
    let end = EndTeller(sender);
    let mut thread = JobThread::default();
    let mut report = ProcessReport::default();
    let outcome = (job.connect)(&mut thread).and_then(|mut work| {
        // The process waits for this word; it cannot have left.
        let _left = end.0.send(Word::Connected).is_err();
        let outcome = work.run(orders, heartbeat);
        report = work.report();
        outcome
    });
    Ended {
        grant: thread.grant,
        report,
        outcome,
    }
}

/// Adds what one job reports; `facts` are known of the stamps of every direction and arm.
fn add(report: &mut ProcessReport, other: ProcessReport, facts: &[(String, String)]) {
    report.preparation_s = report.preparation_s.or(other.preparation_s);
    report.skipped_ticks += other.skipped_ticks;
    report.ticks += other.ticks;
    report.malformed_count += other.malformed_count;
    report.outbox_dropped += other.outbox_dropped;
    report.connection_failures += other.connection_failures;
    let directions = other.directions.into_iter().map(|mut direction| {
        direction.facts.extend_from_slice(facts);
        direction
    });
    report.directions.extend(directions);
    let arms = other.faces.into_iter().map(|mut arm| {
        arm.facts.extend_from_slice(facts);
        arm
    });
    report.faces.extend(arms);
    report.inlets.extend(other.inlets);
}

/// Says how many messages passed on the channels on which any did since it was said last, that the threads
/// turn, if they do, and what ticks passed without the role.
fn say_progress(
    counters: &mut [(Counter, Option<u64>)],
    heartbeats: &mut Heartbeats,
    skipped_ticks: Option<&AtomicU64>,
) {
    let mut progress = Vec::new();
    for (counter, said) in counters {
        let count = counter.count.load(Ordering::Relaxed);
        if said.replace(count) != Some(count) {
            progress.push(ChannelProgress {
                channel: counter.channel.clone(),
                what: counter.what.to_owned(),
                count,
            });
        }
    }
    if !progress.is_empty() {
        say(&FromProcess::Progress(progress));
    }
    if heartbeats.have_all_turned() {
        say(&FromProcess::Alive);
    }
    let skipped = skipped_ticks.map_or(NO_TIMER, |count| count.load(Ordering::Relaxed));
    if skipped != NO_TIMER {
        say(&FromProcess::SkippedTicks(skipped));
    }
}

/// Says what a spinning thread, named at the beginning of what is said, will lose or take on its CPU.
pub(crate) fn warn_of_spinning(name: &str, wait: WaitMode, cpu: Option<usize>) {
    if wait != WaitMode::Spin {
        return;
    }
    let text = match cpu.map(realtime::spin_advice) {
        Some(SpinAdvice::Fine) => return,
        Some(SpinAdvice::Warn(why)) => format!("{name}wait = spin: {why}"),
        None => format!("{name}wait = spin without a cpu of its own"),
    };
    say(&FromProcess::Warning(text));
}

/// Fills the usage figures of `report` for the calling process; leaves them zero if the kernel
/// does not tell, which Linux never does for one's own process.
fn add_usage(report: &mut ProcessReport) {
    if let Ok(usage) = getrusage(UsageWho::RUSAGE_SELF) {
        let cpu_us = usage.user_time().num_microseconds() + usage.system_time().num_microseconds();
        report.cpu_s = cpu_us as f64 * 1e-6;
        report.voluntary_switches = usage.voluntary_context_switches().unsigned_abs();
        report.involuntary_switches = usage.involuntary_context_switches().unsigned_abs();
    }
}

#[cfg(test)]
mod tests {
    use std::io::{BufReader, pipe};
    use std::panic::panic_any;

    use super::*;

    /// Works until told to stop, or panics at once.
    struct Counting {
        panics: bool,
    }

    impl JobWork for Counting {
        fn begin(&mut self, _orders: &Orders) -> Result<bool, WorkerError> {
            if self.panics {
                panic_any("planted");
            }
            Ok(true)
        }

        fn step(&mut self) -> Result<bool, WorkerError> {
            Ok(false)
        }

        fn rest(&mut self) -> Result<(), WorkerError> {
            thread::yield_now();
            Ok(())
        }

        fn report(&mut self) -> ProcessReport {
            ProcessReport {
                malformed_count: 7,
                ..ProcessReport::default()
            }
        }
    }

    fn job(panics: bool) -> Job<'static> {
        Job {
            name: "counting".to_owned(),
            counters: Vec::new(),
            is_watched: false,
            connect: Box::new(move |_| Ok(Box::new(Counting { panics }))),
        }
    }

    #[test]
    fn a_panic_of_a_thread_is_an_error_and_the_others_report_what_they_counted() {
        // The supervisor stays, so it is the panic that ends the process.
        let (orders_in, _supervisor) = pipe().unwrap();
        let orders = Orders::from_input(BufReader::new(orders_in)).unwrap();
        let opened = Opened {
            jobs: vec![job(false), job(true), job(false)],
            ..Opened::default()
        };
        let mut report = ProcessReport::default();
        let outcome = run_jobs(opened, &orders, &mut report);
        assert!(orders.is_stopping());
        assert!(matches!(outcome, Err(WorkerError::Panicked)), "{outcome:?}");
        assert_eq!(report.malformed_count, 14);
    }
}
