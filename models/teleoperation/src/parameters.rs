//! `[case.parameters]` of the teleoperation case, their ranges, and the motion file. It opens no
//! file: whoever can, hands the text in. The robot's own settings are in
//! [`hil_arm::egm::parameters`].

use core::time::Duration;

use crate::bvh::Bvh;
use crate::experiment::TableParameters;
use crate::follower::MappingSettings;
use crate::motion::{Hands, Motion, MotionError, Recording};
use crate::swing::Swing;
use hil_arm::egm::parameters::{EgmParameters, EgmStartRequest};
use hil_core::case_study::ParameterError;
use hil_core::text_file::TextFile;

hil_core::words! {
    /// What the left arm does.
    #[derive(Default)]
    pub enum LeftArm {
        /// Holds its start posture.
        #[default]
        Hold = "hold",
        /// Mirrors what the right hand does.
        Mirror = "mirror",
    }
}

hil_core::words! {
    /// When the controller sends commands.
    #[derive(Default)]
    pub enum SendPolicy {
        /// One per human frame and arm.
        #[default]
        Frame = "frame",
        /// One per feedback of the arm, as the maker recommends.
        Coupled = "coupled",
        /// `send_hz` per second and arm, whatever comes in.
        Free = "free",
    }
}

hil_core::words! {
    /// Where an arm goes when guided motion is back after a session ended.
    #[derive(Default)]
    pub enum ResumePolicy {
        /// To where it would be had nothing happened, as fast as the robot lets it.
        #[default]
        Jump = "jump",
        /// There too, but gliding from where the arm is within `blend_s`.
        Blend = "blend",
        /// Nowhere: hand and tool are taken anew where they are, and the motion goes on from there.
        Reclutch = "reclutch",
    }
}

hil_core::options! {
    /// `[case.parameters]` of the teleoperation case. The defaults are the seed paper's figures where
    /// it gives them (section III.C) and the maker's defaults otherwise.
    pub struct TeleoperationParameters with {
        /// The text of `motion_file`, once it was read.
        #[serde(skip)]
        motion_text: Option<TextFile> = None,
    }
    {
        /// Length of one motion loop, s.
        motion_period_s: f64 = 4.033, in 0.5..=60.0;
        /// How long the human rests before the motion begins, s: nobody swings before guided
        /// motion runs, and an arm that engages in the midst of a swing works off its centre.
        motion_start_s: f64 = 2.0, in 0.0..=60.0;
        /// Frame rate of the motion capture, Hz.
        rate_hz: f64 = 125.0, in 10.0..=1000.0;
        /// How far the synthetic human swings the hand to either side, m. Without effect
        /// with a `motion_file`.
        amplitude_m: f64 = 0.1875, in 0.01..=0.4;
        /// Standard deviation of a loop's period as a share of the period; the amplitude's
        /// is three times that. Zero repeats the same loop for ever.
        loop_variation_ratio: f64 = 0.0, in 0.0..=0.05;
        /// Tool path length per hand path length.
        mapping_scale_ratio: f64 = 0.8, in 0.1..=2.0;
        /// Farthest a target may move between two frames, m.
        jump_max_m: f64 = 0.02, in 0.001..=1.0;
        /// What the left arm does.
        left_arm: LeftArm = LeftArm::Hold;
        /// True adds the joints' own speed to each command, so that the robot need not lag.
        feed_forward: bool = false;
        /// When commands are sent.
        send: SendPolicy = SendPolicy::Frame;
        /// Commands per second and arm with `send = "free"`, Hz; 250 when left out. Refused
        /// with any other `send`.
        send_hz: Option<f64>, in 1.0..=1000.0;
        /// Where an arm goes when guided motion is back.
        resume: ResumePolicy = ResumePolicy::Jump;
        /// How long the way of `resume = "blend"` takes, s.
        blend_s: f64 = 1.0, in 0.1..=10.0;
        /// How long it takes until an arm that went idle is asked to start again, s: with
        /// `egm.restart = "external_trigger"` people and programs take 2 to 10.
        trigger_after_s: f64 = 3.0, in 0.0..=60.0;
        /// A BVH motion file to play instead of the synthetic swing. Whoever can open files puts its
        /// text in by [`TeleoperationParameters::read_files`].
        motion_file: Option<String>;
        /// The joint of the motion file that is the right hand, where its name does not say so.
        motion_right_hand: Option<String>;
        /// The joint that is the left hand.
        motion_left_hand: Option<String>;
        /// Length unit of the motion file, m.
        motion_unit_m: f64 = 0.01, in 1e-4..=1.0;
        /// The robot's settings.
        egm: EgmParameters;
        /// What the controller asks for instead of them.
        egm_start: EgmStartRequest;
        /// What `hil-runtime tables` and `calibrate` compute.
        tables: TableParameters;
    }
    check TeleoperationParameters::check_sending;
}

/// Commands per second and arm where nothing is said: as many as the robot has cycles.
const SEND_HZ_DEFAULT: f64 = 250.0;

/// Farthest a target may turn between two frames. At the default rate that is 12 rad/s, twice
/// what a hand does.
const JUMP_MAX_RAD: f64 = 0.1;

impl TeleoperationParameters {
    /// Reads the files the parameters name, by `read`, which gives a file's text or says why not.
    ///
    /// # Errors
    /// What `read` said, under the key `motion_file`.
    pub fn read_files(
        &mut self,
        read: &mut dyn FnMut(&str) -> Result<TextFile, String>,
    ) -> Result<(), ParameterError> {
        if let Some(path) = &self.motion_file {
            let text = read(path).map_err(|reason| motion_file_error(path, &reason))?;
            self.motion_text = Some(text);
        }
        Ok(())
    }

    fn check_sending(&self) -> Result<(), ParameterError> {
        if let Some(send_hz) = self.send_hz
            && self.send != SendPolicy::Free
        {
            let problem = format!("{send_hz} has no effect: it needs send = \"free\"");
            return Err(ParameterError::new("send_hz", problem));
        }
        Ok(())
    }

    /// The motion to play.
    ///
    /// # Errors
    /// When the motion file was not read, is no motion file, or does not fill the period.
    pub fn motion(&self) -> Result<Motion, ParameterError> {
        let Some(path) = &self.motion_file else {
            return Swing::new(self.amplitude_m).map(Motion::Synthetic);
        };
        let bvh = self.bvh(path)?;
        let hands = Hands {
            right: self.motion_right_hand.as_deref(),
            left: self.motion_left_hand.as_deref(),
        };
        let (period_s, unit_m) = (self.motion_period_s, self.motion_unit_m);
        Recording::new(&bvh, hands, period_s, unit_m)
            .map(Motion::Recorded)
            .map_err(|error| match error {
                MotionError::MissingJoint { .. } => ParameterError::new(
                    "motion_file",
                    format!("{path}: {error}; name it with motion_right_hand or motion_left_hand"),
                ),
                MotionError::TooShort { .. } => motion_file_error(path, &error),
            })
    }

    /// What is unusual about the motion file, in words without full stop.
    pub(crate) fn motion_remark(&self) -> Option<String> {
        let path = self.motion_file.as_deref()?;
        let remark = self.bvh(path).ok()?.remark()?;
        Some(format!("motion_file {path}: {remark}"))
    }

    fn bvh(&self, path: &str) -> Result<Bvh, ParameterError> {
        let Some(text) = &self.motion_text else {
            return Err(motion_file_error(path, &"its text was not handed in"));
        };
        Bvh::parse(text).map_err(|error| motion_file_error(path, &error))
    }

    /// Commands per second and arm with [`SendPolicy::Free`].
    pub(crate) fn send_hz(&self) -> f64 {
        self.send_hz.unwrap_or(SEND_HZ_DEFAULT)
    }

    /// From frame to frame.
    pub(crate) fn frame_period(&self) -> Duration {
        Duration::from_secs_f64(1.0 / self.rate_hz)
    }

    pub(crate) fn mapping(&self, is_mirrored: bool) -> MappingSettings {
        MappingSettings {
            scale_ratio: self.mapping_scale_ratio,
            is_mirrored,
            jump_max_m: self.jump_max_m,
            jump_max_rad: JUMP_MAX_RAD,
        }
    }
}

fn motion_file_error(path: &str, reason: &dyn core::fmt::Display) -> ParameterError {
    let problem = format!(
        "{path} ({reason}) is not what can be played: a BVH motion file that fills one \
         motion_period_s"
    );
    ParameterError::new("motion_file", problem)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::swing::swing_bvh;

    #[track_caller]
    fn check_refused(key: &str, change: impl FnOnce(&mut TeleoperationParameters)) {
        let mut parameters = TeleoperationParameters::default();
        change(&mut parameters);
        assert_eq!(parameters.check().unwrap_err().key, key);
    }

    #[test]
    fn each_number_outside_its_range_is_refused_by_name() {
        check_refused("motion_period_s", |p| p.motion_period_s = 0.0);
        check_refused("motion_start_s", |p| p.motion_start_s = 61.0);
        check_refused("rate_hz", |p| p.rate_hz = f64::NAN);
        check_refused("amplitude_m", |p| p.amplitude_m = 0.5);
        check_refused("loop_variation_ratio", |p| p.loop_variation_ratio = -0.1);
        check_refused("mapping_scale_ratio", |p| p.mapping_scale_ratio = 3.0);
        check_refused("jump_max_m", |p| p.jump_max_m = 0.0);
        check_refused("send_hz", |p| {
            p.send = SendPolicy::Free;
            p.send_hz = Some(0.0);
        });
        check_refused("send_hz", |p| p.send_hz = Some(250.0));
        check_refused("blend_s", |p| p.blend_s = 11.0);
        check_refused("trigger_after_s", |p| p.trigger_after_s = -1.0);
        check_refused("egm_start.comm_timeout_s", |p| {
            p.egm_start.comm_timeout_s = Some(0.0);
        });
        check_refused("motion_unit_m", |p| p.motion_unit_m = f64::INFINITY);
        assert_eq!(TeleoperationParameters::default().check(), Ok(()));
    }

    #[test]
    fn a_motion_file_is_played_once_its_text_is_there() {
        let mut parameters = TeleoperationParameters {
            motion_file: Some("swing.bvh".to_owned()),
            ..TeleoperationParameters::default()
        };
        let error = parameters.motion().unwrap_err().to_string();
        assert!(
            error.starts_with("motion_file swing.bvh (its text was not"),
            "{error}"
        );

        let absent = parameters.read_files(&mut |_| Err("no such file".to_owned()));
        let error = absent.unwrap_err().to_string();
        assert!(
            error.starts_with("motion_file swing.bvh (no such file)"),
            "{error}"
        );

        parameters
            .read_files(&mut |_| Ok("HIERARCHY\nROOF".into()))
            .unwrap();
        let error = parameters.motion().unwrap_err().to_string();
        assert!(
            error.contains("line 2, byte 10: expected the keyword ROOT"),
            "{error}"
        );

        let text = swing_bvh(4.033, 0.1, 125.0).unwrap();
        parameters
            .read_files(&mut |_| Ok(text.as_str().into()))
            .unwrap();
        let motion = parameters.motion().unwrap();
        let lateral_m = motion.lateral_peak_to_peak_m(parameters.motion_period_s);
        assert!((lateral_m - 0.2).abs() < 1e-5, "{lateral_m}");
    }
}
