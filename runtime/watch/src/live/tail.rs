//! The newest records of one channel, and the account of them: the same that the run's report has,
//! of the messages of a window. It reads no file.

use core::ops::RangeInclusive;

use hil_account::{AccountContext, ChannelAccount, ChannelRecords, account};
use hil_core::record::{
    EgressRecord, FollowUpRecord, IngressRecord, PublishedRecord, TakenRecord, UNAVAILABLE,
};

use super::observer::Arrival;
use crate::Batch;
use hil_rundir::record::RecordKind;

/// Records of the messages that were published last.
#[derive(Debug, Default)]
pub(crate) struct ChannelTail {
    published: Option<Vec<PublishedRecord>>,
    egress: Option<Vec<EgressRecord>>,
    ingress: Option<Vec<IngressRecord>>,
    follow_up: Option<Vec<FollowUpRecord>>,
    taken: Option<Vec<TakenRecord>>,
    newest: Newest,
}

/// The newest stamps among the records.
#[derive(Debug, Default)]
struct Newest {
    /// Publication, on the clock of the producer's host.
    published_ns: Option<i64>,
    /// Of a process of this host.
    here_ns: Option<i64>,
}

/// What every record of a message says.
trait OfMessage: Copy {
    fn epoch(&self) -> u32;
    fn sequence(&self) -> u64;
    fn published_ns(&self) -> i64;
    /// When this host had it last.
    fn here_ns(&self) -> i64;
    fn renumbered(self, sequence: u64) -> Self;
}

macro_rules! of_message {
    ($($record:ty: $here:ident),+ $(,)?) => {$(
        impl OfMessage for $record {
            fn epoch(&self) -> u32 {
                self.epoch
            }
            fn sequence(&self) -> u64 {
                self.sequence
            }
            fn published_ns(&self) -> i64 {
                self.published_ns
            }
            fn here_ns(&self) -> i64 {
                self.$here
            }
            fn renumbered(self, sequence: u64) -> Self {
                Self { sequence, ..self }
            }
        }
    )+};
}
of_message! {
    PublishedRecord: published_ns,
    EgressRecord: handed_ns,
    IngressRecord: received_ns,
    TakenRecord: taken_ns,
}

impl ChannelTail {
    /// Adds what came, if it is of a kind that accounts are made of.
    pub(crate) fn add(&mut self, batch: &Batch<'_>) {
        match batch.header.kind {
            RecordKind::Published => extend(&mut self.published, batch.records(), &mut self.newest),
            RecordKind::Egress => extend(&mut self.egress, batch.records(), &mut self.newest),
            RecordKind::Ingress => extend(&mut self.ingress, batch.records(), &mut self.newest),
            RecordKind::Taken => extend(&mut self.taken, batch.records(), &mut self.newest),
            RecordKind::FollowUp => {
                let kept = self.follow_up.get_or_insert_default();
                kept.extend(batch.records::<FollowUpRecord>());
            }
            _ => {}
        }
    }

    /// Knows from now on that records of this kind are at hand: that a message has none then means
    /// something.
    pub(crate) fn expect(&mut self, kind: RecordKind) {
        match kind {
            RecordKind::Published => drop(self.published.get_or_insert_default()),
            RecordKind::Egress => drop(self.egress.get_or_insert_default()),
            RecordKind::Ingress => drop(self.ingress.get_or_insert_default()),
            RecordKind::Taken => drop(self.taken.get_or_insert_default()),
            _ => {}
        }
    }

    /// Forgets messages published more than `span_ns` before the newest one, and all of them when
    /// nothing came here within `span_ns` before `now_ns`.
    pub(crate) fn trim(&mut self, span_ns: i64, now_ns: i64) {
        let is_silent = self
            .newest
            .here_ns
            .is_none_or(|at| now_ns.saturating_sub(at) > span_ns);
        let oldest_ns = if is_silent {
            i64::MAX
        } else {
            let newest_ns = self.newest.published_ns.unwrap_or(i64::MIN);
            newest_ns.saturating_sub(span_ns)
        };
        keep(&mut self.published, oldest_ns);
        keep(&mut self.egress, oldest_ns);
        keep(&mut self.ingress, oldest_ns);
        keep(&mut self.taken, oldest_ns);
        let lowest = self
            .lowest()
            .into_iter()
            .map(|(_, sequence)| sequence)
            .min();
        if let Some(follow_up) = &mut self.follow_up {
            follow_up.retain(|one| lowest.is_some_and(|lowest| one.sequence >= lowest));
        }
    }

    /// The messages that a gateway of this host brought, in the order in which they came.
    pub(crate) fn arrivals(&self) -> Vec<Arrival> {
        const NEVER_CAME: u32 =
            IngressRecord::DUPLICATE | IngressRecord::LATE | IngressRecord::INCOMPLETE;
        let received = self.ingress.iter().flatten();
        let came = received.filter(|one| one.flags & NEVER_CAME == 0);
        came.map(|one| Arrival {
            at_ns: one.received_ns,
            epoch: one.epoch,
            sequence: one.sequence,
        })
        .collect()
    }

    /// True when no record of the channel is at hand.
    pub(crate) fn is_empty(&self) -> bool {
        self.newest.here_ns.is_none()
    }

    /// The account of the messages published within `span_ns`, which ends `settling_ns` before the
    /// newest publication: by then all who met them have written it down. Their numbers begin at 0
    /// in it.
    pub(crate) fn account(
        &self,
        span_ns: i64,
        settling_ns: i64,
        context: &AccountContext<'_>,
    ) -> ChannelAccount {
        let newest_ns = self.newest.published_ns.unwrap_or(i64::MIN);
        let until_ns = newest_ns.saturating_sub(settling_ns);
        let window = until_ns.saturating_sub(span_ns)..=until_ns;
        let chosen = Self {
            published: within(self.published.as_deref(), &window),
            egress: within(self.egress.as_deref(), &window),
            ingress: within(self.ingress.as_deref(), &window),
            follow_up: self.follow_up.clone(),
            taken: within(self.taken.as_deref(), &window),
            ..Self::default()
        };
        chosen.whole_account(context)
    }

    fn whole_account(&self, context: &AccountContext<'_>) -> ChannelAccount {
        let lowest = self.lowest();
        let published = renumber(self.published.as_deref(), &lowest);
        let egress = renumber(self.egress.as_deref(), &lowest);
        let ingress = renumber(self.ingress.as_deref(), &lowest);
        let taken = renumber(self.taken.as_deref(), &lowest);
        // They name no start of the producer: with several they could be of any.
        let follow_up = match lowest.as_slice() {
            [(_, first)] => self.follow_up.as_deref().map(|records| {
                let each = records.iter();
                let kept = each.filter(|one| one.sequence >= *first);
                kept.map(|one| FollowUpRecord {
                    sequence: one.sequence - *first,
                    ..*one
                })
                .collect::<Vec<_>>()
            }),
            _ => None,
        };
        let records = ChannelRecords {
            published: published.as_ref().map(|records| records as _),
            egress: egress.as_ref().map(|records| records as _),
            ingress: ingress.as_ref().map(|records| records as _),
            follow_up: follow_up.as_ref().map(|records| records as _),
            taken: taken.as_ref().map(|records| records as _),
        };
        account(&records, context)
    }

    /// The lowest kept number of each start of the producer.
    fn lowest(&self) -> Vec<(u32, u64)> {
        let mut lowest = Vec::new();
        note_lowest(self.published.as_deref(), &mut lowest);
        note_lowest(self.egress.as_deref(), &mut lowest);
        note_lowest(self.ingress.as_deref(), &mut lowest);
        note_lowest(self.taken.as_deref(), &mut lowest);
        lowest
    }
}

/// Appends `new` and notes the newest stamps among it.
fn extend<R: OfMessage>(
    kept: &mut Option<Vec<R>>,
    new: impl Iterator<Item = R>,
    newest: &mut Newest,
) {
    let kept = kept.get_or_insert_default();
    let known = |ns: i64| Some(ns).filter(|ns| *ns != UNAVAILABLE);
    for record in new {
        newest.published_ns = newest.published_ns.max(known(record.published_ns()));
        newest.here_ns = newest.here_ns.max(known(record.here_ns()));
        kept.push(record);
    }
}

fn keep<R: OfMessage>(records: &mut Option<Vec<R>>, oldest_ns: i64) {
    if let Some(records) = records {
        records.retain(|one| one.published_ns() >= oldest_ns);
    }
}

fn within<R: OfMessage>(records: Option<&[R]>, window: &RangeInclusive<i64>) -> Option<Vec<R>> {
    let each = records?.iter().copied();
    Some(
        each.filter(|one| window.contains(&one.published_ns()))
            .collect(),
    )
}

fn note_lowest<R: OfMessage>(records: Option<&[R]>, lowest: &mut Vec<(u32, u64)>) {
    for one in records.unwrap_or_default() {
        match lowest.iter_mut().find(|(epoch, _)| *epoch == one.epoch()) {
            Some((_, sequence)) => *sequence = (*sequence).min(one.sequence()),
            None => lowest.push((one.epoch(), one.sequence())),
        }
    }
}

fn renumber<R: OfMessage>(records: Option<&[R]>, lowest: &[(u32, u64)]) -> Option<Vec<R>> {
    let first = |epoch| {
        let found = lowest.iter().find(|(known, _)| *known == epoch);
        found.map_or(0, |(_, sequence)| *sequence)
    };
    let each = records?.iter();
    Some(
        each.map(|one| one.renumbered(one.sequence() - first(one.epoch())))
            .collect(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_account::{ChannelPath, MessageFate};
    use hil_core::time::Alignment;

    const MS: i64 = 1_000_000;

    /// Messages 100 to 149, one each millisecond from 1 s on; every tenth is not taken.
    fn tail() -> ChannelTail {
        let (mut published, mut taken) = (Vec::new(), Vec::new());
        for number in 100..150_i64 {
            let published_ns = 1_000 * MS + number * MS;
            let (sequence, epoch, reserved) = (number.unsigned_abs(), 3, 0);
            published.push(PublishedRecord {
                sequence,
                published_ns,
                epoch,
                reserved,
            });
            if number % 10 != 5 {
                taken.push(TakenRecord {
                    sequence,
                    published_ns,
                    forwarded_ns: UNAVAILABLE,
                    taken_ns: published_ns + number,
                    epoch,
                    reserved,
                });
            }
        }
        let mut tail = ChannelTail::default();
        extend(&mut tail.published, published.into_iter(), &mut tail.newest);
        extend(&mut tail.taken, taken.into_iter(), &mut tail.newest);
        tail
    }

    fn account_of(tail: &ChannelTail) -> ChannelAccount {
        tail.account(i64::MAX, 0, &AccountContext::new(ChannelPath::SharedMemory))
    }

    #[test]
    fn what_was_before_the_window_is_neither_published_nor_lost() {
        let mut tail = tail();
        let context = AccountContext::new(ChannelPath::SharedMemory);
        assert_eq!(tail.account(20 * MS, 0, &context).published_count, 21);
        let settled = tail.account(20 * MS, 40 * MS, &context);
        assert_eq!(settled.published_count, 10, "100 to 109 had settled");
        tail.trim(20 * MS, 1_150 * MS);
        let account = account_of(&tail);
        // 129 to 149 are within 20 ms of the newest.
        assert_eq!(account.published_count, 21);
        assert_eq!(account.fates.of(MessageFate::Taken), 19);
        assert_eq!(account.fates.of(MessageFate::SupersededAtConsumer), 2);
        let delay = account.end_to_end.distribution.measured().unwrap();
        assert_eq!((delay.min_ns, delay.max_ns), (129, 149));
    }

    #[test]
    fn what_left_and_never_came_is_lost_only_where_its_arrival_would_be_on_record() {
        let mut tail = ChannelTail::default();
        let each = tail_of_sent();
        extend(&mut tail.egress, each.into_iter(), &mut tail.newest);
        let path = ChannelPath::Gateway {
            alignment: Some(Alignment::SAME_CLOCK),
        };
        let context = AccountContext::new(path);
        let fates = |tail: &ChannelTail| tail.account(i64::MAX, 0, &context).fates;
        let unknown = MessageFate::UnknownPeerRecordsUnavailable;
        assert_eq!(fates(&tail).of(unknown), 20);
        tail.expect(RecordKind::Ingress);
        assert_eq!(fates(&tail).of(unknown), 0);
        assert_eq!(fates(&tail).of(MessageFate::LostOnWire), 20);
        assert!(tail.arrivals().is_empty());
    }

    #[test]
    fn only_a_whole_message_is_an_arrival() {
        let flags = [
            0,
            IngressRecord::REORDERED,
            IngressRecord::DUPLICATE,
            IngressRecord::LATE,
            IngressRecord::INCOMPLETE,
        ];
        let each = (0_u64..).zip(flags).map(|(sequence, flags)| IngressRecord {
            sequence,
            flags,
            ..bytemuck::Zeroable::zeroed()
        });
        let mut tail = ChannelTail::default();
        extend(&mut tail.ingress, each, &mut tail.newest);
        let came: Vec<_> = tail.arrivals().iter().map(|one| one.sequence).collect();
        assert_eq!(came, [0, 1]);
    }

    /// What a gateway sent, one message each millisecond.
    fn tail_of_sent() -> Vec<EgressRecord> {
        let one = |number: u64| EgressRecord {
            sequence: number,
            published_ns: number.cast_signed() * MS,
            handed_ns: number.cast_signed() * MS + 10,
            ..bytemuck::Zeroable::zeroed()
        };
        (0..20).map(one).collect()
    }

    #[test]
    fn a_channel_that_fell_silent_has_no_messages_in_the_window() {
        let mut tail = tail();
        tail.trim(20 * MS, 1_200 * MS);
        assert_eq!(account_of(&tail).published_count, 0);
        assert!(!tail.is_empty());
    }
}
