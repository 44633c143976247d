//! The sending host's half of a channel: takes messages from the local channel, gives datagrams,
//! and takes replies. It owns no socket and no clock.
//!
//! The loop that owns it does, in this order: [`EgressBridge::on_local`] for a waiting message,
//! [`EgressBridge::poll_transmit`] until it gives nothing, [`EgressBridge::on_transmit_stamp`] for
//! transmit stamps, [`EgressBridge::on_datagram`] for replies, then it waits for a message, a
//! reply or [`EgressBridge::next_wakeup`].
//!
//! Silence of the peer does not stop messages: on a radio link a pause is what is being measured.
//! Only a peer that the network reports unreachable, or that asks for a greeting, stops them until
//! it has greeted back.

mod answer;
mod counts;
mod exchange;
mod settings;
mod staging;
mod transmit;

use core::net::SocketAddr;
use core::time::Duration;

use hil_core::message::Envelope;
use hil_core::time::{Instant, PeriodicTimer};

use super::body::{HelloStatus, ReceivedWindow};
use super::channel::SettingsError;
use super::refusal::{Refusal, RefusalCounts};
use super::stamps::ArrivalStamps;
use super::wire::{Header, Kind};

pub use counts::{EgressCounts, LocalRefusal};
pub use exchange::RoundTrip;
pub use settings::EgressSettings;

use exchange::Exchanges;
use staging::Staging;

/// Time between greetings while the peer has not answered or is down.
pub const HELLO_PERIOD: Duration = Duration::from_millis(50);
/// Time between greetings after the peer refused the channel: it may be restarted with other
/// settings, but soon is unlikely.
pub const HELLO_PERIOD_REFUSED: Duration = Duration::from_secs(1);

/// Where the conversation with the receiving gateway stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PeerState {
    /// Greeting, not answered yet.
    Greeting,
    /// The peer takes messages.
    Established,
    /// The network reported the peer unreachable.
    Down,
    /// The peer refused the channel; greetings go on slowly.
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
    /// What it is.
    pub kind: Kind,
    /// The header's sequence number; with `kind` the key for [`EgressBridge::on_transmit_stamp`].
    pub sequence: u64,
    /// Epoch and sequence of the message it carries.
    pub message: Option<(u32, u64)>,
    /// No further datagram of the same message follows.
    pub is_last_fragment: bool,
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
    /// The peer refused the channel.
    Refused(HelloStatus),
    /// The peer does not know this session; greeting starts again.
    GreetAgain,
    /// A clock exchange came back.
    RoundTrip {
        /// The exchange, with the stamps known now.
        round_trip: RoundTrip,
        /// An earlier exchange, now with the responder's kernel transmit stamp as t3.
        earlier: Option<RoundTrip>,
        /// What the peer received of the messages.
        window: Option<ReceivedWindow>,
        /// Requests the peer received in this session; wraps. Against
        /// [`EgressCounts::sync_sent_count`] it tells lost requests from lost responses.
        sync_received_count: u32,
    },
}

/// The bridge.
#[derive(Debug)]
pub struct EgressBridge {
    settings: EgressSettings,
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
    staging: Staging,
    control: Box<[u8]>,
    last_transmit: Option<LastTransmit>,
    last_message: Option<(u32, u64)>,
    farewell: Farewell,
    counts: EgressCounts,
    refusals: RefusalCounts,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct LastTransmit {
    kind: Kind,
    is_last_fragment: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Farewell {
    Open,
    Due,
    Said,
}

impl EgressBridge {
    /// Sets everything aside; nothing allocates afterwards.
    ///
    /// # Errors
    /// [`SettingsError`] names the setting, its value and its bound.
    pub fn new(settings: EgressSettings) -> Result<Self, SettingsError> {
        settings.check()?;
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
            staging: Staging::new(
                settings.channel.size_max_bytes as usize,
                settings.payload_budget_bytes(),
            ),
            control: vec![0; settings.control_bytes()].into_boxed_slice(),
            last_transmit: None,
            last_message: None,
            farewell: Farewell::Open,
            counts: EgressCounts::default(),
            refusals: RefusalCounts::default(),
            settings,
        })
    }

    /// Stages one message of the local channel; send it with [`EgressBridge::poll_transmit`]
    /// before staging the next.
    ///
    /// # Errors
    /// The message is refused and counted; it will not be sent.
    pub fn on_local(
        &mut self,
        now: Instant,
        envelope: &Envelope,
        payload: &[u8],
    ) -> Result<(), LocalRefusal> {
        self.counts.offered_count += 1;
        let result = self.check_local(envelope, payload);
        match result {
            Ok(()) => {
                if self
                    .last_message
                    .is_some_and(|(epoch, _)| epoch != envelope.epoch)
                {
                    // A follow-up names its message by sequence alone.
                    self.staging.forget_follow_up();
                }
                self.last_message = Some((envelope.epoch, envelope.sequence));
                let mut header = Header::new(
                    Kind::Data,
                    self.settings.session,
                    self.settings.channel.channel,
                );
                header.type_hash = self.settings.channel.type_hash;
                header.sequence = envelope.sequence;
                header.published_ns = envelope.published_ns;
                header.epoch = envelope.epoch;
                self.staging.stage(now, header, payload);
            }
            Err(refusal) => self.counts.refuse(refusal),
        }
        result
    }

    /// The next datagram to send: fragments of the staged message first, then what is due.
    /// `now` becomes its `handed_ns`; read the clock for each call.
    pub fn poll_transmit(&mut self, now: Instant) -> Option<Transmit<'_>> {
        if self.staging.is_pending() {
            return Some(self.transmit_data(now));
        }
        if self.farewell == Farewell::Due {
            self.farewell = Farewell::Said;
            return Some(self.transmit_bye(now));
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
        match self.last_transmit.take() {
            Some(LastTransmit {
                kind: Kind::Data,
                is_last_fragment,
            }) => {
                self.counts.message_failed_count += 1;
                if is_last_fragment {
                    self.counts.sent_count -= 1;
                } else {
                    self.staging.abandon();
                }
            }
            Some(LastTransmit {
                kind: Kind::SyncRequest,
                ..
            }) => self.counts.sync_sent_count -= 1,
            _ => {}
        }
        if failure == TransmitFailure::PeerUnreachable {
            self.on_peer_unreachable(now);
        }
    }

    /// The network reported the peer unreachable outside a send call (a receive call returned
    /// ECONNREFUSED). Messages are refused until the peer greets back.
    pub fn on_peer_unreachable(&mut self, now: Instant) {
        if self.staging.abandon() {
            self.counts.message_failed_count += 1;
        }
        if self.state != PeerState::Down {
            self.counts.peer_down_count += 1;
            self.greet_from(PeerState::Down, now + HELLO_PERIOD);
        }
    }

    /// The kernel's transmit stamp of a datagram given earlier: `handed_to_tx_ns` is that stamp
    /// minus the `now` it was polled with; for a fragmented message, the stamp of the last
    /// fragment minus the `now` of the first. It rides on the next message, or refines t1.
    pub fn on_transmit_stamp(&mut self, kind: Kind, sequence: u64, handed_to_tx_ns: i64) {
        let delta = u32::try_from(handed_to_tx_ns).unwrap_or(u32::MAX);
        if delta == u32::MAX {
            self.counts.transmit_stamp_implausible_count += 1;
            return;
        }
        match kind {
            Kind::Data if self.last_message.is_some_and(|(_, last)| sequence <= last) => {
                self.staging.set_follow_up(sequence, delta);
            }
            Kind::SyncRequest => self.exchanges.set_transmit_stamp(sequence, handed_to_tx_ns),
            _ => {}
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
                Farewell::Due
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
            (Farewell::Due, _) => Some(Instant::from_ns(i64::MIN)),
            (Farewell::Open, PeerState::Established) => self.sync_timer.next(),
            (Farewell::Open, _) => Some(self.hello_due),
        }
    }

    /// Where the conversation stands.
    pub const fn peer_state(&self) -> PeerState {
        self.state
    }

    /// When the last accepted reply came; against `now` it tells a silent peer.
    pub const fn last_heard(&self) -> Option<Instant> {
        self.last_heard
    }

    /// Both hosts read one monotonic clock, as the peer's latest greeting said; `None` before it.
    pub fn clock_is_shared(&self) -> Option<bool> {
        self.peer_clock_id.map(|id| id == self.settings.clock_id)
    }

    /// What became of messages, exchanges and replies.
    pub const fn counts(&self) -> &EgressCounts {
        &self.counts
    }

    /// Replies refused, by reason.
    pub const fn refusals(&self) -> &RefusalCounts {
        &self.refusals
    }

    fn check_local(&self, envelope: &Envelope, payload: &[u8]) -> Result<(), LocalRefusal> {
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
        let size_max_bytes = self.settings.channel.size_max_bytes as usize;
        if payload.len() > size_max_bytes {
            return Err(LocalRefusal::TooBig {
                size_bytes: payload.len(),
                size_max_bytes,
            });
        }
        if self.staging.is_pending() {
            return Err(LocalRefusal::TransmissionPending);
        }
        Ok(())
    }
}
