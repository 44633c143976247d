//! The sending host's half of a flow: takes messages from the local channels, gives datagrams, and takes
//! replies. It owns no socket and no clock. A channel without messages costs it nothing: greetings, clock
//! exchanges and the state of the peer are the flow's.
//!
//! The loop that owns it does, in this order: [`EgressBridge::on_local`] for a waiting message,
//! [`EgressBridge::poll_transmit`] until it gives nothing, [`EgressBridge::on_transmit_stamp`] for
//! transmit stamps, [`EgressBridge::on_datagram`] for replies, then it waits for a message, a
//! reply or [`EgressBridge::next_wakeup`].
//!
//! Silence of the peer does not stop messages: on a radio link a pause is what is being measured.
//! Only a peer that the network reports unreachable, or that asks for a greeting, stops them until
//! it has greeted back.

mod counts;
mod exchange;
pub(crate) mod pacing;
mod path;
mod staging;
mod transmit;

use core::net::SocketAddr;
use core::time::Duration;

use hil_core::message::Envelope;
use hil_core::time::{Instant, PeriodicTimer};

use crate::body::{
    HELLO_ACK_BODY_BYTES, Hello, HelloAck, HelloStatus, SYNC_BODY_BYTES, SyncResponse,
};
use crate::channel::{FlowIdentity, SettingsError};
use crate::fragment::{FRAGMENT_COUNT_MAX, FragmentPlan};
use crate::refusal::{Refusal, RefusalCounts};
use crate::stamps::ArrivalStamps;
use crate::wire::{
    self, Body, FollowUpField, HEADER_BYTES, Header, Kind, Prefix, TAG_BYTES, payload_budget_bytes,
};

pub use counts::{EgressChannelCounts, EgressCounts, LocalRefusal};
pub use exchange::RoundTrip;

use exchange::Exchanges;
use pacing::Pacing;
use path::PathSearch;
use staging::Staging;

/// A message up to this size is sent in one go. The pieces of a longer one leave between other messages, as
/// the owner paces them, and its bytes stay with the owner meanwhile.
pub const STAGED_BYTES_MAX: usize = 65_536;
/// Time between greetings while the peer has not answered or is down.
pub const HELLO_PERIOD: Duration = Duration::from_millis(50);
/// Time between a padded greeting and the bare one behind it, which a near peer's answer makes needless.
const BARE_AFTER: Duration = Duration::from_millis(5);
/// Time between greetings after the peer refused the flow: it may be restarted with other
/// settings, but soon is unlikely.
pub const HELLO_PERIOD_REFUSED: Duration = Duration::from_secs(1);

/// Settings of an [`EgressBridge`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EgressSettings {
    /// The flow, as both hosts must see it.
    pub flow: FlowIdentity,
    /// This gateway's start; must differ from its earlier ones.
    pub session: u32,
    /// Fingerprint of this host's shared-memory domain.
    pub domain: [u8; 16],
    /// Names this host's monotonic clock; equal ids on both hosts mean one clock.
    pub clock_id: u64,
    /// Largest datagram the path may carry unfragmented: path MTU minus IP and UDP headers. What it does carry, the bridge
    /// finds out by its greetings.
    pub datagram_max_bytes: usize,
    /// Time between clock exchanges.
    pub sync_period: Duration,
}

impl EgressSettings {
    /// Payload bytes of one datagram, the room for a tag taken off.
    pub const fn payload_budget_bytes(&self) -> usize {
        payload_budget_bytes(self.datagram_max_bytes)
    }

    /// Datagrams that the largest message of any channel takes.
    pub fn fragment_count_max(&self) -> usize {
        let size_bytes = self.flow.size_max_bytes() as usize;
        match self.payload_budget_bytes() {
            0 => usize::MAX,
            budget => size_bytes.div_ceil(budget).max(1),
        }
    }

    fn hello(&self) -> Hello<'_> {
        Hello {
            domain: self.domain,
            clock_id: self.clock_id,
            channel_count: u16::try_from(self.flow.channels.len()).unwrap_or(u16::MAX),
            flow_name: &self.flow.name,
        }
    }

    /// Longest datagram that is not data.
    fn control_bytes(&self) -> usize {
        let body = self.hello().encoded_bytes().max(SYNC_BODY_BYTES);
        HEADER_BYTES + body.max(HELLO_ACK_BODY_BYTES)
    }

    /// The longest datagram that the flow has to send.
    fn datagram_bytes(&self) -> usize {
        let longest = HEADER_BYTES + self.flow.size_max_bytes() as usize + TAG_BYTES;
        longest.min(self.datagram_max_bytes)
    }

    fn check(&self) -> Result<(), SettingsError> {
        self.flow.check()?;
        if self.sync_period.is_zero() {
            return Err(SettingsError::Zero { key: "sync_period" });
        }
        let bound = self.control_bytes() + TAG_BYTES;
        if self.datagram_max_bytes < bound {
            return Err(SettingsError::DatagramTooSmall {
                value: self.datagram_max_bytes,
                bound,
            });
        }
        let fragments = self.fragment_count_max();
        if fragments > FRAGMENT_COUNT_MAX {
            return Err(SettingsError::TooManyFragments {
                size_bytes: self.flow.size_max_bytes(),
                fragments,
                bound: FRAGMENT_COUNT_MAX,
            });
        }
        Ok(())
    }
}

/// Where the conversation with the receiving gateway stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PeerState {
    /// Greeting, not answered yet.
    Greeting,
    /// The peer takes messages.
    Established,
    /// The network reported the peer unreachable.
    Down,
    /// The peer refused the flow; greetings go on slowly.
    Refused(HelloStatus),
}

/// Why a transmission failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TransmitFailure {
    /// The network says that the peer cannot be reached (ECONNREFUSED, ENETUNREACH and the like).
    PeerUnreachable,
    /// This host could not send just now (full queue, no buffers).
    Local,
}

/// One datagram to send.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Transmit<'a> {
    /// Its bytes.
    pub datagram: &'a [u8],
    /// What its stamp is given back with.
    pub key: TransmitKey,
    /// No further datagram of the same message follows.
    pub is_last_fragment: bool,
}

/// Which of the datagrams given earlier a transmit stamp is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TransmitKey {
    /// What it is.
    pub kind: Kind,
    /// Index of the channel whose message it carries.
    pub channel: Option<usize>,
    /// The producer's start of that message: numbers begin anew with each.
    pub epoch: Option<u32>,
    /// The header's sequence number.
    pub sequence: u64,
}

/// What a reply said.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EgressEvent {
    /// The peer takes messages.
    Accepted {
        /// The receiving gateway's start.
        peer_session: u32,
        /// Both hosts read one monotonic clock.
        clock_is_shared: bool,
        /// The peer answered before with another session.
        is_peer_restart: bool,
    },
    /// The peer answers, and the longest datagram that the path takes is not found yet.
    Answered,
    /// The peer refused the flow.
    Refused(HelloStatus),
    /// The peer does not know this session; greeting starts again.
    GreetAgain,
    /// A piece of a long message has arrived.
    PieceArrived,
    /// A clock exchange came back.
    RoundTrip {
        /// The exchange, with the stamps known now.
        round_trip: RoundTrip,
        /// An earlier exchange, now with the responder's kernel transmit stamp as t3.
        earlier: Option<RoundTrip>,
    },
}

/// The bridge.
#[derive(Debug)]
pub struct EgressBridge {
    settings: EgressSettings,
    digest: u64,
    channels: Box<[EgressChannel]>,
    state: PeerState,
    peer: Option<SocketAddr>,
    peer_session: Option<u32>,
    peer_clock_id: Option<u64>,
    last_heard: Option<Instant>,
    /// `handed_ns` of the first greeting of the current round, or of the accepted one: answers to
    /// anything earlier are stale.
    round_started_ns: Option<i64>,
    hello_due: Instant,
    hello_sequence: u64,
    sync_timer: PeriodicTimer,
    sync_sequence: u64,
    exchanges: Exchanges,
    path: PathSearch,
    staging: Staging,
    long: Option<Long>,
    pacing: Pacing,
    control: Box<[u8]>,
    last_transmit: Option<LastTransmit>,
    farewell: Farewell,
    counts: EgressCounts,
    refusals: RefusalCounts,
}

/// A long message under way.
#[derive(Debug, Clone, Copy)]
struct Long {
    channel: usize,
    /// Of its next piece.
    header: Header,
    plan: FragmentPlan,
    /// Of the piece given last.
    head: [u8; HEADER_BYTES],
}

/// One piece of a long message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LongPiece<'a> {
    /// The bytes before it.
    pub head: &'a [u8],
    /// Its own, of the message.
    pub tail: &'a [u8],
    /// Index of the channel.
    pub channel: usize,
    /// The message's number.
    pub sequence: u64,
    /// No further piece follows.
    pub is_last: bool,
}

/// What the bridge knows of one channel.
#[derive(Debug, Clone, Copy, Default)]
struct EgressChannel {
    /// Epoch and sequence of the last message taken.
    last_message: Option<(u32, u64)>,
    /// A stamp that rides on its next message.
    follow_up: Option<FollowUpField>,
    counts: EgressChannelCounts,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct LastTransmit {
    key: TransmitKey,
    is_last_fragment: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Farewell {
    Open,
    /// Of the channels from this index on, then of the flow.
    Due {
        from: usize,
    },
    Said,
}

impl EgressBridge {
    /// Sets everything aside; nothing allocates afterwards.
    ///
    /// # Errors
    /// [`SettingsError`] names the setting, its value and its bound.
    pub fn new(settings: EgressSettings) -> Result<Self, SettingsError> {
        settings.check()?;
        let path = PathSearch::new(
            settings.datagram_bytes(),
            settings.control_bytes() + TAG_BYTES,
        );
        let control_bytes = settings.control_bytes().max(path.greeting_bytes_max());
        Ok(Self {
            state: PeerState::Greeting,
            peer: None,
            peer_session: None,
            peer_clock_id: None,
            last_heard: None,
            round_started_ns: None,
            hello_due: Instant::from_ns(i64::MIN),
            hello_sequence: 0,
            sync_timer: PeriodicTimer::new(settings.sync_period),
            sync_sequence: 0,
            exchanges: Exchanges::new(),
            digest: settings.flow.digest(),
            channels: vec![EgressChannel::default(); settings.flow.channels.len()]
                .into_boxed_slice(),
            long: None,
            pacing: Pacing::new(),
            staging: Staging::new(
                (settings.flow.size_max_bytes() as usize).min(STAGED_BYTES_MAX),
                path.least_budget_bytes(),
            ),
            control: vec![0; control_bytes].into_boxed_slice(),
            path,
            last_transmit: None,
            farewell: Farewell::Open,
            counts: EgressCounts::default(),
            refusals: RefusalCounts::default(),
            settings,
        })
    }

    /// Stages one message of the local channel with index `channel`; send it with
    /// [`EgressBridge::poll_transmit`] before staging the next of any channel.
    ///
    /// # Errors
    /// The message is refused and counted; it will not be sent.
    ///
    /// # Panics
    /// When the flow has no such channel.
    pub fn on_local(
        &mut self,
        now: Instant,
        channel: usize,
        envelope: &Envelope,
        payload: &[u8],
    ) -> Result<(), LocalRefusal> {
        let mut result = self.check_local(channel, envelope, payload.len());
        if result.is_ok() && payload.len() > STAGED_BYTES_MAX {
            result = Err(LocalRefusal::TooBig {
                size_bytes: payload.len(),
                size_max_bytes: STAGED_BYTES_MAX,
            });
        }
        self.count_offered(channel, result);
        if result.is_ok() {
            let header = self.message_header(channel, envelope);
            self.staging.stage(now, channel, header, payload);
        }
        result
    }

    /// Begins a message of `length_bytes`, which may be above [`STAGED_BYTES_MAX`]; its pieces are then given
    /// by [`EgressBridge::long_piece`], and other messages may be sent between them.
    ///
    /// # Errors
    /// The message is refused and counted; it will not be sent. One at a time.
    ///
    /// # Panics
    /// When the flow has no such channel.
    pub fn begin_long(
        &mut self,
        channel: usize,
        envelope: &Envelope,
        length_bytes: usize,
    ) -> Result<(), LocalRefusal> {
        let mut result = self.check_local(channel, envelope, length_bytes);
        if result.is_ok() && self.long.is_some() {
            result = Err(LocalRefusal::TransmissionPending);
        }
        self.count_offered(channel, result);
        result?;
        let plan = FragmentPlan::new(length_bytes, self.path.budget_bytes())
            .expect("settings bound the fragments of the largest message");
        let mut header = self.message_header(channel, envelope);
        header.total_len = u32::try_from(length_bytes).expect("size_max_bytes is a u32");
        header.fragment_count = plan.count();
        self.long = Some(Long {
            channel,
            header,
            plan,
            head: [0; HEADER_BYTES],
        });
        Ok(())
    }

    /// True while a long message is under way; it ends with its last piece, or with the peer.
    pub const fn has_long(&self) -> bool {
        self.long.is_some()
    }

    /// Until when the next piece of a long message waits, so that no more are under way than path and receiver
    /// keep up with; `None` when it may leave. Ask before each, and again after an
    /// [`EgressEvent::PieceArrived`].
    pub fn piece_held_until(&mut self, now: Instant) -> Option<Instant> {
        if self.pacing.is_silent(now) {
            self.counts.piece_silence_count += 1;
            self.pacing.on_silence(now);
        }
        self.pacing.held_until(now)
    }

    /// Whether a piece waits for an acknowledgement, so that replies are to be looked for soon.
    pub fn awaits_piece_ack(&self) -> bool {
        self.long.is_some() && self.pacing.awaits_acknowledgement()
    }

    /// The next piece of the long message under way, whose bytes are `payload`; the same again until
    /// [`EgressBridge::on_long_sent`] or [`EgressBridge::on_long_failed`]. `now` becomes its `handed_ns`.
    ///
    /// # Panics
    /// Never: the index of a piece stays below their count.
    pub fn long_piece<'a>(&'a mut self, now: Instant, payload: &'a [u8]) -> Option<LongPiece<'a>> {
        let long = self.long.as_mut()?;
        let index = long.header.fragment_index;
        let range = long.plan.range(index).expect("index is below the count");
        long.header.handed_ns = now.as_ns();
        long.header.encode(&mut long.head);
        Some(LongPiece {
            tail: payload.get(range)?,
            channel: long.channel,
            sequence: long.header.sequence,
            is_last: index + 1 == long.plan.count(),
            head: &long.head,
        })
    }

    /// The piece given last has left.
    pub fn on_long_sent(&mut self) {
        let Some(long) = &mut self.long else {
            return;
        };
        self.counts.datagram_count += 1;
        self.pacing.on_sent(&long.header);
        let counts = &mut self.channels[long.channel].counts;
        counts.datagram_count += 1;
        long.header.fragment_index += 1;
        if long.header.fragment_index == long.plan.count() {
            counts.sent_count += 1;
            self.long = None;
        }
    }

    /// The piece given last could not be sent; the rest of its message is given up.
    pub fn on_long_failed(&mut self, now: Instant, failure: TransmitFailure) {
        self.counts.transmit_failed_count += 1;
        self.abandon_long();
        if failure == TransmitFailure::PeerUnreachable {
            self.on_peer_unreachable(now);
        }
    }

    fn count_offered(&mut self, channel: usize, result: Result<(), LocalRefusal>) {
        let counts = &mut self.channels[channel].counts;
        counts.offered_count += 1;
        if let Err(refusal) = result {
            counts.refuse(refusal);
        }
    }

    /// Of a message that is taken now.
    fn message_header(&mut self, channel: usize, envelope: &Envelope) -> Header {
        let own = &mut self.channels[channel];
        let before = own
            .last_message
            .replace((envelope.epoch, envelope.sequence));
        let identity = &self.settings.flow.channels[channel];
        let mut header = Header::new(Kind::Data, self.settings.session, identity.channel);
        header.type_hash = identity.type_hash;
        header.sequence = envelope.sequence;
        header.published_ns = envelope.published_ns;
        header.epoch = envelope.epoch;
        // A follow-up names its message by sequence alone.
        let follow_up = own.follow_up.take();
        header.follow_up =
            follow_up.filter(|_| before.is_none_or(|(epoch, _)| epoch == envelope.epoch));
        header
    }

    /// The next datagram to send: fragments of the staged message first, then what is due.
    /// `now` becomes its `handed_ns`; read the clock for each call.
    pub fn poll_transmit(&mut self, now: Instant) -> Option<Transmit<'_>> {
        if self.staging.is_pending() {
            return Some(self.transmit_data(now));
        }
        if let Farewell::Due { from } = self.farewell {
            return Some(self.transmit_bye(now, from));
        }
        if self.farewell == Farewell::Said {
            return None;
        }
        if self.state == PeerState::Established {
            self.sync_timer.poll(now)?;
            return Some(self.transmit_sync(now));
        }
        (self.hello_due <= now).then(|| self.transmit_hello(now))
    }

    /// The datagram given last could not be sent; what is left of its message is given up.
    pub fn on_transmit_failed(&mut self, now: Instant, failure: TransmitFailure) {
        self.counts.transmit_failed_count += 1;
        if let Some(last) = self.last_transmit.take() {
            if let Some(channel) = last.key.channel {
                let counts = &mut self.channels[channel].counts;
                counts.datagram_count -= 1;
                counts.message_failed_count += 1;
                if last.is_last_fragment {
                    counts.sent_count -= 1;
                } else {
                    self.staging.abandon();
                }
            } else if last.key.kind == Kind::SyncRequest {
                self.counts.sync_sent_count -= 1;
            } else if last.key.kind == Kind::Bye
                && let Farewell::Due { from } = self.farewell
                && let Some(channel) = from.checked_sub(1)
            {
                // The peer may be gone before it is told so.
                self.channels[channel].counts.datagram_count -= 1;
            }
        }
        if failure == TransmitFailure::PeerUnreachable {
            self.on_peer_unreachable(now);
        }
    }

    /// The network reported the peer unreachable outside a send call (a receive call returned
    /// ECONNREFUSED). Messages are refused until the peer greets back.
    pub fn on_peer_unreachable(&mut self, now: Instant) {
        self.abandon_staged();
        if self.state != PeerState::Down {
            self.counts.peer_down_count += 1;
            self.greet_from(PeerState::Down, now + HELLO_PERIOD);
        }
    }

    /// The kernel's transmit stamp of a datagram given earlier: `handed_to_tx_ns` is that stamp
    /// minus the `now` it was polled with; for a fragmented message, the stamp of the last
    /// fragment minus the `now` of the first. It rides on the next message of the same start of its producer, or
    /// refines t1.
    pub fn on_transmit_stamp(&mut self, of: TransmitKey, handed_to_tx_ns: i64) {
        let delta = u32::try_from(handed_to_tx_ns).unwrap_or(u32::MAX);
        if delta == u32::MAX {
            self.counts.transmit_stamp_implausible_count += 1;
            return;
        }
        match (of.channel, of.kind) {
            (Some(channel), _) => {
                let own = &mut self.channels[channel];
                let is_of_last_start = own
                    .last_message
                    .is_some_and(|(epoch, last)| of.epoch == Some(epoch) && of.sequence <= last);
                if is_of_last_start {
                    own.follow_up = Some(FollowUpField::new(of.sequence, delta));
                }
            }
            (None, Kind::SyncRequest) => {
                let exchanges = &mut self.exchanges;
                exchanges.set_transmit_stamp(of.sequence, handed_to_tx_ns);
            }
            (None, _) => {}
        }
    }

    /// Takes a reply.
    ///
    /// # Errors
    /// The reply is refused and counted.
    pub fn on_datagram(
        &mut self,
        now: Instant,
        arrival: ArrivalStamps,
        bytes: &[u8],
    ) -> Result<EgressEvent, Refusal> {
        self.counts.reply_count += 1;
        let result = self.accept(now, arrival, bytes);
        match result {
            Ok(_) => {
                self.counts.reply_accepted_count += 1;
                self.last_heard = Some(now);
            }
            Err(refusal) => self.refusals.count(refusal),
        }
        result
    }

    /// Ends the session: no message is taken any more, and the peer is told once.
    pub fn bye(&mut self) {
        if self.farewell == Farewell::Open {
            self.farewell = if self.state == PeerState::Established {
                Farewell::Due { from: 0 }
            } else {
                Farewell::Said
            };
        }
    }

    /// When [`EgressBridge::poll_transmit`] next has something to give; in the past when it has
    /// something now, `None` once the farewell is said.
    pub fn next_wakeup(&self) -> Option<Instant> {
        if let Some(staged_at) = self.staging.staged_at() {
            return Some(staged_at);
        }
        match (self.farewell, self.state) {
            (Farewell::Said, _) => None,
            (Farewell::Due { .. }, _) => Some(Instant::from_ns(i64::MIN)),
            (Farewell::Open, PeerState::Established) => self.sync_timer.next(),
            (Farewell::Open, _) => Some(self.hello_due),
        }
    }

    /// Where the conversation stands.
    pub const fn peer_state(&self) -> PeerState {
        self.state
    }

    /// The longest datagram that greetings found the path to take, where the flow has longer ones to send.
    pub fn shortened_datagram_bytes(&self) -> Option<usize> {
        self.path.shortened()
    }

    /// When the last accepted reply came; against `now` it tells a silent peer.
    pub const fn last_heard(&self) -> Option<Instant> {
        self.last_heard
    }

    /// What became of datagrams, exchanges and replies.
    pub const fn counts(&self) -> &EgressCounts {
        &self.counts
    }

    /// What became of the messages of the channel with index `channel`.
    ///
    /// # Panics
    /// When the flow has no such channel.
    pub fn channel_counts(&self, channel: usize) -> &EgressChannelCounts {
        &self.channels[channel].counts
    }

    /// Replies refused, by reason.
    pub const fn refusals(&self) -> &RefusalCounts {
        &self.refusals
    }

    fn check_local(
        &self,
        channel: usize,
        envelope: &Envelope,
        size_bytes: usize,
    ) -> Result<(), LocalRefusal> {
        if self.farewell != Farewell::Open {
            return Err(LocalRefusal::Closed);
        }
        match self.state {
            PeerState::Established => {}
            PeerState::Greeting => return Err(LocalRefusal::PeerNotGreeted),
            PeerState::Down => return Err(LocalRefusal::PeerDown),
            PeerState::Refused(_) => return Err(LocalRefusal::ChannelRefused),
        }
        if envelope.is_forwarded() {
            return Err(LocalRefusal::Forwarded);
        }
        let size_max_bytes = self.settings.flow.channels[channel].size_max_bytes as usize;
        if size_bytes > size_max_bytes {
            return Err(LocalRefusal::TooBig {
                size_bytes,
                size_max_bytes,
            });
        }
        if self.staging.is_pending() {
            return Err(LocalRefusal::TransmissionPending);
        }
        Ok(())
    }

    fn accept(
        &mut self,
        now: Instant,
        arrival: ArrivalStamps,
        bytes: &[u8],
    ) -> Result<EgressEvent, Refusal> {
        let datagram = wire::decode(bytes).inspect_err(|&refusal| {
            if refusal == Refusal::UnsupportedVersion {
                self.on_other_version(now, bytes);
            }
        })?;
        let header = &datagram.header;
        if header.channel != self.settings.flow.flow {
            return Err(Refusal::UnknownChannel);
        }
        if let (Some(bound), Some(from)) = (self.peer, arrival.peer)
            && bound != from
        {
            return Err(Refusal::ForeignSource);
        }
        if header.session != self.settings.session {
            return Err(Refusal::UnknownSession);
        }
        match datagram.body {
            Body::HelloAck(ack) => self.on_hello_ack(now, arrival, &ack),
            Body::SyncResponse(response) => self.on_sync_response(header, &response, arrival),
            Body::PieceAck(ack) => {
                self.pacing.on_acknowledged(now, ack.answers_handed_ns)?;
                self.counts.piece_ack_count += 1;
                Ok(EgressEvent::PieceArrived)
            }
            _ => Err(Refusal::UnexpectedKind),
        }
    }

    /// A greeting was answered in another version of the protocol: only the part of the header
    /// that no version changes can be read.
    fn on_other_version(&mut self, now: Instant, bytes: &[u8]) {
        let is_answer = Prefix::decode(bytes).is_some_and(|prefix| {
            prefix.kind == Some(Kind::HelloAck)
                && prefix.session == self.settings.session
                && prefix.channel == self.settings.flow.flow
        });
        if is_answer && self.state != PeerState::Established {
            let refused = PeerState::Refused(HelloStatus::VersionMismatch);
            self.greet_from(refused, now + HELLO_PERIOD_REFUSED);
        }
    }

    fn on_hello_ack(
        &mut self,
        now: Instant,
        arrival: ArrivalStamps,
        ack: &HelloAck,
    ) -> Result<EgressEvent, Refusal> {
        let round_started_ns = self.round_started_ns.ok_or(Refusal::Unsolicited)?;
        if ack.answers_handed_ns < round_started_ns {
            return Err(Refusal::Stale);
        }
        if ack.answers_handed_ns > now.as_ns() {
            return Err(Refusal::ImplausibleStamp);
        }
        match ack.status {
            HelloStatus::Accepted => {
                let is_established = self.state == PeerState::Established;
                if !is_established && !self.path.on_answer(ack.answers_handed_ns) {
                    self.state = PeerState::Greeting;
                    return Ok(EgressEvent::Answered);
                }
                Ok(self.establish(now, arrival, ack))
            }
            HelloStatus::GreetAgain => {
                if self.state == PeerState::Established {
                    self.counts.greet_again_count += 1;
                    self.greet_from(PeerState::Greeting, now);
                }
                Ok(EgressEvent::GreetAgain)
            }
            status => {
                self.greet_from(PeerState::Refused(status), now + HELLO_PERIOD_REFUSED);
                Ok(EgressEvent::Refused(status))
            }
        }
    }

    fn establish(&mut self, now: Instant, arrival: ArrivalStamps, ack: &HelloAck) -> EgressEvent {
        let is_peer_restart = self
            .peer_session
            .is_some_and(|session| session != ack.session);
        self.counts.peer_restart_count += u64::from(is_peer_restart);
        if self.state != PeerState::Established {
            self.state = PeerState::Established;
            self.staging.cut_at(self.path.budget_bytes());
            self.sync_timer.start(now);
        }
        self.round_started_ns = Some(ack.answers_handed_ns);
        self.peer = arrival.peer;
        self.peer_session = Some(ack.session);
        self.peer_clock_id = Some(ack.clock_id);
        EgressEvent::Accepted {
            peer_session: ack.session,
            clock_is_shared: ack.clock_id == self.settings.clock_id,
            is_peer_restart,
        }
    }

    fn abandon_staged(&mut self) {
        if let Some(channel) = self.staging.abandon() {
            self.channels[channel].counts.message_failed_count += 1;
        }
        self.abandon_long();
    }

    fn abandon_long(&mut self) {
        if let Some(long) = self.long.take() {
            self.channels[long.channel].counts.message_failed_count += 1;
        }
    }

    /// Leaves for a state in which the peer is greeted, first at `due`.
    fn greet_from(&mut self, state: PeerState, due: Instant) {
        self.abandon_staged();
        // Refused and Down keep listening to answers of greetings that are still under way.
        if self.state == PeerState::Established {
            self.round_started_ns = None;
        }
        self.path.begin();
        self.state = state;
        self.peer = None;
        self.hello_due = due;
    }

    fn on_sync_response(
        &mut self,
        header: &Header,
        response: &SyncResponse,
        arrival: ArrivalStamps,
    ) -> Result<EgressEvent, Refusal> {
        let round_trip = self.exchanges.close(header.sequence, response, arrival)?;
        let earlier = header
            .follow_up
            .and_then(|field| self.exchanges.refine(header.sequence, field));
        self.counts.round_trip_count += 1;
        Ok(EgressEvent::RoundTrip {
            round_trip,
            earlier,
        })
    }
}
