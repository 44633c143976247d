//! Two bridges behind sealed transports: the bridges notice nothing but the peer.

use core::time::Duration;

use hil_core::message::Envelope;
use hil_core::time::Instant;

use super::*;
use crate::queue::{QueueReceiver, QueueSender, QueueSettings, queue_pair};
use hil_protocol::seal::{Association, Rotation, RunSecret, Suite};
use hil_protocol::wire::{HEADER_BYTES, Header};
use hil_protocol::{
    ArrivalStamps, ChannelIdentity, EgressBridge, EgressSettings, IngressBridge, IngressSettings,
    PeerState,
};

fn association() -> Association {
    Association {
        secret: RunSecret::new(&mut [9; 32]),
        suite: Suite::Aes256Gcm,
        channel: 3,
        channel_name: "arm/command".to_owned(),
    }
}

fn channel() -> ChannelIdentity {
    ChannelIdentity::new(3, "arm/command", "test.Command.v1", 3_000, 8)
}

fn egress_settings() -> EgressSettings {
    EgressSettings {
        channel: channel(),
        session: 100,
        domain: [1; 16],
        clock_id: 11,
        datagram_max_bytes: 1472,
        sync_period: Duration::from_millis(20),
    }
}

struct Hop {
    egress: EgressBridge,
    sender: SealedSender<QueueSender>,
    ingress: IngressBridge,
    receiver: SealedReceiver<QueueReceiver>,
    now: Instant,
    delivered: Vec<Vec<u8>>,
}

impl Hop {
    fn new() -> Self {
        let settings = QueueSettings::default();
        let (sender, receiver) = queue_pair(&settings);
        let known = association();
        let rotation = Rotation::default();
        Self {
            egress: EgressBridge::new(egress_settings()).unwrap(),
            sender: SealedSender::new(sender, Initiator::new(&known, [1; 16], rotation)),
            ingress: IngressBridge::new(IngressSettings::new(channel(), 200, [2; 16], 22)).unwrap(),
            receiver: SealedReceiver::new(
                receiver,
                Responder::new(&known, &[2; 32], rotation),
                settings.sender_address,
            ),
            now: Instant::from_ns(1_000_000_000),
            delivered: Vec::new(),
        }
    }

    fn step(&mut self) {
        self.now = self.now + Duration::from_millis(1);
        let (now, arrival) = (self.now, ArrivalStamps::application(self.now.as_ns()));
        let mut buffer = [0; 2_000];
        while let Some(transmit) = self.egress.poll_transmit(now) {
            self.sender.send(transmit.datagram).unwrap();
        }
        while let Some(received) = self.receiver.receive(now, &mut buffer).unwrap() {
            let delivered = &mut self.delivered;
            let bytes = &buffer[..received.length_bytes];
            let mut deliver =
                |one: hil_protocol::Delivery<'_>| delivered.push(one.payload.to_vec());
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
}

#[test]
fn a_conversation_with_pieces_exchanges_and_farewell_goes_through_whole() {
    let mut hop = Hop::new();
    let steps = (0..10).position(|_| {
        hop.step();
        hop.egress.peer_state() == PeerState::Established
    });
    assert!(steps.is_some_and(|steps| steps < 5), "{steps:?}");
    for sequence in 0..200_u64 {
        let envelope = Envelope {
            sequence,
            published_ns: hop.now.as_ns(),
            epoch: 1,
            ..Envelope::default()
        };
        let payload = vec![sequence.to_le_bytes()[0]; if sequence % 3 == 0 { 3_000 } else { 64 }];
        hop.egress.on_local(hop.now, &envelope, &payload).unwrap();
        hop.step();
        assert_eq!(hop.delivered.pop(), Some(payload));
    }
    hop.egress.bye();
    hop.step();
    assert!(hop.ingress.has_left());
    let sequences = hop.ingress.sequence_counts();
    assert_eq!((sequences.received_count, sequences.lost_count), (200, 0));
    assert!(hop.egress.counts().round_trip_count > 5);
    assert_eq!(
        hop.ingress.refusals().total() + hop.egress.refusals().total(),
        0
    );
    let counts = hop.receiver.seal_counts().unwrap();
    assert_eq!(counts.refused_total(), 0);
    assert_eq!(counts.opened_count, hop.ingress.counts().datagram_count);
    assert_eq!(counts.agreement_count, 1);
}

#[test]
fn a_stranger_is_refused_before_the_seal_and_a_copy_before_the_bridge() {
    let settings = QueueSettings::default();
    let (mut sender, receiver) = queue_pair(&settings);
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
    assert_eq!(counts.refused(SealRefusal::ForeignSource), 1);
}
