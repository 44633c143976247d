//! Tests of the ticks of a trace, against a producer that a loaded host holds up.

use super::*;
use core::time::Duration;
use hil_core::random::RandomStream;
use hil_core::time::{Instant, PeriodicTimer};

/// How a host treats a producer.
#[derive(Debug, Clone, Copy)]
struct Host {
    period_ns: f64,
    tick_count: u64,
    /// Share of the wake-ups that come too late for the next tick.
    skip_ratio: f64,
    /// Share of the messages held up for 1 to 2.5 periods between timer and publication.
    held_ratio: f64,
    /// Some 500 to 1500 ticks are slept through every so many records.
    burst_every: usize,
}

/// A published message, as its producer knows it.
#[derive(Debug, Clone, Copy)]
struct Published {
    tick: u64,
    /// From its tick, in periods.
    lateness: f64,
}

fn record(published_ns: i64) -> TraceRecord {
    TraceRecord::published(published_ns, 0, 0)
}

fn whole_ns(ns: f64) -> i64 {
    whole(ns.round())
}

/// A run of a producer with the timer that producers have. One wake-up in ten is late by up to 0.45
/// of a period, the others by up to 0.02.
fn run(host: Host, seed: u64) -> (Vec<TraceRecord>, Vec<Published>) {
    // The timer counts in its own nanoseconds; the trace's clock runs at another rate.
    let nominal_ns = 1_000_000;
    let rate = host.period_ns / nominal_ns as f64;
    let mut timer = PeriodicTimer::new(Duration::from_nanos(nominal_ns));
    timer.start(Instant::ZERO);
    let mut random = RandomStream::new(seed, "ticks");
    let (mut records, mut published) = (Vec::new(), Vec::new());
    let mut now_ns = 0.0;
    let period = nominal_ns as f64;
    loop {
        let due_ns = timer.next().unwrap().as_ns() as f64;
        let count = published.len();
        let mut wake = if random.chance(0.1) { 0.45 } else { 0.02 } * random.uniform();
        if count > 0 && random.chance(host.skip_ratio) {
            wake += 0.6 + 3.0 * random.uniform();
        }
        if count > 0 && count.is_multiple_of(host.burst_every) {
            wake += (500.0 + 1_000.0 * random.uniform()).floor();
        }
        // A timer that is due already is polled at once.
        let polled_ns = if due_ns > now_ns {
            due_ns + wake * period
        } else {
            now_ns
        };
        let Some(tick) = timer.poll(Instant::from_ns(whole_ns(polled_ns))) else {
            now_ns = polled_ns + 1.0;
            continue;
        };
        if tick.index >= host.tick_count {
            return (records, published);
        }
        let is_held = count > 0 && random.chance(host.held_ratio);
        let work = if is_held {
            1.0 + 1.5 * random.uniform()
        } else {
            0.005 * random.uniform()
        };
        now_ns = polled_ns + work * period;
        let published_ns = 170_000_123 + whole_ns(now_ns * rate);
        records.push(record(published_ns));
        let lateness = (now_ns - tick.scheduled.as_ns() as f64) / period;
        published.push(Published {
            tick: tick.index,
            lateness,
        });
    }
}

/// Every record that left within its period must have its tick; gives how many others have not.
fn check(host: Host, seed: u64) -> usize {
    let (records, published) = run(host, seed);
    let middle_ns = whole_ns(host.period_ns) + 310;
    let ticks = Ticks::of(&records, middle_ns).unwrap();
    let error = ticks.period_ns / host.period_ns - 1.0;
    assert!(error.abs() < 1e-7, "seed {seed}: {error:e}");
    let mut wrong_count = 0;
    for (place, (one, tick)) in published.iter().zip(&ticks.ticks).enumerate() {
        let off = tick.abs_diff(one.tick);
        let text = || format!("seed {seed}: record {place} {one:?} has tick {tick}");
        assert!(off == 0 || one.lateness > 1.0 - EARLY_RATIO, "{}", text());
        assert!(off as f64 <= one.lateness.ceil(), "{}", text());
        wrong_count += usize::from(off > 0);
        let shared = place > 0 && ticks.ticks[place - 1] == *tick;
        assert!(
            shared || ticks.record_of(*tick) == Some(place),
            "{}",
            text()
        );
    }
    wrong_count
}

const LONG: Host = Host {
    period_ns: 1e6,
    tick_count: 600_000,
    skip_ratio: 0.01,
    held_ratio: 0.0,
    burst_every: 50_000,
};

#[test]
fn in_ten_minutes_at_1_khz_each_record_finds_its_tick_however_many_were_missed() {
    for (seed, (ppm, skip_ratio)) in [(0.0, 0.01), (100.0, 0.1), (-100.0, 0.03), (37.0, 0.06)]
        .into_iter()
        .enumerate()
    {
        let period_ns = 1e6 * (1.0 + ppm * 1e-6);
        let host = Host {
            period_ns,
            skip_ratio,
            ..LONG
        };
        let wrong_count = check(host, seed as u64);
        // Those that woke up in the very last of their period and had no successor.
        assert!(wrong_count < 200, "{ppm} ppm: {wrong_count}");
    }
}

#[test]
fn a_message_held_up_for_longer_than_its_period_moves_none_after_it() {
    let host = Host {
        tick_count: 60_000,
        held_ratio: 0.01,
        ..LONG
    };
    for seed in 0..5 {
        // One held up for more than two periods may have been of either tick before it.
        let wrong_count = check(host, seed);
        assert!(
            (1..600).contains(&wrong_count),
            "seed {seed}: {wrong_count}"
        );
    }
}

#[test]
fn a_short_trace_and_one_full_of_gaps_have_their_ticks() {
    for (tick_count, burst_every) in [(20, 1_000), (300, 1_000), (200_000, 20)] {
        let host = Host {
            tick_count,
            burst_every,
            ..LONG
        };
        let (records, published) = run(host, 3);
        let ticks = Ticks::of(&records, 1_000_000).unwrap();
        let expected: Vec<u64> = published.iter().map(|one| one.tick).collect();
        let pairs = ticks.ticks.iter().zip(&expected);
        let wrong: Vec<_> = pairs.filter(|(a, b)| a != b).collect();
        assert!(
            wrong.len() <= records.len() / 100,
            "{tick_count} ticks, {} of {}: {:?}",
            wrong.len(),
            records.len(),
            &wrong[..10]
        );
    }
}

#[test]
fn of_two_in_one_period_the_earlier_takes_the_last_tick_without_a_record() {
    let sorted = |mut ticks: Vec<i64>| {
        sort_out(&mut ticks);
        ticks
    };
    assert_eq!(sorted(vec![0, 1, 4, 4, 5]), [0, 1, 3, 4, 5]);
    assert_eq!(sorted(vec![0, 2, 3, 3, 4]), [0, 1, 2, 3, 4]);
    assert_eq!(sorted(vec![0, 4, 4, 4, 5]), [0, 2, 3, 4, 5]);
    // The first was late itself.
    assert_eq!(sorted(vec![0, 0, 1]), [-1, 0, 1]);
    // Eleven that a producer found waiting when it was let go.
    let mut burst = vec![0, 1];
    burst.extend([13; 11]);
    burst.extend([14, 15]);
    let in_turn: Vec<i64> = [0, 1].into_iter().chain(3..16).collect();
    assert_eq!(sorted(burst), in_turn);
    // None is near: they share it, and nothing else moves.
    let mut long: Vec<i64> = (0..400).collect();
    long.push(399);
    assert_eq!(sorted(long.clone()), long);
}

#[test]
fn what_has_no_period_has_no_ticks() {
    let mut random = RandomStream::new(1, "no period");
    let mut at_ns = 0;
    let mut next = |_| {
        at_ns += i64::try_from(random.next_u64() % 30_000_000).unwrap();
        record(at_ns)
    };
    let records: Vec<_> = (0..500).map(&mut next).collect();
    assert!(Ticks::of(&records, 15_000_000).is_none());
    let host = Host {
        tick_count: 7_000,
        ..LONG
    };
    let (mut restarted, _) = run(host, 1);
    restarted[4_000].start = 1;
    assert!(Ticks::of(&restarted, 1_000_000).is_none());
    // Regular for a while only.
    let (mut halting, _) = run(host, 1);
    let mut at_ns = halting[2_999].published_ns;
    for record in &mut halting[3_000..] {
        at_ns += i64::try_from(random.next_u64() % 3_000_000).unwrap();
        record.published_ns = at_ns;
    }
    assert!(Ticks::of(&halting, 1_000_000).is_none());
    // Beyond all reason.
    let (mut far, _) = run(host, 1);
    far.last_mut().unwrap().published_ns = i64::MAX - 1;
    assert!(Ticks::of(&far, 1_000_000).is_none());
}
