//! The role "robot": both arms' servos at the robot's cycle. It has no session and no time-out:
//! when commands stop it holds the last one and says so.
//!
//! Within a cycle it works as the real controller does: move by the reference in use, report,
//! then take the newest command for the next cycle. Commands that came in between are passed over.

use core::time::Duration;

use crate::component::{Component, Outbox};
use crate::teleoperation::messages::{ArmCommand, ArmStatus, JointCommand, JointStatus};
use crate::teleoperation::parameters::TeleoperationParameters;
use crate::teleoperation::servo::Servo;
use crate::time::{Instant, PeriodicTimer, duration_ns};
use crate::yumi::arm::{Arm, LEFT_START_RAD, RIGHT_START_RAD};

/// The reference counts as held once it is older than this many command periods.
const HOLD_AFTER_PERIODS: u32 = 5;

/// The role.
#[derive(Debug)]
pub(crate) struct Robot {
    timer: PeriodicTimer,
    right: (Arm, Servo),
    left: (Arm, Servo),
    started: Instant,
    newest_command: Option<(Instant, JointCommand)>,
    reference: Option<(Instant, u64)>,
    hold_after: Duration,
}

impl Robot {
    /// A robot at rest in its start posture.
    pub(crate) fn new(parameters: &TeleoperationParameters) -> Self {
        let settings = parameters.servo();
        Self {
            timer: PeriodicTimer::new(settings.cycle),
            right: (Arm::right(), Servo::new(settings, RIGHT_START_RAD)),
            left: (Arm::left(), Servo::new(settings, LEFT_START_RAD)),
            started: Instant::ZERO,
            newest_command: None,
            reference: None,
            hold_after: parameters.frame_period() * HOLD_AFTER_PERIODS,
        }
    }

    fn status(&self, now: Instant, cycle_index: u64) -> JointStatus {
        let (since, reference_frame_index) = self.reference.unwrap_or((self.started, 0));
        let reference_age_ns = now.ns_since(since);
        let has_reference = self.reference.is_some();
        let is_holding = has_reference && reference_age_ns > duration_ns(self.hold_after);
        let servos = [&self.right.1, &self.left.1];
        let is_at_position_limit = servos.iter().any(|servo| servo.is_at_position_limit());
        let is_speed_limited = servos.iter().any(|servo| servo.is_speed_limited());
        let flags = [
            (has_reference, JointStatus::HAS_REFERENCE),
            (is_holding, JointStatus::HOLDING),
            (is_at_position_limit, JointStatus::AT_POSITION_LIMIT),
            (is_speed_limited, JointStatus::SPEED_LIMITED),
        ]
        .into_iter()
        .filter_map(|(is_set, bit)| is_set.then_some(bit))
        .sum();
        JointStatus {
            cycle_index,
            reference_frame_index,
            reference_age_ns,
            right: arm_status(&self.right),
            left: arm_status(&self.left),
            flags,
            reserved: 0,
        }
    }
}

fn arm_status((arm, servo): &(Arm, Servo)) -> ArmStatus {
    ArmStatus {
        measured_rad: *servo.q_rad(),
        reference_rad: servo.reference().position_rad,
        tool: arm.tool(servo.q_rad()).into(),
    }
}

/// Far beyond any joint, far below where the control law overflows.
const MAGNITUDE_MAX: f64 = 1e6;

/// A command of non-numbers, or so large that the law overflows, would poison the arm's state for
/// ever; the robot does not take it.
fn is_usable(command: &ArmCommand) -> bool {
    let speeds = command.speed_rad_per_s.iter();
    command
        .position_rad
        .iter()
        .chain(speeds)
        .all(|value| value.abs() <= MAGNITUDE_MAX)
}

impl Component for Robot {
    type Input = JointCommand;
    type Output = JointStatus;

    fn on_start(&mut self, now: Instant) {
        self.started = now;
        self.timer.start(now);
        self.right.1.start(now);
        self.left.1.start(now);
    }

    fn on_message(&mut self, now: Instant, input: &JointCommand, _out: &mut Outbox<JointStatus>) {
        if is_usable(&input.right) && is_usable(&input.left) {
            self.newest_command = Some((now, *input));
        }
    }

    fn on_tick(&mut self, now: Instant, out: &mut Outbox<JointStatus>) {
        let Some(tick) = self.timer.poll(now) else {
            return;
        };
        self.right.1.advance(now);
        self.left.1.advance(now);
        out.send(self.status(now, tick.index));
        if let Some((arrived, command)) = self.newest_command.take() {
            self.right.1.set_reference(&command.right);
            self.left.1.set_reference(&command.left);
            self.reference = Some((arrived, command.frame_index));
        }
    }

    fn next_tick(&self) -> Option<Instant> {
        self.timer.next()
    }

    fn skipped_ticks(&self) -> u64 {
        self.timer.skipped_total()
    }
}
