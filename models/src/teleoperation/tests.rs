//! The whole case: hours of motion in virtual time.

use core::time::Duration;
use std::collections::BTreeMap;

use super::*;
use crate::link::bernoulli::BernoulliLink;
use crate::link::{Fate, LinkModel};
use crate::simulation::{Carrier, Simulation, SimulationResult};
use crate::teleoperation::arm::{Arm, RIGHT_START_RAD};
use crate::teleoperation::controller::Follower;
use crate::teleoperation::inverse::Reach;
use crate::teleoperation::messages::Joints;
use crate::time::Instant;

fn case(change: impl FnOnce(&mut TeleoperationParameters)) -> Teleoperation {
    let mut parameters = TeleoperationParameters::default();
    change(&mut parameters);
    Teleoperation::new(parameters, 11).unwrap()
}

fn run(case: &Teleoperation, link: Option<Box<dyn Carrier>>, duration_s: f64) -> SimulationResult {
    let carriers = link.map(|link| (ARM_COMMAND.to_owned(), link));
    Simulation::new(case, carriers.into_iter().collect::<BTreeMap<_, _>>())
        .unwrap()
        .run(Duration::from_secs_f64(duration_s))
        .unwrap()
}

fn figures(case: &Teleoperation, result: &SimulationResult) -> impl Fn(&str) -> f64 + use<> {
    let score = case.score(&result.log);
    move |name| score.get(name).and_then(|metric| metric.value).unwrap()
}

/// Sums of squares would hide a single frame; the largest of each figure does not.
#[derive(Debug, Default)]
struct Tracked {
    frame_count: u64,
    failure_count: u64,
    error_m_max: f64,
    /// Joints each time the motion is at the same phase again: every 4033 frames, 8 loops.
    at_same_phase: Vec<Joints>,
}

fn track(frame_count: u64, rate_hz: f64) -> Tracked {
    let case = case(|parameters| parameters.rate_hz = rate_hz);
    let mut player = case.player();
    let (arm, frame_s) = (Arm::right(), 1.0 / rate_hz);
    let mut hand = player.at(0.0).right_hand;
    let origin = hand;
    let settings = case.parameters.mapping(false);
    let mut follower = Follower::engage(arm, RIGHT_START_RAD, settings, &hand);
    let mut clutch = mapping::Clutch::engage(settings, &origin, &arm.tool(&RIGHT_START_RAD));
    let mut tracked = Tracked::default();
    for frame in 0..frame_count {
        hand = player.at(frame as f64 * frame_s).right_hand;
        let answer = follower.follow(&hand, frame_s, false);
        tracked.frame_count += 1;
        tracked.failure_count += u64::from(answer.reach != Reach::Reached);
        // Every tenth frame is checked by the full pose: that doubles the work.
        if frame % 10 == 0 {
            let tool = arm.tool(&answer.command.position_rad);
            let (target, _) = clutch.follow(&hand);
            let apart = spatial::subtract(tool.position_m, target.position_m);
            tracked.error_m_max = tracked.error_m_max.max(spatial::length(apart));
        }
        if frame % 4033 == 0 {
            tracked.at_same_phase.push(answer.command.position_rad);
        }
    }
    tracked
}

/// Largest change of a joint between the first and the last time at the same phase, after the
/// first eight loops in which the redundant joint settles.
fn drift_deg(tracked: &Tracked) -> f64 {
    let (first, last) = (
        tracked.at_same_phase[1],
        tracked.at_same_phase.last().unwrap(),
    );
    let changes = first.iter().zip(last).map(|(a, b)| (a - b).abs());
    changes.fold(0.0, f64::max).to_degrees()
}

#[test]
fn eight_hundred_and_ninety_loops_are_tracked_without_failure_error_or_drift() {
    let tracked = track(448_672, 125.0);
    assert_eq!(tracked.failure_count, 0);
    assert!(tracked.error_m_max <= 1e-5, "{}", tracked.error_m_max);
    assert!(drift_deg(&tracked) < 0.01, "{}", drift_deg(&tracked));
}

#[test]
fn the_same_holds_at_250_hz() {
    // Fewer loops: at twice the rate every step is smaller.
    let tracked = track(80_660, 250.0);
    assert_eq!(tracked.failure_count, 0);
    assert!(tracked.error_m_max <= 1e-5, "{}", tracked.error_m_max);
    assert!(drift_deg(&tracked) < 0.01, "{}", drift_deg(&tracked));
}

#[test]
fn at_the_default_gain_the_robot_lags_195_ms_and_executes_every_loop() {
    let case = case(|_| {});
    let result = run(&case, None, 6.0 * 4.033);
    let figure = figures(&case, &result);
    assert!((figure("tracking_lag_ms") - 195.0).abs() <= 8.0);
    assert!((figure("joint_error_ratio") - 0.299).abs() <= 0.015);
    assert!((figure("motion_loops_sent_count") - 6.0).abs() < 0.5);
    assert!((figure("motion_loops_executed_count") - 6.0).abs() < 0.5);
    assert!(figure("motion_loss_ratio").abs() < 1e-12);
    assert!(figure("ik_failure_count") + figure("ik_limited_count") < 0.5);
    assert!(figure("hold_count") < 0.5);
}

#[test]
fn the_highest_gain_and_feed_forward_follow_as_the_control_law_says() {
    let steep = case(|parameters| parameters.servo_gain_per_s = 20.0);
    let figure = figures(&steep, &run(&steep, None, 20.0));
    assert!((figure("tracking_lag_ms") - 50.0).abs() <= 8.0);
    assert!((figure("joint_error_ratio") - 0.078).abs() <= 0.005);

    let fed = case(|parameters| parameters.feed_forward = true);
    let figure = figures(&fed, &run(&fed, None, 20.0));
    assert!(figure("tracking_lag_ms").abs() <= 8.0);
    assert!(figure("joint_error_ratio") < 0.03);
    assert!(
        (figure("tool_y_m_peak_to_peak") / case(|_| {}).nominal_peak_to_peak_m() - 1.0).abs()
            < 0.02
    );
}

#[test]
fn bernoulli_loss_of_half_the_commands_loses_no_loop() {
    let case = case(|_| {});
    let link = BernoulliLink::new(Duration::ZERO, 0.5, RandomStream::new(1, "link")).unwrap();
    let figure = figures(&case, &run(&case, Some(Box::new(link)), 8.0 * 4.033));
    assert!((figure("motion_loops_sent_count") - 8.0).abs() < 0.5);
    assert!(figure("motion_loss_ratio").abs() < 1e-12);
}

/// Loses everything from one instant to another.
#[derive(Debug)]
struct Outage {
    from: Instant,
    until: Instant,
}

impl LinkModel for Outage {
    fn offer(&mut self, now: Instant, _length_bytes: usize) -> Fate {
        if now >= self.from && now < self.until {
            Fate::Lost
        } else {
            Fate::Delivered(now)
        }
    }
}

#[test]
fn an_outage_of_one_period_is_one_hold_and_one_lost_loop() {
    let case = case(|_| {});
    let outage = Outage {
        from: Instant::from_ns(12_000_000_000),
        until: Instant::from_ns(16_033_000_000),
    };
    let figure = figures(&case, &run(&case, Some(Box::new(outage)), 8.0 * 4.033));
    assert!((figure("hold_count") - 1.0).abs() < 0.1);
    assert!((figure("motion_loops_executed_count") - 7.0).abs() < 0.1);
    assert!((figure("motion_loss_ratio") - 0.125).abs() < 1e-12);
    // The hold begins five command periods after the last command.
    let held_s = figure("hold_time_ratio") * 8.0 * 4.033;
    assert!((held_s - (4.033 - 0.04)).abs() < 0.02, "{held_s}");
}

#[test]
fn a_mirrored_left_arm_swings_opposite_without_failure() {
    let case = case(|parameters| parameters.left_arm = LeftArm::Mirror);
    let result = run(&case, None, 9.0);
    let statuses: Vec<_> = result.log.messages::<JointStatus>(ARM_STATUS).collect();
    let start = statuses[0].1;
    for (_, status) in &statuses {
        let right_m = status.right.tool.position_m[1] - start.right.tool.position_m[1];
        let left_m = status.left.tool.position_m[1] - start.left.tool.position_m[1];
        assert!((right_m + left_m).abs() < 2e-3, "{right_m} {left_m}");
    }
    let figure = figures(&case, &result);
    assert!(figure("ik_failure_count") + figure("ik_limited_count") < 0.5);
}

#[test]
fn equal_seeds_give_equal_runs_and_unequal_seeds_do_not() {
    let with_seed = |seed: u64| {
        let parameters = TeleoperationParameters {
            loop_variation_ratio: 0.01,
            ..TeleoperationParameters::default()
        };
        let case = Teleoperation::new(parameters, seed).unwrap();
        let link = BernoulliLink::new(Duration::ZERO, 0.1, RandomStream::new(seed, "link"));
        run(&case, Some(Box::new(link.unwrap())), 5.0)
    };
    assert_eq!(with_seed(1), with_seed(1));
    assert_ne!(with_seed(1).log, with_seed(2).log);
}

#[test]
fn a_controller_without_a_status_says_nothing() {
    let mut controller = case(|_| {}).role("controller").unwrap();
    let mut player = case(|_| {}).player();
    let frame = HumanFrame {
        frame_index: 0,
        source_time_ns: 0,
        root: player.at(0.0).root,
        right_hand: player.at(0.0).right_hand,
        left_hand: player.at(0.0).left_hand,
    };
    let mut sent_count = 0;
    let mut emit = |_: usize, _: &[u8]| sent_count += 1;
    controller.start(Instant::ZERO);
    assert!(controller.message(Instant::ZERO, 0, bytemuck::bytes_of(&frame), &mut emit));
    assert_eq!(sent_count, 0);
}
