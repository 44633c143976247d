//! What the network did to each message, as topics: the stamps of every stage beside each other, and
//! the verdict of the link. It judges nothing by itself: fates and bounds are those of the run.

use std::collections::BTreeMap;

use hil_models::record::{
    EgressRecord, FollowUpRecord, IngressRecord, PublishedRecord, TakenRecord, UNAVAILABLE,
};
use hil_models::trace::{Trace, TraceFate, TraceRecord, UNAVAILABLE_NS, UNBOUNDED_NS};
use hil_runtime::record::{RecordFile, RecordKind};
use prost_types::field_descriptor_proto::Type;

use crate::schema::{self, OwnField, Schema};

/// The stamps of one message, nanoseconds; absent where there was none. Each is on the clock that
/// its name says: monotonic of its own host unless `realtime` or `card` stands in it.
#[derive(Clone, PartialEq, prost::Message)]
pub(crate) struct MessageLatency {
    /// Number on the channel, from 0 at each start of the producer.
    #[prost(uint64, tag = "1")]
    pub(crate) sequence: u64,
    /// The producer's start.
    #[prost(uint32, tag = "2")]
    pub(crate) epoch: u32,
    /// The producer published it, on its host.
    #[prost(int64, optional, tag = "3")]
    pub(crate) published_ns: Option<i64>,
    /// The sending gateway took it.
    #[prost(int64, optional, tag = "4")]
    pub(crate) gateway_taken_ns: Option<i64>,
    /// Just before the send call.
    #[prost(int64, optional, tag = "5")]
    pub(crate) handed_ns: Option<i64>,
    /// Kernel transmit stamp.
    #[prost(int64, optional, tag = "6")]
    pub(crate) tx_realtime_ns: Option<i64>,
    /// The network card's transmit stamp, on the card's clock.
    #[prost(int64, optional, tag = "7")]
    pub(crate) tx_card_ns: Option<i64>,
    /// Real-time minus monotonic clock of the sending host.
    #[prost(int64, optional, tag = "8")]
    pub(crate) sender_realtime_offset_ns: Option<i64>,
    /// The network card's receive stamp, on the card's clock.
    #[prost(int64, optional, tag = "9")]
    pub(crate) rx_card_ns: Option<i64>,
    /// Kernel receive stamp.
    #[prost(int64, optional, tag = "10")]
    pub(crate) rx_realtime_ns: Option<i64>,
    /// The receive call had returned, on the receiving host.
    #[prost(int64, optional, tag = "11")]
    pub(crate) received_ns: Option<i64>,
    /// The receiving gateway published it.
    #[prost(int64, optional, tag = "12")]
    pub(crate) forwarded_ns: Option<i64>,
    /// Real-time minus monotonic clock of the receiving host.
    #[prost(int64, optional, tag = "13")]
    pub(crate) receiver_realtime_offset_ns: Option<i64>,
    /// The consumer took it.
    #[prost(int64, optional, tag = "14")]
    pub(crate) taken_ns: Option<i64>,
    /// Published to taken; absent unless both hosts read one clock.
    #[prost(int64, optional, tag = "15")]
    pub(crate) delay_ns: Option<i64>,
    /// Handed to received, as the run's link trace has it.
    #[prost(int64, optional, tag = "16")]
    pub(crate) link_delay_ns: Option<i64>,
    /// Largest error of `link_delay_ns` by the clocks' alignment; 0 on one clock.
    #[prost(uint64, optional, tag = "17")]
    pub(crate) link_delay_bound_ns: Option<u64>,
}

const LATENCY: [OwnField; 17] = [
    ("sequence", Type::Uint64, false),
    ("epoch", Type::Uint32, false),
    ("published_ns", Type::Int64, true),
    ("gateway_taken_ns", Type::Int64, true),
    ("handed_ns", Type::Int64, true),
    ("tx_realtime_ns", Type::Int64, true),
    ("tx_card_ns", Type::Int64, true),
    ("sender_realtime_offset_ns", Type::Int64, true),
    ("rx_card_ns", Type::Int64, true),
    ("rx_realtime_ns", Type::Int64, true),
    ("received_ns", Type::Int64, true),
    ("forwarded_ns", Type::Int64, true),
    ("receiver_realtime_offset_ns", Type::Int64, true),
    ("taken_ns", Type::Int64, true),
    ("delay_ns", Type::Int64, true),
    ("link_delay_ns", Type::Int64, true),
    ("link_delay_bound_ns", Type::Uint64, true),
];

/// Schema of [`MessageLatency`].
pub(crate) fn latency_schema() -> Schema {
    schema::own("MessageLatency", &LATENCY)
}

/// What the link did to one message.
#[derive(Clone, PartialEq, prost::Message)]
#[allow(
    clippy::struct_excessive_bools,
    reason = "a row of a table, not a state"
)]
pub(crate) struct LinkDecision {
    /// Number on the channel, from 0 at each start of the producer.
    #[prost(uint64, tag = "1")]
    pub(crate) sequence: u64,
    /// Starts of the producer before this message's.
    #[prost(uint32, tag = "2")]
    pub(crate) start: u32,
    /// `delivered`, `lost-in-network`, `lost-before-link`, `lost-after-link` or `unknown`.
    #[prost(string, tag = "3")]
    pub(crate) fate: String,
    /// True for the three kinds of loss.
    #[prost(bool, tag = "4")]
    pub(crate) is_lost: bool,
    /// True when a second copy arrived.
    #[prost(bool, tag = "5")]
    pub(crate) is_duplicated: bool,
    /// It arrived after a message published later.
    #[prost(bool, tag = "6")]
    pub(crate) is_reordered: bool,
    /// A link model, not a network, decided.
    #[prost(bool, tag = "7")]
    pub(crate) is_emulated: bool,
    /// Handed to the link until it arrived.
    #[prost(int64, optional, tag = "8")]
    pub(crate) delay_ns: Option<i64>,
    /// Largest error of `delay_ns` by the clocks' alignment; 0 on one clock.
    #[prost(uint64, optional, tag = "9")]
    pub(crate) delay_bound_ns: Option<u64>,
    /// Handed to the link until the second copy arrived.
    #[prost(int64, optional, tag = "10")]
    pub(crate) second_delay_ns: Option<i64>,
    /// Size of the message.
    #[prost(uint32, tag = "11")]
    pub(crate) size_bytes: u32,
}

const DECISION: [OwnField; 11] = [
    ("sequence", Type::Uint64, false),
    ("start", Type::Uint32, false),
    ("fate", Type::String, false),
    ("is_lost", Type::Bool, false),
    ("is_duplicated", Type::Bool, false),
    ("is_reordered", Type::Bool, false),
    ("is_emulated", Type::Bool, false),
    ("delay_ns", Type::Int64, true),
    ("delay_bound_ns", Type::Uint64, true),
    ("second_delay_ns", Type::Int64, true),
    ("size_bytes", Type::Uint32, false),
];

/// Schema of [`LinkDecision`].
pub(crate) fn decision_schema() -> Schema {
    schema::own("LinkDecision", &DECISION)
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

/// The stamps of the messages of one channel, by start and number.
pub(crate) type Latencies = BTreeMap<(u32, u64), MessageLatency>;

/// Joins the record files of one channel. `has_one_clock` says that stamps of both ends compare.
pub(crate) fn latencies<'a>(
    files: &(impl Iterator<Item = &'a RecordFile> + Clone),
    trace: Option<&Trace>,
    has_one_clock: bool,
) -> Latencies {
    let mut joined = Latencies::new();
    for file in files.clone() {
        match file.header.kind {
            RecordKind::Published => file.records().for_each(|one| published(&mut joined, &one)),
            RecordKind::Taken => file.records().for_each(|one| taken(&mut joined, &one)),
            RecordKind::Egress => file.records().for_each(|one| sent(&mut joined, &one)),
            RecordKind::Ingress => file.records().for_each(|one| received(&mut joined, &one)),
            _ => {}
        }
    }
    follow_up(&mut joined, files);
    if has_one_clock {
        for one in joined.values_mut() {
            let ends = one.taken_ns.zip(one.published_ns);
            one.delay_ns = ends.and_then(|(taken, published)| taken.checked_sub(published));
        }
    }
    if let Some(trace) = trace {
        add_link_delays(&mut joined, trace);
    }
    joined
}

fn entry(joined: &mut Latencies, epoch: u32, sequence: u64) -> &mut MessageLatency {
    joined
        .entry((epoch, sequence))
        .or_insert_with(|| MessageLatency {
            sequence,
            epoch,
            ..MessageLatency::default()
        })
}

/// Puts a record beside the others of its message.
pub(crate) fn published(joined: &mut Latencies, record: &PublishedRecord) {
    entry(joined, record.epoch, record.sequence).note_published(record);
}

/// Puts a record beside the others of its message.
pub(crate) fn taken(joined: &mut Latencies, record: &TakenRecord) {
    entry(joined, record.epoch, record.sequence).note_taken(record);
}

/// Puts a record beside the others of its message.
pub(crate) fn sent(joined: &mut Latencies, record: &EgressRecord) {
    entry(joined, record.epoch, record.sequence).note_sent(record);
}

/// Puts a record beside the others of its message.
pub(crate) fn received(joined: &mut Latencies, record: &IngressRecord) {
    // A second copy says nothing of the way of the first.
    if record.flags & IngressRecord::DUPLICATE != 0 {
        return;
    }
    entry(joined, record.epoch, record.sequence).note_received(record);
}

/// What each record says of its message, in whatever order they come.
impl MessageLatency {
    /// The producer's.
    pub(crate) fn note_published(&mut self, record: &PublishedRecord) {
        self.published_ns = stamp(record.published_ns);
    }

    /// The consumer's.
    pub(crate) fn note_taken(&mut self, record: &TakenRecord) {
        self.published_ns = self.published_ns.or(stamp(record.published_ns));
        self.taken_ns = stamp(record.taken_ns);
    }

    /// The sending gateway's.
    pub(crate) fn note_sent(&mut self, record: &EgressRecord) {
        self.published_ns = self.published_ns.or(stamp(record.published_ns));
        self.gateway_taken_ns = stamp(record.taken_ns);
        self.handed_ns = stamp(record.handed_ns);
        self.tx_realtime_ns = stamp(record.tx_software_ns);
        self.tx_card_ns = stamp(record.tx_hardware_ns);
        self.sender_realtime_offset_ns = stamp(record.realtime_offset_ns);
    }

    /// The receiving gateway's, of the first copy.
    pub(crate) fn note_received(&mut self, record: &IngressRecord) {
        self.published_ns = self.published_ns.or(stamp(record.published_ns));
        self.handed_ns = self.handed_ns.or(stamp(record.handed_ns));
        self.rx_card_ns = stamp(record.rx_hardware_ns);
        self.rx_realtime_ns = stamp(record.rx_software_ns);
        self.received_ns = stamp(record.received_ns);
        self.forwarded_ns = stamp(record.forwarded_ns);
        self.receiver_realtime_offset_ns = stamp(record.realtime_offset_ns);
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
            let epoch = epochs.get(&(record.session, record.sequence));
            let one = epoch.and_then(|epoch| joined.get_mut(&(*epoch, record.sequence)));
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
        let epoch = starts.get(usize::from(record.start));
        let key = epoch.map(|epoch| (*epoch, record.sequence));
        if let Some(one) = key.and_then(|key| joined.get_mut(&key)) {
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
