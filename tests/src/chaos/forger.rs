//! Datagrams on the cable that no gateway sent: a stranger's, forged ones, and late, repeated or
//! damaged copies of real ones. It listens at the receiving host and sends from the sending one
//! through raw sockets, so that a copy has the sender's address and ports.

use std::io::{self, Read};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, TcpStream, UdpSocket};
use std::thread;
use std::time::{Duration, Instant};

use hil_core::random::RandomStream;
use socket2::{Domain, Protocol, Socket, Type};

use crate::lab::LabHost;

/// UDP ports of the gateways, and the TCP port of the supervisors.
const GATEWAY_PORTS: std::ops::Range<u16> = 7400..7402;
const CONTROL_PORT: u16 = 7399;
const IPV4_BYTES: usize = 20;
const UDP_BYTES: usize = 8;

/// What is done with the copy of a datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Forgery {
    /// Sent again as it was.
    Copy,
    /// Sent again with flipped bits and a check sum that does not fit.
    Damage,
}

/// A stranger on `from` speaks to every port of the run on `to` for `length`; with `looks_real`, in
/// words that begin like a gateway's.
///
/// # Errors
/// When no socket can be had there.
pub fn flood(
    from: &LabHost,
    to: &LabHost,
    looks_real: bool,
    length: Duration,
    seed: u64,
) -> io::Result<u64> {
    let own = SocketAddr::from((from.address(), 0));
    let socket = from.on_network(|| UdpSocket::bind(own))?;
    let target = to.address();
    let mut random = RandomStream::new(seed, "flood");
    let end = Instant::now() + length;
    let mut count = 0_u64;
    while Instant::now() < end {
        for port in GATEWAY_PORTS {
            let bytes = nonsense(&mut random, looks_real);
            // A full queue or an answer of "nobody listens" is no concern of a stranger.
            drop(socket.send_to(&bytes, (target, port)));
            count += 1;
        }
        if count.is_multiple_of(64) {
            knock(from, target, looks_real);
        }
        thread::sleep(Duration::from_micros(500));
    }
    Ok(count)
}

/// Bytes that mean nothing, or a header that nearly does.
fn nonsense(random: &mut RandomStream, looks_real: bool) -> Vec<u8> {
    let length = usize::try_from(random.next_u64() % 200).unwrap_or(0);
    let mut bytes: Vec<u8> = (0..length)
        .map(|_| random.next_u64().to_le_bytes()[0])
        .collect();
    if looks_real {
        bytes.resize(bytes.len().max(72 + 16), 0);
        // Requests for keys and answers among them, which only sealed hops know.
        let kind = 1 + random.next_u64().to_le_bytes()[0] % 8;
        let is_sealed = random.chance(0.5);
        bytes[..8].copy_from_slice(&[b'H', b'I', b'L', b'G', 1, kind, is_sealed.into(), 0]);
        bytes[12..16].copy_from_slice(&[random.next_u64().to_le_bytes()[0] % 3, 0, 72, 0]);
        if is_sealed {
            bytes[68..72].copy_from_slice(&random.next_u64().to_le_bytes()[..4]);
        } else {
            bytes[68..72].fill(0);
        }
    }
    bytes
}

/// A connection to the supervisors' port that says something else.
fn knock(from: &LabHost, target: Ipv4Addr, looks_real: bool) {
    use std::io::Write;
    let words: &[u8] = if looks_real {
        &[9, 0, 0, 0, 0, b'{', b'"', b'R', b'e']
    } else {
        b"GET / HTTP/1.1\r\n\r\n"
    };
    from.on_network(|| {
        let address = SocketAddr::V4(SocketAddrV4::new(target, CONTROL_PORT));
        // Nobody listens there once the hosts have met.
        if let Ok(mut stream) = TcpStream::connect_timeout(&address, Duration::from_millis(20)) {
            drop(stream.write_all(words));
        }
    });
}

/// For `length`, copies of the run's datagrams that reach `to` are sent again from `from`, up to
/// 60 ms late and so out of order. Gives how many.
///
/// # Errors
/// When no raw socket can be had there.
pub fn copy(
    from: &LabHost,
    to: &LabHost,
    forgery: Forgery,
    length: Duration,
    seed: u64,
) -> io::Result<u64> {
    let raw = |host: &LabHost| {
        host.on_network(|| {
            let socket = Socket::new(Domain::IPV4, Type::RAW, Some(Protocol::UDP))?;
            socket.bind(&SocketAddr::from((host.address(), 0)).into())?;
            socket.set_read_timeout(Some(Duration::from_millis(2)))?;
            Ok::<Socket, io::Error>(socket)
        })
    };
    let (mut ear, mouth) = (raw(to)?, raw(from)?);
    let target = SocketAddr::from((to.address(), 0)).into();
    let mut random = RandomStream::new(seed, "copy");
    let end = Instant::now() + length;
    let mut held: Vec<(Instant, Vec<u8>)> = Vec::new();
    let mut buffer = vec![0; 4096];
    let mut count = 0;
    while Instant::now() < end || !held.is_empty() {
        if let Ok(received) = ear.read(&mut buffer)
            && Instant::now() < end
            && let Some(segment) = of_the_run(&buffer[..received])
            // Copies are heard as well; one in four is copied again.
            && random.chance(0.25)
        {
            let late = Duration::from_micros(random.next_u64() % 60_000);
            let segment = forged(segment, forgery, &mut random);
            held.push((Instant::now() + late, segment));
        }
        let now = Instant::now();
        held.retain(|(at, segment)| {
            let is_due = *at <= now;
            if is_due {
                // Without a cable there is no sending.
                count += u64::from(mouth.send_to(segment, &target).is_ok());
            }
            !is_due
        });
    }
    Ok(count)
}

/// The UDP header and payload of a datagram between gateways.
fn of_the_run(packet: &[u8]) -> Option<&[u8]> {
    let segment = packet.get(IPV4_BYTES..)?;
    let header = segment.first_chunk::<UDP_BYTES>()?;
    let port = |at: usize| u16::from_be_bytes([header[at], header[at + 1]]);
    let is_ours = GATEWAY_PORTS.contains(&port(0)) && GATEWAY_PORTS.contains(&port(2));
    is_ours.then_some(segment)
}

fn forged(segment: &[u8], forgery: Forgery, random: &mut RandomStream) -> Vec<u8> {
    let mut bytes = segment.to_vec();
    match forgery {
        // No check sum: a sum that the sender's kernel left to the card is none.
        Forgery::Copy => bytes[6..8].fill(0),
        Forgery::Damage => {
            let length = bytes.len().max(UDP_BYTES + 1) - UDP_BYTES;
            let at = UDP_BYTES + usize::try_from(random.next_u64()).unwrap_or(0) % length;
            if let Some(byte) = bytes.get_mut(at) {
                *byte ^= 1 << (random.next_u64() % 8);
            }
            let sum = u16::from_be_bytes([bytes[6], bytes[7]]).wrapping_add(0x0101);
            bytes[6..8].copy_from_slice(&sum.max(1).to_be_bytes());
        }
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_datagrams_between_gateways_are_copied() {
        let packet = |from: u16, to: u16| {
            let mut packet = vec![0; IPV4_BYTES];
            packet.extend(from.to_be_bytes());
            packet.extend(to.to_be_bytes());
            packet.extend([0, 12, 1, 2, b'H', b'I', b'L', b'G']);
            packet
        };
        assert_eq!(of_the_run(&packet(7400, 7401)).map(<[u8]>::len), Some(12));
        assert_eq!(of_the_run(&packet(5353, 7401)), None);
        assert_eq!(of_the_run(&packet(7400, 7401)[..25]), None);
    }

    #[test]
    fn a_copy_is_the_same_and_a_damaged_one_is_not() {
        let mut random = RandomStream::new(1, "forged");
        let segment = [1, 2, 3, 4, 0, 12, 9, 9, b'H', b'I', b'L', b'G'];
        let copy = forged(&segment, Forgery::Copy, &mut random);
        assert_eq!((&copy[..6], &copy[8..]), (&segment[..6], &segment[8..]));
        let damaged = forged(&segment, Forgery::Damage, &mut random);
        assert_ne!(damaged[8..], segment[8..]);
        assert_ne!(damaged[6..8], [0, 0]);
    }

    #[test]
    fn what_looks_real_has_a_gateways_header() {
        let mut random = RandomStream::new(1, "nonsense");
        for _ in 0..100 {
            let bytes = nonsense(&mut random, true);
            assert!(bytes.starts_with(b"HILG") && bytes.len() >= 88);
        }
    }
}
