//! A channel whose reader lost an announcement: it must be woken by the next ones all the same.
//! Before, it never was again, and every message waited for the reader's own patience.

use std::os::fd::AsRawFd;
use std::time::Duration;

use hil_core::message::MessageType;
use hil_platform::clock::MonotonicClock;
use hil_shm::{ChannelHolder, ChannelSettings, Domain, OutputSettings, TypedOutput, Waiter, Wake};
use hil_shuttle::ShuttleStatus;
use hil_tests::run_folder::RunFolder;
use nix::errno::Errno;
use nix::sys::socket::{MsgFlags, recv};

const CHANNEL: &str = "arm/status";
const STATUS: MessageType = MessageType::of::<ShuttleStatus>();
/// Nothing comes within it.
const SHORT: Duration = Duration::from_millis(5);
/// Only a wake-up that never comes takes so long.
const NEVER: Duration = Duration::from_secs(20);

/// Takes what lies in the reader's socket, and leaves the mark "has been told" in shared memory: what
/// iceoryx2 0.10 does when an announcement comes between its marking the listener as idle and its
/// emptying the socket.
fn rob(waiter: &Waiter) {
    let mut byte = [0];
    let socket = waiter.descriptor().as_raw_fd();
    assert_eq!(recv(socket, &mut byte, MsgFlags::MSG_DONTWAIT), Ok(1));
    let rest = recv(socket, &mut byte, MsgFlags::MSG_DONTWAIT);
    assert_eq!(rest, Err(Errno::EAGAIN));
}

#[test]
fn a_reader_that_lost_an_announcement_is_woken_by_the_next() {
    let folder = RunFolder::new("wake-ups");
    let domain = Domain::create(&folder.join("d")).unwrap();
    let holder = ChannelHolder::create(&domain, &ChannelSettings::of(CHANNEL, &STATUS)).unwrap();
    let mut waiter = Waiter::open(&domain, &[CHANNEL]).unwrap();
    let settings = OutputSettings::default();
    let mut output = TypedOutput::<ShuttleStatus>::open(&domain, CHANNEL, settings).unwrap();
    let mut announce = || {
        let message = ShuttleStatus { position_m: 0.0 };
        output.send(MonotonicClock::now(), message).unwrap();
    };
    // Whether it waits for a while, or takes announcements back for whatever reason.
    let recoveries: [fn(&mut Waiter); 2] = [
        |waiter| assert_eq!(waiter.wait(SHORT).unwrap(), Wake::Woken),
        |waiter| assert!(waiter.drain(0).unwrap()),
    ];
    for recover in recoveries {
        announce();
        rob(&waiter);
        // Nobody is told of this one.
        announce();
        recover(&mut waiter);
        assert_eq!(waiter.wait(SHORT).unwrap(), Wake::TimedOut);
        announce();
        assert_eq!(waiter.wait(NEVER).unwrap(), Wake::Woken);
    }
    drop((waiter, output, holder));
    assert!(domain.remove().remained.is_empty());
}
