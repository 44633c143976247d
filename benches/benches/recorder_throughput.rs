//! Whether a live recorder on one processor keeps up: twenty channels at 1 kHz each, of 200-byte messages
//! that nobody records, so that every one of them has to come out of shared memory before it is
//! replaced. One process publishes, the recorder is pinned to another processor. It says what was
//! missed and what share of its processor the recorder took, and ends with code 1 when anything was
//! missed.
//!
//! `cargo bench -p hil-benches --bench recorder_throughput -- [--seconds N] [--cpu N]`
#![allow(clippy::print_stdout, reason = "a bench prints its result")]

use std::collections::BTreeMap;
use std::error::Error;
use std::fs;
use std::path::Path;
use std::process::{Command, ExitCode, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use hil_models::message::Envelope;
use hil_runtime::platform::clock::MonotonicClock;
use hil_runtime::rundir::live_run::{LIVE_VERSION, LiveChannel, LiveRun, Source};
use hil_runtime::shm::observer_depth;
use hil_runtime::shm::{ChannelHolder, ChannelSettings, Domain, RawOutput, TypeInfo};
use hil_tests::binary::hil_recorder_binary;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::wait_until;
use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::time::TimeValLike;
use serde_json::json;

const BENCH: &str = "recorder_throughput";
const CHANNEL_COUNT: usize = 20;
const PERIOD: Duration = Duration::from_millis(1);
const MESSAGE_BYTES: usize = 200;
const LIMIT: Duration = Duration::from_mins(1);

fn channel(index: usize) -> String {
    format!("raw/{index:02}")
}

/// One channel as the manifest describes it: twenty-five numbers.
fn described(index: usize) -> serde_json::Value {
    let field = json!({ "name": "value", "kind": "f64", "count": MESSAGE_BYTES / 8,
        "offset_bytes": 0 });
    json!({ "name": channel(index), "message": "bench.Raw.v1", "size_bytes": MESSAGE_BYTES,
        "fields": [field], "from_host": "here", "to_host": "here" })
}

fn hold(domain: &Domain) -> Result<Vec<ChannelHolder>, Box<dyn Error>> {
    let create = |index| {
        let settings = ChannelSettings {
            name: channel(index),
            message: TypeInfo {
                name: "bench.Raw.v1".to_owned(),
                size_bytes: MESSAGE_BYTES,
                alignment_bytes: 8,
            },
            depth_max: observer_depth(MESSAGE_BYTES),
            writers_max: 2,
            readers_max: 6,
        };
        Ok(ChannelHolder::create(domain, &settings)?)
    };
    (0..CHANNEL_COUNT).map(create).collect()
}

/// Announces a run as its supervisor would; `holder` is the process whose end ends it.
fn announce(domain: &Domain, run: &Path, holder: u32) -> Result<(), Box<dyn Error>> {
    fs::create_dir_all(run.join("records"))?;
    let channels: Vec<_> = (0..CHANNEL_COUNT).map(described).collect();
    let offset_ns: Option<i64> = None;
    let manifest = json!({ "schema_version": 1, "channels": channels, "hosts_here": ["here"],
        "program": { "name": BENCH, "version": "0" },
        "realtime_minus_monotonic_ns": offset_ns });
    fs::write(run.join("manifest.json"), manifest.to_string())?;
    let announced = (0..CHANNEL_COUNT).map(|index| LiveChannel {
        name: channel(index),
        source: Source::SharedMemory {
            host: "here".to_owned(),
            is_forwarded: false,
        },
        noted: Vec::new(),
        comes_again: false,
    });
    let live = LiveRun {
        schema_version: LIVE_VERSION,
        name: BENCH.to_owned(),
        topology: BENCH.to_owned(),
        folder: run.to_owned(),
        pid: holder,
        pid_start_ticks: None,
        since: String::new(),
        has_one_clock: Some(true),
        domains: BTreeMap::from([("here".to_owned(), domain.address().to_string())]),
        processes: Vec::new(),
        channels: announced.collect(),
    };
    let text = serde_json::to_string(&live)?;
    for folder in [domain.address().root_path(), run] {
        fs::write(folder.join(LiveRun::FILE_NAME), &text)?;
    }
    Ok(())
}

/// Publishes on every channel, every millisecond; how many messages on each, and how many of the
/// milliseconds began late by more than another.
fn publish(domain: &Domain, span: Duration) -> Result<(u64, u64), Box<dyn Error>> {
    let mut outputs = (0..CHANNEL_COUNT)
        .map(|index| RawOutput::open(domain, &channel(index), false))
        .collect::<Result<Vec<_>, _>>()?;
    let start = Instant::now();
    let (mut count, mut late_count) = (0, 0);
    let mut due = start;
    while start.elapsed() < span {
        for output in &mut outputs {
            let envelope = Envelope {
                sequence: count,
                published_ns: MonotonicClock::now().as_ns(),
                epoch: 1,
                ..Envelope::default()
            };
            output.publish(&envelope, &[7; MESSAGE_BYTES])?;
        }
        count += 1;
        due += PERIOD;
        let now = Instant::now();
        late_count += u64::from(now > due + PERIOD);
        thread::sleep(due.saturating_duration_since(now));
    }
    Ok((count, late_count))
}

fn measure(seconds: u64, cpu: usize) -> Result<bool, Box<dyn Error>> {
    let program = hil_recorder_binary();
    let folder = RunFolder::new("throughput");
    let domain = Domain::create(&folder.join("d"))?;
    let holders = hold(&domain)?;
    let run = folder.join("run");
    // Its end is the supervisor's.
    let mut holder = Command::new("sleep").arg("100000").spawn()?;
    announce(&domain, &run, holder.id())?;
    let file = folder.join("live.mcap");
    let mut recorder = Command::new("taskset")
        .args(["-c", &cpu.to_string()])
        .arg(program)
        .arg("record")
        .arg(&run)
        .arg("-o")
        .arg(&file)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()?;
    let partial = folder.join("live.mcap.partial");
    wait_until(LIMIT, "the recorder's file", || partial.is_file());
    let before = Instant::now();
    let (count, late_count) = publish(&domain, Duration::from_secs(seconds))?;
    let span_s = before.elapsed().as_secs_f64();
    for folder in [domain.address().root_path(), &run] {
        fs::remove_file(folder.join(LiveRun::FILE_NAME))?;
    }
    holder.kill()?;
    holder.wait()?;
    let processor_before_s = children_s()?;
    recorder.wait()?;
    let processor_s = children_s()? - processor_before_s;
    let output = recorder.wait_with_output()?;
    let said = [&output.stdout[..], &output.stderr[..]].concat();
    let said = String::from_utf8_lossy(&said);
    drop(holders);
    let left = domain.remove().remained;
    let expected = count * CHANNEL_COUNT as u64;
    let words = format!("{expected} messages of the run");
    let is_kept = output.status.success() && said.contains(&words) && said.contains("missed 0");
    println!(
        "{CHANNEL_COUNT} channels of {MESSAGE_BYTES} bytes, {count} messages each in {span_s:.1} s \
         ({late_count} milliseconds began late), {:.1} % of processor {cpu}, {:.1} MiB",
        100.0 * processor_s / span_s,
        fs::metadata(&file)?.len() as f64 / f64::from(1 << 20)
    );
    println!("{}", said.trim());
    println!(
        "{}",
        json!({"bench": BENCH, "channels": CHANNEL_COUNT, "message_bytes": MESSAGE_BYTES,
            "published": expected, "late_periods": late_count, "span_s": span_s,
            "processor_ratio": processor_s / span_s, "is_kept": is_kept})
    );
    if !left.is_empty() {
        println!("left in shared memory: {left:?}");
    }
    Ok(is_kept && left.is_empty())
}

/// Processor time of all children that have ended, seconds.
fn children_s() -> Result<f64, Box<dyn Error>> {
    let usage = getrusage(UsageWho::RUSAGE_CHILDREN)?;
    let total = usage.user_time() + usage.system_time();
    Ok(total.num_microseconds() as f64 * 1e-6)
}

fn arguments() -> Result<(u64, usize), Box<dyn Error>> {
    let (mut seconds, mut cpu) = (20, 1);
    let mut given = std::env::args().skip(1).filter(|word| word != "--bench");
    while let Some(word) = given.next() {
        let value = given.next().ok_or(format!("{word} needs a value"))?;
        match word.as_str() {
            "--seconds" => seconds = value.parse()?,
            "--cpu" => cpu = value.parse()?,
            _ => return Err(format!("unknown argument {word}").into()),
        }
    }
    Ok((seconds, cpu))
}

fn main() -> ExitCode {
    match arguments().and_then(|(seconds, cpu)| measure(seconds, cpu)) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            println!("{BENCH}: {error}");
            ExitCode::FAILURE
        }
    }
}
