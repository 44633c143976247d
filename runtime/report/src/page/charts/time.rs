//! Panels over one axis of time: network above, robot below. Each panel has its own values; the page's
//! cursor reads all of them at once.

use super::{FULL_WIDTH, Frame, legend, legend_height, path_through};
use crate::page::axis::{Axis, Unit};
use crate::page::series::{Plot, PlotPanel, Thinned};
use crate::page::svg::{Anchor, Svg, line_class};

const LEFT: f64 = 76.0;
const RIGHT: f64 = FULL_WIDTH - 14.0;
const PANEL_HEIGHT: f64 = 118.0;

/// Something that happened at a moment or over a time.
#[derive(Debug, Clone)]
pub(in crate::page) struct Mark {
    pub(in crate::page) from_s: f64,
    /// `None` for a moment.
    pub(in crate::page) until_s: Option<f64>,
    /// What it marks.
    pub(in crate::page) class: MarkClass,
    pub(in crate::page) channel: String,
    pub(in crate::page) words: String,
}

impl Mark {
    /// Something of no channel that happened at `at_s`.
    pub(in crate::page) const fn moment(at_s: f64, class: MarkClass, words: String) -> Self {
        Self {
            from_s: at_s,
            until_s: None,
            class,
            channel: String::new(),
            words,
        }
    }
}

hil_core::labelled! {
    /// What a mark of a figure over time stands for.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub(in crate::page) enum MarkClass, word {
        /// A grave event of the score.
        Incident = "incident",
        /// A dangerous one.
        Hazard = "hazard",
        /// Any other one.
        Notice = "notice",
        /// A link that was changed by hand.
        Change = "change",
        /// A time in which nothing got through.
        Band = "band",
    }
}

/// The figure: panels, and below them a row of marks for what happened to the robot.
pub(in crate::page) fn over_time(
    name: &str,
    title: &str,
    plot: &Plot,
    bands: &[Mark],
    moments: &[Mark],
) -> String {
    let axis = Axis::linear(plot.from_s, plot.until_s, LEFT, RIGHT);
    let colours = Colours::of(plot);
    let legends: Vec<_> = plot
        .panels
        .iter()
        .map(|panel| colours.entries(panel))
        .collect();
    let heights = legends
        .iter()
        .map(|entries| 24.0 + legend_height(entries, LEFT, RIGHT) + PANEL_HEIGHT + 8.0);
    let marks_height = if moments.is_empty() { 0.0 } else { 52.0 };
    let height = heights.sum::<f64>() + marks_height;
    let mut svg = Svg::new(FULL_WIDTH, height + 46.0);
    let clip = format!("clip-{name}");
    svg.clip(&clip, LEFT, 0.0, RIGHT - LEFT, height);
    let url = format!("url(#{clip})");
    let mut top = 0.0;
    for (panel, entries) in plot.panels.iter().zip(&legends) {
        svg.text("strong", 8.0, top + 15.0, Anchor::Start, &panel.title);
        let below = top + 33.0;
        let used = legend(&mut svg, LEFT, below, RIGHT, entries);
        let frame = Frame {
            left: LEFT,
            top: below + used - 12.0,
            right: RIGHT,
            bottom: below + used - 12.0 + PANEL_HEIGHT,
        };
        draw_panel(&mut svg, panel, &colours, frame, &axis, &url, bands);
        top += 24.0 + used + PANEL_HEIGHT + 8.0;
    }
    if !moments.is_empty() {
        draw_moments(&mut svg, moments, top, &axis, &url);
    }
    let bottom = Frame {
        left: LEFT,
        top: height - 4.0,
        right: RIGHT,
        bottom: height,
    };
    svg.open(&[("class", "time-axis")]);
    bottom.x_axis(&mut svg, &axis, Unit::Seconds, "seconds");
    svg.close();
    let number = |value: f64| format!("{value}");
    svg.finish(
        title,
        &[
            ("id", name.to_owned()),
            ("data-axis", plot.axis.clone()),
            ("data-from", number(plot.from_s)),
            ("data-until", number(plot.until_s)),
            ("data-left", number(LEFT)),
            ("data-right", number(RIGHT)),
            ("data-bottom", number(height)),
        ],
    )
}

fn draw_moments(svg: &mut Svg, moments: &[Mark], top: f64, axis: &Axis, url: &str) {
    let is_change = |mark: &Mark| mark.class == MarkClass::Change;
    let title = if moments.iter().all(is_change) {
        "Links changed by hand (dashed)"
    } else if moments.iter().any(is_change) {
        "What happened to the robot, and links changed by hand (dashed)"
    } else {
        "What happened to the robot"
    };
    svg.text("strong", 8.0, top + 15.0, Anchor::Start, title);
    svg.open(&[("clip-path", url)]);
    svg.open(&[("class", "zoom")]);
    for mark in moments {
        let y = match mark.class {
            MarkClass::Change => top + 18.0,
            MarkClass::Incident | MarkClass::Hazard | MarkClass::Band => top + 22.0,
            MarkClass::Notice => top + 30.0,
        };
        let x = axis.at(mark.from_s);
        svg.line(mark.class.word(), x, y, x, top + 44.0);
    }
    svg.close();
    svg.close();
}

/// Which colour each channel has, the same in every panel.
struct Colours {
    channels: Vec<String>,
}

impl Colours {
    fn of(plot: &Plot) -> Self {
        let mut channels: Vec<String> = Vec::new();
        for one in plot.panels.iter().flat_map(|panel| &panel.series) {
            if !one.channel.is_empty() && !channels.contains(&one.channel) {
                channels.push(one.channel.clone());
            }
        }
        Self { channels }
    }

    fn class(&self, one: &Thinned, index: usize) -> String {
        let place = self.channels.iter().position(|name| *name == one.channel);
        line_class(place.unwrap_or(index))
    }

    /// A line that its panel's title names needs no legend.
    fn entries(&self, panel: &PlotPanel) -> Vec<(String, String)> {
        if let [one] = panel.series.as_slice()
            && one.channel.is_empty()
            && panel.title.contains(&one.name)
        {
            return Vec::new();
        }
        let entry = |(index, one): (usize, &Thinned)| (self.class(one, index), one.name.clone());
        panel.series.iter().enumerate().map(entry).collect()
    }
}

/// A ratio of largest to smallest above which a panel of lengths is logarithmic.
const WIDE_RATIO: f64 = 60.0;

fn value_axis(panel: &PlotPanel, frame: Frame) -> (Axis, Unit) {
    let lows = panel.series.iter().flat_map(|one| one.low.iter().flatten());
    let highs = panel
        .series
        .iter()
        .flat_map(|one| one.high.iter().flatten());
    let values = || lows.clone().chain(highs.clone()).copied();
    let (low, high) = (
        values().fold(f64::INFINITY, f64::min),
        values().fold(f64::NEG_INFINITY, f64::max),
    );
    let unit = Unit::of(&panel.unit);
    let (bottom, top) = (frame.bottom, frame.top + 4.0);
    if !low.is_finite() || !high.is_finite() {
        return (Axis::linear(0.0, 1.0, bottom, top), unit);
    }
    let least = values()
        .filter(|value| *value > 0.0)
        .fold(f64::INFINITY, f64::min);
    if unit == Unit::Length && low >= 0.0 && high > least * WIDE_RATIO {
        return (Axis::logarithmic(least, high, bottom, top), unit);
    }
    let low = if low >= 0.0 && low < high * 0.8 {
        0.0
    } else {
        low
    };
    let margin = (high - low) * 0.04;
    let low = if low < 0.0 { low - margin } else { low };
    (Axis::linear(low, high + margin, bottom, top), unit)
}

fn draw_panel(
    svg: &mut Svg,
    panel: &PlotPanel,
    colours: &Colours,
    frame: Frame,
    time: &Axis,
    url: &str,
    bands: &[Mark],
) {
    let (axis, unit) = value_axis(panel, frame);
    frame.y_axis(svg, &axis, unit);
    svg.rect(
        "panel",
        frame.left,
        frame.top,
        frame.right - frame.left,
        frame.bottom - frame.top,
        "",
    );
    svg.open(&[("clip-path", url)]);
    svg.open(&[("class", "zoom")]);
    for band in bands
        .iter()
        .filter(|_| panel.series.iter().any(|one| !one.channel.is_empty()))
    {
        let left = time.at(band.from_s);
        let right = time.at(band.until_s.unwrap_or(time.ends().1));
        let width = (right - left).max(1.0);
        svg.open(&[("data-channel", &band.channel)]);
        svg.rect(
            "band",
            left,
            frame.top,
            width,
            frame.bottom - frame.top,
            &band.words,
        );
        svg.close();
    }
    for (index, one) in panel.series.iter().enumerate() {
        svg.open(&[("data-channel", &one.channel)]);
        let class = colours.class(one, index);
        svg.path(&class, &line_of(one, time, &axis));
        svg.close();
    }
    svg.close();
    svg.close();
}

/// From low to high within each step, and on to the next; single steps get a short dash.
fn line_of(one: &Thinned, time: &Axis, axis: &Axis) -> String {
    let count = one.high.len() as f64;
    let (from, until) = time.ends();
    let width = (until - from) / count;
    let mut points = Vec::with_capacity(one.high.len() * 2);
    for (index, high) in one.high.iter().enumerate() {
        let Some(high) = high else {
            points.push(None);
            continue;
        };
        let at = |part: f64| time.at(from + (index as f64 + part) * width);
        let low = one.low.get(index).copied().flatten().unwrap_or(*high);
        let is_same = (low - high).abs() < f64::EPSILON * high.abs();
        let has_neighbour = [index.wrapping_sub(1), index + 1]
            .iter()
            .any(|near| one.high.get(*near).is_some_and(Option::is_some));
        if !is_same {
            points.push(Some((at(0.5), axis.at(low))));
            points.push(Some((at(0.5), axis.at(*high))));
        } else if has_neighbour {
            points.push(Some((at(0.5), axis.at(*high))));
        } else {
            points.push(Some((at(0.0), axis.at(*high))));
            points.push(Some((at(1.0), axis.at(*high))));
        }
    }
    path_through(points.into_iter())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plot(values: Vec<Option<f64>>) -> Plot {
        Plot {
            axis: "run-1".to_owned(),
            from_s: 0.0,
            until_s: 10.0,
            panels: vec![PlotPanel {
                title: "delay <x>".to_owned(),
                unit: "s".to_owned(),
                series: vec![Thinned {
                    name: "arm/command".to_owned(),
                    channel: "arm/command".to_owned(),
                    high: values,
                    low: Vec::new(),
                }],
            }],
        }
    }

    #[test]
    fn gaps_stay_gaps_and_texts_stay_texts() {
        let mark = Mark::moment(5.0, MarkClass::Incident, String::new());
        let values = vec![Some(0.1), None, Some(0.2), Some(0.3)];
        let svg = over_time("a", "t", &plot(values), &[], &[mark]);
        let path = svg.split("<path").nth(1).unwrap();
        assert_eq!(path.matches('M').count(), 2, "{path}");
        assert!(svg.contains("delay &lt;x&gt;"));
        assert!(svg.contains("class=\"incident\""));
    }

    #[test]
    fn a_panel_without_a_value_is_drawn_empty() {
        let svg = over_time("a", "t", &plot(vec![None, None]), &[], &[]);
        assert!(!svg.contains("<path"), "{svg}");
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
