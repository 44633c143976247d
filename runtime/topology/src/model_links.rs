//! The checked links of a topology: what carries their bytes, and how their gateways run. It reads
//! no file and opens no socket.

use core::fmt;
use std::collections::BTreeMap;
use std::path::Path;

use hil_link::spec::LinkSpec;
use hil_protocol::transport::Description;
use hil_transport::registry;
use serde::{Deserialize, Serialize};

use super::model::{Execution, OnExit, Topology, words};
use crate::trace_source::{BaseFolder, TraceSource};

/// One `[links.<name>]`.
#[derive(Debug, Clone, PartialEq)]
pub struct Link {
    /// Its key.
    pub name: String,
    /// What carries the bytes.
    pub via: Via,
    /// Its two hosts; forward is from the first to the second. `None` while no channel uses it
    /// and the file does not say.
    pub between: Option<[String; 2]>,
}

impl Topology {
    /// The same with its traces looked for beside the file at `path`.
    pub(super) fn with_traces_beside(mut self, path: &Path) -> Self {
        let folder = path.parent().unwrap_or(Path::new(""));
        for link in &mut self.links {
            if let Via::Emulated(_, emulation) = &mut link.via
                && let Some(trace) = &mut emulation.trace
            {
                trace.base = BaseFolder(folder.to_owned());
            }
        }
        self
    }
}

impl Link {
    /// Socket and gateway settings; `None` for shared memory.
    pub fn hop(&self) -> Option<&Hop> {
        self.via.hop()
    }

    /// What the emulation does; `None` on every other link.
    pub fn emulation(&self) -> Option<&Emulation> {
        match &self.via {
            Via::Emulated(_, emulation) => Some(emulation),
            Via::SharedMemory | Via::Network(_) => None,
        }
    }
}

/// The transport called `name`, as a topology or a summary names it.
pub fn transport(name: &str) -> Option<&'static Description> {
    registry::named(name).map(registry::Transport::description)
}

/// What carries a link's bytes.
#[derive(Debug, Clone, PartialEq)]
pub enum Via {
    /// One host, no gateway.
    SharedMemory,
    /// The real network.
    Network(Hop),
    /// Datagrams behind a model of a network.
    Emulated(Hop, Box<Emulation>),
}

impl Via {
    /// The word in the file.
    pub const fn word(&self) -> &'static str {
        match self {
            Self::SharedMemory => "shared-memory",
            Self::Network(hop) => hop.transport.name,
            Self::Emulated(..) => "emulated",
        }
    }

    /// Socket and gateway settings; `None` for shared memory.
    pub fn hop(&self) -> Option<&Hop> {
        match self {
            Self::SharedMemory => None,
            Self::Network(hop) | Self::Emulated(hop, _) => Some(hop),
        }
    }
}

/// Socket and gateway settings of a link.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Hop {
    /// What carries the datagrams.
    pub transport: &'static Description,
    /// The transport's own options, by their keys.
    pub options: BTreeMap<String, i64>,
    /// First port; see [`LinkPorts::of`](super::LinkPorts::of).
    pub port: u16,
    /// Differentiated-services code point (RFC 2474), 0..=63.
    pub dscp: u8,
    /// `SO_PRIORITY`; `None` leaves what the kernel derives from the code point.
    pub socket_priority: Option<u32>,
    /// Send buffer asked of the kernel.
    pub send_buffer_bytes: usize,
    /// Receive buffer asked of the kernel.
    pub receive_buffer_bytes: usize,
    /// Kernel time stamps asked for.
    pub timestamps: Timestamps,
    /// Largest IP packet the path carries.
    pub path_mtu_bytes: usize,
    /// How its gateways run.
    pub gateway: Gateway,
}

/// How the gateways of a link run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Gateway {
    /// How the kernel schedules them and how they wait.
    pub execution: Execution,
    /// What the end of one means for the run.
    pub on_exit: OnExit,
}

/// Kernel time stamps of a hop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Timestamps {
    /// None: only the gateways' own clock readings.
    Off,
    /// Taken by the kernel's network stack.
    Software,
    /// Taken by the network card.
    Hardware,
}

/// What an emulated link does, in each direction. Outages strike both at once and are those of
/// either.
#[derive(Debug, Clone, PartialEq)]
pub struct Emulation {
    /// From the first host of [`Link::between`] to the second.
    pub forward: LinkSpec,
    /// From the second to the first.
    pub backward: LinkSpec,
    /// Recorded traces: a channel that has one meets nothing of the above.
    pub trace: Option<TraceSource>,
}

words!(Timestamps { Off = "off", Software = "software", Hardware = "hardware" });
