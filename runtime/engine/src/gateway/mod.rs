//! The gateway of a link on one host: carries channels between shared memory and the network. What
//! bytes mean is the business of `hil_protocol`; here are the loops that own clock,
//! socket, port and records.
//!
//! - `process`: the process with its threads, one per channel direction.
//! - [`direction`]: one direction from its launch description to its final counters.
//! - `egress`: shared memory to network; `ingress`: network to shared memory.
//! - `gathering`: what both do about a flood of datagrams that they refuse.

pub(crate) mod arming;
mod connection;
mod counters;
pub mod direction;
pub(crate) mod egress;
mod gathering;
pub(crate) mod ingress;
pub(crate) mod kernel_clock;
mod line;
pub(crate) mod link_control;
mod link_switch;
mod opening;
pub mod process;
pub(crate) mod socket;
pub mod stamp_plan;

use std::fs::File;
use std::io::{self, Read};
use std::os::fd::BorrowedFd;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use hil_core::time::Instant;
use hil_protocol::body::HelloStatus;
use hil_protocol::{ChannelIdentity, SettingsError};
use hil_transport::socket::SocketError;
use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::time::TimeSpec;

use hil_platform::clock::MonotonicClock;
use hil_rundir::launch::{DirectionLaunch, LaunchError};
use hil_rundir::record::RecordFileError;
use hil_shm::{ChannelError, Domain, DomainError, clock_id};
use hil_topology::emulation::EmulationError;

/// Why a gateway cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum GatewayError {
    /// The launch file.
    #[error(transparent)]
    Launch(#[from] LaunchError),
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
    /// The run's secret, without which its hops are not opened.
    #[error("the supervisor did not give the run's secret")]
    SecretMissing,
    /// No random session number.
    #[error("cannot choose a session number: {0}")]
    Session(io::Error),
    /// The other end does not want this channel.
    #[error("the gateway at the other end refused the channel: {}", .0.label())]
    Refused(HelloStatus),
    /// A record file could not be written any more.
    #[error("{0}")]
    Unrecorded(String),
    /// A thread panicked.
    #[error("a gateway thread panicked")]
    Panicked,
}

/// What a direction's thread needs from the process around it.
#[derive(Debug)]
pub struct Surroundings {
    /// The host's shared memory.
    pub domain: Domain,
    /// Number of this start.
    pub session: u32,
    /// Which memory it is.
    pub fingerprint: [u8; 16],
    /// Which clock is read.
    pub(crate) clock_id: u64,
    /// Set when the threads are to end.
    pub stop: Arc<AtomicBool>,
}

impl Surroundings {
    /// A gateway's start in `domain`, with a session number nobody can guess from the last one.
    ///
    /// # Errors
    /// When the host's identity or a random number cannot be read.
    pub fn new(domain: Domain) -> Result<Self, GatewayError> {
        Ok(Self {
            session: random_session().map_err(GatewayError::Session)?,
            fingerprint: domain.fingerprint()?,
            clock_id: clock_id()?,
            stop: Arc::new(AtomicBool::new(false)),
            domain,
        })
    }

    /// What the other end of the channel of `launch` must agree on.
    pub fn identity(launch: &DirectionLaunch) -> ChannelIdentity {
        ChannelIdentity::new(
            launch.channel_id,
            &launch.channel,
            &launch.message,
            u32::try_from(launch.size_bytes).unwrap_or(u32::MAX),
            u32::try_from(launch.alignment_bytes).unwrap_or(u32::MAX),
        )
    }
}

/// Descriptors one thread waits for: its listener and its socket.
const DESCRIPTORS_MAX: usize = 2;

/// Sessions must differ between starts, and not be guessable from the last one.
fn random_session() -> io::Result<u32> {
    let mut bytes = [0; 4];
    File::open("/dev/urandom")?.read_exact(&mut bytes)?;
    Ok(u32::from_le_bytes(bytes).max(1))
}

/// Sleeps until a descriptor has something or `until`; says for each whether it has.
pub(crate) fn poll_descriptors<'a>(
    descriptors: impl Iterator<Item = BorrowedFd<'a>>,
    until: Instant,
) -> Result<[bool; DESCRIPTORS_MAX], GatewayError> {
    let left = until.saturating_duration_since(MonotonicClock::now());
    let mut news = [false; DESCRIPTORS_MAX];
    // On the stack: waiting is part of the measured path, which does not allocate.
    let mut polled: [Option<PollFd<'a>>; DESCRIPTORS_MAX] = [const { None }; DESCRIPTORS_MAX];
    for (place, descriptor) in polled.iter_mut().zip(descriptors) {
        *place = Some(PollFd::new(descriptor, PollFlags::POLLIN));
    }
    let timeout = Some(TimeSpec::from_duration(left));
    let outcome = match polled {
        [Some(first), Some(second)] => {
            let mut polled = [first, second];
            let outcome = ppoll(&mut polled, timeout, None);
            news = polled.map(|one| one.any().unwrap_or(true));
            outcome
        }
        [Some(only), None] | [None, Some(only)] => {
            let mut polled = [only];
            let outcome = ppoll(&mut polled, timeout, None);
            news[0] = polled[0].any().unwrap_or(true);
            outcome
        }
        [None, None] => ppoll(&mut [], timeout, None),
    };
    match outcome {
        Ok(_) => Ok(news),
        Err(Errno::EINTR) => Ok([true; DESCRIPTORS_MAX]),
        Err(errno) => Err(GatewayError::Wait(errno.into())),
    }
}
