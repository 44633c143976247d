//! What a topology wants of this host, as far as the doctor looks at it: pinned CPUs, addresses,
//! ports, message sizes, the folder of the run. It examines nothing.

use std::net::IpAddr;
use std::path::PathBuf;

use hil_net::interface::own_name;
use hil_protocol::wire;

use hil_topology::{ClockEnd, Crossing, Execution, Host, Topology, Wait, WantedPort};

/// A CPU that something is pinned to.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Pin {
    /// The CPU.
    pub cpu: usize,
    /// The key that says so.
    pub key: String,
    /// The process or gateway, for people.
    pub of: String,
    /// It polls without pause (`wait = "spin"`).
    pub spins: bool,
}

/// A host that this one talks to.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Peer {
    /// Its name in the topology.
    pub name: String,
    /// Its address.
    pub address: IpAddr,
    /// This host's address, from which it expects to be talked to.
    pub own: IpAddr,
    /// The interface the topology binds to.
    pub interface: Option<String>,
}

/// The longest message that leaves this host over a link.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LinkLoad {
    /// The link.
    pub link: String,
    /// The channel with the longest message.
    pub channel: String,
    /// Bytes of that message.
    pub message_bytes: usize,
    /// `path_mtu_bytes` of the link.
    pub path_mtu_bytes: usize,
    /// Where it leaves.
    pub own: IpAddr,
    /// Bytes of a packet before a datagram.
    pub header_bytes: usize,
    /// The transport, where it cuts what it carries to the path itself.
    pub cut_by: Option<&'static str>,
}

impl LinkLoad {
    /// Bytes of the IP packet that the message would be in one piece.
    pub(super) fn packet_bytes(&self) -> usize {
        self.header_bytes + wire::HEADER_BYTES + self.message_bytes
    }

    /// Datagrams of one message where a packet has at most `mtu` bytes; `None` when not even the
    /// headers fit.
    pub(super) fn datagram_count(&self, mtu: usize) -> Option<usize> {
        let budget = mtu.checked_sub(self.header_bytes + wire::HEADER_BYTES)?;
        (budget > 0).then(|| self.message_bytes.div_ceil(budget).max(1))
    }
}

/// An interface, or an address, that a run of the topology needs here.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct WantedInterface {
    /// The key that names it, or the address that it has.
    pub key: String,
    /// Its name; `None` where only the address says which it is.
    pub name: Option<String>,
    /// The address that it has.
    pub address: IpAddr,
}

/// What a topology has this host do.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Plan {
    /// Pinned CPUs.
    pub pins: Vec<Pin>,
    /// Interfaces it names; those of its addresses are found by the addresses.
    pub interfaces: Vec<String>,
    /// Its own addresses.
    pub addresses: Vec<IpAddr>,
    /// The interfaces that messages of a run pass.
    pub ways: Vec<WantedInterface>,
    /// Ports.
    pub ports: Vec<WantedPort>,
    /// Hosts to talk to.
    pub peers: Vec<Peer>,
    /// The longest message per link.
    pub loads: Vec<LinkLoad>,
    /// Where this host exchanges clocks.
    pub clock_end: Option<ClockEnd>,
    /// Folder that receives the runs.
    pub record_folder: PathBuf,
}

impl Plan {
    /// The plan of the hosts called `here`, which run on this machine.
    pub fn of(topology: &Topology, here: &[String]) -> Self {
        let is_here = |host: &Host| here.contains(&host.name);
        let mut plan = Self {
            record_folder: PathBuf::from(topology.run().record.as_ref()),
            ports: topology.ports_on(here),
            ..Self::default()
        };
        for host in topology.hosts().iter().filter(|host| is_here(host)) {
            plan.addresses.extend(host.address);
            plan.ways
                .extend(host.address.map(|address| WantedInterface {
                    key: format!(
                        "hosts.{}.{}",
                        host.name,
                        host.interface.as_ref().map_or("address", |_| "interface")
                    ),
                    name: host.interface.clone(),
                    address,
                }));
            plan.interfaces.extend(host.interface.clone());
            if let Some(end) = host.clock() {
                plan.addresses.push(end.address);
                plan.interfaces.extend(end.interface.clone());
                plan.clock_end.get_or_insert(end);
            }
            for process in topology.processes_on(&host.name) {
                let key = format!("processes.{}", process.name);
                plan.pin(&process.name, &key, &process.execution);
            }
        }
        for crossing in topology.crossings() {
            plan.cross(&crossing, &is_here);
        }
        sort_unique(&mut plan.pins);
        sort_unique(&mut plan.interfaces);
        sort_unique(&mut plan.addresses);
        sort_unique(&mut plan.peers);
        // The longest of each link stays.
        plan.loads
            .sort_by(|a, b| (&a.link, b.message_bytes).cmp(&(&b.link, a.message_bytes)));
        plan.loads.dedup_by(|later, first| later.link == first.link);
        plan
    }

    /// The same with the kernel's own names of the interfaces that it calls otherwise.
    #[must_use]
    pub(super) fn with_own_names(mut self) -> Self {
        let named = self.interfaces.iter_mut();
        let named = named.chain(self.ways.iter_mut().filter_map(|way| way.name.as_mut()));
        let of_peers = self.peers.iter_mut();
        let named = named.chain(of_peers.filter_map(|peer| peer.interface.as_mut()));
        let end = self.clock_end.as_mut();
        for name in named.chain(end.and_then(|end| end.interface.as_mut())) {
            if let Some(own) = own_name(name) {
                *name = own;
            }
        }
        sort_unique(&mut self.interfaces);
        self
    }

    /// The CPUs of the pins, each once.
    pub fn cpus(&self) -> Vec<usize> {
        let mut cpus: Vec<usize> = self.pins.iter().map(|pin| pin.cpu).collect();
        sort_unique(&mut cpus);
        cpus
    }

    /// Something pinned polls without pause.
    pub(super) fn spins(&self) -> bool {
        self.pins.iter().any(|pin| pin.spins)
    }

    fn pin(&mut self, of: &str, table: &str, execution: &Execution) {
        self.pins.extend(execution.cpu.iter().map(|cpu| Pin {
            cpu: usize::from(*cpu),
            key: format!("{table}.cpu"),
            of: of.to_owned(),
            spins: execution.wait == Wait::Spin,
        }));
    }

    fn cross(&mut self, crossing: &Crossing<'_>, is_here: &dyn Fn(&Host) -> bool) {
        let (from, to, channel) = (crossing.from_host, crossing.to_host, crossing.channel);
        let transport = crossing.hop.transport;
        let capabilities = &transport.capabilities;
        if is_here(from) || is_here(to) {
            let name = format!("gateway of {}", crossing.link.name);
            let table = format!("links.{}.gateway", crossing.link.name);
            self.pin(&name, &table, &crossing.hop.gateway.execution);
        }
        if is_here(from) {
            self.loads.push(LinkLoad {
                link: crossing.link.name.clone(),
                channel: channel.name.clone(),
                message_bytes: channel.message.size_bytes,
                path_mtu_bytes: crossing.hop.socket.path_mtu_bytes,
                own: from.gateway_address(),
                header_bytes: capabilities.header_bytes(from.gateway_address()),
                cut_by: capabilities.cuts_to_path.then_some(transport.label),
            });
            self.adapter(from, to);
        }
        if is_here(to) {
            self.adapter(to, from);
        }
    }

    /// `own` talks to `other`, as far as both have an address.
    fn adapter(&mut self, own: &Host, other: &Host) {
        if let (Some(here), Some(there)) = (own.address, other.address) {
            self.peers.push(Peer {
                name: other.name.clone(),
                address: there,
                own: here,
                interface: own.interface.clone(),
            });
        }
    }
}

fn sort_unique<T: Ord>(list: &mut Vec<T>) {
    list.sort();
    list.dedup();
}

#[cfg(test)]
mod tests {
    use hil_shuttle::Shuttle;

    use super::*;
    use hil_topology::{KnownCases, parse};

    const SPLIT: &str = r#"
version = 1
name = "t"
case.name = "shuttle"
[run]
record = "/var/tmp/t"
[hosts.a]
address = "10.0.0.1"
interface = "eth9"
clock_address = "10.1.0.1"
[hosts.b]
address = "10.0.0.2"
clock_address = "10.1.0.2"
[processes.controller]
role = "controller"
host = "a"
cpu = 2
[processes.robot]
role = "robot"
host = "b"
cpu = 5
[channels]
"shuttle/command".link = "hop"
"shuttle/status".link = "hop"
[links.hop]
via = "udp"
port = 7400
path_mtu_bytes = 1400
[links.hop.gateway]
cpu = 3
wait = "spin"
"#;

    fn plan(host: &str) -> Plan {
        let known = KnownCases::new().with::<Shuttle>();
        let topology = parse("t.toml", SPLIT, &[], &known).unwrap();
        Plan::of(&topology, &[host.to_owned()])
    }

    #[test]
    fn a_host_gets_its_own_share_and_nothing_of_its_peer() {
        let plan = plan("a");
        assert_eq!(plan.cpus(), [2, 3]);
        assert!(plan.spins());
        assert_eq!(plan.pins[0].of, "controller");
        assert_eq!(plan.interfaces, ["eth9"]);
        assert_eq!(plan.record_folder, PathBuf::from("/var/tmp/t"));
        let ports: Vec<String> = plan
            .ports
            .iter()
            .map(|port| format!("{} {} {}", port.protocol.word(), port.address, port.of))
            .collect();
        assert_eq!(
            ports,
            [
                "udp 10.0.0.1:7400 link hop/forward",
                "udp 10.0.0.1:7401 link hop/backward",
                "udp 10.1.0.1:7390 clock/a-b",
                "tcp 10.0.0.1:7399 control_port",
            ]
        );
        let peers: Vec<(&str, IpAddr)> = plan
            .peers
            .iter()
            .map(|peer| (peer.name.as_str(), peer.address))
            .collect();
        assert_eq!(peers, [("b", "10.0.0.2".parse().unwrap())]);
        assert_eq!(plan.loads.len(), 1);
    }

    #[test]
    fn the_second_host_listens_for_no_supervisor() {
        let plan = plan("b");
        assert_eq!(plan.cpus(), [3, 5]);
        assert!(plan.ports.iter().all(|port| port.of != "control_port"));
    }

    #[test]
    fn datagrams_of_a_message_follow_from_headers_and_mtu() {
        let load = LinkLoad {
            link: "hop".to_owned(),
            channel: "c".to_owned(),
            message_bytes: 1400,
            path_mtu_bytes: 1500,
            own: IpAddr::from([10, 0, 0, 1]),
            header_bytes: 28,
            cut_by: None,
        };
        // 1500 - 28 - 72 leave exactly 1400.
        assert_eq!(load.packet_bytes(), 1500);
        assert_eq!(load.datagram_count(1500), Some(1));
        assert_eq!(load.datagram_count(1499), Some(2));
        assert_eq!(load.datagram_count(100), None);
    }
}
