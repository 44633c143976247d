//! The robot side of one arm: follows a joint reference by the control law the maker publishes
//! for externally guided motion. No dynamics, no time-out and no session: a silent network makes
//! it hold the last reference for ever.
//!
//! Law (ABB, "Externally Guided Motion", `RobotWare` 7): `speed = k (pos_ref - pos) + speed_ref`,
//! all joints slowed by one ratio where one would exceed its limit, then a first-order low-pass,
//! then integration up to the position limits.

use core::time::Duration;

use crate::teleoperation::messages::ArmCommand;
use crate::time::{Instant, duration_ns};
use crate::yumi::arm::{JointVector, speed_ratio, within_limits};
use crate::yumi::{JOINT_COUNT, Joints};

/// The maker's adjustable parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ServoSettings {
    /// Position gain k, 1/s.
    pub gain_per_s: f64,
    /// Corner of the low-pass behind the speed, Hz; 0 switches it off.
    pub low_pass_hz: f64,
    /// Nominal cycle; a longer gap is integrated in steps of at most this.
    pub cycle: Duration,
}

/// One arm's servo.
#[derive(Debug, Clone)]
pub struct Servo {
    settings: ServoSettings,
    q_rad: JointVector,
    speed_rad_per_s: JointVector,
    reference: ArmCommand,
    moved_until: Instant,
    is_at_position_limit: bool,
    is_speed_limited: bool,
}

impl Servo {
    /// Stands at `q_rad` with that as reference.
    pub fn new(settings: ServoSettings, q_rad: Joints) -> Self {
        Self {
            settings,
            q_rad: q_rad.into(),
            speed_rad_per_s: JointVector::zeros(),
            reference: ArmCommand {
                position_rad: q_rad,
                speed_rad_per_s: [0.0; JOINT_COUNT],
            },
            moved_until: Instant::ZERO,
            is_at_position_limit: false,
            is_speed_limited: false,
        }
    }

    /// Time begins at `now`.
    pub fn start(&mut self, now: Instant) {
        self.moved_until = now;
    }

    /// Takes a reference for the time after [`Servo::moved_until`]. Its speed part goes on acting
    /// until the next reference, as on the real controller.
    pub fn set_reference(&mut self, reference: &ArmCommand) {
        self.reference = *reference;
    }

    /// Moves on to `now` with the present reference, by the time that really passed.
    pub fn advance(&mut self, now: Instant) {
        let elapsed_ns = now.ns_since(self.moved_until);
        if elapsed_ns <= 0 {
            return;
        }
        let cycle_ns = duration_ns(self.settings.cycle).max(1);
        // Steps no longer than a cycle keep the explicit integration stable after a gap.
        let step_count = elapsed_ns / cycle_ns + i64::from(elapsed_ns % cycle_ns != 0);
        let step_s = now.seconds_since(self.moved_until) / step_count as f64;
        let low_pass_share = if self.settings.low_pass_hz > 0.0 {
            1.0 - (-core::f64::consts::TAU * self.settings.low_pass_hz * step_s).exp()
        } else {
            1.0
        };
        (self.is_at_position_limit, self.is_speed_limited) = (false, false);
        for _ in 0..step_count {
            self.step(step_s, low_pass_share);
        }
        self.moved_until = now;
    }

    fn step(&mut self, step_s: f64, low_pass_share: f64) {
        let error = JointVector::from(self.reference.position_rad) - self.q_rad;
        let feed_forward = JointVector::from(self.reference.speed_rad_per_s);
        let wanted = self.settings.gain_per_s * error + feed_forward;
        let ratio = speed_ratio(&wanted);
        self.is_speed_limited |= ratio < 1.0;
        self.speed_rad_per_s += low_pass_share * (ratio * wanted - self.speed_rad_per_s);
        let (moved, is_clipped) = within_limits(&(self.q_rad + step_s * self.speed_rad_per_s));
        self.is_at_position_limit |= is_clipped;
        self.q_rad = moved;
    }

    /// Joint positions at [`Servo::moved_until`].
    pub fn q_rad(&self) -> &Joints {
        self.q_rad.as_ref()
    }

    /// The reference in use.
    pub fn reference(&self) -> &ArmCommand {
        &self.reference
    }

    /// Up to when the motion is computed.
    pub fn moved_until(&self) -> Instant {
        self.moved_until
    }

    /// True when a joint was stopped by its position limit in the last [`Servo::advance`].
    pub fn is_at_position_limit(&self) -> bool {
        self.is_at_position_limit
    }

    /// True when the law asked for more speed than a joint has in the last [`Servo::advance`].
    pub fn is_speed_limited(&self) -> bool {
        self.is_speed_limited
    }
}

#[cfg(test)]
#[path = "servo_tests.rs"]
mod tests;
