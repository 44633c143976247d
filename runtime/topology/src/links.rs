//! Links: the keys of `[links.<name>]`, what they become, and the same written back. It builds no
//! model, opens no trace and no socket.

use core::time::Duration;
use std::collections::BTreeMap;
use std::path::Path;

use hil_core::options::{Field, Kind, Options, Part, Scalar, Setting, Shape, Slot};
use hil_core::{options, words};
use hil_link::outages::Outages;
use hil_link::spec::{LinkParts, LinkSpec};
use hil_link::wifi::WifiSpec;
use hil_protocol::transport::Description;
use hil_transport::registry;
use serde::{Deserialize, Serialize};

use super::checks::Checks;
use super::errors::Fault;
use super::model::{AtExit, Execution, Restarts, Scheduling, Topology};
use super::resolved::{put, write};
use super::tree::join;
use super::units::format_duration;
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

    /// The table as the file would say it in full.
    pub(super) fn resolved(&self) -> toml::Table {
        let mut table = toml::Table::new();
        if let Some(between) = &self.between {
            put(&mut table, "between", between.to_vec());
        }
        put(&mut table, "via", self.via.word());
        if let Some(hop) = self.hop() {
            for (key, value) in &hop.options {
                put(&mut table, key, *value);
            }
            write(&mut hop.table(), &mut table);
        }
        if let Some(emulation) = self.emulation() {
            write(&mut emulation.table(), &mut table);
        }
        table
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
            Self::SharedMemory => SHARED_MEMORY,
            Self::Network(hop) => hop.transport.name,
            Self::Emulated(..) => EMULATED,
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
    /// Options of its sockets.
    pub socket: SocketOptions,
    /// How its gateways run.
    pub gateway: Gateway,
}

impl Hop {
    fn table(&self) -> HopTable {
        HopTable {
            port: self.port,
            socket: self.socket.clone(),
            gateway: self.gateway.clone(),
        }
    }
}

options! {
    /// Keys that only a link with gateways has.
    pub struct HopTable as part {
        /// First port: one for each way; between hosts at one address as many again for the ends that send.
        port: u16 = 7_400, in 1_024..=65_534;
        /// Options of its sockets.
        socket: SocketOptions;
        /// How its gateways run.
        gateway: Gateway;
    }
}

options! {
    /// Options of the sockets of a link.
    #[derive(Eq)]
    pub struct SocketOptions as part {
        /// Differentiated-services code point (RFC 2474).
        dscp: u8 = 0, in 0..=63;
        /// `SO_PRIORITY`; left out, the kernel derives it from the code point. 256 to 263 select a Wi-Fi user
        /// priority directly.
        socket_priority: Option<u32>, in 0..=263;
        /// Send buffer asked of the kernel. The default is Linux's own.
        send_buffer_bytes: usize = 212_992, in 4_096..=67_108_864;
        /// Receive buffer asked of the kernel. The default is Linux's own.
        receive_buffer_bytes: usize = 212_992, in 4_096..=67_108_864;
        /// Kernel time stamps asked for. A transport without them has `off`.
        timestamps: Timestamps = Timestamps::Software;
        /// Largest IP packet that is sent; over UDP greetings find out what the path takes of it. The smallest is what every IPv4 host accepts (RFC 791).
        path_mtu_bytes: usize = 1_500, in 576..=65_535;
    }
}

options! {
    /// How the gateways of a link run.
    #[derive(Eq)]
    pub struct Gateway {
        /// How the kernel schedules them and how they wait.
        execution: Execution;
        /// What the end of one means for the run.
        restarts: Restarts = Restarts { on_exit: AtExit::Restart, ..Restarts::TEMPLATE };
    }
}

words! {
    /// Kernel time stamps of a hop.
    pub enum Timestamps {
        /// None: only the gateways' own clock readings.
        Off = "off",
        /// Taken by the kernel's network stack.
        Software = "software",
        /// Taken by the network card.
        Hardware = "hardware",
    }
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

impl Emulation {
    fn table(&self) -> EmulationTable {
        let Self {
            forward, backward, ..
        } = self;
        EmulationTable {
            // A radio has outages of its own, and the link then has none beside them.
            outages: forward.wifi.is_none().then_some(forward.outages),
            wifi: forward.wifi,
            trace: self.trace.clone(),
            both: Part::UNSET,
            forward: Some(forward.into()),
            backward: Some(backward.into()),
        }
    }
}

options! {
    /// Keys that only an emulated link has. Each direction does what is said for both, but for the parts
    /// that it has a key or table of its own for.
    pub struct EmulationTable as part {
        /// When nothing gets through: on all channels of the link and both ways at once.
        outages: Option<Outages>;
        /// A Wi-Fi 6 hop with outages, losses, queue and delay of its own.
        wifi: Option<WifiSpec>;
        /// Recorded traces: a channel that has one meets nothing else of the link.
        trace: Option<TraceSource>;
        /// What both directions do.
        both: Part<LinkParts>;
        /// What the direction from the first host of `between` to the second does.
        forward: Option<LinkParts>;
        /// What the other direction does.
        backward: Option<LinkParts>;
    }
}

options! {
    /// A link.
    pub struct LinkTable {
        /// What carries the bytes.
        via: ViaWord;
        /// Its two hosts; forward is from the first to the second. May be left out where a channel says it.
        between: Option<Vec<String>>;
        /// What a link with gateways has.
        hop: HopTable;
        /// What one transport has.
        own: TransportOptions;
        /// What an emulated link does.
        emulation: EmulationTable;
    }
    check LinkTable::check_between;
}

const SHARED_MEMORY: &str = "shared-memory";
const EMULATED: &str = "emulated";

/// The word of `via`; empty while it is not known.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub(crate) struct ViaWord(String);

impl Scalar for ViaWord {
    type Range = ();
    const UNSET: Self = Self(String::new());

    fn shape((): ()) -> Shape {
        let network = transports().map(|one| one.name);
        let words = core::iter::once(SHARED_MEMORY).chain(network);
        Shape::Words(words.chain([EMULATED]).collect())
    }

    fn to_setting(&self) -> Setting {
        Setting::Text(self.0.clone())
    }

    fn from_setting(setting: Setting) -> Result<Self, String> {
        String::from_setting(setting).map(Self)
    }
}

/// The values of the keys that only some transports have.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub(crate) struct TransportOptions(BTreeMap<String, i64>);

impl Options for TransportOptions {
    fn fields(&mut self) -> Vec<Field<'_>> {
        let declared: BTreeMap<&str, _> = transports()
            .flat_map(|one| one.options)
            .map(|option| (option.key, option))
            .collect();
        for (key, option) in &declared {
            let value = self.0.entry((*key).to_owned());
            value.or_insert(option.default);
        }
        let declared = declared.into_values().zip(self.0.values_mut());
        let field = |(option, value): (&'static hil_protocol::transport::TransportOption, _)| {
            Field::new(
                option.key,
                option.about,
                i64::slot(value, option.min..=option.max),
            )
        };
        declared.map(field).collect()
    }
}

impl Kind for TransportOptions {
    type Range = ();
    const UNSET: Self = Self(BTreeMap::new());
    const IS_OPTIONAL: bool = true;

    fn slot(&mut self, (): ()) -> Slot<'_> {
        Slot::Part(self)
    }
}

/// Every transport.
fn transports() -> impl Iterator<Item = &'static Description> {
    registry::ALL
        .into_iter()
        .map(registry::Transport::description)
}

/// The words of `via` that join two hosts, of the transports that `is_meant`, in a sentence.
pub(super) fn crossing_words(is_meant: impl Fn(&Description) -> bool) -> String {
    let words = transports().filter(|one| is_meant(one));
    let words: Vec<_> = words.map(|one| format!("\"{}\"", one.name)).collect();
    format!("{} or \"{EMULATED}\"", words.join(", "))
}

/// Of a gateway on an emulated link: it sleeps until 90 us before a datagram is due and spins then,
/// so a timer that is half of that late is still in time.
const EMULATED_TIMER_SLACK_MAX: Duration = Duration::from_micros(45);

impl LinkTable {
    fn check_between(&self) -> Result<(), hil_core::case_study::ParameterError> {
        match self.between.as_deref() {
            None => Ok(()),
            Some([first, second]) if first != second => Ok(()),
            Some(_) => Err(hil_core::case_study::ParameterError::new(
                "between",
                "does not name two different hosts",
            )),
        }
    }

    /// The two hosts of `between`.
    pub(super) fn hosts(&self) -> Option<[&String; 2]> {
        match self.between.as_deref() {
            Some([first, second]) => Some([first, second]),
            _ => None,
        }
    }

    /// What carries the bytes of the link at `path`; `None` where `via` is missing or faulty. Keys that do
    /// not belong to it are refused.
    pub(super) fn via(&self, path: &str, checks: &Checks<'_>) -> Option<Via> {
        let network = transport(&self.via.0);
        let carrier = network.unwrap_or(registry::PLAIN.description());
        let mut hop = Hop {
            transport: carrier,
            options: BTreeMap::new(),
            port: self.hop.port,
            socket: self.hop.socket.clone(),
            gateway: self.hop.gateway.clone(),
        };
        self.give_own_options(&mut hop, path, checks);
        refuse_stamps(&mut hop, path, checks);
        let mut emulation = self.emulation.clone();
        if emulation.wifi.is_some() {
            checks.refuse_present(
                path,
                ["outages"],
                "beside `wifi` says outages twice; the radio has its own, in [links.<name>.wifi.outages]",
            );
            checks.refuse_present(
                path,
                ["trace"],
                "beside `wifi` stands in its place, so no message would meet the radio; say one of them",
            );
        }
        let via = match (self.via.0.as_str(), network) {
            (SHARED_MEMORY, _) => {
                let why = "does not apply to via = \"shared-memory\", which has no gateway";
                checks.refuse_present(path, keys(&mut hop.table()), why);
                Via::SharedMemory
            }
            (EMULATED, _) => {
                refuse_slack(&hop.gateway.execution, path, checks);
                return Some(Via::Emulated(hop, Box::new(emulation.resolve())));
            }
            (_, Some(_)) => Via::Network(hop),
            (_, None) => return None,
        };
        let why = "needs via = \"emulated\": no real link can be told what to do";
        checks.refuse_present(path, keys(&mut emulation), why);
        Some(via)
    }

    /// The keys that only some transports have; a key of another one does not belong here.
    fn give_own_options(&self, hop: &mut Hop, path: &str, checks: &Checks<'_>) {
        for transport in transports() {
            for option in transport.options {
                let key = option.key;
                if transport.name == hop.transport.name {
                    let value = self.own.0.get(key).copied().unwrap_or(option.default);
                    hop.options.insert(key.to_owned(), value);
                } else if hop.transport.options.iter().all(|own| own.key != key) {
                    let why = format!("needs via = \"{}\"", transport.name);
                    checks.refuse_present(path, [key], &why);
                }
            }
        }
    }
}

impl EmulationTable {
    fn resolve(self) -> Emulation {
        let (wifi, outages) = (self.wifi, self.outages.unwrap_or_default());
        let both = &self.both.0;
        let [forward, backward] = [self.forward, self.backward].map(|own| {
            let parts = own.map_or_else(|| both.clone(), |own| own.or(both));
            LinkSpec {
                wifi,
                outages,
                ..LinkSpec::from(parts)
            }
        });
        Emulation {
            forward,
            backward,
            trace: self.trace,
        }
    }
}

/// All keys of a table, those in place of a table among them.
fn keys(options: &mut dyn Options) -> Vec<&'static str> {
    let mut found = Vec::new();
    for field in options.fields() {
        match field.slot {
            Slot::Part(part) => found.extend(keys(part)),
            Slot::Table(mut table) => {
                found.push(field.key);
                found.extend(table.shorthand().map(|short| short.key));
            }
            _ => found.push(field.key),
        }
    }
    found
}

/// A transport whose datagrams the kernel does not stamp has no stamps to ask for.
fn refuse_stamps(hop: &mut Hop, path: &str, checks: &Checks<'_>) {
    let Some(why) = hop.transport.capabilities.unstamped_because else {
        return;
    };
    if hop.socket.timestamps != Timestamps::Off {
        let words = crossing_words(|one| one.capabilities.unstamped_because.is_none());
        let why = format!(
            "needs via = {words}: over {} {why}; leave it out, or write \"off\"",
            hop.transport.label
        );
        checks.refuse_present(path, ["timestamps"], &why);
    }
    hop.socket.timestamps = Timestamps::Off;
}

/// An emulated delay ends with a timer, which the kernel may fire later by the slack; real-time
/// threads have none (prctl(2), `PR_SET_TIMERSLACK`).
fn refuse_slack(execution: &Execution, path: &str, checks: &Checks<'_>) {
    let (slack, most) = (execution.timer_slack, EMULATED_TIMER_SLACK_MAX);
    if slack > most && execution.scheduling() == Scheduling::Other {
        let problem = format!(
            "has a timer_slack of \"{}\", by which every delay of the emulated link could be late; \
             at most \"{}\", or scheduling = \"fifo\"",
            format_duration(slack),
            format_duration(most)
        );
        checks.refuse(join(path, "gateway"), Fault::Inconsistent(problem));
    }
}
