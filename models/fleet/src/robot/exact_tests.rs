//! The exact tracker against closed forms and against a numerical integration.

use core::time::Duration;

use crate::geometry::floor_index;
use crate::robot::tracker::{ExactTracker, Limits};
use hil_core::random::RandomStream;
use hil_core::time::Instant;

const LIMITS: Limits = Limits {
    speed_max_mps: 6.0,
    acceleration_mps2: 2.0,
};

fn seconds(at_s: f64) -> Instant {
    Instant::ZERO + Duration::from_secs_f64(at_s)
}

/// Goes through all changes up to `now`.
fn advance(tracker: &mut ExactTracker, now: Instant) {
    while tracker.next_change().is_some_and(|at| at <= now) {
        tracker.change();
    }
}

/// When it comes to rest.
fn rest_of(tracker: &mut ExactTracker) -> Instant {
    let mut rest = Instant::ZERO;
    while let Some(at) = tracker.next_change() {
        rest = at;
        tracker.change();
    }
    rest
}

#[test]
fn durations_and_stops_are_those_of_trapezoid_and_triangle() {
    for target_m in [1e-6, 0.3, 5.0, 17.999, 18.0, 18.001, 60.0, 400.0] {
        let mut tracker = ExactTracker::new(LIMITS);
        tracker.place(Instant::ZERO, 0.0);
        tracker.aim(Instant::ZERO, target_m);
        let rest = rest_of(&mut tracker);
        // Full speed needs v^2 / a = 18 m for speeding up and braking.
        let expected_s = if target_m < 18.0 {
            2.0 * (target_m / 2.0).sqrt()
        } else {
            3.0 + 3.0 + (target_m - 18.0) / 6.0
        };
        let error_s = rest.seconds_since(Instant::ZERO) - expected_s;
        assert!((0.0..=1.1e-9).contains(&error_s), "{target_m} {error_s}");
        assert!((tracker.motion(rest).way_m - target_m).abs() < 1e-12);
        assert!(tracker.motion(rest).speed_mps.abs() < 1e-12);
    }
}

#[test]
fn it_speeds_up_again_when_more_way_comes_while_it_brakes() {
    let mut tracker = ExactTracker::new(LIMITS);
    tracker.place(Instant::ZERO, 0.0);
    tracker.aim(Instant::ZERO, 30.0);
    let braking = seconds(3.0 + 2.0 + 1.0);
    advance(&mut tracker, braking);
    let from = tracker.motion(braking);
    assert!((from.speed_mps - 4.0).abs() < 1e-9 && from.acceleration_mps2 < 0.0);
    tracker.aim(braking, 60.0);
    assert!(tracker.motion(braking).acceleration_mps2 > 0.0);
    let rest = rest_of(&mut tracker);
    // Braked from 21 m on for 1 s (5 m), so at 26 m with 4 m/s: 1 s and 5 m to full speed, then
    // 20 m at 6 m/s and 9 m to brake.
    let expected_s = 6.0 + 1.0 + 20.0 / 6.0 + 3.0;
    assert!((rest.seconds_since(Instant::ZERO) - expected_s).abs() < 2e-9);
    assert!((tracker.motion(rest).way_m - 60.0).abs() < 1e-12);
}

#[test]
fn what_it_cannot_stop_at_it_passes_by_its_braking_way_and_no_more() {
    let mut tracker = ExactTracker::new(LIMITS);
    tracker.place(Instant::ZERO, 0.0);
    tracker.aim(Instant::ZERO, 100.0);
    let late = seconds(5.0);
    advance(&mut tracker, late);
    assert!((tracker.motion(late).way_m - 21.0).abs() < 1e-9);
    assert!(!tracker.can_stop_at(late, 29.9) && tracker.can_stop_at(late, 30.0));
    tracker.aim(late, 22.0);
    let rest = rest_of(&mut tracker);
    assert!((rest.seconds_since(late) - 3.0).abs() < 2e-9);
    assert!((tracker.motion(rest).way_m - 30.0).abs() < 1e-9);
}

/// The fastest motion to a moving target in small steps: speeds up while it could still stop
/// after the step, else holds its speed, else brakes.
struct Stepped {
    way_m: f64,
    speed_mps: f64,
}

impl Stepped {
    fn step(&mut self, target_m: f64, step_s: f64) {
        let after = |speed_mps: f64| {
            self.way_m + 0.5 * (self.speed_mps + speed_mps) * step_s + LIMITS.braking_m(speed_mps)
        };
        let change_mps = LIMITS.acceleration_mps2 * step_s;
        let faster_mps = (self.speed_mps + change_mps).min(LIMITS.speed_max_mps);
        let next_mps = if after(faster_mps) <= target_m {
            faster_mps
        } else if after(self.speed_mps) <= target_m {
            self.speed_mps
        } else {
            (self.speed_mps - change_mps).max(0.0)
        };
        self.way_m += 0.5 * (self.speed_mps + next_mps) * step_s;
        self.speed_mps = next_mps;
    }
}

#[test]
fn random_changes_of_target_give_the_motion_of_a_fine_integration() {
    const STEP_S: f64 = 1e-4;
    let mut random = RandomStream::new(11, "exact tracker");
    for _ in 0..60 {
        let mut tracker = ExactTracker::new(LIMITS);
        tracker.place(Instant::ZERO, 0.0);
        let mut stepped = Stepped {
            way_m: 0.0,
            speed_mps: 0.0,
        };
        let mut target_m = 0.0;
        let mut worst_m: f64 = 0.0;
        let mut step_count = 0_u32;
        for _ in 0..6 {
            let now = seconds(f64::from(step_count) * STEP_S);
            advance(&mut tracker, now);
            let from = tracker.motion(now);
            let asked_m = from.way_m + 60.0 * random.uniform() - 5.0;
            if tracker.can_stop_at(now, asked_m) {
                target_m = asked_m;
                tracker.aim(now, target_m);
                // The same motion goes on.
                let onward = tracker.motion(now);
                assert!((onward.way_m - from.way_m).abs() < 1e-9);
                assert!((onward.speed_mps - from.speed_mps).abs() < 1e-9);
            }
            for _ in 0..10 + floor_index(50_000.0 * random.uniform()) {
                stepped.step(target_m, STEP_S);
                step_count += 1;
                let now = seconds(f64::from(step_count) * STEP_S);
                advance(&mut tracker, now);
                let motion = tracker.motion(now);
                worst_m = worst_m.max((motion.way_m - stepped.way_m).abs());
                assert!((0.0..=LIMITS.speed_max_mps + 1e-12).contains(&motion.speed_mps));
                assert!(motion.way_m <= target_m.max(from.way_m) + 1e-9);
            }
        }
        assert!(worst_m < 5e-3, "{worst_m}");
        let rest = rest_of(&mut tracker);
        let final_m = tracker.motion(rest).way_m;
        assert!((final_m - target_m).abs() < 1e-9, "{final_m} {target_m}");
    }
}
