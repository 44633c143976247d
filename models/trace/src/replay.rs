//! A recorded trace as a link: each message meets what a message of the trace met. It draws no
//! random number and reads no file.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use super::replay_offers::{OfferGrid, Offered};
use super::replay_ticks::Ticks;
use super::{Trace, TraceFate, TraceRecord, UNAVAILABLE_NS};
use hil_core::link_model::{Fate, LinkModel, MessageNumber, ReplayEvent, ReplayTally, TraceMatch};
use hil_core::time::{Instant, RemoteInstant};
use hil_core::words;

words! {
    /// What a message meets that comes after the end of the trace.
    #[derive(Default)]
    pub enum TraceEnd {
        /// The trace from its beginning.
        #[default]
        Wrap = "wrap",
        /// A link that delivers at once.
        Perfect = "perfect",
        /// A link that delivers nothing.
        Lost = "lost",
    }
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

/// What a message met. Each piece of it meets the same: a message that was lost comes in none, and one
/// that was delivered in all, each as much later as the record says.
#[derive(Debug, Clone, Copy)]
enum Met {
    Record(TraceRecord),
    /// The trace has no record at its tick.
    Unpublished,
    /// It came after the end.
    End,
}

/// The link.
#[derive(Debug)]
pub struct TraceLink {
    trace: Trace,
    replay: TraceReplay,
    /// What time zero of the run is in the trace, and the length of one round through it, above
    /// zero.
    origin_ns: i64,
    span_ns: i64,
    offered: Offered<Met>,
    /// Where records are matched by ticks.
    ticks: Option<Ticks>,
    offers: Option<Offers>,
    tally: ReplayTally,
}

/// Where a replay by ticks stands.
#[derive(Debug, Clone, Copy)]
struct Offers {
    grid: OfferGrid,
    /// The tick of the last message.
    last: u64,
    /// The grid is that of publications on the producer's clock, not of arrivals.
    is_published: bool,
}

impl TraceLink {
    /// A link that replays `trace`.
    ///
    /// # Errors
    /// [`ReplayError`].
    pub fn new(trace: Trace, mut replay: TraceReplay) -> Result<Self, ReplayError> {
        let Some(last) = trace.records.last() else {
            return Err(ReplayError::Empty);
        };
        let mut records = trace.records.iter();
        let unknown =
            |record: &TraceRecord| record.fate == TraceFate::Delivered && record.delay().is_none();
        if replay.delay_otherwise.is_none()
            && let Some(index) = records.position(unknown)
        {
            let clock = trace.header.clock;
            return Err(ReplayError::DelayUnknown { index, clock });
        }
        let period_ns = trace.period_ns().unwrap_or(0);
        let (origin_ns, end_ns) = round(&trace, last.published_ns, period_ns);
        let ticks = match replay.matching {
            TraceMatch::Index | TraceMatch::Time => None,
            TraceMatch::Tick => Ticks::of(&trace.records, period_ns),
        };
        if replay.matching == TraceMatch::Tick && ticks.is_none() {
            replay.matching = TraceMatch::Index;
        }
        let tally = ReplayTally::new(trace.records.len() as u64, replay.matching);
        Ok(Self {
            trace,
            replay,
            origin_ns,
            span_ns: end_ns.saturating_sub(origin_ns).max(1),
            offered: Offered::new(),
            ticks,
            offers: None,
            tally,
        })
    }

    /// Its counts, for whoever gives the link away.
    pub fn tally(&self) -> ReplayTally {
        self.tally.clone()
    }

    /// The longest delay it can add.
    pub fn delay_max(&self) -> Duration {
        let delays = self.trace.records.iter();
        let delays = delays.flat_map(|record| [record.delay(), record.second_delay()]);
        let longest_ns = delays.flatten().max().unwrap_or(0).max(0);
        let longest = Duration::from_nanos(longest_ns.unsigned_abs());
        longest.max(self.replay.delay_otherwise.unwrap_or_default())
    }

    /// As [`LinkModel::offer`], for this message of its channel. A piece or copy of one of the last 64
    /// meets what that met, and is not counted again.
    pub fn offer_message(&mut self, now: Instant, message: MessageNumber) -> Fate {
        let (number, is_restarted) = self.offered.number(message);
        if let Some(met) = self.offered.met(number) {
            return self.fate(met, now);
        }
        let met = match self.replay.matching {
            TraceMatch::Index => self.counted(self.by_index(number)),
            TraceMatch::Time => self.counted(self.by_time(now)),
            TraceMatch::Tick => self.by_tick(now, message.published, number, is_restarted),
        };
        self.offered.keep(number, met);
        if let Met::Record(record) = met
            && record.fate == TraceFate::Delivered
        {
            let delays = [record.delay(), record.second_delay()];
            for _ in delays.into_iter().flatten().filter(|delay| *delay < 0) {
                self.tally.count(ReplayEvent::NegativeDelay);
            }
        }
        self.fate(met, now)
    }

    /// Counts what a message meets with a record of its own, or none after the end.
    fn counted(&self, place: Option<(TraceRecord, bool)>) -> Met {
        let Some((record, is_beyond)) = place else {
            self.tally.count(ReplayEvent::BeyondEnd);
            return Met::End;
        };
        self.tally.count(match record.fate {
            _ if is_beyond => ReplayEvent::BeyondEnd,
            TraceFate::Delivered => ReplayEvent::Delivered,
            TraceFate::Unknown => ReplayEvent::Unknown,
            TraceFate::LostInNetwork | TraceFate::LostBeforeLink | TraceFate::LostAfterLink => {
                ReplayEvent::Lost
            }
        });
        Met::Record(record)
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
        let in_round_ns = now.as_ns().rem_euclid(self.span_ns);
        let at_ns = self.origin_ns.saturating_add(in_round_ns);
        let records = &self.trace.records;
        let after = records.partition_point(|record| record.published_ns <= at_ns);
        let place = match after.checked_sub(1) {
            Some(place) => place,
            None if is_beyond => records.len() - 1,
            None => 0,
        };
        Some((records[place], is_beyond))
    }

    /// As the others, with its count: a message may have no record of its own.
    fn by_tick(
        &mut self,
        now: Instant,
        published: Option<RemoteInstant>,
        number: u64,
        is_restarted: bool,
    ) -> Met {
        let ticks = self.ticks.as_ref().expect("matching by ticks has them");
        // As in the trace itself, what counts is when a message was published. Its arrival, which the
        // hosts and the hop below have shifted, stands in only where nothing else is known.
        let at_ns = published.map_or(now.as_ns(), RemoteInstant::as_ns);
        let is_published = published.is_some();
        let begun = |tick| Offers {
            grid: OfferGrid::new(at_ns, tick, ticks.period_ns),
            last: tick,
            is_published,
        };
        let (offered, is_repeated) = match &mut self.offers {
            None => {
                self.offers = Some(begun(number));
                (number, false)
            }
            // The two clocks have nothing in common.
            Some(offers) if offers.is_published != is_published => {
                let tick = offers.last.saturating_add(1);
                *offers = begun(tick);
                (tick, false)
            }
            Some(offers) => {
                if is_restarted {
                    offers.grid = offers.grid.restarted(at_ns);
                } else {
                    offers.grid.tick(at_ns);
                }
                let tick = offers.grid.newest();
                (tick, core::mem::replace(&mut offers.last, tick) == tick)
            }
        };
        let is_beyond = offered >= ticks.count();
        if is_beyond && self.replay.end != TraceEnd::Wrap {
            return self.counted(None);
        }
        let Some(place) = ticks.record_of(offered % ticks.count()) else {
            self.tally.count(ReplayEvent::Unpublished);
            return Met::Unpublished;
        };
        let record = self.trace.records[place];
        if is_repeated && !is_beyond {
            self.tally.count(ReplayEvent::Repeated);
            return Met::Record(record);
        }
        self.counted(Some((record, is_beyond)))
    }

    fn fate(&self, met: Met, now: Instant) -> Fate {
        let record = match met {
            Met::Record(record) if record.fate == TraceFate::Delivered => record,
            Met::End if self.replay.end != TraceEnd::Lost => return Fate::Delivered(now),
            Met::Record(_) | Met::Unpublished | Met::End => return Fate::Lost,
        };
        let after = |delay_ns: i64| now + Duration::from_nanos(delay_ns.max(0).unsigned_abs());
        let otherwise = now + self.replay.delay_otherwise.unwrap_or_default();
        let first = record.delay().map_or(otherwise, after);
        match record.second_delay().map(after) {
            None => Fate::Delivered(first),
            Some(second) => Fate::Duplicated {
                first: first.min(second),
                second: first.max(second),
            },
        }
    }
}

/// Where a round through `trace` by time begins and ends: with its run, where it says how long that
/// was, so also a text of opportunities, which wraps at its last line; else with its first record and
/// a period after its last. Instants of another origin than the run's thus do not count as a time
/// without end before the first record.
fn round(trace: &Trace, last_ns: i64, period_ns: i64) -> (i64, i64) {
    let first_ns = trace.records.first().map_or(0, |first| first.published_ns);
    let duration_ns = trace.header.duration_ns;
    if duration_ns != UNAVAILABLE_NS && first_ns <= duration_ns {
        return (0, duration_ns.max(last_ns));
    }
    (first_ns, last_ns.saturating_add(period_ns))
}

impl LinkModel for TraceLink {
    fn offer(&mut self, now: Instant, _length_bytes: usize) -> Fate {
        self.offer_message(now, self.offered.following())
    }

    fn offer_numbered(
        &mut self,
        now: Instant,
        _length_bytes: usize,
        message: MessageNumber,
    ) -> Fate {
        self.offer_message(now, message)
    }

    fn replay_tally(&self) -> Option<ReplayTally> {
        Some(self.tally())
    }
}
