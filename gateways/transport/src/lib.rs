//! Transports: how a datagram leaves one gateway and reaches the other, and when the kernel saw
//! it. They know no datagram layout; that is [`hil_protocol`].
//!
//! - [`registry`]: the list of transports, and what each is: a name, capabilities, and how its
//!   ends are opened.
//! - [`udp`]: the real network, with separate sockets for sending and receiving, and one for both where a foreign
//!   protocol wants that.
//! - [`tcp`]: the real network as a stream, with what it costs in waiting.
//! - [`emulated`]: any receiver behind a link model.
//! - [`sealed`]: any sender or receiver behind encryption and authentication.
//! - [`probe`]: which stamps really arrive, by sending.
//!
//! A refused send or a report of the network is a state the caller sees, never an exit.
#![forbid(unsafe_code)]

mod counters;
pub mod emulated;
pub mod probe;
#[cfg(any(test, feature = "lab"))]
#[path = "tests/queue.rs"]
pub mod queue;
pub mod registry;
pub mod sealed;
pub mod socket;
pub mod tcp;
pub mod udp;

#[cfg(test)]
mod answering_tests;
#[cfg(test)]
mod conformance_tests;
#[cfg(test)]
mod host_tests;
#[cfg(test)]
mod reply_stamp_tests;
#[cfg(test)]
mod trap_tests;

use core::fmt::Debug;
use std::io;
use std::net::SocketAddr;
use std::os::fd::BorrowedFd;

use hil_core::time::Instant;
use thiserror::Error;

pub use counters::{
    ConnectionTally, EndReport, LinkCounts, ReceiverCounters, SenderCounters, Stalls,
};

use hil_net::radio::RadioReport;
use hil_net::{KernelStamps, TransmitStamp, TxToken};
use hil_protocol::seal::SealCounts;

/// When a link model took a datagram and when it gave it back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EmulatedDelay {
    /// When the emulation took it from the transport below, monotonic clock.
    pub arrived: Instant,
    /// When the link model let it arrive, monotonic clock; never before `arrived`.
    pub due: Instant,
}

/// One received datagram; its bytes are in the caller's buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Received {
    /// Bytes written to the buffer.
    pub length_bytes: usize,
    /// The datagram was longer than the buffer and its end is gone.
    pub is_truncated: bool,
    /// Who sent it. A receiver takes datagrams of anyone: the caller checks.
    pub source: SocketAddr,
    /// Receive stamps.
    pub stamps: KernelStamps,
    /// Set when a link model held the datagram.
    pub emulated: Option<EmulatedDelay>,
    /// Datagrams that found no room on this host before this one came, since the receiver was opened; 0 where
    /// nothing tells.
    pub no_room_count: u64,
}

impl Received {
    /// `datagram` in `buffer`, or as much of it as has room there; nothing stamped it.
    pub(crate) fn copied(datagram: &[u8], buffer: &mut [u8], source: SocketAddr) -> Self {
        let length_bytes = datagram.len().min(buffer.len());
        buffer[..length_bytes].copy_from_slice(&datagram[..length_bytes]);
        Self {
            length_bytes,
            is_truncated: length_bytes < datagram.len(),
            source,
            stamps: KernelStamps::default(),
            emulated: None,
            no_room_count: 0,
        }
    }
}

/// Why a datagram did not leave. Each is a state of the peer or of the network, to be counted
/// and shown; the next send may succeed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum SendRefusal {
    /// The peer's host answered an *earlier* datagram that nobody listens (`ECONNREFUSED`).
    #[error("nobody listens at the peer (ECONNREFUSED)")]
    PeerRefused,
    /// No way to the peer: `ENETUNREACH`, `EHOSTUNREACH`, `ENETDOWN`, `EHOSTDOWN`, `ENONET` or
    /// `EACCES`; or `ENOBUFS` of an interface without a carrier.
    #[error("peer is unreachable (errno {errno})")]
    Unreachable {
        /// Which of them.
        errno: i32,
    },
    /// A queue on the way out is full: `ENOBUFS` of an interface with a carrier, or `EAGAIN`.
    #[error("a send queue is full (errno {errno})")]
    QueueFull {
        /// Which of them.
        errno: i32,
    },
    /// Longer than the path takes in one piece (`EMSGSIZE`).
    #[error("datagram of {length_bytes} bytes is too long for the path (EMSGSIZE)")]
    TooLong {
        /// Its length; 0 when the refusal came later, as a report.
        length_bytes: usize,
    },
    /// A transport with connections has none to the peer just now.
    #[error("there is no connection to the peer")]
    NotConnected,
    /// Anything else the kernel answered.
    #[error("send was refused (errno {errno})")]
    Other {
        /// What it answered.
        errno: i32,
    },
}

impl SendRefusal {
    /// True where there is no way to the peer, whoever the peer is.
    pub const fn is_unreachable(self) -> bool {
        matches!(self, Self::Unreachable { .. })
    }

    /// The refusal that `errno` stands for, for a datagram of `length_bytes`.
    pub fn from_errno(errno: i32, length_bytes: usize) -> Self {
        match errno {
            libc::ECONNREFUSED => Self::PeerRefused,
            // ENONET and EACCES are what ICMP reports of an unknown or forbidding network become.
            libc::ENETUNREACH
            | libc::EHOSTUNREACH
            | libc::ENETDOWN
            | libc::EHOSTDOWN
            | libc::ENONET
            | libc::EACCES => Self::Unreachable { errno },
            // EWOULDBLOCK has the value of EAGAIN on Linux.
            libc::ENOBUFS | libc::EAGAIN => Self::QueueFull { errno },
            libc::EMSGSIZE => Self::TooLong { length_bytes },
            _ => Self::Other { errno },
        }
    }

    /// The refusal as it is where the interface that it left by has a carrier or not: Linux takes the queue away from an
    /// interface whose cable is out, and answers as if the queue were full.
    pub(crate) fn at_interface(self, has_carrier: impl FnOnce() -> bool) -> Self {
        match self {
            Self::QueueFull {
                errno: errno @ libc::ENOBUFS,
            } if !has_carrier() => Self::Unreachable { errno },
            other => other,
        }
    }

    /// The refusal that `error` stands for; an error without an errno becomes errno 0.
    pub(crate) fn from_io(error: &io::Error, length_bytes: usize) -> Self {
        Self::from_errno(error.raw_os_error().unwrap_or(0), length_bytes)
    }
}

/// The sending end of a transport: towards one peer, with stamps and the peer's replies coming
/// back. Nothing here blocks.
///
/// ```no_run
/// use hil_core::time::Instant;
/// use hil_transport::socket::SocketSettings;
/// use hil_transport::udp::{UdpReceiver, UdpSender};
/// use hil_transport::{DatagramReceiver, DatagramSender};
///
/// let anywhere = "127.0.0.1:0".parse()?;
/// let mut receiver = UdpReceiver::open(&SocketSettings::new(anywhere, anywhere))?;
/// let there = receiver.local_address()?;
/// let mut sender = UdpSender::open(&SocketSettings::new(anywhere, there))?;
/// sender.send(b"stop")?;
/// while let Some(stamp) = sender.next_stamp() {
///     println!("datagram {} left at {:?}", stamp.token.0, stamp.stamps.software_ns);
/// }
/// let mut buffer = [0; 16];
/// if let Some(received) = receiver.receive(Instant::ZERO, &mut buffer)? {
///     println!("{:?}", &buffer[..received.length_bytes]);
/// }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub trait DatagramSender: Debug + Send {
    /// Hands one datagram to the transport.
    ///
    /// # Errors
    /// The state that kept it from leaving; it is counted.
    fn send(&mut self, datagram: &[u8]) -> Result<TxToken, SendRefusal>;

    /// As [`DatagramSender::send`], of a datagram that lies in two places: a long message's piece is not
    /// copied behind its header first.
    ///
    /// # Errors
    /// As [`DatagramSender::send`].
    fn send_parts(&mut self, head: &[u8], tail: &[u8]) -> Result<TxToken, SendRefusal>;

    /// The next transmit stamp that has arrived. Call it until `None` after every send: the
    /// kernel charges unfetched stamps to the receive buffer, so a sender that is never drained
    /// hears no replies. Reports of the network are swallowed and counted on the way.
    fn next_stamp(&mut self) -> Option<TransmitStamp>;

    /// The next report of the radio that [`DatagramSender::next_stamp`] found on its way; call it
    /// until `None` after that. A transport without a radio has none.
    fn next_radio_report(&mut self) -> Option<RadioReport> {
        None
    }

    /// The next reply of the peer, if one has arrived.
    ///
    /// # Errors
    /// When the transport itself is broken; states of the peer are not errors.
    fn receive(&mut self, buffer: &mut [u8]) -> io::Result<Option<Received>>;

    /// What to wait on for stamps (`POLLERR`) and replies (`POLLIN`); `None` when the transport
    /// has no descriptor.
    fn poll_fd(&self) -> Option<BorrowedFd<'_>>;

    /// What was counted since the start.
    fn counters(&self) -> SenderCounters;

    /// Does what is due beside sending, such as connecting: call it at
    /// [`DatagramSender::next_due`] and whenever the descriptor has something.
    fn attend(&mut self, _now: Instant) {}

    /// When [`DatagramSender::attend`] is due without a word from the descriptor.
    fn next_due(&self) -> Option<Instant> {
        None
    }

    /// Bytes that this host has not got rid of yet, as far as the kernel tells: what a datagram sent now
    /// waits for.
    fn queued_bytes(&self) -> usize {
        0
    }

    /// True while bytes of a datagram it took have not been given to the kernel.
    fn has_unsent(&self) -> bool {
        false
    }

    /// What only this transport counts and has to tell, until `now`.
    fn report(&self, _now: Instant) -> EndReport {
        EndReport::default()
    }

    /// What a transport behind the seal counted; `None` for a plain one.
    fn seal_counts(&self) -> Option<SealCounts> {
        None
    }
}

/// The receiving end of a transport. Nothing here blocks. See [`DatagramSender`] for an example.
pub trait DatagramReceiver: Debug + Send {
    /// The next datagram that has arrived, or was due, by `now`.
    ///
    /// # Errors
    /// When the transport itself is broken; a bad or foreign datagram is not an error.
    fn receive(&mut self, now: Instant, buffer: &mut [u8]) -> io::Result<Option<Received>>;

    /// Sends `datagram` back to `to`, the source of an earlier datagram, without a transmit stamp:
    /// stamps would compete with arrivals for the receive buffer.
    ///
    /// # Errors
    /// The state that kept it from leaving; it is counted.
    fn reply(&mut self, datagram: &[u8], to: SocketAddr) -> Result<(), SendRefusal>;

    /// As [`DatagramReceiver::reply`], to whoever sent the datagram that [`DatagramReceiver::receive`] gave
    /// last, whether or not it has been proven to be the peer.
    ///
    /// # Errors
    /// As [`DatagramReceiver::reply`].
    fn answer(&mut self, datagram: &[u8], to: SocketAddr) -> Result<(), SendRefusal> {
        self.reply(datagram, to)
    }

    /// Says that the datagram that [`DatagramReceiver::receive`] gave last is the peer's: of several
    /// connections the one that it came on is the peer's from now on.
    fn prove(&mut self) {}

    /// As [`DatagramReceiver::reply`], and asks for the stamp of its departure, where the
    /// transport has stamps. It is for few replies, as each costs system calls.
    ///
    /// # Errors
    /// As [`DatagramReceiver::reply`].
    fn reply_stamped(
        &mut self,
        _now: Instant,
        datagram: &[u8],
        to: SocketAddr,
    ) -> Result<(), SendRefusal> {
        self.reply(datagram, to)
    }

    /// When the newest stamped reply left, nanoseconds of this host's `CLOCK_REALTIME`; once, and
    /// `None` while it has not come. Call it after the reply and whenever nothing arrived; it
    /// makes a system call only while a stamp may be there.
    fn take_reply_stamp(&mut self, _now: Instant) -> Option<i64> {
        None
    }

    /// When a datagram held back by a link model is due; `None` when none is held. A wait for
    /// [`DatagramReceiver::poll_fd`] must end then.
    fn next_due(&self) -> Option<Instant>;

    /// What to wait on for arrivals (`POLLIN`); `None` when the transport has no descriptor.
    fn poll_fd(&self) -> Option<BorrowedFd<'_>>;

    /// What was counted since the start.
    fn counters(&self) -> ReceiverCounters;

    /// [`Received::no_room_count`] as of now, also of what came after the newest datagram.
    fn no_room_count(&self) -> u64 {
        self.counters().kernel_drop_count
    }

    /// Does what is due beside receiving, such as taking connections: call it whenever the
    /// descriptor has something and [`DatagramReceiver::receive`] gave nothing.
    fn attend(&mut self, _now: Instant) {}

    /// What a link model in front of it did to the datagrams of `channel`; `None` without one.
    fn link_counts(&self, _channel: u16) -> Option<LinkCounts> {
        None
    }

    /// What only this transport counts and has to tell, until `now`.
    fn report(&self, _now: Instant) -> EndReport {
        EndReport::default()
    }

    /// What a transport behind the seal counted; `None` for a plain one.
    fn seal_counts(&self) -> Option<SealCounts> {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_queue_of_an_interface_without_a_carrier_is_no_way_to_the_peer() {
        let full = |errno| SendRefusal::QueueFull { errno };
        let errno = libc::ENOBUFS;
        let unreachable = SendRefusal::Unreachable { errno };
        assert_eq!(full(errno).at_interface(|| false), unreachable);
        assert_eq!(full(errno).at_interface(|| true), full(errno));
        // The buffer of the socket says nothing of the interface.
        let of_socket = full(libc::EAGAIN);
        assert_eq!(of_socket.at_interface(|| false), of_socket);
        let refused = SendRefusal::PeerRefused;
        assert_eq!(refused.at_interface(|| unreachable!()), refused);
    }

    #[test]
    fn each_errno_of_the_network_is_a_state() {
        let unreachable = |errno| SendRefusal::Unreachable { errno };
        for (errno, expected) in [
            (libc::ECONNREFUSED, SendRefusal::PeerRefused),
            (libc::ENETUNREACH, unreachable(libc::ENETUNREACH)),
            (libc::EHOSTUNREACH, unreachable(libc::EHOSTUNREACH)),
            (libc::ENETDOWN, unreachable(libc::ENETDOWN)),
            (
                libc::ENOBUFS,
                SendRefusal::QueueFull {
                    errno: libc::ENOBUFS,
                },
            ),
            (
                libc::EWOULDBLOCK,
                SendRefusal::QueueFull {
                    errno: libc::EAGAIN,
                },
            ),
            (libc::EMSGSIZE, SendRefusal::TooLong { length_bytes: 9 }),
            (libc::EPERM, SendRefusal::Other { errno: libc::EPERM }),
        ] {
            assert_eq!(SendRefusal::from_errno(errno, 9), expected);
            let mut counters = SenderCounters::default();
            counters.count_refusal(expected);
            assert_eq!(counters.refused_count(), 1);
        }
    }
}
