//! The two loops that measure: one that sleeps to absolute instants, one that does nothing but look
//! at the clock. Neither allocates, locks or logs while it measures.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use hil_core::time::PeriodicTimer;
use hil_stats::histogram::LatencyHistogram;
use nix::sys::resource::{UsageWho, getrusage};

use super::{Gaps, LatencyRequest, Quantiles, Wakeups, ns};
use hil_platform::clock::{MonotonicClock, Wake};
use hil_platform::realtime::{RealtimeGrant, RealtimeRequest, SchedulingPolicy, apply};

/// Longer values make the histogram allocate; by then the measurement is spoilt anyway.
const ROOM_NS: u64 = 10_000_000_000;
/// Instants that one stall may be counted for; a stall longer than that is a host that slept.
const STALL_INSTANTS_MAX: u64 = 1_000_000;

/// Pins this thread, locks memory, takes the priority; says what became of each.
fn prepare(cpu: Option<usize>, priority: Option<u8>) -> RealtimeGrant {
    let policy = priority.map_or(SchedulingPolicy::Other, |priority| SchedulingPolicy::Fifo {
        priority,
    });
    apply(&RealtimeRequest {
        cpu,
        policy,
        lock_memory: true,
        ..RealtimeRequest::default()
    })
}

fn in_words(grant: &RealtimeGrant) -> Vec<String> {
    grant.items.iter().map(ToString::to_string).collect()
}

/// Times that the kernel took the CPU away from this thread so far.
fn preempted_count() -> Option<u64> {
    let usage = getrusage(UsageWho::RUSAGE_THREAD).ok()?;
    u64::try_from(usage.involuntary_context_switches()).ok()
}

/// Sleeps to the instants of a grid until the time is over or `stop` is set.
pub(super) fn wake(request: &LatencyRequest, cpu: Option<usize>, stop: &AtomicBool) -> Wakeups {
    let grant = prepare(cpu, Some(request.priority));
    let mut histogram = LatencyHistogram::with_room(ROOM_NS);
    let period_ns = i64::try_from(ns(request.period)).unwrap_or(i64::MAX);
    let mut timer = PeriodicTimer::new(request.period);
    let preempted_before = preempted_count();
    let start = MonotonicClock::now();
    let end = start + request.duration;
    timer.start(start + request.period);
    let mut skipped_count = 0;
    while let Some(due) = timer.next()
        && due <= end
        && !stop.load(Ordering::Relaxed)
    {
        if MonotonicClock::sleep_until(due) == Wake::Interrupted {
            continue;
        }
        let now = MonotonicClock::now();
        let mut late_ns = now.ns_since(due);
        histogram.record(late_ns);
        let tick = timer.poll(now);
        // What passed meanwhile was late too, each by a period less: left out, a stall of ten
        // periods would count as one wake-up and the quantiles would not see the rest.
        let passed = tick.map_or(0, |tick| tick.skipped_count);
        for _ in 0..passed.min(STALL_INSTANTS_MAX) {
            late_ns -= period_ns;
            histogram.record(late_ns);
            skipped_count += 1;
        }
    }
    let measured = MonotonicClock::now().ns_since(start);
    let preempted = preempted_before.zip(preempted_count());
    Wakeups {
        cpu,
        is_as_asked: grant.is_complete(),
        scheduling: in_words(&grant),
        measured_ns: u64::try_from(measured).unwrap_or(0),
        count: histogram.count(),
        skipped_count,
        preempted_count: preempted.map(|(before, after)| after.saturating_sub(before)),
        lateness: Quantiles::of(&histogram),
    }
}

/// How a busy poller is to spin.
#[derive(Debug, Clone, Copy)]
pub(super) struct Spin {
    /// Where.
    pub(super) cpu: Option<usize>,
    /// `SCHED_FIFO` priority; `None` leaves the normal policy.
    pub(super) priority: Option<u8>,
    /// How long.
    pub(super) duration: Duration,
    /// What the real-time throttle keeps back per period.
    pub(super) throttle_ns: Option<i64>,
}

/// Looks at the clock without pause until the time is over or `stop` is set.
pub(super) fn spin(settings: &Spin, stop: &AtomicBool) -> Gaps {
    let grant = prepare(settings.cpu, settings.priority);
    let mut histogram = LatencyHistogram::with_room(ROOM_NS);
    let throttle_ns = settings.throttle_ns.unwrap_or(0);
    let (mut look_count, mut lost_ns, mut throttle_like_count) = (0, 0, 0);
    let start = MonotonicClock::now();
    let end = start + settings.duration;
    let mut last = start;
    while last < end && !stop.load(Ordering::Relaxed) {
        let now = MonotonicClock::now();
        look_count += 1;
        let gap_ns = now.ns_since(last);
        last = now;
        if gap_ns > Gaps::LEAST_NS {
            histogram.record(gap_ns);
            lost_ns += gap_ns.unsigned_abs();
            let is_throttle_like = (gap_ns - throttle_ns).abs() <= throttle_ns / 10;
            throttle_like_count += u64::from(is_throttle_like);
        }
    }
    Gaps {
        cpu: settings.cpu,
        scheduling: in_words(&grant),
        measured_ns: u64::try_from(last.ns_since(start)).unwrap_or(0),
        look_count,
        count: histogram.count(),
        lost_ns,
        throttle_like_count: settings.throttle_ns.map(|_| throttle_like_count),
        length: Quantiles::of(&histogram),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_poller_sees_no_gap_shorter_than_the_least_and_ends_in_time() {
        let settings = Spin {
            cpu: None,
            priority: None,
            duration: Duration::from_millis(30),
            throttle_ns: Some(50_000_000),
        };
        let gaps = spin(&settings, &AtomicBool::new(false));
        assert!(gaps.measured_ns >= 30_000_000, "{gaps:?}");
        assert!(gaps.look_count > 1000, "{gaps:?}");
        assert!(gaps.lost_ns <= gaps.measured_ns, "{gaps:?}");
        assert_eq!(gaps.length.is_some(), gaps.count > 0);
        assert!(gaps.length.is_none_or(|one| one.p50_ns > Gaps::LEAST_NS));
        let stopped = spin(&settings, &AtomicBool::new(true));
        assert_eq!((stopped.look_count, stopped.count), (0, 0));
    }

    #[test]
    fn no_time_means_no_figures() {
        let request = LatencyRequest {
            duration: Duration::ZERO,
            ..LatencyRequest::brief(None)
        };
        let wakeups = wake(&request, None, &AtomicBool::new(false));
        assert_eq!((wakeups.count, wakeups.lateness), (0, None));
    }

    #[test]
    fn a_cpu_that_does_not_exist_is_told_and_not_passed_over() {
        let request = LatencyRequest {
            duration: Duration::from_millis(5),
            ..LatencyRequest::brief(None)
        };
        let wakeups = wake(&request, Some(1000), &AtomicBool::new(false));
        assert!(!wakeups.is_as_asked);
        assert!(
            wakeups.scheduling[0].starts_with("cpu 1000 refused"),
            "{wakeups:?}"
        );
    }
}
