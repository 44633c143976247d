//! One-way delay of the network and how it varies. The variation needs less of the clocks than
//! the delay itself: a constant error of their alignment drops out of it.

use serde::{Deserialize, Serialize};

use super::{Crossing, Figure, Passage};
use crate::measure::special::ceil_count;
use crate::measure::statistics::{CONFIDENCE, IntervalNs, block_bootstrap_quantile};
use crate::random::RandomStream;

/// Fewest samples beyond a quantile for which resampling says anything about it.
const TAIL_COUNT_MIN: f64 = 10.0;

/// True when enough of `count` samples lie beyond the quantile `share`, on its nearer side, for an
/// interval by resampling.
pub(crate) fn has_tail(count: usize, share: f64) -> bool {
    share.min(1.0 - share) * count as f64 >= TAIL_COUNT_MIN
}

/// A quantile of the delay with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct DelayQuantile {
    /// The smallest delay that at least this share of messages did not exceed.
    pub value_ns: i64,
    /// By resampling blocks of successive messages; `None` when fewer than ten messages lie
    /// beyond the quantile. The error of the clocks' alignment is not in it.
    pub interval: Option<IntervalNs>,
}

/// One-way delay, handed to the kernel until received by the other gateway (RFC 7679), of the
/// messages that arrived.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct DelayFigures {
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
}

/// Difference of the delays of two messages with successive numbers, both of which arrived
/// (inter-packet delay variation: RFC 3393; RFC 5481, section 4.1), as magnitudes. Each interval
/// is taken on one clock, so that nothing but the clocks' difference in rate over one interval is
/// in it.
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
}

pub(super) fn delays(passages: &[Passage], random: &mut RandomStream) -> Figure<DelayFigures> {
    let arrived = || {
        passages
            .iter()
            .filter(|one| one.crossing == Crossing::Arrived)
    };
    let delays_ns: Vec<i64> = arrived().filter_map(|one| one.delay_ns).collect();
    let mut ascending = delays_ns.clone();
    ascending.sort_unstable();
    let (Some(min_ns), Some(max_ns)) = (ascending.first().copied(), ascending.last().copied())
    else {
        let reason = if arrived().next().is_none() {
            "no message is known to have arrived"
        } else if arrived().all(|one| one.received_ns.is_none()) {
            "the receiving gateway's records are not at hand"
        } else {
            "clocks not aligned"
        };
        return Figure::unavailable(reason);
    };
    let mut quantile = |share: f64| DelayQuantile {
        value_ns: at_share(&ascending, share),
        interval: has_tail(ascending.len(), share)
            .then(|| block_bootstrap_quantile(&delays_ns, share, CONFIDENCE, random))
            .flatten(),
    };
    let [p50, p95, p99, p999] = [0.5, 0.95, 0.99, 0.999].map(&mut quantile);
    let alignment_bound_ns = arrived().map(|one| one.delay_bound_ns).max().unwrap_or(0);
    let above_min = |ns: i64| ns.saturating_sub(min_ns);
    Figure::Measured(DelayFigures {
        count: ascending.len() as u64,
        min_ns,
        p50,
        p95,
        p99,
        p999,
        max_ns,
        alignment_bound_ns,
        is_bound_wider: i128::from(alignment_bound_ns) > i128::from(p50.value_ns),
        variation: DelayVariation {
            p50_ns: above_min(p50.value_ns),
            p95_ns: above_min(p95.value_ns),
            p99_ns: above_min(p99.value_ns),
            p999_ns: above_min(p999.value_ns),
            max_ns: above_min(max_ns),
        },
    })
}

/// The smallest of `ascending` that at least `share` of them do not exceed.
pub(super) fn at_share(ascending: &[i64], share: f64) -> i64 {
    let rank = ceil_count(share * ascending.len() as f64).clamp(1, ascending.len());
    ascending[rank - 1]
}

pub(super) fn successive(passages: &[Passage]) -> Figure<SuccessiveVariation> {
    let mut magnitudes: Vec<i64> = Vec::new();
    for pair in passages.windows(2) {
        let [before, after] = [&pair[0], &pair[1]];
        let follows = !after.begins_epoch_after(before)
            && before.sequence.checked_add(1) == Some(after.sequence);
        if let Some(ns) = difference_ns(before, after).filter(|_| follows) {
            magnitudes.push(ns);
        }
    }
    magnitudes.sort_unstable();
    let Some(max_ns) = magnitudes.last().copied() else {
        return Figure::unavailable("no two successive messages arrived");
    };
    Figure::Measured(SuccessiveVariation {
        count: magnitudes.len() as u64,
        p50_ns: at_share(&magnitudes, 0.5),
        p99_ns: at_share(&magnitudes, 0.99),
        max_ns,
        jitter: jitter(passages),
    })
}

/// By how much the two delays differ; `None` when one of the messages did not arrive.
fn difference_ns(before: &Passage, after: &Passage) -> Option<i64> {
    let between = |from: Option<i64>, to: Option<i64>| Some(to?.saturating_sub(from?));
    let received = between(before.received_ns, after.received_ns)?;
    let sent = between(before.offered_ns, after.offered_ns)?;
    Some(received.saturating_sub(sent).saturating_abs())
}

fn jitter(passages: &[Passage]) -> InterarrivalJitter {
    let mut arrivals: Vec<&Passage> = passages
        .iter()
        .filter(|one| one.received_ns.is_some() && one.offered_ns.is_some())
        .collect();
    arrivals.sort_by_key(|one| one.received_ns);
    let (mut jitter_ns, mut sum, mut max_ns) = (0.0_f64, 0.0, 0.0_f64);
    for pair in arrivals.windows(2) {
        let magnitude_ns = difference_ns(pair[0], pair[1]).unwrap_or(0) as f64;
        jitter_ns += (magnitude_ns - jitter_ns) / 16.0;
        sum += jitter_ns;
        max_ns = max_ns.max(jitter_ns);
    }
    let count = arrivals.len().saturating_sub(1).max(1);
    InterarrivalJitter {
        mean_ns: sum / count as f64,
        max_ns,
    }
}
