//! Whether runs may be compared: what they have in common and where they differ beside their figures.

use core::fmt;
use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;

use super::{ComparedRun, Measurements};
use crate::answer::Answer;
use crate::assessment::Assessment;
use crate::summary::{LinkKind, Outcome, RunSummary};
use hil_platform::host_facts::Fact;
use hil_platform::words::counted;
use serde_json::Value;

/// In what runs differ beside their figures.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Difference {
    #[serde(flatten)]
    pub(crate) what: Differing,
    /// Of the base; several values are told one after the other.
    pub(crate) base: String,
    /// Of the new runs.
    pub(crate) new: String,
    /// Those that follow from it: a link of another kind has other keys.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) following: Vec<Difference>,
}

/// What differs.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(tag = "of", content = "what", rename_all = "snake_case")]
pub(crate) enum Differing {
    /// A key of the topologies, with dots.
    Key(String),
    /// The topologies, of which not every folder has the keys.
    Topology,
    /// The seeds of the runs.
    Seed,
    /// The kinds of links that their channels crossed, which follow from the topologies.
    Links,
    /// Another fact of a run or a host.
    Fact(&'static str),
}

impl fmt::Display for Differing {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Key(key) => write!(formatter, "topology {key}"),
            Self::Topology => formatter.write_str("topology (not every folder has its keys)"),
            Self::Seed => formatter.write_str("seed"),
            Self::Links => formatter.write_str("links"),
            Self::Fact(what) => formatter.write_str(what),
        }
    }
}

impl fmt::Display for Difference {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            what, base, new, ..
        } = self;
        write!(formatter, "{what}: base {base}, new {new}")?;
        match self.following.len() as u64 {
            0 => Ok(()),
            count => write!(formatter, ", and {} with it", counted(count, "key")),
        }
    }
}

impl Difference {
    fn new(what: Differing, base: String, new: String) -> Self {
        Self {
            what,
            base,
            new,
            following: Vec::new(),
        }
    }
}

/// Facts of a host that change what it can measure, and their words.
const HOST_FACTS: [(&str, &str); 4] = [
    ("kernel", "kernel"),
    ("cpu_model", "cpu model"),
    ("governor", "governor"),
    ("virtual_machine", "virtual machine"),
];

/// What both sides share, and what they do not.
pub(super) fn of(base: &[ComparedRun], new: &[ComparedRun]) -> (Vec<String>, Vec<Difference>) {
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
        differences.push(Difference::new(Differing::Seed, b, n));
    }
    let mut check = |what: Differing, of: &dyn Fn(&RunSummary) -> String| {
        let (b, n) = (values(base, of), values(new, of));
        if b == n && b.len() == 1 {
            same.push(format!("{what} {}", joined(&b)));
        } else {
            differences.push(Difference::new(what, joined(&b), joined(&n)));
        }
    };
    check(Differing::Fact("case"), &|one| one.run.case.clone());
    check(Differing::Fact("hosts"), &|one| {
        let hosts: BTreeSet<&str> = one.processes.iter().map(|it| it.host.as_str()).collect();
        hosts.into_iter().collect::<Vec<_>>().join(" and ")
    });
    check(Differing::Fact("length"), &|one| {
        format!("{:.0} s", one.run.duration_s)
    });
    check(Differing::Links, &links);
    for (label, words) in HOST_FACTS {
        let mut runs = base.iter().chain(new);
        if runs.any(|run| run.summary.host_facts.find(label).is_some()) {
            check(Differing::Fact(words), &|one| {
                let found = one.host_facts.find(label);
                found.map_or_else(|| "unavailable".to_owned(), Fact::to_text)
            });
        }
    }
    (same, differences)
}

/// The same for the topologies.
fn topology(base: &[ComparedRun], new: &[ComparedRun]) -> (Vec<String>, Vec<Difference>) {
    let [b, n] = [base, new].map(|runs| values(runs, &|one| one.run.topology_hash.clone()));
    if b == n && b.len() == 1 {
        return (vec![format!("topology {}", joined(&b))], Vec::new());
    }
    if base.iter().chain(new).any(|run| run.topology.is_null()) {
        let one = Difference::new(Differing::Topology, joined(&b), joined(&n));
        return (Vec::new(), vec![one]);
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
            let what = Differing::Key(key.clone());
            differences.push(Difference::new(what, joined(&b), joined(&n)));
        }
    }
    if differences.is_empty() {
        let same = "topology but for seed, length and ports".to_owned();
        return (vec![same], differences);
    }
    (Vec::new(), folded(differences))
}

/// With all keys of a link whose kind differs below its kind.
fn folded(differences: Vec<Difference>) -> Vec<Difference> {
    let link_of = |one: &Difference| match &one.what {
        Differing::Key(key) => {
            let name = key.strip_prefix("links.")?.split('.').next()?;
            let is_kind = key.rsplit('.').next() == Some("via");
            Some((name.to_owned(), is_kind))
        }
        _ => None,
    };
    let kinds = differences.iter().filter_map(link_of);
    let kinds: BTreeSet<String> = kinds
        .filter_map(|(name, is_kind)| is_kind.then_some(name))
        .collect();
    let mut found: Vec<Difference> = Vec::new();
    let mut following: BTreeMap<String, Vec<Difference>> = BTreeMap::new();
    for one in differences {
        match link_of(&one) {
            Some((name, false)) if kinds.contains(&name) => {
                following.entry(name).or_default().push(one);
            }
            _ => found.push(one),
        }
    }
    for one in &mut found {
        if let Some((name, true)) = link_of(one) {
            one.following = following.remove(&name).unwrap_or_default();
        }
    }
    found
}

/// Every value in `value` by its path; a list is one.
pub(crate) fn add_leaves(leaves: &mut BTreeMap<String, String>, path: &str, value: &Value) {
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

    fn words(differences: &[Difference]) -> Vec<String> {
        differences.iter().map(Difference::to_string).collect()
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
        assert_eq!(words(&differences), expected);
        let (same, differences) = of(&[link(1, 7_400, "5 ms")], &[link(2, 7_402, "5 ms")]);
        assert!(same[0].starts_with("topology but for"), "{same:?}");
        assert_eq!(differences.len(), 1, "{differences:?}");
        // Repetitions of the same seeds, of which one met another link.
        let [one, two, other] =
            [(1, "5 ms"), (2, "5 ms"), (2, "9 ms")].map(|(seed, delay)| link(seed, 7_400, delay));
        let (same, differences) = of(&[one.clone(), two.clone()], &[two.clone(), one.clone()]);
        assert!(same.iter().any(|one| one == "seed 1 and 2"), "{same:?}");
        assert_eq!(differences, []);
        let (_, differences) = of(&[one.clone(), two.clone()], &[one.clone(), one.clone()]);
        assert_eq!(words(&differences), ["seed: base 1 and 2, new 1 and 1"]);
        let sides = [one, other];
        let (_, differences) = of(&sides, &sides);
        let expected = "topology links.hop.delay: base 5 ms or 9 ms, new 5 ms or 9 ms";
        assert_eq!(words(&differences), [expected]);
        // A key of one side only, and a folder without a manifest.
        let (_, differences) = of(&[run(1, json!({}))], &[run(1, json!({ "name": "x" }))]);
        assert_eq!(words(&differences), ["topology name: base none, new x"]);
        let (_, differences) = of(&[run(1, Value::Null)], &[run(1, json!({ "name": "x" }))]);
        assert_eq!(differences[0].what, Differing::Topology);
    }

    #[test]
    fn the_keys_of_a_link_of_another_kind_follow_from_its_kind() {
        let with = |hop: Value| {
            let other = json!({ "via": "tcp", "rate": hop["rate"] });
            run(1, json!({ "links": { "hop": hop, "other": other } }))
        };
        let real = with(json!({ "via": "udp", "dscp": 46 }));
        let emulated =
            with(json!({ "via": "emulated", "forward": { "delay": "5 ms" }, "rate": "1 kbit/s" }));
        let (_, differences) = of(&[real], &[emulated]);
        let expected = [
            "topology links.hop.via: base udp, new emulated, and 3 keys with it",
            "topology links.other.rate: base null, new 1 kbit/s",
        ];
        assert_eq!(words(&differences), expected);
        let following = [
            "topology links.hop.dscp: base 46, new none",
            "topology links.hop.forward.delay: base none, new 5 ms",
            "topology links.hop.rate: base none, new 1 kbit/s",
        ];
        assert_eq!(words(&differences[0].following), following);
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
