//! What the EGM adapters add to the controller's cycle. A robot's application and a controller's
//! exchange one feedback and one command every 4 ms: over shared memory alone, through our own
//! gateways, and through robot adapter and sensor adapter in the maker's own datagrams; one-way times
//! from publication to being taken, all in one run. Not a test: it states its aim and whether it
//! was met, and ends with code 0.
//!
//! `cargo bench -p hil-benches --bench egm_face -- [--quick] [--rounds N]`, about 30 s, quick 6 s.
//! Namespaces and real-time priority take root; without, it says what is missing.
#![allow(clippy::print_stdout, reason = "a bench prints its result")]

use std::cell::RefCell;
use std::process::ExitCode;
use std::thread;
use std::time::Duration;

use hil_benches::adapter::{Exchange, Pair};
use hil_benches::gateway::hosts::SetupError;
use hil_benches::gateway::notices::{announce, ended};
use hil_benches::gateway::parties::{MachineTime, PRIORITY, claim, stolen_text};
use hil_benches::gateway::verdict::Verdict;
use hil_benches::{Case, Comparison, compare, json_line, table};
use hil_platform::clock::MonotonicClock;
use hil_report::adapter::AdapterSegment;
use serde_json::json;

const BENCH: &str = "egm_face";
/// The robot's cycle.
const CYCLE: Duration = Duration::from_millis(4);
/// An adapter may take this share of the cycle, at the 99th percentile, each way.
const CYCLE_SHARE_MAX: f64 = 0.1;
/// Exchanges of one case in one round.
const EXCHANGES: usize = 50;
/// Clock reads of one sample of the floor.
const BATCH: u32 = 64;

const TITLES: [&str; 6] = [
    "feedback, shared memory alone",
    "command, shared memory alone",
    "feedback, our gateways",
    "command, our gateways",
    "feedback, both EGM adapters",
    "command, both EGM adapters",
];
/// Row of each row's reference.
const REFERENCES: [usize; 6] = [0, 1, 0, 1, 0, 1];

/// The columns of one pass over the three ways.
struct Measured {
    pair: Pair,
    columns: [Vec<u64>; 6],
}

impl Measured {
    /// The column of this round; the first to ask makes the pass.
    fn column(&mut self, index: usize) -> Vec<u64> {
        if self.columns[index].is_empty()
            && let Err(error) = self.pass()
        {
            println!("{BENCH}: a pass failed: {error}");
        }
        core::mem::take(&mut self.columns[index])
    }

    fn pass(&mut self) -> Result<(), SetupError> {
        self.columns.iter_mut().for_each(Vec::clear);
        for _ in 0..EXCHANGES {
            for way in 0..3 {
                let Exchange { out_ns, back_ns } = self.pair.exchange(way, CYCLE / 3)?;
                self.columns[2 * way].push(out_ns);
                self.columns[2 * way + 1].push(back_ns);
            }
        }
        Ok(())
    }
}

fn clock_batch() -> Vec<u64> {
    let batch = |_| {
        let started = MonotonicClock::now();
        for _ in 0..BATCH {
            std::hint::black_box(MonotonicClock::now());
        }
        let ns = MonotonicClock::now().ns_since(started) / i64::from(BATCH);
        u64::try_from(ns).unwrap_or(0)
    };
    (0..2000).map(batch).collect()
}

fn run(measured: &RefCell<Measured>, rounds: usize) -> Comparison {
    let mut columns: Vec<_> = (0..TITLES.len())
        .map(|index| move || measured.borrow_mut().column(index))
        .collect();
    let mut cases: Vec<_> = columns
        .iter_mut()
        .zip(TITLES)
        .map(|(round, name)| Case { name, round })
        .collect();
    compare(rounds, &mut clock_batch, &mut cases)
}

/// What the adapters noted themselves, with kernel stamps.
fn print_segments(who: &str, segments: &[AdapterSegment]) {
    let cycle_ns = i64::try_from(CYCLE.as_nanos()).ok();
    for segment in segments {
        let share = segment.p99_of_cycle(cycle_ns);
        let figures = segment.distribution.measured();
        let text = figures.map_or("unavailable".to_owned(), |figures| {
            let us = |ns: i64| ns as f64 * 1e-3;
            format!(
                "p50 {:>7.1}  p99 {:>7.1}  p99.9 {:>7.1} us  p99 {:.2} % of the cycle",
                us(figures.p50_ns),
                us(figures.p99_ns),
                us(figures.p999_ns),
                100.0 * share.unwrap_or(f64::NAN)
            )
        });
        println!("{who:<12} {:<54} {text}", segment.name);
        println!(
            "{}",
            json!({"bench": BENCH, "face": who, "segment": segment.name,
                "p50_ns": figures.map(|one| one.p50_ns), "p99_ns": figures.map(|one| one.p99_ns),
                "p99_9_ns": figures.map(|one| one.p999_ns), "p99_of_cycle": share})
        );
    }
}

fn verdicts(outcome: &Comparison) -> Vec<Verdict> {
    let cycle_ns = CYCLE.as_nanos() as f64;
    [(4, 0), (5, 1)]
        .into_iter()
        .map(|(row, reference)| {
            let p99 = |row: usize| outcome.rows[row].quantiles.map(|one| one.p99_ns as f64);
            let added = p99(row)
                .zip(p99(reference))
                .map(|(adapter, direct)| adapter - direct);
            Verdict {
                name: format!("added p99 of {}, share of the cycle", TITLES[row]),
                measured: added.map(|added_ns| added_ns / cycle_ns),
                aim_max: CYCLE_SHARE_MAX,
                note: "of 4 ms".to_owned(),
            }
        })
        .collect()
}

fn measure_all() -> Result<(), SetupError> {
    let is_quick = std::env::args().any(|argument| argument == "--quick");
    let mut arguments = std::env::args().skip_while(|argument| argument != "--rounds");
    let given = arguments.nth(1).and_then(|text| text.parse().ok());
    let rounds = given.unwrap_or(if is_quick { 6 } else { 30 });
    let pair = Pair::start()?;
    // Receive stamps are switched on by a kernel worker, which needs a moment.
    thread::sleep(Duration::from_millis(300));
    let refusals = claim(0);
    announce(
        BENCH,
        &format!(
            "robot and its adapter on cpu 0, controller and its adapter on cpu 1, waiting in the kernel, \
         SCHED_FIFO {PRIORITY} asked for"
        ),
        pair.network_note(),
    );
    let measured = RefCell::new(Measured {
        pair,
        columns: Default::default(),
    });
    measured.borrow_mut().pair.warm_up(CYCLE / 3)?;
    let before = MachineTime::read();
    let outcome = run(&measured, rounds);
    println!("{}", stolen_text(before, MachineTime::read()));
    for (row, reference) in outcome.rows.iter().zip(REFERENCES) {
        println!(
            "{}",
            json_line(BENCH, &outcome, row, &outcome.rows[reference])
        );
    }
    println!(
        "\none way, from published to taken; the floor is a clock read\n{}",
        table(&outcome, &REFERENCES)
    );
    let Measured { pair, .. } = measured.into_inner();
    let finished = pair.finish()?;
    for (who, figures) in ["robot adapter", "sensor adapter"]
        .iter()
        .zip(&finished.figures)
    {
        print_segments(who, &figures.segments);
    }
    for verdict in verdicts(&outcome) {
        println!("{}\n{}", verdict.text(), verdict.json_line(BENCH));
    }
    for refusal in refusals.into_iter().chain(finished.refusals) {
        println!("refused by the kernel: {refusal}");
    }
    for left in finished.left {
        println!("left behind: {left}");
    }
    Ok(())
}

fn main() -> ExitCode {
    ended(BENCH, measure_all())
}
