//! What a page is made from, and what a user's own template is given: the JSON of `--format json`.
//! Plain values; texts are for readers, numbers beside them for programs. What is unknown is `null`
//! with a reason beside it, never zero.

use std::collections::BTreeMap;

use hil_present::{Field, Metric, Section, Table, Tone};
use serde::Serialize;

use super::series::Plot;

/// Version of this layout; within one, fields are only added.
pub(crate) const SCHEMA_VERSION: u32 = 2;

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
    /// The few metrics to see first.
    pub(crate) headline: Vec<Tile>,
    /// Incidents and hazards, also those that are not listed; `null` without a score.
    pub(crate) grave_count: Option<u64>,
    /// All it says.
    pub(crate) sections: Vec<Section>,
    pub(crate) repeat_command: Option<String>,
    /// What its drawings show over time, by their names, for the page's cursor.
    pub(crate) plots: BTreeMap<String, Plot>,
}

/// A metric to see first.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Tile {
    #[serde(flatten)]
    pub(crate) metric: Metric,
    /// What the clean run has, where one was named.
    pub(crate) clean: Option<String>,
}

/// The answer of a run in words, as [`crate::answer::Answer`] has them.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct AnswerView {
    pub(crate) question: String,
    pub(crate) answer: Verdict,
    /// Why no more can be said, or in how many occasions nothing happened.
    pub(crate) reason: Option<String>,
    /// What hurt the robot, and what might have.
    pub(crate) harms: Vec<Field>,
    /// Whether the measurement is valid, how large the sample is, what the network did, and the emulated links.
    pub(crate) badges: Vec<Field>,
}

/// A judgement.
#[derive(Debug, Clone, Default, Serialize)]
pub(crate) struct Verdict {
    pub(crate) tone: Tone,
    pub(crate) word: String,
    pub(crate) text: String,
}
