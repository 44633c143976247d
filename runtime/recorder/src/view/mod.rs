//! The state of a run while it goes on, worked out from its records as they come: figures of each
//! channel, losses, the fleet on its ground, the arms. It reads nothing, sends nothing and looks at
//! no clock: records and "now" are arguments, results are JSON as docs/live-view.md lists it.
//!
//! All times are nanoseconds on one axis, that of a recording: a host's monotonic clock plus its
//! offset (see [`crate::clocks`]).

mod account;
pub(crate) mod arms;
pub(crate) mod collisions;
pub(crate) mod facts;
pub(crate) mod fleet;
pub(crate) mod ground;
pub(crate) mod sections;
pub(crate) mod state;

use hil_arm::egm::messages::{EgmCommand, EgmFeedback, Side};
use hil_core::message::Message;
use hil_fleet::messages::{Mission, State, Truth};
use hil_watch::Record;
use serde_json::Value;

use crate::topics::{read, side_of};
use arms::ArmsView;
use fleet::FleetView;

/// Robots from which on a fleet's picture is drawn more seldom.
const MANY_ROBOTS: usize = 64;
/// Between two pictures: 20 Hz.
pub(crate) const PERIOD_NS: u64 = 50_000_000;
/// The same for fleets of many robots.
const LARGE_PERIOD_NS: u64 = 200_000_000;

/// A message that says something of what a run looks like.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Told {
    /// Where a robot is.
    State(State),
    /// Where it is sent.
    Mission(Mission),
    /// What it truly did.
    Truth(Truth),
    /// What an arm is commanded.
    Command(Side, EgmCommand),
    /// What it reports.
    Feedback(Side, EgmFeedback),
}

impl Told {
    /// What `payload`, a message of `channel`, says; nothing when it is no sound message of a kind that is
    /// shown. Which arm it is about, the channel's name tells.
    pub(crate) fn of(channel: &str, message: &str, payload: &[u8]) -> Option<Self> {
        match message {
            State::NAME => read(payload).filter(State::is_sound).map(Self::State),
            Mission::NAME => read(payload).map(Self::Mission),
            Truth::NAME => read(payload).map(Self::Truth),
            EgmCommand::NAME => Some(Self::Command(side_of(channel)?, read(payload)?)),
            EgmFeedback::NAME => Some(Self::Feedback(side_of(channel)?, read(payload)?)),
            _ => None,
        }
    }

    /// True of what arms say.
    const fn is_of_arms(&self) -> bool {
        matches!(self, Self::Command(..) | Self::Feedback(..))
    }
}

/// What a run looks like.
#[derive(Debug)]
pub(crate) struct Pictures {
    /// Of a run whose case is a fleet.
    pub(crate) fleet: Option<FleetView>,
    /// Whatever the case is.
    pub(crate) arms: ArmsView,
}

impl Pictures {
    /// Of a run of `case` with these `[case.parameters]`. The ground of a fleet is made from now on, in a
    /// thread of its own.
    pub(crate) fn of(case: Option<&str>, parameters: &Value) -> Self {
        Self {
            fleet: (case == Some("fleet")).then(|| FleetView::new(parameters)),
            arms: ArmsView::new(),
        }
    }

    /// True when `told` changes a picture of this run.
    pub(crate) const fn shows(&self, told: &Told) -> bool {
        self.fleet.is_some() || told.is_of_arms()
    }

    /// Takes what was told at `at_ns`; `offset_ns` leads from its producer's clock to the axis.
    pub(crate) fn take(&mut self, told: &Told, at_ns: i64, offset_ns: i64) {
        if told.is_of_arms() {
            self.arms.take(told, at_ns);
        } else if let Some(fleet) = &mut self.fleet {
            fleet.take(told, at_ns, offset_ns);
        }
    }

    /// Between two pictures.
    pub(crate) fn period_ns(&self) -> u64 {
        let robots = self.fleet.as_ref().map_or(0, FleetView::robot_count);
        if robots > MANY_ROBOTS {
            LARGE_PERIOD_NS
        } else {
            PERIOD_NS
        }
    }
}

/// Something that a process of the run recorded.
#[derive(Debug, Clone)]
pub(crate) struct LiveRecord {
    /// When it was known: of a played back run, when it happened.
    pub(crate) at_ns: i64,
    /// Which channel, by its place in [`facts::RunFacts`].
    pub(crate) channel: usize,
    /// What.
    pub(crate) body: Body,
}

/// What a record says.
#[derive(Debug, Clone)]
pub(crate) enum Body {
    /// A message itself.
    Message(Vec<u8>),
    /// What became of one on its way.
    Record(Record),
}

/// To the millimetre, or to the thousandth of whatever else: enough for a picture, half the bytes.
pub(crate) fn rounded(value: f64) -> f64 {
    (value * 1000.0).round() / 1000.0
}

/// Seconds, to the millisecond.
pub(crate) fn seconds(ns: i64) -> f64 {
    rounded(ns as f64 / 1e9)
}
