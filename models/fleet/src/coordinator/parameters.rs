//! What a user sets about the coordinator, and the checks of it.

use core::time::Duration;

use crate::coordinator::policy::PolicyName;
use crate::coordinator::safe::SafeParameters;
use crate::messages::MessageOrder;

hil_core::words! {
    /// Which rules give robots their way.
    #[derive(Default)]
    pub enum CoordinatorMode {
        /// The original's: orders are believed delivered.
        #[default]
        Legacy = "legacy",
        /// Acknowledged movement authority.
        Safe = "safe",
    }
}

hil_core::options! {
    /// `[case.parameters.coordinator]`.
    pub struct CoordinatorParameters {
        /// The rules.
        mode: CoordinatorMode = CoordinatorMode::Legacy;
        /// Who goes first when both could wait.
        policy: PolicyName = PolicyName::ClosestFirst;
        /// Control period, ms.
        control_period_ms: f64 = 1000.0, in 10.0..=60_000.0;
        /// Largest message delay the coordinator reckons with, ms; the channel's may differ.
        known_delay_ms: f64 = 0.0, in 0.0..=60_000.0;
        /// Tracking period of the robots it reckons with, ms.
        tracking_period_ms: f64 = 30.0, in 1.0..=10_000.0;
        /// Copies sent of every authority.
        replicas: u32 = 1, in 1..=10;
        /// How states that overtook each other are taken.
        message_order: MessageOrder = MessageOrder::Legacy;
        /// Path poses kept between a wait point and the section.
        trailing_points: u32 = 3, in 0..=100;
        /// Missions begun per control period.
        missions_per_cycle: u32 = 1, in 1..=1000;
        /// Time without way after which a robot is put at its goal, s.
        stuck_after_s: f64 = 120.0, in 1.0..=100_000.0;
        /// Reverse orders to break up cycles of waiting robots.
        break_deadlocks: bool = true;
        /// What only the safe mode needs.
        safe: SafeParameters;
    }
}

impl CoordinatorParameters {
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
        check(|p| p.replicas = 11, "replicas 11 is outside 1 to 10");
        check(|p| p.known_delay_ms = f64::NAN, "known_delay_ms NaN");
        check(|p| p.control_period_ms = 0.0, "control_period_ms 0");
    }
}
