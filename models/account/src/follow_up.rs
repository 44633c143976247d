//! Transmit stamps that the sender reported in later datagrams, found by its session, the producer's start and
//! the number of the message. Both count without holes but for losses, so they lie in a row.

use std::collections::{BTreeMap, VecDeque};

use hil_core::record::{FollowUp, IngressRecord};

/// A number that no stamp was reported for.
const NONE: i32 = i32::MIN;

/// Transmit stamps reported by the sender.
#[derive(Debug, Default)]
pub(super) struct FollowUps {
    starts: BTreeMap<Starts, Reported>,
}

/// Of a session and of the producer, whose messages it carried.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Starts {
    session: u32,
    epoch: u32,
}

impl Starts {
    const fn of(record: &IngressRecord) -> Self {
        Self {
            session: record.session,
            epoch: record.epoch,
        }
    }
}

/// What was reported of the messages of two starts.
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
    /// Takes in the stamp that came along with a message, if one did.
    pub(super) fn add(&mut self, record: &IngressRecord) {
        if let Some(FollowUp {
            sequence,
            handed_to_tx_ns,
        }) = record.follow_up()
        {
            let reported = self.starts.entry(Starts::of(record)).or_default();
            reported.add(sequence, handed_to_tx_ns);
        }
    }

    /// The stamp of a message that arrived; those of lower numbers are forgotten.
    pub(super) fn take(&mut self, record: &IngressRecord) -> Option<i64> {
        let reported = self.starts.get_mut(&Starts::of(record))?;
        let found = reported.find(record.sequence);
        reported.forget_before(record.sequence);
        found
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
