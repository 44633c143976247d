//! The kernel's findings on made-up hosts: good, bad and unreadable.

use super::*;
use crate::plan::Pin;
use hil_platform::host_facts::FakeHost;

type Look = fn(&HostFiles) -> Checked;

const RELEASE: &str = "/proc/sys/kernel/osrelease";
const VERSION: &str = "/proc/sys/kernel/version";
const CMDLINE: &str = "/proc/cmdline";
const BUILT: &str = "/boot/config-6.12.1";

fn spinning() -> Plan {
    Plan {
        pins: vec![Pin {
            cpu: 3,
            key: "links.hop.gateway.cpu".to_owned(),
            of: "gateway".to_owned(),
            spins: true,
        }],
        ..Plan::default()
    }
}

fn of(files: &[(&str, &str)], look: impl Fn(&HostFiles) -> Checked) -> Finding {
    settled(look(&FakeHost::with(files).files()))
}

#[test]
fn an_empty_host_tells_nothing_and_passes_nothing() {
    let host = FakeHost::with(&[]);
    for finding in examine(&host.files(), &Plan::default(), None) {
        assert_eq!(finding.severity, Severity::CannotTell, "{finding:?}");
    }
}

#[test]
fn folders_in_place_of_files_are_told_as_unreadable() {
    let files: Vec<(String, &str)> = [
        "/sys/kernel/mm/transparent_hugepage/enabled",
        "/proc/sys/kernel/sched_rt_runtime_us",
        "/proc/loadavg",
        "/proc/cpuinfo",
    ]
    .iter()
    .map(|path| (format!("{path}/below"), ""))
    .collect();
    let files: Vec<(&str, &str)> = files
        .iter()
        .map(|(path, text)| (path.as_str(), *text))
        .collect();
    let host = FakeHost::with(&files);
    for finding in [
        huge_pages(&host.files()),
        throttle(&host.files(), &Plan::default()),
        load(&host.files()),
        machine(&host.files()),
    ]
    .map(settled)
    {
        assert_eq!(finding.severity, Severity::CannotTell, "{finding:?}");
        assert!(finding.value.contains("directory"), "{finding:?}");
    }
}

#[test]
fn preemption_is_ok_only_where_real_time_tasks_get_through() {
    let built = |option: &'static str| {
        vec![
            (VERSION, "#1 SMP PREEMPT_DYNAMIC"),
            (RELEASE, "6.12.1"),
            (CMDLINE, "quiet"),
            (BUILT, option),
        ]
    };
    for (files, expected) in [
        (vec![("/sys/kernel/realtime", "1")], Severity::Ok),
        (built("CONFIG_PREEMPT=y"), Severity::Ok),
        (built("CONFIG_PREEMPT_LAZY=y"), Severity::Note),
        (built("CONFIG_PREEMPT_VOLUNTARY=y"), Severity::Warning),
        (built("CONFIG_PREEMPT_NONE=y"), Severity::Warning),
        (vec![(VERSION, "#1 SMP")], Severity::Warning),
        (
            vec![(VERSION, "#1 SMP PREEMPT_DYNAMIC")],
            Severity::CannotTell,
        ),
    ] {
        let finding = of(&files, preemption_model);
        assert_eq!(finding.severity, expected, "{finding:?}");
    }
}

#[test]
fn the_throttle_is_stated_in_microseconds_and_weighs_by_the_topology() {
    let files = |runtime| {
        [
            ("/proc/sys/kernel/sched_rt_runtime_us", runtime),
            ("/proc/sys/kernel/sched_rt_period_us", "1000000"),
        ]
    };
    let idle = of(&files("950000"), |files| throttle(files, &Plan::default()));
    assert_eq!(idle.severity, Severity::Note);
    assert_eq!(idle.value, "50000 us of every 1000000 us");
    let spins = of(&files("950000"), |files| throttle(files, &spinning()));
    assert_eq!(spins.severity, Severity::Warning);
    let off = of(&files("-1"), |files| throttle(files, &spinning()));
    assert_eq!(off.severity, Severity::Ok);
}

#[test]
fn the_fair_server_is_read_per_cpu() {
    let runtime = |cpu: usize| format!("{FAIR_SERVER_FOLDER}/cpu{cpu}/runtime");
    let (first, second) = (runtime(0), runtime(1));
    let host = |ns: &'static str| {
        [
            (RELEASE, "6.12.1"),
            (first.as_str(), "0"),
            (second.as_str(), ns),
        ]
    };
    let lent = of(&host("50000000"), |files| fair_server(files, &spinning()));
    assert_eq!(lent.severity, Severity::Warning);
    assert_eq!(lent.value, "50000 us per second on CPU 1");
    let off = of(&host("0"), |files| fair_server(files, &spinning()));
    assert_eq!(off.severity, Severity::Ok);
    let old = of(&[(RELEASE, "6.1.0")], |files| {
        fair_server(files, &spinning())
    });
    assert_eq!(old.severity, Severity::Ok);
    let hidden = of(&[(RELEASE, "6.12.1")], |files| {
        fair_server(files, &spinning())
    });
    assert_eq!(hidden.severity, Severity::CannotTell);
    assert!(hidden.value.contains("50000 us"), "{hidden:?}");
}

#[test]
fn group_scheduling_is_judged_with_the_trial() {
    let on = [(RELEASE, "6.12.1"), (BUILT, "CONFIG_RT_GROUP_SCHED=y")];
    let refused = GrantOutcome::Refused {
        error: "EPERM".to_owned(),
        reason: "RLIMIT_RTPRIO is 0".to_owned(),
        fix: "needs CAP_SYS_NICE".to_owned(),
    };
    for (tried, expected) in [
        (Some(&GrantOutcome::Granted), Severity::Note),
        (Some(&refused), Severity::Error),
        (None, Severity::Warning),
    ] {
        let finding = of(&on, |files| group_scheduling(files, tried));
        assert_eq!(finding.severity, expected);
        assert_eq!(finding.source, BUILT);
    }
    let absent = [
        (RELEASE, "6.12.1"),
        (BUILT, "# CONFIG_RT_GROUP_SCHED is not set"),
    ];
    let off = [on[0], on[1], (CMDLINE, "rt_group_sched=0")];
    for files in [&absent[..], &off[..]] {
        let finding = of(files, |files| group_scheduling(files, None));
        assert_eq!(finding.severity, Severity::Ok);
    }
}

#[test]
fn settings_of_one_word_are_judged_by_it() {
    let huge = "/sys/kernel/mm/transparent_hugepage/enabled";
    let clock = "/sys/devices/system/clocksource/clocksource0/current_clocksource";
    let cases: [(&str, &str, Look, Severity); 6] = [
        (huge, "always [madvise] never", huge_pages, Severity::Ok),
        (huge, "[always] madvise never", huge_pages, Severity::Note),
        (huge, "always madvise", huge_pages, Severity::CannotTell),
        (clock, "tsc", clock_source, Severity::Ok),
        (clock, "hpet", clock_source, Severity::Warning),
        (
            "/proc/cpuinfo",
            "flags : fpu hypervisor",
            machine,
            Severity::Note,
        ),
    ];
    for (path, text, look, expected) in cases {
        assert_eq!(
            of(&[(path, text)], look).severity,
            expected,
            "{path} {text}"
        );
    }
    let bare = of(&[("/proc/cpuinfo", "flags : fpu")], machine);
    assert_eq!(bare.severity, Severity::Ok);
}

#[test]
fn irqbalance_matters_where_cpus_are_pinned() {
    let running = [("/proc/17/comm", "irqbalance"), ("/proc/1/comm", "systemd")];
    let look = |plan: Plan| move |files: &HostFiles| irqbalance(files, &plan);
    assert_eq!(of(&running, look(Plan::default())).severity, Severity::Note);
    let pinned = of(&running, look(spinning()));
    assert_eq!(pinned.severity, Severity::Warning);
    assert!(pinned.fix.contains("CPULIST=3"), "{}", pinned.fix);
    let absent = of(&running[1..], look(spinning()));
    assert_eq!(absent.severity, Severity::Ok);
    let blind = of(&[("/proc/cmdline", "")], look(spinning()));
    assert_eq!(blind.severity, Severity::CannotTell);
}

#[test]
fn load_is_judged_per_cpu() {
    let host = |load| {
        [
            ("/proc/loadavg", load),
            ("/sys/devices/system/cpu/online", "0-3"),
        ]
    };
    for (text, expected) in [
        ("0.50 0.4 0.3 1/99 7", Severity::Ok),
        ("3.00 0.4 0.3 1/99 7", Severity::Note),
        ("9.00 0.4 0.3 1/99 7", Severity::Warning),
        ("much", Severity::CannotTell),
    ] {
        assert_eq!(of(&host(text), load).severity, expected, "{text}");
    }
}
