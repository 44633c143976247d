//! Joins the record files of one channel by (start of the producer, sequence number). It knows
//! keys, not fates.

use std::collections::BTreeMap;
use std::rc::Rc;

use super::follow_up::FollowUps;
use super::{ChannelRecords, RecordSource, each};
use hil_core::record::{
    EgressRecord, IngressRecord, PublishedRecord, TakenRecord, UNAVAILABLE, stamp,
};
use hil_stats::in_order::{InOrder, in_order};

/// A message's place: the order of the producer's starts, then the sequence number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Key {
    /// Rank of the producer's start, from 0.
    pub epoch_rank: u32,
    /// Sequence number.
    pub sequence: u64,
}

/// Everything recorded about one message.
#[derive(Debug, Clone, Copy)]
pub struct Joined {
    /// Its place.
    pub key: Key,
    /// 1, or the length of a run of sequence numbers that no file mentions.
    pub count: u64,
    /// The producer's.
    pub published: Option<PublishedRecord>,
    /// The sending gateway's.
    pub egress: Option<EgressRecord>,
    /// The receiving gateway's.
    pub ingress: Option<IngressRecord>,
    /// The consumer's.
    pub taken: Option<TakenRecord>,
    /// From handing it to the kernel to its transmit stamp, as the sender reported.
    pub handed_to_tx_ns: Option<i64>,
}

impl Joined {
    /// What the receiving gateway noted of the whole message; `None` also where only pieces of it came.
    pub fn arrived(&self) -> Option<IngressRecord> {
        let is_whole = |one: &IngressRecord| one.flags & IngressRecord::INCOMPLETE == 0;
        self.ingress.filter(is_whole)
    }

    /// The producer's stamp, from whichever record carries it.
    pub fn published_ns(&self) -> Option<i64> {
        let stamps = [
            self.published.map(|record| record.published_ns),
            self.egress.map(|record| record.published_ns),
            self.ingress.map(|record| record.published_ns),
            self.taken.map(|record| record.published_ns),
        ];
        stamps.into_iter().flatten().find_map(stamp)
    }

    const fn empty(key: Key, count: u64) -> Self {
        Self {
            key,
            count,
            published: None,
            egress: None,
            ingress: None,
            taken: None,
            handed_to_tx_ns: None,
        }
    }
}

trait Keyed {
    fn epoch(&self) -> u32;
    fn sequence(&self) -> u64;
    fn published_ns(&self) -> i64;
}

macro_rules! keyed {
    ($($record:ty),+) => {$(
        impl Keyed for $record {
            fn epoch(&self) -> u32 {
                self.epoch
            }
            fn sequence(&self) -> u64 {
                self.sequence
            }
            fn published_ns(&self) -> i64 {
                self.published_ns
            }
        }
    )+};
}
keyed!(PublishedRecord, EgressRecord, IngressRecord, TakenRecord);

/// The starts of the producer, ordered by their first publication, which every record carries.
#[derive(Debug, Default)]
struct Epochs {
    first_published_ns: BTreeMap<u32, i64>,
}

impl Epochs {
    /// Gives the last key of the records: start of the producer, not yet its rank, and number.
    fn see<R: Keyed>(&mut self, source: Option<&dyn RecordSource<R>>) -> LastOfEpochs {
        let mut last = LastOfEpochs::new();
        let mut current: Option<(u32, i64, u64)> = None;
        for record in each(source) {
            let published_ns = stamp(record.published_ns()).unwrap_or(i64::MAX);
            // Runs of one epoch touch the maps once.
            match &mut current {
                Some((epoch, first_ns, highest)) if *epoch == record.epoch() => {
                    *first_ns = (*first_ns).min(published_ns);
                    *highest = (*highest).max(record.sequence());
                }
                _ => {
                    self.note(current, &mut last);
                    current = Some((record.epoch(), published_ns, record.sequence()));
                }
            }
        }
        self.note(current, &mut last);
        last
    }

    fn note(&mut self, run: Option<(u32, i64, u64)>, last: &mut LastOfEpochs) {
        if let Some((epoch, published_ns, highest)) = run {
            let first_ns = self.first_published_ns.entry(epoch).or_insert(i64::MAX);
            *first_ns = (*first_ns).min(published_ns);
            let known = last.entry(epoch).or_insert(highest);
            *known = (*known).max(highest);
        }
    }

    /// Epoch to rank.
    fn ranks(&self) -> BTreeMap<u32, u32> {
        let mut order: Vec<(i64, u32)> = self
            .first_published_ns
            .iter()
            .map(|(epoch, first_ns)| (*first_ns, *epoch))
            .collect();
        order.sort_unstable();
        order.into_iter().map(|(_, epoch)| epoch).zip(0..).collect()
    }
}

/// The highest number of each start of the producer in one file.
type LastOfEpochs = BTreeMap<u32, u64>;

/// The place of the last of them.
fn last_key(last: &LastOfEpochs, ranks: &BTreeMap<u32, u32>) -> Option<Key> {
    let keys = last.iter().map(|(epoch, sequence)| Key {
        epoch_rank: ranks[epoch],
        sequence: *sequence,
    });
    keys.max()
}

/// The records of one file in key order, read group by group.
struct Cursor<'a, R> {
    order: InOrder<Key, R, Box<dyn Iterator<Item = (Key, R)> + 'a>>,
}

impl<'a, R: Keyed + 'a> Cursor<'a, R> {
    fn new(source: Option<&'a dyn RecordSource<R>>, ranks: &Rc<BTreeMap<u32, u32>>) -> Self {
        let read = || -> Box<dyn Iterator<Item = (Key, R)> + 'a> {
            let ranks = Rc::clone(ranks);
            let mut current: Option<(u32, u32)> = None;
            Box::new(each(source).map(move |record| {
                let epoch = record.epoch();
                let epoch_rank = match current {
                    Some((known, rank)) if known == epoch => rank,
                    _ => ranks[&epoch],
                };
                current = Some((epoch, epoch_rank));
                let sequence = record.sequence();
                let key = Key {
                    epoch_rank,
                    sequence,
                };
                (key, record)
            }))
        };
        Self {
            order: in_order(read),
        }
    }

    fn head(&mut self) -> Option<Key> {
        self.order.head()
    }

    /// The next record of `key`, in the order written; passes over it.
    fn next_of(&mut self, key: Key) -> Option<R> {
        if self.head() != Some(key) {
            return None;
        }
        self.order.next().map(|(_, record)| record)
    }

    /// The first record of `key`; passes over all of them.
    fn first_of(&mut self, key: Key) -> Option<R> {
        let first = self.next_of(key);
        while self.next_of(key).is_some() {}
        first
    }
}

/// All messages of a channel in key order, with the runs nobody mentions between them. It reads the
/// records from their source three times and holds few of them.
pub(super) struct Join<'a> {
    published: Cursor<'a, PublishedRecord>,
    egress: Cursor<'a, EgressRecord>,
    ingress: Cursor<'a, IngressRecord>,
    taken: Cursor<'a, TakenRecord>,
    follow_ups: FollowUps,
    /// The last message the sending gateway took.
    pub(super) last_egress: Option<Key>,
    /// The last message the consumer took.
    pub(super) last_taken: Option<Key>,
    /// Starts of the producer that left a message.
    pub(super) epoch_count: u64,
    next: Key,
}

impl<'a> Join<'a> {
    pub(super) fn new(records: &ChannelRecords<'a>) -> Self {
        let mut epochs = Epochs::default();
        epochs.see(records.published);
        let egress = epochs.see(records.egress);
        epochs.see(records.ingress);
        let taken = epochs.see(records.taken);
        let ranks = Rc::new(epochs.ranks());
        Self {
            published: Cursor::new(records.published, &ranks),
            egress: Cursor::new(records.egress, &ranks),
            ingress: Cursor::new(records.ingress, &ranks),
            taken: Cursor::new(records.taken, &ranks),
            follow_ups: FollowUps::new(records),
            last_egress: last_key(&egress, &ranks),
            last_taken: last_key(&taken, &ranks),
            epoch_count: ranks.len() as u64,
            next: Key {
                epoch_rank: 0,
                sequence: 0,
            },
        }
    }

    fn gather(&mut self, key: Key) -> Joined {
        let mut joined = Joined::empty(key, 1);
        joined.published = self.published.first_of(key);
        while let Some(record) = self.ingress.next_of(key) {
            // The copy that was forwarded is the message, the others are its duplicates.
            let is_better = joined.ingress.is_none_or(|best| {
                best.forwarded_ns == UNAVAILABLE && record.forwarded_ns != UNAVAILABLE
            });
            if is_better {
                joined.ingress = Some(record);
            }
        }
        let session = joined.ingress.map(|record| record.session);
        while let Some(record) = self.egress.next_of(key) {
            // A restarted gateway may send a message again; keep the sending that arrived.
            let is_better = joined.egress.is_none_or(|best| {
                Some(best.session) != session && Some(record.session) == session
            });
            if is_better {
                joined.egress = Some(record);
            }
        }
        joined.taken = self.taken.first_of(key);
        if let Some(ingress) = joined.ingress {
            joined.handed_to_tx_ns = self.follow_ups.find(ingress.session, key.sequence);
        }
        joined
    }
}

impl Iterator for Join<'_> {
    type Item = Joined;

    fn next(&mut self) -> Option<Joined> {
        let heads = [
            self.published.head(),
            self.egress.head(),
            self.ingress.head(),
            self.taken.head(),
        ];
        let key = heads.into_iter().flatten().min()?;
        if key.epoch_rank != self.next.epoch_rank {
            self.next = Key {
                epoch_rank: key.epoch_rank,
                sequence: 0,
            };
        }
        if key.sequence > self.next.sequence {
            let silent = Joined::empty(self.next, key.sequence - self.next.sequence);
            self.next = key;
            return Some(silent);
        }
        self.next.sequence = key.sequence.saturating_add(1);
        Some(self.gather(key))
    }
}
