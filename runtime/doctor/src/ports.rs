//! The ports of the topology against those that other programs hold, from the kernel's socket tables.
//! It binds none itself: a port tried a moment before a run would be in the run's way.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

use super::Finding;
use hil_protocol::transport::IpProtocol;

use super::plan::WantedPort;
use hil_platform::host_facts::{Fact, HostFiles};

/// `TCP_LISTEN` in the socket tables.
const LISTENING: &str = "0A";

/// A bound socket.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Bound {
    address: SocketAddr,
    inode: u64,
}

/// `None` when the topology needs no ports.
pub(super) fn examine(files: &HostFiles, wanted: &[WantedPort]) -> Option<Finding> {
    let id = "ports";
    if wanted.is_empty() {
        return None;
    }
    let mut taken = Vec::new();
    for protocol in [IpProtocol::Udp, IpProtocol::Tcp] {
        let mut own = wanted
            .iter()
            .filter(|one| one.protocol == protocol)
            .peekable();
        if own.peek().is_none() {
            continue;
        }
        let bound = match bound(files, protocol) {
            Fact::Available(bound) => bound,
            Fact::Unavailable(reason) => return Some(Finding::cannot_tell(id, reason)),
        };
        taken.extend(own.filter_map(|one| {
            let other = bound
                .iter()
                .find(|bound| collide(bound.address, one.address))?;
            Some((one, *other))
        }));
    }
    if taken.is_empty() {
        return Some(Finding::ok(id, format!("free: {}", list(wanted))));
    }
    let words: Vec<String> = taken
        .iter()
        .map(|(one, other)| {
            let holder = holder(files, other.inode);
            let (word, address) = (one.protocol.word(), one.address);
            format!("{word} {address} of {} is held by {holder}", one.of)
        })
        .collect();
    Some(Finding::error(id, words.join("; ")))
}

/// Two sockets cannot have both, unless they agreed to.
fn collide(one: SocketAddr, other: SocketAddr) -> bool {
    let is_any = one.ip().is_unspecified() || other.ip().is_unspecified();
    one.port() == other.port() && (is_any || one.ip() == other.ip())
}

/// `udp 7400-7403, tcp 7399`.
fn list(wanted: &[WantedPort]) -> String {
    let parts = [IpProtocol::Udp, IpProtocol::Tcp].map(|protocol| {
        let own = wanted.iter().filter(|one| one.protocol == protocol);
        let mut ports: Vec<usize> = own.map(|one| usize::from(one.address.port())).collect();
        ports.sort_unstable();
        ports.dedup();
        (!ports.is_empty()).then(|| {
            let ports = hil_platform::host_facts::format_cpu_list(&ports);
            format!("{} {ports}", protocol.word())
        })
    });
    parts.into_iter().flatten().collect::<Vec<_>>().join(", ")
}

fn bound(files: &HostFiles, protocol: IpProtocol) -> Fact<Vec<Bound>> {
    let word = protocol.word();
    let first = format!("/proc/net/{word}");
    let second = format!("/proc/net/{word}6");
    files.read(&first).and_then(|text| {
        let mut found = parse(&text, protocol);
        // A kernel without IPv6 has no such file.
        if files.locate(&second).exists() {
            match files.read(&second) {
                Fact::Available(text) => found.extend(parse(&text, protocol)),
                Fact::Unavailable(reason) => return Fact::Unavailable(reason),
            }
        }
        Fact::Available(found)
    })
}

fn parse(text: &str, protocol: IpProtocol) -> Vec<Bound> {
    let lines = text.lines().skip(1).filter_map(|line| {
        let words: Vec<&str> = line.split_whitespace().collect();
        if protocol == IpProtocol::Tcp && *words.get(3)? != LISTENING {
            return None;
        }
        Some(Bound {
            address: address(words.get(1)?)?,
            inode: words.get(9)?.parse().ok()?,
        })
    });
    lines.collect()
}

/// `0100007F:1CE8`: words of 32 bits in this host's order, then the port.
fn address(text: &str) -> Option<SocketAddr> {
    let (address, port) = text.split_once(':')?;
    let port = u16::from_str_radix(port, 16).ok()?;
    let mut bytes = Vec::new();
    for index in (0..address.len()).step_by(8) {
        let word = u32::from_str_radix(address.get(index..index + 8)?, 16).ok()?;
        bytes.extend(word.to_ne_bytes());
    }
    let ip: IpAddr = match bytes.len() {
        4 => Ipv4Addr::from(<[u8; 4]>::try_from(bytes).ok()?).into(),
        16 => {
            let ip = Ipv6Addr::from(<[u8; 16]>::try_from(bytes).ok()?);
            ip.to_ipv4_mapped().map_or(IpAddr::V6(ip), IpAddr::V4)
        }
        _ => return None,
    };
    Some(SocketAddr::new(ip, port))
}

/// Who has the socket open, as far as this user may see.
fn holder(files: &HostFiles, inode: u64) -> String {
    let wanted = format!("socket:[{inode}]");
    let processes = files.list("/proc");
    let processes = processes.available().cloned().unwrap_or_default();
    let numbers = processes
        .iter()
        .filter(|name| name.bytes().all(|byte| byte.is_ascii_digit()));
    for process in numbers {
        let folder = format!("/proc/{process}/fd");
        let descriptors = files.list(&folder);
        let mut open = descriptors.available().into_iter().flatten();
        let is_it = |one: &String| {
            files.link_target(&format!("{folder}/{one}")) == Fact::Available(wanted.clone())
        };
        if open.any(is_it) {
            let command = files.read(&format!("/proc/{process}/comm")).to_text();
            return format!("{command} (process {process})");
        }
    }
    "a process this user cannot see".to_owned()
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;
    use crate::finding::Severity;
    use hil_platform::host_facts::FakeHost;

    const HEADER: &str = "sl local_address rem_address st tx_queue tr tm->when uid timeout inode";

    fn line(local: &str, state: &str, inode: u64) -> String {
        format!("{HEADER}\n 0: {local} 00000000:0000 {state} 0:0 0:0 0 0 0 {inode} 2 0\n")
    }

    fn wanted(protocol: IpProtocol) -> Vec<WantedPort> {
        vec![WantedPort {
            protocol,
            address: "10.0.0.1:7400".parse().unwrap(),
            of: "shuttle/command".to_owned(),
        }]
    }

    /// 7400 in the kernel's order, at `ip`.
    fn local(ip: [u8; 4]) -> String {
        format!("{:08X}:1CE8", u32::from_ne_bytes(ip))
    }

    #[test]
    fn addresses_are_read_as_the_kernel_writes_them() {
        assert_eq!(
            address(&local([127, 0, 0, 1])),
            "127.0.0.1:7400".parse().ok()
        );
        let any = format!("{}:1CE8", "0".repeat(32));
        assert_eq!(address(&any), "[::]:7400".parse().ok());
        assert_eq!(address("0100"), None);
        assert_eq!(address("01:1CE8"), None);
    }

    #[test]
    fn a_port_in_use_is_told_with_its_holder() {
        let table = line(&local([0, 0, 0, 0]), "07", 4711);
        let files = [
            ("/proc/net/udp", table.as_str()),
            ("/proc/77/comm", "iperf3"),
            ("/proc/77/fd/none", ""),
        ];
        let host = FakeHost::with(&files);
        symlink("socket:[4711]", host.files().locate("/proc/77/fd/3")).unwrap();
        let finding = examine(&host.files(), &wanted(IpProtocol::Udp)).unwrap();
        assert_eq!(finding.severity, Severity::Error);
        assert_eq!(
            finding.value,
            "udp 10.0.0.1:7400 of shuttle/command is held by iperf3 (process 77)"
        );
    }

    #[test]
    fn other_addresses_and_connections_are_in_nobodys_way() {
        let elsewhere = line(&local([10, 0, 0, 9]), "07", 1);
        let connected = line(&local([10, 0, 0, 1]), "01", 1);
        let listening = line(&local([10, 0, 0, 1]), "0A", 1);
        for (path, table, protocol, expected) in [
            ("/proc/net/udp", &elsewhere, IpProtocol::Udp, Severity::Ok),
            ("/proc/net/tcp", &connected, IpProtocol::Tcp, Severity::Ok),
            (
                "/proc/net/tcp",
                &listening,
                IpProtocol::Tcp,
                Severity::Error,
            ),
        ] {
            let host = FakeHost::with(&[(path, table.as_str())]);
            let finding = examine(&host.files(), &wanted(protocol)).unwrap();
            assert_eq!(finding.severity, expected, "{finding:?}");
        }
    }

    #[test]
    fn an_unreadable_table_is_no_pass_and_no_ports_no_finding() {
        let host = FakeHost::with(&[]);
        let finding = examine(&host.files(), &wanted(IpProtocol::Udp)).unwrap();
        assert_eq!(finding.severity, Severity::CannotTell);
        assert_eq!(examine(&host.files(), &[]), None);
        let folder = FakeHost::with(&[("/proc/net/udp", HEADER), ("/proc/net/udp6/x", "")]);
        let finding = examine(&folder.files(), &wanted(IpProtocol::Udp)).unwrap();
        assert_eq!(finding.severity, Severity::CannotTell, "{finding:?}");
    }

    #[test]
    fn this_hosts_tables_show_a_socket_of_this_process() {
        let socket = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        let own = WantedPort {
            protocol: IpProtocol::Udp,
            address: socket.local_addr().unwrap(),
            of: "test".to_owned(),
        };
        let finding = examine(&HostFiles::of_this_host(), &[own]).unwrap();
        assert_eq!(finding.severity, Severity::Error);
        let process = format!("(process {})", std::process::id());
        assert!(finding.value.contains(&process), "{}", finding.value);
    }
}
