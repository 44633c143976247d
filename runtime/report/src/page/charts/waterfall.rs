//! Where the time of a message went: the medians of its segments as one stacked bar per channel, each
//! as long as the others, since a link of milliseconds would hide one of microseconds.

use super::{FULL_WIDTH, legend, legend_height};
use crate::page::svg::{Anchor, COLOUR_COUNT, Svg};
use hil_present::units::{duration, percent};

/// One bar.
#[derive(Debug, Clone)]
pub(in crate::page) struct Bar {
    pub(in crate::page) channel: String,
    /// Segment and its median, nanoseconds, in order; only those that were measured.
    pub(in crate::page) parts: Vec<(String, i64)>,
    /// The median of the whole.
    pub(in crate::page) whole_ns: Option<i64>,
}

/// The figure; `None` without a measured segment.
pub(in crate::page) fn waterfall(title: &str, bars: &[Bar]) -> Option<String> {
    let bars: Vec<&Bar> = bars
        .iter()
        .filter(|bar| bar.parts.iter().any(|part| part.1 > 0))
        .collect();
    if bars.is_empty() {
        return None;
    }
    let mut names: Vec<&str> = Vec::new();
    for (name, _) in bars.iter().flat_map(|bar| &bar.parts) {
        if !names.contains(&name.as_str()) {
            names.push(name);
        }
    }
    let place = |name: &str| names.iter().position(|one| *one == name).unwrap_or(0);
    let colour = |name: &str| {
        // A second round of colours is paler.
        let pale = if place(name) < COLOUR_COUNT {
            ""
        } else {
            " pale"
        };
        format!("{}{pale}", place(name) % COLOUR_COUNT)
    };
    let entries: Vec<(String, String)> = names
        .iter()
        .map(|name| (format!("line whole c{}", colour(name)), (*name).to_owned()))
        .collect();
    let (left, right) = (8.0, FULL_WIDTH - 8.0);
    let top = 10.0 + legend_height(&entries, left, right);
    let mut svg = Svg::new(FULL_WIDTH, top + bars.len() as f64 * 52.0 + 4.0);
    legend(&mut svg, left, 16.0, right, &entries);
    for (index, bar) in bars.iter().enumerate() {
        let y = top + index as f64 * 52.0;
        let total: i64 = bar.parts.iter().map(|part| part.1.max(0)).sum();
        svg.open(&[("data-channel", &bar.channel)]);
        svg.text("strong", left, y + 13.0, Anchor::Start, &bar.channel);
        let whole = bar.whole_ns.map_or_else(
            || "median of the whole unavailable".to_owned(),
            |ns| format!("median of the whole {}", duration(ns)),
        );
        svg.text("faint", right, y + 13.0, Anchor::End, &whole);
        let mut x = left;
        for (name, ns) in &bar.parts {
            let share = (*ns).max(0) as f64 / total as f64;
            let width = share * (right - left);
            let words = format!("{name}: {} ({})", duration(*ns), percent(share));
            let class = format!("f{}", colour(name));
            svg.rect(&class, x, y + 20.0, (width - 0.7).max(0.3), 22.0, &words);
            if width > 64.0 {
                let middle = x + width / 2.0;
                svg.text("inside", middle, y + 35.0, Anchor::Middle, &duration(*ns));
            }
            x += width;
        }
        svg.close();
    }
    Some(svg.finish(title, &[]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bar_has_every_segment_that_was_measured() {
        let bar = |parts: &[(&str, i64)]| Bar {
            channel: "arm/<command>".to_owned(),
            parts: parts
                .iter()
                .map(|(name, ns)| ((*name).to_owned(), *ns))
                .collect(),
            whole_ns: Some(1_100),
        };
        let svg = waterfall(
            "t",
            &[bar(&[("a → b", 1_000), ("b → c", 0), ("c → d", 100)])],
        )
        .unwrap();
        assert_eq!(svg.matches("<rect").count(), 3);
        assert!(svg.contains("arm/&lt;command&gt;"), "{svg}");
        assert_eq!(waterfall("t", &[bar(&[])]), None);
    }
}
