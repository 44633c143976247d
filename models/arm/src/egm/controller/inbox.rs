//! What happens to a command before the control law sees it: checks, the wait for its grid point,
//! the controller's queue. It knows no session; the controller tells it whether one runs.

use std::collections::VecDeque;

use bytemuck::Zeroable;

use crate::egm::messages::{CommandRefusal, EgmCommand};
use crate::egm::parameters::QueuePolicy;
use crate::yumi::JOINT_COUNT;
use crate::yumi::arm::{POSITION_MAX_RAD, POSITION_MIN_RAD};
use hil_core::time::Instant;

/// How far beyond a joint's limit a commanded position may lie: a limit that travelled in degrees
/// comes back with its last digits changed. The servo stops at the limit itself.
pub const LIMIT_TOLERANCE_RAD: f64 = 1e-6;

/// At least so many commands may arrive between two cycles, whatever the queue holds.
const PENDING_CAPACITY_MIN: usize = 1024;

/// What became of the commands so far. Each that was received is counted once, or still waits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct CommandCounters {
    /// Handed over by [`Controller::receive`](super::Controller::receive).
    pub received: u64,
    /// Taken from the queue as the reference.
    pub taken: u64,
    /// [`CommandRefusal::NotFinite`].
    pub refused_not_finite: u64,
    /// [`CommandRefusal::OutsideLimits`].
    pub refused_outside_limits: u64,
    /// [`CommandRefusal::NoSession`].
    pub refused_no_session: u64,
    /// Passed over for a newer one ([`QueuePolicy::Latest`]).
    pub superseded: u64,
    /// Found no room.
    pub dropped: u64,
    /// Emptied from the queue when a session began.
    pub cleared: u64,
}

/// Why a command cannot be used, and the number at fault.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Fault {
    pub(super) refusal: CommandRefusal,
    pub(super) value: f64,
    pub(super) limit: f64,
    pub(super) joint: usize,
}

impl Fault {
    pub(super) const NO_SESSION: Self = Self {
        refusal: CommandRefusal::NoSession,
        value: 0.0,
        limit: 0.0,
        joint: 0,
    };

    /// The first fault of `command`, whatever the session.
    #[cold]
    fn of(command: &EgmCommand) -> Option<Self> {
        let fault = |refusal, value, limit, joint| {
            Some(Self {
                refusal,
                value,
                limit,
                joint,
            })
        };
        let has_speed = command.flags & EgmCommand::HAS_SPEED != 0;
        for joint in 0..JOINT_COUNT {
            let speed = command.speed_rad_per_s[joint];
            if has_speed && !speed.is_finite() {
                return fault(CommandRefusal::NotFinite, speed, 0.0, joint);
            }
            let q = command.position_rad[joint];
            if !q.is_finite() {
                return fault(CommandRefusal::NotFinite, q, 0.0, joint);
            }
            let (min, max) = (POSITION_MIN_RAD[joint], POSITION_MAX_RAD[joint]);
            if q < min - LIMIT_TOLERANCE_RAD {
                return fault(CommandRefusal::OutsideLimits, q, min, joint);
            }
            if q > max + LIMIT_TOLERANCE_RAD {
                return fault(CommandRefusal::OutsideLimits, q, max, joint);
            }
        }
        None
    }
}

/// Whether [`Fault::of`] finds nothing, without saying what.
#[inline]
fn is_faultless(command: &EgmCommand) -> bool {
    let mut is_faultless = true;
    for joint in 0..JOINT_COUNT {
        let q = command.position_rad[joint];
        is_faultless &= q >= POSITION_MIN_RAD[joint] - LIMIT_TOLERANCE_RAD;
        is_faultless &= q <= POSITION_MAX_RAD[joint] + LIMIT_TOLERANCE_RAD;
    }
    if command.flags & EgmCommand::HAS_SPEED != 0 {
        for speed in &command.speed_rad_per_s {
            is_faultless &= speed.is_finite();
        }
    }
    is_faultless
}

/// A command with its arrival.
#[derive(Debug, Clone, Copy)]
pub(super) struct Arrival {
    pub(super) at: Instant,
    pub(super) command: EgmCommand,
    is_faultless: bool,
}

impl Arrival {
    fn fault(&self) -> Option<Fault> {
        if self.is_faultless {
            None
        } else {
            Fault::of(&self.command)
        }
    }
}

/// What became of one arrival at its grid point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Fate {
    Queued,
    Refused(Fault),
    Dropped,
}

/// Commands on their way to the control law.
#[derive(Debug, Clone)]
pub(super) struct Inbox {
    policy: QueuePolicy,
    /// Handed over, but no grid point came to them yet: what they meet is decided there, so that
    /// it does not matter how early the driver hands them over.
    pending: VecDeque<Arrival>,
    queue: VecDeque<Arrival>,
    /// Commands that the queue holds; as many may be pending, or [`PENDING_CAPACITY_MIN`].
    queue_capacity: usize,
    counters: CommandCounters,
    has_pending_overflow: bool,
}

impl Inbox {
    pub(super) fn new(policy: QueuePolicy, queue_capacity: usize) -> Self {
        Self {
            policy,
            pending: touched(queue_capacity.max(PENDING_CAPACITY_MIN)),
            queue: touched(queue_capacity),
            queue_capacity,
            counters: CommandCounters::default(),
            has_pending_overflow: false,
        }
    }

    /// Notes a command that arrived at `at`.
    pub(super) fn receive(
        &mut self,
        at: Instant,
        command: &EgmCommand,
    ) -> Result<(), CommandRefusal> {
        self.counters.received += 1;
        let arrival = Arrival {
            at,
            command: *command,
            is_faultless: is_faultless(command),
        };
        if self.pending.len() < self.queue_capacity.max(PENDING_CAPACITY_MIN) {
            self.pending.push_back(arrival);
        } else {
            self.counters.dropped += 1;
            self.has_pending_overflow = true;
        }
        arrival.fault().map_or(Ok(()), |fault| Err(fault.refusal))
    }

    /// Settles the next command that arrived before `at`: when it came and what became of it.
    #[inline]
    pub(super) fn settle(&mut self, at: Instant, is_running: bool) -> Option<(Instant, Fate)> {
        let arrival = self.pending.front().filter(|arrival| arrival.at < at)?;
        let arrived = arrival.at;
        let fault = if is_running {
            arrival.fault()
        } else {
            arrival.fault().or(Some(Fault::NO_SESSION))
        };
        let fate = match fault {
            Some(fault) => {
                *self.refused_count(fault.refusal) += 1;
                Fate::Refused(fault)
            }
            None if self.queue.len() < self.queue_capacity => {
                self.queue.push_back(*arrival);
                Fate::Queued
            }
            None => {
                self.counters.dropped += 1;
                Fate::Dropped
            }
        };
        discard_front(&mut self.pending);
        Some((arrived, fate))
    }

    fn refused_count(&mut self, refusal: CommandRefusal) -> &mut u64 {
        match refusal {
            CommandRefusal::NotFinite => &mut self.counters.refused_not_finite,
            CommandRefusal::OutsideLimits => &mut self.counters.refused_outside_limits,
            CommandRefusal::NoSession => &mut self.counters.refused_no_session,
        }
    }

    /// Gives `take` the command that the queue policy has next; false when none waits.
    #[inline]
    pub(super) fn take(&mut self, take: impl FnOnce(&Arrival)) -> bool {
        let waiting = self.queue.len();
        let next = match self.policy {
            QueuePolicy::Fifo1 => self.queue.front(),
            QueuePolicy::Latest => self.queue.back(),
        };
        let Some(next) = next else {
            return false;
        };
        take(next);
        match self.policy {
            QueuePolicy::Fifo1 => discard_front(&mut self.queue),
            QueuePolicy::Latest => {
                self.queue.clear();
                self.counters.superseded += waiting as u64 - 1;
            }
        }
        self.counters.taken += 1;
        true
    }

    /// Empties the queue.
    pub(super) fn clear(&mut self) {
        self.counters.cleared += self.queue.len() as u64;
        self.queue.clear();
    }

    pub(super) fn queued(&self) -> usize {
        self.queue.len()
    }

    /// True when commands were turned away since the last call because too many came between two
    /// cycles.
    pub(super) fn take_pending_overflow(&mut self) -> bool {
        core::mem::take(&mut self.has_pending_overflow)
    }

    /// True while the queue is at most half full.
    pub(super) fn has_room_again(&self) -> bool {
        2 * self.queue.len() <= self.queue_capacity
    }

    pub(super) fn counters(&self) -> &CommandCounters {
        &self.counters
    }
}

/// An empty queue with room for `capacity` arrivals, all of it touched now.
fn touched(capacity: usize) -> VecDeque<Arrival> {
    let blank = Arrival {
        at: Instant::ZERO,
        command: EgmCommand::zeroed(),
        is_faultless: false,
    };
    let mut queue = VecDeque::from(vec![blank; capacity]);
    queue.clear();
    queue
}

/// Forgets the oldest.
fn discard_front(queue: &mut VecDeque<Arrival>) {
    queue.pop_front();
    if queue.is_empty() {
        // Starting over at the front keeps a short queue within a few cache lines.
        queue.clear();
    }
}
