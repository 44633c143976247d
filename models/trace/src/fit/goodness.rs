//! The test of a fitted model of losses: Pearson's chi-square on burst lengths.

use super::chain::Chain;
use hil_stats::goodness::ChiSquare;

/// Fewest expected bursts in a class (Cochran 1954).
const EXPECTED_MIN: f64 = 5.0;
/// Longest burst with a class of its own.
const LENGTH_MAX: usize = 10_000;

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
    ChiSquare::of(&classes, fitted_count)
}
