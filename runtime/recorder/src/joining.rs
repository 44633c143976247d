//! The stamps of each message of one channel, joined while the run goes: a message is given out when
//! every process here has noted what it was to note, or when it has been waited for long enough.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use hil_models::measure::record::IngressRecord;
use hil_runtime::watch::{Record, Seen, Stage};

use crate::net::{self, Latencies, MessageLatency};

/// How long the rest of a message's stamps is waited for: longer than links delay. A message that
/// is lost, or replaced by a newer one, is given out after this time.
const WAIT: Duration = Duration::from_secs(5);
/// Messages waited for at a time; the oldest is given out when there are more.
const WAITING_MAX: usize = 1 << 16;

type Key = (u32, u64);

/// Joins the stamps of one channel.
#[derive(Debug, Default)]
pub(crate) struct Joining {
    /// What is noted here, as bits.
    wanted: u8,
    waiting: Latencies,
    /// In the order of their first stamps; what was given out before its turn is still in it.
    order: VecDeque<(Instant, Key)>,
    given: Seen,
    /// Stamps that came for a message that had been given out.
    pub(crate) late_count: u64,
}

const fn bit(stage: Stage) -> u8 {
    match stage {
        Stage::Published => 1,
        Stage::Sent => 2,
        Stage::Received => 4,
        Stage::Taken => 8,
    }
}

impl Joining {
    /// For a channel of whose messages `noted` is noted here.
    pub(crate) fn new(noted: &[Stage]) -> Self {
        let wanted = noted.iter().fold(0, |bits, stage| bits | bit(*stage));
        Self {
            wanted,
            ..Self::default()
        }
    }

    /// Takes a stamp that came `now`; the message with all its stamps when this was the last of
    /// them, or the one that has waited longest when too many wait.
    pub(crate) fn take(&mut self, record: &Record, now: Instant) -> Option<MessageLatency> {
        let key = match record {
            Record::Published(one) => (one.epoch, one.sequence),
            Record::Taken(one) => (one.epoch, one.sequence),
            Record::Egress(one) => (one.epoch, one.sequence),
            // A second copy says nothing of the way of the first.
            Record::Ingress(one) if one.flags & IngressRecord::DUPLICATE == 0 => {
                (one.epoch, one.sequence)
            }
            _ => return None,
        };
        if self.given.contains(key.0, key.1) {
            // The others bring the publication stamp along.
            self.late_count += u64::from(!matches!(record, Record::Published(_)));
            return None;
        }
        if !self.waiting.contains_key(&key) {
            self.order.push_back((now, key));
        }
        match record {
            Record::Published(one) => net::published(&mut self.waiting, one),
            Record::Taken(one) => net::taken(&mut self.waiting, one),
            Record::Egress(one) => net::sent(&mut self.waiting, one),
            Record::Ingress(one) => net::received(&mut self.waiting, one),
            _ => {}
        }
        let has_all = self
            .waiting
            .get(&key)
            .is_some_and(|one| self.wanted != 0 && has(one) & self.wanted == self.wanted);
        if has_all {
            return self.give(key);
        }
        if self.waiting.len() > WAITING_MAX {
            return self.oldest();
        }
        None
    }

    /// The message that has waited longest, if it has waited long enough.
    pub(crate) fn overdue(&mut self, now: Instant) -> Option<MessageLatency> {
        while let Some((since, key)) = self.order.front().copied() {
            if self.waiting.contains_key(&key) {
                if now.saturating_duration_since(since) < WAIT {
                    return None;
                }
                self.order.pop_front();
                return self.give(key);
            }
            self.order.pop_front();
        }
        None
    }

    /// The message that has waited longest; nothing more will come.
    pub(crate) fn oldest(&mut self) -> Option<MessageLatency> {
        while let Some((_, key)) = self.order.pop_front() {
            if self.waiting.contains_key(&key) {
                return self.give(key);
            }
        }
        None
    }

    fn give(&mut self, key: Key) -> Option<MessageLatency> {
        self.given.insert(key.0, key.1);
        self.waiting.remove(&key)
    }
}

/// The stages of which a message has stamps.
fn has(one: &MessageLatency) -> u8 {
    // A publication stamp travels with the message, so the others bring it too.
    let stages = [
        (one.published_ns.is_some(), Stage::Published),
        (one.gateway_taken_ns.is_some(), Stage::Sent),
        (one.received_ns.is_some(), Stage::Received),
        (one.taken_ns.is_some(), Stage::Taken),
    ];
    let there = stages.into_iter().filter(|(is_there, _)| *is_there);
    there.fold(0, |bits, (_, stage)| bits | bit(stage))
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_models::measure::record::{PublishedRecord, TakenRecord, UNAVAILABLE};

    fn published(sequence: u64) -> Record {
        Record::Published(PublishedRecord {
            sequence,
            published_ns: 10,
            epoch: 1,
            reserved: 0,
        })
    }

    fn taken(sequence: u64) -> Record {
        Record::Taken(TakenRecord {
            sequence,
            published_ns: 10,
            forwarded_ns: UNAVAILABLE,
            taken_ns: 30,
            epoch: 1,
            reserved: 0,
        })
    }

    #[test]
    fn a_message_is_given_out_once_when_it_is_whole_or_overdue() {
        let mut joining = Joining::new(&[Stage::Published, Stage::Taken]);
        let start = Instant::now();
        assert!(joining.take(&published(0), start).is_none());
        assert!(joining.take(&published(1), start).is_none());
        let whole = joining.take(&taken(1), start).unwrap();
        assert_eq!((whole.sequence, whole.taken_ns), (1, Some(30)));
        assert!(joining.overdue(start + WAIT / 2).is_none());
        let partial = joining.overdue(start + WAIT).unwrap();
        assert_eq!((partial.sequence, partial.taken_ns), (0, None));
        assert!(joining.overdue(start + WAIT).is_none());
        // Given out once, whatever comes.
        assert!(joining.take(&taken(0), start).is_none());
        assert_eq!(joining.late_count, 1);
        assert!(joining.take(&published(2), start).is_none());
        assert_eq!(joining.oldest().unwrap().sequence, 2);
        assert!(joining.oldest().is_none());
    }

    #[test]
    fn no_more_than_so_many_wait() {
        let mut joining = Joining::new(&[Stage::Published, Stage::Taken]);
        let start = Instant::now();
        for sequence in 0..WAITING_MAX as u64 {
            assert!(joining.take(&published(sequence), start).is_none());
        }
        let first = joining.take(&published(WAITING_MAX as u64), start);
        assert_eq!(first.unwrap().sequence, 0);
    }
}
