//! The ground a fleet drives on: its edge, its obstacles and its bays. What a vehicle can do on
//! it is the planner's business.
//!
//! The two built-in maps are our own, laid out by rule: a hall with racks and a yard with container
//! blocks; the seed paper shows its maps only as pictures.

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
            if !bay.pose.is_finite() {
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

/// Bays on each side.
pub(crate) const BAYS_PER_SIDE: usize = 7;

/// Columns of equal blocks, every other column shifted by half a gap.
struct Blocks {
    /// Middle of the first column and from column to column, metres.
    column_m: (f64, f64),
    column_count: usize,
    /// From block to block within a column, metres.
    pitch_m: f64,
    /// Width and height of a block, metres.
    size_m: [f64; 2],
}

impl Blocks {
    /// The blocks that fit below `height_m` with `edge_m` to spare.
    fn within(&self, height_m: f64, edge_m: f64) -> Vec<Bounds> {
        let mut blocks = Vec::new();
        for column in 0..self.column_count {
            let x_m = self.column_m.0 + column as f64 * self.column_m.1;
            // Odd columns have a block in the middle, even ones a lane.
            let shift = if column.is_multiple_of(2) { 0.5 } else { 0.0 };
            for row in -20..20_i32 {
                let y_m = 0.5 * height_m + (f64::from(row) + shift) * self.pitch_m;
                let block = Bounds {
                    x_min_m: x_m - 0.5 * self.size_m[0],
                    x_max_m: x_m + 0.5 * self.size_m[0],
                    y_min_m: y_m - 0.5 * self.size_m[1],
                    y_max_m: y_m + 0.5 * self.size_m[1],
                };
                if block.y_min_m >= edge_m && block.y_max_m <= height_m - edge_m {
                    blocks.push(block);
                }
            }
        }
        blocks
    }

    /// Lanes within the gaps of every other column from `first_column` on, `aside_m` to both sides
    /// of each gap's middle.
    fn gates(&self, first_column: usize, height_m: f64, aside_m: f64) -> Vec<Vec<Pose>> {
        let shift = if first_column.is_multiple_of(2) {
            0.0
        } else {
            0.5
        };
        // A lane keeps from the edge what it keeps from the blocks beside it.
        let edge_m = 0.5 * (self.pitch_m - self.size_m[1]) - aside_m;
        let gate = |column: usize| {
            let x_m = self.column_m.0 + column as f64 * self.column_m.1;
            let gaps = (-20..20_i32)
                .map(|row| 0.5 * height_m + (f64::from(row) + shift) * self.pitch_m)
                .flat_map(|y_m| [y_m - aside_m, y_m + aside_m]);
            gaps.filter(|y_m| *y_m >= edge_m && *y_m <= height_m - edge_m)
                .map(|y_m| Pose::new(x_m, y_m, 0.0))
                .collect()
        };
        let columns = (first_column..self.column_count).step_by(2);
        columns.map(gate).collect()
    }
}

/// Left bays from bottom to top, then right bays from top to bottom: the shuttle line of a bay
/// crosses the hall, so every two lines cross.
fn bays(x_m: [f64; 2], middle_m: f64, pitch_m: f64) -> Vec<MapBay> {
    let offset_m = |bay: usize| (bay as f64 - 3.0) * pitch_m;
    let left = (0..BAYS_PER_SIDE).map(|bay| MapBay {
        pose: Pose::new(x_m[0], middle_m + offset_m(bay), 0.0),
        side: BaySide::Left,
    });
    let right = (0..BAYS_PER_SIDE).map(|bay| MapBay {
        pose: Pose::new(x_m[1], middle_m - offset_m(bay), 0.0),
        side: BaySide::Right,
    });
    left.chain(right).collect()
}

fn ground(width_m: f64, height_m: f64) -> Bounds {
    Bounds {
        x_min_m: 0.0,
        x_max_m: width_m,
        y_min_m: 0.0,
        y_max_m: height_m,
    }
}

/// A hall of 80 m x 44 m with racks.
pub(crate) fn warehouse(clearance_m: f64) -> Map {
    let racks = Blocks {
        column_m: (18.0, 11.0),
        column_count: 5,
        pitch_m: 7.0,
        size_m: [4.5, 2.6],
    };
    Map {
        bounds: ground(80.0, 44.0),
        obstacles: racks.within(44.0, 2.0),
        bays: bays([2.5, 77.5], 22.0, 5.6),
        gates: racks.gates(0, 44.0, 1.0),
        clearance_m,
    }
}

/// A yard of 400 m x 220 m with container blocks.
pub(crate) fn harbor(clearance_m: f64) -> Map {
    let blocks = Blocks {
        column_m: (90.0, 55.0),
        column_count: 5,
        pitch_m: 42.0,
        size_m: [24.0, 13.0],
    };
    Map {
        bounds: ground(400.0, 220.0),
        obstacles: blocks.within(220.0, 12.0),
        bays: bays([14.0, 386.0], 110.0, 29.0),
        gates: blocks.gates(1, 220.0, 7.0),
        clearance_m,
    }
}
