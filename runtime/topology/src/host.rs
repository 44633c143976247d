//! Which host of the topology this machine is. The decision is a pure function of what was asked
//! for and of what the machine calls itself; only [`MachineIdentity::gather`] asks the kernel.

use std::net::IpAddr;

use super::model::{Host, Topology};
use super::suggest::{listed, nearest};

/// Environment variable that names the host when `--host` does not.
pub const HOST_VARIABLE: &str = "HIL_HOST";

/// What this machine calls itself.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct MachineIdentity {
    /// Name of the system; empty if it has none.
    pub hostname: String,
    /// Addresses of its interfaces.
    pub addresses: Vec<IpAddr>,
}

/// The hosts of the topology that run here.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum HostChoice {
    /// All of them: none has an address.
    All,
    /// This one.
    One(String),
}

/// Why it cannot be said which host this is.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum HostError {
    /// A host was named that the topology does not have.
    #[error("{origin} names host `{name}`, which is not in the topology: {help}")]
    Unknown {
        /// `--host` or `HIL_HOST`.
        origin: &'static str,
        /// The name.
        name: String,
        /// What it may be.
        help: String,
    },
    /// One of several hosts was named, but peers without address cannot be reached.
    #[error(
        "--host names `{name}`, but the hosts have no address: all of them run here, started by \
         one supervisor"
    )]
    NothingToChoose {
        /// The name.
        name: String,
    },
    /// Nothing, or more than one thing, fits.
    #[error("{found}: {compared}; say which one with --host or {HOST_VARIABLE}")]
    Undecided {
        /// `no host fits this machine`, or which hosts do.
        found: String,
        /// What was compared with what.
        compared: String,
    },
}

impl MachineIdentity {
    /// Asks the kernel for the name of the system and the addresses of its interfaces.
    ///
    /// # Errors
    /// When the kernel does not say.
    pub fn gather() -> Result<Self, nix::Error> {
        let hostname = nix::unistd::gethostname()?.to_string_lossy().into_owned();
        let mut addresses = Vec::new();
        for interface in nix::ifaddrs::getifaddrs()? {
            let Some(storage) = interface.address else {
                continue;
            };
            let v4 = storage
                .as_sockaddr_in()
                .map(|address| IpAddr::V4(address.ip()));
            let v6 = || {
                storage
                    .as_sockaddr_in6()
                    .map(|address| IpAddr::V6(address.ip()))
            };
            addresses.extend(v4.or_else(v6));
        }
        Ok(Self {
            hostname,
            addresses,
        })
    }
}

/// The hosts of `topology` that run on `machine`: what `--host` says, else what the environment
/// says, else the only host of the machine's name, else the only one with an address of it.
///
/// The environment variable is a property of the machine and is ignored when all hosts run here.
///
/// # Errors
/// When a named host does not exist, or when none or several fit; says what was compared.
pub fn which_host(
    topology: &Topology,
    requested: Option<&str>,
    environment: Option<&str>,
    machine: &MachineIdentity,
) -> Result<HostChoice, HostError> {
    if let Some(name) = requested {
        let choice = named(topology, "--host", name)?;
        return match (topology.is_all_local(), topology.hosts()) {
            (true, [_]) => Ok(HostChoice::All),
            (true, _) => Err(HostError::NothingToChoose {
                name: name.to_owned(),
            }),
            (false, _) => Ok(choice),
        };
    }
    if topology.is_all_local() {
        return Ok(HostChoice::All);
    }
    if let Some(name) = environment {
        return named(topology, HOST_VARIABLE, name);
    }
    let fits_name = |host: &&Host| is_same_machine(&machine.hostname, &host.name);
    let by_name: Vec<_> = topology.hosts().iter().filter(fits_name).collect();
    if let [host] = by_name[..] {
        return Ok(HostChoice::One(host.name.clone()));
    }
    let has_address = |host: &&Host| {
        host.address
            .is_some_and(|address| machine.addresses.contains(&address))
    };
    let by_address: Vec<_> = topology.hosts().iter().filter(has_address).collect();
    if let [host] = by_address[..] {
        return Ok(HostChoice::One(host.name.clone()));
    }
    Err(undecided(topology, machine, &by_address))
}

fn named(topology: &Topology, origin: &'static str, name: &str) -> Result<HostChoice, HostError> {
    if topology.host(name).is_some() {
        return Ok(HostChoice::One(name.to_owned()));
    }
    let hosts: Vec<_> = topology
        .hosts()
        .iter()
        .map(|host| host.name.clone())
        .collect();
    let near = nearest(name, hosts.iter().map(String::as_str));
    let near = near.map(|near| format!("did you mean `{near}`? "));
    Err(HostError::Unknown {
        origin,
        name: name.to_owned(),
        help: format!("{}it has {}", near.unwrap_or_default(), listed(&hosts)),
    })
}

/// Compares without case, and without the domain if the host's key has none.
fn is_same_machine(hostname: &str, host: &str) -> bool {
    let short = hostname.split('.').next().unwrap_or(hostname);
    hostname.eq_ignore_ascii_case(host) || short.eq_ignore_ascii_case(host)
}

fn undecided(topology: &Topology, machine: &MachineIdentity, fitting: &[&Host]) -> HostError {
    let fitting: Vec<_> = fitting.iter().map(|host| host.name.clone()).collect();
    let found = if fitting.is_empty() {
        "no host of the topology fits this machine".to_owned()
    } else {
        format!(
            "several hosts have an address of this machine ({})",
            listed(&fitting)
        )
    };
    let host = |host: &Host| match host.address {
        Some(address) => format!("`{}` at {address}", host.name),
        None => format!("`{}`", host.name),
    };
    let hosts: Vec<_> = topology.hosts().iter().map(host).collect();
    let addresses: Vec<_> = machine.addresses.iter().map(ToString::to_string).collect();
    let compared = format!(
        "compared {} with system name `{}` and interface addresses {}",
        hosts.join(", "),
        machine.hostname,
        addresses.join(", ")
    );
    HostError::Undecided { found, compared }
}
