//! Orders to emulated links, from the gateways' records to the report: put on the axis of the run. The
//! fates of messages are not touched: each is on record by itself.

use std::collections::BTreeMap;
use std::time::Duration;

use hil_core::time::Instant;
use hil_link::condition::{LinkCondition, LinkConditionRecord, OrderOutcome, flow_name};
use hil_link::spec::Way;

use super::axis::RunAxis;
use super::records::RunRecords;
use crate::link_change::LinkChange;
use hil_topology::emulation::EmulationLaunch;
use hil_topology::{Crossing, Topology};

/// Every order that was given to a link of the run, in order of time.
pub(super) fn of_run(records: &RunRecords<'_>, axis: &RunAxis<'_>) -> Vec<LinkChange> {
    let topology = records.topology;
    let mut directions: BTreeMap<String, (String, Way, String)> = BTreeMap::new();
    for crossing in topology.crossings() {
        if let Some((channel, way)) = channel_of(topology, &crossing) {
            let host = crossing.to_host.name.clone();
            directions.insert(channel, (crossing.link.name.clone(), way, host));
        }
    }
    let mut changes = Vec::new();
    for (channel, (link, way, host)) in &directions {
        for record in records.link_orders(channel) {
            let at_s = axis.place_s(host, Instant::from_ns(record.from_ns));
            changes.push(LinkChange::of(link, *way, record, at_s));
        }
    }
    let time = |change: &LinkChange| change.at_s.unwrap_or(f64::MAX);
    changes.sort_by(|a, b| time(a).total_cmp(&time(b)));
    changes
}

fn channel_of(topology: &Topology, crossing: &Crossing<'_>) -> Option<(String, Way)> {
    let emulation = EmulationLaunch::of(crossing, topology.run().seed)?;
    Some((flow_name(&emulation.link, emulation.way), emulation.way))
}

/// Orders to the direction that `crossing` goes, which took effect.
pub(crate) fn in_force_on<'a>(
    records: &'a RunRecords<'_>,
    crossing: &Crossing<'_>,
) -> impl Iterator<Item = &'a LinkConditionRecord> {
    let channel = channel_of(records.topology, crossing).map(|(channel, _)| channel);
    let orders = channel.map_or(&[][..], |channel| records.link_orders(&channel));
    let is_in_force =
        |record: &&LinkConditionRecord| record.outcome() == Some(OrderOutcome::InForce);
    orders.iter().filter(is_in_force)
}

/// The longest delay that the direction of `crossing` was changed to; zero when it was not.
pub(super) fn longest_delay(records: &RunRecords<'_>, crossing: &Crossing<'_>) -> Duration {
    let delays = in_force_on(records, crossing)
        .filter_map(LinkConditionRecord::condition)
        .map(LinkCondition::delay);
    delays.max().unwrap_or(Duration::ZERO)
}
