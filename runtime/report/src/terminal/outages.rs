//! The outages of one channel: how many of which length, and the longest.

use hil_account::{LongestOutage, OutageClass, OutageMetrics};

use super::canvas::{Canvas, INDENT, Tone, bar, right};
use super::units::{duration, seconds};
use hil_platform::text::grouped;
use hil_platform::words::{counted, plural};

/// Columns of the label, of a class and of a count, and the gaps beside the bar.
const LABEL_WIDTH: usize = 14;
const CLASS_WIDTH: usize = 16;
const COUNT_WIDTH: usize = 10;
const GAP: usize = 2;

pub(super) fn outages(canvas: &mut Canvas, figures: &OutageMetrics) {
    if figures.outage_count == 0 {
        return;
    }
    canvas.field("outages", Tone::Plain, &total(figures));
    if let Some(longest) = figures.longest {
        canvas.field("", Tone::Plain, &longest_words(longest));
    }
    // Lengths beyond the longest outage have nothing to show.
    let known = figures.outage_count - figures.unknown_length_count.min(figures.outage_count);
    let last = figures
        .classes
        .iter()
        .rposition(|class| class.outage_count > 0);
    let shown = last.map_or(0, |last| last + 1);
    for class in figures.classes.iter().take(shown) {
        line(canvas, class, known);
    }
}

fn total(figures: &OutageMetrics) -> String {
    let count = figures.outage_count;
    let mut text = format!(
        "{} with {} lost, {} in all, from the first lost publication to the next one that arrived",
        grouped(count),
        counted(figures.lost_count, "message"),
        duration(figures.total_ns),
    );
    if figures.unknown_length_count > 0 {
        let unknown = grouped(figures.unknown_length_count);
        let outages = plural(count, "outage");
        text.push_str(&["; ", &unknown, " ", &outages, " of unknown length"].concat());
    }
    text
}

fn longest_words(longest: LongestOutage) -> String {
    let seconds_of = |ns: i64| seconds(ns as f64 * 1e-9);
    let end = longest.start_ns.saturating_add(longest.length_ns);
    let until = if longest.is_open {
        "the end of the run".to_owned()
    } else {
        seconds_of(end)
    };
    format!(
        "longest {}, {} to {until}, {} lost from {} on",
        duration(longest.length_ns),
        seconds_of(longest.start_ns),
        counted(longest.lost_count, "message"),
        grouped(longest.first_sequence),
    )
}

fn line(canvas: &mut Canvas, class: &OutageClass, of: u64) {
    let margin = INDENT + LABEL_WIDTH;
    let bar_width = canvas.width() - margin - CLASS_WIDTH - COUNT_WIDTH - GAP;
    let ratio = class.outage_count as f64 / of.max(1) as f64;
    let line = format!(
        "{:margin$}{}{}{:GAP$}{}",
        "",
        right(&length_words(class), CLASS_WIDTH),
        right(&grouped(class.outage_count), COUNT_WIDTH),
        "",
        canvas.paint(Tone::Bar, &bar(0.0, ratio, bar_width))
    );
    canvas.line(&line);
}

/// The lengths of a class: `100 ms to 500 ms`, below the first and above the last border.
fn length_words(class: &OutageClass) -> String {
    match class.until_ns {
        None => format!("{} and more", border(class.from_ns)),
        Some(until_ns) if class.from_ns == 0 => format!("below {}", border(until_ns)),
        Some(until_ns) => format!("{} to {}", border(class.from_ns), border(until_ns)),
    }
}

fn border(ns: i64) -> String {
    if ns < 1_000_000_000 {
        format!("{} ms", ns as f64 * 1e-6)
    } else {
        format!("{} s", ns as f64 * 1e-9)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::terminal::Style;
    use hil_account::{Outage, OutageMetrics};

    const MS: i64 = 1_000_000;

    #[test]
    fn lengths_are_counted_up_to_the_longest() {
        let lengths_ms = [8, 8, 16, 250, 700, 1_840];
        let found: Vec<_> = lengths_ms
            .iter()
            .map(|length_ms| Outage {
                lost_count: 3,
                first_sequence: 5_150,
                from_ns: Some(41_200 * MS),
                until_ns: Some((41_200 + length_ms) * MS),
                silent_from_ns: None,
                silent_until_ns: None,
                interruption_index: None,
            })
            .collect();
        let figures = OutageMetrics::of(&found, None);
        let mut canvas = Canvas::new(100, Style::Plain);
        outages(&mut canvas, &figures);
        let page = canvas.finish();
        let expected = "  outages       6 with 18 messages lost, 2.82 s in all, from the first lost publication to the next
                one that arrived
                longest 1.84 s, 41.200 s to 43.040 s, 3 messages lost from 5,150 on
                     below 20 ms         3  ████████████████████████████
                 20 ms to 100 ms         0
                100 ms to 500 ms         1  █████████▍
                   500 ms to 1 s         1  █████████▍
                      1 s to 2 s         1  █████████▍
";
        assert_eq!(page, expected, "{page}");
        let mut canvas = Canvas::new(100, Style::Plain);
        outages(&mut canvas, &OutageMetrics::of(&[], None));
        assert_eq!(canvas.finish(), "");
    }
}
