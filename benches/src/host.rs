//! What the machine was like while a bench ran. It describes; it does not tune.

use std::{fs, io, thread};

use nix::sched::{CpuSet, sched_setaffinity};
use nix::unistd::Pid;
use serde_json::{Value, json};

/// Facts without which a figure means little.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HostFacts {
    /// Model name of the first processor.
    pub cpu_model: String,
    /// Processors this process may use.
    pub cpu_count: usize,
    /// True when the kernel says that it runs in a virtual machine.
    pub is_virtual_machine: bool,
    /// Frequency governor of the first processor.
    pub governor: String,
    /// Kernel release.
    pub kernel: String,
    /// Scheduling policy of the calling thread.
    pub scheduling_policy: String,
    /// Where the bench pinned its threads, as the bench describes it.
    pub pinning: String,
    /// One-minute load average at the time of reading.
    pub load_average: String,
}

const UNAVAILABLE: &str = "unavailable";

impl HostFacts {
    /// Reads the facts; what the host does not tell is `unavailable`.
    pub fn read(pinning: &str) -> Self {
        let cpuinfo = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        let field = |name: &str| {
            let line = cpuinfo.lines().find(|line| line.starts_with(name));
            line.and_then(|line| line.split_once(':'))
                .map(|(_, value)| value.trim().to_owned())
        };
        Self {
            cpu_model: field("model name").unwrap_or_else(|| UNAVAILABLE.to_owned()),
            cpu_count: thread::available_parallelism().map_or(0, Into::into),
            is_virtual_machine: field("flags")
                .is_some_and(|flags| flags.split(' ').any(|flag| flag == "hypervisor")),
            governor: first_word("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"),
            kernel: first_word("/proc/sys/kernel/osrelease"),
            scheduling_policy: scheduling_policy(),
            pinning: pinning.to_owned(),
            load_average: first_word("/proc/loadavg"),
        }
    }

    /// For the first line of a bench's output.
    pub fn to_json(&self) -> Value {
        json!({
            "cpu_model": self.cpu_model,
            "cpu_count": self.cpu_count,
            "is_virtual_machine": self.is_virtual_machine,
            "governor": self.governor,
            "kernel": self.kernel,
            "scheduling_policy": self.scheduling_policy,
            "pinning": self.pinning,
            "load_average": self.load_average,
        })
    }
}

/// Keeps the calling thread on one processor.
///
/// # Errors
/// When there is no such processor or it is not allowed.
pub fn pin_to_cpu(cpu: usize) -> io::Result<()> {
    let mut set = CpuSet::new();
    set.set(cpu)?;
    Ok(sched_setaffinity(Pid::from_raw(0), &set)?)
}

/// What `work` gives in a thread that stays on one processor, if one is named, as what it starts does.
///
/// # Errors
/// As [`pin_to_cpu`].
///
/// # Panics
/// When `work` does.
pub fn on_cpu<T: Send>(cpu: Option<usize>, work: impl FnOnce() -> T + Send) -> io::Result<T> {
    let Some(cpu) = cpu else {
        return Ok(work());
    };
    // A child may run where the thread that started it may.
    let joined = thread::scope(|scope| scope.spawn(|| pin_to_cpu(cpu).map(|()| work())).join());
    joined.unwrap_or_else(|cause| std::panic::resume_unwind(cause))
}

fn first_word(path: &str) -> String {
    let text = fs::read_to_string(path).unwrap_or_default();
    let word = text.split_whitespace().next();
    word.unwrap_or(UNAVAILABLE).to_owned()
}

fn scheduling_policy() -> String {
    let stat = fs::read_to_string("/proc/thread-self/stat").unwrap_or_default();
    // The command in parentheses may hold blanks; counting starts behind it, at field 3.
    let fields = stat.rsplit(") ").next().unwrap_or_default();
    let field = |number: usize| fields.split(' ').nth(number - 3);
    match (field(41), field(40)) {
        (Some("0"), _) => "other".to_owned(),
        (Some("1"), Some(priority)) => format!("fifo {priority}"),
        (Some("2"), Some(priority)) => format!("round robin {priority}"),
        (Some(policy), _) => format!("policy {policy}"),
        (None, _) => UNAVAILABLE.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn facts_are_read_or_said_to_be_unavailable() {
        let facts = HostFacts::read("none");
        for text in [
            &facts.cpu_model,
            &facts.governor,
            &facts.kernel,
            &facts.load_average,
        ] {
            assert!(!text.is_empty());
        }
        assert!(facts.cpu_count > 0);
        assert_ne!(facts.scheduling_policy, "policy ");
    }

    #[test]
    fn a_processor_that_is_not_there_is_refused() {
        assert!(pin_to_cpu(1_000).is_err());
    }
}
