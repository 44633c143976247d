//! `[case.parameters.egm]`: every setting of the simulated controller, presets of them, and their
//! ranges. Names follow the maker's where it has one.

mod written;

use core::ops::RangeInclusive;
use core::time::Duration;

use serde::{Deserialize, Serialize};

use crate::egm::controller::DELAY_CYCLES_MAX;
use crate::egm::messages::{EgmStartParameters, MotionRefusal, Side};
use hil_core::case_study::ParameterError;

/// A named set of settings that single keys may then change.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Preset {
    /// The maker's defaults, with their traps.
    AbbDefault,
    /// Everything open: level 0, highest gain, no filter to speak of.
    Raw,
    /// As the `YuMi` programs of KTH set it.
    KthYumi,
    /// Fitted so that calibrated outages reproduce the seed paper's motion loss; the paper states
    /// none of these values.
    #[default]
    Paper,
}

/// How the controller takes queued commands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum QueuePolicy {
    /// One per cycle, oldest first, as the maker documents it.
    Fifo1,
    /// The newest; those it overtook are dropped and counted. What would help.
    Latest,
}

/// What becomes of the motion when a session is stopped by request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StopMode {
    /// Stays where it is.
    Hold,
    /// Returns to where the session started.
    RampDown,
}

/// What starts the first session.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StartMode {
    /// A request to the motion server.
    Request,
    /// The program by itself, from the robot's start.
    PowerOn,
}

/// What the program does when a session ended by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RestartPolicy {
    /// Starts the next at once; setting it up takes `activation_s`.
    AutoRetry,
    /// Waits `restart_wait_s` first.
    WaitThenRestart,
    /// Goes idle until a request starts the next.
    ExternalTrigger,
    /// Moves to the home posture first.
    GoHomeFirst,
}

/// Whose program starts guided motion by itself with [`StartMode::PowerOn`]. The other arm stands
/// still until a request moves it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GuidedArms {
    /// Both arms'.
    Both,
    /// The right arm's.
    Right,
    /// The left arm's.
    Left,
}

impl GuidedArms {
    /// True when `side` is one of them.
    pub const fn include(self, side: Side) -> bool {
        match self {
            Self::Both => true,
            Self::Right => matches!(side, Side::Right),
            Self::Left => matches!(side, Side::Left),
        }
    }
}

/// `[case.parameters.egm]`. A key left out takes the preset's value; written out again, every key
/// in force is there, see [`EgmParameters::spelled_out`].
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, remote = "Self")]
pub struct EgmParameters {
    /// Where the other keys come from.
    pub preset: Preset,
    /// Controller cycle, 1000..=100000 us; real controllers were seen at 4032, simulated at 4000.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cycle_us: Option<f64>,
    /// Queue policy.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub queue: Option<QueuePolicy>,
    /// Commands the queue holds, 1..=100000; further ones are dropped and counted.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub queue_capacity: Option<u32>,
    /// Default Proportional Position Gain, 0..=20 1/s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub position_gain_per_s: Option<f64>,
    /// Default Low Pass Filter Bandwidth, 0..=100 Hz; 0 switches it off.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub low_pass_hz: Option<f64>,
    /// `PosCorrGain`, 0..=1; 0 is pure speed control.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub position_correction_ratio: Option<f64>,
    /// `RampInTime`, 0..=10 s: the share of the correction grows from 0 to 1 over it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ramp_in_s: Option<f64>,
    /// `RampOutTime`, 0..=10 s: how long a stop by `ramp-down` takes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ramp_out_s: Option<f64>,
    /// `MaxSpeedDeviation`, 0.01..=1000 deg/s: all joints are slowed by one ratio.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_speed_deviation_deg_per_s: Option<f64>,
    /// `MaxPosDeviation`, 0.1..=1000 deg from where the session started; beyond, it ends.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_position_deviation_deg: Option<f64>,
    /// Half the convergence window, 0.001..=100 deg.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub convergence_deg: Option<f64>,
    /// `CondTime`, 0..=1000000 s: converged for so long, the session ends.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub condition_time_s: Option<f64>,
    /// `CommTimeout`, 0.004..=1000000 s: without a message for so long, the session ends. A
    /// refused one does not count.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub comm_timeout_s: Option<f64>,
    /// What a requested stop does.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stop_mode: Option<StopMode>,
    /// What starts the first session.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start: Option<StartMode>,
    /// Whose program does so with `start = "power-on"`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub arms: Option<GuidedArms>,
    /// What follows a session that ended by itself.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub restart: Option<RestartPolicy>,
    /// Wait of `wait_then_restart`, 0..=60 s; refused with a policy that never waits.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub restart_wait_s: Option<f64>,
    /// How long setting a session up takes (fine point, synchronisation, set-up), 0..=60 s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub activation_s: Option<f64>,
    /// Cycles by which the measured joints lag the planned ones, 0..=16: the maker's control lag
    /// of 10 to 20 ms, filtering level included.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub control_delay_cycles: Option<u32>,
}

/// The settings in force: a preset and what the keys changed. SI units and radians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ControllerSettings {
    /// See [`EgmParameters::cycle_us`].
    pub cycle: Duration,
    /// See [`EgmParameters::queue`].
    pub queue: QueuePolicy,
    /// See [`EgmParameters::queue_capacity`].
    pub queue_capacity: usize,
    /// See [`EgmParameters::position_gain_per_s`].
    pub position_gain_per_s: f64,
    /// See [`EgmParameters::low_pass_hz`].
    pub low_pass_hz: f64,
    /// See [`EgmParameters::position_correction_ratio`].
    pub position_correction_ratio: f64,
    /// See [`EgmParameters::ramp_in_s`].
    pub ramp_in_s: f64,
    /// See [`EgmParameters::ramp_out_s`].
    pub ramp_out_s: f64,
    /// See [`EgmParameters::max_speed_deviation_deg_per_s`].
    pub max_speed_deviation_rad_per_s: f64,
    /// See [`EgmParameters::max_position_deviation_deg`].
    pub max_position_deviation_rad: f64,
    /// See [`EgmParameters::convergence_deg`].
    pub convergence_rad: f64,
    /// See [`EgmParameters::condition_time_s`].
    pub condition_time_s: f64,
    /// See [`EgmParameters::comm_timeout_s`].
    pub comm_timeout_s: f64,
    /// See [`EgmParameters::stop_mode`].
    pub stop_mode: StopMode,
    /// See [`EgmParameters::start`].
    pub start: StartMode,
    /// See [`EgmParameters::arms`].
    pub arms: GuidedArms,
    /// See [`EgmParameters::restart`].
    pub restart: RestartPolicy,
    /// See [`EgmParameters::restart_wait_s`].
    pub restart_wait_s: f64,
    /// See [`EgmParameters::activation_s`].
    pub activation_s: f64,
    /// See [`EgmParameters::control_delay_cycles`].
    pub control_delay_cycles: usize,
}

impl ControllerSettings {
    /// The settings of a preset.
    pub fn of(preset: Preset) -> Self {
        // The maker's defaults; `RampInTime` and the set-up time have none in its manual.
        let abb = Self {
            cycle: Duration::from_millis(4),
            queue: QueuePolicy::Fifo1,
            queue_capacity: 1000,
            position_gain_per_s: 5.0,
            low_pass_hz: 20.0,
            position_correction_ratio: 1.0,
            ramp_in_s: 0.5,
            ramp_out_s: 0.5,
            max_speed_deviation_rad_per_s: 1_f64.to_radians(),
            max_position_deviation_rad: 1000_f64.to_radians(),
            convergence_rad: 0.5_f64.to_radians(),
            condition_time_s: 1.0,
            comm_timeout_s: 1.0,
            stop_mode: StopMode::Hold,
            start: StartMode::Request,
            arms: GuidedArms::Both,
            restart: RestartPolicy::AutoRetry,
            restart_wait_s: 1.0,
            activation_s: 0.5,
            control_delay_cycles: 4,
        };
        match preset {
            Preset::AbbDefault => abb,
            Preset::Raw => Self {
                position_gain_per_s: 20.0,
                low_pass_hz: 100.0,
                ramp_in_s: 0.005,
                max_speed_deviation_rad_per_s: 1000_f64.to_radians(),
                condition_time_s: 1e6,
                control_delay_cycles: 3,
                ..abb
            },
            Preset::KthYumi => Self {
                max_speed_deviation_rad_per_s: 400_f64.to_radians(),
                condition_time_s: 500.0,
                ramp_in_s: 0.1,
                ..abb
            },
            Preset::Paper => Self {
                position_gain_per_s: 20.0,
                max_speed_deviation_rad_per_s: 400_f64.to_radians(),
                condition_time_s: 500.0,
                ramp_in_s: 0.1,
                restart: RestartPolicy::WaitThenRestart,
                restart_wait_s: 1.5,
                activation_s: 0.5,
                ..abb
            },
        }
    }
}

impl EgmParameters {
    /// The arms that guided motion shall move: with [`StartMode::Request`], all that are asked to.
    pub fn guided_arms(&self) -> GuidedArms {
        let preset = ControllerSettings::of(self.preset);
        match self.start.unwrap_or(preset.start) {
            StartMode::Request => GuidedArms::Both,
            StartMode::PowerOn => self.arms.unwrap_or(preset.arms),
        }
    }

    /// The settings in force: the preset's, where no key changes them.
    ///
    /// # Errors
    /// The first key outside its range, as `egm.<key>`.
    pub fn settings(&self) -> Result<ControllerSettings, ParameterError> {
        let preset = ControllerSettings::of(self.preset);
        let (speed_deg, position_deg) = (
            MAX_SPEED_DEVIATION_DEG_PER_S.key(self.max_speed_deviation_deg_per_s)?,
            MAX_POSITION_DEVIATION_DEG.key(self.max_position_deviation_deg)?,
        );
        let cycle = CYCLE_US.key(self.cycle_us)?;
        let capacity = QUEUE_CAPACITY.key(self.queue_capacity.map(f64::from))?;
        let delay = CONTROL_DELAY_CYCLES.key(self.control_delay_cycles.map(f64::from))?;
        let convergence = CONVERGENCE_DEG.key(self.convergence_deg)?;
        let restart_wait = RESTART_WAIT_S.key(self.restart_wait_s)?;
        let restart = self.restart.unwrap_or(preset.restart);
        if let Some(wait_s) = restart_wait
            && restart != RestartPolicy::WaitThenRestart
        {
            let problem =
                format!("{wait_s} has no effect: it needs egm.restart = \"wait_then_restart\"");
            return Err(ParameterError::new(RESTART_WAIT_S.key, problem));
        }
        Ok(ControllerSettings {
            cycle: cycle.map_or(preset.cycle, |us| Duration::from_secs_f64(us * 1e-6)),
            queue: self.queue.unwrap_or(preset.queue),
            queue_capacity: capacity.map_or(preset.queue_capacity, whole),
            position_gain_per_s: POSITION_GAIN_PER_S
                .key(self.position_gain_per_s)?
                .unwrap_or(preset.position_gain_per_s),
            low_pass_hz: LOW_PASS_HZ
                .key(self.low_pass_hz)?
                .unwrap_or(preset.low_pass_hz),
            position_correction_ratio: POSITION_CORRECTION_RATIO
                .key(self.position_correction_ratio)?
                .unwrap_or(preset.position_correction_ratio),
            ramp_in_s: RAMP_IN_S.key(self.ramp_in_s)?.unwrap_or(preset.ramp_in_s),
            ramp_out_s: RAMP_OUT_S
                .key(self.ramp_out_s)?
                .unwrap_or(preset.ramp_out_s),
            max_speed_deviation_rad_per_s: speed_deg
                .map_or(preset.max_speed_deviation_rad_per_s, f64::to_radians),
            max_position_deviation_rad: position_deg
                .map_or(preset.max_position_deviation_rad, f64::to_radians),
            convergence_rad: convergence.map_or(preset.convergence_rad, f64::to_radians),
            condition_time_s: CONDITION_TIME_S
                .key(self.condition_time_s)?
                .unwrap_or(preset.condition_time_s),
            comm_timeout_s: COMM_TIMEOUT_S
                .key(self.comm_timeout_s)?
                .unwrap_or(preset.comm_timeout_s),
            stop_mode: self.stop_mode.unwrap_or(preset.stop_mode),
            start: self.start.unwrap_or(preset.start),
            arms: self.arms.unwrap_or(preset.arms),
            restart,
            restart_wait_s: restart_wait.unwrap_or(preset.restart_wait_s),
            activation_s: ACTIVATION_S
                .key(self.activation_s)?
                .unwrap_or(preset.activation_s),
            control_delay_cycles: delay.map_or(preset.control_delay_cycles, whole),
        })
    }
}

impl ControllerSettings {
    /// These settings with what `parameters` ask for.
    ///
    /// # Errors
    /// [`MotionRefusal::BadNumber`] when one is outside the range of its key in
    /// [`EgmParameters`]; NaN asks for nothing.
    pub fn with(&self, parameters: &EgmStartParameters) -> Result<Self, MotionRefusal> {
        let degrees = |range: &Range, asked: f64, kept: f64| {
            // Within a millionth: the bound itself comes back from radians with changed digits.
            let asked_deg = asked.to_degrees();
            let (min, max) = (*range.allowed.start(), *range.allowed.end());
            let within = asked_deg.clamp(min, max);
            let is_rounded = (asked_deg - within).abs() <= 1e-6 * within;
            range.or_kept(
                if is_rounded { within } else { asked_deg },
                kept.to_degrees(),
            )?;
            Ok(if asked.is_nan() { kept } else { asked })
        };
        Ok(Self {
            comm_timeout_s: COMM_TIMEOUT_S
                .or_kept(parameters.comm_timeout_s, self.comm_timeout_s)?,
            condition_time_s: CONDITION_TIME_S
                .or_kept(parameters.condition_time_s, self.condition_time_s)?,
            max_speed_deviation_rad_per_s: degrees(
                &MAX_SPEED_DEVIATION_DEG_PER_S,
                parameters.max_speed_deviation_rad_per_s,
                self.max_speed_deviation_rad_per_s,
            )?,
            max_position_deviation_rad: degrees(
                &MAX_POSITION_DEVIATION_DEG,
                parameters.max_position_deviation_rad,
                self.max_position_deviation_rad,
            )?,
            ramp_in_s: RAMP_IN_S.or_kept(parameters.ramp_in_s, self.ramp_in_s)?,
            position_correction_ratio: POSITION_CORRECTION_RATIO.or_kept(
                parameters.position_correction_ratio,
                self.position_correction_ratio,
            )?,
            position_gain_per_s: POSITION_GAIN_PER_S
                .or_kept(parameters.position_gain_per_s, self.position_gain_per_s)?,
            low_pass_hz: LOW_PASS_HZ.or_kept(parameters.low_pass_hz, self.low_pass_hz)?,
            ..*self
        })
    }
}

/// A number that passed its range, as a count.
#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "whole and within a range of small counts"
)]
fn whole(number: f64) -> usize {
    number as usize
}

/// What a key may be.
struct Range {
    key: &'static str,
    allowed: RangeInclusive<f64>,
    text: &'static str,
}

impl Range {
    const fn new(key: &'static str, min: f64, max: f64, text: &'static str) -> Self {
        Self {
            key,
            allowed: min..=max,
            text,
        }
    }

    fn key(&self, value: Option<f64>) -> Result<Option<f64>, ParameterError> {
        if let Some(value) = value {
            ParameterError::check(self.key, value, self.allowed.clone(), self.text)?;
        }
        Ok(value)
    }

    fn or_kept(&self, asked: f64, kept: f64) -> Result<f64, MotionRefusal> {
        if asked.is_nan() {
            Ok(kept)
        } else if self.allowed.contains(&asked) {
            Ok(asked)
        } else {
            Err(MotionRefusal::BadNumber)
        }
    }
}

const CYCLE_US: Range = Range::new("egm.cycle_us", 1000.0, 100_000.0, "1000 to 100000");
const QUEUE_CAPACITY: Range = Range::new("egm.queue_capacity", 1.0, 100_000.0, "1 to 100000");
const POSITION_GAIN_PER_S: Range = Range::new("egm.position_gain_per_s", 0.0, 20.0, "0 to 20");
const LOW_PASS_HZ: Range = Range::new("egm.low_pass_hz", 0.0, 100.0, "0 to 100");
const POSITION_CORRECTION_RATIO: Range =
    Range::new("egm.position_correction_ratio", 0.0, 1.0, "0 to 1");
const RAMP_IN_S: Range = Range::new("egm.ramp_in_s", 0.0, 10.0, "0 to 10");
const RAMP_OUT_S: Range = Range::new("egm.ramp_out_s", 0.0, 10.0, "0 to 10");
const MAX_SPEED_DEVIATION_DEG_PER_S: Range = Range::new(
    "egm.max_speed_deviation_deg_per_s",
    0.01,
    1000.0,
    "0.01 to 1000",
);
const MAX_POSITION_DEVIATION_DEG: Range =
    Range::new("egm.max_position_deviation_deg", 0.1, 1000.0, "0.1 to 1000");
const CONVERGENCE_DEG: Range = Range::new("egm.convergence_deg", 0.001, 100.0, "0.001 to 100");
const CONDITION_TIME_S: Range = Range::new("egm.condition_time_s", 0.0, 1e6, "0 to 1000000");
const COMM_TIMEOUT_S: Range = Range::new("egm.comm_timeout_s", 0.004, 1e6, "0.004 to 1000000");
const RESTART_WAIT_S: Range = Range::new("egm.restart_wait_s", 0.0, 60.0, "0 to 60");
const ACTIVATION_S: Range = Range::new("egm.activation_s", 0.0, 60.0, "0 to 60");
const CONTROL_DELAY_CYCLES: Range = Range::new(
    "egm.control_delay_cycles",
    0.0,
    DELAY_CYCLES_MAX as f64,
    "0 to 16",
);

#[cfg(test)]
#[path = "parameters_tests.rs"]
mod tests;
