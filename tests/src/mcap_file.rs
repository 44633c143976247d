//! An MCAP file as the container's own reader has it, and the commands of `hil-recorder` that make one.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::{env, fs};

use serde_json::Value;

use crate::binary::{hil_recorder_binary, workspace_folder};
use crate::child::ChildGuard;

/// Names the Python to read with.
pub const PYTHON_VARIABLE: &str = "HIL_MCAP_PYTHON";

/// Runs `hil-recorder` to its end.
///
/// # Panics
/// When it cannot be started.
pub fn recorder(arguments: &[&str], paths: &[&Path]) -> Output {
    let mut command = Command::new(hil_recorder_binary());
    command.args(arguments).args(paths);
    match command.output() {
        Ok(output) => output,
        Err(error) => panic!("hil-recorder cannot be started: {error}"),
    }
}

/// Starts `hil-recorder record`.
///
/// # Panics
/// When it cannot be started.
pub fn record(arguments: &[&str], output: &Path) -> ChildGuard {
    let mut command = Command::new(hil_recorder_binary());
    command.arg("record").args(arguments).arg("-o").arg(output);
    match ChildGuard::spawn(&mut command) {
        Ok(recorder) => recorder,
        Err(error) => panic!("hil-recorder cannot be started: {error}"),
    }
}

/// What the file at `path` is called until it is whole.
pub fn partial(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".partial");
    PathBuf::from(name)
}

/// What a program said, on either stream.
pub fn words(output: &Output) -> String {
    let text = [&output.stdout[..], &output.stderr[..]].concat();
    String::from_utf8_lossy(&text).into_owned()
}

/// Checks how a program ended.
///
/// # Panics
/// With what it said, when its exit code is another one.
pub fn assert_code(output: &Output, code: i32) {
    assert_eq!(output.status.code(), Some(code), "{}", words(output));
}

/// Every message by topic.
///
/// # Panics
/// When the file is not whole.
pub fn read_back(file: &Path) -> BTreeMap<String, Vec<mcap::Message<'static>>> {
    let bytes: &'static [u8] = match fs::read(file) {
        Ok(bytes) => bytes.leak(),
        Err(error) => panic!("{}: {error}", file.display()),
    };
    let mut topics: BTreeMap<String, Vec<mcap::Message<'static>>> = BTreeMap::new();
    let messages = match mcap::MessageStream::new(bytes) {
        Ok(messages) => messages,
        Err(error) => panic!("{}: {error}", file.display()),
    };
    for message in messages {
        match message {
            Ok(message) => {
                let topic = message.channel.topic.clone();
                topics.entry(topic).or_default().push(message);
            }
            Err(error) => panic!("{}: {error}", file.display()),
        }
    }
    topics
}

/// Messages by topic.
///
/// # Panics
/// As [`read_back`].
pub fn counts(file: &Path) -> BTreeMap<String, u64> {
    let topics = read_back(file).into_iter();
    topics
        .map(|(topic, messages)| (topic, messages.len() as u64))
        .collect()
}

/// What the file says of itself: its metadata, by record and key.
///
/// # Panics
/// When the file is not whole.
pub fn metadata(file: &Path) -> BTreeMap<String, BTreeMap<String, String>> {
    let read = || -> Result<_, Box<dyn std::error::Error>> {
        let bytes = fs::read(file)?;
        let mut found = BTreeMap::new();
        for record in mcap::read::LinearReader::new(&bytes)? {
            if let mcap::records::Record::Metadata(one) = record? {
                found.insert(one.name, one.metadata);
            }
        }
        Ok(found)
    };
    match read() {
        Ok(found) => found,
        Err(error) => panic!("{}: {error}", file.display()),
    }
}

/// What the Python packages make of the file; `None`, with the reason printed, where none is named.
///
/// # Panics
/// When Python is named and cannot read it.
#[allow(clippy::print_stderr, reason = "what is left out is said")]
pub fn python(file: &Path, topics: &[&str]) -> Option<Value> {
    let python = env::var(PYTHON_VARIABLE)
        .ok()
        .filter(|name| !name.is_empty());
    let Some(python) = python else {
        eprintln!("read in Rust only: {PYTHON_VARIABLE} names no Python with mcap");
        return None;
    };
    let mut command = Command::new(python);
    let script = workspace_folder().join("tests/mcap_reader/read.py");
    command.env("PYTHONDONTWRITEBYTECODE", "1").arg(script);
    match command.arg(file).args(topics).output() {
        Ok(output) => {
            assert!(output.status.success(), "{}", words(&output));
            serde_json::from_slice(&output.stdout).ok()
        }
        Err(error) => panic!("Python cannot be started: {error}"),
    }
}
