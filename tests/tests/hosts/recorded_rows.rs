//! Rows of a case's tables made of runs on this PC, as any user: ended, killed and gone on with.

use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use hil_tests::binary::hil_runtime_binary;
use hil_tests::child::{ChildGuard, Finished};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{processes_mentioning, shipped_topology, wait_until};
use nix::sys::signal::Signal;
use serde_json::Value;

const LIMIT: Duration = Duration::from_mins(2);
/// Nobody on this machine has it.
const USER: &str = "45679";
/// A busy machine may refuse as many runs in a row as end a call.
const CALLS_MAX: usize = 4;

/// The tables, of one condition that takes no time.
const TABLES: &str = "case.parameters.tables.conditions=[\"perfect\"]";
const LOOPS: &str = "case.parameters.tables.loops=20";
/// A loop every second, so that a short run has some.
const PERIOD: &str = "case.parameters.motion_period_s=1.0";

/// An emulated link of a row, and a real one whose wire a probe sees.
const EMULATED: &str =
    "network = \"short\"\nset = [\"links.hop.via=emulated\", \"links.hop.delay=1 ms\", ";
const PROBED: &str = "network = \"ethernet\"\nprobe = true\nset = [";

/// A folder that the user may write to, with a recording of a few motion loops over `link` in it.
fn recording(link: &str) -> RunFolder {
    let folder = RunFolder::new("recorded-rows");
    fs::set_permissions(folder.path(), Permissions::from_mode(0o777)).unwrap();
    let [split, tables] = ["split.toml", "teleop-tables.toml"]
        .map(|name| shipped_topology(name).display().to_string());
    let text = format!(
        "folder = \"runs\"\ntables = \"{tables}\"\nset = ['{TABLES}', '{LOOPS}', '{PERIOD}']\n[rows.short]\n\
         topology = \"{split}\"\nenough = 5\nseed = 3\n{link}\"run.duration=5 s\", '{PERIOD}']\n"
    );
    folder.write("rows.toml", &text);
    folder
}

/// Tables by a user without rights, with these arguments.
fn tables(folder: &RunFolder, arguments: &[&str]) -> ChildGuard {
    let mut command = Command::new("env");
    if nix::unistd::geteuid().is_root() {
        command = Command::new("setpriv");
        command.args(["--reuid", USER, "--regid", USER, "--clear-groups"]);
        command.args(["--inh-caps=-all", "--bounding-set=-all"]);
    }
    command
        .arg(hil_runtime_binary())
        .arg("tables")
        .args(arguments);
    command.arg("--json").current_dir(folder.path());
    command.env_remove("XDG_RUNTIME_DIR").env_remove("HIL_HOST");
    ChildGuard::spawn(&mut command).unwrap()
}

fn record(folder: &RunFolder) -> ChildGuard {
    tables(folder, &["--record", "rows.toml"])
}

/// The first of a few calls that ends well. `None` where this host kept up with none of their runs, as one whose processors
/// are taken away for milliseconds every second: then nothing can be said of a row.
fn recorded(folder: &RunFolder) -> Option<Finished> {
    let calls = (0..CALLS_MAX).map(|_| record(folder).wait_within(LIMIT).unwrap());
    for call in calls {
        if call.status.success() {
            return Some(call);
        }
        assert_refused_for_its_host(&call);
    }
    println!("this host keeps up with no run of 5 s: what becomes of a row is not tested");
    None
}

/// Every run was refused, and because of the host.
fn assert_refused_for_its_host(call: &Finished) {
    call.assert_code(1);
    let refused = |line: &&str| line.starts_with("runs/short/refused-");
    let refused: Vec<&str> = call.stderr.lines().filter(refused).collect();
    assert!(!refused.is_empty(), "{}", call.stderr);
    let causes = [
        "the host overran",
        "the host could not keep the emulated link",
        "ticks were skipped",
    ];
    for line in refused {
        let is_its_host = causes.iter().any(|cause| line.contains(cause));
        assert!(is_its_host, "{line}");
    }
}

/// A run that goes on.
fn is_under_way(row: &Path) -> bool {
    let hosts = fs::read_dir(row.join("under-way"))
        .into_iter()
        .flatten()
        .flatten();
    hosts
        .into_iter()
        .any(|host| host.path().join("live.json").is_file())
}

fn sound_runs(row: &Path) -> Vec<String> {
    let entries = fs::read_dir(row).into_iter().flatten().flatten();
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
    let mut names: Vec<_> = names.filter(|name| name.starts_with("run-")).collect();
    names.sort();
    names
}

fn tables_of(finished: &Finished) -> Value {
    let report: Value = serde_json::from_str(&finished.stdout).unwrap();
    report["report"]["tables"].clone()
}

#[test]
fn rows_that_were_ended_and_killed_become_those_of_their_runs() {
    let folder = recording(EMULATED);
    let row = folder.join("runs/short");
    let mut call = record(&folder);
    wait_until(LIMIT, "a run under way", || is_under_way(&row));
    call.signal(Signal::SIGINT).unwrap();
    let ended = call.wait_within(LIMIT).unwrap();
    ended.assert_code(130);
    assert!(tables_of(&ended).is_array(), "{}", ended.stdout);
    assert!(!row.join("under-way").exists());
    // Killed within a run, with one before it.
    let (mut call, mut calls_left) = (record(&folder), CALLS_MAX);
    wait_until(2 * LIMIT, "a run behind a kept one", || {
        if !call.is_running() {
            assert_refused_for_its_host(&call.wait_within(LIMIT).unwrap());
            if calls_left == 0 {
                return true;
            }
            (call, calls_left) = (record(&folder), calls_left - 1);
        }
        !sound_runs(&row).is_empty() && is_under_way(&row)
    });
    if !call.is_running() {
        println!("this host keeps up with no run of 5 s: what becomes of a row is not tested");
        return;
    }
    let kept = sound_runs(&row).remove(0);
    let summary = || fs::read(row.join(&kept).join("summary.json")).unwrap();
    let before = summary();
    call.signal(Signal::SIGKILL).unwrap();
    call.wait_within(LIMIT).unwrap();
    assert!(row.join("under-way").exists());
    // At once: what the killed call left goes on to its own end.
    let Some(resumed) = recorded(&folder) else {
        return;
    };
    assert_eq!(summary(), before);
    assert!(!row.join("under-way").exists());
    assert!(sound_runs(&row).len() > 1);
    let counted = &tables_of(&resumed)[0]["rows"][1][6]["count"];
    assert!(
        counted.as_u64().is_some_and(|count| count >= 5),
        "{counted}"
    );
    // Each run was replayed four times, with as many loops or one more or less.
    let replay = &tables_of(&resumed)[0]["rows"][2];
    let words = replay[0]["text"].as_str().unwrap_or_default();
    assert_eq!(
        words, "Replay, short-range Wi-Fi 6, emulated link",
        "{replay}"
    );
    let replayed = replay[6]["count"].as_u64().unwrap();
    let wanted = 4 * counted.as_u64().unwrap();
    let runs = sound_runs(&row).len() as u64;
    assert!(
        replayed.abs_diff(wanted) <= 4 * runs,
        "{replayed} for {wanted}"
    );
    // Nothing is missing, so that it only prints.
    let names = sound_runs(&row);
    let again = record(&folder).wait_within(LIMIT).unwrap();
    again.assert_success();
    assert_eq!(
        (tables_of(&again), sound_runs(&row)),
        (tables_of(&resumed), names)
    );
    let teleop = shipped_topology("teleop-tables.toml").display().to_string();
    let settings = ["--set", TABLES, "--set", LOOPS, "--set", PERIOD];
    let mut arguments = vec!["--topology", &teleop, "--run", "short=runs/short/run-*"];
    arguments.extend(settings);
    let by_hand = tables(&folder, &arguments).wait_within(LIMIT).unwrap();
    by_hand.assert_success();
    assert_eq!(tables_of(&by_hand), tables_of(&resumed));
    // Another link is no repetition.
    let text = fs::read_to_string(folder.join("rows.toml")).unwrap();
    folder.write("rows.toml", &text.replace("delay=1 ms", "delay=2 ms"));
    let changed = record(&folder).wait_within(LIMIT).unwrap();
    changed.assert_code(2);
    let expected = "links.hop.forward.delay was 1 ms, is 2 ms";
    assert!(changed.stderr.contains(expected), "{}", changed.stderr);
    wait_until(LIMIT, "the end of all processes", || {
        processes_mentioning(&folder.path().to_string_lossy()).is_empty()
    });
}

#[test]
fn a_probed_row_has_loss_and_delay_of_the_wire_beside_those_of_the_account() {
    let folder = recording(PROBED);
    let row = folder.join("runs/short");
    let Some(recorded) = recorded(&folder) else {
        return;
    };
    let notes = tables_of(&recorded)[0]["notes"].to_string();
    let probe = "by the passive probe: PLR 0.0000, delay p50 0.";
    assert!(notes.contains(probe), "{notes}");
    for run in sound_runs(&row) {
        let entries = fs::read_dir(row.join(run)).unwrap().flatten();
        let mut names: Vec<_> = entries.map(|entry| entry.file_name()).collect();
        names.sort();
        let kept = [
            "manifest.json",
            "probe.json",
            "replays",
            "report.txt",
            "summary.json",
        ];
        assert_eq!(names, kept);
    }
    assert!(!row.join("under-way").exists());
    // What an emulated link does, it does before the wire.
    let text = fs::read_to_string(folder.join("rows.toml")).unwrap();
    let emulated = "set = [\"links.hop.via=emulated\", \"links.hop.delay=1 ms\", \"run";
    folder.write("rows.toml", &text.replace("set = [\"run", emulated));
    let refused = record(&folder).wait_within(LIMIT).unwrap();
    refused.assert_code(2);
    let expected = "rows.short: probe = true, and a link is emulated";
    assert!(refused.stderr.contains(expected), "{}", refused.stderr);
}
