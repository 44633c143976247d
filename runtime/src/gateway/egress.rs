//! The sending thread of a gateway: from one local channel to the network. It owns the clock, the
//! port and the socket; what to send and what replies mean is the bridge's business.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use hil_gateways::protocol::egress::{RoundTrip, TransmitFailure};
use hil_gateways::protocol::wire::Kind;
use hil_gateways::protocol::{EgressBridge, EgressEvent, LocalRefusal, PeerState};
use hil_gateways::transport::{DatagramSender, SendRefusal, TransmitStage, TransmitStamp, TxToken};
use hil_models::measure::record::{EgressRecord, RoundTripRecord, UNAVAILABLE};
use hil_models::message::Envelope;
use hil_models::time::Instant;

use super::kernel_clock::KernelClock;
use super::{GatewayError, poll_descriptors};
use crate::channel::{RawInput, Waiter};
use crate::clock::MonotonicClock;
use crate::record::RecordSink;
use crate::wait::{Pause, WaitStrategy};

/// Datagrams whose transmit stamps may be outstanding; a power of two.
const PENDING: usize = 256;
/// A stamp that has not come by then does not come: drivers deliver within a millisecond or so,
/// and a record must not wait for ever.
const STAMP_PATIENCE_NS: i64 = 20_000_000;
/// The same for a card's stamp, which the driver fetches from a worker of normal priority.
const CARD_STAMP_PATIENCE_NS: i64 = 200_000_000;

/// How long the end of a run may wait for the kernel to take what is left.
const HAND_OVER_MAX: Duration = Duration::from_millis(200);

/// Longer than any reply; what is longer is no reply and is cut.
const REPLY_BYTES_MAX: usize = 1024;

/// Everything the thread works with.
#[derive(Debug)]
pub(crate) struct Egress {
    pub(crate) input: RawInput,
    pub(crate) waiter: Option<Waiter>,
    pub(crate) bridge: EgressBridge,
    pub(crate) line: Line,
    pub(crate) wait: WaitStrategy,
    pub(crate) sent: Arc<AtomicU64>,
    pub(crate) stop: Arc<AtomicBool>,
    pub(crate) attention: Attention,
    /// Set while the peer takes messages.
    pub(crate) is_established: Arc<AtomicBool>,
}

/// What waiting found: to look after the socket costs system calls that a waiting message would
/// have to wait for, and so does taking back announcements.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Attention {
    has_news: bool,
    is_announced: bool,
    is_overdue: bool,
    looked: Instant,
}

/// A thread that finds a message in every turn looks after its socket this often.
const LOOK_PERIOD_BUSY_NS: i64 = 5_000_000;
/// A spinning thread looks after its socket this often.
const LOOK_PERIOD_NS: i64 = 500_000;

/// The socket, the stamps still to come from it, and the records they complete.
#[derive(Debug)]
pub(crate) struct Line {
    sender: Box<dyn DatagramSender>,
    pending: Box<[Option<Pending>]>,
    pending_count: usize,
    records: RecordSink,
    round_trips: RecordSink,
    session: u32,
    clock: KernelClock,
    wants_hardware: bool,
    has_stamps: bool,
    message: Option<EgressRecord>,
    newest_handed: Instant,
    report_count: u64,
}

#[derive(Debug, Clone, Copy)]
struct Pending {
    token: TxToken,
    kind: Kind,
    sequence: u64,
    handed: Instant,
    record: Option<EgressRecord>,
}

/// Which stamps the socket was armed for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Armed {
    pub(crate) software: bool,
    pub(crate) hardware: bool,
}

impl Line {
    pub(crate) fn new(
        sender: Box<dyn DatagramSender>,
        (records, round_trips): (RecordSink, RecordSink),
        session: u32,
        armed: Armed,
    ) -> Result<Self, GatewayError> {
        Ok(Self {
            sender,
            pending: vec![None; PENDING].into_boxed_slice(),
            pending_count: 0,
            records,
            round_trips,
            session,
            clock: KernelClock::read()?,
            wants_hardware: armed.hardware,
            has_stamps: armed.software,
            message: None,
            newest_handed: Instant::ZERO,
            report_count: 0,
        })
    }

    pub(crate) fn sender(&self) -> &dyn DatagramSender {
        self.sender.as_ref()
    }

    /// Sends everything the bridge has, then takes the stamps that came of it.
    fn transmit(&mut self, bridge: &mut EgressBridge) {
        loop {
            let handed = MonotonicClock::now();
            let Some(transmit) = bridge.poll_transmit(handed) else {
                break;
            };
            self.newest_handed = handed;
            let (kind, sequence) = (transmit.kind, transmit.sequence);
            let is_last = transmit.is_last_fragment;
            if kind == Kind::Data
                && let Some(record) = &mut self.message
            {
                record.fragment_count += 1;
                if record.handed_ns == UNAVAILABLE {
                    record.handed_ns = handed.as_ns();
                }
            }
            let sent = self.sender.send(transmit.datagram);
            let is_message_end = kind == Kind::Data && (is_last || sent.is_err());
            let record = if is_message_end {
                self.message.take()
            } else {
                None
            };
            match sent {
                Ok(token) => self.expect_stamp(token, (kind, sequence), handed, record),
                Err(refusal) => {
                    let is_established = bridge.peer_state() == PeerState::Established;
                    bridge.on_transmit_failed(handed, failure(refusal, is_established));
                    if let Some(record) = record {
                        self.finish(EgressRecord {
                            flags: EgressRecord::REFUSED_BY_KERNEL,
                            ..record
                        });
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

    fn expect_stamp(
        &mut self,
        token: TxToken,
        (kind, sequence): (Kind, u64),
        handed: Instant,
        record: Option<EgressRecord>,
    ) {
        if !self.has_stamps {
            if let Some(record) = record {
                self.finish(record);
            }
            return;
        }
        let slot = slot_of(token);
        if let Some(old) = self.pending[slot].take() {
            self.retire(old);
        }
        self.pending[slot] = Some(Pending {
            token,
            kind,
            sequence,
            handed,
            record,
        });
        self.pending_count += 1;
    }

    /// Takes the stamps that are still to come, as far as they have come; asks no further, as
    /// each look is a system call.
    fn take_due_stamps(&mut self, bridge: &mut EgressBridge) {
        while self.pending_count > 0 && self.take_stamp(bridge) {}
    }

    /// Takes every stamp there is, and with them the reports of the network.
    fn take_stamps(&mut self, bridge: &mut EgressBridge) {
        while self.take_stamp(bridge) {}
    }

    /// Takes one stamp without blocking, false when there is none; a record is complete when all
    /// it waits for has come.
    fn take_stamp(&mut self, bridge: &mut EgressBridge) -> bool {
        let Some(TransmitStamp {
            token,
            stage,
            stamps,
        }) = self.sender.next_stamp()
        else {
            return false;
        };
        let slot = slot_of(token);
        let offset = self.clock.offset_ns();
        let pending = self.pending[slot].as_mut();
        let Some(pending) =
            pending.filter(|one| stage == TransmitStage::Sent && one.token == token)
        else {
            return true;
        };
        // Of a message in pieces only the last piece's stamp is the message's.
        let is_whole = pending.kind != Kind::Data || pending.record.is_some();
        if let Some(software_ns) = stamps.software_ns.filter(|_| is_whole) {
            let first_handed = pending
                .record
                .map_or(pending.handed.as_ns(), |record| record.handed_ns);
            bridge.on_transmit_stamp(
                pending.kind,
                pending.sequence,
                software_ns - offset - first_handed,
            );
        }
        let mut is_complete = !self.wants_hardware;
        if let Some(record) = &mut pending.record {
            record.tx_software_ns = stamps.software_ns.unwrap_or(record.tx_software_ns);
            record.tx_hardware_ns = stamps.hardware_ns.unwrap_or(record.tx_hardware_ns);
            is_complete = record.tx_software_ns != UNAVAILABLE
                && (record.tx_hardware_ns != UNAVAILABLE || !self.wants_hardware);
        }
        if is_complete && let Some(pending) = self.pending[slot].take() {
            self.retire(pending);
        }
        true
    }

    /// A host without a listener answers with a report instead of a reply; reading stamps swallows
    /// it before any send call could fail with it.
    fn notice_reports(&mut self, bridge: &mut EgressBridge, now: Instant) {
        let counters = self.sender.counters();
        if counters.network_report_count == self.report_count {
            return;
        }
        self.report_count = counters.network_report_count;
        let newest = counters.newest_report.map(|report| failure(report, true));
        if newest == Some(TransmitFailure::PeerUnreachable) {
            bridge.on_peer_unreachable(now);
        }
    }

    fn retire(&mut self, pending: Pending) {
        self.pending_count -= 1;
        if let Some(record) = pending.record {
            self.finish(record);
        }
    }

    fn finish(&mut self, record: EgressRecord) {
        self.records.push(&record);
    }

    /// Gives up on stamps that are overdue at `now`.
    fn expire(&mut self, now: Instant) {
        if self.pending_count == 0 {
            return;
        }
        let patience_ns = if self.wants_hardware {
            CARD_STAMP_PATIENCE_NS
        } else {
            STAMP_PATIENCE_NS
        };
        for slot in 0..PENDING {
            let is_overdue =
                self.pending[slot].is_some_and(|one| now.ns_since(one.handed) > patience_ns);
            if is_overdue && let Some(pending) = self.pending[slot].take() {
                self.retire(pending);
            }
        }
    }

    /// Gives the kernel what the transport still holds, for a bounded time.
    fn hand_over(&mut self) -> Result<(), GatewayError> {
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

    /// How often the real-time clock was stepped.
    pub(crate) fn clock_step_count(&self) -> u64 {
        self.clock.step_count()
    }
}

fn slot_of(token: TxToken) -> usize {
    token.0 as usize % PENDING
}

/// What a refusal means for the conversation. That there is no connection yet says nothing of a
/// peer that has not been heard of; that there is none any more says that it is gone.
fn failure(refusal: SendRefusal, is_established: bool) -> TransmitFailure {
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

impl Egress {
    /// Carries the channel until told to stop, then says goodbye to the peer.
    ///
    /// # Errors
    /// When the channel or the socket itself breaks, or the peer refuses the channel for good.
    pub(crate) fn run(&mut self) -> Result<(), GatewayError> {
        while !self.stop.load(Ordering::Acquire) {
            if !self.step()? {
                self.rest()?;
            }
        }
        self.bridge.bye();
        self.line.transmit(&mut self.bridge);
        self.line.expire(Instant::from_ns(i64::MAX));
        self.line.hand_over()
    }

    /// Sends one waiting message, or else looks after stamps, replies and appointments; false when
    /// no message waited and none was announced.
    pub(crate) fn step(&mut self) -> Result<bool, GatewayError> {
        let moved = self.forward()?;
        if moved && !self.attention.is_overdue {
            // A producer faster than the socket must not keep replies and orders waiting for ever.
            let now = self.line.newest_handed;
            self.attention.is_overdue = now.ns_since(self.attention.looked) > LOOK_PERIOD_BUSY_NS;
            return Ok(true);
        }
        let now = MonotonicClock::now();
        let since_look = now.ns_since(self.attention.looked);
        if self.attention.has_news || self.attention.is_overdue || since_look > LOOK_PERIOD_NS {
            self.attention.is_overdue = false;
            self.attention.has_news = false;
            self.attention.looked = now;
            self.line.sender.attend(now);
            self.line.take_stamps(&mut self.bridge);
            self.line.notice_reports(&mut self.bridge, now);
            self.hear()?;
            self.line.expire(now);
            self.line.clock.refresh(now);
            let is_established = self.bridge.peer_state() == PeerState::Established;
            self.is_established.store(is_established, Ordering::Release);
        }
        if self.bridge.next_wakeup().is_some_and(|due| due <= now) {
            self.line.transmit(&mut self.bridge);
        }
        // Announcements are taken back only now, for the message waited for its datagram, not
        // for this. A message published before they were is seen by the look that follows.
        let was_announced = core::mem::take(&mut self.attention.is_announced);
        if was_announced && let Some(waiter) = &mut self.waiter {
            waiter.drain()?;
        }
        Ok(moved || was_announced)
    }

    /// Sends the oldest waiting message; false when none waited.
    fn forward(&mut self) -> Result<bool, GatewayError> {
        let Self {
            input,
            bridge,
            line,
            wait,
            sent,
            ..
        } = self;
        let mut take = |envelope: &Envelope, payload: &[u8]| {
            let taken = MonotonicClock::now();
            wait.on_arrival(taken);
            let record = EgressRecord {
                sequence: envelope.sequence,
                published_ns: envelope.published_ns,
                taken_ns: taken.as_ns(),
                handed_ns: UNAVAILABLE,
                tx_software_ns: UNAVAILABLE,
                tx_hardware_ns: UNAVAILABLE,
                realtime_offset_ns: line.clock.offset_ns(),
                epoch: envelope.epoch,
                session: line.session,
                flags: 0,
                fragment_count: 0,
            };
            match bridge.on_local(taken, envelope, payload) {
                Ok(()) => {
                    line.message = Some(record);
                    line.transmit(bridge);
                    sent.store(bridge.counts().sent_count, Ordering::Relaxed);
                }
                // Another gateway's message: not this gateway's to account for.
                Err(LocalRefusal::Forwarded) => {}
                Err(_counted) => line.finish(EgressRecord {
                    flags: EgressRecord::REFUSED_BY_KERNEL,
                    ..record
                }),
            }
        };
        Ok(input.receive(&mut take)?)
    }

    /// Takes the peer's replies.
    fn hear(&mut self) -> Result<(), GatewayError> {
        let mut buffer = [0; REPLY_BYTES_MAX];
        while let Some(received) = self
            .line
            .sender
            .receive(&mut buffer)
            .map_err(GatewayError::Socket)?
        {
            let now = MonotonicClock::now();
            let arrival = self.line.clock.arrival(&received, now);
            let bytes = &buffer[..received.length_bytes];
            match self.bridge.on_datagram(now, arrival, bytes) {
                Ok(EgressEvent::RoundTrip {
                    round_trip,
                    earlier,
                    ..
                }) => {
                    if let Some(earlier) = earlier {
                        self.note_round_trip(&earlier);
                    }
                    self.note_round_trip(&round_trip);
                }
                Ok(EgressEvent::Refused(status)) => {
                    if self.bridge.peer_state() == PeerState::Refused(status) {
                        return Err(GatewayError::Refused(status));
                    }
                }
                Ok(EgressEvent::Accepted { .. } | EgressEvent::GreetAgain) | Err(_) => {}
            }
        }
        Ok(())
    }

    fn note_round_trip(&mut self, round_trip: &RoundTrip) {
        let sources = [
            round_trip.t1_source,
            round_trip.t2_source,
            round_trip.t3_source,
            round_trip.t4_source,
        ];
        self.line.round_trips.push(&RoundTripRecord {
            sequence: round_trip.sequence,
            t1_ns: round_trip.t1_ns,
            t2_ns: round_trip.t2_ns,
            t3_ns: round_trip.t3_ns,
            t4_ns: round_trip.t4_ns,
            session: self.line.session,
            sources: sources.map(|source| source as u8),
        });
    }

    /// Waits for a message, a stamp, a reply or an appointment.
    pub(crate) fn rest(&mut self) -> Result<(), GatewayError> {
        let now = MonotonicClock::now();
        let dues = [self.bridge.next_wakeup(), self.line.sender.next_due()];
        let mut due = dues.into_iter().flatten().min();
        if self.line.pending_count > 0 {
            // A stamp makes the socket readable, but an overdue one must be given up in time.
            let patience = Instant::from_ns(now.as_ns() + STAMP_PATIENCE_NS);
            due = Some(due.map_or(patience, |due| due.min(patience)));
        }
        match self.wait.pause(now, due) {
            Pause::Spin => core::hint::spin_loop(),
            Pause::Sleep(until) => {
                let listeners = self.waiter.iter().flat_map(Waiter::descriptors);
                let socket = self.line.sender.poll_fd();
                let [is_announced, has_socket_news] =
                    poll_descriptors(listeners.chain(socket), until)?;
                // Without a waiter the socket comes first.
                let (is_announced, has_socket_news) = match self.waiter {
                    Some(_) => (is_announced, has_socket_news),
                    None => (false, is_announced),
                };
                self.attention.has_news |= has_socket_news;
                self.attention.is_announced |= is_announced;
            }
        }
        Ok(())
    }
}
