//! One run of the real binary: how a test starts it, what the run left in its folder, and whether
//! anything is left where nothing should be. It judges no figure; see [`crate::account`].

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};
use std::{fs, thread};

use hil_engine::security::PreSharedKey;
use hil_platform::domain_address::DomainAddress;
use hil_report::summary::RunSummary;
use hil_rundir::record::file::written_bytes;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

use crate::binary::{hil_runtime_binary, workspace_folder};
use crate::child::ChildGuard;
use crate::lab::LabHost;
use crate::ports::own_ports;

/// How often a waiting test looks.
const POLL_INTERVAL: Duration = Duration::from_millis(5);

/// What to run: a topology, changed by `--set`, recording into a folder of the test's own.
#[derive(Debug, Clone)]
pub struct Trial {
    topology: PathBuf,
    settings: Vec<String>,
    record: PathBuf,
}

impl Trial {
    /// A topology that ships with the workspace, by its file name.
    pub fn shipped(name: &str, record: &Path) -> Self {
        Self::of(&shipped_topology(name), record)
    }

    /// Any topology file.
    pub fn of(topology: &Path, record: &Path) -> Self {
        let record_setting = format!("run.record=\"{}\"", record.display());
        let mut settings = vec![record_setting];
        if is_secured(topology) {
            settings.push(format!("security.key=\"{}\"", hop_key(record).display()));
        }
        Self {
            topology: topology.to_owned(),
            settings,
            record: record.to_owned(),
        }
    }

    /// The same with hops that anyone on the wire can read.
    #[must_use]
    pub fn plain(self) -> Self {
        self.set("security.hops=\"plain\"")
    }

    /// The same with one value changed, e.g. `run.duration="5 s"`.
    #[must_use]
    pub fn set(mut self, setting: &str) -> Self {
        self.settings.push(setting.to_owned());
        self
    }

    /// The same with these links on ports that no other test has, for runs in the network of this machine.
    #[must_use]
    pub fn on_own_ports(self, links: &[&str]) -> Self {
        let set =
            |trial: Self, link: &&str| trial.set(&format!("links.{link}.port={}", own_ports()));
        links.iter().fold(self, set)
    }

    /// The arguments of the binary.
    pub fn arguments(&self) -> Vec<OsString> {
        let mut arguments = vec!["--topology".into(), self.topology.clone().into_os_string()];
        for setting in &self.settings {
            arguments.extend(["--set".into(), setting.into()]);
        }
        arguments
    }

    /// A command that runs it on this machine.
    pub fn command_here(&self) -> Command {
        let mut command = Command::new(hil_runtime_binary());
        command.args(self.arguments());
        command
    }

    /// Starts it on this machine.
    ///
    /// # Panics
    /// When the binary cannot be started.
    pub fn start_here(&self) -> ChildGuard {
        spawn(&mut self.command_here())
    }

    /// Starts it on a host of a lab.
    ///
    /// # Panics
    /// When the binary cannot be started.
    pub fn start_on(&self, host: &LabHost) -> ChildGuard {
        let mut command = host.command(hil_runtime_binary());
        command.args(self.arguments());
        spawn(&mut command)
    }

    /// The folder of the run whose name ends with `suffix`, as soon as it is there.
    ///
    /// # Panics
    /// When it does not appear within `limit`, or there are several.
    pub fn folder(&self, suffix: &str, limit: Duration) -> RunFiles {
        RunFiles::find(&self.record, &self.record, suffix, limit)
    }
}

/// Whether a topology, or one that it extends, has hops between hosts to be secured.
fn is_secured(topology: &Path) -> bool {
    let text = fs::read_to_string(topology).unwrap_or_default();
    let mut lines = text.lines();
    let base = lines.find_map(|line| line.strip_prefix("extends = \"")?.split('"').next());
    let folder = topology.parent().unwrap_or(Path::new("."));
    text.contains("[security]") || base.is_some_and(|base| is_secured(&folder.join(base)))
}

/// The key of every run between two hosts that records into `record`.
///
/// # Panics
/// When it cannot be made.
pub fn hop_key(record: &Path) -> PathBuf {
    let path = record.join(".hop.key");
    if !path.exists() {
        let made = fs::create_dir_all(record)
            .map_err(|error| error.to_string())
            .and_then(|()| PreSharedKey::create(&path).map_err(|error| error.to_string()));
        if let Err(error) = made {
            panic!("no key for the test's hops: {error}");
        }
    }
    path
}

/// The path of a topology that ships with the workspace.
pub fn shipped_topology(name: &str) -> PathBuf {
    workspace_folder().join("deploy/topologies").join(name)
}

fn spawn(command: &mut Command) -> ChildGuard {
    match ChildGuard::spawn(command) {
        Ok(child) => child,
        Err(error) => panic!("the binary under test cannot be started: {error}"),
    }
}

/// Waits until `is_so`.
///
/// # Panics
/// When it is not within `limit`; `what` says what was waited for.
pub fn wait_until(limit: Duration, what: &str, mut is_so: impl FnMut() -> bool) {
    let deadline = Instant::now() + limit;
    while !is_so() {
        assert!(
            Instant::now() < deadline,
            "{what}: not within {limit:?}; load {}",
            load_average()
        );
        thread::sleep(POLL_INTERVAL);
    }
}

/// Waits until the process has a handler of its own for SIGINT.
///
/// # Panics
/// When it has none within `limit`, or is gone.
pub fn wait_until_it_heeds_interrupts(child: &ChildGuard, limit: Duration) {
    let path = format!("/proc/{}/status", child.pid());
    wait_until(limit, "a handler for SIGINT", || {
        let status = fs::read_to_string(&path).expect("a child that runs has a status");
        let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:"));
        let caught = caught.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
        caught.is_some_and(|mask| mask & (1 << (Signal::SIGINT as u32 - 1)) != 0)
    });
}

/// Processes that were ready to run on this machine over the last minute, with the number of
/// processors: what a reader must know of a late result.
pub fn load_average() -> String {
    let load = fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let processors = thread::available_parallelism().map_or(0, usize::from);
    let minute = load.split(' ').next().unwrap_or("unknown");
    format!("{minute} on {processors} processors")
}

/// What one run left behind on one host.
#[derive(Debug, Clone)]
pub struct RunFiles {
    root: PathBuf,
    inside: PathBuf,
}

impl RunFiles {
    /// The one run folder below `record` whose name ends with `suffix`; the run itself has it below `inside`.
    ///
    /// # Panics
    /// When there is none within `limit`, or more than one.
    pub fn find(record: &Path, inside: &Path, suffix: &str, limit: Duration) -> Self {
        let mut found = Vec::new();
        wait_until(limit, &format!("a run folder {suffix}"), || {
            let entries = fs::read_dir(record).into_iter().flatten().flatten();
            found = entries
                .filter(|entry| entry.path().is_dir())
                .filter(|entry| entry.file_name().to_string_lossy().ends_with(suffix))
                .map(|entry| entry.path())
                .collect();
            !found.is_empty()
        });
        assert_eq!(found.len(), 1, "one run folder {suffix}, not {found:?}");
        let root = found.remove(0);
        let inside = inside.join(root.file_name().expect("an entry of a folder has a name"));
        Self { root, inside }
    }

    /// The run folder.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The folder as the processes of the run have it.
    pub fn inside(&self) -> &Path {
        &self.inside
    }

    /// True once the run has written its last file.
    pub fn has_report(&self) -> bool {
        self.root.join("report.txt").is_file()
    }

    /// The summary, written and read back.
    ///
    /// # Panics
    /// When it is missing or not a summary: then the report is not complete.
    pub fn summary(&self) -> RunSummary {
        let text = self.read("summary.json");
        match RunSummary::from_json(&text) {
            Ok(summary) => summary,
            Err(error) => panic!("{}: {error}", self.root.display()),
        }
    }

    /// A file of the run folder as text.
    ///
    /// # Panics
    /// When it cannot be read.
    pub fn read(&self, name: &str) -> String {
        let path = self.root.join(name);
        match fs::read_to_string(&path) {
            Ok(text) => text,
            Err(error) => panic!("{}: {error}", path.display()),
        }
    }

    /// Bytes written in the record files whose names begin with `start`, of all instances.
    pub fn record_bytes(&self, start: &str) -> u64 {
        let entries = fs::read_dir(self.root.join("records"));
        let files = entries.into_iter().flatten().flatten();
        let chosen = files.filter(|file| file.file_name().to_string_lossy().starts_with(start));
        let opened = chosen.filter_map(|file| fs::File::open(file.path()).ok());
        opened.filter_map(|file| written_bytes(&file, 0).ok()).sum()
    }

    /// The process that was started from the launch file of `name` for the `instance`th time.
    pub fn process(&self, name: &str, instance: u32) -> Option<Pid> {
        let launch = self.inside.join(format!("launch/{name}.{instance}.json"));
        processes_mentioning(&launch.to_string_lossy())
            .first()
            .copied()
    }

    /// Kills the process as nothing else can, as soon as it is there.
    ///
    /// # Panics
    /// When there is no such process within `limit`, or it cannot be killed.
    pub fn kill_process(&self, name: &str, instance: u32, limit: Duration) {
        let mut found = None;
        wait_until(limit, &format!("process {name}.{instance}"), || {
            found = self.process(name, instance);
            found.is_some()
        });
        let killed = found.map(|process| kill(process, Signal::SIGKILL));
        assert_eq!(killed, Some(Ok(())), "{name}.{instance}");
    }

    /// Processes that were started from any launch file of this run and have not ended.
    pub fn processes(&self) -> Vec<Pid> {
        processes_mentioning(&self.inside.join("launch").to_string_lossy())
    }

    /// The shared-memory domains of the run, as its processes were told.
    ///
    /// # Panics
    /// When a launch file cannot be read.
    pub fn domains(&self) -> Vec<DomainAddress> {
        let entries = fs::read_dir(self.root.join("launch"));
        let files = entries.into_iter().flatten().flatten();
        let addresses = files.map(|file| {
            let text = self.read(&format!("launch/{}", file.file_name().display()));
            let launch: Value = serde_json::from_str(&text).unwrap_or_default();
            let address = launch["domain"].as_str().map(str::parse);
            address
                .and_then(Result::ok)
                .unwrap_or_else(|| panic!("{}: no domain", file.path().display()))
        });
        let mut addresses: Vec<DomainAddress> = addresses.collect();
        addresses.sort_by_key(ToString::to_string);
        addresses.dedup();
        addresses
    }

    /// What is still there of the run beside its folder: processes, shared memory, sockets.
    /// `locate` says where a path of the run's host is found from here.
    pub fn leftovers(&self, locate: impl Fn(&Path) -> PathBuf) -> Vec<String> {
        let mut left: Vec<String> = self
            .processes()
            .iter()
            .map(|process| format!("process {process}"))
            .collect();
        for domain in self.domains() {
            let root = locate(domain.root_path());
            if root.exists() {
                left.push(root.display().to_string());
            }
            let shared = fs::read_dir(locate(Path::new("/dev/shm")));
            for file in shared.into_iter().flatten().flatten() {
                let name = file.file_name().to_string_lossy().into_owned();
                if name.starts_with(domain.prefix()) {
                    left.push(format!("/dev/shm/{name}"));
                }
            }
        }
        left
    }

    /// Checks that nothing is left of a run on this machine.
    ///
    /// # Panics
    /// With what is left.
    pub fn assert_nothing_left_here(&self) {
        let left = self.leftovers(Path::to_owned);
        assert!(left.is_empty(), "left of {}: {left:?}", self.root.display());
    }

    /// Checks that nothing is left on a host of a lab, of this run or of any other.
    ///
    /// # Panics
    /// With what is left.
    pub fn assert_nothing_left_on(&self, host: &LabHost) {
        let mut left = self.leftovers(|path| host.locate(path));
        left.extend(host.shared_memory_leftovers());
        let domains = fs::read_dir(host.locate("/run/hil"));
        let domains = domains.into_iter().flatten().flatten();
        left.extend(domains.map(|entry| entry.path().display().to_string()));
        assert!(left.is_empty(), "left of {}: {left:?}", self.root.display());
    }
}

/// Living processes with `text` in their command line.
pub fn processes_mentioning(text: &str) -> Vec<Pid> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    let numbers = entries.filter_map(|entry| entry.file_name().to_str()?.parse::<i32>().ok());
    // A process that has ended has no command line any more, even while its parent is still to
    // take notice.
    let mentions = |number: &i32| {
        let line = fs::read(format!("/proc/{number}/cmdline")).unwrap_or_default();
        let line = String::from_utf8_lossy(&line).into_owned();
        line.contains(text)
    };
    numbers.filter(mentions).map(Pid::from_raw).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run_folder::RunFolder;

    #[test]
    fn a_living_process_is_found_by_its_command_line_and_a_dead_one_is_not() {
        let folder = RunFolder::new("trial");
        let path = folder.join("launch");
        let mut command = Command::new("sh");
        command.args(["-c", "read line", "sh"]).arg(&path);
        command.stdin(std::process::Stdio::piped());
        let mut child = command.spawn().unwrap();
        // A new program runs a moment before the kernel knows its command line.
        wait_until(Duration::from_secs(20), "the process", || {
            processes_mentioning(&path.to_string_lossy()).len() == 1
        });
        child.kill().unwrap();
        wait_until(Duration::from_secs(20), "the end of the process", || {
            processes_mentioning(&path.to_string_lossy()).is_empty()
        });
        child.wait().unwrap();
    }

    #[test]
    fn what_a_run_left_in_shared_memory_is_found_by_its_launch_files() {
        let folder = RunFolder::new("left");
        fs::create_dir_all(folder.join("run/launch")).unwrap();
        fs::create_dir_all(folder.join("there/dev/shm")).unwrap();
        fs::create_dir_all(folder.join("there/run/hil/1")).unwrap();
        folder.write(
            "run/launch/robot.0.json",
            r#"{"domain": "h01234567_@/run/hil/1"}"#,
        );
        let segment = folder.write("there/dev/shm/h01234567_abc.data", "");
        folder.write("there/dev/shm/h11111111_abc.data", "");
        let files = RunFiles {
            root: folder.join("run"),
            inside: folder.join("run"),
        };
        let there = folder.join("there");
        let locate = |path: &Path| there.join(path.strip_prefix("/").unwrap());
        let left = files.leftovers(locate);
        assert_eq!(left.len(), 2, "{left:?}");
        fs::remove_file(segment).unwrap();
        fs::remove_dir(there.join("run/hil/1")).unwrap();
        assert!(files.leftovers(locate).is_empty());
    }
}
