//! The shuttle case behind an emulated link, as several tests run it, and what a run of it left on
//! record. It starts nothing.

use std::collections::BTreeSet;
use std::fs;

use bytemuck::Pod;
use hil_core::record::{IngressRecord, UNAVAILABLE};
use hil_rundir::record::RecordFile;
use hil_trace::{Trace, wire};

use crate::ports::own_ports;
use crate::trial::RunFiles;

/// The channels that cross the link.
pub const CHANNELS: [&str; 2] = ["shuttle/command", "shuttle/status"];
/// Time from one message of a channel to the next.
pub const PERIOD_NS: i64 = 10_000_000;
/// Seed of the run.
pub const SEED: u64 = 4;

/// A topology called `name` of both channels over the emulated link `hop`, which `link` describes:
/// keys of `[links.hop]` and tables below it. It runs for 12 s, on ports that no other test has.
pub fn emulated_shuttle(name: &str, link: &str) -> String {
    let port = own_ports();
    format!(
        r#"
version = 1
name = "{name}"
run = {{ duration = "12 s", seed = {SEED} }}
case = {{ name = "shuttle", parameters = {{ rate_hz = 100.0 }} }}
hosts = {{ control-pc = {{}}, robot-pc = {{}} }}
processes.controller = {{ role = "controller", host = "control-pc" }}
processes.robot = {{ role = "robot", host = "robot-pc" }}
channels."shuttle/command".link = "hop"
channels."shuttle/status".link = "hop"
[links.hop]
via = "emulated"
between = ["control-pc", "robot-pc"]
port = {port}
{link}
"#
    )
}

/// Every record of `channel` and `kind`, e.g. `ingress`, of all starts of its process.
///
/// # Panics
/// When the records cannot be read.
pub fn records<T: Pod>(files: &RunFiles, channel: &str, kind: &str) -> Vec<T> {
    let start = format!("{}.{kind}.", channel.replace('/', "."));
    let folder = files.root().join("records");
    let entries = match fs::read_dir(&folder) {
        Ok(entries) => entries.flatten(),
        Err(error) => panic!("{}: {error}", folder.display()),
    };
    let mut found = Vec::new();
    for path in entries.map(|entry| entry.path()) {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if name.starts_with(&start) {
            match RecordFile::read(&path) {
                Ok(file) => found.extend(file.records::<T>()),
                Err(error) => panic!("{}: {error}", path.display()),
            }
        }
    }
    found
}

/// The messages of `channel` that the receiving gateway published, by its records alone: start of
/// the producer and sequence number.
///
/// # Panics
/// When the records cannot be read.
pub fn forwarded(files: &RunFiles, channel: &str) -> BTreeSet<(u32, u64)> {
    let records = records::<IngressRecord>(files, channel, "ingress").into_iter();
    let published = records.filter(|one| one.forwarded_ns != UNAVAILABLE);
    published.map(|one| (one.epoch, one.sequence)).collect()
}

/// The trace that a run left of `channel`.
///
/// # Panics
/// When it is not there or not whole.
pub fn trace_of(files: &RunFiles, channel: &str) -> Trace {
    let name = format!("traces/{}.trace", channel.replace('/', "."));
    let path = files.root().join(name);
    let bytes = match fs::read(&path) {
        Ok(bytes) => bytes,
        Err(error) => panic!("{}: {error}", path.display()),
    };
    match wire::decode(&bytes) {
        Ok(decoded) if decoded.fault.is_none() => decoded.trace,
        other => panic!("{}: {other:?}", path.display()),
    }
}
