//! One robot as its truth records tell: where it is at any time from its last record on. It
//! judges nothing.

use std::sync::Arc;

use crate::geometry::{OrientedBox, Pose, floor_index};
use crate::messages::Truth;
use crate::path::{Path, PathId};
use crate::referee::tally::Cause;
use crate::world::Vehicle;
use hil_core::time::Instant;

/// A robot's motion from its last record on, and where it was at the last scan.
#[derive(Debug, Clone)]
pub(crate) struct Track {
    pub(crate) path: Option<Arc<Path>>,
    pub(crate) path_id: PathId,
    pub(crate) mission_id: u32,
    pub(crate) is_driving: bool,
    /// Its last authority came too late to stop at.
    pub(crate) is_late: bool,
    pub(crate) cause: Cause,
    since: Instant,
    way_m: f64,
    speed_mps: f64,
    acceleration_mps2: f64,
    /// At the last scan.
    pub(crate) seen_m: f64,
    /// Last pose passed at the last scan.
    pub(crate) index: usize,
    /// Reference point at the last scan, metres.
    pub(crate) position: [f64; 2],
    /// It stands elsewhere than at the scan before.
    pub(crate) has_moved: bool,
    stand: Pose,
}

impl Track {
    /// A robot nothing is known of but where it stands.
    pub(crate) fn standing(stand: Pose) -> Self {
        Self {
            path: None,
            path_id: PathId(u32::MAX),
            mission_id: 0,
            is_driving: false,
            is_late: false,
            cause: Cause::default(),
            since: Instant::ZERO,
            way_m: 0.0,
            speed_mps: 0.0,
            acceleration_mps2: 0.0,
            seen_m: 0.0,
            index: 0,
            position: [stand.x_m, stand.y_m],
            has_moved: true,
            stand,
        }
    }

    /// Goes over to a record's motion; gives the way driven since the last record.
    pub(crate) fn take(&mut self, truth: &Truth, path: Option<&Arc<Path>>) -> f64 {
        let is_same_way = self.path_id.0 == truth.path_id && self.mission_id == truth.mission_id;
        let driven_m = if is_same_way {
            (truth.travelled_m - self.way_m).max(0.0)
        } else {
            0.0
        };
        if self.path_id.0 != truth.path_id {
            self.path_id = PathId(truth.path_id);
            self.path = path.map(Arc::clone);
        }
        if !is_same_way {
            self.has_moved = true;
            // No way compares equal to it: the next look takes the robot as moved.
            self.seen_m = f64::NAN;
        }
        self.mission_id = truth.mission_id;
        self.since = Instant::from_ns(truth.at_ns);
        self.way_m = truth.travelled_m;
        self.speed_mps = truth.speed_mps;
        self.acceleration_mps2 = truth.acceleration_mps2;
        driven_m
    }

    /// Way along its path at `now`; never backwards, and not beyond where it comes to rest.
    pub(crate) fn way_at_m(&self, now: Instant) -> f64 {
        if self.speed_mps <= 0.0 && self.acceleration_mps2 <= 0.0 {
            return self.way_m;
        }
        let mut elapsed_s = now.seconds_since(self.since).max(0.0);
        if self.acceleration_mps2 < 0.0 {
            elapsed_s = elapsed_s.min(self.speed_mps / -self.acceleration_mps2);
        }
        self.way_m + (self.speed_mps + 0.5 * self.acceleration_mps2 * elapsed_s) * elapsed_s
    }

    /// Looks where it is at `now`; true when it has passed another pose since the last look.
    pub(crate) fn look(&mut self, now: Instant) -> bool {
        let way_m = self.way_at_m(now);
        self.has_moved = way_m.to_bits() != self.seen_m.to_bits();
        if !self.has_moved {
            return false;
        }
        self.seen_m = way_m;
        let Some(path) = &self.path else {
            self.position = [self.stand.x_m, self.stand.y_m];
            return false;
        };
        let position = way_m / path.spacing_m();
        // As the path's own rule for an index, without dividing once more.
        let index = floor_index(position + 1e-9).min(path.last_index());
        let here = &path.poses()[index];
        let next = &path.poses()[(index + 1).min(path.last_index())];
        let ratio = (position - index as f64).clamp(0.0, 1.0);
        self.position = [
            here.x_m + ratio * (next.x_m - here.x_m),
            here.y_m + ratio * (next.y_m - here.y_m),
        ];
        let has_passed = index != self.index;
        self.index = index;
        has_passed
    }

    /// The ground it covered at the last look.
    pub(crate) fn covered(&self, vehicle: &Vehicle) -> OrientedBox {
        let pose = match &self.path {
            Some(path) => path.pose_at(self.seen_m),
            None => self.stand,
        };
        vehicle.footprint.at(&pose)
    }

    /// The ground it would cover at the last pose passed, as the original looks at it.
    pub(crate) fn covered_at_index(&self, vehicle: &Vehicle) -> OrientedBox {
        let pose = match &self.path {
            Some(path) => path.poses()[self.index],
            None => self.stand,
        };
        vehicle.footprint.at(&pose)
    }
}
