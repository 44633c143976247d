//! Network and robot on one time axis: a strip of blocks for each row, time from left to right. It
//! knows no figures.

use super::canvas::{Canvas, INDENT, Tone, left, right};
use super::units::{duration_s, figure, percent, seconds};
use crate::link_change::LinkChange;
use crate::network::{NetworkQuantity, Timeline, TimelineRow, TimelineSubject};

/// Columns of the row's name, of what it shows, and of its scale behind it.
const WHAT_WIDTH: usize = 9;
const SCALE_WIDTH: usize = 18;

/// Eighths of a block, lowest first.
const LEVELS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];

pub(super) fn timeline(canvas: &mut Canvas, all: &Timeline, changes: &[LinkChange]) {
    let Some(step_count) = all.rows.first().map(|row| row.values.len()) else {
        return;
    };
    let whole_s = all.step_s * step_count as f64;
    let name_width = if canvas.width() < 100 { 18 } else { 20 };
    let room = canvas.width() - INDENT - name_width - WHAT_WIDTH - SCALE_WIDTH - 2;
    let column_s = whole_s / room as f64;
    let aside = format!(
        "{} a column, each row to its own largest value, · none",
        duration_s(column_s)
    );
    canvas.heading("Timeline", &aside);
    let mut last = "";
    for row in &all.rows {
        let (label, tone) = match &row.subject {
            // A robot's rows have names of their own.
            TimelineSubject::Robot { label } => {
                let label = format!("{} ", left(label, name_width + WHAT_WIDTH - 1));
                (label, Tone::Bad)
            }
            TimelineSubject::Channel { channel, quantity } => {
                let name = if channel == last { "" } else { channel };
                last = channel;
                let what = match quantity {
                    NetworkQuantity::Loss => "lost",
                    NetworkQuantity::Delay => "delay",
                    NetworkQuantity::Silence => "silence",
                };
                let label = format!("{} {}", left(name, name_width - 1), left(what, WHAT_WIDTH));
                (label, Tone::Bar)
            }
        };
        let line = format!(
            "{:INDENT$}{}{}  {}",
            "",
            canvas.paint(Tone::Faint, &label),
            canvas.paint(tone, &strip(&row.values, room)),
            canvas.paint(Tone::Faint, &right(&scale(row), SCALE_WIDTH)),
        );
        canvas.line(&line);
    }
    let axis_margin = INDENT + name_width + WHAT_WIDTH;
    if let Some(marks) = change_marks(changes, whole_s, room) {
        let label = left("link changed by hand", name_width + WHAT_WIDTH);
        let line = format!(
            "{:INDENT$}{}{}",
            "",
            canvas.paint(Tone::Faint, &label),
            canvas.paint(Tone::Caution, &marks)
        );
        canvas.line(&line);
    }
    let [begin, middle, end] = [0.0, 0.5, 1.0].map(|share| seconds(share * whole_s));
    let half = room / 2;
    let axis = format!(
        "{:axis_margin$}{}{}{}",
        "",
        left(&begin, half.saturating_sub(4)),
        left(&middle, half.saturating_sub(6)),
        right(&end, room.saturating_sub(2 * half) + 10)
    );
    canvas.painted_line(Tone::Faint, &axis);
}

/// A mark in each column in which a link was changed; `None` when none was.
fn change_marks(changes: &[LinkChange], whole_s: f64, room: usize) -> Option<String> {
    let in_force = changes.iter().filter(|change| change.is_in_force());
    let times: Vec<f64> = in_force.filter_map(|change| change.at_s).collect();
    let column_s = whole_s / room as f64;
    let mark = |index: usize| {
        let from_s = index as f64 * column_s;
        // What happened just before the start or after the end stands at the border.
        let is_within = |at_s: &f64| {
            let at_s = at_s.clamp(0.0, whole_s - column_s / 2.0);
            (from_s..from_s + column_s).contains(&at_s)
        };
        if times.iter().any(is_within) {
            '^'
        } else {
            ' '
        }
    };
    (!times.is_empty()).then(|| (0..room).map(mark).collect())
}

/// `width` columns, each as high as the largest value of its time.
fn strip(values: &[Option<f64>], width: usize) -> String {
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

/// How far any value may be off by the alignment of two clocks; nothing on one.
fn bound_words(bound_s: Option<f64>) -> String {
    let bound_s = bound_s.filter(|bound_s| *bound_s > 0.0);
    bound_s.map_or_else(String::new, |bound_s| format!(" ±{}", duration_s(bound_s)))
}

/// The largest value of the row.
fn scale(row: &TimelineRow) -> String {
    let Some(largest) = row.values.iter().flatten().copied().reduce(f64::max) else {
        return "unavailable".to_owned();
    };
    match row.unit.as_str() {
        _ if largest <= 0.0 => "none".to_owned(),
        "s" => duration_s(largest) + &bound_words(row.bound),
        "1" if matches!(row.subject, TimelineSubject::Channel { .. }) => percent(largest),
        "1" => figure(largest),
        unit => format!("{} {unit}", figure(largest)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link_change::ChangedTo;
    use crate::terminal::Style;
    use hil_link::spec::Way;

    #[test]
    fn a_strip_keeps_the_highest_value_of_each_column() {
        let values = [Some(0.0), Some(1.0), None, None, Some(8.0), Some(2.0)];
        assert_eq!(strip(&values, 3), "▁·█");
        assert_eq!(strip(&values, 6), " ▁··█▂");
        assert_eq!(strip(&values[..2], 4), "  ██");
        assert_eq!(strip(&[Some(0.0); 4], 4), "    ");
    }

    #[test]
    fn network_and_robot_share_one_axis() {
        let row = |subject, unit: &str, at: usize, value: f64| TimelineRow {
            subject,
            unit: unit.to_owned(),
            values: (0..120)
                .map(|step| Some(if step == at { value } else { 0.0 }))
                .collect(),
            bound: (unit == "s").then_some(15e-6),
        };
        let of_channel = |quantity| TimelineSubject::Channel {
            channel: "shuttle/command".to_owned(),
            quantity,
        };
        let robot = TimelineSubject::Robot {
            label: "error of the cart's speed".to_owned(),
        };
        let all = Timeline {
            step_s: 0.1,
            rows: vec![
                row(of_channel(NetworkQuantity::Loss), "1", 30, 1.0),
                row(of_channel(NetworkQuantity::Silence), "s", 35, 0.812),
                row(robot, "m/s", 40, 1.1),
            ],
        };
        for width in [80, 100] {
            let mut canvas = Canvas::new(width, Style::Plain);
            let change = LinkChange {
                link: "hop".to_owned(),
                way: Way::Forward,
                number: 1,
                at_s: Some(3.0),
                unsure_s: 0.0,
                to: ChangedTo::Cut,
                refused: None,
            };
            timeline(&mut canvas, &all, &[change]);
            let page = canvas.finish();
            let rows: Vec<&str> = page.lines().collect();
            assert!(
                rows.iter().all(|row| row.chars().count() <= width),
                "{page}"
            );
            let place = |row: &str| row.chars().position(|c| c == '█').unwrap();
            assert!(
                place(rows[2]) < place(rows[3]) && place(rows[3]) < place(rows[4]),
                "{page}"
            );
            assert!(rows[4].contains("error of the cart's speed"), "{page}");
            let changed = rows[5].chars().position(|c| c == '^').unwrap();
            assert!(changed.abs_diff(place(rows[2])) <= 1, "{page}");
            assert!(
                rows[3].ends_with("812 ms ±15.0 µs") && rows[6].contains("6.000 s"),
                "{page}"
            );
        }
    }
}
