//! The events of a recorded run: incidents the referee saw and commands the robots got late, not
//! at all or in vain, each with the messages behind it. What the network did to those messages is
//! not known here; whoever has the account of the channels shows it beside them.

use core::time::Duration;
use std::collections::BTreeMap;

use crate::case::{FLEET_AUTHORITY, FLEET_MISSION, FLEET_TRUTH};
use crate::messages::{Authority, Header, Mission, Truth, TruthKind};
use crate::referee::{Incident, IncidentKind};
use hil_core::case_study::{MessageRef, ScoreEvent, Severity};
use hil_core::message::Message;
use hil_core::run_log::RunLog;
use hil_core::time::Instant;

/// A command counts as held up when the copy that was taken left so long after the first. Repeats
/// come after a control period, a second, and replicas at once.
const HELD_UP_AFTER: Duration = Duration::from_millis(300);

/// A robot dates what it does to the moment it began to read its channels; a command may come in
/// while it reads, and so leave after its effect.
const READING: Duration = Duration::from_millis(20);

/// Copies of one command that an event names.
pub(crate) const COPIES_NAMED_MAX: usize = 4;

/// A command to a robot: an authority by its number, or with 0 the mission itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Key {
    fleet_id: u32,
    robot_id: u32,
    mission_id: u32,
    sequence: u32,
}

impl Key {
    fn of(to: &Header, sequence: u32) -> Self {
        Self {
            fleet_id: to.fleet_id,
            robot_id: to.robot_id,
            mission_id: to.mission_id,
            sequence,
        }
    }

    fn with(self, sequence: u32) -> Self {
        Self { sequence, ..self }
    }
}

/// The events of a run, in order of time. The log must hold the truth in its own order.
pub(crate) fn events(log: &RunLog, incidents: &[Incident]) -> Vec<ScoreEvent> {
    let mut robots = Robots::new(Orders::of(log));
    let mut found = Found::default();
    for (_, truth) in log.messages::<Truth>(FLEET_TRUTH) {
        robots.see(&truth, &mut found);
    }
    let orders = robots.orders;
    let Found { mut events, led_to } = found;
    events.extend(incidents.iter().map(|one| incident(one, &orders, &led_to)));
    events.sort_by_key(|event| event.at);
    events
}

/// What the robots' records tell beside what was sent to them.
#[derive(Debug, Default)]
pub(crate) struct Robots {
    orders: Orders,
    /// By fleet and robot.
    watches: BTreeMap<(u32, u32), Watch>,
}

impl Robots {
    const fn new(orders: Orders) -> Self {
        Self {
            orders,
            watches: BTreeMap::new(),
        }
    }

    fn see(&mut self, truth: &Truth, found: &mut Found) {
        let robot = (truth.fleet_id, truth.robot_id);
        let watch = self.watches.entry(robot).or_default();
        watch.see(truth, &self.orders, found);
    }

    /// The events of one more record.
    pub(crate) fn told(&mut self, truth: &Truth) -> Vec<ScoreEvent> {
        let mut found = Found::default();
        self.see(truth, &mut found);
        found.events
    }
}

/// What came of the robots' records.
#[derive(Debug, Default)]
struct Found {
    events: Vec<ScoreEvent>,
    /// By authority taken: its copies, and those of the numbers that should have come before it.
    led_to: BTreeMap<Key, Vec<Sent>>,
}

/// One sending of a command.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sent {
    pub(crate) message: MessageRef,
    pub(crate) at: Instant,
}

/// Everything the controller sent.
#[derive(Debug, Default)]
struct Orders {
    authorities: BTreeMap<Key, Vec<Sent>>,
    missions: BTreeMap<Key, Vec<Sent>>,
    /// Controller and robots read one clock, or theirs are aligned: their times compare.
    has_one_clock: bool,
    /// How much later than its effect a command may seem to have left.
    reading: Duration,
}

impl Orders {
    fn of(log: &RunLog) -> Self {
        let mut orders = Self {
            has_one_clock: log.has_one_clock(),
            reading: reading(log),
            ..Self::default()
        };
        for (sent, authority) in sent::<Authority>(log, FLEET_AUTHORITY) {
            let key = Key::of(&authority.header, authority.sequence);
            orders.authorities.entry(key).or_default().push(sent);
        }
        for (sent, mission) in sent::<Mission>(log, FLEET_MISSION) {
            let key = Key::of(&mission.header, 0);
            orders.missions.entry(key).or_default().push(sent);
        }
        orders
    }

    fn authority(&self, key: Key) -> &[Sent] {
        self.authorities.get(&key).map_or(&[], Vec::as_slice)
    }

    /// What was sent of a mission's authorities after `after` and below number `below`.
    fn between(&self, after: Key, below: u32) -> Vec<Sent> {
        let from = after.with(after.sequence.saturating_add(1));
        let to = after.with(below);
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
        let taken = copies.iter().rfind(|copy| copy.at <= at + self.reading)?;
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
        copies.retain(|sent| !self.has_one_clock || sent.at <= event.at + self.reading);
        copies.sort_by_key(|sent| sent.at);
        let copies = copies.iter().take(COPIES_NAMED_MAX);
        copies.fold(event, |event, sent| event.naming(sent.message))
    }
}

/// How much later than its effect a command of `log` may seem to have left.
pub(crate) fn reading(log: &RunLog) -> Duration {
    READING + Duration::from_nanos(log.clock_bound_ns())
}

/// The messages of a channel, each with when it was published.
pub(crate) fn sent<M: Message>(
    log: &RunLog,
    channel: &'static str,
) -> impl Iterator<Item = (Sent, M)> {
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
    /// When the robot began it, if its record says so.
    begun: Option<Instant>,
    heard: u32,
}

impl Watch {
    fn see(&mut self, truth: &Truth, orders: &Orders, found: &mut Found) {
        let Some(kind) = TruthKind::from_number(truth.kind) else {
            return;
        };
        if truth.mission_id != self.mission_id {
            self.mission_id = truth.mission_id;
            self.begun = (kind == TruthKind::MissionStarted).then(|| at(truth));
            self.heard = 0;
        }
        match kind {
            TruthKind::MissionStarted => found.events.extend(mission_held_up(truth, orders)),
            TruthKind::AuthorityApplied
            | TruthKind::AuthorityLate
            | TruthKind::AuthorityIgnored
            | TruthKind::AuthorityRefused => {
                let (event, sent) = self.hear(truth, kind, orders);
                found.events.extend(event);
                found.led_to.entry(key(truth)).or_insert(sent);
            }
            // A repeat of what it knows; a number that was sent for this mission counts as heard.
            TruthKind::MessageStale if !orders.authority(key(truth)).is_empty() => {
                self.heard = self.heard.max(truth.caused_by_sequence);
            }
            TruthKind::Replaced => found.events.push(replaced(truth)),
            TruthKind::Motion | TruthKind::MissionDone | TruthKind::MessageStale => {}
        }
    }

    /// One event at most per authority taken, the gravest that applies; and what led to it.
    fn hear(
        &mut self,
        truth: &Truth,
        kind: TruthKind,
        orders: &Orders,
    ) -> (Option<ScoreEvent>, Vec<Sent>) {
        let number = truth.caused_by_sequence;
        let before = self.heard;
        self.heard = before.max(number);
        let missed = orders.between(key(truth).with(before), number);
        let copies = orders.authority(key(truth));
        // What was sent before the robot had the mission had to wait for it, not for the network.
        let begun = self.begun.filter(|_| orders.has_one_clock);
        let since = copies.partition_point(|copy| begun.is_some_and(|begun| copy.at < begun));
        let copies = &copies[since..];
        let sent = [missed.as_slice(), copies].concat();
        let severity = severity_of(kind);
        let said = if severity == Severity::Notice && number <= before {
            None
        } else {
            let held_up = orders.held_up(copies, at(truth));
            words(truth, kind, held_up, before, !missed.is_empty())
        };
        let event = said.map(|what| orders.named(event(severity, truth, what), sent.clone()));
        (event, sent)
    }
}

/// What to say of an authority taken: how long it was held up, and the number heard before with
/// whether any between the two was sent. `None` when all is well.
fn words(
    truth: &Truth,
    kind: TruthKind,
    held_up: Option<(f64, usize)>,
    before: u32,
    has_missed: bool,
) -> Option<String> {
    let (who, number, mission) = (name(truth), truth.caused_by_sequence, truth.mission_id);
    let order = format!("authority {number} of mission {mission}");
    match (kind, held_up) {
        (TruthKind::AuthorityLate, _) => Some(format!(
            "{who} could not stop at {order} any more and went past"
        )),
        (TruthKind::AuthorityIgnored, _) => Some(format!(
            "{who} was past {order} already and drives on as before"
        )),
        (TruthKind::AuthorityRefused, _) => Some(format!(
            "{who} refused {order}: it cannot stop there any more"
        )),
        (_, Some((late_s, copy_count))) => {
            let copies = counted(copy_count, "copy", "copies");
            Some(format!(
                "{who} took {order} {late_s:.2} s after it was first sent, {copies} before"
            ))
        }
        _ if has_missed => {
            let first = before + 1;
            let numbers = if first + 1 == number {
                format!("authority {first}")
            } else {
                format!("authorities {first} to {}", number - 1)
            };
            Some(format!(
                "{who} took no {numbers} of mission {mission} before {number}"
            ))
        }
        _ => None,
    }
}

fn mission_held_up(truth: &Truth, orders: &Orders) -> Option<ScoreEvent> {
    let copies = orders.missions.get(&key(truth).with(0))?;
    let (late_s, copy_count) = orders.held_up(copies, at(truth))?;
    let what = format!(
        "{} began mission {} {late_s:.2} s after it was first sent, {} before",
        name(truth),
        truth.mission_id,
        counted(copy_count, "copy", "copies"),
    );
    Some(orders.named(notice(truth, what), copies.clone()))
}

fn replaced(truth: &Truth) -> ScoreEvent {
    let what = format!("{} was put at its goal to clear a stuck fleet", name(truth));
    event(Severity::Hazard, truth, what)
}

const fn severity_of(kind: TruthKind) -> Severity {
    match kind {
        TruthKind::AuthorityLate | TruthKind::AuthorityIgnored => Severity::Hazard,
        _ => Severity::Notice,
    }
}

/// An incident with, for each of the two robots, what led to the authority it last took and what
/// was sent to it after that.
fn incident(incident: &Incident, orders: &Orders, led_to: &BTreeMap<Key, Vec<Sent>>) -> ScoreEvent {
    let event = collision(incident);
    let sides = incident
        .robots
        .iter()
        .zip(incident.mission_ids)
        .zip(incident.causes);
    sides.fold(event, |event, ((robot, mission), cause)| {
        let taken = Key {
            fleet_id: incident.fleet_id,
            robot_id: *robot,
            mission_id: mission,
            sequence: cause.caused_by_sequence,
        };
        let last = led_to.get(&taken);
        let event = orders.named(event, last.cloned().unwrap_or_default());
        orders.named(event, orders.between(taken, u32::MAX))
    })
}

/// An incident alone.
pub(crate) fn collision(incident: &Incident) -> ScoreEvent {
    let manner = match incident.kind {
        IncidentKind::Section => "collided in their crossing section",
        IncidentKind::Overlap => "overlapped in a critical section",
        IncidentKind::Outside => "overlapped outside every critical section",
    };
    let [one, other] = incident.robots;
    let [x_m, y_m] = incident.position_m;
    let what = format!(
        "robots {one} and {other} of fleet {} {manner}, at x {x_m:.1} m, y {y_m:.1} m",
        incident.fleet_id
    );
    ScoreEvent::new(Severity::Incident, incident.at, FLEET_TRUTH, what)
}

fn event(severity: Severity, truth: &Truth, what: String) -> ScoreEvent {
    ScoreEvent::new(severity, at(truth), FLEET_TRUTH, what)
}

fn notice(truth: &Truth, what: String) -> ScoreEvent {
    event(Severity::Notice, truth, what)
}

fn key(truth: &Truth) -> Key {
    Key {
        fleet_id: truth.fleet_id,
        robot_id: truth.robot_id,
        mission_id: truth.mission_id,
        sequence: truth.caused_by_sequence,
    }
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
mod tests;
