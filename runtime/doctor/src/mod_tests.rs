//! The doctor as a whole, on the running host and on one that tells nothing.

use std::collections::BTreeSet;
use std::time::Duration;

use super::latency::{LatencyRequest, Watch, measure};
use super::*;
use hil_platform::host_facts::FakeHost;

fn examined() -> DoctorReport {
    let mut report = examine(&DoctorRequest::default());
    let request = LatencyRequest {
        duration: Duration::from_millis(20),
        ..LatencyRequest::brief(None)
    };
    let watch = Watch {
        is_stopped: &|| false,
        stage: None,
    };
    report.add_latency(measure(&request, &HostFiles::of_this_host(), &watch));
    report
}

fn find<'a>(report: &'a DoctorReport, id: &str) -> Option<&'a Finding> {
    report.findings.iter().find(|finding| finding.id == id)
}

#[test]
fn every_finding_has_its_own_name_and_says_all_there_is_to_say() {
    let report = examined();
    let names: BTreeSet<&str> = report.findings.iter().map(|f| f.id.as_str()).collect();
    assert_eq!(names.len(), report.findings.len());
    for finding in &report.findings {
        let Finding {
            id,
            title,
            value,
            source,
            why,
            fix,
            ..
        } = finding;
        for words in [title, value, source, why, fix] {
            assert!(!words.is_empty() && !words.contains("{}"), "{finding:?}");
        }
        let kind = id.split('.').next().unwrap();
        assert!(catalogue::entry(kind).is_some(), "{id} is not documented");
    }
    let counted: usize = report.counts.values().sum();
    assert_eq!(counted, report.findings.len());
}

#[test]
fn the_whole_list_is_covered() {
    let report = examined();
    let several = [
        "interface",
        "timestamps",
        "card",
        "radio",
        "interrupts",
        "coalescing",
        "ring",
        "route",
        "mtu",
        "clock_between_hosts",
    ];
    // These need a topology.
    let planned = ["ports", "clock_path", "run_limits"];
    for (_, entries) in catalogue::SUBJECTS {
        for entry in entries {
            if !several.contains(&entry.id) && !planned.contains(&entry.id) {
                assert!(
                    find(&report, entry.id).is_some(),
                    "no finding `{}`",
                    entry.id
                );
            }
        }
    }
    assert!(find(&report, "timestamps.lo").is_some());
}

#[test]
fn what_is_of_one_interface_only_says_which() {
    // An identifier with a place for a name and without one would be ambiguous in scripts.
    for (_, entries) in catalogue::SUBJECTS {
        for entry in entries {
            let finding = Finding::ok(entry.id, "x");
            let has_place = finding.source.contains("{}") || finding.fix.contains("{}");
            let named = finding.of("eth0");
            assert!(!named.source.contains("{}") && !named.fix.contains("{}"));
            let ends_open = entry.title.ends_with(" of")
                || entry.title.ends_with(" on")
                || entry.title.ends_with(" to")
                || entry.title.ends_with(" and")
                || entry.title.ends_with(" link")
                || entry.id == "interface";
            assert_eq!(has_place, ends_open, "{}", entry.id);
        }
    }
}

#[test]
fn a_host_without_files_passes_nothing_that_is_read_from_files() {
    let nowhere = FakeHost::with(&[]);
    let request = DoctorRequest {
        files: nowhere.files(),
        ..DoctorRequest::default()
    };
    let report = examine(&request);
    for id in [
        "preemption",
        "realtime_throttle",
        "fair_server",
        "rt_group_sched",
        "clocksource",
        "transparent_huge_pages",
        "irqbalance",
        "virtual_machine",
        "load",
        "isolated_cpus",
        "nohz_full",
        "rcu_nocbs",
        "governor",
        "idle_states",
        "smt",
        "memory_lock",
        "udp_buffers",
        "private_tmp",
        "shared_memory_leftovers",
    ] {
        let finding = find(&report, id).unwrap();
        assert_eq!(finding.severity, Severity::CannotTell, "{finding:?}");
    }
}

#[test]
fn the_worst_finding_decides() {
    let with = |findings: Vec<Finding>| DoctorReport::of(findings).worst_severity();
    assert_eq!(with(vec![]), Severity::Ok);
    let (note, ok) = (Finding::note("load", "a"), Finding::ok("smt", "b"));
    assert_eq!(with(vec![note.clone(), ok.clone()]), Severity::Note);
    let unknown = Finding::cannot_tell("fifo", "why");
    assert_eq!(with(vec![unknown.clone(), note]), Severity::CannotTell);
    let warning = Finding::warning("governor", "w");
    assert_eq!(with(vec![warning, unknown]), Severity::Warning);
    assert_eq!(
        with(vec![ok, Finding::error("ports", "e")]),
        Severity::Error
    );
}

#[test]
fn the_report_survives_json_and_another_form_is_refused() {
    let report = examined();
    let text = report.to_json();
    assert_eq!(DoctorReport::from_json(&text).unwrap(), report);
    let other = text.replace(DoctorReport::SCHEMA, "hil-doctor/0");
    let why = DoctorReport::from_json(&other).unwrap_err();
    assert!(why.contains("hil-doctor/0"), "{why}");
    assert!(DoctorReport::from_json("{}").is_err());
}
