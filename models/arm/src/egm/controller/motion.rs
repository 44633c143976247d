//! Motions the controller makes by itself, without a client: from posture to posture with a
//! trapezoidal speed. It plans no path around anything.

use crate::egm::messages::Side;
use crate::yumi::arm::SPEED_MAX_RAD_PER_S;
use crate::yumi::{JOINT_COUNT, Joints};

/// Share of the joints' own speed limits that a motion uses unless told otherwise.
pub const SPEED_RATIO_DEFAULT: f64 = 0.25;

/// Time a joint motion takes to reach its speed, where it is long enough to reach it.
const ACCELERATION_S: f64 = 0.2;

/// The home posture of ABB's programs: J1..J6 at 0, -130, 30, 0, 40 and 0 degrees, J7 at 135
/// (left) or -135 (right).
pub fn home_rad(side: Side) -> Joints {
    let j7 = match side {
        Side::Right => -135.0,
        Side::Left => 135.0,
    };
    [0.0, -130.0, j7, 30.0, 0.0, 40.0, 0.0].map(f64::to_radians)
}

/// A straight motion in joint space from rest to rest; all joints arrive together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointMotion {
    from_rad: Joints,
    way_rad: Joints,
    duration_s: f64,
    acceleration_s: f64,
}

impl JointMotion {
    /// From one posture to another with at most `speed_ratio` (above 0, at most 1) of the joints'
    /// own speeds.
    pub fn new(from_rad: &Joints, to_rad: &Joints, speed_ratio: f64) -> Self {
        let (way_rad, fastest_s) = way(from_rad, to_rad);
        let cruise_s = fastest_s / speed_ratio;
        let (duration_s, acceleration_s) = if cruise_s > ACCELERATION_S {
            (cruise_s + ACCELERATION_S, ACCELERATION_S)
        } else {
            // Too short to reach its speed: the same acceleration, but only to half-way.
            let half_s = (cruise_s * ACCELERATION_S).sqrt();
            (2.0 * half_s, half_s)
        };
        Self {
            from_rad: *from_rad,
            way_rad,
            duration_s,
            acceleration_s,
        }
    }

    /// From one posture to another within `duration_s`, or later where a joint's speed limit
    /// needs it.
    pub fn lasting(from_rad: &Joints, to_rad: &Joints, duration_s: f64) -> Self {
        /// A trapezoid that accelerates for a quarter of its time and brakes for another.
        const ACCELERATION_SHARE: f64 = 0.25;
        let (way_rad, fastest_s) = way(from_rad, to_rad);
        let duration_s = duration_s.max(fastest_s / (1.0 - ACCELERATION_SHARE));
        Self {
            from_rad: *from_rad,
            way_rad,
            duration_s,
            acceleration_s: ACCELERATION_SHARE * duration_s,
        }
    }

    /// How long it takes.
    pub fn duration_s(&self) -> f64 {
        self.duration_s
    }

    /// The joints `time_s` after its start; before and after, where it starts and ends.
    pub fn at(&self, time_s: f64) -> Joints {
        let share = self.share(time_s);
        core::array::from_fn(|joint| self.from_rad[joint] + share * self.way_rad[joint])
    }

    /// Share of the way, 0..=1.
    fn share(&self, time_s: f64) -> f64 {
        let left_s = self.duration_s - time_s;
        if left_s <= 0.0 {
            return 1.0;
        }
        if time_s <= 0.0 {
            return 0.0;
        }
        let cruise_per_s = (self.duration_s - self.acceleration_s).recip();
        let ramp = |ramp_s: f64| 0.5 * cruise_per_s * ramp_s * ramp_s / self.acceleration_s;
        if time_s < self.acceleration_s {
            ramp(time_s)
        } else if left_s < self.acceleration_s {
            1.0 - ramp(left_s)
        } else {
            cruise_per_s * (time_s - 0.5 * self.acceleration_s)
        }
    }
}

/// The way from one posture to another, and the time it takes at the joints' own speeds.
fn way(from_rad: &Joints, to_rad: &Joints) -> (Joints, f64) {
    let mut way_rad = [0.0; JOINT_COUNT];
    let mut fastest_s = 0.0_f64;
    for joint in 0..JOINT_COUNT {
        way_rad[joint] = to_rad[joint] - from_rad[joint];
        fastest_s = fastest_s.max(way_rad[joint].abs() / SPEED_MAX_RAD_PER_S[joint]);
    }
    (way_rad, fastest_s)
}

/// A motion under way, one cycle at a time.
#[derive(Debug, Clone)]
pub(super) enum Track {
    /// Between two postures.
    Joint { motion: JointMotion, time_s: f64 },
    /// Through given points, one per cycle.
    Path { points: Vec<Joints>, next: usize },
}

impl Track {
    pub(super) fn along(motion: JointMotion) -> Self {
        Self::Joint {
            motion,
            time_s: 0.0,
        }
    }

    /// Where the joints are one cycle later; `None` when the end was reached before.
    pub(super) fn advance(&mut self, step_s: f64) -> Option<Joints> {
        match self {
            Self::Joint { motion, time_s } => {
                let is_under_way = *time_s < motion.duration_s;
                *time_s += step_s;
                is_under_way.then(|| motion.at(*time_s))
            }
            Self::Path { points, next } => {
                let point = points.get(*next).copied();
                *next += 1;
                point
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::yumi::CHAIN_TO_MAKER;
    use crate::yumi::arm::{POSITION_MAX_RAD, POSITION_MIN_RAD, RIGHT_START_RAD};

    /// Highest joint speed as a share of its limit, sampled finely.
    fn speed_ratio_max(motion: &JointMotion) -> f64 {
        let step_s = motion.duration_s() / 10_000.0;
        let mut highest = 0.0_f64;
        for step in 0..10_000_i32 {
            let time_s = f64::from(step) * step_s;
            let (before, after) = (motion.at(time_s), motion.at(time_s + step_s));
            for joint in 0..JOINT_COUNT {
                let speed = (after[joint] - before[joint]).abs() / step_s;
                highest = highest.max(speed / SPEED_MAX_RAD_PER_S[joint]);
            }
        }
        highest
    }

    #[test]
    fn a_joint_motion_keeps_its_share_of_the_speed_and_arrives() {
        let home = home_rad(Side::Right);
        for ratio in [0.05, 0.25, 1.0] {
            let motion = JointMotion::new(&RIGHT_START_RAD, &home, ratio);
            let highest = speed_ratio_max(&motion);
            assert!((highest / ratio - 1.0).abs() < 1e-3, "{highest} of {ratio}");
            let end = motion.at(motion.duration_s());
            assert!(end.iter().zip(&home).all(|(a, b)| (a - b).abs() < 1e-12));
            assert!(motion.at(-1.0)[0].to_bits() == RIGHT_START_RAD[0].to_bits());
        }
    }

    #[test]
    fn a_short_motion_accelerates_no_harder_than_a_long_one() {
        let mut near = RIGHT_START_RAD;
        near[0] += 0.01;
        let motion = JointMotion::new(&RIGHT_START_RAD, &near, 0.5);
        let acceleration = 0.01 / (0.5 * motion.duration_s()).powi(2);
        let of_a_long_one = 0.5 * SPEED_MAX_RAD_PER_S[0] / ACCELERATION_S;
        assert!((acceleration / of_a_long_one - 1.0).abs() < 1e-9);
        assert!(speed_ratio_max(&motion) <= 0.5);
    }

    #[test]
    fn a_motion_of_given_length_is_longer_only_where_a_joint_needs_it() {
        let home = home_rad(Side::Right);
        let slow = JointMotion::lasting(&RIGHT_START_RAD, &home, 5.0);
        assert!((slow.duration_s() - 5.0).abs() < 1e-12);
        let fast = JointMotion::lasting(&RIGHT_START_RAD, &home, 0.0);
        assert!((speed_ratio_max(&fast) - 1.0).abs() < 1e-3);
    }

    #[test]
    fn no_way_takes_no_time() {
        let motion = JointMotion::new(&RIGHT_START_RAD, &RIGHT_START_RAD, 0.25);
        assert!(motion.duration_s() < 1e-12);
        let still = JointMotion::lasting(&RIGHT_START_RAD, &RIGHT_START_RAD, 0.0);
        assert!(still.at(0.0)[0].to_bits() == RIGHT_START_RAD[0].to_bits());
    }

    #[test]
    fn home_is_the_makers_posture_and_within_the_limits() {
        for (side, j7_deg) in [(Side::Right, -135.0), (Side::Left, 135.0)] {
            let home = home_rad(side);
            let maker = [0.0, -130.0, 30.0, 0.0, 40.0, 0.0, j7_deg];
            for (chain, number) in CHAIN_TO_MAKER.into_iter().enumerate() {
                assert!((home[chain].to_degrees() - maker[number - 1]).abs() < 1e-9);
                assert!((POSITION_MIN_RAD[chain]..=POSITION_MAX_RAD[chain]).contains(&home[chain]));
            }
        }
    }
}
