//! The JSON Schema of topology files, judged by a validator nobody here wrote: `HIL_MCAP_PYTHON` names a
//! Python with `tests/mcap_reader/requirements.txt`. Every shipped topology fits; what the reader refuses as
//! unknown, mistyped or out of range does not.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

use hil_tests::binary::{hil_runtime_binary, workspace_folder};
use hil_tests::mcap_file::PYTHON_VARIABLE;
use hil_tests::run_folder::RunFolder;
use serde_json::Value;

/// What a file may hold, and what of it the schema refuses.
const WRONG: [(&str, &str); 8] = [
    ("run.duratoin = \"4 s\"", "duratoin"),
    ("run.duration = \"4 parsecs\"", "parsecs"),
    ("run.seed = -1", "minimum"),
    ("links.hop.via = \"pigeon\"", "pigeon"),
    ("links.hop.port = 99999", "maximum"),
    ("links.hop.forward.delay = { law = \"tea\" }", "tea"),
    ("processes.\"a b\".role = \"robot\"", "a b"),
    ("security.hops = true", "True"),
];
/// What it may hold as well.
const RIGHT: [&str; 5] = [
    "case = { name = \"x\", parameters = { anything = { at = [\"all\"] } } }",
    "links.hop = { delay = \"1.5 ms\", backward = { delay = { law = \"normal\", mean = \"2 ms\" } } }",
    "links.hop.wifi = { preset = \"wifi6-long-range\", outages = { mean = \"1 s\" } }",
    "links.hop.trace = { files = { \"a/b\" = \"c.csv\" }, match = \"tick\" }",
    "processes.robot = { cpu = [1, 2], env = { A = \"b\" }, scheduling = \"fifo\" }",
];

fn shipped() -> Vec<PathBuf> {
    let folder = fs::read_dir(workspace_folder().join("deploy/topologies")).unwrap();
    let paths = folder.map(|entry| entry.unwrap().path());
    paths
        .filter(|path| path.extension().is_some_and(|kind| kind == "toml"))
        .collect()
}

fn written(folder: &RunFolder) -> PathBuf {
    let mut command = Command::new(hil_runtime_binary());
    let output = command
        .arg("documents")
        .arg(folder.path())
        .output()
        .unwrap();
    assert!(output.status.success(), "{output:?}");
    folder.join("schema/topology.schema.json")
}

/// What is wrong with each file.
fn judged(python: &str, schema: &Path, files: &[PathBuf]) -> Value {
    let script = workspace_folder().join("tests/mcap_reader/schema.py");
    let mut command = Command::new(python);
    let output = command
        .arg(script)
        .arg(schema)
        .args(files)
        .output()
        .unwrap();
    let words = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{words}");
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn every_shipped_topology_fits_the_schema_and_a_wrong_one_does_not() {
    let folder = RunFolder::new("schema");
    let schema = written(&folder);
    let text = fs::read_to_string(&schema).unwrap();
    assert!(text.contains("bad_loss_ratio"), "{text}");
    let python = env::var(PYTHON_VARIABLE).ok();
    let Some(python) = python.filter(|name| !name.is_empty()) else {
        println!("skipped: {PYTHON_VARIABLE} names no Python with jsonschema");
        return;
    };
    let mut right = shipped();
    assert!(right.len() > 10, "{right:?}");
    for (number, text) in RIGHT.iter().enumerate() {
        right.push(folder.write(format!("right-{number}.toml"), text));
    }
    let found = judged(&python, &schema, &right);
    for path in &right {
        let faults = found[path.to_str().unwrap()].as_array().unwrap();
        assert!(faults.is_empty(), "{}: {faults:?}", path.display());
    }
    let named = |(number, (text, _)): (usize, &(&str, &str))| {
        folder.write(format!("wrong-{number}.toml"), text)
    };
    let wrong: Vec<PathBuf> = WRONG.iter().enumerate().map(named).collect();
    let found = judged(&python, &schema, &wrong);
    for (path, (text, word)) in wrong.iter().zip(WRONG) {
        let faults = found[path.to_str().unwrap()].to_string();
        assert!(faults.contains(word), "{text}: {faults}");
    }
    println!(
        "{} files fit the schema, {} do not",
        right.len(),
        wrong.len()
    );
}
