//! What strangers send while a sealed run goes on, in turns with as long a time without: no kind of it costs the run
//! messages above the time beside it. And neighbours of IPv6.
//!
//! `HIL_ATTACK_ROUNDS=20` sends each kind so often, half a second each time: 20,000 messages under it, and as many beside.

use core::cell::Cell;
use core::slice;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, SocketAddrV4, SocketAddrV6};
use std::time::Duration;
use std::{fs, thread};

use hil_core::random::RandomStream;
use hil_platform::clock::MonotonicClock;
use hil_report::summary::{CounterGroup, RunEvent, RunEventKind, RunSummary};
use hil_rundir::event::EventKind;
use hil_rundir::run_folder::RunFolder as Folder;
use hil_rundir::run_result::RunResult;
use hil_tests::account::assert_accounts_close;
use hil_tests::attacker::{
    Attacker, Exact, FOREIGN, FOREIGN_V6, Quoted, datagram_v4, reports_v4, reset_v4, segment_v4,
    syn_v4,
};
use hil_tests::knocker::CONTROL_PORT;
use hil_tests::lab::{ADDRESSES, ADDRESSES_V6, INTERFACE, Lab};
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::CHANNELS;
use hil_tests::split::{HOSTS, Split, count, direction, refused};
use hil_tests::trial::{RunFiles, Trial};
use hil_tests::turns::{TURN, cost, judge, play, roomy, round_count};

use super::strangers::made_up;

const LIMIT: Duration = Duration::from_mins(1);
/// No other file of tests uses these ports.
const PORT: u16 = 7_900;
/// Of the link from the first host to the second, and back.
const PORTS: [u16; 2] = [PORT, PORT + 1];
/// Where the first clock path of a host listens, unless the topology says otherwise.
const CLOCK_PORT: u16 = 7_390;
/// Beside those of the data.
const CLOCK_ADDRESSES: [Ipv4Addr; 2] = [Ipv4Addr::new(10, 77, 0, 11), Ipv4Addr::new(10, 77, 0, 12)];
const CLOCK_ADDRESSES_V6: [Ipv6Addr; 2] = [
    Ipv6Addr::new(0xfd77, 0, 0, 0, 0, 0, 0, 0x11),
    Ipv6Addr::new(0xfd77, 0, 0, 0, 0, 0, 0, 0x12),
];
/// Messages a second of each of the two channels.
const MESSAGES_HZ: u32 = 1_000;
/// Longer than any test: it stops the run itself.
const UNTIL_STOPPED: &str = "run.duration=\"10 min\"";
/// Resets that the hosts have answered with, for beginnings of connections where nothing listens.
fn resets_sent(lab: &Lab) -> u64 {
    let counts = [0, 1].map(|index| {
        // Of the thread's network.
        let path = "/proc/thread-self/net/snmp";
        let text = lab
            .host(index)
            .on_network(|| fs::read_to_string(path).unwrap());
        let mut lines = text.lines().filter_map(|line| line.strip_prefix("Tcp: "));
        let mut names = lines.next().unwrap().split(' ');
        let place = names.position(|name| name == "OutRsts").unwrap();
        let count = lines.next().unwrap().split(' ').nth(place).unwrap();
        count.parse::<u64>().unwrap()
    });
    counts.iter().sum()
}

/// As a stranger sees it.
fn at(address: Ipv4Addr, port: u16) -> SocketAddrV4 {
    SocketAddrV4::new(address, port)
}

/// Where these come from: a host has to have a way to answer.
const EVERYWHERE: &str = "10.77.96.0/20";

/// Beginnings of connections from 2000 addresses, to these ports of both hosts.
fn beginnings(ports: [u16; 2]) -> Vec<Vec<u8>> {
    let packets = (0..2_000_u16).map(|number| {
        let [high, low] = number.to_be_bytes();
        let from = at(Ipv4Addr::new(10, 77, 100 + high, low), 1_024 + number);
        let to = ADDRESSES[usize::from(number / 2 % 2)];
        syn_v4(from, at(to, ports[usize::from(number % 2)]))
    });
    packets.collect()
}

/// ICMP of every type, datagrams and clock exchanges from the peers' addresses, beginnings of connections from
/// everywhere: at both ports of the run, at the supervisors' and at the clock path's.
#[test]
fn forged_traffic_of_each_kind_costs_a_sealed_run_nothing_above_the_time_beside_it() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let stranger = Attacker::join(&lab, FOREIGN);
    let record = RunFolder::new("forged");
    let rounds = round_count(4);
    let mut trial = roomy(Trial::shipped("shuttle-split.toml", record.path()))
        .set(&format!("links.hop.port={PORT}"))
        .set(&format!("case.parameters.rate_hz={MESSAGES_HZ}.0"))
        .set(UNTIL_STOPPED);
    for (index, host) in HOSTS.iter().enumerate() {
        lab.host(index).add_route(EVERYWHERE);
        lab.host(index).add_address(CLOCK_ADDRESSES[index]);
        let address = CLOCK_ADDRESSES[index];
        stranger.know(address.into(), &lab.host(index).hardware_address());
        trial = trial.set(&format!("hosts.{host}.clock_address=\"{address}\""));
    }
    let split = Split::start(&lab, &trial);
    split.wait_for_messages("the begin of the run");
    let mut random = RandomStream::new(7, "forged");
    let mut forge = |port: u16, ends: [Ipv4Addr; 2], from_port: u16| {
        let recorded = stranger.overhear(port, 100, LIMIT);
        assert!(recorded.len() >= 100, "the stranger hears port {port}");
        let packets = (0..1_800).map(|number| {
            let words = made_up(&recorded, &mut random, number);
            datagram_v4(at(ends[0], from_port), at(ends[1], port), &words)
        });
        packets.collect::<Vec<_>>()
    };
    let datagrams = forge(PORT, ADDRESSES, PORT);
    let exchanges = forge(CLOCK_PORT, CLOCK_ADDRESSES, CLOCK_PORT);
    let quoted = [0, 1].map(|from| {
        let data = [from, 1 - from].map(|end| at(ADDRESSES[end], PORTS[from]));
        let clock = [from, 1 - from].map(|end| at(CLOCK_ADDRESSES[end], CLOCK_PORT));
        [data, clock]
    });
    let reports = reports_v4(Quoted::Udp, &quoted.concat());
    let beginnings = beginnings([CONTROL_PORT, PORT]);
    let send = |packets: &[Vec<u8>]| stranger.send_repeatedly(packets, TURN).sent_count;
    let reset_count = Cell::new(0);
    let all = play(
        &[
            ("forged datagrams from the peer's address", &|| {
                send(&datagrams)
            }),
            ("forged clock exchanges from the peer's address", &|| {
                send(&exchanges)
            }),
            ("ICMP of every type", &|| send(&reports)),
            ("beginnings of connections from 2000 addresses", &|| {
                let before = resets_sent(&lab);
                let sent_count = send(&beginnings);
                reset_count.set(reset_count.get() + resets_sent(&lab) - before);
                sent_count
            }),
        ],
        rounds,
    );
    let files = [0, 1].map(|index| split.files[index].clone());
    let summaries = split.stop();
    judge(&files, &all);
    let [datagrams, exchanges, _, beginnings] = &all[..] else {
        panic!("four kinds");
    };
    let ingress = direction(&summaries[1], CHANNELS[0], "ingress");
    let pair = &summaries[1].clocks.as_ref().unwrap().pairs[0];
    let clock_path = &pair.clock_path.as_ref().unwrap().name;
    let by_clock_path = refused_by_end_of(&files[1], clock_path, HOSTS[1]);
    for (turns, refused_count) in [(datagrams, refused(ingress)), (exchanges, by_clock_path)] {
        println!("{}: {refused_count} refused", turns.name);
        assert!(refused_count * 10 > turns.sent_count * 9);
    }
    let reset_count = reset_count.get();
    println!("{}: {reset_count} answered by a reset", beginnings.name);
    assert!(reset_count * 10 > beginnings.sent_count * 9);
    for (summary, name) in summaries.iter().zip(CHANNELS) {
        let ignored = count(
            direction(summary, name, "egress"),
            "socket: ignored_report_count",
        );
        println!("{}: {ignored} reports ignored", summary.run.host);
        assert!(ignored > 0);
        let pair = &summary.clocks.as_ref().unwrap().pairs[0];
        assert_eq!(pair.contradiction, None);
        let path = pair.clock_path.as_ref().unwrap();
        println!("{}: clock path {path:?}", summary.run.host);
        assert!(path.has_exchanges());
        assert!(cuts(summary).is_empty(), "{:?}", summary.events);
    }
    for summary in &summaries {
        assert_accounts_close(summary);
    }
}

/// What a stranger can send to the connections of a sealed TCP hop and of the supervisors, whose ports it heard: the kernel
/// believes none of it (RFC 5961, RFC 5927), but for a reset with exactly the number that is expected next.
#[test]
fn forged_traffic_costs_a_sealed_tcp_hop_nothing_and_an_exact_reset_one_reconnect() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let stranger = Attacker::join(&lab, FOREIGN);
    let record = RunFolder::new("forged-tcp");
    let rounds = round_count(4);
    let trial = roomy(Trial::shipped("shuttle-tcp.toml", record.path()))
        .set(&format!("links.hop.port={PORT}"))
        .set(&format!("case.parameters.rate_hz={MESSAGES_HZ}.0"))
        .set(UNTIL_STOPPED);
    for index in [0, 1] {
        lab.host(index).add_route(EVERYWHERE);
    }
    let split = Split::start(&lab, &trial);
    split.wait_for_messages("the begin of the run");
    let ports = [PORTS[0], PORTS[1], CONTROL_PORT];
    let exact = [Exact::Reset, Exact::End, Exact::Content].map(|what| {
        let began_ns = MonotonicClock::now().as_ns();
        for host in ADDRESSES {
            let sent_count = stranger.forge_exactly(what, PORT, host, LIMIT);
            println!("{sent_count} of {what:?} at {host}");
            thread::sleep(TURN);
        }
        split.wait_for_messages("an exact forgery");
        (what, began_ns..MonotonicClock::now().as_ns())
    });
    let ways = connections(&lab, &ports).map(|ends| {
        ends.map(|end| match end {
            SocketAddr::V4(end) => end,
            SocketAddr::V6(end) => panic!("{end} in a run of IPv4"),
        })
    });
    let ways: Vec<_> = ways.collect();
    let reports = reports_v4(Quoted::Tcp, &ways);
    let ways = || ways.iter().copied();
    let mut random = RandomStream::new(8, "forged");
    let mut blind = |forge: fn(SocketAddrV4, SocketAddrV4, u32) -> Vec<u8>| {
        let packets = (0..700).flat_map(|_| {
            let [a, b, c, d, ..] = random.next_u64().to_le_bytes();
            let guess = u32::from_le_bytes([a, b, c, d]);
            ways().map(move |[from, to]| forge(from, to, guess))
        });
        packets.collect::<Vec<_>>()
    };
    let resets = blind(reset_v4);
    let beginnings = blind(|from, to, _| syn_v4(from, to));
    let from_everywhere = self::beginnings(PORTS);
    let half_open_count = Cell::new(0);
    let contents = blind(|from, to, guess| {
        let words = guess.to_le_bytes().repeat(24);
        segment_v4(from, to, guess, &words)
    });
    let send = |packets: &[Vec<u8>]| stranger.send_repeatedly(packets, TURN).sent_count;
    let all = play(
        &[
            ("ICMP of every type on connections", &|| send(&reports)),
            ("resets with a guessed number", &|| send(&resets)),
            ("beginnings in a connection that is up", &|| {
                send(&beginnings)
            }),
            ("content with a guessed number", &|| send(&contents)),
            ("beginnings of connections from 2000 addresses", &|| {
                let sent_count = send(&from_everywhere);
                let half_open = lab.host(1).connections("syn-recv", PORT).len();
                half_open_count.set(half_open_count.get().max(half_open));
                sent_count
            }),
        ],
        rounds,
    );
    println!("{} half-open connections at most", half_open_count.get());
    assert!(half_open_count.get() > 0);
    let files = [0, 1].map(|index| split.files[index].clone());
    let summaries = split.stop();
    judge(&files, &all);
    for (what, window_ns) in &exact {
        let commands = cost(
            [&files[0], &files[1]],
            CHANNELS[0],
            slice::from_ref(window_ns),
        );
        println!("commands under an exact {what:?} at each end: {commands:?}");
    }
    for (summary, name) in summaries.iter().zip(CHANNELS) {
        let egress = direction(summary, name, "egress");
        let reconnects = count(egress, "transport: reconnect_count");
        println!("{name}: {reconnects} reconnects");
        assert!(if name == CHANNELS[0] {
            reconnects >= 6
        } else {
            reconnects == 0
        });
        assert!(cuts(summary).is_empty(), "{:?}", summary.events);
        assert_accounts_close(summary);
    }
    let mut told = summaries[0].events.iter().map(RunEvent::what);
    assert!(told.any(|what| what.contains("and is back (reconnect 2)")));
}

/// Both ways of each connection that has one of `ports`, as its sending end sees it.
fn connections(lab: &Lab, ports: &[u16]) -> impl Iterator<Item = [SocketAddr; 2]> {
    let all: Vec<_> = ports
        .iter()
        .flat_map(|port| {
            let found = lab.host(0).connections("established", *port);
            assert!(!found.is_empty(), "no connection with port {port}");
            found
        })
        .collect();
    all.into_iter()
        .flat_map(|[own, other]| [[own, other], [other, own]])
}

/// Datagrams that the end of the clock path `flow` on `host` refused, whatever the cause. It has no channels, and is in no
/// summary.
fn refused_by_end_of(files: &RunFiles, flow: &str, host: &str) -> u64 {
    let result = RunResult::read(&Folder::existing(files.root())).unwrap();
    let here = result.processes.iter().filter(|one| one.host == host);
    let directions = here.filter_map(|one| one.report.as_ref());
    let directions = directions.flat_map(|report| &report.directions);
    let counters = directions.filter(|one| one.flow == flow);
    let counters = counters.flat_map(|one| &one.counters);
    let refused = counters.filter(|one| one.group == CounterGroup::Refused);
    refused.map(|one| one.count).sum()
}

fn cuts(summary: &RunSummary) -> Vec<String> {
    let events = summary.events.iter();
    let cuts = events.filter(|event| {
        matches!(
            event.kind,
            RunEventKind::Process(EventKind::Reconnected { .. })
        )
    });
    cuts.map(RunEvent::what).collect()
}

/// A run whose hosts have addresses of IPv6, on a bridge with a stranger.
fn run_of_v6<'a>(
    lab: &'a Lab,
    topology: &str,
    record: &RunFolder,
    duration: &str,
) -> (Split<'a>, Attacker) {
    let stranger = Attacker::join(lab, FOREIGN);
    stranger.add_address(FOREIGN_V6);
    let mut trial = roomy(Trial::shipped(topology, record.path()))
        .set(&format!("links.hop.port={PORT}"))
        .set(&format!("case.parameters.rate_hz={MESSAGES_HZ}.0"))
        .set(duration);
    for (index, host) in HOSTS.iter().enumerate() {
        let host_here = lab.host(index);
        let (address, clock_address) = (ADDRESSES_V6[index], CLOCK_ADDRESSES_V6[index]);
        for address in [address, clock_address] {
            host_here.add_address(address);
            stranger.know(address.into(), &host_here.hardware_address());
        }
        trial = trial
            .set(&format!("hosts.{host}.address=\"{address}\""))
            .set(&format!("hosts.{host}.clock_address=\"{clock_address}\""));
    }
    let split = Split::start(lab, &trial);
    split.wait_for_messages("the begin of the run");
    (split, stranger)
}

#[test]
fn icmpv6_of_every_type_costs_a_sealed_run_nothing_above_the_time_beside_it() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("forged-v6");
    let rounds = round_count(4);
    let (split, stranger) = run_of_v6(&lab, "shuttle-split.toml", &record, UNTIL_STOPPED);
    let reports = |to: usize| {
        let ends = [(ADDRESSES_V6, PORTS[to]), (CLOCK_ADDRESSES_V6, CLOCK_PORT)];
        let quoted = ends.map(|(addresses, port)| {
            [to, 1 - to].map(|index| SocketAddrV6::new(addresses[index], port, 0, 0))
        });
        let flood = stranger.forge_reports_v6(Quoted::Udp, &quoted, TURN);
        flood.sent_count
    };
    let all = play(
        &[
            ("ICMPv6 of every type at the first host", &|| reports(0)),
            ("ICMPv6 of every type at the second host", &|| reports(1)),
        ],
        rounds,
    );
    let files = [0, 1].map(|index| split.files[index].clone());
    let summaries = split.stop();
    judge(&files, &all);
    for (summary, name) in summaries.iter().zip(CHANNELS) {
        let ignored = count(
            direction(summary, name, "egress"),
            "socket: ignored_report_count",
        );
        println!("{}: {ignored} reports ignored", summary.run.host);
        assert!(ignored > 0);
        assert_accounts_close(summary);
    }
}

#[test]
fn icmpv6_of_every_type_costs_a_sealed_tcp_hop_and_the_supervisors_nothing() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("forged-tcp-v6");
    let rounds = round_count(4);
    let (split, stranger) = run_of_v6(&lab, "shuttle-tcp.toml", &record, UNTIL_STOPPED);
    let ways = connections(&lab, &[PORTS[0], PORTS[1], CONTROL_PORT]);
    let ways: Vec<_> = ways
        .map(|ends| {
            ends.map(|end| match end {
                SocketAddr::V6(end) => end,
                SocketAddr::V4(end) => panic!("{end} in a run of IPv6"),
            })
        })
        .collect();
    let reports = || {
        let flood = stranger.forge_reports_v6(Quoted::Tcp, &ways, TURN);
        flood.sent_count
    };
    let all = play(&[("ICMPv6 of every type on connections", &reports)], rounds);
    let files = [0, 1].map(|index| split.files[index].clone());
    let summaries = split.stop();
    judge(&files, &all);
    for (summary, name) in summaries.iter().zip(CHANNELS) {
        let egress = direction(summary, name, "egress");
        assert_eq!(count(egress, "transport: reconnect_count"), 0);
        assert!(cuts(summary).is_empty(), "{:?}", summary.events);
        assert_accounts_close(summary);
    }
}

/// As with ARP, the messages to the host whose address is taken are lost on the wire, and the change is told.
#[test]
fn a_stranger_that_advertises_a_hosts_address_of_ipv6_is_told_with_both_link_addresses() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("claimed-v6");
    let (mut split, stranger) =
        run_of_v6(&lab, "shuttle-split.toml", &record, "run.duration=\"8 s\"");
    let claimed_at = "02:00:00:00:00:68";
    stranger.claim_v6(ADDRESSES_V6[0], ADDRESSES_V6[1], claimed_at);
    let words = format!("is at {claimed_at} on {INTERFACE}");
    let seen = split.hosts[0].wait_for_output(&words, LIMIT);
    seen.unwrap_or_else(|reason| panic!("{reason}"));
    // Pinned, it is found again, and stays.
    lab.host(0)
        .pin_neighbour(ADDRESSES_V6[1], &lab.host(1).hardware_address());
    stranger.claim_v6(ADDRESSES_V6[0], ADDRESSES_V6[1], "02:00:00:00:00:69");
    let summaries = split.finish();
    let changes: Vec<_> = summaries[0]
        .events
        .iter()
        .filter(|event| {
            matches!(
                event.kind,
                RunEventKind::Process(EventKind::NeighbourChanged { .. })
            )
        })
        .collect();
    for event in &changes {
        println!("at {:?} s: {}", event.at_s, event.what());
    }
    let told = |hardware: &str| changes.iter().any(|event| event.what().contains(hardware));
    assert!(
        told(claimed_at) && !told("02:00:00:00:00:69"),
        "{changes:?}"
    );
}
