//! A whole run that takes turns: one thing is done to it in some of them, another or nothing in the
//! others, and each round of turns gives one ratio, so that what the machine does meanwhile hits all
//! alike. A round goes through its turns and back (A B B A), in an order by lot, so that a machine that
//! becomes faster or slower within it favours none; the turn in the middle is one of twice the length.
//! The run is the shuttle on two hosts, with processes and gateways of its own.

#![allow(clippy::print_stdout, reason = "a bench prints its result")]

mod arguments;

pub use arguments::Arguments;

use std::ops::Range;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;
use std::{fs, thread};

use hil_core::random::RandomStream;
use hil_core::record::{TakenRecord, UNAVAILABLE};
use hil_platform::clock::MonotonicClock;
use hil_platform::signals::EXIT_INTERRUPTED;
use hil_rundir::record::{RecordFile, RecordKind};
use hil_tests::child::ChildGuard;
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::Trial;
use nix::sys::signal::Signal;
use serde_json::{Value, json};

use crate::gateway::hosts::SetupError;
use crate::gateway::parties::{MachineTime, stolen_text};
use crate::{HostFacts, Quantiles, TypicalRatio, on_cpu};

const SEED: u64 = 11;
/// The first messages meet cold processes.
const WARM_UP: Duration = Duration::from_secs(3);
const LIMIT: Duration = Duration::from_mins(1);

/// A turn, monotonic nanoseconds.
pub type Turn = Range<i64>;

/// Measures for `length` from `guard` after now, when what begins the turn has passed.
pub fn wait_turn(guard: Duration, length: Duration) -> Turn {
    thread::sleep(guard);
    let from = MonotonicClock::now().as_ns();
    thread::sleep(length);
    from..MonotonicClock::now().as_ns()
}

/// The turns of one round, by kind.
type Round<const N: usize> = [Vec<Turn>; N];

/// What is compared and what it may come to.
#[derive(Debug, Clone, Copy)]
pub struct Contest<const N: usize> {
    /// Name of the bench.
    pub bench: &'static str,
    /// Names of the kinds of turns; all others are set against the first.
    pub kinds: [&'static str; N],
    /// Largest ratio wished for of the medians and of the 99th percentiles.
    pub aims: [f64; 2],
    /// Time that a round needs at most besides its turns.
    pub extra: Duration,
}

/// Does one turn: of which kind, and how long it is measured.
pub type Take<'a> = &'a mut dyn FnMut(usize, Duration) -> Result<Turn, SetupError>;

/// Ratios of one round to the first kind: median and 99th percentile of each other kind, in their order.
type Ratios = Vec<[f64; 2]>;

/// What one latency of one channel did over all rounds.
#[derive(Debug)]
struct Outcome<const N: usize> {
    case: String,
    /// Rounds with messages in all of their turns, and all rounds that were taken.
    judged_count: usize,
    round_count: usize,
    /// In the order of the kinds; `None` where several channels are taken together.
    quantiles: Option<[Quantiles; N]>,
    /// Median and 99th percentile against the first kind; the others in their order.
    ratios: Vec<[TypicalRatio; 2]>,
    /// What they were made of; `None` for a round without messages in all of its turns.
    by_round: Vec<Option<Ratios>>,
}

impl<const N: usize> Outcome<N> {
    fn rounds_text(&self) -> String {
        let (judged, all) = (self.judged_count, self.round_count);
        match all - judged {
            0 => format!("all {all} rounds judged"),
            out => format!("{judged} of {all} rounds judged, {out} without messages left out"),
        }
    }
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

impl<const N: usize> Contest<N> {
    /// Runs the shuttle on the hosts of `lab` for as long as it takes, has `take` do each turn by the
    /// index of its kind, and prints what it came to.
    ///
    /// # Errors
    /// When the run cannot be started or fails, or a turn does.
    pub fn hold(&self, arguments: &Arguments, lab: &Lab, take: Take<'_>) -> Result<(), SetupError> {
        let pins = &arguments.pins;
        let facts = HostFacts::read(&if pins.is_empty() {
            "as the topology says: nothing pinned, wait = block".to_owned()
        } else {
            format!("the processes of the hosts pinned to {pins:?}, wait = block")
        });
        println!("{}", self.heading(&facts, arguments));
        let record = RunFolder::new(self.bench);
        let one_round_s = 2.0 * arguments.turn.as_secs_f64() * N as f64 + self.extra.as_secs_f64();
        let span_s = (one_round_s * arguments.round_count as f64 + 10.0).ceil();
        let mut trial = Trial::shipped("shuttle-split.toml", record.path())
            .plain()
            .set(&format!("run.duration=\"{span_s} s\""))
            .set(&format!("case.parameters.rate_hz={:?}", arguments.rate_hz));
        for setting in &arguments.settings {
            trial = trial.set(setting);
        }
        let mut hosts = [
            start(&trial, lab, 0, &arguments.pins)?,
            start(&trial, lab, 1, &arguments.pins)?,
        ];
        let folder = trial.folder("-control-pc", LIMIT);
        thread::sleep(WARM_UP);
        let before = MachineTime::read();
        let rounds = take_rounds::<N>(arguments.round_count, arguments.turn, take)?;
        println!("{}", stolen_text(before, MachineTime::read()));
        for host in &hosts {
            host.signal(Signal::SIGINT)?;
        }
        for host in &mut hosts {
            let finished = host.wait_within(Duration::from_secs_f64(span_s) + LIMIT)?;
            if !matches!(finished.status.code(), Some(0 | EXIT_INTERRUPTED)) {
                return Err(format!("the run failed: {finished:?}").into());
            }
        }
        // Either folder holds the records of both hosts.
        let channels = taken_records(folder.root())?;
        for (name, latency) in LATENCIES {
            let mut judged = Vec::new();
            for (channel, records) in &channels {
                let case = format!("{channel}, {name}");
                match judge(&case, records, &rounds, latency) {
                    Some(outcome) => {
                        self.print(&outcome);
                        judged.push(outcome);
                    }
                    None => println!("\n{case}: too few of {} rounds with messages", rounds.len()),
                }
            }
            if let Some(outcome) = together(&format!("all channels, {name}"), &judged) {
                self.print(&outcome);
            }
        }
        Ok(())
    }

    fn heading(&self, facts: &HostFacts, arguments: &Arguments) -> String {
        let turn_s = arguments.turn.as_secs_f64();
        format!(
            "{}\n{} rounds of two {turn_s} s turns of each kind at {} Hz, there and back, order by lot of \
             seed {SEED}; ratios of each round's quantiles, their mean (of logarithms, without the fifth \
             at either end) with its 95 % bootstrap interval over the rounds; each interval holds by \
             itself, not adjusted for how many there are",
            json!({"bench": self.bench, "host": facts.to_json(), "rounds": arguments.round_count,
                "turn_s": turn_s, "rate_hz": arguments.rate_hz, "seed": SEED,
                "settings": arguments.settings}),
            arguments.round_count,
            arguments.rate_hz
        )
    }

    fn print(&self, outcome: &Outcome<N>) {
        println!("\n{}: {}", outcome.case, outcome.rounds_text());
        for (kind, found) in self.kinds.iter().zip(outcome.quantiles.iter().flatten()) {
            let us = |ns: u64| ns as f64 * 1e-3;
            println!(
                "  {kind:<10} p50 {:8.2} us   p99 {:8.2} us   p99.9 {:9.2} us   {} messages",
                us(found.p50_ns),
                us(found.p99_ns),
                us(found.p99_9_ns),
                found.count
            );
        }
        let quantiles = outcome.quantiles.iter().flatten().map(Quantiles::to_json);
        let quantiles: Vec<Value> = quantiles.collect();
        let reference = self.kinds[0];
        for (kind, ratios) in self.kinds[1..].iter().zip(&outcome.ratios) {
            for ((figure, ratio), aim) in ["p50", "p99"].into_iter().zip(ratios).zip(self.aims) {
                let verdict = verdict(ratio, aim);
                let TypicalRatio { ratio, low, high } = *ratio;
                println!(
                    "  {verdict:<9} {figure} {kind} / {reference}: {ratio:.4} \
                     [{low:.4}, {high:.4}], aim at most {aim}"
                );
                println!(
                    "{}",
                    json!({
                        "bench": self.bench, "case": outcome.case, "kind": kind, "figure": figure,
                        "judged_rounds": outcome.judged_count, "rounds": outcome.round_count,
                        "ratio": ratio, "interval_95": [low, high], "aim_max": aim,
                        "verdict": verdict, "quantiles": quantiles,
                    })
                );
            }
        }
    }
}

/// Whether the whole interval of `ratio` is within `aim`.
pub fn verdict(ratio: &TypicalRatio, aim: f64) -> &'static str {
    if ratio.high <= aim {
        "PASS"
    } else if ratio.low > aim {
        "FAIL"
    } else {
        "UNDECIDED"
    }
}

/// Starts the run of one host, whose processes stay on its processor, if it has one.
fn start(trial: &Trial, lab: &Lab, index: usize, pins: &[usize]) -> Result<ChildGuard, SetupError> {
    let cpu = pins.get(index).copied();
    Ok(on_cpu(cpu, || trial.start_on(lab.host(index)))?)
}

/// Every kind twice a round: there in an order drawn by lot, and back.
fn take_rounds<const N: usize>(
    round_count: usize,
    turn: Duration,
    take: Take<'_>,
) -> Result<Vec<Round<N>>, SetupError> {
    let mut lots = RandomStream::new(SEED, "turns");
    let mut rounds = Vec::new();
    for _ in 0..round_count {
        let mut order: [usize; N] = core::array::from_fn(|index| index);
        for last in (1..N).rev() {
            let chosen = lots.next_u64() % (last as u64 + 1);
            order.swap(last, usize::try_from(chosen)?);
        }
        let mut round: Round<N> = core::array::from_fn(|_| Vec::new());
        let Some((&middle, others)) = order.split_last() else {
            continue;
        };
        for &index in others {
            round[index].push(take(index, turn)?);
        }
        round[middle].push(take(middle, turn * 2)?);
        for &index in others.iter().rev() {
            round[index].push(take(index, turn)?);
        }
        rounds.push(round);
    }
    Ok(rounds)
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

fn samples(records: &[TakenRecord], turns: &[Turn], latency: Latency) -> Vec<u64> {
    let during = records
        .iter()
        .filter(|record| turns.iter().any(|turn| turn.contains(&record.published_ns)));
    during.filter_map(latency).collect()
}

/// A round without a message of one kind is left out; `None` with too few others.
fn judge<const N: usize>(
    case: &str,
    records: &[TakenRecord],
    rounds: &[Round<N>],
    latency: Latency,
) -> Option<Outcome<N>> {
    let mut all: [Vec<u64>; N] = core::array::from_fn(|_| Vec::new());
    let mut by_round = Vec::new();
    for round in rounds {
        let mut during = round
            .each_ref()
            .map(|turns| samples(records, turns, latency));
        let found: Option<Vec<Quantiles>> =
            during.iter_mut().map(|some| Quantiles::of(some)).collect();
        let Some([reference, others @ ..]) = found.as_deref() else {
            by_round.push(None);
            continue;
        };
        let ratio = |one: u64, to: u64| one as f64 / to as f64;
        let ratios = others.iter().map(|other| {
            [
                ratio(other.p50_ns, reference.p50_ns),
                ratio(other.p99_ns, reference.p99_ns),
            ]
        });
        by_round.push(Some(ratios.collect()));
        for (all, some) in all.iter_mut().zip(&mut during) {
            all.append(some);
        }
    }
    let quantiles: Option<Vec<Quantiles>> =
        all.iter_mut().map(|some| Quantiles::of(some)).collect();
    outcome(case, Some(quantiles?.try_into().ok()?), by_round)
}

/// What several channels did in the same rounds, each round by the geometric mean of their ratios: what
/// is common to them shows with less noise than in any of them. `None` for fewer than two.
fn together<const N: usize>(case: &str, judged: &[Outcome<N>]) -> Option<Outcome<N>> {
    let [first, others @ ..] = judged else {
        return None;
    };
    let share = 1.0 / judged.len() as f64;
    let by_round = (0..first.by_round.len()).map(|round| {
        let each = judged.iter().map(|one| one.by_round[round].as_ref());
        let each: Vec<&Ratios> = each.collect::<Option<_>>()?;
        let mean = |kind: usize, figure: usize| {
            let product: f64 = each.iter().map(|ratios| ratios[kind][figure]).product();
            product.powf(share)
        };
        Some(
            (0..N - 1)
                .map(|kind| [mean(kind, 0), mean(kind, 1)])
                .collect(),
        )
    });
    let by_round = by_round.collect();
    outcome(case, None, by_round).filter(|_| !others.is_empty())
}

fn outcome<const N: usize>(
    case: &str,
    quantiles: Option<[Quantiles; N]>,
    by_round: Vec<Option<Ratios>>,
) -> Option<Outcome<N>> {
    let judged: Vec<&Ratios> = by_round.iter().flatten().collect();
    let typical = |kind: usize, figure: usize| {
        let each: Vec<f64> = judged.iter().map(|ratios| ratios[kind][figure]).collect();
        TypicalRatio::of(&each)
    };
    let ratios = (0..N - 1).map(|kind| Some([typical(kind, 0)?, typical(kind, 1)?]));
    Some(Outcome {
        case: case.to_owned(),
        judged_count: judged.len(),
        round_count: by_round.len(),
        quantiles,
        ratios: ratios.collect::<Option<_>>()?,
        by_round,
    })
}

/// Ends with code 0 whether it was met or not: the figure is the result.
pub fn exit(bench: &str, measured: Result<(), SetupError>) -> ExitCode {
    if let Err(error) = measured {
        println!("{bench}: not measurable here: {error}");
    }
    ExitCode::SUCCESS
}

#[cfg(test)]
mod tests {
    use super::*;

    fn taken(published_ns: i64, span_ns: i64) -> TakenRecord {
        TakenRecord {
            published_ns,
            taken_ns: published_ns + span_ns,
            forwarded_ns: UNAVAILABLE,
            ..bytemuck::Zeroable::zeroed()
        }
    }

    #[test]
    fn each_round_gives_one_ratio_and_a_missing_stamp_none() {
        // What is done in the second kind of turns takes twice as long; the machine slows down from
        // turn to turn, by so much that only there and back makes up for it.
        let mut records = Vec::new();
        let mut rounds: Vec<Round<2>> = Vec::new();
        for round in 0..8_i64 {
            let mut turns = [Vec::new(), Vec::new()];
            for (place, kind) in [0_usize, 1, 1, 0].into_iter().enumerate() {
                let from = (round * 4 + i64::try_from(place).unwrap()) * 1000;
                let each_ns = (1 + i64::try_from(kind).unwrap()) * (1000 + from / 10);
                records.extend((0..100).map(|step| taken(from + step, each_ns)));
                turns[kind].push(from..from + 1000);
            }
            rounds.push(turns);
        }
        let [(_, hop), (_, whole)] = LATENCIES;
        let found = judge("case", &records, &rounds, whole).unwrap();
        let [p50, _] = found.ratios[0];
        assert!((1.8..2.2).contains(&p50.low) && p50.high < 2.2, "{p50:?}");
        let counts = found.quantiles.as_ref().unwrap().map(|found| found.count);
        assert_eq!(counts, [1600, 1600]);
        assert_eq!(found.rounds_text(), "all 8 rounds judged");
        let both = together(
            "both",
            &[judge("again", &records, &rounds, whole).unwrap(), found],
        );
        let both = both.unwrap();
        assert!((both.ratios[0][0].ratio - p50.ratio).abs() < 1e-9 && both.quantiles.is_none());
        records.retain(|record| !rounds[1][1][0].contains(&record.published_ns));
        records.retain(|record| !rounds[1][1][1].contains(&record.published_ns));
        let fewer = judge("case", &records, &rounds, whole).unwrap();
        let said = "7 of 8 rounds judged, 1 without messages left out";
        assert_eq!(fewer.rounds_text(), said);
        assert!(together("one", &[fewer]).is_none());
        assert!(judge("case", &records, &rounds, hop).is_none());
        assert!(judge("case", &records, &rounds[..5], whole).is_none());
    }

    #[test]
    fn a_verdict_needs_the_whole_interval() {
        let of = |low, high| {
            verdict(
                &TypicalRatio {
                    ratio: 1.0,
                    low,
                    high,
                },
                1.02,
            )
        };
        assert_eq!(of(0.9, 1.02), "PASS");
        assert_eq!(of(1.03, 1.1), "FAIL");
        assert_eq!(of(1.0, 1.1), "UNDECIDED");
    }

    #[test]
    fn every_kind_has_its_turns_there_and_back_and_not_always_in_one_order() {
        let turn = Duration::from_secs(1);
        let mut taken = Vec::new();
        let rounds = take_rounds::<3>(12, turn, &mut |kind, length| {
            taken.push((kind, length.as_secs()));
            Ok(0..1)
        });
        let counts = rounds.unwrap();
        let counts = counts.iter().map(|round| round.each_ref().map(Vec::len));
        assert!(
            counts
                .into_iter()
                .all(|counts| counts.iter().sum::<usize>() == 5)
        );
        let rounds: Vec<&[(usize, u64)]> = taken.chunks(5).collect();
        for round in &rounds {
            let back: Vec<(usize, u64)> = round.iter().rev().copied().collect();
            assert_eq!(*round, back, "there and back");
            for kind in 0..3 {
                let lengths = round.iter().filter(|(one, _)| *one == kind);
                assert_eq!(
                    lengths.map(|(_, length)| length).sum::<u64>(),
                    2,
                    "{round:?}"
                );
            }
        }
        assert!(rounds.iter().any(|round| round != &rounds[0]));
    }
}
