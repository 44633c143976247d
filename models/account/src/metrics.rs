//! What an account says: plain figures, ready to be written and read back. Nothing here
//! computes an account.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::stage::{MessageFate, Stage};
use hil_core::interval::Spread;
use hil_stats::bounds::BoundMetrics;
use hil_stats::histogram::{Distribution, DurationBin};

/// The latency account of one channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChannelAccount {
    /// Messages the producer published: every sequence number up to the highest seen of each of its starts, from the first
    /// that counts ([`crate::FirstNumber`]).
    pub published_count: u64,
    /// Those without a record of the producer's; `None` when its records are not at hand.
    pub published_unrecorded_count: Option<u64>,
    /// Starts of the producer after the first: restarts, not losses.
    pub producer_restart_count: u64,
    /// What became of each message; the sum is [`ChannelAccount::published_count`].
    pub fates: FateCounts,
    /// Received after a message with a higher sequence number; `None` without the receiving
    /// gateway's records or on a direct channel.
    pub reordered_count: Option<u64>,
    /// Datagrams received again.
    pub duplicated_count: Option<u64>,
    /// Messages older than the sequence window.
    pub late_count: Option<u64>,
    /// The way of a message in order: first each pair of neighbouring stages, available or not,
    /// then pairs that some message had to combine because a stage between was missing.
    pub segments: Vec<SegmentMetrics>,
    /// Published to taken, as the consumer's own record has it.
    pub end_to_end: EndToEnd,
    /// Whether the segments of each message add up.
    pub closing: Closing,
    /// Share of messages with each kernel stamp.
    pub coverage: StampCoverage,
    /// Round trips of the gateways' clock exchange, separate from the chain.
    pub round_trip: Distribution,
    /// How many losses came in a row.
    pub loss_bursts: Vec<BurstCount>,
    /// Silence at the consumer.
    pub gaps: Gaps,
    /// What each interruption cost this channel.
    pub interruptions: Vec<InterruptionMetrics>,
}

impl ChannelAccount {
    /// Messages that vanished; `None` where records that are not at hand would tell of others.
    pub fn lost_known(&self) -> Option<u64> {
        let unknown_count = self.fates.of(MessageFate::UnknownPeerRecordsUnavailable);
        let is_known = unknown_count == 0 && self.published_unrecorded_count.is_some();
        is_known.then(|| self.fates.lost_count())
    }
}

/// Messages by fate.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct FateCounts {
    counts: BTreeMap<MessageFate, u64>,
}

impl FateCounts {
    /// Messages with this fate.
    pub fn of(&self, fate: MessageFate) -> u64 {
        self.counts.get(&fate).copied().unwrap_or(0)
    }

    /// All messages.
    pub fn total(&self) -> u64 {
        let counts = self.counts.values();
        counts.fold(0, |sum, count| sum.saturating_add(*count))
    }

    /// Messages that vanished; see [`MessageFate::is_loss`].
    pub fn lost_count(&self) -> u64 {
        let losses = self.iter().filter(|(fate, _)| fate.is_loss());
        losses.fold(0, |sum, (_, count)| sum.saturating_add(count))
    }

    /// The fates that occurred, in the order of a message's way.
    pub fn iter(&self) -> impl Iterator<Item = (MessageFate, u64)> + '_ {
        self.counts.iter().map(|(fate, count)| (*fate, *count))
    }

    /// Counts `count` messages of one fate.
    pub fn add(&mut self, fate: MessageFate, count: u64) {
        let entry = self.counts.entry(fate).or_insert(0);
        *entry = entry.saturating_add(count);
    }
}

/// The durations between two stages.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SegmentMetrics {
    /// Where it starts.
    pub from: Stage,
    /// Where it ends.
    pub to: Stage,
    /// True when a stage between the two was missing for the messages counted here.
    pub is_combined: bool,
    /// Its durations.
    pub distribution: Distribution,
    /// The same durations as a histogram; empty where none was measured.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub bins: Vec<DurationBin>,
    /// How far its durations may be off because it ends on another host's clock than it began on;
    /// `None` within one host.
    #[serde(default)]
    pub bound: Option<BoundMetrics>,
}

impl SegmentMetrics {
    /// Both ends in words.
    pub fn name(&self) -> String {
        format!("{} → {}", self.from, self.to)
    }
}

/// Published to taken.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EndToEnd {
    /// The durations, on the consumer's clock.
    pub distribution: Distribution,
    /// The same durations as a histogram; empty where none was measured.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub bins: Vec<DurationBin>,
    /// 95 % interval of the median, nanoseconds, or why there is none; `None` when no duration differs.
    pub p50_interval: Option<Spread>,
    /// The same of the 99th percentile.
    pub p99_interval: Option<Spread>,
    /// Errors from clock alignment over all messages; zero on one clock.
    #[serde(default)]
    pub bound: Option<BoundMetrics>,
}

impl EndToEnd {
    /// Largest error from clock alignment, nanoseconds; 0 on one clock.
    pub fn alignment_bound_ns(&self) -> Option<u64> {
        self.bound.map(|bound| bound.largest_ns)
    }
}

/// Whether published-to-taken equals the sum of the segments, message by message.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "state", rename_all = "snake_case")]
pub enum Closing {
    /// Checked on every taken message.
    Checked(ClosingMetrics),
    /// Not checkable.
    Unavailable {
        /// Why, in words for a report.
        reason: String,
    },
}

impl Closing {
    /// The figures, if it was checked.
    pub const fn checked(&self) -> Option<&ClosingMetrics> {
        match self {
            Self::Checked(figures) => Some(figures),
            Self::Unavailable { .. } => None,
        }
    }
}

/// The outcome of the closing check.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ClosingMetrics {
    /// Messages checked: all that were taken.
    pub checked_count: u64,
    /// Messages whose stages are complete and in order and whose residual is within the limit.
    pub closed_count: u64,
    /// Closed messages with a combined segment: a kernel stamp was missing, so the two clocks
    /// of a host were not tested against each other.
    pub closed_combined_count: u64,
    /// Not closed because a process left no record of a stage it must have passed.
    pub missing_stage_count: u64,
    /// Not closed because a stage lies before its predecessor by more than the tolerance.
    pub negative_segment_count: u64,
    /// Not closed because of the residual alone.
    pub residual_count: u64,
    /// Not checked because a clock was stepped about when the message was published.
    #[serde(default)]
    pub unaligned_count: u64,
    /// True when stamps of one host were converted to the other's clock first: then an error of
    /// either host's real-time offset cancels out, and the check proves that much less.
    #[serde(default)]
    pub is_converted: bool,
    /// Largest residual that closes, nanoseconds.
    pub residual_limit_ns: i64,
    /// End-to-end minus sum of segments, magnitude.
    pub residual: Distribution,
}

impl ClosingMetrics {
    /// Share of checked messages that closed: of all of them, so that it has no interval.
    pub fn closed_ratio(&self) -> Option<f64> {
        (self.checked_count > 0).then(|| self.closed_count as f64 / self.checked_count as f64)
    }
}

/// How many messages carried each stamp.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct StampCoverage {
    /// Kernel transmit stamps, of the messages handed to the kernel. On a host without the
    /// sender's records: of the messages received, by follow-up.
    pub tx_software: Option<Coverage>,
    /// Of the kernel transmit stamps, those taken before the queueing discipline: the driver stamps no departures.
    #[serde(default)]
    pub tx_before_queue_count: u64,
    /// Card transmit stamps.
    pub tx_hardware: Option<Coverage>,
    /// Kernel receive stamps, of the messages received.
    pub rx_software: Option<Coverage>,
    /// Card receive stamps.
    pub rx_hardware: Option<Coverage>,
}

/// Stamped messages among those that could have been.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Coverage {
    /// With a stamp.
    pub stamped_count: u64,
    /// With or without.
    pub eligible_count: u64,
}

impl Coverage {
    /// Share in 0..=1; `None` when there was nothing to stamp.
    pub fn ratio(&self) -> Option<f64> {
        let stamped = self.stamped_count as f64;
        (self.eligible_count > 0).then(|| stamped / self.eligible_count as f64)
    }

    pub(super) fn count(&mut self, is_stamped: bool) {
        self.eligible_count += 1;
        self.stamped_count += u64::from(is_stamped);
    }
}

/// So many runs of exactly so many successive losses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct BurstCount {
    /// Losses in a row.
    pub length_messages: u64,
    /// How often.
    pub count: u64,
}

/// Counts runs by their lengths.
#[derive(Debug, Clone, Default)]
pub struct BurstLengths(BTreeMap<u64, u64>);

impl BurstLengths {
    /// Adds one of so many messages; none is no run.
    pub fn add(&mut self, length_messages: u64) {
        if length_messages > 0 {
            *self.0.entry(length_messages).or_insert(0) += 1;
        }
    }

    /// The counts, the shortest first.
    pub fn finish(self) -> Vec<BurstCount> {
        let count = |(length_messages, count)| BurstCount {
            length_messages,
            count,
        };
        self.0.into_iter().map(count).collect()
    }
}

/// The time between successive messages at the consumer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Gaps {
    /// All of them.
    pub between_taken: Distribution,
    /// The longest time in which one was due, to the end of the run if none came any more; `None` where there was none.
    pub longest: Option<Gap>,
    /// The longest that overlaps no interruption.
    pub longest_unattributed: Option<Gap>,
    /// From the last taken message to the end of the run, nanoseconds; `None` when either is
    /// unknown.
    pub last_taken_to_run_end_ns: Option<i64>,
    /// The longest time in which the producer published nothing, which is in none of the above; `None` without the
    /// producer's records, and below two messages.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub producer: Option<ProducerSilence>,
}

/// The longest time between two publications of one channel, or from the last one to the end of the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ProducerSilence {
    /// Start, nanoseconds after the start of the run, or on the producer's clock when that is unknown.
    pub start_ns: i64,
    /// Length, nanoseconds.
    pub length_ns: i64,
    /// Sequence number of the last message before.
    pub after_sequence: u64,
    /// True when nothing came until the end of the run.
    pub is_open: bool,
    /// How far apart publications were at most in nine of ten cases, nanoseconds.
    pub period_p90_ns: i64,
    /// How many times between two publications that rests on.
    pub period_count: u64,
}

impl ProducerSilence {
    /// Of fewer periods nothing is said of how regular a producer is.
    const PERIODS_MIN: u64 = 10;
    /// A silence of more periods is no jitter.
    const PERIODS_LONG: i64 = 10;

    /// True when it is out of all proportion to the time that is usual between publications of the channel.
    pub const fn is_long(&self) -> bool {
        self.period_count >= Self::PERIODS_MIN
            && self.length_ns > self.period_p90_ns.saturating_mul(Self::PERIODS_LONG)
    }
}

/// A time at the consumer in which a message was due: from when the one after the last would have come with the
/// delay of the last, until one came. What its producer was idle is not in it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Gap {
    /// Start, nanoseconds after the start of the run, or on the consumer's clock when that is
    /// unknown.
    pub start_ns: i64,
    /// Length, nanoseconds.
    pub length_ns: i64,
    /// Sequence number of the last message before.
    pub after_sequence: u64,
    /// Index of the interruption it overlaps, if any.
    pub interruption_index: Option<usize>,
}

/// What one interruption cost.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct InterruptionMetrics {
    /// The process that was down.
    pub process: String,
    /// Why, e.g. `killed by signal 9`.
    pub cause: String,
    /// Length, nanoseconds.
    pub length_ns: i64,
    /// Messages lost to it.
    pub lost_count: u64,
    /// The longest silence at the consumer that overlaps it.
    pub gap: Option<Gap>,
}
