//! Two bridges behind sealed transports: the bridges notice nothing but the peer.

use core::time::Duration;
use std::net::Ipv4Addr;

use hil_core::message::Envelope;
use hil_core::time::Instant;

use super::*;
use crate::conformance_tests::opened;
use crate::queue::{self, queue_pair};
use crate::registry;
use hil_net::clock_pair::monotonic_now;
use hil_net::timestamping::TimestampMode;
use hil_protocol::seal::{Association, Rotation, RunSecret, Suite};
use hil_protocol::wire::{HEADER_BYTES, Header};
use hil_protocol::{
    ArrivalStamps, ChannelIdentity, EgressBridge, EgressSettings, FlowIdentity, InMemory,
    IngressBridge, IngressSettings, PeerState,
};

fn association() -> Association {
    Association {
        secret: RunSecret::new(&mut [9; 32]),
        suite: Suite::Aes256Gcm,
        flow: 65_535,
        flow_name: "link/hop/forward".to_owned(),
    }
}

fn flow() -> FlowIdentity {
    let long = ChannelIdentity::new(3, "arm/command", "test.Command.v1", 3_000, 8);
    let short = ChannelIdentity::new(4, "arm/state", "test.State.v1", 64, 8);
    FlowIdentity {
        flow: 65_535,
        name: "link/hop/forward".to_owned(),
        channels: vec![long, short],
    }
}

fn egress_settings() -> EgressSettings {
    EgressSettings {
        flow: flow(),
        session: 100,
        domain: [1; 16],
        clock_id: 11,
        datagram_max_bytes: 1472,
        sync_period: Duration::from_millis(20),
    }
}

struct Hop {
    egress: EgressBridge,
    sender: Box<dyn DatagramSender>,
    ingress: IngressBridge,
    memory: InMemory,
    receiver: Box<dyn DatagramReceiver>,
    /// The machine's time, or one of its own.
    is_real: bool,
    now: Instant,
    delivered: Vec<Vec<u8>>,
}

impl Hop {
    fn new(
        sender: Box<dyn DatagramSender>,
        receiver: Box<dyn DatagramReceiver>,
        is_real: bool,
    ) -> Self {
        Self {
            egress: EgressBridge::new(egress_settings()).unwrap(),
            sender,
            ingress: IngressBridge::new(IngressSettings::new(flow(), 200, [2; 16], 22)).unwrap(),
            memory: InMemory::default(),
            receiver,
            is_real,
            now: Instant::from_ns(1_000_000_000),
            delivered: Vec::new(),
        }
    }

    #[allow(
        clippy::disallowed_methods,
        reason = "a test may step aside while a datagram is on its way"
    )]
    fn step(&mut self) {
        let step = Duration::from_millis(1);
        if self.is_real {
            std::thread::sleep(step);
            self.now = monotonic_now().unwrap();
            self.sender.attend(self.now);
            self.receiver.attend(self.now);
        } else {
            self.now = self.now + step;
        }
        let (now, arrival) = (self.now, ArrivalStamps::application(self.now.as_ns()));
        let mut buffer = [0; 2_000];
        while let Some(transmit) = self.egress.poll_transmit(now) {
            self.sender.send(transmit.datagram).unwrap();
        }
        while self.sender.next_stamp().is_some() {}
        while let Some(received) = self.receiver.receive(now, &mut buffer).unwrap() {
            let delivered = &mut self.delivered;
            let bytes = &buffer[..received.length_bytes];
            let mut deliver = self
                .memory
                .with(|_, payload| delivered.push(payload.to_vec()));
            self.ingress
                .on_datagram(now, arrival, bytes, &mut deliver)
                .unwrap();
            while let Some(reply) = self.ingress.poll_transmit(now) {
                self.receiver
                    .reply(reply.datagram, received.source)
                    .unwrap();
            }
        }
        while let Some(received) = self.sender.receive(&mut buffer).unwrap() {
            let bytes = &buffer[..received.length_bytes];
            self.egress.on_datagram(now, arrival, bytes).unwrap();
        }
    }

    /// Steps until `is_reached`, at most as often as a slow machine needs.
    fn step_until(&mut self, is_reached: impl Fn(&Self) -> bool) {
        let step_count_max = if self.is_real { 10_000 } else { 5 };
        let reached = (0..step_count_max).any(|_| {
            self.step();
            is_reached(self)
        });
        assert!(reached, "{:?}", self.sender);
    }
}

fn check_conversation(mut hop: Hop) {
    hop.step_until(|hop| hop.egress.peer_state() == PeerState::Established);
    for sequence in 0..200_u64 {
        let envelope = Envelope {
            sequence,
            published_ns: hop.now.as_ns(),
            epoch: 1,
            ..Envelope::default()
        };
        let (channel, size_bytes) = if sequence % 3 == 0 {
            (0, 3_000)
        } else {
            (1, 64)
        };
        let payload = vec![sequence.to_le_bytes()[0]; size_bytes];
        hop.egress
            .on_local(hop.now, channel, &envelope, &payload)
            .unwrap();
        hop.step_until(|hop| !hop.delivered.is_empty());
        assert_eq!(hop.delivered.pop(), Some(payload));
    }
    hop.egress.bye();
    hop.step_until(|hop| hop.ingress.has_left());
    let received = [0, 1].map(|channel| hop.ingress.sequence_counts(channel).received_count);
    assert_eq!(received, [67, 133]);
    assert!(hop.egress.counts().round_trip_count > 5);
    assert_eq!(
        hop.ingress.refusals().total() + hop.egress.refusals().total(),
        0
    );
    let counts = hop.receiver.seal_counts().unwrap();
    assert_eq!(counts.refused.total(), 0);
    assert_eq!(counts.opened_count, hop.ingress.counts().datagram_count);
    assert_eq!(counts.agreement_count, 1);
}

fn keys() -> (Initiator, Responder) {
    let (known, rotation) = (association(), Rotation::default());
    (
        Initiator::new(&known, [1; 16], rotation),
        Responder::new(&known, &[2; 32], rotation),
    )
}

#[test]
fn a_conversation_with_pieces_exchanges_and_farewell_goes_through_whole() {
    let (sender, receiver) = queue_pair();
    let (initiator, responder) = keys();
    check_conversation(Hop::new(
        super::sender(sender, Some(initiator)),
        super::receiver(receiver, queue::SENDER, Some(responder)),
        false,
    ));
}

#[test]
fn every_transport_carries_a_sealed_conversation() {
    for transport in registry::ALL {
        let (initiator, responder) = keys();
        let (ip, mode) = (Ipv4Addr::LOCALHOST.into(), TimestampMode::Off);
        let opened = opened(transport, ip, mode, Some(initiator), Some(responder));
        if let Some((sender, receiver)) = opened {
            check_conversation(Hop::new(sender.sender, receiver.receiver, true));
        }
    }
}

#[test]
fn a_stranger_is_refused_before_the_seal_and_a_copy_before_the_bridge() {
    let (mut sender, receiver) = queue_pair();
    let known = association();
    let responder = Responder::new(&known, &[2; 32], Rotation::default());
    let elsewhere = "127.0.0.1:9".parse().unwrap();
    let mut receiver = SealedReceiver::new(receiver, responder, elsewhere);
    let mut hello = [5; HEADER_BYTES + 60];
    Header::new(Kind::Hello, 77, 3).encode(&mut hello);
    sender.send(&hello).unwrap();
    let mut buffer = [0; 2_000];
    assert!(
        receiver
            .receive(Instant::ZERO, &mut buffer)
            .unwrap()
            .is_none()
    );
    let counts = receiver.seal_counts().unwrap();
    assert_eq!(counts.refused.get(SealRefusal::ForeignSource), 1);
}
