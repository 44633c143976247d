//! How the recorder stands against what it records: it gives way to everything, and stops giving way
//! when it can no longer keep up.

use std::fmt;
use std::time::{Duration, Instant};

use clap::ValueEnum;
use hil_runtime::realtime::{GrantOutcome, RealtimeItem, RealtimeRequest, SchedulingPolicy, apply};
use nix::time::{ClockId, clock_gettime};

/// A look that comes so much later than it should, beyond the processor time that was spent since
/// the one before, shows that others left the recorder nothing.
const LATE_MAX: Duration = Duration::from_secs(1);

/// What is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Priority {
    /// Only when nothing else wants the processor; normal when it cannot keep up so.
    Idle,
    /// As any other program.
    Normal,
}

/// Why the recorder no longer gives way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Reason {
    Late,
    Missed,
}

impl Reason {
    const fn words(self) -> &'static str {
        match self {
            Self::Late => "others left it no processor time for over a second",
            Self::Missed => "it missed messages",
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum State {
    Normal,
    GivesWay,
    Raised(Reason),
    /// The kernel refused, for this reason.
    Refused(Reason, String),
    CannotGiveWay(String),
}

/// The scheduling of the calling thread. Use it in the thread that made it.
#[derive(Debug)]
pub(crate) struct Precedence {
    state: State,
    looked: Instant,
    spent: Duration,
}

impl Precedence {
    /// Takes the place that is asked for.
    pub(crate) fn take(priority: Priority) -> Self {
        let state = match priority {
            Priority::Normal => State::Normal,
            Priority::Idle => match schedule(SchedulingPolicy::Idle) {
                Ok(()) => State::GivesWay,
                Err(refusal) => State::CannotGiveWay(refusal),
            },
        };
        Self {
            state,
            looked: Instant::now(),
            spent: processor_time(),
        }
    }

    /// Judges a look that was to come `planned` after the one before.
    pub(crate) fn judge_look(&mut self, planned: Duration) {
        if self.state != State::GivesWay {
            return;
        }
        let (now, spent) = (Instant::now(), processor_time());
        let due = planned + spent.saturating_sub(self.spent);
        let is_late = now.duration_since(self.looked) > due + LATE_MAX;
        (self.looked, self.spent) = (now, spent);
        if is_late {
            self.raise(Reason::Late);
        }
    }

    /// Judges how many messages were missed so far.
    pub(crate) fn judge_missed(&mut self, count: u64) {
        if self.state == State::GivesWay && count > 0 {
            self.raise(Reason::Missed);
        }
    }

    fn raise(&mut self, reason: Reason) {
        self.state = match schedule(SchedulingPolicy::Other) {
            Ok(()) => State::Raised(reason),
            Err(refusal) => State::Refused(reason, refusal),
        };
    }

    /// What a user must know of it.
    pub(crate) fn warning(&self) -> Option<String> {
        match &self.state {
            State::Raised(reason) => Some(format!(
                "the recorder gave way to all else until {}; from then on it ran like any other \
                 program, and the run may have felt it",
                reason.words()
            )),
            State::Refused(reason, refusal) => Some(format!(
                "the recorder gave way to all else, {}, and was not let up: {refusal}; or record \
                 with --priority normal",
                reason.words()
            )),
            State::CannotGiveWay(refusal) => Some(format!(
                "the recorder could not give way, so the run may have felt it: {refusal}"
            )),
            State::Normal | State::GivesWay => None,
        }
    }
}

impl fmt::Display for Precedence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.state {
            State::Normal => f.write_str("SCHED_OTHER"),
            State::GivesWay => f.write_str("SCHED_IDLE"),
            State::Raised(reason) => {
                write!(f, "SCHED_IDLE, then SCHED_OTHER: {}", reason.words())
            }
            State::Refused(reason, refusal) => {
                write!(f, "SCHED_IDLE; {}; {refusal}", reason.words())
            }
            State::CannotGiveWay(refusal) => write!(f, "SCHED_OTHER; {refusal}"),
        }
    }
}

fn schedule(policy: SchedulingPolicy) -> Result<(), String> {
    let request = RealtimeRequest {
        policy,
        ..RealtimeRequest::default()
    };
    let grant = apply(&request);
    let mut items = grant.items.iter();
    match items.find(|one| one.item == RealtimeItem::Scheduling) {
        Some(item) => match &item.outcome {
            GrantOutcome::Granted => Ok(()),
            GrantOutcome::Refused { error, reason, fix } => {
                Err(format!("{error}; {reason}; {fix}"))
            }
        },
        None => Err("the kernel was not asked".to_owned()),
    }
}

/// Processor time of the calling thread.
fn processor_time() -> Duration {
    clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).map_or(Duration::ZERO, Duration::from)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scheduling() -> i32 {
        let text = std::fs::read_to_string("/proc/thread-self/sched").unwrap_or_default();
        let line = text.lines().find(|line| line.starts_with("policy"));
        let value = line.and_then(|line| line.rsplit(':').next());
        value.and_then(|value| value.trim().parse().ok()).unwrap()
    }

    #[test]
    fn it_gives_way_until_it_is_too_late() {
        // Scheduling is of a thread; a test has one of its own.
        let mut precedence = Precedence::take(Priority::Idle);
        assert_eq!(
            (precedence.state.clone(), scheduling()),
            (State::GivesWay, 5)
        );
        precedence.judge_look(Duration::ZERO);
        precedence.judge_missed(0);
        assert_eq!(precedence.warning(), None);
        precedence.looked = Instant::now().checked_sub(LATE_MAX * 2).unwrap();
        precedence.judge_look(LATE_MAX * 3);
        assert_eq!(
            precedence.state,
            State::GivesWay,
            "it was to sleep for so long"
        );
        precedence.looked = Instant::now().checked_sub(LATE_MAX * 2).unwrap();
        precedence.judge_look(Duration::ZERO);
        match &precedence.state {
            State::Raised(Reason::Late) => assert_eq!(scheduling(), 0),
            // Without the right to it.
            State::Refused(Reason::Late, words) => {
                assert!(words.contains("RLIMIT_NICE"), "{words}");
            }
            other => panic!("{other:?}"),
        }
        assert!(
            precedence
                .warning()
                .is_some_and(|words| words.contains("over a second"))
        );
    }

    #[test]
    fn what_is_missed_raises_it_and_a_normal_one_stays() {
        let mut precedence = Precedence::take(Priority::Idle);
        precedence.judge_missed(3);
        assert_ne!(precedence.state, State::GivesWay);
        assert!(
            precedence.to_string().contains("missed messages"),
            "{precedence}"
        );
        std::thread::spawn(|| {
            let mut precedence = Precedence::take(Priority::Normal);
            precedence.judge_missed(3);
            assert_eq!(precedence.to_string(), "SCHED_OTHER");
            assert_eq!(scheduling(), 0);
        })
        .join()
        .unwrap();
    }
}
