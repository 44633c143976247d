//! The simulated controller of one arm's motion task: commands in, joints out, once a cycle. It owns
//! no clock, no socket and no thread: whoever drives it says when a command arrived and which
//! point of the cycle grid is due, so real and virtual time give the same joints.
//!
//! One cycle at the grid time T does, in this order: move by the reference in use; check whether
//! the session must end; say where the joints are; take from the queue what arrived before T. So a
//! command acts from the cycle after the one that took it, and `control_delay_cycles` later in
//! the measured joints (ABB: a new position starts to act after about 20 ms).
//!
//! Read `law` (the control law), `inbox` (from arrival to reference), `session` (what starts and
//! ends), `watch` (what is checked while it runs), [`motion`] (moves without a client) and
//! `describe` (events in words).
//!
//! Everything about a command is decided at its grid point, not when it is handed over: a driver
//! that comes late and hands over the arrivals of many cycles before going through these cycles
//! gets the joints that a punctual driver gets.

mod describe;
mod inbox;
mod law;
pub mod motion;
mod session;
mod watch;

#[cfg(test)]
mod tests;

use crate::egm::controller::inbox::Inbox;
use crate::egm::controller::law::{Delay, Law, Plan, Reference};
use crate::egm::controller::session::{OwnMotion, Phase, Request, Session};
use crate::egm::controller::watch::{HoldWatch, Limits, ThrottleWatch};
use crate::egm::messages::{
    CommandRefusal, EgmCommand, EgmEvent, EgmEventKind, EgmFeedback, EgmStartParameters,
    MotionKind, MotionRefusal, SessionState, Side,
};
use crate::egm::parameters::{ControllerSettings, StartMode};
use crate::yumi::arm::{POSITION_MAX_RAD, POSITION_MIN_RAD};
use crate::yumi::{Joints, Pose};
use hil_core::time::Instant;

pub use crate::egm::controller::inbox::{CommandCounters, LIMIT_TOLERANCE_RAD};
pub(crate) use crate::egm::controller::law::DELAY_CYCLES_MAX;
pub use crate::egm::controller::watch::HOLD_AFTER_NS;

/// One arm's controller.
#[derive(Debug, Clone)]
pub struct Controller {
    side: Side,
    /// The controller's own settings; a session's are in the fields below.
    settings: ControllerSettings,
    at: Instant,
    cycle_index: u64,
    has_begun: bool,
    plan: Plan,
    delay: Delay,
    law: Law,
    limits: Limits,
    reference: Reference,
    has_reference: bool,
    inbox: Inbox,
    has_overflowed: bool,
    last_refusal: Option<CommandRefusal>,
    session: Session,
    request: Option<Request>,
    own_motion: Option<OwnMotion>,
    throttle: ThrottleWatch,
    hold: HoldWatch,
    /// Flags of the feedback that belong to one cycle.
    cycle_flags: u32,
}

impl Controller {
    /// At rest at `q_rad`, without a session.
    pub fn new(side: Side, settings: ControllerSettings, q_rad: Joints) -> Self {
        Self {
            side,
            settings,
            at: Instant::ZERO,
            cycle_index: 0,
            has_begun: false,
            plan: Plan::standing(q_rad),
            delay: Delay::new(settings.control_delay_cycles, &q_rad),
            law: Law::new(&settings),
            limits: Limits::new(&settings),
            reference: Reference::standing(&q_rad, Instant::ZERO),
            has_reference: false,
            inbox: Inbox::new(settings.queue, settings.queue_capacity),
            has_overflowed: false,
            last_refusal: None,
            session: Session::none(settings, q_rad),
            request: None,
            own_motion: None,
            throttle: ThrottleWatch::default(),
            hold: HoldWatch::default(),
            cycle_flags: 0,
        }
    }

    /// Takes a command that arrived at `at`; calls come in non-decreasing `at`, and before the
    /// first cycle whose grid time is later than `at`. That cycle uses it, or a later one, as the
    /// queue has it.
    ///
    /// # Errors
    /// Why it will never reach the servo; it is counted and told by the next cycle's events.
    /// [`CommandRefusal::NoSession`] is not among them: whether a session runs when the command
    /// is due, its grid point decides, and tells by an event.
    pub fn receive(&mut self, at: Instant, command: &EgmCommand) -> Result<(), CommandRefusal> {
        self.inbox.receive(at, command)
    }

    /// Starts guided motion with `parameters` from the next cycle on. They hold until a request
    /// starts it anew: sessions that the restart policy starts have them as well.
    ///
    /// # Errors
    /// When a parameter is outside its range or the arm is busy.
    pub fn start_guided_motion(
        &mut self,
        parameters: &EgmStartParameters,
    ) -> Result<(), MotionRefusal> {
        let settings = self.start_settings(parameters)?;
        self.request = Some(Request::Start(Box::new(settings)));
        Ok(())
    }

    /// Whether [`Controller::start_guided_motion`] would be taken now.
    ///
    /// # Errors
    /// What that would refuse it with.
    pub fn can_start(&self, parameters: &EgmStartParameters) -> Result<(), MotionRefusal> {
        self.start_settings(parameters).map(|_| ())
    }

    fn start_settings(
        &self,
        parameters: &EgmStartParameters,
    ) -> Result<ControllerSettings, MotionRefusal> {
        self.must_be_idle()?;
        self.settings.with(parameters)
    }

    fn must_be_idle(&self) -> Result<(), MotionRefusal> {
        match self.state() {
            SessionState::Idle if self.request.is_none() => Ok(()),
            SessionState::Activating | SessionState::Running => {
                Err(MotionRefusal::GuidedMotionRuns)
            }
            _ => Err(MotionRefusal::Busy),
        }
    }

    /// Stops guided motion by the stop mode, from the next cycle on, and what a restart policy
    /// would do; nothing to do without either.
    pub fn stop_guided_motion(&mut self) {
        self.request = match self.request.take() {
            Some(Request::Start(_)) => None,
            Some(Request::Move { kind, points }) => Some(Request::Move { kind, points }),
            Some(Request::Stop) | None => Some(Request::Stop),
        };
    }

    /// Moves along `path`, joint positions one cycle apart, from the next cycle on; `kind` is
    /// what asked for it. The path should begin at [`Controller::planned_rad`].
    ///
    /// # Errors
    /// When the arm is busy or not yet at rest, or a point is no number or outside the joints'
    /// limits.
    pub fn move_along(&mut self, kind: MotionKind, path: Vec<Joints>) -> Result<(), MotionRefusal> {
        self.can_move(&path)?;
        self.request = Some(Request::Move { kind, points: path });
        Ok(())
    }

    /// Whether [`Controller::move_along`] would be taken now.
    ///
    /// # Errors
    /// What that would refuse it with.
    pub fn can_move(&self, path: &[Joints]) -> Result<(), MotionRefusal> {
        self.must_be_idle()?;
        if !self.plan.is_at_rest() {
            return Err(MotionRefusal::Busy);
        }
        if !path.iter().flatten().all(|q| q.is_finite()) {
            return Err(MotionRefusal::BadNumber);
        }
        let is_inside = |point: &Joints| {
            let limits = POSITION_MIN_RAD.iter().zip(&POSITION_MAX_RAD);
            point.iter().zip(limits).all(|(q, (min, max))| {
                (min - LIMIT_TOLERANCE_RAD..=max + LIMIT_TOLERANCE_RAD).contains(q)
            })
        };
        if !path.iter().all(is_inside) {
            return Err(MotionRefusal::OutsideLimits);
        }
        Ok(())
    }

    /// Goes through the cycle due at the grid time `at`: moves by the reference in use, then takes
    /// the next command that had arrived before `at`. Tells what happened.
    ///
    /// Grid times follow each other by the nominal cycle, which is what is integrated; the first
    /// is the origin, at which nothing moves yet.
    pub fn cycle(&mut self, at: Instant, tell: &mut dyn FnMut(EgmEvent)) {
        self.at = at;
        self.cycle_flags = 0;
        if self.has_begun {
            self.cycle_index += 1;
            self.session.cycle_count += 1;
        } else {
            self.begin(tell);
        }
        self.settle_arrivals(tell);
        if self.request.is_some() {
            self.apply_request(tell);
        }
        match self.session.phase {
            Phase::Running => self.run(tell),
            Phase::Idle => self.plan.coast(&self.law),
            _ => self.go_on(tell),
        }
        self.delay.push(self.plan.q_rad());
        self.take_command(tell);
    }

    fn begin(&mut self, tell: &mut dyn FnMut(EgmEvent)) {
        self.has_begun = true;
        self.session.ended_at = self.at;
        tell(self.event(EgmEventKind::Started));
        let is_own_start =
            self.settings.start == StartMode::PowerOn && self.settings.arms.include(self.side);
        if is_own_start && self.request.is_none() {
            self.request = Some(Request::Start(Box::new(self.settings)));
        }
    }

    /// The feedback of the last cycle; `tool` is where the kinematics puts the tool for
    /// [`Controller::measured_rad`].
    pub fn feedback(&self, tool: &Pose) -> EgmFeedback {
        let reference_since = if self.has_reference {
            self.reference.arrived_at
        } else {
            self.session.since
        };
        EgmFeedback {
            cycle_index: self.cycle_index,
            reference_frame_index: self.reference.frame_index,
            reference_age_ns: self.at.ns_since(reference_since),
            measured_rad: *self.measured_rad(),
            planned_rad: *self.planned_rad(),
            tool: *tool,
            clock_ms: clock_ms(self.at),
            seqno: wrapped(self.session.cycle_count),
            session: self.session.number,
            state: self.state() as u32,
            queue_count: wrapped(self.inbox.queued() as u64),
            flags: self.cycle_flags
                | flag(self.has_reference, EgmFeedback::HAS_REFERENCE)
                | flag(self.hold.is_holding, EgmFeedback::HOLDING)
                | flag(self.plan.is_at_limit, EgmFeedback::AT_POSITION_LIMIT),
        }
    }

    /// True when `MaxSpeedDeviation` bound in the last cycle.
    pub fn is_throttled(&self) -> bool {
        self.cycle_flags & EgmFeedback::SPEED_DEVIATION_LIMITED != 0
    }

    /// Joint positions as measured in the last cycle.
    pub fn measured_rad(&self) -> &Joints {
        self.delay.measured_rad()
    }

    /// Joint positions as planned in the last cycle, ahead of the measured ones.
    pub fn planned_rad(&self) -> &Joints {
        self.plan.q_rad()
    }

    /// What the motion task did in the last cycle; a request shows with the next.
    pub fn state(&self) -> SessionState {
        self.session.phase.state()
    }

    /// What became of the commands.
    pub fn command_counters(&self) -> &CommandCounters {
        self.inbox.counters()
    }

    /// An event of this cycle, without its numbers.
    fn event(&self, kind: EgmEventKind) -> EgmEvent {
        EgmEvent {
            at_ns: self.at.as_ns(),
            cycle_index: self.cycle_index,
            value: 0.0,
            limit: 0.0,
            count: 0,
            kind: kind as u32,
            side: wrapped(self.side.index() as u64),
            session: self.session.number,
            cause: 0,
        }
    }
}

const fn flag(is_set: bool, bit: u32) -> u32 {
    if is_set { bit } else { 0 }
}

#[allow(
    clippy::cast_possible_truncation,
    reason = "counters of the protocol wrap"
)]
fn wrapped(count: u64) -> u32 {
    count as u32
}

/// The protocol's clock.
fn clock_ms(at: Instant) -> u32 {
    wrapped(at.as_ns().div_euclid(1_000_000).cast_unsigned())
}
