//! What strangers send while a sealed run goes on, in turns with as long a time without: no kind of it costs the run
//! messages above the time beside it. And neighbours of IPv6.
//!
//! `HIL_ATTACK_ROUNDS=20` sends each kind so often, half a second each time: 20,000 messages under it, and as many beside.

use core::cell::Cell;
use core::ops::Range;
use std::collections::BTreeSet;
use std::fs;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddrV4, SocketAddrV6};
use std::time::Duration;
use std::{env, thread};

use hil_core::random::RandomStream;
use hil_core::record::{PublishedRecord, TakenRecord};
use hil_platform::clock::MonotonicClock;
use hil_report::summary::{CounterGroup, RunEvent, RunEventKind, RunSummary};
use hil_rundir::event::EventKind;
use hil_rundir::run_folder::RunFolder as Folder;
use hil_rundir::run_result::RunResult;
use hil_tests::account::assert_accounts_close;
use hil_tests::attacker::{Attacker, Quoted, datagram_v4, report_v4, reset_v4, syn_v4};
use hil_tests::knocker::CONTROL_PORT;
use hil_tests::lab::{ADDRESSES, INTERFACE, Lab};
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::{CHANNELS, records};
use hil_tests::split::{HOSTS, Split, count, direction, refused};
use hil_tests::trial::{RunFiles, Trial};

use super::strangers::{hardware_address, made_up};

const LIMIT: Duration = Duration::from_mins(1);
/// No other file of tests uses these ports.
const PORT: u16 = 7_900;
/// Of the link from the first host to the second, and back.
const PORTS: [u16; 2] = [PORT, PORT + 1];
/// Where the first clock path of a host listens, unless the topology says otherwise.
const CLOCK_PORT: u16 = 7_390;
/// Beside those of the data.
const CLOCK_ADDRESSES: [Ipv4Addr; 2] = [Ipv4Addr::new(10, 77, 0, 11), Ipv4Addr::new(10, 77, 0, 12)];
const ADDRESSES_V6: [Ipv6Addr; 2] = [
    Ipv6Addr::new(0xfd77, 0, 0, 0, 0, 0, 0, 1),
    Ipv6Addr::new(0xfd77, 0, 0, 0, 0, 0, 0, 2),
];
/// Addresses that are in no topology.
const FOREIGN: Ipv4Addr = Ipv4Addr::new(10, 77, 0, 66);
const FOREIGN_V6: Ipv6Addr = Ipv6Addr::new(0xfd77, 0, 0, 0, 0, 0, 0, 0x66);
/// Messages a second of each of the two channels.
const MESSAGES_HZ: u32 = 1_000;
/// Of an attack, and of the time without that follows it.
const TURN: Duration = Duration::from_millis(500);
/// What a stranger sends in a second.
const SENT_HZ: u32 = 2_000;
/// Share of messages that an attack may cost above the time without.
const COST_MAX: f64 = 0.001;
/// Where none of n messages is lost, the share that is lost is below 3 / n with 95 % confidence (Hanley and Lippman-Hand,
/// JAMA 1983): fewer messages cannot show [`COST_MAX`].
const MESSAGES_MIN: usize = 3_000;

/// Messages that were published in some windows of time, and those of them that never came.
#[derive(Debug, Default, Clone, Copy)]
struct Cost {
    published: usize,
    lost: usize,
}

impl Cost {
    fn ratio(self) -> f64 {
        self.lost as f64 / self.published as f64
    }
}

/// Of `channel`, which leads from the first of `files` to the second.
fn cost(files: [&RunFiles; 2], channel: &str, windows_ns: &[Range<i64>]) -> Cost {
    let published: Vec<PublishedRecord> = records(files[0], channel, "published");
    let taken: Vec<TakenRecord> = records(files[1], channel, "taken");
    let taken: BTreeSet<_> = taken.iter().map(|one| (one.epoch, one.sequence)).collect();
    let is_inside = |one: &&PublishedRecord| {
        let mut windows = windows_ns.iter();
        windows.any(|window| window.contains(&one.published_ns))
    };
    let inside: Vec<_> = published.iter().filter(is_inside).collect();
    let lost = inside
        .iter()
        .filter(|one| !taken.contains(&(one.epoch, one.sequence)));
    Cost {
        published: inside.len(),
        lost: lost.count(),
    }
}

/// Turns of one kind of attack, and those without between them.
struct Turns {
    name: &'static str,
    sent_count: u64,
    attacked_ns: Vec<Range<i64>>,
    quiet_ns: Vec<Range<i64>>,
}

/// Rounds of attacks: `HIL_ATTACK_ROUNDS`, else `usual`.
fn round_count(usual: u32) -> u32 {
    let asked = env::var("HIL_ATTACK_ROUNDS").ok();
    asked.map_or(usual, |text| text.parse().expect("a number of rounds"))
}

/// The duration of a run in which so many rounds of `kind_count` attacks are played; some seconds more, in which the
/// stranger listens before.
fn run_duration(round_count: u32, kind_count: u32) -> String {
    format!("run.duration=\"{} s\"", 6 + round_count * kind_count)
}

/// Plays each attack once a round and nothing after each.
fn play(attacks: &[(&'static str, &dyn Fn() -> u64)], round_count: u32) -> Vec<Turns> {
    let mut all: Vec<Turns> = attacks
        .iter()
        .map(|(name, _)| Turns {
            name,
            sent_count: 0,
            attacked_ns: Vec::new(),
            quiet_ns: Vec::new(),
        })
        .collect();
    let now_ns = || MonotonicClock::now().as_ns();
    for _ in 0..round_count {
        for ((_, attack), turns) in attacks.iter().zip(&mut all) {
            let began_ns = now_ns();
            turns.sent_count += attack();
            let ended_ns = now_ns();
            turns.attacked_ns.push(began_ns..ended_ns);
            thread::sleep(TURN);
            turns.quiet_ns.push(ended_ns..now_ns());
        }
    }
    all
}

/// Prints what each kind of attack cost, and checks each: at least [`MESSAGES_MIN`] messages under it and beside it, and
/// at most [`COST_MAX`] of them lost above the time beside it.
fn judge(files: &[RunFiles; 2], all: &[Turns]) {
    let ways = [
        ([&files[0], &files[1]], CHANNELS[0]),
        ([&files[1], &files[0]], CHANNELS[1]),
    ];
    let both = |windows_ns: &[Range<i64>]| {
        let costs = ways.map(|(files, channel)| cost(files, channel, windows_ns));
        Cost {
            published: costs[0].published + costs[1].published,
            lost: costs[0].lost + costs[1].lost,
        }
    };
    for turns in all {
        let [attacked, beside] = [&turns.attacked_ns, &turns.quiet_ns].map(|one| both(one));
        println!(
            "{}: {} sent; {} of {} messages lost, {} of {} beside it",
            turns.name,
            turns.sent_count,
            attacked.lost,
            attacked.published,
            beside.lost,
            beside.published
        );
        assert!(turns.sent_count > 0, "{}", turns.name);
        for one in [attacked, beside] {
            assert!(one.published >= MESSAGES_MIN, "{}: {one:?}", turns.name);
        }
        assert!(
            attacked.ratio() <= beside.ratio() + COST_MAX,
            "{}: {attacked:?}, {beside:?} beside it",
            turns.name
        );
    }
}

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

fn stranger_in(lab: &Lab) -> Attacker {
    let first = lab.host(0).namespace();
    let name = format!("{}2", first.strip_suffix('0').unwrap());
    Attacker::join(
        first,
        &name,
        FOREIGN,
        ADDRESSES[0],
        &hardware_address(lab, 0),
    )
}

/// ICMP of every type, datagrams and clock exchanges from the peers' addresses, beginnings of connections from
/// everywhere: at both ports of the run, at the supervisors' and at the clock path's.
#[test]
fn forged_traffic_of_each_kind_costs_a_sealed_run_nothing_above_the_time_beside_it() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    lab.put_bridge_between();
    let stranger = stranger_in(&lab);
    let hardware = [0, 1].map(|index| hardware_address(&lab, index));
    let record = RunFolder::new("forged");
    let rounds = round_count(6);
    let mut trial = Trial::shipped("shuttle-split.toml", record.path())
        .set(&format!("links.hop.port={PORT}"))
        .set(&format!("case.parameters.rate_hz={MESSAGES_HZ}.0"))
        .set("channels.\"shuttle/command\".depth=256")
        .set("channels.\"shuttle/status\".depth=256")
        .set(&run_duration(rounds, 4));
    for (index, host) in HOSTS.iter().enumerate() {
        lab.host(index).add_address(CLOCK_ADDRESSES[index]);
        for address in [ADDRESSES[index], CLOCK_ADDRESSES[index]] {
            stranger.know(address.into(), &hardware[index]);
        }
        let address = CLOCK_ADDRESSES[index];
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
    let reports: Vec<_> = (0..=255)
        .flat_map(|kind| {
            [0, 1].map(|from| {
                let [own, other] = [from, 1 - from].map(|end| at(ADDRESSES[end], PORTS[from]));
                report_v4(kind, Quoted::Udp, [own, other])
            })
        })
        .collect();
    let beginnings: Vec<_> = (0..2_000_u16)
        .map(|number| {
            let [high, low] = number.to_be_bytes();
            let from = at(Ipv4Addr::new(10, 77, 100 + high, low), 1_024 + number);
            let port = if number % 2 == 0 { CONTROL_PORT } else { PORT };
            syn_v4(from, at(ADDRESSES[usize::from(number / 2 % 2)], port))
        })
        .collect();
    let send = |packets: &[Vec<u8>]| stranger.send_repeatedly(packets, TURN, SENT_HZ).sent_count;
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
    let summaries = split.finish();
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
    lab.put_bridge_between();
    let stranger = stranger_in(&lab);
    let hardware = [0, 1].map(|index| hardware_address(&lab, index));
    stranger.know(ADDRESSES[1].into(), &hardware[1]);
    let record = RunFolder::new("forged-tcp");
    let rounds = round_count(6);
    let trial = Trial::shipped("shuttle-tcp.toml", record.path())
        .set(&format!("links.hop.port={PORT}"))
        .set(&format!("case.parameters.rate_hz={MESSAGES_HZ}.0"))
        .set("channels.\"shuttle/command\".depth=256")
        .set("channels.\"shuttle/status\".depth=256")
        .set(&run_duration(rounds, 3));
    let split = Split::start(&lab, &trial);
    split.wait_for_messages("the begin of the run");
    let ports = [PORTS[0], PORTS[1], CONTROL_PORT];
    let connections = ports.map(|port| stranger.overhear_connection(port, LIMIT));
    let ways = || connections.into_iter().flat_map(|[a, b]| [[a, b], [b, a]]);
    let reports: Vec<_> = (0..=255)
        .flat_map(|kind| ways().map(move |ends| report_v4(kind, Quoted::Tcp, ends)))
        .collect();
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
    let send = |packets: &[Vec<u8>]| stranger.send_repeatedly(packets, TURN, SENT_HZ).sent_count;
    let all = play(
        &[
            ("ICMP of every type on connections", &|| send(&reports)),
            ("resets with a guessed number", &|| send(&resets)),
            ("beginnings in a connection that is up", &|| {
                send(&beginnings)
            }),
        ],
        rounds,
    );
    let calm_ns = MonotonicClock::now().as_ns();
    for (host, hardware) in ADDRESSES.into_iter().zip(&hardware) {
        let sent_count = stranger.reset(PORT, host, hardware, LIMIT);
        println!("{sent_count} exact resets at {host}");
        thread::sleep(TURN);
    }
    let files = [0, 1].map(|index| split.files[index].clone());
    let summaries = split.finish();
    judge(&files, &all);
    let after = cost(
        [&files[0], &files[1]],
        CHANNELS[0],
        core::slice::from_ref(&(calm_ns..i64::MAX)),
    );
    println!("commands under two exact resets: {after:?}");
    for (summary, name) in summaries.iter().zip(CHANNELS) {
        let egress = direction(summary, name, "egress");
        let reconnects = count(egress, "transport: reconnect_count");
        println!("{name}: {reconnects} reconnects");
        assert_eq!(reconnects, if name == CHANNELS[0] { 2 } else { 0 });
        assert!(cuts(summary).is_empty(), "{:?}", summary.events);
        assert_accounts_close(summary);
    }
    let mut told = summaries[0].events.iter().map(RunEvent::what);
    assert!(told.any(|what| what.contains("and is back (reconnect 2)")));
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
fn run_of_v6<'a>(lab: &'a Lab, record: &RunFolder, duration: &str) -> (Split<'a>, Attacker) {
    lab.put_bridge_between();
    let stranger = stranger_in(lab);
    stranger.add_address(FOREIGN_V6);
    let mut trial = Trial::shipped("shuttle-split.toml", record.path())
        .set(&format!("links.hop.port={PORT}"))
        .set(&format!("case.parameters.rate_hz={MESSAGES_HZ}.0"))
        .set("channels.\"shuttle/command\".depth=256")
        .set("channels.\"shuttle/status\".depth=256")
        .set(duration);
    for (index, host) in HOSTS.iter().enumerate() {
        let address = ADDRESSES_V6[index];
        lab.host(index).add_address(address);
        stranger.know(address.into(), &hardware_address(lab, index));
        trial = trial.set(&format!("hosts.{host}.address=\"{address}\""));
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
    let rounds = round_count(10);
    let (split, stranger) = run_of_v6(&lab, &record, &run_duration(rounds, 2));
    let reports = |to: usize| {
        let end = |index: usize| SocketAddrV6::new(ADDRESSES_V6[index], PORTS[to], 0, 0);
        let quoted = [end(to), end(1 - to)];
        let flood = stranger.forge_reports_v6(ADDRESSES_V6[to], quoted, TURN, SENT_HZ);
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
    let summaries = split.finish();
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

/// As with ARP, the messages to the host whose address is taken are lost on the wire, and the change is told.
#[test]
fn a_stranger_that_advertises_a_hosts_address_of_ipv6_is_told_with_both_link_addresses() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("claimed-v6");
    let (mut split, stranger) = run_of_v6(&lab, &record, "run.duration=\"8 s\"");
    let claimed_at = "02:00:00:00:00:68";
    stranger.claim_v6(ADDRESSES_V6[0], ADDRESSES_V6[1], claimed_at);
    let words = format!("is at {claimed_at} on {INTERFACE}");
    let seen = split.hosts[0].wait_for_output(&words, LIMIT);
    seen.unwrap_or_else(|reason| panic!("{reason}"));
    // Pinned, it is found again, and stays.
    lab.host(0)
        .pin_neighbour(ADDRESSES_V6[1], &hardware_address(&lab, 1));
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
