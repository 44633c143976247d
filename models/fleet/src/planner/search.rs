//! A* over poses (hybrid A*, Dolgov et al. 2008): states are continuous, one kept per cell of
//! place and heading; it ends with a Dubins way to the very goal. Ties are broken by the order of
//! creation, so equal questions have equal answers.

use core::cmp::{Ordering, Reverse};
use core::f64::consts::TAU;
use std::collections::BinaryHeap;

use crate::geometry::{Pose, floor_index};
use crate::planner::dubins::{Segment, shortest};
use crate::planner::grid::{Distances, Grid};
use crate::planner::space::Space;

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
