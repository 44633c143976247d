//! The simulated controller of one arm's motion task: commands in, joints out, once a cycle. It owns
//! no clock, no socket and no thread: whoever drives it says when a command arrived and which
//! point of the cycle grid is due, so real and virtual time give the same joints.

use crate::egm::messages::{
    CommandRefusal, EgmCommand, EgmEvent, EgmFeedback, EgmStartParameters, MotionRefusal, Side,
};
use crate::egm::parameters::ControllerSettings;
use crate::time::Instant;
use crate::yumi::{Joints, Pose};

/// One arm's controller.
#[derive(Debug, Clone)]
pub struct Controller {
    side: Side,
    settings: ControllerSettings,
}

impl Controller {
    /// At rest at `q_rad`, without a session.
    pub fn new(side: Side, settings: ControllerSettings, q_rad: Joints) -> Self {
        let _unused = q_rad;
        Self { side, settings }
    }

    /// Takes a command that arrived at `at`; calls come in non-decreasing `at`. It is used by the
    /// first cycle whose grid time is later than `at`, or a later one, as the queue has it.
    ///
    /// # Errors
    /// Why it will never reach the servo; it is counted and told by the next cycle's events.
    pub fn receive(&mut self, at: Instant, command: &EgmCommand) -> Result<(), CommandRefusal> {
        let _unused = (at, command);
        todo!()
    }

    /// Starts guided motion with `parameters` from the next cycle on.
    ///
    /// # Errors
    /// When a parameter is outside its range or the arm is busy.
    pub fn start_guided_motion(
        &mut self,
        parameters: &EgmStartParameters,
    ) -> Result<(), MotionRefusal> {
        let _unused = parameters;
        todo!()
    }

    /// Stops guided motion by the stop mode, from the next cycle on; nothing to do without it.
    pub fn stop_guided_motion(&mut self) {
        todo!()
    }

    /// Moves along `path`, joint positions one cycle apart, from the next cycle on.
    ///
    /// # Errors
    /// When the arm is busy.
    pub fn move_along(&mut self, path: Vec<Joints>) -> Result<(), MotionRefusal> {
        let _unused = path;
        todo!()
    }

    /// Goes through the cycle due at the grid time `at`: moves by the reference in use, then takes
    /// the next command that had arrived before `at`. Tells what happened.
    pub fn cycle(&mut self, at: Instant, tell: &mut dyn FnMut(EgmEvent)) {
        let _unused = (at, tell);
        todo!()
    }

    /// The feedback of the last cycle; `tool` is where the kinematics puts the tool for
    /// [`Controller::measured_rad`].
    pub fn feedback(&self, tool: &Pose) -> EgmFeedback {
        let _unused = tool;
        todo!()
    }

    /// Joint positions as measured in the last cycle.
    pub fn measured_rad(&self) -> &Joints {
        todo!()
    }
}
