//! The checked topology: what runs where, which channels join it, and over which links. Every
//! reference resolves and every number is within `limits`; it reads no file and starts nothing.

use core::fmt;
use core::time::Duration;
use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use hil_core::message::type_hash;
use hil_link::condition::{flow_label, flow_name};
use hil_link::spec::{LinkSpec, Way};

use super::model_links::{Hop, Link};

use super::adapter::EgmAdapter;
use super::clock_path::ClockEnd;
use super::security::Security;

/// A topology file after every check. Only [`load`](super::load) and [`parse`](super::parse)
/// make one.
#[derive(Debug, Clone, PartialEq)]
pub struct Topology {
    pub(super) name: String,
    pub(super) run: Run,
    pub(super) case: Option<Case>,
    pub(super) hosts: Vec<Host>,
    pub(super) processes: Vec<Process>,
    pub(super) channels: Vec<Channel>,
    pub(super) links: Vec<Link>,
    pub(super) security: Security,
}

/// `[run]`: how long, from which seed, recorded where.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Run {
    /// How long the roles run once all hosts are ready.
    pub duration: Duration,
    /// Seed of every random stream of the run.
    pub seed: u64,
    /// Folder that receives one sub-folder per run.
    pub record_folder: String,
    /// How long a host waits for its peers before the run starts.
    pub start_timeout: Duration,
    /// How long a host may be silent during the run before it counts as gone.
    pub peer_timeout: Duration,
}

/// `[case]`: the case study.
#[derive(Debug, Clone, PartialEq)]
pub struct Case {
    /// Name under which the binary knows it.
    pub name: String,
    /// Every parameter, those the file leaves out filled with the case's defaults.
    pub parameters: toml::Table,
}

/// One `[hosts.<name>]`, or the single implicit host `local`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Host {
    /// Its key.
    pub name: String,
    /// Address on the link under test; `None` when it runs on this PC beside its peers.
    pub address: Option<IpAddr>,
    /// Interface its gateways bind to, when named.
    pub interface: Option<String>,
    /// TCP port of its supervisor; meaningful only with an address.
    pub control_port: u16,
    /// Where it exchanges clocks beside the link under test, if it does.
    pub clock: Option<ClockEnd>,
}

impl Host {
    /// Where gateways reach it: its address, or loopback when all hosts run on this PC.
    pub fn gateway_address(&self) -> IpAddr {
        self.address.unwrap_or(IpAddr::V4(Ipv4Addr::LOCALHOST))
    }

    /// Where its supervisor listens; `None` when one supervisor runs all hosts.
    pub fn control_address(&self) -> Option<SocketAddr> {
        let port = self.control_port;
        self.address.map(|address| SocketAddr::new(address, port))
    }
}

/// One `[processes.<name>]`.
#[derive(Debug, Clone, PartialEq)]
pub struct Process {
    /// Its key.
    pub name: String,
    /// Name of the host it runs on.
    pub host: String,
    /// What it executes.
    pub program: Program,
    /// How the kernel schedules it and how it waits.
    pub execution: Execution,
    /// What its end means for the run.
    pub on_exit: OnExit,
}

impl Process {
    /// The role of the case it plays, if any.
    pub fn role(&self) -> Option<&str> {
        match &self.program {
            Program::BuiltIn { role } | Program::Egm { role, .. } => Some(role),
            Program::Command { role, .. } => role.as_deref(),
        }
    }
}

/// What a process executes.
#[derive(Debug, Clone, PartialEq)]
pub enum Program {
    /// A role of the case study, shipped in this binary.
    BuiltIn {
        /// Name of the role.
        role: String,
    },
    /// The user's own program.
    Command {
        /// The role of the case it stands in for; `None` when it has foreign channels only.
        role: Option<String>,
        /// Program and arguments; never empty.
        command: Vec<String>,
        /// Variables added to its environment.
        environment: BTreeMap<String, String>,
    },
    /// Nothing of the role: a foreign EGM program plays it, and this process speaks with it.
    Egm {
        /// Name of the role.
        role: String,
        /// How to speak with the program.
        adapter: EgmAdapter,
    },
}

/// How the kernel schedules a process or a gateway, and how it waits for messages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Execution {
    /// Cores it may use; empty means any.
    pub cpus: Vec<u16>,
    /// Scheduling class.
    pub scheduling: Scheduling,
    /// Lock all pages in memory.
    pub locks_memory: bool,
    /// How late the kernel may fire its timers.
    pub timer_slack: Duration,
    /// How it waits for the next message or tick.
    pub wait: Wait,
}

/// Scheduling class.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scheduling {
    /// `SCHED_OTHER`, the normal class.
    Other,
    /// `SCHED_FIFO`.
    Fifo {
        /// 1 (low) to 99.
        priority: u8,
    },
}

/// How a thread waits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wait {
    /// Sleep until woken: little CPU, a wake-up per message.
    Block,
    /// Sleep until shortly before the expected arrival, then poll.
    Hybrid,
    /// Poll without pause; needs a core of its own.
    Spin,
}

/// What the end of a process means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OnExit {
    /// It ends the run: a restarted robot model would invalidate it.
    EndRun,
    /// It is started again.
    Restart {
        /// At most this often in one run.
        limit: u32,
    },
}

/// Identity of a channel's messages; owned, because foreign channels name theirs in the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MessageLayout {
    /// Name and version, e.g. `hil.EgmCommand.v1`.
    pub name: String,
    /// Size of one message.
    pub size_bytes: usize,
    /// Alignment in shared memory, a power of two.
    pub alignment_bytes: usize,
}

impl MessageLayout {
    /// The hash both hosts compare; equals that of the message type of the same identity.
    pub fn hash(&self) -> u64 {
        type_hash(&self.name, self.size_bytes, self.alignment_bytes)
    }
}

/// One channel: one producer, and one consumer or none but the record.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Channel {
    /// Number in datagrams: the case's channels in their order, then foreign ones by name.
    pub channel_id: u16,
    /// Name, also of the shared-memory service.
    pub name: String,
    /// What it carries.
    pub message: MessageLayout,
    /// Process that publishes.
    pub from: String,
    /// Process that subscribes; `None` when its messages go to the run's record only.
    pub to: Option<String>,
    /// Messages the shared-memory queue holds; 0 without a consumer, as there is no queue.
    pub depth: usize,
    /// Name of its link, if the file gives one.
    pub link: Option<String>,
    /// True when gateways carry it over its link, false when it stays in shared memory.
    pub is_carried: bool,
    /// True when the file declares it, false when the case does.
    pub is_foreign: bool,
}

impl Channel {
    /// True when its messages go to the run's record only: it is in no shared memory.
    pub fn is_recorded_only(&self) -> bool {
        self.to.is_none()
    }
}

/// The two ports of one way of a link. Over TCP only the receiver's is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LinkPorts {
    /// Bound on the host that sends.
    pub sender: u16,
    /// Bound on the host that receives.
    pub receiver: u16,
}

impl LinkPorts {
    /// Ports that a link takes from its `port` on: one for each way, of one number at both ends; between
    /// hosts at one address as many again for the ends that send.
    pub const fn count(is_one_address: bool) -> u16 {
        if is_one_address { 4 } else { 2 }
    }

    /// The ports of one way of a link with first port `base`; `None` beyond 65535.
    pub fn of(base: u16, direction: Direction, is_one_address: bool) -> Option<Self> {
        let offset = match direction {
            Direction::Forward => 0,
            Direction::Backward => 1,
        };
        let receiver = base.checked_add(offset)?;
        let sender = receiver.checked_add(if is_one_address { 2 } else { 0 })?;
        Some(Self { sender, receiver })
    }
}

/// The way a channel travels on its link.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// From the first host of [`Link::between`] to the second.
    Forward,
    /// From the second to the first.
    Backward,
}

/// A channel whose producer and consumer are on different hosts.
#[derive(Debug, Clone, Copy)]
pub struct Crossing<'a> {
    /// The channel.
    pub channel: &'a Channel,
    /// The link that carries it.
    pub link: &'a Link,
    /// Settings of that link.
    pub hop: &'a Hop,
    /// Ports of that way of the link.
    pub ports: LinkPorts,
    /// Host of the producer.
    pub from_host: &'a Host,
    /// Host of the consumer.
    pub to_host: &'a Host,
    /// Its way on the link.
    pub direction: Direction,
    /// What the emulation does to it; `None` on a real hop.
    pub spec: Option<&'a LinkSpec>,
}

impl Topology {
    /// `name` of the file.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// `[run]`.
    pub fn run(&self) -> &Run {
        &self.run
    }

    /// `[case]`; `None` when the file runs the user's own programs only.
    pub fn case(&self) -> Option<&Case> {
        self.case.as_ref()
    }

    /// The hosts by name; at least one.
    pub fn hosts(&self) -> &[Host] {
        &self.hosts
    }

    /// The processes by name; at least one.
    pub fn processes(&self) -> &[Process] {
        &self.processes
    }

    /// The channels by [`Channel::channel_id`].
    pub fn channels(&self) -> &[Channel] {
        &self.channels
    }

    /// The links by name.
    pub fn links(&self) -> &[Link] {
        &self.links
    }

    /// The host called `name`.
    pub fn host(&self, name: &str) -> Option<&Host> {
        self.hosts.iter().find(|host| host.name == name)
    }

    /// The process called `name`.
    pub fn process(&self, name: &str) -> Option<&Process> {
        self.processes.iter().find(|process| process.name == name)
    }

    /// The channel called `name`.
    pub fn channel(&self, name: &str) -> Option<&Channel> {
        self.channels.iter().find(|channel| channel.name == name)
    }

    /// The link called `name`.
    pub fn link(&self, name: &str) -> Option<&Link> {
        self.links.iter().find(|link| link.name == name)
    }

    /// The processes of the host called `host`, by name.
    pub fn processes_on<'a>(&'a self, host: &'a str) -> impl Iterator<Item = &'a Process> {
        let processes = self.processes.iter();
        processes.filter(move |process| process.host == host)
    }

    /// True when one supervisor runs every host on this PC, because no host has an address.
    pub fn is_all_local(&self) -> bool {
        self.hosts.iter().all(|host| host.address.is_none())
    }

    /// The channels that leave their host, by [`Channel::channel_id`].
    pub fn crossings(&self) -> impl Iterator<Item = Crossing<'_>> {
        self.channels
            .iter()
            .filter_map(|channel| self.crossing(channel))
    }

    /// How `channel` leaves its host; `None` when it stays.
    pub fn crossing<'a>(&'a self, channel: &'a Channel) -> Option<Crossing<'a>> {
        let link = self.link(channel.link.as_deref().filter(|_| channel.is_carried)?)?;
        let hop = link.hop()?;
        let from_host = self.host(&self.process(&channel.from)?.host)?;
        let to_host = self.host(&self.process(channel.to.as_deref()?)?.host)?;
        let is_forward = link.between.as_ref()?[0] == from_host.name;
        let direction = if is_forward {
            Direction::Forward
        } else {
            Direction::Backward
        };
        let is_one_address = from_host.gateway_address() == to_host.gateway_address();
        let ports = LinkPorts::of(hop.port, direction, is_one_address)?;
        let emulation = link.emulation();
        let spec = emulation.map(|emulation| match direction {
            Direction::Forward => &emulation.forward,
            Direction::Backward => &emulation.backward,
        });
        Some(Crossing {
            channel,
            link,
            hop,
            ports,
            from_host,
            to_host,
            direction,
            spec,
        })
    }
}

impl Direction {
    /// The same way as the link models call it.
    pub const fn way(self) -> Way {
        match self {
            Self::Forward => Way::Forward,
            Self::Backward => Way::Backward,
        }
    }
}

impl Crossing<'_> {
    /// Name of all that goes this way on the link: the flow.
    pub fn flow_name(&self) -> String {
        flow_name(&self.link.name, self.direction.way())
    }

    /// The same for a reader: `hop/forward`.
    pub fn flow_label(&self) -> String {
        flow_label(&self.flow_name()).to_owned()
    }
}

impl Topology {
    /// Number in datagrams of what goes the way of `crossing` on its link: counted down from the numbers of
    /// the clock paths, where no channel's is.
    pub fn flow_number(&self, crossing: &Crossing<'_>) -> u16 {
        let links = self.links.iter();
        let before = links.take_while(|link| link.name != crossing.link.name);
        let ways = 2 * before.count() + usize::from(crossing.direction == Direction::Backward);
        let number = u16::try_from(self.clock_paths().count() + ways).unwrap_or(u16::MAX);
        u16::MAX - number
    }
}

macro_rules! words {
    ($type:ident { $($variant:ident = $word:literal),+ $(,)? }) => {
        impl $type {
            /// Every word the file may say, with its meaning.
            pub(super) const WORDS: &'static [(&'static str, Self)] =
                &[$(($word, Self::$variant)),+];

            /// The word in the file.
            pub const fn word(self) -> &'static str {
                match self { $(Self::$variant => $word),+ }
            }
        }

        impl fmt::Display for $type {
            fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
                formatter.write_str(self.word())
            }
        }
    };
}
pub(super) use words;

words!(Wait { Block = "block", Hybrid = "hybrid", Spin = "spin" });
