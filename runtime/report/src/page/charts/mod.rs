//! The figures of a page, drawn as SVG from figures that are there already. They compute nothing but
//! places.

pub(super) mod bursts;
pub(super) mod cdf;
pub(super) mod histogram;
pub(super) mod time;
pub(super) mod waterfall;

use super::axis::{Axis, Unit};
use super::svg::{Anchor, Svg, px};

/// Width of a figure that shares its row with another one.
const HALF_WIDTH: f64 = 480.0;
/// Width of a figure with a row of its own.
const FULL_WIDTH: f64 = 960.0;

/// The frame of a plot.
#[derive(Debug, Clone, Copy)]
struct Frame {
    left: f64,
    top: f64,
    right: f64,
    bottom: f64,
}

impl Frame {
    /// Lines and words of the horizontal axis, below.
    fn x_axis(self, svg: &mut Svg, axis: &Axis, unit: Unit, title: &str) {
        for (value, word) in axis.ticks(unit) {
            let x = axis.at(value);
            svg.line("grid", x, self.top, x, self.bottom);
            svg.text("faint", x, self.bottom + 16.0, Anchor::Middle, &word);
        }
        svg.line("axis", self.left, self.bottom, self.right, self.bottom);
        let middle = f64::midpoint(self.left, self.right);
        svg.text("faint", middle, self.bottom + 33.0, Anchor::Middle, title);
    }

    /// Lines and words of the vertical axis, to the left.
    fn y_axis(self, svg: &mut Svg, axis: &Axis, unit: Unit) {
        for (value, word) in axis.ticks(unit) {
            let y = axis.at(value);
            svg.line("grid", self.left, y, self.right, y);
            svg.text("faint", self.left - 6.0, y + 4.0, Anchor::End, &word);
        }
    }
}

/// Words of a legend with their marks, in rows of the frame's width; gives its height.
fn legend(svg: &mut Svg, left: f64, top: f64, right: f64, entries: &[(String, String)]) -> f64 {
    let (mut x, mut y) = (left, top);
    for (class, words) in entries {
        // An estimate: the width of a letter is for the reader's font to say.
        let width = 30.0 + 7.0 * words.chars().count() as f64;
        if x > left && x + width > right {
            (x, y) = (left, y + 17.0);
        }
        svg.line(class, x, y - 4.0, x + 18.0, y - 4.0);
        svg.text("", x + 23.0, y, Anchor::Start, words);
        x += width + 6.0;
    }
    y - top + 17.0
}

/// Height that [`legend`] will take.
fn legend_height(entries: &[(String, String)], left: f64, right: f64) -> f64 {
    legend(&mut Svg::new(0.0, 0.0), left, 0.0, right, entries)
}

/// The `d` of a path through points, begun anew after each gap.
fn path_through(points: impl Iterator<Item = Option<(f64, f64)>>) -> String {
    let mut d = String::new();
    let mut is_open = false;
    for point in points {
        let Some((x, y)) = point else {
            is_open = false;
            continue;
        };
        d.push(if is_open { 'L' } else { 'M' });
        d.push_str(&px(x));
        d.push(' ');
        d.push_str(&px(y));
        is_open = true;
    }
    d
}
