//! Viewers that keep to no limit, beside a run: the recorder stays small, says whom it sent away and why, and
//! the run loses nothing that it does not put down to its host.

use std::fs;
use std::io::{Error, ErrorKind, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use hil_account::MessageFate;
use hil_report::assessment::{Assessment, NetworkVerdict, SKIPPED_TICK_RATIO_MAX};
use hil_report::summary::Outcome;
use hil_tests::account::{account, assert_every_message_is_accounted_for, carried, describe};
use hil_tests::child::ChildGuard;
use hil_tests::live_server::LiveServer;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::Trial;
use nix::sys::signal::Signal;

use super::live_access::{Asked, LIMIT, ask_as_program};

/// How long they try, each again and again; longer while none of a kind was told why it is sent away.
const SPAN: Duration = Duration::from_secs(6);
const SPAN_UNTOLD: Duration = Duration::from_secs(10);
const MEMORY_MAX_MB: u64 = 200;
/// Connections that say nothing, or only half a head, at the socket and at the page.
const SILENT: usize = 100;

/// Figures of /proc/<pid>/status, MB: present and largest resident memory.
fn memory_mb(child: &ChildGuard) -> [u64; 2] {
    let status = fs::read_to_string(format!("/proc/{}/status", child.pid())).unwrap();
    ["VmRSS:", "VmHWM:"].map(|key| {
        let line = status.lines().find_map(|line| line.strip_prefix(key));
        let kib = line.and_then(|line| line.trim().split(' ').next()?.parse::<u64>().ok());
        kib.unwrap() / 1024
    })
}

/// The beginning of a frame of a client whose mask is zero.
fn head(first: u8, length: u64) -> Vec<u8> {
    let mut head = vec![first];
    match length {
        0..126 => head.push(0x80 | u8::try_from(length).unwrap()),
        126..0x1_0000 => {
            head.push(0xFE);
            head.extend(u16::try_from(length).unwrap().to_be_bytes());
        }
        _ => {
            head.push(0xFF);
            head.extend(length.to_be_bytes());
        }
    }
    head.extend([0; 4]);
    head
}

fn frame(first: u8, content: &[u8]) -> Vec<u8> {
    [head(first, content.len() as u64), content.to_vec()].concat()
}

fn text(content: &str) -> Vec<u8> {
    frame(0x81, content.as_bytes())
}

/// Topics that every server offers first.
const TOPICS: u32 = 6;

/// A subscription to them.
pub(super) fn subscribe() -> Vec<u8> {
    let each = |id: u32| format!("{{\"id\":{id},\"channelId\":{id}}}");
    let all: Vec<_> = (1..=TOPICS).map(each).collect();
    text(&format!(
        "{{\"op\":\"subscribe\",\"subscriptions\":[{}]}}",
        all.join(",")
    ))
}

fn subscribe_and_unsubscribe(_: u64) -> Vec<u8> {
    let ids: Vec<_> = (1..=TOPICS).map(|id| id.to_string()).collect();
    let ids = ids.join(",");
    let unsubscribe = format!("{{\"op\":\"unsubscribe\",\"subscriptionIds\":[{ids}]}}");
    [subscribe(), text(&unsubscribe)].concat()
}

/// Names of parameters that nobody has named before.
fn want_parameters(round: u64) -> Vec<u8> {
    let names: Vec<_> = (0..100)
        .map(|index| format!("\"{round}.{index}\""))
        .collect();
    let names = names.join(",");
    text(&format!(
        "{{\"op\":\"subscribeParameterUpdates\",\"parameterNames\":[{names}]}}"
    ))
}

fn endless_frame(round: u64) -> Vec<u8> {
    if round == 0 {
        head(0x82, 1 << 40)
    } else {
        vec![0; 65_536]
    }
}

fn endless_message(round: u64) -> Vec<u8> {
    frame(if round == 0 { 0x02 } else { 0x00 }, &vec![0; 65_000])
}

/// What a viewer sends, round by round.
type Flood = fn(u64) -> Vec<u8>;

fn pings(_: u64) -> Vec<u8> {
    frame(0x89, &[b'x'; 125]).repeat(100)
}

fn nonsense(_: u64) -> Vec<u8> {
    text("x").repeat(1000)
}

/// Viewers that all do the same.
#[derive(Clone, Copy)]
struct Kind {
    what: &'static str,
    flood: Flood,
    viewers: usize,
    /// Whether they take what they are sent.
    reads: bool,
    /// What they are told when they are sent away. One without room for it gets no frame, and of one that
    /// takes no answers to its pings nothing is read.
    told: Option<&'static str>,
}

const RATE: &str = "sent more than 1024 KiB at once and 64 KiB a second";
const LENGTH: &str = "sent a message of more than 128 KiB";
const NAMES: &str = "subscribes to updates of more than 4096 parameters";

fn kinds() -> [Kind; 7] {
    let kind = |what, flood, viewers, told| Kind {
        what,
        flood,
        viewers,
        reads: false,
        told,
    };
    let reading = |what, flood, viewers| Kind {
        reads: true,
        ..kind(what, flood, viewers, Some(RATE))
    };
    [
        kind("pings", pings, 4, None),
        reading("pings, answers read", pings, 2),
        kind("an endless frame", endless_frame, 2, Some(LENGTH)),
        kind("an endless message", endless_message, 4, Some(LENGTH)),
        reading("subscriptions", subscribe_and_unsubscribe, 4),
        kind("names", want_parameters, 2, Some(NAMES)),
        kind("nonsense", nonsense, 4, None),
    ]
}

/// As much of what a viewer was sent last is kept.
const TAIL_BYTES: usize = 1024;

/// One that is let in as soon as there is a seat; a crowd may push it out before it has asked.
fn let_in(server: &str) -> Asked {
    let deadline = Instant::now() + LIMIT;
    loop {
        let mut asked = ask_as_program(server);
        let mut answer = [0; 12];
        let is_whole = asked.stream.read_exact(&mut answer).is_ok();
        if is_whole && answer == *b"HTTP/1.1 101" {
            return asked;
        }
        assert!(Instant::now() < deadline, "no seat");
        thread::sleep(Duration::from_millis(50));
    }
}

/// Sends until it is sent away, again and again; how often it was. `is_told` says whether one of its kind was told why.
fn flood(server: &str, kind: Kind, is_told: &AtomicBool) -> u64 {
    let (began, mut count) = (Instant::now(), 0);
    let is_told_why = || is_told.load(Ordering::Relaxed);
    let is_over = || began.elapsed() >= if is_told_why() { SPAN } else { SPAN_UNTOLD };
    let second = Some(Duration::from_secs(1));
    while !is_over() {
        let stream = let_in(server).stream;
        stream.set_write_timeout(second).unwrap();
        stream.set_read_timeout(second).unwrap();
        let reading = kind.reads.then(|| {
            let stream = stream.try_clone().unwrap();
            thread::spawn(move || tail_of(&stream))
        });
        let sent = (0..).find_map(|round| {
            let sent = (&stream).write_all(&(kind.flood)(round));
            let over = || is_over().then(|| ErrorKind::WouldBlock.into());
            sent.err().or_else(over)
        });
        let is_held = sent.is_some_and(|error: Error| error.kind() == ErrorKind::WouldBlock);
        if is_held && is_told_why() {
            // It has its seat, and is not read.
            while !is_over() {
                thread::sleep(Duration::from_millis(20));
            }
        }
        if is_held {
            // Its reader notices.
            let _is_there = stream.shutdown(Shutdown::Both).is_ok();
        } else {
            count += 1;
        }
        let tail = reading.map_or_else(|| tail_of(&stream), |reading| reading.join().unwrap());
        let tail = String::from_utf8_lossy(&tail);
        if kind.told.is_some_and(|told| tail.contains(told)) {
            is_told.store(true, Ordering::Relaxed);
        }
    }
    count
}

/// The last of what there is to read.
fn tail_of(mut stream: &TcpStream) -> Vec<u8> {
    let (mut tail, mut bytes) = (Vec::new(), vec![0; 1 << 16]);
    // It may be cut off, after what was said before.
    while let Ok(length @ 1..) = stream.read(&mut bytes) {
        tail.extend_from_slice(&bytes[..length]);
        tail.drain(..tail.len().saturating_sub(TAIL_BYTES));
    }
    tail
}

/// Subscribes to everything and reads a byte a second.
fn crawl(server: &str) {
    let began = Instant::now();
    let mut viewer = let_in(server);
    viewer.stream.write_all(&subscribe()).unwrap();
    while began.elapsed() < SPAN {
        viewer.stream.read_exact(&mut [0]).unwrap();
        thread::sleep(Duration::from_secs(1));
    }
}

#[test]
fn viewers_without_measure_take_little_memory_and_cost_the_run_nothing() {
    let folder = RunFolder::new("floods");
    let trial = Trial::shipped("local.toml", folder.path()).set("run.duration=\"10 min\"");
    let mut run = trial.start_here();
    let files = trial.folder("", LIMIT);
    let name = files.root().file_name().unwrap().to_string_lossy();
    let server = LiveServer::start(&["--wait", &name]);
    ask_as_program(&server.socket).is_let_in();
    let [before_mb, _] = memory_mb(&server.child);
    let socket = &server.socket;
    let (results, silent) = thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| crawl(socket));
        }
        let begun = kinds().map(|kind| {
            let is_told = Arc::new(AtomicBool::new(kind.told.is_none()));
            let each = (0..kind.viewers).map(|_| {
                let is_told = Arc::clone(&is_told);
                scope.spawn(move || flood(socket, kind, &is_told))
            });
            (kind, each.collect::<Vec<_>>(), is_told)
        });
        // When the others are in.
        thread::sleep(SPAN / 4);
        let silent = (0..SILENT).flat_map(|_| [socket, &server.page]);
        let silent = silent.map(|address| Asked::send(address, b"GET / HTTP/1.1\r\nHost: local"));
        let silent: Vec<_> = silent.collect();
        let results = begun.map(|(kind, each, is_told)| {
            let counts = each.into_iter().map(|one| one.join().unwrap());
            (kind, counts.sum::<u64>(), is_told)
        });
        (results, silent)
    });
    let [after_mb, most_mb] = memory_mb(&server.child);
    println!("resident memory: {before_mb} MB before, {after_mb} MB after, {most_mb} MB at most");
    for (kind, count, _) in &results {
        println!("{}: sent away {count} times", kind.what);
    }
    assert!(most_mb <= MEMORY_MAX_MB, "{most_mb} MB");
    for (kind, _, is_told) in &results {
        assert!(is_told.load(Ordering::Relaxed), "{}", kind.what);
    }
    // Others are served.
    drop(let_in(&server.socket));
    assert_eq!(server.get("GET /config.json").0, "200");
    drop(silent);
    assert!(run.is_running(), "{}", run.stderr_so_far());
    run.signal(Signal::SIGINT).unwrap();
    run.wait_within(LIMIT).unwrap().assert_code(130);
    let said = server.end().stderr;
    let refused = said.lines().rfind(|line| line.contains(" × ")).unwrap();
    println!("{refused}");
    // Each cause is printed once; the account names the most frequent only.
    let viewers = [RATE, LENGTH, NAMES].map(|told| format!("refused a viewer that {told}"));
    let silent = "refused a connection that said nothing while 64 more came";
    for words in viewers.iter().map(String::as_str).chain([silent]) {
        assert!(said.contains(words), "{words}: {said}");
    }
    let summary = files.summary();
    assert_eq!(summary.run.outcome, Outcome::Stopped);
    assert_every_message_is_accounted_for(&summary);
    // A starved host may lose messages; the run then says so itself.
    let network = Assessment::of(&summary).network;
    let is_of_host = matches!(
        network,
        NetworkVerdict::HostOverran { .. }
            | NetworkVerdict::EmulationNotKept { .. }
            | NetworkVerdict::ReceiverLate { .. }
    );
    for channel in carried(&summary) {
        let account = account(&summary, &channel.name);
        let lost = MessageFate::ALL.into_iter().filter(|fate| fate.is_loss());
        let lost: u64 = lost.map(|fate| account.fates.of(fate)).sum();
        let said = describe(&channel.name, account);
        println!("{said}");
        let may_lose = SKIPPED_TICK_RATIO_MAX * account.published_count as f64;
        assert!(is_of_host || lost as f64 <= may_lose, "{said}, {network:?}");
    }
}
