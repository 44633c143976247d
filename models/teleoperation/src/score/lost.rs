//! The events of a run for the report: lost loops with their causes, holds, and what the robot's
//! sessions told. It names the commands concerned; what the network did to them it does not know.

use crate::EGM_RIGHT_FEEDBACK;
use crate::score::Run;
use crate::score::loops::{Loops, LossCause, Span, within};
use crate::score::sessions::{events, is_right};
use hil_arm::egm::messages::{EgmEvent, EgmEventKind, EndCause};
use hil_core::run_log::RunLog;
use hil_core::score::{EVENTS_MAX, LeftOut, Score, ScoreEvent, Severity};
use hil_core::time::Instant;

/// Adds all events in order of time.
pub(crate) fn add_events(score: &mut Score, run: &Run, loops: Option<&Loops>, log: &RunLog) {
    let mut found: Vec<ScoreEvent> = loops
        .into_iter()
        .flat_map(|loops| {
            loops
                .lost
                .iter()
                .map(|lost| run.lost_loop(loops, lost.index, lost.due_ns))
        })
        .collect();
    found.extend(run.holds());
    found.extend(events(log).map(|event| run.session_event(&event)));
    found.sort_by_key(|event| event.at);
    // A full score drops the least grave, which costs a search each time: a flood of notices is
    // cut off before it gets there.
    let mut notices = 0;
    for event in found {
        notices += usize::from(event.severity == Severity::Notice);
        if event.severity == Severity::Notice && notices > EVENTS_MAX {
            score.left_out.push(LeftOut::from(&event));
        } else {
            score.add_event(event);
        }
    }
}

fn event(severity: Severity, at_ns: i64, what: String) -> ScoreEvent {
    ScoreEvent::new(severity, Instant::from_ns(at_ns), EGM_RIGHT_FEEDBACK, what)
}

impl Run {
    /// The event with the commands that were under way in `span`, which the robot had none in.
    fn naming(&self, event: ScoreEvent, span: Span) -> ScoreEvent {
        let commands = self.record.commands_between(span.begin_ns, span.end_ns);
        let messages = commands.iter().map(|command| command.message);
        messages.fold(event, ScoreEvent::naming)
    }

    fn lost_loop(&self, loops: &Loops, index: usize, due_ns: i64) -> ScoreEvent {
        let (evidence, period_ns) = (&self.sessions.evidence, self.counter.period_ns);
        let cause = evidence.cause_of(due_ns, period_ns);
        let window = Span::around(due_ns, period_ns);
        let mut what = format!(
            "motion loop {} of {} lost: {}",
            index + 1,
            loops.sent_count(),
            cause.text(self.origin_ns()),
        );
        let needed_m = self.counter.prominence_m;
        // More than that and still no peak of its own: the distance explains nothing.
        if let Some(moved_m) = self.moved_m(window).filter(|moved_m| *moved_m < needed_m) {
            let said = format!("; the tool moved {moved_m:.3} m in it, {needed_m:.3} m are needed");
            what.push_str(&said);
        }
        let named = event(Severity::Incident, due_ns, what);
        let silence = match cause {
            LossCause::Trip(pause) => Some(self.silence_before(pause.span)),
            LossCause::Held => within(&evidence.holds, window, |span| *span)
                .first()
                .copied(),
            LossCause::Unseen | LossCause::Clipped | LossCause::Throttled | LossCause::Merged => {
                None
            }
        };
        match silence {
            Some(span) => self.naming(named, span),
            None => named,
        }
    }

    /// The first feedback: where the times of texts begin.
    pub(crate) fn origin_ns(&self) -> i64 {
        self.record.feedback.first().map_or(0, |first| first.at_ns)
    }

    /// The pause with the hold that led to it.
    fn silence_before(&self, pause: Span) -> Span {
        let holds = &self.sessions.evidence.holds;
        let next = holds.partition_point(|hold| hold.begin_ns < pause.begin_ns);
        let before = next.checked_sub(1).map(|index| holds[index]);
        match before.filter(|hold| hold.end_ns >= pause.begin_ns) {
            Some(hold) => Span {
                begin_ns: hold.begin_ns,
                ..pause
            },
            None => pause,
        }
    }

    /// Highest minus lowest measured y; `None` without a measurement.
    fn moved_m(&self, window: Span) -> Option<f64> {
        let begin = self
            .moved
            .partition_point(|sample| sample.0 < window.begin_ns);
        let end = self
            .moved
            .partition_point(|sample| sample.0 < window.end_ns);
        let values = self.moved[begin..end].iter().map(|sample| sample.1);
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
            (low.min(value), high.max(value))
        });
        (high >= low).then_some(high - low)
    }

    fn holds(&self) -> Vec<ScoreEvent> {
        let holds = self.sessions.evidence.holds.iter();
        holds
            .map(|hold| {
                let held_s = (hold.end_ns - hold.begin_ns) as f64 * 1e-9;
                let what = format!("right arm held for {held_s:.3} s for want of commands");
                self.naming(event(Severity::Hazard, hold.begin_ns, what), *hold)
            })
            .collect()
    }

    fn session_event(&self, told: &EgmEvent) -> ScoreEvent {
        let named = event(severity_of(told), told.at_ns, told.describe());
        let is_timeout = told.kind == EgmEventKind::Ended as u32
            && EndCause::from_number(told.cause) == Some(EndCause::CommTimeout);
        if !is_timeout || !is_right(told) {
            return named;
        }
        let pause = Span {
            begin_ns: told.at_ns,
            end_ns: told.at_ns,
        };
        self.naming(named, self.silence_before(pause))
    }
}

/// A session that ends by itself, a command that never reaches the servo and a speed limit that
/// binds keep the robot from what it was told; the rest is worth knowing.
pub(super) fn severity_of(told: &EgmEvent) -> Severity {
    let is = |kind: EgmEventKind| told.kind == kind as u32;
    let ended_by_itself =
        is(EgmEventKind::Ended) && EndCause::from_number(told.cause) != Some(EndCause::Requested);
    if ended_by_itself
        || is(EgmEventKind::SpeedThrottled)
        || is(EgmEventKind::CommandRefused)
        || is(EgmEventKind::QueueOverflow)
    {
        Severity::Hazard
    } else {
        Severity::Notice
    }
}
