//! What this process may ask of the kernel: real-time priority and locked memory, tried and not just
//! read from limits. The tries leave no trace: the priority is taken by a thread that ends, and the
//! lock is released again.

use std::thread;

use nix::errno::Errno;
use nix::sys::mman::{MlockAllFlags, mlockall, munlockall};
use nix::sys::resource::Resource;
use nix::unistd::{Uid, User};

use super::finding::{Answer, Checked, Finding, settled};
use hil_platform::host_facts::{CAP_IPC_LOCK, CAP_SYS_NICE, Fact, HostFiles, limit};
use hil_platform::realtime::{GrantOutcome, RealtimeRequest, SchedulingPolicy, apply};

/// A typical priority of a control loop, above the interrupt threads of `PREEMPT_RT`.
const TRIED_PRIORITY: u8 = 80;

/// What becomes of a wish for `SCHED_FIFO`; `None` when the trial itself failed.
pub(super) fn try_fifo() -> Option<GrantOutcome> {
    let trial = thread::spawn(|| {
        apply(&RealtimeRequest {
            policy: SchedulingPolicy::Fifo {
                priority: TRIED_PRIORITY,
            },
            ..RealtimeRequest::default()
        })
    });
    Some(trial.join().ok()?.items.pop()?.outcome)
}

/// `tried` is what [`try_fifo`] came to.
pub(super) fn examine(files: &HostFiles, tried: Option<&GrantOutcome>) -> Vec<Finding> {
    let rtprio = limit(Resource::RLIMIT_RTPRIO, "");
    let memlock = limit(Resource::RLIMIT_MEMLOCK, " bytes");
    vec![
        settled(fifo(files, tried, &rtprio.to_text())),
        settled(memory_lock(files, &memlock.to_text(), try_lock)),
    ]
}

fn limit_line(name: &str, value: &str, in_unit: &str, file: &str) -> String {
    let user = User::from_uid(Uid::current()).ok().flatten();
    let user = user.map_or_else(|| Uid::current().to_string(), |user| user.name);
    format!(
        "echo \"{user} - {name} {value}\" | sudo tee /etc/security/limits.d/{file} and log in again; \
         in a unit Limit{}={in_unit}",
        name.to_uppercase()
    )
}

fn fifo(files: &HostFiles, tried: Option<&GrantOutcome>, rtprio: &str) -> Checked {
    let id = "fifo";
    let capability = held(files, CAP_SYS_NICE);
    let rights = format!("RLIMIT_RTPRIO {rtprio}, CAP_SYS_NICE {capability}");
    let tried = tried.ok_or(format!("the trial thread died; {rights}"));
    Ok(match tried.told(id)? {
        GrantOutcome::Granted => {
            Finding::ok(id, format!("priority {TRIED_PRIORITY} granted; {rights}"))
        }
        GrantOutcome::Refused { error, reason, fix } => {
            let value = format!("priority {TRIED_PRIORITY} refused ({error}); {rights}");
            if capability == "held" {
                // Then it is not for want of rights.
                Finding::error(id, format!("{value}: {reason}")).fixed_by(fix)
            } else {
                Finding::error(id, value).fixed_by(limit_line("rtprio", "90", "90", "90-hil.conf"))
            }
        }
    })
}

/// Locks what is there and releases it again.
fn try_lock() -> Result<(), Errno> {
    mlockall(MlockAllFlags::MCL_CURRENT)?;
    munlockall()
}

fn memory_lock(
    files: &HostFiles,
    memlock: &str,
    trial: impl FnOnce() -> Result<(), Errno>,
) -> Checked {
    let id = "memory_lock";
    let capability = held(files, CAP_IPC_LOCK);
    let rights = format!("RLIMIT_MEMLOCK {memlock}, CAP_IPC_LOCK {capability}");
    // Somebody else's lock must survive the trial, so a locked process is not tried.
    let locked = files.read_field("/proc/self/status", "VmLck");
    let locked = locked.told_as(id, |reason| format!("not tried: {reason}; {rights}"))?;
    if !locked.starts_with("0 ") {
        return Ok(Finding::ok(id, format!("in force ({locked}); {rights}")));
    }
    let why = match trial() {
        Ok(()) => return Ok(Finding::ok(id, format!("granted; {rights}"))),
        // The kernel says "out of memory" for what is beyond the limit.
        Err(Errno::ENOMEM) => "more than the limit",
        Err(errno) => errno.desc(),
    };
    let fix = limit_line("memlock", "unlimited", "infinity", "91-hil.conf");
    Ok(Finding::error(id, format!("refused ({why}); {rights}")).fixed_by(fix))
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
    use crate::finding::Severity;
    use hil_platform::host_facts::FakeHost;

    const UNLOCKED: (&str, &str) = (
        "/proc/self/status",
        "VmLck:\t     0 kB\nCapEff:\t0000000000000000\n",
    );

    #[test]
    fn the_trials_say_what_the_limits_are() {
        let files = HostFiles::of_this_host();
        for finding in examine(&files, try_fifo().as_ref()) {
            assert_ne!(finding.severity, Severity::CannotTell, "{finding:?}");
        }
    }

    #[test]
    fn a_refusal_names_the_line_that_cures_it() {
        let host = FakeHost::with(&[UNLOCKED]);
        let refused = GrantOutcome::Refused {
            error: "EPERM".to_owned(),
            reason: "RLIMIT_RTPRIO is 0".to_owned(),
            fix: "needs CAP_SYS_NICE".to_owned(),
        };
        let finding = settled(fifo(&host.files(), Some(&refused), "0"));
        assert_eq!(finding.severity, Severity::Error);
        assert!(finding.fix.contains("- rtprio 90\""), "{}", finding.fix);
        let locking = settled(memory_lock(&host.files(), "65536 bytes", || {
            Err(Errno::ENOMEM)
        }));
        assert_eq!(locking.severity, Severity::Error);
        assert!(
            locking.fix.contains("LimitMEMLOCK=infinity"),
            "{}",
            locking.fix
        );
        assert!(
            locking
                .value
                .contains("RLIMIT_MEMLOCK 65536 bytes, CAP_IPC_LOCK missing")
        );
    }

    #[test]
    fn what_was_not_tried_is_not_ok() {
        let silent = FakeHost::with(&[]);
        let finding = settled(fifo(&silent.files(), None, "0"));
        assert_eq!(finding.severity, Severity::CannotTell);
        let finding = settled(memory_lock(&silent.files(), "1", || {
            panic!("tried in the dark")
        }));
        assert_eq!(finding.severity, Severity::CannotTell);
    }

    #[test]
    fn memory_that_is_already_locked_stays_locked() {
        let host = FakeHost::with(&[("/proc/self/status", "VmLck:\t  5120 kB\n")]);
        let finding = settled(memory_lock(&host.files(), "1", || {
            panic!("tried all the same")
        }));
        assert!(
            finding.value.starts_with("in force (5120 kB)"),
            "{finding:?}"
        );
        assert_eq!(finding.severity, Severity::Ok);
    }

    #[test]
    fn granted_is_ok() {
        let host = FakeHost::with(&[UNLOCKED]);
        let granted = settled(fifo(&host.files(), Some(&GrantOutcome::Granted), "90"));
        assert_eq!(granted.severity, Severity::Ok);
        let locked = settled(memory_lock(&host.files(), "unlimited", || Ok(())));
        assert_eq!(locked.severity, Severity::Ok);
    }
}
