//! The role "controller": human frame to joint command, by mapping and inverse kinematics. Only
//! messages drive it; it has no clock of its own.

use nalgebra::Isometry3;

use crate::component::{Component, Outbox};
use crate::teleoperation::mapping::{Clutch, MappingSettings};
use crate::teleoperation::messages::{ArmCommand, HumanFrame, JointCommand, JointStatus};
use crate::teleoperation::parameters::{LeftArm, TeleoperationParameters};
use crate::time::Instant;
use crate::yumi::arm::{Arm, JointVector};
use crate::yumi::inverse::{Reach, Tracker};
use crate::yumi::{JOINT_COUNT, Joints};

crate::message_set! {
    /// What the controller hears, in channel order.
    pub(crate) enum ControllerInput { Frame(HumanFrame), Status(JointStatus) }
}

/// Frames farther apart than this count as one this far apart: after an outage the arm does not
/// get the whole gap's worth of speed at once.
const ELAPSED_MAX_S: f64 = 0.1;

/// The role. It engages on the first sound human frame after the first robot status, from the
/// posture that status reports; before that it says nothing.
#[derive(Debug)]
pub(crate) struct Controller {
    parameters: TeleoperationParameters,
    newest_status: Option<JointStatus>,
    engaged: Option<Engaged>,
}

#[derive(Debug)]
struct Engaged {
    source_time_ns: i64,
    right: Follower,
    left: Follower,
}

/// One arm's way from hand to joints.
#[derive(Debug, Clone)]
pub(crate) struct Follower {
    arm: Arm,
    clutch: Option<Clutch>,
    tracker: Tracker,
}

/// One arm's command and how it came about.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Followed {
    pub(crate) command: ArmCommand,
    pub(crate) reach: Reach,
    pub(crate) is_jump_limited: bool,
}

impl Follower {
    /// Engages `arm` at `q_rad` with the hand at `hand`.
    pub(crate) fn engage(
        arm: Arm,
        q_rad: Joints,
        settings: MappingSettings,
        hand: &Isometry3<f64>,
    ) -> Self {
        Self {
            clutch: Some(Clutch::engage(settings, hand, &arm.tool(&q_rad))),
            ..Self::holding(arm, q_rad)
        }
    }

    /// Keeps `arm` at `q_rad` whatever the hand does.
    fn holding(arm: Arm, q_rad: Joints) -> Self {
        Self {
            tracker: Tracker::new(*arm.chain(), q_rad),
            clutch: None,
            arm,
        }
    }

    /// The command for the hand at `hand`, `elapsed_s` after the previous frame; without a hand,
    /// for where it was.
    pub(crate) fn follow(
        &mut self,
        hand: Option<&Isometry3<f64>>,
        elapsed_s: f64,
        feed_forward: bool,
    ) -> Followed {
        let before = JointVector::from(*self.tracker.q_rad());
        let (mut reach, mut is_jump_limited) = (Reach::Reached, false);
        if let Some(clutch) = &mut self.clutch {
            let (target, is_limited) = clutch.follow(hand);
            is_jump_limited = is_limited;
            reach = self.tracker.track(&self.arm.from_body(&target), elapsed_s);
        }
        let position_rad = *self.tracker.q_rad();
        let speed_rad_per_s = if feed_forward && elapsed_s > 0.0 {
            ((JointVector::from(position_rad) - before) / elapsed_s).into()
        } else {
            [0.0; JOINT_COUNT]
        };
        Followed {
            command: ArmCommand {
                position_rad,
                speed_rad_per_s,
            },
            reach,
            is_jump_limited,
        }
    }
}

impl Controller {
    pub(crate) fn new(parameters: TeleoperationParameters) -> Self {
        Self {
            parameters,
            newest_status: None,
            engaged: None,
        }
    }

    fn engage(&self, frame: &HumanFrame) -> Option<Engaged> {
        let status = self.newest_status.as_ref()?;
        let hand = frame.right_hand.isometry()?;
        let joints = status.right.measured_rad.iter();
        let mut joints = joints.chain(&status.left.measured_rad);
        if !joints.all(|q| q.is_finite()) {
            return None;
        }
        let follow = |arm, q_rad, is_mirrored| {
            let settings = self.parameters.mapping(is_mirrored);
            Follower::engage(arm, q_rad, settings, &hand)
        };
        Some(Engaged {
            source_time_ns: frame.source_time_ns,
            right: follow(Arm::right(), status.right.measured_rad, false),
            left: match self.parameters.left_arm {
                LeftArm::Hold => Follower::holding(Arm::left(), status.left.measured_rad),
                LeftArm::Mirror => follow(Arm::left(), status.left.measured_rad, true),
            },
        })
    }

    fn command(&mut self, frame: &HumanFrame) -> Option<JointCommand> {
        if self.engaged.is_none() {
            self.engaged = self.engage(frame);
        }
        let feed_forward = self.parameters.feed_forward;
        let frame_s = self.parameters.frame_period().as_secs_f64();
        let engaged = self.engaged.as_mut()?;
        let since_previous_ns = frame.source_time_ns.saturating_sub(engaged.source_time_ns);
        engaged.source_time_ns = frame.source_time_ns;
        // The first frame, and one of a human that started anew, count as one period.
        let elapsed_s = if since_previous_ns > 0 {
            (since_previous_ns as f64 * 1e-9).min(ELAPSED_MAX_S)
        } else {
            frame_s
        };
        let hand = frame.right_hand.isometry();
        let right = engaged.right.follow(hand.as_ref(), elapsed_s, feed_forward);
        let left = engaged.left.follow(hand.as_ref(), elapsed_s, feed_forward);
        let flag = |is_set: bool, bit: u32| if is_set { bit } else { 0 };
        let flags = flag(
            right.reach == Reach::Unreachable,
            JointCommand::RIGHT_UNREACHABLE,
        ) | flag(
            left.reach == Reach::Unreachable,
            JointCommand::LEFT_UNREACHABLE,
        ) | flag(
            right.reach == Reach::Approaching,
            JointCommand::RIGHT_LIMITED,
        ) | flag(left.reach == Reach::Approaching, JointCommand::LEFT_LIMITED)
            | flag(
                right.is_jump_limited || left.is_jump_limited,
                JointCommand::JUMP_LIMITED,
            );
        Some(JointCommand {
            frame_index: frame.frame_index,
            source_time_ns: frame.source_time_ns,
            right: right.command,
            left: left.command,
            flags,
            reserved: 0,
        })
    }
}

impl Component for Controller {
    type Input = ControllerInput;
    type Output = JointCommand;

    fn on_start(&mut self, _now: Instant) {}

    fn on_message(
        &mut self,
        _now: Instant,
        input: &ControllerInput,
        out: &mut Outbox<JointCommand>,
    ) {
        match input {
            ControllerInput::Status(status) => self.newest_status = Some(*status),
            ControllerInput::Frame(frame) => {
                if let Some(command) = self.command(frame) {
                    out.send(command);
                }
            }
        }
    }

    fn on_tick(&mut self, _now: Instant, _out: &mut Outbox<JointCommand>) {}

    fn next_tick(&self) -> Option<Instant> {
        None
    }

    fn skipped_ticks(&self) -> u64 {
        0
    }
}
