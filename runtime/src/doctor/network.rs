//! The network interfaces: what timestamps they claim, and how much the sockets may buffer. Claims
//! only: drivers lie, so a run probes its stamps by sending and reports the share that came back.

use std::collections::BTreeMap;

use nix::ifaddrs::getifaddrs;
use nix::net::if_::InterfaceFlags;
use serde::{Deserialize, Serialize};

use super::Finding;
use crate::host_facts::{Fact, HostFiles};

/// Bits of `SO_TIMESTAMPING` in `linux/net_tstamp.h`.
const TX_HARDWARE: u32 = 1 << 0;
const TX_SOFTWARE: u32 = 1 << 1;
const RX_HARDWARE: u32 = 1 << 2;
const RX_SOFTWARE: u32 = 1 << 3;
const RAW_HARDWARE: u32 = 1 << 6;

/// A second of 1 kHz messages with their stamps; the kernel charges about 800 bytes for each.
const BUFFER_BYTES_MIN: i64 = 1024 * 1024;

/// What an interface claims it can stamp, as `ETHTOOL_GET_TS_INFO` answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct StampCapabilities {
    /// The `so_timestamping` bits of the answer.
    pub so_timestamping: u32,
    /// The number N of the interface's clock `/dev/ptpN`, if it has one.
    pub hardware_clock_index: Option<u32>,
}

impl StampCapabilities {
    fn has(self, bits: u32) -> bool {
        self.so_timestamping & bits == bits
    }

    pub(super) fn has_software_both_ways(self) -> bool {
        self.has(RX_SOFTWARE | TX_SOFTWARE)
    }

    pub(super) fn describe(self) -> String {
        describe(self)
    }
}

/// Answers which timestamps an interface claims.
///
/// The system call belongs to the gateways; any closure of this shape serves.
pub trait StampCapabilityQuery {
    /// Asks for the interface called `interface`.
    ///
    /// # Errors
    /// Why the interface did not answer, in words.
    fn stamp_capabilities(&self, interface: &str) -> Result<StampCapabilities, String>;
}

impl<F> StampCapabilityQuery for F
where
    F: Fn(&str) -> Result<StampCapabilities, String>,
{
    fn stamp_capabilities(&self, interface: &str) -> Result<StampCapabilities, String> {
        self(interface)
    }
}

pub(crate) fn examine(
    files: &HostFiles,
    wanted: &[String],
    query: &dyn StampCapabilityQuery,
) -> Vec<Finding> {
    let mut findings = Vec::new();
    match interfaces() {
        Ok(present) => {
            let names: Vec<&String> = if wanted.is_empty() {
                present.keys().collect()
            } else {
                wanted.iter().collect()
            };
            for name in names {
                findings.push(match present.get(name) {
                    Some(flags) => interface(files, name, *flags, query),
                    None => missing(name, &present),
                });
            }
        }
        Err(reason) => {
            findings.push(Finding::unknown(
                "timestamps",
                "Network interfaces",
                &reason,
            ));
        }
    }
    findings.push(buffers(files));
    findings
}

/// The interfaces of this network namespace with their flags, sorted by name.
pub(super) fn interfaces() -> Result<BTreeMap<String, InterfaceFlags>, String> {
    let addresses = getifaddrs().map_err(|errno| format!("getifaddrs: {errno}"))?;
    Ok(addresses
        .map(|address| (address.interface_name, address.flags))
        .collect())
}

fn missing(name: &str, present: &BTreeMap<String, InterfaceFlags>) -> Finding {
    let known: Vec<&str> = present.keys().map(String::as_str).collect();
    Finding::problem(
        &format!("timestamps.{name}"),
        &format!("Stamps on {name}"),
        "no such interface",
    )
    .because("the topology names it, so the run cannot start")
    .fixed_by(format!("use one of {}", known.join(", ")))
}

fn interface(
    files: &HostFiles,
    name: &str,
    flags: InterfaceFlags,
    query: &dyn StampCapabilityQuery,
) -> Finding {
    let (id, title) = (format!("timestamps.{name}"), format!("Stamps on {name}"));
    let capabilities = match query.stamp_capabilities(name) {
        Ok(capabilities) => capabilities,
        Err(reason) => return Finding::unknown(&id, &title, &reason),
    };
    let is_wireless = ["wireless", "phy80211"].iter().any(|entry| {
        files
            .locate(&format!("/sys/class/net/{name}/{entry}"))
            .exists()
    });
    let is_up = flags.contains(InterfaceFlags::IFF_UP | InterfaceFlags::IFF_RUNNING);
    let value = format!(
        "{}{}{}",
        describe(capabilities),
        if is_wireless { ", wireless" } else { "" },
        if is_up { "" } else { ", link down" }
    );
    judge(Finding::good(&id, &title, value), capabilities, is_wireless)
}

fn judge(finding: Finding, capabilities: StampCapabilities, is_wireless: bool) -> Finding {
    if is_wireless {
        return worsen(finding)
            .because(
                "wireless drivers stamp no departures whatever they claim, so a run asks for the \
                 stamp before the queue instead and for the radio's acknowledgements",
            )
            .fixed_by("none needed; the report says which stamps there were");
    }
    if !capabilities.has(RX_SOFTWARE) || !capabilities.has(TX_SOFTWARE) {
        return worsen(finding)
            .because("without kernel stamps the scheduler's delay is counted as the network's")
            .fixed_by("use a driver with software stamps (ethtool -T shows them)");
    }
    if capabilities.has(TX_HARDWARE | RX_HARDWARE | RAW_HARDWARE) {
        return finding.because(
            "claimed only: some drivers advertise hardware stamps that never arrive, so a run \
             probes them before it relies on them",
        );
    }
    finding
}

fn worsen(mut finding: Finding) -> Finding {
    finding.state = super::State::Note;
    finding
}

fn describe(capabilities: StampCapabilities) -> String {
    let kind = |tx: u32, rx: u32| match (capabilities.has(tx), capabilities.has(rx)) {
        (true, true) => "tx+rx",
        (true, false) => "tx only",
        (false, true) => "rx only",
        (false, false) => "none",
    };
    let software = kind(TX_SOFTWARE, RX_SOFTWARE);
    let hardware = kind(TX_HARDWARE | RAW_HARDWARE, RX_HARDWARE | RAW_HARDWARE);
    let clock = match capabilities.hardware_clock_index {
        Some(index) => format!(" (/dev/ptp{index})"),
        None => String::new(),
    };
    format!("software {software}, hardware {hardware}{clock}")
}

fn buffers(files: &HostFiles) -> Finding {
    let (id, title) = ("udp_buffers", "Largest socket buffers");
    let read = |name: &str| files.read_number(&format!("/proc/sys/net/core/{name}"));
    match (read("rmem_max"), read("wmem_max")) {
        (Fact::Available(receive), Fact::Available(send)) => {
            let is_good = receive >= BUFFER_BYTES_MIN && send >= BUFFER_BYTES_MIN;
            Finding::note_unless(
                is_good,
                id,
                title,
                format!("receive {receive} bytes, send {send} bytes"),
            )
            .because(
                "transmit stamps are charged to the receive buffer too: a small one fills within a \
                 stall of some 250 messages and then drops what arrives",
            )
            .fixed_by("sysctl net.core.rmem_max=4194304 net.core.wmem_max=4194304")
            .quiet_when_good()
        }
        (Fact::Unavailable(reason), _) | (_, Fact::Unavailable(reason)) => {
            // A network namespace other than the first one hides these limits.
            Finding::unknown(id, title, &reason)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::State;
    use crate::host_facts::FakeHost;

    const VETH: StampCapabilities = StampCapabilities {
        so_timestamping: 0x1a,
        hardware_clock_index: None,
    };
    const IGB: StampCapabilities = StampCapabilities {
        so_timestamping: 0x5f,
        hardware_clock_index: Some(0),
    };

    fn judged(capabilities: StampCapabilities, is_wireless: bool) -> Finding {
        let finding = Finding::good("timestamps.x", "Stamps on x", describe(capabilities));
        judge(finding, capabilities, is_wireless)
    }

    #[test]
    fn the_ethtool_bits_are_put_into_words() {
        assert_eq!(describe(VETH), "software tx+rx, hardware none");
        assert_eq!(describe(IGB), "software tx+rx, hardware tx+rx (/dev/ptp0)");
        let wireless = StampCapabilities {
            so_timestamping: 0x18,
            hardware_clock_index: None,
        };
        assert_eq!(describe(wireless), "software rx only, hardware none");
    }

    #[test]
    fn claims_are_labelled_as_claims() {
        assert_eq!(judged(VETH, false).state, State::Good);
        assert!(judged(IGB, false).why.contains("claimed only"));
        assert_eq!(judged(VETH, true).state, State::Note);
        let deaf = StampCapabilities {
            so_timestamping: 0,
            hardware_clock_index: None,
        };
        assert_eq!(judged(deaf, false).state, State::Note);
    }

    #[test]
    fn the_query_is_asked_once_per_interface() {
        let host = FakeHost::with(&[]);
        let asked = std::cell::RefCell::new(Vec::new());
        let query = |name: &str| {
            asked.borrow_mut().push(name.to_owned());
            Ok(VETH)
        };
        let findings = examine(&host.files(), &["lo".to_owned()], &query);
        assert_eq!(*asked.borrow(), ["lo"]);
        assert_eq!(findings[0].id, "timestamps.lo");
        assert!(
            findings[0].value.starts_with("software tx+rx"),
            "{}",
            findings[0].value
        );
    }

    #[test]
    fn an_interface_that_does_not_exist_is_a_problem() {
        let host = FakeHost::with(&[]);
        let query = |_: &str| Ok(VETH);
        let findings = examine(&host.files(), &["nosuch0".to_owned()], &query);
        assert_eq!(findings[0].state, State::Problem);
        assert!(findings[0].fix.contains("lo"), "{}", findings[0].fix);
    }

    #[test]
    fn small_buffers_are_noted() {
        let files = |bytes| {
            FakeHost::with(&[
                ("/proc/sys/net/core/rmem_max", bytes),
                ("/proc/sys/net/core/wmem_max", bytes),
            ])
        };
        assert_eq!(buffers(&files("212992").files()).state, State::Note);
        assert_eq!(buffers(&files("4194304").files()).state, State::Good);
        assert_eq!(buffers(&FakeHost::with(&[]).files()).state, State::Note);
    }
}
