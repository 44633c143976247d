//! What the network did to each message, as topics: the stamps of every stage beside each other, and
//! the verdict of the link. It judges nothing by itself: fates and bounds are those of the run.

use hil_core::record::{FollowUp, IngressRecord, stamp};
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
        let (stage, at_ns) = match record {
            Record::Published(one) => (Stage::Published, one.published_ns),
            Record::Egress(one) => (Stage::Sent, one.taken_ns),
            Record::Ingress(one) if one.flags & NO_ARRIVAL == 0 => {
                (Stage::Received, one.received_ns)
            }
            Record::Taken(one) => (Stage::Taken, one.taken_ns),
            _ => return None,
        };
        let name = record.message()?;
        Some(Self {
            stage,
            message: MessageId {
                epoch: name.epoch,
                sequence: name.sequence,
            },
            published_ns: name.published_ns,
            at_ns,
        })
    }
}

/// The record with `index` of a file of records that tell of single messages, or of a link.
pub(crate) fn record(file: &RecordFile, index: usize) -> Option<Record> {
    match file.header.kind {
        RecordKind::Published => file.record(index).map(Record::Published),
        RecordKind::Taken => file.record(index).map(Record::Taken),
        RecordKind::Egress => file.record(index).map(Record::Egress),
        RecordKind::Ingress => file.record(index).map(Record::Ingress),
        RecordKind::LinkCondition => file.record(index).map(Record::LinkCondition),
        _ => None,
    }
}

/// Such records of a file, in order.
pub(crate) fn records(file: &RecordFile) -> impl Iterator<Item = Record> + '_ {
    (0..file.record_count()).map_while(|index| record(file, index))
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
            Record::LinkCondition(_) => {}
        }
    }

    /// Takes a transmit stamp that came in a later datagram. It needs the sender's offset, so it is used
    /// only beside one that the sender noted.
    pub(crate) fn note_late(&mut self, late: FollowUp) {
        if self.tx_realtime_ns.is_none() {
            let left = self.handed_ns.zip(self.sender_realtime_offset_ns);
            self.tx_realtime_ns = left.and_then(|(handed_ns, offset_ns)| {
                let left_ns = handed_ns.checked_add(late.handed_to_tx_ns)?;
                left_ns.checked_add(offset_ns)
            });
        }
    }

    /// Takes the delay that the run worked out with its clocks' alignment.
    pub(crate) fn note_decision(&mut self, record: &TraceRecord) {
        if record.fate != TraceFate::Unknown {
            self.link_delay_ns = record.delay();
            self.link_delay_bound_ns = bound_ns(record);
        }
    }

    /// Works out the delay from end to end, as both read one clock.
    pub(crate) fn compare_ends(&mut self) {
        let ends = self.taken_ns.zip(self.published_ns);
        self.delay_ns = ends.and_then(|(taken, published)| taken.checked_sub(published));
    }
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
