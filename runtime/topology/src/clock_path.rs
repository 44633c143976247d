//! Clock paths: the addresses over which two hosts exchange clocks beside the link under test. Read,
//! checked, and paired here; nothing is opened.

use std::collections::BTreeSet;
use std::net::{IpAddr, SocketAddr};

use super::errors::{Fault, Faults, Place};
use super::limits;
use super::model::{Host, Topology};
use super::reader::Reader;
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
            let interface = host.clock.as_ref().and_then(|end| end.interface.as_deref());
            describe_end(&address.ip().to_string(), interface)
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
            .filter(|(one, other)| one.clock.is_some() && other.clock.is_some())
            .collect()
    }
}

/// Where `host` is on the clock path that follows those of `before`.
fn end_of(host: &Host, before: &[(&Host, &Host)]) -> Option<SocketAddr> {
    let end = host.clock.as_ref()?;
    let is_own = |(one, other): &&(&Host, &Host)| one.name == host.name || other.name == host.name;
    let offset = u16::try_from(before.iter().filter(is_own).count()).ok()?;
    Some(SocketAddr::new(end.address, end.port.checked_add(offset)?))
}

/// A clock address as the file has it.
#[derive(Debug)]
pub(super) struct ClockEntry {
    pub path: String,
    pub place: Place,
    /// Of the port, or of the address where the port is the default.
    pub port_place: Place,
}

/// Reads the keys of a host's clock path.
pub(super) fn read(reader: &mut Reader<'_>) -> (Option<ClockEnd>, Option<ClockEntry>) {
    let text = reader.text("clock_address");
    let place = text.as_ref().map(|text| text.place);
    let address = text.and_then(|text| read_address(reader, "clock_address", &text.value));
    let interface = read_interface(reader, "clock_interface");
    let port: Option<u16> = reader.integer("clock_port", &limits::HOST_CLOCK_PORT);
    if !reader.has("clock_address") {
        let why = "needs `clock_address`: it belongs to a path for clock exchanges";
        reader.refuse_present(&["clock_interface", "clock_port"], why);
    }
    if !reader.has("address") {
        let why = "needs `address`: without it this host and its peers run on one PC, on one clock";
        reader.refuse_present(&["clock_address"], why);
    }
    let default = u16::try_from(limits::HOST_CLOCK_PORT.default);
    let end = address.map(|address| ClockEnd {
        address,
        interface,
        port: port.unwrap_or(default.expect("a default port is within 1..=65535")),
    });
    let entry = place.map(|place| ClockEntry {
        path: reader.path.clone(),
        place,
        port_place: reader.place_of("clock_port").unwrap_or(place),
    });
    (end, entry)
}

/// The address of one host.
pub(super) fn read_address(reader: &Reader<'_>, key: &str, text: &str) -> Option<IpAddr> {
    let parsed: Option<IpAddr> = text.parse().ok();
    let address = parsed.filter(|address| !address.is_unspecified() && !address.is_multicast());
    if address.is_none() {
        let fault = Fault::Inconsistent(format!("\"{text}\" is no address of one host"));
        reader.refuse(key, fault);
    } else if address.is_some_and(is_link_local_v6) {
        reader.refuse(key, Fault::Inconsistent(link_local_fault(text)));
    }
    address
}

/// Why a link-local address without a scope is refused.
pub(super) fn link_local_fault(text: &str) -> String {
    format!(
        "\"{text}\" is link-local: it says nothing without an interface, and its scope differs from \
         host to host; give the host a unique local address (fd00::/8) or use IPv4"
    )
}

/// Of `fe80::/10` (RFC 4291, 2.5.6): the kernel refuses it without a scope.
const fn is_link_local_v6(address: IpAddr) -> bool {
    matches!(address, IpAddr::V6(address) if address.is_unicast_link_local())
}

/// The name of an interface.
pub(super) fn read_interface(reader: &mut Reader<'_>, key: &'static str) -> Option<String> {
    let interface = reader.text(key).map(|interface| interface.value);
    if interface
        .as_deref()
        .is_some_and(|name| !is_interface_name(name))
    {
        let fault = "is no interface name: 1 to 15 letters without blank or slash";
        reader.refuse(key, Fault::Inconsistent(fault.to_owned()));
    }
    interface
}

/// `IFNAMSIZ` is 16 with the terminating zero.
fn is_interface_name(name: &str) -> bool {
    (1..=15).contains(&name.len()) && !name.contains([' ', '/', ':']) && name.is_ascii()
}

/// Checks the clock addresses against each other and against what the links use; `entries` are in
/// the order of the hosts.
pub(super) fn check(topology: &Topology, entries: &[Option<ClockEntry>], faults: &Faults) {
    for (index, (host, entry)) in topology.hosts().iter().zip(entries).enumerate() {
        let (Some(end), Some(entry)) = (&host.clock, entry) else {
            continue;
        };
        check_owner(topology, index, end.address, entry, faults);
    }
    // Without a host or a channel that is meant, these would be noise.
    if !faults.is_empty() || topology.processes().is_empty() {
        return;
    }
    for (host, entry) in topology.hosts().iter().zip(entries) {
        if let (Some(end), Some(entry)) = (&host.clock, entry) {
            check_use(topology, host, end, entry, faults);
            check_ports(topology, host, end, entry, faults);
        }
    }
}

/// An address belongs to one host, the one at `index`.
fn check_owner(
    topology: &Topology,
    index: usize,
    address: IpAddr,
    entry: &ClockEntry,
    faults: &Faults,
) {
    let key = join(&entry.path, "clock_address");
    for (place, other) in topology.hosts().iter().enumerate() {
        if place == index {
            continue;
        }
        let is_clock = other
            .clock
            .as_ref()
            .is_some_and(|end| end.address == address);
        let what = match (is_clock && place < index, other.address == Some(address)) {
            (true, _) => "clock_address",
            (false, true) => "address",
            (false, false) => continue,
        };
        let fault = format!("is the {what} of host `{}` already: {address}", other.name);
        faults.add(key.clone(), Some(entry.place), Fault::Inconsistent(fault));
    }
}

/// Some other host must be there to exchange clocks with, in the same family of addresses.
fn check_use(
    topology: &Topology,
    host: &Host,
    end: &ClockEnd,
    entry: &ClockEntry,
    faults: &Faults,
) {
    let add = |fault: String| {
        let key = join(&entry.path, "clock_address");
        faults.add(key, Some(entry.place), Fault::Inconsistent(fault));
    };
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
    if linked.iter().all(|other| other.clock.is_none()) {
        let names: Vec<String> = linked.iter().map(|other| other.name.clone()).collect();
        let names = super::suggest::listed(&names);
        add(format!(
            "needs one at the other end as well: {names}, which a link joins with `{name}`, has \
             no clock_address"
        ));
    }
    for other in linked {
        let Some(its) = &other.clock else { continue };
        if its.address.is_ipv4() != end.address.is_ipv4() {
            add(format!(
                "{} and that of host `{}`, {}, are of different IP versions",
                end.address, other.name, its.address
            ));
        }
        check_name(topology, host, other, entry, faults);
    }
}

/// The path's name stands in the headers of its record files, among the names of channels.
fn check_name(topology: &Topology, host: &Host, other: &Host, entry: &ClockEntry, faults: &Faults) {
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
    let key = join(&entry.path, "clock_address");
    faults.add(key, Some(entry.place), Fault::Inconsistent(fault));
}

/// A host's clock paths take ports from `clock_port` on, and no channel uses one of them.
fn check_ports(
    topology: &Topology,
    host: &Host,
    end: &ClockEnd,
    entry: &ClockEntry,
    faults: &Faults,
) {
    let add = |fault: String| {
        let key = join(&entry.path, "clock_port");
        faults.add(key, Some(entry.port_place), Fault::Inconsistent(fault));
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
