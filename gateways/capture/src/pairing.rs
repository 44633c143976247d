//! Which points are joined for which stream: all that saw it, and those that should have seen it and
//! did not. The joining itself is in [`super::join`].
//!
//! A point that saw nothing of a stream is held against one that did only if the stream was to come
//! by there: the way between the two leads there by their directions, the point was watched, and it
//! saw other datagrams between the same two addresses, or to the same address. A point of another
//! file that saw no followed datagram at all counts too: whoever names two captures means two points
//! of one way.

use super::join::{JoinSettings, Joined, Sight, join, median_difference_ns};
use super::observe::{Observer, Point, Seen, Stream};
use super::watch::Watch;
use hil_net::Direction;

/// Every stream at every two points it passed or should have passed.
pub fn join_all(observer: &Observer, settings: &JoinSettings) -> Vec<(Stream, Joined)> {
    let unwatched = Watch::default();
    let points: Vec<Sight<'_>> = observer
        .seen()
        .iter()
        .map(|(point, seen)| Sight {
            point,
            watch: observer.watches().get(&point.tap()).unwrap_or(&unwatched),
            seen,
        })
        .collect();
    let mut found = Vec::new();
    for (index, a) in points.iter().enumerate() {
        for stream in a.seen.keys() {
            let saw_it = |sight: &Sight<'_>| sight.seen.contains_key(stream);
            let others = points.iter().enumerate().filter(|(at, _)| *at != index);
            let is_elsewhere = others.clone().any(|(_, sight)| saw_it(sight));
            for (at, b) in others {
                let is_wanted = if is_elsewhere {
                    // Each two once.
                    at > index && saw_it(b)
                } else {
                    is_expected(stream, a.point, b.point, observer)
                };
                if !is_wanted {
                    continue;
                }
                // In the order of the files.
                let (a, b) = if at > index { (*a, *b) } else { (*b, *a) };
                let round_trip = || comes_first(stream, a, b, settings.window_ns);
                let is_two_clocks = !settings.is_one_clock
                    && !a.is_of_host_of(&b)
                    && a.point.direction == Direction::Unknown;
                let round_trip = is_two_clocks.then(round_trip).flatten();
                let joined = join(stream, a, b, settings, round_trip);
                found.extend(joined.map(|joined| (*stream, joined)));
            }
        }
    }
    found.sort_by_key(|(stream, joined)| (*stream, joined.first_point));
    found
}

/// Whether `b` comes before `a`, by streams the other way between the same two hosts at the same two
/// points: there and back takes a positive time in the right order, whatever the clocks.
fn comes_first(stream: &Stream, a: Sight<'_>, b: Sight<'_>, window_ns: i64) -> Option<bool> {
    let there_ns = median_difference_ns(stream, a, b, window_ns)?;
    let is_back = |one: &&Stream| {
        (one.source.ip(), one.destination.ip()) == (stream.destination.ip(), stream.source.ip())
    };
    let mut back = a.seen.keys().filter(is_back);
    let back_ns = back.find_map(|one| median_difference_ns(one, a, b, window_ns))?;
    match there_ns.checked_sub(back_ns)? {
        0 => None,
        round_trip_ns => Some(round_trip_ns < 0),
    }
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
