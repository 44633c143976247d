//! What the emulated links of a running run do to its messages at present: by its topology, and by
//! the orders that were given to them while it goes. Only gateways of this host tell of orders here.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::Path;
use std::time::Duration;

use hil_account::FLIGHT_QUANTILE;
use hil_core::time::duration_ns;
use hil_link::condition::{LinkCondition, LinkConditionRecord, OrderOutcome, flow_name};
use hil_link::spec::Way;

use hil_platform::clock::MonotonicClock;
use hil_rundir::link_orders::{in_force, orders_on_record};
use hil_rundir::record::RecordFileError;
use hil_topology::Topology;
use hil_topology::emulation::EmulationLaunch;

/// A delay that was taken back counts for so long after its last message came: until all who met
/// that message have written it down.
const AFTERWARDS: Duration = Duration::from_secs(1);

/// The emulated links of one run.
#[derive(Debug, Default)]
pub(crate) struct LinkConditions {
    /// How long messages are kept under way on purpose, by channel.
    flights: BTreeMap<String, Flight>,
    /// What became of the orders to each direction, by the channel they travel on, in the order of
    /// the gateway's count.
    orders: BTreeMap<String, Vec<LinkConditionRecord>>,
}

#[derive(Debug)]
struct Flight {
    by_topology: Duration,
    /// The channel of the orders to its direction.
    orders: String,
}

impl LinkConditions {
    /// Those of `topology`, as if nobody had given an order.
    pub(crate) fn of(topology: &Topology) -> Self {
        let flights = topology.crossings().filter_map(|crossing| {
            let emulation = EmulationLaunch::of(&crossing, topology.run().seed)?;
            let flight = Flight {
                // Of a trace that cannot be read here nothing is known.
                by_topology: emulation.flight_time(FLIGHT_QUANTILE).unwrap_or_default(),
                orders: flow_name(&emulation.link, emulation.way),
            };
            Some((crossing.channel.name.clone(), flight))
        });
        Self {
            flights: flights.collect(),
            orders: BTreeMap::new(),
        }
    }

    /// Takes in the orders on record in the folder `records`; gives what could not be read.
    pub(crate) fn read(&mut self, records: &Path) -> Vec<String> {
        let channels = self.flights.values().map(|flight| flight.orders.clone());
        let channels: BTreeSet<String> = channels.collect();
        let mut problems = Vec::new();
        for channel in channels {
            match orders_on_record(records, &channel) {
                Ok(orders) => self.add(&channel, orders),
                // Nothing is on record yet.
                Err(RecordFileError::Io { source, .. })
                    if source.kind() == io::ErrorKind::NotFound => {}
                Err(error) => {
                    problems.push(format!("earlier changes of links are not known: {error}"));
                }
            }
        }
        problems
    }

    /// Takes in `orders` to the direction whose orders travel on `channel`.
    pub(crate) fn add(
        &mut self,
        channel: &str,
        orders: impl IntoIterator<Item = LinkConditionRecord>,
    ) {
        let known = self.orders.entry(channel.to_owned()).or_default();
        for order in orders {
            let is_same = |one: &LinkConditionRecord| {
                (one.number, one.from_ns) == (order.number, order.from_ns)
            };
            if !known.iter().any(is_same) {
                known.push(order);
            }
        }
        known.sort_by_key(|order| order.number);
    }

    /// What the direction `way` of `link` was ordered to do, as far as this host knows.
    pub(crate) fn now(&self, link: &str, way: Way) -> LinkCondition {
        let orders = self.orders.get(&flow_name(link, way));
        orders.map_or(LinkCondition::Topology, |orders| in_force(orders).0)
    }

    /// How long messages of `channel` are under way at most, as things stand.
    pub(crate) fn flight_time(&self, channel: &str) -> Duration {
        self.flights
            .get(channel)
            .map_or(Duration::ZERO, |flight| self.longest(flight))
    }

    /// As [`Self::flight_time`], of the slowest channel.
    pub(crate) fn longest_flight_time(&self) -> Duration {
        let all = self.flights.values().map(|flight| self.longest(flight));
        all.max().unwrap_or_default()
    }

    fn longest(&self, flight: &Flight) -> Duration {
        let orders = self.orders.get(&flight.orders);
        let ordered = orders.map_or(Duration::ZERO, |orders| {
            longest_delay(orders, MonotonicClock::now().as_ns())
        });
        flight.by_topology.max(ordered)
    }
}

/// The longest delay that `orders` gave to messages which may still be under way at `now_ns`.
fn longest_delay(orders: &[LinkConditionRecord], now_ns: i64) -> Duration {
    let is_in_force = |order: &&LinkConditionRecord| order.outcome() == Some(OrderOutcome::InForce);
    let orders: Vec<&LinkConditionRecord> = orders.iter().filter(is_in_force).collect();
    let delays = orders.iter().enumerate().filter_map(|(place, order)| {
        let delay = order.condition()?.delay();
        let is_past = orders.get(place + 1).is_some_and(|next| {
            let last_ns = duration_ns(delay.saturating_add(AFTERWARDS));
            next.certain_ns.saturating_add(last_ns) < now_ns
        });
        (!is_past).then_some(delay)
    });
    delays.max().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_link::condition::LinkChangeRequest;

    const MS: i64 = 1_000_000;

    fn record(number: u64, from_ns: i64, condition: LinkCondition) -> LinkConditionRecord {
        let order = LinkChangeRequest::new(condition, number);
        LinkConditionRecord {
            number,
            request: number,
            from_ns,
            certain_ns: from_ns,
            delay_ns: order.delay_ns,
            loss_ratio: order.loss_ratio,
            kind: order.kind,
            outcome: OrderOutcome::InForce.number(),
        }
    }

    fn slow() -> LinkCondition {
        LinkCondition::Fixed {
            delay: Duration::from_millis(800),
            loss_ratio: 0.0,
        }
    }

    #[test]
    fn a_delay_counts_until_its_last_message_has_come() {
        let delay = Duration::from_millis(800);
        let mut orders = vec![record(1, 100 * MS, slow())];
        assert_eq!(longest_delay(&orders, 90_000 * MS), delay);
        orders.push(record(2, 5_000 * MS, LinkCondition::Topology));
        assert_eq!(longest_delay(&orders, 6_000 * MS), delay);
        assert_eq!(longest_delay(&orders, 7_000 * MS), Duration::ZERO);
        orders[0].outcome = OrderOutcome::NoRoom.number();
        assert_eq!(longest_delay(&orders, 6_000 * MS), Duration::ZERO);
    }

    #[test]
    fn an_order_that_is_read_twice_counts_once_and_the_last_one_holds() {
        let channel = flow_name("hop", Way::Forward);
        let mut conditions = LinkConditions::default();
        conditions.add(&channel, [record(2, 2 * MS, LinkCondition::Cut)]);
        conditions.add(
            &channel,
            [record(1, MS, slow()), record(2, 2 * MS, LinkCondition::Cut)],
        );
        assert_eq!(conditions.orders[&channel].len(), 2);
        assert_eq!(conditions.now("hop", Way::Forward), LinkCondition::Cut);
        assert_eq!(
            conditions.now("hop", Way::Backward),
            LinkCondition::Topology
        );
    }
}
