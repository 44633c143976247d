//! The ground a fleet drives on: its edge, its obstacles and its bays. What a vehicle can do on
//! it is the planner's business.

use crate::case_study::ParameterError;
use crate::fleet::geometry::{Bounds, Footprint, Pose};
use crate::fleet::planner::At;
use crate::fleet::planner::space::{Blocker, Space};
use crate::fleet::scenario::BaySide;
use crate::fleet::world::{BayIndex, Vehicle};

/// The ground a fleet drives on.
#[derive(Debug, Clone, PartialEq)]
pub struct Map {
    /// Its edge, metres.
    pub bounds: Bounds,
    /// What no vehicle may touch.
    pub obstacles: Vec<Bounds>,
    /// Where vehicles park.
    pub bays: Vec<MapBay>,
    /// What planned paths keep between vehicle and everything else, metres.
    pub clearance_m: f64,
}

/// A bay of a map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapBay {
    /// Where a vehicle stands in it.
    pub pose: Pose,
    /// Which end of the paths it is.
    pub side: BaySide,
}

impl Map {
    /// Checks that the numbers are numbers, that obstacles have a size, and that vehicles parked
    /// in all bays stand free and apart.
    ///
    /// # Errors
    /// Names the key below `world`.
    pub fn check(&self, vehicle: &Vehicle) -> Result<(), ParameterError> {
        check_rectangle("world.bounds", &self.bounds)?;
        for (index, obstacle) in self.obstacles.iter().enumerate() {
            check_rectangle(&format!("world.obstacles[{index}]"), obstacle)?;
        }
        let space = self.space(vehicle);
        let covered = |bay: &MapBay| vehicle.footprint.at(&bay.pose);
        for (index, bay) in self.bays.iter().enumerate() {
            let error = |problem: String| ParameterError {
                key: format!("world.bays[{index}]"),
                problem: format!("at {} {problem}", At(&bay.pose)),
            };
            let numbers = [bay.pose.x_m, bay.pose.y_m, bay.pose.heading_rad];
            if !numbers.iter().all(|number| number.is_finite()) {
                return Err(error("is not finite".to_owned()));
            }
            if let Some(blocker) = space.blocker(&bay.pose) {
                return Err(error(format!(
                    "has no room for a vehicle with {} m of clearance: {blocker} is there",
                    self.clearance_m
                )));
            }
            let grown = vehicle.footprint.grown(self.clearance_m).at(&bay.pose);
            let other = self.bays[..index]
                .iter()
                .position(|other| grown.overlaps(&covered(other)));
            if let Some(other) = other {
                return Err(error(format!("overlaps bay {other} when both are taken")));
            }
        }
        Ok(())
    }

    /// The bays of one side, by index.
    pub fn bays_of(&self, side: BaySide) -> impl Iterator<Item = BayIndex> {
        let numbered = self.bays.iter().enumerate();
        numbered.filter_map(move |(index, bay)| (bay.side == side).then_some(index))
    }

    /// The map `count` times, one above the other, as one.
    #[must_use]
    pub fn stacked(&self, count: usize) -> Self {
        let mut whole = Self {
            obstacles: Vec::new(),
            bays: Vec::new(),
            ..self.clone()
        };
        for tile in 0..count {
            let rise_m = tile as f64 * self.height_m();
            whole
                .obstacles
                .extend(self.obstacles.iter().map(|bounds| Bounds {
                    y_min_m: bounds.y_min_m + rise_m,
                    y_max_m: bounds.y_max_m + rise_m,
                    ..*bounds
                }));
            whole.bays.extend(self.bays.iter().map(|bay| MapBay {
                pose: raised(&bay.pose, rise_m),
                ..*bay
            }));
            whole.bounds.y_max_m = self.bounds.y_max_m + rise_m;
        }
        whole
    }

    /// From the lower edge to the upper one, metres.
    pub fn height_m(&self) -> f64 {
        self.bounds.y_max_m - self.bounds.y_min_m
    }

    pub(crate) fn space(&self, vehicle: &Vehicle) -> Space {
        self.space_with(vehicle.footprint, &[])
    }

    pub(crate) fn space_around_parked(&self, vehicle: &Vehicle) -> Space {
        let parked: Vec<_> = self.bays.iter().map(|bay| bay.pose).enumerate().collect();
        self.space_with(vehicle.footprint, &parked)
    }

    /// The space of a vehicle that goes between two bays, all others being taken, with half the
    /// clearance: what a planned path keeps everywhere.
    pub(crate) fn space_between(&self, vehicle: &Vehicle, ends: [BayIndex; 2]) -> Space {
        let all = self.bays.iter().map(|bay| bay.pose).enumerate();
        let others: Vec<_> = all.filter(|(bay, _)| !ends.contains(bay)).collect();
        let halved = Self {
            clearance_m: 0.5 * self.clearance_m,
            ..self.clone()
        };
        halved.space_with(vehicle.footprint, &others)
    }

    fn space_with(&self, footprint: Footprint, parked: &[(usize, Pose)]) -> Space {
        let clearance_m = self.clearance_m;
        Space::new(self.bounds, &self.obstacles, parked, footprint, clearance_m)
    }
}

/// The pose so much higher up the map.
pub(crate) fn raised(pose: &Pose, rise_m: f64) -> Pose {
    Pose {
        y_m: pose.y_m + rise_m,
        ..*pose
    }
}

/// What a vehicle which drives through `poses` would touch, and at which pose.
pub(crate) fn first_blocker(space: &Space, poses: &[Pose]) -> Option<(usize, Blocker)> {
    let numbered = poses.iter().enumerate();
    let mut blocked = numbered.filter_map(|(index, pose)| Some((index, space.blocker(pose)?)));
    blocked.next()
}

fn check_rectangle(key: &str, bounds: &Bounds) -> Result<(), ParameterError> {
    let numbers = [
        bounds.x_min_m,
        bounds.x_max_m,
        bounds.y_min_m,
        bounds.y_max_m,
    ];
    if !numbers.iter().all(|number| number.is_finite()) {
        return Err(ParameterError::new(key, "has an edge that is not finite"));
    }
    if bounds.x_min_m >= bounds.x_max_m || bounds.y_min_m >= bounds.y_max_m {
        let problem = format!(
            "from ({}, {}) to ({}, {}) m has no area",
            bounds.x_min_m, bounds.y_min_m, bounds.x_max_m, bounds.y_max_m
        );
        return Err(ParameterError::new(key, problem));
    }
    Ok(())
}
