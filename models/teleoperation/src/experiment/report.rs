//! The motion-loss table and what it is held against. It computes means and intervals, nothing else.

use crate::experiment::conditions::{Condition, Expected, PUBLISHED_LOOPS};
use crate::experiment::drive::Tally;
use crate::experiment::recorded::{MotionLossRow, published_rate};
use crate::experiment::study::MotionLossStudy;
use crate::score::loops::LossKind;
use hil_core::study::{self, Cell, Column, Criterion, Field, Larger, StudyReport, Table, Verdict};
use hil_stats::comparison::{Judge, Share, against_published, mean_interval};
use hil_stats::recorded::{REPLAYS_NOTE, ROWS_NOTE, replays_summary};
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
    let judge = Judge::of_tests(test_count(rows));
    let criteria: Vec<_> = rows.iter().flat_map(|row| row.criteria(judge)).collect();
    let verdicts = rows
        .iter()
        .filter_map(|row| Some((row.name(), row.verdict()?)));
    let verdicts: Vec<_> = verdicts.collect();
    let recorded = study.recorded.iter();
    let recorded = recorded.map(|one| (one.row.method(), one.verdict));
    let named: Vec<_> = verdicts.iter().cloned().chain(recorded).collect();
    let replays = study.recorded.iter();
    let replays = replays.filter_map(|one| Some(one.replay.as_deref()?.verdict));
    let mut summary = study::summary(&named, &criteria);
    summary.extend(replays_summary(&replays.collect::<Vec<_>>()));
    StudyReport {
        title: study::title(
            "Case study 2: motion loss rate (MLR) by condition",
            !study.recorded.is_empty(),
        ),
        notes: notes(study, rows),
        tables: vec![rates(rows, &study.recorded), counts(rows), setups(rows)],
        summary,
        larger: larger(study, rows, &verdicts, &criteria),
        criteria,
    }
}

/// What more loops or more runs would decide.
fn larger(
    study: &MotionLossStudy,
    rows: &[Row<'_>],
    verdicts: &[(String, Verdict)],
    criteria: &[Criterion],
) -> Vec<Larger> {
    let parameters = &study.parameters;
    let mut needed = Vec::new();
    if parameters.loops != PUBLISHED_LOOPS {
        needed.push(format!("tables.loops={PUBLISHED_LOOPS}"));
    }
    // Longer runs scatter less, so that what short ones need is not known.
    let runs = if needed.is_empty() && study.is_fitted {
        runs_needed(rows)
    } else {
        RUNS_MIN
    };
    if (parameters.seeds as usize) < runs && runs <= SEEDS_MAX {
        needed.push(format!("tables.seeds={runs}"));
    }
    let is_open = verdicts
        .iter()
        .any(|(_, one)| *one == Verdict::Inconclusive);
    let is_short = criteria
        .iter()
        .any(|one| one.is_judged && one.is_met.is_none());
    let larger = Larger {
        of: "inconclusive and too few",
        parameters: needed,
    };
    let is_of_use = (is_open || is_short) && !larger.parameters.is_empty();
    is_of_use.then_some(larger).into_iter().collect()
}

/// Runs that decide the most of the means that can be decided, in dozens.
#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "the value is checked to lie in 0 to the number of seeds that a table can have"
)]
fn runs_needed(rows: &[Row<'_>]) -> usize {
    let judge = Judge::of_tests(test_count(rows));
    let needed = rows.iter().filter_map(|row| match row.condition.expected {
        Expected::Published {
            mean_low,
            mean_high,
            ..
        } => row.runs_needed([mean_low, mean_high], judge),
        _ => None,
    });
    let possible = needed.filter(|runs| (0.0..=SEEDS_MAX as f64).contains(runs));
    let most = possible.fold(0.0, f64::max) as usize;
    most.next_multiple_of(RUNS_MIN).clamp(RUNS_MIN, SEEDS_MAX)
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
             in at most {:.0} of 100 tables of other seeds (Bonferroni); a mean outside its range is met in at most \
             1 of 40",
            test_count(rows),
            100.0 * Judge::ERROR_RATE
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

/// Columns of the rates that only a table with recorded rows has.
const MEASURED: [Column; 6] = [
    Column::new("loops_sent", "Sent").ranked(4),
    Column::new("loops_lost", "Lost").ranked(3),
    Column::new("loss_ratio", "PLR"),
    Column::new("delay_ms", "Delay ms"),
    Column::new("delay_ms_p99", "p99 ms").ranked(1),
    Column::new("published_mlr", "Paper"),
];

/// The rates of the conditions, with the recorded rows beside those that are held against the same published rate.
fn rates(rows: &[Row<'_>], recorded: &[MotionLossRow]) -> Table {
    let mut table = rates_of_conditions(rows);
    if recorded.is_empty() {
        return table;
    }
    let end = table.columns.len() - 1;
    table.columns.splice(end..end, MEASURED);
    let recorded_at = |place: Option<usize>| {
        let is_there = move |one: &&MotionLossRow| {
            let beside = |row: &Row<'_>| one.is_beside(row.condition);
            rows.iter().rposition(beside) == place
        };
        let found = recorded.iter().filter(is_there);
        found.flat_map(|one| {
            [Some(one), one.replay.as_deref()]
                .into_iter()
                .flatten()
                .map(recorded_cells)
        })
    };
    let mut wide = Vec::new();
    for (index, (row, mut cells)) in rows.iter().zip(table.rows).enumerate() {
        let mut measured = vec![Cell::Absent; MEASURED.len() - 1];
        measured.push(published_rate(row.condition));
        cells.splice(end..end, measured);
        wide.push(cells);
        wide.extend(recorded_at(Some(index)));
    }
    wide.extend(recorded_at(None));
    table.rows = wide;
    table.notes.push(ROWS_NOTE.to_owned());
    if recorded.iter().any(|one| one.replay.is_some()) {
        table.notes.push(REPLAYS_NOTE.to_owned());
    }
    let notes = recorded.iter().map(MotionLossRow::note);
    table.notes.extend(notes);
    table
}

fn recorded_cells(one: &MotionLossRow) -> Vec<Cell> {
    let interval = one.lost.interval.map(|ends| (ends.low, ends.high));
    let mut cells = vec![
        Cell::text(one.row.method()),
        Cell::number(one.lost.ratio(), 5),
        Cell::Absent,
        Cell::interval(interval, 5),
        Cell::Absent,
        Cell::Absent,
    ];
    cells.extend(one.measured());
    cells.push(Cell::Verdict(one.verdict));
    cells
}

fn rates_of_conditions(rows: &[Row<'_>]) -> Table {
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

/// Runs per condition that a table can have.
const SEEDS_MAX: usize = 1000;

/// Tests on published rates: two a row.
fn test_count(rows: &[Row<'_>]) -> usize {
    let is_published =
        |row: &&Row<'_>| matches!(row.condition.expected, Expected::Published { .. });
    2 * rows.iter().filter(is_published).count()
}

impl Row<'_> {
    fn criteria(&self, judge: Judge) -> Vec<Criterion> {
        match self.condition.expected {
            Expected::Ethernet => vec![self.nothing_lost(true)],
            Expected::NothingLost { nor_tripped } => vec![self.nothing_lost(nor_tripped)],
            Expected::Published {
                lost,
                mean_low,
                mean_high,
            } => vec![
                self.mean_in_range([mean_low, mean_high], judge),
                self.published_among_runs(lost, judge),
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
        // One lost is enough to miss it; to meet it takes as many loops as were published.
        let is_telling = self.sent() >= u64::from(PUBLISHED_LOOPS);
        Criterion {
            text: format!("{}: MLR is 0 exactly{trips_text}", self.condition.name),
            is_met: (!self.runs.is_empty() && (!is_met || is_telling)).then_some(is_met),
            is_judged: true,
            finding: format!("{lost} of {} loops lost, {trips} trips", self.sent()),
        }
    }

    /// A criterion on a published rate, which is judged by at least [`RUNS_MIN`] runs of motion and robot of the fit.
    fn on_published(
        &self,
        text: &str,
        finding: Option<String>,
        is_met: impl FnOnce() -> Option<bool>,
    ) -> Criterion {
        let count = self.runs.len();
        Criterion {
            text: format!("{}: {text}", self.condition.name),
            is_met: (self.is_fitted && count >= RUNS_MIN).then(is_met).flatten(),
            is_judged: self.is_fitted,
            finding: if self.is_fitted {
                finding.map_or_else(
                    || format!("{count} runs"),
                    |one| format!("{one}, of {count} runs"),
                )
            } else {
                "not the fit's motion or robot".to_owned()
            },
        }
    }

    /// How the mean stands to its range, and the interval that this is judged by.
    fn mean_verdict(&self, [low, high]: [f64; 2], judge: Judge) -> Option<bool> {
        judge.verdict(
            |confidence| mean_interval(&self.rates(), confidence),
            |mean| mean.low >= low && mean.high <= high,
            |mean| mean.high < low || mean.low > high,
        )
    }

    fn mean_in_range(&self, [low, high]: [f64; 2], judge: Judge) -> Criterion {
        let finding = self.mean(Tally::loss_ratio).map(|mean| {
            let interval = self.runs_interval();
            let interval = interval.map_or_else(String::new, |(low, high)| {
                format!(", {low:.5} to {high:.5} (95 %)")
            });
            format!("{mean:.5}{interval}")
        });
        let text = format!("mean MLR of at least {RUNS_MIN} runs in {low} to {high}");
        self.on_published(&text, finding, || self.mean_verdict([low, high], judge))
    }

    /// Runs of which the interval of the mean would lie on one side of the ends of its range, if mean and scatter stay as
    /// they are: twice as many as just would. `None` where it does, or where no number is known.
    fn runs_needed(&self, range: [f64; 2], judge: Judge) -> Option<f64> {
        if self.runs.len() >= RUNS_MIN && self.mean_verdict(range, judge).is_some() {
            return None;
        }
        let mean = self.mean(Tally::loss_ratio)?;
        let is_inside = (range[0]..=range[1]).contains(&mean);
        let confidence = if is_inside {
            CONFIDENCE
        } else {
            judge.miss_confidence()
        };
        let interval = mean_interval(&self.rates(), confidence)?;
        let reach = 0.5 * (interval.high - interval.low);
        let to_end = range.map(|end| (mean - end).abs());
        Some(2.0 * self.runs.len() as f64 * (reach / to_end[0].min(to_end[1])).powi(2))
    }

    /// The range of a single further run (Hahn and Meeker 1991).
    fn single_run(&self, confidence: f64) -> Option<(f64, f64)> {
        let mean = mean_interval(&self.rates(), confidence)?;
        let middle = f64::midpoint(mean.low, mean.high);
        let reach = (middle - mean.low) * (self.runs.len() as f64 + 1.0).sqrt();
        Some((middle - reach, middle + reach))
    }

    /// The published run is one more of ours. A range that holds a run without a lost loop would hold any small rate: it
    /// says nothing.
    fn published_among_runs(&self, lost: u32, judge: Judge) -> Criterion {
        // A short run's rate has another scatter than the published one's.
        let is_as_long = |run: &&Tally| run.sent_count == u64::from(PUBLISHED_LOOPS);
        let is_as_long = self.runs.iter().all(is_as_long);
        let published = f64::from(lost) / f64::from(PUBLISHED_LOOPS);
        let finding = match self.single_run(CONFIDENCE) {
            _ if !is_as_long => Some(format!("not all of {PUBLISHED_LOOPS} loops")),
            range => range.map(|(low, high)| format!("{:.5} to {high:.5}", low.max(0.0))),
        };
        let text = format!(
            "the published {lost} of {PUBLISHED_LOOPS} loops lost, {published:.5}, in the range of 95 % of single runs, \
             and none lost outside it"
        );
        let is_within = |&(low, high): &(f64, f64)| low <= published && published <= high;
        self.on_published(&text, finding, || {
            judge
                .verdict(
                    |confidence| self.single_run(confidence),
                    |range| range.0 > 0.0 && is_within(range),
                    |range| !is_within(range),
                )
                .filter(|_| is_as_long)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::conditions::{base, conditions};
    use crate::score::loops::LostByKind;
    use crate::{Teleoperation, TeleoperationParameters};
    use hil_core::case_study::CaseStudy as _;

    fn condition(name: &str) -> Condition {
        let case = Teleoperation::new(TeleoperationParameters::default(), 1).unwrap();
        let mut all = conditions(&base(&case)).into_iter();
        all.find(|one| one.name == name).unwrap()
    }

    /// A run for each number of lost loops.
    fn runs(lost: &[u64], sent_count: u64) -> Vec<Tally> {
        let run = |lost: &u64| {
            let mut lost_counts = LostByKind::default();
            lost_counts[LossKind::Trip as usize] = *lost;
            Tally {
                sent_count,
                executed_count: sent_count - lost,
                extra_count: 0,
                lost_counts,
                lost: Vec::new(),
                trip_count: 0,
                hours: 1.0,
                hold_ratio: 0.0,
            }
        };
        lost.iter().map(run).collect()
    }

    fn row<'a>(condition: &'a Condition, runs: &'a [Tally], is_fitted: bool) -> Row<'a> {
        Row {
            condition,
            runs: runs.iter().collect(),
            is_fitted,
        }
    }

    #[test]
    fn a_published_rate_is_met_only_by_what_would_miss_another() {
        let condition = condition("short-range");
        // Two criteria: a miss is by 97.5 %. Student's quantiles of 11 degrees of freedom are 2.20099 and 2.59309.
        let judge = Judge::of_tests(2);
        let check = |lost: [u64; 12], loops, mean, single| {
            let runs = runs(&lost, loops);
            let criteria = row(&condition, &runs, true).criteria(judge);
            assert_eq!(
                [criteria[0].is_met, criteria[1].is_met],
                [mean, single],
                "{criteria:?}"
            );
        };
        // 0.0167, 0.0043 to 0.0290: 0.006 to 0.011 is in it, not the other way around.
        check([0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2], 40, None, None);
        // 0.0081 to 0.0088; single runs 0.0071 to 0.0098, the published 0.0079.
        let close = [7, 7, 7, 7, 7, 7, 8, 8, 8, 8, 8, 8];
        check(close, 890, Some(true), Some(true));
        // 0.0083 to 0.0117; single runs 0.0040 to 0.0161.
        let wide = [7, 7, 7, 8, 8, 8, 8, 9, 9, 9, 12, 15];
        check(wide, 890, None, Some(true));
        // By 97.5 %, 0.0136 to 0.0145; single runs 0.0125 to 0.0156.
        let high = [12, 13, 12, 13, 12, 13, 12, 13, 12, 13, 12, 13];
        check(high, 890, Some(false), Some(false));
        // 0.0103 to 0.01105; single runs by 97.5 % 0.0091 to 0.0123.
        let edge = [9, 10, 9, 10, 9, 10, 9, 10, 9, 10, 9, 10];
        check(edge, 890, None, Some(false));
        // Single runs from -0.023 to 0.040: none lost is in it.
        let clumped = [0, 0, 0, 0, 0, 0, 1, 1, 2, 20, 25, 35];
        check(clumped, 890, None, None);
        // 0.01002 is 0.00098 from the end of its range, the interval reaches 0.00168: 24 (0.00168 / 0.00098)^2 = 70.3.
        let runs_of = |lost: &[u64]| runs_needed(&[row(&condition, &runs(lost, 890), true)]);
        assert_eq!((runs_of(&wide), runs_of(&close)), (72, RUNS_MIN));
    }

    #[test]
    fn a_row_of_another_motion_or_robot_is_not_too_small_but_not_judged() {
        let condition = condition("short-range");
        let runs = runs(&[7; 12], 890);
        let row = row(&condition, &runs, false);
        for criterion in row.criteria(Judge::of_tests(2)) {
            assert_eq!((criterion.is_met, criterion.is_judged), (None, false));
            assert_eq!(criterion.finding, "not the fit's motion or robot");
        }
    }

    #[test]
    fn nothing_lost_of_fewer_loops_than_were_published_meets_nothing() {
        for name in ["perfect", "loss-0.5"] {
            let condition = condition(name);
            let is_met = |lost, loops| {
                let runs = runs(&[lost], loops);
                row(&condition, &runs, true).criteria(Judge::of_tests(0))[0].is_met
            };
            assert_eq!(is_met(0, 180), None);
            assert_eq!(is_met(1, 180), Some(false));
            assert_eq!(is_met(0, 890), Some(true));
        }
    }

    #[test]
    fn a_single_run_has_no_deviation() {
        assert_eq!(deviation(&[0.1]), None);
        assert!(deviation(&[1.0, 3.0]).is_some_and(|sd| (sd - 2_f64.sqrt()).abs() < 1e-12));
    }
}
