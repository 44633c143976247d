//! `[case.parameters]` of the teleoperation case, their ranges, and the motion file. It opens no
//! file: whoever can, hands the text in.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use crate::case_study::ParameterError;
use crate::teleoperation::bvh::Bvh;
use crate::teleoperation::mapping::MappingSettings;
use crate::teleoperation::motion::{Motion, Recording};
use crate::teleoperation::servo::ServoSettings;
use crate::teleoperation::swing::Swing;

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

/// `[case.parameters]` of the teleoperation case. The defaults are the seed paper's figures where
/// it gives them (section III.C) and the maker's defaults otherwise.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TeleoperationParameters {
    /// Length of one motion loop, 0.5..=60 s.
    pub motion_period_s: f64,
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
    /// True adds the joints' own speed to each command, so that the servo need not lag.
    pub feed_forward: bool,
    /// Position gain of the servo, 0..=20 1/s.
    pub servo_gain_per_s: f64,
    /// Corner of the servo's low-pass, 0..=100 Hz; 0 switches it off.
    pub servo_low_pass_hz: f64,
    /// Servo cycle, 1000..=100000 us; real controllers were seen at 4032.
    pub servo_cycle_us: f64,
    /// A BVH motion file to play instead of the synthetic swing. Whoever can open files puts its
    /// text in by [`TeleoperationParameters::read_files`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub motion_file: Option<String>,
    /// Length unit of the motion file, 0.0001..=1 m.
    pub motion_unit_m: f64,
    /// Text of `motion_file`; never in a topology file.
    #[serde(skip)]
    pub motion_text: Option<String>,
}

impl Default for TeleoperationParameters {
    fn default() -> Self {
        Self {
            motion_period_s: 4.033,
            rate_hz: 125.0,
            amplitude_m: 0.1875,
            loop_variation_ratio: 0.0,
            mapping_scale_ratio: 0.8,
            jump_max_m: 0.02,
            left_arm: LeftArm::Hold,
            feed_forward: false,
            servo_gain_per_s: 5.0,
            servo_low_pass_hz: 20.0,
            servo_cycle_us: 4000.0,
            motion_file: None,
            motion_unit_m: 0.01,
            motion_text: None,
        }
    }
}

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
            (
                "motion_period_s",
                self.motion_period_s,
                0.5..=60.0,
                "0.5..=60",
            ),
            ("rate_hz", self.rate_hz, 10.0..=1000.0, "10..=1000"),
            ("amplitude_m", self.amplitude_m, 0.01..=0.4, "0.01..=0.4"),
            (
                "loop_variation_ratio",
                self.loop_variation_ratio,
                0.0..=0.05,
                "0..=0.05",
            ),
            (
                "mapping_scale_ratio",
                self.mapping_scale_ratio,
                0.1..=2.0,
                "0.1..=2",
            ),
            ("jump_max_m", self.jump_max_m, 0.001..=1.0, "0.001..=1"),
            (
                "servo_gain_per_s",
                self.servo_gain_per_s,
                0.0..=20.0,
                "0..=20",
            ),
            (
                "servo_low_pass_hz",
                self.servo_low_pass_hz,
                0.0..=100.0,
                "0..=100",
            ),
            (
                "servo_cycle_us",
                self.servo_cycle_us,
                1000.0..=100_000.0,
                "1000..=100000",
            ),
            (
                "motion_unit_m",
                self.motion_unit_m,
                1e-4..=1.0,
                "0.0001..=1",
            ),
        ];
        for (key, value, allowed, allowed_text) in ranges {
            ParameterError::check(key, value, allowed, allowed_text)?;
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
        let Some(text) = &self.motion_text else {
            return Err(motion_file_error(path, &"its text was not handed in"));
        };
        let bvh = Bvh::parse(text).map_err(|error| motion_file_error(path, &error))?;
        Recording::new(&bvh, self.motion_period_s, self.motion_unit_m)
            .map(Motion::Recorded)
            .map_err(|error| motion_file_error(path, &error))
    }

    /// From frame to frame.
    pub(crate) fn frame_period(&self) -> Duration {
        Duration::from_secs_f64(1.0 / self.rate_hz)
    }

    pub(crate) fn servo(&self) -> ServoSettings {
        ServoSettings {
            gain_per_s: self.servo_gain_per_s,
            low_pass_hz: self.servo_low_pass_hz,
            cycle: Duration::from_secs_f64(self.servo_cycle_us * 1e-6),
        }
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
    use crate::teleoperation::swing::swing_bvh;

    #[track_caller]
    fn check_refused(key: &str, change: impl FnOnce(&mut TeleoperationParameters)) {
        let mut parameters = TeleoperationParameters::default();
        change(&mut parameters);
        assert_eq!(parameters.check().unwrap_err().key, key);
    }

    #[test]
    fn each_number_outside_its_range_is_refused_by_name() {
        check_refused("motion_period_s", |p| p.motion_period_s = 0.0);
        check_refused("rate_hz", |p| p.rate_hz = f64::NAN);
        check_refused("amplitude_m", |p| p.amplitude_m = 0.5);
        check_refused("loop_variation_ratio", |p| p.loop_variation_ratio = -0.1);
        check_refused("mapping_scale_ratio", |p| p.mapping_scale_ratio = 3.0);
        check_refused("jump_max_m", |p| p.jump_max_m = 0.0);
        check_refused("servo_gain_per_s", |p| p.servo_gain_per_s = 20.1);
        check_refused("servo_low_pass_hz", |p| p.servo_low_pass_hz = -1.0);
        check_refused("servo_cycle_us", |p| p.servo_cycle_us = 4.0);
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
