//! The checked topology: what runs where, which channels join it, and over which links. Every
//! reference resolves and every number is within its range. Tables that are in the file as they are
//! here declare their keys here; it reads no file and starts nothing.

use core::time::Duration;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use hil_account::Demand;
use hil_core::case_study::ParameterError;
use hil_core::message::ETHERNET_FRAME;
use hil_core::{options, words};
use hil_link::condition::{flow_label, flow_name};
use hil_link::spec::{LinkSpec, Way};

use super::adapter::EgmAdapter;
use super::clock_path::ClockEnd;
use super::flows::Flow;
use super::links::{Hop, Link};
use super::security::Security;
use super::tables::{FOLDER, HOST_ADDRESS, INTERFACE, NAME};

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
    pub(super) flows: Vec<Flow>,
    pub(super) security: Security,
}

options! {
    /// How long, from which seed, recorded where.
    #[derive(Eq)]
    pub struct Run {
        /// How long the roles run once all hosts are ready.
        duration: Duration = Duration::from_secs(20), in Duration::from_millis(100)..=Run::LONGEST;
        /// Seed of every random stream of the run.
        seed: u64 = 1, in 0..=i64::MAX.unsigned_abs();
        /// Folder that receives one sub-folder per run.
        record: Cow<'static, str> = Cow::Borrowed("runs"), in FOLDER;
        /// How long a host waits for its peers before the run starts.
        start_timeout: Duration = Duration::from_secs(30), in Duration::from_secs(1)..=Duration::from_hours(1);
        /// How long a host may be silent, or its connection missing, before it counts as gone; also while
        /// records are exchanged. The default lets a radio roam, and notices a host that vanished within
        /// half a minute.
        peer_timeout: Duration = Duration::from_secs(30), in Duration::from_secs(1)..=Duration::from_hours(1);
    }
}

impl Run {
    /// The longest duration; a run of two programs without a duration has it.
    pub const LONGEST: Duration = Duration::from_hours(7 * 24);

    /// How long it is to last; `None` where only its processes or a person end it.
    pub fn planned(&self) -> Option<Duration> {
        (self.duration < Self::LONGEST).then_some(self.duration)
    }
}

/// `[case]`: the case study.
#[derive(Debug, Clone, PartialEq)]
pub struct Case {
    /// Name under which the binary knows it.
    pub name: String,
    /// Every parameter, those the file leaves out filled with the case's defaults.
    pub parameters: toml::Table,
}

/// Why a key of a host without an address is refused.
const ONE_SUPERVISOR: &str =
    "needs `address`: without it one supervisor runs this host and its peers";
/// Why a key of a host without a clock path is refused.
const NO_CLOCK_PATH: &str = "needs `clock_address`: it belongs to a path for clock exchanges";

options! {
    /// A host. A file without any has one, `local`.
    #[derive(Eq)]
    pub struct Host
    with {
        /// Its key.
        name: String = String::new(),
    }
    {
        /// Address on the link under test. All hosts have one, or none has, and then all run on this PC.
        address: Option<IpAddr>, in HOST_ADDRESS;
        /// Interface that its gateways bind to.
        interface: Option<String>, in INTERFACE, needs(address, Host::has_address, ONE_SUPERVISOR);
        /// TCP port of its supervisor.
        control_port: u16 = 7_399, in 1_024..=65_535, needs(address, Host::has_address, ONE_SUPERVISOR);
        /// Address where it exchanges clocks, beside the link under test.
        clock_address: Option<IpAddr>, in HOST_ADDRESS, needs(address, Host::has_address,
            "needs `address`: without it this host and its peers run on one PC, on one clock");
        /// Interface that clock exchanges bind to.
        clock_interface: Option<String>, in INTERFACE,
            needs(clock_address, |host| host.clock_address.is_some(), NO_CLOCK_PATH);
        /// UDP port of its first clock path; each further one takes the next. The default leaves room for
        /// ten below the ports of links.
        clock_port: u16 = 7_390, in 1_024..=65_535,
            needs(clock_address, |host| host.clock_address.is_some(), NO_CLOCK_PATH);
    }
}

impl Host {
    /// Where gateways reach it: its address, or loopback when all hosts run on this PC.
    pub fn gateway_address(&self) -> IpAddr {
        self.address.unwrap_or(IpAddr::V4(Ipv4Addr::LOCALHOST))
    }

    fn has_address(&self) -> bool {
        self.address.is_some()
    }

    /// Where it exchanges clocks beside the link under test, if it does.
    pub fn clock(&self) -> Option<ClockEnd> {
        Some(ClockEnd {
            address: self.clock_address?,
            interface: self.clock_interface.clone(),
            port: self.clock_port,
        })
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
    pub restarts: Restarts,
}

impl Process {
    /// Its address in a network namespace of its own, if it runs in one.
    pub const fn inside(&self) -> Option<IpAddr> {
        match self.program {
            Program::Command { inside, .. } => inside,
            Program::BuiltIn { .. } | Program::Egm { .. } => None,
        }
    }

    /// True for a program of the user's that joins its channels itself and keeps no records: a witness beside it does.
    pub const fn is_witnessed(&self) -> bool {
        matches!(self.program, Program::Command { inside: None, .. })
    }

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
        /// Its address in a network namespace of its own; its channels are of frames then.
        inside: Option<IpAddr>,
    },
    /// Nothing of the role: a foreign EGM program plays it, and this process speaks with it.
    Egm {
        /// Name of the role.
        role: String,
        /// How to speak with the program.
        adapter: EgmAdapter,
    },
}

options! {
    /// How the kernel schedules a process or a gateway, and how it waits for messages.
    #[derive(Eq)]
    pub struct Execution as part {
        /// Cores it may use; none for any.
        cpu: Vec<u16> = Vec::new(), in 0..=1_023;
        /// Scheduling class.
        scheduling: SchedulingClass = SchedulingClass::Other;
        /// Priority, 1 (low) to 99. The default is below the 50 that threaded interrupt handlers get on
        /// `PREEMPT_RT`, so that the network card is served first.
        priority: u8 = 40, in 1..=99,
            needs(scheduling, |one| one.scheduling == SchedulingClass::Fifo, "needs scheduling = \"fifo\"");
        /// Lock all pages in memory.
        lock_memory: bool = false;
        /// How late the kernel may fire its timers.
        timer_slack: Duration = Duration::from_micros(1), in Duration::from_nanos(1)..=Duration::from_millis(1);
        /// How it waits for the next message or tick.
        wait: Wait = Wait::Block;
    }
}

impl Execution {
    /// Scheduling class with its priority.
    pub const fn scheduling(&self) -> Scheduling {
        match self.scheduling {
            SchedulingClass::Other => Scheduling::Other,
            SchedulingClass::Fifo => Scheduling::Fifo {
                priority: self.priority,
            },
        }
    }
}

words! {
    /// Scheduling class, by its word.
    pub enum SchedulingClass {
        /// `SCHED_OTHER`, the normal class.
        Other = "other",
        /// `SCHED_FIFO`.
        Fifo = "fifo",
    }
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

words! {
    /// How a thread waits.
    pub enum Wait {
        /// Sleep until woken: little CPU, a wake-up per message.
        Block = "block",
        /// Sleep until shortly before the expected arrival, then poll.
        Hybrid = "hybrid",
        /// Poll without pause; needs a core of its own.
        Spin = "spin",
    }
}

options! {
    /// What the end of a process means.
    #[derive(Copy, Eq)]
    pub struct Restarts as part {
        /// What the end of it means for the run. A gateway is started again by default: it holds no state
        /// of the robot, and the messages lost meanwhile are counted.
        on_exit: AtExit = AtExit::EndRun;
        /// It is started again at most this often in one run.
        restart_limit: u32 = 3, in 1..=100,
            needs(on_exit, |one| one.on_exit == AtExit::Restart, "needs on_exit = \"restart\"");
    }
}

impl Restarts {
    /// What the end means, with its limit.
    pub const fn on_exit(self) -> OnExit {
        match self.on_exit {
            AtExit::EndRun => OnExit::EndRun,
            AtExit::Restart => OnExit::Restart {
                limit: self.restart_limit,
            },
        }
    }
}

words! {
    /// What the end of a process means, by its word.
    pub enum AtExit {
        /// It ends the run: a restarted robot model would invalidate it.
        EndRun = "end-run",
        /// It is started again.
        Restart = "restart",
    }
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

options! {
    /// Identity of a channel's messages; owned, because foreign channels name theirs in the file.
    #[derive(Eq)]
    pub struct MessageLayout {
        /// Name and version, e.g. `hil.EgmCommand.v1`.
        name: String, in NAME, hint "a foreign channel states the name and size of its messages";
        /// Size of one message.
        size_bytes: usize, in 1..=16_777_216,
            hint "a foreign channel states the name and size of its messages";
        /// Alignment in shared memory, a power of two.
        alignment_bytes: usize = 8, in 1..=64;
    }
    check MessageLayout::check_alignment;
}

impl MessageLayout {
    /// Of Ethernet frames.
    pub(super) fn of_frames() -> Self {
        Self {
            name: ETHERNET_FRAME.name.to_owned(),
            size_bytes: ETHERNET_FRAME.size_bytes,
            alignment_bytes: ETHERNET_FRAME.alignment_bytes,
        }
    }

    fn check_alignment(&self) -> Result<(), ParameterError> {
        let alignment = self.alignment_bytes;
        if !alignment.is_power_of_two() {
            let problem = format!("{alignment} is no power of two");
            return Err(ParameterError::new("alignment_bytes", problem));
        }
        if self.size_bytes.is_multiple_of(alignment) {
            return Ok(());
        }
        let problem = format!("is no multiple of alignment_bytes, which is {alignment}");
        Err(ParameterError::new("size_bytes", problem))
    }
}

/// One channel: one producer, and one consumer or none but the record.
#[derive(Debug, Clone, PartialEq)]
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
    /// What its consumer asks of the network, if the file says.
    pub demand: Option<Demand>,
}

impl Channel {
    /// True when its messages are the Ethernet frames of a program with an address inside.
    pub fn carries_frames(&self) -> bool {
        self.message.name == ETHERNET_FRAME.name
    }

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
    pub fn of(base: u16, direction: Way, is_one_address: bool) -> Option<Self> {
        let offset = match direction {
            Way::Forward => 0,
            Way::Backward => 1,
        };
        let receiver = base.checked_add(offset)?;
        let sender = receiver.checked_add(if is_one_address { 2 } else { 0 })?;
        Some(Self { sender, receiver })
    }
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
    pub direction: Way,
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
            Way::Forward
        } else {
            Way::Backward
        };
        let is_one_address = from_host.gateway_address() == to_host.gateway_address();
        let ports = LinkPorts::of(hop.port, direction, is_one_address)?;
        let emulation = link.emulation();
        let spec = emulation.map(|emulation| match direction {
            Way::Forward => &emulation.forward,
            Way::Backward => &emulation.backward,
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

impl Crossing<'_> {
    /// Name of all that goes this way on the link: the flow.
    pub fn flow_name(&self) -> String {
        flow_name(&self.link.name, self.direction)
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
        let ways = 2 * before.count() + usize::from(crossing.direction == Way::Backward);
        let number = u16::try_from(self.clock_paths().count() + ways).unwrap_or(u16::MAX);
        u16::MAX - number
    }
}
