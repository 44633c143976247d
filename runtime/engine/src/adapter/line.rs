//! The socket of one arm with the transmit stamps that are still to come from it. It knows no
//! message: robot and sensor adapter do.

use std::net::SocketAddr;

use hil_core::record::UNAVAILABLE;
use hil_core::time::Instant;
use hil_net::TransmitStage;
use hil_transport::udp::UdpSender;
use hil_transport::{DatagramSender, Received};

use crate::gateway::kernel_clock::KernelClock;
use crate::gateway::stamp_tracker::{STAMP_PATIENCE_NS, StampTracker};
use crate::process::worker::WorkerError;
use hil_rundir::adapter_record::{AdapterReceivedRecord, AdapterSentRecord};
use hil_rundir::record::RecordSink;

/// The socket, its records and the clock of its stamps.
#[derive(Debug)]
pub(super) struct Line {
    /// Connected to the foreign program, which the robot speaks to first; or it hears anyone and answers the robot.
    pub(super) socket: UdpSender,
    pending: StampTracker<AdapterSentRecord>,
    sent: RecordSink,
    received: RecordSink,
    pub(super) clock: KernelClock,
    has_stamps: bool,
}

impl Line {
    pub(super) fn new(
        socket: UdpSender,
        sent: RecordSink,
        received: RecordSink,
        has_stamps: bool,
    ) -> Result<Self, WorkerError> {
        Ok(Self {
            socket,
            pending: StampTracker::new(),
            sent,
            received,
            clock: KernelClock::read()?,
            has_stamps,
        })
    }

    /// Answers `peer` from now on.
    pub(super) fn answer_to(&mut self, peer: SocketAddr) {
        self.socket.answer_to(peer);
    }

    /// Sends `datagram`, then takes the stamps that have come. A refusal is a state of the network
    /// or of the peer; the socket counts it.
    pub(super) fn send(&mut self, datagram: &[u8], record: AdapterSentRecord) -> bool {
        let record = AdapterSentRecord {
            tx_software_ns: UNAVAILABLE,
            realtime_offset_ns: self.clock.offset_ns(),
            ..record
        };
        let sent = self.socket.send(datagram);
        match sent {
            Ok(token) if self.has_stamps => {
                let handed = Instant::from_ns(record.handed_ns);
                if let Some(displaced) = self.pending.expect(token, handed, record) {
                    self.sent.push(&displaced);
                }
                while self.awaits_stamps() && self.take_stamp() {}
            }
            Ok(_) => self.sent.push(&record),
            Err(_counted) => self.sent.push(&AdapterSentRecord {
                flags: record.flags | AdapterSentRecord::REFUSED_BY_KERNEL,
                ..record
            }),
        }
        sent.is_ok()
    }

    /// Takes one stamp without blocking; false when there is none. Reports of the network come the
    /// same way and are counted by the socket.
    fn take_stamp(&mut self) -> bool {
        let Some(stamp) = self.socket.next_stamp() else {
            return false;
        };
        if let (Some(software_ns), TransmitStage::Sent) = (stamp.stamps.software_ns, stamp.stage)
            && let Some(record) = self.pending.take(stamp.token)
        {
            self.sent.push(&AdapterSentRecord {
                tx_software_ns: software_ns,
                ..record
            });
        }
        true
    }

    /// Takes every stamp and report there is, gives up those that are overdue at `now`, and reads
    /// the clocks again when it is time to.
    pub(super) fn look_after(&mut self, now: Instant) {
        while self.take_stamp() {}
        while let Some(overdue) = self.pending.take_overdue(now, STAMP_PATIENCE_NS) {
            self.sent.push(&overdue);
        }
        self.clock.refresh(now);
    }

    /// The next datagram, if one has come.
    pub(super) fn receive(&mut self, buffer: &mut [u8]) -> Result<Option<Received>, WorkerError> {
        let received = self.socket.receive(buffer);
        received.map_err(WorkerError::Socket)
    }

    /// Notes a datagram that was received at `received_at` and became a message.
    pub(super) fn note_received(
        &mut self,
        received: &Received,
        received_at: Instant,
        published_at: Instant,
    ) {
        self.received.push(&AdapterReceivedRecord {
            rx_software_ns: received.stamps.software_ns.unwrap_or(UNAVAILABLE),
            received_ns: received_at.as_ns(),
            published_ns: published_at.as_ns(),
            realtime_offset_ns: self.clock.offset_ns(),
        });
    }

    /// True while stamps are still to come.
    pub(super) const fn awaits_stamps(&self) -> bool {
        !self.pending.is_empty()
    }
}
