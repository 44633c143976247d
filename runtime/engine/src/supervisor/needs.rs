//! What a run takes of its host, from the plan, against what the host gives: memory for channels, open
//! files, threads, locked memory. It is looked at before anything is made, because each of these is
//! missed late and without a name. It takes nothing itself.

use core::fmt;
use std::path::{Path, PathBuf};

use hil_platform::host_facts::HostFiles;
use hil_platform::host_limits::{Headroom, locked_memory_bound, memory_headroom, thread_headroom};
use hil_platform::{open_files, words};
use hil_rundir::launch::{AdapterSettings, CableWork, GatewayWork, Side};
use hil_rundir::record::GROWING_FILE_BYTES;
use hil_shm::{ChannelSettings, Room, SHARED_MEMORY_DIRECTORY};
use hil_topology::{Host, RoleSpec, Topology};

use super::domains::channel_settings;
use super::plan::{HostPlan, Plan, ProcessPlan, ProcessTask, domain_base, plan};

// Counted in runs of the binary; the tests of limits compare them with what runs have open.

/// Descriptors of any process of ours before it has a channel.
const OWN_FILES: u64 = 24;
/// Of the supervisor: those, its peers' connections with a turn of strangers among them, and the report.
const SUPERVISOR_FILES: u64 = 160;
/// Of the supervisor for each channel it holds, and for each process.
const HELD_CHANNEL_FILES: u64 = 4;
const CHILD_FILES: u64 = 4;
/// Of a gateway for one way of its link, or of an adapter for one of its channels: socket, clock exchanges.
const DIRECTION_FILES: u64 = 8;
/// Of a gateway or an adapter for each of its channels: port, records, four observers.
const CARRIED_CHANNEL_FILES: u64 = 16;
/// Of whoever gives a program's cable away, and of whoever fetches it: socket, ring, connection, records.
const CABLE_FILES: u64 = 8;
/// Of a component for each of its channels: port, records, four observers.
const COMPONENT_CHANNEL_FILES: u64 = 16;

/// What iceoryx2 keeps in the folder of a domain: for each channel its services and the tags of its
/// ports, for each process that it is alive.
const CHANNEL_ENTRIES: Room = Room {
    bytes: 16 << 10,
    files: 32,
};
const MEMBER_ENTRIES: Room = Room {
    bytes: 32 << 10,
    files: 16,
};

/// Threads of any process of ours: itself, its orders, its writer, and one to spare.
const OWN_THREADS: u64 = 4;
/// Of the supervisor: it, its log keeper, its peers' readers and writers, greetings.
const SUPERVISOR_THREADS: u64 = 16;

/// What a process has locked at least when it locks its memory, beside its channels: its program, and
/// the stack of each thread.
const LOCKED_PROGRAM_BYTES: u64 = 16 << 20;
const LOCKED_THREAD_BYTES: u64 = 2 << 20;

/// What the run takes of one process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ProcessNeed {
    pub(crate) name: String,
    pub(crate) open_files: u64,
    pub(crate) threads: u64,
    /// Bytes that it locks at least; `None` where it locks none.
    pub(crate) locked_bytes: Option<u64>,
}

/// What a run takes of this host.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Needs {
    /// Of the memory of channels.
    pub(crate) shared_memory: Room,
    /// Of the folder for sockets and service files.
    pub(crate) runtime_folder: Room,
    /// The supervisor first.
    pub(crate) processes: Vec<ProcessNeed>,
}

/// Something of which the host has less than the run takes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Shortfall {
    /// Memory of channels.
    SharedMemory {
        /// What the run takes.
        need: Room,
        /// What is free.
        have: Room,
        /// How large it would have to be, bytes.
        size_bytes: u64,
    },
    /// The folder for sockets and service files.
    RuntimeFolder {
        /// The folder.
        folder: PathBuf,
        /// What the run takes.
        need: Room,
        /// What is free.
        have: Room,
    },
    /// Memory altogether, in bytes.
    Memory {
        /// What the channels of the run take.
        need: u64,
        /// What is left.
        have: Headroom,
    },
    /// Descriptors of one process.
    OpenFiles {
        /// The process.
        process: String,
        /// What it opens.
        need: u64,
        /// What it may.
        have: u64,
    },
    /// Threads of all processes together.
    Threads {
        /// What the run starts.
        need: u64,
        /// What is left.
        have: Headroom,
    },
    /// Locked memory of one process, in bytes.
    LockedMemory {
        /// The process.
        process: String,
        /// What it locks at least.
        need: u64,
        /// The limit.
        have: Headroom,
    },
}

/// A host gives less than a run takes.
#[derive(Debug, thiserror::Error)]
#[error("this host cannot run it: {}", listed(.0))]
pub struct HostTooSmall(pub Vec<Shortfall>);

fn listed(shortfalls: &[Shortfall]) -> String {
    let lines: Vec<String> = shortfalls.iter().map(ToString::to_string).collect();
    lines.join("\n  ")
}

impl fmt::Display for Shortfall {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::SharedMemory {
                need,
                have,
                size_bytes,
            } => {
                let folder = SHARED_MEMORY_DIRECTORY;
                let size_mib = size_bytes.div_ceil(1 << 20);
                write!(
                    f,
                    "the channels take {need} of {folder}, which has {have} free; end what fills it, or \
                     mount -o remount,size={size_mib}M {folder} (--shm-size={size_mib}m for a container), \
                     or lower depth and sizes of channels"
                )
            }
            Self::RuntimeFolder { folder, need, have } => write!(
                f,
                "sockets and service files take {need} of {}, which has {have} free; end what fills it",
                folder.display()
            ),
            Self::Memory { need, have } => write!(
                f,
                "the channels take {} of memory, and {} leaves {}; {}",
                words::bytes(*need),
                have.bound,
                words::bytes(have.left),
                have.bound.cure()
            ),
            Self::OpenFiles {
                process,
                need,
                have,
            } => write!(
                f,
                "{process} opens up to {need} files, and RLIMIT_NOFILE allows {have}; \
                 LimitNOFILE={need} in the unit, or nofile in /etc/security/limits.d (--ulimit \
                 nofile={need} for a container)"
            ),
            Self::Threads { need, have } => write!(
                f,
                "the run starts up to {need} threads, and {} leaves {}; {}",
                have.bound,
                have.left,
                have.bound.cure()
            ),
            Self::LockedMemory {
                process,
                need,
                have,
            } => write!(
                f,
                "{process} has lock_memory and locks {} at least, and {} is {}; {}",
                words::bytes(*need),
                have.bound,
                words::bytes(have.left),
                have.bound.cure()
            ),
        }
    }
}

/// Whether this host gives what the hosts called `here` take in a run of `topology`.
///
/// # Errors
/// Names what is short, what the run needs of it, what there is, and the cure.
pub fn check_host(topology: &Topology, here: &[String]) -> Result<(), HostTooSmall> {
    let hosts: Vec<&Host> = topology
        .hosts()
        .iter()
        .filter(|host| here.contains(&host.name))
        .collect();
    check(&plan(topology, &hosts), None)
}

/// As [`check_host`], of a plan whose domains lie below `base` or the default folder.
pub(crate) fn check(plan: &Plan, base: Option<&PathBuf>) -> Result<(), HostTooSmall> {
    let files = HostFiles::of_this_host();
    let host = HostRoom {
        shared_memory: Room::free().ok(),
        runtime_folder: runtime_folder(&domain_base(base)),
        memory: memory_headroom(&files),
        open_files: open_files::limit().ok(),
        threads: thread_headroom(&files),
        locked_memory: locked_memory_bound(&files),
    };
    let short = Needs::of(plan).against(&host);
    if short.is_empty() {
        Ok(())
    } else {
        Err(HostTooSmall(short))
    }
}

/// What the host gives, as far as it tells.
#[derive(Debug, Clone, Default)]
struct HostRoom {
    shared_memory: Option<Room>,
    runtime_folder: Option<(PathBuf, Room)>,
    memory: Vec<Headroom>,
    open_files: Option<u64>,
    threads: Vec<Headroom>,
    locked_memory: Option<Headroom>,
}

/// The folder, or what of its path is there, and what is free in it.
fn runtime_folder(base: &Path) -> Option<(PathBuf, Room)> {
    let there = base.ancestors().find(|folder| folder.is_dir())?;
    Some((there.to_owned(), Room::free_in(there).ok()?))
}

impl Needs {
    pub(crate) fn of(plan: &Plan) -> Self {
        let hosts = plan.hosts.iter();
        let settings = hosts.flat_map(|host| channel_settings(host).map(move |one| (host, one)));
        let settings: Vec<(&HostPlan, ChannelSettings)> = settings.collect();
        // What a writer that is started again takes while its predecessor's memory is not free yet.
        let spare = settings.iter().map(|(_, one)| one.writer_room());
        let spare = spare.max_by_key(|room| room.bytes).unwrap_or_default();
        let domains = Room {
            bytes: 4096,
            files: 1,
        };
        let domains = domains.times(plan.hosts.len() as u64);
        let channels = settings.iter().map(|(_, one)| one.room());
        let shared_memory = channels.fold(spare.and(domains), Room::and);
        let supervisor = ProcessNeed {
            name: "the supervisor".to_owned(),
            open_files: SUPERVISOR_FILES
                + HELD_CHANNEL_FILES * settings.len() as u64
                + CHILD_FILES * plan.processes.len() as u64,
            // One hears each process.
            threads: SUPERVISOR_THREADS + plan.processes.len() as u64,
            locked_bytes: None,
        };
        let processes = plan.processes.iter().map(|process| {
            let here = settings.iter().filter(|(at, _)| at.name == process.host);
            process_need(process, here.map(|(_, one)| one))
        });
        let members = MEMBER_ENTRIES.times(1 + plan.processes.len() as u64);
        Self {
            shared_memory,
            runtime_folder: CHANNEL_ENTRIES.times(settings.len() as u64).and(members),
            processes: [supervisor].into_iter().chain(processes).collect(),
        }
    }

    fn against(&self, host: &HostRoom) -> Vec<Shortfall> {
        let mut short = Vec::new();
        let need = self.shared_memory;
        if let Some(have) = host.shared_memory.filter(|have| !have.holds(need)) {
            short.push(Shortfall::SharedMemory {
                need,
                have,
                size_bytes: Room::size_with(need).unwrap_or(need.bytes),
            });
        }
        if let Some((folder, have)) = &host.runtime_folder
            && !have.holds(self.runtime_folder)
        {
            short.push(Shortfall::RuntimeFolder {
                folder: folder.clone(),
                need: self.runtime_folder,
                have: *have,
            });
        }
        if let Some(have) = narrowest(&host.memory, need.bytes) {
            let need = need.bytes;
            short.push(Shortfall::Memory { need, have });
        }
        let neediest = self.processes.iter().max_by_key(|one| one.open_files);
        if let (Some(one), Some(have)) = (neediest, host.open_files)
            && one.open_files > have
        {
            short.push(Shortfall::OpenFiles {
                process: one.name.clone(),
                need: one.open_files,
                have,
            });
        }
        let need = self.processes.iter().map(|one| one.threads).sum();
        if let Some(have) = narrowest(&host.threads, need) {
            short.push(Shortfall::Threads { need, have });
        }
        let locking = self.processes.iter();
        let locking = locking.filter_map(|one| Some((one.locked_bytes?, &one.name)));
        if let (Some((need, process)), Some(have)) = (locking.max(), &host.locked_memory)
            && need > have.left
        {
            short.push(Shortfall::LockedMemory {
                process: process.clone(),
                need,
                have: have.clone(),
            });
        }
        short
    }
}

/// The bound that leaves the least, where that is less than `need`.
fn narrowest(bounds: &[Headroom], need: u64) -> Option<Headroom> {
    let least = bounds.iter().min_by_key(|one| one.left)?;
    (least.left < need).then(|| least.clone())
}

/// The need of a process among the channels of its host.
fn process_need<'a>(
    process: &ProcessPlan,
    channels: impl Iterator<Item = &'a ChannelSettings>,
) -> ProcessNeed {
    let opened = match &process.task {
        ProcessTask::Component { card, realtime, .. } => {
            let channels = channels_of(card);
            ProcessContent {
                open_files: OWN_FILES + COMPONENT_CHANNEL_FILES * channels.len() as u64,
                threads: OWN_THREADS + 1,
                locks_memory: realtime.lock_memory,
                channels,
                own_bytes: 0,
            }
        }
        ProcessTask::Gateway(work) | ProcessTask::ClockPath(work) => gateway_content(work),
        ProcessTask::Adapter(adapter) => adapter_content(adapter),
        ProcessTask::Cable(work) => cable_content(work),
        ProcessTask::Witness(work) => ProcessContent {
            open_files: OWN_FILES + COMPONENT_CHANNEL_FILES * work.channels.len() as u64,
            threads: OWN_THREADS + 1,
            locks_memory: false,
            channels: work.channels.iter().map(|one| one.name.clone()).collect(),
            own_bytes: 0,
        },
        // What it opens is its own, under its own limit.
        ProcessTask::Foreign { .. } => ProcessContent {
            open_files: 0,
            threads: 1,
            locks_memory: false,
            channels: Vec::new(),
            own_bytes: 0,
        },
    };
    let ProcessContent {
        open_files,
        threads,
        ..
    } = opened;
    let locked_bytes = opened.locks_memory.then(|| {
        let joined = channels.filter(|one| opened.channels.contains(&one.name));
        let shared: u64 = joined.map(|one| one.writer_room().bytes).sum();
        let memory = shared + opened.own_bytes;
        LOCKED_PROGRAM_BYTES + LOCKED_THREAD_BYTES * threads + memory
    });
    ProcessNeed {
        name: process.name.clone(),
        open_files,
        threads,
        locked_bytes,
    }
}

/// What a process of ours opens and starts.
struct ProcessContent {
    open_files: u64,
    threads: u64,
    locks_memory: bool,
    /// Names of the channels it joins.
    channels: Vec<String>,
    /// Memory set aside for messages and records outside of shared memory.
    own_bytes: u64,
}

fn channels_of(card: &RoleSpec) -> Vec<String> {
    let channels = card.inputs.iter().chain(&card.outputs);
    channels.map(|channel| channel.name.clone()).collect()
}

/// The end of the program and the program; and threads for its frames where no gateway carries them.
fn cable_content(work: &CableWork) -> ProcessContent {
    let own = ProcessContent {
        open_files: OWN_FILES + CABLE_FILES,
        threads: OWN_THREADS + 2,
        locks_memory: false,
        channels: Vec::new(),
        own_bytes: 0,
    };
    let Some(frames) = &work.frames else {
        return own;
    };
    ProcessContent {
        open_files: own.open_files + 2 * COMPONENT_CHANNEL_FILES,
        threads: own.threads + 2,
        locks_memory: frames.realtime.iter().any(|one| one.lock_memory),
        channels: vec![work.input.name.clone(), work.output.name.clone()],
        own_bytes: hil_cable::RING_BYTES as u64,
    }
}

fn gateway_content(work: &GatewayWork) -> ProcessContent {
    let count = work.directions.len() as u64;
    let programs = work.directions.iter().flat_map(|one| &one.channels);
    let program_count = programs.filter(|one| one.cable_socket.is_some()).count() as u64;
    let outward = work.directions.iter();
    let outward = outward.filter(|one| one.side == Side::Egress);
    let rings = outward.flat_map(|one| &one.channels);
    let ring_count = rings.filter(|one| one.cable_socket.is_some()).count() as u64;
    let mut directions = work.directions.iter();
    let channels = work.directions.iter().flat_map(|one| &one.channels);
    let channels: Vec<String> = channels.map(|one| one.channel.clone()).collect();
    ProcessContent {
        open_files: OWN_FILES
            + DIRECTION_FILES * count
            + CARRIED_CHANNEL_FILES * channels.len() as u64
            + CABLE_FILES * program_count,
        // One more samples a radio.
        threads: OWN_THREADS + 1 + count,
        locks_memory: directions.any(|one| one.realtime.lock_memory),
        own_bytes: GROWING_FILE_BYTES * channels.len() as u64
            + hil_cable::RING_BYTES as u64 * ring_count,
        channels,
    }
}

fn adapter_content(adapter: &AdapterSettings) -> ProcessContent {
    let count = adapter.arms.len() as u64;
    let channels = adapter.arms.iter();
    let channels = channels.flat_map(|arm| [arm.input.name.clone(), arm.output.name.clone()]);
    ProcessContent {
        open_files: OWN_FILES + 2 * (DIRECTION_FILES + CARRIED_CHANNEL_FILES) * count,
        threads: OWN_THREADS + 1 + count,
        locks_memory: adapter.arms.iter().any(|arm| arm.realtime.lock_memory),
        channels: channels.collect(),
        own_bytes: 0,
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use hil_platform::host_limits::Bound;
    use hil_shuttle::Shuttle;
    use hil_topology::registry::Registry;

    use super::*;

    fn needs(overrides: &[&str]) -> Needs {
        Needs::of(&planned(overrides))
    }

    fn planned(overrides: &[&str]) -> Plan {
        let mut registry = Registry::default();
        registry.add::<Shuttle>();
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../deploy/topologies/shuttle-split.toml");
        let overrides: Vec<String> = overrides.iter().map(|&text| text.to_owned()).collect();
        let topology = hil_topology::load(&path, &overrides, registry.known()).unwrap();
        let here = topology.host("control-pc").unwrap();
        plan(&topology, &[here])
    }

    fn headroom(bound: Bound, left: u64) -> Headroom {
        Headroom { bound, left }
    }

    #[test]
    fn a_host_that_gives_as_much_as_is_needed_is_enough_and_one_less_is_named() {
        let needs = needs(&["processes.controller.lock_memory=true"]);
        let threads = needs.processes.iter().map(|one| one.threads).sum();
        let files = needs.processes.iter().map(|one| one.open_files).max();
        let locked = needs
            .processes
            .iter()
            .filter_map(|one| one.locked_bytes)
            .max()
            .unwrap();
        let enough = HostRoom {
            shared_memory: Some(needs.shared_memory),
            runtime_folder: Some((PathBuf::from("/run/hil"), needs.runtime_folder)),
            memory: vec![headroom(Bound::Memory, needs.shared_memory.bytes)],
            open_files: files,
            threads: vec![headroom(Bound::KernelThreads, threads)],
            locked_memory: Some(headroom(Bound::LockedMemory, locked)),
        };
        assert_eq!(needs.against(&enough), []);
        assert_eq!(needs.against(&HostRoom::default()), []);
        let less = |room: Room| Room {
            bytes: room.bytes - 1,
            ..room
        };
        let group = Bound::GroupThreads(PathBuf::from("/sys/fs/cgroup/a"));
        let short = HostRoom {
            shared_memory: Some(less(needs.shared_memory)),
            runtime_folder: Some((PathBuf::from("/run/hil"), less(needs.runtime_folder))),
            memory: vec![headroom(Bound::Memory, needs.shared_memory.bytes - 1)],
            open_files: files.map(|count| count - 1),
            threads: vec![
                headroom(Bound::KernelThreads, threads),
                headroom(group, threads - 1),
            ],
            locked_memory: Some(headroom(Bound::LockedMemory, locked - 1)),
        };
        let found = needs.against(&short);
        let told = HostTooSmall(found.clone()).to_string();
        assert_eq!(found.len(), 6, "{told}");
        for words in [
            "/dev/shm",
            "remount,size=",
            "/run/hil",
            "the memory of this host",
            "the supervisor opens up to",
            "RLIMIT_NOFILE",
            "pids.max in /sys/fs/cgroup/a",
            "TasksMax=",
            "controller has lock_memory",
            "LimitMEMLOCK=infinity",
        ] {
            assert!(told.contains(words), "{words} is not in {told}");
        }
    }

    #[test]
    fn messages_in_pieces_come_together_in_the_memory_of_the_channel_that_a_gateway_writes() {
        let plan = planned(&["links.hop.gateway.lock_memory=true"]);
        let [host] = &plan.hosts[..] else {
            panic!("one host");
        };
        for settings in channel_settings(host) {
            let arrives = settings.name == "shuttle/status";
            let assembled = if arrives { 4 } else { 0 };
            assert_eq!(settings.assembled_max, assembled, "{}", settings.name);
        }
        let writers = channel_settings(host).filter(|one| one.name.starts_with("shuttle/"));
        let channels: u64 = writers.map(|one| one.writer_room().bytes).sum();
        let needs = Needs::of(&plan);
        let gateway = needs.processes.iter().find(|one| one.name.contains("hop"));
        let gateway = gateway.unwrap();
        let threads = LOCKED_THREAD_BYTES * gateway.threads;
        let records = 2 * GROWING_FILE_BYTES;
        let locked = LOCKED_PROGRAM_BYTES + threads + channels + records;
        assert_eq!(gateway.locked_bytes, Some(locked));
    }

    #[test]
    fn files_run_out_before_bytes_where_their_number_is_bounded() {
        let needs = needs(&[]);
        let host = HostRoom {
            shared_memory: Some(Room {
                files: 3,
                ..needs.shared_memory
            }),
            ..HostRoom::default()
        };
        let found = needs.against(&host);
        assert!(
            matches!(found[..], [Shortfall::SharedMemory { .. }]),
            "{found:?}"
        );
        assert_eq!(needs.processes[0].locked_bytes, None);
    }
}
