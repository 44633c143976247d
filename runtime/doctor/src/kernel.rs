//! The kernel: how it preempts, what it keeps back from real-time tasks, how it was built, what else
//! it does in the background. It reads settings only; what they cost is measured by the wake-ups.

use super::{Finding, finding::Severity, plan::Plan};
use hil_platform::host_facts::{
    Fact, HostFiles, KernelOptions, PreemptionMode, RealtimeThrottle, boot_parameter, clocksource,
    format_cpu_list, has_fair_server, load_average, online_cpus, preemption, virtual_machine,
};

/// Clocks that are read in user space through the vDSO; any other is a system call.
const FAST_CLOCKS: [&str; 4] = [
    "tsc",
    "arch_sys_counter",
    "kvm-clock",
    "hyperv_clocksource_tsc_page",
];
const FAIR_SERVER_FOLDER: &str = "/sys/kernel/debug/sched/fair_server";
/// Runnable tasks per CPU above which the host counts as busy.
const LOAD_PER_CPU_BUSY: f64 = 0.5;

/// `is_fifo_granted` is what a trial found, where there was one.
pub(super) fn examine(
    files: &HostFiles,
    plan: &Plan,
    is_fifo_granted: Option<bool>,
) -> Vec<Finding> {
    vec![
        preemption_model(files),
        throttle(files, plan),
        fair_server(files, plan),
        group_scheduling(files, is_fifo_granted),
        clock_source(files),
        huge_pages(files),
        irqbalance(files, plan),
        machine(files),
        load(files),
    ]
}

fn preemption_model(files: &HostFiles) -> Finding {
    let id = "preemption";
    let found = match preemption(files) {
        Fact::Available(found) => found,
        Fact::Unavailable(reason) => return Finding::cannot_tell(id, reason),
    };
    let severity = match found.mode {
        Fact::Available(PreemptionMode::Realtime | PreemptionMode::Full) => Severity::Ok,
        Fact::Available(PreemptionMode::Lazy) => Severity::Note,
        Fact::Available(PreemptionMode::Voluntary | PreemptionMode::None) => Severity::Warning,
        Fact::Unavailable(reason) => return Finding::cannot_tell(id, reason),
    };
    Finding::new(id, severity, found.words).read_from(found.source)
}

/// What takes time from busy pollers matters more where the topology has some.
fn worse_when_spinning(plan: &Plan) -> Severity {
    if plan.spins() {
        Severity::Warning
    } else {
        Severity::Note
    }
}

fn throttle(files: &HostFiles, plan: &Plan) -> Finding {
    let id = "realtime_throttle";
    let throttle = match RealtimeThrottle::read(files) {
        Fact::Available(throttle) => throttle,
        Fact::Unavailable(reason) => return Finding::cannot_tell(id, reason),
    };
    let (runtime_us, period_us) = (throttle.runtime_us, throttle.period_us);
    if !throttle.is_active() {
        return Finding::ok(id, format!("none (sched_rt_runtime_us={runtime_us})"));
    }
    let lost_us = period_us - runtime_us;
    let value = format!("{lost_us} us of every {period_us} us");
    Finding::new(id, worse_when_spinning(plan), value)
}

fn fair_server(files: &HostFiles, plan: &Plan) -> Finding {
    let id = "fair_server";
    match has_fair_server(files) {
        Fact::Available(false) => return Finding::ok(id, "none before Linux 6.12"),
        Fact::Available(true) => {}
        Fact::Unavailable(reason) => return Finding::cannot_tell(id, reason),
    }
    let runtimes = files.list(FAIR_SERVER_FOLDER).and_then(|cpus| {
        let read = |cpu: &String| {
            let path = format!("{FAIR_SERVER_FOLDER}/{cpu}/runtime");
            files.read_number(&path).map(|ns| (cpu.clone(), ns / 1000))
        };
        let mut found = Vec::new();
        for cpu in cpus.iter().filter(|name| name.starts_with("cpu")) {
            match read(cpu) {
                Fact::Available(one) => found.push(one),
                Fact::Unavailable(reason) => return Fact::Unavailable(reason),
            }
        }
        Fact::Available(found)
    });
    let runtimes = match runtimes {
        Fact::Available(runtimes) if !runtimes.is_empty() => runtimes,
        Fact::Available(_) => {
            return Finding::cannot_tell(id, format!("{FAIR_SERVER_FOLDER} lists no CPU"));
        }
        Fact::Unavailable(reason) => {
            let why = format!("{reason}; the kernel's default is 50000 us per second");
            return Finding::cannot_tell(id, why)
                .fixed_by("as root: mount -t debugfs none /sys/kernel/debug, then run this again");
        }
    };
    let lent: Vec<usize> = runtimes
        .iter()
        .filter(|(_, us)| *us > 0)
        .filter_map(|(cpu, _)| cpu.strip_prefix("cpu")?.parse().ok())
        .collect();
    if lent.is_empty() {
        return Finding::ok(id, "switched off on every CPU");
    }
    let most = runtimes.iter().map(|(_, us)| *us).max().unwrap_or(0);
    let value = format!("{most} us per second on CPU {}", format_cpu_list(&lent));
    Finding::new(id, worse_when_spinning(plan), value)
}

fn group_scheduling(files: &HostFiles, is_fifo_granted: Option<bool>) -> Finding {
    let id = "rt_group_sched";
    let options = match KernelOptions::read(files) {
        Fact::Available(options) => options,
        Fact::Unavailable(reason) => return Finding::cannot_tell(id, reason),
    };
    if !options.has("RT_GROUP_SCHED") {
        return Finding::ok(id, "not built in").read_from(options.source);
    }
    let booted = boot_parameter(files, "rt_group_sched");
    let is_off = match booted.available() {
        Some(Some(value)) => value == "0",
        _ => options.has("RT_GROUP_SCHED_DEFAULT_DISABLED"),
    };
    if is_off {
        return Finding::ok(id, "built in and switched off").read_from(options.source);
    }
    let (severity, here) = match is_fifo_granted {
        Some(true) => (
            Severity::Note,
            "this group has a budget: SCHED_FIFO was granted",
        ),
        Some(false) => (Severity::Error, "SCHED_FIFO was refused"),
        None => (
            Severity::Warning,
            "whether this group has a budget was not tried",
        ),
    };
    Finding::new(id, severity, format!("built in; {here}")).read_from(options.source)
}

fn clock_source(files: &HostFiles) -> Finding {
    let id = "clocksource";
    match clocksource(files) {
        Fact::Available(name) if FAST_CLOCKS.contains(&name.as_str()) => Finding::ok(id, name),
        Fact::Available(name) => Finding::warning(id, name),
        Fact::Unavailable(reason) => Finding::cannot_tell(id, reason),
    }
}

fn huge_pages(files: &HostFiles) -> Finding {
    let id = "transparent_huge_pages";
    let modes = match files.read("/sys/kernel/mm/transparent_hugepage/enabled") {
        Fact::Available(modes) => modes,
        Fact::Unavailable(reason) => return Finding::cannot_tell(id, reason),
    };
    let marked = modes
        .split_once('[')
        .and_then(|(_, rest)| rest.split_once(']'));
    match marked {
        Some(("always", _)) => Finding::note(id, "always"),
        Some((mode, _)) => Finding::ok(id, mode),
        None => Finding::cannot_tell(id, format!("no mode is marked in `{modes}`")),
    }
}

fn irqbalance(files: &HostFiles, plan: &Plan) -> Finding {
    let id = "irqbalance";
    let commands = match files.process_names() {
        Fact::Available(commands) => commands,
        Fact::Unavailable(reason) => return Finding::cannot_tell(id, reason),
    };
    if !commands.iter().any(|command| command == "irqbalance") {
        return Finding::ok(id, "not running");
    }
    if plan.pins.is_empty() {
        Finding::note(id, "running")
    } else {
        let cpus = format_cpu_list(&plan.cpus());
        Finding::warning(id, format!("running, and CPU {cpus} is pinned to")).fixed_by(format!(
            "systemctl stop irqbalance, or IRQBALANCE_BANNED_CPULIST={cpus} in \
             /etc/default/irqbalance"
        ))
    }
}

fn machine(files: &HostFiles) -> Finding {
    let id = "virtual_machine";
    match virtual_machine(files) {
        Fact::Available(answer) if answer == "no" => Finding::ok(id, answer),
        Fact::Available(answer) => Finding::note(id, answer),
        Fact::Unavailable(reason) => Finding::cannot_tell(id, reason),
    }
}

fn load(files: &HostFiles) -> Finding {
    let id = "load";
    let (minute, words) = match load_average(files) {
        Fact::Available(load) => load,
        Fact::Unavailable(reason) => return Finding::cannot_tell(id, reason),
    };
    let cpus = match online_cpus(files) {
        Fact::Available(cpus) => cpus.len(),
        Fact::Unavailable(reason) => return Finding::cannot_tell(id, reason),
    };
    let per_cpu = minute / cpus.max(1) as f64;
    let severity = Severity::of_size(per_cpu, LOAD_PER_CPU_BUSY, 1.0);
    Finding::new(id, severity, format!("{words}, {cpus} CPUs"))
}

#[cfg(test)]
#[path = "kernel_tests.rs"]
mod tests;
