//! The stamps of each message of one channel, joined while the run goes. Messages are given out in the
//! order of their publication, as readers want them: each when every process here has noted what it
//! was to note, when those published well after it are whole, or when it has been waited for long
//! enough.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use hil_models::measure::record::IngressRecord;
use hil_runtime::watch::{Record, Seen, Stage};

use crate::net::{self, Latencies, MessageLatency};

/// How long the rest of a message's stamps is waited for when none after it is whole: longer than
/// links delay.
const WAIT: Duration = Duration::from_secs(5);
/// A message that is not whole when one is that was published so much later is lost, or was replaced
/// by a newer one. Links that put messages out of order by more are few; their stamps are counted.
/// Short, because so much is missing from the file of a killed recorder.
const OVERTAKEN_NS: i64 = 300_000_000;
/// Messages waited for at a time; the oldest is given out when there are more.
const WAITING_MAX: usize = 1 << 16;

type Key = (u32, u64);

/// Joins the stamps of one channel.
#[derive(Debug, Default)]
pub(crate) struct Joining {
    /// What is noted here, as bits.
    wanted: u8,
    waiting: Latencies,
    /// The same by instant of publication, nanoseconds, with the moment their first stamp came.
    order: BTreeMap<(i64, Key), Instant>,
    /// The latest publication of a message that is whole.
    newest_whole_ns: Option<i64>,
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

    /// Takes a stamp that came `now`.
    pub(crate) fn take(&mut self, record: &Record, now: Instant) {
        let (key, published_ns) = match record {
            Record::Published(one) => ((one.epoch, one.sequence), one.published_ns),
            Record::Taken(one) => ((one.epoch, one.sequence), one.published_ns),
            Record::Egress(one) => ((one.epoch, one.sequence), one.published_ns),
            // A second copy says nothing of the way of the first.
            Record::Ingress(one) if one.flags & IngressRecord::DUPLICATE == 0 => {
                ((one.epoch, one.sequence), one.published_ns)
            }
            _ => return,
        };
        if self.given.contains(key.0, key.1) {
            // The others bring the publication stamp along.
            self.late_count += u64::from(!matches!(record, Record::Published(_)));
            return;
        }
        if !self.waiting.contains_key(&key) {
            self.order.insert((published_ns, key), now);
        }
        match record {
            Record::Published(one) => net::published(&mut self.waiting, one),
            Record::Taken(one) => net::taken(&mut self.waiting, one),
            Record::Egress(one) => net::sent(&mut self.waiting, one),
            Record::Ingress(one) => net::received(&mut self.waiting, one),
            _ => {}
        }
        if self.is_whole(&key) {
            let newest_ns = self.newest_whole_ns.unwrap_or(published_ns);
            self.newest_whole_ns = Some(newest_ns.max(published_ns));
        }
    }

    fn is_whole(&self, key: &Key) -> bool {
        let message = self.waiting.get(key);
        message.is_some_and(|one| self.wanted != 0 && has(one) & self.wanted == self.wanted)
    }

    /// The earliest message, if there is nothing more to wait for.
    pub(crate) fn next(&mut self, now: Instant) -> Option<MessageLatency> {
        let (&(published_ns, key), since) = self.order.first_key_value()?;
        let is_overtaken = self
            .newest_whole_ns
            .is_some_and(|newest_ns| newest_ns.saturating_sub(published_ns) >= OVERTAKEN_NS);
        let is_due = self.is_whole(&key)
            || is_overtaken
            || now.saturating_duration_since(*since) >= WAIT
            || self.waiting.len() > WAITING_MAX;
        if is_due { self.earliest() } else { None }
    }

    /// The earliest message; nothing more will come.
    pub(crate) fn earliest(&mut self) -> Option<MessageLatency> {
        let ((_, key), _) = self.order.pop_first()?;
        self.give(key)
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
            published_ns: sequence.cast_signed(),
            epoch: 1,
            reserved: 0,
        })
    }

    fn taken(sequence: u64) -> Record {
        Record::Taken(TakenRecord {
            sequence,
            published_ns: sequence.cast_signed(),
            forwarded_ns: UNAVAILABLE,
            taken_ns: sequence.cast_signed() + 30,
            epoch: 1,
            reserved: 0,
        })
    }

    #[test]
    fn messages_are_given_out_once_and_in_their_order() {
        let mut joining = Joining::new(&[Stage::Published, Stage::Taken]);
        let start = Instant::now();
        for sequence in 0..3 {
            joining.take(&published(sequence), start);
        }
        joining.take(&taken(1), start);
        assert!(joining.next(start + WAIT / 2).is_none(), "0 may still come");
        joining.take(&taken(0), start);
        let mut given = || joining.next(start).map(|one| (one.sequence, one.taken_ns));
        assert_eq!(given(), Some((0, Some(30))));
        assert_eq!(given(), Some((1, Some(31))));
        assert_eq!(given(), None);
        let partial = joining.next(start + WAIT).unwrap();
        assert_eq!((partial.sequence, partial.taken_ns), (2, None));
        // Given out once, whatever comes.
        joining.take(&taken(2), start);
        assert_eq!(joining.late_count, 1);
        assert!(joining.earliest().is_none());
    }

    #[test]
    fn a_lost_message_holds_up_the_others_for_a_moment() {
        let mut joining = Joining::new(&[Stage::Published, Stage::Taken]);
        let start = Instant::now();
        let after = u64::try_from(OVERTAKEN_NS).unwrap();
        for sequence in [0, 1, after - 1] {
            joining.take(&published(sequence), start);
        }
        joining.take(&taken(1), start);
        joining.take(&taken(after - 1), start);
        assert!(joining.next(start).is_none());
        joining.take(&published(after), start);
        joining.take(&taken(after), start);
        let given = core::iter::from_fn(|| joining.next(start));
        let given: Vec<(u64, bool)> = given
            .map(|one| (one.sequence, one.taken_ns.is_some()))
            .collect();
        assert_eq!(
            given,
            [(0, false), (1, true), (after - 1, true), (after, true)]
        );
    }

    #[test]
    fn no_more_than_so_many_wait() {
        let mut joining = Joining::new(&[Stage::Published, Stage::Taken]);
        let start = Instant::now();
        for sequence in 0..WAITING_MAX as u64 {
            joining.take(&published(sequence), start);
            assert!(joining.next(start).is_none());
        }
        joining.take(&published(WAITING_MAX as u64), start);
        assert_eq!(joining.next(start).unwrap().sequence, 0);
        assert!(joining.next(start).is_none());
    }
}
