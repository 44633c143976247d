//! What a face process is told: whom it speaks with, which channels it joins, how it waits. It
//! opens nothing.

use std::net::SocketAddr;
use std::path::PathBuf;

use hil_arm::egm::face::{Axes, RobotWare};
use hil_arm::egm::messages::Side;
use serde::{Deserialize, Serialize};

use hil_platform::realtime::RealtimeRequest;
use hil_platform::wait::WaitMode;
use hil_topology::{CardChannel, FaceKind, FaceSend, Timestamps};

/// How to start one face here.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FaceLaunch {
    /// Name of the process in the topology.
    pub process: String,
    /// How often it was restarted before.
    pub instance: u32,
    /// The host's shared memory, a [`DomainAddress`](hil_platform::domain_address::DomainAddress).
    pub domain: String,
    /// Folder for record files.
    pub records: PathBuf,
    /// How to wait.
    pub wait: WaitMode,
    /// Everything that does not depend on the run.
    pub face: FaceSettings,
}

/// What a face is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FaceSettings {
    /// The role that the foreign program plays.
    pub role: String,
    /// Which side of the protocol we are.
    pub kind: FaceKind,
    /// Joints of an arm on the wire, 6 or 7.
    pub axes: u8,
    /// Generation of the robot's software, 6 or 7.
    pub robotware: u8,
    /// The robot's cycle as the case has it.
    pub cycle_ns: u64,
    /// How far its planned joints are ahead of the measured.
    pub planned_lead_ns: u64,
    /// When a sensor face sends.
    pub send: FaceSend,
    /// Kernel stamps to ask for.
    pub timestamps: Timestamps,
    /// Differentiated-services code point (RFC 2474), 0..=63.
    pub dscp: u8,
    /// Interface to bind to.
    pub interface: Option<String>,
    /// One thread and one socket each.
    pub arms: Vec<ArmLaunch>,
    /// Channels whose messages the protocol has no place for: taken, recorded and dropped.
    pub spare: Vec<CardChannel>,
}

impl FaceSettings {
    /// [`FaceSettings::axes`] in the words of the protocol.
    pub const fn axes(&self) -> Axes {
        match self.axes {
            6 => Axes::Six,
            _ => Axes::Seven,
        }
    }

    /// [`FaceSettings::robotware`] in the words of the protocol.
    pub const fn robotware(&self) -> RobotWare {
        match self.robotware {
            6 => RobotWare::Six,
            _ => RobotWare::Seven,
        }
    }
}

/// One arm of a face.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ArmLaunch {
    /// Which arm.
    pub arm: Side,
    /// Where the foreign program listens (robot face), or where we do (sensor face).
    pub address: SocketAddr,
    /// The channel whose messages go out.
    pub input: CardChannel,
    /// The channel that what comes in is published on.
    pub output: CardChannel,
    /// What to ask of the kernel.
    pub realtime: RealtimeRequest,
}
