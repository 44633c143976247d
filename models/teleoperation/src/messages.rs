//! What the human tells the controller. Layout only: no behaviour, no units other than SI. What
//! controller and robot tell each other is in [`hil_arm::egm::messages`].

use hil_arm::yumi::Pose;

hil_core::message! {
    /// Human to controller: where root and hands are.
    ///
    /// Frame of reference: the capture's own, x to the person's left, y up, z forward, metres.
    pub struct HumanFrame = "hil.HumanFrame.v1", 184 bytes {
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
}

#[cfg(test)]
mod tests {
    use bytemuck::Zeroable;

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
