//! How a pinned thread waits for its next message: in the kernel, on the processor, or in the
//! kernel until shortly before the message is expected. It decides; the caller waits.

use core::time::Duration;

use std::thread;

use hil_core::arrival::ArrivalPredictor;
use hil_core::time::{Instant, duration_ns};
use serde::{Deserialize, Serialize};

use crate::realtime::is_isolated;

/// How long before an expected event hybrid waiting starts to spin. Covers a blocking wake-up's
/// usual latency with some room; longer would only cost processor time.
pub const SPIN_LEAD: Duration = Duration::from_micros(90);

/// Messages that may stay away before hybrid waiting sleeps until one comes.
const MISSES_MAX: i64 = 16;

/// No thread waits longer than this at once, so that orders to stop are seen.
pub const WAIT_MAX: Duration = Duration::from_millis(50);

/// The waiting strategies.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WaitMode {
    /// Sleep in the kernel until there is something to do. The default.
    Block,
    /// Sleep until shortly before the next expected event, then spin: for periodic channels.
    Hybrid,
    /// Never sleep: for an isolated CPU.
    Spin,
}

/// What to do until there is something to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pause {
    /// Sleep in the kernel until this instant or an arrival.
    Sleep(Instant),
    /// Look again at once.
    Spin,
}

impl Pause {
    /// The shorter of two pauses.
    #[must_use]
    pub fn sooner(self, other: Self) -> Self {
        match (self, other) {
            (Self::Sleep(a), Self::Sleep(b)) => Self::Sleep(a.min(b)),
            _ => Self::Spin,
        }
    }
}

/// What to do at `now` for something that must happen at `due`, neither before nor after: sleep
/// until shortly before, then spin. The kernel alone would be a wake-up latency late.
pub fn release(now: Instant, due: Instant) -> Pause {
    let spin_from = earlier(due, SPIN_LEAD);
    if spin_from <= now {
        Pause::Spin
    } else {
        Pause::Sleep(spin_from.min(now + WAIT_MAX))
    }
}

/// The waiting of one thread.
#[derive(Debug, Clone)]
pub struct WaitStrategy {
    mode: WaitMode,
    predictor: ArrivalPredictor,
    /// Others may want the processor of a thread that spins.
    is_shared: bool,
}

impl WaitStrategy {
    /// Waiting in `mode` on `cpu`, if it is bound to one.
    pub fn new(mode: WaitMode, cpu: Option<usize>) -> Self {
        Self {
            mode,
            predictor: ArrivalPredictor::default(),
            is_shared: mode != WaitMode::Block && !cpu.is_some_and(is_isolated),
        }
    }

    /// Spins once while it waits for a message: looks again at once on an isolated processor or in a thread that
    /// blocks; else lets others of the same priority have the processor first, which would wait for as long as the scheduler lets
    /// this thread spin.
    pub fn spin(&self) {
        if self.is_shared {
            thread::yield_now();
        } else {
            core::hint::spin_loop();
        }
    }

    /// Tells when a message arrived.
    pub fn on_arrival(&mut self, at: Instant) {
        if self.mode == WaitMode::Hybrid {
            self.predictor.arrived(at);
        }
    }

    /// What to do at `now`, when `next_due` is the thread's own next appointment.
    pub fn pause(&self, now: Instant, next_due: Option<Instant>) -> Pause {
        let longest = now + WAIT_MAX;
        let sleep_until = |due: Option<Instant>| due.map_or(longest, |due| due.min(longest));
        match self.mode {
            WaitMode::Block => Pause::Sleep(sleep_until(next_due)),
            WaitMode::Spin => Pause::Spin,
            WaitMode::Hybrid => {
                // The kernel meets an appointment a wake-up latency late, so it is spun for as
                // an arrival is.
                let events = self.expected(now).into_iter().chain(next_due);
                let spin_from = events.min().map(|event| earlier(event, SPIN_LEAD));
                match spin_from {
                    Some(from) if from <= now => Pause::Spin,
                    from => Pause::Sleep(sleep_until(from)),
                }
            }
        }
    }

    /// The arrival to wait for: the expected one until it is overdue by the lead, then the next
    /// on the grid, so that a loss costs a bounded time of spinning; none once a whole stretch stayed away.
    fn expected(&self, now: Instant) -> Option<Instant> {
        let expected = self.predictor.next_expected()?;
        if now <= expected + SPIN_LEAD {
            return Some(expected);
        }
        let longest_ns = duration_ns(self.predictor.period()?).saturating_mul(MISSES_MAX);
        self.predictor
            .next_expected_after(now)
            .filter(|_| now.ns_since(expected) <= longest_ns)
    }
}

fn earlier(at: Instant, lead: Duration) -> Instant {
    Instant::from_ns(at.as_ns().saturating_sub(duration_ns(lead)))
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn learnt(mode: WaitMode) -> WaitStrategy {
        let mut wait = WaitStrategy::new(mode, None);
        (0..20).for_each(|index| wait.on_arrival(Instant::from_ns(index * MS)));
        wait
    }

    #[test]
    fn block_sleeps_until_the_appointment_and_spin_never_sleeps() {
        let now = Instant::from_ns(5 * MS);
        let due = Instant::from_ns(7 * MS);
        assert_eq!(
            learnt(WaitMode::Block).pause(now, Some(due)),
            Pause::Sleep(due)
        );
        assert_eq!(
            learnt(WaitMode::Block).pause(now, None),
            Pause::Sleep(now + WAIT_MAX)
        );
        assert_eq!(learnt(WaitMode::Spin).pause(now, Some(due)), Pause::Spin);
    }

    #[test]
    fn a_release_is_slept_for_until_shortly_before_and_then_spun_for() {
        let due = Instant::from_ns(20 * MS);
        let spin_from = Instant::from_ns(20 * MS - 90_000);
        let early = Instant::from_ns(10 * MS);
        assert_eq!(release(early, due), Pause::Sleep(spin_from));
        for now in [spin_from, due, Instant::from_ns(21 * MS)] {
            assert_eq!(release(now, due), Pause::Spin);
        }
        // However far it is, an order to stop is seen.
        let far = Instant::from_ns(900 * MS);
        assert_eq!(release(early, far), Pause::Sleep(early + WAIT_MAX));
    }

    #[test]
    fn hybrid_sleeps_until_shortly_before_the_expected_arrival_and_then_spins() {
        let wait = learnt(WaitMode::Hybrid);
        let early = Instant::from_ns(19 * MS + MS / 2);
        let spin_from = Instant::from_ns(20 * MS - 90_000);
        assert_eq!(wait.pause(early, None), Pause::Sleep(spin_from));
        assert_eq!(wait.pause(spin_from, None), Pause::Spin);
    }

    #[test]
    fn hybrid_gives_up_an_overdue_arrival_and_sleeps_until_the_next() {
        let wait = learnt(WaitMode::Hybrid);
        let overdue = Instant::from_ns(20 * MS + 100_000);
        assert_eq!(
            wait.pause(overdue, None),
            Pause::Sleep(Instant::from_ns(21 * MS - 90_000))
        );
    }

    #[test]
    fn hybrid_sleeps_once_a_whole_stretch_stayed_away_and_learns_anew() {
        let mut wait = learnt(WaitMode::Hybrid);
        // The last arrival was at 19 ms.
        let due = |now_ns| wait.pause(Instant::from_ns(now_ns), None);
        assert_eq!(due(36 * MS), Pause::Spin);
        let silent = Instant::from_ns(37 * MS);
        assert_eq!(due(37 * MS), Pause::Sleep(silent + WAIT_MAX));
        wait.on_arrival(Instant::from_ns(60 * MS));
        let now = Instant::from_ns(60 * MS + MS / 2);
        let spin_from = Instant::from_ns(61 * MS - 90_000);
        assert_eq!(wait.pause(now, None), Pause::Sleep(spin_from));
    }

    #[test]
    fn hybrid_without_a_known_period_sleeps_like_block() {
        let wait = WaitStrategy::new(WaitMode::Hybrid, None);
        let now = Instant::from_ns(MS);
        assert_eq!(wait.pause(now, None), Pause::Sleep(now + WAIT_MAX));
    }
}
