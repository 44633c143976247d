//! What starts and ends: the session's states, the restart policies, and the motions of the
//! controller's own. It computes no motion of a session.

use crate::egm::controller::motion::{JointMotion, SPEED_RATIO_DEFAULT, Track, home_rad};
use crate::egm::controller::watch::{HoldWatch, Limits, ThrottleWatch, Trip, ns};
use crate::egm::controller::{Controller, Law, Reference};
use crate::egm::messages::{EgmEvent, EgmEventKind, EndCause, MotionKind, SessionState};
use crate::egm::parameters::{ControllerSettings, RestartPolicy, StopMode};
use crate::yumi::Joints;
use hil_core::time::Instant;

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
            settle_cycles: self.delay.cycles,
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
        if let Some(q_rad) = track.advance(self.law.step_s) {
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
        let step_s = self.law.step_s;
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
}
