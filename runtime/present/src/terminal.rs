//! Sections as text of a fixed width.

pub mod canvas;

use crate::model::{
    Block, Cell, Event, EventList, Field, Metric, Row, Section, Strips, Table, Tone,
};
use crate::units::{duration_s, seconds};
use crate::{joined_labels, model};
use canvas::{Canvas, INDENT, Style, bar, left, right};
use hil_platform::text::{columns, shortened};

/// Columns of a fact's label.
const LABEL_MIN: usize = 14;
const LABEL_MAX: usize = 34;
/// Columns of a metric's value, and of all that stands beside its label.
const VALUE_WIDTH: usize = 16;
const METRIC_WIDTH: usize = 46;
/// Columns between two of a table, of its first column at least, and of the shortest bar worth drawing.
const GAP: usize = 2;
const NAME_MIN: usize = 14;
const BAR_MIN: usize = 8;
/// Columns of an event's time, and the margin of what stood beside it.
const TIME_WIDTH: usize = 14;
const BESIDE_MARGIN: usize = INDENT + 4;
/// Columns of what a strip shows, and of its scale.
const WHAT_WIDTH_MIN: usize = 9;
const SCALE_WIDTH: usize = 18;
/// Eighths of a block, lowest first.
const LEVELS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];

/// `sections` as text of at most `width` columns (clamped to 80..=120).
pub fn render(sections: &[Section], width: usize, style: Style) -> String {
    let mut canvas = Canvas::new(width, style);
    for one in sections {
        section(&mut canvas, one);
    }
    canvas.finish()
}

/// A section and what is below it; nothing of an empty one.
pub fn section(canvas: &mut Canvas, section: &Section) {
    if section.is_empty() {
        return;
    }
    if !section.title.is_empty() {
        canvas.heading(&section.title, &section.aside);
    }
    blocks(canvas, &section.blocks);
    for child in section.children.iter().filter(|one| !one.is_empty()) {
        canvas.subheading(&child.title, &child.aside);
        blocks(canvas, &child.blocks);
        child
            .children
            .iter()
            .for_each(|one| self::section(canvas, one));
    }
}

fn blocks(canvas: &mut Canvas, blocks: &[Block]) {
    for block in blocks {
        match block {
            Block::Facts { facts } => self::facts(canvas, facts),
            Block::Table(table) => self::table(canvas, table),
            Block::Metrics { metrics } => self::metrics(canvas, metrics),
            Block::Events(list) => events(canvas, list),
            Block::Strips(strips) => self::strips(canvas, strips),
            Block::Note { tone, text } => canvas.paragraph(INDENT, *tone, text),
            Block::List { tone, items } => {
                for item in items {
                    canvas.behind(&format!("{:INDENT$}· ", ""), INDENT + 2, *tone, item);
                }
            }
            Block::Command { text } => canvas.paragraph(INDENT + 2, Tone::Strong, text),
            // A picture has no form here; its numbers stand beside it.
            Block::Drawing(_) => {}
        }
    }
}

fn facts(canvas: &mut Canvas, facts: &[Field]) {
    let widest = facts.iter().map(|fact| columns(&fact.label) + 1).max();
    let width = widest.unwrap_or(0).clamp(LABEL_MIN, LABEL_MAX);
    for fact in facts {
        let label = shortened(&fact.label, width - 1);
        canvas.field_of(width, &label, fact.tone, &fact.value);
    }
}

fn metrics(canvas: &mut Canvas, metrics: &[Metric]) {
    let widest = metrics.iter().map(|metric| columns(&metric.label)).max();
    let most = canvas.width() - METRIC_WIDTH;
    let label_width = widest.unwrap_or(0).clamp(20, most);
    let mut told: Vec<&str> = Vec::new();
    for metric in metrics {
        // A method or a reason is said once, where the first of those stands that it is for.
        let is_told = told.contains(&metric.method.as_str());
        let alike = without_value(metrics, metric);
        if alike.len() > 1 {
            if !is_told {
                told.push(&metric.method);
                let reason = format!("{}, {}: {}", model::UNAVAILABLE, alike.len(), metric.method);
                canvas.paragraph(INDENT, Tone::Faint, &reason);
                canvas.paragraph(INDENT + 2, Tone::Plain, &joined_labels(&alike));
            }
            continue;
        }
        let tone = if metric.value.is_some() {
            Tone::Strong
        } else {
            Tone::Faint
        };
        let label = if columns(&metric.label) > label_width {
            canvas.paragraph(INDENT, Tone::Plain, &metric.label);
            ""
        } else {
            &metric.label
        };
        // A value is never cut short.
        let width = VALUE_WIDTH.max(columns(&metric.text));
        let value = canvas.paint(tone, &left(&metric.text, width));
        let line = format!("{:INDENT$}{}  {value}", "", left(label, label_width));
        let room = canvas
            .width()
            .saturating_sub(INDENT + label_width + width + 4);
        match metric.interval.as_str() {
            "" => canvas.line(&line),
            interval if columns(interval) + 2 <= room => {
                canvas.line(&format!("{line}  [{interval}]"));
            }
            interval => {
                canvas.line(&line);
                canvas.paragraph(INDENT + 2, Tone::Plain, &format!("[{interval}]"));
            }
        }
        if !metric.method.is_empty() && !is_told {
            told.push(&metric.method);
            canvas.paragraph(INDENT + 2, Tone::Faint, &metric.method);
        }
    }
}

/// Labels of the metrics that have no value for the reason of `one`; empty when it has one.
fn without_value<'a>(metrics: &'a [Metric], one: &Metric) -> Vec<&'a str> {
    let alike = metrics.iter().filter(|other| {
        let is_none = one.value.is_none() && other.value.is_none();
        is_none && !one.method.is_empty() && other.method == one.method
    });
    alike.map(|other| other.label.as_str()).collect()
}

/// What is shown of a table, and how wide.
struct Layout {
    /// Columns of the table.
    shown: Vec<usize>,
    widths: Vec<usize>,
    are_numbers: Vec<bool>,
    bar_width: usize,
    /// Labels of columns that there was no room for.
    left_out: Vec<String>,
}

impl Layout {
    fn of(table: &Table, room: Option<usize>) -> Self {
        let is_full = |row: &&Row| row.cells.len() == table.columns.len();
        // Names before reasons count where nothing else stands in the column.
        let has_full = table.rows.iter().any(|row| is_full(&row));
        let width_of = |index: usize| {
            let is_told = |row: &&Row| is_full(row) || !has_full && index + 1 < row.cells.len();
            let rows = table.rows.iter().filter(is_told);
            let cells = rows.map(|row| columns(&row.cells[index].text())).max();
            cells.unwrap_or(0).max(columns(&table.columns[index].label))
        };
        let has_value = |index: &usize| {
            let mut cells = table.rows.iter().filter_map(|row| row.cells.get(*index));
            table.columns[*index].rank == 0 || cells.any(|cell| *cell != Cell::Missing)
        };
        let has_bar = table.rows.iter().any(|row| row.bar.is_some());
        let mut shown: Vec<usize> = (0..table.columns.len()).filter(has_value).collect();
        let mut widths: Vec<usize> = (0..table.columns.len()).map(width_of).collect();
        let total = |shown: &[usize], widths: &[usize]| {
            let gaps = GAP * shown.len().saturating_sub(1);
            shown.iter().map(|index| widths[*index]).sum::<usize>() + gaps
        };
        let wanted = if has_bar { GAP + BAR_MIN } else { 0 };
        let room = room.unwrap_or_else(|| total(&shown, &widths) + wanted);
        if table.has_long_names
            && let Some(first) = shown.first()
        {
            let excess = (total(&shown, &widths) + wanted).saturating_sub(room);
            let least = NAME_MIN.min(widths[*first]);
            widths[*first] = widths[*first].saturating_sub(excess).max(least);
        }
        let mut left_out = Vec::new();
        while total(&shown, &widths) + wanted > room {
            let rank = |index: &usize| table.columns[*index].rank;
            match shown
                .iter()
                .copied()
                .filter(|index| rank(index) > 0)
                .max_by_key(rank)
            {
                Some(least) => {
                    left_out.insert(0, table.columns[least].label.clone());
                    shown.retain(|index| *index != least);
                }
                None => break,
            }
        }
        // Then the widest are shortened, the first one last of all.
        while total(&shown, &widths) > room {
            let excess = total(&shown, &widths) - room;
            let widest = shown
                .iter()
                .skip(1)
                .copied()
                .max_by_key(|index| widths[*index]);
            let widest = widest.filter(|index| widths[*index] > NAME_MIN);
            let Some(one) = widest.or_else(|| {
                shown
                    .first()
                    .copied()
                    .filter(|index| widths[*index] > NAME_MIN)
            }) else {
                break;
            };
            widths[one] -= excess.min(widths[one] - NAME_MIN);
        }
        let are_numbers = (0..table.columns.len()).map(|index| {
            let mut cells = table.rows.iter().filter_map(|row| row.cells.get(index));
            cells.any(Cell::is_number)
        });
        let left = room.saturating_sub(total(&shown, &widths) + GAP);
        Self {
            are_numbers: are_numbers.collect(),
            bar_width: if has_bar && left >= BAR_MIN { left } else { 0 },
            shown,
            widths,
            left_out,
        }
    }

    fn padded(&self, index: usize, text: &str) -> String {
        let pad = if self.are_numbers[index] && index > 0 {
            right
        } else {
            left
        };
        pad(text, self.widths[index])
    }
}

/// A table: head, rows and note.
pub fn table(canvas: &mut Canvas, table: &Table) {
    if !table.title.is_empty() {
        canvas.paragraph(INDENT, Tone::Faint, &table.title);
    }
    let layout = Layout::of(table, canvas.table_room());
    let gap = " ".repeat(GAP);
    let head = layout
        .shown
        .iter()
        .map(|index| layout.padded(*index, &table.columns[*index].label));
    let head = head.collect::<Vec<_>>().join(&gap);
    if !head.trim().is_empty() {
        canvas.painted_line(Tone::Faint, &format!("{:INDENT$}{head}", ""));
    }
    for row in &table.rows {
        table_row(canvas, table, &layout, row);
    }
    if !layout.left_out.is_empty() {
        let text = format!("no room for the columns: {}", layout.left_out.join(", "));
        canvas.paragraph(INDENT, Tone::Faint, &text);
    }
    if !table.note.is_empty() {
        canvas.paragraph(INDENT, Tone::Faint, &table.note);
    }
}

fn table_row(canvas: &mut Canvas, table: &Table, layout: &Layout, row: &Row) {
    let gap = " ".repeat(GAP);
    if row.cells.len() < table.columns.len() {
        let texts: Vec<String> = row.cells.iter().map(Cell::text).collect();
        let Some((reason, before)) = texts.split_last() else {
            return;
        };
        let before = before.iter().enumerate();
        let before: Vec<String> = before
            .map(|(index, text)| layout.padded(index, text))
            .collect();
        let mut lead = format!("{:INDENT$}{}", "", before.join(&gap));
        if !before.is_empty() {
            lead.push_str(&gap);
        }
        canvas.behind(&lead, columns(&lead), Tone::Faint, reason);
        return;
    }
    let name = layout.shown.first().map(|first| row.cells[*first].text());
    let name =
        name.filter(|name| table.has_long_names && columns(name) > layout.widths[layout.shown[0]]);
    if let Some(name) = &name {
        canvas.paragraph(INDENT, row.tone, name);
    }
    let cells = layout.shown.iter().map(|index| {
        let is_told = name.is_some() && *index == layout.shown[0];
        let text = if is_told {
            String::new()
        } else {
            row.cells[*index].text()
        };
        layout.padded(*index, &text)
    });
    let cells = cells.collect::<Vec<_>>().join(&gap);
    let drawn = row.bar.filter(|_| layout.bar_width > 0);
    let drawn = drawn.map_or_else(String::new, |one| bar(one.start, one.end, layout.bar_width));
    let line = format!(
        "{:INDENT$}{}{gap}{}",
        "",
        canvas.paint(row.tone, &cells),
        canvas.paint(Tone::Bar, &drawn)
    );
    canvas.line(&line);
}

fn events(canvas: &mut Canvas, list: &EventList) {
    for event in &list.events {
        self::event(canvas, event);
    }
    if !list.note.is_empty() {
        canvas.paragraph(INDENT, Tone::Faint, &list.note);
    }
}

fn event(canvas: &mut Canvas, event: &Event) {
    canvas.field_of(TIME_WIDTH, &event.at, event.tone, &event.what);
    for beside in &event.beside {
        canvas.paragraph(BESIDE_MARGIN, Tone::Plain, beside);
    }
}

/// Series on one time axis: a strip of blocks each, time from left to right.
pub fn strips(canvas: &mut Canvas, strips: &Strips) {
    let name_width = if canvas.width() < 100 { 18 } else { 20 };
    let widest = strips.rows.iter().map(|row| columns(&row.what) + 1).max();
    let what_width = widest.unwrap_or(0).max(WHAT_WIDTH_MIN);
    let room = canvas.width() - INDENT - name_width - what_width - SCALE_WIDTH - 2;
    for row in &strips.rows {
        let label = if row.what.is_empty() {
            format!("{} ", left(&row.name, name_width + what_width - 1))
        } else {
            format!(
                "{} {}",
                left(&row.name, name_width - 1),
                left(&row.what, what_width)
            )
        };
        let line = format!(
            "{:INDENT$}{}{}  {}",
            "",
            canvas.paint(Tone::Faint, &label),
            canvas.paint(row.tone, &strip(&row.values, room)),
            canvas.paint(Tone::Faint, &right(&row.scale, SCALE_WIDTH)),
        );
        canvas.line(&line);
    }
    if !strips.marks_s.is_empty() {
        let label = left(strips.marks_label, name_width + what_width);
        let marks = marks(strips, room);
        let line = format!(
            "{:INDENT$}{}{}",
            "",
            canvas.paint(Tone::Faint, &label),
            canvas.paint(Tone::Caution, &marks)
        );
        canvas.line(&line);
    }
    let [begin, middle, end] = [0.0, 0.5, 1.0].map(|share| seconds(share * strips.whole_s));
    let half = room / 2;
    let middle_width = half.saturating_sub(6);
    let middle = if columns(&middle) < middle_width {
        middle
    } else {
        String::new()
    };
    let axis_margin = INDENT + name_width + what_width;
    let column = format!("a column is {}", duration_s(strips.whole_s / room as f64));
    let axis = format!(
        "{:INDENT$}{}{}{}{}",
        "",
        left(&column, axis_margin - INDENT),
        left(&begin, half.saturating_sub(4)),
        left(&middle, middle_width),
        right(&end, room.saturating_sub(2 * half) + 10)
    );
    canvas.painted_line(Tone::Faint, &axis);
}

/// A mark in each column in which something is to be marked.
fn marks(strips: &Strips, room: usize) -> String {
    let column_s = strips.whole_s / room as f64;
    let mark = |index: usize| {
        let from_s = index as f64 * column_s;
        // What happened just before the start or after the end stands at the border.
        let is_within = |at_s: &f64| {
            let at_s = at_s.clamp(0.0, strips.whole_s - column_s / 2.0);
            (from_s..from_s + column_s).contains(&at_s)
        };
        if strips.marks_s.iter().any(is_within) {
            '^'
        } else {
            ' '
        }
    };
    (0..room).map(mark).collect()
}

/// `width` columns, each as high as the largest value of its time.
pub(crate) fn strip(values: &[Option<f64>], width: usize) -> String {
    let largest = values.iter().flatten().copied().fold(0.0, f64::max);
    let column = |index: usize| {
        let from = index * values.len() / width;
        let until = ((index + 1) * values.len() / width).max(from + 1);
        let within = values
            .get(from..until.min(values.len()))
            .unwrap_or_default();
        match within.iter().flatten().copied().reduce(f64::max) {
            None => '·',
            Some(value) if value > 0.0 => LEVELS[level(value / largest)],
            Some(_) => ' ',
        }
    };
    (0..width).map(column).collect()
}

#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "the value is clamped to 0..=7"
)]
fn level(share: f64) -> usize {
    ((share * 8.0).ceil() - 1.0).clamp(0.0, 7.0) as usize
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Bar, Column, Strip};

    fn text_of(width: usize, draw: impl FnOnce(&mut Canvas)) -> String {
        let mut canvas = Canvas::new(width, Style::Plain);
        draw(&mut canvas);
        canvas.finish()
    }

    #[test]
    fn a_strip_keeps_the_highest_value_of_each_column() {
        let values = [Some(0.0), Some(1.0), None, None, Some(8.0), Some(2.0)];
        assert_eq!(strip(&values, 3), "▁·█");
        assert_eq!(strip(&values, 6), " ▁··█▂");
        assert_eq!(strip(&values[..2], 4), "  ██");
        assert_eq!(strip(&[Some(0.0); 4], 4), "    ");
    }

    #[test]
    fn rows_of_one_axis_stand_below_each_other_and_marks_at_their_time() {
        let row = |at: usize| Strip {
            name: "shuttle/command".to_owned(),
            what: "lost".to_owned(),
            values: (0..120)
                .map(|step| Some(f64::from(u8::from(step == at))))
                .collect(),
            scale: "812 ms ±15.0 µs".to_owned(),
            ..Strip::default()
        };
        let all = Strips {
            whole_s: 12.0,
            rows: vec![row(30), row(35)],
            marks_s: vec![3.0],
            marks_label: "link changed by hand",
        };
        for width in [80, 100] {
            let text = text_of(width, |canvas| strips(canvas, &all));
            let rows: Vec<&str> = text.lines().collect();
            assert!(rows.iter().all(|row| columns(row) <= width), "{text}");
            let place = |row: &str, mark| row.chars().position(|c| c == mark).unwrap();
            assert!(place(rows[0], '█') < place(rows[1], '█'), "{text}");
            assert!(
                place(rows[2], '^').abs_diff(place(rows[0], '█')) <= 1,
                "{text}"
            );
            assert!(
                rows[1].ends_with("812 ms ±15.0 µs") && rows[3].contains("6.000 s"),
                "{text}"
            );
        }
    }

    #[test]
    fn a_table_without_room_drops_the_column_of_highest_rank_and_keeps_reasons_whole() {
        let mut one = Table::new("", &["channel", "p50", "p99"]);
        one.columns.push(Column {
            key: String::new(),
            label: "what a page with room has besides".to_owned(),
            rank: 1,
        });
        one.push([
            "a/very/long/channel/name/that/needs/room".into(),
            Cell::Duration(1_500),
            Cell::Missing,
            Cell::Count(1_234),
        ]);
        one.push([
            "b".into(),
            format!("unavailable: {}", "unrecorded ".repeat(12)).into(),
        ]);
        one.rows[0].bar = Some(Bar {
            start: 0.0,
            end: 1.0,
        });
        let narrow = text_of(80, |canvas| table(canvas, &one));
        assert!(
            narrow.contains("columns: what a page") && narrow.contains("1.50 µs"),
            "{narrow}"
        );
        assert!(!narrow.contains("1,234"), "{narrow}");
        let wide = text_of(120, |canvas| table(canvas, &one));
        assert!(wide.contains("besides") && wide.contains("1,234"), "{wide}");
        for (text, width) in [(&narrow, 80), (&wide, 120)] {
            assert!(text.lines().all(|line| columns(line) <= width), "{text}");
            assert_eq!(text.matches("unrecorded").count(), 12, "{text}");
        }
    }

    #[test]
    fn a_long_name_stands_on_a_line_of_its_own_before_a_column_is_left_out() {
        let mut one = Table::new("", &["flow", "frames", "what a page has besides"])
            .ranked("what a page has besides", 1)
            .with_long_names();
        let name = "tcp [fe80::858:44ff:fe4d:1]:40001 → [fe80::858:44ff:fe4d:2]:5201";
        one.push([name.into(), Cell::Count(12), Cell::Count(1_234)]);
        one.push(["arp".into(), Cell::Count(7), Cell::Count(5_678)]);
        let narrow = text_of(80, |canvas| table(canvas, &one));
        let line = |words: &str| narrow.lines().find(|line| line.contains(words)).unwrap();
        assert_eq!(line(name).trim(), name);
        assert!(line("1,234").contains("12"), "{narrow}");
        assert!(line("5,678").contains("arp"), "{narrow}");
        assert!(narrow.lines().all(|line| columns(line) <= 80), "{narrow}");
        let wide = text_of(120, |canvas| table(canvas, &one));
        let line = wide.lines().find(|line| line.contains(name)).unwrap();
        assert!(line.contains("1,234"), "{wide}");
    }

    #[test]
    fn a_name_stands_before_its_reason_where_no_row_has_values() {
        let mut one = Table::new("", &["", "p50", "p99"]);
        one.push(["interval".into(), "fewer than two datagrams".into()]);
        let text = text_of(80, |canvas| table(canvas, &one));
        assert!(
            text.ends_with("\n  interval  fewer than two datagrams\n"),
            "{text}"
        );
    }

    #[test]
    fn a_reason_is_said_once_with_all_that_it_is_for() {
        let metrics: Vec<Metric> = ["a", "b"]
            .map(|label| Metric::unavailable(label, label, "1", "no whole loop"))
            .to_vec();
        let text = text_of(80, |canvas| super::metrics(canvas, &metrics));
        assert_eq!(text, "  unavailable, 2: no whole loop\n    a; b\n");
    }

    #[test]
    fn a_metric_has_its_interval_and_its_method_below() {
        let one = Metric::new("p50", "published → taken, p50", "s", 0.0012)
            .within(Some((0.001, 0.002)))
            .by("block bootstrap");
        let text = text_of(80, |canvas| metrics(canvas, &[one.clone(), one]));
        assert_eq!(text.matches("[1.00 to 2.00 ms]").count(), 2, "{text}");
        assert_eq!(text.matches("block bootstrap").count(), 1, "{text}");
    }
}
