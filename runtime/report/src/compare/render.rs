//! A comparison in words: for a terminal and as Markdown. It computes nothing.

use hil_stats::comparison::Estimate;
use hil_stats::statistics::Interval;

use super::conditions::Verdicts;
use super::harms::{ComparedHarm, QUESTION};
use super::{ChartKind, ComparedMetric, Comparison, Part};
use crate::terminal::{duration, figure, percent};

const UNAVAILABLE: &str = "unavailable";
const COLUMNS: [&str; 6] = ["figure", "base", "new", "new / base", "95 %", "verdict"];

/// One line of the table.
struct Row {
    group: String,
    cells: [String; 6],
}

fn rows(comparison: &Comparison) -> Vec<Row> {
    let all = comparison.figures.iter();
    all.map(|one| Row {
        group: match &one.channel {
            Some(channel) => channel.clone(),
            None => "score".to_owned(),
        },
        cells: cells(one),
    })
    .collect()
}

fn cells(one: &ComparedMetric) -> [String; 6] {
    let name = match one.part {
        None => one.metric.clone(),
        Some(part) => format!("{part} {}", one.metric),
    };
    let (change, interval) = match one.kind {
        ChartKind::Delay => (
            one.ratio.map(|ratio| format!("{ratio:.3}x")),
            one.ratio_interval
                .map(|Interval { low, high }| format!("{low:.3}x to {high:.3}x")),
        ),
        ChartKind::Loss => (
            one.difference.map(points),
            one.difference_interval
                .map(|Interval { low, high }| format!("{} to {}", points(low), points(high))),
        ),
        ChartKind::Score => (
            one.difference.map(signed),
            one.difference_interval
                .map(|Interval { low, high }| format!("{} to {}", signed(low), signed(high))),
        ),
    };
    let or_none = |text: Option<String>| text.unwrap_or_else(|| UNAVAILABLE.to_owned());
    [
        name,
        value(one, one.base),
        value(one, one.new),
        or_none(change),
        or_none(interval),
        one.verdict.words().to_owned(),
    ]
}

fn points(share: f64) -> String {
    format!("{:+.3} pp", share * 100.0)
}

fn signed(value: f64) -> String {
    let text = figure(value);
    if value > 0.0 {
        format!("+{text}")
    } else {
        text
    }
}

#[expect(clippy::cast_possible_truncation, reason = "nanoseconds of a delay")]
pub(super) fn value(one: &ComparedMetric, estimate: Option<Estimate>) -> String {
    let Some(Estimate { value, .. }) = estimate else {
        return UNAVAILABLE.to_owned();
    };
    match (one.kind, one.unit.as_str()) {
        (ChartKind::Delay, _) => duration(value as i64),
        (ChartKind::Loss, _) => percent(value),
        (ChartKind::Score, "1") => figure(value),
        (ChartKind::Score, unit) => format!("{} {unit}", figure(value)),
    }
}

/// For a terminal.
pub(super) fn text(comparison: &Comparison, verdicts: &Verdicts) -> String {
    let rows = rows(comparison);
    let width = |column: usize| {
        let cells = rows.iter().map(|row| row.cells[column].chars().count());
        cells.max().unwrap_or(0).max(COLUMNS[column].len())
    };
    let widths: Vec<usize> = (0..COLUMNS.len()).map(width).collect();
    let line = |cells: &[String]| {
        let padded = cells.iter().zip(&widths).map(|(cell, width)| {
            let missing = width.saturating_sub(cell.chars().count());
            format!("{cell}{:missing$}", "")
        });
        format!("  {}", padded.collect::<Vec<_>>().join("  ").trim_end())
    };
    let mut lines = head(comparison, "  ");
    lines.push(String::new());
    lines.push(line(&COLUMNS.map(str::to_owned)));
    let mut last = "";
    for row in &rows {
        if row.group != last {
            lines.push(row.group.clone());
            last = &row.group;
        }
        lines.push(line(&row.cells));
    }
    lines.push(String::new());
    lines.push("Intervals are 95 %:".to_owned());
    lines.extend(
        methods(comparison)
            .into_iter()
            .map(|text| format!("  {text}")),
    );
    let verdicts = verdicts.lines();
    if !verdicts.is_empty() {
        lines.push(String::new());
        lines.extend(verdicts);
    }
    lines.join("\n")
}

pub(super) fn head(comparison: &Comparison, margin: &str) -> Vec<String> {
    let folders = |runs: &[std::path::PathBuf]| {
        let names = runs.iter().map(|run| run.display().to_string());
        names.collect::<Vec<_>>().join(", ")
    };
    let mut lines = vec![
        format!("base  {}", folders(&comparison.base)),
        format!("new   {}", folders(&comparison.new)),
    ];
    if comparison.differences.is_empty() {
        let same = comparison.same.join(", ");
        lines.push(format!("The runs are comparable: same {same}."));
    } else {
        lines.push("The runs differ in more than their figures:".to_owned());
        let differences = comparison.differences.iter();
        lines.extend(differences.map(|text| format!("{margin}{text}")));
    }
    if !comparison.cautions.is_empty() {
        lines.push("Read with care:".to_owned());
        let cautions = comparison.cautions.iter();
        lines.extend(cautions.map(|text| format!("{margin}{text}")));
    }
    lines
}

/// Each method once, with what it was used for.
fn methods(comparison: &Comparison) -> Vec<String> {
    let mut found: Vec<(&str, Vec<&str>)> = Vec::new();
    for one in &comparison.figures {
        let whom = match one.kind {
            ChartKind::Delay if one.part == Some(Part::EndToEnd) => one.metric.as_str(),
            ChartKind::Delay => "segments",
            ChartKind::Loss => "loss",
            ChartKind::Score => "scores",
        };
        match found.iter_mut().find(|known| known.0 == one.method) {
            Some((_, known)) if known.contains(&whom) => {}
            Some((_, known)) => known.push(whom),
            None => found.push((&one.method, vec![whom])),
        }
    }
    found
        .into_iter()
        .map(|(method, whom)| format!("{}: {method}", whom.join(", ")))
        .collect()
}

/// As Markdown.
pub(super) fn markdown(comparison: &Comparison, verdicts: &Verdicts) -> String {
    let cell = |text: &str| text.replace('|', "\\|");
    let mut lines = vec!["# Comparison of runs".to_owned(), String::new()];
    lines.push(format!(
        "**{QUESTION} {}**",
        cell(&comparison.hurt.to_string())
    ));
    lines.push(String::new());
    for ComparedHarm { base, new, .. } in &comparison.harms {
        let (what, base, new) = (&base.what, base.words(), new.words());
        lines.push(format!("- {what}: base {base}; new {new}"));
    }
    if !comparison.harms.is_empty() {
        lines.push(String::new());
    }
    // A blank line around everything but between the items of a list.
    let mut was_item = false;
    for line in head(comparison, "- ") {
        let is_item = line.starts_with("- ");
        if was_item && !is_item {
            lines.push(String::new());
        }
        lines.push(line);
        if !is_item {
            lines.push(String::new());
        }
        was_item = is_item;
    }
    lines.push(String::new());
    lines.push(format!("| channel | {} |", COLUMNS.join(" | ")));
    lines.push("|---".repeat(COLUMNS.len() + 1) + "|");
    for row in rows(comparison) {
        let cells = row.cells.iter().map(|text| cell(text));
        let cells = cells.collect::<Vec<_>>().join(" | ");
        lines.push(format!("| {} | {cells} |", cell(&row.group)));
    }
    lines.push(String::new());
    lines.push("Intervals are 95 %.".to_owned());
    lines.push(String::new());
    lines.extend(
        methods(comparison)
            .into_iter()
            .map(|text| format!("- {text}")),
    );
    let verdicts = verdicts.lines();
    if !verdicts.is_empty() {
        lines.push(String::new());
        lines.extend(verdicts.iter().map(|one| format!("- {one}")));
    }
    lines.join("\n")
}
