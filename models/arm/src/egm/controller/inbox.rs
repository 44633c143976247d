//! What happens to a command before the control law sees it: checks, the wait for its grid point,
//! the controller's queue. It knows no session; the controller tells it whether one runs.

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
    pending: Ring<Arrival>,
    queue: Ring<Arrival>,
    counters: CommandCounters,
    has_pending_overflow: bool,
}

impl Inbox {
    pub(super) fn new(policy: QueuePolicy, queue_capacity: usize) -> Self {
        let blank = Arrival {
            at: Instant::ZERO,
            command: EgmCommand::zeroed(),
            is_faultless: false,
        };
        Self {
            policy,
            pending: Ring::new(queue_capacity.max(PENDING_CAPACITY_MIN), blank),
            queue: Ring::new(queue_capacity, blank),
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
        if !self.pending.push(&arrival) {
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
            None if self.queue.push(arrival) => Fate::Queued,
            None => {
                self.counters.dropped += 1;
                Fate::Dropped
            }
        };
        self.pending.discard_front();
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
            QueuePolicy::Fifo1 => self.queue.discard_front(),
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
        2 * self.queue.len() <= self.queue.capacity()
    }

    pub(super) fn counters(&self) -> &CommandCounters {
        &self.counters
    }
}

/// The buffer.
#[derive(Debug, Clone)]
pub(super) struct Ring<T> {
    slots: Box<[T]>,
    first: usize,
    len: usize,
}

impl<T: Copy> Ring<T> {
    /// Room for `capacity` values, all touched now by writing `blank`.
    pub(super) fn new(capacity: usize, blank: T) -> Self {
        Self {
            slots: vec![blank; capacity.max(1)].into_boxed_slice(),
            first: 0,
            len: 0,
        }
    }

    pub(super) fn len(&self) -> usize {
        self.len
    }

    pub(super) fn capacity(&self) -> usize {
        self.slots.len()
    }

    fn slot(&self, index: usize) -> usize {
        let slot = self.first + index;
        if slot < self.slots.len() {
            slot
        } else {
            slot - self.slots.len()
        }
    }

    /// Appends `value`; false when it does not fit.
    #[must_use]
    pub(super) fn push(&mut self, value: &T) -> bool {
        if self.len == self.slots.len() {
            return false;
        }
        self.slots[self.slot(self.len)] = *value;
        self.len += 1;
        true
    }

    pub(super) fn front(&self) -> Option<&T> {
        (self.len > 0).then(|| &self.slots[self.first])
    }

    pub(super) fn back(&self) -> Option<&T> {
        (self.len > 0).then(|| &self.slots[self.slot(self.len - 1)])
    }

    /// Forgets the oldest.
    pub(super) fn discard_front(&mut self) {
        if self.len > 0 {
            self.first = self.slot(1);
            self.len -= 1;
        }
        // Starting over at the front keeps a short queue within a few cache lines.
        if self.len == 0 {
            self.first = 0;
        }
    }

    pub(super) fn clear(&mut self) {
        (self.first, self.len) = (0, 0);
    }
}

#[cfg(test)]
mod ring_tests {
    use super::*;

    #[test]
    fn values_come_out_in_order_and_never_exceed_the_capacity() {
        let mut ring = Ring::new(3, 0);
        let (mut next_in, mut next_out) = (0, 0);
        for step in 0..100 {
            for _ in 0..step % 5 {
                let fits = ring.len() < 3;
                assert_eq!(ring.push(&next_in), fits);
                next_in += i32::from(fits);
            }
            assert_eq!(ring.back().copied(), (ring.len() > 0).then(|| next_in - 1));
            for _ in 0..step % 3 {
                assert_eq!(
                    ring.front().copied(),
                    (next_out < next_in).then_some(next_out)
                );
                next_out += i32::from(ring.front().is_some());
                ring.discard_front();
            }
        }
        ring.clear();
        assert_eq!((ring.front(), ring.len(), ring.capacity()), (None, 0, 3));
    }
}
