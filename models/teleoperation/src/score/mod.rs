//! What the robot made of the motion: motion loops and why they were lost, sessions, joint error,
//! lag, age. It reads the run log and nothing else, in time linear in the log's length.
//!
//! Where commands and feedback were stamped by two clocks, loops are still counted, on clocks
//! that the fastest answered command brings together; what needs better than that is unavailable.

mod joint_error;
pub(crate) mod live;
pub(crate) mod loops;
mod lost;
mod path;
mod plots;
pub(crate) mod record;
pub(crate) mod sessions;
#[cfg(test)]
mod tests;

use crate::messages::HumanFrame;
use crate::score::joint_error::JointError;
use crate::score::loops::{LoopCounter, Loops, LossKind, LostByKind};
use crate::score::record::{Feedback, Record};
use crate::score::sessions::Sessions;
use crate::{HUMAN_FRAME, Teleoperation};
use hil_arm::egm::messages::{EgmCommand, EgmFeedback};
use hil_core::case_study::{ErrorSeries, Harm, Score};
use hil_core::plot::PlotSeries;
use hil_core::run_log::RunLog;
use hil_core::score::Metric;
use hil_stats::metric::{Label, label};
use hil_stats::series::{Estimate, Sample, lag_s, peak_to_peak};

/// Everything a plot of the run shows.
pub(crate) fn series(case: &Teleoperation, log: &RunLog) -> Vec<PlotSeries> {
    let mut series = plots::series(log);
    series.extend(plots::motion_loops(&Run::read(case, log)));
    series
}

/// The joint error of the right arm over time.
pub(crate) fn errors(log: &RunLog) -> Vec<ErrorSeries> {
    plots::joint_error_over_time(log)
}

/// Scores a run.
pub(crate) fn score(case: &Teleoperation, log: &RunLog) -> Score {
    let run = Run::read(case, log);
    let loops = run.counter.count(&run.sent.samples, &run.moved);
    let mut metrics = run.motion_loops(loops.as_ref());
    metrics.extend(JointError::read(case, log, run.period_s).metrics());
    metrics.push(run.tracking_lag(log));
    metrics.push(run.tool_travel());
    let commanded = run.record.sent_y();
    metrics.extend(path::metrics(
        &run.record,
        &commanded,
        &run.moved,
        run.period_s,
    ));
    metrics.extend(age_metrics(&run.record));
    metrics.extend(run.sessions.metrics(&run.record));
    metrics.extend(run.inverse_kinematics());
    let mut score = Score {
        metrics,
        harms: vec![
            run.lost_loops(loops.as_ref()),
            run.sessions.ended_by_themselves(&run.record),
        ],
        headline: &["joint_error_network_rad_rms"],
        ..Score::default()
    };
    lost::add_events(&mut score, &run, loops.as_ref(), log);
    score
}

pub(crate) const LOOPS_SENT: Label = label("motion_loops_sent_count", "motion loops sent", "1");

pub(crate) const LOOPS_EXECUTED: Label =
    label("motion_loops_executed_count", "motion loops executed", "1");

pub(crate) const MOTION_LOSS: Label = label("motion_loss_ratio", "motion loss rate", "1");

/// A sender silent for longer than this share of a loop may have left one out.
const SILENCE_PERIODS: f64 = 0.25;

/// A log made ready.
#[derive(Debug)]
struct Run {
    counter: LoopCounter,
    period_s: f64,
    /// How long the human rests first.
    rest_s: f64,
    has_one_clock: bool,
    record: Record,
    sent: Sent,
    moved: Vec<Sample>,
    sessions: Sessions,
}

/// The motion the loops are counted in.
#[derive(Debug)]
struct Sent {
    samples: Vec<Sample>,
    what: &'static str,
}

impl Sent {
    /// The commanded tool y. A sender that parks the arm or falls silent now and then sends fewer
    /// loops than the human makes: then the human's hand is what was asked for.
    fn read(case: &Teleoperation, log: &RunLog, record: &Record) -> Self {
        let is_parked = |flags: u32| flags & EgmCommand::PARKED != 0;
        let mut commands = record.commands.iter();
        // What comes before the first command that follows the hand is no loop left out.
        let followed = commands.find(|command| !is_parked(command.flags));
        let silence_ns = SILENCE_PERIODS * case.parameters.motion_period_s * 1e9;
        let mut heard_ns = followed.map_or(0, |command| command.at_ns);
        let has_left_out = commands.any(|command| {
            let gap_ns = command.at_ns - core::mem::replace(&mut heard_ns, command.at_ns);
            is_parked(command.flags) || gap_ns as f64 > silence_ns
        });
        let is_behind_the_network = log.raw(HUMAN_FRAME).is_empty();
        let commanded = |what| Self {
            samples: record.sent_y(),
            what,
        };
        if followed.is_none() || (!has_left_out && !is_behind_the_network) {
            return commanded("as commanded");
        }
        if is_behind_the_network {
            let what = "as the commands arrived: what was lost on their way is not counted";
            return commanded(what);
        }
        let scale = case.parameters.mapping_scale_ratio;
        let begin_ns = followed.map_or(0, |command| command.at_ns);
        let hand = log.messages::<HumanFrame>(HUMAN_FRAME);
        let samples: Vec<_> = hand
            .map(|(at, frame)| {
                (
                    at.as_ns() + record.shift_ns,
                    scale * frame.right_hand.position_m[0],
                )
            })
            .filter(|(at, y_m)| *at >= begin_ns && y_m.is_finite())
            .collect();
        if samples.is_empty() {
            return commanded("as commanded, without the loops in which the sender was silent");
        }
        Self {
            samples,
            what: "as the human's hand made them, because the sender was silent at times",
        }
    }
}

impl Run {
    fn read(case: &Teleoperation, log: &RunLog) -> Self {
        let record = Record::read(log);
        Self {
            counter: LoopCounter::new(
                case.nominal_peak_to_peak_m(),
                case.parameters.motion_period_s,
            ),
            period_s: case.parameters.motion_period_s,
            rest_s: case.parameters.motion_start_s,
            has_one_clock: log.has_one_clock(),
            sent: Sent::read(case, log, &record),
            moved: record.moved_y(),
            sessions: Sessions::read(&record, log),
            record,
        }
    }

    /// Loops sent, loops executed, their loss ratio (Lv et al., equation 1), and causes.
    fn motion_loops(&self, loops: Option<&Loops>) -> Vec<Metric> {
        let missing = "no whole motion loop between the first and the last feedback";
        let counter = self.counter.text();
        let sent = loops.map(|loops| loops.sent_count() as f64);
        let executed = loops.map(|loops| loops.executed_count as f64);
        let ratio = MOTION_LOSS.measured(
            loops.map(Loops::loss_ratio),
            format!("(sent - executed) / sent, {counter}"),
            missing,
        );
        let interval = loops.map(Loops::loss_interval);
        let mut metrics = vec![
            LOOPS_SENT.measured(sent, format!("{}, {counter}", self.sent.what), missing),
            LOOPS_EXECUTED.measured(executed, format!("as measured, {counter}"), missing),
            Metric { interval, ..ratio },
        ];
        metrics.extend(self.causes(loops, missing));
        metrics
    }

    fn lost_by_kind(&self, loops: &Loops) -> LostByKind {
        let evidence = &self.sessions.evidence;
        evidence.lost_by_kind(loops, self.counter.period_ns)
    }

    fn lost_loops(&self, loops: Option<&Loops>) -> Harm {
        let harm = Harm::new("motion loops lost", loops.and_then(Loops::missing_count));
        let Some(loops) = loops else {
            return harm;
        };
        let kinds = self.lost_by_kind(loops);
        // Slow and merged loops may be what an outage left behind; the reach of the arm is not.
        let others = kinds.iter().sum::<u64>() - kinds[LossKind::Clipped as usize];
        let count = harm.count.unwrap_or(0);
        Harm {
            own_count: count - count.min(others),
            interval: Some(loops.loss_interval()),
            note: "hand movements out and back that the arm did not make",
            ..harm.of(loops.sent_count() as u64, "motion loops sent")
        }
    }

    fn causes(&self, loops: Option<&Loops>, missing: &str) -> [Metric; 7] {
        let kinds = loops.map(|loops| self.lost_by_kind(loops));
        let by = |kind: LossKind, name, text, what: &str| {
            let value = kinds.map(|kinds| kinds[kind as usize] as f64);
            label(name, text, "1").measured(value, what, missing)
        };
        [
            by(
                LossKind::Trip,
                "loops_lost_by_trip_count",
                "loops lost without a session",
                "sent peaks that no executed one answers, with no session in part of their loop",
            ),
            by(
                LossKind::Held,
                "loops_lost_by_hold_count",
                "loops lost in a hold",
                "of the others, those with a hold in their loop",
            ),
            by(
                LossKind::Clipped,
                "loops_lost_by_clipping_count",
                "loops lost to inverse kinematics",
                "of the others, those with limited or unreachable commands in their loop",
            ),
            by(
                LossKind::Throttled,
                "loops_lost_by_throttling_count",
                "loops lost to MaxSpeedDeviation",
                "of the others, those with MaxSpeedDeviation binding in a fifth of their loop",
            ),
            by(
                LossKind::Merged,
                "loops_lost_by_merging_count",
                "loops merged with a neighbour",
                "the others: too little motion between two peaks",
            ),
            by(
                LossKind::Unseen,
                "loops_lost_unseen_count",
                "loops lost without feedback",
                "of those with a session, as far as is known: no feedback in part of their loop",
            ),
            label("loops_extra_count", "executed loops that answer none", "1").measured(
                loops.map(|loops| loops.extra_count as f64),
                "a motion of the robot's own, or one loop cut in two; each hides one lost loop in \
                 the motion loss rate",
                missing,
            ),
        ]
    }

    fn tracking_lag(&self, log: &RunLog) -> Metric {
        let label = label("tracking_lag_ms", "tracking lag", "ms");
        if !self.has_one_clock {
            let missing = "commands and feedback were stamped by two clocks that are not aligned";
            return label.unavailable(missing);
        }
        let lag = lag_s(&self.record.sent_y(), &self.moved, 0.5 * self.period_s);
        let in_ms = |lag: Estimate| Estimate {
            value: lag.value * 1e3,
            interval: lag.interval.map(|end| end * 1e3),
        };
        let clock = log.clock_words(lag.map(|lag| lag.value));
        label.estimated(lag.map(in_ms), format!(
                "highest cross-correlation of the right tool's y, commanded and measured, on a 4 ms \
                 grid; interval from blocks of the run{clock}"
            ), "commands and feedback overlap for less than two motion periods, or nothing moved")
    }

    fn tool_travel(&self) -> Metric {
        #[allow(
            clippy::cast_possible_truncation,
            reason = "a period of at most a minute in nanoseconds"
        )]
        let travel = peak_to_peak(self.followed(), (self.period_s * 1e9) as i64);
        label(
            "tool_y_m_peak_to_peak",
            "side-to-side travel of the right tool",
            "m",
        )
        .estimated(
            travel,
            "mean over whole motion periods of following the human of highest minus lowest \
             measured y",
            "no whole motion period of feedback that follows the human",
        )
    }

    /// The measured tool y from when the robot first had a command to use and the human no longer
    /// rested; hosts start together within milliseconds.
    fn followed(&self) -> &[Sample] {
        let mut feedback = self.record.feedback.iter();
        let first = feedback.find(|known| known.has(EgmFeedback::HAS_REFERENCE));
        let (Some(first), Some(start)) = (first, self.moved.first()) else {
            return &[];
        };
        let is_before = |sample: &Sample| {
            sample.0 < first.at_ns || ((sample.0 - start.0) as f64) < self.rest_s * 1e9
        };
        &self.moved[self.moved.partition_point(is_before)..]
    }

    fn inverse_kinematics(&self) -> [Metric; 2] {
        const LIMITED: u32 = EgmCommand::LIMITED | EgmCommand::JUMP_LIMITED;
        let commands = &self.record.commands;
        let flagged = |bits: u32| {
            let is_flagged = |flags: u32| flags & bits != 0;
            let found = commands.iter().filter(|command| is_flagged(command.flags));
            (!commands.is_empty()).then(|| found.count() as u64)
        };
        let of = commands.len();
        [
            label("ik_failure_count", "inverse kinematics failures", "1").count(
                flagged(EgmCommand::UNREACHABLE),
                format!("commands flagged unreachable, of {of}"),
            ),
            label("ik_limited_count", "commands held back by a limit", "1").count(
                flagged(LIMITED),
                format!("commands flagged as limited in speed, position or jump, of {of}"),
            ),
        ]
    }
}

/// Median, tail and greatest age, and its slope.
fn age_metrics(record: &Record) -> [Metric; 4] {
    let has_age = |known: &&Feedback| known.is_running() && known.has(EgmFeedback::HAS_REFERENCE);
    let with_age = || record.feedback.iter().filter(has_age);
    let mut ages_ns: Vec<i64> = with_age().map(|known| known.reference_age_ns).collect();
    let missing = "no feedback of a running session with a reference";
    let method = format!(
        "time since the command in use arrived, its wait in the queue included, in {} messages",
        ages_ns.len()
    );
    let age = |name, text, value: Option<i64>| {
        let value_ms = value.map(|age_ns| age_ns as f64 * 1e-6);
        label(name, text, "ms").measured(value_ms, method.clone(), missing)
    };
    let mut quantile = |share: f64| {
        let last = ages_ns.len().checked_sub(1)?;
        #[allow(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a share of a length"
        )]
        let rank = (share * last as f64).round() as usize;
        Some(*ages_ns.select_nth_unstable(rank).1)
    };
    let [median, tail, greatest] = [0.5, 0.99, 1.0].map(&mut quantile);
    let slope = slope_ms_per_s(with_age().filter(|known| !known.has(EgmFeedback::HOLDING)));
    [
        age(
            "reference_age_ms_p50",
            "age of the reference in use, median",
            median,
        ),
        age(
            "reference_age_ms_p99",
            "age of the reference in use, 99 %",
            tail,
        ),
        age(
            "reference_age_ms_max",
            "age of the reference in use, greatest",
            greatest,
        ),
        label(
            "reference_age_ms_per_s",
            "growth of the reference's age",
            "ms/s",
        )
        .measured(
            slope,
            "least squares within each session, holds left out; above zero the queue grows for \
             ever",
            "no session long enough for a slope",
        ),
    ]
}

/// Shortest time over which a slope means anything.
const SLOPE_SPAN_MIN_NS: i64 = 1_000_000_000;

/// One slope for all sessions, each with a level of its own.
fn slope_ms_per_s<'a>(feedback: impl Iterator<Item = &'a Feedback>) -> Option<f64> {
    let (mut moment, mut square) = (0.0, 0.0);
    let mut session: Option<Line> = None;
    let mut close = |line: Option<Line>| {
        if let Some(line) = line.filter(|line| line.newest_ns >= SLOPE_SPAN_MIN_NS) {
            moment += line.moment;
            square += line.square;
        }
    };
    for known in feedback {
        if session
            .as_ref()
            .is_none_or(|line| line.session != known.session)
        {
            close(session.take());
            session = Some(Line {
                session: known.session,
                begin_ns: known.at_ns,
                ..Line::default()
            });
        }
        if let Some(line) = &mut session {
            line.add(known.at_ns, known.reference_age_ns);
        }
    }
    close(session);
    (square > 0.0).then(|| moment / square)
}

/// Sums about the means of one session, by Welford's update.
#[derive(Debug, Default)]
struct Line {
    session: u32,
    begin_ns: i64,
    newest_ns: i64,
    count: f64,
    time_mean_s: f64,
    age_mean_ms: f64,
    moment: f64,
    square: f64,
}

impl Line {
    fn add(&mut self, at_ns: i64, age_ns: i64) {
        self.newest_ns = at_ns - self.begin_ns;
        let (time_s, age) = (self.newest_ns as f64 * 1e-9, age_ns as f64 * 1e-6);
        self.count += 1.0;
        let time_off = time_s - self.time_mean_s;
        self.time_mean_s += time_off / self.count;
        self.age_mean_ms += (age - self.age_mean_ms) / self.count;
        self.moment += time_off * (age - self.age_mean_ms);
        self.square += time_off * (time_s - self.time_mean_s);
    }
}
