//! What a summary says of the foreign programs that played a role through an EGM adapter. It holds
//! figures; `crate::adapter_metrics` computes them.

use hil_arm::egm::messages::Side as ArmSide;
use hil_stats::histogram::Distribution;
use serde::{Deserialize, Serialize};

use super::summary::{CountByName, Fact};
use hil_rundir::pipe::RefusalCount;
use hil_topology::AdapterKind;

/// One arm of an adapter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AdapterSummary {
    /// The process in the topology.
    pub process: String,
    /// The host it ran on.
    pub host: String,
    /// Whether we were the robot or the sensor.
    pub kind: AdapterKind,
    /// Which arm.
    pub arm: ArmSide,
    /// Where the foreign program listens, or where we did.
    pub address: String,
    /// How the foreign program stood to us at the end, in words.
    pub peer_state: String,
    /// Median interval of the robot's messages: the controller cycle that every delay is held
    /// against; `None` when there were fewer than two.
    pub cycle_ns: Option<i64>,
    /// How the robot's messages were answered.
    pub answers: Answers,
    /// Where time went, in the order of the way.
    pub segments: Vec<AdapterSegment>,
    /// Datagrams that could not be used, by cause; only causes that occurred.
    pub refusals: Vec<RefusalCount>,
    /// Everything else it counted.
    pub counters: Vec<CountByName>,
    /// What was granted and found: socket, buffers, stamp probe.
    pub facts: Vec<Fact>,
}

impl AdapterSummary {
    /// True when nothing came from the foreign program, not even what was refused.
    pub fn is_unanswered(&self) -> bool {
        !self.has_usable_messages() && self.refusals.is_empty()
    }

    /// True when something that the protocol allows came from the foreign program.
    pub fn has_usable_messages(&self) -> bool {
        match self.kind {
            AdapterKind::Sensor => self.answers.robot_message_count > 0,
            // From the first answer to the last there is at least the message it follows.
            AdapterKind::Robot => self.answers.attended_count > 0,
        }
    }
}

/// How many of the robot's messages were answered.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Answers {
    /// Messages of the robot, of the whole run.
    pub robot_message_count: u64,
    /// Of those, as many as there were from the first answer to the last: while the sensor was
    /// there at all.
    pub attended_count: u64,
    /// Of the attended ones, those followed by an answer before the next message of the robot.
    pub answered_count: u64,
}

impl Answers {
    /// Share of the attended messages that were answered; `None` without any.
    pub fn ratio(&self) -> Option<f64> {
        let attended = (self.attended_count > 0).then_some(self.attended_count as f64);
        attended.map(|attended| self.answered_count as f64 / attended)
    }
}

/// One part of the way through an adapter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AdapterSegment {
    /// From where to where, and of what.
    pub name: String,
    /// How long it took.
    pub distribution: Distribution,
}

impl AdapterSegment {
    /// The 99th percentile as a share of a cycle of `cycle_ns`; `None` where either is unknown.
    pub fn p99_of_cycle(&self, cycle_ns: Option<i64>) -> Option<f64> {
        let figures = self.distribution.measured()?;
        let cycle_ns = cycle_ns.filter(|cycle_ns| *cycle_ns > 0)?;
        Some(figures.p99_ns as f64 / cycle_ns as f64)
    }
}
