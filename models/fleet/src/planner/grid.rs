//! How far each point of the ground is from the goal for a point that goes round obstacles: the
//! planner's estimate of what remains. It ignores headings and turning radii.

use core::cmp::Reverse;
use std::collections::BinaryHeap;

use crate::geometry::{Pose, floor_index};
use crate::planner::space::{Space, extent};

/// A uniform grid over the ground.
#[derive(Debug, Clone)]
pub(crate) struct Grid {
    origin: [f64; 2],
    cell_m: f64,
    columns: usize,
    rows: usize,
}

impl Grid {
    pub(crate) fn new(space: &Space, cell_m: f64) -> Self {
        let bounds = space.bounds();
        let (width_m, height_m) = extent(bounds);
        Self {
            origin: [bounds.x_min_m, bounds.y_min_m],
            cell_m,
            columns: floor_index(width_m / cell_m) + 1,
            rows: floor_index(height_m / cell_m) + 1,
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.columns * self.rows
    }

    pub(crate) fn cell_at(&self, x_m: f64, y_m: f64) -> usize {
        let column = floor_index((x_m - self.origin[0]) / self.cell_m).min(self.columns - 1);
        let row = floor_index((y_m - self.origin[1]) / self.cell_m).min(self.rows - 1);
        row * self.columns + column
    }

    fn centre(&self, cell: usize) -> [f64; 2] {
        let (column, row) = (cell % self.columns, cell / self.columns);
        [
            self.origin[0] + (column as f64 + 0.5) * self.cell_m,
            self.origin[1] + (row as f64 + 0.5) * self.cell_m,
        ]
    }

    /// The neighbours of a cell and whether they lie across a corner.
    fn neighbours(&self, cell: usize) -> impl Iterator<Item = (usize, bool)> + use<> {
        let (columns, rows) = (self.columns, self.rows);
        let (column, row) = (cell % columns, cell / columns);
        (0..9).filter(|step| *step != 4).filter_map(move |step| {
            let column = (column + step % 3).checked_sub(1)?;
            let row = (row + step / 3).checked_sub(1)?;
            (column < columns && row < rows).then_some((row * columns + column, step % 2 == 0))
        })
    }
}

/// Per cell, the way to the goal in units of the cell; `u32::MAX` where there is none.
#[derive(Debug, Clone)]
pub(crate) struct Distances {
    grid: Grid,
    remaining: Vec<u32>,
    metres_per_unit: f64,
}

/// Length of a step to a side and across a corner, in the unit of [`Distances`].
const STEPS: [u32; 2] = [70, 99];
/// A way over eight neighbours is at most this much longer than the straight one
/// (`cos(pi / 8)` inverted); so much less is no over-estimate.
const STRAIGHTER: f64 = 0.9238;
/// Cells at most.
const CELLS_MAX: f64 = 1e6;

impl Distances {
    /// The distances to `goal` (Dijkstra 1959).
    pub(crate) fn new(space: &Space, goal: &Pose) -> Self {
        let inscribed_m = space.inscribed_m();
        let (width_m, height_m) = extent(space.bounds());
        let cell_m = inscribed_m.max((width_m * height_m / CELLS_MAX).sqrt());
        let grid = Grid::new(space, cell_m);
        // A cell is closed when its middle is so near an obstacle that no vehicle stands anywhere
        // in it: within the circle of the vehicle's half width less the cell's half diagonal,
        // and so within the square in that circle. Cells too coarse to tell are open.
        let half_diagonal_m = cell_m * core::f64::consts::FRAC_1_SQRT_2;
        let half_m = (inscribed_m - half_diagonal_m) * core::f64::consts::FRAC_1_SQRT_2;
        let is_open: Vec<_> = (0..grid.len())
            .map(|cell| half_m <= 0.0 || space.is_square_clear(grid.centre(cell), half_m))
            .collect();
        let mut remaining = vec![u32::MAX; grid.len()];
        let mut open = BinaryHeap::new();
        let first = grid.cell_at(goal.x_m, goal.y_m);
        remaining[first] = 0;
        open.push(Reverse((0_u32, first)));
        while let Some(Reverse((way, cell))) = open.pop() {
            if way > remaining[cell] {
                continue;
            }
            for (next, is_across) in grid.neighbours(cell) {
                let there = way + STEPS[usize::from(is_across)];
                if is_open[next] && there < remaining[next] {
                    remaining[next] = there;
                    open.push(Reverse((there, next)));
                }
            }
        }
        Self {
            metres_per_unit: cell_m / f64::from(STEPS[0]) * STRAIGHTER,
            grid,
            remaining,
        }
    }

    /// Metres at least, give or take a cell; `None` where no way leads to the goal.
    pub(crate) fn metres(&self, pose: &Pose) -> Option<f64> {
        let units = self.remaining[self.grid.cell_at(pose.x_m, pose.y_m)];
        (units != u32::MAX).then(|| f64::from(units) * self.metres_per_unit)
    }
}
