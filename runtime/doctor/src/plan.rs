//! What a topology wants of this host, as far as the doctor looks at it: pinned CPUs, addresses,
//! ports, message sizes, the folder of the run. It examines nothing.

use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;

use hil_arm::egm::messages::Side;
use hil_protocol::transport::IpProtocol;
use hil_protocol::wire;

use hil_topology::{AdapterKind, ClockEnd, Crossing, Execution, Host, Program, Topology, Wait};

/// A CPU that something is pinned to.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Pin {
    /// The CPU.
    pub cpu: usize,
    /// The process or gateway, for people.
    pub of: String,
    /// It polls without pause (`wait = "spin"`).
    pub spins: bool,
}

/// A port that a run binds on this host.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct WantedPort {
    /// Its protocol.
    pub protocol: IpProtocol,
    /// Where.
    pub address: SocketAddr,
    /// What for.
    pub of: String,
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

/// What a topology has this host do.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Plan {
    /// Pinned CPUs.
    pub pins: Vec<Pin>,
    /// Interfaces it names; those of its addresses are found by the addresses.
    pub interfaces: Vec<String>,
    /// Its own addresses.
    pub addresses: Vec<IpAddr>,
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
            record_folder: PathBuf::from(&topology.run().record_folder),
            ..Self::default()
        };
        for host in topology.hosts().iter().filter(|host| is_here(host)) {
            plan.addresses.extend(host.address);
            plan.interfaces.extend(host.interface.clone());
            if let Some(end) = &host.clock {
                plan.addresses.push(end.address);
                plan.interfaces.extend(end.interface.clone());
                plan.clock_end.get_or_insert_with(|| end.clone());
            }
            for process in topology.processes_on(&host.name) {
                plan.pin(&process.name, &process.execution);
                // A sensor adapter listens; a robot adapter sends from a port of the kernel's choice.
                if let Program::Egm { adapter, .. } = &process.program
                    && adapter.kind == AdapterKind::Sensor
                {
                    let sides = [Side::Right, Side::Left].into_iter();
                    for address in sides.filter_map(|side| adapter.address(side)) {
                        plan.bind(IpProtocol::Udp, address, &process.name);
                    }
                }
            }
        }
        for crossing in topology.crossings() {
            plan.cross(&crossing, &is_here);
        }
        // The supervisors meet at the first host; clock paths have ports of their own.
        let first = topology.hosts().first().filter(|host| is_here(host));
        if let Some(address) = first.and_then(Host::control_address) {
            plan.bind(IpProtocol::Tcp, address, "control_port");
        }
        for path in topology.clock_paths() {
            for (host, address) in [(path.from, path.asking), (path.to, path.answering)] {
                if is_here(host) {
                    plan.bind(IpProtocol::Udp, address, &path.name());
                }
            }
        }
        sort_unique(&mut plan.pins);
        sort_unique(&mut plan.ports);
        sort_unique(&mut plan.interfaces);
        sort_unique(&mut plan.addresses);
        sort_unique(&mut plan.peers);
        // The longest of each link stays.
        plan.loads
            .sort_by(|a, b| (&a.link, b.message_bytes).cmp(&(&b.link, a.message_bytes)));
        plan.loads.dedup_by(|later, first| later.link == first.link);
        plan
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

    fn pin(&mut self, of: &str, execution: &Execution) {
        self.pins.extend(execution.cpus.iter().map(|cpu| Pin {
            cpu: usize::from(*cpu),
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
            self.pin(&name, &crossing.hop.gateway.execution);
        }
        let flow = format!("link {}", crossing.flow_label());
        let at = |host: &Host, port| SocketAddr::new(host.gateway_address(), port);
        if is_here(from) {
            if let Some(protocol) = capabilities.sender_port {
                self.bind(protocol, at(from, crossing.ports.sender), &flow);
            }
            self.loads.push(LinkLoad {
                link: crossing.link.name.clone(),
                channel: channel.name.clone(),
                message_bytes: channel.message.size_bytes,
                path_mtu_bytes: crossing.hop.path_mtu_bytes,
                own: from.gateway_address(),
                header_bytes: capabilities.header_bytes(from.gateway_address()),
                cut_by: capabilities.cuts_to_path.then_some(transport.label),
            });
            self.adapter(from, to);
        }
        if is_here(to) {
            if let Some(protocol) = capabilities.receiver_port {
                self.bind(protocol, at(to, crossing.ports.receiver), &flow);
            }
            self.adapter(to, from);
        }
    }

    fn bind(&mut self, protocol: IpProtocol, address: SocketAddr, of: &str) {
        self.ports.push(WantedPort {
            protocol,
            address,
            of: of.to_owned(),
        });
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
