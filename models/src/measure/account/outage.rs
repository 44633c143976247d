//! Outages: the times in which a channel delivered nothing of what was published. It finds them
//! in the records of messages, whatever lost these, sorts them by length, and says which of them
//! went before something that happened. What caused an event is not decided here.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use super::fate::Judge;
use super::join::{Join, Joined, stamp};
use super::stage::{MessageFate, Side};
use super::story::published_ns;
use super::{AccountContext, ChannelRecords};
use crate::time::{Instant, duration_ns};

/// How long after its end an outage may still show in what a robot does: a session that it ended
/// takes seconds to come back.
pub const OUTAGE_EFFECT_MAX: Duration = Duration::from_secs(5);

/// Where the classes of [`OutageFigures::classes`] border on each other, milliseconds.
const BORDERS_MS: [i64; 6] = [20, 100, 500, 1_000, 2_000, 5_000];

/// One outage: messages lost in a row, up to the next one that arrived.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Outage {
    /// Messages lost in it. One that was replaced by a newer one before it was sent, or whose
    /// fate is unknown, says nothing about the way: it neither counts nor ends an outage.
    pub lost_count: u64,
    /// Sequence number of the first of them.
    pub first_sequence: u64,
    /// When the first of them was published, on the producer's clock, nanoseconds; `None` when
    /// no record of any of them is at hand.
    pub from_ns: Option<i64>,
    /// When the next message that arrived was published, on the producer's clock; `None` when
    /// none did.
    pub until_ns: Option<i64>,
    /// When the consumer had taken its last message before, on the consumer's clock, or the run's
    /// beginning there; `None` when the consumer's records are not at hand.
    pub silent_from_ns: Option<i64>,
    /// When the consumer took its next message; `None` when it never did.
    pub silent_until_ns: Option<i64>,
    /// Index of the interruption that cost the first of the messages, when it was lost in one.
    pub interruption_index: Option<usize>,
}

impl Outage {
    /// From the first lost publication to the next one that arrived, or to `end` when none did,
    /// nanoseconds; both on the producer's clock.
    pub fn length_ns(&self, end: Option<Instant>) -> Option<i64> {
        let until_ns = self.until_ns.or_else(|| end.map(Instant::as_ns))?;
        Some(until_ns.saturating_sub(self.from_ns?).max(0))
    }

    /// Beginning and end as one side's clock has them.
    const fn span_ns(&self, side: Side) -> (Option<i64>, Option<i64>) {
        match side {
            Side::Producer => (self.from_ns, self.until_ns),
            Side::Consumer => (self.silent_from_ns, self.silent_until_ns),
        }
    }
}

/// Finds outages in messages that are told in the order of their sequence numbers.
#[derive(Debug, Default)]
pub struct OutageFinder {
    found: Vec<Outage>,
    is_open: bool,
    /// From here on, the consumer has taken nothing since.
    silent_index: usize,
    last_taken_ns: Option<i64>,
}

impl OutageFinder {
    /// A finder for a consumer that began at `start` on its clock; `None` when its records are not
    /// at hand.
    pub fn new(start: Option<Instant>) -> Self {
        Self {
            last_taken_ns: start.map(Instant::as_ns),
            ..Self::default()
        }
    }

    /// `count` messages from `sequence` on were lost; the first was published at `published_ns`,
    /// where that is known.
    pub fn lost(&mut self, sequence: u64, count: u64, published_ns: Option<i64>) {
        if !self.is_open {
            self.is_open = true;
            self.found.push(Outage {
                lost_count: 0,
                first_sequence: sequence,
                from_ns: None,
                until_ns: None,
                silent_from_ns: self.last_taken_ns,
                silent_until_ns: None,
                interruption_index: None,
            });
        }
        if let Some(outage) = self.found.last_mut() {
            outage.lost_count = outage.lost_count.saturating_add(count);
            outage.from_ns = outage.from_ns.or(published_ns);
        }
    }

    /// A message that was published at `published_ns` got through; at `taken_ns` the consumer
    /// took it, if it did.
    pub fn arrived(&mut self, published_ns: Option<i64>, taken_ns: Option<i64>) {
        if core::mem::take(&mut self.is_open)
            && let Some(outage) = self.found.last_mut()
        {
            outage.until_ns = published_ns;
        }
        if let Some(taken_ns) = taken_ns {
            for outage in &mut self.found[self.silent_index..] {
                outage.silent_until_ns = Some(taken_ns);
            }
            self.silent_index = self.found.len();
            self.last_taken_ns = self.last_taken_ns.max(Some(taken_ns));
        }
    }

    /// The outages, in order.
    pub fn finish(self) -> Vec<Outage> {
        self.found
    }

    fn see(&mut self, joined: &Joined<'_>, fate: MessageFate, interruption: Option<usize>) {
        let published_ns = published_ns(joined);
        match fate {
            MessageFate::Taken | MessageFate::SupersededAtConsumer => {
                let taken_ns = joined.taken.and_then(|record| stamp(record.taken_ns));
                self.arrived(published_ns, taken_ns);
            }
            fate if fate.is_loss() => {
                let is_first = !self.is_open;
                self.lost(joined.key.sequence, joined.count, published_ns);
                if let Some(outage) = self.found.last_mut().filter(|_| is_first) {
                    outage.interruption_index = interruption;
                }
            }
            _ => {}
        }
    }
}

/// Every outage of a channel, in the order of its messages. Time and memory grow with the number
/// of records.
pub fn outages(records: &ChannelRecords<'_>, context: &AccountContext<'_>) -> Vec<Outage> {
    let records = records.on(context.path);
    let join = Join::new(&records);
    let mut judge = Judge::new(&records, context, &join);
    let start = context.consumer_run.map(|run| run.start);
    let mut finder = OutageFinder::new(start.filter(|_| records.taken.is_some()));
    for joined in join {
        let fate = judge.judge(&joined);
        finder.see(&joined, fate, judge.last_interruption());
    }
    finder.finish()
}

/// The outages of a channel in figures.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct OutageFigures {
    /// How many.
    pub outage_count: u64,
    /// Messages lost in all of them.
    pub lost_count: u64,
    /// Their lengths added up, nanoseconds.
    pub total_ns: i64,
    /// How many of each length, from the shortest class to the longest.
    pub classes: Vec<OutageClass>,
    /// Those whose length is unknown: no record tells when they began, or when the run ended.
    pub unknown_length_count: u64,
    /// The longest.
    pub longest: Option<LongestOutage>,
}

/// Outages of about one length.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct OutageClass {
    /// Shortest length that belongs here, nanoseconds.
    pub from_ns: i64,
    /// Shortest length that does not belong here any more; `None` for the last class.
    pub until_ns: Option<i64>,
    /// Outages.
    pub outage_count: u64,
    /// Messages lost in them.
    pub lost_count: u64,
}

/// The longest outage of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct LongestOutage {
    /// Publication of its first lost message, nanoseconds after the start of the run, or on the
    /// producer's clock when that start is unknown.
    pub start_ns: i64,
    /// Length, nanoseconds.
    pub length_ns: i64,
    /// Messages lost in it.
    pub lost_count: u64,
    /// Sequence number of the first of them.
    pub first_sequence: u64,
    /// True when it lasted to the end of the run.
    pub is_open: bool,
}

impl OutageFigures {
    /// The figures of `outages`; `start` and `end` of the run are on the producer's clock.
    pub fn of(outages: &[Outage], start: Option<Instant>, end: Option<Instant>) -> Self {
        let mut figures = Self {
            outage_count: outages.len() as u64,
            lost_count: 0,
            total_ns: 0,
            classes: empty_classes(),
            unknown_length_count: 0,
            longest: None,
        };
        for outage in outages {
            figures.lost_count = figures.lost_count.saturating_add(outage.lost_count);
            let known = outage.from_ns.zip(outage.length_ns(end));
            let Some((from_ns, length_ns)) = known else {
                figures.unknown_length_count += 1;
                continue;
            };
            figures.total_ns = figures.total_ns.saturating_add(length_ns);
            let mut classes = figures.classes.iter_mut().rev();
            if let Some(class) = classes.find(|class| class.from_ns <= length_ns) {
                class.outage_count += 1;
                class.lost_count = class.lost_count.saturating_add(outage.lost_count);
            }
            let is_longest = figures.longest.is_none_or(|one| one.length_ns < length_ns);
            if is_longest {
                figures.longest = Some(LongestOutage {
                    start_ns: from_ns.saturating_sub(start.map_or(0, Instant::as_ns)),
                    length_ns,
                    lost_count: outage.lost_count,
                    first_sequence: outage.first_sequence,
                    is_open: outage.until_ns.is_none(),
                });
            }
        }
        figures
    }
}

fn empty_classes() -> Vec<OutageClass> {
    let borders_ns = BORDERS_MS.map(|border_ms| border_ms * 1_000_000);
    let begins = core::iter::once(0).chain(borders_ns);
    let ends = borders_ns.into_iter().map(Some).chain([None]);
    let class = |(from_ns, until_ns)| OutageClass {
        from_ns,
        until_ns,
        outage_count: 0,
        lost_count: 0,
    };
    begins.zip(ends).map(class).collect()
}

/// What a channel went through before something happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Foregoing {
    /// The outage that had lasted longest by then.
    pub outage: Outage,
    /// Outages beside it that had lasted less.
    pub shorter_count: u64,
    /// True when it was not over yet.
    pub is_under_way: bool,
    /// From its end to the event, nanoseconds; 0 when it was not over yet.
    pub since_end_ns: i64,
}

/// Of `outages`, what was under way at `at` or had ended at most [`OUTAGE_EFFECT_MAX`] before;
/// `at` is on the clock of `side`'s host. What came after an event cannot have led to it, so an
/// outage counts with what had passed of it by then.
pub fn foregoing(outages: &[Outage], at: Instant, side: Side) -> Option<Foregoing> {
    let at_ns = at.as_ns();
    let earliest_ns = at_ns.saturating_sub(duration_ns(OUTAGE_EFFECT_MAX));
    let mut candidates = 0_u64;
    let mut longest: Option<(i64, Foregoing)> = None;
    for outage in outages {
        let (Some(from_ns), until_ns) = outage.span_ns(side) else {
            continue;
        };
        let until_ns = until_ns.unwrap_or(i64::MAX);
        if from_ns > at_ns || until_ns < earliest_ns {
            continue;
        }
        candidates += 1;
        let passed_ns = until_ns.min(at_ns).saturating_sub(from_ns);
        if longest.is_none_or(|(length_ns, _)| length_ns < passed_ns) {
            let foregoing = Foregoing {
                outage: *outage,
                shorter_count: 0,
                is_under_way: until_ns > at_ns,
                since_end_ns: at_ns.saturating_sub(until_ns).max(0),
            };
            longest = Some((passed_ns, foregoing));
        }
    }
    let (_, found) = longest?;
    Some(Foregoing {
        shorter_count: candidates - 1,
        ..found
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measure::account::synthetic::{Files, PERIOD_NS, TAKEN_NS, at, same_clock};
    use crate::measure::account::{ChannelPath, Interruption, PathProcess, account};
    use MessageFate as Fate;

    /// One message per millisecond; `fate` says what becomes of each.
    fn files(count: u64, fate: impl Fn(u64) -> Fate) -> Files {
        let mut files = Files::default();
        for sequence in 0..count {
            files.write(at(7, sequence), fate(sequence));
        }
        files
    }

    fn burst(outage: &Outage) -> (u64, u64, Option<i64>, Option<i64>) {
        let ms = |ns: i64| ns / PERIOD_NS;
        let Outage {
            first_sequence,
            lost_count,
            ..
        } = *outage;
        let ends = (outage.from_ns.map(ms), outage.until_ns.map(ms));
        (first_sequence, lost_count, ends.0, ends.1)
    }

    #[test]
    fn an_outage_lasts_from_the_first_lost_to_the_next_delivered_publication() {
        let files = files(1_000, |sequence| match sequence {
            100..=149 | 300 => Fate::LostOnWire,
            // Replaced before it was sent: no word on the way, so the outage goes on.
            500 | 502 => Fate::LostOnWire,
            501 => Fate::SupersededAtInput,
            // Not taken, but it got through.
            700 | 702 => Fate::Late,
            701 => Fate::SupersededAtConsumer,
            _ => Fate::Taken,
        });
        let context = same_clock(1_000 * PERIOD_NS);
        let found = outages(&files.records(), &context);
        let bursts: Vec<_> = found.iter().map(burst).collect();
        assert_eq!(
            bursts,
            [
                (100, 50, Some(100), Some(150)),
                (300, 1, Some(300), Some(301)),
                (500, 2, Some(500), Some(503)),
                (700, 1, Some(700), Some(701)),
                (702, 1, Some(702), Some(703)),
            ]
        );
        assert_eq!(found[0].silent_from_ns, Some(99 * PERIOD_NS + TAKEN_NS));
        assert_eq!(found[0].silent_until_ns, Some(150 * PERIOD_NS + TAKEN_NS));
        // What got through but was not taken leaves the consumer in silence.
        for outage in &found[3..] {
            assert_eq!(outage.silent_from_ns, Some(699 * PERIOD_NS + TAKEN_NS));
            assert_eq!(outage.silent_until_ns, Some(703 * PERIOD_NS + TAKEN_NS));
        }
        let total = found.iter().map(|outage| outage.lost_count).sum::<u64>();
        let fates = account(&files.records(), &context).fates;
        assert_eq!(total, fates.lost_count());
    }

    #[test]
    fn an_outage_at_the_end_lasts_as_long_as_the_run() {
        let files = files(400, |sequence| match sequence {
            100.. => Fate::LostOnWire,
            _ => Fate::Taken,
        });
        let context = same_clock(500 * PERIOD_NS);
        let end = context.producer_run.map(|run| run.end);
        let found = outages(&files.records(), &context);
        assert_eq!(burst(&found[0]), (100, 300, Some(100), None));
        assert_eq!(found[0].silent_until_ns, None);
        assert_eq!(found[0].length_ns(end), Some(400 * PERIOD_NS));
        assert_eq!(found[0].length_ns(None), None);
        let figures = OutageFigures::of(&found, None, end);
        assert!(figures.longest.unwrap().is_open);
        assert_eq!(
            OutageFigures::of(&found, None, None).unknown_length_count,
            1
        );
    }

    #[test]
    fn outages_are_sorted_by_length_and_their_borders_belong_to_the_longer_class() {
        let outage = |from_ms: i64, length_ms: i64| Outage {
            lost_count: 2,
            first_sequence: 0,
            from_ns: Some(from_ms * PERIOD_NS),
            until_ns: Some((from_ms + length_ms) * PERIOD_NS),
            silent_from_ns: None,
            silent_until_ns: None,
            interruption_index: None,
        };
        let lengths_ms = [
            8, 19, 20, 99, 100, 499, 500, 999, 1_000, 1_999, 2_000, 5_000,
        ];
        let found: Vec<_> = lengths_ms.map(|ms| outage(10_000, ms)).to_vec();
        let start = Instant::from_ns(4_000 * PERIOD_NS);
        let figures = OutageFigures::of(&found, Some(start), None);
        let counts: Vec<_> = figures.classes.iter().map(|one| one.outage_count).collect();
        assert_eq!(counts, [2, 2, 2, 2, 2, 1, 1]);
        assert_eq!((figures.outage_count, figures.lost_count), (12, 24));
        assert_eq!(figures.total_ns, lengths_ms.iter().sum::<i64>() * PERIOD_NS);
        assert_eq!(figures.classes[6].until_ns, None);
        for pair in figures.classes.windows(2) {
            assert_eq!(pair[0].until_ns, Some(pair[1].from_ns));
        }
        let longest = figures.longest.unwrap();
        assert_eq!(longest.start_ns, 6_000 * PERIOD_NS);
        assert_eq!(longest.length_ns, 5_000 * PERIOD_NS);
        assert_eq!(OutageFigures::of(&[], None, None).longest, None);
    }

    #[test]
    fn an_event_finds_the_outage_that_had_lasted_longest_by_then() {
        let lost = |sequence: u64| matches!(sequence, 1_000..=1_009 | 2_000..=2_999 | 3_500..=3_599 | 9_000..=9_999);
        let files = files(20_000, |sequence| {
            if lost(sequence) {
                Fate::LostOnWire
            } else {
                Fate::Taken
            }
        });
        let found = outages(&files.records(), &same_clock(20_000 * PERIOD_NS));
        let before = |ms: i64, side| {
            let found = foregoing(&found, Instant::from_ns(ms * PERIOD_NS), side)?;
            let Outage { first_sequence, .. } = found.outage;
            Some((first_sequence, found.shorter_count, found.is_under_way))
        };
        for side in [Side::Producer, Side::Consumer] {
            assert_eq!(before(900, side), None);
            assert_eq!(before(1_005, side), Some((1_000, 0, true)));
            // It has only just begun: what came before weighs more.
            assert_eq!(before(2_003, side), Some((1_000, 1, false)));
            assert_eq!(before(2_500, side), Some((2_000, 1, true)));
            assert_eq!(before(5_000, side), Some((2_000, 2, false)));
            assert_eq!(before(8_500, side), Some((3_500, 0, false)));
            assert_eq!(before(8_900, side), None);
            assert_eq!(before(15_100, side), None);
        }
        let at = Instant::from_ns(10_400 * PERIOD_NS);
        let ended = foregoing(&found, at, Side::Producer).unwrap();
        assert_eq!(ended.since_end_ns, 400 * PERIOD_NS);
    }

    #[test]
    fn unaligned_clocks_leave_each_side_its_own_times() {
        let mut files = files(300, |sequence| match sequence {
            100..=199 => Fate::LostOnWire,
            _ => Fate::Taken,
        });
        let ahead_ns = 7_000_000_000_000;
        for record in &mut files.taken {
            record.taken_ns += ahead_ns;
        }
        let context = AccountContext::new(ChannelPath::Gateway { alignment: None });
        let found = outages(&files.records(), &context);
        assert_eq!(burst(&found[0]), (100, 100, Some(100), Some(200)));
        let here = Instant::from_ns(150 * PERIOD_NS + ahead_ns);
        assert!(foregoing(&found, here, Side::Consumer).is_some());
        assert!(foregoing(&found, here, Side::Producer).is_none());
        let mut records = files.records();
        records.taken = None;
        let unseen = outages(&records, &context);
        assert!(unseen.iter().all(|outage| outage.silent_from_ns.is_none()));
    }

    #[test]
    fn an_outage_that_an_interruption_caused_names_it() {
        let files = files(300, |sequence| match sequence {
            100..=199 => Fate::LostOnWire,
            _ => Fate::Taken,
        });
        let interruptions = [Interruption {
            process: "gateway".to_owned(),
            place: PathProcess::ReceivingGateway,
            from: Instant::from_ns(100 * PERIOD_NS),
            until: Instant::from_ns(200 * PERIOD_NS),
            cause: "killed by signal 9".to_owned(),
        }];
        let context = same_clock(300 * PERIOD_NS).with_interruptions(&interruptions);
        let found = outages(&files.records(), &context);
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].interruption_index, Some(0));
    }
}
