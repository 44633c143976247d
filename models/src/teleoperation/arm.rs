//! Kinematics of one `YuMi` arm (IRB 14000): joint angles to tool pose and Jacobian. It knows no
//! dynamics, no payload and no collision.
//!
//! Modified Denavit-Hartenberg parameters (Craig's convention), which reproduce the ten poses
//! that rpiRobotics/yumi-ik publishes from RobotStudio; the widespread URDF of the arm is off by
//! about 1.4 mm against the same poses.

use crate::teleoperation::messages::{JOINT_COUNT, Joints};
use crate::teleoperation::spatial::{
    Columns, Orientation, Pose, Vector3, add, cross, dot, scaled, subtract,
};

/// Height of the first joint above the arm's base frame as RobotStudio places it, metres.
pub const BASE_TO_FIRST_JOINT_M: f64 = 0.306;

/// Height of the first joint above the mounting frame on the robot's body, metres.
pub const MOUNT_TO_FIRST_JOINT_M: f64 = 0.1;

/// Lowest joint positions, chain order.
pub const POSITION_MIN_RAD: Joints =
    degrees([-168.5, -143.5, -168.5, -123.5, -290.0, -88.0, -229.0]);

/// Highest joint positions, chain order.
pub const POSITION_MAX_RAD: Joints = degrees([168.5, 43.5, 168.5, 80.0, 290.0, 138.0, 229.0]);

/// Highest joint speeds, chain order.
pub const SPEED_MAX_RAD_PER_S: Joints = degrees([180.0, 180.0, 180.0, 180.0, 400.0, 400.0, 400.0]);

/// Where the right arm starts: tool in front of the body, far from every limit, with room for a
/// side-to-side swing of 0.15 m each way.
pub const RIGHT_START_RAD: Joints = degrees([98.4, -113.5, -49.3, 19.4, -155.1, 98.4, 18.9]);

/// Where the left arm starts: the mirror image of [`RIGHT_START_RAD`].
pub const LEFT_START_RAD: Joints = degrees([-98.4, -113.5, 49.3, 19.4, 155.1, 98.4, -18.9]);

const fn degrees(values: Joints) -> Joints {
    let mut result = values;
    let mut index = 0;
    while index < JOINT_COUNT {
        result[index] = values[index].to_radians();
        index += 1;
    }
    result
}

/// One row of the table: Rx(alpha) Tx(a) Rz(theta + offset) Tz(d).
#[derive(Debug, Clone, Copy)]
struct Link {
    /// Twist of the previous axis in quarter turns: its sine and cosine are exact.
    alpha_sine: f64,
    alpha_cosine: f64,
    a_m: f64,
    d_m: f64,
    offset_rad: f64,
}

const fn link(alpha_quarters: i8, a_m: f64, d_m: f64, offset_rad: f64) -> Link {
    let (alpha_sine, alpha_cosine) = match alpha_quarters {
        -1 => (-1.0, 0.0),
        1 => (1.0, 0.0),
        _ => (0.0, 1.0),
    };
    Link {
        alpha_sine,
        alpha_cosine,
        a_m,
        d_m,
        offset_rad,
    }
}

/// The chain without the first height, which depends on the base frame.
const LINKS: [Link; JOINT_COUNT] = [
    link(0, 0.0, 0.0, 0.0),
    link(-1, -0.030, 0.0, 0.0),
    link(1, 0.030, 0.2515, 0.0),
    link(-1, 0.0405, 0.0, core::f64::consts::FRAC_PI_2),
    link(1, -0.0405, 0.265, 0.0),
    link(-1, 0.027, 0.0, 0.0),
    link(1, -0.027, 0.036, 0.0),
];

/// Tool frame and the axes that move it, all in the arm's base frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChainState {
    /// Origin of `tool0`, metres.
    pub tool_m: Vector3,
    /// Axes of `tool0`.
    pub tool_axes: Columns,
    /// Direction of each joint's axis.
    pub axes: [Vector3; JOINT_COUNT],
    /// A point on each joint's axis, metres.
    pub points_m: [Vector3; JOINT_COUNT],
}

/// A Jacobian: for each joint the tool's linear (m/rad) and angular (1) velocity in the base
/// frame per unit of joint speed.
pub type Jacobian = [[f64; 6]; JOINT_COUNT];

impl ChainState {
    /// The tool pose with its orientation as a quaternion.
    pub fn tool(&self) -> Pose {
        Pose {
            position_m: self.tool_m,
            orientation: Orientation::from_columns(self.tool_axes),
        }
    }

    /// The geometric Jacobian of the tool's origin.
    pub fn jacobian(&self) -> Jacobian {
        let mut jacobian = [[0.0; 6]; JOINT_COUNT];
        for ((column, axis), point) in jacobian.iter_mut().zip(&self.axes).zip(&self.points_m) {
            let [x, y, z] = cross(*axis, subtract(self.tool_m, *point));
            *column = [x, y, z, axis[0], axis[1], axis[2]];
        }
        jacobian
    }
}

/// The chain from an arm's base frame to `tool0`.
#[derive(Debug, Clone, Copy)]
pub struct Chain {
    first_height_m: f64,
}

impl Chain {
    /// A chain whose first joint lies `first_height_m` above the base frame:
    /// [`BASE_TO_FIRST_JOINT_M`] or [`MOUNT_TO_FIRST_JOINT_M`].
    pub const fn new(first_height_m: f64) -> Self {
        Self { first_height_m }
    }

    /// Tool and axes at joint angles `q_rad`, chain order.
    pub fn at(&self, q_rad: &Joints) -> ChainState {
        let mut x: Vector3 = [1.0, 0.0, 0.0];
        let mut y: Vector3 = [0.0, 1.0, 0.0];
        let mut z: Vector3 = [0.0, 0.0, 1.0];
        let mut origin: Vector3 = [0.0, 0.0, self.first_height_m];
        let mut axes = [[0.0; 3]; JOINT_COUNT];
        let mut points_m = [[0.0; 3]; JOINT_COUNT];
        for (index, (link, q)) in LINKS.iter().zip(q_rad).enumerate() {
            origin = add(origin, scaled(x, link.a_m));
            let (sine, cosine) = (link.alpha_sine, link.alpha_cosine);
            let twisted = add(scaled(y, cosine), scaled(z, sine));
            z = add(scaled(y, -sine), scaled(z, cosine));
            origin = add(origin, scaled(z, link.d_m));
            let (sine, cosine) = (q + link.offset_rad).sin_cos();
            y = add(scaled(x, -sine), scaled(twisted, cosine));
            x = add(scaled(x, cosine), scaled(twisted, sine));
            axes[index] = z;
            points_m[index] = origin;
        }
        ChainState {
            tool_m: origin,
            tool_axes: [x, y, z],
            axes,
            points_m,
        }
    }
}

/// One arm on the robot's body.
#[derive(Debug, Clone, Copy)]
pub struct Arm {
    chain: Chain,
    mount: Pose,
    mount_inverse: Pose,
}

/// Rotation of the right arm's mounting frame in the body frame, rows, as published (4 digits).
const RIGHT_MOUNT_ROWS: [Vector3; 3] = [
    [0.5713, -0.1071, 0.8138],
    [0.6198, 0.7063, -0.3421],
    [-0.5381, 0.6998, 0.4698],
];

/// Roll, pitch and yaw of the left arm's first link in the published robot description.
const LEFT_MOUNT_ROLL_PITCH_YAW_RAD: Vector3 = [0.9781, -0.5716, 2.3180];

impl Arm {
    /// The right arm.
    pub fn right() -> Self {
        let [first, second, third] = RIGHT_MOUNT_ROWS;
        let columns = [
            [first[0], second[0], third[0]],
            [first[1], second[1], third[1]],
            [first[2], second[2], third[2]],
        ];
        Self::mounted(Pose {
            position_m: [0.053_55, -0.0725, 0.414_92],
            orientation: Orientation::from_columns(orthonormalised(columns)),
        })
    }

    /// The left arm. The published numbers of the two arms are not exact mirror images.
    pub fn left() -> Self {
        let [roll, pitch, yaw] = LEFT_MOUNT_ROLL_PITCH_YAW_RAD;
        let described = Orientation::about_axis(2, yaw)
            .after(Orientation::about_axis(1, pitch))
            .after(Orientation::about_axis(0, roll));
        // That description counts the first joint from the opposite direction.
        let turned = described.after(Orientation::about_axis(2, core::f64::consts::PI));
        Self::mounted(Pose {
            position_m: [0.053_55, 0.0725, 0.414_92],
            orientation: turned,
        })
    }

    fn mounted(mount: Pose) -> Self {
        Self {
            chain: Chain::new(MOUNT_TO_FIRST_JOINT_M),
            mount,
            mount_inverse: mount.inverse(),
        }
    }

    /// The chain below the mounting frame.
    pub fn chain(&self) -> &Chain {
        &self.chain
    }

    /// Tool pose in the body frame.
    pub fn tool(&self, q_rad: &Joints) -> Pose {
        self.mount.compose(&self.chain.at(q_rad).tool())
    }

    /// Lateral position (body frame, y to the robot's left) of the tool.
    pub fn tool_y_m(&self, q_rad: &Joints) -> f64 {
        let tool_m = self.chain.at(q_rad).tool_m;
        self.mount.position_m[1] + self.mount.orientation.rotate(tool_m)[1]
    }

    /// A pose of the body frame seen from the arm's mounting frame.
    pub fn from_body(&self, pose: &Pose) -> Pose {
        self.mount_inverse.compose(pose)
    }
}

/// The nearest right-handed orthonormal frame that keeps the first axis (Gram-Schmidt).
fn orthonormalised([x, y, _]: Columns) -> Columns {
    let unit = |v: Vector3| scaled(v, 1.0 / dot(v, v).sqrt());
    let x = unit(x);
    let y = unit(subtract(y, scaled(x, dot(x, y))));
    [x, y, cross(x, y)]
}

/// `q_rad` with every joint inside its position limits, and whether any had to move.
pub fn within_limits(q_rad: &Joints) -> (Joints, bool) {
    let mut clipped = *q_rad;
    let mut is_clipped = false;
    let limits = POSITION_MIN_RAD.iter().zip(&POSITION_MAX_RAD);
    for (q, (min, max)) in clipped.iter_mut().zip(limits) {
        if *q < *min || *q > *max {
            *q = q.clamp(*min, *max);
            is_clipped = true;
        }
    }
    (clipped, is_clipped)
}

/// The largest factor of at most 1 by which all `speeds_rad_per_s` keep their limits: one ratio
/// for all joints, so that the direction of motion stays.
pub fn speed_ratio(speeds_rad_per_s: &Joints) -> f64 {
    speeds_rad_per_s
        .iter()
        .zip(&SPEED_MAX_RAD_PER_S)
        .map(|(speed, max)| max / speed.abs())
        .fold(1.0, f64::min)
}

#[cfg(test)]
#[path = "arm_tests.rs"]
mod tests;
