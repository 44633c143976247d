//! The library's server, shut to all but the door. It listens on TCP, checks no identity, and is in the
//! kernel's tables for every user of this machine to see. So its listener has a packet filter, which takes
//! connections of ours only, each from an address and port that no other socket has meanwhile.

use std::collections::VecDeque;
use std::io;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use hil_platform::open_files::listener_at;
use hil_platform::random::random_bytes;
use socket2::{SockFilter, SockRef};
use tokio::net::{TcpSocket, TcpStream};
use tokio::time::sleep;

use super::front::SEATS;

/// How long a connection of ours may take to be made on the listener's side, of which we do not hear: the last
/// packet of its handshake may come after `connect` has returned.
const MADE_WITHIN: Duration = Duration::from_secs(3);

/// The listener of the library's server.
#[derive(Debug, Clone)]
pub(crate) struct Gate(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    address: SocketAddr,
    /// The kernel takes the filter; Linux 6.18 does so with `CAP_NET_ADMIN` only.
    is_shut: bool,
    /// Where connections of ours come from that may not be made yet, and since when; the oldest first.
    let_in: Mutex<VecDeque<(Instant, SocketAddrV4)>>,
}

impl Gate {
    /// Shuts what listens in this process at `address`, where this process may; see [`Gate::is_shut`].
    ///
    /// # Errors
    /// When nothing does, or the kernel takes no filter for another reason.
    pub(crate) fn shut(address: SocketAddr) -> io::Result<Self> {
        let mut shared = Shared {
            address,
            is_shut: true,
            let_in: Mutex::default(),
        };
        match shared.let_in(None) {
            Err(why) if why.kind() == io::ErrorKind::PermissionDenied => shared.is_shut = false,
            done => done?,
        }
        Ok(Self(Arc::new(shared)))
    }

    /// False where every user of this machine can connect.
    pub(super) fn is_shut(&self) -> bool {
        self.0.is_shut
    }

    /// Connects `socket`, which must not be bound.
    ///
    /// # Errors
    /// What the kernel answers.
    pub(super) async fn connect(&self, socket: TcpSocket) -> io::Result<TcpStream> {
        if !self.is_shut() {
            return socket.connect(self.0.address).await;
        }
        self.0.let_in(Some(bind(&socket)?))?;
        let shared = Arc::clone(&self.0);
        tokio::spawn(async move {
            sleep(MADE_WITHIN).await;
            // What the kernel took before it takes again.
            let _is_shut = shared.let_in(None).is_ok();
        });
        socket.connect(self.0.address).await
    }
}

/// Binds `socket` to a random address of this machine.
fn bind(socket: &TcpSocket) -> io::Result<SocketAddrV4> {
    socket.bind(SocketAddr::new(hidden_address()?.into(), 0))?;
    match socket.local_addr()? {
        SocketAddr::V4(own) => Ok(own),
        SocketAddr::V6(_) => Err(io::ErrorKind::AddrNotAvailable.into()),
    }
}

impl Shared {
    /// Has the listener take packets from `more` too, and no longer from those that had their time. A
    /// connection keeps the filter with which it was made.
    fn let_in(&self, more: Option<SocketAddrV4>) -> io::Result<()> {
        let mut let_in = self.let_in.lock().unwrap_or_else(PoisonError::into_inner);
        let_in.retain(|(since, _)| since.elapsed() < MADE_WITHIN);
        if let Some(more) = more {
            if let_in.len() >= SEATS {
                let_in.pop_front();
            }
            let_in.push_back((Instant::now(), more));
        }
        // Not kept: the library may stop listening, and viewers are to hear of it.
        let listener = listener_at(self.address)?;
        let newest_first = let_in.iter().rev().map(|(_, one)| *one);
        SockRef::from(&listener).attach_filter(&program(newest_first))
    }
}

/// A filter that accepts packets from `sources` and drops all others.
fn program(sources: impl Iterator<Item = SocketAddrV4>) -> Vec<SockFilter> {
    const LOAD_WORD: u16 = 0x20;
    const LOAD_HALF: u16 = 0x28;
    const RETURN: u16 = 0x06;
    const JUMP_IF_EQUAL: u16 = 0x15;
    // `SKF_NET_OFF`, and the source in the header there (RFC 791).
    const SOURCE: u32 = 0xfff0_0000 + 12;
    let load_source = || SockFilter::new(LOAD_WORD, 0, 0, SOURCE);
    let each = sources.flat_map(|one| {
        [
            SockFilter::new(JUMP_IF_EQUAL, 0, 4, u32::from(*one.ip())),
            // The packet begins with the header of TCP, and that with the source port (RFC 9293).
            SockFilter::new(LOAD_HALF, 0, 0, 0),
            SockFilter::new(JUMP_IF_EQUAL, 0, 1, u32::from(one.port())),
            SockFilter::new(RETURN, 0, 0, u32::MAX),
            load_source(),
        ]
    });
    let drop = SockFilter::new(RETURN, 0, 0, 0);
    [load_source()]
        .into_iter()
        .chain(each)
        .chain([drop])
        .collect()
}

/// A random address of this machine.
///
/// # Errors
/// When the kernel has no random numbers.
pub(super) fn hidden_address() -> io::Result<Ipv4Addr> {
    random_bytes().map(hidden)
}

fn hidden([a, b, c]: [u8; 3]) -> Ipv4Addr {
    // The first is everybody's first guess, and those of the network and of all hosts are none.
    match (a, b, c) {
        (0, 0, 0 | 1) => Ipv4Addr::new(127, 0, 0, 2),
        (255, 255, 255) => Ipv4Addr::new(127, 255, 255, 254),
        _ => Ipv4Addr::new(127, a, b, c),
    }
}

#[cfg(test)]
mod tests {
    use std::net::TcpStream as StdStream;

    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    use tokio::net::TcpListener;
    use tokio::time::timeout;

    use super::*;

    /// Nothing here takes a tenth of this on an overloaded machine.
    const LIMIT: Duration = Duration::from_mins(1);

    fn in_time(steps: impl Future<Output = ()>) {
        let mut builder = tokio::runtime::Builder::new_multi_thread();
        let runtime = builder.worker_threads(1).enable_all().build().unwrap();
        runtime.block_on(async { timeout(LIMIT, steps).await.unwrap() });
    }

    async fn listener() -> (TcpListener, SocketAddr) {
        let listener = TcpListener::bind((hidden_address().unwrap(), 0)).await;
        let listener = listener.unwrap();
        let address = listener.local_addr().unwrap();
        (listener, address)
    }

    fn is_refused(address: SocketAddr) -> bool {
        StdStream::connect_timeout(&address, Duration::from_millis(300)).is_err()
    }

    #[test]
    fn what_comes_through_the_gate_is_connected_and_nothing_else_is() {
        in_time(async {
            let (listener, address) = listener().await;
            let gate = Gate::shut(address).unwrap();
            assert!(is_refused(address));
            for _ in 0..2 {
                let mut stream = gate.connect(TcpSocket::new_v4().unwrap()).await.unwrap();
                let (mut inside, from) = listener.accept().await.unwrap();
                assert_eq!(from, stream.local_addr().unwrap());
                assert!(is_refused(address));
                inside.write_all(b"x").await.unwrap();
                stream.read_exact(&mut [0]).await.unwrap();
            }
        });
    }

    #[test]
    fn those_that_connect_at_once_all_get_in() {
        in_time(async {
            let (listener, address) = listener().await;
            let gate = Gate::shut(address).unwrap();
            // Each is let in before the first sends a packet.
            let let_in = || {
                let socket = TcpSocket::new_v4().unwrap();
                gate.0.let_in(Some(bind(&socket).unwrap())).unwrap();
                socket
            };
            let sockets: Vec<_> = (0..SEATS).map(|_| let_in()).collect();
            for socket in sockets {
                let mut stream = socket.connect(address).await.unwrap();
                let (mut inside, from) = listener.accept().await.unwrap();
                assert_eq!(from, stream.local_addr().unwrap());
                stream.write_all(b"x").await.unwrap();
                inside.read_exact(&mut [0]).await.unwrap();
            }
            assert!(is_refused(address));
        });
    }

    #[test]
    fn what_had_its_time_is_let_in_no_more() {
        in_time(async {
            let (_listener, address) = listener().await;
            let gate = Gate::shut(address).unwrap();
            let late = TcpSocket::new_v4().unwrap();
            gate.0.let_in(Some(bind(&late).unwrap())).unwrap();
            sleep(MADE_WITHIN).await;
            gate.0.let_in(None).unwrap();
            let connected = timeout(Duration::from_millis(300), late.connect(address)).await;
            assert!(connected.is_err());
        });
    }

    #[test]
    fn the_hidden_address_is_on_loopback_and_not_the_one_everybody_tries() {
        assert_eq!(hidden([0, 0, 0]), Ipv4Addr::new(127, 0, 0, 2));
        assert_eq!(hidden([0, 0, 1]), Ipv4Addr::new(127, 0, 0, 2));
        assert_eq!(hidden([255, 255, 255]), Ipv4Addr::new(127, 255, 255, 254));
        assert_eq!(hidden([1, 2, 3]), Ipv4Addr::new(127, 1, 2, 3));
        let drawn: Vec<_> = (0..4).map(|_| hidden_address().unwrap()).collect();
        assert!(drawn.iter().all(Ipv4Addr::is_loopback));
        assert!(drawn[1..].iter().any(|one| *one != drawn[0]), "{drawn:?}");
    }
}
