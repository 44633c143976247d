//! The kernel: how it preempts, what it keeps back from real-time tasks, how it was built, what else
//! it does in the background. It reads settings only; what they cost is measured by the wake-ups.

use super::finding::{Answer, Checked, Finding, Severity, settled};
use super::plan::Plan;
use hil_platform::host_facts::{
    HostFiles, KernelOptions, PreemptionMode, RealtimeThrottle, boot_parameter, clocksource,
    format_cpu_list, has_fair_server, load_average, online_cpus, preemption, virtual_machine,
};
use hil_platform::realtime::GrantOutcome;

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

/// `fifo` is what a trial of `SCHED_FIFO` came to, where there was one.
pub(super) fn examine(files: &HostFiles, plan: &Plan, fifo: Option<&GrantOutcome>) -> Vec<Finding> {
    let checks = [
        preemption_model(files),
        throttle(files, plan),
        fair_server(files, plan),
        group_scheduling(files, fifo),
        clock_source(files),
        huge_pages(files),
        irqbalance(files, plan),
        machine(files),
        load(files),
    ];
    checks.map(settled).into()
}

fn preemption_model(files: &HostFiles) -> Checked {
    let id = "preemption";
    let found = preemption(files).told(id)?;
    let severity = match found.mode.told(id)? {
        PreemptionMode::Realtime | PreemptionMode::Full => Severity::Ok,
        PreemptionMode::Lazy => Severity::Note,
        PreemptionMode::Voluntary | PreemptionMode::None => Severity::Warning,
    };
    Ok(Finding::new(id, severity, found.words).read_from(found.source))
}

/// What takes time from busy pollers matters more where there are some.
pub(super) fn worse_when_spinning(spins: bool) -> Severity {
    if spins {
        Severity::Warning
    } else {
        Severity::Note
    }
}

fn throttle(files: &HostFiles, plan: &Plan) -> Checked {
    let id = "realtime_throttle";
    let throttle = RealtimeThrottle::read(files).told(id)?;
    let (runtime_us, period_us) = (throttle.runtime_us, throttle.period_us);
    if !throttle.is_active() {
        let value = format!("none (sched_rt_runtime_us={runtime_us})");
        return Ok(Finding::ok(id, value));
    }
    let value = format!("{} us of every {period_us} us", period_us - runtime_us);
    Ok(Finding::new(id, worse_when_spinning(plan.spins()), value))
}

/// Each CPU with the microseconds of every second that it lends to normal tasks.
fn lent_us(files: &HostFiles) -> Result<Vec<(usize, i64)>, String> {
    let mut found = Vec::new();
    for name in files.list(FAIR_SERVER_FOLDER).known()? {
        if let Some(cpu) = name.strip_prefix("cpu").and_then(|cpu| cpu.parse().ok()) {
            let runtime_ns = files.read_number(&format!("{FAIR_SERVER_FOLDER}/{name}/runtime"));
            found.push((cpu, runtime_ns.known()? / 1000));
        }
    }
    Ok(found)
}

fn fair_server(files: &HostFiles, plan: &Plan) -> Checked {
    let id = "fair_server";
    if !has_fair_server(files).told(id)? {
        return Ok(Finding::ok(id, "none before Linux 6.12"));
    }
    let found = lent_us(files).map_err(|reason| {
        let why = format!("{reason}; the kernel's default is 50000 us per second");
        Finding::cannot_tell(id, why)
            .fixed_by("as root: mount -t debugfs none /sys/kernel/debug, then run this again")
    })?;
    let most = found.iter().map(|(_, us)| *us).max();
    let most = most.ok_or(format!("{FAIR_SERVER_FOLDER} lists no CPU"));
    let most = most.told(id)?;
    let lending = found.iter().filter(|(_, us)| *us > 0);
    let lending: Vec<usize> = lending.map(|(cpu, _)| *cpu).collect();
    if lending.is_empty() {
        return Ok(Finding::ok(id, "switched off on every CPU"));
    }
    let value = format!("{most} us per second on CPU {}", format_cpu_list(&lending));
    Ok(Finding::new(id, worse_when_spinning(plan.spins()), value))
}

fn group_scheduling(files: &HostFiles, fifo: Option<&GrantOutcome>) -> Checked {
    let id = "rt_group_sched";
    let options = KernelOptions::read(files).told(id)?;
    let is_off = match boot_parameter(files, "rt_group_sched").available() {
        Some(Some(value)) => value == "0",
        _ => options.has("RT_GROUP_SCHED_DEFAULT_DISABLED"),
    };
    let (severity, value) = match fifo {
        _ if !options.has("RT_GROUP_SCHED") => (Severity::Ok, "not built in"),
        _ if is_off => (Severity::Ok, "built in and switched off"),
        Some(GrantOutcome::Granted) => (
            Severity::Note,
            "built in; this group has a budget: SCHED_FIFO was granted",
        ),
        Some(_) => (Severity::Error, "built in; SCHED_FIFO was refused"),
        None => (
            Severity::Warning,
            "built in; whether this group has a budget was not tried",
        ),
    };
    Ok(Finding::new(id, severity, value).read_from(options.source))
}

fn clock_source(files: &HostFiles) -> Checked {
    let id = "clocksource";
    let name = clocksource(files).told(id)?;
    let is_fast = FAST_CLOCKS.contains(&name.as_str());
    Ok(Finding::new(
        id,
        Severity::ok_if(is_fast, Severity::Warning),
        name,
    ))
}

fn huge_pages(files: &HostFiles) -> Checked {
    let id = "transparent_huge_pages";
    let modes = files.read("/sys/kernel/mm/transparent_hugepage/enabled");
    let modes = modes.told(id)?;
    let (_, rest) = modes.split_once('[').unwrap_or_default();
    let Some((mode, _)) = rest.split_once(']') else {
        return Err(format!("no mode is marked in `{modes}`")).told(id);
    };
    Ok(Finding::new(
        id,
        Severity::ok_if(mode != "always", Severity::Note),
        mode,
    ))
}

fn irqbalance(files: &HostFiles, plan: &Plan) -> Checked {
    let id = "irqbalance";
    let commands = files.process_names().told(id)?;
    if !commands.iter().any(|command| command == "irqbalance") {
        return Ok(Finding::ok(id, "not running"));
    }
    if plan.pins.is_empty() {
        return Ok(Finding::note(id, "running"));
    }
    let cpus = format_cpu_list(&plan.cpus());
    let value = format!("running, and CPU {cpus} is pinned to");
    Ok(Finding::warning(id, value).fixed_by(format!(
        "systemctl stop irqbalance, or IRQBALANCE_BANNED_CPULIST={cpus} in /etc/default/irqbalance"
    )))
}

fn machine(files: &HostFiles) -> Checked {
    let id = "virtual_machine";
    let answer = virtual_machine(files).told(id)?;
    Ok(Finding::new(
        id,
        Severity::ok_if(answer == "no", Severity::Note),
        answer,
    ))
}

fn load(files: &HostFiles) -> Checked {
    let id = "load";
    let (minute, words) = load_average(files).told(id)?;
    let cpus = online_cpus(files).told(id)?.len();
    let severity = Severity::rising(minute / cpus.max(1) as f64, LOAD_PER_CPU_BUSY, 1.0);
    Ok(Finding::new(id, severity, format!("{words}, {cpus} CPUs")))
}

#[cfg(test)]
#[path = "kernel_tests.rs"]
mod tests;
