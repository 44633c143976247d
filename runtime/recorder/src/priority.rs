//! How the recorder stands against what it looks at: it gives way to everything where nothing is lost
//! by that, and stops giving way when it can no longer keep up. All threads of the process stand
//! alike, for what one of them is waited for all are late; but for the one that sees to it, [`watcher`].

mod watcher;

pub(crate) use watcher::Looks;

use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use clap::ValueEnum;
use hil_runtime::platform::realtime::{
    GrantOutcome, RealtimeGrantItem, RealtimeRequest, SchedulingPolicy, apply, move_threads,
};

/// What is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Priority {
    /// Only when nothing else wants the processor, where that loses nothing; normal when it cannot
    /// keep up so.
    Idle,
    /// As any other program.
    Normal,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum State {
    /// As asked for.
    Normal,
    /// It is asked to give way and has not yet.
    Asked,
    /// What it reads would not wait for it.
    ReadsMemory,
    GivesWay,
    /// It was kept waiting for so long.
    Raised(Duration),
    /// The same, and the kernel refused, for this reason.
    Refused(Duration, String),
    CannotGiveWay(String),
}

/// How all threads of this process stand.
#[derive(Debug, Clone)]
pub(crate) struct Precedence(Arc<Standing>);

#[derive(Debug)]
struct Standing {
    state: Mutex<State>,
    /// Beside the state, whose lock a thread that gets no processor may hold.
    gives_way: AtomicBool,
}

impl Precedence {
    /// As the command line asks; nothing is changed yet.
    pub(crate) fn new(priority: Priority) -> Self {
        let state = match priority {
            Priority::Idle => State::Asked,
            Priority::Normal => State::Normal,
        };
        Self::of(state)
    }

    fn of(state: State) -> Self {
        let gives_way = AtomicBool::new(state == State::GivesWay);
        Self(Arc::new(Standing {
            state: Mutex::new(state),
            gives_way,
        }))
    }

    /// True when it may come to give way, so that somebody has to watch over it.
    fn may_give_way(&self) -> bool {
        matches!(
            *self.lock(),
            State::Asked | State::ReadsMemory | State::GivesWay
        )
    }

    fn gives_way(&self) -> bool {
        self.0.gives_way.load(Ordering::Relaxed)
    }

    /// Takes its place for a run of which nothing is lost by looking late, since all `waits` in files or
    /// comes again, or something would be.
    pub(crate) fn settle(&self, waits: bool) {
        let mut state = self.lock();
        match *state {
            State::Asked | State::ReadsMemory if waits => {
                *state = give_way();
                let gives_way = *state == State::GivesWay;
                self.0.gives_way.store(gives_way, Ordering::Relaxed);
            }
            State::Asked => *state = State::ReadsMemory,
            State::GivesWay if !waits && self.0.gives_way.swap(false, Ordering::Relaxed) => {
                *state = match come_back() {
                    Ok(()) => State::ReadsMemory,
                    Err(refusal) => State::Refused(Duration::ZERO, refusal),
                };
            }
            _ => {}
        }
    }

    /// Gives way no longer: it was kept waiting for so long.
    fn raise(&self, waited: Duration) {
        if !self.0.gives_way.swap(false, Ordering::Relaxed) {
            return;
        }
        // Before the lock: who holds it may be waiting for a processor.
        let came = come_back();
        *self.lock() = match came {
            Ok(()) => State::Raised(waited),
            Err(refusal) => State::Refused(waited, refusal),
        };
    }

    /// What a user must know of it.
    pub(crate) fn warning(&self) -> Option<String> {
        match &*self.lock() {
            State::Raised(waited) => Some(format!(
                "the recorder gave way to all else until others left it no processor time for {} ms; \
                 from then on it ran like any other program, and the run may have felt it",
                waited.as_millis()
            )),
            State::Refused(waited, refusal) => Some(format!(
                "the recorder gave way to all else, which left it no processor time for {} ms, and \
                 was not let up: {refusal}; or use --priority normal",
                waited.as_millis()
            )),
            State::CannotGiveWay(refusal) => Some(format!(
                "the recorder does not give way, so the run may feel it: {refusal}; with --priority \
                 normal this is not said"
            )),
            State::Normal | State::Asked | State::ReadsMemory | State::GivesWay => None,
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl fmt::Display for Precedence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &*self.lock() {
            State::Normal | State::Asked => f.write_str("SCHED_OTHER"),
            State::ReadsMemory => f.write_str("SCHED_OTHER; shared memory does not wait for it"),
            State::GivesWay => f.write_str("SCHED_IDLE"),
            State::Raised(waited) => write!(
                f,
                "SCHED_IDLE until it had no processor time for {} ms, then SCHED_OTHER",
                waited.as_millis()
            ),
            State::Refused(waited, refusal) => write!(
                f,
                "SCHED_IDLE; it had no processor time for {} ms; {refusal}",
                waited.as_millis()
            ),
            State::CannotGiveWay(refusal) => write!(f, "SCHED_OTHER; {refusal}"),
        }
    }
}

/// Who gives way without the right to come back would stay there, however late it became.
fn give_way() -> State {
    let there_and_back = || {
        if !watcher::can_tell() {
            return Err("/proc/thread-self/schedstat does not tell how long it waits".to_owned());
        }
        own(SchedulingPolicy::Idle)?;
        own(SchedulingPolicy::Other)
    };
    // A thread that may not come back takes that with it.
    let tried = thread::spawn(there_and_back).join();
    let tried = tried.unwrap_or_else(|_panic| Err("its trial failed".to_owned()));
    let moved = tried.and_then(|()| {
        outcome(&move_threads(
            SchedulingPolicy::Other,
            SchedulingPolicy::Idle,
        ))
    });
    moved.map_or_else(State::CannotGiveWay, |()| State::GivesWay)
}

/// Takes all threads that gave way back among the others.
fn come_back() -> Result<(), String> {
    outcome(&move_threads(
        SchedulingPolicy::Idle,
        SchedulingPolicy::Other,
    ))
}

/// Schedules the calling thread.
fn own(policy: SchedulingPolicy) -> Result<(), String> {
    let request = RealtimeRequest {
        policy,
        ..RealtimeRequest::default()
    };
    apply(&request).items.iter().try_for_each(outcome)
}

fn outcome(item: &RealtimeGrantItem) -> Result<(), String> {
    match &item.outcome {
        GrantOutcome::Granted => Ok(()),
        GrantOutcome::Refused { error, reason, fix } => Err(format!("{error}; {reason}; {fix}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_stays_where_memory_does_not_wait_and_where_it_was_told_to() {
        let asked = Precedence::new(Priority::Idle);
        asked.settle(false);
        assert_eq!(
            asked.to_string(),
            "SCHED_OTHER; shared memory does not wait for it"
        );
        let normal = Precedence::new(Priority::Normal);
        normal.settle(true);
        for precedence in [asked, normal] {
            precedence.raise(Duration::MAX);
            assert_eq!(precedence.warning(), None);
            assert!(precedence.to_string().starts_with("SCHED_OTHER"));
        }
        let cannot = Precedence::of(State::CannotGiveWay("EPERM".to_owned()));
        cannot.settle(true);
        assert_eq!(cannot.to_string(), "SCHED_OTHER; EPERM");
        assert!(cannot.warning().is_some());
    }
}
