//! `[case.parameters]` of the teleoperation case, their ranges, and the motion file. It opens no
//! file: whoever can, hands the text in. The robot's own settings are in
//! [`hil_arm::egm::parameters`].

use core::time::Duration;

use serde::{Deserialize, Serialize};

use crate::bvh::Bvh;
use crate::experiment::TableParameters;
use crate::follower::MappingSettings;
use crate::motion::{Motion, Recording};
use crate::swing::Swing;
use hil_arm::egm::messages::EgmStartParameters;
use hil_arm::egm::parameters::EgmParameters;
use hil_core::case_study::ParameterError;

/// What the left arm does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LeftArm {
    /// Holds its start posture.
    #[default]
    Hold,
    /// Mirrors what the right hand does.
    Mirror,
}

/// When the controller sends commands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SendPolicy {
    /// One per human frame and arm.
    #[default]
    Frame,
    /// One per feedback of the arm, as the maker recommends.
    Coupled,
    /// `send_hz` per second and arm, whatever comes in.
    Free,
}

/// Where an arm goes when guided motion is back after a session ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ResumePolicy {
    /// To where it would be had nothing happened, as fast as the robot lets it.
    #[default]
    Jump,
    /// There too, but gliding from where the arm is within `blend_s`.
    Blend,
    /// Nowhere: hand and tool are taken anew where they are, and the motion goes on from there.
    Reclutch,
}

/// `[case.parameters.egm_start]`: what the controller asks the robot to change when it asks for
/// guided motion. A key left out keeps the robot's setting; ranges are those of
/// [`EgmParameters`].
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EgmStartRequest {
    /// See [`EgmParameters::comm_timeout_s`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub comm_timeout_s: Option<f64>,
    /// See [`EgmParameters::condition_time_s`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub condition_time_s: Option<f64>,
    /// See [`EgmParameters::max_speed_deviation_deg_per_s`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_speed_deviation_deg_per_s: Option<f64>,
    /// See [`EgmParameters::max_position_deviation_deg`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_position_deviation_deg: Option<f64>,
    /// See [`EgmParameters::ramp_in_s`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ramp_in_s: Option<f64>,
    /// See [`EgmParameters::position_correction_ratio`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub position_correction_ratio: Option<f64>,
    /// See [`EgmParameters::position_gain_per_s`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub position_gain_per_s: Option<f64>,
    /// See [`EgmParameters::low_pass_hz`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub low_pass_hz: Option<f64>,
}

impl EgmStartRequest {
    /// As it travels; a key left out is NaN.
    pub(crate) fn message(&self) -> EgmStartParameters {
        let keep = f64::NAN;
        EgmStartParameters {
            comm_timeout_s: self.comm_timeout_s.unwrap_or(keep),
            condition_time_s: self.condition_time_s.unwrap_or(keep),
            max_speed_deviation_rad_per_s: self
                .max_speed_deviation_deg_per_s
                .map_or(keep, f64::to_radians),
            max_position_deviation_rad: self
                .max_position_deviation_deg
                .map_or(keep, f64::to_radians),
            ramp_in_s: self.ramp_in_s.unwrap_or(keep),
            position_correction_ratio: self.position_correction_ratio.unwrap_or(keep),
            position_gain_per_s: self.position_gain_per_s.unwrap_or(keep),
            low_pass_hz: self.low_pass_hz.unwrap_or(keep),
        }
    }

    /// Checks the keys as if the robot had them: its ranges are the same.
    fn check(&self) -> Result<(), ParameterError> {
        let as_settings = EgmParameters {
            comm_timeout_s: self.comm_timeout_s,
            condition_time_s: self.condition_time_s,
            max_speed_deviation_deg_per_s: self.max_speed_deviation_deg_per_s,
            max_position_deviation_deg: self.max_position_deviation_deg,
            ramp_in_s: self.ramp_in_s,
            position_correction_ratio: self.position_correction_ratio,
            position_gain_per_s: self.position_gain_per_s,
            low_pass_hz: self.low_pass_hz,
            ..EgmParameters::default()
        };
        as_settings.settings().map(|_| ()).map_err(|error| {
            let key = error.key.trim_start_matches("egm.");
            ParameterError::new(&format!("egm_start.{key}"), error.problem)
        })
    }
}

/// `[case.parameters]` of the teleoperation case. The defaults are the seed paper's figures where
/// it gives them (section III.C) and the maker's defaults otherwise.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TeleoperationParameters {
    /// Length of one motion loop, 0.5..=60 s.
    pub motion_period_s: f64,
    /// How long the human rests before the motion begins, 0..=60 s: nobody swings before guided
    /// motion runs, and an arm that engages in the midst of a swing works off its centre.
    pub motion_start_s: f64,
    /// Frame rate of the motion capture, 10..=1000 Hz.
    pub rate_hz: f64,
    /// How far the synthetic human swings the hand to either side, 0.01..=0.4 m. Without effect
    /// with a `motion_file`.
    pub amplitude_m: f64,
    /// Standard deviation of a loop's period as a share of the period, 0..=0.05; the amplitude's
    /// is three times that. Zero repeats the same loop for ever.
    pub loop_variation_ratio: f64,
    /// Tool path length per hand path length, 0.1..=2.
    pub mapping_scale_ratio: f64,
    /// Farthest a target may move between two frames, 0.001..=1 m.
    pub jump_max_m: f64,
    /// What the left arm does.
    pub left_arm: LeftArm,
    /// True adds the joints' own speed to each command, so that the robot need not lag.
    pub feed_forward: bool,
    /// When commands are sent.
    pub send: SendPolicy,
    /// Commands per second and arm with `send = "free"`, 1..=1000 Hz; 250 when left out. Refused
    /// with any other `send`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub send_hz: Option<f64>,
    /// Where an arm goes when guided motion is back.
    pub resume: ResumePolicy,
    /// How long the way of `resume = "blend"` takes, 0.1..=10 s.
    pub blend_s: f64,
    /// How long it takes until an arm that went idle is asked to start again, 0..=60 s: with
    /// `egm.restart = "external_trigger"` people and programs take 2 to 10.
    pub trigger_after_s: f64,
    /// A BVH motion file to play instead of the synthetic swing. Whoever can open files puts its
    /// text in by [`TeleoperationParameters::read_files`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub motion_file: Option<String>,
    /// Length unit of the motion file, 0.0001..=1 m.
    pub motion_unit_m: f64,
    /// The robot's settings.
    pub egm: EgmParameters,
    /// What the controller asks for instead of them.
    pub egm_start: EgmStartRequest,
    /// What `hil-runtime tables` and `calibrate` compute.
    pub tables: TableParameters,
    /// Text of `motion_file`; never in a topology file.
    #[serde(skip)]
    pub motion_text: Option<String>,
}

impl Default for TeleoperationParameters {
    fn default() -> Self {
        Self {
            motion_period_s: 4.033,
            motion_start_s: 2.0,
            rate_hz: 125.0,
            amplitude_m: 0.1875,
            loop_variation_ratio: 0.0,
            mapping_scale_ratio: 0.8,
            jump_max_m: 0.02,
            left_arm: LeftArm::Hold,
            feed_forward: false,
            send: SendPolicy::Frame,
            send_hz: None,
            resume: ResumePolicy::Jump,
            blend_s: 1.0,
            trigger_after_s: 3.0,
            motion_file: None,
            motion_unit_m: 0.01,
            egm: EgmParameters::default(),
            egm_start: EgmStartRequest::default(),
            tables: TableParameters::default(),
            motion_text: None,
        }
    }
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
        read: &mut dyn FnMut(&str) -> Result<String, String>,
    ) -> Result<(), ParameterError> {
        if let Some(path) = &self.motion_file {
            let text = read(path).map_err(|reason| motion_file_error(path, &reason))?;
            self.motion_text = Some(text);
        }
        Ok(())
    }

    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first key outside its range.
    pub fn check(&self) -> Result<(), ParameterError> {
        let ranges = [
            ("motion_period_s", self.motion_period_s, 0.5, 60.0),
            ("motion_start_s", self.motion_start_s, 0.0, 60.0),
            ("rate_hz", self.rate_hz, 10.0, 1000.0),
            ("amplitude_m", self.amplitude_m, 0.01, 0.4),
            ("loop_variation_ratio", self.loop_variation_ratio, 0.0, 0.05),
            ("mapping_scale_ratio", self.mapping_scale_ratio, 0.1, 2.0),
            ("jump_max_m", self.jump_max_m, 0.001, 1.0),
            ("send_hz", self.send_hz(), 1.0, 1000.0),
            ("blend_s", self.blend_s, 0.1, 10.0),
            ("trigger_after_s", self.trigger_after_s, 0.0, 60.0),
            ("motion_unit_m", self.motion_unit_m, 1e-4, 1.0),
        ];
        for (key, value, min, max) in ranges {
            ParameterError::check(key, value, min..=max, &format!("{min} to {max}"))?;
        }
        if let Some(send_hz) = self.send_hz
            && self.send != SendPolicy::Free
        {
            let problem = format!("{send_hz} has no effect: it needs send = \"free\"");
            return Err(ParameterError::new("send_hz", problem));
        }
        self.egm_start.check()?;
        self.tables.check()
    }

    /// The motion to play.
    ///
    /// # Errors
    /// When the motion file was not read, is no motion file, or does not fill the period.
    pub fn motion(&self) -> Result<Motion, ParameterError> {
        let Some(path) = &self.motion_file else {
            return Swing::new(self.amplitude_m).map(Motion::Synthetic);
        };
        let Some(text) = &self.motion_text else {
            return Err(motion_file_error(path, &"its text was not handed in"));
        };
        let bvh = Bvh::parse(text).map_err(|error| motion_file_error(path, &error))?;
        Recording::new(&bvh, self.motion_period_s, self.motion_unit_m)
            .map(Motion::Recorded)
            .map_err(|error| motion_file_error(path, &error))
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
            .read_files(&mut |_| Ok("HIERARCHY\nROOF".to_owned()))
            .unwrap();
        let error = parameters.motion().unwrap_err().to_string();
        assert!(
            error.contains("line 2: expected the keyword ROOT"),
            "{error}"
        );

        let text = swing_bvh(4.033, 0.1, 125.0).unwrap();
        parameters.read_files(&mut |_| Ok(text.clone())).unwrap();
        let motion = parameters.motion().unwrap();
        let lateral_m = motion.lateral_peak_to_peak_m(parameters.motion_period_s);
        assert!((lateral_m - 0.2).abs() < 1e-5, "{lateral_m}");
    }
}
