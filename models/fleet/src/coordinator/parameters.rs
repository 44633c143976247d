//! What a user sets about the coordinator, and the checks of it.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use crate::coordinator::policy::PolicyName;
use crate::coordinator::safe::SafeParameters;
use crate::messages::MessageOrder;
use hil_core::case_study::ParameterError;

/// Which rules give robots their way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CoordinatorMode {
    /// The original's: orders are believed delivered.
    #[default]
    Legacy,
    /// Acknowledged movement authority.
    Safe,
}

/// `[case.parameters.coordinator]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CoordinatorParameters {
    /// The rules.
    pub mode: CoordinatorMode,
    /// Who goes first when both could wait.
    pub policy: PolicyName,
    /// Control period, 10..=60000 ms.
    pub control_period_ms: f64,
    /// Largest message delay the coordinator reckons with, 0..=60000 ms; the channel's may differ.
    pub known_delay_ms: f64,
    /// Tracking period of the robots it reckons with, 1..=10000 ms.
    pub tracking_period_ms: f64,
    /// Copies sent of every authority, 1..=10.
    pub replicas: u32,
    /// How states that overtook each other are taken.
    pub message_order: MessageOrder,
    /// Path poses kept between a wait point and the section, 0..=100.
    pub trailing_points: u32,
    /// Missions begun per control period, 1..=1000.
    pub missions_per_cycle: u32,
    /// Time without way after which a robot is put at its goal, 1..=100000 s.
    pub stuck_after_s: f64,
    /// Reverse orders to break up cycles of waiting robots.
    pub break_deadlocks: bool,
    /// Robots stamp states with the controller's clock, so that a state's age means something.
    pub clock_is_shared: bool,
    /// What only the safe mode needs.
    pub safe: SafeParameters,
}

impl Default for CoordinatorParameters {
    fn default() -> Self {
        Self {
            mode: CoordinatorMode::default(),
            policy: PolicyName::default(),
            control_period_ms: 1000.0,
            known_delay_ms: 0.0,
            tracking_period_ms: 30.0,
            replicas: 1,
            message_order: MessageOrder::default(),
            trailing_points: 3,
            missions_per_cycle: 1,
            stuck_after_s: 120.0,
            break_deadlocks: true,
            clock_is_shared: true,
            safe: SafeParameters::default(),
        }
    }
}

impl CoordinatorParameters {
    /// Checks every number against its range.
    ///
    /// # Errors
    /// Names the key, its value and its range.
    pub fn check(&self) -> Result<(), ParameterError> {
        let numbers = [
            ("control_period_ms", self.control_period_ms, 10.0, 60_000.0),
            ("known_delay_ms", self.known_delay_ms, 0.0, 60_000.0),
            ("tracking_period_ms", self.tracking_period_ms, 1.0, 10_000.0),
            ("replicas", f64::from(self.replicas), 1.0, 10.0),
            (
                "trailing_points",
                f64::from(self.trailing_points),
                0.0,
                100.0,
            ),
            (
                "missions_per_cycle",
                f64::from(self.missions_per_cycle),
                1.0,
                1000.0,
            ),
            ("stuck_after_s", self.stuck_after_s, 1.0, 100_000.0),
        ];
        for (key, value, min, max) in numbers {
            let key = format!("coordinator.{key}");
            ParameterError::check(&key, value, min..=max, &format!("{min} to {max}"))?;
        }
        self.safe.check()
    }

    /// Tc.
    pub fn control_period(&self) -> Duration {
        milliseconds(self.control_period_ms)
    }

    /// D, the delay the coordinator reckons with.
    pub fn known_delay(&self) -> Duration {
        milliseconds(self.known_delay_ms)
    }

    /// TT, as the coordinator knows it.
    pub fn tracking_period(&self) -> Duration {
        milliseconds(self.tracking_period_ms)
    }

    /// Time without way after which a robot is reset.
    pub fn stuck_after(&self) -> Duration {
        Duration::from_secs_f64(self.stuck_after_s)
    }
}

fn milliseconds(value: f64) -> Duration {
    Duration::from_secs_f64(value * 1e-3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_outside_its_range_is_named() {
        let check = |change: fn(&mut CoordinatorParameters), expected: &str| {
            let mut parameters = CoordinatorParameters::default();
            assert_eq!(parameters.check(), Ok(()));
            change(&mut parameters);
            let text = parameters.check().unwrap_err().to_string();
            assert!(text.contains(expected), "{text}");
        };
        check(
            |p| p.replicas = 11,
            "coordinator.replicas 11 is outside 1 to 10",
        );
        check(
            |p| p.known_delay_ms = f64::NAN,
            "coordinator.known_delay_ms NaN",
        );
        check(
            |p| p.control_period_ms = 0.0,
            "coordinator.control_period_ms 0",
        );
    }
}
