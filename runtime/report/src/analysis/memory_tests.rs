//! What drawing up the account of a run costs in memory, and that it does not grow with the run as its
//! records do: runs of two lengths are concluded, each in a process of its own, and their peaks compared.

use std::collections::BTreeMap;
use std::env;
use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::Path;
use std::process::Command;

use bytemuck::Pod;
use hil_account::MessageFate;
use hil_core::message::Envelope;
use hil_core::random::RandomStream;
use hil_core::record::{
    EgressRecord, FollowUp, IngressRecord, PublishedRecord, RoundTripRecord, TakenRecord,
    UNAVAILABLE,
};
use hil_core::time::Instant;
use hil_link::condition::flow_name;
use hil_link::spec::Way;
use hil_shuttle::{Shuttle, ShuttleCommand, ShuttleStatus};

use super::{analyse, conclude};
use hil_platform::host_facts::HostFacts;
use hil_rundir::manifest::{self, ManifestContent};
use hil_rundir::record::RecordKind;
use hil_rundir::record::file::RecordHeader;
use hil_rundir::run_folder::RunFolder;
use hil_rundir::run_result::{Outcome, RunResult};
use hil_topology::registry::Registry;
use hil_topology::{self, Topology};

/// Says to a process of this test which run to conclude.
const FOLDER_VARIABLE: &str = "HIL_TEST_CONCLUDE_FOLDER";
const THIS_TEST: &str = "memory_does_not_grow_with_the_run_as_its_records_do";

/// Before the figure in what such a process says.
const PEAK: &str = "peak bytes: ";

/// Bytes that a message of either of the two channels may add. Its records have 320, of both channels 640.
const GROWTH_MAX: f64 = 100.0;

const PERIOD_NS: i64 = 1_000_000;
const START_NS: i64 = 50_000_000_000;
/// The robot's clock is ahead by this, and gains 20 ppm.
const AHEAD_NS: i64 = 100_000_000_000;
const REALTIME_NS: i64 = 1_790_000_000_000_000_000;

const TOPOLOGY: &str = r#"
version = 1
name = "long"
[run]
duration = "20 s"
[case]
name = "shuttle"
[case.parameters]
rate_hz = 1000.0
[hosts.control-pc]
address = "10.77.0.1"
[hosts.robot-pc]
address = "10.77.0.2"
[security]
hops = "plain"
[processes.controller]
role = "controller"
host = "control-pc"
[processes.robot]
role = "robot"
host = "robot-pc"
[channels]
"shuttle/command".link = "hop"
"shuttle/status".link = "hop"
[links.hop]
via = "udp"
between = ["control-pc", "robot-pc"]
"#;

fn registry() -> Registry {
    let mut registry = Registry::default();
    registry.add::<Shuttle>();
    registry
}

fn topology(registry: &Registry) -> Topology {
    hil_topology::parse("long.toml", TOPOLOGY, &[], registry.known())
        .unwrap_or_else(|errors| panic!("{errors}"))
}

/// An instant of the controller's clock on the clock of one side.
fn on(is_robot: bool, ns: i64) -> i64 {
    if is_robot {
        ns + AHEAD_NS + ns / 50_000
    } else {
        ns
    }
}

/// One record file under way.
struct Sink(BufWriter<File>);

impl Sink {
    fn new(folder: &Path, kind: RecordKind, channel: &str, bytes: usize) -> Self {
        let header = RecordHeader {
            kind,
            channel: channel.to_owned(),
            record_bytes: u32::try_from(bytes).unwrap(),
            instance: 0,
        };
        let (_, file) = header.create(folder, "process").unwrap();
        Self(BufWriter::new(file))
    }

    fn put<R: Pod>(&mut self, record: &R) {
        self.0.write_all(bytemuck::bytes_of(record)).unwrap();
    }
}

/// The record files of one channel that is sent by the robot or by the controller.
struct Written<'a> {
    is_robot: bool,
    channel: &'a str,
    random: RandomStream,
    published: Sink,
    egress: Sink,
    ingress: Sink,
    taken: Sink,
    round_trip: Sink,
    message: Sink,
    /// Arrivals that others overtook, with when they are due.
    late: Vec<(i64, IngressRecord)>,
}

impl<'a> Written<'a> {
    fn new(folder: &Path, channel: &'a str, is_robot: bool, payload: usize) -> Self {
        let sink = |kind, bytes| Sink::new(folder, kind, channel, bytes);
        let way = if is_robot {
            Way::Backward
        } else {
            Way::Forward
        };
        Self {
            is_robot,
            channel,
            random: RandomStream::new(1, channel),
            published: sink(RecordKind::Published, size_of::<PublishedRecord>()),
            egress: sink(RecordKind::Egress, size_of::<EgressRecord>()),
            ingress: sink(RecordKind::Ingress, size_of::<IngressRecord>()),
            taken: sink(RecordKind::Taken, size_of::<TakenRecord>()),
            round_trip: Sink::new(
                folder,
                RecordKind::RoundTrip,
                &flow_name("hop", way),
                size_of::<RoundTripRecord>(),
            ),
            message: sink(RecordKind::Message, size_of::<Envelope>() + payload),
            late: Vec::new(),
        }
    }

    fn message(&mut self, index: i64) {
        let at = START_NS + index * PERIOD_NS;
        let here = on(self.is_robot, at);
        let sequence = index.unsigned_abs();
        self.published.put(&PublishedRecord {
            sequence,
            published_ns: here,
            epoch: 7,
            reserved: 0,
        });
        let envelope = Envelope {
            sequence,
            published_ns: here,
            epoch: 7,
            ..Envelope::default()
        };
        self.message.put(&envelope);
        let place = (index as f64 * 1e-3).sin();
        if self.channel == "shuttle/command" {
            let command = ShuttleCommand {
                speed_mps: place,
                target_m: 1.0,
            };
            self.message.put(&command);
        } else {
            self.message.put(&ShuttleStatus { position_m: place });
        }
        if index % 100 == 0 {
            self.exchange(at);
        }
        // A newer one pushes a few out before the gateway takes them.
        if self.random.uniform() < 0.001 {
            return;
        }
        let handed = at + 9_000 + self.jitter(3_000.0);
        self.egress.put(&EgressRecord {
            sequence,
            published_ns: here,
            taken_ns: on(self.is_robot, handed - 3_000),
            handed_ns: on(self.is_robot, handed),
            tx_software_ns: on(self.is_robot, handed + 4_000) + REALTIME_NS,
            tx_hardware_ns: UNAVAILABLE,
            realtime_offset_ns: REALTIME_NS,
            epoch: 7,
            session: 41,
            flags: 0,
            fragment_count: 1,
        });
        // Losses in bursts, the longest of which are outages.
        let is_lost = index / 37 % 211 == 5 || index % 60_000 > 59_700;
        if !is_lost {
            self.arrival(at, here, handed, sequence);
        }
    }

    #[allow(clippy::cast_possible_truncation, reason = "well below a second")]
    fn jitter(&mut self, mean_ns: f64) -> i64 {
        (-(1.0 - self.random.uniform()).ln() * mean_ns) as i64
    }

    fn arrival(&mut self, at: i64, published_ns: i64, handed: i64, sequence: u64) {
        let is_displaced = self.random.uniform() < 0.005;
        let more = if is_displaced { 3_500_000 } else { 0 };
        let received = handed + 180_000 + more + self.jitter(60_000.0);
        let there = |ns| on(!self.is_robot, ns);
        let record = IngressRecord {
            sequence,
            published_ns,
            handed_ns: on(self.is_robot, handed),
            rx_hardware_ns: UNAVAILABLE,
            rx_software_ns: there(received - 6_000) + REALTIME_NS,
            received_ns: there(received),
            forwarded_ns: there(received + 2_000),
            realtime_offset_ns: REALTIME_NS,
            emulated_ns: UNAVAILABLE,
            due_ns: UNAVAILABLE,
            follow_up_sequence: 0,
            follow_up_ns: UNAVAILABLE,
            epoch: 7,
            session: 41,
            flags: if is_displaced {
                IngressRecord::REORDERED
            } else {
                0
            },
            fragment_count: 1,
        };
        self.late.push((received, record));
        if self.random.uniform() < 0.001 {
            let copy = IngressRecord {
                flags: IngressRecord::DUPLICATE,
                forwarded_ns: UNAVAILABLE,
                received_ns: there(received + 1_400_000),
                ..record
            };
            self.late.push((received + 1_400_000, copy));
        }
        self.arrive_until(at);
    }

    /// What has arrived by `ns`, in the order it did.
    fn arrive_until(&mut self, ns: i64) {
        self.late.sort_by_key(|one| one.0);
        let count = self.late.partition_point(|one| one.0 <= ns);
        for (_, record) in self.late.drain(..count).collect::<Vec<_>>() {
            let before = record.sequence.checked_sub(1);
            self.ingress
                .put(&record.with_follow_up(before.map(|sequence| FollowUp {
                    sequence,
                    handed_to_tx_ns: 4_000,
                })));
            // The consumer wakes for all but a few of them.
            if record.flags & IngressRecord::DUPLICATE == 0 && self.random.uniform() > 0.002 {
                let taken_ns = record.forwarded_ns + 20_000 + self.jitter(8_000.0);
                self.taken.put(&TakenRecord {
                    sequence: record.sequence,
                    published_ns: record.published_ns,
                    forwarded_ns: record.forwarded_ns,
                    taken_ns,
                    epoch: 7,
                    reserved: 0,
                });
            }
        }
    }

    fn exchange(&mut self, at: i64) {
        let (go, back) = (
            200_000 + self.jitter(50_000.0),
            210_000 + self.jitter(50_000.0),
        );
        self.round_trip.put(&RoundTripRecord {
            sequence: at.unsigned_abs(),
            t1_ns: on(self.is_robot, at),
            t2_ns: on(!self.is_robot, at + go),
            t3_ns: on(!self.is_robot, at + go + 5_000),
            t4_ns: on(self.is_robot, at + go + 5_000 + back),
            session: 41,
            sources: [0; 4],
        });
    }
}

/// Writes the records of a run of `count` messages a channel.
fn write_run(root: &Path, count: i64) {
    let folder = root.join("records");
    fs::create_dir_all(&folder).unwrap();
    let channels = [
        ("shuttle/command", false, size_of::<ShuttleCommand>()),
        ("shuttle/status", true, size_of::<ShuttleStatus>()),
    ];
    for (channel, is_robot, payload) in channels {
        let mut written = Written::new(&folder, channel, is_robot, payload);
        for index in 0..count {
            written.message(index);
        }
        written.arrive_until(i64::MAX);
    }
}

fn result(root: &Path, count: i64) -> RunResult {
    let span = |is_robot| {
        let at = |ns| Instant::from_ns(on(is_robot, ns));
        (at(START_NS - 5_000_000), at(START_NS + count * PERIOD_NS))
    };
    RunResult {
        folder: RunFolder::existing(root),
        outcome: Outcome::Completed,
        spans: BTreeMap::from([
            ("control-pc".to_owned(), span(false)),
            ("robot-pc".to_owned(), span(true)),
        ]),
        started: "2026-01-01 00:00:00 UTC".to_owned(),
        events: Vec::new(),
        processes: Vec::new(),
        cards: Vec::new(),
        has_one_clock: false,
        security: None,
        disciplines: BTreeMap::new(),
        own_hosts: vec!["control-pc".to_owned()],
        gaps: Vec::new(),
        problems: Vec::new(),
        facts: HostFacts::default(),
        trace_delays: BTreeMap::new(),
    }
}

/// Largest memory of this process so far, bytes.
fn peak_bytes() -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with("VmHWM:"));
    let kib = line.unwrap().split_whitespace().nth(1).unwrap();
    kib.parse::<u64>().unwrap() * 1024
}

/// Draws up the account of the run in `root` and says what that took at the most.
fn conclude_here(root: &Path) {
    let count: i64 = fs::read_to_string(root.join("count"))
        .unwrap()
        .parse()
        .unwrap();
    let registry = registry();
    let concluded = conclude(
        &topology(&registry),
        &result(root, count),
        &registry,
        Path::new("long.toml"),
        &[],
    );
    let concluded = concluded.unwrap();
    assert!(concluded.unwritten.is_none(), "{:?}", concluded.unwritten);
    assert_eq!(concluded.summary.warnings, Vec::<String>::new());
    let accounts = concluded.summary.channels.iter();
    let accounts: Vec<_> = accounts.filter_map(|one| one.account.as_ref()).collect();
    let published: Vec<u64> = accounts.iter().map(|one| one.published_count).collect();
    assert_eq!(published, [count.unsigned_abs(); 2]);
    for account in accounts {
        assert!(account.closing.checked().unwrap().closed_count > count.unsigned_abs() * 9 / 10);
        assert_eq!(account.fates.of(MessageFate::Unexplained), 0);
    }
    println!("{PEAK}{}", peak_bytes());
}

/// The most memory that a process takes to conclude a run of `count` messages a channel.
fn peak_of(folder: &Path, count: i64) -> u64 {
    let root = folder.join(format!("run-{count}"));
    write_run(&root, count);
    fs::write(root.join("count"), count.to_string()).unwrap();
    let (_, module) = module_path!().split_once("::").unwrap();
    let done = Command::new(env::current_exe().unwrap())
        .args(["--exact", &format!("{module}::{THIS_TEST}"), "--nocapture"])
        .env(FOLDER_VARIABLE, &root)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&done.stdout).into_owned();
    let complaint = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(done.status.success(), "{said}{complaint}");
    let peak = said.lines().find_map(|line| line.split_once(PEAK));
    peak.unwrap().1.trim().parse().unwrap()
}

#[test]
fn the_folder_alone_gives_the_same_summary() {
    let root = env::temp_dir().join(format!("hil-analyse-{}", std::process::id()));
    let count = 2_000;
    write_run(&root, count);
    let registry = registry();
    let topology = topology(&registry);
    let result = result(&root, count);
    let command_line = ["hil-runtime".to_owned(), "-t".to_owned()];
    let file = Path::new("long.toml");
    let content = ManifestContent {
        topology: &topology,
        topology_file: file,
        hosts: &result.own_hosts,
        command_line: &command_line,
        layouts: &BTreeMap::new(),
        facts: &result.facts,
        realtime_minus_monotonic_ns: None,
    };
    manifest::write(&content, &result.folder).unwrap();
    result.write().unwrap();
    assert_eq!(RunResult::read(&result.folder).unwrap(), result);
    let from_memory = conclude(&topology, &result, &registry, file, &command_line).unwrap();
    fs::remove_file(result.folder.summary()).unwrap();
    let from_folder = analyse(&result.folder, &registry).unwrap();
    assert_eq!(from_folder.summary, from_memory.summary);
    assert!(result.folder.summary().is_file() && from_folder.unwritten.is_none());
    fs::remove_dir_all(root).unwrap();
}

#[test]
fn memory_does_not_grow_with_the_run_as_its_records_do() {
    if let Some(folder) = env::var_os(FOLDER_VARIABLE) {
        conclude_here(Path::new(&folder));
        return;
    }
    let folder = env::temp_dir().join(format!("hil-conclude-{}", std::process::id()));
    let (short, long) = (60_000, 180_000);
    let peaks = [short, long].map(|count| peak_of(&folder, count));
    let growth = peaks[1].saturating_sub(peaks[0]) as f64 / (long - short) as f64;
    println!("peaks of {peaks:?} bytes, {growth:.1} more for each message of a channel");
    fs::remove_dir_all(&folder).unwrap();
    assert!(growth < GROWTH_MAX, "{growth} bytes a message of a channel");
}
