//! How late this host wakes a thread and how long it takes a busy poller's CPU away: measured, and
//! what figures in microseconds this allows. It is a measurement of the host as it is now, not a
//! qualification.

mod claims;
mod loops;
mod render;

use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use hil_stats::histogram::LatencyHistogram;
use nix::sys::mman::munlockall;
use serde::{Deserialize, Serialize};

pub use self::claims::{Claim, Standing};
use hil_platform::host_facts::{
    Fact, HostFiles, ProcessorTicks, RealtimeThrottle, format_cpu_list, load_average, online_cpus,
    virtual_machine,
};
use hil_platform::progress::Stage;

/// A busy poller holds its CPU at real-time priority; the kernel's own threads there wait this long at
/// most.
const SPIN_MAX: Duration = Duration::from_secs(10);
/// How often the coordinating thread looks at the wish to stop.
const LOOK_PERIOD: Duration = Duration::from_millis(20);

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
        let seconds = |duration: Duration| duration.as_secs_f64();
        format!(
            "measuring on CPU {}: {} s of wake-ups, {} s of busy polling; Ctrl-C gives what there is so \
             far",
            format_cpu_list(&self.cpus),
            seconds(self.duration),
            seconds(self.spin_total()),
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
    /// What was asked of the kernel and what became of it, in words.
    pub scheduling: Vec<String>,
    /// The kernel gave everything that was asked.
    pub is_as_asked: bool,
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
    pub scheduling: Vec<String>,
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
pub struct Surroundings {
    /// Load averages before.
    pub load_before: Fact<String>,
    /// And after.
    pub load_after: Fact<String>,
    /// Where the processors' time went, the measurement's own share included.
    pub ticks: Fact<ProcessorTicks>,
    /// Whether a hypervisor runs below.
    pub virtual_machine: Fact<String>,
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
    pub surroundings: Surroundings,
    /// What figures this host supports, each with its rule.
    pub claims: Vec<Claim>,
}

impl LatencyReport {
    /// The wake-ups of the CPU that was latest at p99.
    pub fn worst(&self) -> Option<(&Wakeups, Quantiles)> {
        let with_figures = self
            .wakeups
            .iter()
            .filter_map(|one| Some((one, one.lateness?)));
        with_figures.max_by_key(|(_, lateness)| lateness.p99_ns)
    }
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

/// The steps of a measurement, for its progress.
struct Steps<'a> {
    watch: &'a Watch<'a>,
    since: Instant,
    whole: Duration,
}

impl Steps<'_> {
    fn tell(&self, words: &str) {
        if let Some(stage) = self.watch.stage {
            let whole_s = self.whole.as_secs_f64().max(1e-9);
            stage.tell(Some(self.since.elapsed().as_secs_f64() / whole_s), words);
        }
    }

    /// Sets `stop` when somebody wants it, looks until `is_over`.
    fn attend(&self, words: &str, stop: &AtomicBool, is_over: &dyn Fn() -> bool) {
        while !is_over() {
            if (self.watch.is_stopped)() {
                stop.store(true, Ordering::Release);
            }
            self.tell(words);
            thread::sleep(LOOK_PERIOD);
        }
    }
}

/// Measures, for [`LatencyRequest::duration`] per part: wake-ups on all CPUs at once, then a busy
/// poller on one CPU after the other. A wish to stop ends it with what there is.
pub fn measure(request: &LatencyRequest, files: &HostFiles, watch: &Watch<'_>) -> LatencyReport {
    let was_locked = is_locked(files);
    let load_before = load_average(files).map(|(_, words)| words);
    let ticks_before = ProcessorTicks::read(files);
    let whole = if request.is_thorough {
        request.duration + request.spin_total()
    } else {
        request.duration
    };
    let steps = Steps {
        watch,
        since: Instant::now(),
        whole,
    };
    let wakeups = wakeups(request, &steps);
    let mut gaps = Vec::new();
    if request.is_thorough {
        let throttle = RealtimeThrottle::read(files);
        let throttle = throttle.available().copied().filter(|one| one.is_active());
        gaps = spin(request, files, &steps, throttle);
    }
    // Only what this measurement locked is released.
    if !was_locked {
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
        surroundings: Surroundings {
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

fn is_locked(files: &HostFiles) -> bool {
    let locked = files.read_field("/proc/self/status", "VmLck");
    locked
        .available()
        .is_none_or(|amount| !amount.starts_with("0 "))
}

fn ns(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}

/// Each of the CPUs; one place anywhere where none was asked for.
fn places(request: &LatencyRequest) -> Vec<Option<usize>> {
    if request.cpus.is_empty() {
        vec![None]
    } else {
        request.cpus.iter().copied().map(Some).collect()
    }
}

fn wakeups(request: &LatencyRequest, steps: &Steps<'_>) -> Vec<Wakeups> {
    let stop = AtomicBool::new(false);
    thread::scope(|scope| {
        let threads: Vec<_> = places(request)
            .into_iter()
            .map(|cpu| {
                let stop = &stop;
                scope.spawn(move || loops::wake(request, cpu, stop))
            })
            .collect();
        let is_over = || threads.iter().all(thread::ScopedJoinHandle::is_finished);
        steps.attend("wake-ups", &stop, &is_over);
        // A thread that panicked has no figures to show.
        threads
            .into_iter()
            .filter_map(|thread| thread.join().ok())
            .collect()
    })
}

fn spin(
    request: &LatencyRequest,
    files: &HostFiles,
    steps: &Steps<'_>,
    throttle: Option<RealtimeThrottle>,
) -> Vec<Gaps> {
    let mut found = Vec::new();
    // On the only CPU a poller at real-time priority would stop the whole host, this program too.
    let is_alone = online_cpus(files)
        .available()
        .is_some_and(|cpus| cpus.len() < 2);
    for cpu in places(request) {
        if (steps.watch.is_stopped)() {
            break;
        }
        let stop = AtomicBool::new(false);
        let settings = loops::Spin {
            cpu,
            priority: (!is_alone).then_some(request.priority),
            duration: request.spin_duration(),
            throttle_ns: throttle.map(|one| (one.period_us - one.runtime_us) * 1000),
        };
        let words = cpu.map_or("busy polling".to_owned(), |cpu| {
            format!("busy polling on CPU {cpu}")
        });
        let gaps = thread::scope(|scope| {
            let thread = scope.spawn(|| loops::spin(&settings, &stop));
            steps.attend(&words, &stop, &|| thread.is_finished());
            thread.join().ok()
        });
        found.extend(gaps);
    }
    found
}

#[cfg(test)]
mod tests {
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
}
