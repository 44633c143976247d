//! Draws up the account of a channel from its messages, one by one: fates, segments, silences, and whether
//! the parts add up.

use std::collections::BTreeSet;

use super::fold::{RecordsAtHand, each_history};
use super::gaps::{Bursts, GapFold};
use super::history::{Copies, MessageHistory};
use super::metrics::{ChannelAccount, FateCounts, InterruptionMetrics};
use super::segments::SegmentFold;
use super::{AccountContext, ChannelRecords};
use hil_stats::histogram::{Distribution, LatencyHistogram};

/// Sums messages up to the account of a channel. Memory grows by the few bytes a message that exact
/// quantiles take.
#[derive(Debug)]
pub struct AccountFold<'a> {
    context: &'a AccountContext<'a>,
    at_hand: RecordsAtHand,
    published_count: u64,
    unrecorded_count: u64,
    epochs: BTreeSet<u32>,
    fates: FateCounts,
    copies: Copies,
    bursts: Bursts,
    segments: SegmentFold<'a>,
    gaps: GapFold<'a>,
    /// Messages lost to each interruption.
    lost_counts: Vec<u64>,
}

impl<'a> AccountFold<'a> {
    /// Of no message.
    pub fn new(at_hand: RecordsAtHand, context: &'a AccountContext<'a>) -> Self {
        Self {
            context,
            at_hand,
            published_count: 0,
            unrecorded_count: 0,
            epochs: BTreeSet::new(),
            fates: FateCounts::default(),
            copies: Copies::default(),
            bursts: Bursts::default(),
            segments: SegmentFold::new(at_hand, context),
            gaps: GapFold::new(context),
            lost_counts: vec![0; context.interruptions.len()],
        }
    }

    /// Adds a message; they come in the order in which they settle.
    pub fn add(&mut self, message: &MessageHistory) {
        let count = message.count;
        self.published_count = self.published_count.saturating_add(count);
        if message.published.is_none() {
            self.unrecorded_count = self.unrecorded_count.saturating_add(count);
        }
        self.epochs.insert(message.key.epoch_rank);
        self.fates.add(message.fate, count);
        self.copies.add(&message.copies);
        self.bursts.count(message);
        self.segments.count(message);
        self.gaps.count(message);
        let lost_count = message
            .interruption_index
            .and_then(|index| self.lost_counts.get_mut(index));
        if let Some(lost_count) = lost_count {
            *lost_count = lost_count.saturating_add(count);
        }
    }

    /// The account.
    ///
    /// # Panics
    /// Never for any records; it asserts its own invariant, that the fates sum to the published
    /// count.
    pub fn finish(self) -> ChannelAccount {
        assert_eq!(
            self.fates.total(),
            self.published_count,
            "every published message has exactly one fate"
        );
        let (at_hand, context) = (self.at_hand, self.context);
        let (gaps, gap_of_interruption) = self.gaps.finish(at_hand);
        let costs = self.lost_counts.iter().zip(gap_of_interruption);
        let interruptions = context.interruptions.iter().zip(costs);
        ChannelAccount {
            published_count: self.published_count,
            published_unrecorded_count: at_hand.published.then_some(self.unrecorded_count),
            producer_restart_count: self.epochs.len().saturating_sub(1) as u64,
            fates: self.fates,
            reordered_count: at_hand.ingress.then_some(self.copies.reordered_count),
            duplicated_count: at_hand.ingress.then_some(self.copies.duplicated_count),
            late_count: at_hand.ingress.then_some(self.copies.late_count),
            segments: self.segments.segments(),
            end_to_end: self.segments.end_to_end(),
            closing: self.segments.closing(),
            coverage: self.segments.coverage,
            round_trip: round_trip(context.round_trips_ns),
            loss_bursts: self.bursts.finish(),
            gaps,
            interruptions: interruptions
                .map(|(interruption, (lost_count, gap))| InterruptionMetrics {
                    process: interruption.process.clone(),
                    cause: interruption.cause.clone(),
                    length_ns: interruption.until.ns_since(interruption.from),
                    lost_count: *lost_count,
                    gap,
                })
                .collect(),
        }
    }
}

fn round_trip(round_trips_ns: &[i64]) -> Distribution {
    let mut histogram = LatencyHistogram::default();
    for round_trip_ns in round_trips_ns {
        histogram.record(*round_trip_ns);
    }
    histogram.distribution("no clock exchange took place")
}

/// Draws up the account of one channel from its record files. Time grows with the number of records.
///
/// # Panics
/// As [`AccountFold::finish`].
pub fn account(records: &ChannelRecords<'_>, context: &AccountContext<'_>) -> ChannelAccount {
    let mut fold = AccountFold::new(RecordsAtHand::of(records, context), context);
    each_history(records, context, |message| fold.add(message));
    fold.finish()
}
