//! Two bridges that work as they should, over networks that do not.

use core::time::Duration;

use hil_core::message::Envelope;
use hil_core::time::{Alignment, Instant};

use crate::body::HelloStatus;
use crate::channel::{ChannelIdentity, FlowIdentity, SettingsError};
use crate::egress::{EgressBridge, EgressEvent, LocalRefusal, PeerState, TransmitFailure};
use crate::ingress::{IngressBridge, IngressSettings};
use crate::lab::{
    Impairment, InMemory, Lab, OFFSET_NS, TX_NS, egress_settings, ingress_settings, rtt_ns,
};
use crate::refusal::Refusal;
use crate::sequence::Order;
use crate::stamps::{ArrivalStamps, StampSource};
use crate::wire::Kind;

const DELAY: Impairment = Impairment {
    delay_ns: 300_000,
    jitter_ns: 0,
    loss_ratio: 0.0,
    duplicate_ratio: 0.0,
};

#[test]
fn on_a_good_network_every_message_arrives_once_in_order_with_its_stamps() {
    let mut lab = Lab::new(1, 64, DELAY);
    lab.run_ms(2);
    assert_eq!(lab.egress.peer_state(), PeerState::Established);
    lab.publish_for_ms(500);
    assert_eq!(lab.delivered.len(), 500);
    for (sequence, delivered) in (0..).zip(&lab.delivered) {
        let message = delivered.message;
        assert_eq!(
            (message.sequence, message.epoch, message.session),
            (sequence, 1, 100)
        );
        assert_eq!(delivered.payload, Lab::payload(sequence, 64));
        assert_eq!(delivered.order, Order::InOrder { gap: 0 });
        let envelope = message.envelope(Instant::from_ns(42));
        assert!(envelope.is_forwarded());
        assert_eq!((envelope.sequence, envelope.epoch), (sequence, 1));
        assert_eq!(envelope.published_ns, message.published.as_ns());
        assert_eq!(envelope.forwarded_ns, 42);
        let waited = message.handed.as_ns() - message.published.as_ns();
        assert_eq!(waited, 2000);
        let expected = sequence.checked_sub(1).map(|earlier| (earlier, TX_NS));
        assert_eq!(delivered.follow_up, expected);
    }
    assert_eq!(lab.ingress.refusals().total(), 0);
    assert_eq!(lab.egress.refusals().total(), 0);
    assert_eq!(lab.egress.channel_counts(0).sent_count, 500);
}

#[test]
fn clock_exchanges_give_the_offset_and_improve_with_kernel_stamps() {
    let mut lab = Lab::new(1, 64, DELAY);
    lab.publish_for_ms(500);
    let mut earlier_count = 0;
    for event in &lab.events {
        let Ok(EgressEvent::RoundTrip {
            round_trip,
            earlier,
        }) = event
        else {
            continue;
        };
        assert_eq!(round_trip.t1_source, StampSource::KernelSoftware);
        assert_eq!(round_trip.t2_source, StampSource::KernelSoftware);
        assert_eq!(round_trip.t3_source, StampSource::Application);
        assert_eq!(
            round_trip.t2_ns + OFFSET_NS - round_trip.t1_ns,
            300_000 - TX_NS
        );
        assert_eq!(round_trip.t4_ns - OFFSET_NS - round_trip.t3_ns, 300_000);
        assert_eq!(rtt_ns(round_trip), 600_000 - TX_NS);
        if let Some(earlier) = earlier {
            assert!(earlier.sequence < round_trip.sequence);
            assert_eq!(earlier.t3_source, StampSource::KernelSoftware);
            assert_eq!(rtt_ns(earlier), 600_000 - 2 * TX_NS);
            earlier_count += 1;
        }
    }
    let round_trips = lab.egress.counts().round_trip_count;
    assert!(
        round_trips >= 24,
        "{round_trips} round trips in 500 ms at 20 ms"
    );
    assert_eq!(earlier_count, round_trips - 1);
}

#[test]
fn a_delivered_stamp_becomes_local_only_through_an_alignment() {
    let mut lab = Lab::new(1, 64, DELAY);
    lab.publish_for_ms(5);
    let alignment = Alignment {
        offset_ns: -OFFSET_NS,
        bound_ns: 0,
    };
    let handed = alignment.localise(lab.delivered[0].message.handed);
    assert!(handed < Instant::from_ns(lab.now_ns));
}

/// Runs 1.5 s at 1 kHz over a bad network and returns the lab with its account closed.
fn bad_network(seed: u64, payload_bytes: u32, impairment: Impairment) -> Lab {
    let mut lab = Lab::new(seed, payload_bytes, DELAY);
    // The first message must arrive for counting to start at 0.
    lab.run_ms(2);
    lab.publish_for_ms(2);
    lab.medium.there.impairment = impairment;
    lab.medium.back.impairment = impairment;
    lab.publish_for_ms(1500);
    lab.medium.there.impairment = DELAY;
    lab.publish_for_ms(2);
    lab.egress.bye();
    lab.run_ms(200);
    lab.ingress.finish();
    lab
}

#[test]
fn on_a_bad_network_every_message_sent_is_received_or_lost_and_none_delivered_twice() {
    for seed in 0..4 {
        for payload_bytes in [16, 64, 5000] {
            let impairment = Impairment {
                delay_ns: 200_000,
                jitter_ns: 4_000_000,
                loss_ratio: 0.05,
                duplicate_ratio: 0.05,
            };
            let lab = bad_network(seed, payload_bytes, impairment);
            let name = format!("seed {seed}, {payload_bytes} bytes");
            let counts = *lab.ingress.sequence_counts(0);
            let sent = lab.egress.channel_counts(0).sent_count;
            assert_eq!(sent, lab.next_sequence, "{name}");
            assert_eq!(counts.received_count + counts.lost_count, sent, "{name}");
            assert_eq!(counts.received_count, lab.delivered.len() as u64, "{name}");
            assert_eq!(counts.restart_count, 0, "{name}");
            assert!(
                counts.lost_count > 0 && counts.reordered_count > 0,
                "{name}"
            );
            let mut sequences: Vec<_> = lab
                .delivered
                .iter()
                .map(|delivered| delivered.message.sequence)
                .collect();
            for delivered in &lab.delivered {
                let message = delivered.message;
                let expected = Lab::payload(message.sequence, delivered.payload.len());
                assert_eq!(delivered.payload, expected, "{name}");
            }
            sequences.sort_unstable();
            sequences.dedup();
            assert_eq!(sequences.len(), lab.delivered.len(), "{name}");
            assert!(lab.ingress.has_left(), "{name}");
            if payload_bytes == 5000 {
                let reassembly = lab.ingress.reassembly_counts(0);
                assert!(reassembly.evicted_count + reassembly.timed_out_count > 0);
                assert_eq!(reassembly.completed_count, counts.received_count);
                assert!(lab.ingress.refusals().get(Refusal::DuplicateFragment) > 0);
            } else {
                assert!(counts.duplicate_count > 0, "{name}");
            }
        }
    }
}

#[test]
fn a_transmission_that_fails_is_counted_and_its_message_given_up() {
    let mut lab = Lab::new(1, 5000, DELAY);
    lab.run_ms(2);
    let now = lab.egress_now();
    let envelope = Envelope {
        published_ns: now.as_ns(),
        ..Envelope::default()
    };
    lab.egress.on_local(now, 0, &envelope, &[0; 5000]).unwrap();
    let first = lab.egress.poll_transmit(now).unwrap();
    assert_eq!((first.key.epoch, first.key.sequence), (Some(0), 0));
    assert!(!first.is_last_fragment);
    lab.egress.on_transmit_failed(now, TransmitFailure::Local);
    assert_eq!(lab.egress.poll_transmit(now), None);
    assert_eq!(lab.egress.peer_state(), PeerState::Established);
    let counts = lab.egress.channel_counts(0);
    assert_eq!((counts.sent_count, counts.message_failed_count), (0, 1));
    assert_eq!(counts.datagram_count, 0);
    assert_eq!(lab.egress.counts().transmit_failed_count, 1);
}

#[test]
fn a_farewell_that_could_not_be_sent_is_no_datagram_of_its_channel() {
    let mut lab = Lab::new(1, 64, DELAY);
    lab.run_ms(2);
    lab.publish().unwrap();
    lab.run_ms(1);
    let sent_count = lab.egress.channel_counts(0).datagram_count;
    lab.egress.bye();
    let now = lab.egress_now();
    let farewell = lab.egress.poll_transmit(now).unwrap();
    assert_eq!(farewell.key.kind, Kind::Bye);
    lab.egress
        .on_transmit_failed(now, TransmitFailure::PeerUnreachable);
    assert_eq!(lab.egress.channel_counts(0).datagram_count, sent_count);
}

#[test]
fn what_the_local_channel_may_not_send_is_refused_and_counted() {
    let mut lab = Lab::new(1, 64, DELAY);
    assert_eq!(lab.publish(), Err(LocalRefusal::PeerNotGreeted));
    lab.run_ms(2);
    let now = lab.egress_now();
    let mut envelope = Envelope::default();
    let too_big = LocalRefusal::TooBig {
        size_bytes: 65,
        size_max_bytes: 64,
    };
    assert_eq!(
        lab.egress.on_local(now, 0, &envelope, &[0; 65]),
        Err(too_big)
    );
    assert_eq!(lab.egress.on_local(now, 0, &envelope, &[0; 64]), Ok(()));
    let pending = Err(LocalRefusal::TransmissionPending);
    assert_eq!(lab.egress.on_local(now, 0, &envelope, &[0; 64]), pending);
    lab.drain_egress();
    envelope.flags = Envelope::FORWARDED;
    let forwarded = Err(LocalRefusal::Forwarded);
    assert_eq!(lab.egress.on_local(now, 0, &envelope, &[0; 64]), forwarded);
    lab.egress.bye();
    lab.run_ms(1);
    assert_eq!(lab.publish(), Err(LocalRefusal::Closed));
    assert_eq!(lab.egress.next_wakeup(), None);
    let counts = lab.egress.channel_counts(0);
    assert_eq!((counts.offered_count, counts.refused_count()), (6, 5));
}

/// The answer that `ingress` gives an egress bridge with default settings.
fn answer_of(ingress: &IngressSettings) -> (PeerState, Refusal) {
    let mut egress = EgressBridge::new(egress_settings(100, 64)).unwrap();
    let mut ingress = IngressBridge::new(ingress.clone()).unwrap();
    let now = Instant::from_ns(1_000_000);
    let arrival = ArrivalStamps::application(now.as_ns());
    let hello = egress.poll_transmit(now).unwrap().datagram.to_vec();
    let refusal = ingress.on_datagram(
        now,
        arrival,
        &hello,
        &mut InMemory::default().with(|_, _| panic!("no message")),
    );
    let reply = ingress.poll_transmit(now).unwrap().datagram.to_vec();
    assert!(reply.len() <= hello.len());
    let event = egress.on_datagram(now, arrival, &reply).unwrap();
    assert!(matches!(event, EgressEvent::Refused(_)));
    // Greetings are repeated, slowly, and nothing else is sent.
    assert_eq!(egress.next_wakeup(), Some(now + Duration::from_secs(1)));
    let staged = egress.on_local(now, 0, &Envelope::default(), &[0; 64]);
    assert_eq!(staged, Err(LocalRefusal::ChannelRefused));
    assert_eq!(ingress.session(), None);
    (egress.peer_state(), refusal.unwrap_err())
}

#[test]
fn each_disagreement_of_the_two_hosts_is_named() {
    let good = ingress_settings(200, 64);
    let mut other = good.clone();
    other.domain = [1; 16];
    let refused = |status| PeerState::Refused(status);
    let expected = (refused(HelloStatus::SharedDomain), Refusal::SharedDomain);
    assert_eq!(answer_of(&other), expected);
    let mut other = good.clone();
    other.flow.name = "link/hop/backward".to_owned();
    let expected = (refused(HelloStatus::UnknownFlow), Refusal::UnknownChannel);
    assert_eq!(answer_of(&other), expected);
    let expected = (
        refused(HelloStatus::ChannelsDiffer),
        Refusal::ChannelsDiffer,
    );
    let changes: [fn(&mut FlowIdentity); 8] = [
        |flow| flow.channels[0].channel_name = "arm/status".to_owned(),
        |flow| flow.channels[0].type_name = "test.Command.v2".to_owned(),
        |flow| flow.channels[0].channel = 4,
        |flow| flow.channels[0].type_hash ^= 1,
        |flow| flow.channels[0].size_max_bytes = 72,
        |flow| flow.channels[0].alignment_bytes = 4,
        |flow| flow.channels.clear(),
        |flow| {
            let second = ChannelIdentity::new(4, "arm/status", "test.Status.v1", 8, 8);
            flow.channels.push(second);
        },
    ];
    for change in changes {
        let mut other = good.clone();
        change(&mut other.flow);
        assert_eq!(answer_of(&other), expected, "{:?}", other.flow);
    }
}

#[test]
fn another_version_is_told_so_and_understood() {
    let mut egress = EgressBridge::new(egress_settings(100, 64)).unwrap();
    let mut ingress = IngressBridge::new(ingress_settings(200, 64)).unwrap();
    let now = Instant::from_ns(1_000_000);
    let arrival = ArrivalStamps::application(now.as_ns());
    let mut hello = egress.poll_transmit(now).unwrap().datagram.to_vec();
    hello[4] = 3;
    let refusal = ingress.on_datagram(
        now,
        arrival,
        &hello,
        &mut InMemory::default().with(|_, _| panic!("no message")),
    );
    assert_eq!(refusal, Err(Refusal::UnsupportedVersion));
    let mut reply = ingress.poll_transmit(now).unwrap().datagram.to_vec();
    assert_eq!(reply[72], HelloStatus::VersionMismatch as u8);
    // Seen by a gateway of this version, an answer in another one.
    reply[4] = 3;
    let event = egress.on_datagram(now, arrival, &reply);
    assert_eq!(event, Err(Refusal::UnsupportedVersion));
    let expected = PeerState::Refused(HelloStatus::VersionMismatch);
    assert_eq!(egress.peer_state(), expected);
}

#[test]
fn settings_out_of_bounds_are_named() {
    let mut settings = egress_settings(1, 64);
    settings.datagram_max_bytes = 144;
    let bound = 72 + 57 + 16;
    let expected = SettingsError::DatagramTooSmall { value: 144, bound };
    assert_eq!(EgressBridge::new(settings).unwrap_err(), expected);
    let mut settings = egress_settings(1, 1 << 26);
    settings.datagram_max_bytes = 1000;
    let expected = SettingsError::TooManyFragments {
        size_bytes: 1 << 26,
        fragments: 73_585,
        bound: 40_000,
    };
    assert_eq!(EgressBridge::new(settings).unwrap_err(), expected);
    let mut settings = ingress_settings(1, 64);
    settings.flow.channels[0].channel_name = "x".repeat(256);
    let expected = SettingsError::NameLength {
        key: "channel_name",
        bytes: 256,
    };
    assert_eq!(IngressBridge::new(settings).unwrap_err(), expected);
    let mut settings = ingress_settings(1, 64);
    settings.flow.flow = 3;
    let expected = SettingsError::NumberTwice { number: 3 };
    assert_eq!(IngressBridge::new(settings).unwrap_err(), expected);
}
