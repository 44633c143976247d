//! Tests of a fitted model: Pearson's chi-square on counts, Kolmogorov and Smirnov's distance on
//! values. They say what speaks against a model, never that it is true.

use serde::{Deserialize, Serialize};
use statrs::distribution::{ChiSquared, ContinuousCDF};

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

impl ChiSquare {
    /// Of classes with their observed and expected counts, by a model that `fitted_count` numbers
    /// were fitted for. `None` when too few classes are left for a test.
    pub fn of(classes: &[(f64, f64)], fitted_count: usize) -> Option<Self> {
        let degrees = classes.len().checked_sub(1 + fitted_count)?;
        if degrees == 0 {
            return None;
        }
        let terms = classes.iter().map(|(observed, expected)| {
            (observed - expected).powi(2) / expected.max(f64::MIN_POSITIVE)
        });
        let statistic: f64 = terms.sum();
        let probability = ChiSquared::new(degrees as f64).map_or(f64::NAN, |law| law.sf(statistic));
        Some(Self {
            statistic,
            degrees: u32::try_from(degrees).unwrap_or(u32::MAX),
            probability: probability.clamp(0.0, 1.0),
        })
    }
}

/// Largest difference between the distribution of `ascending` and `distribution`.
pub fn ks_distance(ascending: &[f64], distribution: impl Fn(f64) -> f64) -> f64 {
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
