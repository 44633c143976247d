//! `hil-runtime doctor`: what this host can measure, what stands in the way, and the cure for
//! each. It examines and reports; it changes nothing that outlives it, prints nothing and knows
//! no exit codes: the caller turns [`DoctorReport::worst_state`] into one.
//!
//! One file per subject: clocks, processors, privileges, wake-ups, shared memory and
//! network; each is a function from the kernel's files to findings.

mod card;
mod clock_path;
mod clocks;
mod finding;
mod network;
mod privileges;
mod processors;
mod radio;
mod render;
mod shared_memory;
mod wakeup;

use std::path::PathBuf;
use std::time::Duration;

use hil_gateways::transport::interface::interface_with_address;
use serde::{Deserialize, Serialize};

pub use self::finding::{Finding, State};
pub use self::network::{StampCapabilities, StampCapabilityQuery};
pub use self::wakeup::WakeupMeasurement;
use crate::card_clock::probing::probe_card;
use crate::host_facts::{HostFacts, HostFiles};
use crate::topology::ClockEnd;

/// Which end of a clock path to look at.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ClockQuestion {
    /// No topology was given.
    NotAsked,
    /// The topology has this host, and no clock address of it.
    NoneNamed,
    /// This one.
    End(ClockEnd),
}

/// What to examine.
#[derive(Debug, Clone)]
pub struct DoctorRequest {
    /// CPUs a topology pins threads to; empty when none is known.
    pub pinned_cpus: Vec<usize>,
    /// Network interfaces a topology uses; empty for all of this host.
    pub interfaces: Vec<String>,
    /// Where a topology has this host exchange clocks.
    pub clock_end: ClockQuestion,
    /// How long the wake-up latency is measured.
    pub wakeup_duration: Duration,
    /// Folders for sockets and service files, in the order the runtime tries them.
    pub runtime_folders: Vec<PathBuf>,
    /// The kernel's text files.
    pub files: HostFiles,
}

impl Default for DoctorRequest {
    fn default() -> Self {
        Self {
            pinned_cpus: Vec::new(),
            interfaces: Vec::new(),
            clock_end: ClockQuestion::NotAsked,
            wakeup_duration: Duration::from_secs(1),
            runtime_folders: vec![PathBuf::from("/run/hil"), std::env::temp_dir()],
            files: HostFiles::of_this_host(),
        }
    }
}

/// The facts of a host and what they mean for a measurement.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DoctorReport {
    /// The host described.
    pub host: HostFacts,
    /// What was found, grouped by subject.
    pub findings: Vec<Finding>,
    /// The wake-up latency in numbers; `None` when none could be measured.
    pub wakeup: Option<WakeupMeasurement>,
}

impl DoctorReport {
    /// The worst state among the findings. A strict caller treats [`State::Problem`] as a host
    /// that is not fit.
    pub fn worst_state(&self) -> State {
        self.findings
            .iter()
            .map(|finding| finding.state)
            .max()
            .unwrap_or(State::Good)
    }

    /// The finding with this identifier.
    pub fn find(&self, id: &str) -> Option<&Finding> {
        self.findings.iter().find(|finding| finding.id == id)
    }

    /// The report as indented JSON.
    ///
    /// # Panics
    /// Never: the report holds strings and lists only.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("strings and lists always serialise")
    }
}

/// Examines this host. Takes [`DoctorRequest::wakeup_duration`] and a fraction of a second.
///
/// A network card with a clock of its own is asked for stamps, sent a few datagrams through and put
/// back as it was; that takes another half second for each.
///
/// `stamps` answers which timestamps an interface claims; the gateways own that system call.
pub fn examine(request: &DoctorRequest, stamps: &dyn StampCapabilityQuery) -> DoctorReport {
    let files = &request.files;
    let mut findings = Vec::new();
    findings.extend(network::examine(files, &request.interfaces, stamps));
    findings.extend(card::examine(&request.interfaces, stamps, &probe_card));
    findings.extend(radio::examine(&request.interfaces));
    let end = &request.clock_end;
    let interface_of =
        |address| interface_with_address(address).map_err(|error| format!("getifaddrs: {error}"));
    findings.extend(clock_path::examine(end, &interface_of, stamps));
    findings.extend(clocks::examine(files));
    findings.extend(processors::examine(files, &request.pinned_cpus));
    findings.extend(privileges::examine(files));
    let cpu = request.pinned_cpus.first().copied();
    let measured = wakeup::measure(request.wakeup_duration, cpu);
    findings.push(wakeup::judge(measured.as_ref(), files));
    findings.extend(shared_memory::examine(files, &request.runtime_folders));
    DoctorReport {
        host: HostFacts::gather_from(files),
        findings,
        wakeup: measured,
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    fn examined() -> DoctorReport {
        let request = DoctorRequest {
            wakeup_duration: Duration::from_millis(20),
            ..Default::default()
        };
        examine(&request, &|_: &str| Err("no query in this test".to_owned()))
    }

    #[test]
    fn every_finding_has_its_own_name_and_every_complaint_a_cure() {
        let report = examined();
        let names: BTreeSet<&str> = report.findings.iter().map(|f| f.id.as_str()).collect();
        assert_eq!(names.len(), report.findings.len());
        for finding in &report.findings {
            assert!(
                !finding.title.is_empty() && !finding.value.is_empty(),
                "{finding:?}"
            );
            if finding.state != State::Good {
                assert!(
                    !finding.why.is_empty() && !finding.fix.is_empty(),
                    "{finding:?}"
                );
            }
        }
    }

    #[test]
    fn the_whole_list_is_covered() {
        let report = examined();
        for id in [
            "udp_buffers",
            "clocksource",
            "clock_synchronisation",
            "clock_read_cost",
            "preemption",
            "isolated_cpus",
            "nohz_full",
            "governor",
            "idle_states",
            "smt",
            "irqbalance",
            "transparent_huge_pages",
            "realtime_throttle",
            "fifo",
            "memory_lock",
            "probe_tap",
            "wakeup_latency",
            "shared_memory",
            "shared_memory_leftovers",
            "runtime_folder",
            "remove_ipc",
        ] {
            assert!(report.find(id).is_some(), "no finding `{id}`");
        }
    }

    #[test]
    fn the_worst_finding_decides() {
        let mut report = DoctorReport {
            host: HostFacts::default(),
            findings: Vec::new(),
            wakeup: None,
        };
        assert_eq!(report.worst_state(), State::Good);
        report
            .findings
            .push(Finding::note("a", "a", "a").because("b").fixed_by("c"));
        report.findings.push(Finding::good("b", "b", "b"));
        assert_eq!(report.worst_state(), State::Note);
        report
            .findings
            .push(Finding::problem("c", "c", "c").because("b").fixed_by("c"));
        assert_eq!(report.worst_state(), State::Problem);
    }

    #[test]
    fn the_report_survives_json() {
        let report = examined();
        let read: DoctorReport = serde_json::from_str(&report.to_json()).unwrap();
        assert_eq!(read, report);
    }
}
