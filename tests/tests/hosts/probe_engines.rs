//! The two engines of a live tap beside each other: what one sees the other sees, they leave nothing
//! behind, and what a host does not grant or a ring has no room for is told.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use hil_gateways::capture::Direction;
use hil_gateways::capture::reader::{CaptureReader, Step};
use hil_gateways::transport::bpf_tap::attached_programs;
use hil_gateways::transport::live_tap::{LiveTap, TapEngine};
use hil_gateways::transport::packet_ring::{RingSettings, RingStamps};
use hil_tests::binary::hil_runtime_binary;
use hil_tests::child::{ChildGuard, Finished};
use hil_tests::lab::{INTERFACE, Lab, LabHost};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{Trial, wait_until};
use nix::sys::signal::Signal;
use serde_json::Value;

const ENGINES: [&str; 2] = ["bpf", "packet"];
const HOSTS: [&str; 2] = ["control-pc", "robot-pc"];
const START_LIMIT: Duration = Duration::from_mins(1);
const RUN_LIMIT: Duration = Duration::from_mins(2);
/// Farthest that the medians of two engines may lie apart, microseconds: what only a wrong clock or a
/// wrong match reaches, on a machine with other work as well.
const MEDIAN_LIMIT_US: f64 = 100.0;

fn start(host: &LabHost, interface: &str, output: &Path, more: &[&str]) -> ChildGuard {
    let mut command = host.command(hil_runtime_binary());
    command.args(["probe", "--interface", interface, "--output"]);
    command.arg(output).args(more);
    let mut probe = ChildGuard::spawn(&mut command).unwrap();
    probe.wait_for_output("probing ", START_LIMIT).unwrap();
    probe
}

fn end(probe: &mut ChildGuard) -> Finished {
    probe.signal(Signal::SIGINT).unwrap();
    let finished = probe.wait_within(START_LIMIT).unwrap();
    print!("{}", finished.stdout);
    finished
}

fn folder(name: &str) -> RunFolder {
    let folder = RunFolder::new(name);
    std::fs::create_dir_all(folder.path()).unwrap();
    folder
}

fn ip(host: &LabHost, arguments: &str) -> Finished {
    let mut command = host.command("ip");
    command.args(arguments.split(' '));
    let mut child = ChildGuard::spawn(&mut command).unwrap();
    child.wait_within(START_LIMIT).unwrap()
}

/// The packets of a capture by way, length and bytes, each with its stamps in order.
type Packets = BTreeMap<(bool, u32, Vec<u8>), Vec<i64>>;

fn packets(path: &Path) -> Packets {
    let mut reader = CaptureReader::default();
    reader.feed(&std::fs::read(path).unwrap());
    reader.end();
    let mut found = Packets::new();
    loop {
        match reader.next_step() {
            Step::Packet(packet) => {
                let is_out = packet.direction == Direction::Outbound;
                let key = (is_out, packet.original_bytes, packet.data.to_vec());
                let stamps = found.entry(key).or_default();
                stamps.push(packet.stamp_ns.unwrap());
            }
            Step::Ended => return found,
            other => panic!("{}: {other:?}", path.display()),
        }
    }
}

/// Checks that two captures hold the same packets; gives how far the second's stamps lie behind the
/// first's, in the median, of what arrived and of what left, microseconds.
fn medians_apart_us(first: &Packets, second: &Packets) -> [f64; 2] {
    assert!(
        first.keys().eq(second.keys()),
        "{} against {} packets",
        first.len(),
        second.len()
    );
    [false, true].map(|is_out| {
        let mut apart: Vec<i64> = Vec::new();
        for (key, stamps) in first.iter().filter(|(key, _)| key.0 == is_out) {
            let others = &second[key];
            assert_eq!(stamps.len(), others.len());
            apart.extend(stamps.iter().zip(others).map(|(a, b)| b - a));
        }
        apart.sort_unstable();
        apart[apart.len() / 2] as f64 * 1e-3
    })
}

#[test]
fn both_engines_see_the_same_run_at_the_same_time() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = folder("probe-engines");
    let captures = HOSTS
        .map(|host| ENGINES.map(|engine| record.path().join(format!("{host}-{engine}.pcapng"))));
    let mut probes: Vec<ChildGuard> = Vec::new();
    for (index, of_host) in captures.iter().enumerate() {
        for (engine, output) in ENGINES.iter().zip(of_host) {
            let more = ["--tap", engine];
            probes.push(start(lab.host(index), INTERFACE, output, &more));
        }
    }
    let trial = Trial::shipped("shuttle-split.toml", record.path())
        // What is on the wire is looked at byte by byte.
        .plain()
        .set("run.duration=\"5 s\"")
        .set("case.parameters.rate_hz=500.0");
    let mut hosts = [0, 1].map(|index| trial.start_on(lab.host(index)));
    let files = HOSTS.map(|host| trial.folder(&format!("-{host}"), START_LIMIT));
    for host in &mut hosts {
        host.wait_within(RUN_LIMIT).unwrap().assert_success();
    }
    for (probe, engine) in probes.iter_mut().zip(["eBPF", "packet ring"].repeat(2)) {
        let finished = end(probe);
        finished.assert_success();
        assert!(finished.stdout.contains(", 0 dropped"), "{finished:?}");
        assert!(finished.stdout.contains(engine), "{finished:?}");
        let late = finished.stdout.contains("stamped by the tap instead");
        assert!(!late, "the stack stamps what arrives: {finished:?}");
    }
    for of_host in &captures {
        let [bpf, packet] = [packets(&of_host[0]), packets(&of_host[1])];
        assert!(bpf.len() > 1000, "{} packets", bpf.len());
        let [arrived_us, left_us] = medians_apart_us(&bpf, &packet);
        println!(
            "the ring's stamps behind: {arrived_us} us of arrivals, {left_us} us of departures"
        );
        // Both have the stack's stamp of an arrival.
        assert!(arrived_us.abs() < 1e-6, "{arrived_us} us");
        assert!(left_us.abs() <= MEDIAN_LIMIT_US, "{left_us} us");
    }
    for engine in 0..ENGINES.len() {
        let mut command = Command::new(hil_runtime_binary());
        command.args(["probe", "compare", "--json", "--limit", "100"]);
        command.arg(files[0].root());
        command.args([&captures[0][engine], &captures[1][engine]]);
        let mut child = ChildGuard::spawn(&mut command).unwrap();
        let finished = child.wait_within(RUN_LIMIT).unwrap();
        finished.assert_success();
        let comparison: Value = serde_json::from_str(&finished.stdout).unwrap();
        for channel in comparison["channels"].as_array().unwrap() {
            for counts in ["sent", "received", "data_sent", "data_received"] {
                let counts = &channel[counts];
                assert_eq!(counts["gateway"], counts["probe"], "{channel:#}");
            }
            println!(
                "{}: {}: medians {} ns by the gateways, {} ns by the probe",
                ENGINES[engine],
                channel["channel"],
                channel["gateway_wire"]["p50_ns"],
                channel["probe_wire"]["p50_ns"]
            );
        }
    }
}

#[test]
fn tags_and_datagrams_in_pieces_are_the_same_to_both() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = folder("probe-pieces");
    let host = lab.host(0);
    ip(host, "link set lo up").assert_success();
    let tagged = [0, 1].map(|index| {
        let added = ip(
            lab.host(index),
            "link add link eth0 name eth0.5 type vlan id 5",
        );
        let address = format!("address add 10.78.0.{}/24 dev eth0.5", index + 1);
        added.status.success()
            && ip(lab.host(index), &address).status.success()
            && ip(lab.host(index), "link set eth0.5 up").status.success()
    });
    let is_tagged = tagged == [true; 2];
    println!("VLANs tried: {is_tagged}");
    let mut probes = Vec::new();
    let mut outputs: Vec<[PathBuf; 2]> = Vec::new();
    for interface in ["lo", INTERFACE] {
        let both = ENGINES.map(|engine| record.path().join(format!("{interface}-{engine}.pcapng")));
        for (engine, output) in ENGINES.iter().zip(&both) {
            probes.push(start(host, interface, output, &["--tap", engine]));
        }
        outputs.push(both);
    }
    host.on_network(|| {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).unwrap();
        let receiver = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        for number in 0..50_u8 {
            // Larger than the kernel puts into one piece: what the filter looks at is in another.
            let mut payload = b"HILG".to_vec();
            payload.resize(20_000, number);
            let to = receiver.local_addr().unwrap();
            socket.send_to(&payload, to).unwrap();
            if is_tagged {
                payload.truncate(100);
                let peer = (Ipv4Addr::new(10, 78, 0, 2), 7000);
                socket.send_to(&payload, peer).unwrap();
            }
        }
    });
    for probe in &mut probes {
        end(probe).assert_success();
    }
    let [bpf, packet] = [packets(&outputs[0][0]), packets(&outputs[0][1])];
    assert_eq!(bpf.len(), 100, "fifty both ways");
    assert!(bpf.keys().all(|(_, length, _)| *length == 20_042));
    medians_apart_us(&bpf, &packet);
    let [bpf, packet] = [packets(&outputs[1][0]), packets(&outputs[1][1])];
    assert!(bpf.keys().eq(packet.keys()));
    if is_tagged {
        let tag = [0x81, 0, 0, 5];
        assert_eq!(bpf.keys().filter(|key| key.2[12..16] == tag).count(), 50);
    }
}

#[test]
fn a_probe_that_is_killed_leaves_no_program() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = folder("probe-killed");
    let host = lab.host(0);
    let attached = || host.on_network(|| attached_programs(INTERFACE)).unwrap();
    assert_eq!(attached(), [0, 0]);
    let output = record.path().join("killed.pcapng");
    let mut probe = start(host, INTERFACE, &output, &["--tap", "bpf"]);
    assert_eq!(attached(), [1, 1]);
    assert!(
        ip(host, "-d link show eth0")
            .stdout
            .contains("promiscuity 1")
    );
    probe.signal(Signal::SIGKILL).unwrap();
    let finished = probe.wait_within(START_LIMIT).unwrap();
    assert!(!finished.status.success());
    wait_until(START_LIMIT, "no program", || attached() == [0, 0]);
    wait_until(START_LIMIT, "the card as it was", || {
        ip(host, "-d link show eth0")
            .stdout
            .contains("promiscuity 0")
    });
}

#[test]
fn what_found_no_room_is_in_the_report_and_in_the_file() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = folder("probe-room");
    let host = lab.host(0);
    let output = record.path().join("full.pcapng");
    let more = [
        "--tap",
        "bpf",
        "--flow",
        "udp:dport=7000",
        "--ring",
        "1",
        "--snap-length",
        "2048",
    ];
    let mut probe = start(host, INTERFACE, &output, &more);
    probe.signal(Signal::SIGSTOP).unwrap();
    let sent_count = 2000_u64;
    host.on_network(|| {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).unwrap();
        for _ in 0..sent_count {
            // Nobody listens there, and an answer that says so is no fault.
            let _refused = socket
                .send_to(b"flood", (lab.host(1).address(), 7000))
                .is_ok();
        }
    });
    probe.signal(Signal::SIGCONT).unwrap();
    let finished = end(&mut probe);
    assert_eq!(finished.status.code(), Some(1), "{finished:?}");
    assert!(finished.stderr.contains("were dropped"), "{finished:?}");
    let mut command = Command::new(hil_runtime_binary());
    command.args(["probe", "analyse", "--flow", "udp:dport=7000", "--json"]);
    let mut child = ChildGuard::spawn(command.arg(&output)).unwrap();
    let report = child.wait_within(RUN_LIMIT).unwrap().stdout;
    let report: Value = serde_json::from_str(&report).unwrap();
    let file = &report["files"][0];
    let [kept, dropped] = ["packet_count", "dropped_count"].map(|key| file[key].as_u64().unwrap());
    println!("{kept} kept, {dropped} dropped");
    assert!(dropped > 1000 && kept > 100, "{file:#}");
    assert_eq!(kept + dropped, sent_count);
}

#[test]
fn what_came_before_the_taps_begin_is_neither_kept_nor_counted() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let settings = RingSettings {
        snap_bytes: 2048,
        ring_bytes: 1 << 20,
        stamps: RingStamps::Kernel,
    };
    let flows = ["udp:dport=7000".parse().unwrap()];
    lab.host(0).on_network(|| {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).unwrap();
        let send = |count: u64| {
            for _ in 0..count {
                // Nobody listens there, and an answer that says so is no fault.
                let _refused = socket.send_to(b"", (lab.host(1).address(), 7000)).is_ok();
            }
        };
        for engine in [TapEngine::Bpf, TapEngine::Packet] {
            let mut tap = LiveTap::open(engine, INTERFACE, &flows, &settings).unwrap();
            let said = |tap: &mut LiveTap| {
                let counters = tap.counters().unwrap();
                (counters.matched_count, counters.dropped_count)
            };
            // More than there is room for, then less.
            for count in [2000, 30] {
                let (matched, dropped) = said(&mut tap);
                send(count);
                let (matched_now, dropped_now) = said(&mut tap);
                assert_eq!(matched_now - matched, count, "{engine}");
                assert_eq!(dropped_now > dropped, count == 2000, "{engine}");
                tap.begin().unwrap();
                assert_eq!(said(&mut tap), (0, 0), "{engine}");
            }
            send(40);
            let kept = (0..100).take_while(|_| tap.next_packet(|_| ())).count();
            assert_eq!((kept, said(&mut tap)), (40, (40, 0)), "{engine}");
        }
    });
}

#[test]
fn without_the_right_to_bpf_the_packet_ring_is_taken_and_says_why() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = folder("probe-rights");
    let run = |tap: &str| {
        let output = record.path().join(format!("{tap}.pcapng"));
        let mut command = lab.host(0).command("setpriv");
        command
            .args(["--bounding-set=-bpf,-sys_admin,-perfmon", "--"])
            .arg(hil_runtime_binary())
            .args([
                "probe",
                "-i",
                INTERFACE,
                "--duration",
                "100ms",
                "--tap",
                tap,
            ])
            .args([Path::new("-o"), &output]);
        let mut child = ChildGuard::spawn(&mut command).unwrap();
        (child.wait_within(START_LIMIT).unwrap(), output)
    };
    let (finished, output) = run("auto");
    finished.assert_success();
    let words = "tapped by a packet ring: no eBPF tap on `eth0`";
    assert!(finished.stdout.contains(words), "{finished:?}");
    assert!(finished.stdout.contains("CAP_BPF"), "{finished:?}");
    let file = std::fs::read(&output).unwrap();
    let written = words.as_bytes();
    assert!(file.windows(written.len()).any(|part| part == written));
    let (finished, _) = run("bpf");
    assert_eq!(finished.status.code(), Some(78), "{finished:?}");
    assert!(finished.stderr.contains("CAP_BPF"), "{finished:?}");
}
