//! The passages of a channel one after the other, as often as they are asked for, in a few bytes each. It
//! computes no figure.

use super::{Crossing, Passage};
use hil_core::packed::{Unpacked, put};

/// Passages in the order of epochs and sequence numbers, in about a dozen bytes each: what of a message
/// follows from the one before takes one.
#[derive(Debug, Clone, Default)]
pub struct Passages {
    bytes: Vec<u8>,
    last: Follows,
}

/// What the next passage is expected to be like, from those before it.
#[derive(Debug, Clone, Copy, Default)]
struct Follows {
    epoch_rank: u32,
    sequence: u64,
    offered_ns: i64,
    /// From one to the next, as it was last.
    period_ns: i64,
    /// Received less offered, with whatever separates the clocks.
    apart_ns: i64,
    /// What separates the clocks: `apart_ns` less the delay.
    offset_ns: i64,
    bound_ns: u64,
}

/// Bits of the first number of a passage; the crossing is above them.
const IS_OFFERED: i64 = 1;
const IS_RECEIVED: i64 = 2;
const HAS_DELAY: i64 = 4;
const IS_MANY: i64 = 8;
const CROSSING_SHIFT: u32 = 4;

/// By their numbers.
const CROSSINGS: [Crossing; 6] = [
    Crossing::Arrived,
    Crossing::LostByNetwork,
    Crossing::Unreachable,
    Crossing::LostByHost,
    Crossing::Unknown,
    Crossing::Doubtful,
];

impl Follows {
    /// Notes a passage, so that what is expected moves on with it.
    fn note(&mut self, one: &Passage) {
        self.epoch_rank = one.epoch_rank;
        self.sequence = one.sequence.wrapping_add(1);
        if let Some(ns) = one.offered_ns {
            self.period_ns = ns.wrapping_sub(self.offered_ns);
            self.offered_ns = ns;
        }
        if let Some(ns) = one.received_ns {
            self.apart_ns = ns.wrapping_sub(self.offered_ns);
        }
        if let Some(ns) = one.delay_ns {
            self.offset_ns = self.apart_ns.wrapping_sub(ns);
        }
        self.bound_ns = one.delay_bound_ns;
    }
}

impl Passages {
    /// Appends the next one.
    pub fn push(&mut self, one: &Passage) {
        let mut head = (one.crossing as i64) << CROSSING_SHIFT;
        let flags = [
            (one.offered_ns.is_some(), IS_OFFERED),
            (one.received_ns.is_some(), IS_RECEIVED),
            (one.delay_ns.is_some(), HAS_DELAY),
            (one.count != 1, IS_MANY),
        ];
        for (is_set, flag) in flags {
            head |= if is_set { flag } else { 0 };
        }
        let bytes = &mut self.bytes;
        let before = self.last;
        self.last.note(one);
        let now = self.last;
        put(bytes, head);
        let rank = i64::from(one.epoch_rank) - i64::from(before.epoch_rank);
        put(bytes, rank);
        let skipped = one.sequence.wrapping_sub(before.sequence);
        put(bytes, skipped.cast_signed());
        if one.count != 1 {
            put(bytes, one.count.cast_signed());
        }
        if one.offered_ns.is_some() {
            put(bytes, now.period_ns.wrapping_sub(before.period_ns));
        }
        if one.received_ns.is_some() {
            put(bytes, now.apart_ns.wrapping_sub(before.apart_ns));
        }
        if one.delay_ns.is_some() {
            put(bytes, now.offset_ns.wrapping_sub(before.offset_ns));
        }
        let wider = one.delay_bound_ns.wrapping_sub(before.bound_ns);
        put(bytes, wider.cast_signed());
    }

    /// All of them from the first on.
    pub fn each(&self) -> impl Iterator<Item = Passage> + '_ {
        Unpacking {
            numbers: Unpacked(&self.bytes),
            last: Follows::default(),
        }
    }

    #[cfg(test)]
    fn byte_count(&self) -> usize {
        self.bytes.len()
    }
}

impl FromIterator<Passage> for Passages {
    fn from_iter<I: IntoIterator<Item = Passage>>(passages: I) -> Self {
        let mut packed = Self::default();
        for one in passages {
            packed.push(&one);
        }
        packed
    }
}

struct Unpacking<'a> {
    numbers: Unpacked<'a>,
    last: Follows,
}

impl Iterator for Unpacking<'_> {
    type Item = Passage;

    fn next(&mut self) -> Option<Passage> {
        let head = self.numbers.next()?;
        let mut next = || self.numbers.next();
        let last = &mut self.last;
        let rank = i64::from(last.epoch_rank).wrapping_add(next()?);
        let sequence = last.sequence.wrapping_add_signed(next()?);
        let count = if head & IS_MANY == 0 {
            1
        } else {
            next()?.cast_unsigned()
        };
        let mut one = Passage {
            epoch_rank: u32::try_from(rank).ok()?,
            sequence,
            count,
            offered_ns: None,
            received_ns: None,
            delay_ns: None,
            delay_bound_ns: 0,
            crossing: *CROSSINGS.get(usize::try_from(head >> CROSSING_SHIFT).ok()?)?,
        };
        if head & IS_OFFERED != 0 {
            let period_ns = last.period_ns.wrapping_add(next()?);
            one.offered_ns = Some(last.offered_ns.wrapping_add(period_ns));
        }
        let offered_ns = one.offered_ns.unwrap_or(last.offered_ns);
        let mut apart_ns = last.apart_ns;
        if head & IS_RECEIVED != 0 {
            apart_ns = apart_ns.wrapping_add(next()?);
            one.received_ns = Some(offered_ns.wrapping_add(apart_ns));
        }
        if head & HAS_DELAY != 0 {
            let offset_ns = last.offset_ns.wrapping_add(next()?);
            one.delay_ns = Some(apart_ns.wrapping_sub(offset_ns));
        }
        one.delay_bound_ns = last.bound_ns.wrapping_add_signed(next()?);
        last.note(&one);
        Some(one)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::random::RandomStream;

    #[test]
    fn passages_of_every_kind_come_back() {
        let mut random = RandomStream::new(2, "measure.network.list");
        let mut number = |shift: u32| (random.next_u64() >> (shift % 64)).cast_signed();
        let mut passage = |index: u32| Passage {
            epoch_rank: index / 700,
            sequence: number(index).cast_unsigned(),
            count: if index.is_multiple_of(9) {
                number(40).cast_unsigned()
            } else {
                1
            },
            offered_ns: (!index.is_multiple_of(3)).then(|| number(index / 3)),
            received_ns: (!index.is_multiple_of(5)).then(|| number(index / 5)),
            delay_ns: (!index.is_multiple_of(7)).then(|| number(index / 7)),
            delay_bound_ns: number(index / 2).cast_unsigned(),
            crossing: CROSSINGS[index as usize % 4],
        };
        let passages: Vec<Passage> = (0..5_000).map(&mut passage).collect();
        let packed: Passages = passages.iter().copied().collect();
        assert!(packed.each().eq(passages.iter().copied()));
        assert_eq!(Passages::default().each().count(), 0);
        for (number, crossing) in (0..).zip(CROSSINGS) {
            assert_eq!(crossing as i64, number);
        }
    }

    #[test]
    #[allow(clippy::cast_possible_truncation, reason = "small numbers")]
    fn messages_of_a_steady_channel_take_a_dozen_bytes() {
        let mut random = RandomStream::new(3, "measure.network.list");
        let count = 10_000_i64;
        let passage = |index: i64| {
            let mut under = |limit| (random.uniform() * limit) as i64;
            let offered_ns = index * 1_000_000 + under(50_000.0);
            let delay_ns = 150_000 + under(100_000.0);
            Passage {
                epoch_rank: 0,
                sequence: index.unsigned_abs(),
                count: 1,
                offered_ns: Some(offered_ns),
                received_ns: Some(offered_ns + delay_ns + 7_000_000_000 + index * 20),
                delay_ns: Some(delay_ns),
                delay_bound_ns: 90_000 + index.unsigned_abs() % 1_000 * 10,
                crossing: Crossing::Arrived,
            }
        };
        let packed: Passages = (0..count).map(passage).collect();
        let bytes = packed.byte_count() as f64 / count as f64;
        assert!(bytes < 14.0, "{bytes} bytes");
    }
}
