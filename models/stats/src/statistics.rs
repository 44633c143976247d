//! Intervals for what a run counts and measures: proportions, rates and quantiles. No interval
//! here is a promise about another day, another room or another host.
//!
//! Delays of successive messages are correlated (queues, interference, scheduling), so the
//! order-statistics interval, which assumes independence, is too narrow for them; reports use
//! [`block_bootstrap_quantile`], which keeps the correlation inside its blocks.

use serde::{Deserialize, Serialize};
use statrs::function::gamma::gamma_lr;

use crate::resampling::BlockResampling;
use crate::samples::Samples;
use crate::special::{binomial_cdf, incomplete_beta, invert, normal_quantile};
use hil_core::random::RandomStream;

/// The confidence every report uses.
pub const CONFIDENCE: f64 = 0.95;

/// Resamples of the block bootstrap; its 2.5 % tail then rests on 10 of them.
pub const RESAMPLE_COUNT: usize = 400;

/// Fewest blocks for which resampling blocks means anything.
pub(super) const BLOCK_COUNT_MIN: usize = 10;

/// Fewest samples beyond a quantile for which resampling says anything about it.
const TAIL_COUNT_MIN: f64 = 10.0;

/// True when enough of `count` samples lie beyond the quantile `share`, on its nearer side, for an
/// interval by resampling.
pub fn has_tail(count: usize, share: f64) -> bool {
    share.min(1.0 - share) * count as f64 >= TAIL_COUNT_MIN
}

/// A closed interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// A closed interval of nanoseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct IntervalNs {
    /// Lower end, nanoseconds.
    pub low_ns: i64,
    /// Upper end, nanoseconds.
    pub high_ns: i64,
}

/// Wilson's score interval for a proportion (Wilson 1927; Newcombe 1998, method 3): close to its
/// nominal coverage on average, also near 0 and 1. `None` without trials.
///
/// # Panics
/// When `successes > trials` or `confidence` is not inside 0..1.
pub fn wilson(successes: u64, trials: u64, confidence: f64) -> Option<Interval> {
    check(successes, trials, confidence);
    if trials == 0 {
        return None;
    }
    let n = trials as f64;
    let Interval { low, high } = wilson_of(successes as f64 / n, n, confidence);
    // The closed form is exact at the ends; rounding is not.
    Some(Interval {
        low: if successes == 0 { 0.0 } else { low },
        high: if successes == trials { 1.0 } else { high },
    })
}

/// Wilson's interval for a share of `n` trials, which need not be a whole number.
pub fn wilson_of(share: f64, n: f64, confidence: f64) -> Interval {
    let z = normal_quantile(0.5 + 0.5 * confidence);
    let centre = share + z * z / (2.0 * n);
    let spread = z * (share * (1.0 - share) / n + z * z / (4.0 * n * n)).sqrt();
    let scale = 1.0 + z * z / n;
    Interval {
        low: ((centre - spread) / scale).max(0.0),
        high: ((centre + spread) / scale).min(1.0),
    }
}

/// The exact interval for a proportion (Clopper and Pearson 1934): never covers less than
/// `confidence`, usually more. `None` without trials.
///
/// # Panics
/// When `successes > trials` or `confidence` is not inside 0..1.
pub fn clopper_pearson(successes: u64, trials: u64, confidence: f64) -> Option<Interval> {
    check(successes, trials, confidence);
    if trials == 0 {
        return None;
    }
    let tail = 0.5 * (1.0 - confidence);
    let (k, misses) = (successes as f64, (trials - successes) as f64);
    let low = if successes == 0 {
        0.0
    } else {
        invert(tail, 0.0, 1.0, |x| incomplete_beta(k, misses + 1.0, x))
    };
    let high = if successes == trials {
        1.0
    } else {
        invert(1.0 - tail, 0.0, 1.0, |x| {
            incomplete_beta(k + 1.0, misses, x)
        })
    };
    Some(Interval { low, high })
}

/// The exact interval for the mean of a Poisson count (Garwood 1936), e.g. for rare events in a
/// run of given length.
///
/// # Panics
/// When `confidence` is not inside 0..1.
pub fn poisson(count: u64, confidence: f64) -> Interval {
    check(0, 0, confidence);
    let tail = 0.5 * (1.0 - confidence);
    let k = count as f64;
    let ceiling = 2.0 * k + 10.0 * normal_quantile(1.0 - tail).powi(2) + 100.0;
    let low = if count == 0 {
        0.0
    } else {
        invert(tail, 0.0, ceiling, |x| gamma_lr(k, x))
    };
    let high = invert(1.0 - tail, 0.0, ceiling, |x| gamma_lr(k + 1.0, x));
    Interval { low, high }
}

fn check(successes: u64, trials: u64, confidence: f64) {
    assert!(
        successes <= trials,
        "{successes} successes exceed {trials} trials"
    );
    assert!(
        confidence > 0.0 && confidence < 1.0,
        "confidence {confidence} is outside 0..1"
    );
}

/// The 1-based ranks of the two order statistics that enclose a quantile with at least
/// `confidence` (David and Nagaraja 2003, section 7.1), for *independent* samples of any
/// continuous distribution. `None` when `count` is too small for such a pair.
///
/// # Panics
/// When `quantile` or `confidence` is not inside 0..1.
pub fn quantile_ranks(count: u64, quantile: f64, confidence: f64) -> Option<(u64, u64)> {
    check(0, 0, confidence);
    assert!(
        quantile > 0.0 && quantile < 1.0,
        "quantile {quantile} is outside 0..1"
    );
    let tail = 0.5 * (1.0 - confidence);
    let below = |rank: u64| binomial_cdf(rank - 1, count, quantile);
    // The largest rank whose left tail still fits, the smallest whose right tail does.
    let low = partition(count, |rank| below(rank) <= tail);
    let high = partition(count, |rank| below(rank) < 1.0 - tail) + 1;
    (low >= 1 && high <= count).then_some((low, high))
}

/// The largest rank in `1..=count` for which a non-increasing predicate holds; 0 when none.
fn partition(count: u64, holds: impl Fn(u64) -> bool) -> u64 {
    let (mut yes, mut no) = (0, count + 1);
    while no - yes > 1 {
        let middle = yes + (no - yes) / 2;
        if holds(middle) {
            yes = middle;
        } else {
            no = middle;
        }
    }
    yes
}

/// The percentile interval of a quantile by resampling non-overlapping blocks (Carlstein 1986)
/// of consecutive samples, each about the square root of the sample count long. `None` below 100
/// samples. Equal samples and streams give equal intervals.
///
/// # Panics
/// When `quantile` or `confidence` is not inside 0..1.
pub fn block_bootstrap_quantile(
    samples_ns: &[i64],
    quantile: f64,
    confidence: f64,
    random: &mut RandomStream,
) -> Option<IntervalNs> {
    check(0, 0, confidence);
    assert!(
        quantile > 0.0 && quantile < 1.0,
        "quantile {quantile} is outside 0..1"
    );
    let samples: Samples = samples_ns.iter().copied().collect();
    Some(BlockResampling::of(&samples)?.interval(quantile, confidence, random))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn assert_interval(actual: Interval, low: f64, high: f64) {
        let matches = (actual.low - low).abs() < 5e-5 && (actual.high - high).abs() < 5e-5;
        assert!(matches, "{actual:?} is not {low}..{high}");
    }

    /// Newcombe (1998), Statistics in Medicine 17:857, table I: (r, n), method 3, method 5.
    const NEWCOMBE: [(u64, u64, [f64; 2], [f64; 2]); 4] = [
        (81, 263, [0.2553, 0.3662], [0.2527, 0.3676]),
        (15, 148, [0.0624, 0.1605], [0.0578, 0.1617]),
        (0, 20, [0.0, 0.1611], [0.0, 0.1684]),
        (1, 29, [0.0061, 0.1718], [0.0009, 0.1776]),
    ];

    #[test]
    fn proportion_intervals_match_newcombes_table() {
        for (successes, trials, score, exact) in NEWCOMBE {
            let interval = wilson(successes, trials, 0.95).unwrap();
            assert_interval(interval, score[0], score[1]);
            let interval = clopper_pearson(successes, trials, 0.95).unwrap();
            assert_interval(interval, exact[0], exact[1]);
            let mirrored = clopper_pearson(trials - successes, trials, 0.95).unwrap();
            assert_interval(mirrored, 1.0 - exact[1], 1.0 - exact[0]);
        }
        assert_eq!(wilson(0, 0, 0.95), None);
        assert_eq!(clopper_pearson(0, 0, 0.95), None);
    }

    #[test]
    fn poisson_intervals_match_garwoods_table() {
        for (count, low, high) in [
            (0, 0.0, 3.689),
            (1, 0.0253, 5.572),
            (5, 1.623, 11.668),
            (10, 4.795, 18.390),
            (100, 81.364, 121.627),
        ] {
            let interval = poisson(count, 0.95);
            let matches = (interval.low - low).abs() < 6e-4 && (interval.high - high).abs() < 6e-4;
            assert!(matches, "{count}: {interval:?}");
        }
    }

    #[test]
    fn median_ranks_match_the_published_table() {
        // Conover (1999), confidence interval for a median at 95 %.
        assert_eq!(quantile_ranks(5, 0.5, 0.95), None);
        assert_eq!(quantile_ranks(6, 0.5, 0.95), Some((1, 6)));
        assert_eq!(quantile_ranks(10, 0.5, 0.95), Some((2, 9)));
        assert_eq!(quantile_ranks(20, 0.5, 0.95), Some((6, 15)));
        assert_eq!(quantile_ranks(100, 0.5, 0.95), Some((40, 61)));
        // A p99 needs 473 independent samples before both of its ends exist: 0.99^n <= 0.025
        // at the upper end needs 367; below that there is none.
        assert_eq!(quantile_ranks(366, 0.99, 0.95), None);
        assert!(quantile_ranks(368, 0.99, 0.95).is_some());
    }

    /// An autoregressive series around 1 ms; `memory` 0 is independent.
    #[allow(clippy::cast_possible_truncation, reason = "values stay near 10^6")]
    fn series(count: usize, memory: f64, stream: &mut RandomStream) -> Vec<i64> {
        let mut state = 0.0;
        (0..count)
            .map(|_| {
                state = memory * state + (1.0 - memory * memory).sqrt() * stream.normal();
                (1_000_000.0 + 10_000.0 * state) as i64
            })
            .collect()
    }

    #[test]
    fn correlated_samples_widen_the_bootstrap_but_fool_the_order_statistics() {
        let mut stream = RandomStream::new(5, "series");
        let (mut naive_hits, mut block_hits) = (0, 0);
        for _ in 0..50 {
            let samples = series(1_600, 0.9, &mut stream);
            let block = block_bootstrap_quantile(&samples, 0.5, 0.95, &mut stream).unwrap();
            let mut ascending = samples;
            ascending.sort_unstable();
            let (low, high) = quantile_ranks(1_600, 0.5, 0.95).unwrap();
            let at = |rank: u64| ascending[usize::try_from(rank).unwrap() - 1];
            let naive = IntervalNs {
                low_ns: at(low),
                high_ns: at(high),
            };
            let holds = |i: IntervalNs| i.low_ns <= 1_000_000 && 1_000_000 <= i.high_ns;
            naive_hits += u32::from(holds(naive));
            block_hits += u32::from(holds(block));
        }
        assert!(naive_hits < 33, "naive covered {naive_hits} of 50");
        assert!(block_hits > 39, "blocks covered {block_hits} of 50");
    }

    #[test]
    fn equal_streams_give_equal_intervals_and_few_samples_give_none() {
        let samples = series(1_000, 0.5, &mut RandomStream::new(1, "series"));
        let interval = |seed| {
            let mut stream = RandomStream::new(seed, "bootstrap");
            block_bootstrap_quantile(&samples, 0.9, 0.95, &mut stream)
        };
        assert_eq!(interval(1), interval(1));
        assert!(interval(1).unwrap().low_ns <= interval(1).unwrap().high_ns);
        let mut stream = RandomStream::new(1, "few");
        assert_eq!(
            block_bootstrap_quantile(&samples[..99], 0.5, 0.95, &mut stream),
            None
        );
    }
}
