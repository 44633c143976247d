//! The messages of one channel that settled last, and the account of them: the same fold as the run's
//! report, fed while the records come. It reads no file.

use std::collections::VecDeque;

use hil_account::{
    AccountContext, AccountFold, ChannelAccount, ChannelFold, ChannelPath, FirstNumber,
    FoldSettings, MessageHistory, NoRoom, RecordEvent, RecordsAtHand, RunSpan,
};
use hil_core::record::{IngressRecord, NoRoomRecord, stamp};
use hil_core::time::Instant;

use super::observer::Arrival;
use crate::Batch;
use crate::event::Record;
use hil_rundir::record::RecordKind;

/// Most messages of a channel that are held because their fate is not known.
const HELD_MAX: usize = 4_096;
/// Stretches without room that are remembered, the newest ones.
const NO_ROOM_MAX: usize = 1_024;

/// Messages of one channel.
#[derive(Debug)]
pub(crate) struct ChannelTail {
    fold: ChannelFold,
    is_gateway: bool,
    /// See [`AccountContext::has_witness`].
    pub(crate) has_witness: bool,
    /// See [`AccountContext::producer_run`]; `None` where its start is not known on the producer's clock.
    producer_run: Option<RunSpan>,
    /// Nobody counts yet what is missing in them, so what became of it stays open.
    no_room: Vec<NoRoom>,
    /// With the publication of each, or that of the one before where it has none.
    settled: VecDeque<(i64, MessageHistory)>,
    /// What a gateway of this host brought, in the order in which it came.
    arrivals: VecDeque<Arrival>,
    /// The newest publication on record, on the clock of the producer's host.
    newest: Option<Newest>,
    /// Publications up to then have settled.
    settled_until_ns: i64,
    has_noted_late: bool,
}

#[derive(Debug, Clone, Copy)]
struct Newest {
    published_ns: i64,
    /// When it was read, on this host's clock; `None` until the next look at that clock.
    read_ns: Option<i64>,
}

impl ChannelTail {
    /// Of a channel that crosses a link or does not, whose readers have room for `depth` messages.
    pub(crate) fn new(is_gateway: bool, depth: Option<usize>) -> Self {
        Self {
            fold: ChannelFold::new(FoldSettings {
                is_gateway,
                depth,
                first_number: FirstNumber::OnRecord,
                held_max: Some(HELD_MAX),
            }),
            is_gateway,
            has_witness: false,
            producer_run: None,
            no_room: Vec::new(),
            settled: VecDeque::new(),
            arrivals: VecDeque::new(),
            newest: None,
            settled_until_ns: i64::MIN,
            has_noted_late: false,
        }
    }

    /// Knows from now on that the run has not begun: what settles is no message of it, and is forgotten.
    pub(crate) const fn await_begin(&mut self) {
        self.begin(Instant::from_ns(i64::MAX));
    }

    /// Knows from now on when the run began, on the producer's clock: what was published before is no message of it.
    pub(crate) const fn begin(&mut self, start: Instant) {
        let end = Instant::from_ns(i64::MAX);
        self.producer_run = Some(RunSpan { start, end });
    }

    /// Adds what came, if it is of a kind that accounts are made of.
    pub(crate) fn add(&mut self, batch: &Batch<'_>) {
        Record::each(batch, &mut |record| {
            if let Some(event) = record.of_message() {
                self.push(&event);
            }
        });
    }

    /// Adds where the receiving host had no room for datagrams of the channel's flow.
    pub(crate) fn add_no_room(&mut self, records: impl Iterator<Item = NoRoomRecord>) {
        for record in records {
            NoRoom::push(&mut self.no_room, &record);
        }
        let extra_count = self.no_room.len().saturating_sub(NO_ROOM_MAX);
        self.no_room.drain(..extra_count);
    }

    fn push(&mut self, event: &RecordEvent) {
        const NEVER_CAME: u32 =
            IngressRecord::DUPLICATE | IngressRecord::LATE | IngressRecord::INCOMPLETE;
        let published_ns = stamp(event.message().published_ns);
        if let RecordEvent::Ingress(record) = event
            && record.flags & NEVER_CAME == 0
        {
            self.arrivals.push_back(Arrival {
                at_ns: record.received_ns,
                epoch: record.epoch,
                sequence: record.sequence,
            });
        }
        if let Some(published_ns) = published_ns
            && self
                .newest
                .is_none_or(|newest| newest.published_ns < published_ns)
        {
            self.newest = Some(Newest {
                published_ns,
                read_ns: None,
            });
        }
        self.fold.push(event);
    }

    /// Knows from now on that records of this kind are at hand: that a message has none then means
    /// something.
    pub(crate) fn expect(&mut self, kind: RecordKind) {
        self.fold.expect(RecordsAtHand {
            published: kind == RecordKind::Published,
            egress: kind == RecordKind::Egress,
            ingress: kind == RecordKind::Ingress,
            taken: kind == RecordKind::Taken,
        });
    }

    /// Settles what was published `settling_ns` ago: by then all who met it have written it down. How far the
    /// producer's clock has come is known from its newest stamp and from the time since that was read.
    pub(crate) fn settle(&mut self, now_ns: i64, settling_ns: i64) {
        // Without a publication on record nothing is due; only messages beyond the limit settle.
        let until_ns = self.newest.as_mut().map_or(i64::MIN, |newest| {
            let read_ns = *newest.read_ns.get_or_insert(now_ns);
            let passed_ns = now_ns.saturating_sub(read_ns);
            let producer_ns = newest.published_ns.saturating_add(passed_ns);
            producer_ns.saturating_sub(settling_ns)
        });
        self.settled_until_ns = self.settled_until_ns.max(until_ns);
        // No clock but the producer's is asked: no end of the run and no interruption is known.
        let path = if self.is_gateway {
            ChannelPath::Gateway { alignment: None }
        } else {
            ChannelPath::SharedMemory
        };
        let context = AccountContext {
            no_room: &self.no_room,
            has_witness: self.has_witness,
            producer_run: self.producer_run,
            ..AccountContext::new(path)
        };
        let settled = &mut self.settled;
        self.fold
            .settle(&context, self.settled_until_ns, &mut |message| {
                let before_ns = settled.back().map(|(at_ns, _)| *at_ns);
                let at_ns = message.published_ns().or(before_ns);
                settled.push_back((at_ns.unwrap_or(until_ns), *message));
            });
    }

    /// Forgets messages published more than `span_ns` before those that settle now, and arrivals of more than
    /// `span_ns` ago.
    pub(crate) fn trim(&mut self, span_ns: i64, now_ns: i64) {
        let oldest_ns = self.settled_until_ns.saturating_sub(span_ns);
        self.settled.retain(|(at_ns, _)| *at_ns >= oldest_ns);
        let oldest_ns = now_ns.saturating_sub(span_ns);
        self.arrivals.retain(|one| one.at_ns >= oldest_ns);
    }

    /// The messages that a gateway of this host brought, in the order in which they came.
    pub(crate) const fn arrivals(&self) -> &VecDeque<Arrival> {
        &self.arrivals
    }

    /// As [`Self::arrivals`], and forgets them.
    pub(crate) fn take_arrivals(&mut self) -> Vec<Arrival> {
        core::mem::take(&mut self.arrivals).into()
    }

    /// True when no record of the channel is at hand.
    pub(crate) const fn is_empty(&self) -> bool {
        self.newest.is_none()
    }

    /// True once, when the first record came whose message had settled without it.
    pub(crate) const fn notes_late_record(&mut self) -> bool {
        let is_first = self.fold.late_record_count() > 0 && !self.has_noted_late;
        self.has_noted_late |= is_first;
        is_first
    }

    /// The account of the messages published in the last `span_ns` that have settled.
    pub(crate) fn account(&self, span_ns: i64, context: &AccountContext<'_>) -> ChannelAccount {
        let from_ns = self.settled_until_ns.saturating_sub(span_ns);
        let mut fold = AccountFold::new(self.fold.at_hand(), context);
        for (at_ns, message) in &self.settled {
            if *at_ns >= from_ns {
                fold.add(message);
            }
        }
        fold.finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_account::MessageFate;
    use hil_core::record::{EgressRecord, PublishedRecord, TakenRecord, UNAVAILABLE};
    use hil_core::time::Alignment;

    const MS: i64 = 1_000_000;

    /// Messages 100 to 149, one each millisecond from 1.1 s on; every tenth is not taken.
    fn tail() -> ChannelTail {
        let mut tail = ChannelTail::new(false, None);
        for number in 100..150_i64 {
            let published_ns = 1_000 * MS + number * MS;
            let (sequence, epoch, reserved) = (number.unsigned_abs(), 3, 0);
            tail.push(&RecordEvent::Published(PublishedRecord {
                sequence,
                published_ns,
                epoch,
                reserved,
            }));
            if number % 10 != 5 {
                tail.push(&RecordEvent::Taken(TakenRecord {
                    sequence,
                    published_ns,
                    forwarded_ns: UNAVAILABLE,
                    taken_ns: published_ns + number,
                    epoch,
                    reserved,
                }));
            }
        }
        tail
    }

    fn account_of(tail: &ChannelTail, span_ns: i64) -> ChannelAccount {
        tail.account(span_ns, &AccountContext::new(ChannelPath::SharedMemory))
    }

    #[test]
    fn what_was_before_the_window_is_neither_published_nor_lost() {
        let mut tail = tail();
        tail.settle(5_000 * MS, 40 * MS);
        let settled = account_of(&tail, 20 * MS);
        assert_eq!(settled.published_count, 10, "100 to 109 had settled");
        tail.settle(5_000 * MS, 0);
        assert_eq!(account_of(&tail, 20 * MS).published_count, 21);
        tail.trim(20 * MS, 5_000 * MS);
        let account = account_of(&tail, i64::MAX);
        // 129 to 149 are within 20 ms of the newest.
        assert_eq!(account.published_count, 21);
        assert_eq!(account.fates.of(MessageFate::Taken), 19);
        assert_eq!(account.fates.of(MessageFate::SupersededAtConsumer), 2);
        let delay = account.end_to_end.distribution.measured().unwrap();
        assert_eq!((delay.min_ns, delay.max_ns), (129, 149));
    }

    #[test]
    fn what_was_published_before_the_run_began_is_no_message_of_it() {
        let mut tail = tail();
        tail.await_begin();
        // Up to 1.209 s: the newest was read at this very time.
        tail.settle(5_000 * MS, 40 * MS);
        assert_eq!(tail.fold.held_count(), 40, "those before 110 are forgotten");
        assert!(tail.settled.is_empty());
        tail.begin(Instant::from_ns(1_120 * MS));
        tail.settle(5_000 * MS, 0);
        let account = account_of(&tail, i64::MAX);
        assert_eq!(account.published_count, 30, "120 to 149");
        assert_eq!(account.fates.of(MessageFate::Taken), 27);
    }

    #[test]
    fn what_left_and_never_came_is_lost_only_where_its_arrival_would_be_on_record() {
        let path = ChannelPath::Gateway {
            alignment: Some(Alignment::SAME_CLOCK),
        };
        let context = AccountContext::new(path);
        let fates = |is_expected: bool| {
            let mut tail = ChannelTail::new(true, None);
            if is_expected {
                tail.expect(RecordKind::Ingress);
            }
            for record in sent() {
                tail.push(&RecordEvent::Egress(record));
            }
            tail.settle(0, 0);
            assert!(tail.arrivals().is_empty());
            tail.account(i64::MAX, &context).fates
        };
        let unknown = MessageFate::UnknownPeerRecordsUnavailable;
        assert_eq!(fates(false).of(unknown), 20);
        assert_eq!(fates(true).of(unknown), 0);
        assert_eq!(fates(true).of(MessageFate::LostOnWire), 20);
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
        let mut tail = ChannelTail::new(true, None);
        for (sequence, flags) in (0_u64..).zip(flags) {
            tail.push(&RecordEvent::Ingress(IngressRecord {
                sequence,
                flags,
                ..bytemuck::Zeroable::zeroed()
            }));
        }
        let came: Vec<_> = tail.arrivals().iter().map(|one| one.sequence).collect();
        assert_eq!(came, [0, 1]);
        assert_eq!(tail.take_arrivals().len(), 2);
        assert!(tail.arrivals().is_empty());
    }

    /// What a gateway sent, one message each millisecond.
    fn sent() -> Vec<EgressRecord> {
        let one = |number: u64| EgressRecord {
            sequence: number,
            published_ns: number.cast_signed() * MS,
            handed_ns: number.cast_signed() * MS + 10,
            ..bytemuck::Zeroable::zeroed()
        };
        (0..20).map(one).collect()
    }

    #[test]
    fn what_is_missing_where_the_receiving_host_had_no_room_is_not_called_lost_on_the_wire() {
        let mut tail = ChannelTail::new(true, None);
        tail.expect(RecordKind::Ingress);
        for record in sent() {
            tail.push(&RecordEvent::Egress(record));
        }
        let record = NoRoomRecord {
            after_ns: 4 * MS + 10,
            before_ns: 10 * MS + 10,
            noticed_ns: 0,
            datagram_count: 5,
        };
        tail.add_no_room([record].into_iter());
        tail.settle(0, 0);
        let fates = tail
            .account(
                i64::MAX,
                &AccountContext::new(ChannelPath::Gateway { alignment: None }),
            )
            .fates;
        assert_eq!(fates.of(MessageFate::LostOnWireOrByHarness), 5);
        assert_eq!(fates.of(MessageFate::LostOnWire), 15);
    }

    #[test]
    fn a_channel_that_fell_silent_has_no_messages_in_the_window() {
        let mut tail = tail();
        tail.settle(7_000 * MS, 100 * MS);
        assert_eq!(
            account_of(&tail, 20 * MS).published_count,
            0,
            "none has settled"
        );
        // The newest settle although nothing follows them, and leave the window.
        tail.settle(7_100 * MS, 100 * MS);
        assert_eq!(account_of(&tail, 20 * MS).published_count, 21);
        tail.settle(7_200 * MS, 100 * MS);
        tail.trim(20 * MS, 7_200 * MS);
        assert_eq!(account_of(&tail, i64::MAX).published_count, 0);
        assert!(!tail.is_empty());
    }

    #[test]
    fn a_record_that_comes_after_its_message_has_settled_is_noted_once() {
        let mut tail = tail();
        tail.settle(0, 0);
        assert!(!tail.notes_late_record());
        tail.push(&RecordEvent::Taken(TakenRecord {
            sequence: 105,
            published_ns: 1_105 * MS,
            forwarded_ns: UNAVAILABLE,
            taken_ns: 1_400 * MS,
            epoch: 3,
            reserved: 0,
        }));
        assert!(tail.notes_late_record() && !tail.notes_late_record());
    }
}
