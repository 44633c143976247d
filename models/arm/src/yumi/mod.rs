//! The arm of an ABB `YuMi` (IRB 14000): its joints, kinematics, limits and looks. It knows no controller,
//! no dynamics and no collision.
//!
//! **Chain order.** Every seven-joint array lists the joints from the body to the hand:
//! J1, J2, J7, J3, J4, J5, J6 in the maker's numbering. The arm's seventh axis is the *third* of
//! the chain; [`CHAIN_TO_MAKER`] converts.

pub mod arm;
pub mod description;
pub mod inverse;
mod pose;

pub use crate::yumi::pose::Pose;

/// Joints of one arm.
pub const JOINT_COUNT: usize = 7;

/// One value per joint in chain order.
pub type Joints = [f64; JOINT_COUNT];

/// The maker's joint number (1..=7) of each place in the chain.
pub const CHAIN_TO_MAKER: [usize; JOINT_COUNT] = [1, 2, 7, 3, 4, 5, 6];

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
