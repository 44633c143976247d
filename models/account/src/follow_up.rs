//! Transmit stamps that the sender reported in later datagrams, found by its session and the number of
//! the message. A session numbers without holes but for losses, so they lie in a row.

use std::collections::{BTreeMap, VecDeque};

use hil_core::record::{FollowUpRecord, IngressRecord};

/// A number that no stamp was reported for.
const NONE: i32 = i32::MIN;

/// Transmit stamps reported by the sender, found by its session.
#[derive(Debug, Default)]
pub(super) struct FollowUps {
    sessions: BTreeMap<u32, Reported>,
    /// The highest number of each start of the producer that came in a session: a stamp for a number
    /// that two of them reached could belong to either message.
    tops: BTreeMap<u32, Vec<(u32, u64)>>,
}

/// What was reported in one session.
#[derive(Debug, Default)]
struct Reported {
    /// Number of the first in `row`.
    first: u64,
    /// Handed over to transmitted, nanoseconds, or [`NONE`].
    row: VecDeque<i32>,
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

    /// Lets go of what nobody asks for any more: messages are asked for in order, a few late ones
    /// excepted.
    fn forget_before(&mut self, sequence: u64) {
        let lowest = sequence.saturating_sub(Self::HOLE_MAX);
        while self.first < lowest && self.row.pop_front().is_some() {
            self.first += 1;
        }
        while self
            .apart
            .first_key_value()
            .is_some_and(|(one, _)| *one < lowest)
        {
            self.apart.pop_first();
        }
    }

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
    /// True when no stamp was reported.
    pub(super) fn is_empty(&self) -> bool {
        self.sessions.is_empty()
    }

    /// Takes in a reported stamp.
    pub(super) fn add(&mut self, record: &FollowUpRecord) {
        let session = self.sessions.entry(record.session).or_default();
        session.add(record.sequence, record.handed_to_tx_ns);
    }

    /// Notes which numbers of which start of the producer came in a session.
    pub(super) fn note_arrival(&mut self, record: &IngressRecord) {
        let tops = self.tops.entry(record.session).or_default();
        match tops.iter_mut().find(|(epoch, _)| *epoch == record.epoch) {
            Some((_, top)) => *top = record.sequence.max(*top),
            None => tops.push((record.epoch, record.sequence)),
        }
    }

    /// The stamp of a message that came in a session; those of lower numbers are forgotten.
    pub(super) fn take(&mut self, session: u32, sequence: u64) -> Option<i64> {
        let reported = self.sessions.get_mut(&session)?;
        let found = reported.find(sequence);
        reported.forget_before(sequence);
        let tops = self.tops.get(&session)?;
        let reaching_count = tops.iter().filter(|(_, top)| *top >= sequence).count();
        found.filter(|_| reaching_count < 2)
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
        reported.forget_before(20_000);
        assert_eq!((reported.row.len(), reported.apart.len()), (0, 1));
        assert_eq!(reported.find(far), Some(5));
    }
}
