//! Two hosts on one machine: network namespaces joined by a veth pair, each with shared memory and
//! runtime folders of its own. They share the kernel, its clock and its processors, so a delay
//! between them is the software's alone and its true clock offset is zero.
//!
//! Each host is held open by a process that waits for the end of its input. When the test ends,
//! even by `SIGKILL`, that input closes and the mounts go; [`Lab`]'s drop, or the next lab's start,
//! removes the named namespaces.

mod namespace;
mod privilege;
#[cfg(test)]
mod self_tests;

use std::ffi::OsStr;
use std::fs::{self, File};
use std::io::{BufRead, BufReader, Read};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use nix::fcntl::{FallocateFlags, fallocate};
use nix::sched::{CloneFlags, setns};
use nix::sys::statvfs::statvfs;

pub use self::privilege::require_privileges;
use crate::child;
use crate::trial::wait_until;

/// The interface that joins the two hosts, in each of them.
pub const INTERFACE: &str = "eth0";
/// The addresses of host 0 and host 1.
pub const ADDRESSES: [Ipv4Addr; 2] = [Ipv4Addr::new(10, 77, 0, 1), Ipv4Addr::new(10, 77, 0, 2)];
/// The ports of [`Lab::put_bridge_between`] to both hosts, on host 0.
pub const BRIDGE_PORTS: [&str; 2] = ["port0", "port1"];
/// The interface of a second cable, see [`Lab::lay_second_cable`].
pub const SECOND_INTERFACE: &str = "eth1";
/// The addresses of host 0 and host 1 on a second cable.
pub const SECOND_ADDRESSES: [Ipv4Addr; 2] =
    [Ipv4Addr::new(10, 78, 0, 1), Ipv4Addr::new(10, 78, 0, 2)];

/// No set-up command takes a tenth of this on an overloaded machine.
const SETUP_LIMIT: Duration = Duration::from_secs(20);

/// What takes the room on a disk, see [`LabHost::fill_disk`].
const FILLER: &str = ".filler";

/// Private folders, then a word, then waiting for the test to end. `/run` is private because the
/// runtime keeps its sockets below it; `TMPDIR` points there too, see [`LabHost::command`].
const HOLDER_SCRIPT: &str = "mount -t tmpfs -o mode=1777 tmpfs /dev/shm \
    && mount -t tmpfs -o mode=0755 tmpfs /run \
    && mkdir -m 1777 /run/tmp && mkdir -m 0755 /run/hil \
    && echo ready && exec cat";

/// Two hosts joined by a cable. Dropping it removes everything, the processes inside included.
#[derive(Debug)]
pub struct Lab {
    hosts: [LabHost; 2],
}

impl Lab {
    /// Builds two hosts, after removing labs whose owner has died.
    ///
    /// # Errors
    /// The first set-up command that failed, with its words.
    pub fn two_hosts() -> Result<Self, String> {
        Self::with_clock_ahead(None)
    }

    /// As [`Lab::two_hosts`]; with `ahead_s`, host 1 has a time namespace of its own whose
    /// monotonic clock is exactly that many seconds ahead.
    ///
    /// # Errors
    /// As [`Lab::two_hosts`].
    pub fn with_clock_ahead(ahead_s: Option<u32>) -> Result<Self, String> {
        namespace::sweep_stale();
        let names = namespace::fresh_names();
        let hosts = [
            LabHost::start(&names[0], 0, None)?,
            LabHost::start(&names[1], 1, ahead_s)?,
        ];
        namespace::join(&names, INTERFACE)?;
        for host in &hosts {
            namespace::ip(&["-n", &host.namespace, "link", "set", "lo", "up"])?;
            host.bring_up(INTERFACE, host.address)?;
        }
        Ok(Self { hosts })
    }

    /// Builds two hosts; `None`, with the reason printed, where the rights for it are missing.
    ///
    /// # Panics
    /// When building fails in spite of the rights, and in CI (`CI` is set) when they are missing:
    /// a gate that skips its main test is no gate.
    pub fn two_hosts_or_skip() -> Option<Self> {
        Self::with_clock_ahead_or_skip(None)
    }

    /// [`Lab::with_clock_ahead`], or `None` as [`Lab::two_hosts_or_skip`].
    ///
    /// # Panics
    /// As [`Lab::two_hosts_or_skip`].
    #[allow(clippy::print_stderr, reason = "a test that is skipped must say so")]
    pub fn with_clock_ahead_or_skip(ahead_s: Option<u32>) -> Option<Self> {
        if let Err(reason) = require_privileges() {
            eprintln!("skipped: {reason}");
            return None;
        }
        Some(Self::with_clock_ahead(ahead_s).unwrap_or_else(|reason| panic!("no lab: {reason}")))
    }

    /// Lays a second cable between the hosts.
    ///
    /// # Panics
    /// When it cannot be laid.
    pub fn lay_second_cable(&self) {
        let names = [0, 1].map(|index| self.hosts[index].namespace.clone());
        let laid = namespace::join(&names, SECOND_INTERFACE).and_then(|()| {
            let ends = self.hosts.iter().zip(SECOND_ADDRESSES);
            ends.into_iter()
                .try_for_each(|(host, address)| host.bring_up(SECOND_INTERFACE, address))
        });
        if let Err(reason) = laid {
            panic!("no second cable: {reason}");
        }
    }

    /// Cuts the first cable and puts a bridge on host 0 in between, whose queues towards either
    /// host can be throttled at [`BRIDGE_PORTS`].
    ///
    /// What waits there waits on the wire as far as the hosts' kernels can tell: their own queues lie
    /// before the stamp of a departure, and throttling those would show in no stamp.
    ///
    /// # Panics
    /// When it cannot be built.
    pub fn put_bridge_between(&self) {
        let [first, second] = [0, 1].map(|index| self.hosts[index].namespace.as_str());
        let in_first = |words: &str| -> Result<(), String> {
            let words: Vec<&str> = ["-n", first].into_iter().chain(words.split(' ')).collect();
            namespace::ip(&words)
        };
        let built = || -> Result<(), String> {
            in_first(&format!("link delete {INTERFACE}"))?;
            in_first("link add bridge0 type bridge")?;
            in_first(&format!("link add {INTERFACE} type veth peer name port0"))?;
            in_first(&format!(
                "link add port1 type veth peer name {INTERFACE} netns {second}"
            ))?;
            for port in BRIDGE_PORTS {
                in_first(&format!("link set {port} master bridge0 up"))?;
            }
            in_first("link set bridge0 up")?;
            self.hosts
                .iter()
                .try_for_each(|host| host.bring_up(INTERFACE, host.address))
        };
        if let Err(reason) = built() {
            panic!("no bridge: {reason}");
        }
    }

    /// Has the bridge of [`Lab::put_bridge_between`] send every frame to a third port as well, and
    /// returns the interface on host 0 at the far end of it: a mirror port of the switch.
    ///
    /// # Panics
    /// When it cannot be built, or there is no bridge.
    pub fn add_mirror_port(&self) -> &'static str {
        let first = self.hosts[0].namespace.as_str();
        let built = [
            "link set bridge0 type bridge ageing_time 0",
            "link add port2 type veth peer name mirror0",
            "link set port2 master bridge0 up",
            "link set mirror0 up",
        ]
        .iter()
        .try_for_each(|words| {
            let words: Vec<&str> = ["-n", first].into_iter().chain(words.split(' ')).collect();
            namespace::ip(&words)
        });
        if let Err(reason) = built {
            panic!("no mirror port: {reason}");
        }
        "mirror0"
    }

    /// Host 0 (the controller's, by convention) or host 1 (the robot's).
    ///
    /// # Panics
    /// When `index` is above 1.
    pub fn host(&self, index: usize) -> &LabHost {
        &self.hosts[index]
    }
}

/// One host of a [`Lab`].
#[derive(Debug)]
pub struct LabHost {
    namespace: String,
    address: Ipv4Addr,
    has_own_clock: bool,
    holder: Child,
}

impl LabHost {
    /// Its address on the cable.
    pub fn address(&self) -> Ipv4Addr {
        self.address
    }

    /// The name of its network namespace, for `ip netns exec` by hand.
    pub fn namespace(&self) -> &str {
        &self.namespace
    }

    /// The link address of the first cable's interface.
    ///
    /// # Panics
    /// When it cannot be read.
    pub fn hardware_address(&self) -> String {
        let file = format!("/sys/class/net/{INTERFACE}/address");
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.namespace, "cat", &file]);
        match child::run(&mut command, SETUP_LIMIT) {
            Ok(finished) => finished.stdout.trim().to_owned(),
            Err(reason) => panic!("{reason}"),
        }
    }

    /// A command that will run on this host.
    ///
    /// All commands of one host share its `/dev/shm` and `/run`; the rest of the file system is
    /// this machine's. `TMPDIR` and `XDG_RUNTIME_DIR` point below the private `/run`, the working
    /// folder is the caller's, and the process identifier is the program's own, so a signal to
    /// the child reaches it.
    pub fn command(&self, program: impl AsRef<OsStr>) -> Command {
        let mut command = Command::new("nsenter");
        command
            .arg("--target")
            .arg(self.holder.id().to_string())
            .args(self.has_own_clock.then_some("--time"))
            .args([
                "--mount",
                "--net",
                "--",
                "/bin/sh",
                "-c",
                r#"cd "$0" && exec "$@""#,
            ])
            .arg(std::env::current_dir().unwrap_or_else(|_| PathBuf::from("/")))
            .arg(program)
            .env("TMPDIR", "/run/tmp")
            .env("XDG_RUNTIME_DIR", "/run/tmp");
        command
    }

    /// Plugs a cable in (`up`) or pulls it (`down`).
    ///
    /// # Panics
    /// When it cannot be done.
    pub fn set_link(&self, interface: &str, what: &str) {
        let words = ["-n", &self.namespace, "link", "set", interface, what];
        if let Err(reason) = namespace::ip(&words) {
            panic!("{interface} {what}: {reason}");
        }
    }

    /// Gives this host one more address on the first cable, to be used at once.
    ///
    /// # Panics
    /// When it cannot be done.
    pub fn add_address(&self, address: impl Into<IpAddr>) {
        let address = address.into();
        if address.is_ipv4() {
            self.change(&["address", "add", &format!("{address}/24")]);
        } else {
            self.change(&["address", "add", &format!("{address}/64"), "nodad"]);
        }
    }

    /// Takes the address of the first cable away from this host, as a lease that ran out does.
    ///
    /// # Panics
    /// When it cannot be done.
    pub fn take_address(&self) {
        self.change(&["address", "del", &format!("{}/24", self.address)]);
    }

    /// Gives the address of the first cable back.
    ///
    /// # Panics
    /// When it cannot be done.
    pub fn give_address(&self) {
        self.change(&["address", "add", &format!("{}/24", self.address)]);
    }

    /// Has this host know `address` at the link address `hardware` on the first cable, whatever others say.
    ///
    /// # Panics
    /// When it cannot be done.
    pub fn pin_neighbour(&self, address: impl Into<IpAddr>, hardware: &str) {
        self.change(&[
            "neigh",
            "replace",
            &address.into().to_string(),
            "lladdr",
            hardware,
        ]);
    }

    /// Sets the longest packet of the first cable's interface, in bytes, and lets the host forget what it
    /// learnt of the path: Linux keeps a small one for ten minutes (`net.ipv4.route.mtu_expires`).
    ///
    /// # Panics
    /// When it cannot be done.
    pub fn set_mtu(&self, bytes: u16) {
        self.change(&["link", "set", "mtu", &bytes.to_string()]);
        let forget = ["-n", self.namespace.as_str(), "route", "flush", "cache"];
        if let Err(reason) = namespace::ip(&forget) {
            panic!("{forget:?}: {reason}");
        }
    }

    /// The ends of this host's connections of TCP with `port` at either end: its own and the other.
    ///
    /// # Panics
    /// When they cannot be listed.
    pub fn connections(&self, port: u16) -> Vec<[SocketAddr; 2]> {
        let mut command = self.command("ss");
        command.args(["-Htn", "state", "established"]);
        let filter = format!("( sport = :{port} or dport = :{port} )");
        let finished = child::run(command.arg(filter), SETUP_LIMIT);
        let finished = finished.unwrap_or_else(|reason| panic!("{reason}"));
        let ends = finished.stdout.lines().filter_map(|line| {
            let mut words = line.split_whitespace().filter_map(|word| word.parse().ok());
            Some([words.next()?, words.next()?])
        });
        ends.collect()
    }

    /// Runs `ip -n <this host> <words> dev <the first cable>`.
    fn change(&self, words: &[&str]) {
        let host = ["-n", self.namespace.as_str()];
        let arguments: Vec<&str> = [&host, words, &["dev", INTERFACE]].concat();
        if let Err(reason) = namespace::ip(&arguments) {
            panic!("{words:?} on {}: {reason}", self.namespace);
        }
    }

    /// Runs `work` in a thread whose new sockets belong to this host's network. The sockets stay
    /// there when they are handed out; the file system is this machine's.
    ///
    /// # Panics
    /// When the namespace cannot be entered, or `work` panics.
    pub fn on_network<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        let network = format!("/proc/{}/ns/net", self.holder.id());
        let result = thread::scope(|scope| {
            let entered = scope.spawn(|| {
                let file = File::open(&network).map_err(|error| format!("{network}: {error}"))?;
                setns(file, CloneFlags::CLONE_NEWNET)
                    .map_err(|errno| format!("setns {network}: {errno}"))?;
                Ok::<T, String>(work())
            });
            entered.join()
        });
        match result {
            Ok(Ok(value)) => value,
            Ok(Err(reason)) => panic!("host {} cannot be entered: {reason}", self.namespace),
            Err(cause) => std::panic::resume_unwind(cause),
        }
    }

    /// Where `path` of this host can be read from outside.
    pub fn locate(&self, path: impl AsRef<Path>) -> PathBuf {
        let path = path.as_ref();
        let inside = path.strip_prefix("/").unwrap_or(path);
        Path::new("/proc")
            .join(self.holder.id().to_string())
            .join("root")
            .join(inside)
    }

    /// Puts a disk of `size`, in the words of mount(8) for a tmpfs, at `folder` of this host alone.
    ///
    /// # Panics
    /// When it cannot be done.
    pub fn mount_disk(&self, folder: &Path, size: &str) {
        let script = r#"mkdir -p "$0" && mount -t tmpfs -o "size=$1" tmpfs "$0""#;
        let mut command = self.command("sh");
        command.args(["-c", script]).arg(folder).arg(size);
        let mounted = child::run(&mut command, SETUP_LIMIT);
        assert!(mounted.is_ok(), "{mounted:?}");
    }

    /// Takes all of the disk of this host at `folder` but `kept` bytes, at once, in a file `.filler`.
    ///
    /// # Panics
    /// When it does not get full.
    pub fn fill_disk(&self, folder: &Path, kept: u64) {
        let disk = self.locate(folder);
        let filler = File::options()
            .create(true)
            .append(true)
            .open(disk.join(FILLER));
        let filler = filler.expect("a file on the disk");
        let length = filler.metadata().map(|data| data.len());
        let mut from = length.expect("an open file has a length");
        // Others write meanwhile.
        wait_until(SETUP_LIMIT, "a full disk", || {
            let free = statvfs(&disk).expect("a mounted disk");
            let free_bytes = free.blocks_available() * free.fragment_size();
            let Some(rest) = free_bytes.checked_sub(kept).filter(|rest| *rest > 0) else {
                return true;
            };
            let [at, length] =
                [from, rest].map(|bytes| i64::try_from(bytes).expect("less than 8 EiB"));
            if fallocate(&filler, FallocateFlags::empty(), at, length).is_ok() {
                from += rest;
            }
            false
        });
    }

    /// Gives back what [`LabHost::fill_disk`] took, if it did.
    pub fn clear_disk(&self, folder: &Path) {
        drop(fs::remove_file(self.locate(folder).join(FILLER)));
    }

    /// The names in this host's `/dev/shm`, sorted.
    ///
    /// # Panics
    /// When it cannot be listed: an unread folder must not pass for an empty one.
    pub fn shared_memory_files(&self) -> Vec<String> {
        let folder = self.locate("/dev/shm");
        let entries = fs::read_dir(&folder)
            .unwrap_or_else(|error| panic!("cannot list {}: {error}", folder.display()));
        let mut names: Vec<String> = entries
            .flatten()
            .map(|e| e.file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        names
    }

    /// The segments runs left in this host's `/dev/shm`: names of the form `h????????_*`.
    pub fn shared_memory_leftovers(&self) -> Vec<String> {
        let mut names = self.shared_memory_files();
        names.retain(|name| name.len() > 10 && name.starts_with('h') && name[9..].starts_with('_'));
        names
    }

    fn start(name: &str, index: usize, ahead_s: Option<u32>) -> Result<Self, String> {
        namespace::add(name)?;
        let mut command = Command::new("ip");
        command.args(["netns", "exec", name]);
        if let Some(ahead_s) = ahead_s {
            let ahead_s = ahead_s.to_string();
            command.args(["unshare", "--time", "--monotonic", &ahead_s]);
        }
        let spawned = command
            .args(["unshare", "--mount", "--propagation", "private"])
            .args(["sh", "-c", HOLDER_SCRIPT])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn();
        let holder = match spawned {
            Ok(holder) => holder,
            Err(error) => {
                namespace::remove(name);
                return Err(format!("ip netns exec {name}: {error}"));
            }
        };
        // From here on dropping the host cleans up.
        let mut host = Self {
            namespace: name.to_owned(),
            address: ADDRESSES[index],
            has_own_clock: ahead_s.is_some(),
            holder,
        };
        host.wait_until_ready()?;
        Ok(host)
    }

    fn wait_until_ready(&mut self) -> Result<(), String> {
        let Some(stdout) = self.holder.stdout.take() else {
            return Err("the holder has no output".to_owned());
        };
        let (sender, receiver) = mpsc::channel();
        thread::spawn(move || {
            let mut line = String::new();
            let read = BufReader::new(stdout).read_line(&mut line);
            // The receiver is gone when the limit has passed.
            drop(sender.send(read.map(|_length| line)));
        });
        match receiver.recv_timeout(SETUP_LIMIT) {
            Ok(Ok(line)) if line == "ready\n" => Ok(()),
            Ok(Ok(_)) => {
                let mut words = String::new();
                if let Some(stderr) = self.holder.stderr.as_mut() {
                    drop(stderr.read_to_string(&mut words));
                }
                Err(format!(
                    "host {} was not set up: {}",
                    self.namespace,
                    words.trim()
                ))
            }
            Ok(Err(error)) => Err(format!("host {}: {error}", self.namespace)),
            Err(error) => Err(format!(
                "host {} within {SETUP_LIMIT:?}: {error}",
                self.namespace
            )),
        }
    }

    fn bring_up(&self, interface: &str, address: Ipv4Addr) -> Result<(), String> {
        let name = self.namespace.as_str();
        let address = format!("{address}/24");
        namespace::ip(&["-n", name, "address", "add", &address, "dev", interface])?;
        namespace::ip(&["-n", name, "link", "set", interface, "up"])
    }
}

impl Drop for LabHost {
    fn drop(&mut self) {
        namespace::remove(&self.namespace);
        // The holder was among the processes just killed; this reaps it. Both calls fail only if
        // it is gone already.
        drop(self.holder.kill());
        drop(self.holder.wait());
    }
}
