//! The arm of an ABB `YuMi` (IRB 14000): its joints, kinematics, limits and looks. It knows no controller,
//! no dynamics and no collision.
//!
//! **Chain order.** Every seven-joint array lists the joints from the body to the hand:
//! J1, J2, J7, J3, J4, J5, J6 in the maker's numbering. The arm's seventh axis is the *third* of
//! the chain; [`CHAIN_TO_MAKER`] converts.

pub mod arm;
pub mod description;
pub mod inverse;

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};

/// Joints of one arm.
pub const JOINT_COUNT: usize = 7;

/// One value per joint in chain order.
pub type Joints = [f64; JOINT_COUNT];

/// The maker's joint number (1..=7) of each place in the chain.
pub const CHAIN_TO_MAKER: [usize; JOINT_COUNT] = [1, 2, 7, 3, 4, 5, 6];

hil_core::message! {
    /// A frame seen from another, as it travels: plain numbers, which may be nonsense.
    ///
    /// Kinematics computes with [`Isometry3`], which is always a rigid motion; [`Pose::isometry`]
    /// is the gate between the two.
    pub struct Pose, 56 bytes {
        /// Origin, metres.
        pub position_m: [f64; 3],
        /// Rotation as a quaternion, scalar part first (Hamilton convention, active); of unit length
        /// in every message this crate sends.
        pub quaternion_wxyz: [f64; 4],
    }
}

impl Pose {
    /// Largest magnitude of any number of a pose: far beyond any robot or person, far below
    /// where arithmetic overflows.
    pub const MAGNITUDE_MAX: f64 = 1e6;

    /// The rigid motion these numbers stand for; a quaternion of another length is normalised.
    ///
    /// `None` when a number is none or beyond [`Pose::MAGNITUDE_MAX`], or the quaternion is
    /// shorter than its reciprocal and so has no direction to speak of.
    pub fn isometry(&self) -> Option<Isometry3<f64>> {
        let [w, x, y, z] = self.quaternion_wxyz;
        let mut numbers = self.position_m.iter().chain(&self.quaternion_wxyz);
        if !numbers.all(|number| number.abs() <= Self::MAGNITUDE_MAX) {
            return None;
        }
        let rotation =
            UnitQuaternion::try_new(Quaternion::new(w, x, y, z), Self::MAGNITUDE_MAX.recip())?;
        let translation = Translation3::from(Vector3::from(self.position_m));
        Some(Isometry3::from_parts(translation, rotation))
    }
}

impl From<Isometry3<f64>> for Pose {
    fn from(isometry: Isometry3<f64>) -> Self {
        let rotation = isometry.rotation;
        Self {
            position_m: isometry.translation.vector.into(),
            quaternion_wxyz: [rotation.w, rotation.i, rotation.j, rotation.k],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_chain_lists_every_joint_once() {
        let mut numbers = CHAIN_TO_MAKER;
        numbers.sort_unstable();
        assert_eq!(numbers, [1, 2, 3, 4, 5, 6, 7]);
    }
}

#[cfg(test)]
mod pose_tests {
    use bytemuck::Zeroable;

    use super::*;

    const POSE: Pose = Pose {
        position_m: [1.0, -2.0, 3.0],
        quaternion_wxyz: [0.5, -0.5, 0.5, -0.5],
    };

    #[test]
    fn a_pose_is_a_rigid_motion_and_back_whatever_its_quaternions_length() {
        let isometry = POSE.isometry().unwrap();
        assert_eq!(Pose::from(isometry), POSE);
        let long = Pose {
            quaternion_wxyz: POSE.quaternion_wxyz.map(|part| part * 3.0),
            ..POSE
        };
        assert!(
            long.isometry()
                .unwrap()
                .rotation
                .angle_to(&isometry.rotation)
                < 1e-15
        );
    }

    #[test]
    fn numbers_that_are_no_pose_are_refused() {
        for nonsense in [f64::NAN, f64::INFINITY, 1e300] {
            let (mut moved, mut turned) = (POSE, POSE);
            moved.position_m[1] = nonsense;
            turned.quaternion_wxyz[0] = nonsense;
            assert_eq!(moved.isometry(), None);
            assert_eq!(turned.isometry(), None);
        }
        assert_eq!(Pose::zeroed().isometry(), None);
    }
}
