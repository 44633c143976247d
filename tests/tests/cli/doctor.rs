//! `hil-runtime doctor` as a program: its JSON, its exit codes, its measurement, its refusals. What it
//! finds on made-up hosts is tested beside the code.

use std::process::Command;
use std::time::Duration;

use hil_tests::binary::{hil_runtime as run, hil_runtime_binary};
use hil_tests::child::ChildGuard;
use nix::sys::signal::Signal;
use serde_json::Value;

/// A measurement of seconds, on a machine that does other things.
const LIMIT: Duration = Duration::from_mins(2);

fn start(arguments: &[&str]) -> ChildGuard {
    let mut command = Command::new(hil_runtime_binary());
    ChildGuard::spawn(command.args(arguments).env_remove("HIL_HOST")).unwrap()
}

#[test]
fn the_doctor_speaks_json_and_is_strict_when_told_to() {
    let finished = run(&["doctor", "--json"]);
    finished.assert_success();
    let report: Value = serde_json::from_str(&finished.stdout).unwrap();
    assert!(
        report["host"]
            .as_array()
            .is_some_and(|facts| facts.len() > 5),
        "{report}"
    );
    assert_eq!(report["schema"], "hil-doctor/1");
    let counted = report["counts"].as_object().unwrap().values();
    let counted: u64 = counted.filter_map(Value::as_u64).sum();
    let findings = report["findings"].as_array().unwrap();
    assert_eq!(counted, findings.len() as u64);
    for finding in findings {
        for key in ["id", "title", "severity", "value", "source", "why", "fix"] {
            assert!(
                finding[key].as_str().is_some_and(|s| !s.is_empty()),
                "{finding}"
            );
        }
    }
    let text = run(&["doctor"]);
    text.assert_success();
    assert!(text.stdout.contains("Kernel preemption"), "{}", text.stdout);
    let strict = run(&["doctor", "--strict", "--json"]);
    let report: Value = serde_json::from_str(&strict.stdout).unwrap();
    let is_unfit = ["warning", "error"]
        .iter()
        .any(|word| report["counts"][word].as_u64() > Some(0));
    strict.assert_code(if is_unfit { 78 } else { 0 });
}

#[test]
fn the_doctor_measures_latency_with_counts_that_follow_from_the_time() {
    let finished = run(&[
        "doctor",
        "--latency",
        "2s",
        "--period",
        "2ms",
        "--cpu",
        "0",
        "--json",
    ]);
    finished.assert_success();
    let report: Value = serde_json::from_str(&finished.stdout).unwrap();
    let latency = &report["latency"];
    assert_eq!(latency["is_thorough"], true);
    assert_eq!(latency["period_ns"], 2_000_000);
    let wakeups = &latency["wakeups"][0];
    assert_eq!(wakeups["cpu"], 0);
    let number = |value: &Value| value.as_u64().unwrap();
    // Every instant of the grid counts, also one that passed while the thread was late.
    let expected = number(&wakeups["measured_ns"]) / 2_000_000;
    let count = number(&wakeups["count"]);
    assert!(
        expected >= 1000 && count.abs_diff(expected) <= 1,
        "{wakeups}"
    );
    let lateness = &wakeups["lateness"];
    let quantiles = ["p50_ns", "p99_ns", "p999_ns", "max_ns"].map(|key| number(&lateness[key]));
    assert!(quantiles.is_sorted(), "{lateness}");
    let gaps = &latency["gaps"][0];
    assert!(number(&gaps["measured_ns"]) >= 2_000_000_000, "{gaps}");
    assert!(
        number(&gaps["lost_ns"]) <= number(&gaps["measured_ns"]),
        "{gaps}"
    );
    assert!(number(&gaps["look_count"]) > 1000, "{gaps}");
    let claims = latency["claims"].as_array().unwrap();
    for id in [
        "median",
        "p99",
        "p999",
        "largest",
        "deadline_1000_hz",
        "busy_polling_cpu0",
    ] {
        let claim = claims.iter().find(|claim| claim["id"] == id);
        assert!(
            claim.is_some_and(|one| !one["rule"].as_str().unwrap().is_empty()),
            "{id}"
        );
    }
    // A thousand wake-ups are too few for one in a thousand, whatever they were.
    let tail = claims.iter().find(|claim| claim["id"] == "p999").unwrap();
    assert_eq!(tail["standing"], "not_measured");
}

#[test]
fn wrong_arguments_of_the_doctor_are_refused_with_what_is_right() {
    for (arguments, words) in [
        (["--latency", "30"].as_slice(), "no unit"),
        (&["--latency", "1 ms"], "100 ms to 24 h"),
        (&["--latency", "1 s", "--priority", "0"], "1 to 99"),
        (&["--latency", "1 s", "--period", "2 s"], "100 us to 1 s"),
        (
            &["--latency", "1 s", "--cpu", "4095"],
            "CPU 4095 does not run here",
        ),
        (&["--cpu", "0"], "--latency"),
        (&["--with", "/nonexistent.json"], "/nonexistent.json"),
        (&["--with", "/dev/null"], "no report of `doctor --json`"),
    ] {
        let finished = run(&[&["doctor"], arguments].concat());
        finished.assert_code(2);
        assert!(
            finished.stderr.contains(words),
            "no `{words}` in {finished:?}"
        );
    }
}

#[test]
fn an_interrupted_measurement_gives_what_there_was_so_far() {
    let mut doctor = start(&["doctor", "--latency", "1 h", "--cpu", "0", "--json"]);
    // Progress appears on standard error once the measurement goes on.
    doctor.wait_for_output("wake-ups", LIMIT).unwrap();
    doctor.signal(Signal::SIGINT).unwrap();
    let finished = doctor.wait_within(LIMIT).unwrap();
    finished.assert_code(130);
    let report: Value = serde_json::from_str(&finished.stdout).unwrap();
    let latency = &report["latency"];
    assert_eq!(latency["is_interrupted"], true);
    assert!(
        latency["wakeups"][0]["count"].as_u64() > Some(0),
        "{latency}"
    );
    assert!(latency["gaps"].as_array().unwrap().is_empty());
}
