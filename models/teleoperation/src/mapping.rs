//! From a human hand to a robot tool: clutched, scaled, aligned. It solves no kinematics.
//!
//! At the moment of engagement hand `H0` and tool `R0` are stored; from then on
//!
//! `p = p_R0 + s A (p_h - p_H0)`, `q = A (q_h q_H0^-1) A^-1 q_R0`
//!
//! with scale `s` and axis alignment `A`. The operator may therefore start from any posture
//! (relative mapping; Lv et al., section III.C, use the scale 0.8). The formula is ours: the
//! paper's own mapping strategy is described in its reference 13 only.

use nalgebra::{Isometry3, Quaternion, UnitQuaternion, Vector3};

/// Turns the capture's axes (x left, y up, z forward) into the body's (x forward, y left, z up):
/// a third of a turn about the space diagonal.
pub const CAPTURE_TO_BODY: UnitQuaternion<f64> =
    UnitQuaternion::new_unchecked(Quaternion::new(0.5, 0.5, 0.5, 0.5));

/// How a hand's motion becomes a tool's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MappingSettings {
    /// Tool path length per hand path length.
    pub scale_ratio: f64,
    /// Reflects the motion at the body's plane of symmetry, for the arm on the other side.
    pub is_mirrored: bool,
    /// Farthest the target may move from one frame to the next, metres.
    pub jump_max_m: f64,
    /// Farthest the target may turn from one frame to the next, radians.
    pub jump_max_rad: f64,
}

/// An engaged mapping.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Clutch {
    settings: MappingSettings,
    hand_origin: Isometry3<f64>,
    tool_origin: Isometry3<f64>,
    target: Isometry3<f64>,
}

impl Clutch {
    /// Engages with the hand (capture frame) and the tool (body frame) where they are now.
    pub fn engage(settings: MappingSettings, hand: &Isometry3<f64>, tool: &Isometry3<f64>) -> Self {
        Self {
            settings,
            hand_origin: *hand,
            tool_origin: *tool,
            target: *tool,
        }
    }

    /// Where the tool shall be now that the hand is at `hand`, and whether the jump limit held
    /// it back. Without a hand the target stays where it is and counts as held back.
    pub fn follow(&mut self, hand: Option<&Isometry3<f64>>) -> (Isometry3<f64>, bool) {
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
mod tests {
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
