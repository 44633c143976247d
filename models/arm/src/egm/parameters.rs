//! `[case.parameters.egm]`: every setting of the simulated controller, presets of them, and their
//! ranges. Names follow the maker's where it has one.

use core::ops::RangeInclusive;
use core::time::Duration;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::egm::controller::DELAY_CYCLES_MAX;
use crate::egm::messages::{MotionRefusal, Side};
use hil_core::case_study::ParameterError;

hil_core::words! {
    /// A named set of settings that single keys may then change.
    #[derive(Default)]
    pub enum Preset {
        /// The maker's defaults, with their traps.
        AbbDefault = "abb-default",
        /// Everything open: level 0, highest gain, no filter to speak of.
        Raw = "raw",
        /// As the `YuMi` programs of KTH set it.
        KthYumi = "kth-yumi",
        /// Fitted so that calibrated outages reproduce the seed paper's motion loss; the paper states
        /// none of these values.
        #[default]
        Paper = "paper",
    }
}

hil_core::words! {
    /// How the controller takes queued commands.
    pub enum QueuePolicy {
        /// One per cycle, oldest first, as the maker documents it.
        Fifo1 = "fifo1",
        /// The newest; those it overtook are dropped and counted. What would help.
        Latest = "latest",
    }
}

hil_core::words! {
    /// What becomes of the motion when a session is stopped by request.
    pub enum StopMode {
        /// Stays where it is.
        Hold = "hold",
        /// Returns to where the session started.
        RampDown = "ramp-down",
    }
}

hil_core::words! {
    /// What starts the first session.
    pub enum StartMode {
        /// A request to the motion server.
        Request = "request",
        /// The program by itself, from the robot's start.
        PowerOn = "power-on",
    }
}

hil_core::words! {
    /// What the program does when a session ended by itself.
    pub enum RestartPolicy {
        /// Starts the next at once; setting it up takes `activation_s`.
        AutoRetry = "auto_retry",
        /// Waits `restart_wait_s` first.
        WaitThenRestart = "wait_then_restart",
        /// Goes idle until a request starts the next.
        ExternalTrigger = "external_trigger",
        /// Moves to the home posture first.
        GoHomeFirst = "go_home_first",
    }
}

hil_core::words! {
    /// Whose program starts guided motion by itself with [`StartMode::PowerOn`]. The other arm stands
    /// still until a request moves it.
    pub enum GuidedArms {
        /// Both arms'.
        Both = "both",
        /// The right arm's.
        Right = "right",
        /// The left arm's.
        Left = "left",
    }
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

/// [`DELAY_CYCLES_MAX`], as a setting states it.
const DELAY_CYCLES: u32 = 16;
const _: () = assert!(DELAY_CYCLES as usize == DELAY_CYCLES_MAX);

/// Declares the settings of the controller, one a line: what it is, key and type in files, the maker's
/// default, range, and what becomes of it in SI units. Gives [`EgmParameters`], [`ControllerSettings`]
/// and what leads from one to the other.
macro_rules! settings {
    ($($(#[doc = $about:literal])+ $key:ident: $kind:ty = $abb:expr
        $(, in $allowed:expr)?, as $field:ident: $si:ty = $convert:expr;)+) => {
        hil_core::options! {
            /// `[case.parameters.egm]`. A key left out takes the preset's value; written out again, every
            /// key in force is there, see [`EgmParameters::spelled_out`].
            #[serde(remote = "Self")]
            pub struct EgmParameters {
                /// Where the other keys come from.
                preset: Preset = Preset::Paper;
                $($(#[doc = $about])+ $key: Option<$kind> $(, in $allowed)?;)+
            }
        }

        /// The settings in force: a preset and what the keys changed. SI units and radians.
        #[derive(Debug, Clone, Copy, PartialEq)]
        pub struct ControllerSettings {
            $(#[doc = concat!("See [`EgmParameters::", stringify!($key), "`].")] pub $field: $si,)+
        }

        /// What each number may be, by key.
        #[allow(non_upper_case_globals, reason = "as the keys are spelled")]
        #[allow(dead_code, reason = "a request may change only some of them")]
        mod allowed {
            use super::{DELAY_CYCLES, RangeInclusive};

            $($(pub(super) const $key: RangeInclusive<$kind> = $allowed;)?)+
        }

        impl EgmParameters {
            /// The maker's defaults; `RampInTime` and the set-up time have none in its manual.
            const ABB_DEFAULT: Self = Self {
                preset: Preset::AbbDefault,
                $($key: Some($abb),)+
            };

            /// Every key, from `preset` where this has none.
            fn or(&self, preset: &Self) -> Self {
                Self {
                    preset: self.preset,
                    $($key: self.$key.or(preset.$key),)+
                }
            }

            /// The settings of a set of parameters that states every key.
            fn converted(&self) -> ControllerSettings {
                const STATED: &str = "a preset states every key";
                ControllerSettings {
                    $($field: $convert(self.$key.expect(STATED)),)+
                }
            }
        }
    };
}

settings! {
    /// Controller cycle, us; real controllers were seen at 4032, simulated at 4000.
    cycle_us: f64 = 4000.0, in 1000.0..=100_000.0, as cycle: Duration = microseconds;
    /// Queue policy.
    queue: QueuePolicy = QueuePolicy::Fifo1, as queue: QueuePolicy = as_is;
    /// Commands the queue holds; further ones are dropped and counted.
    queue_capacity: u32 = 1000, in 1..=100_000, as queue_capacity: usize = whole;
    /// Default Proportional Position Gain, 1/s.
    position_gain_per_s: f64 = 5.0, in 0.0..=20.0, as position_gain_per_s: f64 = as_is;
    /// Default Low Pass Filter Bandwidth, Hz; 0 switches it off.
    low_pass_hz: f64 = 20.0, in 0.0..=100.0, as low_pass_hz: f64 = as_is;
    /// `PosCorrGain`; 0 is pure speed control.
    position_correction_ratio: f64 = 1.0, in 0.0..=1.0, as position_correction_ratio: f64 = as_is;
    /// `RampInTime`, s: the share of the correction grows from 0 to 1 over it.
    ramp_in_s: f64 = 0.5, in 0.0..=10.0, as ramp_in_s: f64 = as_is;
    /// `RampOutTime`, s: how long a stop by `ramp-down` takes.
    ramp_out_s: f64 = 0.5, in 0.0..=10.0, as ramp_out_s: f64 = as_is;
    /// `MaxSpeedDeviation`, deg/s: all joints are slowed by one ratio.
    max_speed_deviation_deg_per_s: f64 = 1.0, in 0.01..=1000.0,
        as max_speed_deviation_rad_per_s: f64 = f64::to_radians;
    /// `MaxPosDeviation`, deg from where the session started; beyond, it ends.
    max_position_deviation_deg: f64 = 1000.0, in 0.1..=1000.0,
        as max_position_deviation_rad: f64 = f64::to_radians;
    /// Half the convergence window, deg.
    convergence_deg: f64 = 0.5, in 0.001..=100.0, as convergence_rad: f64 = f64::to_radians;
    /// `CondTime`, s: converged for so long, the session ends.
    condition_time_s: f64 = 1.0, in 0.0..=1e6, as condition_time_s: f64 = as_is;
    /// `CommTimeout`, s: without a message for so long, the session ends. A refused one does not
    /// count.
    comm_timeout_s: f64 = 1.0, in 0.004..=1e6, as comm_timeout_s: f64 = as_is;
    /// What a requested stop does.
    stop_mode: StopMode = StopMode::Hold, as stop_mode: StopMode = as_is;
    /// What starts the first session.
    start: StartMode = StartMode::Request, as start: StartMode = as_is;
    /// Whose program does so with `start = "power-on"`.
    arms: GuidedArms = GuidedArms::Both, as arms: GuidedArms = as_is;
    /// What follows a session that ended by itself.
    restart: RestartPolicy = RestartPolicy::AutoRetry, as restart: RestartPolicy = as_is;
    /// Wait of `wait_then_restart`, s; refused with a policy that never waits.
    restart_wait_s: f64 = 1.0, in 0.0..=60.0, as restart_wait_s: f64 = as_is;
    /// How long setting a session up takes (fine point, synchronisation, set-up), s.
    activation_s: f64 = 0.5, in 0.0..=60.0, as activation_s: f64 = as_is;
    /// Cycles by which the measured joints lag the planned ones: the maker's control lag of 10 to
    /// 20 ms, filtering level included.
    control_delay_cycles: u32 = 4, in 0..=DELAY_CYCLES,
        as control_delay_cycles: usize = whole;
}

/// Declares what a request may change for its session, in the order of the message: key, field of
/// [`EgmStartParameters`] and [`ControllerSettings`], and unit.
macro_rules! start_settings {
    ($($key:ident as $field:ident, $unit:expr;)+) => {
        hil_core::message! {
            /// What a session shall differ in from the controller's own settings; NaN keeps the setting.
            pub struct EgmStartParameters, 64 bytes {
                $(
                    #[doc = concat!("See [`ControllerSettings::", stringify!($field), "`].")]
                    pub $field: f64,
                )+
            }
        }

        impl EgmStartParameters {
            /// Keeps every setting.
            pub const KEEP: Self = Self { $($field: f64::NAN,)+ };
        }

        hil_core::options! {
            /// `[case.parameters.egm_start]`: what the controller asks the robot to change when it asks for
            /// guided motion. A key left out keeps the robot's setting; ranges are those of
            /// [`EgmParameters`].
            pub struct EgmStartRequest {
                $(
                    /// For this session, in place of the robot's setting of this name.
                    $key: Option<f64>, in allowed::$key;
                )+
            }
        }

        impl EgmStartRequest {
            /// As it travels; a key left out is NaN.
            pub fn message(&self) -> EgmStartParameters {
                EgmStartParameters { $($field: self.$key.map_or(f64::NAN, $unit.to_si),)+ }
            }
        }

        impl ControllerSettings {
            /// These settings with what `parameters` ask for.
            ///
            /// # Errors
            /// [`MotionRefusal::BadNumber`] when one is outside the range of its key in
            /// [`EgmParameters`]; NaN asks for nothing.
            pub fn with(&self, parameters: &EgmStartParameters) -> Result<Self, MotionRefusal> {
                Ok(Self {
                    $($field: $unit.or_kept(parameters.$field, self.$field, &allowed::$key)?,)+
                    ..*self
                })
            }
        }
    };
}

start_settings! {
    comm_timeout_s as comm_timeout_s, PLAIN;
    condition_time_s as condition_time_s, PLAIN;
    max_speed_deviation_deg_per_s as max_speed_deviation_rad_per_s, DEGREES;
    max_position_deviation_deg as max_position_deviation_rad, DEGREES;
    ramp_in_s as ramp_in_s, PLAIN;
    position_correction_ratio as position_correction_ratio, PLAIN;
    position_gain_per_s as position_gain_per_s, PLAIN;
    low_pass_hz as low_pass_hz, PLAIN;
}

/// The unit of a key.
struct Unit {
    to_si: fn(f64) -> f64,
    from_si: fn(f64) -> f64,
    /// By how much of itself a bound of a range may change on the way.
    slack_ratio: f64,
}

const PLAIN: Unit = Unit {
    to_si: as_is,
    from_si: as_is,
    slack_ratio: 0.0,
};
const DEGREES: Unit = Unit {
    to_si: f64::to_radians,
    from_si: f64::to_degrees,
    slack_ratio: 1e-6,
};

impl Unit {
    /// What is asked for, in SI units, if a key of this unit may say so; what is kept for NaN.
    fn or_kept(
        &self,
        asked: f64,
        kept: f64,
        allowed: &RangeInclusive<f64>,
    ) -> Result<f64, MotionRefusal> {
        if asked.is_nan() {
            return Ok(kept);
        }
        let key = (self.from_si)(asked);
        let within = key.clamp(*allowed.start(), *allowed.end());
        if (key - within).abs() <= self.slack_ratio * within {
            Ok(asked)
        } else {
            Err(MotionRefusal::BadNumber)
        }
    }
}

const fn as_is<T: Copy>(value: T) -> T {
    value
}

fn microseconds(value: f64) -> Duration {
    Duration::from_secs_f64(value * 1e-6)
}

const fn whole(count: u32) -> usize {
    count as usize
}

impl ControllerSettings {
    /// The settings of a preset.
    pub fn of(preset: Preset) -> Self {
        EgmParameters::of(preset).converted()
    }
}

impl EgmParameters {
    /// A preset with each of its values.
    fn of(preset: Preset) -> Self {
        let abb = Self {
            preset,
            ..Self::ABB_DEFAULT
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
        let all = self.or(&Self::of(self.preset));
        let is_waiting = all.restart == Some(RestartPolicy::WaitThenRestart);
        Self {
            restart_wait_s: if is_waiting {
                all.restart_wait_s
            } else {
                self.restart_wait_s
            },
            ..all
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
    /// The first key outside its range.
    pub fn settings(&self) -> Result<ControllerSettings, ParameterError> {
        self.check()?;
        let settings = self.or(&Self::of(self.preset)).converted();
        if let Some(wait_s) = self.restart_wait_s
            && settings.restart != RestartPolicy::WaitThenRestart
        {
            let problem =
                format!("{wait_s} has no effect: it needs restart = \"wait_then_restart\"");
            return Err(ParameterError::new("restart_wait_s", problem));
        }
        Ok(settings)
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

#[cfg(test)]
#[path = "parameters_tests.rs"]
mod tests;
