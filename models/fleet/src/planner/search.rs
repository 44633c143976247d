//! A* over poses (hybrid A*, Dolgov et al. 2008): states are continuous, one kept per cell of
//! place and heading; it ends with a Dubins way to the very goal. Ties are broken by the order of
//! creation, so equal questions have equal answers.

use core::cmp::{Ordering, Reverse};
use core::f64::consts::TAU;
use std::collections::BinaryHeap;

use crate::geometry::{Pose, floor_index};
use crate::planner::dubins::{Segment, shortest};
use crate::planner::space::{Space, extent};

/// Number of heading cells in a full turn.
const HEADINGS: usize = 48;
/// Curvatures tried at each state, of the largest one.
const CURVATURES: [f64; 5] = [0.0, 0.5, -0.5, 1.0, -1.0];
/// A step leaves its cell: more than its diagonal.
const STEP_CELLS: f64 = 1.5;
/// What a metre of full curvature costs more than a straight one: straight ways first.
const TURN_COST: f64 = 0.02;

/// How much the way that remains counts against the way so far (weighted A*, Pohl 1970). Above 1
/// the search goes straighter for the goal; what it loses in length is won back by shortening.
const GREED: f64 = 1.25;

/// A state reached.
#[derive(Debug, Clone, Copy)]
struct Reached {
    pose: Pose,
    cost: f64,
    parent: u32,
    segment: Segment,
}

/// An entry of the open list: cheapest first, oldest first among equals.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Open {
    estimate: f64,
    number: u32,
}

impl Eq for Open {}

impl Ord for Open {
    fn cmp(&self, other: &Self) -> Ordering {
        let by_cost = self.estimate.total_cmp(&other.estimate);
        by_cost.then(self.number.cmp(&other.number))
    }
}

impl PartialOrd for Open {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// What a search found.
#[derive(Debug, Clone)]
pub(crate) struct Found {
    /// The way; `None` when there is none.
    pub(crate) segments: Option<Vec<Segment>>,
    /// States expanded.
    pub(crate) expanded_count: u64,
}

/// The search's memory, kept from plan to plan.
#[derive(Debug, Clone)]
pub(crate) struct Search {
    grid: Grid,
    turning_radius_m: f64,
    step_m: f64,
    check_m: f64,
    /// Per cell of place and heading: cheapest cost so far.
    costs: Vec<f64>,
    reached: Vec<Reached>,
    open: BinaryHeap<Reverse<Open>>,
}

impl Search {
    /// A search over cells of `cell_m`, which is to be no more than the turning radius.
    pub(crate) fn new(space: &Space, cell_m: f64, turning_radius_m: f64) -> Self {
        let grid = Grid::new(space, cell_m);
        let costs = vec![f64::INFINITY; grid.len() * HEADINGS];
        Self {
            grid,
            turning_radius_m,
            step_m: STEP_CELLS * cell_m,
            check_m: space.step_m(turning_radius_m),
            costs,
            reached: Vec::new(),
            open: BinaryHeap::new(),
        }
    }

    /// A way from `start` to `goal`, both free, expanding at most `expanded_max` states.
    pub(crate) fn run(
        &mut self,
        space: &Space,
        distances: &Distances,
        start: &Pose,
        goal: &Pose,
        expanded_max: u64,
    ) -> Found {
        self.costs.fill(f64::INFINITY);
        self.reached.clear();
        self.open.clear();
        let stand = Segment {
            curvature_per_m: 0.0,
            length_m: 0.0,
        };
        self.offer(distances, goal, *start, stand, 0, 0.0);
        let mut expanded_count = 0;
        while let Some(Reverse(open)) = self.open.pop() {
            let here = self.reached[open.number as usize];
            if here.cost > self.costs[self.state_at(&here.pose)] || expanded_count == expanded_max {
                continue;
            }
            expanded_count += 1;
            if is_home_tried(expanded_count) {
                let home = shortest(&here.pose, goal, self.turning_radius_m);
                if space.is_way_free(&here.pose, &home.segments, self.check_m) {
                    let mut segments = self.way_to(open.number);
                    segments.extend(home.segments);
                    return Found {
                        segments: Some(segments),
                        expanded_count,
                    };
                }
            }
            for ratio in CURVATURES {
                let segment = Segment {
                    curvature_per_m: ratio / self.turning_radius_m,
                    length_m: self.step_m,
                };
                let pose = segment.pose_after(&here.pose, segment.length_m);
                let cost = here.cost + segment.length_m * (1.0 + TURN_COST * ratio.abs());
                if !is_within(space, &pose)
                    || cost >= self.costs[self.state_at(&pose)]
                    || !space.is_way_free(&here.pose, &[segment], self.check_m)
                {
                    continue;
                }
                self.offer(distances, goal, pose, segment, open.number, cost);
            }
        }
        Found {
            segments: None,
            expanded_count,
        }
    }

    fn offer(
        &mut self,
        distances: &Distances,
        goal: &Pose,
        pose: Pose,
        segment: Segment,
        parent: u32,
        cost: f64,
    ) {
        let Some(around_m) = distances.metres(&pose) else {
            return;
        };
        let state = self.state_at(&pose);
        self.costs[state] = cost;
        let number = u32::try_from(self.reached.len()).expect("fewer than 2^32 states");
        let direct_m = shortest(&pose, goal, self.turning_radius_m).length_m;
        self.reached.push(Reached {
            pose,
            cost,
            parent,
            segment,
        });
        self.open.push(Reverse(Open {
            estimate: cost + GREED * direct_m.max(around_m),
            number,
        }));
    }

    fn state_at(&self, pose: &Pose) -> usize {
        let turn = (pose.heading_rad / TAU).rem_euclid(1.0) * HEADINGS as f64;
        let heading = (floor_index(turn + 0.5)) % HEADINGS;
        self.grid.cell_at(pose.x_m, pose.y_m) * HEADINGS + heading
    }

    fn way_to(&self, mut number: u32) -> Vec<Segment> {
        let mut segments = Vec::new();
        while number != 0 {
            let reached = &self.reached[number as usize];
            segments.push(reached.segment);
            number = reached.parent;
        }
        segments.reverse();
        segments
    }
}

/// Whether the direct way home is tried from this state: from every early one, from some of the
/// many states of a search that has not found it soon.
fn is_home_tried(expanded_count: u64) -> bool {
    expanded_count <= 1000 || expanded_count.is_multiple_of(8)
}

fn is_within(space: &Space, pose: &Pose) -> bool {
    let bounds = space.bounds();
    (bounds.x_min_m..=bounds.x_max_m).contains(&pose.x_m)
        && (bounds.y_min_m..=bounds.y_max_m).contains(&pose.y_m)
}

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
