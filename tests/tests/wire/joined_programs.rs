//! Two programs that know nothing of us, joined by `hil-runtime join` as a user without any right: what they count
//! themselves and what the account says of their flows is the same.

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use hil_account::flow::FlowMetrics;
use hil_report::summary::RunSummary;
use hil_rundir::pipe::InletReport;
use hil_tests::binary::{hil_runtime_binary, workspace_folder};
use hil_tests::child::{ChildGuard, Finished};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{processes_mentioning, wait_until};
use nix::sys::signal::Signal;
use serde_json::Value;

pub(super) const LIMIT: Duration = Duration::from_mins(2);
/// Who runs it where the tests run as root: `nobody`, without a capability.
const NOBODY: [&str; 5] = [
    "--reuid=65534",
    "--regid=65534",
    "--clear-groups",
    "--no-new-privs",
    "--bounding-set=-all",
];

/// Says why a test is skipped that needs `program`; in CI it fails.
pub(super) fn lacks(program: &str, package: &str) -> bool {
    let Some(reason) = missing(program, package) else {
        return false;
    };
    let is_ci = std::env::var("CI").is_ok_and(|value| !value.is_empty() && value != "false");
    assert!(!is_ci, "CI has every program, but {reason}");
    eprintln!("skipped: {reason}");
    true
}

/// That `program` is missing and which package has it; `None` where it is there.
pub(super) fn missing(program: &str, package: &str) -> Option<String> {
    let path = std::env::var("PATH").unwrap_or_default();
    let is_there = path
        .split(':')
        .any(|one| Path::new(one).join(program).is_file());
    let reason = format!("`{program}` is not in PATH (Debian: apt-get install {package})");
    (!is_there).then_some(reason)
}

/// A folder of a user without rights, with a program of its own.
pub(super) struct Place {
    pub(super) folder: RunFolder,
    pub(super) binary: PathBuf,
}

impl Place {
    pub(super) fn new(label: &str) -> Self {
        let folder = RunFolder::new(label);
        let binary = folder.join("hil-runtime");
        fs::copy(hil_runtime_binary(), &binary).unwrap();
        for path in [folder.path(), &binary] {
            fs::set_permissions(path, fs::Permissions::from_mode(0o777)).unwrap();
        }
        Self { folder, binary }
    }

    /// `hil-runtime join` with these arguments, run by a user without rights.
    pub(super) fn join(&self, arguments: &[&str]) -> ChildGuard {
        self.start(
            &[self.binary.to_str().unwrap(), "join", "--quiet"],
            arguments,
        )
    }

    pub(super) fn start(&self, program: &[&str], arguments: &[&str]) -> ChildGuard {
        let mut command = if nix::unistd::geteuid().is_root() {
            let mut command = Command::new("setpriv");
            command.args(NOBODY).args(program);
            command
        } else {
            let mut command = Command::new(program[0]);
            command.args(&program[1..]);
            command
        };
        command.args(arguments).current_dir(self.folder.path());
        ChildGuard::spawn(&mut command).unwrap()
    }

    /// Runs it to its end; nothing of it is left.
    pub(super) fn run(&self, arguments: &[&str]) -> Finished {
        let finished = self.join(arguments).wait_within(LIMIT).unwrap();
        self.assert_nothing_left();
        finished
    }

    pub(super) fn assert_nothing_left(&self) {
        let path = self.binary.to_str().unwrap().to_owned();
        wait_until(LIMIT, "every process of the run has ended", || {
            processes_mentioning(&path).is_empty()
        });
    }

    fn run_folder(&self) -> PathBuf {
        let mut runs = fs::read_dir(self.folder.join("runs")).unwrap();
        runs.next().unwrap().unwrap().path()
    }

    pub(super) fn summary(&self) -> RunSummary {
        let text = fs::read_to_string(self.run_folder().join("summary.json")).unwrap();
        RunSummary::from_json(&text).unwrap()
    }

    fn said_by_first(&self) -> String {
        self.said_by("first")
    }

    pub(super) fn said_by(&self, program: &str) -> String {
        let log = self.run_folder().join(format!("logs/{program}.log"));
        fs::read_to_string(log).unwrap()
    }

    /// A program that nobody here wrote, or that knows nothing of us, put beside the binary.
    pub(super) fn copy_of(&self, program: &str) -> PathBuf {
        let copy = self.folder.join(program);
        let source = workspace_folder()
            .join("tests/foreign_programs")
            .join(program);
        fs::copy(source, &copy).unwrap();
        copy
    }
}

/// The flow that has `part` in its name, from one program or the other.
pub(super) fn flow<'a>(summary: &'a RunSummary, part: &str) -> &'a FlowMetrics {
    let mut flows = summary.flows.iter().flat_map(|one| &one.flows);
    let found = flows.find(|one| one.name.contains(part));
    found.unwrap_or_else(|| panic!("no flow {part} in {:#?}", summary.flows))
}

/// Every frame has one fate, and no inlet lost any.
pub(super) fn assert_closed(summary: &RunSummary) {
    assert_fates_add_up(summary);
    for channel in &summary.flows {
        // A frame of the kernel's own that comes as a program ends finds its interface down.
        let mut lost = channel.inlet_lost.iter();
        let lost = lost.find(|one| {
            let dropped = [InletReport::DROPPED_SENT, InletReport::DROPPED_GIVEN];
            !dropped.contains(&one.name.as_str()) || one.count > 2
        });
        assert_eq!(lost, None, "{}", channel.channel);
        for flow in &channel.flows {
            println!("{flow:?}");
        }
    }
}

/// Every frame that became a message has one fate.
pub(super) fn assert_fates_add_up(summary: &RunSummary) {
    assert_eq!(summary.flows.len(), 2);
    for channel in &summary.flows {
        let mut all_count = 0;
        for flow in &channel.flows {
            let fates = [
                flow.taken_count,
                flow.lost_by_network_count,
                flow.lost_by_either_count,
                flow.lost_by_harness_count,
                flow.unknown_count,
            ];
            assert_eq!(fates.iter().sum::<u64>(), flow.frame_count, "{flow:?}");
            all_count += flow.frame_count;
        }
        let mut accounts = summary.channels.iter();
        let account = accounts.find(|one| one.name == channel.channel).unwrap();
        let account = account.account.as_ref().unwrap();
        assert_eq!(all_count, account.published_count, "{}", channel.channel);
    }
}

/// The number in front of `words`.
pub(super) fn number_before(text: &str, words: &str) -> u64 {
    let before = text.split(words).next().unwrap();
    let digits = before
        .rsplit(|letter: char| !letter.is_ascii_digit())
        .next();
    digits
        .unwrap()
        .parse()
        .unwrap_or_else(|_none| panic!("no number before {words}: {text}"))
}

#[test]
fn ping_and_the_account_count_the_same_echoes_over_a_link_that_loses_and_delays() {
    if lacks("ping", "iputils-ping") {
        return;
    }
    let place = Place::new("join-ping");
    let link = ["--link", "delay 5ms loss 5%"];
    let ping = [
        "--",
        "ping",
        "-c",
        "300",
        "-i",
        "0.01",
        "-W",
        "1",
        "10.77.0.2",
    ];
    let finished = place.run(&[&link[..], &ping, &["--", "sleep", "60"]].concat());
    finished.assert_success();
    assert!(finished.stdout.contains("Flows"), "{}", finished.stdout);
    let (summary, said) = (place.summary(), place.said_by_first());
    assert_closed(&summary);
    let requests = flow(&summary, "icmp 10.77.0.1 → 10.77.0.2");
    let replies = flow(&summary, "icmp 10.77.0.2 → 10.77.0.1");
    assert_eq!(
        requests.frame_count,
        number_before(&said, " packets transmitted")
    );
    assert_eq!(replies.frame_count, requests.taken_count);
    assert_eq!(replies.taken_count, number_before(&said, " received"));
    assert!(requests.lost_by_network_count + replies.lost_by_network_count > 0);
    for one in [requests, replies] {
        assert_eq!(one.lost_by_harness_count, 0, "{one:?}");
        assert!(one.delay.measured().unwrap().min_ns >= 5_000_000, "{one:?}");
    }
}

#[test]
fn datagrams_longer_than_a_frame_pass_and_one_that_may_not_be_cut_is_refused_inside() {
    if lacks("ping", "iputils-ping") {
        return;
    }
    let place = Place::new("join-large");
    let script = "ping -c 3 -i 0.2 -s 6000 10.77.0.2 && ping -c 2 -i 0.2 -M do -s 1472 10.77.0.2 && \
                  ! ping -c 1 -M do -s 1473 10.77.0.2";
    let finished = place.run(&["--", "sh", "-c", script, "--", "sleep", "60"]);
    finished.assert_success();
    let (summary, said) = (place.summary(), place.said_by_first());
    assert_closed(&summary);
    assert!(
        said.contains("3 received") && said.contains("2 received"),
        "{said}"
    );
    assert!(said.contains("mtu=1500"), "{said}");
    // Five frames an echo of 6000 bytes, one of 1472.
    assert_eq!(flow(&summary, "icmp 10.77.0.1").frame_count, 3 * 5 + 2);
}

#[test]
fn iperf3_and_the_account_lose_the_same_datagrams() {
    if lacks("iperf3", "iperf3") {
        return;
    }
    let place = Place::new("join-iperf");
    let client =
        "sleep 1; exec iperf3 --udp --bitrate 4M --length 1000 --time 3 --json --client 10.77.0.2";
    // Losses of a full queue, not by chance: iperf3 gives up when the one datagram that opens its stream, or
    // the one that answers it, is lost.
    let link = ["--link", "delay 1ms rate 2Mbit"];
    let programs = ["--", "sh", "-c", client, "--", "iperf3", "--server"];
    place.run(&[&link[..], &programs].concat()).assert_success();
    let (summary, said) = (place.summary(), place.said_by_first());
    assert_closed(&summary);
    let said: Value = serde_json::from_str(&said[said.find('{').unwrap()..]).unwrap();
    let sum = &said["end"]["sum"];
    let [packets, lost] = ["packets", "lost_packets"].map(|key| sum[key].as_u64().unwrap());
    let datagrams = flow(&summary, "udp 10.77.0.1");
    println!("iperf3: {lost} of {packets} lost");
    // Beside its datagrams it sends one that opens the stream; the last ones it does not count as lost.
    assert!((packets..=packets + 2).contains(&datagrams.frame_count));
    // What was under way when it ended is lost to it.
    let not_taken = datagrams.lost_by_network_count + datagrams.unknown_count;
    assert!(not_taken.abs_diff(lost) <= 3, "{lost}: {datagrams:?}");
    assert!(
        lost > 0 && datagrams.lost_by_harness_count == 0,
        "{datagrams:?}"
    );
    assert!(flow(&summary, "tcp 10.77.0.1").taken_count > 0);
}

#[test]
fn a_java_controller_and_robot_and_the_account_count_the_same_datagrams() {
    if lacks("javac", "default-jdk-headless") {
        return;
    }
    let place = Place::new("join-java");
    let agents = place.copy_of("Agents.java");
    let agents = agents.to_str().unwrap();
    let link = ["--link", "delay 2ms loss 2%", "--seed", "3"];
    let controller = ["--", "java", agents, "controller", "10.77.0.2", "1000", "4"];
    let robot = ["--", "java", agents, "robot", "10.77.0.1"];
    let finished = place.run(&[&link[..], &controller, &robot].concat());
    finished.assert_success();
    let summary = place.summary();
    assert_closed(&summary);
    let (commands, status) = (
        flow(&summary, "10.77.0.2:6001"),
        flow(&summary, "10.77.0.1:6002"),
    );
    let (controller, robot) = (place.said_by("first"), place.said_by("second"));
    println!("{controller}{}", robot.lines().last().unwrap());
    assert_eq!(
        commands.frame_count,
        number_before(&controller, " commands sent")
    );
    let received = robot.lines().last().unwrap();
    assert_eq!(
        commands.taken_count,
        number_before(received, " commands received")
    );
    assert_eq!(status.frame_count, commands.taken_count);
    assert_eq!(
        status.taken_count,
        number_before(&controller, " status received")
    );
    for one in [commands, status] {
        assert!(one.lost_by_network_count > 0, "{one:?}");
        assert_eq!(
            one.taken_count + one.lost_by_network_count,
            one.frame_count,
            "{one:?}"
        );
    }
    let response_us = controller.split("median response ").nth(1).unwrap();
    assert!(number_before(response_us, " us") >= 4_000, "{controller}");
}

/// Where a Python with the package RSIPI is.
const RSI_VARIABLE: &str = "HIL_RSI_PYTHON";

#[test]
fn a_kuka_controller_misses_the_answers_that_our_deadline_counts() {
    let python = std::env::var(RSI_VARIABLE).unwrap_or_default();
    if python.is_empty() {
        eprintln!("skipped: {RSI_VARIABLE} names no Python with RSIPI");
        return;
    }
    let place = Place::new("join-rsi");
    let script = place.copy_of("rsi.py");
    let script = script.display();
    // RSIPI waits for an answer from one cycle after a packet until another one is over.
    let topology = format!(
        r#"version = 1
name = "rsi"
[hosts]
robot-pc = {{}}
sensor-pc = {{}}
[processes]
robot = {{ host = "robot-pc", run = ["{python}", "{script}", "robot", "10.77.0.2", "10"], inside = "10.77.0.1" }}
sensor = {{ host = "sensor-pc", run = ["{python}", "{script}", "sensor"], inside = "10.77.0.2" }}
[channels]
out = {{ from = "robot", to = "sensor", link = "hop" }}
back = {{ from = "sensor", to = "robot", link = "hop" }}
[links.hop]
via = "emulated"
between = ["robot-pc", "sensor-pc"]
delay = "1 ms"
loss_ratio = 0.02
[flows.cycle]
match = "udp dst port 64000"
deadline = "8 ms"
"#
    );
    // As the user of the tests, who can read that Python.
    let summary = run_topology(&place, "rsi.toml", &topology, || ());
    assert_closed(&summary);
    let said = place.said_by("robot");
    let said = said
        .lines()
        .find(|line| line.contains(" packets sent"))
        .unwrap();
    let [sent, faulty] = [" packets sent", " faulty"].map(|words| number_before(said, words));
    let cycle = &summary.deadlines[0];
    println!("RSIPI: {faulty} of {sent} faulty; {cycle:?}");
    assert_eq!(cycle.request_count, sent);
    let late = [
        cycle.late_by_network_count,
        cycle.late_by_program_count,
        cycle.late_by_both_count,
        cycle.late_by_harness_count,
    ];
    let missing = cycle.missing_by_network_count + cycle.missing_by_program_count;
    assert!(cycle.missing_by_network_count > 0, "{cycle:?}");
    // What was lost last it does not count any more. Whether it still takes what comes at the end of its time hangs
    // on when it gets a processor.
    assert!(
        faulty + 10 >= cycle.missing_by_network_count,
        "{said}{cycle:?}"
    );
    let most = missing + late.iter().sum::<u64>() + cycle.unknown_count + sent / 20;
    assert!(faulty <= most, "{said}{cycle:?}");
}

/// Runs the topology `text`, named `name`, as the user of the tests, until `meanwhile` is done and it has ended.
fn run_topology(place: &Place, name: &str, text: &str, meanwhile: impl FnOnce()) -> RunSummary {
    let file = place.folder.join(name);
    fs::write(&file, text).unwrap();
    let mut command = Command::new(&place.binary);
    command.args(["--quiet", "--topology"]).arg(&file);
    command.current_dir(place.folder.path());
    let mut run = ChildGuard::spawn(&mut command).unwrap();
    meanwhile();
    run.wait_within(LIMIT).unwrap().assert_success();
    place.assert_nothing_left();
    place.summary()
}

#[test]
fn programs_of_one_host_need_no_link_and_no_gateway() {
    if lacks("ping", "iputils-ping") {
        return;
    }
    let topology = r#"version = 1
name = "neighbours"
[processes]
one = { run = ["ping", "-c", "50", "-i", "0.01", "10.77.0.2"], inside = "10.77.0.1" }
other = { run = ["sleep", "100"], inside = "10.77.0.2" }
[channels]
out = { from = "one", to = "other" }
back = { from = "other", to = "one" }
"#;
    let place = Place::new("join-local");
    let summary = run_topology(&place, "neighbours.toml", topology, || ());
    assert_closed(&summary);
    for name in ["icmp 10.77.0.1 → 10.77.0.2", "icmp 10.77.0.2 → 10.77.0.1"] {
        let echoes = flow(&summary, name);
        assert_eq!((echoes.frame_count, echoes.taken_count), (50, 50));
    }
}

#[test]
fn killed_gateways_and_programs_come_back_and_frames_flow_again() {
    if lacks("python3", "python3") {
        return;
    }
    let place = Place::new("join-killed");
    let talker = place.folder.join("talker.py");
    let program = "import socket, time\n\
                   one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)\n\
                   while True:\n    one.sendto(b'x' * 64, ('10.77.0.2', 5000))\n    time.sleep(0.002)\n";
    fs::write(&talker, program).unwrap();
    let talker = talker.display();
    let topology = format!(
        r#"version = 1
name = "killed"
[run]
duration = "14 s"
[hosts]
control-pc = {{}}
robot-pc = {{}}
[processes]
controller = {{ host = "control-pc", run = ["python3", "{talker}"], inside = "10.77.0.1", on_exit = "restart" }}
robot = {{ host = "robot-pc", run = ["sleep", "100"], inside = "10.77.0.2", on_exit = "restart" }}
[channels]
out = {{ from = "controller", to = "robot", link = "hop" }}
back = {{ from = "robot", to = "controller", link = "hop" }}
[links.hop]
via = "emulated"
between = ["control-pc", "robot-pc"]
delay = "1 ms"
"#
    );
    let victims = [
        "gateway-hop-robot-pc",
        "robot",
        "gateway-hop-control-pc",
        "controller",
    ];
    let kill_each = || {
        for victim in victims {
            let process = |instance: u32| {
                let of_place = processes_mentioning(place.folder.path().to_str().unwrap());
                let launched = processes_mentioning(&format!("/{victim}.{instance}.json"));
                launched.into_iter().find(|pid| of_place.contains(pid))
            };
            wait_until(LIMIT, "the process runs", || process(0).is_some());
            // Frames flow, and what flows again after the kill before is recorded.
            std::thread::sleep(Duration::from_secs(2));
            nix::sys::signal::kill(process(0).unwrap(), Signal::SIGKILL).unwrap();
            wait_until(LIMIT, "it was started again", || process(1).is_some());
        }
    };
    let summary = run_topology(&place, "killed.toml", &topology, kill_each);
    for victim in victims {
        let found = summary.processes.iter().find(|one| one.name == victim);
        assert_eq!(found.unwrap().restart_count, 1, "{victim}");
    }
    let flows = summary.flows.iter().flat_map(|one| &one.flows);
    let datagrams: Vec<&FlowMetrics> = flows
        .filter(|one| one.name.contains("udp 10.77.0.1"))
        .collect();
    // One of each start of the controller, whose port is another each time.
    let [before, after] = datagrams[..] else {
        panic!("{datagrams:#?}");
    };
    // Three kills, with two seconds after each of the gateways' and the robot's in which all were taken.
    assert!(before.taken_count > 1_500, "{before:?}");
    assert!(after.taken_count > 500, "{after:?}");
    for one in [before, after] {
        assert_eq!(one.lost_by_network_count, 0, "{one:?}");
    }
    assert!(before.lost_by_harness_count < 500, "{before:?}");
}

#[test]
fn ctrl_c_leaves_a_report_and_nothing_else_and_a_program_that_fails_is_named_with_its_last_line() {
    let place = Place::new("join-end");
    let mut child = place.join(&[
        "--",
        "sleep",
        "100",
        "--",
        "sh",
        "-c",
        "sleep 100 & sleep 100",
    ]);
    let records = place.folder.join("runs");
    wait_until(LIMIT, "a frame is recorded", || {
        let Ok(mut runs) = fs::read_dir(&records) else {
            return false;
        };
        let run = runs
            .next()
            .and_then(Result::ok)
            .map(|run| run.path().join("records"));
        let files = run.and_then(|run| fs::read_dir(run).ok());
        files.is_some_and(|mut files| {
            files.any(|file| {
                let file = file.unwrap();
                let name = file.file_name().into_string().unwrap();
                name.contains(".frame.") && file.metadata().unwrap().len() > 128
            })
        })
    });
    child.signal(Signal::SIGINT).unwrap();
    let finished = child.wait_within(LIMIT).unwrap();
    assert_eq!(finished.status.code(), Some(130), "{}", finished.stderr);
    place.assert_nothing_left();
    assert_closed(&place.summary());

    let place = Place::new("join-missing");
    let finished = place.run(&["--", "sleep", "1", "--", "no-such-program"]);
    assert_eq!(finished.status.code(), Some(2));
    let said = "error: processes.second.run: cannot start no-such-program: ";
    assert!(finished.stderr.starts_with(said), "{}", finished.stderr);
    assert_eq!(finished.stderr.lines().count(), 1, "{}", finished.stderr);

    let place = Place::new("join-failed");
    let script = "echo no such device >&2; exit 7";
    let finished = place.run(&["--", "sh", "-c", script, "--", "sleep", "100"]);
    assert_eq!(finished.status.code(), Some(1));
    let said = "sh ended with exit code 7, after it said \"no such device\"";
    for words in [said, "/logs/first.log"] {
        assert!(finished.stderr.contains(words), "{}", finished.stderr);
    }
}

#[test]
fn a_refusal_of_the_kernel_is_told_with_its_cure() {
    let place = Place::new("join-refused");
    let binary = place.binary.to_str().unwrap();
    let script = format!(
        "echo 0 > /proc/sys/user/max_net_namespaces && exec {binary} join --quiet -- true -- true"
    );
    let unshare = ["unshare", "--user", "--map-root-user", "sh", "-c"];
    let mut child = place.start(&unshare, &[&script]);
    let finished = child.wait_within(LIMIT).unwrap();
    assert_eq!(finished.status.code(), Some(1), "{}", finished.stderr);
    let cure = "max_net_namespaces is 0: raise the one that is used up with sysctl";
    assert!(finished.stderr.contains(cure), "{}", finished.stderr);
    place.assert_nothing_left();
}

#[test]
fn what_a_stopped_process_of_ours_loses_is_the_harness_and_not_the_network() {
    if lacks("python3", "python3") {
        return;
    }
    let place = Place::new("join-stopped");
    let client = "import socket, time\n\
                  one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)\n\
                  one.sendto(b'x', ('10.77.0.2', 5000))\n\
                  time.sleep(1)\n\
                  for number in range(4000):\n    one.sendto(b'x' * 64, ('10.77.0.2', 5000))\n    time.sleep(0.0005)\n\
                  time.sleep(30)\n";
    let mut child = place.join(&["--", "python3", "-c", client, "--", "sleep", "100"]);
    let own = |text: &str| {
        let of_place = processes_mentioning(place.folder.path().to_str().unwrap());
        let worker = processes_mentioning(text);
        worker.into_iter().find(|pid| of_place.contains(pid))
    };
    let launch = "/gateway-link-second.0.json";
    wait_until(LIMIT, "the gateway of the second program is there", || {
        own(launch).is_some()
    });
    let gateway = own(launch).unwrap();
    std::thread::sleep(Duration::from_secs(1));
    nix::sys::signal::kill(gateway, Signal::SIGSTOP).unwrap();
    std::thread::sleep(Duration::from_secs(5));
    nix::sys::signal::kill(gateway, Signal::SIGCONT).unwrap();
    std::thread::sleep(Duration::from_secs(1));
    child.signal(Signal::SIGINT).unwrap();
    child.wait_within(LIMIT).unwrap();
    place.assert_nothing_left();
    let summary = place.summary();
    assert_closed(&summary);
    let datagrams = flow(&summary, "udp 10.77.0.1");
    assert!(datagrams.lost_by_harness_count > 1_000, "{datagrams:?}");
    assert_eq!(datagrams.lost_by_network_count, 0, "{datagrams:?}");
}
