//! How an egress bridge takes replies: greetings answered and clock exchanges. It sends nothing.

use hil_core::time::Instant;

use super::{EgressBridge, EgressEvent, HELLO_PERIOD_REFUSED, PeerState};
use crate::body::{HelloAck, HelloStatus, SyncResponse};
use crate::refusal::Refusal;
use crate::stamps::ArrivalStamps;
use crate::wire;
use crate::wire::{Body, Header, Kind, Prefix};

impl EgressBridge {
    pub(super) fn accept(
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
        if header.channel != self.settings.channel.channel {
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
            _ => Err(Refusal::UnexpectedKind),
        }
    }

    /// A greeting was answered in another version of the protocol: only the part of the header
    /// that no version changes can be read.
    fn on_other_version(&mut self, now: Instant, bytes: &[u8]) {
        let is_answer = Prefix::decode(bytes).is_some_and(|prefix| {
            prefix.kind == Some(Kind::HelloAck)
                && prefix.session == self.settings.session
                && prefix.channel == self.settings.channel.channel
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
            HelloStatus::Accepted => Ok(self.establish(now, arrival, ack)),
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

    /// Leaves for a state in which the peer is greeted, first at `due`.
    pub(super) fn greet_from(&mut self, state: PeerState, due: Instant) {
        if self.staging.abandon() {
            self.counts.message_failed_count += 1;
        }
        // Refused and Down keep listening to answers of greetings that are still under way.
        if self.state == PeerState::Established {
            self.round_started_ns = None;
        }
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
            window: response.window,
            sync_received_count: response.sync_received_count,
        })
    }
}
