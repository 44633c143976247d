//! A recorded trace as a link: each message meets what a message of the trace met. It draws no
//! random number and reads no file; see [`crate::trace`] for what a trace is.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use core::time::Duration;
use serde::{Deserialize, Serialize};

use crate::link::trace_ticks::Ticks;
use crate::link::{Fate, LinkModel};
use crate::time::Instant;
use crate::trace::{Trace, TraceFate, TraceRecord};

/// Which record a message meets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TraceMatch {
    /// The n-th message of the channel meets the n-th record: equal departures have equal counts.
    #[default]
    Index,
    /// The record published last at that time of the run, before the first record the first.
    Time,
    /// The record of the same tick: as many periods after the first message of its channel as the
    /// record is after the first of the trace. What nobody published live is lost, so the other end
    /// hears at each tick what it heard live. A trace without a period, or of a producer that was
    /// started anew, is matched by index instead, and the counts say so.
    Tick,
}

/// What a message meets that comes after the end of the trace.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TraceEnd {
    /// The trace from its beginning.
    #[default]
    Wrap,
    /// A link that delivers at once.
    Perfect,
    /// A link that delivers nothing.
    Lost,
}

/// How a trace is replayed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TraceReplay {
    /// Which record a message meets.
    pub matching: TraceMatch,
    /// What comes after the last one.
    pub end: TraceEnd,
    /// Delay of a delivered message whose delay the trace does not know.
    pub delay_otherwise: Option<Duration>,
}

/// Why a trace cannot be replayed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ReplayError {
    /// It has no record.
    #[error("the trace has no record")]
    Empty,
    /// Its delays are unknown, and nothing is said instead.
    #[error(
        "record {index} was delivered after an unknown delay ({clock}); say what stands for it: delay"
    )]
    DelayUnknown {
        /// The first such record.
        index: usize,
        /// What the trace says of its clocks.
        clock: String,
    },
}

/// What a replay met so far. Read it while the link works, or after.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ReplayCounts {
    /// How records were matched in the end.
    pub matching: TraceMatch,
    /// Records of the trace.
    pub record_count: u64,
    /// Messages offered.
    pub offered_count: u64,
    /// Of these, within the trace.
    pub met_count: u64,
    /// Of those within it, delivered.
    pub delivered_count: u64,
    /// Of those within it, lost, wherever the trace's were.
    pub lost_count: u64,
    /// Of those within it, lost here because nobody knows what became of the trace's.
    pub unknown_count: u64,
    /// Lost because the trace has no record at their tick: nobody published live.
    pub unpublished_count: u64,
    /// Messages at a tick that had its message already; they met the same record again.
    pub repeated_count: u64,
    /// After the end of the trace.
    pub beyond_end_count: u64,
    /// Delivered at once because the trace's delay is below zero, which clocks within their bound
    /// allow.
    pub negative_delay_count: u64,
}

#[derive(Debug, Default)]
struct Cells {
    delivered: AtomicU64,
    lost: AtomicU64,
    unknown: AtomicU64,
    unpublished: AtomicU64,
    repeated: AtomicU64,
    beyond_end: AtomicU64,
    negative_delay: AtomicU64,
}

/// The counts of a [`TraceLink`] that somebody else owns.
#[derive(Debug, Clone)]
pub struct ReplayTally {
    cells: Arc<Cells>,
    record_count: u64,
    matching: TraceMatch,
}

impl ReplayTally {
    /// What the link met so far.
    pub fn counts(&self) -> ReplayCounts {
        let of = |cell: &AtomicU64| cell.load(Ordering::Relaxed);
        let delivered_count = of(&self.cells.delivered);
        let lost_count = of(&self.cells.lost);
        let unknown_count = of(&self.cells.unknown);
        let beyond_end_count = of(&self.cells.beyond_end);
        let unpublished_count = of(&self.cells.unpublished);
        let repeated_count = of(&self.cells.repeated);
        let met_count = delivered_count + lost_count + unknown_count;
        let apart_count = unpublished_count + repeated_count + beyond_end_count;
        ReplayCounts {
            matching: self.matching,
            record_count: self.record_count,
            offered_count: met_count + apart_count,
            met_count,
            delivered_count,
            lost_count,
            unknown_count,
            unpublished_count,
            repeated_count,
            beyond_end_count,
            negative_delay_count: of(&self.cells.negative_delay),
        }
    }
}

/// The link.
#[derive(Debug)]
pub struct TraceLink {
    trace: Arc<Trace>,
    replay: TraceReplay,
    /// Length of one round through the trace, above zero.
    span_ns: i64,
    next_number: u64,
    /// Where records are matched by ticks.
    ticks: Option<Ticks>,
    /// The first message offered, and the tick of the last.
    first_offer: Option<Instant>,
    last_tick: Option<usize>,
    cells: Arc<Cells>,
}

impl TraceLink {
    /// A link that replays `trace`.
    ///
    /// # Errors
    /// [`ReplayError`].
    pub fn new(trace: Arc<Trace>, mut replay: TraceReplay) -> Result<Self, ReplayError> {
        let Some(last) = trace.records.last() else {
            return Err(ReplayError::Empty);
        };
        let mut records = trace.records.iter();
        let unknown =
            |record: &TraceRecord| record.fate == TraceFate::Delivered && record.delay().is_none();
        if replay.delay_otherwise.is_none()
            && let Some(index) = records.position(unknown)
        {
            let clock = trace.header.clock.clone();
            return Err(ReplayError::DelayUnknown { index, clock });
        }
        let after_last_ns = last
            .published_ns
            .saturating_add(trace.period_ns().unwrap_or(0));
        let span_ns = after_last_ns.max(trace.header.duration_ns).max(1);
        let period_ns = trace.period_ns().unwrap_or(0);
        let ticks = match replay.matching {
            TraceMatch::Index | TraceMatch::Time => None,
            TraceMatch::Tick => Ticks::of(&trace.records, period_ns),
        };
        if replay.matching == TraceMatch::Tick && ticks.is_none() {
            replay.matching = TraceMatch::Index;
        }
        Ok(Self {
            trace,
            replay,
            span_ns,
            next_number: 0,
            ticks,
            first_offer: None,
            last_tick: None,
            cells: Arc::default(),
        })
    }

    /// Its counts, for whoever gives the link away.
    pub fn tally(&self) -> ReplayTally {
        ReplayTally {
            cells: Arc::clone(&self.cells),
            record_count: self.trace.records.len() as u64,
            matching: self.replay.matching,
        }
    }

    /// The longest delay it can add.
    pub fn delay_max(&self) -> Duration {
        let delays = self.trace.records.iter();
        let delays = delays.flat_map(|record| [record.delay_ns, record.second_delay_ns]);
        let longest_ns = delays.max().unwrap_or(0).max(0);
        let longest = Duration::from_nanos(longest_ns.unsigned_abs());
        longest.max(self.replay.delay_otherwise.unwrap_or_default())
    }

    /// As [`LinkModel::offer`], for the message `number` of its channel, counted from 0 over all
    /// starts of its producer.
    pub fn offer_number(&mut self, now: Instant, number: u64) -> Fate {
        self.next_number = number.saturating_add(1);
        let place = match self.replay.matching {
            TraceMatch::Index => self.by_index(number),
            TraceMatch::Time => self.by_time(now),
            TraceMatch::Tick => match self.by_tick(now) {
                Ok(place) => place,
                Err(fate) => return fate,
            },
        };
        let Some((record, is_beyond)) = place else {
            add(&self.cells.beyond_end);
            return match self.replay.end {
                TraceEnd::Lost => Fate::Lost,
                TraceEnd::Perfect | TraceEnd::Wrap => Fate::Delivered(now),
            };
        };
        let fate = self.fate(&record, now);
        add(match record.fate {
            _ if is_beyond => &self.cells.beyond_end,
            TraceFate::Delivered => &self.cells.delivered,
            TraceFate::Unknown => &self.cells.unknown,
            _ => &self.cells.lost,
        });
        fate
    }

    /// The record, and whether it stands for one after the end; `None` after the end.
    fn by_index(&self, number: u64) -> Option<(TraceRecord, bool)> {
        let records = &self.trace.records;
        let count = records.len() as u64;
        let is_beyond = number >= count;
        if is_beyond && self.replay.end != TraceEnd::Wrap {
            return None;
        }
        let index = usize::try_from(number % count).expect("an index of a vector");
        Some((records[index], is_beyond))
    }

    fn by_time(&self, now: Instant) -> Option<(TraceRecord, bool)> {
        let is_beyond = now.as_ns() >= self.span_ns;
        if is_beyond && self.replay.end != TraceEnd::Wrap {
            return None;
        }
        let at_ns = now.as_ns().rem_euclid(self.span_ns);
        let records = &self.trace.records;
        let after = records.partition_point(|record| record.published_ns <= at_ns);
        Some((records[after.saturating_sub(1)], is_beyond))
    }

    /// As the others, or the fate of a message that meets no record of its own.
    fn by_tick(&mut self, now: Instant) -> Result<Option<(TraceRecord, bool)>, Fate> {
        let first = *self.first_offer.get_or_insert(now);
        let ticks = self.ticks.as_ref().expect("matching by ticks has them");
        let offered = ticks.at(now.ns_since(first));
        let is_beyond = offered >= ticks.count();
        if is_beyond && self.replay.end != TraceEnd::Wrap {
            return Ok(None);
        }
        let place = ticks.record_of(offered % ticks.count());
        let is_repeated = self.last_tick.replace(offered) == Some(offered);
        let Some(place) = place else {
            add(&self.cells.unpublished);
            return Err(Fate::Lost);
        };
        let record = self.trace.records[place];
        if is_repeated && !is_beyond {
            add(&self.cells.repeated);
            return Err(self.fate(&record, now));
        }
        Ok(Some((record, is_beyond)))
    }

    fn fate(&self, record: &TraceRecord, now: Instant) -> Fate {
        if record.fate != TraceFate::Delivered {
            return Fate::Lost;
        }
        let otherwise = self.replay.delay_otherwise.unwrap_or_default();
        let first = match record.delay() {
            Some(delay_ns) => now + self.duration(delay_ns),
            None => now + otherwise,
        };
        match record.second_delay() {
            None => Fate::Delivered(first),
            Some(delay_ns) => {
                let second = now + self.duration(delay_ns);
                Fate::Duplicated {
                    first: first.min(second),
                    second: first.max(second),
                }
            }
        }
    }

    fn duration(&self, delay_ns: i64) -> Duration {
        if delay_ns < 0 {
            add(&self.cells.negative_delay);
        }
        Duration::from_nanos(delay_ns.max(0).unsigned_abs())
    }
}

/// One thread counts, another reads when the first is done.
fn add(cell: &AtomicU64) {
    cell.fetch_add(1, Ordering::Relaxed);
}

impl LinkModel for TraceLink {
    fn offer(&mut self, now: Instant, _length_bytes: usize) -> Fate {
        self.offer_number(now, self.next_number)
    }

    fn offer_numbered(&mut self, now: Instant, _length_bytes: usize, number: u64) -> Fate {
        self.offer_number(now, number)
    }

    fn replay_tally(&self) -> Option<ReplayTally> {
        Some(self.tally())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::TraceHeader;

    const MS: i64 = 1_000_000;

    /// Every 10 ms: delivered after 2 ms, lost, delivered twice, unknown.
    fn trace() -> Trace {
        let at = |index: i64| TraceRecord::published(index * 10 * MS, index.unsigned_abs(), 16);
        let mut records = vec![at(0).delivered(2 * MS, 0), at(1), at(2), at(3)];
        records[1].fate = TraceFate::LostInNetwork;
        records[2] = records[2].delivered(5 * MS, 0);
        records[2].second_delay_ns = 3 * MS;
        let header = TraceHeader::new("a/b");
        Trace { header, records }
    }

    fn link(matching: TraceMatch, end: TraceEnd) -> TraceLink {
        let replay = TraceReplay {
            matching,
            end,
            delay_otherwise: None,
        };
        TraceLink::new(Arc::new(trace()), replay).unwrap()
    }

    fn at(ms: i64) -> Instant {
        Instant::from_ns(ms * MS)
    }

    fn met(ms: i64) -> Vec<Fate> {
        vec![
            Fate::Delivered(at(ms + 2)),
            Fate::Lost,
            Fate::Duplicated {
                first: at(ms + 3),
                second: at(ms + 5),
            },
            Fate::Lost,
        ]
    }

    #[test]
    fn the_nth_message_meets_the_nth_record_whenever_it_comes() {
        let mut link = link(TraceMatch::Index, TraceEnd::Wrap);
        let tally = link.tally();
        for round in 0..2 {
            let fates: Vec<_> = (0..4).map(|_| link.offer(at(700), 16)).collect();
            assert_eq!(fates, met(700), "round {round}");
        }
        let counts = tally.counts();
        assert_eq!((counts.offered_count, counts.met_count), (8, 4));
        assert_eq!((counts.delivered_count, counts.lost_count), (2, 1));
        assert_eq!((counts.unknown_count, counts.beyond_end_count), (1, 4));
        assert_eq!(counts.record_count, 4);
        assert_eq!(link.delay_max(), Duration::from_millis(5));
        // Told by number, it does not matter which were never offered.
        assert_eq!(link.offer_number(at(9), 2), met(9)[2]);
        assert_eq!(link.offer(at(9), 1), Fate::Lost);
    }

    #[test]
    fn by_time_a_message_meets_the_record_published_last() {
        let mut link = link(TraceMatch::Time, TraceEnd::Wrap);
        for (ms, index) in [(0, 0), (9, 0), (10, 1), (25, 2), (39, 3), (40, 0), (52, 1)] {
            assert_eq!(link.offer(at(ms), 1), met(ms)[index], "{ms} ms");
        }
        assert_eq!(link.tally().counts().beyond_end_count, 2);
    }

    #[test]
    fn by_tick_a_message_meets_the_record_of_its_tick_and_what_nobody_published_is_lost() {
        let mut ticking = trace();
        ticking.records = (0..100)
            .filter(|tick| tick % 10 != 7)
            .map(|tick| TraceRecord::published(3 * MS + tick * 10 * MS, 0, 1).delivered(tick, 0))
            .collect();
        let replay = TraceReplay {
            matching: TraceMatch::Tick,
            end: TraceEnd::Perfect,
            delay_otherwise: None,
        };
        let mut link = TraceLink::new(Arc::new(ticking), replay).unwrap();
        for tick in 0..100 {
            let now = at(500 + tick * 10);
            let expected = match tick % 10 {
                7 => Fate::Lost,
                _ => Fate::Delivered(Instant::from_ns(now.as_ns() + tick)),
            };
            assert_eq!(link.offer(now, 1), expected, "tick {tick}");
        }
        assert_eq!(link.offer(at(500 + 991), 1), link.offer(at(500 + 991), 1));
        assert_eq!(link.offer(at(1_500), 1), Fate::Delivered(at(1_500)));
        let counts = link.tally().counts();
        assert_eq!((counts.met_count, counts.unpublished_count), (90, 10));
        assert_eq!((counts.repeated_count, counts.beyond_end_count), (2, 1));
        assert_eq!(counts.offered_count, 103);
        let without_period = TraceLink::new(Arc::new(trace()), replay).unwrap();
        assert_eq!(without_period.tally().counts().matching, TraceMatch::Index);
    }

    #[test]
    fn after_the_end_it_does_what_it_was_told_and_counts_it() {
        for matching in [TraceMatch::Index, TraceMatch::Time] {
            for (end, fate) in [
                (TraceEnd::Perfect, Fate::Delivered(at(40))),
                (TraceEnd::Lost, Fate::Lost),
            ] {
                let mut link = link(matching, end);
                for ms in [0, 10, 20, 30] {
                    link.offer(at(ms), 1);
                }
                assert_eq!(link.offer(at(40), 1), fate);
                let counts = link.tally().counts();
                assert_eq!((counts.met_count, counts.beyond_end_count), (4, 1));
            }
        }
    }

    #[test]
    fn unknown_delays_need_a_word_and_negative_ones_are_counted() {
        let mut unknown = trace();
        unknown.records[2].delay_ns = crate::trace::UNAVAILABLE_NS;
        unknown.header.clock = "clocks not aligned".to_owned();
        let unknown = Arc::new(unknown);
        let error = TraceLink::new(Arc::clone(&unknown), TraceReplay::default()).unwrap_err();
        assert!(error.to_string().contains("record 2"), "{error}");
        let replay = TraceReplay {
            delay_otherwise: Some(Duration::from_millis(4)),
            ..TraceReplay::default()
        };
        let mut link = TraceLink::new(unknown, replay).unwrap();
        let fate = link.offer_number(at(0), 2);
        assert_eq!(fate.arrival(), Some(at(3)));
        let mut early = trace();
        early.records[0].delay_ns = -5;
        let mut link = TraceLink::new(Arc::new(early), TraceReplay::default()).unwrap();
        assert_eq!(link.offer(at(1), 1), Fate::Delivered(at(1)));
        assert_eq!(link.tally().counts().negative_delay_count, 1);
        let empty = Trace {
            records: Vec::new(),
            ..trace()
        };
        let refused = TraceLink::new(Arc::new(empty), TraceReplay::default());
        assert_eq!(refused.unwrap_err(), ReplayError::Empty);
    }
}
