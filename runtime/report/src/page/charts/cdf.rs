//! How delays are distributed: one step curve per segment, over a logarithmic axis of time and an
//! axis of shares whose steps are nines, so that the tail is as readable as the median.

use hil_stats::histogram::DurationBin;

use super::{Frame, HALF_WIDTH, legend, legend_height, path_through};
use crate::page::axis::{Axis, Unit};
use crate::page::svg::{Svg, line_class};

/// One curve.
#[derive(Debug, Clone)]
pub(in crate::page) struct Curve<'a> {
    pub(in crate::page) label: String,
    pub(in crate::page) bins: &'a [DurationBin],
    /// The sum of the others.
    pub(in crate::page) is_whole: bool,
}

/// Delay above 0 and the share of values up to it.
fn steps(curve: &Curve<'_>) -> Vec<(f64, f64)> {
    let total: u64 = curve.bins.iter().map(|bin| bin.count).sum();
    let mut sum = 0;
    let mut points = Vec::with_capacity(curve.bins.len() * 2);
    for bin in curve.bins {
        points.push((bin.from_ns() as f64, sum as f64 / total as f64));
        sum += bin.count;
        points.push((bin.until_ns as f64, sum as f64 / total as f64));
    }
    points
}

/// The figure; `None` when no curve has a value above zero.
pub(in crate::page) fn delay_cdf(title: &str, curves: &[Curve<'_>]) -> Option<String> {
    let drawn: Vec<(&Curve<'_>, Vec<(f64, f64)>)> = curves
        .iter()
        .map(|curve| (curve, steps(curve)))
        .filter(|(_, points)| points.iter().any(|(ns, _)| *ns > 0.0))
        .collect();
    let values = drawn.iter().flat_map(|(_, points)| points);
    let values = values.map(|(ns, _)| *ns).filter(|ns| *ns >= 1.0);
    let (low, high) = values.fold((f64::MAX, 0.0_f64), |(low, high), ns| {
        (low.min(ns), high.max(ns))
    });
    if drawn.is_empty() || high < 1.0 {
        return None;
    }
    let classes = drawn.iter().enumerate().map(|(index, (curve, _))| {
        let whole = if curve.is_whole { " whole" } else { "" };
        let class = if curve.is_whole {
            "line c6".to_owned()
        } else {
            line_class(index)
        };
        (format!("{class}{whole}"), curve.label.clone())
    });
    let entries: Vec<(String, String)> = classes.collect();
    let top = 8.0 + legend_height(&entries, 8.0, HALF_WIDTH - 8.0);
    let frame = Frame {
        left: 64.0,
        top,
        right: HALF_WIDTH - 14.0,
        bottom: top + 240.0,
    };
    let mut svg = Svg::new(HALF_WIDTH, frame.bottom + 42.0);
    legend(&mut svg, 8.0, 16.0, HALF_WIDTH - 8.0, &entries);
    let counts = drawn
        .iter()
        .map(|(curve, _)| curve.bins.iter().map(|bin| bin.count).sum::<u64>());
    let most = counts.max().unwrap_or(1).max(2) as f64;
    let nines = most.log10().clamp(2.0, 6.0);
    let x_axis = Axis::logarithmic(low, high, frame.left, frame.right);
    let y_axis = Axis::nines(nines, frame.bottom, frame.top + 6.0);
    frame.x_axis(&mut svg, &x_axis, Unit::Nanoseconds, "time, logarithmic");
    frame.y_axis(&mut svg, &y_axis, Unit::Share);
    for ((_, points), (class, _)) in drawn.iter().zip(&entries) {
        let places = points
            .iter()
            .map(|(ns, share)| Some((x_axis.at(*ns), y_axis.at(*share))));
        svg.path(class, &path_through(places));
    }
    Some(svg.finish(title, &[]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(bins: &[DurationBin]) -> Curve<'_> {
        Curve {
            label: "a → b".to_owned(),
            bins,
            is_whole: false,
        }
    }

    #[test]
    fn a_curve_climbs_to_one_and_nothing_is_drawn_of_nothing() {
        let bins =
            [(1_000, 3), (1_122, 1)].map(|(until_ns, count)| DurationBin { until_ns, count });
        let points = steps(&curve(&bins));
        assert_eq!(points.first(), Some(&(891.0, 0.0)));
        assert_eq!(points[1], (1_000.0, 0.75));
        assert_eq!(points.last(), Some(&(1_122.0, 1.0)));
        assert!(delay_cdf("t", &[curve(&bins)]).unwrap().contains("<path"));
        assert_eq!(delay_cdf("t", &[curve(&[])]), None);
        let negative = [DurationBin {
            until_ns: -5,
            count: 2,
        }];
        assert_eq!(delay_cdf("t", &[curve(&negative)]), None);
    }
}
