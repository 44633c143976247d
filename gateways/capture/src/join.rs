//! The same datagrams at two points: delay, its variation, loss, repetition and reordering. What a
//! gateway says of them plays no part here.
//!
//! **Delay** is the difference of the two stamps, so it is one-way only if both points read one
//! clock; otherwise it is off by a constant and drift that nobody here can know.
//! **Variation** is the delay less the smallest one (PDV, RFC 5481 section 4.2) and needs only
//! that the clocks run alike. **Jitter** is RFC 3550's running estimate, section 6.4.1.
//! **Reordering** is RFC 4737's: a datagram is late when one that left after it came before it.
//! **Loss** counts what was seen at the first point and not at the second, without the *edges*:
//! what left when the second point was not watched, or so near to its end that the slowest datagram
//! would not have come in time. An *unexplained* datagram was seen at the second point only, while
//! the first was watched: the first point's capture has missed it.

use std::collections::BTreeMap;

use hil_core::interval::Spread;
use hil_stats::dependence::{Batches, Quantiles};
use hil_stats::histogram::{Distribution, LatencyHistogram};
use hil_stats::samples::Samples;
use serde::{Deserialize, Serialize};

use super::observe::{Observation, Point, Seen, Span, Stream};
use hil_net::Direction;

/// Farthest that two stamps of one datagram may lie apart unless told otherwise.
pub const WINDOW_NS: i64 = 5_000_000_000;

/// By what the first point was told from the second.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OrderSource {
    /// The packets' direction: out here, in there.
    PacketDirection,
    /// Most stamps here were earlier; sound only when the points read one clock.
    Stamps,
}

/// Figures of a stream between two points.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct JoinMetrics {
    /// How first and second were told apart.
    pub order: OrderSource,
    /// Datagrams at the first point.
    pub first_count: u64,
    /// Datagrams at the second point.
    pub second_count: u64,
    /// Seen at both.
    pub matched_count: u64,
    /// Seen at the first only.
    pub lost_count: u64,
    /// Seen at one only, when the other was not watched or not long enough.
    pub edge_count: u64,
    /// Seen more often at the second than at the first.
    pub duplicated_count: u64,
    /// Seen at the second only: the first capture has gaps.
    pub unexplained_count: u64,
    /// Lost of those that were judged.
    pub loss_ratio: Option<f64>,
    /// 95 % interval of it, or why there is none.
    pub loss_interval: Option<Spread>,
    /// Runs of losses in the order of departure: length and how many.
    pub loss_bursts: Vec<(u64, u64)>,
    /// Second stamp minus first.
    pub delay: Distribution,
    /// 95 % interval of its median, nanoseconds, or why there is none.
    pub delay_p50_interval: Option<Spread>,
    /// The same of its 99th percentile.
    pub delay_p99_interval: Option<Spread>,
    /// Delay less the smallest delay.
    pub variation: Distribution,
    /// RFC 3550's estimate after the last datagram, nanoseconds.
    pub jitter_last_ns: Option<f64>,
    /// Its mean over all datagrams.
    pub jitter_mean_ns: Option<f64>,
    /// Late ones.
    pub reordered_count: u64,
    /// Farthest that one was overtaken: positions to the earliest of those that overtook it
    /// (RFC 4737 section 4.2.2).
    pub reordering_extent_max: u64,
    /// Time between arrivals at the second point.
    pub arrival_interval: Distribution,
}

/// A datagram seen at both points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pair {
    /// At the first point.
    pub first: Observation,
    /// At the second.
    pub second: Observation,
}

impl Pair {
    /// Second stamp minus first, nanoseconds.
    pub const fn delay_ns(&self) -> i64 {
        self.second.stamp_ns.saturating_sub(self.first.stamp_ns)
    }
}

/// A stream at two points, in the order in which it passes them.
#[derive(Debug)]
pub struct Joined {
    /// Where it was seen first.
    pub first_point: Point,
    /// Where then.
    pub second_point: Point,
    /// What was seen at both, in the order of departure.
    pub pairs: Vec<Pair>,
    /// The figures.
    pub figures: JoinMetrics,
}

/// What one of the two points saw of the stream, in time.
struct Side<'a> {
    point: &'a Point,
    /// See [`Seen::span`].
    watched: Option<Span>,
    seen: Vec<Observation>,
}

impl<'a> Side<'a> {
    fn of(stream: &Stream, point: &'a Point, seen: &Seen) -> Option<Self> {
        let list = seen.streams.get(stream).cloned();
        let mut list = list.or_else(|| seen.span.map(|_watched| Vec::new()))?;
        list.sort_by_key(|one| one.stamp_ns);
        Some(Self {
            point,
            watched: seen.span,
            seen: list,
        })
    }

    /// It was watched all of this time.
    fn covers(&self, from_ns: i64, to_ns: i64) -> bool {
        self.watched
            .is_some_and(|span| from_ns >= span.first_ns && to_ns <= span.last_ns)
    }
}

/// Joins what two points saw of `stream`; `None` when neither saw anything of it, or one did not and
/// nothing tells that it was watched. Stamps of one datagram lie at most `window_ns` apart.
///
/// A point that was watched and saw nothing has lost everything. Whether the stream should have come
/// by there at all is for the caller to know: see [`super::pairing`].
pub fn join(
    stream: &Stream,
    a: &Point,
    seen_a: &Seen,
    b: &Point,
    seen_b: &Seen,
    window_ns: i64,
) -> Option<Joined> {
    let mut first = Side::of(stream, a, seen_a)?;
    let mut second = Side::of(stream, b, seen_b)?;
    if first.seen.is_empty() && second.seen.is_empty() {
        return None;
    }
    // Through a host with two taps the way is in, then out; but both then read one clock.
    let by_direction = match (a.direction, b.direction) {
        _ if a.file_index == b.file_index => None,
        (Direction::Outbound, Direction::Inbound) => Some(false),
        (Direction::Inbound, Direction::Outbound) => Some(true),
        _ => None,
    };
    let mut matches = Matches::of(&first.seen, &second.seen, window_ns);
    let is_swapped = by_direction.unwrap_or_else(|| {
        let is_early =
            |pair: &&(usize, usize)| second.seen[pair.1].stamp_ns < first.seen[pair.0].stamp_ns;
        let early_count = matches.pairs.iter().filter(is_early).count();
        // The one point that saw it is the first.
        first.seen.is_empty() || 2 * early_count > matches.pairs.len()
    });
    if is_swapped {
        core::mem::swap(&mut first, &mut second);
        matches = Matches::of(&first.seen, &second.seen, window_ns);
    }
    let order = match by_direction {
        Some(_) => OrderSource::PacketDirection,
        None => OrderSource::Stamps,
    };
    let pair = |&(i, j): &(usize, usize)| Pair {
        first: first.seen[i],
        second: second.seen[j],
    };
    let pairs: Vec<Pair> = matches.pairs.iter().map(pair).collect();
    Some(Joined {
        first_point: *first.point,
        second_point: *second.point,
        figures: metrics(order, &first, &second, &pairs, &matches),
        pairs,
    })
}

/// Who belongs to whom, by positions.
#[derive(Default)]
struct Matches {
    /// In the order of the first point.
    pairs: Vec<(usize, usize)>,
    only_first: Vec<usize>,
    only_second: Vec<usize>,
    duplicates: Vec<usize>,
}

impl Matches {
    /// Of equal keys the earliest at one point belongs to the earliest at the other that is within
    /// the window; what remains at the second beside a match is a repetition.
    fn of(first: &[Observation], second: &[Observation], window_ns: i64) -> Self {
        let mut by_key: BTreeMap<u64, (Vec<usize>, Vec<usize>)> = BTreeMap::new();
        for (index, one) in first.iter().enumerate() {
            by_key.entry(one.identity.key).or_default().0.push(index);
        }
        for (index, one) in second.iter().enumerate() {
            by_key.entry(one.identity.key).or_default().1.push(index);
        }
        let mut matches = Self::default();
        for (from, to) in by_key.values() {
            let (mut i, mut j, mut newest_match) = (0, 0, None);
            while j < to.len() {
                let arrival_ns = second[to[j]].stamp_ns;
                let since = |at: i64| arrival_ns.saturating_sub(at);
                match from.get(i).map(|index| since(first[*index].stamp_ns)) {
                    Some(delay_ns) if delay_ns > window_ns => {
                        matches.only_first.push(from[i]);
                        i += 1;
                        continue;
                    }
                    Some(delay_ns) if delay_ns >= -window_ns => {
                        matches.pairs.push((from[i], to[j]));
                        newest_match = Some(arrival_ns);
                        i += 1;
                    }
                    _ if newest_match.is_some_and(|at| since(at) <= window_ns) => {
                        matches.duplicates.push(to[j]);
                    }
                    _ => matches.only_second.push(to[j]),
                }
                j += 1;
            }
            matches.only_first.extend(&from[i..]);
        }
        matches.pairs.sort_unstable();
        matches.only_first.sort_unstable();
        matches
    }
}

fn metrics(
    order: OrderSource,
    first: &Side<'_>,
    second: &Side<'_>,
    pairs: &[Pair],
    matches: &Matches,
) -> JoinMetrics {
    let delays: Vec<i64> = pairs.iter().map(Pair::delay_ns).collect();
    let fastest = delays.iter().min().copied().unwrap_or(0);
    let slowest = delays.iter().max().copied().unwrap_or(0);
    // A datagram would have had its other stamp while the point was watched, however fast or slow it
    // was among those seen; the rest of what was seen at one point only lies at an edge.
    let mut lost = matches.only_first.clone();
    lost.retain(|index| {
        let at = first.seen[*index].stamp_ns;
        second.covers(at.saturating_add(fastest), at.saturating_add(slowest))
    });
    let unexplained = matches.only_second.iter().filter(|index| {
        let at = second.seen[**index].stamp_ns;
        first.covers(at.saturating_sub(slowest), at.saturating_sub(fastest))
    });
    let unexplained_count = unexplained.count();
    let only_count = matches.only_first.len() + matches.only_second.len();
    let matched_count = pairs.len() as u64;
    let lost_count = lost.len() as u64;
    let judged_count = matched_count + lost_count;
    // In the order of departure: matched or lost.
    let mut judged: Vec<(usize, f64)> = matches.pairs.iter().map(|pair| (pair.0, 0.0)).collect();
    judged.extend(lost.iter().map(|place| (*place, 1.0)));
    judged.sort_unstable_by_key(|one| one.0);
    let outcomes = Batches::of(judged.iter().map(|one| one.1));
    // Positions of departure in the order of arrival.
    let mut arrivals: Vec<usize> = (0..pairs.len()).collect();
    arrivals.sort_by_key(|departure| pairs[*departure].second.stamp_ns);
    let (reordered_count, reordering_extent_max) = reordering(&arrivals);
    let in_arrival = arrivals.iter().map(|departure| delays[*departure]);
    let jitter = jitter_ns(&in_arrival.collect::<Vec<_>>());
    let series: Samples = delays.iter().copied().collect();
    let ascending = series.ascending();
    let quantiles = Quantiles::of(&series, &ascending);
    let unmatched = "no datagram was seen at both points";
    let variation = delays.iter().map(|delay| delay.saturating_sub(fastest));
    let gaps = second.seen.windows(2);
    let gaps = gaps.map(|pair| pair[1].stamp_ns.saturating_sub(pair[0].stamp_ns));
    JoinMetrics {
        order,
        first_count: first.seen.len() as u64,
        second_count: second.seen.len() as u64,
        matched_count,
        lost_count,
        edge_count: (only_count - lost.len() - unexplained_count) as u64,
        duplicated_count: matches.duplicates.len() as u64,
        unexplained_count: unexplained_count as u64,
        loss_ratio: (judged_count > 0).then(|| lost_count as f64 / judged_count as f64),
        loss_interval: (judged_count > 0).then(|| outcomes.share_interval()),
        loss_bursts: bursts(&lost),
        delay: distribution(delays.iter().copied(), unmatched),
        delay_p50_interval: quantiles.interval(0.5),
        delay_p99_interval: quantiles.interval(0.99),
        variation: distribution(variation, unmatched),
        jitter_last_ns: jitter.map(|(last, _)| last),
        jitter_mean_ns: jitter.map(|(_, mean)| mean),
        reordered_count,
        reordering_extent_max,
        arrival_interval: distribution(gaps, "fewer than two arrivals"),
    }
}

/// How many were overtaken, and the largest extent.
fn reordering(arrivals: &[usize]) -> (u64, u64) {
    // Running maxima only grow, so the earliest overtaker is found by bisection.
    let mut tops: Vec<usize> = Vec::with_capacity(arrivals.len());
    let (mut count, mut extent_max) = (0, 0);
    for (position, departure) in arrivals.iter().enumerate() {
        let earliest = tops.partition_point(|top| top < departure);
        if earliest < position {
            count += 1;
            extent_max = extent_max.max((position - earliest) as u64);
        }
        tops.push(tops.last().map_or(*departure, |top| *top.max(departure)));
    }
    (count, extent_max)
}

/// Lengths of runs of neighbouring positions, and how many of each.
fn bursts(lost: &[usize]) -> Vec<(u64, u64)> {
    let mut lengths: BTreeMap<u64, u64> = BTreeMap::new();
    for run in lost.chunk_by(|a, b| a + 1 == *b) {
        *lengths.entry(run.len() as u64).or_default() += 1;
    }
    lengths.into_iter().collect()
}

fn distribution(values: impl Iterator<Item = i64>, reason: &str) -> Distribution {
    let mut histogram = LatencyHistogram::default();
    values.for_each(|value| histogram.record(value));
    histogram.distribution(reason)
}

/// RFC 3550 section 6.4.1 over the delays in the order of arrival: the last estimate and the mean of
/// all.
fn jitter_ns(delays: &[i64]) -> Option<(f64, f64)> {
    let (mut jitter, mut sum) = (0.0, 0.0);
    for pair in delays.windows(2) {
        let difference = pair[1].saturating_sub(pair[0]);
        jitter += (difference.unsigned_abs() as f64 - jitter) / 16.0;
        sum += jitter;
    }
    (delays.len() > 1).then(|| (jitter, sum / (delays.len() - 1) as f64))
}
