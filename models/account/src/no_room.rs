//! Datagrams for which a receiving host had no room, beside the messages of their flow that are missing. The kernel
//! notes with each datagram how many it dropped before (`SO_RXQ_OVFL`, socket(7)), so between two messages that came
//! the dropped and the missing are counts of one stretch. Where they are equal, the missing are the dropped.

use super::stage::MessageFate;
use super::{AccountContext, ChannelRecords, MessageHistory, each_history};
use hil_core::record::{EgressRecord, NoRoomRecord, RoundTripRecord, stamp};

/// A stretch between two messages of a flow that came, in which the host dropped some.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NoRoom {
    /// When the message before was handed to the kernel, on the sender's clock.
    after_ns: i64,
    /// When the message behind was.
    before_ns: i64,
    /// Datagrams that were dropped.
    dropped_count: u64,
    /// Datagrams of the flow that were handed over in between and are missing.
    missing_count: u64,
}

/// Clock requests in a row that an account asks after: those of a week at ten a second.
const REQUESTS_MAX: u64 = 6_048_000;

impl NoRoom {
    /// The stretches of a flow, in order, without what is missing in them.
    pub fn of(records: impl Iterator<Item = NoRoomRecord>) -> Vec<Self> {
        let mut all: Vec<Self> = records
            .map(|record| Self {
                after_ns: record.after_ns,
                before_ns: stamp(record.before_ns).unwrap_or(i64::MAX),
                dropped_count: record.datagram_count,
                missing_count: 0,
            })
            .collect();
        all.sort_by_key(|one| one.after_ns);
        all
    }

    fn find(all: &[Self], handed_ns: i64) -> Option<usize> {
        let next = all.partition_point(|one| one.after_ns < handed_ns);
        let index = next.checked_sub(1)?;
        (handed_ns < all[index].before_ns).then_some(index)
    }

    /// Adds the missing datagrams of a channel of the flow.
    pub fn add_missing(
        all: &mut [Self],
        records: &ChannelRecords<'_>,
        context: &AccountContext<'_>,
    ) {
        each_history(records, context, |message| {
            let Some(index) = message.handed_ns().and_then(|ns| Self::find(all, ns)) else {
                return;
            };
            all[index].missing_count += missing_pieces(message);
        });
    }

    /// Adds the flow's clock requests that nothing answered: their numbers are missing among `exchanges`, which
    /// are in order. Requests are sent at even distances.
    pub fn add_requests<'a>(
        all: &mut [Self],
        exchanges: impl Iterator<Item = &'a RoundTripRecord>,
    ) {
        let mut before: Option<&RoundTripRecord> = None;
        for exchange in exchanges {
            if let Some(last) = before.replace(exchange)
                && last.session == exchange.session
            {
                let steps = exchange.sequence.saturating_sub(last.sequence);
                let apart_ns = exchange.t1_ns.saturating_sub(last.t1_ns);
                // A number that is further on than a run has requests is no request's.
                for step in 1..steps.min(REQUESTS_MAX) {
                    let since_ns = i128::from(apart_ns) * i128::from(step) / i128::from(steps);
                    let since_ns = i64::try_from(since_ns).unwrap_or(i64::MAX);
                    if let Some(index) = Self::find(all, last.t1_ns.saturating_add(since_ns)) {
                        all[index].missing_count += 1;
                    }
                }
            }
        }
    }

    /// What became of a message that was handed over and did not come, by the stretch in which that was.
    pub(super) fn fate(all: &[Self], handed_ns: i64) -> Option<MessageFate> {
        let one = all[Self::find(all, handed_ns)?];
        Some(if one.missing_count == one.dropped_count {
            MessageFate::LostByHarness
        } else {
            MessageFate::LostOnWireOrByHarness
        })
    }
}

/// Pieces of a message that left and did not come.
fn missing_pieces(message: &MessageHistory) -> u64 {
    let has_left = |one: &EgressRecord| one.flags & EgressRecord::REFUSED_BY_KERNEL == 0;
    let sent = message.egress.filter(has_left);
    let sent = sent.map_or(0, |record| record.fragment_count);
    let came = message.ingress.map_or(0, |record| record.fragment_count);
    u64::from(sent.saturating_sub(came))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{Files, HANDED_NS, PERIOD_NS, at, same_clock};
    use crate::{ChannelAccount, account};

    /// Messages 10 to 14 of 100 are missing; the host dropped `dropped_count` between 9 and 15, and number 50 is
    /// missing without any drop.
    fn judged(dropped_count: u64, exchanges: &[RoundTripRecord]) -> ChannelAccount {
        let mut files = Files::default();
        for sequence in 0..100 {
            let fate = match sequence {
                10..15 | 50 => MessageFate::LostOnWire,
                _ => MessageFate::Taken,
            };
            files.write(at(7, sequence), fate);
        }
        let record = NoRoomRecord {
            after_ns: 9 * PERIOD_NS + HANDED_NS,
            before_ns: 15 * PERIOD_NS + HANDED_NS,
            noticed_ns: 16 * PERIOD_NS,
            datagram_count: dropped_count,
        };
        let context = same_clock(1_000 * PERIOD_NS);
        let mut no_room = NoRoom::of([record].into_iter());
        NoRoom::add_missing(&mut no_room, &files.records(), &context);
        NoRoom::add_requests(&mut no_room, exchanges.iter());
        let context = AccountContext {
            no_room: &no_room,
            ..context
        };
        account(&files.records(), &context)
    }

    fn fates(account: &ChannelAccount) -> [u64; 3] {
        use MessageFate::{LostByHarness, LostOnWire, LostOnWireOrByHarness};
        [LostByHarness, LostOnWireOrByHarness, LostOnWire].map(|fate| account.fates.of(fate))
    }

    #[test]
    fn what_is_missing_where_as_much_was_dropped_was_lost_by_the_harness() {
        assert_eq!(fates(&judged(5, &[])), [5, 0, 1]);
        assert_eq!(fates(&judged(4, &[])), [0, 5, 1], "one was lost elsewhere");
        assert_eq!(
            fates(&judged(6, &[])),
            [0, 5, 1],
            "one was of something else"
        );
    }

    #[test]
    fn a_request_without_an_answer_counts_among_the_missing() {
        let exchange = |sequence, t1_ns| RoundTripRecord {
            sequence,
            t1_ns,
            t2_ns: 0,
            t3_ns: 0,
            t4_ns: 0,
            session: 41,
            sources: [0; 4],
        };
        // Number 3 left at 13 ms.
        let exchanges = [exchange(2, 3 * PERIOD_NS), exchange(4, 23 * PERIOD_NS)];
        assert_eq!(fates(&judged(6, &exchanges)), [5, 0, 1]);
        assert_eq!(fates(&judged(5, &exchanges)), [0, 5, 1]);
    }
}
