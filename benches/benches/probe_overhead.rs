//! What a probe at both ends costs the gateways it watches: round trips between gateways, and one
//! hop at 1 kHz, each alone and tapped by either engine in every round, so that ratios are of
//! neighbours in time. Not a test: it states the aim and whether it was met, and ends with code 0.
//!
//! `cargo bench -p hil-benches --bench probe_overhead -- [--rounds N]`, about 60 s. Namespaces,
//! taps and real-time priority take root; without, it says what is missing.
#![allow(clippy::print_stdout, reason = "a bench prints its result")]

use std::cell::{Cell, RefCell};
use std::process::ExitCode;
use std::thread::Thread;
use std::time::Duration;

use hil_benches::gateway::cases::{CasePlan, Kind, PERIOD, case_plans};
use hil_benches::gateway::ends::{NearEnd, Setup};
use hil_benches::gateway::hosts::SetupError;
use hil_benches::gateway::notices::{announce, with_a_processor_each};
use hil_benches::gateway::parties::{MachineTime, PRIORITY, Party, stolen_text};
use hil_benches::gateway::tap::Drainer;
use hil_benches::gateway::turns::{STOP, Turns, pace, ping};
use hil_benches::gateway::verdict::Verdict;
use hil_benches::{Case, Comparison, compare, json_line, table};
use hil_gateways::transport::live_tap::TapEngine;

const BENCH: &str = "probe_overhead";
/// Tapped against alone, median and 99th percentile.
const RATIO_MAX: f64 = 1.02;
const SLICE: Duration = Duration::from_millis(60);
const PACED_SLICE: Duration = Duration::from_millis(240);

/// What is measured: title of the case, names of its rows: alone, then by each of [`ENGINES`].
const MEASURED: [(&str, [&str; 3]); 4] = [
    (
        "gateways block 64 B stamps",
        [
            "gateways block, alone",
            "gateways block, packet",
            "gateways block, bpf",
        ],
    ),
    (
        "gateways spin 64 B stamps",
        [
            "gateways spin, alone",
            "gateways spin, packet",
            "gateways spin, bpf",
        ],
    ),
    (
        "one hop spin 64 B 1 kHz",
        [
            "one hop spin 1 kHz, alone",
            "one hop spin 1 kHz, packet",
            "one hop spin 1 kHz, bpf",
        ],
    ),
    (
        "one hop block 64 B 1 kHz",
        [
            "one hop block 1 kHz, alone",
            "one hop block 1 kHz, packet",
            "one hop block 1 kHz, bpf",
        ],
    ),
];
const ENGINES: [TapEngine; 2] = [TapEngine::Packet, TapEngine::Bpf];
const ROWS_PER_CASE: usize = 1 + ENGINES.len();

/// Those measured, each after the case whose gateways it shares.
fn plans(cpu_count: usize) -> Vec<CasePlan> {
    let all = case_plans(cpu_count);
    let mut kept = Vec::new();
    for (index, case) in all.iter().enumerate() {
        if MEASURED.iter().any(|(title, _)| *title == case.title) {
            if matches!(case.kind, Kind::BetweenGateways) {
                kept.push(all[index - 1]);
            }
            kept.push(*case);
        }
    }
    kept
}

/// One case for one round.
fn measure(
    (end, index): (&mut NearEnd, usize),
    (turns, far): (&Turns, &Thread),
    far_party: &Party,
    count: &mut u64,
) -> Vec<u64> {
    match end {
        NearEnd::Gateway(shared, column) => shared.column(*column, |case, side| {
            ping((turns, far), case, side, (count, SLICE))
        }),
        NearEnd::Hop { side, noted, .. } => {
            let listening = (far_party, noted.as_ref());
            let time = (PACED_SLICE, PERIOD);
            pace((turns, far), index, side.as_mut(), time, listening).0
        }
        NearEnd::PingPong(_) | NearEnd::Applications(_) => Vec::new(),
    }
}

/// What the taps saw, over all rounds.
#[derive(Debug, Default)]
struct Tapped {
    matched_count: Cell<u64>,
    dropped_count: Cell<u64>,
    refusal: RefCell<Option<String>>,
}

fn run(
    setup: &mut Setup,
    cases: &[CasePlan],
    (drainer, tapped): (&Drainer, &Tapped),
    round_count: usize,
) -> Comparison {
    let Setup {
        hosts,
        near,
        turns,
        far,
        far_party,
        ..
    } = setup;
    let far = far.thread().clone();
    let (turns, far_party): (&Turns, &Party) = (turns, far_party);
    let network = &hosts.network;
    let near = RefCell::new(near);
    let count = Cell::new(0);
    let once = |index: usize| {
        let mut number = count.get();
        let mut near = near.borrow_mut();
        let found = measure(
            (&mut near[index], index),
            (turns, &far),
            far_party,
            &mut number,
        );
        count.set(number);
        found
    };
    let under_tap =
        |engine, index: usize| match drainer.while_tapped(network, engine, || once(index)) {
            Ok((samples, counters)) => {
                tapped
                    .matched_count
                    .set(tapped.matched_count.get() + counters.matched_count);
                tapped
                    .dropped_count
                    .set(tapped.dropped_count.get() + counters.dropped_count);
                samples
            }
            Err(error) => {
                *tapped.refusal.borrow_mut() = Some(error.to_string());
                Vec::new()
            }
        };
    let mut rounds: Vec<(&'static str, Round<'_>)> = Vec::new();
    for (title, names) in MEASURED {
        let index = cases.iter().position(|case| case.title == title);
        let Some(index) = index else { continue };
        let (once, under_tap) = (&once, &under_tap);
        rounds.push((names[0], Box::new(move || once(index))));
        for (name, engine) in names[1..].iter().zip(ENGINES) {
            rounds.push((name, Box::new(move || under_tap(engine, index))));
        }
    }
    let mut contestants: Vec<Case<'_>> = rounds
        .iter_mut()
        .map(|(name, round)| Case {
            name,
            round: round.as_mut(),
        })
        .collect();
    let mut floor = || turns.floor(&far, SLICE);
    compare(round_count, &mut floor, &mut contestants)
}

/// One slice of a contestant: its samples, nanoseconds.
type Round<'a> = Box<dyn FnMut() -> Vec<u64> + 'a>;

fn report(outcome: &Comparison) {
    let alone = |index: usize| index - index % ROWS_PER_CASE;
    let references: Vec<usize> = (0..outcome.rows.len()).map(alone).collect();
    for (row, reference) in outcome.rows.iter().zip(&references) {
        println!(
            "{}",
            json_line(BENCH, outcome, row, &outcome.rows[*reference])
        );
    }
    println!("\nround trips (one way for `one hop`); a tapped row's reference is its case alone");
    println!("{}", table(outcome, &references));
    for (row, reference) in outcome.rows.iter().zip(&references) {
        let alone = &outcome.rows[*reference];
        if row.name == alone.name {
            continue;
        }
        let ratios = [
            ("p50", row.p50_ratio_to(alone)),
            ("p99", row.p99_ratio_to(alone)),
        ];
        for (name, ratio) in ratios {
            let quartiles = ratio.map_or(String::new(), |ratio| {
                let (low, high) = (ratio.lower_quartile, ratio.upper_quartile);
                format!(" (quartiles {low:.3} to {high:.3})")
            });
            let verdict = Verdict {
                name: format!("{} {name}{quartiles}", row.name),
                measured: ratio.map(|ratio| ratio.median),
                aim_max: RATIO_MAX,
                note: "x".to_owned(),
            };
            println!("{}", verdict.text());
            println!("{}", verdict.json_line(BENCH));
        }
    }
}

fn measure_all(cpu_count: usize) -> Result<(), SetupError> {
    let mut arguments = std::env::args().skip_while(|argument| argument != "--rounds");
    let given = arguments.nth(1).and_then(|text| text.parse().ok());
    let cases = plans(cpu_count);
    let drainer = Drainer::start();
    let mut setup = Setup::open(&cases, cpu_count)?;
    announce(
        BENCH,
        &format!(
            "near host on cpu 0, far host on cpu 1, SCHED_FIFO {PRIORITY} asked for, probe free"
        ),
        setup.hosts.network.note(),
    );
    let before = MachineTime::read();
    let tapped = Tapped::default();
    let outcome = run(&mut setup, &cases, (&drainer, &tapped), given.unwrap_or(40));
    println!("{}", stolen_text(before, MachineTime::read()));
    if let Some(refusal) = tapped.refusal.borrow().as_ref() {
        println!("no tap: {refusal}");
    }
    report(&outcome);
    println!(
        "tapped {} datagrams, {} dropped; messages lost: {}",
        tapped.matched_count.get(),
        tapped.dropped_count.get(),
        setup.turns.lost_count()
    );
    setup.turns.give(STOP, &[setup.far.thread().clone()]);
    let refused_far = setup.far.join().unwrap_or_default();
    setup.near.clear();
    drainer.finish();
    for refusal in setup.refusals.iter().chain(&refused_far) {
        println!("refused by the kernel: {refusal}");
    }
    println!("records dropped: {}", setup.hosts.finish_recording());
    for left in setup.hosts.remove() {
        println!("left behind: {left}");
    }
    Ok(())
}

fn main() -> ExitCode {
    with_a_processor_each(BENCH, measure_all)
}
