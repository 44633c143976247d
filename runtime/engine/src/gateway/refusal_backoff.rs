//! What a sleeping thread does about a flood of datagrams that it refuses: it looks away from its socket
//! for a moment, so that the next ones are met together. It would otherwise be woken for each, and a
//! wake-up costs its processor, and the sender's on this machine, more than the refusal itself.
//!
//! An honest datagram that comes meanwhile waits for [`GATHERING`] and the thread's timer slack at
//! most. A line on which little is refused, such as the copies that a network makes, is never left, nor
//! does a thread look away that spins, which is woken by nobody.
//!
//! Where the honest datagrams are the messages, neither does one with real-time priority. A normal thread
//! pays for the processor time of its wake-ups with its turn, and waits for the next one longer than
//! [`GATHERING`]; one with priority does not, so looking away would only make its messages late. The
//! sending side gets replies on its socket and messages elsewhere, so it looks away as it likes.

use core::time::Duration;

use hil_core::time::Instant;
use hil_transport::sealed::REFUSED_PER_LOOK_MAX;

use hil_platform::realtime;

/// How long a thread looks away: about the wake-up that it saves.
pub(super) const GATHERING: Duration = Duration::from_micros(50);
/// As many refusals within [`WINDOW`] are a flood: above what any network makes of honest datagrams.
const FLOOD_COUNT: u64 = 8;
/// What counts as at once.
const WINDOW: Duration = Duration::from_millis(1);

/// The refusals of one socket, as its thread last saw them.
#[derive(Debug)]
pub(super) struct RefusalBackoff {
    /// False for a thread that never looks away.
    is_wanted: bool,
    refused_count: u64,
    /// When the window began in which refusals are counted.
    began: Instant,
    /// In that window, and whether the one before it saw a flood.
    count: u64,
    was_flood: bool,
    /// When the thread last looked at the count.
    seen: Instant,
}

impl RefusalBackoff {
    /// Of a socket for replies on which nothing was refused yet.
    pub(super) const fn of_replies() -> Self {
        Self::new(true)
    }

    /// Of a socket for messages on which nothing was refused yet, for the calling thread as it is
    /// scheduled now.
    pub(super) fn of_messages() -> Self {
        Self::new(!realtime::has_realtime_priority())
    }

    const fn new(is_wanted: bool) -> Self {
        Self {
            is_wanted,
            refused_count: 0,
            began: Instant::from_ns(i64::MIN),
            count: 0,
            was_flood: false,
            seen: Instant::from_ns(i64::MIN),
        }
    }

    /// Until when to look away, at `now`, when `refused_count` datagrams were refused so far; `None` for a
    /// thread that never does, when that is no flood, or when so much came at once that more may wait.
    pub(super) fn until(&mut self, now: Instant, refused_count: u64) -> Option<Instant> {
        if !self.is_wanted {
            return None;
        }
        let new_count = refused_count.saturating_sub(self.refused_count);
        self.refused_count = refused_count;
        // Refusals of a time that the thread did not come here, as while it spins, are of any age.
        let is_recent = now.saturating_duration_since(self.seen) <= WINDOW;
        self.seen = now;
        let age = now.saturating_duration_since(self.began);
        if age > WINDOW {
            self.was_flood = age <= 2 * WINDOW && self.count >= FLOOD_COUNT;
            (self.began, self.count) = (now, 0);
        }
        if new_count == 0 || !is_recent {
            return None;
        }
        self.count += new_count;
        let is_flood = self.was_flood || self.count >= FLOOD_COUNT;
        let is_emptied = new_count < REFUSED_PER_LOOK_MAX as u64;
        (is_flood && is_emptied).then(|| now + GATHERING)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_platform::realtime::SchedulingPolicy;

    /// What a normal thread does that looks every `every_us` and refuses `each` meanwhile, a thousand
    /// times: how often it looks away.
    fn away_count(every_us: i64, each: u64) -> usize {
        away_count_of(true, every_us, each)
    }

    fn away_count_of(is_wanted: bool, every_us: i64, each: u64) -> usize {
        let mut refusal_backoff = RefusalBackoff::new(is_wanted);
        let looks = (0..1000_u64).map(|look| {
            let now = Instant::from_ns(every_us * 1000 * look.cast_signed());
            let away = refusal_backoff.until(now, each * look);
            assert!(away.is_none_or(|away| away == now + GATHERING));
            away
        });
        looks.flatten().count()
    }

    #[test]
    fn a_flood_is_gathered_and_what_a_network_does_is_not() {
        assert_eq!(away_count(10, 0), 0, "an honest line is never left");
        assert_eq!(away_count(500, 1), 0, "a copy of every message at 2 kHz");
        assert_eq!(away_count(10, 1), 1000 - 8, "100,000 a second");
        assert_eq!(away_count(60, 6), 1000 - 2, "the same, gathered");
        assert_eq!(away_count(10, 16), 0, "more may wait");
    }

    #[test]
    fn a_thread_with_real_time_priority_never_looks_away() {
        assert_eq!(away_count_of(false, 10, 1), 0, "100,000 a second");
        let is_wanted = |policy| {
            let asking = std::thread::spawn(move || {
                let grant = realtime::apply(&realtime::RealtimeRequest {
                    policy,
                    ..Default::default()
                });
                (grant.is_complete(), RefusalBackoff::of_messages().is_wanted)
            });
            asking.join().unwrap()
        };
        assert_eq!(is_wanted(SchedulingPolicy::Other), (true, true));
        let (is_granted, is_wanted) = is_wanted(SchedulingPolicy::Fifo { priority: 1 });
        assert_eq!(
            is_wanted, !is_granted,
            "what it is counts, not what it asked"
        );
    }

    #[test]
    fn what_was_refused_while_nobody_looked_is_of_any_age() {
        let mut refusal_backoff = RefusalBackoff::new(true);
        let at = |us: i64| Instant::from_ns(us * 1000);
        assert_eq!(refusal_backoff.until(at(0), 0), None);
        assert_eq!(
            refusal_backoff.until(at(5_000), 12),
            None,
            "as after a spin"
        );
        assert_eq!(refusal_backoff.until(at(5_010), 20), Some(at(5_060)));
        assert_eq!(refusal_backoff.until(at(5_020), 20), None, "nothing new");
        assert_eq!(
            refusal_backoff.until(at(50_000), 21),
            None,
            "long after a flood"
        );
        assert_eq!(refusal_backoff.until(at(50_010), 22), None);
    }
}
