//! The ports of the topology against those that other programs hold, from the kernel's socket tables.
//! It binds none itself: a port tried a moment before a run would be in the run's way.

use std::collections::BTreeSet;

use hil_protocol::transport::IpProtocol;

use super::finding::{Answer, Checked, Finding, settled};
use hil_platform::host_facts::{Fact, HostFiles, format_cpu_list};
use hil_platform::socket_table::{self, IpSocket, LISTENING};
use hil_topology::{WantedPort, collide};

/// `None` when the topology needs no ports.
pub(super) fn examine(files: &HostFiles, wanted: &[WantedPort]) -> Option<Finding> {
    (!wanted.is_empty()).then(|| settled(check(files, wanted)))
}

fn check(files: &HostFiles, wanted: &[WantedPort]) -> Checked {
    let id = "ports";
    let (mut taken, mut free) = (Vec::new(), Vec::new());
    for (protocol, ports) in by_protocol(wanted) {
        let word = protocol.word();
        let bound = bound(files, protocol).told(id)?;
        for one in wanted.iter().filter(|one| one.protocol == protocol) {
            let (address, of, key) = (one.address, &one.of, &one.key);
            if let Some(other) = bound.iter().find(|bound| collide(bound.local, address)) {
                let holder = holder(files, other.inode);
                taken.push(format!(
                    "{word} {address} of {of} ({key}) is held by {holder}"
                ));
            }
        }
        // `udp 7400-7403, tcp 7399`.
        let ports: Vec<usize> = ports.into_iter().map(usize::from).collect();
        free.push(format!("{word} {}", format_cpu_list(&ports)));
    }
    Ok(if taken.is_empty() {
        Finding::ok(id, format!("free: {}", free.join(", ")))
    } else {
        Finding::error(id, taken.join("; "))
    })
}

/// The ports of each protocol that has some, in ascending order.
pub(super) fn by_protocol(wanted: &[WantedPort]) -> Vec<(IpProtocol, BTreeSet<u16>)> {
    let ports = [IpProtocol::Udp, IpProtocol::Tcp].map(|protocol| {
        let own = wanted.iter().filter(|one| one.protocol == protocol);
        (protocol, own.map(|one| one.address.port()).collect())
    });
    let has_some = |(_, ports): &(IpProtocol, BTreeSet<u16>)| !ports.is_empty();
    ports.into_iter().filter(has_some).collect()
}

/// Sockets that have a port: of TCP those that listen.
fn bound(files: &HostFiles, protocol: IpProtocol) -> Result<Vec<IpSocket>, String> {
    let first = format!("/proc/net/{}", protocol.word());
    let second = format!("{first}6");
    let mut tables = vec![files.read(&first).known()?];
    // A kernel without IPv6 has no such file.
    if files.locate(&second).exists() {
        tables.push(files.read(&second).known()?);
    }
    let sockets = tables.iter().flat_map(|table| socket_table::parse(table));
    let has_port = |one: &IpSocket| protocol == IpProtocol::Udp || one.state == LISTENING;
    Ok(sockets.filter(has_port).collect())
}

/// Who holds a port that a run wants, as far as this user may see.
pub(super) fn holder_of(files: &HostFiles, wanted: &WantedPort) -> String {
    let bound = bound(files, wanted.protocol).unwrap_or_default();
    let mut colliding = bound
        .iter()
        .filter(|one| collide(one.local, wanted.address));
    colliding.next().map_or_else(
        || "a process this user cannot see".to_owned(),
        |one| holder(files, one.inode),
    )
}

/// Who has the socket open, as far as this user may see.
fn holder(files: &HostFiles, inode: u64) -> String {
    let wanted = Fact::Available(format!("socket:[{inode}]"));
    let processes = files.list("/proc").known().unwrap_or_default();
    let is_number = |name: &&String| name.bytes().all(|byte| byte.is_ascii_digit());
    for process in processes.iter().filter(is_number) {
        let folder = format!("/proc/{process}/fd");
        let mut open = files.list(&folder).known().unwrap_or_default().into_iter();
        if open.any(|one| files.link_target(&format!("{folder}/{one}")) == wanted) {
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
            key: "links.hop.port".to_owned(),
            address_key: "hosts.a.address".to_owned(),
            interface: None,
            is_dispensable: false,
        }]
    }

    /// 7400 in the kernel's order, at `ip`.
    fn local(ip: [u8; 4]) -> String {
        format!("{:08X}:1CE8", u32::from_ne_bytes(ip))
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
            "udp 10.0.0.1:7400 of shuttle/command (links.hop.port) is held by iperf3 (process 77)"
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
            key: "links.hop.port".to_owned(),
            address_key: "hosts.a.address".to_owned(),
            interface: None,
            is_dispensable: false,
        };
        let finding = examine(&HostFiles::of_this_host(), &[own]).unwrap();
        assert_eq!(finding.severity, Severity::Error);
        let process = format!("(process {})", std::process::id());
        assert!(finding.value.contains(&process), "{}", finding.value);
    }
}
