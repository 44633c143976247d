//! The two built-in maps, laid out by rule: a hall with racks and a yard with container blocks.
//! Both are our own; the seed paper shows its maps only as pictures.

use crate::geometry::{Bounds, Pose};
use crate::map::{Map, MapBay};
use crate::scenario::BaySide;

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
