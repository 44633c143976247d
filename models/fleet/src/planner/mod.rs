//! Plans paths on a map at run time: for a vehicle with a smallest turning radius, driving
//! forwards, around obstacles, from any start to any goal pose. It reads no clock; what a plan
//! cost is counted in expanded states.
//!
//! A search over poses finds a way, which is then shortened.

pub(crate) mod dubins;
mod search;
pub(crate) mod space;

use crate::geometry::{Pose, floor_index};
pub use crate::planner::dubins::Segment;
use crate::planner::dubins::shortest;
use crate::planner::search::{Distances, Search};
pub use crate::planner::space::Blocker;
use crate::planner::space::{Space, extent};

/// States a plan may expand before it gives up.
pub const EXPANDED_MAX: u64 = 200_000;
/// Cells of place a search may have: with their headings, 77 MB.
const CELLS_MAX: f64 = 200_000.0;

/// Goals a planner remembers the surroundings of.
const GOALS_MAX: usize = 64;

/// A way from start to goal: arcs and straight lines, none curved more than the turning radius
/// allows.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    start: Pose,
    goal: Pose,
    segments: Vec<Segment>,
    pub(crate) expanded_count: u64,
}

/// Why there is no plan.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// The turning radius is not a positive number.
    #[error("turning radius {turning_radius_m} m is not above 0")]
    TurningRadius {
        /// What was asked.
        turning_radius_m: f64,
    },
    /// The ground has more cells than a search has memory for.
    #[error(
        "a ground of {width_m} m x {height_m} m is too large to plan with a turning radius of \
         {turning_radius_m} m"
    )]
    TooLarge {
        /// Metres.
        width_m: f64,
        /// Metres.
        height_m: f64,
        /// Metres.
        turning_radius_m: f64,
    },
    /// A coordinate of start or goal is NaN or infinite.
    #[error("a path from {} to {} cannot be: not finite", At(.start), At(.goal))]
    NotFinite {
        /// Where the path was to begin.
        start: Pose,
        /// Where it was to end.
        goal: Pose,
    },
    /// The vehicle cannot stand at the start.
    #[error("start {} is blocked by {blocker}", At(.start))]
    StartBlocked {
        /// Where the path was to begin.
        start: Pose,
        /// What is there.
        blocker: Blocker,
    },
    /// The vehicle cannot stand at the goal.
    #[error("goal {} is blocked by {blocker}", At(.goal))]
    GoalBlocked {
        /// Where the path was to end.
        goal: Pose,
        /// What is there.
        blocker: Blocker,
    },
    /// No way was found.
    #[error(
        "no path from {} to {} fits the free space ({expanded_count} states expanded, \
         at most {EXPANDED_MAX})",
        At(.start),
        At(.goal)
    )]
    NoPath {
        /// Where the path was to begin.
        start: Pose,
        /// Where it was to end.
        goal: Pose,
        /// States expanded before giving up.
        expanded_count: u64,
    },
}

/// How messages name a pose.
pub(crate) struct At<'a>(pub(crate) &'a Pose);

impl core::fmt::Display for At<'_> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let pose = self.0;
        write!(
            f,
            "({:.3} m, {:.3} m, {:.3} rad)",
            pose.x_m, pose.y_m, pose.heading_rad
        )
    }
}

impl Plan {
    /// Poses along the way, at most `spacing_m` apart, from the very start to the very goal.
    pub fn poses(&self, spacing_m: f64) -> Vec<Pose> {
        let mut poses = vec![self.start];
        let mut from = self.start;
        for segment in &self.segments {
            let count = floor_index((segment.length_m / spacing_m).ceil().max(1.0));
            poses.extend((1..=count).map(|step| {
                segment.pose_after(&from, segment.length_m * step as f64 / count as f64)
            }));
            from = segment.pose_after(&from, segment.length_m);
        }
        // The sum of many arcs ends a rounding error beside the goal.
        if let Some(last) = poses.last_mut() {
            *last = self.goal;
        }
        poses
    }
}

/// Plans path after path on one map, faster than each alone when goals repeat.
#[derive(Debug, Clone)]
pub struct Planner {
    space: Space,
    search: Search,
    turning_radius_m: f64,
    /// What is known of recent goals, the latest last.
    distances: Vec<(Pose, Distances)>,
}

impl Planner {
    /// A planner for a free space.
    ///
    /// # Errors
    /// When the turning radius is no positive number or small beyond reason for the ground.
    pub(crate) fn new(space: Space, turning_radius_m: f64) -> Result<Self, PlanError> {
        if !(turning_radius_m > 0.0 && turning_radius_m.is_finite()) {
            return Err(PlanError::TurningRadius { turning_radius_m });
        }
        let (width_m, height_m) = extent(space.bounds());
        let cell_m = (0.25 * turning_radius_m).max((width_m * height_m / CELLS_MAX).sqrt());
        // A step longer than the radius would turn past headings on the way.
        if cell_m > 0.5 * turning_radius_m {
            return Err(PlanError::TooLarge {
                width_m,
                height_m,
                turning_radius_m,
            });
        }
        Ok(Self {
            search: Search::new(&space, cell_m, turning_radius_m),
            space,
            turning_radius_m,
            distances: Vec::new(),
        })
    }

    /// The path from `start` to `goal`.
    ///
    /// # Errors
    /// When there is none; see [`PlanError`].
    pub fn plan(&mut self, start: &Pose, goal: &Pose) -> Result<Plan, PlanError> {
        let (start, goal) = (*start, *goal);
        if !(start.is_finite() && goal.is_finite()) {
            return Err(PlanError::NotFinite { start, goal });
        }
        if let Some(blocker) = self.space.blocker(&start) {
            return Err(PlanError::StartBlocked { start, blocker });
        }
        if let Some(blocker) = self.space.blocker(&goal) {
            return Err(PlanError::GoalBlocked { goal, blocker });
        }
        let known = self.distances.iter().position(|(known, _)| *known == goal);
        let latest = match known {
            Some(index) => self.distances.remove(index),
            None => (goal, Distances::new(&self.space, &goal)),
        };
        let found = self
            .search
            .run(&self.space, &latest.1, &start, &goal, EXPANDED_MAX);
        self.distances.push(latest);
        if self.distances.len() > GOALS_MAX {
            self.distances.remove(0);
        }
        let expanded_count = found.expanded_count;
        let Some(segments) = found.segments else {
            return Err(PlanError::NoPath {
                start,
                goal,
                expanded_count,
            });
        };
        let segments = shortened(&self.space, &start, &goal, &segments, self.turning_radius_m);
        Ok(Plan {
            start,
            goal,
            segments: joined(segments),
            expanded_count,
        })
    }
}

/// Neighbouring segments of equal curvature as one, empty ones left out.
fn joined(segments: Vec<Segment>) -> Vec<Segment> {
    let mut joined: Vec<Segment> = Vec::with_capacity(segments.len());
    for segment in segments.into_iter().filter(|part| part.length_m > 1e-9) {
        match joined.last_mut() {
            Some(last) if (last.curvature_per_m - segment.curvature_per_m).abs() < 1e-12 => {
                last.length_m += segment.length_m;
            }
            _ => joined.push(segment),
        }
    }
    joined
}

/// Poses at which a way may be cut, at most: the work grows with the square.
const ANCHORS_MAX: f64 = 96.0;

/// The shortest free chain of Dubins ways between poses of the way, which begins at `start`.
pub(crate) fn shortened(
    space: &Space,
    start: &Pose,
    goal: &Pose,
    segments: &[Segment],
    turning_radius_m: f64,
) -> Vec<Segment> {
    let anchors = anchors(start, segments, goal, 0.25 * turning_radius_m);
    let step_m = space.step_m(turning_radius_m);
    let mut best: Vec<(f64, usize, Vec<Segment>)> = vec![(0.0, 0, Vec::new())];
    for (index, (pose, along)) in anchors.iter().enumerate().skip(1) {
        // The way as it was is always there; it counts from the anchor before.
        let before = &best[index - 1];
        let kept_m: f64 = along.iter().map(|segment| segment.length_m).sum();
        let mut found = (before.0 + kept_m, index - 1, along.clone());
        for (from, (cut, _)) in anchors[..index].iter().enumerate() {
            // Cheap bound first: nothing is shorter than straight.
            if best[from].0 + cut.distance_m(pose) >= found.0 - 1e-9 {
                continue;
            }
            let way = shortest(cut, pose, turning_radius_m);
            let length_m = best[from].0 + way.length_m;
            if length_m < found.0 - 1e-9 && space.is_way_free(cut, &way.segments, step_m) {
                found = (length_m, from, way.segments.to_vec());
            }
        }
        best.push(found);
    }
    let (mut index, mut parts) = (best.len() - 1, Vec::new());
    while index > 0 {
        parts.push(&best[index].2);
        index = best[index].1;
    }
    parts.into_iter().rev().flatten().copied().collect()
}

/// Poses along the way, each with the segments that lead to it from the one before.
fn anchors(
    start: &Pose,
    segments: &[Segment],
    goal: &Pose,
    spacing_m: f64,
) -> Vec<(Pose, Vec<Segment>)> {
    let length_m: f64 = segments.iter().map(|segment| segment.length_m).sum();
    let spacing_m = spacing_m.max(length_m / ANCHORS_MAX);
    let mut anchors = vec![(*start, Vec::new())];
    let mut from = *start;
    for segment in segments.iter().filter(|segment| segment.length_m > 1e-9) {
        let count = floor_index((segment.length_m / spacing_m).ceil().max(1.0));
        for _ in 0..count {
            let part = Segment {
                length_m: segment.length_m / count as f64,
                ..*segment
            };
            from = part.pose_after(&from, part.length_m);
            anchors.push((from, vec![part]));
        }
    }
    // The sum of many arcs ends a rounding error beside the goal; the last cut is the goal.
    if let Some(last) = anchors.last_mut() {
        last.0 = *goal;
    }
    anchors
}

#[cfg(test)]
mod tests;
