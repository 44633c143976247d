//! Seeds of what comes from the network or the kernel.

use std::time::Duration;

use hil_arm::egm::adapter::{
    Axes, RobotAdapter, RobotAdapterSettings, RobotWare, SendPolicy, SensorAdapter,
    SensorAdapterSettings,
};
use hil_arm::egm::messages::{EgmCommand, Side};
use hil_arm::yumi::arm::RIGHT_START_RAD;
use hil_capture::writer::PacketToWrite;
use hil_capture::{CaptureInterface, esl, writer};
use hil_core::message::Envelope;
use hil_core::time::Instant;
use hil_net::{Direction, link_type};
use hil_protocol::body::PieceAck;
use hil_protocol::wire::{Body, Datagram, HEADER_BYTES, Header, Kind};
use hil_protocol::{ArrivalStamps, EgressBridge, InMemory, IngressBridge};
use hil_transport::tcp::frame::prefix;

use super::{behind, numbered};
use crate::Seed;
use crate::bridges::{egress, ingress};
use crate::egm::feedback;
use crate::gateway::encode;

const NOW_NS: i64 = 50_000_000_000;

/// One datagram of every kind, as two gateways make them.
fn all_datagrams() -> Vec<Vec<u8>> {
    let (mut sender, mut receiver) = (egress(100), ingress());
    let mut made = Vec::new();
    for (sequence, length) in [0, 8, 64, 1400].into_iter().enumerate() {
        let envelope = Envelope {
            sequence: sequence as u64,
            published_ns: NOW_NS - 5,
            epoch: 1,
            ..Envelope::default()
        };
        let now = Instant::from_ns(NOW_NS) + Duration::from_millis(25 * sequence as u64);
        // Not greeted at first: then the message is refused, and counted.
        let _counted = sender.on_local(now, 0, &envelope, &vec![7; length]);
        converse(&mut sender, &mut receiver, now, &mut made);
    }
    sender.bye();
    // Of the channel, and of the flow.
    while let Some(farewell) = sender.poll_transmit(Instant::from_ns(NOW_NS)) {
        made.push(farewell.datagram.to_vec());
    }
    let mut header = Header::new(Kind::PieceAck, 100, 65_535);
    header.handed_ns = NOW_NS;
    header.total_len = 8;
    let ack = PieceAck {
        answers_handed_ns: NOW_NS - 70_000,
    };
    let body = Body::PieceAck(ack);
    made.push(encode(&Datagram { header, body }, HEADER_BYTES + 8));
    made
}

fn converse(
    sender: &mut EgressBridge,
    receiver: &mut IngressBridge,
    now: Instant,
    made: &mut Vec<Vec<u8>>,
) {
    let arrival = ArrivalStamps::application(now.as_ns());
    let mut memory = InMemory::default();
    let mut destination = memory.with(|_, _| {});
    while let Some(transmit) = sender.poll_transmit(now) {
        let key = transmit.key;
        let datagram = transmit.datagram.to_vec();
        sender.on_transmit_stamp(key, 900);
        let _counted = receiver.on_datagram(now, arrival, &datagram, &mut destination);
        made.push(datagram);
        while let Some(reply) = receiver.poll_transmit(now) {
            let reply = reply.datagram.to_vec();
            let _counted = sender.on_datagram(now, arrival, &reply);
            made.push(reply);
        }
    }
}

pub(crate) fn datagrams() -> Vec<Seed> {
    numbered("datagram", all_datagrams())
}

pub(crate) fn reassembly() -> Vec<Seed> {
    // Head, index, count, length of the whole.
    let piece = |head: u8, index: u8, count: u8, total: u16| {
        let [low, high] = total.to_le_bytes();
        [head, index, count, low, high]
    };
    let whole = [piece(0, 0, 1, 64)].concat();
    let reordered = [piece(2, 1, 2, 999), piece(2, 0, 2, 999)].concat();
    let doubled = [piece(4, 0, 3, 90), piece(4, 0, 3, 90), piece(4, 1, 3, 90)].concat();
    let evicted = (0..5).map(|sequence| piece(sequence << 1, 0, 2, 500));
    let evicted = evicted.collect::<Vec<_>>().concat();
    let late = [piece(0, 0, 2, 700), piece(0xf0, 1, 2, 700)].concat();
    numbered("pieces", [whole, reordered, doubled, evicted, late])
}

pub(crate) fn conversations() -> Vec<Seed> {
    // Steps of a code and an argument, see `Conversation::step`.
    let greet = [[2, 0], [3, 0], [4, 0]].concat();
    let plain = [[0, 16], [3, 0], [1, 40], [3, 0], [2, 12], [3, 0], [4, 0]].concat();
    let reordered = [[0, 1], [0, 2], [0, 3], [3, 2], [3, 0], [3, 0]].concat();
    let copied = [
        [0, 9],
        [5, 0],
        [5, 0],
        [3, 0],
        [0, 9],
        [7, 0],
        [0, 9],
        [3, 0],
    ]
    .concat();
    let long = [
        [0, 250],
        [3, 1],
        [3, 1],
        [3, 0],
        [0, 240],
        [7, 0],
        [3, 0],
        [3, 0],
    ]
    .concat();
    let restarted = [
        [0, 5],
        [5, 0],
        [11, 0],
        [0, 5],
        [3, 1],
        [3, 0],
        [11, 3],
        [3, 0],
        [4, 0],
        [0, 5],
        [3, 0],
        [3, 0],
    ]
    .concat();
    let damaged = [
        &[0, 9, 9, 0, 60, 0, 1, 3, 0][..],
        &[10, 0, 4, 0, 1, 2, 3, 4],
    ]
    .concat();
    let parts = [plain, reordered, copied, long, restarted, damaged];
    let parts = parts.map(|part| [&greet[..], &part].concat());
    let all = parts.concat();
    numbered("talk", parts.into_iter().chain([all]))
}

pub(crate) fn tcp_streams() -> Vec<Seed> {
    let mut stream = Vec::new();
    for datagram in all_datagrams().iter().take(5) {
        stream.extend(prefix(datagram.len()).unwrap_or_default());
        stream.extend(datagram);
    }
    let broken = [&stream[..], &[0xff; 4], &[1, 2, 3]].concat();
    let cut = stream[..stream.len() - 5].to_vec();
    let inputs = [
        behind(0, &stream[..200]),
        behind(6, &stream),
        behind(255, &broken),
        behind(63, &cut),
    ];
    numbered("stream", inputs)
}

pub(crate) fn control_messages() -> Vec<Seed> {
    let message = |level: i32, kind: i32, payload: &[u8]| {
        let mut bytes = (16 + payload.len()).to_ne_bytes().to_vec();
        bytes.extend(level.to_ne_bytes());
        bytes.extend(kind.to_ne_bytes());
        bytes.extend(payload);
        bytes.resize(bytes.len().next_multiple_of(8), 0);
        bytes
    };
    let times: Vec<u8> = [1_700_000_000_i64, 5, 0, 0, 37, 250]
        .into_iter()
        .flat_map(i64::to_ne_bytes)
        .collect();
    // SOL_SOCKET with SCM_TIMESTAMPING, SO_RXQ_OVFL and SCM_WIFI_STATUS; IP_TOS; IP_RECVERR.
    let stamps = message(1, 37, &times);
    let report = message(0, 11, &[42, 0, 0, 0, 4, 3, 3, 0, 0, 0, 0, 0, 41, 0, 0, 0]);
    let rest = [
        message(1, 40, &[9, 0, 0, 0]),
        message(1, 41, &[1, 0, 0, 0]),
        message(0, 1, &[184]),
    ]
    .concat();
    let all = [stamps.clone(), report.clone(), rest.clone()].concat();
    numbered("control", [stamps, report, rest, all])
}

/// An Ethernet frame with a UDP datagram over IPv4 in it.
fn frame(port: u16, payload: &[u8]) -> Vec<u8> {
    let udp_bytes = u16::try_from(8 + payload.len()).unwrap_or(u16::MAX);
    let mut bytes = vec![2, 0, 0, 0, 0, 2, 2, 0, 0, 0, 0, 1, 0x08, 0x00, 0x45, 0xb8];
    bytes.extend((20 + udp_bytes).to_be_bytes());
    bytes.extend([0, 0, 0x40, 0, 64, 17, 0, 0]);
    bytes.extend([10, 77, 0, 1, 10, 77, 0, 2]);
    for word in [port, port, udp_bytes, 0] {
        bytes.extend(word.to_be_bytes());
    }
    bytes.extend(payload);
    bytes
}

/// The same payload over IPv6 behind a VLAN tag.
fn frame_v6(port: u16, payload: &[u8]) -> Vec<u8> {
    let udp_bytes = u16::try_from(8 + payload.len()).unwrap_or(u16::MAX);
    let mut bytes = vec![
        2, 0, 0, 0, 0, 2, 2, 0, 0, 0, 0, 1, 0x81, 0x00, 0x20, 7, 0x86, 0xdd,
    ];
    bytes.extend([0x6b, 0x80, 0, 0]);
    bytes.extend(udp_bytes.to_be_bytes());
    bytes.extend([17, 64]);
    bytes.extend([0xfd; 32]);
    for word in [port, port, udp_bytes, 0] {
        bytes.extend(word.to_be_bytes());
    }
    bytes.extend(payload);
    bytes
}

pub(crate) fn frames() -> Vec<Seed> {
    // Which link layer, and the length on the wire: even ones have a stamp.
    let input = |link: u8, frame: &[u8]| [&[link, 130, 0][..], frame].concat();
    let datagrams = all_datagrams();
    let message = &datagrams[datagrams.len() - 2];
    let own = frame(7400, &message[..message.len().min(100)]);
    let egm = frame(6510, &egm_messages()[0]);
    let header = esl::EslHeader {
        flags: esl::FLAG_BITS[3] | esl::STAMP_ENABLED,
        stamp_ns: 5,
    };
    let before = [&header.encode()[..], &own].concat();
    let after = [&own[..], &header.encode()].concat();
    let cooked = [&[0; 14][..], &[8, 0], &own[14..]].concat();
    let cooked_2 = [&[8, 0][..], &[0; 18], &own[14..]].concat();
    let inputs = [
        input(0, &own),
        input(0, &egm),
        input(0, &frame_v6(7000, &[1; 16])),
        input(0, &before),
        input(0, &after),
        input(1, &own[14..]),
        input(2, &cooked),
        input(5, &cooked_2),
        [&[0, 131, 0][..], &frame(7001, b"no stamp")].concat(),
    ];
    numbered("frame", inputs)
}

pub(crate) fn captures() -> Vec<Seed> {
    let payload = frame(7400, &[5; 40]);
    let mut next = Vec::new();
    writer::begin(&mut next, "seed", "none");
    for name in ["a", "b"] {
        let interface = CaptureInterface {
            name: Some(name.to_owned()),
            link_type: link_type::ETHERNET,
            ..CaptureInterface::default()
        };
        writer::interface(&mut next, &interface, "hil");
    }
    for index in 0..3 {
        let packet = PacketToWrite {
            interface_index: index % 2,
            stamp_ns: 1_000_000 * u64::from(index),
            original_bytes: 130,
            direction: [Direction::Inbound, Direction::Outbound, Direction::Unknown]
                [index as usize],
            data: [&payload, &[]],
        };
        writer::packet(&mut next, &packet);
    }
    writer::statistics(&mut next, 1, 0, 9, 3, 0, Some("done"));
    let classic = |magic: [u8; 4], is_big: bool| {
        let word = |value: u32| {
            if is_big {
                value.to_be_bytes()
            } else {
                value.to_le_bytes()
            }
        };
        let half = |value: u16| {
            if is_big {
                value.to_be_bytes()
            } else {
                value.to_le_bytes()
            }
        };
        let mut file = magic.to_vec();
        file.extend([half(2), half(4)].concat());
        file.extend([word(0), word(0), word(0), word(1)].concat());
        for index in 0..2 {
            let length = u32::try_from(payload.len()).unwrap_or(u32::MAX);
            file.extend([word(index), word(5), word(length), word(length)].concat());
            file.extend(&payload);
        }
        file
    };
    let inputs = [
        behind(40, &next),
        behind(0, &next[..next.len() - 30]),
        behind(96, &classic([0xd4, 0xc3, 0xb2, 0xa1], false)),
        behind(255, &classic([0xa1, 0xb2, 0x3c, 0x4d], true)),
    ];
    numbered("capture", inputs)
}

/// A robot's and a sensor's datagrams, of either release and number of axes.
fn egm_messages() -> Vec<Vec<u8>> {
    let mut made = Vec::new();
    let axes = [Axes::Six, Axes::Seven];
    for (axes, robotware) in axes.into_iter().zip([RobotWare::Six, RobotWare::Seven]) {
        let mut robot = RobotAdapter::new(RobotAdapterSettings {
            side: Side::Right,
            axes,
            robotware,
            cycle: Duration::from_millis(4),
            planned_lead: Duration::from_millis(16),
        });
        let mut sensor = SensorAdapter::new(SensorAdapterSettings {
            axes,
            held_rad: 0.0,
            policy: SendPolicy::Coupled {
                patience: Duration::ZERO,
            },
        });
        for cycle_index in 0..2 {
            let mut datagram = Vec::new();
            let _is_told = robot.encode(&feedback(cycle_index, 1), Duration::ZERO, &mut datagram);
            let now = Instant::from_ns(4_000_000 * i64::from(cycle_index));
            let _counted = sensor.decode(now, &datagram);
            made.push(datagram);
            let command = EgmCommand {
                frame_index: 0,
                source_time_ns: 0,
                answered_cycle: 0,
                position_rad: RIGHT_START_RAD,
                speed_rad_per_s: [0.125; 7],
                seqno: 0,
                flags: EgmCommand::HAS_SPEED * cycle_index,
            };
            let _counted = sensor.command(&command);
            let mut answer = Vec::new();
            if sensor.poll_transmit(now, &mut answer) {
                made.push(answer);
            }
        }
    }
    made
}

pub(crate) fn egm_datagrams() -> Vec<Seed> {
    // A path correction: header of its type, and a correction.
    let path = vec![
        0x0a, 0x06, 0x08, 0x01, 0x10, 0x02, 0x18, 0x04, 0x12, 0x1f, 0x0a, 0x1b, 0x09, 0, 0, 0, 0,
        0, 0, 0, 0, 0x11, 0, 0, 0, 0, 0, 0, 0xf0, 0x3f, 0x19, 0, 0, 0, 0, 0, 0, 0, 0, 0x10, 0x05,
    ];
    numbered("egm", egm_messages().into_iter().chain([path]))
}

pub(crate) fn egm_sessions() -> Vec<Seed> {
    let messages = egm_messages();
    let told = |mode: u8, parts: &[&[u8]]| {
        let mut bytes = vec![mode];
        for part in parts {
            let length = u16::try_from(part.len()).unwrap_or(u16::MAX);
            bytes.extend(length.to_le_bytes());
            bytes.extend(*part);
        }
        bytes
    };
    // 0x8000: the robot's next cycle, which opens a session; two robots' messages come first.
    let cycle = [0x00, 0x80];
    let (six, seven) = messages.split_at(messages.len() / 2);
    let to_six: Vec<&[u8]> = six.iter().map(Vec::as_slice).collect();
    let to_seven: Vec<&[u8]> = seven.iter().map(Vec::as_slice).collect();
    let opened = |bytes: Vec<u8>| [&bytes[..1], &cycle, &bytes[1..]].concat();
    let inputs = [
        opened(told(0, &to_six)),
        opened(told(1, &to_seven)),
        told(2, &to_six),
        told(3, &to_seven),
        told(6, &to_six),
    ];
    numbered("session", inputs)
}
