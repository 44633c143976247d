//! Where a vehicle may stand: ground bounds and obstacles, looked up by a grid. It knows nothing
//! of how a vehicle gets there.

use crate::geometry::{Bounds, Footprint, OrientedBox, Pose, floor_index};
use crate::planner::dubins::Segment;

/// What a vehicle at a pose would touch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Blocker {
    /// The edge of the ground.
    Bounds,
    /// The obstacle with this index.
    Obstacle(usize),
    /// A vehicle parked in the bay with this index.
    ParkedIn(usize),
}

impl core::fmt::Display for Blocker {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Bounds => write!(f, "the edge of the ground"),
            Self::Obstacle(index) => write!(f, "obstacle {index}"),
            Self::ParkedIn(index) => write!(f, "a vehicle parked in bay {index}"),
        }
    }
}

/// The free space of one vehicle, which keeps a clearance from all there is.
#[derive(Debug, Clone)]
pub(crate) struct Space {
    bounds: Bounds,
    footprint: Footprint,
    clearance_m: f64,
    obstacles: Vec<(OrientedBox, Blocker)>,
    cell_m: f64,
    columns: usize,
    /// Per cell, where its obstacles begin in `near`; one more at the end.
    begins: Vec<u32>,
    /// Obstacles that a vehicle with its reference point in the cell could touch.
    near: Vec<u32>,
}

impl Space {
    /// The space of `footprint` between `obstacles`; `parked` are vehicles in bays.
    pub(crate) fn new(
        bounds: Bounds,
        obstacles: &[Bounds],
        parked: &[(usize, Pose)],
        footprint: Footprint,
        clearance_m: f64,
    ) -> Self {
        let upright = |bounds: &Bounds| OrientedBox {
            centre: [
                0.5 * (bounds.x_min_m + bounds.x_max_m),
                0.5 * (bounds.y_min_m + bounds.y_max_m),
            ],
            axis: [1.0, 0.0],
            half_m: [
                0.5 * (bounds.x_max_m - bounds.x_min_m),
                0.5 * (bounds.y_max_m - bounds.y_min_m),
            ],
        };
        let fixed = obstacles.iter().enumerate();
        let fixed = fixed.map(|(index, bounds)| (upright(bounds), Blocker::Obstacle(index)));
        let others = parked.iter();
        let others = others.map(|(bay, pose)| (footprint.at(pose), Blocker::ParkedIn(*bay)));
        let mut space = Self {
            bounds,
            footprint: footprint.grown(clearance_m),
            clearance_m,
            obstacles: fixed.chain(others).collect(),
            cell_m: 1.0,
            columns: 1,
            begins: Vec::new(),
            near: Vec::new(),
        };
        space.index();
        space
    }

    fn index(&mut self) {
        let (width_m, height_m) = extent(&self.bounds);
        let reach_m = self.footprint.radius_m();
        // Fine enough to be selective, coarse enough for at most about 65 536 cells.
        self.cell_m = (0.5 * reach_m).max((width_m * height_m / 65_536.0).sqrt());
        self.columns = floor_index(width_m / self.cell_m) + 1;
        let rows = floor_index(height_m / self.cell_m) + 1;
        let mut cells = vec![Vec::new(); self.columns * rows];
        for (number, (obstacle, _)) in (0_u32..).zip(&self.obstacles) {
            let around = obstacle.bounds();
            let span = |low: f64, high: f64, origin: f64, count: usize| {
                let first = floor_index((low - reach_m - origin) / self.cell_m);
                let last = floor_index((high + reach_m - origin) / self.cell_m);
                first..(last + 1).min(count)
            };
            let (x_min_m, y_min_m) = (self.bounds.x_min_m, self.bounds.y_min_m);
            for row in span(around.y_min_m, around.y_max_m, y_min_m, rows) {
                for column in span(around.x_min_m, around.x_max_m, x_min_m, self.columns) {
                    cells[row * self.columns + column].push(number);
                }
            }
        }
        self.begins.push(0);
        for cell in cells {
            self.near.extend(cell);
            self.begins
                .push(u32::try_from(self.near.len()).expect("fewer than 2^32 entries"));
        }
    }

    /// Largest distance between checked poses at which the vehicle keeps half its clearance
    /// between them as well: any of its points moves, on a curve of this radius, by at most
    /// `way (1 + vehicle radius / turning radius)`, and it is at most half a step from a checked
    /// pose. Without any clearance, a hundredth of the vehicle's length.
    pub(crate) fn step_m(&self, turning_radius_m: f64) -> f64 {
        let lever = 1.0 + self.footprint.radius_m() / turning_radius_m;
        (self.clearance_m / lever).max(0.01 * self.footprint.length_m)
    }

    /// Half the width of the vehicle with its clearance: the least distance of its reference
    /// point from any obstacle.
    pub(crate) fn inscribed_m(&self) -> f64 {
        0.5 * self.footprint.width_m.min(self.footprint.length_m)
    }

    pub(crate) fn bounds(&self) -> &Bounds {
        &self.bounds
    }

    /// True when a vehicle at `pose` is free.
    fn is_free(&self, pose: &Pose) -> bool {
        let centre = [pose.x_m, pose.y_m];
        // Far from everything the heading, and so its sine and cosine, does not matter.
        let reach_m = self.footprint.radius_m();
        let is_inside = centre[0] - reach_m >= self.bounds.x_min_m
            && centre[0] + reach_m <= self.bounds.x_max_m
            && centre[1] - reach_m >= self.bounds.y_min_m
            && centre[1] + reach_m <= self.bounds.y_max_m;
        if is_inside && self.near(centre).next().is_none() {
            return true;
        }
        let covered = self.footprint.at(pose);
        self.bounds.contains(&covered.bounds())
            && !self.near(centre).any(|entry| entry.0.overlaps(&covered))
    }

    /// What a vehicle at `pose`, with its clearance, would touch first; `None` when it is free.
    pub(crate) fn blocker(&self, pose: &Pose) -> Option<Blocker> {
        self.blocker_but(&[], pose)
    }

    /// As [`blocker`](Self::blocker), when vehicles in these bays are not there.
    pub(crate) fn blocker_but(&self, empty: &[usize], pose: &Pose) -> Option<Blocker> {
        let covered = self.footprint.at(pose);
        if !self.bounds.contains(&covered.bounds()) {
            return Some(Blocker::Bounds);
        }
        let is_there = |blocker: &Blocker| match blocker {
            Blocker::ParkedIn(bay) => !empty.contains(bay),
            Blocker::Bounds | Blocker::Obstacle(_) => true,
        };
        let mut near = self.near(covered.centre);
        near.find(|entry| is_there(&entry.1) && entry.0.overlaps(&covered))
            .map(|entry| entry.1)
    }

    /// The obstacles that a vehicle at `centre`, within the bounds, could touch.
    fn near(&self, centre: [f64; 2]) -> impl Iterator<Item = &(OrientedBox, Blocker)> {
        let column = floor_index((centre[0] - self.bounds.x_min_m) / self.cell_m);
        let row = floor_index((centre[1] - self.bounds.y_min_m) / self.cell_m);
        let cell = row * self.columns + column.min(self.columns - 1);
        let range = match (self.begins.get(cell), self.begins.get(cell + 1)) {
            (Some(begin), Some(end)) => *begin as usize..*end as usize,
            _ => 0..0,
        };
        self.near[range]
            .iter()
            .map(|number| &self.obstacles[*number as usize])
    }

    /// True when no obstacle meets the square of this half width around the point.
    pub(crate) fn is_square_clear(&self, centre: [f64; 2], half_m: f64) -> bool {
        let square = OrientedBox {
            centre,
            axis: [1.0, 0.0],
            half_m: [half_m; 2],
        };
        !self.near(centre).any(|entry| entry.0.overlaps(&square))
    }

    /// True when the whole way along `segments` is free, its very end excepted; poses are checked
    /// `step_m` apart.
    pub(crate) fn is_way_free(&self, start: &Pose, segments: &[Segment], step_m: f64) -> bool {
        let mut from = *start;
        for segment in segments {
            let count = floor_index((segment.length_m / step_m).ceil());
            let end = segment.pose_after(&from, segment.length_m);
            let is_straight = segment.curvature_per_m.abs() < 1e-12;
            for step in 0..count {
                let ratio = step as f64 / count as f64;
                let pose = if is_straight {
                    Pose {
                        x_m: from.x_m + ratio * (end.x_m - from.x_m),
                        y_m: from.y_m + ratio * (end.y_m - from.y_m),
                        heading_rad: from.heading_rad,
                    }
                } else {
                    segment.pose_after(&from, ratio * segment.length_m)
                };
                if !self.is_free(&pose) {
                    return false;
                }
            }
            from = end;
        }
        true
    }
}

/// Width and height, metres.
pub(crate) fn extent(bounds: &Bounds) -> (f64, f64) {
    (
        bounds.x_max_m - bounds.x_min_m,
        bounds.y_max_m - bounds.y_min_m,
    )
}
