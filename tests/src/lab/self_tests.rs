//! What a lab promises, tested on real labs.

use std::net::UdpSocket;
use std::panic::catch_unwind;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use super::*;
use crate::child::{ChildGuard, run};

const LONG: Duration = Duration::from_secs(30);

fn shell(host: &LabHost, script: &str) -> Command {
    let mut command = host.command("sh");
    command.args(["-c", script]);
    command
}

fn output(host: &LabHost, script: &str) -> String {
    run(&mut shell(host, script), LONG)
        .unwrap()
        .stdout
        .trim()
        .to_owned()
}

fn socket_on(host: &LabHost) -> UdpSocket {
    let socket = host
        .on_network(|| UdpSocket::bind((host.address(), 0)))
        .unwrap();
    socket.set_read_timeout(Some(LONG)).unwrap();
    socket
}

#[test]
fn datagrams_cross_the_cable_both_ways() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let [first, second] = [0, 1].map(|index| socket_on(lab.host(index)));
    let mut buffer = [0; 16];
    first
        .send_to(b"there", second.local_addr().unwrap())
        .unwrap();
    let (length, from) = second.recv_from(&mut buffer).unwrap();
    assert_eq!(&buffer[..length], b"there");
    assert_eq!(from, first.local_addr().unwrap());
    second.send_to(b"and back", from).unwrap();
    let (length, _) = first.recv_from(&mut buffer).unwrap();
    assert_eq!(&buffer[..length], b"and back");
}

#[test]
fn each_host_has_shared_memory_and_runtime_folders_of_its_own() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let (first, second) = (lab.host(0), lab.host(1));
    output(
        first,
        "echo one > /dev/shm/h00c0ffee_probe; echo two > /run/hil/probe",
    );
    // A second command on the same host sees what the first one left; the other host does not.
    assert_eq!(
        output(first, "cat /dev/shm/h00c0ffee_probe /run/hil/probe"),
        "one\ntwo"
    );
    assert_eq!(
        output(second, "ls /dev/shm /run/hil | grep probe || echo none"),
        "none"
    );
    assert!(!Path::new("/dev/shm/h00c0ffee_probe").exists());
    assert!(!Path::new("/run/hil/probe").exists());
    // And the test can look from outside.
    assert_eq!(first.shared_memory_leftovers(), ["h00c0ffee_probe"]);
    assert!(second.shared_memory_leftovers().is_empty());
    assert_eq!(
        fs::read_to_string(first.locate("/run/hil/probe")).unwrap(),
        "two\n"
    );
}

#[test]
fn a_command_keeps_its_folder_its_variables_and_its_identifier() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let here = std::env::current_dir().unwrap();
    let mut command = shell(lab.host(1), "pwd; echo $$ $PROBE $TMPDIR; exec sleep 1000");
    let mut child = ChildGuard::spawn(command.env("PROBE", "kept")).unwrap();
    child.wait_for_output("kept", LONG).unwrap();
    let expected = format!("{}\n{} kept /run/tmp\n", here.display(), child.pid());
    assert_eq!(child.stdout_so_far(), expected);
}

#[test]
fn only_the_cable_and_the_loopback_are_there() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    for host in &lab.hosts {
        assert_eq!(output(host, "ls /sys/class/net | tr '\\n' ' '"), "eth0 lo");
        let addresses = output(host, "ip -4 -oneline address show dev eth0");
        assert!(
            addresses.contains(&format!("{}/24", host.address())),
            "{addresses}"
        );
    }
}

#[test]
fn two_labs_do_not_meet() {
    let (Some(first), Some(second)) = (Lab::two_hosts_or_skip(), Lab::two_hosts_or_skip()) else {
        return;
    };
    output(first.host(0), "touch /dev/shm/h00000001_x");
    assert!(second.host(0).shared_memory_files().is_empty());
    // The same address is free in the other lab, so it is another network.
    let one = socket_on(first.host(0));
    let port = one.local_addr().unwrap().port();
    let host = second.host(0);
    host.on_network(|| UdpSocket::bind((host.address(), port)))
        .unwrap();
}

/// Namespace names and a process that run on after the test body, to be looked for afterwards.
fn leave_a_lab_behind(lab: &Lab) -> (Vec<String>, ChildGuard) {
    let mut sleeper =
        ChildGuard::spawn(&mut shell(lab.host(0), "echo up; exec sleep 1000")).unwrap();
    sleeper.wait_for_output("up", LONG).unwrap();
    (
        lab.hosts
            .iter()
            .map(|host| host.namespace().to_owned())
            .collect(),
        sleeper,
    )
}

fn assert_gone(names: &[String], sleeper: &mut ChildGuard) {
    for name in names {
        assert!(
            !Path::new("/run/netns").join(name).exists(),
            "{name} is still there"
        );
    }
    let finished = sleeper.wait_within(LONG).unwrap();
    assert!(
        !finished.status.success(),
        "the process inside was not killed"
    );
}

#[test]
fn dropping_a_lab_removes_it_with_the_processes_inside() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let (names, mut sleeper) = leave_a_lab_behind(&lab);
    assert!(Path::new("/run/netns").join(&names[0]).exists());
    drop(lab);
    assert_gone(&names, &mut sleeper);
}

#[test]
fn a_panic_removes_the_lab_too() {
    if require_privileges().is_err() {
        return;
    }
    let (sender, receiver) = mpsc::channel();
    let result = catch_unwind(move || {
        let lab = Lab::two_hosts().unwrap();
        sender.send(leave_a_lab_behind(&lab)).unwrap();
        panic!("planted");
    });
    assert!(result.is_err());
    let (names, mut sleeper) = receiver.recv().unwrap();
    assert_gone(&names, &mut sleeper);
}

#[test]
fn a_lab_whose_owner_died_is_swept() {
    if require_privileges().is_err() {
        return;
    }
    // No process has this identifier: it is above the kernel's largest.
    let stale = format!("hil-lab-4194305-1-{}-0", std::process::id());
    namespace::add(&stale).unwrap();
    let lab = Lab::two_hosts().unwrap();
    assert!(!Path::new("/run/netns").join(&stale).exists());
    assert!(
        Path::new("/run/netns")
            .join(lab.host(0).namespace())
            .exists()
    );
}

#[test]
fn a_work_that_panics_on_a_host_panics_in_the_test() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let lab = std::panic::AssertUnwindSafe(&lab);
    assert!(catch_unwind(|| lab.host(0).on_network(|| panic!("planted"))).is_err());
    assert_eq!(lab.host(0).on_network(|| 7), 7);
}
