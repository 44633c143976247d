//! Which joint is where on the wire. It judges no value: see [`crate::egm::face`].
//!
//! The protocol has room for six joints and up to six external axes. A seven-axis `YuMi` arm sends
//! J1 to J6 as joints and J7, the *third* joint from the body, as the first external axis.

use crate::yumi::{CHAIN_TO_MAKER, JOINT_COUNT, Joints};

/// Joints of the robot itself in a message.
pub const ROBOT_JOINT_COUNT: usize = 6;

/// Place of J7 in the chain.
pub const EXTERNAL_PLACE: usize = 2;

/// Place in the chain of each joint J1 to J6.
pub const ROBOT_PLACES: [usize; ROBOT_JOINT_COUNT] = [0, 1, 3, 4, 5, 6];

const _: () = {
    let mut joint = 0;
    while joint < ROBOT_JOINT_COUNT {
        assert!(CHAIN_TO_MAKER[ROBOT_PLACES[joint]] == joint + 1);
        joint += 1;
    }
    assert!(CHAIN_TO_MAKER[EXTERNAL_PLACE] == JOINT_COUNT);
};

/// One value per joint in the order and unit of the wire.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WireJoints {
    /// J1 to J6, degrees or degrees/s.
    pub robot_deg: [f64; ROBOT_JOINT_COUNT],
    /// J7, degrees or degrees/s.
    pub external_deg: f64,
}

impl WireJoints {
    /// From chain order, rad or rad/s.
    pub fn from_chain(chain_rad: &Joints) -> Self {
        Self {
            robot_deg: ROBOT_PLACES.map(|place| chain_rad[place].to_degrees()),
            external_deg: chain_rad[EXTERNAL_PLACE].to_degrees(),
        }
    }

    /// To chain order, rad or rad/s.
    pub fn to_chain(&self) -> Joints {
        let mut chain_rad = [0.0; JOINT_COUNT];
        for (value_deg, place) in self.robot_deg.iter().zip(ROBOT_PLACES) {
            chain_rad[place] = value_deg.to_radians();
        }
        chain_rad[EXTERNAL_PLACE] = self.external_deg.to_radians();
        chain_rad
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_third_of_the_chain_is_the_first_external_axis() {
        let chain_rad = [1.0, 2.0, 7.0, 3.0, 4.0, 5.0, 6.0].map(f64::to_radians);
        let wire = WireJoints::from_chain(&chain_rad);
        for (joint, value_deg) in wire.robot_deg.iter().enumerate() {
            assert!((value_deg - (joint + 1) as f64).abs() < 1e-12);
        }
        assert!((wire.external_deg - 7.0).abs() < 1e-12);
        for (back, there) in wire.to_chain().iter().zip(&chain_rad) {
            assert!((back - there).abs() < 1e-15);
        }
    }
}
