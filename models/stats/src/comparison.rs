//! Intervals for how two runs differ: by a difference or a ratio, from the intervals of each, or from
//! the spread of repetitions. It judges nothing and knows no channel.

use core::cmp::Ordering;

use serde::{Deserialize, Serialize};

use super::special::{normal_quantile, student_quantile};
use super::statistics::{CONFIDENCE, clopper_pearson_at};
use hil_core::interval::{Interval, IntervalMethod};
use hil_core::study::Verdict;

/// A figure of one run, with its interval where it has one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// The figure.
    pub value: f64,
    /// Its interval.
    pub interval: Option<Interval>,
}

impl Estimate {
    /// Of a share: how many independent trials have as wide an interval. `None` without one.
    pub fn effective_count(self) -> Option<f64> {
        let Interval { low, high, .. } = self.interval?;
        let variance = self.value * (1.0 - self.value);
        let tail = 0.5 - 0.5 * CONFIDENCE;
        Some(variance * (2.0 * normal_quantile(1.0 - tail) / (high - low)).powi(2))
    }
}

/// The interval of `new - base` for independent estimates, from the interval of each (MOVER, Zou and
/// Donner 2008; with score intervals it is method 10 of Newcombe 1998). `None` when either has none.
pub fn difference(base: Estimate, new: Estimate) -> Option<Interval> {
    let (b, n) = (base.interval?, new.interval?);
    let d = new.value - base.value;
    let below = (new.value - n.low).hypot(b.high - base.value);
    let above = (n.high - new.value).hypot(base.value - b.low);
    Some(Interval::new(d - below, d + above, IntervalMethod::Mover))
}

/// The interval of `new / base`, by [`difference`] of the logarithms. `None` when either has none, or
/// reaches to zero or below.
pub fn ratio(base: Estimate, new: Estimate) -> Option<Interval> {
    let logarithm = |one: Estimate| {
        let interval = one.interval?;
        (interval.low > 0.0 && one.value > 0.0).then(|| Estimate {
            value: one.value.ln(),
            interval: Some(interval.map(f64::ln)),
        })
    };
    Some(difference(logarithm(base)?, logarithm(new)?)?.map(f64::exp))
}

/// The interval of a share of which none of `of` were seen, where its events come together as those of another
/// sample do: `like`, of `like_of`. What that one is worth shows in the width of its interval, and the upper end is
/// exact (Clopper and Pearson 1934) for as large a part of `of`. `None` when that one has no interval.
pub fn none_of(of: u64, like: Estimate, like_of: u64) -> Option<Interval> {
    let tail = 0.5 - 0.5 * CONFIDENCE;
    let effective = like.effective_count()?;
    let worth = of as f64 * (effective / like_of as f64).min(1.0);
    (worth > 0.0).then(|| {
        let high = 1.0 - tail.powf(1.0 / worth);
        Interval::new(0.0, high, IntervalMethod::EffectiveShare)
    })
}

/// How criteria are judged, each by an interval of the sample: what a small sample says is neither met nor missed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Judge {
    /// The confidence of what a miss must leave no doubt of.
    miss: f64,
}

impl Judge {
    /// By chance, at most this share of tables miss one of their criteria, if all of them hold.
    pub const ERROR_RATE: f64 = 0.05;

    /// For a table of so many criteria (Bonferroni).
    pub const fn of_tests(count: usize) -> Self {
        let count = if count == 0 { 1 } else { count };
        Self {
            miss: 1.0 - Self::ERROR_RATE / count as f64,
        }
    }

    /// The confidence of the interval that a miss is judged by.
    pub const fn miss_confidence(self) -> f64 {
        self.miss
    }

    /// True when the interval of the figure lies as `holds` says, at the usual confidence; false when it lies as
    /// `fails` says, at that of a miss; `None` between, or without an interval.
    pub fn verdict<T>(
        self,
        interval: impl Fn(f64) -> Option<T>,
        holds: impl Fn(&T) -> bool,
        fails: impl Fn(&T) -> bool,
    ) -> Option<bool> {
        if holds(&interval(CONFIDENCE)?) {
            Some(true)
        } else {
            fails(&interval(self.miss)?).then_some(false)
        }
    }
}

/// So many of so many.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Share {
    /// Those that count.
    pub count: u64,
    /// All.
    pub of: u64,
}

impl Share {
    /// The share with its exact interval, both counts divided by `scatter`; `None` of none. See [`clopper_pearson_at`].
    ///
    /// # Panics
    /// When more count than there are, or `scatter` is not above zero.
    pub fn estimate(self, scatter: f64) -> Option<Estimate> {
        let interval = clopper_pearson_at(self.count, self.of, scatter, CONFIDENCE)?;
        Some(Estimate {
            value: self.count as f64 / self.of as f64,
            interval: Some(interval),
        })
    }
}

/// How much more the shares of parts of a sample vary than those of independent trials: Pearson's chi-squared and its degrees
/// of freedom (Rao and Scott 1992). Each part should be long against the time for which events come together.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Scatter {
    chi_squared: f64,
    freedom: f64,
}

impl Scatter {
    /// That of `parts`; of one part, or where none or all count, it tells nothing.
    pub fn of(parts: &[Share]) -> Self {
        let sum = |of: fn(&Share) -> u64| parts.iter().map(of).sum::<u64>() as f64;
        let share = sum(|part| part.count) / sum(|part| part.of);
        if !(share > 0.0 && share < 1.0) {
            return Self::default();
        }
        let parts = parts.iter().filter(|part| part.of > 0);
        let off = parts.clone().map(|part| {
            let of = part.of as f64;
            (part.count as f64 - share * of).powi(2) / (share * (1.0 - share) * of)
        });
        Self {
            chi_squared: off.sum(),
            freedom: parts.count().saturating_sub(1) as f64,
        }
    }

    /// That of this sample and `other`, each about its own share.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        Self {
            chi_squared: self.chi_squared + other.chi_squared,
            freedom: self.freedom + other.freedom,
        }
    }

    /// The variance over that of independent trials; `None` where nothing tells it.
    pub fn ratio(self) -> Option<f64> {
        (self.freedom > 0.0).then(|| self.chi_squared / self.freedom)
    }

    /// What counts are divided by for [`clopper_pearson_at`]: the ratio, and as much more as Student's interval is wider
    /// than the normal one because the ratio is an estimate itself.
    pub fn divisor(self) -> Option<f64> {
        let wider = |freedom| student_quantile(0.975, freedom) / normal_quantile(0.975);
        Some(self.ratio()? * wider(self.freedom).powi(2))
    }
}

/// How `ours` stands to the `published` share, which is taken to scatter as ours does, by `scatter`; `None` when either
/// is of none.
///
/// # Panics
/// As [`Share::estimate`].
pub fn against_published(published: Share, ours: Share, scatter: f64) -> Option<Verdict> {
    estimate_against_published(published, ours.estimate(scatter)?, ours.of as f64, scatter)
}

/// The same of `ours` with an interval of its own, a share of `of`.
///
/// # Panics
/// As [`Share::estimate`].
pub fn estimate_against_published(
    published: Share,
    ours: Estimate,
    of: f64,
    scatter: f64,
) -> Option<Verdict> {
    let interval = difference(published.estimate(scatter)?, ours)?;
    Some(if interval.low > 0.0 || interval.high < 0.0 {
        Verdict::Differs
    } else if 2.0 * of >= published.of as f64 {
        Verdict::Agrees
    } else {
        Verdict::Inconclusive
    })
}

/// The interval of the difference of two means, `new - base`, of repetitions (Welch 1947): what the runs
/// differ by among themselves is in it. `None` below two on either side, or when none differs at all.
///
/// # Panics
/// When `confidence` is not inside 0..1.
pub fn welch(base: &[f64], new: &[f64], confidence: f64) -> Option<Interval> {
    assert_inside(confidence);
    let (base, new) = (Moments::of(base)?, Moments::of(new)?);
    let (b, n) = (base.variance / base.count, new.variance / new.count);
    let error = (b + n).sqrt();
    if error.partial_cmp(&0.0) != Some(Ordering::Greater) {
        return None;
    }
    let freedom =
        (b + n).powi(2) / (b.powi(2) / (base.count - 1.0) + n.powi(2) / (new.count - 1.0));
    let reach = student_quantile(0.5 + 0.5 * confidence, freedom) * error;
    let d = new.mean - base.mean;
    Some(Interval::new(d - reach, d + reach, IntervalMethod::Welch))
}

/// The interval of the mean of repetitions (Student 1908). `None` below two, when none differs at all,
/// and when one is not finite.
///
/// # Panics
/// When `confidence` is not inside 0..1.
pub fn mean_interval(values: &[f64], confidence: f64) -> Option<Interval> {
    assert_inside(confidence);
    let Moments {
        count,
        mean,
        variance,
    } = Moments::of(values)?;
    let error = (variance / count).sqrt();
    if !error.is_finite() || error <= 0.0 {
        return None;
    }
    let reach = student_quantile(0.5 + 0.5 * confidence, count - 1.0) * error;
    Some(Interval::new(
        mean - reach,
        mean + reach,
        IntervalMethod::Student,
    ))
}

fn assert_inside(confidence: f64) {
    assert!(
        confidence > 0.0 && confidence < 1.0,
        "confidence {confidence} is outside 0..1"
    );
}

struct Moments {
    count: f64,
    mean: f64,
    variance: f64,
}

impl Moments {
    fn of(values: &[f64]) -> Option<Self> {
        let (&[first, ..], true) = (values, values.len() > 1) else {
            return None;
        };
        let count = values.len() as f64;
        // From the first, so that equal values have no variance by rounding.
        let mean = first + values.iter().map(|value| value - first).sum::<f64>() / count;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        Some(Self {
            count,
            mean,
            variance: squares / (count - 1.0),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn none_of_a_sample_is_as_large_as_its_like_is_worth() {
        let like = |of| Share { count: of / 10, of }.estimate(1.0).unwrap();
        let independent = none_of(1000, like(1000), 1000).unwrap();
        assert!(independent.low.abs() < 1e-12);
        // Clopper and Pearson's upper end of none of 1000 is 0.00368.
        assert!(
            (0.003..0.005).contains(&independent.high),
            "{independent:?}"
        );
        // Its like is a thousand of which a hundred are worth something.
        let clustered = none_of(1000, like(100), 1000).unwrap();
        assert!((0.03..0.05).contains(&clustered.high), "{clustered:?}");
        let without = Estimate {
            value: 0.1,
            interval: None,
        };
        assert_eq!(none_of(1000, without, 1000), None);
    }

    #[test]
    fn no_difference_in_a_small_sample_is_no_agreement() {
        let against = |count, of| {
            let published = Share {
                count: 5,
                of: 10_018,
            };
            against_published(published, Share { count, of }, 1.0)
        };
        assert_eq!(against(40, 100_156), Some(Verdict::Agrees));
        assert_eq!(against(2, 5009), Some(Verdict::Agrees));
        assert_eq!(against(0, 420), Some(Verdict::Inconclusive));
        assert_eq!(against(12, 420), Some(Verdict::Differs));
        assert_eq!(against(0, 0), None);
        // What comes in clusters of four is worth a quarter.
        let share = |count, of| Share { count, of };
        let clustered = |scatter| against_published(share(5, 10_018), share(120, 100_156), scatter);
        assert_eq!(clustered(1.0), Some(Verdict::Differs));
        assert_eq!(clustered(4.0), Some(Verdict::Agrees));
    }

    #[test]
    fn parts_of_independent_trials_scatter_as_they_should() {
        let shares = |counts: &[u64]| -> Vec<Share> {
            counts
                .iter()
                .map(|count| Share {
                    count: *count,
                    of: 100,
                })
                .collect()
        };
        // By hand: 10 % of 100 each, off by 3, 3, 0, 0; the variance of each is 9.
        let mixed = Scatter::of(&shares(&[7, 13, 10, 10]));
        close(mixed.ratio().unwrap(), 2.0 / 3.0, 1e-12);
        let together = Scatter::of(&shares(&[0, 20, 0, 20]));
        close(together.ratio().unwrap(), 400.0 / 9.0 / 3.0, 1e-12);
        let both = mixed.and(together).ratio().unwrap();
        close(both, (2.0 + 400.0 / 9.0) / 6.0, 1e-12);
        for none in [&[][..], &[5], &[0, 0], &[100, 100]] {
            assert_eq!(Scatter::of(&shares(none)).ratio(), None, "{none:?}");
        }
    }

    fn close(found: f64, expected: f64, tolerance: f64) {
        assert!(
            (found - expected).abs() <= tolerance,
            "{found} is not {expected}"
        );
    }

    #[test]
    fn differences_of_shares_are_those_newcombe_published() {
        // Newcombe 1998 (Statistics in Medicine 17, 873), table II, method 10.
        for ((k1, n1), (k2, n2), low, high) in [
            ((56, 70), (48, 80), 0.0524, 0.3339),
            ((9, 10), (3, 10), 0.1705, 0.8090),
            ((10, 10), (0, 20), 0.6791, 1.0000),
        ] {
            let found = difference(score(k2, n2), score(k1, n1)).unwrap();
            close(found.low, low, 6e-5);
            close(found.high, high, 6e-5);
        }
        assert_eq!(Share { count: 0, of: 0 }.estimate(1.0), None);
    }

    /// A share with its score interval (Wilson 1927).
    fn score(count: u64, of: u64) -> Estimate {
        let (n, z) = (of as f64, normal_quantile(0.975));
        let value = count as f64 / n;
        let (centre, scale) = (value + z * z / (2.0 * n), 1.0 + z * z / n);
        let spread = z * (value * (1.0 - value) / n + z * z / (4.0 * n * n)).sqrt();
        let [low, high] = [centre - spread, centre + spread].map(|end| end / scale);
        Estimate {
            value,
            interval: Some(Interval::new(low, high, IntervalMethod::Exact)),
        }
    }

    #[test]
    fn repetitions_are_compared_by_their_own_spread() {
        // Means 12 and 10, variances 1 and 1, three each: error 0.8165, t of 4 is 2.776.
        let found = welch(&[9.0, 10.0, 11.0], &[11.0, 12.0, 13.0], 0.95).unwrap();
        close(found.low, 2.0 - 2.267, 2e-3);
        close(found.high, 2.0 + 2.267, 2e-3);
        assert_eq!(welch(&[1.0], &[1.0, 2.0], 0.95), None);
        assert_eq!(welch(&[1.0, 1.0], &[1.0, 1.0], 0.95), None);
    }

    #[test]
    fn a_mean_of_repetitions_has_students_interval() {
        // Mean 10, variance 1, three: error 0.57735, t of 2 is 4.30265.
        let found = mean_interval(&[9.0, 10.0, 11.0], 0.95).unwrap();
        close(found.low, 10.0 - 2.4841, 1e-3);
        close(found.high, 10.0 + 2.4841, 1e-3);
        // Mean 3, two that are 2 apart: error 1, t of 1 is 12.7062.
        let found = mean_interval(&[2.0, 4.0], 0.95).unwrap();
        close(found.low, 3.0 - 12.7062, 1e-3);
        close(found.high, 3.0 + 12.7062, 1e-3);
        for values in [
            vec![],
            vec![1.0],
            vec![0.1, 0.1, 0.1],
            vec![1.0, f64::NEG_INFINITY],
            vec![1.0, f64::NAN],
        ] {
            assert_eq!(mean_interval(&values, 0.95), None, "{values:?}");
        }
    }

    #[test]
    fn a_ratio_has_the_interval_of_the_difference_of_logarithms() {
        let of = |value: f64, reach: f64| Estimate {
            value,
            interval: Some(Interval::new(
                value / reach,
                value * reach,
                IntervalMethod::EffectiveRanks,
            )),
        };
        let found = ratio(of(10.0, 1.1), of(20.0, 1.1)).unwrap();
        let reach = (2.0_f64.sqrt() * 1.1_f64.ln()).exp();
        close(found.low, 2.0 / reach, 1e-9);
        close(found.high, 2.0 * reach, 1e-9);
        let without = Estimate {
            value: 1.0,
            interval: None,
        };
        assert_eq!(ratio(without, of(10.0, 1.1)), None);
    }
}
