//! Connections to the supervisors' port of somebody who has nothing to say there: silent ones, nonsense,
//! first messages of a handshake whole, cut short and too long. None is ever completed. It judges nothing.

use std::collections::VecDeque;
use std::io::Write;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use hil_core::random::RandomStream;
use socket2::{Domain, Socket, Type};

use crate::lab::LabHost;

/// Where the hosts of a run meet, unless the topology says otherwise.
pub const CONTROL_PORT: u16 = 7399;
/// Connections that are kept open; then the oldest is dropped.
const OPEN_MAX: usize = 300;
/// A first message of the handshake is this long behind its head.
const FIRST_BYTES: u16 = 144;

/// What became of the knocking.
#[derive(Debug, Clone, Copy, Default)]
pub struct Knocked {
    /// Connections that were tried.
    pub tried_count: u64,
    /// Of those, opened or still under way when their words were written.
    pub held_count: u64,
    /// Of those, refused by the host's kernel at once: nobody listened.
    pub refused_count: u64,
}

/// Knocks at `to` from `host`, from its address `from`, so often a second, until `is_over`.
///
/// # Panics
/// When no socket can be had there.
pub fn knock(
    host: &LabHost,
    from: Ipv4Addr,
    to: SocketAddrV4,
    rate: u32,
    is_over: &AtomicBool,
) -> Knocked {
    host.on_network(|| {
        let mut random = RandomStream::new(u64::from(from.to_bits()), "knock");
        let mut open: VecDeque<Socket> = VecDeque::new();
        let mut knocked = Knocked::default();
        let began = Instant::now();
        while !is_over.load(Ordering::Acquire) {
            let mut socket = socket_at(from);
            let connected = socket.connect(&SocketAddr::V4(to).into());
            knocked.tried_count += 1;
            let is_under_way = match connected {
                Ok(()) => true,
                Err(error) => error.raw_os_error() == Some(libc::EINPROGRESS),
            };
            // Over a cable within one machine the answer is there by now.
            let words = words(&mut random, knocked.tried_count);
            let is_refused = !is_under_way
                || matches!(socket.take_error(), Ok(Some(_)))
                || (!words.is_empty() && socket.write_all(&words).is_err());
            if is_refused {
                knocked.refused_count += 1;
            } else {
                knocked.held_count += 1;
                open.push_back(socket);
            }
            if open.len() > OPEN_MAX {
                open.pop_front();
            }
            let due = Duration::from_secs_f64(knocked.tried_count as f64 / f64::from(rate));
            thread::sleep(due.saturating_sub(began.elapsed()));
        }
        knocked
    })
}

fn socket_at(from: Ipv4Addr) -> Socket {
    let made = Socket::new(Domain::IPV4, Type::STREAM, None).and_then(|socket| {
        socket.set_nonblocking(true)?;
        socket.bind(&SocketAddr::from((from, 0)).into())?;
        Ok(socket)
    });
    match made {
        Ok(socket) => socket,
        Err(error) => panic!("no socket at {from}: {error}"),
    }
}

/// What the connection of this number says.
fn words(random: &mut RandomStream, number: u64) -> Vec<u8> {
    let mut noise = |count: usize| {
        let bytes = (0..count).map(|_| random.next_u64().to_le_bytes()[0]);
        bytes.collect::<Vec<u8>>()
    };
    let head = |length: u16| {
        let [low, high] = length.to_le_bytes();
        vec![b'H', b'I', b'L', b'K', 1, 1, low, high]
    };
    match number % 6 {
        0 => Vec::new(),
        1 => b"GET / HTTP/1.1\r\n\r\n".to_vec(),
        2 => noise(64),
        // Whole, but not sealed with the key.
        3 => [head(FIRST_BYTES), noise(FIRST_BYTES.into())].concat(),
        4 => [head(FIRST_BYTES), noise(40)].concat(),
        _ => [head(60_000), noise(512)].concat(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_of_words_comes_and_none_is_longer_than_a_segment() {
        let mut random = RandomStream::new(1, "knock");
        let all: Vec<_> = (0..6).map(|number| words(&mut random, number)).collect();
        assert!(all[0].is_empty() && all[3].len() == 152);
        assert!(all.iter().filter(|one| one.starts_with(b"HILK")).count() == 3);
        assert!(all.iter().all(|one| one.len() < 1_400));
    }
}
