//! How the recorder stands against what it looks at: it gives way to everything where nothing is lost
//! by that, and stops giving way when it can no longer keep up. All threads of the process stand
//! alike, for what one of them is waited for all are late.

use std::fmt;
use std::fs;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use clap::ValueEnum;
use hil_runtime::realtime::{
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
pub(crate) struct Precedence(Arc<Mutex<State>>);

impl Precedence {
    /// As the command line asks; nothing is changed yet.
    pub(crate) fn new(priority: Priority) -> Self {
        let state = match priority {
            Priority::Idle => State::Asked,
            Priority::Normal => State::Normal,
        };
        Self(Arc::new(Mutex::new(state)))
    }

    /// Takes its place for a run that is read from files only, which wait for as long as it takes, or
    /// also from shared memory, which does not wait.
    pub(crate) fn settle(&self, reads_memory: bool) {
        let mut state = self.lock();
        match *state {
            State::Asked | State::ReadsMemory if !reads_memory => *state = give_way(),
            State::Asked => *state = State::ReadsMemory,
            State::GivesWay if reads_memory => {
                *state = match outcome(&move_threads(
                    SchedulingPolicy::Idle,
                    SchedulingPolicy::Other,
                )) {
                    Ok(()) => State::ReadsMemory,
                    Err(refusal) => State::Refused(Duration::ZERO, refusal),
                };
            }
            _ => {}
        }
    }

    /// Gives way no longer: it was kept waiting for so long.
    fn raise(&self, waited: Duration) {
        let mut state = self.lock();
        if *state != State::GivesWay {
            return;
        }
        let moved = move_threads(SchedulingPolicy::Idle, SchedulingPolicy::Other);
        *state = match outcome(&moved) {
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
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
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
    let come_back = || {
        if waited().is_none() {
            return Err("/proc/thread-self/schedstat does not tell how long it waits".to_owned());
        }
        own(SchedulingPolicy::Idle)?;
        own(SchedulingPolicy::Other)
    };
    // A thread that may not come back takes that with it.
    let tried = thread::spawn(come_back).join();
    let tried = tried.unwrap_or_else(|_panic| Err("its trial failed".to_owned()));
    let moved = tried.and_then(|()| {
        outcome(&move_threads(
            SchedulingPolicy::Other,
            SchedulingPolicy::Idle,
        ))
    });
    moved.map_or_else(State::CannotGiveWay, |()| State::GivesWay)
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

/// The looks of one thread, each judged by how long it was kept waiting for a processor. Use it in
/// the thread that looks.
#[derive(Debug)]
pub(crate) struct Looks {
    late_max: Duration,
    /// So far.
    waited: Duration,
}

impl Looks {
    /// Between two looks it may wait for `late_max`.
    pub(crate) fn new(late_max: Duration) -> Self {
        Self {
            late_max,
            waited: waited().unwrap_or_default(),
        }
    }

    /// Judges the time since the look before: nothing but a lack of processor time counts, neither
    /// a slow disk nor a stopped terminal.
    pub(crate) fn judge(&mut self, precedence: &Precedence) {
        self.judge_by(waited().unwrap_or(self.waited), precedence);
    }

    fn judge_by(&mut self, waited: Duration, precedence: &Precedence) {
        let late = waited.saturating_sub(self.waited);
        self.waited = waited;
        if late > self.late_max {
            precedence.raise(late);
        }
    }
}

/// How long the calling thread could have run and had no processor, since it began; `None` where the
/// kernel does not count it.
fn waited() -> Option<Duration> {
    let text = fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    waited_in(&text)
}

/// The second number of `schedstat`: time spent waiting on a run queue, nanoseconds.
fn waited_in(schedstat: &str) -> Option<Duration> {
    let number = schedstat.split_whitespace().nth(1)?;
    number.parse().ok().map(Duration::from_nanos)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::channel;

    fn of(state: State) -> Precedence {
        Precedence(Arc::new(Mutex::new(state)))
    }

    /// The policy of the calling thread, field 41 of its `stat`.
    fn policy() -> u32 {
        let text = fs::read_to_string("/proc/thread-self/stat").unwrap();
        let (_, after_name) = text.rsplit_once(')').unwrap();
        let field = after_name.split_whitespace().nth(38).unwrap();
        field.parse().unwrap()
    }

    #[test]
    fn the_kernel_tells_how_long_a_thread_waited() {
        assert_eq!(waited_in("123 4567 89\n"), Some(Duration::from_nanos(4567)));
        assert_eq!(waited_in("123"), None);
        assert!(waited().is_some());
    }

    /// No other test of this program gives way, so no other is moved.
    #[test]
    fn every_thread_gives_way_until_one_is_too_late() {
        let judged = thread::spawn(|| {
            own(SchedulingPolicy::Idle).unwrap();
            let (go, wait) = channel::<()>();
            let child = thread::spawn(move || {
                let _is_told = wait.recv().is_ok();
                policy()
            });
            let precedence = of(State::GivesWay);
            let late_max = Duration::from_millis(250);
            let mut looks = Looks {
                late_max,
                waited: Duration::from_secs(7),
            };
            let look_after = |more_ms: u64| Duration::from_millis(7000 + more_ms);
            looks.judge_by(look_after(250), &precedence);
            assert_eq!(
                (precedence.to_string().as_str(), policy()),
                ("SCHED_IDLE", 5)
            );
            assert_eq!(precedence.warning(), None);
            looks.judge_by(look_after(501), &precedence);
            let state = precedence.lock().clone();
            drop(go);
            let policies = [policy(), child.join().unwrap()];
            (state, policies, precedence.warning())
        });
        let (state, policies, warning) = judged.join().unwrap();
        let late = Duration::from_millis(251);
        match state {
            State::Raised(waited) => assert_eq!((waited, policies), (late, [0, 0])),
            // Without the right to it.
            State::Refused(waited, words) => {
                assert_eq!(waited, late);
                assert!(words.contains("RLIMIT_NICE"), "{words}");
            }
            other => panic!("{other:?}"),
        }
        assert!(warning.is_some_and(|words| words.contains("for 251 ms")));
    }

    #[test]
    fn it_stays_where_memory_does_not_wait_and_where_it_was_told_to() {
        let asked = Precedence::new(Priority::Idle);
        asked.settle(true);
        assert_eq!(
            asked.to_string(),
            "SCHED_OTHER; shared memory does not wait for it"
        );
        let normal = Precedence::new(Priority::Normal);
        normal.settle(false);
        for precedence in [asked, normal] {
            let mut looks = Looks::new(Duration::ZERO);
            looks.judge_by(Duration::MAX, &precedence);
            assert_eq!(precedence.warning(), None);
            assert!(precedence.to_string().starts_with("SCHED_OTHER"));
        }
        let cannot = of(State::CannotGiveWay("EPERM".to_owned()));
        cannot.settle(false);
        assert_eq!(cannot.to_string(), "SCHED_OTHER; EPERM");
        assert!(cannot.warning().is_some());
    }
}
