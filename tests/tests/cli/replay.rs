//! What a finished run leaves besides its report, and what becomes of it: the replay of its robot,
//! its event log, its outages; and the same of a run in virtual time.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use hil_account::MessageFate;
use hil_report::summary::RunSummary;
use hil_tests::account::account;
use hil_tests::binary::hil_runtime as run;
use hil_tests::child::Finished;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{RunFiles, Trial};
use serde_json::Value;

const LIMIT: Duration = Duration::from_mins(2);

/// A finished run behind an emulated link that loses every tenth message.
fn finished_run(record: &RunFolder) -> RunFiles {
    let trial = Trial::shipped("emulated.toml", record.path())
        .on_own_ports(&["hop"])
        .set("run.duration=\"5 s\"");
    let mut child = trial.start_here();
    child.wait_within(LIMIT).unwrap().assert_success();
    trial.folder("", LIMIT)
}

fn replay(folder: &Path) -> Finished {
    run(&["replay", folder.to_str().unwrap()])
}

/// The record of a channel's messages.
fn messages_of(folder: &Path, channel: &str) -> PathBuf {
    let start = format!("{channel}.message.");
    let mut files = fs::read_dir(folder.join("records")).unwrap();
    let file = files.find_map(|entry| {
        let name = entry.unwrap().file_name();
        name.to_str().unwrap().starts_with(&start).then_some(name)
    });
    folder.join("records").join(file.unwrap())
}

#[test]
fn a_run_is_replayed_to_the_last_bit_and_a_flipped_bit_is_found() {
    let record = RunFolder::new("replay");
    let files = finished_run(&record);
    assert_outages_and_events_are_kept(&files);
    let folder = files.root();
    let same = replay(folder);
    same.assert_code(0);
    assert!(same.stdout.contains(": identical\n"), "{same:?}");
    let json = run(&["replay", folder.to_str().unwrap(), "--json"]);
    json.assert_code(0);
    let document: Value = serde_json::from_str(&json.stdout).unwrap();
    assert_eq!(document["is_identical"], true, "{document}");
    assert!(document["replay"]["compared_count"].as_u64().unwrap() > 1_000);

    // The lowest bit of the first joint in the middle of the record: header, envelopes, cycle,
    // reference and its age come before it.
    let path = messages_of(folder, "egm.left.feedback");
    let whole = fs::read(&path).unwrap();
    let record_bytes = 64 + 216;
    let count = (whole.len() - 128) / record_bytes;
    let mut flipped = whole.clone();
    flipped[128 + count / 2 * record_bytes + 64 + 24] ^= 1;
    fs::write(&path, flipped).unwrap();
    let other = replay(folder);
    other.assert_code(1);
    assert!(other.stdout.contains(": DIFFERENT\n"), "{other:?}");
    assert!(other.stdout.contains("1 differs"), "{other:?}");
    assert!(other.stdout.contains("left arm, cycle "), "{other:?}");

    fs::remove_file(&path).unwrap();
    let torn = replay(folder);
    torn.assert_code(1);
    assert!(
        torn.stdout
            .contains("egm/left/feedback: no record is at hand"),
        "{torn:?}"
    );
    fs::remove_dir_all(folder.join("records")).unwrap();
    replay(folder).assert_code(2);
    let nowhere = replay(record.path());
    nowhere.assert_code(2);
    assert!(nowhere.stderr.contains("not a run's folder"), "{nowhere:?}");
}

fn assert_outages_and_events_are_kept(files: &RunFiles) {
    let summary = files.summary();
    for channel in &summary.channels {
        let Some(figures) = &channel.outages else {
            assert!(channel.to.is_none(), "{}", channel.name);
            continue;
        };
        let account = account(&summary, &channel.name);
        assert_eq!(
            figures.lost_count,
            account.fates.lost_count(),
            "{}",
            channel.name
        );
        let of_each: u64 = figures.classes.iter().map(|one| one.outage_count).sum();
        assert_eq!(of_each + figures.unknown_length_count, figures.outage_count);
        let is_lossless = account.fates.of(MessageFate::LostOnWire) == 0;
        assert_eq!(figures.longest.is_none(), is_lossless);
    }
    let page = files.read("report-full.txt");
    assert!(page.contains("Outages by length"), "{page}");
    assert!(page.contains("  events.log  "), "{page}");
    let log = files.read("events.log");
    let name = &summary.run.name;
    assert!(log.starts_with(&format!("# {name}\n")), "{log}");
    let lines = log.lines().filter(|line| !line.starts_with('#'));
    assert_eq!(lines.count(), summary.score_events.events.len(), "{log}");
}

#[test]
fn a_run_in_virtual_time_leaves_the_same_files_but_no_records() {
    let folder = RunFolder::new("virtual");
    let output = folder.join("out");
    let arguments = [
        "simulate",
        "--topology",
        "deploy/topologies/emulated.toml",
        "--set",
        "run.duration=\"10 s\"",
        "--full",
        "--output",
        output.to_str().unwrap(),
    ];
    let simulated = run(&arguments);
    simulated.assert_code(0);
    let again = run(&arguments);
    again.assert_code(2);
    assert!(
        again.stderr.contains("out: the folder is not empty"),
        "{again:?}"
    );
    let report = run(&["report", output.to_str().unwrap(), "--full"]);
    report.assert_code(0);
    assert_eq!(report.stdout.trim_end(), simulated.stdout.trim_end());
    let brief = run(&["report", output.to_str().unwrap()]);
    let printed = fs::read_to_string(output.join("report.txt")).unwrap();
    assert_eq!(brief.stdout, printed);
    assert!(
        simulated.stdout.contains("  egm/right/command  "),
        "{simulated:?}"
    );
    assert!(
        simulated.stdout.contains("  outages together  "),
        "{simulated:?}"
    );
    assert_eq!(
        fs::read_to_string(output.join("report-full.txt")).unwrap(),
        simulated.stdout
    );
    let summary = fs::read_to_string(output.join("summary.json")).unwrap();
    let summary = RunSummary::from_json(&summary).unwrap();
    let channels = &mut summary.channels.iter();
    let command = channels
        .find(|one| one.name == "egm/right/command")
        .unwrap();
    assert!(
        command.outages.as_ref().unwrap().outage_count > 20,
        "{command:?}"
    );
    assert!(output.join("events.log").is_file());
    assert_series_are_those_that_the_case_lists(&output.join("series"));
    replay(&output).assert_code(2);
}

fn assert_series_are_those_that_the_case_lists(folder: &Path) {
    let cases = run(&["cases"]).stdout;
    let case = cases.split("\nteleoperation: ").nth(1).unwrap();
    let line = case.lines().find_map(|line| line.strip_prefix("  series "));
    let names = line.unwrap().split(';').next().unwrap().split(',');
    let mut listed: Vec<_> = names.map(|name| format!("{}.csv", name.trim())).collect();
    let files = fs::read_dir(folder).unwrap();
    let mut found: Vec<_> = files
        .map(|file| file.unwrap().file_name().into_string().unwrap())
        .collect();
    let networks = found.iter().filter(|name| name.starts_with("network-"));
    let networks: Vec<_> = networks.cloned().collect();
    assert!(
        networks.contains(&"network-egm-right-command.csv".to_owned()),
        "{found:?}"
    );
    listed.extend(networks);
    listed.push("series.json".to_owned());
    listed.sort();
    found.sort();
    assert_eq!(found, listed);
    let list = fs::read(folder.join("series.json")).unwrap();
    let list: Value = serde_json::from_slice(&list).unwrap();
    for name in listed.iter().filter_map(|name| name.strip_suffix(".csv")) {
        let table = fs::read_to_string(folder.join(format!("{name}.csv"))).unwrap();
        let mut lines = table.lines();
        let columns: Vec<_> = lines.next().unwrap().split(',').collect();
        let rows: Vec<_> = lines.map(|line| line.split(',').count()).collect();
        // Ten seconds of motion are two loops.
        let fewest = match name {
            "motion-loops" => 1,
            // A row for each tenth of a second.
            name if name.starts_with("network-") => 50,
            _ => 1_000,
        };
        assert!(rows.len() >= fewest, "{name} has {} rows", rows.len());
        assert!(rows.iter().all(|count| *count == columns.len()), "{name}");
        let mut entries = list.as_array().unwrap().iter();
        let entry = entries.find(|entry| entry["name"] == name);
        let described = entry.unwrap_or_else(|| panic!("{name}: {list}"))["columns"].as_array();
        let described = described.unwrap().iter().map(|column| &column["name"]);
        assert!(described.eq(columns.iter()), "{name}: {list}");
    }
}

#[test]
fn mistakes_in_a_calibration_are_named_with_what_would_do() {
    for (arguments, words) in [
        (
            &["calibrate", "submarine", "--mlr", "0.008"][..],
            &["submarine", "teleoperation", "fleet"][..],
        ),
        (
            &["calibrate", "shuttle", "--mlr", "0.008"],
            &["case shuttle cannot be calibrated for mlr"],
        ),
        (&["calibrate", "teleop"], &["--mlr", "--figure"]),
        (
            &["calibrate", "teleop", "--mlr", "1.5"],
            &[
                "\"teleop\" is taken for case teleoperation",
                "mlr 1.5 is outside 0.001 to 0.3",
            ],
        ),
        (
            &["calibrate", "shuttle", "--figure", "mlr"],
            &["mlr is not NAME=VALUE"],
        ),
        (
            &["calibrate", "shuttle", "--mlr", "NaN"],
            &["mlr NaN is not a finite number"],
        ),
        (
            &["calibrate", "shuttle", "--mlr", "0.1", "--set", "run.sed=2"],
            &["did you mean `seed`?"],
        ),
        (
            &[
                "calibrate",
                "shuttle",
                "--mlr",
                "0.1",
                "--topology",
                "deploy/topologies/local.toml",
            ],
            &["the topology names teleoperation, not case shuttle"],
        ),
    ] {
        let finished = run(arguments);
        finished.assert_code(2);
        for word in words {
            assert!(
                finished.stderr.contains(word),
                "no `{word}` in {finished:?}"
            );
        }
    }
    let help = run(&["calibrate", "--help"]);
    assert!(
        help.stdout.contains("hil-runtime calibrate teleop --mlr"),
        "{help:?}"
    );
}
