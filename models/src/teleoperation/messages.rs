//! What the three roles tell each other. Layout only: no behaviour, no units other than SI. Joints
//! are in chain order, see [`crate::yumi`].

use bytemuck::{Pod, Zeroable};

use crate::message::Message;
use crate::yumi::{Joints, Pose};

/// Human to controller: where root and hands are.
///
/// Frame of reference: the capture's own, x to the person's left, y up, z forward, metres.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct HumanFrame {
    /// Grid point of the capture, counted from its start; a skipped point leaves a gap.
    pub frame_index: u64,
    /// Time of this frame since the motion's start, on the motion's own time axis: the same on
    /// every host.
    pub source_time_ns: i64,
    /// Pelvis.
    pub root: Pose,
    /// Right hand.
    pub right_hand: Pose,
    /// Left hand.
    pub left_hand: Pose,
}

impl Message for HumanFrame {
    const NAME: &'static str = "hil.HumanFrame.v1";
}

const _: () = assert!(size_of::<HumanFrame>() == 184);

/// Desired motion of one arm.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct ArmCommand {
    /// Desired joint positions, chain order.
    pub position_rad: Joints,
    /// Desired joint speeds, chain order; zero without feed-forward.
    pub speed_rad_per_s: Joints,
}

/// Controller to robot: where both arms shall be.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct JointCommand {
    /// The human frame this command answers.
    pub frame_index: u64,
    /// [`HumanFrame::source_time_ns`] of that frame.
    pub source_time_ns: i64,
    /// Right arm.
    pub right: ArmCommand,
    /// Left arm.
    pub left: ArmCommand,
    /// Bits below; all others are zero.
    pub flags: u32,
    /// Zero.
    pub reserved: u32,
}

impl JointCommand {
    /// No joint position reaches the right hand's target: the right arm holds.
    pub const RIGHT_UNREACHABLE: u32 = 1;
    /// As [`JointCommand::RIGHT_UNREACHABLE`], for the left arm.
    pub const LEFT_UNREACHABLE: u32 = 1 << 1;
    /// The right arm is on its way to the target but not there: a speed or position limit binds.
    pub const RIGHT_LIMITED: u32 = 1 << 2;
    /// As [`JointCommand::RIGHT_LIMITED`], for the left arm.
    pub const LEFT_LIMITED: u32 = 1 << 3;
    /// A hand moved farther in one frame than the mapping allows; the target follows slowly.
    pub const JUMP_LIMITED: u32 = 1 << 4;

    /// True when at least one arm's target is out of reach.
    pub const fn is_unreachable(&self) -> bool {
        self.flags & (Self::RIGHT_UNREACHABLE | Self::LEFT_UNREACHABLE) != 0
    }
}

impl Message for JointCommand {
    const NAME: &'static str = "hil.JointCommand.v1";
}

const _: () = assert!(size_of::<JointCommand>() == 248);

/// State of one arm.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct ArmStatus {
    /// Joint positions, chain order.
    pub measured_rad: Joints,
    /// The reference the servo follows, chain order.
    pub reference_rad: Joints,
    /// Tool centre point (the flange frame `tool0`) in the robot's body frame: x forward, y to
    /// the robot's left, z up.
    pub tool: Pose,
}

/// Robot to controller: where both arms are.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct JointStatus {
    /// Servo cycle, counted from the robot's start; a skipped cycle leaves a gap.
    pub cycle_index: u64,
    /// [`JointCommand::frame_index`] of the reference in use; meaningless without
    /// [`JointStatus::HAS_REFERENCE`].
    pub reference_frame_index: u64,
    /// Time since the reference in use arrived at the robot; without
    /// [`JointStatus::HAS_REFERENCE`], since the robot's start.
    pub reference_age_ns: i64,
    /// Right arm.
    pub right: ArmStatus,
    /// Left arm.
    pub left: ArmStatus,
    /// Bits below; all others are zero.
    pub flags: u32,
    /// Zero.
    pub reserved: u32,
}

impl JointStatus {
    /// At least one command has arrived since the robot's start.
    pub const HAS_REFERENCE: u32 = 1;
    /// Commands came before and have stopped: the robot holds the last reference.
    pub const HOLDING: u32 = 1 << 1;
    /// A joint of some arm stands at its position limit.
    pub const AT_POSITION_LIMIT: u32 = 1 << 2;
    /// The servo wanted to go faster than a joint of some arm can.
    pub const SPEED_LIMITED: u32 = 1 << 3;

    /// True when the robot holds the last reference because commands stopped.
    pub const fn is_holding(&self) -> bool {
        self.flags & Self::HOLDING != 0
    }
}

impl Message for JointStatus {
    const NAME: &'static str = "hil.JointStatus.v1";
}

const _: () = assert!(size_of::<JointStatus>() == 368);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_survive_their_bytes() {
        let mut frame = HumanFrame::zeroed();
        frame.frame_index = 7;
        frame.right_hand.position_m = [1.0, 2.0, 3.0];
        let bytes = bytemuck::bytes_of(&frame).to_vec();
        let back: HumanFrame = bytemuck::pod_read_unaligned(&bytes);
        assert_eq!(back, frame);
    }
}
