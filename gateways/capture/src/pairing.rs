//! Which points are joined for which stream: all that saw it, and those that should have seen it and
//! did not. The joining itself is in [`super::join`].
//!
//! A point that saw nothing of a stream is held against one that did only if the stream was to come
//! by there: the way between the two leads there by their directions, the point was watched, and it
//! saw other datagrams between the same two addresses, or to the same address. A point of another
//! file that saw no followed datagram at all counts too: whoever names two captures means two points
//! of one way.

use super::join::{Joined, join};
use super::observe::{Observer, Point, Seen, Stream};
use hil_net::Direction;

/// Every stream at every two points it passed or should have passed. Stamps of one datagram lie at
/// most `window_ns` apart.
pub fn join_all(observer: &Observer, window_ns: i64) -> Vec<(Stream, Joined)> {
    let points: Vec<(&Point, &Seen)> = observer.seen().iter().collect();
    let mut found = Vec::new();
    for (index, (a, seen_a)) in points.iter().enumerate() {
        for stream in seen_a.streams.keys() {
            let saw_it = |seen: &Seen| seen.streams.contains_key(stream);
            let others = points.iter().enumerate().filter(|(at, _)| *at != index);
            let is_elsewhere = others.clone().any(|(_, (_, seen))| saw_it(seen));
            for (at, (b, seen_b)) in others {
                let is_wanted = if is_elsewhere {
                    // Each two once.
                    at > index && saw_it(seen_b)
                } else {
                    is_expected(stream, a, b, observer)
                };
                let joined = join(stream, a, seen_a, b, seen_b, window_ns);
                found.extend(joined.filter(|_| is_wanted).map(|joined| (*stream, joined)));
            }
        }
    }
    found.sort_by_key(|(stream, joined)| (*stream, joined.first_point));
    found
}

/// True when `stream`, seen at `at`, was to be seen at the other point.
fn is_expected(stream: &Stream, at: &Point, point: &Point, observer: &Observer) -> bool {
    let place = |point: &Point| (point.file_index, point.interface_index, point.esl_port);
    // Out here, in there; into a host and out of it, or out of another whose capture has missed it.
    let is_on_its_way = match (at.direction, point.direction) {
        (Direction::Outbound, direction) => direction == Direction::Inbound,
        (Direction::Inbound, direction) => direction != Direction::Unknown,
        (Direction::Unknown, direction) => direction == Direction::Unknown,
    };
    if place(at) == place(point) || !is_on_its_way {
        return false;
    }
    let (source, destination) = (stream.source.ip(), stream.destination.ip());
    let here = observer.seen().iter();
    let here = here.filter(|(one, _)| place(one) == place(point));
    let mut here = here.flat_map(|(_, seen)| seen.streams.keys()).peekable();
    let has_followed = here.peek().is_some();
    let is_between_them = here.any(|one| {
        let (from, to) = (one.source.ip(), one.destination.ip());
        (from == source && to == destination) || (from == destination && to == source)
    });
    let mut own = observer.seen()[point].streams.keys();
    let has_its_target = own.any(|one| one.destination.ip() == destination);
    let is_first_of_a_file = !has_followed && at.file_index != point.file_index;
    let leaves = at.direction != Direction::Inbound;
    is_between_them || (leaves && (has_its_target || is_first_of_a_file))
}
