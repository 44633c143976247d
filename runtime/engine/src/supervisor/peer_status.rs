//! What the hosts of a run tell each other of the ticks that passed without their processes, while it
//! goes on: for whoever looks on. It decides nothing, and no gateway knows of it. A host that is not
//! heard is known by when it was, never by a zero.

use hil_core::time::Instant;
use serde::{Deserialize, Serialize};
use std::cmp::Reverse;
use std::collections::BTreeMap;

use super::frame::PeerMessage;
use super::process_group::ManagedProcess;
use hil_rundir::status::{HostStatus, TickStatus};
use hil_topology::{Host, Topology};

/// As many processes of a host are told of, those that skipped most: about 6 KB.
const PROCESSES_MAX: usize = 64;
/// As many hosts are told of in one message; one beyond is not heard, and shown so.
const HOSTS_MAX: usize = 16;

/// Skipped ticks of the processes of one host, as they travel.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct HostTicks {
    /// Its name in the topology.
    pub host: String,
    /// How long ago the host said so; 0 when it says it itself.
    pub age_ms: u64,
    /// By process, the most skipped first; no more than fit.
    pub processes: Vec<(String, Option<u64>)>,
    /// Processes that skipped some and found no room above.
    pub left_out_count: usize,
}

impl HostTicks {
    /// Those of `host` as of now, from what its processes said last.
    fn new(host: &str, processes: impl Iterator<Item = (String, Option<u64>)>) -> Self {
        let mut processes: Vec<_> = processes.collect();
        processes.sort_by_key(|(_, count)| Reverse(*count));
        let beyond = processes.iter().skip(PROCESSES_MAX);
        let left_out_count = beyond.filter(|(_, count)| *count > Some(0)).count();
        processes.truncate(PROCESSES_MAX);
        Self {
            host: host.to_owned(),
            age_ms: 0,
            processes,
            left_out_count,
        }
    }
}

/// Those of each of the hosts here. Only processes of the topology have ticks; gateways have none.
pub(super) fn own_ticks(hosts: &[String], members: &[ManagedProcess]) -> Vec<HostTicks> {
    let of_host = |host: &String| {
        let members = members.iter().filter(|one| one.plan.host == *host);
        let timed = members.filter(|one| one.plan.is_component());
        let said = timed.map(|one| (one.plan.name.clone(), one.skipped_tick_count));
        HostTicks::new(host, said)
    };
    hosts.iter().map(of_host).collect()
}

/// What a peer is told of `ticks` while the run goes on: those of other hosts than its own, in place of
/// a word that this one lives. A peer that is not heard may not be reached; what it is told piles up in
/// the connection, which is lost when it takes no more, so it is told the least.
pub(super) fn greeting(ticks: &[HostTicks], peer: &str, is_heard: bool) -> PeerMessage {
    if !is_heard {
        return PeerMessage::Alive;
    }
    let others = ticks.iter().filter(|ticks| ticks.host != peer);
    PeerMessage::Ticks(others.cloned().collect())
}

/// What the other hosts said last.
#[derive(Debug)]
pub(super) struct PeerStatus {
    /// The first host speaks for all it knows of, the others for themselves: they meet nobody else.
    first_host: String,
    /// By host, and since when it is known.
    hosts: BTreeMap<String, Option<(Instant, HostTicks)>>,
    /// Names that the topology gives its processes, by host.
    processes: BTreeMap<String, Vec<String>>,
}

impl PeerStatus {
    /// Of the hosts of `topology` that are not among `here`.
    pub(super) fn new(topology: &Topology, here: &[&Host]) -> Self {
        let all = topology.hosts().iter();
        let others = all.filter(|host| here.iter().all(|here| here.name != host.name));
        let others: Vec<&str> = others.map(|host| host.name.as_str()).collect();
        let named = |host: &&str| {
            let processes = topology.processes_on(host);
            let names = processes.map(|process| process.name.clone());
            ((*host).to_owned(), names.collect())
        };
        Self {
            first_host: topology.hosts()[0].name.clone(),
            hosts: others
                .iter()
                .map(|host| ((*host).to_owned(), None))
                .collect(),
            processes: others.iter().map(named).collect(),
        }
    }

    /// Takes down what the supervisor of `from` said at `now`. What it cannot know, or the topology
    /// does not name, is left: it cannot make this grow.
    pub(super) fn hear(&mut self, from: &str, said: Vec<HostTicks>, now: Instant) {
        for mut ticks in said.into_iter().take(HOSTS_MAX) {
            let may_say = from == ticks.host || from == self.first_host;
            let (Some(known), Some(names), true) = (
                self.hosts.get_mut(&ticks.host),
                self.processes.get(&ticks.host),
                may_say,
            ) else {
                continue;
            };
            ticks.processes.truncate(PROCESSES_MAX);
            ticks.processes.retain(|(name, _)| names.contains(name));
            let age_ns = i64::try_from(ticks.age_ms.saturating_mul(1_000_000)).unwrap_or(i64::MAX);
            let heard = Instant::from_ns(now.as_ns().saturating_sub(age_ns));
            *known = Some((heard, ticks));
        }
    }

    /// What to tell the others at `now`: `own`, of the hosts here, and on the first host of those
    /// that were heard.
    pub(super) fn told(&self, own: Vec<HostTicks>, now: Instant) -> Vec<HostTicks> {
        let relays = own.iter().any(|one| one.host == self.first_host);
        let heard = self.hosts.values().flatten().filter(|_| relays);
        let heard = heard.map(|(at, ticks)| {
            let age = now.saturating_duration_since(*at);
            let age_ms = u64::try_from(age.as_millis()).unwrap_or(u64::MAX);
            HostTicks {
                age_ms,
                ..ticks.clone()
            }
        });
        own.into_iter().chain(heard).take(HOSTS_MAX).collect()
    }

    /// All other hosts, heard or not, as `status.json` has them.
    pub(super) fn status(&self) -> Vec<HostStatus> {
        let hosts = self.hosts.iter().map(|(host, heard)| HostStatus {
            name: host.clone(),
            heard_ns: heard.as_ref().map(|(at, _)| at.as_ns()),
            processes: heard.iter().flat_map(|(_, ticks)| ticked(ticks)).collect(),
            left_out_count: heard.as_ref().map_or(0, |(_, ticks)| ticks.left_out_count),
        });
        hosts.collect()
    }
}

fn ticked(ticks: &HostTicks) -> impl Iterator<Item = TickStatus> {
    ticks.processes.iter().map(|(name, count)| TickStatus {
        name: name.clone(),
        skipped_tick_count: *count,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(host: &str, skipped_count: u64) -> HostTicks {
        HostTicks::new(host, [("p".to_owned(), Some(skipped_count))].into_iter())
    }

    /// At a host of three, which may be the first.
    fn at(first_host: &str, others: [&str; 2]) -> PeerStatus {
        PeerStatus {
            first_host: first_host.to_owned(),
            hosts: others.map(|host| (host.to_owned(), None)).into(),
            processes: others
                .map(|host| (host.to_owned(), vec!["p".to_owned()]))
                .into(),
        }
    }

    fn counts(elsewhere: &PeerStatus) -> Vec<(String, Option<i64>, Option<u64>)> {
        let hosts = elsewhere.status().into_iter();
        let counts = hosts.map(|one| {
            let count = one.processes.first().and_then(|one| one.skipped_tick_count);
            (one.name, one.heard_ns, count)
        });
        counts.collect()
    }

    #[test]
    fn the_first_host_hands_on_what_it_heard_with_its_age() {
        let ms = |ms: i64| Instant::from_ns(ms * 1_000_000);
        let mut first = at("a", ["b", "c"]);
        first.hear("b", vec![of("b", 5)], ms(100));
        let told = first.told(vec![of("a", 1)], ms(400));
        let ages: Vec<_> = told
            .iter()
            .map(|one| (one.host.as_str(), one.age_ms))
            .collect();
        assert_eq!(ages, [("a", 0), ("b", 300)]);
        let mut other = at("a", ["a", "b"]);
        other.hear("a", told, ms(7000));
        let expected = [
            ("a".to_owned(), Some(7_000_000_000), Some(1)),
            ("b".to_owned(), Some(6_700_000_000), Some(5)),
        ];
        assert_eq!(counts(&other), expected);
        let own = other.told(vec![of("c", 2)], ms(7000));
        assert_eq!(own, [of("c", 2)], "only the first host hands on");
    }

    #[test]
    fn a_host_that_was_not_heard_has_no_figure_and_nobody_speaks_for_another() {
        let mut first = at("a", ["b", "c"]);
        let now = Instant::from_ns(9);
        first.hear("b", vec![of("c", 3), of("a", 3), of("nobody", 3)], now);
        let unheard = ["b", "c"].map(|host| (host.to_owned(), None, None));
        assert_eq!(counts(&first), unheard);
        let mut many = of("b", 4);
        let stranger = |index| (format!("stranger-{index}"), Some(9));
        many.processes.splice(0..0, (0..10).map(stranger));
        many.processes.extend((10..100_000).map(stranger));
        many.age_ms = u64::MAX;
        first.hear("b", vec![many], now);
        let known = first.status();
        let names: Vec<_> = known[0].processes.iter().map(|one| &*one.name).collect();
        assert_eq!(names, ["p"], "names that the topology has");
        assert!(known[0].heard_ns < Some(0), "older than this host's clock");
    }

    #[test]
    fn a_peer_is_told_of_the_others_and_an_unheard_one_the_least() {
        let ticks = [of("a", 1), of("b", 2)];
        let told = PeerMessage::Ticks(vec![of("a", 1)]);
        assert_eq!(greeting(&ticks, "b", true), told);
        assert_eq!(greeting(&ticks, "b", false), PeerMessage::Alive);
    }

    #[test]
    fn those_that_skipped_most_are_told_and_the_others_counted() {
        let count = |index: u64| if index < 100 { Some(index) } else { None };
        let processes = (0..200_u64).map(|index| (format!("p{index}"), count(index)));
        let ticks = HostTicks::new("a", processes);
        assert_eq!(ticks.processes.len(), PROCESSES_MAX);
        assert_eq!(ticks.processes[0], ("p99".to_owned(), Some(99)));
        // 99 skipped some, 64 of them are told.
        assert_eq!(ticks.left_out_count, 35);
    }
}
