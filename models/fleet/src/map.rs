//! The ground a fleet drives on: its edge, its obstacles and its bays. What a vehicle can do on
//! it is the planner's business.

use crate::geometry::{Bounds, Footprint, Pose};
use crate::planner::At;
use crate::planner::space::Space;
use crate::scenario::BaySide;
use crate::world::{BayIndex, Vehicle};
use hil_core::case_study::ParameterError;
use hil_core::message::{FNV_OFFSET, fnv1a};

/// Lanes of a gate that a path may be led through.
const LANES: usize = 6;

/// The ground a fleet drives on.
#[derive(Debug, Clone, PartialEq)]
pub struct Map {
    /// Its edge, metres.
    pub bounds: Bounds,
    /// What no vehicle may touch.
    pub obstacles: Vec<Bounds>,
    /// Where vehicles park.
    pub bays: Vec<MapBay>,
    /// Gates across the ground from left to right, each with its lanes. Paths between bays are
    /// led through one lane of each gate, so that traffic spreads over the ground instead of
    /// gathering on the shortest line.
    pub gates: Vec<Vec<Pose>>,
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
            gates: vec![Vec::new(); self.gates.len()],
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
            for (gate, lanes) in whole.gates.iter_mut().zip(&self.gates) {
                gate.extend(lanes.iter().map(|lane| raised(lane, rise_m)));
            }
            whole.bounds.y_max_m = self.bounds.y_max_m + rise_m;
        }
        whole
    }

    /// The lanes for the path between two bays: in each gate one of those about the straight line,
    /// which one being a matter of the bays' numbers.
    pub(crate) fn lanes_between(&self, from: BayIndex, to: BayIndex) -> Vec<Pose> {
        let (start, goal) = (self.bays[from].pose, self.bays[to].pose);
        let lane_of = |(number, lanes): (usize, &Vec<Pose>)| {
            let mixed = [from, to, number]
                .iter()
                .fold(FNV_OFFSET, |hash, value| fnv1a(hash, &value.to_le_bytes()));
            let is_farther = |a: &&Pose, b: &&Pose| {
                let aside_m = |lane: &Pose| {
                    let ratio = (lane.x_m - start.x_m) / (goal.x_m - start.x_m);
                    (lane.y_m - start.towards(&goal, ratio).y_m).abs()
                };
                aside_m(a).total_cmp(&aside_m(b))
            };
            let mut nearest: Vec<_> = lanes.iter().collect();
            nearest.sort_by(is_farther);
            let choice = usize::try_from((mixed >> 32) % LANES as u64).unwrap_or(0);
            nearest
                .get(choice.min(nearest.len() - 1))
                .map(|lane| **lane)
        };
        self.gates.iter().enumerate().filter_map(lane_of).collect()
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

    /// The space around vehicles in all bays with half the clearance: what a planned path keeps
    /// everywhere.
    pub(crate) fn space_with_half_clearance(&self, vehicle: &Vehicle) -> Space {
        let halved = Self {
            clearance_m: 0.5 * self.clearance_m,
            ..self.clone()
        };
        halved.space_around_parked(vehicle)
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
