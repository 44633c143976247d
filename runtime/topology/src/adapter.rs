//! `[processes.<name>.egm]`: a role of the case that is played by a foreign program speaking the
//! robot maker's own guided-motion datagrams (EGM). Its keys are declared here;
//! which of the two adapters it is follows from the case, see `check_adapter`.

use std::net::{IpAddr, SocketAddr};

use hil_arm::egm::messages::Side;
use hil_core::case_study::ParameterError;
use hil_core::{options, words};
use serde::{Deserialize, Serialize};

use super::links::Timestamps;
use super::tables::{EGM_ADDRESS, HOST_ADDRESS};

/// Why a robot adapter is not told when to send.
pub(super) const ROBOT_SENDS: &str =
    "does not apply to a robot adapter, which sends with every cycle of the robot";

/// Why a robot adapter is told no robot.
const ROBOT_IS_HERE: &str = "does not apply to a robot adapter, which stands for the robot";

options! {
    /// A role played by a foreign EGM program.
    pub struct EgmAdapter
    with {
        /// Which side of the protocol we are; it follows from the role, which the table does not know.
        kind: AdapterKind = AdapterKind::Sensor,
    }
    {
        /// Right arm: where the foreign program listens (robot adapter) or where we do (sensor adapter).
        right: Option<SocketAddr>, in EGM_ADDRESS;
        /// Left arm, as `right`.
        left: Option<SocketAddr>, in EGM_ADDRESS;
        /// Address of the robot: a sensor adapter hears and answers no other. Without it the first that
        /// speaks is held while it speaks.
        robot: Option<IpAddr>, in HOST_ADDRESS,
            needs(kind, |one| one.kind == AdapterKind::Sensor, ROBOT_IS_HERE);
        /// Joints of an arm on the wire.
        axes: u8 = 7, in 6..=7;
        /// Generation of the robot's software whose message fields we write.
        robotware: u8 = 7, in 6..=7;
        /// When the sensor adapter sends; a robot adapter sends with every feedback.
        send: SendClock = SendClock::Coupled,
            needs(kind, |one| one.kind == AdapterKind::Sensor, ROBOT_SENDS);
        /// Messages per second. A robot takes one per cycle of 4 ms; senders of up to four times that are
        /// seen.
        send_hz: f64 = 250.0, in 1.0..=1_000.0,
            needs(send, |one| one.send == SendClock::Free, "needs send = \"free\"");
        /// Kernel stamps asked for. The network card's own clock would not compare with the software stamps
        /// of the other way.
        timestamps: Timestamps = Timestamps::Software, in &[Timestamps::Off, Timestamps::Software];
        /// Differentiated-services code point (RFC 2474).
        dscp: u8 = 0, in 0..=63;
    }
    check EgmAdapter::check_arms;
}

words! {
    /// When a sensor adapter sends, by its word.
    pub enum SendClock {
        /// One message for each of the robot's, as the maker recommends.
        Coupled = "coupled",
        /// On a clock of its own.
        Free = "free",
    }
}

hil_core::labelled! {
    /// Which side of the protocol an adapter is.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "kebab-case")]
    pub enum AdapterKind, label {
        /// We are the robot: the foreign program plays the role that commands it.
        Robot = "EGM robot adapter",
        /// We are the sensor: the foreign program, or a real robot, plays the robot.
        Sensor = "EGM sensor adapter",
    }
}

/// When a sensor adapter sends.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AdapterSend {
    /// One message for each of the robot's, as the maker recommends.
    Coupled,
    /// On a clock of its own.
    Free {
        /// Messages per second.
        rate_hz: f64,
    },
}

impl EgmAdapter {
    /// The address of `side`; `None` when the adapter has no such arm.
    pub const fn address(&self, side: Side) -> Option<SocketAddr> {
        match side {
            Side::Right => self.right,
            Side::Left => self.left,
        }
    }

    /// When a sensor adapter sends.
    pub const fn send(&self) -> AdapterSend {
        match self.send {
            SendClock::Coupled => AdapterSend::Coupled,
            SendClock::Free => AdapterSend::Free {
                rate_hz: self.send_hz,
            },
        }
    }

    fn check_arms(&self) -> Result<(), ParameterError> {
        match (self.right, self.left) {
            (None, None) => Err(ParameterError::new(
                "right",
                "is missing: write right = \"ADDRESS:PORT\", left = \"ADDRESS:PORT\" or both: one for \
                 each arm",
            )),
            (right, left) if right == left => Err(ParameterError::new(
                "left",
                "is the address of the right arm too: each arm has a channel of its own",
            )),
            _ => Ok(()),
        }
    }

    /// The arms that have an address.
    pub(super) fn addresses(&self) -> impl Iterator<Item = (Side, SocketAddr)> {
        let arms = [(Side::Right, self.right), (Side::Left, self.left)];
        arms.into_iter()
            .filter_map(|(side, address)| Some((side, address?)))
    }
}
