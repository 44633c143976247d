//! The example runs as its page says: in virtual time, and as processes on this machine.

#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::{env, fs, process};

use serde_json::Value;

fn folder() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// A folder of the test's own.
fn scratch(name: &str) -> PathBuf {
    let folder = env::temp_dir().join(format!("hil-cart-{name}-{}", process::id()));
    fs::create_dir_all(&folder).unwrap();
    folder
}

#[track_caller]
fn cart(place: &Path, arguments: &[&str]) -> Output {
    let topology = folder().join("cart.toml");
    let mut command = Command::new(env!("CARGO_BIN_EXE_cart"));
    command.args(arguments).arg("--topology").arg(topology);
    let output = command.current_dir(place).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    output
}

#[track_caller]
fn published_count(summary: &Path, channel: &str) -> u64 {
    let summary: Value = serde_json::from_slice(&fs::read(summary).unwrap()).unwrap();
    let mut channels = summary["channels"].as_array().unwrap().iter();
    let found = channels.find(|one| one["name"] == channel).unwrap();
    found["account"]["published_count"].as_u64().unwrap()
}

#[test]
fn it_runs_in_virtual_time() {
    let place = scratch("virtual");
    cart(&place, &["simulate", "--output", "out"]);
    for channel in ["cart/command", "cart/state"] {
        let count = published_count(&place.join("out/summary.json"), channel);
        assert!(count.abs_diff(500) <= 1, "{count} of {channel}");
    }
    fs::remove_dir_all(&place).unwrap();
}

#[test]
fn it_runs_as_processes_with_the_same_code() {
    let place = scratch("processes");
    cart(&place, &["--quiet", "--set", "run.duration=\"1 s\""]);
    let mut runs = fs::read_dir(place.join("runs")).unwrap();
    let run = runs.next().unwrap().unwrap().path();
    assert!(published_count(&run.join("summary.json"), "cart/state") > 10);
    fs::remove_dir_all(&place).unwrap();
}

#[test]
fn its_page_shows_this_code() {
    let page = fs::read_to_string(folder().join("../../docs/your-own-program.md")).unwrap();
    for file in ["src/main.rs", "cart.toml"] {
        let text = fs::read_to_string(folder().join(file)).unwrap();
        // The page says in prose what a file's own documentation says.
        let code = text.lines().skip_while(|line| line.starts_with("//!"));
        let code = code.collect::<Vec<_>>().join("\n");
        assert!(page.contains(code.trim()), "{file} is not on the page");
    }
}
