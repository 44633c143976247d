//! Reads a run's folder for a page. What cannot be read is said, and the rest is read all the same.

use std::path::Path;
use std::{fs, io};

use serde::Deserialize;
use serde_json::Value;

use super::series::{self, Series};
use crate::summary::RunSummary;
use hil_platform::host_facts::HostFacts;
use hil_rundir::run_folder::RunFolder;
use hil_rundir::series::list;

/// One folder.
#[derive(Debug, Clone)]
pub struct Material {
    /// The folder's own name.
    pub folder: String,
    /// What was found there.
    pub(crate) found: Found,
    /// What there is to plot.
    pub(crate) series: Vec<Series>,
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

/// Largest series that is read, bytes: an hour of two arms is a tenth of it.
const SERIES_BYTES_MAX: u64 = 1 << 30;

/// Why a folder is none of a run.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// Nothing in it is known.
    #[error("{0}: no summary.json or manifest.json; not a run's folder")]
    NoRun(String),
    /// A file is not what it should be.
    #[error("{path}: {text}")]
    File {
        /// Which.
        path: String,
        /// Why.
        text: String,
    },
}

/// The material of the folder at `path`.
///
/// # Errors
/// When it is not the folder of a run, or its summary cannot be read.
pub fn read(path: &Path) -> Result<Material, ReadError> {
    let folder = RunFolder::existing(path);
    let found = found(&folder)?;
    let mut problems = Vec::new();
    let series = match &found {
        Found::Unfinished(_) => Vec::new(),
        Found::Ended(_) => all_series(&folder.series(), &mut problems),
    };
    let name = path.canonicalize().unwrap_or_else(|_error| path.to_owned());
    Ok(Material {
        folder: RunFolder::existing(&name).name(),
        found,
        series,
        problems,
    })
}

fn text_of(path: &Path) -> Result<Option<String>, ReadError> {
    match fs::read_to_string(path) {
        Ok(text) => Ok(Some(text)),
        Err(error)
            if matches!(
                error.kind(),
                io::ErrorKind::NotFound | io::ErrorKind::NotADirectory
            ) =>
        {
            Ok(None)
        }
        Err(error) => Err(file_error(path, &error.to_string())),
    }
}

fn file_error(path: &Path, text: &str) -> ReadError {
    ReadError::File {
        path: path.display().to_string(),
        text: text.to_owned(),
    }
}

/// With what it rests on: serde's words alone do not say which field.
fn with_source(error: &dyn core::error::Error) -> String {
    error
        .source()
        .map_or_else(|| error.to_string(), |source| format!("{error}: {source}"))
}

fn found(folder: &RunFolder) -> Result<Found, ReadError> {
    if let Some(text) = text_of(&folder.summary())? {
        let summary = RunSummary::from_json(&text);
        let summary =
            summary.map_err(|error| file_error(&folder.summary(), &with_source(&error)))?;
        return Ok(Found::Ended(Box::new(summary)));
    }
    let path = folder.manifest();
    let Some(text) = text_of(&path)? else {
        return Err(ReadError::NoRun(folder.root().display().to_string()));
    };
    let manifest: Value =
        serde_json::from_str(&text).map_err(|error| file_error(&path, &error.to_string()))?;
    Ok(Found::Unfinished(manifest_of(&manifest, folder)))
}

fn manifest_of(manifest: &Value, folder: &RunFolder) -> Manifest {
    let text = |value: &Value| value.as_str().unwrap_or("unavailable").to_owned();
    let list = |value: &Value| value.as_array().cloned().unwrap_or_default();
    let records = fs::read_dir(folder.records())
        .into_iter()
        .flatten()
        .flatten();
    let sizes = records.filter_map(|entry| Some(entry.metadata().ok()?.len()));
    Manifest {
        name: text(&manifest["topology"]["name"]),
        case: text(&manifest["topology"]["case"]["name"]),
        created: text(&manifest["created"]),
        seed: manifest["seed"].as_u64(),
        command_line: list(&manifest["command_line"]).iter().map(text).collect(),
        host_facts: HostFacts::deserialize(&manifest["host_facts"]).unwrap_or_default(),
        records: sizes.fold((0, 0), |(count, bytes), size| (count + 1, bytes + size)),
    }
}

fn all_series(folder: &Path, problems: &mut Vec<String>) -> Vec<Series> {
    let entries = list(folder).unwrap_or_else(|error| {
        problems.push(format!("series/ cannot be read: {error}"));
        Vec::new()
    });
    let mut all = Vec::new();
    for entry in entries {
        let file = format!("{}.csv", entry.name);
        match one_series(&folder.join(&file)) {
            Ok(mut series) => {
                series.describe(entry);
                all.push(series);
            }
            Err(text) => problems.push(format!("series/{file} cannot be read: {text}")),
        }
    }
    all
}

fn one_series(path: &Path) -> Result<Series, String> {
    let size = fs::metadata(path).map_err(|error| error.to_string())?.len();
    if size > SERIES_BYTES_MAX {
        return Err(format!("{size} bytes, more than {SERIES_BYTES_MAX}"));
    }
    let text = fs::read_to_string(path).map_err(|error| error.to_string())?;
    let name = path.file_stem().unwrap_or_default().to_string_lossy();
    series::parse(&name, &text)
}
