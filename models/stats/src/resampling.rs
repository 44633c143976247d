//! Resampling of blocks of successive samples, for intervals of quantiles. Which intervals a report shows
//! is decided elsewhere; see [`super::statistics::block_bootstrap_quantile`].

use core::ops::Range;

use super::samples::Samples;
use super::special::ceil_count;
use super::statistics::{BLOCK_COUNT_MIN, IntervalNs, RESAMPLE_COUNT};
use hil_core::random::RandomStream;

/// Samples in sorted blocks, ready to be resampled; see [`super::statistics::block_bootstrap_quantile`].
#[derive(Debug)]
pub struct BlockResampling {
    /// Block after block.
    sorted: Samples,
    length: usize,
    block_count: usize,
    /// Values in ascending order, at most [`PIVOT_COUNT`] of them.
    pivots: Vec<i64>,
    /// By pivot, then by block: samples of the block that do not exceed the pivot.
    reached: Vec<u32>,
}

/// Values for which the samples below are counted once, whatever is drawn then.
const PIVOT_COUNT: usize = 256;

impl BlockResampling {
    /// `None` below 100 samples.
    ///
    /// # Panics
    /// When a block has 2^32 samples.
    pub fn of(samples: &Samples) -> Option<Self> {
        let length = samples.len().isqrt();
        if length < BLOCK_COUNT_MIN {
            return None;
        }
        let block_count = samples.len() / length;
        let mut sorted = samples.clone();
        for block in 0..block_count {
            sorted.sort_between(block * length, (block + 1) * length);
        }
        let mut resampling = Self {
            sorted,
            length,
            block_count,
            pivots: Vec::new(),
            reached: Vec::new(),
        };
        resampling.pivots = resampling.pivots();
        for pivot in &resampling.pivots {
            for block in 0..block_count {
                let reached = resampling.reach(block, *pivot, 0..length);
                let reached = u32::try_from(reached).expect("a block has fewer samples");
                resampling.reached.push(reached);
            }
        }
        Some(resampling)
    }

    /// Some of the samples, the largest of all among them.
    fn pivots(&self) -> Vec<i64> {
        let count = self.block_count * self.length;
        let step = (count / (16 * PIVOT_COUNT)).max(1);
        let mut some: Vec<i64> = (0..count)
            .step_by(step)
            .map(|place| self.sorted.at(place))
            .collect();
        some.sort_unstable();
        let apart = some.len().div_ceil(PIVOT_COUNT - 1);
        let mut pivots: Vec<i64> = some.into_iter().step_by(apart).collect();
        let tops = (1..=self.block_count).map(|block| self.sorted.at(block * self.length - 1));
        pivots.extend(tops.max());
        pivots.dedup();
        pivots
    }

    /// Samples of `block` that do not exceed `value`, which are at least and at most so many.
    fn reach(&self, block: usize, value: i64, places: Range<usize>) -> usize {
        let (mut low, mut high) = (places.start, places.end);
        let start = block * self.length;
        while low < high {
            let middle = usize::midpoint(low, high);
            if self.sorted.at(start + middle) <= value {
                low = middle + 1;
            } else {
                high = middle;
            }
        }
        low
    }

    /// The interval of a quantile.
    pub fn interval(
        &self,
        quantile: f64,
        confidence: f64,
        random: &mut RandomStream,
    ) -> IntervalNs {
        let wanted = ceil_count(quantile * (self.block_count * self.length) as f64).max(1);
        let mut drawn = vec![0; self.block_count];
        let mut estimates: Vec<i64> = (0..RESAMPLE_COUNT)
            .map(|_| {
                drawn.fill_with(|| index_below(self.block_count, random));
                self.rank_of_union(&drawn, wanted)
            })
            .collect();
        estimates.sort_unstable();
        let tail = 0.5 * (1.0 - confidence);
        let low = ceil_count(tail * RESAMPLE_COUNT as f64).min(RESAMPLE_COUNT) - 1;
        IntervalNs {
            low_ns: estimates[low],
            high_ns: estimates[RESAMPLE_COUNT - 1 - low],
        }
    }

    /// The `wanted`-th smallest value (1-based) of the union of the drawn blocks: the smallest value
    /// that at least so many samples do not exceed. Counting inside sorted blocks is far cheaper than
    /// sorting each resample.
    fn rank_of_union(&self, drawn: &[usize], wanted: usize) -> i64 {
        let row = |pivot: usize| &self.reached[pivot * self.block_count..][..self.block_count];
        let (mut low, mut high) = (0, self.pivots.len() - 1);
        while low < high {
            let middle = usize::midpoint(low, high);
            let row = row(middle);
            let count: usize = drawn.iter().map(|block| row[*block] as usize).sum();
            if count < wanted {
                low = middle + 1;
            } else {
                high = middle;
            }
        }
        // What is wanted does not exceed this pivot, and exceeds the one before.
        let above = low.checked_sub(1);
        let range = |block: usize| {
            let least = above.map_or(0, |above| row(above)[block] as usize);
            least..row(low)[block] as usize
        };
        let reaches = |value: i64| {
            let each = drawn.iter();
            let count: usize = each
                .map(|block| self.reach(*block, value, range(*block)))
                .sum();
            count >= wanted
        };
        let least = above.map_or_else(|| self.least(), |above| self.pivots[above]);
        let (mut low_ns, mut high_ns) = (least, self.pivots[low]);
        while low_ns < high_ns {
            let middle = (i128::from(low_ns) + i128::from(high_ns)).div_euclid(2);
            let middle = i64::try_from(middle).expect("it lies between two of them");
            if reaches(middle) {
                high_ns = middle;
            } else {
                low_ns = middle + 1;
            }
        }
        low_ns
    }

    /// The smallest sample.
    fn least(&self) -> i64 {
        let lowest = (0..self.block_count).map(|block| self.sorted.at(block * self.length));
        lowest.min().unwrap_or(0)
    }
}

/// A uniform index below `count`, by the multiplication of Lemire (2019); its bias is below
/// `count / 2^64`.
fn index_below(count: usize, random: &mut RandomStream) -> usize {
    let product = u128::from(random.next_u64()) * count as u128;
    usize::try_from(product >> 64).expect("the high half lies below count")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each resample sorted whole.
    fn plain(samples: &[i64], quantile: f64, random: &mut RandomStream) -> IntervalNs {
        let length = samples.len().isqrt();
        let blocks: Vec<&[i64]> = samples.chunks_exact(length).collect();
        let wanted = ceil_count(quantile * (blocks.len() * length) as f64).max(1);
        let mut estimates: Vec<i64> = (0..RESAMPLE_COUNT)
            .map(|_| {
                let drawn = (0..blocks.len()).map(|_| blocks[index_below(blocks.len(), random)]);
                let mut union: Vec<i64> = drawn.flatten().copied().collect();
                union.sort_unstable();
                union[wanted - 1]
            })
            .collect();
        estimates.sort_unstable();
        let low = ceil_count(0.5 * (1.0 - 0.95) * RESAMPLE_COUNT as f64) - 1;
        IntervalNs {
            low_ns: estimates[low],
            high_ns: estimates[RESAMPLE_COUNT - 1 - low],
        }
    }

    #[test]
    #[allow(clippy::cast_possible_truncation, reason = "small numbers")]
    fn counting_in_blocks_gives_what_sorting_each_resample_does() {
        let mut random = RandomStream::new(3, "measure.resampling");
        let all_but_one = |odd: i64| (0..150).map(move |index| if index == 70 { odd } else { 4 });
        let runs: Vec<Vec<i64>> = vec![
            (0..5_000).map(|_| (random.normal() * 1e5) as i64).collect(),
            (0..1_003)
                .map(|_| (random.uniform() * 3.0) as i64)
                .collect(),
            all_but_one(i64::MAX).collect(),
            all_but_one(i64::MIN).collect(),
            (0..100).collect(),
        ];
        for samples in &runs {
            let near: Samples = samples.iter().copied().collect();
            let resampling = BlockResampling::of(&near).unwrap();
            for quantile in [0.01, 0.5, 0.99, 0.999] {
                let mut streams = [0; 2].map(|_| RandomStream::new(11, "measure.resampling"));
                let found = resampling.interval(quantile, 0.95, &mut streams[0]);
                let expected = plain(samples, quantile, &mut streams[1]);
                assert_eq!(found, expected, "{quantile} of {} samples", samples.len());
            }
        }
    }
}
