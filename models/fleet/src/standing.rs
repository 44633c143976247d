//! Standstills of whole fleets: when no robot of a fleet moved, took a mission or reached a goal, for how long, and
//! what the log says of the cause.

use core::time::Duration;
use std::collections::BTreeMap;

use crate::case::{FLEET_AUTHORITY, FLEET_MISSION, FLEET_STATE, FLEET_TRUTH};
use crate::events::{COPIES_NAMED_MAX, Sent, reading, sent};
use crate::messages::{Authority, Mission, State, Truth, TruthKind};
use hil_core::case_study::{MessageRef, ScoreEvent, Severity};
use hil_core::run_log::RunLog;
use hil_core::time::Instant;

/// One standstill.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Standstill {
    fleet_id: u32,
    from: Instant,
    to: Instant,
    /// Robots with a mission that was not done.
    under_way_count: usize,
    cause: Cause,
}

#[derive(Debug, Clone, PartialEq)]
enum Cause {
    NothingSent {
        silence: Silence,
    },
    /// Questions what robots hold, of which some were answered.
    OnlyAsked {
        sent_from: Instant,
        until: Instant,
    },
    NothingArrived {
        silence: Silence,
        sent_count: usize,
        sent_from: Instant,
        /// The first of them.
        first: Vec<MessageRef>,
    },
    Waiting,
    ClocksDiffer,
}

/// The longest part of a standstill in which no command arrived.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Silence {
    from: Instant,
    to: Instant,
    is_whole: bool,
}

/// From when on a fleet stands.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Patience {
    /// Its robots have been under way.
    pub(crate) after: Duration,
    /// A robot in its bay has had time to be sent on.
    pub(crate) parking: Duration,
    /// A command that was sent has had time to be heard and repeated.
    pub(crate) answer: Duration,
}

/// Finds the standstills in a run from the first of `truths`, which come in order of time, to `end`: those of more than
/// `patience.after`, and those of fleets that never moved. A fleet that has had a mission, and has none now, stands only
/// where `has_more_missions`.
pub(crate) fn standstills(
    log: &RunLog,
    truths: &[Truth],
    end: Instant,
    patience: Patience,
    has_more_missions: bool,
) -> Vec<Standstill> {
    let Some(start) = truths.first().map(|truth| Instant::from_ns(truth.at_ns)) else {
        return Vec::new();
    };
    let mut fleets: BTreeMap<u32, Watch> = BTreeMap::new();
    for truth in truths {
        let watch = fleets
            .entry(truth.fleet_id)
            .or_insert_with(|| Watch::from(start, has_more_missions));
        watch.see(truth, patience.after);
    }
    let mut found = Vec::new();
    for (fleet_id, mut watch) in fleets {
        watch.close(end, patience.after);
        let is_idle = watch.gaps.is_empty() && !watch.has_moved && watch.is_due();
        let idle = is_idle.then(|| (watch.busy_until, end, watch.under_way_count()));
        for (from, to, under_way_count) in watch.gaps.into_iter().chain(idle) {
            let cause = cause(log, truths, fleet_id, [from, to]);
            if !is_idle || cause.is_sure(patience) {
                found.push(Standstill {
                    fleet_id,
                    from,
                    to,
                    under_way_count,
                    cause,
                });
            }
        }
    }
    found
}

/// One fleet, record by record.
#[derive(Debug)]
pub(crate) struct Watch {
    /// Per robot its last record.
    last: BTreeMap<u32, Truth>,
    /// Per robot that has had a mission.
    is_under_way: BTreeMap<u32, bool>,
    has_moved: bool,
    has_more_missions: bool,
    /// Until when something moved or began, as far as is known.
    busy_until: Instant,
    gaps: Vec<(Instant, Instant, usize)>,
}

impl Watch {
    pub(crate) fn from(start: Instant, has_more_missions: bool) -> Self {
        Self {
            last: BTreeMap::new(),
            is_under_way: BTreeMap::new(),
            has_moved: false,
            has_more_missions,
            busy_until: start,
            gaps: Vec::new(),
        }
    }

    pub(crate) fn see(&mut self, truth: &Truth, after: Duration) {
        let at = Instant::from_ns(truth.at_ns);
        let kind = TruthKind::from_number(truth.kind);
        let is_under_way = match kind {
            Some(TruthKind::MissionStarted) => Some(true),
            Some(TruthKind::MissionDone | TruthKind::Replaced) => Some(false),
            _ => None,
        };
        let is_moving = truth.speed_mps > 0.0 || truth.acceleration_mps2 > 0.0;
        // Whatever else is recorded, a command that gives no way for one, does not end a standstill.
        if is_under_way.is_some() || is_moving {
            self.close(at, after);
            self.busy_until = self.busy_until.max(at);
        } else {
            self.busy_until = self.still_since(at);
        }
        self.has_moved |= is_moving;
        if let Some(is_under_way) = is_under_way {
            self.is_under_way.insert(truth.robot_id, is_under_way);
        }
        self.last.insert(truth.robot_id, *truth);
    }

    /// Since when nothing moves or begins, as far as the records until `at` tell.
    pub(crate) fn still_since(&self, at: Instant) -> Instant {
        let moves_until = |truth: &Truth| {
            let since = Instant::from_ns(truth.at_ns);
            if truth.speed_mps <= 0.0 && truth.acceleration_mps2 <= 0.0 {
                since
            } else if truth.acceleration_mps2 < 0.0 {
                let stops_s = truth.speed_mps / -truth.acceleration_mps2;
                (since + Duration::from_secs_f64(stops_s.min(1e6))).min(at)
            } else {
                at
            }
        };
        let moved = self
            .last
            .values()
            .filter(|truth| truth.speed_mps > 0.0 || truth.acceleration_mps2 > 0.0);
        moved.map(moves_until).fold(self.busy_until, Instant::max)
    }

    /// The standstills that are over, each with its begin, its end and the robots under way in it.
    pub(crate) fn take_gaps(&mut self) -> Vec<(Instant, Instant, usize)> {
        core::mem::take(&mut self.gaps)
    }

    /// Robots with a mission that is not done.
    pub(crate) fn under_way_count(&self) -> usize {
        self.is_under_way.values().filter(|is| **is).count()
    }

    /// True when something is to do: for those under way, or for all as more missions are to come or none came yet.
    pub(crate) fn is_due(&self) -> bool {
        self.has_more_missions || self.is_under_way.is_empty() || self.under_way_count() > 0
    }

    /// Nothing is known beyond the last records until `at`: a standstill may have been until then.
    fn close(&mut self, at: Instant, after: Duration) {
        let until = self.still_since(at);
        if at > until + after {
            if self.is_due() {
                self.gaps.push((until, at, self.under_way_count()));
            }
            self.busy_until = at;
        } else {
            self.busy_until = until;
        }
    }
}

/// Which command to which robot of a fleet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Order {
    robot_id: u32,
    /// It asks what the robot holds and gives no way.
    is_question: bool,
    /// Of an authority or a question its number, of a mission 0.
    sequence: u32,
}

/// The commands to robots of a fleet that were sent within `span`, in order of time.
fn commands(log: &RunLog, fleet_id: u32, span: [Instant; 2]) -> Vec<(Sent, Order)> {
    let authorities = sent::<Authority>(log, FLEET_AUTHORITY).map(|(sent, one)| {
        let is_question = one.flags & Authority::QUESTION != 0;
        (sent, one.header, is_question, one.sequence)
    });
    let missions =
        sent::<Mission>(log, FLEET_MISSION).map(|(sent, one)| (sent, one.header, false, 0));
    let mut commands: Vec<_> = authorities
        .chain(missions)
        .filter(|(sent, to, _, _)| {
            to.fleet_id == fleet_id && span[0] <= sent.at && sent.at < span[1]
        })
        .map(|(sent, to, is_question, sequence)| {
            let order = Order {
                robot_id: to.robot_id,
                is_question,
                sequence,
            };
            (sent, order)
        })
        .collect();
    commands.sort_by_key(|(sent, _)| sent.at);
    commands
}

/// When commands arrived that were sent within `span`, each with when it first was; in order of time.
fn arrivals(
    log: &RunLog,
    truths: &[Truth],
    fleet_id: u32,
    span: [Instant; 2],
    first_sent: &BTreeMap<Order, Instant>,
) -> Vec<Instant> {
    let told = truths.iter().filter(|truth| {
        let is_its = truth.fleet_id == fleet_id;
        is_its && tells_of_arrival(truth)
    });
    let told = told.map(|truth| {
        let order = Order {
            robot_id: truth.robot_id,
            is_question: false,
            sequence: truth.caused_by_sequence,
        };
        (Instant::from_ns(truth.at_ns), order)
    });
    // Of a question the first state that answers it tells.
    let mut answered = BTreeMap::new();
    let states = log.messages::<State>(FLEET_STATE);
    for (_, state) in states.filter(|(_, state)| state.header.fleet_id == fleet_id) {
        let order = Order {
            robot_id: state.header.robot_id,
            is_question: true,
            sequence: state.answered,
        };
        let at = Instant::from_ns(state.sampled_ns);
        answered.entry(order).or_insert(at);
    }
    let answered = answered.into_iter().map(|(order, at)| (at, order));
    let reading = reading(log);
    // What was sent before says nothing of this time.
    let is_of_span = |(at, order): &(Instant, Order)| {
        let sent = first_sent.get(order);
        span[0] < *at && *at < span[1] && sent.is_some_and(|sent| *sent <= *at + reading)
    };
    let all = told.chain(answered).filter(is_of_span);
    let mut arrivals: Vec<_> = all.map(|(at, _)| at).collect();
    arrivals.sort_unstable();
    arrivals
}

fn cause(log: &RunLog, truths: &[Truth], fleet_id: u32, span: [Instant; 2]) -> Cause {
    if !log.has_one_clock() {
        return Cause::ClocksDiffer;
    }
    let commands = commands(log, fleet_id, span);
    let mut first_sent: BTreeMap<Order, Instant> = BTreeMap::new();
    for (sent, order) in &commands {
        first_sent.entry(*order).or_insert(sent.at);
    }
    let arrivals = arrivals(log, truths, fleet_id, span, &first_sent);
    let is_question = |(_, order): &(Sent, Order)| order.is_question;
    if let Some((first, _)) = commands.first()
        && !arrivals.is_empty()
        && commands.iter().all(is_question)
    {
        return Cause::OnlyAsked {
            sent_from: first.at,
            until: span[1],
        };
    }
    let begins = core::iter::once(span[0]).chain(arrivals.iter().copied());
    let ends = arrivals.iter().copied().chain([span[1]]);
    let between = begins.zip(ends);
    let longest = between.max_by_key(|(from, to)| to.ns_since(*from));
    let (from, to) = longest.expect("there is an end for each begin");
    if 2 * to.ns_since(from) <= span[1].ns_since(span[0]) {
        return Cause::Waiting;
    }
    let silence = Silence {
        from,
        to,
        is_whole: arrivals.is_empty(),
    };
    let unheard = || {
        let all = commands.iter().map(|(sent, _)| sent);
        all.filter(|sent| from <= sent.at && sent.at < to)
    };
    match unheard().next() {
        None => Cause::NothingSent { silence },
        Some(first) => Cause::NothingArrived {
            silence,
            sent_count: unheard().count(),
            sent_from: first.at,
            first: unheard()
                .take(COPIES_NAMED_MAX)
                .map(|sent| sent.message)
                .collect(),
        },
    }
}

/// True of a record of a command that came to the robot.
fn tells_of_arrival(truth: &Truth) -> bool {
    match TruthKind::from_number(truth.kind) {
        Some(
            TruthKind::MissionStarted
            | TruthKind::AuthorityApplied
            | TruthKind::AuthorityLate
            | TruthKind::AuthorityIgnored
            | TruthKind::AuthorityRefused
            | TruthKind::MessageStale,
        ) => true,
        Some(TruthKind::Motion | TruthKind::MissionDone | TruthKind::Replaced) | None => false,
    }
}

impl Cause {
    /// Whether a fleet stands by it that has not moved in the whole run, however short that was: robots have had time to
    /// be sent on and to hear of it.
    fn is_sure(&self, patience: Patience) -> bool {
        match self {
            Self::NothingSent { silence } => {
                silence.to > silence.from + patience.parking + patience.answer
            }
            Self::NothingArrived {
                silence, sent_from, ..
            } => silence.to > *sent_from + patience.answer,
            Self::OnlyAsked { sent_from, until } => *until > *sent_from + patience.answer,
            Self::Waiting | Self::ClocksDiffer => false,
        }
    }
}

impl Silence {
    fn words(&self) -> String {
        if self.is_whole {
            "in that time".to_owned()
        } else {
            format!("in {:.0} s of that time", self.to.seconds_since(self.from))
        }
    }
}

impl Standstill {
    /// How long, seconds.
    pub(crate) fn duration_s(&self) -> f64 {
        self.to.seconds_since(self.from)
    }

    /// True when its robots heard what was sent to them, and gave way to one another.
    pub(crate) const fn is_their_own(&self) -> bool {
        matches!(self.cause, Cause::Waiting)
    }

    /// As an event of the score.
    pub(crate) fn event(&self) -> ScoreEvent {
        let cause = match &self.cause {
            Cause::NothingSent { silence } => {
                format!("the controller sent no command {}", silence.words())
            }
            Cause::OnlyAsked { .. } => {
                "the controller asked robots what they hold, and sent no other command in that time"
                    .to_owned()
            }
            Cause::NothingArrived {
                silence,
                sent_count,
                ..
            } => format!(
                "none of the {sent_count} commands sent {} reached a robot",
                silence.words()
            ),
            Cause::Waiting => {
                "commands arrived, and none gave a robot more way: they wait for one another"
                    .to_owned()
            }
            Cause::ClocksDiffer => {
                "cause unavailable, as the hosts' clocks are not aligned".to_owned()
            }
        };
        let what = format!(
            "fleet {} stood for {:.0} s, {} of its robots with a mission: {cause}",
            self.fleet_id,
            self.duration_s(),
            self.under_way_count
        );
        let event = ScoreEvent::new(Severity::Hazard, self.from, FLEET_TRUTH, what);
        match &self.cause {
            Cause::NothingArrived { first, .. } => {
                first.iter().copied().fold(event, ScoreEvent::naming)
            }
            _ => event,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::message::Envelope;

    fn truth(at_s: i64, robot_id: u32, kind: TruthKind, speed_mps: f64) -> Truth {
        Truth {
            at_ns: at_s * 1_000_000_000,
            robot_id,
            kind: kind as u32,
            speed_mps,
            ..Truth::default()
        }
    }

    const PATIENCE: Patience = Patience {
        after: Duration::from_mins(2),
        parking: Duration::from_secs(3),
        answer: Duration::from_secs(5),
    };

    /// Authorities to robot 0 of fleet 0, numbered from 1, at these seconds.
    fn log_of(sent_at_s: &[i64]) -> RunLog {
        let mut log = RunLog::default();
        for (sequence, at_s) in (1..).zip(sent_at_s) {
            let authority = Authority {
                sequence,
                ..Authority::default()
            };
            let envelope = Envelope {
                sequence: sequence.into(),
                published_ns: at_s * 1_000_000_000,
                ..Envelope::default()
            };
            log.push(FLEET_AUTHORITY, envelope, bytemuck::bytes_of(&authority));
        }
        log
    }

    /// What is said of the standstills, without the fleet.
    fn said(log: &RunLog, truths: &[Truth], end_s: i64) -> Vec<String> {
        let end = Instant::from_ns(end_s * 1_000_000_000);
        let found = standstills(log, truths, end, PATIENCE, true);
        let events = found.iter().map(Standstill::event);
        events
            .map(|event| event.what.replace("fleet 0 stood for ", ""))
            .collect()
    }

    /// A record that names an authority.
    fn of(mut truth: Truth, sequence: u32) -> Truth {
        truth.caused_by_sequence = sequence;
        truth
    }

    #[test]
    fn a_stop_at_the_end_of_an_old_authority_is_no_arrival_nor_is_one_that_was_sent_before() {
        let begun = truth(0, 0, TruthKind::MissionStarted, 1.0);
        // It stops within the standstill, which another robot's last motion begins.
        let stops = of(truth(12, 0, TruthKind::Motion, 0.0), 1);
        let late = of(truth(15, 0, TruthKind::MessageStale, 0.0), 1);
        let sent: Vec<i64> = (5..300).step_by(5).collect();
        let log = log_of(&sent);
        let none = "290 s, 1 of its robots with a mission: none of the 58 commands sent in that time reached a robot";
        let moving = of(truth(10, 0, TruthKind::Motion, 0.0), 1);
        for records in [vec![stops], vec![late], vec![stops, late], vec![]] {
            let mut truths = vec![begun, moving];
            truths.extend(records);
            assert_eq!(said(&log, &truths, 300), [none]);
        }
        // Each arrives: there is another reason.
        let mut truths = vec![begun, moving];
        let heard = (3..).zip(&sent[2..]);
        truths.extend(heard.map(|(sequence, at_s)| {
            of(
                truth(at_s + 1, 0, TruthKind::AuthorityApplied, 0.0),
                sequence,
            )
        }));
        let waits = "290 s, 1 of its robots with a mission: commands arrived, and none gave a robot more way: they wait \
                     for one another";
        assert_eq!(said(&log, &truths, 300), [waits]);
        // Only those of the last twenty seconds do: of 10 to 281 s none.
        truths.retain(|truth| truth.at_ns < 12_000_000_000 || truth.at_ns > 280_000_000_000);
        let mostly = "290 s, 1 of its robots with a mission: none of the 55 commands sent in 271 s of that time reached \
                      a robot";
        assert_eq!(said(&log, &truths, 300), [mostly]);
    }

    #[test]
    fn a_question_arrives_with_the_first_state_that_answers_it() {
        let starts = [truth(0, 0, TruthKind::Motion, 0.0)];
        let envelope = |at_s: i64| Envelope {
            published_ns: at_s * 1_000_000_000,
            ..Envelope::default()
        };
        let mut log = RunLog::default();
        for at_s in 1..100 {
            let question = Authority {
                sequence: 7,
                flags: Authority::QUESTION,
                ..Authority::default()
            };
            log.push(
                FLEET_AUTHORITY,
                envelope(at_s),
                bytemuck::bytes_of(&question),
            );
        }
        let lost = "100 s, 0 of its robots with a mission: none of the 99 commands sent in that time reached a robot";
        assert_eq!(said(&log, &starts, 100), [lost]);
        let answer = |answered| State {
            answered,
            sampled_ns: 3_000_000_000,
            ..State::default()
        };
        // To another question, of before.
        log.push(FLEET_STATE, envelope(3), bytemuck::bytes_of(&answer(6)));
        assert_eq!(said(&log, &starts, 100), [lost]);
        log.push(FLEET_STATE, envelope(3), bytemuck::bytes_of(&answer(7)));
        let asked = "100 s, 0 of its robots with a mission: the controller asked robots what they hold, and sent no \
                     other command in that time";
        assert_eq!(said(&log, &starts, 100), [asked]);
    }

    #[test]
    fn a_fleet_that_never_moves_stands_however_short_the_run_once_it_was_due() {
        let starts = [truth(0, 0, TruthKind::Motion, 0.0)];
        let log = log_of(&[3, 6, 9, 12]);
        let none = |count: usize, of_s: usize| {
            format!(
                "{of_s} s, 0 of its robots with a mission: none of the {count} commands sent in that time reached a robot"
            )
        };
        assert_eq!(said(&log, &starts, 100), [none(4, 100)]);
        assert_eq!(said(&log, &starts, 10), [none(3, 10)]);
        // The first was sent at 3 s and has five to be answered.
        for end_s in [1, 5, 8] {
            assert!(said(&log, &starts, end_s).is_empty(), "{end_s}");
        }
        // Nothing was sent: a robot parks for three seconds first.
        let silent = log_of(&[]);
        assert!(said(&silent, &starts, 8).is_empty());
        let nothing =
            "9 s, 0 of its robots with a mission: the controller sent no command in that time";
        assert_eq!(said(&silent, &starts, 9), [nothing]);
        // It has its mission, and no way; with its first motion it is a fleet like any other.
        let begun = [starts[0], truth(4, 0, TruthKind::MissionStarted, 0.0)];
        let under_way = "56 s, 1 of its robots with a mission: none of the 3 commands sent in that time reached a robot";
        assert_eq!(said(&log, &begun, 60), [under_way]);
        let moves = [begun[0], begun[1], truth(5, 0, TruthKind::Motion, 0.5)];
        let stops = truth(6, 0, TruthKind::Motion, 0.0);
        assert!(said(&log, &[&moves[..], &[stops]].concat(), 60).is_empty());
        // Also one whose missions end, of which none came.
        assert_eq!(found(&starts, 150, false), [(150.0, 0)]);
    }

    fn found(truths: &[Truth], end_s: i64, has_more_missions: bool) -> Vec<(f64, usize)> {
        let end = Instant::from_ns(end_s * 1_000_000_000);
        let found = standstills(&RunLog::default(), truths, end, PATIENCE, has_more_missions);
        found
            .iter()
            .map(|one| (one.duration_s(), one.under_way_count))
            .collect()
    }

    #[test]
    fn a_fleet_that_stands_to_the_end_of_the_run_is_told_with_those_under_way() {
        let truths = [
            truth(0, 0, TruthKind::MissionStarted, 0.0),
            truth(1, 1, TruthKind::MissionStarted, 0.0),
            truth(2, 0, TruthKind::Motion, 1.0),
            truth(60, 0, TruthKind::MissionDone, 0.0),
        ];
        assert_eq!(found(&truths, 3600, true), [(3540.0, 1)]);
        assert_eq!(found(&truths, 150, true), []);
    }

    #[test]
    fn a_fleet_that_has_had_all_its_missions_does_not_stand() {
        let truths = [
            truth(0, 0, TruthKind::MissionStarted, 1.0),
            truth(60, 0, TruthKind::MissionDone, 0.0),
        ];
        assert_eq!(found(&truths, 3600, false), []);
        assert_eq!(found(&truths, 3600, true), [(3540.0, 0)]);
    }

    #[test]
    fn a_robot_in_motion_ends_a_standstill_and_one_that_brakes_begins_it() {
        let mut braking = truth(100, 0, TruthKind::Motion, 2.0);
        braking.acceleration_mps2 = -1.0;
        let truths = [
            truth(0, 0, TruthKind::MissionStarted, 1.0),
            braking,
            truth(102, 0, TruthKind::Motion, 0.0),
            truth(400, 0, TruthKind::Motion, 1.0),
            truth(700, 0, TruthKind::MissionDone, 0.0),
        ];
        assert_eq!(found(&truths, 710, true), [(298.0, 1)]);
    }
}
