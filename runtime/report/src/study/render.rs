//! A study's report as a page, as comma-separated values and as JSON. It computes nothing.

use core::fmt::Write;

use hil_core::study::{Cell, Criterion, StudyReport, Table};
use serde_json::json;

use crate::study::Cost;

/// Between two columns of a page.
const GAP: &str = "  ";

/// The report as a page.
pub(super) fn text(report: &StudyReport, cost: &Cost) -> String {
    let mut page = format!("{}\n", report.title);
    for note in &report.notes {
        push(&mut page, format_args!("  {note}"));
    }
    for table in &report.tables {
        page.push('\n');
        push_table(&mut page, table);
    }
    if !report.criteria.is_empty() {
        page.push_str("\nHeld against\n");
        for criterion in &report.criteria {
            push_criterion(&mut page, criterion);
        }
    }
    page.push('\n');
    push(&mut page, format_args!("{}", cost_text(cost)));
    for line in &report.summary {
        push(&mut page, format_args!("{line}"));
    }
    page
}

fn push(page: &mut String, line: core::fmt::Arguments<'_>) {
    let _infallible = writeln!(page, "{line}");
}

fn push_table(page: &mut String, table: &Table) {
    push(page, format_args!("{}", table.title));
    let shown: Vec<Vec<String>> = table
        .rows
        .iter()
        .map(|row| row.iter().map(Cell::shown).collect())
        .collect();
    let is_figure = |column: usize| {
        let mut cells = table.rows.iter().filter_map(|row| row.get(column));
        cells.any(Cell::is_figure)
    };
    let widths: Vec<usize> = table
        .columns
        .iter()
        .enumerate()
        .map(|(index, column)| {
            let cells = shown.iter().filter_map(|row| row.get(index));
            let widest = cells.map(|cell| cell.chars().count()).max().unwrap_or(0);
            widest.max(column.label.chars().count())
        })
        .collect();
    let line = |cells: &mut dyn Iterator<Item = &str>| {
        let padded: Vec<String> = cells
            .enumerate()
            .map(|(index, cell)| {
                let width = widths.get(index).copied().unwrap_or(0);
                if is_figure(index) {
                    format!("{cell:>width$}")
                } else {
                    format!("{cell:<width$}")
                }
            })
            .collect();
        format!("  {}", padded.join(GAP).trim_end())
    };
    let heading = line(&mut table.columns.iter().map(|column| column.label));
    push(page, format_args!("{heading}"));
    let rule_width = widths.iter().sum::<usize>() + GAP.len() * widths.len().saturating_sub(1);
    push(page, format_args!("  {}", "─".repeat(rule_width)));
    for row in &shown {
        let row = line(&mut row.iter().map(String::as_str));
        push(page, format_args!("{row}"));
    }
    for note in &table.notes {
        push(page, format_args!("  {note}"));
    }
}

fn push_criterion(page: &mut String, criterion: &Criterion) {
    let verdict = match criterion.is_met {
        Some(true) => "met     ",
        Some(false) => "MISSED  ",
        None => "too few ",
    };
    let Criterion { text, finding, .. } = criterion;
    push(page, format_args!("  {verdict} {text}: {finding}"));
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

/// A table as comma-separated values (RFC 4180), figures at full precision, an interval as two
/// columns.
pub(super) fn csv(table: &Table) -> String {
    let is_interval = |column: usize| {
        let mut cells = table.rows.iter().filter_map(|row| row.get(column));
        cells.any(|cell| matches!(cell, Cell::Interval { .. }))
    };
    let split: Vec<bool> = (0..table.columns.len()).map(is_interval).collect();
    let mut lines = Vec::new();
    let heading = table
        .columns
        .iter()
        .zip(&split)
        .flat_map(|(column, split)| {
            if *split {
                vec![
                    format!("{}_low", column.name),
                    format!("{}_high", column.name),
                ]
            } else {
                vec![column.name.to_owned()]
            }
        });
    lines.push(heading.collect::<Vec<_>>().join(","));
    for row in &table.rows {
        let fields = row.iter().zip(&split).flat_map(|(cell, split)| match cell {
            Cell::Interval { low, high, .. } => vec![low.to_string(), high.to_string()],
            Cell::Absent if *split => vec![String::new(), String::new()],
            other => vec![field(other)],
        });
        lines.push(fields.collect::<Vec<_>>().join(","));
    }
    lines.join("\r\n") + "\r\n"
}

fn field(cell: &Cell) -> String {
    let text = match cell {
        Cell::Number { value, .. } => return value.to_string(),
        Cell::Absent => return String::new(),
        Cell::Verdict(is_met) => return is_met.to_string(),
        other => other.shown(),
    };
    if text.contains(['"', ',', '\n', '\r']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text
    }
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
    use hil_core::study::Column;

    fn table() -> Table {
        let column = |name, label| Column { name, label };
        Table {
            name: "sample".to_owned(),
            title: "A sample".to_owned(),
            columns: vec![
                column("row", "Row"),
                column("count", "Count"),
                column("ratio", "95 %"),
            ],
            rows: vec![
                vec![
                    Cell::text("a, \"b\""),
                    Cell::Count(7),
                    Cell::interval(Some((0.125, 0.5)), 2),
                ],
                vec![Cell::text("c"), Cell::Absent, Cell::Absent],
            ],
            notes: vec!["below".to_owned()],
        }
    }

    fn cost() -> Cost {
        Cost {
            wall: Duration::from_secs(2),
            jobs: 2,
            task_count: 3,
            ended_count: 3,
        }
    }

    #[test]
    fn a_page_lines_its_columns_up() {
        let report = StudyReport {
            title: "Study".to_owned(),
            tables: vec![table()],
            ..StudyReport::default()
        };
        let page = text(&report, &cost());
        let lines: Vec<_> = page.lines().collect();
        assert_eq!(lines[2], "A sample");
        assert_eq!(lines[3], "  Row     Count          95 %");
        assert_eq!(lines[5], "  a, \"b\"      7  0.12 to 0.50");
        assert_eq!(lines[6], "  c           -             -");
        assert_eq!(lines[7], "  below");
        assert!(
            page.ends_with("3 tasks on 2 threads: 2.0 s of wall time\n"),
            "{page}"
        );
    }

    #[test]
    fn values_keep_their_precision_and_quote_their_commas() {
        let expected = "row,count,ratio_low,ratio_high\r\n\"a, \"\"b\"\"\",7,0.125,0.5\r\nc,,,\r\n";
        assert_eq!(csv(&table()), expected);
    }
}
