//! Tests of [`super`].

use nalgebra::Translation3;

use super::*;
use crate::yumi::arm::{
    MOUNT_TO_FIRST_JOINT_M, POSITION_MAX_RAD, POSITION_MIN_RAD, RIGHT_START_RAD,
};
use hil_core::random::RandomStream;

const CHAIN: Chain = Chain::new(MOUNT_TO_FIRST_JOINT_M);

const SEARCH_ITERATIONS_MAX: usize = 60;

/// What a search found.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Solution {
    /// Joint positions within limits, chain order.
    q_rad: Joints,
    /// Random starts it took beyond the first.
    restart_count: u32,
}

/// Joint positions that put the tool at `target` (arm base frame) from anywhere: starts at
/// `seed_rad`, then at up to `restarts_max` random postures.
///
/// `None` means not found; with 50 restarts that happened to 38 of 40 000 random reachable poses.
fn search(
    chain: Chain,
    target: &Isometry3<f64>,
    seed_rad: &Joints,
    restarts_max: u32,
    random: &mut RandomStream,
) -> Option<Solution> {
    let mut q = JointVector::from(*seed_rad);
    for restart_count in 0..=restarts_max {
        if let Some(q_rad) = descend(chain, target, q) {
            return Some(Solution {
                q_rad: q_rad.into(),
                restart_count,
            });
        }
        q = random_posture(random).into();
    }
    None
}

/// A posture with every joint uniform within its limits.
fn random_posture(random: &mut RandomStream) -> Joints {
    core::array::from_fn(|joint| {
        let (min, max) = (POSITION_MIN_RAD[joint], POSITION_MAX_RAD[joint]);
        min + (max - min) * random.uniform()
    })
}

fn descend(chain: Chain, target: &Isometry3<f64>, mut q: JointVector) -> Option<JointVector> {
    let mut best_cost = f64::INFINITY;
    let mut stalled_count = 0;
    for _ in 0..SEARCH_ITERATIONS_MAX {
        let state = chain.at(q.as_ref());
        let error = task_error(&state, target);
        if is_within(&error, 1.0) {
            return Some(q);
        }
        let cost = cost(&error);
        if cost < 0.98 * best_cost {
            best_cost = cost;
            stalled_count = 0;
        } else {
            stalled_count += 1;
            if stalled_count > 8 {
                return None;
            }
        }
        let step = damped_step(&state.jacobian(), &error, &JointVector::zeros())?;
        q = within_limits(&(q + step)).0;
    }
    None
}

#[test]
fn of_random_reachable_poses_at_least_995_in_1000_are_found() {
    let mut random = RandomStream::new(17, "inverse");
    let (pose_count, mut found_count, mut first_count) = (400, 0, 0);
    for _ in 0..pose_count {
        let target = *CHAIN.at(&random_posture(&mut random)).tool();
        let seed = random_posture(&mut random);
        let Some(solution) = search(CHAIN, &target, &seed, 50, &mut random) else {
            continue;
        };
        found_count += 1;
        first_count += u32::from(solution.restart_count == 0);
        let tool = *CHAIN.at(&solution.q_rad).tool();
        let apart_m = (tool.translation.vector - target.translation.vector).norm();
        assert!(apart_m <= TOLERANCE_M * 1.0001);
        assert!(tool.rotation.angle_to(&target.rotation) <= TOLERANCE_RAD * 1.0001);
        assert!(!within_limits(&solution.q_rad.into()).1);
    }
    assert!(
        f64::from(found_count) >= 0.995 * f64::from(pose_count),
        "{found_count} of {pose_count} found, {first_count} from the first start"
    );
}

#[test]
fn a_pose_out_of_reach_is_not_found() {
    let mut random = RandomStream::new(1, "inverse");
    let mut target = *CHAIN.at(&RIGHT_START_RAD).tool();
    target.translation = Translation3::new(0.9, 0.0, 0.1);
    assert_eq!(
        search(CHAIN, &target, &RIGHT_START_RAD, 5, &mut random),
        None
    );
}

fn target_moved_by(step_m: [f64; 3]) -> Isometry3<f64> {
    Translation3::from(step_m) * CHAIN.at(&RIGHT_START_RAD).tool()
}

#[test]
fn a_start_slightly_beyond_a_limit_can_be_driven() {
    let mut beyond = RIGHT_START_RAD;
    beyond[0] = POSITION_MAX_RAD[0] + 0.01;
    let mut inside = RIGHT_START_RAD;
    inside[0] = POSITION_MAX_RAD[0] - 0.05;
    let mut restarted = Tracker::new(CHAIN, RIGHT_START_RAD);
    restarted.restart_at(beyond);
    let target = *CHAIN.at(&inside).tool();
    for mut tracker in [Tracker::new(CHAIN, beyond), restarted] {
        for _ in 0..100 {
            assert!(!within_limits(&(*tracker.q_rad()).into()).1);
            tracker.track(&target, 0.008);
        }
        assert_eq!(tracker.track(&target, 0.008), Reach::Reached);
    }
}

#[test]
fn a_far_target_is_approached_within_the_speed_limits_and_reached() {
    let mut tracker = Tracker::new(CHAIN, RIGHT_START_RAD);
    let target = target_moved_by([0.05, 0.03, 0.0]);
    let mut reaches = Vec::new();
    for _ in 0..100 {
        let before = *tracker.q_rad();
        reaches.push(tracker.track(&target, 0.008));
        for (joint, speed_max) in SPEED_MAX_RAD_PER_S.iter().enumerate() {
            let step = (tracker.q_rad()[joint] - before[joint]).abs();
            assert!(step <= speed_max * 0.008 * (1.0 + 1e-9));
        }
    }
    assert_eq!(reaches[0], Reach::Approaching);
    assert_eq!(reaches[99], Reach::Reached);
    assert!(!reaches.contains(&Reach::Unreachable));
}

#[test]
fn an_unreachable_target_holds_and_a_reachable_one_frees_again() {
    let mut tracker = Tracker::new(CHAIN, RIGHT_START_RAD);
    let far = target_moved_by([3.0, 0.0, 0.0]);
    let mut held_count = 0;
    for _ in 0..500 {
        let before = *tracker.q_rad();
        if tracker.track(&far, 0.008) == Reach::Unreachable {
            held_count += 1;
            assert_eq!(tracker.q_rad().map(f64::to_bits), before.map(f64::to_bits));
        }
    }
    assert!(held_count > 0, "never gave up");
    let near = target_moved_by([0.0; 3]);
    let mut reach = Reach::Unreachable;
    for _ in 0..1000 {
        reach = tracker.track(&near, 0.008);
    }
    assert_eq!(reach, Reach::Reached);
}

#[test]
fn a_target_of_nonsense_numbers_holds() {
    let mut tracker = Tracker::new(CHAIN, RIGHT_START_RAD);
    for nonsense in [f64::NAN, f64::INFINITY, 1e300] {
        let target = target_moved_by([nonsense, 0.0, 0.0]);
        assert_eq!(tracker.track(&target, 0.008), Reach::Unreachable);
    }
    assert_eq!(
        tracker.q_rad().map(f64::to_bits),
        RIGHT_START_RAD.map(f64::to_bits)
    );
}
