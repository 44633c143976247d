//! Positions, orientations and poses as plain arrays. Not a general linear algebra: only what a
//! serial arm and a skeleton need.
//!
//! Plain arrays because a [`Pose`] is part of messages, and because the inner loops of an hour's
//! run must stay quick in unoptimised test builds, where generic matrix code is not.

use bytemuck::{Pod, Zeroable};

/// A position or direction, `[x, y, z]`.
pub type Vector3 = [f64; 3];

/// A rotation as three column vectors: the images of the x, y and z axes.
pub type Columns = [Vector3; 3];

/// The sum of two vectors.
pub fn add(a: Vector3, b: Vector3) -> Vector3 {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// `a - b`.
pub fn subtract(a: Vector3, b: Vector3) -> Vector3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// `a` times `factor`.
pub fn scaled(a: Vector3, factor: f64) -> Vector3 {
    [a[0] * factor, a[1] * factor, a[2] * factor]
}

/// The scalar product.
pub fn dot(a: Vector3, b: Vector3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// The vector product.
pub fn cross(a: Vector3, b: Vector3) -> Vector3 {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

/// The Euclidean length.
pub fn length(a: Vector3) -> f64 {
    dot(a, a).sqrt()
}

/// A rotation as a unit quaternion, `[w, x, y, z]` (Hamilton convention, active).
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Orientation {
    /// Scalar part first; of unit length in every valid message.
    pub wxyz: [f64; 4],
}

impl Orientation {
    /// No rotation.
    pub const IDENTITY: Self = Self {
        wxyz: [1.0, 0.0, 0.0, 0.0],
    };

    /// The rotation by `angle_rad` about coordinate axis 0 (x), 1 (y) or 2 (z).
    ///
    /// # Panics
    /// When `axis` is above 2.
    pub fn about_axis(axis: usize, angle_rad: f64) -> Self {
        assert!(axis < 3, "axis {axis} is outside 0..=2");
        let (sine, cosine) = (0.5 * angle_rad).sin_cos();
        let mut wxyz = [cosine, 0.0, 0.0, 0.0];
        wxyz[axis + 1] = sine;
        Self { wxyz }
    }

    /// The rotation about `vector` by its length in radians.
    pub fn from_rotation_vector(vector: Vector3) -> Self {
        let angle = length(vector);
        let (sine, cosine) = (0.5 * angle).sin_cos();
        // sin(x/2)/x tends to 1/2; below 1e-8 the next term is beyond double precision.
        let factor = if angle < 1e-8 { 0.5 } else { sine / angle };
        Self {
            wxyz: [
                cosine,
                vector[0] * factor,
                vector[1] * factor,
                vector[2] * factor,
            ],
        }
        .normalised()
    }

    /// Axis times angle, the angle in 0..=pi radians.
    pub fn rotation_vector(self) -> Vector3 {
        let [w, x, y, z] = self.wxyz;
        let sign = if w < 0.0 { -1.0 } else { 1.0 };
        let vector = [sign * x, sign * y, sign * z];
        let sine = length(vector);
        let angle = 2.0 * sine.atan2(sign * w);
        scaled(vector, if sine < 1e-12 { 2.0 } else { angle / sine })
    }

    /// `self` after `other`: rotates by `other` first.
    #[must_use]
    pub fn after(self, other: Self) -> Self {
        let [aw, ax, ay, az] = self.wxyz;
        let [bw, bx, by, bz] = other.wxyz;
        Self {
            wxyz: [
                aw * bw - ax * bx - ay * by - az * bz,
                aw * bx + ax * bw + ay * bz - az * by,
                aw * by - ax * bz + ay * bw + az * bx,
                aw * bz + ax * by - ay * bx + az * bw,
            ],
        }
    }

    /// The opposite rotation.
    #[must_use]
    pub fn inverse(self) -> Self {
        let [w, x, y, z] = self.wxyz;
        Self {
            wxyz: [w, -x, -y, -z],
        }
    }

    /// The rotated vector.
    pub fn rotate(self, vector: Vector3) -> Vector3 {
        let [w, x, y, z] = self.wxyz;
        let axis = [x, y, z];
        let twice = scaled(cross(axis, vector), 2.0);
        add(add(vector, scaled(twice, w)), cross(axis, twice))
    }

    /// The same rotation with unit length; the identity when the length is zero or not finite.
    #[must_use]
    pub fn normalised(self) -> Self {
        let norm = self.wxyz.iter().map(|part| part * part).sum::<f64>().sqrt();
        if norm > 0.0 && norm.is_finite() {
            Self {
                wxyz: self.wxyz.map(|part| part / norm),
            }
        } else {
            Self::IDENTITY
        }
    }

    /// The image of each axis.
    pub fn columns(self) -> Columns {
        [
            self.rotate([1.0, 0.0, 0.0]),
            self.rotate([0.0, 1.0, 0.0]),
            self.rotate([0.0, 0.0, 1.0]),
        ]
    }

    /// The rotation whose axes' images are `columns` (Shepperd 1978: the largest part first).
    pub fn from_columns(columns: Columns) -> Self {
        let [[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]] = columns;
        let trace = xx + yy + zz;
        let wxyz = if trace >= xx.max(yy).max(zz) {
            [1.0 + trace, yz - zy, zx - xz, xy - yx]
        } else if xx >= yy && xx >= zz {
            [yz - zy, 1.0 + xx - yy - zz, xy + yx, zx + xz]
        } else if yy >= zz {
            [zx - xz, xy + yx, 1.0 + yy - xx - zz, yz + zy]
        } else {
            [xy - yx, zx + xz, yz + zy, 1.0 + zz - xx - yy]
        };
        Self { wxyz }.normalised()
    }

    /// The angle between two orientations, 0..=pi radians.
    pub fn angle_to(self, other: Self) -> f64 {
        length(other.after(self.inverse()).rotation_vector())
    }
}

/// A frame seen from another: position, then orientation.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Pose {
    /// Origin, metres.
    pub position_m: Vector3,
    /// Orientation.
    pub orientation: Orientation,
}

impl Pose {
    /// The frame itself.
    pub const IDENTITY: Self = Self {
        position_m: [0.0; 3],
        orientation: Orientation::IDENTITY,
    };

    /// True when every number is one.
    pub fn is_finite(&self) -> bool {
        let parts = self.position_m.iter().chain(&self.orientation.wxyz);
        parts.copied().all(f64::is_finite)
    }

    /// `inner`, given in this frame, seen from where this frame is given.
    #[must_use]
    pub fn compose(&self, inner: &Self) -> Self {
        Self {
            position_m: add(self.position_m, self.orientation.rotate(inner.position_m)),
            orientation: self.orientation.after(inner.orientation),
        }
    }

    /// The other frame seen from this one.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let orientation = self.orientation.inverse();
        Self {
            position_m: scaled(orientation.rotate(self.position_m), -1.0),
            orientation,
        }
    }

    /// From `self` (at 0) to `other` (at 1) on a straight line and the shortest rotation.
    #[must_use]
    pub fn interpolate(&self, other: &Self, share: f64) -> Self {
        let step = subtract(other.position_m, self.position_m);
        let turn = other
            .orientation
            .after(self.orientation.inverse())
            .rotation_vector();
        Self {
            position_m: add(self.position_m, scaled(step, share)),
            orientation: Orientation::from_rotation_vector(scaled(turn, share))
                .after(self.orientation)
                .normalised(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::RandomStream;

    fn random_orientation(stream: &mut RandomStream) -> Orientation {
        Orientation {
            wxyz: core::array::from_fn(|_| stream.normal()),
        }
        .normalised()
    }

    #[test]
    fn quaternion_columns_and_rotation_vector_describe_one_rotation() {
        let mut stream = RandomStream::new(1, "spatial");
        for _ in 0..1000 {
            let orientation = random_orientation(&mut stream);
            let again = Orientation::from_columns(orientation.columns());
            assert!(orientation.angle_to(again) < 1e-7);
            let again = Orientation::from_rotation_vector(orientation.rotation_vector());
            assert!(orientation.angle_to(again) < 1e-7);
        }
    }

    #[test]
    fn a_pose_composed_with_its_inverse_is_the_identity() {
        let mut stream = RandomStream::new(2, "spatial");
        for _ in 0..1000 {
            let pose = Pose {
                position_m: core::array::from_fn(|_| stream.normal()),
                orientation: random_orientation(&mut stream),
            };
            let nothing = pose.compose(&pose.inverse());
            assert!(length(nothing.position_m) < 1e-12);
            assert!(nothing.orientation.angle_to(Orientation::IDENTITY) < 1e-7);
        }
    }

    #[test]
    fn halfway_is_as_far_from_both_ends() {
        let from = Pose::IDENTITY;
        let to = Pose {
            position_m: [1.0, 2.0, -4.0],
            orientation: Orientation::about_axis(2, 1.0),
        };
        let middle = from.interpolate(&to, 0.5);
        let difference = subtract(middle.position_m, [0.5, 1.0, -2.0]);
        assert!(length(difference) < 1e-15);
        assert!(
            middle
                .orientation
                .angle_to(Orientation::about_axis(2, 0.5))
                .abs()
                < 1e-12
        );
    }

    #[test]
    fn small_and_half_turns_keep_their_angle() {
        for angle in [1e-14, 1e-9, 1e-3, 3.0] {
            let turn = Orientation::about_axis(1, angle).rotation_vector();
            assert!((length(turn) - angle).abs() < 1e-15 + 1e-12 * angle);
        }
    }
}
