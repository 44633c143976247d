//! What a fleet's controller, robots and referee share and never change: the vehicle, its bays,
//! the paths between them and the critical sections of each two paths.

use std::sync::Arc;

use crate::geometry::{Footprint, Pose, wrap_angle};
use crate::path::{Path, PathId, PathLibrary};
use crate::section::MergePolicy;

pub use crate::section::SectionLibrary;

/// A vehicle of Table I of the seed paper.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Vehicle {
    /// Its ground plan.
    pub footprint: Footprint,
    /// Largest speed, m/s.
    pub speed_max_mps: f64,
    /// Largest acceleration and deceleration, m/s^2.
    pub acceleration_mps2: f64,
}

impl Vehicle {
    /// The time from rest to rest over `way_m` with all that it can do, seconds.
    pub fn least_time_s(&self, way_m: f64) -> f64 {
        let ramp_s = self.speed_max_mps / self.acceleration_mps2;
        if way_m < self.speed_max_mps * ramp_s {
            2.0 * (way_m / self.acceleration_mps2).sqrt()
        } else {
            way_m / self.speed_max_mps + ramp_s
        }
    }
}

/// A place where a robot parks; paths begin and end in bays.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bay {
    /// Where a robot stands in it.
    pub pose: Pose,
}

/// A bay's number, from 0.
pub type BayIndex = usize;

/// One way a robot can be sent: the path from one bay to another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Route {
    /// Where it begins.
    pub from: BayIndex,
    /// Where it ends.
    pub to: BayIndex,
    /// The path.
    pub path: PathId,
}

/// The unchanging world of a fleet.
#[derive(Debug)]
pub struct World {
    /// The vehicle all robots are.
    pub vehicle: Vehicle,
    /// The bays.
    pub bays: Vec<Bay>,
    /// Every way from bay to bay, each way and back, sorted by `from`, then `to`.
    pub routes: Vec<Route>,
    /// The paths of the routes.
    pub paths: PathLibrary,
    /// Sections at the exact footprint: the original's.
    pub sections: SectionLibrary,
    /// Sections at the [`guarded_footprint`]: no overlap hides between two poses.
    pub guarded_sections: SectionLibrary,
}

impl World {
    /// Joins bays and paths to a world; `routes` name paths of `paths` in both directions.
    pub fn new(
        vehicle: Vehicle,
        bays: Vec<Bay>,
        mut routes: Vec<Route>,
        paths: PathLibrary,
        merge: MergePolicy,
    ) -> Self {
        routes.sort_by_key(|route| (route.from, route.to));
        let library = |footprint| SectionLibrary::new(paths.clone(), footprint, merge);
        let sections = library(vehicle.footprint);
        let guarded_sections = library(guarded_footprint(&vehicle.footprint, &paths));
        Self {
            vehicle,
            bays,
            routes,
            paths,
            sections,
            guarded_sections,
        }
    }

    /// The routes that begin at `bay`.
    pub fn routes_from(&self, bay: BayIndex) -> &[Route] {
        let begin = self.routes.partition_point(|route| route.from < bay);
        let end = self.routes.partition_point(|route| route.from <= bay);
        &self.routes[begin..end]
    }

    /// The path `id`.
    ///
    /// # Panics
    /// When the world has no such path.
    pub fn path(&self, id: PathId) -> &Arc<Path> {
        self.paths
            .get(id)
            .expect("a route's path is in the library")
    }
}

/// A footprint within which a vehicle anywhere on a path is covered at the pose nearest to it.
///
/// Let a vehicle be the share `t <= 1/2` of the way from the pose nearest to it to a neighbour,
/// which lies at `(dx, dy)` and turned by `D` in the frame of the nearest pose. Position and
/// heading go linearly ([`Path::pose_at`]), so the point `(u, v)` of the vehicle is at
///
/// ```text
/// x = t dx + u cos(t D) - v sin(t D)      |x| <= l/2 + |dx|/2 + w/2 sin(|D|/2)
/// y = t dy + u sin(t D) + v cos(t D)      |y| <= w/2 + |dy|/2 + l/2 sin(|D|/2)
/// ```
///
/// since `|u| <= l/2`, `|v| <= w/2` and `|D| <= pi`. The grown footprint has these half length and
/// half width at their largest over all steps of all paths, so it covers the vehicle. When
/// the grown footprints of two paths overlap at no pair of poses out of two ranges, the vehicles
/// overlap at no pair of positions between them: each is covered by its own at its nearest
/// pose, which lies in the range.
pub fn guarded_footprint(footprint: &Footprint, paths: &PathLibrary) -> Footprint {
    let (mut length_m, mut width_m) = (footprint.length_m, footprint.width_m);
    // The way back has the same steps.
    for path in paths.ids().step_by(2).filter_map(|id| paths.get(id)) {
        for two in path.poses().windows(2) {
            let half_turn = 0.5 * wrap_angle(two[1].heading_rad - two[0].heading_rad);
            let sine = half_turn.sin().abs();
            let step = [two[1].x_m - two[0].x_m, two[1].y_m - two[0].y_m];
            for pose in two {
                let (s, c) = pose.heading_rad.sin_cos();
                let along_m = (step[0] * c + step[1] * s).abs();
                let across_m = (step[1] * c - step[0] * s).abs();
                length_m = length_m.max(footprint.length_m + along_m + footprint.width_m * sine);
                width_m = width_m.max(footprint.width_m + across_m + footprint.length_m * sine);
            }
        }
    }
    Footprint { length_m, width_m }
}
