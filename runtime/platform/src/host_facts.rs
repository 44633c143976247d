//! What kind of host a run happened on: a list of labelled facts for the run's manifest. It is a
//! description, not a judgement.

mod fake;
mod files;
mod kernel;
mod processors;

use core::fmt::Display;

use nix::sys::resource::{RLIM_INFINITY, Resource, getrlimit};
use nix::sys::utsname::uname;
use serde::{Deserialize, Serialize};

pub use self::fake::FakeHost;
pub use self::files::{CAP_IPC_LOCK, CAP_SYS_NICE, HostFiles, format_cpu_list};
pub(crate) use self::files::{CAP_SYS_ADMIN, CAP_SYS_RESOURCE};
pub use self::kernel::{
    KernelOptions, PreemptionMode, RealtimeThrottle, boot_parameter, clocksource, has_fair_server,
    kernel_release, preemption, virtual_machine,
};
pub use self::processors::{
    CPU_FOLDER, IsolatedCpus, ProcessorTicks, governors, isolated_or_online, load_average,
    online_cpus, refuse_absent,
};

/// Something the host was asked: an answer, or why there is none.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fact<T> {
    /// The host's answer.
    Available(T),
    /// Why the host gave none. It never stands for zero or for "no".
    Unavailable(String),
}

impl<T> Fact<T> {
    /// What was asked of `asked`; an error is the reason why there is no answer.
    fn of<E: Display>(asked: &str, answer: Result<T, E>) -> Self {
        match answer {
            Ok(value) => Self::Available(value),
            Err(error) => Self::Unavailable(format!("{asked}: {error}")),
        }
    }

    /// The answer, if there is one.
    pub fn available(&self) -> Option<&T> {
        match self {
            Self::Available(value) => Some(value),
            Self::Unavailable(_) => None,
        }
    }

    /// The answer changed; a reason stays.
    pub fn map<U>(self, change: impl FnOnce(T) -> U) -> Fact<U> {
        self.and_then(|value| Fact::Available(change(value)))
    }

    /// What follows from the answer; a reason stays.
    pub fn and_then<U>(self, change: impl FnOnce(T) -> Fact<U>) -> Fact<U> {
        match self {
            Self::Available(value) => change(value),
            Self::Unavailable(reason) => Fact::Unavailable(reason),
        }
    }
}

impl Fact<String> {
    /// The answer, or `unavailable (why)`, for a table.
    pub fn to_text(&self) -> String {
        match self {
            Self::Available(value) => value.clone(),
            Self::Unavailable(reason) => format!("unavailable ({reason})"),
        }
    }
}

/// One labelled fact.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct HostFact {
    /// Stable snake-case name, for example `cpu_model`.
    pub label: String,
    /// The answer in words, with its unit where it has one.
    pub value: Fact<String>,
}

/// What a host says about itself, in a fixed order.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct HostFacts {
    /// The facts; every label occurs once and none is left out for lack of an answer.
    pub facts: Vec<HostFact>,
}

impl HostFacts {
    /// Asks the running host. Best effort: a fact that cannot be had says why.
    pub fn gather() -> Self {
        Self::gather_from(&HostFiles::of_this_host())
    }

    /// As [`HostFacts::gather`], with the kernel's files taken from `files`. Limits and the kernel
    /// name are still those of the running process.
    pub fn gather_from(files: &HostFiles) -> Self {
        let mut list = Self::default();
        list.add("hostname", hostname());
        list.add("kernel", kernel_name());
        let isolation = IsolatedCpus::read(files);
        let in_words = |cpus: Fact<Vec<usize>>| cpus.map(|cpus| format_cpu_list(&cpus));
        list.add("preemption", preemption(files).map(|found| found.words));
        list.add("boot_parameters", kernel::boot_parameters(files));
        list.add("cpu_model", files.read_field("/proc/cpuinfo", "model name"));
        list.add("cores", cores(files));
        list.add("governor", governor(files));
        list.add("isolated_cpus", in_words(isolation.isolated));
        list.add("nohz_full_cpus", in_words(isolation.nohz_full));
        list.add("clocksource", clocksource(files));
        list.add("boot_id", files.read("/proc/sys/kernel/random/boot_id"));
        list.add("load_average", load_average(files).map(|(_, words)| words));
        list.add("memory", memory(files));
        list.add("virtual_machine", virtual_machine(files));
        list.add(
            "sched_rt_runtime_us",
            RealtimeThrottle::read(files).map(|throttle| throttle.runtime_us.to_string()),
        );
        list.add("limit_rtprio", limit(Resource::RLIMIT_RTPRIO, ""));
        list.add("limit_memlock", limit(Resource::RLIMIT_MEMLOCK, " bytes"));
        list.add(
            "runtime_version",
            Fact::Available(env!("CARGO_PKG_VERSION").to_owned()),
        );
        list
    }

    /// With the revision of the running program's sources, which the program knows by its build; `None` outside a git checkout.
    #[must_use]
    pub fn built_from(mut self, revision: Option<&str>) -> Self {
        let revision = match revision {
            Some(revision) if !revision.is_empty() => Fact::Available(revision.to_owned()),
            _ => Fact::Unavailable("built outside a git checkout".to_owned()),
        };
        self.add("runtime_git_revision", revision);
        self
    }

    /// The fact called `label`.
    pub fn find(&self, label: &str) -> Option<&Fact<String>> {
        self.facts
            .iter()
            .find(|fact| fact.label == label)
            .map(|fact| &fact.value)
    }

    fn add(&mut self, label: &str, value: Fact<String>) {
        self.facts.push(HostFact {
            label: label.to_owned(),
            value,
        });
    }
}

fn hostname() -> Fact<String> {
    Fact::of("gethostname", nix::unistd::gethostname())
        .map(|name| name.to_string_lossy().into_owned())
}

fn kernel_name() -> Fact<String> {
    Fact::of("uname", uname()).map(|name| {
        [name.sysname(), name.release(), name.machine()]
            .map(|part| part.to_string_lossy())
            .join(" ")
    })
}

fn cores(files: &HostFiles) -> Fact<String> {
    online_cpus(files)
        .map(|online| format!("{} online ({})", online.len(), format_cpu_list(&online)))
}

/// That of every processor, said once where they agree.
fn governor(files: &HostFiles) -> Fact<String> {
    governors(files, &[]).map(|found| {
        let mut names: Vec<String> = found.into_iter().map(|(_, governor)| governor).collect();
        names.sort();
        names.dedup();
        names.join(", ")
    })
}

fn memory(files: &HostFiles) -> Fact<String> {
    files
        .read_field("/proc/meminfo", "MemTotal")
        .and_then(|total| {
            let available = files.read_field("/proc/meminfo", "MemAvailable");
            available.map(|available| format!("{total} in all, {available} available"))
        })
}

/// The soft limit of this process on `resource`.
pub(crate) fn soft_limit(resource: Resource) -> Fact<u64> {
    Fact::of("getrlimit", getrlimit(resource)).map(|(soft, _hard)| soft)
}

/// The limit of this process on `resource`, in `unit`.
pub fn limit(resource: Resource, unit: &str) -> Fact<String> {
    soft_limit(resource).map(|soft| {
        if soft == RLIM_INFINITY {
            "unlimited".to_owned()
        } else {
            format!("{soft}{unit}")
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_label_occurs_once_on_any_host() {
        let empty = FakeHost::with(&[]);
        let (here, nowhere) = (HostFacts::gather(), HostFacts::gather_from(&empty.files()));
        let labels = |facts: &HostFacts| {
            facts
                .facts
                .iter()
                .map(|fact| fact.label.clone())
                .collect::<Vec<_>>()
        };
        assert_eq!(labels(&here), labels(&nowhere));
        let mut unique = labels(&here);
        unique.sort();
        unique.dedup();
        assert_eq!(unique.len(), here.facts.len());
    }

    #[test]
    fn a_host_without_files_answers_unavailable_and_not_zero() {
        let empty = FakeHost::with(&[]);
        let facts = HostFacts::gather_from(&empty.files());
        for label in [
            "cores",
            "memory",
            "isolated_cpus",
            "clocksource",
            "virtual_machine",
        ] {
            let fact = facts.find(label).unwrap();
            assert!(
                matches!(fact, Fact::Unavailable(_)),
                "{label} says {fact:?}"
            );
            assert!(fact.to_text().starts_with("unavailable ("));
        }
    }

    #[test]
    fn a_planted_host_is_described_in_words() {
        let host = FakeHost::with(&[
            ("/sys/devices/system/cpu/online", "0-3"),
            ("/sys/devices/system/cpu/isolated", "2-3"),
            (
                "/proc/cpuinfo",
                "model name\t: Test CPU\nflags\t\t: fpu hypervisor\n",
            ),
            (
                "/proc/meminfo",
                "MemTotal:  16 kB\nMemFree: 3 kB\nMemAvailable:  9 kB\n",
            ),
            ("/proc/sys/kernel/version", "#1 SMP PREEMPT_DYNAMIC Debian"),
            (
                "/sys/kernel/debug/sched/preempt",
                "none voluntary (full) lazy",
            ),
            (
                "/proc/cmdline",
                "root=/dev/sda1 isolcpus=2-3 token=secret nosmt",
            ),
        ]);
        let facts = HostFacts::gather_from(&host.files());
        for (label, expected) in [
            ("cores", "4 online (0-3)"),
            ("isolated_cpus", "2-3"),
            ("cpu_model", "Test CPU"),
            ("memory", "16 kB in all, 9 kB available"),
            ("virtual_machine", "yes"),
            ("preemption", "PREEMPT_DYNAMIC, mode full"),
            ("boot_parameters", "isolcpus=2-3 nosmt"),
        ] {
            assert_eq!(facts.find(label).unwrap().to_text(), expected);
        }
    }

    #[test]
    fn facts_survive_json() {
        let facts = HostFacts::gather();
        let text = serde_json::to_string(&facts).unwrap();
        assert_eq!(serde_json::from_str::<HostFacts>(&text).unwrap(), facts);
    }
}
