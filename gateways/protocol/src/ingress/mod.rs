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
mod destination;
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
use super::fragment::{Reassembler, ReassemblyCounts};
use super::refusal::{Refusal, RefusalCounts};
use super::sequence::{Order, SequenceCounts, SequenceWindow};
use super::stamps::ArrivalStamps;
use super::wire::{self, Body, Header, Kind, Prefix};

pub use delivery::{
    Delivery, Disposition, Incomplete, IngressChannelCounts, IngressCounts, MessageInfo,
};
pub use destination::{Destination, Payload, Piece};
pub use replies::ReplyCounts;

use delivery::{delivery_of, stream_of};
use replies::Replies;
use session::Sessions;

/// Shortest time between two replies that refuse, or ask for a greeting.
pub const REFUSAL_REPLY_PERIOD: Duration = Duration::from_millis(10);

/// A message that skips more numbers than this is refused until its sender greets again.
pub const SEQUENCE_JUMP_MAX: u64 = 1 << 20;

/// How long after its last piece a message is given up: longer than a stall of TCP of two timeouts, or of a radio.
pub(crate) const REASSEMBLY_TIMEOUT: Duration = Duration::from_secs(1);

/// Messages of a channel of `size_bytes` that may be incomplete at a time, each of which needs memory; the oldest
/// gives way. Of long ones, of which a sender has one under way, it is the one and the remains of the one before.
pub const fn reassembly_slots(size_bytes: usize) -> usize {
    if size_bytes > STAGED_BYTES_MAX { 2 } else { 4 }
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
}

impl IngressSettings {
    /// Of one flow.
    pub fn new(flow: FlowIdentity, session: u32, domain: [u8; 16], clock_id: u64) -> Self {
        Self {
            flow,
            session,
            domain,
            clock_id,
        }
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
    fn new(index: usize, identity: &ChannelIdentity) -> Self {
        let size_bytes = identity.size_max_bytes as usize;
        let slot_count = reassembly_slots(size_bytes);
        Self {
            window: SequenceWindow::new(),
            reassembler: Reassembler::new(index, slot_count, size_bytes, REASSEMBLY_TIMEOUT),
            is_jump_allowed: true,
            counts: IngressChannelCounts::default(),
        }
    }

    fn clear(&mut self) {
        self.reassembler.clear();
        self.window.finish();
    }
}

/// Puts what `reassembler` gave up where the owner finds it.
fn collect(incomplete: &mut VecDeque<Incomplete>, reassembler: &mut Reassembler) {
    while let Some(given_up) = reassembler.next_given_up() {
        incomplete.push_back(given_up);
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
        settings.flow.check()?;
        // All that can be given up between two questions of the owner.
        let channels = settings.flow.channels.iter();
        let slots = channels.map(|one| reassembly_slots(one.size_max_bytes as usize) + 1);
        let incomplete_max: usize = slots.sum();
        Ok(Self {
            digest: settings.flow.digest(),
            numbers: ChannelNumbers::new(&settings.flow.channels),
            channels: settings
                .flow
                .channels
                .iter()
                .enumerate()
                .map(|(index, identity)| IngressChannel::new(index, identity))
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

    /// Takes one datagram; its message or its piece of one goes to `destination`.
    ///
    /// # Errors
    /// The datagram is refused and counted.
    pub fn on_datagram(
        &mut self,
        now: Instant,
        arrival: ArrivalStamps,
        bytes: &[u8],
        destination: &mut dyn Destination,
    ) -> Result<Disposition, Refusal> {
        self.counts.datagram_count += 1;
        self.expire(now);
        let result = self.accept(now, arrival, bytes, destination);
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

    /// The session said farewell and nothing was heard of it since.
    pub fn has_left(&self) -> bool {
        self.sessions
            .current()
            .is_some_and(|session| session.has_left)
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
        destination: &mut dyn Destination,
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
                let result = self.on_data(request, channel, payload, destination);
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
            self.replies
                .acknowledge(request, HelloStatus::VersionMismatch);
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
            self.replies.acknowledge(request, status);
            return Err(refusal);
        }
        if request.header.handed_ns < 0 {
            return Err(Refusal::ImplausibleStamp);
        }
        let greeting = self
            .sessions
            .greet(request.now, request.arrival, request.header)?;
        for channel in &mut self.channels {
            channel.is_jump_allowed = true;
        }
        if greeting.is_new {
            self.clear_channels();
            self.replies.forget_transmit_stamp();
        }
        self.counts.session_restart_count += u64::from(greeting.is_restart);
        self.replies.acknowledge(request, HelloStatus::Accepted);
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
            collect(incomplete, reassembler);
            reassembler.open_count() > 0
        });
    }

    fn clear_channels(&mut self) {
        for channel in &mut self.channels {
            channel.clear();
            collect(&mut self.incomplete, &mut channel.reassembler);
        }
        self.split.clear();
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
            self.replies.acknowledge(request, HelloStatus::GreetAgain);
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
        destination: &mut dyn Destination,
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
            self.replies.acknowledge(request, HelloStatus::GreetAgain);
            return Err(Refusal::ImplausibleSequence);
        }
        if header.fragment_count == 1 {
            own.is_jump_allowed = false;
            let message = MessageInfo::of(channel, header);
            let window = &mut own.window;
            let order = window.record(stream, header.sequence, header.handed_ns);
            let delivery = delivery_of(header, message, order);
            let payload = Payload::Datagram(payload);
            return Ok(delivery.dispose(payload, destination));
        }
        match order {
            Order::Duplicate => return Err(Refusal::DuplicateFragment),
            Order::Late => return Err(Refusal::Stale),
            Order::InOrder { .. } | Order::Reordered => {}
        }
        let place = own.reassembler.place(request.now, header, payload.len())?;
        collect(&mut self.incomplete, &mut own.reassembler);
        if place.is_first && !self.split.contains(&channel) {
            self.split.push(channel);
        }
        let slot = place.slot;
        let is_stored = destination.store(&Piece {
            channel,
            slot,
            is_first: place.is_first,
            offset_bytes: place.offset_bytes,
            payload,
        });
        if !is_stored {
            return Err(Refusal::NoMemory);
        }
        let whole = own.reassembler.stored(place);
        if is_acknowledged(header) {
            self.replies.acknowledge_piece(request);
        }
        let Some(assembled) = whole else {
            return Ok(Disposition::FragmentStored);
        };
        own.is_jump_allowed = false;
        let window = &mut own.window;
        let order = window.record(stream, header.sequence, header.handed_ns);
        let payload = Payload::Stored {
            slot,
            length_bytes: assembled.length_bytes,
        };
        let delivery = delivery_of(header, assembled.message, order);
        Ok(delivery.dispose(payload, destination))
    }

    fn on_sync_request(&mut self, request: Request<'_>) -> Disposition {
        self.sessions.anchor(request.arrival, request.header);
        self.replies.answer(request);
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
