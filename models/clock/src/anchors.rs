//! The estimate: through the exchanges with the smallest round trips, assumed to have taken equally
//! long both ways. It guarantees nothing.

use super::ClockSettings;
use super::exchange::{Constraint, Edge};

/// Parts of a line whose slopes are compared.
const PART_COUNT: usize = 4;

/// One point of the estimate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Anchor {
    pub(super) middle: Edge,
    pub(super) rtt_ns: i64,
}

/// A line through anchors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Line {
    /// Gain of the offset per nanosecond of the other host's clock.
    pub(super) slope: f64,
    /// Standard error of the slope, at least that of the mean of a slope that changes with time.
    pub(super) slope_error: f64,
}

/// The estimate over one stretch.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Anchors {
    pub(super) points: Vec<Anchor>,
    line: Option<Line>,
}

impl Anchors {
    /// Of the exchanges of one stretch, in order of time.
    pub(super) fn new(constraints: &[Constraint], settings: &ClockSettings) -> Self {
        let mut points: Vec<Anchor> = Vec::new();
        let mut window = i64::MIN;
        for one in constraints {
            let anchor = Anchor {
                middle: one.middle(),
                rtt_ns: one.rtt_ns,
            };
            let of = anchor.middle.at_ns.div_euclid(settings.window_ns.max(1));
            match points.last_mut() {
                Some(last) if of == window => {
                    if anchor.rtt_ns < last.rtt_ns {
                        *last = anchor;
                    }
                }
                _ => points.push(anchor),
            }
            window = of;
        }
        let points = undominated(&points, settings);
        let line = line(&points);
        Self { points, line }
    }

    pub(super) const fn line(&self) -> Option<Line> {
        self.line
    }

    /// The estimated offset at `at_ns`, between its neighbours or beyond the ends by the line.
    pub(super) fn offset_at(&self, at_ns: i64) -> Option<i64> {
        let next = self
            .points
            .partition_point(|point| point.middle.at_ns < at_ns);
        let beyond = |end: &Anchor| {
            let slope = self.line.map_or(0.0, |line| line.slope);
            let span_ns = at_ns.saturating_sub(end.middle.at_ns);
            end.middle
                .offset_ns
                .saturating_add(round(slope * span_ns as f64))
        };
        let Some(after) = self.points.get(next) else {
            return self.points.last().map(beyond);
        };
        let Some(before) = next.checked_sub(1).map(|index| &self.points[index]) else {
            return Some(beyond(after));
        };
        Some(between(before.middle, after.middle, at_ns))
    }

    /// How far anchors lie off the straight line between their neighbours, as a standard deviation
    /// of one of them; `None` below three.
    pub(super) fn spread_ns(&self) -> Option<f64> {
        let deviations = self.points.windows(3).map(|three| {
            let straight = between(three[0].middle, three[2].middle, three[1].middle.at_ns);
            three[1].middle.offset_ns.saturating_sub(straight) as f64
        });
        let count = self
            .points
            .len()
            .checked_sub(2)
            .filter(|count| *count > 0)?;
        let square_sum: f64 = deviations.map(|deviation| deviation * deviation).sum();
        // The mean of two neighbours adds half a variance to that of the point itself.
        Some((square_sum / count as f64 / 1.5).sqrt())
    }
}

fn between(before: Edge, after: Edge, at_ns: i64) -> i64 {
    let span_ns = after.at_ns.saturating_sub(before.at_ns).max(1);
    let rise_ns = after.offset_ns.saturating_sub(before.offset_ns);
    let share = i128::from(rise_ns) * i128::from(at_ns.saturating_sub(before.at_ns));
    let gain = share / i128::from(span_ns);
    before
        .offset_ns
        .saturating_add(i64::try_from(gain).unwrap_or(0))
}

/// Without those about which a better exchange nearby says more, even after drifting.
fn undominated(points: &[Anchor], settings: &ClockSettings) -> Vec<Anchor> {
    let says_more = |one: &Anchor, other: &Anchor| {
        let span_ns = one.middle.at_ns.saturating_sub(other.middle.at_ns);
        let width_ns = settings.drift_ns(span_ns).saturating_mul(2);
        other.rtt_ns.saturating_add(width_ns) < one.rtt_ns
    };
    let mut is_kept = vec![true; points.len()];
    // The best so far in each direction is the only one that can dominate.
    for is_forward in [true, false] {
        let mut best: Option<Anchor> = None;
        for step in 0..points.len() {
            let index = if is_forward {
                step
            } else {
                points.len() - 1 - step
            };
            let one = points[index];
            match best {
                Some(other) if says_more(&one, &other) => is_kept[index] = false,
                _ => best = Some(one),
            }
        }
    }
    let kept = points.iter().zip(is_kept).filter(|(_, is_kept)| *is_kept);
    kept.map(|(point, _)| *point).collect()
}

/// Least squares, each anchor weighted by the inverse square of its round trip.
fn line(points: &[Anchor]) -> Option<Line> {
    let origin = points.first()?.middle;
    let rows: Vec<(f64, f64, f64)> = points
        .iter()
        .map(|point| {
            let width = point.rtt_ns.max(100) as f64;
            let x = point.middle.at_ns.saturating_sub(origin.at_ns) as f64;
            let y = point.middle.offset_ns.saturating_sub(origin.offset_ns) as f64;
            (x, y, (1e3 / width) * (1e3 / width))
        })
        .collect();
    let weight: f64 = rows.iter().map(|row| row.2).sum();
    let mean = |value: fn(&(f64, f64, f64)) -> f64| {
        rows.iter().map(|row| value(row) * row.2).sum::<f64>() / weight
    };
    let (mean_x, mean_y) = (mean(|row| row.0), mean(|row| row.1));
    let spread: f64 = rows.iter().map(|(x, _, w)| w * (x - mean_x).powi(2)).sum();
    let covariance: f64 = rows
        .iter()
        .map(|(x, y, w)| w * (x - mean_x) * (y - mean_y))
        .sum();
    if rows.len() < 3 || spread <= 0.0 {
        return None;
    }
    let slope = covariance / spread;
    let residual: f64 = rows
        .iter()
        .map(|(x, y, w)| w * (y - mean_y - slope * (x - mean_x)).powi(2))
        .sum();
    let variance = residual / (rows.len() as f64 - 2.0);
    let scatter = slope_scatter(points).unwrap_or(0.0);
    Some(Line {
        slope,
        slope_error: (variance / spread).sqrt().max(scatter),
    })
}

/// How uncertain the mean of a slope is that changes with time: standard deviation of the slopes
/// of up to [`PART_COUNT`] equally long parts, over the square root of their number. What is left
/// about a straight line does not tell, as neighbours stray together. `None` below two parts.
fn slope_scatter(points: &[Anchor]) -> Option<f64> {
    let count = PART_COUNT.min(points.len().checked_sub(1)?);
    let end = |part: usize| points[part * (points.len() - 1) / count].middle;
    let slopes: Vec<f64> = (0..count)
        .map(|part| {
            let (from, until) = (end(part), end(part + 1));
            let span_ns = until.at_ns.saturating_sub(from.at_ns).max(1);
            until.offset_ns.saturating_sub(from.offset_ns) as f64 / span_ns as f64
        })
        .collect();
    let mean = slopes.iter().sum::<f64>() / count as f64;
    let squares: f64 = slopes.iter().map(|slope| (slope - mean).powi(2)).sum();
    (count >= 2).then(|| (squares / (count as f64 - 1.0) / count as f64).sqrt())
}

#[allow(
    clippy::cast_possible_truncation,
    reason = "a drift over a run is far below 292 years; beyond, the conversion saturates"
)]
fn round(value: f64) -> i64 {
    value.round() as i64
}
