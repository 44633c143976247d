//! What a live recorder costs a whole run: the shuttle on two hosts with its own processes and gateways,
//! which in turns is recorded on both hosts and is not. Each round of turns gives one ratio, in an order
//! drawn by lot. Not a test: it states the aim and whether it was met, or that the rounds were too
//! few to tell, and ends with code 0.
//!
//! `cargo bench -p hil-benches --bench recorder_on_off -- [--rounds N] [--rate HZ] [--set KEY=VALUE]...`,
//! about 7 s a round. `HIL_RUNTIME_BINARY` and `HIL_RECORDER_BINARY` name the programs; without them
//! they are built. Namespaces take root; without, it says what is missing.
#![allow(clippy::print_stdout, reason = "a bench prints its result")]

use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::thread;
use std::time::Duration;

use hil_benches::gateway::hosts::SetupError;
use hil_benches::gateway::network::Network;
use hil_benches::gateway::parties::{MachineTime, stolen_text};
use hil_benches::{HostFacts, MedianInterval, Quantiles};
use hil_models::measure::record::{TakenRecord, UNAVAILABLE};
use hil_models::random::RandomStream;
use hil_runtime::clock::MonotonicClock;
use hil_runtime::record::{RecordFile, RecordKind};
use hil_tests::binary::{hil_recorder_binary, hil_runtime_binary};
use hil_tests::child::ChildGuard;
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{Trial, wait_until};
use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::signal::Signal;
use nix::sys::time::TimeValLike;
use serde_json::{Value, json};

const BENCH: &str = "recorder_on_off";
/// Recorded against not, median and 99th percentile.
const RATIO_MAX: f64 = 1.02;
const TURN: Duration = Duration::from_secs(2);
/// What is left out of a turn at its beginning: recorders come or go.
const GUARD: Duration = Duration::from_millis(400);
const SEED: u64 = 12;
const LIMIT: Duration = Duration::from_mins(1);

#[derive(Debug)]
struct Arguments {
    round_count: usize,
    rate_hz: f64,
    settings: Vec<String>,
}

impl Arguments {
    fn read() -> Result<Self, SetupError> {
        let mut read = Self {
            round_count: 30,
            rate_hz: 1000.0,
            settings: Vec::new(),
        };
        let mut given = std::env::args().skip(1).filter(|word| word != "--bench");
        while let Some(word) = given.next() {
            let value = given.next().ok_or(format!("{word} needs a value"))?;
            match word.as_str() {
                "--rounds" => read.round_count = value.parse()?,
                "--rate" => read.rate_hz = value.parse()?,
                "--set" => read.settings.push(value),
                _ => return Err(format!("unknown argument {word}").into()),
            }
        }
        Ok(read)
    }
}

/// A turn, monotonic nanoseconds.
type Turn = Range<i64>;
/// Not recorded, then recorded.
type Round = [Turn; 2];

fn wait_turn() -> Turn {
    thread::sleep(GUARD);
    let from = MonotonicClock::now().as_ns();
    thread::sleep(TURN);
    from..MonotonicClock::now().as_ns()
}

/// What the recorders did in all turns.
#[derive(Debug, Default)]
struct Work {
    processor_s: f64,
    wall_s: f64,
    missed: Vec<String>,
}

fn recorded_turn(lab: &Lab, folder: &Path, work: &mut Work) -> Result<Turn, SetupError> {
    let files: [PathBuf; 2] = [0, 1].map(|index| folder.join(format!("{index}.mcap")));
    let mut recorders = [0, 1].map(|index| {
        let mut command = lab.host(index).command(hil_recorder_binary());
        let arguments = ["record", "--from-now", "--force", "-o"];
        ChildGuard::spawn(command.args(arguments).arg(&files[index]))
    });
    for file in &files {
        let partial = file.with_extension("mcap.partial");
        wait_until(LIMIT, "a recorder's file", || partial.is_file());
    }
    let turn = wait_turn();
    let before_s = children_s()?;
    for recorder in &mut recorders {
        let recorder = recorder.as_mut().map_err(|error| error.to_string())?;
        recorder.signal(Signal::SIGINT)?;
        let finished = recorder.wait_within(LIMIT)?;
        // Interrupted, with a whole file.
        if finished.status.code() != Some(130) {
            return Err(format!("a recorder failed: {finished:?}").into());
        }
        if !finished.stdout.contains("missed 0") {
            work.missed.push(finished.stdout.trim().to_owned());
        }
    }
    work.processor_s += children_s()? - before_s;
    work.wall_s += 2.0 * (TURN + GUARD).as_secs_f64();
    Ok(turn)
}

/// Processor time of all children that have ended, seconds.
fn children_s() -> Result<f64, SetupError> {
    let usage = getrusage(UsageWho::RUSAGE_CHILDREN)?;
    let total = usage.user_time() + usage.system_time();
    Ok(total.num_microseconds() as f64 * 1e-6)
}

fn take_turns(
    lab: &Lab,
    folder: &Path,
    round_count: usize,
) -> Result<(Vec<Round>, Work), SetupError> {
    let mut lots = RandomStream::new(SEED, "turns");
    let (mut rounds, mut work) = (Vec::new(), Work::default());
    for _ in 0..round_count {
        let is_first = lots.next_u64().is_multiple_of(2);
        let mut round: Round = [0..0, 0..0];
        for is_recorded in [is_first, !is_first] {
            round[usize::from(is_recorded)] = if is_recorded {
                recorded_turn(lab, folder, &mut work)?
            } else {
                wait_turn()
            };
        }
        rounds.push(round);
    }
    Ok((rounds, work))
}

/// Every record of consumers in a run folder, by channel.
fn taken_records(folder: &Path) -> Result<Vec<(String, Vec<TakenRecord>)>, SetupError> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder.join("records"))? {
        let file = RecordFile::read(&entry?.path())?;
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

/// Quantiles of both kinds of turns, and the ratios of median and 99th percentile.
fn judge(
    records: &[TakenRecord],
    rounds: &[Round],
    latency: Latency,
) -> Option<([Quantiles; 2], [MedianInterval; 2])> {
    let mut all: [Vec<u64>; 2] = Default::default();
    let mut ratios: [Vec<f64>; 2] = Default::default();
    for round in rounds {
        let mut during = round.each_ref().map(|turn| samples(records, turn, latency));
        let [off, on] = during.each_mut().map(|some| Quantiles::of(some));
        let (Some(off), Some(on)) = (off, on) else {
            continue;
        };
        ratios[0].push(on.p50_ns as f64 / off.p50_ns as f64);
        ratios[1].push(on.p99_ns as f64 / off.p99_ns as f64);
        for (all, some) in all.iter_mut().zip(&mut during) {
            all.append(some);
        }
    }
    let [off, on] = all.each_mut().map(|some| Quantiles::of(some));
    let [p50, p99] = ratios.map(MedianInterval::of);
    Some(([off?, on?], [p50?, p99?]))
}

fn print(case: &str, quantiles: &[Quantiles; 2], ratios: &[MedianInterval; 2]) {
    println!("\n{case}");
    for (name, found) in ["off", "on"].iter().zip(quantiles) {
        let us = |ns: u64| ns as f64 * 1e-3;
        println!(
            "  {name:<4} p50 {:8.2} us   p99 {:8.2} us   p99.9 {:9.2} us   {} messages",
            us(found.p50_ns),
            us(found.p99_ns),
            us(found.p99_9_ns),
            found.count
        );
    }
    for (figure, ratio) in ["p50", "p99"].into_iter().zip(ratios) {
        let MedianInterval { median, low, high } = *ratio;
        let verdict = if high <= RATIO_MAX {
            "PASS"
        } else if low > RATIO_MAX {
            "FAIL"
        } else {
            "UNDECIDED"
        };
        println!(
            "  {verdict:<9} {figure} on / off: {median:.4} [{low:.4}, {high:.4}], aim at most \
             {RATIO_MAX}"
        );
        let quantiles = quantiles.each_ref().map(Quantiles::to_json);
        println!(
            "{}",
            json!({
                "bench": BENCH, "case": case, "figure": figure, "ratio": median,
                "interval_95": [low, high], "aim_max": RATIO_MAX, "verdict": verdict,
                "quantiles": quantiles,
            })
        );
    }
}

fn measure(arguments: &Arguments) -> Result<(), SetupError> {
    // Built before anything is measured, not between.
    let binaries = [hil_runtime_binary(), hil_recorder_binary()];
    println!(
        "binaries: {}, {}",
        binaries[0].display(),
        binaries[1].display()
    );
    let network = Network::open();
    let Some(lab) = network.lab() else {
        return Err(network.note().to_owned().into());
    };
    let facts = HostFacts::read("as the topology says: nothing pinned, wait = block");
    println!("{}", heading(&facts, arguments));
    let record = RunFolder::new(BENCH);
    // A recorder takes a moment to come and to go.
    let span_s = (TURN + GUARD).as_secs_f64() * 3.0 * arguments.round_count as f64 + 15.0;
    let mut trial = Trial::shipped("shuttle-split.toml", record.path())
        .set(&format!("run.duration=\"{span_s} s\""))
        .set(&format!("case.parameters.rate_hz={:?}", arguments.rate_hz));
    for setting in &arguments.settings {
        trial = trial.set(setting);
    }
    let mut hosts = [0, 1].map(|index| trial.start_on(lab.host(index)));
    let folder = trial.folder("-control-pc", LIMIT);
    // The first messages meet cold processes.
    thread::sleep(Duration::from_secs(3));
    let recordings = RunFolder::new("recordings");
    let before = MachineTime::read();
    let (rounds, work) = take_turns(lab, recordings.path(), arguments.round_count)?;
    println!("{}", stolen_text(before, MachineTime::read()));
    for host in &mut hosts {
        let limit = Duration::from_secs_f64(span_s) + LIMIT;
        let finished = host.wait_within(limit)?;
        if !finished.status.success() {
            return Err(format!("the run failed: {finished:?}").into());
        }
    }
    // Either folder holds the records of both hosts.
    for (channel, records) in taken_records(folder.root())? {
        for (name, latency) in LATENCIES {
            let case = format!("{channel}, {name}");
            match judge(&records, &rounds, latency) {
                Some((quantiles, ratios)) => print(&case, &quantiles, &ratios),
                None => println!("\n{case}: too few rounds with messages"),
            }
        }
    }
    println!(
        "\na recorder took {:.1} % of a processor, its start and end included",
        100.0 * work.processor_s / work.wall_s
    );
    for words in &work.missed {
        println!("MISSED {words}");
    }
    Ok(())
}

fn heading(facts: &HostFacts, arguments: &Arguments) -> String {
    let machine: Value = facts.to_json();
    format!(
        "{}\n{} rounds of {} s turns at {} Hz, order by lot of seed {SEED}; ratios of each round's \
         quantiles, their median with its 95 % interval by order statistics",
        json!({"bench": BENCH, "host": machine, "rounds": arguments.round_count,
            "rate_hz": arguments.rate_hz, "seed": SEED}),
        arguments.round_count,
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
