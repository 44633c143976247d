//! Whether runs may be compared: what they have in common and where they differ beside their figures.

use std::collections::{BTreeMap, BTreeSet};

use super::{ComparedRun, Measurements};
use crate::answer::Answer;
use crate::assessment::Assessment;
use crate::summary::{LinkKind, Outcome, RunSummary};
use hil_platform::host_facts::Fact;
use hil_platform::words::counted;
use serde_json::Value;

/// Keys of topologies that are named; all are in `manifest.json`.
const KEYS_SHOWN: usize = 12;

/// Facts of a host that change what it can measure, and their words.
const HOST_FACTS: [(&str, &str); 4] = [
    ("kernel", "kernel"),
    ("cpu_model", "cpu model"),
    ("governor", "governor"),
    ("virtual_machine", "virtual machine"),
];

/// What both sides share, and what they do not.
pub(super) fn of(base: &[ComparedRun], new: &[ComparedRun]) -> (Vec<String>, Vec<String>) {
    let (mut same, mut differences) = topology(base, new);
    // Repetitions have a seed each: the same on both sides make no difference.
    let [b, n] = [base, new].map(|runs| {
        let mut seeds: Vec<u64> = runs.iter().map(|run| run.summary.run.seed).collect();
        seeds.sort_unstable();
        let words = seeds.iter().map(u64::to_string);
        words.collect::<Vec<_>>().join(" and ")
    });
    if b == n {
        same.push(format!("seed {b}"));
    } else {
        differences.push(format!("seed: base {b}, new {n}"));
    }
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

/// The same for the topologies.
fn topology(base: &[ComparedRun], new: &[ComparedRun]) -> (Vec<String>, Vec<String>) {
    let [b, n] = [base, new].map(|runs| values(runs, &|one| one.run.topology_hash.clone()));
    if b == n && b.len() == 1 {
        return (vec![format!("topology {}", joined(&b))], Vec::new());
    }
    if base.iter().chain(new).any(|run| run.topology.is_null()) {
        let (b, n) = (joined(&b), joined(&n));
        let text = format!("topology, of which not every folder has the keys: base {b}, new {n}");
        return (Vec::new(), vec![text]);
    }
    let [base, new] = [base, new].map(|runs| {
        let all = runs.iter().map(|run| {
            let mut leaves = BTreeMap::new();
            add_leaves(&mut leaves, "", &run.topology);
            leaves
        });
        all.collect::<Vec<_>>()
    });
    let keys: BTreeSet<&String> = base.iter().chain(&new).flat_map(BTreeMap::keys).collect();
    let mut differences = Vec::new();
    for key in keys.into_iter().filter(|key| !is_told_elsewhere(key)) {
        let [b, n] = [&base, &new].map(|all| {
            let values = all.iter().map(|one| one.get(key).cloned());
            values
                .map(Option::unwrap_or_default)
                .collect::<BTreeSet<_>>()
        });
        if b != n || b.len() > 1 {
            let (b, n) = (joined(&b), joined(&n));
            differences.push(format!("topology {key}: base {b}, new {n}"));
        }
    }
    if differences.is_empty() {
        let same = "topology but for seed, length and ports".to_owned();
        return (vec![same], differences);
    }
    let hidden = differences.len().saturating_sub(KEYS_SHOWN);
    differences.truncate(KEYS_SHOWN);
    if hidden > 0 {
        let hidden = counted(hidden as u64, "more key");
        differences.push(format!("{hidden} of the topology: see manifest.json"));
    }
    (Vec::new(), differences)
}

/// Every value in `value` by its path; a list is one.
fn add_leaves(leaves: &mut BTreeMap<String, String>, path: &str, value: &Value) {
    match value {
        Value::Object(table) => {
            for (key, value) in table {
                let path = match path {
                    "" => key.clone(),
                    _ => format!("{path}.{key}"),
                };
                add_leaves(leaves, &path, value);
            }
        }
        Value::String(text) => {
            leaves.insert(path.to_owned(), text.clone());
        }
        other => {
            leaves.insert(path.to_owned(), other.to_string());
        }
    }
}

/// Seed and length stand beside the topology. A port and a folder change nothing of what is measured; joined programs take
/// a port that is free.
fn is_told_elsewhere(key: &str) -> bool {
    matches!(key, "run.seed" | "run.duration" | "run.record")
        || key.starts_with("links.") && key.rsplit('.').next() == Some("port")
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
    found.extend(shared_seeds(base.iter().chain(new)));
    if base.len() == 1 || new.len() == 1 {
        found.push(
            "one run on a side: its intervals know how messages differ, not how runs do; repeat \
             runs and give them with --base and --new"
                .to_owned(),
        );
    }
    found
}

/// Runs of one seed over an emulated link meet the same draws.
fn shared_seeds<'a>(runs: impl Iterator<Item = &'a ComparedRun>) -> Vec<String> {
    let mut counts: BTreeMap<u64, u64> = BTreeMap::new();
    let is_emulated = |run: &&ComparedRun| {
        let mut channels = run.summary.channels.iter();
        channels.any(|one| one.link == LinkKind::Emulated)
    };
    for run in runs.filter(is_emulated) {
        *counts.entry(run.summary.run.seed).or_default() += 1;
    }
    let shared = counts.into_iter().filter(|(_, count)| *count > 1);
    let words = shared.map(|(seed, count)| {
        format!(
            "{} have seed {seed} of an emulated link, which draws the same for each: they are no independent \
             sample, and the intervals take them for one; give each run a seed of its own",
            counted(count, "run")
        )
    });
    words.collect()
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

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use serde_json::json;

    use super::*;
    use crate::tests::sample;

    fn run(seed: u64, topology: Value) -> ComparedRun {
        let mut summary = sample::full();
        summary.run.seed = seed;
        summary.run.topology_hash = topology.to_string();
        ComparedRun {
            folder: PathBuf::from("run"),
            summary,
            topology,
        }
    }

    fn link(seed: u64, port: u16, delay: &str) -> ComparedRun {
        let link = json!({ "port": port, "delay": delay, "between": ["a", "b"] });
        run(
            seed,
            json!({ "run": { "seed": seed }, "links": { "hop": link } }),
        )
    }

    #[test]
    fn topologies_differ_by_their_keys_with_both_values() {
        let (same, differences) = of(&[link(1, 7_400, "5 ms")], &[link(2, 7_402, "9 ms")]);
        assert!(!same.iter().any(|one| one.contains("topology")), "{same:?}");
        let expected = [
            "topology links.hop.delay: base 5 ms, new 9 ms",
            "seed: base 1, new 2",
        ];
        assert_eq!(differences, expected);
        let (same, differences) = of(&[link(1, 7_400, "5 ms")], &[link(2, 7_402, "5 ms")]);
        assert!(same[0].starts_with("topology but for"), "{same:?}");
        assert_eq!(differences.len(), 1, "{differences:?}");
        // Repetitions of the same seeds, of which one met another link.
        let [one, two, other] =
            [(1, "5 ms"), (2, "5 ms"), (2, "9 ms")].map(|(seed, delay)| link(seed, 7_400, delay));
        let (same, differences) = of(&[one.clone(), two.clone()], &[two.clone(), one.clone()]);
        assert!(same.iter().any(|one| one == "seed 1 and 2"), "{same:?}");
        assert_eq!(differences, [""; 0]);
        let (_, differences) = of(&[one.clone(), two.clone()], &[one.clone(), one.clone()]);
        assert_eq!(differences, ["seed: base 1 and 2, new 1 and 1"]);
        let sides = [one, other];
        let (_, differences) = of(&sides, &sides);
        let expected = "topology links.hop.delay: base 5 ms or 9 ms, new 5 ms or 9 ms";
        assert_eq!(differences, [expected]);
        // A key of one side only, and a folder without a manifest.
        let (_, differences) = of(&[run(1, json!({}))], &[run(1, json!({ "name": "x" }))]);
        assert_eq!(differences, ["topology name: base none, new x"]);
        let (_, differences) = of(&[run(1, Value::Null)], &[run(1, json!({ "name": "x" }))]);
        assert!(
            differences[0].contains("not every folder"),
            "{differences:?}"
        );
        let many = |word: &str| {
            let keys = (0..20).map(|index| (format!("k{index}"), json!(word)));
            run(1, Value::Object(keys.collect()))
        };
        let (_, differences) = of(&[many("a")], &[many("b")]);
        assert_eq!(differences.len(), KEYS_SHOWN + 1);
        assert!(
            differences[KEYS_SHOWN].starts_with("8 more keys"),
            "{differences:?}"
        );
    }

    #[test]
    fn runs_of_one_seed_over_an_emulated_link_are_called_no_independent_sample() {
        let emulated = |seed| {
            let mut run = run(seed, Value::Null);
            run.summary.channels[0].link = LinkKind::Emulated;
            run
        };
        let is_told = |base: &[ComparedRun], new: &[ComparedRun]| {
            let words = "2 runs have seed 7 of an emulated link";
            cautions(base, new).iter().any(|one| one.contains(words))
        };
        assert!(is_told(&[emulated(7), emulated(7)], &[emulated(8)]));
        assert!(is_told(&[emulated(7)], &[emulated(7)]));
        assert!(!is_told(&[emulated(7)], &[emulated(8)]));
        // A network draws nothing.
        assert!(!is_told(&[run(7, Value::Null)], &[run(7, Value::Null)]));
    }
}
