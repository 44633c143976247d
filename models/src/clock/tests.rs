//! The estimator against clocks whose truth is known.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    reason = "simulated times are far below 292 years, and mutations may wrap"
)]

use super::simulated::SimulatedRun;
use super::{ClockMap, ClockSettings, Exchange, Localised, Requester};
use crate::measure::record::{RoundTripRecord, UNAVAILABLE};
use crate::random::RandomStream;
use crate::time::{Instant, RemoteInstant};

const DURATION_NS: i64 = 20_000_000_000;
/// The smallest round trip of this long before and of this long after an instant bounds the
/// interval there.
const WINDOW_NS: i64 = 2_000_000_000;

/// What the queries of many runs came to.
#[derive(Debug, Default)]
struct Tally {
    run_count: u64,
    step_count: u64,
    asked_count: u64,
    answered_count: u64,
    truth_outside_interval: u64,
    truth_outside_bound: u64,
    width_compared_count: u64,
    too_wide_count: u64,
    failures: Vec<String>,
}

impl Tally {
    fn add_run(&mut self, seed: u64, step_powers: Option<(f64, f64)>) {
        let settings = ClockSettings::default();
        let mut run = SimulatedRun::new(seed, DURATION_NS, step_powers);
        let exchanges = run.exchanges();
        let map = ClockMap::new(&exchanges, settings);
        self.run_count += 1;
        self.step_count += map.figures().steps.len() as u64;
        let usable = exchanges.iter().filter_map(|one| one.constraint(&settings));
        let spans: Vec<Span> = usable
            .map(|one| (one.first_ns, one.last_ns, one.rtt_ns))
            .collect();
        let mut random = RandomStream::new(seed, "clock.queries");
        for _ in 0..300 {
            let (remote, truth) = run.truth((random.uniform() * DURATION_NS as f64) as i64);
            self.asked_count += 1;
            let Some(localised) = map.localise(remote) else {
                continue;
            };
            self.answered_count += 1;
            let error_ns = truth.ns_since(localised.instant).unsigned_abs();
            let is_outside = truth < localised.earliest || truth > localised.latest;
            self.truth_outside_interval += u64::from(is_outside);
            self.truth_outside_bound += u64::from(error_ns > localised.bound_ns());
            if is_outside {
                let failure = format!("seed {seed}: {truth:?} not in {localised:?}");
                self.failures.push(failure);
            }
            self.compare_width(remote.as_ns(), localised, (&map, &spans));
        }
    }

    fn compare_width(&mut self, at_ns: i64, one: Localised, (map, spans): (&ClockMap, &[Span])) {
        let settings = ClockSettings::default();
        let mut steps = map.figures().steps.iter();
        let (from_ns, until_ns) = (at_ns - WINDOW_NS, at_ns + WINDOW_NS);
        if steps.any(|step| step.from_ns < until_ns && from_ns < step.until_ns) {
            return;
        }
        let before = smallest_rtt(spans, from_ns, at_ns);
        let after = smallest_rtt(spans, at_ns, until_ns);
        let Some((before, after)) = before.zip(after) else {
            return;
        };
        let drift_ns = settings.drift_ns(2 * WINDOW_NS);
        let allowed_ns = before.max(after) / 2 + drift_ns + 2 * settings.stamp_error_ns;
        let half_ns = one.latest.ns_since(one.earliest) / 2;
        self.width_compared_count += 1;
        if half_ns > allowed_ns {
            self.too_wide_count += 1;
            let failure = format!("{one:?}: ±{half_ns} is above {allowed_ns}");
            self.failures.push(failure);
        }
    }
}

/// First and last instant of an exchange on the other clock, and its round trip.
type Span = (i64, i64, i64);

fn smallest_rtt(spans: &[Span], from_ns: i64, until_ns: i64) -> Option<i64> {
    let inside = spans
        .iter()
        .filter(|(first_ns, last_ns, _)| *first_ns >= from_ns && *last_ns <= until_ns);
    inside.map(|(_, _, rtt_ns)| *rtt_ns).min()
}

#[test]
fn the_truth_is_always_inside_a_bound_of_half_the_smallest_round_trip_and_drift() {
    let mut tally = Tally::default();
    for seed in 0..1_200 {
        // No step, and steps of a microsecond to ten seconds: too small to notice as well.
        let step_powers = (seed % 3 != 0).then_some((3.0, 10.0));
        tally.add_run(seed, step_powers);
    }
    let failures = core::mem::take(&mut tally.failures);
    let wrong = [
        tally.truth_outside_interval,
        tally.truth_outside_bound,
        tally.too_wide_count,
    ];
    assert_eq!(wrong, [0; 3], "{tally:?}: {failures:?}");
    assert!(
        tally.width_compared_count * 4 > tally.asked_count * 3,
        "{tally:?}"
    );
    assert!(
        tally.answered_count * 100 > tally.asked_count * 99,
        "{tally:?}"
    );
    assert!(tally.step_count > 300, "{tally:?}");
}

#[test]
fn large_steps_are_noticed_each_once_and_skew_is_found() {
    let (mut far_off_count, mut compared_count) = (0, 0);
    for seed in 0..200 {
        // From half a second up: above any burst's round trip.
        let mut run = SimulatedRun::new(seed, DURATION_NS, Some((8.7, 9.5)));
        let exchanges = run.exchanges();
        let map = ClockMap::new(&exchanges, ClockSettings::default());
        let steps = &map.figures().steps;
        assert_eq!(steps.len(), run.step_count(), "seed {seed}: {steps:?}");
        for step in steps {
            let size_ns = step.size_ns.unwrap().unsigned_abs();
            assert!((480_000_000..3_300_000_000).contains(&size_ns), "{step:?}");
        }
        if let Some((skew, error)) = map.figures().skew_ppm.zip(map.figures().skew_error_ppm)
            && run.step_count() == 0
        {
            compared_count += 1;
            far_off_count += u64::from((skew - run.skew_ppm()).abs() > 4.0 * error + 1.0);
        }
    }
    assert!(compared_count >= 15, "{compared_count}");
    // The line is straight and the clocks wander: beside the truth now and then.
    assert!(
        far_off_count * 5 <= compared_count,
        "{far_off_count} of {compared_count}"
    );
}

fn record(stamps: [i64; 4]) -> RoundTripRecord {
    RoundTripRecord {
        sequence: 1,
        t1_ns: stamps[0],
        t2_ns: stamps[1],
        t3_ns: stamps[2],
        t4_ns: stamps[3],
        session: 1,
        sources: [0; 4],
    }
}

/// Exchanges every 10 ms over a path of 100 µs there and 300 µs back; the other clock is 5 s ahead.
fn asymmetric(requester: Requester) -> Vec<Exchange> {
    let (out, home, ahead) = match requester {
        Requester::Local => (100_000, 300_000, 5_000_000_000),
        Requester::Remote => (300_000, 100_000, -5_000_000_000),
    };
    let exchange = |index: i64| {
        let sent = index * 10_000_000 - ahead.min(0);
        let arrived = sent + out + ahead;
        record([sent, arrived, arrived + 7_000, sent + out + home + 7_000])
    };
    let exchanges = (0..500).map(exchange);
    exchanges
        .map(|one| Exchange::of(&one, requester).unwrap())
        .collect()
}

#[test]
fn asymmetry_shifts_the_estimate_and_stays_inside_the_interval() {
    for requester in [Requester::Local, Requester::Remote] {
        let map = ClockMap::new(&asymmetric(requester), ClockSettings::default());
        let remote = RemoteInstant::from_ns(7_500_000_000);
        let localised = map.localise(remote).unwrap();
        let truth = Instant::from_ns(2_500_000_000);
        assert_eq!(localised.instant.ns_since(truth), 100_000, "{localised:?}");
        assert!(localised.earliest <= truth && truth <= localised.latest);
        assert!(
            (200_000..205_000).contains(&localised.bound_ns()),
            "{localised:?}"
        );
        let (back, bound_ns) = map.to_remote(localised.instant).unwrap();
        assert!(back.as_ns().abs_diff(remote.as_ns()) <= 2, "{back:?}");
        assert_eq!(bound_ns, localised.bound_ns());
        assert_eq!(map.figures().rtt_min_ns, Some(400_000));
    }
}

#[test]
fn both_directions_together_are_at_least_as_narrow_as_one() {
    let mut both = asymmetric(Requester::Local);
    both.extend(asymmetric(Requester::Remote));
    let alone = ClockMap::new(&both[..500], ClockSettings::default());
    let map = ClockMap::new(&both, ClockSettings::default());
    for step in 0..1000_i64 {
        let remote = RemoteInstant::from_ns(5_100_000_000 + step * 4_800_123);
        let (alone, merged) = (alone.localise(remote), map.localise(remote));
        let (alone, merged) = (alone.unwrap(), merged.unwrap());
        assert!(merged.earliest >= alone.earliest && merged.latest <= alone.latest);
    }
}

#[test]
fn without_exchanges_nothing_is_converted() {
    let map = ClockMap::new(&[], ClockSettings::default());
    assert_eq!(map.localise(RemoteInstant::from_ns(0)), None);
    assert_eq!(map.to_remote(Instant::ZERO), None);
    assert_eq!(map.figures().bound, None);
}

#[test]
fn exchanges_that_no_clock_could_give_are_left_out_and_counted() {
    let mut exchanges = asymmetric(Requester::Local);
    let arrives_before_it_left = record([0, 5_000_000_000, 5_000_000_000, -1]);
    exchanges.extend(Exchange::of(&arrives_before_it_left, Requester::Local));
    let map = ClockMap::new(&exchanges, ClockSettings::default());
    assert_eq!(map.figures().unused_count, 1);
    assert_eq!(map.figures().steps, []);
    let missing = record([0, UNAVAILABLE, 1, 2]);
    assert_eq!(Exchange::of(&missing, Requester::Local), None);
    let mut card = record([0, 1, 2, 3]);
    card.sources = [0, 2, 0, 0];
    assert_eq!(Exchange::of(&card, Requester::Local), None);
}

#[test]
fn mutated_exchanges_never_panic_and_intervals_hold_their_estimate() {
    let mut random = RandomStream::new(5, "clock.mutation");
    let mut converted_count = 0_u64;
    for _ in 0..10_000 {
        // Eleven exchanges each: above 10⁵ mutated ones in all.
        let exchanges = (0..11).filter_map(|index: i64| {
            let sent = index * 10_000_000;
            let mut stamps = [sent, sent + 100, sent + 200, sent + 300];
            for _ in 0..random.next_u64() % 3 {
                let place = (random.next_u64() % 4) as usize;
                let shift = random.next_u64() % 64;
                stamps[place] ^= (random.next_u64() >> shift) as i64;
            }
            let mut record = record(stamps);
            record.sources[(random.next_u64() % 4) as usize] = (random.next_u64() % 4) as u8;
            let requester = if random.chance(0.5) {
                Requester::Local
            } else {
                Requester::Remote
            };
            Exchange::of(&record, requester)
        });
        let map = ClockMap::new(&exchanges.collect::<Vec<_>>(), ClockSettings::default());
        for _ in 0..4 {
            let remote =
                RemoteInstant::from_ns((random.next_u64() >> (random.next_u64() % 64)) as i64);
            let back = map.localise(remote);
            if let Some(one) = back {
                converted_count += 1;
                assert!(
                    one.earliest <= one.instant && one.instant <= one.latest,
                    "{one:?}"
                );
            }
            map.to_remote(Instant::from_ns(remote.as_ns()));
        }
    }
    assert!(converted_count > 1_000, "{converted_count}");
}
