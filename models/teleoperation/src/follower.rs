//! One arm's way from the human hand to joint positions: mapping, then inverse kinematics. It knows
//! no session and sends nothing.

use nalgebra::{Isometry3, Quaternion, UnitQuaternion, Vector3};

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

/// Turns the capture's axes (x left, y up, z forward) into the body's (x forward, y left, z up):
/// a third of a turn about the space diagonal.
pub(crate) const CAPTURE_TO_BODY: UnitQuaternion<f64> =
    UnitQuaternion::new_unchecked(Quaternion::new(0.5, 0.5, 0.5, 0.5));

/// How a hand's motion becomes a tool's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct MappingSettings {
    /// Tool path length per hand path length.
    pub(crate) scale_ratio: f64,
    /// Reflects the motion at the body's plane of symmetry, for the arm on the other side.
    pub(crate) is_mirrored: bool,
    /// Farthest the target may move from one frame to the next, metres.
    pub(crate) jump_max_m: f64,
    /// Farthest the target may turn from one frame to the next, radians.
    pub(crate) jump_max_rad: f64,
}

/// An engaged mapping.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Clutch {
    settings: MappingSettings,
    hand_origin: Isometry3<f64>,
    tool_origin: Isometry3<f64>,
    target: Isometry3<f64>,
}

impl Clutch {
    /// Engages with the hand (capture frame) and the tool (body frame) where they are now.
    pub(crate) fn engage(
        settings: MappingSettings,
        hand: &Isometry3<f64>,
        tool: &Isometry3<f64>,
    ) -> Self {
        Self {
            settings,
            hand_origin: *hand,
            tool_origin: *tool,
            target: *tool,
        }
    }

    /// Where the tool shall be now that the hand is at `hand`, and whether the jump limit held
    /// it back. Without a hand the target stays where it is and counts as held back.
    pub(crate) fn follow(&mut self, hand: Option<&Isometry3<f64>>) -> (Isometry3<f64>, bool) {
        let Some(hand) = hand else {
            return (self.target, true);
        };
        let wanted = self.wanted(hand);
        let step_m = (wanted.translation.vector - self.target.translation.vector).norm();
        let step_rad = self.target.rotation.angle_to(&wanted.rotation);
        let share = (self.settings.jump_max_m / step_m)
            .min(self.settings.jump_max_rad / step_rad)
            .min(1.0);
        let is_limited = share < 1.0;
        if is_limited {
            self.target = self.target.lerp_slerp(&wanted, share);
            // Frame upon frame of limited steps would let the quaternion's length wander.
            self.target.rotation.renormalize();
        } else {
            self.target = wanted;
        }
        (self.target, is_limited)
    }

    fn wanted(&self, hand: &Isometry3<f64>) -> Isometry3<f64> {
        let moved = hand.translation.vector - self.hand_origin.translation.vector;
        let turned = hand.rotation * self.hand_origin.rotation.inverse();
        let mut moved = CAPTURE_TO_BODY * moved;
        let mut turned = CAPTURE_TO_BODY * turned * CAPTURE_TO_BODY.inverse();
        if self.settings.is_mirrored {
            (moved, turned) = (reflected(moved), reflected_turn(turned));
        }
        let position = self.tool_origin.translation.vector + self.settings.scale_ratio * moved;
        Isometry3::from_parts(position.into(), turned * self.tool_origin.rotation)
    }
}

fn reflected(step: Vector3<f64>) -> Vector3<f64> {
    Vector3::new(step.x, -step.y, step.z)
}

/// A rotation seen in a mirror normal to y: its axis is reflected, its sense reversed.
fn reflected_turn(turn: UnitQuaternion<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::new_unchecked(Quaternion::new(turn.w, -turn.i, turn.j, -turn.k))
}

#[cfg(test)]
mod mapping_tests {
    use super::*;

    const SETTINGS: MappingSettings = MappingSettings {
        scale_ratio: 0.8,
        is_mirrored: false,
        jump_max_m: 1.0,
        jump_max_rad: 3.0,
    };

    fn hand() -> Isometry3<f64> {
        Isometry3::translation(-0.2, 1.4, 0.5)
    }

    fn tool() -> Isometry3<f64> {
        let turned = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), 1.0);
        Isometry3::from_parts([0.4, -0.2, 0.1].into(), turned)
    }

    fn moved_by(step: [f64; 3]) -> Isometry3<f64> {
        Isometry3::from(step) * hand()
    }

    fn apart_m(a: &Isometry3<f64>, b: &Isometry3<f64>) -> f64 {
        (a.translation.vector - b.translation.vector).norm()
    }

    #[track_caller]
    fn check_step(settings: MappingSettings, hand_step: [f64; 3], tool_step: [f64; 3]) {
        let mut clutch = Clutch::engage(settings, &hand(), &tool());
        let (target, is_limited) = clutch.follow(Some(&moved_by(hand_step)));
        let expected = Isometry3::from(tool_step) * tool();
        assert!(apart_m(&target, &expected) < 1e-12, "{target:?}");
        assert!(!is_limited);
    }

    #[test]
    fn left_up_and_forward_stay_left_up_and_forward() {
        check_step(SETTINGS, [0.1, 0.0, 0.0], [0.0, 0.08, 0.0]);
        check_step(SETTINGS, [0.0, 0.1, 0.0], [0.0, 0.0, 0.08]);
        check_step(SETTINGS, [0.0, 0.0, 0.1], [0.08, 0.0, 0.0]);
        let mirrored = MappingSettings {
            is_mirrored: true,
            ..SETTINGS
        };
        check_step(mirrored, [0.1, 0.1, 0.1], [0.08, -0.08, 0.08]);
    }

    #[test]
    fn turning_the_hand_about_up_turns_the_tool_about_up() {
        let turned = hand() * UnitQuaternion::from_axis_angle(&Vector3::y_axis(), 0.3);
        for (is_mirrored, angle) in [(false, 0.3), (true, -0.3)] {
            let settings = MappingSettings {
                is_mirrored,
                ..SETTINGS
            };
            let mut clutch = Clutch::engage(settings, &hand(), &tool());
            let about_up = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle);
            let (target, _) = clutch.follow(Some(&turned));
            assert!(target.rotation.angle_to(&(about_up * tool().rotation)) < 1e-12);
        }
    }

    #[test]
    fn engaging_moves_nothing() {
        let mut clutch = Clutch::engage(SETTINGS, &hand(), &tool());
        let (target, _) = clutch.follow(Some(&hand()));
        assert!(apart_m(&target, &tool()) < 1e-15);
        assert!(target.rotation.angle_to(&tool().rotation) < 1e-15);
    }

    #[test]
    fn a_jump_is_walked_in_steps_of_the_limit_and_arrives() {
        let settings = MappingSettings {
            jump_max_m: 0.03,
            ..SETTINGS
        };
        let mut clutch = Clutch::engage(settings, &hand(), &tool());
        let far = moved_by([0.1, 0.0, 0.0]);
        let mut last = tool();
        for frame in 0..5 {
            let (target, is_limited) = clutch.follow(Some(&far));
            assert!(apart_m(&target, &last) < 0.03 + 1e-12);
            assert_eq!(is_limited, frame < 2, "frame {frame}");
            last = target;
        }
        assert!((last.translation.y - tool().translation.y - 0.08).abs() < 1e-12);
    }

    #[test]
    fn without_a_hand_the_target_stays() {
        let mut clutch = Clutch::engage(SETTINGS, &hand(), &tool());
        assert_eq!(clutch.follow(None), (tool(), true));
        assert!(!clutch.follow(Some(&hand())).1);
    }
}
