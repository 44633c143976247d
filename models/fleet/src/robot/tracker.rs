//! What both trackers have in common, and the choice between them. A tracker moves along a way;
//! which path and why is not its business.
//!
//! The exact tracker has full acceleration, full speed, full braking, each in closed form, and is at
//! rest exactly where it is aimed at. The original's tracker has its errors: Runge-Kutta steps from
//! tick to tick, a braking point computed ahead, and decisions only at ticks, so that it stops late
//! by up to a tick.

use crate::geometry::floor_index;
use crate::robot::{RobotParameters, TrackerKind};
use crate::world::Vehicle;
use hil_core::time::Instant;

/// What a vehicle can do.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Limits {
    pub(crate) speed_max_mps: f64,
    pub(crate) acceleration_mps2: f64,
}

impl Limits {
    pub(crate) const fn of(vehicle: &Vehicle) -> Self {
        Self {
            speed_max_mps: vehicle.speed_max_mps,
            acceleration_mps2: vehicle.acceleration_mps2,
        }
    }

    /// Way from `speed_mps` to rest.
    pub(crate) fn braking_m(&self, speed_mps: f64) -> f64 {
        speed_mps * speed_mps / (2.0 * self.acceleration_mps2)
    }
}

/// Where a robot is along its path and how it moves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Motion {
    pub(crate) way_m: f64,
    pub(crate) speed_mps: f64,
    pub(crate) acceleration_mps2: f64,
}

/// Either tracker.
#[derive(Debug, Clone)]
pub(crate) enum Tracker {
    Exact(ExactTracker),
    Legacy(LegacyTracker),
}

impl Tracker {
    pub(crate) fn new(parameters: &RobotParameters, limits: Limits) -> Self {
        match parameters.tracker {
            TrackerKind::Exact => Self::Exact(ExactTracker::new(limits)),
            TrackerKind::LegacyRk4 => {
                let period_s = 1e-3 * parameters.tracking_period_ms;
                Self::Legacy(LegacyTracker::new(limits, period_s))
            }
        }
    }

    pub(crate) fn place(&mut self, now: Instant, way_m: f64, end_m: f64) {
        match self {
            Self::Exact(tracker) => tracker.place(now, way_m),
            Self::Legacy(tracker) => tracker.place(now, way_m, end_m),
        }
    }

    /// What the robot reports.
    pub(crate) fn motion(&self, now: Instant) -> Motion {
        match self {
            Self::Exact(tracker) => tracker.motion(now),
            Self::Legacy(tracker) => tracker.motion(),
        }
    }

    /// How the robot truly moves from `now` on: between its ticks the legacy tracker stands.
    pub(crate) fn true_motion(&self, now: Instant) -> Motion {
        match self {
            Self::Exact(tracker) => tracker.motion(now),
            Self::Legacy(tracker) => Motion {
                way_m: tracker.motion().way_m,
                speed_mps: 0.0,
                acceleration_mps2: 0.0,
            },
        }
    }

    pub(crate) fn aim(&mut self, now: Instant, target_m: f64) {
        match self {
            Self::Exact(tracker) => tracker.aim(now, target_m),
            Self::Legacy(tracker) => tracker.aim(target_m),
        }
    }

    pub(crate) fn can_stop_at(&self, now: Instant, target_m: f64) -> bool {
        match self {
            Self::Exact(tracker) => tracker.can_stop_at(now, target_m),
            Self::Legacy(tracker) => tracker.can_stop_at(target_m),
        }
    }

    pub(crate) fn is_at_rest(&self) -> bool {
        match self {
            Self::Exact(tracker) => tracker.is_at_rest(),
            Self::Legacy(tracker) => tracker.is_at_rest(),
        }
    }

    /// When the motion changes by itself; the legacy tracker's does at its ticks only.
    pub(crate) fn next_change(&self) -> Option<Instant> {
        match self {
            Self::Exact(tracker) => tracker.next_change(),
            Self::Legacy(_) => None,
        }
    }

    pub(crate) fn change(&mut self) {
        if let Self::Exact(tracker) = self {
            tracker.change();
        }
    }
}

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

/// The braking table reaches this far above the largest speed.
const TABLE_SPEED_RATIO: f64 = 1.1;

/// A robot's motion, as of its last tick.
#[derive(Debug, Clone)]
pub(crate) struct LegacyTracker {
    limits: Limits,
    half_period_s: f64,
    /// Speeds and the ways to brake from them, ascending.
    braking_table: Box<[(f64, f64)]>,
    way_m: f64,
    speed_mps: f64,
    acceleration_mps2: f64,
    end_m: f64,
    target_m: f64,
    /// `positionToSlowDown` of the original: from here on it brakes.
    brake_from_m: f64,
    is_holding: bool,
    last_tick: Instant,
}

impl LegacyTracker {
    /// At rest at the beginning of the way.
    pub(crate) fn new(limits: Limits, tracking_period_s: f64) -> Self {
        let half_period_s = 0.5 * tracking_period_s;
        Self {
            limits,
            half_period_s,
            braking_table: braking_table(limits, half_period_s),
            way_m: 0.0,
            speed_mps: 0.0,
            acceleration_mps2: 0.0,
            end_m: 0.0,
            target_m: 0.0,
            brake_from_m: f64::NEG_INFINITY,
            is_holding: true,
            last_tick: Instant::ZERO,
        }
    }

    /// Puts it at rest at `way_m` of a way `end_m` long.
    pub(crate) fn place(&mut self, now: Instant, way_m: f64, end_m: f64) {
        (self.way_m, self.end_m, self.last_tick) = (way_m, end_m, now);
        (self.speed_mps, self.acceleration_mps2) = (0.0, 0.0);
        (self.brake_from_m, self.is_holding) = (f64::NEG_INFINITY, true);
    }

    /// Where it was at its last tick, and so is until the next.
    pub(crate) fn motion(&self) -> Motion {
        Motion {
            way_m: self.way_m,
            speed_mps: self.speed_mps.max(0.0),
            acceleration_mps2: self.acceleration_mps2,
        }
    }

    /// Heads for `target_m` from the next tick on.
    pub(crate) fn aim(&mut self, target_m: f64) {
        self.target_m = target_m;
        self.brake_from_m = self.braking_point_m(target_m);
    }

    /// True when it need not brake at once to stop at `target_m`.
    pub(crate) fn can_stop_at(&self, target_m: f64) -> bool {
        if self.speed_mps <= 0.0 {
            return self.way_m <= target_m;
        }
        self.way_m < self.braking_point_m(target_m)
    }

    /// True when the next tick will not move it.
    pub(crate) fn is_at_rest(&self) -> bool {
        self.is_holding && self.way_m >= self.brake_from_m
    }

    /// One tick: moves by the time since the last one. The decision to brake rests on where the
    /// last tick left it, so that it falls late by what it has moved since.
    pub(crate) fn tick(&mut self, now: Instant) {
        let step_s = now.seconds_since(self.last_tick);
        self.last_tick = now;
        if self.is_at_rest() {
            return;
        }
        let is_braking = self.way_m >= self.brake_from_m;
        if is_braking && self.speed_mps < 0.0 {
            if self.target_m >= self.end_m {
                self.way_m = self.end_m;
            }
            (self.speed_mps, self.acceleration_mps2) = (0.0, 0.0);
            self.is_holding = true;
            return;
        }
        self.is_holding = false;
        self.acceleration_mps2 = acceleration(
            self.limits,
            self.limits.speed_max_mps,
            self.speed_mps,
            is_braking,
        );
        let (way_m, speed_mps) = runge_kutta(self.way_m, self.speed_mps, step_s, |speed| {
            acceleration(self.limits, self.limits.speed_max_mps, speed, is_braking)
        });
        // A step that ends at a negative speed may end behind where it began; robots do not.
        self.way_m = way_m.max(self.way_m).min(self.end_m);
        self.speed_mps = speed_mps;
    }

    /// From where it must brake to stop at `target_m`: simulated ahead in steps of half a tracking
    /// period until the way the table asks for would not fit any more.
    fn braking_point_m(&self, target_m: f64) -> f64 {
        let top = self.limits.speed_max_mps;
        let (mut way_m, mut speed_mps) = (self.way_m, self.speed_mps.max(0.0));
        loop {
            let spare_m = target_m - way_m - self.braking_m(speed_mps);
            if spare_m < 0.0 || way_m >= target_m {
                return way_m;
            }
            if speed_mps > top {
                // Nothing changes any more but the way: as many steps at once as fit.
                let step_m = speed_mps * self.half_period_s;
                return way_m + step_m * ((spare_m / step_m).floor() + 1.0);
            }
            (way_m, speed_mps) = runge_kutta(way_m, speed_mps, self.half_period_s, |speed| {
                acceleration(self.limits, top, speed, false)
            });
        }
    }

    /// The table's way for the next higher speed.
    fn braking_m(&self, speed_mps: f64) -> f64 {
        let last = self.braking_table.len() - 1;
        // The table's speeds are even steps up to its end but for the last.
        let step_mps = self.limits.acceleration_mps2 * self.half_period_s;
        let mut index = floor_index(speed_mps / step_mps).min(last);
        while index > 0 && self.braking_table[index - 1].0 >= speed_mps {
            index -= 1;
        }
        while index < last && self.braking_table[index].0 < speed_mps {
            index += 1;
        }
        self.braking_table[index].1
    }
}

fn acceleration(limits: Limits, top_mps: f64, speed_mps: f64, is_braking: bool) -> f64 {
    if is_braking {
        -limits.acceleration_mps2
    } else if speed_mps > top_mps {
        0.0
    } else {
        limits.acceleration_mps2
    }
}

/// One classical fourth-order step of way and speed.
fn runge_kutta(
    way_m: f64,
    speed_mps: f64,
    step_s: f64,
    acceleration: impl Fn(f64) -> f64,
) -> (f64, f64) {
    let first = acceleration(speed_mps);
    let second_mps = speed_mps + 0.5 * step_s * first;
    let second = acceleration(second_mps);
    let third_mps = speed_mps + 0.5 * step_s * second;
    let third = acceleration(third_mps);
    let fourth_mps = speed_mps + step_s * third;
    let fourth = acceleration(fourth_mps);
    let sixth_s = step_s / 6.0;
    (
        way_m + sixth_s * (speed_mps + 2.0 * second_mps + 2.0 * third_mps + fourth_mps),
        speed_mps + sixth_s * (first + 2.0 * second + 2.0 * third + fourth),
    )
}

fn braking_table(limits: Limits, step_s: f64) -> Box<[(f64, f64)]> {
    let top_mps = TABLE_SPEED_RATIO * limits.speed_max_mps;
    let (mut way_m, mut speed_mps) = (0.0, 0.0);
    let mut table = vec![(speed_mps, way_m)];
    while speed_mps < top_mps {
        (way_m, speed_mps) = runge_kutta(way_m, speed_mps, step_s, |speed| {
            acceleration(limits, top_mps, speed, false)
        });
        table.push((speed_mps, way_m));
    }
    table.into()
}
