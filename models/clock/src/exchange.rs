//! One four-stamp exchange between two hosts, as a pair of causal statements about their clocks.
//! It estimates nothing.

use serde::{Deserialize, Serialize};

use super::ClockSettings;
use hil_core::record::{RoundTripRecord, UNAVAILABLE};

/// Which of the two hosts asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Requester {
    /// The one whose clock is converted to.
    Local,
    /// The one whose clock is converted from.
    Remote,
}

hil_core::labelled! {
    /// What took a stamp.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum StampKind, label {
        /// The program, beside its system call.
        Application = "application",
        /// The kernel, on its real-time clock.
        KernelSoftware = "kernel",
        /// The network card, on a clock of its own.
        NetworkCard = "network card",
    }
}

impl StampKind {
    /// As [`RoundTripRecord::sources`] has it.
    pub const fn from_code(code: u8) -> Option<Self> {
        match code {
            0 => Some(Self::Application),
            1 => Some(Self::KernelSoftware),
            2 => Some(Self::NetworkCard),
            _ => None,
        }
    }
}

/// A datagram each way. Whichever host asked, one went from here to there and one came back, and
/// neither arrived before it left.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Exchange {
    there_sent_ns: i64,
    there_received_ns: i64,
    back_sent_ns: i64,
    back_received_ns: i64,
    requester: Requester,
    /// Kinds of t1 to t4.
    kinds: [StampKind; 4],
}

impl Exchange {
    /// The exchange that `record` tells of; `None` when a stamp is missing or of a kind that is not
    /// on the host's monotonic clock.
    pub fn of(record: &RoundTripRecord, requester: Requester) -> Option<Self> {
        let stamps = [record.t1_ns, record.t2_ns, record.t3_ns, record.t4_ns];
        if stamps.contains(&UNAVAILABLE) {
            return None;
        }
        let mut kinds = [StampKind::Application; 4];
        for (kind, code) in kinds.iter_mut().zip(record.sources) {
            *kind = StampKind::from_code(code)?;
        }
        if kinds.contains(&StampKind::NetworkCard) {
            return None;
        }
        let [t1, t2, t3, t4] = stamps;
        let (there, back) = match requester {
            Requester::Local => ((t1, t2), (t3, t4)),
            Requester::Remote => ((t3, t4), (t1, t2)),
        };
        Some(Self {
            there_sent_ns: there.0,
            there_received_ns: there.1,
            back_sent_ns: back.0,
            back_received_ns: back.1,
            requester,
            kinds,
        })
    }

    /// Kinds of the four stamps, in the order t1 to t4.
    pub const fn kinds(&self) -> [StampKind; 4] {
        self.kinds
    }

    /// When one of its datagrams arrived at the host whose clock is converted from, on that clock.
    pub const fn remote_ns(&self) -> i64 {
        self.there_received_ns
    }

    /// Time under way, both directions together, nanoseconds.
    pub const fn rtt_ns(&self) -> i64 {
        let there = self.there_received_ns.saturating_sub(self.there_sent_ns);
        let back = self.back_received_ns.saturating_sub(self.back_sent_ns);
        there.saturating_add(back)
    }

    /// The two statements and the time they belong to; `None` when even the stamps' errors do not
    /// explain that something arrived before it left, or the stamps are further apart than any
    /// clock could be.
    pub(super) fn constraint(&self, settings: &ClockSettings) -> Option<Constraint> {
        let error = |indices: [usize; 2]| -> i64 {
            let [first_ns, second_ns] = indices.map(|index| match self.kinds[index] {
                StampKind::KernelSoftware => settings.stamp_error_ns,
                StampKind::Application | StampKind::NetworkCard => 0,
            });
            first_ns.saturating_add(second_ns)
        };
        let (there_error_ns, back_error_ns) = match self.requester {
            Requester::Local => (error([0, 1]), error([2, 3])),
            Requester::Remote => (error([2, 3]), error([0, 1])),
        };
        let lower_ns = self
            .there_sent_ns
            .checked_sub(self.there_received_ns)?
            .checked_sub(there_error_ns)?;
        let upper_ns = self
            .back_received_ns
            .checked_sub(self.back_sent_ns)?
            .checked_add(back_error_ns)?;
        let width_ns = upper_ns.checked_sub(lower_ns)?;
        if width_ns < 0 {
            return None;
        }
        let (first_ns, last_ns) = match self.requester {
            // Our own ends of it are not on the other's clock, but no further off than this.
            Requester::Local => (
                self.there_received_ns.saturating_sub(width_ns),
                self.back_sent_ns.saturating_add(width_ns),
            ),
            Requester::Remote => (self.back_sent_ns, self.there_received_ns),
        };
        let (low, high) = (
            Edge::new(self.there_received_ns, lower_ns),
            Edge::new(self.back_sent_ns, upper_ns),
        );
        Some(Constraint {
            low,
            high,
            first_ns: first_ns.min(low.at_ns).min(high.at_ns),
            last_ns: last_ns.max(low.at_ns).max(high.at_ns),
            rtt_ns: self.rtt_ns(),
        })
    }
}

/// A one-sided bound of the offset at one instant of the other host's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Edge {
    pub(super) at_ns: i64,
    pub(super) offset_ns: i64,
}

impl Edge {
    const fn new(at_ns: i64, offset_ns: i64) -> Self {
        Self { at_ns, offset_ns }
    }

    /// What this lower bound still says at `at_ns`.
    pub(super) fn lower_at(self, at_ns: i64, settings: &ClockSettings) -> i64 {
        let drift_ns = settings.drift_ns(at_ns.saturating_sub(self.at_ns));
        self.offset_ns.saturating_sub(drift_ns)
    }

    /// What this upper bound still says at `at_ns`.
    pub(super) fn upper_at(self, at_ns: i64, settings: &ClockSettings) -> i64 {
        let drift_ns = settings.drift_ns(at_ns.saturating_sub(self.at_ns));
        self.offset_ns.saturating_add(drift_ns)
    }
}

/// What one exchange says of the offset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Constraint {
    /// The offset was no less.
    pub(super) low: Edge,
    /// The offset was no more.
    pub(super) high: Edge,
    /// All of it happened between these two instants of the other host's clock.
    pub(super) first_ns: i64,
    pub(super) last_ns: i64,
    pub(super) rtt_ns: i64,
}

impl Constraint {
    /// The middle of what it allows: the offset, if it took equally long both ways.
    pub(super) fn middle(&self) -> Edge {
        let half = |a: i64, b: i64| a.saturating_add(b.saturating_sub(a) / 2);
        Edge::new(
            half(self.low.at_ns, self.high.at_ns),
            half(self.low.offset_ns, self.high.offset_ns),
        )
    }
}
