//! Pins a thread, gives it a real-time priority, locks memory, and reports what the kernel
//! refused. It decides nothing: a refusal is listed with its reason and cure, and the caller (or
//! the reader of the run's report) judges. Also here: the kernel calls `nix` lacks.

use std::time::Duration;

use core_affinity::CoreId;
use nix::errno::Errno;
use nix::sched::{CpuSet, sched_getaffinity, sched_setaffinity};
use nix::sys::mman::{MlockAllFlags, mlockall};
use nix::sys::prctl;
use nix::sys::resource::Resource;
use nix::unistd::Pid;
use serde::{Deserialize, Serialize};

use crate::host_facts::{
    CAP_SYS_NICE, Fact, HostFiles, IsolatedCpus, RealtimeThrottle, format_cpu_list,
    has_fair_server, limit, online_cpus,
};

/// How the kernel schedules a thread.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "policy")]
pub enum SchedulingPolicy {
    /// The normal policy, `SCHED_OTHER`.
    #[default]
    Other,
    /// `SCHED_FIFO`: runs until it blocks, before every normal task.
    Fifo {
        /// 1 (lowest) to 99. Kernel threads for interrupts run at 50 on `PREEMPT_RT`.
        priority: u8,
    },
}

impl SchedulingPolicy {
    /// Policy with its flags, and priority, as the kernel numbers them.
    const fn of_kernel(self, fifo_flags: libc::c_int) -> (libc::c_int, u8) {
        match self {
            Self::Other => (libc::SCHED_OTHER, 0),
            Self::Fifo { priority } => (libc::SCHED_FIFO | fifo_flags, priority),
        }
    }
}

impl std::fmt::Display for SchedulingPolicy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Other => f.write_str("SCHED_OTHER"),
            Self::Fifo { priority } => write!(f, "SCHED_FIFO {priority}"),
        }
    }
}

/// The calling thread, in the kernel's numbers.
const OWN_THREAD: libc::pid_t = 0;

/// What a thread asks of the kernel.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RealtimeRequest {
    /// The one CPU to run on; `None` leaves the mask alone.
    pub cpu: Option<usize>,
    /// The scheduling policy.
    pub policy: SchedulingPolicy,
    /// Lock all present and future pages of the process, so that none faults later.
    pub lock_memory: bool,
    /// How late the kernel may fire this thread's timers to save wake-ups; without effect under
    /// `SCHED_FIFO`, where it is always zero.
    pub timer_slack: Option<Duration>,
}

/// One thing that was asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RealtimeItem {
    /// Running on one CPU only.
    CpuPinning,
    /// Pages that stay in memory.
    MemoryLock,
    /// The timer slack.
    TimerSlack,
    /// The scheduling policy and priority.
    Scheduling,
}

/// What the kernel made of one item.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "outcome")]
pub enum GrantOutcome {
    /// Set, and read back as asked.
    Granted,
    /// Not set.
    Refused {
        /// The kernel's error, for example `EPERM: Operation not permitted`.
        error: String,
        /// What this host lacks.
        reason: String,
        /// What to change.
        fix: String,
    },
}

/// One item with its outcome.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RealtimeGrantItem {
    /// What was asked for.
    pub item: RealtimeItem,
    /// The request in words, for example `SCHED_FIFO 80`.
    pub asked: String,
    /// What became of it.
    #[serde(flatten)]
    pub outcome: GrantOutcome,
}

impl std::fmt::Display for RealtimeGrantItem {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.outcome {
            GrantOutcome::Granted => write!(f, "{} granted", self.asked),
            GrantOutcome::Refused { error, reason, fix } => {
                write!(f, "{} refused: {error}; {reason}; {fix}", self.asked)
            }
        }
    }
}

/// Everything that was asked for, granted or refused.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct RealtimeGrant {
    /// One entry per item of the request, in the order they were tried.
    pub items: Vec<RealtimeGrantItem>,
}

impl RealtimeGrant {
    /// The kernel gave everything.
    pub fn is_complete(&self) -> bool {
        self.refusals().next().is_none()
    }

    /// Nothing that was asked of `item` was refused.
    pub fn has(&self, item: RealtimeItem) -> bool {
        self.refusals().all(|one| one.item != item)
    }

    /// The items the kernel refused.
    pub fn refusals(&self) -> impl Iterator<Item = &RealtimeGrantItem> {
        self.items
            .iter()
            .filter(|entry| entry.outcome != GrantOutcome::Granted)
    }

    fn add_policy(&mut self, policy: SchedulingPolicy, fifo_flags: libc::c_int) {
        let (number, priority) = policy.of_kernel(fifo_flags);
        let result = schedule(number, priority);
        self.add(RealtimeItem::Scheduling, policy.to_string(), result);
    }

    fn add(&mut self, item: RealtimeItem, asked: String, result: Result<(), Refusal>) {
        let outcome = match result {
            Ok(()) => GrantOutcome::Granted,
            Err(Refusal { error, reason, fix }) => GrantOutcome::Refused { error, reason, fix },
        };
        self.items.push(RealtimeGrantItem {
            item,
            asked,
            outcome,
        });
    }
}

struct Refusal {
    error: String,
    reason: String,
    fix: String,
}

impl Refusal {
    fn new(errno: Errno, reason: impl Into<String>, fix: impl Into<String>) -> Self {
        let error = format!("{errno:?}: {}", errno.desc());
        Self {
            error,
            reason: reason.into(),
            fix: fix.into(),
        }
    }
}

/// Applies `request` to the calling thread (the memory lock to the whole process) and lists what
/// was granted and what was refused.
///
/// The priority comes last, so that a thread never spins at real-time priority on a CPU it is
/// about to leave. Threads and processes started later by this thread do not inherit the
/// real-time policy (`SCHED_RESET_ON_FORK`), but they do inherit the CPU mask.
pub fn apply(request: &RealtimeRequest) -> RealtimeGrant {
    let mut grant = prepare(request, request.cpu.as_slice());
    grant.add_policy(request.policy, libc::SCHED_RESET_ON_FORK);
    grant
}

/// As [`apply`], for a program that this process becomes: it may use all of `cpus`, any where that is empty, and its
/// threads and children inherit its policy. The normal policy is not asked for: it has what this process has.
pub fn apply_to_program(
    policy: SchedulingPolicy,
    timer_slack: Option<Duration>,
    cpus: &[usize],
) -> RealtimeGrant {
    let request = RealtimeRequest {
        policy,
        timer_slack,
        ..RealtimeRequest::default()
    };
    let mut grant = prepare(&request, cpus);
    if policy != SchedulingPolicy::Other {
        grant.add_policy(policy, 0);
    }
    grant
}

/// All but the policy, which comes last.
fn prepare(request: &RealtimeRequest, cpus: &[usize]) -> RealtimeGrant {
    let mut grant = RealtimeGrant::default();
    if !cpus.is_empty() {
        let asked = format!("cpu {}", format_cpu_list(cpus));
        grant.add(RealtimeItem::CpuPinning, asked, pin_to(cpus));
    }
    if request.lock_memory {
        let result = lock_memory();
        grant.add(RealtimeItem::MemoryLock, "locked memory".to_owned(), result);
    }
    if let Some(slack) = request.timer_slack {
        let asked = format!("timer slack {} ns", slack.as_nanos());
        grant.add(RealtimeItem::TimerSlack, asked, set_timer_slack(slack));
    }
    grant
}

/// True when the calling thread runs before every normal task, under `SCHED_FIFO` or `SCHED_RR`: whether
/// it asked for that or inherited it, and not when it asked in vain.
pub fn has_realtime_priority() -> bool {
    let policy = current_policy() & !libc::SCHED_RESET_ON_FORK;
    matches!(policy, libc::SCHED_FIFO | libc::SCHED_RR)
}

fn pin_to(cpus: &[usize]) -> Result<(), Refusal> {
    let online = || {
        let files = HostFiles::of_this_host();
        online_cpus(&files)
            .map(|cpus| format_cpu_list(&cpus))
            .to_text()
    };
    let refused = |errno| {
        let reason = format!("the CPUs online are {}", online());
        let fix = "choose one of them that the process's cpuset also allows";
        Refusal::new(errno, reason, fix)
    };
    let mut asked = CpuSet::new();
    for cpu in cpus {
        asked.set(*cpu).map_err(refused)?;
    }
    match cpus {
        &[id] => {
            if !core_affinity::set_for_current(CoreId { id }) {
                return Err(refused(Errno::last()));
            }
        }
        // The crate sets one.
        _ => sched_setaffinity(Pid::from_raw(OWN_THREAD), &asked).map_err(refused)?,
    }
    let granted = sched_getaffinity(Pid::from_raw(OWN_THREAD)).map_err(refused)?;
    if granted == asked {
        Ok(())
    } else {
        Err(refused(Errno::EAGAIN))
    }
}

/// The CPUs that threads of this process may be pinned to: those of its cpuset that are online.
///
/// # Errors
/// When the kernel does not tell.
pub fn allowed_cpus() -> Result<Vec<usize>, Errno> {
    // In a thread of its own, whose mask nobody inherits. The kernel takes of a mask what is allowed.
    let asked = std::thread::Builder::new().spawn(|| {
        let mut mask = CpuSet::new();
        for cpu in 0..CpuSet::count() {
            mask.set(cpu)?;
        }
        sched_setaffinity(Pid::from_raw(0), &mask)?;
        let granted = sched_getaffinity(Pid::from_raw(0))?;
        let cpus = (0..CpuSet::count()).filter(|cpu| granted.is_set(*cpu).unwrap_or(false));
        Ok(cpus.collect())
    });
    asked
        .map_err(|_no_thread| Errno::EAGAIN)?
        .join()
        .unwrap_or(Err(Errno::EAGAIN))
}

fn lock_memory() -> Result<(), Refusal> {
    mlockall(MlockAllFlags::MCL_CURRENT | MlockAllFlags::MCL_FUTURE).map_err(|errno| {
        let limit = limit(Resource::RLIMIT_MEMLOCK, " bytes").to_text();
        let reason = format!("RLIMIT_MEMLOCK is {limit} and CAP_IPC_LOCK is missing");
        Refusal::new(
            errno,
            reason,
            "needs CAP_IPC_LOCK or LimitMEMLOCK=infinity in the unit",
        )
    })
}

fn set_timer_slack(slack: Duration) -> Result<(), Refusal> {
    // Zero would mean "back to the default of 50 us" to the kernel, which nobody asked for.
    let slack_ns = libc::c_ulong::try_from(slack.as_nanos())
        .unwrap_or(libc::c_ulong::MAX)
        .max(1);
    prctl::set_timerslack(slack_ns).map_err(|errno| {
        Refusal::new(
            errno,
            "the kernel rejected the timer slack",
            "leave it unset",
        )
    })
}

fn schedule(policy: libc::c_int, priority: u8) -> Result<(), Refusal> {
    let set = set_scheduler(policy, priority);
    set.map_err(|errno| explain(errno, policy, priority))?;
    let actual = current_policy();
    if actual & !libc::SCHED_RESET_ON_FORK == policy & !libc::SCHED_RESET_ON_FORK {
        return Ok(());
    }
    let reason = format!("the kernel accepted the call but reports policy {actual}");
    Err(Refusal::new(Errno::EAGAIN, reason, "report this kernel"))
}

fn explain(errno: Errno, policy: libc::c_int, priority: u8) -> Refusal {
    match policy {
        libc::SCHED_OTHER => explain_raising(errno),
        _ => explain_scheduling(errno, priority, &HostFiles::of_this_host()),
    }
}

/// `SCHED_IDLE` counts as nice 20, which a task without rights may enter and not leave.
fn explain_raising(errno: Errno) -> Refusal {
    let nice = limit(Resource::RLIMIT_NICE, "").to_text();
    Refusal::new(
        errno,
        format!("RLIMIT_NICE is {nice}"),
        // Without a sign systemd takes the raw limit, of which 0 allows nothing (systemd.exec(5)).
        "needs CAP_SYS_NICE or LimitNICE=+0 in the unit",
    )
}

fn explain_scheduling(errno: Errno, priority: u8, files: &HostFiles) -> Refusal {
    if errno == Errno::EINVAL {
        let reason = format!("priority {priority} is outside 1 to 99");
        return Refusal::new(errno, reason, "choose a priority from 1 to 99");
    }
    if files.holds_capability(CAP_SYS_NICE) == Fact::Available(true) {
        return Refusal::new(
            errno,
            "CAP_SYS_NICE is held, so the control group has no real-time budget \
             (CONFIG_RT_GROUP_SCHED)",
            "give the group a budget in cpu.rt_runtime_us, or boot with rt_group_sched=0",
        );
    }
    let rtprio = limit(Resource::RLIMIT_RTPRIO, "").to_text();
    Refusal::new(
        errno,
        format!("RLIMIT_RTPRIO is {rtprio}"),
        "needs CAP_SYS_NICE or LimitRTPRIO",
    )
}

#[allow(unsafe_code, reason = "nix has no sched_setscheduler")]
fn set_scheduler(policy: libc::c_int, priority: u8) -> Result<(), Errno> {
    let parameters = libc::sched_param {
        sched_priority: i32::from(priority),
    };
    // SAFETY: the pointer is to a live, fully initialised `sched_param` that the call only reads.
    let code = unsafe { libc::sched_setscheduler(OWN_THREAD, policy, &raw const parameters) };
    Errno::result(code).map(drop)
}

#[allow(unsafe_code, reason = "nix has no sched_getscheduler")]
fn current_policy() -> libc::c_int {
    // SAFETY: the call takes no pointer.
    unsafe { libc::sched_getscheduler(OWN_THREAD) }
}

/// What the kernel knows about how `CLOCK_REALTIME` is steered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ClockDiscipline {
    /// A daemon claims that the clock follows a reference.
    pub(crate) is_synchronised: bool,
    /// The daemon's claim about the largest error; grows by 500 us per second when nobody renews it.
    pub(crate) max_error_us: i64,
    /// The daemon's estimate of the error.
    pub(crate) estimated_error_us: i64,
    /// Rate correction in force, in parts per billion.
    pub(crate) frequency_ppb: i64,
}

/// Asks the kernel (`adjtimex`, read only) how the time of day is steered.
#[allow(unsafe_code, reason = "nix has no adjtimex")]
pub(crate) fn clock_discipline() -> Result<ClockDiscipline, Errno> {
    // SAFETY: `timex` is a C struct of integers, for which all-zero bytes are a valid value.
    let mut state: libc::timex = unsafe { std::mem::zeroed() };
    // SAFETY: the pointer is to a live `timex`; with `modes` zero the call only fills it in.
    let code = Errno::result(unsafe { libc::adjtimex(&raw mut state) })?;
    Ok(ClockDiscipline {
        is_synchronised: code != libc::TIME_ERROR && state.status & libc::STA_UNSYNC == 0,
        max_error_us: state.maxerror,
        estimated_error_us: state.esterror,
        // The kernel counts in parts per million with 16 fraction bits.
        frequency_ppb: state.freq.saturating_mul(1000) >> 16,
    })
}

/// Whether a busy-polling thread at real-time priority belongs on a CPU.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SpinAdvice {
    /// Nothing takes the CPU away.
    Fine,
    /// The poller will lose time, or take it from others; why.
    Warn(String),
}

/// Judges a busy-polling `SCHED_FIFO` thread on `cpu` of this host.
pub fn spin_advice(cpu: usize) -> SpinAdvice {
    spin_advice_in(cpu, &HostFiles::of_this_host())
}

/// Whether `cpu` of this host is kept free of other threads; false where that is unknown.
pub(crate) fn is_isolated(cpu: usize) -> bool {
    let isolated = IsolatedCpus::read(&HostFiles::of_this_host()).isolated;
    isolated.available().is_some_and(|cpus| cpus.contains(&cpu))
}

pub(crate) fn spin_advice_in(cpu: usize, files: &HostFiles) -> SpinAdvice {
    let isolated = IsolatedCpus::read(files).isolated;
    let is_isolated = isolated.available().is_some_and(|cpus| cpus.contains(&cpu));
    let has_fair_server = has_fair_server(files).available() == Some(&true);
    let throttle = match RealtimeThrottle::read(files) {
        Fact::Available(throttle) => throttle,
        Fact::Unavailable(reason) => {
            return SpinAdvice::Warn(format!("the real-time throttle is unknown: {reason}"));
        }
    };
    let (runtime_us, is_throttled) = (throttle.runtime_us, throttle.is_active());
    let (lost_ms, period_ms) = (throttle.lost_ms(), throttle.period_ms());
    match (is_isolated, is_throttled) {
        (true, true) if !has_fair_server => SpinAdvice::Warn(format!(
            "cpu {cpu} is isolated, but sched_rt_runtime_us={runtime_us} stops a FIFO spinner for \
             {lost_ms} ms of every {period_ms} ms all the same; set it to -1"
        )),
        (true, _) => SpinAdvice::Fine,
        (false, true) => SpinAdvice::Warn(format!(
            "cpu {cpu} is not isolated and sched_rt_runtime_us={runtime_us}: a FIFO spinner blacks \
             out for about {lost_ms} ms of every {period_ms} ms when any normal task wants the CPU; boot \
             with isolcpus={cpu} or use a waiting mode that blocks"
        )),
        (false, false) if has_fair_server => SpinAdvice::Warn(format!(
            "cpu {cpu} is not isolated: since Linux 6.12 normal tasks are lent about 50 ms of every \
             second even with sched_rt_runtime_us=-1; boot with isolcpus={cpu}"
        )),
        (false, false) => SpinAdvice::Warn(format!(
            "cpu {cpu} is not isolated and the throttle is off: a FIFO spinner starves the kernel's \
             own workers there, the one that arms receive timestamps among them; boot with \
             isolcpus={cpu}"
        )),
    }
}

#[cfg(test)]
#[path = "realtime/tests.rs"]
mod tests;
