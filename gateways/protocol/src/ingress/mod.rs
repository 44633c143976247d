//! The receiving host's half of a channel: takes datagrams, delivers messages, and gives replies.
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

use core::net::SocketAddr;
use core::time::Duration;

use hil_core::time::Instant;

use super::body::{Hello, HelloStatus};
use super::channel::{ChannelIdentity, SettingsError};
use super::fragment::{Fragment, Reassembler, ReassemblyCounts};
use super::refusal::{Refusal, RefusalCounts};
use super::sequence::{Order, SequenceCounts, SequenceWindow};
use super::stamps::ArrivalStamps;
use super::wire::{self, Body, Header, Kind, Prefix};

pub use delivery::{Delivery, Disposition, FollowUp, IngressCounts, MessageInfo};
pub use replies::ReplyCounts;

use delivery::{delivery_of, message_of, stream_of};
use replies::{AckRequest, Replies, SyncRequest};
use session::Sessions;

/// Shortest time between two replies that refuse, or ask for a greeting.
pub const REFUSAL_REPLY_PERIOD: Duration = Duration::from_millis(10);

/// A message that skips more numbers than this is refused until its sender greets again.
pub const SEQUENCE_JUMP_MAX: u64 = 1 << 20;

/// Settings of an [`IngressBridge`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IngressSettings {
    /// The channel, as both hosts must see it.
    pub channel: ChannelIdentity,
    /// This gateway's start; must differ from its earlier ones.
    pub session: u32,
    /// Fingerprint of this host's shared-memory domain.
    pub domain: [u8; 16],
    /// Names this host's monotonic clock; equal ids on both hosts mean one clock.
    pub clock_id: u64,
    /// Incomplete messages held at a time; the oldest gives way.
    pub reassembly_slots: usize,
    /// An incomplete message older than this is given up; one period of the channel is a good
    /// value.
    pub reassembly_timeout: Duration,
    /// True to deliver a message that is new but older than one already delivered; false for
    /// newest-wins.
    pub deliver_reordered: bool,
}

impl IngressSettings {
    /// Four reassembly slots, 100 ms each, reordered messages delivered.
    pub fn new(channel: ChannelIdentity, session: u32, domain: [u8; 16], clock_id: u64) -> Self {
        Self {
            channel,
            session,
            domain,
            clock_id,
            reassembly_slots: 4,
            reassembly_timeout: Duration::from_millis(100),
            deliver_reordered: true,
        }
    }

    fn check(&self) -> Result<(), SettingsError> {
        self.channel.check()?;
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
    sessions: Sessions,
    window: SequenceWindow,
    reassembler: Reassembler,
    replies: Replies,
    /// The next message may skip any number: its session has just greeted.
    is_jump_allowed: bool,
    sync_received_count: u32,
    counts: IngressCounts,
    refusals: RefusalCounts,
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
        Ok(Self {
            sessions: Sessions::new(),
            window: SequenceWindow::new(),
            reassembler: Reassembler::new(
                settings.reassembly_slots,
                settings.channel.size_max_bytes as usize,
                settings.reassembly_timeout,
            ),
            replies: Replies::new(&settings),
            is_jump_allowed: true,
            sync_received_count: 0,
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
        self.reassembler.expire(now);
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
        let expiry = self.reassembler.next_expiry();
        self.replies.waiting_since().into_iter().chain(expiry).min()
    }

    /// Gives up incomplete messages whose time is up; call at [`IngressBridge::next_wakeup`].
    pub fn on_wakeup(&mut self, now: Instant) {
        self.reassembler.expire(now);
    }

    /// Ends the accounting: outstanding gaps become losses and incomplete messages are given up.
    pub fn finish(&mut self) {
        self.reassembler.clear();
        self.window.finish();
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

    /// What became of the messages.
    pub const fn sequence_counts(&self) -> &SequenceCounts {
        self.window.counts()
    }

    /// Messages missing now that may still come.
    pub fn outstanding_count(&self) -> u64 {
        self.window.outstanding_count()
    }

    /// What became of messages that came in pieces.
    pub const fn reassembly_counts(&self) -> &ReassemblyCounts {
        self.reassembler.counts()
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
            Body::SyncResponse(_) | Body::HelloAck(_) => return Err(Refusal::UnexpectedKind),
            Body::Data(_) | Body::SyncRequest | Body::Bye => {}
        }
        self.check_session(request)?;
        let disposition = match datagram.body {
            Body::Data(payload) => self.on_data(request, payload, deliver)?,
            Body::Bye => self.on_bye(request.header),
            _ => self.on_sync_request(request),
        };
        let handed_ns = datagram.header.handed_ns;
        let has_left = disposition == Disposition::Farewell;
        self.sessions.heard(now, handed_ns, has_left);
        Ok(disposition)
    }

    /// Only the part of the header that no version changes can be read; enough to say so.
    fn on_other_version(&mut self, now: Instant, arrival: ArrivalStamps, bytes: &[u8]) {
        let Some(prefix) = Prefix::decode(bytes) else {
            return;
        };
        if prefix.kind == Some(Kind::Hello) && prefix.channel == self.settings.channel.channel {
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
                Refusal::UnknownChannel => HelloStatus::UnknownChannel,
                Refusal::SharedDomain => HelloStatus::SharedDomain,
                Refusal::SizeMismatch => HelloStatus::SizeMismatch,
                _ => HelloStatus::TypeMismatch,
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
        self.is_jump_allowed = true;
        if greeting.is_new {
            self.window.finish();
            self.reassembler.clear();
            self.replies.forget_transmit_stamp();
            self.sync_received_count = 0;
        }
        self.counts.session_restart_count += u64::from(greeting.is_restart);
        self.acknowledge(request, HelloStatus::Accepted);
        Ok(Disposition::Greeted {
            is_restart: greeting.is_restart,
        })
    }

    fn check_hello(&self, header: &Header, hello: &Hello<'_>) -> Result<(), Refusal> {
        let own = &self.settings.channel;
        if header.channel != own.channel || hello.channel_name != own.channel_name {
            return Err(Refusal::UnknownChannel);
        }
        if hello.domain == self.settings.domain {
            return Err(Refusal::SharedDomain);
        }
        if hello.type_name != own.type_name {
            return Err(Refusal::TypeMismatch);
        }
        let size = (hello.size_max_bytes, hello.alignment_bytes);
        if size != (own.size_max_bytes, own.alignment_bytes) {
            return Err(Refusal::SizeMismatch);
        }
        if header.type_hash != own.type_hash {
            return Err(Refusal::TypeMismatch);
        }
        Ok(())
    }

    fn acknowledge(&mut self, request: Request<'_>, status: HelloStatus) {
        self.replies.acknowledge(&AckRequest {
            now: request.now,
            status,
            session: request.header.session,
            channel: request.header.channel,
            sequence: request.header.sequence,
            answers_handed_ns: request.header.handed_ns,
            request_bytes: request.length_bytes,
            destination: request.arrival.peer,
        });
    }

    fn check_session(&mut self, request: Request<'_>) -> Result<(), Refusal> {
        let header = request.header;
        if header.channel != self.settings.channel.channel {
            return Err(Refusal::UnknownChannel);
        }
        let result = self.sessions.check(request.arrival, header);
        if result == Err(Refusal::UnknownSession) {
            self.acknowledge(request, HelloStatus::GreetAgain);
        }
        result?;
        if header.type_hash == self.settings.channel.type_hash {
            Ok(())
        } else {
            Err(Refusal::TypeMismatch)
        }
    }

    fn on_data(
        &mut self,
        request: Request<'_>,
        payload: &[u8],
        deliver: &mut dyn FnMut(Delivery<'_>),
    ) -> Result<Disposition, Refusal> {
        let header = request.header;
        if header.total_len > self.settings.channel.size_max_bytes {
            return Err(Refusal::Oversize);
        }
        self.sessions.check_stamps(request.arrival, header)?;
        let stream = stream_of(header);
        let order = self.window.peek(stream, header.sequence, header.handed_ns);
        if let Order::InOrder { gap } = order
            && gap > SEQUENCE_JUMP_MAX
            && !self.is_jump_allowed
        {
            self.acknowledge(request, HelloStatus::GreetAgain);
            return Err(Refusal::ImplausibleSequence);
        }
        if header.fragment_count == 1 {
            let window = &mut self.window;
            self.is_jump_allowed = false;
            let message = message_of(header, header.handed_ns);
            let order = window.record(stream, header.sequence, header.handed_ns);
            let delivery = delivery_of(header, message, payload, order);
            return Ok(delivery.dispose(self.settings.deliver_reordered, deliver));
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
            handed_ns: header.handed_ns,
            payload,
        };
        let Some(assembled) = self.reassembler.insert(request.now, &fragment)? else {
            return Ok(Disposition::FragmentStored);
        };
        self.is_jump_allowed = false;
        let message = message_of(header, assembled.handed_ns);
        let order = self
            .window
            .record(stream, header.sequence, header.handed_ns);
        let delivery = delivery_of(header, message, assembled.payload, order);
        Ok(delivery.dispose(self.settings.deliver_reordered, deliver))
    }

    fn on_sync_request(&mut self, request: Request<'_>) -> Disposition {
        self.sync_received_count = self.sync_received_count.wrapping_add(1);
        self.sessions.anchor(request.arrival, request.header);
        self.replies.answer(&SyncRequest {
            now: request.now,
            session: request.header.session,
            sequence: request.header.sequence,
            t1_ns: request.header.handed_ns,
            t2_ns: request.arrival.received_ns,
            t2_source: request.arrival.received_source,
            window: self.window.received_window(),
            sync_received_count: self.sync_received_count,
            destination: request.arrival.peer,
        });
        Disposition::SyncRequested
    }

    fn on_bye(&mut self, header: &Header) -> Disposition {
        let stream = stream_of(header);
        let Some(last) = header.sequence.checked_sub(1) else {
            return Disposition::Farewell;
        };
        let order = self.window.peek(stream, last, header.handed_ns);
        if !matches!(order, Order::InOrder { gap } if gap > SEQUENCE_JUMP_MAX) {
            self.window.announce_end(stream, header.sequence);
        }
        Disposition::Farewell
    }
}
