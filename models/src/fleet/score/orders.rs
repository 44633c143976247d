//! Every order the controller gave, how often it was sent, and what its robot made of it. An order
//! is a sequence number of a mission's authority; its repeats carry the same number.

use core::time::Duration;
use std::collections::BTreeMap;

use crate::fleet::messages::{Authority, Truth, TruthKind};
use crate::fleet::{FLEET_AUTHORITY, FLEET_TRUTH};
use crate::run_log::RunLog;
use crate::score::{MessageRef, Metric, ScoreEvent, Severity};
use crate::time::Instant;

/// Which order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Key {
    pub(super) fleet_id: u32,
    pub(super) robot_id: u32,
    pub(super) mission_id: u32,
    pub(super) sequence: u32,
}

/// One order.
#[derive(Debug, Default)]
struct Order {
    /// When it was sent, on the controller's clock, and by which message.
    sent: Vec<(Instant, MessageRef)>,
    /// When the robot first heard it, on the robots' clock, and what it made of it.
    heard: Option<(Instant, TruthKind)>,
}

/// All orders of a run.
#[derive(Debug, Default)]
pub(super) struct Orders {
    orders: BTreeMap<Key, Order>,
    newest_sent: Instant,
}

/// Orders sent in the last so many nanoseconds of a run may still be on their way.
const MARGIN_NS: i64 = 2_000_000_000;

impl Orders {
    /// The orders a run's controller sent.
    pub(super) fn sent(log: &RunLog) -> Self {
        let mut orders = Self::default();
        for logged in log.raw(FLEET_AUTHORITY) {
            let Ok(authority) = bytemuck::try_pod_read_unaligned::<Authority>(&logged.payload)
            else {
                continue;
            };
            let header = authority.header;
            let key = Key {
                fleet_id: header.fleet_id,
                robot_id: header.robot_id,
                mission_id: header.mission_id,
                sequence: authority.sequence,
            };
            let at = Instant::from_ns(logged.envelope.published_ns);
            let message = MessageRef::of(FLEET_AUTHORITY, &logged.envelope);
            orders.newest_sent = orders.newest_sent.max(at);
            let order = orders.orders.entry(key).or_default();
            order.sent.push((at, message));
        }
        orders
    }

    /// Takes a record of the robots' truth.
    pub(super) fn heard(&mut self, record: &Truth) {
        let Some(kind) = TruthKind::of(record.kind) else {
            return;
        };
        let is_about_an_order = matches!(
            kind,
            TruthKind::AuthorityApplied
                | TruthKind::AuthorityLate
                | TruthKind::AuthorityIgnored
                | TruthKind::AuthorityRefused
                | TruthKind::MessageStale
        );
        if !is_about_an_order || record.caused_by_sequence == 0 {
            return;
        }
        let key = Key {
            fleet_id: record.fleet_id,
            robot_id: record.robot_id,
            mission_id: record.mission_id,
            sequence: record.caused_by_sequence,
        };
        if let Some(order) = self.orders.get_mut(&key) {
            let at = Instant::from_ns(record.at_ns);
            order.heard.get_or_insert((at, kind));
        }
    }

    /// The messages of the order `from` and of later ones of its mission, sent until `until`.
    pub(super) fn messages_from(
        &self,
        from: Key,
        until: Instant,
    ) -> impl Iterator<Item = MessageRef> + '_ {
        let last = Key {
            sequence: u32::MAX,
            ..from
        };
        let sent = self.orders.range(from..=last);
        sent.flat_map(|(_, order)| &order.sent)
            .filter(move |(at, _)| *at <= until)
            .map(|(_, message)| *message)
    }

    /// Orders no robot ever heard.
    pub(super) fn unheard_metric(&self) -> Metric {
        let unheard = self.unheard().count();
        let count = self.orders.len();
        Metric {
            name: "authorities_unheard_count",
            label: "orders their robot never heard",
            value: (count > 0).then_some(unheard as f64),
            interval: None,
            unit: "1",
            method: if count > 0 {
                format!("of {count} orders; those of the last 2 s left out")
            } else {
                "no order was sent".to_owned()
            },
        }
    }

    fn unheard(&self) -> impl Iterator<Item = (&Key, &Order)> {
        self.orders.iter().filter(|(_, order)| {
            let is_old = |at: Instant| self.newest_sent.ns_since(at) > MARGIN_NS;
            let (Some((first, _)), Some((last, _))) = (order.sent.first(), order.sent.last())
            else {
                return false;
            };
            order.heard.is_none() && is_old(*first) && is_old(*last)
        })
    }

    /// What a reader will want explained: orders late, ignored or refused, orders that took
    /// several sends or more than two control periods to be heard, and those never heard.
    pub(super) fn events(
        &self,
        control_period: Duration,
        has_one_clock: bool,
    ) -> impl Iterator<Item = ScoreEvent> + '_ {
        let judged = self
            .orders
            .iter()
            .filter_map(move |(key, order)| event_of(key, order, control_period, has_one_clock));
        let unheard = self.unheard().filter_map(|(key, order)| {
            let (at, _) = order.sent.first()?;
            let text = format!("{} was never heard", name_of(key));
            Some(naming(
                ScoreEvent::new(Severity::Notice, *at, FLEET_AUTHORITY, text),
                order,
            ))
        });
        judged.chain(unheard)
    }
}

fn event_of(
    key: &Key,
    order: &Order,
    control_period: Duration,
    has_one_clock: bool,
) -> Option<ScoreEvent> {
    let (at, kind) = order.heard?;
    let (first_sent, _) = order.sent.first()?;
    let what = match kind {
        TruthKind::AuthorityLate => "came too late to stop at",
        TruthKind::AuthorityIgnored => "came when the robot was past it, and was ignored",
        TruthKind::AuthorityRefused => "was refused: the robot could not stop there",
        _ => "was heard",
    };
    // Two clocks that are not aligned tell neither a delay nor which sends came before.
    let delay = has_one_clock.then(|| at.saturating_duration_since(*first_sent));
    let send_count = match delay {
        Some(_) => order.sent.iter().filter(|(sent, _)| *sent <= at).count(),
        None => order.sent.len(),
    };
    let is_slow = delay.is_some_and(|delay| delay > 2 * control_period);
    let is_plain = matches!(kind, TruthKind::AuthorityApplied | TruthKind::MessageStale);
    if is_plain && !is_slow && send_count < 2 {
        return None;
    }
    let mut text = format!("{} {what}", name_of(key));
    if let Some(delay) = delay {
        text.push_str(&format!(
            " {:.3} s after it was first sent",
            delay.as_secs_f64()
        ));
    }
    if send_count > 1 {
        text.push_str(&format!(", after {send_count} sends"));
    }
    let event = ScoreEvent::new(Severity::Notice, at, FLEET_TRUTH, text);
    Some(naming(event, order))
}

fn name_of(key: &Key) -> String {
    let Key {
        fleet_id,
        robot_id,
        mission_id,
        sequence,
    } = key;
    format!("order {sequence} of mission {mission_id} to robot {robot_id} of fleet {fleet_id}")
}

fn naming(event: ScoreEvent, order: &Order) -> ScoreEvent {
    let messages = order.sent.iter();
    messages.fold(event, |event, (_, message)| event.naming(*message))
}
