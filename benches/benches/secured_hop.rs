//! What the seal costs a hop: round trips of one message over UDP between two hosts, sealed and plain in
//! turns over sockets of their own, and what sealing and opening take by themselves. Not a test: it
//! states the aim and whether it was met, and ends with code 0.
//!
//! `cargo bench -p hil-benches --bench secured_hop`, about eight minutes. `HIL_SECURED_ROUNDS` (100) and
//! `HIL_SECURED_TURN_MS` (1150) say how many rounds it takes for each size of message, and how long either
//! hop has in each of them. Namespaces take root; without, it goes over loopback and says so. The parties
//! block, so a wake-up is in every leg, as in a run; bridges, shared memory and kernel stamps, which cost
//! both alike, are not: the ratio of a whole hop is smaller.
#![allow(clippy::print_stdout, reason = "a bench prints its result")]

use std::hint::black_box;
use std::net::SocketAddr;
use std::os::fd::BorrowedFd;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant as WallInstant};

use hil_benches::gateway::hosts::SetupError;
use hil_benches::gateway::network::Network;
use hil_benches::gateway::parties::{MachineTime, stolen_text};
use hil_benches::{HostFacts, Quantiles, TypicalRatio};
use hil_core::random::RandomStream;
use hil_core::time::Instant;
use hil_net::timestamping::TimestampMode;
use hil_protocol::seal::{Association, Initiator, Opened, Responder, Rotation, RunSecret, Suite};
use hil_protocol::wire::{HEADER_BYTES, Header, Kind, TAG_BYTES};
use hil_transport::sealed::{SealedReceiver, SealedSender};
use hil_transport::socket::SocketSettings;
use hil_transport::udp::{UdpReceiver, UdpSender};
use hil_transport::{DatagramReceiver, DatagramSender};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use serde_json::json;

const SEED: u64 = 12;
const AIM: f64 = 1.15;
const SIZES: [usize; 2] = [64, 1024];
const KINDS: [&str; 2] = ["plain", "sealed"];
/// A lost datagram ends a trip, not the bench.
const PATIENCE_MS: u16 = 200;

fn association(suite: Suite) -> Association {
    Association {
        secret: RunSecret::new(&mut [7; 32]),
        suite,
        flow: 0,
        flow_name: "bench/hop".to_owned(),
    }
}

fn datagram(kind: Kind, sequence: u64, payload_bytes: usize) -> Vec<u8> {
    let mut header = Header::new(kind, 1, 0);
    header.sequence = sequence;
    header.total_len = u32::try_from(payload_bytes).unwrap_or(0);
    let mut bytes = vec![5; HEADER_BYTES + payload_bytes];
    header.encode(&mut bytes);
    bytes
}

fn settings(local: SocketAddr, peer: SocketAddr) -> SocketSettings {
    SocketSettings {
        timestamps: TimestampMode::Off,
        ..SocketSettings::new(local, peer)
    }
}

fn wait(descriptor: Option<BorrowedFd<'_>>) {
    if let Some(fd) = descriptor {
        let mut polled = [PollFd::new(fd, PollFlags::POLLIN)];
        // A time-out is a lost trip, which the caller notices.
        let _late = poll(&mut polled, PollTimeout::from(PATIENCE_MS)).is_err();
    }
}

/// Both ends of one hop; the far one answers in a thread of its own.
struct Hop {
    sender: Box<dyn DatagramSender>,
    stop: Arc<AtomicBool>,
    answering: Option<JoinHandle<()>>,
}

impl Drop for Hop {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.answering.take() {
            drop(thread.join());
        }
    }
}

fn answer(mut receiver: Box<dyn DatagramReceiver>, stop: &AtomicBool) {
    let mut buffer = vec![0; 2_048];
    let mut reply = Vec::new();
    while !stop.load(Ordering::Acquire) {
        wait(receiver.poll_fd());
        while let Ok(Some(received)) = receiver.receive(Instant::ZERO, &mut buffer) {
            reply.clear();
            reply.extend_from_slice(&buffer[..received.length_bytes]);
            reply[5] = Kind::SyncResponse as u8;
            let _lost = receiver.reply(&reply, received.source).is_err();
        }
    }
}

fn open(network: &Network, kind: usize) -> Result<Hop, SetupError> {
    let ends = [network.free_address(0)?, network.free_address(1)?];
    let sender = network.on(0, || UdpSender::open(&settings(ends[0], ends[1])))?;
    let receiver = network.on(1, || UdpReceiver::open(&settings(ends[1], ends[0])))?;
    let (sender, receiver): (Box<dyn DatagramSender>, Box<dyn DatagramReceiver>) = if kind == 0 {
        (Box::new(sender), Box::new(receiver))
    } else {
        let known = association(Suite::Aes256Gcm);
        let initiator = Initiator::new(&known, [1; 16], Rotation::default());
        let responder = Responder::new(&known, &[2; 32], Rotation::default());
        (
            Box::new(SealedSender::new(sender, initiator)),
            Box::new(SealedReceiver::new(receiver, responder, ends[0])),
        )
    };
    let stop = Arc::new(AtomicBool::new(false));
    let stopping = Arc::clone(&stop);
    let answering = thread::spawn(move || answer(receiver, &stopping));
    let mut hop = Hop {
        sender,
        stop,
        answering: Some(answering),
    };
    // Keys first, where there are any; its greeting is answered as well.
    trip(&mut hop, &datagram(Kind::Hello, 0, 60));
    trip(&mut hop, &datagram(Kind::Hello, 1, 60));
    Ok(hop)
}

/// One round trip, nanoseconds; `None` when a datagram was lost.
fn trip(hop: &mut Hop, datagram: &[u8]) -> Option<u64> {
    let began = WallInstant::now();
    hop.sender.send(datagram).ok()?;
    let mut buffer = [0; 2_048];
    let limit = Duration::from_millis(PATIENCE_MS.into());
    while began.elapsed() < limit {
        wait(hop.sender.poll_fd());
        if hop.sender.receive(&mut buffer).ok()?.is_some() {
            return u64::try_from(began.elapsed().as_nanos()).ok();
        }
    }
    None
}

/// Round trips of one hop for one turn, nanoseconds, and how many were lost.
fn turn(hop: &mut Hop, size: usize, length: Duration, number: &mut u64) -> (Vec<u64>, u64) {
    let began = WallInstant::now();
    let (mut trips, mut lost_count) = (Vec::new(), 0);
    while began.elapsed() < length {
        *number += 1;
        match trip(hop, &datagram(Kind::Data, *number, size)) {
            Some(took) => trips.push(took),
            None => lost_count += 1,
        }
    }
    (trips, lost_count)
}

/// Both hops in every round, in an order drawn by lot.
fn compare(hops: &mut [Hop; 2], size: usize, rounds: u64, length: Duration) {
    let mut lots = RandomStream::new(SEED, "turns");
    let mut ratios: [Vec<f64>; 3] = Default::default();
    let mut all: [Vec<u64>; 2] = Default::default();
    let (mut lost, mut number) = ([0_u64; 2], 0);
    for _ in 0..rounds {
        let mut found = [None, None];
        let first = usize::from(lots.chance(0.5));
        for kind in [first, 1 - first] {
            let (mut trips, lost_count) = turn(&mut hops[kind], size, length, &mut number);
            found[kind] = Quantiles::of(&mut trips);
            lost[kind] += lost_count;
            all[kind].append(&mut trips);
        }
        if let [Some(plain), Some(sealed)] = found {
            let of = |one: &Quantiles| [one.p50_ns, one.p99_ns, one.p99_9_ns];
            for ((ratios, plain), sealed) in ratios.iter_mut().zip(of(&plain)).zip(of(&sealed)) {
                ratios.push(sealed as f64 / plain as f64);
            }
        }
    }
    let quantiles = all.each_mut().map(|trips| Quantiles::of(trips));
    for ((kind, found), lost) in KINDS.iter().zip(quantiles).zip(lost) {
        let Some(found) = found else {
            println!("  {size:>5} B {kind:<7} no trip came back, {lost} were lost");
            return;
        };
        let us = |ns: u64| ns as f64 * 1e-3;
        println!(
            "  {size:>5} B {kind:<7} there and back p50 {:8.2} us   p99 {:8.2} us   p99.9 {:8.2} us   {} \
             trips, {lost} lost",
            us(found.p50_ns),
            us(found.p99_ns),
            us(found.p99_9_ns),
            found.count
        );
    }
    for (figure, ratios) in ["p50", "p99", "p99.9"].into_iter().zip(ratios) {
        print_ratio(figure, size, &ratios, quantiles);
    }
}

/// Only the median has an aim.
fn print_ratio(figure: &str, size: usize, ratios: &[f64], quantiles: [Option<Quantiles>; 2]) {
    let count = ratios.len();
    let Some(TypicalRatio { ratio, low, high }) = TypicalRatio::of(ratios) else {
        println!("  {size} B: too few rounds for a ratio of {figure}");
        return;
    };
    let verdict = match () {
        () if figure != "p50" => "",
        () if high <= AIM => "PASS",
        () if low > AIM => "FAIL",
        () => "UNDECIDED",
    };
    let aim = if figure == "p50" {
        format!(", aim at most {AIM}")
    } else {
        String::new()
    };
    println!(
        "  {verdict:<9} {size} B: {figure} sealed / plain {ratio:.4} [{low:.4}, {high:.4}], {count} rounds{aim}"
    );
    let quantiles = quantiles.map(|found| found.map(|found| found.to_json()));
    println!(
        "{}",
        json!({
            "bench": "secured_hop", "bytes": size, "figure": figure, "ratio": ratio,
            "interval_95": [low, high], "rounds": count, "aim_max": (figure == "p50").then_some(AIM),
            "verdict": verdict, "quantiles": quantiles,
        })
    );
}

/// Both ends of a channel that agreed on keys.
fn agreed(suite: Suite) -> Option<(Initiator, Responder)> {
    let known = association(suite);
    let mut sender = Initiator::new(&known, [1; 16], Rotation::default());
    let mut receiver = Responder::new(&known, &[2; 32], Rotation::default());
    let mut request = sender.request_before(&datagram(Kind::Hello, 0, 60))?;
    let Ok(Opened::Answer(mut answer)) = receiver.open(&mut request) else {
        return None;
    };
    sender.open(&mut answer).ok()?;
    Some((sender, receiver))
}

/// What sealing and opening take by themselves, nanoseconds.
fn price(suite: Suite, size: usize) {
    const COUNT: u64 = 100_000;
    let Some((mut sender, mut receiver)) = agreed(suite) else {
        return;
    };
    let plain = datagram(Kind::Data, 0, size);
    let mut sealed = vec![0; plain.len() + TAG_BYTES];
    let (mut sealing, mut opening) = (Duration::ZERO, Duration::ZERO);
    let mut opened_count = 0_u64;
    for _ in 0..COUNT {
        let began = WallInstant::now();
        black_box(sender.seal(black_box(&plain), &mut sealed));
        let between = WallInstant::now();
        opened_count += u64::from(receiver.open(black_box(&mut sealed)).is_ok());
        opening += between.elapsed();
        sealing += between - began;
    }
    let each = |all: Duration| all.as_nanos() as f64 / COUNT as f64;
    println!(
        "  {:<18} {size:>5} B  seal {:7.1} ns  open {:7.1} ns  ({opened_count} of {COUNT} opened; two clock reads in each)",
        suite.label(),
        each(sealing),
        each(opening)
    );
}

/// What it takes to refuse a datagram, nanoseconds, by what is wrong with it.
fn price_of_refusal(size: usize) {
    const COUNT: u32 = 100_000;
    let Some((mut sender, mut receiver)) = agreed(Suite::Aes256Gcm) else {
        return;
    };
    let plain = datagram(Kind::Data, 0, size);
    let mut sealed = vec![0; plain.len() + TAG_BYTES];
    if sender.seal(&plain, &mut sealed).is_none() {
        return;
    }
    let wrong = |at: usize| {
        let mut bytes = sealed.clone();
        bytes[at] ^= 1;
        bytes
    };
    for (cause, bytes) in [
        ("not sealed", plain.clone()),
        ("foreign session", wrong(8)),
        ("forged", wrong(HEADER_BYTES)),
        ("replayed", sealed.clone()),
    ] {
        // A replay is one of what was taken once.
        let mut taken = sealed.clone();
        let _again = receiver.open(&mut taken).is_err();
        let (mut refused_count, mut spent) = (0_u64, Duration::ZERO);
        for _ in 0..COUNT {
            // Opening may write into what it refuses.
            taken.clear();
            taken.extend_from_slice(&bytes);
            let began = WallInstant::now();
            refused_count += u64::from(receiver.open(black_box(&mut taken)).is_err());
            spent += began.elapsed();
        }
        let each = spent.as_nanos() as f64 / f64::from(COUNT);
        println!(
            "  {cause:<18} {size:>5} B  refused in {each:7.1} ns  ({refused_count} of {COUNT} refused)"
        );
    }
}

/// A number from the environment.
fn setting(variable: &str, otherwise: u64) -> Result<u64, SetupError> {
    match std::env::var(variable) {
        Ok(text) => text
            .parse()
            .map_err(|error| format!("{variable}={text}: {error}").into()),
        Err(_unset) => Ok(otherwise),
    }
}

fn measure() -> Result<(), SetupError> {
    let rounds: u64 = setting("HIL_SECURED_ROUNDS", 100)?;
    let length = Duration::from_millis(setting("HIL_SECURED_TURN_MS", 1_150)?);
    let facts = HostFacts::read("nothing pinned; the parties block");
    println!(
        "{}\n{rounds} rounds of two turns of {length:?}, order by lot of seed {SEED}; ratios of each round's \
         quantiles, the mean of their logarithms without the fifth at either end, 95 % bootstrap interval",
        facts.to_json()
    );
    println!("\nby itself");
    for suite in [Suite::Aes256Gcm, Suite::ChaCha20Poly1305] {
        for size in SIZES {
            price(suite, size);
        }
    }
    println!("\nrefused, AES-256-GCM");
    for size in SIZES {
        price_of_refusal(size);
    }
    let network = Network::open();
    println!("\nover the hop, AES-256-GCM, {}", network.note());
    let mut hops = [open(&network, 0)?, open(&network, 1)?];
    for size in SIZES {
        let before = MachineTime::read();
        compare(&mut hops, size, rounds, length);
        println!("  {}", stolen_text(before, MachineTime::read()));
    }
    Ok(())
}

fn main() -> ExitCode {
    if let Err(error) = measure() {
        println!("secured_hop: not measurable here: {error}");
    }
    ExitCode::SUCCESS
}
