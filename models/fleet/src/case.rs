//! The case study `fleet`: which roles and channels there are, and what they share.

use crate::controller::Controller;
use crate::coordinator::parameters::{CoordinatorMode, CoordinatorParameters};
use crate::experiment::{FleetStudy, TableParameters};
use crate::feasibility::{Beginning, beginning, obstruction_text, undecided_because};
use crate::live::FleetEvents;
use crate::messages::{Authority, Mission, State, Truth};
use crate::mission::MissionParameters;
use crate::robot::RobotParameters;
use crate::robots::Robots;
use crate::scenario::{Scenario, Scene, WorldParameters};
use crate::score;
use crate::world::Vehicle;
use hil_core::case_study::{CaseStudy, ChannelSpec, ParameterError};
use hil_core::component::Role;
use hil_core::recorded_run::{RecordedRun, RowSample};
use hil_core::run_log::RunLog;
use hil_core::score::{ErrorSeries, LiveEvents, Score};
use hil_core::study::{Batch, StudyRefusal, into_batch};

/// Channel from controller to robots: how far each may go.
pub const FLEET_AUTHORITY: &str = "fleet/authority";
/// Channel from controller to robots: which path each shall drive.
pub const FLEET_MISSION: &str = "fleet/mission";
/// Channel from robots to controller.
pub const FLEET_STATE: &str = "fleet/state";
/// Channel from robots to the recorder alone: what truly happened.
pub const FLEET_TRUTH: &str = "fleet/truth";

/// Case study 1.
///
/// ```text
/// controller --fleet/authority--> robots
///            --fleet/mission---->
///            <----fleet/state----         robots --fleet/truth--> recorder
/// ```
#[derive(Debug, Clone)]
pub struct Fleet {
    parameters: FleetParameters,
    scene: Scene,
    seed: u64,
}

impl Fleet {
    /// World, robots and starts.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// What the user set.
    pub fn parameters(&self) -> &FleetParameters {
        &self.parameters
    }
}

impl CaseStudy for Fleet {
    const NAME: &'static str = "fleet";
    const SUMMARY: &'static str = "seven guided vehicles share a harbor or a warehouse";
    const ROLES: &'static [&'static str] = &["controller", "robots"];
    const CHANNELS: &'static [ChannelSpec] = &[
        ChannelSpec::of::<Authority>(FLEET_AUTHORITY, "controller", "robots"),
        ChannelSpec::of::<Mission>(FLEET_MISSION, "controller", "robots"),
        ChannelSpec::of::<State>(FLEET_STATE, "robots", "controller"),
        ChannelSpec::recorded::<Truth>(FLEET_TRUTH, "robots"),
    ];
    const SCORE_CLOCK: Option<&'static str> = Some(FLEET_TRUTH);
    const ROW_SAMPLE: Option<RowSample> = Some(RowSample {
        metric: score::CRITICAL_SECTIONS.name,
        what: "critical sections",
        enough: 10_000,
        copies: Some("fleets"),
    });
    type Parameters = FleetParameters;

    fn new(parameters: Self::Parameters, seed: u64) -> Result<Self, ParameterError> {
        parameters.check()?;
        let scene = parameters.world.build()?;
        parameters.check_stop_error(&scene.world.vehicle)?;
        parameters.check_beginning(&scene)?;
        Ok(Self {
            parameters,
            scene,
            seed,
        })
    }

    /// A legacy coordinator started anew would believe all robots in their first bays, and robots
    /// started anew would be there while the coordinator believes them under way. A safe one asks.
    fn may_restart(parameters: &FleetParameters, role: &str) -> bool {
        role == "controller" && parameters.coordinator.mode == CoordinatorMode::Safe
    }

    fn role(&self, name: &str) -> Option<Box<dyn Role>> {
        let FleetParameters {
            fleets,
            robot,
            coordinator,
            missions,
            ..
        } = &self.parameters;
        let (fleets, scene) = (*fleets, &self.scene);
        match name {
            "controller" => {
                let controller = Controller::new(scene, coordinator, missions, fleets, self.seed);
                Some(controller.into_role())
            }
            "robots" => Some(Robots::new(scene, robot, fleets, self.seed).into_role()),
            _ => None,
        }
    }

    fn undecided(&self) -> Option<String> {
        let is_safe = self.parameters.coordinator.mode == CoordinatorMode::Safe;
        let reason = undecided_because(&self.scene, &self.parameters.missions, is_safe)?;
        Some(format!(
            "feasibility of the start: not decided, because {reason}"
        ))
    }

    fn score(&self, log: &RunLog) -> Score {
        score::score(self, log)
    }

    fn live_events(&self) -> Option<Box<dyn LiveEvents>> {
        Some(Box::new(FleetEvents::of(self)))
    }

    fn errors(&self, log: &RunLog) -> Vec<ErrorSeries> {
        score::errors(self, log)
    }

    fn study(
        &self,
        recorded: Vec<RecordedRun<FleetParameters>>,
    ) -> Result<Option<Box<dyn Batch>>, StudyRefusal> {
        let study = FleetStudy::new(&self.parameters, self.seed, recorded)?;
        Ok(Some(into_batch(study)))
    }
}

hil_core::options! {
    /// `[case.parameters]` of the fleet case. The defaults are the seed paper's figures where it
    /// gives them (section III.B, Table I) and the original implementation's otherwise.
    pub struct FleetParameters {
        /// Independent fleets that share the channels: critical sections come so many times
        /// faster.
        fleets: u32 = 1, in 1..=64;
        /// Vehicle, map and number of robots.
        world: WorldParameters;
        /// How robots drive and take orders.
        robot: RobotParameters;
        /// Who goes first, and how it is told.
        coordinator: CoordinatorParameters;
        /// Where robots are sent.
        missions: MissionParameters;
        /// What `hil-runtime tables` computes.
        tables: TableParameters;
    }
}

impl FleetParameters {
    /// Checks that some order lets every robot set out, and drive all of its missions.
    fn check_beginning(&self, scene: &Scene) -> Result<(), ParameterError> {
        let is_safe = self.coordinator.mode == CoordinatorMode::Safe;
        let key = match self.world.scenario {
            Scenario::Custom if !self.world.paths.0.is_empty() => "world.paths",
            Scenario::Custom => "world.bays",
            _ => "world.scenario",
        };
        match beginning(scene, &self.missions, is_safe) {
            Beginning::Free | Beginning::Undecided(_) => Ok(()),
            Beginning::Wayless(what) => Err(ParameterError::new(key, what)),
            Beginning::Never(chain) => Err(ParameterError::new(key, obstruction_text(&chain))),
            Beginning::Crowded(ends) => Err(ParameterError::new(
                "missions.missions_per_robot",
                ends.to_string(),
            )),
        }
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
