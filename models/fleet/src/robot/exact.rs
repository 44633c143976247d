//! The exact tracker: full acceleration, full speed, full braking, each in closed form, at rest
//! exactly where it is aimed at. It integrates nothing and knows neither paths nor messages.

use crate::robot::tracker::{Limits, Motion};
use hil_core::time::Instant;

/// Ways closer than this are one way: far below a micrometre, far above rounding.
const WAY_TOLERANCE_M: f64 = 1e-9;

/// A stretch of constant acceleration.
#[derive(Debug, Clone, Copy, Default)]
struct Leg {
    /// When it begins, seconds after the plan's anchor.
    start_s: f64,
    way_m: f64,
    speed_mps: f64,
    acceleration_mps2: f64,
}

/// Accelerate, cruise, brake, rest.
const LEGS_MAX: usize = 4;

/// A robot's motion from its last change of mind until it rests.
#[derive(Debug, Clone)]
pub(crate) struct ExactTracker {
    limits: Limits,
    anchor: Instant,
    legs: [Leg; LEGS_MAX],
    leg_count: usize,
    current: usize,
    next_change: Option<Instant>,
}

impl ExactTracker {
    /// At rest at the beginning of the way.
    pub(crate) fn new(limits: Limits) -> Self {
        Self {
            limits,
            anchor: Instant::ZERO,
            legs: [Leg::default(); LEGS_MAX],
            leg_count: 1,
            current: 0,
            next_change: None,
        }
    }

    /// Puts it at rest at `way_m`.
    pub(crate) fn place(&mut self, now: Instant, way_m: f64) {
        self.begin_plan(now);
        self.rest_at(0.0, way_m);
    }

    /// Where it is at `now`, not before the last change.
    pub(crate) fn motion(&self, now: Instant) -> Motion {
        let elapsed_s = now.seconds_since(self.anchor);
        let mut index = self.current;
        while index + 1 < self.leg_count && self.legs[index + 1].start_s <= elapsed_s {
            index += 1;
        }
        let leg = &self.legs[index];
        let leg_s = elapsed_s - leg.start_s;
        let gained_mps = leg.acceleration_mps2 * leg_s;
        let way_m = leg.way_m + (leg.speed_mps + 0.5 * gained_mps) * leg_s;
        Motion {
            way_m: way_m.min(self.rest_m()),
            speed_mps: (leg.speed_mps + gained_mps).max(0.0),
            acceleration_mps2: leg.acceleration_mps2,
        }
    }

    /// Heads for `target_m`: as fast as may be, at rest there. When it cannot stop there any more
    /// it brakes at once and goes past.
    pub(crate) fn aim(&mut self, now: Instant, target_m: f64) {
        let from = self.motion(now);
        let Limits {
            speed_max_mps: top,
            acceleration_mps2: rate,
        } = self.limits;
        self.begin_plan(now);
        let (v, ahead_m) = (from.speed_mps, target_m - from.way_m);
        let braking_m = self.limits.braking_m(v);
        if ahead_m <= braking_m + WAY_TOLERANCE_M {
            let is_on_target = (ahead_m - braking_m).abs() <= WAY_TOLERANCE_M;
            let rest_m = if is_on_target {
                target_m
            } else {
                from.way_m + braking_m
            };
            if v > 0.0 {
                self.push(0.0, from.way_m, v, -rate);
            }
            self.rest_at(v / rate, rest_m);
            return;
        }
        let peak = (rate * ahead_m + 0.5 * v * v).sqrt().min(top).max(v);
        let (gain_s, gain_m) = ((peak - v) / rate, (peak * peak - v * v) / (2.0 * rate));
        if gain_s > 0.0 {
            self.push(0.0, from.way_m, v, rate);
        }
        let cruise_m = ahead_m - gain_m - self.limits.braking_m(peak);
        let cruise_s = if cruise_m > WAY_TOLERANCE_M {
            self.push(gain_s, from.way_m + gain_m, peak, 0.0);
            cruise_m / peak
        } else {
            0.0
        };
        let brake_s = gain_s + cruise_s;
        let brake_from_m = target_m - self.limits.braking_m(peak);
        self.push(brake_s, brake_from_m, peak, -rate);
        self.rest_at(brake_s + peak / rate, target_m);
    }

    /// Comes to rest as soon as it can.
    pub(crate) fn brake(&mut self, now: Instant) {
        self.aim(now, f64::NEG_INFINITY);
    }

    /// True when it can come to rest at or before `target_m`.
    pub(crate) fn can_stop_at(&self, now: Instant, target_m: f64) -> bool {
        let motion = self.motion(now);
        motion.way_m + self.limits.braking_m(motion.speed_mps) <= target_m + WAY_TOLERANCE_M
    }

    /// True when nothing will change until it is aimed anew.
    pub(crate) fn is_at_rest(&self) -> bool {
        self.current + 1 == self.leg_count
    }

    /// When its acceleration changes next, rounded up to the nanosecond.
    pub(crate) const fn next_change(&self) -> Option<Instant> {
        self.next_change
    }

    /// Goes over to the next leg; call at [`ExactTracker::next_change`].
    pub(crate) fn change(&mut self) {
        self.current = (self.current + 1).min(self.leg_count - 1);
        self.next_change = self.change_after(self.current);
    }

    fn change_after(&self, leg: usize) -> Option<Instant> {
        let next = self.legs[..self.leg_count].get(leg + 1)?;
        let at_ns = self.anchor.as_ns() + ceil_ns(next.start_s);
        Some(Instant::from_ns(at_ns))
    }

    fn rest_m(&self) -> f64 {
        self.legs[self.leg_count - 1].way_m
    }

    fn begin_plan(&mut self, now: Instant) {
        (self.anchor, self.leg_count, self.current) = (now, 0, 0);
    }

    fn push(&mut self, start_s: f64, way_m: f64, speed_mps: f64, acceleration_mps2: f64) {
        self.legs[self.leg_count] = Leg {
            start_s,
            way_m,
            speed_mps,
            acceleration_mps2,
        };
        self.leg_count += 1;
    }

    /// The last leg of a plan.
    fn rest_at(&mut self, start_s: f64, way_m: f64) {
        self.push(start_s, way_m, 0.0, 0.0);
        self.next_change = self.change_after(0);
    }
}

#[allow(
    clippy::cast_possible_truncation,
    reason = "a plan lasts seconds to hours, far below 2^63 ns"
)]
fn ceil_ns(seconds: f64) -> i64 {
    (seconds * 1e9).ceil() as i64
}
