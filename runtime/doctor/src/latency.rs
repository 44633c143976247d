//! How late this host wakes a thread and how long it takes a busy poller's CPU away: measured, and
//! what figures in microseconds this allows. It is a measurement of the host as it is now, not a
//! qualification.

mod claims;

use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use hil_core::time::PeriodicTimer;
use hil_stats::histogram::LatencyHistogram;
use nix::sys::mman::munlockall;
use nix::sys::resource::{UsageWho, getrusage};
use serde::{Deserialize, Serialize};

pub use self::claims::{Claim, Standing};
pub(super) use self::claims::{judge, us_up};
use super::finding::Answer;
use hil_platform::clock::{MonotonicClock, Wake};
use hil_platform::host_facts::{
    Fact, HostFiles, ProcessorTicks, RealtimeThrottle, format_cpu_list, load_average, online_cpus,
    virtual_machine,
};
use hil_platform::progress::Stage;
use hil_platform::realtime::{
    RealtimeGrant, RealtimeItem, RealtimeRequest, SchedulingPolicy, apply,
};

/// A busy poller holds its CPU at real-time priority; the kernel's own threads there wait this long at
/// most.
const SPIN_MAX: Duration = Duration::from_secs(10);
/// How often the coordinating thread looks at the wish to stop.
const LOOK_PERIOD: Duration = Duration::from_millis(20);
/// Longer values make the histogram allocate; by then the measurement is spoilt anyway.
const ROOM_NS: u64 = 10_000_000_000;
/// Instants that one stall may be counted for; a stall longer than that is a host that slept.
const STALL_INSTANTS_MAX: u64 = 1_000_000;

/// What to measure.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LatencyRequest {
    /// How long, each part.
    pub duration: Duration,
    /// Where: one thread per CPU. None means one thread on whichever CPU.
    pub cpus: Vec<usize>,
    /// `SCHED_FIFO` priority, 1 to 99.
    pub priority: u8,
    /// From one wake-up to the next.
    pub period: Duration,
    /// Also measure the gaps of a busy poller.
    pub is_thorough: bool,
}

impl LatencyRequest {
    /// A second on one CPU, or on any: what a look at the host has time for.
    pub fn brief(cpu: Option<usize>) -> Self {
        Self {
            duration: Duration::from_secs(1),
            cpus: cpu.into_iter().collect(),
            priority: 80,
            period: Duration::from_millis(1),
            is_thorough: false,
        }
    }

    /// What is about to happen and how long it takes, for whoever waits.
    pub fn announcement(&self) -> String {
        let (wakeups, spinning) = (self.duration, self.spin_total());
        format!(
            "measuring on CPU {}: {} s of wake-ups, {} s of busy polling; Ctrl-C gives what there is so \
             far",
            format_cpu_list(&self.cpus),
            wakeups.as_secs_f64(),
            spinning.as_secs_f64(),
        )
    }

    fn spin_total(&self) -> Duration {
        let count = u32::try_from(self.cpus.len().max(1)).unwrap_or(1);
        self.spin_duration() * count
    }

    /// How long a busy poller spins on each CPU.
    fn spin_duration(&self) -> Duration {
        self.duration.min(SPIN_MAX)
    }

    /// Each of the CPUs; one place anywhere where none was asked for.
    fn places(&self) -> Vec<Option<usize>> {
        if self.cpus.is_empty() {
            vec![None]
        } else {
            self.cpus.iter().copied().map(Some).collect()
        }
    }
}

/// Quantiles of what was measured, nanoseconds, within 0.1 %.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Quantiles {
    /// Median.
    pub p50_ns: i64,
    /// 99 %.
    pub p99_ns: i64,
    /// 99.9 %.
    pub p999_ns: i64,
    /// The largest.
    pub max_ns: i64,
}

impl Quantiles {
    fn of(histogram: &LatencyHistogram) -> Option<Self> {
        let summary = histogram.summary()?;
        Some(Self {
            p50_ns: summary.p50_ns,
            p99_ns: summary.p99_ns,
            p999_ns: summary.p999_ns,
            max_ns: summary.max_ns,
        })
    }
}

/// Lateness of the wake-ups of one thread.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Wakeups {
    /// The CPU it was pinned to; `None` when it was left to run anywhere.
    pub cpu: Option<usize>,
    /// What was asked of the kernel, granted or refused.
    pub scheduling: RealtimeGrant,
    /// How long it measured, nanoseconds.
    pub measured_ns: u64,
    /// Instants to wake at that fell into this time. Each has a lateness: one that passed while the
    /// thread was still late from the one before counts with what it would have had.
    pub count: u64,
    /// Those of them that passed so.
    pub skipped_count: u64,
    /// Times that the kernel took the CPU away from the thread.
    pub preempted_count: Option<u64>,
    /// The lateness; `None` without a single wake-up.
    pub lateness: Option<Quantiles>,
}

/// Gaps between two looks at the clock of a thread that does nothing else.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Gaps {
    /// The CPU it was pinned to; `None` when it was left to run anywhere.
    pub cpu: Option<usize>,
    /// As for [`Wakeups::scheduling`].
    pub scheduling: RealtimeGrant,
    /// How long it measured, nanoseconds.
    pub measured_ns: u64,
    /// Looks at the clock.
    pub look_count: u64,
    /// Gaps longer than [`Gaps::LEAST_NS`].
    pub count: u64,
    /// Their sum, nanoseconds.
    pub lost_ns: u64,
    /// Those as long, within a tenth, as what the real-time throttle keeps back per period; `None`
    /// when there is no throttle.
    pub throttle_like_count: Option<u64>,
    /// Their lengths; `None` without a gap.
    pub length: Option<Quantiles>,
}

impl Gaps {
    /// Shorter gaps are the loop itself and its cache misses.
    pub const LEAST_NS: i64 = 10_000;

    /// Milliseconds lost of every second.
    pub fn lost_ms_per_s(&self) -> f64 {
        self.lost_ns as f64 / 1e6 / self.seconds()
    }

    /// Gaps in every second.
    pub fn per_second(&self) -> f64 {
        self.count as f64 / self.seconds()
    }

    fn seconds(&self) -> f64 {
        (self.measured_ns as f64 * 1e-9).max(1e-9)
    }
}

/// What else the host did meanwhile.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct HostActivity {
    /// Load averages before.
    pub load_before: Fact<String>,
    /// And after.
    pub load_after: Fact<String>,
    /// Where the processors' time went, the measurement's own share included.
    pub ticks: Fact<ProcessorTicks>,
    /// Whether a hypervisor runs below.
    pub virtual_machine: Fact<String>,
}

impl LatencyReport {
    /// The wake-ups of threads that were where they were to be: a CPU outside the cpuset has none.
    pub(crate) fn measured_wakeups(&self) -> impl Iterator<Item = &Wakeups> {
        let is_there = |one: &&Wakeups| one.scheduling.has(RealtimeItem::CpuPinning);
        self.wakeups.iter().filter(is_there)
    }

    /// As [`LatencyReport::measured_wakeups`], of pollers.
    pub(crate) fn measured_gaps(&self) -> impl Iterator<Item = &Gaps> {
        let is_there = |one: &&Gaps| one.scheduling.has(RealtimeItem::CpuPinning);
        self.gaps.iter().filter(is_there)
    }
}

/// What was measured and what it allows.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LatencyReport {
    /// How long each part was to take, nanoseconds.
    pub duration_ns: u64,
    /// From one wake-up to the next, nanoseconds.
    pub period_ns: u64,
    /// The priority asked for.
    pub priority: u8,
    /// It has the parts beyond the wake-ups.
    pub is_thorough: bool,
    /// It was stopped before its time; what is here is what there was so far.
    pub is_interrupted: bool,
    /// One per thread.
    pub wakeups: Vec<Wakeups>,
    /// One per CPU, in turn; empty in a brief measurement.
    pub gaps: Vec<Gaps>,
    /// What else went on.
    pub surroundings: HostActivity,
    /// What figures this host supports, each with its rule.
    pub claims: Vec<Claim>,
}

/// How far it is, and whether to go on.
pub struct Watch<'a> {
    /// True as soon as somebody wants it to end.
    pub is_stopped: &'a dyn Fn() -> bool,
    /// Told how far it is.
    pub stage: Option<&'a Stage>,
}

impl core::fmt::Debug for Watch<'_> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let is_stopped = (self.is_stopped)();
        f.debug_struct("Watch")
            .field("is_stopped", &is_stopped)
            .finish_non_exhaustive()
    }
}

/// Measures, for [`LatencyRequest::duration`] per part: wake-ups on all CPUs at once, then a busy
/// poller on one CPU after the other. A wish to stop ends it with what there is.
pub fn measure(request: &LatencyRequest, files: &HostFiles, watch: &Watch<'_>) -> LatencyReport {
    let locked = files.read_field("/proc/self/status", "VmLck");
    let was_unlocked = locked.known().is_ok_and(|amount| amount.starts_with("0 "));
    let load_before = load_average(files).map(|(_, words)| words);
    let ticks_before = ProcessorTicks::read(files);
    let since = Instant::now();
    let mut whole = request.duration;
    if request.is_thorough {
        whole += request.spin_total();
    }
    let whole_s = whole.as_secs_f64().max(1e-9);
    // Sets `stop` when somebody wants it, looks until `is_over`.
    let attend = |words: &str, stop: &AtomicBool, is_over: &dyn Fn() -> bool| {
        while !is_over() {
            if (watch.is_stopped)() {
                stop.store(true, Ordering::Release);
            }
            if let Some(stage) = watch.stage {
                stage.tell(Some(since.elapsed().as_secs_f64() / whole_s), words);
            }
            thread::sleep(LOOK_PERIOD);
        }
    };
    let stop = &AtomicBool::new(false);
    let wakeups = thread::scope(|scope| {
        let start = |cpu| scope.spawn(move || wake(request, cpu, stop));
        let threads: Vec<_> = request.places().into_iter().map(start).collect();
        let is_over = || threads.iter().all(thread::ScopedJoinHandle::is_finished);
        attend("wake-ups", stop, &is_over);
        // A thread that panicked has no figures to show.
        let joined = threads.into_iter().map(thread::ScopedJoinHandle::join);
        joined.filter_map(Result::ok).collect()
    });
    let throttle = RealtimeThrottle::read(files);
    let throttle = throttle.available().filter(|one| one.is_active());
    let throttle_ns = throttle.map(|one| (one.period_us - one.runtime_us) * 1000);
    // On the only CPU a poller at real-time priority would stop the whole host, this program too.
    let is_alone = online_cpus(files).known().is_ok_and(|cpus| cpus.len() < 2);
    let priority = (!is_alone).then_some(request.priority);
    let duration = request.spin_duration();
    let mut gaps = Vec::new();
    for cpu in request.places() {
        if !request.is_thorough || (watch.is_stopped)() {
            break;
        }
        let stop = AtomicBool::new(false);
        let on = cpu.map_or_else(String::new, |cpu| format!(" on CPU {cpu}"));
        gaps.extend(thread::scope(|scope| {
            let thread = scope.spawn(|| spin(cpu, priority, duration, throttle_ns, &stop));
            attend(&format!("busy polling{on}"), &stop, &|| {
                thread.is_finished()
            });
            thread.join().ok()
        }));
    }
    // Only what this measurement locked is released.
    if was_unlocked {
        let _released = munlockall().is_ok();
    }
    let ticks_after = ProcessorTicks::read(files);
    let mut report = LatencyReport {
        duration_ns: ns(request.duration),
        period_ns: ns(request.period),
        priority: request.priority,
        is_thorough: request.is_thorough,
        is_interrupted: (watch.is_stopped)(),
        wakeups,
        gaps,
        surroundings: HostActivity {
            load_before,
            load_after: load_average(files).map(|(_, words)| words),
            ticks: ticks_before.and_then(|before| ticks_after.map(|after| after.since(before))),
            virtual_machine: virtual_machine(files),
        },
        claims: Vec::new(),
    };
    report.claims = claims::derive(&report);
    report
}

fn ns(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}

/// Pins this thread, locks memory, takes the priority; reports the result of each.
fn prepare(cpu: Option<usize>, priority: Option<u8>) -> RealtimeGrant {
    apply(&RealtimeRequest {
        cpu,
        policy: match priority {
            Some(priority) => SchedulingPolicy::Fifo { priority },
            None => SchedulingPolicy::Other,
        },
        lock_memory: true,
        ..RealtimeRequest::default()
    })
}

/// How long to measure: not at all where the thread is not on the CPU that the figures would be called
/// after, such as one outside the cpuset.
fn duration_of(asked: Duration, grant: &RealtimeGrant) -> Duration {
    if grant.has(RealtimeItem::CpuPinning) {
        asked
    } else {
        Duration::ZERO
    }
}

/// Times that the kernel took the CPU away from this thread so far.
fn preempted_count() -> Option<u64> {
    let usage = getrusage(UsageWho::RUSAGE_THREAD).ok()?;
    u64::try_from(usage.involuntary_context_switches()).ok()
}

/// Sleeps to the instants of a grid until the time is over or `stop` is set. It neither allocates,
/// locks nor logs while it measures.
fn wake(request: &LatencyRequest, cpu: Option<usize>, stop: &AtomicBool) -> Wakeups {
    let grant = prepare(cpu, Some(request.priority));
    let mut histogram = LatencyHistogram::with_room(ROOM_NS);
    let period_ns = i64::try_from(ns(request.period)).unwrap_or(i64::MAX);
    let mut timer = PeriodicTimer::new(request.period);
    let preempted_before = preempted_count();
    let start = MonotonicClock::now();
    let end = start + duration_of(request.duration, &grant);
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
        scheduling: grant,
        measured_ns: u64::try_from(measured).unwrap_or(0),
        count: histogram.count(),
        skipped_count,
        preempted_count: preempted.map(|(before, after)| after.saturating_sub(before)),
        lateness: Quantiles::of(&histogram),
    }
}

/// Looks at the clock without pause until the time is over or `stop` is set, at `SCHED_FIFO` where a
/// priority is given. `throttle_ns` is what the real-time throttle keeps back per period. It neither
/// allocates, locks nor logs while it measures.
fn spin(
    cpu: Option<usize>,
    priority: Option<u8>,
    duration: Duration,
    throttle_ns: Option<i64>,
    stop: &AtomicBool,
) -> Gaps {
    let grant = prepare(cpu, priority);
    let mut histogram = LatencyHistogram::with_room(ROOM_NS);
    let kept_back_ns = throttle_ns.unwrap_or(0);
    let (mut look_count, mut lost_ns, mut throttle_like_count) = (0, 0, 0);
    let start = MonotonicClock::now();
    let end = start + duration_of(duration, &grant);
    let mut last = start;
    while last < end && !stop.load(Ordering::Relaxed) {
        let now = MonotonicClock::now();
        look_count += 1;
        let gap_ns = now.ns_since(last);
        last = now;
        if gap_ns > Gaps::LEAST_NS {
            histogram.record(gap_ns);
            lost_ns += gap_ns.unsigned_abs();
            let is_throttle_like = (gap_ns - kept_back_ns).abs() <= kept_back_ns / 10;
            throttle_like_count += u64::from(is_throttle_like);
        }
    }
    Gaps {
        cpu,
        scheduling: grant,
        measured_ns: u64::try_from(last.ns_since(start)).unwrap_or(0),
        look_count,
        count: histogram.count(),
        lost_ns,
        throttle_like_count: throttle_ns.map(|_| throttle_like_count),
        length: Quantiles::of(&histogram),
    }
}

#[cfg(test)]
mod tests {
    use hil_platform::realtime::GrantOutcome;

    use super::*;

    fn brief_of(milliseconds: u64) -> LatencyRequest {
        LatencyRequest {
            duration: Duration::from_millis(milliseconds),
            ..LatencyRequest::brief(None)
        }
    }

    fn request() -> LatencyRequest {
        LatencyRequest {
            is_thorough: true,
            ..brief_of(100)
        }
    }

    #[test]
    fn every_instant_of_the_grid_is_counted_once() {
        let files = HostFiles::of_this_host();
        let watch = Watch {
            is_stopped: &|| false,
            stage: None,
        };
        let brief = brief_of(100);
        let report = measure(&brief, &files, &watch);
        let wakeups = &report.wakeups[0];
        // The last instant may pass while the thread is late from the one before.
        assert!(wakeups.count >= 99, "{wakeups:?}");
        let expected = wakeups.measured_ns / report.period_ns;
        assert!(wakeups.count.abs_diff(expected) <= 1, "{wakeups:?}");
        let lateness = wakeups.lateness.unwrap();
        assert!(lateness.p50_ns >= 0 && lateness.p50_ns <= lateness.p99_ns);
        assert!(lateness.p99_ns <= lateness.p999_ns && lateness.p999_ns <= lateness.max_ns);
        assert!(report.gaps.is_empty(), "a brief measurement does not spin");
        assert!(!report.claims.is_empty());
    }

    #[test]
    fn a_stop_gives_what_there_is_so_far() {
        let long = LatencyRequest {
            duration: Duration::from_hours(1),
            ..request()
        };
        let looks = std::cell::Cell::new(0);
        let is_stopped = || {
            looks.set(looks.get() + 1);
            looks.get() > 2
        };
        let watch = Watch {
            is_stopped: &is_stopped,
            stage: None,
        };
        let report = measure(&long, &HostFiles::of_this_host(), &watch);
        assert!(report.is_interrupted);
        assert_eq!(report.wakeups.len(), 1);
        assert!(report.gaps.is_empty());
        let text = serde_json::to_string(&report).unwrap();
        assert_eq!(
            serde_json::from_str::<LatencyReport>(&text).unwrap(),
            report
        );
    }

    #[test]
    fn a_poller_sees_no_gap_shorter_than_the_least_and_ends_in_time() {
        let spun = |is_stopped| {
            let stop = AtomicBool::new(is_stopped);
            spin(
                None,
                None,
                Duration::from_millis(30),
                Some(50_000_000),
                &stop,
            )
        };
        let gaps = spun(false);
        assert!(gaps.measured_ns >= 30_000_000, "{gaps:?}");
        assert!(gaps.look_count > 1000, "{gaps:?}");
        assert!(gaps.lost_ns <= gaps.measured_ns, "{gaps:?}");
        assert_eq!(gaps.length.is_some(), gaps.count > 0);
        assert!(gaps.length.is_none_or(|one| one.p50_ns > Gaps::LEAST_NS));
        let stopped = spun(true);
        assert_eq!((stopped.look_count, stopped.count), (0, 0));
    }

    #[test]
    fn no_time_means_no_metrics() {
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
        assert!(!wakeups.scheduling.is_complete());
        assert_eq!((wakeups.count, wakeups.lateness), (0, None), "of no CPU");
        let gaps = spin(
            Some(1000),
            None,
            request.duration,
            None,
            &AtomicBool::new(false),
        );
        assert_eq!((gaps.look_count, gaps.count, gaps.length), (0, 0, None));
        let pin = &wakeups.scheduling.items[0];
        assert!(
            pin.asked == "cpu 1000" && matches!(pin.outcome, GrantOutcome::Refused { .. }),
            "{wakeups:?}"
        );
    }
}
