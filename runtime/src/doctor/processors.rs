//! The processors: who else may run on them, how fast they clock and how deep they sleep. It reads
//! settings only; what they cost is measured by the wake-up finding.

use super::{Finding, State};
use crate::host_facts::{Fact, HostFiles, format_cpu_list, preemption};
use crate::realtime::isolated_cpus_in;

/// An idle state that takes longer to leave shows up in every blocking receive.
const IDLE_EXIT_US_GOOD: i64 = 10;

pub(crate) fn examine(files: &HostFiles, pinned: &[usize]) -> Vec<Finding> {
    vec![
        preemption_model(files),
        isolated(files, pinned),
        nohz_full(files, pinned),
        governor(files),
        idle_states(files),
        siblings(files, pinned),
        irqbalance(files),
        huge_pages(files),
    ]
}

fn preemption_model(files: &HostFiles) -> Finding {
    let (id, title) = ("preemption", "Kernel preemption");
    match preemption(files) {
        Fact::Available(model) => {
            let is_good = model == "PREEMPT_RT" || model.ends_with("mode full");
            Finding::note_unless(is_good, id, title, model)
                .because("a system call of another task may hold a wake-up back for milliseconds")
                .fixed_by("boot a PREEMPT_RT kernel, or add preempt=full to a PREEMPT_DYNAMIC one")
                .quiet_when_good()
        }
        Fact::Unavailable(reason) => Finding::unknown(id, title, &reason),
    }
}

/// The pinned CPUs missing from `listed`.
fn missing(listed: &[usize], pinned: &[usize]) -> Vec<usize> {
    pinned
        .iter()
        .copied()
        .filter(|cpu| !listed.contains(cpu))
        .collect()
}

fn isolated(files: &HostFiles, pinned: &[usize]) -> Finding {
    let (id, title) = ("isolated_cpus", "Isolated CPUs");
    let isolated = match isolated_cpus_in(files).isolated {
        Fact::Available(cpus) => cpus,
        Fact::Unavailable(reason) => return Finding::unknown(id, title, &reason),
    };
    let value = format_cpu_list(&isolated);
    let uncovered = missing(&isolated, pinned);
    if isolated.is_empty() {
        return Finding::note(id, title, value)
            .because("every task of the host may run on the CPU of a busy poller")
            .fixed_by(
                "boot with isolcpus=CPUS nohz_full=CPUS rcu_nocbs=CPUS, or do not busy-poll",
            );
    }
    if uncovered.is_empty() {
        return Finding::good(id, title, value);
    }
    let uncovered = format_cpu_list(&uncovered);
    Finding::note(
        id,
        title,
        format!("{value}; pinned but not isolated: {uncovered}"),
    )
    .because("the topology pins threads to CPUs that other tasks use as well")
    .fixed_by(format!(
        "pin to the isolated CPUs, or isolate {uncovered} too"
    ))
}

fn nohz_full(files: &HostFiles, pinned: &[usize]) -> Finding {
    let (id, title) = ("nohz_full", "CPUs without a periodic tick");
    let isolation = isolated_cpus_in(files);
    match isolation.nohz_full {
        Fact::Available(cpus) => {
            let is_good = !cpus.is_empty() && missing(&cpus, pinned).is_empty();
            Finding::note_unless(is_good, id, title, format_cpu_list(&cpus))
                .because(
                    "each timer tick takes microseconds from a busy poller, 100 to 1000 times \
                          a second",
                )
                .fixed_by("boot with nohz_full=CPUS for the CPUs that busy-poll")
                .quiet_when_good()
        }
        Fact::Unavailable(reason) => Finding::note(id, title, format!("unavailable ({reason})"))
            .because("this kernel has no nohz_full; a busy poller pays for every timer tick")
            .fixed_by("use a kernel with CONFIG_NO_HZ_FULL for microsecond busy polling"),
    }
}

fn governor(files: &HostFiles) -> Finding {
    let (id, title) = ("governor", "Frequency governor");
    let mut governors: Vec<String> = cpu_folders(files)
        .into_iter()
        .filter_map(|cpu| {
            let path = format!("/sys/devices/system/cpu/{cpu}/cpufreq/scaling_governor");
            files.read(&path).available().cloned()
        })
        .collect();
    governors.sort();
    governors.dedup();
    if governors.is_empty() {
        return Finding::unknown(id, title, "no cpufreq driver, as in most virtual machines");
    }
    let is_good = governors == ["performance"];
    Finding::note_unless(is_good, id, title, governors.join(", "))
        .because("the clock rate follows the load, so the same work takes differently long")
        .fixed_by("cpupower frequency-set -g performance")
        .quiet_when_good()
}

fn cpu_folders(files: &HostFiles) -> Vec<String> {
    let mut names = files.names_in("/sys/devices/system/cpu");
    names.retain(|name| {
        name.strip_prefix("cpu")
            .is_some_and(|index| index.parse::<usize>().is_ok())
    });
    names
}

fn idle_states(files: &HostFiles) -> Finding {
    let (id, title) = ("idle_states", "Deepest idle state in use");
    let folder = "/sys/devices/system/cpu/cpu0/cpuidle";
    let enabled = files.names_in(folder).into_iter().filter_map(|state| {
        let file = |name: &str| format!("{folder}/{state}/{name}");
        let is_disabled = files.read_number(&file("disable")) == Fact::Available(1);
        let exit_us = files.read_number(&file("latency")).available().copied()?;
        let name = files.read(&file("name")).available().cloned()?;
        (!is_disabled).then_some((exit_us, name))
    });
    let Some((exit_us, name)) = enabled.max() else {
        return Finding::unknown(id, title, "no cpuidle driver, as in most virtual machines");
    };
    Finding::note_unless(
        exit_us <= IDLE_EXIT_US_GOOD,
        id,
        title,
        format!("{name}, {exit_us} us"),
    )
    .because("a CPU that sleeps this deep adds its exit latency to the next wake-up")
    .fixed_by("hold /dev/cpu_dma_latency open at 0 during a run, or cpupower idle-set -D 10")
    .quiet_when_good()
}

fn siblings(files: &HostFiles, pinned: &[usize]) -> Finding {
    let (id, title) = ("smt", "Hardware threads sharing a core");
    match files.read("/sys/devices/system/cpu/smt/active") {
        Fact::Unavailable(reason) => return Finding::unknown(id, title, &reason),
        Fact::Available(active) if active != "1" => return Finding::good(id, title, "none"),
        Fact::Available(_) => {}
    }
    let cpus = if pinned.is_empty() { &[0][..] } else { pinned };
    let groups: Vec<String> = cpus
        .iter()
        .map(|cpu| {
            let path = format!("/sys/devices/system/cpu/cpu{cpu}/topology/thread_siblings_list");
            format!("cpu {cpu} shares with {}", files.read(&path).to_text())
        })
        .collect();
    Finding::note(id, title, groups.join("; "))
        .because("a neighbour on the same core takes half of its execution units at any time")
        .fixed_by("leave the sibling of a pinned CPU idle, or boot with nosmt")
}

fn irqbalance(files: &HostFiles) -> Finding {
    let (id, title) = ("irqbalance", "Interrupt balancing daemon");
    let processes = files.names_in("/proc");
    let mut names = processes
        .iter()
        .filter(|name| name.bytes().all(|byte| byte.is_ascii_digit()))
        .map(|process| files.read(&format!("/proc/{process}/comm")));
    if processes.is_empty() {
        return Finding::unknown(id, title, "/proc cannot be listed");
    }
    let is_running = names.any(|name| name == Fact::Available("irqbalance".to_owned()));
    Finding::note_unless(
        !is_running,
        id,
        title,
        if is_running { "running" } else { "not running" },
    )
    .because("it moves network interrupts between CPUs during a run, onto pinned ones too")
    .fixed_by("systemctl stop irqbalance, or ban the pinned CPUs in its configuration")
    .quiet_when_good()
}

fn huge_pages(files: &HostFiles) -> Finding {
    let (id, title) = ("transparent_huge_pages", "Transparent huge pages");
    let modes = match files.read("/sys/kernel/mm/transparent_hugepage/enabled") {
        Fact::Available(modes) => modes,
        Fact::Unavailable(reason) => return Finding::unknown(id, title, &reason),
    };
    let chosen = modes
        .split_once('[')
        .and_then(|(_, rest)| rest.split_once(']'));
    let Some((chosen, _)) = chosen else {
        return Finding::unknown(id, title, &format!("no mode is marked in `{modes}`"));
    };
    let state = if chosen == "always" {
        State::Note
    } else {
        State::Good
    };
    Finding::new(id, title, state, chosen)
        .because("the kernel merges pages in the background and holds the process up while it does")
        .fixed_by("echo madvise > /sys/kernel/mm/transparent_hugepage/enabled")
        .quiet_when_good()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::host_facts::FakeHost;

    const CPU: &str = "/sys/devices/system/cpu";

    #[test]
    fn a_tuned_host_gets_no_complaint() {
        let host = FakeHost::with(&[
            (&format!("{CPU}/isolated"), "2-3"),
            (&format!("{CPU}/nohz_full"), "2-3"),
            (
                &format!("{CPU}/cpu0/cpufreq/scaling_governor"),
                "performance",
            ),
            (&format!("{CPU}/cpu0/cpuidle/state0/latency"), "0"),
            (&format!("{CPU}/cpu0/cpuidle/state0/name"), "POLL"),
            (&format!("{CPU}/smt/active"), "0"),
            ("/sys/kernel/realtime", "1"),
            ("/proc/1/comm", "systemd"),
            (
                "/sys/kernel/mm/transparent_hugepage/enabled",
                "always [madvise] never",
            ),
        ]);
        for finding in examine(&host.files(), &[2, 3]) {
            assert_eq!(finding.state, State::Good, "{finding:?}");
            assert!(finding.why.is_empty());
        }
    }

    #[test]
    fn a_desktop_gets_every_complaint() {
        let host = FakeHost::with(&[
            (&format!("{CPU}/isolated"), ""),
            (&format!("{CPU}/nohz_full"), "(null)"),
            (&format!("{CPU}/cpu0/cpufreq/scaling_governor"), "powersave"),
            (
                &format!("{CPU}/cpu1/cpufreq/scaling_governor"),
                "performance",
            ),
            (&format!("{CPU}/cpu0/cpuidle/state0/latency"), "2"),
            (&format!("{CPU}/cpu0/cpuidle/state0/name"), "C1"),
            (&format!("{CPU}/cpu0/cpuidle/state1/latency"), "890"),
            (&format!("{CPU}/cpu0/cpuidle/state1/name"), "C10"),
            (&format!("{CPU}/smt/active"), "1"),
            (&format!("{CPU}/cpu0/topology/thread_siblings_list"), "0,4"),
            ("/proc/sys/kernel/version", "#1 SMP PREEMPT_DYNAMIC"),
            ("/proc/77/comm", "irqbalance"),
            (
                "/sys/kernel/mm/transparent_hugepage/enabled",
                "[always] madvise never",
            ),
        ]);
        let findings = examine(&host.files(), &[]);
        for finding in &findings {
            assert_eq!(finding.state, State::Note, "{finding:?}");
        }
        let values: Vec<&str> = findings
            .iter()
            .map(|finding| finding.value.as_str())
            .collect();
        assert!(values.contains(&"performance, powersave"));
        assert!(values.contains(&"C10, 890 us"));
        assert!(values.contains(&"cpu 0 shares with 0,4"));
    }

    #[test]
    fn a_disabled_idle_state_does_not_count() {
        let host = FakeHost::with(&[
            (&format!("{CPU}/cpu0/cpuidle/state0/latency"), "2"),
            (&format!("{CPU}/cpu0/cpuidle/state0/name"), "C1"),
            (&format!("{CPU}/cpu0/cpuidle/state1/latency"), "890"),
            (&format!("{CPU}/cpu0/cpuidle/state1/name"), "C10"),
            (&format!("{CPU}/cpu0/cpuidle/state1/disable"), "1"),
        ]);
        assert_eq!(idle_states(&host.files()).value, "C1, 2 us");
    }

    #[test]
    fn a_pin_outside_the_isolated_cpus_is_named() {
        let host = FakeHost::with(&[(&format!("{CPU}/isolated"), "2-3")]);
        let finding = isolated(&host.files(), &[1, 2]);
        assert_eq!(finding.value, "2-3; pinned but not isolated: 1");
    }

    #[test]
    fn a_silent_host_passes_nothing() {
        let host = FakeHost::with(&[]);
        for finding in examine(&host.files(), &[]) {
            assert_eq!(finding.state, State::Note, "{finding:?}");
        }
    }
}
