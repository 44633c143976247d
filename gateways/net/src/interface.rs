//! Which network interface has an address or a name, and whether a socket could be bound. It changes none.

use std::io;
use std::net::{IpAddr, SocketAddr};

use nix::net::if_::{if_indextoname, if_nametoindex};
use socket2::{Domain, Socket, Type};

/// The interface that has `address`; `None` when this host has no such address.
///
/// # Errors
/// When the kernel does not list the interfaces.
pub fn interface_with_address(address: IpAddr) -> io::Result<Option<String>> {
    let has_address = |entry: &nix::ifaddrs::InterfaceAddress| {
        let Some(storage) = entry.address.as_ref() else {
            return false;
        };
        let v4 = storage.as_sockaddr_in().map(|a| IpAddr::V4(a.ip()));
        let v6 = storage.as_sockaddr_in6().map(|a| IpAddr::V6(a.ip()));
        v4.or(v6) == Some(address)
    };
    let mut entries = nix::ifaddrs::getifaddrs()?;
    Ok(entries.find(has_address).map(|entry| entry.interface_name))
}

/// The kernel's own name of the interface called `name`, which may be an alternative name of it; `None`
/// where the kernel knows none of this name.
pub fn own_name(name: &str) -> Option<String> {
    let index = if_nametoindex(name).ok()?;
    if_indextoname(index).ok()?.into_string().ok()
}

/// Binds a socket for datagrams to `address`, and to `interface` where one is named, as a run does, and
/// closes it again.
///
/// # Errors
/// What the kernel would answer to the run.
pub fn try_datagrams(address: SocketAddr, interface: Option<&str>) -> io::Result<()> {
    let socket = Socket::new(Domain::for_address(address), Type::DGRAM, None)?;
    if let Some(interface) = interface {
        socket.bind_device(Some(interface.as_bytes()))?;
    }
    socket.bind(&address.into())
}

/// As [`try_datagrams`], for a listener.
///
/// # Errors
/// As [`try_datagrams`].
pub fn try_listener(address: SocketAddr, interface: Option<&str>) -> io::Result<()> {
    let socket = Socket::new(Domain::for_address(address), Type::STREAM, None)?;
    if let Some(interface) = interface {
        socket.bind_device(Some(interface.as_bytes()))?;
    }
    // Connections that have just ended are in nobody's way.
    socket.set_reuse_address(true)?;
    socket.bind(&address.into())?;
    socket.listen(1)
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;

    #[test]
    fn the_interface_of_an_address_is_found() {
        let loopback = IpAddr::V4(Ipv4Addr::LOCALHOST);
        let found = interface_with_address(loopback).unwrap();
        assert_eq!(found.as_deref(), Some("lo"));
        let foreign = IpAddr::V4(Ipv4Addr::new(203, 0, 113, 77));
        assert_eq!(interface_with_address(foreign).unwrap(), None);
    }

    #[test]
    fn a_name_that_the_kernel_knows_is_told_and_another_is_not() {
        assert_eq!(own_name("lo").as_deref(), Some("lo"));
        assert_eq!(own_name("no-such-card"), None);
    }

    #[test]
    fn a_port_is_tried_as_a_run_would_take_it() {
        let taken = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        let address = taken.local_addr().unwrap();
        let udp = |address, interface| {
            let tried = try_datagrams(address, interface);
            tried.map_err(|error| error.raw_os_error())
        };
        assert_eq!(udp(address, None), Err(Some(libc::EADDRINUSE)));
        drop(taken);
        assert_eq!(udp(address, None), Ok(()));
        assert_eq!(udp(address, Some("lo")), Ok(()));
        assert_eq!(udp(address, Some("no-such-card")), Err(Some(libc::ENODEV)));
        let foreign = "203.0.113.77:7400".parse().unwrap();
        assert_eq!(udp(foreign, None), Err(Some(libc::EADDRNOTAVAIL)));
        let listening = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listening.local_addr().unwrap();
        let tried = try_listener(address, None);
        assert_eq!(tried.unwrap_err().raw_os_error(), Some(libc::EADDRINUSE));
    }
}
