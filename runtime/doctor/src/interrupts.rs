//! Where the interrupts of the network cards strike, against the CPUs that the topology pins to. It
//! moves none.

use std::collections::{BTreeMap, BTreeSet};

use super::finding::{Answer, Checked, Finding, settled};
use super::network::has_device;
use super::plan::Plan;
use hil_platform::host_facts::{HostFiles, format_cpu_list};

/// An interrupt of a card.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Interrupt {
    number: u32,
    /// CPUs it may strike on, by the setting.
    allowed: Vec<usize>,
    /// CPUs it does strike on, where the kernel tells.
    effective: Vec<usize>,
    /// How often it struck on each CPU.
    counts: Vec<u64>,
}

pub(super) fn examine(files: &HostFiles, interfaces: &[String], plan: &Plan) -> Vec<Finding> {
    // Without a device there are no interrupts: loopback, veth, bridges.
    let cards = interfaces.iter().filter(|name| has_device(files, name));
    let judged = cards.map(|name| settled(judge(files, name, plan)).of(name));
    judged.collect()
}

fn judge(files: &HostFiles, interface: &str, plan: &Plan) -> Checked {
    let id = "interrupts";
    let found = interrupts_of(files, interface).told(id)?;
    let in_words =
        |one: &Interrupt| format!("{} on CPU {}", one.number, format_cpu_list(&one.effective));
    let value = found.iter().map(in_words).collect::<Vec<_>>().join(", ");
    let mut struck = Vec::new();
    for pin in &plan.pins {
        let own = found.iter().filter(|one| one.effective.contains(&pin.cpu));
        let counts = own.map(|one| one.counts.get(pin.cpu).copied().unwrap_or_default());
        let counts: Vec<u64> = counts.collect();
        if !counts.is_empty() {
            let (cpu, of, total) = (pin.cpu, &pin.of, counts.iter().sum::<u64>());
            struck.push(format!(
                "CPU {cpu} is pinned to by {of} ({total} struck there so far)"
            ));
        }
    }
    let pinned = plan.cpus();
    let mut allowed = found.iter().flat_map(|one| &one.allowed);
    Ok(if !struck.is_empty() {
        Finding::warning(id, format!("{value}; {}", struck.join(", ")))
            .fixed_by(cure(&found, &pinned))
    } else if allowed.any(|cpu| pinned.contains(cpu)) {
        Finding::note(
            id,
            format!("{value}; the setting allows pinned CPUs as well"),
        )
        .fixed_by(cure(&found, &pinned))
    } else {
        Finding::ok(id, value)
    })
}

fn cure(found: &[Interrupt], pinned: &[usize]) -> String {
    let allowed = found.iter().flat_map(|one| &one.allowed).copied();
    let free: BTreeSet<usize> = allowed.filter(|cpu| !pinned.contains(cpu)).collect();
    if free.is_empty() {
        return "pin to fewer CPUs: the topology leaves none for interrupts".to_owned();
    }
    let cpus = format_cpu_list(&Vec::from_iter(free));
    let numbers: Vec<String> = found.iter().map(|one| one.number.to_string()).collect();
    format!(
        "for i in {}; do echo {cpus} > /proc/irq/$i/smp_affinity_list; done",
        numbers.join(" ")
    )
}

/// The message-signalled interrupts of the device behind `interface`, else those whose line in
/// `/proc/interrupts` names it.
fn interrupts_of(files: &HostFiles, interface: &str) -> Result<Vec<Interrupt>, String> {
    let lines = lines_of(&files.read("/proc/interrupts").known()?);
    let device = format!("/sys/class/net/{interface}/device");
    // A virtio device sits on a PCI device that has the interrupts.
    let folders = ["msi_irqs", "../msi_irqs"].map(|folder| format!("{device}/{folder}"));
    let list = |folder: &String| files.list(folder).known().ok();
    let listed = folders.iter().find_map(list);
    let numbers: Vec<u32> = if let Some(names) = listed {
        names.iter().filter_map(|name| name.parse().ok()).collect()
    } else {
        let own = lines.iter().filter(|(_, line)| line.names(interface));
        own.map(|(number, _)| *number).collect()
    };
    let mut found = Vec::new();
    for number in numbers {
        // A vector that nobody asked for has no line and strikes nowhere.
        let Some(line) = lines.get(&number) else {
            continue;
        };
        let cpus = |file: &str| {
            files
                .read_cpu_list(&format!("/proc/irq/{number}/{file}"))
                .known()
        };
        let allowed = cpus("smp_affinity_list")?;
        let effective = cpus("effective_affinity_list").ok();
        found.push(Interrupt {
            number,
            effective: effective
                .filter(|cpus| !cpus.is_empty())
                .unwrap_or(allowed.clone()),
            counts: line.counts.clone(),
            allowed,
        });
    }
    if found.is_empty() {
        return Err(format!(
            "neither {device}/msi_irqs nor /proc/interrupts names an interrupt of {interface}"
        ));
    }
    Ok(found)
}

/// One line of `/proc/interrupts`.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Line {
    counts: Vec<u64>,
    words: String,
}

impl Line {
    /// Drivers call their interrupts `eth0`, `eth0-rx-0` or `i915_eth0:0`.
    fn names(&self, interface: &str) -> bool {
        let is_name = |c: char| c.is_ascii_alphanumeric() || c == '.' || c == '_';
        let mut words = self.words.split(|c: char| !is_name(c));
        words.any(|word| word == interface)
    }
}

fn lines_of(text: &str) -> BTreeMap<u32, Line> {
    let mut lines = text.lines();
    // Columns are those of the CPUs that are online; a gap in their numbers is a gap here.
    let header = lines.next().unwrap_or_default().split_whitespace();
    let columns: Vec<usize> = header
        .filter_map(|word| word.strip_prefix("CPU")?.parse().ok())
        .collect();
    let parsed = lines.filter_map(|line| {
        let (number, rest) = line.split_once(':')?;
        let number = number.trim().parse().ok()?;
        let mut words = rest.split_whitespace();
        let mut counts = vec![0; columns.iter().max().map_or(0, |cpu| cpu + 1)];
        for cpu in &columns {
            counts[*cpu] = words.next()?.parse().ok()?;
        }
        let words = words.collect::<Vec<_>>().join(" ");
        Some((number, Line { counts, words }))
    });
    parsed.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::finding::Severity;
    use crate::plan::Pin;
    use hil_platform::host_facts::FakeHost;

    const TABLE: &str = "           CPU0       CPU1       CPU3\n\
        \x20 8:          1          0          0  IO-APIC   8-edge      rtc0\n\
        \x2024:          5       4242          7  PCI-MSI 1-edge      eth0-rx-0\n\
        \x2025:          9          0          0  PCI-MSI 2-edge      eth0-tx-0\n\
        \x2026:          3          0          0  PCI-MSI 2-edge      eth01\n\
        LOC:      74667     102075          3  Local timer interrupts\n";

    fn plan(cpu: usize) -> Plan {
        Plan {
            pins: vec![Pin {
                cpu,
                key: "processes.robot.cpu".to_owned(),
                of: "robot".to_owned(),
                spins: false,
            }],
            ..Plan::default()
        }
    }

    fn host(extra: &[(&str, &str)]) -> FakeHost {
        let mut files = vec![
            ("/proc/interrupts", TABLE),
            ("/sys/class/net/eth0/device/vendor", "0x8086"),
            ("/sys/class/net/lo/mtu", "65536"),
            ("/proc/irq/24/smp_affinity_list", "0-3"),
            ("/proc/irq/24/effective_affinity_list", "1"),
            ("/proc/irq/25/smp_affinity_list", "0"),
        ];
        files.extend(extra);
        FakeHost::with(&files)
    }

    fn examined(host: &FakeHost, cpu: usize) -> Vec<Finding> {
        let interfaces = ["eth0".to_owned(), "lo".to_owned()];
        examine(&host.files(), &interfaces, &plan(cpu))
    }

    #[test]
    fn an_interrupt_on_a_pinned_cpu_is_named_with_its_cure() {
        let findings = examined(&host(&[]), 1);
        assert_eq!(
            findings.len(),
            1,
            "loopback has no interrupts: {findings:?}"
        );
        let finding = &findings[0];
        assert_eq!(finding.id, "interrupts.eth0");
        assert_eq!(finding.severity, Severity::Warning);
        assert_eq!(
            finding.value,
            "24 on CPU 1, 25 on CPU 0; CPU 1 is pinned to by robot (4242 struck there so far)"
        );
        assert_eq!(
            finding.fix,
            "for i in 24 25; do echo 0,2-3 > /proc/irq/$i/smp_affinity_list; done"
        );
    }

    #[test]
    fn one_that_may_come_is_a_note_and_one_that_may_not_is_ok() {
        assert_eq!(examined(&host(&[]), 3)[0].severity, Severity::Note);
        assert_eq!(examined(&host(&[]), 7)[0].severity, Severity::Ok);
    }

    #[test]
    fn the_devices_own_list_counts_before_names() {
        let listed = host(&[
            ("/sys/class/net/eth0/device/msi_irqs/25", "msix"),
            ("/sys/class/net/eth0/device/msi_irqs/99", "msix"),
        ]);
        let finding = &examined(&listed, 1)[0];
        assert_eq!(finding.value, "25 on CPU 0");
        assert_eq!(finding.severity, Severity::Ok);
    }

    #[test]
    fn what_cannot_be_read_is_not_ok() {
        let device = ("/sys/class/net/eth0/device/vendor", "0x8086");
        for files in [
            vec![device],
            vec![device, ("/proc/interrupts", "CPU0\n 8: 1 rtc0\n")],
            vec![device, ("/proc/interrupts", TABLE)],
        ] {
            let host = FakeHost::with(&files);
            let finding = &examined(&host, 1)[0];
            assert_eq!(finding.severity, Severity::CannotTell, "{finding:?}");
        }
    }
}
