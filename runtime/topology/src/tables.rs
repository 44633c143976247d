//! The tables of a topology file that exist only in the file: what they become is in `model` and
//! `links`, beside the declarations of the tables that stay as they are. A key is stated here or
//! there, once, and nowhere else.

use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};

use hil_account::Demand;
use hil_core::options;
use hil_core::options::{Free, Named, TextRule};

use crate::adapter::EgmAdapter;
use crate::flows::Flow;
use crate::links::LinkTable;
use crate::model::{Execution, Host, MessageLayout, Restarts, Run};
use crate::security::Security;

/// Longest name of a run, host, process, channel or link.
const NAME_LENGTH_MAX: usize = 64;

/// A text that can name a folder and a shared-memory service.
pub(super) const NAME: TextRule = TextRule {
    what: "a name: 1 to 64 letters, digits, `-`, `_`, `.`, starting with a letter or digit",
    check: |name| check_name(name, false),
    pattern: Some("^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"),
};

/// The name of a channel.
pub(super) const NAME_WITH_SLASHES: TextRule = TextRule {
    what: "a name that may have slashes",
    check: |name| check_name(name, true),
    pattern: Some("^[A-Za-z0-9][A-Za-z0-9._/-]{0,63}$"),
};

/// An address is written as a number: a name would have to be resolved by a network that the file
/// is checked without.
pub(super) const HOST_ADDRESS: TextRule = TextRule {
    what: "the IP address of one host",
    check: check_host_address,
    pattern: None,
};

/// The name of a network interface; `IFNAMSIZ` is 16 with the terminating zero.
pub(super) const INTERFACE: TextRule = TextRule {
    what: "the name of an interface",
    check: check_interface,
    pattern: None,
};

/// Address and port of a foreign EGM program, or our own.
pub(super) const EGM_ADDRESS: TextRule = TextRule {
    what: "an address with a port, e.g. 192.168.125.1:6510",
    check: check_egm_address,
    pattern: None,
};

/// A path that is not empty.
pub(super) const FOLDER: TextRule = TextRule {
    what: "the path of a folder",
    check: |path| check_path(path, "a folder"),
    pattern: None,
};

/// A path that is not empty.
pub(super) const KEY_FILE: TextRule = TextRule {
    what: "the path of a key file",
    check: |path| check_path(path, "a key file"),
    pattern: None,
};

fn check_name(name: &str, has_slashes: bool) -> Result<(), String> {
    let is_allowed = |letter: char| {
        letter.is_ascii_alphanumeric()
            || matches!(letter, '-' | '_' | '.')
            || (has_slashes && letter == '/')
    };
    let starts_well = name.starts_with(|letter: char| letter.is_ascii_alphanumeric());
    if starts_well && name.len() <= NAME_LENGTH_MAX && name.chars().all(is_allowed) {
        return Ok(());
    }
    let slash = if has_slashes { ", `/`" } else { "" };
    Err(format!(
        "`{name}` is no name: 1 to {NAME_LENGTH_MAX} letters, digits, `-`, `_`, `.`{slash}, \
         starting with a letter or digit"
    ))
}

fn check_path(path: &str, what: &str) -> Result<(), String> {
    if path.is_empty() {
        return Err(format!("is empty, expected the path of {what}"));
    }
    Ok(())
}

fn check_host_address(text: &str) -> Result<(), String> {
    let address: Option<IpAddr> = text.parse().ok();
    match address.filter(|address| !address.is_unspecified() && !address.is_multicast()) {
        None => Err(format!("\"{text}\" is no address of one host")),
        // Of `fe80::/10` (RFC 4291, 2.5.6): the kernel refuses it without a scope.
        Some(IpAddr::V6(address)) if address.is_unicast_link_local() => Err(link_local(text)),
        Some(_) => Ok(()),
    }
}

/// Why a link-local address without a scope is refused.
fn link_local(text: &str) -> String {
    format!(
        "\"{text}\" is link-local: it says nothing without an interface, and its scope differs from \
         host to host; give the host a unique local address (fd00::/8) or use IPv4"
    )
}

fn check_interface(name: &str) -> Result<(), String> {
    if (1..=15).contains(&name.len()) && !name.contains([' ', '/', ':']) && name.is_ascii() {
        return Ok(());
    }
    Err("is no interface name: 1 to 15 letters without blank or slash".to_owned())
}

/// Ports below belong to the system's own services.
const EGM_PORT_MIN: u16 = 1024;

fn check_egm_address(text: &str) -> Result<(), String> {
    let address: Option<SocketAddr> = text.parse().ok();
    match address.filter(|one| one.port() >= EGM_PORT_MIN && !one.ip().is_multicast()) {
        None => Err(format!(
            "\"{text}\" is no address of the form 192.168.125.1:6510 with a port of \
             {EGM_PORT_MIN} to 65535"
        )),
        Some(SocketAddr::V6(address))
            if address.ip().is_unicast_link_local() && address.scope_id() == 0 =>
        {
            Err(link_local(text))
        }
        Some(_) => Ok(()),
    }
}

options! {
    /// The whole file.
    pub struct File {
        /// A file that this one changes: its tables are merged with this file's, everything else is
        /// replaced. The path starts from the folder of this file.
        extends: Option<String>;
        /// The version of the format.
        version: u32, in 1..=1, hint "write version = 1";
        /// Name of the run's folder and report.
        name: String, in NAME, hint "it names the run's folder and report";
        /// How long, from which seed, recorded where.
        run: Run;
        /// The case study. Without it the file runs programs of the user's own only.
        case: Option<CaseTable>;
        /// The hosts, by name. Without any there is one, `local`.
        hosts: Named<Host>, in false;
        /// The processes, by name.
        processes: Named<ProcessTable>, in false;
        /// What the file says of the case's channels, and foreign channels, by name.
        channels: Named<ChannelTable>, in true;
        /// The links, by name.
        links: Named<LinkTable>, in false;
        /// Flows of frames that have a name.
        flows: Named<Flow>, in false;
        /// Whether the hops of the run are sealed, and with which key.
        security: Security;
    }
}

options! {
    /// The case study.
    pub struct CaseTable {
        /// Name of the case study.
        name: Option<String>;
        /// Its parameters: its own keys, which it checks itself.
        parameters: Free;
    }
}

options! {
    /// A process: a role of the case, a program of the user's own, or both.
    pub struct ProcessTable {
        /// The host it runs on. May be left out where there is one host.
        host: Option<String>;
        /// The role of the case that it plays.
        role: Option<String>;
        /// The user's own program and its arguments, in place of what this program ships for the role.
        run: Option<Vec<String>>, needs(egm, |process| process.egm.is_none(),
            "does not go with `egm`: a foreign program that is not started here plays the role");
        /// Variables added to the environment of `run`.
        env: BTreeMap<String, String> = BTreeMap::new(), needs(run, |process| process.run.is_some(),
            "needs `run`: a built-in role reads no environment");
        /// Address of `run` in a network namespace of its own, where it speaks IP and nothing of ours: its Ethernet
        /// frames go over two channels, one each way, to another such process.
        inside: Option<IpAddr>, in HOST_ADDRESS, needs(run, |process| process.run.is_some(),
            "needs `run`: a built-in role speaks no IP");
        /// The role is played by a foreign program that speaks EGM.
        egm: Option<EgmAdapter>;
        /// How it is scheduled and how it waits.
        execution: Execution;
        /// What its end means.
        restarts: Restarts;
    }
    check ProcessTable::check_program;
}

impl ProcessTable {
    fn check_program(&self) -> Result<(), hil_core::case_study::ParameterError> {
        let refuse = |key, problem| Err(hil_core::case_study::ParameterError::new(key, problem));
        match (&self.role, &self.run) {
            (Some(_), _) if self.inside.is_some() => refuse(
                "inside",
                "does not go with `role`: a role has the channels of its case, and `inside` those of frames",
            ),
            (None, None) => refuse(
                "role",
                "is missing: write role = \"…\" for a built-in role of the case, or run = [\"…\"] for \
                 your own program",
            ),
            (_, Some(words)) if words.first().is_none_or(String::is_empty) => {
                refuse("run", "is empty, expected a program and its arguments")
            }
            _ => Ok(()),
        }
    }
}

options! {
    /// What a file says of a channel. A foreign channel, between programs of the user's own, states
    /// message, from and to; a channel of the case has them from there.
    pub struct ChannelTable {
        /// Messages that its queue in shared memory holds: 16 where not given, and 1024 of frames.
        depth: Option<usize>, in 1..=1_024;
        /// The link that carries it to another host.
        link: Option<String>;
        /// Identity of its messages; between processes with `inside` it is that of Ethernet frames.
        message: Option<MessageLayout>;
        /// The process that publishes.
        from: Option<String>;
        /// The process that subscribes.
        to: Option<String>;
        /// What its consumer asks of the network; the report says whether it was met.
        demand: Option<Demand>;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_patterns_of_names_state_the_longest_one() {
        for rule in [NAME, NAME_WITH_SLASHES] {
            let more = format!("{{0,{}}}$", NAME_LENGTH_MAX - 1);
            assert!(rule.pattern.unwrap().ends_with(&more));
            assert!((rule.check)(&"a".repeat(NAME_LENGTH_MAX)).is_ok());
            assert!((rule.check)(&"a".repeat(NAME_LENGTH_MAX + 1)).is_err());
        }
        assert!((NAME.check)("a/b").is_err() && (NAME_WITH_SLASHES.check)("a/b").is_ok());
    }
}
