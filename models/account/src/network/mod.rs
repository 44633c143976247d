//! What the network did to the messages of one channel and direction, in the terms of the
//! Internet's measurement standards: one-way delay and its variation (RFC 5481, RFC 3393,
//! RFC 3550), loss and its bursts (RFC 3611), reordering (RFC 4737), throughput. It reads
//! [`Passage`]s, which [`crate::MessageHistory::passage`] makes; it opens no file and knows
//! no robot.
//!
//! The network begins where the sending gateway hands a message to the kernel and ends where the
//! receiving gateway's receive call returned; a way to the peer that is not there (an interface that is
//! down, no route) is the network's. What a host lost on its own (a message replaced by
//! a newer one before it was sent, refused by the kernel, lost while a process was down) is counted
//! beside the network's losses and never among them.

mod bins;
#[cfg(test)]
mod bound_tests;
mod delay;
mod events;
mod list;
mod loss;
mod order;
#[cfg(test)]
mod tests;

use serde::{Deserialize, Serialize};

pub use bins::{NetworkBin, NetworkBins, Place, bin_width_ns, network_series_name};
pub use delay::{
    DelayMetrics, DelayQuantile, DelayVariation, InterarrivalJitter, SuccessiveVariation,
};
pub use events::{
    CLOCK_READING_AGE_NS_MAX, EVENT_OUTAGE_MIN_NS, NetworkEvent, NetworkEventKind, clock_steps,
    interruptions, network_events,
};
pub use list::Passages;
pub use loss::{BURST_GAP_MIN, BurstMetrics, LongestLoss, LossBounds, LossMetrics};
pub use order::OrderMetrics;

use crate::{ChannelPath, Side};
use hil_stats::histogram::DurationBin;

/// What the network did to one message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Crossing {
    /// The receiving gateway has it.
    Arrived,
    /// Handed to the kernel, never received.
    LostByNetwork,
    /// Lost by the network before it: an interface was down or there was no route.
    Unreachable,
    /// It never got onto the network, or was lost because a process was down.
    LostByHost,
    /// Still under way at the end, or the other host's records are not at hand.
    Unknown,
    /// Handed to the kernel, and either lost there or by the receiving host for want of room.
    Doubtful,
}

/// One message's way over the network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Passage {
    /// Which start of the producer, in order.
    pub epoch_rank: u32,
    /// Sequence number.
    pub sequence: u64,
    /// 1, or the length of a run of numbers that no record mentions.
    pub count: u64,
    /// When it was handed to the kernel, or else published, on the producer's clock.
    pub offered_ns: Option<i64>,
    /// When the receiving gateway had it, on the consumer's clock.
    pub received_ns: Option<i64>,
    /// Handed to the kernel to received; `None` when it did not arrive and between hosts whose
    /// clocks are not aligned.
    pub delay_ns: Option<i64>,
    /// Largest error of `delay_ns` from the alignment of the clocks.
    pub delay_bound_ns: u64,
    /// What became of it.
    pub crossing: Crossing,
}

impl Passage {
    /// True for the first message of another start of the producer.
    const fn begins_epoch_after(&self, other: &Self) -> bool {
        self.epoch_rank != other.epoch_rank
    }
}

/// A figure, or why there is none.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "state", rename_all = "snake_case")]
pub enum Metric<T> {
    /// The figure.
    Measured(T),
    /// There is none.
    Unavailable {
        /// Why.
        reason: String,
    },
}

impl<T> Metric<T> {
    /// No figure, for this reason.
    pub fn unavailable(reason: &str) -> Self {
        Self::Unavailable {
            reason: reason.to_owned(),
        }
    }

    /// The figure, if there is one.
    pub const fn measured(&self) -> Option<&T> {
        match self {
            Self::Measured(figure) => Some(figure),
            Self::Unavailable { .. } => None,
        }
    }
}

/// What the passages alone do not say.
#[derive(Debug, Clone, Copy)]
pub struct NetworkContext<'a> {
    /// How the clocks of the two hosts relate.
    pub path: ChannelPath<'a>,
    /// Start and end of the run on the producer's clock, nanoseconds, where known.
    pub run_ns: Option<(i64, i64)>,
    /// Payload of a message that arrived, the mean where they differ in length.
    pub payload_bytes: Option<f64>,
}

/// The network's figures of one channel, which is one direction.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NetworkMetrics {
    /// Messages handed to the network whose outcome is known.
    pub offered_count: u64,
    /// Of these, received by the other gateway.
    pub arrived_count: u64,
    /// Of these, never received.
    pub lost_count: u64,
    /// Lost before they got onto the network, or because a process was down; not in
    /// `offered_count`.
    pub host_lost_count: u64,
    /// Still under way at the end of the run, or unknown, also whether the network lost it; not in
    /// `offered_count`.
    pub unknown_count: u64,
    /// Of the unknown ones, those that the network lost, or the receiving host for want of room.
    #[serde(default)]
    pub doubtful_count: u64,
    /// Messages per second handed to the network, from the first to the last of them.
    pub offered_per_s: Option<f64>,
    /// Of these, messages per second that were received, over the same time: what was lost at its end lowers this rate
    /// as well. `None` below two that were handed over.
    pub arrived_per_s: Option<f64>,
    /// Payload bytes per second of these, without any header.
    pub arrived_bytes_per_s: Option<f64>,
    /// Handed to the kernel to received by the other gateway.
    pub delay: Metric<DelayMetrics>,
    /// The same delays as a histogram; empty where none was measured.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub delay_bins: Vec<DurationBin>,
    /// Difference of the delays of successive messages; needs no alignment of clocks, only a bound
    /// of their rates.
    pub successive: Metric<SuccessiveVariation>,
    /// Losses of the network.
    pub loss: Metric<LossMetrics>,
    /// Reordering.
    pub order: Metric<OrderMetrics>,
}

impl NetworkMetrics {
    /// The figures of `passages`, which are in the order of epochs and sequence numbers.
    pub fn of(passages: &Passages, context: &NetworkContext<'_>) -> Self {
        let counts = Counts::of(passages);
        let offered_count = counts.arrived.saturating_add(counts.lost);
        let on_network = |one: &Passage| {
            matches!(
                one.crossing,
                Crossing::Arrived | Crossing::LostByNetwork | Crossing::Unreachable
            )
        };
        let offered = passages.each().filter(on_network);
        let offered_per_s = rate(offered.filter_map(|one| Some((one.offered_ns?, one.count))));
        let arrived_ratio = counts.arrived as f64 / offered_count as f64;
        let arrived_per_s = offered_per_s.map(|per_s| per_s * arrived_ratio);
        Self {
            offered_count,
            arrived_count: counts.arrived,
            lost_count: counts.lost,
            host_lost_count: counts.host_lost,
            unknown_count: counts.unknown + counts.doubtful,
            doubtful_count: counts.doubtful,
            offered_per_s,
            arrived_per_s,
            arrived_bytes_per_s: context
                .payload_bytes
                .zip(arrived_per_s)
                .map(|(bytes, per_s)| bytes * per_s),
            delay_bins: delay::delay_bins(passages),
            delay: delay::delays(passages, context.path),
            successive: delay::successive(passages, context.path),
            loss: match counts.doubtful {
                0 => loss::losses(passages, context.run_ns),
                _ => Metric::unavailable(
                    "it is unknown of some messages whether they were lost on the wire or for want of room on the \
                     receiving host",
                ),
            },
            order: order::order(passages),
        }
    }

    /// Between what the loss ratio is; `None` where it is one figure, or there is none.
    pub fn loss_bounds(&self) -> Option<LossBounds> {
        let doubtful_count = Some(self.doubtful_count).filter(|count| *count > 0)?;
        let of = self.offered_count.saturating_add(doubtful_count) as f64;
        Some(LossBounds {
            low: self.lost_count as f64 / of,
            high: self.lost_count.saturating_add(doubtful_count) as f64 / of,
            doubtful_count,
        })
    }
}

/// Messages by what became of them.
#[derive(Debug, Default)]
struct Counts {
    arrived: u64,
    lost: u64,
    host_lost: u64,
    unknown: u64,
    doubtful: u64,
}

impl Counts {
    fn of(passages: &Passages) -> Self {
        let mut counts = Self::default();
        for one in passages.each() {
            let count = match one.crossing {
                Crossing::Arrived => &mut counts.arrived,
                Crossing::LostByNetwork | Crossing::Unreachable => &mut counts.lost,
                Crossing::LostByHost => &mut counts.host_lost,
                Crossing::Unknown => &mut counts.unknown,
                Crossing::Doubtful => &mut counts.doubtful,
            };
            *count = count.saturating_add(one.count);
        }
        counts
    }
}

fn is_arrived(one: &Passage) -> bool {
    one.crossing == Crossing::Arrived
}

/// Messages per second from the first to the last of them; each with how many it stands for. `None` below
/// two instants.
fn rate(messages: impl Iterator<Item = (i64, u64)>) -> Option<f64> {
    let mut count = 0_u64;
    let mut ends: Option<(i64, i64)> = None;
    for (at_ns, of) in messages {
        let (first, last) = ends.unwrap_or((at_ns, at_ns));
        ends = Some((first.min(at_ns), last.max(at_ns)));
        count = count.saturating_add(of);
    }
    let (first, last) = ends?;
    let span_s = last.saturating_sub(first) as f64 * 1e-9;
    // The last of n messages ends n - 1 periods.
    (span_s > 0.0).then(|| count.saturating_sub(1) as f64 / span_s)
}

/// A moment of a channel, on the clock of one of its two hosts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Moment {
    /// Whose clock.
    pub side: Side,
    /// Nanoseconds on it.
    pub ns: i64,
}
