//! The processes of this supervisor as a whole: started in order, watched, restarted or given up
//! by policy, stopped in order. Each single one is a [`Child`].

use std::collections::BTreeMap;
use std::io;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::Duration;

use hil_core::time::{Instant, duration_ns};

use super::child::{Child, ProcessEnd, Word, last_line};
use super::output_log::{LogKeeper, cut_middle};
use super::plan::{ProcessPlan, ProcessTask};
use hil_platform::clock::MonotonicClock;
use hil_platform::open_files;
use hil_platform::own_process;
use hil_platform::text::shortened;
use hil_rundir::event::{Event, EventKind, Interruption};
use hil_rundir::file_fault::FileFault;
use hil_rundir::launch::{ComponentWork, LaunchError, Work, WorkerLaunch, write};
use hil_rundir::pipe::{
    ChannelProgress, Failure, FailureKind, FromProcess, ProcessReport, ToProcess,
};
use hil_rundir::run_folder::RunFolder;
use hil_rundir::run_result::Outcome;
use hil_rundir::run_seal::RunSeal;
use hil_shm::{Room, SHARED_MEMORY_DIRECTORY};
use hil_topology::OnExit;

/// Words that may wait for the supervisor.
const WORDS_MAX: usize = 4096;
/// Messages a dead process may have held in its queues were published at most this long before
/// it was last seen alive.
const QUEUE_SPAN: Duration = Duration::from_millis(50);

/// The last words of a process that has ended are in its pipe; reading them takes no longer.
const LAST_WORDS_PATIENCE: Duration = Duration::from_secs(1);

/// What a process says in one warning, or why it failed: about five lines of a report.
const TEXT_CHARS_MAX: usize = 500;
/// Warnings that are kept of the processes of a supervisor; more are counted.
const WARNINGS_MAX: usize = 100_000;
/// Events of the hosts themselves that are kept beside them; more are counted.
const HOST_EVENTS_MAX: usize = 1_000;

/// Why the processes could not be started.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ProcessGroupError {
    #[error(transparent)]
    Launch(#[from] LaunchError),
    #[error("process {process}: cannot start {program}: {source}")]
    Spawn {
        process: String,
        program: String,
        source: io::Error,
    },
    #[error("cannot start a thread: {0}")]
    Thread(io::Error),
}

impl ProcessGroupError {
    /// What it means for whoever would try again.
    fn kind(&self) -> FailureKind {
        match self {
            Self::Spawn { source, .. } | Self::Thread(source) => FailureKind::of(source),
            Self::Launch(_) => FailureKind::Fault,
        }
    }
}

/// One process with its history.
#[derive(Debug)]
pub(crate) struct ManagedProcess {
    pub(crate) plan: ProcessPlan,
    pub(crate) restart_count: u32,
    pub(crate) report: Option<ProcessReport>,
    pub(crate) end: Option<String>,
    pub(crate) progress: Vec<ChannelProgress>,
    /// Ticks of its timer that passed without it, as it last said.
    pub(crate) skipped_tick_count: Option<u64>,
    pub(super) child: Option<Child>,
    pub(super) is_ready: bool,
    /// When it last said that its loops turn, or was asked to begin.
    pub(super) heard: Instant,
    seen_alive: Instant,
    /// When its end was seen.
    seen_ended: Option<Instant>,
    complaint: Option<Failure>,
    /// Warnings for which there was no room.
    left_out_count: u64,
}

/// Puts the counts that a process tells of now in the place of those it told of before, both in its order.
fn merge(known: &mut Vec<ChannelProgress>, told: Vec<ChannelProgress>) {
    let mut next = 0;
    for one in told {
        let is_it =
            |known: &ChannelProgress| (&known.channel, &known.what) == (&one.channel, &one.what);
        match known[next..].iter().position(is_it) {
            Some(place) => {
                next += place;
                known[next] = one;
            }
            None => known.push(one),
        }
    }
}

/// The processes of one supervisor.
#[derive(Debug)]
pub(crate) struct ProcessGroup {
    members: Vec<ManagedProcess>,
    places: BTreeMap<String, String>,
    folder: RunFolder,
    /// The run's secret, for its gateways; `None` when its hops are plain.
    seal: Option<RunSeal>,
    sender: SyncSender<Word>,
    words: Receiver<Word>,
    /// When the run began.
    pub(super) started: Option<Instant>,
    events: Vec<Event>,
    /// How many of them are warnings of processes.
    warning_count: usize,
    /// How many of them are of a host.
    host_event_count: usize,
    /// The first file that a process could not write, and the host of it.
    unwritten: Option<(String, FileFault)>,
    log_keeper: Option<LogKeeper>,
}

impl ProcessGroup {
    /// A process group for `plans`; `places` gives the address of each host's shared memory. Starts nothing.
    pub(crate) fn new(
        plans: Vec<ProcessPlan>,
        places: BTreeMap<String, String>,
        folder: &RunFolder,
        seal: Option<RunSeal>,
    ) -> Self {
        let (sender, words) = sync_channel(WORDS_MAX);
        let members = plans.into_iter().map(|plan| ManagedProcess {
            plan,
            restart_count: 0,
            report: None,
            end: None,
            progress: Vec::new(),
            skipped_tick_count: None,
            child: None,
            is_ready: false,
            heard: Instant::ZERO,
            seen_alive: Instant::ZERO,
            seen_ended: None,
            complaint: None,
            left_out_count: 0,
        });
        Self {
            members: members.collect(),
            places,
            folder: folder.clone(),
            seal,
            sender,
            words,
            started: None,
            events: Vec::new(),
            warning_count: 0,
            host_event_count: 0,
            unwritten: None,
            log_keeper: None,
        }
    }

    /// Starts every process; they wait for [`ProcessGroup::begin`].
    ///
    /// # Errors
    /// How the run ends by it.
    pub(crate) fn start(&mut self) -> Result<(), Outcome> {
        let started = self.start_all();
        started.map_err(|(index, error)| self.not_started(index, &error))
    }

    /// What it means that a process could not be started.
    fn not_started(&self, index: usize, error: &ProcessGroupError) -> Outcome {
        match error {
            ProcessGroupError::Launch(LaunchError::Io { path, source }) => Outcome::Unwritable {
                host: self.members[index].plan.host.clone(),
                fault: FileFault::new(path, source),
            },
            other => Outcome::Failed(Failure {
                kind: other.kind(),
                text: other.to_string(),
            }),
        }
    }

    fn start_all(&mut self) -> Result<(), (usize, ProcessGroupError)> {
        let names = self.members.iter().map(|member| &member.plan.name);
        let logs = names.map(|name| self.folder.log(name)).collect();
        let keeper = LogKeeper::start(logs).map_err(ProcessGroupError::Thread);
        self.log_keeper = Some(keeper.map_err(|error| (0, error))?);
        (0..self.members.len()).try_for_each(|index| {
            let spawned = self.spawn(index);
            spawned.map_err(|error| (index, error))
        })
    }

    fn spawn(&mut self, index: usize) -> Result<(), ProcessGroupError> {
        let member = &mut self.members[index];
        let (name, instance) = (member.plan.name.clone(), member.restart_count);
        let log = self.folder.log(&name);
        let domain = self.places[&member.plan.host].clone();
        let mut program = own_process::again();
        let work = match &member.plan.task {
            ProcessTask::Component {
                card,
                realtime,
                wait,
            } => {
                let role_spec_path = self.folder.role_spec(&name);
                write(&role_spec_path, card)?;
                Some(Work::Component(ComponentWork {
                    card: role_spec_path,
                    realtime: realtime.clone(),
                    wait: *wait,
                }))
            }
            ProcessTask::Gateway(work) | ProcessTask::ClockPath(work) => {
                Some(Work::Gateway(work.clone()))
            }
            ProcessTask::Adapter(adapter) => Some(Work::Adapter(adapter.clone())),
            ProcessTask::Cable(work) => Some(Work::Cable(work.clone())),
            ProcessTask::Witness(work) => Some(Work::Witness(work.clone())),
            ProcessTask::Foreign {
                card,
                command,
                environment,
                realtime,
            } => {
                let role_spec_path = self.folder.role_spec(&name);
                write(&role_spec_path, card)?;
                let supervisor = std::process::id().to_string();
                program.args(["become", "--supervisor", &supervisor]);
                if let Some(limit) = open_files::inherited_limit() {
                    program.args(["--open-files", &limit.to_string()]);
                }
                let realtime = serde_json::to_string(realtime);
                program.args([
                    "--realtime",
                    &realtime.expect("its fields have plain names"),
                ]);
                program
                    .arg("--")
                    .args(command)
                    .envs(environment)
                    .env("HIL_DOMAIN", &domain)
                    .env("HIL_CARD", &role_spec_path);
                None
            }
        };
        // A user's own program says nothing: being started is all that is known of it.
        member.is_ready = work.is_none();
        let spawned = match work {
            None => Child::spawn_foreign(program, &log),
            Some(work) => {
                let launch = WorkerLaunch {
                    process: name.clone(),
                    instance,
                    domain,
                    records: self.folder.records(),
                    is_sealed: self.seal.is_some() && member.plan.is_gateway(),
                    work,
                };
                let path = self.folder.launch(&name, instance);
                write(&path, &launch)?;
                program.arg("worker").arg("--launch").arg(&path);
                Child::spawn_speaking(program, &log, index, instance, self.sender.clone())
            }
        };
        let mut child = spawned.map_err(|source| ProcessGroupError::Spawn {
            process: name,
            program: match &member.plan.task {
                ProcessTask::Foreign { command, .. } => command[0].clone(),
                _ => own_process::RUNNING_FILE.to_owned(),
            },
            source,
        })?;
        if let Some(seal) = self.seal.as_ref().filter(|_| member.plan.is_gateway()) {
            child.order(&ToProcess::Seal(seal.clone()));
        }
        let now = MonotonicClock::now();
        member.child = Some(child);
        member.complaint = None;
        member.seen_ended = None;
        member.seen_alive = now;
        if member.is_ready && self.started.is_some() {
            self.close_interruptions(index, now);
        }
        Ok(())
    }

    /// True once every process is ready.
    pub(crate) fn is_ready(&self) -> bool {
        self.members.iter().all(|member| member.is_ready)
    }

    /// Names of the processes that are not ready yet.
    pub(crate) fn missing(&self) -> String {
        let missing = self.members.iter().filter(|member| !member.is_ready);
        missing
            .map(|member| member.plan.name.as_str())
            .collect::<Vec<_>>()
            .join(", ")
    }

    /// Lets every process begin.
    pub(crate) fn begin(&mut self) {
        let started = MonotonicClock::now();
        self.started = Some(started);
        let at_ns = started.as_ns();
        for member in &mut self.members {
            member.heard = started;
            if let Some(child) = &mut member.child {
                child.order(&ToProcess::Start { at_ns });
            }
        }
    }

    /// Hears what the processes said, sees who died, and applies the policies. Gives how the run ends, if one ended it.
    pub(crate) fn watch(&mut self) -> Option<Outcome> {
        self.listen();
        // Its end, and that of others on the same disk, follows from it.
        if let Some(outcome) = self.unwritable() {
            return Some(outcome);
        }
        let now = MonotonicClock::now();
        let mut outcome = None;
        for index in 0..self.members.len() {
            let member = &mut self.members[index];
            let Some(child) = &mut member.child else {
                continue;
            };
            let Some(end) = child.poll_end() else {
                member.seen_alive = now;
                continue;
            };
            // What it said last decides what its end means. That comes within moments, unless something that it started
            // has its output, too.
            let ended = *member.seen_ended.get_or_insert(now);
            if !child.has_said_all() && now.saturating_duration_since(ended) < LAST_WORDS_PATIENCE {
                continue;
            }
            member.child = None;
            member.end = Some(end.to_string());
            self.listen();
            if let Some(outcome) = self.unwritable() {
                return Some(outcome);
            }
            let judged = self.judge(index, end, now);
            // A failure is not overridden by an orderly end seen in the same turn.
            let has_failed = matches!(
                outcome,
                Some(Outcome::Failed(_) | Outcome::Unwritable { .. })
            );
            if !has_failed && judged.is_some() {
                outcome = judged;
            }
        }
        outcome
    }

    /// Whether a process here cannot record any more.
    pub(super) fn cannot_record(&self) -> bool {
        self.unwritten.is_some()
    }

    fn unwritable(&self) -> Option<Outcome> {
        let (host, fault) = self.unwritten.clone()?;
        Some(Outcome::Unwritable { host, fault })
    }

    /// What came of a process that ended so, with what it said of it.
    fn end_words(&self, index: usize, end: ProcessEnd) -> String {
        let member = &self.members[index];
        let log = self.folder.log(&member.plan.name);
        if let Some(Failure { kind, text }) = &member.complaint {
            // What a program of the user's said came before what its starter says of its end.
            let last = (*kind == FailureKind::ProgramEnded).then(|| last_line(&log, Some(text)));
            return match last.flatten() {
                None => format!("{end}: {text}"),
                Some(last) => format!("{end}: {text}, after it said \"{last}\""),
            };
        }
        if end.signal() == Some(libc::SIGBUS)
            && let Ok(free) = Room::free()
        {
            return format!("{end}; {SHARED_MEMORY_DIRECTORY} has {free} free");
        }
        if end.code().is_some_and(|code| code != 0)
            && let Some(last) = last_line(&log, None)
        {
            return format!("{end}, after it said \"{last}\"");
        }
        end.to_string()
    }

    /// What the end of a process means: it is started again, or the run ends.
    fn judge(&mut self, index: usize, end: ProcessEnd, now: Instant) -> Option<Outcome> {
        let what = self.end_words(index, end);
        let member = &mut self.members[index];
        let kind = member.complaint.as_ref().map(|failure| failure.kind);
        // What a process cannot do it cannot do when it is started again; a program may.
        let may_restart = kind.is_none_or(|kind| kind == FailureKind::ProgramEnded);
        member.end = Some(what.clone());
        let limit = match member.plan.on_exit {
            OnExit::EndRun => 0,
            OnExit::Restart { limit } => limit,
        };
        let name = member.plan.name.clone();
        let is_orderly = end.code() == Some(0) && kind.is_none();
        let interruption = self.interruption(index);
        let member = &mut self.members[index];
        if self.started.is_some() && member.restart_count < limit && may_restart {
            member.restart_count += 1;
            let kind = EventKind::Restarted {
                end: what,
                restart: member.restart_count,
                limit,
            };
            self.note(now, index, kind, Some(interruption));
            return match self.spawn(index) {
                Ok(()) => None,
                Err(error) if self.members[index].plan.is_clock_path() => {
                    self.go_on_without(now, index, error.to_string());
                    None
                }
                Err(error) => {
                    let kind = EventKind::StartFailed {
                        error: error.to_string(),
                    };
                    self.note(now, index, kind, None);
                    Some(self.not_started(index, &error))
                }
            };
        }
        if self.members[index].plan.is_clock_path() {
            self.go_on_without(now, index, what);
            return None;
        }
        // What it had in its queues, or came for it until the end, is lost with it.
        let interruption = Some(interruption).filter(|_| !is_orderly);
        let text = format!("process {name} {what}");
        self.note(now, index, EventKind::EndedRun { end: what }, interruption);
        Some(if is_orderly {
            Outcome::EndedEarly(text)
        } else {
            let has_own_output = matches!(
                self.members[index].plan.task,
                ProcessTask::Cable(_) | ProcessTask::Foreign { .. }
            );
            let text = if has_own_output {
                let log = self.folder.log(&self.members[index].plan.name);
                format!("{text}; its output is in {}", log.display())
            } else {
                text
            };
            Outcome::Failed(Failure {
                kind: kind.unwrap_or(FailureKind::Fault),
                text,
            })
        })
    }

    /// From when on nothing is known of what a process carried that now is lost, or records nothing more.
    fn interruption(&self, index: usize) -> Interruption {
        let member = &self.members[index];
        // What a witness saw a program given was given to it.
        let queue = match member.plan.task {
            ProcessTask::Foreign { .. } => Duration::ZERO,
            _ => QUEUE_SPAN,
        };
        let from = member.seen_alive.as_ns() - duration_ns(queue);
        Interruption {
            from: Instant::from_ns(from),
            until: None,
        }
    }

    /// A clock path that is gone for good: nothing waits for it, and no message depends on it.
    fn go_on_without(&mut self, now: Instant, index: usize, end: String) {
        self.members[index].is_ready = true;
        self.note(now, index, EventKind::GivenUp { end }, None);
    }

    fn listen(&mut self) {
        while let Ok(Word {
            index,
            instance,
            said,
        }) = self.words.try_recv()
        {
            let now = MonotonicClock::now();
            if self.members[index].restart_count != instance {
                continue;
            }
            let member = &mut self.members[index];
            match said {
                FromProcess::Alive => member.heard = now,
                FromProcess::Ready => {
                    member.is_ready = true;
                    member.heard = now;
                    if let Some(started) = self.started
                        && instance > 0
                    {
                        let at_ns = started.as_ns();
                        if let Some(child) = &mut member.child {
                            child.order(&ToProcess::Start { at_ns });
                        }
                        self.close_interruptions(index, now);
                    }
                }
                FromProcess::Progress(progress) => merge(&mut member.progress, progress),
                FromProcess::SkippedTicks(count) => member.skipped_tick_count = Some(count),
                FromProcess::Warning(_) if self.warning_count >= WARNINGS_MAX => {
                    member.left_out_count += 1;
                }
                FromProcess::Warning(text) => {
                    self.warning_count += 1;
                    let text = shortened(&text, TEXT_CHARS_MAX);
                    self.note(now, index, EventKind::Warning { text }, None);
                }
                FromProcess::Unwritable(fault) => {
                    let host = member.plan.host.clone();
                    self.unwritten.get_or_insert((host, fault.clone()));
                    let kind = EventKind::Unrecorded { fault };
                    let gap = self.interruption(index);
                    self.note(now, index, kind, Some(gap));
                }
                FromProcess::Finished(report) => member.report = Some(*report),
                FromProcess::Failed(Failure { kind, text }) => {
                    let text = shortened(&text, TEXT_CHARS_MAX);
                    member.complaint = Some(Failure { kind, text });
                }
            }
        }
    }

    /// The process is back: whatever interruption of it is still open ends here.
    fn close_interruptions(&mut self, index: usize, now: Instant) {
        let name = &self.members[index].plan.name;
        for event in self
            .events
            .iter_mut()
            .filter(|event| event.process == *name)
        {
            if let Some(gap) = &mut event.interruption {
                gap.until.get_or_insert(now);
            }
        }
    }

    pub(super) fn note(
        &mut self,
        at: Instant,
        index: usize,
        kind: EventKind,
        interruption: Option<Interruption>,
    ) {
        let plan = &self.members[index].plan;
        self.events.push(Event {
            at,
            host: plan.host.clone(),
            process: plan.name.clone(),
            kind,
            interruption,
        });
    }

    /// Notes what happened to `host` as a whole.
    pub(super) fn note_of_host(&mut self, at: Instant, host: &str, kind: EventKind) {
        let is_full = self.host_event_count >= HOST_EVENTS_MAX;
        let mut own = self.events.iter_mut().rev();
        let last = own.find(|event| event.process == host);
        if is_full && let Some(EventKind::WarningsLeftOut { count }) = last.map(|one| &mut one.kind)
        {
            *count += 1;
            return;
        }
        self.host_event_count += 1;
        self.events.push(Event {
            at,
            host: host.to_owned(),
            process: host.to_owned(),
            kind: if is_full {
                EventKind::WarningsLeftOut { count: 1 }
            } else {
                kind
            },
            interruption: None,
        });
    }

    /// Stops the processes that `choose` picks and waits for them up to `patience`; who does not
    /// end by then is killed, which is noted.
    pub(crate) fn stop(&mut self, patience: Duration, choose: impl Fn(&ProcessPlan) -> bool) {
        let chosen: Vec<usize> = (0..self.members.len())
            .filter(|index| choose(&self.members[*index].plan))
            .collect();
        for index in &chosen {
            let member = &mut self.members[*index];
            if let Some(child) = &mut member.child {
                child.order(&ToProcess::Stop);
            }
        }
        let deadline = std::time::Instant::now() + patience;
        for index in chosen {
            let Some(mut child) = self.members[index].child.take() else {
                continue;
            };
            let ended_by_itself = child.end(deadline);
            let said_all_by = std::time::Instant::now() + LAST_WORDS_PATIENCE;
            while !child.has_said_all() && std::time::Instant::now() < said_all_by {
                self.listen();
                std::thread::sleep(Duration::from_millis(1));
            }
            self.listen();
            let end = match child.poll_end() {
                // What a program of the user's does when it is told to stop.
                Some(end) if end.signal() == Some(libc::SIGTERM) => "stopped".to_owned(),
                Some(end) => self.end_words(index, end),
                None => "ended".to_owned(),
            };
            if !ended_by_itself {
                let patience_s = patience.as_secs();
                let kind = EventKind::Killed { patience_s };
                self.note(MonotonicClock::now(), index, kind, None);
            }
            self.members[index].end = Some(end);
        }
        self.listen();
    }

    /// Takes the middle out of each long log, once nothing is written to it any more, and tells of the
    /// warnings that are left out.
    pub(crate) fn cut_logs(&mut self) {
        for index in 0..self.members.len() {
            let count = self.members[index].left_out_count;
            if count > 0 {
                let kind = EventKind::WarningsLeftOut { count };
                self.note(MonotonicClock::now(), index, kind, None);
            }
        }
        if let Some(keeper) = self.log_keeper.take() {
            keeper.finish();
        }
        for index in 0..self.members.len() {
            let kind = match cut_middle(&self.folder.log(&self.members[index].plan.name)) {
                Ok(0) => continue,
                Ok(left_out_bytes) => EventKind::OutputCut { left_out_bytes },
                // It was never started.
                Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
                Err(error) => EventKind::Warning {
                    text: format!("its log cannot be shortened: {error}"),
                },
            };
            self.note(MonotonicClock::now(), index, kind, None);
        }
    }

    /// Names of the processes.
    pub(crate) fn names(&self) -> Vec<String> {
        let members = self.members.iter();
        members.map(|member| member.plan.name.clone()).collect()
    }

    /// The processes with their history.
    pub(crate) fn members(&self) -> &[ManagedProcess] {
        &self.members
    }

    /// What happened, in order.
    pub(crate) fn events(&self) -> &[Event] {
        &self.events
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::process::ExitStatusExt;
    use std::path::Path;
    use std::process::ExitStatus;

    use hil_platform::realtime::SchedulingPolicy;
    use hil_topology::RoleSpec;

    use super::*;
    use crate::process::own_program::ProgramRealtime;

    /// A group of one program of the user's, whose run folder is not there.
    fn group(on_exit: OnExit) -> ProcessGroup {
        let card = RoleSpec {
            process: "own".to_owned(),
            case: None,
            role: None,
            seed: 1,
            inputs: Vec::new(),
            outputs: Vec::new(),
            parameters: toml::Table::new(),
        };
        let plan = ProcessPlan {
            name: "own".to_owned(),
            host: "pc".to_owned(),
            task: ProcessTask::Foreign {
                card,
                command: vec!["own".to_owned()],
                environment: BTreeMap::new(),
                realtime: ProgramRealtime {
                    cpus: Vec::new(),
                    policy: SchedulingPolicy::Other,
                    timer_slack: None,
                },
            },
            on_exit,
        };
        let places = BTreeMap::from([("pc".to_owned(), String::new())]);
        let folder = RunFolder::existing(Path::new("/proc/no-run"));
        ProcessGroup::new(vec![plan], places, &folder, None)
    }

    #[test]
    fn a_start_that_needs_a_file_that_cannot_be_written_is_told_with_it() {
        let check = |outcome: Outcome| {
            let Outcome::Unwritable { host, fault } = outcome else {
                panic!("{outcome:?}");
            };
            assert_eq!(host, "pc");
            assert!(fault.path.starts_with("/proc/no-run"), "{fault}");
        };
        check(group(OnExit::EndRun).start().unwrap_err());
        let mut group = group(OnExit::Restart { limit: 1 });
        group.started = Some(MonotonicClock::now());
        let ended = ProcessEnd::Exited(ExitStatus::from_raw(0));
        check(group.judge(0, ended, MonotonicClock::now()).unwrap());
    }

    #[test]
    fn a_failure_keeps_the_kind_that_its_process_gave_it() {
        let mut group = group(OnExit::EndRun);
        let failed = ProcessEnd::Exited(ExitStatus::from_raw(1 << 8));
        for kind in [FailureKind::NotThereYet, FailureKind::HostTooSmall] {
            let text = "cannot go on".to_owned();
            group.members[0].complaint = Some(Failure { kind, text });
            let outcome = group.judge(0, failed, MonotonicClock::now());
            let Some(Outcome::Failed(failure)) = outcome else {
                panic!("{outcome:?}");
            };
            assert_eq!(failure.kind, kind);
            let said = ": cannot go on; its output is in /proc/no-run/logs/own.log";
            assert!(failure.text.ends_with(said), "{}", failure.text);
        }
        group.members[0].complaint = None;
        let outcome = group.judge(0, failed, MonotonicClock::now());
        assert!(
            matches!(outcome, Some(Outcome::Failed(failure)) if failure.kind == FailureKind::Fault)
        );
    }

    #[test]
    fn a_program_that_ended_may_be_started_again_and_a_process_that_cannot_go_on_may_not() {
        let failed = ProcessEnd::Exited(ExitStatus::from_raw(1 << 8));
        for (kind, expected) in [(FailureKind::ProgramEnded, 1), (FailureKind::Fault, 0)] {
            let mut group = group(OnExit::Restart { limit: 1 });
            group.started = Some(MonotonicClock::now());
            let text = "first ended with exit code 3".to_owned();
            group.members[0].complaint = Some(Failure { kind, text });
            // It cannot: its folder cannot be written.
            let outcome = group.judge(0, failed, MonotonicClock::now());
            assert!(outcome.is_some());
            assert_eq!(group.members[0].restart_count, expected);
        }
    }

    #[test]
    fn a_process_that_ended_is_judged_though_another_keeps_its_output() {
        let folder = std::env::temp_dir().join(format!("hil-output-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let id_file = folder.join("id");
        // The other one is in a session of its own, so that it is not ended with the group.
        let script = "setsid sh -c 'echo $$ > \"$0\"; exec sleep 600' \"$0\" & \
                      until [ -s \"$0\" ]; do sleep 0.01; done; exit 3";
        let mut command = std::process::Command::new("sh");
        command.args(["-c", script]).arg(&id_file);
        let mut group = group(OnExit::EndRun);
        let (log, words) = (folder.join("log"), group.sender.clone());
        let child = Child::spawn_speaking(command, &log, 0, 0, words).unwrap();
        group.members[0].child = Some(child);
        let outcome = loop {
            if let Some(outcome) = group.watch() {
                break outcome;
            }
            std::thread::sleep(Duration::from_millis(10));
        };
        let id = std::fs::read_to_string(&id_file).unwrap();
        let id = nix::unistd::Pid::from_raw(id.trim().parse().unwrap());
        nix::sys::signal::kill(id, nix::sys::signal::Signal::SIGKILL).expect("it still runs");
        let Outcome::Failed(failure) = outcome else {
            panic!("{outcome:?}");
        };
        assert!(failure.text.contains("exit code 3"), "{}", failure.text);
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn events_of_a_host_are_kept_beside_warnings_of_processes_and_bounded() {
        let mut group = group(OnExit::EndRun);
        group.warning_count = WARNINGS_MAX;
        let told = |cause: usize| EventKind::Reconnected {
            peer: "robot-pc".to_owned(),
            away_ms: 1,
            cause: cause.to_string(),
        };
        for cause in 0..HOST_EVENTS_MAX + 3 {
            group.note_of_host(MonotonicClock::now(), "pc", told(cause));
        }
        let kinds: Vec<&EventKind> = group.events().iter().map(|event| &event.kind).collect();
        assert_eq!(kinds.len(), HOST_EVENTS_MAX + 1);
        assert_eq!(*kinds[0], told(0));
        assert_eq!(
            *kinds[HOST_EVENTS_MAX],
            EventKind::WarningsLeftOut { count: 3 }
        );
    }

    #[test]
    fn counts_that_are_not_told_again_stay_as_they_were() {
        let told = |counts: &[(&str, u64)]| -> Vec<ChannelProgress> {
            let one = |&(channel, count): &(&str, u64)| ChannelProgress {
                channel: channel.to_owned(),
                what: "sent".to_owned(),
                count,
            };
            counts.iter().map(one).collect()
        };
        let mut known = Vec::new();
        merge(&mut known, told(&[("a", 1), ("b", 2), ("c", 3)]));
        merge(&mut known, told(&[("b", 5)]));
        merge(&mut known, told(&[("a", 4), ("c", 6)]));
        assert_eq!(known, told(&[("a", 4), ("b", 5), ("c", 6)]));
        // Started again, it counts from the beginning.
        merge(&mut known, told(&[("a", 0), ("b", 0), ("c", 0), ("d", 1)]));
        assert_eq!(known, told(&[("a", 0), ("b", 0), ("c", 0), ("d", 1)]));
    }
}
