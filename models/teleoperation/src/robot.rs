//! The role "robot": two arms, each a controller of guided motion, and the motion server, all in
//! one cycle. It computes no control law itself: see [`hil_arm::egm::controller`].
//!
//! The cycle lies on an absolute grid. What arrived at `a` can act from the first grid point
//! *later* than `a`; a call that comes late goes through every grid point in between, each with
//! what had arrived before it. So the joints follow from start, settings and arrivals alone, and
//! those are what the robot writes to the record.

use core::time::Duration;

use crate::motion_server::MotionServer;
use hil_arm::egm::controller::Controller;
use hil_arm::egm::messages::{
    EgmArrival, EgmCommand, EgmEvent, EgmFeedback, MotionArrival, MotionRequest, MotionResponse,
    Side,
};
use hil_arm::egm::parameters::ControllerSettings;
use hil_arm::yumi::Joints;
use hil_arm::yumi::arm::{Arm, LEFT_START_RAD, RIGHT_START_RAD};
use hil_core::component::{Component, Outbox};
use hil_core::time::{Instant, PeriodicTimer, duration_ns};

/// Where the arms are at the robot's start, right then left.
const START_RAD: [Joints; 2] = [RIGHT_START_RAD, LEFT_START_RAD];

/// The arms' kinematics, right then left.
pub(crate) fn arms() -> [Arm; 2] {
    [Arm::right(), Arm::left()]
}

hil_core::message_set! {
    /// What the robot hears, in channel order.
    pub(crate) enum RobotInput {
        RightCommand(EgmCommand),
        LeftCommand(EgmCommand),
        Request(MotionRequest),
    }
}

hil_core::message_set! {
    /// What the robot says, in channel order.
    pub(crate) enum RobotOutput {
        RightFeedback(EgmFeedback),
        LeftFeedback(EgmFeedback),
        Response(MotionResponse),
        Event(EgmEvent),
        CommandArrived(EgmArrival),
        RequestArrived(MotionArrival),
    }
}

/// The role.
#[derive(Debug)]
pub(crate) struct Robot {
    timer: PeriodicTimer,
    period: Duration,
    started: Option<Instant>,
    /// The next grid point to go through.
    next_cycle: u64,
    arms: [Arm; 2],
    controllers: [Controller; 2],
    server: MotionServer,
}

impl Robot {
    /// A robot at rest in its start posture.
    pub(crate) fn new(settings: ControllerSettings) -> Self {
        let controller = |side: Side| Controller::new(side, settings, START_RAD[side.index()]);
        Self {
            timer: PeriodicTimer::new(settings.cycle),
            period: settings.cycle,
            started: None,
            next_cycle: 0,
            arms: arms(),
            controllers: Side::BOTH.map(controller),
            server: MotionServer::new(arms(), settings.cycle),
        }
    }

    fn grid_point(&self, start: Instant, index: u64) -> Instant {
        let steps = i64::try_from(index).unwrap_or(i64::MAX);
        let since_ns = duration_ns(self.period).saturating_mul(steps);
        Instant::from_ns(start.as_ns().saturating_add(since_ns))
    }

    /// Goes through every grid point up to and including `now`.
    fn advance(&mut self, now: Instant, out: &mut Outbox<RobotOutput>) {
        let Some(start) = self.started else { return };
        loop {
            let at = self.grid_point(start, self.next_cycle);
            if at > now {
                break;
            }
            self.next_cycle += 1;
            self.server.take_request(&mut self.controllers);
            for controller in &mut self.controllers {
                controller.cycle(at, &mut |event| out.send(RobotOutput::Event(event)));
            }
            self.server.answer(&self.controllers, &mut |response| {
                out.send(RobotOutput::Response(response));
            });
        }
    }

    fn receive(&mut self, now: Instant, side: Side, command: &EgmCommand) -> RobotOutput {
        // A refusal is counted by the controller and told by the next cycle's events.
        let _told_later = self.controllers[side.index()].receive(now, command);
        RobotOutput::CommandArrived(EgmArrival {
            at_ns: now.as_ns(),
            side: side.number(),
            reserved: 0,
            command: *command,
        })
    }

    fn feedback(&self, side: Side) -> EgmFeedback {
        let controller = &self.controllers[side.index()];
        let tool = self.arms[side.index()].tool(controller.measured_rad());
        controller.feedback(&tool.into())
    }
}

impl Component for Robot {
    type Input = RobotInput;
    type Output = RobotOutput;

    fn on_start(&mut self, now: Instant) {
        self.timer.start(now);
        self.started = Some(now);
        self.next_cycle = 0;
    }

    fn on_message(&mut self, now: Instant, input: &RobotInput, out: &mut Outbox<RobotOutput>) {
        // First everything this message comes too late for.
        self.advance(now, out);
        let arrival = match input {
            RobotInput::RightCommand(command) => self.receive(now, Side::Right, command),
            RobotInput::LeftCommand(command) => self.receive(now, Side::Left, command),
            RobotInput::Request(request) => {
                let refused = self.server.receive(request, &self.controllers);
                if let Some(response) = refused {
                    out.send(RobotOutput::Response(response));
                }
                RobotOutput::RequestArrived(MotionArrival {
                    at_ns: now.as_ns(),
                    request: *request,
                })
            }
        };
        out.send(arrival);
    }

    fn on_tick(&mut self, now: Instant, out: &mut Outbox<RobotOutput>) {
        self.advance(now, out);
        // A late robot reports its newest cycle only; the timer counts those it passed over.
        if self.timer.poll(now).is_some() {
            out.send(RobotOutput::RightFeedback(self.feedback(Side::Right)));
            out.send(RobotOutput::LeftFeedback(self.feedback(Side::Left)));
        }
    }

    fn next_tick(&self) -> Option<Instant> {
        self.timer.next()
    }

    fn skipped_ticks(&self) -> u64 {
        self.timer.skipped_total()
    }
}

#[cfg(test)]
#[path = "robot_tests.rs"]
mod tests;
