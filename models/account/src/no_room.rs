//! Datagrams for which a receiving host had no room, beside the messages of their flow that are missing. The kernel
//! notes with each datagram how many it dropped before (`SO_RXQ_OVFL`, socket(7)), so between two messages that came
//! the dropped and the missing are counts of one stretch. Where they are equal, the missing are the dropped.

use super::stage::MessageFate;
use super::{AccountContext, ChannelRecords, MessageHistory, each_history};
use hil_core::record::{NoRoomRecord, RoundTripRecord, stamp};

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

/// Clock requests in a row that an account asks after: those of a quarter of an hour at the hundred a second of a
/// clock path. No outage that one stretch can hold has more.
const REQUESTS_MAX: u64 = 100_000;

impl NoRoom {
    /// The stretches of a flow, in order, without what is missing in them.
    pub fn of(records: impl Iterator<Item = NoRoomRecord>) -> Vec<Self> {
        let mut records: Vec<NoRoomRecord> = records.collect();
        records.sort_by_key(|one| one.noticed_ns);
        let mut all = Vec::new();
        for record in &records {
            Self::push(&mut all, record);
        }
        all
    }

    /// Adds the stretch of a record that was noticed later than all those before it. A gateway that was started anew
    /// knows no message before: its first stretch begins where the last one ended. Stretches that overlap, also
    /// because the end of the earlier one is unknown, become one.
    pub fn push(all: &mut Vec<Self>, record: &NoRoomRecord) {
        let before_ns = stamp(record.before_ns).unwrap_or(i64::MAX);
        let end_ns = all.last().map_or(i64::MIN, |one| one.before_ns);
        let after_ns = stamp(record.after_ns).unwrap_or(end_ns);
        let is_open = end_ns == i64::MAX;
        if let Some(last) = all.last_mut()
            && (is_open || after_ns < end_ns)
        {
            let from_ns = if is_open { last.after_ns } else { end_ns };
            last.before_ns = before_ns.max(from_ns);
            last.dropped_count = last.dropped_count.saturating_add(record.datagram_count);
            return;
        }
        all.push(Self {
            after_ns,
            before_ns: before_ns.max(after_ns),
            dropped_count: record.datagram_count,
            missing_count: 0,
        });
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
    /// are in order. Requests are sent at even distances. On a sealed flow a request for keys goes before each that
    /// follows `unanswered_max` without an answer.
    pub fn add_requests<'a>(
        all: &mut [Self],
        exchanges: impl Iterator<Item = &'a RoundTripRecord> + Clone,
        unanswered_max: Option<u32>,
    ) {
        let mut answered_ns: Vec<i64> = exchanges.clone().map(|one| one.t4_ns).collect();
        answered_ns.sort_unstable();
        let mut before: Option<&RoundTripRecord> = None;
        for exchange in exchanges {
            if let Some(last) = before.replace(exchange)
                && last.session == exchange.session
                && let Some(gap) = Gap::between(last, exchange)
            {
                let first = all.partition_point(|one| one.before_ns <= last.t1_ns);
                let within = all[first..].iter_mut();
                for one in within.take_while(|one| one.after_ns < exchange.t1_ns) {
                    let after_ns = one.after_ns.max(last.t1_ns);
                    let before_ns = one.before_ns.min(exchange.t1_ns);
                    let (from, until) = (gap.after(after_ns), gap.not_before(before_ns));
                    let mut count = gap.count(from, until);
                    if let Some(max) = unanswered_max {
                        let next = answered_ns.partition_point(|ns| *ns <= after_ns);
                        let answers = &answered_ns[next.saturating_sub(1)..];
                        let answers = answers.iter().take_while(|ns| **ns < before_ns);
                        let mut answers = answers.peekable();
                        while let Some(answer_ns) = answers.next() {
                            let next = answers.peek().map(|ns| gap.not_before(**ns));
                            let asks_from = gap.after(*answer_ns) + i128::from(max);
                            count += gap.count(from.max(asks_from), next.unwrap_or(until));
                        }
                    }
                    one.missing_count = one.missing_count.saturating_add(count);
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

/// Clock requests between two that were answered, by their place behind the first of these.
struct Gap {
    from_ns: i64,
    apart_ns: i64,
    steps: u64,
}

impl Gap {
    /// `None` where none is missing. A number that is further on than an outage has requests is no request's.
    fn between(last: &RoundTripRecord, next: &RoundTripRecord) -> Option<Self> {
        let gap = Self {
            from_ns: last.t1_ns,
            apart_ns: next.t1_ns.saturating_sub(last.t1_ns),
            steps: next.sequence.saturating_sub(last.sequence),
        };
        ((2..=REQUESTS_MAX).contains(&gap.steps) && gap.apart_ns > 0).then_some(gap)
    }

    /// The first place after `at_ns`; below 1 it is of a request before the gap.
    fn after(&self, at_ns: i64) -> i128 {
        let since_ns = i128::from(at_ns) - i128::from(self.from_ns);
        (since_ns * i128::from(self.steps)).div_euclid(self.apart_ns.into()) + 1
    }

    /// The first place not before `at_ns`.
    fn not_before(&self, at_ns: i64) -> i128 {
        let since_ns = i128::from(self.from_ns) - i128::from(at_ns);
        -(since_ns * i128::from(self.steps)).div_euclid(self.apart_ns.into())
    }

    /// How many are missing of those from one place to before another.
    fn count(&self, from: i128, until: i128) -> u64 {
        let count = until.min(self.steps.into()) - from.max(1);
        u64::try_from(count).unwrap_or(0)
    }
}

/// Pieces of a message that left and did not come.
fn missing_pieces(message: &MessageHistory) -> u64 {
    let sent = message.egress.filter(|one| !one.is_refused());
    let sent = sent.map_or(0, |record| record.fragment_count);
    let came = message.ingress.map_or(0, |record| record.fragment_count);
    u64::from(sent.saturating_sub(came))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{Files, HANDED_NS, PERIOD_NS, at, same_clock};
    use crate::{ChannelAccount, account};
    use hil_core::record::IngressRecord;

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
        NoRoom::add_requests(&mut no_room, exchanges.iter(), None);
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

    fn exchange(sequence: u64, t1_ns: i64, t4_ns: i64) -> RoundTripRecord {
        RoundTripRecord {
            sequence,
            t1_ns,
            t2_ns: 0,
            t3_ns: 0,
            t4_ns,
            session: 41,
            sources: [0; 4],
        }
    }

    fn record(after_ns: i64, before_ns: i64, noticed_ns: i64) -> NoRoomRecord {
        NoRoomRecord {
            after_ns,
            before_ns,
            noticed_ns,
            datagram_count: 1,
        }
    }

    fn ends(all: &[NoRoom]) -> Vec<(i64, i64, u64)> {
        let of = |one: &NoRoom| (one.after_ns, one.before_ns, one.dropped_count);
        all.iter().map(of).collect()
    }

    #[test]
    fn pieces_that_come_once_the_others_were_given_up_are_not_missing() {
        let mut files = Files::default();
        files.write(at(0, 0), MessageFate::Incomplete);
        files.egress[0].fragment_count = 10;
        files.ingress[0].fragment_count = 5;
        let late = IngressRecord {
            fragment_count: 4,
            ..files.ingress[0]
        };
        files.ingress.push(late);
        let mut missing = Vec::new();
        each_history(&files.records(), &same_clock(1_000_000_000), |one| {
            missing.push(missing_pieces(one));
        });
        assert_eq!(missing, [1]);
    }

    #[test]
    fn a_request_without_an_answer_counts_among_the_missing() {
        // Number 3 left at 13 ms.
        let exchanges = [
            exchange(2, 3 * PERIOD_NS, 4 * PERIOD_NS),
            exchange(4, 23 * PERIOD_NS, 24 * PERIOD_NS),
        ];
        assert_eq!(fates(&judged(6, &exchanges)), [5, 0, 1]);
        assert_eq!(fates(&judged(5, &exchanges)), [0, 5, 1]);
    }

    #[test]
    fn a_restarted_gateway_has_no_room_from_the_end_of_the_stretch_before() {
        let of = |records: &[NoRoomRecord]| NoRoom::of(records.iter().copied());
        // Records come by file, not by time.
        let all = of(&[record(i64::MIN, 9_000, 30), record(100, 200, 10)]);
        assert_eq!(ends(&all), [(100, 200, 1), (200, 9_000, 1)]);
        assert_eq!(NoRoom::find(&all, 5_000), Some(1));
        assert_eq!(NoRoom::find(&all, 150), Some(0));
        assert_eq!(NoRoom::find(&all, 50), None);
        // The end of the first gateway left open what the second one closes.
        let open = of(&[record(300, i64::MIN, 20), record(i64::MIN, 9_000, 30)]);
        assert_eq!(ends(&open), [(300, 9_000, 2)]);
        let overlap = of(&[record(100, 300, 10), record(200, 400, 20)]);
        assert_eq!(ends(&overlap), [(100, 400, 2)]);
    }

    #[test]
    fn a_sealed_flow_asks_for_keys_before_requests_that_stay_unanswered() {
        const MS: i64 = 1_000_000;
        // A receiver stood still from 150 ms on; 2 to 6 waited in its buffer and were answered at 1400 ms.
        let mut exchanges: Vec<_> = (0..7_i64)
            .map(|one| {
                let t4_ns = if one < 2 { one * 100 + 1 } else { 1_400 };
                exchange(one.unsigned_abs(), one * 100 * MS, t4_ns * MS)
            })
            .collect();
        exchanges.push(exchange(17, 1_700 * MS, 1_701 * MS));
        let missing = |records: &[NoRoomRecord], unanswered_max| {
            let mut all = NoRoom::of(records.iter().copied());
            NoRoom::add_requests(&mut all, exchanges.iter(), unanswered_max);
            all.iter().map(|one| one.missing_count).collect::<Vec<_>>()
        };
        let whole = [record(640 * MS, 1_390 * MS, 1)];
        // Requests 7 to 13, each after a request for keys.
        assert_eq!(missing(&whole, None), [7]);
        assert_eq!(missing(&whole, Some(3)), [14]);
        // The answers at 1400 ms end that: 14 to 16 are without.
        let longer = [record(640 * MS, 1_650 * MS, 1)];
        assert_eq!(missing(&longer, Some(3)), [10 + 7]);
    }

    #[test]
    fn numbers_that_no_outage_has_are_no_requests() {
        let all = |exchanges: [RoundTripRecord; 2]| {
            let mut all = NoRoom::of([record(10, 20, 1)].into_iter());
            NoRoom::add_requests(&mut all, exchanges.iter(), Some(3));
            all[0].missing_count
        };
        assert_eq!(all([exchange(0, 0, 1), exchange(30, 30, 31)]), 9 + 9);
        assert_eq!(all([exchange(0, 0, 1), exchange(u64::MAX, 30, 31)]), 0);
        assert_eq!(all([exchange(0, 30, 31), exchange(30, 0, 1)]), 0);
        let far = [
            exchange(0, i64::MIN, i64::MIN),
            exchange(30, i64::MAX, i64::MAX),
        ];
        assert_eq!(all(far), 0);
    }
}
