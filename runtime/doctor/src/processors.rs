//! The processors: who else may run on those that the topology pins to, how fast they clock, how
//! deep they sleep, with whom they share a core. It reads settings only; what they cost is measured
//! by the wake-ups.

use std::collections::BTreeSet;

use super::finding::{Answer, Checked, Finding, Severity, settled};
use super::kernel::worse_when_spinning;
use super::plan::Plan;
use hil_platform::host_facts::{
    CPU_FOLDER, Fact, HostFiles, IsolatedCpus, KernelOptions, format_cpu_list, governors,
    online_cpus,
};

/// An idle state that takes longer to leave shows up in every blocking receive.
const IDLE_EXIT_US_OK: i64 = 10;
/// And one that takes longer than this dwarfs what a wake-up costs otherwise.
const IDLE_EXIT_US_NOTE: i64 = 100;

pub(super) fn examine(files: &HostFiles, plan: &Plan) -> Vec<Finding> {
    let isolation = IsolatedCpus::read(files);
    let without_tick = match (isolation.nohz_full, KernelOptions::read(files)) {
        // A kernel without the option has no such file, and ticks everywhere.
        (Fact::Unavailable(_), Fact::Available(options)) if !options.has("NO_HZ_FULL") => {
            Fact::Available(Vec::new())
        }
        (found, _) => found,
    };
    let checks = [
        covered("isolated_cpus", isolation.isolated, plan),
        covered("nohz_full", without_tick, plan),
        covered("rcu_nocbs", isolation.without_callbacks, plan),
        governor(files, plan),
        idle_states(files, plan),
        siblings(files, plan),
    ];
    checks.map(settled).into()
}

/// Whether the pinned CPUs may be had; `allowed` are those of the cpuset that are online.
pub(super) fn pinned(plan: &Plan, allowed: Result<Vec<usize>, String>) -> Checked {
    let id = "pinned_cpus";
    let allowed = allowed.told(id)?;
    let value = format_cpu_list(&allowed);
    let outside = plan.pins.iter().filter(|pin| !allowed.contains(&pin.cpu));
    let outside: Vec<String> = outside
        .map(|pin| format!("{} by {} ({})", pin.cpu, pin.of, pin.key))
        .collect();
    if outside.is_empty() {
        return Ok(Finding::ok(id, value));
    }
    let value = format!("{value}; not {}", outside.join(", "));
    Ok(Finding::warning(id, value))
}

/// Whether the pinned CPUs are among those that were set apart.
fn covered(id: &str, apart: Fact<Vec<usize>>, plan: &Plan) -> Checked {
    let apart = apart.told(id)?;
    let value = format_cpu_list(&apart);
    if plan.pins.is_empty() {
        return Ok(if apart.is_empty() {
            Finding::note(id, value)
        } else {
            let value = format!("{value}; the topology pins nothing, or none was given");
            Finding::ok(id, value)
        });
    }
    let outside = plan.pins.iter().filter(|pin| !apart.contains(&pin.cpu));
    let (mut words, mut cpus, mut spins) = (Vec::new(), Vec::new(), false);
    for pin in outside {
        let what = if pin.spins { ", which busy-polls" } else { "" };
        words.push(format!("{} ({}{what})", pin.cpu, pin.of));
        cpus.push(pin.cpu);
        spins |= pin.spins;
    }
    if words.is_empty() {
        return Ok(Finding::ok(id, value));
    }
    let value = format!("{value}; pinned to outside: {}", words.join(", "));
    cpus.dedup();
    let cpus = format_cpu_list(&cpus);
    let parameter = if id == "isolated_cpus" {
        "isolcpus"
    } else {
        id
    };
    let finding = Finding::new(id, worse_when_spinning(spins), value);
    Ok(finding.fixed_by(format!("boot with {parameter}={cpus}")))
}

fn governor(files: &HostFiles, plan: &Plan) -> Checked {
    let id = "governor";
    let absent =
        |reason: String| format!("{reason}: no cpufreq driver, as in most virtual machines");
    let mut slow = governors(files, &plan.cpus()).told_as(id, absent)?;
    slow.retain(|(_, governor)| governor != "performance");
    let (cpus, names): (Vec<usize>, BTreeSet<String>) = slow.into_iter().unzip();
    if cpus.is_empty() {
        return Ok(Finding::ok(id, "performance"));
    }
    let (cpus, names) = (format_cpu_list(&cpus), Vec::from_iter(names).join(", "));
    Ok(Finding::warning(id, format!("{names} on CPU {cpus}"))
        .fixed_by(format!("cpupower -c {cpus} frequency-set -g performance")))
}

/// The enabled idle state of a CPU with the longest way out, and the microseconds of it.
fn deepest_idle(files: &HostFiles, cpu: usize) -> Result<(i64, String), String> {
    let folder = format!("{CPU_FOLDER}/cpu{cpu}/cpuidle");
    let mut deepest: Option<(i64, String)> = None;
    let states = files.list(&folder).known()?;
    for state in states.iter().filter(|name| name.starts_with("state")) {
        let file = |name: &str| format!("{folder}/{state}/{name}");
        if files.read_number(&file("disable")) == Fact::Available(1) {
            continue;
        }
        let exit_us = files.read_number(&file("latency")).known()?;
        if deepest.as_ref().is_none_or(|(us, _)| exit_us > *us) {
            deepest = Some((exit_us, files.read(&file("name")).to_text()));
        }
    }
    deepest.ok_or_else(|| format!("{folder} has no enabled state"))
}

fn idle_states(files: &HostFiles, plan: &Plan) -> Checked {
    let id = "idle_states";
    let cpus = if plan.pins.is_empty() {
        online_cpus(files).told(id)?
    } else {
        plan.cpus()
    };
    let absent =
        |reason: String| format!("{reason}: no cpuidle driver, as in most virtual machines");
    let mut worst: Option<(i64, String)> = None;
    for cpu in cpus {
        let (us, name) = deepest_idle(files, cpu).told_as(id, absent)?;
        if worst.as_ref().is_none_or(|(most, _)| us > *most) {
            worst = Some((us, format!("{name} on CPU {cpu}, {us} us to leave")));
        }
    }
    let (exit_us, words) = worst.ok_or("no CPU is online").told(id)?;
    // What a program that holds the file open asked for; the kernel then avoids deeper states.
    let (bound_us, also) = match files.read_word("/dev/cpu_dma_latency") {
        Fact::Available(us) if i64::from(us) < exit_us => (
            us.into(),
            format!("/dev/cpu_dma_latency holds it at {us} us"),
        ),
        Fact::Available(_) => (exit_us, "nobody holds /dev/cpu_dma_latency".to_owned()),
        Fact::Unavailable(reason) => (exit_us, format!("a bound on it is unknown ({reason})")),
    };
    let severity = Severity::rising(bound_us, IDLE_EXIT_US_OK, IDLE_EXIT_US_NOTE);
    Ok(Finding::new(id, severity, format!("{words}; {also}")))
}

fn siblings(files: &HostFiles, plan: &Plan) -> Checked {
    let id = "smt";
    if files.read(&format!("{CPU_FOLDER}/smt/active")).told(id)? != "1" {
        return Ok(Finding::ok(id, "none"));
    }
    let pinned = plan.cpus();
    if pinned.is_empty() {
        let value = "in use; the topology pins nothing, or none was given";
        return Ok(Finding::note(id, value));
    }
    let isolated = IsolatedCpus::read(files).isolated;
    let isolated = isolated.known().unwrap_or_default();
    let mut shared = Vec::new();
    for cpu in &pinned {
        let path = format!("{CPU_FOLDER}/cpu{cpu}/topology/thread_siblings_list");
        for other in files.read_cpu_list(&path).told(id)? {
            let how = if pinned.contains(&other) {
                "pinned too"
            } else if !isolated.contains(&other) {
                "open to all tasks"
            } else {
                continue;
            };
            if other != *cpu {
                shared.push(format!("CPU {cpu} shares with CPU {other}, {how}"));
            }
        }
    }
    if shared.is_empty() {
        let value = "in use; those of the pinned CPUs are isolated and idle";
        return Ok(Finding::ok(id, value));
    }
    Ok(Finding::warning(id, shared.join("; ")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::Pin;
    use hil_platform::host_facts::FakeHost;

    fn pinned(cpus: &[usize], spins: bool) -> Plan {
        let pins = cpus.iter().map(|cpu| Pin {
            cpu: *cpu,
            key: "links.hop.gateway.cpu".to_owned(),
            of: "gateway of hop".to_owned(),
            spins,
        });
        Plan {
            pins: pins.collect(),
            ..Plan::default()
        }
    }

    fn at(path: &str) -> String {
        format!("{CPU_FOLDER}/{path}")
    }

    fn found<'a>(findings: &'a [Finding], id: &str) -> &'a Finding {
        findings.iter().find(|finding| finding.id == id).unwrap()
    }

    fn with(files: &[(String, &str)], plan: &Plan) -> Vec<Finding> {
        let files: Vec<(&str, &str)> = files.iter().map(|(p, t)| (p.as_str(), *t)).collect();
        examine(&FakeHost::with(&files).files(), plan)
    }

    #[test]
    fn a_tuned_host_gets_no_complaint() {
        let files = [
            (at("online"), "0-3"),
            (at("isolated"), "2-3"),
            (at("nohz_full"), "2-3"),
            ("/proc/cmdline".to_owned(), "rcu_nocbs=2-3"),
            (at("cpu2/cpufreq/scaling_governor"), "performance"),
            (at("cpu2/cpuidle/state0/latency"), "0"),
            (at("cpu2/cpuidle/state0/name"), "POLL"),
            (at("cpu2/topology/thread_siblings_list"), "2-3"),
            (at("smt/active"), "1"),
        ];
        for finding in with(&files, &pinned(&[2], true)) {
            assert_eq!(finding.severity, Severity::Ok, "{finding:?}");
        }
    }

    #[test]
    fn a_desktop_gets_each_complaint_with_its_numbers() {
        let files = [
            (at("online"), "0-1"),
            (at("isolated"), ""),
            (at("nohz_full"), "(null)"),
            ("/proc/cmdline".to_owned(), "quiet"),
            (at("cpu0/cpufreq/scaling_governor"), "performance"),
            (at("cpu1/cpufreq/scaling_governor"), "powersave"),
            (at("cpu1/cpuidle/state1/latency"), "890"),
            (at("cpu1/cpuidle/state1/name"), "C10"),
            (at("cpu1/topology/thread_siblings_list"), "0-1"),
            (at("smt/active"), "1"),
        ];
        let findings = with(&files, &pinned(&[1], true));
        for (id, value) in [
            (
                "isolated_cpus",
                "none; pinned to outside: 1 (gateway of hop, which busy-polls)",
            ),
            (
                "rcu_nocbs",
                "none; pinned to outside: 1 (gateway of hop, which busy-polls)",
            ),
            ("governor", "powersave on CPU 1"),
            ("smt", "CPU 1 shares with CPU 0, open to all tasks"),
        ] {
            let finding = found(&findings, id);
            assert_eq!(finding.severity, Severity::Warning, "{finding:?}");
            assert_eq!(finding.value, value);
        }
        let idle = found(&findings, "idle_states");
        assert!(idle.value.starts_with("C10 on CPU 1, 890 us"), "{idle:?}");
        assert_eq!(idle.severity, Severity::Warning);
        assert_eq!(
            found(&findings, "isolated_cpus").fix,
            "boot with isolcpus=1"
        );
        // What only blocks feels it less.
        let findings = with(&files, &pinned(&[1], false));
        assert_eq!(found(&findings, "nohz_full").severity, Severity::Note);
    }

    #[test]
    fn a_pin_outside_the_cpuset_is_told_with_its_key() {
        let found = |cpus: &[usize]| settled(super::pinned(&pinned(cpus, false), Ok(vec![0, 1])));
        assert_eq!(found(&[1]).severity, Severity::Ok);
        let outside = found(&[1, 5]);
        assert_eq!(outside.severity, Severity::Warning);
        assert_eq!(
            outside.value,
            "0-1; not 5 by gateway of hop (links.hop.gateway.cpu)"
        );
        let unknown = settled(super::pinned(&pinned(&[1], false), Err("no".to_owned())));
        assert_eq!(unknown.severity, Severity::CannotTell);
    }

    #[test]
    fn a_silent_host_passes_nothing() {
        for plan in [Plan::default(), pinned(&[0], true)] {
            for finding in with(&[], &plan) {
                assert_eq!(finding.severity, Severity::CannotTell, "{finding:?}");
                assert!(finding.value.contains('/'), "names its file: {finding:?}");
            }
        }
    }

    #[test]
    fn disabled_idle_states_do_not_count_and_a_held_latency_bounds_the_rest() {
        let mut files = vec![
            (at("cpu1/cpuidle/state0/latency"), "2"),
            (at("cpu1/cpuidle/state0/name"), "C1"),
            (at("cpu1/cpuidle/state1/latency"), "890"),
            (at("cpu1/cpuidle/state1/name"), "C10"),
        ];
        files.push((at("cpu1/cpuidle/state1/disable"), "1"));
        let findings = with(&files, &pinned(&[1], false));
        let idle = found(&findings, "idle_states");
        assert!(idle.value.starts_with("C1 on CPU 1, 2 us"), "{idle:?}");
        assert_eq!(idle.severity, Severity::Ok);
        files.pop();
        files.push(("/dev/cpu_dma_latency".to_owned(), "\0\0\0\0"));
        let findings = with(&files, &pinned(&[1], false));
        let idle = found(&findings, "idle_states");
        assert_eq!(idle.severity, Severity::Ok);
        assert!(idle.value.contains("holds it at 0 us"), "{idle:?}");
    }

    #[test]
    fn siblings_that_are_both_pinned_are_named() {
        let files = [
            (at("smt/active"), "1"),
            (at("isolated"), "2-3"),
            (at("cpu2/topology/thread_siblings_list"), "2-3"),
            (at("cpu3/topology/thread_siblings_list"), "2-3"),
        ];
        let findings = with(&files, &pinned(&[2, 3], false));
        let smt = found(&findings, "smt");
        assert_eq!(smt.severity, Severity::Warning);
        assert!(smt.value.contains("CPU 3, pinned too"), "{smt:?}");
    }

    #[test]
    fn a_kernel_that_cannot_leave_the_tick_out_is_known_to_tick() {
        let files = [
            ("/proc/sys/kernel/osrelease".to_owned(), "6.1"),
            ("/boot/config-6.1".to_owned(), "CONFIG_NO_HZ_IDLE=y"),
        ];
        let findings = with(&files, &pinned(&[1], true));
        let tick = found(&findings, "nohz_full");
        assert_eq!(tick.severity, Severity::Warning, "{tick:?}");
        // One that can, and does not tell where, is not known to do anything.
        let able = [
            files[0].clone(),
            (files[1].0.clone(), "CONFIG_NO_HZ_FULL=y"),
        ];
        let findings = with(&able, &pinned(&[1], true));
        let tick = found(&findings, "nohz_full");
        assert_eq!(tick.severity, Severity::CannotTell, "{tick:?}");
    }
}
