//! Losses in a row, and silences at the consumer with what caused them. It does not judge single
//! messages: see [`super::fate`].

use std::collections::BTreeMap;

use super::join::Key;
use super::metrics::{BurstCount, Gap, Gaps};
use super::stage::{MessageFate, Side};
use super::{AccountContext, ChannelRecords, Interruption, each};
use hil_core::record::stamp;
use hil_stats::histogram::LatencyHistogram;
use hil_stats::in_order::in_order;

/// Counts runs of successive losses; anything else, and a restart of the producer, ends a run.
#[derive(Debug, Default)]
pub(super) struct Bursts {
    length: u64,
    epoch_rank: u32,
    counts: BTreeMap<u64, u64>,
}

impl Bursts {
    pub(super) fn count(&mut self, key: Key, fate: MessageFate, count: u64) {
        if !fate.is_loss() || key.epoch_rank != self.epoch_rank {
            self.end();
            self.epoch_rank = key.epoch_rank;
        }
        if fate.is_loss() {
            self.length = self.length.saturating_add(count);
        }
    }

    fn end(&mut self) {
        if self.length > 0 {
            *self.counts.entry(self.length).or_insert(0) += 1;
            self.length = 0;
        }
    }

    pub(super) fn finish(mut self) -> Vec<BurstCount> {
        self.end();
        let counts = self.counts.into_iter();
        counts
            .map(|(length_messages, count)| BurstCount {
                length_messages,
                count,
            })
            .collect()
    }
}

/// One taken message, on both clocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct TakenAt {
    taken_ns: i64,
    published_ns: i64,
    sequence: u64,
}

/// The silences between taken messages, and for each interruption the longest it overlaps.
pub(super) fn gaps(
    records: &ChannelRecords<'_>,
    context: &AccountContext<'_>,
) -> (Gaps, Vec<Option<Gap>>) {
    let run = context.consumer_run;
    let start_ns = run.map_or(0, |run| run.start.as_ns());
    let read = || {
        each(records.taken).filter_map(|record| {
            let at = TakenAt {
                taken_ns: stamp(record.taken_ns)?,
                published_ns: record.published_ns,
                sequence: record.sequence,
            };
            Some((at, ()))
        })
    };
    let mut histogram = LatencyHistogram::default();
    let (mut longest, mut longest_unattributed) = (None, None);
    let mut of_interruption = vec![None; context.interruptions.len()];
    let mut last: Option<TakenAt> = None;
    for (after, ()) in in_order(read) {
        let Some(before) = last.replace(after) else {
            continue;
        };
        let length_ns = after.taken_ns.saturating_sub(before.taken_ns);
        histogram.record(length_ns);
        let mut gap = Gap {
            start_ns: before.taken_ns.saturating_sub(start_ns),
            length_ns,
            after_sequence: before.sequence,
            interruption_index: None,
        };
        for (index, interruption) in context.interruptions.iter().enumerate() {
            if overlaps(interruption, before, after) {
                gap.interruption_index = gap.interruption_index.or(Some(index));
                keep_longer(&mut of_interruption[index], gap);
            }
        }
        keep_longer(&mut longest, gap);
        if gap.interruption_index.is_none() {
            keep_longer(&mut longest_unattributed, gap);
        }
    }
    let tail_ns = |last: TakenAt| Some(run?.end.as_ns().saturating_sub(last.taken_ns));
    let reason = if records.taken.is_some() {
        "fewer than two messages were taken"
    } else {
        "the consumer's records are not at hand"
    };
    let gaps = Gaps {
        between_taken: histogram.distribution(reason),
        longest,
        longest_unattributed,
        last_taken_to_run_end_ns: last.and_then(tail_ns),
    };
    (gaps, of_interruption)
}

/// Compares on the clock of the interrupted process's host; the publication times of the two
/// messages stand for the silence there, so no alignment is needed.
fn overlaps(interruption: &Interruption, before: TakenAt, after: TakenAt) -> bool {
    let (start_ns, end_ns) = match interruption.place.side() {
        Side::Consumer => (before.taken_ns, after.taken_ns),
        Side::Producer => (
            before.published_ns.min(after.published_ns),
            before.published_ns.max(after.published_ns),
        ),
    };
    start_ns <= interruption.until.as_ns() && interruption.from.as_ns() <= end_ns
}

fn keep_longer(longest: &mut Option<Gap>, gap: Gap) {
    if longest.is_none_or(|known| known.length_ns < gap.length_ns) {
        *longest = Some(gap);
    }
}
