//! Joins the record files of one channel by (start of the producer, sequence number). It knows
//! keys, not fates.

use std::collections::BTreeMap;

use super::ChannelRecords;
use crate::measure::record::{
    EgressRecord, IngressRecord, PublishedRecord, TakenRecord, UNAVAILABLE,
};

/// A message's place: the order of the producer's starts, then the sequence number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Key {
    pub(super) epoch_rank: u32,
    pub(super) sequence: u64,
}

/// Everything recorded about one message.
#[derive(Debug, Clone, Copy)]
pub(super) struct Joined<'a> {
    pub(super) key: Key,
    /// 1, or the length of a run of sequence numbers that no file mentions.
    pub(super) count: u64,
    pub(super) published: Option<&'a PublishedRecord>,
    pub(super) egress: Option<&'a EgressRecord>,
    pub(super) ingress: Option<&'a IngressRecord>,
    pub(super) taken: Option<&'a TakenRecord>,
    pub(super) handed_to_tx_ns: Option<i64>,
}

impl Joined<'_> {
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

/// `None` for the stamp that was not available.
pub(super) const fn stamp(ns: i64) -> Option<i64> {
    if ns == UNAVAILABLE { None } else { Some(ns) }
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
    fn see<R: Keyed>(&mut self, records: Option<&[R]>) {
        let mut current: Option<(u32, i64)> = None;
        for record in records.unwrap_or_default() {
            let published_ns = stamp(record.published_ns()).unwrap_or(i64::MAX);
            // Runs of one epoch touch the map once.
            match &mut current {
                Some((epoch, first_ns)) if *epoch == record.epoch() => {
                    *first_ns = (*first_ns).min(published_ns);
                }
                _ => {
                    self.note(current);
                    current = Some((record.epoch(), published_ns));
                }
            }
        }
        self.note(current);
    }

    fn note(&mut self, run: Option<(u32, i64)>) {
        if let Some((epoch, published_ns)) = run {
            let first_ns = self.first_published_ns.entry(epoch).or_insert(i64::MAX);
            *first_ns = (*first_ns).min(published_ns);
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

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Entry {
    key: Key,
    index: u32,
}

/// One file in key order, read group by group.
#[derive(Debug)]
struct Cursor<'a, R> {
    records: &'a [R],
    entries: Vec<Entry>,
    position: usize,
}

impl<'a, R: Keyed> Cursor<'a, R> {
    fn new(records: Option<&'a [R]>, ranks: &BTreeMap<u32, u32>) -> Self {
        let records = records.unwrap_or_default();
        let mut current: Option<(u32, u32)> = None;
        let mut entries: Vec<Entry> = records
            .iter()
            .zip(0_u32..)
            .map(|(record, index)| {
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
                Entry { key, index }
            })
            .collect();
        entries.sort_unstable();
        Self {
            records,
            entries,
            position: 0,
        }
    }

    fn head(&self) -> Option<Key> {
        self.entries.get(self.position).map(|entry| entry.key)
    }

    fn last(&self) -> Option<Key> {
        self.entries.last().map(|entry| entry.key)
    }

    /// The records of `key`, in the order written; passes over them.
    fn take(&mut self, key: Key) -> impl Iterator<Item = &'a R> + use<'_, 'a, R> {
        let start = self.position;
        while self.head() == Some(key) {
            self.position += 1;
        }
        let group = &self.entries[start..self.position];
        group
            .iter()
            .map(|entry| &self.records[entry.index as usize])
    }
}

/// Transmit stamps reported by the sender, found by its session.
#[derive(Debug, Default)]
struct FollowUps {
    entries: Vec<(u32, u64, i64)>,
    /// Sequence numbers up to this occur in more than one epoch of the session, so a stamp for
    /// them could belong to either message.
    ambiguous_to: BTreeMap<u32, u64>,
}

impl FollowUps {
    fn new(records: &ChannelRecords<'_>) -> Self {
        let Some(follow_up) = records.follow_up else {
            return Self::default();
        };
        let mut entries: Vec<_> = follow_up
            .iter()
            .map(|record| (record.session, record.sequence, record.handed_to_tx_ns))
            .collect();
        entries.sort_unstable();
        let mut highest: BTreeMap<(u32, u32), u64> = BTreeMap::new();
        for record in records.ingress.unwrap_or_default() {
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
            entries,
            ambiguous_to,
        }
    }

    fn find(&self, session: u32, sequence: u64) -> Option<i64> {
        if self
            .ambiguous_to
            .get(&session)
            .is_some_and(|to| sequence <= *to)
        {
            return None;
        }
        let wanted = (session, sequence);
        let start = self
            .entries
            .partition_point(|entry| (entry.0, entry.1) < wanted);
        let found = self.entries.get(start)?;
        ((found.0, found.1) == wanted).then_some(found.2)
    }
}

/// All messages of a channel in key order, with the runs nobody mentions between them.
#[derive(Debug)]
pub(super) struct Join<'a> {
    published: Cursor<'a, PublishedRecord>,
    egress: Cursor<'a, EgressRecord>,
    ingress: Cursor<'a, IngressRecord>,
    taken: Cursor<'a, TakenRecord>,
    follow_ups: FollowUps,
    epoch_count: u64,
    next: Key,
}

impl<'a> Join<'a> {
    pub(super) fn new(records: &ChannelRecords<'a>) -> Self {
        let mut epochs = Epochs::default();
        epochs.see(records.published);
        epochs.see(records.egress);
        epochs.see(records.ingress);
        epochs.see(records.taken);
        let ranks = epochs.ranks();
        Self {
            published: Cursor::new(records.published, &ranks),
            egress: Cursor::new(records.egress, &ranks),
            ingress: Cursor::new(records.ingress, &ranks),
            taken: Cursor::new(records.taken, &ranks),
            follow_ups: FollowUps::new(records),
            epoch_count: ranks.len() as u64,
            next: Key {
                epoch_rank: 0,
                sequence: 0,
            },
        }
    }

    /// Starts of the producer that left a message.
    pub(super) const fn epoch_count(&self) -> u64 {
        self.epoch_count
    }

    /// The last message the sending gateway took.
    pub(super) fn last_egress(&self) -> Option<Key> {
        self.egress.last()
    }

    /// The last message the consumer took.
    pub(super) fn last_taken(&self) -> Option<Key> {
        self.taken.last()
    }

    fn gather(&mut self, key: Key) -> Joined<'a> {
        let mut joined = Joined::empty(key, 1);
        joined.published = self.published.take(key).next();
        for record in self.ingress.take(key) {
            // The copy that was forwarded is the message, the others are its duplicates.
            let is_better = joined.ingress.is_none_or(|best| {
                best.forwarded_ns == UNAVAILABLE && record.forwarded_ns != UNAVAILABLE
            });
            if is_better {
                joined.ingress = Some(record);
            }
        }
        let session = joined.ingress.map(|record| record.session);
        for record in self.egress.take(key) {
            // A restarted gateway may send a message again; keep the sending that arrived.
            let is_better = joined.egress.is_none_or(|best| {
                Some(best.session) != session && Some(record.session) == session
            });
            if is_better {
                joined.egress = Some(record);
            }
        }
        joined.taken = self.taken.take(key).next();
        if let Some(ingress) = joined.ingress {
            joined.handed_to_tx_ns = self.follow_ups.find(ingress.session, key.sequence);
        }
        joined
    }
}

impl<'a> Iterator for Join<'a> {
    type Item = Joined<'a>;

    fn next(&mut self) -> Option<Joined<'a>> {
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
