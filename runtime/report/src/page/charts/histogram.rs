//! How often which delays occurred: the bins of the summary as they are, never thinned. Bins are equally
//! wide on the logarithmic axis.

use hil_stats::histogram::DurationBin;

use super::{Frame, HALF_WIDTH};
use crate::page::axis::{Axis, Unit};
use crate::page::svg::Svg;
use hil_platform::text::grouped;
use hil_present::units::duration;

/// The figure; `None` without a bin above zero.
pub(in crate::page) fn delay_histogram(title: &str, bins: &[DurationBin]) -> Option<String> {
    let drawn: Vec<&DurationBin> = bins.iter().filter(|bin| bin.until_ns > 0).collect();
    let (first, last) = (drawn.first()?, drawn.last()?);
    let most = drawn.iter().map(|bin| bin.count).max()?;
    let frame = Frame {
        left: 64.0,
        top: 12.0,
        right: HALF_WIDTH - 14.0,
        bottom: 252.0,
    };
    let low = (first.from_ns() as f64).max(1.0);
    let mut svg = Svg::new(HALF_WIDTH, frame.bottom + 42.0);
    let x_axis = Axis::logarithmic(low, last.until_ns as f64, frame.left, frame.right);
    let y_axis = Axis::linear(0.0, most as f64, frame.bottom, frame.top);
    frame.x_axis(
        &mut svg,
        &x_axis,
        Unit::Nanoseconds,
        "time, logarithmic; bars: messages",
    );
    frame.y_axis(&mut svg, &y_axis, Unit::Count);
    for bin in drawn {
        let (left, right) = (
            x_axis.at(bin.from_ns() as f64),
            x_axis.at(bin.until_ns as f64),
        );
        // A single message among a million must still be seen.
        let top = y_axis.at(bin.count as f64).min(frame.bottom - 1.0);
        let words = format!(
            "{} to {}: {}",
            duration(bin.from_ns()),
            duration(bin.until_ns),
            grouped(bin.count)
        );
        let width = (right - left - 0.6).max(1.0);
        svg.rect("bar", left, top, width, frame.bottom - top, &words);
    }
    Some(svg.finish(title, &[]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_bin_is_a_bar() {
        let bins: Vec<_> = [(1_000, 1_000_000), (1_122, 1), (8_912_509, 1)]
            .map(|(until_ns, count)| DurationBin { until_ns, count })
            .to_vec();
        let svg = delay_histogram("t", &bins).unwrap();
        assert_eq!(svg.matches("class=\"bar\"").count(), 3);
        assert!(svg.contains("1,000,000"), "{svg}");
        assert_eq!(delay_histogram("t", &[]), None);
    }
}
