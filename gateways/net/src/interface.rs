//! Which network interface has an address. It changes none.

use std::io;
use std::net::IpAddr;

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
}
