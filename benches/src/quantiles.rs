//! Quantiles of nanosecond samples and ratios paired by round. Exact: samples are sorted, not
//! binned.

use hil_core::random::RandomStream;
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

/// The typical ratio of rounds that are independent of each other: the mean of their logarithms without
/// the fifth at either end, with a 95 % bootstrap interval over the rounds. A round that was disturbed
/// has little weight, and all others count, so that it takes fewer rounds than the median does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TypicalRatio {
    /// The ratio.
    pub ratio: f64,
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

impl TypicalRatio {
    /// Rounds without which nothing is said of the others' spread.
    const ROUNDS_MIN: usize = 6;
    /// Sets of rounds that are drawn.
    const DRAWN_COUNT: usize = 10_000;
    const SEED: u64 = 17;
    /// What is left out at either end: one of so many.
    const TRIMMED_PART: usize = 5;

    /// `None` with too few rounds, or a ratio that is no number above 0.
    pub fn of(ratios: &[f64]) -> Option<Self> {
        let logs: Vec<f64> = ratios.iter().map(|ratio| ratio.ln()).collect();
        if logs.len() < Self::ROUNDS_MIN || logs.iter().any(|log| !log.is_finite()) {
            return None;
        }
        let mut random = RandomStream::new(Self::SEED, "bootstrap");
        let mut drawn = Vec::with_capacity(logs.len());
        let mut means: Vec<f64> = (0..Self::DRAWN_COUNT)
            .map(|_| {
                drawn.clear();
                drawn.extend((0..logs.len()).map(|_| logs[draw(&mut random, logs.len())]));
                Self::trimmed_mean(&mut drawn)
            })
            .collect();
        means.sort_unstable_by(f64::total_cmp);
        let at = |per_mille: usize| means[(means.len() * per_mille).div_ceil(1000) - 1].exp();
        Some(Self {
            ratio: Self::trimmed_mean(&mut logs.clone()).exp(),
            low: at(25),
            high: at(975),
        })
    }

    fn trimmed_mean(logs: &mut [f64]) -> f64 {
        logs.sort_unstable_by(f64::total_cmp);
        let out = logs.len() / Self::TRIMMED_PART;
        let kept = &logs[out..logs.len() - out];
        kept.iter().sum::<f64>() / kept.len() as f64
    }
}

/// One of `count`, by lot.
fn draw(lots: &mut RandomStream, count: usize) -> usize {
    usize::try_from(lots.next_u64() % count as u64).unwrap_or(0)
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
    fn the_interval_holds_what_is_true_about_as_often_as_it_says() {
        let mut lots = RandomStream::new(5, "rounds");
        let mut unit = || lots.next_u64() as f64 / u64::MAX as f64;
        let (mut held, mut widths) = (0, 0.0);
        for _ in 0..20 {
            // Ratios about 1.1, spread by some 20 %, one of ten far off.
            let mut round = || {
                let spread = unit() + unit() + unit() - 1.5;
                let is_off = unit() < 0.1;
                1.1 * (0.4 * spread).exp()
                    * if is_off {
                        8.0_f64.powf(2.0 * unit() - 1.0)
                    } else {
                        1.0
                    }
            };
            let ratios: Vec<f64> = (0..40).map(|_| round()).collect();
            let found = TypicalRatio::of(&ratios).unwrap();
            held += usize::from((found.low..=found.high).contains(&1.1));
            widths += (found.high / found.low).ln() / 20.0;
        }
        assert!((16..=20).contains(&held), "seed 5: {held} of 20");
        assert!(widths < 0.3, "{widths}");
    }

    #[test]
    fn a_typical_ratio_needs_rounds_and_is_the_same_each_time() {
        let ratios = [1.0, 1.1, 0.9, 1.05, 0.95, 50.0];
        let found = TypicalRatio::of(&ratios).unwrap();
        // Without the smallest and the largest.
        let expected = (1.0_f64 * 1.1 * 1.05 * 0.95).powf(0.25);
        assert!((found.ratio - expected).abs() < 1e-9);
        assert_eq!(TypicalRatio::of(&ratios), Some(found));
        assert_eq!(TypicalRatio::of(&ratios[..5]), None);
        assert_eq!(TypicalRatio::of(&[1.0, 1.0, 1.0, 1.0, 1.0, 0.0]), None);
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
