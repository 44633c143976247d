//! What one point alone tells of a stream: how many, how often, which numbers are missing. It knows
//! neither delay nor loss; a missing number may be one that was never sent.

use std::collections::{BTreeMap, BTreeSet};

use hil_stats::histogram::{Distribution, LatencyHistogram};
use serde::{Deserialize, Serialize};

use super::flow::Numbered;
use super::observe::Observation;

/// Figures of one stream at one point.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PointMetrics {
    /// Datagrams seen, repetitions included.
    pub datagram_count: u64,
    /// Their payload, bytes.
    pub payload_bytes: u64,
    /// First stamp, nanoseconds on the point's clock.
    pub first_ns: i64,
    /// Last stamp.
    pub last_ns: i64,
    /// Time from one to the next.
    pub interval: Distribution,
    /// Longest such time and when it began.
    pub longest_gap: Option<GapMetrics>,
    /// What the sequence numbers tell, where there are any.
    pub numbers: Option<NumberMetrics>,
}

/// A time without datagrams.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct GapMetrics {
    /// Stamp of the datagram before it.
    pub from_ns: i64,
    /// How long.
    pub length_ns: i64,
}

/// Figures of sequence numbers, each series apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct NumberMetrics {
    /// Series met: a new one begins when a session or producer starts, or a number falls back too
    /// far to be late.
    pub series_count: u64,
    /// What one number differs from the next by, most often.
    pub step: u64,
    /// Numbers between first and last of a series, on that step, that were not seen.
    pub skipped_count: u64,
    /// Datagrams with a number seen before; `None` when messages came in pieces, which bear one
    /// number by design.
    pub repeated_count: Option<u64>,
    /// Datagrams with a number lower than one seen before, copies apart (RFC 4737 section 3.3).
    pub reordered_count: u64,
}

/// Its stamps, or, where they go back on the whole, those of a clock that was not set meanwhile.
fn clock(observations: &[Observation]) -> fn(&Observation) -> i64 {
    let mut neighbours = observations.windows(2);
    if neighbours.any(|pair| pair[0].level != pair[1].level && pair[1].stamp_ns < pair[0].stamp_ns)
    {
        |one| one.steady_ns
    } else {
        |one| one.stamp_ns
    }
}

/// Figures of a stream; `None` without observations. They are put in order of time first.
pub fn single_point_metrics(observations: &[Observation]) -> Option<PointMetrics> {
    let at_ns = clock(observations);
    let mut stamps: Vec<i64> = observations.iter().map(at_ns).collect();
    stamps.sort_unstable();
    let (first_ns, last_ns) = (*stamps.first()?, *stamps.last()?);
    let mut interval = LatencyHistogram::default();
    let mut longest: Option<GapMetrics> = None;
    for pair in stamps.windows(2) {
        let (from_ns, length_ns) = (pair[0], pair[1].saturating_sub(pair[0]));
        interval.record(length_ns);
        if longest.is_none_or(|gap| length_ns > gap.length_ns) {
            longest = Some(GapMetrics { from_ns, length_ns });
        }
    }
    let payloads = observations.iter().map(|one| u64::from(one.payload_bytes));
    Some(PointMetrics {
        datagram_count: observations.len() as u64,
        payload_bytes: payloads.sum(),
        first_ns,
        last_ns,
        interval: interval.distribution("fewer than two datagrams"),
        longest_gap: longest,
        numbers: number_metrics(observations),
    })
}

/// Numbers that a late datagram may lie behind the newest, and that may be missing where the count
/// passes its end; farther back or on it has begun anew (RFC 3550 appendix A.1).
const LATE_MAX: u64 = 100;
const MISSING_AT_WRAP_MAX: u64 = 3000;

/// A count without its wraps.
#[derive(Debug)]
struct Unwrapped {
    /// Highest number so far, unwrapped. It starts one lap up, so that one may be late at once.
    top: u64,
    restart_count: u64,
}

impl Unwrapped {
    const fn first_top(first: &Numbered) -> u64 {
        match first.bits {
            Some(bits @ ..64) => (1 << bits) + first.number,
            _ => first.number,
        }
    }

    /// The number as it would be if the count never wrapped.
    fn take(&mut self, one: &Numbered) -> u64 {
        let Some(bits) = one.bits else {
            self.top = self.top.max(one.number);
            return one.number;
        };
        // 64 bits never wrap in practice, so that half of them as a lap change nothing.
        let lap = 1_u64 << bits.min(63);
        let newest = self.top % lap;
        let ahead = one.number.wrapping_sub(newest) % lap;
        let behind = newest.wrapping_sub(one.number) % lap;
        let has_wrapped = one.number < newest;
        if behind <= LATE_MAX.min(lap / 4) {
            return self.top - behind;
        }
        let may_be_missing = if has_wrapped {
            MISSING_AT_WRAP_MAX.min(lap / 2)
        } else {
            lap / 2
        };
        if ahead <= may_be_missing {
            self.top = self.top.saturating_add(ahead);
        } else {
            self.restart_count += 1;
            self.top = Self::first_top(one);
        }
        self.top
    }
}

fn number_metrics(observations: &[Observation]) -> Option<NumberMetrics> {
    let mut in_time: Vec<&Observation> = observations.iter().collect();
    let at_ns = clock(observations);
    in_time.sort_by_key(|one| at_ns(one));
    // By what the datagrams say, and by how often the counting began anew unsaid.
    let mut series: BTreeMap<(u64, u64), BTreeSet<u64>> = BTreeMap::new();
    let mut figures = NumberMetrics::default();
    let mut counts: BTreeMap<u64, Unwrapped> = BTreeMap::new();
    let (mut has_pieces, mut repeated_count) = (false, 0);
    for one in in_time {
        let numbered = one.identity.number?;
        let count = counts.entry(numbered.series).or_insert_with(|| Unwrapped {
            top: Unwrapped::first_top(&numbered),
            restart_count: 0,
        });
        let number = count.take(&numbered);
        let seen = series.entry((numbered.series, count.restart_count));
        let is_new = seen.or_default().insert(number);
        repeated_count += u64::from(!is_new);
        // A copy is a repetition; a piece of a late message is late.
        let is_late = number < count.top && (is_new || numbered.is_piece);
        figures.reordered_count += u64::from(is_late);
        has_pieces |= numbered.is_piece;
    }
    figures.series_count = series.len() as u64;
    let mut steps: BTreeMap<u64, u64> = BTreeMap::new();
    for seen in series.values() {
        for (number, next) in seen.iter().zip(seen.iter().skip(1)) {
            *steps.entry(next - number).or_default() += 1;
        }
    }
    figures.repeated_count = (!has_pieces).then_some(repeated_count);
    // The smallest of the most frequent ones.
    let most = steps.iter().max_by(|a, b| a.1.cmp(b.1).then(b.0.cmp(a.0)));
    figures.step = most.map_or(1, |(step, _)| *step);
    for (difference, count) in &steps {
        let between = difference.div_ceil(figures.step).saturating_sub(1);
        let skipped = between.saturating_mul(*count);
        figures.skipped_count = figures.skipped_count.saturating_add(skipped);
    }
    Some(figures)
}
