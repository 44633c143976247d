//! The real binary asked for hardware stamps on a cable without a card: what is not there is said,
//! and nothing else of the run suffers. Cards that stamp need emulated PCs:
//! `tests/lab/hardware-stamps.sh`.

use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use hil_tests::account::{account, assert_accounts_close};
use hil_tests::binary::hil_runtime_binary;
use hil_tests::child::ChildGuard;
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::split::Split;
use hil_tests::trial::{Trial, wait_until_it_heeds_interrupts};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

const START_LIMIT: Duration = Duration::from_mins(1);
const RUN_LIMIT: Duration = Duration::from_mins(2);

#[test]
fn on_a_veth_the_missing_nic_is_said_and_software_stamps_carry_the_run() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("hardware-stamps");
    let trial = Trial::shipped("shuttle-split.toml", record.path())
        .set("run.duration=\"3 s\"")
        .set("links.hop.timestamps=\"hardware\"");
    let split = Split::start(&lab, &trial);
    let files = split.files[0].clone();
    let [summary, _] = split.finish();
    assert_accounts_close(&summary);

    let stamps = summary.hardware_stamps.as_ref().unwrap();
    let hosts: Vec<&str> = stamps
        .cards
        .iter()
        .map(|card| card.story.host.as_str())
        .collect();
    assert_eq!(hosts, ["control-pc", "robot-pc"]);
    for card in &stamps.cards {
        assert!(!card.story.is_armed, "{card:?}");
        assert!(card.story.arming.contains("veth"), "{card:?}");
        assert!(card.story.clock.contains("no clock of its own"), "{card:?}");
        assert_eq!(card.clock, None);
    }
    assert_eq!(stamps.channels.len(), 2);
    for channel in &stamps.channels {
        let counted = [channel.tx_hardware_count, channel.rx_hardware_count];
        assert_eq!(counted, [0, 0], "{channel:?}");
        assert!(channel.rx_reason.contains("not armed"), "{channel:?}");
        assert!(channel.sent_count > 0, "{channel:?}");
        let unavailable = channel
            .segments
            .iter()
            .all(|segment| segment.distribution.measured().is_none());
        assert!(unavailable, "{channel:?}");
        let software = account(&summary, &channel.channel).coverage.tx_software;
        assert_ne!(software.unwrap().stamped_count, 0, "{channel:?}");
    }
    assert!(files.read("report-full.txt").contains("Hardware stamps"));
}

/// The guard of a card, ready. Loopback has none: what it tries in the end is refused and said.
fn guard_of_loopback() -> Child {
    let mut guard = Command::new(hil_runtime_binary())
        .args(["card-guard", "--interface=lo", "--flags=0"])
        .args(["--transmit-type=0", "--receive-filter=12"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut word = String::new();
    let output = guard.stdout.take().unwrap();
    BufReader::new(output).read_line(&mut word).unwrap();
    assert_eq!(word, "ready\n");
    guard
}

fn ended(mut guard: Child) -> (Option<i32>, String) {
    let status = guard.wait().unwrap();
    let mut words = String::new();
    let errors = guard.stderr.as_mut().unwrap();
    errors.read_to_string(&mut words).unwrap();
    (status.code(), words)
}

#[test]
fn a_guard_outlives_signals_and_acts_when_its_program_is_gone() {
    let mut guard = guard_of_loopback();
    let id = Pid::from_raw(i32::try_from(guard.id()).unwrap());
    for signal in [
        Signal::SIGINT,
        Signal::SIGTERM,
        Signal::SIGHUP,
        Signal::SIGQUIT,
    ] {
        kill(id, signal).unwrap();
    }
    // What the kernel does when the program is killed.
    drop(guard.stdin.take());
    let (code, words) = ended(guard);
    assert_eq!(code, Some(1), "{words}");
    assert!(words.contains("card lo"), "{words}");
    assert!(words.contains("receive filter PTPv2 event"), "{words}");
    assert!(words.contains("NOT be put back"), "{words}");
}

#[test]
fn a_guard_that_is_let_go_leaves_the_nic_alone() {
    let mut guard = guard_of_loopback();
    guard.stdin.as_mut().unwrap().write_all(b"r").unwrap();
    assert_eq!(ended(guard), (Some(0), String::new()));
}

#[test]
fn an_interrupted_doctor_says_so_by_its_exit_code() {
    let mut command = Command::new(hil_runtime_binary());
    let mut doctor = ChildGuard::spawn(command.arg("doctor")).unwrap();
    wait_until_it_heeds_interrupts(&doctor, START_LIMIT);
    doctor.signal(Signal::SIGINT).unwrap();
    let finished = doctor.wait_within(RUN_LIMIT).unwrap();
    assert_eq!(finished.status.code(), Some(130), "{finished:?}");
    assert!(finished.stderr.contains("ended by Ctrl-C"), "{finished:?}");
    assert_eq!(finished.stdout, "");
}
