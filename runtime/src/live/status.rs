//! What a supervisor says of its processes while the run goes: the file `status.json` in the run's
//! folder, twice a second. It is for people who look on; nothing in the run reads it.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

/// Name of the file.
const FILE_NAME: &str = "status.json";
/// Version of its layout. Within one, fields are only added.
const STATUS_VERSION: u32 = 1;

/// How the run stands.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct RunStatus {
    /// [`STATUS_VERSION`] of the writer.
    schema_version: u32,
    /// How far it is.
    pub(crate) phase: Phase,
    /// When it was written, on the host's monotonic clock.
    pub(crate) written_ns: i64,
    /// When the run began, on the host's monotonic clock; `None` before.
    pub(crate) start_ns: Option<i64>,
    /// How long it is to be.
    pub(crate) duration_ns: u64,
    /// What runs here.
    pub(crate) processes: Vec<ProcessStatus>,
}

/// How far a run is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Phase {
    /// Its processes make themselves ready.
    Starting,
    /// It runs.
    Running,
    /// Its processes are being ended.
    Ending,
}

impl Phase {
    /// The word for it.
    pub(crate) const fn word(self) -> &'static str {
        match self {
            Self::Starting => "starting",
            Self::Running => "running",
            Self::Ending => "ending",
        }
    }
}

/// How one process stands.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct ProcessStatus {
    /// Its name in the topology.
    pub(crate) name: String,
    /// Its host.
    pub(crate) host: String,
    /// Its role, or what else it is.
    pub(crate) role: String,
    /// `starting`, `running`, or how it ended.
    pub(crate) state: String,
    /// `None` while it does not run.
    pub(crate) pid: Option<u32>,
    /// How often it was started again.
    pub(crate) restart_count: u32,
    /// Ticks of its timer that passed without it; `None` for what has no timer, or has not said.
    pub(crate) skipped_tick_count: Option<u64>,
}

impl RunStatus {
    /// The status of a run that is to last `duration_ns`.
    pub(crate) fn new(phase: Phase, duration_ns: u64, processes: Vec<ProcessStatus>) -> Self {
        Self {
            schema_version: STATUS_VERSION,
            phase,
            written_ns: crate::clock::MonotonicClock::now().as_ns(),
            start_ns: None,
            duration_ns,
            processes,
        }
    }

    /// Reads that of the run in `folder`.
    ///
    /// # Errors
    /// When there is none, or not one that this program can read.
    pub(crate) fn read(folder: &Path) -> io::Result<Self> {
        let text = fs::read_to_string(folder.join(FILE_NAME))?;
        serde_json::from_str(&text).map_err(io::Error::other)
    }
}

/// True once the run in `folder` has begun; false also when it is over.
pub fn has_begun(folder: &Path) -> bool {
    let status = RunStatus::read(folder);
    status.is_ok_and(|status| status.phase == Phase::Running)
}

/// Ticks of a process that passed without it: its host overran.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ProcessOverruns {
    /// Its name in the topology.
    pub process: String,
    /// Its host.
    pub host: String,
    /// How many so far; `None` for what has no timer, or has not said.
    pub skipped_tick_count: Option<u64>,
}

/// The overruns of every process here of the run in `folder`, while it goes on.
///
/// # Errors
/// When there is no `status.json`, as before and after a run, or none that this program can read.
pub fn overruns(folder: &Path) -> io::Result<Vec<ProcessOverruns>> {
    let processes = RunStatus::read(folder)?.processes.into_iter();
    let overruns = processes.map(|one| ProcessOverruns {
        process: one.name,
        host: one.host,
        skipped_tick_count: one.skipped_tick_count,
    });
    Ok(overruns.collect())
}

/// The file for as long as the run goes; it is removed when this is dropped.
#[derive(Debug)]
pub(crate) struct StatusFile {
    path: PathBuf,
    /// One complaint is enough.
    has_complained: bool,
}

impl StatusFile {
    /// That of the run in `folder`; writes nothing yet.
    pub(crate) fn of(folder: &Path) -> Self {
        Self {
            path: folder.join(FILE_NAME),
            has_complained: false,
        }
    }

    /// Writes `status`, so that a reader finds it whole. Gives the complaint, once; what hindered it
    /// may be over the next time.
    pub(crate) fn write(&mut self, status: &RunStatus) -> Option<String> {
        let new = self.path.with_extension("json.new");
        let written = serde_json::to_string(status)
            .map_err(io::Error::other)
            .and_then(|text| fs::write(&new, text))
            .and_then(|()| fs::rename(&new, &self.path));
        let error = written.err()?;
        if self.has_complained {
            return None;
        }
        self.has_complained = true;
        let path = self.path.display();
        Some(format!(
            "{path}: {error}; until it can be written, `hil-runtime top` does not see how the \
             processes stand"
        ))
    }
}

impl Drop for StatusFile {
    fn drop(&mut self) {
        // Where it cannot be removed it only says how the run stood last.
        let _is_gone = fs::remove_file(&self.path).is_ok();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_is_read_as_written_and_goes_with_its_file() {
        let folder = std::env::temp_dir().join(format!("hil-status-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let process = ProcessStatus {
            name: "robot".to_owned(),
            host: "here".to_owned(),
            role: "robot".to_owned(),
            state: "running".to_owned(),
            pid: Some(7),
            restart_count: 1,
            skipped_tick_count: None,
        };
        let status = RunStatus::new(Phase::Running, 5, vec![process]);
        let mut file = StatusFile::of(&folder);
        assert_eq!(file.write(&status), None);
        assert_eq!(RunStatus::read(&folder).unwrap(), status);
        let overruns = overruns(&folder).unwrap();
        assert_eq!(
            (overruns[0].process.as_str(), overruns[0].skipped_tick_count),
            ("robot", None)
        );
        drop(file);
        assert!(RunStatus::read(&folder).is_err());
        fs::remove_dir_all(&folder).unwrap();
        let mut nowhere = StatusFile::of(&folder);
        assert!(
            nowhere
                .write(&status)
                .is_some_and(|why| why.contains("status.json"))
        );
        assert_eq!(nowhere.write(&status), None, "one complaint is enough");
        fs::create_dir_all(&folder).unwrap();
        assert_eq!(nowhere.write(&status), None);
        assert_eq!(RunStatus::read(&folder).unwrap(), status);
        drop(nowhere);
        fs::remove_dir_all(&folder).unwrap();
    }
}
