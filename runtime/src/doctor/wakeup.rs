//! How late this host wakes a thread: a second of absolute sleeps at 1 kHz, and what claims that
//! allows. It is a sanity check, not a qualification: a second holds no rare event.

use std::thread;
use std::time::Duration;

use hil_models::time::PeriodicTimer;
use serde::{Deserialize, Serialize};

use super::{Finding, State};
use crate::clock::{MonotonicClock, Wake};
use crate::host_facts::{Fact, HostFiles, virtual_machine};
use crate::realtime::{RealtimeRequest, SchedulingPolicy, apply};

const PERIOD: Duration = Duration::from_millis(1);
const PRIORITY: u8 = 80;

/// A wake-up p99 below this leaves room for claims in tens of microseconds.
const P99_NS_GOOD: i64 = 100_000;
/// A wake-up p99 above this is the size of a control period.
const P99_NS_BAD: i64 = 1_000_000;

/// Lateness of wake-ups from an absolute sleep.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct WakeupMeasurement {
    /// The scheduling that was in force, in words.
    pub scheduling: String,
    /// Wake-ups measured.
    pub sample_count: usize,
    /// Grid points missed because the previous wake-up was later than a period.
    pub skipped_count: u64,
    /// Median lateness.
    pub lateness_ns_p50: i64,
    /// 99th percentile (nearest rank).
    pub lateness_ns_p99: i64,
    /// Latest wake-up.
    pub lateness_ns_max: i64,
}

/// Measures for `duration` in a thread of its own, at `SCHED_FIFO` 80 where that is granted.
/// `None` when not a single wake-up fell into the time.
pub(crate) fn measure(duration: Duration, cpu: Option<usize>) -> Option<WakeupMeasurement> {
    thread::spawn(move || measure_in_this_thread(duration, cpu))
        .join()
        .ok()
        .flatten()
}

fn measure_in_this_thread(duration: Duration, cpu: Option<usize>) -> Option<WakeupMeasurement> {
    let policy = SchedulingPolicy::Fifo { priority: PRIORITY };
    let grant = apply(&RealtimeRequest {
        cpu,
        policy,
        ..RealtimeRequest::default()
    });
    let scheduling: Vec<String> = grant.items.iter().map(ToString::to_string).collect();
    let sample_limit = usize::try_from(duration.as_nanos() / PERIOD.as_nanos()).ok()?;
    let mut lateness_ns = Vec::with_capacity(sample_limit);
    let mut timer = PeriodicTimer::new(PERIOD);
    let end = MonotonicClock::now() + duration;
    timer.start(MonotonicClock::now() + PERIOD);
    while let Some(due) = timer.next()
        && due < end
        && lateness_ns.len() < sample_limit
    {
        if MonotonicClock::sleep_until(due) == Wake::Interrupted {
            continue;
        }
        let now = MonotonicClock::now();
        lateness_ns.push(now.ns_since(due));
        timer.poll(now);
    }
    lateness_ns.sort_unstable();
    Some(WakeupMeasurement {
        scheduling: scheduling.join(", "),
        sample_count: lateness_ns.len(),
        skipped_count: timer.skipped_total(),
        lateness_ns_p50: nearest_rank(&lateness_ns, 50)?,
        lateness_ns_p99: nearest_rank(&lateness_ns, 99)?,
        lateness_ns_max: nearest_rank(&lateness_ns, 100)?,
    })
}

/// The smallest value that at least `percent` of the sorted values do not exceed.
fn nearest_rank(sorted: &[i64], percent: usize) -> Option<i64> {
    let rank = (sorted.len() * percent).div_ceil(100).max(1);
    sorted.get(rank - 1).copied()
}

pub(crate) fn judge(measured: Option<&WakeupMeasurement>, files: &HostFiles) -> Finding {
    let (id, title) = ("wakeup_latency", "Lateness of a 1 kHz wake-up");
    let Some(measured) = measured else {
        return Finding::unknown(id, title, "no wake-up fell into the measuring time");
    };
    let us = |ns: i64| ns as f64 / 1000.0;
    let (p50, p99, max) = (
        us(measured.lateness_ns_p50),
        us(measured.lateness_ns_p99),
        us(measured.lateness_ns_max),
    );
    let state = if measured.lateness_ns_p99 < P99_NS_GOOD {
        State::Good
    } else if measured.lateness_ns_p99 < P99_NS_BAD {
        State::Note
    } else {
        State::Problem
    };
    let value = format!(
        "p50 {p50:.0} us, p99 {p99:.0} us, max {max:.0} us of {}, {} skipped ({})",
        measured.sample_count, measured.skipped_count, measured.scheduling
    );
    let below = match virtual_machine(files) {
        Fact::Available(answer) if answer != "no" => {
            "; this is a virtual machine, whose tail comes from below and stays when it is idle"
        }
        _ => "",
    };
    // A second holds a thousand wake-ups: one per mille of them is a single event.
    let why = format!(
        "of blocking operations, medians above about {p50:.0} us and p99 above about {p99:.0} us \
         can be claimed here; single delays up to {max:.0} us may be the host's own, and p99.9 \
         needs a longer measurement{below}"
    );
    Finding::new(id, title, state, value)
        .because(why)
        .fixed_by(if state == State::Good {
            "cyclictest --mlockall --priority=80 --interval=1000 for an hour qualifies the tail"
        } else {
            "allow SCHED_FIFO, isolate a CPU, set the performance governor, quieten the host"
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::host_facts::FakeHost;

    #[test]
    fn a_short_measurement_counts_what_it_saw() {
        let measured = measure(Duration::from_millis(30), None).unwrap();
        assert!((1..=30).contains(&measured.sample_count), "{measured:?}");
        assert!(measured.lateness_ns_p50 >= 0);
        assert!(measured.lateness_ns_p50 <= measured.lateness_ns_p99);
        assert!(measured.lateness_ns_p99 <= measured.lateness_ns_max);
    }

    #[test]
    fn no_time_means_no_numbers() {
        assert_eq!(measure(Duration::ZERO, None), None);
        let host = FakeHost::with(&[]);
        assert_eq!(judge(None, &host.files()).state, State::Note);
    }

    #[test]
    fn quantiles_are_values_that_occurred() {
        let sorted: Vec<i64> = (1..=1000).collect();
        for (percent, expected) in [(50, 500), (99, 990), (100, 1000)] {
            assert_eq!(nearest_rank(&sorted, percent), Some(expected));
        }
        assert_eq!(nearest_rank(&[7], 50), Some(7));
        assert_eq!(nearest_rank(&[], 50), None);
    }

    #[test]
    fn the_claim_follows_the_measured_noise() {
        let measured = |p99_ns| {
            Some(WakeupMeasurement {
                scheduling: "SCHED_FIFO 80 granted".to_owned(),
                sample_count: 1000,
                skipped_count: 0,
                lateness_ns_p50: 25_000,
                lateness_ns_p99: p99_ns,
                lateness_ns_max: 7_000_000,
            })
        };
        let host = FakeHost::with(&[("/proc/cpuinfo", "flags : fpu hypervisor")]);
        let good = judge(measured(65_000).as_ref(), &host.files());
        assert_eq!(good.state, State::Good);
        assert!(good.why.contains("p99 above about 65 us"), "{}", good.why);
        assert!(
            good.why.contains("single delays up to 7000 us"),
            "{}",
            good.why
        );
        assert!(good.why.contains("virtual machine"), "{}", good.why);
        assert_eq!(
            judge(measured(400_000).as_ref(), &host.files()).state,
            State::Note
        );
        assert_eq!(
            judge(measured(3_000_000).as_ref(), &host.files()).state,
            State::Problem
        );
    }
}
