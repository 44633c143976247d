//! A face: a process that lets a foreign program play a role of the case by speaking the robot
//! maker's own guided-motion datagrams (EGM) with it. What the datagrams mean is the business of
//! `hil_arm::egm::face`; here are the threads that own clock, socket, ports and records.
//!
//! - *Robot face*: we are the robot. Each feedback goes out as one `EgmRobot` to the address the
//!   topology names, each `EgmSensor` that comes back becomes a command.
//! - *Sensor face*: we are the sensor. Each `EgmRobot` that comes becomes a feedback, and commands
//!   go out as `EgmSensor` to where it came from.
//!
//! Read in this order: [`hil_rundir::face_launch`], `process`, `arm`, then `robot` or `sensor`; [`hil_rundir::face_record`] is what
//! they note, `figures` what that comes to.
//!
//! On the measured path nothing allocates once the protocol's lists have grown, but for what a joint
//! session does not use (a tool speed, signals of a program, forces) and for the error of a datagram
//! that cannot be decoded: there the protobuf library does.

mod arm;
mod line;
mod opening;
mod peer;
pub mod process;
mod robot;
mod sensor;
mod spare;
#[cfg(test)]
mod tests;

use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use hil_transport::socket::SocketError;

use crate::gateway::GatewayError;
use hil_rundir::launch::LaunchError;
use hil_rundir::record::RecordFileError;
use hil_shm::{ChannelError, DomainError};

pub use opening::{JoinedArm, OpenedArm};

/// Why a face cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum FaceError {
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
    /// The kernel does not tell a socket's address.
    #[error("cannot read the address of a socket: {0}")]
    Address(io::Error),
    /// What faces and gateways have in common: clocks, sockets, waiting, threads.
    #[error(transparent)]
    Common(#[from] GatewayError),
}

/// Lets the arms begin together, and tells them when to end.
#[derive(Debug, Default)]
pub(crate) struct Gate {
    is_open: AtomicBool,
    is_closed: AtomicBool,
}

impl Gate {
    fn open(&self) {
        self.is_open.store(true, Ordering::Release);
    }

    fn close(&self) {
        self.is_closed.store(true, Ordering::Release);
    }

    fn is_closed(&self) -> bool {
        self.is_closed.load(Ordering::Acquire)
    }

    /// Set once the run is over.
    fn stop_flag(&self) -> &AtomicBool {
        &self.is_closed
    }

    /// Waits for the start; false when it ended before.
    fn wait_until_open(&self) -> bool {
        loop {
            if self.is_closed() {
                return false;
            }
            if self.is_open.load(Ordering::Acquire) {
                return true;
            }
            thread::sleep(Duration::from_micros(200));
        }
    }
}
