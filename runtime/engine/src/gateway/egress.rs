//! The sending thread of a gateway: from the local channels of one flow to the network. It owns the clock,
//! the ports and the socket; what to send and what replies mean is the bridge's business.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use hil_core::message::Envelope;
use hil_core::record::RoundTripRecord;
use hil_core::time::Instant;
use hil_protocol::egress::{RoundTrip, TransmitFailure};
use hil_protocol::{EgressBridge, EgressEvent, LocalRefusal, PeerState};

use super::inputs::{Inputs, Look};
use super::line::Line;
use super::long_message::LongMessage;
use super::refusal_backoff::RefusalBackoff;
use super::stamp_tracker::STAMP_PATIENCE_NS;
use super::{DESCRIPTORS_MAX, WorkerError, poll_descriptors};
use crate::cable::Outward;
use hil_platform::clock::MonotonicClock;
use hil_platform::wait::{Pause, WaitStrategy};
use hil_rundir::pipe::{FromProcess, say};
use hil_shm::HeldMessage;

/// Longer than any reply; what is longer is no reply and is cut.
const REPLY_BYTES_MAX: usize = 1024;

/// Everything the thread works with.
#[derive(Debug)]
pub(crate) struct Egress {
    /// Where messages come from; empty on a clock path, which carries none.
    pub(super) inputs: Inputs,
    /// A message that is too long to be sent in one go, while its pieces leave.
    pub(super) long: Option<LongMessage>,
    pub(crate) bridge: EgressBridge,
    pub(crate) line: Line,
    pub(crate) wait: WaitStrategy,
    /// Messages sent, by channel.
    pub(crate) sent: Box<[Arc<AtomicU64>]>,
    pub(crate) attention: Attention,
    pub(super) refusal_backoff: RefusalBackoff,
    /// The longest datagram that the path takes, as told last; `None` while it takes what is sent.
    pub(super) path_bytes: Option<usize>,
    /// Set while the peer takes messages.
    pub(crate) is_established: Arc<AtomicBool>,
}

/// What waiting found: to look after the socket costs system calls that a waiting message would
/// have to wait for, and so does taking back announcements.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Attention {
    has_news: bool,
    is_overdue: bool,
    looked: Instant,
}

/// A thread that finds a message in every turn looks after its socket this often.
const LOOK_PERIOD_BUSY_NS: i64 = 5_000_000;
/// A spinning thread looks after its socket this often.
const LOOK_PERIOD_NS: i64 = 500_000;
/// Descriptors that it waits for beside the inlets of programs: its listener and its socket.
const OWN_DESCRIPTORS: usize = 2;
/// How often inlets are looked at where there are too many to wait for.
const UNWATCHED_LOOK_PERIOD: Duration = Duration::from_millis(1);
/// And any thread so often while a long message waits for a reply.
const LOOK_PERIOD_HELD_NS: i64 = 50_000;

impl Egress {
    /// Gives up a long message that is under way, then, if no step failed, sends the peer a farewell.
    pub(crate) fn finish(&mut self, stepped: Result<(), WorkerError>) -> Result<(), WorkerError> {
        if let Some(mut long) = self.long.take() {
            let now = MonotonicClock::now();
            self.bridge.on_long_failed(now, TransmitFailure::Local);
            long.end(&mut self.line);
        }
        stepped?;
        self.bridge.bye();
        self.line.transmit(&mut self.bridge);
        self.line.settle(&mut self.bridge)?;
        self.line.hand_over()
    }

    /// Sends one waiting message, or else looks after stamps, replies and appointments; false when
    /// no message waited and no channel is to be looked at.
    pub(crate) fn step(&mut self) -> Result<bool, WorkerError> {
        let moved = if self.long.is_some() {
            self.forward_beside_long()?
        } else {
            self.forward()?
        };
        if moved {
            self.inputs.note_moved()?;
        }
        if moved && !self.attention.is_overdue {
            // A producer faster than the socket must not keep replies and orders waiting for ever.
            let now = self.line.newest_handed;
            let since_look = now.ns_since(self.attention.looked);
            self.attention.is_overdue = since_look > self.look_period_ns(LOOK_PERIOD_BUSY_NS);
            return Ok(true);
        }
        let now = MonotonicClock::now();
        let since_look = now.ns_since(self.attention.looked);
        if self.attention.has_news
            || self.attention.is_overdue
            || since_look > self.look_period_ns(LOOK_PERIOD_NS)
        {
            self.attention.is_overdue = false;
            self.attention.has_news = false;
            self.attention.looked = now;
            self.line.sender.attend(now);
            self.line.take_stamps(&mut self.bridge);
            self.line.notice_reports(&mut self.bridge, now);
            self.hear()?;
            self.line.expire(now);
            self.line.clock.refresh(now);
            self.inputs.sweep(now);
            self.is_established
                .store(self.is_ready(), Ordering::Release);
        }
        if self.bridge.next_wakeup().is_some_and(|due| due <= now) {
            self.line.transmit(&mut self.bridge);
        }
        // Announcements are taken back only now, for the message waited for its datagram, not
        // for this.
        let was_announced = self.inputs.settle()?;
        Ok(moved || was_announced || self.inputs.is_any_due())
    }

    /// How often to look after the socket, where `otherwise` holds without a long message that waits for a reply.
    fn look_period_ns(&self, otherwise: i64) -> i64 {
        if self.bridge.awaits_piece_ack() {
            LOOK_PERIOD_HELD_NS
        } else {
            otherwise
        }
    }

    /// True while the peer takes messages. On a clock path the run may begin after an exchange
    /// whose four stamps are known: that of the response's departure rides on the next.
    fn is_ready(&self) -> bool {
        let is_established = self.bridge.peer_state() == PeerState::Established;
        is_established && (!self.inputs.is_empty() || self.bridge.counts().round_trip_count > 1)
    }

    /// Looks at every channel that may have a message, then sends some pieces of the long message under way.
    fn forward_beside_long(&mut self) -> Result<bool, WorkerError> {
        let mut has_moved = false;
        for _ in 0..self.inputs.due_count() {
            has_moved |= self.forward()?;
        }
        if self.push_long() {
            // Other channels may have been announced while its pieces left.
            self.inputs.note_announced()?;
            has_moved = true;
        }
        Ok(has_moved)
    }

    /// Sends some pieces of the long message under way; false when there is none, or enough of it is on its
    /// way.
    fn push_long(&mut self) -> bool {
        let Some(long) = &mut self.long else {
            return false;
        };
        let has_moved = long.push(&mut self.bridge, &mut self.line);
        if !self.bridge.has_long() {
            let channel = long.end(&mut self.line);
            let sent_count = self.bridge.channel_counts(channel).sent_count;
            self.sent[channel].store(sent_count, Ordering::Relaxed);
            self.long = None;
            self.inputs.resume_long();
        }
        has_moved
    }

    /// Begins to send the message of `channel` that was taken at `taken`.
    fn begin_long(&mut self, taken: Instant, channel: usize, held: HeldMessage) {
        let envelope = held.envelope();
        let record = self.line.record_of(taken, &envelope);
        let begun = self
            .bridge
            .begin_long(channel, &envelope, held.payload().len());
        match begun {
            Ok(()) => self.long = Some(LongMessage::new(channel, held, record)),
            // Another gateway's message: not this gateway's to account for.
            Err(LocalRefusal::Forwarded) => {}
            Err(_counted) => self.line.finish_refused(channel, record),
        }
    }

    /// Sends the oldest message of the channel whose turn it is; false when it had none.
    fn forward(&mut self) -> Result<bool, WorkerError> {
        let Self {
            inputs,
            bridge,
            line,
            wait,
            sent,
            ..
        } = self;
        let take = |channel: usize, envelope: &Envelope, payload: &[u8]| {
            let taken = MonotonicClock::now();
            wait.on_arrival(taken);
            let record = line.record_of(taken, envelope);
            match bridge.on_local(taken, channel, envelope, payload) {
                Ok(()) => {
                    line.message = Some(record);
                    line.transmit(bridge);
                    let sent_count = bridge.channel_counts(channel).sent_count;
                    sent[channel].store(sent_count, Ordering::Relaxed);
                }
                // Another gateway's message: not this gateway's to account for.
                Err(LocalRefusal::Forwarded) => {}
                Err(_counted) => line.finish_refused(channel, record),
            }
        };
        match inputs.receive(self.long.is_none(), take)? {
            Look::Empty => Ok(false),
            Look::Message => Ok(true),
            Look::Long(channel, held) => {
                let taken = MonotonicClock::now();
                self.wait.on_arrival(taken);
                self.begin_long(taken, channel, held);
                Ok(true)
            }
        }
    }

    /// Takes the peer's replies.
    fn hear(&mut self) -> Result<(), WorkerError> {
        let mut buffer = [0; REPLY_BYTES_MAX];
        while let Some(received) = self
            .line
            .sender
            .receive(&mut buffer)
            .map_err(WorkerError::Socket)?
        {
            let now = MonotonicClock::now();
            let arrival = self.line.clock.arrival(&received, now);
            let bytes = &buffer[..received.length_bytes];
            match self.bridge.on_datagram(now, arrival, bytes) {
                Ok(EgressEvent::RoundTrip {
                    round_trip,
                    earlier,
                }) => {
                    if let Some(earlier) = earlier {
                        self.note_round_trip(&earlier);
                    }
                    self.note_round_trip(&round_trip);
                }
                Ok(EgressEvent::Refused(status)) => {
                    if self.bridge.peer_state() == PeerState::Refused(status) {
                        return Err(WorkerError::Refused(status));
                    }
                }
                Ok(EgressEvent::PieceArrived) => {
                    if let Some(long) = &mut self.long {
                        long.on_piece_arrived();
                    }
                }
                Ok(EgressEvent::Accepted { .. }) => self.tell_path(),
                Ok(EgressEvent::Answered | EgressEvent::GreetAgain) | Err(_) => {}
            }
        }
        Ok(())
    }

    /// Says that the path takes less than the interface.
    fn tell_path(&mut self) {
        let found = self.bridge.shortened_datagram_bytes();
        if let Some(bytes) = found.filter(|_| self.path_bytes != found) {
            say(&FromProcess::Warning(format!(
                "the path to the peer takes no datagrams above {bytes} bytes: longer messages go in more pieces"
            )));
        }
        self.path_bytes = found;
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

    /// Waits for a message, a stamp, a reply or an appointment; also for the frames of programs, or until their `cables`
    /// want to be looked at.
    pub(crate) fn rest(&mut self, cables: &[(usize, Outward)]) -> Result<(), WorkerError> {
        let now = MonotonicClock::now();
        let dues = [
            self.bridge.next_wakeup(),
            self.line.sender.next_due(),
            self.long.as_ref().map(|long| long.due),
            cables.iter().filter_map(|(_, one)| one.next_look()).min(),
        ];
        let mut due = dues.into_iter().flatten().min();
        if cables.len() > DESCRIPTORS_MAX - OWN_DESCRIPTORS {
            // Nobody wakes this thread for the others.
            let look = now + UNWATCHED_LOOK_PERIOD;
            due = Some(due.map_or(look, |due| due.min(look)));
        }
        if self.line.awaits_stamps() {
            // A stamp makes the socket readable, but an overdue one must be given up in time.
            let patience = Instant::from_ns(now.as_ns() + STAMP_PATIENCE_NS);
            due = Some(due.map_or(patience, |due| due.min(patience)));
        }
        match self.wait.pause(now, due) {
            Pause::Spin => {
                self.wait.spin();
                self.inputs.note_announced()?;
            }
            Pause::Sleep(until) => {
                // Messages are never kept waiting for refused replies.
                let away = self.refusal_backoff.until(now, self.refused_count());
                let until = away.unwrap_or(until).min(until);
                let listener = self.inputs.descriptor();
                let is_listening = listener.is_some();
                let socket = self.line.sender.poll_fd().filter(|_| away.is_none());
                let has_socket = socket.is_some();
                let own = listener.into_iter().chain(socket);
                let inlets = cables.iter().filter_map(|(_, one)| one.descriptor());
                let [first, second, ..] = poll_descriptors(own.chain(inlets), until)?;
                // Without a listener the socket comes first.
                let (is_announced, has_socket_news) = if is_listening {
                    (first, second && has_socket)
                } else {
                    (false, first && has_socket)
                };
                self.attention.has_news |= has_socket_news || away.is_some();
                if is_announced {
                    self.inputs.note_announced()?;
                }
            }
        }
        Ok(())
    }

    /// Replies refused so far, by the seal or the bridge.
    fn refused_count(&self) -> u64 {
        let sealed = self.line.sender().seal_counts();
        sealed.map_or(0, |counts| counts.refused.total()) + self.bridge.refusals().total()
    }
}
