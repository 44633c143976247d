//! One UDP socket that hears anyone and answers whom it is told to, with kernel stamps both ways:
//! what a foreign protocol needs whose client speaks first and expects answers from the very port
//! it spoke to. Our own gateways use the two sockets of [`super::udp`] instead.
//!
//! Transmit stamps that nobody fetched are charged to the receive buffer of this same socket:
//! whoever sends must drain [`DatagramSender::next_stamp`] after every send, or it goes deaf.

use std::io;
use std::net::SocketAddr;
use std::os::fd::BorrowedFd;

use socket2::SockAddr;

use super::socket::{GrantedOptions, SocketError, SocketSettings};
use super::udp::UdpSender;
use super::{DatagramSender, Received, SendRefusal, SenderCounters};
use hil_net::{TransmitStamp, TxToken};

/// The socket.
#[derive(Debug)]
pub struct UdpServer {
    line: UdpSender,
    peer: Option<SockAddr>,
}

impl UdpServer {
    /// Opens the socket at `settings.local`; `settings.peer` is not used.
    ///
    /// # Errors
    /// When the settings contradict themselves or the kernel refuses a step.
    pub fn open(settings: &SocketSettings) -> Result<Self, SocketError> {
        Ok(Self {
            line: UdpSender::open_towards(settings, None, true)?,
            peer: None,
        })
    }

    /// What the kernel granted.
    pub fn granted(&self) -> GrantedOptions {
        self.line.granted()
    }

    /// Where it listens, with the port the kernel chose.
    ///
    /// # Errors
    /// When the kernel does not tell.
    pub fn local_address(&self) -> io::Result<SocketAddr> {
        self.line.local_address()
    }

    /// Sends to `peer` from now on.
    pub fn answer_to(&mut self, peer: SocketAddr) {
        self.peer = Some(SockAddr::from(peer));
    }
}

impl DatagramSender for UdpServer {
    /// Sends to the peer that was named last; without one it is refused with `EDESTADDRREQ`.
    fn send(&mut self, datagram: &[u8]) -> Result<TxToken, SendRefusal> {
        let Some(peer) = &self.peer else {
            return Err(SendRefusal::Other {
                errno: libc::EDESTADDRREQ,
            });
        };
        self.line.send_towards(datagram, Some(peer))
    }

    /// A foreign protocol has no message that lies in two places.
    fn send_parts(&mut self, head: &[u8], tail: &[u8]) -> Result<TxToken, SendRefusal> {
        if tail.is_empty() {
            return self.send(head);
        }
        let length_bytes = head.len() + tail.len();
        Err(SendRefusal::TooLong { length_bytes })
    }

    fn next_stamp(&mut self) -> Option<TransmitStamp> {
        self.line.next_stamp()
    }

    fn receive(&mut self, buffer: &mut [u8]) -> io::Result<Option<Received>> {
        self.line.receive(buffer)
    }

    fn poll_fd(&self) -> Option<BorrowedFd<'_>> {
        self.line.poll_fd()
    }

    fn counters(&self) -> SenderCounters {
        self.line.counters()
    }
}

#[cfg(test)]
mod tests {
    use std::net::{Ipv4Addr, UdpSocket};
    use std::thread;

    use super::*;
    use hil_net::TransmitStage;

    fn server() -> UdpServer {
        let local = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
        UdpServer::open(&SocketSettings::new(local, local)).unwrap()
    }

    /// Waits for what loopback delivers at once, unless the machine is busy.
    fn soon<T>(mut look: impl FnMut() -> Option<T>) -> T {
        for _ in 0..5_000_000 {
            if let Some(found) = look() {
                return found;
            }
            thread::yield_now();
        }
        panic!("nothing came");
    }

    #[test]
    fn it_hears_anyone_and_answers_from_the_port_that_was_spoken_to() {
        let mut server = server();
        let address = server.local_address().unwrap();
        assert!(matches!(
            server.send(b"early"),
            Err(SendRefusal::Other { errno }) if errno == libc::EDESTADDRREQ
        ));
        for word in [b"one", b"two"] {
            let client = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
            client.send_to(word, address).unwrap();
            let mut buffer = [0; 16];
            let received = soon(|| server.receive(&mut buffer).unwrap());
            assert_eq!(&buffer[..received.length_bytes], word);
            assert_eq!(received.source, client.local_addr().unwrap());
            server.answer_to(received.source);
            let token = server.send(b"answer").unwrap();
            let stamp = soon(|| server.next_stamp());
            assert_eq!((stamp.token, stamp.stage), (token, TransmitStage::Sent));
            assert!(stamp.stamps.software_ns.is_some());
            let (length, from) = client.recv_from(&mut buffer).unwrap();
            assert_eq!((&buffer[..length], from), (&b"answer"[..], address));
        }
    }

    #[test]
    fn a_peer_that_is_gone_is_a_report_and_the_next_peer_is_served() {
        let mut server = server();
        let address = server.local_address().unwrap();
        let gone = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        server.answer_to(gone.local_addr().unwrap());
        drop(gone);
        server.send(b"nobody hears this").unwrap();
        soon(|| {
            while server.next_stamp().is_some() {}
            (server.counters().ignored_report_count > 0).then_some(())
        });
        let client = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        client.send_to(b"here", address).unwrap();
        let mut buffer = [0; 16];
        let received = soon(|| server.receive(&mut buffer).unwrap());
        server.answer_to(received.source);
        assert!(soon(|| server.send(b"hello").ok()).0 > 0);
        assert_eq!(client.recv(&mut buffer).unwrap(), 5);
    }
}
