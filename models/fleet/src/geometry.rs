//! Plane geometry of vehicles: poses, rectangular footprints and their overlap. Map frame, metres
//! and radians. It knows neither paths nor maps.

use hil_core::options::ANY_NUMBER;
use serde::{Deserialize, Serialize};

hil_core::options! {
    /// Where a vehicle's reference point is and where its front points, in the map frame.
    #[derive(Copy)]
    pub struct Pose {
        /// Metres.
        x_m: f64, in ANY_NUMBER;
        /// Metres.
        y_m: f64, in ANY_NUMBER;
        /// Radians from the x axis, counter-clockwise.
        heading_rad: f64, in ANY_NUMBER;
    }
}

impl Pose {
    /// The pose with these coordinates.
    pub const fn new(x_m: f64, y_m: f64, heading_rad: f64) -> Self {
        Self {
            x_m,
            y_m,
            heading_rad,
        }
    }

    /// True without NaN or infinity.
    pub fn is_finite(&self) -> bool {
        self.x_m.is_finite() && self.y_m.is_finite() && self.heading_rad.is_finite()
    }

    /// Distance between the reference points.
    pub fn distance_m(&self, other: &Self) -> f64 {
        (self.x_m - other.x_m).hypot(self.y_m - other.y_m)
    }

    /// The pose `ratio` (0..=1) of the way to `other`, turning the shorter way round.
    #[must_use]
    pub fn towards(&self, other: &Self, ratio: f64) -> Self {
        let turn = wrap_angle(other.heading_rad - self.heading_rad);
        Self {
            x_m: self.x_m + ratio * (other.x_m - self.x_m),
            y_m: self.y_m + ratio * (other.y_m - self.y_m),
            heading_rad: wrap_angle(self.heading_rad + ratio * turn),
        }
    }
}

/// The angle in -pi..=pi that points the same way.
pub fn wrap_angle(angle_rad: f64) -> f64 {
    use core::f64::consts::{PI, TAU};
    // Most angles need no wrapping, and a remainder costs more than all else that is done to them.
    if (-PI..=PI).contains(&angle_rad) {
        return angle_rad;
    }
    let wrapped = (angle_rad + PI).rem_euclid(TAU) - PI;
    if wrapped < -PI {
        wrapped + TAU
    } else {
        wrapped
    }
}

/// The whole number at or below `value`, as an index; negative values and NaN give 0.
#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "saturating float casts are what an index wants"
)]
pub(crate) fn floor_index(value: f64) -> usize {
    // The cast cuts towards zero, which for all but negative values is down.
    value as usize
}

/// A rectangular vehicle, its reference point in the middle.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Footprint {
    /// Along the heading, metres.
    pub length_m: f64,
    /// Across, metres.
    pub width_m: f64,
}

impl Footprint {
    /// The ground the vehicle covers at `pose`.
    pub fn at(&self, pose: &Pose) -> OrientedBox {
        let (sine, cosine) = pose.heading_rad.sin_cos();
        OrientedBox {
            centre: [pose.x_m, pose.y_m],
            axis: [cosine, sine],
            half_m: [0.5 * self.length_m, 0.5 * self.width_m],
        }
    }

    /// The footprint with `clearance_m` more on each side.
    #[must_use]
    pub fn grown(&self, clearance_m: f64) -> Self {
        Self {
            length_m: self.length_m + 2.0 * clearance_m,
            width_m: self.width_m + 2.0 * clearance_m,
        }
    }

    /// The larger of length and width: `max dimension` of the original's merge rule.
    pub fn size_max_m(&self) -> f64 {
        self.length_m.max(self.width_m)
    }

    /// From the reference point to a corner.
    pub fn radius_m(&self) -> f64 {
        0.5 * self.length_m.hypot(self.width_m)
    }
}

/// A rectangle in the map frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrientedBox {
    /// Centre, metres.
    pub centre: [f64; 2],
    /// Unit vector along the length.
    pub axis: [f64; 2],
    /// Half of length and width, metres.
    pub half_m: [f64; 2],
}

impl OrientedBox {
    /// True when the two share a point of positive depth; touching is no overlap. Separating
    /// axes (Gottschalk, Lin and Manocha 1996), in the plane.
    pub fn overlaps(&self, other: &Self) -> bool {
        let gap_m = self.gaps_m(other);
        gap_m(self, other) < 0.0 && gap_m(other, self) < 0.0
    }

    /// The largest gap between the two along any of their sides: at least 0 when they are apart,
    /// and then no more than their distance; below 0 when they overlap, and then by as much as
    /// one must move to leave the other.
    pub fn gap_m(&self, other: &Self) -> f64 {
        let gap_m = self.gaps_m(other);
        gap_m(self, other).max(gap_m(other, self))
    }

    /// The larger gap between the two along the sides of the one given first.
    fn gaps_m(&self, other: &Self) -> impl Fn(&Self, &Self) -> f64 {
        let offset = [
            other.centre[0] - self.centre[0],
            other.centre[1] - self.centre[1],
        ];
        let cosine = (self.axis[0] * other.axis[0] + self.axis[1] * other.axis[1]).abs();
        let sine = (self.axis[0] * other.axis[1] - self.axis[1] * other.axis[0]).abs();
        move |from, to| {
            let along = (offset[0] * from.axis[0] + offset[1] * from.axis[1]).abs();
            let across = (offset[1] * from.axis[0] - offset[0] * from.axis[1]).abs();
            let along_m = along - (from.half_m[0] + to.half_m[0] * cosine + to.half_m[1] * sine);
            let across_m = across - (from.half_m[1] + to.half_m[0] * sine + to.half_m[1] * cosine);
            along_m.max(across_m)
        }
    }

    /// The corners, counter-clockwise from the front left.
    pub fn corners(&self) -> [[f64; 2]; 4] {
        let [cx, cy] = self.centre;
        let [ax, ay] = self.axis;
        let [length, width] = self.half_m;
        [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)].map(|(along, across)| {
            let (along, across) = (along * length, across * width);
            [cx + along * ax - across * ay, cy + along * ay + across * ax]
        })
    }

    /// The smallest upright rectangle around it.
    pub fn bounds(&self) -> Bounds {
        let reach_x = self.half_m[0] * self.axis[0].abs() + self.half_m[1] * self.axis[1].abs();
        let reach_y = self.half_m[0] * self.axis[1].abs() + self.half_m[1] * self.axis[0].abs();
        Bounds {
            x_min_m: self.centre[0] - reach_x,
            x_max_m: self.centre[0] + reach_x,
            y_min_m: self.centre[1] - reach_y,
            y_max_m: self.centre[1] + reach_y,
        }
    }

    /// Smallest distance between the two; 0 when they touch or overlap.
    pub fn distance_m(&self, other: &Self) -> f64 {
        if self.overlaps(other) {
            return 0.0;
        }
        let from_corners = |corners: [[f64; 2]; 4], to: &Self| {
            corners
                .iter()
                .map(|corner| to.distance_to_point_m(*corner))
                .fold(f64::INFINITY, f64::min)
        };
        from_corners(self.corners(), other).min(from_corners(other.corners(), self))
    }

    fn distance_to_point_m(&self, point: [f64; 2]) -> f64 {
        let offset = [point[0] - self.centre[0], point[1] - self.centre[1]];
        let along = (offset[0] * self.axis[0] + offset[1] * self.axis[1]).abs();
        let across = (offset[1] * self.axis[0] - offset[0] * self.axis[1]).abs();
        let outside = |distance: f64, half: f64| (distance - half).max(0.0);
        outside(along, self.half_m[0]).hypot(outside(across, self.half_m[1]))
    }
}

hil_core::options! {
    /// An upright rectangle in the map frame, metres.
    #[derive(Copy)]
    pub struct Bounds {
        /// Left.
        x_min_m: f64, in ANY_NUMBER;
        /// Right.
        x_max_m: f64, in ANY_NUMBER;
        /// Bottom.
        y_min_m: f64, in ANY_NUMBER;
        /// Top.
        y_max_m: f64, in ANY_NUMBER;
    }
}

impl Bounds {
    /// True when the two share a point.
    pub fn meets(&self, other: &Self) -> bool {
        self.x_min_m <= other.x_max_m
            && other.x_min_m <= self.x_max_m
            && self.y_min_m <= other.y_max_m
            && other.y_min_m <= self.y_max_m
    }

    /// The smallest rectangle around both.
    #[must_use]
    pub fn joined(&self, other: &Self) -> Self {
        Self {
            x_min_m: self.x_min_m.min(other.x_min_m),
            x_max_m: self.x_max_m.max(other.x_max_m),
            y_min_m: self.y_min_m.min(other.y_min_m),
            y_max_m: self.y_max_m.max(other.y_max_m),
        }
    }

    /// True when `other` lies wholly within.
    pub fn contains(&self, other: &Self) -> bool {
        self.x_min_m <= other.x_min_m
            && other.x_max_m <= self.x_max_m
            && self.y_min_m <= other.y_min_m
            && other.y_max_m <= self.y_max_m
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::random::RandomStream;

    const CAR: Footprint = Footprint {
        length_m: 4.0,
        width_m: 2.0,
    };

    #[test]
    fn boxes_that_touch_do_not_overlap_and_boxes_that_cut_do() {
        let here = CAR.at(&Pose::new(0.0, 0.0, 0.0));
        let check = |x, y, heading, expected| {
            let there = CAR.at(&Pose::new(x, y, heading));
            assert_eq!(here.overlaps(&there), expected, "{x} {y} {heading}");
            assert_eq!(there.overlaps(&here), expected);
        };
        check(4.0, 0.0, 0.0, false);
        check(3.999, 0.0, 0.0, true);
        check(0.0, 3.1, core::f64::consts::FRAC_PI_2, false);
        check(0.0, 2.9, core::f64::consts::FRAC_PI_2, true);
        check(3.0, 2.2, core::f64::consts::FRAC_PI_4, true);
        check(4.0, 3.0, -core::f64::consts::FRAC_PI_4, false);
    }

    #[test]
    fn overlap_agrees_with_distance_for_random_boxes() {
        let mut random = RandomStream::new(5, "boxes");
        let mut overlaps = 0;
        for _ in 0..20_000 {
            let mut pose = || {
                let at = [random.uniform(), random.uniform(), random.uniform()];
                Pose::new(8.0 * at[0], 8.0 * at[1], 6.3 * at[2])
            };
            let (a, b) = (CAR.at(&pose()), CAR.at(&pose()));
            overlaps += u32::from(a.overlaps(&b));
            assert_eq!(a.overlaps(&b), a.distance_m(&b) <= 0.0);
            assert_eq!(a.overlaps(&b), a.gap_m(&b) < 0.0);
            assert!(a.gap_m(&b) <= a.distance_m(&b) + 1e-12);
            assert!(!a.overlaps(&b) || a.bounds().meets(&b.bounds()));
        }
        assert!(overlaps > 1000);
    }

    #[test]
    fn a_pose_turns_the_shorter_way() {
        let middle = Pose::new(0.0, 0.0, 3.0).towards(&Pose::new(2.0, 0.0, -3.0), 0.5);
        assert!((middle.heading_rad.abs() - core::f64::consts::PI).abs() < 1e-12);
        assert!((middle.x_m - 1.0).abs() < 1e-12);
    }
}
