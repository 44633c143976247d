//! What a tap could have seen: when it was watched, on which clock, and which frames it could not read
//! or did not keep. Only what it would have seen and did not see is lost.
//!
//! A tap's stamps are taken in the order of the file. Where they jump back, or on by more than a day, a
//! new *level* begins. A level of one or two stamps far from the others is a fault of single stamps: it is
//! no time of watching. So are one or two ahead of all around them, and one or two at the beginning or end,
//! as far from the rest as none there lies from the next. Between longer levels the clock was set, or parts of the file are out of order; two points
//! together tell which (see [`super::join`]).

use std::collections::{BTreeMap, BTreeSet};
use std::net::{IpAddr, SocketAddr};

use serde::{Deserialize, Serialize};

use super::kept::surely_keeps;
use super::observe::{Observation, Stream};
use super::{CaptureInterface, Span};

/// Farthest that a stamp may lie behind the one before it without being of another level: packets that
/// several queues of a card brought.
const DISORDER_MAX_NS: i64 = 1_000_000;
/// Farthest that a single stamp may lie behind the one before it and still be sound.
const LATE_MAX_NS: i64 = 100_000_000;
/// Longest silence of a tap.
const SILENCE_MAX_NS: i64 = 86_400_000_000_000;
/// A stamp before it, since 1970, is of a clock that was not set.
const YEAR_NS: i64 = 365 * SILENCE_MAX_NS;
/// Stamps that are no level of their own.
const ISOLATED_COUNT: usize = 2;
const ISOLATED_MAX: u64 = ISOLATED_COUNT as u64;
/// How much longer than any other the time is between the rest and a stamp far from it, and how long at least.
const FAR_FACTOR: i64 = 100;
const FAR_MIN_NS: i64 = 1_000_000_000;
/// Times between stamps that tell what is far.
const USUAL_COUNT_MIN: u64 = 5;
/// Levels whose clock another point's is compared with.
const ANCHOR_COUNT_MAX: usize = 4;
/// How far the stated times of watching may leave out a packet.
const STATED_SLACK_NS: i64 = 1_000_000_000;

/// What captures on one clock: an interface of a file, or the ET2000 behind it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Tap {
    /// Which file.
    pub file_index: usize,
    /// Which interface of it.
    pub interface_index: usize,
    /// On the clock of an ET2000.
    pub is_esl: bool,
}

hil_core::labelled! {
    /// Which header numbers a protocol.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum ProtocolSpace, label {
        /// Of Ethernet.
        EtherType = "EtherType",
        /// Of IP.
        Ip = "IP protocol",
        /// Of PPP.
        Ppp = "PPP protocol",
        /// Service access point of LLC.
        Llc = "LLC service",
        /// Organisation of SNAP.
        Snap = "SNAP organisation",
        /// Address family of a BSD loopback.
        AddressFamily = "address family",
    }
}

/// Why it is unknown which datagrams a frame holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "why")]
pub enum Unread {
    /// A link layer that is not read.
    LinkType {
        /// Its number.
        link_type: u16,
    },
    /// A protocol that is not read and may carry IP.
    Protocol {
        /// Whose number.
        space: ProtocolSpace,
        /// Its number.
        number: u32,
    },
    /// Within UDP, in a tunnel that is not read.
    Tunnel {
        /// The port that tells.
        port: u16,
    },
    /// Captured too short (snap length).
    CutShort,
    /// The first fragment of a datagram that is known by all of its payload.
    Fragmented,
    /// Lengths or versions that cannot be.
    Malformed,
    /// Sealed by 802.11, `MACsec`, PPP or ESP.
    Encrypted,
    /// Several datagrams in one frame: a super-frame of segmentation or receive offload, or an A-MSDU.
    Aggregate,
    /// Without a time stamp.
    NoStamp,
}

/// A clock that was set while it stamped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockStep {
    /// The last stamp before.
    pub before_ns: i64,
    /// From it to the next, which came later.
    pub by_ns: i64,
}

/// Stamps that go on from one another.
#[derive(Debug, Clone, Copy)]
struct Level {
    first_ns: i64,
    last_ns: i64,
    min_ns: i64,
    max_ns: i64,
    /// Last and largest stamp before the newest, and before the one before it.
    before_ns: [Option<(i64, i64)>; ISOLATED_COUNT],
    count: u64,
    gaps: Gaps,
    /// How far its first stamp lies behind the one before.
    behind_ns: i64,
    /// The level before it.
    previous: Option<usize>,
    /// What takes its stamps to a clock that was not set; `None` for isolated ones.
    shift_ns: Option<i64>,
}

/// Times from one stamp of a level to the next.
#[derive(Debug, Clone, Copy, Default)]
struct Gaps {
    /// The first, and the stamps behind them.
    head: [Option<(i64, i64)>; ISOLATED_COUNT],
    /// The newest, the last one first.
    tail: [Option<i64>; ISOLATED_COUNT],
    /// Of those between, the longest, and how many.
    usual_max_ns: i64,
    usual_count: u64,
}

impl Gaps {
    fn take(&mut self, gap_ns: i64, at_ns: i64) {
        if let Some(free) = self.head.iter_mut().find(|gap| gap.is_none()) {
            *free = Some((gap_ns, at_ns));
            return;
        }
        let [newest, older] = self.tail;
        if let Some(usual_ns) = older {
            self.usual_max_ns = self.usual_max_ns.max(usual_ns);
            self.usual_count += 1;
        }
        self.tail = [Some(gap_ns), newest];
    }

    fn is_far(&self, gap_ns: i64) -> bool {
        let usual_ns = self.usual_max_ns.saturating_mul(FAR_FACTOR);
        self.usual_count >= USUAL_COUNT_MIN && gap_ns > usual_ns.max(FAR_MIN_NS)
    }
}

impl Level {
    fn begun(at_ns: i64, behind_ns: i64, previous: Option<usize>) -> Self {
        Self {
            first_ns: at_ns,
            last_ns: at_ns,
            min_ns: at_ns,
            max_ns: at_ns,
            before_ns: [None; _],
            count: 1,
            gaps: Gaps::default(),
            behind_ns,
            previous,
            shift_ns: None,
        }
    }

    fn take(&mut self, at_ns: i64) {
        self.gaps.take(at_ns.saturating_sub(self.last_ns), at_ns);
        let [newest, _] = self.before_ns;
        self.before_ns = [Some((self.last_ns, self.max_ns)), newest];
        self.last_ns = at_ns;
        self.min_ns = self.min_ns.min(at_ns);
        self.max_ns = self.max_ns.max(at_ns);
        self.count += 1;
    }

    /// Leaves out stamps at either end that lie far from all others.
    fn trim(&mut self) {
        let gaps = self.gaps;
        let head = gaps.head.iter().rev().flatten();
        let mut head = head.filter(|(gap_ns, _)| gaps.is_far(*gap_ns));
        if let Some((_, first_ns)) = head.next() {
            (self.first_ns, self.min_ns) = (*first_ns, *first_ns);
        }
        let tail = gaps.tail.into_iter().zip(self.before_ns).rev();
        let mut tail = tail.filter(|(gap_ns, _)| gap_ns.is_some_and(|gap_ns| gaps.is_far(gap_ns)));
        if let Some((_, Some((last_ns, max_ns)))) = tail.next() {
            (self.last_ns, self.max_ns) = (last_ns, max_ns);
        }
    }

    /// It begins so little behind the level before it that packets may have come late: none is isolated.
    fn is_late(&self) -> bool {
        (1..=LATE_MAX_NS).contains(&self.behind_ns)
    }
}

/// See the module documentation.
#[derive(Debug, Clone, Default)]
pub struct Watch {
    levels: Vec<Level>,
    current: usize,
    /// Single stamps ahead of all around them, by level, and the one before each.
    ahead: BTreeMap<(usize, i64), i64>,
    /// When it was watched, by its stamps.
    pub spans: Vec<Span>,
    /// The same as if its clock had not been set.
    pub steady_spans: Vec<Span>,
    /// Where its clock was set, if its file is in order.
    pub steps: Vec<ClockStep>,
    /// What takes the clock that was not set to each level's own, the longest level first.
    pub(super) anchors_ns: Vec<i64>,
    /// Frames that may hold any datagram.
    pub unread: BTreeMap<Unread, u64>,
    /// Datagrams of a flow and two sockets of which too little was captured to know them again.
    cut: BTreeMap<(usize, SocketAddr, SocketAddr, Unread), u64>,
    /// IP packets between two ends whose payload is encrypted, or a tunnel's that is not read.
    sealed: BTreeMap<(IpAddr, IpAddr, Unread), u64>,
    /// Frames that it did not keep, as its file says.
    pub dropped_count: u64,
    /// Its file says that none was dropped.
    pub is_complete: bool,
    /// To how many nanoseconds its stamps are whole.
    pub unit_ns: i64,
    /// See [`CaptureInterface::is_merged`].
    pub is_merged: bool,
    /// See [`CaptureInterface::filter`].
    filters: BTreeSet<String>,
    /// The file says when it was watched.
    is_stated: bool,
}

impl Watch {
    pub(super) fn miss(&mut self, why: Unread) {
        *self.unread.entry(why).or_default() += 1;
    }

    pub(super) fn miss_of(&mut self, flow: usize, from: SocketAddr, to: SocketAddr, why: Unread) {
        *self.cut.entry((flow, from, to, why)).or_default() += 1;
    }

    pub(super) fn miss_sealed(&mut self, source: IpAddr, destination: IpAddr, why: Unread) {
        *self.sealed.entry((source, destination, why)).or_default() += 1;
    }

    /// Frames that may be of a flow between two sockets, and why they cannot be told. Encrypted packets between
    /// other ends may be a tunnel of it, unless it `is_seen` here.
    pub fn unread_of(
        &self,
        flow_index: usize,
        source: SocketAddr,
        destination: SocketAddr,
        is_seen: bool,
    ) -> BTreeMap<Unread, u64> {
        let mut unread = self.unread.clone();
        for ((from, to, why), count) in &self.sealed {
            if !is_seen || (*from, *to) == (source.ip(), destination.ip()) {
                *unread.entry(*why).or_default() += count;
            }
        }
        for ((flow, from, to, why), count) in &self.cut {
            if (*flow, *from, *to) == (flow_index, source, destination) {
                *unread.entry(*why).or_default() += count;
            }
        }
        unread
    }

    /// Filters with which it may not have kept all of a stream.
    pub(super) fn filters_against(&self, stream: &Stream) -> impl Iterator<Item = &String> {
        let filters = self.filters.iter();
        filters.filter(|filter| !surely_keeps(filter, stream))
    }

    /// Takes the stamp of the next packet; true when it lies before the one before.
    pub(super) fn stamp(&mut self, at_ns: i64) -> bool {
        let fits = |level: &Level| {
            let on_ns = at_ns.saturating_sub(level.last_ns);
            (-DISORDER_MAX_NS..=SILENCE_MAX_NS).contains(&on_ns)
        };
        let is_nearer =
            |a: &Level, b: &Level| at_ns.abs_diff(a.last_ns) < at_ns.abs_diff(b.last_ns);
        let is_backward = self
            .levels
            .get(self.current)
            .is_some_and(|level| at_ns < level.last_ns);
        self.pass_over_those_ahead(at_ns);
        let current = self.levels.get(self.current);
        let next = current.and_then(|level| {
            let may_return = level.count <= ISOLATED_MAX && !level.is_late();
            let previous = level.previous.filter(|_| may_return);
            let returns = previous.filter(|index| {
                let before = &self.levels[*index];
                fits(before) && (!fits(level) || is_nearer(before, level))
            });
            returns.or_else(|| fits(level).then_some(self.current))
        });
        if let Some(index) = next {
            self.current = index;
            self.levels[index].take(at_ns);
        } else {
            let behind_ns = current.map_or(0, |level| level.last_ns.saturating_sub(at_ns));
            let previous = current.map(|_| self.current);
            self.current = self.levels.len();
            self.levels.push(Level::begun(at_ns, behind_ns, previous));
        }
        is_backward
    }

    /// The newest stamps were one or two ahead, if the next goes on from the one before them.
    fn pass_over_those_ahead(&mut self, at_ns: i64) {
        let Some(level) = self.levels.get_mut(self.current) else {
            return;
        };
        let late = |at_ns: i64| at_ns.saturating_sub(LATE_MAX_NS);
        let mut ahead = Vec::new();
        for before in level.before_ns {
            let newest_ns = ahead
                .last()
                .map_or(level.last_ns, |(_, before_ns)| *before_ns);
            let Some((last_ns, max_ns)) = before.filter(|_| at_ns < late(newest_ns)) else {
                return;
            };
            ahead.push((newest_ns, last_ns));
            if late(last_ns) <= at_ns {
                let current = self.current;
                let stamps = ahead.iter().map(|(at_ns, _)| ((current, *at_ns), last_ns));
                self.ahead.extend(stamps);
                (level.last_ns, level.max_ns, level.before_ns) = (last_ns, max_ns, [None; _]);
                return;
            }
        }
    }

    /// The newest stamp of all.
    pub(super) fn last_ns(&self) -> Option<i64> {
        self.levels.iter().map(|level| level.max_ns).max()
    }

    /// The level of the newest stamp.
    pub(super) const fn level(&self) -> usize {
        self.current
    }

    /// Settles levels and times of watching, after the last packet of the file.
    pub(super) fn settle(&mut self, interface: Option<&CaptureInterface>) {
        self.levels.iter_mut().for_each(Level::trim);
        let most = self.levels.iter().map(|level| level.count).max();
        let least = if most > Some(ISOLATED_MAX) {
            ISOLATED_MAX + 1
        } else {
            1
        };
        let mut sound: Vec<usize> = Vec::new();
        for (index, level) in self.levels.iter().enumerate() {
            let goes_on = level.is_late() && sound.last().copied() == level.previous;
            if level.count >= least || goes_on {
                sound.push(index);
            }
        }
        // The level of most packets keeps its stamps; the others are put next to it.
        let main = sound
            .iter()
            .position(|index| Some(self.levels[*index].count) == most);
        let main = main.unwrap_or(0);
        for at in (0..sound.len()).skip(main) {
            let shift_ns = match at.checked_sub(1).filter(|_| at > main) {
                Some(before) => self.behind(sound[before], sound[at]),
                None => 0,
            };
            self.levels[sound[at]].shift_ns = Some(shift_ns);
        }
        for at in (0..main).rev() {
            let (here, next) = (self.levels[sound[at]], self.levels[sound[at + 1]]);
            let next_ns = next.first_ns.saturating_add(next.shift_ns.unwrap_or(0));
            self.levels[sound[at]].shift_ns = Some(next_ns.saturating_sub(here.last_ns));
        }
        for pair in sound.windows(2) {
            let (before, after) = (self.levels[pair[0]], self.levels[pair[1]]);
            self.steps.push(ClockStep {
                before_ns: before.last_ns,
                by_ns: after.first_ns.saturating_sub(before.last_ns),
            });
        }
        let mut longest: Vec<Level> = sound.iter().map(|index| self.levels[*index]).collect();
        longest.sort_by_key(|level| core::cmp::Reverse(level.count));
        longest.truncate(ANCHOR_COUNT_MAX);
        let shifts = longest.iter().filter_map(|level| level.shift_ns);
        self.anchors_ns = shifts.map(i64::saturating_neg).collect();
        let levels = || sound.iter().map(|index| self.levels[*index]);
        let stamps = hull(levels().map(|level| (level, 0)));
        let steady = hull(levels().map(|level| (level, level.shift_ns.unwrap_or(0))));
        self.is_merged = interface.is_some_and(|one| one.is_merged);
        self.is_complete = interface.is_some_and(|one| one.dropped_count == Some(0));
        let (numerator, denominator) = interface.map_or((1, 1), |one| one.unit_ns);
        let unit_ns = numerator.div_ceil(denominator.max(1));
        self.unit_ns = i64::try_from(unit_ns).unwrap_or(i64::MAX);
        let filter = interface.and_then(|one| one.filter.clone());
        self.filters = filter.into_iter().collect();
        let stated = interface.and_then(|one| stated(one, stamps));
        self.is_stated = stated.is_some();
        let widen = |span: Option<Span>| match (span, stated) {
            (Some(a), Some(b)) => Some(a.hull(b)),
            (a, b) => a.or(b),
        };
        self.spans = widen(stamps).into_iter().collect();
        self.steady_spans = if self.steps.is_empty() {
            self.spans.clone()
        } else {
            steady.into_iter().collect()
        };
    }

    /// What puts level `index` right behind level `before`.
    fn behind(&self, before: usize, index: usize) -> i64 {
        let before = self.levels[before];
        let end_ns = before.last_ns.saturating_add(before.shift_ns.unwrap_or(0));
        end_ns.saturating_sub(self.levels[index].first_ns)
    }

    /// Gives an observation of this tap its steady stamp, and an isolated one a neighbour's.
    pub(super) fn settle_observation(&self, one: &mut Observation) {
        let Some(mut level) = self.levels.get(one.level) else {
            return;
        };
        one.is_stamp_sound = level.shift_ns.is_some();
        if let Some(before_ns) = self.ahead.get(&(one.level, one.stamp_ns)) {
            one.stamp_ns = *before_ns;
            one.is_stamp_sound = false;
        }
        if level.shift_ns.is_none() {
            while let (None, Some(previous)) = (level.shift_ns, level.previous) {
                one.stamp_ns = level.first_ns.saturating_add(level.behind_ns);
                level = &self.levels[previous];
            }
            if level.shift_ns.is_none()
                && let Some(next) = self.levels.iter().find(|level| level.shift_ns.is_some())
            {
                level = next;
                one.stamp_ns = next.first_ns;
            }
        }
        one.steady_ns = one.stamp_ns.saturating_add(level.shift_ns.unwrap_or(0));
    }

    /// True when nothing was seen here while something was seen there.
    pub(super) fn is_apart_from(&self, other: &Self) -> bool {
        let mut pairs = self
            .spans
            .iter()
            .flat_map(|a| other.spans.iter().map(move |b| (a, b)));
        pairs.all(|(a, b)| a.last_ns <= b.first_ns || b.last_ns <= a.first_ns)
    }

    /// Takes what a later section of the file tells of the same interface.
    pub(super) fn absorb(&mut self, other: Self) {
        self.is_stated &= other.is_stated;
        self.spans.extend(other.spans);
        self.steady_spans.extend(other.steady_spans);
        if !self.is_stated {
            // Nothing says that there was a time between the sections.
            for spans in [&mut self.spans, &mut self.steady_spans] {
                *spans = spans.drain(..).reduce(Span::hull).into_iter().collect();
            }
        }
        self.steps.extend(other.steps);
        self.filters.extend(other.filters);
        for (why, count) in other.unread {
            *self.unread.entry(why).or_default() += count;
        }
        for (ends, count) in other.sealed {
            *self.sealed.entry(ends).or_default() += count;
        }
        for (of, count) in other.cut {
            *self.cut.entry(of).or_default() += count;
        }
        self.dropped_count = self.dropped_count.saturating_add(other.dropped_count);
        self.is_complete &= other.is_complete;
        self.unit_ns = self.unit_ns.max(other.unit_ns);
    }
}

/// From the first stamp to the last.
fn hull(levels: impl Iterator<Item = (Level, i64)>) -> Option<Span> {
    let spans = levels.map(|(level, shift_ns)| Span {
        first_ns: level.min_ns.saturating_add(shift_ns),
        last_ns: level.max_ns.saturating_add(shift_ns),
    });
    spans.reduce(Span::hull)
}

/// The stated time of watching, in the unit in which it holds the packets; without packets, in the one in
/// which it is not the first year of the clock.
fn stated(interface: &CaptureInterface, stamps: Option<Span>) -> Option<Span> {
    let mut stated = interface.watch.iter().flatten();
    let Some(stamps) = stamps else {
        let is_set = |span: &&Span| span.first_ns > YEAR_NS;
        return stated.clone().find(is_set).or(stated.next()).copied();
    };
    let holds = |span: &&Span| {
        span.first_ns.saturating_sub(STATED_SLACK_NS) <= stamps.first_ns
            && stamps.last_ns <= span.last_ns.saturating_add(STATED_SLACK_NS)
    };
    stated.find(holds).copied()
}
