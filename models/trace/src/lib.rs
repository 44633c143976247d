//! A link trace: what one channel's messages met on a link, one record each. It is what a run
//! leaves, what the models are fitted to, and what [`replay::TraceLink`] replays. It
//! opens no file; layouts are in `docs/traces.md`.
//!
//! [`wire`] is the binary form, [`csv`] the textual one, [`opportunities`] that of Mahimahi,
//! [`netem`] an export; [`metrics`] describes a trace, [`fit`] sets link models beside it.
#![forbid(unsafe_code)]

pub mod csv;
mod epoch;
pub mod fault;
pub mod fit;
pub mod from_records;
pub mod metrics;
pub mod netem;
pub mod opportunities;
pub mod replay;
mod replay_offers;
#[cfg(test)]
mod replay_tests;
mod replay_ticks;
pub mod wire;

use serde::{Deserialize, Serialize};

/// An instant or a delay that is not known; never a made-up zero.
pub const UNAVAILABLE_NS: i64 = i64::MIN;

/// A bound that is not known.
pub const UNBOUNDED_NS: u64 = u64::MAX;

hil_core::labelled! {
    /// What became of a message.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum TraceFate, word {
        /// Nobody can say: it was under way when the run ended, or the other host's records are missing.
        Unknown = "unknown",
        /// The receiving gateway published it.
        Delivered = "delivered",
        /// Handed to the kernel, never received.
        LostInNetwork = "lost-in-network",
        /// It never left the sending host: superseded, refused by the kernel, or its gateway was down.
        LostBeforeLink = "lost-before-link",
        /// The receiving host had it and did not publish it: late, a duplicate, or refused.
        LostAfterLink = "lost-after-link",
    }
}

impl TraceFate {
    /// True when the consumer's host never got it, for whatever reason.
    pub const fn is_loss(self) -> bool {
        matches!(
            self,
            Self::LostInNetwork | Self::LostBeforeLink | Self::LostAfterLink
        )
    }
}

/// What one message met.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TraceRecord {
    /// When it was published, nanoseconds since the run's start on the sender's clock. Records are
    /// in this order.
    pub published_ns: i64,
    /// When it was handed to the link, on the same clock; else when its gateway took it, else when
    /// it was published.
    pub departure_ns: i64,
    /// Departure to arrival; [`UNAVAILABLE_NS`] when it did not arrive, or when two clocks have no
    /// relation.
    pub delay_ns: i64,
    /// Largest error of `delay_ns`, 0 on one clock; [`UNBOUNDED_NS`] without a delay.
    pub bound_ns: u64,
    /// Departure to the arrival of a second copy; [`UNAVAILABLE_NS`] when there was none.
    pub second_delay_ns: i64,
    /// Sequence number on the channel, counted from 0 at each start of the producer.
    pub sequence: u64,
    /// Payload.
    pub size_bytes: u32,
    /// Starts of the producer before this message's.
    pub start: u16,
    /// What became of it.
    pub fate: TraceFate,
    /// Bits below.
    pub flags: u8,
}

impl TraceRecord {
    /// It arrived after a message published later.
    pub const REORDERED: u8 = 1;
    /// A link model, not a network, decided its fate.
    pub const EMULATED: u8 = 2;
    /// The sending host's kernel refused it, or its peer was absent.
    pub const REFUSED: u8 = 4;
    /// A process on its way was down.
    pub const INTERRUPTED: u8 = 8;
    /// No record tells when it was published; the instant is that of the message before.
    pub const INSTANT_ASSUMED: u8 = 16;
    /// All bits with a meaning.
    pub const FLAGS: u8 = 31;

    /// A message that met nothing yet.
    pub const fn published(published_ns: i64, sequence: u64, size_bytes: u32) -> Self {
        Self {
            published_ns,
            departure_ns: published_ns,
            delay_ns: UNAVAILABLE_NS,
            bound_ns: UNBOUNDED_NS,
            second_delay_ns: UNAVAILABLE_NS,
            sequence,
            size_bytes,
            start: 0,
            fate: TraceFate::Unknown,
            flags: 0,
        }
    }

    /// The same, delivered after `delay_ns`, known to `bound_ns`.
    #[must_use]
    pub const fn delivered(mut self, delay_ns: i64, bound_ns: u64) -> Self {
        self.fate = TraceFate::Delivered;
        self.delay_ns = delay_ns;
        self.bound_ns = bound_ns;
        self
    }

    /// The delay, where it is known.
    pub fn delay(&self) -> Option<i64> {
        (self.delay_ns != UNAVAILABLE_NS).then_some(self.delay_ns)
    }

    /// The delay of the second copy, if there was one and it is known.
    pub fn second_delay(&self) -> Option<i64> {
        (self.second_delay_ns != UNAVAILABLE_NS).then_some(self.second_delay_ns)
    }

    /// True when `flag` is set.
    pub const fn has(&self, flag: u8) -> bool {
        self.flags & flag != 0
    }
}

hil_core::labelled! {
    /// Which way a channel travels on its link.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum TraceDirection, word {
        /// Not known.
        Unknown = "unknown",
        /// From the first host of the link's `between` to the second.
        Forward = "forward",
        /// From the second to the first.
        Backward = "backward",
    }
}

hil_core::labelled! {
    /// Where a delay ends.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum TraceArrival, word {
        /// Not known, as in a trace from elsewhere.
        Unknown = "unknown",
        /// The receiving gateway's receive call had returned.
        Received = "received",
        /// The packet was seen at the second point of a capture.
        Captured = "captured",
    }
}

/// Where a trace comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TraceHeader {
    /// The run it was taken from, at most [`TraceHeader::RUN_BYTES`].
    pub run: String,
    /// The channel, at most [`TraceHeader::CHANNEL_BYTES`].
    pub channel: String,
    /// The link, at most [`TraceHeader::LINK_BYTES`].
    pub link: String,
    /// How the clocks of both ends relate, in words, e.g. `one clock`, or why delays are
    /// unavailable; at most [`TraceHeader::CLOCK_BYTES`].
    pub clock: String,
    /// Which way.
    pub direction: TraceDirection,
    /// Where delays end.
    pub arrival: TraceArrival,
    /// How often the link was changed while the run went on: above 0, its model alone does not explain the
    /// trace.
    pub link_change_count: u16,
    /// The run's start on the sender's monotonic clock; [`UNAVAILABLE_NS`] when it has none.
    pub origin_ns: i64,
    /// Length of the run; [`UNAVAILABLE_NS`] when it is not known.
    pub duration_ns: i64,
}

impl TraceHeader {
    /// Longest name of a run.
    pub const RUN_BYTES: usize = 96;
    /// Longest name of a channel.
    pub const CHANNEL_BYTES: usize = 96;
    /// Longest name of a link.
    pub const LINK_BYTES: usize = 64;
    /// Longest word on the clocks.
    pub const CLOCK_BYTES: usize = 64;

    /// The header of a trace that was made, not captured.
    pub fn new(channel: &str) -> Self {
        Self {
            run: String::new(),
            channel: channel.to_owned(),
            link: String::new(),
            clock: String::new(),
            direction: TraceDirection::Unknown,
            arrival: TraceArrival::Unknown,
            link_change_count: 0,
            origin_ns: UNAVAILABLE_NS,
            duration_ns: UNAVAILABLE_NS,
        }
    }
}

/// A trace: header and records in the order of publication.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Trace {
    /// Where it comes from.
    pub header: TraceHeader,
    /// What each message met.
    pub records: Vec<TraceRecord>,
}

/// How many messages met what.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct TraceCounts {
    /// Messages.
    pub message_count: u64,
    /// [`TraceFate::Delivered`].
    pub delivered_count: u64,
    /// [`TraceFate::LostInNetwork`].
    pub lost_in_network_count: u64,
    /// [`TraceFate::LostBeforeLink`].
    pub lost_before_link_count: u64,
    /// [`TraceFate::LostAfterLink`].
    pub lost_after_link_count: u64,
    /// [`TraceFate::Unknown`].
    pub unknown_count: u64,
    /// Delivered, with a delay.
    pub delay_count: u64,
    /// Messages that arrived twice.
    pub duplicated_count: u64,
}

impl TraceCounts {
    /// Counts one message.
    pub fn count(&mut self, record: &TraceRecord) {
        self.message_count += 1;
        *match record.fate {
            TraceFate::Unknown => &mut self.unknown_count,
            TraceFate::Delivered => &mut self.delivered_count,
            TraceFate::LostInNetwork => &mut self.lost_in_network_count,
            TraceFate::LostBeforeLink => &mut self.lost_before_link_count,
            TraceFate::LostAfterLink => &mut self.lost_after_link_count,
        } += 1;
        let is_delivered = record.fate == TraceFate::Delivered;
        self.delay_count += u64::from(is_delivered && record.delay().is_some());
        self.duplicated_count += u64::from(record.second_delay().is_some());
    }

    /// Messages lost, wherever.
    pub const fn lost_count(&self) -> u64 {
        self.lost_in_network_count + self.lost_before_link_count + self.lost_after_link_count
    }
}

impl Trace {
    /// What its messages met.
    pub fn counts(&self) -> TraceCounts {
        let mut counts = TraceCounts::default();
        for record in &self.records {
            counts.count(record);
        }
        counts
    }

    /// Largest error of any delay from the clocks, 0 on one clock; `None` without delays, and when
    /// that of one of them is not known.
    pub fn delay_bound_ns(&self) -> Option<u64> {
        let delays = self.records.iter();
        let delays = delays.filter(|record| record.delay().is_some());
        let largest_ns = delays.map(|record| record.bound_ns).max()?;
        (largest_ns != UNBOUNDED_NS).then_some(largest_ns)
    }

    /// The delays of messages that arrived and were not published, in their order: they came too
    /// late, or something refused them.
    pub fn late_delays_ns(&self) -> Vec<i64> {
        let unused = self.records.iter();
        let unused = unused.filter(|record| record.fate == TraceFate::LostAfterLink);
        unused.filter_map(TraceRecord::delay).collect()
    }

    /// The delays of delivered messages, in their order; those without one are left out.
    pub fn delays_ns(&self) -> Vec<i64> {
        let delivered = self.records.iter();
        let delivered = delivered.filter(|record| record.fate == TraceFate::Delivered);
        delivered.filter_map(TraceRecord::delay).collect()
    }

    /// Middle of the times from one publication to the next; `None` below two messages.
    pub fn period_ns(&self) -> Option<i64> {
        let pairs = self.records.windows(2);
        let mut steps: Vec<i64> = pairs
            .map(|pair| pair[1].published_ns.saturating_sub(pair[0].published_ns))
            .collect();
        if steps.is_empty() {
            return None;
        }
        steps.sort_unstable();
        Some(steps[steps.len() / 2])
    }
}
