//! The network interfaces: which there are, what timestamps they claim, and how much the sockets may
//! buffer. Claims only: drivers lie, so a run probes its stamps by sending and reports the share that
//! came back.

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;

use hil_net::timestamping::TimestampCapabilities;
use nix::ifaddrs::{InterfaceAddress, getifaddrs};
use nix::net::if_::InterfaceFlags;
use nix::sys::socket::SockaddrStorage;

use super::finding::{Answer, Checked, Finding, Severity, settled};
use super::plan::Plan;
use hil_platform::host_facts::HostFiles;

/// A second of 1 kHz messages with their stamps; the kernel charges about 800 bytes for each.
const BUFFER_BYTES_MIN: i64 = 1024 * 1024;

/// Answers which timestamps an interface claims, or why not.
pub(super) type StampQuery<'a> = &'a dyn Fn(&str) -> Result<TimestampCapabilities, String>;

pub(super) fn has_software_both_ways(claims: &TimestampCapabilities) -> bool {
    claims.tx_software && claims.rx_software
}

pub(super) fn describe(claims: &TimestampCapabilities) -> String {
    let kind = |tx: bool, rx: bool| match (tx, rx) {
        (true, true) => "tx+rx",
        (true, false) => "tx only",
        (false, true) => "rx only",
        (false, false) => "none",
    };
    let software = kind(claims.tx_software, claims.rx_software);
    let hardware = kind(claims.tx_hardware, claims.rx_hardware);
    let clock = claims.phc_index;
    let clock = clock.map_or_else(String::new, |index| format!(" (/dev/ptp{index})"));
    format!("software {software}, hardware {hardware}{clock}")
}

/// One interface of this network namespace.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) struct Interface {
    /// It is switched on.
    pub(super) is_up: bool,
    /// And has a link.
    pub(super) has_link: bool,
    /// Its addresses with the length of their network part.
    pub(super) addresses: Vec<(IpAddr, u32)>,
}

/// The interfaces by name.
pub(super) type Interfaces = BTreeMap<String, Interface>;

/// The interfaces of this network namespace. Not from `/sys`, which may show another one's.
pub(super) fn interfaces() -> Result<Interfaces, String> {
    let entries = getifaddrs().map_err(|errno| format!("getifaddrs: {}", errno.desc()))?;
    let mut found = Interfaces::new();
    for entry in entries {
        let one = found.entry(entry.interface_name.clone()).or_default();
        let running = InterfaceFlags::IFF_UP | InterfaceFlags::IFF_RUNNING;
        one.is_up |= entry.flags.contains(InterfaceFlags::IFF_UP);
        one.has_link |= entry.flags.contains(running);
        one.addresses.extend(address_of(&entry));
    }
    Ok(found)
}

fn address_of(entry: &InterfaceAddress) -> Option<(IpAddr, u32)> {
    let of = |storage: &SockaddrStorage| {
        let v4 = storage.as_sockaddr_in().map(|a| IpAddr::V4(a.ip()));
        let v6 = storage.as_sockaddr_in6().map(|a| IpAddr::V6(a.ip()));
        v4.or(v6)
    };
    let address = of(entry.address.as_ref()?)?;
    let prefix = match entry.netmask.as_ref().and_then(of) {
        Some(IpAddr::V4(mask)) => mask.to_bits().count_ones(),
        Some(IpAddr::V6(mask)) => mask.to_bits().count_ones(),
        // A point-to-point address may come without a mask.
        None if address.is_ipv4() => 32,
        None => 128,
    };
    Some((address, prefix))
}

/// The names to look at: those of the plan, by name or address, else every one that is up.
pub(super) fn wanted(present: &Interfaces, plan: &Plan) -> Vec<String> {
    let mut names = plan.interfaces.iter().cloned().collect::<BTreeSet<_>>();
    for (name, interface) in present {
        let mut own = interface.addresses.iter();
        if own.any(|(address, _)| plan.addresses.contains(address)) {
            names.insert(name.clone());
        }
    }
    if names.is_empty() {
        let up = present.iter().filter(|(_, one)| one.is_up);
        names.extend(up.map(|(name, _)| name.clone()));
    }
    names.into_iter().collect()
}

/// True for an interface with hardware, or a paravirtual device, behind it.
pub(super) fn has_device(files: &HostFiles, name: &str) -> bool {
    has_entry(files, name, "device")
}

fn has_entry(files: &HostFiles, name: &str, entry: &str) -> bool {
    let path = format!("/sys/class/net/{name}/{entry}");
    files.locate(&path).exists()
}

pub(super) fn examine(
    files: &HostFiles,
    present: &Interfaces,
    names: &[String],
    query: StampQuery<'_>,
) -> Vec<Finding> {
    let stamps = names.iter().map(|name| {
        let Some(interface) = present.get(name) else {
            let known: Vec<&str> = present.keys().map(String::as_str).collect();
            return Finding::error("interface", "there is none of this name")
                .of(name)
                .fixed_by(format!("name one of {}", known.join(", ")));
        };
        let is_wireless = ["wireless", "phy80211"];
        let is_wireless = is_wireless
            .iter()
            .any(|entry| has_entry(files, name, entry));
        let claims = query(name).told("timestamps");
        settled(claims.map(|claims| judge(&claims, is_wireless, interface))).of(name)
    });
    stamps.chain([settled(buffers(files))]).collect()
}

fn judge(claims: &TimestampCapabilities, is_wireless: bool, interface: &Interface) -> Finding {
    let claimed = describe(claims);
    let wireless = if is_wireless { ", wireless" } else { "" };
    let link = if interface.has_link {
        ""
    } else {
        ", link down"
    };
    let is_good = has_software_both_ways(claims) && !is_wireless;
    let finding = Finding::new(
        "timestamps",
        Severity::ok_if(is_good, Severity::Note),
        format!("{claimed}{wireless}{link}"),
    );
    if is_wireless {
        return finding
            .because(
                "wireless drivers stamp no departures whatever they claim, so a run asks for the \
                 stamp before the queue instead and for the radio's acknowledgements",
            )
            .fixed_by("none needed; the report says which stamps there were");
    }
    if claims.tx_hardware && claims.rx_hardware {
        return finding.because(
            "claimed only: some drivers advertise hardware stamps that never arrive, so a run \
             probes them before it relies on them",
        );
    }
    finding
}

/// A network namespace other than the first one hides these limits.
fn buffers(files: &HostFiles) -> Checked {
    let id = "udp_buffers";
    let read = |name: &str| {
        files
            .read_number(&format!("/proc/sys/net/core/{name}"))
            .told(id)
    };
    let (receive, send) = (read("rmem_max")?, read("wmem_max")?);
    let severity = Severity::ok_if(receive.min(send) >= BUFFER_BYTES_MIN, Severity::Note);
    let value = format!("receive {receive} bytes, send {send} bytes");
    Ok(Finding::new(id, severity, value))
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_platform::host_facts::FakeHost;

    const DEAF: TimestampCapabilities = TimestampCapabilities {
        tx_software: false,
        rx_software: false,
        tx_hardware: false,
        rx_hardware: false,
        phc_index: None,
    };
    const VETH: TimestampCapabilities = TimestampCapabilities {
        tx_software: true,
        rx_software: true,
        ..DEAF
    };
    const IGB: TimestampCapabilities = TimestampCapabilities {
        tx_hardware: true,
        rx_hardware: true,
        phc_index: Some(0),
        ..VETH
    };

    fn judged(claims: &TimestampCapabilities, is_wireless: bool) -> Finding {
        judge(claims, is_wireless, &present("x", [10, 0, 0, 1]).1)
    }

    fn present(name: &str, address: [u8; 4]) -> (String, Interface) {
        let interface = Interface {
            is_up: true,
            has_link: true,
            addresses: vec![(address.into(), 24)],
        };
        (name.to_owned(), interface)
    }

    #[test]
    fn the_claims_are_put_into_words() {
        assert_eq!(describe(&VETH), "software tx+rx, hardware none");
        assert_eq!(describe(&IGB), "software tx+rx, hardware tx+rx (/dev/ptp0)");
        let wireless = TimestampCapabilities {
            rx_software: true,
            ..DEAF
        };
        assert_eq!(describe(&wireless), "software rx only, hardware none");
    }

    #[test]
    fn claims_are_labelled_as_claims() {
        assert_eq!(judged(&VETH, false).severity, Severity::Ok);
        assert!(judged(&IGB, false).why.contains("claimed only"));
        assert_eq!(judged(&VETH, true).severity, Severity::Note);
        assert_eq!(judged(&DEAF, false).severity, Severity::Note);
        assert!(
            judge(&VETH, false, &Interface::default())
                .value
                .ends_with("link down")
        );
    }

    #[test]
    fn interfaces_are_asked_once_and_silence_is_no_pass() {
        let host = FakeHost::with(&[]);
        let asked = std::cell::RefCell::new(Vec::new());
        let query = |name: &str| {
            asked.borrow_mut().push(name.to_owned());
            if name == "lo" {
                Ok(VETH)
            } else {
                Err("no".to_owned())
            }
        };
        let here = Interfaces::from([present("lo", [127, 0, 0, 1]), present("e", [10, 0, 0, 1])]);
        let names = ["lo", "e", "nosuch0"].map(str::to_owned);
        let findings = examine(&host.files(), &here, &names, &query);
        assert_eq!(*asked.borrow(), ["lo", "e"]);
        let found: Vec<(&str, Severity)> = findings
            .iter()
            .map(|finding| (finding.id.as_str(), finding.severity))
            .collect();
        assert_eq!(
            found,
            [
                ("timestamps.lo", Severity::Ok),
                ("timestamps.e", Severity::CannotTell),
                ("interface.nosuch0", Severity::Error),
                ("udp_buffers", Severity::CannotTell),
            ]
        );
        assert!(findings[2].fix.contains("e, lo"), "{}", findings[2].fix);
    }

    #[test]
    fn a_plan_chooses_by_name_and_by_address() {
        let mut here = Interfaces::from([
            present("eth0", [10, 0, 0, 1]),
            present("eth1", [10, 1, 0, 1]),
        ]);
        here.insert("down0".to_owned(), Interface::default());
        assert_eq!(wanted(&here, &Plan::default()), ["eth0", "eth1"]);
        let plan = Plan {
            interfaces: vec!["nosuch0".to_owned()],
            addresses: vec![[10, 1, 0, 1].into()],
            ..Plan::default()
        };
        assert_eq!(wanted(&here, &plan), ["eth1", "nosuch0"]);
    }

    #[test]
    fn this_host_has_loopback_with_its_prefix() {
        let here = interfaces().unwrap();
        assert!(here["lo"].addresses.contains(&([127, 0, 0, 1].into(), 8)));
    }

    #[test]
    fn small_buffers_are_noted() {
        let files = |bytes| {
            FakeHost::with(&[
                ("/proc/sys/net/core/rmem_max", bytes),
                ("/proc/sys/net/core/wmem_max", bytes),
            ])
        };
        assert_eq!(
            settled(buffers(&files("212992").files())).severity,
            Severity::Note
        );
        assert_eq!(
            settled(buffers(&files("4194304").files())).severity,
            Severity::Ok
        );
    }
}
