//! An adapter: a process that lets a foreign program play a role of the case by speaking the robot
//! maker's own guided-motion datagrams (EGM) with it. What the datagrams mean is the business of
//! `hil_arm::egm::adapter`; here are the threads that own clock, socket, ports and records.
//!
//! - *Robot adapter*: we are the robot. Each feedback goes out as one `EgmRobot` to the address the
//!   topology names, each `EgmSensor` that comes back becomes a command.
//! - *Sensor adapter*: we are the sensor. Each `EgmRobot` that comes becomes a feedback, and commands
//!   go out as `EgmSensor` to where it came from.
//!
//! Read in this order: [`hil_rundir::launch`], `process`, `arm`, then `robot` or `sensor`;
//! [`hil_rundir::adapter_record`] is what they note.
//!
//! On the measured path nothing allocates once the protocol's lists have grown, but for what a joint
//! session does not use (a tool speed, signals of a program, forces) and for the error of a datagram
//! that cannot be decoded: there the protobuf library does.

mod arm;
mod line;
mod opening;
mod peer;
pub(crate) mod process;
mod robot;
mod robot_address;
mod sensor;
mod spare;
#[cfg(test)]
mod tests;

pub use opening::{JoinedArm, OpenedArm};
