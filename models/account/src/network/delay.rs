//! One-way delay of the network and how it varies, each with how far the clocks may have led it
//! astray. A variation needs less of them than the delay itself: a constant error of their alignment
//! drops out of it, and what their rates may differ by is left.

use serde::{Deserialize, Serialize};

use super::{Metric, Passage, Passages, is_arrived};
use crate::ChannelPath;
use hil_core::interval::Spread;
use hil_core::time::RemoteInstant;
use hil_stats::dependence::Quantiles;
use hil_stats::histogram::{DurationBin, LatencyHistogram};
use hil_stats::in_order::in_order;
use hil_stats::samples::Samples;

/// A quantile of the delay with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DelayQuantile {
    /// The smallest delay that at least this share of messages did not exceed.
    pub value_ns: i64,
    /// In nanoseconds, or why there is none; `None` when no delay differs. The error of the clocks'
    /// alignment is not in it.
    pub interval: Option<Spread>,
}

/// One-way delay, handed to the kernel until received by the other gateway (RFC 7679), of the
/// messages that arrived.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DelayMetrics {
    /// Messages.
    pub count: u64,
    /// Smallest.
    pub min_ns: i64,
    /// Median.
    pub p50: DelayQuantile,
    /// 95th percentile.
    pub p95: DelayQuantile,
    /// 99th percentile.
    pub p99: DelayQuantile,
    /// 99.9th percentile.
    pub p999: DelayQuantile,
    /// Largest.
    pub max_ns: i64,
    /// Largest error of any of these from the alignment of the two clocks; 0 on one clock.
    pub alignment_bound_ns: u64,
    /// True when that bound is wider than the median: the figure says little more than the bound,
    /// and the round trip is what is known.
    pub is_bound_wider: bool,
    /// Relative to the smallest delay.
    pub variation: DelayVariation,
}

/// Packet delay variation: delay minus the smallest delay of the run (RFC 5481, section 4.2).
///
/// Its bound is the smaller one of two. Each delay is off by at most its own bound, so the
/// difference of two is off by at most twice the largest one: this holds whatever the clocks did. And on
/// one stretch between noticed steps a constant error of the alignment cancels: what is left is how far
/// the estimated offset moved during the run, and how far the true one may have, by the drift allowance
/// over the time from the first to the last message. The second one takes for granted that no clock
/// was stepped unnoticed. The stamps, of the gateways themselves, are taken as exact.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct DelayVariation {
    /// Median.
    pub p50_ns: i64,
    /// 95th percentile.
    pub p95_ns: i64,
    /// 99th percentile.
    pub p99_ns: i64,
    /// 99.9th percentile.
    pub p999_ns: i64,
    /// Largest.
    pub max_ns: i64,
    /// Largest error of any of these from the two clocks; 0 on one clock.
    pub bound_ns: u64,
    /// True when that bound is wider than the median.
    pub is_bound_wider: bool,
}

/// Difference of the delays of two messages with successive numbers, both of which arrived
/// (inter-packet delay variation: RFC 3393; RFC 5481, section 4.1), as magnitudes. Each interval
/// is taken on one clock, so that nothing but the clocks' difference in rate over one interval is
/// in it. Pairs with a noticed step of a clock between them are left out.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SuccessiveVariation {
    /// Pairs.
    pub count: u64,
    /// Median magnitude.
    pub p50_ns: i64,
    /// 99th percentile of the magnitude.
    pub p99_ns: i64,
    /// Largest magnitude.
    pub max_ns: i64,
    /// Largest error of any of these: what the clocks' rates may differ by, over the longest time
    /// between the messages of a pair; 0 on one clock.
    pub bound_ns: u64,
    /// True when that bound is wider than the median.
    pub is_bound_wider: bool,
    /// Smoothed over messages in the order they came.
    pub jitter: InterarrivalJitter,
}

/// Interarrival jitter, `J += (|D| - J) / 16` (RFC 3550, section 6.4.1).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct InterarrivalJitter {
    /// Mean of J over the run.
    pub mean_ns: f64,
    /// Largest J.
    pub max_ns: f64,
    /// Largest error of both: the bounds of the differences, smoothed as they are. 0 on one clock.
    pub bound_ns: f64,
}

pub(super) fn delays(passages: &Passages, path: ChannelPath<'_>) -> Metric<DelayMetrics> {
    let arrived = || passages.each().filter(is_arrived);
    let delays_ns: Samples = arrived().filter_map(|one| one.delay_ns).collect();
    let Some(last) = delays_ns.len().checked_sub(1) else {
        let reason = if arrived().next().is_none() {
            "no message is known to have arrived"
        } else if arrived().all(|one| one.received_ns.is_none()) {
            "the receiving gateway's records are not at hand"
        } else {
            "clocks not aligned"
        };
        return Metric::unavailable(reason);
    };
    let ascending = delays_ns.ascending();
    let (min_ns, max_ns) = (ascending.at(0), ascending.at(last));
    let quantiles = Quantiles::of(&delays_ns, &ascending);
    let [p50, p95, p99, p999] = [0.5, 0.95, 0.99, 0.999].map(|share| DelayQuantile {
        value_ns: ascending.at_share(share),
        interval: quantiles.interval(share),
    });
    let alignment_bound_ns = arrived().map(|one| one.delay_bound_ns).max().unwrap_or(0);
    let above_min = |ns: i64| ns.saturating_sub(min_ns);
    let bound_ns = variation_bound_ns(arrived(), path, alignment_bound_ns);
    Metric::Measured(DelayMetrics {
        count: ascending.len() as u64,
        min_ns,
        p50,
        p95,
        p99,
        p999,
        max_ns,
        alignment_bound_ns,
        is_bound_wider: exceeds(alignment_bound_ns, p50.value_ns),
        variation: DelayVariation {
            p50_ns: above_min(p50.value_ns),
            p95_ns: above_min(p95.value_ns),
            p99_ns: above_min(p99.value_ns),
            p999_ns: above_min(p999.value_ns),
            max_ns: above_min(max_ns),
            bound_ns,
            is_bound_wider: exceeds(bound_ns, above_min(p50.value_ns)),
        },
    })
}

/// The delays of the messages that arrived, as a histogram.
pub(super) fn delay_bins(passages: &Passages) -> Vec<DurationBin> {
    let mut histogram = LatencyHistogram::default();
    let arrived = passages.each().filter(is_arrived);
    for delay_ns in arrived.filter_map(|one| one.delay_ns) {
        histogram.record(delay_ns);
    }
    histogram.bins()
}

/// True when a figure says less than its bound.
pub(super) fn exceeds(bound_ns: u64, figure_ns: i64) -> bool {
    i128::from(bound_ns) > i128::from(figure_ns)
}

/// See [`DelayVariation`]. All errors of delays lie in an interval as wide as this, so that the
/// difference of any two of their quantiles is off by no more.
fn variation_bound_ns(
    arrived: impl Iterator<Item = Passage>,
    path: ChannelPath<'_>,
    alignment_bound_ns: u64,
) -> u64 {
    let twice_ns = alignment_bound_ns.saturating_mul(2);
    let mut sent_ns: Option<(i64, i64)> = None;
    let mut offset_ns: Option<(i64, i64)> = None;
    let widen = |ends: &mut Option<(i64, i64)>, ns: i64| {
        let (low, high) = ends.unwrap_or((ns, ns));
        *ends = Some((low.min(ns), high.max(ns)));
    };
    for one in arrived {
        let stamps = one.offered_ns.zip(one.received_ns);
        let Some(((offered_ns, received_ns), delay_ns)) = stamps.zip(one.delay_ns) else {
            continue;
        };
        widen(&mut sent_ns, offered_ns);
        // What was added to bring the one stamp to the other's clock.
        let raw_ns = received_ns.saturating_sub(offered_ns);
        widen(&mut offset_ns, raw_ns.saturating_sub(delay_ns));
    }
    let (Some((first_ns, last_ns)), Some((low_ns, high_ns))) = (sent_ns, offset_ns) else {
        return twice_ns;
    };
    let [first, last] = [first_ns, last_ns].map(RemoteInstant::from_ns);
    let drift_ns = path.drift_ns(first, last);
    let moved_ns = high_ns.abs_diff(low_ns);
    drift_ns.map_or(twice_ns, |drift_ns| {
        twice_ns.min(drift_ns.saturating_add(moved_ns))
    })
}

pub(super) fn successive(
    passages: &Passages,
    path: ChannelPath<'_>,
) -> Metric<SuccessiveVariation> {
    let mut magnitudes = Samples::default();
    let mut bound_ns = 0;
    let mut last: Option<Passage> = None;
    for after in passages.each() {
        let Some(before) = last.replace(after) else {
            continue;
        };
        let follows = !after.begins_epoch_after(&before)
            && before.sequence.checked_add(1) == Some(after.sequence);
        if !follows {
            continue;
        }
        if let Some(one) = difference(&Ends::of(&before), &Ends::of(&after), path) {
            magnitudes.push(one.magnitude_ns);
            bound_ns = bound_ns.max(one.bound_ns);
        }
    }
    magnitudes.sort();
    let Some(last) = magnitudes.len().checked_sub(1) else {
        return Metric::unavailable("no two successive messages arrived");
    };
    let p50_ns = magnitudes.at_share(0.5);
    Metric::Measured(SuccessiveVariation {
        count: magnitudes.len() as u64,
        p50_ns,
        p99_ns: magnitudes.at_share(0.99),
        max_ns: magnitudes.at(last),
        bound_ns,
        is_bound_wider: exceeds(bound_ns, p50_ns),
        jitter: jitter(passages, path),
    })
}

/// By how much two delays differ, and how far that may be off.
struct Difference {
    magnitude_ns: i64,
    bound_ns: u64,
}

/// When a message was handed over and received.
#[derive(Debug, Clone, Copy)]
struct Ends {
    offered_ns: Option<i64>,
    received_ns: Option<i64>,
}

impl Ends {
    const fn of(one: &Passage) -> Self {
        Self {
            offered_ns: one.offered_ns,
            received_ns: one.received_ns,
        }
    }
}

/// `None` when one of the messages did not arrive, or a clock was stepped between them.
fn difference(before: &Ends, after: &Ends, path: ChannelPath<'_>) -> Option<Difference> {
    let between = |from: Option<i64>, to: Option<i64>| Some(to?.saturating_sub(from?));
    let received_ns = between(before.received_ns, after.received_ns)?;
    let sent_ns = between(before.offered_ns, after.offered_ns)?;
    let instant = |one: &Ends| one.offered_ns.map(RemoteInstant::from_ns);
    Some(Difference {
        magnitude_ns: received_ns.saturating_sub(sent_ns).saturating_abs(),
        bound_ns: path.drift_ns(instant(before)?, instant(after)?)?,
    })
}

fn jitter(passages: &Passages, path: ChannelPath<'_>) -> InterarrivalJitter {
    let read = || {
        passages.each().filter_map(|one| {
            one.offered_ns?;
            Some((one.received_ns?, Ends::of(&one)))
        })
    };
    let mut last: Option<Ends> = None;
    let (mut jitter_ns, mut sum, mut max_ns) = (0.0_f64, 0.0, 0.0_f64);
    let (mut error_ns, mut bound_ns) = (0.0_f64, 0.0_f64);
    let mut count = 0_u64;
    for (_, after) in in_order(read) {
        let Some(before) = last.replace(after) else {
            continue;
        };
        let Some(one) = difference(&before, &after, path) else {
            continue;
        };
        jitter_ns += (one.magnitude_ns as f64 - jitter_ns) / 16.0;
        error_ns += (one.bound_ns as f64 - error_ns) / 16.0;
        count += 1;
        sum += jitter_ns;
        max_ns = max_ns.max(jitter_ns);
        bound_ns = bound_ns.max(error_ns);
    }
    InterarrivalJitter {
        mean_ns: sum / count.max(1) as f64,
        max_ns,
        bound_ns,
    }
}
