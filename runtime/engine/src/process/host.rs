//! The hosts of a topology as namespaces of this PC: one process starts a supervisor for each host and waits
//! until all have ended.

use std::ffi::OsString;
use std::fs::{DirBuilder, File};
use std::io::{self, PipeReader, Read as _, pipe};
use std::net::IpAddr;
use std::os::fd::AsFd as _;
use std::os::unix::fs::DirBuilderExt as _;
use std::os::unix::process::CommandExt as _;
use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};
use std::{env, thread};

use hil_cable::pcs::{self, Pc, Wire, WireEnd};
use hil_cable::{CableError, Refusal};
use hil_net::handover;
use hil_platform::console::Console;
use hil_platform::signals::Signals;
use hil_platform::{own_process, systemd};
use hil_topology::{Host, Topology};
use nix::fcntl::{FcntlArg, OFlag, fcntl};
use nix::sys::signal::Signal;
use nix::unistd::dup2_stdin;
use rustix::thread::{
    CapabilitySet, capabilities, clear_ambient_capability_set, configure_capability_in_ambient_set,
    set_capabilities,
};

use super::again::Beside;
use super::own_program::{OwnProgramError, bind_to};
use crate::security::PreSharedKey;
use crate::supervisor::Child;

/// The argument that asks for it.
pub const ALL: &str = "--on-one-pc";
/// The argument that asks for a probe beside each host.
const PROBE: &str = "--probe";
/// In place of [`ALL`], for the supervisor of the host that follows.
const ONE: &str = "--on-one-pc-as=";
/// The key of the run's hops, in the shared memory that each host has for itself.
pub const KEY_FILE: &str = "/dev/shm/hop.key";
/// Folder of a host's domains, likewise.
pub const DOMAIN_ROOT: &str = "/dev/shm/hil";
/// Interfaces of a host, where the topology names none.
const INTERFACES: &str = "eth";

/// A longer line is said in pieces.
const LINE_BYTES_MAX: usize = 4096;
/// How often it is looked whether a host has ended.
const LOOK_PERIOD: Duration = Duration::from_millis(20);
/// How long the others are left running once a host has failed. Of a run that had begun they know by then and end by themselves.
const PATIENCE: Duration = Duration::from_secs(2);
/// A run that begins before is told that nothing leaves its interface.
const WIRES_UP_WITHIN: Duration = Duration::from_secs(2);
const WIRES_PERIOD: Duration = Duration::from_millis(5);
/// Exit code for a host that was killed.
const FAILED: u8 = 1;
/// For one that the signal which this process was told to end with killed, as it did not listen to signals yet.
const INTERRUPTED: u8 = 130;

/// Why hosts cannot be on one PC.
#[derive(Debug, thiserror::Error)]
pub enum HostsError {
    /// They are on one PC anyway.
    #[error("its hosts have no `address`, so that it runs on one PC without --on-one-pc")]
    WithoutAddress,
    /// A wire goes between two hosts.
    #[error(
        "hosts.{host}.{key} names one interface, and on one PC each of the {count} hosts has one to each other; \
         leave it out"
    )]
    OneInterface {
        /// The host.
        host: String,
        /// `interface` or `clock_interface`.
        key: &'static str,
        /// Of hosts.
        count: usize,
    },
    /// The link under test and the clock path of a host.
    #[error(
        "hosts.{0}.interface and clock_interface are one, and on one PC each path has an interface of its own; leave \
         one out"
    )]
    SameInterface(String),
    /// The kernel refuses something here.
    #[error(transparent)]
    Refused(#[from] Refusal),
    /// It refuses something to a host.
    #[error("host {host}: {source}")]
    Host {
        /// The host.
        host: String,
        /// Why.
        source: CableError,
    },
    /// A process cannot be started, or told to begin.
    #[error("cannot start host {host}: {source}")]
    Start {
        /// The host.
        host: String,
        /// Why.
        source: io::Error,
    },
    /// There are no random bytes for a key, or no handlers of signals.
    #[error("{0}")]
    Io(#[from] io::Error),
}

/// What a supervisor of [`run_all`] was started by, as its user typed it.
pub fn as_typed(arguments: impl Iterator<Item = String>) -> Vec<String> {
    arguments
        .map(|one| {
            if one.starts_with(ONE) {
                ALL.to_owned()
            } else {
                one
            }
        })
        .collect()
}

/// Whether the hosts of `topology` can be on one PC, as far as its file tells.
///
/// # Errors
/// When they cannot.
pub fn check(topology: &Topology) -> Result<(), HostsError> {
    wires(topology.hosts()).map(drop)
}

/// The interfaces of the host called `name`, on one PC.
///
/// # Errors
/// When the hosts cannot be on one PC.
pub fn interfaces(topology: &Topology, name: &str) -> Result<Vec<String>, HostsError> {
    let hosts = topology.hosts();
    let ends = wires(hosts)?.into_iter().flat_map(|wire| wire.ends);
    let own = ends.filter(|end| hosts[end.host].name == name);
    Ok(own.map(|end| end.interface).collect())
}

/// Runs all hosts of `topology`, each by the arguments of this process, and gives the exit code of the first one
/// that did not end with 0. The first host has this process's outputs; of others the warnings and errors are
/// said, each with the host's name. This process must have one thread.
///
/// # Errors
/// When a host cannot be made.
pub fn run_all(topology: &Topology, console: &mut Console) -> Result<u8, HostsError> {
    let arguments: Vec<OsString> = env::args_os().skip(1).collect();
    let hosts = topology.hosts();
    let wires = wires(hosts)?;
    pcs::begin()?;
    let signals = Signals::install()?;
    let mut words = Vec::new();
    let mut running = Vec::new();
    let mut entered = Vec::new();
    for (index, host) in hosts.iter().enumerate() {
        let failed = |source| HostsError::Start {
            host: host.name.clone(),
            source,
        };
        let (here, there) = handover::pair().map_err(failed)?;
        let mut helper = own_process::again();
        helper.args(["become-host", "--starter", &std::process::id().to_string()]);
        let as_host = OsString::from(format!("{ONE}{}", host.name));
        let all = OsString::from(ALL);
        let arguments_of_it = arguments
            .iter()
            .map(|one| if *one == all { &as_host } else { one });
        helper.arg("--").args(arguments_of_it);
        // Told by this process when to end, and once.
        helper.stdin(Stdio::from(there)).process_group(0);
        for variable in systemd::VARIABLES {
            helper.env_remove(variable);
        }
        if index > 0 {
            let (read, write) = pipe().map_err(failed)?;
            if !arguments.iter().any(|one| one == "--quiet" || one == "-q") {
                helper.arg("--quiet");
            }
            helper.stdout(Stdio::null()).stderr(write);
            words.push(Words::of(host, read).map_err(failed)?);
        }
        running.push(Child::spawn_apart(&mut helper).map_err(failed)?);
        // This process keeps no copy of the helper's ends.
        drop(helper);
        entered.push(Pc::take(here).map_err(|source| HostsError::Host {
            host: host.name.clone(),
            source,
        })?);
    }
    pcs::join(&entered, &wires)?;
    let key = PreSharedKey::random()?;
    for (host, pc) in hosts.iter().zip(entered) {
        pc.go(key.expose()).map_err(|source| HostsError::Start {
            host: host.name.clone(),
            source,
        })?;
    }
    let mut say = || words.iter_mut().for_each(|one| one.say(console));
    let code = wait_for_all(&mut running, &signals, &mut say);
    say();
    Ok(code)
}

/// The standard error of a host. It is read without a thread: each thread of a starter that is killed would leave the hosts
/// to the next one with a signal of its own, and the second signal costs the report.
struct Words {
    host: String,
    pipe: PipeReader,
    /// What came of a line.
    line: Vec<u8>,
}

impl Words {
    fn of(host: &Host, pipe: PipeReader) -> io::Result<Self> {
        fcntl(&pipe, FcntlArg::F_SETFL(OFlag::O_NONBLOCK))?;
        Ok(Self {
            host: host.name.clone(),
            pipe,
            line: Vec::new(),
        })
    }

    /// Says the lines that have come.
    fn say(&mut self, console: &mut Console) {
        let mut bytes = [0; 4096];
        while let Ok(length @ 1..) = self.pipe.read(&mut bytes) {
            for byte in &bytes[..length] {
                if *byte != b'\n' {
                    self.line.push(*byte);
                }
                if *byte == b'\n' || self.line.len() >= LINE_BYTES_MAX {
                    let line = String::from_utf8_lossy(&self.line);
                    console.rendered(&format!("{}: {line}", self.host));
                    self.line.clear();
                }
            }
        }
    }
}

/// Waits until all hosts have ended, and tells them once to end when this process is told to, or when one of
/// them failed; `meanwhile` is called at each look. Gives the exit code of the first one that ended with another
/// than 0.
fn wait_for_all(hosts: &mut [Child], signals: &Signals, mut meanwhile: impl FnMut()) -> u8 {
    let (mut code, mut stop_at, mut told) = (0, None, None);
    loop {
        meanwhile();
        let ends: Vec<_> = hosts.iter_mut().map(Child::poll_end).collect();
        let now = Instant::now();
        let mut failures = ends.iter().flatten().filter(|end| end.code() != Some(0));
        if code == 0
            && let Some(end) = failures.next()
        {
            let said = end.code().and_then(|code| code.try_into().ok());
            let is_told = told.is_some_and(|signal: Signal| end.signal() == Some(signal as i32));
            let killed = if is_told { INTERRUPTED } else { FAILED };
            code = said.unwrap_or(killed);
            stop_at = stop_at.or(Some(now + PATIENCE));
        }
        if ends.iter().all(Option::is_some) {
            return code;
        }
        let received = signals.received_signal();
        if received.is_some() {
            stop_at = Some(now);
        }
        if told.is_none() && stop_at.is_some_and(|at| now >= at) {
            // Each host's report says by which signal the run ended.
            let signal = received.unwrap_or(Signal::SIGTERM);
            for host in &mut *hosts {
                host.signal(signal);
            }
            told = Some(signal);
        }
        thread::sleep(LOOK_PERIOD);
    }
}

/// The wires between `hosts`, and those of their clock paths.
fn wires(hosts: &[Host]) -> Result<Vec<Wire>, HostsError> {
    if hosts.iter().any(|host| host.address.is_none()) {
        return Err(HostsError::WithoutAddress);
    }
    let has_one = |host: &&Host| host.interface.is_some() && host.interface == host.clock_interface;
    if let Some(host) = hosts.iter().find(has_one) {
        return Err(HostsError::SameInterface(host.name.clone()));
    }
    let mut next = vec![0; hosts.len()];
    let mut end = |index: usize, key: &'static str, address: IpAddr, named: &Option<String>| {
        let host: &Host = &hosts[index];
        let has =
            |name: &String| [&host.interface, &host.clock_interface].contains(&&Some(name.clone()));
        let mut drawn = format!("{INTERFACES}{}", next[index]);
        while has(&drawn) {
            next[index] += 1;
            drawn = format!("{INTERFACES}{}", next[index]);
        }
        if named.is_none() {
            next[index] += 1;
        }
        if named.is_some() && hosts.len() > 2 {
            return Err(HostsError::OneInterface {
                host: host.name.clone(),
                key,
                count: hosts.len(),
            });
        }
        Ok(WireEnd {
            host: index,
            interface: named.clone().unwrap_or(drawn),
            address,
        })
    };
    let mut wires = Vec::new();
    for (near, one) in hosts.iter().enumerate() {
        for (far, other) in hosts.iter().enumerate().skip(near + 1) {
            let [here, there] = [one, other].map(Host::gateway_address);
            wires.push(Wire {
                ends: [
                    end(near, "interface", here, &one.interface)?,
                    end(far, "interface", there, &other.interface)?,
                ],
            });
            if let (Some(here), Some(there)) = (one.clock(), other.clock()) {
                wires.push(Wire {
                    ends: [
                        end(near, "clock_interface", here.address, &here.interface)?,
                        end(far, "clock_interface", there.address, &there.interface)?,
                    ],
                });
            }
        }
    }
    Ok(wires)
}

/// Keeps the right to capture in this host's namespaces, which any user has within them, over the change to another program.
fn keep_right_to_capture() -> rustix::io::Result<()> {
    let mut rights = capabilities(None)?;
    rights.inheritable |= CapabilitySet::NET_RAW;
    set_capabilities(None, rights)?;
    configure_capability_in_ambient_set(CapabilitySet::NET_RAW, true)
}

/// Starts the probe of a host with `arguments`, to which alone [`become_host`] has left the right to capture.
///
/// # Errors
/// When it cannot be started, or the right not be taken from what starts later.
pub fn start_probe(arguments: &[String]) -> io::Result<Beside> {
    let probe = Beside::start(arguments)?;
    clear_ambient_capability_set()?;
    Ok(probe)
}

/// Enters a host's namespaces, joined by the process at the other end of standard input, and becomes this
/// program with `arguments`, which ends when that process does. Returns only when it fails.
///
/// # Errors
/// When the starter is gone, or the kernel refuses something.
pub fn become_host(starter: u32, arguments: &[String]) -> Result<(), OwnProgramError> {
    const NAME: &str = "the supervisor of a host";
    bind_to(starter, NAME, Signal::SIGTERM)?;
    let Some(key) = pcs::enter(io::stdin().as_fd())? else {
        return Err(OwnProgramError::Orphaned(NAME.to_owned()));
    };
    if let Some(key) = PreSharedKey::of(&key) {
        key.write(Path::new(KEY_FILE))?;
    }
    let deadline = Instant::now() + WIRES_UP_WITHIN;
    while !pcs::are_wires_up() && Instant::now() < deadline {
        thread::sleep(WIRES_PERIOD);
    }
    let nothing = File::open("/dev/null").and_then(|nothing| Ok(dup2_stdin(nothing)?));
    nothing
        .and_then(|()| DirBuilder::new().mode(0o700).create(DOMAIN_ROOT))
        .map_err(|source| OwnProgramError::Descriptors {
            program: NAME.to_owned(),
            source,
        })?;
    if arguments
        .iter()
        .any(|one| one.split('=').next() == Some(PROBE))
    {
        keep_right_to_capture().map_err(|source| OwnProgramError::Realtime {
            program: NAME.to_owned(),
            refusal: format!("the right to capture: {source}"),
        })?;
    }
    // A change of identity may have unbound it.
    bind_to(starter, NAME, Signal::SIGTERM)?;
    let source = own_process::again().args(arguments).exec();
    Err(OwnProgramError::Execute {
        program: own_process::RUNNING_FILE.to_owned(),
        source,
    })
}

#[cfg(test)]
mod tests {
    use hil_topology::registry::Registry;

    use super::*;

    #[test]
    fn each_two_hosts_have_a_wire_and_clock_paths_have_one_of_their_own() {
        let hosts = |hosts: &[&str]| {
            let rest = "[processes]\none = { host = \"a\", run = [\"true\"] }\n\
                        two = { host = \"b\", run = [\"true\"] }\n\
                        [channels.c]\nfrom = \"one\"\nto = \"two\"\nlink = \"hop\"\n\
                        message = { name = \"m\", size_bytes = 8 }\n\
                        [links.hop]\nvia = \"udp\"\nbetween = [\"a\", \"b\"]\n";
            let hosts = hosts.join("\n");
            let text = format!("version = 1\nname = \"wires\"\n[hosts]\n{hosts}\n{rest}");
            let topology = hil_topology::parse("wires", &text, &[], Registry::default().known());
            topology.unwrap().hosts().to_vec()
        };
        let names = |wires: &[Wire]| -> Vec<[String; 2]> {
            let names = |wire: &Wire| wire.ends.each_ref().map(|end| end.interface.clone());
            wires.iter().map(names).collect()
        };
        let first =
            "a = { address = \"10.0.0.1\", interface = \"lan\", clock_address = \"fd00::1\" }";
        let other = "b = { address = \"192.168.1.2\", clock_address = \"fd00::2\" }";
        let third = "c.address = \"10.0.0.3\"";
        let made = wires(&hosts(&[first, other])).unwrap();
        assert_eq!(names(&made), [["lan", "eth0"], ["eth0", "eth1"]]);
        let taken =
            "a = { address = \"10.0.0.1\", interface = \"eth0\", clock_address = \"fd00::1\" }";
        assert_eq!(
            names(&wires(&hosts(&[taken, other])).unwrap()),
            [["eth0", "eth0"], ["eth1", "eth1"]]
        );
        let same = taken.replace("clock_address", "clock_interface = \"eth0\", clock_address");
        let error = wires(&hosts(&[&same, other])).unwrap_err();
        assert!(matches!(error, HostsError::SameInterface(_)), "{error}");
        let error = wires(&hosts(&[first, other, third])).unwrap_err();
        assert!(
            error.to_string().starts_with("hosts.a.interface "),
            "{error}"
        );
        let made = wires(&hosts(&[
            "a.address = \"10.0.0.1\"",
            "b.address = \"10.0.0.2\"",
            third,
        ]));
        let expected = [["eth0", "eth0"], ["eth1", "eth0"], ["eth1", "eth1"]];
        assert_eq!(names(&made.unwrap()), expected);
        let local = wires(&hosts(&["a = {}", "b = {}"]));
        assert!(matches!(local, Err(HostsError::WithoutAddress)));
    }
}
