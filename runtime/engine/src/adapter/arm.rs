//! One arm's thread: looks in turn at shared memory and at the socket, and waits for either. What
//! is sent and what is made of what came is the business of `robot` and `sensor`.

use core::fmt::Debug;
use core::time::Duration;
use std::os::fd::BorrowedFd;

use hil_core::message::Envelope;
use hil_core::time::Instant;
use hil_transport::DatagramSender;

use super::line::Line;
use crate::gateway::poll_descriptors;
use crate::gateway::stamp_tracker::STAMP_PATIENCE_NS;
use crate::process::recording::{RecordedInput, RecordedOutput};
use crate::process::worker::WorkerError;
use hil_platform::clock::MonotonicClock;
use hil_platform::wait::{Pause, WaitStrategy};
use hil_rundir::pipe::{CountByName, RefusalCount};
use hil_shm::Waiter;

/// Longer than any message of the protocol, which stays below 1 kB; what is longer is cut off and
/// refused.
pub(super) const DATAGRAM_BYTES_MAX: usize = 2048;
/// A busy or spinning thread looks after its socket's error queue this often.
const LOOK_PERIOD_NS: i64 = 500_000;
/// So many looks at most clear what waits before and after the run: more than a socket's buffer
/// and a channel hold, so that only a peer that goes on sending meets this end.
const CLEARING_TURNS_MAX: usize = 65_536;

/// What the thread works with, whichever adapter it is.
#[derive(Debug)]
pub(super) struct Arm {
    pub(super) input: RecordedInput,
    pub(super) output: RecordedOutput,
    pub(super) waiter: Option<Waiter>,
    pub(super) line: Line,
    pub(super) wait: WaitStrategy,
    pub(super) buffer: Box<[u8; DATAGRAM_BYTES_MAX]>,
    pub(super) attention: Attention,
    /// Datagrams that came before the run began, dropped.
    pub(super) early_count: u64,
}

/// What waiting found.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Attention {
    has_news: bool,
    is_announced: bool,
    looked: Instant,
}

/// What one of the two adapters does.
pub(super) trait Work: Debug {
    /// Moves what waits at both ends, at most one message each way; false when nothing waited.
    fn turn(&mut self, arm: &mut Arm) -> Result<bool, WorkerError>;

    /// The adapter's own next appointment.
    fn next_due(&self) -> Option<Instant>;

    /// What it counted but what it refused.
    fn counters(&self) -> Vec<CountByName>;

    /// What it refused, by cause.
    fn refusals(&self) -> Vec<RefusalCount>;

    /// How the foreign program stood to it, in words.
    fn peer_state(&self) -> String;
}

impl Arm {
    /// Drops what came before the run: a robot that was there before us has filled the socket.
    pub(super) fn clear(&mut self) -> Result<(), WorkerError> {
        for _ in 0..CLEARING_TURNS_MAX {
            if self.line.receive(self.buffer.as_mut_slice())?.is_none() {
                break;
            }
            self.early_count += 1;
        }
        Ok(())
    }

    /// Takes what still waits: none of ours publishes any more, but the foreign program may go on sending.
    pub(super) fn finish(&mut self, work: &mut dyn Work) -> Result<(), WorkerError> {
        for _ in 0..CLEARING_TURNS_MAX {
            if !self.step(work)? {
                break;
            }
        }
        self.line.look_after(Instant::from_ns(i64::MAX));
        Ok(())
    }

    /// One look at both ends and, now and then, at the socket's reports.
    pub(super) fn step(&mut self, work: &mut dyn Work) -> Result<bool, WorkerError> {
        let has_moved = work.turn(self)?;
        let now = MonotonicClock::now();
        let since_look = now.ns_since(self.attention.looked);
        if self.attention.has_news || since_look > LOOK_PERIOD_NS {
            self.attention.has_news = false;
            self.attention.looked = now;
            self.line.look_after(now);
        }
        // Announcements are taken back after the message they are about has gone out. One that
        // was published before they were is seen by the look that follows.
        let was_announced = core::mem::take(&mut self.attention.is_announced);
        if was_announced && let Some(waiter) = &mut self.waiter {
            waiter.drain(0)?;
        }
        Ok(has_moved || was_announced)
    }

    /// Waits for a message, a datagram, a stamp or an appointment.
    pub(super) fn rest(&mut self, due: Option<Instant>) -> Result<(), WorkerError> {
        let now = MonotonicClock::now();
        let mut due = due;
        if self.line.awaits_stamps() {
            let patience = Instant::from_ns(now.as_ns() + STAMP_PATIENCE_NS);
            due = Some(due.map_or(patience, |due| due.min(patience)));
        }
        let own = self.wait.pause(now, due);
        match own.sooner(self.input.wait.pause(now, None)) {
            Pause::Spin => core::hint::spin_loop(),
            Pause::Sleep(until) => {
                let listeners = self.waiter.iter().map(Waiter::descriptor);
                let socket: Option<BorrowedFd<'_>> = self.line.socket.poll_fd();
                let [first, second, ..] = poll_descriptors(listeners.chain(socket), until)?;
                let (is_announced, has_news) = match self.waiter {
                    Some(_) => (first, second),
                    None => (false, first),
                };
                self.attention.has_news |= has_news;
                self.attention.is_announced |= is_announced;
            }
        }
        Ok(())
    }
}

/// The time of day of `at`, since 1 January 1970.
pub(super) fn since_1970(at: Instant, realtime_offset_ns: i64) -> Duration {
    let ns = at.as_ns().saturating_add(realtime_offset_ns);
    Duration::from_nanos(u64::try_from(ns).unwrap_or(0))
}

/// When a message was published on this host: by its producer, or by the gateway that brought it.
pub(super) const fn published_here_ns(envelope: &Envelope) -> i64 {
    if envelope.is_forwarded() {
        envelope.forwarded_ns
    } else {
        envelope.published_ns
    }
}
