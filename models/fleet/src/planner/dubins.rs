//! The shortest forward way between two poses with a bounded curvature and no obstacles
//! (Dubins 1957; the six words in the closed form of Shkel and Lumelsky 2001).

use core::f64::consts::TAU;

use crate::geometry::{Pose, wrap_angle};

/// Part of a way with constant curvature.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Segment {
    /// 1/m, positive to the left.
    pub curvature_per_m: f64,
    /// Metres.
    pub length_m: f64,
}

impl Segment {
    /// Where a vehicle at `from` is after `way_m` of this curvature.
    pub fn pose_after(&self, from: &Pose, way_m: f64) -> Pose {
        let turn = self.curvature_per_m * way_m;
        // The chord of an arc has the middle heading and the length 2 r sin(turn / 2).
        let chord_m = if turn.abs() < 1e-9 {
            way_m
        } else {
            2.0 * (0.5 * turn).sin() / self.curvature_per_m
        };
        let (sine, cosine) = (from.heading_rad + 0.5 * turn).sin_cos();
        Pose {
            x_m: from.x_m + chord_m * cosine,
            y_m: from.y_m + chord_m * sine,
            heading_rad: wrap_angle(from.heading_rad + turn),
        }
    }
}

/// A way of three segments.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Dubins {
    pub(crate) segments: [Segment; 3],
    pub(crate) length_m: f64,
}

/// Turn, straight or opposite turn, turn; each in radians (or turning radii, when straight).
type Word = ([f64; 3], [f64; 3]);

/// The shortest of the six words from `start` to `goal`.
pub(crate) fn shortest(start: &Pose, goal: &Pose, turning_radius_m: f64) -> Dubins {
    let words = words_between(start, goal, turning_radius_m);
    let length = |word: &Word| word.1[0] + word.1[1] + word.1[2];
    let mut best = ([0.0; 3], [f64::INFINITY; 3]);
    for word in words.iter().flatten() {
        if length(word) < length(&best) {
            best = *word;
        }
    }
    let segments = core::array::from_fn(|part| Segment {
        curvature_per_m: best.0[part] / turning_radius_m,
        length_m: best.1[part] * turning_radius_m,
    });
    Dubins {
        segments,
        length_m: length(&best) * turning_radius_m,
    }
}

fn words_between(start: &Pose, goal: &Pose, turning_radius_m: f64) -> [Option<Word>; 6] {
    let (x, y) = (goal.x_m - start.x_m, goal.y_m - start.y_m);
    let distance = x.hypot(y) / turning_radius_m;
    let bearing = y.atan2(x);
    let (alpha, beta) = (start.heading_rad - bearing, goal.heading_rad - bearing);
    let ((sa, ca), (sb, cb)) = (alpha.sin_cos(), beta.sin_cos());
    let parallel = (alpha - beta).cos();
    let square = distance * distance;
    let outer = |side: f64| {
        // Both turns to the same side, `side` +1 for left.
        let along = 2.0 + square - 2.0 * parallel + side * 2.0 * distance * (sa - sb);
        (along >= 0.0).then(|| {
            let direction = (side * (cb - ca)).atan2(distance + side * (sa - sb));
            let first = positive(side * (direction - alpha));
            let last = positive(side * (beta - direction));
            ([side, 0.0, side], [first, along.sqrt(), last])
        })
    };
    let inner = |side: f64| {
        // First turn to `side`, last to the other.
        let along = square - 2.0 + 2.0 * parallel + side * 2.0 * distance * (sa + sb);
        (along >= 0.0).then(|| {
            let along = along.sqrt();
            let direction =
                (-side * (ca + cb)).atan2(distance + side * (sa + sb)) - (-2.0 * side).atan2(along);
            let first = positive(side * (direction - alpha));
            let last = positive(side * (direction - beta));
            ([side, 0.0, -side], [first, along, last])
        })
    };
    let three_turns = |side: f64| {
        let cosine = (6.0 - square + 2.0 * parallel - side * 2.0 * distance * (sa - sb)) / 8.0;
        (cosine.abs() <= 1.0).then(|| {
            let middle = TAU - cosine.acos();
            let direction = (-side * (ca - cb)).atan2(distance + side * (sa - sb));
            let first = positive(side * (direction - alpha) + 0.5 * middle);
            let last = positive(side * (beta - alpha) - first + middle);
            ([side, -side, side], [first, middle, last])
        })
    };
    [
        outer(1.0),
        outer(-1.0),
        inner(1.0),
        inner(-1.0),
        three_turns(1.0),
        three_turns(-1.0),
    ]
}

/// The angle in 0..tau; one that is a hair below a full turn is none.
fn positive(angle: f64) -> f64 {
    let turn = angle.rem_euclid(TAU);
    if turn > TAU - 1e-9 { 0.0 } else { turn }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::random::RandomStream;

    fn end(start: &Pose, segments: &[Segment]) -> Pose {
        let step = |pose: Pose, segment: &Segment| segment.pose_after(&pose, segment.length_m);
        segments.iter().fold(*start, step)
    }

    #[test]
    fn every_word_ends_at_the_goal() {
        let mut random = RandomStream::new(3, "dubins");
        let mut seen = [0; 6];
        for _ in 0..20_000 {
            let mut pose = || {
                let at = [random.uniform(), random.uniform(), random.uniform()];
                Pose::new(8.0 * at[0], 8.0 * at[1], TAU * at[2])
            };
            let (start, goal) = (pose(), pose());
            let words = words_between(&start, &goal, 2.0);
            for (index, word) in words.iter().enumerate() {
                let Some((turns, ways)) = word else { continue };
                let segments: [Segment; 3] = core::array::from_fn(|part| Segment {
                    curvature_per_m: turns[part] / 2.0,
                    length_m: ways[part] * 2.0,
                });
                let reached = end(&start, &segments);
                let turned = wrap_angle(reached.heading_rad - goal.heading_rad).abs();
                assert!(
                    reached.distance_m(&goal) < 1e-6 && turned < 1e-6,
                    "word {index} from {start:?} to {goal:?} ends at {reached:?}"
                );
                seen[index] += 1;
            }
        }
        assert!(seen.iter().all(|count| *count > 1000), "{seen:?}");
    }

    #[test]
    fn straight_ahead_is_a_straight_line_and_a_half_circle_is_one() {
        let start = Pose::new(1.0, 2.0, 0.0);
        let ahead = shortest(&start, &Pose::new(31.0, 2.0, 0.0), 4.0);
        assert!((ahead.length_m - 30.0).abs() < 1e-9);
        let back = shortest(&start, &Pose::new(1.0, 10.0, core::f64::consts::PI), 4.0);
        assert!((back.length_m - 4.0 * core::f64::consts::PI).abs() < 1e-9);
    }
}
