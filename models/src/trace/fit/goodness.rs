//! Tests of a fitted model: Pearson's chi-square on burst lengths, Kolmogorov and Smirnov's distance
//! on delays. They say what speaks against a model, never that it is true.

use serde::{Deserialize, Serialize};

use super::chain::Chain;
use crate::measure::special::incomplete_gamma;

/// Fewest expected bursts in a class (Cochran 1954).
const EXPECTED_MIN: f64 = 5.0;
/// Longest burst with a class of its own.
const LENGTH_MAX: usize = 10_000;

/// Pearson's test.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ChiSquare {
    /// Sum of (observed - expected)² / expected.
    pub statistic: f64,
    /// Degrees of freedom: classes - 1 - numbers fitted.
    pub degrees: u32,
    /// Probability of a value as large, if the model is true.
    pub probability: f64,
}

/// Lengths of the rows of losses in `losses`; a row cut by either end does not count.
fn burst_lengths(losses: &[bool]) -> Vec<usize> {
    let rows = losses.split(|is_lost| !is_lost);
    let lengths: Vec<usize> = rows.map(<[bool]>::len).collect();
    let inner = lengths.len().saturating_sub(1).max(1);
    let whole = lengths.get(1..inner).unwrap_or_default();
    whole.iter().copied().filter(|length| *length > 0).collect()
}

/// Burst lengths of `losses` against those of `chain`, which spent `fitted_count` numbers on them.
/// `None` when too few bursts are left for a test.
pub(super) fn burst_test(losses: &[bool], chain: &Chain, fitted_count: usize) -> Option<ChiSquare> {
    let lengths = burst_lengths(losses);
    let n = lengths.len() as f64;
    let longest = lengths.iter().copied().max()?.clamp(64, LENGTH_MAX);
    let survival = chain.burst_survival(longest);
    let mut classes: Vec<(f64, f64)> = Vec::new();
    let (mut expected, mut from) = (0.0, 1);
    for length in 1..=longest {
        expected += n * (survival[length - 1] - survival[length]);
        let rest = n * survival[length];
        // What is left must make a class of its own, or belong to this one.
        if expected >= EXPECTED_MIN && rest >= EXPECTED_MIN {
            let observed = lengths.iter().filter(|one| (from..=length).contains(*one));
            classes.push((observed.count() as f64, expected));
            (expected, from) = (0.0, length + 1);
        }
    }
    let observed = lengths.iter().filter(|one| **one >= from).count() as f64;
    classes.push((observed, n * survival[from - 1]));
    let degrees = classes.len().checked_sub(1 + fitted_count)?;
    if degrees == 0 {
        return None;
    }
    let terms = classes.iter().map(|(observed, expected)| {
        (observed - expected).powi(2) / expected.max(f64::MIN_POSITIVE)
    });
    let statistic: f64 = terms.sum();
    let probability = 1.0 - incomplete_gamma(0.5 * degrees as f64, 0.5 * statistic);
    Some(ChiSquare {
        statistic,
        degrees: u32::try_from(degrees).unwrap_or(u32::MAX),
        probability: probability.clamp(0.0, 1.0),
    })
}

/// Largest difference between the distribution of `ascending` and `distribution`.
pub(super) fn ks_distance(ascending: &[f64], distribution: impl Fn(f64) -> f64) -> f64 {
    let n = ascending.len() as f64;
    let mut largest: f64 = 0.0;
    for (index, value) in ascending.iter().enumerate() {
        let expected = distribution(*value);
        let (below, upto) = (index as f64 / n, (index + 1) as f64 / n);
        largest = largest
            .max((expected - below).abs())
            .max((upto - expected).abs());
    }
    largest
}
