//! Predicts when the next message of a periodic channel arrives, so that a waiting thread can
//! sleep until shortly before and spin only then. It waits for nothing itself.

use core::time::Duration;

use crate::time::Instant;

/// Intervals whose lower quartile chooses the period: up to two thirds of them may be multiples
/// of it (losses) and up to a fifth fractions (bursts after a delay).
const WINDOW: usize = 15;

/// Intervals before the first prediction.
const WARM_UP: usize = 3;

/// Weight of a new error in the phase: jitter averages out over about eight arrivals.
const PHASE_SHIFT: u32 = 3;

/// Weight of a new error in the period. With phase weight `a`, `a * a / (2 - a)` damps an
/// alpha-beta tracker critically (Benedict and Bordner 1962); for 1/8 that is close to 1/128.
const PERIOD_SHIFT: u32 = 7;

/// The period is tracked in 1/256 ns: a shifted error is often below one nanosecond.
const FRACTION: i64 = 256;

/// Successive arrivals far off the expected instant that prove a new phase.
const STEP_COUNT: u32 = 3;

/// Learns period and phase from arrivals; robust to loss, jitter and phase steps. All state is
/// inline, so it may be used on the measured path.
///
/// ```
/// use hil_core::{arrival::ArrivalPredictor, time::Instant};
///
/// let mut predictor = ArrivalPredictor::default();
/// for index in 0..10 {
///     predictor.arrived(Instant::from_ns(index * 1_000_000));
/// }
/// assert_eq!(predictor.next_expected(), Some(Instant::from_ns(10_000_000)));
/// ```
#[derive(Debug, Clone, Default)]
pub struct ArrivalPredictor {
    intervals_ns: [i64; WINDOW],
    interval_count: usize,
    /// The tracked period times [`FRACTION`]; 0 before it is known.
    period_fractions: i64,
    last_ns: Option<i64>,
    /// Where the latest grid point of the learnt phase lies; follows arrivals slowly.
    phase_ns: i64,
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
        self.intervals_ns[self.interval_count % WINDOW] = now_ns.saturating_sub(last_ns);
        self.interval_count += 1;
        // The quartile is robust but coarse: it chooses the period, the tracker refines it.
        let typical_ns = self.typical_interval_ns();
        let is_new = (typical_ns - self.period_ns()).abs() > typical_ns / 3;
        if is_new || self.interval_count <= WARM_UP || typical_ns == 0 {
            self.lock(now_ns, typical_ns);
        } else {
            self.follow(now_ns, typical_ns);
        }
    }

    /// When the next message is due after the latest arrival; `None` before the period is known.
    pub fn next_expected(&self) -> Option<Instant> {
        let last_ns = self.last_ns?;
        if self.interval_count < WARM_UP || self.period_ns() <= 0 {
            return None;
        }
        // The arrival itself belongs to the nearest grid point, which may lie after it.
        let steps = nearest(last_ns.saturating_sub(self.phase_ns), self.period_ns()) + 1;
        let ahead_ns = self.ahead_ns(steps);
        Some(Instant::from_ns(self.phase_ns.saturating_add(ahead_ns)))
    }

    /// The first due instant at or after `now`: after a loss, the grid goes on.
    pub fn next_expected_after(&self, now: Instant) -> Option<Instant> {
        let expected = self.next_expected()?;
        let overdue_ns = now.ns_since(expected);
        if overdue_ns <= 0 {
            return Some(expected);
        }
        let period_ns = self.period_ns();
        let steps = overdue_ns / period_ns + i64::from(overdue_ns % period_ns != 0);
        let ahead_ns = self.ahead_ns(steps);
        Some(Instant::from_ns(expected.as_ns().saturating_add(ahead_ns)))
    }

    /// The learnt period; `None` before it is known.
    pub fn period(&self) -> Option<Duration> {
        self.next_expected()?;
        Some(Duration::from_nanos(self.period_ns().unsigned_abs()))
    }

    fn lock(&mut self, now_ns: i64, period_ns: i64) {
        self.period_fractions = period_ns.saturating_mul(FRACTION);
        self.phase_ns = now_ns;
        self.far_off_count = 0;
    }

    /// Moves phase and period towards an arrival, or starts anew from it when several in a row
    /// were far off.
    fn follow(&mut self, now_ns: i64, typical_ns: i64) {
        let period_ns = self.period_ns();
        let steps = nearest(now_ns.saturating_sub(self.phase_ns), period_ns);
        let expected_ns = self.phase_ns.saturating_add(self.ahead_ns(steps));
        let error_ns = now_ns.saturating_sub(expected_ns);
        let limit_ns = period_ns / 8;
        if error_ns.abs() <= limit_ns {
            self.far_off_count = 0;
            let period_error = error_ns.saturating_mul(FRACTION) / steps.max(1);
            self.period_fractions += period_error >> PERIOD_SHIFT;
        } else {
            self.far_off_count += 1;
        }
        if self.far_off_count >= STEP_COUNT {
            self.lock(now_ns, typical_ns);
            return;
        }
        // A far-off arrival is an outlier until it repeats; it moves the phase no further than
        // the largest regular error would.
        let correction_ns = error_ns.clamp(-limit_ns, limit_ns) >> PHASE_SHIFT;
        self.phase_ns = expected_ns.saturating_add(correction_ns);
    }

    const fn period_ns(&self) -> i64 {
        self.period_fractions / FRACTION
    }

    /// So many periods.
    const fn ahead_ns(&self, steps: i64) -> i64 {
        self.period_fractions.saturating_mul(steps) / FRACTION
    }

    fn typical_interval_ns(&self) -> i64 {
        let count = self.interval_count.min(WINDOW);
        let mut sorted = self.intervals_ns;
        let known = &mut sorted[..count];
        known.sort_unstable();
        known[count / 4]
    }
}

/// `distance / period`, rounded to the nearest whole number.
const fn nearest(distance_ns: i64, period_ns: i64) -> i64 {
    distance_ns
        .saturating_add(period_ns / 2)
        .div_euclid(period_ns)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::RandomStream;

    const PERIOD_NS: i64 = 1_000_000;

    fn learnt(count: i64) -> ArrivalPredictor {
        let mut predictor = ArrivalPredictor::default();
        for index in 0..count {
            predictor.arrived(Instant::from_ns(index * PERIOD_NS));
        }
        predictor
    }

    /// Feeds arrivals of a lossy, jittery channel; returns the share of arrivals after the
    /// warm-up that came within `lead` before and the same after their expected instant.
    fn hit_ratio(loss_ratio: f64, jitter_ns: f64, lead_ns: i64) -> f64 {
        let mut stream = RandomStream::new(11, "arrivals");
        let mut predictor = ArrivalPredictor::default();
        let (mut hits, mut counted) = (0, 0);
        for index in 0..20_000_i64 {
            if stream.chance(loss_ratio) {
                continue;
            }
            #[allow(clippy::cast_possible_truncation, reason = "jitter is below 10^6")]
            let jitter = (jitter_ns * stream.normal()).clamp(-4e5, 4e5) as i64;
            let now = Instant::from_ns(1_000_000 + index * PERIOD_NS + jitter);
            if index > 100 {
                let expected = predictor
                    .next_expected_after(Instant::from_ns(now.as_ns() - PERIOD_NS / 2))
                    .unwrap();
                counted += 1;
                hits += i32::from(now.ns_since(expected).abs() <= lead_ns);
            }
            predictor.arrived(now);
        }
        f64::from(hits) / f64::from(counted)
    }

    #[test]
    fn a_regular_channel_is_predicted_to_the_nanosecond() {
        let predictor = learnt(50);
        assert_eq!(
            predictor.next_expected(),
            Some(Instant::from_ns(50 * PERIOD_NS))
        );
        assert_eq!(predictor.period(), Some(Duration::from_millis(1)));
        let late = Instant::from_ns(52 * PERIOD_NS + 1);
        let next = Instant::from_ns(53 * PERIOD_NS);
        assert_eq!(predictor.next_expected_after(late), Some(next));
    }

    #[test]
    fn nothing_is_predicted_before_the_period_is_known() {
        for count in 0..=3 {
            let predictor = learnt(count);
            assert_eq!(predictor.next_expected(), None, "{count} arrivals");
            assert_eq!(predictor.period(), None);
        }
        assert!(learnt(4).next_expected().is_some());
    }

    #[test]
    fn jitter_and_loss_leave_most_arrivals_within_the_lead() {
        let (clean, lossy, both) = (
            hit_ratio(0.0, 20e3, 90_000),
            hit_ratio(0.3, 0.0, 1_000),
            hit_ratio(0.3, 20e3, 90_000),
        );
        assert!(clean > 0.99, "jitter alone: {clean}");
        assert!(lossy > 0.99, "loss alone: {lossy}");
        assert!(both > 0.98, "jitter and loss: {both}");
    }

    #[test]
    fn a_lost_message_does_not_move_the_prediction() {
        let mut predictor = learnt(50);
        predictor.arrived(Instant::from_ns(52 * PERIOD_NS));
        assert_eq!(
            predictor.next_expected(),
            Some(Instant::from_ns(53 * PERIOD_NS))
        );
    }

    #[test]
    fn a_phase_step_is_followed_after_a_few_arrivals() {
        let mut predictor = learnt(50);
        let step_ns = 400_000;
        for index in 50..54 {
            predictor.arrived(Instant::from_ns(index * PERIOD_NS + step_ns));
        }
        let expected = predictor.next_expected().unwrap();
        assert_eq!(expected, Instant::from_ns(54 * PERIOD_NS + step_ns));
    }

    #[test]
    fn one_late_arrival_moves_the_prediction_little() {
        let mut predictor = learnt(50);
        predictor.arrived(Instant::from_ns(50 * PERIOD_NS + 300_000));
        let expected = predictor.next_expected().unwrap();
        let error_ns = expected.ns_since(Instant::from_ns(51 * PERIOD_NS));
        assert!((0..20_000).contains(&error_ns), "{error_ns} ns");
    }

    #[test]
    fn a_new_period_is_learnt_within_one_window() {
        let mut predictor = learnt(50);
        for index in 1..=20 {
            predictor.arrived(Instant::from_ns(49 * PERIOD_NS + index * 4 * PERIOD_NS));
        }
        assert_eq!(predictor.period(), Some(Duration::from_millis(4)));
        let expected = Instant::from_ns((49 + 84) * PERIOD_NS);
        assert_eq!(predictor.next_expected(), Some(expected));
    }

    #[test]
    fn a_period_that_changes_by_a_third_is_learnt_too() {
        let mut predictor = learnt(50);
        let start_ns = 49 * PERIOD_NS;
        for index in 1..=40 {
            predictor.arrived(Instant::from_ns(start_ns + index * 1_300_000));
        }
        let expected = Instant::from_ns(start_ns + 41 * 1_300_000);
        assert_eq!(predictor.next_expected(), Some(expected));
    }

    #[test]
    fn a_slightly_wrong_clock_is_followed() {
        // 200 ppm: the sender's clock runs slow.
        let mut predictor = ArrivalPredictor::default();
        for index in 0..5_000 {
            let now = Instant::from_ns(index * (PERIOD_NS + 200));
            if let Some(expected) = predictor.next_expected() {
                assert!(now.ns_since(expected).abs() < 5_000, "arrival {index}");
            }
            predictor.arrived(now);
        }
    }

    #[test]
    fn equal_and_decreasing_instants_are_harmless() {
        let mut predictor = ArrivalPredictor::default();
        for now_ns in [5, 5, 5, 5, 5, 3, i64::MAX, i64::MIN, i64::MAX] {
            predictor.arrived(Instant::from_ns(now_ns));
        }
        let _ = predictor.next_expected_after(Instant::from_ns(i64::MAX));
    }
}
