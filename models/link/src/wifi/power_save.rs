//! Power save: frames for a dozing station wait for the beacon that it listens to (IEEE Std
//! 802.11-2020, 11.2.3). It contends for nothing.

use crate::wifi::phy::nanoseconds;
use crate::wifi::spec::WifiSpec;
use hil_core::time::Instant;

/// A receiver that dozes between beacons.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Doze {
    period_ns: i64,
    phase_ns: i64,
    awake_ns: i64,
    /// It is awake until then.
    until: Instant,
}

impl Doze {
    /// Beacons are due at a share `phase` of the period, 0..1, after the start of the run.
    pub(crate) fn new(spec: &WifiSpec, phase: f64) -> Self {
        let period_ns =
            nanoseconds(spec.beacon_interval_ms * 1e6 * f64::from(spec.listen_interval));
        Self {
            period_ns,
            phase_ns: nanoseconds(phase * period_ns as f64),
            awake_ns: nanoseconds(spec.awake_ms * 1e6),
            until: Instant::ZERO,
        }
    }

    /// When the receiver hears a frame that is ready at `at`: then, or after the next beacon it
    /// listens to.
    pub(crate) fn listens_from(&self, at: Instant) -> Instant {
        if at < self.until {
            return at;
        }
        let into_ns = (at.as_ns().saturating_sub(self.phase_ns)).rem_euclid(self.period_ns);
        let wait_ns = if into_ns == 0 {
            0
        } else {
            self.period_ns - into_ns
        };
        Instant::from_ns(at.as_ns().saturating_add(wait_ns))
    }

    /// A frame was received: the receiver stays awake for a while.
    pub(crate) fn heard(&mut self, at: Instant) {
        self.until = Instant::from_ns(at.as_ns().saturating_add(self.awake_ns));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_waits_for_the_next_beacon_listened_to_unless_one_was_just_heard() {
        let spec = WifiSpec {
            beacon_interval_ms: 102.4,
            listen_interval: 3,
            awake_ms: 100.0,
            ..WifiSpec::default()
        };
        let mut doze = Doze::new(&spec, 0.25);
        let at = Instant::from_ns;
        let (phase, period) = (76_800_000, 307_200_000);
        assert_eq!(doze.listens_from(at(0)), at(phase));
        assert_eq!(doze.listens_from(at(phase)), at(phase));
        assert_eq!(doze.listens_from(at(phase + 1)), at(phase + period));
        doze.heard(at(phase));
        assert_eq!(doze.listens_from(at(phase + 1)), at(phase + 1));
        let asleep = at(phase + 100_000_000);
        assert_eq!(doze.listens_from(asleep), at(phase + period));
    }
}
