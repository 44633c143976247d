//! What each stage of a gateway hop costs, in one thread, with the product's own types; and what
//! the product's loops take for a whole hop, so that nothing between the stages stays hidden. Not
//! a test: it states its aim and whether it was met, and ends with code 0.
//!
//! `cargo bench -p hil-benches --bench gateway_stages -- [--quick] [--rounds N]`, about 20 s,
//! quick 5 s. Namespaces and real-time priority take root; without, it says what is missing.
#![allow(clippy::print_stdout, reason = "a bench prints its result")]

use std::cell::RefCell;
use std::process::ExitCode;
use std::sync::atomic::AtomicUsize;
use std::thread;
use std::time::{Duration, Instant as Stopwatch};

use hil_benches::gateway::hosts::{Hosts, Plan, Ports, SetupError, greet};
use hil_benches::gateway::network::Network;
use hil_benches::gateway::notices::{announce, ended};
use hil_benches::gateway::parties::{MachineTime, PRIORITY, claim, stolen_text};
use hil_benches::gateway::stages::{BATCH, STAGES, Stage, Workbench};
use hil_benches::gateway::verdict::Verdict;
use hil_benches::{Case, Comparison, Row, compare, json_line, table};
use hil_core::endpoint::InputPort;
use hil_core::time::Instant;
use hil_engine::gateway::direction::Direction;
use hil_platform::clock::MonotonicClock;
use hil_platform::wait::WaitMode;
use hil_rundir::launch::DirectionLaunch;
use serde_json::json;

const BENCH: &str = "gateway_stages";
/// Everything that is not a socket call, in sum, at 64 B.
const SUM_NS_MAX: f64 = 500.0;
const SIZES: [usize; 2] = [64, 1024];
/// Batches per round.
const BATCHES: usize = 60;

/// The product's own loops over the same wire, both ends stepped by this thread.
struct WholeHop {
    near: Ports,
    far: Ports,
    egress: (DirectionLaunch, Direction),
    ingress: (DirectionLaunch, Direction),
    payload: Vec<u8>,
}

impl WholeHop {
    fn open(hosts: &mut Hosts, plan: Plan) -> Result<Self, SetupError> {
        let [near, far] = hosts.add(plan)?;
        let ports = (
            Ports::open(&near.address, &plan, 0, false)?,
            Ports::open(&far.address, &plan, 1, false)?,
        );
        let ([egress, _], [_, ingress]) = (near.split(), far.split());
        Ok(Self {
            near: ports.0,
            far: ports.1,
            egress: egress.connect()?,
            ingress: ingress.connect()?,
            payload: vec![7; plan.size_bytes],
        })
    }

    fn greet(&mut self) -> Result<(), SetupError> {
        let mut directions = [
            (&self.egress.0, &mut self.egress.1),
            (&self.ingress.0, &mut self.ingress.1),
        ];
        greet(&mut directions, &AtomicUsize::new(1))
    }

    /// Nanoseconds of the sending and of the receiving gateway's step for one message.
    fn hop(&mut self) -> Result<[u64; 2], SetupError> {
        self.near.output.publish(Instant::ZERO, &self.payload)?;
        let started = Stopwatch::now();
        self.egress.1.step()?;
        let sent = started.elapsed();
        let handed_over = Stopwatch::now();
        self.ingress.1.step()?;
        let received = handed_over.elapsed();
        let mut has_come = false;
        while self
            .far
            .input
            .receive(Instant::ZERO, &mut |_, _| has_come = true)?
        {}
        // What is due besides messages is done here, untimed.
        while self.egress.1.step()? || self.ingress.1.step()? {}
        if !has_come {
            return Err("a message got lost on the way".into());
        }
        Ok([sent, received].map(|time| u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)))
    }
}

/// Stages and whole steps of one payload size; one pass per round fills all columns.
struct Measured {
    bench: Workbench,
    whole: WholeHop,
    columns: Vec<Vec<u64>>,
}

const WHOLE: [&str; 2] = [
    "Direction::step, sending end",
    "Direction::step, receiving end",
];

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
        // Lets ordinary work have the processor, the writer of the records among it.
        thread::sleep(Duration::from_millis(30));
        self.columns.iter_mut().for_each(Vec::clear);
        for batch in 0..=BATCHES {
            let stages = self.bench.batch()?;
            let mut hops = [[0; 2]; BATCH];
            for hop in &mut hops {
                *hop = self.whole.hop()?;
            }
            // The first batch warms the caches.
            if batch > 0 {
                let (of_stages, of_whole) = self.columns.split_at_mut(STAGES.len());
                for (column, ns) in of_stages.iter_mut().zip(stages) {
                    column.push(ns);
                }
                for hop in hops {
                    of_whole[0].push(hop[0]);
                    of_whole[1].push(hop[1]);
                }
            }
        }
        Ok(())
    }
}

fn clock_batch() -> Vec<u64> {
    let batch = |_| {
        let started = Stopwatch::now();
        for _ in 0..BATCH {
            std::hint::black_box(MonotonicClock::now());
        }
        u64::try_from(started.elapsed().as_nanos()).unwrap_or(u64::MAX) / BATCH as u64
    };
    (0..2000).map(batch).collect()
}

fn name(what: &str, size: usize) -> &'static str {
    // A handful, needed until the end of the program.
    format!("{what}, {size} B").leak()
}

fn run(measured: &[RefCell<Measured>], rounds: usize) -> Comparison {
    let whats = || {
        STAGES
            .iter()
            .map(|stage| stage.name)
            .chain(WHOLE)
            .enumerate()
    };
    let mut columns: Vec<_> = measured
        .iter()
        .zip(SIZES)
        .flat_map(|(measured, size)| {
            whats().map(move |(index, what)| {
                let round = move || measured.borrow_mut().column(index);
                (name(what, size), round)
            })
        })
        .collect();
    let mut cases: Vec<_> = columns
        .iter_mut()
        .map(|(name, round)| Case { name, round })
        .collect();
    compare(rounds, &mut clock_batch, &mut cases)
}

fn p50(row: &Row) -> Option<u64> {
    row.quantiles.map(|quantiles| quantiles.p50_ns)
}

/// Sum of the medians of the stages `wanted` picks, each as often as a hop does it.
fn sum_ns(rows: &[Row], wanted: impl Fn(&Stage) -> bool) -> Option<u64> {
    let stages = rows.iter().zip(STAGES).filter(|(_, stage)| wanted(stage));
    stages
        .map(|(row, stage)| Some(p50(row)? * stage.per_hop))
        .sum()
}

fn report(outcome: &Comparison, size: usize, rows: &[Row]) {
    let own = sum_ns(rows, |stage| !stage.is_socket_call);
    let calls = sum_ns(rows, |stage| stage.is_socket_call);
    let whole = p50(&rows[STAGES.len()]).zip(p50(&rows[STAGES.len() + 1]));
    let whole = whole.map(|(sending, receiving)| sending + receiving);
    let text = |ns: Option<u64>| ns.map_or("unavailable".to_owned(), |ns| format!("{ns} ns"));
    println!("{size} B: not a socket call, in sum: {}", text(own));
    let shared_memory = sum_ns(rows, |stage| stage.is_shared_memory);
    println!("{size} B: of that shared memory: {}", text(shared_memory));
    println!("{size} B: three socket calls: {}", text(calls));
    println!("{size} B: whole hop by Direction::step: {}", text(whole));
    let beside = own.zip(calls).zip(whole);
    let beside = beside.map(|((own, calls), whole)| i128::from(whole) - i128::from(own + calls));
    println!(
        "{size} B: of it in none of the stages: {} ns",
        beside.unwrap_or(0)
    );
    println!(
        "{}",
        json!({"bench": BENCH, "size_bytes": size, "own_sum_ns": own,
            "shared_memory_ns": shared_memory, "socket_calls_ns": calls,
            "whole_hop_ns": whole, "floor_p50_ns": outcome.floor.quantiles.map(|q| q.p50_ns)})
    );
    if size == 64 {
        let verdict = Verdict {
            name: "stages of a hop that are no socket call, 64 B, sum of medians".to_owned(),
            measured: own.map(|ns| ns as f64),
            aim_max: SUM_NS_MAX,
            note: "ns".to_owned(),
        };
        println!("{}\n{}", verdict.text(), verdict.json_line(BENCH));
    }
}

fn measure_all() -> Result<(), SetupError> {
    let is_quick = std::env::args().any(|argument| argument == "--quick");
    let mut arguments = std::env::args().skip_while(|argument| argument != "--rounds");
    let given = arguments.nth(1).and_then(|text| text.parse().ok());
    let rounds = given.unwrap_or(if is_quick { 20 } else { 100 });
    let mut hosts = Hosts::create(Network::open())?;
    let mut opened = Vec::new();
    for (size, names) in SIZES
        .into_iter()
        .zip([["stages64", "whole64"], ["stages1k", "whole1k"]])
    {
        let plan = |name| Plan {
            name,
            size_bytes: size,
            wait: WaitMode::Spin,
            is_stamped: true,
            depth: BATCH,
        };
        let bench = Workbench::open(&mut hosts, plan(names[0]))?;
        let whole = WholeHop::open(&mut hosts, plan(names[1]))?;
        opened.push(Measured {
            bench,
            whole,
            columns: vec![Vec::new(); STAGES.len() + WHOLE.len()],
        });
    }
    hosts.start_recording()?;
    for measured in &mut opened {
        measured.whole.greet()?;
    }
    // Receive stamps are switched on by a kernel worker, which needs a moment.
    thread::sleep(Duration::from_millis(300));
    let refusals = claim(0);
    announce(
        BENCH,
        &format!("one thread on cpu 0, SCHED_FIFO {PRIORITY} asked for"),
        hosts.network.note(),
    );
    println!("nanoseconds per message; stages are means of {BATCH} messages, steps are single;");
    println!("sending includes the way to the receiving socket, as both are on one processor");
    let measured: Vec<_> = opened.into_iter().map(RefCell::new).collect();
    let before = MachineTime::read();
    let outcome = run(&measured, rounds);
    println!("{}", stolen_text(before, MachineTime::read()));
    for row in &outcome.rows {
        println!("{}", json_line(BENCH, &outcome, row, row));
    }
    let own: Vec<usize> = (0..outcome.rows.len()).collect();
    println!("\nthe floor is a clock read\n{}", table(&outcome, &own));
    for (rows, size) in outcome.rows.chunks(STAGES.len() + WHOLE.len()).zip(SIZES) {
        report(&outcome, size, rows);
    }
    drop(measured);
    println!("records dropped: {}", hosts.finish_recording());
    for refusal in refusals {
        println!("refused by the kernel: {refusal}");
    }
    for left in hosts.remove() {
        println!("left behind: {left}");
    }
    Ok(())
}

fn main() -> ExitCode {
    ended(BENCH, measure_all())
}
