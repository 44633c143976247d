//! What a run's folder holds, as far as a page needs it: read by [`super::read`], judged by nobody yet.

use std::collections::BTreeMap;

use hil_models::measure::account::OutageFigures;
use hil_models::measure::histogram::LatencySummary;
use serde::Deserialize;

use super::series::Series;
use crate::host_facts::HostFacts;
use crate::report::network::NetworkReport;
use crate::report::score_event::ScoreEvents;
use crate::report::summary::{RunSummary, ScoreMetric};

/// One folder.
#[derive(Debug, Clone)]
pub(crate) struct Material {
    /// The folder's own name.
    pub(crate) folder: String,
    pub(crate) found: Found,
    pub(crate) series: Vec<Series>,
    /// `report.txt`.
    pub(crate) printed: Option<String>,
    /// What could not be read, in words.
    pub(crate) problems: Vec<String>,
}

/// What kind of folder it is.
#[derive(Debug, Clone)]
pub(crate) enum Found {
    /// Of a run that ended.
    Live(Box<RunSummary>),
    /// Of a run in virtual time.
    Virtual(Box<VirtualReport>),
    /// Of a run without a summary.
    Unfinished(Manifest),
}

/// `report.json` of a run in virtual time.
#[derive(Debug, Clone, Deserialize)]
pub(crate) struct VirtualReport {
    pub(crate) name: String,
    pub(crate) seed: u64,
    pub(crate) duration_s: f64,
    pub(crate) channels: BTreeMap<String, VirtualCounts>,
    #[serde(default)]
    pub(crate) links: BTreeMap<String, VirtualLink>,
    #[serde(default)]
    pub(crate) outages: BTreeMap<String, OutageFigures>,
    pub(crate) score: VirtualScore,
    #[serde(default)]
    pub(crate) score_events: ScoreEvents,
    #[serde(default)]
    pub(crate) network: Option<NetworkReport>,
}

/// Messages of a channel in virtual time.
#[derive(Debug, Clone, Copy, Deserialize)]
#[allow(clippy::struct_field_names, reason = "as `report.json` names them")]
pub(crate) struct VirtualCounts {
    pub(crate) published_count: u64,
    pub(crate) taken_count: u64,
    pub(crate) in_flight_count: u64,
}

/// What a link model was asked for and did.
#[derive(Debug, Clone, Deserialize)]
pub(crate) struct VirtualLink {
    pub(crate) model: String,
    pub(crate) requested_loss_ratio: Option<f64>,
    pub(crate) duplicated_count: u64,
    pub(crate) overtaken_count: u64,
    pub(crate) delay: Option<LatencySummary>,
}

/// The score of a run in virtual time; its events stand in [`VirtualReport::score_events`].
#[derive(Debug, Clone, Deserialize)]
pub(crate) struct VirtualScore {
    pub(crate) metrics: Vec<ScoreMetric>,
}

/// What `manifest.json` says of a run that has nothing else to say.
#[derive(Debug, Clone, Default)]
pub(crate) struct Manifest {
    pub(crate) name: String,
    pub(crate) case: String,
    pub(crate) created: String,
    pub(crate) seed: Option<u64>,
    pub(crate) command_line: Vec<String>,
    pub(crate) host_facts: HostFacts,
    /// Files of records that there are, and what they hold in all, bytes.
    pub(crate) records: (u64, u64),
}
