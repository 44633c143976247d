//! The process of a program with an address inside: it starts the program in namespaces of its own, waits for its
//! end and keeps the [`CableServer`] of its cable. Its Ethernet frames are messages, one each: the gateway of its link
//! fetches and delivers them in the threads that carry them on, so that nobody is woken in between; where the
//! program's channels stay on the host, two threads of this process do. What the frames are, a report finds out.

mod attachment;
mod inward;
mod outward;
mod program;

use std::net::IpAddr;
use std::os::fd::AsFd as _;
use std::process::Stdio;
use std::sync::Arc;

use hil_cable::CableServer;
use hil_core::time::Instant;
use hil_net::handover;
use hil_platform::clock::MonotonicClock;
use hil_platform::own_process;
use hil_platform::signals::Signals;
use hil_platform::wait::{Pause, WaitMode, WaitStrategy};
use hil_rundir::launch::{CableWork, FrameWork, WorkerLaunch};
use hil_rundir::pipe::{Orders, ProcessReport};
use hil_rundir::record::Recorder;
use hil_shm::{Domain, Waiter};

use self::attachment::socket_path;
pub(crate) use self::inward::{Inward, OpenInward};
pub(crate) use self::outward::{OpenOutward, Outward};
use self::program::Program;
use crate::gateway::poll_descriptors;
use crate::process::worker::{
    Counter, Job, JobWork, Opened, WorkerError, open_domain, warn_of_spinning,
};
use crate::supervisor::Child;

/// Records a ring holds: half a second at 128,000 frames a second.
const RING_RECORDS: usize = 65_536;
/// Frames that are moved at the end at most: a program that does not end keeps sending.
const CLEARING_MAX: usize = 65_536;

/// Starts the program, which waits for the run, and opens the record files of its frames.
///
/// # Errors
/// When the program cannot have a cable, or a file cannot be made.
pub(crate) fn open<'a>(
    launch: &'a WorkerLaunch,
    work: &'a CableWork,
    orders: &Orders,
    recorder: &mut Recorder,
) -> Result<Opened<'a>, WorkerError> {
    let signals = Signals::install().map_err(WorkerError::Thread)?;
    let domain = Arc::new(open_domain(launch)?);
    let (child, server) = start(work, &domain)?;
    let program = Program {
        child,
        server,
        name: work.command[0].clone(),
        channels: [&work.output, &work.input].map(|one| one.name.clone()),
        stop: Arc::clone(orders.stop_flag()),
        _signals: signals,
    };
    let mut jobs = match &work.frames {
        Some(frames) => frame_jobs(work, frames, &domain, orders, recorder)?
            .into_iter()
            .collect(),
        None => Vec::new(),
    };
    jobs.push(Job {
        name: "program".to_owned(),
        counters: Vec::new(),
        is_watched: false,
        connect: Box::new(move |_thread| Ok(Box::new(program))),
    });
    Ok(Opened {
        jobs,
        ..Opened::default()
    })
}

/// The threads of what the program sends and of what it receives.
fn frame_jobs<'a>(
    work: &'a CableWork,
    frames: &'a FrameWork,
    domain: &Arc<Domain>,
    orders: &Orders,
    recorder: &mut Recorder,
) -> Result<[Job<'a>; 2], WorkerError> {
    warn_of_spinning("", frames.wait, frames.realtime[0].cpu);
    let [for_output, for_input] = &frames.realtime;
    let (output, input) = (&work.output, &work.input);
    let ends = OpenOutward::new(recorder, &output.name)?;
    let (start, here) = (orders.run_start(), Arc::clone(domain));
    let outward = Job {
        name: "frames out".to_owned(),
        counters: vec![Counter::new(&output.name, "published", &ends.given)],
        is_watched: true,
        connect: Box::new(move |thread| {
            thread.claim(for_output);
            let cable = Outward::join(&here, &output.name, &work.cable_socket, true, ends, start)?;
            Ok(Box::new(LocalOutward {
                cable,
                wait: WaitStrategy::new(frames.wait, for_output.cpu),
                _domain: here,
            }))
        }),
    };
    let ends = OpenInward::new(recorder, &input.name)?;
    let here = Arc::clone(domain);
    let inward = Job {
        name: "frames in".to_owned(),
        counters: vec![Counter::new(&input.name, "taken", &ends.count)],
        is_watched: true,
        connect: Box::new(move |thread| {
            thread.claim(for_input);
            let waiter = (frames.wait != WaitMode::Spin)
                .then(|| Waiter::open(&here, &[&input.name]))
                .transpose()?;
            Ok(Box::new(LocalInward {
                cable: Inward::join(&here, &input.name, &work.cable_socket, input.depth, ends)?,
                waiter,
                wait: WaitStrategy::new(frames.wait, for_input.cpu),
                _domain: here,
            }))
        }),
    };
    Ok([outward, inward])
}

/// The helper that becomes the program, and the server of its cable.
fn start(work: &CableWork, domain: &Domain) -> Result<(Child, CableServer), WorkerError> {
    let (here, there) = handover::pair().map_err(WorkerError::Socket)?;
    let failed = |source| WorkerError::Program {
        program: work.command[0].clone(),
        source,
    };
    // Both outputs go where this process's own words go; its standard output is the supervisor's.
    let log = std::io::stderr()
        .as_fd()
        .try_clone_to_owned()
        .map_err(failed)?;
    let mut helper = own_process::again();
    helper.args(["become", "--supervisor", &std::process::id().to_string()]);
    let inside: IpAddr = work.inside;
    helper.args(["--inside", &inside.to_string()]);
    if let Some(limit) = work.open_files {
        helper.args(["--open-files", &limit.to_string()]);
    }
    helper.arg("--").args(&work.command).envs(&work.environment);
    helper.stdin(Stdio::from(there)).stdout(Stdio::from(log));
    let child = Child::spawn_beside(&mut helper).map_err(failed)?;
    // This process keeps no copy of the helper's end: the end of a helper is noticed.
    drop(helper);
    Ok((
        child,
        CableServer::open(&socket_path(domain, &work.cable_socket), here)?,
    ))
}

/// Moves what waits as a thread ends, so that only what came later is under way at the end of the run.
///
/// # Errors
/// Those of `step`.
pub(crate) fn clear(
    mut step: impl FnMut() -> Result<bool, WorkerError>,
) -> Result<(), WorkerError> {
    for _ in 0..CLEARING_MAX {
        if !step()? {
            break;
        }
    }
    Ok(())
}

/// [`Outward`] in a thread of its own.
struct LocalOutward {
    cable: Outward,
    wait: WaitStrategy,
    /// Dropped after the port.
    _domain: Arc<Domain>,
}

impl JobWork for LocalOutward {
    fn step(&mut self) -> Result<bool, WorkerError> {
        let has_moved = self.cable.step()?;
        if has_moved {
            self.wait.on_arrival(MonotonicClock::now());
        }
        Ok(has_moved)
    }

    fn rest(&mut self) -> Result<(), WorkerError> {
        match self
            .wait
            .pause(MonotonicClock::now(), self.cable.next_look())
        {
            Pause::Spin => self.wait.spin(),
            Pause::Sleep(until) => {
                poll_descriptors(self.cable.descriptor().into_iter(), until)?;
            }
        }
        Ok(())
    }

    fn finish(&mut self, stepped: Result<(), WorkerError>) -> Result<(), WorkerError> {
        stepped?;
        clear(|| self.cable.step())
    }

    fn report(&mut self) -> ProcessReport {
        ProcessReport {
            inlets: vec![self.cable.report()],
            connection_failures: self.cable.connection_failure_count(),
            ..ProcessReport::default()
        }
    }
}

/// [`Inward`] in a thread of its own.
struct LocalInward {
    cable: Inward,
    /// `None` for a thread that spins.
    waiter: Option<Waiter>,
    wait: WaitStrategy,
    /// Dropped after the ports.
    _domain: Arc<Domain>,
}

impl JobWork for LocalInward {
    fn step(&mut self) -> Result<bool, WorkerError> {
        let has_moved = self.cable.step()?;
        if has_moved {
            self.wait.on_arrival(MonotonicClock::now());
        }
        Ok(has_moved)
    }

    fn rest(&mut self) -> Result<(), WorkerError> {
        let next_look: Option<Instant> = self.cable.next_look();
        let pause = self.wait.pause(MonotonicClock::now(), next_look);
        if let (Pause::Sleep(until), Some(waiter)) = (pause, &mut self.waiter) {
            waiter.wait_until(Some(until))?;
        } else {
            self.wait.spin();
        }
        Ok(())
    }

    fn finish(&mut self, stepped: Result<(), WorkerError>) -> Result<(), WorkerError> {
        stepped?;
        clear(|| self.cable.step())
    }

    fn report(&mut self) -> ProcessReport {
        ProcessReport {
            inlets: vec![self.cable.report()],
            connection_failures: self.cable.connection_failure_count(),
            ..ProcessReport::default()
        }
    }
}
