//! The house rules that no compiler checks: sizes, file headers, purity, `unsafe`, unfinished work
//! and which crate may know which. Every rule is tried on a planted fault as well.

#![allow(clippy::unwrap_used, reason = "tests")]

use std::fs;

use hil_tests::binary::workspace_folder;
use hil_tests::source_tree::{SourceFile, lines_with_word, workspace_sources};

const FILE_LINES_MAX: usize = 500;
const FUNCTION_LINES_MAX: usize = 70;

/// Folders that compute and touch nothing.
const PURE_FOLDERS: [&str; 2] = ["models/src", "gateways/src/protocol"];
/// What would give a pure folder a clock, a file, a socket, a thread or a random order.
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
const UNSAFE_FILES: [&str; 9] = [
    "gateways/src/transport/bpf_call.rs",
    "gateways/src/transport/card_clock.rs",
    "gateways/src/transport/packet_ring.rs",
    "gateways/src/transport/packet_socket.rs",
    "gateways/src/transport/tcp/info.rs",
    "gateways/src/transport/timestamping.rs",
    "runtime/src/shm/raw.rs",
    "runtime/src/shm/ports.rs",
    "runtime/src/platform/realtime.rs",
];

/// Packages each crate must not depend on: the arrows of the architecture.
const FORBIDDEN_DEPENDENCIES: [(&str, &[&str]); 3] = [
    (
        "models",
        &[
            "hil-gateways",
            "hil-runtime",
            "iceoryx2",
            "nix",
            "libc",
            "socket2",
        ],
    ),
    ("gateways", &["hil-runtime", "iceoryx2"]),
    // Nothing of the recorder may get into the real-time binary.
    ("runtime", &["hil-recorder", "foxglove", "mcap", "tokio"]),
];
/// Folders within a crate with the modules they must not name, not even in their tests.
const FORBIDDEN_MODULES: [(&str, &str); 2] = [
    ("models/src/egm", "teleoperation"),
    ("models/src/yumi", "teleoperation"),
];
const MEMBERS: [&str; 7] = [
    "models",
    "gateways",
    "runtime",
    "runtime/recorder",
    "tests",
    "tests/decoders",
    "benches",
];

type Rule = fn(&SourceFile) -> Vec<String>;

fn short_file(file: &SourceFile) -> Vec<String> {
    let line_count = file.text.lines().count();
    let is_long = line_count > FILE_LINES_MAX;
    is_long
        .then(|| format!("{line_count} lines, at most {FILE_LINES_MAX}"))
        .into_iter()
        .collect()
}

fn header(file: &SourceFile) -> Vec<String> {
    let has_header = file.text.starts_with("//! ");
    let complaint = "does not start with `//!` and what the file is";
    (!has_header)
        .then(|| complaint.to_owned())
        .into_iter()
        .collect()
}

fn short_functions(file: &SourceFile) -> Vec<String> {
    let long = file
        .functions()
        .into_iter()
        .filter(|f| f.line_count > FUNCTION_LINES_MAX);
    long.map(|f| {
        let (line, name, count) = (f.line, f.name, f.line_count);
        format!("line {line}: `{name}` has {count} lines, at most {FUNCTION_LINES_MAX}")
    })
    .collect()
}

fn purity(file: &SourceFile) -> Vec<String> {
    if !PURE_FOLDERS.iter().any(|folder| file.is_under(folder)) {
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
                .map(move |line| format!("line {line}: `{word}` in a pure folder"))
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
    let lines = file.lines_with_word("unsafe");
    lines
        .into_iter()
        .map(|line| format!("line {line}: `unsafe` in an unlisted file"))
        .collect()
}

fn modules_depend_downwards(file: &SourceFile) -> Vec<String> {
    let rules = FORBIDDEN_MODULES.iter();
    let own = rules.filter(|(folder, _)| file.is_under(folder));
    own.flat_map(|(folder, module)| {
        let lines = file.lines_with_word(module);
        lines
            .into_iter()
            .map(move |line| format!("line {line}: `{module}` in {folder}"))
    })
    .collect()
}

fn finished(file: &SourceFile) -> Vec<String> {
    let macros = ["todo!", "unimplemented!"].map(|word| (word, file.lines_with_word(word)));
    let marks = ["TODO", "FIXME", "XXX"].map(|word| (word, lines_with_word(&file.comments, word)));
    let found = macros.into_iter().chain(marks);
    found
        .flat_map(|(word, lines)| {
            lines
                .into_iter()
                .map(move |line| format!("line {line}: unfinished (`{word}`)"))
        })
        .collect()
}

/// The dependencies of a manifest: name and the rest of the line.
fn dependencies(manifest: &str) -> Vec<(String, String)> {
    let mut is_in_list = false;
    let mut found = Vec::new();
    for line in manifest.lines().map(str::trim) {
        if line.starts_with('[') {
            is_in_list = line.trim_matches(['[', ']']).ends_with("dependencies");
        } else if is_in_list && !line.is_empty() && !line.starts_with('#') {
            let (name, rest) = line.split_at(line.find(['.', ' ', '=']).unwrap_or(line.len()));
            found.push((name.to_owned(), rest.trim().to_owned()));
        }
    }
    found
}

fn manifest_faults(member: &str, manifest: &str) -> Vec<String> {
    let forbidden = FORBIDDEN_DEPENDENCIES
        .iter()
        .find(|(name, _)| *name == member);
    let mut faults = Vec::new();
    for (name, rest) in dependencies(manifest) {
        // Some crates come in parts: `iceoryx2-bb-posix` is `iceoryx2` too.
        let is_forbidden = forbidden.is_some_and(|(_, list)| {
            list.iter()
                .any(|other| name == *other || name.starts_with(&format!("{other}-")))
        });
        if is_forbidden {
            faults.push(format!("{member} must not depend on {name}"));
        }
        if !rest.replace(' ', "").contains("workspace=true") {
            faults.push(format!(
                "{member}: {name} does not take the workspace's version"
            ));
        }
    }
    if !manifest
        .replace(' ', "")
        .contains("[lints]\nworkspace=true")
    {
        faults.push(format!("{member} does not take the workspace's lints"));
    }
    faults
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

fn read(path: &str) -> String {
    fs::read_to_string(workspace_folder().join(path)).unwrap()
}

#[test]
fn no_file_is_longer_than_500_lines() {
    check_tree(short_file);
    check_snippet(short_file, "a.rs", &"x\n".repeat(500), 0);
    check_snippet(short_file, "a.rs", &"x\n".repeat(501), 1);
}

#[test]
fn every_file_says_what_it_is() {
    check_tree(header);
    check_snippet(header, "a.rs", "//! A file.\n", 0);
    check_snippet(header, "a.rs", "// A file.\n", 1);
    check_snippet(header, "a.rs", "\n//! Late.\n", 1);
    check_snippet(header, "a.rs", "", 1);
}

#[test]
fn no_function_is_longer_than_70_lines() {
    check_tree(short_functions);
    let function = |count| format!("fn a() {{\n{}}}\n", "    b();\n".repeat(count));
    check_snippet(short_functions, "a.rs", &function(70), 0);
    check_snippet(short_functions, "a.rs", &function(71), 1);
}

#[test]
fn the_pure_folders_touch_nothing() {
    check_tree(purity);
    for word in IMPURE_WORDS {
        let text = format!("use {word}x;\nlet a = {word};");
        let faults = purity(&SourceFile::new("models/src/a.rs", &text));
        assert!(!faults.is_empty(), "{word} was not found");
    }
    let clock = "let t = std::time::Instant::now();";
    check_snippet(purity, "gateways/src/protocol/a.rs", clock, 1);
    check_snippet(purity, "models/src/a.rs", "use std::{fs, thread};", 2);
    check_snippet(
        purity,
        "models/src/a.rs",
        "// no std::fs here\nlet a = \"std::fs\";",
        0,
    );
    check_snippet(purity, "runtime/src/a.rs", clock, 0);
    check_snippet(purity, "gateways/src/transport/a.rs", clock, 0);
}

#[test]
fn unsafe_stays_in_the_listed_files() {
    check_tree(unsafe_only_where_listed);
    let text = "#![deny(unsafe_code)]\nunsafe { a() }\n";
    check_snippet(unsafe_only_where_listed, "models/src/a.rs", text, 1);
    check_snippet(
        unsafe_only_where_listed,
        "runtime/src/platform/realtime.rs",
        text,
        0,
    );
    check_snippet(
        unsafe_only_where_listed,
        "models/src/a.rs",
        "// unsafe is far\n",
        0,
    );
}

#[test]
fn the_protocol_and_the_arm_know_no_case() {
    check_tree(modules_depend_downwards);
    let text = "//! teleoperation uses it.\nuse crate::teleoperation::Goal;\n";
    for (path, fault_count) in [
        ("models/src/egm/controller/tests/a.rs", 1),
        ("models/src/yumi/a.rs", 1),
        ("models/src/teleoperation/a.rs", 0),
    ] {
        check_snippet(modules_depend_downwards, path, text, fault_count);
    }
}

#[test]
fn nothing_is_left_unfinished() {
    check_tree(finished);
    check_snippet(finished, "a.rs", "fn a() { todo!() }", 1);
    check_snippet(finished, "a.rs", "fn a() { unimplemented!(\"later\") }", 1);
    check_snippet(finished, "a.rs", "// TODO: later\n/* FIXME */", 2);
    check_snippet(finished, "a.rs", "let a = \"TODO\";", 0);
}

#[test]
fn crates_depend_downwards_and_on_workspace_versions() {
    for member in MEMBERS {
        let faults = manifest_faults(member, &read(&format!("{member}/Cargo.toml")));
        assert!(faults.is_empty(), "\n{}", faults.join("\n"));
    }
    let lints = "[lints]\nworkspace = true\n";
    for (member, list, fault_count) in [
        ("models", "[dependencies]\nserde.workspace = true\n", 0),
        (
            "models",
            "[dependencies]\nhil-runtime.workspace = true\n",
            1,
        ),
        (
            "models",
            "[dev-dependencies]\niceoryx2-bb-posix = { workspace = true }\n",
            1,
        ),
        (
            "gateways",
            "[dependencies]\nhil-models.workspace = true\n",
            0,
        ),
        (
            "gateways",
            "[dependencies]\nhil-runtime.workspace = true\n",
            1,
        ),
        ("runtime", "[dependencies]\nserde = \"1\"\n", 1),
        (
            "runtime",
            "[target.'cfg(unix)'.dependencies]\nserde = { version = \"1\" }\n",
            1,
        ),
    ] {
        let faults = manifest_faults(member, &format!("{list}\n{lints}"));
        assert_eq!(
            faults.len(),
            fault_count,
            "{member}: {list:?} gave {faults:?}"
        );
    }
    assert_eq!(manifest_faults("runtime", "[dependencies]\n").len(), 1);
}

#[test]
fn the_lints_that_keep_functions_short_are_on() {
    let manifest = read("Cargo.toml");
    for lint in [
        "too_many_lines = \"warn\"",
        "unsafe_code = \"deny\"",
        "missing_docs = \"warn\"",
    ] {
        assert!(manifest.contains(lint), "the workspace's lints lack {lint}");
    }
    for path in ["clippy.toml", "models/clippy.toml"] {
        let text = read(path);
        let threshold = format!("too-many-lines-threshold = {FUNCTION_LINES_MAX}");
        assert!(text.contains(&threshold), "{path} lacks {threshold}");
    }
}

/// What a file of the live page does wrong: too long, silent about itself, or naming another place.
fn page_faults(name: &str, text: &str) -> Vec<String> {
    let starts: &[&str] = match name.rsplit_once('.').map(|(_, ending)| ending) {
        Some("html") => &["<!DOCTYPE html>\n<!-- "],
        Some("css") => &["/* "],
        Some("js") => &["// "],
        _ => &[],
    };
    let mut faults = Vec::new();
    if !starts.iter().any(|start| text.starts_with(start)) {
        faults.push(format!("{name} does not begin by saying what it is"));
    }
    let line_count = text.lines().count();
    if line_count > FILE_LINES_MAX {
        faults.push(format!("{name} has {line_count} lines"));
    }
    for word in ["http://", "https://", "@import", "eval(", "innerHTML"] {
        if text.contains(word) {
            faults.push(format!("{name} has {word}"));
        }
    }
    faults
}

#[test]
fn the_live_page_is_short_files_of_its_own() {
    let folder = workspace_folder().join("runtime/recorder/page");
    let mut faults = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        faults.extend(page_faults(&name, &fs::read_to_string(&path).unwrap()));
    }
    assert!(faults.is_empty(), "{faults:#?}");
    assert!(page_faults("a.js", "// A script.\n").is_empty());
    for (name, text) in [
        ("a.js", "let x;\n"),
        ("a.css", "body {}\n"),
        ("a.html", "<html>\n"),
        ("a.svg", "<svg/>\n"),
        ("a.js", "// A script.\nimport \"https://x.example/y.js\";\n"),
    ] {
        assert_eq!(page_faults(name, text).len(), 1, "{name}: {text}");
    }
}
