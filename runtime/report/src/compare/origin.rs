//! Whether runs may be compared: what they have in common and where they differ beside their figures.

use std::collections::BTreeSet;

use super::{ComparedRun, Measurements};
use crate::answer::Answer;
use crate::assessment::Assessment;
use crate::summary::{Outcome, RunSummary};
use hil_platform::host_facts::Fact;

/// Facts of a host that change what it can measure, and their words.
const HOST_FACTS: [(&str, &str); 4] = [
    ("kernel", "kernel"),
    ("cpu_model", "cpu model"),
    ("governor", "governor"),
    ("virtual_machine", "virtual machine"),
];

/// What both sides share, and what they do not.
pub(super) fn of(base: &[ComparedRun], new: &[ComparedRun]) -> (Vec<String>, Vec<String>) {
    let (mut same, mut differences) = (Vec::new(), Vec::new());
    let mut check = |what: &str, of: &dyn Fn(&RunSummary) -> String| {
        let (b, n) = (values(base, of), values(new, of));
        if b == n && b.len() == 1 {
            same.push(format!("{what} {}", joined(&b)));
        } else {
            let (b, n) = (joined(&b), joined(&n));
            differences.push(format!("{what}: base {b}, new {n}"));
        }
    };
    check("case", &|one| one.run.case.clone());
    check("topology", &|one| one.run.topology_hash.clone());
    check("seed", &|one| one.run.seed.to_string());
    check("hosts", &|one| {
        let hosts: BTreeSet<&str> = one.processes.iter().map(|it| it.host.as_str()).collect();
        hosts.into_iter().collect::<Vec<_>>().join(" and ")
    });
    check("length", &|one| format!("{:.0} s", one.run.duration_s));
    check("links", &links);
    for (label, words) in HOST_FACTS {
        let mut runs = base.iter().chain(new);
        if runs.any(|run| run.summary.host_facts.find(label).is_some()) {
            check(words, &|one| {
                let found = one.host_facts.find(label);
                found.map_or_else(|| "unavailable".to_owned(), Fact::to_text)
            });
        }
    }
    (same, differences)
}

fn values(runs: &[ComparedRun], of: &dyn Fn(&RunSummary) -> String) -> BTreeSet<String> {
    runs.iter().map(|run| of(&run.summary)).collect()
}

fn joined(values: &BTreeSet<String>) -> String {
    let words = values.iter().map(|value| match value.as_str() {
        "" => "none",
        value => value,
    });
    words.collect::<Vec<_>>().join(" or ")
}

fn links(summary: &RunSummary) -> String {
    let kinds: BTreeSet<&str> = summary
        .channels
        .iter()
        .map(|one| one.link.label())
        .collect();
    kinds.into_iter().collect::<Vec<_>>().join(", ")
}

/// What changes what a run is about.
pub(super) fn cautions(base: &[ComparedRun], new: &[ComparedRun]) -> Vec<String> {
    let mut found = Vec::new();
    for run in base.iter().chain(new) {
        let (summary, name) = (&run.summary, run.folder.display());
        if summary.run.outcome != Outcome::Completed {
            let reason = &summary.run.exit_reason;
            found.push(format!("{name} did not run its length: {reason}"));
        }
        let changes = summary.link_changes.iter().filter(|one| one.is_in_force());
        let count = changes.count();
        if count > 0 {
            let times = if count == 1 { "once" } else { "more than once" };
            found.push(format!(
                "{name}: a link was changed by hand {times} while it went on"
            ));
        }
    }
    if base.len() == 1 || new.len() == 1 {
        found.push(
            "one run on a side: its intervals know how messages differ, not how runs do; repeat \
             runs and give them with --base and --new"
                .to_owned(),
        );
    }
    found
}

/// Whether the runs measured what they were to measure; those of which the same is to be said, together.
pub(super) fn measurements(base: &[ComparedRun], new: &[ComparedRun]) -> Vec<Measurements> {
    let mut found: Vec<Measurements> = Vec::new();
    for run in base.iter().chain(new) {
        let assessment = Assessment::of(&run.summary);
        let answer = Answer::of(&run.summary, &assessment);
        let (_, words) = answer.measurement_words(&assessment.network);
        match found.iter_mut().find(|one| one.words == words) {
            Some(known) => known.runs.push(run.folder.clone()),
            None => found.push(Measurements {
                runs: vec![run.folder.clone()],
                is_valid: answer.measurement.is_valid,
                words,
            }),
        }
    }
    found
}
