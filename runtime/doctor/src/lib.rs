//! `hil-runtime doctor`: what this host can measure, what stands in the way, and the cure for
//! each. It examines and reports; it changes nothing that outlives it, prints nothing and knows
//! no exit codes: the caller turns [`DoctorReport::worst_severity`] into one.
//!
//! One file per subject, each a function from the kernel's files (below a root that tests can move)
//! and a [`Plan`] to findings; [`latency`] measures. Every finding is in the catalogue, from which
//! `docs/doctor.md` is checked.
#![forbid(unsafe_code)]

mod catalogue;
pub mod cli;
mod clock_path;
mod clocks;
mod driver;
mod finding;
mod firewall;
mod interrupts;
mod kernel;
pub mod latency;
mod network;
mod nic;
mod obstacles;
mod paths;
mod plan;
mod ports;
mod privileges;
mod processors;
mod radio;
mod render;
mod shared_memory;
mod storage;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use hil_net::interface::interface_with_address;
use hil_net::timestamping::TimestampCapabilities;
use serde::{Deserialize, Serialize};

use self::finding::{Answer, settled};
pub use self::finding::{Finding, Severity};
use self::latency::LatencyReport;
use self::network::StampQuery;
pub use self::obstacles::{Effect, Obstacle, Trouble, obstacles};
pub use self::plan::{LinkLoad, Peer, Pin, Plan, WantedInterface};
use hil_nic::nic_clock::probing::probe_nic;
use hil_platform::clock_discipline::HostDiscipline;
use hil_platform::domain_address::domain_base_candidates;
use hil_platform::host_facts::{HostFacts, HostFiles};
use hil_platform::realtime::allowed_cpus;
use hil_shm::ForeignNodes;

/// What to examine.
#[derive(Debug, Clone)]
pub struct DoctorRequest {
    /// What a topology has this host do; `None` when none was given.
    pub plan: Option<Plan>,
    /// What this host gives too little of for the plan, in words; `None` when no plan was given.
    pub shortfalls: Option<Vec<String>>,
    /// Another host's report, with its name, to compare clocks with.
    pub other: Option<(String, Box<DoctorReport>)>,
    /// Folders for sockets and service files, in the order the runtime tries them.
    pub runtime_folders: Vec<PathBuf>,
    /// The kernel's text files.
    pub files: HostFiles,
}

impl Default for DoctorRequest {
    fn default() -> Self {
        Self {
            plan: None,
            shortfalls: None,
            other: None,
            runtime_folders: domain_base_candidates(),
            files: HostFiles::of_this_host(),
        }
    }
}

/// The facts of a host and what they mean for a measurement. `docs/doctor.md` describes its JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DoctorReport {
    /// [`DoctorReport::SCHEMA`].
    pub schema: String,
    /// The host described.
    pub host: HostFacts,
    /// How many findings there are of each severity, by its word.
    pub counts: BTreeMap<String, usize>,
    /// What was found, grouped by subject.
    pub findings: Vec<Finding>,
    /// How the time of day is kept; `None` when the kernel does not say.
    pub clock: Option<HostDiscipline>,
    /// The lateness of wake-ups; `None` before it is measured.
    pub latency: Option<LatencyReport>,
}

impl DoctorReport {
    /// The form of the JSON. It changes when a field goes or changes its meaning.
    pub const SCHEMA: &'static str = "hil-doctor/1";

    /// A report of these findings alone.
    fn of(findings: Vec<Finding>) -> Self {
        let mut report = Self {
            schema: Self::SCHEMA.to_owned(),
            host: HostFacts::default(),
            counts: BTreeMap::new(),
            findings,
            clock: None,
            latency: None,
        };
        report.recount();
        report
    }

    fn recount(&mut self) {
        let count = |severity: Severity| (severity.word().to_owned(), self.count(severity));
        self.counts = Severity::ALL.map(count).into();
    }

    fn count(&self, severity: Severity) -> usize {
        self.of_severity(severity).count()
    }

    fn of_severity(&self, severity: Severity) -> impl Iterator<Item = &Finding> {
        let all = self.findings.iter();
        all.filter(move |one| one.severity == severity)
    }

    /// Takes a measurement in, with its finding.
    pub fn add_latency(&mut self, measured: LatencyReport) {
        self.findings.push(settled(latency::judge(&measured)));
        self.latency = Some(measured);
        self.recount();
    }

    /// The worst severity among the findings. A strict caller takes [`Severity::Warning`] and worse
    /// for a host that is not fit.
    pub fn worst_severity(&self) -> Severity {
        let severities = self.findings.iter().map(|finding| finding.severity);
        severities.max().unwrap_or(Severity::Ok)
    }

    /// The report as indented JSON.
    ///
    /// # Panics
    /// Never: the report holds strings, numbers and lists only.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("strings, numbers and lists always serialise")
    }

    /// Reads another host's report.
    ///
    /// # Errors
    /// When the text is no report of this form.
    pub fn from_json(text: &str) -> Result<Self, String> {
        let read: Self = serde_json::from_str(text).map_err(|error| error.to_string())?;
        if read.schema != Self::SCHEMA {
            let (found, known) = (read.schema, Self::SCHEMA);
            return Err(format!(
                "its schema is `{found}`, this program reads `{known}`"
            ));
        }
        Ok(read)
    }
}

/// Examines this host; takes a fraction of a second. It measures no latency, see [`latency::measure`].
///
/// A network card with a clock of its own is asked for stamps, sent a few datagrams through and put
/// back as it was; that takes another half second for each.
pub fn examine(request: &DoctorRequest) -> DoctorReport {
    let stamps: StampQuery<'_> =
        &|interface| TimestampCapabilities::query(interface).map_err(|error| error.to_string());
    let files = &request.files;
    let plan = &request.plan.clone().unwrap_or_default().with_own_names();
    let fifo = privileges::try_fifo();
    let mut findings = kernel::examine(files, plan, fifo.as_ref());
    let allowed = allowed_cpus().map_err(|errno| format!("sched_setaffinity: {}", errno.desc()));
    findings.push(settled(processors::pinned(plan, allowed)));
    findings.extend(processors::examine(files, plan));
    findings.extend(privileges::examine(files, fifo.as_ref()));
    let present = match network::interfaces().told("interface") {
        Ok(present) => present,
        Err(unknown) => {
            findings.push(unknown.of("any"));
            network::Interfaces::new()
        }
    };
    let names = network::wanted(&present, plan);
    findings.extend(network::examine(files, &present, &names, stamps));
    findings.extend(obstacles::without_carrier(&present, plan));
    findings.extend(nic::examine(&present, &names, stamps, &probe_nic));
    findings.extend(radio::examine(&names));
    findings.extend(interrupts::examine(files, &names, plan));
    let mut line = driver::open();
    for name in names.iter().filter(|name| network::has_device(files, name)) {
        findings.extend(driver::examine(name, &mut line));
    }
    let source = &paths::source_towards;
    findings.extend(paths::examine(files, &present, plan, source));
    findings.extend(ports::examine(files, &plan.ports));
    let firewall = firewall::examine(files, firewall::chains(), &plan.ports);
    findings.push(settled(firewall));
    if request.plan.is_some() {
        let interface_of = |address| {
            interface_with_address(address).map_err(|error| format!("getifaddrs: {error}"))
        };
        let end = plan.clock_end.as_ref();
        findings.push(settled(clock_path::examine(end, &interface_of, stamps)));
    }
    let discipline = HostDiscipline::gather();
    let other = request.other.as_ref();
    let other = other.map(|(name, report)| (name.as_str(), report.clock.as_ref()));
    findings.extend(clocks::examine(&discipline, other));
    let folders = &request.runtime_folders;
    findings.extend(shared_memory::examine(files, folders, ForeignNodes::list()));
    let usable = shared_memory::first_usable(folders).map(|index| folders[index].as_path());
    let runtime_folder = usable.unwrap_or(Path::new("/run/hil"));
    let record_folder = if plan.record_folder.as_os_str().is_empty() {
        Path::new("runs")
    } else {
        &plan.record_folder
    };
    let shortfalls = request.shortfalls.as_deref();
    findings.extend(shortfalls.map(shared_memory::run_limits));
    findings.extend(storage::examine(files, record_folder, runtime_folder));
    DoctorReport {
        host: HostFacts::gather_from(files),
        clock: discipline.ok(),
        ..DoctorReport::of(findings)
    }
}

#[cfg(test)]
#[path = "mod_tests.rs"]
mod tests;
