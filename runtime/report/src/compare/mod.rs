//! Two runs, or two sets of repetitions, side by side: every delay, loss and score with the ratio or
//! difference of the two and its interval, and whether the runs may be compared at all. It reads
//! `summary.json`, and the topology of `manifest.json`.

pub mod cli;
mod conditions;
mod harms;
mod metrics;
mod origin;
mod render;
pub mod work;

use std::collections::BTreeSet;
use std::fmt;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use hil_account::Stage;
use hil_core::interval::Interval;
use hil_stats::comparison::Estimate;
use serde::Serialize;

use crate::answer::{Hurt, Object};
use crate::sections::events::gravest_harm;
use crate::sections::{link_words, transports};
use crate::summary::{RunSummary, SummaryError};
use harms::ComparedHarm;
use hil_rundir::manifest::Manifest;
use hil_rundir::run_folder::RunFolder;
use origin::Difference;
pub(crate) use origin::add_leaves;
use serde_json::Value;

/// Why runs cannot be compared.
#[derive(Debug, thiserror::Error)]
pub(crate) enum CompareError {
    /// The summary cannot be read.
    #[error("{path}: {source}; only runs that ended and have a summary can be compared")]
    Read {
        path: PathBuf,
        source: std::io::Error,
    },
    /// The summary is not one.
    #[error("{path}: {source}")]
    Summary { path: PathBuf, source: SummaryError },
}

/// One run.
#[derive(Debug, Clone)]
pub(crate) struct ComparedRun {
    /// As it was named.
    pub(crate) folder: PathBuf,
    pub(crate) summary: RunSummary,
    /// The topology with every default spelled out; null for a folder without a manifest.
    pub(crate) topology: Value,
}

impl ComparedRun {
    /// Reads the summary of the run in `folder`.
    ///
    /// # Errors
    /// When it is not there or not a summary.
    pub(crate) fn read(folder: &Path) -> Result<Self, CompareError> {
        let run_folder = RunFolder::existing(folder);
        let path = run_folder.summary();
        let text = std::fs::read_to_string(&path).map_err(|source| CompareError::Read {
            path: path.clone(),
            source,
        })?;
        let summary = RunSummary::from_json(&text)
            .map_err(|source| CompareError::Summary { path, source })?;
        let topology = match Manifest::read(&run_folder) {
            Ok(manifest) => manifest.topology,
            Err(error) if error.kind() == ErrorKind::NotFound => Value::Null,
            Err(source) => {
                let path = run_folder.manifest();
                return Err(CompareError::Read { path, source });
            }
        };
        Ok(Self {
            folder: folder.to_owned(),
            summary,
            topology,
        })
    }
}

hil_core::labelled! {
    /// How a figure of the new runs stands to that of the base.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
    #[serde(rename_all = "snake_case")]
    pub(crate) enum Verdict, words {
        /// The interval has both directions in it.
        NoDifferenceShown = "no difference shown",
        /// Shorter delays, by the whole interval.
        Faster = "faster",
        /// Longer delays, by the whole interval.
        Slower = "slower",
        /// Fewer losses, by the whole interval.
        LosesLess = "loses less",
        /// More losses, by the whole interval.
        LosesMore = "loses more",
        /// A smaller score, by the whole interval; which is better, the case knows.
        Lower = "lower",
        /// A larger score, by the whole interval.
        Higher = "higher",
        /// No interval can be had.
        NotTested = "not tested",
    }
}

/// What kind of figure it is: it says how it is compared and printed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum ChartKind {
    /// Nanoseconds, compared by their ratio.
    Delay,
    /// A share, compared by its difference.
    Loss,
    /// A count of the network's, compared by its difference.
    Count,
    /// A score, compared by its difference.
    Score,
}

/// A part of a channel's way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub(crate) enum Part {
    /// The whole of it.
    EndToEnd,
    /// From the kernel of one gateway to the other gateway.
    Network,
    /// From one stage to another.
    Segment {
        /// Where it begins.
        from: Stage,
        /// Where it ends.
        to: Stage,
    },
}

impl fmt::Display for Part {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::EndToEnd => formatter.write_str("end to end"),
            Self::Network => formatter.write_str("network"),
            Self::Segment { from, to } => write!(formatter, "{from} → {to}"),
        }
    }
}

/// One figure of both sides.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct ComparedMetric {
    /// The channel; `None` for a score.
    pub(crate) channel: Option<String>,
    /// Which part of the channel's way a delay is of; `None` for losses and scores.
    pub(crate) part: Option<Part>,
    /// `p50`, `p99`, `p99.9`, `max`, `loss`, another figure of the network's, or the score's name.
    pub(crate) metric: String,
    /// The same for a reader.
    pub(crate) label: String,
    pub(crate) kind: ChartKind,
    /// The unit of both: `ns`, `1`, or the score's.
    pub(crate) unit: String,
    /// Of the base: one run's figure, or the mean of repetitions (of delays, the geometric one), with
    /// its own interval if all of its runs have the figure.
    pub(crate) base: Option<Estimate>,
    /// Of the new runs.
    pub(crate) new: Option<Estimate>,
    /// Runs of the base that have the figure.
    pub(crate) base_count: usize,
    /// New runs that have it.
    pub(crate) new_count: usize,
    /// New by base; `None` where the base is zero, and for shares.
    pub(crate) ratio: Option<f64>,
    /// Interval of the ratio.
    pub(crate) ratio_interval: Option<Interval>,
    /// New less base, in the figure's unit.
    pub(crate) difference: Option<f64>,
    /// Interval of the difference.
    pub(crate) difference_interval: Option<Interval>,
    pub(crate) verdict: Verdict,
    /// How the interval came about, or why there is none.
    pub(crate) method: String,
}

/// Runs of whose measurement the same is to be said.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Measurements {
    /// Their folders.
    pub(crate) runs: Vec<PathBuf>,
    /// `None` where nothing was measured.
    pub(crate) is_valid: Option<bool>,
    /// Why, in words.
    pub(crate) words: String,
}

/// What the runs of a side were.
#[derive(Debug, Clone, Default, Serialize)]
pub(crate) struct Tested {
    /// What their emulated links do, or over what their channels went, each once.
    pub(crate) links: Vec<String>,
    /// Their lengths together, seconds.
    pub(crate) duration_s: f64,
}

impl Tested {
    fn of(runs: &[ComparedRun]) -> Self {
        let links = runs.iter().flat_map(|run| {
            let emulated = link_words(&run.summary).into_iter();
            let others = transports(&run.summary).into_iter();
            emulated.chain(others.map(str::to_owned))
        });
        Self {
            links: links.collect::<BTreeSet<_>>().into_iter().collect(),
            duration_s: runs.iter().map(|run| run.summary.run.duration_s).sum(),
        }
    }
}

/// All of it.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Comparison {
    /// Folders of the base.
    pub(crate) base: Vec<PathBuf>,
    /// Folders of the new runs.
    pub(crate) new: Vec<PathBuf>,
    /// What those of the base were.
    pub(crate) base_tested: Tested,
    /// What the new ones were.
    pub(crate) new_tested: Tested,
    /// What both sides have in common that matters.
    pub(crate) same: Vec<String>,
    /// In what the runs differ beside the figures; empty when in nothing that is known.
    pub(crate) differences: Vec<Difference>,
    /// Why figures must be read with care.
    pub(crate) cautions: Vec<String>,
    /// What was to be hurt: programs where no run has a robot.
    pub(crate) object: Object,
    /// What hurt the robots.
    pub(crate) harms: Vec<ComparedHarm>,
    /// Was the robot hurt more in the new runs?
    pub(crate) hurt: Hurt,
    /// Whether the runs measured what they were to measure.
    pub(crate) measurements: Vec<Measurements>,
    /// The gravest event of the new runs that the network explains, and what the network did before.
    pub(crate) gravest_harm: Option<String>,
    /// Names of the scores to see first.
    pub(crate) headline: Vec<String>,
    pub(crate) figures: Vec<ComparedMetric>,
}

impl Comparison {
    /// Compares `new` with `base`; neither may be empty.
    pub(crate) fn of(base: &[ComparedRun], new: &[ComparedRun]) -> Self {
        let folders = |runs: &[ComparedRun]| runs.iter().map(|run| run.folder.clone()).collect();
        let (same, differences) = origin::of(base, new);
        let figures = metrics::of(base, new);
        let mut cautions = origin::cautions(base, new);
        cautions.extend(metrics::cautions(&figures, [base.len(), new.len()]));
        let harms = harms::of(base, new);
        let hurt = harms::hurt(&harms, base, new);
        let mut gravest_harms = new.iter().filter_map(|run| {
            let (words, cause) = gravest_harm(&run.summary)?;
            let run = run.folder.display();
            Some(format!("in {run}, {words}; network before it: {cause}"))
        });
        let headline = new.first().map(|run| run.summary.headline.clone());
        Self {
            base: folders(base),
            new: folders(new),
            base_tested: Tested::of(base),
            new_tested: Tested::of(new),
            same,
            differences,
            cautions,
            object: base
                .iter()
                .chain(new)
                .map(|run| Object::of(&run.summary))
                .find(|object| *object == Object::Robot)
                .unwrap_or(Object::Programs),
            harms,
            hurt,
            measurements: origin::measurements(base, new),
            gravest_harm: gravest_harms.next(),
            headline: headline.unwrap_or_default(),
            figures,
        }
    }
}
