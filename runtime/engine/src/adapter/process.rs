//! What the process of an adapter opens: one thread per arm, and one that takes what the protocol has no
//! place for. The process's own thread opens and arms the sockets, because kernel stamps are switched
//! on by a worker that a spinning real-time thread would starve.

use std::net::SocketAddr;
use std::sync::Arc;

use hil_transport::probe::{DISCARD_PORT, ProbeSettings};

use super::opening::{JoinedArm, OpenedArm};
use super::spare::Spare;
use crate::gateway::socket::timestamp_mode;
use crate::gateway::timestamping::{PROBE_BOUND, arm_and_describe};
use crate::process::worker::{
    Counter, Job, JobWork, Opened, WorkerError, open_domain, warn_of_spinning,
};
use hil_rundir::launch::{AdapterSettings, ArmLaunch, WorkerLaunch};
use hil_rundir::pipe::{Orders, ProcessReport};
use hil_rundir::record::Recorder;
use hil_shm::Domain;
use hil_topology::{AdapterKind, Timestamps};

/// Opens the sockets and record files of the adapter of `launch`; call it from a thread of normal
/// priority.
///
/// # Errors
/// When a socket or file cannot be opened.
pub(crate) fn open<'a>(
    launch: &'a WorkerLaunch,
    adapter: &'a AdapterSettings,
    recorder: &mut Recorder,
) -> Result<Opened<'a>, WorkerError> {
    let domain = Arc::new(open_domain(launch)?);
    let armed = arm_and_describe(probe_settings(adapter));
    let mut jobs = Vec::new();
    for arm in &adapter.arms {
        let opened = OpenedArm::open(adapter, arm, recorder)?;
        warn_of_spinning(
            &format!("{}: ", arm.arm.word()),
            adapter.wait,
            arm.realtime.cpu,
        );
        jobs.push(job(adapter, arm, opened, Arc::clone(&domain)));
    }
    let spare = Spare::open(&adapter.spare, recorder)?;
    if !adapter.spare.is_empty() {
        jobs.push(Job {
            name: "spare".to_owned(),
            counters: Vec::new(),
            is_watched: false,
            connect: Box::new(move |_thread| Ok(Box::new(spare.connect(&domain)?))),
        });
    }
    Ok(Opened {
        jobs,
        armed: Some(armed),
        ..Opened::default()
    })
}

fn probe_settings(adapter: &AdapterSettings) -> Option<ProbeSettings> {
    // A robot that speaks first has no address yet, and then loopback is probed.
    let target = (adapter.egm.kind == AdapterKind::Robot)
        .then(|| adapter.arms.first())
        .flatten()
        .map(|arm| SocketAddr::new(arm.address.ip(), DISCARD_PORT));
    (adapter.egm.timestamps != Timestamps::Off).then(|| ProbeSettings {
        timestamps: timestamp_mode(adapter.egm.timestamps),
        interface: adapter.interface.clone().filter(|_| target.is_some()),
        transmit_target: target,
        proof_count: 5,
        bound: PROBE_BOUND,
    })
}

/// The job of one arm.
fn job<'a>(
    adapter: &'a AdapterSettings,
    arm: &'a ArmLaunch,
    opened: OpenedArm,
    domain: Arc<Domain>,
) -> Job<'a> {
    let [taken, given] = &opened.counts;
    Job {
        name: format!("egm {}", arm.arm.word()),
        counters: vec![
            Counter::new(&arm.input.name, "taken", taken),
            Counter::new(&arm.output.name, "published", given),
        ],
        is_watched: true,
        connect: Box::new(move |thread| {
            thread.claim(&arm.realtime);
            Ok(Box::new(opened.connect(adapter, arm, &domain)?))
        }),
    }
}

impl JobWork for JoinedArm {
    fn begin(&mut self, orders: &Orders) -> Result<bool, WorkerError> {
        let has_started = orders.wait_for_start();
        if has_started {
            self.clear()?;
        }
        Ok(has_started)
    }

    fn step(&mut self) -> Result<bool, WorkerError> {
        Self::step(self)
    }

    fn rest(&mut self) -> Result<(), WorkerError> {
        Self::rest(self)
    }

    fn finish(&mut self, stepped: Result<(), WorkerError>) -> Result<(), WorkerError> {
        stepped.and_then(|()| Self::finish(self))
    }

    fn report(&mut self) -> ProcessReport {
        ProcessReport {
            faces: vec![Self::report(self)],
            ..ProcessReport::default()
        }
    }
}
