//! The stamps of replies, on loopback: they are the reply's own, and a socket whose stamps nobody
//! fetches keeps hearing.

use std::net::{SocketAddr, UdpSocket};
use std::time::Duration;

use hil_core::time::Instant;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};

use super::DatagramReceiver;
use super::conformance_tests::within_bound;
use super::trap_tests::{count_waiting, loopback_settings};
use super::udp::UdpReceiver;
use hil_net::clock_pair::{ClockPair, monotonic_now};
use hil_net::timestamping::TimestampMode;

const UNFETCHED_REPLY_COUNT: u64 = 2000;
const ARRIVAL_COUNT: u32 = 50;

fn receiver(mode: TimestampMode) -> (UdpReceiver, SocketAddr) {
    let mut settings = loopback_settings();
    settings.timestamps = mode;
    let receiver = UdpReceiver::open(&settings).unwrap();
    let address = receiver.local_address().unwrap();
    (receiver, address)
}

fn peer() -> (UdpSocket, SocketAddr) {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let address = socket.local_addr().unwrap();
    (socket, address)
}

fn wakes(receiver: &UdpReceiver) -> PollFlags {
    let mut descriptors = [PollFd::new(receiver.poll_fd().unwrap(), PollFlags::POLLIN)];
    poll(&mut descriptors, PollTimeout::ZERO).unwrap();
    descriptors[0].revents().unwrap()
}

#[test]
fn a_receiver_whose_reply_stamps_nobody_fetches_still_hears() {
    let (mut receiver, address) = receiver(TimestampMode::Software);
    let (peer, sink) = peer();
    for _ in 0..UNFETCHED_REPLY_COUNT {
        let now = monotonic_now().unwrap();
        receiver.reply_stamped(now, &[0; 64], sink).unwrap();
    }
    for _ in 0..ARRIVAL_COUNT {
        peer.send_to(&[1; 64], address).unwrap();
    }
    let mut heard_count = 0;
    within_bound("arrivals", || {
        heard_count += count_waiting(&mut receiver);
        (heard_count >= ARRIVAL_COUNT).then_some(())
    });
    let counters = receiver.counters();
    assert_eq!(counters.reply_count, UNFETCHED_REPLY_COUNT);
    assert_eq!(counters.kernel_drop_count, 0);
    // The stamps were real, and each was settled before the next was asked for.
    assert!(counters.reply_stamp_count > 0, "{counters:?}");
    let settled_count = counters.reply_stamp_count + counters.reply_stamp_missing_count;
    assert!(settled_count >= UNFETCHED_REPLY_COUNT - 1, "{counters:?}");
}

#[test]
fn each_reply_gets_its_own_stamp_and_leaves_nothing_behind() {
    let (mut receiver, _address) = receiver(TimestampMode::Software);
    let (_peer, sink) = peer();
    let pair = ClockPair::read(16).unwrap();
    let slack = Duration::from_nanos(pair.bound_ns + 1000);
    for index in 0..500 {
        if index % 3 == 0 {
            // Neither asks for a stamp nor is counted by the kernel.
            receiver.reply(b"unstamped", sink).unwrap();
        }
        if index % 50 == 7 {
            let before = monotonic_now().unwrap();
            let refused = receiver.reply_stamped(before, &vec![0; 66_000], sink);
            assert!(refused.is_err());
        }
        let before = monotonic_now().unwrap();
        receiver.reply_stamped(before, b"stamped", sink).unwrap();
        let realtime_ns = within_bound("stamp", || receiver.take_reply_stamp(before));
        let after = monotonic_now().unwrap();
        let left = pair.to_monotonic(realtime_ns);
        assert!(left + slack >= before && left <= after + slack, "{index}");
        assert_eq!(receiver.take_reply_stamp(before), None);
        assert_eq!(wakes(&receiver), PollFlags::empty());
    }
    let counters = receiver.counters();
    assert_eq!(counters.reply_stamp_count, 500);
    assert_eq!(counters.reply_stamp_missing_count, 0);
    assert_eq!(counters.reply_refused_count, 10);
}

#[test]
fn a_stamp_is_given_up_in_time_and_taken_off_the_queue_when_it_comes_after_all() {
    let (mut receiver, _address) = receiver(TimestampMode::Software);
    let (_peer, sink) = peer();
    receiver
        .reply_stamped(Instant::ZERO, b"late", sink)
        .unwrap();
    within_bound("pending stamp", || {
        Some(wakes(&receiver)).filter(|events| events.contains(PollFlags::POLLERR))
    });
    // As if the stamp had come long after: replaced by another reply's, it is no one's.
    let later = Instant::ZERO + Duration::from_secs(1);
    receiver.reply_stamped(later, b"next", sink).unwrap();
    within_bound("stamp", || receiver.take_reply_stamp(later));
    let counters = receiver.counters();
    let settled_count = counters.reply_stamp_count + counters.reply_stamp_missing_count;
    assert_eq!(settled_count, 2, "{counters:?}");
    // Without one awaited the queue is looked at by time only.
    let soon = later + Duration::from_millis(1);
    assert_eq!(receiver.take_reply_stamp(soon), None);
    assert_eq!(wakes(&receiver), PollFlags::empty());
}

#[test]
fn where_departures_are_not_stamped_no_reply_asks() {
    for mode in [TimestampMode::Off, TimestampMode::Scheduled] {
        let (mut receiver, _address) = receiver(mode);
        let (peer, sink) = peer();
        receiver
            .reply_stamped(Instant::ZERO, b"plain", sink)
            .unwrap();
        peer.recv(&mut [0; 8]).unwrap();
        let later = Instant::ZERO + Duration::from_secs(1);
        assert_eq!(receiver.take_reply_stamp(later), None);
        assert_eq!(wakes(&receiver), PollFlags::empty());
        let counters = receiver.counters();
        assert_eq!(
            (counters.reply_count, counters.reply_stamp_missing_count),
            (1, 0)
        );
    }
}
