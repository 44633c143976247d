//! What a page is made from, and what a user's own template is given: the JSON of `--format json`.
//! Plain values; texts are for readers, numbers beside them for programs. What is unknown is `null`
//! with a reason beside it, never zero.

use serde::Serialize;

use crate::summary::Fact;

/// Version of this layout; within one, fields are only added.
pub(crate) const SCHEMA_VERSION: u32 = 1;

/// Everything.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Page {
    pub(crate) schema_version: u32,
    /// `hil-runtime` and its version.
    pub(crate) program: String,
    pub(crate) title: String,
    /// One row per run; only where there are several.
    pub(crate) overview: Option<Table>,
    pub(crate) runs: Vec<Run>,
}

/// Where a run on a page comes from.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum RunKind {
    /// It ran in real time.
    #[default]
    Live,
    /// It ran in virtual time.
    Virtual,
    /// It left no summary.
    Unfinished,
}

/// One run.
#[derive(Debug, Clone, Default, Serialize)]
pub(crate) struct Run {
    /// Its place on the page, `run-1` and so on.
    pub(crate) key: String,
    pub(crate) name: String,
    pub(crate) case: String,
    /// Where it comes from.
    pub(crate) kind: RunKind,
    /// How it ended.
    pub(crate) outcome: Verdict,
    /// Did the network hurt the robot? Nothing of a run without a summary.
    pub(crate) answer: Option<AnswerView>,
    /// The few figures to see first.
    pub(crate) headline: Vec<Metric>,
    pub(crate) warnings: Vec<String>,
    /// What this report lacks, and why.
    pub(crate) missing: Vec<String>,
    pub(crate) facts: Vec<FactGroup>,
    pub(crate) score: Vec<Metric>,
    /// The run as a row of the seed paper's tables.
    pub(crate) paper: Option<Table>,
    pub(crate) channels: Vec<Channel>,
    pub(crate) score_events: EventList,
    pub(crate) network_events: EventList,
    /// What follows what, in words.
    pub(crate) correlation: Vec<String>,
    pub(crate) processes: Option<Table>,
    pub(crate) clocks: Vec<String>,
    pub(crate) method: Vec<String>,
    pub(crate) files: Vec<Fact>,
    pub(crate) repeat_command: Option<String>,
    /// Figures of the whole run.
    pub(crate) drawings: Vec<Drawing>,
    /// `report-full.txt` as the run left it.
    pub(crate) printed: Option<String>,
}

/// The answer of a run in words, as [`crate::answer::Answer`] has them.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct AnswerView {
    pub(crate) question: String,
    pub(crate) answer: Verdict,
    pub(crate) measurement: Verdict,
    pub(crate) sample: String,
    /// What hurt the robot.
    pub(crate) harms: Vec<Fact>,
}

/// A judgement: `tone` is `good`, `caution`, `bad` or `plain`.
#[derive(Debug, Clone, Default, Serialize)]
pub(crate) struct Verdict {
    pub(crate) tone: &'static str,
    pub(crate) word: String,
    pub(crate) text: String,
}

/// Facts under one heading.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct FactGroup {
    pub(crate) title: String,
    pub(crate) facts: Vec<Fact>,
}

/// One figure with its interval and how it came about.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(crate) struct Metric {
    /// Snake-case; what `--format csv` and `compare` call it.
    pub(crate) name: String,
    pub(crate) label: String,
    /// SI unit, or `1`.
    pub(crate) unit: String,
    pub(crate) value: Option<f64>,
    /// The value as readers want it, or `unavailable`.
    pub(crate) text: String,
    pub(crate) low: Option<f64>,
    pub(crate) high: Option<f64>,
    /// The interval in words; empty without one.
    pub(crate) interval: String,
    /// How it was obtained, or why it was not.
    pub(crate) method: String,
}

/// One channel.
#[derive(Debug, Clone, Default, Serialize)]
pub(crate) struct Channel {
    pub(crate) name: String,
    pub(crate) from: String,
    pub(crate) to: Option<String>,
    pub(crate) link: String,
    pub(crate) figures: Vec<Metric>,
    /// Fates, segments, stamps, outages; those that there are.
    pub(crate) tables: Vec<Table>,
    /// What else is to be known of it.
    pub(crate) notes: Vec<String>,
    pub(crate) drawings: Vec<Drawing>,
}

/// A table of texts.
#[derive(Debug, Clone, Default, Serialize)]
pub(crate) struct Table {
    pub(crate) title: String,
    pub(crate) columns: Vec<String>,
    pub(crate) rows: Vec<Vec<String>>,
    pub(crate) note: String,
}

/// Events in order of time.
#[derive(Debug, Clone, Default, Serialize)]
pub(crate) struct EventList {
    pub(crate) events: Vec<Event>,
    /// Incidents and hazards among all events, also those left out.
    pub(crate) grave_count: u64,
    /// What was left out, and where it is; empty when nothing was.
    pub(crate) note: String,
}

/// One event.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Event {
    pub(crate) at: String,
    /// `incident`, `hazard`, `notice` or `network`.
    pub(crate) severity: &'static str,
    pub(crate) what: String,
    /// What stood beside it.
    pub(crate) beside: Vec<String>,
}

/// One figure drawn.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Drawing {
    /// Unique on the page; the file's name with `--format svg`.
    pub(crate) name: String,
    pub(crate) title: String,
    pub(crate) caption: String,
    /// An `svg` element.
    pub(crate) svg: String,
    /// True for one that wants the whole width.
    pub(crate) is_wide: bool,
    /// What it shows over time, for the page's cursor.
    pub(crate) plot: Option<super::series::Plot>,
}

impl Metric {
    /// A figure with its text.
    pub(crate) fn new(name: &str, label: &str, unit: &str, value: f64) -> Self {
        Self {
            name: name.to_owned(),
            label: label.to_owned(),
            unit: unit.to_owned(),
            value: Some(value),
            text: super::words::value(value, unit),
            ..Self::default()
        }
    }

    /// None, and why.
    pub(crate) fn unavailable(name: &str, label: &str, unit: &str, reason: &str) -> Self {
        Self {
            name: name.to_owned(),
            label: label.to_owned(),
            unit: unit.to_owned(),
            text: super::words::UNAVAILABLE.to_owned(),
            method: reason.to_owned(),
            ..Self::default()
        }
    }

    /// A figure, or none because of `reason`.
    pub(crate) fn maybe(
        name: &str,
        label: &str,
        unit: &str,
        value: Option<f64>,
        reason: &str,
    ) -> Self {
        match value.filter(|value| value.is_finite()) {
            Some(value) => Self::new(name, label, unit, value),
            None => Self::unavailable(name, label, unit, reason),
        }
    }

    /// With how it was obtained; a figure that there is none of keeps its reason.
    pub(crate) fn by(mut self, method: &str) -> Self {
        if self.value.is_some() {
            method.clone_into(&mut self.method);
        }
        self
    }

    /// With its interval of 95 %.
    pub(crate) fn within(mut self, interval: Option<(f64, f64)>) -> Self {
        if let Some((low, high)) = interval.filter(|_| self.value.is_some()) {
            (self.low, self.high) = (Some(low), Some(high));
            let [low, high] = [low, high].map(|end| super::words::value(end, &self.unit));
            self.interval = format!("{low} to {high}");
        }
        self
    }
}

impl Table {
    /// An empty one with these columns.
    pub(crate) fn new(title: &str, columns: &[&str]) -> Self {
        Self {
            title: title.to_owned(),
            columns: columns.iter().map(|&column| column.to_owned()).collect(),
            ..Self::default()
        }
    }
}
