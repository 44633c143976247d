//! A recorder on each host of a split run stands still until shared memory would have overflown: what came meanwhile
//! is read from the records of the run, also of a program of the user's, and the run loses nothing by it.

use std::collections::BTreeSet;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Duration;

use hil_report::summary::RunSummary;
use hil_rundir::record::RecordFile;
use hil_tests::account::{account, describe};
use hil_tests::binary::hil_recorder_binary;
use hil_tests::child::ChildGuard;
use hil_tests::lab::Lab;
use hil_tests::mcap_file::{assert_code, metadata, partial, read_back, recorder};
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::CHANNELS;
use hil_tests::split::Split;
use hil_tests::trial::{RunFiles, Trial, wait_until};
use nix::sys::signal::Signal;

const LIMIT: Duration = Duration::from_mins(2);
/// The channel of a program that keeps no records: a witness beside it does.
const CHANNEL: &str = "shuttle/command";
/// Messages that a recorder finds room for between two looks, at most.
const ROOM_COUNT: u64 = 1024;

/// Commands of a run, as one file.
fn commands(folder: &RunFolder) -> PathBuf {
    let trial = Trial::shipped("shuttle-local.toml", &folder.join("first"))
        .set("name=\"stopped-source\"")
        .set("run.duration=\"3 s\"");
    let mut run = trial.start_here();
    run.wait_within(LIMIT).unwrap().assert_success();
    let file = folder.join("commands.mcap");
    let root = trial.folder("", LIMIT).root().to_owned();
    let converted = recorder(&["convert", "--output"], &[&file, &root]);
    assert_code(&converted, 0);
    file
}

/// A run in which a program plays commands at 1 kHz in place of the controller.
fn played(folder: &RunFolder) -> Trial {
    let program = hil_recorder_binary().display().to_string();
    let file = commands(folder).display().to_string();
    Trial::shipped("shuttle-split.toml", &folder.join("second"))
        .set("run.duration=\"10 min\"")
        .set(&format!(
            "processes.controller.run=[\"{program}\", \"play\", \"{file}\", \"--only\", \
             \"{CHANNEL}\", \"--speed\", \"10\", \"--loop\"]"
        ))
}

/// Commands that came over the hop by now.
fn arrived(files: &RunFiles) -> u64 {
    // The run's folder is there a moment before what is in it.
    let entries = match fs::read_dir(files.root().join("records")) {
        Ok(entries) => entries,
        Err(error) if error.kind() == ErrorKind::NotFound => return 0,
        Err(error) => panic!("{error}"),
    };
    let paths = entries.map(|entry| entry.unwrap().path());
    let of_commands = paths.filter(|path| {
        let name = path.file_name().unwrap().to_string_lossy();
        name.starts_with("shuttle.command.ingress.")
    });
    // So is a file before its header, which is written at once.
    let begun = of_commands.filter(|path| fs::metadata(path).unwrap().len() > 0);
    let counts = begun.map(|path| RecordFile::read(&path).unwrap().record_count());
    counts.sum::<usize>() as u64
}

/// A file has every message of the channel once, and misses none.
fn check(file: &Path, summary: &RunSummary) {
    let words = &metadata(file)["hil.recording"];
    let missed = words.get(&format!("missed {CHANNEL}"));
    let messages = read_back(file).remove(&format!("/{CHANNEL}")).unwrap();
    let numbers: BTreeSet<u64> = messages.iter().map(|one| u64::from(one.sequence)).collect();
    let published = account(summary, CHANNEL).published_count;
    println!(
        "{}: {} recorded, {missed:?} missed, {published} published",
        summary.run.host,
        messages.len()
    );
    assert_eq!(missed, None);
    assert_eq!(numbers.len(), messages.len());
    assert_eq!(numbers.len() as u64, published);
}

#[test]
fn a_recorder_that_stood_still_reads_the_rest_from_the_records_and_costs_the_run_nothing() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let folder = RunFolder::new("stopped");
    let trial = played(&folder);
    let outputs = ["control.mcap", "robot.mcap"].map(|name| folder.join(name));
    let mut recorders = [0, 1].map(|index| {
        let mut command = lab.host(index).command(hil_recorder_binary());
        command
            .args(["record", "--wait", "-o"])
            .arg(&outputs[index]);
        ChildGuard::spawn(&mut command).unwrap()
    });
    let mut run = Split::start(&lab, &trial);
    let files = run.files[1].clone();
    wait_until(LIMIT, "commands and files", || {
        arrived(&files) > ROOM_COUNT && outputs.iter().all(|file| partial(file).is_file())
    });
    for recorder in &recorders {
        recorder.signal(Signal::SIGSTOP).unwrap();
    }
    let stopped_at = arrived(&files);
    wait_until(LIMIT, "commands that no recorder has room for", || {
        arrived(&files) > stopped_at + 3 * ROOM_COUNT
    });
    for recorder in &recorders {
        recorder.signal(Signal::SIGCONT).unwrap();
    }
    let resumed_at = arrived(&files);
    wait_until(LIMIT, "commands that are recorded as they come", || {
        arrived(&files) > resumed_at + 2 * ROOM_COUNT
    });
    run.interrupt();
    let summaries = run.stopped();
    for (index, recorder) in recorders.iter_mut().enumerate() {
        let finished = recorder.wait_within(LIMIT).unwrap();
        println!("{}", finished.stdout);
        assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
        check(&outputs[index], &summaries[index]);
    }
    for summary in &summaries {
        for name in CHANNELS {
            let account = account(summary, name);
            assert_eq!(account.fates.lost_count(), 0, "{}", describe(name, account));
        }
    }
}
