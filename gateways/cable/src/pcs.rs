//! Hosts of a topology as namespaces of one PC, each with interfaces, `/sys` and shared memory of its own, and
//! a pair of veth interfaces between each two of them.
//!
//! The process that joins them [`begin`]s before it has a second thread; it starts a helper a host, which
//! [`enter`]s and becomes the host's first program once [`join`] has joined all.

use std::fs::{self, File};
use std::io;
use std::net::IpAddr;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use hil_net::handover;
use nix::errno::Errno;
use nix::sched::{CloneFlags, setns};

use crate::inside::{ENTERED, let_ping, make_namespaces, mount_own};
use crate::netlink::{INDEX, LOOPBACK, Netlink, Network, PairEnd};
use crate::refusal::{Refusal, Step};
use crate::server::CableError;

/// A wire between two hosts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Wire {
    /// Its ends, at different hosts.
    pub ends: [WireEnd; 2],
}

/// An interface of a host.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WireEnd {
    /// The host's place in the list of them.
    pub host: usize,
    /// Its name, at most 15 bytes.
    pub interface: String,
    /// Its address; whatever the other end's is, there is a route to that.
    pub address: IpAddr,
}

/// A helper that has entered, as the process sees it that joins the hosts.
#[derive(Debug)]
pub struct Pc {
    helper: OwnedFd,
    network: OwnedFd,
}

/// Gives this process the rights over the hosts that it is to join, in a user namespace where the user has
/// none.
///
/// # Errors
/// What the kernel refuses.
pub fn begin() -> Result<(), Refusal> {
    make_namespaces()
}

/// The helper's part: namespaces of the host's own, then a wait at `socket` for the wires. Gives the word with
/// which the host begins; `None` when the process that joins the hosts is gone.
///
/// # Errors
/// What the kernel refuses; the other end of `socket` is told.
pub fn enter(socket: BorrowedFd<'_>) -> Result<Option<Vec<u8>>, Refusal> {
    let entered = make_namespaces().and_then(|()| {
        File::open("/proc/self/ns/net").map_err(|source| Refusal::new(Step::Namespaces, source))
    });
    let told = match &entered {
        Ok(network) => handover::give(socket, ENTERED, &[network.as_fd()]),
        Err(refusal) => handover::give(socket, refusal.to_string().as_bytes(), &[]),
    };
    entered?;
    let word = told.and_then(|()| handover::take(socket));
    let Some(word) = word
        .ok()
        .map(|(word, _)| word)
        .filter(|word| !word.is_empty())
    else {
        return Ok(None);
    };
    let_ping().map_err(|source| Refusal::new(Step::Addresses, source))?;
    mount_own()?;
    Ok(Some(word))
}

/// Whether this host's wires are up, which the kernel notes a moment after both of their ends are.
pub fn are_wires_up() -> bool {
    let is_up = |interface: fs::DirEntry| {
        let read = |name| fs::read_to_string(interface.path().join(name)).unwrap_or_default();
        // What a kernel adds on its own stays down.
        let is_of_a_wire = read("ifindex")
            .trim()
            .parse()
            .is_ok_and(|index: u32| index >= INDEX);
        !is_of_a_wire || read("operstate").trim() == "up"
    };
    let mut interfaces = fs::read_dir("/sys/class/net")
        .into_iter()
        .flatten()
        .flatten();
    interfaces.all(is_up)
}

impl Pc {
    /// Waits until the helper at the other end of `helper` has entered.
    ///
    /// # Errors
    /// What it was refused.
    pub fn take(helper: OwnedFd) -> Result<Self, CableError> {
        let (word, descriptors) = handover::take(&helper)?;
        if word.is_empty() {
            return Err(CableError::Gone);
        }
        let [network] = <[OwnedFd; 1]>::try_from(descriptors)
            .map_err(|_none| CableError::Refused(String::from_utf8_lossy(&word).into_owned()))?;
        Ok(Self { helper, network })
    }

    /// Lets the helper become the host's first program, with a word that is not empty.
    ///
    /// # Errors
    /// When it is gone.
    pub fn go(self, word: &[u8]) -> io::Result<()> {
        handover::give(&self.helper, word, &[])
    }
}

/// Puts the wires between the hosts. Leaves this thread in the last host's network namespace.
///
/// # Errors
/// What the kernel refuses.
pub fn join(pcs: &[Pc], wires: &[Wire]) -> Result<(), Refusal> {
    let refused = |step| move |source| Refusal::new(step, source);
    let netlink = Netlink::open().map_err(refused(Step::Interfaces))?;
    for (index, wire) in (INDEX..).zip(wires) {
        let ends = wire.ends.each_ref().map(|end| PairEnd {
            index,
            name: &end.interface,
            hardware_address: None,
            namespace: Some(pcs[end.host].network.as_fd()),
        });
        netlink.make_pair(ends).map_err(refused(Step::Interfaces))?;
    }
    for (host, pc) in pcs.iter().enumerate() {
        setns(&pc.network, CloneFlags::CLONE_NEWNET)
            .map_err(|errno: Errno| Refusal::new(Step::Namespaces, errno.into()))?;
        let netlink = Netlink::open().map_err(refused(Step::Interfaces))?;
        netlink
            .bring_up(LOOPBACK)
            .map_err(refused(Step::Interfaces))?;
        for (index, wire) in (INDEX..).zip(wires) {
            let (near, far) = match &wire.ends {
                [one, other] if one.host == host => (one, other),
                [other, one] if one.host == host => (one, other),
                _ => continue,
            };
            let other_end = Network {
                address: far.address,
                prefix_length: if far.address.is_ipv4() { 32 } else { 128 },
            };
            netlink
                .bring_up(index)
                .and_then(|()| netlink.give_address(index, near.address, other_end))
                .map_err(refused(Step::Addresses))?;
        }
    }
    Ok(())
}
