//! Whether the exchanges contradict the drift limit that the guaranteed interval takes for granted.
//!
//! A rate beyond the limit looks like a row of steps. A step is told from it by a line: exchanges on both
//! sides of a step leave none, whatever its slope; exchanges of clocks that run apart do. What no step
//! shows, the slope of the estimate may: it is taken to contradict the limit at four standard errors.

use core::ops::RangeInclusive;

use serde::{Deserialize, Serialize};

use super::ClockSettings;
use super::anchors::Anchors;
use super::exchange::Constraint;

/// Steepest line that is looked for: far beyond any oscillator, and beyond how the kernel steers one.
const SLOPE_MAX: f64 = 1e-2;
/// Exchanges at least that are on either side of a contradiction where a rate is told from a step: fewer have a
/// line over any step.
const SIDE_COUNT: usize = 10;
/// Points of the estimate whose slope counts, and standard errors by which it is beyond the limit.
const POINT_COUNT_MIN: usize = 10;
const ERROR_FACTOR: f64 = 4.0;
/// Thirds that the range of slopes loses, one after the other: to far below a part per billion.
const SEARCH_COUNT: usize = 60;

/// The clocks' rates differ by more than the drift limit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DriftContradiction {
    /// A rate that explains the exchanges: how much faster this host's clock runs, parts per million.
    pub rate_ppm: f64,
    /// The limit.
    pub limit_ppm: f64,
}

/// What of the exchanges, in order of time, and of the estimates over their stretches contradicts the limit.
/// `contradictions` are those that no clock within the limit explains, unless it was stepped.
pub(super) fn contradiction<'a>(
    constraints: &[Constraint],
    contradictions: &[RangeInclusive<usize>],
    estimates: impl Iterator<Item = &'a Anchors>,
    settings: &ClockSettings,
) -> Option<DriftContradiction> {
    let limit = f64::from(settings.drift_ppb) * 1e-9;
    let across = (0..contradictions.len()).find_map(|index| {
        let between = &contradictions[index];
        // A step has long and level sides, which no line meets; a rate lasts into the next contradiction.
        let before = index
            .checked_sub(1)
            .map_or(0, |one| *contradictions[one].start());
        let from = before.min(between.start().saturating_sub(SIDE_COUNT));
        let after = contradictions.get(index + 1);
        let after = after.map_or(constraints.len(), |one| one.end() + 1);
        let until = after
            .max(between.end() + 1 + SIDE_COUNT)
            .min(constraints.len());
        let sides = [between.start() + 1 - from, until - between.end()];
        if sides.into_iter().any(|count| count < SIDE_COUNT) {
            return None;
        }
        common_slope(&constraints[from..until]).filter(|slope| slope.abs() > limit)
    });
    let within = || {
        let longest = estimates.max_by_key(|anchors| anchors.points.len());
        let anchors = longest.filter(|anchors| anchors.points.len() >= POINT_COUNT_MIN)?;
        let line = anchors.line()?;
        let least = line.slope.abs() - ERROR_FACTOR * line.slope_error;
        (least > limit).then_some(line.slope)
    };
    let slope = across.or_else(within)?;
    Some(DriftContradiction {
        rate_ppm: slope * 1e6,
        limit_ppm: limit * 1e6,
    })
}

/// The slope of a line that meets all exchanges; `None` when there is none.
fn common_slope(constraints: &[Constraint]) -> Option<f64> {
    let origin = constraints.first()?.low;
    let point = |at_ns: i64, offset_ns: i64| {
        let x = at_ns.saturating_sub(origin.at_ns) as f64;
        (x, offset_ns.saturating_sub(origin.offset_ns) as f64)
    };
    let lows: Vec<_> = constraints
        .iter()
        .map(|one| point(one.low.at_ns, one.low.offset_ns))
        .collect();
    let highs: Vec<_> = constraints
        .iter()
        .map(|one| point(one.high.at_ns, one.high.offset_ns))
        .collect();
    // By how much no line of this slope meets them all: convex in the slope.
    let lack = |slope: f64| {
        let above = |(x, y): &(f64, f64)| y - slope * x;
        let most = lows.iter().map(above).fold(f64::NEG_INFINITY, f64::max);
        let least = highs.iter().map(above).fold(f64::INFINITY, f64::min);
        most - least
    };
    let (mut from, mut until) = (-SLOPE_MAX, SLOPE_MAX);
    for _ in 0..SEARCH_COUNT {
        let third = (until - from) / 3.0;
        if lack(from + third) <= lack(until - third) {
            until -= third;
        } else {
            from += third;
        }
    }
    let slope = f64::midpoint(from, until);
    (lack(slope) <= 0.0).then_some(slope)
}

#[cfg(test)]
mod tests {
    use crate::{ClockMap, ClockSettings, Exchange, Requester};
    use hil_core::random::RandomStream;
    use hil_core::record::RoundTripRecord;
    use hil_core::time::RemoteInstant;

    #[allow(clippy::cast_possible_truncation, reason = "some milliseconds")]
    fn rounded(ns: f64) -> i64 {
        ns as i64
    }

    /// Exchanges ten times a second for a minute. `offset_ns` is the other clock's lead, `way_ns` the
    /// least time under way and the mean of what comes on top.
    fn map(seed: u64, way_ns: f64, offset_ns: impl Fn(i64) -> i64) -> ClockMap {
        queued(seed, way_ns, |_| 0, offset_ns)
    }

    /// The same behind a queue on the way there, so long at an instant.
    fn queued(
        seed: u64,
        way_ns: f64,
        queue_ns: impl Fn(i64) -> i64,
        offset_ns: impl Fn(i64) -> i64,
    ) -> ClockMap {
        let mut random = RandomStream::new(seed, "clock.drift");
        let exchanges: Vec<Exchange> = (0..600)
            .filter_map(|index| {
                let mut way = || rounded(way_ns * (1.0 - random.uniform().ln()));
                let sent_ns = index * 100_000_000;
                let arrived_ns = sent_ns + queue_ns(sent_ns) + way();
                let (left_ns, back_ns) = (arrived_ns + 5_000, arrived_ns + 5_000 + way());
                let record = RoundTripRecord {
                    sequence: index.unsigned_abs(),
                    t1_ns: sent_ns,
                    t2_ns: arrived_ns + offset_ns(arrived_ns),
                    t3_ns: left_ns + offset_ns(left_ns),
                    t4_ns: back_ns,
                    session: 1,
                    sources: [0; 4],
                };
                Exchange::of(&record, Requester::Local)
            })
            .collect();
        ClockMap::new(&exchanges, ClockSettings::default())
    }

    fn rate(ppm: i64) -> impl Fn(i64) -> i64 {
        move |at_ns| at_ns / 1_000_000 * ppm
    }

    #[test]
    fn a_rate_beyond_the_limit_withdraws_the_bound_and_one_within_it_does_not() {
        for seed in 0..20 {
            for way_ns in [50e3, 300e3, 3e6] {
                for ppm in [-190, -100, 0, 100, 190] {
                    let map = map(seed, way_ns, rate(ppm));
                    let figures = map.metrics();
                    assert_eq!(figures.drift_contradiction, None, "{seed} {way_ns} {ppm}");
                    assert!(figures.bound.is_some() && figures.steps.is_empty());
                }
                // What a long round trip leaves room for contradicts nothing within a minute.
                let shown = |ppm: &i64| way_ns < 1e6 || ppm.abs() >= 1_000;
                for ppm in [-2_000, -500, 300, 400, 1_000].into_iter().filter(shown) {
                    let map = map(seed, way_ns, rate(ppm));
                    let figures = map.metrics();
                    let found = figures.drift_contradiction;
                    let found =
                        found.unwrap_or_else(|| panic!("{seed} {way_ns} {ppm}: {figures:?}"));
                    // The other clock's gain is this one's loss.
                    let rate_ppm = found.rate_ppm * -(ppm.signum() as f64);
                    assert!(
                        rate_ppm > found.limit_ppm,
                        "{seed} {way_ns} {ppm}: {found:?}"
                    );
                    assert_eq!((figures.bound, figures.offset), (None, None));
                    let at = RemoteInstant::from_ns(30_000_000_000);
                    assert_eq!(map.localise(at), None);
                }
            }
        }
    }

    #[test]
    fn a_queue_that_grows_on_one_way_is_no_rate() {
        for seed in 0..20 {
            for (period_s, most_ns) in [(2, 5e6), (10, 20e6), (30, 50e6), (60, 100e6), (120, 50e6)]
            {
                // A saw: it grows for a period and is gone.
                let queue_ns = |at_ns: i64| {
                    let period_ns = period_s * 1_000_000_000;
                    rounded(most_ns * (at_ns % period_ns) as f64 / period_ns as f64)
                };
                for way_ns in [50e3, 1e6] {
                    let map = queued(seed, way_ns, queue_ns, rate(40));
                    let found = map.metrics().drift_contradiction;
                    assert_eq!(found, None, "{seed} {period_s} {way_ns}");
                }
            }
        }
    }

    #[test]
    fn a_step_is_no_rate() {
        for seed in 0..20 {
            for step_ns in [-20_000_000, 3_000_000, 1_000_000_000] {
                let map = map(seed, 300e3, |at_ns| {
                    rate(50)(at_ns) + if at_ns < 25_000_000_000 { 0 } else { step_ns }
                });
                assert_eq!(map.metrics().drift_contradiction, None, "{seed} {step_ns}");
                assert_eq!(map.metrics().steps.len(), 1, "{seed} {step_ns}");
            }
        }
    }

    #[test]
    fn a_step_beside_an_end_is_no_rate_either() {
        for seed in 0..20 {
            for at_s in [0.35, 0.55, 1.05, 2.5, 57.0, 59.0, 59.5, 59.7] {
                for step_ns in [-20_000_000, 8_000_000, 1_000_000_000] {
                    let map = map(seed, 3e6, |at_ns| {
                        rate(50)(at_ns)
                            + if at_ns < rounded(at_s * 1e9) {
                                0
                            } else {
                                step_ns
                            }
                    });
                    let found = map.metrics().drift_contradiction;
                    assert_eq!(found, None, "{seed} {at_s} {step_ns}");
                }
            }
        }
    }
}
