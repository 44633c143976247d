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
    let points: Vec<_> = observer.seen().iter().collect();
    let mut found = Vec::new();
    for (index, a) in points.iter().enumerate() {
        for stream in a.1.streams.keys() {
            let others = points.iter().enumerate();
            let saw_it = |seen: &Seen| seen.streams.contains_key(stream);
            let is_elsewhere = others.clone().any(|(at, b)| at != index && saw_it(b.1));
            for (at, b) in others.filter(|(at, _)| *at != index) {
                let is_wanted = if is_elsewhere {
                    // Each two once.
                    at > index && saw_it(b.1)
                } else {
                    is_expected(stream, a.0, b.0, b.1, observer)
                };
                if let Some(joined) =
                    join(stream, a.0, a.1, b.0, b.1, window_ns).filter(|_| is_wanted)
                {
                    found.push((*stream, joined));
                }
            }
        }
    }
    found.sort_by_key(|(stream, joined)| (*stream, joined.first_point));
    found
}

/// True when `stream`, seen at `at`, was to be seen at `point`, which saw `seen`.
fn is_expected(
    stream: &Stream,
    at: &Point,
    point: &Point,
    seen: &Seen,
    observer: &Observer,
) -> bool {
    let place = |point: &Point| (point.file_index, point.interface_index, point.esl_port);
    let is_same_file = at.file_index == point.file_index;
    // Out here, in there; into a host and out of it, or out of another whose capture has missed it.
    let is_on_its_way = match (at.direction, point.direction) {
        (Direction::Outbound, direction) => direction == Direction::Inbound,
        (Direction::Inbound, direction) => direction != Direction::Unknown,
        (Direction::Unknown, direction) => direction == Direction::Unknown,
    };
    if place(at) == place(point) || !is_on_its_way {
        return false;
    }
    let ends = |one: &Stream| (one.source.ip(), one.destination.ip());
    let (source, destination) = ends(stream);
    let here = observer.seen().iter();
    let mut here = here
        .filter(|(one, _)| place(one) == place(point))
        .flat_map(|(_, seen)| seen.streams.keys())
        .peekable();
    let has_followed = here.peek().is_some();
    let is_between_them = here.any(|one| {
        let pair = ends(one);
        pair == (source, destination) || pair == (destination, source)
    });
    let leaves = at.direction != Direction::Inbound;
    let has_its_target = seen
        .streams
        .keys()
        .any(|one| one.destination.ip() == destination);
    is_between_them || (leaves && (has_its_target || (!has_followed && !is_same_file)))
}
