//! From a checked topology to what this supervisor starts: domains, channels, processes. It
//! starts nothing itself.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use hil_arm::egm::messages::Side as ArmSide;
use hil_arm::egm::parameters::{ControllerSettings, EgmParameters};
use hil_core::message::{FNV_OFFSET, fnv1a};
use hil_link::condition::flow_name;

use super::clock_path;
use crate::process::own_program::ProgramRealtime;
use hil_platform::domain_address::domain_base_candidates;
use hil_platform::open_files;
use hil_platform::own_folder::OwnFolder;
use hil_platform::realtime::{RealtimeRequest, SchedulingPolicy};
use hil_platform::wait::WaitMode;
use hil_rundir::announcement;
use hil_rundir::event::ProcessKind;
use hil_rundir::launch::{
    AdapterSettings, ArmLaunch, CableWork, ChannelLaunch, DirectionLaunch, FrameWork, GatewayWork,
    Side, SocketLaunch, WitnessWork, WitnessedChannel,
};
use hil_rundir::live_run::Source;
use hil_topology::emulation::EmulationLaunch;
use hil_topology::{
    AdapterKind, Channel, Crossing, EgmAdapter, Execution, Host, OnExit, Process, Program,
    RoleChannel, RoleSpec, Scheduling, Topology, Wait, command_channel, feedback_channel,
    gateway_name, witness_name,
};

/// Everything one supervisor is responsible for.
#[derive(Debug)]
pub(crate) struct Plan {
    /// One per host that runs here.
    pub(crate) hosts: Vec<HostPlan>,
    /// Clock paths first, whose exchanges are to lie on both sides of every message; then gateways
    /// and adapters, which must be ready before components publish.
    pub(crate) processes: Vec<ProcessPlan>,
}

/// A host that runs here.
#[derive(Debug)]
pub(crate) struct HostPlan {
    pub(crate) name: String,
    /// Channels in shared memory with an end on this host.
    pub(crate) channels: Vec<Channel>,
    /// Names of those that a gateway writes here.
    pub(crate) arriving: BTreeSet<String>,
    /// Channels for orders to the directions of emulated links that are emulated here.
    pub(crate) orders: BTreeSet<String>,
    /// Names of those whose messages no process here records, so that who wants to see them looks into the shared
    /// memory of this host, and of those that a witness reads.
    pub(crate) observed: BTreeSet<String>,
}

/// A process to start here.
#[derive(Debug)]
pub(crate) struct ProcessPlan {
    pub(crate) name: String,
    pub(crate) host: String,
    pub(crate) task: ProcessTask,
    pub(crate) on_exit: OnExit,
}

/// What it executes.
#[derive(Debug)]
pub(crate) enum ProcessTask {
    /// A role of the case, in this binary.
    Component {
        card: RoleSpec,
        realtime: RealtimeRequest,
        wait: WaitMode,
    },
    /// The gateway of one link, in this binary.
    Gateway(GatewayWork),
    /// One end of a clock path: a gateway that carries no messages.
    ClockPath(GatewayWork),
    /// What speaks with a foreign program, in this binary.
    Adapter(AdapterSettings),
    /// What carries the frames of a program of the user's, in this binary.
    Cable(CableWork),
    /// What records for the user's own programs of a host, in this binary.
    Witness(WitnessWork),
    /// The user's own program.
    Foreign {
        card: RoleSpec,
        command: Vec<String>,
        environment: BTreeMap<String, String>,
        realtime: ProgramRealtime,
    },
}

impl ProcessPlan {
    /// True for what makes messages, or hears them.
    pub(crate) fn is_component(&self) -> bool {
        !self.is_carrier() && !self.is_clock_path()
    }

    /// True for what exchanges clocks and nothing else.
    pub(crate) fn is_clock_path(&self) -> bool {
        matches!(self.task, ProcessTask::ClockPath(_))
    }

    /// True for what has datagrams of ours on the network.
    pub(crate) fn is_gateway(&self) -> bool {
        matches!(self.task, ProcessTask::Gateway(_)) || self.is_clock_path()
    }

    /// True for what carries messages instead of making them, or only reads them: a gateway, an adapter, a witness.
    pub(crate) fn is_carrier(&self) -> bool {
        matches!(
            self.task,
            ProcessTask::Gateway(_) | ProcessTask::Adapter(_) | ProcessTask::Witness(_)
        )
    }

    /// What it is.
    pub(crate) fn kind(&self) -> ProcessKind {
        match &self.task {
            ProcessTask::Component { .. } => ProcessKind::Component,
            ProcessTask::Gateway(_) => ProcessKind::Gateway,
            ProcessTask::ClockPath(_) => ProcessKind::ClockPath,
            ProcessTask::Adapter(_) => ProcessKind::Adapter,
            ProcessTask::Witness(_) => ProcessKind::Witness,
            ProcessTask::Foreign { .. } | ProcessTask::Cable(_) => ProcessKind::OwnProgram,
        }
    }

    /// The role of the case that it plays, or that a foreign program plays through it.
    pub(crate) fn role(&self) -> Option<String> {
        match &self.task {
            ProcessTask::Component { card, .. } | ProcessTask::Foreign { card, .. } => {
                card.role.clone()
            }
            ProcessTask::Adapter(adapter) => Some(adapter.role.clone()),
            ProcessTask::Gateway(_)
            | ProcessTask::ClockPath(_)
            | ProcessTask::Cable(_)
            | ProcessTask::Witness(_) => None,
        }
    }
}

/// What to run on `hosts`, all of them on this PC.
pub(crate) fn plan(topology: &Topology, hosts: &[&Host]) -> Plan {
    let is_here = |name: &str| hosts.iter().any(|host| host.name == name);
    let host_plans = hosts.iter().map(|host| {
        let channels = topology.channels().iter().filter(|channel| {
            // What is only recorded needs no memory to share.
            let ends = channel.to.iter().chain([&channel.from]);
            !channel.is_recorded_only()
                && ends
                    .filter_map(|name| topology.process(name))
                    .any(|process| process.host == host.name)
        });
        let observed = topology.channels().iter().filter(|channel| {
            let source = announcement::source(topology, channel, &is_here);
            matches!(source, Some(Source::SharedMemory { host: at, .. }) if at == host.name)
        });
        let witnessed = witnessed(topology, host).into_iter().map(|one| one.name);
        let observed = observed.map(|channel| channel.name.clone());
        HostPlan {
            name: host.name.clone(),
            observed: observed.chain(witnessed).collect(),
            channels: channels.cloned().collect(),
            arriving: arriving(topology, host),
            orders: order_channels(topology, host),
        }
    });
    let clock_paths = hosts.iter().flat_map(|host| clock_path::on(topology, host));
    let gateways = hosts.iter().flat_map(|host| gateways_on(topology, host));
    let processes = topology
        .processes()
        .iter()
        .filter(|process| is_here(&process.host))
        .map(|process| component(topology, process));
    let witnesses = hosts.iter().filter_map(|host| {
        let channels = witnessed(topology, host);
        (!channels.is_empty()).then(|| ProcessPlan {
            name: witness_name(&host.name),
            host: host.name.clone(),
            task: ProcessTask::Witness(WitnessWork {
                patience: topology.run().start_timeout / 2,
                channels,
            }),
            on_exit: OnExit::EndRun,
        })
    });
    let carriers = clock_paths.chain(gateways).chain(witnesses);
    let mut processes: Vec<ProcessPlan> = carriers.chain(processes).collect();
    processes.sort_by_key(|process| (!process.is_clock_path(), process.is_component()));
    Plan {
        hosts: host_plans.collect(),
        processes,
    }
}

/// The channels in the shared memory of `host` with a program of the user's there at an end, who records nothing.
fn witnessed(topology: &Topology, host: &Host) -> Vec<WitnessedChannel> {
    let own = |name: &str| {
        let process = topology.process(name)?;
        (process.is_witnessed() && process.host == host.name).then_some(process)
    };
    let channels = topology.channels().iter();
    let channels = channels.filter(|channel| !channel.is_recorded_only());
    let witnessed = channels.map(|channel| {
        let publisher = own(&channel.from);
        let reader = channel.to.as_deref().and_then(own);
        WitnessedChannel {
            name: channel.name.clone(),
            message_size_bytes: channel.message.size_bytes,
            publisher: publisher.map(|one| one.name.clone()),
            reader: reader.map(|one| one.name.clone()),
            has_messages: publisher.is_some_and(|one| one.role().is_some()),
        }
    });
    witnessed
        .filter(|one| one.publisher.is_some() || one.reader.is_some())
        .collect()
}

fn arriving(topology: &Topology, host: &Host) -> BTreeSet<String> {
    topology
        .crossings()
        .filter(|crossing| crossing.to_host.name == host.name)
        .map(|crossing| crossing.channel.name.clone())
        .collect()
}

/// The channels for orders to what is emulated on `host`: it receives.
fn order_channels(topology: &Topology, host: &Host) -> BTreeSet<String> {
    let seed = topology.run().seed;
    topology
        .crossings()
        .filter(|crossing| crossing.to_host.name == host.name)
        .filter_map(|crossing| EmulationLaunch::of(&crossing, seed))
        .map(|emulation| flow_name(&emulation.link, emulation.way))
        .collect()
}

fn component(topology: &Topology, process: &Process) -> ProcessPlan {
    let card = topology
        .role_spec(&process.name)
        .expect("the process is of this topology");
    let task = match &process.program {
        Program::BuiltIn { .. } => ProcessTask::Component {
            card,
            realtime: realtime(&process.execution, 0),
            wait: wait_mode(process.execution.wait),
        },
        Program::Command {
            command,
            environment,
            inside,
            ..
        } => match cable_ends(&card).zip(*inside) {
            Some(([input, output], inside)) => ProcessTask::Cable(CableWork {
                inside,
                command: command.clone(),
                environment: environment.clone(),
                open_files: open_files::inherited_limit(),
                cable_socket: cable_socket_of(topology, &process.name).unwrap_or_default(),
                frames: topology
                    .crossings()
                    .all(|crossing| crossing.channel.name != output.name)
                    .then(|| FrameWork {
                        realtime: [0, 1].map(|index| realtime(&process.execution, index)),
                        wait: wait_mode(process.execution.wait),
                    }),
                input,
                output,
            }),
            None => ProcessTask::Foreign {
                card,
                command: command.clone(),
                environment: environment.clone(),
                realtime: program_realtime(&process.execution),
            },
        },
        Program::Egm { role, adapter } => {
            let host = topology.host(&process.host);
            let interface = host.and_then(|host| host.interface.clone());
            ProcessTask::Adapter(adapter_settings(role, adapter, &card, process, interface))
        }
    };
    ProcessPlan {
        name: process.name.clone(),
        host: process.host.clone(),
        task,
        on_exit: process.restarts.on_exit(),
    }
}

/// The name of the socket of the cable of process `name`, if it has one. It is short, as paths of sockets must be.
fn cable_socket_of(topology: &Topology, name: &str) -> Option<String> {
    let mut processes = topology.processes().iter().enumerate();
    let (index, _) = processes.find(|(_, one)| one.name == name && one.inside().is_some())?;
    Some(format!("cable-{index}"))
}

/// The channels of a program with an address inside, of which the topology has one each way.
fn cable_ends(card: &RoleSpec) -> Option<[RoleChannel; 2]> {
    let (input, output) = (card.inputs.first()?, card.outputs.first()?);
    Some([input.clone(), output.clone()])
}

fn adapter_settings(
    role: &str,
    adapter: &EgmAdapter,
    card: &RoleSpec,
    process: &Process,
    interface: Option<String>,
) -> AdapterSettings {
    let mut arms = Vec::new();
    for side in ArmSide::BOTH {
        let Some(address) = adapter.address(side) else {
            continue;
        };
        let (input, output) = match adapter.kind {
            AdapterKind::Robot => (feedback_channel(side), command_channel(side)),
            AdapterKind::Sensor => (command_channel(side), feedback_channel(side)),
        };
        let named = |channels: &[RoleChannel], name: &str| {
            channels
                .iter()
                .find(|channel| channel.name == name)
                .cloned()
        };
        // A channel whose other role nobody plays is not there; the topology saw to the rest.
        let (Some(input), Some(output)) =
            (named(&card.inputs, input), named(&card.outputs, output))
        else {
            continue;
        };
        arms.push(ArmLaunch {
            arm: side,
            address,
            input,
            output,
            realtime: realtime(&process.execution, arms.len()),
        });
    }
    let (cycle, delay_cycles) = robot_cycle(card);
    let is_used = |channel: &&RoleChannel| arms.iter().any(|arm| arm.input == **channel);
    AdapterSettings {
        role: role.to_owned(),
        egm: adapter.clone(),
        cycle_ns: nanoseconds(cycle),
        planned_lead_ns: nanoseconds(cycle) * delay_cycles,
        wait: wait_mode(process.execution.wait),
        interface,
        spare: card
            .inputs
            .iter()
            .filter(|one| !is_used(one))
            .cloned()
            .collect(),
        arms,
    }
}

/// The robot's cycle, and by how many of them its measured joints lag the planned ones: what the
/// case's `egm` table says, or its default.
fn robot_cycle(card: &RoleSpec) -> (Duration, u64) {
    let table = card.parameters.get("egm").cloned();
    let parameters: EgmParameters = table
        .and_then(|egm| egm.try_into().ok())
        .unwrap_or_default();
    let settings = parameters.settings();
    let settings = settings.unwrap_or_else(|_checked| ControllerSettings::of(parameters.preset));
    (settings.cycle, settings.control_delay_cycles as u64)
}

fn nanoseconds(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}

fn gateways_on(topology: &Topology, host: &Host) -> Vec<ProcessPlan> {
    let mut plans = Vec::new();
    for link in topology.links() {
        let Some(hop) = link.hop() else { continue };
        let crossings: Vec<Crossing<'_>> = topology
            .crossings()
            .filter(|crossing| crossing.link.name == link.name)
            .collect();
        let mut directions = Vec::new();
        for side in [Side::Egress, Side::Ingress] {
            let is_here = |crossing: &&Crossing<'_>| {
                let end = match side {
                    Side::Egress => crossing.from_host,
                    Side::Ingress => crossing.to_host,
                };
                end.name == host.name
            };
            let here: Vec<&Crossing<'_>> = crossings.iter().filter(is_here).collect();
            let index = directions.len();
            directions.extend(direction(topology, &here, side, index));
        }
        if !directions.is_empty() {
            plans.push(ProcessPlan {
                name: gateway_name(&link.name, &host.name),
                host: host.name.clone(),
                task: ProcessTask::Gateway(GatewayWork {
                    directions,
                    ready_within: None,
                }),
                on_exit: hop.gateway.restarts.on_exit(),
            });
        }
    }
    plans
}

/// One way of a link, which `crossings` go; `None` when nothing goes it.
fn direction(
    topology: &Topology,
    crossings: &[&Crossing<'_>],
    side: Side,
    index: usize,
) -> Option<DirectionLaunch> {
    let first = crossings.first()?;
    let (hop, ports) = (first.hop, first.ports);
    let sender = SocketAddr::new(first.from_host.gateway_address(), ports.sender);
    let receiver = SocketAddr::new(first.to_host.gateway_address(), ports.receiver);
    let (local, peer, here) = match side {
        Side::Egress => (sender, receiver, first.from_host),
        Side::Ingress => (receiver, sender, first.to_host),
    };
    let seed = topology.run().seed;
    let channels = crossings.iter().map(|crossing| {
        let channel = crossing.channel;
        ChannelLaunch {
            channel: channel.name.clone(),
            channel_id: channel.channel_id,
            message: channel.message.name.clone(),
            size_bytes: channel.message.size_bytes,
            alignment_bytes: channel.message.alignment_bytes,
            depth: channel.depth,
            emulation: EmulationLaunch::of(crossing, seed).filter(|_| side == Side::Ingress),
            cable_socket: match side {
                Side::Egress => cable_socket_of(topology, &channel.from),
                Side::Ingress => channel
                    .to
                    .as_deref()
                    .and_then(|to| cable_socket_of(topology, to)),
            },
        }
    });
    Some(DirectionLaunch {
        flow: first.flow_name(),
        flow_number: topology.flow_number(first),
        side,
        local,
        peer,
        socket: SocketLaunch {
            interface: here.interface.clone(),
            transport: hop.transport.name.to_owned(),
            options: hop.options.clone(),
            common: hop.socket.clone(),
        },
        wait: wait_mode(hop.gateway.execution.wait),
        realtime: realtime(&hop.gateway.execution, index),
        channels: channels.collect(),
    })
}

/// The request for thread number `index` of something that runs as `execution` says: its CPUs
/// are dealt out in turn.
fn realtime(execution: &Execution, index: usize) -> RealtimeRequest {
    let cpu = (!execution.cpu.is_empty())
        .then(|| usize::from(execution.cpu[index % execution.cpu.len()]));
    RealtimeRequest {
        cpu,
        policy: match execution.scheduling() {
            Scheduling::Other => SchedulingPolicy::Other,
            Scheduling::Fifo { priority } => SchedulingPolicy::Fifo { priority },
        },
        lock_memory: execution.lock_memory,
        timer_slack: Some(execution.timer_slack),
    }
}

fn program_realtime(execution: &Execution) -> ProgramRealtime {
    let cpus = execution.cpu.iter().map(|cpu| usize::from(*cpu));
    let RealtimeRequest {
        policy,
        timer_slack,
        ..
    } = realtime(execution, 0);
    ProgramRealtime {
        cpus: cpus.collect(),
        policy,
        timer_slack,
    }
}

fn wait_mode(wait: Wait) -> WaitMode {
    match wait {
        Wait::Block => WaitMode::Block,
        Wait::Hybrid => WaitMode::Hybrid,
        Wait::Spin => WaitMode::Spin,
    }
}

/// Where the shared-memory domain of `host` lies: short, because a socket path below it must
/// stay under 108 bytes. `run` is the whole path of the run folder: runs that record into
/// different folders may bear one name.
pub(crate) fn domain_root(base: Option<&PathBuf>, run: &str, host: &str) -> PathBuf {
    let run = fnv1a(FNV_OFFSET, run.as_bytes());
    let hash = fnv1a(fnv1a(run, &[0]), host.as_bytes());
    domain_base(base).join(format!("{:012x}", hash & 0xffff_ffff_ffff))
}

/// Folder of all domains: `base`, or the default.
pub(crate) fn domain_base(base: Option<&PathBuf>) -> PathBuf {
    base.cloned().unwrap_or_else(default_domain_base)
}

/// The first candidate that is this user's alone, or can be made so; the last one is tried by who uses it.
fn default_domain_base() -> PathBuf {
    let mut candidates = domain_base_candidates();
    let last = candidates.pop().unwrap_or_default();
    let is_own = |folder: &PathBuf| OwnFolder::create(folder).is_ok();
    candidates.into_iter().find(is_own).unwrap_or(last)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_of_one_name_in_different_folders_have_different_domains() {
        let base = PathBuf::from("/run/hil");
        let root = |run, host| domain_root(Some(&base), run, host);
        assert_ne!(root("/a/run-1", "x"), root("/b/run-1", "x"));
        assert_ne!(root("/a/run-1", "x"), root("/a/run-1", "y"));
        assert_eq!(root("/a/run-1", "x"), root("/a/run-1", "x"));
    }
}
