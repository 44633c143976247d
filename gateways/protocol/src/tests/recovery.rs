//! Gateways and producers that restart, peers that vanish and return, and datagrams of strangers.

use hil_core::time::Instant;

use crate::egress::{EgressBridge, LocalRefusal, PeerState, TransmitKey};
use crate::ingress::{Disposition, IngressBridge};
use crate::lab::{Impairment, InMemory, Lab, TX_NS, egress_settings, ingress_settings};
use crate::refusal::Refusal;
use crate::stamps::ArrivalStamps;
use crate::wire::Kind;

const DELAY: Impairment = Impairment {
    delay_ns: 300_000,
    jitter_ns: 0,
    loss_ratio: 0.0,
    duplicate_ratio: 0.0,
};

fn finish(lab: &mut Lab) {
    lab.run_ms(50);
    lab.ingress.finish();
}

#[test]
fn a_restarted_producer_is_a_restart_and_not_a_loss() {
    let mut lab = Lab::new(1, 64, DELAY);
    lab.run_ms(2);
    lab.publish_for_ms(300);
    lab.epoch = 2;
    lab.next_sequence = 0;
    lab.publish_for_ms(200);
    finish(&mut lab);
    let counts = lab.ingress.sequence_counts(0);
    assert_eq!((counts.received_count, counts.lost_count), (500, 0));
    assert_eq!(counts.restart_count, 1);
    // The stamp of the old producer's last message does not ride on the new one's first.
    assert_eq!(lab.delivered[300].follow_up, None);
}

#[test]
fn a_late_stamp_of_the_old_producer_rides_on_no_message_of_the_new_one() {
    let mut lab = Lab::new(1, 64, DELAY);
    lab.run_ms(2);
    lab.publish_for_ms(10);
    lab.epoch = 2;
    lab.next_sequence = 0;
    lab.publish_for_ms(5);
    let late = |epoch| TransmitKey {
        kind: Kind::Data,
        channel: Some(0),
        epoch: Some(epoch),
        sequence: 4,
    };
    lab.egress.on_transmit_stamp(late(1), 7 * TX_NS);
    lab.publish_for_ms(1);
    lab.egress.on_transmit_stamp(late(2), 7 * TX_NS);
    lab.publish_for_ms(1);
    finish(&mut lab);
    let ridden = |index: usize| lab.delivered[index].follow_up.map(|(_, delta_ns)| delta_ns);
    assert_eq!([ridden(15), ridden(16)], [Some(TX_NS), Some(7 * TX_NS)]);
}

#[test]
fn a_restarted_sending_gateway_is_a_restart_and_not_a_loss() {
    let mut lab = Lab::new(1, 64, DELAY);
    lab.run_ms(2);
    lab.publish_for_ms(300);
    lab.egress = EgressBridge::new(egress_settings(101, 64)).unwrap();
    lab.medium.egress_address = "10.0.0.1:4001".parse().unwrap();
    // What the producer publishes meanwhile is refused at the gateway.
    assert_eq!(lab.publish(), Err(LocalRefusal::PeerNotGreeted));
    lab.run_ms(2);
    lab.publish_for_ms(200);
    finish(&mut lab);
    let counts = lab.ingress.sequence_counts(0);
    assert_eq!((counts.received_count, counts.lost_count), (500, 0));
    assert_eq!(counts.restart_count, 1);
    assert_eq!(lab.ingress.counts().session_restart_count, 1);
    assert_eq!(lab.ingress.session(), Some(101));
}

#[test]
fn a_restarted_receiving_gateway_asks_for_a_greeting_and_goes_on() {
    for payload_bytes in [8, 64] {
        let mut lab = Lab::new(1, payload_bytes, DELAY);
        lab.run_ms(2);
        lab.publish_for_ms(100);
        lab.ingress = IngressBridge::new(ingress_settings(201, payload_bytes)).unwrap();
        lab.publish_for_ms(100);
        finish(&mut lab);
        assert_eq!(lab.egress.peer_state(), PeerState::Established);
        let counts = *lab.egress.counts();
        assert_eq!(
            (counts.greet_again_count, counts.peer_restart_count),
            (1, 1)
        );
        let refused = lab.ingress.refusals().get(Refusal::UnknownSession);
        // Messages of 8 bytes are too short to be answered; the next clock exchange is.
        assert!((1..=21).contains(&refused), "{refused} refused");
        let replies = lab.ingress.reply_counts();
        assert_eq!(replies.amplifying_count > 0, payload_bytes == 8);
        let received = lab.ingress.sequence_counts(0).received_count;
        assert!(received >= 75, "{received} received");
        assert_eq!(lab.ingress.sequence_counts(0).lost_count, 0);
    }
}

#[test]
fn a_vanished_peer_is_down_until_it_greets_back() {
    let mut lab = Lab::new(1, 64, DELAY);
    lab.run_ms(2);
    lab.publish_for_ms(100);
    lab.is_listening = false;
    lab.publish_for_ms(500);
    assert_eq!(lab.egress.peer_state(), PeerState::Down);
    let counts = *lab.egress.counts();
    assert_eq!(counts.peer_down_count, 1);
    let messages = lab.egress.channel_counts(0);
    assert_eq!(messages.message_failed_count, 1);
    assert_eq!(messages.refused_peer_down_count, 499);
    // Greetings go on every 50 ms.
    assert!((8..=11).contains(&(counts.hello_sent_count)), "{counts:?}");
    lab.is_listening = true;
    lab.run_ms(60);
    assert_eq!(lab.egress.peer_state(), PeerState::Established);
    lab.publish_for_ms(100);
    finish(&mut lab);
    let counts = *lab.ingress.sequence_counts(0);
    assert_eq!((counts.received_count, counts.lost_count), (200, 500));
    assert_eq!(counts.loss_burst_length_max, 500);
    assert_eq!(
        (counts.restart_count, lab.egress.counts().peer_restart_count),
        (0, 0)
    );
}

#[test]
fn a_silent_network_does_not_stop_messages() {
    let mut lab = Lab::new(1, 64, DELAY);
    lab.run_ms(2);
    lab.publish_for_ms(100);
    let (there, back) = (lab.medium.there.impairment, lab.medium.back.impairment);
    lab.medium.there.impairment.loss_ratio = 1.0;
    lab.medium.back.impairment.loss_ratio = 1.0;
    lab.publish_for_ms(5000);
    assert_eq!(lab.egress.peer_state(), PeerState::Established);
    let silent_ns = lab.egress_now().ns_since(lab.egress.last_heard().unwrap());
    assert!(silent_ns >= 4_900_000_000);
    lab.medium.there.impairment = there;
    lab.medium.back.impairment = back;
    lab.publish_for_ms(100);
    finish(&mut lab);
    let counts = *lab.ingress.sequence_counts(0);
    assert_eq!((counts.received_count, counts.lost_count), (200, 5000));
    assert_eq!(counts.loss_burst_length_max, 5000);
}

#[test]
fn a_delayed_greeting_or_message_of_an_old_session_is_stale() {
    let mut lab = Lab::new(1, 64, DELAY);
    let now = lab.egress_now();
    let arrival = ArrivalStamps::application(lab.now_ns);
    let ingress = &mut lab.ingress;
    let mut old = EgressBridge::new(egress_settings(100, 64)).unwrap();
    let mut new = EgressBridge::new(egress_settings(101, 64)).unwrap();
    let old_hello = old.poll_transmit(now).unwrap().datagram.to_vec();
    let new_hello = new.poll_transmit(now).unwrap().datagram.to_vec();
    let mut take = |bytes: &[u8]| {
        let now = Instant::from_ns(arrival.received_ns);
        ingress.on_datagram(
            now,
            arrival,
            bytes,
            &mut InMemory::default().with(|_, _| {}),
        )
    };
    assert_eq!(
        take(&old_hello),
        Ok(Disposition::Greeted { is_restart: false })
    );
    assert_eq!(
        take(&old_hello),
        Ok(Disposition::Greeted { is_restart: false })
    );
    assert_eq!(
        take(&new_hello),
        Ok(Disposition::Greeted { is_restart: true })
    );
    assert_eq!(take(&old_hello), Err(Refusal::Stale));
}

#[test]
fn a_session_replaced_by_mistake_comes_back() {
    let mut lab = Lab::new(1, 64, DELAY);
    lab.run_ms(2);
    lab.publish_for_ms(50);
    // A single forged greeting from the same host takes the channel over.
    let mut forger = EgressBridge::new(egress_settings(666, 64)).unwrap();
    let hello = forger
        .poll_transmit(lab.egress_now())
        .unwrap()
        .datagram
        .to_vec();
    let arrival = ArrivalStamps {
        peer: Some("10.0.0.1:4999".parse().unwrap()),
        ..ArrivalStamps::application(lab.now_ns)
    };
    let now = Instant::from_ns(lab.now_ns);
    let ingress = &mut lab.ingress;
    let taken = ingress.on_datagram(
        now,
        arrival,
        &hello,
        &mut InMemory::default().with(|_, _| {}),
    );
    assert_eq!(taken, Ok(Disposition::Greeted { is_restart: true }));
    lab.publish_for_ms(50);
    assert_eq!(lab.ingress.session(), Some(100));
    let received = lab.ingress.sequence_counts(0).received_count;
    assert!(received >= 95, "{received} received");
}

#[test]
fn another_host_neither_takes_over_a_live_session_nor_speaks_for_it() {
    let mut lab = Lab::new(1, 64, DELAY);
    lab.run_ms(2);
    let stranger = ArrivalStamps {
        peer: Some("10.0.0.9:4000".parse().unwrap()),
        ..ArrivalStamps::application(lab.now_ns)
    };
    let mut other = EgressBridge::new(egress_settings(666, 64)).unwrap();
    let hello = other
        .poll_transmit(lab.egress_now())
        .unwrap()
        .datagram
        .to_vec();
    let now = Instant::from_ns(lab.now_ns);
    let ingress = &mut lab.ingress;
    let refused = ingress.on_datagram(
        now,
        stranger,
        &hello,
        &mut InMemory::default().with(|_, _| {}),
    );
    assert_eq!(refused, Err(Refusal::ForeignSource));
    let later = Instant::from_ns(lab.now_ns + 3_000_000_000);
    let taken = ingress.on_datagram(
        later,
        stranger,
        &hello,
        &mut InMemory::default().with(|_, _| {}),
    );
    assert_eq!(taken, Ok(Disposition::Greeted { is_restart: true }));
    lab.publish().unwrap();
    lab.run_ms(1);
    // The first session's messages come from an address that no longer speaks.
    assert!(lab.delivered.is_empty());
}

#[test]
fn a_leap_of_the_sequence_asks_for_a_greeting_first() {
    let mut lab = Lab::new(1, 64, DELAY);
    lab.run_ms(2);
    lab.publish_for_ms(10);
    lab.next_sequence += 1 << 30;
    lab.publish_for_ms(20);
    let refused = lab.ingress.refusals().get(Refusal::ImplausibleSequence);
    assert!(refused >= 1);
    let received = lab.ingress.sequence_counts(0).received_count;
    assert_eq!(
        received + refused + lab.egress.channel_counts(0).refused_count(),
        30
    );
    assert!(received > 20);
}

#[test]
fn stamps_that_contradict_the_clock_are_refused_until_the_next_exchange() {
    let mut lab = Lab::new(1, 64, DELAY);
    lab.run_ms(2);
    lab.publish_for_ms(3);
    // The receiving host was suspended for five minutes: its clock stood still.
    let delivered = lab.delivered.len();
    lab.now_ns += 1_000_000;
    let transmit = |lab: &mut Lab, offset_ns: i64| {
        let now = Instant::from_ns(lab.egress_now().as_ns() + offset_ns);
        let envelope = hil_core::message::Envelope {
            sequence: lab.next_sequence,
            published_ns: now.as_ns(),
            epoch: 1,
            ..Default::default()
        };
        lab.next_sequence += 1;
        lab.egress.on_local(now, 0, &envelope, &[0; 64]).unwrap();
        let bytes = lab.egress.poll_transmit(now).unwrap().datagram.to_vec();
        let arrival = ArrivalStamps::application(lab.now_ns);
        let now = Instant::from_ns(lab.now_ns);
        let ingress = &mut lab.ingress;
        let result = ingress.on_datagram(
            now,
            arrival,
            &bytes,
            &mut InMemory::default().with(|_, _| {}),
        );
        result.map(|_| ())
    };
    let suspended_ns = 300_000_000_000;
    assert_eq!(
        transmit(&mut lab, suspended_ns),
        Err(Refusal::ImplausibleStamp)
    );
    assert_eq!(delivered, lab.delivered.len());
    let later = Instant::from_ns(lab.egress_now().as_ns() + suspended_ns);
    let sync = lab.egress.poll_transmit(later).unwrap().datagram.to_vec();
    let arrival = ArrivalStamps::application(lab.now_ns);
    let now = Instant::from_ns(lab.now_ns);
    let ingress = &mut lab.ingress;
    ingress
        .on_datagram(
            now,
            arrival,
            &sync,
            &mut InMemory::default().with(|_, _| {}),
        )
        .unwrap();
    assert_eq!(transmit(&mut lab, suspended_ns), Ok(()));
}
