//! Which points are joined for which stream: all that saw it, and those that should have seen it and
//! did not. The joining itself is in [`super::join`].
//!
//! A point that saw nothing of a stream is held against one that did only if the stream was to come
//! by there: the way between the two leads there by their directions, the point was watched, and it
//! saw other datagrams between the same two addresses, or to the same address. A point of another
//! file that saw no followed datagram at all counts too: whoever names two captures means two points
//! of one way. Points of one host of which each saw a part of a stream count as one.

use std::collections::BTreeSet;

use super::join::{JoinSettings, Joined, Sight, common_count, differences, join};
use super::observe::{Observer, Point, Seen, Stream};
use super::watch::{Tap, Watch};
use hil_net::Direction;

/// Farthest in time that datagrams there and back may lie apart to make a round trip, and how fast two clocks may
/// drift apart meanwhile.
const ROUND_TRIP_APART_MAX_NS: i64 = 1_000_000_000;
const DRIFT_MAX_PPM: i64 = 200;
/// Two points of a host of which one in so many datagrams passed both are on one way, not on two.
const COMMON_SHARE: usize = 10;

/// Points of one host over which a stream went in parts.
struct Parts<'a> {
    point: Point,
    also: Vec<Point>,
    watch: Watch,
    seen: Seen,
    beside: Vec<&'a Watch>,
}

impl Parts<'_> {
    fn sight(&self) -> Sight<'_> {
        Sight {
            point: &self.point,
            watch: &self.watch,
            seen: &self.seen,
            also: &self.also,
            beside: &self.beside,
        }
    }
}

/// Every stream at every two points it passed or should have passed.
pub fn join_all(observer: &Observer, settings: &JoinSettings) -> Vec<(Stream, Joined)> {
    let unwatched = Watch::default();
    let all: Vec<&Point> = observer.seen().keys().collect();
    let beside: Vec<Vec<&Watch>> = all
        .iter()
        .map(|point| other_taps(observer, &BTreeSet::from([point.tap()])))
        .collect();
    let points: Vec<Sight<'_>> = observer
        .seen()
        .iter()
        .zip(&beside)
        .map(|((point, seen), beside)| Sight {
            point,
            watch: observer.watches().get(&point.tap()).unwrap_or(&unwatched),
            seen,
            also: &[],
            beside,
        })
        .collect();
    let streams = points.iter().flat_map(|sight| sight.seen.keys());
    let streams: BTreeSet<&Stream> = streams.collect();
    let mut found = Vec::new();
    for stream in streams {
        let groups = groups(stream, &points, settings.window_ns);
        let parts: Vec<Option<Parts<'_>>> = groups
            .iter()
            .map(|group| (group.len() > 1).then(|| together(stream, &points, group, observer)))
            .collect();
        let sights: Vec<Sight<'_>> = groups
            .iter()
            .zip(&parts)
            .map(|(group, parts)| parts.as_ref().map_or(points[group[0]], Parts::sight))
            .collect();
        let mut join_two = |a: Sight<'_>, b: Sight<'_>| {
            let round_trip = || comes_first(stream, a, b, settings.window_ns);
            let is_two_clocks = !settings.is_one_clock
                && !a.is_of_host_of(&b)
                && a.point.direction == Direction::Unknown;
            let round_trip = is_two_clocks.then(round_trip).flatten();
            let joined = join(stream, a, b, settings, round_trip);
            found.extend(joined.map(|joined| (*stream, joined)));
        };
        // Each two once, in the order of the files.
        for (at, a) in sights.iter().enumerate() {
            sights[at + 1..].iter().for_each(|b| join_two(*a, *b));
        }
        if let ([sight], [group]) = (&sights[..], &groups[..]) {
            for (at, other) in points.iter().enumerate() {
                let is_wanted =
                    |here: &usize| is_expected(stream, points[*here].point, other.point, observer);
                if group.contains(&at) || !group.iter().any(is_wanted) {
                    continue;
                }
                if at > group[0] {
                    join_two(*sight, *other);
                } else {
                    join_two(*other, *sight);
                }
            }
        }
    }
    found.sort_by_key(|(stream, joined)| (*stream, joined.first_point));
    found
}

/// What the other taps of the host of these could see.
fn other_taps<'a>(observer: &'a Observer, taps: &BTreeSet<Tap>) -> Vec<&'a Watch> {
    let watches = observer.watches().iter();
    let of_host = watches.filter(|(tap, watch)| {
        let is_of_file = taps.iter().any(|one| one.file_index == tap.file_index);
        is_of_file && !taps.contains(tap) && !watch.is_merged
    });
    of_host.map(|(_, watch)| watch).collect()
}

/// The points that saw a stream, those of one host together of which each saw a part: another interface of a bond or
/// after it was plugged in anew, another tag, packets whose direction is not told.
fn groups(stream: &Stream, points: &[Sight<'_>], window_ns: i64) -> Vec<Vec<usize>> {
    let mut groups: Vec<Vec<usize>> = Vec::new();
    for (at, sight) in points.iter().enumerate() {
        let Some(seen) = sight.seen.get(stream) else {
            continue;
        };
        let is_part = |other: &usize| {
            let other = points[*other];
            let count = other.seen.get(stream).map_or(0, Vec::len).min(seen.len());
            let (here, there) = (sight.point, other.point);
            let directions = [here.direction, there.direction];
            let is_one_way =
                here.direction == there.direction || directions.contains(&Direction::Unknown);
            count > 0
                && is_one_way
                && here.esl_port.is_some() == there.esl_port.is_some()
                && sight.is_of_host_of(&other)
                && COMMON_SHARE * common_count(stream, other, *sight, window_ns) <= count
        };
        match groups.iter_mut().find(|group| group.iter().all(is_part)) {
            Some(group) => group.push(at),
            None => groups.push(vec![at]),
        }
    }
    groups
}

/// What the points of a group saw of a stream, as one.
fn together<'a>(
    stream: &Stream,
    points: &[Sight<'_>],
    group: &[usize],
    observer: &'a Observer,
) -> Parts<'a> {
    let members = || group.iter().map(|at| points[*at]);
    // One that tells its direction tells that of all.
    let mut known = members().map(|sight| *sight.point);
    let known = known.find(|point| point.direction != Direction::Unknown);
    let point = known.unwrap_or(*points[group[0]].point);
    let mut watch = points[group[0]].watch.clone();
    let mut taps = BTreeSet::from([point.tap()]);
    for sight in members() {
        if taps.insert(sight.point.tap()) {
            watch.absorb(sight.watch.clone());
        }
    }
    let seen = members().filter_map(|sight| sight.seen.get(stream));
    Parts {
        point,
        also: members()
            .map(|sight| *sight.point)
            .filter(|one| *one != point)
            .collect(),
        watch,
        beside: other_taps(observer, &taps),
        seen: Seen::from([(*stream, seen.flatten().copied().collect())]),
    }
}

/// Whether `b` comes before `a`, by streams the other way between the same two hosts at the same two
/// points: there and back takes a positive time in the right order, whatever the clocks. Only what is near in time
/// tells: clocks drift.
fn comes_first(stream: &Stream, a: Sight<'_>, b: Sight<'_>, window_ns: i64) -> Option<bool> {
    let is_back = |one: &&Stream| {
        (one.source.ip(), one.destination.ip()) == (stream.destination.ip(), stream.source.ip())
    };
    let back = a.seen.keys().filter(is_back);
    let back = back.flat_map(|one| differences(one, a, b, window_ns));
    let mut back: Vec<(i64, i64)> = back.collect();
    back.sort_unstable();
    let unit_ns = a.watch.unit_ns.max(b.watch.unit_ns);
    let round_trip_ns = |(at_ns, there_ns): (i64, i64)| {
        let next = back.partition_point(|(at, _)| *at < at_ns);
        let around = back[next.saturating_sub(1)..].iter().take(2);
        let apart = |one: &&(i64, i64)| at_ns.saturating_sub(one.0).saturating_abs();
        let nearest = around.min_by_key(apart)?;
        let apart_ns = apart(&nearest);
        let unsure_ns = apart_ns / 1_000_000 * DRIFT_MAX_PPM + 2 * unit_ns;
        let round_trip_ns = there_ns.saturating_sub(nearest.1);
        let is_sure =
            apart_ns <= ROUND_TRIP_APART_MAX_NS && round_trip_ns.saturating_abs() > unsure_ns;
        is_sure.then_some(round_trip_ns)
    };
    let there = differences(stream, a, b, window_ns).into_iter();
    let round_trips: Vec<i64> = there.filter_map(round_trip_ns).collect();
    let below_count = round_trips.iter().filter(|ns| **ns < 0).count();
    let minority = below_count.min(round_trips.len() - below_count);
    let is_told = !round_trips.is_empty() && 10 * minority <= round_trips.len();
    is_told.then_some(2 * below_count > round_trips.len())
}

/// True when `stream`, seen at `at`, was to be seen at the other point.
fn is_expected(stream: &Stream, at: &Point, point: &Point, observer: &Observer) -> bool {
    // Out here, in there; into a host and out of it, or out of another whose capture has missed it.
    let is_on_its_way = match at.direction {
        Direction::Inbound => point.direction != Direction::Unknown,
        Direction::Outbound | Direction::Unknown => point.direction != Direction::Outbound,
    };
    if at.place() == point.place() || !is_on_its_way {
        return false;
    }
    let (source, destination) = (stream.source.ip(), stream.destination.ip());
    let of_tap = observer.seen().iter();
    let mut of_tap = of_tap.filter(|(one, _)| one.tap() == point.tap());
    let has_followed = of_tap.clone().any(|(_, seen)| !seen.is_empty());
    let here = |one: &Seen| {
        one.keys().any(|one| {
            let (from, to) = (one.source.ip(), one.destination.ip());
            (from == source && to == destination) || (from == destination && to == source)
        })
    };
    let is_between_them = of_tap.any(|(one, seen)| one.place() == point.place() && here(seen));
    let mut own = observer.seen()[point].keys();
    let has_its_target = own.any(|one| one.destination.ip() == destination);
    let is_first_of_a_file = !has_followed && at.file_index != point.file_index;
    let leaves = at.direction != Direction::Inbound;
    is_between_them || (leaves && (has_its_target || is_first_of_a_file))
}
