//! What no compiler checks: pure code touches nothing, `unsafe` stays where it is reviewed, and the crates
//! depend on each other as ARCHITECTURE.md draws it. Every rule is tried on a planted fault as well.

#![allow(clippy::unwrap_used, reason = "tests")]

use std::fs;
use std::path::Path;
use std::process::Command;

use hil_tests::binary::workspace_folder;
use hil_tests::source_tree::{SourceFile, lines_with_word, workspace_sources};
use serde_json::{Value, json};

/// What would give pure code a clock, a file, a socket, a thread or a random order.
const IMPURE_WORDS: [&str; 15] = [
    "std::net",
    "std::fs",
    "std::io::",
    "std::thread",
    "std::process",
    "std::env",
    "Instant::now",
    "SystemTime",
    "nix::",
    "libc::",
    "socket2::",
    "iceoryx2::",
    "HashMap",
    "HashSet",
    "println!",
];
/// The only files that may hold `unsafe`, each for a kernel or shared-memory border.
const UNSAFE_FILES: [&str; 12] = [
    "gateways/net/src/handover.rs",
    "gateways/net/src/nic_clock.rs",
    "gateways/net/src/offload.rs",
    "gateways/net/src/packet_ring.rs",
    "gateways/net/src/packet_socket.rs",
    "gateways/net/src/tcp_info.rs",
    "gateways/net/src/timestamping.rs",
    "runtime/platform/src/file_window.rs",
    "runtime/platform/src/open_files.rs",
    "runtime/platform/src/realtime.rs",
    "runtime/platform/src/signals.rs",
    "runtime/shm/src/raw.rs",
];
/// What tells the wall clock's time or a file's by it. Somebody may set that clock, so nothing is awaited or
/// judged by it: these files name a run, or stamp what people or other programs read.
const WALL_CLOCK_WORDS: [&str; 5] = [
    "SystemTime",
    "modified()",
    "created()",
    "accessed()",
    "st_mtime",
];
const WALL_CLOCK_FILES: [&str; 6] = [
    "runtime/engine/src/supervisor/session.rs",
    "runtime/probe/src/live.rs",
    "runtime/recorder/src/serve/engine.rs",
    "runtime/rundir/src/announcement.rs",
    "runtime/rundir/src/manifest.rs",
    "runtime/rundir/src/run_folder.rs",
];

type Rule = fn(&SourceFile) -> Vec<String>;

/// All of `models` computes, and so does the protocol.
fn is_pure(path: &str) -> bool {
    let path = Path::new(path);
    let is_source = path.iter().any(|part| part == "src");
    is_source && (path.starts_with("models") || path.starts_with("gateways/protocol"))
}

fn purity(file: &SourceFile) -> Vec<String> {
    if !is_pure(&file.path) {
        return Vec::new();
    }
    // `use std::{fs, io}` says the same in fewer words.
    let flat = flatten_imports(&file.code);
    let words = IMPURE_WORDS.iter();
    words
        .flat_map(|word| {
            let lines = lines_with_word(&flat, word);
            lines
                .into_iter()
                .map(move |line| format!("line {line}: `{word}` in pure code"))
        })
        .collect()
}

/// `use std::{fs, io::Read}` on one line as `std::fs std::io::Read`; other lines unchanged.
fn flatten_imports(code: &str) -> String {
    let lines = code.lines().map(|line| match line.split_once("std::{") {
        Some((_, list)) => {
            let parts: Vec<&str> = list.split([',', '{', '}', ';']).map(str::trim).collect();
            format!("std::{}", parts.join(" std::"))
        }
        None => line.to_owned(),
    });
    lines.collect::<Vec<String>>().join("\n")
}

fn unsafe_only_where_listed(file: &SourceFile) -> Vec<String> {
    if UNSAFE_FILES.contains(&file.path.as_str()) {
        return Vec::new();
    }
    let lines = lines_with_word(&file.code, "unsafe");
    lines
        .into_iter()
        .map(|line| format!("line {line}: `unsafe` in an unlisted file"))
        .collect()
}

fn wall_clock_only_where_listed(file: &SourceFile) -> Vec<String> {
    let path = Path::new(&file.path);
    let is_ours = ["gateways", "runtime"]
        .iter()
        .any(|top| path.starts_with(top));
    if !is_ours || WALL_CLOCK_FILES.contains(&file.path.as_str()) {
        return Vec::new();
    }
    let found = WALL_CLOCK_WORDS.iter().flat_map(|word| {
        let lines = lines_with_word(&file.code, word).into_iter();
        lines.map(move |line| format!("line {line}: `{word}` in an unlisted file"))
    });
    found.collect()
}

fn check_tree(rule: Rule) {
    let complain = |file: SourceFile| {
        let complaints = rule(&file);
        complaints
            .into_iter()
            .map(move |complaint| format!("{}: {complaint}", file.path))
    };
    let faults: Vec<String> = workspace_sources().into_iter().flat_map(complain).collect();
    assert!(faults.is_empty(), "\n{}", faults.join("\n"));
}

fn check_snippet(rule: Rule, path: &str, text: &str, fault_count: usize) {
    let faults = rule(&SourceFile::new(path, text));
    assert_eq!(
        faults.len(),
        fault_count,
        "{path}: {text:?} gave {faults:?}"
    );
}

#[test]
fn pure_code_touches_nothing() {
    check_tree(purity);
    for word in IMPURE_WORDS {
        let text = format!("use {word}x;\nlet a = {word};");
        let faults = purity(&SourceFile::new("models/core/src/a.rs", &text));
        assert!(!faults.is_empty(), "{word} was not found");
    }
    let clock = "let t = std::time::Instant::now();";
    for (path, fault_count) in [
        ("models/core/src/link/a.rs", 1),
        ("gateways/protocol/src/a.rs", 1),
        ("gateways/net/src/a.rs", 0),
        ("runtime/engine/src/a.rs", 0),
        ("models/build.rs", 0),
    ] {
        check_snippet(purity, path, clock, fault_count);
    }
    check_snippet(purity, "models/core/src/a.rs", "use std::{fs, thread};", 2);
    let words = "// no std::fs here\nlet a = \"std::fs\";";
    check_snippet(purity, "models/core/src/a.rs", words, 0);
}

#[test]
fn nothing_waits_or_judges_by_the_wall_clock() {
    check_tree(wall_clock_only_where_listed);
    let text = "let age = SystemTime::now();\nlet other = data.modified()?;\n";
    for (path, fault_count) in [
        ("runtime/shm/src/domain.rs", 2),
        ("gateways/net/src/a.rs", 2),
        ("runtime/rundir/src/manifest.rs", 0),
        ("tests/src/child.rs", 0),
    ] {
        check_snippet(wall_clock_only_where_listed, path, text, fault_count);
    }
}

#[test]
fn unsafe_stays_in_the_listed_files() {
    check_tree(unsafe_only_where_listed);
    let text = "#![deny(unsafe_code)]\nunsafe { a() }\n";
    for (path, fault_count) in [
        ("models/core/src/a.rs", 1),
        ("runtime/engine/src/realtime.rs", 1),
        ("runtime/platform/src/realtime.rs", 0),
    ] {
        check_snippet(unsafe_only_where_listed, path, text, fault_count);
    }
    let comment = "// unsafe is far\n";
    check_snippet(unsafe_only_where_listed, "models/core/src/a.rs", comment, 0);
}

/// What cargo knows of the workspace's own packages.
fn metadata() -> Value {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let output = Command::new(cargo)
        .current_dir(workspace_folder())
        .args([
            "metadata",
            "--no-deps",
            "--offline",
            "--format-version",
            "1",
        ])
        .output()
        .unwrap();
    let words = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{words}");
    serde_json::from_slice(&output.stdout).unwrap()
}

fn packages(metadata: &Value) -> &[Value] {
    metadata["packages"].as_array().unwrap()
}

fn name(value: &Value) -> &str {
    value["name"].as_str().unwrap()
}

/// A line for each crate of the workspace with those it is built from, tests aside: `name: dep dep`, sorted,
/// without `hil-`.
fn crates_of(metadata: &Value) -> Vec<String> {
    let members: Vec<&str> = packages(metadata).iter().map(name).collect();
    let mut lines: Vec<String> = packages(metadata)
        .iter()
        .map(|package| {
            let all = package["dependencies"].as_array().unwrap().iter();
            // Those of tests and of build scripts have a kind.
            let normal = all.filter(|one| one["kind"].is_null()).map(name);
            let mut own: Vec<&str> = normal.filter(|name| members.contains(name)).collect();
            own.sort_unstable();
            let words: Vec<&str> = own.into_iter().map(short).collect();
            format!("{}: {}", short(name(package)), words.join(" "))
        })
        .map(|line| line.trim_end().to_owned())
        .collect();
    lines.sort_unstable();
    lines
}

fn short(name: &str) -> &str {
    name.strip_prefix("hil-").unwrap_or(name)
}

/// The lines of the fenced block whose language is `crates`.
fn crates_drawn_in(document: &str) -> Vec<String> {
    let (_, rest) = document
        .split_once("```crates\n")
        .expect("a block of crates");
    let (block, _) = rest.split_once("```").expect("the end of the block");
    block.lines().map(str::to_owned).collect()
}

#[test]
fn the_crates_depend_on_each_other_as_drawn() {
    let document = fs::read_to_string(workspace_folder().join("ARCHITECTURE.md")).unwrap();
    let found = crates_of(&metadata());
    let text = found.join("\n");
    assert_eq!(
        crates_drawn_in(&document),
        found,
        "ARCHITECTURE.md should draw\n```crates\n{text}\n```\n"
    );
}

#[test]
fn a_dependency_that_is_not_drawn_is_seen() {
    let dependency = |name: &str, kind: Value| json!({ "name": name, "kind": kind });
    let graph = |of_models: Value| {
        let gateways = [
            dependency("socket2", Value::Null),
            dependency("hil-models", Value::Null),
            dependency("hil-tests", json!("dev")),
        ];
        json!({ "packages": [
            { "name": "hil-models", "dependencies": of_models },
            { "name": "hil-gateways", "dependencies": gateways },
            { "name": "hil-tests", "dependencies": [] },
        ] })
    };
    let drawn = crates_drawn_in(
        "# A\n\n```crates\ngateways: models\nmodels:\ntests:\n```\n\n```\nx\n```\n",
    );
    assert_eq!(crates_of(&graph(json!([]))), drawn);
    let back = json!([dependency("hil-gateways", Value::Null)]);
    assert_ne!(crates_of(&graph(back)), drawn);
}

#[test]
fn every_crate_takes_the_workspaces_lints() {
    for package in packages(&metadata()) {
        let manifest = fs::read_to_string(package["manifest_path"].as_str().unwrap()).unwrap();
        let has_lints = manifest.contains("[lints]\nworkspace = true");
        assert!(has_lints, "{} does not", name(package));
    }
}
