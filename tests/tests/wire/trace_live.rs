//! A recorded trace behind real sockets: each datagram meets its record, and the report counts what
//! was met.

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::fs;
use std::path::Path;
use std::time::Duration;

use hil_core::link_model::{ReplayCounts, TraceMatch};
use hil_core::random::RandomStream;
use hil_core::record::IngressRecord;
use hil_tests::account::{assert_every_message_is_accounted_for, channel};
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::{CHANNELS, PERIOD_NS, emulated_shuttle, forwarded, records, trace_of};
use hil_tests::trial::{RunFiles, Trial};
use hil_trace::{Trace, TraceFate, TraceHeader, TraceRecord, wire};

const LIMIT: Duration = Duration::from_mins(1);
const RUN_S: u64 = 5;
/// Longer than the run, so that none of its messages comes after the end.
const RECORD_COUNT: u64 = 2_000;

/// What the record of `tick` delays by, no two alike.
fn delay_of(tick: u64) -> i64 {
    3_000_000 + i64::try_from(tick * 7_919 % 20_000).unwrap() * 1_000
}

/// A trace of bursts, its delays 3 to 23 ms, and of ticks that nobody published at where `misses`.
fn written(folder: &Path, channel: &str, misses: bool) -> Trace {
    let mut random = RandomStream::new(9, channel);
    let (mut is_bad, mut records) = (false, Vec::new());
    for tick in 0..RECORD_COUNT {
        is_bad = random.chance(if is_bad { 0.7 } else { 0.1 });
        if misses && tick % 20 == 13 {
            continue;
        }
        let published_ns = i64::try_from(tick).unwrap() * PERIOD_NS;
        let record = TraceRecord::published(published_ns, records.len() as u64, 16);
        let delay_ns = delay_of(tick);
        records.push(if is_bad {
            TraceRecord {
                fate: TraceFate::LostInNetwork,
                ..record
            }
        } else {
            record.delivered(delay_ns, 0)
        });
    }
    let trace = Trace {
        header: TraceHeader::new(channel),
        records,
    };
    let file = folder.join(format!("{}.trace", channel.replace('/', ".")));
    fs::write(file, wire::encode(&trace).unwrap()).unwrap();
    trace
}

/// A live run over the traces in `traces`, matched by `matching`.
fn live(record: &RunFolder, matching: &str) -> RunFiles {
    let link = format!("trace = {{ folder = \"traces\", match = \"{matching}\" }}");
    let topology = record.write("live.toml", &emulated_shuttle("live", &link));
    let trial =
        Trial::of(&topology, &record.join("runs")).set(&format!("run.duration=\"{RUN_S} s\""));
    let mut child = trial.start_here();
    child.wait_within(LIMIT).unwrap().assert_success();
    let files = trial.folder("", LIMIT);
    files.assert_nothing_left_here();
    assert_every_message_is_accounted_for(&files.summary());
    files
}

/// What the report counts of the replay on `name`; it must say so in words as well.
fn counts(files: &RunFiles, name: &str) -> ReplayCounts {
    let counts = channel(&files.summary(), name).trace_replay.unwrap();
    println!("{name}: {counts:?}");
    let words: Vec<_> = files
        .read("report-full.txt")
        .split_whitespace()
        .map(str::to_owned)
        .collect();
    let (met, all) = (counts.met_count, counts.record_count);
    let line = format!("trace replay met {met} of {all} records of its trace:");
    assert!(
        words.join(" ").replace('\u{a0}', " ").contains(&line),
        "{line}"
    );
    counts
}

#[test]
fn live_the_nth_message_meets_the_nth_record_and_the_report_counts_it() {
    let record = RunFolder::new("trace-live-index");
    fs::create_dir(record.join("traces")).unwrap();
    let traces = CHANNELS.map(|name| written(&record.join("traces"), name, false));
    let files = live(&record, "index");
    for (name, trace) in CHANNELS.into_iter().zip(traces) {
        let counts = counts(&files, name);
        assert_eq!(counts.matching, TraceMatch::Index);
        assert_eq!(counts.record_count, RECORD_COUNT);
        assert_eq!(counts.met_count, counts.offered_count);
        assert_eq!(counts.met_count, counts.delivered_count + counts.lost_count);
        // A loaded host misses ticks; four in five remain.
        assert!(counts.met_count > 80 * RUN_S, "{counts:?}");
        assert!(counts.lost_count > 10 * RUN_S, "{counts:?}");
        let met = |sequence: u64| trace.records[usize::try_from(sequence).unwrap()];
        for arrival in records::<IngressRecord>(&files, name, "ingress") {
            let requested_ns = arrival.due_ns - arrival.emulated_ns;
            assert_eq!(met(arrival.sequence).delay(), Some(requested_ns));
        }
        // Every message that the gateway took met its record: the run's own trace has the fates of
        // the one it replayed.
        let own = trace_of(&files, name);
        let mut compared_count = 0;
        for one in own
            .records
            .iter()
            .filter(|one| matches!(one.fate, TraceFate::Delivered | TraceFate::LostInNetwork))
        {
            assert_eq!(one.fate, met(one.sequence).fate, "message {}", one.sequence);
            compared_count += 1;
        }
        let unknown_count = own.counts().unknown_count;
        assert!(
            compared_count + unknown_count >= counts.met_count,
            "{compared_count}"
        );
        let forwarded_count = forwarded(&files, name).len() as u64;
        assert!(
            (forwarded_count..=forwarded_count + unknown_count).contains(&counts.delivered_count),
            "{forwarded_count} forwarded, {unknown_count} unknown"
        );
    }
}

/// Tick and lateness in periods of each of `places`, instants in periods: the grid is where most of them
/// are early, and nothing is before it by more than an eighth.
fn on_grid(places: &[f64]) -> Vec<(i64, f64)> {
    let turns = places.iter().map(|place| (TAU * place).sin_cos());
    let (sine, cosine) = turns.fold((0.0, 0.0), |sum, turn| (sum.0 + turn.0, sum.1 + turn.1));
    let middle = sine.atan2(cosine) / TAU;
    let near = |place: &f64| (place - middle + 0.5).rem_euclid(1.0) - 0.5;
    let mut sorted: Vec<f64> = places.iter().map(near).collect();
    sorted.sort_by(f64::total_cmp);
    let grid = middle + sorted[sorted.len() / 10];
    let on = |place: &f64| {
        let tick = (place - grid + 0.125).floor();
        (tick as i64, place - grid - tick)
    };
    places.iter().map(on).collect()
}

/// Instants in periods since `origin_ns`.
fn places(instants_ns: impl Iterator<Item = i64>, origin_ns: i64) -> Vec<f64> {
    let place = |at_ns: i64| (at_ns - origin_ns) as f64 / PERIOD_NS as f64;
    instants_ns.map(place).collect()
}

/// Published later than this share of a period, a message may be taken for the next tick's.
const LATE: f64 = 0.3;
/// First messages by which the replay finds the grid; a few may meet a record beside theirs.
const YOUNG_COUNT: usize = 16;

/// Compares the record that each message met with the one of its producer's tick. Gives how many were
/// compared, and how many were late and met another.
fn check_ticks(files: &RunFiles, name: &str, trace: &Trace) -> (usize, usize) {
    let own = trace_of(files, name);
    let of_sequence: BTreeMap<u64, usize> = own
        .records
        .iter()
        .map(|one| one.sequence)
        .zip(0..)
        .collect();
    let origin_ns = own.records[0].published_ns;
    let published = places(own.records.iter().map(|one| one.published_ns), origin_ns);
    let producer = on_grid(&published);
    let is_offered =
        |one: &TraceRecord| matches!(one.fate, TraceFate::Delivered | TraceFate::LostInNetwork);
    let first = own.records.iter().position(is_offered).unwrap();
    // The first message offered has the tick of its number.
    let shift = i64::try_from(own.records[first].sequence).unwrap() - producer[first].0;
    let tick_of = |place: usize| u64::try_from(producer[place].0 + shift).unwrap();
    let record_of: BTreeMap<u64, &TraceRecord> = (trace.records.iter())
        .map(|one| (u64::try_from(one.published_ns / PERIOD_NS).unwrap(), one))
        .collect();
    // No two records have one delay.
    let tick_met: BTreeMap<i64, u64> = record_of
        .keys()
        .map(|tick| (delay_of(*tick), *tick))
        .collect();
    assert_eq!(tick_met.len(), record_of.len());
    let arrivals = records::<IngressRecord>(files, name, "ingress");
    let (mut compared_count, mut off) = (0, Vec::new());
    for arrival in &arrivals {
        let met = tick_met[&(arrival.due_ns - arrival.emulated_ns)];
        assert_eq!(record_of[&met].fate, TraceFate::Delivered);
        let place = of_sequence[&arrival.sequence];
        compared_count += 1;
        if met != tick_of(place) {
            off.push((place, met, tick_of(place)));
            let lateness = producer[place].1;
            assert!(
                lateness > LATE || place - first < YOUNG_COUNT,
                "{name}: message {place} of tick {} met that of {met}, late by {lateness}",
                tick_of(place)
            );
        }
    }
    // What did not arrive was at a tick whose record was lost, or that has none.
    let lost = own.records.iter().zip(0..);
    for (_, place) in lost.filter(|(one, _)| one.fate == TraceFate::LostInNetwork) {
        compared_count += 1;
        let record = record_of.get(&tick_of(place));
        if record.is_some_and(|record| record.fate == TraceFate::Delivered) {
            let lateness = producer[place].1;
            assert!(
                lateness > LATE || place - first < YOUNG_COUNT,
                "{name}: message {place} of tick {} was lost, late by {lateness}",
                tick_of(place)
            );
            off.push((place, u64::MAX, tick_of(place)));
        }
    }
    println!("{name}: {compared_count} compared, off (message, met, tick): {off:?}");
    (compared_count, off.len())
}

#[test]
fn live_by_tick_nobody_hears_at_a_tick_that_has_no_record() {
    let record = RunFolder::new("trace-live-tick");
    fs::create_dir(record.join("traces")).unwrap();
    let traces = CHANNELS.map(|name| written(&record.join("traces"), name, true));
    let files = live(&record, "tick");
    for (name, trace) in CHANNELS.into_iter().zip(traces) {
        let counts = counts(&files, name);
        assert_eq!(counts.matching, TraceMatch::Tick);
        let apart_count = counts.unpublished_count + counts.repeated_count;
        assert_eq!(counts.offered_count, counts.met_count + apart_count);
        assert!(counts.met_count > 75 * RUN_S, "{counts:?}");
        assert!(counts.lost_count > 10 * RUN_S, "{counts:?}");
        assert!(counts.unpublished_count > 2 * RUN_S, "{counts:?}");
        let (compared_count, off_count) = check_ticks(&files, name, &trace);
        assert!(compared_count as u64 > 80 * RUN_S, "{compared_count}");
        // A replay that is one tick off for good is off on nearly all.
        assert!(
            off_count <= compared_count / 20,
            "{off_count} of {compared_count}"
        );
        // A late message that is taken for the next one's tick repeats one.
        let bound = compared_count as u64 / 20;
        assert!(counts.repeated_count <= bound, "{counts:?}");
    }
}
