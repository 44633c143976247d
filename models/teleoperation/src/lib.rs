//! Case study 2: human motion drives a dual-arm `YuMi` (Lv et al., sections II.C and III.C).
//!
//! ```text
//! human --human/frame--> controller --egm/{right,left}/command--> robot
//!                             |  ^---egm/{right,left}/feedback----'  |
//!                             '---------motion/request-------->      |
//!                                <------motion/response--------------'
//! ```
//!
//! A person swings the right arm from side to side, 125 frames a second. The controller maps the
//! hand to a tool pose, the tool pose to joints, and commands each arm by externally guided
//! motion (EGM); it asks the robot's motion server to start it. The robot is a simulated maker's
//! controller per arm: when the network is silent for too long, the session ends, and what follows
//! is up to settings on both sides. Read in this order:
//!
//! 1. [`messages`] and [`hil_arm::egm::messages`]: what the roles tell each other.
//! 2. [`motion`] with [`swing`], [`bvh`], [`skeleton`]: where the hand is.
//! 3. The follower with [`hil_arm::yumi`]: from the hand to the joints.
//! 4. [`hil_arm::egm::controller`]: from the commands to the motion.
//! 5. `score`: what the robot made of it.
//! 6. [`experiment`]: thousands of loops over channels that a table names, in virtual time.
//!
//! ```
//! use std::collections::BTreeMap;
//! use std::time::Duration;
//!
//! use hil_core::case_study::CaseStudy;
//! use hil_arm::egm::parameters::EgmParameters;
//! use hil_core::simulation::Simulation;
//! use hil_teleoperation::{Teleoperation, TeleoperationParameters};
//!
//! let parameters = TeleoperationParameters {
//!     egm: EgmParameters { position_gain_per_s: Some(5.0), ..Default::default() },
//!     ..Default::default()
//! };
//! let case = Teleoperation::new(parameters, 1)?;
//! let result = Simulation::new(&case, BTreeMap::new())?.run(Duration::from_secs(12))?;
//! let score = case.score(&result.log);
//! let lag_ms = score.get("tracking_lag_ms").and_then(|metric| metric.value);
//! // 195 ms by the control law and four cycles until the motion is measured.
//! assert!(lag_ms.is_some_and(|lag_ms| (lag_ms - 211.0).abs() < 8.0));
//! assert!(case.replay(&result.log).is_some_and(|replay| replay.is_identical()));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! The robot writes everything it hears to the record. From that, [`CaseStudy::replay`] lets a
//! fresh robot move again, in virtual time, and finds the same joints to the last bit.
#![forbid(unsafe_code)]

pub mod bvh;
mod controller;
pub mod experiment;
mod follower;
mod human;
pub mod messages;
pub mod motion;
mod motion_server;
mod parameters;
mod replay;
mod robot;
mod score;
#[cfg(test)]
mod session_tests;
pub mod skeleton;
pub mod swing;
#[cfg(test)]
mod tests;

use crate::controller::Controller;
use crate::experiment::{Calibration, MotionLossStudy};
use crate::human::Human;
use crate::messages::HumanFrame;
use crate::motion::{Motion, Player};
use crate::robot::Robot;
use hil_arm::egm::messages::{
    EgmArrival, EgmCommand, EgmEvent, EgmFeedback, MotionArrival, MotionRequest, MotionResponse,
};
use hil_arm::egm::parameters::ControllerSettings;
use hil_core::case_study::{
    CaseStudy, ChannelSpec, ErrorSeries, LiveEvents, ParameterError, Score,
};
use hil_core::component::Role;
use hil_core::plot::PlotSeries;
use hil_core::random::RandomStream;
use hil_core::recorded_run::{RecordedRun, RowSample};
use hil_core::replay::Replay;
use hil_core::run_log::RunLog;
use hil_core::study::{Batch, StudyRefusal, into_batch};
use hil_core::text_file::TextFile;

pub use crate::parameters::{LeftArm, ResumePolicy, SendPolicy, TeleoperationParameters};
pub use hil_arm::egm::parameters::EgmStartRequest;

/// Channel from human to controller.
pub const HUMAN_FRAME: &str = "human/frame";
/// Channel from controller to robot: commands of the right arm, the hop under test.
pub const EGM_RIGHT_COMMAND: &str = "egm/right/command";
/// Channel from controller to robot: commands of the left arm.
pub const EGM_LEFT_COMMAND: &str = "egm/left/command";
/// Channel from controller to robot: requests to the motion server.
pub const MOTION_REQUEST: &str = "motion/request";
/// Channel from robot to controller: the right arm, every cycle.
pub const EGM_RIGHT_FEEDBACK: &str = "egm/right/feedback";
/// Channel from robot to controller: the left arm, every cycle.
pub const EGM_LEFT_FEEDBACK: &str = "egm/left/feedback";
/// Channel from robot to controller: answers of the motion server.
pub const MOTION_RESPONSE: &str = "motion/response";
/// Channel from robot to the record alone: what happened to the sessions.
pub const EGM_EVENT: &str = "egm/event";
/// Channel from robot to the record alone: every command as it arrived.
pub const EGM_RECEIVED: &str = "egm/received";
/// Channel from robot to the record alone: every request as it arrived.
pub const MOTION_RECEIVED: &str = "motion/received";

/// The case study.
#[derive(Debug, Clone)]
pub struct Teleoperation {
    parameters: TeleoperationParameters,
    settings: ControllerSettings,
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
        .starting_at(self.parameters.motion_start_s)
    }
}

impl CaseStudy for Teleoperation {
    const NAME: &'static str = "teleoperation";
    const SUMMARY: &'static str = "human arm motion drives a dual-arm YuMi over the network";
    const ROLES: &'static [&'static str] = &["human", "controller", "robot"];
    const CHANNELS: &'static [ChannelSpec] = &[
        ChannelSpec::of::<HumanFrame>(HUMAN_FRAME, "human", "controller"),
        ChannelSpec::of::<EgmCommand>(EGM_RIGHT_COMMAND, "controller", "robot"),
        ChannelSpec::of::<EgmCommand>(EGM_LEFT_COMMAND, "controller", "robot"),
        ChannelSpec::of::<MotionRequest>(MOTION_REQUEST, "controller", "robot"),
        ChannelSpec::of::<EgmFeedback>(EGM_RIGHT_FEEDBACK, "robot", "controller"),
        ChannelSpec::of::<EgmFeedback>(EGM_LEFT_FEEDBACK, "robot", "controller"),
        ChannelSpec::of::<MotionResponse>(MOTION_RESPONSE, "robot", "controller"),
        ChannelSpec::recorded::<EgmEvent>(EGM_EVENT, "robot"),
        ChannelSpec::recorded::<EgmArrival>(EGM_RECEIVED, "robot"),
        ChannelSpec::recorded::<MotionArrival>(MOTION_RECEIVED, "robot"),
    ];
    const SCORE_CLOCK: Option<&'static str> = Some(EGM_RIGHT_FEEDBACK);
    const SERIES: &'static [&'static str] = &[
        "fig6-input",
        "fig7-9-tool-y",
        "fig10-joints",
        "fig11-joint-error",
        "motion-loops",
    ];
    const CALIBRATED_FIGURES: &'static [&'static str] = &["mlr"];
    const ROW_SAMPLE: Option<RowSample> = Some(RowSample {
        metric: score::LOOPS_SENT.name,
        what: "motion loops",
        enough: experiment::PUBLISHED_LOOPS as u64,
        copies: None,
    });
    type Parameters = TeleoperationParameters;

    fn read_files(
        parameters: &mut Self::Parameters,
        read: &mut dyn FnMut(&str) -> Result<TextFile, String>,
    ) -> Result<(), ParameterError> {
        parameters.read_files(read)
    }

    fn new(parameters: Self::Parameters, seed: u64) -> Result<Self, ParameterError> {
        parameters.check()?;
        let settings = parameters.egm.settings();
        let settings = settings.map_err(|error| error.below("egm"))?;
        let motion = parameters.motion()?;
        Ok(Self {
            parameters,
            settings,
            motion,
            seed,
        })
    }

    fn undecided(&self) -> Option<String> {
        self.parameters.motion_remark()
    }

    fn role(&self, name: &str) -> Option<Box<dyn Role>> {
        match name {
            "human" => {
                let human = Human::new(self.player(), self.parameters.frame_period());
                Some(human.into_role())
            }
            "controller" => Some(Controller::new(self.parameters.clone()).into_role()),
            "robot" => Some(Robot::new(self.settings).into_role()),
            _ => None,
        }
    }

    fn score(&self, log: &RunLog) -> Score {
        score::score(self, log)
    }

    fn live_events(&self) -> Option<Box<dyn LiveEvents>> {
        Some(Box::<score::live::ArmEvents>::default())
    }

    fn errors(&self, log: &RunLog) -> Vec<ErrorSeries> {
        score::errors(log)
    }

    fn series(&self, log: &RunLog) -> Vec<PlotSeries> {
        score::series(self, log)
    }

    fn replay(&self, log: &RunLog) -> Option<Replay> {
        Some(replay::replay(self.settings, log))
    }

    fn calibration(
        &self,
        figure: &str,
        value: f64,
    ) -> Result<Option<Box<dyn Batch>>, ParameterError> {
        if figure != "mlr" {
            return Ok(None);
        }
        Ok(Some(into_batch(Calibration::new(self, value)?)))
    }

    fn study(
        &self,
        recorded: Vec<RecordedRun<TeleoperationParameters>>,
    ) -> Result<Option<Box<dyn Batch>>, StudyRefusal> {
        Ok(Some(into_batch(MotionLossStudy::new(self, recorded)?)))
    }
}
