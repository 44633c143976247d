//! What a stranger on the network can send to a viewer's connection to the recorder, which the kernel judges: what it costs the
//! viewer and the run.

use core::ops::Range;
use core::slice;
use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, SocketAddrV4};
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use hil_core::random::RandomStream;
use hil_platform::clock::MonotonicClock;
use hil_tests::account::account;
use hil_tests::attacker::{
    Attacker, Exact, FOREIGN, FOREIGN_V6, Quoted, reports_v4, reset_v4, segment_v4, syn_v4,
};
use hil_tests::binary::hil_recorder_binary;
use hil_tests::lab::{ADDRESSES, ADDRESSES_V6, Lab};
use hil_tests::live_server::LiveServer;
use hil_tests::run_folder::RunFolder;
use hil_tests::split::{HOSTS, Split};
use hil_tests::trial::Trial;
use hil_tests::turns::{Bound, TURN, Turns, cost_of_both, play, roomy, round_count};

use super::live_access::{Asked, LIMIT};
use super::live_floods::subscribe;

/// No other file of tests uses these ports.
const PORT: u16 = 7_920;
/// How long a stranger takes the viewer's address.
const CLAIMED_FOR: Duration = Duration::from_secs(1);

/// A viewer, which reads until it is cut off.
struct Viewer {
    /// When something came, this machine's monotonic clock, and at last why nothing comes any more.
    came: mpsc::Receiver<Result<i64, ErrorKind>>,
}

impl Viewer {
    /// Looks on at `address`, which must be reachable from the present network.
    fn at(address: &str, token: &str) -> Self {
        let mut asked = Asked::with_token(address, address, None, Some(token));
        asked.is_let_in();
        asked.stream.write_all(&subscribe()).unwrap();
        let (told, came) = mpsc::channel();
        thread::spawn(move || {
            let mut bytes = vec![0; 1 << 16];
            loop {
                let read = match asked.stream.read(&mut bytes) {
                    Ok(0) => Err(ErrorKind::UnexpectedEof),
                    Ok(_) => Ok(MonotonicClock::now().as_ns()),
                    Err(error) => Err(error.kind()),
                };
                if told.send(read).is_err() || read.is_err() {
                    return;
                }
            }
        });
        Self { came }
    }

    /// When something came, until now.
    fn times_ns(&self) -> Vec<i64> {
        let came = self.came.try_iter();
        came.map(|one| one.expect("the viewer is not cut off"))
            .collect()
    }
}

/// Turns in which something came, of how many.
fn served(times_ns: &[i64], windows_ns: &[Range<i64>]) -> usize {
    let has_come = |window: &&Range<i64>| times_ns.iter().any(|at| window.contains(at));
    windows_ns.iter().filter(has_come).count()
}

fn both<T>(ends: Vec<[T; 2]>) -> Vec<[T; 2]>
where
    T: Copy,
{
    ends.into_iter()
        .flat_map(|[own, other]| [[own, other], [other, own]])
        .collect()
}

/// As [`SocketAddr`]s of the two families; an address of IPv4 may be said in the form of IPv6.
fn canonical(end: SocketAddr) -> SocketAddr {
    SocketAddr::new(end.ip().to_canonical(), end.port())
}

#[test]
fn forged_traffic_costs_a_viewer_nothing_and_an_exact_reset_that_viewer() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let stranger = Attacker::join(&lab, FOREIGN);
    stranger.add_address(FOREIGN_V6);
    for (index, address) in ADDRESSES_V6.into_iter().enumerate() {
        lab.host(index).add_address(address);
        stranger.know(address.into(), &lab.host(index).hardware_address());
    }
    let rounds = round_count(2);
    let record = RunFolder::new("forged-live");
    let trial = Trial::shipped("shuttle-split.toml", record.path())
        .set(&format!("links.hop.port={PORT}"))
        .set("case.parameters.rate_hz=1000.0")
        .set("run.duration=\"10 min\"");
    let trial = roomy(trial);
    let split = Split::start(&lab, &trial);
    split.wait_for_messages("the begin of the run");
    let server = LiveServer::start_by(
        lab.host(0).command(hil_recorder_binary()),
        &["--wait", "--host", "::"],
    );
    let port: u16 = server.socket.rsplit(':').next().unwrap().parse().unwrap();
    let viewers = lab.host(1).on_network(|| {
        let addresses = [
            SocketAddr::from((ADDRESSES[0], port)),
            SocketAddr::from((ADDRESSES_V6[0], port)),
        ];
        addresses.map(|address| Viewer::at(&address.to_string(), &server.token))
    });
    for viewer in &viewers {
        viewer.came.recv_timeout(LIMIT).unwrap().unwrap();
    }
    let ends: Vec<_> = both(lab.host(0).connections("established", port));
    let (mut v4, mut v6) = (Vec::new(), Vec::new());
    for ends in ends {
        match ends.map(canonical) {
            [SocketAddr::V4(from), SocketAddr::V4(to)] => v4.push([from, to]),
            [SocketAddr::V6(from), SocketAddr::V6(to)] => v6.push([from, to]),
            mixed => panic!("{mixed:?}"),
        }
    }
    assert_eq!((v4.len(), v6.len()), (2, 2));
    let mut random = RandomStream::new(9, "forged");
    let mut guessed = |forge: &dyn Fn([SocketAddrV4; 2], u32) -> Vec<u8>| {
        let packets = (0..1_000).flat_map(|_| {
            let [a, b, c, d, ..] = random.next_u64().to_le_bytes();
            let guess = u32::from_le_bytes([a, b, c, d]);
            [v4[0], v4[1]].map(|ends| forge(ends, guess))
        });
        packets.collect::<Vec<_>>()
    };
    let resets = guessed(&|[from, to], guess| reset_v4(from, to, guess));
    let beginnings = guessed(&|[from, to], _| syn_v4(from, to));
    let contents =
        guessed(&|[from, to], guess| segment_v4(from, to, guess, &guess.to_le_bytes().repeat(24)));
    let reports = reports_v4(Quoted::Tcp, &v4);
    let send = |packets: &[Vec<u8>]| stranger.send_repeatedly(packets, TURN).sent_count;
    let all: Vec<Turns> = play(
        &[
            ("ICMP of every type on a viewer's connection", &|| {
                send(&reports)
            }),
            ("ICMPv6 of every type on a viewer's connection", &|| {
                let flood = stranger.forge_reports_v6(Quoted::Tcp, &v6, TURN);
                flood.sent_count
            }),
            ("resets with a guessed number", &|| send(&resets)),
            ("beginnings in a viewer's connection", &|| send(&beginnings)),
            ("content with a guessed number", &|| send(&contents)),
        ],
        rounds,
    );
    let times_ns = viewers.each_ref().map(Viewer::times_ns);
    for turns in &all {
        for (family, times_ns) in ["IPv4", "IPv6"].iter().zip(&times_ns) {
            let windows = [&turns.attacked_ns, &turns.quiet_ns];
            let [attacked, quiet] = windows.map(|windows| served(times_ns, windows));
            println!(
                "{}: viewer over {family} served in {attacked} and beside it in {quiet} of {rounds} turns",
                turns.name
            );
        }
    }
    for viewer in &viewers {
        viewer.came.recv_timeout(LIMIT).unwrap().unwrap();
    }
    let calm_ns = MonotonicClock::now().as_ns();
    let for_s = Duration::from_secs(2);
    let sent_count = stranger.forge_exactly(Exact::Reset, port, ADDRESSES[1], for_s);
    let [reset, other] = viewers;
    let ended = reset.came.iter().find_map(Result::err);
    println!("{sent_count} exact resets: the viewer's connection ended, {ended:?}");
    assert_eq!(ended, Some(ErrorKind::ConnectionReset));
    other.came.recv_timeout(LIMIT).unwrap().unwrap();
    let look_on = || {
        let address = SocketAddr::from((ADDRESSES[0], port)).to_string();
        lab.host(1)
            .on_network(|| Viewer::at(&address, &server.token))
    };
    drop(look_on());
    let reset_ns = calm_ns..MonotonicClock::now().as_ns();
    // Who has the viewer's address answers for it: the recorder's connection ends. The next viewer is let in.
    let _lost = look_on();
    stranger.claim(ADDRESSES[1], "02:00:00:00:00:71");
    thread::sleep(CLAIMED_FOR);
    lab.host(0)
        .pin_neighbour(ADDRESSES[1], &lab.host(1).hardware_address());
    let pinned_ns = MonotonicClock::now().as_ns();
    let next = look_on().came.recv_timeout(LIMIT).unwrap().unwrap();
    println!(
        "a new viewer from an address that was taken for {CLAIMED_FOR:?} is served {:.2} s after it is pinned",
        (next - pinned_ns) as f64 * 1e-9
    );
    let files = [0, 1].map(|index| split.files[index].clone());
    let summaries = split.stop();
    server.end();
    for turns in &all {
        turns.judge(
            "messages of the run",
            |windows_ns| cost_of_both(&files, windows_ns),
            Bound {
                sent_min: 500,
                cost_max: 0.01,
            },
        );
    }
    let under_resets = cost_of_both(&files, slice::from_ref(&reset_ns));
    println!("messages of the run under exact resets: {under_resets:?}");
    assert!(under_resets.lost * 100 <= under_resets.sent);
    for (summary, host) in summaries.iter().zip(HOSTS) {
        assert_eq!(summary.run.host, host);
        let lost = account(summary, "shuttle/command").fates.lost_count();
        println!("{host}: {lost} commands lost in all, the second of the taken address with them");
    }
}
