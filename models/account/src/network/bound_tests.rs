//! How far two clocks may lead the figures of a delay's variation astray.

use super::tests::{arrived, figures_on, passages};
use crate::ChannelPath;
use hil_core::random::RandomStream;
use hil_core::time::Alignment;

#[test]
fn variation_is_bounded_by_twice_the_alignment_or_by_drift_and_nothing_on_one_clock() {
    let aligned = |bound_ns| ChannelPath::Gateway {
        alignment: Some(Alignment {
            offset_ns: 0,
            bound_ns,
        }),
    };
    // 2 s: at 200 ppm two clocks part by 398 us from the first message to the last.
    let of = |path, bound_ns: u64| {
        let mut all = passages(200, |_| false);
        for one in &mut all {
            one.delay_bound_ns = bound_ns;
        }
        let found = figures_on(path, &all);
        let variation = found.delay.measured().unwrap().variation;
        (variation.bound_ns, *found.successive.measured().unwrap())
    };
    let (narrow_ns, successive) = of(aligned(40_000), 40_000);
    assert_eq!(narrow_ns, 80_000);
    // A period of 10 ms; jitter of a steady bound comes near it from below.
    assert_eq!(successive.bound_ns, 2_000);
    assert!(successive.is_bound_wider, "they do not differ at all");
    assert!((1_990.0..=2_000.0).contains(&successive.jitter.bound_ns));
    let (wide_ns, _) = of(aligned(20_000_000), 20_000_000);
    assert_eq!(wide_ns, 398_000);
    let (none_ns, successive) = of(ChannelPath::SharedMemory, 0);
    assert_eq!((none_ns, successive.bound_ns), (0, 0));
    assert!(successive.jitter.bound_ns.abs() < f64::EPSILON);
    let (_, unaligned) = of(ChannelPath::Gateway { alignment: None }, 0);
    assert_eq!(
        unaligned.bound_ns, 2_000,
        "rates are bounded without an alignment"
    );
}

#[test]
fn the_bound_of_the_variation_holds_for_clocks_that_drift_as_far_as_they_may() {
    // The true offset drifts by 200 ppm to and fro; the estimate is a constant within its bound.
    let mut random = RandomStream::new(5, "variation");
    for round in 0..50_u64 {
        let turn = 20 + round * 3;
        let mut offset_ns = 0_i64;
        let mut truths = Vec::new();
        let mut all = Vec::new();
        let mut worst_ns = 0;
        for sequence in 0..200_u64 {
            offset_ns += if sequence < turn { 2_000 } else { -2_000 };
            worst_ns = worst_ns.max(offset_ns.unsigned_abs());
            #[allow(clippy::cast_possible_truncation, reason = "below a millisecond")]
            let true_ns = 1_000_000 + (random.uniform() * 200e3) as i64;
            truths.push(true_ns);
            // Taken for the same clock, the delay has the whole offset in it.
            all.push(arrived(sequence, true_ns + offset_ns));
        }
        for one in &mut all {
            one.delay_bound_ns = worst_ns;
        }
        let path = ChannelPath::Gateway {
            alignment: Some(Alignment {
                offset_ns: 0,
                bound_ns: worst_ns,
            }),
        };
        let found = figures_on(path, &all);
        let variation = found.delay.measured().unwrap().variation;
        truths.sort_unstable();
        let true_p50_ns = truths[99] - truths[0];
        let true_max_ns = truths[199] - truths[0];
        for (told_ns, true_ns) in [
            (variation.p50_ns, true_p50_ns),
            (variation.max_ns, true_max_ns),
        ] {
            assert!(
                told_ns.abs_diff(true_ns) <= variation.bound_ns,
                "{variation:?}"
            );
        }
    }
}
