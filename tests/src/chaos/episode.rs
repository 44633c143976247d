//! One episode: two hosts, a run of two seconds between them, what was drawn for it, and the wait
//! for its end.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use std::{fs, thread};

use nix::unistd::Pid;

use super::act::{Effects, command_line};
use super::plan::{Carrier, Kind, PEER_TIMEOUT, Plan, RUN_LENGTH};
use super::verdict::{self, Verdict};
use crate::binary::hil_runtime_binary;
use crate::child::{self, ChildGuard, Finished};
use crate::lab::{Lab, LabHost};
use crate::run_folder::RunFolder;
use crate::soak::held::Held;
use crate::trial::{hop_key, processes_mentioning, shipped_topology};

/// Names of the hosts in the topology.
pub const HOSTS: [&str; 2] = ["control-pc", "robot-pc"];
/// Room for records on each host, MiB: several times what a run takes.
const DISK_MIB: u32 = 24;
/// Time from the start of the supervisors until messages flow; then the episode goes on anyhow.
const FLOW_LIMIT: Duration = Duration::from_secs(20);
/// Within this a run ends after the last injection, whatever was done: its length, the patience of
/// stopping (three times 3 s), of exchanging records (20 s), and a slow machine.
const END_LIMIT: Duration = Duration::from_secs(75);
const COMMAND_LIMIT: Duration = Duration::from_secs(30);
/// No file is opened for this long by a process that has all it needs.
const SETTLED: Duration = Duration::from_millis(60);
const SETTLE_LIMIT: Duration = Duration::from_millis(500);
const POLL_INTERVAL: Duration = Duration::from_millis(2);
/// Records of 40 bytes behind a header of 128: messages have been taken.
const FLOWING_BYTES: u64 = 128 + 2 * 40;

/// Where an episode plays: its hosts, its folders, its supervisors.
#[derive(Debug)]
pub struct Stage {
    lab: Lab,
    record: PathBuf,
    supervisors: [Pid; 2],
}

impl Stage {
    /// The two hosts.
    pub fn lab(&self) -> &Lab {
        &self.lab
    }

    /// The folder for records, as the hosts name it. Each host has its own, on a disk of its own.
    pub fn record(&self) -> &Path {
        &self.record
    }

    /// The same as seen from here.
    pub fn record_of(&self, host: usize) -> PathBuf {
        self.lab.host(host).locate(&self.record)
    }

    /// The run folder as seen from here, once it is there.
    pub fn folder_of(&self, host: usize) -> Option<PathBuf> {
        let ending = format!("-{}", HOSTS[host]);
        let entries = fs::read_dir(self.record_of(host)).ok()?.flatten();
        let mut folders = entries
            .map(|entry| entry.path())
            .filter(|path| path.is_dir());
        folders.find(|path| path.to_string_lossy().ends_with(&ending))
    }

    /// The run folder as the host names it; the folder for records before there is one.
    pub fn folder_inside(&self, host: usize) -> PathBuf {
        let folder = self.folder_of(host);
        let name = folder.as_deref().and_then(Path::file_name);
        name.map_or_else(|| self.record.clone(), |name| self.record.join(name))
    }

    /// The process of the supervisor on `host`.
    pub fn supervisor(&self, host: usize) -> Pid {
        self.supervisors[host]
    }

    /// The newest process on `host` with `word` in its command line.
    pub fn process(&self, host: usize, word: &str) -> Option<Pid> {
        let folder = self.folder_inside(host);
        let of_run = processes_mentioning(&folder.join("launch").to_string_lossy());
        let mut named = of_run
            .into_iter()
            .filter(|process| command_line(*process).contains(word));
        named.next_back()
    }

    /// Bytes in the record files of `host` whose names contain `word`.
    fn record_bytes(&self, host: usize, word: &str) -> u64 {
        let folder = self.folder_of(host).unwrap_or_default().join("records");
        let entries = fs::read_dir(folder).into_iter().flatten().flatten();
        let chosen = entries.filter(|entry| entry.file_name().to_string_lossy().contains(word));
        let sizes = chosen.filter_map(|entry| entry.metadata().ok());
        sizes.map(|data| data.len()).sum()
    }

    fn messages_flow(&self) -> bool {
        self.record_bytes(0, "status.taken") > FLOWING_BYTES
            && self.record_bytes(1, "command.taken") > FLOWING_BYTES
    }
}

/// How an episode went.
#[derive(Debug)]
pub struct Report {
    /// What was done.
    pub plan: Plan,
    /// What must hold and does not; empty when all is well.
    pub violations: Vec<String>,
    /// How each host ended, in a few words.
    pub ends: [String; 2],
    /// What could not be done.
    pub notes: Vec<String>,
    /// How long it took.
    pub took: Duration,
    /// Messages published, and of those taken, over both channels, as host 0 tells it, else host 1.
    pub messages: Option<(u64, u64)>,
}

/// How both supervisors ended; `None` for one that did not.
pub type Ends = [Option<Finished>; 2];

/// Plays the episode of `plan`.
///
/// # Panics
/// When the stage cannot be built.
pub fn play(plan: &Plan) -> Report {
    let began = Instant::now();
    let lab = Lab::two_hosts().unwrap_or_else(|reason| panic!("no lab: {reason}"));
    let number = lab.host(0).namespace().replace("hil-lab-", "");
    let record = PathBuf::from(format!("/run/chaos-{number}"));
    for host in 0..2 {
        lab.host(host).mount_disk(&record, &format!("{DISK_MIB}m"));
    }
    // Outside of what the hosts have for themselves.
    let keys = RunFolder::new("chaos-key");
    let key = plan.is_sealed.then(|| hop_key(keys.path()));
    let mut guards = [0, 1].map(|host| start(lab.host(host), plan, &record, key.as_deref()));
    let supervisors = [guards[0].pid(), guards[1].pid()];
    let stage = Stage {
        lab,
        record,
        supervisors,
    };
    let mut effects = Effects::default();
    let mut violations = Vec::new();
    thread::scope(|scope| {
        let started = Instant::now();
        let mut at_start = plan
            .injections
            .iter()
            .filter(|one| one.kind == Kind::KillAtStart);
        let is_over = |guards: &mut [ChildGuard; 2]| guards.iter_mut().any(|one| !one.is_running());
        let mut next = at_start.next();
        while !stage.messages_flow() && !is_over(&mut guards) && started.elapsed() < FLOW_LIMIT {
            if let Some(injection) = next.filter(|one| started.elapsed() >= one.at) {
                effects.inject(&stage, injection, scope);
                next = at_start.next();
            }
            thread::sleep(POLL_INTERVAL);
        }
        let flowing = Instant::now();
        let before = held_before(plan, &stage);
        let rest = plan
            .injections
            .iter()
            .filter(|one| one.kind != Kind::KillAtStart);
        for injection in rest {
            wait_until(flowing + injection.at, &stage, &mut effects);
            effects.inject(&stage, injection, scope);
        }
        // Before anything is stopped.
        wait_until(flowing + RUN_LENGTH.mul_f64(0.8), &stage, &mut effects);
        violations.extend(verdict::gained_files(&before, &held(&stage)));
        let deadline = Instant::now() + END_LIMIT;
        while guards.iter_mut().any(ChildGuard::is_running) && Instant::now() < deadline {
            effects.undo_due(&stage, Instant::now());
            thread::sleep(POLL_INTERVAL);
        }
        effects.undo_all(&stage);
    });
    let ends: Ends = guards.map(|mut guard| guard.wait_within(Duration::from_millis(10)).ok());
    let judged = Verdict::of(plan, &stage, &ends);
    violations.extend(judged.violations);
    violations.extend(sweep(plan, &stage));
    keep(plan, &stage, &ends, &violations);
    Report {
        plan: plan.clone(),
        violations,
        ends: judged.ends,
        notes: effects.notes,
        took: began.elapsed(),
        messages: judged.messages,
    }
}

fn start(host: &LabHost, plan: &Plan, record: &Path, key: Option<&Path>) -> ChildGuard {
    let settings = [
        format!("run.record=\"{}\"", record.display()),
        format!("run.duration=\"{} ms\"", RUN_LENGTH.as_millis()),
        format!("run.seed={}", plan.seed % 1_000_000),
        "run.start_timeout=\"8 s\"".to_owned(),
        // On plain hops damage reaches the bridges, which a seal keeps from them.
        match key {
            Some(key) => format!("security.key=\"{}\"", key.display()),
            None => "security.hops=\"plain\"".to_owned(),
        },
        format!("run.peer_timeout=\"{} s\"", PEER_TIMEOUT.as_secs()),
        "case.parameters.rate_hz=200".to_owned(),
        "processes.controller.on_exit=\"restart\"".to_owned(),
        "processes.robot.on_exit=\"restart\"".to_owned(),
    ];
    let mut command = host.command(hil_runtime_binary());
    command
        .arg("--topology")
        .arg(shipped_topology(match plan.carrier {
            Carrier::Tcp => "shuttle-tcp.toml",
            Carrier::Udp | Carrier::Emulated => "shuttle-split.toml",
        }));
    for setting in &settings {
        command.args(["--set", setting]);
    }
    if plan.carrier == Carrier::Emulated {
        command.args(["--set", "links.hop.via=\"emulated\""]);
        command.args(["--set", "links.hop.delay=\"2 ms\""]);
    }
    let started = ChildGuard::spawn(&mut command);
    started.unwrap_or_else(|error| panic!("the binary under test cannot be started: {error}"))
}

/// Waits, and undoes meanwhile what is due.
fn wait_until(at: Instant, stage: &Stage, effects: &mut Effects) {
    loop {
        let now = Instant::now();
        effects.undo_due(stage, now);
        if now >= at {
            return;
        }
        thread::sleep(POLL_INTERVAL);
    }
}

/// What the supervisors and gateways hold, by process.
fn held(stage: &Stage) -> Vec<(String, Pid, Held)> {
    let mut found = Vec::new();
    for (host, host_name) in HOSTS.iter().enumerate() {
        let supervisor = ("supervisor".to_owned(), Some(stage.supervisor(host)));
        let gateway = stage.process(host, "/launch/gateway-hop");
        for (name, process) in [supervisor, ("gateway".to_owned(), gateway)] {
            if let Some((process, held)) = process.and_then(|one| Some((one, Held::of(one)?))) {
                found.push((format!("{name} on {host_name}"), process, held));
            }
        }
    }
    found
}

/// The same when messages flow. A gateway that was killed at the start may then still be opening what it
/// needs: with such a kill, once nothing has been opened for a while. Only then, for what the plan does as
/// soon as messages flow must not be kept waiting.
fn held_before(plan: &Plan, stage: &Stage) -> Vec<(String, Pid, Held)> {
    let began = Instant::now();
    let mut found = held(stage);
    let mut kinds = plan.injections.iter().map(|one| one.kind);
    if kinds.all(|kind| kind != Kind::KillAtStart) {
        return found;
    }
    let mut since = began;
    while since.elapsed() < SETTLED && began.elapsed() < SETTLE_LIMIT {
        thread::sleep(POLL_INTERVAL);
        let now = held(stage);
        let is_same = now.len() == found.len()
            && now
                .iter()
                .zip(&found)
                .all(|((_, one, now), (_, other, then))| {
                    one == other && now.file_count == then.file_count
                });
        if !is_same {
            since = Instant::now();
        }
        found = now;
    }
    found
}

/// After a killed supervisor the next run on its host must clear what is left; then, and without
/// such a kill at once, nothing may be left.
fn sweep(plan: &Plan, stage: &Stage) -> Vec<String> {
    let mut violations = Vec::new();
    for (host, name) in HOSTS.iter().enumerate() {
        let lab_host = stage.lab.host(host);
        if plan.has(Kind::KillSupervisor, Some(host)) {
            let mut command = lab_host.command(hil_runtime_binary());
            command
                .arg("--topology")
                .arg(shipped_topology("shuttle-local.toml"));
            command.args(["--set", "run.duration=\"200 ms\""]);
            command.args(["--set", "run.record=\"/run/tmp/next\""]);
            if let Err(reason) = child::run(&mut command, COMMAND_LIMIT) {
                violations.push(format!("the next run on {name} failed: {reason}"));
            }
        }
        violations.extend(verdict::leftovers(stage, host));
    }
    violations
}

/// Where the folders of a violated episode are kept, if anywhere.
pub const KEEP_VARIABLE: &str = "HIL_CHAOS_KEEP";

fn keep(plan: &Plan, stage: &Stage, ends: &Ends, violations: &[String]) {
    let Some(folder) = std::env::var_os(KEEP_VARIABLE).filter(|_| !violations.is_empty()) else {
        return;
    };
    let folder = PathBuf::from(folder).join(plan.seed.to_string());
    drop(fs::create_dir_all(&folder));
    for host in 0..2 {
        let mut copy = std::process::Command::new("cp");
        copy.arg("-r")
            .arg(stage.record_of(host))
            .arg(folder.join(HOSTS[host]));
        drop(child::run(&mut copy, COMMAND_LIMIT));
        if let Some(end) = &ends[host] {
            let text = format!("{}\n{}\n{}", end.status, end.stdout, end.stderr);
            drop(fs::write(folder.join(format!("{}.txt", HOSTS[host])), text));
        }
    }
    drop(fs::write(
        folder.join("violations.txt"),
        violations.join("\n"),
    ));
}
