//! Makes a way shorter: picks, among the poses along it, those whose joining by free Dubins ways
//! is shortest. The result is as free and as little curved as the way was.

use crate::geometry::{Pose, floor_index};
use crate::planner::dubins::{Segment, shortest};
use crate::planner::space::Space;

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
