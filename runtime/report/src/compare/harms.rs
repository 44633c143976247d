//! Was the robot hurt more in the new runs than in the base? What hurt it on both sides, pooled over the runs of each,
//! and the answer that follows. Figures of the network are elsewhere.

use hil_core::interval::{Interval, Spread, TooSmall};
use hil_stats::comparison::{Estimate, difference, mean_interval, none_of, welch};
use hil_stats::dependence::COUNT_MIN;
use hil_stats::statistics::CONFIDENCE;
use serde::Serialize;

use super::ComparedRun;
use crate::answer::{
    HarmCount, Hurt, OCCASIONS_MIN, OccasionCount, Unresolved, Untested, is_score_incomplete,
    precondition, tested_count, too_few_occasions,
};
use crate::assessment::Assessment;

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
    /// 95 %, or why there is none: of a run and a run by the interval of each on its effective sample (MOVER), of
    /// repetitions Welch's.
    pub(crate) interval: Spread,
    /// It is of shares.
    pub(crate) is_share: bool,
}

/// How a harm stands to that of the base.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Change {
    /// By the whole interval of the difference.
    More,
    /// Likewise.
    Less,
    /// Chance alone may make it.
    NotShown,
}

/// A harm of a run.
#[derive(Debug, Clone, Copy)]
struct RunHarm {
    /// Its share of the occasions, or its rate per second.
    value: f64,
    /// How many occasions; `None` of a rate.
    of: Option<u64>,
    interval: Spread,
}

/// Events of a run that are only counted may all be one: the run is the observation.
const ONE_RUN: TooSmall = TooSmall {
    effective: 1,
    needed: 2,
};

impl RunHarm {
    /// `None` where it was not counted, or of no occasions or no time.
    fn of(what: &str, run: &ComparedRun) -> Option<Self> {
        let harm = run.summary.harms.iter().find(|one| one.what == what)?;
        let of = harm.occasions.as_ref().map(|one| one.count);
        let length = of.map_or(run.summary.run.duration_s, |of| of as f64);
        let value = harm.count? as f64 / length;
        value.is_finite().then_some(Self {
            value: of.map_or(value, |_| value.min(1.0)),
            of,
            interval: harm.interval.unwrap_or(Spread::Unknown(ONE_RUN)),
        })
    }

    /// With its interval; without events that of how they come together in the `other` run, or why that is unknown.
    fn estimate(&self, other: &Self) -> Result<Estimate, TooSmall> {
        let value = self.value;
        let with = |interval| Estimate {
            value,
            interval: Some(interval),
        };
        match (self.interval, other.interval) {
            (Spread::Known(interval), _) => Ok(with(interval)),
            (Spread::Unknown(why), Spread::Known(interval)) if value == 0.0 => {
                let like = Estimate {
                    value: other.value,
                    interval: Some(interval),
                };
                let counts = self.of.zip(other.of);
                let found = counts.and_then(|(of, like_of)| none_of(of, like, like_of));
                found.map(with).ok_or(why)
            }
            (Spread::Unknown(_), Spread::Unknown(why)) if value == 0.0 && other.value > 0.0 => {
                Err(why)
            }
            (Spread::Unknown(why), _) => Err(why),
        }
    }

    /// The same beside several runs, by that of them which leaves open the most.
    fn against(&self, others: &[Self]) -> Result<Estimate, TooSmall> {
        let hurt = others.iter().filter(|one| one.value > 0.0);
        let found = hurt.map(|other| self.estimate(other));
        let found = found.collect::<Result<Vec<_>, _>>()?;
        let high = |one: &Estimate| one.interval.map_or(f64::INFINITY, |found| found.high);
        let widest = found.into_iter().max_by(|a, b| high(a).total_cmp(&high(b)));
        widest.map_or_else(|| self.estimate(self), Ok)
    }
}

impl HarmDifference {
    fn of(base: &[RunHarm], new: &[RunHarm]) -> Option<Self> {
        let values = |side: &[RunHarm]| side.iter().map(|one| one.value).collect::<Vec<f64>>();
        let mean = |side: &[RunHarm]| values(side).iter().sum::<f64>() / side.len() as f64;
        let is_share = base.first()?.of.is_some();
        let mut all = base.iter().chain(new);
        if new.is_empty() || all.any(|one| one.of.is_some() != is_share) {
            return None;
        }
        let several = |side: &[RunHarm]| Estimate {
            value: mean(side),
            interval: mean_interval(&values(side), CONFIDENCE),
        };
        let found = match (base, new) {
            ([b], [n]) => b
                .against(new)
                .and_then(|one| Ok(difference(one, n.against(base)?))),
            ([b], _) => b.against(new).map(|one| difference(one, several(new))),
            (_, [n]) => n.against(base).map(|one| difference(several(base), one)),
            _ => Ok(welch(&values(base), &values(new), CONFIDENCE)),
        };
        // No share is above one, whatever repetitions scatter.
        let within = |one: Interval| {
            if is_share {
                one.map(|end| end.clamp(-1.0, 1.0))
            } else {
                one
            }
        };
        Some(Self {
            value: mean(new) - mean(base),
            // Repetitions of which none differs from another are worth one.
            interval: found.and_then(|one| one.map(within).ok_or(ONE_RUN)).into(),
            is_share,
        })
    }

    fn known(&self) -> Option<Interval> {
        self.interval.known()
    }
}

impl Change {
    fn of(difference: Option<HarmDifference>) -> Self {
        match difference.and_then(|one| one.known()) {
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
        let of_runs = |runs: &[ComparedRun]| {
            let each = runs.iter().map(|run| RunHarm::of(what, run));
            each.collect::<Option<Vec<_>>>().unwrap_or_default()
        };
        let difference = HarmDifference::of(&of_runs(base), &of_runs(new));
        let [base, new] = [base, new].map(|runs| pooled(what, runs));
        let has_few = |harm: &HarmCount| {
            let occasions = harm.occasions.as_ref();
            occasions.is_some_and(|one| one.count < OCCASIONS_MIN)
        };
        ComparedHarm {
            change: Change::of(difference),
            difference: difference.filter(|_| !has_few(&base) && !has_few(&new)),
            base,
            new,
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
        note: String::new(),
    };
    for run in runs {
        let Some(harm) = run.summary.harms.iter().find(|one| one.what == what) else {
            sum.count = None;
            continue;
        };
        sum.count = sum.count.zip(harm.count).map(|(one, other)| one + other);
        sum.own_count += harm.own_count;
        sum.note.clone_from(&harm.note);
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

/// Whether the robot was hurt more in the new runs.
pub(super) fn hurt(harms: &[ComparedHarm], base: &[ComparedRun], new: &[ComparedRun]) -> Hurt {
    let not_resolvable = |because| Hurt::NotResolvable { because };
    let mut found = base
        .iter()
        .filter_map(base_precondition)
        .chain(new.iter().filter_map(run_precondition));
    if let Some(found) = found.next() {
        return found;
    }
    let changes = harms.iter().map(|one| one.change);
    if changes.clone().any(|change| change == Change::More) {
        return Hurt::Yes;
    }
    if harms
        .iter()
        .any(|one| one.base.count.is_none() || one.new.count.is_none())
    {
        return not_resolvable(Unresolved::NotCounted);
    }
    let is_unhurt = harms.iter().all(|one| one.new.count == Some(0));
    let is_less = changes.clone().any(|change| change == Change::Less)
        && harms
            .iter()
            .all(|one| one.change == Change::Less || one.new.count == Some(0));
    if !is_unhurt && !is_less {
        let are_repeated = base.len().min(new.len()) > 1;
        let because = too_small(harms, are_repeated).unwrap_or(Unresolved::WithinChance);
        return not_resolvable(because);
    }
    too_few(harms, base, new).map_or(Hurt::No, not_resolvable)
}

/// The new runs have too few occasions for a NO. Where a side has one run, each new one must have as many as an interval of
/// its own takes: with fewer a YES could not be either.
fn too_few(
    harms: &[ComparedHarm],
    base: &[ComparedRun],
    new: &[ComparedRun],
) -> Option<Unresolved> {
    let (mut because, of) = if base.len().min(new.len()) > 1 {
        let message_count = new.iter().map(|run| tested_count(&run.summary)).sum();
        let new_harms = harms.iter().map(|one| &one.new);
        let because = too_few_occasions(new_harms, message_count, OCCASIONS_MIN)?;
        (because, "the new runs")
    } else {
        let because = new.iter().find_map(|run| {
            let message_count = tested_count(&run.summary);
            too_few_occasions(&run.summary.harms, message_count, COUNT_MIN)
        })?;
        (because, "a new run where a side has one")
    };
    if let Unresolved::SampleTooSmall { what, .. } = &mut because {
        what.push_str(" in ");
        what.push_str(of);
    }
    Some(because)
}

/// What a run alone has to say before its harms are looked at.
fn run_precondition(run: &ComparedRun) -> Option<Hurt> {
    precondition(&run.summary, &Assessment::of(&run.summary).network)
}

/// The same of a run to compare with: a robot without a network is one, whose score must be whole all the same.
fn base_precondition(run: &ComparedRun) -> Option<Hurt> {
    let no_network = Hurt::NotTested {
        because: Untested::NoNetwork,
    };
    let found = run_precondition(run)?;
    if found != no_network {
        return Some(found);
    }
    let because = Unresolved::ScoreIncomplete;
    is_score_incomplete(&run.summary).then_some(Hurt::NotResolvable { because })
}

/// The first harm of the new runs whose difference has no interval.
fn too_small(harms: &[ComparedHarm], are_repeated: bool) -> Option<Unresolved> {
    let mut hurt = harms.iter().filter(|one| one.new.count != Some(0));
    hurt.find_map(|one| {
        let what = one.new.what.clone();
        match one.difference?.interval {
            Spread::Known(_) => None,
            Spread::Unknown(_) if are_repeated => Some(Unresolved::NoScatter { what }),
            Spread::Unknown(why) => Some(Unresolved::NoInterval { what, why }),
        }
    })
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use hil_core::random::RandomStream;
    use hil_stats::dependence::Batches;

    use super::*;
    use crate::answer::Object;
    use crate::summary::{LinkKind, Outcome, RunSummary};
    use crate::tests::sample::full;
    use crate::tests::sample_events::recorded_channel;

    /// So many loops lost, evenly or in one go.
    fn of_loops(count: u64, sent_count: u64, is_even: bool) -> Spread {
        let step = sent_count / count.max(1);
        let runs: Vec<(u64, u64)> = if is_even {
            (0..count).map(|at| (at * step, 1)).collect()
        } else {
            vec![(0, count)]
        };
        Batches::of_runs(sent_count, runs).share_interval()
    }

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
            interval: count.map(|count| of_loops(count, sent_count, true)),
            note: String::new(),
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
        let clean = [run(Some(0), 600)];
        assert_eq!(compared(&clean, &[run(Some(90), 600)]), Hurt::Yes);
        assert_eq!(compared(&clean, &[run(Some(0), 600)]), Hurt::No);
        let worse = [run(Some(200), 600)];
        assert_eq!(compared(&worse, &[run(Some(30), 600)]), Hurt::No, "less");
        let chance = compared(&clean, &[run(Some(1), 600)]);
        let because = Unresolved::NoInterval {
            what: "motion loops lost".to_owned(),
            why: TooSmall {
                effective: 284,
                needed: 3000,
            },
        };
        assert_eq!(chance, Hurt::NotResolvable { because });
        let because = Unresolved::WithinChance;
        let same = compared(&[run(Some(90), 600)], &[run(Some(91), 600)]);
        assert_eq!(same, Hurt::NotResolvable { because });
        let more = of(&clean, &[run(Some(90), 600)])[0].difference.unwrap();
        let Interval { low, high, .. } = more.known().unwrap();
        assert!(more.is_share && (more.value - 0.15).abs() < 1e-12);
        assert!(
            (0.08..0.14).contains(&low) && (0.16..0.25).contains(&high),
            "{more:?}"
        );
        assert_eq!(
            of(&clean, &[run(Some(4), 9)])[0].difference,
            None,
            "no rate of nine"
        );
        let scattered = [run(Some(60), 60), run(Some(40), 60), run(Some(60), 60)];
        let none = [run(Some(0), 60), run(Some(0), 60), run(Some(1), 60)];
        let wide = of(&none, &scattered)[0].difference.unwrap();
        assert!(wide.known().unwrap().high <= 1.0, "{wide:?}");
        // Repetitions are as many observations, also of short runs.
        let repeated: Vec<_> = (0..8).map(|at| run(Some(1 + at % 2), 60)).collect();
        let clean: Vec<_> = (0..8).map(|_| run(Some(0), 60)).collect();
        assert_eq!(compared(&clean, &repeated), Hurt::Yes);
        assert_eq!(
            of(&clean, &repeated)[0].new.words().split(':').next(),
            Some("12 of 480 motion loops sent")
        );
    }

    #[test]
    fn single_runs_get_a_no_only_where_they_could_get_a_yes() {
        let of = |base: u64, new: u64| {
            compared(&[run(Some(base), 17)], &[run(Some(new), 17)]).words(Object::Robot)
        };
        let hurt = "CANNOT TELL: the difference of motion loops lost has no interval: 17 independent values, 64 needed";
        assert_eq!(of(0, 11), hurt);
        let unhurt = "CANNOT TELL: the sample is too small for a NO (motion loops sent in a new run where a side has one: 17, needed: 64)";
        assert_eq!(of(0, 0), unhurt);
        assert_eq!(of(11, 0), unhurt);
        // Repetitions tell, either way.
        let runs = |counts: [u64; 3]| counts.map(|count| run(Some(count), 17));
        assert_eq!(compared(&runs([0; 3]), &runs([11, 9, 12])), Hurt::Yes);
        assert_eq!(compared(&runs([0; 3]), &runs([0; 3])), Hurt::No);
        let because = Unresolved::NoScatter {
            what: "motion loops lost".to_owned(),
        };
        let alike = compared(&runs([0; 3]), &runs([3; 3]));
        assert_eq!(alike, Hurt::NotResolvable { because });
        assert_eq!(compared(&runs([11, 9, 12]), &runs([0; 3])), Hurt::No);
        // As do repetitions beside one run that is long enough.
        let long = |counts: [u64; 3]| counts.map(|count| run(Some(count), 600));
        assert_eq!(
            compared(&[run(Some(0), 600)], &long([90, 80, 99])),
            Hurt::Yes
        );
        assert_eq!(compared(&[run(Some(0), 600)], &long([0; 3])), Hurt::No);
    }

    /// Loops lost while an outage lasts; outages come and go with these mean lengths, in loops.
    fn clustered(
        stream: &mut RandomStream,
        sent_count: u64,
        [lost, kept]: [f64; 2],
    ) -> ComparedRun {
        let (mut runs, mut at, mut is_lost) = (Vec::new(), 0, stream.chance(lost / (lost + kept)));
        while at < sent_count {
            let mean = if is_lost { lost } else { kept };
            let mut length = 1;
            while !stream.chance(1.0 / mean) {
                length += 1;
            }
            let length = length.min(sent_count - at);
            if is_lost {
                runs.push((at, length));
            }
            at += length;
            is_lost = !is_lost;
        }
        let mut run = run(Some(runs.iter().map(|one| one.1).sum()), sent_count);
        let batches = Batches::of_runs(sent_count, runs);
        run.summary.harms[0].interval = Some(batches.share_interval());
        run
    }

    #[test]
    fn runs_over_one_link_are_seldom_told_apart_however_its_losses_come_together() {
        for (sent_count, lengths) in [(17, [6.0, 12.0]), (400, [3.0, 60.0]), (400, [6.0, 12.0])] {
            let run = |seed| {
                let mut stream = RandomStream::new(seed, "clustered losses");
                [clustered(&mut stream, sent_count, lengths)]
            };
            let runs: Vec<_> = (0..40).map(run).collect();
            let (mut more_count, mut pair_count) = (0, 0);
            for (index, base) in runs.iter().enumerate() {
                for (_, new) in runs.iter().enumerate().filter(|(other, _)| *other != index) {
                    pair_count += 1;
                    more_count += usize::from(of(base, new)[0].change == Change::More);
                }
            }
            // More is one of two sides of an interval of 95 %.
            assert!(
                more_count * 40 <= pair_count,
                "{more_count} of {pair_count} at {lengths:?}"
            );
        }
    }

    #[test]
    fn events_that_come_in_one_go_are_no_sample() {
        let mut outage = run(Some(90), 600);
        outage.summary.harms[0].interval = Some(of_loops(90, 600, false));
        let outage = [outage];
        let clean = [run(Some(0), 600)];
        let difference = of(&clean, &outage)[0].difference.unwrap();
        assert!(difference.known().is_none(), "{difference:?}");
        assert!((difference.value - 0.15).abs() < 1e-12);
        let hurt = compared(&clean, &outage);
        assert!(matches!(hurt, Hurt::NotResolvable { .. }), "{hurt:?}");
    }

    #[test]
    fn one_harm_that_became_less_hides_no_other_that_became_more() {
        let with_stops = |count: u64, stops: u64| {
            let each = (0..4).map(|at| {
                let mut run = run(Some(count + at % 2), 60);
                run.summary.harms.push(HarmCount {
                    what: "stops".to_owned(),
                    count: Some(stops + at % 2 * u64::from(stops > 0)),
                    own_count: 0,
                    occasions: None,
                    interval: None,
                    note: String::new(),
                });
                run
            });
            each.collect::<Vec<_>>()
        };
        let better = compared(&with_stops(20, 0), &with_stops(3, 0));
        assert_eq!(better, Hurt::No);
        let worse = compared(&with_stops(20, 0), &with_stops(3, 500));
        assert_eq!(worse, Hurt::Yes);
        let because = Unresolved::WithinChance;
        let mixed = compared(&with_stops(20, 2), &with_stops(3, 2));
        assert_eq!(mixed, Hurt::NotResolvable { because });
        // Of one run and one run nothing tells how stops come.
        let single = compared(&with_stops(0, 0)[..1], &with_stops(0, 500)[..1]);
        assert!(matches!(single, Hurt::NotResolvable { .. }), "{single:?}");
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
        // Nor do two grasps beside many loops.
        let mut few = run(Some(0), 600);
        few.summary.harms.push(HarmCount {
            what: "grasps missed".to_owned(),
            occasions: Some(OccasionCount {
                what: "grasps".to_owned(),
                count: 2,
            }),
            ..few.summary.harms[0].clone()
        });
        let Hurt::NotResolvable {
            because: Unresolved::SampleTooSmall { count: 2, .. },
        } = compared(&[few.clone()], &[few])
        else {
            panic!("two grasps show no absence of harm");
        };
        let mut failed = run(Some(0), 60);
        failed.summary.run.outcome = Outcome::Failed;
        let because = Untested::RunFailed;
        assert_eq!(compared(&clean, &[failed]), Hurt::NotTested { because });
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

    #[test]
    fn what_a_run_alone_cannot_answer_no_comparison_answers() {
        let clean = || run(Some(0), 600);
        let with = |change: &dyn Fn(&mut RunSummary)| {
            let mut run = clean();
            change(&mut run.summary);
            run
        };
        let because = Unresolved::HostUnknown;
        let silent = with(&|one| {
            for process in &mut one.processes {
                (process.tick_count, process.skipped_tick_count) = (None, None);
            }
        });
        let unknown = Hurt::NotResolvable { because };
        assert_eq!(compared(&[clean()], std::slice::from_ref(&silent)), unknown);
        assert_eq!(compared(&[silent], &[clean()]), unknown);
        let because = Unresolved::ScoreIncomplete;
        let incomplete = with(&|one| {
            let mut recorded = recorded_channel();
            recorded.recorded = None;
            one.channels.push(recorded);
        });
        let unscored = Hurt::NotResolvable { because };
        assert_eq!(
            compared(&[clean()], std::slice::from_ref(&incomplete)),
            unscored
        );
        assert_eq!(compared(&[incomplete], &[clean()]), unscored);
        let because = Untested::NoNetwork;
        let direct = with(&|one| {
            for channel in &mut one.channels {
                channel.link = LinkKind::SharedMemory;
            }
        });
        let mut stepped = direct.clone();
        stepped.summary.run.is_virtual = true;
        let untested = Hurt::NotTested { because };
        for one in [direct, stepped] {
            assert_eq!(compared(&[clean()], std::slice::from_ref(&one)), untested);
            assert_eq!(compared(&[one], &[clean()]), Hurt::No, "to compare with");
        }
    }
}
