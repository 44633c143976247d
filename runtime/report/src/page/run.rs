//! One run of a page: the sections of the report with what only a page has, drawings and tiles.

use hil_platform::text::{grouped, shell_words};
use hil_present::units::JOINT;
use hil_present::{Block, Field, Metric, Section, Tone, UNAVAILABLE};

use super::data::{AnswerView, Run, RunKind, Tile, Verdict};
use super::drawings;
use super::read::{Found, Manifest, Material};
use super::timeline;
use crate::answer::Answer;
use crate::assessment::Assessment;
use crate::sections::AnswerFacts;
use crate::sections::{self, Sources, outcome_words};
use crate::summary::{RunSummary, host_words};

/// The run in `material`; `steps` is how many points a series over time may have.
pub(super) fn of(material: &Material, index: usize, steps: usize) -> Run {
    let key = format!("run-{}", index + 1);
    match &material.found {
        Found::Ended(summary) => ended(key, summary, material, steps),
        Found::Unfinished(manifest) => unfinished(key, manifest, material),
    }
}

/// What a report lacks, and why.
fn missing(items: Vec<String>) -> Section {
    let mut section = Section::new("missing", "What is not here", "");
    if !items.is_empty() {
        let tone = Tone::Plain;
        section.blocks.push(Block::List { tone, items });
    }
    section
}

/// A run without a summary.
fn unfinished(key: String, manifest: &Manifest, material: &Material) -> Run {
    let (files, bytes) = manifest.records;
    let seed = manifest
        .seed
        .map_or_else(|| UNAVAILABLE.to_owned(), |seed| seed.to_string());
    let mut lacks = vec![
        "Score, channels, delays, losses and events: unavailable without summary.json.".to_owned(),
        format!(
            "{} files of records with {} bytes are whole up to the moment it ended.",
            grouped(files),
            grouped(bytes)
        ),
    ];
    lacks.extend(material.problems.iter().cloned());
    let mut facts = Section::new("facts", "Run facts", "");
    facts.fact("begun", Tone::Plain, &manifest.created);
    facts.fact("seed", Tone::Plain, seed);
    facts.fact("folder", Tone::Plain, &material.folder);
    for one in host_words(&manifest.host_facts) {
        facts.fact(one.label, Tone::Plain, one.value);
    }
    Run {
        key,
        name: manifest.name.clone(),
        case: manifest.case.clone(),
        kind: RunKind::Unfinished,
        outcome: Verdict {
            tone: Tone::Bad,
            word: "unfinished".to_owned(),
            text: "this run never began or was killed outright, so it left no summary".to_owned(),
        },
        sections: vec![
            missing(lacks),
            facts,
            sections::repeat(Some(&shell_words(&manifest.command_line))),
        ],
        repeat_command: Some(shell_words(&manifest.command_line)).filter(|line| !line.is_empty()),
        ..Run::default()
    }
}

fn ended(key: String, summary: &RunSummary, material: &Material, steps: usize) -> Run {
    let assessment = Assessment::of(summary);
    let facts = &summary.run;
    let (tone, word) = outcome_words(facts.outcome);
    let mut sections = sections::of_run(summary, &assessment);
    let mut run = Run {
        name: facts.name.clone(),
        case: facts.case.clone(),
        kind: if facts.is_virtual {
            RunKind::Virtual
        } else {
            RunKind::Live
        },
        outcome: Verdict {
            tone,
            word: word.to_owned(),
            text: facts.exit_reason.clone(),
        },
        answer: Some(answer_view(summary, &assessment)),
        grave_count: (!facts.case.is_empty() && summary.no_score_words().is_none())
            .then(|| sections::events::grave_count(&summary.score_events)),
        repeat_command: Some(facts.repeat_command.clone()),
        key,
        ..Run::default()
    };
    let lacks = draw(&mut run, &mut sections, summary, material, steps);
    sections.push(missing(lacks));
    sections.retain(|section| !section.is_empty());
    let tile = |metric| Tile {
        metric,
        clean: None,
    };
    let first = headline(&sections, &summary.headline);
    run.headline = first.into_iter().map(tile).collect();
    run.sections = sections;
    run
}

/// Puts the drawings where they belong; what there is none of, and why.
fn draw(
    run: &mut Run,
    sections: &mut Vec<Section>,
    summary: &RunSummary,
    material: &Material,
    steps: usize,
) -> Vec<String> {
    let key = run.key.clone();
    let mut lacks = Vec::new();
    let find = |sections: &mut Vec<Section>, id: &str| {
        sections.iter().position(|section| section.id == id)
    };
    match &summary.network {
        Some(report) => {
            let (drawing, plot) = timeline::over_run(
                &key,
                report,
                &summary.score_events,
                &summary.link_changes,
                &material.series,
                steps,
            );
            run.plots.insert(drawing.name.clone(), plot);
            let index = find(sections, "over-time").unwrap_or_else(|| {
                sections.insert(0, Section::new("over-time", report.timeline.title(), ""));
                0
            });
            sections[index].blocks.insert(0, Block::Drawing(drawing));
        }
        None => lacks.push(
            "Network over time: no channel crossed a network, so there is nothing to draw."
                .to_owned(),
        ),
    }
    let mut figures = Section::new("figures", "Figures of the run", "");
    let accounts = summary.channels.iter();
    let accounts = accounts.filter_map(|one| Some((one.name.as_str(), one.account.as_ref()?)));
    match drawings::of_accounts(&key, accounts) {
        Some(drawing) => figures.blocks.push(Block::Drawing(drawing)),
        None => lacks.push("Where the time went: no channel has a measured segment.".to_owned()),
    }
    let (drawing, left_out) = timeline::of_case(&key, &material.series, steps);
    match drawing {
        Some((drawing, plot)) => {
            run.plots.insert(drawing.name.clone(), plot);
            figures.blocks.push(Block::Drawing(drawing));
        }
        None if summary.run.case.is_empty() => {}
        None => lacks
            .push("The robot over time: the case left no series, or they are empty.".to_owned()),
    }
    let left_out = left_out.into_iter();
    lacks.extend(left_out.map(|file| format!("Not drawn for want of room: {file}.")));
    lacks.extend(material.problems.iter().cloned());
    let at = find(sections, "robot").map_or(0, |index| index + 1);
    sections.insert(at, figures);
    if let Some(index) = find(sections, "channels") {
        for (child, channel) in sections[index].children.iter_mut().zip(&summary.channels) {
            let sources = Sources::of(channel, summary);
            let drawn = drawings::of_channel(&key, &channel.name, &sources);
            child
                .blocks
                .splice(0..0, drawn.into_iter().map(Block::Drawing));
        }
    }
    lacks
}

fn answer_view(summary: &RunSummary, assessment: &Assessment) -> AnswerView {
    let answer = Answer::of(summary, assessment);
    let plain = |text: String| text.replace(JOINT, " ");
    let field = |one: Field| Field {
        value: plain(one.value),
        ..one
    };
    let facts = AnswerFacts::of(summary, assessment, &answer, None);
    AnswerView {
        question: answer.question(),
        answer: Verdict {
            tone: answer.tone(),
            word: answer.hurt.word().to_owned(),
            text: plain(answer.sentence()),
        },
        reason: answer.reason().map(plain),
        harms: facts.harms.into_iter().map(field).collect(),
        badges: [facts.measurement, facts.sample]
            .into_iter()
            .chain(facts.rest)
            .chain(facts.links)
            .map(field)
            .collect(),
    }
}

/// True when a channel has a hundred messages of a `kind`: the 99th percentile of two is only their larger one, and one of two lost
/// is no figure to see first.
fn has_a_hundred(channel: &Section, kind: &str) -> bool {
    let metrics = channel.metrics();
    let count = metrics.iter().find(|(_, one)| one.name == kind);
    count.and_then(|(_, one)| one.value).unwrap_or(0.0) >= 100.0
}

/// Figures of which the channel with the largest is shown first, and what they are called.
pub(super) const WORST: [(&str, &str); 3] = [
    (
        "loss_ratio",
        "largest loss by the network, of what it was given",
    ),
    ("p99", "largest p99"),
    ("network_p99", "network's largest p99"),
];

/// The metrics to see first: what the case `wanted`, else its first one, and the worst of the network.
fn headline(sections: &[Section], wanted: &[String]) -> Vec<Metric> {
    let of = |id: &str| sections.iter().find(|section| section.id == id);
    let score = of("score").map(Section::metrics).unwrap_or_default();
    let named = |name: &String| score.iter().find(|(_, one)| one.name == *name);
    let metric = |(_, one): &(&str, &Metric)| (*one).clone();
    let mut found: Vec<Metric> = wanted.iter().filter_map(named).map(metric).collect();
    if found.is_empty() {
        found.extend(score.first().map(metric));
    }
    let channels = of("channels").map_or(&[][..], |section| &section.children);
    for (name, words) in WORST {
        let kind = match name {
            "loss_ratio" => "published",
            _ => "delivered",
        };
        let told = channels.iter().filter(|one| has_a_hundred(one, kind));
        let all = told.flat_map(Section::metrics);
        let all = all.filter(|(_, one)| one.name == name && one.value.is_some());
        let value = |one: &Metric| one.value.unwrap_or(f64::NEG_INFINITY);
        if let Some((channel, one)) = all.max_by(|a, b| value(a.1).total_cmp(&value(b.1))) {
            let label = format!("{words}: {channel}");
            found.push(Metric {
                label,
                ..one.clone()
            });
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worst_of_the_network_to_see_first_rests_on_a_hundred_messages() {
        let channel = |name: &str, count, p99| {
            let mut section = Section::new("channel", name, "");
            name.clone_into(&mut section.subject);
            section.metric(Metric::new("published", "published", "1", count));
            section.metric(Metric::new("delivered", "delivered", "1", count));
            section.metric(Metric::new("loss_ratio", "lost", "1", 10.0 * p99));
            section.metric(Metric::new("p99", "p99", "s", p99));
            section
        };
        let mut all = Section::new("channels", "Channels", "");
        all.children = vec![channel("often", 100.0, 1e-3), channel("twice", 2.0, 5e-3)];
        let [loss, delay] = headline(std::slice::from_ref(&all), &[])
            .try_into()
            .unwrap();
        assert_eq!(
            loss.label,
            "largest loss by the network, of what it was given: often"
        );
        assert_eq!(delay.label, "largest p99: often");
        all.children.remove(0);
        assert!(headline(&[all], &[]).is_empty());
    }

    #[test]
    fn the_case_says_which_of_its_figures_are_seen_first() {
        let mut score = Section::new("score", "Score", "");
        for name in ["motion_loss_ratio", "separation_m_min", "missions_per_hour"] {
            score.metric(Metric::new(name, name, "1", 1.0));
        }
        let of = |wanted: &[&str]| {
            let wanted: Vec<String> = wanted.iter().map(|one| (*one).to_owned()).collect();
            let found = headline(std::slice::from_ref(&score), &wanted);
            found.into_iter().map(|one| one.name).collect::<Vec<_>>()
        };
        let wanted = ["missions_per_hour", "separation_m_min"];
        assert_eq!(of(&wanted), wanted);
        assert_eq!(of(&["no_such_figure"]), ["motion_loss_ratio"]);
    }
}
