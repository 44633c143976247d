//! Ports of one's own: tests run side by side in the network of this machine, each in a process of its own.

use std::io::{Read, Seek, SeekFrom, Write};
use std::net::{Ipv4Addr, SocketAddr};

use crate::machine_lock::machine_lock;

/// Below what the kernel gives away by itself, above our programs' own defaults.
const FIRST: u16 = 20_000;
const END: u16 = 32_000;
/// What a link between two hosts needs for its channels, with room.
const BLOCK: u16 = 20;

/// The first of `BLOCK` ports that no other test of this machine is given until all others have been.
///
/// # Panics
/// When it cannot be noted that they are taken.
pub fn own_ports() -> u16 {
    let mut file = machine_lock("ports");
    let mut text = String::new();
    let read = file.read_to_string(&mut text);
    let last: u16 = text.trim().parse().unwrap_or(FIRST);
    let next = if last + 2 * BLOCK <= END {
        last + BLOCK
    } else {
        FIRST
    };
    let noted = read
        .and_then(|_length| file.set_len(0))
        .and_then(|()| file.seek(SeekFrom::Start(0)))
        .and_then(|_position| write!(file, "{next}"));
    if let Err(error) = noted {
        panic!("no ports: {error}");
    }
    next
}

/// Two addresses of loopback, of [`own_ports`].
pub fn own_addresses() -> [SocketAddr; 2] {
    let first = own_ports();
    [first, first + 1].map(|port| (Ipv4Addr::LOCALHOST, port).into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ports_are_given_once_in_a_round() {
        let given: Vec<u16> = (0..8).map(|_| own_ports()).collect();
        assert!(
            given
                .iter()
                .all(|first| (FIRST..=END - BLOCK).contains(first))
        );
        let apart = |two: &[u16]| two[0].abs_diff(two[1]) >= BLOCK;
        assert!(given.windows(2).all(apart), "{given:?}");
    }
}
