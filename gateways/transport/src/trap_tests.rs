//! The traps of kernel stamps and of UDP, each reproduced on loopback.

use std::net::{SocketAddr, UdpSocket};
use std::os::fd::AsFd;
use std::time::Duration;

use hil_core::time::Instant;

use super::conformance_tests::{udp_pair, within_bound};
use super::probe::{Availability, ProbeSettings, Sentinel, arm_and_probe};
use super::socket::SocketSettings;
use super::udp::{UdpReceiver, UdpSender};
use super::{DatagramReceiver, DatagramSender, SendRefusal};
use hil_net::TxToken;
use hil_net::clock_pair::{ClockPair, monotonic_now};
use hil_net::timestamping::{TimestampMode, arm_transmit};

const UNDRAINED_SEND_COUNT: u32 = 2000;
const ARRIVAL_COUNT: u32 = 50;

pub(super) fn loopback_settings() -> SocketSettings {
    let address = "127.0.0.1:0".parse().unwrap();
    SocketSettings::new(address, address)
}

pub(super) fn sentinel() -> Sentinel {
    let (report, sentinel) =
        arm_and_probe(&ProbeSettings::loopback(TimestampMode::Software)).unwrap();
    assert_eq!(report.rx_software, Availability::Seen, "{report:?}");
    sentinel
}

/// Counts what is waiting now. Loopback mostly delivers within the send call, but a loaded
/// kernel may do it later.
pub(super) fn count_waiting(receiver: &mut dyn DatagramReceiver) -> u32 {
    let mut count = 0;
    while let Some(_arrival) = receiver.receive(Instant::ZERO, &mut [0; 64]).unwrap() {
        count += 1;
    }
    count
}

/// Waits until `expected` have come.
fn expect_arrivals(receiver: &mut dyn DatagramReceiver, expected: u32) {
    let mut count = 0;
    within_bound("arrivals", || {
        count += count_waiting(receiver);
        (count >= expected).then_some(())
    });
    assert_eq!(count, expected);
}

pub(super) fn take_stamps(sender: &mut UdpSender) -> Vec<u32> {
    core::iter::from_fn(|| sender.next_stamp())
        .map(|stamp| stamp.token.0)
        .collect()
}

#[test]
fn an_undrained_sender_does_not_deafen_its_receiver() {
    // One gateway has both: its sender floods a sink, its receiver must still hear.
    let (mut own_sender, _sink) = udp_pair("127.0.0.1:0", TimestampMode::Software);
    let (mut other_sender, mut own_receiver) = udp_pair("127.0.0.1:0", TimestampMode::Software);
    for _ in 0..UNDRAINED_SEND_COUNT {
        own_sender.send(&[0; 64]).unwrap();
    }
    for _ in 0..ARRIVAL_COUNT {
        other_sender.send(&[1; 64]).unwrap();
    }
    expect_arrivals(&mut own_receiver, ARRIVAL_COUNT);
    // The flood was real: stamps had piled up, and draining ends.
    assert!(!take_stamps(&mut own_sender).is_empty());
}

/// The control: with one socket for both, the same flood does deafen it. This is why sending
/// and receiving are separate.
#[test]
fn one_socket_for_both_directions_goes_deaf() {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.set_nonblocking(true).unwrap();
    arm_transmit(&socket, TimestampMode::Software).unwrap();
    let sink = UdpSocket::bind("127.0.0.1:0").unwrap();
    for _ in 0..UNDRAINED_SEND_COUNT {
        socket
            .send_to(&[0; 64], sink.local_addr().unwrap())
            .unwrap();
    }
    let other = UdpSocket::bind("127.0.0.1:0").unwrap();
    for _ in 0..ARRIVAL_COUNT {
        other
            .send_to(&[1; 64], socket.local_addr().unwrap())
            .unwrap();
    }
    let mut heard_count = 0;
    while socket.recv(&mut [0; 64]).is_ok() {
        heard_count += 1;
    }
    println!("one socket heard {heard_count} of {ARRIVAL_COUNT}");
    assert!(heard_count < ARRIVAL_COUNT);
}

#[test]
fn a_sender_that_is_drained_gets_every_stamp_and_every_reply() {
    let (mut sender, mut receiver) = udp_pair("127.0.0.1:0", TimestampMode::Software);
    for index in 0..UNDRAINED_SEND_COUNT {
        assert_eq!(sender.send(&[0; 64]), Ok(TxToken(index)));
        let stamp = within_bound("stamp", || sender.next_stamp());
        assert_eq!(stamp.token, TxToken(index));
        assert!(stamp.stamps.software_ns.is_some() && stamp.stamps.hardware_ns.is_none());
        let arrival = within_bound("arrival", || {
            receiver.receive(Instant::ZERO, &mut [0; 64]).unwrap()
        });
        receiver.reply(b"heard", arrival.source).unwrap();
        within_bound("reply", || sender.receive(&mut [0; 64]).unwrap());
    }
    assert_eq!(sender.counters().unmatched_stamp_count, 0);
}

#[test]
fn a_failed_send_takes_no_token_and_shifts_no_stamp() {
    let (mut sender, receiver) = udp_pair("127.0.0.1:0", TimestampMode::Software);
    let too_long = vec![0; 66_000];
    assert_eq!(sender.send(&[0; 8]), Ok(TxToken(0)));
    assert!(sender.send(&too_long).is_err());
    assert_eq!(sender.send(&[0; 8]), Ok(TxToken(1)));
    drop(receiver);
    // A send after that provokes a report, which refuses a later one.
    within_bound("refusal", || sender.send(&[0; 8]).err());
    sender.send(&[0; 8]).ok();
    let sent_count = u32::try_from(sender.counters().sent_count).unwrap();
    let expected: Vec<u32> = (0..sent_count).collect();
    let mut tokens = Vec::new();
    within_bound("stamp of each send", || {
        tokens.extend(take_stamps(&mut sender));
        (tokens.len() >= expected.len()).then_some(())
    });
    assert_eq!(tokens, expected);
    let counters = sender.counters();
    assert_eq!(counters.unmatched_stamp_count, 0);
    assert_eq!(counters.too_long_count, 1);
    assert!(counters.peer_refused_count >= 1);
}

#[test]
fn a_dead_peer_is_a_state_that_ends_when_it_comes_back() {
    check_dead_peer("127.0.0.1:0");
    if UdpSocket::bind("[::1]:0").is_ok() {
        check_dead_peer("[::1]:0");
    }
}

/// The kernel answers each datagram with a report, as a stranger can: a sealed hop loses no datagram to it
/// and uses nothing of it.
#[test]
fn reports_of_the_network_cost_a_sealed_hop_no_datagram() {
    for address in ["127.0.0.1:0", "[::1]:0"] {
        let Ok(gone) = UdpSocket::bind(address) else {
            continue;
        };
        let local: SocketAddr = address.parse().unwrap();
        let settings = SocketSettings::new(local, gone.local_addr().unwrap());
        let mut sender = UdpSender::open_ignoring_reports(&settings).unwrap();
        drop(gone);
        for number in 0..1_000_u32 {
            // Undrained half of the time, so that the send itself meets the report.
            assert_eq!(sender.send(b"message"), Ok(TxToken(number)));
            if number % 2 == 0 {
                take_stamps(&mut sender);
                assert_eq!(sender.receive(&mut [0; 8]).unwrap(), None);
            }
        }
        take_stamps(&mut sender);
        let counters = sender.counters();
        assert_eq!((counters.sent_count, counters.refused_count()), (1_000, 0));
        assert_eq!(
            (counters.network_report_count, counters.newest_report),
            (0, None)
        );
        assert!(counters.ignored_report_count > 400, "{counters:?}");
    }
}

fn check_dead_peer(address: &str) {
    let (mut sender, receiver) = udp_pair(address, TimestampMode::Software);
    let address = receiver.local_address().unwrap();
    drop(receiver);
    // Drained after every send, each report is swallowed before it can refuse a datagram.
    let expect_report = |sender: &mut UdpSender, report_count| {
        within_bound("report", || {
            take_stamps(sender);
            (sender.counters().network_report_count == report_count).then_some(())
        });
    };
    for report_count in 1..=10 {
        sender.send(b"anyone?").unwrap();
        expect_report(&mut sender, report_count);
    }
    let counters = sender.counters();
    assert_eq!(counters.newest_report, Some(SendRefusal::PeerRefused));
    assert_eq!(counters.refused_count(), 0);
    // A pending report does not break the reading of replies either.
    sender.send(b"anyone?").unwrap();
    assert_eq!(sender.receive(&mut [0; 8]).unwrap(), None);
    expect_report(&mut sender, 11);

    let mut receiver = UdpReceiver::open(&SocketSettings::new(address, address)).unwrap();
    sender.send(b"welcome").unwrap();
    expect_arrivals(&mut receiver, 1);
}

#[test]
fn a_datagram_longer_than_the_path_is_refused_not_fragmented() {
    let (mut sender, _receiver) = udp_pair("127.0.0.1:0", TimestampMode::Software);
    let path = sender.path_mtu();
    assert!(!path.is_assumed);
    let longest = usize::try_from(path.datagram_bytes).unwrap();
    assert!(sender.send(&vec![0; longest]).is_ok());
    let length_bytes = longest + 1;
    let refusal = sender.send(&vec![0; length_bytes]).unwrap_err();
    assert_eq!(refusal, SendRefusal::TooLong { length_bytes });
}

#[test]
fn code_point_and_priority_are_both_kept() {
    let mut settings = loopback_settings();
    // Expedited forwarding alone would set priority 4.
    (settings.dscp, settings.priority) = (Some(46), Some(5));
    settings.send_buffer_bytes = Some(100_000);
    settings.receive_buffer_bytes = Some(100_000);
    settings.peer = "127.0.0.1:9".parse().unwrap();
    let sender = UdpSender::open(&settings).unwrap().granted();
    let receiver = UdpReceiver::open(&settings).unwrap().granted();
    for granted in [sender, receiver] {
        assert_eq!((granted.dscp, granted.priority), (46, 5));
        assert_eq!(granted.shortfalls(&settings), Vec::<String>::new());
    }
    settings.priority = None;
    let alone = UdpReceiver::open(&settings).unwrap().granted();
    assert_eq!((alone.dscp, alone.priority), (46, 4));
    if UdpSocket::bind("[::1]:0").is_ok() {
        settings.local = "[::1]:0".parse().unwrap();
        settings.priority = Some(5);
        let granted = UdpReceiver::open(&settings).unwrap().granted();
        assert_eq!((granted.dscp, granted.priority), (46, 5));
    }
}

#[test]
fn settings_that_cannot_be_are_refused_by_name_value_and_bound() {
    let mut settings = loopback_settings();
    settings.dscp = Some(64);
    let error = UdpReceiver::open(&settings).unwrap_err().to_string();
    assert_eq!(error, "dscp 64 is outside 0 to 63");
    settings.dscp = None;
    settings.receive_buffer_bytes = Some(usize::MAX);
    let error = UdpReceiver::open(&settings).unwrap_err().to_string();
    assert!(error.starts_with("SO_RCVBUF of 18446744073709551615 bytes is above 1073741823"));
    settings.receive_buffer_bytes = None;
    settings.interface = Some("no-such-device".into());
    let error = UdpReceiver::open(&settings).unwrap_err().to_string();
    assert!(error.contains("SO_BINDTODEVICE = no-such-device was refused: No such device"));
    settings.interface = None;
    settings.peer = "[::1]:9".parse().unwrap();
    assert!(UdpSender::open(&settings).is_err());
}

#[test]
fn a_full_receive_buffer_is_counted_by_the_kernel() {
    let mut settings = loopback_settings();
    settings.receive_buffer_bytes = Some(4096);
    let mut receiver = UdpReceiver::open(&settings).unwrap();
    settings.peer = receiver.local_address().unwrap();
    let mut sender = UdpSender::open(&settings).unwrap();
    for _ in 0..200 {
        sender.send(&[0; 64]).unwrap();
        take_stamps(&mut sender);
    }
    // The count comes with the next datagram, so ask until both add up.
    within_bound("sum of arrivals and drops", || {
        count_waiting(&mut receiver);
        sender.send(&[0; 64]).unwrap();
        expect_arrivals(&mut receiver, 1);
        let counters = receiver.counters();
        let known_count = counters.received_count + counters.kernel_drop_count;
        (known_count == sender.counters().sent_count).then_some(())
    });
    assert!(receiver.counters().kernel_drop_count > 100);
}

#[test]
fn after_the_probe_stamps_cover_the_arrivals_and_lie_between_our_clock_reads() {
    let _sentinel = sentinel();
    let (mut sender, mut receiver) = udp_pair("127.0.0.1:0", TimestampMode::Software);
    let pair = ClockPair::read(16).unwrap();
    for _ in 0..1000 {
        let before = monotonic_now().unwrap();
        sender.send(&[0; 64]).unwrap();
        let arrival = within_bound("arrival", || {
            receiver.receive(Instant::ZERO, &mut [0; 64]).unwrap()
        });
        let after = monotonic_now().unwrap();
        let slack = Duration::from_nanos(pair.bound_ns + 1000);
        if let Some(stamp_ns) = arrival.stamps.software_ns {
            let stamp = pair.to_monotonic(stamp_ns);
            assert!(stamp + slack >= before && stamp <= after + slack);
        }
        take_stamps(&mut sender);
    }
    let counters = receiver.counters();
    assert_eq!(counters.received_count, 1000);
    assert!(counters.software_stamp_count >= 990, "{counters:?}");
}

#[test]
fn a_pending_stamp_wakes_a_wait_for_replies_until_it_is_fetched() {
    use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
    let (mut sender, _receiver) = udp_pair("127.0.0.1:0", TimestampMode::Software);
    let wakes = |sender: &UdpSender| {
        let mut descriptors = [PollFd::new(sender.poll_fd().unwrap(), PollFlags::POLLIN)];
        poll(&mut descriptors, PollTimeout::ZERO).unwrap();
        descriptors[0].revents().unwrap()
    };
    assert_eq!(wakes(&sender), PollFlags::empty());
    sender.send(&[0; 8]).unwrap();
    let events = within_bound("wake-up", || {
        Some(wakes(&sender)).filter(|events| !events.is_empty())
    });
    assert_eq!(events, PollFlags::POLLERR);
    take_stamps(&mut sender);
    assert_eq!(wakes(&sender), PollFlags::empty());
    assert!(
        sender
            .poll_fd()
            .unwrap()
            .as_fd()
            .try_clone_to_owned()
            .is_ok()
    );
}
