//! Paired reads of the real-time and the monotonic clock: kernel stamps are of the first, all
//! else in a run of the second. It corrects neither clock and knows no other host.

use core::time::Duration;
use std::io;

use hil_core::time::Instant;
use nix::time::{ClockId, clock_gettime};

/// Both clocks at one moment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClockPair {
    /// Real-time minus monotonic clock, in nanoseconds.
    pub offset_ns: i64,
    /// Largest error of `offset_ns`: half the time between the two monotonic reads around the
    /// real-time read.
    pub bound_ns: u64,
    /// When, on the monotonic clock.
    pub taken: Instant,
}

impl ClockPair {
    /// Reads the pair `attempt_count` times (at least once) and keeps the narrowest.
    ///
    /// # Errors
    /// When the kernel refuses to read one of the clocks.
    pub fn read(attempt_count: u32) -> io::Result<Self> {
        let mut narrowest = Self::read_once()?;
        for _ in 1..attempt_count {
            let pair = Self::read_once()?;
            if pair.bound_ns < narrowest.bound_ns {
                narrowest = pair;
            }
        }
        Ok(narrowest)
    }

    fn read_once() -> io::Result<Self> {
        let before = monotonic_now()?;
        let realtime_ns = read_ns(ClockId::CLOCK_REALTIME)?;
        let after = monotonic_now()?;
        Ok(Self::from_reads(before, realtime_ns, after))
    }

    /// The pair that one real-time read between two monotonic reads gives.
    pub fn from_reads(before: Instant, realtime_ns: i64, after: Instant) -> Self {
        let width_ns = after.ns_since(before).max(0);
        let middle = before + Duration::from_nanos(width_ns.unsigned_abs() / 2);
        Self {
            offset_ns: realtime_ns.saturating_sub(middle.as_ns()),
            bound_ns: width_ns.unsigned_abs().div_ceil(2),
            taken: middle,
        }
    }

    /// The monotonic instant of a real-time stamp; wrong by at most [`ClockPair::bound_ns`] plus
    /// whatever the real-time clock was stepped in between.
    pub const fn to_monotonic(&self, realtime_ns: i64) -> Instant {
        Instant::from_ns(realtime_ns.saturating_sub(self.offset_ns))
    }

    /// Takes over a newer reading; true when the real-time clock was stepped in between.
    ///
    /// Only a step changes the offset, so a wider reading, taken by a thread that was held up
    /// between its reads, does not replace a narrower one.
    pub fn renew(&mut self, newer: Self) -> bool {
        let is_stepped = newer.step_since(self).is_some();
        if is_stepped || newer.bound_ns <= self.bound_ns {
            *self = newer;
        } else {
            self.taken = newer.taken;
        }
        is_stepped
    }

    /// By how much the real-time clock was stepped since `earlier`, in nanoseconds; `None` when
    /// the two offsets agree within their bounds. Stamps taken in between are of no use then.
    ///
    /// The kernel slews both clocks alike, so the offset changes by a step only (`settimeofday`,
    /// `ADJ_SETOFFSET`, a leap second).
    pub fn step_since(&self, earlier: &Self) -> Option<i64> {
        let change_ns = self.offset_ns.saturating_sub(earlier.offset_ns);
        let allowed_ns = self.bound_ns.saturating_add(earlier.bound_ns);
        (change_ns.unsigned_abs() > allowed_ns).then_some(change_ns)
    }
}

/// `CLOCK_MONOTONIC` of this host.
///
/// # Errors
/// When the kernel refuses to read it.
pub fn monotonic_now() -> io::Result<Instant> {
    read_ns(ClockId::CLOCK_MONOTONIC).map(Instant::from_ns)
}

pub(crate) fn read_ns(clock: ClockId) -> io::Result<i64> {
    let time = clock_gettime(clock)?;
    Ok(nanoseconds(time.tv_sec(), time.tv_nsec()))
}

pub(crate) const fn nanoseconds(seconds: i64, nanoseconds: i64) -> i64 {
    seconds
        .saturating_mul(1_000_000_000)
        .saturating_add(nanoseconds)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pair(offset_ns: i64, bound_ns: u64, taken_ns: i64) -> ClockPair {
        ClockPair {
            offset_ns,
            bound_ns,
            taken: Instant::from_ns(taken_ns),
        }
    }

    #[test]
    fn a_held_up_reading_does_not_replace_a_good_one_but_a_step_does() {
        let pair = |at_ns: i64, offset_ns: i64, bound_ns: u64| ClockPair {
            offset_ns,
            bound_ns,
            taken: Instant::from_ns(at_ns),
        };
        let mut kept = pair(0, 1000, 20);
        assert!(!kept.renew(pair(100, 40_000, 50_000)));
        assert_eq!(kept, pair(100, 1000, 20));
        assert!(!kept.renew(pair(200, 1010, 15)));
        assert_eq!(kept, pair(200, 1010, 15));
        assert!(kept.renew(pair(300, 9_000_000, 30)));
        assert_eq!(kept, pair(300, 9_000_000, 30));
    }

    #[test]
    fn the_bound_covers_every_place_of_the_read_between_its_neighbours() {
        let (before, after) = (Instant::from_ns(1_000), Instant::from_ns(1_301));
        for true_read_ns in 1_000..=1_301 {
            let read = ClockPair::from_reads(before, true_read_ns + 77_000, after);
            assert!(read.offset_ns.abs_diff(77_000) <= read.bound_ns);
        }
    }

    #[test]
    fn a_stamp_maps_back_to_the_instant_it_came_from() {
        let read = pair(1_700_000_000_000_000_000, 40, 5_000);
        let stamp = read.offset_ns + 123_456;
        assert_eq!(read.to_monotonic(stamp), Instant::from_ns(123_456));
    }

    #[test]
    fn a_step_is_told_from_the_width_of_the_reads() {
        let start = pair(1_000_000, 50, 0);
        assert_eq!(pair(1_000_100, 50, 10).step_since(&start), None);
        assert_eq!(pair(1_000_101, 50, 10).step_since(&start), Some(101));
        assert_eq!(pair(999_000, 50, 10).step_since(&start), Some(-1_000));
    }

    #[test]
    fn the_clocks_of_this_host_make_a_pair() {
        let earlier = ClockPair::read(8).unwrap();
        let later = ClockPair::read(8).unwrap();
        assert!(later.taken >= earlier.taken);
        assert!(earlier.offset_ns > 0, "the epoch lies before every boot");
        assert_eq!(later.step_since(&earlier), None);
    }
}
