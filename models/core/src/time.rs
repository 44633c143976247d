//! Instants of this host and of another, and the periodic timer. It reads no clock: `now` is
//! always an argument.

use core::fmt;
use core::ops::Add;
use core::time::Duration;

use serde::{Deserialize, Serialize};

/// A moment on this host's monotonic clock, in nanoseconds since an origin the clock chooses.
///
/// Two instants of one host subtract to a signed number of nanoseconds. An instant of another
/// host is a [`RemoteInstant`] and does not subtract at all.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize,
)]
#[serde(transparent)]
pub struct Instant(i64);

impl Instant {
    /// The origin of the clock; the start of a virtual-time run.
    pub const ZERO: Self = Self(0);

    /// The instant `ns` nanoseconds after the clock's origin.
    pub const fn from_ns(ns: i64) -> Self {
        Self(ns)
    }

    /// Nanoseconds since the clock's origin.
    pub const fn as_ns(self) -> i64 {
        self.0
    }

    /// Signed nanoseconds from `earlier` to `self`; negative when `self` comes first.
    pub const fn ns_since(self, earlier: Self) -> i64 {
        self.0.saturating_sub(earlier.0)
    }

    /// Time from `earlier` to `self`, or zero when `self` comes first.
    pub const fn saturating_duration_since(self, earlier: Self) -> Duration {
        let ns = self.0.saturating_sub(earlier.0);
        Duration::from_nanos(if ns > 0 { ns.unsigned_abs() } else { 0 })
    }

    /// Seconds from `earlier` to `self`, for integration and plots.
    pub fn seconds_since(self, earlier: Self) -> f64 {
        self.ns_since(earlier) as f64 * 1e-9
    }
}

impl Add<Duration> for Instant {
    type Output = Self;

    fn add(self, step: Duration) -> Self {
        Self(self.0.saturating_add(duration_ns(step)))
    }
}

/// A duration in nanoseconds, saturating at 292 years.
pub fn duration_ns(duration: Duration) -> i64 {
    i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX)
}

/// A moment on another host's clock.
///
/// It has no arithmetic. It becomes an [`Instant`] of this host only through an [`Alignment`],
/// which brings its error bound along.
///
/// ```compile_fail
/// use hil_core::time::{Instant, RemoteInstant};
/// let _ = Instant::from_ns(5).ns_since(RemoteInstant::from_ns(3));
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct RemoteInstant(i64);

impl RemoteInstant {
    /// The instant `ns` nanoseconds after the other clock's origin.
    pub const fn from_ns(ns: i64) -> Self {
        Self(ns)
    }

    /// Nanoseconds since the other clock's origin: for encoding, not for arithmetic.
    pub const fn as_ns(self) -> i64 {
        self.0
    }
}

/// How another host's clock relates to this host's: `local = remote + offset`, within a bound.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Alignment {
    /// What to add to the other host's nanoseconds to get this host's.
    pub offset_ns: i64,
    /// Largest error of the converted instant.
    pub bound_ns: u64,
}

impl Alignment {
    /// Both ends read one clock (two network namespaces of one kernel): exact.
    pub const SAME_CLOCK: Self = Self {
        offset_ns: 0,
        bound_ns: 0,
    };

    /// The other host's instant on this host's clock; wrong by at most [`Alignment::bound_ns`].
    pub const fn localise(&self, remote: RemoteInstant) -> Instant {
        Instant(remote.0.saturating_add(self.offset_ns))
    }
}

/// One firing of a [`PeriodicTimer`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tick {
    /// Position on the grid, counted from the timer's start.
    pub index: u64,
    /// The grid point this tick stands for; `now - scheduled` is the lateness.
    pub scheduled: Instant,
    /// Grid points passed over without a tick since the previous one.
    pub skipped_count: u64,
}

/// A timer on an absolute grid `start + n * period`.
///
/// A late caller gets one tick for the newest grid point and the number it missed, so load shows
/// up as a count instead of as silent drift or as a burst.
#[derive(Debug, Clone)]
pub struct PeriodicTimer {
    period_ns: i64,
    start: Option<Instant>,
    next_index: u64,
    skipped_total: u64,
}

impl PeriodicTimer {
    /// A stopped timer.
    ///
    /// # Panics
    /// When `period` is zero.
    pub fn new(period: Duration) -> Self {
        let period_ns = duration_ns(period);
        assert!(period_ns > 0, "a periodic timer needs a period above zero");
        Self {
            period_ns,
            start: None,
            next_index: 0,
            skipped_total: 0,
        }
    }

    /// Anchors the grid at `now`; the first tick is due at once.
    pub fn start(&mut self, now: Instant) {
        self.start = Some(now);
        self.next_index = 0;
        self.skipped_total = 0;
    }

    /// When the next tick is due; `None` before [`PeriodicTimer::start`].
    pub fn next(&self) -> Option<Instant> {
        self.start
            .map(|start| self.grid_point(start, self.next_index))
    }

    /// The newest tick that is due at `now`, if any.
    pub fn poll(&mut self, now: Instant) -> Option<Tick> {
        let start = self.start?;
        let elapsed = u64::try_from(now.ns_since(start)).ok()?;
        let newest = elapsed / self.period_ns.unsigned_abs();
        if newest < self.next_index {
            return None;
        }
        let skipped_count = newest - self.next_index;
        self.next_index = newest + 1;
        self.skipped_total += skipped_count;
        Some(Tick {
            index: newest,
            scheduled: self.grid_point(start, newest),
            skipped_count,
        })
    }

    /// Grid points passed over since the start.
    pub fn skipped_total(&self) -> u64 {
        self.skipped_total
    }

    fn grid_point(&self, start: Instant, index: u64) -> Instant {
        let steps = i64::try_from(index).unwrap_or(i64::MAX);
        Instant(start.0.saturating_add(self.period_ns.saturating_mul(steps)))
    }
}

impl fmt::Display for Instant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.6} s", self.0 as f64 * 1e-9)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn a_punctual_caller_gets_every_tick() {
        let mut timer = PeriodicTimer::new(Duration::from_millis(4));
        timer.start(Instant::from_ns(7));
        let mut now = Instant::from_ns(7);
        for index in 0..1000 {
            let tick = timer.poll(now).unwrap();
            assert_eq!((tick.index, tick.skipped_count), (index, 0));
            assert_eq!(tick.scheduled, now);
            assert_eq!(timer.poll(now), None);
            now = timer.next().unwrap();
        }
        assert_eq!(now, Instant::from_ns(7 + 4000 * MS));
    }

    #[test]
    fn a_late_caller_gets_one_tick_and_the_count_it_missed() {
        let mut timer = PeriodicTimer::new(Duration::from_millis(4));
        timer.start(Instant::ZERO);
        timer.poll(Instant::ZERO);
        let tick = timer.poll(Instant::from_ns(17 * MS)).unwrap();
        assert_eq!((tick.index, tick.skipped_count), (4, 3));
        assert_eq!(tick.scheduled, Instant::from_ns(16 * MS));
        assert_eq!(timer.next(), Some(Instant::from_ns(20 * MS)));
        assert_eq!(timer.skipped_total(), 3);
    }

    #[test]
    fn ticks_and_skips_always_cover_the_grid() {
        let mut timer = PeriodicTimer::new(Duration::from_micros(997));
        timer.start(Instant::ZERO);
        let (mut now, mut ticks) = (Instant::ZERO, 0);
        for step in 0..10_000_i64 {
            now = now + Duration::from_nanos((step * 7_919 % 3_000_000).unsigned_abs());
            ticks += u64::from(timer.poll(now).is_some());
        }
        let grid = now.as_ns() / 997_000 + 1;
        assert_eq!(ticks + timer.skipped_total(), grid.unsigned_abs());
    }

    #[test]
    fn a_timer_that_was_not_started_never_fires() {
        let mut timer = PeriodicTimer::new(Duration::from_millis(1));
        assert_eq!(timer.poll(Instant::from_ns(MS)), None);
        assert_eq!(timer.next(), None);
    }

    #[test]
    fn another_hosts_instant_needs_an_alignment() {
        let alignment = Alignment {
            offset_ns: -250,
            bound_ns: 40,
        };
        assert_eq!(
            alignment.localise(RemoteInstant::from_ns(1000)),
            Instant::from_ns(750)
        );
    }
}
