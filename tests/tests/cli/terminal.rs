//! A running run on a terminal: `channel` and `top` show what its records say, disturb nothing, and
//! end with it.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use hil_tests::binary::hil_runtime_binary;
use hil_tests::child::{ChildGuard, Finished};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{RunFiles, Trial, wait_until};
use nix::sys::signal::Signal;
use serde_json::Value;

const LIMIT: Duration = Duration::from_mins(1);
const COMMAND: &str = "egm/right/command";

fn start(arguments: &[&str]) -> ChildGuard {
    let mut command = Command::new(hil_runtime_binary());
    command.args(arguments).env("COLUMNS", "110");
    ChildGuard::spawn(&mut command).unwrap()
}

fn run(arguments: &[&str]) -> Finished {
    start(arguments).wait_within(LIMIT).unwrap()
}

/// The one JSON object that a command prints.
fn json(arguments: &[&str]) -> Value {
    let finished = run(arguments);
    finished.assert_success();
    assert_eq!(finished.stdout.trim().lines().count(), 1, "{finished:?}");
    serde_json::from_str(&finished.stdout).unwrap()
}

/// A run that lasts until it is asked to end, with messages under way.
fn running(trial: &Trial) -> (ChildGuard, RunFiles) {
    let child = trial.start_here();
    let files = trial.folder("", LIMIT);
    wait_until(LIMIT, "messages", || {
        files.record_bytes("egm.right.command.taken.robot.") > 4096
    });
    (child, files)
}

fn end((mut child, files): (ChildGuard, RunFiles)) {
    child.signal(Signal::SIGINT).unwrap();
    let finished = child.wait_within(LIMIT).unwrap();
    finished.assert_code(130);
    files.assert_nothing_left_here();
    for name in ["status.json", "live.json"] {
        assert!(!files.root().join(name).exists(), "{name} is left");
    }
    // An observer is no part of a run, so nobody complains of one.
    assert!(!finished.stderr.contains("still used"), "{finished:?}");
}

fn folder_of(files: &RunFiles) -> String {
    files.root().to_str().unwrap().to_owned()
}

#[test]
fn channels_of_a_running_run_are_listed_counted_shown_and_timed() {
    let record = RunFolder::new("terminal-channel");
    let trial = Trial::shipped("emulated.toml", record.path())
        .set("run.duration=\"10 min\"")
        .on_own_ports(&["hop"]);
    let going = running(&trial);
    let run_folder = folder_of(&going.1);
    let run_folder = run_folder.as_str();

    let list = json(&["channel", "list", run_folder, "--json"]);
    let channels = list["channels"].as_array().unwrap();
    let one = channels.iter().find(|one| one["name"] == COMMAND).unwrap();
    assert_eq!(one["message"], "hil.EgmCommand.v1");
    assert_eq!(
        (&one["via"], &one["from_host"]),
        (&"hop".into(), &"control-pc".into())
    );
    assert!(one["rate_hz"].as_f64().unwrap() > 1.0, "{one}");
    let ends = one["ends"].as_array().unwrap();
    assert_eq!(ends.len(), 2, "{one}");
    assert!(ends.iter().all(|end| end["writer_count"] == 1), "{one}");
    let table = run(&["channel", "list", run_folder, "--window", "100 ms"]);
    table.assert_success();
    assert!(table.stdout.contains("control-pc → robot-pc"), "{table:?}");

    let hz = json(&["channel", "hz", COMMAND, run_folder, "--once", "--json"]);
    assert_eq!(
        (&hz["seen_at"], &hz["missed_count"]),
        (&"publication".into(), &0.into())
    );
    assert!(hz["message_count"].as_u64().unwrap() > 1, "{hz}");
    assert!(hz["gap"]["mean_ns"].as_f64().unwrap() > 0.0, "{hz}");

    let delay = ["channel", "delay", COMMAND, run_folder, "--once", "--json"];
    let delay = json(&[&delay[..], &["--window", "2 s"]].concat());
    let account = &delay["account"];
    assert_eq!(account["clock"]["relation"], "one clock", "{delay}");
    // The link takes 50 ms.
    assert!(
        account["end_to_end"]["p50_ns"].as_i64().unwrap() > 50_000_000,
        "{delay}"
    );
    let segments = account["segments"].as_array().unwrap();
    let taken = segments
        .iter()
        .find(|one| one["from"] == "published")
        .unwrap();
    assert!(taken["p99_ns"].as_i64().is_some(), "{delay}");
    assert!(account["fates"]["taken"].as_u64().unwrap() > 0, "{delay}");
    let page = run(&["channel", "delay", COMMAND, run_folder, "--once"]);
    page.assert_success();
    assert!(page.stdout.contains("both ends read one clock"), "{page:?}");
    end(going);
}

/// Ctrl-C gives the totals so far.
fn gives_totals_when_interrupted(run_folder: &str) {
    let mut child = start(&["channel", "hz", COMMAND, run_folder, "--window", "100 ms"]);
    child.wait_for_output(" Hz", LIMIT).unwrap();
    child.signal(Signal::SIGINT).unwrap();
    let finished = child.wait_within(LIMIT).unwrap();
    finished.assert_code(130);
    assert!(finished.stdout.contains("in all"), "{finished:?}");
}

#[test]
fn messages_are_shown_by_their_fields_and_wrong_questions_say_what_there_is() {
    let record = RunFolder::new("terminal-echo");
    let trial = Trial::shipped("local.toml", record.path()).set("run.duration=\"10 min\"");
    let going = running(&trial);
    let run_folder = folder_of(&going.1);
    let run_folder = run_folder.as_str();
    let echo = |more: &[&str]| {
        run(&[&["channel", "echo", "egm/right/feedback", run_folder], more].concat())
    };

    let whole = echo(&["--once", "--json"]);
    whole.assert_success();
    let whole: Value = serde_json::from_str(&whole.stdout).unwrap();
    assert_eq!(whole["message"], "hil.EgmFeedback.v1");
    assert_eq!(whole["fields"]["measured_rad"].as_array().unwrap().len(), 7);
    assert_eq!(
        whole["fields"]["tool"]["quaternion_wxyz"]
            .as_array()
            .unwrap()
            .len(),
        4
    );
    let part = echo(&["--count", "3", "--field", "tool.position_m.0"]);
    part.assert_success();
    let numbers: Vec<f64> = part
        .stdout
        .lines()
        .map(|line| line.parse().unwrap())
        .collect();
    assert_eq!(numbers.len(), 3);
    let raw = echo(&["--raw", "--once"]);
    raw.assert_success();
    // Two digits for each of 216 bytes.
    assert_eq!(raw.stdout.lines().nth(1).unwrap().len(), 432, "{raw:?}");

    for (arguments, words) in [
        (
            vec![
                "channel",
                "echo",
                "egm/right/feedback",
                run_folder,
                "--field",
                "tool.speed",
            ],
            "it has position_m, quaternion_wxyz",
        ),
        (vec!["channel", "hz", "egm/command", run_folder], "it has "),
        (
            vec!["channel", "list", "no-such-run"],
            "no run \"no-such-run\"",
        ),
        (
            vec!["top", record.path().to_str().unwrap()],
            "does not go any more",
        ),
        (
            vec!["channel", "hz", COMMAND, run_folder, "--window", "1"],
            "no unit",
        ),
    ] {
        let refused = run(&arguments);
        refused.assert_code(2);
        assert!(refused.stderr.contains(words), "{words}: {refused:?}");
    }
    gives_totals_when_interrupted(run_folder);
    end(going);
}

/// A link that lets nothing through is silent and loses everything, also for who looks on only after
/// the last message came.
fn is_silent_when_cut(run_folder: &str) {
    run(&["link", "set", "hop", "--cut", run_folder]).assert_success();
    wait_until(LIMIT, "the silence", || {
        let view = json(&["top", run_folder, "--once", "--json"]);
        let link = &view["links"][0];
        let channels = view["channels"].as_array().unwrap();
        let channel = channels.iter().find(|one| one["name"] == COMMAND).unwrap();
        let is_lost = link["loss_ratio"] == 1.0 && channel["lost_count"].as_u64() > Some(0);
        link["state"] == "silent" && is_lost
    });
}

#[test]
fn top_shows_processes_channels_links_and_clocks_of_a_running_run() {
    let record = RunFolder::new("terminal-top");
    let trial = Trial::shipped("emulated.toml", record.path())
        .set("run.duration=\"10 min\"")
        .on_own_ports(&["hop"]);
    let going = running(&trial);
    let run_folder = folder_of(&going.1);
    let top = |more: &[&str]| run(&[&["top", &run_folder][..], more].concat());

    let page = top(&["--once"]);
    page.assert_success();
    for words in [
        "PROCESSES",
        "controller",
        "CHANNELS",
        COMMAND,
        "LINKS",
        "carries",
        "one clock",
    ] {
        assert!(page.stdout.contains(words), "no {words} in {}", page.stdout);
    }
    assert!(page.stdout.contains(" left\n"), "{}", page.stdout);
    // Standard output is no terminal here, so that a look is enough without --once, too.
    top(&[]).assert_success();
    let view = top(&["--once", "--json", "--window", "2 s"]);
    view.assert_success();
    let view: Value = serde_json::from_str(&view.stdout).unwrap();
    assert_eq!(view["run"]["state"], "running");
    assert_eq!(view["run"]["duration_s"], 600.0);
    let named = |list: &str, name: &str| {
        let mut all = view[list].as_array().unwrap().iter();
        all.find(|one| one["name"] == name).unwrap().clone()
    };
    let human = named("processes", "human");
    assert_eq!(
        (&human["state"], &human["restart_count"]),
        (&"running".into(), &0.into())
    );
    assert!(human["overrun_count"].as_u64().is_some(), "{human}");
    assert!(human["cpu_ratio"].as_f64().is_some(), "{human}");
    let channel = named("channels", COMMAND);
    assert!(
        channel["delay"]["p50_ns"].as_i64().unwrap() > 50_000_000,
        "{channel}"
    );
    // A tenth of the messages is lost; some of 250 are, and the account says so.
    let link = named("links", "hop");
    assert!(
        link["condition"].as_str().unwrap().contains("50 ms"),
        "{link}"
    );
    let loss_ratio = link["loss_ratio"].as_f64().unwrap();
    assert!(loss_ratio > 0.0 && loss_ratio < 0.5, "{link}");
    is_silent_when_cut(&run_folder);
    end(going);
}

#[test]
fn a_restarted_process_is_seen_to_be_one() {
    let record = RunFolder::new("terminal-restart");
    let trial = Trial::shipped("local.toml", record.path())
        .set("run.duration=\"10 min\"")
        .set("processes.human.on_exit=\"restart\"");
    let going = running(&trial);
    going.1.kill_process("human", 0, LIMIT);
    let run_folder = folder_of(&going.1);
    wait_until(LIMIT, "the restart", || {
        let view = json(&["top", &run_folder, "--once", "--json", "--window", "100 ms"]);
        let processes = view["processes"].as_array().unwrap().clone();
        let human = processes.iter().find(|one| one["name"] == "human").unwrap();
        human["restart_count"] == 1 && human["state"] == "running"
    });
    end(going);
    assert!(Path::new(&run_folder).join("summary.json").exists());
}
