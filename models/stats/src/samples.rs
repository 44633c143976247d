//! Exact values of every message of a run, in as little memory as they need. What figures are made of them is decided elsewhere.

use super::histogram::{Distribution, LatencySummary};
use super::special::place_of;

/// Exact values of one kind, in four bytes each while they lie close together.
#[derive(Debug, Clone)]
pub enum Samples {
    /// Above `base`, which lies half the range below the first.
    Near {
        /// What is above it is counted from here.
        base: i64,
        /// Each value less `base`.
        above: Vec<u32>,
    },
    /// As they are.
    Far(Vec<i64>),
}

impl Default for Samples {
    fn default() -> Self {
        Self::Far(Vec::new())
    }
}

impl Samples {
    /// One more.
    pub fn push(&mut self, value: i64) {
        match self {
            Self::Far(values) if values.is_empty() => {
                let base = value.saturating_sub(1 << 31);
                let above = value.saturating_sub(base);
                *self = Self::Near {
                    base,
                    above: vec![u32::try_from(above).unwrap_or(0)],
                };
            }
            Self::Far(values) => values.push(value),
            Self::Near { base, above } => {
                if let Some(Ok(near)) = value.checked_sub(*base).map(u32::try_from) {
                    above.push(near);
                } else {
                    let mut values: Vec<i64> = self.iter().collect();
                    values.push(value);
                    *self = Self::Far(values);
                }
            }
        }
    }

    /// True of none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// How many.
    pub fn len(&self) -> usize {
        match self {
            Self::Near { above, .. } => above.len(),
            Self::Far(values) => values.len(),
        }
    }

    /// In the order they came.
    pub fn iter(&self) -> impl Iterator<Item = i64> + '_ {
        let (base, above, values): (i64, &[u32], &[i64]) = match self {
            Self::Near { base, above } => (*base, above, &[]),
            Self::Far(values) => (0, &[], values),
        };
        let near = above.iter().map(move |above| base + i64::from(*above));
        near.chain(values.iter().copied())
    }

    /// Puts them in ascending order.
    pub fn sort(&mut self) {
        match self {
            Self::Near { above, .. } => above.sort_unstable(),
            Self::Far(values) => values.sort_unstable(),
        }
    }

    /// Sorts those from `from` on and before `until` among themselves.
    pub fn sort_between(&mut self, from: usize, until: usize) {
        match self {
            Self::Near { above, .. } => above[from..until].sort_unstable(),
            Self::Far(values) => values[from..until].sort_unstable(),
        }
    }

    /// In ascending order.
    #[must_use]
    pub fn ascending(&self) -> Self {
        let mut ascending = self.clone();
        ascending.sort();
        ascending
    }

    /// The figures, or none because of `reason`.
    pub fn distribution(&self, reason: &str) -> Distribution {
        LatencySummary::of(self)
            .map_or_else(|| Distribution::unavailable(reason), Distribution::Measured)
    }

    /// Of values in ascending order, the smallest that at least `share` of them do not exceed.
    ///
    /// # Panics
    /// When there are none.
    pub fn at_share(&self, share: f64) -> i64 {
        self.at(place_of(share, self.len()))
    }

    /// Of values in ascending order, how many are smaller than `value`.
    pub fn count_below(&self, value: i64) -> usize {
        match self {
            Self::Near { base, above } => {
                above.partition_point(|above| base + i64::from(*above) < value)
            }
            Self::Far(values) => values.partition_point(|one| *one < value),
        }
    }

    /// The value at this place.
    ///
    /// # Panics
    /// When there is none.
    pub fn at(&self, index: usize) -> i64 {
        match self {
            Self::Near { base, above } => base + i64::from(above[index]),
            Self::Far(values) => values[index],
        }
    }
}

impl Extend<i64> for Samples {
    fn extend<I: IntoIterator<Item = i64>>(&mut self, values: I) {
        for value in values {
            self.push(value);
        }
    }
}

impl FromIterator<i64> for Samples {
    fn from_iter<I: IntoIterator<Item = i64>>(values: I) -> Self {
        let mut samples = Self::default();
        samples.extend(values);
        samples
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_exact_near_and_far() {
        for values in [
            vec![5, 3, 4],
            vec![-7, i64::from(u32::MAX), 12],
            vec![i64::MIN, 4, i64::MAX],
            vec![i64::MAX, i64::MAX - 1],
        ] {
            let mut samples: Samples = values.iter().copied().collect();
            assert_eq!(samples.iter().collect::<Vec<_>>(), values);
            assert_eq!((samples.len(), samples.at(1)), (values.len(), values[1]));
            let mut ascending = values.clone();
            ascending.sort_unstable();
            samples.sort();
            assert_eq!(samples.iter().collect::<Vec<_>>(), ascending);
        }
        let near: Samples = [1_000_000_000_000, 1_000_000_000_001].into_iter().collect();
        assert!(matches!(near, Samples::Near { .. }));
    }
}
