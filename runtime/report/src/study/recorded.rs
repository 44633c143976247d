//! Recorded runs for a case's tables: folders of the command line, read as `compare` reads them, with what speaks
//! against holding a run against the paper. It computes no figure and makes no row.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use hil_account::network::Metric;
use hil_core::recorded_run::{
    DelayBin, Doubt, LinkOrigin, PublishedNetwork, RecordedCrossing, RecordedLink, RecordedMetric,
    RecordedRun, SkippedTicks,
};
use serde_json::Value;

use crate::answer::{Answer, is_score_incomplete};
use crate::assessment::Assessment;
use crate::compare::ComparedRun;
use crate::link_change::LinkChange;
use crate::study::probed;
use crate::study::recording::trace_replay;
use crate::summary::{
    ChannelSummary, Fact, LinkKind, Outcome, ProcessSummary, RunSummary, ScoreMetric,
};

/// Runs of the command line: a folder, or those that a `*` in its last part stands for, and the published network
/// that they stand for.
#[derive(Debug, Clone, PartialEq)]
pub struct RunArgument {
    network: Option<PublishedNetwork>,
    row: Option<String>,
    folder: String,
    /// Its row allows so large a share of skipped ticks.
    skipped_ratio_max: f64,
}

impl FromStr for RunArgument {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        // A folder in another one may have any name.
        let labelled = text.split_once('=');
        let Some((label, folder)) = labelled.filter(|(label, _)| !label.contains('/')) else {
            return Ok(Self {
                network: None,
                row: None,
                folder: text.to_owned(),
                skipped_ratio_max: 0.0,
            });
        };
        let mut networks = PublishedNetwork::ALL.into_iter();
        let network = networks.find(|network| network.word() == label);
        if network.is_none() {
            let words = PublishedNetwork::ALL.map(PublishedNetwork::word).join(", ");
            return Err(format!(
                "label `{label}` is none of {words}; write ./{text} for a folder of that name"
            ));
        }
        Ok(Self {
            network,
            row: None,
            folder: folder.to_owned(),
            skipped_ratio_max: 0.0,
        })
    }
}

impl fmt::Display for RunArgument {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(network) = self.network {
            write!(formatter, "{}=", network.word())?;
        }
        formatter.write_str(&self.folder)
    }
}

impl RunArgument {
    /// The run in `folder` for the row called `name`, which stands for `network`.
    pub(super) fn of(name: &str, network: Option<PublishedNetwork>, folder: &Path) -> Self {
        Self {
            network,
            row: network.is_none().then(|| name.to_owned()),
            folder: folder.display().to_string(),
            skipped_ratio_max: 0.0,
        }
    }

    /// The same, of which this share of the ticks may have been skipped.
    pub(super) fn allow(self, skipped_ratio_max: f64) -> Self {
        Self {
            skipped_ratio_max,
            ..self
        }
    }

    /// The folders that it names, in the order of their names; a number at the end of a name counts by its value.
    fn folders(&self) -> Result<Vec<PathBuf>, String> {
        let path = Path::new(&self.folder);
        let pattern = path.file_name().and_then(|name| name.to_str());
        let Some(pattern) = pattern.filter(|name| name.contains('*') && !path.exists()) else {
            return Ok(vec![path.to_owned()]);
        };
        let parent = match path.parent() {
            Some(parent) if parent != Path::new("") => parent,
            _ => Path::new("."),
        };
        let entries = fs::read_dir(parent)
            .map_err(|error| format!("{}: {error}", parent.display()))?
            .filter_map(Result::ok);
        let is_meant = |name: &String| is_match(pattern, name);
        let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
        let mut folders: Vec<PathBuf> = names
            .filter(is_meant)
            .map(|name| path.with_file_name(name))
            .filter(|path| path.is_dir())
            .collect();
        folders.sort_by_cached_key(|path| {
            let name = path.display().to_string();
            let stem = name.trim_end_matches(|one: char| one.is_ascii_digit());
            let number = name[stem.len()..].parse::<u64>().ok();
            (stem.to_owned(), number, name)
        });
        if folders.is_empty() {
            return Err(format!("{}: no folder is called so", self.folder));
        }
        Ok(folders)
    }
}

/// Whether `name` is `pattern` with something, or nothing, for each `*`.
fn is_match(pattern: &str, name: &str) -> bool {
    let mut parts: Vec<&str> = pattern.split('*').collect();
    let first = parts.remove(0);
    let Some(mut rest) = name.strip_prefix(first) else {
        return false;
    };
    let Some(last) = parts.pop() else {
        return rest.is_empty();
    };
    for part in parts {
        match rest.find(part) {
            Some(at) => rest = &rest[at + part.len()..],
            None => return false,
        }
    }
    rest.ends_with(last)
}

/// Reads the runs for tables of `case`.
///
/// # Errors
/// Names the folder that is no finished run in real time of that case over a link, or of a run that is given already.
pub(super) fn read(
    arguments: &[RunArgument],
    case: &str,
) -> Result<Vec<RecordedRun<Value>>, String> {
    let mut runs: Vec<(ComparedRun, &RunArgument)> = Vec::new();
    for argument in arguments {
        for folder in argument.folders()? {
            let run = ComparedRun::read(&folder).map_err(|error| error.to_string())?;
            let is_same = |other: &&(ComparedRun, _)| is_same_run(&other.0, &run);
            if let Some((other, _)) = runs.iter().find(is_same) {
                return Err(format!(
                    "{}: it is of the same run as {}; give one folder of each run",
                    folder.display(),
                    other.folder.display()
                ));
            }
            runs.push((run, argument));
        }
    }
    let recorded = runs.into_iter().map(|(run, argument)| {
        let folder = run.folder.display().to_string();
        recorded(run, argument, case).map_err(|problem| format!("{folder}: {problem}"))
    });
    recorded.collect()
}

/// True of one folder named twice, and of the folders that two hosts wrote of one run.
fn is_same_run(one: &ComparedRun, other: &ComparedRun) -> bool {
    let place = |run: &ComparedRun| run.folder.canonicalize().ok();
    let [facts, others] = [one, other].map(|run| &run.summary.run);
    let mut starts = facts.starts_ns.iter();
    let is_place = place(one).is_some() && place(one) == place(other);
    let is_start = facts.topology_hash == others.topology_hash
        && starts.any(|(host, at_ns)| others.starts_ns.get(host) == Some(at_ns));
    is_place || is_start
}

/// The run as tables of `case` take it.
///
/// # Errors
/// Why it can be no row of them.
pub(super) fn recorded(
    run: ComparedRun,
    argument: &RunArgument,
    case: &str,
) -> Result<RecordedRun<Value>, String> {
    let ComparedRun {
        folder,
        summary,
        mut topology,
    } = run;
    let facts = &summary.run;
    if facts.case != case {
        let found = match facts.case.as_str() {
            "" => "no case",
            found => found,
        };
        return Err(format!("a run of {found}; the tables are of {case}"));
    }
    if facts.is_virtual {
        return Err("a run in virtual time; recorded rows are of runs in real time".to_owned());
    }
    if facts.outcome == Outcome::Failed {
        return Err(format!("the run failed: {}", facts.exit_reason));
    }
    let parameters = topology.pointer_mut("/case/parameters").map(Value::take);
    let parameters =
        parameters.ok_or("no manifest.json with case.parameters, which a table needs to know")?;
    let channels = summary.channels.iter();
    let crossing: Vec<_> = channels.filter(|one| one.link.is_crossing()).collect();
    if crossing.is_empty() {
        return Err("no channel went over a network, or a model of one".to_owned());
    }
    let replays = trace_replay::read(&folder)
        .map_err(|error| error.to_string())?
        .map(|scores| scores.iter().map(|score| by_name(score)).collect());
    let probed = probed::read(&folder).map_err(|error| format!("{}: {error}", probed::FILE))?;
    let skipped = skipped(&summary);
    Ok(RecordedRun {
        folder: folder.display().to_string(),
        name: match topology.get("name").and_then(Value::as_str) {
            Some(name) => name.to_owned(),
            None => facts.name.clone(),
        },
        network: argument.network,
        row: argument.row.clone(),
        link: link(&summary, &crossing),
        seed: facts.seed,
        parameters,
        skipped,
        crossing: crossing_of(&summary, &crossing),
        probed,
        score: by_name(&summary.score),
        replays,
        doubts: doubts(&summary, skipped, argument.skipped_ratio_max),
    })
}

/// The figures of a score by name.
fn by_name(score: &[ScoreMetric]) -> BTreeMap<String, RecordedMetric> {
    let found = |metric: &ScoreMetric| RecordedMetric {
        value: metric.value,
        interval: metric.interval,
    };
    let score = score.iter();
    score
        .map(|metric| (metric.name.clone(), found(metric)))
        .collect()
}

/// What carried the channels.
fn link(summary: &RunSummary, crossing: &[&ChannelSummary]) -> RecordedLink {
    let origin = |channel: &&ChannelSummary| match channel.link {
        LinkKind::Emulated if channel.trace_replay.is_some() => LinkOrigin::Traced,
        LinkKind::Emulated => LinkOrigin::Emulated,
        _ => LinkOrigin::Real,
    };
    let transports = crossing.iter().filter_map(|channel| match channel.link {
        LinkKind::Network(transport) => Some(transport.label.to_owned()),
        _ => None,
    });
    let transports: BTreeSet<String> = transports.collect();
    let models = summary.run.links.iter().map(Fact::to_string);
    let about: Vec<String> = transports.into_iter().chain(models).collect();
    RecordedLink {
        origin: crossing
            .iter()
            .map(origin)
            .max()
            .unwrap_or(LinkOrigin::Real),
        about: about.join(", "),
    }
}

/// What the network did to the messages of the channels together.
fn crossing_of(summary: &RunSummary, crossing: &[&ChannelSummary]) -> RecordedCrossing {
    let mut sum = RecordedCrossing {
        offered_count: 0,
        lost_count: Ok(0),
        delays: Ok(Vec::new()),
    };
    let known = summary.network.iter().flat_map(|report| &report.channels);
    let known: Vec<_> = known.collect();
    for channel in crossing {
        let name = &channel.name;
        let Some(found) = known.iter().find(|one| one.channel == *name) else {
            let why = format!("there is no account of {name}");
            sum.lost_count = Err(why.clone());
            sum.delays = Err(why);
            continue;
        };
        let figures = &found.figures;
        sum.offered_count += figures.offered_count;
        if let Some(why) = missing(&figures.loss).filter(|_| figures.offered_count > 0) {
            sum.lost_count = Err(format!("{name}: {why}"));
        } else if let Ok(count) = &mut sum.lost_count {
            *count += figures.lost_count;
        }
        // What nothing arrived on has no delays to be missed.
        if let Some(why) = missing(&figures.delay).filter(|_| figures.arrived_count > 0) {
            sum.delays = Err(format!("{name}: {why}"));
        } else if let Ok(delays) = &mut sum.delays {
            delays.extend(figures.delay_bins.iter().copied().map(DelayBin::from));
        }
    }
    sum
}

/// Why a figure is unavailable; `None` where it is not.
const fn missing<T>(metric: &Metric<T>) -> Option<&String> {
    match metric {
        Metric::Measured(_) => None,
        Metric::Unavailable { reason } => Some(reason),
    }
}

/// The ticks of all its processes.
fn skipped(summary: &RunSummary) -> SkippedTicks {
    let processes = summary.processes.iter();
    let sum =
        |of: fn(&ProcessSummary) -> Option<u64>| -> u64 { processes.clone().filter_map(of).sum() };
    let skipped_count = sum(|process| process.skipped_tick_count);
    SkippedTicks {
        skipped_count,
        due_count: skipped_count + sum(|process| process.tick_count),
    }
}

/// What speaks against holding the run against the paper, of whose ticks so large a share may have been skipped.
fn doubts(summary: &RunSummary, skipped: SkippedTicks, skipped_ratio_max: f64) -> Vec<Doubt> {
    let mut found = Vec::new();
    if summary.run.outcome == Outcome::Stopped {
        found.push(Doubt::Stopped {
            reason: summary.run.exit_reason.clone(),
        });
    }
    let assessment = Assessment::of(summary);
    let answer = Answer::of(summary, &assessment);
    let measurement = answer.measurement;
    let is_valid = measurement.is_valid == Some(true) && measurement.uncounted_start_count == 0;
    if !is_valid {
        let (_, measurement) = answer.measurement_words(&assessment.network);
        found.push(Doubt::NotValid { measurement });
    } else if skipped.is_above(skipped_ratio_max) {
        found.push(Doubt::SkippedTicks(skipped));
    }
    if is_score_incomplete(summary) {
        found.push(Doubt::ScoreIncomplete);
    }
    if summary.link_changes.iter().any(LinkChange::is_in_force) {
        found.push(Doubt::LinkChanged);
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    use crate::tests::sample::full;
    use hil_core::link_model::ReplayCounts;
    use serde_json::json;

    /// A valid run over UDP, and its parameters.
    fn run(change: impl FnOnce(&mut RunSummary)) -> ComparedRun {
        let mut summary = full();
        for process in &mut summary.processes {
            process.restart_count = 0;
            process.cpu_time_s = Some(1.0);
            process.skipped_tick_count = process.skipped_tick_count.map(|_| 0);
        }
        for channel in &mut summary.channels {
            if let Some(recorded) = &mut channel.recorded {
                recorded.missing_count = 0;
            }
        }
        change(&mut summary);
        ComparedRun {
            folder: PathBuf::from("runs/eth-1"),
            summary,
            topology: json!({ "name": "split", "case": { "name": "teleoperation", "parameters": { "rate_hz": 125.0 } } }),
        }
    }

    fn argument(network: Option<PublishedNetwork>) -> RunArgument {
        RunArgument {
            network,
            row: None,
            folder: "runs/eth-1".to_owned(),
            skipped_ratio_max: 0.0,
        }
    }

    fn read_one(change: impl FnOnce(&mut RunSummary)) -> Result<RecordedRun<Value>, String> {
        let ethernet = Some(PublishedNetwork::Ethernet);
        recorded(run(change), &argument(ethernet), "teleoperation")
    }

    #[test]
    fn an_argument_is_a_folder_with_or_without_a_label() {
        let parsed = |text: &str| text.parse::<RunArgument>();
        let of = |network, folder: &str| {
            let folder = folder.to_owned();
            Ok(RunArgument {
                folder,
                ..argument(network)
            })
        };
        assert_eq!(parsed("runs/a=b"), of(None, "runs/a=b"));
        let short = Some(PublishedNetwork::ShortRange);
        assert_eq!(parsed("short=runs/a=b"), of(short, "runs/a=b"));
        for text in ["runs/a", "ethernet=runs/a", "long=a*"] {
            assert_eq!(parsed(text).unwrap().to_string(), text);
        }
        assert_eq!(
            parsed("wifi=runs/a").unwrap_err(),
            "label `wifi` is none of ethernet, short, long; write ./wifi=runs/a for a folder of that name"
        );
    }

    #[test]
    fn a_star_stands_for_anything_in_a_name() {
        for (pattern, name, expected) in [
            ("wifi-*", "wifi-12", true),
            ("wifi-*", "wifi-", true),
            ("wifi-*", "eth-1", false),
            ("*-1", "wifi-1", true),
            ("*-1", "wifi-12", false),
            ("a*b*c", "a-b-b-c", true),
            ("a*b*c", "a-c-b", false),
            ("ab*bc", "abc", false),
            ("*", "", true),
        ] {
            assert_eq!(is_match(pattern, name), expected, "{pattern} {name}");
        }
    }

    #[test]
    fn folders_are_read_by_pattern_and_a_run_given_twice_is_refused() {
        let parent = std::env::temp_dir().join(format!("hil-recorded-{}", std::process::id()));
        for name in ["wifi-10", "wifi-2", "wifi-1", "eth-1"] {
            let folder = parent.join(name);
            fs::create_dir_all(&folder).unwrap();
            let run = run(|_| {});
            run.summary.write(&folder.join("summary.json")).unwrap();
            let program = json!({ "name": "hil-runtime", "version": "0" });
            let manifest =
                json!({ "schema_version": 1, "program": program, "topology": run.topology });
            fs::write(folder.join("manifest.json"), manifest.to_string()).unwrap();
        }
        let argument = |label: &str, name: &str| -> RunArgument {
            let text = format!("{label}{}", parent.join(name).display());
            text.parse().unwrap()
        };
        let read = |arguments: &[RunArgument]| read(arguments, "teleoperation");
        let found = read(&[argument("short=", "wifi-*"), argument("", "eth-1")]).unwrap();
        let named: Vec<_> = found
            .iter()
            .map(|run| (&run.folder[run.folder.len() - 6..], run.network))
            .collect();
        let short = Some(PublishedNetwork::ShortRange);
        assert_eq!(
            named,
            [
                ("wifi-1", short),
                ("wifi-2", short),
                ("ifi-10", short),
                ("/eth-1", None)
            ]
        );
        assert_eq!(found[0].parameters, json!({ "rate_hz": 125.0 }));
        assert_eq!(found[0].name, "split");
        let error = |arguments: &[RunArgument]| read(arguments).unwrap_err();
        let twice = error(&[argument("", "wifi-1"), argument("", "wifi-*")]);
        assert!(
            twice.contains("wifi-1: it is of the same run as /"),
            "{twice}"
        );
        let none = error(&[argument("", "lte-*")]);
        assert!(none.ends_with("lte-*: no folder is called so"), "{none}");
        let missing = error(&[argument("", "lte-1")]);
        assert!(missing.contains("lte-1/summary.json"), "{missing}");
        fs::remove_dir_all(parent).unwrap();
    }

    #[test]
    fn folders_of_two_hosts_of_one_run_are_one_run() {
        let of = |folder: &str, start_ns: i64| {
            let mut run = run(|one| {
                one.run.starts_ns = [("robot-pc".to_owned(), start_ns)].into();
            });
            run.folder = PathBuf::from(folder);
            run
        };
        let here = of("no/control-pc", 5);
        assert!(is_same_run(&here, &of("no/robot-pc", 5)));
        assert!(!is_same_run(&here, &of("no/robot-pc", 6)));
        let mut other = of("no/robot-pc", 5);
        other.summary.run.topology_hash.push('0');
        assert!(!is_same_run(&here, &other));
    }

    #[test]
    fn what_can_be_no_row_is_refused_with_its_cause() {
        let error = |change: fn(&mut RunSummary)| read_one(change).unwrap_err();
        assert_eq!(
            error(|one| one.run.case = "fleet".to_owned()),
            "a run of fleet; the tables are of teleoperation"
        );
        assert!(error(|one| one.run.case.clear()).starts_with("a run of no case"));
        assert!(error(|one| one.run.is_virtual = true).contains("virtual time"));
        assert_eq!(
            error(|one| {
                one.run.outcome = Outcome::Failed;
                one.run.exit_reason = "process robot ended with code 1".to_owned();
            }),
            "the run failed: process robot ended with code 1"
        );
        let local = error(|one| {
            for channel in &mut one.channels {
                channel.link = LinkKind::SharedMemory;
            }
        });
        assert_eq!(local, "no channel went over a network, or a model of one");
        let mut bare = run(|_| {});
        bare.topology = Value::Null;
        let error = recorded(bare, &argument(None), "teleoperation").unwrap_err();
        assert!(error.contains("case.parameters"), "{error}");
    }

    #[test]
    fn a_sound_run_has_no_doubts_and_what_is_wrong_is_named() {
        let found = |change: fn(&mut RunSummary)| read_one(change).unwrap().doubts;
        assert_eq!(found(|_| {}), []);
        let two = |one: &mut RunSummary| one.processes[0].skipped_tick_count = Some(2);
        let skipped = SkippedTicks {
            skipped_count: 2,
            due_count: 10_002,
        };
        assert_eq!(found(two), [Doubt::SkippedTicks(skipped)]);
        for (allowed, is_sound) in [(0.000_1, false), (0.000_2, true)] {
            let allowing = argument(None).allow(allowed);
            let one = recorded(run(two), &allowing, "teleoperation").unwrap();
            assert_eq!((one.is_sound(), one.skipped), (is_sound, skipped));
        }
        // No row allows what makes a measurement invalid.
        let overran = |one: &mut RunSummary| one.processes[0].skipped_tick_count = Some(500);
        let allowing = argument(None).allow(1.0);
        let overran = recorded(run(overran), &allowing, "teleoperation")
            .unwrap()
            .doubts;
        let [Doubt::NotValid { measurement }] = overran.as_slice() else {
            panic!("{overran:?}");
        };
        assert!(
            measurement.contains("500 of") && measurement.contains("by controller;"),
            "{measurement}"
        );
        let restarted = found(|one| one.processes[2].restart_count = 1);
        assert!(matches!(restarted.as_slice(), [Doubt::NotValid { .. }]));
        let stopped = found(|one| one.run.outcome = Outcome::Stopped);
        assert!(matches!(stopped.as_slice(), [Doubt::Stopped { .. }]));
    }

    #[test]
    fn link_loss_and_delay_are_of_all_channels_that_crossed() {
        let found = read_one(|one| {
            let report = one.network.as_mut().unwrap();
            report.channels[1] = report.channels[0].clone();
            report.channels[1].channel = "arm/status".to_owned();
        })
        .unwrap();
        let link = RecordedLink {
            origin: LinkOrigin::Real,
            about: "UDP".to_owned(),
        };
        assert_eq!(found.link, link);
        // Each channel: 2500 messages every 8 ms; none from 3.6 to 4.4 s and from 15.0 to 15.3 s: 100 and 38.
        assert_eq!(found.crossing.offered_count, 5_000);
        assert_eq!(found.crossing.lost_count, Ok(276));
        let delays = found.crossing.delays.unwrap();
        assert_eq!(delays.iter().map(|bin| bin.count).sum::<u64>(), 5_000 - 276);
        // As the sample has it, the second channel is between clocks that are not aligned.
        let found = read_one(|_| {}).unwrap().crossing;
        assert!(found.delays.unwrap_err().starts_with("arm/status: "));
        assert!(found.lost_count.is_ok());
        let emulated = |replay: Option<ReplayCounts>| {
            let change = |one: &mut RunSummary| {
                one.channels[0].link = LinkKind::Emulated;
                one.channels[0].trace_replay = replay;
                one.run.links = vec![Fact::new("hop", "5 ms")];
            };
            read_one(change).unwrap().link
        };
        let expected = RecordedLink {
            origin: LinkOrigin::Emulated,
            about: "UDP, hop: 5 ms".to_owned(),
        };
        assert_eq!(emulated(None), expected);
        let traced = emulated(Some(ReplayCounts::default()));
        assert_eq!(traced.origin, LinkOrigin::Traced);
    }
}
