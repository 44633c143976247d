//! A comparison as a page of a terminal: what differs, the robot, one line a channel, and last the answer. It
//! computes nothing; `--full` has every figure.

use hil_platform::text::grouped;
use hil_platform::words::counted;

use super::conditions::Verdicts;
use super::harms::QUESTION;
use super::{ChartKind, ComparedMetric, Comparison, Part, Verdict, render};
use crate::answer::UnitScale;
use crate::terminal::left;

/// Channels on the page.
const CHANNELS_SHOWN: usize = 12;
/// Columns of a name and of a figure.
const NAME_WIDTH: usize = 36;
const FIGURE_WIDTH: usize = 28;

pub(super) fn text(comparison: &Comparison, verdicts: &Verdicts) -> String {
    let mut lines = render::head(comparison, "  ");
    lines.push(String::new());
    robot(&mut lines, comparison);
    channels(&mut lines, comparison);
    let verdicts = verdicts.lines();
    if !verdicts.is_empty() {
        lines.push(String::new());
        lines.extend(verdicts);
    }
    lines.push(String::new());
    lines.push("--full prints every figure with its method; intervals are 95 %.".to_owned());
    lines.push("─".repeat(80));
    answer(&mut lines, comparison);
    lines.push("─".repeat(80));
    lines.join("\n").replace(crate::terminal::JOINT, " ")
}

fn row(name: &str, cells: [&str; 3]) -> String {
    let cells = cells.map(|cell| left(cell, FIGURE_WIDTH));
    let line = format!("  {} {}", left(name, NAME_WIDTH - 1), cells.concat());
    line.trim_end().to_owned()
}

/// The scores that differ, and those to see first.
fn robot(lines: &mut Vec<String>, comparison: &Comparison) {
    let scores = || {
        let all = comparison.figures.iter();
        all.filter(|one| one.kind == ChartKind::Score && one.base.is_some() && one.new.is_some())
    };
    let is_shown = |one: &&ComparedMetric| {
        let differs = matches!(one.verdict, Verdict::Lower | Verdict::Higher);
        differs || comparison.headline.contains(&one.metric)
    };
    let shown: Vec<&ComparedMetric> = scores().filter(is_shown).collect();
    let hidden_count = scores().count() - shown.len();
    if !shown.is_empty() {
        lines.push(row("Robot", ["base", "new", "difference"]));
    }
    for one in shown {
        let scale = UnitScale::of(&one.unit);
        let [base, new] = [one.base, one.new]
            .map(|side| side.map_or_else(String::new, |side| scale.words(side.value)));
        lines.push(row(&one.label, [&base, &new, one.verdict.words()]));
    }
    if hidden_count > 0 {
        let text = counted(hidden_count as u64, "other score");
        lines.push(format!("  {text}: no difference shown"));
    }
}

/// Loss of both sides, and how often as long the delays are; those that lose most first.
fn channels(lines: &mut Vec<String>, comparison: &Comparison) {
    let mut names: Vec<&str> = Vec::new();
    for one in &comparison.figures {
        if let Some(channel) = &one.channel
            && !names.contains(&channel.as_str())
        {
            names.push(channel);
        }
    }
    let figure = |channel: &str, part: Option<Part>, metric: &str| {
        let mut all = comparison.figures.iter();
        all.find(|one| {
            one.channel.as_deref() == Some(channel) && one.part == part && one.metric == metric
        })
    };
    let share_lost = |channel: &str| {
        let new = figure(channel, None, "loss").and_then(|one| one.new);
        new.map_or(0.0, |one| one.value)
    };
    names.sort_by(|one, other| share_lost(other).total_cmp(&share_lost(one)));
    if names.is_empty() {
        return;
    }
    lines.push(row(
        "Channels",
        ["lost", "p50, new / base", "p99, new / base"],
    ));
    for name in names.iter().take(CHANNELS_SHOWN) {
        let lost = figure(name, None, "loss").map_or_else(String::new, |one| {
            let [base, new] = [one.base, one.new].map(|side| render::value(one, side));
            with_verdict(format!("{base} → {new}"), one.verdict)
        });
        let ratio = |metric: &str| {
            let one = figure(name, Some(Part::EndToEnd), metric);
            let known = one.and_then(|one| Some((one.ratio?, one.verdict)));
            known.map_or_else(String::new, |(ratio, verdict)| {
                with_verdict(format!("{ratio:.2}"), verdict)
            })
        };
        lines.push(row(name, [&lost, &ratio("p50"), &ratio("p99")]));
    }
    let hidden = names.len().saturating_sub(CHANNELS_SHOWN) as u64;
    if hidden > 0 {
        lines.push(format!(
            "  and {} more that lose no larger share",
            grouped(hidden)
        ));
    }
}

fn with_verdict(text: String, verdict: Verdict) -> String {
    match verdict {
        Verdict::NotTested | Verdict::NoDifferenceShown => text,
        verdict => format!("{text}, {}", verdict.words()),
    }
}

fn answer(lines: &mut Vec<String>, comparison: &Comparison) {
    lines.push(format!("{QUESTION}  {}", comparison.hurt));
    if comparison.base.len().min(comparison.new.len()) == 1 {
        lines.push(
            "  one run on a side: how much runs differ by themselves is not known".to_owned(),
        );
    }
    for harm in &comparison.harms {
        let (base, new) = (harm.base.words(), harm.new.words());
        lines.push(format!("  {}", harm.base.what));
        lines.push(format!("    base  {base}"));
        lines.push(format!("    new   {new}"));
    }
}
