//! Two bridges behind sealed transports: the bridges notice nothing but the peer.

use core::time::Duration;
use std::net::{Ipv4Addr, SocketAddr};

use hil_core::time::Instant;

use super::*;
use crate::conformance_tests::opened;
use crate::queue::{self, queue_pair};
use crate::registry;
use hil_net::clock_pair::monotonic_now;
use hil_net::timestamping::TimestampMode;
use hil_protocol::lab::{Arrived, Lab, Medium, Way};
use hil_protocol::seal::{Association, Rotation, RunSecret, Suite};
use hil_protocol::wire::{HEADER_BYTES, Header};
use hil_protocol::{ArrivalStamps, ChannelIdentity, FlowIdentity, PeerState};

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

/// Both ends of a transport between two bridges.
#[derive(Debug)]
struct Ends {
    sender: Box<dyn DatagramSender>,
    receiver: Box<dyn DatagramReceiver>,
    source: Option<SocketAddr>,
}

impl Medium for Ends {
    fn send(&mut self, way: Way, _now: Instant, datagram: &[u8]) {
        match way {
            Way::There => {
                self.sender.send(datagram).unwrap();
                while self.sender.next_stamp().is_some() {}
            }
            Way::Back => self.receiver.reply(datagram, self.source.unwrap()).unwrap(),
        }
    }

    fn receive(&mut self, way: Way, now: Instant) -> Option<Arrived> {
        let mut buffer = [0; 2_000];
        let received = match way {
            Way::There => self.receiver.receive(now, &mut buffer),
            Way::Back => self.sender.receive(&mut buffer),
        };
        let received = received.unwrap()?;
        if way == Way::There {
            self.source = Some(received.source);
        }
        Some(Arrived {
            stamps: ArrivalStamps::application(now.as_ns()),
            bytes: buffer[..received.length_bytes].to_vec(),
        })
    }
}

/// Steps until `is_reached`: in the machine's time, or in one of its own.
#[allow(
    clippy::disallowed_methods,
    reason = "a test may step aside while a datagram is on its way"
)]
fn step_until(lab: &mut Lab<Ends>, is_real: bool, is_reached: impl Fn(&Lab<Ends>) -> bool) {
    // As often as a slow machine needs.
    let step_count_max = if is_real { 10_000 } else { 5 };
    let reached = (0..step_count_max).any(|_| {
        if is_real {
            std::thread::sleep(Duration::from_millis(1));
            let now = monotonic_now().unwrap();
            lab.now_ns = now.as_ns();
            lab.medium.sender.attend(now);
            lab.medium.receiver.attend(now);
        } else {
            lab.now_ns += 1_000_000;
        }
        lab.exchange();
        is_reached(lab)
    });
    assert!(reached, "{:?}", lab.medium);
}

fn check_conversation(
    sender: Box<dyn DatagramSender>,
    receiver: Box<dyn DatagramReceiver>,
    is_real: bool,
) {
    let ends = Ends {
        sender,
        receiver,
        source: None,
    };
    let mut lab = Lab::over(&flow(), ends);
    lab.offset_ns = 0;
    step_until(&mut lab, is_real, |lab| {
        lab.egress.peer_state() == PeerState::Established
    });
    for sequence in 0..200_u64 {
        let (channel, size_bytes) = if sequence % 3 == 0 {
            (0, 3_000)
        } else {
            (1, 64)
        };
        let payload = vec![sequence.to_le_bytes()[0]; size_bytes];
        lab.offer(channel, 1, sequence, &payload).unwrap();
        step_until(&mut lab, is_real, |lab| !lab.delivered.is_empty());
        assert_eq!(lab.delivered.pop().unwrap().payload, payload);
    }
    lab.egress.bye();
    step_until(&mut lab, is_real, |lab| lab.ingress.has_left());
    let taken_count = [0, 1].map(|channel| lab.ingress.sequence_counts(channel).received_count);
    assert_eq!(taken_count, [67, 133]);
    assert!(lab.egress.counts().round_trip_count > 5);
    assert_eq!(
        lab.ingress.refusals().total() + lab.egress.refusals().total(),
        0
    );
    let counts = lab.medium.receiver.seal_counts().unwrap();
    assert_eq!(counts.refused.total(), 0);
    assert_eq!(counts.opened_count, lab.ingress.counts().datagram_count);
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
    check_conversation(
        super::sender(sender, Some(initiator)),
        super::receiver(receiver, queue::SENDER, Some(responder)),
        false,
    );
}

#[test]
fn every_transport_carries_a_sealed_conversation() {
    for transport in registry::ALL {
        let (initiator, responder) = keys();
        let (ip, mode) = (Ipv4Addr::LOCALHOST.into(), TimestampMode::Off);
        let opened = opened(transport, ip, mode, Some(initiator), Some(responder));
        if let Some((sender, receiver)) = opened {
            check_conversation(sender.sender, receiver.receiver, true);
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
