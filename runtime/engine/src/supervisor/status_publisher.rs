//! Tells how a run stands: to the person who started it, in one line, to whoever looks on, in
//! `status.json`, and to the service manager. It decides nothing.

use std::path::Path;
use std::time::{Duration, Instant as WallInstant};

use hil_core::time::Instant;

use super::child::Child;
use super::heartbeat::SilentProcesses;
use super::peer_status::PeerStatus;
use super::process_group::{ManagedProcess, ProcessGroup};
use super::progress_line;
use hil_platform::clock::MonotonicClock;
use hil_platform::console::Console;
use hil_rundir::status::{Phase, ProcessState, ProcessStatus, RunStatus};
use hil_rundir::status_file::StatusFile;
use hil_topology::Topology;

/// How often it tells.
const PERIOD: Duration = Duration::from_millis(500);

#[derive(Debug)]
pub(super) struct StatusPublisher {
    file: StatusFile,
    /// What was told last, and when.
    told: Option<(Phase, WallInstant)>,
    silent_processes: SilentProcesses,
}

impl StatusPublisher {
    /// For the run in `folder`.
    pub(super) fn new(folder: &Path) -> Self {
        Self {
            file: StatusFile::of(folder),
            told: None,
            silent_processes: SilentProcesses::default(),
        }
    }

    /// Tells, if something changed or it is time.
    pub(super) fn tell(
        &mut self,
        phase: Phase,
        topology: &Topology,
        process_group: &mut ProcessGroup,
        elsewhere: &PeerStatus,
        console: &mut Console,
    ) {
        let is_due = self
            .told
            .is_none_or(|(told, at)| told != phase || at.elapsed() >= PERIOD);
        if !is_due {
            return;
        }
        self.told = Some((phase, WallInstant::now()));
        self.tell_service(phase, process_group, console);
        let planned = topology.run().planned();
        let processes = process_group.members().iter().map(process);
        let duration_ns =
            planned.map(|planned| u64::try_from(planned.as_nanos()).unwrap_or(u64::MAX));
        let mut status = RunStatus::new(phase, duration_ns, processes.collect());
        status.elsewhere = elsewhere.status();
        status.start_ns = process_group.started.map(Instant::as_ns);
        // Where the disk takes no records, it is told already and ends the run.
        if let Some(complaint) = self.file.write(status)
            && !process_group.cannot_record()
        {
            console.warn(&complaint);
        }
        let Some(start) = process_group.started.filter(|_| phase == Phase::Running) else {
            return;
        };
        let elapsed = MonotonicClock::now().saturating_duration_since(start);
        let progress = process_group
            .members()
            .iter()
            .flat_map(|member| &member.progress);
        let channels = progress_line::of_channels(topology, progress);
        // Before the first counts there is nothing to tell.
        if !channels.is_empty() {
            let time = progress_line::of_time(elapsed, planned);
            console.progress(&format!("{time}  {channels}"));
        }
    }

    /// A tick of the watchdog says that the loop of the supervisor turns, which calls this, and those
    /// of all processes that it started.
    fn tell_service(
        &mut self,
        phase: Phase,
        process_group: &mut ProcessGroup,
        console: &mut Console,
    ) {
        match phase {
            Phase::Starting => console.announce_alive(),
            Phase::Running => {
                for words in self
                    .silent_processes
                    .look(process_group, MonotonicClock::now())
                {
                    console.warn(&words);
                }
                if self.silent_processes.are_all_there() {
                    console.announce_up();
                }
            }
            Phase::Ending => console.announce_ending(),
        }
    }
}

fn process(member: &ManagedProcess) -> ProcessStatus {
    let pid = member.child.as_ref().map(Child::id);
    let state = match (&member.end, pid) {
        (_, Some(_)) if member.is_ready => ProcessState::Running,
        (_, Some(_)) => ProcessState::Starting,
        (Some(end), None) => ProcessState::Ended(end.clone()),
        (None, None) => ProcessState::NotStarted,
    };
    ProcessStatus {
        name: member.plan.name.clone(),
        host: member.plan.host.clone(),
        kind: member.plan.kind(),
        role: member.plan.role(),
        state,
        pid,
        restart_count: member.restart_count,
        skipped_tick_count: member.skipped_tick_count,
    }
}
