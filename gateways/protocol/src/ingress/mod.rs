//! The receiving host's half of a flow: takes datagrams, delivers messages, and gives replies.
//! It owns no socket and no clock, and it never replays a message: silence stays silence.
//!
//! The loop that owns it does: [`IngressBridge::on_datagram`] for each arrival, then
//! [`IngressBridge::poll_transmit`] until it gives nothing. Replies go to the address the request
//! came from, and no reply is longer than its request, so that a forged source address gains
//! nothing.
//!
//! Every datagram is either given a [`Disposition`] or a [`Refusal`], and counted once:
//! `datagram_count = accepted_count + refusals().total()`.

mod delivery;
mod replies;
mod session;

use core::cmp::Ordering;
use core::net::SocketAddr;
use core::time::Duration;
use std::collections::VecDeque;

use hil_core::message::may_be_shorter;
use hil_core::time::Instant;

use super::body::{Hello, HelloStatus};
use super::channel::{ChannelIdentity, ChannelNumbers, FlowIdentity, SettingsError};
use super::egress::STAGED_BYTES_MAX;
use super::egress::pacing::is_acknowledged;
use super::fragment::{Fragment, Reassembler, ReassemblyCounts};
use super::refusal::{Refusal, RefusalCounts};
use super::sequence::{Order, SequenceCounts, SequenceWindow};
use super::stamps::ArrivalStamps;
use super::wire::{self, Body, Header, Kind, Prefix};

pub use delivery::{
    Delivery, Disposition, FollowUp, Incomplete, IngressChannelCounts, IngressCounts, MessageInfo,
};
pub use replies::ReplyCounts;

use delivery::{delivery_of, message_of, stream_of};
use replies::{AckRequest, PieceRequest, Replies, SyncRequest};
use session::Sessions;

/// Shortest time between two replies that refuse, or ask for a greeting.
pub const REFUSAL_REPLY_PERIOD: Duration = Duration::from_millis(10);

/// A message that skips more numbers than this is refused until its sender greets again.
pub const SEQUENCE_JUMP_MAX: u64 = 1 << 20;

/// Messages of a channel that may be incomplete at a time.
const REASSEMBLY_SLOTS: usize = 4;
/// The same of a channel with long messages.
const REASSEMBLY_SLOTS_LONG: usize = 2;
/// How long after its last piece a message is given up: longer than a stall of TCP of two timeouts, or of a radio.
pub(crate) const REASSEMBLY_TIMEOUT: Duration = Duration::from_secs(1);

/// Memory that is set aside to put the messages of a channel of `size_bytes` together.
pub const fn reassembly_bytes(size_bytes: usize) -> usize {
    let slot_count = if size_bytes > STAGED_BYTES_MAX {
        REASSEMBLY_SLOTS_LONG
    } else {
        REASSEMBLY_SLOTS
    };
    slot_count * size_bytes
}

/// Settings of an [`IngressBridge`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IngressSettings {
    /// The flow, as both hosts must see it.
    pub flow: FlowIdentity,
    /// This gateway's start; must differ from its earlier ones.
    pub session: u32,
    /// Fingerprint of this host's shared-memory domain.
    pub domain: [u8; 16],
    /// Names this host's monotonic clock; equal ids on both hosts mean one clock.
    pub clock_id: u64,
    /// Incomplete messages held at a time for each channel; the oldest gives way.
    pub reassembly_slots: usize,
    /// An incomplete message of which no piece came for so long is given up.
    pub reassembly_timeout: Duration,
    /// True to deliver a message that is new but older than one already delivered; false for
    /// newest-wins.
    pub deliver_reordered: bool,
}

impl IngressSettings {
    /// Four reassembly slots, 1 s each, reordered messages delivered.
    pub fn new(flow: FlowIdentity, session: u32, domain: [u8; 16], clock_id: u64) -> Self {
        Self {
            flow,
            session,
            domain,
            clock_id,
            reassembly_slots: REASSEMBLY_SLOTS,
            reassembly_timeout: REASSEMBLY_TIMEOUT,
            deliver_reordered: true,
        }
    }

    /// Messages of a channel that may be incomplete at a time. Of long ones, of which a sender has one under
    /// way, it is the one and the remains of the one before.
    fn slot_count(&self, size_max_bytes: usize) -> usize {
        if size_max_bytes > STAGED_BYTES_MAX {
            self.reassembly_slots.min(REASSEMBLY_SLOTS_LONG)
        } else {
            self.reassembly_slots
        }
    }

    fn check(&self) -> Result<(), SettingsError> {
        self.flow.check()?;
        if self.reassembly_slots == 0 {
            return Err(SettingsError::Zero {
                key: "reassembly_slots",
            });
        }
        if self.reassembly_timeout.is_zero() {
            return Err(SettingsError::Zero {
                key: "reassembly_timeout",
            });
        }
        Ok(())
    }
}

/// One datagram to send back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reply<'a> {
    /// Its bytes.
    pub datagram: &'a [u8],
    /// What it is.
    pub kind: Kind,
    /// The request's sequence number, repeated; with `kind` the key for
    /// [`IngressBridge::on_transmit_stamp`].
    pub sequence: u64,
    /// Where the request came from; `None` on a connected transport.
    pub destination: Option<SocketAddr>,
}

/// The bridge.
#[derive(Debug)]
pub struct IngressBridge {
    settings: IngressSettings,
    digest: u64,
    numbers: ChannelNumbers,
    channels: Box<[IngressChannel]>,
    /// Indices of the channels with incomplete messages.
    split: Vec<usize>,
    /// Messages given up, until the owner takes them.
    incomplete: VecDeque<Incomplete>,
    sessions: Sessions,
    replies: Replies,
    counts: IngressCounts,
    refusals: RefusalCounts,
}

/// What the bridge knows of one channel.
#[derive(Debug)]
struct IngressChannel {
    window: SequenceWindow,
    reassembler: Reassembler,
    /// The next message may skip any number: its session has just greeted.
    is_jump_allowed: bool,
    counts: IngressChannelCounts,
}

impl IngressChannel {
    fn new(identity: &ChannelIdentity, settings: &IngressSettings) -> Self {
        Self {
            window: SequenceWindow::new(),
            reassembler: Reassembler::new(
                settings.slot_count(identity.size_max_bytes as usize),
                identity.size_max_bytes as usize,
                settings.reassembly_timeout,
            ),
            is_jump_allowed: true,
            counts: IngressChannelCounts::default(),
        }
    }

    fn clear(&mut self) {
        self.reassembler.clear();
        self.window.finish();
    }
}

/// Puts what `reassembler` gave up of `channel` where the owner finds it.
fn collect(incomplete: &mut VecDeque<Incomplete>, reassembler: &mut Reassembler, channel: usize) {
    while let Some(given_up) = reassembler.next_given_up() {
        incomplete.push_back(Incomplete::of(channel, &given_up));
    }
}

/// A datagram on its way through the checks.
#[derive(Clone, Copy)]
struct Request<'a> {
    now: Instant,
    arrival: ArrivalStamps,
    length_bytes: usize,
    header: &'a Header,
}

impl IngressBridge {
    /// Sets everything aside; nothing allocates afterwards.
    ///
    /// # Errors
    /// [`SettingsError`] names the setting, its value and its bound.
    pub fn new(settings: IngressSettings) -> Result<Self, SettingsError> {
        settings.check()?;
        // All that can be given up between two questions of the owner.
        let incomplete_max = settings.flow.channels.len() * (settings.reassembly_slots + 1);
        Ok(Self {
            digest: settings.flow.digest(),
            numbers: ChannelNumbers::new(&settings.flow.channels),
            channels: settings
                .flow
                .channels
                .iter()
                .map(|identity| IngressChannel::new(identity, &settings))
                .collect(),
            split: Vec::with_capacity(settings.flow.channels.len()),
            incomplete: VecDeque::with_capacity(incomplete_max),
            sessions: Sessions::new(),
            replies: Replies::new(&settings),
            counts: IngressCounts::default(),
            refusals: RefusalCounts::default(),
            settings,
        })
    }

    /// Takes one datagram; its message, if it brings or completes one, goes to `deliver`.
    ///
    /// # Errors
    /// The datagram is refused and counted.
    pub fn on_datagram(
        &mut self,
        now: Instant,
        arrival: ArrivalStamps,
        bytes: &[u8],
        deliver: &mut dyn FnMut(Delivery<'_>),
    ) -> Result<Disposition, Refusal> {
        self.counts.datagram_count += 1;
        self.expire(now);
        let result = self.accept(now, arrival, bytes, deliver);
        match &result {
            Ok(disposition) => self.counts.count(disposition),
            Err(refusal) => self.refusals.count(*refusal),
        }
        result
    }

    /// The next reply to send. `now` becomes t3 and `handed_ns`; read the clock for each call.
    pub fn poll_transmit(&mut self, now: Instant) -> Option<Reply<'_>> {
        self.replies.next(now)
    }

    /// Whether [`IngressBridge::poll_transmit`] has something to give, without reading a clock.
    pub fn has_reply(&self) -> bool {
        self.replies.waiting_since().is_some()
    }

    /// The kernel's transmit stamp of a reply given earlier, minus the `now` it was polled with;
    /// it rides on the next response, as a refined t3.
    pub fn on_transmit_stamp(&mut self, kind: Kind, sequence: u64, handed_to_tx_ns: i64) {
        if kind == Kind::SyncResponse {
            self.replies.set_transmit_stamp(sequence, handed_to_tx_ns);
        }
    }

    /// When something changes without a datagram: a reply waits, or an incomplete message is to
    /// be given up.
    pub fn next_wakeup(&self) -> Option<Instant> {
        let split = self.split.iter();
        let expiries =
            split.filter_map(|&channel| self.channels[channel].reassembler.next_expiry());
        self.replies
            .waiting_since()
            .into_iter()
            .chain(expiries)
            .min()
    }

    /// Gives up incomplete messages whose time is up; call at [`IngressBridge::next_wakeup`].
    pub fn on_wakeup(&mut self, now: Instant) {
        self.expire(now);
    }

    /// Ends the accounting: outstanding gaps become losses and incomplete messages are given up.
    pub fn finish(&mut self) {
        self.clear_channels();
    }

    /// A message that was given up because some of its pieces did not come. Ask until `None` after every
    /// datagram and wake-up, and at the end.
    pub fn next_incomplete(&mut self) -> Option<Incomplete> {
        self.incomplete.pop_front()
    }

    /// Session that greeted last, if one has.
    pub fn session(&self) -> Option<u32> {
        self.sessions.current().map(|session| session.id)
    }

    /// When the last accepted datagram came; against `now` it tells a silent peer.
    pub fn last_heard(&self) -> Option<Instant> {
        self.sessions.current().map(|session| session.last_heard)
    }

    /// The session said farewell and nothing was heard of it since.
    pub fn has_left(&self) -> bool {
        self.sessions
            .current()
            .is_some_and(|session| session.has_left)
    }

    /// Both hosts read one monotonic clock, as the sender's greeting said; `None` before it.
    pub fn clock_is_shared(&self) -> Option<bool> {
        let session = self.sessions.current()?;
        Some(session.clock_id == self.settings.clock_id)
    }

    /// What became of the datagrams.
    pub const fn counts(&self) -> &IngressCounts {
        &self.counts
    }

    /// What became of the datagrams of the channel with index `channel`.
    ///
    /// # Panics
    /// When the flow has no such channel; so the three below.
    pub fn channel_counts(&self, channel: usize) -> &IngressChannelCounts {
        &self.channels[channel].counts
    }

    /// What became of its messages.
    pub fn sequence_counts(&self, channel: usize) -> &SequenceCounts {
        self.channels[channel].window.counts()
    }

    /// Its messages that are missing now and may still come.
    pub fn outstanding_count(&self, channel: usize) -> u64 {
        self.channels[channel].window.outstanding_count()
    }

    /// What became of its messages that came in pieces.
    pub fn reassembly_counts(&self, channel: usize) -> &ReassemblyCounts {
        self.channels[channel].reassembler.counts()
    }

    /// What became of the replies.
    pub const fn reply_counts(&self) -> &ReplyCounts {
        self.replies.counts()
    }

    /// Datagrams refused, by reason.
    pub const fn refusals(&self) -> &RefusalCounts {
        &self.refusals
    }

    fn accept(
        &mut self,
        now: Instant,
        arrival: ArrivalStamps,
        bytes: &[u8],
        deliver: &mut dyn FnMut(Delivery<'_>),
    ) -> Result<Disposition, Refusal> {
        let datagram = wire::decode(bytes).inspect_err(|&refusal| {
            if refusal == Refusal::UnsupportedVersion {
                self.on_other_version(now, arrival, bytes);
            }
        })?;
        let request = Request {
            now,
            arrival,
            length_bytes: bytes.len(),
            header: &datagram.header,
        };
        match datagram.body {
            Body::Hello(hello) => return self.on_hello(request, &hello),
            Body::SyncResponse(_) | Body::HelloAck(_) | Body::PieceAck(_) => {
                return Err(Refusal::UnexpectedKind);
            }
            Body::Data(_) | Body::SyncRequest | Body::Bye => {}
        }
        let channel = self.check_session(request)?;
        let disposition = match (datagram.body, channel) {
            (Body::Data(payload), Some(channel)) => {
                let result = self.on_data(request, channel, payload, deliver);
                let counts = &mut self.channels[channel].counts;
                counts.datagram_count += 1;
                result.inspect(|disposition| counts.count(disposition))?
            }
            (Body::Bye, Some(channel)) => self.on_bye(request.header, channel),
            (Body::Bye, None) => Disposition::Farewell,
            (_, None) if request.header.kind == Kind::SyncRequest => self.on_sync_request(request),
            _ => return Err(Refusal::UnknownChannel),
        };
        let handed_ns = datagram.header.handed_ns;
        let has_left = disposition == Disposition::Farewell;
        self.sessions.heard(now, handed_ns, has_left);
        Ok(disposition)
    }

    /// Only the part of the header that no version changes can be read; enough to say so.
    /// Another version may greet for a channel.
    fn has(&self, number: u16) -> bool {
        number == self.settings.flow.flow || self.numbers.index_of(number).is_some()
    }

    fn on_other_version(&mut self, now: Instant, arrival: ArrivalStamps, bytes: &[u8]) {
        let Some(prefix) = Prefix::decode(bytes) else {
            return;
        };
        if prefix.kind == Some(Kind::Hello) && self.has(prefix.channel) {
            let header = Header::new(Kind::Hello, prefix.session, prefix.channel);
            let request = Request {
                now,
                arrival,
                length_bytes: bytes.len(),
                header: &header,
            };
            self.acknowledge(request, HelloStatus::VersionMismatch);
        }
    }

    fn on_hello(
        &mut self,
        request: Request<'_>,
        hello: &Hello<'_>,
    ) -> Result<Disposition, Refusal> {
        if let Err(refusal) = self.check_hello(request.header, hello) {
            let status = match refusal {
                Refusal::UnknownChannel => HelloStatus::UnknownFlow,
                Refusal::SharedDomain => HelloStatus::SharedDomain,
                _ => HelloStatus::ChannelsDiffer,
            };
            self.acknowledge(request, status);
            return Err(refusal);
        }
        if request.header.handed_ns < 0 {
            return Err(Refusal::ImplausibleStamp);
        }
        let greeting =
            self.sessions
                .greet(request.now, request.arrival, request.header, hello.clock_id)?;
        for channel in &mut self.channels {
            channel.is_jump_allowed = true;
        }
        if greeting.is_new {
            self.clear_channels();
            self.replies.forget_transmit_stamp();
        }
        self.counts.session_restart_count += u64::from(greeting.is_restart);
        self.acknowledge(request, HelloStatus::Accepted);
        Ok(Disposition::Greeted {
            is_restart: greeting.is_restart,
        })
    }

    fn check_hello(&self, header: &Header, hello: &Hello<'_>) -> Result<(), Refusal> {
        let own = &self.settings.flow;
        if header.channel != own.flow || hello.flow_name != own.name {
            return Err(Refusal::UnknownChannel);
        }
        if hello.domain == self.settings.domain {
            return Err(Refusal::SharedDomain);
        }
        let is_count_equal = usize::from(hello.channel_count) == own.channels.len();
        if !is_count_equal || header.type_hash != self.digest {
            return Err(Refusal::ChannelsDiffer);
        }
        Ok(())
    }

    /// Gives up incomplete messages whose time is up.
    fn expire(&mut self, now: Instant) {
        let (channels, incomplete) = (&mut self.channels, &mut self.incomplete);
        self.split.retain(|&channel| {
            let reassembler = &mut channels[channel].reassembler;
            reassembler.expire(now);
            collect(incomplete, reassembler, channel);
            reassembler.open_count() > 0
        });
    }

    fn clear_channels(&mut self) {
        for (index, channel) in self.channels.iter_mut().enumerate() {
            channel.clear();
            collect(&mut self.incomplete, &mut channel.reassembler, index);
        }
        self.split.clear();
    }

    fn acknowledge(&mut self, request: Request<'_>, status: HelloStatus) {
        self.replies.acknowledge(&AckRequest {
            now: request.now,
            status,
            session: request.header.session,
            flow: self.settings.flow.flow,
            sequence: request.header.sequence,
            answers_handed_ns: request.header.handed_ns,
            request_bytes: request.length_bytes,
            destination: request.arrival.peer,
        });
    }

    /// The index of the channel that the datagram is about; `None` when it is about the flow.
    fn check_session(&mut self, request: Request<'_>) -> Result<Option<usize>, Refusal> {
        let header = request.header;
        let channel = self.numbers.index_of(header.channel);
        if channel.is_none() && header.channel != self.settings.flow.flow {
            return Err(Refusal::UnknownChannel);
        }
        let result = self.sessions.check(request.arrival, header);
        if result == Err(Refusal::UnknownSession) {
            self.acknowledge(request, HelloStatus::GreetAgain);
        }
        result?;
        let type_hash = match channel {
            Some(index) => self.settings.flow.channels[index].type_hash,
            None => self.digest,
        };
        if header.type_hash == type_hash {
            Ok(channel)
        } else {
            Err(Refusal::TypeMismatch)
        }
    }

    fn on_data(
        &mut self,
        request: Request<'_>,
        channel: usize,
        payload: &[u8],
        deliver: &mut dyn FnMut(Delivery<'_>),
    ) -> Result<Disposition, Refusal> {
        let header = request.header;
        let identity = &self.settings.flow.channels[channel];
        match header.total_len.cmp(&identity.size_max_bytes) {
            Ordering::Greater => return Err(Refusal::Oversize),
            // Nobody could take it.
            Ordering::Less if header.total_len == 0 || !may_be_shorter(&identity.type_name) => {
                return Err(Refusal::LengthMismatch);
            }
            Ordering::Less | Ordering::Equal => {}
        }
        self.sessions.check_stamps(request.arrival, header)?;
        let stream = stream_of(header);
        let own = &mut self.channels[channel];
        let order = own.window.peek(stream, header.sequence, header.handed_ns);
        if let Order::InOrder { gap } = order
            && gap > SEQUENCE_JUMP_MAX
            && !own.is_jump_allowed
        {
            self.acknowledge(request, HelloStatus::GreetAgain);
            return Err(Refusal::ImplausibleSequence);
        }
        let deliver_reordered = self.settings.deliver_reordered;
        if header.fragment_count == 1 {
            own.is_jump_allowed = false;
            let message = message_of(channel, header, header.handed_ns);
            let window = &mut own.window;
            let order = window.record(stream, header.sequence, header.handed_ns);
            let delivery = delivery_of(header, message, payload, order);
            return Ok(delivery.dispose(deliver_reordered, deliver));
        }
        match order {
            Order::Duplicate => return Err(Refusal::DuplicateFragment),
            Order::Late => return Err(Refusal::Stale),
            Order::InOrder { .. } | Order::Reordered => {}
        }
        let fragment = Fragment {
            stream,
            sequence: header.sequence,
            total_len: header.total_len,
            index: header.fragment_index,
            count: header.fragment_count,
            published_ns: header.published_ns,
            handed_ns: header.handed_ns,
            payload,
        };
        let inserted = own.reassembler.insert(request.now, &fragment)?;
        if is_acknowledged(header) {
            self.replies.acknowledge_piece(&PieceRequest {
                now: request.now,
                session: header.session,
                sequence: header.sequence,
                answers_handed_ns: header.handed_ns,
                request_bytes: request.length_bytes,
                destination: request.arrival.peer,
            });
        }
        let Some(assembled) = inserted else {
            collect(&mut self.incomplete, &mut own.reassembler, channel);
            if !self.split.contains(&channel) {
                self.split.push(channel);
            }
            return Ok(Disposition::FragmentStored);
        };
        own.is_jump_allowed = false;
        let message = message_of(channel, header, assembled.handed_ns);
        let window = &mut own.window;
        let order = window.record(stream, header.sequence, header.handed_ns);
        let delivery = delivery_of(header, message, assembled.payload, order);
        Ok(delivery.dispose(deliver_reordered, deliver))
    }

    fn on_sync_request(&mut self, request: Request<'_>) -> Disposition {
        self.sessions.anchor(request.arrival, request.header);
        self.replies.answer(&SyncRequest {
            now: request.now,
            session: request.header.session,
            sequence: request.header.sequence,
            t1_ns: request.header.handed_ns,
            t2_ns: request.arrival.received_ns,
            t2_source: request.arrival.received_source,
            destination: request.arrival.peer,
        });
        Disposition::SyncRequested
    }

    fn on_bye(&mut self, header: &Header, channel: usize) -> Disposition {
        let stream = stream_of(header);
        let Some(last) = header.sequence.checked_sub(1) else {
            return Disposition::Farewell;
        };
        let window = &mut self.channels[channel].window;
        let order = window.peek(stream, last, header.handed_ns);
        if !matches!(order, Order::InOrder { gap } if gap > SEQUENCE_JUMP_MAX) {
            window.announce_end(stream, header.sequence);
        }
        Disposition::Farewell
    }
}
