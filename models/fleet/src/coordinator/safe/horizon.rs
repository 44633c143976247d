//! How far ahead of a robot its authority has to reach so that it never brakes for want of a
//! message: a closed form, and an estimate of the round trip that it needs.

use core::time::Duration;

use crate::world::Vehicle;
use hil_core::time::Instant;

/// Time from sending an authority to the first state that shows it, as seen by the sender alone,
/// so that no clocks are compared. It follows a longer one at once and a shorter one slowly.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RoundTrip {
    estimate_s: f64,
    asked: Option<(u32, Instant)>,
}

/// A peer that is silent for longer is not waited for with ever more authority.
const ROUND_TRIP_MAX_S: f64 = 10.0;
/// Part of the difference by which a shorter round trip lowers the estimate.
const DECAY: f64 = 0.1;

impl RoundTrip {
    /// An authority with a new sequence is sent; one is timed at a time.
    pub(crate) fn sent(&mut self, now: Instant, sequence: u32) {
        if self.asked.is_none() {
            self.asked = Some((sequence, now));
        }
    }

    /// A state shows `sequence` applied.
    pub(crate) fn shown(&mut self, now: Instant, sequence: u32) {
        let Some((asked, at)) = self.asked else {
            return;
        };
        if sequence < asked {
            return;
        }
        self.asked = None;
        let sample_s = now.seconds_since(at).clamp(0.0, ROUND_TRIP_MAX_S);
        self.estimate_s = follow(self.estimate_s, sample_s);
    }

    /// A new mission numbers its authorities anew; the estimate is kept.
    pub(crate) fn forget_question(&mut self) {
        self.asked = None;
    }

    pub(crate) fn estimate_s(&self) -> f64 {
        self.estimate_s
    }
}

/// Time from one control cycle to the next as it really is: a host that overruns its period gives
/// authority less often, so robots need more of it at once.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct CycleTime {
    estimate_s: f64,
    last: Option<Instant>,
}

impl CycleTime {
    /// A cycle begins.
    pub(crate) fn begin(&mut self, now: Instant) {
        if let Some(last) = self.last.replace(now) {
            let sample_s = now.seconds_since(last).clamp(0.0, ROUND_TRIP_MAX_S);
            self.estimate_s = follow(self.estimate_s, sample_s);
        }
    }

    /// What to expect, at least the nominal period.
    pub(crate) fn expected_s(&self, nominal: Duration) -> f64 {
        self.estimate_s.max(nominal.as_secs_f64())
    }
}

/// Follows a larger sample at once and a smaller one slowly.
fn follow(estimate_s: f64, sample_s: f64) -> f64 {
    sample_s.max(estimate_s + DECAY * (sample_s - estimate_s))
}

/// Way a robot at `speed_mps` makes at most in `time_s`, and then needs to stop.
pub(crate) fn reach_m(vehicle: &Vehicle, speed_mps: f64, time_s: f64) -> f64 {
    let (speed_max_mps, acceleration_mps2) = (vehicle.speed_max_mps, vehicle.acceleration_mps2);
    let speed_mps = speed_mps.clamp(0.0, speed_max_mps);
    let accelerating_s = ((speed_max_mps - speed_mps) / acceleration_mps2).min(time_s);
    let end_mps = speed_mps + acceleration_mps2 * accelerating_s;
    0.5 * (speed_mps + end_mps) * accelerating_s
        + end_mps * (time_s - accelerating_s)
        + end_mps * end_mps / (2.0 * acceleration_mps2)
}

/// Seconds until an authority sent a control cycle from now is sure to be at the robot, counted
/// from when the state known now was sampled.
pub(crate) fn lookahead_s(cycle_s: f64, round_trip_s: f64, reserve_ms: f64) -> f64 {
    cycle_s + round_trip_s + 1e-3 * reserve_ms
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Footprint;

    const CART: Vehicle = Vehicle {
        footprint: Footprint {
            length_m: 2.0,
            width_m: 0.5,
        },
        speed_max_mps: 2.0,
        acceleration_mps2: 1.0,
    };

    #[test]
    fn reach_follows_its_closed_form() {
        let check = |speed, time, expected: f64| {
            let reach = reach_m(&CART, speed, time);
            assert!((reach - expected).abs() < 1e-12, "{reach} {expected}");
        };
        check(2.0, 0.0, 2.0);
        check(2.0, 1.5, 5.0);
        check(0.0, 1.0, 1.0);
        check(0.0, 3.0, 2.0 + 2.0 + 2.0);
    }

    #[test]
    fn cycles_that_overrun_count_as_long_as_they_are() {
        let mut cycles = CycleTime::default();
        let nominal = Duration::from_secs(1);
        for s in [0, 1, 2, 6] {
            cycles.begin(Instant::from_ns(s * 1_000_000_000));
        }
        assert!((cycles.expected_s(nominal) - 4.0).abs() < 1e-12);
        for s in 7..100 {
            cycles.begin(Instant::from_ns(s * 1_000_000_000));
        }
        assert!((cycles.expected_s(nominal) - 1.0).abs() < 1e-3);
    }

    #[test]
    fn a_longer_round_trip_counts_at_once_and_a_shorter_one_slowly() {
        let mut trip = RoundTrip::default();
        let at = |ms: i64| Instant::from_ns(ms * 1_000_000);
        trip.sent(at(0), 1);
        trip.sent(at(1000), 2);
        trip.shown(at(1400), 0);
        trip.shown(at(1500), 2);
        assert!((trip.estimate_s() - 1.5).abs() < 1e-12);
        trip.sent(at(2000), 3);
        trip.shown(at(2100), 3);
        assert!((trip.estimate_s() - 1.36).abs() < 1e-12);
    }
}
