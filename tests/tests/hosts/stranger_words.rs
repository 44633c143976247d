//! What a stranger can say to the supervisors and gateways of a sealed run in a host's place, and what it costs.

use core::slice;
use std::io::Write;
use std::net::{SocketAddrV4, TcpListener, TcpStream};
use std::thread;
use std::time::{Duration, Instant};

use hil_platform::clock::MonotonicClock;
use hil_report::summary::{RunEvent, RunEventKind, RunSummary};
use hil_rundir::event::EventKind;
use hil_tests::account::{account, assert_accounts_close, assert_every_message_is_accounted_for};
use hil_tests::attacker::{Attacker, Exact, FOREIGN, Flood};
use hil_tests::child::ChildGuard;
use hil_tests::knocker::CONTROL_PORT;
use hil_tests::lab::{ADDRESSES, BRIDGE_PORTS, INTERFACE, Lab};
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::CHANNELS;
use hil_tests::split::{HOSTS, Split, count, direction};
use hil_tests::trial::{Trial, wait_until};
use hil_tests::turns::{cost_of_both, cost_of_exchanges, roomy};

const LIMIT: Duration = Duration::from_mins(1);
/// No other file of tests uses these ports.
const PORT: u16 = 7_930;
/// A refusal as the listening end of a handshake words it: nine bytes that anybody can send.
const REFUSAL: [u8; 9] = [b'H', b'I', b'L', b'K', 1, 3, 1, 0, 1];
/// Connections that the stranger at the first host's address answers with it.
const REFUSED_COUNT: usize = 5;

#[test]
fn made_up_refusals_at_a_hosts_address_end_no_waiting_and_are_told() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("refused");
    let trial = Trial::shipped("shuttle-split.toml", record.path())
        .set(&format!("links.hop.port={PORT}"))
        .set("run.duration=\"3 s\"");
    let (mut joining, listener) = lab.host(0).on_network(|| {
        let listener = TcpListener::bind((ADDRESSES[0], CONTROL_PORT)).unwrap();
        (trial.start_on(lab.host(1)), listener)
    });
    for _ in 0..REFUSED_COUNT {
        let (mut stream, _) = listener.accept().unwrap();
        stream.write_all(&REFUSAL).unwrap();
    }
    drop(listener);
    // Longer than it takes to end: before, it ended within a tenth of this.
    thread::sleep(Duration::from_millis(700));
    assert!(joining.is_running(), "{}", joining.stderr_so_far());
    joining.wait_for_output("came to nothing", LIMIT).unwrap();
    let split = Split::of(&lab, &trial, [trial.start_on(lab.host(0)), joining]);
    let summaries = split.finish();
    let security = summaries[1].run.security.as_ref().unwrap().to_string();
    println!("{security}");
    let told = format!("{REFUSED_COUNT} to control-pc (10.77.0.1) which answered without proof");
    assert!(security.contains(&told), "{security}");
    for summary in &summaries {
        assert_accounts_close(summary);
    }
}

/// Forged reports of the network in a second.
const REPORTS_HZ: u32 = 2_000;
/// How long, in a sealed run.
const REPORTS_SPAN: Duration = Duration::from_secs(5);
/// In a plain one, of which nothing is asked but that it goes on.
const PLAIN_REPORTS_SPAN: Duration = Duration::from_secs(2);

/// A run with forged reports to its sending gateway of commands, for so long.
fn under_reports(
    lab: &Lab,
    trial: &Trial,
    stranger: &Attacker,
    span: Duration,
) -> (Flood, [RunSummary; 2]) {
    let split = Split::start(lab, trial);
    split.wait_for_messages("the begin of the run");
    let quoted = ADDRESSES.map(|address| SocketAddrV4::new(address, PORT));
    let flood = stranger.forge_reports(ADDRESSES[0], quoted, span, REPORTS_HZ);
    (flood, split.stop())
}

#[test]
fn forged_reports_of_the_network_cost_a_sealed_run_nothing_and_are_counted() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let stranger = Attacker::join(&lab, FOREIGN);
    for is_sealed in [false, true] {
        let record = RunFolder::new("reports");
        let trial = Trial::shipped("shuttle-split.toml", record.path())
            .set(&format!("links.hop.port={PORT}"))
            .set("case.parameters.rate_hz=1000.0")
            .set("run.duration=\"10 min\"");
        let (trial, span) = if is_sealed {
            (trial, REPORTS_SPAN)
        } else {
            (trial.plain(), PLAIN_REPORTS_SPAN)
        };
        let (flood, summaries) = under_reports(&lab, &trial, &stranger, span);
        let commands = account(&summaries[1], CHANNELS[0]);
        let sender = direction(&summaries[0], CHANNELS[0], "egress");
        let ignored = count(sender, "socket: ignored_report_count");
        println!(
            "sealed {is_sealed}: {} forged reports; {} commands published, {:?}; the sender counted {ignored} \
             reports it ignored and {} it believed",
            flood.sent_count,
            commands.published_count,
            commands.fates.iter().collect::<Vec<_>>(),
            count(sender, "socket: network_report_count")
        );
        if is_sealed {
            assert_eq!(commands.fates.lost_count(), 0);
            let refused = ["peer_refused", "unreachable", "too_long", "other_refusal"];
            for name in refused {
                assert_eq!(count(sender, &format!("socket: {name}_count")), 0, "{name}");
            }
            assert!(ignored > 1_000, "{:?}", sender.counters);
        }
    }
}

/// Connections that say nothing, from the address of the peer of a TCP hop, and their spacing.
const EMPTY_COUNT: u64 = 80;
const EMPTY_EVERY: Duration = Duration::from_millis(50);

#[test]
fn empty_connections_from_the_peers_address_cost_a_sealed_tcp_hop_nothing() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("empty");
    let trial = Trial::shipped("shuttle-tcp.toml", record.path())
        .set(&format!("links.hop.port={PORT}"))
        .set("run.duration=\"10 min\"");
    let split = Split::start(&lab, &trial);
    split.wait_for_messages("the begin of the run");
    let made = lab.host(0).on_network(|| {
        let (mut open, began) = (Vec::new(), Instant::now());
        for number in 1..=EMPTY_COUNT {
            open.extend(TcpStream::connect((ADDRESSES[1], PORT)));
            let due = EMPTY_EVERY * u32::try_from(number).unwrap();
            thread::sleep(due.saturating_sub(began.elapsed()));
        }
        open.len()
    });
    let summaries = split.stop();
    let commands = account(&summaries[1], CHANNELS[0]);
    let ingress = direction(&summaries[1], CHANNELS[0], "ingress");
    let unproven = count(ingress, "transport: unproven_connection_count");
    println!(
        "{made} empty connections; {} commands published, {} lost; {unproven} connections ended unproven",
        commands.published_count,
        commands.fates.lost_count()
    );
    assert_eq!(commands.fates.lost_count(), 0);
    assert_eq!(count(ingress, "transport: reconnect_count"), 0);
    assert!(unproven > EMPTY_COUNT / 2, "{:?}", ingress.counters);
    for summary in &summaries {
        assert_accounts_close(summary);
    }
}

/// Least length of the run whose supervisors' connection is reset: so much there is to exchange.
const RESET_RUN: Duration = Duration::from_secs(12);
/// What the hosts' network is slowed to in the run, which needs less, so that the exchange of records takes seconds.
const SLOW: &str = "tbf rate 5mbit burst 64kb limit 1mb";

/// When the connection to `peer` was cut by `summary`, seconds.
fn cuts(summary: &RunSummary, peer: &str) -> Vec<f64> {
    let cuts = summary.events.iter().filter_map(|event| match &event.kind {
        RunEventKind::Process(EventKind::Reconnected { peer: of, .. }) if of == peer => {
            println!(
                "{}: at {:?} s, {}",
                summary.run.host,
                event.at_s,
                event.what()
            );
            event.at_s
        }
        _ => None,
    });
    cuts.collect()
}

/// A reset, an end and content with the exact number at either end of the supervisors' connection in the run, and two resets in
/// the exchange of records.
#[test]
fn exact_forgeries_in_the_supervisors_connection_cost_reconnects_that_are_told() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let stranger = Attacker::join(&lab, FOREIGN);
    let forge_both = |what: Exact, phase: &str| {
        for host in ADDRESSES {
            let sent_count = stranger.forge_exactly(what, CONTROL_PORT, host, LIMIT);
            println!("{phase}: {sent_count} of {what:?} at {host}");
            thread::sleep(Duration::from_millis(700));
        }
    };
    let record = RunFolder::new("resets");
    let trial = Trial::shipped("shuttle-split.toml", record.path())
        .set(&format!("links.hop.port={PORT}"))
        .set("case.parameters.rate_hz=1000.0")
        .set("run.duration=\"10 min\"");
    let mut split = Split::start(&lab, &trial);
    split.wait_for_messages("the begin of the run");
    let began = Instant::now();
    for what in [Exact::Reset, Exact::End, Exact::Content] {
        forge_both(what, "run");
    }
    let told_cuts = |split: &Split<'_>| {
        let hosts = split.hosts.each_ref();
        hosts.map(|host| host.stderr_so_far().matches("is back after").count())
    };
    wait_until(LIMIT, "the connection after six cuts", || {
        told_cuts(&split).iter().all(|count| *count >= 6)
    });
    thread::sleep(RESET_RUN.saturating_sub(began.elapsed()));
    for port in BRIDGE_PORTS {
        let mut command = lab.host(0).command("tc");
        let words = format!("qdisc add dev {port} root {SLOW}");
        let status = command.args(words.split(' ')).status().unwrap();
        assert!(status.success(), "tc {words}");
    }
    let early_counts = told_cuts(&split);
    split.interrupt();
    wait_until(LIMIT, "records of the other host", || {
        split.files[0].record_bytes("shuttle.command.taken.") > 0
    });
    forge_both(Exact::Reset, "exchange");
    let summaries = split.stopped();
    for (index, summary) in summaries.iter().enumerate() {
        assert_every_message_is_accounted_for(summary);
        let all = cuts(summary, HOSTS[1 - index]);
        let early_count = early_counts[index];
        assert!(
            early_count >= 6 && all.len() >= early_count + 2,
            "{early_count} of {all:?}"
        );
        for name in CHANNELS {
            let account = account(summary, name);
            println!(
                "{name}: {} published, {} lost",
                account.published_count,
                account.fates.lost_count()
            );
            assert!(account.fates.lost_count() * 1_000 <= account.published_count);
        }
        assert_accounts_close(summary);
    }
}

/// Link addresses of a stranger that takes a host's address, and how long it does at least.
const CLAIMED_AT: [&str; 2] = ["02:00:00:00:00:66", "02:00:00:00:00:67"];
const CLAIMED_FOR: Duration = Duration::from_secs(1);
/// How long each run goes on when the host has its address again.
const PINNED_FOR: Duration = Duration::from_secs(2);

/// It gets what is sent to that host. No seal sees that; the messages are lost on the wire, and the change is told.
#[test]
fn a_stranger_that_answers_for_a_hosts_address_is_told_with_both_link_addresses() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let stranger = Attacker::join(&lab, FOREIGN);
    let lost_counts =
        [(false, CLAIMED_AT[0]), (true, CLAIMED_AT[1])].map(|(is_pinned, claimed_at)| {
            let record = RunFolder::new("claimed");
            let trial = Trial::shipped("shuttle-split.toml", record.path())
                .set(&format!("links.hop.port={PORT}"))
                .set("run.duration=\"10 min\"");
            let mut split = Split::start(&lab, &trial);
            split.wait_for_messages("the begin of the run");
            stranger.claim(ADDRESSES[1], claimed_at);
            thread::sleep(CLAIMED_FOR);
            if !is_pinned {
                let words = format!("is at {claimed_at} on {INTERFACE}");
                let seen = split.hosts[0].wait_for_output(&words, LIMIT);
                seen.unwrap_or_else(|reason| panic!("{reason}"));
            }
            // It mends the first run, and is there from the start of the second.
            lab.host(0)
                .pin_neighbour(ADDRESSES[1], &lab.host(1).hardware_address());
            // A supervisor looks ten times a second.
            thread::sleep(PINNED_FOR);
            let summaries = split.stop();
            let told = |event: &RunEvent| match &event.kind {
                RunEventKind::Process(EventKind::NeighbourChanged { interface, now, .. }) => {
                    // The bridge of the lab is on that host as well, and takes over the address of any announcement.
                    interface == INTERFACE && now == claimed_at
                }
                _ => false,
            };
            let commands = account(&summaries[1], CHANNELS[0]);
            let (published, lost) = (commands.published_count, commands.fates.lost_count());
            println!("pinned {is_pinned}: {lost} of {published} commands lost");
            for event in &summaries[0].events {
                println!("at {:?} s: {}", event.at_s, event.what());
            }
            assert_eq!(summaries[0].events.iter().any(told), !is_pinned);
            assert!(summaries[0].record_gaps.is_empty());
            lost
        });
    let [lost_unpinned, lost_pinned] = lost_counts;
    assert!(lost_pinned * 10 < lost_unpinned, "{lost_counts:?}");
}

/// How long the address is taken: longer than the supervisors wait for a byte.
const TAKEN_FOR: Duration = Duration::from_secs(5);
/// How long the run is looked at when messages come again.
const AFTERWARDS: Duration = Duration::from_secs(3);

/// The hop and the supervisors' connection over TCP wait, and go on; a hop's queue is bounded.
#[test]
fn a_taken_address_costs_a_sealed_tcp_hop_and_the_supervisors_what_is_sent_meanwhile() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let stranger = Attacker::join(&lab, FOREIGN);
    let record = RunFolder::new("taken");
    let trial = Trial::shipped("shuttle-tcp.toml", record.path())
        .set(&format!("links.hop.port={PORT}"))
        .set("run.duration=\"10 min\"");
    let trial = roomy(trial);
    let split = Split::start(&lab, &trial);
    split.wait_for_messages("the begin of the run");
    let now_ns = || MonotonicClock::now().as_ns();
    stranger.claim(ADDRESSES[1], CLAIMED_AT[0]);
    let began_ns = now_ns();
    thread::sleep(TAKEN_FOR);
    lab.host(0)
        .pin_neighbour(ADDRESSES[1], &lab.host(1).hardware_address());
    let ended_ns = now_ns();
    split.wait_for_messages("the address is back");
    let back_ns = now_ns();
    thread::sleep(AFTERWARDS + Duration::from_millis(200));
    wait_until(LIMIT, "the supervisors' connection", || {
        let mut told = split.hosts.iter().map(ChildGuard::stderr_so_far);
        told.any(|text| text.contains("is back after"))
    });
    let files = [0, 1].map(|index| split.files[index].clone());
    let summaries = split.stop();
    let afterwards_ns = i64::try_from(AFTERWARDS.as_nanos()).unwrap();
    for (name, window_ns) in [
        ("taken", began_ns..ended_ns),
        ("pinned, until messages came again", ended_ns..back_ns),
        ("after that", back_ns..back_ns + afterwards_ns),
    ] {
        let windows_ns = slice::from_ref(&window_ns);
        let messages = cost_of_both(&files, windows_ns);
        let exchanges = cost_of_exchanges(&files[0], windows_ns);
        let span_s = (window_ns.end - window_ns.start) as f64 * 1e-9;
        println!("{name}, {span_s:.2} s: {messages:?} messages, {exchanges:?} clock exchanges");
        match name {
            "taken" => assert!(messages.lost * 2 > messages.sent, "{messages:?}"),
            "after that" => assert!(messages.lost < messages.sent, "{messages:?}"),
            _ => {}
        }
    }
    let cut = [(&summaries[0], HOSTS[1]), (&summaries[1], HOSTS[0])];
    assert!(
        cut.iter()
            .any(|(summary, peer)| !cuts(summary, peer).is_empty())
    );
    for summary in &summaries {
        assert!(summary.record_gaps.is_empty());
        assert_accounts_close(summary);
    }
    let mut events = summaries[0].events.iter();
    assert!(events.any(|event| {
        let kind = &event.kind;
        matches!(kind, RunEventKind::Process(EventKind::NeighbourChanged { now, .. }) if now == CLAIMED_AT[0])
    }));
}
