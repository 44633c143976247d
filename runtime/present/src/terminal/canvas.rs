//! Text of a fixed width: padding, wrapping, bars and colours. It knows no numbers.

use anstyle::{AnsiColor, Style as Ansi};

use crate::model::Tone;
use crate::units::JOINT;
use hil_platform::text::{clean, columns, shortened};

/// Whether the text carries colour sequences.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Style {
    /// Text only.
    Plain,
    /// With ANSI sequences. A caller that prints through `anstream` gets `NO_COLOR` and pipes
    /// right by itself.
    Coloured,
}

/// Narrowest and widest page.
const WIDTH_MIN: usize = 80;
const WIDTH_MAX: usize = 120;

/// Left margin of everything below a heading.
pub const INDENT: usize = 2;

/// Eighths of a block, thinnest first.
const EIGHTHS: [char; 8] = ['▏', '▎', '▍', '▌', '▋', '▊', '▉', '█'];

/// A growing page.
#[derive(Debug)]
pub struct Canvas {
    text: String,
    width: usize,
    has_whole_tables: bool,
    style: Style,
}

impl Canvas {
    /// An empty one of `width` columns, clamped to 80..=120.
    pub fn new(width: usize, style: Style) -> Self {
        Self {
            text: String::new(),
            width: width.clamp(WIDTH_MIN, WIDTH_MAX),
            has_whole_tables: false,
            style,
        }
    }

    /// With tables as wide as they need to be.
    #[must_use]
    pub const fn with_whole_tables(mut self) -> Self {
        self.has_whole_tables = true;
        self
    }

    /// Columns that a table may take; `None` where it may take as many as it needs.
    pub(crate) const fn table_room(&self) -> Option<usize> {
        if self.has_whole_tables {
            None
        } else {
            Some(self.width - INDENT)
        }
    }

    /// Columns of a line.
    pub const fn width(&self) -> usize {
        self.width
    }

    /// The text.
    pub fn finish(self) -> String {
        self.text
    }

    /// `text` in `tone`; call it after padding, since sequences have no width. Padding stays
    /// unpainted, so that a line's trailing blanks can be dropped in both styles.
    pub fn paint(&self, tone: Tone, text: &str) -> String {
        let (shown, padding) = text.split_at(text.trim_end().len());
        let ansi = match tone {
            _ if self.style == Style::Plain || shown.is_empty() => return text.to_owned(),
            Tone::Plain => return text.to_owned(),
            Tone::Strong => Ansi::new().bold(),
            Tone::Good => Ansi::new().bold().fg_color(Some(AnsiColor::Green.into())),
            Tone::Caution => Ansi::new().fg_color(Some(AnsiColor::Yellow.into())),
            Tone::Bad => Ansi::new().bold().fg_color(Some(AnsiColor::Red.into())),
            Tone::Faint => Ansi::new().dimmed(),
            Tone::Chosen => Ansi::new().invert(),
            Tone::Bar => Ansi::new().fg_color(Some(AnsiColor::Cyan.into())),
        };
        format!("{}{shown}{}{padding}", ansi.render(), ansi.render_reset())
    }

    /// Ends a line; trailing blanks are dropped.
    pub fn line(&mut self, line: &str) {
        let line = line.replace(JOINT, " ");
        self.text.push_str(line.trim_end());
        self.text.push('\n');
    }

    /// A whole line in `tone`.
    pub fn painted_line(&mut self, tone: Tone, text: &str) {
        let line = self.paint(tone, text);
        self.line(&line);
    }

    /// An empty line.
    pub fn blank(&mut self) {
        self.text.push('\n');
    }

    /// A rule across the page.
    pub fn rule(&mut self, tone: Tone) {
        self.painted_line(tone, &"─".repeat(self.width));
    }

    /// A heading, with something faint beside it.
    pub fn heading(&mut self, title: &str, aside: &str) {
        self.heading_at(0, title, aside);
    }

    /// A heading below another one.
    pub fn subheading(&mut self, title: &str, aside: &str) {
        self.heading_at(INDENT, title, aside);
    }

    fn heading_at(&mut self, margin: usize, title: &str, aside: &str) {
        self.blank();
        let width = self.width - margin;
        let title = shortened(title, width);
        // What has no room beside the title stands below it.
        let (beside, below) = if columns(&title) + 2 + columns(aside) <= width {
            (aside, "")
        } else {
            ("", aside)
        };
        let line = format!(
            "{:margin$}{}  {}",
            "",
            self.paint(Tone::Strong, &title),
            self.paint(Tone::Faint, beside)
        );
        self.line(&line);
        if !below.is_empty() {
            self.paragraph(margin + INDENT, Tone::Faint, below);
        }
    }

    /// A label in a column of `label_width`, and a text that wraps beside it.
    pub fn field_of(&mut self, label_width: usize, label: &str, tone: Tone, text: &str) {
        self.field_at(INDENT, label_width, label, tone, text);
    }

    /// As [`Canvas::field_of`], behind `margin` columns.
    pub fn field_at(
        &mut self,
        margin: usize,
        label_width: usize,
        label: &str,
        tone: Tone,
        text: &str,
    ) {
        // A label that has no room stands on lines of its own.
        let label = if columns(label) < label_width {
            label
        } else {
            self.paragraph(margin, Tone::Faint, label);
            ""
        };
        let label = self.paint(Tone::Faint, &left(label, label_width));
        let lead = format!("{:margin$}{label}", "");
        self.behind(&lead, margin + label_width, tone, text);
    }

    /// `lead`, which takes `margin` columns and may be painted, and a text in `tone` that wraps behind it.
    pub fn behind(&mut self, lead: &str, margin: usize, tone: Tone, text: &str) {
        let blank = " ".repeat(margin);
        let rows = wrapped(text, self.width.saturating_sub(margin).max(20));
        for (index, row) in rows.iter().enumerate() {
            let lead = if index == 0 { lead } else { &blank };
            let line = format!("{lead}{}", self.paint(tone, row));
            self.line(&line);
        }
    }

    /// A paragraph behind a blank margin.
    pub fn paragraph(&mut self, margin: usize, tone: Tone, text: &str) {
        self.behind(&" ".repeat(margin), margin, tone, text);
    }
}

/// Exactly `width` columns, text at the left.
pub fn left(text: &str, width: usize) -> String {
    let text = shortened(text, width);
    let padding = width - columns(&text);
    format!("{text}{:padding$}", "")
}

/// Exactly `width` columns, text at the right.
pub fn right(text: &str, width: usize) -> String {
    let text = shortened(text, width);
    let padding = width - columns(&text);
    format!("{:padding$}{text}", "")
}

/// Rows of at most `width` columns, broken at blanks, or anywhere in a longer word.
pub fn wrapped(text: &str, width: usize) -> Vec<String> {
    let (mut rows, mut row) = (Vec::new(), String::new());
    for word in clean(text).split(' ').filter(|word| !word.is_empty()) {
        let mut word: Vec<char> = word.chars().collect();
        if !row.is_empty() && columns(&row) + 1 + word.len() > width {
            rows.push(core::mem::take(&mut row));
        }
        while word.len() > width {
            let rest = word.split_off(width);
            rows.push(word.into_iter().collect());
            word = rest;
        }
        if !row.is_empty() {
            row.push(' ');
        }
        row.extend(word);
    }
    if !row.is_empty() || rows.is_empty() {
        rows.push(row);
    }
    rows
}

/// A bar from `start` to `end` on a scale of 0..=1 over `width` columns. It begins at a whole
/// column and ends at an eighth; anything above nothing is visible.
pub fn bar(start: f64, end: f64, width: usize) -> String {
    let unit = 8 * width as u64;
    let at = |share: f64| eighths(share.clamp(0.0, 1.0) * unit as f64, unit);
    let (first, last) = (at(start) / 8, at(end));
    if start.is_nan() || end.is_nan() || end <= start || width == 0 {
        return String::new();
    }
    let first = first.min(width as u64 - 1);
    let length = last.saturating_sub(first * 8).max(1);
    let mut text = " ".repeat(usize::try_from(first).unwrap_or(width));
    text.extend((0..length / 8).map(|_| EIGHTHS[7]));
    if length % 8 > 0 {
        text.push(EIGHTHS[usize::try_from(length % 8 - 1).unwrap_or(0)]);
    }
    text
}

#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "the value lies in 0..=limit, and NaN becomes 0"
)]
fn eighths(value: f64, limit: u64) -> u64 {
    (value.round() as u64).min(limit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bars_start_and_end_where_they_should() {
        assert_eq!(bar(0.0, 1.0, 4), "████");
        assert_eq!(bar(0.5, 1.0, 4), "  ██");
        assert_eq!(bar(0.0, 0.5 / 4.0, 4), "▌");
        assert_eq!(bar(0.0, 1e-9, 4), "▏");
        assert_eq!(bar(1.0 - 1e-9, 1.0, 4), "   █");
        assert_eq!(bar(0.3, 0.3, 4), "");
        assert_eq!(bar(f64::NAN, f64::NAN, 4), "");
        assert_eq!(bar(0.0, 1.0, 0), "");
    }

    #[test]
    fn rows_never_exceed_their_width() {
        let text = "a word and averyveryverylongwordwithoutanyblank and \u{1b}[31m more";
        for width in 1..60 {
            for row in wrapped(text, width) {
                assert!(columns(&row) <= width, "{row:?} in {width}");
                assert!(!row.contains('\u{1b}'));
            }
        }
        assert_eq!(wrapped("", 10), [""]);
    }

    #[test]
    fn what_has_no_room_beside_a_title_stands_whole_below_it() {
        let drawn = |aside: &str| {
            let mut canvas = Canvas::new(80, Style::Plain);
            canvas.heading("Robot, and the network before it", aside);
            canvas.finish()
        };
        let aside = "1 incident (must not happen), 1 hazard (nearly one), 0 notices";
        let title = "\nRobot, and the network before it";
        assert_eq!(drawn("1 incident"), format!("{title}  1 incident\n"));
        assert_eq!(drawn(aside), format!("{title}\n  {aside}\n"));
    }

    #[test]
    fn a_label_without_room_never_runs_into_its_value() {
        let drawn = |label: &str| {
            let mut canvas = Canvas::new(80, Style::Plain);
            canvas.field_of(10, label, Tone::Plain, "2 of 40");
            canvas.finish()
        };
        assert_eq!(drawn("loops"), "  loops     2 of 40\n");
        assert_eq!(drawn("loops lost"), "  loops lost\n            2 of 40\n");
    }

    #[test]
    fn padding_shortens_what_does_not_fit() {
        assert_eq!(left("robot", 8), "robot   ");
        assert_eq!(right("robot", 8), "   robot");
        assert_eq!(left("controller", 6), "contr…");
        assert_eq!(right("µ→", 0), "");
    }

    #[test]
    fn colours_appear_only_when_asked_for() {
        let plain = Canvas::new(80, Style::Plain);
        assert_eq!(plain.paint(Tone::Bad, "x"), "x");
        let coloured = Canvas::new(80, Style::Coloured);
        assert!(coloured.paint(Tone::Bad, "x").starts_with('\u{1b}'));
        assert_eq!(coloured.paint(Tone::Plain, "x"), "x");
    }
}
