//! Link models: what a network does to a message, as a pure function of time and a seeded
//! stream. They carry no bytes; virtual time and `via = "emulated"` ask them for each message.

pub mod bernoulli;
pub mod chain;
#[cfg(test)]
mod chain_tests;
pub mod condition;
pub mod delay;
pub mod impaired;
pub mod in_series;
pub mod loss;
pub mod outages;
pub mod rate;
pub mod reordering;
pub mod spec;
pub mod switched;
pub mod trace;
mod trace_offers;
mod trace_ticks;
pub mod wifi;

use core::fmt::Debug;

use serde::{Deserialize, Serialize};

use self::trace::ReplayTally;
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
