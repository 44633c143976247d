//! Predicts when the next message of a periodic channel arrives, so that a waiting thread can
//! sleep until shortly before and spin only then. It waits for nothing itself.

use core::time::Duration;

use crate::time::{Instant, duration_ns};

/// Intervals whose median is the period. Odd, and long enough that a third of them may be
/// multiples (losses) or fractions (bursts).
const WINDOW: usize = 15;

/// Intervals before the first prediction.
const WARM_UP: usize = 3;

/// Weight of a new arrival in the phase: jitter of successive arrivals averages out over about
/// eight of them.
const PHASE_SHIFT: u32 = 3;

/// Weight of a new error in the deviation, as in RFC 6298 (beta = 1/4).
const DEVIATION_SHIFT: u32 = 2;

/// Successive arrivals far off the expected instant that prove a new phase.
const STEP_COUNT: u32 = 3;

/// Learns period and phase from arrivals; robust to loss, jitter and phase steps. All state is
/// inline, so it may be used on the measured path.
///
/// ```
/// use core::time::Duration;
/// use hil_models::{arrival::ArrivalPredictor, time::Instant};
///
/// let mut predictor = ArrivalPredictor::default();
/// for index in 0..10 {
///     predictor.arrived(Instant::from_ns(index * 1_000_000));
/// }
/// assert_eq!(predictor.next_expected(), Some(Instant::from_ns(10_000_000)));
/// let spin_from = predictor.spin_from(Duration::from_micros(90));
/// assert_eq!(spin_from, Some(Instant::from_ns(9_910_000)));
/// ```
#[derive(Debug, Clone, Default)]
pub struct ArrivalPredictor {
    intervals_ns: [i64; WINDOW],
    interval_count: usize,
    period_ns: i64,
    last_ns: Option<i64>,
    /// Where the latest grid point of the learnt phase lies; follows arrivals slowly.
    phase_ns: i64,
    deviation_ns: i64,
    far_off_count: u32,
}

impl ArrivalPredictor {
    /// Learns from an arrival. Instants must not decrease; one that does is ignored.
    pub fn arrived(&mut self, now: Instant) {
        let now_ns = now.as_ns();
        let Some(last_ns) = self.last_ns.replace(now_ns) else {
            self.phase_ns = now_ns;
            return;
        };
        if now_ns < last_ns {
            self.last_ns = Some(last_ns);
            return;
        }
        self.intervals_ns[self.interval_count % WINDOW] = now_ns - last_ns;
        self.interval_count += 1;
        self.period_ns = self.median_interval_ns();
        if self.period_ns > 0 {
            self.follow(now_ns);
        }
    }

    /// When the next message is due after the latest arrival; `None` before the period is known.
    pub fn next_expected(&self) -> Option<Instant> {
        let last_ns = self.last_ns?;
        if self.interval_count < WARM_UP || self.period_ns <= 0 {
            return None;
        }
        // The arrival itself belongs to the nearest grid point, which may lie after it.
        let steps = nearest(last_ns.saturating_sub(self.phase_ns), self.period_ns) + 1;
        let ahead_ns = self.period_ns.saturating_mul(steps);
        Some(Instant::from_ns(self.phase_ns.saturating_add(ahead_ns)))
    }

    /// When to stop sleeping and start spinning: `lead` before [`Self::next_expected`].
    pub fn spin_from(&self, lead: Duration) -> Option<Instant> {
        let expected_ns = self.next_expected()?.as_ns();
        Some(Instant::from_ns(
            expected_ns.saturating_sub(duration_ns(lead)),
        ))
    }

    /// The first due instant at or after `now`: after a loss, the grid goes on.
    pub fn next_expected_after(&self, now: Instant) -> Option<Instant> {
        let expected = self.next_expected()?;
        let overdue_ns = now.ns_since(expected);
        if overdue_ns <= 0 {
            return Some(expected);
        }
        let steps = overdue_ns / self.period_ns + i64::from(overdue_ns % self.period_ns != 0);
        let ahead_ns = self.period_ns.saturating_mul(steps);
        Some(Instant::from_ns(expected.as_ns().saturating_add(ahead_ns)))
    }

    /// The learnt period; `None` before it is known.
    pub fn period(&self) -> Option<Duration> {
        self.next_expected()?;
        Some(Duration::from_nanos(self.period_ns.unsigned_abs()))
    }

    /// Smoothed distance of arrivals from their prediction: a lead of a few of these catches
    /// most early messages.
    pub fn deviation(&self) -> Duration {
        Duration::from_nanos(self.deviation_ns.unsigned_abs())
    }

    /// Moves the phase towards an arrival, or onto it when several in a row were far off.
    fn follow(&mut self, now_ns: i64) {
        let steps = nearest(now_ns.saturating_sub(self.phase_ns), self.period_ns);
        let ahead_ns = self.period_ns.saturating_mul(steps);
        let expected_ns = self.phase_ns.saturating_add(ahead_ns);
        let error_ns = now_ns.saturating_sub(expected_ns);
        let is_far_off = error_ns.abs() > self.period_ns / 8;
        self.far_off_count = if is_far_off {
            self.far_off_count + 1
        } else {
            0
        };
        if self.interval_count <= WARM_UP || self.far_off_count >= STEP_COUNT {
            self.phase_ns = now_ns;
            self.far_off_count = 0;
            return;
        }
        // A far-off arrival is an outlier until it repeats; let it move the phase no further
        // than a large regular error would.
        let limit_ns = self.period_ns / 8;
        let correction_ns = error_ns.clamp(-limit_ns, limit_ns) >> PHASE_SHIFT;
        self.phase_ns = expected_ns.saturating_add(correction_ns);
        self.deviation_ns += (error_ns.abs().min(limit_ns) - self.deviation_ns) >> DEVIATION_SHIFT;
    }

    fn median_interval_ns(&self) -> i64 {
        let count = self.interval_count.min(WINDOW);
        let mut sorted = self.intervals_ns;
        let known = &mut sorted[..count];
        known.sort_unstable();
        known[count / 2]
    }
}

/// `distance / period`, rounded to the nearest whole number.
const fn nearest(distance_ns: i64, period_ns: i64) -> i64 {
    distance_ns
        .saturating_add(period_ns / 2)
        .div_euclid(period_ns)
}
