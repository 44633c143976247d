//! How many messages were lost in a row, and how often.

use hil_account::BurstCount;

use super::{Frame, HALF_WIDTH};
use crate::burst_classes::burst_classes;
use crate::page::axis::{Axis, Unit};
use crate::page::svg::{Anchor, Svg};
use hil_platform::text::grouped;

/// The figure; `None` when nothing was lost.
pub(in crate::page) fn loss_bursts(title: &str, runs: &[BurstCount]) -> Option<String> {
    let bars = burst_classes(runs);
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
    fn nothing_is_drawn_of_no_loss() {
        let runs = [BurstCount {
            length_messages: 3,
            count: 2,
        }];
        assert!(loss_bursts("t", &runs).is_some());
        assert_eq!(loss_bursts("t", &[]), None);
    }
}
