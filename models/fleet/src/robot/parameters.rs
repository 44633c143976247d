//! What can be set of a robot model, the ranges, and the bound on its stop error. How a tracker
//! works is in its own file.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use crate::messages::MessageOrder;
use crate::world::Vehicle;
use hil_core::case_study::ParameterError;

/// How a robot follows its path.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TrackerKind {
    /// Piecewise constant acceleration in closed form; stops at its authority without error.
    #[default]
    Exact,
    /// The original's: a numerical integration whose decisions fall on its ticks.
    LegacyRk4,
}

/// `[case.parameters.robot]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RobotParameters {
    /// How a robot follows its path.
    pub tracker: TrackerKind,
    /// From tick to tick, and so from state to state, of a robot under way, 1..=1000 ms.
    pub tracking_period_ms: f64,
    /// From state to state of a robot without a mission, 1..=10000 ms.
    pub parked_period_ms: f64,
    /// True lengthens each tick of the legacy tracker by U[0, `inflation_delay_ms`), as the
    /// original does when a message delay is configured. Without effect on the exact tracker.
    pub step_inflation: bool,
    /// How much `step_inflation` lengthens a tick at most, 0..=10000 ms.
    pub inflation_delay_ms: f64,
    /// What becomes of authorities and missions that arrive out of order or twice.
    pub message_order: MessageOrder,
}

impl Default for RobotParameters {
    fn default() -> Self {
        Self {
            tracker: TrackerKind::Exact,
            tracking_period_ms: 30.0,
            parked_period_ms: 300.0,
            step_inflation: false,
            inflation_delay_ms: 0.0,
            message_order: MessageOrder::Legacy,
        }
    }
}

impl RobotParameters {
    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first key outside its range; keys begin with `robot.`.
    pub fn check(&self) -> Result<(), ParameterError> {
        let ranges = [
            (
                "robot.tracking_period_ms",
                self.tracking_period_ms,
                1.0..=1000.0,
                "1 to 1000",
            ),
            (
                "robot.parked_period_ms",
                self.parked_period_ms,
                1.0..=10_000.0,
                "1 to 10000",
            ),
            (
                "robot.inflation_delay_ms",
                self.inflation_delay_ms,
                0.0..=10_000.0,
                "0 to 10000",
            ),
        ];
        for (key, value, allowed, allowed_text) in ranges {
            ParameterError::check(key, value, allowed, allowed_text)?;
        }
        Ok(())
    }

    /// How far past an authority that came in time a robot can come to rest, at most.
    ///
    /// The exact tracker: 0. The legacy tracker: `3 v T + v TT / 2` with `v` the largest speed,
    /// `T` the longest tick and `TT` the tracking period: it brakes up to a tick late, it may have
    /// gone past `v` by what a tick adds, its braking table has steps of half a period, and it
    /// judges whether an order comes in time by where its last tick left it. Without the last of
    /// these the bound is `2 v T + v TT / 2`, which orders of the last moment do pass.
    pub fn stop_error_bound_m(&self, vehicle: &Vehicle) -> f64 {
        match self.tracker {
            TrackerKind::Exact => 0.0,
            TrackerKind::LegacyRk4 => {
                let period_s = 1e-3 * self.tracking_period_ms;
                let longest_s = period_s + 1e-3 * self.inflation_ms();
                vehicle.speed_max_mps * (3.0 * longest_s + 0.5 * period_s)
            }
        }
    }

    pub(crate) fn tracking_period(&self) -> Duration {
        Duration::from_secs_f64(1e-3 * self.tracking_period_ms)
    }

    pub(crate) fn parked_period(&self) -> Duration {
        Duration::from_secs_f64(1e-3 * self.parked_period_ms)
    }

    pub(crate) fn inflation_ms(&self) -> f64 {
        if self.step_inflation && self.tracker == TrackerKind::LegacyRk4 {
            self.inflation_delay_ms
        } else {
            0.0
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Footprint;

    #[test]
    fn each_number_outside_its_range_is_refused_by_name() {
        let check = |key: &str, change: fn(&mut RobotParameters)| {
            let mut parameters = RobotParameters::default();
            change(&mut parameters);
            assert_eq!(parameters.check().unwrap_err().key, key);
        };
        check("robot.tracking_period_ms", |p| p.tracking_period_ms = 0.0);
        check("robot.parked_period_ms", |p| p.parked_period_ms = f64::NAN);
        check("robot.inflation_delay_ms", |p| p.inflation_delay_ms = -1.0);
        assert_eq!(RobotParameters::default().check(), Ok(()));
    }

    #[test]
    fn the_harbor_bound_at_100_ms_is_the_sum_of_its_terms() {
        let vehicle = Vehicle {
            footprint: Footprint {
                length_m: 14.8,
                width_m: 3.0,
            },
            speed_max_mps: 6.0,
            acceleration_mps2: 2.0,
        };
        let mut parameters = RobotParameters {
            tracker: TrackerKind::LegacyRk4,
            step_inflation: true,
            inflation_delay_ms: 100.0,
            ..RobotParameters::default()
        };
        assert!((parameters.stop_error_bound_m(&vehicle) - 2.43).abs() < 1e-12);
        parameters.step_inflation = false;
        assert!((parameters.stop_error_bound_m(&vehicle) - 0.63).abs() < 1e-12);
        parameters.tracker = TrackerKind::Exact;
        assert!(parameters.stop_error_bound_m(&vehicle).abs() < f64::EPSILON);
    }
}
