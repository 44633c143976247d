//! Transmit stamps that the sender reported in later datagrams, found by its session and the number of
//! the message. A session numbers without holes but for losses, so they lie in a row.

use std::collections::BTreeMap;

use super::{ChannelRecords, each};

/// A number that no stamp was reported for.
const NONE: i32 = i32::MIN;

/// Transmit stamps reported by the sender, found by its session.
#[derive(Debug, Default)]
pub(super) struct FollowUps {
    sessions: BTreeMap<u32, Reported>,
    /// Sequence numbers up to this occur in more than one epoch of the session, so a stamp for
    /// them could belong to either message.
    ambiguous_to: BTreeMap<u32, u64>,
}

/// What was reported in one session.
#[derive(Debug, Default)]
struct Reported {
    /// Number of the first in `row`.
    first: u64,
    /// Handed over to transmitted, nanoseconds, or [`NONE`].
    row: Vec<i32>,
    /// What does not fit there.
    apart: BTreeMap<u64, i64>,
}

impl Reported {
    /// The smallest is kept of several.
    fn add(&mut self, sequence: u64, handed_to_tx_ns: i64) {
        if self.row.is_empty() && self.apart.is_empty() {
            // Those before the first came late; a few are no reason to be apart.
            self.first = sequence.saturating_sub(Self::HOLE_MAX);
        }
        let place = sequence.checked_sub(self.first).map(usize::try_from);
        let near_end = self.row.len() as u64 + 2 * Self::HOLE_MAX;
        match (place, i32::try_from(handed_to_tx_ns)) {
            (Some(Ok(place)), Ok(ns)) if ns != NONE && (place as u64) < near_end => {
                if self.row.len() <= place {
                    self.row.resize(place + 1, NONE);
                }
                let known = &mut self.row[place];
                if *known == NONE || ns < *known {
                    *known = ns;
                }
            }
            _ => {
                let known = self.apart.entry(sequence).or_insert(handed_to_tx_ns);
                *known = (*known).min(handed_to_tx_ns);
            }
        }
    }

    /// Longest run of numbers without a stamp that is kept as such.
    const HOLE_MAX: u64 = 4_096;

    fn find(&self, sequence: u64) -> Option<i64> {
        let place = sequence.checked_sub(self.first).map(usize::try_from);
        let in_row = place
            .and_then(Result::ok)
            .and_then(|place| self.row.get(place).copied())
            .filter(|ns| *ns != NONE)
            .map(i64::from);
        let apart = self.apart.get(&sequence).copied();
        match (in_row, apart) {
            (Some(one), Some(other)) => Some(one.min(other)),
            (one, other) => one.or(other),
        }
    }
}

impl FollowUps {
    pub(super) fn new(records: &ChannelRecords<'_>) -> Self {
        let mut sessions: BTreeMap<u32, Reported> = BTreeMap::new();
        for record in each(records.follow_up) {
            let session = sessions.entry(record.session).or_default();
            session.add(record.sequence, record.handed_to_tx_ns);
        }
        if sessions.is_empty() {
            return Self::default();
        }
        let mut highest: BTreeMap<(u32, u32), u64> = BTreeMap::new();
        for record in each(records.ingress) {
            let entry = highest.entry((record.session, record.epoch)).or_insert(0);
            *entry = (*entry).max(record.sequence);
        }
        let mut tops: BTreeMap<u32, Vec<u64>> = BTreeMap::new();
        for ((session, _), sequence) in highest {
            tops.entry(session).or_default().push(sequence);
        }
        let ambiguous_to = tops
            .into_iter()
            .filter_map(|(session, mut sequences)| {
                sequences.sort_unstable_by(|a, b| b.cmp(a));
                sequences.get(1).map(|second| (session, *second))
            })
            .collect();
        Self {
            sessions,
            ambiguous_to,
        }
    }

    pub(super) fn find(&self, session: u32, sequence: u64) -> Option<i64> {
        if self
            .ambiguous_to
            .get(&session)
            .is_some_and(|to| sequence <= *to)
        {
            return None;
        }
        self.sessions.get(&session)?.find(sequence)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_smallest_stamp_of_a_number_is_found_wherever_it_lies() {
        let mut reported = Reported::default();
        let far = u64::from(u32::MAX);
        for (sequence, ns) in [
            (9_000, 70),
            (8_990, 60),
            (9_000, 50),
            (far, 5),
            (0, 4),
            (9_002, i64::MAX),
            (9_002, 3),
            (9_003, i64::from(NONE)),
        ] {
            reported.add(sequence, ns);
        }
        let found = [9_000, 8_990, far, 0, 9_002, 9_003, 9_001].map(|one| reported.find(one));
        let none = i64::from(NONE);
        assert_eq!(
            found,
            [
                Some(50),
                Some(60),
                Some(5),
                Some(4),
                Some(3),
                Some(none),
                None
            ]
        );
        assert!(reported.row.len() < 10_000, "one far number costs no room");
    }
}
