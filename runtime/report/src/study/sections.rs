//! A study's report as sections, and as JSON. It computes nothing.

use hil_core::study::{Cell, Criterion, Larger, StudyReport, Table};
use hil_platform::text::shell_words;
use hil_present::terminal::canvas::{Canvas, Style};
use hil_present::terminal::section;
use hil_present::{self as present, Column, Row, Section, Tone};
use serde_json::json;

use super::{Cost, Invocation};

/// Which part of a report a page has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Extent {
    /// The tables to see first, as many columns as fit, and the criteria that are not met.
    Brief,
    /// Everything, each table as wide as it needs to be.
    Full,
}

/// The report as text.
pub(super) fn text(
    report: &StudyReport,
    cost: &Cost,
    invocation: &Invocation,
    extent: Extent,
    style: Style,
) -> String {
    let mut canvas = Canvas::new(invocation.columns, style);
    if extent == Extent::Full {
        canvas = canvas.with_whole_tables();
    }
    let is_shown = |one: &&Table| extent == Extent::Full || !one.is_detail;
    let mut head = Section::new("study", &report.title, "");
    for note in &report.notes {
        head.note(Tone::Faint, note);
    }
    let mut sections = vec![head];
    for one in report.tables.iter().filter(is_shown) {
        let mut below = Section::new(&one.name, &one.title, "");
        below.table(table(one));
        for note in &one.notes {
            below.note(Tone::Faint, note);
        }
        sections.push(below);
    }
    sections.push(criteria(&report.criteria, extent));
    let mut summary = Section::new("summary", "Summary", cost_text(cost));
    if report.summary.is_empty() {
        summary.note(Tone::Plain, cost_text(cost));
        summary.aside.clear();
    }
    for line in &report.summary {
        summary.note(Tone::Strong, line);
    }
    sections.push(summary);
    sections.push(next(&report.larger, invocation, extent));
    for one in &sections {
        section(&mut canvas, one);
    }
    canvas.finish().trim_start_matches('\n').to_owned()
}

/// A table of a study as any form shows it.
pub(super) fn table(of: &Table) -> present::Table {
    let columns = of.columns.iter().map(|column| Column {
        key: column.name.to_owned(),
        label: column.label.to_owned(),
        rank: column.rank,
    });
    let rows = of.rows.iter().map(|row| Row {
        cells: row.iter().map(cell).collect(),
        tone: if row.iter().any(Cell::is_difference) {
            Tone::Caution
        } else {
            Tone::Plain
        },
        bar: None,
    });
    present::Table {
        columns: columns.collect(),
        rows: rows.collect(),
        ..present::Table::default()
    }
}

fn cell(of: &Cell) -> present::Cell {
    match of {
        Cell::Text(text) => text.as_str().into(),
        Cell::Count(count) => present::Cell::Count(*count),
        &Cell::Number { value, decimals } => present::Cell::Number { value, decimals },
        &Cell::Interval {
            low,
            high,
            decimals,
        } => present::Cell::Range {
            low,
            high,
            decimals,
        },
        Cell::Verdict(verdict) => verdict.words().into(),
        Cell::Absent => present::Cell::Missing,
    }
}

fn criteria(all: &[Criterion], extent: Extent) -> Section {
    let met = all.iter().filter(|one| one.is_met == Some(true)).count();
    let aside = format!("{met} of {} met", all.len());
    let mut section = Section::new("criteria", "Held against", aside);
    for Criterion {
        text,
        is_met,
        is_judged,
        finding,
    } in all
    {
        let (tone, label) = match is_met {
            Some(true) if extent == Extent::Brief => continue,
            Some(true) => (Tone::Good, "met"),
            Some(false) => (Tone::Bad, "MISSED"),
            None if *is_judged => (Tone::Caution, "too few"),
            None => (Tone::Plain, "not judged"),
        };
        section.fact(label, tone, format!("{text}: {finding}"));
    }
    section
}

fn cost_text(cost: &Cost) -> String {
    let tasks = if cost.ended_count == cost.task_count {
        format!("{} tasks", cost.task_count)
    } else {
        format!("{} of {} tasks", cost.ended_count, cost.task_count)
    };
    format!(
        "{tasks} on {} threads: {:.1} s of wall time",
        cost.jobs,
        cost.wall.as_secs_f64()
    )
}

/// The commands that decide what is open, and the one that prints the rest.
fn next(larger: &[Larger], invocation: &Invocation, extent: Extent) -> Section {
    let mut section = Section::new("next", "Next", "");
    for Larger { of, parameters } in larger {
        section.fact(*of, Tone::Plain, command(invocation, parameters));
    }
    if extent == Extent::Brief {
        let every = command(invocation, &[]) + " --full";
        section.fact("every figure", Tone::Plain, every);
    }
    section
}

/// The command again, with `parameters` of the case in place of those that it had.
fn command(invocation: &Invocation, parameters: &[String]) -> String {
    let key = |text: &str| text.split('=').next().unwrap_or_default().trim().to_owned();
    let changed: Vec<String> = parameters
        .iter()
        .map(|text| format!("case.parameters.{text}"))
        .collect();
    let is_kept = |one: &&String| !changed.iter().any(|other| key(other) == key(one));
    let kept = invocation.overrides.iter().filter(is_kept);
    let mut words = invocation.words.clone();
    for text in kept.chain(&changed) {
        words.extend(["--set".to_owned(), text.clone()]);
    }
    shell_words(&words)
}

/// The report as one JSON object.
pub(super) fn json(report: &StudyReport, cost: &Cost) -> String {
    let document = json!({
        "report": report,
        "is_passed": report.is_passed(),
        "cost": {
            "wall_s": cost.wall.as_secs_f64(),
            "jobs": cost.jobs,
            "task_count": cost.task_count,
            "ended_count": cost.ended_count,
        },
    });
    format!("{document:#}\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::time::Duration;
    use hil_core::study::{Column, Verdict};

    fn report() -> StudyReport {
        let columns = vec![
            Column::new("row", "Row"),
            Column::new("count", "Count"),
            Column::new("ratio", "95 %").ranked(1),
            Column::new("against_paper", "Verdict"),
        ];
        let rows = vec![
            vec![
                Cell::text("a".repeat(60)),
                Cell::Count(1_007),
                Cell::interval(Some((0.125, 0.5)), 2),
                Cell::Verdict(Verdict::Differs),
            ],
            vec![
                Cell::text("c"),
                Cell::Absent,
                Cell::Absent,
                Cell::Verdict(Verdict::Inconclusive),
            ],
        ];
        let criterion = |is_met, text: &str| Criterion {
            text: text.to_owned(),
            is_met,
            is_judged: text != "foreign",
            finding: "0 of 7".to_owned(),
        };
        let of = |name: &str, is_detail| Table {
            name: name.to_owned(),
            title: format!("Table {name}"),
            columns: columns.clone(),
            rows: rows.clone(),
            notes: vec!["below".to_owned()],
            is_detail,
        };
        StudyReport {
            title: "Study".to_owned(),
            tables: vec![of("one", false), of("two", true)],
            criteria: vec![
                criterion(Some(true), "easy"),
                criterion(Some(false), "hard"),
                criterion(None, "rare"),
                criterion(None, "foreign"),
            ],
            summary: vec!["One differs.".to_owned()],
            larger: vec![Larger {
                of: "inconclusive rows",
                parameters: vec!["tables.sections=5009".to_owned()],
            }],
            ..StudyReport::default()
        }
    }

    fn page(extent: Extent) -> String {
        let cost = Cost {
            wall: Duration::from_secs(2),
            jobs: 2,
            task_count: 3,
            ended_count: 3,
        };
        let words = ["hil-runtime", "tables", "--topology", "a b.toml"];
        let invocation = Invocation {
            words: words.map(str::to_owned).to_vec(),
            overrides: ["run.seed=2", "case.parameters.tables.sections=420"]
                .map(str::to_owned)
                .to_vec(),
            remarks: Vec::new(),
            columns: 80,
        };
        text(&report(), &cost, &invocation, extent, Style::Plain)
    }

    #[test]
    fn a_brief_page_ends_in_what_follows_and_how_to_decide_the_rest() {
        let page = page(Extent::Brief);
        assert!(
            page.lines().all(|line| line.chars().count() <= 80),
            "{page}"
        );
        assert!(page.contains("no room for the columns: 95 %"), "{page}");
        assert!(
            !page.contains("Table two") && !page.contains("easy"),
            "{page}"
        );
        let again = "hil-runtime tables --topology 'a b.toml' --set run.seed=2 --set \
                     case.parameters.tables.sections=5009";
        let one_line = page.split_whitespace().collect::<Vec<_>>().join(" ");
        for words in [
            "Held against 1 of 4 met MISSED hard: 0 of 7 too few rare: 0 of 7 not judged foreign: 0 of 7",
            "Summary 3 tasks on 2 threads: 2.0 s of wall time One differs. Next",
            &format!("inconclusive rows {again}"),
            "--full",
        ] {
            assert!(one_line.contains(words), "{words}: {page}");
        }
    }

    #[test]
    fn a_full_page_has_every_figure() {
        let page = page(Extent::Full);
        for words in ["Table two", "1,007  0.12 to 0.50  differs", "easy", "–"] {
            assert!(page.contains(words), "{words}: {page}");
        }
        assert!(
            !page.contains("no room") && !page.contains("--full"),
            "{page}"
        );
    }
}
