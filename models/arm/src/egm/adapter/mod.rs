//! Between the maker's datagrams and our messages: the robot's side and the sensor's side of a
//! session. Without a socket, a clock or a thread: whoever owns those hands in bytes and the time.
//!
//! - [`RobotAdapter`]: we are the robot; a foreign program guides our model.
//! - [`SensorAdapter`]: we are the sensor; our controller guides a foreign robot.
//!
//! Nothing a datagram holds comes out unjudged: what is not a message of the right type, with the
//! right number of finite values inside the joints' limits, is refused and counted by cause.
//!
//! A robot and the sensor that guides it, one cycle long:
//!
//! ```
//! use core::time::Duration;
//! use hil_arm::egm::adapter::*;
//! use hil_arm::egm::messages::{EgmCommand, EgmFeedback, SessionState, Side};
//! use hil_core::time::Instant;
//! # use bytemuck::Zeroable;
//! # use hil_arm::yumi::arm::{Arm, RIGHT_START_RAD};
//! # let feedback = EgmFeedback {
//! #     measured_rad: RIGHT_START_RAD,
//! #     planned_rad: RIGHT_START_RAD,
//! #     tool: Arm::right().tool(&RIGHT_START_RAD).into(),
//! #     session: 1,
//! #     state: SessionState::Running as u32,
//! #     ..Zeroable::zeroed()
//! # };
//! # let command = EgmCommand { position_rad: RIGHT_START_RAD, ..Zeroable::zeroed() };
//! let mut robot = RobotAdapter::new(RobotAdapterSettings {
//!     side: Side::Right,
//!     axes: Axes::Seven,
//!     robotware: RobotWare::Six,
//!     cycle: Duration::from_millis(4),
//!     planned_lead: Duration::from_millis(16),
//! });
//! let mut sensor = SensorAdapter::new(SensorAdapterSettings {
//!     axes: Axes::Seven,
//!     held_rad: 0.0,
//!     policy: SendPolicy::Coupled { patience: Duration::from_millis(2) },
//! });
//! let (mut datagram, now) = (Vec::new(), Instant::ZERO);
//!
//! // The robot's cycle, on its way to the sensor.
//! let since_1970 = Duration::from_secs(1_700_000_000);
//! assert!(robot.encode(&feedback, since_1970, &mut datagram));
//! let seen = sensor.decode(now, &datagram)?;
//! assert_eq!(seen.session_state(), Some(SessionState::Running));
//!
//! // The sensor's answer to it, which is not waited for any longer as soon as it is there.
//! sensor.command(&command)?;
//! assert!(sensor.poll_transmit(now, &mut datagram));
//! let taken = robot.decode(&datagram)?;
//! assert!((taken.position_rad[2] - command.position_rad[2]).abs() < 1e-15);
//! # Ok::<(), hil_arm::egm::wire::Refusal>(())
//! ```

mod checks;
mod robot;
mod sensor;
mod transmit;

pub use crate::egm::adapter::checks::{
    COMMAND_SLACK_RAD, FEEDBACK_SLACK_RAD, SPEED_REFERENCE_MAX_RAD_PER_S,
};
pub use crate::egm::adapter::robot::{RobotAdapter, RobotAdapterSettings};
pub use crate::egm::adapter::sensor::{
    AHEAD_MAX_MS, QUEUE_COUNT_UNKNOWN, REORDERING_MAX_MS, SensorAdapter, SensorAdapterSettings,
};
pub use crate::egm::adapter::transmit::{SendPolicy, TransmitCounts};

/// Joints a session moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Axes {
    /// J1 to J6 only: J7 stays where it is. For programs written for six-axis robots.
    Six,
    /// All of the arm.
    Seven,
}

impl Axes {
    /// Their number.
    pub const fn count(self) -> usize {
        match self {
            Self::Six => 6,
            Self::Seven => 7,
        }
    }
}

/// Whose messages we send as a robot. Both are always understood.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RobotWare {
    /// Release 6, 6.10 or newer.
    Six,
    /// Release 7: network time stamps beside the times.
    Seven,
}

#[cfg(test)]
mod adapter_tests;
#[cfg(test)]
mod sensor_tests;
