//! The process of one link's gateway on one host: one thread per channel direction. This thread
//! opens and arms the sockets, because kernel stamps are switched on by a worker that a spinning
//! real-time thread would starve; then it only reports.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use super::connection::Connection;
use super::direction::Opened;
use super::link_control::LinkControl;
use super::opening::{OpenSockets, open_sockets};
use super::{GatewayError, Surroundings};
use hil_core::time::Instant;

use crate::process::pulse::Pulses;
use crate::process::usage::add_usage;
use hil_nic::radio::sampler::Sampler;
use hil_platform::clock::MonotonicClock;
use hil_platform::realtime;
use hil_platform::realtime::{RealtimeGrant, SpinAdvice};
use hil_platform::wait::WaitMode;
use hil_rundir::launch::{DirectionLaunch, GatewayLaunch, Side, read};
use hil_rundir::pipe::{ChannelProgress, DirectionReport, FromProcess, Orders, ProcessReport, say};
use hil_rundir::record::Recorder;
use hil_shm::{Domain, DomainError};

const PROGRESS_PERIOD: Duration = Duration::from_millis(250);
/// How often orders and threads are looked at.
const WATCH_PERIOD: Duration = Duration::from_millis(5);
/// How long the run's secret may take, which the supervisor writes as soon as the process is there.
const SEAL_PATIENCE: Duration = Duration::from_secs(5);
/// How long each half of the stamp probe may take; a restart must not wait long for it.
pub(crate) const PROBE_BOUND: Duration = Duration::from_millis(300);

/// Runs the gateway described by the launch file until told to stop.
///
/// # Errors
/// When a socket or channel cannot be opened or breaks; the supervisor is told as well.
pub fn run(launch: &Path) -> Result<(), GatewayError> {
    let outcome = prepare_and_live(launch);
    if let Err(error) = &outcome {
        say(&FromProcess::Failed(error.to_string()));
    }
    outcome
}

fn prepare_and_live(path: &Path) -> Result<(), GatewayError> {
    let orders = Orders::listen().map_err(GatewayError::Thread)?;
    let launch: GatewayLaunch = read(path)?;
    let seal = launch
        .is_sealed
        .then(|| orders.wait_for_seal(SEAL_PATIENCE));
    if matches!(seal, Some(None)) {
        return Err(GatewayError::SecretMissing);
    }
    let seal = seal.flatten();
    let domain = Domain::open(&launch.domain.parse().map_err(DomainError::Address)?)?;
    let surroundings = Arc::new(Surroundings::new(domain)?);
    warn_of_shared_cpus(&launch);
    let mut recorder = Recorder::new(&launch.records, &launch.process, launch.instance);
    let sockets = open_sockets(&launch, &orders, seal.as_ref(), &surroundings)?;
    let Some(OpenSockets { mut armed, sockets }) = sockets else {
        return finish(Vec::new(), recorder, &[]);
    };
    let mut opened = Vec::new();
    for (direction, (socket, plan)) in launch.directions.iter().zip(sockets) {
        let one = Opened::new(direction, &mut recorder, socket, plan)?;
        opened.push((direction, one));
    }
    let sampler = armed.prepare_sampler(&launch.process, &mut recorder);
    let switches = opened.iter_mut().filter_map(|(_, one)| one.take_switch());
    let switches = switches.collect();
    let mut control = LinkControl::open(&surroundings.domain, &launch, switches)?;
    let on_failure = orders.stopper();
    recorder
        .start_and_tell(on_failure)
        .map_err(GatewayError::Thread)?;
    let stop = Arc::clone(&surroundings.stop);
    let sampler = sampler.map(|one| one.start(stop)).transpose()?;
    let counters: Vec<Counter> = opened
        .iter()
        .map(|(launch, one)| counter(launch, one))
        .collect();
    let established: Vec<_> = opened.iter().map(|(_, one)| one.is_established()).collect();
    let mut pulses = Pulses::of(opened.iter().map(|(_, one)| one.pulse()));
    let mut watched: Vec<_> = opened
        .iter()
        .filter_map(|(launch, one)| Some(Connection::new(launch, one.tally()?)))
        .collect();
    let (sender, ready) = channel();
    let mut threads = Vec::new();
    for (direction, one) in opened {
        warn_of_spinning(&direction.channel, direction.wait, direction.realtime.cpu);
        threads.push(spawn(
            direction.clone(),
            one,
            Arc::clone(&surroundings),
            sender.clone(),
        )?);
    }
    drop(sender);
    if wait_until_open(&ready, threads.len()) {
        let patience = launch.ready_within.map(|within| Patience {
            until: MonotonicClock::now() + within,
            launch: &launch,
        });
        let hops = (counters.as_slice(), established.as_slice());
        let beside = (watched.as_mut_slice(), &mut control, &mut pulses);
        watch(&orders, &threads, hops, (beside, patience));
    }
    surroundings.stop.store(true, Ordering::Release);
    armed.facts.extend(sampler.map(Sampler::finish));
    finish(threads, recorder, &armed.facts)
}

/// A gateway that is ready without its peer after a while.
struct Patience<'a> {
    until: Instant,
    launch: &'a GatewayLaunch,
}

impl Patience<'_> {
    fn warning(&self) -> String {
        let peers = self.launch.directions.iter();
        let peers: Vec<String> = peers.map(|one| one.peer.to_string()).collect();
        let within_s = self.launch.ready_within.unwrap_or_default().as_secs_f64();
        let peers = peers.join(", ");
        let then = match self.launch.instance {
            0 => "the run begins without it",
            _ => "it goes on asking",
        };
        format!("no answer from {peers} within {within_s:.1} s: {then}")
    }
}

/// Says when every direction is ready and how many messages passed, until told to stop or a
/// thread ends.
fn watch(
    orders: &Orders,
    threads: &[JoinHandle<Lived>],
    (counters, established): (&[Counter], &[Arc<AtomicBool>]),
    ((connections, control, pulses), patience): (
        (&mut [Connection], &mut LinkControl, &mut Pulses),
        Option<Patience<'_>>,
    ),
) {
    let mut is_ready = false;
    let mut told = MonotonicClock::now();
    while !orders.is_stopping() && !threads.iter().any(JoinHandle::is_finished) {
        let now = MonotonicClock::now();
        // Messages published before the peer has greeted back would be refused.
        if !is_ready {
            let is_established = established.iter().all(|one| one.load(Ordering::Acquire));
            let given_up = patience.as_ref().filter(|patience| now >= patience.until);
            if let Some(patience) = given_up.filter(|_| !is_established) {
                say(&FromProcess::Warning(patience.warning()));
            }
            is_ready = is_established || given_up.is_some();
            if is_ready {
                say(&FromProcess::Ready);
            }
        }
        if now.saturating_duration_since(told) >= PROGRESS_PERIOD {
            told = now;
            report_progress(counters);
            say_if_alive(pulses);
        }
        if is_ready {
            for connection in &mut *connections {
                connection.tell(now);
            }
        }
        control.attend();
        thread::sleep(WATCH_PERIOD);
    }
}

/// Channel, what happened to its messages, and how many.
pub(crate) type Counter = (String, &'static str, Arc<AtomicU64>);

fn counter(launch: &DirectionLaunch, opened: &Opened) -> Counter {
    let what = match launch.side {
        Side::Egress => "sent",
        Side::Ingress => "received",
    };
    (launch.channel.clone(), what, opened.count())
}

/// Says that the threads of this process turn, if they do.
pub(crate) fn say_if_alive(pulses: &mut Pulses) {
    if pulses.have_all_beaten() {
        say(&FromProcess::Alive);
    }
}

pub(crate) fn report_progress(counters: &[Counter]) {
    let progress = counters
        .iter()
        .map(|(channel, what, count)| ChannelProgress {
            channel: channel.clone(),
            what: (*what).to_owned(),
            count: count.load(Ordering::Relaxed),
        });
    say(&FromProcess::Progress(progress.collect()));
}

/// One direction's thread: its real-time grant, then its counters and outcome.
struct Lived {
    grant: RealtimeGrant,
    /// `None` when it could not connect.
    report: Option<DirectionReport>,
    outcome: Result<(), GatewayError>,
}

fn spawn(
    launch: DirectionLaunch,
    opened: Opened,
    surroundings: Arc<Surroundings>,
    ready: Sender<bool>,
) -> Result<JoinHandle<Lived>, GatewayError> {
    let name = match launch.side {
        Side::Egress => format!("out {}", launch.channel),
        Side::Ingress => format!("in {}", launch.channel),
    };
    let live = move || {
        let grant = realtime::apply(&launch.realtime);
        match opened.connect(&launch, &surroundings) {
            Ok(mut direction) => {
                // The process waits for this word; it cannot have left.
                let _left = ready.send(true).is_err();
                let outcome = direction.run();
                Lived {
                    grant,
                    report: Some(direction.report(&launch)),
                    outcome,
                }
            }
            Err(error) => {
                let _left = ready.send(false).is_err();
                Lived {
                    grant,
                    report: None,
                    outcome: Err(error),
                }
            }
        }
    };
    thread::Builder::new()
        .name(name)
        .spawn(live)
        .map_err(GatewayError::Thread)
}

/// True when all of `count` threads said that they are open.
pub(crate) fn wait_until_open(ready: &Receiver<bool>, count: usize) -> bool {
    let opened = (0..count).filter(|_| ready.recv() == Ok(true)).count();
    opened == count
}

fn finish(
    threads: Vec<JoinHandle<Lived>>,
    recorder: Recorder,
    stamp_facts: &[(String, String)],
) -> Result<(), GatewayError> {
    let mut report = ProcessReport::default();
    let mut outcome = Ok(());
    for thread in threads {
        let name = thread.thread().name().unwrap_or("gateway").to_owned();
        match thread.join() {
            Ok(lived) => {
                report.realtime.push((name, lived.grant));
                report.directions.extend(lived.report.map(|mut direction| {
                    direction.facts.extend_from_slice(stamp_facts);
                    direction
                }));
                outcome = outcome.and(lived.outcome);
            }
            Err(_) => outcome = outcome.and(Err(GatewayError::Panicked)),
        }
    }
    let written = recorder.finish();
    let problem = written.problem();
    report.recorder_dropped = written.dropped_count;
    report.recorder_failures = written.failures;
    add_usage(&mut report);
    say(&FromProcess::Finished(Box::new(report)));
    outcome.and(problem.map_or(Ok(()), |text| Err(GatewayError::Unrecorded(text))))
}

/// Says what a spinning thread, of the channel or arm `name`, will lose or take on its CPU.
pub(crate) fn warn_of_spinning(name: &str, wait: WaitMode, cpu: Option<usize>) {
    if wait != WaitMode::Spin {
        return;
    }
    match cpu.map(realtime::spin_advice) {
        Some(SpinAdvice::Fine) => {}
        Some(SpinAdvice::Warn(why)) => {
            say(&FromProcess::Warning(format!("{name}: wait = spin: {why}")));
        }
        None => {
            let text = format!("{name}: wait = spin without a cpu of its own");
            say(&FromProcess::Warning(text));
        }
    }
}

/// Threads that spin on one CPU wait for each other, and the wait shows as delay.
fn warn_of_shared_cpus(launch: &GatewayLaunch) {
    let mut spinning: BTreeMap<usize, Vec<&str>> = BTreeMap::new();
    for direction in launch
        .directions
        .iter()
        .filter(|one| one.wait == WaitMode::Spin)
    {
        if let Some(cpu) = direction.realtime.cpu {
            spinning.entry(cpu).or_default().push(&direction.channel);
        }
    }
    for (cpu, channels) in spinning
        .into_iter()
        .filter(|(_, channels)| channels.len() > 1)
    {
        let text = format!(
            "wait = spin: the threads of {} share CPU {cpu}; list one CPU for each in \
             gateway.cpu",
            channels.join(" and ")
        );
        say(&FromProcess::Warning(text));
    }
}
