//! A session: its states, the restart policies, the motions of the controller's own, the limits that
//! end it, and the states worth an event (refusing, overflowing, throttled, holding). It computes no
//! motion of a session.

use core::time::Duration;

use crate::egm::controller::inbox::{Fate, Fault};
use crate::egm::controller::law::Binding;
use crate::egm::controller::motion::{JointMotion, SPEED_RATIO_DEFAULT, Track, home_rad};
use crate::egm::controller::{Controller, Law, Reference};
use crate::egm::messages::{
    EgmEvent, EgmEventKind, EgmFeedback, EndCause, MotionKind, SessionState,
};
use crate::egm::parameters::{ControllerSettings, RestartPolicy, StopMode};
use crate::yumi::{JOINT_COUNT, Joints};
use hil_core::time::{Instant, duration_ns};

/// A running session that took no command for longer than this holds: five periods of a 125 Hz
/// sender.
pub const HOLD_AFTER_NS: i64 = 40_000_000;

/// `MaxSpeedDeviation` must not bind for so long before it counts as free again: a swing is
/// slow at each turn, and one episode shall be told once.
const FREE_AFTER_NS: i64 = 500_000_000;

/// The limits that end a session, as the check needs them.
#[derive(Debug, Clone, Copy)]
pub(super) struct Limits {
    comm_timeout_ns: i64,
    condition_ns: i64,
    convergence_rad: f64,
    max_position_deviation_rad: f64,
}

impl Limits {
    pub(super) fn new(settings: &ControllerSettings) -> Self {
        Self {
            comm_timeout_ns: ns(settings.comm_timeout_s),
            condition_ns: ns(settings.condition_time_s),
            convergence_rad: settings.convergence_rad,
            max_position_deviation_rad: settings.max_position_deviation_rad,
        }
    }
}

/// Seconds of a checked setting in nanoseconds.
fn ns(seconds: f64) -> i64 {
    duration_ns(Duration::from_secs_f64(seconds))
}

/// What a session ended of.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Trip {
    cause: EndCause,
    /// In the unit of the cause.
    value: f64,
    limit: f64,
    /// Joint at fault, chain order.
    joint: usize,
}

/// Whether `MaxSpeedDeviation` binds.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct ThrottleWatch {
    began_at: Option<Instant>,
    bound_at: Instant,
    /// Highest speed asked in the episode.
    asked_rad_per_s: f64,
}

/// Whether commands have stopped.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct HoldWatch {
    taken_at: Instant,
    is_holding: bool,
}

impl HoldWatch {
    pub(super) fn is_holding(&self) -> bool {
        self.is_holding
    }
}

/// What the motion task does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Phase {
    Idle,
    /// See [`OwnMotion`].
    Moving,
    Waiting {
        until: Instant,
    },
    Activating {
        until: Instant,
    },
    Running,
    Stopping {
        since: Instant,
    },
}

impl Phase {
    pub(super) fn state(self) -> SessionState {
        match self {
            Self::Idle => SessionState::Idle,
            Self::Moving => SessionState::Moving,
            Self::Waiting { .. } => SessionState::Waiting,
            Self::Activating { .. } => SessionState::Activating,
            Self::Running => SessionState::Running,
            Self::Stopping { .. } => SessionState::Stopping,
        }
    }
}

/// The present session, or the last one.
#[derive(Debug, Clone)]
pub(super) struct Session {
    pub(super) phase: Phase,
    pub(super) number: u32,
    /// In force for it and for those that follow it by themselves.
    pub(super) settings: ControllerSettings,
    /// When its setting up, then when its guided motion began.
    pub(super) since: Instant,
    /// When the last one ended; before any did, the origin.
    pub(super) ended_at: Instant,
    /// Where the joints stood when guided motion began.
    pub(super) start_rad: Joints,
    /// Cycles since guided motion last began.
    pub(super) cycle_count: u64,
    /// When the last message arrived that was not refused, or guided motion began.
    pub(super) heard_at: Instant,
    pub(super) converged_since: Option<Instant>,
}

impl Session {
    pub(super) fn none(settings: ControllerSettings, q_rad: Joints) -> Self {
        Self {
            phase: Phase::Idle,
            number: 0,
            settings,
            since: Instant::ZERO,
            ended_at: Instant::ZERO,
            start_rad: q_rad,
            cycle_count: 0,
            heard_at: Instant::ZERO,
            converged_since: None,
        }
    }
}

/// Asked for between two cycles, done in the next.
#[derive(Debug, Clone)]
pub(super) enum Request {
    Start(Box<ControllerSettings>),
    Stop,
    Move {
        kind: MotionKind,
        points: Vec<Joints>,
    },
}

/// A motion without a client.
#[derive(Debug, Clone)]
pub(super) struct OwnMotion {
    kind: MotionKind,
    began_at: Instant,
    /// None until the arm stands and the way is known.
    track: Option<Track>,
    /// Cycles until the measured joints have arrived as well.
    settle_cycles: usize,
    /// Guided motion is set up after it.
    leads_to_session: bool,
}

impl Controller {
    pub(super) fn apply_request(&mut self, tell: &mut dyn FnMut(EgmEvent)) {
        match self.request.take() {
            Some(Request::Start(settings)) => {
                self.session.settings = *settings;
                self.law = Law::new(&settings);
                self.limits = Limits::new(&settings);
                self.activate(tell);
            }
            Some(Request::Stop) => self.stop(tell),
            Some(Request::Move { kind, points }) => {
                let track = Track::Path { points, next: 0 };
                self.begin_own_motion(kind, Some(track), tell);
            }
            None => {}
        }
    }

    fn stop(&mut self, tell: &mut dyn FnMut(EgmEvent)) {
        match self.session.phase {
            Phase::Idle | Phase::Stopping { .. } => {}
            Phase::Waiting { .. } => self.session.phase = Phase::Idle,
            Phase::Moving => {
                let own_motion = self.own_motion.take_if(|motion| motion.leads_to_session);
                if let Some(motion) = own_motion {
                    self.session.phase = Phase::Idle;
                    self.tell_motion_ended(&motion, tell);
                }
            }
            Phase::Activating { .. } => self.end_as_requested(self.at, tell),
            Phase::Running => {
                self.forget_reference();
                self.own_motion = None;
                self.session.phase = Phase::Stopping { since: self.at };
            }
        }
    }

    /// One cycle of guided motion.
    #[inline]
    pub(super) fn run(&mut self, tell: &mut dyn FnMut(EgmEvent)) {
        let ramp = self.law.ramp(self.session.cycle_count);
        let binding = self.plan.follow(&self.law, &self.reference, ramp);
        self.note_binding(binding, tell);
        if let Some(trip) = self.tripped() {
            self.end_by_itself(&trip, tell);
        }
    }

    /// One cycle of a state that is neither idle nor running.
    pub(super) fn go_on(&mut self, tell: &mut dyn FnMut(EgmEvent)) {
        match self.session.phase {
            Phase::Moving => self.move_on(tell),
            Phase::Stopping { since } => self.stop_on(since, tell),
            Phase::Waiting { until } => {
                self.plan.coast(&self.law);
                if self.at >= until {
                    self.activate(tell);
                }
            }
            Phase::Activating { until } => {
                self.plan.coast(&self.law);
                if self.at >= until {
                    self.begin_running(tell);
                }
            }
            Phase::Idle | Phase::Running => {}
        }
    }

    fn activate(&mut self, tell: &mut dyn FnMut(EgmEvent)) {
        self.session.number = self.session.number.wrapping_add(1);
        self.session.since = self.at;
        let until = self.after_s(self.session.settings.activation_s);
        self.session.phase = Phase::Activating { until };
        tell(EgmEvent {
            value: self.session.settings.activation_s,
            ..self.event(EgmEventKind::Activating)
        });
    }

    fn begin_running(&mut self, tell: &mut dyn FnMut(EgmEvent)) {
        self.inbox.clear();
        self.forget_reference();
        self.throttle = ThrottleWatch::default();
        self.session.phase = Phase::Running;
        self.session.since = self.at;
        self.session.heard_at = self.at;
        self.session.cycle_count = 0;
        self.session.converged_since = None;
        self.session.start_rad = *self.plan.q_rad();
        tell(EgmEvent {
            value: self.at.seconds_since(self.session.ended_at),
            ..self.event(EgmEventKind::Running)
        });
    }

    fn forget_reference(&mut self) {
        self.has_reference = false;
        self.reference = Reference::standing(self.plan.q_rad(), self.at);
        self.hold = HoldWatch::default();
    }

    fn end_by_itself(&mut self, trip: &Trip, tell: &mut dyn FnMut(EgmEvent)) {
        self.tell_ended(trip, tell);
        match self.session.settings.restart {
            RestartPolicy::AutoRetry => self.activate(tell),
            RestartPolicy::WaitThenRestart => {
                let until = self.after_s(self.session.settings.restart_wait_s);
                self.session.phase = Phase::Waiting { until };
            }
            RestartPolicy::ExternalTrigger => self.session.phase = Phase::Idle,
            RestartPolicy::GoHomeFirst => {
                self.begin_own_motion(MotionKind::Home, None, tell);
            }
        }
    }

    fn end_as_requested(&mut self, since: Instant, tell: &mut dyn FnMut(EgmEvent)) {
        let trip = Trip {
            cause: EndCause::Requested,
            value: self.at.seconds_since(since),
            limit: 0.0,
            joint: 0,
        };
        self.tell_ended(&trip, tell);
        self.session.phase = Phase::Idle;
    }

    fn tell_ended(&mut self, trip: &Trip, tell: &mut dyn FnMut(EgmEvent)) {
        self.end_throttling(tell);
        tell(EgmEvent {
            value: trip.value,
            limit: trip.limit,
            count: trip.joint as u64,
            cause: trip.cause as u32,
            ..self.event(EgmEventKind::Ended)
        });
        self.forget_reference();
        self.session.ended_at = self.at;
    }

    fn begin_own_motion(
        &mut self,
        kind: MotionKind,
        track: Option<Track>,
        tell: &mut dyn FnMut(EgmEvent),
    ) {
        self.session.phase = Phase::Moving;
        tell(EgmEvent {
            cause: kind as u32,
            ..self.event(EgmEventKind::MotionBegan)
        });
        self.own_motion = Some(OwnMotion {
            kind,
            began_at: self.at,
            leads_to_session: track.is_none(),
            track,
            settle_cycles: self.delay.cycles(),
        });
    }

    fn move_on(&mut self, tell: &mut dyn FnMut(EgmEvent)) {
        let Some(mut motion) = self.own_motion.take() else {
            self.session.phase = Phase::Idle;
            return;
        };
        let Some(track) = &mut motion.track else {
            self.plan.coast(&self.law);
            if self.plan.is_at_rest() {
                let home = home_rad(self.side);
                let way = JointMotion::new(self.plan.q_rad(), &home, SPEED_RATIO_DEFAULT);
                motion.track = Some(Track::along(way));
            }
            self.own_motion = Some(motion);
            return;
        };
        if let Some(q_rad) = track.advance(self.law.step_s()) {
            self.plan.place(&q_rad);
        } else if motion.settle_cycles > 1 {
            motion.settle_cycles -= 1;
        } else {
            self.tell_motion_ended(&motion, tell);
            if motion.leads_to_session {
                self.activate(tell);
            } else {
                self.session.phase = Phase::Idle;
            }
            return;
        }
        self.own_motion = Some(motion);
    }

    fn tell_motion_ended(&self, motion: &OwnMotion, tell: &mut dyn FnMut(EgmEvent)) {
        tell(EgmEvent {
            value: self.at.seconds_since(motion.began_at),
            cause: motion.kind as u32,
            ..self.event(EgmEventKind::MotionEnded)
        });
    }

    /// One cycle of a requested stop: to rest, then back to the session's start if the stop mode
    /// says so.
    fn stop_on(&mut self, since: Instant, tell: &mut dyn FnMut(EgmEvent)) {
        let Some(motion) = &mut self.own_motion else {
            self.plan.coast(&self.law);
            if !self.plan.is_at_rest() {
                return;
            }
            match self.session.settings.stop_mode {
                StopMode::Hold => self.end_as_requested(since, tell),
                StopMode::RampDown => {
                    let way = JointMotion::lasting(
                        self.plan.q_rad(),
                        &self.session.start_rad,
                        self.session.settings.ramp_out_s,
                    );
                    self.own_motion = Some(OwnMotion {
                        kind: MotionKind::EgmStop,
                        began_at: self.at,
                        track: Some(Track::along(way)),
                        settle_cycles: 0,
                        leads_to_session: false,
                    });
                }
            }
            return;
        };
        let step_s = self.law.step_s();
        let next = motion
            .track
            .as_mut()
            .and_then(|track| track.advance(step_s));
        if let Some(q_rad) = next {
            self.plan.place(&q_rad);
        } else {
            self.own_motion = None;
            self.end_as_requested(since, tell);
        }
    }

    fn after_s(&self, seconds: f64) -> Instant {
        Instant::from_ns(self.at.as_ns().saturating_add(ns(seconds)))
    }

    /// Decides about everything that arrived before this cycle, by the state the cycle before
    /// left.
    ///
    /// `CommTimeout` counts from the last command that could have moved the arm: one that was
    /// queued, or found the queue full. A refused one does not postpone it, as it does not where a
    /// face refuses it before it comes here.
    pub(super) fn settle_arrivals(&mut self, tell: &mut dyn FnMut(EgmEvent)) {
        let is_running = self.session.phase == Phase::Running;
        while let Some((arrived_at, fate)) = self.inbox.settle(self.at, is_running) {
            match fate {
                Fate::Refused(fault) => {
                    self.note_refusal(&fault, tell);
                    continue;
                }
                Fate::Queued => self.last_refusal = None,
                Fate::Dropped => self.note_overflow(tell),
            }
            // Without a session everything is refused.
            self.session.heard_at = arrived_at;
        }
        if self.inbox.take_pending_overflow() {
            self.note_overflow(tell);
        }
    }

    fn note_refusal(&mut self, fault: &Fault, tell: &mut dyn FnMut(EgmEvent)) {
        if self.last_refusal == Some(fault.refusal) {
            return;
        }
        self.last_refusal = Some(fault.refusal);
        tell(EgmEvent {
            value: fault.value,
            limit: fault.limit,
            count: fault.joint as u64,
            cause: fault.refusal as u32,
            ..self.event(EgmEventKind::CommandRefused)
        });
    }

    fn note_overflow(&mut self, tell: &mut dyn FnMut(EgmEvent)) {
        if self.has_overflowed {
            return;
        }
        self.has_overflowed = true;
        tell(EgmEvent {
            limit: self.settings.queue_capacity as f64,
            count: self.inbox.counters().dropped,
            ..self.event(EgmEventKind::QueueOverflow)
        });
    }

    /// Takes the next command, if one is there, as the reference of the coming cycles.
    pub(super) fn take_command(&mut self, tell: &mut dyn FnMut(EgmEvent)) {
        if self.session.phase != Phase::Running {
            return;
        }
        let reference = &mut self.reference;
        let took = self
            .inbox
            .take(|next| reference.set(&next.command, next.at));
        if took {
            self.cycle_flags |= EgmFeedback::TOOK_COMMAND;
            self.has_reference = true;
            if self.hold.is_holding {
                tell(EgmEvent {
                    value: self.at.seconds_since(self.hold.taken_at),
                    ..self.event(EgmEventKind::HoldEnded)
                });
            }
            self.hold = HoldWatch {
                taken_at: self.at,
                is_holding: false,
            };
            if self.has_overflowed && self.inbox.has_room_again() {
                self.has_overflowed = false;
            }
            return;
        }
        if !self.has_reference {
            return;
        }
        if !self.hold.is_holding && self.at.ns_since(self.hold.taken_at) > HOLD_AFTER_NS {
            self.hold.is_holding = true;
            tell(EgmEvent {
                value: self.at.seconds_since(self.hold.taken_at),
                limit: HOLD_AFTER_NS as f64 * 1e-9,
                ..self.event(EgmEventKind::HoldBegan)
            });
        }
        self.held_cycle_count += u64::from(self.hold.is_holding);
    }

    /// Tells of each episode in which `MaxSpeedDeviation` slows the joints that it began, and what
    /// it came to.
    #[inline]
    fn note_binding(&mut self, binding: Binding, tell: &mut dyn FnMut(EgmEvent)) {
        match binding {
            Binding::Nothing => {}
            Binding::Joint => self.cycle_flags |= EgmFeedback::SPEED_LIMITED,
            Binding::Deviation { asked_rad_per_s } => {
                self.cycle_flags |= EgmFeedback::SPEED_DEVIATION_LIMITED;
                let throttle = &mut self.throttle;
                throttle.bound_at = self.at;
                throttle.asked_rad_per_s = throttle.asked_rad_per_s.max(asked_rad_per_s);
                if throttle.began_at.is_none() {
                    self.throttle.began_at = Some(self.at);
                    let allowed = self.session.settings.max_speed_deviation_rad_per_s;
                    tell(EgmEvent {
                        value: asked_rad_per_s.to_degrees(),
                        limit: allowed.to_degrees(),
                        ..self.event(EgmEventKind::SpeedThrottled)
                    });
                }
                return;
            }
        }
        if self.throttle.began_at.is_some()
            && self.at.ns_since(self.throttle.bound_at) > FREE_AFTER_NS
        {
            self.end_throttling(tell);
        }
    }

    /// Tells what the episode under way came to, if there is one.
    fn end_throttling(&mut self, tell: &mut dyn FnMut(EgmEvent)) {
        let throttle = core::mem::take(&mut self.throttle);
        let Some(began_at) = throttle.began_at else {
            return;
        };
        // The last cycle in which it bound counts in full.
        let bound_ns = throttle.bound_at.ns_since(began_at) + ns(self.law.step_s());
        let allowed = self.session.settings.max_speed_deviation_rad_per_s;
        tell(EgmEvent {
            value: throttle.asked_rad_per_s.to_degrees(),
            limit: allowed.to_degrees(),
            count: bound_ns.unsigned_abs(),
            ..self.event(EgmEventKind::SpeedFree)
        });
    }

    /// The first limit that ends the session in this cycle.
    #[inline]
    fn tripped(&mut self) -> Option<Trip> {
        let (planned, session) = (self.plan.q_rad(), &self.session);
        let (mut farthest_rad, mut error_rad) = (0.0_f64, 0.0_f64);
        for (joint, q) in planned.iter().enumerate() {
            let deviation = (q - session.start_rad[joint]).abs();
            let error = (self.reference.position_rad[joint] - q).abs();
            if deviation > farthest_rad {
                farthest_rad = deviation;
            }
            if error > error_rad {
                error_rad = error;
            }
        }
        if farthest_rad > self.limits.max_position_deviation_rad {
            return Some(self.position_trip());
        }
        if self.has_reference && error_rad <= self.limits.convergence_rad {
            self.cycle_flags |= EgmFeedback::CONVERGED;
            let since = *self.session.converged_since.get_or_insert(self.at);
            if self.at.ns_since(since) >= self.limits.condition_ns {
                return Some(Trip {
                    cause: EndCause::ConditionTime,
                    value: self.at.seconds_since(since),
                    limit: self.session.settings.condition_time_s,
                    joint: 0,
                });
            }
        } else {
            self.session.converged_since = None;
        }
        (self.at.ns_since(self.session.heard_at) > self.limits.comm_timeout_ns).then(|| Trip {
            cause: EndCause::CommTimeout,
            value: self.at.seconds_since(self.session.heard_at),
            limit: self.session.settings.comm_timeout_s,
            joint: 0,
        })
    }

    #[cold]
    fn position_trip(&self) -> Trip {
        let away = |joint: usize| self.plan.q_rad()[joint] - self.session.start_rad[joint];
        let joint = (0..JOINT_COUNT)
            .max_by(|a, b| away(*a).abs().total_cmp(&away(*b).abs()))
            .unwrap_or(0);
        Trip {
            cause: EndCause::PositionDeviation,
            value: away(joint).to_degrees(),
            limit: self
                .session
                .settings
                .max_position_deviation_rad
                .to_degrees(),
            joint,
        }
    }
}
