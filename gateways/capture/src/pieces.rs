//! Which datagrams that IP cut into fragments came whole: the first fragment names the datagram, the others only
//! bear its number. Nothing is put together.

use std::collections::BTreeMap;
use std::net::IpAddr;

use super::link::Fragment;
use super::observe::{Point, Stream};

/// Longest time from the first to the last fragment of a datagram: what Linux waits (`ipfrag_time`).
const TOGETHER_MAX_NS: u64 = 30_000_000_000;

/// Where, from where to where, by which protocol and with which number.
type Key = (Point, IpAddr, IpAddr, u8, u32);

/// A datagram of which the first fragment was seen.
#[derive(Debug, Clone, Copy)]
pub(super) struct Begun {
    pub(super) point: Point,
    pub(super) stream: Stream,
    /// Its position among those seen of the stream.
    pub(super) index: usize,
    pub(super) first_ns: i64,
    /// From its first piece to its last; `None` when one is missing.
    pub(super) length_ns: Option<u64>,
}

/// Fragments with one number, one after the other.
#[derive(Debug, Default)]
struct Pieces {
    begun: Option<Begun>,
    /// Bytes of the packet that came, by where they begin.
    ranges: BTreeMap<usize, usize>,
    whole_bytes: Option<usize>,
    span_ns: Option<(i64, i64)>,
}

impl Pieces {
    /// Takes a fragment; false when it is of another datagram.
    fn take(&mut self, fragment: &Fragment, stamp_ns: i64, begun: Option<Begun>) -> bool {
        let (first_ns, last_ns) = self.span_ns.unwrap_or((stamp_ns, stamp_ns));
        let is_near = first_ns.abs_diff(stamp_ns) <= TOGETHER_MAX_NS;
        if !is_near || self.ranges.contains_key(&fragment.from_bytes) {
            return false;
        }
        self.span_ns = Some((first_ns.min(stamp_ns), last_ns.max(stamp_ns)));
        let end = fragment.from_bytes.saturating_add(fragment.bytes);
        self.ranges.insert(fragment.from_bytes, end);
        if fragment.is_last {
            self.whole_bytes = Some(end);
        }
        self.begun = self.begun.or(begun);
        true
    }

    fn ended(self) -> Option<Begun> {
        let mut reached = 0;
        for (from, to) in self.ranges {
            if from <= reached {
                reached = reached.max(to);
            }
        }
        let is_whole = self.whole_bytes.is_some_and(|whole| reached >= whole);
        let span = self.span_ns.filter(|_| is_whole);
        Some(Begun {
            length_ns: span.map(|(from, to)| to.abs_diff(from)),
            ..self.begun?
        })
    }
}

/// All fragments of a capture.
#[derive(Debug, Default)]
pub(super) struct Fragments {
    open: BTreeMap<Key, Pieces>,
    ended: Vec<Begun>,
}

impl Fragments {
    /// Takes a fragment; `begun` is of a followed datagram's first one.
    pub(super) fn take(
        &mut self,
        point: Point,
        fragment: &Fragment,
        stamp_ns: i64,
        begun: Option<Begun>,
    ) {
        let (from, to) = (fragment.source, fragment.destination);
        let key = (point, from, to, fragment.protocol, fragment.number);
        let pieces = self.open.entry(key).or_default();
        if !pieces.take(fragment, stamp_ns, begun) {
            let earlier = core::mem::take(pieces);
            self.ended.extend(earlier.ended());
            pieces.take(fragment, stamp_ns, begun);
        }
    }

    /// Every datagram of a file of which the first fragment was seen.
    pub(super) fn finish(&mut self, file_index: usize) -> Vec<Begun> {
        let is_of = |key: &Key, _: &mut Pieces| key.0.file_index == file_index;
        let open: Vec<(Key, Pieces)> = self.open.extract_if(.., is_of).collect();
        let mut ended = core::mem::take(&mut self.ended);
        ended.extend(open.into_iter().filter_map(|(_, pieces)| pieces.ended()));
        ended
    }
}
