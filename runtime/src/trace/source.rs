//! Where a link's traces lie, and how they become its model: `[links.<name>.trace]`. It reads the
//! files; what a message meets then is `hil_models::link::trace`.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use hil_models::link::trace::{ReplayError, TraceEnd, TraceLink, TraceMatch, TraceReplay};
use hil_models::trace::wire::{self, Decoded};
use hil_models::trace::{Trace, csv, fault::TraceFault};
use serde::{Deserialize, Serialize};

use super::capture::file_name;
use crate::topology::Topology;

/// `[links.<name>.trace]`: paths are as written, relative to the topology file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TraceSource {
    /// Folder with one file per channel, named as a run names them.
    pub folder: Option<String>,
    /// Files by channel; they go before the folder.
    pub files: BTreeMap<String, String>,
    /// How they are replayed.
    pub replay: TraceReplay,
    /// What the paths start from.
    pub base: BaseFolder,
}

/// The folder of the topology file. Where a file lies is no part of what it says, so any two are
/// equal: the same topology on two hosts is one.
#[derive(Debug, Clone, Default)]
pub struct BaseFolder(pub PathBuf);

impl PartialEq for BaseFolder {
    fn eq(&self, _other: &Self) -> bool {
        true
    }
}

impl Eq for BaseFolder {}

/// One channel's trace and how to replay it: what a gateway is told.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TraceLaunch {
    /// The file.
    pub file: PathBuf,
    /// How to replay it.
    pub replay: TraceReplay,
}

/// Why a trace file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TraceFileError {
    /// It cannot be read.
    #[error("trace {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// It is no trace.
    #[error("trace {path}: {source}")]
    Foreign {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: TraceFault,
    },
    /// It is damaged; whoever can live with that part reads it with `hil-runtime trace convert`.
    #[error(
        "trace {path}: {source}; the {kept} records before it are whole: `hil-runtime trace convert` \
         keeps them"
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: TraceFault,
        /// Records before it.
        kept: usize,
    },
    /// It is a CSV file with a fault.
    #[error("trace {path}: {source}")]
    Csv {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: csv::CsvFault,
    },
    /// It cannot be replayed.
    #[error("trace {path}: {source}")]
    Replay {
        /// The file.
        path: PathBuf,
        /// Why.
        source: ReplayError,
    },
}

impl TraceSource {
    /// The trace of `channel`; `None` for one that is not named where no folder is.
    pub fn launch(&self, channel: &str) -> Option<TraceLaunch> {
        let named = self.files.get(channel).map(PathBuf::from);
        let in_folder = || {
            let folder = self.folder.as_ref()?;
            Some(Path::new(folder).join(file_name(channel)))
        };
        let file = self.base.0.join(named.or_else(in_folder)?);
        Some(TraceLaunch {
            // A gateway may run in another folder.
            file: std::path::absolute(&file).unwrap_or(file),
            replay: self.replay,
        })
    }
}

/// Reads every trace that the links of `topology` replay, so that a run without one does not begin.
///
/// # Errors
/// The first that cannot be used.
pub fn check(topology: &Topology) -> Result<(), TraceFileError> {
    for crossing in topology.crossings() {
        let source = crossing
            .link
            .emulation()
            .and_then(|emulation| emulation.trace.as_ref());
        if let Some(launch) = source.and_then(|source| source.launch(&crossing.channel.name)) {
            launch.model()?;
        }
    }
    Ok(())
}

impl TraceLaunch {
    /// The longest delay of the trace; `None` when it cannot be read.
    pub fn delay_max(&self) -> Option<Duration> {
        self.model().ok().map(|link| link.delay_max())
    }

    /// What it does, in words.
    pub fn describe(&self) -> String {
        let matching = match self.replay.matching {
            TraceMatch::Index => "message by message",
            TraceMatch::Time => "by the time of the run",
            TraceMatch::Tick => "tick by tick",
        };
        let end = match self.replay.end {
            TraceEnd::Wrap => "begins anew",
            TraceEnd::Perfect => "delivers at once",
            TraceEnd::Lost => "delivers nothing",
        };
        format!(
            "replay of {}, {matching}; after its end it {end}",
            self.file.display()
        )
    }

    /// The link.
    ///
    /// # Errors
    /// When the file is no whole trace, or cannot be replayed.
    pub fn model(&self) -> Result<TraceLink, TraceFileError> {
        let trace = read_whole(&self.file)?;
        TraceLink::new(Arc::new(trace), self.replay).map_err(|source| TraceFileError::Replay {
            path: self.file.clone(),
            source,
        })
    }
}

/// A trace that must be whole, in its binary form or as CSV.
///
/// # Errors
/// With the offset of the first fault.
pub fn read_whole(path: &Path) -> Result<Trace, TraceFileError> {
    let (path_owned, bytes) = (path.to_owned(), read(path)?);
    if looks_like_text(&bytes) {
        let text = String::from_utf8_lossy(&bytes);
        let decoded = csv::decode(&text);
        let whole = decoded.and_then(|read| read.fault.map_or(Ok(read.trace), Err));
        return whole.map_err(|source| TraceFileError::Csv {
            path: path_owned,
            source,
        });
    }
    let Decoded { trace, fault } = wire::decode(&bytes).map_err(|source| {
        let path = path.to_owned();
        TraceFileError::Foreign { path, source }
    })?;
    match fault {
        None => Ok(trace),
        Some(source) => Err(TraceFileError::Damaged {
            path: path_owned,
            source,
            kept: trace.records.len(),
        }),
    }
}

/// The bytes of a file.
///
/// # Errors
/// When it cannot be read.
pub fn read(path: &Path) -> Result<Vec<u8>, TraceFileError> {
    fs::read(path).map_err(|source| TraceFileError::Io {
        path: path.to_owned(),
        source,
    })
}

/// True for what may be CSV: text by its first bytes, and no trace.
pub fn looks_like_text(bytes: &[u8]) -> bool {
    let start = &bytes[..bytes.len().min(512)];
    // A letter may be cut in two at the end.
    let is_utf8 =
        core::str::from_utf8(start).map_or_else(|end| end.error_len().is_none(), |_| true);
    !start.starts_with(&wire::MAGIC)
        && !start.is_empty()
        && is_utf8
        && start
            .iter()
            .all(|byte| byte.is_ascii_graphic() || byte.is_ascii_whitespace() || *byte >= 0x80)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_of_its_own_goes_before_the_folder() {
        let source = TraceSource {
            folder: Some("runs/x/traces".to_owned()),
            files: BTreeMap::from([("a/b".to_owned(), "/tmp/one.trace".to_owned())]),
            replay: TraceReplay::default(),
            base: BaseFolder(PathBuf::from("/lab")),
        };
        let of = |channel| source.launch(channel).unwrap().file;
        assert_eq!(of("a/b"), Path::new("/tmp/one.trace"));
        assert_eq!(of("b/a"), Path::new("/lab/runs/x/traces/b.a.trace"));
        let files_only = TraceSource {
            folder: None,
            ..source
        };
        assert_eq!(files_only.launch("b/a"), None);
    }

    #[test]
    fn text_and_traces_are_told_apart() {
        assert!(looks_like_text(b"# run: x\npublished_ns,delay_ns\n"));
        assert!(!looks_like_text(b"HILTRACE\x01\0\0\0"));
        assert!(!looks_like_text(&[0xd4, 0xc3, 0xb2, 0xa1]));
        assert!(!looks_like_text(b""));
    }
}
