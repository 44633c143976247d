//! Many channels in one flow: what is theirs stays apart, and what is the flow's happens once.

use hil_core::message::{ETHERNET_FRAME, Envelope};
use hil_core::time::Instant;

use crate::channel::{ChannelIdentity, FlowIdentity};
use crate::egress::{EgressBridge, EgressEvent, EgressSettings};
use crate::ingress::{
    Delivery, Destination, Disposition, IngressBridge, IngressSettings, Payload, Piece,
};
use crate::lab::{Impairment, InMemory, Lab, egress_settings, ingress_settings};
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

/// Of one clock, over a cable without delay.
fn lab_of(flow: &FlowIdentity) -> Lab {
    let mut lab = Lab::of(1, flow, Impairment::default());
    lab.offset_ns = 0;
    lab.run_ms(1);
    lab
}

fn lab() -> Lab {
    lab_of(&flow())
}

fn publish(lab: &mut Lab, channel: usize, epoch: u32, sequence: u64) {
    let size_bytes = flow().channels[channel].size_max_bytes as usize;
    let mark = u8::try_from(channel % 251).unwrap();
    lab.offer(channel, epoch, sequence, &vec![mark; size_bytes])
        .unwrap();
    lab.step();
}

#[test]
fn four_hundred_channels_greet_once_and_each_counts_its_own_messages() {
    let mut lab = lab();
    let kinds: Vec<Kind> = lab.datagrams.iter().map(|(kind, _)| *kind).collect();
    assert_eq!(kinds, [Kind::Hello, Kind::SyncRequest]);
    let channels = usize::from(CHANNELS);
    let mut expected = Vec::new();
    for round in 0..5 {
        for channel in 0..channels {
            // Each channel starts at a number of its own, and every seventh loses one in between.
            let gap = u64::from(round > 2 && channel % 7 == 0);
            let sequence = channel as u64 + round + gap;
            publish(&mut lab, channel, 1, sequence);
            expected.push((channel, 1, sequence, u8::try_from(channel % 251).unwrap()));
        }
    }
    let delivered = lab.delivered.iter().map(|one| {
        let message = one.message;
        (
            message.channel,
            message.epoch,
            message.sequence,
            one.payload[0],
        )
    });
    assert_eq!(delivered.collect::<Vec<_>>(), expected);
    lab.egress.bye();
    lab.step();
    lab.ingress.finish();
    for channel in 0..channels {
        let counts = lab.ingress.sequence_counts(channel);
        let lost = u64::from(channel % 7 == 0);
        assert_eq!((counts.received_count, counts.lost_count), (5, lost));
        let sent = lab.egress.channel_counts(channel);
        assert_eq!((sent.sent_count, sent.refused_count()), (5, 0));
        let taken = lab.ingress.channel_counts(channel);
        let is_split = channel.is_multiple_of(10);
        assert_eq!(taken.datagram_count, if is_split { 15 } else { 5 });
        assert_eq!(
            sent.datagram_count,
            taken.datagram_count + 1,
            "the farewell"
        );
        let pieces = lab.ingress.reassembly_counts(channel);
        assert_eq!(pieces.completed_count, if is_split { 5 } else { 0 });
    }
    assert_eq!(lab.ingress.refusals().total(), 0);
    let last = lab.datagrams.last().unwrap();
    assert_eq!(*last, (Kind::Bye, 65_534), "the flow's own comes last");
    let byes = lab.datagrams.iter().filter(|one| one.0 == Kind::Bye);
    assert_eq!(byes.count(), channels + 1);
    assert!(lab.ingress.has_left());
}

#[test]
fn an_idle_channel_has_nothing_due() {
    let mut lab = lab();
    let started = lab.now_ns;
    let before = lab.datagrams.len();
    for _ in 0..50 {
        let due = lab.egress.next_wakeup().unwrap();
        lab.now_ns = due.as_ns();
        lab.exchange();
        assert_eq!(lab.ingress.next_wakeup(), None);
    }
    assert_eq!(lab.datagrams.len() - before, 50, "the clock exchanges");
    assert!(lab.now_ns - started >= 50 * 20_000_000 - 1_000_000);
}

#[test]
fn a_restart_of_one_producer_leaves_the_other_channels_alone() {
    let mut lab = lab();
    for sequence in 0..10 {
        publish(&mut lab, 1, 1, sequence);
        publish(&mut lab, 2, 1, sequence);
    }
    for sequence in 0..10 {
        publish(&mut lab, 1, 2, sequence);
        publish(&mut lab, 2, 1, 10 + sequence);
    }
    let counts = [1, 2].map(|channel| *lab.ingress.sequence_counts(channel));
    assert_eq!(counts.map(|one| one.restart_count), [1, 0]);
    assert_eq!(counts.map(|one| one.received_count), [20, 20]);
    assert_eq!(counts.map(|one| one.lost_count), [0, 0]);
}

#[test]
fn a_stamp_rides_on_the_next_message_of_its_own_channel() {
    let mut lab = lab();
    publish(&mut lab, 1, 1, 40);
    let follow_up = |lab: &mut Lab, channel: usize, sequence: u64| {
        let envelope = Envelope {
            sequence,
            epoch: 1,
            ..Envelope::default()
        };
        let now = lab.now();
        let staged = lab.egress.on_local(now, channel, &envelope, &[0; 16]);
        staged.unwrap();
        let datagram = lab.egress.poll_transmit(now).unwrap().datagram;
        Header::read(datagram).unwrap().0.follow_up
    };
    assert_eq!(follow_up(&mut lab, 2, 0), None);
    let field = follow_up(&mut lab, 1, 41).unwrap();
    assert_eq!((field.sequence(41), field.handed_to_tx_ns), (Some(40), 700));
}

#[test]
fn numbers_that_are_no_channels_and_exchanges_about_channels_are_refused() {
    let mut lab = lab();
    let now = lab.now();
    let arrival = ArrivalStamps::application(lab.now_ns);
    let mut offer = |kind: Kind, number: u16, type_hash: u64, body: &[u8]| {
        let mut header = Header::new(kind, 100, number);
        header.type_hash = type_hash;
        header.handed_ns = lab.now_ns;
        header.total_len = u32::try_from(body.len()).unwrap();
        let mut datagram = vec![0; HEADER_BYTES];
        header.encode(&mut datagram);
        datagram.extend_from_slice(body);
        let mut no_message = lab.memory.with(|_, _| panic!("no message"));
        lab.ingress
            .on_datagram(now, arrival, &datagram, &mut no_message)
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
    let mut lab = Lab::of(1, &flow(), Impairment::default());
    let mut fewer = flow();
    fewer.channels.pop();
    lab.ingress = IngressBridge::new(IngressSettings {
        flow: fewer,
        ..ingress_settings(200, 0)
    })
    .unwrap();
    let now = lab.now();
    let arrival = ArrivalStamps::application(lab.now_ns);
    let hello = lab.egress.poll_transmit(now).unwrap().datagram.to_vec();
    let refused = lab.ingress.on_datagram(
        now,
        arrival,
        &hello,
        &mut InMemory::default().with(|_, _| {}),
    );
    assert_eq!(refused, Err(Refusal::ChannelsDiffer));
    let reply = lab.ingress.poll_transmit(now).unwrap().datagram.to_vec();
    let event = lab.egress.on_datagram(now, arrival, &reply);
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
        .on_datagram(
            now,
            arrival,
            &hello,
            &mut InMemory::default().with(|_, _| {}),
        )
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
    let mut memory = InMemory::default();
    let mut deliver = memory.with(|one, payload| {
        delivered.push((one.message.channel, payload.to_vec()));
    });
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

/// A destination that notes where pieces go, with memory for so many of them.
struct Places {
    rest: usize,
    /// Slot, whether its message begins, and offset of each.
    stored: Vec<(usize, bool, usize)>,
    /// Slot and length of each message.
    whole: Vec<(usize, usize)>,
}

impl Destination for Places {
    fn store(&mut self, piece: &Piece<'_>) -> bool {
        let Some(rest) = self.rest.checked_sub(1) else {
            return false;
        };
        self.rest = rest;
        let place = (piece.slot, piece.is_first, piece.offset_bytes);
        self.stored.push(place);
        true
    }

    fn deliver(&mut self, delivery: &Delivery, payload: Payload<'_>) {
        match payload {
            Payload::Stored { slot, length_bytes } => self.whole.push((slot, length_bytes)),
            Payload::Datagram(_) => panic!("{delivery:?} came in pieces"),
        }
    }
}

/// The three datagrams of a message of the first channel, which do not arrive yet.
fn pieces_of(lab: &mut Lab, sequence: u64) -> Vec<Vec<u8>> {
    let envelope = Envelope {
        sequence,
        epoch: 1,
        ..Envelope::default()
    };
    let now = lab.now();
    let staged = lab.egress.on_local(now, 0, &envelope, &[3; 4_000]);
    staged.unwrap();
    let mut pieces = Vec::new();
    while let Some(transmit) = lab.egress.poll_transmit(now) {
        pieces.push(transmit.datagram.to_vec());
    }
    assert_eq!(pieces.len(), 3);
    pieces
}

fn offer(lab: &mut Lab, datagram: &[u8], places: &mut Places) -> Result<Disposition, Refusal> {
    let arrival = ArrivalStamps::application(lab.now_ns);
    lab.ingress
        .on_datagram(lab.now(), arrival, datagram, places)
}

#[test]
fn a_piece_without_memory_is_refused_and_its_message_is_never_whole() {
    let mut lab = lab();
    let mut places = Places {
        rest: 2,
        stored: Vec::new(),
        whole: Vec::new(),
    };
    let pieces = pieces_of(&mut lab, 0);
    let outcomes = pieces.iter().map(|one| offer(&mut lab, one, &mut places));
    let stored = Ok(Disposition::FragmentStored);
    let refused = Err(Refusal::NoMemory);
    assert_eq!(outcomes.collect::<Vec<_>>(), [stored, stored, refused]);
    assert_eq!(places.stored, [(0, true, 0), (0, false, 1_334)]);
    assert_eq!(lab.ingress.refusals().get(Refusal::NoMemory), 1);
    let due = lab.ingress.next_wakeup().unwrap();
    lab.ingress.on_wakeup(due);
    let incomplete = lab.ingress.next_incomplete().unwrap();
    assert_eq!(incomplete.message.fragment_count, 2);
    assert_eq!(places.whole, []);
}

#[test]
fn a_message_of_a_new_session_begins_anew_in_the_slot_of_an_old_one() {
    let mut lab = lab();
    let mut places = Places {
        rest: usize::MAX,
        stored: Vec::new(),
        whole: Vec::new(),
    };
    for piece in &pieces_of(&mut lab, 0)[..2] {
        offer(&mut lab, piece, &mut places).unwrap();
    }
    let flow = flow();
    lab.egress = EgressBridge::new(EgressSettings {
        flow,
        ..egress_settings(101, 0)
    })
    .unwrap();
    lab.run_ms(1);
    assert_eq!(lab.ingress.next_incomplete().unwrap().message.session, 100);
    let pieces = pieces_of(&mut lab, 0);
    for piece in [2, 0, 1] {
        assert_eq!(places.whole, []);
        offer(&mut lab, &pieces[piece], &mut places).unwrap();
    }
    let of_the_new = [(0, true, 2_668), (0, false, 0), (0, false, 1_334)];
    assert_eq!(places.stored[2..], of_the_new);
    assert_eq!(places.whole, [(0, 4_000)]);
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
        let mut lab = lab_of(&flow);
        let (before, payload) = (lab.dispositions.len(), vec![7; length]);
        lab.offer(0, 1, 0, &payload).unwrap();
        lab.step();
        let refused = Err(Refusal::LengthMismatch);
        for taken in &lab.dispositions[before..] {
            assert!(is_taken == taken.is_ok() && (is_taken || *taken == refused));
        }
        let delivered = lab.delivered.iter().map(|one| one.payload.len());
        let expected: &[usize] = if is_taken { &[length] } else { &[] };
        assert_eq!(
            delivered.collect::<Vec<_>>(),
            expected,
            "{message} of {length} bytes"
        );
    }
}
