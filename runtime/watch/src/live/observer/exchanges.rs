//! What the gateways' exchanges say of two hosts' clocks while a run goes on.

use std::collections::BTreeMap;

use hil_clock::{ClockMap, ClockSettings, Exchange, Requester};
use hil_core::record::RoundTripRecord;

use super::Observer;
use hil_report::clock_summary::ClockRung;
use hil_topology::Topology;

impl Observer {
    /// How the clock of `from` relates to that of `to` by the exchanges of the last half minute;
    /// `None` without any.
    pub(crate) fn clock_map(&self, from: &str, to: &str) -> Option<ClockMap> {
        let exchanges = self.exchanges(from, to);
        let map = ClockMap::new(&exchanges, ClockSettings::default());
        map.figures().offset.is_some().then_some(map)
    }

    /// What figures between the two hosts rest on while the run goes on, in the words of a report. What
    /// daemons say of system clocks is asked at its end only, so that rung is none of these.
    pub(crate) fn clock_rung(&self, from: &str, to: &str) -> &'static str {
        if self.has_one_clock() {
            return ClockRung::OneClock.label();
        }
        if self.clock_map(from, to).is_none() {
            return ClockRung::None.label();
        }
        ClockRung::Exchanges.words(self.has_clock_path_exchanges(from, to))
    }

    fn has_clock_path_exchanges(&self, from: &str, to: &str) -> bool {
        let paths = self.topology().into_iter().flat_map(Topology::clock_paths);
        let mut of_pair = paths.filter(|path| {
            let ends = (path.from.name.as_str(), path.to.name.as_str());
            ends == (from, to) || ends == (to, from)
        });
        of_pair.any(|path| {
            let round_trips = self.round_trips.get(&path.name());
            round_trips.is_some_and(|found| !found.is_empty())
        })
    }

    fn exchanges(&self, from: &str, to: &str) -> Vec<Exchange> {
        let mut found = Vec::new();
        for (name, round_trips) in &self.round_trips {
            let Some((asks, answers)) = self.exchanging_hosts(name) else {
                continue;
            };
            // The host that is converted to is the local one.
            let requester = match (asks.as_str(), answers.as_str()) {
                pair if pair == (to, from) => Requester::Local,
                pair if pair == (from, to) => Requester::Remote,
                _ => continue,
            };
            // An exchange whose stamps were bettered later is there twice; the last one counts.
            let last: BTreeMap<(u32, u64), &RoundTripRecord> = round_trips
                .iter()
                .map(|one| ((one.session, one.sequence), one))
                .collect();
            found.extend(
                last.into_values()
                    .filter_map(|one| Exchange::of(one, requester)),
            );
        }
        found
    }

    /// The host that asks and the host that answers in the exchanges recorded as `name`: of a
    /// channel, whose sending gateway asks, or of a clock path.
    fn exchanging_hosts(&self, name: &str) -> Option<(String, String)> {
        if let Some(topology) = &self.topology {
            let clock_path = topology.clock_paths().find(|path| path.name() == name);
            if let Some(path) = clock_path {
                return Some((path.from.name.clone(), path.to.name.clone()));
            }
        }
        self.hosts_of(name)
    }
}
