//! The process of a program with an address inside: it starts the program in namespaces of its own and carries
//! its Ethernet frames to and from two channels, one message each. One thread for what the program sends, one for
//! what it receives, and one that waits for its end. What the frames are, a report finds out.

mod inward;
mod outward;
mod program;

use std::net::IpAddr;
use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use hil_cable::Inlet;
use hil_core::record::{FrameRecord, PublishedRecord, TakenRecord};
use hil_net::handover;
use hil_platform::own_process;
use hil_platform::signals::Signals;
use hil_rundir::launch::{CableWork, WorkerLaunch};
use hil_rundir::pipe::Orders;
use hil_rundir::record::{RecordKind, Recorder};
use std::os::fd::AsFd as _;

use self::inward::Inward;
use self::outward::Outward;
use self::program::Program;
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
    let (child, inlet) = start(work)?;
    let program = Program {
        child,
        name: work.command[0].clone(),
        stop: Arc::clone(orders.stop_flag()),
        _signals: signals,
    };
    let sender = inlet.sender().map_err(WorkerError::Socket)?;
    let domain = Arc::new(open_domain(launch)?);
    let (input, output) = (work.input.name.as_str(), work.output.name.as_str());
    let mut sink = |kind, channel, size| recorder.sink(kind, channel, size, RING_RECORDS);
    let published = sink(RecordKind::Published, output, size_of::<PublishedRecord>())?;
    let frames = sink(RecordKind::Frame, output, size_of::<FrameRecord>())?;
    let taken = sink(RecordKind::Taken, input, size_of::<TakenRecord>())?;
    warn_of_spinning("", work.wait, work.realtime[0].cpu);
    let end = |channel: &str, what| {
        let count = Arc::new(AtomicU64::new(0));
        let counter = Counter {
            channel: channel.to_owned(),
            what,
            count: Arc::clone(&count),
        };
        (counter, count)
    };
    let (counter, given) = end(output, "published");
    let [for_output, for_input] = &work.realtime;
    let here = Arc::clone(&domain);
    let outward = Job {
        name: "frames out".to_owned(),
        counters: vec![counter],
        is_watched: true,
        connect: Box::new(move |thread| {
            thread.claim(for_output);
            let ends = outward::Ends {
                inlet,
                published,
                frames,
                given,
            };
            Ok(Box::new(Outward::join(work, here, ends)?))
        }),
    };
    let (counter, count) = end(input, "taken");
    let inward = Job {
        name: "frames in".to_owned(),
        counters: vec![counter],
        is_watched: true,
        connect: Box::new(move |thread| {
            thread.claim(for_input);
            let ends = inward::Ends {
                sender,
                taken,
                count,
            };
            Ok(Box::new(Inward::join(work, domain, ends)?))
        }),
    };
    let program = Job {
        name: "program".to_owned(),
        counters: Vec::new(),
        is_watched: false,
        connect: Box::new(move |_thread| Ok(Box::new(program))),
    };
    Ok(Opened {
        jobs: vec![outward, inward, program],
        ..Opened::default()
    })
}

/// The helper that becomes the program, and its cable.
fn start(work: &CableWork) -> Result<(Child, Inlet), WorkerError> {
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
    Ok((child, Inlet::take(here)?))
}

/// Moves what waits as a thread ends, so that only what came later is under way at the end of the run.
fn clear(work: &mut impl JobWork) -> Result<(), WorkerError> {
    for _ in 0..CLEARING_MAX {
        if !work.step()? {
            break;
        }
    }
    Ok(())
}
