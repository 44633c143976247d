//! Losses in a row, silences at the consumer with what caused them, and those of the producer. It does not judge single
//! messages: see [`super::fate`].

use core::cmp::Reverse;
use std::collections::BinaryHeap;

use super::fold::RecordsAtHand;
use super::history::MessageHistory;
use super::metrics::{BurstCount, BurstLengths, Gap, Gaps, ProducerSilence};
use super::stage::Side;
use super::{AccountContext, Interruption, RunSpan};
use hil_core::record::stamp;
use hil_stats::histogram::LatencyHistogram;

/// Counts runs of successive losses; anything else, and a restart of the producer, ends a run.
#[derive(Debug, Default)]
pub(super) struct Bursts {
    length: u64,
    epoch_rank: u32,
    lengths: BurstLengths,
}

impl Bursts {
    pub(super) fn count(&mut self, message: &MessageHistory) {
        let is_loss = message.fate.is_loss();
        if !is_loss || message.key.epoch_rank != self.epoch_rank {
            self.end();
            self.epoch_rank = message.key.epoch_rank;
        }
        if is_loss {
            self.length = self.length.saturating_add(message.count);
        }
    }

    fn end(&mut self) {
        self.lengths.add(core::mem::take(&mut self.length));
    }

    pub(super) fn finish(mut self) -> Vec<BurstCount> {
        self.end();
        self.lengths.finish()
    }
}

/// Messages that are held until those taken before them have come: they come in the order of their
/// numbers. A second of messages at 2 kHz.
const WINDOW: usize = 2_048;

/// One taken message, on both clocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct TakenAt {
    taken_ns: i64,
    published_ns: i64,
    sequence: u64,
    /// When the next message of the same start was published, whatever became of it; `None` where that is unknown.
    next_published_ns: Option<i64>,
}

/// A publication that the producer recorded.
#[derive(Debug, Clone, Copy)]
struct PublishedAt {
    published_ns: i64,
    sequence: u64,
}

/// Finds the longest time in which the producer published nothing.
#[derive(Debug, Default)]
struct ProducerFold {
    /// The newest message; `None` where its record is missing.
    last: Option<PublishedAt>,
    periods: LatencyHistogram,
    /// The longest period and the publication before it.
    longest: Option<(i64, PublishedAt)>,
}

impl ProducerFold {
    fn count(&mut self, message: &MessageHistory) {
        let published_ns = message.published.and_then(|one| stamp(one.published_ns));
        // While records are missing it may have published anything.
        let now = published_ns.map(|published_ns| PublishedAt {
            published_ns,
            sequence: message.key.sequence,
        });
        if let (Some(before), Some(now)) = (self.last, now) {
            let period_ns = now.published_ns.saturating_sub(before.published_ns);
            self.periods.record(period_ns);
            if self
                .longest
                .is_none_or(|(known_ns, _)| known_ns < period_ns)
            {
                self.longest = Some((period_ns, before));
            }
        }
        self.last = now;
    }

    fn finish(self, run: Option<RunSpan>) -> Option<ProducerSilence> {
        let period_p90_ns = self.periods.quantile(0.9)?;
        let longest = self.longest?;
        let tail = self.last.zip(run).map(|(last, run)| {
            let tail_ns = run.end.as_ns().saturating_sub(last.published_ns);
            (tail_ns, last)
        });
        let tail = tail.filter(|(tail_ns, _)| *tail_ns > longest.0);
        let (length_ns, after) = tail.unwrap_or(longest);
        let start_ns = run.map_or(0, |run| run.start.as_ns());
        Some(ProducerSilence {
            start_ns: after.published_ns.saturating_sub(start_ns),
            length_ns,
            after_sequence: after.sequence,
            is_open: tail.is_some(),
            period_p90_ns,
            period_count: self.periods.count(),
        })
    }
}

/// Collects the silences between taken messages, and for each interruption the longest it overlaps.
#[derive(Debug)]
pub(super) struct GapFold<'a> {
    interruptions: &'a [Interruption],
    run: Option<RunSpan>,
    producer_run: Option<RunSpan>,
    producer: ProducerFold,
    /// The newest one and the rank of its start, until the message after it is seen.
    held: Option<(u32, TakenAt)>,
    /// The taken message with the highest number, and when the one after it was published.
    newest: Option<TakenAt>,
    window: BinaryHeap<Reverse<TakenAt>>,
    last: Option<TakenAt>,
    histogram: LatencyHistogram,
    longest: Option<Gap>,
    longest_unattributed: Option<Gap>,
    of_interruption: Vec<Option<Gap>>,
}

impl<'a> GapFold<'a> {
    pub(super) fn new(context: &AccountContext<'a>) -> Self {
        Self {
            interruptions: context.interruptions,
            run: context.consumer_run,
            producer_run: context.producer_run,
            producer: ProducerFold::default(),
            held: None,
            newest: None,
            window: BinaryHeap::new(),
            last: None,
            histogram: LatencyHistogram::default(),
            longest: None,
            longest_unattributed: None,
            of_interruption: vec![None; context.interruptions.len()],
        }
    }

    pub(super) fn count(&mut self, message: &MessageHistory) {
        self.producer.count(message);
        let epoch_rank = message.key.epoch_rank;
        if let Some((held_rank, mut held)) = self.held.take() {
            held.next_published_ns = message.published_ns().filter(|_| held_rank == epoch_rank);
            self.window.push(Reverse(held));
        }
        let taken = message.taken.and_then(|record| {
            Some(TakenAt {
                taken_ns: stamp(record.taken_ns)?,
                published_ns: record.published_ns,
                sequence: record.sequence,
                next_published_ns: None,
            })
        });
        self.held = taken.map(|taken| (epoch_rank, taken));
        if taken.is_some() {
            self.newest = taken;
        } else if let Some(newest) = &mut self.newest {
            newest.next_published_ns = newest.next_published_ns.or(message.published_ns());
        }
        if self.window.len() > WINDOW {
            self.close_next();
        }
    }

    /// The silence before the earliest of those held; false without any.
    fn close_next(&mut self) -> bool {
        let Some(Reverse(after)) = self.window.pop() else {
            return false;
        };
        let Some(before) = self.last.replace(after) else {
            return true;
        };
        let length_ns = after.taken_ns.saturating_sub(before.taken_ns);
        self.histogram.record(length_ns);
        self.close(before, after);
        true
    }

    /// Takes the silence between two messages for what it is.
    fn close(&mut self, before: TakenAt, after: TakenAt) {
        let start_ns = self.run.map_or(0, |run| run.start.as_ns());
        let next_ns = before.next_published_ns.unwrap_or(before.published_ns);
        let idle_ns = next_ns.saturating_sub(before.published_ns).max(0);
        let due_ns = before.taken_ns.saturating_add(idle_ns);
        let mut gap = Gap {
            start_ns: due_ns.saturating_sub(start_ns),
            length_ns: after.taken_ns.saturating_sub(due_ns).max(0),
            after_sequence: before.sequence,
            interruption_index: None,
        };
        for (index, interruption) in self.interruptions.iter().enumerate() {
            if overlaps(interruption, before, after) {
                gap.interruption_index = gap.interruption_index.or(Some(index));
                keep_longer(&mut self.of_interruption[index], gap);
            }
        }
        keep_longer(&mut self.longest, gap);
        if gap.interruption_index.is_none() {
            keep_longer(&mut self.longest_unattributed, gap);
        }
    }

    /// The silence that lasts to the end of the run, if a message was due in it.
    fn close_last(&mut self) {
        let newest = self.newest.filter(|one| one.next_published_ns.is_some());
        let (Some(newest), Some(run)) = (newest, self.run) else {
            return;
        };
        let tail_ns = run.end.as_ns().saturating_sub(newest.taken_ns);
        if tail_ns > 0 {
            let end = TakenAt {
                taken_ns: run.end.as_ns(),
                published_ns: newest.published_ns.saturating_add(tail_ns),
                ..newest
            };
            self.close(newest, end);
        }
    }

    /// The silences, and by interruption the longest it overlaps.
    pub(super) fn finish(mut self, at_hand: RecordsAtHand) -> (Gaps, Vec<Option<Gap>>) {
        self.window
            .extend(self.held.take().map(|(_, held)| Reverse(held)));
        while self.close_next() {}
        self.close_last();
        let run = self.run;
        let tail_ns = |last: TakenAt| Some(run?.end.as_ns().saturating_sub(last.taken_ns));
        let reason = if at_hand.taken {
            "fewer than two messages were taken"
        } else {
            "the consumer's records are not at hand"
        };
        let gaps = Gaps {
            between_taken: self.histogram.distribution(reason),
            longest: self.longest,
            longest_unattributed: self.longest_unattributed,
            last_taken_to_run_end_ns: self.last.and_then(tail_ns),
            producer: self.producer.finish(self.producer_run),
        };
        (gaps, self.of_interruption)
    }
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

#[cfg(test)]
mod tests {
    use crate::account;
    use crate::stage::MessageFate;
    use crate::synthetic::{Files, PERIOD_NS, TAKEN_NS, at, same_clock};

    /// Of a run of a second: `taken_count` messages come, the last two in the other order, then `lost_count` get lost.
    fn longest_ns(taken_count: u64, lost_count: u64) -> Option<i64> {
        let mut files = Files::default();
        for sequence in 0..taken_count {
            files.write(at(0, sequence), MessageFate::Taken);
        }
        if let [.., before, last] = files.taken.as_mut_slice() {
            core::mem::swap(&mut before.taken_ns, &mut last.taken_ns);
        }
        for sequence in taken_count..taken_count + lost_count {
            files.write(at(0, sequence), MessageFate::LostOnWire);
        }
        let account = account(&files.records(), &same_clock(1_000_000_000));
        account.gaps.longest.map(|gap| gap.length_ns)
    }

    #[test]
    fn an_outage_that_lasts_to_the_end_is_the_longest_silence() {
        // Message 10 was due a period after the ninth was taken, which overtook the eighth; nobody waits for what was not sent.
        let due_ns = 9 * PERIOD_NS + TAKEN_NS;
        assert_eq!(longest_ns(10, 5), Some(1_000_000_000 - due_ns));
        assert!(longest_ns(10, 0).is_some_and(|ns| ns <= PERIOD_NS));
        assert_eq!(longest_ns(1, 1), Some(1_000_000_000 - PERIOD_NS - TAKEN_NS));
        assert_eq!(longest_ns(0, 5), None);
    }
}
