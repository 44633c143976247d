//! What a probe costs a whole run: the shuttle on two hosts with a switch between them, with its own
//! processes and gateways, whose wire is in turns not tapped, tapped at a mirror port of the switch,
//! and tapped on the hosts' own interfaces, by a packet ring and by eBPF programs. Each round of turns gives one ratio, in an order drawn by
//! lot, so that what the machine does meanwhile hits all alike. Not a test: it states the aim and
//! whether it was met, or that the rounds were too few to tell, and ends with code 0.
//!
//! `cargo bench -p hil-benches --bench probe_in_a_run -- [--rounds N] [--rate HZ] [--set KEY=VALUE]...`,
//! about 8 s a round. Namespaces and taps take root; without, it says what is missing. What the taps
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
use hil_gateways::transport::live_tap::TapEngine;
use hil_models::measure::record::{TakenRecord, UNAVAILABLE};
use hil_models::random::RandomStream;
use hil_runtime::clock::MonotonicClock;
use hil_runtime::record::{RecordFile, RecordKind};
use hil_tests::binary::hil_runtime_binary;
use hil_tests::lab::INTERFACE;
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

/// A turn of the wire, monotonic nanoseconds.
type Turn = Range<i64>;

/// Where the wire is tapped in a turn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Tap {
    /// Nowhere.
    None,
    /// At a mirror port of the switch between the hosts: no datagram's way leads through it.
    Mirror,
    /// By packet rings on the hosts' own interfaces: every datagram's way leads through two.
    Hosts,
    /// By eBPF programs there.
    HostsBpf,
}

const TAPS: [Tap; 4] = [Tap::None, Tap::Mirror, Tap::Hosts, Tap::HostsBpf];
const TAP_COUNT: usize = TAPS.len();

impl Tap {
    const fn name(self) -> &'static str {
        match self {
            Self::None => "alone",
            Self::Mirror => "mirror",
            Self::Hosts => "hosts",
            Self::HostsBpf => "hosts, bpf",
        }
    }

    const fn engine(self) -> TapEngine {
        match self {
            Self::HostsBpf => TapEngine::Bpf,
            _ => TapEngine::Packet,
        }
    }

    /// Host and interface of each.
    fn places(self, mirror: &'static str) -> Vec<(usize, &'static str)> {
        match self {
            Self::None => Vec::new(),
            Self::Mirror => vec![(0, mirror)],
            Self::Hosts | Self::HostsBpf => vec![(0, INTERFACE), (1, INTERFACE)],
        }
    }
}

/// One turn of each kind, in the order of [`TAPS`].
type Round = [Turn; TAP_COUNT];

/// What one latency of one channel did over all rounds.
#[derive(Debug)]
struct Outcome {
    name: String,
    /// In the order of [`TAPS`].
    quantiles: [Quantiles; TAP_COUNT],
    /// Median and 99th percentile against the turns alone; the taps in their order.
    ratios: [[MedianInterval; 2]; TAP_COUNT - 1],
}

fn wait_turn() -> Turn {
    let from = MonotonicClock::now().as_ns() + GUARD_NS;
    thread::sleep(TURN);
    from..MonotonicClock::now().as_ns()
}

/// What the taps saw.
#[derive(Debug, Default)]
struct Tapped {
    matched_count: u64,
    dropped_count: u64,
}

fn take_turns(
    (network, mirror): (&Network, &'static str),
    drainer: &Drainer,
    round_count: usize,
) -> Result<(Vec<Round>, Tapped), SetupError> {
    let mut lots = RandomStream::new(SEED, "turns");
    let (mut rounds, mut tapped) = (Vec::new(), Tapped::default());
    for _ in 0..round_count {
        let mut order: [usize; TAP_COUNT] = core::array::from_fn(|index| index);
        for last in (1..order.len()).rev() {
            let chosen = lots.next_u64() % (last as u64 + 1);
            order.swap(last, usize::try_from(chosen)?);
        }
        let mut round: Round = core::array::from_fn(|_| 0..0);
        for index in order {
            let places = TAPS[index].places(mirror);
            let (turn, counters) =
                drainer.while_tapped_at(network, (TAPS[index].engine(), &places), wait_turn)?;
            tapped.matched_count += counters.matched_count;
            tapped.dropped_count += counters.dropped_count;
            round[index] = turn;
        }
        rounds.push(round);
    }
    Ok((rounds, tapped))
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
    rounds: &[Round],
    (name, latency): (&str, Latency),
) -> Option<Outcome> {
    let mut all: [Vec<u64>; TAP_COUNT] = Default::default();
    let mut ratios: [[Vec<f64>; 2]; TAP_COUNT - 1] = Default::default();
    for round in rounds {
        let mut during = round.each_ref().map(|turn| samples(records, turn, latency));
        let found = during.each_mut().map(|some| Quantiles::of(some));
        let [Some(alone), tapped @ ..] = &found else {
            continue;
        };
        if tapped.iter().any(Option::is_none) {
            continue;
        }
        for (ratios, tapped) in ratios.iter_mut().zip(tapped.iter().flatten()) {
            ratios[0].push(tapped.p50_ns as f64 / alone.p50_ns as f64);
            ratios[1].push(tapped.p99_ns as f64 / alone.p99_ns as f64);
        }
        for (all, some) in all.iter_mut().zip(&mut during) {
            all.append(some);
        }
    }
    let quantiles: Option<Vec<Quantiles>> =
        all.iter_mut().map(|some| Quantiles::of(some)).collect();
    let ratios: Option<Vec<[MedianInterval; 2]>> = ratios
        .into_iter()
        .map(|[p50, p99]| Some([MedianInterval::of(p50)?, MedianInterval::of(p99)?]))
        .collect();
    Some(Outcome {
        name: format!("{channel}, {name}"),
        quantiles: quantiles?.try_into().ok()?,
        ratios: ratios?.try_into().ok()?,
    })
}

fn print(outcome: &Outcome) {
    println!("\n{}", outcome.name);
    for (tap, found) in TAPS.iter().zip(&outcome.quantiles) {
        let us = |ns: u64| ns as f64 * 1e-3;
        println!(
            "  {:<10} p50 {:8.2} us   p99 {:8.2} us   p99.9 {:9.2} us   {} messages",
            tap.name(),
            us(found.p50_ns),
            us(found.p99_ns),
            us(found.p99_9_ns),
            found.count
        );
    }
    for (tap, ratios) in TAPS[1..].iter().zip(&outcome.ratios) {
        for (figure, ratio) in ["p50", "p99"].into_iter().zip(ratios) {
            let MedianInterval { median, low, high } = *ratio;
            let verdict = if high <= RATIO_MAX {
                "PASS"
            } else if low > RATIO_MAX {
                "FAIL"
            } else {
                "UNDECIDED"
            };
            let tap = tap.name();
            println!(
                "  {verdict:<9} {figure} {tap} / alone: {median:.4} [{low:.4}, {high:.4}], aim at \
                 most {RATIO_MAX}"
            );
            let quantiles = outcome.quantiles.each_ref().map(Quantiles::to_json);
            println!(
                "{}",
                json!({
                    "bench": BENCH, "case": outcome.name, "tap": tap, "figure": figure,
                    "ratio": median, "interval_95": [low, high], "aim_max": RATIO_MAX,
                    "verdict": verdict, "quantiles": quantiles,
                })
            );
        }
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
    lab.put_bridge_between();
    let mirror = lab.add_mirror_port();
    let record = RunFolder::new(BENCH);
    let span_s =
        TURN.as_secs_f64() * (TAP_COUNT as f64 + 0.1) * arguments.round_count as f64 + 10.0;
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
    let (rounds, tapped) = take_turns((&network, mirror), &drainer, arguments.round_count)?;
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
            match judge(&channel, &records, &rounds, latency) {
                Some(outcome) => print(&outcome),
                None => println!("{channel}: no message in six rounds"),
            }
        }
    }
    let Tapped {
        matched_count,
        dropped_count,
    } = tapped;
    println!("\ntapped {matched_count} datagrams, {dropped_count} dropped");
    drainer.finish();
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
