//! What a tap asks of a packet socket: to be bound to an interface, to tell its link layer, to listen
//! to frames of other addresses. A socket without a protocol hears no packet and is in no packet's way.
//!
//! `unsafe` is allowed here because `nix` opens such sockets only with a protocol, cannot make their
//! addresses, and wraps few of their options.

use core::ffi::{c_int, c_uint};
use std::io;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};

use super::link_type;

/// `AF_PACKET` as a link address has it, and `PACKET_MR_PROMISC`.
const PACKET_FAMILY: u16 = 17;
const PROMISCUOUS: u16 = 1;
const _: () = assert!(PACKET_FAMILY as c_int == libc::AF_PACKET);
const _: () = assert!(PROMISCUOUS as c_int == libc::PACKET_MR_PROMISC);
const NO_ADDRESS: libc::sockaddr_ll = libc::sockaddr_ll {
    sll_family: 0,
    sll_protocol: 0,
    sll_ifindex: 0,
    sll_hatype: 0,
    sll_pkttype: 0,
    sll_halen: 0,
    sll_addr: [0; 8],
};

/// The capture link type of a kernel hardware type.
pub(super) const fn link_of(hardware_type: u16) -> Option<u16> {
    match hardware_type {
        libc::ARPHRD_ETHER | libc::ARPHRD_LOOPBACK => Some(link_type::ETHERNET),
        libc::ARPHRD_NONE => Some(link_type::RAW),
        _ => None,
    }
}

pub(super) fn option_length<T>() -> libc::socklen_t {
    libc::socklen_t::try_from(size_of::<T>()).expect("an option is a few bytes long")
}

#[allow(unsafe_code, reason = "nix opens packet sockets only with a protocol")]
pub(super) fn open() -> io::Result<OwnedFd> {
    let kind = libc::SOCK_RAW | libc::SOCK_CLOEXEC | libc::SOCK_NONBLOCK;
    // SAFETY: the call takes three numbers.
    let descriptor = unsafe { libc::socket(libc::AF_PACKET, kind, 0) };
    if descriptor < 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: the kernel has just given this descriptor, and nobody else knows it.
    Ok(unsafe { OwnedFd::from_raw_fd(descriptor) })
}

#[allow(unsafe_code, reason = "nix cannot make a link address")]
pub(super) fn bind(socket: &OwnedFd, interface_index: c_uint, protocol_be: u16) -> io::Result<()> {
    let mut address = NO_ADDRESS;
    address.sll_family = PACKET_FAMILY;
    address.sll_protocol = protocol_be;
    address.sll_ifindex = c_int::try_from(interface_index).map_err(io::Error::other)?;
    let length = option_length::<libc::sockaddr_ll>();
    let pointer = (&raw const address).cast();
    // SAFETY: the kernel reads `length` bytes at `pointer`, a live address of that size.
    let result = unsafe { libc::bind(socket.as_raw_fd(), pointer, length) };
    outcome(result)
}

/// The kernel's type of the interface a socket is bound to.
#[allow(
    unsafe_code,
    reason = "nix refuses a link address shorter than its structure"
)]
pub(super) fn hardware_type(socket: &OwnedFd) -> io::Result<u16> {
    let mut address = NO_ADDRESS;
    let mut length = option_length::<libc::sockaddr_ll>();
    let pointer = (&raw mut address).cast();
    // SAFETY: the kernel writes at most `length` bytes at `pointer`, a live address of that size.
    let result = unsafe { libc::getsockname(socket.as_raw_fd(), pointer, &raw mut length) };
    outcome(result)?;
    Ok(address.sll_hatype)
}

#[allow(unsafe_code, reason = "no crate wraps the options of packet sockets")]
pub(super) fn set_option<T>(
    socket: &OwnedFd,
    level: c_int,
    name: c_int,
    value: &T,
) -> io::Result<()> {
    let (pointer, length) = ((&raw const *value).cast(), option_length::<T>());
    let descriptor = socket.as_raw_fd();
    // SAFETY: the kernel reads `length` bytes at `pointer`, a live value of that size.
    let result = unsafe { libc::setsockopt(descriptor, level, name, pointer, length) };
    outcome(result)
}

/// Lets the card pass frames of other addresses, as on a mirror port, until the socket is closed.
pub(super) fn listen_to_all(socket: &OwnedFd, interface_index: c_uint) -> io::Result<()> {
    let membership = libc::packet_mreq {
        mr_ifindex: c_int::try_from(interface_index).map_err(io::Error::other)?,
        mr_type: PROMISCUOUS,
        mr_alen: 0,
        mr_address: [0; 8],
    };
    set_option(
        socket,
        libc::SOL_PACKET,
        libc::PACKET_ADD_MEMBERSHIP,
        &membership,
    )
}

fn outcome(result: c_int) -> io::Result<()> {
    if result == 0 {
        Ok(())
    } else {
        Err(io::Error::last_os_error())
    }
}
