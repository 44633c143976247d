//! The ways to the peers of the topology: the route each takes, this host's own addresses, and the
//! largest message against the largest packet. It sends nothing.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, UdpSocket};

use super::finding::{Answer, Checked, Finding, settled};
use super::network::Interfaces;
use super::plan::{LinkLoad, Peer, Plan};
use hil_platform::host_facts::HostFiles;

/// The discard port (RFC 863); nothing is sent to it.
const ANY_PORT: u16 = 9;

/// The source address that the kernel takes towards an address, or why there is none.
pub(super) type SourceTowards<'a> = &'a dyn Fn(IpAddr) -> Result<IpAddr, String>;

/// Asks the kernel's routing, policy rules included, by connecting a datagram socket.
pub(super) fn source_towards(peer: IpAddr) -> Result<IpAddr, String> {
    let own: IpAddr = match peer {
        IpAddr::V4(_) => Ipv4Addr::UNSPECIFIED.into(),
        IpAddr::V6(_) => Ipv6Addr::UNSPECIFIED.into(),
    };
    let chosen = UdpSocket::bind((own, 0)).and_then(|socket| {
        socket.connect((peer, ANY_PORT))?;
        Ok(socket.local_addr()?.ip())
    });
    chosen.map_err(|error| error.to_string())
}

pub(super) fn examine(
    files: &HostFiles,
    present: &Interfaces,
    plan: &Plan,
    source: SourceTowards<'_>,
) -> Vec<Finding> {
    let mut findings = vec![settled(addresses(present, plan))];
    let peers = plan.peers.iter();
    findings.extend(peers.map(|peer| route(files, present, peer, source).of(&peer.name)));
    let loads = plan.loads.iter();
    findings.extend(loads.map(|load| settled(mtu(files, present, load)).of(&load.link)));
    findings
}

/// The interface that has `address`.
fn owner(present: &Interfaces, address: IpAddr) -> Option<&str> {
    let mut all = present.iter();
    all.find(|(_, one)| one.addresses.iter().any(|(own, _)| *own == address))
        .map(|(name, _)| name.as_str())
}

fn route(
    files: &HostFiles,
    present: &Interfaces,
    peer: &Peer,
    source: SourceTowards<'_>,
) -> Finding {
    let id = "route";
    let Peer { address, own, .. } = peer;
    let Some(own_interface) = owner(present, *own) else {
        let to = peer.interface.as_deref().unwrap_or("INTERFACE");
        return Finding::error(id, format!("no interface has {own}, this host's address"))
            .fixed_by(format!("ip address add {own}/24 dev {to}"));
    };
    if let Some(named) = &peer.interface
        && named != own_interface
    {
        let value = format!("{own} is on {own_interface}, and interface says {named}");
        return Finding::error(id, value).fixed_by(format!("interface = \"{own_interface}\""));
    }
    if let Some(interface) = owner(present, *address) {
        let value = format!("{address} is this host's own address, on {interface}");
        return Finding::error(id, value)
            .because("what is sent there never leaves the host: no network is measured")
            .fixed_by("give the two hosts different addresses in the topology");
    }
    let misled = |value| {
        let fix = format!("ip route add {address} dev {own_interface} src {own}");
        Finding::error(id, value).fixed_by(fix)
    };
    let chosen = match source(*address) {
        Ok(chosen) => chosen,
        Err(reason) => return misled(format!("none to {address}: {reason}")),
    };
    let by = owner(present, chosen).unwrap_or("an unknown interface");
    if by != own_interface {
        return misled(format!(
            "{address} by {by} from {chosen}, not by {own_interface} from {own}"
        ));
    }
    if let Some(device) = unanswered(files, *address) {
        let value = format!("{address} by {by}, but nobody answers for it on {device}");
        return Finding::warning(id, value)
            .because("no delay can be measured to a host that is not there")
            .fixed_by(format!(
                "ping -c 3 {address}; connect or start the other host"
            ));
    }
    Finding::ok(id, format!("{address} by {by} from {chosen}"))
}

/// The interface on which the kernel asked for `address` and got no answer.
fn unanswered(files: &HostFiles, address: IpAddr) -> Option<String> {
    let table = files.read("/proc/net/arp").known().ok()?;
    table.lines().find_map(|line| {
        // Address, type, flags, hardware address, mask, device; without flags the entry is
        // incomplete.
        let words: Vec<&str> = line.split_whitespace().collect();
        let is_it = words.first()?.parse() == Ok(address) && words.get(2) == Some(&"0x0");
        is_it.then(|| words.last().map(|device| (*device).to_owned()))?
    })
}

/// The network part of an address.
fn subnet(address: Ipv4Addr, prefix: u32) -> u32 {
    let mask = u32::MAX.checked_shl(32 - prefix.min(32)).unwrap_or(0);
    address.to_bits() & mask
}

fn addresses(present: &Interfaces, plan: &Plan) -> Checked {
    let id = "addresses";
    let mut all: Vec<(&str, Ipv4Addr, u32)> = Vec::new();
    for (name, interface) in present.iter().filter(|(_, interface)| interface.is_up) {
        for (address, prefix) in &interface.addresses {
            match address {
                IpAddr::V4(address) if !address.is_loopback() => {
                    all.push((name, *address, *prefix));
                }
                _ => {}
            }
        }
    }
    for (index, (name, address, prefix)) in all.iter().enumerate() {
        let others = all[index + 1..].iter().filter(|(other, ..)| other != name);
        for (other, there, other_prefix) in others {
            if address == there {
                let value = format!("{address} is on {name} and on {other}");
                return Ok(Finding::error(id, value)
                    .fixed_by(format!("ip address del {there}/{other_prefix} dev {other}")));
            }
            let shorter = *prefix.min(other_prefix);
            if shorter < 32 && subnet(*address, shorter) == subnet(*there, shorter) {
                let value = format!(
                    "{address}/{prefix} on {name} and {there}/{other_prefix} on {other} overlap"
                );
                let is_used = |own: &Ipv4Addr| plan.addresses.contains(&IpAddr::V4(*own));
                return Ok(if is_used(address) || is_used(there) {
                    Finding::warning(id, value)
                } else {
                    Finding::note(id, value)
                });
            }
        }
    }
    if all.is_empty() {
        return Err("no interface that is up has an IPv4 address").told(id);
    }
    let in_words =
        |(name, address, prefix): &(&str, Ipv4Addr, u32)| format!("{address}/{prefix} on {name}");
    let words: Vec<String> = all.iter().map(in_words).collect();
    Ok(Finding::ok(id, words.join(", ")))
}

fn mtu(files: &HostFiles, present: &Interfaces, load: &LinkLoad) -> Checked {
    let id = "mtu";
    let message = format!("{} of {} bytes", load.channel, load.message_bytes);
    if let Some(label) = load.cut_by {
        return Ok(Finding::ok(
            id,
            format!("{message}: {label} cuts its own segments"),
        ));
    }
    let interface = owner(present, load.own);
    let interface = interface.ok_or(format!("{message}: no interface has {}", load.own));
    let interface = interface.told(id)?;
    let path = format!("/sys/class/net/{interface}/mtu");
    let mtu = files.read_number(&path).told(id)?;
    let own = usize::try_from(mtu).map_err(|_negative| format!("{path}: {mtu} is no size"));
    let own = own.told(id)?;
    let configured = load.path_mtu_bytes;
    let Some(count) = load.datagram_count(own.min(configured)) else {
        let value = format!("{message}: {interface} carries {own} bytes, less than the headers");
        return Ok(Finding::error(id, value));
    };
    let packet = load.packet_bytes();
    let value = format!(
        "{message} is a packet of {packet}; {interface} carries {own}, path_mtu_bytes {configured}"
    );
    if count > 1 {
        return Ok(Finding::note(id, format!("{value}: {count} datagrams")));
    }
    if configured > own {
        let why = "the gateway takes the smaller of the two; this file says more than this \
                   host's interface carries";
        let fix = format!("path_mtu_bytes = {own}");
        return Ok(Finding::note(id, value).because(why).fixed_by(fix));
    }
    Ok(Finding::ok(id, value))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::finding::Severity;
    use crate::network::Interface;
    use hil_platform::host_facts::FakeHost;

    fn present(entries: &[(&str, &str, u32)]) -> Interfaces {
        let mut found = Interfaces::new();
        for (name, address, prefix) in entries {
            let one = found.entry((*name).to_owned()).or_insert(Interface {
                is_up: true,
                has_link: true,
                addresses: Vec::new(),
            });
            one.addresses.push((address.parse().unwrap(), *prefix));
        }
        found
    }

    fn two_networks() -> Interfaces {
        present(&[("eth0", "192.168.1.5", 24), ("eth1", "10.77.0.1", 24)])
    }

    fn peer(interface: Option<&str>) -> Peer {
        Peer {
            name: "robot-pc".to_owned(),
            address: "10.77.0.2".parse().unwrap(),
            own: "10.77.0.1".parse().unwrap(),
            interface: interface.map(str::to_owned),
        }
    }

    fn routed(present: &Interfaces, peer: &Peer, chosen: Result<&str, &str>) -> Finding {
        let host = FakeHost::with(&[]);
        let source = |_| {
            chosen
                .map(|text| text.parse().unwrap())
                .map_err(str::to_owned)
        };
        route(&host.files(), present, peer, &source)
    }

    #[test]
    fn only_the_interface_of_the_topology_is_the_right_way() {
        let here = two_networks();
        let right = routed(&here, &peer(Some("eth1")), Ok("10.77.0.1"));
        assert_eq!(right.severity, Severity::Ok, "{right:?}");
        let wrong = routed(&here, &peer(None), Ok("192.168.1.5"));
        assert_eq!(wrong.severity, Severity::Error);
        assert!(
            wrong.value.contains("by eth0 from 192.168.1.5"),
            "{wrong:?}"
        );
        assert_eq!(wrong.fix, "ip route add 10.77.0.2 dev eth1 src 10.77.0.1");
        let none = routed(&here, &peer(None), Err("Network is unreachable"));
        assert_eq!(none.severity, Severity::Error);
        let named = routed(&here, &peer(Some("wlan0")), Ok("10.77.0.1"));
        assert_eq!(named.fix, "interface = \"eth1\"");
    }

    #[test]
    fn addresses_that_are_missing_or_the_peers_are_errors() {
        let elsewhere = present(&[("eth0", "192.168.1.5", 24)]);
        let missing = routed(&elsewhere, &peer(Some("eth0")), Ok("192.168.1.5"));
        assert_eq!(missing.severity, Severity::Error);
        assert_eq!(missing.fix, "ip address add 10.77.0.1/24 dev eth0");
        let both = present(&[("eth0", "10.77.0.1", 24), ("eth0", "10.77.0.2", 24)]);
        let own = routed(&both, &peer(None), Ok("10.77.0.1"));
        assert_eq!(own.severity, Severity::Error);
        assert!(own.why.contains("never leaves"), "{own:?}");
    }

    #[test]
    fn a_neighbour_that_did_not_answer_is_told() {
        let table = "IP address HW type Flags HW address Mask Device\n\
                     10.77.0.2 0x1 0x0 00:00:00:00:00:00 * eth1\n";
        let host = FakeHost::with(&[("/proc/net/arp", table)]);
        let source = |_| Ok("10.77.0.1".parse().unwrap());
        let finding = route(&host.files(), &two_networks(), &peer(None), &source);
        assert_eq!(finding.severity, Severity::Warning, "{finding:?}");
        let table = table.replace("0x0 ", "0x2 ");
        let host = FakeHost::with(&[("/proc/net/arp", table.as_str())]);
        let finding = route(&host.files(), &two_networks(), &peer(None), &source);
        assert_eq!(finding.severity, Severity::Ok, "{finding:?}");
    }

    #[test]
    fn doubles_and_overlaps_are_found() {
        let judged = |entries: &[(&str, &str, u32)], own: &[&str]| {
            let plan = Plan {
                addresses: own.iter().map(|text| text.parse().unwrap()).collect(),
                ..Plan::default()
            };
            settled(addresses(&present(entries), &plan))
        };
        let double = [("eth0", "10.0.0.1", 24), ("eth1", "10.0.0.1", 24)];
        assert_eq!(judged(&double, &[]).severity, Severity::Error);
        assert_eq!(
            judged(&double, &[]).fix,
            "ip address del 10.0.0.1/24 dev eth1"
        );
        let overlap = [("eth0", "10.0.0.1", 8), ("eth1", "10.9.0.1", 24)];
        assert_eq!(judged(&overlap, &[]).severity, Severity::Note);
        assert_eq!(judged(&overlap, &["10.9.0.1"]).severity, Severity::Warning);
        let plain = [("lo", "127.0.0.1", 8), ("eth0", "10.0.0.1", 24)];
        assert_eq!(judged(&plain, &[]).value, "10.0.0.1/24 on eth0");
        assert_eq!(judged(&plain, &[]).severity, Severity::Ok);
        assert_eq!(judged(&plain[..1], &[]).severity, Severity::CannotTell);
    }

    fn sized(mtu: Option<&str>, message_bytes: usize, is_stream: bool) -> Finding {
        let file = mtu.map(|mtu| ("/sys/class/net/eth1/mtu", mtu));
        let host = FakeHost::with(file.as_slice());
        let load = LinkLoad {
            link: "hop".to_owned(),
            channel: "status".to_owned(),
            message_bytes,
            path_mtu_bytes: 1500,
            own: "10.77.0.1".parse().unwrap(),
            header_bytes: 28,
            cut_by: is_stream.then_some("TCP"),
        };
        mtu_of(&host, &load)
    }

    fn mtu_of(host: &FakeHost, load: &LinkLoad) -> Finding {
        settled(mtu(&host.files(), &two_networks(), load))
    }

    #[test]
    fn messages_are_held_against_the_interface() {
        assert_eq!(sized(Some("1500"), 1400, false).severity, Severity::Ok);
        let cut = sized(Some("9000"), 1401, false);
        assert_eq!(cut.severity, Severity::Note);
        assert!(cut.value.ends_with("2 datagrams"), "{cut:?}");
        let narrow = sized(Some("1400"), 64, false);
        assert_eq!(narrow.fix, "path_mtu_bytes = 1400");
        assert_eq!(sized(Some("90"), 64, false).severity, Severity::Error);
        assert_eq!(sized(Some("-1"), 64, false).severity, Severity::CannotTell);
        assert_eq!(sized(None, 64, false).severity, Severity::CannotTell);
        assert_eq!(sized(None, 9000, true).severity, Severity::Ok);
    }

    #[test]
    fn the_kernel_names_a_source_without_sending() {
        let loopback = IpAddr::V4(Ipv4Addr::LOCALHOST);
        assert_eq!(source_towards(loopback), Ok(loopback));
    }
}
