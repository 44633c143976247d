//! The arms as their messages tell of them: commanded and measured joints, and where these put the
//! links. Kinematics and shapes are those of the models, as in the robot's URDF.

use hil_arm::egm::messages::{EgmCommand, EgmFeedback, SessionState, Side};
use hil_arm::yumi::arm::Arm;
use hil_arm::yumi::description::{self, Rod};
use hil_arm::yumi::{Joints, Pose};
use serde::Serialize;

use super::{Told, rounded, seconds};

/// Position, and the quaternion w, x, y, z.
pub(crate) type Frame = [f64; 7];

/// `/live/arms`.
#[derive(Debug, Serialize)]
pub(crate) struct ArmsPicture {
    at_s: f64,
    body: [RodPicture; 3],
    fingers: [RodPicture; 2],
    pub(crate) shapes: Vec<Shape>,
    pub(crate) arms: Vec<ArmPicture>,
}

/// A rod in the frame of whoever has it.
#[derive(Debug, Serialize)]
#[expect(clippy::struct_field_names, reason = "each in its unit")]
struct RodPicture {
    from_m: [f64; 3],
    to_m: [f64; 3],
    radius_m: f64,
}

impl From<Rod> for RodPicture {
    fn from(rod: Rod) -> Self {
        let round = |place: [f64; 3]| place.map(|number| (number * 1e4).round() / 1e4);
        Self {
            from_m: round(rod.from_m),
            to_m: round(rod.to_m),
            radius_m: rod.radius_m,
        }
    }
}

/// A link of an arm, from one frame to another.
#[derive(Debug, Serialize)]
pub(crate) struct Shape {
    pub(crate) from: usize,
    pub(crate) to: usize,
    pub(crate) radius_m: f64,
}

/// An arm.
#[derive(Debug, Serialize)]
pub(crate) struct ArmPicture {
    pub(crate) side: &'static str,
    pub(crate) state: Option<&'static str>,
    pub(crate) session: Option<u32>,
    queue_count: Option<u32>,
    flags: Vec<&'static str>,
    desired_rad: Option<Joints>,
    measured_rad: Option<Joints>,
    desired_age_s: Option<f64>,
    measured_age_s: Option<f64>,
    pub(crate) tool_error_mm: Option<f64>,
    pub(crate) desired_frames: Option<Vec<Frame>>,
    pub(crate) measured_frames: Option<Vec<Frame>>,
}

/// Both arms.
#[derive(Debug)]
pub(crate) struct ArmsView {
    arms: [OneArm; 2],
}

#[derive(Debug)]
struct OneArm {
    side: Side,
    arm: Arm,
    command: Option<(EgmCommand, i64)>,
    feedback: Option<(EgmFeedback, i64)>,
}

impl ArmsView {
    /// Arms of which nothing is known yet.
    pub(crate) fn new() -> Self {
        let arm = |side| OneArm {
            side,
            arm: match side {
                Side::Right => Arm::right(),
                Side::Left => Arm::left(),
            },
            command: None,
            feedback: None,
        };
        Self {
            arms: Side::BOTH.map(arm),
        }
    }

    /// Takes what was told at `at_ns`.
    pub(crate) fn take(&mut self, told: &Told, at_ns: i64) {
        match *told {
            Told::Command(side, command) => {
                self.arms[side.index()].command = Some((command, at_ns));
            }
            Told::Feedback(side, feedback) => {
                self.arms[side.index()].feedback = Some((feedback, at_ns));
            }
            Told::State(_) | Told::Mission(_) | Told::Truth(_) => {}
        }
    }

    /// True once there is anything to show.
    pub(crate) fn is_known(&self) -> bool {
        self.arms
            .iter()
            .any(|arm| arm.command.is_some() || arm.feedback.is_some())
    }

    /// `/live/arms` at `now_ns`; `origin_ns` is the run's beginning.
    pub(crate) fn picture(&self, now_ns: i64, origin_ns: i64) -> ArmsPicture {
        let radii_m = description::link_radii_m();
        let shapes = radii_m.iter().enumerate();
        let shapes = shapes.map(|(from, radius_m)| Shape {
            from,
            to: from + 1,
            radius_m: *radius_m,
        });
        ArmsPicture {
            at_s: seconds(now_ns - origin_ns),
            body: description::body().map(RodPicture::from),
            fingers: description::fingers().map(RodPicture::from),
            shapes: shapes.collect(),
            arms: self.arms.iter().map(|arm| arm.picture(now_ns)).collect(),
        }
    }
}

impl OneArm {
    fn picture(&self, now_ns: i64) -> ArmPicture {
        let desired = self.command.map(|(command, _)| command.position_rad);
        let measured = self.feedback.map(|(feedback, _)| feedback.measured_rad);
        let [desired, measured] = [desired, measured].map(|joints| joints.filter(is_finite));
        let age = |at_ns: Option<i64>| at_ns.map(|at_ns| seconds((now_ns - at_ns).max(0)));
        let feedback = self.feedback.as_ref().map(|(feedback, _)| feedback);
        let state = feedback.and_then(EgmFeedback::session_state);
        let ends = desired.zip(measured);
        ArmPicture {
            side: self.side.word(),
            state: state.map(SessionState::word),
            session: feedback.map(|one| one.session),
            queue_count: feedback.map(|one| one.queue_count),
            flags: self.flags(),
            desired_rad: desired,
            measured_rad: measured,
            desired_age_s: age(self.command.map(|(_, at_ns)| at_ns)),
            measured_age_s: age(self.feedback.map(|(_, at_ns)| at_ns)),
            tool_error_mm: ends.map(|(one, other)| self.tool_error_mm(&one, &other)),
            desired_frames: desired.map(|joints| self.frames(&joints)),
            measured_frames: measured.map(|joints| self.frames(&joints)),
        }
    }

    fn flags(&self) -> Vec<&'static str> {
        let of_feedback = [
            (EgmFeedback::HOLDING, "holding"),
            (EgmFeedback::AT_POSITION_LIMIT, "at-position-limit"),
            (EgmFeedback::SPEED_LIMITED, "speed-limited"),
            (
                EgmFeedback::SPEED_DEVIATION_LIMITED,
                "speed-deviation-limited",
            ),
            (EgmFeedback::CONVERGED, "converged"),
        ];
        let of_command = [
            (EgmCommand::UNREACHABLE, "unreachable"),
            (EgmCommand::LIMITED, "limited"),
            (EgmCommand::JUMP_LIMITED, "jump-limited"),
            (EgmCommand::PARKED, "parked"),
        ];
        let feedback = self.feedback.map_or(0, |(one, _)| one.flags);
        let command = self.command.map_or(0, |(one, _)| one.flags);
        let set = |flags: u32| move |(bit, _): &&(u32, &str)| flags & *bit != 0;
        let words = of_feedback.iter().filter(set(feedback));
        let words = words.chain(of_command.iter().filter(set(command)));
        words.map(|(_, word)| *word).collect()
    }

    fn tool_error_mm(&self, desired: &Joints, measured: &Joints) -> f64 {
        let position = |joints| Pose::from(self.arm.tool(joints)).position_m;
        let (one, other) = (position(desired), position(measured));
        let squares = one.iter().zip(&other).map(|(a, b)| (a - b) * (a - b));
        rounded(1000.0 * squares.sum::<f64>().sqrt())
    }

    fn frames(&self, joints: &Joints) -> Vec<Frame> {
        let frames = self.arm.frames(joints).map(Pose::from);
        let numbers = frames.iter().map(|frame| {
            let ([x, y, z], [w, i, j, k]) = (frame.position_m, frame.quaternion_wxyz);
            [x, y, z, w, i, j, k].map(|number| (number * 1e4).round() / 1e4)
        });
        numbers.collect()
    }
}

fn is_finite(joints: &Joints) -> bool {
    joints.iter().all(|angle| angle.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;
    use hil_arm::yumi::arm::RIGHT_START_RAD;
    use serde_json::{Value, json};

    #[test]
    fn an_arm_that_is_where_it_shall_be_has_no_error_and_its_tool_at_its_last_frame() {
        let mut view = ArmsView::new();
        let (mut command, mut feedback) = (EgmCommand::zeroed(), EgmFeedback::zeroed());
        command.position_rad = RIGHT_START_RAD;
        (feedback.measured_rad, feedback.state) = (RIGHT_START_RAD, 4);
        feedback.flags = EgmFeedback::HOLDING;
        assert!(!view.is_known());
        view.take(&Told::Command(Side::Right, command), 0);
        view.take(&Told::Feedback(Side::Right, feedback), 500_000_000);
        let picture = json!(view.picture(1_000_000_000, 0));
        let [right, left] = [0, 1].map(|arm| &picture["arms"][arm]);
        assert_eq!(
            (&right["state"], &right["flags"]),
            (&json!("running"), &json!(["holding"]))
        );
        assert_eq!(
            (&right["desired_age_s"], &right["measured_age_s"]),
            (&json!(1.0), &json!(0.5))
        );
        assert_eq!(right["tool_error_mm"], 0.0);
        let tool = Pose::from(Arm::right().tool(&RIGHT_START_RAD)).position_m;
        let frame = &right["measured_frames"][7];
        for axis in 0..3 {
            assert!((frame[axis].as_f64().unwrap() - tool[axis]).abs() < 1e-4);
        }
        assert_eq!(left["measured_rad"], Value::Null);
        assert_eq!(left["desired_frames"], Value::Null);
    }

    #[test]
    fn the_error_is_the_way_between_the_tools() {
        let mut view = ArmsView::new();
        let (mut command, mut feedback) = (EgmCommand::zeroed(), EgmFeedback::zeroed());
        command.position_rad = RIGHT_START_RAD;
        feedback.measured_rad = RIGHT_START_RAD;
        feedback.measured_rad[0] += 0.01;
        view.take(&Told::Command(Side::Right, command), 0);
        view.take(&Told::Feedback(Side::Right, feedback), 0);
        let error_mm = json!(view.picture(0, 0))["arms"][0]["tool_error_mm"]
            .as_f64()
            .unwrap();
        // The tool is some tenths of a metre off the first joint's axis.
        assert!((1.0..8.0).contains(&error_mm), "{error_mm}");
    }
}
