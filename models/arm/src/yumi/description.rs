//! The two arms as a robot description: what every link looks like, and the same as URDF for tools that draw
//! robots. Positions of joints come from [`super::arm`], so nothing here can differ from them.
//!
//! URDF as `urdf/XML` of the ROS documentation has it: metres, radians, an origin's `rpy` about the
//! fixed axes x, y, z in this order, every joint about the z axis of its own frame.

use core::fmt;

use nalgebra::{Isometry3, Vector3};

use crate::yumi::arm::{Arm, POSITION_MAX_RAD, POSITION_MIN_RAD, SPEED_MAX_RAD_PER_S};
use crate::yumi::{CHAIN_TO_MAKER, JOINT_COUNT};

/// Radius of each part of an arm from its mount to its tool, metres: about the arm's own thickness.
const RADII_M: [f64; JOINT_COUNT] = [0.065, 0.06, 0.055, 0.05, 0.045, 0.04, 0.035];
/// Two fingers along the tool's z axis, so that its turn can be seen: distance from the axis, length and
/// radius, metres. No gripper is modelled.
const FINGER_M: [f64; 3] = [0.02, 0.06, 0.008];
/// Lower end and radius of the column under the arms, metres, for orientation: its size is not the robot's.
const COLUMN_M: [f64; 2] = [0.03, 0.06];
/// Radius of the shoulders, from the column's top to the mounts, metres.
const SHOULDER_RADIUS_M: f64 = 0.05;

/// What says which arm a name is about: the sides and the ends of the maker's joint names.
const SIDES: [(&str, &str); 2] = [("right", "r"), ("left", "l")];

/// A rod with round ends, in the frame that its user names.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rod {
    /// One end, metres.
    pub from_m: [f64; 3],
    /// The other end, metres.
    pub to_m: [f64; 3],
    /// Its radius, metres.
    pub radius_m: f64,
}

/// The maker's name of a joint: `place` in the chain from 0, on the `"right"` or another side. As in the
/// published descriptions of the robot, e.g. `yumi_joint_7_r` for the third of the right arm.
pub fn joint_name(side: &str, place: usize) -> String {
    let end = SIDES.iter().find(|(name, _)| *name == side);
    let end = end.map_or(String::new(), |(_, end)| format!("_{end}"));
    format!("yumi_joint_{}{end}", CHAIN_TO_MAKER[place])
}

/// The parts of an arm between frame `n` and frame `n + 1` of [`Arm::frames`]: radii, metres.
pub const fn link_radii_m() -> [f64; JOINT_COUNT] {
    RADII_M
}

/// What is drawn at an arm's end, in the frame of its tool.
pub fn fingers() -> [Rod; 2] {
    let [aside_m, length_m, radius_m] = FINGER_M;
    [-1.0, 1.0].map(|side| Rod {
        from_m: [side * aside_m, 0.0, 0.0],
        to_m: [side * aside_m, 0.0, length_m],
        radius_m,
    })
}

/// What carries the arms, in the body frame: a column and two shoulders.
pub fn body() -> [Rod; 3] {
    let mounts = arms().map(|arm| arm.frames(&[0.0; JOINT_COUNT])[0].translation.vector);
    let top = (mounts[0] + mounts[1]) / 2.0;
    let [foot_m, radius_m] = COLUMN_M;
    let column = Rod {
        from_m: [top.x - 0.02, top.y, foot_m],
        to_m: top.into(),
        radius_m,
    };
    let [right, left] = mounts.map(|mount| Rod {
        from_m: top.into(),
        to_m: mount.into(),
        radius_m: SHOULDER_RADIUS_M,
    });
    [column, right, left]
}

/// In the order of [`SIDES`].
fn arms() -> [Arm; 2] {
    [Arm::right(), Arm::left()]
}

/// The robot as URDF: root link `body`, then `right_mount`, `right_link_1` to `right_link_6`,
/// `right_tool`, and the same on the left.
#[derive(Debug, Clone, Copy)]
pub struct Urdf;

impl fmt::Display for Urdf {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(concat!(
            "<?xml version=\"1.0\"?>\n",
            "<!-- Both arms of an ABB YuMi (IRB 14000) as hil-runtime computes with them, in simple shapes.\n",
            "     Written by `hil-runtime documents`; joints and limits are those of the models. To be looked at,\n",
            "     not simulated: no masses, no collision shapes, and the effort that URDF asks for is 0 because\n",
            "     none is known. -->\n",
            "<robot name=\"yumi\">\n",
        ))?;
        for (name, color) in [
            ("body", "0.6 0.6 0.6"),
            ("right", "0.12 0.47 0.71"),
            ("left", "0.17 0.63 0.17"),
        ] {
            writeln!(
                out,
                "  <material name=\"{name}\"><color rgba=\"{color} 1\"/></material>"
            )?;
        }
        write_link(out, "body", "body", &body())?;
        for ((side, _), arm) in SIDES.iter().zip(arms()) {
            write_arm(out, side, &arm)?;
        }
        out.write_str("</robot>\n")
    }
}

fn write_arm(out: &mut fmt::Formatter<'_>, side: &str, arm: &Arm) -> fmt::Result {
    let frames = arm.frames(&[0.0; JOINT_COUNT]);
    let name = |frame: usize| match frame {
        0 => format!("{side}_mount"),
        JOINT_COUNT => format!("{side}_tool"),
        _ => format!("{side}_link_{frame}"),
    };
    writeln!(
        out,
        "  <joint name=\"{side}_mounting\" type=\"fixed\">\n    <parent link=\"body\"/><child link=\"{}\"/>\n    \
         {}\n  </joint>",
        name(0),
        origin(&frames[0])
    )?;
    for (frame, radius_m) in RADII_M.into_iter().enumerate() {
        let to_next = frames[frame].inv_mul(&frames[frame + 1]);
        let rod = Rod {
            from_m: [0.0; 3],
            to_m: to_next.translation.vector.into(),
            radius_m,
        };
        write_link(out, &name(frame), side, &[rod])?;
        let (lower, upper) = (POSITION_MIN_RAD[frame], POSITION_MAX_RAD[frame]);
        let speed = SPEED_MAX_RAD_PER_S[frame];
        writeln!(
            out,
            "  <joint name=\"{}\" type=\"revolute\">\n    <parent link=\"{}\"/><child link=\"{}\"/>\n    {}\n    \
             <axis xyz=\"0 0 1\"/>\n    \
             <limit lower=\"{lower}\" upper=\"{upper}\" velocity=\"{speed}\" effort=\"0\"/>\n  </joint>",
            joint_name(side, frame),
            name(frame),
            name(frame + 1),
            origin(&to_next),
        )?;
    }
    write_link(out, &name(JOINT_COUNT), side, &fingers())
}

fn write_link(
    out: &mut fmt::Formatter<'_>,
    name: &str,
    material: &str,
    rods: &[Rod],
) -> fmt::Result {
    writeln!(out, "  <link name=\"{name}\">")?;
    for rod in rods {
        let [from, to] = [rod.from_m, rod.to_m].map(Vector3::from);
        let along = to - from;
        let middle = (from + to) / 2.0;
        let pitch = along.xy().norm().atan2(along.z);
        let yaw = along.y.atan2(along.x);
        let shapes = [
            (
                middle,
                [0.0, pitch, yaw],
                format!(
                    "<cylinder radius=\"{}\" length=\"{}\"/>",
                    rod.radius_m,
                    number(along.norm())
                ),
            ),
            (
                to,
                [0.0; 3],
                format!("<sphere radius=\"{}\"/>", rod.radius_m),
            ),
        ];
        for (at, turn, shape) in shapes {
            writeln!(
                out,
                "    <visual>\n      <origin xyz=\"{}\" rpy=\"{}\"/>\n      <geometry>{shape}</geometry>\n      \
                 <material name=\"{material}\"/>\n    </visual>",
                triple(at.into()),
                triple(turn)
            )?;
        }
    }
    writeln!(out, "  </link>")
}

fn origin(frame: &Isometry3<f64>) -> String {
    format!(
        "<origin xyz=\"{}\" rpy=\"{}\"/>",
        triple(frame.translation.vector.into()),
        triple(roll_pitch_yaw(frame))
    )
}

/// Angles about the fixed axes x, y, z. A pitch of a quarter turn, which some joints have at zero, leaves
/// only the sum of the other two: all of it is then roll. The arcsine that is usual loses half of the digits there.
fn roll_pitch_yaw(frame: &Isometry3<f64>) -> [f64; 3] {
    /// Below this the rest of the matrix says nothing of roll and yaw apart from each other.
    const SINGULAR: f64 = 1e-9;
    let r = frame.rotation.to_rotation_matrix();
    let cosine = r[(0, 0)].hypot(r[(1, 0)]);
    let pitch = (-r[(2, 0)]).atan2(cosine);
    if cosine > SINGULAR {
        let roll = r[(2, 1)].atan2(r[(2, 2)]);
        return [roll, pitch, r[(1, 0)].atan2(r[(0, 0)])];
    }
    [(pitch.signum() * r[(0, 1)]).atan2(r[(1, 1)]), pitch, 0.0]
}

fn triple(values: [f64; 3]) -> String {
    values.map(number).join(" ")
}

/// To a picometre or picoradian, without the zeros at the end.
fn number(value: f64) -> String {
    let text = format!("{value:.12}");
    let short = text.trim_end_matches('0').trim_end_matches('.');
    if short == "-0" { "0" } else { short }.to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joints_have_the_names_of_the_published_descriptions() {
        let right = (0..JOINT_COUNT).map(|place| joint_name("right", place));
        let right: Vec<String> = right.collect();
        let expected = [1, 2, 7, 3, 4, 5, 6].map(|number| format!("yumi_joint_{number}_r"));
        assert_eq!(right, expected);
        assert_eq!(joint_name("left", 2), "yumi_joint_7_l");
        assert_eq!(joint_name("", 0), "yumi_joint_1");
    }

    #[test]
    fn angles_turn_back_into_the_rotation_also_where_two_of_them_are_one() {
        use core::f64::consts::FRAC_PI_2;
        for turn in [
            [0.3, -0.7, 2.1],
            [0.4, FRAC_PI_2, 0.9],
            [-1.2, -FRAC_PI_2, 0.5],
            [0.0, 0.0, 0.0],
        ] {
            let [roll, pitch, yaw] = turn;
            let rotation = nalgebra::UnitQuaternion::from_euler_angles(roll, pitch, yaw);
            let frame = Isometry3::from_parts(nalgebra::Translation3::identity(), rotation);
            let [roll, pitch, yaw] = roll_pitch_yaw(&frame);
            let again = nalgebra::UnitQuaternion::from_euler_angles(roll, pitch, yaw);
            assert!(rotation.angle_to(&again) < 1e-12, "{turn:?}");
        }
    }

    #[test]
    fn numbers_are_short() {
        assert_eq!(
            [0.5, -1e-17, 1.0, 0.0405].map(number),
            ["0.5", "0", "1", "0.0405"]
        );
    }

    #[test]
    fn parts_lie_where_the_frames_are() {
        let text = Urdf.to_string();
        assert_eq!(text.matches("type=\"revolute\"").count(), 2 * JOINT_COUNT);
        assert_eq!(text.matches("<link ").count(), 1 + 2 * (JOINT_COUNT + 1));
        let [_, right, left] = body();
        assert_eq!(
            right.from_m.map(f64::to_bits),
            left.from_m.map(f64::to_bits)
        );
        assert!(
            right.to_m[1] < 0.0 && left.to_m[1] > 0.0,
            "x forward, y left"
        );
    }
}
