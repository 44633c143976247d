//! Both hosts of a topology on this PC by one command, as any user.

use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt as _;
use std::process::Command;
use std::time::Duration;

use hil_tests::account::assert_every_message_is_accounted_for;
use hil_tests::binary::{hil_runtime_binary, workspace_folder};
use hil_tests::child::ChildGuard;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{RunFiles, Trial, processes_mentioning, wait_until};
use nix::sys::signal::Signal;

const LIMIT: Duration = Duration::from_mins(1);
const HOSTS: [&str; 2] = ["control-pc", "robot-pc"];
/// Nobody on this machine has it.
const USER: &str = "45679";

/// A folder that the user may write to.
fn open_folder(label: &str) -> RunFolder {
    let record = RunFolder::new(label);
    fs::set_permissions(record.path(), Permissions::from_mode(0o777)).unwrap();
    record
}

/// Starts a run of both hosts by a user without rights. The key that the topology names is of the test's user.
fn start(record: &RunFolder, settings: &[&str]) -> (Trial, ChildGuard) {
    start_with(record, settings, &[])
}

fn start_with(record: &RunFolder, settings: &[&str], more: &[&str]) -> (Trial, ChildGuard) {
    let trial = Trial::shipped("shuttle-split.toml", record.path());
    let trial = settings.iter().fold(trial, |trial, one| trial.set(one));
    let mut command = Command::new("env");
    if nix::unistd::geteuid().is_root() {
        command = Command::new("setpriv");
        command.args(["--reuid", USER, "--regid", USER, "--clear-groups"]);
        command.args(["--inh-caps=-all", "--bounding-set=-all"]);
    }
    command.arg(hil_runtime_binary()).args(trial.arguments());
    command.arg("--on-one-pc").args(more);
    command.env_remove("XDG_RUNTIME_DIR");
    (trial, ChildGuard::spawn(&mut command).unwrap())
}

fn folders(trial: &Trial) -> [RunFiles; 2] {
    HOSTS.map(|host| trial.folder(host, LIMIT))
}

fn assert_nobody_left(record: &RunFolder) {
    wait_until(LIMIT, "the end of all processes", || {
        processes_mentioning(&record.path().to_string_lossy()).is_empty()
    });
}

#[test]
fn the_first_command_of_the_readme_ends_in_the_answer_of_a_comparison() {
    let record = open_folder("try");
    let release = record.path().join("release");
    fs::create_dir(&release).unwrap();
    std::os::unix::fs::symlink(hil_runtime_binary(), release.join("hil-runtime")).unwrap();
    let mut command = Command::new(workspace_folder().join("deploy/try.sh"));
    // What it would build is there.
    command
        .env("CARGO", "true")
        .env("CARGO_TARGET_DIR", record.path());
    command.arg("4").current_dir(record.path());
    // Each of two runs may be repeated twice.
    let finished = ChildGuard::spawn(&mut command)
        .unwrap()
        .wait_within(4 * LIMIT);
    let finished = finished.unwrap();
    finished.assert_success();
    let answer = "Was the robot hurt more in the new runs?";
    assert!(finished.stdout.contains(answer), "{}", finished.stdout);
    let open = "which of these made the difference";
    assert!(!finished.stdout.contains(open), "{}", finished.stdout);
    assert!(
        finished.stdout.contains("sessions of the right arm lost"),
        "{}",
        finished.stdout
    );
    assert_nobody_left(&record);
}

#[test]
fn a_user_without_rights_runs_both_hosts_over_a_hop_with_kernel_stamps() {
    let record = open_folder("one-pc");
    let (trial, mut child) = start(&record, &["run.duration='3 s'"]);
    let finished = child.wait_within(LIMIT).unwrap();
    finished.assert_success();
    assert!(
        finished.stdout.contains("Did the network hurt"),
        "{}",
        finished.stdout
    );
    for files in folders(&trial) {
        let summary = files.summary();
        assert_every_message_is_accounted_for(&summary);
        let full = files.read("report-full.txt");
        assert!(full.contains("TX stamp → RX stamp"), "{full}");
        assert!(full.contains("--on-one-pc"), "{full}");
        assert!(
            full.contains("sealed (AES-256-GCM)") || full.contains("sealed (ChaCha20"),
            "{full}"
        );
    }
    assert_nobody_left(&record);
}

#[test]
fn a_probe_at_both_hosts_counts_what_the_gateways_do_and_replaces_no_capture() {
    let record = open_folder("one-pc-probe");
    let captures = record.join("captures");
    let probe = ["--probe", captures.to_str().unwrap()];
    let (trial, mut child) = start_with(&record, &["run.duration='2 s'"], &probe);
    child.wait_within(LIMIT).unwrap().assert_success();
    let [files, _] = folders(&trial);
    let mut compare = Command::new(hil_runtime_binary());
    // How near the medians lie is for a quiet machine.
    compare.args(["probe", "compare", "--keep", "--limit", "100000"]);
    compare.arg(files.root());
    compare.args(HOSTS.map(|host| captures.join(format!("{host}.pcapng"))));
    let compared = ChildGuard::spawn(&mut compare).unwrap().wait_within(LIMIT);
    compared.unwrap().assert_success();
    let kept: serde_json::Value = serde_json::from_str(&files.read("probe.json")).unwrap();
    let crossing = &kept["crossing"];
    assert!(crossing["offered_count"].as_u64() > Some(100), "{kept}");
    assert_eq!(crossing["lost_count"]["Ok"], 0, "{kept}");
    let bins = crossing["delays"]["Ok"].as_array();
    assert!(bins.is_some_and(|bins| !bins.is_empty()), "{kept}");
    let (_, mut again) = start_with(&record, &["run.duration='2 s'"], &probe);
    let refused = again.wait_within(LIMIT).unwrap();
    refused.assert_code(2);
    let expected = "exists; give --probe another folder";
    assert!(refused.stderr.contains(expected), "{}", refused.stderr);
    let mut alone = trial.command_here();
    let alone = ChildGuard::spawn(alone.args(probe))
        .unwrap()
        .wait_within(LIMIT);
    let alone = alone.unwrap();
    alone.assert_code(2);
    assert!(
        alone.stderr.contains("--probe is for --on-one-pc"),
        "{}",
        alone.stderr
    );
    assert_nobody_left(&record);
}

#[test]
fn a_probe_that_cannot_capture_ends_the_run_before_it_begins() {
    let record = open_folder("one-pc-closed");
    let closed = record.join("closed");
    fs::create_dir(&closed).unwrap();
    fs::set_permissions(&closed, Permissions::from_mode(0o555)).unwrap();
    let probe = ["--probe", closed.to_str().unwrap()];
    let (_, mut child) = start_with(&record, &["run.duration='2 s'"], &probe);
    let refused = child.wait_within(LIMIT).unwrap();
    refused.assert_code(2);
    for expected in [
        "Permission denied",
        "does not capture, so that nothing is run",
    ] {
        assert!(refused.stderr.contains(expected), "{}", refused.stderr);
    }
    let entries = fs::read_dir(record.path()).unwrap();
    let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    // The key of the hop is the test's.
    let runs: Vec<_> = names
        .filter(|name| name != "closed" && !name.starts_with('.'))
        .collect();
    assert_eq!(runs, Vec::<String>::new());
    assert_nobody_left(&record);
}

#[test]
fn a_stop_of_the_one_command_ends_both_hosts_with_their_reports() {
    for (signal, words) in [
        (Signal::SIGINT, Some("Ctrl-C")),
        (Signal::SIGTERM, Some("SIGTERM")),
        (Signal::SIGKILL, None),
    ] {
        let record = open_folder("one-pc-stop");
        let (trial, mut child) = start(&record, &["run.duration='10 min'"]);
        let folders = folders(&trial);
        wait_until(LIMIT, "records of both", || {
            folders.iter().all(|one| one.record_bytes("shuttle.") > 0)
        });
        child.signal(signal).unwrap();
        let finished = child.wait_within(LIMIT).unwrap();
        if words.is_some() {
            finished.assert_code(130);
        }
        assert_nobody_left(&record);
        for files in folders {
            assert!(files.has_report(), "{signal}: {}", files.root().display());
            let report = files.read("report.txt");
            assert!(report.contains(words.unwrap_or_default()), "{report}");
        }
    }
}

#[test]
fn a_host_that_cannot_begin_is_named_and_the_other_does_not_wait_for_it() {
    let record = open_folder("one-pc-refused");
    let missing = "processes.robot.run=['/none']";
    let (_trial, mut child) = start(&record, &[missing, "run.start_timeout='1 h'"]);
    let finished = child.wait_within(LIMIT).unwrap();
    finished.assert_code(2);
    assert!(
        finished.stderr.contains("robot-pc: "),
        "{}",
        finished.stderr
    );
    assert!(finished.stderr.contains("/none"), "{}", finished.stderr);
    assert_nobody_left(&record);
}
