//! The parts of a link together: what each does to the others' promises, and which fates hang on
//! what. Every statement about a share is made over a million messages.

use core::time::Duration;

use super::delay::{DelayLaw, Exponential, Uniform};
use super::loss::{Bursts, GilbertElliott, LossLaw};
use super::outages::{OutageLink, Outages};
use super::rate::RateLimit;
use super::reordering::{Duplication, Reordering};
use super::spec::{LinkPlace, LinkSpec, Way};
use hil_core::link_model::{Fate, LinkModel};
use hil_core::random::RandomStream;
use hil_core::time::Instant;

const COUNT: i64 = 1_000_000;
const ERRORS_MAX: f64 = 5.0;

const fn ms(count: u64) -> Duration {
    Duration::from_millis(count)
}

fn place(seed: u64, channel: &str) -> LinkPlace<'_> {
    LinkPlace {
        seed,
        link: "hop",
        channel,
        way: Way::Forward,
    }
}

fn model(spec: &LinkSpec, seed: u64) -> Box<dyn LinkModel> {
    spec.build(&place(seed, "a/b")).unwrap()
}

/// The fates of `count` messages of 100 bytes, one `period` apart, with the time of each.
fn fates(spec: &LinkSpec, seed: u64, period: Duration, count: i64) -> Vec<(Instant, Fate)> {
    let mut link = model(spec, seed);
    let mut now = Instant::ZERO;
    let next = |_| {
        let offered = (now, link.offer(now, 100));
        now = now + period;
        offered
    };
    (0..count).map(next).collect()
}

/// Everything on.
fn rich() -> LinkSpec {
    LinkSpec {
        outages: Outages {
            mean_s: 0.3,
            per_hour: 600.0,
            buffered: false,
        },
        loss: LossLaw::GilbertElliott(GilbertElliott {
            to_bad: 0.01,
            to_good: 0.2,
            bad_loss_ratio: 0.8,
            good_loss_ratio: 0.001,
        }),
        rate: Some(RateLimit {
            bits_per_second: 1_000_000,
            queue_bytes: 2_000,
            overhead_bytes: 28,
        }),
        delay: DelayLaw::Exponential(Exponential {
            min: ms(2),
            mean_excess: ms(3),
            ..Exponential::TEMPLATE
        }),
        reorders: false,
        reordering: Some(Reordering {
            ratio: 0.01,
            hold: ms(30),
        }),
        duplication: Some(Duplication {
            ratio: 0.02,
            lag: ms(5),
        }),
        wifi: None,
    }
}

fn errors_of(found_count: usize, trials: usize, ratio: f64) -> f64 {
    let error = (trials as f64 * ratio * (1.0 - ratio)).sqrt();
    (found_count as f64 - trials as f64 * ratio) / error
}

#[test]
fn the_papers_static_model_is_exact_in_delay_and_binomial_in_loss() {
    for (seed, delay) in [0, 10, 50, 100].into_iter().map(ms).enumerate() {
        for loss_ratio in [0.0, 0.1] {
            let spec = LinkSpec::fixed(delay, loss_ratio);
            let all = fates(&spec, seed as u64, ms(8), COUNT);
            let mut lost_count = 0;
            for (offered, fate) in &all {
                match fate {
                    Fate::Lost => lost_count += 1,
                    fate => assert_eq!(*fate, Fate::Delivered(*offered + delay)),
                }
            }
            if loss_ratio > 0.0 {
                let errors = errors_of(lost_count, all.len(), loss_ratio);
                assert!(errors.abs() < ERRORS_MAX, "{lost_count} lost, {errors}");
            } else {
                assert_eq!(lost_count, 0);
            }
        }
    }
}

#[test]
fn outages_and_independent_losses_have_the_fates_they_had_before_there_were_other_parts() {
    for buffered in [false, true] {
        let outages = Outages {
            mean_s: 0.5,
            per_hour: 300.0,
            buffered,
        };
        let spec = LinkSpec {
            outages,
            ..LinkSpec::fixed(ms(20), 0.1)
        };
        let stream = |name: &str| RandomStream::new(9, name);
        let mut losses = stream("a/b");
        let mut outages =
            OutageLink::new(outages, stream("links.hop.outages"), Instant::ZERO).unwrap();
        for (now, fate) in fates(&spec, 9, ms(4), 200_000) {
            let is_lost = losses.chance(0.1);
            let expected = match outages.offer(now, 100).arrival() {
                Some(at) if !is_lost => Fate::Delivered(at + ms(20)),
                _ => Fate::Lost,
            };
            assert_eq!(fate, expected);
        }
    }
}

#[test]
fn equal_seeds_give_equal_fates_and_neighbouring_seeds_others() {
    let of = |seed| fates(&rich(), seed, ms(1), COUNT);
    let (one, again, other) = (of(1), of(1), of(2));
    assert_eq!(one, again);
    let differing = one.iter().zip(&other).filter(|(a, b)| a != b).count();
    assert!(differing > 500_000, "{differing}");
}

#[test]
fn what_other_channels_carry_changes_no_fate() {
    let alone = fates(&rich(), 3, ms(2), 100_000);
    let spec = rich();
    let mut one = spec.build(&place(3, "a/b")).unwrap();
    let mut other = spec.build(&place(3, "b/a")).unwrap();
    for (now, fate) in alone {
        for _ in 0..now.as_ns() / 2_000_000 % 3 {
            other.offer(now, 1_400);
        }
        assert_eq!(one.offer(now, 100), fate);
    }
}

#[test]
fn turning_one_part_on_changes_no_draw_of_another() {
    let plain = LinkSpec {
        loss: LossLaw::bernoulli(0.0),
        rate: None,
        outages: Outages::default(),
        reordering: None,
        duplication: None,
        reorders: true,
        ..rich()
    };
    let lossy = LinkSpec {
        loss: LossLaw::bernoulli(0.3),
        duplication: rich().duplication,
        outages: rich().outages,
        ..plain.clone()
    };
    let pairs = fates(&plain, 4, ms(2), COUNT).into_iter();
    let mut lost_count = 0;
    for ((_, without), (_, with)) in pairs.zip(fates(&lossy, 4, ms(2), COUNT)) {
        match with.arrival() {
            Some(at) => assert_eq!(Some(at), without.arrival()),
            None => lost_count += 1,
        }
    }
    assert!(lost_count > 300_000);
}

#[test]
fn messages_far_apart_have_the_law_whether_they_may_overtake_or_not() {
    for reorders in [false, true] {
        let spec = LinkSpec {
            delay: DelayLaw::Uniform(Uniform {
                min: ms(5),
                max: ms(25),
            }),
            reorders,
            ..LinkSpec::default()
        };
        // 20 ms apart nothing can overtake; 1 ms apart it could.
        for (period, holds) in [(ms(20), true), (ms(1), reorders)] {
            let all = fates(&spec, 5, period, COUNT);
            let delay_s = |(at, fate): &(Instant, Fate)| fate.arrival().unwrap().seconds_since(*at);
            let below = all.iter().filter(|one| delay_s(one) < 10e-3).count();
            let errors = errors_of(below, all.len(), 0.25);
            assert_eq!(
                errors.abs() < ERRORS_MAX,
                holds,
                "{reorders}, {period:?}: {errors}"
            );
            let in_order = all
                .windows(2)
                .all(|two| two[0].1.arrival() <= two[1].1.arrival());
            assert_eq!(in_order, !reorders || period == ms(20));
        }
    }
}

#[test]
fn messages_that_wait_for_the_one_before_have_the_stated_law() {
    let law = DelayLaw::Exponential(Exponential {
        min: ms(2),
        mean_excess: ms(4),
        ..Exponential::TEMPLATE
    });
    let spec = LinkSpec {
        delay: law.clone(),
        ..LinkSpec::default()
    };
    let period_s = 2e-3;
    let all = fates(&spec, 6, ms(2), COUNT);
    for limit_s in [3e-3, 6e-3, 10e-3, 20e-3] {
        let promised: f64 = (0..2_000)
            .map(|step| law.distribution(limit_s + f64::from(step) * period_s))
            .product();
        let within =
            |(at, fate): &&(Instant, Fate)| fate.arrival().unwrap().seconds_since(*at) <= limit_s;
        let share = all.iter().filter(within).count() as f64 / all.len() as f64;
        // Delays are correlated over about ten periods: a standard error of twenty times the
        // variance is on the safe side, and a tenth of what the floor does.
        let error = (20.0 * promised * (1.0 - promised) / COUNT as f64).sqrt();
        assert!(
            (share - promised).abs() < ERRORS_MAX * error,
            "{limit_s}: {share}, {promised}"
        );
        assert!(promised < 0.9 * law.distribution(limit_s) || limit_s > 15e-3);
    }
}

#[test]
fn held_messages_are_overtaken_by_as_many_as_stated() {
    let spec = LinkSpec {
        reordering: Some(Reordering {
            ratio: 0.05,
            hold: ms(10) + Duration::from_micros(500),
        }),
        ..LinkSpec::fixed(ms(3), 0.0)
    };
    let all = fates(&spec, 7, ms(1), COUNT);
    let held: Vec<usize> = (0..all.len())
        .filter(|index| all[*index].1.arrival() != Some(all[*index].0 + ms(3)))
        .collect();
    let errors = errors_of(held.len(), all.len(), 0.05);
    assert!(errors.abs() < ERRORS_MAX, "{} held", held.len());
    let mut overtakers = 0;
    let whole = held.iter().filter(|index| **index + 11 < all.len());
    for index in whole.clone() {
        let at = all[*index].1.arrival();
        assert_eq!(
            at,
            Some(all[*index].0 + ms(13) + Duration::from_micros(500))
        );
        let later = &all[index + 1..index + 12];
        overtakers += later.iter().filter(|(_, fate)| fate.arrival() < at).count();
    }
    // The next ten, less those held themselves.
    let errors = errors_of(overtakers, whole.count() * 10, 0.95);
    assert!(
        errors.abs() < ERRORS_MAX,
        "{overtakers} overtakers, {errors}"
    );
}

#[test]
fn copies_come_as_often_and_as_late_as_stated() {
    let spec = LinkSpec {
        duplication: Some(Duplication {
            ratio: 0.02,
            lag: ms(5),
        }),
        ..LinkSpec::fixed(ms(3), 0.0)
    };
    let all = fates(&spec, 8, ms(1), COUNT);
    let mut copied_count = 0;
    for (at, fate) in &all {
        assert_eq!(fate.arrival(), Some(*at + ms(3)));
        if let Some(second) = fate.second_arrival() {
            assert_eq!(second, *at + ms(8));
            copied_count += 1;
        }
    }
    let errors = errors_of(copied_count, all.len(), 0.02);
    assert!(errors.abs() < ERRORS_MAX, "{copied_count} copies");
}

#[test]
fn a_lost_message_takes_no_place_in_the_queue() {
    // A link of one place that is lost before it: what gets through finds it empty.
    let rate = RateLimit {
        bits_per_second: 8_000,
        queue_bytes: 128,
        overhead_bytes: 0,
    };
    let spec = LinkSpec {
        rate: Some(rate),
        ..LinkSpec::fixed(Duration::ZERO, 0.5)
    };
    let mut link = model(&spec, 10);
    let mut free_at = Instant::ZERO;
    let mut refused_count = 0;
    for step in 0..100_000 {
        let now = Instant::from_ns(step * 60_000_000);
        // 100 bytes take 100 ms: after a message that was taken one or two find no room.
        let causes = link.loss_causes().unwrap();
        let fate = link.offer(now, 100);
        let new = link.loss_causes().unwrap();
        if let Fate::Delivered(at) = fate {
            assert!(now >= free_at.max(Instant::ZERO) || at > now + ms(100));
            free_at = at;
        } else if new.queue_count > causes.queue_count {
            assert!(
                now < free_at,
                "found no room at {now}, though empty from {free_at}"
            );
            refused_count += 1;
        } else {
            assert_eq!(new.chance_count, causes.chance_count + 1);
        }
    }
    assert!(refused_count > 10_000, "{refused_count}");
}

#[test]
fn every_loss_has_a_cause_and_the_causes_add_up() {
    let mut link = model(&rich(), 11);
    let mut lost_count = 0;
    for step in 0..COUNT {
        // 128 bytes at 1 Mbit/s take 1.024 ms: one a millisecond is too much.
        let fate = link.offer(Instant::from_ns(step * 1_000_000), 100);
        lost_count += u64::from(fate == Fate::Lost);
    }
    let causes = link.loss_causes().unwrap();
    assert_eq!(causes.total(), lost_count);
    assert!(causes.outage_count > 0 && causes.chance_count > 0 && causes.queue_count > 0);
}

#[test]
fn bursts_strike_all_channels_of_a_link_and_no_other_link() {
    let spec = LinkSpec {
        loss: LossLaw::Bursts(Bursts {
            good_mean: ms(90),
            bad_mean: ms(10),
            bad_loss_ratio: 1.0,
            good_loss_ratio: 0.0,
        }),
        ..LinkSpec::default()
    };
    let mut there = spec.build(&place(12, "a/b")).unwrap();
    let back = LinkPlace {
        way: Way::Backward,
        ..place(12, "b/a")
    };
    let mut back = spec.build(&back).unwrap();
    let elsewhere = LinkPlace {
        link: "wire",
        ..place(12, "a/b")
    };
    let mut elsewhere = spec.build(&elsewhere).unwrap();
    let mut differing = 0;
    for step in 0..100_000 {
        let now = Instant::from_ns(step * 1_000_000);
        let fate = there.offer(now, 10);
        assert_eq!(back.offer(now, 10), fate);
        differing += u32::from(elsewhere.offer(now, 10) != fate);
    }
    assert!(differing > 10_000, "{differing}");
}

#[test]
fn a_description_says_what_it_does() {
    let spec = rich();
    let words = spec.describe();
    for part in [
        "exponential on top",
        "no message overtakes",
        "Gilbert-Elliott",
        "1000000 bit/s with a queue of 2000 bytes",
        "0.01 held back by 30 ms",
        "0.02 twice, 5 ms apart",
        "on average, 600 per hour",
    ] {
        assert!(words.contains(part), "{words}");
    }
    assert_eq!(
        LinkSpec::fixed(ms(50), 0.1).describe(),
        "50 ms delay, loss ratio 0.1"
    );
}
