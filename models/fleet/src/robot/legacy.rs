//! The original's tracker, with its errors: Runge-Kutta steps from tick to tick, a braking point
//! computed ahead, and decisions only at ticks, so that it stops late by up to a tick. Between
//! ticks it stands. It knows neither paths nor messages.

use crate::geometry::floor_index;
use crate::robot::tracker::{Limits, Motion};
use hil_core::time::Instant;

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

    /// Brakes from the next tick on.
    pub(crate) fn brake(&mut self) {
        self.brake_from_m = f64::NEG_INFINITY;
        self.target_m = self.way_m;
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
