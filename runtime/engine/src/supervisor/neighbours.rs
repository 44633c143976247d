//! At which link addresses this host reaches the others on its own network. Whoever answers there for the
//! address of another (ARP, RFC 826; neighbour discovery, RFC 4861) takes what is sent to it, and no seal sees that:
//! so a change is told.

use std::collections::BTreeMap;
use std::io;
use std::net::IpAddr;

use hil_rundir::event::EventKind;
use hil_topology::{Host, Topology};
use netlink_packet_core::{
    NLM_F_DUMP, NLM_F_REQUEST, NetlinkHeader, NetlinkMessage, NetlinkPayload,
};
use netlink_packet_route::RouteNetlinkMessage;
use netlink_packet_route::neighbour::{NeighbourAddress, NeighbourAttribute, NeighbourMessage};
use netlink_sys::protocols::NETLINK_ROUTE;
use netlink_sys::{Socket, SocketAddr};
use nix::net::if_::if_indextoname;

use super::session::is_here;

/// Messages of netlink begin at multiples of this (`NLMSG_ALIGNTO`).
const ALIGNMENT_BYTES: usize = 4;

/// A neighbour that can be reached now.
#[derive(Debug)]
struct Neighbour {
    address: IpAddr,
    interface: String,
    /// Its link address.
    hardware: String,
}

/// What is known of them.
#[derive(Debug)]
pub(super) struct Neighbours {
    /// Names of the other hosts by address.
    hosts: BTreeMap<IpAddr, String>,
    /// Their last link addresses, by address and interface.
    known: BTreeMap<(IpAddr, String), String>,
    /// That they cannot be listed is told once.
    has_failed: bool,
}

impl Neighbours {
    /// Of the hosts of `topology` beside `here`.
    pub(super) fn of(topology: &Topology, here: &[&Host]) -> Self {
        let others = topology.hosts().iter().filter(|host| !is_here(host, here));
        let hosts = others.map(|host| (host.gateway_address(), host.name.clone()));
        Self {
            hosts: hosts.collect(),
            known: BTreeMap::new(),
            has_failed: false,
        }
    }

    /// What has changed since the last look.
    pub(super) fn changes(&mut self) -> Vec<EventKind> {
        self.compare(list())
    }

    fn compare(&mut self, there: io::Result<Vec<Neighbour>>) -> Vec<EventKind> {
        let there = match there {
            Ok(there) => there,
            Err(_) if self.has_failed => return Vec::new(),
            Err(error) => {
                self.has_failed = true;
                let text = format!(
                    "the kernel does not list the neighbours of this host ({error}): a change of another \
                     host's link address may not be told"
                );
                return vec![EventKind::Warning { text }];
            }
        };
        let changes = there.into_iter().filter_map(|one| {
            let Neighbour {
                address,
                interface,
                hardware: now,
            } = one;
            let peer = self.hosts.get(&address)?.clone();
            let place = (address, interface.clone());
            let before = self.known.insert(place, now.clone())?;
            (before != now).then_some(EventKind::NeighbourChanged {
                peer,
                address,
                interface,
                before,
                now,
            })
        });
        changes.collect()
    }
}

/// The kernel's neighbours of both families in this network namespace.
fn list() -> io::Result<Vec<Neighbour>> {
    let socket = Socket::new(NETLINK_ROUTE)?;
    socket.connect(&SocketAddr::new(0, 0))?;
    // The kernel has the next part of its answer ready before the last one is taken.
    socket.set_non_blocking(true)?;
    let mut header = NetlinkHeader::default();
    header.flags = NLM_F_REQUEST | NLM_F_DUMP;
    let request = RouteNetlinkMessage::GetNeighbour(NeighbourMessage::default());
    let mut request = NetlinkMessage::new(header, NetlinkPayload::from(request));
    request.finalize();
    let mut bytes = vec![0; request.buffer_len()];
    request.serialize(&mut bytes);
    socket.send(&bytes, 0)?;
    let mut neighbours = Vec::new();
    loop {
        let (answer, _) = socket.recv_from_full()?;
        let mut rest = answer.as_slice();
        while !rest.is_empty() {
            let message = NetlinkMessage::<RouteNetlinkMessage>::deserialize(rest);
            let message = message.map_err(io::Error::other)?;
            match message.payload {
                NetlinkPayload::Done(_) => return Ok(neighbours),
                NetlinkPayload::Error(error) => return Err(error.to_io()),
                NetlinkPayload::InnerMessage(RouteNetlinkMessage::NewNeighbour(one)) => {
                    neighbours.extend(reachable(&one));
                }
                _ => {}
            }
            let length = (message.header.length as usize).next_multiple_of(ALIGNMENT_BYTES);
            rest = rest.get(length..).unwrap_or_default();
        }
    }
}

/// One that has a link address: the kernel gives none of an entry that is not valid.
fn reachable(message: &NeighbourMessage) -> Option<Neighbour> {
    let mut attributes = message.attributes.iter();
    let hardware = attributes.find_map(|one| match one {
        NeighbourAttribute::LinkLayerAddress(bytes) => Some(bytes),
        _ => None,
    })?;
    let mut attributes = message.attributes.iter();
    let address = attributes.find_map(|one| match one {
        NeighbourAttribute::Destination(NeighbourAddress::Inet(address)) => {
            Some(IpAddr::from(*address))
        }
        NeighbourAttribute::Destination(NeighbourAddress::Inet6(address)) => {
            Some(IpAddr::from(*address))
        }
        _ => None,
    })?;
    let hardware: Vec<String> = hardware.iter().map(|byte| format!("{byte:02x}")).collect();
    let interface = if_indextoname(message.header.ifindex).ok()?;
    Some(Neighbour {
        address,
        interface: interface.into_string().ok()?,
        hardware: hardware.join(":"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::Command;
    use std::thread;

    use nix::sched::{CloneFlags, unshare};

    #[test]
    fn another_link_address_is_told_of_either_family() {
        for text in ["10.77.0.2", "fd77::2"] {
            let address = text.parse().unwrap();
            let mut neighbours = Neighbours {
                hosts: BTreeMap::from([(address, "robot-pc".to_owned())]),
                known: BTreeMap::new(),
                has_failed: false,
            };
            let there = |address: IpAddr, hardware: &str| {
                vec![Neighbour {
                    address,
                    interface: "eth0".to_owned(),
                    hardware: hardware.to_owned(),
                }]
            };
            let (first, second) = ("02:00:00:00:00:01", "02:00:00:00:00:02");
            let foreign = "10.77.0.3".parse().unwrap();
            for quiet in [
                there(address, first),
                Vec::new(),
                there(address, first),
                there(foreign, second),
                there(foreign, first),
            ] {
                assert_eq!(neighbours.compare(Ok(quiet)), []);
            }
            // Without a list nothing is forgotten.
            let unlisted = || Err(io::ErrorKind::WouldBlock.into());
            let told = neighbours.compare(unlisted());
            assert!(matches!(&told[..], [EventKind::Warning { .. }]), "{told:?}");
            assert_eq!(neighbours.compare(unlisted()), []);
            let changes = neighbours.compare(Ok(there(address, second)));
            let [EventKind::NeighbourChanged { before, now, .. }] = &changes[..] else {
                panic!("{changes:?}");
            };
            assert_eq!((before.as_str(), now.as_str()), (first, second));
        }
    }

    #[test]
    fn the_kernel_lists_its_neighbours_of_both_families() {
        let listed = thread::spawn(|| {
            if let Err(errno) = unshare(CloneFlags::CLONE_NEWNET) {
                println!("skipped: no network namespace ({errno})");
                return None;
            }
            for words in [
                "link add eth0 type veth peer name eth1",
                "link set eth0 up",
                "neigh add 10.77.0.2 lladdr 02:00:00:00:00:01 dev eth0 nud permanent",
                "neigh add fd77::2 lladdr 02:00:00:00:00:02 dev eth0 nud permanent",
            ] {
                let done = Command::new("ip").args(words.split(' ')).status();
                assert!(done.unwrap().success(), "{words}");
            }
            Some(list().unwrap())
        });
        let Some(listed) = listed.join().unwrap() else {
            return;
        };
        for (address, hardware) in [
            ("10.77.0.2", "02:00:00:00:00:01"),
            ("fd77::2", "02:00:00:00:00:02"),
        ] {
            let address: IpAddr = address.parse().unwrap();
            let found = listed.iter().find(|one| one.address == address);
            let found = found.unwrap_or_else(|| panic!("{listed:?}"));
            assert_eq!((&*found.interface, &*found.hardware), ("eth0", hardware));
        }
    }
}
