//! Many channels in one flow: what is theirs stays apart, and what is the flow's happens once.

use hil_core::message::{ETHERNET_FRAME, Envelope};
use hil_core::time::Instant;

use super::network::{egress_settings, ingress_settings};
use crate::channel::{ChannelIdentity, FlowIdentity};
use crate::egress::{EgressBridge, EgressEvent, EgressSettings};
use crate::ingress::{Delivery, Disposition, IngressBridge, IngressSettings};
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
        Self::of(&flow())
    }

    fn of(flow: &FlowIdentity) -> Self {
        Self {
            egress: EgressBridge::new(EgressSettings {
                flow: flow.clone(),
                ..egress_settings(100, 0)
            })
            .unwrap(),
            ingress: IngressBridge::new(IngressSettings {
                flow: flow.clone(),
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
        let no_message = &mut |_: Delivery<'_>| panic!("no message");
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

/// A flow of a long channel and a short one, both established.
fn long_pair() -> (EgressBridge, IngressBridge) {
    let flow = FlowIdentity {
        flow: 65_535,
        name: "link/hop/forward".to_owned(),
        channels: vec![
            ChannelIdentity::new(0, "camera/image", "test.Image.v1", 4 << 20, 8),
            ChannelIdentity::new(1, "arm/command", "test.Command.v1", 16, 8),
        ],
    };
    let mut egress = EgressBridge::new(EgressSettings {
        flow: flow.clone(),
        ..egress_settings(100, 0)
    })
    .unwrap();
    let mut ingress = IngressBridge::new(IngressSettings {
        flow,
        ..ingress_settings(200, 0)
    })
    .unwrap();
    let now = Instant::from_ns(1_000_000);
    let arrival = ArrivalStamps::application(now.as_ns());
    let hello = egress.poll_transmit(now).unwrap().datagram.to_vec();
    ingress
        .on_datagram(now, arrival, &hello, &mut |_| {})
        .unwrap();
    let answer = ingress.poll_transmit(now).unwrap().datagram.to_vec();
    egress.on_datagram(now, arrival, &answer).unwrap();
    (egress, ingress)
}

/// Sends a long message with a short one after every hundredth piece, and loses the pieces that `is_lost`.
/// What was delivered: its channel and its bytes.
fn send_long(
    egress: &mut EgressBridge,
    ingress: &mut IngressBridge,
    image: &[u8],
    is_lost: impl Fn(usize) -> bool,
) -> Vec<(usize, Vec<u8>)> {
    let now = Instant::from_ns(2_000_000);
    let arrival = ArrivalStamps::application(now.as_ns());
    let mut delivered = Vec::new();
    let mut deliver = |one: Delivery<'_>| {
        delivered.push((one.message.channel, one.payload.to_vec()));
    };
    let envelope = Envelope::default();
    egress.begin_long(0, &envelope, image.len()).unwrap();
    let again = egress.begin_long(0, &envelope, image.len());
    assert_eq!(again, Err(crate::LocalRefusal::TransmissionPending));
    let mut piece_count = 0;
    let mut short_count = 0;
    // Acknowledgements are not delivered here, and nothing asks for them.
    while let Some(piece) = egress.long_piece(now, image) {
        let mut datagram = piece.head.to_vec();
        datagram.extend_from_slice(piece.tail);
        assert!(datagram.len() <= 1472 - 16);
        assert_eq!(
            egress.long_piece(now, image).unwrap().tail.len(),
            datagram.len() - HEADER_BYTES
        );
        if !is_lost(piece_count) {
            ingress
                .on_datagram(now, arrival, &datagram, &mut deliver)
                .unwrap();
        }
        egress.on_long_sent();
        piece_count += 1;
        if piece_count % 100 == 0 {
            let envelope = Envelope {
                sequence: short_count,
                ..Envelope::default()
            };
            short_count += 1;
            egress.on_local(now, 1, &envelope, &[5; 16]).unwrap();
            let short = egress.poll_transmit(now).unwrap().datagram.to_vec();
            ingress
                .on_datagram(now, arrival, &short, &mut deliver)
                .unwrap();
        }
    }
    assert!(!egress.has_long());
    let acknowledged = ingress.poll_transmit(now).unwrap();
    assert_eq!(acknowledged.kind, Kind::PieceAck);
    assert_eq!(ingress.poll_transmit(now), None);
    assert_eq!(piece_count, image.len().div_ceil(1384));
    delivered
}

#[test]
fn a_long_message_leaves_between_short_ones_and_arrives_whole() {
    let (mut egress, mut ingress) = long_pair();
    let image: Vec<u8> = (0..4_u32 << 20)
        .map(|at| (at % 251).to_le_bytes()[0])
        .collect();
    let delivered = send_long(&mut egress, &mut ingress, &image, |_| false);
    let (last, short) = delivered.split_last().unwrap();
    assert_eq!(short.len(), 30, "they came before it was whole");
    assert!(short.iter().all(|one| *one == (1, vec![5; 16])));
    assert_eq!(last.0, 0);
    assert!(last.1 == image);
    assert_eq!(egress.channel_counts(0).sent_count, 1);
    assert_eq!(ingress.next_incomplete(), None);
    // It is too long to be staged as others are.
    let now = Instant::from_ns(3_000_000);
    let envelope = Envelope::default();
    let refused = egress.on_local(now, 0, &envelope, &image).unwrap_err();
    assert!(matches!(refused, crate::LocalRefusal::TooBig { .. }));
}

#[test]
fn a_long_message_of_which_a_piece_is_missing_is_given_up_with_what_came() {
    let (mut egress, mut ingress) = long_pair();
    let image = vec![9; 4 << 20];
    let delivered = send_long(&mut egress, &mut ingress, &image, |piece| piece == 500);
    assert!(delivered.iter().all(|(channel, _)| *channel == 1));
    let due = ingress.next_wakeup().unwrap();
    assert_eq!(due, Instant::from_ns(2_000_000 + 1_000_000_000));
    assert_eq!(ingress.next_incomplete(), None);
    ingress.on_wakeup(due);
    let incomplete = ingress.next_incomplete().unwrap();
    assert_eq!(incomplete.message.channel, 0);
    assert_eq!(
        usize::from(incomplete.message.fragment_count),
        image.len().div_ceil(1384) - 1
    );
    assert_eq!(incomplete.heard_at, Instant::from_ns(2_000_000));
    assert_eq!(ingress.next_incomplete(), None);
    assert_eq!(ingress.reassembly_counts(0).timed_out_count, 1);
}

#[test]
fn a_peer_that_goes_takes_the_long_message_with_it() {
    let (mut egress, _ingress) = long_pair();
    let now = Instant::from_ns(2_000_000);
    egress.begin_long(0, &Envelope::default(), 1 << 20).unwrap();
    egress.on_peer_unreachable(now);
    assert!(!egress.has_long());
    assert_eq!(egress.long_piece(now, &vec![0; 1 << 20]), None);
    let counts = egress.channel_counts(0);
    assert_eq!((counts.offered_count, counts.message_failed_count), (1, 1));
}

#[test]
fn a_frame_arrives_as_long_as_it_is_and_another_message_only_whole() {
    for (message, length, is_taken) in [
        (ETHERNET_FRAME.name, 60, true),
        (ETHERNET_FRAME.name, 1_300, true),
        (ETHERNET_FRAME.name, 1_522, true),
        ("test.State.v1", 60, false),
        ("test.State.v1", 1_522, true),
    ] {
        let flow = FlowIdentity {
            flow: 65_534,
            name: "link/hop/forward".to_owned(),
            channels: vec![ChannelIdentity::new(0, "a/b", message, 1_522, 2)],
        };
        let mut pair = Pair::of(&flow);
        pair.exchange();
        let now = Instant::from_ns(pair.now_ns);
        let (envelope, payload) = (Envelope::default(), vec![7; length]);
        pair.egress.on_local(now, 0, &envelope, &payload).unwrap();
        let arrival = ArrivalStamps::application(pair.now_ns);
        let mut lengths = Vec::new();
        while let Some(transmit) = pair.egress.poll_transmit(now) {
            let datagram = transmit.datagram.to_vec();
            let mut deliver = |one: Delivery<'_>| lengths.push(one.payload.len());
            let taken = pair
                .ingress
                .on_datagram(now, arrival, &datagram, &mut deliver);
            let refused = Err(Refusal::LengthMismatch);
            assert!(is_taken == taken.is_ok() && (is_taken || taken == refused));
        }
        let expected: &[usize] = if is_taken { &[length] } else { &[] };
        assert_eq!(lengths, expected, "{message} of {length} bytes");
    }
}
