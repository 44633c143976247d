//! A histogram of nanoseconds with three significant digits. Negative values, which only wrong
//! or unaligned clocks produce, are kept and counted apart, never clipped to zero.

use hdrhistogram::Histogram;
use hil_core::recorded_run::DelayBin;
use serde::{Deserialize, Serialize};

use crate::samples::Samples;
use crate::special::ceil_count;

/// Digits a recorded value keeps: a quantile is right within 0.1 %.
const SIGNIFICANT_DIGITS: u8 = 3;

/// Counts of durations. Recording may allocate when a value is larger than any before, so it
/// belongs beside the measured path, not on it.
#[derive(Debug, Clone)]
pub struct LatencyHistogram {
    positive: Histogram<u64>,
    /// Magnitudes below zero; most histograms never need it.
    negative: Option<Histogram<u64>>,
    min_ns: i64,
    max_ns: i64,
    sum_ns: i128,
}

impl Default for LatencyHistogram {
    fn default() -> Self {
        Self {
            positive: empty(),
            negative: None,
            min_ns: i64::MAX,
            max_ns: i64::MIN,
            sum_ns: 0,
        }
    }
}

fn empty() -> Histogram<u64> {
    Histogram::new(SIGNIFICANT_DIGITS).expect("three digits are within 0..=5")
}

impl LatencyHistogram {
    /// An empty one that allocates nothing for values from zero to `max_ns` (at least 2), for a loop
    /// that must not. Larger values are counted as well, and make it allocate.
    #[allow(
        clippy::missing_panics_doc,
        reason = "bounds from 1 to at least 2 and three digits are what the histogram takes"
    )]
    pub fn with_room(max_ns: u64) -> Self {
        let mut positive = Histogram::new_with_max(max_ns.max(2), SIGNIFICANT_DIGITS)
            .expect("three digits and a maximum of at least 2 are valid");
        positive.auto(true);
        Self {
            positive,
            ..Self::default()
        }
    }

    /// Counts one value.
    #[allow(
        clippy::missing_panics_doc,
        reason = "an auto-resizing histogram holds every 64-bit value"
    )]
    pub fn record(&mut self, value_ns: i64) {
        let histogram = if value_ns < 0 {
            self.negative.get_or_insert_with(empty)
        } else {
            &mut self.positive
        };
        histogram
            .record(value_ns.unsigned_abs())
            .expect("an auto-resizing histogram holds every 64-bit value");
        self.min_ns = self.min_ns.min(value_ns);
        self.max_ns = self.max_ns.max(value_ns);
        self.sum_ns += i128::from(value_ns);
    }

    /// Adds every value of `other`.
    #[allow(
        clippy::missing_panics_doc,
        reason = "an auto-resizing histogram holds every 64-bit value"
    )]
    pub fn merge(&mut self, other: &Self) {
        const RESIZES: &str = "an auto-resizing histogram holds every 64-bit value";
        self.positive.add(&other.positive).expect(RESIZES);
        if let Some(negative) = &other.negative {
            let own = self.negative.get_or_insert_with(empty);
            own.add(negative).expect(RESIZES);
        }
        self.min_ns = self.min_ns.min(other.min_ns);
        self.max_ns = self.max_ns.max(other.max_ns);
        self.sum_ns += other.sum_ns;
    }

    /// How many values were recorded.
    pub fn count(&self) -> u64 {
        self.positive.len() + self.negative_count()
    }

    /// How many of them were below zero.
    pub fn negative_count(&self) -> u64 {
        self.negative.as_ref().map_or(0, Histogram::len)
    }

    /// The smallest value that at least `quantile` (0..=1) of all values do not exceed, within
    /// 0.1 %; `None` when empty.
    pub fn quantile(&self, quantile: f64) -> Option<i64> {
        let count = self.count();
        if count == 0 {
            return None;
        }
        let rank = (ceil_count(quantile * count as f64) as u64).clamp(1, count);
        let negative_count = self.negative_count();
        let value = match &self.negative {
            // Ranks count from the most negative, magnitudes from the least.
            Some(negative) if rank <= negative_count => {
                -signed(at_rank(negative, negative_count - rank + 1))
            }
            _ => signed(at_rank(&self.positive, rank - negative_count)),
        };
        Some(value.clamp(self.min_ns, self.max_ns))
    }

    /// The figures a report prints; `None` when empty.
    pub fn summary(&self) -> Option<LatencySummary> {
        Some(LatencySummary {
            count: self.count(),
            negative_count: self.negative_count(),
            min_ns: self.quantile(0.0).map(|_| self.min_ns)?,
            p50_ns: self.quantile(0.5)?,
            p90_ns: self.quantile(0.9)?,
            p99_ns: self.quantile(0.99)?,
            p999_ns: self.quantile(0.999)?,
            max_ns: self.max_ns,
            mean_ns: self.sum_ns as f64 / self.count() as f64,
        })
    }

    /// How often which values occurred, in bins whose upper edges grow by a fixed ratio: the
    /// smallest first, empty bins left out. A value is in the bin of the first edge that is not below
    /// it, within the 0.1 % of the histogram.
    pub fn bins(&self) -> Vec<DurationBin> {
        let mut bins: Vec<DurationBin> = Vec::new();
        let mut count = |until_ns: i64, count: u64| match bins.last_mut() {
            Some(last) if last.until_ns == until_ns => last.count += count,
            _ => bins.push(DurationBin { until_ns, count }),
        };
        // Magnitudes of negative values come smallest first, which are the largest values.
        let negative = self.negative.iter().flat_map(Histogram::iter_recorded);
        let negative: Vec<_> = negative
            .map(|step| (step.value_iterated_to(), step.count_at_value()))
            .collect();
        for (magnitude, times) in negative.into_iter().rev() {
            count(-lower_edge_ns(magnitude.saturating_add(1)), times);
        }
        for step in self.positive.iter_recorded() {
            count(
                upper_edge_ns(step.value_iterated_to()),
                step.count_at_value(),
            );
        }
        bins
    }

    /// The figures, or `reason` when there is nothing to summarise.
    pub fn distribution(&self, reason: &str) -> Distribution {
        self.summary()
            .map_or_else(|| Distribution::unavailable(reason), Distribution::Measured)
    }
}

/// Bins of one decade.
const BINS_PER_DECADE: i32 = 20;

/// One bin of a histogram over durations.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct DurationBin {
    /// Upper edge, included; the lower one is the next smaller step of 20 to a decade.
    pub until_ns: i64,
    /// Values in it.
    pub count: u64,
}

impl From<DurationBin> for DelayBin {
    fn from(bin: DurationBin) -> Self {
        Self {
            above_ns: bin.from_ns(),
            until_ns: bin.until_ns,
            count: bin.count,
        }
    }
}

impl DurationBin {
    /// Where the bin begins, not included: the edge before [`DurationBin::until_ns`].
    pub fn from_ns(&self) -> i64 {
        match self.until_ns {
            ..=0 => -upper_edge_ns(self.until_ns.unsigned_abs().saturating_add(1)),
            1 => 0,
            until_ns => lower_edge_ns(until_ns.unsigned_abs()),
        }
    }
}

/// The edge of this number, counted from 1 ns.
#[allow(
    clippy::cast_possible_truncation,
    reason = "edges are positive and saturate at the largest 64-bit integer"
)]
fn edge_ns(index: i32) -> i64 {
    10_f64
        .powf(f64::from(index) / f64::from(BINS_PER_DECADE))
        .round() as i64
}

/// The smallest edge not below `magnitude`; 0 for 0.
#[allow(clippy::cast_possible_truncation, reason = "at most 386")]
fn upper_edge_ns(magnitude: u64) -> i64 {
    if magnitude == 0 {
        return 0;
    }
    let wanted = signed(magnitude);
    let near = ((magnitude as f64).log10() * f64::from(BINS_PER_DECADE)).floor() as i32;
    (near.saturating_sub(1).max(0)..=near.saturating_add(2))
        .map(edge_ns)
        .find(|edge| *edge >= wanted)
        .unwrap_or(i64::MAX)
}

/// The largest edge below `magnitude`; 0 for 1 and less.
#[allow(clippy::cast_possible_truncation, reason = "at most 386")]
fn lower_edge_ns(magnitude: u64) -> i64 {
    let wanted = signed(magnitude);
    if wanted <= 1 {
        return 0;
    }
    let near = ((magnitude as f64).log10() * f64::from(BINS_PER_DECADE)).ceil() as i32;
    (0..=near.saturating_add(1))
        .rev()
        .map(edge_ns)
        .find(|edge| *edge < wanted)
        .unwrap_or(0)
}

fn signed(magnitude: u64) -> i64 {
    i64::try_from(magnitude).unwrap_or(i64::MAX)
}

fn at_rank(histogram: &Histogram<u64>, rank: u64) -> u64 {
    // Half a rank below, so that rounding cannot reach the next one.
    histogram.value_at_quantile((rank as f64 - 0.5) / histogram.len() as f64)
}

/// The figures of one histogram, or of samples. Minimum and maximum are exact; quantiles are exact
/// of samples, and within 0.1 % of a histogram.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LatencySummary {
    /// Values recorded.
    pub count: u64,
    /// Values below zero among them: a sign of wrong clocks.
    pub negative_count: u64,
    /// Smallest.
    pub min_ns: i64,
    /// Median.
    pub p50_ns: i64,
    /// 90th percentile.
    pub p90_ns: i64,
    /// 99th percentile.
    pub p99_ns: i64,
    /// 99.9th percentile.
    pub p999_ns: i64,
    /// Largest.
    pub max_ns: i64,
    /// Arithmetic mean.
    pub mean_ns: f64,
}

impl LatencySummary {
    /// The exact figures of all of `samples_ns`, in any order; `None` when there are none. Where an
    /// interval is drawn from the samples, its figure must be too: a histogram's may lie beside it.
    pub fn of_samples(samples_ns: &[i64]) -> Option<Self> {
        Self::of(&samples_ns.iter().copied().collect())
    }

    /// As [`Self::of_samples`].
    pub fn of(samples: &Samples) -> Option<Self> {
        let ascending = samples.ascending();
        let count = ascending.len();
        let last = count.checked_sub(1)?;
        let at = |quantile: f64| ascending.at_share(quantile);
        let sum_ns: i128 = ascending.iter().map(i128::from).sum();
        Some(Self {
            count: count as u64,
            negative_count: ascending.iter().take_while(|ns| *ns < 0).count() as u64,
            min_ns: ascending.at(0),
            p50_ns: at(0.5),
            p90_ns: at(0.9),
            p99_ns: at(0.99),
            p999_ns: at(0.999),
            max_ns: ascending.at(last),
            mean_ns: sum_ns as f64 / count as f64,
        })
    }
}

/// Figures, or why there are none.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "state", rename_all = "snake_case")]
pub enum Distribution {
    /// At least one value was measured.
    Measured(LatencySummary),
    /// Nothing could be measured.
    Unavailable {
        /// Why, in words for a report.
        reason: String,
    },
}

impl Distribution {
    /// No figures because of `reason`.
    pub fn unavailable(reason: &str) -> Self {
        Self::Unavailable {
            reason: reason.to_owned(),
        }
    }

    /// The exact figures of `samples_ns`, or none because of `reason`.
    pub fn of_samples(samples_ns: &[i64], reason: &str) -> Self {
        LatencySummary::of_samples(samples_ns)
            .map_or_else(|| Self::unavailable(reason), Self::Measured)
    }

    /// The figures, if any.
    pub const fn measured(&self) -> Option<&LatencySummary> {
        match self {
            Self::Measured(summary) => Some(summary),
            Self::Unavailable { .. } => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn room_changes_no_figure_and_bounds_nothing() {
        let (mut roomy, mut plain) = (
            LatencyHistogram::with_room(1_000_000),
            LatencyHistogram::default(),
        );
        for value_ns in [0, 7, 999_999, 5_000_000_000, -3] {
            roomy.record(value_ns);
            plain.record(value_ns);
        }
        assert_eq!(roomy.summary(), plain.summary());
    }
    use hil_core::random::RandomStream;

    #[test]
    fn quantiles_agree_with_sorting_within_a_thousandth() {
        let mut stream = RandomStream::new(2, "histogram");
        let mut values: Vec<i64> = (0..5_001)
            .map(|_| (stream.next_u64() >> (24 + stream.next_u64() % 30)).cast_signed() - 5_000)
            .collect();
        let mut histogram = LatencyHistogram::default();
        for value in &values {
            histogram.record(*value);
        }
        values.sort_unstable();
        for quantile in [0.001, 0.1, 0.25, 0.5, 0.9, 0.99, 0.999, 1.0] {
            let index = ceil_count(quantile * 5_001.0) - 1;
            let (expected, actual) = (values[index], histogram.quantile(quantile).unwrap());
            let error = (actual - expected).abs() as f64;
            assert!(
                error <= 1e-3 * expected.abs() as f64 + 1.0,
                "{actual} is not {expected}"
            );
        }
        let summary = histogram.summary().unwrap();
        assert_eq!((summary.min_ns, summary.max_ns), (values[0], values[5_000]));
        let exact = LatencySummary::of_samples(&values).unwrap();
        assert_eq!(exact.p50_ns, values[2_500]);
        assert_eq!(exact.p99_ns, values[ceil_count(0.99 * 5_001.0) - 1]);
        assert_eq!(
            (
                exact.count,
                exact.negative_count,
                exact.min_ns,
                exact.max_ns
            ),
            (
                5_001,
                summary.negative_count,
                summary.min_ns,
                summary.max_ns
            )
        );
        assert!((exact.mean_ns - summary.mean_ns).abs() < 1e-6 * exact.mean_ns.abs());
    }

    #[test]
    fn negative_values_are_kept_and_counted_apart() {
        let mut histogram = LatencyHistogram::default();
        for value in [-30, -20, -10, 5, 7] {
            histogram.record(value);
        }
        let summary = histogram.summary().unwrap();
        assert_eq!((summary.count, summary.negative_count), (5, 3));
        assert_eq!(
            (summary.min_ns, summary.p50_ns, summary.max_ns),
            (-30, -10, 7)
        );
        assert!((summary.mean_ns + 9.6).abs() < 1e-9);
    }

    #[test]
    fn an_empty_histogram_is_unavailable_not_zero() {
        let histogram = LatencyHistogram::default();
        assert_eq!(histogram.summary(), None);
        assert_eq!(LatencySummary::of_samples(&[]), None);
        let none = histogram.distribution("no message arrived");
        assert_eq!(none, Distribution::unavailable("no message arrived"));
        assert_eq!(none.measured(), None);
    }

    #[test]
    fn bins_hold_every_value_once_in_ascending_edges() {
        let mut stream = RandomStream::new(3, "bins");
        let mut histogram = LatencyHistogram::default();
        let values: Vec<i64> = (0..2_000)
            .map(|_| (stream.next_u64() >> (30 + stream.next_u64() % 34)).cast_signed() - 40)
            .collect();
        for value in &values {
            histogram.record(*value);
        }
        let bins = histogram.bins();
        assert!(bins.windows(2).all(|two| two[0].until_ns < two[1].until_ns));
        assert!(
            bins.windows(2)
                .all(|two| two[0].until_ns <= two[1].from_ns())
        );
        assert_eq!(bins.iter().map(|bin| bin.count).sum::<u64>(), 2_000);
        for bin in bins {
            // What the histogram rounds may fall on the other side of an edge.
            let slack = |edge: i64| edge.abs() / 900 + 1;
            let (from, until) = (bin.from_ns(), bin.until_ns);
            let at_most = values
                .iter()
                .filter(|value| **value > from - slack(from) && **value <= until + slack(until));
            assert!(at_most.count() as u64 >= bin.count, "{bin:?}");
        }
        assert!(LatencyHistogram::default().bins().is_empty());
    }

    #[test]
    fn the_edges_of_bins_are_powers_of_ten_and_steps_between() {
        assert_eq!(
            [0, 1, 2, 999, 1_000, 1_001].map(upper_edge_ns),
            [0, 1, 2, 1_000, 1_000, 1_122]
        );
        assert_eq!(
            [0, 1, 2, 1_000, 1_001].map(lower_edge_ns),
            [0, 0, 1, 891, 1_000]
        );
        assert_eq!(upper_edge_ns(u64::MAX), i64::MAX);
        let bin = DurationBin {
            until_ns: -1_000,
            count: 1,
        };
        assert_eq!(bin.from_ns(), -1_122);
    }

    #[test]
    fn merging_equals_recording_everything_in_one() {
        let (mut left, mut right, mut both) = Default::default();
        let all = [&mut left, &mut right, &mut both];
        let [left, right, both]: [&mut LatencyHistogram; 3] = all;
        for value in -500_i64..40_000 {
            if value % 3 == 0 {
                &mut *left
            } else {
                &mut *right
            }
            .record(value * 97);
            both.record(value * 97);
        }
        left.merge(right);
        assert_eq!(left.summary(), both.summary());
        left.merge(&LatencyHistogram::default());
        assert_eq!(left.summary(), both.summary());
    }
}
