//! What a run inherits from the program that started it, and what happens to its own file while it goes:
//! neither changes how it goes or ends.

use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;
use std::{env, fs};

use hil_report::summary::Outcome;
use hil_tests::account::assert_every_message_is_accounted_for;
use hil_tests::binary::hil_runtime_binary;
use hil_tests::child::ChildGuard;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{RunFiles, Trial, shipped_topology, wait_until};
use nix::sys::signal::Signal;

const LIMIT: Duration = Duration::from_mins(1);

/// Starts `trial` as `env` with `option` starts a program.
fn start_with(option: &str, trial: &Trial) -> ChildGuard {
    let mut command = Command::new("env");
    command.arg(option).arg(hil_runtime_binary());
    command.args(trial.arguments());
    ChildGuard::spawn(&mut command).unwrap()
}

fn wait_for_messages(files: &RunFiles) {
    wait_until(LIMIT, "messages", || {
        files.record_bytes("egm.right.command.taken.robot.") > 2048
    });
}

#[test]
fn the_end_of_a_process_is_seen_though_the_parent_ignored_such_news() {
    let record = RunFolder::new("no-sigchld");
    let trial = Trial::shipped("local.toml", record.path()).set("run.duration=\"8 s\"");
    let mut child = start_with("--ignore-signal=CHLD", &trial);
    let files = trial.folder("", LIMIT);
    wait_for_messages(&files);
    files.kill_process("robot", 0, LIMIT);
    let finished = child.wait_within(LIMIT).unwrap();
    let summary = files.summary();
    println!("{:?}: {}", summary.run.outcome, summary.run.exit_reason);
    assert_eq!(finished.status.code(), Some(1), "{finished:?}");
    assert_eq!(summary.run.outcome, Outcome::Failed);
    let words = "process robot was killed by SIGKILL";
    assert!(summary.run.exit_reason.contains(words));
    assert_every_message_is_accounted_for(&summary);
    files.assert_nothing_left_here();
}

#[test]
fn a_run_started_by_nohup_outlives_its_terminal_and_ends_by_sigterm() {
    let record = RunFolder::new("nohup");
    let trial = Trial::shipped("local.toml", record.path()).set("run.duration=\"10 min\"");
    let mut child = start_with("--ignore-signal=HUP", &trial);
    let files = trial.folder("", LIMIT);
    wait_for_messages(&files);
    child.signal(Signal::SIGHUP).unwrap();
    let bytes = files.record_bytes("egm.right.command.taken.robot.");
    wait_until(LIMIT, "more messages", || {
        files.record_bytes("egm.right.command.taken.robot.") > 2 * bytes
    });
    child.signal(Signal::SIGTERM).unwrap();
    let finished = child.wait_within(LIMIT).unwrap();
    assert_eq!(finished.status.code(), Some(130), "{finished:?}");
    assert_eq!(files.summary().run.exit_reason, "interrupted by SIGTERM");
}

#[test]
fn signals_that_the_parent_blocked_still_end_a_run() {
    let record = RunFolder::new("blocked");
    let trial = Trial::shipped("local.toml", record.path()).set("run.duration=\"10 min\"");
    let mut child = start_with("--block-signal=INT,TERM", &trial);
    let files = trial.folder("", LIMIT);
    wait_for_messages(&files);
    child.signal(Signal::SIGTERM).unwrap();
    let finished = child.wait_within(LIMIT).unwrap();
    assert_eq!(finished.status.code(), Some(130), "{finished:?}");
    files.assert_nothing_left_here();
}

fn write_program(path: &Path, script: &str) {
    fs::write(path, script).unwrap();
    fs::set_permissions(path, fs::Permissions::from_mode(0o755)).unwrap();
}

/// All that is in `folder`, and itself.
fn written(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path());
    let inner = entries.flat_map(|path| {
        if path.is_dir() {
            written(&path)
        } else {
            vec![path]
        }
    });
    inner.chain([folder.to_owned()]).collect()
}

/// The clock's daemon is asked at the end of a run, whose shared memory is there then, and by a program that
/// is not ours.
#[test]
fn no_program_that_a_run_starts_gets_its_shared_memory_or_what_its_parent_had_open() {
    let record = RunFolder::new("descriptors");
    let tools = record.path().join("tools");
    fs::create_dir_all(&tools).unwrap();
    let seen = tools.join("seen");
    let list = format!("ls -l /proc/self/fd >> {}", seen.display());
    write_program(&tools.join("chronyc"), &format!("#!/bin/sh\n{list}\n"));
    // The kernel calls a process by its file: one of this name has to be there to be asked.
    fs::copy("/bin/sleep", tools.join("chronyd")).unwrap();
    let daemon = ChildGuard::spawn(Command::new(tools.join("chronyd")).arg("600")).unwrap();
    let own = format!("{list}; sleep 600");
    let trial = Trial::shipped("shuttle-local.toml", &record.join("runs"))
        .set("run.duration=\"1 s\"")
        .set(&format!("processes.robot.run=[\"sh\", \"-c\", \"{own}\"]"));
    let left_open = record.write("left-open", "");
    // A shell that has a file open, and no mask for new ones, when it starts the run.
    let mut command = Command::new("sh");
    let script = format!("umask 0; exec 7<{}; exec \"$@\"", left_open.display());
    command.args(["-c", &script, "sh"]);
    command.arg(hil_runtime_binary()).args(trial.arguments());
    let path = env::var("PATH").unwrap();
    command.env("PATH", format!("{}:{path}", tools.display()));
    let finished = ChildGuard::spawn(&mut command)
        .unwrap()
        .wait_within(LIMIT)
        .unwrap();
    finished.assert_success();
    drop(daemon);
    for entry in written(trial.folder("", LIMIT).root()) {
        let mode = fs::symlink_metadata(&entry).unwrap().permissions().mode();
        assert_eq!(mode & 0o002, 0, "{}: {mode:o}", entry.display());
    }
    let seen = fs::read_to_string(&seen).unwrap();
    // Before the run, at its end, and the user's own program.
    assert_eq!(seen.matches("total 0").count(), 3, "{seen}");
    for word in ["/dev/shm", "left-open", ".service", "node_monitor"] {
        let count = seen.matches(word).count();
        println!("{word}: {count} descriptors in the hands of others");
        assert_eq!(count, 0, "{seen}");
    }
}

/// The file of the program is replaced, or removed, as an upgrade does it, and that of the topology is written
/// over: the processes of a run that goes on are of one build and one topology.
#[test]
fn a_process_that_is_started_again_is_of_the_build_that_runs() {
    for becomes in [Some("#!/bin/sh\nexit 42\n"), None] {
        let record = RunFolder::new("upgraded");
        let program = record.path().join("installed");
        fs::create_dir_all(record.path()).unwrap();
        fs::copy(hil_runtime_binary(), &program).unwrap();
        let topology = record.path().join("topology.toml");
        fs::copy(shipped_topology("local.toml"), &topology).unwrap();
        let trial = Trial::of(&topology, &record.path().join("runs"))
            .set("run.duration=\"10 min\"")
            .set("processes.controller.on_exit=\"restart\"");
        let mut command = Command::new(&program);
        let mut child = ChildGuard::spawn(command.args(trial.arguments())).unwrap();
        let files = trial.folder("", LIMIT);
        wait_for_messages(&files);
        fs::remove_file(&program).unwrap();
        fs::write(&topology, "of another version").unwrap();
        if let Some(script) = becomes {
            write_program(&program, script);
        }
        files.kill_process("controller", 0, LIMIT);
        wait_until(LIMIT, "messages of the second controller", || {
            !child.is_running()
                || files.record_bytes("egm.right.command.published.controller.1") > 2048
        });
        child.signal(Signal::SIGTERM).unwrap();
        let finished = child.wait_within(LIMIT).unwrap();
        let summary = files.summary();
        println!("{:?}: {}", summary.run.outcome, summary.run.exit_reason);
        assert_eq!(finished.status.code(), Some(130), "{finished:?}");
        let mut processes = summary.processes.iter();
        let controller = processes.find(|one| one.name == "controller").unwrap();
        assert_eq!(controller.restart_count, 1);
        files.assert_nothing_left_here();
    }
}
