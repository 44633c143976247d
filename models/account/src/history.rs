//! What is known of one message: its records, its copies and its fate.

use super::ChannelPath;
use super::network::{Crossing, Passage};
use super::stage::MessageFate;
use hil_core::record::{EgressRecord, IngressRecord, PublishedRecord, TakenRecord, stamp};
use hil_core::time::RemoteInstant;

/// A message's place: the order of the producer's starts, then the sequence number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Key {
    /// Rank of the producer's start, from 0.
    pub epoch_rank: u32,
    /// Sequence number.
    pub sequence: u64,
}

/// Everything that is known of one message, or of some in a row that no record mentions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MessageHistory {
    /// Its place; that of the first of several.
    pub key: Key,
    /// The producer's start, as the records name it.
    pub epoch: u32,
    /// 1, or the length of a run of sequence numbers that no record mentions.
    pub count: u64,
    /// The producer's.
    pub published: Option<PublishedRecord>,
    /// The sending gateway's: of several the one of the sending that arrived.
    pub egress: Option<EgressRecord>,
    /// The receiving gateway's: of several the one of the copy that was forwarded.
    pub ingress: Option<IngressRecord>,
    /// The consumer's.
    pub taken: Option<TakenRecord>,
    /// From handing it to the kernel to its transmit stamp, as the sender reported.
    pub handed_to_tx_ns: Option<i64>,
    /// All its arrivals.
    pub copies: Copies,
    /// Its fate.
    pub fate: MessageFate,
    /// The interruption that cost it, by its place in the context.
    pub interruption_index: Option<usize>,
}

/// What the receiving gateway noted with the copies of a message.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Copies {
    /// Came after a message with a higher number.
    pub reordered_count: u64,
    /// Seen before.
    pub duplicated_count: u64,
    /// Older than the sequence window.
    pub late_count: u64,
    /// When the first of those seen before came, on the consumer's host clock.
    pub second_received_ns: Option<i64>,
}

impl Copies {
    /// Counts one arrival.
    pub(super) fn note(&mut self, record: &IngressRecord) {
        let has = |flag: u32| record.flags & flag != 0;
        self.reordered_count += u64::from(has(IngressRecord::REORDERED));
        self.late_count += u64::from(has(IngressRecord::LATE));
        if has(IngressRecord::DUPLICATE) {
            self.duplicated_count += 1;
            self.second_received_ns.get_or_insert(record.received_ns);
        }
    }

    /// Adds the arrivals of another message.
    pub fn add(&mut self, other: &Self) {
        self.reordered_count += other.reordered_count;
        self.duplicated_count += other.duplicated_count;
        self.late_count += other.late_count;
    }
}

impl MessageHistory {
    /// One of which nothing is known but the start of its producer.
    pub(super) const fn unrecorded(epoch: u32) -> Self {
        Self {
            key: Key {
                epoch_rank: 0,
                sequence: 0,
            },
            epoch,
            count: 1,
            published: None,
            egress: None,
            ingress: None,
            taken: None,
            handed_to_tx_ns: None,
            copies: Copies {
                reordered_count: 0,
                duplicated_count: 0,
                late_count: 0,
                second_received_ns: None,
            },
            fate: MessageFate::Unexplained,
            interruption_index: None,
        }
    }

    /// False for a run of numbers that no record mentions.
    pub const fn is_recorded(&self) -> bool {
        self.published.is_some()
            || self.egress.is_some()
            || self.ingress.is_some()
            || self.taken.is_some()
    }

    /// What the receiving gateway noted of the whole message; `None` also where only pieces of it came.
    pub fn arrived(&self) -> Option<IngressRecord> {
        let is_whole = |one: &IngressRecord| one.flags & IngressRecord::INCOMPLETE == 0;
        self.ingress.filter(is_whole)
    }

    /// True when a later message of the channel came before it.
    pub fn is_overtaken(&self) -> bool {
        let has_flag = |one: IngressRecord| one.flags & IngressRecord::REORDERED != 0;
        self.ingress.is_some_and(has_flag)
    }

    /// When it was published, on the producer's host clock, from whichever record carries it.
    pub fn published_ns(&self) -> Option<i64> {
        let stamps = [
            self.published.map(|record| record.published_ns),
            self.egress.map(|record| record.published_ns),
            self.ingress.map(|record| record.published_ns),
            self.taken.map(|record| record.published_ns),
        ];
        stamps.into_iter().flatten().find_map(stamp)
    }

    /// When it was handed to the kernel, on the producer's host clock.
    pub fn handed_ns(&self) -> Option<i64> {
        let by_sender = self.egress.and_then(|record| stamp(record.handed_ns));
        by_sender.or_else(|| stamp(self.ingress?.handed_ns))
    }

    /// Published to taken and how far that may be off because two hosts' clocks are in it, nanoseconds;
    /// `None` for a message that was not taken, and between hosts whose clocks are not aligned.
    pub fn delay_ns(&self, path: ChannelPath<'_>) -> Option<(i64, u64)> {
        let taken = self.taken?;
        let (published_ns, taken_ns) = (stamp(taken.published_ns)?, stamp(taken.taken_ns)?);
        let (published, bound_ns) = path.localise(RemoteInstant::from_ns(published_ns))?;
        Some((taken_ns.saturating_sub(published.as_ns()), bound_ns))
    }

    /// What processes, queues and timers of the two hosts took of its time, nanoseconds: until it was handed to
    /// the kernel, and from when the kernel or the model of an emulated link let it arrive. Each part is of one
    /// host's clock, and what no record tells is not in it. On a path without gateways all of it is theirs.
    pub fn host_time_ns(&self, path: ChannelPath<'_>) -> i64 {
        let between = |from_ns: Option<i64>, until_ns: Option<i64>| {
            let ends = from_ns.zip(until_ns);
            ends.map_or(0, |(from, until)| until.saturating_sub(from).max(0))
        };
        let arrived = self.arrived();
        let ingress = |of: fn(&IngressRecord) -> i64| arrived.and_then(|record| stamp(of(&record)));
        let received_ns = ingress(|record| record.received_ns);
        let reached_ns = ingress(|record| record.rx_software_ns)
            .zip(ingress(|record| record.realtime_offset_ns))
            .map(|(realtime_ns, offset_ns)| realtime_ns.saturating_sub(offset_ns));
        let modelled_ns = ingress(|record| record.emulated_ns);
        let due_ns = ingress(|record| record.due_ns);
        let taken_ns = self.taken.and_then(|record| stamp(record.taken_ns));
        if !path.is_gateway() {
            return between(self.published_ns(), taken_ns);
        }
        [
            (self.published_ns(), self.handed_ns()),
            (reached_ns, modelled_ns.or(received_ns)),
            (due_ns, received_ns),
            (received_ns, taken_ns),
        ]
        .into_iter()
        .fold(0, |sum, (from, until)| {
            sum.saturating_add(between(from, until))
        })
    }

    /// Its way over the network.
    pub fn passage(&self, path: ChannelPath<'_>) -> Passage {
        let handed_ns = self.handed_ns();
        let received_ns = self.arrived().and_then(|record| stamp(record.received_ns));
        let sent = handed_ns.and_then(|ns| path.localise(RemoteInstant::from_ns(ns)));
        let delay = sent.zip(received_ns);
        Passage {
            epoch_rank: self.key.epoch_rank,
            sequence: self.key.sequence,
            count: self.count,
            offered_ns: handed_ns.or_else(|| self.published_ns()),
            received_ns,
            delay_ns: delay.map(|((sent, _), ns)| ns.saturating_sub(sent.as_ns())),
            delay_bound_ns: delay.map_or(0, |((_, bound_ns), _)| bound_ns),
            crossing: self.crossing(),
        }
    }

    /// What the network did to it. What happened behind the receiving gateway is not the network's.
    pub fn crossing(&self) -> Crossing {
        match self.arrived() {
            Some(_) => Crossing::Arrived,
            None => self.fate.crossing(),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::synthetic::{Files, HANDED_NS, RECEIVED_NS, TAKEN_NS, at, same_clock};
    use crate::{AccountContext, Interruption, PathProcess, account, each_history};
    use hil_core::time::{Alignment, Instant};

    fn passages(files: &Files, context: &AccountContext<'_>) -> Vec<Passage> {
        let mut found = Vec::new();
        each_history(&files.records(), context, |one| {
            found.push(one.passage(context.path));
        });
        found
    }

    /// By start of the producer and number.
    fn histories(
        files: &Files,
        context: &AccountContext<'_>,
    ) -> BTreeMap<(u32, u64), MessageHistory> {
        let mut found = BTreeMap::new();
        each_history(&files.records(), context, |one| {
            found.insert((one.epoch, one.key.sequence), *one);
        });
        found
    }

    #[test]
    fn each_history_has_the_fate_that_the_account_counts() {
        use MessageFate as Fate;
        let fates = [
            Fate::Taken,
            Fate::LostOnWire,
            Fate::SupersededAtInput,
            Fate::RefusedByKernel,
            Fate::Late,
            Fate::SupersededAtConsumer,
            Fate::Taken,
        ];
        let mut files = Files::default();
        for (sequence, fate) in (0_u64..).zip(fates) {
            files.write(at(7, sequence), fate);
        }
        files.ingress.last_mut().unwrap().flags = IngressRecord::REORDERED;
        let context = same_clock(1_000_000_000);
        let found = histories(&files, &context);
        let found_fates: Vec<_> = found.values().map(|one| one.fate).collect();
        assert_eq!(found_fates, fates);
        assert_eq!(found[&(7, 6)].delay_ns(context.path), Some((TAKEN_NS, 0)));
        assert_eq!(found[&(7, 1)].delay_ns(context.path), None);
        assert_eq!(found[&(7, 1)].published_ns(), Some(at(7, 1).published_ns));
        assert!(found[&(7, 6)].is_overtaken() && !found[&(7, 0)].is_overtaken());
        let account = account(&files.records(), &context);
        assert_eq!(account.fates.of(Fate::LostOnWire), 1);
    }

    #[test]
    fn a_message_without_a_record_is_told_by_its_number_and_has_no_delay_without_an_alignment() {
        let mut files = Files::delivered(3);
        files.write(at(7, 5), MessageFate::Taken);
        let context = AccountContext::new(ChannelPath::Gateway { alignment: None });
        let found = histories(&files, &context);
        let recorded: Vec<_> = found.values().map(MessageHistory::is_recorded).collect();
        assert_eq!(recorded, [true, true, true, false, true]);
        assert_eq!(found[&(7, 3)].count, 2);
        assert_eq!(
            found[&(7, 2)].delay_ns(context.path),
            None,
            "clocks are not aligned"
        );
    }

    #[test]
    fn a_message_lost_in_an_interruption_names_it() {
        let mut files = Files::delivered(10);
        files.write(at(7, 10), MessageFate::LostOnWire);
        let down = |from_ns, until_ns| Interruption {
            process: "gateway".to_owned(),
            place: PathProcess::ReceivingGateway,
            from: Instant::from_ns(from_ns),
            until: Instant::from_ns(until_ns),
            cause: "killed by signal 9".to_owned(),
        };
        let published_ns = at(7, 10).published_ns;
        let interruptions = [
            down(900_000_000, 950_000_000),
            down(published_ns, published_ns + 5_000_000),
        ];
        let context = same_clock(1_000_000_000).with_interruptions(&interruptions);
        let found = histories(&files, &context);
        assert_eq!(found[&(7, 10)].interruption_index, Some(1));
        assert_eq!(found[&(7, 9)].interruption_index, None);
    }

    #[test]
    fn what_a_program_published_before_the_run_is_no_message_of_it() {
        let files = Files::delivered(6);
        let mut context = same_clock(1_000_000_000);
        context.producer_run = context.producer_run.map(|run| crate::RunSpan {
            start: Instant::from_ns(at(7, 4).published_ns),
            ..run
        });
        context.first_number = crate::FirstNumber::OnRecord;
        let found = histories(&files, &context);
        let numbers: Vec<_> = found.keys().map(|(_, sequence)| *sequence).collect();
        assert_eq!(numbers, [4, 5]);
        assert_eq!(account(&files.records(), &context).published_count, 2);
        // A number that no record mentions between two of before the run.
        let mut files = files;
        files.published.retain(|one| one.sequence != 2);
        files.egress.retain(|one| one.sequence != 2);
        files.ingress.retain(|one| one.sequence != 2);
        files.taken.retain(|one| one.sequence != 2);
        assert_eq!(histories(&files, &context).len(), 2);
        assert_eq!(account(&files.records(), &context).published_count, 2);
    }

    #[test]
    fn what_a_witness_missed_is_unknown_and_what_it_took_without_the_consumer_is_lost() {
        use MessageFate as Fate;
        let mut files = Files::default();
        let written = [
            Fate::Taken,
            Fate::Taken,
            Fate::Taken,
            Fate::SupersededAtConsumer,
            Fate::Taken,
        ];
        for (sequence, fate) in (0_u64..).zip(written) {
            files.write(at(7, sequence), fate);
        }
        let interruptions = [Interruption {
            process: "own".to_owned(),
            place: PathProcess::Consumer,
            from: Instant::from_ns(at(7, 1).published_ns),
            until: Instant::from_ns(at(7, 2).published_ns),
            cause: "killed by signal 9".to_owned(),
        }];
        let mut context =
            same_clock(at(7, 4).published_ns + TAKEN_NS).with_interruptions(&interruptions);
        for (has_witness, expected) in [
            (false, written),
            (
                true,
                [
                    Fate::Taken,
                    Fate::LostInInterruption,
                    Fate::Taken,
                    Fate::UnknownPeerRecordsUnavailable,
                    Fate::Taken,
                ],
            ),
        ] {
            context.has_witness = has_witness;
            let found = histories(&files, &context);
            let found: Vec<_> = found.values().map(|one| one.fate).collect();
            assert_eq!(found, expected);
        }
        let crossings = passages(&files, &context);
        assert!(
            crossings
                .iter()
                .all(|one| one.crossing == Crossing::Arrived)
        );
    }

    #[test]
    fn losses_of_the_host_are_kept_apart_from_those_of_the_network() {
        use Crossing::{Arrived, LostByHost, LostByNetwork};
        use MessageFate as Fate;
        let mut files = Files::default();
        for (sequence, fate) in (0_u64..).zip([
            Fate::Taken,
            Fate::LostOnWire,
            Fate::SupersededAtInput,
            Fate::RefusedByKernel,
            Fate::Late,
            Fate::SupersededAtConsumer,
            Fate::Taken,
        ]) {
            files.write(at(7, sequence), fate);
        }
        let found = passages(&files, &same_clock(1_000_000_000));
        let crossings: Vec<_> = found.iter().map(|one| one.crossing).collect();
        assert_eq!(
            crossings,
            [
                Arrived,
                LostByNetwork,
                LostByHost,
                LostByHost,
                Arrived,
                Arrived,
                Arrived
            ]
        );
        assert_eq!(found[0].delay_ns, Some(RECEIVED_NS - HANDED_NS));
        assert_eq!(found[1].offered_ns, Some(at(7, 1).published_ns + HANDED_NS));
        assert_eq!(found[2].offered_ns, Some(at(7, 2).published_ns));
    }

    #[test]
    fn a_delay_between_hosts_needs_an_alignment_and_carries_its_bound() {
        let files = Files::delivered(3);
        let unaligned = AccountContext::new(ChannelPath::Gateway { alignment: None });
        let found = passages(&files, &unaligned);
        assert!(found.iter().all(|one| one.delay_ns.is_none()));
        assert!(found.iter().all(|one| one.received_ns.is_some()));
        let alignment = Some(Alignment {
            offset_ns: 500,
            bound_ns: 70,
        });
        let aligned = AccountContext::new(ChannelPath::Gateway { alignment });
        let found = passages(&files, &aligned);
        assert_eq!(found[1].delay_ns, Some(RECEIVED_NS - HANDED_NS - 500));
        assert_eq!(found[1].delay_bound_ns, 70);
    }
}
