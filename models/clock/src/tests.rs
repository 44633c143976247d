//! The estimator against clocks whose truth is known.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    reason = "simulated times are far below 292 years, and mutations may wrap"
)]

mod simulated;

use self::simulated::SimulatedRun;
use super::{BEYOND_NS_MAX, ClockMap, ClockSettings, Exchange, Localised, Requester};
use hil_core::random::RandomStream;
use hil_core::record::{RoundTripRecord, UNAVAILABLE};
use hil_core::time::{Instant, RemoteInstant};

const DURATION_NS: i64 = 20_000_000_000;
/// Exchanges this long before and this long after an instant are considered for its interval.
const WINDOW_NS: i64 = 2_000_000_000;

/// What the queries of many runs came to.
#[derive(Debug, Default)]
struct Tally {
    run_count: u64,
    step_count: u64,
    /// Of clocks within the limit: none is right.
    withdrawn_count: u64,
    asked_count: u64,
    answered_count: u64,
    truth_outside_interval: u64,
    truth_outside_bound: u64,
    width_compared_count: u64,
    too_wide_count: u64,
    /// Bounds above a tenth of what is allowed: the check bites.
    tenth_count: u64,
    failures: Vec<String>,
}

impl Tally {
    fn add_run(&mut self, seed: u64, step_powers: Option<(f64, f64)>) {
        let settings = ClockSettings::default();
        let mut run = SimulatedRun::new(seed, DURATION_NS, step_powers);
        let exchanges = run.exchanges();
        let map = ClockMap::new(&exchanges, settings);
        self.run_count += 1;
        self.step_count += map.metrics().steps.len() as u64;
        self.withdrawn_count += u64::from(map.metrics().drift_contradiction.is_some());
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
            self.compare_width(remote.as_ns(), localised, &map, &spans);
        }
    }

    fn compare_width(&mut self, at_ns: i64, one: Localised, map: &ClockMap, spans: &[Span]) {
        let mut steps = map.metrics().steps.iter();
        let (from_ns, until_ns) = (at_ns - WINDOW_NS, at_ns + WINDOW_NS);
        if steps.any(|step| step.from_ns < until_ns && from_ns < step.until_ns) {
            return;
        }
        let before = narrowest(spans, from_ns, at_ns, at_ns);
        let after = narrowest(spans, at_ns, until_ns, at_ns);
        let Some((before, after)) = before.zip(after) else {
            return;
        };
        // Two intervals that overlap, and rounding.
        let allowed_ns = before + after + 4;
        let width_ns = one.latest.ns_since(one.earliest);
        let bound_ns = one.bound_ns() as i64;
        self.width_compared_count += 1;
        self.tenth_count += u64::from(bound_ns * 10 > allowed_ns);
        if width_ns > allowed_ns || bound_ns > allowed_ns {
            self.too_wide_count += 1;
            let failure = format!("{one:?}: {width_ns} or ±{bound_ns} is above {allowed_ns}");
            self.failures.push(failure);
        }
    }
}

/// First and last instant of an exchange on the other clock, and its round trip.
type Span = (i64, i64, i64);

/// The narrowest that an exchange within the span leaves for the offset at `at_ns`: its round trip,
/// 1 µs for each of four stamps, and 200 ppm of the time to it, both ways.
fn narrowest(spans: &[Span], from_ns: i64, until_ns: i64, at_ns: i64) -> Option<i64> {
    let inside = spans
        .iter()
        .filter(|(first_ns, last_ns, _)| *first_ns >= from_ns && *last_ns <= until_ns);
    let width_ns = |(first_ns, last_ns, rtt_ns): &Span| {
        let away_ns = (at_ns - first_ns).max(last_ns - at_ns);
        rtt_ns + 4_000 + 2 * (away_ns / 5_000 + 1)
    };
    inside.map(width_ns).min()
}

#[test]
fn the_truth_is_always_inside_a_bound_of_nearby_round_trips_and_drift() {
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
        tally.withdrawn_count,
    ];
    assert_eq!(wrong, [0; 4], "{tally:?}: {failures:?}");
    assert!(
        tally.width_compared_count * 4 > tally.asked_count * 3,
        "{tally:?}"
    );
    assert!(
        tally.tenth_count * 100 > tally.width_compared_count * 99,
        "{tally:?}"
    );
    assert!(
        tally.answered_count * 100 > tally.asked_count * 99,
        "{tally:?}"
    );
    assert!(tally.step_count > 300, "{tally:?}");
}

#[test]
fn large_steps_are_noticed_each_once_with_their_sign_and_size() {
    let (mut step_count, mut largest_error_ns) = (0, 0);
    for seed in 0..200 {
        // From half a second up: above any burst's round trip.
        let mut run = SimulatedRun::new(seed, DURATION_NS, Some((8.7, 9.5)));
        let exchanges = run.exchanges();
        let map = ClockMap::new(&exchanges, ClockSettings::default());
        let steps = &map.metrics().steps;
        let true_steps_ns = run.offset_steps_ns();
        assert_eq!(steps.len(), true_steps_ns.len(), "seed {seed}: {steps:?}");
        for (step, true_ns) in steps.iter().zip(true_steps_ns) {
            let error_ns = step.size_ns.unwrap().abs_diff(true_ns);
            assert!(error_ns < 20_000_000, "seed {seed}: {step:?}, {true_ns}");
            largest_error_ns = largest_error_ns.max(error_ns);
            step_count += 1;
        }
    }
    assert!(step_count > 200, "{step_count}");
    assert!(largest_error_ns > 0, "the estimate is not told the truth");
}

#[test]
fn the_error_of_the_skew_covers_what_it_says() {
    let (mut near_count, mut far_off_count, mut compared_count) = (0, 0, 0);
    let mut ratios = Vec::new();
    for seed in 0..300 {
        let mut run = SimulatedRun::new(seed, DURATION_NS, None);
        let map = ClockMap::new(&run.exchanges(), ClockSettings::default());
        let figures = map.metrics();
        let (skew, error) = figures.skew_ppm.zip(figures.skew_error_ppm).unwrap();
        let sigmas = (skew - run.skew_ppm()).abs() / error;
        compared_count += 1;
        near_count += u64::from(sigmas <= 2.0);
        far_off_count += u64::from(sigmas > 4.0);
        ratios.push(error);
    }
    ratios.sort_unstable_by(f64::total_cmp);
    let (near, far) = (near_count * 100 / compared_count, far_off_count);
    assert!(near >= 90 && far * 50 <= compared_count, "{near} %, {far}");
    // And it is no bigger than it need be.
    assert!(ratios[150] < 5.0, "{} ppm", ratios[150]);
}

/// A step near an end, and the instants that the guarantee speaks of.
#[test]
fn a_step_at_either_end_spoils_nothing_that_has_exchanges_on_both_sides() {
    let settings = ClockSettings::default();
    let (mut covered_count, mut spoilt_beyond_count) = (0_u64, 0_u64);
    for seed in 0..400 {
        let mut run = SimulatedRun::new(seed, DURATION_NS, None);
        let mut random = RandomStream::new(seed, "clock.ends");
        let from_end_ns = (random.uniform() * 6e8) as i64;
        let at_ns = if seed % 2 == 0 {
            from_end_ns
        } else {
            DURATION_NS - from_end_ns
        };
        let size_ns = 10_f64.powf(3.0 + 7.0 * random.uniform()) as i64;
        run.step(seed % 4 < 2, at_ns, size_ns);
        let exchanges = run.exchanges();
        let map = ClockMap::new(&exchanges, settings);
        let usable: Vec<_> = exchanges
            .iter()
            .filter_map(|one| one.constraint(&settings))
            .collect();
        let over_ns = usable.iter().map(|one| one.last_ns).min().unwrap();
        let begun_ns = usable.iter().map(|one| one.first_ns).max().unwrap();
        for _ in 0..200 {
            let near_ns = at_ns + ((random.uniform() - 0.5) * 2e9) as i64;
            let (remote, truth) = run.truth(near_ns.max(0));
            let Some(found) = map.localise(remote) else {
                continue;
            };
            let is_right = (found.earliest..=found.latest).contains(&truth);
            if (over_ns..=begun_ns).contains(&remote.as_ns()) {
                covered_count += 1;
                assert!(is_right, "seed {seed}: {truth:?} not in {found:?}");
            } else {
                spoilt_beyond_count += u64::from(!is_right);
            }
        }
    }
    assert!(covered_count > 20_000, "{covered_count}");
    assert!(spoilt_beyond_count > 0, "then the documented limit is none");
}

#[test]
fn alignment_reaches_a_second_beyond_the_exchanges_and_no_further() {
    // On the other clock from 5.0001 s to 9.990107 s.
    let exchanges = asymmetric(Requester::Local);
    let map = ClockMap::new(&exchanges, ClockSettings::default());
    let (first_ns, last_ns) = (5_000_100_000, 9_990_107_000);
    // An exchange's own ends are known within its round trip.
    let slack_ns = 500_000;
    for (end_ns, outwards) in [(first_ns, -1), (last_ns, 1)] {
        let at = |beyond_ns: i64| RemoteInstant::from_ns(end_ns + outwards * beyond_ns);
        // As messages a period away from the exchanges are.
        let found = map.localise(at(100_000_000)).unwrap();
        let truth = Instant::from_ns(at(100_000_000).as_ns() - 5_000_000_000);
        assert!((found.earliest..=found.latest).contains(&truth));
        let (back, _) = map.to_remote(found.instant).unwrap();
        assert!(back.as_ns().abs_diff(at(100_000_000).as_ns()) <= 2);
        assert!(map.localise(at(BEYOND_NS_MAX)).is_some());
        assert_eq!(map.localise(at(BEYOND_NS_MAX + slack_ns)), None);
        let local = Instant::from_ns(at(2 * BEYOND_NS_MAX).as_ns() - 5_000_000_000);
        assert_eq!(map.to_remote(local), None);
    }
}

#[test]
fn an_instant_far_before_the_exchanges_converts_within_the_drift_allowance() {
    let map = ClockMap::new(&asymmetric(Requester::Local), ClockSettings::default());
    let first_ns = 5_000_100_000;
    for beyond_s in [0, 1, 3, 60] {
        let at = RemoteInstant::from_ns(first_ns - beyond_s * 1_000_000_000);
        let found = map.localise_beyond(at).unwrap();
        let truth = Instant::from_ns(at.as_ns() - 5_000_000_000);
        assert!((found.earliest..=found.latest).contains(&truth));
        let drift_ns = u64::try_from(beyond_s).unwrap() * 200_000;
        assert!(found.bound_ns() >= drift_ns, "{beyond_s} s: {found:?}");
        assert!(
            found.bound_ns() <= drift_ns + 500_000,
            "{beyond_s} s: {found:?}"
        );
        assert_eq!(map.localise(at).is_some(), beyond_s <= 1);
        assert_eq!(map.localise_early(at), Some((found, beyond_s > 1)));
    }
    let nothing = ClockMap::new(&[], ClockSettings::default());
    assert_eq!(nothing.localise_beyond(RemoteInstant::from_ns(0)), None);
    assert_eq!(nothing.localise_early(RemoteInstant::from_ns(0)), None);
    // After the last exchange a score gets no more than a delay.
    let late = RemoteInstant::from_ns(first_ns + 3_600_000_000_000);
    assert!(map.localise_beyond(late).is_some());
    assert_eq!(map.localise_early(late), None);
}

#[test]
fn drift_is_bounded_within_a_stretch_and_unknown_across_a_step() {
    let at = RemoteInstant::from_ns;
    let map = ClockMap::new(&stepped(), ClockSettings::default());
    let (early, late) = (at(5_100_000_000), at(9_900_000_000));
    assert_eq!(map.drift_ns(early, at(6_100_000_000)), Some(200_000));
    assert_eq!(map.drift_ns(at(6_100_000_000), early), Some(200_000));
    assert_eq!(map.drift_ns(early, late), None);
}

/// As [`asymmetric`]; the other clock gains 20 ms in mid-run.
fn stepped() -> Vec<Exchange> {
    let mut exchanges = asymmetric(Requester::Local);
    for index in 250..500_i64 {
        let sent = index * 10_000_000;
        let arrived = sent + 100_000 + 5_020_000_000;
        let stamps = [sent, arrived, arrived + 7_000, sent + 407_000];
        exchanges[usize::try_from(index).unwrap()] =
            Exchange::of(&record(stamps), Requester::Local).unwrap();
    }
    exchanges
}

#[test]
fn a_step_in_mid_run_leaves_the_offset_of_an_instant_that_has_one() {
    let map = ClockMap::new(&stepped(), ClockSettings::default());
    let figures = map.metrics();
    let step = figures.steps[0];
    let middle_ns = 7_505_000_000;
    assert!(
        (step.from_ns..step.until_ns).contains(&middle_ns),
        "{step:?}"
    );
    assert!(step.size_ns.unwrap().abs_diff(-20_000_000) < 1_000);
    let offset = figures.offset.unwrap();
    let localised = map.localise(RemoteInstant::from_ns(offset.at_ns)).unwrap();
    let expected = Instant::from_ns(offset.at_ns + offset.estimate_ns);
    assert_eq!(localised.instant, expected);
    let truths = [-5_000_000_000, -5_020_000_000];
    assert_eq!(figures.stretch_offsets.len(), 2);
    for (one, truth_ns) in figures.stretch_offsets.iter().zip(truths) {
        assert!(
            (one.lowest_ns..=one.highest_ns).contains(&truth_ns),
            "{one:?}"
        );
    }
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
        assert_eq!(map.metrics().rtt_min_ns, Some(400_000));
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
    assert_eq!(map.metrics().bound, None);
}

#[test]
fn exchanges_that_no_clock_could_give_are_left_out_and_counted() {
    let mut exchanges = asymmetric(Requester::Local);
    let arrives_before_it_left = record([0, 5_000_000_000, 5_000_000_000, -1]);
    exchanges.extend(Exchange::of(&arrives_before_it_left, Requester::Local));
    let map = ClockMap::new(&exchanges, ClockSettings::default());
    assert_eq!(map.metrics().unused_count, 1);
    assert_eq!(map.metrics().steps, []);
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
