//! `[case.parameters]` of the fleet case. Each table has its own checks; here they are only
//! joined.

use serde::{Deserialize, Serialize};

use crate::coordinator::parameters::{CoordinatorMode, CoordinatorParameters};
use crate::experiment::TableParameters;
use crate::mission::MissionParameters;
use crate::robot::RobotParameters;
use crate::scenario::WorldParameters;
use crate::world::Vehicle;
use hil_core::case_study::ParameterError;

/// `[case.parameters]` of the fleet case. The defaults are the seed paper's figures where it
/// gives them (section III.B, Table I) and the original implementation's otherwise.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FleetParameters {
    /// Independent fleets that share the channels, 1..=64: critical sections come so many times
    /// faster.
    pub fleets: u32,
    /// Vehicle, map and number of robots.
    pub world: WorldParameters,
    /// How robots drive and take orders.
    pub robot: RobotParameters,
    /// Who goes first, and how it is told.
    pub coordinator: CoordinatorParameters,
    /// Where robots are sent.
    pub missions: MissionParameters,
    /// What `hil-runtime tables` computes.
    pub tables: TableParameters,
}

impl Default for FleetParameters {
    fn default() -> Self {
        Self {
            fleets: 1,
            world: WorldParameters::default(),
            robot: RobotParameters::default(),
            coordinator: CoordinatorParameters::default(),
            missions: MissionParameters::default(),
            tables: TableParameters::default(),
        }
    }
}

impl FleetParameters {
    /// Checks every number but the world's, which is checked when it is built.
    ///
    /// # Errors
    /// The first key outside its range.
    pub fn check(&self) -> Result<(), ParameterError> {
        ParameterError::check("fleets", f64::from(self.fleets), 1.0..=64.0, "1 to 64")?;
        self.robot.check()?;
        self.coordinator.check()?;
        self.missions.check()?;
        self.tables.check()
    }

    /// Checks that the safe coordinator leaves at least the room that the robots may overshoot.
    ///
    /// # Errors
    /// Names the stop error that the tracker may have.
    pub(crate) fn check_stop_error(&self, vehicle: &Vehicle) -> Result<(), ParameterError> {
        let bound_m = self.robot.stop_error_bound_m(vehicle);
        let given_m = self.coordinator.safe.stop_error_m;
        if self.coordinator.mode == CoordinatorMode::Safe && given_m < bound_m {
            return Err(ParameterError::new(
                "coordinator.safe.stop_error_m",
                format!(
                    "{given_m} is below {bound_m:.3} m, which robots with this tracker may go past \
                     their authority"
                ),
            ));
        }
        Ok(())
    }
}
