//! A study: a batch of independent computations in virtual time that ends in tables. It owns no
//! thread and reads no clock; whoever has processors runs its tasks, in any order and number at
//! once, and the tables come out the same.

use core::any::Any;
use core::fmt::Debug;

use serde::Serialize;

use crate::case_study::ParameterError;

/// Looks in on a running task: it hands over the share done, 0..=1, and is told whether to go on.
pub type Watch<'a> = &'a mut dyn FnMut(f64) -> bool;

/// What a case study implements to offer tables.
pub trait Study: Debug + Sync {
    /// What a task finds out.
    type Outcome: Debug + Send + 'static;

    /// Number of tasks; they are numbered from 0.
    fn task_count(&self) -> usize;

    /// What the task is about, for a progress line.
    fn label(&self, task: usize) -> String;

    /// Runs one task. Equal tasks give equal outcomes, whichever thread runs them and whatever
    /// ran before. `None` when `watch` said stop.
    fn run(&self, task: usize, watch: Watch<'_>) -> Option<Self::Outcome>;

    /// The tables, from what is there: a task that did not end has no outcome.
    fn report(&self, outcomes: &[Option<&Self::Outcome>]) -> StudyReport;
}

/// A [`Study`] whose kind of outcome is no longer known: what a registry keeps. Made by
/// [`into_batch`].
pub trait Batch: Debug + Sync {
    /// See [`Study::task_count`].
    fn task_count(&self) -> usize;

    /// See [`Study::label`].
    fn label(&self, task: usize) -> String;

    /// See [`Study::run`].
    fn run(&self, task: usize, watch: Watch<'_>) -> Option<TaskOutcome>;

    /// See [`Study::report`]; an outcome of another study counts as none.
    fn report(&self, outcomes: &[Option<TaskOutcome>]) -> StudyReport;
}

/// What a task found out, to be handed back to the study it came from.
pub struct TaskOutcome(Box<dyn Any + Send>);

impl Debug for TaskOutcome {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("TaskOutcome").finish_non_exhaustive()
    }
}

/// Hides the kind of outcome of `study`.
pub fn into_batch<S: Study + 'static>(study: S) -> Box<dyn Batch> {
    Box::new(ErasedStudy(study))
}

#[derive(Debug)]
struct ErasedStudy<S>(S);

impl<S: Study> Batch for ErasedStudy<S> {
    fn task_count(&self) -> usize {
        self.0.task_count()
    }

    fn label(&self, task: usize) -> String {
        self.0.label(task)
    }

    fn run(&self, task: usize, watch: Watch<'_>) -> Option<TaskOutcome> {
        let outcome = self.0.run(task, watch)?;
        Some(TaskOutcome(Box::new(outcome)))
    }

    fn report(&self, outcomes: &[Option<TaskOutcome>]) -> StudyReport {
        let known: Vec<_> = outcomes
            .iter()
            .map(|outcome| outcome.as_ref()?.0.downcast_ref::<S::Outcome>())
            .collect();
        self.0.report(&known)
    }
}

/// Why a case makes no study of its parameters and the recorded runs.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum StudyRefusal {
    /// A parameter keeps the tables from being computed.
    #[error(transparent)]
    Parameter(#[from] ParameterError),
    /// A recorded run can be no row.
    #[error("{folder}: {problem}")]
    Run {
        /// Its folder.
        folder: String,
        /// What is wrong with it.
        problem: String,
    },
}

/// What a study comes to.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct StudyReport {
    /// What was studied, one line.
    pub title: String,
    /// What a reader must know before the tables: seed, method.
    pub notes: Vec<String>,
    /// The tables.
    pub tables: Vec<Table>,
    /// What the figures were held against.
    pub criteria: Vec<Criterion>,
    /// What follows from all of it, in a few lines, last on a page.
    pub summary: Vec<String>,
    /// What this sample is too small for, and the parameters of one that is not.
    pub larger: Vec<Larger>,
}

/// The parameters of a sample that is large enough for what this one cannot judge.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Larger {
    /// What it judges, in the plural.
    pub of: &'static str,
    /// `key=value` each, the key below `case.parameters`.
    pub parameters: Vec<String>,
}

hil_core::labelled! {
    /// How a row stands to the published one.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
    #[serde(rename_all = "kebab-case")]
    pub enum Verdict, words {
        /// No difference at 5 %, in a sample of half the published one's size or more.
        Agrees = "agrees",
        /// The interval of the difference does not hold zero.
        Differs = "differs",
        /// No difference at 5 %, in a smaller sample.
        Inconclusive = "inconclusive",
        /// Parameters of the row were fitted to the published value.
        Fitted = "fitted",
        /// Nothing is published of the row, or of something else.
        NotComparable = "not comparable",
    }
}

/// What is studied, and in what time its rows ran.
pub fn title(of: &str, has_recorded_runs: bool) -> String {
    if has_recorded_runs {
        format!("{of}, in virtual time and of recorded runs")
    } else {
        format!("{of}, in virtual time")
    }
}

/// What the rows, each with its name, and the criteria come to: at most three lines.
pub fn summary(rows: &[(String, Verdict)], criteria: &[Criterion]) -> Vec<String> {
    let of = |wanted: Verdict| rows.iter().filter(move |(_, verdict)| *verdict == wanted);
    let mut lines = Vec::new();
    if !rows.is_empty() {
        let counts = Verdict::ALL.map(|one| format!("{} {}", one.words(), of(one).count()));
        let counts = counts.join(", ");
        lines.push(format!(
            "Against the paper, of {} rows: {counts}; one in twenty differs by chance.",
            rows.len()
        ));
        let differing: Vec<&str> = of(Verdict::Differs)
            .map(|(name, _)| name.as_str())
            .collect();
        if !differing.is_empty() {
            lines.push(format!("These differ: {}.", differing.join("; ")));
        }
    }
    if !criteria.is_empty() {
        let judged = criteria.iter().filter(|one| one.is_judged);
        let count = |is_met| judged.clone().filter(|one| one.is_met == is_met).count();
        let not_judged = match criteria.len() - judged.clone().count() {
            0 => String::new(),
            count => format!(", not judged {count}"),
        };
        lines.push(format!(
            "Of {} criteria: met {}, missed {}, too few to judge {}{not_judged}.",
            criteria.len(),
            count(Some(true)),
            count(Some(false)),
            count(None)
        ));
    }
    lines
}

impl StudyReport {
    /// True when no criterion that could be judged is missed.
    pub fn is_passed(&self) -> bool {
        let is_missed = |criterion: &Criterion| criterion.is_met == Some(false);
        !self.criteria.iter().any(is_missed)
    }
}

/// One table.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Table {
    /// Short name without blanks: the file it is written to.
    pub name: String,
    /// What stands above it.
    pub title: String,
    /// Its columns.
    pub columns: Vec<Column>,
    /// Its rows, each with one cell per column.
    pub rows: Vec<Vec<Cell>>,
    /// What stands below it.
    pub notes: Vec<String>,
    /// Only a page with every figure has it.
    pub is_detail: bool,
}

impl Table {
    /// A table with a row for each of `rows`.
    pub fn of<T>(name: &str, title: &str, fields: &[Field<T>], rows: &[T]) -> Self {
        let cells = |row| Field::cells(fields, Some(row)).collect();
        Self {
            name: name.to_owned(),
            title: title.to_owned(),
            columns: Field::columns(fields).collect(),
            rows: rows.iter().map(cells).collect(),
            ..Self::default()
        }
    }
}

/// One column of a table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Column {
    /// Snake-case name with unit suffix, for a file.
    pub name: &'static str,
    /// The words a page prints.
    pub label: &'static str,
    /// Zero is always shown; where there is no room, the highest goes first.
    pub rank: u8,
}

impl Column {
    /// The column `name` under `label`.
    pub const fn new(name: &'static str, label: &'static str) -> Self {
        let rank = 0;
        Self { name, label, rank }
    }

    /// With a rank.
    #[must_use]
    pub const fn ranked(self, rank: u8) -> Self {
        Self { rank, ..self }
    }
}

/// A column with the figure that it shows of a `T`.
#[derive(Debug)]
pub struct Field<T> {
    column: Column,
    figure: Figure<T>,
}

#[derive(Debug)]
enum Figure<T> {
    Text(fn(&T) -> String),
    Count(fn(&T) -> u64),
    Number {
        value: fn(&T) -> Option<f64>,
        decimals: usize,
    },
    Interval {
        ends: fn(&T) -> Option<(f64, f64)>,
        decimals: usize,
    },
    Verdict(fn(&T) -> Option<Verdict>),
}

impl<T> Field<T> {
    /// With a rank, see [`Column::rank`].
    #[must_use]
    pub const fn ranked(mut self, rank: u8) -> Self {
        self.column.rank = rank;
        self
    }

    /// A column of verdicts.
    pub const fn verdict(
        name: &'static str,
        label: &'static str,
        verdict: fn(&T) -> Option<Verdict>,
    ) -> Self {
        Self {
            column: Column::new(name, label),
            figure: Figure::Verdict(verdict),
        }
    }

    /// A column of words.
    pub const fn text(name: &'static str, label: &'static str, text: fn(&T) -> String) -> Self {
        Self {
            column: Column::new(name, label),
            figure: Figure::Text(text),
        }
    }

    /// A column of numbers of things.
    pub const fn count(name: &'static str, label: &'static str, count: fn(&T) -> u64) -> Self {
        Self {
            column: Column::new(name, label),
            figure: Figure::Count(count),
        }
    }

    /// A column of figures, printed with so many decimals.
    pub const fn number(
        name: &'static str,
        label: &'static str,
        decimals: usize,
        value: fn(&T) -> Option<f64>,
    ) -> Self {
        Self {
            column: Column::new(name, label),
            figure: Figure::Number { value, decimals },
        }
    }

    /// A column of intervals, printed with so many decimals.
    pub const fn interval(
        name: &'static str,
        label: &'static str,
        decimals: usize,
        ends: fn(&T) -> Option<(f64, f64)>,
    ) -> Self {
        Self {
            column: Column::new(name, label),
            figure: Figure::Interval { ends, decimals },
        }
    }

    /// The columns of `fields`.
    pub fn columns(fields: &[Self]) -> impl Iterator<Item = Column> {
        fields.iter().map(|field| field.column)
    }

    /// The cells of `fields` in the row of `of`; without it they are empty.
    pub fn cells(fields: &[Self], of: Option<&T>) -> impl Iterator<Item = Cell> {
        fields.iter().map(move |field| match (of, &field.figure) {
            (None, _) => Cell::Absent,
            (Some(of), Figure::Text(text)) => Cell::Text(text(of)),
            (Some(of), Figure::Count(count)) => Cell::Count(count(of)),
            (Some(of), Figure::Number { value, decimals }) => Cell::number(value(of), *decimals),
            (Some(of), Figure::Interval { ends, decimals }) => Cell::interval(ends(of), *decimals),
            (Some(of), Figure::Verdict(verdict)) => Cell::verdict(verdict(of)),
        })
    }
}

/// One cell of a table.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Cell {
    /// Words.
    Text(String),
    /// A number of things.
    Count(u64),
    /// A figure, printed with so many decimals.
    Number {
        /// The figure.
        value: f64,
        /// Digits behind the point on a page.
        decimals: usize,
    },
    /// An interval, printed with so many decimals.
    Interval {
        /// Lower end.
        low: f64,
        /// Upper end.
        high: f64,
        /// Digits behind the point on a page.
        decimals: usize,
    },
    /// How the row stands to the published one.
    Verdict(Verdict),
    /// No figure.
    Absent,
}

impl Cell {
    /// The cell of a text.
    pub fn text(text: impl Into<String>) -> Self {
        Self::Text(text.into())
    }

    /// The cell of a figure that may be missing or not finite.
    pub fn number(value: Option<f64>, decimals: usize) -> Self {
        match value {
            Some(value) if value.is_finite() => Self::Number { value, decimals },
            _ => Self::Absent,
        }
    }

    /// The cell of an interval that may be missing.
    pub fn interval(ends: Option<(f64, f64)>, decimals: usize) -> Self {
        match ends {
            Some((low, high)) => Self::Interval {
                low,
                high,
                decimals,
            },
            None => Self::Absent,
        }
    }

    /// True for the verdict that the row differs from the published one.
    pub fn is_difference(&self) -> bool {
        *self == Self::Verdict(Verdict::Differs)
    }

    /// The cell of a verdict that may be missing.
    pub fn verdict(verdict: Option<Verdict>) -> Self {
        verdict.map_or(Self::Absent, Self::Verdict)
    }
}

/// Something the figures were held against.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Criterion {
    /// What was asked.
    pub text: String,
    /// Whether it is met; `None` when there was too little to judge.
    pub is_met: Option<bool>,
    /// False where no size of the sample would get it judged; what was found says why.
    pub is_judged: bool,
    /// What was found, and how to see it again.
    pub finding: String,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Adds up the numbers below its task's number, one at a time.
    #[derive(Debug)]
    struct Sums;

    impl Study for Sums {
        type Outcome = u64;

        fn task_count(&self) -> usize {
            4
        }

        fn label(&self, task: usize) -> String {
            format!("sum below {task}")
        }

        fn run(&self, task: usize, watch: Watch<'_>) -> Option<u64> {
            let mut sum = 0;
            for number in 0..task {
                if !watch(number as f64 / task as f64) {
                    return None;
                }
                sum += number as u64;
            }
            Some(sum)
        }

        fn report(&self, outcomes: &[Option<&u64>]) -> StudyReport {
            let cell = |sum: &u64| Cell::Count(*sum);
            let row = outcomes
                .iter()
                .map(|outcome| outcome.map_or(Cell::Absent, cell))
                .collect();
            StudyReport {
                tables: vec![Table {
                    rows: vec![row],
                    ..Table::default()
                }],
                ..StudyReport::default()
            }
        }
    }

    #[test]
    fn an_erased_study_gives_its_outcomes_back_to_itself() {
        let batch = into_batch(Sums);
        let outcomes: Vec<_> = (0..batch.task_count())
            .map(|task| batch.run(task, &mut |_| true))
            .collect();
        let report = batch.report(&outcomes);
        let expected = [0, 0, 1, 3].map(Cell::Count).to_vec();
        assert_eq!(report.tables[0].rows, [expected]);
    }

    #[test]
    fn a_stopped_task_has_no_outcome_and_leaves_its_cell_empty() {
        let batch = into_batch(Sums);
        let outcomes = [
            batch.run(1, &mut |_| true),
            batch.run(3, &mut |done| done < 0.5),
        ];
        let report = batch.report(&outcomes);
        assert_eq!(report.tables[0].rows, [vec![Cell::Count(0), Cell::Absent]]);
    }

    #[test]
    fn only_a_missed_criterion_fails_a_report() {
        let criterion = |is_met| Criterion {
            text: "no collision".to_owned(),
            is_met,
            is_judged: true,
            finding: String::new(),
        };
        let report = |criteria| StudyReport {
            criteria,
            ..StudyReport::default()
        };
        assert!(report(vec![criterion(Some(true)), criterion(None)]).is_passed());
        assert!(!report(vec![criterion(Some(true)), criterion(Some(false))]).is_passed());
    }

    #[test]
    fn fields_give_columns_and_cells_and_empty_cells_of_nothing() {
        const FIELDS: [Field<u64>; 4] = [
            Field::text("parity", "Parity", |n| {
                if n % 2 == 0 { "even" } else { "odd" }.to_owned()
            }),
            Field::count("number", "Number", |n| *n),
            Field::number("inverse", "Inverse", 2, |n| {
                (*n > 0).then(|| 1.0 / *n as f64)
            }),
            Field::interval("around", "Around", 1, |n| {
                Some((*n as f64 - 0.5, *n as f64 + 0.5))
            }),
        ];
        let labels: Vec<_> = Field::columns(&FIELDS).map(|column| column.label).collect();
        assert_eq!(labels, ["Parity", "Number", "Inverse", "Around"]);
        let cells = |of| -> Vec<Cell> { Field::cells(&FIELDS, of).collect() };
        let expected = [
            Cell::text("even"),
            Cell::Count(4),
            Cell::number(Some(0.25), 2),
            Cell::interval(Some((3.5, 4.5)), 1),
        ];
        assert_eq!(cells(Some(&4)), expected);
        assert_eq!(cells(Some(&0))[2], Cell::Absent);
        assert_eq!(cells(None), vec![Cell::Absent; 4]);
    }

    #[test]
    fn a_figure_that_is_no_number_is_absent() {
        assert_eq!(Cell::number(Some(f64::NAN), 2), Cell::Absent);
        assert_eq!(Cell::interval(None, 2), Cell::Absent);
    }

    #[test]
    fn a_summary_counts_verdicts_and_criteria_and_names_what_differs() {
        let rows = [
            ("harbor, 0 ms", Verdict::Agrees),
            ("harbor, 100 ms", Verdict::Differs),
            ("short-range", Verdict::Fitted),
        ];
        let rows = rows.map(|(name, verdict)| (name.to_owned(), verdict));
        let criterion = |is_met| Criterion {
            text: String::new(),
            is_met,
            is_judged: true,
            finding: String::new(),
        };
        let criteria = [criterion(Some(true)), criterion(None)];
        assert_eq!(
            summary(&rows, &criteria),
            [
                "Against the paper, of 3 rows: agrees 1, differs 1, inconclusive 0, fitted 1, \
                 not comparable 0; one in twenty differs by chance.",
                "These differ: harbor, 100 ms.",
                "Of 2 criteria: met 1, missed 0, too few to judge 1."
            ]
        );
        assert!(summary(&[], &[]).is_empty());
    }
}
