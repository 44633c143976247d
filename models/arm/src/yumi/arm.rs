//! Kinematics of one `YuMi` arm (IRB 14000): joint angles to tool pose and Jacobian. It knows no
//! dynamics, no payload and no collision.
//!
//! Modified Denavit-Hartenberg parameters (Craig's convention), which reproduce the ten poses
//! that rpiRobotics/yumi-ik publishes from RobotStudio; the widespread URDF of the arm is off by
//! about 1.4 mm against the same poses.

use nalgebra::{
    Isometry3, Matrix3, Quaternion, SMatrix, SVector, Translation3, UnitQuaternion, Vector3,
    Vector6,
};

use crate::yumi::{JOINT_COUNT, Joints};

/// [`Joints`] to compute with.
pub type JointVector = SVector<f64, JOINT_COUNT>;

/// A Jacobian: one column per joint, in chain order, of the tool's linear (m/rad, rows 0..3) and
/// angular (1, rows 3..6) velocity in the base frame per unit of joint speed.
pub type Jacobian = SMatrix<f64, 6, JOINT_COUNT>;

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
    /// All but the joint's own rotation, which commutes with Tz(d).
    fixed: Isometry3<f64>,
    offset_rad: f64,
}

/// `alpha` comes in quarter turns: -1, 0 or 1.
const fn link(alpha_quarters: i8, a_m: f64, d_m: f64, offset_rad: f64) -> Link {
    use core::f64::consts::FRAC_1_SQRT_2;
    let sine = alpha_quarters as f64;
    let (rotation, height_m) = if alpha_quarters == 0 {
        (Quaternion::new(1.0, 0.0, 0.0, 0.0), d_m)
    } else {
        let half_sine = sine * FRAC_1_SQRT_2;
        (Quaternion::new(FRAC_1_SQRT_2, half_sine, 0.0, 0.0), 0.0)
    };
    let translation = Translation3 {
        vector: Vector3::new(a_m, -sine * d_m, height_m),
    };
    Link {
        fixed: Isometry3::from_parts(translation, UnitQuaternion::new_unchecked(rotation)),
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

/// Where the joints put the links, in the arm's base frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChainState {
    /// Frame of each link, metres; a joint turns about the z axis of its own. The last is `tool0`.
    pub links: [Isometry3<f64>; JOINT_COUNT],
}

impl ChainState {
    /// The frame `tool0`.
    pub fn tool(&self) -> &Isometry3<f64> {
        &self.links[JOINT_COUNT - 1]
    }

    /// The geometric Jacobian of the tool's origin.
    pub fn jacobian(&self) -> Jacobian {
        let tool_m = self.tool().translation.vector;
        let columns = self.links.map(|link| {
            let axis = link.rotation * Vector3::z();
            stacked(&axis.cross(&(tool_m - link.translation.vector)), &axis)
        });
        Jacobian::from_columns(&columns)
    }
}

/// A linear part (rows 0..3) above an angular one (rows 3..6).
pub(crate) fn stacked(linear: &Vector3<f64>, angular: &Vector3<f64>) -> Vector6<f64> {
    Vector6::new(
        linear.x, linear.y, linear.z, angular.x, angular.y, angular.z,
    )
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

    /// The links at joint angles `q_rad`, chain order.
    pub fn at(&self, q_rad: &Joints) -> ChainState {
        let mut frame = Isometry3::translation(0.0, 0.0, self.first_height_m);
        let links = core::array::from_fn(|joint| {
            let link = &LINKS[joint];
            let angle_rad = q_rad[joint] + link.offset_rad;
            frame *= link.fixed;
            frame.rotation *= UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle_rad);
            frame
        });
        ChainState { links }
    }
}

/// One arm on the robot's body.
#[derive(Debug, Clone, Copy)]
pub struct Arm {
    chain: Chain,
    mount: Isometry3<f64>,
}

/// Rotation of the right arm's mounting frame in the body frame, as published (4 digits).
const RIGHT_MOUNT: Matrix3<f64> = Matrix3::new(
    0.5713, -0.1071, 0.8138, //
    0.6198, 0.7063, -0.3421, //
    -0.5381, 0.6998, 0.4698,
);

/// Roll, pitch and yaw of the left arm's first link in the published robot description.
const LEFT_MOUNT_ROLL_PITCH_YAW_RAD: [f64; 3] = [0.9781, -0.5716, 2.3180];

impl Arm {
    /// The right arm.
    pub fn right() -> Self {
        // The nearest rotation: four digits leave the published matrix a little off orthogonal.
        let guess = UnitQuaternion::identity();
        let rotation = UnitQuaternion::from_matrix_eps(&RIGHT_MOUNT, 1e-15, 100, guess);
        Self::mounted([0.053_55, -0.0725, 0.414_92], rotation)
    }

    /// The left arm. The published numbers of the two arms are not exact mirror images.
    pub fn left() -> Self {
        let [roll, pitch, yaw] = LEFT_MOUNT_ROLL_PITCH_YAW_RAD;
        let described = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
        // That description counts the first joint from the opposite direction.
        let half_turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), core::f64::consts::PI);
        Self::mounted([0.053_55, 0.0725, 0.414_92], described * half_turn)
    }

    fn mounted(position_m: [f64; 3], rotation: UnitQuaternion<f64>) -> Self {
        Self {
            chain: Chain::new(MOUNT_TO_FIRST_JOINT_M),
            mount: Isometry3::from_parts(position_m.into(), rotation),
        }
    }

    /// The chain below the mounting frame.
    pub fn chain(&self) -> &Chain {
        &self.chain
    }

    /// Tool pose in the body frame: x forward, y to the robot's left, z up.
    pub fn tool(&self, q_rad: &Joints) -> Isometry3<f64> {
        self.mount * self.chain.at(q_rad).tool()
    }

    /// The frames of mount and links in the body frame, metres, at joint angles `q_rad`; the last
    /// is the tool.
    pub fn frames(&self, q_rad: &Joints) -> [Isometry3<f64>; JOINT_COUNT + 1] {
        let links = self.chain.at(q_rad).links;
        core::array::from_fn(|frame| match frame {
            0 => self.mount,
            link => self.mount * links[link - 1],
        })
    }

    /// A pose of the body frame seen from the arm's mounting frame.
    pub fn from_body(&self, pose: &Isometry3<f64>) -> Isometry3<f64> {
        self.mount.inv_mul(pose)
    }
}

/// `q_rad` with every joint inside its position limits, and whether any had to move.
pub fn within_limits(q_rad: &JointVector) -> (JointVector, bool) {
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

#[cfg(test)]
#[path = "arm_tests.rs"]
mod tests;
