//! How many messages were lost in a row, and how often.

use hil_account::BurstCount;

use super::{Frame, HALF_WIDTH};
use crate::page::axis::{Axis, Unit};
use crate::page::svg::{Anchor, Svg};
use hil_platform::text::grouped;

/// Lengths that get a bar of their own; beyond, a bar reaches to the next power of two.
const SINGLE_MAX: u64 = 4;

/// Bars: their words, and how many runs of losses they hold.
fn bars(runs: &[BurstCount]) -> Vec<(String, u64)> {
    let mut bars: Vec<((u64, u64), u64)> = Vec::new();
    let longest = runs
        .iter()
        .map(|run| run.length_messages)
        .max()
        .unwrap_or(0);
    let mut from = 1;
    while from <= longest {
        let until = if from <= SINGLE_MAX {
            from
        } else {
            (from - 1).saturating_mul(2)
        };
        let within = runs
            .iter()
            .filter(|run| (from..=until).contains(&run.length_messages));
        bars.push(((from, until), within.map(|run| run.count).sum()));
        from = until.saturating_add(1);
    }
    let words = bars.into_iter().map(|((from, until), count)| {
        let words = if from == until {
            grouped(from)
        } else {
            format!("{from}–{until}")
        };
        (words, count)
    });
    words.collect()
}

/// The figure; `None` when nothing was lost.
pub(in crate::page) fn loss_bursts(title: &str, runs: &[BurstCount]) -> Option<String> {
    let bars = bars(runs);
    let most = bars
        .iter()
        .map(|(_, count)| *count)
        .max()
        .filter(|most| *most > 0)?;
    let frame = Frame {
        left: 64.0,
        top: 22.0,
        right: HALF_WIDTH - 14.0,
        bottom: 252.0,
    };
    let mut svg = Svg::new(HALF_WIDTH, frame.bottom + 42.0);
    let y_axis = Axis::linear(0.0, most as f64, frame.bottom, frame.top);
    frame.y_axis(&mut svg, &y_axis, Unit::Count);
    let pitch = (frame.right - frame.left) / bars.len() as f64;
    for (index, (words, count)) in bars.iter().enumerate() {
        let middle = frame.left + (index as f64 + 0.5) * pitch;
        let width = (pitch * 0.7).min(48.0);
        if *count > 0 {
            let top = y_axis.at(*count as f64).min(frame.bottom - 1.0);
            let left = middle - width / 2.0;
            svg.rect("bar", left, top, width, frame.bottom - top, "");
            svg.text("", middle, top - 4.0, Anchor::Middle, &grouped(*count));
        }
        // Words of neighbours must not run into each other.
        if bars.len() <= 9 || index % 2 == 0 {
            svg.text("faint", middle, frame.bottom + 16.0, Anchor::Middle, words);
        }
    }
    svg.line("axis", frame.left, frame.bottom, frame.right, frame.bottom);
    let middle = f64::midpoint(frame.left, frame.right);
    let words = "messages lost in a row; bars: how often";
    svg.text("faint", middle, frame.bottom + 34.0, Anchor::Middle, words);
    Some(svg.finish(title, &[]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_runs_share_bars_and_none_is_left_out() {
        let runs = [(1, 50), (3, 2), (6, 1), (1_000, 4)];
        let runs = runs.map(|(length_messages, count)| BurstCount {
            length_messages,
            count,
        });
        let bars = bars(&runs);
        assert_eq!(bars[4], ("5–8".to_owned(), 1));
        assert_eq!(bars.last(), Some(&("513–1024".to_owned(), 4)));
        assert_eq!(bars.iter().map(|(_, count)| count).sum::<u64>(), 57);
        assert!(loss_bursts("t", &runs).is_some());
        assert_eq!(loss_bursts("t", &[]), None);
    }
}
