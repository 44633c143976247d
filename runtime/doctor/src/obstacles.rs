//! What of this host would keep a run of a topology from starting, or holds it up: interfaces, addresses,
//! ports and CPUs, each tried as the run would take it, with the key that asks for it. It takes some
//! milliseconds and leaves nothing.

use core::fmt;
use std::io;
use std::net::IpAddr;

use hil_net::interface::{try_datagrams, try_listener};
use hil_protocol::transport::IpProtocol;
use nix::errno::Errno;

use super::finding::Finding;
use super::network::{Interfaces, interfaces};
use super::plan::{Pin, Plan, WantedInterface};
use super::ports::holder_of;
use hil_platform::host_facts::{HostFiles, format_cpu_list};
use hil_platform::realtime::allowed_cpus;
use hil_topology::WantedPort;

/// Something that is in a run's way.
#[derive(Debug)]
pub struct Obstacle {
    /// The key of the topology that asks for it.
    pub key: String,
    /// What is the matter.
    pub trouble: Trouble,
    /// What a run makes of it.
    pub effect: Effect,
}

/// What a run makes of an obstacle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effect {
    /// It cannot start.
    Prevents,
    /// It starts, and no message passes before it is gone.
    HoldsUp,
    /// It goes on without what was asked for.
    DoneWithout,
}

/// What is the matter with an interface, an address or a port.
#[derive(Debug)]
pub enum Trouble {
    /// No interface of this name.
    NoInterface {
        /// The name.
        name: String,
        /// The names there are.
        present: Vec<String>,
    },
    /// The interface is switched off.
    Down(String),
    /// The interface is switched on and has no carrier.
    NoCarrier(String),
    /// No interface has the address.
    NoAddress(IpAddr),
    /// A CPU that the processes of this user may not run on.
    Cpu {
        /// The pin.
        pin: Pin,
        /// The CPUs they may run on.
        allowed: Vec<usize>,
    },
    /// Another program holds the port.
    Taken {
        /// What is wanted.
        port: WantedPort,
        /// Who holds it.
        holder: String,
    },
    /// The kernel refuses the port for another reason.
    Refused {
        /// What is wanted.
        port: WantedPort,
        /// What the kernel answered.
        source: io::Error,
    },
}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoInterface { name, present } => {
                write!(
                    f,
                    "there is no interface {name}; there are {}",
                    present.join(", ")
                )
            }
            Self::Down(name) => {
                write!(f, "interface {name} is switched off: ip link set {name} up")
            }
            Self::NoCarrier(name) => write!(
                f,
                "interface {name} has no carrier: nothing leaves it before its cable or its network is \
                 connected"
            ),
            Self::Cpu { pin, allowed } => {
                let (cpu, of, allowed) = (pin.cpu, &pin.of, format_cpu_list(allowed));
                write!(
                    f,
                    "{of} is pinned to CPU {cpu}, and may run on {allowed}: it would run unpinned"
                )
            }
            Self::NoAddress(address) => write!(f, "no interface has {address}"),
            Self::Taken { port, holder } => {
                let (protocol, address) = (port.protocol.word(), port.address);
                let of = &port.of;
                write!(f, "{protocol} {address} of {of} is held by {holder}")
            }
            Self::Refused { port, source } => {
                let (protocol, address) = (port.protocol.word(), port.address);
                let of = &port.of;
                write!(f, "{protocol} {address} of {of} was refused: {source}")
            }
        }
    }
}

/// What is in the way of a run as `plan` has it, each key once.
pub fn obstacles(plan: &Plan) -> Vec<Obstacle> {
    let mut found = Vec::new();
    // Without a list the ports tell.
    if let Ok(present) = interfaces() {
        let plan = plan.clone().with_own_names();
        found.extend(plan.ways.iter().filter_map(|way| on_the_way(&present, way)));
    }
    let files = HostFiles::of_this_host();
    for port in &plan.ports {
        let trouble = tried(&files, port);
        let is_told = |trouble: &Trouble| {
            found.iter().any(|one| match (&one.trouble, trouble) {
                (Trouble::NoAddress(known), Trouble::NoAddress(address)) => known == address,
                (Trouble::NoInterface { .. }, Trouble::NoInterface { .. }) => true,
                _ => one.key == port.key,
            })
        };
        if let Some(trouble) = trouble.filter(|trouble| !is_told(trouble)) {
            let key = match trouble {
                Trouble::NoAddress(_) => &port.address_key,
                _ => &port.key,
            };
            found.push(Obstacle {
                key: key.clone(),
                trouble,
                effect: if port.is_dispensable {
                    Effect::DoneWithout
                } else {
                    Effect::Prevents
                },
            });
        }
    }
    if let Ok(allowed) = allowed_cpus() {
        let outside = plan.pins.iter().filter(|pin| !allowed.contains(&pin.cpu));
        found.extend(outside.map(|pin| Obstacle {
            key: pin.key.clone(),
            trouble: Trouble::Cpu {
                pin: pin.clone(),
                allowed: allowed.clone(),
            },
            effect: Effect::DoneWithout,
        }));
    }
    found
}

/// The interfaces of a plan over which nothing leaves at the moment.
pub(super) fn without_carrier(present: &Interfaces, plan: &Plan) -> Vec<Finding> {
    let mut found: Vec<Finding> = Vec::new();
    for one in plan.ways.iter().filter_map(|way| on_the_way(present, way)) {
        let (name, fix) = match &one.trouble {
            Trouble::Down(name) => (name, format!("ip link set {name} up")),
            Trouble::NoCarrier(name) => (
                name,
                format!("connect {name}, or name another in {}", one.key),
            ),
            _ => continue,
        };
        let finding = Finding::error("interface", one.trouble.to_string()).of(name);
        let why = "nothing is sent before it is there: a run would wait for the other host in vain";
        // Two hosts may share an interface.
        if found.iter().all(|known| known.id != finding.id) {
            found.push(finding.because(why).fixed_by(fix));
        }
    }
    found
}

fn on_the_way(present: &Interfaces, way: &WantedInterface) -> Option<Obstacle> {
    let of_address = || {
        let mut all = present.iter();
        let has = |own: &[(IpAddr, u32)]| own.iter().any(|(own, _)| *own == way.address);
        all.find(|(_, one)| has(&one.addresses))
            .map(|(name, _)| name)
    };
    let name = way.name.as_ref().or_else(of_address)?;
    let trouble = match present.get(name) {
        None => Trouble::NoInterface {
            name: name.clone(),
            present: present.keys().cloned().collect(),
        },
        Some(one) if !one.is_up => Trouble::Down(name.clone()),
        Some(one) if !one.has_link => Trouble::NoCarrier(name.clone()),
        Some(_) => return None,
    };
    Some(Obstacle {
        key: way.key.clone(),
        effect: match trouble {
            Trouble::NoInterface { .. } => Effect::Prevents,
            _ => Effect::HoldsUp,
        },
        trouble,
    })
}

/// What the kernel says to the port.
fn tried(files: &HostFiles, port: &WantedPort) -> Option<Trouble> {
    let interface = port.interface.as_deref();
    let tried = match port.protocol {
        IpProtocol::Udp => try_datagrams(port.address, interface),
        IpProtocol::Tcp => try_listener(port.address, interface),
    };
    let source = tried.err()?;
    Some(match source.raw_os_error().map(Errno::from_raw) {
        Some(Errno::EADDRINUSE) => Trouble::Taken {
            holder: holder_of(files, port),
            port: port.clone(),
        },
        Some(Errno::EADDRNOTAVAIL) => Trouble::NoAddress(port.address.ip()),
        Some(Errno::ENODEV) => Trouble::NoInterface {
            name: port.interface.clone().unwrap_or_default(),
            present: Vec::new(),
        },
        _ => Trouble::Refused {
            port: port.clone(),
            source,
        },
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::Interface;

    fn port(address: std::net::SocketAddr) -> WantedPort {
        WantedPort {
            protocol: IpProtocol::Udp,
            address,
            of: "shuttle/command".to_owned(),
            key: "links.hop.port".to_owned(),
            address_key: "hosts.a.address".to_owned(),
            interface: None,
            is_dispensable: false,
        }
    }

    #[test]
    fn a_port_in_use_is_told_with_key_and_holder_and_one_that_is_free_is_not() {
        let socket = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        let plan = Plan {
            ports: vec![port(socket.local_addr().unwrap())],
            ..Plan::default()
        };
        let found = obstacles(&plan);
        assert_eq!(found.len(), 1, "{found:?}");
        assert_eq!(found[0].key, "links.hop.port");
        assert_eq!(found[0].effect, Effect::Prevents);
        let process = format!("(process {})", std::process::id());
        assert!(
            found[0].trouble.to_string().contains(&process),
            "{}",
            found[0].trouble
        );
        drop(socket);
        assert!(obstacles(&plan).is_empty());
    }

    #[test]
    fn an_address_that_is_not_here_is_told_once() {
        let ports = [7400, 7401].map(|number| port(([203, 0, 113, 77], number).into()));
        let plan = Plan {
            ports: ports.into(),
            ..Plan::default()
        };
        let found = obstacles(&plan);
        assert_eq!(found.len(), 1, "{found:?}");
        assert_eq!(found[0].key, "hosts.a.address");
        assert_eq!(
            found[0].trouble.to_string(),
            "no interface has 203.0.113.77"
        );
    }

    #[test]
    fn an_interface_without_a_carrier_holds_a_run_up_and_one_that_is_not_there_prevents_it() {
        let address = "10.0.0.1".parse().unwrap();
        let one = |is_up, has_link| Interface {
            is_up,
            has_link,
            addresses: vec![(address, 24)],
        };
        let way = |name: Option<&str>| WantedInterface {
            key: "hosts.a.interface".to_owned(),
            name: name.map(str::to_owned),
            address,
        };
        let judged = |interface: Interface, name| {
            let present = Interfaces::from([("eth0".to_owned(), interface)]);
            let found = on_the_way(&present, &way(name));
            found.map(|one| (one.effect, one.trouble.to_string()))
        };
        assert_eq!(judged(one(true, true), None), None);
        let (effect, words) = judged(one(true, false), None).unwrap();
        assert_eq!(effect, Effect::HoldsUp);
        assert!(
            words.starts_with("interface eth0 has no carrier"),
            "{words}"
        );
        let (effect, words) = judged(one(false, false), Some("eth0")).unwrap();
        assert_eq!(effect, Effect::HoldsUp);
        assert!(words.ends_with("ip link set eth0 up"), "{words}");
        let (effect, words) = judged(one(true, true), Some("eth7")).unwrap();
        assert_eq!(effect, Effect::Prevents);
        assert_eq!(words, "there is no interface eth7; there are eth0");
    }

    #[test]
    fn a_cpu_that_is_not_allowed_is_told_with_its_key() {
        let plan = Plan {
            pins: vec![Pin {
                cpu: 1000,
                key: "processes.robot.cpu".to_owned(),
                of: "robot".to_owned(),
                spins: false,
            }],
            ..Plan::default()
        };
        let found = obstacles(&plan);
        assert_eq!(found.len(), 1, "{found:?}");
        assert_eq!(found[0].effect, Effect::DoneWithout);
        assert!(
            found[0]
                .trouble
                .to_string()
                .starts_with("robot is pinned to CPU 1000")
        );
    }
}
