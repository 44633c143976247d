//! One socket that hears anyone and answers.

use std::net::{Ipv4Addr, UdpSocket};
use std::thread;

use super::trap_tests::loopback_settings;
use super::udp::UdpSender;
use super::{DatagramSender, SendRefusal};
use hil_net::TransmitStage;

fn server() -> UdpSender {
    UdpSender::open_answering(&loopback_settings()).unwrap()
}

/// Waits for what loopback delivers at once, unless the machine is busy.
fn soon<T>(mut look: impl FnMut() -> Option<T>) -> T {
    for _ in 0..5_000_000 {
        if let Some(found) = look() {
            return found;
        }
        thread::yield_now();
    }
    panic!("nothing came");
}

#[test]
fn it_hears_anyone_and_answers_from_the_port_that_was_spoken_to() {
    let mut server = server();
    let address = server.local_address().unwrap();
    assert!(matches!(
        server.send(b"early"),
        Err(SendRefusal::Other { errno }) if errno == libc::EDESTADDRREQ
    ));
    for word in [b"one", b"two"] {
        let client = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        client.send_to(word, address).unwrap();
        let mut buffer = [0; 16];
        let received = soon(|| server.receive(&mut buffer).unwrap());
        assert_eq!(&buffer[..received.length_bytes], word);
        assert_eq!(received.source, client.local_addr().unwrap());
        server.answer_to(received.source);
        let token = server.send(b"answer").unwrap();
        let stamp = soon(|| server.next_stamp());
        assert_eq!((stamp.token, stamp.stage), (token, TransmitStage::Sent));
        assert!(stamp.stamps.software_ns.is_some());
        let (length, from) = client.recv_from(&mut buffer).unwrap();
        assert_eq!((&buffer[..length], from), (&b"answer"[..], address));
    }
}

#[test]
fn a_peer_that_is_gone_is_a_report_and_the_next_peer_is_served() {
    let mut server = server();
    let address = server.local_address().unwrap();
    let gone = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    server.answer_to(gone.local_addr().unwrap());
    drop(gone);
    server.send(b"nobody hears this").unwrap();
    soon(|| {
        while server.next_stamp().is_some() {}
        (server.counters().ignored_report_count > 0).then_some(())
    });
    let client = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    client.send_to(b"here", address).unwrap();
    let mut buffer = [0; 16];
    let received = soon(|| server.receive(&mut buffer).unwrap());
    server.answer_to(received.source);
    assert!(soon(|| server.send(b"hello").ok()).0 > 0);
    assert_eq!(client.recv(&mut buffer).unwrap(), 5);
}
