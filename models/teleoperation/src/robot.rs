//! The role "robot": two arms, each a controller of guided motion, and the motion server, all in
//! one cycle. It computes no control law itself: see [`hil_arm::egm::controller`].
//!
//! The cycle lies on an absolute grid. What arrived at `a` can act from the first grid point
//! *later* than `a`; a call that comes late goes through every grid point in between, each with
//! what had arrived before it. So the joints follow from start, settings and arrivals alone, and
//! those are what the robot writes to the record.

use core::time::Duration;

use crate::motion_server::MotionServer;
use crate::{
    EGM_EVENT, EGM_LEFT_COMMAND, EGM_LEFT_FEEDBACK, EGM_RECEIVED, EGM_RIGHT_COMMAND,
    EGM_RIGHT_FEEDBACK, MOTION_RECEIVED, MOTION_REQUEST, MOTION_RESPONSE,
};
use hil_arm::egm::controller::Controller;
use hil_arm::egm::messages::{
    EgmArrival, EgmCommand, EgmEvent, EgmFeedback, MotionArrival, MotionRequest, MotionResponse,
    Side,
};
use hil_arm::egm::parameters::ControllerSettings;
use hil_arm::yumi::Joints;
use hil_arm::yumi::arm::{Arm, LEFT_START_RAD, RIGHT_START_RAD};
use hil_core::component::{Component, Output, Role};
use hil_core::time::{Instant, Tick, duration_ns};

/// Where the arms are at the robot's start, right then left.
const START_RAD: [Joints; 2] = [RIGHT_START_RAD, LEFT_START_RAD];

/// The arms' kinematics, right then left.
pub(crate) fn arms() -> [Arm; 2] {
    [Arm::right(), Arm::left()]
}

/// The role.
#[derive(Debug)]
pub(crate) struct Robot {
    period: Duration,
    started: Option<Instant>,
    /// The next grid point to go through.
    next_cycle: u64,
    arms: [Arm; 2],
    controllers: [Controller; 2],
    server: MotionServer,
    /// By arm.
    feedback: [Output<EgmFeedback>; 2],
    response: Output<MotionResponse>,
    event: Output<EgmEvent>,
    command_received: Output<EgmArrival>,
    request_received: Output<MotionArrival>,
}

impl Robot {
    /// A robot at rest in its start posture.
    pub(crate) fn new(settings: ControllerSettings) -> Self {
        let controller = |side: Side| Controller::new(side, settings, START_RAD[side.index()]);
        Self {
            period: settings.cycle,
            started: None,
            next_cycle: 0,
            arms: arms(),
            controllers: Side::BOTH.map(controller),
            server: MotionServer::new(arms(), settings.cycle),
            feedback: Default::default(),
            response: Output::default(),
            event: Output::default(),
            command_received: Output::default(),
            request_received: Output::default(),
        }
    }

    fn grid_point(&self, start: Instant, index: u64) -> Instant {
        let steps = i64::try_from(index).unwrap_or(i64::MAX);
        let since_ns = duration_ns(self.period).saturating_mul(steps);
        Instant::from_ns(start.as_ns().saturating_add(since_ns))
    }

    /// Goes through every grid point up to and including `now`.
    fn advance(&mut self, now: Instant) {
        let Some(start) = self.started else { return };
        loop {
            let at = self.grid_point(start, self.next_cycle);
            if at > now {
                break;
            }
            self.next_cycle += 1;
            self.server.take_request(&mut self.controllers);
            for controller in &mut self.controllers {
                controller.cycle(at, &mut |event| self.event.send(event));
            }
            self.server.answer(&self.controllers, &mut |response| {
                self.response.send(response);
            });
        }
    }

    fn on_command(&mut self, now: Instant, side: Side, command: &EgmCommand) {
        // First everything this command comes too late for.
        self.advance(now);
        // A refusal is counted by the controller and told by the next cycle's events.
        let _told_later = self.controllers[side.index()].receive(now, command);
        self.command_received.send(EgmArrival {
            at_ns: now.as_ns(),
            side: side.number(),
            reserved: 0,
            command: *command,
        });
    }

    fn on_request(&mut self, now: Instant, request: &MotionRequest) {
        self.advance(now);
        if let Some(response) = self.server.receive(request, &self.controllers) {
            self.response.send(response);
        }
        self.request_received.send(MotionArrival {
            at_ns: now.as_ns(),
            request: *request,
        });
    }

    /// A late robot reports its newest cycle only; its period counts those it passed over.
    fn on_tick(&mut self, now: Instant, _tick: Tick) {
        self.advance(now);
        for side in Side::BOTH {
            let index = side.index();
            let controller = &self.controllers[index];
            let tool = self.arms[index].tool(controller.measured_rad());
            self.feedback[index].send(controller.feedback(&tool.into()));
        }
    }
}

impl Robot {
    pub(crate) fn into_role(self) -> Box<dyn Role> {
        let period = self.period;
        Component::of(self)
            .input(EGM_RIGHT_COMMAND, |own, now, command| {
                own.on_command(now, Side::Right, command);
            })
            .input(EGM_LEFT_COMMAND, |own, now, command| {
                own.on_command(now, Side::Left, command);
            })
            .input(MOTION_REQUEST, Self::on_request)
            .output(EGM_RIGHT_FEEDBACK, |own| &mut own.feedback[0])
            .output(EGM_LEFT_FEEDBACK, |own| &mut own.feedback[1])
            .output(MOTION_RESPONSE, |own| &mut own.response)
            .output(EGM_EVENT, |own| &mut own.event)
            .output(EGM_RECEIVED, |own| &mut own.command_received)
            .output(MOTION_RECEIVED, |own| &mut own.request_received)
            .every(period, Self::on_tick)
            .start(|own, now| (own.started, own.next_cycle) = (Some(now), 0))
            .into_role()
    }
}

#[cfg(test)]
#[path = "robot_tests.rs"]
mod tests;
