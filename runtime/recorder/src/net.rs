//! What the network did to each message, as topics: the stamps of every stage beside each other, and
//! the verdict of the link. It judges nothing by itself: fates and bounds are those of the run.

use std::collections::BTreeMap;

use hil_core::record::{FollowUpRecord, IngressRecord, UNAVAILABLE};
use hil_rundir::live_run::Stage;
use hil_rundir::record::{RecordFile, RecordKind};
use hil_trace::{Trace, TraceFate, TraceRecord, UNAVAILABLE_NS, UNBOUNDED_NS};
use hil_watch::Record;

use crate::schema::own_message;

own_message! {
    /// The stamps of one message, nanoseconds; absent where there was none. Each is on the clock that
    /// its name says: monotonic of its own host unless `realtime` or `card` stands in it.
    pub(crate) struct MessageLatency as "MessageLatency" {
        /// Number on the channel, from 0 at each start of the producer.
        sequence: uint64 = "1",
        /// The producer's start.
        epoch: uint32 = "2",
        /// The producer published it, on its host.
        published_ns: optional int64 = "3",
        /// The sending gateway took it.
        gateway_taken_ns: optional int64 = "4",
        /// Just before the send call.
        handed_ns: optional int64 = "5",
        /// Kernel transmit stamp.
        tx_realtime_ns: optional int64 = "6",
        /// The network card's transmit stamp, on the card's clock.
        tx_nic_ns: optional int64 = "7",
        /// Real-time minus monotonic clock of the sending host.
        sender_realtime_offset_ns: optional int64 = "8",
        /// The network card's receive stamp, on the card's clock.
        rx_nic_ns: optional int64 = "9",
        /// Kernel receive stamp.
        rx_realtime_ns: optional int64 = "10",
        /// The receive call had returned, on the receiving host.
        received_ns: optional int64 = "11",
        /// The receiving gateway published it.
        forwarded_ns: optional int64 = "12",
        /// Real-time minus monotonic clock of the receiving host.
        receiver_realtime_offset_ns: optional int64 = "13",
        /// The consumer took it.
        taken_ns: optional int64 = "14",
        /// Published to taken; absent unless both hosts read one clock.
        delay_ns: optional int64 = "15",
        /// Handed to received, as the run's link trace has it.
        link_delay_ns: optional int64 = "16",
        /// Largest error of `link_delay_ns` by the clocks' alignment; 0 on one clock.
        link_delay_bound_ns: optional uint64 = "17",
    }
}

own_message! {
    /// What the link did to one message.
    #[allow(
        clippy::struct_excessive_bools,
        reason = "a row of a table, not a state"
    )]
    pub(crate) struct LinkDecision as "LinkDecision" {
        /// Number on the channel, from 0 at each start of the producer.
        sequence: uint64 = "1",
        /// Starts of the producer before this message's.
        start: uint32 = "2",
        /// `delivered`, `lost-in-network`, `lost-before-link`, `lost-after-link` or `unknown`.
        fate: string = "3",
        /// True for the three kinds of loss.
        is_lost: bool = "4",
        /// True when a second copy arrived.
        is_duplicated: bool = "5",
        /// It arrived after a message published later.
        is_reordered: bool = "6",
        /// A link model, not a network, decided.
        is_emulated: bool = "7",
        /// Handed to the link until it arrived.
        delay_ns: optional int64 = "8",
        /// Largest error of `delay_ns` by the clocks' alignment; 0 on one clock.
        delay_bound_ns: optional uint64 = "9",
        /// Handed to the link until the second copy arrived.
        second_delay_ns: optional int64 = "10",
        /// Size of the message.
        size_bytes: uint32 = "11",
    }
}

impl LinkDecision {
    /// What a trace says of one message.
    pub(crate) fn of(record: &TraceRecord) -> Self {
        Self {
            sequence: record.sequence,
            start: record.start.into(),
            fate: record.fate.word().to_owned(),
            is_lost: record.fate.is_loss(),
            is_duplicated: record.second_delay().is_some(),
            is_reordered: record.has(TraceRecord::REORDERED),
            is_emulated: record.has(TraceRecord::EMULATED),
            delay_ns: record.delay(),
            delay_bound_ns: bound_ns(record),
            second_delay_ns: record.second_delay(),
            size_bytes: record.size_bytes,
        }
    }
}

fn bound_ns(record: &TraceRecord) -> Option<u64> {
    record
        .delay()
        .map(|_| record.bound_ns)
        .filter(|bound_ns| *bound_ns != UNBOUNDED_NS)
}

fn stamp(ns: i64) -> Option<i64> {
    (ns != UNAVAILABLE).then_some(ns)
}

/// Which message of a channel: the start of its producer, and its number since then.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct MessageId {
    /// The start.
    pub(crate) epoch: u32,
    /// The number.
    pub(crate) sequence: u64,
}

/// Of which message a record tells, and from where.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Noted {
    /// Who noted it.
    pub(crate) stage: Stage,
    /// The message.
    pub(crate) message: MessageId,
    /// When the message was published, on its producer's clock.
    pub(crate) published_ns: i64,
    /// When this was noted, on the clock of its process.
    pub(crate) at_ns: i64,
}

impl Noted {
    /// What `record` tells of; `None` of no single message, of a second copy, which says nothing of
    /// the way of the first, and of pieces of a message that never arrived.
    pub(crate) fn of(record: &Record) -> Option<Self> {
        const NO_ARRIVAL: u32 = IngressRecord::DUPLICATE | IngressRecord::INCOMPLETE;
        let (stage, epoch, sequence, published_ns, at_ns) = match record {
            Record::Published(one) => {
                let at_ns = one.published_ns;
                (Stage::Published, one.epoch, one.sequence, at_ns, at_ns)
            }
            Record::Egress(one) => {
                let (published_ns, at_ns) = (one.published_ns, one.taken_ns);
                (Stage::Sent, one.epoch, one.sequence, published_ns, at_ns)
            }
            Record::Ingress(one) if one.flags & NO_ARRIVAL == 0 => {
                let (published_ns, at_ns) = (one.published_ns, one.received_ns);
                (
                    Stage::Received,
                    one.epoch,
                    one.sequence,
                    published_ns,
                    at_ns,
                )
            }
            Record::Taken(one) => {
                let (published_ns, at_ns) = (one.published_ns, one.taken_ns);
                (Stage::Taken, one.epoch, one.sequence, published_ns, at_ns)
            }
            _ => return None,
        };
        Some(Self {
            stage,
            message: MessageId { epoch, sequence },
            published_ns,
            at_ns,
        })
    }
}

/// The records of a file that tell of single messages, in order.
pub(crate) fn records(file: &RecordFile) -> Box<dyn Iterator<Item = Record> + '_> {
    match file.header.kind {
        RecordKind::Published => Box::new(file.records().map(Record::Published)),
        RecordKind::Taken => Box::new(file.records().map(Record::Taken)),
        RecordKind::Egress => Box::new(file.records().map(Record::Egress)),
        RecordKind::Ingress => Box::new(file.records().map(Record::Ingress)),
        _ => Box::new(core::iter::empty()),
    }
}

/// The stamps of the messages of one channel.
pub(crate) type Latencies = BTreeMap<MessageId, MessageLatency>;

/// Joins the record files of one channel. `has_one_clock` says that stamps of both ends compare.
pub(crate) fn latencies<'a>(
    files: &(impl Iterator<Item = &'a RecordFile> + Clone),
    trace: Option<&Trace>,
    has_one_clock: bool,
) -> Latencies {
    let mut joined = Latencies::new();
    for record in files.clone().flat_map(records) {
        if let Some(noted) = Noted::of(&record) {
            join(&mut joined, noted.message, &record);
        }
    }
    follow_up(&mut joined, files);
    if has_one_clock {
        joined.values_mut().for_each(MessageLatency::compare_ends);
    }
    if let Some(trace) = trace {
        add_link_delays(&mut joined, trace);
    }
    joined
}

/// Puts a record of `message` beside the others of it.
pub(crate) fn join(joined: &mut Latencies, message: MessageId, record: &Record) {
    let one = joined.entry(message);
    one.or_insert_with(|| MessageLatency::new(message))
        .note(record);
}

impl MessageLatency {
    /// Of a message of which nothing is known yet.
    pub(crate) fn new(message: MessageId) -> Self {
        Self {
            sequence: message.sequence,
            epoch: message.epoch,
            ..Self::default()
        }
    }

    /// Takes what a record says of the message; they come in whatever order.
    pub(crate) fn note(&mut self, record: &Record) {
        match record {
            Record::Published(one) => self.published_ns = stamp(one.published_ns),
            Record::Taken(one) => {
                self.published_ns = self.published_ns.or(stamp(one.published_ns));
                self.taken_ns = stamp(one.taken_ns);
            }
            Record::Egress(one) => {
                self.published_ns = self.published_ns.or(stamp(one.published_ns));
                self.gateway_taken_ns = stamp(one.taken_ns);
                self.handed_ns = stamp(one.handed_ns);
                self.tx_realtime_ns = stamp(one.tx_software_ns);
                self.tx_nic_ns = stamp(one.tx_hardware_ns);
                self.sender_realtime_offset_ns = stamp(one.realtime_offset_ns);
            }
            Record::Ingress(one) => {
                self.published_ns = self.published_ns.or(stamp(one.published_ns));
                self.handed_ns = self.handed_ns.or(stamp(one.handed_ns));
                self.rx_nic_ns = stamp(one.rx_hardware_ns);
                self.rx_realtime_ns = stamp(one.rx_software_ns);
                self.received_ns = stamp(one.received_ns);
                self.forwarded_ns = stamp(one.forwarded_ns);
                self.receiver_realtime_offset_ns = stamp(one.realtime_offset_ns);
            }
            _ => {}
        }
    }

    /// Works out the delay from end to end, as both read one clock.
    pub(crate) fn compare_ends(&mut self) {
        let ends = self.taken_ns.zip(self.published_ns);
        self.delay_ns = ends.and_then(|(taken, published)| taken.checked_sub(published));
    }
}

/// Transmit stamps that came in later datagrams, for messages whose sender left no records. They
/// need the sender's offset, so they are used only beside one that the sender noted.
fn follow_up<'a>(joined: &mut Latencies, files: &(impl Iterator<Item = &'a RecordFile> + Clone)) {
    let of_kind = |kind| files.clone().filter(move |file| file.header.kind == kind);
    let mut epochs: BTreeMap<(u32, u64), u32> = BTreeMap::new();
    for file in of_kind(RecordKind::Ingress) {
        for record in file.records::<IngressRecord>() {
            epochs.insert((record.session, record.sequence), record.epoch);
        }
    }
    for file in of_kind(RecordKind::FollowUp) {
        for record in file.records::<FollowUpRecord>() {
            let sequence = record.sequence;
            let epoch = epochs.get(&(record.session, sequence)).copied();
            let one = epoch.and_then(|epoch| joined.get_mut(&MessageId { epoch, sequence }));
            let Some(one) = one.filter(|one| one.tx_realtime_ns.is_none()) else {
                continue;
            };
            let left = one.handed_ns.zip(one.sender_realtime_offset_ns);
            one.tx_realtime_ns = left.and_then(|(handed_ns, offset_ns)| {
                let left_ns = handed_ns.checked_add(record.handed_to_tx_ns)?;
                left_ns.checked_add(offset_ns)
            });
        }
    }
}

/// The delays that the run worked out with its clocks' alignment.
fn add_link_delays(joined: &mut Latencies, trace: &Trace) {
    let starts = starts(joined);
    for record in &trace.records {
        if record.fate == TraceFate::Unknown {
            continue;
        }
        let sequence = record.sequence;
        let epoch = starts.get(usize::from(record.start)).copied();
        let message = epoch.map(|epoch| MessageId { epoch, sequence });
        if let Some(one) = message.and_then(|message| joined.get_mut(&message)) {
            one.link_delay_ns = record.delay();
            one.link_delay_bound_ns = bound_ns(record);
        }
    }
}

/// The producer's starts in the order of their first messages: a trace counts them, records name them.
fn starts(joined: &Latencies) -> Vec<u32> {
    let mut first: BTreeMap<u32, i64> = BTreeMap::new();
    for one in joined.values() {
        if let Some(published_ns) = one.published_ns {
            let earliest = first.entry(one.epoch).or_insert(published_ns);
            *earliest = published_ns.min(*earliest);
        }
    }
    let mut starts: Vec<(i64, u32)> = first.into_iter().map(|(epoch, at)| (at, epoch)).collect();
    starts.sort_unstable();
    starts.into_iter().map(|(_, epoch)| epoch).collect()
}

/// When the message was published, on the sender's monotonic clock; `None` where the trace does not
/// know when the run began.
pub(crate) fn published_ns(trace: &Trace, index: usize) -> Option<i64> {
    let origin_ns = trace.header.origin_ns;
    let since_start_ns = trace.records[index].published_ns;
    (origin_ns != UNAVAILABLE_NS)
        .then(|| origin_ns.checked_add(since_start_ns))
        .flatten()
}
