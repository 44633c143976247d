//! What is watched while guided motion runs: the limits that end a session, and the states worth
//! an event (refusing, overflowing, throttled, holding). It ends nothing itself.

use core::time::Duration;

use crate::egm::controller::Controller;
use crate::egm::controller::inbox::{Fate, Fault};
use crate::egm::controller::law::Binding;
use crate::egm::controller::session::Phase;
use crate::egm::messages::{EgmEvent, EgmEventKind, EgmFeedback, EndCause};
use crate::egm::parameters::ControllerSettings;
use crate::yumi::JOINT_COUNT;
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
pub(super) fn ns(seconds: f64) -> i64 {
    duration_ns(Duration::from_secs_f64(seconds))
}

/// What a session ended of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Trip {
    pub(super) cause: EndCause,
    /// In the unit of the cause.
    pub(super) value: f64,
    pub(super) limit: f64,
    /// Joint at fault, chain order.
    pub(super) joint: usize,
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
    pub(super) is_holding: bool,
}

impl Controller {
    /// Decides about everything that arrived before this cycle, by the state the cycle before
    /// left.
    ///
    /// `CommTimeout` counts from the last command that could have moved the arm: one that was
    /// queued, or found the queue full. A refused one does not postpone it, as it does not where a
    /// adapter refuses it before it comes here.
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
    }

    /// Tells of each episode in which `MaxSpeedDeviation` slows the joints that it began, and what
    /// it came to.
    #[inline]
    pub(super) fn note_binding(&mut self, binding: Binding, tell: &mut dyn FnMut(EgmEvent)) {
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
    pub(super) fn end_throttling(&mut self, tell: &mut dyn FnMut(EgmEvent)) {
        let throttle = core::mem::take(&mut self.throttle);
        let Some(began_at) = throttle.began_at else {
            return;
        };
        // The last cycle in which it bound counts in full.
        let bound_ns = throttle.bound_at.ns_since(began_at) + ns(self.law.step_s);
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
    pub(super) fn tripped(&mut self) -> Option<Trip> {
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
