//! Where the tool went against where it was sent: dynamic time warping, distance from the path and
//! jerk. Time linear in the log's length: both searches look no farther than half a loop.

use crate::score::record::Record;
use hil_core::score::Metric;
use hil_stats::metric::label;
use hil_stats::series::{Sample, resampled};

/// Warping and distances, as far as both signals are there.
pub(crate) fn metrics(
    record: &Record,
    sent: &[Sample],
    moved: &[Sample],
    period_s: f64,
) -> [Metric; 4] {
    let warped = warping_m(sent, moved, period_s);
    let distance = path_distance(record, period_s);
    let missing = "commands and feedback with a tool position overlap for less than a loop";
    let path_method = "nearest point of the path through the commanded tool positions within half \
                       a period, every 40 ms";
    [
        label("tool_y_dtw_m", "tool y, dynamic time warping distance", "m").measured(
            warped,
            "mean |commanded - measured| along the cheapest warping path, 7.5 Hz, at most half a \
             period apart",
            missing,
        ),
        label(
            "tool_path_m_rms",
            "distance of the tool from its path, RMS",
            "m",
        )
        .measured(distance.map(|(rms, _)| rms), path_method, missing),
        label(
            "tool_path_m_max",
            "distance of the tool from its path, greatest",
            "m",
        )
        .measured(distance.map(|(_, max)| max), path_method, missing),
        label("tool_y_jerk_rms", "jerk of the tool's y, RMS", "m/s3").measured(
            jerk_rms(moved),
            "third difference of the measured y on a 16 ms grid",
            "less than a second of feedback with a tool position",
        ),
    ]
}

/// Rate at which signals are warped; the rate of the published figure for this kind of motion.
const WARP_STEP_NS: i64 = 133_333_333;

/// A stretch of two signals as one grid has them.
fn on_grid(sent: &[Sample], moved: &[Sample], step_ns: i64) -> Option<(Vec<f64>, Vec<f64>)> {
    let begin = sent.first()?.0.max(moved.first()?.0);
    let end = sent.last()?.0.min(moved.last()?.0);
    let count = usize::try_from((end - begin) / step_ns).ok()?;
    let grid = |samples| resampled(samples, begin, step_ns, count);
    Some((grid(sent), grid(moved)))
}

/// Mean distance along the cheapest warping path (Sakoe and Chiba 1978, symmetric steps of weight
/// one) inside a band of half a period.
fn warping_m(sent: &[Sample], moved: &[Sample], period_s: f64) -> Option<f64> {
    let (sent, moved) = on_grid(sent, moved, WARP_STEP_NS)?;
    let band = steps(0.5 * period_s, WARP_STEP_NS);
    if sent.len() < 2 * band {
        return None;
    }
    // A row holds the cells of one commanded sample; cell k is the measured one k - band later.
    let width = 2 * band + 1;
    let unreachable = (f64::INFINITY, 0.0);
    let mut above = vec![unreachable; width];
    let mut row = above.clone();
    for (i, target) in sent.iter().enumerate() {
        for k in 0..width {
            let Some(value) = (i + k).checked_sub(band).and_then(|j| moved.get(j)) else {
                row[k] = unreachable;
                continue;
            };
            let from_above = above.get(k + 1).copied().unwrap_or(unreachable);
            let aside = if k > 0 { row[k - 1] } else { unreachable };
            let before = if i == 0 && k == band {
                (0.0, 0.0)
            } else {
                // The diagonal first: of equal costs the shorter path counts.
                cheapest([above[k], from_above, aside])
            };
            row[k] = (before.0 + (target - value).abs(), before.1 + 1.0);
        }
        core::mem::swap(&mut above, &mut row);
    }
    let (cost, length) = above[band];
    (length > 0.0).then(|| cost / length)
}

fn cheapest(cells: [(f64, f64); 3]) -> (f64, f64) {
    let mut best = cells[0];
    for cell in &cells[1..] {
        if cell.0 < best.0 {
            best = *cell;
        }
    }
    best
}

#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "seconds on a grid of milliseconds"
)]
fn steps(time_s: f64, step_ns: i64) -> usize {
    (time_s * 1e9 / step_ns as f64).ceil() as usize
}

#[allow(
    clippy::cast_possible_truncation,
    reason = "a period of at most a minute"
)]
fn half_ns(period_s: f64) -> i64 {
    (0.5e9 * period_s) as i64
}

/// From point to point of both paths.
const PATH_STEP_NS: i64 = 40_000_000;

type Point = [f64; 3];

/// RMS and greatest distance of the measured tool from the commanded path nearby.
fn path_distance(record: &Record, period_s: f64) -> Option<(f64, f64)> {
    let commands = record
        .commands
        .iter()
        .map(|known| (known.at_ns, known.tool_m));
    let feedback = record
        .feedback
        .iter()
        .map(|known| (known.at_ns, known.tool_m));
    let (sent, moved) = (thinned(commands), thinned(feedback));
    let reach_ns = half_ns(period_s);
    let (begin, end) = (sent.first()?.0, sent.last()?.0);
    let (mut low, mut high, mut count, mut square, mut max) = (0, 0, 0.0, 0.0, 0.0_f64);
    for (at, point) in &moved {
        if *at < begin || *at > end {
            continue;
        }
        while sent[low].0 < at - reach_ns {
            low += 1;
        }
        while high < sent.len() && sent[high].0 <= at + reach_ns {
            high += 1;
        }
        let segments = sent[low..high].windows(2);
        let nearest = segments
            .map(|ends| square_to_segment(point, &ends[0].1, &ends[1].1))
            .fold(f64::INFINITY, f64::min);
        if nearest.is_finite() {
            count += 1.0;
            square += nearest;
            max = max.max(nearest);
        }
    }
    (count > 0.0).then(|| ((square / count).sqrt(), max.sqrt()))
}

/// The first sound point of every [`PATH_STEP_NS`].
fn thinned(points: impl Iterator<Item = (i64, Point)>) -> Vec<(i64, Point)> {
    let mut kept: Vec<(i64, Point)> = Vec::new();
    for (at, point) in points.filter(|(_, point)| point.iter().all(|value| value.is_finite())) {
        if kept
            .last()
            .is_none_or(|(newest, _)| at - newest >= PATH_STEP_NS)
        {
            kept.push((at, point));
        }
    }
    kept
}

/// Square of the distance of `point` from the line between `from` and `to`.
fn square_to_segment(point: &Point, from: &Point, to: &Point) -> f64 {
    let mut along = 0.0;
    let mut length = 0.0;
    for axis in 0..3 {
        let step = to[axis] - from[axis];
        along += step * (point[axis] - from[axis]);
        length += step * step;
    }
    let share = if length > 0.0 {
        (along / length).clamp(0.0, 1.0)
    } else {
        0.0
    };
    let apart = |axis: usize| point[axis] - from[axis] - share * (to[axis] - from[axis]);
    (0..3).map(|axis| apart(axis).powi(2)).sum()
}

/// Grid on which jerk is taken.
const JERK_STEP_NS: i64 = 16_000_000;

fn jerk_rms(moved: &[Sample]) -> Option<f64> {
    let (begin, end) = (moved.first()?.0, moved.last()?.0);
    let count = usize::try_from((end - begin) / JERK_STEP_NS).ok()?;
    if count < 62 {
        return None;
    }
    let values = resampled(moved, begin, JERK_STEP_NS, count);
    let step_s = JERK_STEP_NS as f64 * 1e-9;
    let jerk = |four: &[f64]| (four[3] - 3.0 * four[2] + 3.0 * four[1] - four[0]) / step_s.powi(3);
    let squares: f64 = values.windows(4).map(|four| jerk(four).powi(2)).sum();
    Some((squares / (values.len() - 3) as f64).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD_S: f64 = 4.033;

    fn wave(lag_s: f64, scale: f64, end_s: i64) -> Vec<Sample> {
        let at = |step: i64| step * 8_000_000;
        let value = |at: i64| {
            let time_s = at as f64 * 1e-9 - lag_s;
            scale * (core::f64::consts::TAU * time_s / PERIOD_S).sin()
        };
        (0..end_s * 125)
            .map(|step| (at(step), value(at(step))))
            .collect()
    }

    #[test]
    fn warping_forgives_a_delay_but_not_a_smaller_motion() {
        let sent = wave(0.0, 0.15, 60);
        assert!(warping_m(&sent, &sent, PERIOD_S).unwrap() < 1e-12);
        let delayed = warping_m(&sent, &wave(0.2, 0.15, 60), PERIOD_S).unwrap();
        let apart: f64 = sent
            .iter()
            .zip(&wave(0.2, 0.15, 60))
            .map(|(a, b)| (a.1 - b.1).abs())
            .sum::<f64>()
            / sent.len() as f64;
        assert!(delayed < 0.4 * apart, "{delayed} {apart}");
        let smaller = warping_m(&sent, &wave(0.0, 0.10, 60), PERIOD_S).unwrap();
        assert!(smaller > 0.005, "{smaller}");
        assert_eq!(warping_m(&sent[..100], &sent, PERIOD_S), None);
    }

    #[test]
    fn the_jerk_of_a_sine_is_its_third_derivative() {
        let omega = core::f64::consts::TAU / PERIOD_S;
        let expected = 0.15 * omega.powi(3) / 2_f64.sqrt();
        let found = jerk_rms(&wave(0.0, 0.15, 121)).unwrap();
        assert!((found / expected - 1.0).abs() < 0.02, "{found} {expected}");
        assert_eq!(jerk_rms(&wave(0.0, 0.15, 1)[..50]), None);
    }

    #[test]
    fn a_point_beside_a_line_is_as_far_as_its_foot() {
        let far = |point| square_to_segment(&point, &[0.0; 3], &[2.0, 0.0, 0.0]).sqrt();
        assert!((far([1.0, 0.0, 3.0]) - 3.0).abs() < 1e-12);
        assert!((far([5.0, 4.0, 0.0]) - 5.0).abs() < 1e-12);
        let none = square_to_segment(&[1.0, 0.0, 0.0], &[0.0; 3], &[0.0; 3]);
        assert!((none - 1.0).abs() < 1e-12);
    }
}
