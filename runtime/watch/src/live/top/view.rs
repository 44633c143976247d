//! What `top` shows: plain figures of one look, ready to be drawn or printed as JSON. What is not
//! known is `None`. Nothing here gathers or draws.

use std::collections::BTreeMap;
use std::path::PathBuf;

use hil_core::case_study::Severity;
use serde::Serialize;

use hil_rundir::event::ProcessKind;
use hil_rundir::status::{HostHearing, Phase, ProcessState};

/// One look at a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct View {
    /// The run as a whole.
    pub(crate) run: RunView,
    /// What runs on this host.
    pub(crate) processes: Vec<ProcessRow>,
    /// The other hosts of the run.
    pub(crate) elsewhere: Vec<PeerStatusRow>,
    /// The channels with an end on this host, and those that are only recorded here.
    pub(crate) channels: Vec<ChannelRow>,
    /// What happened to the robot; `None` where its case finds no events, or none of its messages is recorded on
    /// this host.
    pub(crate) robot: Option<RobotView>,
    /// What carries them.
    pub(crate) links: Vec<LinkRow>,
    /// How the clocks of its hosts stand to each other.
    pub(crate) clocks: Vec<ClockRow>,
    /// What could not be read, in words.
    pub(crate) problems: Vec<String>,
}

hil_core::labelled! {
    /// How far a run is.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
    #[serde(rename_all = "snake_case")]
    pub(crate) enum RunState, label {
        /// Its processes make themselves ready.
        Starting = "starting",
        /// It runs.
        Running = "running",
        /// Its processes are being ended.
        Ending = "ending",
        /// It is over.
        Ended = "ended",
        /// Its supervisor was killed.
        SupervisorGone = "supervisor gone",
        /// Its supervisor does not tell.
        Unknown = "unknown",
    }
}

impl From<Phase> for RunState {
    fn from(phase: Phase) -> Self {
        match phase {
            Phase::Starting => Self::Starting,
            Phase::Running => Self::Running,
            Phase::Ending => Self::Ending,
        }
    }
}

/// The run as a whole.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct RunView {
    /// Its name.
    pub(crate) name: String,
    /// Its folder.
    pub(crate) folder: PathBuf,
    /// Hosts of it that run here.
    pub(crate) hosts_here: Vec<String>,
    /// How far it is.
    pub(crate) state: RunState,
    /// Since it began, seconds.
    pub(crate) elapsed_s: Option<f64>,
    /// How long it is to be, seconds.
    pub(crate) duration_s: Option<f64>,
    /// How far the figures reach back, seconds.
    pub(crate) window_s: f64,
}

/// One process.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct ProcessRow {
    /// Its name in the topology.
    pub(crate) name: String,
    /// Its host.
    pub(crate) host: String,
    /// What it is.
    pub(crate) kind: ProcessKind,
    /// The role of the case that it plays, or that a foreign program plays through it.
    pub(crate) role: Option<String>,
    /// How far it is.
    pub(crate) state: ProcessState,
    /// Its process id.
    pub(crate) pid: Option<u32>,
    /// Processor time over time, 1 for one whole processor.
    pub(crate) cpu_ratio: Option<f64>,
    /// Processors it may run on, as the kernel lists them, e.g. `1` or `0-3`.
    pub(crate) cpus: Option<String>,
    /// How the kernel schedules it, e.g. `fifo 40`; the highest of its threads.
    pub(crate) scheduling: Option<String>,
    /// Ticks of its timer that passed without it.
    pub(crate) overrun_count: Option<u64>,
    /// How often it was started again.
    pub(crate) restart_count: u32,
}

/// Another host, as far as it is heard here.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct PeerStatusRow {
    /// How well it is heard.
    #[serde(flatten)]
    pub(crate) hearing: HostHearing,
    /// Ticks that passed without its processes, as it last said; those that skipped none, and those
    /// that have not said, left out.
    pub(crate) overruns: BTreeMap<String, u64>,
}

/// Median and 99th percentile, nanoseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub(crate) struct Quantiles {
    /// Median.
    pub(crate) p50_ns: i64,
    /// 99th percentile.
    pub(crate) p99_ns: i64,
}

/// One channel.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct ChannelRow {
    /// Its name.
    pub(crate) name: String,
    /// What carries it: a link's name, `shared memory`, `record only`.
    pub(crate) via: String,
    /// Messages per second in the window, where this host first sees them.
    pub(crate) rate_hz: Option<f64>,
    /// Messages lost in the window, as far as this host can tell.
    pub(crate) lost_count: Option<u64>,
    /// Published to taken.
    pub(crate) delay: Option<Quantiles>,
    /// Why there is no delay.
    pub(crate) why_no_delay: Option<String>,
    /// Largest error of the delay by the clocks, nanoseconds; 0 on one clock.
    pub(crate) bound_ns: Option<u64>,
    /// The parts of the way in their order.
    pub(crate) segments: Vec<SegmentRow>,
    /// 99th percentiles of the delay in the windows before, oldest first, nanoseconds; `None` where
    /// there was none.
    pub(crate) history_ns: Vec<Option<i64>>,
}

/// One part of a channel's way.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct SegmentRow {
    /// Its two ends.
    pub(crate) name: String,
    /// Its time; `None` where this host's records do not have both ends.
    pub(crate) time: Option<Quantiles>,
}

hil_core::labelled! {
    /// Whether a link carries anything.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
    #[serde(rename_all = "snake_case")]
    pub(crate) enum LinkState, label {
        /// Messages came over it within the window.
        Carries = "carries",
        /// None did.
        Silent = "silent",
        /// None of its messages come to this host.
        Unknown = "unknown",
    }
}

/// What happened to the robot.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct RobotView {
    /// The gravest events, of equal ones the newest; newest first.
    pub(crate) recent: Vec<RobotEventRow>,
    /// All since the run began.
    pub(crate) event_count: u64,
    /// More of the past is still to be read: newer events are missing.
    pub(crate) is_behind: bool,
}

/// One event of the robot.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct RobotEventRow {
    /// Since the run began, seconds.
    pub(crate) at_s: Option<f64>,
    /// How much it matters.
    pub(crate) severity: Severity,
    /// What happened, in words.
    pub(crate) what: String,
}

/// One link.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct LinkRow {
    /// Its name.
    pub(crate) name: String,
    /// `udp`, `tcp`, `emulated` or `shared-memory`.
    pub(crate) via: String,
    /// Whether it carries anything.
    pub(crate) state: LinkState,
    /// What its emulation does, each way in words.
    pub(crate) condition: Option<String>,
    /// Messages sent in the window that were lost on the way, of those whose fate is known.
    pub(crate) loss_ratio: Option<f64>,
}

/// Two hosts' clocks.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct ClockRow {
    /// One host.
    pub(crate) from: String,
    /// The other.
    pub(crate) to: String,
    /// What figures between the two rest on, in the words of a report.
    pub(crate) rung: String,
    /// Exchanges of the last half minute; `None` where none is needed or there was none.
    pub(crate) exchange_count: Option<u64>,
    /// What to add to the first one's monotonic clock to have the second one's, nanoseconds.
    pub(crate) offset_ns: Option<i64>,
    /// Largest error of that, nanoseconds.
    pub(crate) bound_ns: Option<u64>,
}

impl View {
    /// True when nothing of the run goes on: the figures are the last ones from while it did.
    pub(crate) fn is_over(&self) -> bool {
        matches!(self.run.state, RunState::Ended | RunState::SupervisorGone)
    }

    /// How much of the run is over, 0 to 1.
    pub(crate) fn progress_ratio(&self) -> Option<f64> {
        let (elapsed_s, duration_s) = self.run.elapsed_s.zip(self.run.duration_s)?;
        (duration_s > 0.0).then(|| (elapsed_s / duration_s).clamp(0.0, 1.0))
    }
}
