//! Exact intervals of independent trials: repetitions, collisions of independent runs, tests. What messages of one
//! run have is in [`crate::dependence`]. No interval is a promise about another day, room or host.

use crate::special::{incomplete_beta, invert};
use hil_core::interval::{Interval, IntervalMethod};

/// The confidence every report uses.
pub const CONFIDENCE: f64 = 0.95;

/// The exact interval for a proportion (Clopper and Pearson 1934): never covers less than
/// `confidence`, usually more. `None` without trials.
///
/// # Panics
/// When `successes > trials` or `confidence` is not inside 0..1.
pub fn clopper_pearson(successes: u64, trials: u64, confidence: f64) -> Option<Interval> {
    clopper_pearson_at(successes, trials, 1.0, confidence)
}

/// The same of trials that come together: both counts are divided by `scatter`, the variance of the successes over
/// that of independent trials, and stay real numbers (Korn and Graubard 1998). `None` without trials.
///
/// # Panics
/// As [`clopper_pearson`], and when `scatter` is not above zero.
pub fn clopper_pearson_at(
    successes: u64,
    trials: u64,
    scatter: f64,
    confidence: f64,
) -> Option<Interval> {
    check(successes, trials, confidence);
    assert!(scatter > 0.0, "scatter {scatter} is not above zero");
    if trials == 0 {
        return None;
    }
    let tail = 0.5 * (1.0 - confidence);
    let [k, misses] = [successes, trials - successes].map(|count| count as f64 / scatter);
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
    Some(Interval::new(low, high, IntervalMethod::Exact))
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

#[cfg(test)]
mod tests {
    use super::*;

    fn assert_interval(actual: Interval, low: f64, high: f64) {
        let matches = (actual.low - low).abs() < 5e-5 && (actual.high - high).abs() < 5e-5;
        assert!(matches, "{actual:?} is not {low}..{high}");
    }

    /// Newcombe (1998), Statistics in Medicine 17:857, table I: (r, n), method 5.
    const NEWCOMBE: [(u64, u64, [f64; 2]); 4] = [
        (81, 263, [0.2527, 0.3676]),
        (15, 148, [0.0578, 0.1617]),
        (0, 20, [0.0, 0.1684]),
        (1, 29, [0.0009, 0.1776]),
    ];

    #[test]
    fn proportion_intervals_match_newcombes_table() {
        for (successes, trials, exact) in NEWCOMBE {
            let interval = clopper_pearson(successes, trials, 0.95).unwrap();
            assert_interval(interval, exact[0], exact[1]);
            let mirrored = clopper_pearson(trials - successes, trials, 0.95).unwrap();
            assert_interval(mirrored, 1.0 - exact[1], 1.0 - exact[0]);
        }
        assert_eq!(clopper_pearson(0, 0, 0.95), None);
    }

    #[test]
    fn counts_divided_by_the_scatter_stay_real() {
        // Whole quotients are as such counts; one between two counts lies between their intervals.
        let halved = clopper_pearson_at(2 * 81, 2 * 263, 2.0, 0.95).unwrap();
        assert_interval(halved, 0.2527, 0.3676);
        let of = |successes| clopper_pearson_at(successes, 2100, 2.1, 0.95).unwrap();
        let whole = |successes| clopper_pearson(successes, 1000, 0.95).unwrap();
        let one = of(1);
        assert!(whole(0).low < one.low && one.low < whole(1).low, "{one:?}");
        assert!(whole(0).high < one.high && one.high < whole(1).high);
        assert_interval(of(0), 0.0, whole(0).high);
    }
}
