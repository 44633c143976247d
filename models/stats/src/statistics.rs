//! Exact intervals of independent trials: repetitions, collisions of independent runs, tests. What messages of one
//! run have is in [`crate::dependence`]. No interval is a promise about another day, room or host.

use crate::special::{gamma_quantile, incomplete_beta, invert};
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

/// The sum of what independent events weigh, e.g. of the lengths of failures, where their number is Poisson's.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PoissonSum {
    /// Events.
    pub count: u64,
    sum: f64,
    squares: f64,
    heaviest: f64,
}

impl PoissonSum {
    /// Adds an event.
    pub fn push(&mut self, weight: f64) {
        self.count += 1;
        self.sum += weight;
        self.squares += weight * weight;
        self.heaviest = self.heaviest.max(weight);
    }

    /// Ends of the interval of the expected sum (Fay and Feuer 1997, Stat. Med. 16:791; of equal weights that of Garwood 1936).
    /// An event that did not happen would have weighed `weight_min` or as much as the heaviest. Weights are taken as known: of
    /// exponential ones each end misses up to 6 % of the samples in place of 2.5 %.
    pub fn interval(&self, weight_min: f64, confidence: f64) -> [f64; 2] {
        let tail = 0.5 * (1.0 - confidence);
        let end = |sum: f64, squares: f64, probability: f64| {
            gamma_quantile(probability, sum * sum / squares) * squares / sum
        };
        let low = match self.count {
            0 => 0.0,
            _ => end(self.sum, self.squares, tail),
        };
        let one_more = self.heaviest.max(weight_min);
        let squares = self.squares + one_more * one_more;
        [low, end(self.sum + one_more, squares, 1.0 - tail)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::random::RandomStream;

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

    #[test]
    fn sums_of_equal_weights_have_garwoods_ends() {
        // Of a Poisson mean, 90 %: Garwood (1936).
        for (count, low, high) in [
            (0, 0.0, 2.9957),
            (1, 0.0513, 4.7439),
            (3, 0.8177, 7.7537),
            (10, 5.4254, 16.9622),
        ] {
            let mut sum = PoissonSum::default();
            (0..count).for_each(|_| sum.push(0.5));
            let ends = sum.interval(0.5, 0.9);
            let expected = [0.5 * low, 0.5 * high];
            let is_near = |index: usize| (ends[index] - expected[index]).abs() < 1e-4;
            assert!(is_near(0) && is_near(1), "{count}: {ends:?}");
        }
    }

    #[test]
    fn each_end_of_a_sum_of_exponential_weights_holds_in_94_of_100_samples() {
        let mut stream = RandomStream::new(1, "statistics.poisson_sum");
        for mean in [1.0, 5.0, 40.0] {
            let mut held = [0_u32; 2];
            for _ in 0..4_000 {
                let mut exponential = || -(1.0 - stream.uniform()).ln();
                let mut sum = PoissonSum::default();
                let mut at = exponential();
                while at < mean {
                    sum.push(exponential());
                    at += exponential();
                }
                let [low, high] = sum.interval(1.0, 0.95);
                held[0] += u32::from(low <= mean);
                held[1] += u32::from(mean <= high);
            }
            assert!(held.iter().all(|&one| one > 3_740), "{mean}: {held:?}");
        }
    }
}
