//! Transports: how a datagram leaves one gateway and reaches the other, and when the kernel saw
//! it. They know no datagram layout; that is [`crate::protocol`].
//!
//! - [`udp`]: the real network, with separate sockets for sending and receiving.
//! - [`tcp`]: the real network as a stream, with what it costs in waiting.
//! - [`udp_server`]: one socket that hears anyone and answers, for foreign protocols.
//! - [`radio`]: whether the peer radio acknowledged each datagram.
//! - [`queue`]: an in-process pair, for tests.
//! - [`emulated`]: any receiver behind a link model.
//! - [`timestamping`] and [`probe`]: what the kernel and the network card can stamp, and whether
//!   they really do.
//! - [`clock_pair`]: from the real-time clock of the stamps to the monotonic clock of the run.
//!
//! A refused send or a report of the network is a state the caller sees, never an exit.

mod boxed;
pub mod card_arming;
pub mod card_clock;
pub mod clock_pair;
mod control;
pub mod emulated;
pub mod packet_ring;
pub mod probe;
pub mod queue;
pub mod radio;
mod reply_stamps;
pub mod tcp;
pub mod timestamping;
pub mod udp;
mod udp_receiver;
pub mod udp_server;
mod udp_socket;

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

use hil_models::link::LossCauses;
use hil_models::time::Instant;
use thiserror::Error;

use radio::RadioReport;
use tcp::StreamFigures;

/// The stamps the kernel attached to one datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct KernelStamps {
    /// Taken by the kernel, in nanoseconds of this host's `CLOCK_REALTIME`; `None` when the
    /// kernel gave none. [`clock_pair`] relates it to the monotonic clock.
    pub software_ns: Option<i64>,
    /// Taken by the network card, in nanoseconds of the card's own clock; `None` when the card
    /// gave none.
    pub hardware_ns: Option<i64>,
}

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
}

/// Names one successful send of one sender: 0, 1, 2, … modulo 2^32. A refused send takes none,
/// as the kernel's own counter (`SOF_TIMESTAMPING_OPT_ID`) does not advance then either.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct TxToken(pub u32);

/// Where on its way out a datagram was when the kernel stamped it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TransmitStage {
    /// Before the queueing discipline (`SCM_TSTAMP_SCHED`).
    Scheduled,
    /// After it: by the driver just before the card took it, or by the card (`SCM_TSTAMP_SND`).
    Sent,
}

/// A transmit stamp. One datagram may yield several: per stage, and software and hardware apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TransmitStamp {
    /// Which send it belongs to.
    pub token: TxToken,
    /// Where it was taken.
    pub stage: TransmitStage,
    /// The stamps.
    pub stamps: KernelStamps,
}

/// Why a datagram did not leave. Each is a state of the peer or of the network, to be counted
/// and shown; the next send may succeed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum SendRefusal {
    /// The peer's host answered an *earlier* datagram that nobody listens (`ECONNREFUSED`).
    #[error("nobody listens at the peer (ECONNREFUSED)")]
    PeerRefused,
    /// No way to the peer: `ENETUNREACH`, `EHOSTUNREACH`, `ENETDOWN`, `EHOSTDOWN`, `ENONET` or
    /// `EACCES`.
    #[error("peer is unreachable (errno {errno})")]
    Unreachable {
        /// Which of them.
        errno: i32,
    },
    /// A queue on the way out is full: `ENOBUFS` or `EAGAIN`.
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

    /// The refusal that `error` stands for; an error without an errno becomes errno 0.
    pub(crate) fn from_io(error: &io::Error, length_bytes: usize) -> Self {
        Self::from_errno(error.raw_os_error().unwrap_or(0), length_bytes)
    }
}

/// Everything a sender counts since it was opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SenderCounters {
    /// Datagrams the transport took.
    pub sent_count: u64,
    /// Sends refused with [`SendRefusal::PeerRefused`].
    pub peer_refused_count: u64,
    /// Sends refused with [`SendRefusal::Unreachable`].
    pub unreachable_count: u64,
    /// Sends refused with [`SendRefusal::QueueFull`].
    pub queue_full_count: u64,
    /// Sends refused with [`SendRefusal::TooLong`].
    pub too_long_count: u64,
    /// Sends refused with [`SendRefusal::NotConnected`].
    pub not_connected_count: u64,
    /// Sends refused with [`SendRefusal::Other`].
    pub other_refusal_count: u64,
    /// Transmit stamps handed out.
    pub stamp_count: u64,
    /// Transmit stamps that named no datagram of this sender, dropped.
    pub unmatched_stamp_count: u64,
    /// Transmit stamps dropped because nobody fetched them in time; known for a queue only, the
    /// kernel does not tell.
    pub stamp_overflow_count: u64,
    /// Reports of the network (ICMP) about earlier datagrams, swallowed.
    pub network_report_count: u64,
    /// Reports of this host's stack about earlier datagrams (for instance their length),
    /// swallowed.
    pub local_report_count: u64,
    /// Entries of the error queue that could not be read or understood, dropped.
    pub undecodable_report_count: u64,
    /// Replies received from the peer.
    pub reply_count: u64,
    /// Replies the kernel dropped because the receive buffer was full (`SO_RXQ_OVFL`). Known as
    /// of the newest reply received.
    pub kernel_drop_count: u64,
    /// Datagrams the peer radio acknowledged; asked for on wireless interfaces only.
    pub radio_acknowledged_count: u64,
    /// Datagrams the peer radio did not acknowledge.
    pub radio_unacknowledged_count: u64,
    /// Reports of the radio that name no send of ours or came too late to be matched, dropped.
    pub radio_unmatched_count: u64,
    /// Reports of the radio dropped because nobody took them in time.
    pub radio_overflow_count: u64,
    /// What the newest network or local report said.
    pub newest_report: Option<SendRefusal>,
}

impl SenderCounters {
    /// Every counter with its name, in the order above.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> + use<> {
        [
            ("sent_count", self.sent_count),
            ("peer_refused_count", self.peer_refused_count),
            ("unreachable_count", self.unreachable_count),
            ("queue_full_count", self.queue_full_count),
            ("too_long_count", self.too_long_count),
            ("not_connected_count", self.not_connected_count),
            ("other_refusal_count", self.other_refusal_count),
            ("stamp_count", self.stamp_count),
            ("unmatched_stamp_count", self.unmatched_stamp_count),
            ("stamp_overflow_count", self.stamp_overflow_count),
            ("network_report_count", self.network_report_count),
            ("local_report_count", self.local_report_count),
            ("undecodable_report_count", self.undecodable_report_count),
            ("reply_count", self.reply_count),
            ("kernel_drop_count", self.kernel_drop_count),
            ("radio_acknowledged_count", self.radio_acknowledged_count),
            (
                "radio_unacknowledged_count",
                self.radio_unacknowledged_count,
            ),
            ("radio_unmatched_count", self.radio_unmatched_count),
            ("radio_overflow_count", self.radio_overflow_count),
        ]
        .into_iter()
    }
}

impl SenderCounters {
    pub(crate) fn count_refusal(&mut self, refusal: SendRefusal) {
        let counter = match refusal {
            SendRefusal::PeerRefused => &mut self.peer_refused_count,
            SendRefusal::Unreachable { .. } => &mut self.unreachable_count,
            SendRefusal::QueueFull { .. } => &mut self.queue_full_count,
            SendRefusal::TooLong { .. } => &mut self.too_long_count,
            SendRefusal::NotConnected => &mut self.not_connected_count,
            SendRefusal::Other { .. } => &mut self.other_refusal_count,
        };
        *counter += 1;
    }

    /// Sends refused, whatever the reason.
    pub fn refused_count(&self) -> u64 {
        self.peer_refused_count
            + self.unreachable_count
            + self.queue_full_count
            + self.too_long_count
            + self.not_connected_count
            + self.other_refusal_count
    }
}

/// Everything a receiver counts since it was opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ReceiverCounters {
    /// Datagrams handed to the caller.
    pub received_count: u64,
    /// Of those, with a software stamp. Divided by `received_count` it is the stamp coverage.
    pub software_stamp_count: u64,
    /// Of those, with a hardware stamp.
    pub hardware_stamp_count: u64,
    /// Of those, cut off because the buffer was too short.
    pub truncated_count: u64,
    /// Of those, with control data that was cut off or damaged, so stamps may be missing.
    pub damaged_control_count: u64,
    /// Datagrams without a readable source address, dropped.
    pub sourceless_count: u64,
    /// Datagrams the kernel dropped because the receive buffer was full (`SO_RXQ_OVFL`). Known
    /// as of the newest datagram received: drops after it show with the next one.
    pub kernel_drop_count: u64,
    /// Replies the transport took.
    pub reply_count: u64,
    /// Replies it refused.
    pub reply_refused_count: u64,
    /// Transmit stamps of replies handed out.
    pub reply_stamp_count: u64,
    /// Transmit stamps of replies that were asked for and did not come in time.
    pub reply_stamp_missing_count: u64,
    /// Datagrams the link model lost.
    pub link_lost_count: u64,
    /// Datagrams dropped because the emulation already held as many as it may.
    pub link_overflow_count: u64,
    /// What the lost ones were lost to; `None` without a link model, or for one that does not tell.
    pub link_loss_causes: Option<LossCauses>,
    /// Datagrams that arrived with the code point this end marks with; counted where it marks.
    pub mark_kept_count: u64,
    /// Datagrams that arrived with another code point: something on the way changed it, or the
    /// sender marks otherwise.
    pub mark_changed_count: u64,
    /// The code point of the newest of those.
    pub newest_other_dscp: Option<u8>,
}

impl ReceiverCounters {
    /// Every counter with its name, in the order above.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> + use<> {
        [
            ("received_count", self.received_count),
            ("software_stamp_count", self.software_stamp_count),
            ("hardware_stamp_count", self.hardware_stamp_count),
            ("truncated_count", self.truncated_count),
            ("damaged_control_count", self.damaged_control_count),
            ("sourceless_count", self.sourceless_count),
            ("kernel_drop_count", self.kernel_drop_count),
            ("reply_count", self.reply_count),
            ("reply_refused_count", self.reply_refused_count),
            ("reply_stamp_count", self.reply_stamp_count),
            ("reply_stamp_missing_count", self.reply_stamp_missing_count),
            ("link_lost_count", self.link_lost_count),
            ("link_overflow_count", self.link_overflow_count),
            ("mark_kept_count", self.mark_kept_count),
            ("mark_changed_count", self.mark_changed_count),
        ]
        .into_iter()
        .chain(self.link_loss_causes.into_iter().flat_map(|causes| {
            [
                ("link_lost_to_outages_count", causes.outage_count),
                ("link_lost_by_chance_count", causes.chance_count),
                ("link_lost_to_full_queue_count", causes.queue_count),
            ]
        }))
    }
}

impl ReceiverCounters {
    /// Compares the mark of an arrival with the one it should have; neither is known without
    /// marking.
    pub(crate) fn count_mark(&mut self, expected_dscp: Option<u8>, class: Option<u8>) {
        let Some((expected_dscp, class)) = expected_dscp.zip(class) else {
            return;
        };
        // The two low bits are for congestion (RFC 3168).
        let dscp = class >> 2;
        if dscp == expected_dscp {
            self.mark_kept_count += 1;
        } else {
            self.mark_changed_count += 1;
            self.newest_other_dscp = Some(dscp);
        }
    }

    pub(crate) fn count_received(&mut self, received: &Received) {
        self.received_count += 1;
        self.truncated_count += u64::from(received.is_truncated);
        self.software_stamp_count += u64::from(received.stamps.software_ns.is_some());
        self.hardware_stamp_count += u64::from(received.stamps.hardware_ns.is_some());
    }
}

/// The sending end of a transport: towards one peer, with stamps and the peer's replies coming
/// back. Nothing here blocks.
///
/// ```
/// use hil_gateways::transport::queue::{QueueSettings, queue_pair};
/// use hil_gateways::transport::{DatagramReceiver, DatagramSender, TxToken};
/// use hil_models::time::Instant;
///
/// let (mut sender, mut receiver) = queue_pair(&QueueSettings::default());
/// assert_eq!(sender.send(b"stop"), Ok(TxToken(0)));
/// while let Some(stamp) = sender.next_stamp() {
///     println!("datagram {} left at {:?}", stamp.token.0, stamp.stamps.software_ns);
/// }
/// let mut buffer = [0; 16];
/// let received = receiver.receive(Instant::ZERO, &mut buffer).unwrap().unwrap();
/// assert_eq!(&buffer[..received.length_bytes], b"stop");
/// ```
pub trait DatagramSender: Debug + Send {
    /// Hands one datagram to the transport.
    ///
    /// # Errors
    /// The state that kept it from leaving; it is counted.
    fn send(&mut self, datagram: &[u8]) -> Result<TxToken, SendRefusal>;

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

    /// True while bytes of a datagram it took have not been given to the kernel.
    fn has_unsent(&self) -> bool {
        false
    }

    /// What a transport with connections saw until `now`; `None` for one without.
    fn stream_figures(&self, _now: Instant) -> Option<StreamFigures> {
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

    /// Does what is due beside receiving, such as taking connections: call it whenever the
    /// descriptor has something and [`DatagramReceiver::receive`] gave nothing.
    fn attend(&mut self, _now: Instant) {}

    /// What a transport with connections saw until `now`; `None` for one without.
    fn stream_figures(&self, _now: Instant) -> Option<StreamFigures> {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
