//! Contention for the medium: how long a frame defers to the other stations, and how often it
//! collides with one of them (EDCA, IEEE Std 802.11-2020, 10.23.2; Bianchi, "Performance analysis
//! of the IEEE 802.11 distributed coordination function", IEEE JSAC 18(3), 2000). It knows no
//! channel.
//!
//! As in Bianchi's model, time without us is a chain of virtual slots: an empty one of 9 µs, or one
//! in which another station begins, with the same probability in each. Busy periods are
//! exponential, so what is left of one when a frame arrives is again exponential. The probability is
//! the one that keeps the medium as busy as the link is told; at most it is that of the saturated
//! fixed point. The link's own frames do not make the others' slots busier.

use crate::wifi::phy::{SIFS_NS, SLOT_NS, nanoseconds};
use crate::wifi::spec::{AccessCategory, WifiSpec};
use hil_core::random::RandomStream;

/// How a category contends: the defaults of the EDCA Parameter Set element (802.11-2020,
/// 9.4.2.28) for stations.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Access {
    /// Arbitration inter-frame space.
    pub(crate) aifs_ns: i64,
    pub(crate) window_min: u32,
    pub(crate) window_max: u32,
}

impl Access {
    pub(crate) const fn of(category: AccessCategory) -> Self {
        let (number, window_min, window_max) = match category {
            AccessCategory::Background => (7, 15, 1023),
            AccessCategory::BestEffort => (3, 15, 1023),
            AccessCategory::Video => (2, 7, 15),
            AccessCategory::Voice => (2, 3, 7),
        };
        Self {
            aifs_ns: SIFS_NS + number * SLOT_NS,
            window_min,
            window_max,
        }
    }

    /// The window after one more failure.
    pub(crate) const fn widened(&self, window: u32) -> u32 {
        let wider = 2 * window + 1;
        if wider > self.window_max {
            self.window_max
        } else {
            wider
        }
    }
}

/// The category that the other stations are taken to use.
const OTHERS: Access = Access::of(AccessCategory::BestEffort);

/// The medium as the other stations leave it, and our way onto it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Contention {
    pub(crate) access: Access,
    /// Probability that another station begins in a slot.
    pub(crate) begin_ratio: f64,
    /// `ln(1 - begin_ratio)`, to skip empty slots.
    stay_log: f64,
    busy_ratio: f64,
    busy_mean_ns: f64,
}

impl Contention {
    pub(crate) fn new(spec: &WifiSpec) -> Self {
        let begin_ratio = begin_ratio(spec.busy_ratio, spec.busy_mean_us * 1e3);
        Self {
            access: Access::of(spec.access_category),
            begin_ratio,
            stay_log: (-begin_ratio).ln_1p(),
            busy_ratio: spec.busy_ratio,
            busy_mean_ns: spec.busy_mean_us * 1e3,
        }
    }

    /// True when there is nobody to defer to.
    fn is_free(&self) -> bool {
        self.begin_ratio <= 0.0
    }

    /// The time until a frame that found nothing before it may go on the air: at once on an idle
    /// medium, else after what is left of the busy period and a back-off.
    pub(crate) fn arrival_ns(&self, random: &mut RandomStream) -> i64 {
        if self.is_free() || !random.chance(self.busy_ratio) {
            return 0;
        }
        self.busy_ns(random) + self.backoff_ns(random, self.access.window_min)
    }

    /// Inter-frame space and a back-off from the window, with what others send meanwhile.
    pub(crate) fn backoff_ns(&self, random: &mut RandomStream, window: u32) -> i64 {
        let drawn = random.uniform() * (f64::from(window) + 1.0);
        let slots = nanoseconds(drawn.floor());
        let mut time_ns = self.access.aifs_ns + slots * SLOT_NS;
        if self.is_free() {
            return time_ns;
        }
        let mut left = slots;
        loop {
            // Empty slots until the next that another station takes.
            let empty = nanoseconds(((1.0 - random.uniform()).ln() / self.stay_log).floor());
            if empty >= left {
                return time_ns;
            }
            left -= empty + 1;
            time_ns += self.busy_ns(random) + self.access.aifs_ns - SLOT_NS;
        }
    }

    /// A busy period of the others.
    pub(crate) fn busy_ns(&self, random: &mut RandomStream) -> i64 {
        nanoseconds(-self.busy_mean_ns * (1.0 - random.uniform()).ln())
    }

    /// True when another station begins in the slot in which we do.
    pub(crate) fn collides(&self, random: &mut RandomStream) -> bool {
        !self.is_free() && random.chance(self.begin_ratio)
    }
}

/// The probability per slot that makes busy periods of `busy_ns` take up `busy_ratio` of the time:
/// each is followed by an inter-frame space, which counts as idle.
fn begin_ratio(busy_ratio: f64, busy_ns: f64) -> f64 {
    let idle_ns = busy_ns * (1.0 - busy_ratio) - busy_ratio * OTHERS.aifs_ns as f64;
    let odds = busy_ratio * SLOT_NS as f64 / idle_ns;
    if idle_ns > 0.0 {
        odds / (1.0 + odds)
    } else {
        1.0
    }
}

/// Share of the time that the stations of `spec` keep the medium busy when each always has a frame.
pub(crate) fn saturated_busy_ratio(spec: &WifiSpec) -> f64 {
    if spec.contender_count == 0 {
        return 0.0;
    }
    let (attempt, _) = fixed_point(&OTHERS, spec.contender_count);
    let begin = 1.0 - (1.0 - attempt).powf(f64::from(spec.contender_count));
    let busy_ns = spec.busy_mean_us * 1e3;
    let slot_ns = begin * (busy_ns + OTHERS.aifs_ns as f64) + (1.0 - begin) * SLOT_NS as f64;
    begin * busy_ns / slot_ns
}

/// Bianchi's fixed point for `count` saturated stations: the probability that one of them begins in
/// a slot, and that it collides when it does.
pub(crate) fn fixed_point(access: &Access, count: u32) -> (f64, f64) {
    let others = f64::from(count.saturating_sub(1));
    let (mut low, mut high) = (0.0, 1.0);
    // The collision probability that an attempt probability makes falls as the one assumed rises.
    for _ in 0..60 {
        let assumed = 0.5 * (low + high);
        let made = 1.0 - (1.0 - attempt_ratio(access, assumed)).powf(others);
        if made > assumed {
            low = assumed;
        } else {
            high = assumed;
        }
    }
    let collision = 0.5 * (low + high);
    (attempt_ratio(access, collision), collision)
}

/// Bianchi's equation (7), with the sum written out: it has no gap at one half.
fn attempt_ratio(access: &Access, collision: f64) -> f64 {
    let window = f64::from(access.window_min) + 1.0;
    let stages = ((f64::from(access.window_max) + 1.0) / window)
        .log2()
        .round();
    let (mut sum, mut term) = (0.0, 1.0);
    for _ in 0..nanoseconds(stages) {
        sum += term;
        term *= 2.0 * collision;
    }
    2.0 / (1.0 + window + collision * window * sum)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// So many saturated stations, slot by slot: attempts per station and slot, and the share of
    /// attempts that collide.
    fn slotted(access: &Access, count: usize, slots: u32, seed: u64) -> (f64, f64) {
        let mut random = RandomStream::new(seed, "slots");
        let mut draw =
            |window: u32| nanoseconds((random.uniform() * (f64::from(window) + 1.0)).floor());
        let mut stations: Vec<_> = (0..count)
            .map(|_| (access.window_min, draw(access.window_min)))
            .collect();
        let (mut attempts, mut collisions) = (0.0, 0.0);
        for _ in 0..slots {
            let ready = stations.iter().filter(|(_, left)| *left == 0).count();
            for (window, left) in &mut stations {
                if *left > 0 {
                    *left -= 1;
                    continue;
                }
                attempts += 1.0;
                if ready > 1 {
                    collisions += 1.0;
                    *window = access.widened(*window);
                } else {
                    *window = access.window_min;
                }
                *left = draw(*window);
            }
        }
        (
            attempts / f64::from(slots) / count as f64,
            collisions / attempts,
        )
    }

    #[test]
    fn the_fixed_point_is_what_saturated_stations_do() {
        for (category, count) in [
            (AccessCategory::BestEffort, 2),
            (AccessCategory::BestEffort, 5),
            (AccessCategory::BestEffort, 20),
            (AccessCategory::Video, 5),
        ] {
            let access = Access::of(category);
            let (attempt, collision) = fixed_point(&access, count);
            let (slots_attempt, slots_collision) = slotted(&access, count as usize, 1_000_000, 3);
            // Bianchi's own comparison agrees within a few per cent; stations are not independent.
            assert!(
                (attempt / slots_attempt - 1.0).abs() < 0.05,
                "{count}: {attempt} {slots_attempt}"
            );
            assert!(
                (collision - slots_collision).abs() < 0.02,
                "{count}: {collision} {slots_collision}"
            );
        }
        let (attempt, collision) = fixed_point(&OTHERS, 1);
        assert!(collision < 1e-9 && (attempt - 2.0 / 17.0).abs() < 1e-9);
    }

    fn contention(busy_ratio: f64, category: AccessCategory) -> Contention {
        Contention::new(&WifiSpec {
            busy_ratio,
            busy_mean_us: 800.0,
            contender_count: 5,
            access_category: category,
            ..WifiSpec::default()
        })
    }

    #[test]
    fn a_million_back_offs_have_the_mean_of_their_slots() {
        let mut random = RandomStream::new(5, "back-off");
        for (busy_ratio, category, window) in [
            (0.0, AccessCategory::BestEffort, 15),
            (0.4, AccessCategory::BestEffort, 15),
            (0.9, AccessCategory::Voice, 3),
            (0.6, AccessCategory::Background, 1023),
        ] {
            let contention = contention(busy_ratio, category);
            let count = 1_000_000;
            let sum: i64 = (0..count)
                .map(|_| contention.backoff_ns(&mut random, window))
                .sum();
            let (aifs, begin) = (contention.access.aifs_ns as f64, contention.begin_ratio);
            let slot = (1.0 - begin) * SLOT_NS as f64 + begin * (800e3 + aifs);
            let expected = aifs + 0.5 * f64::from(window) * slot;
            let mean = sum as f64 / f64::from(count);
            assert!((mean / expected - 1.0).abs() < 0.01, "{mean} {expected}");
        }
    }

    #[test]
    fn the_medium_is_as_busy_as_told() {
        for busy_ratio in [0.05, 0.3, 0.9] {
            let begin = contention(busy_ratio, AccessCategory::Voice).begin_ratio;
            let (busy, aifs) = (800e3, OTHERS.aifs_ns as f64);
            let slot = begin * (busy + aifs) + (1.0 - begin) * SLOT_NS as f64;
            assert!((begin * busy / slot - busy_ratio).abs() < 1e-12);
        }
        // At the ceiling the probability is the fixed point's.
        let mut spec = WifiSpec {
            contender_count: 5,
            ..WifiSpec::default()
        };
        spec.busy_ratio = saturated_busy_ratio(&spec);
        let (attempt, _) = fixed_point(&OTHERS, 5);
        let begin = 1.0 - (1.0 - attempt).powi(5);
        assert!((Contention::new(&spec).begin_ratio - begin).abs() < 1e-9);
    }
}
