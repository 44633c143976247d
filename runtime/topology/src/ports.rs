//! The ports that a run binds on a host, each with the key that says so. It binds none.

use std::net::SocketAddr;

use hil_protocol::transport::IpProtocol;

use super::{AdapterKind, Crossing, Host, Program, Topology};

/// A port that a run binds on a host.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct WantedPort {
    /// Its protocol.
    pub protocol: IpProtocol,
    /// Where.
    pub address: SocketAddr,
    /// What for.
    pub of: String,
    /// The key that says so.
    pub key: String,
    /// The key of its address.
    pub address_key: String,
    /// The interface that it is bound to.
    pub interface: Option<String>,
    /// A run does without it.
    pub is_dispensable: bool,
}

impl WantedPort {
    /// For `of`, at the address of `host`.
    fn new(protocol: IpProtocol, host: &Host, address: SocketAddr, of: &str, key: String) -> Self {
        Self {
            protocol,
            address,
            of: of.to_owned(),
            key,
            address_key: format!("hosts.{}.address", host.name),
            interface: None,
            is_dispensable: false,
        }
    }
}

/// Two sockets of one protocol cannot have both, unless they agreed to.
pub fn collide(one: SocketAddr, other: SocketAddr) -> bool {
    let is_any = one.ip().is_unspecified() || other.ip().is_unspecified();
    one.port() == other.port() && (is_any || one.ip() == other.ip())
}

impl Topology {
    /// The ports that a run binds on the hosts called `here`, which run on one machine, in order and each
    /// once.
    pub fn ports_on(&self, here: &[String]) -> Vec<WantedPort> {
        let is_here = |host: &Host| here.contains(&host.name);
        let mut ports = Vec::new();
        for host in self.hosts().iter().filter(|host| is_here(host)) {
            ports.extend(adapter_ports(self, host));
        }
        for crossing in self.crossings() {
            ports.extend(hop_ports(&crossing, &is_here));
        }
        // The supervisors meet at the first host; clock paths have ports of their own.
        let first = self.hosts().first().filter(|host| is_here(host));
        if let Some((host, address)) = first.and_then(|host| Some((host, host.control_address()?)))
        {
            let key = control_key(host);
            ports.push(WantedPort::new(
                IpProtocol::Tcp,
                host,
                address,
                "control_port",
                key,
            ));
        }
        for path in self.clock_paths() {
            for (host, address) in [(path.from, path.asking), (path.to, path.answering)] {
                if is_here(host) {
                    let key = format!("hosts.{}.clock_port", host.name);
                    ports.push(WantedPort {
                        interface: host.clock_interface.clone(),
                        is_dispensable: true,
                        address_key: format!("hosts.{}.clock_address", host.name),
                        ..WantedPort::new(IpProtocol::Udp, host, address, &path.name(), key)
                    });
                }
            }
        }
        ports.sort();
        ports.dedup();
        ports
    }
}

/// The key of the port at which supervisors meet on `host`.
pub fn control_key(host: &Host) -> String {
    format!("hosts.{}.control_port", host.name)
}

/// A sensor adapter listens; a robot adapter sends from a port of the kernel's choice.
fn adapter_ports(topology: &Topology, host: &Host) -> Vec<WantedPort> {
    let mut ports = Vec::new();
    for process in topology.processes_on(&host.name) {
        let Program::Egm { adapter, .. } = &process.program else {
            continue;
        };
        if adapter.kind != AdapterKind::Sensor {
            continue;
        }
        for (side, address) in adapter.addresses() {
            let key = format!("processes.{}.egm.{}", process.name, side.word());
            ports.push(WantedPort {
                interface: host.interface.clone(),
                address_key: key.clone(),
                ..WantedPort::new(IpProtocol::Udp, host, address, &process.name, key)
            });
        }
    }
    ports
}

fn hop_ports(crossing: &Crossing<'_>, is_here: &dyn Fn(&Host) -> bool) -> Vec<WantedPort> {
    let capabilities = &crossing.hop.transport.capabilities;
    let flow = format!("link {}", crossing.flow_label());
    let ends = [
        (
            crossing.from_host,
            capabilities.sender_port,
            crossing.ports.sender,
        ),
        (
            crossing.to_host,
            capabilities.receiver_port,
            crossing.ports.receiver,
        ),
    ];
    let here = ends.into_iter().filter(|(host, ..)| is_here(host));
    let ports = here.filter_map(|(host, protocol, port)| {
        let address = SocketAddr::new(host.gateway_address(), port);
        let key = format!("links.{}.port", crossing.link.name);
        Some(WantedPort {
            interface: host.interface.clone(),
            ..WantedPort::new(protocol?, host, address, &flow, key)
        })
    });
    ports.collect()
}
