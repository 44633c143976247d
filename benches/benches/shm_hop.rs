//! What one hop through shared memory costs: ping-pong between two pinned threads, ours against
//! bare iceoryx2 against a bare cache line. Not a test: it asserts nothing about time.
//!
//! `cargo bench -p hil-benches --bench shm_hop [-- --rounds 20]`, about 15 s. Both threads spin,
//! so it wants two processors of its own; `chrt -f 40` keeps ordinary neighbours away.
#![allow(clippy::print_stdout, reason = "a bench prints its result")]
#![allow(
    clippy::unwrap_used,
    reason = "a bench that cannot start may stop with a backtrace"
)]

use std::cell::RefCell;
use std::hint::black_box;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use hil_benches::{Case, Comparison, HostFacts, compare, json_line, pin_to_cpu, table};
use hil_core::endpoint::{InputPort, OutputPort};
use hil_core::message::MessageType;
use hil_core::time::Instant as HostInstant;
use hil_platform::clock::MonotonicClock;
use hil_platform::domain_address::DomainAddress;
use hil_shm::{
    ChannelHolder, ChannelSettings, Domain, OutputSettings, ShmInput, ShmOutput, TypedInput,
    TypedOutput, Waiter,
};
use iceoryx2::node::{Node, NodeBuilder};
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::{Config, FileName, Path, SemanticString, ZeroCopySend, ipc};

hil_core::message! {
    /// One cache line, as a joint command has.
    #[derive(Default, ZeroCopySend)]
    #[type_name("bench.Line.v1")]
    struct Line = "bench.Line.v1", 64 bytes { count: u64, fill: [u64; 7] }
}

fn line(count: u64) -> Line {
    Line {
        count,
        fill: [count; 7],
    }
}

const SLICE: Duration = Duration::from_millis(100);
const ROUNDS: usize = 16;
const IDLE: usize = usize::MAX;
const STOP: usize = usize::MAX - 1;
const FLOOR: usize = usize::MAX - 2;
/// Where the kernel happens to put a channel's pages moves a round trip by up to a quarter, so
/// every case has this many channels and the rounds take turns with them.
const PLACEMENTS: usize = 4;
/// Longest sleep of a blocking echo before it looks whether its turn is over.
const LOOK: Duration = Duration::from_millis(10);

/// One side of a ping-pong.
trait Side {
    fn send(&mut self, count: u64);
    /// What came, or `None`; a blocking side waits for a while first.
    fn receive(&mut self) -> Option<u64>;
}

const CASES: [&str; 6] = [
    "iceoryx2, typed, spin",
    "iceoryx2 + 64 B header + clock, spin",
    "TypedOutput/TypedInput, spin",
    "ShmOutput/ShmInput, spin",
    "iceoryx2, typed, listener",
    "TypedOutput/TypedInput, Waiter",
];
/// Which case each is compared with.
const REFERENCES: [usize; 6] = [0, 0, 0, 0, 4, 4];

/// The sides of all cases for the pinging (`is_ping`) or the echoing thread, placement by
/// placement.
fn sides(address: &DomainAddress, is_ping: bool) -> Vec<Box<dyn Side>> {
    let domain = Domain::open(address).unwrap();
    let node = bare_node(address);
    let mut sides: Vec<Box<dyn Side>> = Vec::new();
    for placement in 0..PLACEMENTS {
        let names = |stem: &str| {
            let outward = if is_ping { "ping" } else { "pong" };
            let homeward = if is_ping { "pong" } else { "ping" };
            let name = |way: &str| format!("{stem}/{placement}/{way}");
            [name(outward), name(homeward)]
        };
        sides.push(Box::new(Bare::open(&node, names("bare-spin"), false)));
        sides.push(Box::new(Stamped::open(&node, names("stamped-spin"))));
        sides.push(Box::new(Typed::open(&domain, names("typed-spin"), false)));
        sides.push(Box::new(Bytes::open(&domain, names("bytes-spin"))));
        sides.push(Box::new(Bare::open(&node, names("bare-block"), true)));
        sides.push(Box::new(Typed::open(&domain, names("typed-block"), true)));
    }
    sides
}

/// iceoryx2 as its own examples use it: no envelope, no stamp.
struct Bare {
    publisher: Publisher<ipc::Service, Line, ()>,
    subscriber: Subscriber<ipc::Service, Line, ()>,
    wake: Option<(Notifier<ipc::Service>, Listener<ipc::Service>)>,
}

fn bare_node(address: &DomainAddress) -> Node<ipc::Service> {
    let mut config = Config::default();
    config.global.prefix = FileName::new(address.prefix().as_bytes()).unwrap();
    let root_path = format!("{}/", address.root_path().display());
    config
        .global
        .set_root_path(&Path::new(root_path.as_bytes()).unwrap());
    NodeBuilder::new().config(&config).create().unwrap()
}

impl Bare {
    fn open(node: &Node<ipc::Service>, names: [String; 2], is_blocking: bool) -> Self {
        let [out, back] = names.map(|name| name.as_str().try_into().unwrap());
        let service = |name| {
            let builder = node.service_builder(name).publish_subscribe::<Line>();
            builder
                .subscriber_max_buffer_size(1)
                .open_or_create()
                .unwrap()
        };
        let event = |name| node.service_builder(name).event().open_or_create().unwrap();
        Self {
            publisher: service(&out).publisher_builder().create().unwrap(),
            subscriber: service(&back).subscriber_builder().create().unwrap(),
            wake: is_blocking.then(|| {
                let notifier = event(&out).notifier_builder().create().unwrap();
                (notifier, event(&back).listener_builder().create().unwrap())
            }),
        }
    }

    fn look(&self) -> Option<u64> {
        self.subscriber
            .receive()
            .unwrap()
            .map(|sample| sample.count)
    }
}

impl Side for Bare {
    fn send(&mut self, count: u64) {
        let loan = self.publisher.loan_uninit().unwrap();
        loan.write_payload(line(count)).send().unwrap();
        if let Some((notifier, _)) = &self.wake {
            notifier.notify().unwrap();
        }
    }

    fn receive(&mut self) -> Option<u64> {
        let found = self.look();
        match &self.wake {
            Some((_, listener)) if found.is_none() => {
                listener.timed_wait(|_| {}, LOOK).unwrap();
                self.look()
            }
            _ => found,
        }
    }
}

/// What an envelope with a stamp costs whoever writes it: iceoryx2 with a header of one cache line
/// and one clock reading per message, and nothing else.
struct Stamped {
    publisher: Publisher<ipc::Service, Line, Line>,
    subscriber: Subscriber<ipc::Service, Line, Line>,
}

impl Stamped {
    fn open(node: &Node<ipc::Service>, names: [String; 2]) -> Self {
        let [out, back] = names.map(|name| name.as_str().try_into().unwrap());
        let service = |name| {
            let builder = node.service_builder(name).publish_subscribe::<Line>();
            let builder = builder.user_header::<Line>().subscriber_max_buffer_size(1);
            builder.open_or_create().unwrap()
        };
        Self {
            publisher: service(&out).publisher_builder().create().unwrap(),
            subscriber: service(&back).subscriber_builder().create().unwrap(),
        }
    }
}

impl Side for Stamped {
    fn send(&mut self, count: u64) {
        let loan = self.publisher.loan_uninit().unwrap();
        let mut sample = loan.write_payload(line(count));
        *sample.user_header_mut() = line(MonotonicClock::now().as_ns().unsigned_abs());
        sample.send().unwrap();
    }

    fn receive(&mut self) -> Option<u64> {
        let sample = self.subscriber.receive().unwrap()?;
        black_box(*sample.user_header());
        Some(sample.count)
    }
}

/// Our channel with its type known at compile time.
struct Typed {
    output: TypedOutput<Line>,
    input: TypedInput<Line>,
    waiter: Option<Waiter>,
}

fn settings(notifies_readers: bool) -> OutputSettings {
    OutputSettings {
        notifies_readers,
        ..OutputSettings::default()
    }
}

impl Typed {
    fn open(domain: &Domain, [out, back]: [String; 2], is_blocking: bool) -> Self {
        Self {
            output: TypedOutput::open(domain, &out, settings(is_blocking)).unwrap(),
            input: TypedInput::open(domain, &back, 1).unwrap(),
            waiter: is_blocking.then(|| Waiter::open(domain, &[&back]).unwrap()),
        }
    }

    fn look(&mut self) -> Option<u64> {
        self.input.receive().unwrap().map(|(_, line)| line.count)
    }
}

impl Side for Typed {
    fn send(&mut self, count: u64) {
        self.output.send(HostInstant::ZERO, line(count)).unwrap();
    }

    fn receive(&mut self) -> Option<u64> {
        let found = self.look();
        match &mut self.waiter {
            Some(waiter) if found.is_none() => {
                waiter.wait(LOOK).unwrap();
                self.look()
            }
            _ => found,
        }
    }
}

/// Our channel as a role uses it: bytes whose type is known at run time.
struct Bytes {
    output: ShmOutput,
    input: ShmInput,
}

impl Bytes {
    fn open(domain: &Domain, [out, back]: [String; 2]) -> Self {
        let message = MessageType::of::<Line>();
        Self {
            output: ShmOutput::open(domain, &out, &message, settings(false)).unwrap(),
            input: ShmInput::open(domain, &back, &message, 1).unwrap(),
        }
    }
}

impl Side for Bytes {
    fn send(&mut self, count: u64) {
        let line = line(count);
        self.output
            .send(HostInstant::ZERO, bytemuck::bytes_of(&line))
            .unwrap();
    }

    fn receive(&mut self) -> Option<u64> {
        let mut found = None;
        let mut take = |_: &_, payload: &[u8]| {
            found = Some(bytemuck::pod_read_unaligned::<Line>(payload).count);
        };
        self.input.receive(HostInstant::ZERO, &mut take).unwrap();
        found
    }
}

/// The floor: one cache line that both threads write in turn, odd by the pinging one.
#[derive(Default)]
#[repr(align(128))]
struct CacheLine(AtomicU64);

/// What the two threads share beside the channels.
#[derive(Default)]
struct Stage {
    turn: AtomicUsize,
    floor: CacheLine,
}

/// Answers whatever case has its turn.
fn echo(stage: &Stage, address: &DomainAddress, ready: &AtomicUsize) {
    pin_to_cpu(1).unwrap();
    let mut sides = sides(address, false);
    ready.store(1, Ordering::Release);
    loop {
        match stage.turn.load(Ordering::Acquire) {
            STOP => return,
            IDLE => thread::sleep(Duration::from_micros(100)),
            FLOOR => {
                let count = stage.floor.0.load(Ordering::Acquire);
                if count % 2 == 1 {
                    stage.floor.0.store(count + 1, Ordering::Release);
                }
            }
            turn => {
                if let Some(count) = sides[turn].receive() {
                    sides[turn].send(count);
                }
            }
        }
    }
}

/// Round trips for one slice, in nanoseconds; the first few warm the caches and do not count.
fn ping(stage: &Stage, turn: usize, mut round_trip: impl FnMut()) -> Vec<u64> {
    const WARM_UP: usize = 200;
    let mut samples = Vec::with_capacity(1 << 20);
    stage.turn.store(turn, Ordering::Release);
    for _ in 0..WARM_UP {
        round_trip();
    }
    let started = Instant::now();
    while started.elapsed() < SLICE && samples.len() < samples.capacity() {
        let sent = Instant::now();
        round_trip();
        samples.push(u64::try_from(sent.elapsed().as_nanos()).unwrap());
    }
    stage.turn.store(IDLE, Ordering::Release);
    samples
}

fn run(rounds: usize) -> Comparison {
    let root_path = std::env::temp_dir().join(format!("hil-shm-hop-{}", std::process::id()));
    let domain = Domain::create(&root_path).unwrap();
    let message = MessageType::of::<Line>();
    let holders: Vec<_> = ["typed-spin", "bytes-spin", "typed-block"]
        .iter()
        .flat_map(|stem| (0..PLACEMENTS).map(move |placement| format!("{stem}/{placement}")))
        .flat_map(|pair| [format!("{pair}/ping"), format!("{pair}/pong")])
        .map(|name| ChannelHolder::create(&domain, &ChannelSettings::of(&name, &message)).unwrap())
        .collect();

    let stage = Arc::new(Stage::default());
    stage.turn.store(IDLE, Ordering::Release);
    let ready = Arc::new(AtomicUsize::new(0));
    let echoing = thread::spawn({
        let (stage, ready, address) = (stage.clone(), ready.clone(), domain.address().clone());
        move || echo(&stage, &address, &ready)
    });
    pin_to_cpu(0).unwrap();
    let mut sides = sides(domain.address(), true);
    while ready.load(Ordering::Acquire) == 0 {
        thread::yield_now();
    }
    let outcome = compare_all(rounds, &stage, &mut sides);
    stage.turn.store(STOP, Ordering::Release);
    echoing.join().unwrap();
    drop((sides, holders));
    let removal = domain.remove();
    assert!(
        removal.remained.is_empty(),
        "left behind: {:?}",
        removal.remained
    );
    outcome
}

fn compare_all(rounds: usize, stage: &Stage, sides: &mut [Box<dyn Side>]) -> Comparison {
    let mut floor = || {
        ping(stage, FLOOR, || {
            let count = stage.floor.0.load(Ordering::Relaxed) + 1;
            stage.floor.0.store(count, Ordering::Release);
            while stage.floor.0.load(Ordering::Acquire) == count {}
        })
    };
    let sides: Vec<_> = sides.iter_mut().map(RefCell::new).collect();
    let mut rounds_of: Vec<_> = (0..CASES.len())
        .map(|case| {
            let sides = &sides;
            let (mut count, mut round) = (0, 0);
            move || {
                let turn = round % PLACEMENTS * CASES.len() + case;
                round += 1;
                let mut side = sides[turn].borrow_mut();
                ping(stage, turn, || {
                    count += 1;
                    side.send(count);
                    while side.receive() != Some(count) {}
                })
            }
        })
        .collect();
    let mut cases: Vec<_> = rounds_of
        .iter_mut()
        .zip(CASES)
        .map(|(round, name)| Case { name, round })
        .collect();
    compare(rounds, &mut floor, &mut cases)
}

fn main() {
    let mut arguments = std::env::args().skip_while(|argument| argument != "--rounds");
    let rounds = arguments
        .nth(1)
        .map_or(ROUNDS, |text| text.parse().unwrap());
    let before = HostFacts::read("ping on cpu 0, echo on cpu 1");
    let outcome = run(rounds);
    println!(
        "{}",
        serde_json::json!({"bench": "shm_hop", "host": before.to_json()})
    );
    for (row, reference) in outcome.rows.iter().zip(REFERENCES) {
        let reference = &outcome.rows[reference];
        println!("{}", json_line("shm_hop", &outcome, row, reference));
    }
    println!(
        "\nround trip, 64 B payload; load {} at the start",
        before.load_average
    );
    println!("{}", table(&outcome, &REFERENCES));
}
