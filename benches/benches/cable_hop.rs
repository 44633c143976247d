//! What a cable costs two programs that speak IP: half the round trip of a UDP echo between two programs that each
//! have a network of their own on two hosts, carried by the product, plain and sealed, beside the same programs
//! over the bare pair of interfaces between the hosts (`direct`), and with the least in the cable's place that can
//! stand there (`relay`, see `hil_benches::cable::relay`); with `--rattan PROGRAM` also between two networks of one host that
//! rattan 0.1.1 joins (`cargo install --locked rattan`, with libnftables-dev and libclang-dev). Then what each takes of a flood, what a packet of it costs
//! in processor time, and a stream of TCP. Not a test: it states the aims and whether they were met, and ends
//! with code 0.
//!
//! `cargo bench -p hil-benches --bench cable_hop -- [--rounds N] [--turn MS] [--wait block|hybrid|spin]
//! [--pin CPU,CPU|none] [--rattan PROGRAM] [--quick]`, about three minutes. It takes root; without, it says what is missing. All
//! contestants exist the whole time and take turns in an order drawn by lot for each case of a round, on two
//! processors: all of a host is on one of them, unless `--pin` says otherwise. The programs block. With `--wait spin`
//! product and relay do not sleep; the relay gives the processor to others between two looks. To `hybrid` it has no
//! like, and blocks. With either, the processes of all contestants but the one whose turn it is are stopped
//! (`SIGSTOP`): two processors have no room for more. Two also are too few for a product that spins: it has four
//! threads on each host.
#![allow(clippy::print_stdout, reason = "a bench prints its result")]

use std::net::SocketAddr;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;
use std::{env, thread};

use hil_benches::cable::contestant::{Contestant, DIRECT, NAMES, RATTAN, RELAY, Start};
use hil_benches::cable::{program, relay};
use hil_benches::gateway::hosts::SetupError;
use hil_benches::gateway::network::Network;
use hil_benches::gateway::parties::{MachineTime, stolen_text};
use hil_benches::turns::{self, verdict};
use hil_benches::{HostFacts, Quantiles, TypicalRatio};
use hil_core::random::RandomStream;
use hil_platform::wait::WaitMode;
use hil_tests::binary::hil_runtime_binary;
use hil_tests::run_folder::RunFolder;
use nix::sys::signal::Signal;
use serde_json::json;

const BENCH: &str = "cable_hop";
const SEED: u64 = 23;
/// Which contestants are set against which.
const PAIRS: [[usize; 2]; 8] = [
    [2, RELAY],
    [3, RELAY],
    [2, DIRECT],
    [3, DIRECT],
    [RELAY, DIRECT],
    [2, RATTAN],
    [3, RATTAN],
    [RATTAN, DIRECT],
];
const SIZES: [usize; 2] = [64, 1024];
/// From one trip to the next; zero for at once.
const PERIODS: [Duration; 2] = [Duration::ZERO, Duration::from_millis(1)];
const LOAD_ROUNDS_MAX: usize = 8;
const FLOOD_BYTES: usize = 64;
const FLOOD: Duration = Duration::from_millis(500);
const STREAM: Duration = Duration::from_millis(800);
/// What is under way of a flood has come by then.
const DRAIN: Duration = Duration::from_millis(300);
/// Of processes that go on after a stop.
const SETTLE: Duration = Duration::from_millis(30);

/// What the command line says.
#[derive(Debug)]
struct Arguments {
    round_count: usize,
    turn: Duration,
    wait: WaitMode,
    pins: [Option<usize>; 2],
    /// Where rattan is.
    rattan: Option<String>,
}

impl Arguments {
    fn read(mut words: impl Iterator<Item = String>) -> Result<Self, SetupError> {
        let mut read = Self {
            round_count: 30,
            turn: Duration::from_millis(150),
            wait: WaitMode::Block,
            pins: [Some(0), Some(1)],
            rattan: None,
        };
        while let Some(word) = words.next() {
            if word == "--quick" {
                read.round_count = 6;
                continue;
            }
            let value = words.next().ok_or(format!("{word} needs a value"))?;
            match word.as_str() {
                "--rounds" => read.round_count = value.parse()?,
                "--turn" => read.turn = Duration::from_millis(value.parse()?),
                "--wait" => read.wait = serde_json::from_value(json!(value))?,
                "--rattan" => read.rattan = Some(value),
                "--pin" if value == "none" => read.pins = [None; 2],
                "--pin" => {
                    let (first, second) = value.split_once(',').ok_or("--pin takes two")?;
                    read.pins = [Some(first.parse()?), Some(second.parse()?)];
                }
                _ => return Err(format!("unknown argument {word}").into()),
            }
        }
        Ok(read)
    }

    /// How many contestants there are.
    fn count(&self) -> usize {
        NAMES.len() - usize::from(self.rattan.is_none())
    }

    fn spins(&self) -> bool {
        self.wait == WaitMode::Spin
    }

    /// Whether the others are stopped during a turn: a carrier that does not always sleep takes their processors.
    fn is_alone(&self) -> bool {
        self.wait != WaitMode::Block
    }

    /// More than all turns take.
    fn span(&self) -> Result<Duration, SetupError> {
        let turns = self.count() * SIZES.len() * PERIODS.len() * self.round_count;
        let turns = (self.turn + SETTLE) * 2 * u32::try_from(turns)?;
        Ok(turns + Duration::from_mins(8))
    }

    /// Largest ratios of the median wished for: to the relay and to no cable at all.
    fn aim(&self, reference: usize) -> f64 {
        match reference {
            RELAY => 1.15,
            RATTAN => 1.0,
            _ if self.spins() => 1.5,
            _ => 2.2,
        }
    }
}

/// All contestants, and whose turn it is.
struct Contest {
    arguments: Arguments,
    contestants: Vec<Contestant>,
    lots: RandomStream,
}

impl Contest {
    /// Has each of the first `count` contestants do `work` in an order drawn by lot, alone where they do not always sleep.
    fn each<T>(
        &mut self,
        count: usize,
        mut work: impl FnMut(&mut Contestant) -> Result<T, SetupError>,
    ) -> Result<Vec<T>, SetupError> {
        let mut order: Vec<usize> = (0..count).collect();
        for last in (1..order.len()).rev() {
            let chosen = self.lots.next_u64() % (last as u64 + 1);
            order.swap(last, usize::try_from(chosen)?);
        }
        let mut found: Vec<Option<T>> = (0..count).map(|_| None).collect();
        for index in order {
            let contestant = &mut self.contestants[index];
            if self.arguments.is_alone() {
                contestant.signal(Signal::SIGCONT);
                thread::sleep(SETTLE);
            }
            let worked = work(contestant).map_err(|error| format!("{}: {error}", NAMES[index]));
            found[index] = Some(worked?);
            if self.arguments.is_alone() {
                contestant.signal(Signal::SIGSTOP);
            }
        }
        Ok(found.into_iter().flatten().collect())
    }

    /// All cases in every round.
    fn trips(&mut self) -> Result<(), SetupError> {
        let turn = self.arguments.turn;
        let cases = PERIODS
            .iter()
            .flat_map(|period| SIZES.map(|bytes| Case::new(bytes, *period)));
        let mut cases: Vec<Case> = cases.collect();
        let before = MachineTime::read();
        for _ in 0..self.arguments.round_count {
            for case in &mut cases {
                let (bytes, period) = (case.bytes, case.period);
                let round = self.each(self.contestants.len(), |contestant| {
                    Ok(contestant.near.ping(bytes, turn, period)?)
                })?;
                case.add(round);
            }
        }
        println!("{}", stolen_text(before, MachineTime::read()));
        for case in &mut cases {
            case.print(&self.arguments);
        }
        Ok(())
    }

    /// A flood and a stream through each, in few rounds.
    fn loads(&mut self) -> Result<(), SetupError> {
        let mut figures: [Vec<Vec<f64>>; 4] = Default::default();
        let before = MachineTime::read();
        let count = self.arguments.round_count.min(LOAD_ROUNDS_MAX);
        // Rattan, stopped and continued, does not end a flood.
        let loaded = if self.arguments.is_alone() {
            RATTAN.min(self.contestants.len())
        } else {
            self.contestants.len()
        };
        for _ in 0..count {
            let floods = self.each(loaded, |contestant| {
                let used = contestant.carrier_ns();
                let sent = contestant.near.flood(FLOOD_BYTES, FLOOD)?;
                thread::sleep(DRAIN);
                let (came, span) = contestant.far.flooded()?;
                let used_us = contestant.carrier_ns().saturating_sub(used) as f64 * 1e-3;
                let rate = |count: u64, span: Duration| count as f64 / span.as_secs_f64().max(1e-9);
                Ok([
                    rate(sent, FLOOD),
                    rate(came, span),
                    used_us / came.max(1) as f64,
                ])
            })?;
            let streams = self.each(loaded, |contestant| {
                Ok(contestant.near.stream(STREAM)? * 1e-6)
            })?;
            for (at, rounds) in figures[..3].iter_mut().enumerate() {
                rounds.push(floods.iter().map(|flood| flood[at]).collect());
            }
            figures[3].push(streams);
        }
        let stolen = stolen_text(before, MachineTime::read());
        println!("\nloads, medians of {count} rounds, {stolen}");
        let units = [
            ("64 B sent in a flood, 1/s", &PAIRS[..0]),
            ("64 B received of a flood, 1/s", &PAIRS[..]),
            (
                "processor time of carriers per packet received, us",
                &PAIRS[..2],
            ),
            ("TCP, Mbit/s", &PAIRS[..]),
        ];
        for ((what, pairs), rounds) in units.into_iter().zip(&figures) {
            for (index, name) in NAMES.iter().enumerate().take(loaded) {
                let mut each: Vec<f64> = rounds.iter().map(|round| round[index]).collect();
                each.sort_unstable_by(f64::total_cmp);
                let Some(middle) = each.get(each.len() / 2) else {
                    continue;
                };
                println!("  {name:<7} {what} {middle:10.2}");
                println!(
                    "{}",
                    json!({"bench": BENCH, "load": what, "contestant": name, "median": middle, "rounds": each.len()})
                );
            }
            for [one, reference] in pairs
                .iter()
                .filter(|pair| pair.iter().all(|one| *one < loaded))
            {
                let ratios = rounds.iter().map(|round| round[*one] / round[*reference]);
                // A connection that broke has no ratio.
                let ratios = ratios.filter(|ratio| ratio.is_finite() && *ratio > 0.0);
                print_ratio(
                    what,
                    "median",
                    [NAMES[*one], NAMES[*reference]],
                    &ratios.collect::<Vec<f64>>(),
                    None,
                );
            }
        }
        Ok(())
    }
}

/// Round trips of one size at one pace, by contestant.
struct Case {
    bytes: usize,
    period: Duration,
    half_ns: [Vec<u64>; NAMES.len()],
    lost_counts: [u64; NAMES.len()],
    /// Medians and 99th percentiles of each round; a round without an answer to one of them is left out.
    rounds: Vec<Vec<[u64; 2]>>,
}

impl Case {
    fn new(bytes: usize, period: Duration) -> Self {
        Self {
            bytes,
            period,
            half_ns: Default::default(),
            lost_counts: Default::default(),
            rounds: Vec::new(),
        }
    }

    fn name(&self) -> String {
        match self.period {
            Duration::ZERO => format!("{} B one after the other", self.bytes),
            period => format!("{} B every {period:?}", self.bytes),
        }
    }

    fn add(&mut self, round: Vec<program::Trips>) {
        let (mut found, trip_count) = (Vec::new(), round.len());
        for (index, mut trips) in round.into_iter().enumerate() {
            let quantiles = Quantiles::of(&mut trips.half_ns);
            found.extend(quantiles.map(|found| [found.p50_ns, found.p99_ns]));
            self.lost_counts[index] += trips.lost_count;
            self.half_ns[index].append(&mut trips.half_ns);
        }
        if found.len() == trip_count {
            self.rounds.push(found);
        }
    }

    fn print(&mut self, arguments: &Arguments) {
        let case = self.name();
        println!("\n{case}: half a round trip");
        let all = self.half_ns.iter_mut().zip(self.lost_counts);
        let all = all.take(arguments.count());
        for (name, (half_ns, lost_count)) in NAMES.iter().zip(all) {
            let Some(found) = Quantiles::of(half_ns) else {
                println!("  {name:<7} no trip came back, {lost_count} were lost");
                continue;
            };
            let us = |ns: u64| ns as f64 * 1e-3;
            println!(
                "  {name:<7} p50 {:8.2} us   p99 {:8.2} us   p99.9 {:9.2} us   {} trips, {lost_count} lost",
                us(found.p50_ns),
                us(found.p99_ns),
                us(found.p99_9_ns),
                found.count
            );
            println!(
                "{}",
                json!({"bench": BENCH, "case": case, "contestant": name, "half_trip": found.to_json(), "lost": lost_count})
            );
        }
        for [one, reference] in PAIRS
            .into_iter()
            .filter(|pair| pair.iter().all(|one| *one < arguments.count()))
        {
            for (at, figure) in ["p50", "p99"].into_iter().enumerate() {
                let ratios = self
                    .rounds
                    .iter()
                    .map(|round| round[one][at] as f64 / round[reference][at] as f64);
                let is_product = ![RELAY, RATTAN].contains(&one);
                let aim = (is_product && figure == "p50").then(|| arguments.aim(reference));
                print_ratio(
                    &case,
                    figure,
                    [NAMES[one], NAMES[reference]],
                    &ratios.collect::<Vec<f64>>(),
                    aim,
                );
            }
        }
    }
}

fn print_ratio(case: &str, figure: &str, names: [&str; 2], ratios: &[f64], aim: Option<f64>) {
    let [one, reference] = names;
    let Some(found) = TypicalRatio::of(ratios) else {
        println!("  {case}: too few rounds for {figure} {one} / {reference}");
        return;
    };
    let TypicalRatio { ratio, low, high } = found;
    let judged = aim.map_or("", |aim| verdict(&found, aim));
    let said = aim.map_or_else(String::new, |aim| format!(", aim at most {aim}"));
    println!("  {judged:<9} {figure} {one} / {reference}: {ratio:.3} [{low:.3}, {high:.3}]{said}");
    println!(
        "{}",
        json!({
            "bench": BENCH, "case": case, "figure": figure, "of": one, "to": reference, "ratio": ratio,
            "interval_95": [low, high], "rounds": ratios.len(), "aim_max": aim, "verdict": judged,
        })
    );
}

fn measure(arguments: Arguments) -> Result<(), SetupError> {
    let Arguments {
        round_count,
        turn,
        wait,
        pins,
        ..
    } = &arguments;
    let placed = match pins {
        [Some(first), Some(second)] => format!("hosts on processors {first} and {second}"),
        _ => "nothing pinned".to_owned(),
    };
    let facts = HostFacts::read(&format!("{placed}; the programs block"));
    println!(
        "{}\n{round_count} rounds of a {turn:?} turn of each in each case, order by lot of seed {SEED}; ratios of each \
         round's quantiles, their mean (of logarithms, without the fifth at either end) with its 95 % bootstrap \
         interval over the rounds; each interval holds by itself",
        json!({"bench": BENCH, "host": facts.to_json(), "rounds": round_count, "turn_s": turn.as_secs_f64(),
            "wait": wait, "seed": SEED})
    );
    println!("binary: {}", hil_runtime_binary().display());
    let network = Network::open();
    let lab = network.lab().ok_or_else(|| network.note().to_owned())?;
    let folder = RunFolder::new(BENCH);
    let executable = env::current_exe()?;
    let executable = executable
        .to_str()
        .ok_or("this file has no name in letters")?;
    let start = Start {
        lab,
        folder: &folder,
        executable,
        pins: arguments.pins,
        wait: arguments.wait,
        span: arguments.span()?,
        rattan: arguments.rattan.as_deref(),
    };
    let mut contestants = Vec::new();
    for index in 0..arguments.count() {
        contestants.push(start.contestant(index)?);
        if arguments.is_alone() {
            contestants[index].signal(Signal::SIGSTOP);
        }
    }
    let mut contest = Contest {
        arguments,
        contestants,
        lots: RandomStream::new(SEED, "turns"),
    };
    contest.trips()?;
    contest.loads()?;
    for (contestant, name) in contest.contestants.into_iter().zip(NAMES) {
        contestant.signal(Signal::SIGCONT);
        contestant
            .end()
            .map_err(|error| format!("{name} at its end: {error}"))?;
    }
    Ok(())
}

/// This file as a program of a contestant, or as what carries its frames.
fn take_part(words: &[String]) -> Option<Result<(), SetupError>> {
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let owned =
        |words: &[&str]| -> Vec<String> { words.iter().map(|word| (*word).to_owned()).collect() };
    Some(match words[..] {
        ["--echo", control, ..] => program::echo(Path::new(control)).map_err(Into::into),
        ["--ping", control, peer] => match peer.parse() {
            Ok(peer) => program::ask(Path::new(control), peer).map_err(Into::into),
            Err(error) => Err(SetupError::from(error)),
        },
        ["--relay", here, there, inside, wait, ref program @ ..] => {
            relay_of(here, there, inside, wait, &owned(program))
        }
        [relay::INSIDE, inside, ref program @ ..] => match inside.parse() {
            Ok(inside) => Err(relay::become_program(inside, &owned(program))),
            Err(error) => Err(SetupError::from(error)),
        },
        _ => return None,
    })
}

fn relay_of(
    here: &str,
    there: &str,
    inside: &str,
    wait: &str,
    program: &[String],
) -> Result<(), SetupError> {
    let ends: [SocketAddr; 2] = [here.parse()?, there.parse()?];
    relay::run(ends, inside.parse()?, wait == "spin", program)
}

#[allow(
    clippy::print_stderr,
    reason = "what a part of a contestant says before it fails"
)]
fn main() -> ExitCode {
    let words: Vec<String> = env::args()
        .skip(1)
        .filter(|word| word != "--bench")
        .collect();
    match take_part(&words) {
        Some(Ok(())) => ExitCode::SUCCESS,
        Some(Err(error)) => {
            eprintln!("{BENCH}: {error}");
            ExitCode::FAILURE
        }
        None => {
            // A set-up that panics has said why, and cleaned up.
            let measured = thread::spawn(|| Arguments::read(words.into_iter()).and_then(measure));
            let panicked = |_cause| Err("a set-up failed, see above".into());
            turns::exit(BENCH, measured.join().unwrap_or_else(panicked))
        }
    }
}
