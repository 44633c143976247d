//! The motion-loss table and what it is held against. It computes means and intervals, nothing else.

use crate::experiment::conditions::{Condition, Expected, PUBLISHED_LOOPS};
use crate::experiment::drive::Tally;
use crate::experiment::study::MotionLossStudy;
use crate::score::loops::LossKind;
use hil_core::study::{self, Criterion, Field, Larger, StudyReport, Table, Verdict};
use hil_stats::comparison::{Share, against_published, mean_interval};
use hil_stats::statistics::CONFIDENCE;

/// A condition with the runs of it that ended.
#[derive(Debug)]
pub(crate) struct Row<'a> {
    /// What it is about.
    pub(crate) condition: &'a Condition,
    /// The runs that ended.
    pub(crate) runs: Vec<&'a Tally>,
    /// Motion and robot are those with which outages were fitted to the paper.
    pub(crate) is_fitted: bool,
}

/// The whole report.
pub(crate) fn report(study: &MotionLossStudy, rows: &[Row<'_>]) -> StudyReport {
    let confidence = 1.0 - ERROR_RATE / test_count(rows).max(1) as f64;
    let criteria: Vec<_> = rows
        .iter()
        .flat_map(|row| row.criteria(confidence))
        .collect();
    let verdicts = rows
        .iter()
        .filter_map(|row| Some((row.name(), row.verdict()?)));
    let verdicts: Vec<_> = verdicts.collect();
    StudyReport {
        title: "Case study 2: motion loss rate (MLR) by condition, in virtual time".to_owned(),
        notes: notes(study, rows),
        tables: vec![rates(rows), counts(rows), setups(rows)],
        summary: study::summary(&verdicts, &criteria),
        larger: larger(study, &verdicts, &criteria),
        criteria,
    }
}

/// What more loops or more runs would decide.
fn larger(
    study: &MotionLossStudy,
    verdicts: &[(String, Verdict)],
    criteria: &[Criterion],
) -> Vec<Larger> {
    let parameters = &study.parameters;
    let mut needed = Vec::new();
    if parameters.loops != PUBLISHED_LOOPS {
        needed.push(format!("tables.loops={PUBLISHED_LOOPS}"));
    }
    if (parameters.seeds as usize) < RUNS_MIN {
        needed.push(format!("tables.seeds={RUNS_MIN}"));
    }
    let is_open = verdicts
        .iter()
        .any(|(_, one)| *one == Verdict::Inconclusive);
    let is_short = study.is_fitted && criteria.iter().any(|one| one.is_met.is_none());
    let larger = Larger {
        of: "inconclusive and too few",
        parameters: needed,
    };
    let is_of_use = (is_open || is_short) && !larger.parameters.is_empty();
    is_of_use.then_some(larger).into_iter().collect()
}

fn notes(study: &MotionLossStudy, rows: &[Row<'_>]) -> Vec<String> {
    let settings = if study.is_fitted {
        "robot: preset paper; its settings are fitted, the paper states none of them"
    } else {
        "motion and robot: as the parameters say, not those the outages were fitted with; \
         published rows are not judged"
    };
    vec![
        format!(
            "seed {}, {} loops and {} runs per condition; equal seeds give equal tables, and all \
             conditions meet the same outages",
            study.seed, study.parameters.loops, study.parameters.seeds
        ),
        format!("a loop counts by {}", study.trajectory.counter.text()),
        settings.to_owned(),
        "outages are exponential in length and in the time between them, both ways at once; the \
         published rates are 0 (Ethernet), 0.008 (short range), 0.03 (long range)"
            .to_owned(),
        format!(
            "error rate: rows that agree with the paper miss one of the {} criteria on published rates \
             in at most {:.0} of 100 tables of other seeds (Bonferroni)",
            test_count(rows),
            100.0 * ERROR_RATE
        ),
        "right arm only; requests to restart are not lost; the hand is followed as with resume = \
         \"jump\""
            .to_owned(),
    ]
}

impl Row<'_> {
    fn rates(&self) -> Vec<f64> {
        self.runs.iter().map(|run| run.loss_ratio()).collect()
    }

    fn mean(&self, figure: fn(&Tally) -> f64) -> Option<f64> {
        let total: f64 = self.runs.iter().map(|run| figure(run)).sum();
        (!self.runs.is_empty()).then(|| total / self.runs.len() as f64)
    }

    fn sum(&self, count: impl Fn(&Tally) -> u64) -> u64 {
        self.runs.iter().map(|run| count(run)).sum()
    }

    fn sent(&self) -> u64 {
        self.sum(|run| run.sent_count)
    }

    fn lost(&self, kind: LossKind) -> u64 {
        self.sum(|run| run.lost_counts[kind as usize])
    }

    fn name(&self) -> String {
        self.condition.name.to_owned()
    }

    /// How the rate stands to the published one; `None` where nothing was run.
    fn verdict(&self) -> Option<Verdict> {
        if self.runs.is_empty() {
            return None;
        }
        match self.condition.expected {
            Expected::Published { .. } if self.is_fitted => Some(Verdict::Fitted),
            Expected::Ethernet if self.is_fitted => {
                let of = self.sent();
                let count = self.sum(Tally::missing_count).min(of);
                let published = Share {
                    count: 0,
                    of: u64::from(PUBLISHED_LOOPS),
                };
                against_published(published, Share { count, of }, 1.0)
            }
            _ => Some(Verdict::NotComparable),
        }
    }

    /// Student's interval of the mean rate.
    fn runs_interval(&self) -> Option<(f64, f64)> {
        let interval = mean_interval(&self.rates(), CONFIDENCE)?;
        Some((interval.low.max(0.0), interval.high))
    }

    fn range(&self) -> Option<(f64, f64)> {
        let rates = self.rates();
        let lowest = rates.iter().copied().reduce(f64::min)?;
        let highest = rates.iter().copied().reduce(f64::max)?;
        Some((lowest, highest))
    }
}

fn rates(rows: &[Row<'_>]) -> Table {
    let fields: [Field<Row<'_>>; 7] = [
        Field::text("condition", "Condition", Row::name),
        Field::number("mlr_mean", "MLR", 5, |row| row.mean(Tally::loss_ratio)),
        Field::number("mlr_sd", "sd", 5, |row: &Row<'_>| deviation(&row.rates())).ranked(2),
        Field::interval("mlr_runs", "95 % of runs", 5, Row::runs_interval),
        Field::number("trips_per_hour", "Trips/h", 1, |row| {
            row.mean(|run| run.trip_count as f64 / run.hours)
        }),
        Field::number("hold_ratio", "Held", 5, |row| {
            row.mean(|run| run.hold_ratio)
        }),
        Field::verdict("against_paper", "Verdict", Row::verdict),
    ];
    Table {
        notes: vec![
            "fitted: its outages were fitted to the published rate; not comparable: nothing is \
             published of it, or motion or robot are not those of the fit"
                .to_owned(),
            "95 % of runs: Student's interval of the mean, of independent runs".to_owned(),
        ],
        ..Table::of(
            "motion-loss",
            "Motion loss rate by condition",
            &fields,
            rows,
        )
    }
}

fn counts(rows: &[Row<'_>]) -> Table {
    // In virtual time feedback is never missing, so the last kind has no column.
    let fields: [Field<Row<'_>>; 11] = [
        Field::text("condition", "Condition", Row::name),
        Field::count("run_count", "Runs", |row| row.runs.len() as u64),
        Field::count("sent_count", "Sent", Row::sent),
        Field::count("executed_count", "Executed", |row| {
            row.sum(|run| run.executed_count)
        }),
        Field::count("lost_by_trip_count", "Trip", |row| row.lost(LossKind::Trip)),
        Field::count("lost_by_hold_count", "Held", |row| row.lost(LossKind::Held)),
        Field::count("lost_by_clipping_count", "Clip", |row| {
            row.lost(LossKind::Clipped)
        }),
        Field::count("lost_by_throttling_count", "Slow", |row| {
            row.lost(LossKind::Throttled)
        }),
        Field::count("lost_by_merging_count", "Merged", |row| {
            row.lost(LossKind::Merged)
        }),
        Field::count("extra_count", "Extra", |row| row.sum(|run| run.extra_count)),
        Field::interval("mlr_range", "Lowest to highest", 5, Row::range),
    ];
    let title = "Motion loops by condition: sent, executed, lost by cause";
    Table {
        is_detail: true,
        notes: vec![
            "lost to: Trip: no session; Held: no commands; Clip: inverse kinematics; Slow: \
             MaxSpeedDeviation; Merged: none of these"
                .to_owned(),
            "lost loops are those sent ones that no executed one answers; an extra executed loop \
             hides one of them in the rate"
                .to_owned(),
        ],
        ..Table::of("motion-loss-counts", title, &fields, rows)
    }
}

fn setups(rows: &[Row<'_>]) -> Table {
    let fields: [Field<Row<'_>>; 2] = [
        Field::text("condition", "Condition", Row::name),
        Field::text("setup", "Channel and robot", |row| {
            row.condition.text.clone()
        }),
    ];
    Table {
        is_detail: true,
        ..Table::of("motion-loss-conditions", "The conditions", &fields, rows)
    }
}

/// Standard deviation of the runs.
pub(crate) fn deviation(values: &[f64]) -> Option<f64> {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    (values.len() > 1).then(|| (squares / (n - 1.0)).sqrt())
}

/// Runs of which a mean says something.
const RUNS_MIN: usize = 12;

/// How often a table misses any criterion on a published rate that holds.
const ERROR_RATE: f64 = 0.05;

/// Tests on published rates: two a row.
fn test_count(rows: &[Row<'_>]) -> usize {
    let is_published =
        |row: &&Row<'_>| matches!(row.condition.expected, Expected::Published { .. });
    2 * rows.iter().filter(is_published).count()
}

impl Row<'_> {
    fn criteria(&self, confidence: f64) -> Vec<Criterion> {
        match self.condition.expected {
            Expected::Ethernet => vec![self.nothing_lost(true)],
            Expected::NothingLost { nor_tripped } => vec![self.nothing_lost(nor_tripped)],
            Expected::Published {
                lost,
                mean_low,
                mean_high,
            } => vec![
                self.mean_in_range([mean_low, mean_high], confidence),
                self.published_among_runs(lost, confidence),
            ],
            Expected::Open => Vec::new(),
        }
    }

    fn nothing_lost(&self, nor_tripped: bool) -> Criterion {
        let lost = self.sum(Tally::missing_count);
        let unanswered = self.sum(|run| run.lost_counts.iter().sum());
        let extra = self.sum(|run| run.extra_count);
        let trips = self.sum(|run| run.trip_count);
        let trips_text = if nor_tripped {
            " and no session ends"
        } else {
            ""
        };
        let is_met = lost + unanswered + extra == 0 && (!nor_tripped || trips == 0);
        Criterion {
            text: format!("{}: MLR is 0 exactly{trips_text}", self.condition.name),
            is_met: (!self.runs.is_empty()).then_some(is_met),
            finding: format!("{lost} of {} loops lost, {trips} trips", self.sent()),
        }
    }

    /// The mean of the rates, and how far Student's interval of it reaches; `None` where motion or robot are not
    /// those of the fit, or of too few runs.
    fn judged_mean(&self, confidence: f64) -> Option<(f64, f64)> {
        let is_judged = self.is_fitted && self.runs.len() >= RUNS_MIN;
        let interval = mean_interval(&self.rates(), confidence).filter(|_| is_judged)?;
        Some((
            f64::midpoint(interval.low, interval.high),
            0.5 * (interval.high - interval.low),
        ))
    }

    fn mean_in_range(&self, [low, high]: [f64; 2], confidence: f64) -> Criterion {
        let judged = self.judged_mean(confidence);
        let mean = self.mean(Tally::loss_ratio);
        Criterion {
            text: format!(
                "{}: mean MLR of at least {RUNS_MIN} runs in {low} to {high}, by Student's interval of {:.2} %",
                self.condition.name,
                100.0 * confidence
            ),
            is_met: judged.map(|(mean, reach)| mean + reach >= low && mean - reach <= high),
            finding: mean.map_or_else(
                || "no run".to_owned(),
                |mean| {
                    let reach =
                        judged.map_or_else(String::new, |(_, reach)| format!(" ± {reach:.5}"));
                    format!("{mean:.5}{reach} in {} runs", self.runs.len())
                },
            ),
        }
    }

    /// The published run is one more of ours: Student's interval of a single further run (Hahn and Meeker 1991).
    fn published_among_runs(&self, lost: u32, confidence: f64) -> Criterion {
        let runs = &self.runs;
        // A short run's rate has another scatter than the published one's.
        let is_as_long = |run: &&Tally| run.sent_count == u64::from(PUBLISHED_LOOPS);
        let judged = self.judged_mean(confidence);
        let judged = judged.filter(|_| runs.iter().all(is_as_long));
        let published = f64::from(lost) / f64::from(PUBLISHED_LOOPS);
        let of_one = judged.map(|(mean, reach)| (mean, reach * (runs.len() as f64 + 1.0).sqrt()));
        Criterion {
            text: format!(
                "{}: the published {lost} of {PUBLISHED_LOOPS} loops lost, {published:.5}, in the range of single runs \
                 of {:.2} %",
                self.condition.name,
                100.0 * confidence
            ),
            is_met: of_one.map(|(mean, reach)| (published - mean).abs() <= reach),
            finding: of_one.map_or_else(
                || format!("{} runs, or too short ones", runs.len()),
                |(mean, reach)| format!("{:.5} to {:.5}", (mean - reach).max(0.0), mean + reach),
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_single_run_has_no_deviation() {
        assert_eq!(deviation(&[0.1]), None);
        assert!(deviation(&[1.0, 3.0]).is_some_and(|sd| (sd - 2_f64.sqrt()).abs() < 1e-12));
    }
}
