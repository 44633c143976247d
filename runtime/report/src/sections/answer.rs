//! What stands below the answer of a run, in every form. It draws no conclusions.

use std::collections::BTreeSet;

use hil_core::interval::Spread;
use hil_platform::text::grouped;
use hil_platform::words::counted;
use hil_present::units::{duration, percent};
use hil_present::{Field, Tone};

use super::demand;
use super::events::gravest_harm;
use crate::answer::{Answer, Hurt, OCCASIONS_MIN, with_note};
use crate::assessment::Assessment;
use crate::summary::{LinkKind, RunSummary};
use hil_core::case_study::Severity;

/// What an answer rests on, in the order of reading.
#[derive(Debug)]
pub(crate) struct AnswerFacts {
    /// Whether the measurement is valid.
    pub(crate) measurement: Field,
    /// How large the sample is.
    pub(crate) sample: Field,
    /// What hurt the robot, and what might have.
    pub(crate) harms: Vec<Field>,
    /// What the network did, and what the case counts beside harm.
    pub(crate) rest: Vec<Field>,
    /// What the emulated links do.
    pub(crate) links: Option<Field>,
}

impl AnswerFacts {
    /// Of a run; of its harms and figures `shown_max` each, and of harms that did not happen only the names, unless all is wanted.
    pub(crate) fn of(
        summary: &RunSummary,
        assessment: &Assessment,
        answer: &Answer,
        shown_max: Option<usize>,
    ) -> Self {
        let (tone, validity) = answer.measurement_words(&assessment.network);
        let mut harms = Vec::new();
        if answer.hurt == Hurt::Yes
            && let Some((harm, cause)) = gravest_harm(summary)
        {
            harms.push(Field::new("gravest harm", harm));
            harms.push(Field::new("network before it", cause));
        }
        let harms_shown = shown_max.unwrap_or(usize::MAX);
        let is_folded = |count: Option<u64>| count == Some(0) && shown_max.is_some();
        let all = summary.harms.iter();
        let (mut unseen, mut counts): (Vec<_>, Vec<_>) =
            all.partition(|harm| is_folded(harm.count));
        // A single one has room to say of how many, and what it counts.
        if unseen.len() == 1 {
            counts.append(&mut unseen);
        }
        let shown = counts.iter().take(harms_shown);
        harms.extend(shown.map(|harm| Field::new(&harm.what, with_note(harm.words(), &harm.note))));
        let hidden = counts.len().saturating_sub(harms_shown) as u64;
        if hidden > 0 {
            let words = format!("{} with --full", counted(hidden, "further count"));
            harms.push(Field::toned("", Tone::Faint, words));
        }
        if !summary.deadlines.is_empty() {
            let words = "answers that would have come in time but for the network";
            harms.push(Field::new("counted as harm", words));
        }
        if !unseen.is_empty() {
            let names: Vec<&str> = unseen.iter().map(|harm| harm.what.as_str()).collect();
            harms.push(Field::new("none seen", names.join("; ")));
        }
        if answer.hurt == Hurt::No {
            harms.extend(hazards(summary).map(|words| Field::new("hazards", words)));
            let means = answer.no_means();
            harms.extend(means.map(|words| Field::new("NO means", words)));
        }
        let mut rest = Vec::new();
        rest.extend(messages(summary).map(|words| Field::new("messages", words)));
        rest.extend(demand::unmet(summary));
        let scores = summary.score.iter();
        let headline = summary.headline.iter().filter_map(|name| {
            let mut scores = scores.clone();
            scores.find(|one| one.name == *name && one.value.is_some())
        });
        let headline: Vec<_> = headline.take(harms_shown).collect();
        let figures = headline.iter();
        rest.extend(figures.map(|one| Field::new(&one.label, one.words())));
        let harms_of = summary.harms.iter().map(|one| one.interval);
        let mut intervals = harms_of.chain(headline.iter().map(|one| one.interval));
        let has_interval = intervals.any(|one| matches!(one, Some(Spread::Known(_))));
        let note = if has_interval { "; brackets: 95 %" } else { "" };
        let links = link_words(summary);
        // Where a link is emulated, that is what was tested.
        let over = match transports(summary).as_slice() {
            all if !all.is_empty() && links.is_none() => format!(" over {}", all.join(" and ")),
            _ => String::new(),
        };
        let sample = format!("{}{note}", answer.sample_words(&over));
        Self {
            measurement: Field::toned("measurement", tone, validity),
            sample: Field::new("sample", sample),
            harms,
            rest,
            links: links.map(|words| Field::new("emulated link", words)),
        }
    }
}

/// Emulated links that are named; all are in `summary.json`.
const LINKS_SHOWN: usize = 3;

/// What the emulated links do; `None` without one.
pub(crate) fn link_words(summary: &RunSummary) -> Option<String> {
    let all = &summary.run.links;
    let shown = all.iter().take(LINKS_SHOWN).map(ToString::to_string);
    let mut words: Vec<String> = shown.collect();
    let hidden = all.len().saturating_sub(LINKS_SHOWN) as u64;
    if hidden > 0 {
        words.push(format!("{} more in summary.json", grouped(hidden)));
    }
    (!words.is_empty()).then(|| words.join("; "))
}

/// Over what channels crossed a network, each once.
pub(crate) fn transports(summary: &RunSummary) -> Vec<&'static str> {
    let links = summary.channels.iter().map(|one| one.link);
    let crossed = links.filter(|link| matches!(link, LinkKind::Network(_)));
    let labels: BTreeSet<&str> = crossed.map(LinkKind::label).collect();
    labels.into_iter().collect()
}

/// Hazards of a robot that was not hurt: how many, and the first; `None` without a robot.
fn hazards(summary: &RunSummary) -> Option<String> {
    if summary.run.case.is_empty() {
        return None;
    }
    let all = &summary.score_events;
    let mut hazards = all.events.iter();
    let first = hazards.find(|one| one.severity == Severity::Hazard);
    Some(first.map_or_else(
        || "none".to_owned(),
        |first| {
            let count = grouped(all.count_of(Severity::Hazard));
            format!("{count}; first: {}", first.what)
        },
    ))
}

/// Largest loss and longest gap of the messages that crossed a network or a model of one.
fn messages(summary: &RunSummary) -> Option<String> {
    let crossing = summary.channels.iter().filter(|one| one.link.is_crossing());
    let accounts: Vec<_> = crossing
        .filter_map(|one| Some((one.name.as_str(), one.account.as_ref()?)))
        .collect();
    if accounts.is_empty() {
        return None;
    }
    let lost = accounts.iter().filter_map(|(name, account)| {
        Some((*name, account.lost_known()?, account.published_count))
    });
    let lost: Vec<_> = lost.collect();
    let unknown_count = (accounts.len() - lost.len()) as u64;
    let all: u64 = lost.iter().map(|(_, lost, _)| lost).sum();
    let ratio = |lost: u64, of: u64| lost as f64 / of.max(1) as f64;
    let most = lost
        .iter()
        .filter(|(_, _, of)| *of >= OCCASIONS_MIN)
        .max_by(|a, b| ratio(a.1, a.2).total_cmp(&ratio(b.1, b.2)));
    let mut text = match most {
        _ if lost.is_empty() => "how many were lost is unknown".to_owned(),
        _ if unknown_count == 0 && lost.iter().all(|(_, _, of)| *of == 0) => {
            "none published".to_owned()
        }
        _ if all == 0 => "none lost".to_owned(),
        Some((name, lost, of)) if *lost > 0 => {
            let share = percent(ratio(*lost, *of));
            format!("up to {share} of those published lost, on {name}")
        }
        _ => format!("{} lost", grouped(all)),
    };
    if unknown_count > 0 {
        let of = if lost.is_empty() {
            String::new()
        } else {
            format!(
                "; of {} it is unknown",
                counted(unknown_count, "other channel")
            )
        };
        text.push_str(&[&of, ": records that would tell are not at hand"].concat());
    }
    let gaps = accounts.iter().filter_map(|(name, account)| {
        let length_ns = account.gaps.longest?.length_ns;
        let between = account.gaps.between_taken.measured();
        // Messages that come many at once have no interval to name.
        let even = between.filter(|one| 2.0 * one.p50_ns as f64 >= one.mean_ns);
        Some((length_ns, *name, even.map(|one| one.p50_ns)))
    });
    if let Some((length_ns, name, period_ns)) = gaps.max().filter(|(length_ns, ..)| *length_ns > 0)
    {
        let due = period_ns.filter(|ns| *ns > 0);
        let due = due.map_or_else(String::new, |ns| format!(" (every {})", duration(ns)));
        text = format!(
            "{text}; longest gap {} after one was due{due}, on {name}",
            duration(length_ns)
        );
    }
    Some(text)
}
