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

use core::cmp::{Ordering, Reverse};
use core::ops::Range;
use std::collections::{BTreeMap, BTreeSet};

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
/// One in so many stamps equal to the one before shows a clock that ticks more coarsely than datagrams come.
const EQUAL_SHARE: usize = 10;
/// One in so many datagrams whose identity came before shows that identities come again.
const LAPPED_SHARE: usize = 10;

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
    /// Which point comes first is unknown, or told in two ways.
    Order,
    /// Seen at both points, farther apart than [`JoinSettings::window_ns`].
    Apart,
    /// Their identities come again sooner than the delays tell which belongs to which.
    Ambiguous,
    /// The like was seen there under other addresses, which this point never saw.
    Readdressed,
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
    /// Changes of the delays that no stamp of one point shows.
    pub delay_shifts: Vec<DelayShift>,
    /// Second stamp minus first; unavailable when a clock was set meanwhile, or may have been.
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
    /// Further points of the same two hosts over which a part of it went: see [`Sight::also`].
    pub also: [Vec<Point>; 2],
    /// What was seen at both, in the order of departure.
    pub pairs: Vec<Pair>,
    /// The figures.
    pub figures: JoinMetrics,
    /// To how many nanoseconds the coarser stamps are whole.
    pub unit_ns: i64,
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
    /// Further points of its host: what passed one of them did not pass the others, and counts as seen here.
    pub also: &'a [Point],
    /// What the other taps of its host could see.
    pub beside: &'a [&'a Watch],
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

    /// To how many nanoseconds its stamps are whole: as its file says, or coarser where many of them are equal.
    fn unit_ns(&self) -> i64 {
        // One that is not sound has a neighbour's.
        let sound = self.seen.iter().zip(&self.at_ns);
        let sound = sound.filter_map(|(one, at_ns)| one.is_stamp_sound.then_some(*at_ns));
        let sound: Vec<i64> = sound.collect();
        let neighbours = sound.windows(2);
        let on_ns = neighbours.map(|pair| pair[1].saturating_sub(pair[0]));
        let equal_count = on_ns.clone().filter(|on_ns| *on_ns == 0).count();
        let stated_ns = self.sight.watch.unit_ns.max(1);
        if EQUAL_SHARE * equal_count < sound.len() {
            return stated_ns;
        }
        let common = on_ns.fold(0, |a, b| {
            let (mut a, mut b) = (a, b);
            while b != 0 {
                (a, b) = (b, a % b);
            }
            a
        });
        stated_ns.max(common)
    }

    /// After what time identities come again, where they do as a rule.
    fn lap_ns(&self) -> Option<i64> {
        let mut newest = BTreeMap::new();
        let times = self.seen.iter().zip(&self.at_ns);
        let again = times.filter_map(|(one, at_ns)| {
            let before = newest.insert(one.identity.key, *at_ns)?;
            Some(at_ns.saturating_sub(before))
        });
        let again: Vec<i64> = again.collect();
        let is_rule = !again.is_empty() && LAPPED_SHARE * again.len() >= self.seen.len();
        is_rule.then(|| median(&again))
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
    let ends = ends(&first, &second, &matches, is_one_clock, round_trip);
    let unit_ns = first.unit_ns().max(second.unit_ns());
    let matches = if ends.is_swapped {
        core::mem::swap(&mut first, &mut second);
        Matches::within(&first, &second, settings.window_ns)
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
        also: [&first, &second].map(|side| side.sight.also.to_vec()),
        figures: metrics(stream, &ends, &first, &second, &pairs, &matches),
        pairs,
        unit_ns,
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
            let matches = Matches::within(&first, second, window_ns);
            let fit = Fit {
                matched_count: matches.pairs.len(),
                reordered_count: Reverse(matches.reordered_count()),
                spread_ns: Reverse(width(&matches.delays(&first, second))),
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
    spread_ns: Reverse<i64>,
}

/// How the ends are told apart.
struct Ends {
    order: OrderSource,
    /// The second comes first.
    is_swapped: bool,
    /// Something else tells the contrary.
    is_disputed: bool,
}

/// How the ends are told apart: by what no clock changes, by stamps where they can tell, by what the packets say
/// of their direction.
fn ends(
    first: &Side<'_>,
    second: &Side<'_>,
    matches: &Matches,
    is_one_clock: bool,
    round_trip: Option<bool>,
) -> Ends {
    let sure = |order, is_swapped| Ends {
        order,
        is_swapped,
        is_disputed: false,
    };
    let hops = |&(i, j): &(usize, usize)| (first.seen[i].hop_limit, second.seen[j].hop_limit);
    let count = |is_so: &dyn Fn(&(usize, usize)) -> bool| {
        matches.pairs.iter().filter(|pair| is_so(pair)).count()
    };
    let lowered = count(&|pair| hops(pair).0 > hops(pair).1);
    let raised = count(&|pair| hops(pair).0 < hops(pair).1);
    let all = matches.pairs.len();
    if all > 0 && lowered.max(raised) == all {
        return sure(OrderSource::HopLimit, raised == all);
    }
    let levels = Levels::of(first, second, matches);
    // A clock that was set is not one with another.
    let is_steady = [first, second]
        .iter()
        .all(|side| side.reading == Reading::Stamps);
    let by_stamps = (is_one_clock && is_steady)
        .then(|| levels.is_backward(first.unit_ns().max(second.unit_ns())))
        .flatten();
    let (a, b) = (first.sight.point, second.sight.point);
    // Through a host with two taps the way is in, then out; but both then read one clock.
    let by_direction = match (a.direction, b.direction) {
        _ if a.file_index == b.file_index => None,
        (Direction::Outbound, Direction::Inbound) => Some(false),
        (Direction::Inbound, Direction::Outbound) => Some(true),
        _ => None,
    };
    if let Some(is_swapped) = by_direction {
        // Two files of one host that forwards, or clocks that are not one.
        return Ends {
            is_disputed: by_stamps == Some(!is_swapped),
            ..sure(OrderSource::PacketDirection, is_swapped)
        };
    }
    if let Some(is_swapped) = by_stamps {
        return sure(OrderSource::Stamps, is_swapped);
    }
    if let Some(is_swapped) = round_trip {
        return sure(OrderSource::RoundTrip, is_swapped);
    }
    // What lies at an edge is missing because of when the captures began and ended.
    let [only_first, only_second] = levels.alone([first, second], matches);
    let by_missing = |is_swapped, lacking: &Side<'_>, other: &Side<'_>| Ends {
        // Else its capture may have missed what the other has: against the order in which the points were named,
        // only a file that states that it dropped nothing tells.
        is_disputed: is_swapped
            && !lacking.seen.is_empty()
            && !other.seen.is_empty()
            && !lacking.sight.watch.is_complete,
        ..sure(OrderSource::Missing, is_swapped)
    };
    match (only_first.is_empty(), only_second.is_empty()) {
        (false, true) => by_missing(false, second, first),
        (true, false) => by_missing(true, first, second),
        _ => sure(OrderSource::Unknown, false),
    }
}

/// When each datagram seen at both points was seen at `a`, and how much later at `b`; none where a clock was set.
pub(super) fn differences(
    stream: &Stream,
    a: Sight<'_>,
    b: Sight<'_>,
    window_ns: i64,
) -> Vec<(i64, i64)> {
    let Some((first, second, matches)) = best_reading(stream, a, b, window_ns) else {
        return Vec::new();
    };
    let levels = Levels::of(&first, &second, &matches);
    let is_set = [&first, &second].map(|side| side.reading != Reading::Stamps);
    if is_set.contains(&true) || levels.each.len() > 1 {
        return Vec::new();
    }
    let times = matches.pairs.iter().map(|(i, _)| first.at_ns[*i]);
    let each = times.zip(levels.delays).zip(levels.is_stamped);
    each.filter_map(|(one, is_stamped)| is_stamped.then_some(one))
        .collect()
}

/// How many datagrams were seen at both.
pub(super) fn common_count(stream: &Stream, a: Sight<'_>, b: Sight<'_>, window_ns: i64) -> usize {
    best_reading(stream, a, b, window_ns).map_or(0, |(_, _, matches)| matches.pairs.len())
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
    /// Identities come again sooner than the delays tell which belongs to which.
    is_ambiguous: bool,
}

impl Matches {
    /// As told by [`Self::of`]. Where identities come again and the delays show that some were taken for those of the
    /// next lap, only those within half a lap around the median belong together.
    fn within(first: &Side<'_>, second: &Side<'_>, window_ns: i64) -> Self {
        let matches = Self::of(first, second, 0, window_ns);
        let laps = first.lap_ns().zip(second.lap_ns());
        let Some(lap_ns) = laps.map(|(a, b)| a.min(b)) else {
            return matches;
        };
        let delays = matches.delays(first, second);
        if width(&delays) < lap_ns / 2 || lap_ns / 2 >= window_ns {
            return matches;
        }
        let mut near = Self::of(first, second, median(&delays), lap_ns / 2);
        near.is_ambiguous = width(&near.delays(first, second)) > lap_ns / 4
            || 10 * near.pairs.len() < 9 * matches.pairs.len()
            || near.apart_count > 0;
        near
    }

    fn delays(&self, first: &Side<'_>, second: &Side<'_>) -> Vec<i64> {
        let pairs = self.pairs.iter();
        let delays = pairs.map(|&(i, j)| second.at_ns[j].saturating_sub(first.at_ns[i]));
        delays.collect()
    }

    /// Of equal keys the earliest at one point belongs to the earliest at the other that is within
    /// the window around a delay; what remains at the second beside a match is a repetition.
    fn of(first: &Side<'_>, second: &Side<'_>, delay_ns: i64, window_ns: i64) -> Self {
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
                let late_ns = |index: &usize| since(first.at_ns[*index]).saturating_sub(delay_ns);
                match from.get(i).map(late_ns) {
                    Some(late_ns) if late_ns > window_ns => {
                        matches.only_first.push(from[i]);
                        i += 1;
                        continue;
                    }
                    Some(late_ns) if late_ns >= -window_ns => {
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
    fn arrivals(&self) -> Vec<usize> {
        let mut arrivals: Vec<usize> = (0..self.pairs.len()).collect();
        // Of equal stamps the file tells which came first.
        arrivals.sort_by_key(|departure| self.pairs[*departure].1);
        arrivals
    }

    fn reordered_count(&self) -> usize {
        let mut latest = 0;
        let arrivals = self.arrivals().into_iter();
        let late = arrivals.filter(|departure| {
            latest = latest.max(*departure);
            *departure < latest
        });
        late.count()
    }
}

/// Datagrams in a row whose delays are on one level.
struct DelayLevel {
    /// Departure of the first one; of the first level, since ever.
    from_ns: i64,
    /// Which of the pairs.
    places: Range<usize>,
    /// Smallest and largest delay.
    bounds: (i64, i64),
}

/// Delays of the datagrams at both points, in the order of departure, and the level each is on.
struct Levels {
    /// In the reading of both points.
    delays: Vec<i64>,
    /// Which of them are of sound stamps.
    is_stamped: Vec<bool>,
    /// At least one, in the order of departure.
    each: Vec<DelayLevel>,
}

impl Levels {
    fn of(first: &Side<'_>, second: &Side<'_>, matches: &Matches) -> Self {
        let pairs = matches.pairs.iter();
        let delays = matches.delays(first, second);
        let is_stamped = |&(i, j): &(usize, usize)| {
            first.seen[i].is_stamp_sound && second.seen[j].is_stamp_sound
        };
        let mut starts = vec![0];
        level_starts(&delays, 0, &mut starts);
        let ends = starts.iter().skip(1).copied().chain([delays.len()]);
        let each = starts.iter().zip(ends).map(|(from, to)| {
            let here = &delays[*from..to];
            let least = here.iter().min().copied().unwrap_or(0);
            DelayLevel {
                from_ns: match from {
                    0 => i64::MIN,
                    _ => first.at_ns[matches.pairs[*from].0],
                },
                places: *from..to,
                bounds: (least, here.iter().max().copied().unwrap_or(0)),
            }
        });
        Self {
            each: each.collect(),
            is_stamped: pairs.map(is_stamped).collect(),
            delays,
        }
    }

    fn shifts(&self) -> Vec<DelayShift> {
        let median = |level: &DelayLevel| median(&self.delays[level.places.clone()]);
        let pairs = self.each.windows(2);
        pairs
            .map(|pair| DelayShift {
                from_ns: pair[1].from_ns,
                by_ns: median(&pair[1]).saturating_sub(median(&pair[0])),
            })
            .collect()
    }

    /// Of those seen at one point only, at the first and at the second, what the other would have shown. A datagram
    /// would have had its other stamp while the point was watched, however fast or slow it was among
    /// those seen; the rest lies at an edge.
    fn alone(&self, [first, second]: [&Side<'_>; 2], matches: &Matches) -> [Vec<usize>; 2] {
        let last_until = |is_past: &dyn Fn(&DelayLevel) -> bool| {
            let later = self.each.iter().skip(1).rev();
            let level = later.clone().find(|level| is_past(level));
            level.or(self.each.first()).map_or((0, 0), |one| one.bounds)
        };
        let is_lost = |index: &usize| {
            let at = first.at_ns[*index];
            let (fastest, slowest) = last_until(&|level| at >= level.from_ns);
            second.covers(at.saturating_add(fastest), at.saturating_add(slowest))
        };
        let is_unexplained = |index: &usize| {
            let at = second.at_ns[*index];
            let arrival_ns = |level: &DelayLevel| level.from_ns.saturating_add(level.bounds.0);
            let (fastest, slowest) = last_until(&|level| at >= arrival_ns(level));
            first.covers(at.saturating_sub(slowest), at.saturating_sub(fastest))
        };
        let mut alone = [matches.only_first.clone(), matches.only_second.clone()];
        alone[0].retain(is_lost);
        alone[1].retain(is_unexplained);
        alone
    }

    /// Whether most stamps tell that the second comes first, where they differ by more than their unit; `None` where
    /// none does, or where a change of the level turns that round.
    fn is_backward(&self, unit_ns: i64) -> Option<bool> {
        let mut found = None;
        for level in &self.each {
            let places = level.places.clone();
            let stamped = places.filter(|place| self.is_stamped[*place]);
            let delays: Vec<i64> = stamped.map(|place| self.delays[place]).collect();
            let below = delays.iter().filter(|delay| **delay <= -unit_ns).count();
            let above = delays.iter().filter(|delay| **delay >= unit_ns).count();
            let here = match below.cmp(&above) {
                _ if 2 * below.max(above) < delays.len() => return None,
                Ordering::Equal => continue,
                more => more == Ordering::Greater,
            };
            if found.is_some_and(|known| known != here) {
                return None;
            }
            found = Some(here);
        }
        found
    }
}

/// Adds where the delays begin to lie on another level: groups of values apart by more than each is wide, of which
/// each holds [`SHIFT_SIDE_MIN`] datagrams in a row whenever it holds one.
fn level_starts(delays: &[i64], from: usize, starts: &mut Vec<usize>) {
    let mut ascending = delays.to_vec();
    ascending.sort_unstable();
    let gap_ns = |at: &usize| ascending[*at].saturating_sub(ascending[at - 1]);
    let mut gaps: Vec<usize> = (1..ascending.len()).collect();
    gaps.retain(|at| gap_ns(at) > SHIFT_MIN_NS);
    gaps.sort_by_key(|at| Reverse(gap_ns(at)));
    let groups = (1..=gaps.len()).find_map(|count| {
        let mut begins = gaps[..count].to_vec();
        begins.sort_unstable();
        let ends = begins.iter().copied().chain([ascending.len()]);
        let widths = [0]
            .iter()
            .chain(&begins)
            .zip(ends)
            .map(|(begin, end)| ascending[end - 1].saturating_sub(ascending[*begin]));
        let width = widths.max().unwrap_or(0);
        (gap_ns(&gaps[count - 1]) > width.saturating_mul(4)).then_some(begins)
    });
    let Some(begins) = groups else {
        return;
    };
    let least: Vec<i64> = begins.iter().map(|at| ascending[*at]).collect();
    let group = |delay: &i64| least.partition_point(|begin| begin <= delay);
    let runs: Vec<&[i64]> = delays.chunk_by(|a, b| group(a) == group(b)).collect();
    if runs.iter().any(|run| run.len() < SHIFT_SIDE_MIN) {
        return;
    }
    let mut at = from;
    for run in runs {
        if at > from {
            starts.push(at);
        }
        level_starts(run, at, starts);
        at += run.len();
    }
}

/// From the smallest to the largest.
fn width(values: &[i64]) -> i64 {
    let bounds = values.iter().min().zip(values.iter().max());
    bounds.map_or(0, |(least, most)| most.saturating_sub(*least))
}

fn median(values: &[i64]) -> i64 {
    let mut sorted = values.to_vec();
    sorted.sort_unstable();
    sorted.get(sorted.len() / 2).copied().unwrap_or(0)
}

/// Why datagrams that the second point does not show may have passed it.
fn doubts(
    stream: &Stream,
    ends: &Ends,
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
    if alone_count > 0 && (ends.order == OrderSource::Unknown || ends.is_disputed) {
        add(Doubt::Order, alone_count);
    }
    let in_pieces = pairs.iter().filter(|pair| pair.second.lacks_pieces);
    add(Doubt::Pieces, in_pieces.count());
    add(Doubt::Apart, matches.apart_count);
    if matches.is_ambiguous {
        add(Doubt::Ambiguous, pairs.len() + alone_count);
    }
    for (side, other, list) in [(first, second, alone[0]), (second, first, alone[1])] {
        add(
            Doubt::Readdressed,
            readdressed_count(stream, list, side, other),
        );
    }
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
        let unread = watch.unread_of(stream.flow_index, source, destination, is_seen);
        // What is broken in a file is counted at each of its taps.
        let beside = side.sight.beside.iter();
        let beside =
            beside.flat_map(|watch| watch.unread_of(stream.flow_index, source, destination, true));
        let beside = beside.filter(|(why, _)| *why != Unread::Malformed);
        for (why, count) in unread.into_iter().chain(beside) {
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

/// How many of `list`, seen at one point only, are nearly all of a stream that only the other point saw: an
/// address was translated on the way.
fn readdressed_count(
    stream: &Stream,
    list: &[Observation],
    side: &Side<'_>,
    other: &Side<'_>,
) -> usize {
    let keys: BTreeSet<u64> = list.iter().map(|one| one.identity.key).collect();
    let streams = other.sight.seen.iter().filter(|(one, _)| {
        (one.flow_index, one.own) == (stream.flow_index, stream.own)
            && !side.sight.seen.contains_key(one)
    });
    let counts = streams.map(|(_, seen)| {
        let found = seen.iter().map(|one| one.identity.key);
        let found: Vec<u64> = found.filter(|key| keys.contains(key)).collect();
        let is_same = 5 * found.len() >= 4 * seen.len();
        let distinct: BTreeSet<u64> = found.into_iter().collect();
        if is_same && 2 * distinct.len() >= keys.len() {
            distinct.len()
        } else {
            0
        }
    });
    counts.max().unwrap_or(0)
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
        Doubt::Pieces
        | Doubt::Order
        | Doubt::Apart
        | Doubt::Ambiguous
        | Doubt::Readdressed
        | Doubt::Unwatched => false,
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
    ends: &Ends,
    first: &Side<'_>,
    second: &Side<'_>,
    pairs: &[Pair],
    matches: &Matches,
) -> JoinMetrics {
    let levels = Levels::of(first, second, matches);
    let [lost, unexplained] = levels.alone([first, second], matches);
    let observations = |side: &Side<'_>, list: &[usize]| -> Vec<Observation> {
        list.iter().map(|index| side.seen[*index]).collect()
    };
    let alone = [
        observations(first, &lost),
        observations(second, &unexplained),
    ];
    let alone = [&alone[0][..], &alone[1]];
    let doubts = doubts(stream, ends, [first, second], matches, pairs, alone);
    let only_count = matches.only_first.len() + matches.only_second.len();
    let matched_count = pairs.len() as u64;
    let clock_steps = [first.steps(), second.steps()];
    let is_set = clock_steps.iter().any(|steps| !steps.is_empty());
    let delay_shifts = if is_set { Vec::new() } else { levels.shifts() };
    let is_unsure = is_set || matches.is_ambiguous || !delay_shifts.is_empty();
    let arrivals = matches.arrivals();
    let (late, _) = reordered(arrivals.iter().map(|departure| *departure as u64));
    let reordered_count = late.len() as u64;
    // Where a clock was set, or may have been, no delay is known.
    let is_delay = |departure: &usize| !is_unsure && pairs[*departure].is_stamped();
    let delay_of = |departure: usize| levels.delays[departure];
    let in_arrival = arrivals.iter().copied().filter(is_delay);
    let in_arrival: Vec<i64> = in_arrival.map(delay_of).collect();
    let delays: Vec<i64> = (0..pairs.len()).filter(is_delay).map(delay_of).collect();
    let jitter = jitter_ns(&in_arrival);
    let series: Samples = delays.iter().copied().collect();
    let ascending = series.ascending();
    let quantiles = Quantiles::of(&series, &ascending);
    let unmatched = if is_set {
        "a clock was set while it stamped"
    } else if matches.is_ambiguous {
        "numbers come again too soon to tell which is which"
    } else if is_unsure {
        "the delays changed their level: a clock was set, or the way changed"
    } else {
        "no datagram was stamped at both points"
    };
    let fastest = delays.iter().min().copied().unwrap_or(0);
    let variation = delays.iter().map(|delay| delay.saturating_sub(fastest));
    let neighbours = (1..pairs.len()).filter(|at| {
        matches.pairs[at - 1].0 + 1 == matches.pairs[*at].0 && is_delay(&(at - 1)) && is_delay(at)
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
        order: ends.order,
        first_count: first.seen.len() as u64,
        second_count: second.seen.len() as u64,
        matched_count,
        edge_count: (only_count - lost.len() - unexplained.len()) as u64,
        loss: loss(&lost, matches, doubts),
        duplicated_count: (!may_be_copies).then_some(matches.duplicates.len() as u64),
        unexplained_count: unexplained.len() as u64,
        delay_shifts,
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
