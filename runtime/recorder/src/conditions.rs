//! Conditions of emulated links that were changed by hand while a run went on, as topics. What an
//! order means is the models'; here it is put beside the messages that met it.

use std::collections::BTreeMap;

use hil_link::condition::{LinkCondition, LinkConditionRecord, OrderOutcome, flow_name};
use hil_link::spec::Way;
use serde_json::Value;

use crate::schema::own_message;
use crate::sink::{Sink, Topic};
use crate::topics::Names;
use crate::writer::Stamp;

own_message! {
    /// An order to one direction of a link and what became of it.
    pub(crate) struct OrderedCondition as "LinkCondition" {
        /// The gateway's count of orders, from 1 at each of its starts.
        number: uint64 = "1",
        /// What the order was called by whoever gave it.
        request: uint64 = "2",
        link: string = "3",
        /// `forward` or `backward`.
        direction: string = "4",
        /// `topology`, `fixed`, `cut`, or `unknown` to this version.
        condition: string = "5",
        /// Of a fixed condition, nanoseconds.
        delay_ns: optional uint64 = "6",
        /// Of a fixed condition, 0 to 1; of a cut 1.
        loss_ratio: optional double = "7",
        /// It took effect.
        is_in_force: bool = "8",
        /// Why it did not; empty where it did.
        refusal: string = "9",
        /// Messages that the gateway received from here on met it, on its host's monotonic clock.
        from_ns: int64 = "10",
        /// Messages received between `from_ns` and this may have met the one before.
        certain_ns: int64 = "11",
    }
}

impl OrderedCondition {
    fn of(link: &str, direction: Way, record: &LinkConditionRecord) -> Self {
        let (condition, delay_ns, loss_ratio) = match record.condition() {
            Some(LinkCondition::Topology) => ("topology", None, None),
            Some(LinkCondition::Fixed { loss_ratio, .. }) => {
                ("fixed", Some(record.delay_ns), Some(loss_ratio))
            }
            Some(LinkCondition::Cut) => ("cut", None, Some(1.0)),
            None => ("unknown", None, None),
        };
        let outcome = record.outcome();
        let refusal = outcome.map_or("an outcome unknown to this version", OrderOutcome::words);
        Self {
            number: record.number,
            request: record.request,
            link: link.to_owned(),
            direction: direction.word().to_owned(),
            condition: condition.to_owned(),
            delay_ns,
            loss_ratio,
            is_in_force: outcome == Some(OrderOutcome::InForce),
            refusal: refusal.to_owned(),
            from_ns: record.from_ns,
            certain_ns: record.certain_ns,
        }
    }
}

/// The topics of all links, one per direction that was given an order.
#[derive(Debug, Default)]
pub(crate) struct Conditions {
    /// By the name under which orders are recorded.
    directions: BTreeMap<String, Direction>,
}

#[derive(Debug)]
struct Direction {
    link: String,
    way: Way,
    /// Of the gateway that emulates it.
    host: String,
    topic: Topic,
}

impl Conditions {
    /// Of the links of `topology`, as a manifest has it.
    pub(crate) fn of(topology: &Value, names: &mut Names) -> Self {
        let mut directions = BTreeMap::new();
        let links = topology["links"].as_object().into_iter().flatten();
        for (link, described) in links.filter(|(_, one)| one["via"] == "emulated") {
            // A gateway emulates the direction that ends at its host.
            for (way, end) in [(Way::Forward, 1), (Way::Backward, 0)] {
                let host = described["between"][end].as_str().unwrap_or_default();
                let name = names.claim(format!("/net/{link}/{way}/condition"));
                let metadata = [("link", link.as_str()), ("direction", way.word())];
                let direction = Direction {
                    link: link.clone(),
                    way,
                    host: host.to_owned(),
                    topic: Topic::new(name, OrderedCondition::schema(), &metadata),
                };
                directions.insert(flow_name(link, way), direction);
            }
        }
        Self { directions }
    }

    /// The host of the gateway that wrote the orders recorded under `channel`.
    pub(crate) fn host_of(&self, channel: &str) -> Option<&str> {
        Some(&self.directions.get(channel)?.host)
    }

    /// Lets `sink` hear now of the topic of orders recorded under `channel`.
    ///
    /// # Errors
    /// When it has no room for it.
    pub(crate) fn declare<S: Sink>(&mut self, channel: &str, sink: &mut S) -> Result<(), S::Error> {
        if let Some(direction) = self.directions.get_mut(channel) {
            direction.topic.declare(sink)?;
        }
        Ok(())
    }

    /// Writes an order recorded under `channel`, in force from `at_ns` of the recording's axis.
    ///
    /// # Errors
    /// When the sink cannot take it.
    pub(crate) fn write<S: Sink>(
        &mut self,
        channel: &str,
        at_ns: u64,
        record: &LinkConditionRecord,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        let Some(direction) = self.directions.get_mut(channel) else {
            return Ok(());
        };
        let ordered = OrderedCondition::of(&direction.link, direction.way, record);
        let at = Stamp::new(at_ns, record.number);
        direction.topic.put(sink, at, &ordered)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;
    use serde_json::json;

    #[test]
    fn an_order_says_what_it_asked_for_and_why_it_was_refused() {
        let mut record = LinkConditionRecord::zeroed();
        (record.kind, record.delay_ns, record.loss_ratio) = (1, 40_000_000, 0.2);
        let ordered = OrderedCondition::of("hop", Way::Forward, &record);
        assert_eq!(
            (ordered.condition.as_str(), ordered.is_in_force),
            ("fixed", true)
        );
        assert_eq!(
            (ordered.delay_ns, ordered.loss_ratio),
            (Some(40_000_000), Some(0.2))
        );
        (record.kind, record.outcome) = (2, 2);
        let ordered = OrderedCondition::of("hop", Way::Forward, &record);
        assert_eq!(
            (ordered.condition.as_str(), ordered.loss_ratio),
            ("cut", Some(1.0))
        );
        assert!(!ordered.is_in_force && ordered.refusal.contains("too little room"));
        (record.kind, record.outcome) = (9, 9);
        let ordered = OrderedCondition::of("hop", Way::Forward, &record);
        assert_eq!(ordered.condition, "unknown");
        assert!(!ordered.is_in_force && !ordered.refusal.is_empty());
    }

    #[test]
    fn the_gateway_of_a_direction_is_at_its_end() {
        let topology = json!({ "links": {
            "hop": { "via": "emulated", "between": ["a", "b"] },
            "wire": { "via": "udp", "between": ["a", "b"] },
        } });
        let conditions = Conditions::of(&topology, &mut Names::default());
        assert_eq!(conditions.host_of("hil/link/hop/forward"), Some("b"));
        assert_eq!(conditions.host_of("hil/link/hop/backward"), Some("a"));
        assert_eq!(conditions.host_of("hil/link/wire/forward"), None);
    }
}
