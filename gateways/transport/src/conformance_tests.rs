//! What every transport promises, checked on each of them.

#![allow(
    clippy::disallowed_methods,
    reason = "a test may step aside while a datagram is on its way"
)]

use std::io::ErrorKind;
use std::net::{IpAddr, SocketAddr, UdpSocket};
use std::thread;
use std::time::Duration;

use hil_core::link_model::PerfectLink;
use hil_core::time::Instant;

use super::emulated::{EmulatedReceiver, EmulatedSettings, Offer};
use super::queue::{QueueSettings, queue_pair};
use super::registry::{self, OpenReceiver, OpenSender, Transport};
use super::socket::{SocketError, SocketSettings};
use super::tcp::{TcpReceiver, TcpSender};
use super::udp::{UdpReceiver, UdpSender};
use super::{DatagramReceiver, DatagramSender, Received, SendRefusal};
use hil_net::clock_pair::monotonic_now;
use hil_net::timestamping::TimestampMode;
use hil_net::{KernelStamps, TransmitStamp, TxToken};
use hil_protocol::seal::{Initiator, Responder};
use hil_protocol::transport::Description;

const BUFFER_BYTES: usize = 256;

fn now() -> Instant {
    monotonic_now().unwrap()
}

/// Repeats `attempt` until it yields something; ten seconds without are a failure.
pub(super) fn within_bound<T>(what: &str, mut attempt: impl FnMut() -> Option<T>) -> T {
    let end = now() + Duration::from_secs(10);
    while now() < end {
        if let Some(found) = attempt() {
            return found;
        }
        thread::sleep(Duration::from_micros(50));
    }
    panic!("no {what} within ten seconds");
}

fn next_arrival(receiver: &mut dyn DatagramReceiver, buffer: &mut [u8]) -> Received {
    within_bound("arrival", || {
        receiver.attend(now());
        receiver.receive(now(), buffer).unwrap()
    })
}

fn is_silent(sender: &mut dyn DatagramSender, receiver: &mut dyn DatagramReceiver) -> bool {
    let mut buffer = [0; BUFFER_BYTES];
    let arrival = receiver.receive(now(), &mut buffer).unwrap();
    arrival.is_none() && sender.receive(&mut buffer).unwrap().is_none()
}

/// Runs all checks over one pair.
fn check_conformance(
    name: &str,
    sender: &mut dyn DatagramSender,
    receiver: &mut dyn DatagramReceiver,
) {
    assert!(
        is_silent(sender, receiver),
        "{name}: silent before the start"
    );
    assert_eq!(sender.next_stamp(), None, "{name}: no stamp without a send");
    let source = check_order_and_content(name, sender, receiver);
    check_truncation(name, sender, receiver);
    check_refusal_of_length(name, sender);
    check_replies(name, sender, receiver, source);
    check_stamps(name, sender);
    assert!(is_silent(sender, receiver), "{name}: silent at the end");
    assert_eq!(receiver.next_due(), None, "{name}: nothing held at the end");
    let (sent, taken) = (sender.counters(), receiver.counters());
    assert_eq!(sent.sent_count, taken.received_count, "{name}");
    assert_eq!((sent.reply_count, taken.reply_count), (1, 1), "{name}");
    assert_eq!(taken.truncated_count, 1, "{name}");
    assert_eq!(
        (sent.too_long_count, sent.refused_count()),
        (1, 1),
        "{name}"
    );
}

fn check_order_and_content(
    name: &str,
    sender: &mut dyn DatagramSender,
    receiver: &mut dyn DatagramReceiver,
) -> SocketAddr {
    let mut sources = Vec::new();
    for index in 0..20_u8 {
        let datagram = vec![index; usize::from(index) * 3];
        let token = sender.send(&datagram).unwrap();
        assert_eq!(token, TxToken(u32::from(index)), "{name}");
    }
    for index in 0..20_u8 {
        let mut buffer = [0xff; BUFFER_BYTES];
        let arrival = next_arrival(receiver, &mut buffer);
        let expected = vec![index; usize::from(index) * 3];
        assert_eq!(&buffer[..arrival.length_bytes], expected, "{name}");
        assert!(!arrival.is_truncated, "{name}");
        sources.push(arrival.source);
    }
    sources.dedup();
    assert_eq!(sources.len(), 1, "{name}: one sender, one source");
    sources[0]
}

fn check_truncation(
    name: &str,
    sender: &mut dyn DatagramSender,
    receiver: &mut dyn DatagramReceiver,
) {
    sender.send(&[7; 100]).unwrap();
    sender.send(&[8; 10]).unwrap();
    let mut short = [0; 40];
    let arrival = next_arrival(receiver, &mut short);
    assert!(arrival.is_truncated, "{name}: a long datagram is cut");
    assert_eq!((arrival.length_bytes, short), (40, [7; 40]), "{name}");
    let arrival = next_arrival(receiver, &mut short);
    assert!(!arrival.is_truncated, "{name}: the next one is whole");
    assert_eq!(arrival.length_bytes, 10, "{name}");
}

fn check_refusal_of_length(name: &str, sender: &mut dyn DatagramSender) {
    let length_bytes = 70_000;
    let refusal = sender.send(&vec![0; length_bytes]).unwrap_err();
    assert_eq!(refusal, SendRefusal::TooLong { length_bytes }, "{name}");
}

fn check_replies(
    name: &str,
    sender: &mut dyn DatagramSender,
    receiver: &mut dyn DatagramReceiver,
    source: SocketAddr,
) {
    receiver.reply(b"heard", source).unwrap();
    let mut buffer = [0; BUFFER_BYTES];
    let reply = within_bound("reply", || {
        sender.attend(now());
        sender.receive(&mut buffer).unwrap()
    });
    assert_eq!(&buffer[..reply.length_bytes], b"heard", "{name}");
}

/// Stamps, where there are any, name sends that happened, and come to an end.
fn check_stamps(name: &str, sender: &mut dyn DatagramSender) {
    let sent_count = sender.counters().sent_count;
    let stamps: Vec<TransmitStamp> = core::iter::from_fn(|| sender.next_stamp()).collect();
    for stamp in &stamps {
        assert!(u64::from(stamp.token.0) < sent_count, "{name}: {stamp:?}");
    }
    let counters = sender.counters();
    assert_eq!(counters.stamp_count, stamps.len() as u64, "{name}");
    assert_eq!(counters.unmatched_stamp_count, 0, "{name}");
}

/// A sender and the receiver it is connected to, on the loopback address of `address`.
pub(super) fn udp_pair(address: &str, mode: TimestampMode) -> (UdpSender, UdpReceiver) {
    let address = address.parse().unwrap();
    let mut settings = SocketSettings::new(address, address);
    settings.timestamps = mode;
    let receiver = UdpReceiver::open(&settings).unwrap();
    settings.peer = receiver.local_address().unwrap();
    (UdpSender::open(&settings).unwrap(), receiver)
}

/// A sender and the receiver it is connected to, on the loopback address of `address`.
pub(super) fn tcp_pair(address: &str) -> (TcpSender, TcpReceiver) {
    let address = address.parse().unwrap();
    let settings = SocketSettings::new(address, address);
    let mut receiver = TcpReceiver::open(settings, false).unwrap();
    let place = receiver.local_address().unwrap();
    let mut sender = TcpSender::open(SocketSettings::new(address, place)).unwrap();
    within_bound("connection", || {
        sender.attend(now());
        receiver.attend(now());
        (sender.is_connected() && receiver.is_connected()).then_some(())
    });
    (sender, receiver)
}

fn made_up_stamps(token: TxToken) -> KernelStamps {
    KernelStamps {
        software_ns: Some(i64::from(token.0) + 1),
        hardware_ns: None,
    }
}

/// An address of this host that no socket has.
fn free_address(ip: IpAddr) -> SocketAddr {
    UdpSocket::bind((ip, 0)).unwrap().local_addr().unwrap()
}

/// Both ends of `transport` on `ip`, connected where it connects; `None` where this host does not
/// let it be opened.
pub(super) fn opened(
    transport: &dyn Transport,
    ip: IpAddr,
    mode: TimestampMode,
    initiator: Option<Initiator>,
    responder: Option<Responder>,
) -> Option<(OpenSender, OpenReceiver)> {
    let name = transport.description().name;
    if UdpSocket::bind((ip, 0)).is_err() {
        println!("skipped: this host has no {ip}");
        return None;
    }
    let options = transport.description().options.iter();
    let of_sender = SocketSettings {
        timestamps: mode,
        path_mtu_bytes: Some(1_500),
        options: options
            .map(|one| (one.key.to_owned(), one.default))
            .collect(),
        ..SocketSettings::new(free_address(ip), free_address(ip))
    };
    let of_receiver = SocketSettings {
        local: of_sender.peer,
        peer: of_sender.local,
        ..of_sender.clone()
    };
    let mut receiver = match transport.open_receiver(&of_receiver, responder) {
        Err(SocketError::Refused { source, .. })
            if source.kind() == ErrorKind::PermissionDenied =>
        {
            println!("skipped: this host does not let {name} be opened");
            return None;
        }
        receiver => receiver.unwrap(),
    };
    let mut sender = transport.open_sender(&of_sender, initiator).unwrap();
    within_bound("connection", || {
        sender.sender.attend(now());
        receiver.receiver.attend(now());
        let connections = sender.connections.as_ref();
        connections
            .is_none_or(|one| one.begun_count() > 0)
            .then_some(())
    });
    Some((sender, receiver))
}

/// Every transport of the registry, over both versions of IP, with each kind of stamp that it has,
/// by itself and behind a link that changes nothing.
#[test]
fn every_transport_keeps_the_promises() {
    for transport in registry::ALL {
        let Description {
            name, capabilities, ..
        } = transport.description();
        let modes: &[TimestampMode] = match capabilities.unstamped_because {
            Some(_) => &[TimestampMode::Off],
            None => &[
                TimestampMode::Off,
                TimestampMode::Software,
                TimestampMode::Scheduled,
                TimestampMode::Hardware,
            ],
        };
        for ip in ["127.0.0.1", "::1"].map(|ip| ip.parse().unwrap()) {
            for mode in modes {
                let opened = || opened(transport, ip, *mode, None, None);
                let name = format!("{name} {ip} {mode:?}");
                if let Some((mut sender, mut receiver)) = opened() {
                    check_conformance(&name, &mut *sender.sender, &mut *receiver.receiver);
                }
                if let Some((mut sender, inner)) = opened() {
                    let mut receiver = perfect(inner.receiver);
                    let name = format!("emulated {name}");
                    check_conformance(&name, &mut *sender.sender, &mut receiver);
                }
            }
        }
    }
}

fn perfect(inner: Box<dyn DatagramReceiver>) -> EmulatedReceiver {
    let settings = EmulatedSettings::default();
    let any = |_: &[u8]| {
        Some(Offer {
            channel: 0,
            message: None,
        })
    };
    EmulatedReceiver::new(inner, Box::new(PerfectLink), any, 0, settings)
}

#[test]
fn the_queue_keeps_the_promises_with_and_without_stamps() {
    for transmit_stamps in [None, Some(made_up_stamps as fn(TxToken) -> KernelStamps)] {
        let (mut sender, mut receiver) = queue_pair(&QueueSettings {
            transmit_stamps,
            receive_stamps: transmit_stamps,
            ..QueueSettings::default()
        });
        check_conformance("queue", &mut sender, &mut receiver);
    }
}

#[test]
fn a_perfect_emulated_link_keeps_the_promises_of_the_queue() {
    let (mut sender, inner) = queue_pair(&QueueSettings::default());
    check_conformance("emulated queue", &mut sender, &mut perfect(Box::new(inner)));
}
