//! The kernel's tables of the IP sockets of this network namespace: `/proc/net/tcp`, `udp`, `tcp6`, `udp6`.

use std::net::{IpAddr, SocketAddr};
use std::{fs, io};

/// State of a TCP socket that takes connections.
pub const LISTENING: u8 = 0x0A;

/// A socket.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct IpSocket {
    /// Its own end.
    pub local: SocketAddr,
    /// The other end, as far as it is connected.
    pub remote: SocketAddr,
    /// State, as the kernel numbers those of TCP.
    pub state: u8,
    /// The user who made it; 0 where no process has it any more.
    pub user: u32,
    /// Number of its file; 0 where no process has it any more.
    pub inode: u64,
}

/// The sockets of a table. IPv4 addresses in those of IPv6 are IPv4 addresses.
pub fn parse(text: &str) -> impl Iterator<Item = IpSocket> + '_ {
    text.lines().skip(1).filter_map(|line| {
        let words: Vec<&str> = line.split_whitespace().collect();
        Some(IpSocket {
            local: address(words.get(1)?)?,
            remote: address(words.get(2)?)?,
            state: u8::from_str_radix(words.get(3)?, 16).ok()?,
            user: words.get(7)?.parse().ok()?,
            inode: words.get(9)?.parse().ok()?,
        })
    })
}

/// The user whose process on this machine has the TCP connection from `local` to `remote`; `None` where none
/// has.
///
/// # Errors
/// When the kernel does not list connections.
pub fn user_of_connection(local: SocketAddr, remote: SocketAddr) -> io::Result<Option<u32>> {
    let ends = [local, remote].map(canonical);
    for path in ["/proc/net/tcp", "/proc/net/tcp6"] {
        let table = match fs::read_to_string(path) {
            Ok(table) => table,
            // A kernel without IPv6 has no such file.
            Err(error) if error.kind() == io::ErrorKind::NotFound && path.ends_with('6') => {
                continue;
            }
            Err(error) => return Err(error),
        };
        let found = parse(&table).find(|one| [one.local, one.remote] == ends && one.inode != 0);
        if let Some(found) = found {
            return Ok(Some(found.user));
        }
    }
    Ok(None)
}

fn canonical(address: SocketAddr) -> SocketAddr {
    SocketAddr::new(address.ip().to_canonical(), address.port())
}

/// `0100007F:1CE8`: words of 32 bits in this host's order, then the port.
fn address(text: &str) -> Option<SocketAddr> {
    let (address, port) = text.split_once(':')?;
    let port = u16::from_str_radix(port, 16).ok()?;
    let mut bytes = Vec::new();
    for index in (0..address.len()).step_by(8) {
        let word = u32::from_str_radix(address.get(index..index + 8)?, 16).ok()?;
        bytes.extend(word.to_ne_bytes());
    }
    let ip = match bytes.len() {
        4 => IpAddr::V4(<[u8; 4]>::try_from(bytes).ok()?.into()),
        16 => IpAddr::V6(<[u8; 16]>::try_from(bytes).ok()?.into()).to_canonical(),
        _ => return None,
    };
    Some(SocketAddr::new(ip, port))
}

#[cfg(test)]
mod tests {
    use std::net::{TcpListener, TcpStream};

    use nix::unistd::Uid;

    use super::*;

    #[test]
    fn addresses_are_read_as_the_kernel_writes_them() {
        let local = format!("{:08X}:1CE8", u32::from_ne_bytes([127, 0, 0, 1]));
        assert_eq!(address(&local), "127.0.0.1:7400".parse().ok());
        let any = format!("{}:1CE8", "0".repeat(32));
        assert_eq!(address(&any), "[::]:7400".parse().ok());
        assert_eq!(address("0100"), None);
        assert_eq!(address("01:1CE8"), None);
    }

    #[test]
    fn a_connection_is_of_its_user_while_a_process_has_it() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let there = listener.local_addr().unwrap();
        let stream = TcpStream::connect(there).unwrap();
        let here = stream.local_addr().unwrap();
        let own = Some(Uid::effective().as_raw());
        assert_eq!(user_of_connection(here, there).unwrap(), own);
        let mapped = SocketAddr::new(IpAddr::V6("::ffff:127.0.0.1".parse().unwrap()), here.port());
        assert_eq!(user_of_connection(mapped, there).unwrap(), own);
        // What the kernel still keeps of it is nobody's.
        drop(stream);
        assert_eq!(user_of_connection(here, there).unwrap(), None);
    }
}
