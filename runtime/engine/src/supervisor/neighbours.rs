//! At which link addresses this host reaches the others on its own network. Whoever answers there for the
//! address of another takes what is sent to it, and no seal sees that: so a change is told.
//! Of IPv4 only: changes of IPv6 neighbours are not seen.

use std::collections::BTreeMap;
use std::fs;
use std::net::IpAddr;

use hil_rundir::event::EventKind;
use hil_topology::{Host, Topology};

use super::session::is_here;

/// The kernel's table of IPv4 neighbours.
const TABLE: &str = "/proc/net/arp";
/// `ATF_COM`: the entry has a link address.
const COMPLETE: u32 = 2;

/// What is known of them.
#[derive(Debug)]
pub(super) struct Neighbours {
    /// Names of the other hosts by address.
    hosts: BTreeMap<IpAddr, String>,
    /// Their last link addresses, by address and interface.
    known: BTreeMap<(IpAddr, String), String>,
}

impl Neighbours {
    /// Of the hosts of `topology` beside `here`.
    pub(super) fn of(topology: &Topology, here: &[&Host]) -> Self {
        let others = topology.hosts().iter().filter(|host| !is_here(host, here));
        let hosts = others.map(|host| (host.gateway_address(), host.name.clone()));
        Self {
            hosts: hosts.collect(),
            known: BTreeMap::new(),
        }
    }

    /// What has changed since the last look.
    pub(super) fn changes(&mut self) -> Vec<EventKind> {
        // A kernel without the table has no such neighbours.
        self.read(&fs::read_to_string(TABLE).unwrap_or_default())
    }

    fn read(&mut self, table: &str) -> Vec<EventKind> {
        let changes = table.lines().filter_map(|line| {
            let words: Vec<&str> = line.split_whitespace().collect();
            let [address, _, flags, hardware, _, interface] = words[..] else {
                return None;
            };
            let address: IpAddr = address.parse().ok()?;
            let peer = self.hosts.get(&address)?.clone();
            let flags = u32::from_str_radix(flags.strip_prefix("0x")?, 16).ok()?;
            if flags & COMPLETE == 0 {
                return None;
            }
            let place = (address, interface.to_owned());
            let before = self.known.insert(place, hardware.to_owned())?;
            (before != hardware).then(|| EventKind::NeighbourChanged {
                peer,
                address,
                interface: interface.to_owned(),
                before,
                now: hardware.to_owned(),
            })
        });
        changes.collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_link_address_is_told_and_an_entry_without_one_is_not() {
        let address = "10.77.0.2".parse().unwrap();
        let mut neighbours = Neighbours {
            hosts: BTreeMap::from([(address, "robot-pc".to_owned())]),
            known: BTreeMap::new(),
        };
        let table = |address: &str, flags: &str, hardware: &str| {
            format!(
                "IP address       HW type     Flags       HW address            Mask     Device\n\
                 {address}        0x1         {flags}         {hardware}     *        eth0\n"
            )
        };
        let (first, second) = ("02:00:00:00:00:01", "02:00:00:00:00:02");
        let incomplete = table("10.77.0.2", "0x0", "00:00:00:00:00:00");
        for quiet in [
            incomplete.clone(),
            table("10.77.0.2", "0x2", first),
            incomplete,
            table("10.77.0.2", "0x6", first),
            table("10.77.0.3", "0x2", second),
        ] {
            assert_eq!(neighbours.read(&quiet), [], "{quiet}");
        }
        let changes = neighbours.read(&table("10.77.0.2", "0x2", second));
        let [EventKind::NeighbourChanged { before, now, .. }] = &changes[..] else {
            panic!("{changes:?}");
        };
        assert_eq!((before.as_str(), now.as_str()), (first, second));
    }
}
