//! How far values may be off, in figures.

use serde::{Deserialize, Serialize};

use super::samples::Samples;

/// The error bounds of a set of figures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct BoundMetrics {
    /// Half of them are no larger, nanoseconds.
    pub median_ns: u64,
    /// The largest, nanoseconds.
    pub largest_ns: u64,
}

impl BoundMetrics {
    /// Of these bounds; `None` of none.
    pub fn of(mut bounds_ns: Vec<u64>) -> Option<Self> {
        let middle = bounds_ns.len().checked_sub(1)? / 2;
        let largest_ns = bounds_ns.iter().copied().max()?;
        let (_, median_ns, _) = bounds_ns.select_nth_unstable(middle);
        Some(Self {
            median_ns: *median_ns,
            largest_ns,
        })
    }
}

/// How far each of some values may be off, nanoseconds.
#[derive(Debug, Clone, Default)]
pub struct Bounds(Samples);

impl Bounds {
    /// One more.
    pub fn push(&mut self, bound_ns: u64) {
        // Keeps the order of the whole range.
        self.0.push(bound_ns.cast_signed() ^ i64::MIN);
    }

    /// Median and largest; `None` of none.
    pub fn metrics(&self) -> Option<BoundMetrics> {
        let last = self.0.len().checked_sub(1)?;
        let ascending = self.0.ascending();
        let [median_ns, largest_ns] =
            [last / 2, last].map(|place| (ascending.at(place) ^ i64::MIN).cast_unsigned());
        Some(BoundMetrics {
            median_ns,
            largest_ns,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_have_the_figures_of_all_of_them() {
        for bounds_ns in [vec![3, 9, 1, 4], vec![u64::MAX, 0, 7], vec![], vec![5]] {
            let mut bounds = Bounds::default();
            for bound_ns in &bounds_ns {
                bounds.push(*bound_ns);
            }
            assert_eq!(bounds.metrics(), BoundMetrics::of(bounds_ns));
        }
    }
}
