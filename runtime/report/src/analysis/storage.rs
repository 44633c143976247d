//! What disks did not take of a run, in words: each host's cause once, however much followed from it.

use std::collections::{BTreeMap, BTreeSet};

use hil_platform::words::named;
use hil_rundir::file_fault::{FileFault, GapCause, RecordGap};
use hil_rundir::run_result::{Outcome, RunResult};

/// Files of one cause that are named; the others are counted.
const NAMED_COUNT: usize = 3;

/// The causes that a reader has been told, by host.
#[derive(Default)]
struct Told(BTreeSet<(String, String)>);

impl Told {
    /// `words` about `host` with `cause`, which says `error` and where, if that is new.
    fn sentence(&mut self, host: &str, error: &str, words: &str, cause: &str) -> String {
        if self.0.insert((host.to_owned(), error.to_owned())) {
            format!("{words}: {cause}")
        } else {
            format!("{words}, for the reason told before")
        }
    }
}

/// What a reader must know of what could not be written in the run of `result`, and below its folder
/// afterwards, which are the files `unwritten`.
pub(super) fn warnings(result: &RunResult, unwritten: &[FileFault]) -> Vec<String> {
    let mut told = Told::default();
    if let Outcome::Unwritable { host, fault } = &result.outcome {
        told.0.insert((host.clone(), fault.error.clone()));
    }
    let mut found = Vec::new();
    for (host, faults) in unrecorded(result) {
        let files = names(faults.iter().copied());
        let words = format!("records of {host} end early in {files}");
        let (error, cause) = (&faults[0].error, faults[0].to_string());
        found.push(told.sentence(host, error, &words, &cause));
    }
    let gaps = result.gaps.iter().filter(|gap| !is_told(gap, result));
    found.extend(gaps.map(|gap| gap_warning(gap, &mut told)));
    if let (Some(first), Some(host)) = (unwritten.first(), result.own_hosts.first()) {
        let words = format!("the report lacks {}", names(unwritten));
        found.push(told.sentence(host, &first.error, &words, &first.to_string()));
    }
    found
}

/// What hosts lack of their own records. All hosts know it, so that all say the same of the run.
pub(super) fn own_gaps(result: &RunResult) -> impl Iterator<Item = RecordGap> {
    unrecorded(result)
        .into_iter()
        .map(|(host, faults)| RecordGap {
            host: host.to_owned(),
            of: vec![host.to_owned()],
            cause: GapCause::Unwritable(faults[0].clone()),
        })
}

/// The record files that processes could not write any more, by host.
fn unrecorded(result: &RunResult) -> BTreeMap<&str, Vec<&FileFault>> {
    let mut by_host: BTreeMap<&str, Vec<&FileFault>> = BTreeMap::new();
    for process in &result.processes {
        let failures = process.report.iter().flat_map(|one| &one.recorder_failures);
        for fault in failures {
            by_host.entry(&process.host).or_default().push(fault);
        }
    }
    by_host
}

/// Whether the end of the run tells of `gap`: a host that cannot write anything does not stay.
fn is_told(gap: &RecordGap, result: &RunResult) -> bool {
    match (&result.outcome, &gap.cause) {
        (Outcome::Unwritable { host, .. }, GapCause::Connection(_)) => {
            gap.host == *host || gap.of.contains(host)
        }
        _ => false,
    }
}

fn gap_warning(gap: &RecordGap, told: &mut Told) -> String {
    let (host, of) = (&gap.host, gap.of.join(", "));
    match &gap.cause {
        GapCause::Unwritable(fault) => {
            let words = format!("{host} could not keep the records of {of}");
            told.sentence(host, &fault.error, &words, &fault.to_string())
        }
        GapCause::Connection(reason) => {
            format!("the records of {of} did not come to {host}: {reason}")
        }
    }
}

fn names<'a>(faults: impl IntoIterator<Item = &'a FileFault>) -> String {
    let names: Vec<String> = faults.into_iter().map(FileFault::file_name).collect();
    named(&names, NAMED_COUNT)
}
