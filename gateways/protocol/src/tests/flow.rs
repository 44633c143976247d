//! Many channels in one flow: what is theirs stays apart, and what is the flow's happens once.

use hil_core::message::Envelope;
use hil_core::time::Instant;

use super::network::{egress_settings, ingress_settings};
use crate::channel::{ChannelIdentity, FlowIdentity};
use crate::egress::{EgressBridge, EgressEvent, EgressSettings};
use crate::ingress::{Disposition, IngressBridge, IngressSettings};
use crate::refusal::Refusal;
use crate::stamps::ArrivalStamps;
use crate::wire::{HEADER_BYTES, Header, Kind};

const CHANNELS: u16 = 400;

/// Numbers from 7 on in steps of 3; every tenth has messages in pieces.
fn flow() -> FlowIdentity {
    let channel = |index: u16| {
        let size_bytes = if index.is_multiple_of(10) { 4_000 } else { 16 };
        let name = format!("robot-{index}/state");
        ChannelIdentity::new(7 + 3 * index, &name, "test.State.v1", size_bytes, 8)
    };
    FlowIdentity {
        flow: 65_534,
        name: "link/hop/forward".to_owned(),
        channels: (0..CHANNELS).map(channel).collect(),
    }
}

struct Pair {
    egress: EgressBridge,
    ingress: IngressBridge,
    now_ns: i64,
    /// Channel, epoch, sequence and first byte of each.
    delivered: Vec<(usize, u32, u64, u8)>,
    datagrams: Vec<(Kind, u16)>,
}

impl Pair {
    fn new() -> Self {
        Self {
            egress: EgressBridge::new(EgressSettings {
                flow: flow(),
                ..egress_settings(100, 0)
            })
            .unwrap(),
            ingress: IngressBridge::new(IngressSettings {
                flow: flow(),
                ..ingress_settings(200, 0)
            })
            .unwrap(),
            now_ns: 1_000_000,
            delivered: Vec::new(),
            datagrams: Vec::new(),
        }
    }

    /// Everything that is due goes over and is answered.
    fn exchange(&mut self) {
        self.now_ns += 1_000;
        let now = Instant::from_ns(self.now_ns);
        let arrival = ArrivalStamps::application(self.now_ns);
        while let Some(transmit) = self.egress.poll_transmit(now) {
            let header = Header::read(transmit.datagram).unwrap().0;
            self.datagrams.push((header.kind, header.channel));
            let datagram = transmit.datagram.to_vec();
            let delivered = &mut self.delivered;
            self.ingress
                .on_datagram(now, arrival, &datagram, &mut |one| {
                    let message = one.message;
                    delivered.push((
                        message.channel,
                        message.epoch,
                        message.sequence,
                        one.payload[0],
                    ));
                })
                .unwrap();
            while let Some(reply) = self.ingress.poll_transmit(now) {
                let reply = reply.datagram.to_vec();
                self.egress.on_datagram(now, arrival, &reply).unwrap();
            }
        }
    }

    fn publish(&mut self, channel: usize, epoch: u32, sequence: u64) {
        let envelope = Envelope {
            sequence,
            epoch,
            published_ns: self.now_ns,
            ..Envelope::default()
        };
        let size_bytes = flow().channels[channel].size_max_bytes as usize;
        let mark = u8::try_from(channel % 251).unwrap();
        let now = Instant::from_ns(self.now_ns);
        self.egress
            .on_local(now, channel, &envelope, &vec![mark; size_bytes])
            .unwrap();
        self.exchange();
    }
}

#[test]
fn four_hundred_channels_greet_once_and_each_counts_its_own_messages() {
    let mut pair = Pair::new();
    pair.exchange();
    let kinds: Vec<Kind> = pair.datagrams.iter().map(|(kind, _)| *kind).collect();
    assert_eq!(kinds, [Kind::Hello, Kind::SyncRequest]);
    let channels = usize::from(CHANNELS);
    let mut expected = Vec::new();
    for round in 0..5 {
        for channel in 0..channels {
            // Each channel starts at a number of its own, and every seventh loses one in between.
            let gap = u64::from(round > 2 && channel % 7 == 0);
            let sequence = channel as u64 + round + gap;
            pair.publish(channel, 1, sequence);
            expected.push((channel, 1, sequence, u8::try_from(channel % 251).unwrap()));
        }
    }
    assert_eq!(pair.delivered, expected);
    pair.egress.bye();
    pair.exchange();
    pair.ingress.finish();
    for channel in 0..channels {
        let counts = pair.ingress.sequence_counts(channel);
        let lost = u64::from(channel % 7 == 0);
        assert_eq!((counts.received_count, counts.lost_count), (5, lost));
        let sent = pair.egress.channel_counts(channel);
        assert_eq!((sent.sent_count, sent.refused_count()), (5, 0));
        let taken = pair.ingress.channel_counts(channel);
        let is_split = channel.is_multiple_of(10);
        assert_eq!(taken.datagram_count, if is_split { 15 } else { 5 });
        assert_eq!(
            sent.datagram_count,
            taken.datagram_count + 1,
            "the farewell"
        );
        let pieces = pair.ingress.reassembly_counts(channel);
        assert_eq!(pieces.completed_count, if is_split { 5 } else { 0 });
    }
    assert_eq!(pair.ingress.refusals().total(), 0);
    let last = pair.datagrams.last().unwrap();
    assert_eq!(*last, (Kind::Bye, 65_534), "the flow's own comes last");
    let byes = pair.datagrams.iter().filter(|one| one.0 == Kind::Bye);
    assert_eq!(byes.count(), channels + 1);
    assert!(pair.ingress.has_left());
}

#[test]
fn an_idle_channel_has_nothing_due() {
    let mut pair = Pair::new();
    pair.exchange();
    let started = pair.now_ns;
    let before = pair.datagrams.len();
    for _ in 0..50 {
        let due = pair.egress.next_wakeup().unwrap();
        pair.now_ns = due.as_ns();
        pair.exchange();
        assert_eq!(pair.ingress.next_wakeup(), None);
    }
    assert_eq!(pair.datagrams.len() - before, 50, "the clock exchanges");
    assert!(pair.now_ns - started >= 50 * 20_000_000 - 1_000_000);
}

#[test]
fn a_restart_of_one_producer_leaves_the_other_channels_alone() {
    let mut pair = Pair::new();
    pair.exchange();
    for sequence in 0..10 {
        pair.publish(1, 1, sequence);
        pair.publish(2, 1, sequence);
    }
    for sequence in 0..10 {
        pair.publish(1, 2, sequence);
        pair.publish(2, 1, 10 + sequence);
    }
    let counts = [1, 2].map(|channel| *pair.ingress.sequence_counts(channel));
    assert_eq!(counts.map(|one| one.restart_count), [1, 0]);
    assert_eq!(counts.map(|one| one.received_count), [20, 20]);
    assert_eq!(counts.map(|one| one.lost_count), [0, 0]);
}

#[test]
fn a_stamp_rides_on_the_next_message_of_its_own_channel() {
    let mut pair = Pair::new();
    pair.exchange();
    pair.publish(1, 1, 40);
    pair.egress.on_transmit_stamp(Kind::Data, Some(1), 40, 700);
    let follow_up = |pair: &mut Pair, channel: usize, sequence: u64| {
        let envelope = Envelope {
            sequence,
            epoch: 1,
            ..Envelope::default()
        };
        let now = Instant::from_ns(pair.now_ns);
        let staged = pair.egress.on_local(now, channel, &envelope, &[0; 16]);
        staged.unwrap();
        let datagram = pair.egress.poll_transmit(now).unwrap().datagram;
        Header::read(datagram).unwrap().0.follow_up
    };
    assert_eq!(follow_up(&mut pair, 2, 0), None);
    let field = follow_up(&mut pair, 1, 41).unwrap();
    assert_eq!((field.sequence(41), field.handed_to_tx_ns), (Some(40), 700));
}

#[test]
fn numbers_that_are_no_channels_and_exchanges_about_channels_are_refused() {
    let mut pair = Pair::new();
    pair.exchange();
    let now = Instant::from_ns(pair.now_ns);
    let arrival = ArrivalStamps::application(pair.now_ns);
    let mut offer = |kind: Kind, number: u16, type_hash: u64, body: &[u8]| {
        let mut header = Header::new(kind, 100, number);
        header.type_hash = type_hash;
        header.handed_ns = pair.now_ns;
        header.total_len = u32::try_from(body.len()).unwrap();
        let mut datagram = vec![0; HEADER_BYTES];
        header.encode(&mut datagram);
        datagram.extend_from_slice(body);
        let no_message = &mut |_: crate::Delivery<'_>| panic!("no message");
        pair.ingress
            .on_datagram(now, arrival, &datagram, no_message)
    };
    let of_seven = flow().channels[0].type_hash;
    let digest = flow().digest();
    let unknown = Err(Refusal::UnknownChannel);
    for number in [0, 6, 8, 7 + 3 * CHANNELS, 65_535] {
        assert_eq!(offer(Kind::Data, number, of_seven, &[0; 16]), unknown);
    }
    assert_eq!(offer(Kind::Data, 65_534, digest, &[0; 16]), unknown);
    assert_eq!(offer(Kind::SyncRequest, 7, of_seven, &[0; 40]), unknown);
    let other_type = Err(Refusal::TypeMismatch);
    assert_eq!(offer(Kind::Data, 10, of_seven, &[0; 16]), other_type);
    assert_eq!(
        offer(Kind::Bye, 65_534, digest, &[]),
        Ok(Disposition::Farewell)
    );
}

#[test]
fn the_answer_to_a_greeting_of_other_channels_is_no_acceptance() {
    let mut pair = Pair::new();
    let mut fewer = flow();
    fewer.channels.pop();
    pair.ingress = IngressBridge::new(IngressSettings {
        flow: fewer,
        ..ingress_settings(200, 0)
    })
    .unwrap();
    let now = Instant::from_ns(pair.now_ns);
    let arrival = ArrivalStamps::application(pair.now_ns);
    let hello = pair.egress.poll_transmit(now).unwrap().datagram.to_vec();
    let refused = pair.ingress.on_datagram(now, arrival, &hello, &mut |_| {});
    assert_eq!(refused, Err(Refusal::ChannelsDiffer));
    let reply = pair.ingress.poll_transmit(now).unwrap().datagram.to_vec();
    let event = pair.egress.on_datagram(now, arrival, &reply);
    assert!(matches!(event, Ok(EgressEvent::Refused(_))), "{event:?}");
}
