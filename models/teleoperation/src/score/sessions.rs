//! Sessions, holds and trips of the right arm, from its feedback and the robot's events. Times are
//! of the robot's clock.

use crate::EGM_EVENT;
use crate::score::loops::{Evidence, Pause, PauseAfter, Span};
use crate::score::record::{Feedback, Record};
use hil_arm::egm::messages::{EgmEvent, EgmEventKind, EgmFeedback, EndCause, SessionState, Side};
use hil_core::run_log::RunLog;
use hil_core::score::{Harm, Metric};
use hil_stats::metric::label;

/// For how long after a resume the arm catches up, nanoseconds.
const CATCH_UP_NS: i64 = 500_000_000;

/// Feedback comes every few milliseconds; a longer silence than this hides what the robot did.
const UNSEEN_NS: i64 = 100_000_000;

const NOT_TOLD: &str = "the robot recorded no events: a foreign one does not tell its holds";

/// What the sessions came to.
#[derive(Debug, Default)]
pub(crate) struct Sessions {
    pub(crate) evidence: Evidence,
    /// Ends of sessions by themselves, with a next session or without.
    pub(crate) trips: Vec<Trip>,
    /// Sessions that ran.
    pub(crate) count: u64,
    /// Feedback in running sessions.
    running_count: u64,
    /// Of these, those flagged as holding.
    holding_count: u64,
    /// Of these, those in which `MaxSpeedDeviation` bound.
    throttled_count: u64,
    /// Feedback within [`CATCH_UP_NS`] after a hold or a new session, and those limited in speed.
    catching_up_count: u64,
    saturated_count: u64,
    refused_count: Option<u64>,
}

/// A session that ended by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Trip {
    pub(crate) at_ns: i64,
    pub(crate) cause: Option<EndCause>,
    /// Until the next session ran.
    pub(crate) until_ns: Option<i64>,
}

impl Sessions {
    pub(crate) fn read(record: &Record, log: &RunLog) -> Self {
        let mut reading = Reading {
            ends: ends(log),
            ..Reading::default()
        };
        for feedback in &record.feedback {
            reading.add(feedback);
        }
        let mut sessions = reading.finish(record.feedback.last());
        sessions.evidence.clipped = clipped(record);
        // Without a single event there is no record of refusals to count.
        sessions.refused_count = (!log.raw(EGM_EVENT).is_empty()).then(|| refused(log));
        sessions
    }

    pub(crate) fn ended_by_themselves(&self, record: &Record) -> Harm {
        let is_known = !record.feedback.is_empty();
        Harm {
            note: "the arm takes commands only in one",
            ..Harm::new(
                "EGM sessions of the right arm lost",
                is_known.then_some(self.trips.len() as u64),
            )
        }
    }

    pub(crate) fn metrics(&self, record: &Record) -> Vec<Metric> {
        let all = record.feedback.len();
        let tells_holds = all > 0 && self.refused_count.is_some();
        let not_told = if all > 0 {
            NOT_TOLD
        } else {
            "nothing was recorded"
        };
        let mut metrics = vec![
            label("egm_session_count", "guided-motion sessions", "1").count(
                (all > 0).then_some(self.count),
                "times the right arm's session began to run",
            ),
            label("egm_trip_count", "sessions that ended by themselves", "1").count(
                (all > 0).then_some(self.trips.len() as u64),
                "ends by CommTimeout, CondTime, MaxPosDeviation or for a reason not recorded",
            ),
        ];
        let or_not_told = |missing| if tells_holds { missing } else { not_told };
        metrics.extend(self.reactivation());
        metrics.extend([
            label("hold_count", "holds for want of commands", "1").measured(
                tells_holds.then_some(self.evidence.holds.len() as f64),
                "rows of feedback flagged as holding",
                not_told,
            ),
            label("hold_time_ratio", "share of time held", "1").measured(
                (tells_holds && self.running_count > 0)
                    .then(|| self.holding_count as f64 / self.running_count as f64),
                format!(
                    "feedback flagged as holding, of {} in running sessions",
                    self.running_count
                ),
                or_not_told("no feedback of a running session"),
            ),
            label("throttled_time_ratio", "share of time throttled", "1").measured(
                (self.running_count > 0)
                    .then(|| self.throttled_count as f64 / self.running_count as f64),
                format!(
                    "feedback with MaxSpeedDeviation binding, of {} in running sessions",
                    self.running_count
                ),
                "no feedback of a running session",
            ),
            label(
                "resume_saturation_ratio",
                "speed-limited share of the time after a resume",
                "1",
            )
            .measured(
                (tells_holds && self.catching_up_count > 0)
                    .then(|| self.saturated_count as f64 / self.catching_up_count as f64),
                format!(
                    "feedback with a joint's speed or MaxSpeedDeviation binding, of {} within \
                     0.5 s after a hold or a new session",
                    self.catching_up_count
                ),
                or_not_told("no hold ended and no session followed another"),
            ),
            label("commands_refused_count", "commands refused", "1").count(
                self.refused_count,
                "rows of commands refused one after the other for one reason count once",
            ),
        ]);
        metrics
    }

    fn reactivation(&self) -> [Metric; 2] {
        let lengths = self.trips.iter();
        let mut lengths: Vec<i64> = lengths
            .filter_map(|trip| Some(trip.until_ns? - trip.at_ns))
            .collect();
        lengths.sort_unstable();
        let seconds = |length: Option<&i64>| length.map(|length| *length as f64 * 1e-9);
        let missing = "no session ended by itself and was followed by another";
        let method = format!(
            "from the end of a session to the next one, {} times",
            lengths.len()
        );
        [
            label("reactivation_s_median", "time to re-activate, median", "s").measured(
                seconds(lengths.get(lengths.len() / 2)),
                method.clone(),
                missing,
            ),
            label("reactivation_s_max", "time to re-activate, longest", "s").measured(
                seconds(lengths.last()),
                method,
                missing,
            ),
        ]
    }
}

/// The way through the feedback.
#[derive(Debug, Default)]
struct Reading {
    /// Ends of the right arm's sessions as told: session, cause.
    ends: Vec<(u32, Option<EndCause>)>,
    sessions: Sessions,
    /// The session that runs, and when it began to.
    running: Option<u32>,
    /// The session that ran last, and when it ended.
    ended: Option<(u32, i64)>,
    resumed_ns: Option<i64>,
    /// When the newest feedback came.
    heard_ns: Option<i64>,
}

impl Reading {
    fn add(&mut self, feedback: &Feedback) {
        let at_ns = feedback.at_ns;
        let heard_ns = self.heard_ns.replace(at_ns).unwrap_or(at_ns);
        let is_unseen = at_ns - heard_ns > UNSEEN_NS;
        if is_unseen {
            self.sessions.evidence.unseen.push(Span {
                begin_ns: heard_ns,
                end_ns: at_ns,
            });
        }
        let session = feedback.is_running().then_some(feedback.session);
        if session != self.running {
            if let Some(before) = self.running {
                self.sessions.evidence.end_hold(at_ns);
                self.sessions.evidence.end_throttle(at_ns);
                // Behind a silence it is not known when the session ended: at its beginning, at
                // the earliest.
                self.ended = Some((before, if is_unseen { heard_ns } else { at_ns }));
            }
            if session.is_some() {
                self.begin(at_ns);
            }
            self.running = session;
        }
        let evidence = &mut self.sessions.evidence;
        if session.is_none() {
            // From the first feedback without a session on, when no session ran before it.
            if self.sessions.count == 0 {
                let unbegun = || (at_ns, before(feedback));
                evidence.pause_began.get_or_insert_with(unbegun);
            }
            return;
        }
        self.sessions.running_count += 1;
        if feedback.has(EgmFeedback::SPEED_DEVIATION_LIMITED) {
            self.sessions.throttled_count += 1;
            evidence.throttle_began_ns.get_or_insert(at_ns);
        } else {
            evidence.end_throttle(at_ns);
        }
        if feedback.has(EgmFeedback::HOLDING) {
            self.sessions.holding_count += 1;
            evidence.hold_began_ns.get_or_insert(at_ns);
        } else if evidence.hold_began_ns.is_some() {
            evidence.end_hold(at_ns);
            self.resumed_ns = Some(at_ns);
        }
        if self
            .resumed_ns
            .is_some_and(|resumed_ns| at_ns - resumed_ns < CATCH_UP_NS)
        {
            const LIMITED: u32 = EgmFeedback::SPEED_LIMITED | EgmFeedback::SPEED_DEVIATION_LIMITED;
            self.sessions.catching_up_count += 1;
            self.sessions.saturated_count += u64::from(feedback.has(LIMITED));
        }
    }

    fn begin(&mut self, at_ns: i64) {
        self.sessions.count += 1;
        self.sessions.evidence.end_pause(at_ns);
        if let Some((session, ended_ns)) = self.ended.take() {
            self.pause(session, ended_ns, Some(at_ns), at_ns);
            self.resumed_ns = Some(at_ns);
        }
    }

    fn pause(&mut self, session: u32, begin_ns: i64, until_ns: Option<i64>, end_ns: i64) {
        let known = self.ends.iter().rfind(|(known, _)| *known == session);
        let cause = known.and_then(|(_, cause)| *cause);
        let span = Span { begin_ns, end_ns };
        let after = PauseAfter::Session(cause);
        self.sessions.evidence.pauses.push(Pause { span, after });
        if cause != Some(EndCause::Requested) {
            self.sessions.trips.push(Trip {
                at_ns: begin_ns,
                cause,
                until_ns,
            });
        }
    }

    fn finish(mut self, last: Option<&Feedback>) -> Sessions {
        if let Some(last) = last {
            let evidence = &mut self.sessions.evidence;
            evidence.end_pause(last.at_ns);
            evidence.end_hold(last.at_ns);
            evidence.end_throttle(last.at_ns);
            if let Some((session, ended_ns)) = self.ended.take() {
                self.pause(session, ended_ns, None, last.at_ns);
            }
        }
        self.sessions
    }
}

/// What came before a log's first feedback without a session. A number counts from the session's
/// setting up on.
fn before(feedback: &Feedback) -> PauseAfter {
    let is_first = feedback.session == 1 && feedback.state == Some(SessionState::Activating);
    if feedback.session == 0 || is_first {
        PauseAfter::Start
    } else {
        PauseAfter::Session(None)
    }
}

/// The events of both arms, in order.
pub(crate) fn events(log: &RunLog) -> impl Iterator<Item = EgmEvent> + '_ {
    log.messages::<EgmEvent>(EGM_EVENT).map(|(_, event)| event)
}

/// True for an event of the right arm.
pub(crate) fn is_right(event: &EgmEvent) -> bool {
    event.side == Side::Right.number()
}

fn ends(log: &RunLog) -> Vec<(u32, Option<EndCause>)> {
    events(log)
        .filter(|event| is_right(event) && event.kind == EgmEventKind::Ended as u32)
        .map(|event| (event.session, EndCause::from_number(event.cause)))
        .collect()
}

fn refused(log: &RunLog) -> u64 {
    let is_refusal = |event: &EgmEvent| event.kind == EgmEventKind::CommandRefused as u32;
    events(log)
        .filter(|event| is_right(event) && is_refusal(event))
        .count() as u64
}

/// Rows of clipped commands.
fn clipped(record: &Record) -> Vec<Span> {
    let mut spans = Vec::new();
    let mut begin_ns = None;
    for command in &record.commands {
        if command.is_clipped() {
            begin_ns.get_or_insert(command.at_ns);
        } else {
            spans.extend(Span::ended(&mut begin_ns, command.at_ns));
        }
    }
    let last = record.commands.last();
    spans.extend(last.and_then(|last| Span::ended(&mut begin_ns, last.at_ns)));
    spans
}
