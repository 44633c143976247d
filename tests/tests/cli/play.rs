//! A recorded channel played into another run: in place of a process, byte for byte, at its own
//! speed; and never beside a living writer.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use hil_account::MessageFate;
use hil_arm::egm::messages::EgmCommand;
use hil_report::summary::Outcome;
use hil_rundir::layout::hex;
use hil_rundir::record::RecordFile;
use hil_tests::account::{account, assert_accounts_close, assert_every_message_is_accounted_for};
use hil_tests::binary::{hil_recorder_binary, hil_runtime_binary};
use hil_tests::child::{ChildGuard, Finished};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{RunFiles, Trial, wait_until};
use nix::sys::signal::Signal;
use serde_json::Value;

const LIMIT: Duration = Duration::from_mins(1);
const MOTION: &str = "human/frame";

fn finish(command: &mut Command) -> Finished {
    let mut child = ChildGuard::spawn(command).unwrap();
    child.wait_within(LIMIT).unwrap()
}

/// The messages of a channel as its one record file has them.
fn recorded(run: &RunFiles, channel: &str) -> Vec<Vec<u8>> {
    let start = format!("{}.message.", channel.replace('/', "."));
    let mut files = fs::read_dir(run.root().join("records")).unwrap();
    let path = files.find_map(|file| {
        let file = file.unwrap();
        let is_it = file.file_name().to_string_lossy().starts_with(&start);
        is_it.then(|| file.path())
    });
    let file = RecordFile::read(&path.unwrap()).unwrap();
    let all = (0..file.record_count()).map(|index| file.message(index).unwrap().1.to_vec());
    all.collect()
}

/// A run of `seconds`, in four of which a person swings an arm once, and its recording as one file.
fn recording(record: &RunFolder, seconds: u32) -> (RunFiles, PathBuf) {
    let trial = Trial::shipped("local.toml", &record.join("first"))
        .set(&format!("run.duration=\"{seconds} s\""));
    trial
        .start_here()
        .wait_within(LIMIT)
        .unwrap()
        .assert_success();
    let first = trial.folder("", LIMIT);
    let file = record.join("motion.mcap");
    let mut convert = Command::new(hil_recorder_binary());
    convert
        .arg("convert")
        .arg(first.root())
        .arg("-o")
        .arg(&file);
    finish(&mut convert).assert_success();
    (first, file)
}

fn with_player(record: &RunFolder, file: &Path, more: &str) -> Trial {
    let program = hil_recorder_binary().display().to_string();
    let file = file.display();
    Trial::shipped("replayed-motion.toml", &record.join("second")).set(&format!(
        "processes.human.run=[\"{program}\", \"play\", \"{file}\", \"--only\", \"{MOTION}\"{more}]"
    ))
}

/// How far each commanded joint of the right arm moved, radians.
fn strokes(run: &RunFiles) -> Vec<f64> {
    let commands = recorded(run, "egm/right/command");
    let commands: Vec<EgmCommand> = commands
        .iter()
        .map(|bytes| bytemuck::pod_read_unaligned(bytes))
        .collect();
    let joints = 0..commands[0].position_rad.len();
    let stroke = |joint: usize| {
        let angles = commands.iter().map(|command| command.position_rad[joint]);
        let highest = angles.clone().fold(f64::MIN, f64::max);
        highest - angles.fold(f64::MAX, f64::min)
    };
    joints.map(stroke).collect()
}

#[test]
fn a_recorded_person_moves_the_arms_of_another_run() {
    let record = RunFolder::new("play");
    let (first, file) = recording(&record, 4);
    let motion: Vec<String> = recorded(&first, MOTION)
        .iter()
        .map(|bytes| hex(bytes))
        .collect();
    assert!(motion.len() > 100, "{}", motion.len());

    // At twice the speed, twice through and more.
    let trial =
        with_player(&record, &file, ", \"--speed\", \"2\", \"--loop\"").set("run.duration=\"6 s\"");
    let mut child = trial.start_here();
    let second = trial.folder("", LIMIT);
    wait_until(LIMIT, "the player", || {
        second.record_bytes("human.frame.taken.controller.") > 1024
    });
    let run_folder = second.root().to_str().unwrap();
    let mut echo = Command::new(hil_runtime_binary());
    echo.args([
        "channel", "echo", MOTION, run_folder, "--raw", "--json", "--count", "200",
    ]);
    let seen = finish(&mut echo);
    seen.assert_success();
    child.wait_within(LIMIT).unwrap().assert_success();
    second.assert_nothing_left_here();

    // What came is the recording, byte for byte and in its order.
    let seen: Vec<Value> = seen
        .stdout
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    assert_eq!(seen.len(), 200);
    for one in &seen {
        let number = usize::try_from(one["sequence"].as_u64().unwrap()).unwrap();
        let expected = &motion[number % motion.len()];
        assert_eq!(one["bytes"].as_str().unwrap(), expected, "message {number}");
    }
    let summary = second.summary();
    assert_eq!(summary.run.outcome, Outcome::Completed);
    assert_every_message_is_accounted_for(&summary);
    assert_accounts_close(&summary);
    let player = account(&summary, MOTION);
    // A recording of 4 s at twice the speed is over after 2 s: more than two rounds in 6 s.
    assert!(
        player.published_count > 2 * motion.len() as u64,
        "{player:?}"
    );
    assert!(player.fates.of(MessageFate::Taken) > 0, "{player:?}");

    // The arms make the same motion.
    for (one, other) in strokes(&first).into_iter().zip(strokes(&second)) {
        assert!(
            (one - other).abs() < 0.1 + 0.2 * one,
            "{one} against {other} rad"
        );
    }
}

#[test]
fn a_channel_with_a_living_writer_is_refused_and_so_is_what_does_not_fit() {
    let record = RunFolder::new("play-refused");
    let (_first, file) = recording(&record, 1);
    let trial = Trial::shipped("local.toml", &record.join("second")).set("run.duration=\"10 min\"");
    let mut child = trial.start_here();
    let second = trial.folder("", LIMIT);
    wait_until(LIMIT, "messages", || {
        second.record_bytes("egm.right.command.taken.robot.") > 1024
    });
    let into = second.root().to_str().unwrap();
    let play = |arguments: &[&str]| {
        finish(
            Command::new(hil_recorder_binary())
                .arg("play")
                .args(arguments),
        )
    };
    let file = file.to_str().unwrap();
    for (arguments, words) in [
        (
            vec![file, "--only", MOTION, "--into", into],
            "process human: two writers at once",
        ),
        (
            vec![file, "--only", "human", "--into", into],
            "it has human/frame",
        ),
        (
            vec![file, "--only", MOTION, "--into", "no-such-run"],
            "no run \"no-such-run\"",
        ),
        (
            vec![file, "--only", MOTION, "--speed", "0"],
            "must be a number from 0.01 to 100",
        ),
        (vec![file], "Give --only CHANNEL"),
    ] {
        let refused = play(&arguments);
        assert_eq!(refused.status.code(), Some(2), "{refused:?}");
        assert!(refused.stderr.contains(words), "{words}: {refused:?}");
    }
    child.signal(Signal::SIGINT).unwrap();
    child.wait_within(LIMIT).unwrap();
    second.assert_nothing_left_here();
    assert_every_message_is_accounted_for(&second.summary());
}

#[test]
fn a_recording_that_is_over_does_not_end_the_run() {
    let record = RunFolder::new("play-once");
    let (_first, file) = recording(&record, 1);
    let trial = with_player(&record, &file, ", \"--speed\", \"100\"").set("run.duration=\"3 s\"");
    trial
        .start_here()
        .wait_within(LIMIT)
        .unwrap()
        .assert_success();
    let second = trial.folder("", LIMIT);
    second.assert_nothing_left_here();
    assert_eq!(second.summary().run.outcome, Outcome::Completed);
    let log = second.read("logs/human.log");
    assert!(log.contains("silent until the run ends"), "{log}");
}
