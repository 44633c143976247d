//! The robot's motion server: takes requests, answers them, and starts what they ask for. It moves
//! no joint: the arms' controllers do.
//!
//! One request is taken per cycle, in order of arrival, and is carried out whole or not at all:
//! everything that can be refused is refused before the first arm is told.

use core::time::Duration;
use std::collections::VecDeque;

use nalgebra::Isometry3;

use hil_arm::egm::controller::Controller;
use hil_arm::egm::controller::motion::{JointMotion, SPEED_RATIO_DEFAULT, home_rad};
use hil_arm::egm::messages::{
    EgmStartParameters, MotionKind, MotionOutcome, MotionRefusal, MotionRequest, MotionResponse,
    SessionState, Side,
};
use hil_arm::yumi::Joints;
use hil_arm::yumi::arm::{Arm, within_limits};
use hil_arm::yumi::inverse::{Reach, Tracker};

/// Requests that may wait for their cycle; further ones are refused at once, as busy.
const WAITING_MAX: usize = 64;

/// Requests that may be under way. Only stops can pile up: an arm does one other thing at a time.
const JOBS_MAX: usize = 16;

/// Speed of a linear motion that names none, metres per second.
const LINEAR_SPEED_M_PER_S: f64 = 0.1;

/// Points of the longest linear motion, 20 s in cycles of 4 ms: all are computed in the cycle that
/// takes the request, which a longer one would hold up for too long. It is refused as a bad number,
/// as its speed is too low for its way.
const LINEAR_POINTS_MAX: f64 = 5000.0;

/// The server.
#[derive(Debug)]
pub(crate) struct MotionServer {
    arms: [Arm; 2],
    cycle_s: f64,
    waiting: VecDeque<MotionRequest>,
    jobs: Vec<Job>,
    answers: Vec<Answer>,
}

/// A request under way.
#[derive(Debug, Clone, Copy)]
struct Job {
    request_id: u64,
    kind: MotionKind,
    arms: u32,
}

/// A response but for the state it reports, which is that after the cycle.
#[derive(Debug, Clone, Copy)]
struct Answer {
    request_id: u64,
    kind: u32,
    outcome: MotionOutcome,
    refusal: Option<Refusal>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Refusal {
    why: MotionRefusal,
    side: Side,
}

/// What an arm is told.
#[derive(Debug)]
enum Order {
    Start(EgmStartParameters),
    Stop,
    Move(MotionKind, Vec<Joints>),
}

impl MotionServer {
    /// A server for `arms`, right then left, that plans for controllers of the cycle `cycle`.
    pub(crate) fn new(arms: [Arm; 2], cycle: Duration) -> Self {
        Self {
            arms,
            cycle_s: cycle.as_secs_f64(),
            waiting: VecDeque::with_capacity(WAITING_MAX),
            jobs: Vec::with_capacity(JOBS_MAX),
            answers: Vec::with_capacity(1 + JOBS_MAX),
        }
    }

    /// Takes note of a request for the next cycle; the refusal, to be given at once, when too many
    /// wait already.
    pub(crate) fn receive(
        &mut self,
        request: &MotionRequest,
        controllers: &[Controller; 2],
    ) -> Option<MotionResponse> {
        if self.waiting.len() < WAITING_MAX {
            self.waiting.push_back(*request);
            return None;
        }
        let refusal = Refusal {
            why: MotionRefusal::Busy,
            side: Side::Right,
        };
        Some(Answer::refused(request, refusal).response(controllers))
    }

    /// Carries out the oldest waiting request, if any. Call before the arms' cycle.
    pub(crate) fn take_request(&mut self, controllers: &mut [Controller; 2]) {
        let Some(request) = self.waiting.pop_front() else {
            return;
        };
        let Some(kind) = MotionKind::from_number(request.kind) else {
            let refusal = Refusal {
                why: MotionRefusal::UnknownKind,
                side: Side::Right,
            };
            return self.refuse(&request, refusal);
        };
        if kind == MotionKind::GetState {
            return self.answer_with(&request, MotionOutcome::Done);
        }
        match self.carry_out(kind, &request, controllers) {
            Ok(()) => {
                self.jobs.push(Job {
                    request_id: request.request_id,
                    kind,
                    arms: request.arms,
                });
                self.answer_with(&request, MotionOutcome::Accepted);
            }
            Err(refusal) => self.refuse(&request, refusal),
        }
    }

    /// Gives the responses due after a cycle: what it took or refused, and what came to its end.
    pub(crate) fn answer(
        &mut self,
        controllers: &[Controller; 2],
        give: &mut dyn FnMut(MotionResponse),
    ) {
        if self.answers.is_empty() && self.jobs.is_empty() {
            return;
        }
        let states = [controllers[0].state(), controllers[1].state()];
        let answers = &mut self.answers;
        self.jobs.retain(|job| {
            let outcome = job.outcome(states);
            answers.extend(outcome.map(|outcome| Answer {
                request_id: job.request_id,
                kind: job.kind as u32,
                outcome,
                refusal: None,
            }));
            outcome.is_none()
        });
        for answer in answers.drain(..) {
            give(answer.response(controllers));
        }
    }

    fn answer_with(&mut self, request: &MotionRequest, outcome: MotionOutcome) {
        self.answers.push(Answer {
            request_id: request.request_id,
            kind: request.kind,
            outcome,
            refusal: None,
        });
    }

    fn refuse(&mut self, request: &MotionRequest, refusal: Refusal) {
        self.answers.push(Answer::refused(request, refusal));
    }

    fn carry_out(
        &self,
        kind: MotionKind,
        request: &MotionRequest,
        controllers: &mut [Controller; 2],
    ) -> Result<(), Refusal> {
        let no_arm = |side| Refusal {
            why: MotionRefusal::NoArm,
            side,
        };
        let all = MotionRequest::bit(Side::Right) | MotionRequest::bit(Side::Left);
        if request.arms == 0 || request.arms & !all != 0 {
            return Err(no_arm(Side::Right));
        }
        let sides: Vec<Side> = asked(request.arms).collect();
        if self.jobs.len() >= JOBS_MAX {
            let why = MotionRefusal::Busy;
            return Err(Refusal {
                why,
                side: sides[0],
            });
        }
        for &side in &sides {
            must_be_free(kind, controllers[side.index()].state())
                .map_err(|why| Refusal { why, side })?;
        }
        let moves = |paths: Vec<Vec<Joints>>| -> Vec<Order> {
            let moves = paths.into_iter().map(|path| Order::Move(kind, path));
            moves.collect()
        };
        let orders = match kind {
            MotionKind::GetState => Vec::new(),
            MotionKind::EgmStart => sides.iter().map(|_| Order::Start(request.egm)).collect(),
            MotionKind::EgmStop => sides.iter().map(|_| Order::Stop).collect(),
            MotionKind::MoveJoints => {
                moves(self.joint_paths(request, &request.joints_rad, controllers)?)
            }
            MotionKind::Home => {
                moves(self.joint_paths(request, &Side::BOTH.map(home_rad), controllers)?)
            }
            MotionKind::MoveLinear => moves(self.linear_paths(request, controllers)?),
        };
        let orders: Vec<_> = sides.into_iter().zip(orders).collect();
        // An arm may still refuse, e.g. because it is not yet at rest. So that one does not move
        // without the other, all are asked before any is told.
        for (side, order) in &orders {
            would_take(&controllers[side.index()], order)
                .map_err(|why| Refusal { why, side: *side })?;
        }
        for (side, order) in orders {
            give(&mut controllers[side.index()], order).map_err(|why| Refusal { why, side })?;
        }
        Ok(())
    }

    /// A path per asked arm, all of one length in time.
    fn joint_paths(
        &self,
        request: &MotionRequest,
        targets_rad: &[Joints; 2],
        controllers: &[Controller; 2],
    ) -> Result<Vec<Vec<Joints>>, Refusal> {
        let mut motions = Vec::new();
        for side in asked(request.arms) {
            let refused = |why| Refusal { why, side };
            let goal_rad = &targets_rad[side.index()];
            if !goal_rad.iter().all(|q| q.is_finite()) {
                return Err(refused(MotionRefusal::BadNumber));
            }
            if within_limits(&(*goal_rad).into()).1 {
                return Err(refused(MotionRefusal::OutsideLimits));
            }
            let speed_ratio = chosen(request.speed, SPEED_RATIO_DEFAULT, 0.01..=1.0)
                .ok_or(refused(MotionRefusal::BadNumber))?;
            let from_rad = controllers[side.index()].planned_rad();
            motions.push(JointMotion::new(from_rad, goal_rad, speed_ratio));
        }
        let longest_s = motions
            .iter()
            .map(JointMotion::duration_s)
            .fold(0.0, f64::max);
        let path = |motion| joint_path(motion, longest_s, self.cycle_s);
        Ok(motions.iter().map(path).collect())
    }

    /// A path per asked arm, all of one length in time.
    fn linear_paths(
        &self,
        request: &MotionRequest,
        controllers: &[Controller; 2],
    ) -> Result<Vec<Vec<Joints>>, Refusal> {
        let mut lines = Vec::new();
        let mut duration_s = 0.0_f64;
        for side in asked(request.arms) {
            let refused = |why| Refusal { why, side };
            let target = request.poses[side.index()]
                .isometry()
                .ok_or(refused(MotionRefusal::BadNumber))?;
            let speed_m_per_s = chosen(request.speed, LINEAR_SPEED_M_PER_S, 0.01..=1.5)
                .ok_or(refused(MotionRefusal::BadNumber))?;
            let from_rad = *controllers[side.index()].planned_rad();
            let arm = &self.arms[side.index()];
            let own_s = linear_duration_s(arm, &from_rad, &target, speed_m_per_s)
                .ok_or(refused(MotionRefusal::Unreachable))?;
            if own_s > LINEAR_POINTS_MAX * self.cycle_s {
                return Err(refused(MotionRefusal::BadNumber));
            }
            duration_s = duration_s.max(own_s);
            lines.push((side, from_rad, target));
        }
        lines
            .iter()
            .map(|(side, from_rad, target)| {
                let arm = &self.arms[side.index()];
                let why = MotionRefusal::Unreachable;
                linear_path(arm, from_rad, target, duration_s, self.cycle_s)
                    .ok_or(Refusal { why, side: *side })
            })
            .collect()
    }
}

impl Answer {
    fn refused(request: &MotionRequest, refusal: Refusal) -> Self {
        Self {
            request_id: request.request_id,
            kind: request.kind,
            outcome: MotionOutcome::Refused,
            refusal: Some(refusal),
        }
    }

    /// With where the arms are now.
    fn response(&self, controllers: &[Controller; 2]) -> MotionResponse {
        let refused_side = self.refusal.map_or(Side::Right, |refusal| refusal.side);
        MotionResponse {
            request_id: self.request_id,
            kind: self.kind,
            outcome: self.outcome as u32,
            refusal: self.refusal.map_or(0, |refusal| refusal.why as u32),
            refused_side: refused_side.number(),
            states: controllers.each_ref().map(|arm| arm.state() as u32),
            measured_rad: controllers.each_ref().map(|arm| *arm.measured_rad()),
        }
    }
}

impl Job {
    /// How the request ended, given the arms' states; `None` while it is under way.
    fn outcome(&self, states: [SessionState; 2]) -> Option<MotionOutcome> {
        let mut sides = asked(self.arms).map(|side| states[side.index()]);
        match self.kind {
            MotionKind::EgmStart => {
                let is_stopped =
                    |state| matches!(state, SessionState::Idle | SessionState::Stopping);
                if sides.clone().any(is_stopped) {
                    return Some(MotionOutcome::Interrupted);
                }
                sides
                    .all(|state| state == SessionState::Running)
                    .then_some(MotionOutcome::Done)
            }
            MotionKind::EgmStop => sides
                .all(|state| state == SessionState::Idle)
                .then_some(MotionOutcome::Done),
            MotionKind::GetState
            | MotionKind::MoveJoints
            | MotionKind::MoveLinear
            | MotionKind::Home => sides
                .all(|state| state != SessionState::Moving)
                .then_some(MotionOutcome::Done),
        }
    }
}

fn would_take(controller: &Controller, order: &Order) -> Result<(), MotionRefusal> {
    match order {
        Order::Start(parameters) => controller.can_start(parameters),
        Order::Stop => Ok(()),
        Order::Move(_, path) => controller.can_move(path),
    }
}

fn give(controller: &mut Controller, order: Order) -> Result<(), MotionRefusal> {
    match order {
        Order::Start(parameters) => controller.start_guided_motion(&parameters),
        Order::Stop => {
            controller.stop_guided_motion();
            Ok(())
        }
        Order::Move(kind, path) => controller.move_along(kind, path),
    }
}

/// The asked arms, right first.
fn asked(arms: u32) -> impl Iterator<Item = Side> + Clone {
    Side::BOTH
        .into_iter()
        .filter(move |side| arms & MotionRequest::bit(*side) != 0)
}

/// `asked`, or `default` when it is zero; `None` outside `allowed`.
fn chosen(asked: f64, default: f64, allowed: core::ops::RangeInclusive<f64>) -> Option<f64> {
    let speed = if asked == 0.0 { default } else { asked };
    allowed.contains(&speed).then_some(speed)
}

/// Whether an arm in `state` can do `kind`. Stopping needs nothing.
fn must_be_free(kind: MotionKind, state: SessionState) -> Result<(), MotionRefusal> {
    let is_start = kind == MotionKind::EgmStart;
    match state {
        _ if kind == MotionKind::EgmStop => Ok(()),
        SessionState::Idle => Ok(()),
        SessionState::Moving => Err(MotionRefusal::Busy),
        SessionState::Stopping if is_start => Err(MotionRefusal::Busy),
        SessionState::Waiting
        | SessionState::Activating
        | SessionState::Running
        | SessionState::Stopping => Err(MotionRefusal::GuidedMotionRuns),
    }
}

/// How fast a linear motion may turn the tool; ours, the maker has its own by speed class.
const TURN_MAX_RAD_PER_S: f64 = 0.5;

/// No target farther from the tool than this lies within any arm's reach.
const DISTANCE_MAX_M: f64 = 2.0;

/// The points of `motion`, drawn out to `duration_s`, one cycle apart; the first is one cycle after
/// its start. A duration shorter than the motion's own counts as that.
pub(crate) fn joint_path(motion: &JointMotion, duration_s: f64, cycle_s: f64) -> Vec<Joints> {
    let duration_s = duration_s.max(motion.duration_s());
    let count = step_count(duration_s, cycle_s);
    // In the motion's own time: drawn out, every joint is slower by one ratio.
    let step_s = motion.duration_s() / f64::from(count);
    (1..=count)
        .map(|step| motion.at(f64::from(step) * step_s))
        .collect()
}

/// How long a straight line takes at `speed_m_per_s`, or turning on the spot; `None` when the
/// target is beyond any reach.
pub(crate) fn linear_duration_s(
    arm: &Arm,
    from_rad: &Joints,
    target: &Isometry3<f64>,
    speed_m_per_s: f64,
) -> Option<f64> {
    let tool = arm.tool(from_rad);
    let distance_m = (target.translation.vector - tool.translation.vector).norm();
    let turn_rad = tool.rotation.angle_to(&target.rotation);
    let duration_s = (distance_m / speed_m_per_s).max(turn_rad / TURN_MAX_RAD_PER_S);
    (distance_m <= DISTANCE_MAX_M).then_some(duration_s)
}

/// A straight line of the tool at constant speed to `target` (body frame) in `duration_s`; `None`
/// when some point of it is out of reach, or needs a joint beyond its position or speed limit.
pub(crate) fn linear_path(
    arm: &Arm,
    from_rad: &Joints,
    target: &Isometry3<f64>,
    duration_s: f64,
    cycle_s: f64,
) -> Option<Vec<Joints>> {
    let tool = arm.tool(from_rad);
    let mut tracker = Tracker::new(*arm.chain(), *from_rad);
    let count = step_count(duration_s, cycle_s);
    (1..=count)
        .map(|step| {
            let point = tool.lerp_slerp(target, f64::from(step) / f64::from(count));
            let reach = tracker.track(&arm.from_body(&point), cycle_s);
            (reach == Reach::Reached).then(|| *tracker.q_rad())
        })
        .collect()
}

/// At least one: a motion of no length still is one.
fn step_count(duration_s: f64, cycle_s: f64) -> u32 {
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "saturating; the callers bound the duration to minutes"
    )]
    let count = (duration_s / cycle_s).ceil() as u32;
    count.max(1)
}

#[cfg(test)]
mod motion_path_tests {
    use super::*;
    use hil_arm::yumi::arm::{RIGHT_START_RAD, SPEED_MAX_RAD_PER_S};

    const CYCLE_S: f64 = 0.004;

    #[test]
    fn a_joint_motion_drawn_out_is_slower_and_ends_where_it_shall() {
        let mut to = RIGHT_START_RAD;
        to[0] -= 0.8;
        to[6] += 1.0;
        let motion = JointMotion::new(&RIGHT_START_RAD, &to, 0.25);
        let own = joint_path(&motion, 0.0, CYCLE_S);
        let drawn_out = joint_path(&motion, 3.0 * motion.duration_s(), CYCLE_S);
        let fastest = |path: &[Joints]| {
            let steps = path.windows(2).map(|pair| (pair[1][0] - pair[0][0]).abs());
            steps.fold(0.0, f64::max) / CYCLE_S / SPEED_MAX_RAD_PER_S[0]
        };
        assert!((fastest(&own) - 0.25).abs() < 0.01, "{}", fastest(&own));
        assert!((3.0 * fastest(&drawn_out) - 0.25).abs() < 0.01);
        for path in [own, drawn_out] {
            let end = path.last().unwrap();
            assert!(end.iter().zip(&to).all(|(q, to)| (q - to).abs() < 1e-12));
        }
    }

    #[test]
    fn a_line_is_straight_of_constant_speed_and_ends_on_its_target() {
        let arm = Arm::right();
        let tool = arm.tool(&RIGHT_START_RAD);
        let target = Isometry3::translation(0.0, 0.1, 0.05) * tool;
        let duration_s = linear_duration_s(&arm, &RIGHT_START_RAD, &target, 0.1).unwrap();
        let path = linear_path(&arm, &RIGHT_START_RAD, &target, duration_s, CYCLE_S).unwrap();
        let way = target.translation.vector - tool.translation.vector;
        let step_m = way.norm() / path.len() as f64;
        for (index, q_rad) in path.iter().enumerate() {
            let moved = arm.tool(q_rad).translation.vector - tool.translation.vector;
            let along = moved.dot(&way.normalize());
            assert!((moved - along * way.normalize()).norm() < 1e-5);
            assert!((along - step_m * (index + 1) as f64).abs() < 1e-5);
        }
    }

    #[test]
    fn a_line_out_of_reach_or_too_fast_has_no_path() {
        let arm = Arm::right();
        let tool = arm.tool(&RIGHT_START_RAD);
        let far = Isometry3::translation(0.6, 0.0, 0.0) * tool;
        assert_eq!(
            linear_path(&arm, &RIGHT_START_RAD, &far, 6.0, CYCLE_S),
            None
        );
        let near = Isometry3::translation(0.0, 0.1, 0.0) * tool;
        assert_eq!(
            linear_path(&arm, &RIGHT_START_RAD, &near, 0.02, CYCLE_S),
            None
        );
        let beyond = Isometry3::translation(1e5, 0.0, 0.0);
        assert_eq!(
            linear_duration_s(&arm, &RIGHT_START_RAD, &beyond, 0.1),
            None
        );
    }
}
