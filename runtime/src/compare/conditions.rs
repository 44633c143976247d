//! `--fail-if`: a condition on the figures of a comparison, as a script writes it.
//!
//! `[CHANNEL:]METRIC OP VALUE[UNIT]`, e.g. `p99 > 1.2x` or `shuttle/command:loss > 0.5pp`. It holds when
//! the whole interval of the figure lies beyond the value; strictly, when the figure itself does.

use core::fmt;

use hil_models::measure::statistics::Interval;
use serde::Serialize;

use super::figures::END_TO_END;
use super::{ComparedFigure, Comparison, FigureKind};

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
    #[error("--fail-if {text:?}: {metric} takes no `{unit}`; allowed: {allowed}")]
    Unit {
        text: String,
        metric: String,
        unit: String,
        allowed: &'static str,
    },
    /// One side has no such figure, or nothing can be said of how sure it is.
    #[error("--fail-if {text:?}: cannot be judged for {figure}: {why}")]
    Unjudged {
        text: String,
        figure: String,
        why: String,
    },
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
    /// The figure in the condition's unit.
    pub(crate) value: f64,
    /// Its interval in the same unit.
    pub(crate) interval: Option<Interval>,
    /// True when the comparison fails by it.
    pub(crate) holds: bool,
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

    /// What it says of each figure that it means.
    ///
    /// # Errors
    /// When it means none, its unit is not that figure's, or a figure cannot be judged.
    pub(crate) fn judge(
        &self,
        comparison: &Comparison,
        is_strict: bool,
    ) -> Result<Vec<Judged>, ConditionError> {
        let figures = &comparison.figures;
        let is_whole =
            |one: &&ComparedFigure| one.kind != FigureKind::Delay || one.part == END_TO_END;
        let named: Vec<&ComparedFigure> = figures
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
        let is_meant = |one: &&&ComparedFigure| {
            self.channel.is_none() || one.channel.as_ref() == self.channel.as_ref()
        };
        let meant: Vec<&&ComparedFigure> = named.iter().filter(is_meant).collect();
        if meant.is_empty() {
            return Err(ConditionError::UnknownChannel {
                text: self.text.clone(),
                channel: self.channel.clone().unwrap_or_default(),
                allowed: words(figures.iter().filter_map(|one| one.channel.as_deref())),
            });
        }
        let mut judged = Vec::new();
        for one in meant {
            judged.push(self.judge_one(one, is_strict)?);
        }
        Ok(judged)
    }

    fn judge_one(
        &self,
        figure: &ComparedFigure,
        is_strict: bool,
    ) -> Result<Judged, ConditionError> {
        let name = name_of(figure);
        let unjudged = |why: String| ConditionError::Unjudged {
            text: self.text.clone(),
            figure: name.clone(),
            why,
        };
        let (value, interval) = self.quantity(figure)?;
        let value = value.ok_or_else(|| {
            unjudged(
                "the figure is unavailable on one side, or its \
                                                   base is zero"
                    .to_owned(),
            )
        })?;
        let holds = match interval {
            _ if is_strict => self.operator.holds(value, self.value),
            Some(interval) => self.operator.holds_of_all(interval, self.value),
            None => {
                let why = format!("{}; --strict judges the figure alone", figure.method);
                return Err(unjudged(why));
            }
        };
        Ok(Judged {
            condition: self.text.clone(),
            figure: name,
            value,
            interval,
            holds,
        })
    }

    /// The figure and its interval in the condition's unit.
    fn quantity(
        &self,
        figure: &ComparedFigure,
    ) -> Result<(Option<f64>, Option<Interval>), ConditionError> {
        let scaled = |(value, interval): (Option<f64>, Option<Interval>), by: f64| {
            let interval = interval.map(|one| Interval {
                low: one.low * by,
                high: one.high * by,
            });
            (value.map(|value| value * by), interval)
        };
        let new = (
            figure.new.map(|one| one.value),
            figure.new.and_then(|one| one.interval),
        );
        let quotient = (figure.ratio, figure.ratio_interval);
        let more = (figure.difference, figure.difference_interval);
        Ok(match (figure.kind, self.unit.as_str()) {
            (FigureKind::Delay | FigureKind::Score, "x") => quotient,
            (FigureKind::Delay, "ns") | (FigureKind::Score, "") => new,
            (FigureKind::Delay, "us" | "µs") => scaled(new, 1e-3),
            (FigureKind::Delay, "ms") => scaled(new, 1e-6),
            (FigureKind::Delay, "s") => scaled(new, 1e-9),
            (FigureKind::Loss, "%") => scaled(new, 100.0),
            (FigureKind::Loss, "pp") => scaled(more, 100.0),
            (kind, unit) => {
                return Err(ConditionError::Unit {
                    text: self.text.clone(),
                    metric: self.metric.clone(),
                    unit: unit.to_owned(),
                    allowed: match kind {
                        FigureKind::Delay => "x (new by base); s, ms, us, ns (of the new runs)",
                        FigureKind::Loss => {
                            "% (of the new runs), pp (new less base, percentage points)"
                        }
                        FigureKind::Score => "x (new by base), or no unit (of the new runs)",
                    },
                });
            }
        })
    }
}

/// Channel and metric.
pub(super) fn name_of(figure: &ComparedFigure) -> String {
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
        write!(
            formatter,
            "{word}: {}: {} is {:.4}",
            self.condition, self.figure, self.value
        )?;
        if let Some(interval) = self.interval {
            write!(formatter, " ({:.4} to {:.4})", interval.low, interval.high)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use hil_models::measure::comparison::Estimate;

    use super::*;
    use crate::compare::Verdict;

    fn figure(metric: &str, kind: FigureKind, ratio: (f64, f64, f64)) -> ComparedFigure {
        let (low, value, high) = ratio;
        let interval = Some(Interval { low, high });
        let estimate = |value: f64| Some(Estimate { value, interval });
        ComparedFigure {
            channel: (kind != FigureKind::Score).then(|| "a/b".to_owned()),
            part: match kind {
                FigureKind::Delay => END_TO_END.to_owned(),
                FigureKind::Loss | FigureKind::Score => String::new(),
            },
            metric: metric.to_owned(),
            kind,
            unit: String::new(),
            base: estimate(1.0),
            new: estimate(value),
            base_count: 1,
            new_count: 1,
            ratio: Some(value),
            ratio_interval: interval,
            difference: Some(value),
            difference_interval: interval,
            verdict: Verdict::Slower,
            method: "why not".to_owned(),
        }
    }

    fn comparison() -> Comparison {
        let mut maximum = figure("max", FigureKind::Delay, (1.0, 3.0, 4.0));
        maximum.ratio_interval = None;
        Comparison {
            base: Vec::new(),
            new: Vec::new(),
            same: Vec::new(),
            differences: Vec::new(),
            cautions: Vec::new(),
            figures: vec![
                figure("p99", FigureKind::Delay, (1.1, 1.3, 1.5)),
                maximum,
                figure("loss", FigureKind::Loss, (0.001, 0.002, 0.004)),
                figure("score_ratio", FigureKind::Score, (0.5, 0.7, 0.9)),
            ],
        }
    }

    fn holds(text: &str, is_strict: bool) -> Result<bool, ConditionError> {
        let judged = Condition::parse(text)?.judge(&comparison(), is_strict)?;
        Ok(judged.iter().any(|one| one.holds))
    }

    #[test]
    fn a_condition_holds_beyond_the_interval_or_strictly_by_the_figure() {
        for (text, beyond, strictly) in [
            ("p99 > 1.2x", false, true),
            ("p99 > 1.05x", true, true),
            ("a/b:p99>=1.1x", true, true),
            ("p99 < 1.4x", false, true),
            ("loss > 0.15%", false, true),
            ("loss > 0.05 pp", true, true),
            ("score_ratio < 1", true, true),
            ("score_ratio < 0.8", false, true),
        ] {
            assert_eq!(holds(text, false), Ok(beyond), "{text}");
            assert_eq!(holds(text, true), Ok(strictly), "{text}, strictly");
        }
    }

    #[test]
    fn what_cannot_be_judged_says_what_could() {
        for (text, words) in [
            (
                "p98 > 1x",
                "unknown metric `p98`; these runs have: p99, max, loss, score_ratio",
            ),
            ("c:p99 > 1x", "unknown channel `c`; these runs have: a/b"),
            (
                "p99 > 1%",
                "p99 takes no `%`; allowed: x (new by base); s, ms, us, ns",
            ),
            (
                "loss > 1x",
                "loss takes no `x`; allowed: % (of the new runs), pp",
            ),
            ("p99 1.2x", "no operator"),
            ("> 2x", "no metric"),
            ("p99 > fast", "no number"),
            (
                "max > 2x",
                "cannot be judged for a/b:max: why not; --strict",
            ),
        ] {
            let error = holds(text, false).unwrap_err().to_string();
            assert!(error.contains(words), "{text}: {error}");
        }
        assert_eq!(holds("max > 2x", true), Ok(true));
    }
}
