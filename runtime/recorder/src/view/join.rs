//! The stages of one message as its records come in, in any order, and which of the way's segments
//! they complete. The stages are those of the account of a finished run.

use hil_core::record::EgressRecord;
use hil_watch::Record;

use crate::net::{MessageId, MessageLatency};

/// The segments of a channel over a link, in order.
const LINK_SEGMENTS: [&str; 7] = [
    "published-taken by gateway",
    "taken by gateway-handed",
    "handed-TX stamp",
    "TX stamp-RX stamp",
    "RX stamp-received",
    "received-forwarded",
    "forwarded-taken",
];

/// The only segment of a channel that stays in shared memory.
const LOCAL_SEGMENTS: [&str; 1] = ["published-taken"];

/// What decides which lengths a channel's stamps give.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Way {
    /// It crosses a link.
    pub(crate) has_link: bool,
    /// Stamps of both ends compare.
    pub(crate) has_one_clock: bool,
}

impl Way {
    /// The names of its segments.
    pub(crate) const fn segments(self) -> &'static [&'static str] {
        if self.has_link {
            &LINK_SEGMENTS
        } else {
            &LOCAL_SEGMENTS
        }
    }
}

/// One message on its way.
#[derive(Debug, Clone, Default)]
pub(crate) struct Joined {
    /// Its stamps.
    pub(crate) stamps: MessageLatency,
    /// When the first of its records was known.
    pub(crate) first_ns: i64,
    is_refused: bool,
    has_ingress: bool,
    /// Segments already counted, by bit; the last bit is the whole way.
    counted: u16,
}

/// The bit of the whole way, published to taken.
const WHOLE: usize = 15;

impl Joined {
    /// A message first heard of at `at_ns`.
    pub(crate) fn new(message: MessageId, at_ns: i64) -> Self {
        Self {
            stamps: MessageLatency::new(message),
            first_ns: at_ns,
            ..Self::default()
        }
    }

    /// Takes a record of it; of its arrivals only the first.
    pub(crate) fn note(&mut self, record: &Record) {
        self.stamps.note(record);
        match record {
            Record::Egress(one) => {
                self.is_refused = one.flags & EgressRecord::REFUSED_BY_KERNEL != 0;
            }
            Record::Ingress(_) => self.has_ingress = true,
            _ => {}
        }
    }

    /// True when it reached the other gateway, or its consumer said so.
    pub(crate) fn has_arrived(&self) -> bool {
        self.has_ingress || self.stamps.taken_ns.is_some()
    }

    /// True when it was handed to the link, or the kernel refused it there.
    pub(crate) fn has_left(&self) -> bool {
        self.is_refused || self.stamps.handed_ns.is_some()
    }

    /// Hears of each segment whose two ends are known now and were not before: its place among
    /// [`Way::segments`], `None` for the whole way, and its length.
    pub(crate) fn news(&mut self, way: Way, hear: &mut dyn FnMut(Option<usize>, i64)) {
        let one = &self.stamps;
        let mut counted = self.counted;
        let mut offer = |bit: usize, length_ns: Option<i64>| {
            let is_new = counted & (1 << bit) == 0;
            if let Some(length_ns) = length_ns.filter(|_| is_new) {
                counted |= 1 << bit;
                hear((bit != WHOLE).then_some(bit), length_ns);
            }
        };
        let whole =
            span(one.published_ns, one.taken_ns).filter(|_| way.has_one_clock || !way.has_link);
        if way.has_link {
            let tx_ns = minus(one.tx_realtime_ns, one.sender_realtime_offset_ns);
            let rx_ns = minus(one.rx_realtime_ns, one.receiver_realtime_offset_ns);
            let wire = span(one.tx_realtime_ns, one.rx_realtime_ns).filter(|_| way.has_one_clock);
            let segments = [
                span(one.published_ns, one.gateway_taken_ns),
                span(one.gateway_taken_ns, one.handed_ns),
                span(one.handed_ns, tx_ns),
                wire,
                span(rx_ns, one.received_ns),
                span(one.received_ns, one.forwarded_ns),
                span(one.forwarded_ns, one.taken_ns),
            ];
            for (bit, length_ns) in segments.into_iter().enumerate() {
                offer(bit, length_ns);
            }
        } else {
            offer(0, whole);
        }
        offer(WHOLE, whole);
        self.counted = counted;
        self.stamps.delay_ns = whole;
    }
}

fn minus(ns: Option<i64>, offset_ns: Option<i64>) -> Option<i64> {
    ns.zip(offset_ns)
        .and_then(|(ns, offset)| ns.checked_sub(offset))
}

fn span(from_ns: Option<i64>, to_ns: Option<i64>) -> Option<i64> {
    minus(to_ns, from_ns)
}
