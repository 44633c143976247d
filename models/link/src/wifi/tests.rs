//! The link as a whole against what its mechanisms promise, each alone and all together.

use super::*;
use crate::outages::Outages;
use hil_stats::statistics::clopper_pearson;

const COUNT: i64 = 1_000_000;
const NONE: Outages = Outages {
    mean_s: 0.5,
    per_hour: 0.0,
    buffered: false,
};

/// Nothing but airtime: no fades, no others, no outages, no bridges.
fn bare() -> WifiSpec {
    WifiSpec {
        shadowing_db: 0.0,
        fading_m: 0.0,
        contender_count: 0,
        busy_ratio: 0.0,
        forwarding_us: 0.0,
        outages: NONE,
        ..WifiPreset::ShortRange.spec()
    }
}

fn link(spec: &WifiSpec, seed: u64) -> WifiLink {
    let stream = |name| RandomStream::new(seed, name);
    WifiLink::new(spec, Way::Forward, stream("own"), stream("shared")).unwrap()
}

/// Offers `count` messages of 100 bytes every `period_ns`; gives each delay, or nothing.
fn delays(link: &mut WifiLink, count: i64, period_ns: i64) -> Vec<Option<i64>> {
    let offer = |index| {
        let now = Instant::from_ns(index * period_ns);
        link.offer(now, 100).arrival().map(|at| at.ns_since(now))
    };
    (0..count).map(offer).collect()
}

/// Probability of a loss of `lost` in `count` is `ratio`: within the exact interval of 1 in 10^5.
fn assert_ratio(lost: u64, count: u64, ratio: f64) {
    let interval = clopper_pearson(lost, count, 0.99999).unwrap();
    assert!(
        (interval.low..=interval.high).contains(&ratio),
        "{lost} of {count}, expected {ratio}"
    );
}

/// The median signal-to-noise ratio becomes `snr_db`.
fn at_snr(spec: WifiSpec, snr_db: f64) -> WifiSpec {
    let spec = WifiSpec {
        distance_m: if snr_db > 30.0 { 1.0 } else { 20.0 },
        wall_count: 0,
        ..spec
    };
    WifiSpec {
        tx_power_dbm: spec.tx_power_dbm + snr_db - median_snr_db(&spec),
        ..spec
    }
}

#[test]
fn a_clean_medium_delays_by_the_airtime_alone() {
    let spec = bare();
    let phy = Phy::new(&spec);
    let mcs = spec.settled(median_snr_db(&spec));
    let airtime_ns = phy.ppdu_ns(mcs, Phy::air_bytes(100));
    let mut link = link(&spec, 1);
    let all = delays(&mut link, COUNT, 4_000_000);
    // At three decibels above the threshold some 1 in 10^6 is repeated.
    let straight = all.iter().filter(|ns| **ns == Some(airtime_ns)).count();
    assert!(straight as u64 > COUNT.unsigned_abs() - 100, "{straight}");
    assert_eq!(link.counts().delivered_count, COUNT.unsigned_abs());
}

#[test]
fn what_is_left_after_the_retries_is_the_product_of_their_error_ratios() {
    for (snr_db, attempt_limit) in [(4.5, 1), (2.0, 2), (1.5, 4), (1.2, 7)] {
        let spec = WifiSpec {
            attempt_limit,
            rate_margin_db: 0.0,
            error_slope_per_db: 1.0,
            ..at_snr(bare(), snr_db)
        };
        let settled = spec.settled(snr_db);
        let air_bytes = Phy::air_bytes(100);
        let error = |attempt| {
            let mcs = spec.stepped_down(settled, attempt);
            spec.error_ratio(mcs, snr_db, air_bytes)
        };
        let expected: f64 = (0..attempt_limit as usize).map(error).product();
        let mut link = link(&spec, 2);
        delays(&mut link, COUNT, 4_000_000);
        let counts = link.counts();
        assert_ratio(counts.exhausted_count, counts.offered_count, expected);
        assert_ratio(counts.error_count, counts.attempt_count, error(0));
        assert_eq!(
            counts.delivered_count + counts.exhausted_count,
            counts.offered_count
        );
    }
}

#[test]
fn each_step_down_the_rates_has_its_own_error_ratio() {
    // The sender settles on scheme 4 and its fade is 5 dB below: two failures a rate on the way.
    let spec = WifiSpec {
        attempts_per_rate: 1,
        rate_margin_db: 0.0,
        error_slope_per_db: 0.5,
        ..at_snr(bare(), 16.5)
    };
    let air_bytes = Phy::air_bytes(100);
    let error = |mcs| spec.error_ratio(mcs, 16.5, air_bytes);
    assert_eq!(spec.settled(16.5), 4);
    let mut link = link(&spec, 3);
    delays(&mut link, COUNT, 4_000_000);
    let counts = link.counts();
    // Attempts per message: 1 + e4 + e4 e3 + ...
    let expected = 1.0 + error(4) * (1.0 + error(3) * (1.0 + error(2) * (1.0 + error(1))));
    let found = counts.attempt_count as f64 / counts.offered_count as f64;
    assert!((found - expected).abs() < 5e-4, "{found} {expected}");
}

#[test]
fn collisions_and_waiting_are_those_of_the_busy_medium() {
    let spec = WifiSpec {
        contender_count: 5,
        busy_ratio: 0.5,
        busy_mean_us: 300.0,
        ..at_snr(bare(), 60.0)
    };
    let contention = Contention::new(&spec);
    let begin = contention.begin_ratio;
    let mut link = link(&spec, 4);
    let all = delays(&mut link, COUNT, 50_000_000);
    let counts = link.counts();
    assert_ratio(counts.collision_count, counts.attempt_count, begin);
    assert_eq!(counts.error_count, 0);
    // An arrival meets an idle medium half the time, and then leaves at once unless it collides.
    let airtime_ns = Phy::new(&spec).ppdu_ns(11, Phy::air_bytes(100));
    let at_once = all.iter().filter(|ns| **ns == Some(airtime_ns)).count() as u64;
    assert_ratio(at_once, counts.offered_count, 0.5 * (1.0 - begin));
    // Else it waits for a busy period's rest and a back-off of 7.5 slots on average.
    let access = contention.access;
    let slot_ns = (1.0 - begin) * 9e3 + begin * (300e3 + access.aifs_ns as f64);
    let backoff_ns = |window: u32| access.aifs_ns as f64 + 0.5 * f64::from(window) * slot_ns;
    let arrival_ns = 0.5 * (300e3 + backoff_ns(access.window_min));
    // A collision costs the longer of both frames, the response time and a wider back-off.
    let a = airtime_ns as f64;
    let collided_ns = a + 300e3 * (-a / 300e3).exp() + Phy::new(&spec).response_ns(11) as f64;
    let (mut expected, mut reached, mut window) = (arrival_ns + a, 1.0, access.window_min);
    for _ in 0..6 {
        reached *= begin;
        window = access.widened(window);
        expected += reached * (collided_ns + backoff_ns(window));
    }
    let sum: i64 = all.iter().flatten().sum();
    let mean = sum as f64 / counts.delivered_count as f64;
    assert!((mean / expected - 1.0).abs() < 0.01, "{mean} {expected}");
}

#[test]
fn a_saturated_queue_is_served_one_exchange_and_back_off_at_a_time() {
    let spec = WifiSpec {
        lifetime_ms: 10_000.0,
        ..at_snr(bare(), 60.0)
    };
    let phy = Phy::new(&spec);
    let exchange_ns = phy.ppdu_ns(11, Phy::air_bytes(100)) + phy.response_ns(11);
    // Offered twice as fast as it can be served, in bursts that stay within the lifetime.
    let service_ns = exchange_ns + 43_000 + 67_500;
    let mut link = link(&spec, 5);
    let mut last = Instant::ZERO;
    let (mut gaps, mut count) = (0, 0);
    for burst in 0..100 {
        for index in 0..10_000 {
            let now = Instant::from_ns(burst * 10_000_000_000 + index * service_ns / 2);
            let at = link.offer(now, 100).arrival().unwrap();
            assert!(at > last, "in order");
            if index > 0 {
                gaps += at.ns_since(last);
                count += 1;
            }
            last = at;
        }
    }
    let mean = gaps as f64 / f64::from(count);
    assert!(
        (mean / service_ns as f64 - 1.0).abs() < 0.003,
        "{mean} {service_ns}"
    );
}

#[test]
fn a_frame_older_than_its_lifetime_is_given_up_and_the_queue_stays_bounded() {
    let spec = WifiSpec {
        lifetime_ms: 20.0,
        ..at_snr(bare(), 60.0)
    };
    let mut link = link(&spec, 6);
    let all = delays(&mut link, COUNT, 50_000);
    let counts = link.counts();
    assert!(counts.expired_count > 100_000);
    assert_eq!(
        counts.expired_count + counts.delivered_count,
        counts.offered_count
    );
    let longest = all.iter().flatten().max().unwrap();
    assert!((19_000_000..21_000_000).contains(longest), "{longest}");
    // What is given up takes no air: the medium serves one frame per exchange and mean back-off, and
    // one burst of the lifetime's length more at the beginning.
    let phy = Phy::new(&spec);
    let exchange_ns = phy.ppdu_ns(11, Phy::air_bytes(100)) + phy.response_ns(11);
    let service_ns = (exchange_ns + 43_000 + 67_500) as f64;
    let expected = COUNT as f64 * 50_000.0 / service_ns;
    let found = counts.delivered_count as f64;
    assert!((found / expected - 1.0).abs() < 0.003, "{found} {expected}");
}

#[test]
fn no_frame_is_older_than_the_flight_time_however_busy_the_medium() {
    let spec = WifiSpec {
        contender_count: 30,
        busy_ratio: 0.9,
        busy_mean_us: 3_000.0,
        lifetime_ms: 20.0,
        forwarding_us: 200.0,
        ..at_snr(bare(), 12.0)
    };
    let longest_ns = i64::try_from(spec.flight_time_max().as_nanos()).unwrap();
    assert_eq!(longest_ns, 20_000_000 + 200_000 + 5_484_000);
    for length_bytes in [100, 20_000] {
        let mut link = link(&spec, 9);
        let (mut late_count, mut longest_found_ns) = (0, 0);
        for index in 0..20_000_i64 {
            let now = Instant::from_ns(index * 40_000_000);
            if let Some(at) = link.offer(now, length_bytes).arrival() {
                longest_found_ns = longest_found_ns.max(at.ns_since(now));
            } else {
                late_count += 1;
            }
        }
        assert!(longest_found_ns <= longest_ns, "{longest_found_ns}");
        assert!(link.counts().expired_count > 0, "{late_count} lost");
        assert!(link.counts().delivered_count > 0);
    }
}

#[test]
fn rayleigh_fading_loses_what_its_density_says() {
    let spec = WifiSpec {
        fading_m: 1.0,
        fading_coherence_ms: 1.0,
        attempt_limit: 1,
        rate_margin_db: 0.0,
        ..at_snr(bare(), 10.0)
    };
    let air_bytes = Phy::air_bytes(100);
    let settled = spec.settled(10.0);
    // The error ratio over the exponential density of the gain, by the midpoint rule.
    let step = 1e-4;
    let expected: f64 = (0..400_000)
        .map(|index| {
            let gain = (f64::from(index) + 0.5) * step;
            let snr_db = 10.0 + 10.0 * gain.log10();
            step * (-gain).exp() * spec.error_ratio(settled, snr_db, air_bytes)
        })
        .sum();
    let mut link = link(&spec, 7);
    delays(&mut link, COUNT, 4_000_000);
    assert_ratio(
        link.counts().exhausted_count,
        COUNT.unsigned_abs(),
        expected,
    );
}

#[test]
fn frames_for_a_dozing_receiver_wait_half_a_beacon_interval_on_average() {
    let spec = WifiSpec {
        power_save: PowerSave::Forward,
        awake_ms: 0.0,
        ..at_snr(bare(), 60.0)
    };
    // No common measure with the beacon interval of 102.4 ms.
    let all = delays(&mut link(&spec, 8), COUNT, 150_001_237);
    let longest = *all.iter().flatten().max().unwrap();
    let sum: i64 = all.iter().flatten().sum();
    let mean_ms = sum as f64 / COUNT as f64 * 1e-6;
    // Beside the beacon: back-off and airtime.
    let rest_ms = 0.043 + 0.0675 + 1e-6 * Phy::new(&spec).ppdu_ns(11, Phy::air_bytes(100)) as f64;
    assert!((mean_ms - 51.2 - rest_ms).abs() < 0.15, "{mean_ms}");
    assert!(longest < 103_000_000, "{longest}");
    // Any wait up to the interval is as likely as any other.
    for quarter in 1..4_i64 {
        let upto_ns = quarter as f64 * 25.6e6 + rest_ms * 1e6;
        let below = all.iter().flatten().filter(|ns| (**ns as f64) < upto_ns);
        let share = below.count() as f64 / COUNT as f64;
        assert!((share - 0.25 * quarter as f64).abs() < 0.0025, "{share}");
    }
    // The other direction, and a receiver that heard a frame just now, wait for no beacon.
    let stream = |name| RandomStream::new(8, name);
    let mut back = WifiLink::new(&spec, Way::Backward, stream("own"), stream("shared")).unwrap();
    assert!(
        delays(&mut back, 1000, 150_001_237)
            .iter()
            .flatten()
            .all(|ns| *ns < 1_000_000)
    );
    let awake = WifiSpec {
        awake_ms: 200.0,
        ..spec
    };
    let waited = delays(&mut link(&awake, 8), 10_000, 150_001_237);
    assert_eq!(
        waited
            .iter()
            .flatten()
            .filter(|ns| **ns > 1_000_000)
            .count(),
        1
    );
}

#[test]
fn outages_take_their_share_and_all_channels_of_a_link_together() {
    let spec = WifiSpec {
        outages: Outages {
            per_hour: 600.0,
            ..NONE
        },
        ..at_snr(bare(), 60.0)
    };
    let shared = || RandomStream::new(9, "shared");
    let one =
        |own, way| WifiLink::new(&spec, way, RandomStream::new(own, "own"), shared()).unwrap();
    let (mut there, mut back) = (one(1, Way::Forward), one(2, Way::Backward));
    let (forward, backward) = (
        delays(&mut there, COUNT, 8_000_000),
        delays(&mut back, COUNT, 8_000_000),
    );
    let differ = forward
        .iter()
        .zip(&backward)
        .filter(|(a, b)| a.is_some() != b.is_some());
    // A frame that waits for the one before it may meet the next outage's first instant.
    assert_eq!(differ.count(), 0);
    let ratio = there.counts().outage_count as f64 / COUNT as f64;
    // 8000 s hold 1333 outages: five standard errors of their total length.
    assert!(
        (ratio / spec.outages.down_ratio() - 1.0).abs() < 0.2,
        "{ratio}"
    );
}

#[test]
fn a_buffered_outage_keeps_what_is_young_enough() {
    let spec = WifiSpec {
        outages: Outages {
            per_hour: 600.0,
            buffered: true,
            ..NONE
        },
        lifetime_ms: 300.0,
        ..at_snr(bare(), 60.0)
    };
    let mut link = link(&spec, 10);
    let all = delays(&mut link, COUNT, 8_000_000);
    let counts = link.counts();
    assert_eq!(counts.outage_count, 0);
    assert!(
        counts.expired_count > 10_000 && counts.held_count > 500,
        "{counts:?}"
    );
    let longest = *all.iter().flatten().max().unwrap();
    assert!((290_000_000..320_000_000).contains(&longest), "{longest}");
}

#[test]
fn equal_seeds_give_equal_fates_and_others_do_not() {
    for preset in WifiPreset::ALL {
        let of = |seed| delays(&mut link(&preset.spec(), seed), COUNT, 4_000_000);
        let one = of(11);
        assert_eq!(one, of(11));
        assert_ne!(one, of(12));
    }
}

#[test]
fn no_instant_and_no_length_upsets_it() {
    let spec = WifiSpec {
        power_save: PowerSave::Forward,
        outages: NONE,
        ..WifiPreset::LongRange.spec()
    };
    let mut random = RandomStream::new(13, "instants");
    for round in 0..20 {
        let mut link = link(&spec, round);
        let mut now = 0_i64;
        for _ in 0..5_000 {
            let shift = random.next_u64() % 62;
            now = now.saturating_add((random.next_u64() >> (shift + 2)).cast_signed());
            let length = usize::try_from(random.next_u64() % 70_000).unwrap();
            let at = Instant::from_ns(now);
            assert!(
                link.offer(at, length)
                    .arrival()
                    .is_none_or(|arrival| arrival >= at)
            );
        }
        let counts = link.counts();
        let fates = counts.delivered_count + counts.exhausted_count + counts.expired_count;
        assert_eq!(fates + counts.outage_count, counts.offered_count);
    }
}
