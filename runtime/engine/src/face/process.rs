//! The process of a face: one thread per arm, and one that takes what the protocol has no place
//! for. This thread opens and arms the sockets, because kernel stamps are switched on by a worker
//! that a spinning real-time thread would starve; then it only reports.

use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Sender, channel};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use hil_transport::probe::{DISCARD_PORT, ProbeSettings};

use super::opening::OpenedArm;
use super::spare::Spare;
use super::{FaceError, Gate};
use crate::gateway::GatewayError;
use crate::gateway::arming::arm_and_describe;
use crate::gateway::process::{
    Counter, PROBE_BOUND, report_progress, say_if_alive, wait_until_open, warn_of_spinning,
};
use crate::gateway::socket::timestamp_mode;
use crate::process::pulse::Pulses;
use crate::process::usage::add_usage;
use hil_platform::clock::MonotonicClock;
use hil_platform::realtime;
use hil_platform::realtime::RealtimeGrant;
use hil_rundir::face_launch::{ArmLaunch, FaceLaunch};
use hil_rundir::launch::read;
use hil_rundir::pipe::{FaceReport, FromProcess, Orders, ProcessReport, say};
use hil_rundir::record::Recorder;
use hil_shm::{Domain, DomainError};
use hil_topology::{FaceKind, Timestamps};

const PROGRESS_PERIOD: Duration = Duration::from_millis(250);
/// How often orders and threads are looked at.
const WATCH_PERIOD: Duration = Duration::from_millis(5);

/// Runs the face described by the launch file until told to stop.
///
/// # Errors
/// When a socket or channel cannot be opened or breaks; the supervisor is told as well.
pub fn run(launch: &Path) -> Result<(), FaceError> {
    let outcome = prepare_and_live(launch);
    if let Err(error) = &outcome {
        say(&FromProcess::Failed(error.to_string()));
    }
    outcome
}

fn prepare_and_live(path: &Path) -> Result<(), FaceError> {
    let orders = Orders::listen().map_err(GatewayError::Thread)?;
    let launch: Arc<FaceLaunch> = Arc::new(read(path)?);
    let domain = Arc::new(Domain::open(
        &launch.domain.parse().map_err(DomainError::Address)?,
    )?);
    let gate = Arc::new(Gate::default());
    // Held until the end, so that the kernel never switches receive stamps off in between.
    let armed = arm_and_describe(probe_settings(&launch));
    let mut recorder = Recorder::new(&launch.records, &launch.process, launch.instance);
    let mut opened = Vec::new();
    for arm in &launch.face.arms {
        opened.push((arm.clone(), OpenedArm::open(&launch, arm, &mut recorder)?));
    }
    let spare = Spare::open(&launch.face.spare, &mut recorder)?;
    let on_failure = orders.stopper();
    recorder
        .start_and_tell(on_failure)
        .map_err(GatewayError::Thread)?;
    let counters: Vec<Counter> = opened
        .iter()
        .flat_map(|(arm, one)| counters(arm, one))
        .collect();
    let mut pulses = Pulses::of(opened.iter().map(|(_, one)| one.pulse.clone()));
    let (sender, ready) = channel();
    let mut threads = Vec::new();
    for (arm, one) in opened {
        warn_of_spinning(arm.arm.word(), launch.wait, arm.realtime.cpu);
        let around = (Arc::clone(&launch), Arc::clone(&domain), Arc::clone(&gate));
        threads.push(spawn(arm, one, around, sender.clone())?);
    }
    let spare = spare.spawn(&domain, &gate)?;
    drop(sender);
    if wait_until_open(&ready, threads.len()) {
        say(&FromProcess::Ready);
        if orders.wait_for_start() {
            gate.open();
            watch(&orders, &threads, &counters, &mut pulses);
        }
    }
    gate.close();
    let spare_report = spare.join().map_err(|_panic| GatewayError::Panicked)?;
    finish(threads, recorder, &armed.facts).and(spare_report)
}

fn probe_settings(launch: &FaceLaunch) -> Option<ProbeSettings> {
    // A robot that speaks first has no address yet, and then loopback is probed.
    let target = (launch.face.kind == FaceKind::Robot)
        .then(|| launch.face.arms.first())
        .flatten()
        .map(|arm| SocketAddr::new(arm.address.ip(), DISCARD_PORT));
    (launch.face.timestamps != Timestamps::Off).then(|| ProbeSettings {
        timestamps: timestamp_mode(launch.face.timestamps),
        interface: launch.face.interface.clone().filter(|_| target.is_some()),
        transmit_target: target,
        proof_count: 5,
        bound: PROBE_BOUND,
    })
}

/// Says how many messages passed, until told to stop or a thread ends.
fn watch(
    orders: &Orders,
    threads: &[JoinHandle<Lived>],
    counters: &[Counter],
    pulses: &mut Pulses,
) {
    let mut told = MonotonicClock::now();
    while !orders.is_stopping() && !threads.iter().any(JoinHandle::is_finished) {
        let now = MonotonicClock::now();
        if now.saturating_duration_since(told) >= PROGRESS_PERIOD {
            told = now;
            report_progress(counters);
            say_if_alive(pulses);
        }
        thread::sleep(WATCH_PERIOD);
    }
}

fn counters(arm: &ArmLaunch, opened: &OpenedArm) -> [Counter; 2] {
    let [taken, given] = &opened.counts;
    [
        (arm.input.name.clone(), "taken", Arc::clone(taken)),
        (arm.output.name.clone(), "published", Arc::clone(given)),
    ]
}

/// One arm's thread: its real-time grant, then its counters and outcome.
struct Lived {
    grant: RealtimeGrant,
    /// `None` when it could not connect.
    report: Option<FaceReport>,
    outcome: Result<(), FaceError>,
}

type Around = (Arc<FaceLaunch>, Arc<Domain>, Arc<Gate>);

fn spawn(
    arm: ArmLaunch,
    opened: OpenedArm,
    around: Around,
    ready: Sender<bool>,
) -> Result<JoinHandle<Lived>, FaceError> {
    let name = format!("egm {}", arm.arm.word());
    let spawned = thread::Builder::new()
        .name(name)
        .spawn(move || live(&arm, opened, &around, &ready));
    Ok(spawned.map_err(GatewayError::Thread)?)
}

fn live(arm: &ArmLaunch, opened: OpenedArm, around: &Around, ready: &Sender<bool>) -> Lived {
    let (launch, domain, gate) = around;
    let grant = realtime::apply(&arm.realtime);
    let mut report = None;
    let outcome = opened.connect(launch, arm, domain).and_then(|mut joined| {
        // The process waits for this word; it cannot have left.
        let _left = ready.send(true).is_err();
        let outcome = if gate.wait_until_open() {
            joined.run(gate.stop_flag())
        } else {
            Ok(())
        };
        report = Some(joined.report());
        outcome
    });
    if outcome.is_err() {
        let _left = ready.send(false).is_err();
    }
    Lived {
        grant,
        report,
        outcome,
    }
}

fn finish(
    threads: Vec<JoinHandle<Lived>>,
    recorder: Recorder,
    stamp_facts: &[(String, String)],
) -> Result<(), FaceError> {
    let mut report = ProcessReport::default();
    let mut outcome = Ok(());
    for thread in threads {
        let name = thread.thread().name().unwrap_or("egm").to_owned();
        match thread.join() {
            Ok(lived) => {
                report.realtime.push((name, lived.grant));
                report.faces.extend(lived.report.map(|mut face| {
                    face.facts.extend_from_slice(stamp_facts);
                    face
                }));
                outcome = outcome.and(lived.outcome);
            }
            Err(_) => outcome = outcome.and(Err(GatewayError::Panicked.into())),
        }
    }
    let written = recorder.finish();
    let problem = written.problem();
    report.recorder_dropped = written.dropped_count;
    report.recorder_failures = written.failures;
    add_usage(&mut report);
    say(&FromProcess::Finished(Box::new(report)));
    outcome.and(problem.map_or(Ok(()), |text| Err(GatewayError::Unrecorded(text).into())))
}
