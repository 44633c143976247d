//! The command line as a person uses it: checks, mistakes, Ctrl-C, and what commands do. Their help is in
//! `help.rs`.

use std::process::{Command, Stdio};
use std::time::Duration;
use std::{fs, io};

use hil_report::summary::{Outcome, RunEventKind, RunSummary};
use hil_rundir::event::EventKind;
use hil_teleoperation::bvh::Bvh;
use hil_tests::account::{account, assert_accounts_close, assert_every_message_is_accounted_for};
use hil_tests::binary::{
    hil_runtime as run, hil_runtime_binary, hil_runtime_in as run_in, workspace_folder,
};
use hil_tests::child::{ChildGuard, Finished};
use hil_tests::ports::own_ports;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{RunFiles, Trial, processes_mentioning, shipped_topology, wait_until};
use nix::sys::signal::Signal;
use serde_json::Value;

const LIMIT: Duration = Duration::from_mins(1);

/// Checks that standard error says all of `words`.
fn assert_says(finished: &Finished, words: &[&str]) {
    for word in words {
        assert!(
            finished.stderr.contains(word),
            "no `{word}` in {finished:?}"
        );
    }
}

/// A file's name and its contents with what would set the terminal's title, clear it and turn a line around.
#[test]
fn what_others_wrote_never_steers_the_terminal() {
    let folder = RunFolder::new("escapes");
    fs::create_dir_all(folder.path()).unwrap();
    let name = "a\u{1b}]0;title\u{7}.toml";
    let absent = run_in(folder.path(), &["--topology", name]);
    let text = "[run]\nname = \"x\u{202e}\"\n# \u{9b}2J\nno = 1\n";
    fs::write(folder.join("b.toml"), text).unwrap();
    let faulty = run_in(folder.path(), &["--topology", "b.toml", "--check"]);
    for finished in [&absent, &faulty] {
        assert!(!finished.status.success(), "{finished:?}");
        let shown = format!("{}{}", finished.stdout, finished.stderr);
        let steers = |c: char| (c.is_control() && c != '\n') || c == '\u{202e}';
        assert!(!shown.contains(steers), "{shown:?}");
    }
}

#[test]
fn every_shipped_topology_is_fit_and_so_are_the_commands_it_tells_of() {
    let folder = workspace_folder().join("deploy/topologies");
    let (mut topology_count, mut command_count) = (0, 0);
    for entry in fs::read_dir(&folder).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|extension| extension != "toml") {
            continue;
        }
        let name = path.file_name().unwrap().to_str().unwrap();
        let text = fs::read_to_string(&path).unwrap();
        topology_count += 1;
        let checked = run_in(&folder, &["--topology", name, "--check"]);
        checked.assert_code(0);
        assert!(checked.stdout.contains("the file is valid"), "{checked:?}");
        let told = text.lines().filter_map(|line| {
            let (comment, command) = line.split_once("hil-runtime ")?;
            // What is told with sudo makes a file outside the test's folder: the key of a hop.
            let is_of_study = command.starts_with("tables ") || command.starts_with("calibrate ");
            let is_tried = comment.starts_with('#') && !comment.ends_with("sudo ") && !is_of_study;
            is_tried.then_some(command)
        });
        for command in told {
            command_count += 1;
            let mut arguments: Vec<&str> = command.split_whitespace().collect();
            // Virtual time is over in a moment; a real run is only checked.
            arguments.extend((arguments[0] != "simulate").then_some("--check"));
            run_in(&folder, &arguments).assert_code(0);
        }
    }
    assert!(topology_count >= 5 && command_count >= 3);
}

#[test]
fn a_file_that_is_not_there_is_named() {
    let finished = run(&["--topology", "no-such-file.toml"]);
    finished.assert_code(2);
    assert_says(&finished, &["no-such-file.toml", "No such file"]);
}

#[test]
fn a_misspelt_key_is_shown_in_its_file_with_what_was_meant() {
    let folder = RunFolder::new("misspelt");
    let text = fs::read_to_string(shipped_topology("local.toml")).unwrap();
    assert!(text.contains("\nduration ="));
    let wrong = text.replace("\nduration =", "\nduratoin =");
    let path = folder.write("wrong.toml", &wrong);
    let path = path.to_str().unwrap();
    for arguments in [&["--topology", path][..], &["--topology", path, "--check"]] {
        let finished = run(arguments);
        finished.assert_code(2);
        let mut lines = wrong.lines();
        let line = 1 + lines.position(|line| line.starts_with("duratoin")).unwrap();
        let place = format!("wrong.toml:{line}");
        let hint = "did you mean `duration`";
        assert_says(&finished, &["run.duratoin", &place, hint, "start_timeout"]);
    }
    let finished = run(&["--topology", path, "--chekc"]);
    finished.assert_code(2);
    assert_says(&finished, &["--check"]);
}

/// A split run whose two hosts are on this machine.
fn split_here(record: &RunFolder) -> Trial {
    let port = own_ports();
    Trial::shipped("split.toml", record.path())
        .set("hosts.control-pc.address=\"127.0.0.1\"")
        .set("hosts.robot-pc.address=\"127.0.0.2\"")
        .set(&format!("hosts.control-pc.control_port={port}"))
        .on_own_ports(&["hop"])
}

fn start_as(trial: &Trial, host: &str) -> ChildGuard {
    let mut command = trial.command_here();
    command.arg("--host").arg(host);
    ChildGuard::spawn(&mut command).unwrap()
}

/// A split run whose other host nobody starts.
fn lonely(record: &RunFolder, host: &str) -> ChildGuard {
    let trial = split_here(record).set("run.start_timeout=\"2 s\"");
    start_as(&trial, host)
}

#[test]
fn hosts_with_different_topologies_refuse_each_other() {
    let record = RunFolder::new("different");
    let trial = split_here(&record);
    let mut hosts = [
        start_as(&trial, "control-pc"),
        start_as(&trial.clone().set("run.seed=2"), "robot-pc"),
    ];
    for host in &mut hosts {
        let finished = host.wait_within(LIMIT).unwrap();
        finished.assert_code(2);
        assert_says(&finished, &["does not fit this run", "use the same file"]);
    }
}

#[test]
fn a_host_whose_address_is_elsewhere_says_so() {
    let record = RunFolder::new("elsewhere");
    // A block reserved for documentation (RFC 5737): nobody's address.
    let trial = split_here(&record)
        .set("hosts.control-pc.address=\"203.0.113.1\"")
        .set("hosts.robot-pc.address=\"203.0.113.2\"");
    for (host, address) in [("control-pc", "203.0.113.1"), ("robot-pc", "203.0.113.2")] {
        let finished = start_as(&trial, host).wait_within(LIMIT).unwrap();
        finished.assert_code(75);
        let key = format!("hosts.{host}.address cannot be used");
        let words = format!("no interface has {address}");
        assert_says(&finished, &[&key, &words, "--set"]);
    }
}

#[test]
fn a_host_that_never_comes_is_named_with_where_it_was_awaited() {
    for (host, missing) in [("control-pc", "robot-pc"), ("robot-pc", "control-pc")] {
        let record = RunFolder::new("lonely");
        let mut child = lonely(&record, host);
        child
            .wait_for_output(&format!("waiting for {missing}"), LIMIT)
            .unwrap();
        let finished = child.wait_within(LIMIT).unwrap();
        finished.assert_code(69);
        let complaint = format!("{missing} did not appear within 2 s");
        assert_says(&finished, &[&complaint, "TCP 127.0.0.1:"]);
    }
}

#[test]
fn waiting_for_a_host_can_be_interrupted() {
    let record = RunFolder::new("lonely");
    let mut child = lonely(&record, "control-pc");
    child
        .wait_for_output("waiting for robot-pc", LIMIT)
        .unwrap();
    child.signal(Signal::SIGINT).unwrap();
    let finished = child.wait_within(LIMIT).unwrap();
    finished.assert_code(130);
    assert_says(&finished, &["interrupted"]);
}

/// Waits until the robot of a local run has taken some commands.
fn wait_for_messages(files: &RunFiles, name: &str) {
    wait_until(LIMIT, &format!("messages of {name}"), || {
        files.record_bytes(&format!("{name}.taken.robot.")) > 2048
    });
}

#[test]
fn an_interrupted_run_leaves_a_complete_report_and_nothing_else() {
    for (signal, words) in [
        (Signal::SIGINT, "interrupted by Ctrl-C (SIGINT)"),
        (Signal::SIGTERM, "interrupted by SIGTERM"),
    ] {
        let record = RunFolder::new("interrupted");
        let trial = Trial::shipped("local.toml", record.path()).set("run.duration=\"10 min\"");
        let mut child = trial.start_here();
        let files = trial.folder("", LIMIT);
        wait_for_messages(&files, "egm.right.command");
        child.signal(signal).unwrap();
        let finished = child.wait_within(LIMIT).unwrap();
        finished.assert_code(130);
        files.assert_nothing_left_here();
        let summary = files.summary();
        assert_eq!(summary.run.outcome, Outcome::Stopped);
        assert_eq!(summary.run.exit_reason, words);
        assert_every_message_is_accounted_for(&summary);
        assert_accounts_close(&summary);
        assert!(files.has_report());
        assert!(finished.stdout.contains(words), "{}", finished.stdout);
    }
}

#[test]
fn a_second_signal_ends_the_program_at_once_and_its_processes_with_it() {
    for signals in [
        [Signal::SIGINT, Signal::SIGINT],
        [Signal::SIGTERM, Signal::SIGINT],
    ] {
        end_at_once(signals);
    }
}

fn end_at_once([first, second]: [Signal; 2]) {
    let record = RunFolder::new("twice");
    let mark = record.path().display().to_string();
    // A program that will not stop when asked, so that the first Ctrl-C takes its time.
    let script = "trap \\\"\\\" TERM; while :; do sleep 1; done";
    let trial = Trial::shipped("shuttle-local.toml", record.path())
        .set("run.duration=\"10 min\"")
        .set(&format!(
            "processes.robot.run=[\"sh\", \"-c\", \"{script}\", \"{mark}/own\"]"
        ));
    let mut child = trial.start_here();
    let files = trial.folder("", LIMIT);
    let own = format!("{mark}/own");
    // Once as an argument of the script, beside the supervisor's own command line.
    let own_processes = || processes_mentioning(&format!("done\0{own}"));
    wait_until(LIMIT, "the own program", || own_processes().len() == 1);
    wait_until(LIMIT, "the begin of the run", || {
        files.record_bytes("shuttle.command.published.") > 1024
    });
    child.signal(first).unwrap();
    // The controller ends when asked; then the supervisor waits for the own program alone.
    wait_until(LIMIT, "the end of the controller", || {
        files.process("controller", 0).is_none()
    });
    assert!(child.is_running());
    child.signal(second).unwrap();
    let finished = child.wait_within(LIMIT).unwrap();
    finished.assert_code(131);
    assert!(!files.has_report(), "the report would have taken time");
    wait_until(LIMIT, "the end of all processes", || {
        own_processes().is_empty() && files.processes().is_empty()
    });
    // What it left in shared memory, the next run removes.
    let next = RunFolder::new("next");
    let trial = Trial::shipped("shuttle-local.toml", next.path()).set("run.duration=\"100 ms\"");
    let mut child = trial.start_here();
    child.wait_within(LIMIT).unwrap().assert_success();
    files.assert_nothing_left_here();
}

#[test]
fn a_run_in_virtual_time_depends_on_its_seed_alone() {
    let topology = shipped_topology("emulated.toml");
    let topology = topology.to_str().unwrap();
    let simulate = |more: &[&str]| {
        let mut arguments = vec!["simulate", "--topology", topology];
        arguments.extend(["--set", "run.duration=\"30 s\""]);
        arguments.extend(more);
        let finished = run(&arguments);
        finished.assert_success();
        finished.stdout
    };
    let text = simulate(&["--full"]);
    assert!(
        text.contains("egm/right/command") && text.contains("tracking lag"),
        "{text}"
    );
    let record = RunFolder::new("seed");
    let summary = |name: &str, more: &[&str]| {
        let folder = record.join(name);
        simulate(&[&["--output", folder.to_str().unwrap()], more].concat());
        let text = fs::read_to_string(folder.join("summary.json")).unwrap();
        RunSummary::from_json(&text).unwrap()
    };
    let first = summary("first", &[]);
    let same = summary("same", &[]);
    let other = summary("other", &["--set", "run.seed=2"]);
    let figures = |one: &RunSummary| (one.channels.clone(), one.score.clone(), one.network.clone());
    assert_eq!(figures(&first), figures(&same));
    assert_ne!(figures(&first), figures(&other));
    assert!((first.run.duration_s - 30.0).abs() < 1e-9);
    assert_eq!(first.run.seed, 1);
    let command = first
        .channels
        .iter()
        .find(|one| one.name == "egm/right/command");
    let account = command.unwrap().account.as_ref().unwrap();
    // Ten per cent of some 3680, five standard deviations either way.
    assert!(
        (277..=459).contains(&account.fates.lost_count()),
        "{account:?}"
    );
    let real = run(&["simulate", "--topology", "deploy/topologies/split.toml"]);
    real.assert_code(2);
    assert_says(&real, &["udp", "emulated"]);
}

#[test]
fn the_report_of_a_finished_run_can_be_printed_again() {
    let record = RunFolder::new("report");
    let trial = Trial::shipped("shuttle-local.toml", record.path());
    let mut command = trial.set("run.duration=\"1 s\"").command_here();
    command.env_remove("COLUMNS");
    let mut child = ChildGuard::spawn(&mut command).unwrap();
    let first = child.wait_within(LIMIT).unwrap();
    first.assert_success();
    let run_folder = fs::read_dir(record.path()).unwrap().next().unwrap();
    let run_folder = run_folder.unwrap().path();
    let again = run(&["report", run_folder.to_str().unwrap()]);
    again.assert_success();
    assert_eq!(again.stdout, first.stdout);
    let kept = fs::read_to_string(run_folder.join("report.txt")).unwrap();
    assert_eq!(again.stdout, kept);
    let summary = fs::read(run_folder.join("summary.json")).unwrap();
    let summary: Value = serde_json::from_slice(&summary).unwrap();
    assert_eq!(summary["run"]["case"], "shuttle");
    let missing = run(&["report", record.join("nothing").to_str().unwrap()]);
    missing.assert_code(2);
    assert_says(&missing, &["nothing"]);
}

#[test]
fn a_result_that_cannot_be_written_is_told_and_a_reader_that_left_is_not() {
    let record = RunFolder::new("unwritten");
    let folder = record.join("virtual");
    let folder = folder.to_str().unwrap();
    let topology = shipped_topology("shuttle-local.toml");
    let topology = topology.to_str().unwrap();
    let simulated = ["simulate", "--topology", topology, "--output", folder];
    run(&simulated).assert_success();
    let commands: [&[&str]; 10] = [
        &["--help"],
        &["--version"],
        &["report", "--help"],
        &["cases"],
        &["motion"],
        &["--topology", topology, "--check"],
        &["simulate", "--topology", topology],
        &["report", folder],
        &["report", folder, "--format", "json"],
        &["compare", folder, folder],
    ];
    for arguments in commands {
        let ended_with = |output: Stdio| {
            let mut command = Command::new(hil_runtime_binary());
            command.args(arguments).stdout(output);
            let ended = command.output().unwrap();
            (
                ended.status.code(),
                String::from_utf8(ended.stderr).unwrap(),
            )
        };
        let full = fs::OpenOptions::new()
            .write(true)
            .open("/dev/full")
            .unwrap();
        let (code, said) = ended_with(full.into());
        assert_eq!(code, Some(1), "{arguments:?}: {said}");
        let told = said.matches("cannot write the result to standard output: No space left");
        assert_eq!(told.count(), 1, "{arguments:?}: {said}");
        let (reader, writer) = io::pipe().unwrap();
        drop(reader);
        let (code, said) = ended_with(writer.into());
        assert_eq!(code, Some(0), "{arguments:?}: {said}");
        assert!(!said.contains("standard output"), "{arguments:?}: {said}");
    }
}

#[test]
fn the_cases_are_listed_with_channels_and_parameters() {
    let finished = run(&["cases"]);
    finished.assert_success();
    for words in [
        "teleoperation:",
        "shuttle:",
        "fleet:",
        "egm/right/command",
        "  [case.parameters.egm]\n",
        "rate_hz = ",
        "robots -> the record only",
        "  [case.parameters.world]\n",
    ] {
        assert!(finished.stdout.contains(words), "{}", finished.stdout);
    }
}

#[test]
fn a_written_motion_is_one_that_can_be_read_and_played() {
    let folder = RunFolder::new("motion");
    let path = folder.join("swing.bvh");
    let path = path.to_str().unwrap();
    run(&["motion", "--output", path, "--period", "2", "--rate", "100"]).assert_success();
    let text = fs::read_to_string(path).unwrap();
    let motion = Bvh::parse(&text.as_str().into()).unwrap();
    // One period, and the frame that closes it.
    assert!(
        (200..=201).contains(&motion.frame_count()),
        "{}",
        motion.frame_count()
    );
    assert_eq!(
        run(&["motion", "--period", "2", "--rate", "100"]).stdout,
        text
    );
    let topology = shipped_topology("local.toml");
    let motion_file = format!("case.parameters.motion_file=\"{path}\"");
    let played = run(&[
        "simulate",
        "--topology",
        topology.to_str().unwrap(),
        "--set",
        &motion_file,
        "--set",
        "case.parameters.motion_period_s=2.0",
    ]);
    played.assert_success();
    assert!(played.stdout.contains("motion loops sent"), "{played:?}");
    let refused = run(&["motion", "--period", "-1"]);
    refused.assert_code(2);
    assert!(!refused.stderr.is_empty());
}

#[test]
fn an_own_program_is_told_its_role_spec_and_its_channels_and_is_asked_to_stop() {
    let record = RunFolder::new("own");
    let mark = record.path().display().to_string();
    let script = "cat $HIL_CARD > $0/card; echo $HIL_DOMAIN $MOOD > $0/told; \
                  trap \\\"touch $0/asked; exit 0\\\" TERM; while :; do sleep 0.1; done";
    let trial = Trial::shipped("shuttle-local.toml", record.path())
        .set(&format!("run.record=\"{mark}/runs\""))
        .set("run.duration=\"2 s\"")
        .set("processes.robot.env={MOOD=\"good\"}")
        .set(&format!(
            "processes.robot.run=[\"sh\", \"-c\", \"{script}\", \"{mark}\"]"
        ));
    let mut child = trial.start_here();
    let finished = child.wait_within(LIMIT).unwrap();
    finished.assert_success();
    let card: Value =
        serde_json::from_str(&fs::read_to_string(record.join("card")).unwrap()).unwrap();
    assert_eq!(card["role"], "robot");
    assert_eq!(card["inputs"][0]["name"], "shuttle/command");
    let told = fs::read_to_string(record.join("told")).unwrap();
    let (domain, mood) = told.trim().split_once(' ').unwrap();
    assert!(
        domain
            .parse::<hil_platform::domain_address::DomainAddress>()
            .is_ok(),
        "{domain}"
    );
    assert_eq!(mood, "good");
    assert!(record.join("asked").exists(), "it was killed, not asked");
    let runs = Trial::of(
        &shipped_topology("shuttle-local.toml"),
        &record.join("runs"),
    );
    let files = runs.folder("", LIMIT);
    files.assert_nothing_left_here();
    let summary = files.summary();
    assert_eq!(summary.run.outcome, Outcome::Completed);
    assert!(account(&summary, "shuttle/command").published_count > 0);
}

#[test]
fn of_what_an_own_program_prints_both_ends_are_kept_and_the_rest_is_told() {
    let record = RunFolder::new("chatty");
    let script = "echo first; yes | head -c 30000000; echo last; exec sleep 60";
    let trial = Trial::shipped("shuttle-local.toml", record.path())
        .set("run.duration=\"5 s\"")
        .set(&format!(
            "processes.robot.run=[\"sh\", \"-c\", \"{script}\"]"
        ));
    let finished = trial.start_here().wait_within(LIMIT).unwrap();
    finished.assert_success();
    let files = trial.folder("", LIMIT);
    let log = files.read("logs/robot.log");
    assert!(log.len() < 3_000_000, "{}", log.len());
    assert!(log.starts_with("first\n") && log.ends_with("last\n"));
    let events = files.summary().events;
    let left_out = events.iter().find_map(|event| match event.kind {
        RunEventKind::Process(EventKind::OutputCut { left_out_bytes }) => Some(left_out_bytes),
        _ => None,
    });
    let left_out_bytes = left_out.unwrap();
    let note = format!("[hil-runtime left out {left_out_bytes} bytes here]\n");
    assert!(log.contains(&note));
    let printed_bytes = "first\nlast\n".len() as u64 + 30_000_000;
    assert_eq!(
        (log.len() - note.len()) as u64 + left_out_bytes,
        printed_bytes
    );
    assert!(
        files
            .read("report-full.txt")
            .contains("printed more than its log keeps")
    );
}

#[test]
fn an_own_program_that_fails_ends_the_run_and_is_named() {
    let record = RunFolder::new("own-fails");
    let trial = Trial::shipped("shuttle-local.toml", record.path())
        .set("run.duration=\"10 min\"")
        .set(&format!(
            "processes.robot.run=[\"sh\", \"-c\", \"{} 100 & sleep 3; echo no oil >&2; kill $!; exit 3\"]",
            env!("CARGO_BIN_EXE_hil-traffic")
        ));
    let mut child = trial.start_here();
    let finished = child.wait_within(LIMIT).unwrap();
    finished.assert_code(1);
    assert_says(&finished, &["robot: ended with exit code 3"]);
    let files = trial.folder("", LIMIT);
    files.assert_nothing_left_here();
    assert_eq!(files.summary().run.outcome, Outcome::Failed);
    assert!(files.read("logs/robot.log").contains("no oil"));
}

#[test]
fn a_folder_too_long_for_shared_memory_is_a_wrong_argument() {
    let record = RunFolder::new("long");
    let folder = record.join("x".repeat(120));
    let trial = Trial::shipped("shuttle-local.toml", record.path());
    let mut command = trial.command_here();
    command.arg("--domain-root").arg(&folder);
    let finished = ChildGuard::spawn(&mut command).unwrap().wait_within(LIMIT);
    let finished = finished.unwrap();
    finished.assert_code(2);
    assert_says(&finished, &["characters, at most"]);
    let entry_count = fs::read_dir(record.path()).unwrap().count();
    assert_eq!(entry_count, 0, "a run folder of no run");
}

#[test]
fn a_program_that_does_not_exist_is_named_before_the_run_begins() {
    let record = RunFolder::new("own-missing");
    let trial = Trial::shipped("shuttle-local.toml", record.path())
        .set("processes.robot.run=[\"no-such-robot\"]");
    let mut child = trial.start_here();
    let finished = child.wait_within(LIMIT).unwrap();
    finished.assert_code(2);
    assert_says(
        &finished,
        &[
            "processes.robot.run cannot be used: cannot start no-such-robot",
            "in /",
        ],
    );
    let entry_count = fs::read_dir(record.path()).unwrap().count();
    assert_eq!(entry_count, 0, "a run folder of no run");
    // The check of this host finds the same; one of the file alone cannot.
    let mut command = trial.command_here();
    command.args(["--check", "--host", "local"]);
    let checked = ChildGuard::spawn(&mut command).unwrap().wait_within(LIMIT);
    let checked = checked.unwrap();
    checked.assert_code(2);
    assert_says(
        &checked,
        &["processes.robot.run cannot be used: cannot start no-such-robot"],
    );
    let checked = ChildGuard::spawn(trial.command_here().arg("--check")).unwrap();
    { checked }.wait_within(LIMIT).unwrap().assert_code(0);
}
