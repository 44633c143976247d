//! The same datagrams at two points: delay, its variation, loss, repetition and reordering. What a
//! gateway says of them plays no part here.
//!
//! **Delay** is the difference of the two stamps, so it is one-way only if both points read one
//! clock; otherwise it is off by a constant and drift that nobody here can know.
//! **Variation** is the delay less the smallest one (PDV, RFC 5481 section 4.2) and, of one after the
//! other, the difference (IPDV, section 4.1); both need only that the clocks run alike. **Jitter** is RFC 3550's running estimate, section 6.4.1.
//! **Reordering** is RFC 4737's: a datagram is late when one that left after it came before it.
//! **Loss** counts what was seen at the first point and not at the second, without the *edges*:
//! what left when the second point was not watched, or so near to its end that the slowest datagram
//! would not have come in time. It is unavailable where the second point may have seen a datagram and
//! cannot tell: see [`Doubt`]. An *unexplained* datagram was seen at the second point only, while
//! the first was watched: the first point's capture has missed it.

use core::cmp::Reverse;
use std::collections::BTreeMap;

use hil_core::interval::Spread;
use hil_stats::dependence::{Batches, Quantiles};
use hil_stats::histogram::{Distribution, LatencyHistogram};
use hil_stats::reordering::reordered;
use hil_stats::samples::Samples;
use serde::{Deserialize, Serialize};

use super::observe::{Observation, Point, Seen, Stream};
use super::watch::{ClockStep, Unread, Watch};
use hil_net::Direction;

/// Farthest that two stamps of one datagram may lie apart unless told otherwise.
pub const WINDOW_NS: i64 = 5_000_000_000;
/// Largest IP packet of a link without jumbo frames; a larger one may be several in one.
const PACKET_BYTES_MAX: u32 = 1500;
/// Smallest change of the delays' level that is told, and the datagrams on either side of it.
const SHIFT_MIN_NS: i64 = 50_000_000;
const SHIFT_SIDE_MIN: usize = 3;

/// How two captures are joined.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct JoinSettings {
    /// Farthest that two stamps of one datagram may lie apart.
    pub window_ns: i64,
    /// Different files were stamped by one clock.
    pub is_one_clock: bool,
}

/// By what the first point was told from the second.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OrderSource {
    /// The packets' direction: out here, in there.
    PacketDirection,
    /// The time to live, which routers between the points lower.
    HopLimit,
    /// Most stamps here were earlier, on one clock.
    Stamps,
    /// Datagrams the other way took a positive time together with these, whatever the clocks.
    RoundTrip,
    /// Only here datagrams were seen that the other point lacks.
    Missing,
    /// Nothing tells: in the order in which the points were named.
    Unknown,
}

/// Why a datagram that a point does not show may have passed it all the same.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "doubt")]
pub enum Doubt {
    /// Frames there could not be read.
    Unread(Unread),
    /// Only the first of their IP fragments was kept there.
    Pieces,
    /// Frames were dropped by the capture there.
    Dropped,
    /// The capture there had a filter that may not have kept them.
    Filtered {
        /// In the words of its file.
        filter: String,
    },
    /// Which point comes first is unknown.
    Order,
    /// Seen at both points, farther apart than [`JoinSettings::window_ns`].
    Apart,
    /// Seen at one point while nothing tells that the other was watched, and none was seen at both.
    Unwatched,
}

/// A doubt, and how many frames or datagrams it is of.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct CountedDoubt {
    /// Which.
    #[serde(flatten)]
    pub doubt: Doubt,
    /// How many.
    pub count: u64,
}

/// What two points tell of loss.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "state")]
pub enum Loss {
    /// The second point would have seen them.
    Counted(LossCount),
    /// It may have seen them.
    Unavailable {
        /// At least and at most so many are lost, where that is known.
        range: Option<(u64, u64)>,
        /// Why.
        doubts: Vec<CountedDoubt>,
    },
}

/// Losses between two points.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LossCount {
    /// Lost.
    pub count: u64,
    /// Lost of those that were judged.
    pub ratio: Option<f64>,
    /// 95 % interval of it, or why there is none.
    pub interval: Option<Spread>,
    /// Runs of losses in the order of departure, between arrivals: length and how many (loss periods,
    /// RFC 3357 section 5).
    pub bursts: Vec<(u64, u64)>,
}

impl Loss {
    /// How many are lost; `None` when that is unavailable.
    pub const fn count(&self) -> Option<u64> {
        match self {
            Self::Counted(loss) => Some(loss.count),
            Self::Unavailable { .. } => None,
        }
    }
}

/// Delays that from one datagram on all lie on another level: a clock was set, or the way changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct DelayShift {
    /// Departure of the first datagram on the new level.
    pub from_ns: i64,
    /// Median after it less median before it.
    pub by_ns: i64,
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
    pub loss: Loss,
    /// Seen at one only, when the other was not watched or not long enough.
    pub edge_count: u64,
    /// Copies of datagrams seen at the second point before (RFC 5560 section 3), beyond those that had
    /// passed the first; `None` where they may have passed on another link.
    pub duplicated_count: Option<u64>,
    /// Seen at the second only: the first capture has gaps.
    pub unexplained_count: u64,
    /// Where the clock of a point was set, first and second point.
    pub clock_steps: [Vec<ClockStep>; 2],
    /// A change of the delays that no stamp of one point shows.
    pub delay_shift: Option<DelayShift>,
    /// Second stamp minus first; unavailable when a clock was set meanwhile.
    pub delay: Distribution,
    /// 95 % interval of its median, nanoseconds, or why there is none.
    pub delay_p50_interval: Option<Spread>,
    /// The same of its 99th percentile.
    pub delay_p99_interval: Option<Spread>,
    /// Delay less the smallest delay (PDV, RFC 5481 section 4.2).
    pub variation: Distribution,
    /// Difference of the delays of two that left one after the other and both arrived, as a magnitude
    /// (IPDV, RFC 5481 section 4.1).
    pub successive: Distribution,
    /// RFC 3550's estimate after the last datagram, nanoseconds.
    pub jitter_last_ns: Option<f64>,
    /// Its mean over all datagrams.
    pub jitter_mean_ns: Option<f64>,
    /// Those that came after one that left later (RFC 4737 section 3.3).
    pub reordered_count: u64,
    /// Farthest that one was overtaken: positions to the earliest of those that overtook it
    /// (RFC 4737 section 4.2.2).
    pub reordering_extent_max: u64,
    /// Largest n for which one is n-reordered (RFC 4737 section 5).
    pub reordering_n_max: u64,
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
    /// Both stamps are sound.
    pub const fn is_stamped(&self) -> bool {
        self.first.is_stamp_sound && self.second.is_stamp_sound
    }

    /// One point saw several datagrams in one.
    const fn is_aggregate(&self) -> bool {
        self.first.payload_bytes != self.second.payload_bytes
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

/// What one of two points could see, and saw.
#[derive(Debug, Clone, Copy)]
pub struct Sight<'a> {
    /// Which.
    pub point: &'a Point,
    /// What it could see.
    pub watch: &'a Watch,
    /// What it saw.
    pub seen: &'a Seen,
}

impl Sight<'_> {
    /// Both points' stamps are of one host.
    pub(super) fn is_of_host_of(&self, other: &Self) -> bool {
        let (a, b) = (self.point, other.point);
        let is_one_tap = a.interface_index == b.interface_index;
        a.file_index == b.file_index && (is_one_tap || !self.watch.is_merged)
    }
}

/// Which stamps of a point tell when it saw something.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Reading {
    /// As they are; parts of the file may be out of order.
    Stamps,
    /// As if the clock had not been set: the file is in order. What takes them to one level's clock.
    Steady {
        /// Nanoseconds.
        anchor_ns: i64,
    },
}

impl Reading {
    fn at_ns(self, one: &Observation) -> i64 {
        match self {
            Self::Stamps => one.stamp_ns,
            Self::Steady { anchor_ns } => one.steady_ns.saturating_add(anchor_ns),
        }
    }
}

/// What one of the two points saw of the stream, in time.
#[derive(Clone)]
struct Side<'a> {
    sight: Sight<'a>,
    reading: Reading,
    seen: Vec<Observation>,
    /// When each was seen.
    at_ns: Vec<i64>,
}

impl<'a> Side<'a> {
    /// In the readings that its stamps allow.
    fn each(stream: &Stream, sight: Sight<'a>) -> Vec<Self> {
        let list = sight.seen.get(stream).cloned().unwrap_or_default();
        let anchors = sight.watch.anchors_ns.iter();
        let steady = anchors.map(|anchor_ns| Reading::Steady {
            anchor_ns: *anchor_ns,
        });
        let steady = steady.filter(|_| !sight.watch.steps.is_empty());
        let readings = steady.chain([Reading::Stamps]);
        let side = |reading: Reading| {
            let mut seen = list.clone();
            seen.sort_by_key(|one| reading.at_ns(one));
            Self {
                sight,
                reading,
                at_ns: seen.iter().map(|one| reading.at_ns(one)).collect(),
                seen,
            }
        };
        readings.map(side).collect()
    }

    /// It was watched all of this time.
    fn covers(&self, from_ns: i64, to_ns: i64) -> bool {
        let watch = self.sight.watch;
        let (spans, anchor_ns) = match self.reading {
            Reading::Stamps => (&watch.spans, 0),
            Reading::Steady { anchor_ns } => (&watch.steady_spans, anchor_ns),
        };
        let at = |ns: i64| ns.saturating_add(anchor_ns);
        let mut spans = spans.iter();
        spans.any(|span| from_ns >= at(span.first_ns) && to_ns <= at(span.last_ns))
    }

    fn steps(&self) -> Vec<ClockStep> {
        match self.reading {
            Reading::Stamps => Vec::new(),
            Reading::Steady { .. } => self.sight.watch.steps.clone(),
        }
    }
}

/// Joins what two points saw of `stream`; `None` when neither saw anything of it. `round_trip` is what datagrams the other way tell of the order: true
/// when `b` comes first.
///
/// A point that was watched and saw nothing has lost everything. Whether the stream should have come
/// by there at all is for the caller to know: see [`super::pairing`].
pub fn join(
    stream: &Stream,
    a: Sight<'_>,
    b: Sight<'_>,
    settings: &JoinSettings,
    round_trip: Option<bool>,
) -> Option<Joined> {
    let (mut first, mut second, matches) = best_reading(stream, a, b, settings.window_ns)?;
    // What is not known again was seen all the same.
    let is_met = |sight: &Sight<'_>| sight.seen.contains_key(stream);
    if first.seen.is_empty() && second.seen.is_empty() && !(is_met(&a) && is_met(&b)) {
        return None;
    }
    let is_one_clock = settings.is_one_clock || a.is_of_host_of(&b);
    let (order, is_swapped) = ends(&first, &second, &matches, is_one_clock, round_trip);
    let matches = if is_swapped {
        core::mem::swap(&mut first, &mut second);
        Matches::of(&first, &second, settings.window_ns)
    } else {
        matches
    };
    let pair = |&(i, j): &(usize, usize)| Pair {
        first: first.seen[i],
        second: second.seen[j],
    };
    let pairs: Vec<Pair> = matches.pairs.iter().map(pair).collect();
    Some(Joined {
        first_point: *first.sight.point,
        second_point: *second.sight.point,
        figures: metrics(stream, order, &first, &second, &pairs, &matches),
        pairs,
    })
}

/// Of the readings of both points the one under which most datagrams match, with delays most alike.
fn best_reading<'a>(
    stream: &Stream,
    a: Sight<'a>,
    b: Sight<'a>,
    window_ns: i64,
) -> Option<(Side<'a>, Side<'a>, Matches)> {
    let mut best: Option<(Fit, (Side<'a>, Side<'a>, Matches))> = None;
    let seconds = Side::each(stream, b);
    for first in Side::each(stream, a) {
        for second in &seconds {
            let matches = Matches::of(&first, second, window_ns);
            let delays = || {
                let pairs = matches.pairs.iter();
                pairs.map(|&(i, j)| second.at_ns[j].saturating_sub(first.at_ns[i]))
            };
            let spread = delays().max().zip(delays().min());
            let fit = Fit {
                matched_count: matches.pairs.len(),
                reordered_count: Reverse(matches.reordered_count(second)),
                spread_ns: Reverse(spread.map_or(0, |(most, least)| most.abs_diff(least))),
            };
            if best.as_ref().is_none_or(|(known, _)| fit > *known) {
                best = Some((fit, (first.clone(), second.clone(), matches)));
            }
        }
    }
    best.map(|(_, sides)| sides)
}

/// How well two readings agree; the better one is greater.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
struct Fit {
    matched_count: usize,
    /// A clock that was set mixes what came before it with what came after it.
    reordered_count: Reverse<usize>,
    /// Of the delays, from the smallest to the largest.
    spread_ns: Reverse<u64>,
}

/// How the ends are told apart, and whether the second comes first.
fn ends(
    first: &Side<'_>,
    second: &Side<'_>,
    matches: &Matches,
    is_one_clock: bool,
    round_trip: Option<bool>,
) -> (OrderSource, bool) {
    let (a, b) = (first.sight.point, second.sight.point);
    // Through a host with two taps the way is in, then out; but both then read one clock.
    match (a.direction, b.direction) {
        _ if a.file_index == b.file_index => {}
        (Direction::Outbound, Direction::Inbound) => return (OrderSource::PacketDirection, false),
        (Direction::Inbound, Direction::Outbound) => return (OrderSource::PacketDirection, true),
        _ => {}
    }
    let count = |is_so: &dyn Fn(&(usize, usize)) -> bool| {
        matches.pairs.iter().filter(|pair| is_so(pair)).count()
    };
    let hops = |&(i, j): &(usize, usize)| (first.seen[i].hop_limit, second.seen[j].hop_limit);
    let lowered = count(&|pair| hops(pair).0 > hops(pair).1);
    let raised = count(&|pair| hops(pair).0 < hops(pair).1);
    let all = matches.pairs.len();
    if all > 0 && lowered.max(raised) == all {
        return (OrderSource::HopLimit, raised == all);
    }
    // A clock that was set is not one with another.
    let is_steady = [first, second]
        .iter()
        .all(|side| side.reading == Reading::Stamps);
    if is_one_clock && is_steady && all > 0 {
        let is_early = |&(i, j): &(usize, usize)| second.at_ns[j] < first.at_ns[i];
        return (OrderSource::Stamps, 2 * count(&is_early) > all);
    }
    if let Some(is_swapped) = round_trip {
        return (OrderSource::RoundTrip, is_swapped);
    }
    match (
        matches.only_first.is_empty(),
        matches.only_second.is_empty(),
    ) {
        (false, true) => (OrderSource::Missing, false),
        (true, false) => (OrderSource::Missing, true),
        _ => (OrderSource::Unknown, false),
    }
}

/// What the median of the stamps' differences at two points is; `None` without a datagram at both.
pub(super) fn median_difference_ns(
    stream: &Stream,
    a: Sight<'_>,
    b: Sight<'_>,
    window_ns: i64,
) -> Option<i64> {
    let (first, second, matches) = best_reading(stream, a, b, window_ns)?;
    let pairs = matches.pairs.iter();
    let mut differences: Vec<i64> = pairs
        .map(|&(i, j)| second.at_ns[j].saturating_sub(first.at_ns[i]))
        .collect();
    differences.sort_unstable();
    differences.get(differences.len() / 2).copied()
}

/// Who belongs to whom, by positions.
#[derive(Default)]
struct Matches {
    /// In the order of the first point.
    pairs: Vec<(usize, usize)>,
    only_first: Vec<usize>,
    only_second: Vec<usize>,
    duplicates: Vec<usize>,
    /// Of those seen at one point only, what has its like at the other, beyond the window.
    apart_count: usize,
}

impl Matches {
    /// Of equal keys the earliest at one point belongs to the earliest at the other that is within
    /// the window; what remains at the second beside a match is a repetition.
    fn of(first: &Side<'_>, second: &Side<'_>, window_ns: i64) -> Self {
        let mut by_key: BTreeMap<u64, (Vec<usize>, Vec<usize>)> = BTreeMap::new();
        for (index, one) in first.seen.iter().enumerate() {
            by_key.entry(one.identity.key).or_default().0.push(index);
        }
        for (index, one) in second.seen.iter().enumerate() {
            by_key.entry(one.identity.key).or_default().1.push(index);
        }
        let mut matches = Self::default();
        for (from, to) in by_key.values() {
            let before = (matches.only_first.len(), matches.only_second.len());
            let (mut i, mut j, mut newest_match) = (0, 0, None);
            while j < to.len() {
                let arrival_ns = second.at_ns[to[j]];
                let since = |at: i64| arrival_ns.saturating_sub(at);
                match from.get(i).map(|index| since(first.at_ns[*index])) {
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
            let alone = matches.only_first.len() - before.0;
            matches.apart_count += alone.min(matches.only_second.len() - before.1);
        }
        matches.pairs.sort_unstable();
        matches.only_first.sort_unstable();
        matches.only_second.sort_unstable();
        matches
    }

    /// Positions of departure in the order of arrival.
    fn arrivals(&self, second: &Side<'_>) -> Vec<usize> {
        let mut arrivals: Vec<usize> = (0..self.pairs.len()).collect();
        arrivals.sort_by_key(|departure| second.at_ns[self.pairs[*departure].1]);
        arrivals
    }

    fn reordered_count(&self, second: &Side<'_>) -> usize {
        let mut latest = 0;
        let arrivals = self.arrivals(second).into_iter();
        let late = arrivals.filter(|departure| {
            latest = latest.max(*departure);
            *departure < latest
        });
        late.count()
    }
}

/// Delays of the datagrams at both points, in the order of departure, and the level each is on.
struct Levels {
    /// In the reading of both points.
    delays: Vec<i64>,
    shift: Option<DelayShift>,
    /// Smallest and largest delay before and after the shift; without one, twice of all.
    bounds: [(i64, i64); 2],
}

impl Levels {
    fn of(first: &Side<'_>, second: &Side<'_>, matches: &Matches) -> Self {
        let pairs = matches.pairs.iter();
        let (departures, delays): (Vec<i64>, Vec<i64>) = pairs
            .map(|&(i, j)| {
                (
                    first.at_ns[i],
                    second.at_ns[j].saturating_sub(first.at_ns[i]),
                )
            })
            .unzip();
        let bounds = |delays: &[i64]| {
            let least = delays.iter().min().copied().unwrap_or(0);
            (least, delays.iter().max().copied().unwrap_or(0))
        };
        let at = shift_place(&delays);
        let shift = at.map(|at| DelayShift {
            from_ns: departures[at],
            by_ns: median(&delays[at..]).saturating_sub(median(&delays[..at])),
        });
        let (before, after) = delays.split_at(at.unwrap_or(0));
        Self {
            shift,
            bounds: if at.is_some() {
                [bounds(before), bounds(after)]
            } else {
                [bounds(&delays); 2]
            },
            delays,
        }
    }

    /// The least and the most that one which left at `at_ns` would have taken.
    fn bounds_at(&self, at_ns: i64) -> (i64, i64) {
        let is_after = self.shift.is_some_and(|shift| at_ns >= shift.from_ns);
        self.bounds[usize::from(is_after)]
    }

    fn shift_arrival_ns(&self) -> i64 {
        self.shift.map_or(i64::MAX, |shift| {
            shift.from_ns.saturating_add(self.bounds[1].0)
        })
    }
}

/// From which delay on all lie on another level than all before.
fn shift_place(delays: &[i64]) -> Option<usize> {
    let running = |delays: &mut dyn Iterator<Item = &i64>| {
        let mut bounds: Option<(i64, i64)> = None;
        let each = delays.map(|delay| {
            let (least, most) = bounds.unwrap_or((*delay, *delay));
            *bounds.insert((least.min(*delay), most.max(*delay)))
        });
        each.collect::<Vec<(i64, i64)>>()
    };
    let before = running(&mut delays.iter());
    let mut after = running(&mut delays.iter().rev());
    after.reverse();
    let last = delays.len().checked_sub(SHIFT_SIDE_MIN)?;
    (SHIFT_SIDE_MIN..=last).find(|at| {
        let ((a, b), (c, d)) = (before[at - 1], after[*at]);
        let apart = c.saturating_sub(b).max(a.saturating_sub(d));
        let width = b.saturating_sub(a).max(d.saturating_sub(c));
        apart > width.saturating_mul(4).max(SHIFT_MIN_NS)
    })
}

fn median(values: &[i64]) -> i64 {
    let mut sorted = values.to_vec();
    sorted.sort_unstable();
    sorted.get(sorted.len() / 2).copied().unwrap_or(0)
}

/// Why datagrams that the second point does not show may have passed it.
fn doubts(
    stream: &Stream,
    order: OrderSource,
    [first, second]: [&Side<'_>; 2],
    matches: &Matches,
    pairs: &[Pair],
    alone: [&[Observation]; 2],
) -> Vec<CountedDoubt> {
    let mut doubts = Vec::new();
    let mut add = |doubt, count: usize| {
        if count > 0 {
            let count = count as u64;
            doubts.push(CountedDoubt { doubt, count });
        }
    };
    // Links with jumbo frames show it by datagrams that are as large at both points.
    let whole = pairs.iter().filter(|pair| !pair.is_aggregate());
    let whole = whole.map(|pair| pair.first.packet_bytes).max();
    let whole_bytes_max = whole.unwrap_or(0).max(PACKET_BYTES_MAX);
    let alone_count: usize = alone.iter().map(|list| list.len()).sum();
    // One larger than all of the other point may be several that only that one shows.
    let large_count: usize = [(alone[0], second, alone[1]), (alone[1], first, alone[0])]
        .map(|(list, other, pieces)| {
            let largest = other.seen.iter().map(|one| one.payload_bytes).max();
            let mut known = BTreeMap::new();
            let is_large = |one: &&Observation| {
                let whole_bytes = one.payload_bytes;
                let mut has_pieces = || {
                    let found = known.entry(whole_bytes);
                    *found.or_insert_with(|| are_together(pieces, whole_bytes))
                };
                one.packet_bytes > whole_bytes_max || Some(whole_bytes) > largest && has_pieces()
            };
            list.iter().filter(is_large).count()
        })
        .iter()
        .sum();
    let aggregates = pairs.iter().filter(|pair| pair.is_aggregate()).count();
    add(Doubt::Unread(Unread::Aggregate), aggregates + large_count);
    if alone_count > 0 && order == OrderSource::Unknown {
        add(Doubt::Order, alone_count);
    }
    let in_pieces = pairs.iter().filter(|pair| pair.second.lacks_pieces);
    add(Doubt::Pieces, in_pieces.count());
    add(Doubt::Apart, matches.apart_count);
    let is_judged = !pairs.is_empty() || !alone[0].is_empty();
    let mut blind: Vec<&Side<'_>> = Vec::new();
    if !is_judged {
        blind.push(first);
    }
    if !is_judged || !alone[0].is_empty() {
        blind.push(second);
    }
    for side in blind {
        let watch = side.sight.watch;
        let (source, destination) = (stream.source, stream.destination);
        let is_seen = !side.seen.is_empty();
        for (why, count) in watch.unread_of(stream.flow_index, source, destination, is_seen) {
            add(
                Doubt::Unread(why),
                usize::try_from(count).unwrap_or(usize::MAX),
            );
        }
        let dropped = usize::try_from(watch.dropped_count);
        add(Doubt::Dropped, dropped.unwrap_or(usize::MAX));
        for filter in watch.filters_against(stream) {
            let filter = filter.clone();
            let only_count = matches.only_first.len() + matches.only_second.len();
            let count = if is_judged {
                alone[0].len()
            } else {
                only_count
            };
            add(Doubt::Filtered { filter }, count);
        }
    }
    if !is_judged && doubts.is_empty() {
        let count = (matches.only_first.len() + matches.only_second.len()) as u64;
        let doubt = Doubt::Unwatched;
        doubts.push(CountedDoubt { doubt, count });
    }
    doubts
}

/// Whether neighbours in `list`, each of fewer, are of so many bytes together.
fn are_together(list: &[Observation], whole_bytes: u32) -> bool {
    let (mut from, mut bytes) = (0, 0_u64);
    list.iter().any(|one| {
        bytes += u64::from(one.payload_bytes);
        while bytes > u64::from(whole_bytes) {
            bytes -= u64::from(list[from].payload_bytes);
            from += 1;
        }
        bytes == u64::from(whole_bytes)
    })
}

fn loss(lost: &[usize], matches: &Matches, doubts: Vec<CountedDoubt>) -> Loss {
    let count = lost.len() as u64;
    if doubts.is_empty() {
        // In the order of departure: matched or lost.
        let arrived = matches.pairs.iter().map(|pair| (pair.0, 0.0));
        let mut judged: Vec<(usize, f64)> = arrived.collect();
        judged.extend(lost.iter().map(|place| (*place, 1.0)));
        judged.sort_unstable_by_key(|one| one.0);
        let outcomes = Batches::of(judged.iter().map(|one| one.1));
        return Loss::Counted(LossCount {
            count,
            ratio: (!judged.is_empty()).then(|| count as f64 / judged.len() as f64),
            interval: (!judged.is_empty()).then(|| outcomes.share_interval()),
            bursts: bursts(lost),
        });
    }
    let is_bounded = |one: &CountedDoubt| match one.doubt {
        Doubt::Unread(why) => why != Unread::Aggregate,
        Doubt::Dropped | Doubt::Filtered { .. } => true,
        Doubt::Pieces | Doubt::Order | Doubt::Apart | Doubt::Unwatched => false,
    };
    let unseen_count: u64 = doubts.iter().map(|one| one.count).sum();
    let range = count > 0 && doubts.iter().all(is_bounded);
    Loss::Unavailable {
        range: range.then(|| (count.saturating_sub(unseen_count), count)),
        doubts,
    }
}

fn metrics(
    stream: &Stream,
    order: OrderSource,
    first: &Side<'_>,
    second: &Side<'_>,
    pairs: &[Pair],
    matches: &Matches,
) -> JoinMetrics {
    // A datagram would have had its other stamp while the point was watched, however fast or slow it
    // was among those seen; the rest of what was seen at one point only lies at an edge.
    let levels = Levels::of(first, second, matches);
    let mut lost = matches.only_first.clone();
    lost.retain(|index| {
        let at = first.at_ns[*index];
        let (fastest, slowest) = levels.bounds_at(at);
        second.covers(at.saturating_add(fastest), at.saturating_add(slowest))
    });
    let mut unexplained = matches.only_second.clone();
    unexplained.retain(|index| {
        let at = second.at_ns[*index];
        let is_after = at >= levels.shift_arrival_ns();
        let (fastest, slowest) = levels.bounds[usize::from(is_after)];
        first.covers(at.saturating_sub(slowest), at.saturating_sub(fastest))
    });
    let observations = |side: &Side<'_>, list: &[usize]| -> Vec<Observation> {
        list.iter().map(|index| side.seen[*index]).collect()
    };
    let alone = [
        observations(first, &lost),
        observations(second, &unexplained),
    ];
    let alone = [&alone[0][..], &alone[1]];
    let doubts = doubts(stream, order, [first, second], matches, pairs, alone);
    let only_count = matches.only_first.len() + matches.only_second.len();
    let matched_count = pairs.len() as u64;
    let clock_steps = [first.steps(), second.steps()];
    let is_set = clock_steps.iter().any(|steps| !steps.is_empty());
    let arrivals = matches.arrivals(second);
    let (late, _) = reordered(arrivals.iter().map(|departure| *departure as u64));
    let reordered_count = late.len() as u64;
    // Where a clock was set, no delay is known.
    let is_delay = |departure: &&usize| !is_set && pairs[**departure].is_stamped();
    let in_arrival = arrivals.iter().filter(is_delay);
    let in_arrival: Vec<i64> = in_arrival
        .map(|departure| levels.delays[*departure])
        .collect();
    let in_departure: Vec<usize> = (0..pairs.len()).collect();
    let delays = in_departure.iter().filter(is_delay);
    let delays: Vec<i64> = delays.map(|departure| levels.delays[*departure]).collect();
    let jitter = jitter_ns(&in_arrival);
    let series: Samples = delays.iter().copied().collect();
    let ascending = series.ascending();
    let quantiles = Quantiles::of(&series, &ascending);
    let unmatched = if is_set {
        "a clock was set while it stamped"
    } else {
        "no datagram was stamped at both points"
    };
    let fastest = delays.iter().min().copied().unwrap_or(0);
    let variation = delays.iter().map(|delay| delay.saturating_sub(fastest));
    let neighbours = (1..pairs.len()).filter(|at| {
        matches.pairs[at - 1].0 + 1 == matches.pairs[*at].0 && is_delay(&&(at - 1)) && is_delay(&at)
    });
    let successive = neighbours.map(|at| {
        let difference = levels.delays[at].saturating_sub(levels.delays[at - 1]);
        difference.saturating_abs()
    });
    let mut duplicates = matches.duplicates.iter();
    let may_be_copies = second.seen.iter().any(|one| one.has_copy)
        || duplicates.any(|index| second.seen[*index].is_of_any);
    let gaps = second.at_ns.windows(2);
    let gaps = gaps.map(|pair| pair[1].saturating_sub(pair[0]));
    JoinMetrics {
        order,
        first_count: first.seen.len() as u64,
        second_count: second.seen.len() as u64,
        matched_count,
        edge_count: (only_count - lost.len() - unexplained.len()) as u64,
        loss: loss(&lost, matches, doubts),
        duplicated_count: (!may_be_copies).then_some(matches.duplicates.len() as u64),
        unexplained_count: unexplained.len() as u64,
        delay_shift: levels.shift.filter(|_| !is_set),
        delay: distribution(delays.iter().copied(), unmatched),
        delay_p50_interval: quantiles.interval(0.5),
        delay_p99_interval: quantiles.interval(0.99),
        variation: distribution(variation, unmatched),
        successive: distribution(successive, unmatched),
        jitter_last_ns: jitter.map(|(last, _)| last),
        jitter_mean_ns: jitter.map(|(_, mean)| mean),
        reordered_count,
        reordering_extent_max: late.iter().map(|one| one.extent).max().unwrap_or(0),
        reordering_n_max: late.iter().map(|one| one.n).max().unwrap_or(0),
        arrival_interval: distribution(gaps, "fewer than two arrivals"),
        clock_steps,
    }
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
