//! Strangers on the wire of a sealed run: one who spoofs a host's address and sends what a gateway might
//! take, and connections to the supervisors' port that never become a greeting.
//!
//! `HIL_ATTACK_SECONDS=30` attacks for longer, after a quiet run of the same length;
//! `HIL_ATTACK_BUFFER_BYTES=4194304` gives the gateways' sockets that much room, and
//! `HIL_ATTACK_FIFO=1` the run real-time priority on the second processor; `taskset -c 0` keeps the stranger off it.

use std::net::SocketAddrV4;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use std::{env, fs, thread};

use hil_account::MessageFate;
use hil_core::random::RandomStream;
use hil_platform::clock::MonotonicClock;
use hil_report::summary::{DirectionSummary, RunSummary};
use hil_tests::account::{account, assert_accounts_close};
use hil_tests::attacker::{Attacker, FOREIGN, Flood};
use hil_tests::knocker::{CONTROL_PORT, Knocked, knock};
use hil_tests::lab::{ADDRESSES, Lab};
use hil_tests::latency::Latencies;
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::CHANNELS;
use hil_tests::soak::held::Held;
use hil_tests::split::{Split, count, count_of_channel, delays, direction, refused};
use hil_tests::trial::Trial;
use nix::unistd::Pid;

const LIMIT: Duration = Duration::from_mins(1);
/// Every process of the run before whatever else the machine does, on the second processor.
const REAL_TIME: [&str; 6] = [
    "links.hop.gateway.scheduling=\"fifo\"",
    "links.hop.gateway.cpu=1",
    "processes.controller.scheduling=\"fifo\"",
    "processes.controller.cpu=1",
    "processes.robot.scheduling=\"fifo\"",
    "processes.robot.cpu=1",
];
/// No other file of tests uses these ports.
const PORT: u16 = 7840;
/// Datagrams the stranger sends in a second, if it can.
const RATE: u32 = 100_000;
/// Messages a second of each channel: enough for a p99.9 of a few seconds.
const MESSAGES_HZ: u32 = 1_000;
/// Different datagrams of the stranger; then it begins again.
const MADE_UP: u64 = 45_000;
/// Largest ratio of the 99th percentiles that is aimed at. It is printed, not asserted: it is a time.
const RATIO_AIM: f64 = 2.0;
/// Datagrams of the gateway that ends later, which meet no socket any more: a farewell, a clock exchange.
const LAST_WORDS_MAX: u64 = 8;
/// What a gateway's resident memory may differ between two moments without having grown.
const MEMORY_MORE_MAX: u64 = 8 << 20;

/// One after the other: a recorded datagram, the same with a bit flipped, cut, with another payload, as a
/// plain one, of another channel, of another session, of another version, and noise.
pub(super) fn made_up(recorded: &[Vec<u8>], random: &mut RandomStream, number: u64) -> Vec<u8> {
    let index = usize::try_from(random.next_u64() % recorded.len() as u64).unwrap();
    let mut out = recorded[index].clone();
    let byte = random.next_u64().to_le_bytes();
    match number % 9 {
        0 => {}
        1 => {
            let bit = usize::try_from(random.next_u64() % (out.len() as u64 * 8)).unwrap();
            out[bit / 8] ^= 1 << (bit % 8);
        }
        2 => out.truncate(usize::from(byte[0]) % out.len()),
        3 => {
            let end = out.len();
            out[72..end - 16].fill(byte[0]);
            out[68..72].copy_from_slice(&byte[..4]);
        }
        4 => {
            out[6..8].fill(0);
            out[68..72].fill(0);
            out.truncate(out.len() - 16);
        }
        // A request for keys of another flow.
        5 => {
            out[5] = 7;
            out[12] = !out[12];
        }
        6 => out[8..12].copy_from_slice(&byte[..4]),
        7 => out[4] = 1,
        _ => {
            out.clear();
            out.extend((0..100).map(|_| random.next_u64().to_le_bytes()[0]));
        }
    }
    out
}

/// Seconds of the attack: `HIL_ATTACK_SECONDS`, else 5.
fn attack_span() -> Duration {
    let asked = env::var("HIL_ATTACK_SECONDS").ok();
    let seconds = asked.and_then(|text| text.parse().ok());
    Duration::from_secs(seconds.unwrap_or(5))
}

/// Processor time that the thread which takes commands has had, nanoseconds.
fn ingress_ns(gateway: Pid) -> u64 {
    let tasks = fs::read_dir(format!("/proc/{gateway}/task")).unwrap();
    let times = tasks.flatten().filter_map(|task| {
        let name = fs::read_to_string(task.path().join("comm")).ok()?;
        let is_it = name.trim() == "in hop/forward";
        let times = fs::read_to_string(task.path().join("schedstat")).ok()?;
        is_it.then(|| times.split(' ').next()?.parse::<u64>().ok())?
    });
    times.sum()
}

/// Datagrams that this machine's processors had no room for on their way up the stack.
fn backlog_drops() -> u64 {
    let text = fs::read_to_string("/proc/net/softnet_stat").unwrap();
    let dropped = text
        .lines()
        .filter_map(|line| line.split_whitespace().nth(1));
    dropped
        .filter_map(|hex| u64::from_str_radix(hex, 16).ok())
        .sum()
}

/// What one run came to.
struct Phase {
    summaries: [RunSummary; 2],
    flood: Flood,
    /// Of the commands that were published meanwhile, over the hop and end to end.
    commands: [Latencies; 2],
    /// Of the states, which nobody attacks, but which share the processors.
    states: [Latencies; 2],
    /// Resident memory of the attacked gateway at the start, the quarters and the end.
    memory: Vec<u64>,
    ingress_ns: u64,
    backlog_drops: u64,
}

/// A run of `span` on which the stranger only listens, or else attacks.
fn play(record: &Path, lab: &Lab, stranger: &Attacker, span: Duration, attacks: bool) -> Phase {
    let duration = format!("run.duration=\"{} s\"", span.as_secs() + 600);
    let trial = Trial::shipped("shuttle-split.toml", record)
        .set(&format!("links.hop.port={PORT}"))
        .set(&format!("case.parameters.rate_hz={MESSAGES_HZ}.0"))
        .set(&duration);
    let trial = match env::var("HIL_ATTACK_BUFFER_BYTES") {
        Ok(bytes) => trial.set(&format!("links.hop.receive_buffer_bytes={bytes}")),
        Err(_unset) => trial,
    };
    let trial = if env::var_os("HIL_ATTACK_FIFO").is_some() {
        REAL_TIME.into_iter().fold(trial, Trial::set)
    } else {
        trial
    };
    let split = Split::start(lab, &trial);
    split.wait_for_messages("the begin of the run");
    let recorded = stranger.overhear(PORT, 200, LIMIT);
    assert!(recorded.len() >= 200, "the stranger hears the wire");
    let mut random = RandomStream::new(9, "attack");
    let datagrams = (0..MADE_UP).map(|number| made_up(&recorded, &mut random, number));
    let datagrams: Vec<Vec<u8>> = datagrams.collect();
    let gateway = split.files[1].process("gateway-hop-robot-pc", 0).unwrap();
    let (worked_ns, dropped) = (ingress_ns(gateway), backlog_drops());
    let from_ns = MonotonicClock::now().as_ns();
    let (flood, memory) = thread::scope(|scope| {
        let watching = scope.spawn(|| watch_memory(gateway, span));
        let flood = if attacks {
            let from = SocketAddrV4::new(ADDRESSES[0], PORT);
            let to = SocketAddrV4::new(ADDRESSES[1], PORT);
            stranger.flood(from, to, span, RATE, &datagrams)
        } else {
            thread::sleep(span);
            Flood::default()
        };
        (flood, watching.join().unwrap())
    });
    let window_ns = from_ns..MonotonicClock::now().as_ns();
    let worked_ns = ingress_ns(gateway) - worked_ns;
    let files = [0, 1].map(|index| split.files[index].clone());
    let summaries = split.stop();
    Phase {
        summaries,
        flood,
        commands: delays(&files[1], CHANNELS[0], window_ns.clone()),
        states: delays(&files[0], CHANNELS[1], window_ns),
        memory,
        ingress_ns: worked_ns,
        backlog_drops: backlog_drops() - dropped,
    }
}

fn watch_memory(gateway: Pid, span: Duration) -> Vec<u64> {
    let began = Instant::now();
    let moments = (0..=4).map(|quarter| {
        thread::sleep((span * quarter / 4).saturating_sub(began.elapsed()));
        Held::of(gateway).unwrap().resident_bytes
    });
    moments.collect()
}

fn print_delays(quiet: &Phase, attacked: &Phase) {
    for (channel, quiet, attacked) in [
        (CHANNELS[0], &quiet.commands, &attacked.commands),
        (CHANNELS[1], &quiet.states, &attacked.states),
    ] {
        for (way, quiet, attacked) in [
            ("over the hop", &quiet[0], &attacked[0]),
            ("end to end", &quiet[1], &attacked[1]),
        ] {
            println!("{channel} {way}, quiet:    {quiet}");
            println!("{channel} {way}, attacked: {attacked}");
            let ratio = |per_mille| {
                let of = |some: &Latencies| some.quantile_ns(per_mille).unwrap() as f64;
                of(attacked) / of(quiet)
            };
            let (p50, p99, most) = (ratio(500), ratio(990), ratio(999));
            let holds = if p99 <= RATIO_AIM {
                "holds"
            } else {
                "does NOT hold"
            };
            println!(
                "{channel} {way}: attacked / quiet p50 {p50:.2}, p99 {p99:.2}, p99.9 {most:.2}; \
                 p99 at most {RATIO_AIM} times that of the quiet run {holds}"
            );
        }
    }
}

fn assert_refused_by_cause(ingress: &DirectionSummary) {
    for cause in [
        "replayed",
        "forged or damaged",
        "too short",
        "not sealed",
        "foreign flow",
        "foreign session",
        "wrong version",
        "foreign protocol",
    ] {
        let counted = count(ingress, &format!("refused: {cause}"));
        println!("refused, {cause}: {counted}");
        assert!(counted > 0, "{cause}: {:?}", ingress.counters);
    }
}

/// Every datagram that was sent to the attacked port was opened, answered, refused, or had no room.
fn assert_reconciled(phase: &Phase) {
    let [control, robot] = &phase.summaries;
    let ingress = direction(robot, CHANNELS[0], "ingress");
    let sender = direction(control, CHANNELS[0], "egress");
    let received = count(ingress, "socket: received_count");
    let no_room = count(ingress, "socket: kernel_drop_count");
    let opened = count(ingress, "seal: opened_count");
    let exchanged = count(ingress, "seal: key_exchange_count");
    let refused = refused(ingress);
    assert_eq!(
        received,
        opened + exchanged + refused,
        "{:?}",
        ingress.counters
    );
    let sealed = count(sender, "seal: sealed_count");
    assert!(opened <= sealed, "{opened} opened, {sealed} sealed");
    assert_eq!(opened, count(ingress, "datagram_count"));
    assert_eq!(
        count_of_channel(robot, CHANNELS[0], "messages: duplicate_count"),
        0
    );
    let (stranger, peer) = (phase.flood.sent_count, count(sender, "socket: sent_count"));
    let missing = (stranger + peer).checked_sub(received + no_room);
    println!(
        "{stranger} of the stranger and {peer} of the peer sent; {received} received: {opened} opened, \
         {exchanged} requests for keys, {refused} refused; {no_room} had no room in the socket's buffer; \
         {missing:?} came to neither, and {} fell out of a processor's queue on this machine",
        phase.backlog_drops
    );
    let missing = missing.expect("no more received than sent");
    assert!(
        missing <= phase.backlog_drops + LAST_WORDS_MAX,
        "{missing} unaccounted for"
    );
    let lost = account(robot, CHANNELS[0])
        .fates
        .of(MessageFate::LostOnWire);
    println!("{lost} commands lost, each among those without room");
    assert!(lost <= no_room + missing, "{lost} lost without a cause");
}

#[test]
fn a_stranger_with_a_hosts_address_gets_nothing_in_and_stops_nothing() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let stranger = Attacker::join(&lab, ADDRESSES[0]);
    let span = attack_span();
    let (quiet, record) = (RunFolder::new("quiet"), RunFolder::new("attacked"));
    println!("quiet run:");
    let calm = play(quiet.path(), &lab, &stranger, span, false);
    assert_eq!(
        account(&calm.summaries[1], CHANNELS[0]).fates.lost_count(),
        0
    );
    println!("attacked run:");
    let attacked = play(record.path(), &lab, &stranger, span, true);
    let ingress = direction(&attacked.summaries[1], CHANNELS[0], "ingress");
    println!(
        "{} datagrams of the stranger in {:?}, {:.0} a second; the thread that takes commands had {:.2} us of \
         a processor for each datagram it refused",
        attacked.flood.sent_count,
        attacked.flood.took,
        attacked.flood.rate(),
        attacked.ingress_ns as f64 * 1e-3 / refused(ingress).max(1) as f64
    );
    println!(
        "resident bytes of its process by quarters: quiet {:?}, attacked {:?}",
        calm.memory, attacked.memory
    );
    assert_refused_by_cause(ingress);
    assert_reconciled(&attacked);
    print_delays(&calm, &attacked);
    assert!(attacked.flood.sent_count > 1_000);
    let (before, after) = (attacked.memory[0], attacked.memory[4]);
    assert!(
        after < before + MEMORY_MORE_MAX,
        "memory grew from {before} to {after}"
    );
    for summary in &attacked.summaries {
        assert_accounts_close(summary);
    }
}

/// Connections to the control port in a second, from each of two addresses.
const KNOCKS_HZ: u32 = 1_000;
/// Files and threads that a supervisor may have for connections that said nothing yet, beside its own.
const HALF_OPEN_FILES_MAX: u64 = 800;
const HALF_OPEN_THREADS_MAX: u64 = 300;

/// Most that the supervisor held until `is_over`, and what it held first.
fn watch_supervisor(process: Pid, is_over: impl Fn() -> bool) -> [Held; 2] {
    let first = Held::of(process).unwrap();
    let mut most = first;
    while !is_over() {
        if let Some(held) = Held::of(process) {
            most.file_count = most.file_count.max(held.file_count);
            most.thread_count = most.thread_count.max(held.thread_count);
            most.anonymous_bytes = most.anonymous_bytes.max(held.anonymous_bytes);
        }
        thread::sleep(Duration::from_millis(2));
    }
    [first, most]
}

/// Starts the listening host, and the other one when the knocking has gone on for a while.
fn run_knocked_at(lab: &Lab, trial: &Trial, is_over: &AtomicBool) -> ([RunSummary; 2], [Held; 2]) {
    let mut listening = trial.start_on(lab.host(0));
    let said = listening.wait_for_output("waiting for robot-pc", LIMIT);
    if let Err(reason) = said {
        panic!("{reason}");
    }
    let process = listening.pid();
    thread::scope(|scope| {
        let over = || is_over.load(Ordering::Acquire);
        let watching = scope.spawn(move || watch_supervisor(process, over));
        thread::sleep(Duration::from_secs(2));
        assert!(listening.is_running(), "{}", listening.stderr_so_far());
        let split = Split::of(lab, trial, [listening, trial.start_on(lab.host(1))]);
        split.wait_for_messages("the begin of the run");
        // Nobody listens any more; the knocking goes on.
        thread::sleep(Duration::from_secs(2));
        is_over.store(true, Ordering::Release);
        (split.finish(), watching.join().unwrap())
    })
}

#[test]
fn connections_that_never_become_a_greeting_keep_no_run_from_its_start_or_end() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    lab.host(1).add_address(FOREIGN);
    let record = RunFolder::new("knocked");
    let trial = Trial::shipped("shuttle-split.toml", record.path())
        .set(&format!("links.hop.port={PORT}"))
        .set("run.duration=\"5 s\"");
    let is_over = AtomicBool::new(false);
    let control = SocketAddrV4::new(ADDRESSES[0], CONTROL_PORT);
    let (knocked, (summaries, [first, most])) = thread::scope(|scope| {
        // One from the address of the host that is awaited, one from an address that is not.
        let knocking = [ADDRESSES[1], FOREIGN].map(|from| {
            let (lab, is_over) = (&lab, &is_over);
            scope.spawn(move || knock(lab.host(1), from, control, KNOCKS_HZ, is_over))
        });
        let run = run_knocked_at(&lab, &trial, &is_over);
        (knocking.map(|one| one.join().unwrap()), run)
    });
    for (
        from,
        Knocked {
            tried_count,
            held_count,
            refused_count,
        },
    ) in ["the awaited host's address", "a foreign one"]
        .iter()
        .zip(knocked)
    {
        println!(
            "from {from}: {tried_count} connections tried, {held_count} of them opened or under way, \
             {refused_count} refused by the kernel"
        );
        assert!(tried_count > u64::from(KNOCKS_HZ) && held_count > 100);
    }
    println!("the listening supervisor first: {first:?}\nand at most: {most:?}");
    let [control, _] = &summaries;
    let security = control.run.security.as_ref().unwrap();
    let security = security.to_string();
    println!("{security}");
    for words in [
        "connections came to nothing",
        "from 10.77.0.66 of an address that is not awaited",
        "another key",
    ] {
        assert!(security.contains(words), "{words}: {security}");
    }
    assert!(most.file_count < first.file_count + HALF_OPEN_FILES_MAX);
    assert!(most.thread_count < first.thread_count + HALF_OPEN_THREADS_MAX);
    assert!(most.anonymous_bytes < first.anonymous_bytes + (64 << 20));
    for summary in &summaries {
        assert_accounts_close(summary);
    }
}
