//! The socket of a sending gateway thread, and the records that wait for what the kernel and the
//! radio have yet to say of datagrams that left. It decides nothing about what to send.

use std::time::Duration;

use hil_core::message::Envelope;
use hil_core::record::{EgressRecord, UNAVAILABLE};
use hil_core::time::Instant;
use hil_net::radio::RadioReport;
use hil_net::{TransmitStage, TransmitStamp, TxToken};
use hil_protocol::egress::TransmitFailure;
use hil_protocol::wire::Kind;
use hil_protocol::{EgressBridge, LongPiece, PeerState, TransmitKey};
use hil_transport::{DatagramSender, SendRefusal};

use super::kernel_clock::KernelClock;
use super::stamp_plan::StampPlan;
use super::stamp_tracker::{STAMP_PATIENCE_NS, StampTracker};
use super::{WorkerError, poll_descriptors};
use hil_platform::clock::MonotonicClock;
use hil_rundir::record::{RecordSink, SharedSink};

/// A radio reports after its last retry, with other stations and its queue before that; the driver
/// of a card that stamps fetches the stamp from a worker of normal priority.
const LATE_PATIENCE_NS: i64 = 200_000_000;
/// How long the end of a run may wait for the kernel to take what is left.
const HAND_OVER_MAX: Duration = Duration::from_millis(200);

/// The socket, the stamps still to come from it, and the records they complete.
#[derive(Debug)]
pub(crate) struct Line {
    pub(super) sender: Box<dyn DatagramSender>,
    pending: StampTracker<Pending>,
    records: SharedSink,
    pub(super) round_trips: RecordSink,
    pub(super) session: u32,
    pub(super) clock: KernelClock,
    awaited: StampPlan,
    pub(super) message: Option<EgressRecord>,
    pub(super) newest_handed: Instant,
    report_count: u64,
    /// There is no way to the peer, as the kernel or the network said last.
    is_unreachable: bool,
}

#[derive(Debug, Clone, Copy)]
struct Pending {
    key: TransmitKey,
    handed: Instant,
    /// Of a message's last piece.
    record: Option<EgressRecord>,
    is_stamped: bool,
    is_nic_stamped: bool,
    is_reported: bool,
}

impl Pending {
    /// Everything that `awaited` says will come has come.
    const fn is_complete(&self, awaited: StampPlan) -> bool {
        (self.is_stamped || !awaited.awaits_software())
            && (self.is_nic_stamped || !awaited.awaits_hardware())
            && (self.is_reported || !awaited.asks_radio)
    }
}

impl Line {
    pub(crate) fn new(
        sender: Box<dyn DatagramSender>,
        records: SharedSink,
        round_trips: RecordSink,
        session: u32,
        awaited: StampPlan,
    ) -> Result<Self, WorkerError> {
        Ok(Self {
            sender,
            pending: StampTracker::new(),
            records,
            round_trips,
            session,
            clock: KernelClock::read()?,
            awaited,
            message: None,
            newest_handed: Instant::ZERO,
            report_count: 0,
            is_unreachable: false,
        })
    }

    pub(crate) fn sender(&self) -> &dyn DatagramSender {
        self.sender.as_ref()
    }

    /// Sends everything the bridge has, then takes the stamps that came of it.
    pub(super) fn transmit(&mut self, bridge: &mut EgressBridge) {
        loop {
            let handed = MonotonicClock::now();
            let Some(transmit) = bridge.poll_transmit(handed) else {
                break;
            };
            self.newest_handed = handed;
            let key = transmit.key;
            let is_last = transmit.is_last_fragment;
            if key.kind == Kind::Data
                && let Some(record) = &mut self.message
            {
                record.fragment_count += 1;
                if record.handed_ns == UNAVAILABLE {
                    record.handed_ns = handed.as_ns();
                }
            }
            let sent = self.sender.send(transmit.datagram);
            let is_message_end = key.kind == Kind::Data && (is_last || sent.is_err());
            let record = if is_message_end {
                self.message.take()
            } else {
                None
            };
            match sent {
                Ok(token) => {
                    self.is_unreachable &= key.kind != Kind::Data;
                    let pending = Pending {
                        key,
                        handed,
                        record,
                        is_stamped: false,
                        is_nic_stamped: false,
                        is_reported: false,
                    };
                    self.expect_stamp(token, pending);
                }
                Err(refusal) => {
                    self.is_unreachable = refusal.is_unreachable();
                    let is_established = bridge.peer_state() == PeerState::Established;
                    bridge.on_transmit_failed(handed, failure(refusal, is_established));
                    if let Some((channel, record)) = key.channel.zip(record) {
                        self.finish_refused(channel, record);
                    }
                }
            }
            // Asked before the clock is read again: after most messages nothing is due.
            if bridge.next_wakeup().is_none_or(|due| due > handed) {
                break;
            }
        }
        self.take_due_stamps(bridge);
    }

    fn expect_stamp(&mut self, token: TxToken, pending: Pending) {
        if !self.awaited.is_anything_awaited() {
            self.retire(Some(pending));
            return;
        }
        let displaced = self.pending.expect(token, pending.handed, pending);
        self.retire(displaced);
    }

    /// True while stamps or reports are still to come.
    pub(super) const fn awaits_stamps(&self) -> bool {
        !self.pending.is_empty()
    }

    /// Takes the stamps that are still to come, as far as they have come; asks no further, as
    /// each look is a system call.
    pub(super) fn take_due_stamps(&mut self, bridge: &mut EgressBridge) {
        while self.awaits_stamps() && self.take_stamp(bridge) {}
    }

    /// Takes every stamp there is, and with them the reports of the network.
    pub(super) fn take_stamps(&mut self, bridge: &mut EgressBridge) {
        while self.take_stamp(bridge) {}
    }

    /// Takes one stamp without blocking, and the radio's reports found on the way; false when
    /// there is no stamp. A record is complete when all it waits for has come.
    fn take_stamp(&mut self, bridge: &mut EgressBridge) -> bool {
        let stamp = self.sender.next_stamp();
        while let Some(report) = self.sender.next_radio_report() {
            self.note_report(report);
        }
        let Some(stamp) = stamp else {
            return false;
        };
        self.note_stamp(bridge, stamp);
        true
    }

    fn note_stamp(&mut self, bridge: &mut EgressBridge, stamp: TransmitStamp) {
        let offset = self.clock.offset_ns();
        let is_departure = stamp.stage == TransmitStage::Sent;
        let counts = is_departure || self.awaited.is_before_queue_final();
        let Some(pending) = self.pending.find(stamp.token) else {
            return;
        };
        // Of a message in pieces only the last piece's stamp is the message's.
        let is_whole = pending.key.kind != Kind::Data || pending.record.is_some();
        if let Some(software_ns) = stamp.stamps.software_ns {
            if is_whole && counts {
                let first_handed = pending
                    .record
                    .map_or(pending.handed.as_ns(), |record| record.handed_ns);
                bridge.on_transmit_stamp(pending.key, software_ns - offset - first_handed);
            }
            pending.is_stamped |= counts;
            if let Some(record) = &mut pending.record {
                note_software(record, software_ns, is_departure);
            }
        }
        if let Some(hardware_ns) = stamp.stamps.hardware_ns {
            pending.is_nic_stamped = true;
            if let Some(record) = &mut pending.record {
                record.tx_hardware_ns = hardware_ns;
            }
        }
        self.retire_if_complete(stamp.token);
    }

    fn note_report(&mut self, report: RadioReport) {
        let Some(pending) = self.pending.find(report.token) else {
            return;
        };
        pending.is_reported = true;
        if let Some(record) = &mut pending.record {
            record.flags |= if report.is_acknowledged {
                EgressRecord::RADIO_ACKNOWLEDGED
            } else {
                EgressRecord::RADIO_UNACKNOWLEDGED
            };
        }
        self.retire_if_complete(report.token);
    }

    fn retire_if_complete(&mut self, token: TxToken) {
        let pending = self.pending.find(token);
        if pending.is_some_and(|one| one.is_complete(self.awaited)) {
            let pending = self.pending.take(token);
            self.retire(pending);
        }
    }

    /// A host without a listener answers with a report instead of a reply; reading stamps swallows
    /// it before any send call could fail with it.
    pub(super) fn notice_reports(&mut self, bridge: &mut EgressBridge, now: Instant) {
        let counters = self.sender.counters();
        if counters.network_report_count == self.report_count {
            return;
        }
        self.report_count = counters.network_report_count;
        let newest = counters.newest_report.map(|report| failure(report, true));
        if newest == Some(TransmitFailure::PeerUnreachable) {
            let newest = counters.newest_report;
            self.is_unreachable = newest.is_some_and(SendRefusal::is_unreachable);
            bridge.on_peer_unreachable(now);
        }
    }

    fn retire(&mut self, pending: Option<Pending>) {
        if let Some((channel, record)) = pending.and_then(|one| one.key.channel.zip(one.record)) {
            self.finish(channel, record);
        }
    }

    /// Of a message taken at `taken`, nothing of which has left yet.
    pub(super) fn record_of(&self, taken: Instant, envelope: &Envelope) -> EgressRecord {
        EgressRecord {
            sequence: envelope.sequence,
            published_ns: envelope.published_ns,
            taken_ns: taken.as_ns(),
            handed_ns: UNAVAILABLE,
            tx_software_ns: UNAVAILABLE,
            tx_hardware_ns: UNAVAILABLE,
            realtime_offset_ns: self.clock.offset_ns(),
            epoch: envelope.epoch,
            session: self.session,
            flags: 0,
            fragment_count: 0,
        }
    }

    pub(super) fn finish(&mut self, channel: usize, record: EgressRecord) {
        self.records.push(channel, &record);
    }

    /// Of a message that did not leave, or not as a whole.
    pub(super) fn finish_refused(&mut self, channel: usize, record: EgressRecord) {
        let mut flags = EgressRecord::REFUSED_BY_KERNEL;
        if self.is_unreachable {
            flags |= EgressRecord::UNREACHABLE;
        }
        self.finish(channel, EgressRecord { flags, ..record });
    }

    /// Hands a piece of a long message over; `record` is the message's with its last piece.
    pub(super) fn send_piece(
        &mut self,
        piece: &LongPiece<'_>,
        handed: Instant,
        record: Option<EgressRecord>,
    ) -> Result<(), SendRefusal> {
        self.newest_handed = handed;
        let sent = self.sender.send_parts(piece.head, piece.tail);
        self.is_unreachable = sent.is_err_and(SendRefusal::is_unreachable);
        let token = sent?;
        if !piece.is_last {
            // The message's stamp is that of its last piece.
            return Ok(());
        }
        let pending = Pending {
            key: TransmitKey {
                kind: Kind::Data,
                channel: Some(piece.channel),
                epoch: record.map(|record| record.epoch),
                sequence: piece.sequence,
            },
            handed,
            record,
            is_stamped: false,
            is_nic_stamped: false,
            is_reported: false,
        };
        self.expect_stamp(token, pending);
        Ok(())
    }

    /// How long a datagram may wait for what is still to come of it.
    const fn patience_ns(&self) -> i64 {
        if self.awaited.asks_radio || self.awaited.awaits_hardware() {
            LATE_PATIENCE_NS
        } else {
            STAMP_PATIENCE_NS
        }
    }

    /// Gives up on stamps and reports that are overdue at `now`.
    pub(super) fn expire(&mut self, now: Instant) {
        let patience_ns = self.patience_ns();
        while let Some(overdue) = self.pending.take_overdue(now, patience_ns) {
            self.retire(Some(overdue));
        }
    }

    /// Waits a bounded time for what is still to come of the last datagrams.
    pub(super) fn settle(&mut self, bridge: &mut EgressBridge) -> Result<(), WorkerError> {
        let end = MonotonicClock::now() + Duration::from_nanos(self.patience_ns().unsigned_abs());
        loop {
            self.take_stamps(bridge);
            if !self.awaits_stamps() || MonotonicClock::now() >= end {
                self.expire(Instant::from_ns(i64::MAX));
                return Ok(());
            }
            poll_descriptors(self.sender.poll_fd().into_iter(), end)?;
            // What has come without being awaited, such as a last reply, stays readable.
            std::thread::yield_now();
        }
    }

    /// Gives the kernel what the transport still holds, for a bounded time.
    pub(super) fn hand_over(&mut self) -> Result<(), WorkerError> {
        let end = MonotonicClock::now() + HAND_OVER_MAX;
        loop {
            let now = MonotonicClock::now();
            self.sender.attend(now);
            if !self.sender.has_unsent() || now >= end {
                return Ok(());
            }
            poll_descriptors(self.sender.poll_fd().into_iter(), end)?;
        }
    }
}

/// A departure takes the place of a stamp before the queue, in whatever order they come.
fn note_software(record: &mut EgressRecord, software_ns: i64, is_departure: bool) {
    if is_departure {
        record.tx_software_ns = software_ns;
        record.flags &= !EgressRecord::STAMPED_BEFORE_QUEUE;
    } else if record.tx_software_ns == UNAVAILABLE {
        record.tx_software_ns = software_ns;
        record.flags |= EgressRecord::STAMPED_BEFORE_QUEUE;
    }
}

/// What a refusal means for the conversation. That there is no connection yet says nothing of a
/// peer that has not been heard of; that there is none any more says that it is gone.
pub(super) fn failure(refusal: SendRefusal, is_established: bool) -> TransmitFailure {
    match refusal {
        SendRefusal::PeerRefused | SendRefusal::Unreachable { .. } => {
            TransmitFailure::PeerUnreachable
        }
        SendRefusal::NotConnected if is_established => TransmitFailure::PeerUnreachable,
        SendRefusal::NotConnected
        | SendRefusal::QueueFull { .. }
        | SendRefusal::TooLong { .. }
        | SendRefusal::Other { .. } => TransmitFailure::Local,
    }
}

#[cfg(test)]
mod tests {
    use hil_net::timestamping::TimestampMode;

    use super::*;

    #[test]
    fn a_record_is_complete_when_all_that_the_plan_awaits_has_come() {
        let [off, software, hardware] = [
            TimestampMode::Off,
            TimestampMode::Software,
            TimestampMode::Hardware,
        ]
        .map(StampPlan::asked);
        for (plan, wanted) in [
            (off, [false, false, false]),
            (off.on_radio(true), [false, false, true]),
            (software, [true, false, false]),
            (software.on_radio(true), [true, false, true]),
            (hardware, [true, true, false]),
            (hardware.on_radio(true), [true, true, true]),
        ] {
            for come in 0..8_u8 {
                let [is_stamped, is_nic_stamped, is_reported] =
                    [1, 2, 4].map(|bit| come & bit != 0);
                let pending = Pending {
                    key: TransmitKey {
                        kind: Kind::Data,
                        channel: Some(0),
                        epoch: Some(1),
                        sequence: 0,
                    },
                    handed: Instant::ZERO,
                    record: None,
                    is_stamped,
                    is_nic_stamped,
                    is_reported,
                };
                let has = [is_stamped, is_nic_stamped, is_reported];
                let lacks_none = wanted.iter().zip(has).all(|(wanted, has)| has || !wanted);
                assert_eq!(
                    pending.is_complete(plan),
                    lacks_none,
                    "{plan:?} {pending:?}"
                );
            }
        }
    }

    #[test]
    fn a_departure_replaces_a_stamp_before_the_queue_in_either_order() {
        let empty = EgressRecord {
            sequence: 0,
            published_ns: 0,
            taken_ns: 0,
            handed_ns: 0,
            tx_software_ns: UNAVAILABLE,
            tx_hardware_ns: UNAVAILABLE,
            realtime_offset_ns: 0,
            epoch: 0,
            session: 0,
            flags: EgressRecord::RADIO_ACKNOWLEDGED,
            fragment_count: 1,
        };
        let radio = EgressRecord::RADIO_ACKNOWLEDGED;
        for order in [[false, true], [true, false]] {
            let mut record = empty;
            for is_departure in order {
                note_software(&mut record, if is_departure { 9 } else { 4 }, is_departure);
            }
            assert_eq!((record.tx_software_ns, record.flags), (9, radio));
        }
        let mut record = empty;
        note_software(&mut record, 4, false);
        let flags = radio | EgressRecord::STAMPED_BEFORE_QUEUE;
        assert_eq!((record.tx_software_ns, record.flags), (4, flags));
    }
}
