//! What a channel costs on a link: the two gateway processes of the product between two hosts, with 1 to 400
//! channels of 64 bytes, idle and at one total rate of messages. Not a test: it asserts nothing about time.
//!
//! `cargo bench -p hil-benches --bench channels_per_link [-- --seconds 8 --rate 2000 --rounds 3 --channels
//! 1,10,100,400 --images true]`, about 4 minutes, and a channel of 4 MiB beside a small one for half a minute.
//! Processor time, wake-ups and memory are those of the gateways, of both hosts together; a delay is from the
//! publication of a message to its publication on the other host.
#![allow(clippy::print_stdout, reason = "a bench prints its result")]
#![allow(
    clippy::unwrap_used,
    reason = "a bench that cannot start may stop with a backtrace"
)]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::net::SocketAddr;
use std::os::fd::BorrowedFd;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use hil_benches::gateway::network::Network;
use hil_benches::{HostFacts, Quantiles};
use hil_core::message::MessageType;
use hil_platform::clock::MonotonicClock;
use hil_rundir::launch::{DirectionLaunch, Side};
use hil_shm::{
    ChannelHolder, ChannelSettings, Domain, OutputSettings, RawInput, ShmOutput, Waiter,
};
use hil_tests::worker::{self, Worker};
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::time::{TimeSpec, TimeValLike};
use serde_json::json;

const MESSAGE: MessageType = MessageType {
    name: "bench.Bytes.v1",
    size_bytes: 64,
    alignment_bytes: 8,
    fields: &[],
};
/// A camera's.
const IMAGE: MessageType = MessageType {
    name: "bench.Image.v1",
    size_bytes: 4 << 20,
    alignment_bytes: 8,
    fields: &[],
};
const IMAGE_PERIOD: Duration = Duration::from_nanos(1_000_000_000 / 30);
const COMMAND_PERIOD: Duration = Duration::from_millis(1);
const DEPTH: usize = 16;
/// After a change of load, before figures are taken.
const SETTLING: Duration = Duration::from_secs(1);

struct Options {
    seconds: u64,
    rate_hz: u64,
    rounds: usize,
    channels: Vec<usize>,
    with_images: bool,
}

impl Options {
    fn of_arguments() -> Self {
        let mut options = Self {
            seconds: 8,
            rate_hz: 2_000,
            rounds: 3,
            channels: vec![1, 10, 100, 400],
            with_images: true,
        };
        let mut arguments = std::env::args().skip(1).filter(|one| one != "--bench");
        while let Some(key) = arguments.next() {
            let value = arguments.next().unwrap_or_default();
            match key.as_str() {
                "--seconds" => options.seconds = value.parse().unwrap(),
                "--rate" => options.rate_hz = value.parse().unwrap(),
                "--images" => options.with_images = value.parse().unwrap(),
                "--rounds" => options.rounds = value.parse().unwrap(),
                "--channels" => {
                    options.channels = value.split(',').map(|one| one.parse().unwrap()).collect();
                }
                other => panic!("unknown option {other}"),
            }
        }
        options
    }
}

/// What the kernel counted of one process.
#[derive(Clone, Copy, Default)]
struct Usage {
    cpu_ns: u64,
    wake_up_count: u64,
}

impl Usage {
    fn of(process: u32) -> Self {
        let mut usage = Self::default();
        for task in fs::read_dir(format!("/proc/{process}/task"))
            .unwrap()
            .flatten()
        {
            let of = |file: &str| fs::read_to_string(task.path().join(file)).unwrap_or_default();
            let first = of("schedstat");
            let first = first
                .split(' ')
                .next()
                .and_then(|one| one.parse::<u64>().ok());
            usage.cpu_ns += first.unwrap_or(0);
            usage.wake_up_count += field(&of("status"), "voluntary_ctxt_switches:");
        }
        usage
    }

    fn since(self, before: Self) -> Self {
        Self {
            cpu_ns: self.cpu_ns - before.cpu_ns,
            wake_up_count: self.wake_up_count - before.wake_up_count,
        }
    }

    fn and(self, other: Self) -> Self {
        Self {
            cpu_ns: self.cpu_ns + other.cpu_ns,
            wake_up_count: self.wake_up_count + other.wake_up_count,
        }
    }
}

fn field(status: &str, key: &str) -> u64 {
    let mut lines = status.lines();
    let line = lines.find_map(|line| line.strip_prefix(key));
    let word = line.and_then(|rest| rest.split_whitespace().next());
    word.and_then(|word| word.parse().ok()).unwrap_or(0)
}

/// UDP ports that a process has bound to the address of its host.
fn ports(process: u32) -> BTreeSet<String> {
    let links = fs::read_dir(format!("/proc/{process}/fd"))
        .unwrap()
        .flatten();
    let sockets: BTreeSet<String> = links
        .filter_map(|link| fs::read_link(link.path()).ok())
        .filter_map(|link| {
            let name = link.to_string_lossy().into_owned();
            let inode = name.strip_prefix("socket:[")?.strip_suffix(']')?;
            Some(inode.to_owned())
        })
        .collect();
    let table = fs::read_to_string(format!("/proc/{process}/net/udp")).unwrap();
    let of_line = |line: &str| {
        let words: Vec<&str> = line.split_whitespace().collect();
        let (local, inode) = (words.get(1)?, words.get(9)?);
        let is_own = sockets.contains(*inode) && !local.starts_with("0100007F");
        is_own.then(|| (*local).to_owned())
    };
    table.lines().filter_map(of_line).collect()
}

/// Figures of one number of channels in one round.
struct Figures {
    idle: Usage,
    loaded: Usage,
    resident_bytes: u64,
    threads: u64,
    ports: usize,
    sent_count: u64,
    delays_ns: Vec<u64>,
}

/// A channel of a link.
#[derive(Clone)]
struct Lane {
    name: String,
    message: MessageType,
}

impl Lane {
    fn new(name: &str, message: MessageType) -> Self {
        Self {
            name: name.to_owned(),
            message,
        }
    }
}

fn names(count: usize) -> Vec<String> {
    (0..count)
        .map(|index| format!("bench/robot-{index}"))
        .collect()
}

fn direction(side: Side, lanes: &[Lane], addresses: [SocketAddr; 2]) -> DirectionLaunch {
    let channels = (0..)
        .zip(lanes)
        .map(|(id, lane)| worker::channel(id, &lane.name, &lane.message, DEPTH));
    let mut direction = worker::direction(side, addresses, channels.collect());
    let receive_buffer_bytes = 212_992.max(2 * lanes[0].message.size_bytes);
    direction.socket.common.receive_buffer_bytes = receive_buffer_bytes;
    direction
}

/// The service of every channel on both hosts, while it is kept.
fn hold(domains: &[Domain; 2], lanes: &[Lane]) -> Vec<ChannelHolder> {
    let mut holders = Vec::new();
    for domain in domains {
        for lane in lanes {
            let settings = ChannelSettings {
                depth_max: DEPTH,
                ..ChannelSettings::of(&lane.name, &lane.message)
            };
            holders.push(ChannelHolder::create(domain, &settings).unwrap());
        }
    }
    holders
}

/// The two gateway processes of a link that carries `lanes` from the first host to the second.
fn link(network: &Network, folder: &Path, lanes: &[Lane], domains: &[Domain; 2]) -> [Worker; 2] {
    let addresses = [0, 1].map(|host| network.free_address(host).unwrap());
    [(0, Side::Egress), (1, Side::Ingress)].map(|(host, side)| {
        let name = format!("gateway-bench-{host}");
        let direction = direction(side, lanes, addresses);
        let path = worker::gateway(folder, &name, &domains[host], direction);
        let mut command = Worker::command(&path);
        Worker::adopt(network.on(host, move || command.spawn()).unwrap())
    })
}

fn measure(network: &Network, folder: &Path, count: usize, options: &Options) -> Figures {
    let names = names(count);
    let domains = [0, 1].map(|host| Domain::create(&folder.join(format!("d{host}"))).unwrap());
    let lanes: Vec<Lane> = names.iter().map(|name| Lane::new(name, MESSAGE)).collect();
    let holders = hold(&domains, &lanes);
    let mut gateways = link(network, folder, &lanes, &domains);
    let mut outputs: Vec<ShmOutput> = names
        .iter()
        .map(|name| {
            ShmOutput::open(&domains[0], name, &MESSAGE, OutputSettings::default()).unwrap()
        })
        .collect();
    for gateway in &mut gateways {
        gateway.wait_until_ready(Duration::from_mins(1));
    }
    let processes = gateways.each_ref().map(Worker::id);
    let usage = || {
        let [one, other] = processes.map(Usage::of);
        one.and(other)
    };
    let span = Duration::from_secs(options.seconds);
    thread::sleep(SETTLING);
    let before = usage();
    thread::sleep(span);
    let idle = usage().since(before);

    let stop = Arc::new(AtomicBool::new(false));
    let is_open = Arc::new(AtomicBool::new(false));
    let receiving = {
        let (stop, names) = (Arc::clone(&stop), names.clone());
        let domain = Domain::open(domains[1].address()).unwrap();
        let is_open = Arc::clone(&is_open);
        thread::spawn(move || take(&domain, &names, &is_open, &stop))
    };
    while !is_open.load(Ordering::Acquire) {
        thread::sleep(Duration::from_millis(1));
    }
    let period = Duration::from_nanos(1_000_000_000 / options.rate_hz);
    let payload = [7; 64];
    let mut send_for = |span: Duration| {
        let started = MonotonicClock::now();
        let mut sent_count = 0;
        let mut due = started;
        while due < started + span {
            let left = due.saturating_duration_since(MonotonicClock::now());
            thread::sleep(left);
            let index = usize::try_from(sent_count).unwrap() % count;
            outputs[index]
                .publish(MonotonicClock::now(), &payload)
                .unwrap();
            sent_count += 1;
            due = due + period;
        }
        sent_count
    };
    let settled_count = send_for(SETTLING);
    let began = MonotonicClock::now();
    let before = usage();
    let sent_count = send_for(span);
    let loaded = usage().since(before);
    let status = |process: u32| fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let of_both = |key: &str| {
        processes
            .map(|one| field(&status(one), key))
            .iter()
            .sum::<u64>()
    };
    let (resident_bytes, threads) = (of_both("VmRSS:") * 1024, of_both("Threads:"));
    let ports = processes
        .map(ports)
        .iter()
        .map(BTreeSet::len)
        .max()
        .unwrap();
    thread::sleep(Duration::from_millis(200));
    stop.store(true, Ordering::Release);
    let arrivals = receiving.join().unwrap();
    let arrivals_count = arrivals.len() as u64;
    let sent_all = sent_count + settled_count;
    let delays_ns = arrivals
        .into_iter()
        .filter(|(published_ns, _)| *published_ns >= began.as_ns())
        .map(|(_, delay_ns)| delay_ns)
        .collect();
    for gateway in gateways {
        let (_, words) = gateway.end(Duration::from_mins(1));
        let mut warnings = words.lines().filter(|line| line.contains("warning"));
        if let Some(warning) = warnings.next() {
            println!("{warning}");
        }
        if arrivals_count < sent_all {
            // What became of those that did not come.
            println!("{}", counts_of(&words));
        }
    }
    drop((outputs, holders));
    for domain in domains {
        domain.remove();
    }
    fs::remove_dir_all(folder).unwrap();
    Figures {
        idle,
        loaded,
        resident_bytes,
        threads,
        ports,
        sent_count,
        delays_ns,
    }
}

/// Takes every message once `is_open` is set; when each was published, and how long it took to the other host.
fn take(
    domain: &Domain,
    names: &[String],
    is_open: &AtomicBool,
    stop: &AtomicBool,
) -> Vec<(i64, u64)> {
    let listed: Vec<&str> = names.iter().map(String::as_str).collect();
    let waiter = Waiter::open(domain, &listed).unwrap();
    let mut inputs: Vec<RawInput> = names
        .iter()
        .map(|name| RawInput::open(domain, name, DEPTH).unwrap())
        .collect();
    let mut arrivals = Vec::new();
    is_open.store(true, Ordering::Release);
    while !stop.load(Ordering::Acquire) {
        sleep_for(waiter.descriptor());
        for index in waiter.announced().unwrap() {
            waiter.drain(index).unwrap();
            while inputs[index]
                .receive(&mut |envelope, _| {
                    let delay_ns = envelope.forwarded_ns - envelope.published_ns;
                    arrivals.push((envelope.published_ns, delay_ns.unsigned_abs()));
                })
                .unwrap()
            {}
        }
    }
    arrivals
}

fn sleep_for(descriptor: BorrowedFd<'_>) {
    let mut entries = [PollFd::new(descriptor, PollFlags::POLLIN)];
    let patience = TimeSpec::milliseconds(50);
    ppoll(&mut entries, Some(patience), None).unwrap();
}

/// The counters of the sockets in a worker's last words, as far as they are not zero.
fn counts_of(words: &str) -> String {
    let last = words.lines().find(|line| line.contains("\"finished\""));
    let report: serde_json::Value = last
        .and_then(|line| serde_json::from_str(line).ok())
        .unwrap_or_default();
    let counters = &report["finished"]["directions"][0]["counters"];
    let counted = counters.as_array().into_iter().flatten();
    let counted = counted.filter(|one| one["count"] != 0);
    let words: Vec<String> = counted
        .map(|one| {
            format!(
                "{} {}",
                one["name"].as_str().unwrap_or_default(),
                one["count"]
            )
        })
        .collect();
    words.join(", ")
}

/// Which channels there are, and on which links.
struct Layout {
    label: &'static str,
    links: Vec<Vec<Lane>>,
}

/// Delays of a small channel at 1 kHz alone, beside a large one on its link, and with that on another link.
fn measure_beside_images(network: &Network, span: Duration) {
    let command = Lane::new("bench/command", MESSAGE);
    let image = Lane::new("bench/image", IMAGE);
    let layouts = [
        Layout {
            label: "alone",
            links: vec![vec![command.clone()]],
        },
        Layout {
            label: "one link",
            links: vec![vec![image.clone(), command.clone()]],
        },
        Layout {
            label: "two links",
            links: vec![vec![image], vec![command]],
        },
    ];
    for Layout { label, links } in layouts {
        let name = format!("hil-cpl-{}-beside", std::process::id());
        let folder = std::env::temp_dir().join(name);
        let domains = [0, 1].map(|host| Domain::create(&folder.join(format!("d{host}"))).unwrap());
        let lanes = links.concat();
        let holders = hold(&domains, &lanes);
        let mut gateways = Vec::new();
        for (index, lanes) in links.iter().enumerate() {
            let folder = folder.join(format!("link-{index}"));
            gateways.extend(link(network, &folder, lanes, &domains));
        }
        let [is_begun, stop] = [(); 2].map(|()| Arc::new(AtomicBool::new(false)));
        let mut publishers = Vec::new();
        let mut takers = Vec::new();
        for lane in &lanes {
            let domain = Domain::open(domains[0].address()).unwrap();
            let (begun, stopped) = (Arc::clone(&is_begun), Arc::clone(&stop));
            let lane = lane.clone();
            let names = [lane.name.clone()];
            let size_bytes = lane.message.size_bytes;
            let period = if size_bytes == IMAGE.size_bytes {
                IMAGE_PERIOD
            } else {
                COMMAND_PERIOD
            };
            publishers.push(thread::spawn(move || {
                let settings = OutputSettings::default();
                let mut output =
                    ShmOutput::open(&domain, &lane.name, &lane.message, settings).unwrap();
                let payload = vec![7; size_bytes];
                while !begun.load(Ordering::Acquire) {
                    thread::sleep(COMMAND_PERIOD);
                }
                let mut due = MonotonicClock::now();
                let mut sent_count = 0;
                while !stopped.load(Ordering::Acquire) {
                    thread::sleep(due.saturating_duration_since(MonotonicClock::now()));
                    output.publish(MonotonicClock::now(), &payload).unwrap();
                    sent_count += 1;
                    due = due + period;
                }
                sent_count
            }));
            let domain = Domain::open(domains[1].address()).unwrap();
            let stopped = Arc::clone(&stop);
            let is_open = AtomicBool::new(false);
            takers.push(thread::spawn(move || {
                take(&domain, &names, &is_open, &stopped)
            }));
        }
        for gateway in &mut gateways {
            gateway.wait_until_ready(Duration::from_mins(1));
        }
        is_begun.store(true, Ordering::Release);
        thread::sleep(SETTLING + span);
        stop.store(true, Ordering::Release);
        let sent = publishers.into_iter().map(|one| one.join().unwrap());
        let sent: Vec<u64> = sent.collect();
        let came = takers.into_iter().map(|one| one.join().unwrap());
        for ((lane, sent_count), came) in lanes.iter().zip(sent).zip(came) {
            let mut delays: Vec<u64> = came.iter().map(|(_, delay_ns)| *delay_ns).collect();
            let delay = Quantiles::of(&mut delays).expect("messages arrive");
            println!(
                "{label:>9} {:>13}: {} of {sent_count} came; delay p50 {:.0}, p99 {:.0}, p99.9 {:.0} us",
                lane.name,
                came.len(),
                delay.p50_ns as f64 * 1e-3,
                delay.p99_ns as f64 * 1e-3,
                delay.p99_9_ns as f64 * 1e-3,
            );
        }
        for gateway in gateways {
            gateway.end(Duration::from_mins(1));
        }
        drop(holders);
        for domain in domains {
            domain.remove();
        }
        fs::remove_dir_all(folder).unwrap();
    }
}

/// The middle one of three, or of whatever number there is.
fn median(mut figures: Vec<f64>) -> f64 {
    figures.sort_unstable_by(f64::total_cmp);
    figures[figures.len() / 2]
}

fn main() {
    let options = Options::of_arguments();
    let network = Network::open();
    println!("{}", HostFacts::read("none").to_json());
    println!(
        "{}; {} messages per second in all, 64 bytes",
        network.note(),
        options.rate_hz
    );
    if options.with_images {
        measure_beside_images(&network, Duration::from_secs(options.seconds));
    }
    let folder = |name: String| -> PathBuf { std::env::temp_dir().join(name) };
    let mut of_count: BTreeMap<usize, Vec<Figures>> = BTreeMap::new();
    for round in 0..options.rounds {
        let mut order = options.channels.clone();
        if round % 2 == 1 {
            order.reverse();
        }
        for count in order {
            let name = format!("hil-cpl-{}-{round}-{count}", std::process::id());
            let figures = measure(&network, &folder(name), count, &options);
            of_count.entry(count).or_default().push(figures);
        }
    }
    let seconds = options.seconds as f64;
    let mut rows = Vec::new();
    let mut first: Option<[f64; 4]> = None;
    for (count, rounds) in of_count {
        let of = |pick: &dyn Fn(&Figures) -> f64| median(rounds.iter().map(pick).collect());
        let idle_cpu = of(&|one| one.idle.cpu_ns as f64 * 1e-9 / seconds);
        let idle_wake_ups = of(&|one| one.idle.wake_up_count as f64 / seconds);
        let cpu_us = of(&|one| one.loaded.cpu_ns as f64 * 1e-3 / one.sent_count as f64);
        let resident_mb = of(&|one| one.resident_bytes as f64 * 1e-6);
        let threads = of(&|one| one.threads as f64);
        let ports = of(&|one| one.ports as f64);
        let sent: u64 = rounds.iter().map(|one| one.sent_count).sum();
        let mut delays: Vec<u64> = rounds
            .iter()
            .flat_map(|one| one.delays_ns.clone())
            .collect();
        let come = delays.len() as u64;
        let delay = Quantiles::of(&mut delays).expect("messages arrive");
        let own = [idle_cpu, idle_wake_ups, cpu_us, delay.p99_ns as f64];
        let base = *first.get_or_insert(own);
        let ratio = |index: usize| format!("{:.2}", own[index] / base[index]);
        rows.push(vec![
            count.to_string(),
            format!("{:.2} %", idle_cpu * 100.0),
            ratio(0),
            format!("{idle_wake_ups:.0}"),
            ratio(1),
            format!("{cpu_us:.1}"),
            ratio(2),
            format!("{:.0}", delay.p50_ns as f64 * 1e-3),
            format!("{:.0}", delay.p99_ns as f64 * 1e-3),
            ratio(3),
            format!("{:.0}", delay.p99_9_ns as f64 * 1e-3),
            format!("{resident_mb:.1}"),
            format!("{threads:.0}"),
            format!("{ports:.0}"),
            (sent - come.min(sent)).to_string(),
        ]);
        println!(
            "{}",
            json!({
                "bench": "channels_per_link",
                "channels": count,
                "idle_cpu_ratio": idle_cpu,
                "idle_wake_ups_hz": idle_wake_ups,
                "cpu_us_per_message": cpu_us,
                "delay": delay.to_json(),
                "resident_bytes": resident_mb * 1e6,
                "threads": threads,
                "ports": ports,
            })
        );
    }
    let columns = [
        "channels",
        "idle CPU",
        "x",
        "wake-ups/s",
        "x",
        "CPU us/msg",
        "x",
        "p50 us",
        "p99 us",
        "x",
        "p99.9 us",
        "RSS MB",
        "threads",
        "ports",
        "lost",
    ];
    for row in core::iter::once(columns.map(str::to_owned).to_vec()).chain(rows) {
        let cells: Vec<String> = row.iter().map(|cell| format!("{cell:>10}")).collect();
        println!("{}", cells.join(" "));
    }
}
