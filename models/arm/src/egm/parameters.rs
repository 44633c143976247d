//! `[case.parameters.egm]`: every setting of the simulated controller, presets of them, and their
//! ranges. Names follow the maker's where it has one.

use core::ops::RangeInclusive;
use core::time::Duration;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

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
    pub cycle_us: Option<f64>,
    /// Queue policy.
    pub queue: Option<QueuePolicy>,
    /// Commands the queue holds, 1..=100000; further ones are dropped and counted.
    pub queue_capacity: Option<u32>,
    /// Default Proportional Position Gain, 0..=20 1/s.
    pub position_gain_per_s: Option<f64>,
    /// Default Low Pass Filter Bandwidth, 0..=100 Hz; 0 switches it off.
    pub low_pass_hz: Option<f64>,
    /// `PosCorrGain`, 0..=1; 0 is pure speed control.
    pub position_correction_ratio: Option<f64>,
    /// `RampInTime`, 0..=10 s: the share of the correction grows from 0 to 1 over it.
    pub ramp_in_s: Option<f64>,
    /// `RampOutTime`, 0..=10 s: how long a stop by `ramp-down` takes.
    pub ramp_out_s: Option<f64>,
    /// `MaxSpeedDeviation`, 0.01..=1000 deg/s: all joints are slowed by one ratio.
    pub max_speed_deviation_deg_per_s: Option<f64>,
    /// `MaxPosDeviation`, 0.1..=1000 deg from where the session started; beyond, it ends.
    pub max_position_deviation_deg: Option<f64>,
    /// Half the convergence window, 0.001..=100 deg.
    pub convergence_deg: Option<f64>,
    /// `CondTime`, 0..=1000000 s: converged for so long, the session ends.
    pub condition_time_s: Option<f64>,
    /// `CommTimeout`, 0.004..=1000000 s: without a message for so long, the session ends. A
    /// refused one does not count.
    pub comm_timeout_s: Option<f64>,
    /// What a requested stop does.
    pub stop_mode: Option<StopMode>,
    /// What starts the first session.
    pub start: Option<StartMode>,
    /// Whose program does so with `start = "power-on"`.
    pub arms: Option<GuidedArms>,
    /// What follows a session that ended by itself.
    pub restart: Option<RestartPolicy>,
    /// Wait of `wait_then_restart`, 0..=60 s; refused with a policy that never waits.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub restart_wait_s: Option<f64>,
    /// How long setting a session up takes (fine point, synchronisation, set-up), 0..=60 s.
    pub activation_s: Option<f64>,
    /// Cycles by which the measured joints lag the planned ones, 0..=16: the maker's control lag
    /// of 10 to 20 ms, filtering level included.
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
    ///
    /// # Panics
    /// Never: the presets are within their ranges.
    pub fn of(preset: Preset) -> Self {
        let parameters = EgmParameters {
            preset,
            ..EgmParameters::default()
        };
        parameters
            .settings()
            .expect("presets are within their ranges")
    }
}

impl EgmParameters {
    /// A preset with each of its values.
    fn of(preset: Preset) -> Self {
        // The maker's defaults; `RampInTime` and the set-up time have none in its manual.
        let abb = Self {
            preset,
            cycle_us: Some(4000.0),
            queue: Some(QueuePolicy::Fifo1),
            queue_capacity: Some(1000),
            position_gain_per_s: Some(5.0),
            low_pass_hz: Some(20.0),
            position_correction_ratio: Some(1.0),
            ramp_in_s: Some(0.5),
            ramp_out_s: Some(0.5),
            max_speed_deviation_deg_per_s: Some(1.0),
            max_position_deviation_deg: Some(1000.0),
            convergence_deg: Some(0.5),
            condition_time_s: Some(1.0),
            comm_timeout_s: Some(1.0),
            stop_mode: Some(StopMode::Hold),
            start: Some(StartMode::Request),
            arms: Some(GuidedArms::Both),
            restart: Some(RestartPolicy::AutoRetry),
            restart_wait_s: Some(1.0),
            activation_s: Some(0.5),
            control_delay_cycles: Some(4),
        };
        match preset {
            Preset::AbbDefault => abb,
            Preset::Raw => Self {
                position_gain_per_s: Some(20.0),
                low_pass_hz: Some(100.0),
                ramp_in_s: Some(0.005),
                max_speed_deviation_deg_per_s: Some(1000.0),
                condition_time_s: Some(1e6),
                control_delay_cycles: Some(3),
                ..abb
            },
            Preset::KthYumi => Self {
                max_speed_deviation_deg_per_s: Some(400.0),
                condition_time_s: Some(500.0),
                ramp_in_s: Some(0.1),
                ..abb
            },
            Preset::Paper => Self {
                position_gain_per_s: Some(20.0),
                max_speed_deviation_deg_per_s: Some(400.0),
                condition_time_s: Some(500.0),
                ramp_in_s: Some(0.1),
                restart: Some(RestartPolicy::WaitThenRestart),
                restart_wait_s: Some(1.5),
                ..abb
            },
        }
    }

    /// The same settings with every key in force written out: those left out have the preset's
    /// values. `restart_wait_s` is not in force with a policy that never waits.
    #[must_use]
    pub fn spelled_out(&self) -> Self {
        let preset = Self::of(self.preset);
        let restart = self.restart.or(preset.restart);
        let is_waiting = restart == Some(RestartPolicy::WaitThenRestart);
        let wait_s = preset.restart_wait_s.filter(|_| is_waiting);
        Self {
            preset: self.preset,
            cycle_us: self.cycle_us.or(preset.cycle_us),
            queue: self.queue.or(preset.queue),
            queue_capacity: self.queue_capacity.or(preset.queue_capacity),
            position_gain_per_s: self.position_gain_per_s.or(preset.position_gain_per_s),
            low_pass_hz: self.low_pass_hz.or(preset.low_pass_hz),
            position_correction_ratio: self
                .position_correction_ratio
                .or(preset.position_correction_ratio),
            ramp_in_s: self.ramp_in_s.or(preset.ramp_in_s),
            ramp_out_s: self.ramp_out_s.or(preset.ramp_out_s),
            max_speed_deviation_deg_per_s: self
                .max_speed_deviation_deg_per_s
                .or(preset.max_speed_deviation_deg_per_s),
            max_position_deviation_deg: self
                .max_position_deviation_deg
                .or(preset.max_position_deviation_deg),
            convergence_deg: self.convergence_deg.or(preset.convergence_deg),
            condition_time_s: self.condition_time_s.or(preset.condition_time_s),
            comm_timeout_s: self.comm_timeout_s.or(preset.comm_timeout_s),
            stop_mode: self.stop_mode.or(preset.stop_mode),
            start: self.start.or(preset.start),
            arms: self.arms.or(preset.arms),
            restart,
            restart_wait_s: self.restart_wait_s.or(wait_s),
            activation_s: self.activation_s.or(preset.activation_s),
            control_delay_cycles: self.control_delay_cycles.or(preset.control_delay_cycles),
        }
    }

    /// The arms that guided motion shall move: with [`StartMode::Request`], all that are asked to.
    pub fn guided_arms(&self) -> GuidedArms {
        let all = self.spelled_out();
        match all.start {
            Some(StartMode::PowerOn) => all.arms.unwrap_or(GuidedArms::Both),
            Some(StartMode::Request) | None => GuidedArms::Both,
        }
    }

    /// The settings in force: the preset's, where no key changes them.
    ///
    /// # Errors
    /// The first key outside its range, as `egm.<key>`.
    ///
    /// # Panics
    /// Not with the presets of this file, each of which states every key.
    pub fn settings(&self) -> Result<ControllerSettings, ParameterError> {
        const STATED: &str = "a preset states every key";
        let all = self.spelled_out();
        let speed_deg_per_s = MAX_SPEED_DEVIATION_DEG_PER_S.of(all.max_speed_deviation_deg_per_s)?;
        let position_deg = MAX_POSITION_DEVIATION_DEG.of(all.max_position_deviation_deg)?;
        let capacity = QUEUE_CAPACITY.of(all.queue_capacity.map(f64::from))?;
        let delay_cycles = CONTROL_DELAY_CYCLES.of(all.control_delay_cycles.map(f64::from))?;
        let restart = all.restart.expect(STATED);
        let wait_s = all.restart_wait_s.or(Self::of(self.preset).restart_wait_s);
        let restart_wait_s = RESTART_WAIT_S.of(wait_s)?;
        if self.restart_wait_s.is_some() && restart != RestartPolicy::WaitThenRestart {
            let problem = format!(
                "{restart_wait_s} has no effect: it needs egm.restart = \"wait_then_restart\""
            );
            return Err(ParameterError::new(RESTART_WAIT_S.key, problem));
        }
        Ok(ControllerSettings {
            cycle: Duration::from_secs_f64(CYCLE_US.of(all.cycle_us)? * 1e-6),
            queue: all.queue.expect(STATED),
            queue_capacity: whole(capacity),
            position_gain_per_s: POSITION_GAIN_PER_S.of(all.position_gain_per_s)?,
            low_pass_hz: LOW_PASS_HZ.of(all.low_pass_hz)?,
            position_correction_ratio: POSITION_CORRECTION_RATIO
                .of(all.position_correction_ratio)?,
            ramp_in_s: RAMP_IN_S.of(all.ramp_in_s)?,
            ramp_out_s: RAMP_OUT_S.of(all.ramp_out_s)?,
            max_speed_deviation_rad_per_s: speed_deg_per_s.to_radians(),
            max_position_deviation_rad: position_deg.to_radians(),
            convergence_rad: CONVERGENCE_DEG.of(all.convergence_deg)?.to_radians(),
            condition_time_s: CONDITION_TIME_S.of(all.condition_time_s)?,
            comm_timeout_s: COMM_TIMEOUT_S.of(all.comm_timeout_s)?,
            stop_mode: all.stop_mode.expect(STATED),
            start: all.start.expect(STATED),
            arms: all.arms.expect(STATED),
            restart,
            restart_wait_s,
            activation_s: ACTIVATION_S.of(all.activation_s)?,
            control_delay_cycles: whole(delay_cycles),
        })
    }
}

/// Writes every key in force, so that a record of a run needs no table of presets to be read.
impl Serialize for EgmParameters {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        // The derived function, which a type's own name finds before the trait's.
        Self::serialize(&self.spelled_out(), serializer)
    }
}

impl<'de> Deserialize<'de> for EgmParameters {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Self::deserialize(deserializer)
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
}

impl Range {
    const fn new(key: &'static str, min: f64, max: f64) -> Self {
        Self {
            key,
            allowed: min..=max,
        }
    }

    /// The value, checked; a preset states what a key does not.
    fn of(&self, value: Option<f64>) -> Result<f64, ParameterError> {
        let value = value.expect("a preset states every key");
        let (min, max) = (self.allowed.start(), self.allowed.end());
        let text = format!("{min} to {max}");
        ParameterError::check(self.key, value, self.allowed.clone(), &text)?;
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

const CYCLE_US: Range = Range::new("egm.cycle_us", 1000.0, 100_000.0);
const QUEUE_CAPACITY: Range = Range::new("egm.queue_capacity", 1.0, 100_000.0);
const POSITION_GAIN_PER_S: Range = Range::new("egm.position_gain_per_s", 0.0, 20.0);
const LOW_PASS_HZ: Range = Range::new("egm.low_pass_hz", 0.0, 100.0);
const POSITION_CORRECTION_RATIO: Range = Range::new("egm.position_correction_ratio", 0.0, 1.0);
const RAMP_IN_S: Range = Range::new("egm.ramp_in_s", 0.0, 10.0);
const RAMP_OUT_S: Range = Range::new("egm.ramp_out_s", 0.0, 10.0);
const MAX_SPEED_DEVIATION_DEG_PER_S: Range =
    Range::new("egm.max_speed_deviation_deg_per_s", 0.01, 1000.0);
const MAX_POSITION_DEVIATION_DEG: Range = Range::new("egm.max_position_deviation_deg", 0.1, 1000.0);
const CONVERGENCE_DEG: Range = Range::new("egm.convergence_deg", 0.001, 100.0);
const CONDITION_TIME_S: Range = Range::new("egm.condition_time_s", 0.0, 1e6);
const COMM_TIMEOUT_S: Range = Range::new("egm.comm_timeout_s", 0.004, 1e6);
const RESTART_WAIT_S: Range = Range::new("egm.restart_wait_s", 0.0, 60.0);
const ACTIVATION_S: Range = Range::new("egm.activation_s", 0.0, 60.0);
const CONTROL_DELAY_CYCLES: Range =
    Range::new("egm.control_delay_cycles", 0.0, DELAY_CYCLES_MAX as f64);

#[cfg(test)]
#[path = "parameters_tests.rs"]
mod tests;
