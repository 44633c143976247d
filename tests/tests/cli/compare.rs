//! Runs compared by the real binary: a slower and lossier link is found, equal ones are not told apart,
//! and scripts get the exit code that they asked for.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::Duration;

use hil_tests::binary::hil_runtime_binary;
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::emulated_shuttle;
use hil_tests::trial::Trial;
use serde_json::Value;

const LIMIT: Duration = Duration::from_mins(1);

/// Runs of 5 s over emulated links, all at once; gives their folders.
fn runs(record: &RunFolder, links: &[(&str, &str)]) -> Vec<PathBuf> {
    let trials: Vec<_> = links
        .iter()
        .map(|(name, keys)| {
            let file = format!("{name}.toml");
            let topology = record.write(file, &emulated_shuttle(name, keys));
            let trial = Trial::of(&topology, &record.join(name)).set("run.duration=\"5 s\"");
            let child = trial.start_here();
            (trial, child)
        })
        .collect();
    trials
        .into_iter()
        .map(|(trial, mut child)| {
            child.wait_within(LIMIT).unwrap().assert_success();
            trial.folder("", LIMIT).root().to_owned()
        })
        .collect()
}

fn compare(arguments: &[&str], folders: &[&Path]) -> (Option<i32>, String, String) {
    let mut command = Command::new(hil_runtime_binary());
    let Output {
        status,
        stdout,
        stderr,
    } = command
        .arg("compare")
        .args(folders)
        .args(arguments)
        .output()
        .unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap().replace('\u{a0}', " ");
    (status.code(), text(stdout), text(stderr))
}

/// The figure of `metric` on `channel`, end to end.
fn found<'a>(json: &'a Value, channel: &str, metric: &str) -> &'a Value {
    let figures = json["figures"].as_array().unwrap();
    let is_meant = |one: &&Value| {
        one["channel"] == channel
            && one["metric"] == metric
            && (metric == "loss" || one["part"]["kind"] == "end_to_end")
    };
    figures.iter().find(is_meant).unwrap()
}

#[test]
fn a_worse_link_is_found_and_scripts_get_their_exit_code() {
    let record = RunFolder::new("compare");
    let near = "delay = \"5 ms\"";
    let far = "delay = \"15 ms\"\nloss_ratio = 0.2";
    let folders = runs(
        &record,
        &[
            ("near", near),
            ("again", near),
            ("far", far),
            ("farther", far),
        ],
    );
    let [near, again, far, farther] = [0, 1, 2, 3].map(|index: usize| folders[index].as_path());
    let (code, text, error) = compare(&["--format", "json"], &[near, far]);
    assert_eq!(code, Some(0), "{error}");
    let json: Value = serde_json::from_str(&text).unwrap();
    for channel in ["shuttle/command", "shuttle/status"] {
        let p50 = found(&json, channel, "p50");
        println!("{channel}: {p50}");
        // A busy host gives the delays of one run more memory than its interval can allow for.
        let (verdict, ratio) = match p50["ratio_interval"]["low"].as_f64() {
            Some(low) => ("slower", low),
            None => ("not_tested", p50["ratio"].as_f64().unwrap()),
        };
        assert_eq!(p50["verdict"], verdict, "{p50}");
        assert!((1.2..4.0).contains(&ratio), "{p50}");
        let loss = found(&json, channel, "loss");
        assert_eq!(loss["verdict"], "loses_more", "{loss}");
        assert!(found(&json, channel, "max")["ratio_interval"].is_null());
    }
    let differences = json["differences"].to_string();
    assert!(
        differences.contains("links.hop.forward.delay"),
        "{differences}"
    );
    check_conditions(near, again, far);
    check_repetitions([near, again], [far, farther]);
    let (code, text, _) = compare(&["--format", "md"], &[near, again]);
    assert_eq!(code, Some(0));
    let loss = "**shuttle/command**\n\n| metric | base | new | new / base | 95 % | verdict |\n|---|---|---|---|---|---|\n\
                | loss | 0.00 % | 0.00 % | +0.000 pp | unavailable | not tested |";
    assert!(text.contains(loss), "{text}");
    let lines: Vec<&str> = text.lines().collect();
    let care = lines.iter().position(|line| *line == "Read with care:");
    let care = care.expect("one run on a side is read with care");
    assert_eq!((lines[care - 1], lines[care + 1]), ("", ""), "{text}");
}

fn check_conditions(near: &Path, again: &Path, far: &Path) {
    for (condition, folders, expected) in [
        ("p50 > 1.2x", [near, far], 1),
        ("p50 > 1.2x", [far, near], 0),
        ("loss > 5pp", [near, far], 1),
        ("loss > 5pp", [near, again], 0),
        ("shuttle/command:loss > 5%", [near, far], 1),
        ("shuttle/command:p50 > 10s", [near, far], 0),
        ("p49 > 1.2x", [near, far], 2),
        ("nowhere:p50 > 1.2x", [near, far], 2),
        ("p50 > 3%", [near, far], 2),
        ("p50 > 3", [near, far], 2),
        ("max > 1.5x", [near, far], 2),
    ] {
        let (code, text, error) = compare(&["--fail-if", condition], &folders);
        assert_eq!(code, Some(expected), "{condition}: {text}{error}");
    }
    let (code, ..) = compare(&["--fail-if", "max > 0.1x", "--strict"], &[near, far]);
    assert_eq!(code, Some(1), "strictly, a maximum can be judged");
    let (_, text, _) = compare(&["--fail-if", "shuttle/command:p50 > 1 s"], &[near, far]);
    let judged = text
        .lines()
        .find(|line| line.trim_start().starts_with("passes: "));
    assert!(judged.unwrap().ends_with(" s)"), "{text}");
    let (code, _, error) = compare(&[], &[near, Path::new("/nowhere")]);
    assert_eq!(code, Some(2));
    assert!(error.contains("/nowhere/summary.json"), "{error}");
    let (code, ..) = compare(&[], &[near]);
    assert_eq!(code, Some(2), "one run is none to compare");
}

fn check_repetitions(base: [&Path; 2], new: [&Path; 2]) {
    let path = |path: &Path| path.to_str().unwrap().to_owned();
    let arguments = [
        "--base".to_owned(),
        path(base[0]),
        path(base[1]),
        "--new".to_owned(),
        path(new[0]),
        path(new[1]),
        "--format".to_owned(),
        "json".to_owned(),
    ];
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let (code, text, error) = compare(&arguments, &[]);
    assert_eq!(code, Some(0), "{error}");
    let json: Value = serde_json::from_str(&text).unwrap();
    let p50 = found(&json, "shuttle/command", "p50");
    assert!(p50["method"].as_str().unwrap().contains("Welch"), "{p50}");
    assert!(p50["ratio"].as_f64().unwrap() > 1.2, "{p50}");
    assert!(!json["cautions"].to_string().contains("one run on a side"));
}
