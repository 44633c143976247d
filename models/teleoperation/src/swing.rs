//! A synthetic human: standing, the right arm stretched forward, swinging from side to side. It
//! stands in for the recorded motion of the seed paper (section III.C), which is not public.
//!
//! The right hand's lateral position is `amplitude * sin(2 pi phase)`, first to the left. Frames
//! are placed by time: 4.033 s at 125 Hz are 504.125 frames, so a loop is never a whole number of
//! frames and looping by frame count would drift by 0.9 s in an hour.

use core::f64::consts::TAU;

use crate::bvh::Bvh;
use crate::motion::{Actor, HumanPose, LOOP_S};
use crate::skeleton::{Channel, Skeleton};
use hil_core::case_study::ParameterError;

/// Length unit of the skeleton: centimetres, as capture systems export.
pub const UNIT_M: f64 = 0.01;

const UPPER_ARM_CM: f64 = 28.0;
const FOREARM_CM: f64 = 26.0;
/// Shoulder to wrist of the stretched arm: the radius of the swing.
const ARM_LENGTH_M: f64 = (UPPER_ARM_CM + FOREARM_CM) * UNIT_M;

/// Channel values per frame: six of the root, three of each other joint.
const CHANNEL_COUNT: usize = 6 + 7 * 3;
const RIGHT_SHOULDER_YAW: usize = 9;
const LEFT_SHOULDER_ROLL: usize = 20;

/// The side-to-side swing.
#[derive(Debug, Clone)]
pub struct Swing {
    actor: Actor,
    amplitude_m: f64,
}

impl Swing {
    /// A swing of the right hand by `amplitude_m` to either side.
    ///
    /// # Errors
    /// When `amplitude_m` is outside 0.01..=0.4: the arm is 0.54 m long.
    pub fn new(amplitude_m: f64) -> Result<Self, ParameterError> {
        ParameterError::check("amplitude_m", amplitude_m, 0.01..=0.4, "0.01 to 0.4")?;
        Ok(Self {
            actor: person(),
            amplitude_m,
        })
    }

    /// Root and hands at `phase` of a loop, 0..1.
    pub fn at(&self, phase: f64) -> HumanPose {
        self.actor
            .pose(&channel_values(self.shoulder_yaw_rad(phase)))
    }

    /// Shoulder angle that puts the hand where the sine wants it.
    fn shoulder_yaw_rad(&self, phase: f64) -> f64 {
        (self.amplitude_m / ARM_LENGTH_M * (TAU * phase).sin()).asin()
    }
}

/// One loop of the swing as a motion file: frames at `0, 1 / rate_hz, …` below `period_s`.
///
/// # Errors
/// When `period_s` is outside 0.5..=60, `amplitude_m` outside 0.01..=0.4 or `rate_hz` outside
/// 10..=1000.
pub fn swing_bvh(period_s: f64, amplitude_m: f64, rate_hz: f64) -> Result<String, ParameterError> {
    ParameterError::check("motion_period_s", period_s, LOOP_S, "0.5 to 60")?;
    ParameterError::check("rate_hz", rate_hz, 10.0..=1000.0, "10 to 1000")?;
    let swing = Swing::new(amplitude_m)?;
    let frame_time_s = 1.0 / rate_hz;
    let times = (0_u32..)
        .map(|index| f64::from(index) * frame_time_s)
        .take_while(|time_s| *time_s < period_s);
    let values: Vec<f64> = times
        .flat_map(|time_s| channel_values(swing.shoulder_yaw_rad(time_s / period_s)))
        .collect();
    let bvh = Bvh {
        announced_count: values.len() / swing.actor.skeleton.channel_count(),
        cut_count: 0,
        skeleton: swing.actor.skeleton,
        frame_time_s,
        values,
    };
    Ok(bvh.to_text())
}

/// A person 1.75 m tall with arms stretched sideways.
fn person() -> Actor {
    use Channel::{Position, Rotation};
    let turns = [Rotation(1), Rotation(0), Rotation(2)];
    let root = [
        Position(0),
        Position(1),
        Position(2),
        Rotation(1),
        Rotation(0),
        Rotation(2),
    ];
    let mut person = Skeleton::default();
    let hips = person.push("Hips", None, [0.0; 3], &root);
    let spine = person.push("Spine", Some(hips), [0.0, 20.0, 0.0], &turns);
    let shoulder = person.push("RightArm", Some(spine), [-18.0, 28.0, 0.0], &turns);
    let elbow = person.push(
        "RightForeArm",
        Some(shoulder),
        [-UPPER_ARM_CM, 0.0, 0.0],
        &turns,
    );
    let right_hand = person.push("RightHand", Some(elbow), [-FOREARM_CM, 0.0, 0.0], &turns);
    let shoulder = person.push("LeftArm", Some(spine), [18.0, 28.0, 0.0], &turns);
    let elbow = person.push(
        "LeftForeArm",
        Some(shoulder),
        [UPPER_ARM_CM, 0.0, 0.0],
        &turns,
    );
    let left_hand = person.push("LeftHand", Some(elbow), [FOREARM_CM, 0.0, 0.0], &turns);
    debug_assert_eq!(person.channel_count(), CHANNEL_COUNT);
    Actor {
        skeleton: person,
        right_hand,
        left_hand,
        unit_m: UNIT_M,
    }
}

/// One frame: hips at standing height, right arm forward and turned by `yaw_rad` to the left,
/// left arm hanging.
fn channel_values(yaw_rad: f64) -> [f64; CHANNEL_COUNT] {
    let mut values = [0.0; CHANNEL_COUNT];
    values[1] = 95.0;
    // The rest pose stretches the right arm to -x; 90 degrees about y bring it to +z, forward.
    values[RIGHT_SHOULDER_YAW] = 90.0 + yaw_rad.to_degrees();
    values[LEFT_SHOULDER_ROLL] = -90.0;
    values
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Vector3};

    use super::*;
    use crate::motion::{Hands, Recording};

    fn apart_m(a: &Isometry3<f64>, b: Vector3<f64>) -> f64 {
        (a.translation.vector - b).norm()
    }

    #[test]
    fn the_hand_follows_a_sine_of_the_given_amplitude() {
        let swing = Swing::new(0.1875).unwrap();
        let middle_x_m = swing.at(0.0).right_hand.translation.x;
        for step in 0..100 {
            let phase = f64::from(step) / 100.0;
            let x_m = swing.at(phase).right_hand.translation.x - middle_x_m;
            assert!((x_m - 0.1875 * (TAU * phase).sin()).abs() < 1e-12);
        }
        let right = swing.at(0.0).right_hand;
        assert!(
            apart_m(&right, Vector3::new(-0.18, 1.43, 0.54)) < 1e-12,
            "{right:?}"
        );
        let left = swing.at(0.3).left_hand;
        assert!(
            apart_m(&left, Vector3::new(0.18, 0.89, 0.0)) < 1e-12,
            "{left:?}"
        );
    }

    #[test]
    fn a_loop_of_the_paper_has_505_frames_placed_by_time() {
        let bvh = Bvh::parse(&swing_bvh(4.033, 0.1875, 125.0).unwrap().as_str().into()).unwrap();
        assert_eq!(bvh.frame_count(), 505);
        assert!((bvh.frame_time_s - 0.008).abs() < 1e-12);
    }

    #[test]
    fn the_motion_file_read_back_moves_as_the_synthetic_human() {
        let text = swing_bvh(4.033, 0.1875, 125.0).unwrap();
        let recording = Bvh::parse(&text.as_str().into()).unwrap();
        let recording = Recording::new(&recording, Hands::default(), 4.033, UNIT_M).unwrap();
        let swing = Swing::new(0.1875).unwrap();
        for step in 0..2000 {
            let time_s = 4.033 * f64::from(step) / 2000.0;
            let (read, made) = (recording.at(time_s), swing.at(time_s / 4.033));
            // A chord between frames 8 ms apart misses the sine by at most 4 micrometres.
            let apart_m = apart_m(&read.right_hand, made.right_hand.translation.vector);
            assert!(apart_m < 5e-6, "{apart_m} m at {time_s} s");
            let turns = [
                (read.right_hand, made.right_hand, 1e-4),
                (read.left_hand, made.left_hand, 1e-6),
            ];
            for (read, made, tolerance_rad) in turns {
                assert!(read.rotation.angle_to(&made.rotation) < tolerance_rad);
            }
        }
    }

    #[test]
    fn an_amplitude_beyond_the_arm_is_refused() {
        assert_eq!(Swing::new(0.6).unwrap_err().key, "amplitude_m");
        assert_eq!(swing_bvh(4.0, 0.1, f64::NAN).unwrap_err().key, "rate_hz");
    }
}
