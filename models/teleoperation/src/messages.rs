//! What the human tells the controller. Layout only: no behaviour, no units other than SI. What
//! controller and robot tell each other is in [`hil_arm::egm::messages`].

use bytemuck::{Pod, Zeroable};

use hil_arm::yumi::Pose;
use hil_core::layout::Field;
use hil_core::message::Message;

/// Human to controller: where root and hands are.
///
/// Frame of reference: the capture's own, x to the person's left, y up, z forward, metres.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct HumanFrame {
    /// Grid point of the capture, counted from its start; a skipped point leaves a gap.
    pub frame_index: u64,
    /// Time of this frame since the capture's start, on the motion's own time axis: the same on
    /// every host.
    pub source_time_ns: i64,
    /// Pelvis.
    pub root: Pose,
    /// Right hand.
    pub right_hand: Pose,
    /// Left hand.
    pub left_hand: Pose,
}

hil_core::layout!(HumanFrame {
    frame_index,
    source_time_ns,
    root,
    right_hand,
    left_hand
});

impl Message for HumanFrame {
    const NAME: &'static str = "hil.HumanFrame.v1";
    const FIELDS: &'static [Field] = Self::LAYOUT;
}

const _: () = assert!(size_of::<HumanFrame>() == 184);

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
