//! Hosts that give too little, and hosts where something is missing: a run is refused before it takes
//! anything, with what it needs, what there is and the cure, and runs with exactly what it asked for.

use core::fmt::Write as _;
use std::fs;
use std::net::UdpSocket;
use std::os::unix::process::ExitStatusExt as _;
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use hil_report::summary::Outcome;
use hil_tests::binary::hil_runtime_binary;
use hil_tests::child::{ChildGuard, Finished};
use hil_tests::lab::{ADDRESSES, INTERFACE, Lab, LabHost};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{RunFiles, Trial, wait_until};
use nix::unistd::Pid;

const HOSTS: [&str; 2] = ["a", "b"];
const LIMIT: Duration = Duration::from_mins(2);
/// A control port, and channels' ports from here on.
const PORT: u16 = 10_000;

/// Two hosts with an own program each, joined by `count` channels of 60 bytes, eight deep.
fn many_channels(record: &RunFolder, count: usize, program: &str) -> PathBuf {
    let mut text = format!(
        r#"version = 1
name = "many"
run.record = "{}"
run.duration = "2 s"
security.hops = "plain"
links.hop = {{ via = "udp", port = {PORT} }}
"#,
        record.path().display()
    );
    for (index, host) in HOSTS.iter().enumerate() {
        let address = ADDRESSES[index];
        write!(
            text,
            "hosts.{host}.address = \"{address}\"\n\
             processes.p{host} = {{ host = \"{host}\", run = [\"sh\", \"-c\", \"{program}\"] }}\n"
        )
        .unwrap();
    }
    for index in 0..count {
        let (from, to) = if index % 2 == 0 {
            ("pa", "pb")
        } else {
            ("pb", "pa")
        };
        write!(
            text,
            "[channels.\"c/{index}\"]\nfrom = \"{from}\"\nto = \"{to}\"\nlink = \"hop\"\ndepth = 8\n\
             message = {{ name = \"test.Sixty.v1\", size_bytes = 60, alignment_bytes = 4 }}\n"
        )
        .unwrap();
    }
    record.write("many.toml", &text)
}

/// `topology` on one host, with `limits` for prlimit(1).
fn start(host: &LabHost, name: &str, topology: &PathBuf, limits: &[&str]) -> ChildGuard {
    let mut command = host.command("prlimit");
    command.args(limits).arg("--").arg(hil_runtime_binary());
    command.args(["--host", name, "--topology"]).arg(topology);
    ChildGuard::spawn(&mut command).unwrap()
}

fn on_both(lab: &Lab, topology: &PathBuf, limits: &[&str]) -> [Finished; 2] {
    let hosts = [0, 1].map(|index| start(lab.host(index), HOSTS[index], topology, limits));
    hosts.map(|mut host| host.wait_within(LIMIT).unwrap())
}

/// How `command` ended.
fn run(command: &mut Command) -> Finished {
    ChildGuard::spawn(command)
        .unwrap()
        .wait_within(LIMIT)
        .unwrap()
}

fn files_of(record: &RunFolder, host: &str) -> RunFiles {
    let trial = Trial::of(&record.join("many.toml"), record.path());
    trial.folder(&format!("-{host}"), LIMIT)
}

/// It ended with `code`, and said each of `words`.
#[track_caller]
fn assert_refused(finished: &Finished, code: i32, words: &[&str]) {
    assert_eq!(finished.status.code(), Some(code), "{finished:?}");
    for words in words {
        let said = finished
            .stderr
            .split_whitespace()
            .collect::<Vec<_>>()
            .join(" ");
        assert!(said.contains(words), "{words:?} is not in {said}");
    }
}

/// The number behind `before` in what was said.
fn number_after(finished: &Finished, before: &str) -> u64 {
    let said = &finished.stderr;
    let (_, after) = said
        .split_once(before)
        .unwrap_or_else(|| panic!("{before:?}: {said}"));
    let digits: String = after.chars().take_while(char::is_ascii_digit).collect();
    digits.parse().unwrap()
}

fn resize_shared_memory(host: &LabHost, size: &str) {
    let mut command = host.command("mount");
    command.args(["-o", &format!("remount,size={size}"), "/dev/shm"]);
    run(&mut command).assert_success();
}

#[test]
fn too_little_shared_memory_is_refused_and_what_was_asked_for_is_enough() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("limits-shm");
    let topology = many_channels(&record, 12, "sleep 60");
    resize_shared_memory(lab.host(0), "16k");
    for check in [&["--check"][..], &[]] {
        let mut command = lab.host(0).command(hil_runtime_binary());
        command
            .args(["--host", "a", "--topology"])
            .arg(&topology)
            .args(check);
        let refused = run(&mut command);
        let words = [
            "the channels take",
            "of /dev/shm, which has",
            "remount,size=",
        ];
        assert_refused(&refused, 78, &words);
        if check.is_empty() {
            let size_mib = number_after(&refused, "remount,size=");
            resize_shared_memory(lab.host(0), &format!("{size_mib}M"));
        }
    }
    assert!(
        fs::read_dir(record.path()).unwrap().count() == 1,
        "a refused run leaves no folder"
    );
    for finished in on_both(&lab, &topology, &[]) {
        finished.assert_success();
    }
    assert_eq!(
        files_of(&record, "a").summary().run.outcome,
        Outcome::Completed
    );
}

#[test]
fn four_hundred_channels_run_under_a_low_soft_limit_that_own_programs_get_back() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("limits-many");
    let program = "ulimit -Sn; ls /proc/self/fd; exec sleep 60";
    let topology = many_channels(&record, 400, program);
    let hard_bounded =
        start(lab.host(0), "a", &topology, &["--nofile=1024:1024"]).wait_within(LIMIT);
    let refused = hard_bounded.unwrap();
    let words = [
        "gateway-hop-a opens up to",
        "RLIMIT_NOFILE allows 1024",
        "LimitNOFILE=",
    ];
    assert_refused(&refused, 78, &words);
    // Exactly what it asked for is enough for the process that needs most.
    let needed = number_after(&refused, "LimitNOFILE=");
    let limit = format!("--nofile=1024:{needed}");
    for finished in on_both(&lab, &topology, &[&limit]) {
        finished.assert_success();
    }
    for host in HOSTS {
        let files = files_of(&record, host);
        assert_eq!(files.summary().run.outcome, Outcome::Completed);
        let said = files.read(&format!("logs/p{host}.log"));
        let mut lines = said.lines();
        assert_eq!(lines.next(), Some("1024"), "{said}");
        // Its own three, and that of the listing.
        assert_eq!(lines.count(), 4, "{said}");
    }
}

#[test]
fn without_a_free_descriptor_the_meeting_waits_and_says_so_once() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("limits-accept");
    let topology = many_channels(&record, 2, "sleep 60");
    let mut first = start(lab.host(0), "a", &topology, &[]);
    first.wait_for_output("waiting for b", LIMIT).unwrap();
    let limit = |count: usize| {
        let (pid, count) = (first.pid().to_string(), format!("--nofile={count}:20000"));
        let mut command = Command::new("prlimit");
        run(command.args(["--pid", &pid, &count])).assert_success();
    };
    limit(lowest_free_descriptor(first.pid()));
    let mut second = start(lab.host(1), "b", &topology, &[]);
    wait_until(LIMIT, "the warning", || {
        first
            .stderr_so_far()
            .contains("cannot take a connection of another host for now")
    });
    limit(10_000);
    for host in [&mut first, &mut second] {
        host.wait_within(LIMIT).unwrap().assert_success();
    }
    let said = first.stderr_so_far();
    assert_eq!(
        said.matches("cannot take a connection").count(),
        1,
        "{said}"
    );
}

/// The number that the next descriptor of a process gets.
fn lowest_free_descriptor(process: Pid) -> usize {
    let entries = fs::read_dir(format!("/proc/{process}/fd"))
        .unwrap()
        .flatten();
    let numbers = entries.map(|entry| entry.file_name().to_string_lossy().parse().unwrap());
    let mut numbers: Vec<usize> = numbers.collect();
    numbers.sort_unstable();
    let taken = numbers.iter().enumerate();
    taken.take_while(|(index, number)| index == *number).count()
}

#[test]
fn threads_are_counted_before_any_is_started() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("limits-threads");
    let topology = many_channels(&record, 2, "sleep 60");
    // Root is exempt from this limit.
    let mut command = lab.host(0).command("setpriv");
    command.args([
        "--reuid=4242",
        "--regid=4242",
        "--clear-groups",
        "prlimit",
        "--nproc=20",
        "--",
    ]);
    command.arg(hil_runtime_binary());
    command
        .args(["--check", "--host", "a", "--topology"])
        .arg(&topology);
    let refused = run(&mut command);
    let words = ["the run starts up to", "RLIMIT_NPROC leaves", "LimitNPROC="];
    assert_refused(&refused, 78, &words);
}

#[test]
fn a_port_in_use_is_named_with_its_key_and_its_holder_before_the_hosts_meet() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("limits-port");
    let topology = many_channels(&record, 2, "sleep 60");
    let taken = lab
        .host(0)
        .on_network(|| UdpSocket::bind((ADDRESSES[0], PORT)).unwrap());
    for check in [&["--check"][..], &[]] {
        let mut command = lab.host(0).command(hil_runtime_binary());
        command
            .args(["--host", "a", "--topology"])
            .arg(&topology)
            .args(check);
        let refused = run(&mut command);
        let holder = format!("(process {})", std::process::id());
        let words = [
            "links.hop.port cannot be used",
            "udp 10.77.0.1:10000 of link hop/forward",
            &holder,
            "many.toml:",
        ];
        assert_refused(&refused, 75, &words);
    }
    drop(taken);
    for finished in on_both(&lab, &topology, &[]) {
        finished.assert_success();
    }
}

#[test]
fn a_port_that_is_taken_while_the_hosts_meet_ends_a_run_that_may_be_tried_again() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("limits-late-port");
    let topology = many_channels(&record, 2, "sleep 60");
    let mut first = start(lab.host(0), "a", &topology, &[]);
    first.wait_for_output("waiting for b", LIMIT).unwrap();
    let _taken = lab
        .host(0)
        .on_network(|| UdpSocket::bind((ADDRESSES[0], PORT)).unwrap());
    let mut second = start(lab.host(1), "b", &topology, &[]);
    assert_refused(
        &first.wait_within(LIMIT).unwrap(),
        75,
        &["10.77.0.1:10000", "in use"],
    );
    assert_refused(
        &second.wait_within(LIMIT).unwrap(),
        1,
        &["failed on a: process gateway-hop-a", "in use"],
    );
}

#[test]
fn an_interface_without_a_carrier_is_told_at_once_and_an_alternative_name_is_one() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("limits-carrier");
    let topology = many_channels(&record, 2, "sleep 60");
    let mut rename = Command::new("ip");
    let namespace = lab.host(0).namespace().to_owned();
    rename.args([
        "-n", &namespace, "link", "property", "add", "dev", INTERFACE, "altname", "cable0",
    ]);
    run(&mut rename).assert_success();
    let command = |arguments: &[&str]| {
        let mut command = lab.host(0).command(hil_runtime_binary());
        command
            .args(arguments)
            .args(["--host", "a", "--topology"])
            .arg(&topology);
        command.args(["--set", "hosts.a.interface=cable0"]);
        command
    };
    let doctor = run(&mut command(&["doctor", "--json"]));
    doctor.assert_success();
    let report: serde_json::Value = serde_json::from_str(&doctor.stdout).unwrap();
    for finding in report["findings"].as_array().unwrap() {
        let id = finding["id"].as_str().unwrap();
        let is_of_path = id.starts_with("interface.") || id.starts_with("route.");
        assert!(!is_of_path || finding["severity"] != "error", "{finding}");
    }
    run(&mut command(&["--check"])).assert_success();
    lab.host(1).set_link(INTERFACE, "down");
    // The kernel tells of it within a second.
    wait_until(LIMIT, "the lost carrier", || {
        run(&mut command(&["--check"])).status.code() != Some(0)
    });
    let words = [
        "hosts.a.interface cannot be used: interface eth0 has no carrier",
        "--set:1",
    ];
    assert_refused(&run(&mut command(&["--check"])), 75, &words);
    // A run says it and waits.
    let mut waiting = ChildGuard::spawn(&mut command(&[])).unwrap();
    waiting.wait_for_output("waiting for b", LIMIT).unwrap();
    let said = waiting.stderr_so_far();
    assert!(
        said.contains("hosts.a.interface: interface eth0 has no carrier"),
        "{said}"
    );
    waiting.signal(nix::sys::signal::Signal::SIGINT).unwrap();
    let ended = waiting.wait_within(LIMIT).unwrap();
    assert_eq!(ended.status.signal(), None, "{ended:?}");
}
