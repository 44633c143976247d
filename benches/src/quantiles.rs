//! Quantiles of nanosecond samples and ratios paired by round. Exact: samples are sorted, not
//! binned.

use serde_json::{Value, json};

/// Quantiles of a set of samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Quantiles {
    /// Samples.
    pub count: usize,
    /// Median, nanoseconds.
    pub p50_ns: u64,
    /// 99 of 100 samples are at most this, nanoseconds.
    pub p99_ns: u64,
    /// 999 of 1000 samples are at most this, nanoseconds.
    pub p99_9_ns: u64,
    /// Largest, nanoseconds.
    pub max_ns: u64,
}

impl Quantiles {
    /// The quantiles of `samples`, which it sorts; `None` without samples.
    pub fn of(samples: &mut [u64]) -> Option<Self> {
        samples.sort_unstable();
        let max_ns = *samples.last()?;
        let at = |per_mille: usize| samples[(samples.len() * per_mille).div_ceil(1000) - 1];
        Some(Self {
            count: samples.len(),
            p50_ns: at(500),
            p99_ns: at(990),
            p99_9_ns: at(999),
            max_ns,
        })
    }

    /// The four figures with their names.
    pub fn to_json(&self) -> Value {
        json!({
            "samples": self.count,
            "p50_ns": self.p50_ns,
            "p99_ns": self.p99_ns,
            "p99_9_ns": self.p99_9_ns,
            "max_ns": self.max_ns,
        })
    }
}

/// How one case compares with another, round by round.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairedRatio {
    /// Median of the rounds' ratios.
    pub median: f64,
    /// A quarter of the rounds lies below.
    pub lower_quartile: f64,
    /// A quarter of the rounds lies above.
    pub upper_quartile: f64,
}

impl PairedRatio {
    /// Ratios of pairs of one round each; `None` without rounds.
    pub fn of(pairs: impl Iterator<Item = (u64, u64)>) -> Option<Self> {
        let mut ratios: Vec<f64> = pairs
            .filter(|(_, reference)| *reference > 0)
            .map(|(value, reference)| value as f64 / reference as f64)
            .collect();
        ratios.sort_unstable_by(f64::total_cmp);
        let at = |quarter: usize| ratios[((ratios.len() * quarter).div_ceil(4)).max(1) - 1];
        (!ratios.is_empty()).then(|| Self {
            median: at(2),
            lower_quartile: at(1),
            upper_quartile: at(3),
        })
    }

    /// The three figures with their names.
    pub fn to_json(&self) -> Value {
        json!({
            "median": self.median,
            "lower_quartile": self.lower_quartile,
            "upper_quartile": self.upper_quartile,
        })
    }
}

/// The median of independent figures with its 95 % interval by order statistics: whatever their
/// distribution, the true median lies outside with at most that probability.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MedianInterval {
    /// Median of the figures.
    pub median: f64,
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

impl MedianInterval {
    /// Largest probability on either side of the interval.
    const TAIL: f64 = 0.025;

    /// `None` with fewer than six figures: not even the smallest and the largest make an interval
    /// of 95 %.
    pub fn of(mut figures: Vec<f64>) -> Option<Self> {
        figures.sort_unstable_by(f64::total_cmp);
        let count = figures.len();
        // Terms of a binomial distribution of one half; the first `left_out` lie below the interval.
        let mut term = 0.5_f64.powi(i32::try_from(count).ok()?);
        let (mut sum, mut left_out) = (0.0, 0_usize);
        while left_out < count && sum + term <= Self::TAIL {
            sum += term;
            term *= (count - left_out) as f64 / (left_out + 1) as f64;
            left_out += 1;
        }
        let first = left_out.checked_sub(1)?;
        Some(Self {
            median: f64::midpoint(figures[(count - 1) / 2], figures[count / 2]),
            low: figures[first],
            high: figures[count - 1 - first],
        })
    }
}

/// The middle of a few figures; `None` without any.
pub(crate) fn median(mut values: Vec<u64>) -> Option<u64> {
    values.sort_unstable();
    values
        .get(values.len().div_ceil(2).checked_sub(1)?)
        .copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_of_a_thousand_are_exact() {
        let mut samples: Vec<u64> = (1..=1000).rev().collect();
        let quantiles = Quantiles::of(&mut samples).unwrap();
        assert_eq!((quantiles.p50_ns, quantiles.p99_ns), (500, 990));
        assert_eq!((quantiles.p99_9_ns, quantiles.max_ns), (999, 1000));
    }

    #[test]
    fn one_sample_is_every_quantile_and_none_is_none() {
        let quantiles = Quantiles::of(&mut [7]).unwrap();
        assert_eq!((quantiles.p50_ns, quantiles.p99_9_ns), (7, 7));
        assert_eq!(Quantiles::of(&mut []), None);
        assert_eq!(median(Vec::new()), None);
    }

    #[test]
    fn the_interval_of_a_median_is_that_of_the_tables() {
        // Ranks 2 and 9 of 10, 6 and 15 of 20, 10 and 21 of 30: Conover, Practical Nonparametric
        // Statistics, table A3.
        for (count, low, high) in [(10, 2.0, 9.0), (20, 6.0, 15.0), (30, 10.0, 21.0)] {
            let interval = MedianInterval::of((1..=count).rev().map(f64::from).collect()).unwrap();
            let found = (interval.low, interval.median, interval.high);
            assert_eq!(found, (low, f64::midpoint(low, high), high), "{count}");
        }
        assert_eq!(MedianInterval::of(vec![1.0; 5]), None);
        assert!(MedianInterval::of(vec![1.0; 6]).is_some());
    }

    #[test]
    fn ratios_pair_the_rounds() {
        let pairs = [(110, 100), (240, 200), (100, 100), (130, 100)];
        let ratio = PairedRatio::of(pairs.into_iter()).unwrap();
        assert!((ratio.median - 1.1).abs() < 1e-9);
        assert!((ratio.lower_quartile - 1.0).abs() < 1e-9);
        assert!((ratio.upper_quartile - 1.2).abs() < 1e-9);
        assert_eq!(PairedRatio::of(core::iter::empty()), None);
    }
}
