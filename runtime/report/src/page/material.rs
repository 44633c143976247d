//! What a run's folder holds, as far as a page needs it: read by [`super::read`], judged by nobody yet.

use super::series::Series;
use crate::summary::RunSummary;
use hil_platform::host_facts::HostFacts;

/// One folder.
#[derive(Debug, Clone)]
pub struct Material {
    /// The folder's own name.
    pub folder: String,
    /// What was found there.
    pub(crate) found: Found,
    /// What there is to plot.
    pub(crate) series: Vec<Series>,
    /// `report.txt`.
    pub(crate) printed: Option<String>,
    /// What could not be read, in words.
    pub problems: Vec<String>,
}

/// What kind of folder it is.
#[derive(Debug, Clone)]
pub(crate) enum Found {
    /// Of a run that ended, or of one in virtual time.
    Ended(Box<RunSummary>),
    /// Of a run without a summary.
    Unfinished(Manifest),
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
