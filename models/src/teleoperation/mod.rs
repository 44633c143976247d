//! Case study 2: human motion drives a dual-arm `YuMi` (Lv et al., sections II.C and III.C).
//!
//! ```text
//! human --human/frame--> controller --arm/command--> robot
//!                             ^-------arm/status-------'
//! ```
//!
//! A person swings the right arm from side to side, 125 frames a second. The controller maps the
//! hand to a tool pose, the tool pose to joints, and commands the robot, whose servo follows by
//! the published law of externally guided motion. Read in this order:
//!
//! 1. [`messages`]: what the roles tell each other.
//! 2. [`motion`] with [`swing`], [`bvh`], [`skeleton`]: where the hand is.
//! 3. [`mapping`] with [`crate::yumi`]: from the hand to the joints.
//! 4. [`servo`]: from the command to the motion.
//! 5. `score`: what the robot made of it.
//!
//! ```
//! use std::collections::BTreeMap;
//! use std::time::Duration;
//!
//! use hil_models::case_study::CaseStudy;
//! use hil_models::simulation::Simulation;
//! use hil_models::teleoperation::{Teleoperation, TeleoperationParameters};
//!
//! let parameters = TeleoperationParameters { servo_gain_per_s: 20.0, ..Default::default() };
//! let case = Teleoperation::new(parameters, 1)?;
//! let result = Simulation::new(&case, BTreeMap::new())?.run(Duration::from_secs(10))?;
//! let score = case.score(&result.log);
//! let lag_ms = score.get("tracking_lag_ms").and_then(|metric| metric.value);
//! assert!(lag_ms.is_some_and(|lag_ms| (lag_ms - 50.0).abs() < 8.0));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! This first form has no guided-motion session: no time-out, no re-activation, no message queue
//! on the robot's side. A silent network makes the robot hold; it never stops the motion for good.

pub mod bvh;
mod controller;
mod human;
pub mod mapping;
pub mod messages;
pub mod motion;
mod parameters;
mod robot;
mod score;
pub(crate) mod series;
pub mod servo;
pub mod skeleton;
pub mod swing;
#[cfg(test)]
mod tests;

use crate::case_study::{CaseStudy, ChannelSpec, ParameterError, Score};
use crate::component::{Role, into_role};
use crate::random::RandomStream;
use crate::run_log::RunLog;
use crate::teleoperation::controller::Controller;
use crate::teleoperation::human::Human;
use crate::teleoperation::messages::{HumanFrame, JointCommand, JointStatus};
use crate::teleoperation::motion::{Motion, Player};
use crate::teleoperation::robot::Robot;

pub use crate::teleoperation::parameters::{LeftArm, TeleoperationParameters};

/// Channel from human to controller.
pub const HUMAN_FRAME: &str = "human/frame";
/// Channel from controller to robot: the hop under test.
pub const ARM_COMMAND: &str = "arm/command";
/// Channel from robot to controller.
pub const ARM_STATUS: &str = "arm/status";

/// The case study.
#[derive(Debug, Clone)]
pub struct Teleoperation {
    parameters: TeleoperationParameters,
    motion: Motion,
    seed: u64,
}

impl Teleoperation {
    /// How far the tool shall move from side to side in one loop, metres: what a motion loop is
    /// measured against.
    pub fn nominal_peak_to_peak_m(&self) -> f64 {
        let parameters = &self.parameters;
        parameters.mapping_scale_ratio
            * self
                .motion
                .lateral_peak_to_peak_m(parameters.motion_period_s)
    }

    fn player(&self) -> Player {
        Player::new(
            self.motion.clone(),
            self.parameters.motion_period_s,
            self.parameters.loop_variation_ratio,
            RandomStream::new(self.seed, "teleoperation human"),
        )
    }
}

impl CaseStudy for Teleoperation {
    const NAME: &'static str = "teleoperation";
    const SUMMARY: &'static str = "human arm motion drives a dual-arm YuMi over the network";
    const ROLES: &'static [&'static str] = &["human", "controller", "robot"];
    const CHANNELS: &'static [ChannelSpec] = &[
        ChannelSpec::of::<HumanFrame>(HUMAN_FRAME, "human", "controller"),
        ChannelSpec::of::<JointCommand>(ARM_COMMAND, "controller", "robot"),
        ChannelSpec::of::<JointStatus>(ARM_STATUS, "robot", "controller"),
    ];
    type Parameters = TeleoperationParameters;

    fn read_files(
        parameters: &mut Self::Parameters,
        read: &mut dyn FnMut(&str) -> Result<String, String>,
    ) -> Result<(), ParameterError> {
        parameters.read_files(read)
    }

    fn new(parameters: Self::Parameters, seed: u64) -> Result<Self, ParameterError> {
        parameters.check()?;
        let motion = parameters.motion()?;
        Ok(Self {
            parameters,
            motion,
            seed,
        })
    }

    fn role(&self, name: &str) -> Option<Box<dyn Role>> {
        match name {
            "human" => Some(into_role(Human::new(
                self.player(),
                self.parameters.frame_period(),
            ))),
            "controller" => Some(into_role(Controller::new(self.parameters.clone()))),
            "robot" => Some(into_role(Robot::new(&self.parameters))),
            _ => None,
        }
    }

    fn score(&self, log: &RunLog) -> Score {
        score::score(self, log)
    }
}
