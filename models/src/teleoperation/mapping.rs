//! From a human hand to a robot tool: clutched, scaled, aligned. It solves no kinematics.
//!
//! At the moment of engagement hand `H0` and tool `R0` are stored; from then on
//!
//! `p = p_R0 + s A (p_h - p_H0)`, `q = A (q_h q_H0^-1) A^-1 q_R0`
//!
//! with scale `s` and axis alignment `A`. The operator may therefore start from any posture
//! (relative mapping; Lv et al., section III.C, use the scale 0.8). The formula is ours: the
//! paper's own mapping strategy is described in its reference 13 only.

use crate::teleoperation::spatial::{Orientation, Pose, Vector3, add, length, scaled, subtract};

/// Turns the capture's axes (x left, y up, z forward) into the body's (x forward, y left, z up):
/// a third of a turn about the space diagonal.
pub const CAPTURE_TO_BODY: Orientation = Orientation {
    wxyz: [0.5, 0.5, 0.5, 0.5],
};

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
    hand_origin: Pose,
    tool_origin: Pose,
    target: Pose,
}

impl Clutch {
    /// Engages with the hand (capture frame) and the tool (body frame) where they are now. Both
    /// must be poses of finite numbers.
    pub fn engage(settings: MappingSettings, hand: &Pose, tool: &Pose) -> Self {
        Self {
            settings,
            hand_origin: normalised(hand),
            tool_origin: *tool,
            target: *tool,
        }
    }

    /// Where the tool shall be now that the hand is at `hand`, and whether the jump limit held
    /// it back. A hand that is not a pose of finite numbers leaves the target where it is.
    pub fn follow(&mut self, hand: &Pose) -> (Pose, bool) {
        if !hand.is_finite() {
            return (self.target, true);
        }
        let wanted = self.wanted(&normalised(hand));
        let step_m = length(subtract(wanted.position_m, self.target.position_m));
        let step_rad = self.target.orientation.angle_to(wanted.orientation);
        let share = (self.settings.jump_max_m / step_m)
            .min(self.settings.jump_max_rad / step_rad)
            .min(1.0);
        let is_limited = share < 1.0;
        self.target = if is_limited {
            self.target.interpolate(&wanted, share)
        } else {
            wanted
        };
        (self.target, is_limited)
    }

    fn wanted(&self, hand: &Pose) -> Pose {
        let moved = subtract(hand.position_m, self.hand_origin.position_m);
        let moved = CAPTURE_TO_BODY.rotate(moved);
        let turned = hand
            .orientation
            .after(self.hand_origin.orientation.inverse());
        let turned = CAPTURE_TO_BODY
            .after(turned)
            .after(CAPTURE_TO_BODY.inverse());
        let (moved, turned) = if self.settings.is_mirrored {
            (reflected(moved), reflected_turn(turned))
        } else {
            (moved, turned)
        };
        let moved = scaled(moved, self.settings.scale_ratio);
        Pose {
            position_m: add(self.tool_origin.position_m, moved),
            orientation: turned.after(self.tool_origin.orientation).normalised(),
        }
    }
}

/// Another producer's quaternion may be of any length; the mapping needs a rotation.
fn normalised(hand: &Pose) -> Pose {
    Pose {
        orientation: hand.orientation.normalised(),
        ..*hand
    }
}

fn reflected([x, y, z]: Vector3) -> Vector3 {
    [x, -y, z]
}

/// A rotation seen in a mirror normal to y: its axis is reflected, its sense reversed.
fn reflected_turn(turn: Orientation) -> Orientation {
    let [w, x, y, z] = turn.wxyz;
    Orientation {
        wxyz: [w, -x, y, -z],
    }
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

    const HAND: Pose = Pose {
        position_m: [-0.2, 1.4, 0.5],
        orientation: Orientation::IDENTITY,
    };

    fn tool() -> Pose {
        Pose {
            position_m: [0.4, -0.2, 0.1],
            orientation: Orientation::about_axis(0, 1.0),
        }
    }

    fn moved_by(step: Vector3) -> Pose {
        Pose {
            position_m: add(HAND.position_m, step),
            ..HAND
        }
    }

    #[track_caller]
    fn check_step(settings: MappingSettings, hand_step: Vector3, tool_step: Vector3) {
        let mut clutch = Clutch::engage(settings, &HAND, &tool());
        let (target, is_limited) = clutch.follow(&moved_by(hand_step));
        let moved = subtract(target.position_m, tool().position_m);
        assert!(length(subtract(moved, tool_step)) < 1e-12, "{moved:?}");
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
        let hand = Pose {
            orientation: Orientation::about_axis(1, 0.3),
            ..HAND
        };
        for (is_mirrored, angle) in [(false, 0.3), (true, -0.3)] {
            let settings = MappingSettings {
                is_mirrored,
                ..SETTINGS
            };
            let mut clutch = Clutch::engage(settings, &HAND, &tool());
            let expected = Orientation::about_axis(2, angle).after(tool().orientation);
            let (target, _) = clutch.follow(&hand);
            assert!(target.orientation.angle_to(expected) < 1e-7);
        }
    }

    #[test]
    fn engaging_moves_nothing() {
        let mut clutch = Clutch::engage(SETTINGS, &HAND, &tool());
        let (target, _) = clutch.follow(&HAND);
        assert!(length(subtract(target.position_m, tool().position_m)) < 1e-15);
        assert!(target.orientation.angle_to(tool().orientation) < 1e-7);
    }

    #[test]
    fn a_jump_is_walked_in_steps_of_the_limit_and_arrives() {
        let settings = MappingSettings {
            jump_max_m: 0.03,
            ..SETTINGS
        };
        let mut clutch = Clutch::engage(settings, &HAND, &tool());
        let hand = moved_by([0.1, 0.0, 0.0]);
        let mut last = tool();
        for frame in 0..5 {
            let (target, is_limited) = clutch.follow(&hand);
            let step_m = length(subtract(target.position_m, last.position_m));
            assert!(step_m < 0.03 + 1e-12);
            assert_eq!(is_limited, frame < 2, "frame {frame}");
            last = target;
        }
        assert!((last.position_m[1] - tool().position_m[1] - 0.08).abs() < 1e-12);
    }

    #[test]
    fn a_hand_of_nonsense_numbers_leaves_the_target() {
        let mut clutch = Clutch::engage(SETTINGS, &HAND, &tool());
        let (target, is_limited) = clutch.follow(&moved_by([f64::NAN, 0.0, 0.0]));
        assert!(is_limited && target.position_m[0].is_finite());
        assert!(!clutch.follow(&HAND).1);
    }
}
