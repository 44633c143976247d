//! What kind of host a run happened on: a list of labelled facts for the run's manifest. It is a
//! description, not a judgement; [`crate::doctor`] judges.

mod files;

use nix::sys::resource::{RLIM_INFINITY, Resource, getrlimit};
use nix::sys::utsname::uname;
use serde::{Deserialize, Serialize};

pub use self::files::HostFiles;
#[cfg(test)]
pub(crate) use self::files::fake::FakeHost;
pub(crate) use self::files::{CAP_IPC_LOCK, CAP_SYS_NICE, format_cpu_list};

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
    /// The answer, if there is one.
    pub fn available(&self) -> Option<&T> {
        match self {
            Self::Available(value) => Some(value),
            Self::Unavailable(_) => None,
        }
    }

    pub(crate) fn map<U>(self, change: impl FnOnce(T) -> U) -> Fact<U> {
        self.and_then(|value| Fact::Available(change(value)))
    }

    pub(crate) fn and_then<U>(self, change: impl FnOnce(T) -> Fact<U>) -> Fact<U> {
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
        list.add("preemption", preemption(files));
        list.add("boot_parameters", boot_parameters(files));
        list.add("cpu_model", files.read_field("/proc/cpuinfo", "model name"));
        list.add("cores", cores(files));
        list.add(
            "governor",
            files.read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"),
        );
        list.add(
            "isolated_cpus",
            cpu_list(files, "/sys/devices/system/cpu/isolated"),
        );
        list.add(
            "nohz_full_cpus",
            cpu_list(files, "/sys/devices/system/cpu/nohz_full"),
        );
        list.add(
            "clocksource",
            files.read("/sys/devices/system/clocksource/clocksource0/current_clocksource"),
        );
        list.add("boot_id", files.read("/proc/sys/kernel/random/boot_id"));
        list.add("load_average", load_average(files));
        list.add("memory", memory(files));
        list.add("virtual_machine", virtual_machine(files));
        list.add(
            "sched_rt_runtime_us",
            files.read("/proc/sys/kernel/sched_rt_runtime_us"),
        );
        list.add("limit_rtprio", limit(Resource::RLIMIT_RTPRIO, ""));
        list.add("limit_memlock", limit(Resource::RLIMIT_MEMLOCK, " bytes"));
        list.add(
            "runtime_version",
            Fact::Available(env!("CARGO_PKG_VERSION").to_owned()),
        );
        list.add("runtime_git_revision", git_revision());
        list
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
    match nix::unistd::gethostname() {
        Ok(name) => Fact::Available(name.to_string_lossy().into_owned()),
        Err(errno) => Fact::Unavailable(format!("gethostname: {errno}")),
    }
}

fn kernel_name() -> Fact<String> {
    match uname() {
        Ok(name) => Fact::Available(format!(
            "{} {} {}",
            name.sysname().to_string_lossy(),
            name.release().to_string_lossy(),
            name.machine().to_string_lossy()
        )),
        Err(errno) => Fact::Unavailable(format!("uname: {errno}")),
    }
}

/// The kernel's major and minor version.
pub(crate) fn kernel_version(files: &HostFiles) -> Fact<(u32, u32)> {
    files
        .read("/proc/sys/kernel/osrelease")
        .and_then(|release| {
            let mut numbers = release
                .split(|c: char| !c.is_ascii_digit())
                .map(str::parse::<u32>);
            match (numbers.next(), numbers.next()) {
                (Some(Ok(major)), Some(Ok(minor))) => Fact::Available((major, minor)),
                _ => Fact::Unavailable(format!("kernel release `{release}` has no version")),
            }
        })
}

/// `PREEMPT_RT`, or the preemption model and, where the kernel tells it, the mode chosen at boot.
pub(crate) fn preemption(files: &HostFiles) -> Fact<String> {
    let version = files.read("/proc/sys/kernel/version");
    let realtime = files.read("/sys/kernel/realtime");
    if realtime.available().is_some_and(|flag| flag == "1") {
        return Fact::Available("PREEMPT_RT".to_owned());
    }
    version.map(|version| {
        let words: Vec<&str> = version.split_whitespace().collect();
        let model = words
            .iter()
            .find(|word| word.starts_with("PREEMPT"))
            .copied();
        match model {
            None => "none (server)".to_owned(),
            Some("PREEMPT_DYNAMIC") => format!("PREEMPT_DYNAMIC, {}", dynamic_mode(files)),
            Some(model) => model.to_owned(),
        }
    })
}

/// The mode in brackets of `/sys/kernel/debug/sched/preempt`, for example `none (full) lazy`.
fn dynamic_mode(files: &HostFiles) -> String {
    let modes = files.read("/sys/kernel/debug/sched/preempt");
    let chosen = modes.available().and_then(|modes| {
        let (_, rest) = modes.split_once('(')?;
        Some(rest.split_once(')')?.0.to_owned())
    });
    chosen.map_or_else(
        || "mode unavailable (debugfs is not readable)".to_owned(),
        |mode| format!("mode {mode}"),
    )
}

/// Parameters of the kernel's command line that change how it schedules, ticks or idles. The others
/// are left out: they say nothing about a measurement, and a manifest is meant to be shown around.
const TIMING_PARAMETERS: [&str; 15] = [
    "clocksource",
    "cpuidle.off",
    "idle",
    "intel_idle.max_cstate",
    "intel_pstate",
    "irqaffinity",
    "isolcpus",
    "mitigations",
    "nohz",
    "nohz_full",
    "nosmt",
    "preempt",
    "processor.max_cstate",
    "rcu_nocbs",
    "tsc",
];

fn boot_parameters(files: &HostFiles) -> Fact<String> {
    files.read("/proc/cmdline").map(|line| {
        let chosen: Vec<&str> = line
            .split_whitespace()
            .filter(|word| TIMING_PARAMETERS.contains(&word.split('=').next().unwrap_or(word)))
            .collect();
        if chosen.is_empty() {
            "none that affect timing".to_owned()
        } else {
            chosen.join(" ")
        }
    })
}

fn cores(files: &HostFiles) -> Fact<String> {
    files
        .read_cpu_list("/sys/devices/system/cpu/online")
        .map(|online| format!("{} online ({})", online.len(), format_cpu_list(&online)))
}

fn cpu_list(files: &HostFiles, path: &str) -> Fact<String> {
    files.read_cpu_list(path).map(|cpus| format_cpu_list(&cpus))
}

fn load_average(files: &HostFiles) -> Fact<String> {
    files.read("/proc/loadavg").map(|text| {
        let words: Vec<&str> = text.split_whitespace().take(3).collect();
        format!("{} over 1, 5 and 15 minutes", words.join(" "))
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

/// Whether a hypervisor runs below; the tail of every latency then belongs to it as well.
pub(crate) fn virtual_machine(files: &HostFiles) -> Fact<String> {
    files.read_field("/proc/cpuinfo", "flags").map(|flags| {
        let is_virtual = flags.split_whitespace().any(|flag| flag == "hypervisor");
        let product = files.read("/sys/class/dmi/id/product_name");
        match (is_virtual, product) {
            (false, _) => "no".to_owned(),
            (true, Fact::Available(product)) => format!("yes ({product})"),
            (true, Fact::Unavailable(_)) => "yes".to_owned(),
        }
    })
}

/// The soft limit of this process on `resource`.
pub(crate) fn soft_limit(resource: Resource) -> Fact<u64> {
    match getrlimit(resource) {
        Ok((soft, _hard)) => Fact::Available(soft),
        Err(errno) => Fact::Unavailable(format!("getrlimit: {errno}")),
    }
}

pub(crate) fn limit(resource: Resource, unit: &str) -> Fact<String> {
    soft_limit(resource).map(|soft| {
        if soft == RLIM_INFINITY {
            "unlimited".to_owned()
        } else {
            format!("{soft}{unit}")
        }
    })
}

fn git_revision() -> Fact<String> {
    match option_env!("HIL_GIT_REVISION") {
        Some(revision) if !revision.is_empty() => Fact::Available(revision.to_owned()),
        _ => Fact::Unavailable("built outside a git checkout".to_owned()),
    }
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
    fn a_realtime_kernel_is_recognised() {
        let host = FakeHost::with(&[
            ("/proc/sys/kernel/version", "#1 SMP PREEMPT_RT Debian 6.1"),
            ("/sys/kernel/realtime", "1"),
            ("/proc/sys/kernel/osrelease", "6.1.0-42-rt-amd64"),
        ]);
        assert_eq!(preemption(&host.files()).to_text(), "PREEMPT_RT");
        assert_eq!(kernel_version(&host.files()), Fact::Available((6, 1)));
    }

    #[test]
    fn facts_survive_json() {
        let facts = HostFacts::gather();
        let text = serde_json::to_string(&facts).unwrap();
        assert_eq!(serde_json::from_str::<HostFacts>(&text).unwrap(), facts);
    }
}
