//! What this process may ask of the kernel: real-time priority, locked memory and eBPF programs, tried
//! and not just read from limits. The tries leave no trace: the priority is taken by a thread that
//! ends, the lock is released again, and a program is attached nowhere.

use std::thread;

use hil_gateways::transport::bpf_tap;
use nix::sys::mman::{MlockAllFlags, mlockall, munlockall};
use nix::sys::resource::Resource;

use super::Finding;
use crate::host_facts::{CAP_IPC_LOCK, CAP_SYS_NICE, Fact, HostFiles, limit};
use crate::realtime::{GrantOutcome, RealtimeRequest, SchedulingPolicy, apply};

/// A typical priority of a control loop, above the interrupt threads of `PREEMPT_RT`.
const TRIED_PRIORITY: u8 = 80;

pub(crate) fn examine(files: &HostFiles) -> Vec<Finding> {
    vec![throttle(files), fifo(files), memory_lock(files), tap()]
}

fn throttle(files: &HostFiles) -> Finding {
    let (id, title) = ("realtime_throttle", "Share of time for SCHED_FIFO");
    let runtime_us = match files.read_number("/proc/sys/kernel/sched_rt_runtime_us") {
        Fact::Available(runtime_us) => runtime_us,
        Fact::Unavailable(reason) => return Finding::unknown(id, title, &reason),
    };
    let period_us = files.read_number("/proc/sys/kernel/sched_rt_period_us");
    let period_us = period_us.available().copied().unwrap_or(1_000_000);
    if runtime_us < 0 || runtime_us >= period_us {
        return Finding::good(
            id,
            title,
            format!("unlimited (sched_rt_runtime_us={runtime_us})"),
        );
    }
    let lost_ms = (period_us - runtime_us) / 1000;
    Finding::note(id, title, format!("{runtime_us} of {period_us} us"))
        .because(format!(
            "a busy-polling FIFO thread blacks out for about {lost_ms} ms per period on a CPU it \
             shares; loops that block are not affected"
        ))
        .fixed_by("isolate the CPU of a busy poller, then sysctl kernel.sched_rt_runtime_us=-1")
}

fn fifo(files: &HostFiles) -> Finding {
    let (id, title) = ("fifo", "SCHED_FIFO priority");
    let tried = thread::spawn(|| {
        let policy = SchedulingPolicy::Fifo {
            priority: TRIED_PRIORITY,
        };
        apply(&RealtimeRequest {
            policy,
            ..RealtimeRequest::default()
        })
    });
    let Ok(grant) = tried.join() else {
        return Finding::unknown(id, title, "the trial thread died");
    };
    let rtprio = limit(Resource::RLIMIT_RTPRIO, "").to_text();
    let rights = format!(
        "RLIMIT_RTPRIO {rtprio}, CAP_SYS_NICE {}",
        held(files, CAP_SYS_NICE)
    );
    match grant.items.first().map(|entry| &entry.outcome) {
        Some(GrantOutcome::Refused { error, reason, fix }) => Finding::problem(
            id,
            title,
            format!("{TRIED_PRIORITY} refused ({error}); {rights}"),
        )
        .because(format!(
            "without it any load delays the loop by milliseconds: {reason}"
        ))
        .fixed_by(fix.clone()),
        _ => Finding::good(id, title, format!("{TRIED_PRIORITY} granted; {rights}")),
    }
}

fn memory_lock(files: &HostFiles) -> Finding {
    let (id, title) = ("memory_lock", "Locked memory");
    let memlock = limit(Resource::RLIMIT_MEMLOCK, " bytes").to_text();
    let rights = format!(
        "RLIMIT_MEMLOCK {memlock}, CAP_IPC_LOCK {}",
        held(files, CAP_IPC_LOCK)
    );
    // Somebody else's lock must survive the trial, so a locked process is not tried.
    let locked = files.read_field("/proc/self/status", "VmLck");
    if locked
        .available()
        .is_some_and(|amount| !amount.starts_with("0 "))
    {
        return Finding::good(
            id,
            title,
            format!("in force ({}); {rights}", locked.to_text()),
        );
    }
    match mlockall(MlockAllFlags::MCL_CURRENT) {
        Ok(()) => {
            let released = munlockall().map_or_else(
                |errno| format!(", release failed: {errno}"),
                |()| String::new(),
            );
            Finding::good(id, title, format!("granted{released}; {rights}"))
        }
        Err(errno) => Finding::problem(id, title, format!("refused ({errno}); {rights}"))
            .because("a page fault in the loop costs microseconds to milliseconds")
            .fixed_by("needs CAP_IPC_LOCK or LimitMEMLOCK=infinity in the unit"),
    }
}

/// What `hil-runtime probe` can tap an interface with.
fn tap() -> Finding {
    let (id, title) = ("probe_tap", "Tap of the passive probe");
    match bpf_tap::is_granted() {
        Ok(()) => Finding::good(id, title, "eBPF programs granted"),
        Err(error) => Finding::note(id, title, format!("packet ring at most: {error}"))
            .because("a packet ring costs the watched hop more")
            .fixed_by("Linux 6.6 or newer, with CAP_BPF and CAP_NET_ADMIN (run as root)"),
    }
}

fn held(files: &HostFiles, capability: u32) -> &'static str {
    match files.holds_capability(capability) {
        Fact::Available(true) => "held",
        Fact::Available(false) => "missing",
        Fact::Unavailable(_) => "unknown",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::State;
    use crate::host_facts::FakeHost;

    #[test]
    fn the_throttle_is_stated_in_lost_milliseconds() {
        let host = FakeHost::with(&[
            ("/proc/sys/kernel/sched_rt_runtime_us", "950000"),
            ("/proc/sys/kernel/sched_rt_period_us", "1000000"),
        ]);
        let finding = throttle(&host.files());
        assert_eq!(finding.state, State::Note);
        assert!(
            finding.why.contains("about 50 ms per period"),
            "{}",
            finding.why
        );
        let off = FakeHost::with(&[("/proc/sys/kernel/sched_rt_runtime_us", "-1")]);
        assert_eq!(throttle(&off.files()).state, State::Good);
    }

    #[test]
    fn the_trials_say_what_the_limits_are() {
        let files = HostFiles::of_this_host();
        assert!(fifo(&files).value.contains("RLIMIT_RTPRIO"));
        assert!(memory_lock(&files).value.contains("RLIMIT_MEMLOCK"));
    }

    #[test]
    fn memory_that_is_already_locked_stays_locked() {
        let host = FakeHost::with(&[("/proc/self/status", "VmLck:\t  5120 kB\n")]);
        let finding = memory_lock(&host.files());
        assert!(
            finding.value.starts_with("in force (5120 kB)"),
            "{}",
            finding.value
        );
    }
}
