//! Clock paths: the addresses over which two hosts exchange clocks beside the link under test.
//! Checked and paired here; nothing is opened.

use std::collections::BTreeSet;
use std::net::{IpAddr, SocketAddr};

use super::checks::Checks;
use super::errors::Fault;
use super::model::{Host, Topology};
use super::tree::join;
use crate::CHANNEL_NAME_BYTES_MAX;

/// Where a host exchanges clocks, beside the address of the link under test.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ClockEnd {
    /// Its own address on the clock path.
    pub address: IpAddr,
    /// Interface to bind to, when named.
    pub interface: Option<String>,
    /// UDP port of the host's first clock path; each further one takes the next.
    pub port: u16,
}

/// Clock exchanges between two hosts, over addresses of their own.
#[derive(Debug, Clone, Copy)]
pub struct ClockPath<'a> {
    /// Its number among all of them.
    pub index: u16,
    /// The host that asks; the first of the two by name.
    pub from: &'a Host,
    /// The host that answers.
    pub to: &'a Host,
    /// Where the one that asks is.
    pub asking: SocketAddr,
    /// Where the one that answers is.
    pub answering: SocketAddr,
}

impl ClockPath<'_> {
    /// Name in records: `clock/<host>-<host>`.
    pub fn name(&self) -> String {
        name_of(&self.from.name, &self.to.name)
    }

    /// Number in datagrams: counted down from the top, where no channel's is.
    pub const fn flow_number(&self) -> u16 {
        u16::MAX - self.index
    }

    /// `clock path 10.78.0.1 (eth1) <-> 10.78.0.2 (eth1)`.
    pub fn describe(&self) -> String {
        let end = |host: &Host, address: &SocketAddr| {
            describe_end(&address.ip().to_string(), host.clock_interface.as_deref())
        };
        let (from, to) = (end(self.from, &self.asking), end(self.to, &self.answering));
        format!("clock path {from} <-> {to}")
    }
}

/// `10.78.0.1 (eth1)`.
pub fn describe_end(address: &str, interface: Option<&str>) -> String {
    interface.map_or_else(
        || address.to_owned(),
        |interface| format!("{address} ({interface})"),
    )
}

fn name_of(from: &str, to: &str) -> String {
    format!("clock/{from}-{to}")
}

/// Name of the process on `host` at the end of a clock path to `other`.
pub(crate) fn end_name(host: &str, other: &str) -> String {
    format!("clock-{other}-{host}")
}

fn ends_of(one: &str, other: &str) -> [String; 2] {
    [end_name(one, other), end_name(other, one)]
}

impl Topology {
    /// The clock paths: one for every two hosts with a clock address that a link with gateways joins.
    pub fn clock_paths(&self) -> impl Iterator<Item = ClockPath<'_>> {
        let pairs = self.clock_pairs();
        let mut paths = Vec::new();
        for (index, (from, to)) in pairs.iter().enumerate() {
            let before = &pairs[..index];
            let ends = end_of(from, before).zip(end_of(to, before));
            // Neither happens in a checked topology.
            if let (Some((asking, answering)), Ok(index)) = (ends, u16::try_from(index)) {
                paths.push(ClockPath {
                    index,
                    from,
                    to,
                    asking,
                    answering,
                });
            }
        }
        paths.into_iter()
    }

    /// The clock path between two hosts, in whichever order.
    pub fn clock_path_between(&self, one: &str, other: &str) -> Option<ClockPath<'_>> {
        let is_it = |path: &ClockPath<'_>| {
            let ends = (path.from.name.as_str(), path.to.name.as_str());
            ends == (one, other) || ends == (other, one)
        };
        self.clock_paths().find(is_it)
    }

    /// Hosts that a link with gateways joins, by name, the first of each pair first.
    fn linked_pairs(&self) -> BTreeSet<(&str, &str)> {
        let pairs = self.crossings().map(|crossing| {
            let (one, other) = (&crossing.from_host.name, &crossing.to_host.name);
            (one.min(other).as_str(), one.max(other).as_str())
        });
        pairs.collect()
    }

    /// Two other hosts whose clock path has a name or a process in common with that of these.
    fn namesake(&self, from: &Host, to: &Host) -> Option<(&str, &str)> {
        let own = (name_of(&from.name, &to.name), ends_of(&from.name, &to.name));
        let pairs = self.clock_pairs().into_iter();
        let mut others = pairs
            .map(|(one, two)| (one.name.as_str(), two.name.as_str()))
            .filter(|pair| *pair != (from.name.as_str(), to.name.as_str()));
        others.find(|(one, two)| {
            let ends = ends_of(one, two);
            name_of(one, two) == own.0 || ends.iter().any(|end| own.1.contains(end))
        })
    }

    fn clock_pairs(&self) -> Vec<(&Host, &Host)> {
        let pairs = self.linked_pairs().into_iter();
        let hosts = pairs.filter_map(|(one, other)| self.host(one).zip(self.host(other)));
        hosts
            .filter(|(one, other)| one.clock_address.is_some() && other.clock_address.is_some())
            .collect()
    }
}

/// Where `host` is on the clock path that follows those of `before`.
fn end_of(host: &Host, before: &[(&Host, &Host)]) -> Option<SocketAddr> {
    let end = host.clock()?;
    let is_own = |(one, other): &&(&Host, &Host)| one.name == host.name || other.name == host.name;
    let offset = u16::try_from(before.iter().filter(is_own).count()).ok()?;
    Some(SocketAddr::new(end.address, end.port.checked_add(offset)?))
}

/// Checks the clock addresses against each other and against what the links use.
pub(super) fn check(topology: &Topology, checks: &Checks<'_>) {
    let with_clock = || {
        let hosts = topology.hosts().iter();
        hosts.filter_map(|host| Some((host, host.clock()?)))
    };
    for (host, end) in with_clock() {
        check_owner(topology, host, end.address, checks);
    }
    // Without a host or a channel that is meant, these would be noise.
    if !checks.is_clean() || topology.processes().is_empty() {
        return;
    }
    for (host, end) in with_clock() {
        check_use(topology, host, &end, checks);
        check_ports(topology, host, &end, checks);
    }
}

/// Notes what is wrong with the clock address of `host`.
fn refuse(host: &Host, checks: &Checks<'_>, why: String) {
    let path = join(&join("hosts", &host.name), "clock_address");
    checks.refuse_because(path, why);
}

/// An address belongs to one host.
fn check_owner(topology: &Topology, host: &Host, address: IpAddr, checks: &Checks<'_>) {
    let others = topology
        .hosts()
        .iter()
        .filter(|other| other.name != host.name);
    for other in others {
        // Of two equal clock addresses, the second by name is told.
        let is_clock = other.clock_address == Some(address) && other.name < host.name;
        let what = match (is_clock, other.address == Some(address)) {
            (true, _) => "clock_address",
            (false, true) => "address",
            (false, false) => continue,
        };
        let fault = format!("is the {what} of host `{}` already: {address}", other.name);
        refuse(host, checks, fault);
    }
}

/// Some other host must be there to exchange clocks with, in the same family of addresses.
fn check_use(topology: &Topology, host: &Host, end: &ClockEnd, checks: &Checks<'_>) {
    let add = |fault: String| refuse(host, checks, fault);
    let name = host.name.as_str();
    let linked: Vec<&Host> = topology
        .linked_pairs()
        .into_iter()
        .filter_map(|(one, other)| match (one == name, other == name) {
            (true, _) => topology.host(other),
            (_, true) => topology.host(one),
            _ => None,
        })
        .collect();
    if linked.is_empty() {
        add(format!(
            "has no use: no channel leaves host `{name}` over a link with gateways"
        ));
        return;
    }
    if linked.iter().all(|other| other.clock_address.is_none()) {
        let names: Vec<String> = linked.iter().map(|other| other.name.clone()).collect();
        let names = super::suggest::listed(&names);
        add(format!(
            "needs one at the other end as well: {names}, which a link joins with `{name}`, has \
             no clock_address"
        ));
    }
    for other in linked {
        let Some(its) = other.clock_address else {
            continue;
        };
        if its.is_ipv4() != end.address.is_ipv4() {
            add(format!(
                "{} and that of host `{}`, {}, are of different IP versions",
                end.address, other.name, its
            ));
        }
        check_name(topology, host, other, checks);
    }
}

/// The path's name stands in the headers of its record files, among the names of channels.
fn check_name(topology: &Topology, host: &Host, other: &Host, checks: &Checks<'_>) {
    if host.name > other.name {
        return;
    }
    let name = name_of(&host.name, &other.name);
    let fault = if name.len() > CHANNEL_NAME_BYTES_MAX {
        let length = name.len();
        format!(
            "makes a clock path called `{name}`, whose {length} bytes are more than the \
             {CHANNEL_NAME_BYTES_MAX} of a record file's header: shorten a host's name"
        )
    } else if topology.channel(&name).is_some() {
        format!("makes a clock path called `{name}`, and a channel has that name")
    } else if let Some((one, two)) = topology.namesake(host, other) {
        // `a-b` with `c`, and `a` with `b-c`: their exchanges could not be told apart.
        format!("makes a clock path called `{name}`, as hosts `{one}` and `{two}` do: rename one")
    } else if let Some(process) = ends_of(&host.name, &other.name)
        .into_iter()
        .find(|end| topology.process(end).is_some())
    {
        format!("makes a process called `{process}`, and another has that name")
    } else {
        return;
    };
    refuse(host, checks, fault);
}

/// A host's clock paths take ports from `clock_port` on, and no channel uses one of them.
fn check_ports(topology: &Topology, host: &Host, end: &ClockEnd, checks: &Checks<'_>) {
    let add = |fault: String| {
        let host = join("hosts", &host.name);
        let path = join(&host, "clock_port");
        // By default the port follows from the address.
        let place = if checks.has(&path) {
            path.clone()
        } else {
            join(&host, "clock_address")
        };
        checks.refuse_at(path, &place, Fault::Inconsistent(fault));
    };
    let pairs = topology.clock_pairs();
    let is_own = |(one, other): &&(&Host, &Host)| one.name == host.name || other.name == host.name;
    let count = pairs.iter().filter(is_own).count();
    let first = usize::from(end.port);
    let last = first + count.max(1) - 1;
    if last > usize::from(u16::MAX) {
        add(format!(
            "{first} leaves no ports below 65536 for {count} clock paths"
        ));
        return;
    }
    for crossing in topology.crossings() {
        let ports = [crossing.ports.sender, crossing.ports.receiver];
        if ports
            .iter()
            .any(|port| (first..=last).contains(&usize::from(*port)))
        {
            add(format!(
                "{first} to {last} overlaps with the ports of link `{}`",
                crossing.link.name
            ));
            return;
        }
    }
}
