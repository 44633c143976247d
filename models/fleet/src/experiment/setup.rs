//! All that sets one experiment apart from another, but for its world and its seed.

use serde::{Deserialize, Serialize};

use crate::coordinator::parameters::CoordinatorParameters;
use crate::mission::MissionParameters;
use crate::robot::RobotParameters;
use hil_core::case_study::ParameterError;
use hil_link::impaired::Impairments;
use hil_link::wifi::WifiSpec;

/// How the coordinator learns what the robots do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StatusPath {
    /// It reads their true state at each decision, whatever the network does; missions reach the
    /// robots at once. The original since 2020.
    Bypass,
    /// By messages over the network.
    #[default]
    Network,
}

/// What lies between coordinator and robots.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Links {
    /// Whether states go over the network at all.
    pub status_path: StatusPath,
    /// A radio, commands forward and states backward, in place of both impairments.
    pub wifi: Option<WifiSpec>,
    /// What authorities and missions meet.
    pub commands: Impairments,
    /// What states meet.
    pub status: Impairments,
    /// A newer state deletes those still under way that it overtakes, as in the original.
    pub status_keeps_order: bool,
}

/// One experiment.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Setup {
    /// How robots drive and take orders.
    pub robot: RobotParameters,
    /// Who goes first, and how it is told.
    pub coordinator: CoordinatorParameters,
    /// Where robots are sent.
    pub missions: MissionParameters,
    /// What lies between.
    pub links: Links,
    /// A control cycle takes up to this much longer than its period, uniform, seconds.
    pub overrun_max_s: f64,
}

impl Setup {
    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first key outside its range.
    pub fn check(&self) -> Result<(), ParameterError> {
        self.robot.check()?;
        self.coordinator.check()?;
        self.missions.check()?;
        if let Some(wifi) = &self.links.wifi {
            wifi.check()?;
        }
        self.links.commands.check()?;
        self.links.status.check()?;
        let overrun_s = self.overrun_max_s;
        ParameterError::check("overrun_max_s", overrun_s, 0.0..=600.0, "0 to 600")
    }
}
