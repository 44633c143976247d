//! The library's server, shut to all but the door. It listens on TCP, asks nobody who they are, and is in the
//! kernel's tables for every user of this machine to see. So its listener has a packet filter, which lets one
//! connection of ours through at a time, by an address and port that no other socket has meanwhile.

use std::io;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::sync::Arc;
use std::time::Duration;

use hil_platform::open_files::listener_at;
use hil_platform::random::random_bytes;
use socket2::{SockFilter, SockRef};
use tokio::net::{TcpSocket, TcpStream};
use tokio::sync::Mutex;
use tokio::time::sleep;

/// How long a connection of ours may take to be made on the listener's side, of which we do not hear.
const MADE_WITHIN: Duration = Duration::from_secs(3);

/// The listener of the library's server.
#[derive(Debug, Clone)]
pub(crate) struct Gate(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    address: SocketAddr,
    /// Connections that were let through.
    count: Mutex<u64>,
}

impl Gate {
    /// Shuts what listens in this process at `address`.
    ///
    /// # Errors
    /// When nothing does, or the kernel takes no filter.
    pub(crate) fn shut(address: SocketAddr) -> io::Result<Self> {
        let count = Mutex::new(0);
        let gate = Self(Arc::new(Shared { address, count }));
        gate.0.let_in(None)?;
        Ok(gate)
    }

    /// Connects `socket`, which must not be bound, and nobody else.
    ///
    /// # Errors
    /// What the kernel answers.
    pub(super) async fn connect(&self, socket: TcpSocket) -> io::Result<TcpStream> {
        let mut count = self.0.count.lock().await;
        socket.bind(SocketAddr::new(hidden_address()?.into(), 0))?;
        let SocketAddr::V4(own) = socket.local_addr()? else {
            return Err(io::ErrorKind::AddrNotAvailable.into());
        };
        self.0.let_in(Some(own))?;
        *count += 1;
        let number = *count;
        let shared = Arc::clone(&self.0);
        tokio::spawn(async move {
            sleep(MADE_WITHIN).await;
            let count = shared.count.lock().await;
            if *count == number {
                // What the kernel took before it takes again.
                let _is_shut = shared.let_in(None).is_ok();
            }
        });
        socket.connect(self.0.address).await
    }
}

impl Shared {
    /// Has the listener take packets from `one` only. A connection keeps the filter with which it was made.
    fn let_in(&self, one: Option<SocketAddrV4>) -> io::Result<()> {
        const LOAD_WORD: u16 = 0x20;
        const LOAD_HALF: u16 = 0x28;
        const RETURN: u16 = 0x06;
        const JUMP_IF_EQUAL: u16 = 0x15;
        // `SKF_NET_OFF`, and the source in the header there (RFC 791).
        const SOURCE: u32 = 0xfff0_0000 + 12;
        let drop = SockFilter::new(RETURN, 0, 0, 0);
        // Not kept: the library may stop listening, and viewers are to hear of it.
        let listener = listener_at(self.address)?;
        let listener = SockRef::from(&listener);
        let Some(one) = one else {
            return listener.attach_filter(&[drop]);
        };
        listener.attach_filter(&[
            SockFilter::new(LOAD_WORD, 0, 0, SOURCE),
            SockFilter::new(JUMP_IF_EQUAL, 0, 3, u32::from(*one.ip())),
            // The packet begins with the header of TCP, and that with the source port (RFC 9293).
            SockFilter::new(LOAD_HALF, 0, 0, 0),
            SockFilter::new(JUMP_IF_EQUAL, 0, 1, u32::from(one.port())),
            SockFilter::new(RETURN, 0, 0, u32::MAX),
            drop,
        ])
    }
}

/// An address of this machine's own that nobody knows.
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
    use std::io::{Read as _, Write as _};
    use std::net::{TcpListener, TcpStream as StdStream};

    use super::*;

    #[test]
    fn what_comes_through_the_gate_is_connected_and_nothing_else_is() {
        let listener = TcpListener::bind((hidden_address().unwrap(), 0)).unwrap();
        let address = listener.local_addr().unwrap();
        let gate = Gate::shut(address).unwrap();
        let refused = || StdStream::connect_timeout(&address, Duration::from_millis(300)).is_err();
        assert!(refused());
        let mut builder = tokio::runtime::Builder::new_multi_thread();
        let runtime = builder.worker_threads(1).enable_all().build().unwrap();
        for _ in 0..2 {
            let connect = gate.connect(TcpSocket::new_v4().unwrap());
            let stream = runtime.block_on(async { connect.await.unwrap().into_std().unwrap() });
            stream.set_nonblocking(false).unwrap();
            let (mut inside, from) = listener.accept().unwrap();
            assert_eq!(from, stream.local_addr().unwrap());
            assert!(refused());
            inside.write_all(b"x").unwrap();
            (&stream).read_exact(&mut [0]).unwrap();
        }
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
