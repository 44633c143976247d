//! What holds for TCP alone: its framing byte by byte and under mutation, and what becomes of
//! messages when connections end or a peer does not read.

#![allow(
    clippy::disallowed_methods,
    reason = "a test may step aside while the kernel works"
)]

use core::time::Duration;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};

use hil_core::random::RandomStream;

use super::frame::{DATAGRAM_BYTES_MAX, FrameReader, PREFIX_BYTES, prefix};
use super::{TcpReceiver, TcpSender, now};
use crate::conformance_tests::{tcp_pair, within_bound};
use crate::socket::SocketSettings;
use crate::{DatagramReceiver, DatagramSender, SendRefusal};
use hil_net::tcp_info::{ConnectionInfo, unacknowledged_bytes};

fn settings(local: &str, peer: SocketAddr) -> SocketSettings {
    SocketSettings::new(local.parse().unwrap(), peer)
}

fn frame(datagram: &[u8]) -> Vec<u8> {
    let mut bytes = prefix(datagram.len()).unwrap().to_vec();
    bytes.extend_from_slice(datagram);
    bytes
}

#[test]
fn a_frame_is_its_length_and_its_datagram() {
    assert_eq!(frame(b"halt"), [4, 0, 0, 0, b'h', b'a', b'l', b't']);
    assert_eq!(frame(&[7; 0x1234])[..5], [0x34, 0x12, 0, 0, 7]);
    assert_eq!(frame(b""), [0, 0, 0, 0]);
    assert_eq!(prefix(DATAGRAM_BYTES_MAX), Some([0xff, 0xff, 0, 0]));
    assert_eq!(prefix(DATAGRAM_BYTES_MAX + 1), None);
    let mut reader = FrameReader::default();
    let golden = [4, 0, 0, 0, b'h', b'a', b'l', b't', 0, 0, 0, 0, 1, 0];
    reader.room()[..golden.len()].copy_from_slice(&golden);
    reader.filled(golden.len());
    assert_eq!(reader.next_datagram(), Ok(Some(&b"halt"[..])));
    assert_eq!(reader.next_datagram(), Ok(Some(&b""[..])));
    assert_eq!(reader.next_datagram(), Ok(None));
    assert_eq!(reader.waiting_bytes(), 2);
}

/// Feeds `stream` in the portions `portion` gives; all datagrams and whether a length was bad.
fn read_all(stream: &[u8], mut portion: impl FnMut() -> usize) -> (Vec<Vec<u8>>, bool) {
    let mut reader = FrameReader::default();
    let (mut found, mut rest) = (Vec::new(), stream);
    loop {
        match reader.next_datagram() {
            Ok(Some(datagram)) => found.push(datagram.to_vec()),
            Err(_) => return (found, true),
            Ok(None) if rest.is_empty() => return (found, false),
            Ok(None) => {
                let room = reader.room();
                assert!(!room.is_empty(), "a reader that wants more has room for it");
                let count = portion().clamp(1, room.len()).min(rest.len());
                room[..count].copy_from_slice(&rest[..count]);
                reader.filled(count);
                rest = &rest[count..];
            }
        }
    }
}

/// The same by the book, without portions.
fn expected(mut stream: &[u8]) -> (Vec<Vec<u8>>, bool) {
    let mut found = Vec::new();
    while let Some((prefix, rest)) = stream.split_first_chunk::<PREFIX_BYTES>() {
        let length = u32::from_le_bytes(*prefix) as usize;
        if length > DATAGRAM_BYTES_MAX {
            return (found, true);
        }
        let Some(datagram) = rest.get(..length) else {
            break;
        };
        found.push(datagram.to_vec());
        stream = &rest[length..];
    }
    (found, false)
}

#[test]
fn a_hundred_thousand_mutated_streams_are_read_as_the_layout_says() {
    let mut random = RandomStream::new(17, "mutated streams");
    let mut below = move |bound: usize| usize::try_from(random.next_u64() % bound as u64).unwrap();
    let (mut bad_count, mut whole_count) = (0_u32, 0_u32);
    for case in 0..100_000 {
        let mut stream = Vec::new();
        for _ in 0..=below(5) {
            let length = if below(200) == 0 {
                below(DATAGRAM_BYTES_MAX + 1)
            } else {
                below(90)
            };
            stream.extend(frame(&vec![u8::try_from(case % 251).unwrap(); length]));
        }
        for _ in 0..below(4) {
            let place = below(stream.len());
            match below(3) {
                0 => stream[place] ^= 1 << below(8),
                1 => stream[place] = u8::try_from(below(256)).unwrap(),
                _ => stream.truncate(place + 1),
            }
        }
        let portion_max = 1 + below(200);
        let wanted = expected(&stream);
        bad_count += u32::from(wanted.1);
        whole_count += u32::from(!wanted.1);
        assert_eq!(
            read_all(&stream, || 1 + below(portion_max)),
            wanted,
            "case {case}"
        );
    }
    assert!(
        bad_count > 1_000 && whole_count > 1_000,
        "{bad_count} {whole_count}"
    );
}

#[test]
fn the_longest_frames_pass_through_in_any_portion() {
    let stream: Vec<u8> = (0..6_u8)
        .flat_map(|byte| frame(&vec![byte; DATAGRAM_BYTES_MAX]))
        .collect();
    for portion in [1, 1_000, 65_539, 65_540, 70_000, usize::MAX] {
        let (found, is_bad) = read_all(&stream, || portion);
        assert_eq!((found.len(), is_bad), (6, false));
        assert!(
            found
                .iter()
                .zip(0..)
                .all(|(one, byte)| one[..] == vec![byte; DATAGRAM_BYTES_MAX])
        );
    }
}

/// Attends to both until what was sent has come.
fn carry(sender: &mut TcpSender, receiver: &mut TcpReceiver, datagram: &[u8]) {
    sender.send(datagram).unwrap();
    let mut buffer = [0; 1024];
    let arrival = within_bound("arrival", || {
        sender.attend(now());
        receiver.attend(now());
        receiver.receive(now(), &mut buffer).unwrap()
    });
    assert_eq!(&buffer[..arrival.length_bytes], datagram);
}

fn connect(sender: &mut TcpSender, receiver: &mut TcpReceiver) {
    within_bound("connection", || {
        sender.attend(now());
        receiver.attend(now());
        (sender.is_connected() && receiver.is_connected()).then_some(())
    });
}

#[test]
fn a_peer_that_vanished_is_a_state_and_comes_back() {
    let (mut sender, mut receiver) = tcp_pair("127.0.0.1:0");
    carry(&mut sender, &mut receiver, b"before");
    let place = receiver.local_address().unwrap();
    drop(receiver);
    let refusal = within_bound("refusal", || {
        sender.attend(now());
        let nothing = sender.receive(&mut [0; 64]).unwrap();
        assert_eq!(nothing, None);
        sender.send(b"lost").err()
    });
    assert_eq!(refusal, SendRefusal::NotConnected);
    let counters = sender.counters();
    assert_eq!(counters.network_report_count, 1, "the end is told once");
    assert_eq!(counters.newest_report, Some(SendRefusal::NotConnected));
    within_bound("failed attempt", || {
        sender.attend(now());
        (sender.metrics(now()).connect_failed_count >= 2).then_some(())
    });
    assert!(sender.next_due().is_some(), "another attempt is due");

    let mut receiver = TcpReceiver::open(settings(&place.to_string(), place), false).unwrap();
    connect(&mut sender, &mut receiver);
    carry(&mut sender, &mut receiver, b"after");
    let figures = sender.metrics(now());
    assert_eq!(
        (figures.connection_count, figures.reconnect_count()),
        (2, 1)
    );
    assert_eq!(figures.connection_ended_count, 1);
}

#[test]
fn a_restarted_sender_takes_the_place_of_the_one_that_vanished() {
    let (mut sender, mut receiver) = tcp_pair("127.0.0.1:0");
    carry(&mut sender, &mut receiver, b"first");
    let place = receiver.local_address().unwrap();
    let mut second = TcpSender::open(settings("127.0.0.1:0", place)).unwrap();
    within_bound("second connection", || {
        second.attend(now());
        receiver.attend(now());
        second.is_connected().then_some(())
    });
    // The first stays until the second has delivered something.
    carry(&mut sender, &mut receiver, b"still the first");
    assert_eq!(receiver.metrics(now()).connection_count, 1);
    carry(&mut second, &mut receiver, b"second");
    assert_eq!(receiver.metrics(now()).connection_ended_count, 1);
    // The first one hears of it.
    within_bound("end", || {
        assert_eq!(sender.receive(&mut [0; 64]).unwrap(), None);
        (!sender.is_connected()).then_some(())
    });
}

/// Eighty connections that say nothing, a part of a frame, or a datagram that nobody proves to be the peer's,
/// while the peer sends.
#[test]
fn connections_without_an_authentic_datagram_cost_the_present_one_nothing() {
    let place: SocketAddr = "127.0.0.1:0".parse().unwrap();
    let mut receiver = TcpReceiver::open(settings("127.0.0.1:0", place), true).unwrap();
    let place = receiver.local_address().unwrap();
    let mut sender = TcpSender::open(settings("127.0.0.1:0", place)).unwrap();
    connect(&mut sender, &mut receiver);
    carry(&mut sender, &mut receiver, b"peer");
    receiver.prove();
    let mut strangers = Vec::new();
    for number in 0..80 {
        let mut stranger = TcpStream::connect(place).unwrap();
        match number % 4 {
            0 => {}
            1 => stranger.write_all(&[9, 0]).unwrap(),
            2 => stranger.write_all(b"GET / HTTP/1.1\r\n\r\n").unwrap(),
            _ => stranger.write_all(&frame(b"made up")).unwrap(),
        }
        strangers.push(stranger);
        sender.send(b"peer").unwrap();
        let mut buffer = [0; 64];
        within_bound("the peer's", || {
            sender.attend(now());
            receiver.attend(now());
            let taken = receiver.receive(now(), &mut buffer).unwrap()?;
            (&buffer[..taken.length_bytes] == b"peer").then_some(())
        });
        receiver.prove();
        receiver.answer(b"heard", place).unwrap();
        within_bound("answer", || sender.receive(&mut buffer).unwrap());
    }
    let figures = within_bound("all but the candidates", || {
        receiver.attend(now());
        // What a candidate sent is given, and proves nothing.
        let _made_up = receiver.receive(now(), &mut [0; 64]).unwrap();
        let figures = receiver.metrics(now());
        (figures.unproven_connection_count >= 72).then_some(figures)
    });
    assert_eq!(
        (figures.connection_count, figures.connection_ended_count),
        (1, 0)
    );
    assert_eq!(sender.metrics(now()).connection_count, 1);
}

/// What is asked on a new connection is answered on it, and it takes the other's place once it is proven.
#[test]
fn a_new_connection_is_answered_before_it_is_the_peers() {
    let place: SocketAddr = "127.0.0.1:0".parse().unwrap();
    let mut receiver = TcpReceiver::open(settings("127.0.0.1:0", place), true).unwrap();
    let place = receiver.local_address().unwrap();
    let mut first = TcpSender::open(settings("127.0.0.1:0", place)).unwrap();
    connect(&mut first, &mut receiver);
    carry(&mut first, &mut receiver, b"first");
    receiver.prove();
    let mut second = TcpSender::open(settings("127.0.0.1:0", place)).unwrap();
    connect(&mut second, &mut receiver);
    // As long as frames get: it waits in the kernel until it is whole.
    let request = vec![7; DATAGRAM_BYTES_MAX];
    second.send(&request).unwrap();
    let mut buffer = vec![0; DATAGRAM_BYTES_MAX];
    let arrival = within_bound("request", || {
        second.attend(now());
        receiver.attend(now());
        receiver.receive(now(), &mut buffer).unwrap()
    });
    assert_eq!((arrival.length_bytes, &buffer), (request.len(), &request));
    receiver.answer(b"keys", place).unwrap();
    within_bound("answer", || second.receive(&mut buffer).unwrap());
    assert_eq!(receiver.metrics(now()).connection_count, 1);
    carry(&mut first, &mut receiver, b"first");
    receiver.prove();
    carry(&mut second, &mut receiver, b"proof");
    receiver.prove();
    let figures = receiver.metrics(now());
    assert_eq!(
        (figures.connection_count, figures.connection_ended_count),
        (2, 1)
    );
    receiver.reply(b"reply", place).unwrap();
    within_bound("reply", || second.receive(&mut buffer).unwrap());
}

#[test]
fn a_bad_length_closes_the_connection_and_is_counted() {
    let place: SocketAddr = "127.0.0.1:0".parse().unwrap();
    let mut receiver = TcpReceiver::open(settings("127.0.0.1:0", place), false).unwrap();
    let place = receiver.local_address().unwrap();
    let mut stranger = TcpStream::connect(place).unwrap();
    stranger.write_all(&frame(b"good")).unwrap();
    stranger.write_all(b"GET / HTTP/1.1\r\n\r\n").unwrap();
    let mut buffer = [0; 64];
    let arrival = within_bound("good frame", || {
        receiver.attend(now());
        receiver.receive(now(), &mut buffer).unwrap()
    });
    assert_eq!(&buffer[..arrival.length_bytes], b"good");
    within_bound("end", || {
        assert_eq!(receiver.receive(now(), &mut buffer).unwrap(), None);
        (!receiver.is_connected()).then_some(())
    });
    let figures = receiver.metrics(now());
    assert_eq!(
        (figures.bad_frame_count, figures.connection_ended_count),
        (1, 1)
    );
    assert!(matches!(stranger.read(&mut buffer), Ok(0) | Err(_)));
}

#[test]
fn connections_of_another_host_are_turned_away() {
    // All of 127.0.0.0/8 is this host, so another address of it is another host's to the receiver.
    let peer: SocketAddr = "127.0.0.9:0".parse().unwrap();
    let mut receiver = TcpReceiver::open(settings("127.0.0.1:0", peer), false).unwrap();
    let place = receiver.local_address().unwrap();
    let _stranger = TcpStream::connect(place).unwrap();
    within_bound("stranger", || {
        receiver.attend(now());
        let figures = receiver.metrics(now());
        (figures.foreign_connection_count == 1).then_some(())
    });
    assert!(!receiver.is_connected());
    let mut own = TcpSender::open(settings("127.0.0.9:0", place)).unwrap();
    connect(&mut own, &mut receiver);
}

/// A peer that accepts and does not read: the kernel's buffers fill, then ours, then messages are
/// refused, and the stall is measured.
#[test]
fn a_peer_that_does_not_read_costs_messages_and_shows_as_a_stall() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let mut of_sender = settings("127.0.0.1:0", listener.local_addr().unwrap());
    of_sender.send_buffer_bytes = Some(16_384);
    let mut sender = TcpSender::open(of_sender).unwrap();
    let (mut peer, _) = listener.accept().unwrap();
    within_bound("connection", || {
        sender.attend(now());
        sender.is_connected().then_some(())
    });
    let datagram = [5; 10_000];
    let mut sent = 0_usize;
    let refusal = within_bound("refusal", || {
        let outcome = sender.send(&datagram);
        sent += usize::from(outcome.is_ok());
        outcome.err()
    });
    let errno = libc::ENOBUFS;
    assert_eq!(refusal, SendRefusal::QueueFull { errno });
    assert!(sender.has_unsent());
    let stalled = within_bound("stall", || {
        sender.attend(now());
        let figures = sender.metrics(now());
        let stalls = figures.stalls;
        (stalls.count == 1 && stalls.longest > 2 * stalls.threshold).then_some(figures)
    });
    assert!(stalled.stalls.threshold >= Duration::from_millis(50));
    assert!(stalled.backlog_bytes_max > 0 && stalled.backlogged > stalled.stalls.threshold);
    assert!(stalled.waiting_bytes_max > stalled.backlog_bytes_max);
    assert!(sender.next_due().is_some(), "a stall is looked at again");

    // The peer reads: everything that was accepted comes, whole and in order.
    peer.set_nonblocking(true).unwrap();
    let mut reader = FrameReader::default();
    let mut found = 0;
    within_bound("everything", || {
        sender.attend(now());
        while let Ok(count @ 1..) = peer.read(reader.room()) {
            reader.filled(count);
            while let Ok(Some(one)) = reader.next_datagram() {
                assert_eq!(one, datagram);
                found += 1;
            }
        }
        (found == sent && !sender.has_unsent()).then_some(())
    });
    let ended = within_bound("end of the stall", || {
        sender.attend(now());
        sender.next_due().is_none().then(|| sender.metrics(now()))
    });
    assert_eq!((ended.stalls.count, ended.connection_ended_count), (1, 0));
    let total = sender.metrics(now()).stalls.total;
    assert_eq!(total, ended.stalls.total, "it is over");
    assert!(ended.kernel.window_limited_us > Some(0));
}

#[test]
fn the_kernel_is_read_at_the_right_places() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let mut client = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
    let (mut server, _) = listener.accept().unwrap();
    client.write_all(&[1; 12_345]).unwrap();
    server.read_exact(&mut [0; 12_345]).unwrap();
    let client = socket2::Socket::from(client);
    within_bound("acknowledgement", || {
        (unacknowledged_bytes(&client).unwrap() == 0).then_some(())
    });
    let server = socket2::Socket::from(server);
    let info = ConnectionInfo::read(&server).unwrap();
    assert_eq!(info.received_bytes, Some(12_345));
    assert_eq!(info.out_of_order_segments, Some(0));
    let info = ConnectionInfo::read(&client).unwrap();
    assert_eq!(
        (info.received_bytes, info.unacknowledged_segments),
        (Some(0), Some(0))
    );
    assert_eq!(info.retransmitted_segments, Some(0));
    // Loopback, on a machine however busy.
    assert!(
        info.rtt_us.is_some_and(|us| (1..10_000_000).contains(&us)),
        "{info:?}"
    );
    assert!(info.rtt_min_us <= info.rtt_us.map(|us| us * 8), "{info:?}");
    assert!(info.busy_us.is_some_and(|us| us < 60_000_000), "{info:?}");
}
