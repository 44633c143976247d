//! The gateway of a link on one host: carries channels between shared memory and the network. What
//! bytes mean is the business of `hil_protocol`; here are the loops that own clock,
//! socket, ports and records.
//!
//! - `process`: what the process opens: one thread and one socket each way, however many channels.
//! - [`direction`]: one of them from its launch description to its final counters.
//! - `egress`: shared memory to network; `ingress`: network to shared memory.
//! - `inputs`: which channel's message goes next; `long_message`: one that leaves in many turns.
//! - `refusal_backoff`: what both do about a flood of datagrams that they refuse.

mod connection;
mod counters;
pub mod direction;
pub(crate) mod egress;
pub(crate) mod ingress;
mod inputs;
pub(crate) mod kernel_clock;
mod line;
pub(crate) mod link_control;
mod link_switch;
mod long_message;
pub(crate) mod process;
mod refusal_backoff;
pub(crate) mod socket;
pub mod stamp_plan;
pub(crate) mod stamp_tracker;
pub(crate) mod timestamping;

use std::os::fd::BorrowedFd;

use hil_core::time::Instant;
use hil_protocol::{ChannelIdentity, FlowIdentity};
use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::time::TimeSpec;

use crate::process::worker::WorkerError;
use hil_platform::clock::MonotonicClock;
use hil_platform::random::random_bytes;
use hil_rundir::launch::DirectionLaunch;
use hil_shm::{Domain, clock_id};

/// What a direction's thread needs from the process around it.
#[derive(Debug)]
pub struct GatewayContext {
    /// The host's shared memory.
    pub domain: Domain,
    /// Number of this start.
    pub session: u32,
    /// Which memory it is.
    pub fingerprint: [u8; 16],
    /// Which clock is read.
    pub(crate) clock_id: u64,
}

impl GatewayContext {
    /// A gateway's start in `domain`, with a session number nobody can guess from the last one.
    ///
    /// # Errors
    /// When the host's identity or a random number cannot be read.
    pub fn new(domain: Domain) -> Result<Self, WorkerError> {
        let session = u32::from_le_bytes(random_bytes().map_err(WorkerError::Session)?);
        Ok(Self {
            session: session.max(1),
            fingerprint: domain.fingerprint()?,
            clock_id: clock_id()?,
            domain,
        })
    }

    /// What the other end of the flow of `launch` must agree on.
    pub fn identity(launch: &DirectionLaunch) -> FlowIdentity {
        let channels = launch.channels.iter().map(|one| {
            ChannelIdentity::new(
                one.channel_id,
                &one.channel,
                &one.message,
                u32::try_from(one.size_bytes).unwrap_or(u32::MAX),
                u32::try_from(one.alignment_bytes).unwrap_or(u32::MAX),
            )
        });
        FlowIdentity {
            flow: launch.flow_number,
            name: launch.flow.clone(),
            channels: channels.collect(),
        }
    }
}

/// Descriptors that one thread waits for at most: its listener, its socket, and inlets of programs.
pub(crate) const DESCRIPTORS_MAX: usize = 32;

/// Sleeps until a descriptor has something or `until`; says for each whether it has, in their order. Those beyond
/// [`DESCRIPTORS_MAX`] are not waited for.
pub(crate) fn poll_descriptors<'a>(
    descriptors: impl Iterator<Item = BorrowedFd<'a>>,
    until: Instant,
) -> Result<[bool; DESCRIPTORS_MAX], WorkerError> {
    let left = until.saturating_duration_since(MonotonicClock::now());
    let timeout = Some(TimeSpec::from_duration(left));
    let mut news = [false; DESCRIPTORS_MAX];
    let mut descriptors = descriptors.take(DESCRIPTORS_MAX);
    let outcome = if let Some(first) = descriptors.next() {
        // On the stack: waiting is part of the measured path, which does not allocate.
        let mut polled: [PollFd<'_>; DESCRIPTORS_MAX] =
            core::array::from_fn(|_| PollFd::new(first, PollFlags::POLLIN));
        let mut count = 1;
        for (place, descriptor) in polled[1..].iter_mut().zip(descriptors) {
            *place = PollFd::new(descriptor, PollFlags::POLLIN);
            count += 1;
        }
        let outcome = ppoll(&mut polled[..count], timeout, None);
        for (news, polled) in news.iter_mut().zip(&polled[..count]) {
            *news = polled.any().unwrap_or(true);
        }
        outcome
    } else {
        ppoll(&mut [], timeout, None)
    };
    match outcome {
        Ok(_) => Ok(news),
        Err(Errno::EINTR) => Ok([true; DESCRIPTORS_MAX]),
        Err(errno) => Err(WorkerError::Wait(errno.into())),
    }
}
