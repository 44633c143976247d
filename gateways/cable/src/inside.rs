//! The helper process, from its start until it becomes the program: it makes two network namespaces and the
//! cable between them, and gives the cable's end away. It must have one thread.

use std::fs::{self, File};
use std::io;
use std::net::IpAddr;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use hil_net::packet_ring::CableSocket;
use hil_net::{handover, offload};
use nix::errno::Errno;
use nix::mount::{MsFlags, mount};
use nix::sched::{CloneFlags, unshare};
use nix::unistd::{Gid, Uid, getgid, getuid};

use crate::netlink::{INDEX, LOOPBACK, Netlink, Network, PairEnd};
use crate::refusal::{Refusal, Step};
use crate::{INTERFACE, RING};

/// What the program is to have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Inside {
    /// Its address.
    pub address: IpAddr,
}

impl Inside {
    /// Of its network: those of one cable are neighbours.
    pub const fn prefix_length(&self) -> u8 {
        match self.address {
            IpAddr::V4(_) => 24,
            IpAddr::V6(_) => 64,
        }
    }

    /// Locally administered, and the same at every start: a neighbour that remembers it is not wrong.
    pub fn hardware_address(&self) -> [u8; 6] {
        let octets = match self.address {
            IpAddr::V4(address) => address.octets(),
            IpAddr::V6(address) => {
                let [.., a, b, c, d] = address.octets();
                [a, b, c, d]
            }
        };
        let [a, b, c, d] = octets;
        [0x02, 0x48, a, b, c, d]
    }
}

/// What [`enter`] leaves of the cable for another process.
#[derive(Debug)]
pub struct CableEnd {
    socket: OwnedFd,
    /// What the program's interfaces count, readable as long as it is open.
    devices: File,
}

/// Puts this process into namespaces of its own with one interface. As root of the host it stays root; any
/// other user keeps its own identity and gains no right outside.
///
/// # Errors
/// What the kernel refuses.
pub fn enter(inside: &Inside) -> Result<CableEnd, Refusal> {
    let refused = |step| move |source| Refusal::new(step, source);
    let errno = |step| move |errno: Errno| Refusal::new(step, errno.into());
    make_namespaces()?;
    // The end of the cable is no host: it has no address and says nothing of its own.
    write_if_there("net/ipv6/conf/default/disable_ipv6", "1").map_err(refused(Step::Interfaces))?;
    let there = File::open("/proc/self/ns/net").map_err(refused(Step::Namespaces))?;
    let socket = CableSocket::open().map_err(refused(Step::PacketSocket))?;
    let end = Netlink::open().map_err(refused(Step::Interfaces))?;
    unshare(CloneFlags::CLONE_NEWNET).map_err(errno(Step::Namespaces))?;
    let netlink = Netlink::open().map_err(refused(Step::Interfaces))?;
    let program = PairEnd {
        index: INDEX,
        name: INTERFACE,
        hardware_address: Some(inside.hardware_address()),
        namespace: None,
    };
    let cable = PairEnd {
        index: INDEX,
        name: "cable",
        hardware_address: None,
        namespace: Some(there.as_fd()),
    };
    netlink
        .make_pair([program, cable])
        .and_then(|()| end.bring_up(INDEX))
        .map_err(refused(Step::Interfaces))?;
    let socket = socket
        .attach(INDEX, &RING)
        .map_err(refused(Step::PacketSocket))?;
    offload::finish_frames_in_software(INTERFACE).map_err(refused(Step::Offload))?;
    netlink
        .bring_up(LOOPBACK)
        .and_then(|()| netlink.bring_up(INDEX))
        .and_then(|()| {
            let network = Network {
                address: inside.address,
                prefix_length: inside.prefix_length(),
            };
            netlink.give_address(INDEX, inside.address, network)
        })
        .and_then(|()| match inside.address {
            IpAddr::V4(_) => netlink.route_multicast(INDEX),
            IpAddr::V6(_) => Ok(()),
        })
        .map_err(refused(Step::Addresses))?;
    let_ping().map_err(refused(Step::Addresses))?;
    mount_own()?;
    let devices = File::open("/proc/self/net/dev").map_err(refused(Step::Mounts))?;
    Ok(CableEnd { socket, devices })
}

/// Lets this user's programs send ICMP echo requests without a right.
pub(crate) fn let_ping() -> io::Result<()> {
    let gid = getgid();
    write_if_there("net/ipv4/ping_group_range", &format!("{gid} {gid}"))
}

/// Network and mount namespaces, in a user namespace where the user may not make them otherwise.
pub(crate) fn make_namespaces() -> Result<(), Refusal> {
    let (uid, gid) = (getuid(), getgid());
    let wanted = CloneFlags::CLONE_NEWNET | CloneFlags::CLONE_NEWNS;
    match unshare(wanted) {
        Err(Errno::EPERM) => {}
        other => return other.map_err(|errno| Refusal::new(Step::Namespaces, errno.into())),
    }
    unshare(wanted | CloneFlags::CLONE_NEWUSER)
        .map_err(|errno| Refusal::new(Step::Namespaces, errno.into()))?;
    keep_identity(uid, gid).map_err(|source| Refusal::new(Step::Identity, source))
}

fn keep_identity(uid: Uid, gid: Gid) -> io::Result<()> {
    fs::write("/proc/self/setgroups", "deny")?;
    fs::write("/proc/self/uid_map", format!("{uid} {uid} 1"))?;
    fs::write("/proc/self/gid_map", format!("{gid} {gid} 1"))
}

/// Sets a key of the kernel in this network namespace; one that it does not have needs no setting.
fn write_if_there(key: &str, value: &str) -> io::Result<()> {
    match fs::write(format!("/proc/sys/{key}"), value) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        other => other,
    }
}

/// `/sys` of its own interfaces, and shared memory that leads past no cable.
pub(crate) fn mount_own() -> Result<(), Refusal> {
    let refused = |errno: Errno| Refusal::new(Step::Mounts, errno.into());
    let nothing: Option<&str> = None;
    let privately = MsFlags::MS_REC | MsFlags::MS_PRIVATE;
    mount(nothing, "/", nothing, privately, nothing).map_err(refused)?;
    mount(
        Some("sysfs"),
        "/sys",
        Some("sysfs"),
        MsFlags::empty(),
        nothing,
    )
    .map_err(refused)?;
    let mode = Some("mode=1777");
    mount(
        Some("tmpfs"),
        "/dev/shm",
        Some("tmpfs"),
        MsFlags::empty(),
        mode,
    )
    .map_err(refused)
}

/// First word of a helper that entered, and of a server whose program waits for its beginning.
pub(crate) const ENTERED: &[u8] = b"entered";
/// First word of a server whose program has begun.
pub(crate) const BEGAN: &[u8] = b"began";
/// And the answer: the run begins.
pub(crate) const GO: &[u8] = b"go";

/// Gives the cable's end to the process at the other end of `socket`.
///
/// # Errors
/// When it is gone.
pub fn hand_over(socket: BorrowedFd<'_>, end: &CableEnd) -> io::Result<()> {
    handover::give(socket, ENTERED, &[end.socket.as_fd(), end.devices.as_fd()])
}

/// Tells the process at the other end of `socket` why there is no cable.
///
/// # Errors
/// When it is gone.
pub fn refuse(socket: BorrowedFd<'_>, refusal: &Refusal) -> io::Result<()> {
    handover::give(socket, refusal.to_string().as_bytes(), &[])
}

/// Waits until the process at the other end of `socket` lets the program begin; false when it is gone.
///
/// # Errors
/// When receiving fails.
pub fn await_go(socket: BorrowedFd<'_>) -> io::Result<bool> {
    Ok(handover::take(socket)?.0 == GO)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_address_has_a_hardware_address_of_its_own_that_stays() {
        let address = |text: &str| Inside {
            address: text.parse().unwrap(),
        };
        let first = address("10.77.0.1").hardware_address();
        assert_eq!(first, [0x02, 0x48, 10, 77, 0, 1]);
        assert_ne!(first, address("10.77.0.2").hardware_address());
        let six = address("fd00::2");
        assert_eq!((six.hardware_address()[5], six.prefix_length()), (2, 64));
    }
}
