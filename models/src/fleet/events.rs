//! The events of a recorded run: incidents the referee saw and commands the robots got late, not
//! at all or in vain, each with the messages behind it. What the network did to those messages is
//! not known here; whoever has the account of the channels shows it beside them.

use core::time::Duration;
use std::collections::BTreeMap;

use crate::case_study::{MessageRef, ScoreEvent, Severity};
use crate::fleet::case::{FLEET_AUTHORITY, FLEET_MISSION, FLEET_TRUTH};
use crate::fleet::messages::{Authority, Mission, Truth, TruthKind};
use crate::fleet::referee::{Incident, IncidentKind};
use crate::message::Message;
use crate::run_log::RunLog;
use crate::time::Instant;

/// A command counts as held up when the copy that was taken left so long after the first. Repeats
/// come after a control period, a second, and replicas at once.
const HELD_UP_AFTER: Duration = Duration::from_millis(300);

/// A robot dates what it does to the moment it began to read its channels; a command may come in
/// while it reads, and so leave after its effect.
const READING: Duration = Duration::from_millis(20);

/// Copies of one command that an event names.
const COPIES_NAMED_MAX: usize = 4;

/// What a robot was told: fleet, robot, mission, and the number of the authority.
type Key = (u32, u32, u32, u32);

/// The events of a run, in order of time. The log must hold the truth in its own order.
pub(crate) fn events(log: &RunLog, incidents: &[Incident]) -> Vec<ScoreEvent> {
    let orders = Orders::of(log);
    let mut watches: BTreeMap<(u32, u32), Watch> = BTreeMap::new();
    let mut found = Vec::new();
    for (_, truth) in log.messages::<Truth>(FLEET_TRUTH) {
        let watch = watches.entry((truth.fleet_id, truth.robot_id)).or_default();
        watch.see(&truth, &orders, &mut found);
    }
    found.extend(incidents.iter().map(|one| incident(one, &orders)));
    found.sort_by_key(|event| event.at);
    found
}

/// One sending of a command.
#[derive(Debug, Clone, Copy)]
struct Sent {
    message: MessageRef,
    at: Instant,
}

/// Everything the controller sent.
#[derive(Debug, Default)]
struct Orders {
    authorities: BTreeMap<Key, Vec<Sent>>,
    missions: BTreeMap<(u32, u32, u32), Vec<Sent>>,
    /// Controller and robots read one clock: their times compare.
    has_one_clock: bool,
}

impl Orders {
    fn of(log: &RunLog) -> Self {
        let mut orders = Self {
            has_one_clock: log.has_one_clock(),
            ..Self::default()
        };
        for (sent, authority) in sent::<Authority>(log, FLEET_AUTHORITY) {
            let to = &authority.header;
            let key = (to.fleet_id, to.robot_id, to.mission_id, authority.sequence);
            orders.authorities.entry(key).or_default().push(sent);
        }
        for (sent, mission) in sent::<Mission>(log, FLEET_MISSION) {
            let to = &mission.header;
            let key = (to.fleet_id, to.robot_id, to.mission_id);
            orders.missions.entry(key).or_default().push(sent);
        }
        orders
    }

    fn authority(&self, key: Key) -> &[Sent] {
        self.authorities.get(&key).map_or(&[], Vec::as_slice)
    }

    /// What was sent of a mission's authorities after number `after` and below `below`.
    fn between(
        &self,
        (fleet, robot, mission): (u32, u32, u32),
        after: u32,
        below: u32,
    ) -> Vec<Sent> {
        let from = (fleet, robot, mission, after.saturating_add(1));
        let to = (fleet, robot, mission, below);
        if from >= to {
            return Vec::new();
        }
        let range = self.authorities.range(from..to);
        range.flat_map(|(_, copies)| copies).copied().collect()
    }

    /// How long after its first copy a command was taken at `at`, and how many copies left well
    /// before the one that was; `None` when it was not held up, or no one can say.
    fn held_up(&self, copies: &[Sent], at: Instant) -> Option<(f64, usize)> {
        let first = copies.first().filter(|_| self.has_one_clock)?;
        let taken = copies.iter().rfind(|copy| copy.at <= at + READING)?;
        let missed = copies
            .iter()
            .filter(|copy| copy.at + HELD_UP_AFTER <= taken.at);
        let missed_count = missed.count();
        (missed_count > 0).then(|| (at.seconds_since(first.at), missed_count))
    }
}

impl Orders {
    /// The first of `copies` that went out before `event`: what was sent later did not lead to it.
    fn named(&self, event: ScoreEvent, mut copies: Vec<Sent>) -> ScoreEvent {
        copies.retain(|sent| !self.has_one_clock || sent.at <= event.at + READING);
        copies.sort_by_key(|sent| sent.at);
        let copies = copies.iter().take(COPIES_NAMED_MAX);
        copies.fold(event, |event, sent| event.naming(sent.message))
    }
}

fn sent<M: Message>(log: &RunLog, channel: &'static str) -> impl Iterator<Item = (Sent, M)> {
    log.raw(channel).iter().filter_map(move |logged| {
        let message = bytemuck::try_pod_read_unaligned(&logged.payload).ok()?;
        let sent = Sent {
            message: MessageRef::of(channel, &logged.envelope),
            at: Instant::from_ns(logged.envelope.published_ns),
        };
        Some((sent, message))
    })
}

/// What one robot has heard of its mission.
#[derive(Debug, Default)]
struct Watch {
    mission_id: u32,
    /// When the robot began it.
    begun: Instant,
    heard: u32,
}

impl Watch {
    fn see(&mut self, truth: &Truth, orders: &Orders, found: &mut Vec<ScoreEvent>) {
        let Some(kind) = TruthKind::of(truth.kind) else {
            return;
        };
        if truth.mission_id != self.mission_id {
            self.mission_id = truth.mission_id;
            self.begun = at(truth);
            self.heard = 0;
        }
        match kind {
            TruthKind::MissionStarted => found.extend(mission_held_up(truth, orders)),
            TruthKind::AuthorityApplied
            | TruthKind::AuthorityLate
            | TruthKind::AuthorityIgnored
            | TruthKind::AuthorityRefused => {
                found.extend(self.hear(truth, kind, orders));
            }
            // A repeat of what it knows; a number that was sent for this mission counts as heard.
            TruthKind::MessageStale if !orders.authority(key(truth)).is_empty() => {
                self.heard = self.heard.max(truth.caused_by_sequence);
            }
            TruthKind::LeaseEnded => found.push(lease_ended(truth, orders)),
            TruthKind::Replaced => {
                let what = format!("{} was put at its goal to clear a stuck fleet", name(truth));
                found.push(notice(truth, what));
            }
            TruthKind::Motion | TruthKind::MissionDone | TruthKind::MessageStale => {}
        }
    }

    /// One event per authority taken: the gravest that applies.
    fn hear(&mut self, truth: &Truth, kind: TruthKind, orders: &Orders) -> Option<ScoreEvent> {
        let number = truth.caused_by_sequence;
        let before = self.heard;
        self.heard = before.max(number);
        let robot = (truth.fleet_id, truth.robot_id, truth.mission_id);
        let missed = orders.between(robot, before, number);
        let copies = orders.authority(key(truth));
        // What was sent before the robot had the mission had to wait for it, not for the network.
        let since = copies.partition_point(|copy| orders.has_one_clock && copy.at < self.begun);
        let copies = &copies[since..];
        let order = format!("authority {number} of mission {}", truth.mission_id);
        let (who, held_up) = (name(truth), orders.held_up(copies, at(truth)));
        let is_repeat = number <= before;
        let what = match (kind, held_up) {
            (TruthKind::AuthorityLate, _) => {
                format!("{who} could not stop at {order} any more and went past")
            }
            (TruthKind::AuthorityIgnored, _) => {
                format!("{who} was behind {order} already and drives on as before")
            }
            (TruthKind::AuthorityRefused, _) => {
                format!("{who} refused {order}: it cannot stop there any more")
            }
            _ if is_repeat => return None,
            (_, Some((late_s, copy_count))) => {
                let copies = counted(copy_count, "copy", "copies");
                format!("{who} took {order} {late_s:.2} s after it was first sent, {copies} before")
            }
            _ if !missed.is_empty() => {
                let first = before + 1;
                let numbers = if first + 1 == number {
                    format!("authority {first}")
                } else {
                    format!("authorities {first} to {}", number - 1)
                };
                format!(
                    "{who} took no {numbers} of mission {} before {number}",
                    truth.mission_id
                )
            }
            _ => return None,
        };
        let copies = [missed.as_slice(), copies].concat();
        Some(orders.named(notice(truth, what), copies))
    }
}

fn mission_held_up(truth: &Truth, orders: &Orders) -> Option<ScoreEvent> {
    let key = (truth.fleet_id, truth.robot_id, truth.mission_id);
    let copies = orders.missions.get(&key)?;
    let (late_s, copy_count) = orders.held_up(copies, at(truth))?;
    let what = format!(
        "{} began mission {} {late_s:.2} s after it was first sent, {} before",
        name(truth),
        truth.mission_id,
        counted(copy_count, "copy", "copies"),
    );
    Some(orders.named(notice(truth, what), copies.clone()))
}

fn lease_ended(truth: &Truth, orders: &Orders) -> ScoreEvent {
    let robot = (truth.fleet_id, truth.robot_id, truth.mission_id);
    let unheard = orders.between(robot, truth.caused_by_sequence, u32::MAX);
    let what = format!(
        "{} braked: the lease of authority {} of mission {} ended",
        name(truth),
        truth.caused_by_sequence,
        truth.mission_id
    );
    orders.named(notice(truth, what), unheard)
}

/// An incident with, for each of the two robots, the authority it last took and what was sent to it
/// after that.
fn incident(incident: &Incident, orders: &Orders) -> ScoreEvent {
    let manner = match incident.kind {
        IncidentKind::Section => "collided by the section checker",
        IncidentKind::Overlap => "overlapped in a critical section",
        IncidentKind::Outside => "overlapped outside every critical section",
    };
    let [one, other] = incident.robots;
    let [x_m, y_m] = incident.position_m;
    let what = format!(
        "robots {one} and {other} of fleet {} {manner}, at x {x_m:.1} m, y {y_m:.1} m",
        incident.fleet_id
    );
    let event = ScoreEvent::new(Severity::Incident, incident.at, FLEET_TRUTH, what);
    let sides = incident
        .robots
        .iter()
        .zip(incident.mission_ids)
        .zip(incident.causes);
    sides.fold(event, |event, ((robot, mission), cause)| {
        let robot = (incident.fleet_id, *robot, mission);
        let taken = cause.caused_by_sequence;
        let last = orders
            .authority((robot.0, robot.1, robot.2, taken))
            .to_vec();
        let event = orders.named(event, last);
        orders.named(event, orders.between(robot, taken, u32::MAX))
    })
}

fn notice(truth: &Truth, what: String) -> ScoreEvent {
    ScoreEvent::new(Severity::Notice, at(truth), FLEET_TRUTH, what)
}

fn key(truth: &Truth) -> Key {
    (
        truth.fleet_id,
        truth.robot_id,
        truth.mission_id,
        truth.caused_by_sequence,
    )
}

fn at(truth: &Truth) -> Instant {
    Instant::from_ns(truth.at_ns)
}

fn name(truth: &Truth) -> String {
    format!("robot {} of fleet {}", truth.robot_id, truth.fleet_id)
}

fn counted(count: usize, one: &str, many: &str) -> String {
    format!("{count} {}", if count == 1 { one } else { many })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fleet::messages::Header;
    use crate::fleet::referee::Cause;
    use crate::message::Envelope;

    const MS: i64 = 1_000_000;

    /// A run in the making: what was published, channel by channel, in order.
    #[derive(Default)]
    struct Diary {
        log: RunLog,
        counts: BTreeMap<&'static str, u64>,
    }

    impl Diary {
        fn publish(&mut self, channel: &'static str, at_ms: i64, message: &impl Message) {
            let count = self.counts.entry(channel).or_default();
            let envelope = Envelope {
                sequence: *count,
                published_ns: at_ms * MS,
                epoch: 5,
                ..Envelope::default()
            };
            *count += 1;
            self.log
                .push(channel, envelope, bytemuck::bytes_of(message));
        }

        fn send(&mut self, at_ms: i64, number: u32) -> &mut Self {
            let authority = Authority {
                header: header(),
                sequence: number,
                ..Authority::default()
            };
            self.publish(FLEET_AUTHORITY, at_ms, &authority);
            self
        }

        fn take(&mut self, at_ms: i64, kind: TruthKind, number: u32) -> &mut Self {
            let truth = Truth {
                at_ns: at_ms * MS,
                fleet_id: 1,
                robot_id: 2,
                mission_id: 3,
                caused_by_sequence: number,
                kind: kind as u32,
                ..Truth::default()
            };
            self.publish(FLEET_TRUTH, at_ms, &truth);
            self
        }

        fn told(&self) -> Vec<(String, Vec<u64>)> {
            let events = events(&self.log, &[]);
            let told = events.into_iter().map(|event| {
                let numbers = event.messages.iter().map(|message| message.sequence);
                (event.what, numbers.collect())
            });
            told.collect()
        }
    }

    fn header() -> Header {
        Header {
            fleet_id: 1,
            robot_id: 2,
            mission_id: 3,
            ..Header::default()
        }
    }

    use TruthKind::{AuthorityApplied as Applied, AuthorityLate as Late, MessageStale as Stale};

    #[test]
    fn what_comes_in_time_and_in_turn_is_no_event() {
        let mut diary = Diary::default();
        diary.send(0, 1).take(20, Applied, 1);
        diary.send(1_000, 2).take(1_020, Applied, 2);
        diary.send(2_000, 2).take(2_020, Stale, 2);
        diary.send(3_000, 3).take(3_020, Applied, 3);
        assert_eq!(diary.told(), []);
    }

    #[test]
    fn a_number_never_taken_is_named_with_every_copy_of_it() {
        let mut diary = Diary::default();
        diary.send(0, 1).take(20, Applied, 1);
        diary.send(1_000, 2).send(2_000, 3).send(3_000, 4);
        diary.take(3_020, Applied, 4).send(4_000, 4);
        let what = "robot 2 of fleet 1 took no authorities 2 to 3 of mission 3 before 4";
        assert_eq!(diary.told(), [(what.to_owned(), vec![1, 2, 3])]);
    }

    #[test]
    fn a_repeat_that_had_to_be_waited_for_is_named_with_the_copies_before() {
        let mut diary = Diary::default();
        diary.send(0, 1).send(1_000, 1).send(2_000, 1);
        diary.take(2_020, Applied, 1).send(3_000, 1);
        let what = "robot 2 of fleet 1 took authority 1 of mission 3 2.02 s after it was first \
                    sent, 2 copies before";
        assert_eq!(diary.told(), [(what.to_owned(), vec![0, 1, 2])]);
        // Without a common clock nobody can say how long it took.
        diary.log.set_clocks_differ();
        assert_eq!(diary.told(), []);
    }

    #[test]
    fn a_mission_that_had_to_be_repeated_is_named() {
        let mut diary = Diary::default();
        let mission = Mission {
            header: header(),
            ..Mission::default()
        };
        diary.publish(FLEET_MISSION, 0, &mission);
        diary.publish(FLEET_MISSION, 1_000, &mission);
        diary.take(1_010, TruthKind::MissionStarted, 0);
        let what =
            "robot 2 of fleet 1 began mission 3 1.01 s after it was first sent, 1 copy before";
        assert_eq!(diary.told(), [(what.to_owned(), vec![0, 1])]);
    }

    #[test]
    fn an_authority_too_late_to_keep_is_told_with_the_ones_before_that_never_came() {
        let mut diary = Diary::default();
        diary.send(0, 1).take(20, Applied, 1).send(1_000, 2);
        diary.send(2_000, 3).take(2_900, Late, 3);
        let what = "robot 2 of fleet 1 could not stop at authority 3 of mission 3 any more and \
                    went past";
        assert_eq!(diary.told(), [(what.to_owned(), vec![1, 2])]);
    }

    #[test]
    fn an_incident_names_what_each_robot_took_last_and_what_it_was_sent_after() {
        let mut diary = Diary::default();
        diary
            .send(0, 1)
            .take(20, Applied, 1)
            .send(1_000, 2)
            .send(9_000, 3);
        let seen = Incident {
            at: Instant::from_ns(5_000 * MS),
            kind: IncidentKind::Overlap,
            fleet_id: 1,
            robots: [2, 4],
            mission_ids: [3, 1],
            position_m: [1.0, 2.0],
            causes: [
                Cause {
                    kind: Applied as u32,
                    caused_by_sequence: 1,
                    at_ns: 20 * MS,
                },
                Cause::default(),
            ],
        };
        let events = events(&diary.log, &[seen]);
        let [event] = events.as_slice() else {
            panic!("{events:?}");
        };
        assert_eq!(event.severity, Severity::Incident);
        assert_eq!(event.clock_of, FLEET_TRUTH);
        let named: Vec<_> = event.messages.iter().map(|one| one.sequence).collect();
        assert_eq!(named, [0, 1], "the third was sent afterwards");
        assert!(event.messages.iter().all(|one| one.epoch == 5));
        let what =
            "robots 2 and 4 of fleet 1 overlapped in a critical section, at x 1.0 m, y 2.0 m";
        assert_eq!(event.what, what);
    }
}
