//! Which messages of a channel have been seen, by the producer's start and number. Numbers that
//! follow each other take one entry together, so it grows with the gaps only.

use std::collections::BTreeMap;

/// The messages seen so far.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Seen {
    /// By epoch: first number of each unbroken range, with its last.
    ranges: BTreeMap<u32, BTreeMap<u64, u64>>,
    count: u64,
}

impl Seen {
    /// Notes a message; false when it was noted before.
    pub fn insert(&mut self, epoch: u32, sequence: u64) -> bool {
        let ranges = self.ranges.entry(epoch).or_default();
        let before = ranges.range(..=sequence).next_back();
        let before = before.map(|(first, last)| (*first, *last));
        if before.is_some_and(|(_, last)| last >= sequence) {
            return false;
        }
        self.count += 1;
        let joined = before.filter(|(_, last)| last + 1 == sequence);
        let first = joined.map_or(sequence, |(first, _)| first);
        let after = sequence
            .checked_add(1)
            .and_then(|next| ranges.remove(&next));
        ranges.insert(first, after.unwrap_or(sequence));
        true
    }

    /// True when the message was noted.
    pub fn contains(&self, epoch: u32, sequence: u64) -> bool {
        let before = self
            .ranges
            .get(&epoch)
            .and_then(|ranges| ranges.range(..=sequence).next_back());
        before.is_some_and(|(_, last)| *last >= sequence)
    }

    /// Messages noted.
    pub const fn count(&self) -> u64 {
        self.count
    }

    /// Numbers below the highest of their start that were not noted.
    pub fn missing_count(&self) -> u64 {
        let below = self.ranges.values().filter_map(|ranges| {
            let (_, highest) = ranges.last_key_value()?;
            Some(highest.saturating_add(1))
        });
        below
            .fold(0_u64, u64::saturating_add)
            .saturating_sub(self.count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::random::RandomStream;
    use std::collections::BTreeSet;

    #[test]
    fn it_knows_what_a_plain_set_knows() {
        let mut random = RandomStream::new(11, "seen");
        let (mut seen, mut plain) = (Seen::default(), BTreeSet::new());
        for _ in 0..20_000 {
            let epoch = u32::try_from(random.next_u64() % 3).unwrap();
            let sequence = random.next_u64() % 900;
            assert_eq!(
                seen.insert(epoch, sequence),
                plain.insert((epoch, sequence))
            );
            let (epoch, sequence) = (epoch, random.next_u64() % 900);
            assert_eq!(
                seen.contains(epoch, sequence),
                plain.contains(&(epoch, sequence))
            );
        }
        assert_eq!(seen.count(), plain.len() as u64);
        let highest = |epoch| plain.range((epoch, 0)..=(epoch, u64::MAX)).next_back();
        let below: u64 = (0..3).filter_map(|epoch| Some(highest(epoch)?.1 + 1)).sum();
        assert_eq!(seen.missing_count(), below - plain.len() as u64);
    }

    #[test]
    fn neighbours_take_one_entry() {
        let mut seen = Seen::default();
        for sequence in [0, 1, 2, 5, 4, 3, u64::MAX] {
            assert!(seen.insert(7, sequence));
        }
        assert_eq!(seen.ranges[&7].len(), 2);
        assert!(!seen.insert(7, u64::MAX) && seen.contains(7, 5) && !seen.contains(8, 5));
    }
}
