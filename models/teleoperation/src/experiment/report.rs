//! The motion-loss table and what it is held against. It computes means and intervals, nothing else.

use crate::experiment::conditions::{Condition, Expected, PUBLISHED_LOOPS};
use crate::experiment::drive::Tally;
use crate::experiment::study::MotionLossStudy;
use crate::score::loops::LossCause;
use hil_core::study::{Cell, Column, Criterion, StudyReport, Table};
use hil_stats::series::Estimate;
use hil_stats::statistics::{CONFIDENCE, poisson};

/// A condition with the runs of it that ended.
#[derive(Debug)]
pub(crate) struct Row<'a> {
    /// What it is about.
    pub(crate) condition: &'a Condition,
    /// The runs that ended.
    pub(crate) runs: Vec<&'a Tally>,
}

/// The whole report.
pub(crate) fn report(study: &MotionLossStudy, rows: &[Row<'_>]) -> StudyReport {
    StudyReport {
        title: "Case study 2: motion loss rate (MLR) by condition, in virtual time".to_owned(),
        notes: notes(study),
        tables: vec![rates(rows), counts(rows), setups(rows)],
        summary: Vec::new(),
        criteria: rows
            .iter()
            .flat_map(|row| criteria(row, study.is_fitted))
            .collect(),
    }
}

fn notes(study: &MotionLossStudy) -> Vec<String> {
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
        "right arm only; requests to restart are not lost; the hand is followed as with resume = \
         \"jump\""
            .to_owned(),
    ]
}

pub(super) const fn column(name: &'static str, label: &'static str) -> Column {
    Column { name, label }
}

const RATE_COLUMNS: [Column; 7] = [
    column("condition", "Condition"),
    column("mlr_mean", "MLR"),
    column("mlr_sd", "sd"),
    column("mlr_runs", "95 % of runs"),
    column("mlr_poisson", "95 % Poisson"),
    column("trips_per_hour", "Trips/h"),
    column("hold_ratio", "Held"),
];

fn rates(rows: &[Row<'_>]) -> Table {
    Table {
        name: "motion-loss".to_owned(),
        title: "Motion loss rate by condition".to_owned(),
        columns: RATE_COLUMNS.to_vec(),
        rows: rows.iter().map(rate_cells).collect(),
        notes: vec![
            "95 % of runs: Student's interval of the mean; Poisson: of all runs' missing loops"
                .to_owned(),
        ],
    }
}

const COUNT_COLUMNS: [Column; 11] = [
    column("condition", "Condition"),
    column("run_count", "Runs"),
    column("sent_count", "Sent"),
    column("executed_count", "Executed"),
    column("lost_by_trip_count", "Trip"),
    column("lost_by_hold_count", "Held"),
    column("lost_by_clipping_count", "Clip"),
    column("lost_by_throttling_count", "Slow"),
    column("lost_by_merging_count", "Merged"),
    column("extra_count", "Extra"),
    column("mlr_range", "Lowest to highest"),
];

fn counts(rows: &[Row<'_>]) -> Table {
    Table {
        name: "motion-loss-counts".to_owned(),
        title: "Motion loops by condition: sent, executed, lost by cause".to_owned(),
        columns: COUNT_COLUMNS.to_vec(),
        rows: rows.iter().map(count_cells).collect(),
        notes: vec![
            "lost to: Trip: no session; Held: no commands; Clip: inverse kinematics; Slow: \
             MaxSpeedDeviation; Merged: none of these"
                .to_owned(),
            "lost loops are those sent ones that no executed one answers; an extra executed loop \
             hides one of them in the rate"
                .to_owned(),
        ],
    }
}

fn setups(rows: &[Row<'_>]) -> Table {
    let named = |row: &Row<'_>| {
        vec![
            Cell::text(row.condition.name),
            Cell::text(&row.condition.text),
        ]
    };
    Table {
        name: "motion-loss-conditions".to_owned(),
        title: "The conditions".to_owned(),
        columns: vec![
            column("condition", "Condition"),
            column("setup", "Channel and robot"),
        ],
        rows: rows.iter().map(named).collect(),
        notes: Vec::new(),
    }
}

fn rates_of(runs: &[&Tally]) -> Vec<f64> {
    runs.iter().map(|run| run.loss_ratio()).collect()
}

fn sum(runs: &[&Tally], count: impl Fn(&Tally) -> u64) -> u64 {
    runs.iter().map(|run| count(run)).sum()
}

fn rate_cells(row: &Row<'_>) -> Vec<Cell> {
    let runs = &row.runs;
    let mean = |figure: fn(&Tally) -> f64| {
        let total: f64 = runs.iter().map(|run| figure(run)).sum();
        (!runs.is_empty()).then(|| total / runs.len() as f64)
    };
    let rates = rates_of(runs);
    let interval = Estimate::of_mean(&rates).and_then(|known| known.interval);
    let sent = sent(runs);
    let missing = poisson(sum(runs, Tally::missing_count), CONFIDENCE);
    let of_sent = |value: f64| value / sent as f64;
    vec![
        Cell::text(row.condition.name),
        Cell::number(mean(Tally::loss_ratio), 5),
        Cell::number(deviation(&rates), 5),
        Cell::interval(interval.map(|(low, high)| (low.max(0.0), high)), 5),
        Cell::interval(
            (sent > 0).then(|| (of_sent(missing.low), of_sent(missing.high))),
            5,
        ),
        Cell::number(mean(|run| run.trip_count as f64 / run.hours), 1),
        Cell::number(mean(|run| run.hold_ratio), 5),
    ]
}

fn count_cells(row: &Row<'_>) -> Vec<Cell> {
    let runs = &row.runs;
    let rates = rates_of(runs);
    let lowest = rates.iter().copied().fold(f64::INFINITY, f64::min);
    let highest = rates.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let mut cells = vec![
        Cell::text(row.condition.name),
        Cell::Count(runs.len() as u64),
        Cell::Count(sent(runs)),
        Cell::Count(sum(runs, |run| run.executed_count)),
    ];
    // In virtual time feedback is never missing, so the last kind has no column.
    let kinds = 0..LossCause::Unseen.kind();
    cells.extend(kinds.map(|kind| Cell::Count(sum(runs, |run| run.lost_counts[kind]))));
    cells.extend([
        Cell::Count(sum(runs, |run| run.extra_count)),
        Cell::interval((!rates.is_empty()).then_some((lowest, highest)), 5),
    ]);
    cells
}

/// Standard deviation of the runs.
pub(crate) fn deviation(values: &[f64]) -> Option<f64> {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    (values.len() > 1).then(|| (squares / (n - 1.0)).sqrt())
}

fn criteria(row: &Row<'_>, is_fitted: bool) -> Vec<Criterion> {
    let Row { condition, runs } = row;
    match condition.expected {
        Expected::NothingLost { nor_tripped } => vec![nothing_lost(condition, runs, nor_tripped)],
        Expected::Published {
            lost,
            mean_low,
            mean_high,
        } => vec![
            mean_in_range(condition, runs, mean_low, mean_high, is_fitted),
            runs_in_interval(condition, runs, lost, is_fitted),
        ],
        Expected::Open => Vec::new(),
    }
}

fn nothing_lost(condition: &Condition, runs: &[&Tally], nor_tripped: bool) -> Criterion {
    let lost = sum(runs, Tally::missing_count);
    let unanswered = sum(runs, |run| run.lost_counts.iter().sum());
    let extra = sum(runs, |run| run.extra_count);
    let trips = sum(runs, |run| run.trip_count);
    let trips_text = if nor_tripped {
        " and no session ends"
    } else {
        ""
    };
    let is_met = lost + unanswered + extra == 0 && (!nor_tripped || trips == 0);
    Criterion {
        text: format!("{}: MLR is 0 exactly{trips_text}", condition.name),
        is_met: (!runs.is_empty()).then_some(is_met),
        finding: format!("{lost} of {} loops lost, {trips} trips", sent(runs)),
    }
}

fn sent(runs: &[&Tally]) -> u64 {
    sum(runs, |run| run.sent_count)
}

/// Runs of which a mean says something.
const RUNS_MIN: usize = 12;

fn mean_in_range(
    condition: &Condition,
    runs: &[&Tally],
    low: f64,
    high: f64,
    is_fitted: bool,
) -> Criterion {
    let rates = rates_of(runs);
    let mean = rates.iter().sum::<f64>() / rates.len().max(1) as f64;
    let is_judged = is_fitted && runs.len() >= RUNS_MIN;
    Criterion {
        text: format!(
            "{}: mean MLR of at least {RUNS_MIN} runs in {low} to {high}",
            condition.name
        ),
        is_met: is_judged.then(|| (low..=high).contains(&mean)),
        finding: if runs.is_empty() {
            "no run".to_owned()
        } else {
            format!("{mean:.5} in {} runs", runs.len())
        },
    }
}

/// A run that agrees with the published one lies in the interval of its count in 95 % of cases, so
/// some may lie outside: as many as chance allows in one of 40 tables.
fn runs_in_interval(
    condition: &Condition,
    runs: &[&Tally],
    lost: u32,
    is_fitted: bool,
) -> Criterion {
    let interval = poisson(u64::from(lost), CONFIDENCE);
    let of_published = |run: &&&Tally| {
        let missing = run.loss_ratio() * f64::from(PUBLISHED_LOOPS);
        (interval.low..=interval.high).contains(&missing)
    };
    let inside = runs.iter().filter(of_published).count();
    let needed = fewest_inside(runs.len());
    // A short run's count has another scatter than the published one's.
    let is_judged = is_fitted
        && !runs.is_empty()
        && runs
            .iter()
            .all(|run| run.sent_count == u64::from(PUBLISHED_LOOPS));
    Criterion {
        text: format!(
            "{}: single runs of {PUBLISHED_LOOPS} loops in the Poisson interval of {lost} lost, \
             {:.1} to {:.1}; at least {needed} of {}",
            condition.name,
            interval.low,
            interval.high,
            runs.len()
        ),
        is_met: is_judged.then_some(inside >= needed),
        finding: format!("{inside} of {} inside; 95 % are expected", runs.len()),
    }
}

/// The 2.5 % quantile of the number inside when each is with probability 0.95.
fn fewest_inside(count: usize) -> usize {
    let mut probability = 0.95_f64.powi(i32::try_from(count).unwrap_or(i32::MAX));
    let (mut inside, mut at_least) = (count, probability);
    while inside > 0 && at_least < 0.975 {
        // From `inside` to one fewer, by the ratio of binomial terms.
        let outside = (count - inside) as f64;
        probability *= inside as f64 / (outside + 1.0) * (0.05 / 0.95);
        at_least += probability;
        inside -= 1;
    }
    inside
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chance_may_put_two_of_twelve_runs_outside() {
        // P(at most 9 of 12) is 2.0 %, P(at most 10) is 11.8 %.
        assert_eq!(fewest_inside(12), 10);
        assert_eq!(fewest_inside(1), 0);
        assert_eq!(fewest_inside(100), 90);
    }

    #[test]
    fn a_single_run_has_no_deviation() {
        assert_eq!(deviation(&[0.1]), None);
        assert!(deviation(&[1.0, 3.0]).is_some_and(|sd| (sd - 2_f64.sqrt()).abs() < 1e-12));
    }
}
