//! Reports as files, made by the binary from runs of its own: live, in virtual time, torn and hostile.
//! No browser is needed: a page must be whole without one.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use hil_tests::binary::hil_runtime as run;
use hil_tests::child::{ChildGuard, Finished};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{Trial, shipped_topology};
use serde_json::Value;

const LIMIT: Duration = Duration::from_mins(2);

fn report(arguments: &[&Path]) -> Finished {
    run(&[&[Path::new("report")], arguments].concat())
}

fn live_shuttle(record: &RunFolder) -> PathBuf {
    let trial = Trial::shipped("shuttle-local.toml", record.path());
    let mut command = trial.set("run.duration=\"1 s\"").command_here();
    let mut child = ChildGuard::spawn(&mut command).unwrap();
    child.wait_within(LIMIT).unwrap().assert_success();
    let mut folders = fs::read_dir(record.path()).unwrap();
    folders.next().unwrap().unwrap().path()
}

fn simulated(record: &RunFolder, topology: &str) -> PathBuf {
    let folder = record.join("simulated");
    let topology = shipped_topology(topology);
    let words = ["simulate", "--set", "run.duration=\"12 s\"", "--topology"].map(Path::new);
    let rest = [topology.as_path(), Path::new("--output"), &folder];
    run(&[words.as_slice(), rest.as_slice()].concat()).assert_success();
    folder
}

fn page(folders: &[&Path], output: &Path) -> String {
    let made = report(&[folders, &[Path::new("-o"), output]].concat());
    made.assert_success();
    let text = fs::read_to_string(output).unwrap();
    assert_whole(&text);
    text
}

/// Elements nest and end, nothing comes from elsewhere, and all that is to be read is there before
/// the first script.
fn assert_whole(page: &str) {
    let mut open: Vec<&str> = Vec::new();
    let mut rest = page;
    while let Some(at) = rest.find('<') {
        rest = &rest[at + 1..];
        let end = rest.find('>').unwrap();
        let tag = &rest[..end];
        if tag.starts_with('!') || tag.ends_with('/') {
            rest = &rest[end + 1..];
            continue;
        }
        let name = tag.split_whitespace().next().unwrap();
        rest = &rest[end + 1..];
        if let Some(name) = name.strip_prefix('/') {
            assert_eq!(open.pop(), Some(name), "before {:?}", rest.get(..60));
            continue;
        }
        if name == "script" || name == "style" {
            rest = &rest[rest.find(&format!("</{name}")).unwrap()..];
        }
        open.push(name);
    }
    assert!(open.is_empty(), "{open:?}");
    for word in [
        "https://",
        " src=",
        "@import",
        "fetch(",
        "XMLHttpRequest",
        "NaN",
    ] {
        assert!(!page.contains(word), "{word}");
    }
    let names = page.matches("xmlns=\"http://www.w3.org/2000/svg\"").count();
    assert_eq!(page.matches("http://").count(), names);
    let (before, _) = page.split_once("<script").unwrap();
    assert!(before.contains("Repeat this run"));
    assert!(page.len() < 2_000_000, "{}", page.len());
}

#[test]
fn a_live_run_becomes_a_page_with_the_figures_of_its_summary() {
    let record = RunFolder::new("report-live");
    let folder = live_shuttle(&record);
    let output = record.join("report.html");
    let text = page(&[&folder], &output);
    let summary: Value =
        serde_json::from_str(&fs::read_to_string(folder.join("summary.json")).unwrap()).unwrap();
    let published = summary["channels"][0]["account"]["published_count"].to_string();
    for words in [
        published.as_str(),
        "shuttle/command",
        "completed",
        "error of the cart",
        "shared memory",
    ] {
        assert!(text.contains(words), "{words}");
    }
    assert!(
        text.matches("<svg").count() >= 5,
        "waterfall, distributions and histograms"
    );
    // Its own page it may replace, anything else it may not.
    page(&[&folder], &output);
    fs::write(&output, "a letter").unwrap();
    let refused = report(&[&folder, Path::new("-o"), &output]);
    assert_eq!(refused.status.code(), Some(2), "{refused:?}");
    assert!(refused.stderr.contains("--force"), "{refused:?}");
    assert_eq!(fs::read_to_string(&output).unwrap(), "a letter");
    report(&[&folder, Path::new("-o"), &output, Path::new("--force")]).assert_success();
    let left = fs::read_dir(record.path()).unwrap().count();
    assert_eq!(left, 2, "nothing but the run and its page");
}

#[test]
fn a_run_without_summary_series_or_sense_still_becomes_a_page() {
    let record = RunFolder::new("report-torn");
    let folder = live_shuttle(&record);
    let output = record.join("report.html");
    let path = folder.join("summary.json");
    let hostile = "</script><script>alert(1)</script>'\"><img/onerror=alert(1)>&";
    let mut summary: Value = serde_json::from_str(&fs::read_to_string(&path).unwrap()).unwrap();
    summary["run"]["name"] = hostile.into();
    summary["channels"][0]["name"] = hostile.into();
    summary["channels"][1]["account"] = Value::Null;
    fs::write(&path, summary.to_string()).unwrap();
    fs::create_dir_all(folder.join("series")).unwrap();
    fs::write(folder.join("series/bad.csv"), "time_s,a\n0,1\n1,x\n").unwrap();
    let list = r#"[{"name": "bad", "title": "", "notes": [], "row_count": 2, "columns": []}]"#;
    fs::write(folder.join("series/series.json"), list).unwrap();
    let text = page(&[&folder], &output);
    assert!(!text.contains("<img") && text.contains("&lt;img"));
    assert!(text.contains("no records of this channel"));
    assert!(text.contains("series/bad.csv cannot be read: line 3"));
    fs::write(&path, "{ torn").unwrap();
    let torn = report(&[&folder, Path::new("-o"), &output]);
    assert_eq!(torn.status.code(), Some(2), "{torn:?}");
    assert!(torn.stderr.contains("summary.json"), "{torn:?}");
    fs::remove_file(&path).unwrap();
    let text = page(&[&folder], &output);
    assert!(text.contains("unfinished") && text.contains("left no summary"));
    let nothing = report(&[record.path(), Path::new("-o"), &record.join("x.html")]);
    assert_eq!(nothing.status.code(), Some(2), "{nothing:?}");
    assert!(nothing.stderr.contains("not a run's folder"), "{nothing:?}");
}

#[test]
fn virtual_time_becomes_a_page_and_every_other_form() {
    let record = RunFolder::new("report-virtual");
    let teleoperation = simulated(&record, "emulated.toml");
    let output = record.join("report.html");
    let text = page(&[&teleoperation], &output);
    let source: Value =
        serde_json::from_str(&fs::read_to_string(teleoperation.join("summary.json")).unwrap())
            .unwrap();
    let first = &source["network"]["channels"][0];
    assert!(text.contains(first["channel"].as_str().unwrap()));
    for words in [
        "Network and robot over time",
        "The robot, as its case plots it",
        "motion loss rate",
        "unavailable",
    ] {
        assert!(text.contains(words), "{words}");
    }
    let csv = report(&[&teleoperation, Path::new("--format"), Path::new("csv")]);
    csv.assert_success();
    let lost = first["figures"]["loss"]["ratio"].to_string();
    assert!(csv.stdout.contains(&lost), "{lost}: {}", csv.stdout);
    for (name, words) in [
        ("a.md", "| metric | value |"),
        ("a.tex", "\\toprule"),
        ("a.json", "\"schema_version\": 2"),
    ] {
        let path = record.join(name);
        report(&[&teleoperation, Path::new("-o"), &path]).assert_success();
        assert!(fs::read_to_string(&path).unwrap().contains(words), "{name}");
    }
    let template = record.write("own.txt", "{% for run in runs %}{{ run.kind }}{% endfor %}");
    let own = report(&[&teleoperation, Path::new("--template"), &template]);
    own.assert_success();
    assert_eq!(own.stdout.trim(), "virtual");
    let figures = record.join("figures");
    let words = ["--format", "svg", "-o"].map(Path::new);
    report(
        &[
            &[teleoperation.as_path()],
            words.as_slice(),
            &[figures.as_path()],
        ]
        .concat(),
    )
    .assert_success();
    let timeline = fs::read_to_string(figures.join("run-1-timeline.svg")).unwrap();
    assert!(timeline.starts_with("<?xml") && timeline.contains("<style>"));
    let unknown = report(&[&teleoperation, Path::new("-o"), &record.join("report.doc")]);
    assert_eq!(unknown.status.code(), Some(2), "{unknown:?}");
    assert!(unknown.stderr.contains("--format"), "{unknown:?}");
}

#[test]
fn several_runs_share_one_page_with_a_row_each() {
    let record = RunFolder::new("report-several");
    let fleet = simulated(&record, "fleet-emulated.toml");
    let text = page(&[&fleet, &fleet], &record.join("report.html"));
    assert!(text.contains("2 runs") && text.contains("id=\"run-2\""));
    let none = report(&[&fleet, &fleet]);
    assert_eq!(none.status.code(), Some(2), "{none:?}");
    assert!(none.stderr.contains("--output"), "{none:?}");
}
