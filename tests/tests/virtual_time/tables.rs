//! `hil-runtime tables` as a person uses it: equal tables on any number of threads, files, Ctrl-C
//! and mistakes. Whether the figures are right is the models' and the published tables' business.

use std::fs;
use std::process::Command;
use std::time::Duration;

use hil_tests::binary::{hil_runtime_binary, workspace_folder};
use hil_tests::child::{ChildGuard, Finished};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::wait_until_it_heeds_interrupts;
use nix::sys::signal::Signal;
use serde_json::Value;

const SHIPPED: &str = "deploy/topologies/tables.toml";
const LIMIT: Duration = Duration::from_mins(5);

/// Two cells of the published tables and four of the mechanisms', small.
const FEW_CELLS: &str = "case.parameters.tables.cells=['warehouse, loss 0, 100 ms', 'clean']";
const SMALL: [&str; 4] = [
    "--set",
    FEW_CELLS,
    "--set",
    "case.parameters.tables.sections_per_task=100",
];

fn command(topology: &str, arguments: &[&str]) -> Command {
    let mut command = Command::new(hil_runtime_binary());
    command
        .args(["tables", "--topology", topology])
        .args(arguments)
        .current_dir(workspace_folder())
        .env_remove("COLUMNS");
    command
}

fn run_on(topology: &str, arguments: &[&str]) -> Finished {
    let mut child = ChildGuard::spawn(&mut command(topology, arguments)).unwrap();
    child.wait_within(LIMIT).unwrap()
}

fn run(arguments: &[&str]) -> Finished {
    run_on(SHIPPED, arguments)
}

#[test]
fn equal_seeds_give_equal_tables_on_any_number_of_threads() {
    let report = |jobs: &str, seed: &str| {
        let arguments = [
            &SMALL[..],
            &["--sections", "300", "--json", "--quiet", "--jobs", jobs],
            &["--set", seed],
        ];
        let finished = run(&arguments.concat());
        finished.assert_success();
        let document: Value = serde_json::from_str(&finished.stdout).unwrap();
        assert_eq!(document["is_passed"], true, "{}", finished.stdout);
        // Five cells of three runs each.
        assert_eq!(document["cost"]["ended_count"], 15);
        assert!(document["cost"]["wall_s"].as_f64().unwrap() > 0.0);
        document["report"].clone()
    };
    let one = report("1", "run.seed=1");
    assert_eq!(one, report("3", "run.seed=1"));
    assert_ne!(one["tables"], report("3", "run.seed=2")["tables"]);
}

#[test]
fn the_tables_are_printed_and_written_with_what_they_are_held_against() {
    let folder = RunFolder::new("tables");
    let output = folder.path().join("out");
    let output_text = output.to_str().unwrap();
    let finished = run(&[&SMALL[..], &["--sections", "100", "--output", output_text]].concat());
    finished.assert_success();
    for words in [
        "Table II, harbor",
        "HiL, long-range Wi-Fi 6",
        "What causes collisions, warehouse",
        "safe: no collision by any checker",
        "of wall time",
        "seed 1, 100 CS per cell",
    ] {
        assert!(finished.stdout.contains(words), "{words}: {finished:?}");
    }
    let read = |name: &str| fs::read_to_string(output.join(name)).unwrap();
    assert!(read("report.txt").contains("Table III, warehouse"));
    let document: Value = serde_json::from_str(&read("report.json")).unwrap();
    assert_eq!(document["is_passed"], true);
    let harbor = read("table-2-harbor.csv");
    let lines: Vec<_> = harbor.lines().collect();
    assert!(lines[0].starts_with("method,loss_ratio,delay_ms,copies,sections,"));
    // The paper's eleven rows, all of them without a figure of ours here.
    assert_eq!(lines.len(), 1 + 11);
    assert!(lines[4].contains(",10018,5,"), "{}", lines[4]);
}

/// The gate's share of the claim: every impairment in both maps. A million sections take minutes
/// in a release build: `hil-runtime tables --sections 40000` with the same two settings.
#[test]
fn the_safe_coordinator_collides_under_no_impairment() {
    let finished = run(&[
        "--quiet",
        "--json",
        "--sections",
        "1500",
        "--set",
        "case.parameters.tables.parts=['mechanisms']",
        "--set",
        "case.parameters.tables.cells=[', safe']",
        "--set",
        "case.parameters.tables.sections_per_task=750",
    ]);
    finished.assert_success();
    let document: Value = serde_json::from_str(&finished.stdout).unwrap();
    let criteria = document["report"]["criteria"].as_array().unwrap();
    let verdict = |words: &str| {
        let has_words = |criterion: &&Value| criterion["text"].as_str().unwrap().contains(words);
        let found = criteria.iter().find(has_words);
        found.unwrap_or_else(|| panic!("{words}: {document:#}"))["is_met"].clone()
    };
    assert_eq!(verdict("no collision by any checker"), true, "{document:#}");
    assert_eq!(verdict("no robot stuck"), true, "{document:#}");
    assert_eq!(verdict("proof rules out"), true, "{document:#}");
}

#[test]
fn an_interrupted_study_prints_what_is_complete() {
    let mut child = ChildGuard::spawn(&mut command(SHIPPED, &["--sections", "100000000"])).unwrap();
    child
        .wait_for_output("harbor, loss 0, 0 ms", LIMIT)
        .unwrap();
    child.signal(Signal::SIGINT).unwrap();
    let finished = child.wait_within(LIMIT).unwrap();
    assert_eq!(finished.status.code(), Some(130), "{finished:?}");
    assert!(finished.stdout.contains("Table III, warehouse"));
    assert!(finished.stderr.contains("ended by Ctrl-C"), "{finished:?}");
}

#[test]
fn an_interruption_is_answered_from_the_first_moment_on() {
    let mut simulate = Command::new(hil_runtime_binary());
    simulate
        .args(["simulate", "--topology", "deploy/topologies/emulated.toml"])
        .args(["--set", "run.duration=\"20 h\""])
        .current_dir(workspace_folder());
    for mut command in [simulate, command(SHIPPED, &["--sections", "100000000"])] {
        let mut child = ChildGuard::spawn(&mut command).unwrap();
        wait_until_it_heeds_interrupts(&child, LIMIT);
        child.signal(Signal::SIGINT).unwrap();
        let finished = child.wait_within(LIMIT).unwrap();
        assert_eq!(finished.status.code(), Some(130), "{finished:?}");
        assert!(finished.stderr.contains("ended by Ctrl-C"), "{finished:?}");
    }
}

#[test]
fn what_cannot_be_computed_is_named() {
    let refused = |topology: &str, arguments: &[&str], words: &str| {
        let finished = run_on(topology, arguments);
        assert_eq!(finished.status.code(), Some(2), "{finished:?}");
        assert!(finished.stderr.contains(words), "{words}: {finished:?}");
    };
    let unknown_row = ["--set", "case.parameters.tables.cells=['no such row']"];
    refused(SHIPPED, &unknown_row, "no such row");
    refused(SHIPPED, &["--sections", "0"], "tables.sections");
    let absent = ["--run", "ethernet=runs/no-such-run"];
    refused(SHIPPED, &absent, "runs/no-such-run/summary.json");
    let unlabelled = ["--run", "wifi=runs/a"];
    refused(
        SHIPPED,
        &unlabelled,
        "label `wifi` is none of ethernet, short, long",
    );
    let shuttle = "deploy/topologies/shuttle-local.toml";
    refused(shuttle, &[], "case shuttle has no tables");
}

/// The shipped file of case study 2, small: Bernoulli losses cost no loop, whatever the threads.
#[test]
fn the_motion_loss_table_is_the_same_on_any_number_of_threads() {
    let report = |jobs: &str| {
        let arguments = [
            "--json",
            "--quiet",
            "--jobs",
            jobs,
            "--set",
            "case.parameters.tables={ loops = 60, seeds = 3, conditions = ['loss-', 'short'] }",
        ];
        let finished = run_on("deploy/topologies/teleop-tables.toml", &arguments);
        finished.assert_success();
        let document: Value = serde_json::from_str(&finished.stdout).unwrap();
        assert_eq!(document["is_passed"], true, "{}", finished.stdout);
        // Four ratios of loss, the short range and the radio at that range, three runs each.
        assert_eq!(document["cost"]["ended_count"], 18);
        document["report"].clone()
    };
    let (one, two) = (report("1"), report("2"));
    assert!(one["tables"].is_array(), "{one}");
    assert_eq!(one, two);
}
