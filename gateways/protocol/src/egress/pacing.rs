//! How many pieces of long messages may be under way. Where they would queue, at the slowest hop or at the
//! receiver, the messages of other channels would wait behind them and be lost when the queue overflows. The
//! receiver acknowledges every [`ACKNOWLEDGED_EVERY`]th piece, and the window of pieces that are not acknowledged
//! follows TCP Vegas (Brakmo, O'Malley, Peterson: TCP Vegas, SIGCOMM 1994, section 3.2): by the round trip
//! times it estimates how many of them wait in a queue, and keeps these between two bounds.

use core::time::Duration;
use std::collections::VecDeque;

use hil_core::time::Instant;

use super::STAGED_BYTES_MAX;
use crate::ingress::REASSEMBLY_TIMEOUT;
use crate::refusal::Refusal;
use crate::wire::Header;

/// Pieces from one acknowledged to the next.
const ACKNOWLEDGED_EVERY: u16 = 16;
/// Vegas' alpha: with fewer pieces in queues the window grows.
const QUEUED_MIN: f64 = 16.0;
/// Vegas' beta: with more it shrinks. So many datagrams fit into the receive buffer that Linux gives by default.
const QUEUED_MAX: f64 = 32.0;
const WINDOW_MIN: u64 = 32;
/// 5 MB in datagrams of Ethernet.
const WINDOW_MAX: u64 = 4_096;
/// A window of these, and some that stayed out.
const AWAITED_MAX: usize = 300;
/// The shortest round trip is that of the last one to two periods: routes change.
const BASE_PERIOD: Duration = Duration::from_secs(5);
/// A larger share of pieces lost in a round is a queue that overflows without being seen in round trips.
const LOST_RATIO_MAX: f64 = 0.05;
/// Without an acknowledgement for so long and four round trips, what is under way counts as lost.
const PATIENCE: Duration = Duration::from_millis(20);
/// But not for longer, unless a round trip takes longer: the receiver gives a message up in the end.
const PATIENCE_MAX: Duration = Duration::from_millis(400);
const _: () = assert!(PATIENCE_MAX.as_millis() < REASSEMBLY_TIMEOUT.as_millis() / 2);
/// The same before the first round trip is known.
const PATIENCE_AT_FIRST: Duration = Duration::from_millis(200);
const ROUND_TRIPS_OF_PATIENCE: u32 = 4;
/// A window is spread over this share of the shortest round trip, so that it does not queue as a whole.
const SPREAD: f64 = 0.95;
/// And is at most so far ahead of that: a sleep is no shorter.
const AHEAD: Duration = Duration::from_micros(200);

/// Whether the receiver acknowledges the piece with `header`.
pub(crate) const fn is_acknowledged(header: &Header) -> bool {
    let is_last = header.fragment_index + 1 == header.fragment_count;
    let is_due = header.fragment_index % ACKNOWLEDGED_EVERY == ACKNOWLEDGED_EVERY - 1;
    header.total_len as usize > STAGED_BYTES_MAX && (is_due || is_last)
}

/// The window. Pieces are counted over all messages.
#[derive(Debug)]
pub(super) struct Pacing {
    window: u64,
    sent: u64,
    acknowledged: u64,
    /// `handed_ns` of pieces that will be acknowledged, and how many were sent with them.
    awaited: VecDeque<Awaited>,
    /// The shortest round trip of this period and of the one before.
    base_ns: [Option<i64>; 2],
    base_began: Instant,
    /// Nothing is sent until all is acknowledged: a round trip through empty queues is to be seen.
    is_draining: bool,
    /// The window doubles each round until queues are seen.
    is_starting: bool,
    round: Round,
    last_round_trip: Option<Duration>,
    /// When the next piece is to leave.
    due: Instant,
    /// Of the last acknowledgement, or of what was sent when nothing was under way.
    moved_at: Instant,
    sent_at: Instant,
}

#[derive(Debug)]
struct Awaited {
    handed_ns: i64,
    count: u64,
    /// Pieces that were under way with it.
    under_way: u64,
}

/// The pieces of one window.
#[derive(Debug, Default)]
struct Round {
    /// It ends with the acknowledgement of this piece.
    end: u64,
    /// Pieces that waited in queues, by each acknowledgement, summed up.
    queued: f64,
    under_way_max: u64,
    acknowledged: u32,
    /// Acknowledgements that did not come while a later one did.
    skipped: u32,
    /// The window held pieces back.
    was_full: bool,
}

impl Pacing {
    pub(super) fn new() -> Self {
        Self {
            window: WINDOW_MIN,
            sent: 0,
            acknowledged: 0,
            awaited: VecDeque::with_capacity(AWAITED_MAX),
            base_ns: [None; 2],
            base_began: Instant::ZERO,
            is_draining: false,
            is_starting: true,
            round: Round::default(),
            last_round_trip: None,
            due: Instant::ZERO,
            moved_at: Instant::ZERO,
            sent_at: Instant::ZERO,
        }
    }

    /// Until when the next piece waits unless an acknowledgement comes before; `None` when it may leave.
    pub(super) fn held_until(&mut self, now: Instant) -> Option<Instant> {
        let is_full = self.sent - self.acknowledged >= self.window;
        self.round.was_full |= is_full;
        if is_full || self.is_draining {
            return Some(self.patience_ends());
        }
        (now + AHEAD < self.due).then_some(self.due)
    }

    /// Whether an acknowledgement is what the next piece waits for.
    pub(super) fn awaits_acknowledgement(&self) -> bool {
        self.sent - self.acknowledged >= self.window || self.is_draining
    }

    /// Whether nothing was acknowledged for too long; then call [`Pacing::on_silence`].
    pub(super) fn is_silent(&self, now: Instant) -> bool {
        self.awaits_acknowledgement() && now >= self.patience_ends()
    }

    fn patience_ends(&self) -> Instant {
        let patience = match self.last_round_trip {
            Some(last) => {
                let longest = PATIENCE_MAX.max(last + last / 2);
                (PATIENCE + last * ROUND_TRIPS_OF_PATIENCE).min(longest)
            }
            None => PATIENCE_AT_FIRST,
        };
        self.moved_at + patience
    }

    /// What is under way counts as lost.
    pub(super) fn on_silence(&mut self, now: Instant) {
        self.acknowledged = self.sent;
        self.window = (self.window / 2).max(WINDOW_MIN);
        self.is_starting &= self.last_round_trip.is_none();
        self.is_draining = false;
        self.moved_at = now;
    }

    /// A piece has left.
    pub(super) fn on_sent(&mut self, header: &Header) {
        let handed = Instant::from_ns(header.handed_ns);
        if handed >= self.patience_ends() && handed >= self.sent_at + PATIENCE {
            // The rest of an earlier message holds nothing back.
            self.acknowledged = self.sent;
        }
        if self.acknowledged == self.sent {
            self.moved_at = handed;
        }
        self.sent_at = handed;
        self.due = self.due.max(handed) + self.spacing();
        self.sent += 1;
        if is_acknowledged(header) {
            if self.awaited.len() == AWAITED_MAX {
                self.awaited.pop_front();
            }
            self.awaited.push_back(Awaited {
                handed_ns: handed.as_ns(),
                count: self.sent,
                under_way: self.sent - self.acknowledged,
            });
        }
    }

    /// The piece handed over at `answers_handed_ns` has arrived.
    ///
    /// # Errors
    /// [`Refusal::Unsolicited`] when none is awaited.
    #[expect(
        clippy::cast_precision_loss,
        reason = "a window has 4,096 pieces at most, a round trip far less than a day"
    )]
    pub(super) fn on_acknowledged(
        &mut self,
        now: Instant,
        answers_handed_ns: i64,
    ) -> Result<(), Refusal> {
        let awaited = |one: &Awaited| one.handed_ns == answers_handed_ns;
        let index = self.awaited.iter().position(awaited);
        let index = index.ok_or(Refusal::Unsolicited)?;
        let round_trip_ns = now.as_ns() - answers_handed_ns;
        if round_trip_ns < 0 {
            return Err(Refusal::ImplausibleStamp);
        }
        let Awaited {
            count, under_way, ..
        } = self.awaited[index];
        self.awaited.drain(..=index);
        self.acknowledged = self.acknowledged.max(count);
        self.moved_at = now;
        self.last_round_trip = Some(Duration::from_nanos(round_trip_ns.unsigned_abs()));
        self.note_base(now, round_trip_ns);
        let base_ns = self.base_ns().unwrap_or(round_trip_ns);
        let waited = (round_trip_ns - base_ns) as f64 / round_trip_ns.max(1) as f64;
        let round = &mut self.round;
        round.queued += under_way as f64 * waited;
        round.under_way_max = round.under_way_max.max(under_way);
        round.acknowledged += 1;
        round.skipped += u32::try_from(index).unwrap_or(u32::MAX);
        self.is_draining &= !self.awaited.is_empty();
        if count >= self.round.end {
            self.end_round();
        }
        Ok(())
    }

    fn base_ns(&self) -> Option<i64> {
        self.base_ns.into_iter().flatten().min()
    }

    /// From one piece to the next.
    #[expect(
        clippy::cast_precision_loss,
        reason = "a round trip is far below 100 days"
    )]
    fn spacing(&self) -> Duration {
        let base_ns = self.base_ns().unwrap_or(0) as f64;
        Duration::from_secs_f64(SPREAD * base_ns / self.window as f64 / 1e9)
    }

    fn note_base(&mut self, now: Instant, round_trip_ns: i64) {
        if now >= self.base_began + BASE_PERIOD {
            self.is_draining = self.base_ns[0].is_some();
            self.base_ns = [None, self.base_ns[0]];
            self.base_began = now;
        }
        let own = &mut self.base_ns[0];
        *own = Some(own.map_or(round_trip_ns, |known| known.min(round_trip_ns)));
    }

    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a window has 4,096 pieces at most, a round trip far less than a day"
    )]
    fn end_round(&mut self) {
        let round = core::mem::take(&mut self.round);
        self.round.end = self.sent;
        let queued = round.queued / f64::from(round.acknowledged.max(1));
        let all = round.acknowledged.saturating_add(round.skipped);
        let lost_ratio = f64::from(round.skipped) / f64::from(all.max(1));
        // Of a window that was not used as a whole, what was is what made the queue.
        let used = self.window.min(round.under_way_max.max(WINDOW_MIN));
        if lost_ratio > LOST_RATIO_MAX {
            self.is_starting = false;
            self.window = used - used / 4;
        } else if queued > QUEUED_MAX {
            self.is_starting = false;
            // Never more than by half: a receiver that stood still is no full queue.
            self.window = used - ((queued - QUEUED_MAX) as u64).min(used / 2);
        } else if queued > QUEUED_MIN {
            self.is_starting = false;
        } else if !round.was_full {
            return;
        } else if self.is_starting {
            self.window *= 2;
        } else {
            self.window += u64::from(ACKNOWLEDGED_EVERY);
        }
        self.window = self.window.clamp(WINDOW_MIN, WINDOW_MAX);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::Kind;
    use hil_core::random::RandomStream;

    /// A hop with one queue, and the messages that it is to carry.
    #[derive(Clone, Copy)]
    struct Hop {
        one_way_ns: i64,
        /// For each piece, at the slowest place.
        service_ns: i64,
        /// The same from the middle of the time on.
        service_later_ns: i64,
        loss_ratio: f64,
        /// Pieces that have room in the queue.
        buffer: i64,
        /// Pieces of a message, and from one message to the next.
        pieces: u32,
        period_ns: i64,
    }

    impl Default for Hop {
        fn default() -> Self {
            Self {
                one_way_ns: 500_000,
                service_ns: 12_000,
                service_later_ns: 12_000,
                loss_ratio: 0.0,
                buffer: i64::MAX,
                pieces: 16_000,
                period_ns: 0,
            }
        }
    }

    #[derive(Debug)]
    struct Seen {
        /// Share of the slowest place's rate.
        utilization: f64,
        /// Pieces in the queue at most, in the last quarter of the time.
        queued_max: i64,
        /// Share of pieces without room in the last quarter.
        dropped_ratio: f64,
        silence_count: u32,
    }

    impl Hop {
        fn send(&self, seconds: i64) -> Seen {
            let mut random = RandomStream::new(1, "pieces");
            let mut pacing = Pacing::new();
            let end_ns = seconds * 1_000_000_000;
            let (mut now_ns, mut free_ns, mut sequence) = (0, 0, 0_u32);
            let (mut late_count, mut late_dropped) = (0_u32, 0_u32);
            let mut answers = VecDeque::new();
            let mut seen = Seen {
                utilization: 0.0,
                queued_max: 0,
                dropped_ratio: 0.0,
                silence_count: 0,
            };
            while now_ns < end_ns {
                let now = Instant::from_ns(now_ns);
                while let Some(&(at_ns, handed_ns)) = answers.front()
                    && at_ns <= now_ns
                {
                    answers.pop_front();
                    pacing.on_acknowledged(now, handed_ns).unwrap();
                }
                let message = i64::from(sequence / self.pieces);
                if message * self.period_ns > now_ns {
                    let answer = answers.front().map_or(i64::MAX, |&(at_ns, _)| at_ns);
                    now_ns = answer.min(message * self.period_ns);
                    continue;
                }
                if pacing.is_silent(now) {
                    pacing.on_silence(now);
                    seen.silence_count += 1;
                }
                if let Some(until) = pacing.held_until(now) {
                    let until = until.as_ns();
                    let answer = answers.front().map_or(until, |&(at_ns, _)| at_ns);
                    now_ns = until.min(answer);
                    continue;
                }
                let mut header = Header::new(Kind::Data, 1, 1);
                header.total_len = 16 << 20;
                header.fragment_count = u16::try_from(self.pieces).unwrap();
                header.fragment_index = u16::try_from(sequence % self.pieces).unwrap();
                header.handed_ns = now_ns;
                pacing.on_sent(&header);
                sequence += 1;
                let service_ns = if now_ns < end_ns / 2 {
                    self.service_ns
                } else {
                    self.service_later_ns
                };
                let arrives_ns = now_ns + self.one_way_ns;
                let queued = (free_ns - arrives_ns).max(0) / service_ns;
                let is_late = now_ns > end_ns / 4 * 3;
                if is_late {
                    late_count += 1;
                    late_dropped += u32::from(queued >= self.buffer);
                    seen.queued_max = seen.queued_max.max(queued);
                }
                if queued < self.buffer && random.uniform() >= self.loss_ratio {
                    free_ns = free_ns.max(arrives_ns) + service_ns;
                    if is_acknowledged(&header) {
                        answers.push_back((free_ns + self.one_way_ns, now_ns));
                    }
                }
                now_ns += 1_000;
            }
            seen.utilization = f64::from(sequence) * self.service_ns as f64 / end_ns as f64;
            seen.dropped_ratio = f64::from(late_dropped) / f64::from(late_count.max(1));
            seen
        }
    }

    #[test]
    fn no_more_pieces_queue_than_small_messages_can_wait_for_and_the_path_is_used() {
        for one_way_ns in [20_000, 500_000, 5_000_000, 25_000_000] {
            for service_ns in [5_000, 12_000, 120_000] {
                let hop = Hop {
                    one_way_ns,
                    service_ns,
                    service_later_ns: service_ns,
                    ..Hop::default()
                };
                let seen = hop.send(12);
                let what = format!("{one_way_ns} ns there, {service_ns} ns a piece: {seen:?}");
                assert_eq!(seen.silence_count, 0, "{what}");
                // The largest window may be less than what fits on the path.
                let pipe = 2.0 * one_way_ns as f64 / service_ns as f64;
                let possible = (WINDOW_MAX as f64 / pipe).min(1.0);
                assert!(seen.queued_max as f64 <= 64.0 + 0.08 * pipe, "{what}");
                assert!(seen.utilization > 0.8 * possible, "{what}");
            }
        }
    }

    #[test]
    fn a_window_that_has_become_too_large_shrinks_also_where_messages_are_shorter() {
        let hop = Hop {
            one_way_ns: 10_000_000,
            service_later_ns: 120_000,
            pieces: 740,
            period_ns: 100_000_000,
            ..Hop::default()
        };
        let seen = hop.send(60);
        assert!(seen.queued_max < 150, "{seen:?}");
    }

    #[test]
    fn a_shallow_queue_is_not_overrun_for_good() {
        for buffer in [14, 40] {
            let hop = Hop {
                one_way_ns: 5_000_000,
                service_ns: 120_000,
                service_later_ns: 120_000,
                buffer,
                pieces: 740,
                period_ns: 200_000_000,
                ..Hop::default()
            };
            let seen = hop.send(40);
            assert!(seen.dropped_ratio < 0.1, "{buffer}: {seen:?}");
        }
    }

    #[test]
    fn losses_hold_nothing_up_for_good() {
        let hop = Hop {
            loss_ratio: 0.01,
            ..Hop::default()
        };
        let seen = hop.send(10);
        assert!(seen.utilization > 0.5, "{seen:?}");
        let dead = Hop {
            loss_ratio: 1.0,
            ..hop
        };
        // Nothing comes back: a window each 200 ms.
        let seen = dead.send(10);
        assert!((45..=50).contains(&seen.silence_count), "{seen:?}");
    }

    #[test]
    fn silence_lasts_no_longer_than_the_receiver_waits() {
        let mut pacing = Pacing::new();
        for (round_trip_ms, longest_ms) in [(1, 24), (100, 400), (600, 900)] {
            pacing.last_round_trip = Some(Duration::from_millis(round_trip_ms));
            let ends = pacing.patience_ends().ns_since(pacing.moved_at);
            assert_eq!(ends, longest_ms * 1_000_000, "{round_trip_ms} ms");
        }
    }

    #[test]
    fn an_answer_to_nothing_is_refused() {
        let mut pacing = Pacing::new();
        let now = Instant::from_ns(5);
        let refused = Err(Refusal::Unsolicited);
        assert_eq!(pacing.on_acknowledged(now, 5), refused);
    }
}
