//! Was the robot hurt more in the new runs than in the base? What hurt it on both sides, pooled over the runs of each,
//! and the answer that follows. Figures of the network are elsewhere.

use hil_core::interval::{Interval, IntervalMethod};
use hil_stats::comparison::{Share, difference};
use hil_stats::statistics::{CONFIDENCE, poisson};
use serde::Serialize;

use super::ComparedRun;
use crate::answer::{
    HarmCount, Hurt, OCCASIONS_MIN, OccasionCount, Unresolved, Untested, is_valid,
};
use crate::assessment::{Assessment, NetworkVerdict};

/// A harm on both sides.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct ComparedHarm {
    /// Of all runs of the base; its `what` is that of both.
    pub(crate) base: HarmCount,
    /// Of all new runs.
    pub(crate) new: HarmCount,
    /// Whether there was more of it in the new runs.
    pub(crate) change: Change,
    /// New less base; `None` without counts, and of fewer occasions than a rate takes.
    pub(crate) difference: Option<HarmDifference>,
}

/// By how much more a harm happened in the new runs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(crate) struct HarmDifference {
    /// Of the shares of the occasions, or of the rates per second of harms without occasions.
    pub(crate) value: f64,
    /// 95 %: Newcombe's of the shares; of the rates, between the ends of both (Poisson).
    pub(crate) interval: Interval,
    /// It is of shares.
    pub(crate) is_share: bool,
}

/// How a harm stands to that of the base.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Change {
    /// By the whole interval of the difference of the shares (Newcombe's); of harms without occasions, by the
    /// whole intervals of both rates (Poisson).
    More,
    /// Likewise.
    Less,
    /// Chance alone may make it.
    NotShown,
}

/// A harm of the runs of one side.
struct Side {
    harm: HarmCount,
    /// Of all runs together, seconds.
    length_s: f64,
}

impl HarmDifference {
    fn of(base: &Side, new: &Side) -> Option<Self> {
        let (base_s, new_s) = (base.length_s, new.length_s);
        let (base, new) = (&base.harm, &new.harm);
        if let Some((base, new)) = share(base).zip(share(new)) {
            let base = base.estimate(CONFIDENCE)?;
            let new = new.estimate(CONFIDENCE)?;
            return Some(Self {
                value: new.value - base.value,
                interval: difference(base, new)?,
                is_share: true,
            });
        }
        let (base, new) = base.count.zip(new.count)?;
        if base_s <= 0.0 || new_s <= 0.0 {
            return None;
        }
        let value = new as f64 / new_s - base as f64 / base_s;
        let [base, new] = [base, new].map(|count| poisson(count, CONFIDENCE));
        Some(Self {
            value,
            interval: Interval::new(
                new.low / new_s - base.high / base_s,
                new.high / new_s - base.low / base_s,
                IntervalMethod::Exact,
            ),
            is_share: false,
        })
    }
}

impl Change {
    fn of(difference: Option<HarmDifference>) -> Self {
        match difference.map(|one| one.interval) {
            Some(interval) if interval.low > 0.0 => Self::More,
            Some(interval) if interval.high < 0.0 => Self::Less,
            _ => Self::NotShown,
        }
    }
}

/// What hurt the robots of both sides, in the order of the case.
pub(super) fn of(base: &[ComparedRun], new: &[ComparedRun]) -> Vec<ComparedHarm> {
    let mut whats: Vec<&str> = Vec::new();
    for harm in base.iter().chain(new).flat_map(|run| &run.summary.harms) {
        if !whats.contains(&harm.what.as_str()) {
            whats.push(&harm.what);
        }
    }
    let compared = whats.into_iter().map(|what| {
        let [base, new] = [base, new].map(|runs| Side {
            harm: pooled(what, runs),
            length_s: runs.iter().map(|run| run.summary.run.duration_s).sum(),
        });
        let difference = HarmDifference::of(&base, &new);
        let has_few = |side: &Side| {
            let occasions = side.harm.occasions.as_ref();
            occasions.is_some_and(|one| one.count < OCCASIONS_MIN)
        };
        ComparedHarm {
            change: Change::of(difference),
            difference: difference.filter(|_| !has_few(&base) && !has_few(&new)),
            base: base.harm,
            new: new.harm,
        }
    });
    compared.collect()
}

/// The sum over the runs; unavailable where one of them has no count.
fn pooled(what: &str, runs: &[ComparedRun]) -> HarmCount {
    let mut sum = HarmCount {
        what: what.to_owned(),
        count: Some(0),
        own_count: 0,
        occasions: None,
        interval: None,
    };
    for run in runs {
        let Some(harm) = run.summary.harms.iter().find(|one| one.what == what) else {
            sum.count = None;
            continue;
        };
        sum.count = sum.count.zip(harm.count).map(|(one, other)| one + other);
        sum.own_count += harm.own_count;
        // Of several runs together there is none: their own differ.
        sum.interval = harm.interval.filter(|_| runs.len() == 1);
        if let Some(OccasionCount { what, count }) = &harm.occasions {
            let known = sum.occasions.get_or_insert_with(|| OccasionCount {
                what: what.clone(),
                count: 0,
            });
            known.count += count;
        }
    }
    sum
}

fn share(harm: &HarmCount) -> Option<Share> {
    let of = harm.occasions.as_ref().map(|one| one.count)?;
    Some(Share {
        count: harm.count?.min(of),
        of,
    })
}

/// Whether the robot was hurt more in the new runs.
pub(super) fn hurt(harms: &[ComparedHarm], base: &[ComparedRun], new: &[ComparedRun]) -> Hurt {
    let not_resolvable = |because| Hurt::NotResolvable { because };
    let mut assessments = base
        .iter()
        .chain(new)
        .map(|run| Assessment::of(&run.summary));
    let is_invalid = |assessment: Assessment| {
        let has_failed = assessment.network == NetworkVerdict::RunFailed;
        has_failed || is_valid(&assessment.network) == Some(false)
    };
    if assessments.any(is_invalid) {
        return not_resolvable(Unresolved::InvalidMeasurement);
    }
    let Some(first) = harms.first() else {
        let because = Untested::NoScore;
        return Hurt::NotTested { because };
    };
    if harms
        .iter()
        .any(|one| one.base.count.is_none() || one.new.count.is_none())
    {
        return not_resolvable(Unresolved::NotCounted);
    }
    let changes = harms.iter().map(|one| one.change);
    if changes.clone().any(|change| change == Change::More) {
        return Hurt::Yes;
    }
    let is_unhurt = harms.iter().all(|one| one.new.count == Some(0));
    let is_less = changes.clone().any(|change| change == Change::Less)
        && harms
            .iter()
            .all(|one| one.change == Change::Less || one.new.count == Some(0));
    match &first.new.occasions {
        Some(OccasionCount { what, count }) if *count < OCCASIONS_MIN => {
            not_resolvable(Unresolved::SampleTooSmall {
                what: what.clone(),
                count: *count,
                needed: OCCASIONS_MIN,
            })
        }
        _ if is_unhurt || is_less => Hurt::No,
        _ => not_resolvable(Unresolved::WithinChance),
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::summary::Outcome;
    use crate::tests::sample::full;

    fn run(count: Option<u64>, sent_count: u64) -> ComparedRun {
        let mut summary = full();
        summary.processes[0].skipped_tick_count = Some(0);
        summary.harms = vec![HarmCount {
            what: "motion loops lost".to_owned(),
            count,
            own_count: 0,
            occasions: Some(OccasionCount {
                what: "motion loops sent".to_owned(),
                count: sent_count,
            }),
            interval: None,
        }];
        ComparedRun {
            folder: PathBuf::from("run"),
            topology: serde_json::Value::Null,
            summary,
        }
    }

    fn compared(base: &[ComparedRun], new: &[ComparedRun]) -> Hurt {
        hurt(&of(base, new), base, new)
    }

    #[test]
    fn more_harm_than_chance_makes_is_a_yes() {
        let clean = [run(Some(0), 60)];
        assert_eq!(compared(&clean, &[run(Some(9), 60)]), Hurt::Yes);
        assert_eq!(compared(&clean, &[run(Some(0), 60)]), Hurt::No);
        let worse = [run(Some(20), 60)];
        assert_eq!(compared(&worse, &[run(Some(3), 60)]), Hurt::No, "less");
        let because = Unresolved::WithinChance;
        let chance = compared(&clean, &[run(Some(1), 60)]);
        assert_eq!(chance, Hurt::NotResolvable { because });
        let more = of(&clean, &[run(Some(9), 60)])[0].difference.unwrap();
        let Interval { low, high, .. } = more.interval;
        assert!(more.is_share && (more.value - 0.15).abs() < 1e-12);
        assert!(
            (0.05..0.08).contains(&low) && (0.25..0.27).contains(&high),
            "{more:?}"
        );
        assert_eq!(
            of(&clean, &[run(Some(4), 9)])[0].difference,
            None,
            "no rate of nine"
        );
        // Repetitions are pooled.
        let repeated: Vec<_> = (0..8).map(|_| run(Some(1), 60)).collect();
        let clean: Vec<_> = (0..8).map(|_| run(Some(0), 60)).collect();
        assert_eq!(compared(&clean, &repeated), Hurt::Yes);
        assert_eq!(
            of(&clean, &repeated)[0].new.words().split(':').next(),
            Some("8 of 480 motion loops sent")
        );
    }

    #[test]
    fn one_harm_that_became_less_hides_no_other_that_became_more() {
        let with_stops = |count, stops| {
            let mut run = run(Some(count), 60);
            run.summary.harms.push(HarmCount {
                what: "stops".to_owned(),
                count: Some(stops),
                own_count: 0,
                occasions: None,
                interval: None,
            });
            [run]
        };
        let better = compared(&with_stops(20, 0), &with_stops(3, 0));
        assert_eq!(better, Hurt::No);
        let worse = compared(&with_stops(20, 0), &with_stops(3, 500));
        assert_eq!(worse, Hurt::Yes);
        let because = Unresolved::WithinChance;
        let mixed = compared(&with_stops(20, 1), &with_stops(3, 2));
        assert_eq!(mixed, Hurt::NotResolvable { because });
    }

    #[test]
    fn what_is_not_known_is_no_answer() {
        let clean = [run(Some(0), 60)];
        let because = Unresolved::NotCounted;
        let uncounted = compared(&clean, &[run(None, 60)]);
        assert_eq!(uncounted, Hurt::NotResolvable { because });
        let Hurt::NotResolvable {
            because: Unresolved::SampleTooSmall { count: 4, .. },
        } = compared(&clean, &[run(Some(0), 4)])
        else {
            panic!("four loops show no absence of harm");
        };
        let mut failed = run(Some(0), 60);
        failed.summary.run.outcome = Outcome::Failed;
        let because = Unresolved::InvalidMeasurement;
        assert_eq!(compared(&clean, &[failed]), Hurt::NotResolvable { because });
        let mut overrun = run(Some(9), 60);
        overrun.summary.processes[1].skipped_tick_count = Some(500);
        let because = Unresolved::InvalidMeasurement;
        assert_eq!(
            compared(&clean, &[overrun]),
            Hurt::NotResolvable { because }
        );
        let mut unscored = run(None, 60);
        unscored.summary.harms.clear();
        let because = Untested::NoScore;
        assert_eq!(
            compared(&[unscored.clone()], &[unscored]),
            Hurt::NotTested { because }
        );
    }
}
