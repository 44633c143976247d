//! What both trackers have in common, and the choice between them. A tracker moves along a way;
//! which path and why is not its business.

use crate::robot::exact::ExactTracker;
use crate::robot::legacy::LegacyTracker;
use crate::robot::parameters::{RobotParameters, TrackerKind};
use crate::world::Vehicle;
use hil_core::time::Instant;

/// What a vehicle can do.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Limits {
    pub(crate) speed_max_mps: f64,
    pub(crate) acceleration_mps2: f64,
}

impl Limits {
    pub(crate) const fn of(vehicle: &Vehicle) -> Self {
        Self {
            speed_max_mps: vehicle.speed_max_mps,
            acceleration_mps2: vehicle.acceleration_mps2,
        }
    }

    /// Way from `speed_mps` to rest.
    pub(crate) fn braking_m(&self, speed_mps: f64) -> f64 {
        speed_mps * speed_mps / (2.0 * self.acceleration_mps2)
    }
}

/// Where a robot is along its path and how it moves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Motion {
    pub(crate) way_m: f64,
    pub(crate) speed_mps: f64,
    pub(crate) acceleration_mps2: f64,
}

/// Either tracker.
#[derive(Debug, Clone)]
pub(crate) enum Tracker {
    Exact(ExactTracker),
    Legacy(LegacyTracker),
}

impl Tracker {
    pub(crate) fn new(parameters: &RobotParameters, limits: Limits) -> Self {
        match parameters.tracker {
            TrackerKind::Exact => Self::Exact(ExactTracker::new(limits)),
            TrackerKind::LegacyRk4 => {
                let period_s = 1e-3 * parameters.tracking_period_ms;
                Self::Legacy(LegacyTracker::new(limits, period_s))
            }
        }
    }

    pub(crate) fn place(&mut self, now: Instant, way_m: f64, end_m: f64) {
        match self {
            Self::Exact(tracker) => tracker.place(now, way_m),
            Self::Legacy(tracker) => tracker.place(now, way_m, end_m),
        }
    }

    /// What the robot reports.
    pub(crate) fn motion(&self, now: Instant) -> Motion {
        match self {
            Self::Exact(tracker) => tracker.motion(now),
            Self::Legacy(tracker) => tracker.motion(),
        }
    }

    /// How the robot truly moves from `now` on: between its ticks the legacy tracker stands.
    pub(crate) fn true_motion(&self, now: Instant) -> Motion {
        match self {
            Self::Exact(tracker) => tracker.motion(now),
            Self::Legacy(tracker) => Motion {
                way_m: tracker.motion().way_m,
                speed_mps: 0.0,
                acceleration_mps2: 0.0,
            },
        }
    }

    pub(crate) fn aim(&mut self, now: Instant, target_m: f64) {
        match self {
            Self::Exact(tracker) => tracker.aim(now, target_m),
            Self::Legacy(tracker) => tracker.aim(target_m),
        }
    }

    pub(crate) fn brake(&mut self, now: Instant) {
        match self {
            Self::Exact(tracker) => tracker.brake(now),
            Self::Legacy(tracker) => tracker.brake(),
        }
    }

    pub(crate) fn can_stop_at(&self, now: Instant, target_m: f64) -> bool {
        match self {
            Self::Exact(tracker) => tracker.can_stop_at(now, target_m),
            Self::Legacy(tracker) => tracker.can_stop_at(target_m),
        }
    }

    pub(crate) fn is_at_rest(&self) -> bool {
        match self {
            Self::Exact(tracker) => tracker.is_at_rest(),
            Self::Legacy(tracker) => tracker.is_at_rest(),
        }
    }

    /// When the motion changes by itself; the legacy tracker's does at its ticks only.
    pub(crate) fn next_change(&self) -> Option<Instant> {
        match self {
            Self::Exact(tracker) => tracker.next_change(),
            Self::Legacy(_) => None,
        }
    }

    pub(crate) fn change(&mut self) {
        if let Self::Exact(tracker) = self {
            tracker.change();
        }
    }
}
