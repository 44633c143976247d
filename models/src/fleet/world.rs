//! What a fleet's controller, robots and referee share and never change: the vehicle, its bays,
//! the paths between them and the critical sections of each two paths.

use std::sync::{Arc, OnceLock};

use crate::fleet::geometry::{Footprint, Pose};
use crate::fleet::path::{Path, PathId, PathLibrary};
use crate::fleet::section::{MergePolicy, Section, sections_between};

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
    /// Sections at a footprint grown so that no overlap hides between two poses.
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
        let library = |clearance_m| {
            let footprint = vehicle.footprint.grown(clearance_m);
            SectionLibrary::new(paths.clone(), footprint, merge)
        };
        let (sections, guarded_sections) =
            (library(0.0), library(between_poses_m(&vehicle, &paths)));
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

/// How far a vehicle between two poses can stick out of its ground at both of them together, at
/// most: what a corner moves sideways in half a step. Along the way none sticks out, a step being
/// shorter than the vehicle.
fn between_poses_m(vehicle: &Vehicle, paths: &PathLibrary) -> f64 {
    let radius_m = vehicle.footprint.radius_m();
    let of_path = |path: &Path| {
        path.poses()
            .windows(2)
            .map(|two| {
                let turn = (two[1].heading_rad - two[0].heading_rad).sin().abs();
                0.5 * turn * radius_m
            })
            .fold(0.0, f64::max)
    };
    paths
        .ids()
        .filter_map(|id| paths.get(id))
        .map(|path| of_path(path))
        .fold(0.0, f64::max)
}

/// The critical sections of every two paths, each computed when first asked for and kept.
#[derive(Debug)]
pub struct SectionLibrary {
    paths: PathLibrary,
    footprint: Footprint,
    merge: MergePolicy,
    cells: Vec<OnceLock<Arc<[Section]>>>,
}

impl SectionLibrary {
    /// A library without any section computed yet.
    pub fn new(paths: PathLibrary, footprint: Footprint, merge: MergePolicy) -> Self {
        let cells = (0..paths.len() * paths.len())
            .map(|_| OnceLock::new())
            .collect();
        Self {
            paths,
            footprint,
            merge,
            cells,
        }
    }

    /// The sections of two paths, `first` being [`Side::First`](super::section::Side::First).
    /// Several threads may ask at once; each pair is the same whoever computed it.
    ///
    /// # Panics
    /// When a path is not in the library.
    pub fn between(&self, first: PathId, second: PathId) -> &Arc<[Section]> {
        let cell = &self.cells[first.index() * self.paths.len() + second.index()];
        cell.get_or_init(|| {
            let path = |id| self.paths.get(id).expect("a path of this library");
            if second < first {
                let mut mirrored: Vec<_> = self
                    .between(second, first)
                    .iter()
                    .map(Section::mirrored)
                    .collect();
                mirrored.sort_by_key(|section| section.start(super::section::Side::First));
                return mirrored.into();
            }
            sections_between(path(first), path(second), &self.footprint, self.merge).into()
        })
    }
}
