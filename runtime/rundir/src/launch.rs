//! What a supervisor tells a process it starts. A component learns its role and its channels and
//! nothing of hosts, links or gateways: its card is byte-identical in a local and a split run.

use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::Duration;
use std::{fs, io};

use hil_arm::egm::adapter::{Axes, RobotWare};
use hil_arm::egm::messages::Side as ArmSide;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use hil_platform::plain_file;
use hil_platform::realtime::RealtimeRequest;
use hil_platform::wait::WaitMode;
use hil_topology::emulation::EmulationLaunch;
use hil_topology::{EgmAdapter, RoleChannel, SocketOptions};

/// How to start one process of the run that this binary plays.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WorkerLaunch {
    /// Name of the process in the topology, or of a gateway, e.g. `gateway-hop-robot-pc`.
    pub process: String,
    /// How often it was restarted before.
    pub instance: u32,
    /// The host's shared memory, a [`DomainAddress`](hil_platform::domain_address::DomainAddress).
    pub domain: String,
    /// Folder for record files.
    pub records: PathBuf,
    /// Its hops are sealed: the first word on its standard input is the run's secret.
    pub is_sealed: bool,
    /// What it does.
    pub work: Work,
}

/// What a process of the run does.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Work {
    /// Plays a role of the case.
    Component(ComponentWork),
    /// Carries channels over a link, or is one end of a clock path.
    Gateway(GatewayWork),
    /// Speaks a robot maker's own protocol with a foreign program.
    Adapter(AdapterSettings),
    /// Runs a program in a network namespace of its own and carries its Ethernet frames.
    Cable(CableWork),
    /// Records what programs of the user's publish and are given.
    Witness(WitnessWork),
}

/// What a component is told.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ComponentWork {
    /// File with the [`RoleSpec`](hil_topology::RoleSpec).
    pub card: PathBuf,
    /// What to ask of the kernel.
    pub realtime: RealtimeRequest,
    /// How to wait for messages and ticks.
    pub wait: WaitMode,
}

/// What the gateway of one link on one host is told.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GatewayWork {
    /// One thread each: what goes out on the link and what comes in.
    pub directions: Vec<DirectionLaunch>,
    /// How long it waits for the peer's answer before it is ready without; `None` waits on.
    pub ready_within: Option<Duration>,
}

/// One way of a link through a gateway: a flow with all its channels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DirectionLaunch {
    /// Name of the flow.
    pub flow: String,
    /// Its number in datagrams.
    pub flow_number: u16,
    /// Which way.
    pub side: Side,
    /// This end of the hop.
    pub local: SocketAddr,
    /// The other end of the hop.
    pub peer: SocketAddr,
    /// Socket options.
    pub socket: SocketLaunch,
    /// How to wait.
    pub wait: WaitMode,
    /// What to ask of the kernel.
    pub realtime: RealtimeRequest,
    /// Its channels; none on a clock path, which exchanges clocks only.
    pub channels: Vec<ChannelLaunch>,
}

impl DirectionLaunch {
    /// True for one that exchanges clocks only.
    pub fn is_clock_path(&self) -> bool {
        self.channels.is_empty()
    }
}

/// One channel of a flow.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChannelLaunch {
    /// Name of the channel.
    pub channel: String,
    /// Its number in datagrams.
    pub channel_id: u16,
    /// Name and version of its message type.
    pub message: String,
    /// Size of one message.
    pub size_bytes: usize,
    /// Alignment of one message.
    pub alignment_bytes: usize,
    /// Messages that wait at most in shared memory.
    pub depth: usize,
    /// A link model that its messages meet behind the receiving socket.
    pub emulation: Option<EmulationLaunch>,
    /// The socket of the cable of the program on this host whose Ethernet frames its messages are, see [`CableWork::cable_socket`].
    pub cable_socket: Option<String>,
}

hil_core::labelled! {
    /// Which way a gateway thread carries its channels.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "kebab-case")]
    pub enum Side, word {
        /// From shared memory to the network.
        Egress = "egress",
        /// From the network to shared memory.
        Ingress = "ingress",
    }
}

/// Socket options of a hop.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SocketLaunch {
    /// Name of the transport that carries the datagrams.
    pub transport: String,
    /// The transport's own options, by their keys.
    #[serde(default)]
    pub options: BTreeMap<String, i64>,
    /// Interface to bind to.
    pub interface: Option<String>,
    /// What the topology says of it, whatever the transport.
    pub common: SocketOptions,
}

/// What a process is told that speaks with a foreign program.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AdapterSettings {
    /// The role that the foreign program plays.
    pub role: String,
    /// What the topology says of it.
    pub egm: EgmAdapter,
    /// The robot's cycle as the case has it.
    pub cycle_ns: u64,
    /// How far its planned joints are ahead of the measured.
    pub planned_lead_ns: u64,
    /// How to wait.
    pub wait: WaitMode,
    /// Interface to bind to.
    pub interface: Option<String>,
    /// One thread and one socket each.
    pub arms: Vec<ArmLaunch>,
    /// Channels whose messages the protocol has no place for: taken, recorded and dropped.
    pub spare: Vec<RoleChannel>,
}

impl AdapterSettings {
    /// [`EgmAdapter::axes`] in the words of the protocol.
    pub const fn axes(&self) -> Axes {
        match self.egm.axes {
            6 => Axes::Six,
            _ => Axes::Seven,
        }
    }

    /// [`EgmAdapter::robotware`] in the words of the protocol.
    pub const fn robotware(&self) -> RobotWare {
        match self.egm.robotware {
            6 => RobotWare::Six,
            _ => RobotWare::Seven,
        }
    }
}

/// One arm of an adapter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ArmLaunch {
    /// Which arm.
    pub arm: ArmSide,
    /// Where the foreign program listens (robot adapter), or where we do (sensor adapter).
    pub address: SocketAddr,
    /// The channel whose messages go out.
    pub input: RoleChannel,
    /// The channel that what comes in is published on.
    pub output: RoleChannel,
    /// What to ask of the kernel.
    pub realtime: RealtimeRequest,
}

/// What a process is told that starts a program of the user's with a cable.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CableWork {
    /// The program's address.
    pub inside: IpAddr,
    /// The program and its arguments.
    pub command: Vec<String>,
    /// Variables added to its environment.
    pub environment: BTreeMap<String, String>,
    /// Files that the program may have open, if not as many as this process.
    pub open_files: Option<u64>,
    /// Where the threads that carry its frames fetch the cable's end: a file in the root path of the domain.
    pub cable_socket: String,
    /// The channel of the frames for the program.
    pub input: RoleChannel,
    /// The channel of the frames of the program.
    pub output: RoleChannel,
    /// Threads of its own that do; `None` where gateways do.
    pub frames: Option<FrameWork>,
}

/// Threads that carry the frames of a program whose channels stay on its host.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrameWork {
    /// What to ask of the kernel for the thread of the output, and for that of the input.
    pub realtime: [RealtimeRequest; 2],
    /// How to wait for frames.
    pub wait: WaitMode,
}

/// How often a witness looks who reads a channel.
pub const WITNESS_LOOK_PERIOD: Duration = Duration::from_millis(20);

/// What a process is told that records for the programs of the user's on its host.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WitnessWork {
    /// How long the run's start waits for a program that joins some channel late or never.
    pub patience: Duration,
    /// The channels that they have.
    pub channels: Vec<WitnessedChannel>,
}

/// A channel with a program of the user's at an end.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WitnessedChannel {
    /// Its name.
    pub name: String,
    /// Size of one message.
    pub message_size_bytes: usize,
    /// The program of the user's that publishes here.
    pub publisher: Option<String>,
    /// The program of the user's that reads here.
    pub reader: Option<String>,
    /// Whether the messages themselves are recorded, for the case to score.
    pub has_messages: bool,
}

/// A launch file or card cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum LaunchError {
    /// It cannot be read or written.
    #[error("launch file {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// It does not say what it should.
    #[error("launch file {path}: {source}")]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: serde_json::Error,
    },
}

/// Reads a launch file or card.
///
/// # Errors
/// When it cannot be read or does not fit `T`.
pub fn read<T: DeserializeOwned>(path: &Path) -> Result<T, LaunchError> {
    let text = plain_file::read(path).map_err(|source| LaunchError::Io {
        path: path.to_owned(),
        source,
    })?;
    serde_json::from_slice(&text).map_err(|source| LaunchError::Content {
        path: path.to_owned(),
        source,
    })
}

/// Writes a launch file or card.
///
/// # Errors
/// When it cannot be written.
pub fn write<T: Serialize>(path: &Path, content: &T) -> Result<(), LaunchError> {
    let text = serde_json::to_vec_pretty(content).map_err(|source| LaunchError::Content {
        path: path.to_owned(),
        source,
    })?;
    fs::write(path, text).map_err(|source| LaunchError::Io {
        path: path.to_owned(),
        source,
    })
}
