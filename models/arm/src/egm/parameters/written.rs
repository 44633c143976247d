//! How `[case.parameters.egm]` is written: with every key in force. It checks no range.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::egm::parameters::{ControllerSettings, EgmParameters, RestartPolicy};

impl EgmParameters {
    /// The same settings with every key in force written out: those left out have the preset's
    /// values. `restart_wait_s` is not in force with a policy that never waits.
    #[must_use]
    pub fn spelled_out(&self) -> Self {
        let preset = ControllerSettings::of(self.preset);
        let restart = self.restart.unwrap_or(preset.restart);
        let is_waiting = restart == RestartPolicy::WaitThenRestart;
        let cycle_us = preset.cycle.as_nanos() as f64 / 1e3;
        let speed_deg = in_degrees(preset.max_speed_deviation_rad_per_s);
        let position_deg = in_degrees(preset.max_position_deviation_rad);
        let convergence_deg = in_degrees(preset.convergence_rad);
        let wait_s = is_waiting.then_some(preset.restart_wait_s);
        Self {
            preset: self.preset,
            cycle_us: self.cycle_us.or(Some(cycle_us)),
            queue: self.queue.or(Some(preset.queue)),
            queue_capacity: self.queue_capacity.or(Some(count(preset.queue_capacity))),
            position_gain_per_s: self
                .position_gain_per_s
                .or(Some(preset.position_gain_per_s)),
            low_pass_hz: self.low_pass_hz.or(Some(preset.low_pass_hz)),
            position_correction_ratio: self
                .position_correction_ratio
                .or(Some(preset.position_correction_ratio)),
            ramp_in_s: self.ramp_in_s.or(Some(preset.ramp_in_s)),
            ramp_out_s: self.ramp_out_s.or(Some(preset.ramp_out_s)),
            max_speed_deviation_deg_per_s: self.max_speed_deviation_deg_per_s.or(Some(speed_deg)),
            max_position_deviation_deg: self.max_position_deviation_deg.or(Some(position_deg)),
            convergence_deg: self.convergence_deg.or(Some(convergence_deg)),
            condition_time_s: self.condition_time_s.or(Some(preset.condition_time_s)),
            comm_timeout_s: self.comm_timeout_s.or(Some(preset.comm_timeout_s)),
            stop_mode: self.stop_mode.or(Some(preset.stop_mode)),
            start: self.start.or(Some(preset.start)),
            arms: self.arms.or(Some(preset.arms)),
            restart: Some(restart),
            restart_wait_s: self.restart_wait_s.or(wait_s),
            activation_s: self.activation_s.or(Some(preset.activation_s)),
            control_delay_cycles: self
                .control_delay_cycles
                .or(Some(count(preset.control_delay_cycles))),
        }
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

/// Degrees as a preset states them: on the way through radians they lose their last digits, and
/// come back to the same radians only without that.
fn in_degrees(rad: f64) -> f64 {
    (rad.to_degrees() * 1e9).round() / 1e9
}

/// A small count of a preset.
fn count(number: usize) -> u32 {
    u32::try_from(number).unwrap_or(u32::MAX)
}
