//! What a link is to those that offer it messages: [`LinkModel`] and the fate of a message. The
//! models themselves are built on it.

use core::fmt::Debug;
use core::sync::atomic::{AtomicU64, Ordering};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::message::Envelope;
use crate::time::{Instant, RemoteInstant};

/// What happens to one offered message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fate {
    /// It arrives at this instant, never before it was offered.
    Delivered(Instant),
    /// It arrives at `first` and once more at `second`, which is never earlier.
    Duplicated {
        /// Its first arrival.
        first: Instant,
        /// Its second.
        second: Instant,
    },
    /// It does not arrive.
    Lost,
}

impl Fate {
    /// When it arrives first; `None` when it is lost.
    pub const fn arrival(self) -> Option<Instant> {
        match self {
            Self::Delivered(at) | Self::Duplicated { first: at, .. } => Some(at),
            Self::Lost => None,
        }
    }

    /// When it arrives a second time; `None` when it does not.
    pub const fn second_arrival(self) -> Option<Instant> {
        match self {
            Self::Duplicated { second, .. } => Some(second),
            Self::Delivered(_) | Self::Lost => None,
        }
    }

    /// Its arrivals, in order of time.
    pub fn arrivals(self) -> impl Iterator<Item = Instant> {
        self.arrival().into_iter().chain(self.second_arrival())
    }
}

/// Which message of its channel is offered. All pieces of a message have its number, and so has what a
/// network brings twice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MessageNumber {
    /// The producer's start, its epoch on the channel.
    pub start: u32,
    /// Counted from 0 at each start.
    pub sequence: u64,
    /// When it was published, on its producer's clock, where that is known. It compares with that of the
    /// producer's other messages only.
    pub published: Option<RemoteInstant>,
}

impl From<&Envelope> for MessageNumber {
    fn from(envelope: &Envelope) -> Self {
        Self {
            start: envelope.epoch,
            sequence: envelope.sequence,
            published: Some(RemoteInstant::from_ns(envelope.published_ns)),
        }
    }
}

/// A one-directional link.
pub trait LinkModel: Debug + Send {
    /// Offers a message of `length_bytes` at `now` and decides its fate. Calls come in
    /// non-decreasing `now`.
    fn offer(&mut self, now: Instant, length_bytes: usize) -> Fate;

    /// As [`LinkModel::offer`], told which message of its channel it is or is a part of: what a
    /// recorded trace goes by. To other models it is one message like the next.
    fn offer_numbered(
        &mut self,
        now: Instant,
        length_bytes: usize,
        message: MessageNumber,
    ) -> Fate {
        let _ = message;
        self.offer(now, length_bytes)
    }

    /// Tells what time it is while nothing is offered, for a link that changes by itself.
    fn attend(&mut self, now: Instant) {
        let _ = now;
    }

    /// What the replay of a trace met so far; `None` for a model that replays none.
    fn replay_tally(&self) -> Option<ReplayTally> {
        None
    }

    /// What the messages lost so far were lost to; `None` for a model that does not tell causes
    /// apart.
    fn loss_causes(&self) -> Option<LossCauses> {
        None
    }
}

impl<L: LinkModel + ?Sized> LinkModel for Box<L> {
    fn offer(&mut self, now: Instant, length_bytes: usize) -> Fate {
        (**self).offer(now, length_bytes)
    }

    fn offer_numbered(
        &mut self,
        now: Instant,
        length_bytes: usize,
        message: MessageNumber,
    ) -> Fate {
        (**self).offer_numbered(now, length_bytes, message)
    }

    fn attend(&mut self, now: Instant) {
        (**self).attend(now);
    }

    fn replay_tally(&self) -> Option<ReplayTally> {
        (**self).replay_tally()
    }

    fn loss_causes(&self) -> Option<LossCauses> {
        (**self).loss_causes()
    }
}

/// What a link lost messages to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct LossCauses {
    /// To outages.
    pub outage_count: u64,
    /// By chance.
    pub chance_count: u64,
    /// To a full queue.
    pub queue_count: u64,
}

impl LossCauses {
    /// These and others.
    #[must_use]
    pub const fn plus(self, other: Self) -> Self {
        Self {
            outage_count: self.outage_count + other.outage_count,
            chance_count: self.chance_count + other.chance_count,
            queue_count: self.queue_count + other.queue_count,
        }
    }

    /// All of them.
    pub const fn total(self) -> u64 {
        self.outage_count + self.chance_count + self.queue_count
    }
}

/// The shared-memory channel of one host in virtual time: everything arrives at once.
#[derive(Debug, Clone, Copy, Default)]
pub struct PerfectLink;

impl LinkModel for PerfectLink {
    fn offer(&mut self, now: Instant, _length_bytes: usize) -> Fate {
        Fate::Delivered(now)
    }
}

crate::words! {
    /// Which record a message meets.
    #[derive(Default)]
    pub enum TraceMatch {
        /// The n-th message of the channel meets the n-th record: equal departures have equal counts. Counted
        /// over all starts of its producer: a start's first comes after the last one offered before.
        #[default]
        Index = "index",
        /// The record published last at that time of the run: counted from the run's start where the
        /// trace says how long its run was, else from its first record. Before the first record the
        /// first, in a later round the last of the round before.
        Time = "time",
        /// The record of the same tick: as many periods after the first message of its channel as the
        /// record is after the first of the trace, however many were missed and however long it is. What
        /// nobody published live is lost, so the other end hears at each tick what it heard live. A
        /// trace without a period, or of a producer that was started anew, is matched by index instead,
        /// and the counts say so. The first message offered belongs to the tick of its number: to none
        /// too early, and to one too late by what was missed before it.
        Tick = "tick",
    }
}

/// What a replay met so far. Read it while the link works, or after.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ReplayCounts {
    /// How records were matched in the end.
    pub matching: TraceMatch,
    /// Records of the trace.
    pub record_count: u64,
    /// Messages offered, however many pieces or copies each came in.
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

/// What a replay can meet, as it is counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReplayEvent {
    /// A delivered record.
    Delivered,
    /// A lost record.
    Lost,
    /// A record whose fate is not known.
    Unknown,
    /// A tick without a record.
    Unpublished,
    /// A record met before.
    Repeated,
    /// The end of the trace.
    BeyondEnd,
    /// A delay below zero.
    NegativeDelay,
}

/// The counts of a replay, shared between the link that counts and whoever reads.
#[derive(Debug, Clone)]
pub struct ReplayTally {
    cells: Arc<[AtomicU64; 7]>,
    record_count: u64,
    matching: TraceMatch,
}

impl ReplayTally {
    /// Of a replay that met nothing yet.
    pub fn new(record_count: u64, matching: TraceMatch) -> Self {
        Self {
            cells: Arc::default(),
            record_count,
            matching,
        }
    }

    /// Counts one. One thread counts, another reads when the first is done.
    pub fn count(&self, event: ReplayEvent) {
        self.cells[event as usize].fetch_add(1, Ordering::Relaxed);
    }

    /// What the link met so far.
    pub fn counts(&self) -> ReplayCounts {
        let of = |event: ReplayEvent| self.cells[event as usize].load(Ordering::Relaxed);
        let delivered_count = of(ReplayEvent::Delivered);
        let lost_count = of(ReplayEvent::Lost);
        let unknown_count = of(ReplayEvent::Unknown);
        let beyond_end_count = of(ReplayEvent::BeyondEnd);
        let unpublished_count = of(ReplayEvent::Unpublished);
        let repeated_count = of(ReplayEvent::Repeated);
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
            negative_delay_count: of(ReplayEvent::NegativeDelay),
        }
    }
}
