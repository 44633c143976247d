//! Which processes of a run have fallen silent: each says a few times a second that all its loops
//! turn. What is noted here is in the report, and keeps the ticks of the watchdog back; nobody is
//! ended for it. A user's own program says nothing, so nothing is known of it.

use std::collections::BTreeSet;
use std::time::Duration;

use hil_core::time::Instant;

use super::plan::ProcessTask;
use super::process_group::{ManagedProcess, ProcessGroup};
use hil_rundir::event::EventKind;

/// A process that gets a processor now and then speaks within this time.
const SILENCE_MAX: Duration = Duration::from_secs(3);

/// Who is silent.
#[derive(Debug, Default)]
pub(super) struct SilentProcesses {
    silent: BTreeSet<usize>,
}

impl SilentProcesses {
    /// Looks at all processes at `now`; what changed is noted in the process group's events and given back in
    /// words.
    pub(super) fn look(&mut self, process_group: &mut ProcessGroup, now: Instant) -> Vec<String> {
        let mut words = Vec::new();
        for index in 0..process_group.members().len() {
            let member = &process_group.members()[index];
            let name = member.plan.name.clone();
            let silence = silence(member, now).filter(|_| process_group.started.is_some());
            let is_silent = silence.is_some_and(|silence| silence > SILENCE_MAX);
            let kind = match (is_silent, self.silent.contains(&index)) {
                (true, false) => {
                    self.silent.insert(index);
                    let limit_s = SILENCE_MAX.as_secs();
                    EventKind::Silent { limit_s }
                }
                (false, true) => {
                    self.silent.remove(&index);
                    if silence.is_none() {
                        continue;
                    }
                    EventKind::Responsive
                }
                _ => continue,
            };
            words.push(format!("{name}: {kind}"));
            process_group.note(now, index, kind, None);
        }
        words
    }

    /// True while no process is silent.
    pub(super) fn are_all_there(&self) -> bool {
        self.silent.is_empty()
    }
}

/// How long `member` has been silent; `None` of one that owes no sign of life.
fn silence(member: &ManagedProcess, now: Instant) -> Option<Duration> {
    let is_foreign = matches!(member.plan.task, ProcessTask::Foreign { .. });
    let owes = member.child.is_some() && member.is_ready && !is_foreign;
    owes.then(|| now.saturating_duration_since(member.heard))
}
