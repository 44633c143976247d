//! Facts of the processors: which there are, who keeps away from them, how they are clocked and what
//! the host has to do. The one reader of each; it judges nothing.

use serde::{Deserialize, Serialize};

use super::files::{format_cpu_list, parse_cpu_list};
use super::kernel::boot_parameter;
use super::{Fact, HostFiles};

/// Where the kernel describes the processors.
pub const CPU_FOLDER: &str = "/sys/devices/system/cpu";

/// The processors that run.
pub fn online_cpus(files: &HostFiles) -> Fact<Vec<usize>> {
    files.read_cpu_list(&format!("{CPU_FOLDER}/online"))
}

/// The isolated CPUs, else all that run; none when the host does not tell.
pub fn isolated_or_online(files: &HostFiles) -> Vec<usize> {
    let isolated = IsolatedCpus::read(files).isolated;
    let isolated = isolated
        .available()
        .filter(|cpus| !cpus.is_empty())
        .cloned();
    isolated.unwrap_or_else(|| online_cpus(files).available().cloned().unwrap_or_default())
}

/// Refuses CPUs that do not run here.
///
/// # Errors
/// Names the first of them, and those that do run.
pub fn refuse_absent(files: &HostFiles, cpus: &[usize]) -> Result<(), String> {
    let Fact::Available(online) = online_cpus(files) else {
        return Ok(());
    };
    match cpus.iter().find(|cpu| !online.contains(cpu)) {
        Some(cpu) => Err(format!(
            "CPU {cpu} does not run here; those that do are {}",
            format_cpu_list(&online)
        )),
        None => Ok(()),
    }
}

/// CPUs the boot command line took out of the scheduler's hands.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct IsolatedCpus {
    /// `isolcpus=`: no task is placed here unless pinned.
    pub isolated: Fact<Vec<usize>>,
    /// `nohz_full=`: no periodic tick while one task runs here.
    pub nohz_full: Fact<Vec<usize>>,
    /// `rcu_nocbs=` or `nohz_full=`: the kernel's deferred frees run elsewhere.
    pub without_callbacks: Fact<Vec<usize>>,
}

impl IsolatedCpus {
    /// What the kernel says.
    pub fn read(files: &HostFiles) -> Self {
        let nohz_full = files.read_cpu_list(&format!("{CPU_FOLDER}/nohz_full"));
        Self {
            isolated: files.read_cpu_list(&format!("{CPU_FOLDER}/isolated")),
            without_callbacks: without_callbacks(files, nohz_full.available()),
            nohz_full,
        }
    }
}

fn without_callbacks(files: &HostFiles, nohz_full: Option<&Vec<usize>>) -> Fact<Vec<usize>> {
    boot_parameter(files, "rcu_nocbs").and_then(|value| {
        let named = match value.as_deref() {
            Some("all" | "") => files.read_cpu_list(&format!("{CPU_FOLDER}/possible")),
            Some(list) => match parse_cpu_list(list) {
                Some(cpus) => Fact::Available(cpus),
                None => Fact::Unavailable(format!("rcu_nocbs={list} is not a list of CPUs")),
            },
            None => Fact::Available(Vec::new()),
        };
        named.map(|mut cpus| {
            // The kernel adds these by itself.
            cpus.extend(nohz_full.into_iter().flatten());
            cpus.sort_unstable();
            cpus.dedup();
            cpus
        })
    })
}

/// The frequency governor of each of `cpus`, or of all that are there when none is named: the CPU and
/// its governor.
pub fn governors(files: &HostFiles, cpus: &[usize]) -> Fact<Vec<(usize, String)>> {
    let all = || {
        files.list(CPU_FOLDER).map(|names| {
            let indexes = names.iter().filter_map(|name| name.strip_prefix("cpu"));
            let mut cpus: Vec<usize> = indexes.filter_map(|index| index.parse().ok()).collect();
            cpus.sort_unstable();
            cpus
        })
    };
    let asked = if cpus.is_empty() {
        all()
    } else {
        Fact::Available(cpus.to_vec())
    };
    asked.and_then(|cpus| {
        let mut found = Vec::new();
        for cpu in cpus {
            let path = format!("{CPU_FOLDER}/cpu{cpu}/cpufreq/scaling_governor");
            match files.read(&path) {
                Fact::Available(governor) => found.push((cpu, governor)),
                Fact::Unavailable(reason) => return Fact::Unavailable(reason),
            }
        }
        if found.is_empty() {
            return Fact::Unavailable(format!("{CPU_FOLDER} lists no CPU"));
        }
        Fact::Available(found)
    })
}

/// Runnable tasks, averaged over a minute, and the text for people.
pub fn load_average(files: &HostFiles) -> Fact<(f64, String)> {
    files.read("/proc/loadavg").and_then(|text| {
        let words: Vec<&str> = text.split_whitespace().take(3).collect();
        match words.first().and_then(|word| word.parse().ok()) {
            Some(minute) => Fact::Available((
                minute,
                format!("{} over 1, 5 and 15 minutes", words.join(" ")),
            )),
            None => Fact::Unavailable(format!("/proc/loadavg: `{text}` has no load")),
        }
    })
}

/// Where the processors' time went since boot, in ticks of all of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ProcessorTicks {
    /// All of them.
    pub total: u64,
    /// Nothing to do, or waiting for a disk.
    pub idle: u64,
    /// Taken away by the hypervisor, as far as it tells.
    pub steal: u64,
}

impl ProcessorTicks {
    /// The first line of `/proc/stat`.
    pub fn read(files: &HostFiles) -> Fact<Self> {
        files.read("/proc/stat").and_then(|text| {
            let line = text.lines().next().unwrap_or_default();
            let numbers: Option<Vec<u64>> = line.strip_prefix("cpu ").map(|rest| {
                rest.split_whitespace()
                    .map_while(|n| n.parse().ok())
                    .collect()
            });
            // user nice system idle iowait irq softirq steal; guest time is part of user time.
            match numbers.as_deref() {
                Some([user, nice, system, idle, wait, irq, softirq, steal, ..]) => {
                    Fact::Available(Self {
                        total: user + nice + system + idle + wait + irq + softirq + steal,
                        idle: idle + wait,
                        steal: *steal,
                    })
                }
                _ => Fact::Unavailable(format!("/proc/stat: `{line}` is not a line of times")),
            }
        })
    }

    /// What passed since `earlier`.
    #[must_use]
    pub fn since(self, earlier: Self) -> Self {
        Self {
            total: self.total.saturating_sub(earlier.total),
            idle: self.idle.saturating_sub(earlier.idle),
            steal: self.steal.saturating_sub(earlier.steal),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::host_facts::FakeHost;

    #[test]
    fn callbacks_leave_the_cpus_that_boot_names_and_those_without_tick() {
        let cpus = |files: &[(&str, &str)]| {
            let host = FakeHost::with(files);
            IsolatedCpus::read(&host.files()).without_callbacks
        };
        let nohz = ("/sys/devices/system/cpu/nohz_full", "3");
        let possible = ("/sys/devices/system/cpu/possible", "0-1");
        assert_eq!(
            cpus(&[("/proc/cmdline", "rcu_nocbs=2 quiet"), nohz]),
            Fact::Available(vec![2, 3])
        );
        assert_eq!(
            cpus(&[("/proc/cmdline", "rcu_nocbs=all"), possible]),
            Fact::Available(vec![0, 1])
        );
        assert_eq!(cpus(&[("/proc/cmdline", "quiet")]), Fact::Available(vec![]));
        assert!(matches!(cpus(&[]), Fact::Unavailable(_)));
        assert!(matches!(
            cpus(&[("/proc/cmdline", "rcu_nocbs=x")]),
            Fact::Unavailable(_)
        ));
    }

    #[test]
    fn ticks_are_told_apart_and_subtracted() {
        let read = |line: &str| {
            let host = FakeHost::with(&[("/proc/stat", line)]);
            ProcessorTicks::read(&host.files())
        };
        let first = *read("cpu  10 1 2 100 5 0 1 7 0 0\ncpu0 1")
            .available()
            .unwrap();
        assert_eq!((first.total, first.idle, first.steal), (126, 105, 7));
        let second = *read("cpu  20 1 2 190 5 0 1 8 0 0").available().unwrap();
        let passed = second.since(first);
        assert_eq!((passed.total, passed.idle, passed.steal), (101, 90, 1));
        assert!(matches!(read("intr 1 2 3"), Fact::Unavailable(_)));
    }

    #[test]
    fn a_governor_that_cannot_be_read_is_not_passed_over() {
        let path = "/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor";
        let host = FakeHost::with(&[(path, "performance")]);
        let one = vec![(0, "performance".to_owned())];
        assert_eq!(governors(&host.files(), &[]), Fact::Available(one));
        assert!(matches!(
            governors(&host.files(), &[0, 1]),
            Fact::Unavailable(_)
        ));
    }
}
