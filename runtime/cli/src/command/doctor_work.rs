//! `doctor`: from its arguments to a report and an exit code.

use std::fs;
use std::io::IsTerminal;
use std::path::Path;

use super::{Refusal, exit, hosts_here, interrupted, load, signals, usage};
use hil_doctor::cli::DoctorArgs;
use hil_doctor::latency::{LatencyReport, LatencyRequest, Watch, measure};
use hil_doctor::{DoctorReport, DoctorRequest, Plan, Severity};
use hil_engine::supervisor;
use hil_platform::console::Console;
use hil_platform::host_facts::{HostFiles, isolated_or_online};
use hil_platform::progress::Progress;
use hil_platform::signals::Signals;
use hil_topology::registry::Registry;

/// `doctor`.
pub(super) fn doctor(
    args: &DoctorArgs,
    registry: &Registry,
    console: &mut Console,
) -> Result<u8, Refusal> {
    let request = request(args, registry, console)?;
    let latency = latency_request(args, &request).map_err(usage)?;
    let signals = signals()?;
    let watch = signals.end_program_unless_over(
        "the doctor describes a host whole or not at all; a card it was trying is put back",
    );
    let mut report = hil_doctor::examine(&request);
    report.host = report.host.built_from(super::REVISION);
    let is_interrupted = if latency.is_thorough {
        // From here on a signal ends the measurement, not the program.
        drop(watch);
        let measured = measured(&latency, &request.files, &signals, console);
        let is_interrupted = measured.is_interrupted;
        report.add_latency(measured);
        is_interrupted
    } else {
        let patient = Watch {
            is_stopped: &|| false,
            stage: None,
        };
        report.add_latency(measure(&latency, &request.files, &patient));
        drop(watch);
        false
    };
    let text = if args.json {
        format!("{}\n", report.to_json())
    } else {
        report.to_text(true)
    };
    console.result(&text);
    Ok(if is_interrupted {
        interrupted()
    } else if args.strict && report.worst_severity() >= Severity::Warning {
        exit::HOST_UNFIT
    } else {
        exit::RAN
    })
}

/// What a topology, and another host's report, have the doctor look at beside the host itself.
fn request(
    args: &DoctorArgs,
    registry: &Registry,
    console: &mut Console,
) -> Result<DoctorRequest, Refusal> {
    let mut request = DoctorRequest::default();
    if let Some(path) = &args.other {
        request.other = Some(other_report(path).map_err(usage)?);
    }
    if let Some(path) = &args.topology {
        let topology = load(path, &args.overrides, registry, console)?;
        let here = hosts_here(&topology, args.host.as_deref()).map_err(usage)?;
        request.plan = Some(Plan::of(&topology, &here));
        let short = supervisor::check_host(&topology, &here).err();
        let short = short.map_or_else(Vec::new, |error| error.0);
        request.shortfalls = Some(short.iter().map(ToString::to_string).collect());
    }
    Ok(request)
}

fn other_report(path: &Path) -> Result<(String, Box<DoctorReport>), String> {
    let shown = path.display();
    let text = fs::read_to_string(path).map_err(|error| format!("{shown}: {error}"))?;
    let report = DoctorReport::from_json(&text)
        .map_err(|why| format!("{shown} is no report of `doctor --json`: {why}"))?;
    let name = report.host.find("hostname");
    let name = name.and_then(|name| name.available().cloned());
    Ok((name.unwrap_or_else(|| shown.to_string()), Box::new(report)))
}

/// Where and how long to measure.
fn latency_request(args: &DoctorArgs, request: &DoctorRequest) -> Result<LatencyRequest, String> {
    let pinned = request.plan.as_ref().map(Plan::cpus).unwrap_or_default();
    let Some(duration) = args.latency else {
        return Ok(LatencyRequest::brief(pinned.first().copied()));
    };
    let files = &request.files;
    let mut cpus = if !args.cpu.is_empty() {
        args.cpu.clone()
    } else if !pinned.is_empty() {
        pinned
    } else {
        isolated_or_online(files)
    };
    cpus.sort_unstable();
    cpus.dedup();
    hil_platform::host_facts::refuse_absent(files, &cpus)?;
    Ok(LatencyRequest {
        duration,
        cpus,
        priority: args.priority,
        period: args.period,
        is_thorough: true,
    })
}

fn measured(
    request: &LatencyRequest,
    files: &HostFiles,
    signals: &Signals,
    console: &mut Console,
) -> LatencyReport {
    if std::io::stderr().is_terminal() {
        console.say(&request.announcement());
    }
    Progress::begin().during(console, "measuring", |stage| {
        let watch = Watch {
            is_stopped: &|| signals.received().is_some(),
            stage: Some(stage),
        };
        measure(request, files, &watch)
    })
}
