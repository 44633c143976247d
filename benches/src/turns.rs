//! A whole run that takes turns: one thing is done to it in some of them, another or nothing in the
//! others, and each round of turns gives one ratio, so that what the machine does meanwhile hits all
//! alike. The run is the shuttle on two hosts, with processes and gateways of its own.

#![allow(clippy::print_stdout, reason = "a bench prints its result")]

use std::fs;
use std::ops::Range;
use std::path::Path;
use std::process::ExitCode;
use std::thread;
use std::time::Duration;

use hil_models::measure::record::{TakenRecord, UNAVAILABLE};
use hil_models::random::RandomStream;
use hil_runtime::clock::MonotonicClock;
use hil_runtime::record::{RecordFile, RecordKind};
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::Trial;
use serde_json::{Value, json};

use crate::gateway::hosts::SetupError;
use crate::gateway::parties::{MachineTime, stolen_text};
use crate::{HostFacts, MedianInterval, Quantiles};

/// How long a turn is measured.
pub const TURN: Duration = Duration::from_secs(2);
const SEED: u64 = 11;
/// The first messages meet cold processes.
const WARM_UP: Duration = Duration::from_secs(3);
const LIMIT: Duration = Duration::from_mins(1);

/// What a bench of turns is told.
#[derive(Debug)]
pub struct Arguments {
    /// Rounds of turns.
    pub round_count: usize,
    /// Messages per second and channel.
    pub rate_hz: f64,
    /// Settings of the topology, as `--set` takes them.
    pub settings: Vec<String>,
}

impl Arguments {
    /// Reads `[--rounds N] [--rate HZ] [--set KEY=VALUE]...` of this process.
    ///
    /// # Errors
    /// At a word it does not know, or a value that is no number.
    pub fn read() -> Result<Self, SetupError> {
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
pub type Turn = Range<i64>;

/// Measures from `guard` after now, when what begins the turn has passed, for [`TURN`].
pub fn wait_turn(guard: Duration) -> Turn {
    thread::sleep(guard);
    let from = MonotonicClock::now().as_ns();
    thread::sleep(TURN);
    from..MonotonicClock::now().as_ns()
}

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

/// What one latency of one channel did over all rounds.
#[derive(Debug)]
struct Outcome<const N: usize> {
    case: String,
    /// Rounds with messages in all of their turns, and all rounds that were taken.
    judged_count: usize,
    round_count: usize,
    /// In the order of the kinds.
    quantiles: [Quantiles; N],
    /// Median and 99th percentile against the first kind; the others in their order.
    ratios: Vec<[MedianInterval; 2]>,
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
    pub fn hold(
        &self,
        arguments: &Arguments,
        lab: &Lab,
        take: &mut dyn FnMut(usize) -> Result<Turn, SetupError>,
    ) -> Result<(), SetupError> {
        let facts = HostFacts::read("as the topology says: nothing pinned, wait = block");
        println!("{}", self.heading(&facts, arguments));
        let record = RunFolder::new(self.bench);
        let one_round_s = TURN.as_secs_f64() * N as f64 + self.extra.as_secs_f64();
        let span_s = (one_round_s * arguments.round_count as f64 + 10.0).ceil();
        let mut trial = Trial::shipped("shuttle-split.toml", record.path())
            .plain()
            .set(&format!("run.duration=\"{span_s} s\""))
            .set(&format!("case.parameters.rate_hz={:?}", arguments.rate_hz));
        for setting in &arguments.settings {
            trial = trial.set(setting);
        }
        let mut hosts = [0, 1].map(|index| trial.start_on(lab.host(index)));
        let folder = trial.folder("-control-pc", LIMIT);
        thread::sleep(WARM_UP);
        let before = MachineTime::read();
        let rounds = take_rounds::<N>(arguments.round_count, take)?;
        println!("{}", stolen_text(before, MachineTime::read()));
        for host in &mut hosts {
            let finished = host.wait_within(Duration::from_secs_f64(span_s) + LIMIT)?;
            if !finished.status.success() {
                return Err(format!("the run failed: {finished:?}").into());
            }
        }
        // Either folder holds the records of both hosts.
        for (channel, records) in taken_records(folder.root())? {
            for (name, latency) in LATENCIES {
                let case = format!("{channel}, {name}");
                match judge(&case, &records, &rounds, latency) {
                    Some(outcome) => self.print(&outcome),
                    None => println!("\n{case}: too few of {} rounds with messages", rounds.len()),
                }
            }
        }
        Ok(())
    }

    fn heading(&self, facts: &HostFacts, arguments: &Arguments) -> String {
        format!(
            "{}\n{} rounds of {} s turns at {} Hz, order by lot of seed {SEED}; ratios of each \
             round's quantiles, their median with its 95 % interval by order statistics; each interval \
             holds by itself, not adjusted for how many there are",
            json!({"bench": self.bench, "host": facts.to_json(), "rounds": arguments.round_count,
                "rate_hz": arguments.rate_hz, "seed": SEED}),
            arguments.round_count,
            TURN.as_secs_f64(),
            arguments.rate_hz
        )
    }

    fn print(&self, outcome: &Outcome<N>) {
        println!("\n{}: {}", outcome.case, outcome.rounds_text());
        for (kind, found) in self.kinds.iter().zip(&outcome.quantiles) {
            let us = |ns: u64| ns as f64 * 1e-3;
            println!(
                "  {kind:<10} p50 {:8.2} us   p99 {:8.2} us   p99.9 {:9.2} us   {} messages",
                us(found.p50_ns),
                us(found.p99_ns),
                us(found.p99_9_ns),
                found.count
            );
        }
        let quantiles = outcome.quantiles.iter().map(Quantiles::to_json);
        let quantiles: Vec<Value> = quantiles.collect();
        let reference = self.kinds[0];
        for (kind, ratios) in self.kinds[1..].iter().zip(&outcome.ratios) {
            for ((figure, ratio), aim) in ["p50", "p99"].into_iter().zip(ratios).zip(self.aims) {
                let MedianInterval { median, low, high } = *ratio;
                let verdict = verdict(ratio, aim);
                println!(
                    "  {verdict:<9} {figure} {kind} / {reference}: {median:.4} \
                     [{low:.4}, {high:.4}], aim at most {aim}"
                );
                println!(
                    "{}",
                    json!({
                        "bench": self.bench, "case": outcome.case, "kind": kind, "figure": figure,
                        "judged_rounds": outcome.judged_count, "rounds": outcome.round_count,
                        "ratio": median, "interval_95": [low, high], "aim_max": aim,
                        "verdict": verdict, "quantiles": quantiles,
                    })
                );
            }
        }
    }
}

fn verdict(ratio: &MedianInterval, aim: f64) -> &'static str {
    if ratio.high <= aim {
        "PASS"
    } else if ratio.low > aim {
        "FAIL"
    } else {
        "UNDECIDED"
    }
}

/// Every kind once a round, in an order drawn by lot.
fn take_rounds<const N: usize>(
    round_count: usize,
    take: &mut dyn FnMut(usize) -> Result<Turn, SetupError>,
) -> Result<Vec<[Turn; N]>, SetupError> {
    let mut lots = RandomStream::new(SEED, "turns");
    let mut rounds = Vec::new();
    for _ in 0..round_count {
        let mut order: [usize; N] = core::array::from_fn(|index| index);
        for last in (1..N).rev() {
            let chosen = lots.next_u64() % (last as u64 + 1);
            order.swap(last, usize::try_from(chosen)?);
        }
        let mut round: [Turn; N] = core::array::from_fn(|_| 0..0);
        for index in order {
            round[index] = take(index)?;
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

fn samples(records: &[TakenRecord], turn: &Turn, latency: Latency) -> Vec<u64> {
    let during = records
        .iter()
        .filter(|record| turn.contains(&record.published_ns));
    during.filter_map(latency).collect()
}

/// A round without a message in one of its turns is left out; `None` with fewer than six others.
fn judge<const N: usize>(
    case: &str,
    records: &[TakenRecord],
    rounds: &[[Turn; N]],
    latency: Latency,
) -> Option<Outcome<N>> {
    let mut all: [Vec<u64>; N] = core::array::from_fn(|_| Vec::new());
    let mut ratios = vec![[Vec::new(), Vec::new()]; N - 1];
    let mut judged_count = 0;
    for round in rounds {
        let mut during = round.each_ref().map(|turn| samples(records, turn, latency));
        let found: Option<Vec<Quantiles>> =
            during.iter_mut().map(|some| Quantiles::of(some)).collect();
        let Some([reference, others @ ..]) = found.as_deref() else {
            continue;
        };
        judged_count += 1;
        for (ratios, other) in ratios.iter_mut().zip(others) {
            ratios[0].push(other.p50_ns as f64 / reference.p50_ns as f64);
            ratios[1].push(other.p99_ns as f64 / reference.p99_ns as f64);
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
        case: case.to_owned(),
        judged_count,
        round_count: rounds.len(),
        quantiles: quantiles?.try_into().ok()?,
        ratios: ratios?,
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
        // Odd turns take twice as long; the machine slows down from round to round.
        let mut records = Vec::new();
        let mut rounds = Vec::new();
        for round in 0..8_i64 {
            let starts = [round * 2000, round * 2000 + 1000];
            for (start, factor) in starts.into_iter().zip([1, 2]) {
                let spans = (0..100).map(|step| taken(start + step, factor * (100 + round * 50)));
                records.extend(spans);
            }
            rounds.push(starts.map(|start| start..start + 1000));
        }
        let [(_, hop), (_, whole)] = LATENCIES;
        let outcome = judge("case", &records, &rounds, whole).unwrap();
        let [p50, p99] = outcome.ratios[0];
        assert!((p50.median - 2.0).abs() < 1e-9 && (p99.high - 2.0).abs() < 1e-9);
        assert_eq!(outcome.quantiles.map(|found| found.count), [800, 800]);
        assert_eq!(outcome.rounds_text(), "all 8 rounds judged");
        records.retain(|record| !rounds[1][1].contains(&record.published_ns));
        let fewer = judge("case", &records, &rounds, whole).unwrap();
        assert_eq!(fewer.quantiles.map(|found| found.count), [700, 700]);
        let said = "7 of 8 rounds judged, 1 without messages left out";
        assert_eq!(fewer.rounds_text(), said);
        assert!(judge("case", &records, &rounds, hop).is_none());
        assert!(judge("case", &records, &rounds[..5], whole).is_none());
    }

    #[test]
    fn a_verdict_needs_the_whole_interval() {
        let of = |low, high| {
            verdict(
                &MedianInterval {
                    median: 1.0,
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
    fn every_kind_has_its_turn_in_every_round_and_not_always_in_one_order() {
        let mut orders = Vec::new();
        take_rounds::<3>(12, &mut |index| {
            orders.push(index);
            Ok(0..1)
        })
        .unwrap();
        let rounds: Vec<&[usize]> = orders.chunks(3).collect();
        for round in &rounds {
            assert_eq!(round.iter().sum::<usize>(), 3, "{round:?}");
        }
        assert!(rounds.iter().any(|round| round != &rounds[0]));
    }
}
