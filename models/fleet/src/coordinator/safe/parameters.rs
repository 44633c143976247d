//! What a user sets about the safe coordinator, the checks of it, and how far a robot may miss
//! the end of its authority.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use crate::coordinator::safe::liveness::StopMargin;
use crate::geometry::floor_index;
use crate::world::World;
use hil_core::case_study::ParameterError;

/// `[case.parameters.coordinator.safe]`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SafeParameters {
    /// How far robots may stop from the end of their authority, 0..=1000 m; 0 for the exact
    /// tracker, [`RobotParameters::stop_error_bound_m`](crate::robot::RobotParameters::stop_error_bound_m) for the stepped one.
    pub stop_error_m: f64,
    /// Authority beyond what a robot needs in order not to brake before the next one comes, as
    /// time at its speed, 0..=60000 ms.
    pub reserve_ms: f64,
    /// How long a robot waits before the order of all is kept until it is through, 1..=100000 s.
    pub patience_s: f64,
    /// Take authority back, by acknowledged shrinks, where the policy prefers another robot.
    pub takes_back: bool,
    /// How long an authority holds after its receipt, 0..=3600000 ms; 0 for ever. Needs
    /// `delay_bound_ms`.
    pub lease_ms: f64,
    /// Measured largest delay of a message either way, its error included, 0..=3600000 ms. Only
    /// with a lease; with a shared clock it is watched.
    pub delay_bound_ms: f64,
}

impl Default for SafeParameters {
    fn default() -> Self {
        Self {
            stop_error_m: 0.0,
            reserve_ms: 200.0,
            patience_s: 60.0,
            takes_back: true,
            lease_ms: 0.0,
            delay_bound_ms: 0.0,
        }
    }
}

impl SafeParameters {
    /// Checks every number against its range.
    ///
    /// # Errors
    /// Names the key, its value and its range.
    pub fn check(&self) -> Result<(), ParameterError> {
        let numbers = [
            ("stop_error_m", self.stop_error_m, 0.0, 1000.0),
            ("reserve_ms", self.reserve_ms, 0.0, 60_000.0),
            ("patience_s", self.patience_s, 1.0, 100_000.0),
            ("lease_ms", self.lease_ms, 0.0, 3_600_000.0),
            ("delay_bound_ms", self.delay_bound_ms, 0.0, 3_600_000.0),
        ];
        for (key, value, min, max) in numbers {
            let key = format!("coordinator.safe.{key}");
            ParameterError::check(&key, value, min..=max, &format!("{min} to {max}"))?;
        }
        if self.lease_ms > 0.0 && self.delay_bound_ms <= 0.0 {
            return Err(ParameterError::new(
                "coordinator.safe.delay_bound_ms",
                "0 is no bound; a lease needs the largest delay, in ms",
            ));
        }
        Ok(())
    }

    /// See [`SafeParameters::patience_s`].
    pub fn patience(&self) -> Duration {
        Duration::from_secs_f64(self.patience_s)
    }

    /// The stop error in poses of `world`'s paths, one pose for rounding added.
    pub(crate) fn stop_margin(&self, world: &World) -> StopMargin {
        let spacing_m = world
            .paths
            .ids()
            .filter_map(|id| world.paths.get(id))
            .map(|path| path.spacing_m())
            .fold(f64::INFINITY, f64::min);
        let poses = floor_index((self.stop_error_m / spacing_m).ceil()) + 1;
        StopMargin {
            below: poses,
            above: poses,
        }
    }
}
