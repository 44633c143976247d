//! The one account of a channel: records go in one by one, and every message comes out once, with what
//! became of it. It is fed by record files as they grow or by the files of a finished run, in any pieces; the fates depend
//! on the records alone, not on the pieces.
//!
//! All records of a message carry its publication stamp, so the caller says up to which publication
//! every record is in. A message whose fate still hangs on what comes later is held back, and with it
//! those behind it: one that a reader has not taken, until a later one was taken or enough came to
//! push it out of the reader's buffer. With the depth of that buffer known, few are held.

use std::collections::VecDeque;

use super::fate::{Evidence, Judge, Reading, Readings};
use super::follow_up::FollowUps;
use super::history::{Key, MessageHistory};
use super::{AccountContext, ChannelRecords, RecordSource, each};
use hil_core::record::{
    EgressRecord, IngressRecord, PublishedRecord, TakenRecord, UNAVAILABLE, stamp,
};
use hil_stats::in_order::{InOrder, in_order};

/// One record of a channel.
#[derive(Debug, Clone, Copy)]
pub enum RecordEvent {
    /// The producer's.
    Published(PublishedRecord),
    /// The sending gateway's.
    Egress(EgressRecord),
    /// The receiving gateway's.
    Ingress(IngressRecord),
    /// The consumer's.
    Taken(TakenRecord),
}

/// The message that a record is of, as the record names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MessageName {
    /// The producer's start.
    pub epoch: u32,
    /// Sequence number.
    pub sequence: u64,
    /// Publication on the producer's host clock; [`UNAVAILABLE`] where unknown.
    pub published_ns: i64,
}

impl RecordEvent {
    /// The message.
    pub const fn message(&self) -> MessageName {
        let (epoch, sequence, published_ns) = match self {
            Self::Published(one) => (one.epoch, one.sequence, one.published_ns),
            Self::Egress(one) => (one.epoch, one.sequence, one.published_ns),
            Self::Ingress(one) => (one.epoch, one.sequence, one.published_ns),
            Self::Taken(one) => (one.epoch, one.sequence, one.published_ns),
        };
        MessageName {
            epoch,
            sequence,
            published_ns,
        }
    }

    /// True for what a gateway writes.
    const fn is_of_gateway(&self) -> bool {
        !matches!(self, Self::Published(_) | Self::Taken(_))
    }
}

/// The kinds of records of a channel that are at hand: only there does the absence of a record say
/// anything.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[allow(clippy::struct_excessive_bools, reason = "one for each kind of record")]
pub struct RecordsAtHand {
    /// The producer's.
    pub published: bool,
    /// The sending gateway's.
    pub egress: bool,
    /// The receiving gateway's.
    pub ingress: bool,
    /// The consumer's.
    pub taken: bool,
}

impl RecordsAtHand {
    /// The kinds of which `records` has files and which a channel carried so can have.
    pub fn of(records: &ChannelRecords<'_>, context: &AccountContext<'_>) -> Self {
        let is_gateway = context.path.is_gateway();
        Self {
            published: records.published.is_some(),
            egress: is_gateway && records.egress.is_some(),
            ingress: is_gateway && records.ingress.is_some(),
            taken: records.taken.is_some(),
        }
    }
}

/// The number with which the messages of the producer's starts begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FirstNumber {
    /// Zero: the records begin with the run.
    Zero,
    /// The lowest on record of the starts known when the first message settles, since the records begin
    /// in the middle of a run, or the producer before it; zero of later starts. What was published before the run
    /// of the producer's host, where that is known, is no message of it.
    OnRecord,
}

/// How many times as many messages are held in all as are held though they are due.
const HELD_MAX_FACTOR: usize = 16;

/// What is fixed about a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FoldSettings {
    /// True between gateways.
    pub is_gateway: bool,
    /// Messages that a reader of the channel has room for, if known.
    pub depth: Option<usize>,
    /// Where its numbers begin.
    pub first_number: FirstNumber,
    /// Most messages that are held though they are due, because what comes later decides on them; of more
    /// the oldest is told as what is known of it by then. Sixteen times as many are held in all, due or
    /// not. `None` for no limit.
    pub held_max: Option<usize>,
}

/// Joins and judges the messages of one channel.
#[derive(Debug)]
pub struct ChannelFold {
    settings: FoldSettings,
    at_hand: RecordsAtHand,
    /// The starts of the producer: those with a rank first, then by their first publication.
    epochs: Vec<Epoch>,
    is_sorted: bool,
    /// No start before this one has a message that has not settled.
    first_open: usize,
    /// The start that the last record was of.
    current: usize,
    rank_count: u32,
    follow_ups: FollowUps,
    judge: Judge,
    held_count: usize,
    late_record_count: u64,
}

/// One start of the producer.
#[derive(Debug)]
struct Epoch {
    number: u32,
    /// Known once its first message has settled.
    rank: Option<u32>,
    first_published_ns: i64,
    /// The number after that of the last settled message; `None` while the first one is unknown.
    next: Option<u64>,
    /// The messages that have not settled, by their numbers.
    pending: VecDeque<(u64, MessageHistory)>,
    /// What the sending gateway had before it.
    input: Buffer,
    /// What the consumer had before it.
    consumer: Buffer,
}

/// The messages of one start in front of a reader.
#[derive(Debug, Default)]
struct Buffer {
    last_taken: Option<u64>,
    /// The newest that were put there, in order, as many as there is room for.
    newest: VecDeque<u64>,
}

impl Buffer {
    fn offer(&mut self, sequence: u64, depth: Option<usize>) {
        let Some(depth) = depth else { return };
        let place = self.newest.partition_point(|one| *one < sequence);
        if self.newest.get(place) != Some(&sequence) {
            self.newest.insert(place, sequence);
        }
        if self.newest.len() > depth {
            self.newest.pop_front();
        }
    }

    fn take(&mut self, sequence: u64) {
        self.last_taken = self.last_taken.max(Some(sequence));
    }
}

impl MessageHistory {
    fn add(&mut self, event: &RecordEvent) {
        match event {
            RecordEvent::Published(record) => {
                self.published.get_or_insert(*record);
            }
            RecordEvent::Egress(record) => {
                self.egress.get_or_insert(*record);
            }
            RecordEvent::Ingress(record) => {
                self.copies.note(record);
                let is_incomplete =
                    |record: &IngressRecord| record.flags & IngressRecord::INCOMPLETE != 0;
                match &mut self.ingress {
                    None => self.ingress = Some(*record),
                    // The copy that was forwarded is the message, the others are its duplicates.
                    Some(best) if best.forwarded_ns == UNAVAILABLE => {
                        if record.forwarded_ns != UNAVAILABLE {
                            *best = *record;
                        } else if is_incomplete(best) && is_incomplete(record) {
                            // Pieces that came once the others had been given up.
                            best.fragment_count =
                                best.fragment_count.saturating_add(record.fragment_count);
                        }
                    }
                    Some(_) => {}
                }
            }
            RecordEvent::Taken(record) => {
                self.taken.get_or_insert(*record);
            }
        }
    }
}

impl ChannelFold {
    /// Without any record at hand.
    pub fn new(settings: FoldSettings) -> Self {
        Self {
            settings,
            at_hand: RecordsAtHand::default(),
            epochs: Vec::new(),
            is_sorted: true,
            first_open: 0,
            current: 0,
            rank_count: 0,
            follow_ups: FollowUps::default(),
            judge: Judge::default(),
            held_count: 0,
            late_record_count: 0,
        }
    }

    /// For the whole record files of a finished run.
    fn of_files(records: &ChannelRecords<'_>, context: &AccountContext<'_>) -> Self {
        let mut fold = Self::new(FoldSettings {
            is_gateway: context.path.is_gateway(),
            depth: context.depth,
            first_number: context.first_number,
            held_max: None,
        });
        fold.expect(RecordsAtHand::of(records, context));
        if fold.settings.is_gateway {
            // A stamp comes with a later message, of which nothing is known when its own is told.
            for record in each(records.ingress) {
                fold.follow_ups.add(&record);
            }
        }
        fold
    }

    /// Knows from now on that records of these kinds are at hand, beside those known already.
    pub const fn expect(&mut self, kinds: RecordsAtHand) {
        let at_hand = &mut self.at_hand;
        at_hand.published |= kinds.published;
        at_hand.egress |= kinds.egress;
        at_hand.ingress |= kinds.ingress;
        at_hand.taken |= kinds.taken;
    }

    /// The kinds of records at hand.
    pub const fn at_hand(&self) -> RecordsAtHand {
        self.at_hand
    }

    /// Messages that are joined and have not settled.
    pub const fn held_count(&self) -> usize {
        self.held_count
    }

    /// Records that came after their message had settled, and count for nothing.
    pub const fn late_record_count(&self) -> u64 {
        self.late_record_count
    }

    /// Takes in a record. Its kind is at hand from now on. What gateways write of a channel without any says
    /// nothing.
    pub fn push(&mut self, event: &RecordEvent) {
        if event.is_of_gateway() && !self.settings.is_gateway {
            return;
        }
        match event {
            RecordEvent::Published(_) => self.at_hand.published = true,
            RecordEvent::Egress(_) => self.at_hand.egress = true,
            RecordEvent::Ingress(record) => {
                self.at_hand.ingress = true;
                self.follow_ups.add(record);
            }
            RecordEvent::Taken(_) => self.at_hand.taken = true,
        }
        self.insert(event.message(), event);
    }

    fn insert(&mut self, name: MessageName, event: &RecordEvent) {
        let settings = self.settings;
        let index = self.index_of(name.epoch);
        let epoch = &mut self.epochs[index];
        let sequence = name.sequence;
        match event {
            RecordEvent::Published(_) if settings.is_gateway => {
                epoch.input.offer(sequence, settings.depth);
            }
            RecordEvent::Published(_) => epoch.consumer.offer(sequence, settings.depth),
            RecordEvent::Egress(_) => epoch.input.take(sequence),
            RecordEvent::Ingress(record) if record.forwarded_ns != UNAVAILABLE => {
                epoch.consumer.offer(sequence, settings.depth);
            }
            RecordEvent::Taken(_) => epoch.consumer.take(sequence),
            RecordEvent::Ingress(_) => {}
        }
        let has_settled = epoch.next.is_some_and(|next| sequence < next);
        if has_settled {
            // A copy that comes late changes nothing.
            let is_copy = matches!(event, RecordEvent::Ingress(record)
                if record.flags & IngressRecord::DUPLICATE != 0);
            self.late_record_count += u64::from(!is_copy);
            return;
        }
        let known_count = epoch.pending.len();
        epoch.pending(sequence).add(event);
        self.held_count += epoch.pending.len() - known_count;
        if let Some(published_ns) = stamp(name.published_ns)
            && published_ns < epoch.first_published_ns
        {
            epoch.first_published_ns = published_ns;
            self.is_sorted = false;
        }
        self.first_open = self.first_open.min(index);
    }

    fn index_of(&mut self, number: u32) -> usize {
        let is_it = |epoch: &Epoch| epoch.number == number;
        if self.epochs.get(self.current).is_some_and(is_it) {
            return self.current;
        }
        self.current = self.epochs.iter().rposition(is_it).unwrap_or_else(|| {
            let is_cut = self.settings.first_number == FirstNumber::OnRecord;
            self.epochs.push(Epoch {
                number,
                rank: None,
                first_published_ns: i64::MAX,
                next: (!is_cut || self.rank_count > 0).then_some(0),
                pending: VecDeque::new(),
                input: Buffer::default(),
                consumer: Buffer::default(),
            });
            self.is_sorted = false;
            self.epochs.len() - 1
        });
        self.current
    }

    /// Hands every message that was published up to `until_ns` on the producer's clock to `take`, in the
    /// order of the producer's starts and numbers, unless its fate hangs on what comes later. All its
    /// records are in, or will not come: see [`AccountContext::flight_time_max`].
    pub fn settle(
        &mut self,
        context: &AccountContext<'_>,
        until_ns: i64,
        take: &mut dyn FnMut(&MessageHistory),
    ) {
        let evidence = Evidence::new(context, self.at_hand);
        self.tell(&evidence, Some(until_ns), take);
    }

    /// Hands all messages that have not settled to `take`: no record comes any more.
    pub fn finish(&mut self, context: &AccountContext<'_>, take: &mut dyn FnMut(&MessageHistory)) {
        let evidence = Evidence::new(context, self.at_hand).at_end();
        self.tell(&evidence, None, take);
    }

    fn tell(
        &mut self,
        evidence: &Evidence<'_>,
        until_ns: Option<i64>,
        take: &mut dyn FnMut(&MessageHistory),
    ) {
        self.sort();
        let max = self.settings.held_max.unwrap_or(usize::MAX);
        let due = |epoch: &Epoch| epoch.due_count(until_ns);
        let mut due_count: usize = self.epochs[self.first_open..].iter().map(due).sum();
        for index in self.first_open..self.epochs.len() {
            loop {
                let is_full = self.held_count > max.saturating_mul(HELD_MAX_FACTOR);
                let until_ns = until_ns.filter(|_| !is_full);
                let Some(sequence) = self.epochs[index].due(until_ns) else {
                    break;
                };
                let held_count = self.held_count;
                let is_crowded = is_full || due_count > max;
                if !self.tell_one(index, sequence, evidence, is_crowded, take) {
                    return;
                }
                due_count = due_count.saturating_sub(held_count - self.held_count);
            }
            if self.first_open == index && self.epochs[index].pending.is_empty() {
                self.first_open += 1;
            }
        }
    }

    /// Tells the message `sequence` of a start, or the numbers before it that no record mentions; false
    /// when nothing can be said yet.
    fn tell_one(
        &mut self,
        index: usize,
        sequence: u64,
        evidence: &Evidence<'_>,
        is_crowded: bool,
        take: &mut dyn FnMut(&MessageHistory),
    ) -> bool {
        let epoch = &self.epochs[index];
        let next = epoch.next.unwrap_or(sequence);
        let key = Key {
            epoch_rank: epoch.rank.unwrap_or(self.rank_count),
            sequence: next.min(sequence),
        };
        let mut message = match epoch.pending.front() {
            Some((_, pending)) if next >= sequence => *pending,
            _ => MessageHistory {
                count: sequence.saturating_sub(next),
                ..MessageHistory::unrecorded(epoch.number)
            },
        };
        message.key = key;
        // Numbers that no record mentions are not later than the record behind them.
        let first = epoch.pending.front().map(|(_, pending)| pending);
        let is_on_record = self.settings.first_number == FirstNumber::OnRecord;
        if is_on_record && first.is_some_and(|first| evidence.is_before_run(first)) {
            self.advance(index, next, sequence);
            return true;
        }
        if evidence.is_for_nobody(&message) {
            message.taken = None;
        }
        // A message that was taken needs no reading.
        let readings = match message.taken {
            Some(_) => Readings::default(),
            None => Readings {
                gateway: self.reading(index, key.sequence, |one| &one.input),
                consumer: self.reading(index, key.sequence, |one| &one.consumer),
            },
        };
        let verdict = self.judge.judge(&message, evidence, readings, is_crowded);
        let Some(verdict) = verdict else {
            return false;
        };
        message.fate = verdict.fate;
        message.interruption_index = verdict.interruption_index;
        if let Some(ingress) = message.ingress {
            message.handed_to_tx_ns = self.follow_ups.take(&ingress);
        }
        let epoch = &mut self.epochs[index];
        if epoch.rank.is_none() {
            epoch.rank = Some(key.epoch_rank);
            self.rank_count += 1;
        }
        self.advance(index, next, sequence);
        take(&message);
        true
    }

    /// Goes on behind `next`, of a start whose first record that has not settled is that of `sequence`.
    fn advance(&mut self, index: usize, next: u64, sequence: u64) {
        let epoch = &mut self.epochs[index];
        if next < sequence {
            epoch.next = Some(sequence);
        } else {
            epoch.next = Some(sequence.saturating_add(1));
            epoch.pending.pop_front();
            self.held_count -= 1;
        }
    }

    /// How a reader that has not taken a message stands to it.
    fn reading(&self, index: usize, sequence: u64, of: fn(&Epoch) -> &Buffer) -> Reading {
        let own = of(&self.epochs[index]);
        let later = || self.epochs[index + 1..].iter().map(of);
        if own.last_taken > Some(sequence) || later().any(|one| one.last_taken.is_some()) {
            return Reading::Passed;
        }
        let Some(depth) = self.settings.depth else {
            return Reading::Unknown;
        };
        let place = own.newest.partition_point(|one| *one <= sequence);
        let behind_count = own.newest.len() - place;
        if later().fold(behind_count, |sum, one| sum + one.newest.len()) >= depth {
            Reading::Passed
        } else if place.checked_sub(1).and_then(|place| own.newest.get(place)) == Some(&sequence) {
            Reading::Waiting
        } else {
            Reading::Unknown
        }
    }

    fn sort(&mut self) {
        if self.is_sorted {
            return;
        }
        let number = self.epochs.get(self.current).map(|epoch| epoch.number);
        self.epochs.sort_by_key(|epoch| {
            let rank = epoch.rank.unwrap_or(u32::MAX);
            (rank, epoch.first_published_ns, epoch.number)
        });
        let current = self
            .epochs
            .iter()
            .position(|epoch| Some(epoch.number) == number);
        self.current = current.unwrap_or(0);
        let open = self
            .epochs
            .iter()
            .position(|epoch| !epoch.pending.is_empty());
        self.first_open = open.unwrap_or(self.epochs.len());
        self.is_sorted = true;
    }
}

impl Epoch {
    /// What is known of a message that has not settled.
    fn pending(&mut self, sequence: u64) -> &mut MessageHistory {
        // Records mostly come in order.
        let place = match self.pending.back() {
            Some((last, _)) if *last < sequence => self.pending.len(),
            _ => self.pending.partition_point(|(one, _)| *one < sequence),
        };
        if self
            .pending
            .get(place)
            .is_none_or(|(one, _)| *one != sequence)
        {
            let pending = MessageHistory::unrecorded(self.number);
            self.pending.insert(place, (sequence, pending));
        }
        &mut self.pending[place].1
    }

    /// Messages published by `until_ns`, or all.
    fn due_count(&self, until_ns: Option<i64>) -> usize {
        let Some(until_ns) = until_ns else {
            return self.pending.len();
        };
        let is_due = |(_, one): &(u64, MessageHistory)| {
            let published_ns = one.published_ns();
            published_ns.is_none_or(|at_ns| at_ns <= until_ns)
        };
        self.pending.partition_point(is_due)
    }

    /// The lowest number that has not settled, if it was published by then; without an instant, if a
    /// later one was.
    fn due(&self, until_ns: Option<i64>) -> Option<u64> {
        let (sequence, _) = self.pending.front()?;
        let Some(until_ns) = until_ns else {
            return Some(*sequence);
        };
        let mut stamps = self
            .pending
            .iter()
            .filter_map(|(_, one)| one.published_ns());
        stamps
            .next()
            .filter(|at_ns| *at_ns <= until_ns)
            .map(|_| *sequence)
    }
}

/// Hands every message of the record files of a finished run to `take`, in the order of the producer's
/// starts and numbers. It reads the files two times, those of arrivals three times, and holds few records.
pub fn each_history(
    records: &ChannelRecords<'_>,
    context: &AccountContext<'_>,
    mut take: impl FnMut(&MessageHistory),
) {
    let mut fold = ChannelFold::of_files(records, context);
    let mut evidence = Evidence::new(context, fold.at_hand);
    let mut published = by_publication(records.published, |one| one.published_ns);
    let mut egress = by_publication(records.egress, |one| one.published_ns);
    let mut ingress = by_publication(records.ingress, |one| one.published_ns);
    let mut taken = by_publication(records.taken, |one| one.published_ns);
    loop {
        let heads = [
            published.head(),
            egress.head(),
            ingress.head(),
            taken.head(),
        ];
        let Some(at_ns) = heads.into_iter().flatten().min() else {
            break;
        };
        push_all(&mut fold, &mut published, at_ns, RecordEvent::Published);
        push_all(&mut fold, &mut egress, at_ns, RecordEvent::Egress);
        push_all(&mut fold, &mut ingress, at_ns, RecordEvent::Ingress);
        push_all(&mut fold, &mut taken, at_ns, RecordEvent::Taken);
        fold.tell(&evidence, Some(at_ns), &mut take);
    }
    evidence = evidence.at_end();
    fold.tell(&evidence, None, &mut take);
}

/// The records of one file in the order of the publication of their messages.
type ByPublication<'a, R> = InOrder<i64, R, Box<dyn Iterator<Item = (i64, R)> + 'a>>;

fn by_publication<'a, R: 'a>(
    source: Option<&'a dyn RecordSource<R>>,
    published_ns: fn(&R) -> i64,
) -> ByPublication<'a, R> {
    in_order(|| -> Box<dyn Iterator<Item = (i64, R)> + 'a> {
        Box::new(each(source).map(move |record| (published_ns(&record), record)))
    })
}

/// Pushes the next records, those of messages published at `at_ns`.
fn push_all<R>(
    fold: &mut ChannelFold,
    records: &mut ByPublication<'_, R>,
    at_ns: i64,
    event: fn(R) -> RecordEvent,
) {
    while records.head() == Some(at_ns)
        && let Some((_, record)) = records.next()
    {
        fold.push(&event(record));
    }
}
