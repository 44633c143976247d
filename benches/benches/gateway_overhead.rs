//! What the gateways add to a UDP hop. Two hosts in one process: round trips over bare stamped UDP
//! and through gateways with shared memory at both ends, one thread per host; then from application
//! to application with a thread per party; then what hybrid waiting costs at 1 kHz. Not a test: it
//! states its aims and whether they were met, and ends with code 0.
//!
//! `cargo bench -p hil-benches --bench gateway_overhead -- [--quick] [--rounds N] [--only TEXT]`, about 50 s,
//! quick 15 s. Namespaces and real-time priority take root; without, it says what is missing.
#![allow(clippy::print_stdout, reason = "a bench prints its result")]

use std::process::ExitCode;
use std::thread::Thread;
use std::time::Duration;

use hil_benches::gateway::applications::{PARTY_COUNT, PartyGroup};
use hil_benches::gateway::cases::{CasePlan, Kind, PERIOD, case_plans, only};
use hil_benches::gateway::ends::{NearEnd, Setup};
use hil_benches::gateway::hosts::{Hosts, Plan, SetupError};
use hil_benches::gateway::notices::{announce, with_a_processor_each};
use hil_benches::gateway::parties::{MachineTime, PRIORITY, Party, Usage, stolen_text};
use hil_benches::gateway::segments::{SEGMENTS, WAKE_UPS, segments};
use hil_benches::gateway::turns::{STOP, Turns, pace, ping};
use hil_benches::gateway::verdict::Verdict;
use hil_benches::{Case, Comparison, compare, json_line, table};
use hil_platform::wait::WaitMode;
use serde_json::json;

const BENCH: &str = "gateway_overhead";
/// Gateway against echo, both stamped, same wait mode.
const GATEWAY_RATIO_MAX: f64 = 1.1;
/// Application to application, blocking, against the blocking echo.
const APPLICATION_RATIO_MAX: f64 = 3.3;
/// One hybrid party at 1 kHz.
const HYBRID_SHARE_MAX: f64 = 0.15;
/// Hybrid against spinning.
const HYBRID_RATIO_MAX: f64 = 1.3;

/// How long everything takes.
#[derive(Debug, Clone, Copy)]
struct Extent {
    rounds: usize,
    slice: Duration,
    paced_slice: Duration,
}

fn argument_after(name: &str) -> Option<String> {
    std::env::args()
        .skip_while(|argument| argument != name)
        .nth(1)
}

impl Extent {
    fn from_arguments() -> Self {
        let is_quick = std::env::args().any(|argument| argument == "--quick");
        let given = argument_after("--rounds").and_then(|text| text.parse().ok());
        Self {
            rounds: given.unwrap_or(if is_quick { 6 } else { 24 }),
            slice: Duration::from_millis(30),
            paced_slice: Duration::from_millis(120),
        }
    }
}

/// Measures one case for one round.
fn measure(
    end: &mut NearEnd,
    case: &CasePlan,
    index: usize,
    turns: &Turns,
    far: &Thread,
    far_party: &Party,
    extent: Extent,
    count: &mut u64,
) -> Vec<u64> {
    match end {
        NearEnd::PingPong(side) => {
            ping(turns, far, index, side.as_mut(), count, extent.slice).whole
        }
        NearEnd::Gateway(shared, column) => shared.column(*column, |case, side| {
            ping(turns, far, case, side, count, extent.slice)
        }),
        NearEnd::Hop { side, noted, usage } => {
            let (samples, [before, after]) = pace(
                turns,
                far,
                index,
                side.as_mut(),
                extent.paced_slice,
                PERIOD,
                far_party,
                noted.as_ref(),
            );
            usage.add(before, after);
            samples
        }
        NearEnd::Applications(group) => match case.kind {
            Kind::Applications { is_paced: true } => group.round(extent.paced_slice, Some(PERIOD)),
            _ => group.round(extent.slice, None),
        },
    }
}

fn run(setup: &mut Setup, cases: &[CasePlan], extent: Extent) -> Comparison {
    let Setup {
        near,
        turns,
        far,
        far_party,
        ..
    } = setup;
    let far = far.thread().clone();
    let turns: &Turns = turns;
    let far_party: &Party = far_party;
    let mut rounds: Vec<_> = near
        .iter_mut()
        .zip(cases)
        .enumerate()
        .map(|(index, (end, case))| {
            let (far, mut count) = (far.clone(), 0);
            move || measure(end, case, index, turns, &far, far_party, extent, &mut count)
        })
        .collect();
    let mut contestants: Vec<_> = rounds
        .iter_mut()
        .zip(cases)
        .map(|(round, case)| Case {
            name: case.title,
            round,
        })
        .collect();
    let mut floor = || turns.floor(&far, extent.slice);
    compare(extent.rounds, &mut floor, &mut contestants)
}

fn ratio_verdicts(outcome: &Comparison, cases: &[CasePlan]) -> Vec<Verdict> {
    let rows = outcome.rows.iter().zip(cases);
    let judged = rows.filter_map(|(row, case)| {
        let aim_max = match case.kind {
            Kind::BetweenGateways if case.plan.is_stamped => GATEWAY_RATIO_MAX,
            Kind::Applications { is_paced: false } => APPLICATION_RATIO_MAX,
            Kind::Hop if case.plan.wait == WaitMode::Hybrid => HYBRID_RATIO_MAX,
            _ => return None,
        };
        let reference = &outcome.rows[case.reference];
        Some(Verdict {
            name: format!("{} against {}", case.title, reference.name),
            measured: row.p50_ratio_to(reference).map(|ratio| ratio.median),
            aim_max,
            note: "x at p50".to_owned(),
        })
    });
    judged.collect()
}

fn share_verdict(title: &str, usage: &Usage) -> Verdict {
    Verdict {
        name: format!("processor share, {title}"),
        measured: usage.share(),
        aim_max: HYBRID_SHARE_MAX,
        note: "of a core".to_owned(),
    }
}

/// What hybrid waiting costs, where it can be said.
fn hybrid_verdicts(setup: &Setup, cases: &[CasePlan], cpu_count: usize) -> Vec<Verdict> {
    let mut verdicts = Vec::new();
    for (end, case) in setup.near.iter().zip(cases) {
        match end {
            NearEnd::Hop { usage, .. } if case.plan.wait == WaitMode::Hybrid => {
                verdicts.push(share_verdict(case.title, usage));
            }
            NearEnd::Applications(group) if case.plan.wait == WaitMode::Hybrid => {
                let (parties, _) = group.usage();
                let dearest = parties.iter().max_by_key(|(_, usage)| usage.processor_ns);
                if let Some((party, usage)) = dearest {
                    let title = format!("{}, dearest party ({})", case.title, party.name);
                    verdicts.push(share_verdict(&title, usage));
                }
            }
            _ => {}
        }
    }
    if cpu_count < PARTY_COUNT {
        verdicts.push(Verdict {
            name: "applications hybrid against spin at 1 kHz".to_owned(),
            measured: None,
            aim_max: HYBRID_RATIO_MAX,
            note: format!("{cpu_count} processors, {PARTY_COUNT} parties that want one each"),
        });
    }
    verdicts
}

/// Who used how much, and how often each was woken.
fn print_usage(setup: &Setup, cases: &[CasePlan]) {
    println!("\nprocessor share and sleeps per round trip (or per message of a hop)");
    let line = |title: &str, name: &str, usage: &Usage, trips: u64| {
        let share = usage.share().map_or("unavailable".to_owned(), |share| {
            format!("{:.1} %", share * 100.0)
        });
        let sleeps = usage.sleep_count as f64 / trips.max(1) as f64;
        println!("{title:<38} {name:<18} {share:>12} {sleeps:>8.2}");
        println!(
            "{}",
            json!({"bench": BENCH, "case": title, "party": name, "share": usage.share(),
                "sleeps_per_round_trip": sleeps})
        );
    };
    for (end, case) in setup.near.iter().zip(cases) {
        match end {
            NearEnd::Hop { usage, .. } => {
                let messages = usage.elapsed_ns / u64::try_from(PERIOD.as_nanos()).unwrap_or(1);
                line(case.title, "far gateway", usage, messages);
            }
            NearEnd::Applications(group) => {
                let (parties, trips) = group.usage();
                for (party, usage) in parties {
                    line(case.title, party.name, usage, trips);
                }
                let sleeps: u64 = parties.iter().map(|(_, usage)| usage.sleep_count).sum();
                let all = sleeps as f64 / trips.max(1) as f64;
                println!("{:<38} {:<18} {:>12} {all:>8.2}", case.title, "all", "");
            }
            _ => {}
        }
    }
}

/// What each segment of the way took, wake-ups among them.
fn print_segments(
    hosts: &Hosts,
    title: &str,
    plan: Plan,
    woken: &[Vec<u64>; 2],
) -> Result<(), SetupError> {
    // In the two-thread cases the application is no party of its own, and the last message of a
    // round lies in its socket until the next round: medians tell, the tail does not.
    let is_stepped = woken.iter().all(Vec::is_empty);
    let columns = if is_stepped {
        "p50, p99"
    } else {
        "p50, p99, p99.9, max"
    };
    println!("\n{title}: one way, microseconds ({columns})");
    let found = segments(hosts, &plan, woken)?;
    for (index, (name, quantiles)) in SEGMENTS.iter().zip(found).enumerate() {
        let Some(quantiles) = quantiles else {
            continue;
        };
        let is_wake_up = WAKE_UPS.contains(&index) && !is_stepped;
        let name = if is_stepped {
            name.trim_end_matches(" (wake-up)")
        } else {
            name
        };
        let us = |ns: u64| ns as f64 * 1e-3;
        print!(
            "  {name:<46} {:>9.2} {:>9.2}",
            us(quantiles.p50_ns),
            us(quantiles.p99_ns)
        );
        if is_stepped {
            println!();
        } else {
            println!(
                " {:>9.2} {:>10.1}",
                us(quantiles.p99_9_ns),
                us(quantiles.max_ns)
            );
        }
        let mut line = json!({"bench": BENCH, "case": title, "segment": name,
            "is_wake_up": is_wake_up, "p50_ns": quantiles.p50_ns, "p99_ns": quantiles.p99_ns});
        if !is_stepped {
            line["p99_9_ns"] = json!(quantiles.p99_9_ns);
            line["max_ns"] = json!(quantiles.max_ns);
        }
        println!("{line}");
    }
    Ok(())
}

/// What a hop takes longer than the datagram alone, in microseconds.
fn print_added(outcome: &Comparison, cases: &[CasePlan]) {
    for (row, case) in outcome.rows.iter().zip(cases) {
        let reference = &outcome.rows[case.reference];
        let pairs = row.round_p50_ns.iter().zip(&reference.round_p50_ns);
        let mut added: Vec<i64> = pairs
            .filter_map(|(own, floor)| Some((own.checked_signed_diff(*floor)?) / 2))
            .collect();
        added.sort_unstable();
        if matches!(case.kind, Kind::BetweenGateways)
            && let Some(ns) = added.get(added.len() / 2)
        {
            println!("{}: {:.2} us more per hop", case.title, *ns as f64 * 1e-3);
            println!(
                "{}",
                json!({"bench": BENCH, "case": case.title, "added_per_hop_ns": ns})
            );
        }
    }
}

fn print_coverage(setup: &Setup, cases: &[CasePlan]) {
    let coverage = setup.near.iter().zip(cases).filter_map(|(end, case)| {
        let (stamped, all) = end.stamp_coverage()?;
        let share = 100.0 * stamped as f64 / all.max(1) as f64;
        Some(format!("{}: {share:.3} %", case.title))
    });
    let coverage: Vec<String> = coverage.collect();
    println!("\nreceive stamps: {}", coverage.join("; "));
}

fn report(
    mut setup: Setup,
    cases: &[CasePlan],
    outcome: &Comparison,
    cpu_count: usize,
) -> Result<(), SetupError> {
    for (row, case) in outcome.rows.iter().zip(cases) {
        let reference = &outcome.rows[case.reference];
        println!("{}", json_line(BENCH, outcome, row, reference));
    }
    let references: Vec<usize> = cases.iter().map(|case| case.reference).collect();
    println!("\nround trips (one way for `one hop`); the floor is a cache line's round trip,");
    println!("the reference of a gateway row the UDP echo above it");
    println!("{}", table(outcome, &references));
    print_added(outcome, cases);
    println!("messages lost: {}", setup.turns.lost_count());
    print_coverage(&setup, cases);
    print_usage(&setup, cases);
    let mut verdicts = ratio_verdicts(outcome, cases);
    verdicts.extend(hybrid_verdicts(&setup, cases, cpu_count));
    setup.turns.give(STOP, &[setup.far.thread().clone()]);
    let mut groups: Vec<(&CasePlan, PartyGroup)> = Vec::new();
    for (end, case) in setup.near.drain(..).zip(cases) {
        if let NearEnd::Applications(group) = end {
            groups.push((case, *group));
        }
    }
    let woken: Vec<_> = groups
        .into_iter()
        .map(|(case, group)| (case, group.finish()))
        .collect();
    let refused_far = setup.far.join().unwrap_or_default();
    println!("\nrecords dropped: {}", setup.hosts.finish_recording());
    let stepped = cases
        .iter()
        .filter(|case| matches!(case.kind, Kind::BetweenGateways) && case.plan.is_stamped);
    for case in stepped {
        // Their channels are those of the case before.
        let before = cases.iter().rfind(|other| {
            matches!(other.kind, Kind::Gateway) && other.reference == case.reference
        });
        if let Some(before) = before {
            print_segments(
                &setup.hosts,
                case.title,
                before.plan,
                &[Vec::new(), Vec::new()],
            )?;
        }
    }
    for (case, woken) in woken {
        print_segments(&setup.hosts, case.title, case.plan, &woken)?;
    }
    println!();
    for verdict in &verdicts {
        println!("{}", verdict.text());
        println!("{}", verdict.json_line(BENCH));
    }
    for refusal in setup.refusals.iter().chain(&refused_far) {
        println!("refused by the kernel: {refusal}");
    }
    for left in setup.hosts.remove() {
        println!("left behind: {left}");
    }
    Ok(())
}

fn measure_all(cpu_count: usize) -> Result<(), SetupError> {
    let extent = Extent::from_arguments();
    let mut cases = case_plans(cpu_count);
    if let Some(text) = argument_after("--only") {
        cases = only(&cases, &text);
    }
    let mut setup = Setup::open(&cases, cpu_count)?;
    announce(
        BENCH,
        &format!("near host on cpu 0, far host on cpu 1, SCHED_FIFO {PRIORITY} asked for"),
        setup.hosts.network.note(),
    );
    println!("without stamps means: these sockets ask for none; the host's receive stamps are on");
    let before = MachineTime::read();
    let outcome = run(&mut setup, &cases, extent);
    println!("{}", stolen_text(before, MachineTime::read()));
    report(setup, &cases, &outcome, cpu_count)
}

fn main() -> ExitCode {
    with_a_processor_each(BENCH, measure_all)
}
