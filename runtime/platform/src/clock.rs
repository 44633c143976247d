//! This host's monotonic clock and the absolute sleep on it. It is not a time of day, and it
//! knows nothing of another host's clock: offsets and their bounds belong to the gateways.

use hil_core::time::Instant;
use nix::errno::Errno;
use nix::sys::time::TimeSpec;
use nix::time::{ClockId, ClockNanosleepFlags, clock_nanosleep};

const NS_PER_SECOND: i64 = 1_000_000_000;

/// Why [`MonotonicClock::sleep_until`] returned.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[must_use = "an interrupted sleep ended before the instant that was asked for"]
pub enum Wake {
    /// The instant has come; it may lie in the past by the scheduler's latency.
    Due,
    /// A signal handler ran first. The caller looks at its stop flag and sleeps again.
    Interrupted,
}

/// `CLOCK_MONOTONIC`: never stepped, slewed by NTP or PTP, standing still while the host sleeps.
///
/// A read goes through the vDSO and costs about 25 ns with the `tsc` clocksource; with `hpet` or
/// `acpi_pm` it is a system call of a microsecond and more, which `hil-runtime doctor` measures.
///
/// ```
/// use hil_platform::clock::MonotonicClock;
/// let (first, second) = (MonotonicClock::now(), MonotonicClock::now());
/// assert!(second >= first);
/// ```
#[derive(Debug, Clone, Copy, Default)]
pub struct MonotonicClock;

impl MonotonicClock {
    /// The present instant, in nanoseconds since the clock's origin (near the boot of the host).
    ///
    /// All processes of one host share this clock, so their instants compare.
    ///
    /// # Panics
    /// Never on Linux, where `CLOCK_MONOTONIC` always exists.
    pub fn now() -> Instant {
        let read = ClockId::CLOCK_MONOTONIC.now();
        instant_of(&read.expect("Linux always has CLOCK_MONOTONIC"))
    }

    /// Sleeps until `due`, or until a signal handler ran.
    ///
    /// The sleep is absolute, so time lost before the call does not add to it. An instant in the
    /// past returns at once. Under a normal scheduling policy the kernel may add the timer slack
    /// (50 us unless changed) to every sleep; under `SCHED_FIFO` it adds none.
    ///
    /// # Panics
    /// Never on Linux: the request is normalised here, so the kernel can only be interrupted.
    pub fn sleep_until(due: Instant) -> Wake {
        let flags = ClockNanosleepFlags::TIMER_ABSTIME;
        match clock_nanosleep(ClockId::CLOCK_MONOTONIC, flags, &timespec_of(due)) {
            Ok(_) => Wake::Due,
            Err(Errno::EINTR) => Wake::Interrupted,
            Err(errno) => panic!("clock_nanosleep refused a normalised request: {errno}"),
        }
    }
}

fn instant_of(read: &TimeSpec) -> Instant {
    Instant::from_ns(read.tv_sec() * NS_PER_SECOND + read.tv_nsec())
}

fn timespec_of(due: Instant) -> TimeSpec {
    let ns = due.as_ns().max(0);
    TimeSpec::new(ns / NS_PER_SECOND, ns % NS_PER_SECOND)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn the_clock_never_runs_backwards() {
        let mut previous = MonotonicClock::now();
        for _ in 0..100_000 {
            let now = MonotonicClock::now();
            assert!(now >= previous, "{previous:?} was followed by {now:?}");
            previous = now;
        }
    }

    #[test]
    fn a_sleep_never_ends_before_its_instant() {
        for step_us in [0_u64, 1, 50, 700, 3000] {
            let due = MonotonicClock::now() + Duration::from_micros(step_us);
            while MonotonicClock::sleep_until(due) == Wake::Interrupted {}
            assert!(MonotonicClock::now() >= due);
        }
    }

    #[test]
    fn an_instant_in_the_past_returns_at_once() {
        assert_eq!(MonotonicClock::sleep_until(Instant::from_ns(-5)), Wake::Due);
        assert_eq!(MonotonicClock::sleep_until(Instant::ZERO), Wake::Due);
    }

    #[test]
    fn instants_survive_the_trip_through_a_timespec() {
        for ns in [0, 1, 999_999_999, 1_000_000_000, 86_400_123_456_789] {
            let instant = Instant::from_ns(ns);
            assert_eq!(instant_of(&timespec_of(instant)), instant);
        }
    }

    #[test]
    fn threads_share_one_clock() {
        let before = MonotonicClock::now();
        let other = std::thread::spawn(MonotonicClock::now).join().unwrap();
        assert!(before <= other && other <= MonotonicClock::now());
    }
}
