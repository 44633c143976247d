//! The socket of one arm with the transmit stamps that are still to come from it. It knows no
//! message: robot and sensor face do.

use hil_core::record::UNAVAILABLE;
use hil_core::time::Instant;
use hil_net::{TransmitStage, TxToken};
use hil_transport::udp::UdpSender;
use hil_transport::udp_server::UdpServer;
use hil_transport::{DatagramSender, Received, SendRefusal, SenderCounters};
use std::net::SocketAddr;
use std::os::fd::BorrowedFd;

use super::FaceError;
use crate::gateway::GatewayError;
use crate::gateway::kernel_clock::KernelClock;
use hil_rundir::face_record::{FaceReceivedRecord, FaceSentRecord};
use hil_rundir::record::RecordSink;

/// Datagrams whose transmit stamps may be outstanding; a power of two.
const PENDING: usize = 64;
/// A stamp that has not come by then does not come.
const STAMP_PATIENCE_NS: i64 = 20_000_000;

/// Which end of the protocol's UDP the socket is.
#[derive(Debug)]
pub(super) enum Socket {
    /// Connected to the foreign program: the robot speaks first, and to nobody else.
    Client(Box<UdpSender>),
    /// Hears anyone and answers the robot.
    Server(Box<UdpServer>),
}

impl Socket {
    fn sender(&self) -> &dyn DatagramSender {
        match self {
            Self::Client(socket) => socket.as_ref(),
            Self::Server(socket) => socket.as_ref(),
        }
    }

    fn sender_mut(&mut self) -> &mut dyn DatagramSender {
        match self {
            Self::Client(socket) => socket.as_mut(),
            Self::Server(socket) => socket.as_mut(),
        }
    }
}

#[derive(Debug, Clone, Copy)]
struct Pending {
    token: TxToken,
    record: FaceSentRecord,
}

/// The socket, its records and the clock of its stamps.
#[derive(Debug)]
pub(super) struct Line {
    socket: Socket,
    pending: [Option<Pending>; PENDING],
    pending_count: usize,
    sent: RecordSink,
    received: RecordSink,
    clock: KernelClock,
    has_stamps: bool,
}

impl Line {
    pub(super) fn new(
        socket: Socket,
        (sent, received): (RecordSink, RecordSink),
        has_stamps: bool,
    ) -> Result<Self, FaceError> {
        Ok(Self {
            socket,
            pending: [None; PENDING],
            pending_count: 0,
            sent,
            received,
            clock: KernelClock::read()?,
            has_stamps,
        })
    }

    /// Answers `peer` from now on; a connected socket has its peer.
    pub(super) fn answer_to(&mut self, peer: SocketAddr) {
        if let Socket::Server(socket) = &mut self.socket {
            socket.answer_to(peer);
        }
    }

    /// Sends `datagram`, then takes the stamps that have come. A refusal is a state of the network
    /// or of the peer; the socket counts it.
    pub(super) fn send(&mut self, datagram: &[u8], record: FaceSentRecord) -> bool {
        let record = FaceSentRecord {
            tx_software_ns: UNAVAILABLE,
            realtime_offset_ns: self.clock.offset_ns(),
            ..record
        };
        let sent: Result<TxToken, SendRefusal> = self.socket.sender_mut().send(datagram);
        match sent {
            Ok(token) if self.has_stamps => {
                let slot = slot_of(token);
                if let Some(old) = self.pending[slot].take() {
                    self.retire(&old);
                }
                self.pending[slot] = Some(Pending { token, record });
                self.pending_count += 1;
                while self.pending_count > 0 && self.take_stamp() {}
            }
            Ok(_) => self.sent.push(&record),
            Err(_counted) => self.sent.push(&FaceSentRecord {
                flags: record.flags | FaceSentRecord::REFUSED_BY_KERNEL,
                ..record
            }),
        }
        sent.is_ok()
    }

    /// Takes one stamp without blocking; false when there is none. Reports of the network come the
    /// same way and are counted by the socket.
    fn take_stamp(&mut self) -> bool {
        let Some(stamp) = self.socket.sender_mut().next_stamp() else {
            return false;
        };
        let slot = slot_of(stamp.token);
        let pending = self.pending[slot];
        let pending = pending.filter(|one| one.token == stamp.token);
        if let (Some(mut pending), Some(software_ns), TransmitStage::Sent) =
            (pending, stamp.stamps.software_ns, stamp.stage)
        {
            self.pending[slot] = None;
            pending.record.tx_software_ns = software_ns;
            self.retire(&pending);
        }
        true
    }

    fn retire(&mut self, pending: &Pending) {
        self.pending_count -= 1;
        self.sent.push(&pending.record);
    }

    /// Takes every stamp and report there is, gives up those that are overdue at `now`, and reads
    /// the clocks again when it is time to.
    pub(super) fn look_after(&mut self, now: Instant) {
        while self.take_stamp() {}
        if self.pending_count > 0 {
            for slot in 0..PENDING {
                let is_overdue = self.pending[slot].is_some_and(|one| {
                    now.as_ns().saturating_sub(one.record.handed_ns) > STAMP_PATIENCE_NS
                });
                if is_overdue && let Some(old) = self.pending[slot].take() {
                    self.retire(&old);
                }
            }
        }
        self.clock.refresh(now);
    }

    /// The next datagram, if one has come.
    pub(super) fn receive(&mut self, buffer: &mut [u8]) -> Result<Option<Received>, FaceError> {
        let received = self.socket.sender_mut().receive(buffer);
        Ok(received.map_err(GatewayError::Socket)?)
    }

    /// Notes a datagram that was received at `received_at` and became a message.
    pub(super) fn note_received(
        &mut self,
        received: &Received,
        received_at: Instant,
        published_at: Instant,
    ) {
        self.received.push(&FaceReceivedRecord {
            rx_software_ns: received.stamps.software_ns.unwrap_or(UNAVAILABLE),
            received_ns: received_at.as_ns(),
            published_ns: published_at.as_ns(),
            realtime_offset_ns: self.clock.offset_ns(),
        });
    }

    /// Real-time minus monotonic clock.
    pub(super) const fn realtime_offset_ns(&self) -> i64 {
        self.clock.offset_ns()
    }

    /// True while stamps are still to come.
    pub(super) const fn awaits_stamps(&self) -> bool {
        self.pending_count > 0
    }

    /// What to wait on.
    pub(super) fn poll_fd(&self) -> Option<BorrowedFd<'_>> {
        self.socket.sender().poll_fd()
    }

    /// What the socket counted.
    pub(super) fn counters(&self) -> SenderCounters {
        self.socket.sender().counters()
    }

    /// How often the real-time clock was stepped.
    pub(super) const fn clock_step_count(&self) -> u64 {
        self.clock.step_count()
    }
}

fn slot_of(token: TxToken) -> usize {
    token.0 as usize % PENDING
}
