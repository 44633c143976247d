//! What a supervisor tells a process it starts. A component learns its role and its channels and
//! nothing of hosts, links or gateways: its card is byte-identical in a local and a split run.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use hil_platform::realtime::RealtimeRequest;
use hil_platform::wait::WaitMode;
use hil_topology::Timestamps;
use hil_topology::emulation::EmulationLaunch;

/// How to start one component here.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ComponentLaunch {
    /// Name of the process in the topology.
    pub process: String,
    /// How often it was restarted before.
    pub instance: u32,
    /// File with the [`ProcessCard`](hil_topology::ProcessCard).
    pub card: PathBuf,
    /// The shared memory to join, a [`DomainAddress`](hil_platform::domain_address::DomainAddress).
    pub domain: String,
    /// What to ask of the kernel.
    pub realtime: RealtimeRequest,
    /// How to wait for messages and ticks.
    pub wait: WaitMode,
    /// Folder for record files.
    pub records: PathBuf,
}

/// How to start the gateway of one link on one host.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GatewayLaunch {
    /// Name of the process, e.g. `gateway-hop-robot-pc`.
    pub process: String,
    /// How often it was restarted before.
    pub instance: u32,
    /// The host's shared memory, a [`DomainAddress`](hil_platform::domain_address::DomainAddress).
    pub domain: String,
    /// Folder for record files.
    pub records: PathBuf,
    /// One thread each.
    pub directions: Vec<DirectionLaunch>,
    /// How long it waits for the peer's answer before it is ready without; `None` waits on.
    #[serde(default)]
    pub ready_within: Option<Duration>,
    /// Its hops are sealed: the first word on its standard input is the run's secret.
    #[serde(default)]
    pub is_sealed: bool,
}

/// One channel direction through a gateway.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DirectionLaunch {
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
    /// A link model in front of this direction's receiver.
    pub emulation: Option<EmulationLaunch>,
    /// It exchanges clocks only: no channel of shared memory is behind it.
    #[serde(default)]
    pub is_clock_path: bool,
}

/// Which way a gateway thread carries its channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Side {
    /// From shared memory to the network.
    Egress,
    /// From the network to shared memory.
    Ingress,
}

impl Side {
    /// The word for it.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Egress => "egress",
            Self::Ingress => "ingress",
        }
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
    /// Differentiated-services code point (RFC 2474), 0..=63.
    pub dscp: u8,
    /// `SO_PRIORITY`.
    pub priority: Option<u32>,
    /// Send buffer to ask for.
    pub send_buffer_bytes: usize,
    /// Receive buffer to ask for.
    pub receive_buffer_bytes: usize,
    /// Largest IP packet of the path.
    pub path_mtu_bytes: usize,
    /// Kernel stamps to ask for.
    pub timestamps: Timestamps,
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
    let text = fs::read(path).map_err(|source| LaunchError::Io {
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
