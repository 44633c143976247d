//! What a supervisor says of its processes while the run goes: the file `status.json` in the run's
//! folder, twice a second. It is for people who look on; nothing in the run reads it.

use std::collections::BTreeSet;
use std::path::Path;
use std::time::Duration;
use std::{fmt, io};

use hil_core::time::Instant;
use hil_platform::plain_file;
use serde::{Deserialize, Serialize};

use crate::event::ProcessKind;

/// Name of the file.
pub(crate) const FILE_NAME: &str = "status.json";
/// Version of its layout. Within one, fields are only added.
const STATUS_VERSION: u32 = 2;

/// How the run stands.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunStatus {
    /// [`STATUS_VERSION`] of the writer.
    schema_version: u32,
    /// How far it is.
    pub phase: Phase,
    /// When it was written, on the host's monotonic clock.
    pub written_ns: i64,
    /// When the run began, on the host's monotonic clock; `None` before.
    pub start_ns: Option<i64>,
    /// How long it is to be; `None` where only its processes or a person end it.
    pub duration_ns: Option<u64>,
    /// What runs here.
    pub processes: Vec<ProcessStatus>,
    /// What the other hosts of the run said.
    #[serde(default)]
    pub elsewhere: Vec<HostStatus>,
}

/// What another host said of its processes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct HostStatus {
    /// Its name.
    pub name: String,
    /// When it last said something, on this host's monotonic clock; `None` when it never did.
    pub heard_ns: Option<i64>,
    /// Its processes.
    pub processes: Vec<TickStatus>,
    /// Processes that skipped ticks and are not among them.
    pub left_out_count: usize,
}

/// The ticks of a process of another host.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TickStatus {
    /// Its name in the topology.
    pub name: String,
    /// As [`ProcessStatus::skipped_tick_count`].
    pub skipped_tick_count: Option<u64>,
}

/// How far a run is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// Its processes make themselves ready.
    Starting,
    /// It runs.
    Running,
    /// Its processes are being ended.
    Ending,
}

/// How far a process is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ProcessState {
    /// It was not started yet.
    NotStarted,
    /// It makes itself ready.
    Starting,
    /// It runs.
    Running,
    /// It ended, in this way.
    Ended(String),
}

impl ProcessState {
    /// True while the process is there.
    pub const fn is_alive(&self) -> bool {
        matches!(self, Self::Starting | Self::Running)
    }
}

impl fmt::Display for ProcessState {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::NotStarted => "not started",
            Self::Starting => "starting",
            Self::Running => "running",
            Self::Ended(how) => how,
        })
    }
}

/// How one process stands.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ProcessStatus {
    /// Its name in the topology.
    pub name: String,
    /// Its host.
    pub host: String,
    /// What it is.
    pub kind: ProcessKind,
    /// The role of the case that it plays, or that a foreign program plays through it.
    pub role: Option<String>,
    /// How far it is.
    pub state: ProcessState,
    /// `None` while it does not run.
    pub pid: Option<u32>,
    /// How often it was started again.
    pub restart_count: u32,
    /// Ticks of its timer that passed without it; `None` for what has no timer, or has not said.
    pub skipped_tick_count: Option<u64>,
}

impl RunStatus {
    /// The status of a run that is to last `duration_ns`.
    pub fn new(phase: Phase, duration_ns: Option<u64>, processes: Vec<ProcessStatus>) -> Self {
        Self {
            schema_version: STATUS_VERSION,
            phase,
            written_ns: hil_platform::clock::MonotonicClock::now().as_ns(),
            start_ns: None,
            duration_ns,
            processes,
            elsewhere: Vec::new(),
        }
    }

    /// Reads that of the run in `folder`.
    ///
    /// # Errors
    /// When there is none, or not one that this program can read.
    pub fn read(folder: &Path) -> io::Result<Self> {
        let text = plain_file::read_to_string(&folder.join(FILE_NAME))?;
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

/// How much of a host's overruns is known.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct HostHearing {
    /// The host.
    pub host: String,
    /// False when it has not been heard for [`HEARING_MAX`]: what it said before is out of date.
    pub is_heard: bool,
    /// How long ago it was heard; `None` when it never was.
    pub silent_s: Option<f64>,
    /// Processes that skipped ticks and of which it found no room to tell.
    pub left_out_count: usize,
}

/// The overruns of a run's hosts.
#[derive(Debug, Clone, PartialEq)]
pub struct Overruns {
    /// Of all processes that were told of.
    pub processes: Vec<ProcessOverruns>,
    /// The hosts of the run, those here first.
    pub hosts: Vec<HostHearing>,
}

/// A host says how it stands twice a second; one that says nothing for this long is not heard.
pub const HEARING_MAX: Duration = Duration::from_secs(3);

/// How well `host` is heard at `now` when it was last at `heard_ns`.
pub fn hearing(
    host: &str,
    heard_ns: Option<i64>,
    now: Instant,
    left_out_count: usize,
) -> HostHearing {
    let silent = heard_ns.map(|at| now.saturating_duration_since(Instant::from_ns(at)));
    HostHearing {
        host: host.to_owned(),
        is_heard: silent.is_some_and(|silent| silent <= HEARING_MAX),
        silent_s: silent.map(|silent| silent.as_secs_f64()),
        left_out_count,
    }
}

/// The overruns of the run in `folder` as of `now`, while it goes on.
///
/// # Errors
/// When there is no `status.json`, as before and after a run, or none that this program can read; and
/// while the run is being ended, when no host tells any more.
pub fn overruns(folder: &Path, now: Instant) -> io::Result<Overruns> {
    let status = RunStatus::read(folder)?;
    if status.phase == Phase::Ending {
        return Err(io::Error::other("the run is being ended"));
    }
    // The supervisor here speaks for the hosts here, unless it hangs.
    let here: BTreeSet<&str> = status
        .processes
        .iter()
        .map(|one| one.host.as_str())
        .collect();
    let here = here
        .into_iter()
        .map(|host| hearing(host, Some(status.written_ns), now, 0));
    let elsewhere = status.elsewhere.iter();
    let elsewhere =
        elsewhere.map(|host| hearing(&host.name, host.heard_ns, now, host.left_out_count));
    let hosts = here.chain(elsewhere).collect();
    let own = status.processes.iter().map(|one| ProcessOverruns {
        process: one.name.clone(),
        host: one.host.clone(),
        skipped_tick_count: one.skipped_tick_count,
    });
    let others = status.elsewhere.iter().flat_map(|host| {
        host.processes.iter().map(|one| ProcessOverruns {
            process: one.name.clone(),
            host: host.name.clone(),
            skipped_tick_count: one.skipped_tick_count,
        })
    });
    let processes = own.chain(others).collect();
    Ok(Overruns { processes, hosts })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_status_is_read_as_written() {
        let folder = std::env::temp_dir().join(format!("hil-status-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let process = ProcessStatus {
            name: "robot".to_owned(),
            host: "here".to_owned(),
            kind: ProcessKind::Component,
            role: Some("robot".to_owned()),
            state: ProcessState::Running,
            pid: Some(7),
            restart_count: 1,
            skipped_tick_count: None,
        };
        let mut status = RunStatus::new(Phase::Running, Some(5), vec![process]);
        status.elsewhere = ["there", "nowhere"].map(elsewhere).to_vec();
        status.elsewhere[0].heard_ns = Some(status.written_ns);
        write(&folder, &status);
        assert_eq!(RunStatus::read(&folder).unwrap(), status);
        check_overruns(&folder, Instant::from_ns(status.written_ns));
        status.phase = Phase::Ending;
        write(&folder, &status);
        let at_the_end = overruns(&folder, Instant::from_ns(status.written_ns));
        assert!(at_the_end.is_err(), "nobody tells any more: {at_the_end:?}");
        fs::remove_dir_all(&folder).unwrap();
    }

    fn write(folder: &Path, status: &RunStatus) {
        let text = serde_json::to_string(status).unwrap();
        fs::write(folder.join(FILE_NAME), text).unwrap();
    }

    fn elsewhere(name: &str) -> HostStatus {
        HostStatus {
            name: name.to_owned(),
            heard_ns: None,
            processes: vec![TickStatus {
                name: "arm".to_owned(),
                skipped_tick_count: Some(3),
            }],
            left_out_count: 2,
        }
    }

    /// A host that was not heard is said to be so, also when the supervisor here is the one that hangs.
    fn check_overruns(folder: &Path, written: Instant) {
        let at = |after: Duration| {
            let after_ns = i64::try_from(after.as_nanos()).unwrap();
            let now = Instant::from_ns(written.as_ns() + after_ns);
            overruns(folder, now).unwrap()
        };
        let found = at(Duration::from_secs(1));
        let counts = found.processes.iter();
        let counts: Vec<_> = counts
            .map(|one| (one.host.as_str(), one.skipped_tick_count))
            .collect();
        let expected = [("here", None), ("there", Some(3)), ("nowhere", Some(3))];
        assert_eq!(counts, expected);
        let heard = |overruns: &Overruns| -> Vec<_> {
            let hosts = overruns.hosts.iter();
            hosts.map(|one| (one.is_heard, one.silent_s)).collect()
        };
        assert_eq!(
            heard(&found),
            [(true, Some(1.0)), (true, Some(1.0)), (false, None)]
        );
        let late = HEARING_MAX + Duration::from_secs(1);
        assert_eq!(
            heard(&at(late)),
            [(false, Some(4.0)), (false, Some(4.0)), (false, None)]
        );
    }
}
