//! Paths of the motion server: joint positions one cycle apart. It moves nothing, and knows no
//! obstacle and no acceleration limit.

use nalgebra::Isometry3;

use hil_arm::egm::controller::motion::JointMotion;
use hil_arm::yumi::Joints;
use hil_arm::yumi::arm::Arm;
use hil_arm::yumi::inverse::{Reach, Tracker};

/// How fast a linear motion may turn the tool; ours, the maker has its own by speed class.
const TURN_MAX_RAD_PER_S: f64 = 0.5;

/// No target farther from the tool than this lies within any arm's reach.
const DISTANCE_MAX_M: f64 = 2.0;

/// The points of `motion`, drawn out to `duration_s`, one cycle apart; the first is one cycle after
/// its start. A duration shorter than the motion's own counts as that.
pub(crate) fn joint_path(motion: &JointMotion, duration_s: f64, cycle_s: f64) -> Vec<Joints> {
    let duration_s = duration_s.max(motion.duration_s());
    let count = step_count(duration_s, cycle_s);
    // In the motion's own time: drawn out, every joint is slower by one ratio.
    let step_s = motion.duration_s() / f64::from(count);
    (1..=count)
        .map(|step| motion.at(f64::from(step) * step_s))
        .collect()
}

/// How long a straight line takes at `speed_m_per_s`, or turning on the spot; `None` when the
/// target is beyond any reach.
pub(crate) fn linear_duration_s(
    arm: &Arm,
    from_rad: &Joints,
    target: &Isometry3<f64>,
    speed_m_per_s: f64,
) -> Option<f64> {
    let tool = arm.tool(from_rad);
    let distance_m = (target.translation.vector - tool.translation.vector).norm();
    let turn_rad = tool.rotation.angle_to(&target.rotation);
    let duration_s = (distance_m / speed_m_per_s).max(turn_rad / TURN_MAX_RAD_PER_S);
    (distance_m <= DISTANCE_MAX_M).then_some(duration_s)
}

/// A straight line of the tool at constant speed to `target` (body frame) in `duration_s`; `None`
/// when some point of it is out of reach, or needs a joint beyond its position or speed limit.
pub(crate) fn linear_path(
    arm: &Arm,
    from_rad: &Joints,
    target: &Isometry3<f64>,
    duration_s: f64,
    cycle_s: f64,
) -> Option<Vec<Joints>> {
    let tool = arm.tool(from_rad);
    let mut tracker = Tracker::new(*arm.chain(), *from_rad);
    let count = step_count(duration_s, cycle_s);
    (1..=count)
        .map(|step| {
            let point = tool.lerp_slerp(target, f64::from(step) / f64::from(count));
            let reach = tracker.track(&arm.from_body(&point), cycle_s);
            (reach == Reach::Reached).then(|| *tracker.q_rad())
        })
        .collect()
}

/// At least one: a motion of no length still is one.
fn step_count(duration_s: f64, cycle_s: f64) -> u32 {
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "saturating; the callers bound the duration to minutes"
    )]
    let count = (duration_s / cycle_s).ceil() as u32;
    count.max(1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_arm::yumi::arm::{RIGHT_START_RAD, SPEED_MAX_RAD_PER_S};

    const CYCLE_S: f64 = 0.004;

    #[test]
    fn a_joint_motion_drawn_out_is_slower_and_ends_where_it_shall() {
        let mut to = RIGHT_START_RAD;
        to[0] -= 0.8;
        to[6] += 1.0;
        let motion = JointMotion::new(&RIGHT_START_RAD, &to, 0.25);
        let own = joint_path(&motion, 0.0, CYCLE_S);
        let drawn_out = joint_path(&motion, 3.0 * motion.duration_s(), CYCLE_S);
        let fastest = |path: &[Joints]| {
            let steps = path.windows(2).map(|pair| (pair[1][0] - pair[0][0]).abs());
            steps.fold(0.0, f64::max) / CYCLE_S / SPEED_MAX_RAD_PER_S[0]
        };
        assert!((fastest(&own) - 0.25).abs() < 0.01, "{}", fastest(&own));
        assert!((3.0 * fastest(&drawn_out) - 0.25).abs() < 0.01);
        for path in [own, drawn_out] {
            let end = path.last().unwrap();
            assert!(end.iter().zip(&to).all(|(q, to)| (q - to).abs() < 1e-12));
        }
    }

    #[test]
    fn a_line_is_straight_of_constant_speed_and_ends_on_its_target() {
        let arm = Arm::right();
        let tool = arm.tool(&RIGHT_START_RAD);
        let target = Isometry3::translation(0.0, 0.1, 0.05) * tool;
        let duration_s = linear_duration_s(&arm, &RIGHT_START_RAD, &target, 0.1).unwrap();
        let path = linear_path(&arm, &RIGHT_START_RAD, &target, duration_s, CYCLE_S).unwrap();
        let way = target.translation.vector - tool.translation.vector;
        let step_m = way.norm() / path.len() as f64;
        for (index, q_rad) in path.iter().enumerate() {
            let moved = arm.tool(q_rad).translation.vector - tool.translation.vector;
            let along = moved.dot(&way.normalize());
            assert!((moved - along * way.normalize()).norm() < 1e-5);
            assert!((along - step_m * (index + 1) as f64).abs() < 1e-5);
        }
    }

    #[test]
    fn a_line_out_of_reach_or_too_fast_has_no_path() {
        let arm = Arm::right();
        let tool = arm.tool(&RIGHT_START_RAD);
        let far = Isometry3::translation(0.6, 0.0, 0.0) * tool;
        assert_eq!(
            linear_path(&arm, &RIGHT_START_RAD, &far, 6.0, CYCLE_S),
            None
        );
        let near = Isometry3::translation(0.0, 0.1, 0.0) * tool;
        assert_eq!(
            linear_path(&arm, &RIGHT_START_RAD, &near, 0.02, CYCLE_S),
            None
        );
        let beyond = Isometry3::translation(1e5, 0.0, 0.0);
        assert_eq!(
            linear_duration_s(&arm, &RIGHT_START_RAD, &beyond, 0.1),
            None
        );
    }
}
