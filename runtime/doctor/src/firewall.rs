//! Whether packets are filtered on their way in or out: the kernel's own list of base chains, whoever
//! filled them (nft, iptables-nft, firewalld, ufw). It reads chains, not the meaning of their rules.

use nix::sys::socket::SockProtocol;

use super::finding::{Answer, Checked, Finding};
use super::ports::by_protocol;
use hil_nic::radio::conversation::Conversation;
use hil_nic::radio::netlink::{Attributes, u32_at};
use hil_platform::host_facts::HostFiles;
use hil_topology::WantedPort;

/// `NFNL_SUBSYS_NFTABLES` and `NFT_MSG_GETCHAIN` of `linux/netfilter`.
const GET_CHAINS: u16 = (10 << 8) | 4;
const CHAIN_TABLE: u16 = 1;
const CHAIN_NAME: u16 = 3;
const CHAIN_HOOK: u16 = 4;
const CHAIN_POLICY: u16 = 5;
const CHAIN_USE: u16 = 6;
const HOOK_NUMBER: u16 = 1;
/// `NF_DROP`.
const DROP: u32 = 0;
/// Hooks of `linux/netfilter.h`, by number.
const HOOKS: [&str; 5] = ["prerouting", "input", "forward", "output", "postrouting"];
/// That which passes through this host is not ours.
const FORWARD: u32 = 2;
/// `NFPROTO_NETDEV`, whose hook 0 is ingress and 1 egress.
const NETDEV: u8 = 5;

/// A chain that packets go through.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Chain {
    name: String,
    hook: &'static str,
    is_dropping: bool,
    rule_count: u32,
}

/// The base chains that packets of this host go through.
///
/// # Errors
/// Why the kernel does not tell, in words.
pub(super) fn chains() -> Result<Vec<Chain>, String> {
    let mut talk = match Conversation::open(SockProtocol::NetlinkNetFilter) {
        Ok(talk) => talk,
        // No such protocol: no nf_tables in this kernel, hence no chains.
        Err(error) if error.raw_os_error() == Some(libc::EPROTONOSUPPORT) => return Ok(Vec::new()),
        Err(error) => return Err(format!("nfnetlink: {error}")),
    };
    let all_families = 0;
    let asked = talk.ask(GET_CHAINS, all_families, true, &[], Chain::decode);
    asked.map_err(|error| match error.raw_os_error() {
        Some(libc::EPERM | libc::EACCES) => {
            "needs root (CAP_NET_ADMIN) to see the rules".to_owned()
        }
        _ => format!("nfnetlink does not list the chains: {error}"),
    })
}

impl Chain {
    /// `None` for chains that other chains jump to, and for forwarding.
    fn decode(family: u8, attributes: Attributes<'_>) -> Option<Self> {
        let number = |bytes: &[u8]| u32_at(bytes, 0).map(u32::from_be);
        let hook = Attributes::nested(attributes.find(CHAIN_HOOK)?).find(HOOK_NUMBER)?;
        let hook = match (family, number(hook)?) {
            (_, FORWARD) => return None,
            (NETDEV, 0) => "ingress",
            (NETDEV, _) => "egress",
            (_, hook) => HOOKS.get(usize::try_from(hook).ok()?).copied()?,
        };
        let text = |number| {
            let bytes = attributes.find(number).unwrap_or_default();
            let text = String::from_utf8_lossy(bytes);
            text.trim_end_matches('\0').to_owned()
        };
        Some(Self {
            name: format!("{} {}", text(CHAIN_TABLE), text(CHAIN_NAME)),
            hook,
            is_dropping: attributes.find(CHAIN_POLICY).and_then(number) == Some(DROP),
            // Nothing jumps to a base chain, so each reference is a rule.
            rule_count: attributes.find(CHAIN_USE).and_then(number).unwrap_or(0),
        })
    }
}

pub(super) fn examine(
    files: &HostFiles,
    found: Result<Vec<Chain>, String>,
    wanted: &[WantedPort],
) -> Checked {
    let id = "firewall";
    let chains = found.map_err(|reason| {
        Finding::cannot_tell(id, reason)
            .fixed_by("sudo hil-runtime doctor, or sudo nft list ruleset")
    })?;
    let mut words = Vec::new();
    for chain in &chains {
        if chain.rule_count > 0 || chain.is_dropping {
            let policy = if chain.is_dropping { "drop" } else { "accept" };
            let (name, hook, count) = (&chain.name, chain.hook, chain.rule_count);
            words.push(format!("{name} ({hook}): {count} rules, else {policy}"));
        }
    }
    let words = words.join("; ");
    if chains.iter().any(|chain| chain.is_dropping) {
        return Ok(Finding::warning(id, words).fixed_by(cure(wanted)));
    }
    let mut legacy = Vec::new();
    for path in ["/proc/net/ip_tables_names", "/proc/net/ip6_tables_names"] {
        // Without the old interface there is no such file.
        if files.locate(path).exists() {
            let unknown = |reason| format!("iptables' own tables: {reason}");
            let tables = files.read(path).told_as(id, unknown)?;
            legacy.extend(tables.lines().map(str::to_owned));
        }
    }
    Ok(if !legacy.is_empty() {
        let value = format!(
            "tables of legacy iptables are loaded: {}",
            legacy.join(", ")
        );
        Finding::note(id, value).fixed_by("iptables-legacy -S shows their rules")
    } else if words.is_empty() {
        Finding::ok(id, "no rules on the way in or out")
    } else {
        Finding::note(id, words)
            .fixed_by("nft list ruleset shows whether the ports of the topology get through")
    })
}

/// Opens the ports of the topology.
fn cure(wanted: &[WantedPort]) -> String {
    let mut rules = Vec::new();
    for (protocol, ports) in by_protocol(wanted) {
        let ports: Vec<String> = ports.iter().map(ToString::to_string).collect();
        let (word, ports) = (protocol.word(), ports.join(", "));
        rules.push(format!(
            "nft add rule inet filter input {word} dport {{ {ports} }} accept"
        ));
    }
    if rules.is_empty() {
        return "hil-runtime doctor --topology FILE names the ports to open; nft list ruleset shows \
                the rules"
            .to_owned();
    }
    rules.join("; ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::finding::{Severity, settled};
    use hil_nic::radio::netlink::encode_attributes;
    use hil_platform::host_facts::FakeHost;
    use hil_protocol::transport::IpProtocol;

    fn chain(hook: u32, policy: u32, rules: u32) -> Option<Chain> {
        let hook = encode_attributes(&[(HOOK_NUMBER, &hook.to_be_bytes())]);
        let answer = encode_attributes(&[
            (CHAIN_TABLE, b"filter\0"),
            (CHAIN_NAME, b"input\0"),
            (CHAIN_HOOK, &hook),
            (CHAIN_POLICY, &policy.to_be_bytes()),
            (CHAIN_USE, &rules.to_be_bytes()),
        ]);
        Chain::decode(1, Attributes::nested(&answer))
    }

    fn wanted() -> Vec<WantedPort> {
        [
            (IpProtocol::Udp, 7400),
            (IpProtocol::Udp, 7403),
            (IpProtocol::Tcp, 7399),
        ]
        .map(|(protocol, port)| WantedPort {
            protocol,
            address: ([10, 0, 0, 1], port).into(),
            of: "x".to_owned(),
            key: "links.hop.port".to_owned(),
            address_key: "hosts.a.address".to_owned(),
            interface: None,
            is_dispensable: false,
        })
        .to_vec()
    }

    fn judged(found: Result<Vec<Chain>, String>, files: &[(&str, &str)]) -> Finding {
        settled(examine(&FakeHost::with(files).files(), found, &wanted()))
    }

    #[test]
    fn base_chains_are_decoded_and_others_left_out() {
        let found = chain(1, 0, 12).unwrap();
        assert_eq!(found.hook, "input");
        assert_eq!((found.is_dropping, found.rule_count), (true, 12));
        assert_eq!(chain(FORWARD, 0, 12), None);
        assert_eq!(chain(99, 0, 0), None);
        let jumped_to = encode_attributes(&[(CHAIN_NAME, b"docker\0")]);
        assert_eq!(Chain::decode(1, Attributes::nested(&jumped_to)), None);
    }

    #[test]
    fn a_dropping_policy_is_a_warning_with_the_rule_that_opens_the_ports() {
        let finding = judged(Ok(vec![chain(1, 0, 3).unwrap()]), &[]);
        assert_eq!(finding.severity, Severity::Warning);
        assert_eq!(finding.value, "filter input (input): 3 rules, else drop");
        assert_eq!(
            finding.fix,
            "nft add rule inet filter input udp dport { 7400, 7403 } accept; nft add rule inet \
             filter input tcp dport { 7399 } accept"
        );
    }

    #[test]
    fn rules_are_a_note_and_only_their_absence_is_ok() {
        let empty = chain(3, 1, 0).unwrap();
        assert_eq!(judged(Ok(vec![empty.clone()]), &[]).severity, Severity::Ok);
        let ruled = judged(Ok(vec![empty, chain(1, 1, 2).unwrap()]), &[]);
        assert_eq!(ruled.severity, Severity::Note);
        let names = "/proc/net/ip_tables_names";
        let legacy = judged(Ok(vec![]), &[(names, "filter\nnat")]);
        assert_eq!(legacy.severity, Severity::Note);
        assert_eq!(judged(Ok(vec![]), &[(names, "")]).severity, Severity::Ok);
    }

    #[test]
    fn what_cannot_be_seen_is_not_called_open() {
        let refused = judged(Err("needs root".to_owned()), &[]);
        assert_eq!(refused.severity, Severity::CannotTell);
        let hidden = judged(Ok(vec![]), &[("/proc/net/ip_tables_names/x", "")]);
        assert_eq!(hidden.severity, Severity::CannotTell);
    }

    #[test]
    fn this_host_lists_its_chains_or_says_why_not() {
        if let Err(reason) = chains() {
            assert!(reason.len() > 10, "{reason}");
        }
    }
}
