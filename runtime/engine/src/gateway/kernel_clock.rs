//! From the clock of the kernel's stamps to the clock of the run, as one gateway thread knows it.

use std::time::Duration;

use hil_core::time::Instant;
use hil_net::clock_pair::ClockPair;
use hil_protocol::{ArrivalStamps, StampSource};
use hil_transport::Received;

use super::WorkerError;

/// Reads of a clock pair of which the narrowest counts.
const PAIR_ATTEMPTS: u32 = 5;
/// How often the relation of real-time and monotonic clock is read anew: it changes by steps
/// only, so this bounds how many messages a step can spoil.
const PAIR_PERIOD: Duration = Duration::from_millis(100);

/// The relation of the two clocks, and how often it jumped.
#[derive(Debug)]
pub(crate) struct KernelClock {
    pair: ClockPair,
    step_count: u64,
}

impl KernelClock {
    /// Reads both clocks.
    pub(crate) fn read() -> Result<Self, WorkerError> {
        let pair = ClockPair::read(PAIR_ATTEMPTS).map_err(WorkerError::Clock)?;
        Ok(Self {
            pair,
            step_count: 0,
        })
    }

    /// Real-time minus monotonic clock.
    pub(crate) const fn offset_ns(&self) -> i64 {
        self.pair.offset_ns
    }

    /// How often the real-time clock was stepped.
    pub(crate) const fn step_count(&self) -> u64 {
        self.step_count
    }

    /// Reads both clocks again when it is time to.
    pub(crate) fn refresh(&mut self, now: Instant) {
        if now.saturating_duration_since(self.pair.taken) < PAIR_PERIOD {
            return;
        }
        if let Ok(newer) = ClockPair::read(PAIR_ATTEMPTS) {
            self.step_count += u64::from(self.pair.renew(newer));
        }
    }

    /// The best there is to say of when `received` came; `now` is when the receive call returned.
    pub(crate) fn arrival(&self, received: &Received, now: Instant) -> ArrivalStamps {
        let peer = Some(received.source);
        match received.stamps.software_ns {
            Some(realtime_ns) => ArrivalStamps {
                received_ns: self.pair.to_monotonic(realtime_ns).as_ns(),
                received_source: StampSource::KernelSoftware,
                peer,
            },
            None => ArrivalStamps {
                peer,
                ..ArrivalStamps::application(now.as_ns())
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_account::network::CLOCK_READING_AGE_NS_MAX;
    use hil_core::time::duration_ns;
    use hil_platform::wait::WAIT_MAX;

    #[test]
    fn a_step_is_looked_for_as_far_back_as_a_reading_may_be_old() {
        // A reading that is not yet due may be slept on, and a datagram is taken before the next.
        assert_eq!(
            duration_ns(PAIR_PERIOD + WAIT_MAX),
            CLOCK_READING_AGE_NS_MAX
        );
    }

    #[test]
    fn a_reading_is_renewed_once_it_is_old_and_not_before() {
        let mut clock = KernelClock::read().unwrap();
        let taken = clock.pair.taken;
        clock.refresh(taken + PAIR_PERIOD / 2);
        assert_eq!(clock.pair.taken, taken);
        clock.refresh(taken + PAIR_PERIOD);
        assert!(clock.pair.taken > taken);
    }
}
