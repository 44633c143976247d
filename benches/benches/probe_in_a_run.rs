//! What a probe at both ends costs a whole run: the shuttle on two hosts, with its own processes and
//! gateways, whose wire is tapped and not tapped in turns. Each pair of turns is one ratio, in an
//! order drawn by lot, so that what the machine does meanwhile hits both alike. Not a test: it states
//! the aim and whether it was met, or that the pairs were too few to tell, and ends with code 0.
//!
//! `cargo bench -p hil-benches --bench probe_in_a_run -- [--pairs N] [--rate HZ] [--set KEY=VALUE]...`,
//! about 4 s a pair. Namespaces and taps take root; without, it says what is missing. What the taps
//! cost a bare hop, back to back, is measured by `probe_overhead`.
#![allow(clippy::print_stdout, reason = "a bench prints its result")]

use std::fs;
use std::ops::Range;
use std::path::Path;
use std::process::ExitCode;
use std::thread;
use std::time::Duration;

use hil_benches::gateway::hosts::SetupError;
use hil_benches::gateway::network::Network;
use hil_benches::gateway::parties::{MachineTime, stolen_text};
use hil_benches::gateway::tap::Drainer;
use hil_benches::{HostFacts, MedianInterval, Quantiles};
use hil_models::measure::record::{TakenRecord, UNAVAILABLE};
use hil_models::random::RandomStream;
use hil_runtime::clock::MonotonicClock;
use hil_runtime::record::{RecordFile, RecordKind};
use hil_tests::binary::hil_runtime_binary;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::Trial;
use serde_json::{Value, json};

const BENCH: &str = "probe_in_a_run";
/// Tapped against alone, median and 99th percentile.
const RATIO_MAX: f64 = 1.02;
const TURN: Duration = Duration::from_secs(2);
/// What is left out of a turn at its beginning: a tap is being opened or closed.
const GUARD_NS: i64 = 150_000_000;
const SEED: u64 = 11;
const START_LIMIT: Duration = Duration::from_mins(1);

#[derive(Debug)]
struct Arguments {
    pair_count: usize,
    rate_hz: f64,
    settings: Vec<String>,
}

impl Arguments {
    fn read() -> Result<Self, SetupError> {
        let mut read = Self {
            pair_count: 30,
            rate_hz: 1000.0,
            settings: Vec::new(),
        };
        let mut given = std::env::args().skip(1).filter(|word| word != "--bench");
        while let Some(word) = given.next() {
            let value = given.next().ok_or(format!("{word} needs a value"))?;
            match word.as_str() {
                "--pairs" => read.pair_count = value.parse()?,
                "--rate" => read.rate_hz = value.parse()?,
                "--set" => read.settings.push(value),
                _ => return Err(format!("unknown argument {word}").into()),
            }
        }
        Ok(read)
    }
}

/// A turn of the wire, monotonic nanoseconds.
type Turn = Range<i64>;

/// Both turns of a pair.
#[derive(Debug, Clone)]
struct Pair {
    alone: Turn,
    tapped: Turn,
}

/// What one latency of one channel did over all pairs.
#[derive(Debug)]
struct Outcome {
    name: String,
    alone: Quantiles,
    tapped: Quantiles,
    p50: MedianInterval,
    p99: MedianInterval,
}

fn wait_turn() -> Turn {
    let from = MonotonicClock::now().as_ns() + GUARD_NS;
    thread::sleep(TURN);
    from..MonotonicClock::now().as_ns()
}

fn take_turns(
    network: &Network,
    drainer: &Drainer,
    pair_count: usize,
) -> Result<(Vec<Pair>, u64, u64), SetupError> {
    let mut lots = RandomStream::new(SEED, "turns");
    let (mut pairs, mut matched_count, mut dropped_count) = (Vec::new(), 0, 0);
    for _ in 0..pair_count {
        let mut tap = || -> Result<Turn, SetupError> {
            let (turn, counters) = drainer.while_tapped(network, wait_turn)?;
            matched_count += counters.matched_count;
            dropped_count += counters.dropped_count;
            Ok(turn)
        };
        let pair = if lots.chance(0.5) {
            let alone = wait_turn();
            let tapped = tap()?;
            Pair { alone, tapped }
        } else {
            let tapped = tap()?;
            let alone = wait_turn();
            Pair { alone, tapped }
        };
        pairs.push(pair);
    }
    Ok((pairs, matched_count, dropped_count))
}

/// Every record of consumers in a run folder, by channel.
fn taken_records(folder: &Path) -> Result<Vec<(String, Vec<TakenRecord>)>, SetupError> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder.join("records"))? {
        let path = entry?.path();
        let file = RecordFile::read(&path)?;
        if file.header.kind == RecordKind::Taken {
            found.push((file.header.channel.clone(), file.records().collect()));
        }
    }
    Ok(found)
}

/// One latency of a message, nanoseconds; `None` where a stamp is missing.
type Latency = fn(&TakenRecord) -> Option<u64>;

const LATENCIES: [(&str, Latency); 2] = [
    ("published to republished", |record| {
        let is_known = record.forwarded_ns != UNAVAILABLE;
        let span = record.forwarded_ns.checked_sub(record.published_ns);
        span.filter(|_| is_known)?.try_into().ok()
    }),
    ("published to taken", |record| {
        (record.taken_ns - record.published_ns).try_into().ok()
    }),
];

fn samples(records: &[TakenRecord], turn: &Turn, latency: Latency) -> Vec<u64> {
    let during = records
        .iter()
        .filter(|record| turn.contains(&record.published_ns));
    during.filter_map(latency).collect()
}

fn judge(
    channel: &str,
    records: &[TakenRecord],
    pairs: &[Pair],
    (name, latency): (&str, Latency),
) -> Option<Outcome> {
    let (mut all_alone, mut all_tapped) = (Vec::new(), Vec::new());
    let (mut p50, mut p99) = (Vec::new(), Vec::new());
    for pair in pairs {
        let mut alone = samples(records, &pair.alone, latency);
        let mut tapped = samples(records, &pair.tapped, latency);
        let (Some(before), Some(after)) = (Quantiles::of(&mut alone), Quantiles::of(&mut tapped))
        else {
            continue;
        };
        p50.push(after.p50_ns as f64 / before.p50_ns as f64);
        p99.push(after.p99_ns as f64 / before.p99_ns as f64);
        all_alone.append(&mut alone);
        all_tapped.append(&mut tapped);
    }
    Some(Outcome {
        name: format!("{channel}, {name}"),
        alone: Quantiles::of(&mut all_alone)?,
        tapped: Quantiles::of(&mut all_tapped)?,
        p50: MedianInterval::of(p50)?,
        p99: MedianInterval::of(p99)?,
    })
}

fn print(outcome: &Outcome) {
    println!("\n{}", outcome.name);
    for (name, found) in [("alone", &outcome.alone), ("tapped", &outcome.tapped)] {
        let us = |ns: u64| ns as f64 * 1e-3;
        println!(
            "  {name:<7} p50 {:8.2} us   p99 {:8.2} us   p99.9 {:9.2} us   {} messages",
            us(found.p50_ns),
            us(found.p99_ns),
            us(found.p99_9_ns),
            found.count
        );
    }
    for (figure, ratio) in [("p50", &outcome.p50), ("p99", &outcome.p99)] {
        let MedianInterval { median, low, high } = *ratio;
        let verdict = if high <= RATIO_MAX {
            "PASS"
        } else if low > RATIO_MAX {
            "FAIL"
        } else {
            "UNDECIDED"
        };
        println!(
            "  {verdict:<9} {figure} tapped / alone: {median:.4} [{low:.4}, {high:.4}], aim at \
             most {RATIO_MAX}"
        );
        println!(
            "{}",
            json!({
                "bench": BENCH, "case": outcome.name, "figure": figure, "ratio": median,
                "interval_95": [low, high], "aim_max": RATIO_MAX, "verdict": verdict,
                "alone": outcome.alone.to_json(), "tapped": outcome.tapped.to_json(),
            })
        );
    }
}

fn measure(arguments: &Arguments) -> Result<(), SetupError> {
    // Built before anything is measured, not between.
    println!("binary: {}", hil_runtime_binary().display());
    let drainer = Drainer::start();
    let network = Network::open();
    let Some(lab) = network.lab() else {
        return Err(network.note().to_owned().into());
    };
    let facts = HostFacts::read("as the topology says: nothing pinned, wait = block");
    println!("{}", heading(&facts, arguments));
    let record = RunFolder::new(BENCH);
    let span_s = TURN.as_secs_f64() * 2.0 * arguments.pair_count as f64 + 10.0;
    let mut trial = Trial::shipped("shuttle-split.toml", record.path())
        .set(&format!("run.duration=\"{span_s} s\""))
        .set(&format!("case.parameters.rate_hz={:?}", arguments.rate_hz));
    for setting in &arguments.settings {
        trial = trial.set(setting);
    }
    let mut hosts = [0, 1].map(|index| trial.start_on(lab.host(index)));
    let folder = trial.folder("-control-pc", START_LIMIT);
    // The first messages meet cold processes.
    thread::sleep(Duration::from_secs(3));
    let before = MachineTime::read();
    let (pairs, matched_count, dropped_count) =
        take_turns(&network, &drainer, arguments.pair_count)?;
    println!("{}", stolen_text(before, MachineTime::read()));
    for host in &mut hosts {
        let limit = Duration::from_secs_f64(span_s) + START_LIMIT;
        let finished = host.wait_within(limit)?;
        if !finished.status.success() {
            return Err(format!("the run failed: {finished:?}").into());
        }
    }
    // Either folder holds the records of both hosts.
    for (channel, records) in taken_records(folder.root())? {
        for latency in LATENCIES {
            match judge(&channel, &records, &pairs, latency) {
                Some(outcome) => print(&outcome),
                None => println!("{channel}: no message in six pairs"),
            }
        }
    }
    println!("\ntapped {matched_count} datagrams, {dropped_count} dropped");
    drainer.finish();
    Ok(())
}

fn heading(facts: &HostFacts, arguments: &Arguments) -> String {
    let machine: Value = facts.to_json();
    format!(
        "{}\n{} pairs of {} s turns at {} Hz, order by lot of seed {SEED}; ratios of each pair's \
         quantiles, their median with its 95 % interval by order statistics",
        json!({"bench": BENCH, "host": machine, "pairs": arguments.pair_count,
            "rate_hz": arguments.rate_hz, "seed": SEED}),
        arguments.pair_count,
        TURN.as_secs_f64(),
        arguments.rate_hz
    )
}

fn main() -> ExitCode {
    match Arguments::read().and_then(|arguments| measure(&arguments)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            println!("{BENCH}: not measurable here: {error}");
            ExitCode::SUCCESS
        }
    }
}
