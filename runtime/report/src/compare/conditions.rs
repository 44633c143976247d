//! `--fail-if`: a condition on the figures of a comparison, as a script writes it.
//!
//! `[CHANNEL:]METRIC OP VALUE[UNIT]`, e.g. `p99 > 1.2x` or `shuttle/command:loss > 0.5pp`. It holds when
//! the whole interval of the figure lies beyond the value; strictly, when the figure itself does.

use core::fmt;

use hil_core::interval::Interval;
use hil_present::units::figure;
use serde::Serialize;

use super::metrics::{Counts, is_partial};
use super::{ChartKind, ComparedMetric, Comparison, Part};

/// Why a condition cannot be judged.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum ConditionError {
    /// It cannot be read.
    #[error(
        "--fail-if {text:?}: {problem}; write [CHANNEL:]METRIC OP VALUE[UNIT], e.g. \"p99 > 1.2x\""
    )]
    Syntax { text: String, problem: String },
    /// There is no such figure.
    #[error("--fail-if {text:?}: unknown metric `{metric}`; these runs have: {allowed}")]
    UnknownMetric {
        text: String,
        metric: String,
        allowed: String,
    },
    /// There is no such channel.
    #[error("--fail-if {text:?}: unknown channel `{channel}`; these runs have: {allowed}")]
    UnknownChannel {
        text: String,
        channel: String,
        allowed: String,
    },
    /// The figure is not measured that way.
    #[error("--fail-if {text:?}: {metric} {problem}; allowed: {allowed}")]
    Unit {
        text: String,
        metric: String,
        problem: String,
        allowed: &'static str,
    },
    /// One side has no such figure, or nothing can be said of how sure it is.
    #[error("--fail-if {0}")]
    Unjudged(Unjudged),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Operator {
    Above,
    NotBelow,
    Below,
    NotAbove,
}

/// Two-letter words first, so that `>=` is not read as `>`.
const OPERATORS: [(&str, Operator); 4] = [
    (">=", Operator::NotBelow),
    ("<=", Operator::NotAbove),
    (">", Operator::Above),
    ("<", Operator::Below),
];

impl Operator {
    fn holds(self, value: f64, limit: f64) -> bool {
        match self {
            Self::Above => value > limit,
            Self::NotBelow => value >= limit,
            Self::Below => value < limit,
            Self::NotAbove => value <= limit,
        }
    }

    /// Beyond the limit by the whole interval.
    fn holds_of_all(self, interval: Interval, limit: f64) -> bool {
        match self {
            Self::Above | Self::NotBelow => self.holds(interval.low, limit),
            Self::Below | Self::NotAbove => self.holds(interval.high, limit),
        }
    }
}

/// A condition that can be read.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Condition {
    text: String,
    channel: Option<String>,
    metric: String,
    operator: Operator,
    value: f64,
    unit: String,
}

/// What became of a condition on one figure.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Judged {
    /// As written.
    pub(crate) condition: String,
    /// Channel and metric.
    pub(crate) figure: String,
    /// The figure in the unit below.
    pub(crate) value: f64,
    /// Unit of the condition, or of the score; empty for a number.
    pub(crate) unit: String,
    /// Its interval in the same unit.
    pub(crate) interval: Option<Interval>,
    /// True when the comparison fails by it.
    pub(crate) holds: bool,
}

/// A figure that a condition means and that cannot be judged by it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, thiserror::Error)]
#[error("{condition:?}: cannot be judged for {figure}: {why}")]
pub(crate) struct Unjudged {
    /// As written.
    pub(crate) condition: String,
    /// Channel and metric.
    pub(crate) figure: String,
    /// What is missing.
    pub(crate) why: String,
}

/// What became of all conditions.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Verdicts {
    /// The figures that could be judged.
    pub(crate) judged: Vec<Judged>,
    /// Those that could not, beside others of the same condition that could.
    pub(crate) unjudged: Vec<Unjudged>,
}

impl Verdicts {
    /// In words, a line for each figure.
    pub(super) fn lines(&self) -> Vec<String> {
        let judged = self.judged.iter().map(ToString::to_string);
        let unjudged = self.unjudged.iter();
        let unjudged = unjudged.map(|one| {
            let (condition, figure, why) = (&one.condition, &one.figure, &one.why);
            format!("not judged: {condition}: {figure}: {why}")
        });
        judged.chain(unjudged).collect()
    }
}

impl Condition {
    /// Reads one.
    ///
    /// # Errors
    /// When it is not of the form above.
    pub(crate) fn parse(text: &str) -> Result<Self, ConditionError> {
        let wrong = |problem: &str| ConditionError::Syntax {
            text: text.to_owned(),
            problem: problem.to_owned(),
        };
        let found = OPERATORS
            .iter()
            .filter_map(|(word, operator)| Some((text.find(word)?, *word, *operator)))
            .min_by_key(|(at, word, _)| (*at, core::cmp::Reverse(word.len())));
        let (at, word, operator) = found.ok_or_else(|| wrong("no operator: > >= < <="))?;
        let (left, right) = (text[..at].trim(), text[at + word.len()..].trim());
        let (channel, metric) = match left.rsplit_once(':') {
            Some((channel, metric)) => (Some(channel.trim().to_owned()), metric.trim()),
            None => (None, left),
        };
        if metric.is_empty() {
            return Err(wrong("no metric before the operator"));
        }
        let end = right
            .find(|c: char| !(c.is_ascii_digit() || "+-.".contains(c)))
            .unwrap_or(right.len());
        let value: f64 = right[..end]
            .parse()
            .map_err(|_error| wrong("no number behind the operator"))?;
        Ok(Self {
            text: text.to_owned(),
            channel,
            metric: metric.to_owned(),
            operator,
            value,
            unit: right[end..].trim().to_owned(),
        })
    }

    /// Adds to `verdicts` what it says of each figure that it means.
    ///
    /// # Errors
    /// When it means none, its unit is not that figure's, or none of its figures can be judged.
    pub(crate) fn judge(
        &self,
        comparison: &Comparison,
        is_strict: bool,
        verdicts: &mut Verdicts,
    ) -> Result<(), ConditionError> {
        let figures = &comparison.figures;
        let is_whole = |one: &&ComparedMetric| !matches!(one.part, Some(Part::Segment { .. }));
        let named: Vec<&ComparedMetric> = figures
            .iter()
            .filter(is_whole)
            .filter(|one| one.metric == self.metric)
            .collect();
        if named.is_empty() {
            return Err(ConditionError::UnknownMetric {
                text: self.text.clone(),
                metric: self.metric.clone(),
                allowed: words(figures.iter().map(|one| one.metric.as_str())),
            });
        }
        let is_meant = |one: &&&ComparedMetric| {
            self.channel.is_none() || one.channel.as_ref() == self.channel.as_ref()
        };
        let meant: Vec<&&ComparedMetric> = named.iter().filter(is_meant).collect();
        if meant.is_empty() {
            return Err(ConditionError::UnknownChannel {
                text: self.text.clone(),
                channel: self.channel.clone().unwrap_or_default(),
                allowed: words(figures.iter().filter_map(|one| one.channel.as_deref())),
            });
        }
        let of = [comparison.base.len(), comparison.new.len()];
        let (mut judged, mut unjudged) = (Vec::new(), Vec::new());
        for one in meant {
            match self.judge_one(one, of, is_strict) {
                Ok(one) => judged.push(one),
                Err(ConditionError::Unjudged(one)) => unjudged.push(one),
                Err(error) => return Err(error),
            }
        }
        if judged.is_empty()
            && let Some(first) = unjudged.first().cloned()
        {
            return Err(ConditionError::Unjudged(first));
        }
        verdicts.judged.extend(judged);
        verdicts.unjudged.extend(unjudged);
        Ok(())
    }

    fn judge_one(
        &self,
        figure: &ComparedMetric,
        of: Counts,
        is_strict: bool,
    ) -> Result<Judged, ConditionError> {
        let name = name_of(figure);
        let unjudged = |why: String| {
            ConditionError::Unjudged(Unjudged {
                condition: self.text.clone(),
                figure: name.clone(),
                why,
            })
        };
        let (value, interval) = self.quantity(figure)?;
        let value = value.ok_or_else(|| {
            unjudged("the figure is unavailable on one side, or its base is zero".to_owned())
        })?;
        let holds = match interval {
            _ if is_strict => self.operator.holds(value, self.value),
            Some(interval) => self.operator.holds_of_all(interval, self.value),
            // Nothing shows the interval of no losses; none itself is in it.
            None if figure.kind == ChartKind::Loss
                && figure.new.is_some_and(|new| new.value <= 0.0)
                && !self.operator.holds(value, self.value)
                && !is_partial([figure.base_count, figure.new_count], of) =>
            {
                false
            }
            None => {
                let why = format!("{}; --strict judges the figure alone", figure.method);
                return Err(unjudged(why));
            }
        };
        Ok(Judged {
            condition: self.text.clone(),
            figure: name,
            value,
            unit: match self.unit.as_str() {
                "" if figure.unit != "1" => figure.unit.clone(),
                unit => unit.to_owned(),
            },
            interval,
            holds,
        })
    }

    /// The figure and its interval in the condition's unit.
    fn quantity(
        &self,
        figure: &ComparedMetric,
    ) -> Result<(Option<f64>, Option<Interval>), ConditionError> {
        let scaled = |(value, interval): (Option<f64>, Option<Interval>), by: f64| {
            let interval = interval.map(|one| one.map(|end| end * by));
            (value.map(|value| value * by), interval)
        };
        let new = (
            figure.new.map(|one| one.value),
            figure.new.and_then(|one| one.interval),
        );
        let quotient = (figure.ratio, figure.ratio_interval);
        let more = (figure.difference, figure.difference_interval);
        Ok(match (figure.kind, self.unit.as_str()) {
            (ChartKind::Delay | ChartKind::Count | ChartKind::Score, "x") => quotient,
            (ChartKind::Delay, "ns") | (ChartKind::Count | ChartKind::Score, "") => new,
            (ChartKind::Delay, "us" | "\u{b5}s" | "\u{3bc}s") => scaled(new, 1e-3),
            (ChartKind::Delay, "ms") => scaled(new, 1e-6),
            (ChartKind::Delay, "s") => scaled(new, 1e-9),
            (ChartKind::Loss, "%") => scaled(new, 100.0),
            (ChartKind::Loss, "pp") => scaled(more, 100.0),
            (kind, unit) => {
                return Err(ConditionError::Unit {
                    text: self.text.clone(),
                    metric: self.metric.clone(),
                    problem: match unit {
                        "" => "needs a unit".to_owned(),
                        unit => format!("takes no `{unit}`"),
                    },
                    allowed: match kind {
                        ChartKind::Delay => "x (new by base); s, ms, us, ns (of the new runs)",
                        ChartKind::Loss => {
                            "% (of the new runs), pp (new less base, percentage points)"
                        }
                        ChartKind::Count | ChartKind::Score => {
                            "x (new by base), or no unit (of the new runs)"
                        }
                    },
                });
            }
        })
    }
}

/// Channel and metric.
pub(super) fn name_of(figure: &ComparedMetric) -> String {
    let metric = &figure.metric;
    figure
        .channel
        .as_ref()
        .map_or_else(|| metric.clone(), |channel| format!("{channel}:{metric}"))
}

/// Each word once, in order.
fn words<'a>(all: impl Iterator<Item = &'a str>) -> String {
    let mut found: Vec<&str> = Vec::new();
    for word in all {
        if !found.contains(&word) {
            found.push(word);
        }
    }
    found.join(", ")
}

impl fmt::Display for Judged {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = if self.holds { "FAILS" } else { "passes" };
        let with_unit = |value: f64| match self.unit.as_str() {
            "" => figure(value),
            "x" => format!("{}x", figure(value)),
            unit => format!("{} {unit}", figure(value)),
        };
        write!(
            formatter,
            "{word}: {}: {} is {}",
            self.condition,
            self.figure,
            with_unit(self.value)
        )?;
        if let Some(interval) = self.interval {
            let (low, high) = (with_unit(interval.low), with_unit(interval.high));
            write!(formatter, " ({low} to {high})")?;
        }
        Ok(())
    }
}

#[cfg(test)]
#[path = "conditions_tests.rs"]
mod tests;
