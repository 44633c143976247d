//! The traps that need rights on the host: a real-time thread and a network of one's own. Where
//! the host refuses them a test says so and passes.

use std::process::Command;
use std::thread;
use std::time::Duration;

use nix::sched::{CloneFlags, CpuSet, sched_getaffinity, sched_setaffinity, unshare};
use nix::unistd::{Pid, gettid};

use super::conformance_tests::{udp_pair, within_bound};
use super::probe::{Availability, DISCARD_PORT, ProbeSettings, arm_and_probe};
use super::trap_tests::{count_waiting, loopback_settings, sentinel, take_stamps};
use super::udp::{UdpReceiver, UdpSender};
use super::{DatagramReceiver, DatagramSender, ReceiverCounters, SendRefusal};
use hil_net::clock_pair::{ClockPair, monotonic_now};
use hil_net::timestamping::{TimestampMode, has_carrier};

/// Gives `thread` the policy `SCHED_FIFO`; false when the host refuses or lacks `chrt`.
fn make_realtime(thread: Pid) -> bool {
    let arguments = ["-f", "-p", "10", &thread.to_string()];
    let output = Command::new("chrt").args(arguments).output();
    output.is_ok_and(|output| output.status.success())
}

/// Runs `body` in a real-time thread pinned to one CPU, where it must not take longer than the
/// rest of the machine can spare; `None` when the host refuses real-time.
fn in_a_realtime_thread<T: Send>(body: impl FnOnce() -> T + Send) -> Option<T> {
    let own = Pid::from_raw(0);
    let allowed = sched_getaffinity(own).unwrap();
    let cpu = (0..CpuSet::count()).find(|cpu| allowed.is_set(*cpu).unwrap())?;
    let mut one = CpuSet::new();
    one.set(cpu).unwrap();
    thread::scope(|scope| {
        let realtime = scope.spawn(|| {
            sched_setaffinity(own, &one).unwrap();
            make_realtime(gettid()).then(body)
        });
        realtime.join().unwrap()
    })
}

/// What a role does that opens its sockets in its own real-time thread and spins from then on:
/// the kernel's worker, which was to switch the stamps on, gets no CPU.
fn arm_and_spin() -> ReceiverCounters {
    let (mut sender, mut receiver) = udp_pair("127.0.0.1:0", TimestampMode::Software);
    for _ in 0..500 {
        sender.send(&[0; 64]).unwrap();
        take_stamps(&mut sender);
        count_waiting(&mut receiver);
    }
    // What a loaded kernel has not delivered yet.
    within_bound("all arrivals", || {
        count_waiting(&mut receiver);
        (receiver.counters().received_count == 500).then_some(())
    });
    receiver.counters()
}

#[test]
fn a_sentinel_keeps_the_stamps_when_a_realtime_thread_starves_the_kernel() {
    // For comparison only: tests beside this one may hold the stamps on.
    if let Some(counters) = in_a_realtime_thread(arm_and_spin) {
        let count = counters.software_stamp_count;
        println!("without a sentinel {count} of 500 arrivals had a stamp");
    }
    let _sentinel = sentinel();
    let Some(counters) = in_a_realtime_thread(arm_and_spin) else {
        println!("skipped: this host refuses SCHED_FIFO");
        return;
    };
    assert_eq!(counters.received_count, 500);
    assert!(counters.software_stamp_count >= 495, "{counters:?}");
}

#[test]
fn a_probe_in_a_realtime_thread_ends() {
    let mut settings = ProbeSettings::loopback(TimestampMode::Software);
    settings.bound = Duration::from_millis(300);
    let Some(result) = in_a_realtime_thread(|| arm_and_probe(&settings)) else {
        println!("skipped: this host refuses SCHED_FIFO");
        return;
    };
    let (report, _sentinel) = result.unwrap();
    println!("{report:?}");
    assert_ne!(report.rx_software, Availability::NotOffered);
    if report.rx_software == Availability::Seen {
        assert!(report.attempts >= settings.proof_count);
    }
}

/// Runs `body` in a thread with a network of its own, of which only loopback is up; skips when
/// the host refuses that or has no `ip` and `tc`.
fn in_an_own_network(body: impl FnOnce() + Send) {
    thread::scope(|scope| {
        scope.spawn(|| {
            let is_ready = unshare(CloneFlags::CLONE_NEWNET).is_ok()
                && run("ip link set lo up")
                && run("tc qdisc show dev lo");
            if is_ready {
                body();
            } else {
                println!("skipped: this host gives no network namespace, or has no ip or tc");
            }
        });
    });
}

fn run(line: &str) -> bool {
    let mut words = line.split(' ');
    let mut command = Command::new(words.next().unwrap());
    let output = command.args(words).output();
    output.is_ok_and(|output| output.status.success())
}

#[test]
fn an_unreachable_network_is_a_state() {
    in_an_own_network(|| {
        let mut settings = loopback_settings();
        settings.local = "0.0.0.0:0".parse().unwrap();
        let mut receiver = UdpReceiver::open(&settings).unwrap();
        let refusal = receiver.reply(b"x", "203.0.113.9:9".parse().unwrap());
        let errno = libc::ENETUNREACH;
        assert_eq!(refusal, Err(SendRefusal::Unreachable { errno }));
        assert_eq!(receiver.counters().reply_refused_count, 1);
    });
}

/// A full queueing discipline refuses a datagram that the kernel has counted already.
#[test]
fn a_full_queue_on_the_way_out_is_a_state_and_shifts_no_stamp() {
    in_an_own_network(|| {
        let (mut sender, _receiver) = udp_pair("127.0.0.1:0", TimestampMode::Software);
        let pair = ClockPair::read(16).unwrap();
        let check_send = |sender: &mut UdpSender| {
            let before = monotonic_now().unwrap();
            let token = sender.send(&[0; 64]).unwrap();
            let stamp = within_bound("stamp", || sender.next_stamp());
            assert_eq!(stamp.token, token);
            let stamp = pair.to_monotonic(stamp.stamps.software_ns.unwrap());
            assert!(stamp + Duration::from_nanos(pair.bound_ns + 1000) >= before);
            token.0
        };
        assert_eq!([0; 3].map(|_| check_send(&mut sender)), [0, 1, 2]);
        assert!(run("tc qdisc add dev lo root pfifo limit 0"));
        let errno = libc::ENOBUFS;
        for _ in 0..5 {
            assert_eq!(sender.send(&[0; 64]), Err(SendRefusal::QueueFull { errno }));
        }
        assert!(run("tc qdisc del dev lo root"));
        assert_eq!([0; 3].map(|_| check_send(&mut sender)), [3, 4, 5]);
        let counters = sender.counters();
        assert_eq!(
            (counters.queue_full_count, counters.unmatched_stamp_count),
            (5, 0)
        );
    });
}

/// The queue refuses as long as it is there, and what it refuses is the network's as soon as the other end is down.
#[test]
fn an_interface_whose_cable_is_out_is_an_unreachable_network() {
    in_an_own_network(|| {
        if !run("ip link add near type veth peer name far") {
            println!("skipped: this host has no veth");
            return;
        }
        let is_ready = run("ip addr add 198.51.100.1/24 dev near")
            && run("ip link set near up")
            && run("ip link set far up")
            && run("ip neigh add 198.51.100.2 lladdr 02:00:00:00:00:02 dev near nud permanent")
            && run("tc qdisc add dev near root pfifo limit 0");
        assert!(is_ready, "a veth pair can be configured");
        let mut settings = loopback_settings();
        settings.local = "198.51.100.1:0".parse().unwrap();
        settings.peer = ([198, 51, 100, 2], DISCARD_PORT).into();
        let mut sender = UdpSender::open(&settings).unwrap();
        within_bound("carrier", || has_carrier("near").unwrap().then_some(()));
        let errno = libc::ENOBUFS;
        let refusal = Err(SendRefusal::QueueFull { errno });
        assert_eq!(sender.send(&[0; 64]), refusal);
        assert!(run("ip link set far down"));
        assert!(!has_carrier("near").unwrap());
        for _ in 0..20 {
            // Once the queue is gone the kernel takes what it is given and drops it.
            if let Err(refusal) = sender.send(&[0; 64]) {
                assert_eq!(refusal, SendRefusal::Unreachable { errno });
            }
        }
        assert_eq!(sender.counters().queue_full_count, 1);
    });
}

#[test]
fn an_interface_is_probed_by_what_leaves_through_it() {
    in_an_own_network(|| {
        if !run("ip link add near type veth peer name far") {
            println!("skipped: this host has no veth");
            return;
        }
        let is_ready = run("ip addr add 198.51.100.1/24 dev near")
            && run("ip link set near up")
            && run("ip link set far up")
            && run("ip neigh add 198.51.100.2 lladdr 02:00:00:00:00:02 dev near nud permanent");
        assert!(is_ready, "a veth pair can be configured");
        let mut settings = ProbeSettings::loopback(TimestampMode::Scheduled);
        settings.interface = Some("near".into());
        settings.transmit_target = Some(([198, 51, 100, 2], DISCARD_PORT).into());
        let (report, _sentinel) = arm_and_probe(&settings).unwrap();
        assert_eq!(report.tx_software, Availability::Seen, "{report:?}");
        assert_eq!(report.tx_scheduled, Availability::Seen, "{report:?}");
        // Unbound, the route leads to the same interface.
        settings.interface = None;
        let (report, _sentinel) = arm_and_probe(&settings).unwrap();
        assert!(report.capabilities.is_some_and(|claims| claims.tx_software));

        // Nobody answers for this address, so nothing leaves and no stamp comes.
        settings.transmit_target = Some(([198, 51, 100, 3], DISCARD_PORT).into());
        settings.bound = Duration::from_millis(100);
        let (report, _sentinel) = arm_and_probe(&settings).unwrap();
        assert_eq!(report.tx_software, Availability::ClaimedButNotSeen);

        // And no way leads there.
        settings.transmit_target = Some(([203, 0, 113, 1], DISCARD_PORT).into());
        settings.interface = Some("far".into());
        match arm_and_probe(&settings) {
            Ok((report, _sentinel)) => assert_ne!(report.tx_software, Availability::Seen),
            Err(error) => println!("{error}"),
        }
    });
}
