//! The real binary as a service: what systemd and the journal hear of a run. A socket and a file of the
//! test stand for them; the real ones are in `tests/lab/systemd.sh`.

use std::fs::{self, File};
use std::os::unix::fs::MetadataExt;
use std::os::unix::net::UnixDatagram;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use hil_tests::binary::hil_runtime_binary;
use hil_tests::child::ChildGuard;
use hil_tests::ports::own_ports;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{Trial, wait_until};
use nix::sys::signal::{Signal, kill};

const LIMIT: Duration = Duration::from_mins(1);

/// What a service says, in place of systemd.
struct Manager {
    path: PathBuf,
    socket: UnixDatagram,
    words: Vec<String>,
}

impl Manager {
    fn new(folder: &RunFolder) -> Self {
        let path = folder.join("notify");
        let socket = UnixDatagram::bind(&path).unwrap();
        socket.set_nonblocking(true).unwrap();
        let words = Vec::new();
        Self {
            path,
            socket,
            words,
        }
    }

    /// The command as systemd would start it for a unit with `WatchdogSec=10s`.
    fn start(&self, mut command: Command) -> ChildGuard {
        command.env("NOTIFY_SOCKET", &self.path);
        command.env("WATCHDOG_USEC", "10000000");
        ChildGuard::spawn(&mut command).unwrap()
    }

    fn listen(&mut self) {
        let mut buffer = [0; 4096];
        while let Ok(length) = self.socket.recv(&mut buffer) {
            let words = String::from_utf8(buffer[..length].to_vec()).unwrap();
            self.words.push(words);
        }
    }

    fn count(&mut self, word: &str) -> usize {
        self.listen();
        self.words.iter().filter(|one| *one == word).count()
    }

    fn wait_for(&mut self, start: &str) {
        wait_until(LIMIT, start, || {
            self.listen();
            self.words.iter().any(|word| word.starts_with(start))
        });
    }

    fn place(&self, start: &str) -> usize {
        let found = self.words.iter().position(|word| word.starts_with(start));
        found.unwrap_or_else(|| panic!("no {start} in {:?}", self.words))
    }
}

#[test]
fn systemd_hears_that_a_run_is_up_how_it_goes_and_that_it_ends() {
    let folder = RunFolder::new("service");
    let mut manager = Manager::new(&folder);
    let trial = Trial::shipped("shuttle-local.toml", &folder.join("runs"));
    let mut run = manager.start(trial.set("run.duration=\"3 s\"").command_here());
    // The kernel holds a dozen words for a manager that does not listen.
    wait_until(LIMIT, "the end of the run", || {
        manager.listen();
        !run.is_running()
    });
    run.wait_within(LIMIT).unwrap().assert_success();
    assert_eq!(manager.count("READY=1"), 1, "{:?}", manager.words);
    assert_eq!(manager.count("STOPPING=1"), 1, "{:?}", manager.words);
    assert!(manager.count("WATCHDOG=1") > 2, "{:?}", manager.words);
    let has_progress = manager
        .words
        .iter()
        .any(|word| word.contains("/ 3 s") && word.contains("shuttle/command"));
    assert!(has_progress, "{:?}", manager.words);
    assert!(manager.place("READY=1") < manager.place("STOPPING=1"));
    assert!(manager.place("STOPPING=1") < manager.place("STATUS=ending"));
}

#[test]
fn a_host_that_waits_for_another_is_up_and_says_so() {
    let folder = RunFolder::new("service-waits");
    let mut manager = Manager::new(&folder);
    let port = own_ports();
    let trial = Trial::shipped("shuttle-split.toml", &folder.join("runs"))
        .set("hosts.control-pc.address=\"127.0.0.1\"")
        .set("hosts.robot-pc.address=\"127.0.0.2\"")
        .set(&format!("hosts.control-pc.control_port={port}"));
    let mut command = trial.command_here();
    command.args(["--host", "control-pc"]);
    let mut run = manager.start(command);
    manager.wait_for("READY=1");
    manager.wait_for("WATCHDOG=1");
    manager.wait_for("STATUS=waiting for robot-pc to connect to 127.0.0.1");
    run.signal(Signal::SIGTERM).unwrap();
    assert_eq!(run.wait_within(LIMIT).unwrap().status.code(), Some(130));
}

#[test]
fn a_process_that_hangs_keeps_the_ticks_back_and_is_in_the_report() {
    let folder = RunFolder::new("service-hangs");
    let mut manager = Manager::new(&folder);
    let trial = Trial::shipped("shuttle-local.toml", &folder.join("runs"));
    let trial = trial.set("run.duration=\"10 min\"");
    let mut run = manager.start(trial.command_here());
    manager.wait_for("STATUS=");
    let files = trial.folder("", LIMIT);
    let robot = files.process("robot", 0).unwrap();
    let environment = fs::read(format!("/proc/{robot}/environ")).unwrap();
    let environment = String::from_utf8_lossy(&environment).into_owned();
    assert!(!environment.contains("NOTIFY_SOCKET"), "{environment}");

    kill(robot, Signal::SIGSTOP).unwrap();
    let silent = run.wait_for_output("robot: gave no sign of life for 3 s", LIMIT);
    // A stopped process would outlive the test's panic.
    silent.unwrap_or_else(|error| panic!("{:?} {error}", kill(robot, Signal::SIGCONT)));
    let ticks = manager.count("WATCHDOG=1");
    let until = Instant::now() + Duration::from_secs(2);
    while Instant::now() < until {
        thread::sleep(Duration::from_millis(20));
    }
    let later = manager.count("WATCHDOG=1");
    kill(robot, Signal::SIGCONT).unwrap();
    assert_eq!(later, ticks, "ticks while a process hangs");
    run.wait_for_output("robot: gives signs of life again", LIMIT)
        .unwrap();
    wait_until(LIMIT, "a tick", || manager.count("WATCHDOG=1") > ticks);

    run.signal(Signal::SIGTERM).unwrap();
    assert_eq!(run.wait_within(LIMIT).unwrap().status.code(), Some(130));
    let report = files.read("report-full.txt");
    assert!(report.contains("no sign of life for 3 s"), "{report}");
    assert!(report.contains("signs of life again"), "{report}");
}

#[test]
fn the_journal_gets_a_priority_with_every_line_and_no_other_file_does() {
    let folder = RunFolder::new("service-journal");
    let topology = folder.join("wrong.toml");
    fs::write(&topology, "version = 1\nname = \"wrong\"\nruns = 3\n").unwrap();
    for is_journal in [true, false] {
        let path = folder.join("stderr");
        let file = File::create(&path).unwrap();
        let meta = file.metadata().unwrap();
        let inode = meta.ino() + u64::from(!is_journal);
        let mut command = Command::new(hil_runtime_binary());
        command.arg("--topology").arg(&topology);
        command.env("JOURNAL_STREAM", format!("{}:{inode}", meta.dev()));
        let status = command.stderr(file).stdout(Stdio::null()).status().unwrap();
        assert_eq!(status.code(), Some(2));
        let text = fs::read_to_string(&path).unwrap();
        assert!(text.contains("runs"), "{text}");
        let marked = text.lines().filter(|line| line.starts_with("<3>")).count();
        let expected = if is_journal { text.lines().count() } else { 0 };
        assert_eq!(marked, expected, "{text}");
    }
}
