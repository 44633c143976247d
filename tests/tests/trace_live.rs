//! A recorded trace behind real sockets: each datagram meets its record, and the report counts what
//! was met.
#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "tests")]

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::time::Duration;

use hil_models::link::trace::{ReplayCounts, TraceMatch};
use hil_models::measure::record::IngressRecord;
use hil_models::random::RandomStream;
use hil_models::trace::{Trace, TraceFate, TraceHeader, TraceRecord, wire};
use hil_tests::account::{assert_every_message_is_accounted_for, channel};
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::{CHANNELS, PERIOD_NS, emulated_shuttle, forwarded, records, trace_of};
use hil_tests::trial::{RunFiles, Trial};

const LIMIT: Duration = Duration::from_mins(1);
const RUN_S: u64 = 8;
/// Longer than the run, so that none of its messages comes after the end.
const RECORD_COUNT: u64 = 2_000;

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
        let delay_ns = 3_000_000 + i64::try_from(tick * 7_919 % 20_000).unwrap() * 1_000;
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
fn live(record: &RunFolder, matching: &str, port: u16) -> RunFiles {
    let link = format!("port = {port}\ntrace = {{ folder = \"traces\", match = \"{matching}\" }}");
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
        .read("report.txt")
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
    let files = live(&record, "index", 7731);
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

#[test]
fn live_by_tick_nobody_hears_at_a_tick_that_has_no_record() {
    let record = RunFolder::new("trace-live-tick");
    fs::create_dir(record.join("traces")).unwrap();
    let traces = CHANNELS.map(|name| written(&record.join("traces"), name, true));
    let files = live(&record, "tick", 7741);
    for (name, trace) in CHANNELS.into_iter().zip(traces) {
        let counts = counts(&files, name);
        assert_eq!(counts.matching, TraceMatch::Tick);
        let apart_count = counts.unpublished_count + counts.repeated_count;
        assert_eq!(counts.offered_count, counts.met_count + apart_count);
        assert!(counts.met_count > 75 * RUN_S, "{counts:?}");
        assert!(counts.lost_count > 10 * RUN_S, "{counts:?}");
        assert!(counts.unpublished_count > 2 * RUN_S, "{counts:?}");
        let delays: BTreeSet<_> = trace.delays_ns().into_iter().collect();
        for arrival in records::<IngressRecord>(&files, name, "ingress") {
            assert!(delays.contains(&(arrival.due_ns - arrival.emulated_ns)));
        }
    }
}
