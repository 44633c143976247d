//! The control law of guided motion for seven joints, and the lag of what is measured. It knows no
//! queue and no session.
//!
//! Law (ABB, "Externally Guided Motion", `RobotWare` 7): `speed = k (pos_ref - pos) + speed_ref`,
//! all joints slowed by one ratio where one would exceed its limit, then a first-order low-pass,
//! then integration over the nominal cycle up to the position limits.

use crate::egm::messages::EgmCommand;
use crate::egm::parameters::ControllerSettings;
use crate::yumi::arm::{POSITION_MAX_RAD, POSITION_MIN_RAD, SPEED_MAX_RAD_PER_S};
use crate::yumi::{JOINT_COUNT, Joints};
use hil_core::time::Instant;

/// Slower than this, an arm stands.
const REST_RAD_PER_S: f64 = 1e-3;

/// Slower than this is no motion: a degree would take thousands of years. Without the bound the
/// low-pass decays into denormal numbers, which cost the processor a hundredfold.
const STILL_RAD_PER_S: f64 = 1e-13;

/// What the law follows.
#[derive(Debug, Clone, Copy)]
pub(super) struct Reference {
    pub(super) position_rad: Joints,
    pub(super) speed_rad_per_s: Joints,
    pub(super) frame_index: u64,
    pub(super) arrived_at: Instant,
}

impl Reference {
    /// Stay at `q_rad`.
    pub(super) fn standing(q_rad: &Joints, at: Instant) -> Self {
        Self {
            position_rad: *q_rad,
            speed_rad_per_s: [0.0; JOINT_COUNT],
            frame_index: 0,
            arrived_at: at,
        }
    }

    /// What `command` asks for.
    #[inline]
    pub(super) fn set(&mut self, command: &EgmCommand, arrived_at: Instant) {
        self.position_rad = command.position_rad;
        self.speed_rad_per_s = if command.flags & EgmCommand::HAS_SPEED == 0 {
            [0.0; JOINT_COUNT]
        } else {
            command.speed_rad_per_s
        };
        self.frame_index = command.frame_index;
        self.arrived_at = arrived_at;
    }
}

/// The law's numbers, computed once per session.
#[derive(Debug, Clone, Copy)]
pub(super) struct Law {
    pub(super) step_s: f64,
    gain_per_s: f64,
    low_pass_share: f64,
    ramp_share_per_cycle: f64,
    deviation_max_rad_per_s: f64,
    inverse_speed_max: Joints,
}

impl Law {
    pub(super) fn new(settings: &ControllerSettings) -> Self {
        let step_s = settings.cycle.as_secs_f64();
        let low_pass_share = if settings.low_pass_hz > 0.0 {
            1.0 - (-core::f64::consts::TAU * settings.low_pass_hz * step_s).exp()
        } else {
            1.0
        };
        let ramp_share_per_cycle = if settings.ramp_in_s > step_s {
            step_s / settings.ramp_in_s
        } else {
            1.0
        };
        let deviation_max_rad_per_s = settings.max_speed_deviation_rad_per_s;
        Self {
            step_s,
            gain_per_s: settings.position_correction_ratio * settings.position_gain_per_s,
            low_pass_share,
            ramp_share_per_cycle,
            deviation_max_rad_per_s,
            inverse_speed_max: SPEED_MAX_RAD_PER_S
                .map(|own_max| own_max.min(deviation_max_rad_per_s).recip()),
        }
    }

    /// Share of the correction in the session's `cycle`-th cycle of motion, 0..=1.
    #[inline]
    pub(super) fn ramp(&self, cycle: u64) -> f64 {
        let share = cycle as f64 * self.ramp_share_per_cycle;
        if share < 1.0 { share } else { 1.0 }
    }
}

/// Which speed limit slowed the joints in a cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Binding {
    Nothing,
    /// A joint's own.
    Joint,
    /// `MaxSpeedDeviation`, with the highest speed the law asked for.
    Deviation {
        asked_rad_per_s: f64,
    },
}

/// Where the controller puts the joints.
#[derive(Debug, Clone)]
pub(super) struct Plan {
    q_rad: Joints,
    speed_rad_per_s: Joints,
    pub(super) is_at_limit: bool,
}

impl Plan {
    pub(super) fn standing(q_rad: Joints) -> Self {
        Self {
            q_rad,
            speed_rad_per_s: [0.0; JOINT_COUNT],
            is_at_limit: false,
        }
    }

    pub(super) fn q_rad(&self) -> &Joints {
        &self.q_rad
    }

    pub(super) fn is_at_rest(&self) -> bool {
        self.speed_rad_per_s
            .iter()
            .all(|speed| speed.abs() < REST_RAD_PER_S)
    }

    /// One cycle towards `reference`, with `ramp` of the correction.
    #[inline]
    pub(super) fn follow(&mut self, law: &Law, reference: &Reference, ramp: f64) -> Binding {
        let mut wanted: Joints = core::array::from_fn(|joint| {
            let error = reference.position_rad[joint] - self.q_rad[joint];
            ramp * (law.gain_per_s * error + reference.speed_rad_per_s[joint])
        });
        let mut excess_ratio = 0.0_f64;
        for (speed, inverse_max) in wanted.iter().zip(&law.inverse_speed_max) {
            let of_limit = speed.abs() * inverse_max;
            if of_limit > excess_ratio {
                excess_ratio = of_limit;
            }
        }
        let mut binding = Binding::Nothing;
        if excess_ratio > 1.0 {
            binding = binding_of(law, &wanted);
            let ratio = excess_ratio.recip();
            for speed in &mut wanted {
                *speed *= ratio;
            }
        }
        self.integrate(law, &wanted);
        binding
    }

    /// One cycle without a reference: the speed goes to zero through the low-pass.
    #[inline]
    pub(super) fn coast(&mut self, law: &Law) {
        self.integrate(law, &[0.0; JOINT_COUNT]);
    }

    #[inline]
    fn integrate(&mut self, law: &Law, wanted: &Joints) {
        let mut is_at_limit = false;
        for joint in 0..JOINT_COUNT {
            let before = self.speed_rad_per_s[joint];
            let passed = before + law.low_pass_share * (wanted[joint] - before);
            let is_moving = passed.abs() >= STILL_RAD_PER_S;
            let speed = if is_moving { passed } else { 0.0 };
            let q = self.q_rad[joint] + law.step_s * speed;
            let (min, max) = (POSITION_MIN_RAD[joint], POSITION_MAX_RAD[joint]);
            let above = if q < min { min } else { q };
            let within = if above > max { max } else { above };
            is_at_limit |= within.to_bits() != q.to_bits();
            self.speed_rad_per_s[joint] = speed;
            self.q_rad[joint] = within;
        }
        self.is_at_limit = is_at_limit;
    }

    /// Stands at `q_rad`, within the limits: the next point of a motion of the controller's own.
    pub(super) fn place(&mut self, q_rad: &Joints) {
        self.speed_rad_per_s = [0.0; JOINT_COUNT];
        for joint in 0..JOINT_COUNT {
            self.q_rad[joint] =
                q_rad[joint].clamp(POSITION_MIN_RAD[joint], POSITION_MAX_RAD[joint]);
        }
        self.is_at_limit = false;
    }
}

/// Which limit asks for the smaller ratio; the joints' own where both ask for the same.
#[cold]
fn binding_of(law: &Law, wanted: &Joints) -> Binding {
    let (mut own_ratio, mut asked_rad_per_s) = (0.0_f64, 0.0_f64);
    for (speed, own_max) in wanted.iter().zip(&SPEED_MAX_RAD_PER_S) {
        own_ratio = own_ratio.max(speed.abs() / own_max);
        asked_rad_per_s = asked_rad_per_s.max(speed.abs());
    }
    if asked_rad_per_s / law.deviation_max_rad_per_s > own_ratio {
        Binding::Deviation { asked_rad_per_s }
    } else {
        Binding::Joint
    }
}

/// Highest [`ControllerSettings::control_delay_cycles`].
pub(crate) const DELAY_CYCLES_MAX: usize = 16;

/// The measured joints: the planned ones of some cycles ago.
#[derive(Debug, Clone)]
pub(super) struct Delay {
    points: [Joints; DELAY_CYCLES_MAX],
    next: usize,
    pub(super) cycles: usize,
    measured_rad: Joints,
}

impl Delay {
    pub(super) fn new(cycles: usize, q_rad: &Joints) -> Self {
        Self {
            points: [*q_rad; DELAY_CYCLES_MAX],
            next: 0,
            cycles: cycles.min(DELAY_CYCLES_MAX),
            measured_rad: *q_rad,
        }
    }

    #[inline]
    pub(super) fn push(&mut self, planned_rad: &Joints) {
        if self.cycles == 0 {
            self.measured_rad = *planned_rad;
            return;
        }
        self.measured_rad = core::mem::replace(&mut self.points[self.next], *planned_rad);
        self.next += 1;
        if self.next == self.cycles {
            self.next = 0;
        }
    }

    pub(super) fn measured_rad(&self) -> &Joints {
        &self.measured_rad
    }
}
