//! `[case.parameters.egm]`: every setting of the simulated controller, presets of them, and their
//! ranges. Names follow the maker's where it has one.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use crate::case_study::ParameterError;

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

/// `[case.parameters.egm]`. A key left out takes the preset's value.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
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
    /// `CommTimeout`, 0.004..=1000000 s: without a message for so long, the session ends.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub comm_timeout_s: Option<f64>,
    /// What a requested stop does.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stop_mode: Option<StopMode>,
    /// What starts the first session.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start: Option<StartMode>,
    /// What follows a session that ended by itself.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub restart: Option<RestartPolicy>,
    /// Wait of `wait_then_restart`, 0..=60 s.
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
            cycle: Duration::from_micros(4000),
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
    /// The settings in force.
    ///
    /// # Errors
    /// The first key outside its range, as `egm.<key>`.
    pub fn settings(&self) -> Result<ControllerSettings, ParameterError> {
        todo!()
    }
}
