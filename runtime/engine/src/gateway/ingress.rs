//! The receiving thread of a gateway: from the network to the local channels of one flow. It owns the clock,
//! the socket and the ports; what a datagram means is the bridge's business.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use hil_core::record::{IngressRecord, NoRoomRecord, UNAVAILABLE};
use hil_core::time::Instant;
use hil_protocol::ingress::MessageInfo;
use hil_protocol::sequence::Order;
use hil_protocol::wire::Kind;
use hil_protocol::{Delivery, Destination, Disposition, Incomplete, IngressBridge, Payload, Piece};
use hil_transport::{DatagramReceiver, Received};

use super::kernel_clock::KernelClock;
use super::refusal_backoff::RefusalBackoff;
use super::{WorkerError, poll_descriptors};
use hil_platform::clock::MonotonicClock;
use hil_platform::wait::{Pause, WaitStrategy, release};
use hil_rundir::record::{RecordSink, SharedSink};
use hil_shm::{ChannelError, RawOutput};

/// Everything the thread works with.
#[derive(Debug)]
pub(crate) struct Ingress {
    pub(crate) receiver: Box<dyn DatagramReceiver>,
    /// The receiver holds datagrams back, so it must be told the time.
    pub(crate) is_emulated: bool,
    pub(crate) bridge: IngressBridge,
    /// Where messages go, by channel; empty on a clock path, which carries none.
    pub(crate) outputs: Box<[Output]>,
    /// Records of messages, by channel.
    pub(crate) records: SharedSink,
    pub(super) no_room: NoRoom,
    pub(super) no_room_records: RecordSink,
    pub(crate) wait: WaitStrategy,
    pub(crate) peer: SocketAddr,
    /// Datagrams from an address that is not the peer's, dropped unread.
    pub(crate) foreign_count: u64,
    pub(super) refusal_backoff: RefusalBackoff,
    pub(crate) clock: KernelClock,
    /// The clock response whose departure the kernel is to stamp.
    pub(crate) response: Option<Response>,
    pub(crate) buffer: Box<[u8]>,
}

/// A clock response that left.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Response {
    sequence: u64,
    handed: Instant,
}

/// A message whose sender's clock went on by this much more or less than this host's since the one that came before
/// it says nothing of where datagrams are missing: without a seal anybody may have written it.
const STRAY_NS: u64 = 60_000_000_000;

/// Between which messages datagrams found no room on this host.
#[derive(Debug)]
pub(super) struct NoRoom {
    recorded_count: u64,
    /// When the newest message was handed over, on the sender's clock.
    newest_ns: i64,
    /// When the last one to come was handed over, and when it came.
    last: Option<(i64, i64)>,
}

impl NoRoom {
    pub(super) const fn new() -> Self {
        Self {
            recorded_count: 0,
            newest_ns: UNAVAILABLE,
            last: None,
        }
    }

    /// What to record when `count` found none before the message that was handed over at `handed_ns`, or before the
    /// end. A message that was overtaken or is a copy does not tell; the next one will.
    fn note(&mut self, count: u64, handed_ns: i64, noticed: Instant) -> Option<NoRoomRecord> {
        let noticed_ns = noticed.as_ns();
        if handed_ns != UNAVAILABLE {
            let last = self.last.replace((handed_ns, noticed_ns));
            let is_stray = last.is_some_and(|(before_ns, came_ns)| {
                let passed_ns = noticed_ns.saturating_sub(came_ns);
                let apart_ns = handed_ns.saturating_sub(before_ns);
                apart_ns.saturating_sub(passed_ns).unsigned_abs() > STRAY_NS
            });
            let behind_ns = self.newest_ns.saturating_sub(handed_ns);
            let is_overtaken = behind_ns >= 0 && behind_ns.unsigned_abs() <= STRAY_NS;
            if is_stray || is_overtaken {
                return None;
            }
            if behind_ns > 0 {
                // The newest was a stray one.
                self.newest_ns = UNAVAILABLE;
            }
        }
        let record = (count > self.recorded_count).then(|| NoRoomRecord {
            after_ns: self.newest_ns,
            before_ns: handed_ns,
            noticed_ns,
            datagram_count: count - self.recorded_count,
        });
        // A link model may hand over later what came earlier.
        self.recorded_count = self.recorded_count.max(count);
        self.newest_ns = self.newest_ns.max(handed_ns);
        record
    }
}

/// One local channel.
#[derive(Debug)]
pub(crate) struct Output {
    pub(crate) port: RawOutput,
    /// Messages delivered.
    pub(crate) received: Arc<AtomicU64>,
}

/// What is known of a datagram before the bridge reads it.
#[derive(Clone, Copy)]
struct Arrival {
    received: Received,
    at: Instant,
    offset_ns: i64,
}

impl Arrival {
    fn record(&self, message: &MessageInfo, forwarded_ns: i64, flags: u32) -> IngressRecord {
        let Received {
            stamps, emulated, ..
        } = self.received;
        IngressRecord {
            rx_hardware_ns: stamps.hardware_ns.unwrap_or(UNAVAILABLE),
            rx_software_ns: stamps.software_ns.unwrap_or(UNAVAILABLE),
            forwarded_ns,
            emulated_ns: emulated.map_or(UNAVAILABLE, |delay| delay.arrived.as_ns()),
            due_ns: emulated.map_or(UNAVAILABLE, |delay| delay.due.as_ns()),
            ..unstamped_record(message, self.at, self.offset_ns, flags)
        }
    }
}

/// The record of a message that was received `at` that time, of which no more is known.
fn unstamped_record(
    message: &MessageInfo,
    at: Instant,
    offset_ns: i64,
    flags: u32,
) -> IngressRecord {
    IngressRecord {
        sequence: message.sequence,
        published_ns: message.published.as_ns(),
        handed_ns: message.handed.as_ns(),
        rx_hardware_ns: UNAVAILABLE,
        rx_software_ns: UNAVAILABLE,
        received_ns: at.as_ns(),
        forwarded_ns: UNAVAILABLE,
        realtime_offset_ns: offset_ns,
        emulated_ns: UNAVAILABLE,
        due_ns: UNAVAILABLE,
        follow_up_sequence: 0,
        follow_up_ns: UNAVAILABLE,
        epoch: message.epoch,
        session: message.session,
        flags,
        fragment_count: u32::from(message.fragment_count),
    }
}

impl Ingress {
    /// Ends the account of what is still under way.
    pub(crate) fn finish(&mut self) {
        self.bridge.finish();
        self.note_incomplete();
        let count = self.receiver.no_room_count();
        let record = self.no_room.note(count, UNAVAILABLE, MonotonicClock::now());
        if let Some(record) = record {
            self.no_room_records.push(&record);
        }
    }

    /// Records the messages of which some pieces did not come.
    fn note_incomplete(&mut self) {
        while let Some(Incomplete { message, heard_at }) = self.bridge.next_incomplete() {
            let (offset_ns, flags) = (self.clock.offset_ns(), IngressRecord::INCOMPLETE);
            let record = unstamped_record(&message, heard_at, offset_ns, flags);
            self.records.push(message.channel, &record);
        }
    }

    /// Delivers one waiting datagram, or else does what is due; false when none waited. Asking
    /// for a second one at once would cost a system call that a message just delivered, or the
    /// thread's other work, would have to wait for.
    pub(crate) fn step(&mut self) -> Result<bool, WorkerError> {
        if let Some(at) = self.take()? {
            if self.bridge.has_reply() {
                self.answer();
            }
            // Under load too, but after the message: a reading of the clocks must not age.
            self.clock.refresh(at);
            return Ok(true);
        }
        let now = MonotonicClock::now();
        self.bridge.on_wakeup(now);
        self.note_incomplete();
        self.take_response_stamp(now);
        self.receiver.attend(now);
        self.clock.refresh(now);
        Ok(false)
    }

    /// Takes one datagram and gives when; `None` when none waits.
    fn take(&mut self) -> Result<Option<Instant>, WorkerError> {
        // Only a link model asks what time it is.
        let now = if self.is_emulated {
            MonotonicClock::now()
        } else {
            Instant::ZERO
        };
        let Some(received) = self
            .receiver
            .receive(now, &mut self.buffer)
            .map_err(WorkerError::Socket)?
        else {
            return Ok(None);
        };
        let at = MonotonicClock::now();
        self.wait.on_arrival(at);
        if received.source != self.peer {
            self.foreign_count += 1;
            return Ok(Some(at));
        }
        let arrival = Arrival {
            received,
            at,
            offset_ns: self.clock.offset_ns(),
        };
        let stamps = self.clock.arrival(&received, at);
        let Self {
            bridge,
            outputs,
            records,
            no_room,
            no_room_records,
            buffer,
            ..
        } = self;
        let bytes = &buffer[..received.length_bytes];
        let mut destination = LocalChannels {
            outputs,
            records,
            arrival: &arrival,
            failed: None,
        };
        // A refused datagram is a counter of the bridge.
        let taken = bridge.on_datagram(at, stamps, bytes, &mut destination);
        let failed = destination.failed;
        if let Ok(disposition) = taken {
            if let Some(message) = disposition.message()
                && let Some(record) =
                    no_room.note(received.no_room_count, message.handed.as_ns(), at)
            {
                no_room_records.push(&record);
            }
            note_undelivered(records, &arrival, disposition);
        }
        self.note_incomplete();
        failed.map_or(Ok(Some(at)), |error| Err(error.into()))
    }

    /// Sends the replies that are due; a reply that cannot leave is counted by the transport.
    fn answer(&mut self) {
        loop {
            let now = MonotonicClock::now();
            let Some(reply) = self.bridge.poll_transmit(now) else {
                return;
            };
            let to = reply.destination.unwrap_or(self.peer);
            if reply.kind != Kind::SyncResponse {
                let _counted = self.receiver.reply(reply.datagram, to).is_err();
                continue;
            }
            let sent = self.receiver.reply_stamped(now, reply.datagram, to);
            self.response = sent.is_ok().then_some(Response {
                sequence: reply.sequence,
                handed: now,
            });
            self.take_response_stamp(now);
        }
    }

    /// Takes the kernel's stamp of the newest clock response, if it has come; it rides on the next.
    fn take_response_stamp(&mut self, now: Instant) {
        let Some(realtime_ns) = self.receiver.take_reply_stamp(now) else {
            return;
        };
        if let Some(response) = self.response.take() {
            let left_ns = realtime_ns - self.clock.offset_ns();
            self.bridge.on_transmit_stamp(
                Kind::SyncResponse,
                response.sequence,
                left_ns.saturating_sub(response.handed.as_ns()),
            );
        }
    }

    /// Waits for a datagram or an appointment, or until `next_look`.
    pub(crate) fn rest(&mut self, next_look: Option<Instant>) -> Result<(), WorkerError> {
        let now = MonotonicClock::now();
        let wakeups = [self.bridge.next_wakeup(), next_look];
        let wakeup = wakeups.into_iter().flatten().min();
        let due = self.receiver.next_due();
        let pause = if self.is_emulated {
            // A link model's delay is a promise; the bridge's appointments are not.
            let pause = self.wait.pause(now, wakeup);
            due.map_or(pause, |due| pause.sooner(release(now, due)))
        } else {
            let dues = [wakeup, due];
            self.wait.pause(now, dues.into_iter().flatten().min())
        };
        match pause {
            // Who gives the processor away may get it back too late for what is due.
            Pause::Spin if due.is_some_and(|due| release(now, due) == Pause::Spin) => {
                core::hint::spin_loop();
            }
            Pause::Spin => self.wait.spin(),
            Pause::Sleep(until) => {
                let away = self.refusal_backoff.until(now, self.refused_count());
                let socket = self.receiver.poll_fd().filter(|_| away.is_none());
                poll_descriptors(socket.into_iter(), away.unwrap_or(until).min(until))?;
            }
        }
        Ok(())
    }

    /// Datagrams refused so far, whoever refused them.
    fn refused_count(&self) -> u64 {
        let sealed = self.receiver.seal_counts();
        let by_seal = sealed.map_or(0, |counts| counts.refused.total());
        by_seal + self.foreign_count + self.bridge.refusals().total()
    }
}

/// The channels while one datagram is taken. Its bytes are copied once, into the shared memory of its channel: only
/// its header and its seal, which are read after it has come, tell where they belong.
struct LocalChannels<'a> {
    outputs: &'a mut [Output],
    records: &'a mut SharedSink,
    arrival: &'a Arrival,
    failed: Option<ChannelError>,
}

impl Destination for LocalChannels<'_> {
    fn store(&mut self, piece: &Piece<'_>) -> bool {
        let port = &mut self.outputs[piece.channel].port;
        if piece.is_first {
            port.discard_pieces(piece.slot);
        }
        let written = port.write_piece(piece.slot, piece.offset_bytes, piece.payload);
        self.failed = written.err();
        self.failed.is_none()
    }

    fn deliver(&mut self, delivery: &Delivery, payload: Payload<'_>) {
        let output = &mut self.outputs[delivery.message.channel];
        output.received.fetch_add(1, Ordering::Relaxed);
        let published = output.publish(self.arrival, delivery, payload, self.records);
        self.failed = published.err();
    }
}

impl Output {
    fn publish(
        &mut self,
        arrival: &Arrival,
        delivery: &Delivery,
        payload: Payload<'_>,
        records: &mut SharedSink,
    ) -> Result<(), ChannelError> {
        let message = &delivery.message;
        let mut forwarded_ns = UNAVAILABLE;
        let envelope = || {
            let now = MonotonicClock::now();
            forwarded_ns = now.as_ns();
            message.envelope(now)
        };
        match payload {
            Payload::Datagram(bytes) => self.port.publish_with(bytes, envelope),
            Payload::Stored { slot, length_bytes } => {
                self.port.publish_pieces(slot, length_bytes, envelope)
            }
        }?;
        let flags = if delivery.order == Order::Reordered {
            IngressRecord::REORDERED
        } else {
            0
        };
        let record = arrival.record(message, forwarded_ns, flags);
        records.push(message.channel, &record.with_follow_up(delivery.follow_up));
        Ok(())
    }
}

fn note_undelivered(messages: &mut SharedSink, arrival: &Arrival, disposition: Disposition) {
    let (message, flags) = match disposition {
        Disposition::Duplicate(message) => (message, IngressRecord::DUPLICATE),
        Disposition::Late(message) => (message, IngressRecord::LATE),
        Disposition::Delivered(_)
        | Disposition::FragmentStored
        | Disposition::Greeted { .. }
        | Disposition::SyncRequested
        | Disposition::Farewell => return,
    };
    let record = arrival.record(&message, UNAVAILABLE, flags);
    messages.push(message.channel, &record);
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    /// What is recorded of messages that come a millisecond apart: `(after, before, count)` in milliseconds of the
    /// sender's clock, of `(handed, count so far)`.
    fn recorded(messages: &[(i64, u64)]) -> Vec<(i64, i64, u64)> {
        let mut no_room = NoRoom::new();
        let noted = (0_i64..)
            .zip(messages)
            .filter_map(|(at, (handed_ns, count))| {
                no_room.note(*count, *handed_ns, Instant::from_ns(at * MS))
            });
        let in_ms = |one: NoRoomRecord| (one.after_ns / MS, one.before_ns / MS, one.datagram_count);
        noted.map(in_ms).collect()
    }

    #[test]
    fn drops_noticed_with_an_overtaken_or_repeated_message_lie_before_the_next_new_one() {
        let late = [(8 * MS, 0), (10 * MS, 0), (9 * MS, 3), (14 * MS, 3)];
        assert_eq!(recorded(&late), [(10, 14, 3)]);
        let copy = [(10 * MS, 0), (10 * MS, 3), (14 * MS, 4), (15 * MS, 4)];
        assert_eq!(recorded(&copy), [(10, 14, 4)]);
    }

    #[test]
    fn an_implausible_time_of_handing_over_stops_no_later_record() {
        for forged_ns in [i64::MAX, i64::MAX - 1, 0, -5] {
            let base = 1_000_000 * MS;
            let [first, second, third, last] = [1, 2, 3, 9].map(|at| base + at * MS);
            let in_between = [
                (first, 0),
                (forged_ns, 0),
                (second, 0),
                (third, 0),
                (last, 5),
            ];
            let found = recorded(&in_between);
            assert_eq!(found, [(1_000_003, 1_000_009, 5)], "{forged_ns}");
            let at_first = [
                (forged_ns, 0),
                (first, 0),
                (second, 0),
                (third, 0),
                (last, 5),
            ];
            assert_eq!(recorded(&at_first), found, "{forged_ns}");
        }
    }
}
