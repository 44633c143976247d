//! One arm's way from the human hand to joint positions: mapping, then inverse kinematics. It knows
//! no session and sends nothing.

use nalgebra::Isometry3;

use crate::mapping::{Clutch, MappingSettings};
use hil_arm::yumi::arm::{Arm, JointVector};
use hil_arm::yumi::inverse::{Reach, Tracker};
use hil_arm::yumi::{JOINT_COUNT, Joints};

/// One arm that follows a hand, or holds.
#[derive(Debug, Clone)]
pub(crate) struct Follower {
    arm: Arm,
    goal: Goal,
    tracker: Tracker,
    blend: Option<Blend>,
}

#[derive(Debug, Clone)]
enum Goal {
    /// Where the mapping puts the hand.
    Hand(Clutch),
    /// Always there, body frame.
    Posture(Isometry3<f64>),
}

/// A glide from where the arm was to where it shall be.
#[derive(Debug, Clone)]
struct Blend {
    from: Isometry3<f64>,
    elapsed_s: f64,
    length_s: f64,
}

/// One arm's answer to a frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Followed {
    pub(crate) position_rad: Joints,
    pub(crate) speed_rad_per_s: Joints,
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
        let clutch = Clutch::engage(settings, hand, &arm.tool(&q_rad));
        Self::towards(Goal::Hand(clutch), arm, q_rad)
    }

    /// Keeps `arm` at `q_rad` whatever the hand does.
    pub(crate) fn holding(arm: Arm, q_rad: Joints) -> Self {
        Self::towards(Goal::Posture(arm.tool(&q_rad)), arm, q_rad)
    }

    fn towards(goal: Goal, arm: Arm, q_rad: Joints) -> Self {
        Self {
            tracker: Tracker::new(*arm.chain(), q_rad),
            goal,
            arm,
            blend: None,
        }
    }

    /// True when no hand moves it.
    pub(crate) fn is_holding(&self) -> bool {
        matches!(self.goal, Goal::Posture(_))
    }

    /// From now on starts at `q_rad` and glides to its goal within `length_s`.
    pub(crate) fn blend_from(&mut self, q_rad: Joints, length_s: f64) {
        self.blend = Some(Blend {
            from: self.arm.tool(&q_rad),
            elapsed_s: 0.0,
            length_s,
        });
        self.tracker.restart_at(q_rad);
    }

    /// The answer to the hand at `hand`, `elapsed_s` after the previous frame; without a hand, to
    /// where it was.
    pub(crate) fn follow(&mut self, hand: Option<&Isometry3<f64>>, elapsed_s: f64) -> Followed {
        let before = JointVector::from(*self.tracker.q_rad());
        let (mut target, is_jump_limited) = match &mut self.goal {
            Goal::Hand(clutch) => clutch.follow(hand),
            Goal::Posture(posture) => (*posture, false),
        };
        if let Some(blend) = &mut self.blend {
            blend.elapsed_s += elapsed_s;
            if blend.elapsed_s < blend.length_s {
                let share = blend.elapsed_s / blend.length_s;
                // Starts and ends at the speed of what it joins.
                let share = share * share * (3.0 - 2.0 * share);
                target = blend.from.lerp_slerp(&target, share);
            } else {
                self.blend = None;
            }
        }
        let target = self.arm.from_body(&target);
        let reach = self.tracker.track(&target, elapsed_s);
        let position_rad = *self.tracker.q_rad();
        let speed_rad_per_s = if elapsed_s > 0.0 {
            ((JointVector::from(position_rad) - before) / elapsed_s).into()
        } else {
            [0.0; JOINT_COUNT]
        };
        Followed {
            position_rad,
            speed_rad_per_s,
            reach,
            is_jump_limited,
        }
    }
}
