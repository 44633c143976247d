//! The probe beside a real run: two hosts, one tap in each, and the gateways' own account. What the
//! two say of the wire must agree, though neither knows of the other.

use std::net::{Ipv4Addr, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use hil_capture::reader::{CaptureReader, Step};
use hil_net::filter::PacketFilter;
use hil_net::packet_ring::{PacketRing, RingSettings, RingStamps};
use hil_tests::binary::hil_runtime_binary;
use hil_tests::child::{ChildGuard, Finished};
use hil_tests::lab::{INTERFACE, Lab, LabHost};
use hil_tests::run_folder::RunFolder;
use hil_tests::split::{HOSTS, Split};
use hil_tests::trial::{RunFiles, Trial};
use nix::sys::signal::Signal;
use serde_json::Value;

const START_LIMIT: Duration = Duration::from_mins(1);
const RUN_LIMIT: Duration = Duration::from_mins(2);
/// Farthest that the medians of both may lie apart, microseconds: what only a wrong stamp or a wrong
/// match reaches. How near they are on a quiet machine is for `probe compare` to say.
const MEDIAN_LIMIT_US: f64 = 100.0;

fn start_probe(host: &LabHost, interface: &str, output: &Path, more: &str) -> ChildGuard {
    let mut command = host.command(hil_runtime_binary());
    command
        .args(["probe", "--interface", interface, "--output"])
        .arg(output)
        .args(more.split_whitespace());
    let mut probe = ChildGuard::spawn(&mut command).unwrap();
    let begun = format!("probing {interface}");
    probe.wait_for_output(&begun, START_LIMIT).unwrap();
    probe
}

/// Runs the binary and gives what it printed as JSON, and its exit code.
fn json(arguments: &[&Path]) -> (Value, Option<i32>) {
    let mut command = Command::new(hil_runtime_binary());
    command.arg("probe").args(arguments).arg("--json");
    let mut child = ChildGuard::spawn(&mut command).unwrap();
    let finished = child.wait_within(RUN_LIMIT).unwrap();
    let value = serde_json::from_str(&finished.stdout);
    let value = value.unwrap_or_else(|error| panic!("{error}: {finished:?}"));
    (value, finished.status.code())
}

/// A run of the shuttle over the wire, and what probes at both ends saw of it.
fn run_with_probes(lab: &Lab, record: &RunFolder, trial: &Trial) -> ([RunFiles; 2], [PathBuf; 2]) {
    std::fs::create_dir_all(record.path()).unwrap();
    let captures = HOSTS.map(|host| record.path().join(format!("{host}.pcapng")));
    let mut probes =
        [0, 1].map(|index| start_probe(lab.host(index), INTERFACE, &captures[index], ""));
    let split = Split::start(lab, trial);
    let files = split.files.clone();
    split.finish();
    for probe in &mut probes {
        probe.signal(Signal::SIGINT).unwrap();
        let finished = probe.wait_within(START_LIMIT).unwrap();
        finished.assert_success();
        print!("{}", finished.stdout);
    }
    (files, captures)
}

#[test]
fn of_a_sealed_run_every_datagram_is_accounted_for_as_well() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("probe-sealed");
    let trial = Trial::shipped("shuttle-split.toml", record.path()).set("run.duration=\"3 s\"");
    let (files, captures) = run_with_probes(&lab, &record, &trial);
    let run = files[0].root();
    let (comparison, _) = json(&[Path::new("compare"), run, &captures[0], &captures[1]]);
    for channel in comparison["channels"].as_array().unwrap() {
        for counts in ["sent", "received", "data_sent", "data_received"] {
            let counts = &channel[counts];
            assert_eq!(counts["gateway"], counts["probe"], "{channel:#}");
        }
    }
}

#[test]
fn probe_and_gateways_agree_on_every_datagram_and_on_the_time_on_the_wire() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("probe-run");
    let trial = Trial::shipped("shuttle-split.toml", record.path())
        // What is on the wire is looked at byte by byte.
        .plain()
        .set("run.duration=\"8 s\"")
        // Often enough that neither tap nor driver runs from cold caches each time.
        .set("case.parameters.rate_hz=1000.0");
    let (files, captures) = run_with_probes(&lab, &record, &trial);

    let arguments = [
        Path::new("compare"),
        files[0].root(),
        &captures[0],
        &captures[1],
        Path::new("--limit"),
        Path::new("100"),
    ];
    let (comparison, code) = json(&arguments);
    println!("{comparison:#}");
    assert_eq!(comparison["clocks"], "one", "two namespaces of one machine");
    let channels = comparison["channels"].as_array().unwrap();
    assert_eq!(
        channels.len(),
        2,
        "both channels of the case cross the wire"
    );
    for channel in channels {
        for counts in ["sent", "received", "data_sent", "data_received"] {
            let counts = &channel[counts];
            assert_eq!(counts["gateway"], counts["probe"], "{channel:#}");
            assert!(counts["probe"].as_u64().unwrap() > 100, "{channel:#}");
        }
        let p50_us = |what: &str| channel[what]["p50_ns"].as_f64().unwrap() * 1e-3;
        println!(
            "{}: medians {} us by the gateways, {} us by the probe",
            channel["channel"],
            p50_us("gateway_wire"),
            p50_us("probe_wire")
        );
        let apart_us = (p50_us("probe_wire") - p50_us("gateway_wire")).abs();
        assert!(
            apart_us <= MEDIAN_LIMIT_US,
            "{apart_us} us apart: {channel:#}"
        );
    }
    assert_eq!(code, Some(0));

    check_analysis(&captures);
    check_cut(&captures);
    check_comparisons_with_faults(files[0].root(), &captures);
}

/// A capture with a fault, and one of another time, beside the run.
fn check_comparisons_with_faults(run: &Path, captures: &[PathBuf; 2]) {
    let bytes = std::fs::read(&captures[0]).unwrap();
    let cut = captures[0].with_extension("tail.pcapng");
    std::fs::write(&cut, &bytes[..bytes.len() - 1]).unwrap();
    // Its section and interface, and no packet.
    let block = |at: usize| u32::from_le_bytes(bytes[at + 4..at + 8].try_into().unwrap()) as usize;
    let empty = captures[0].with_extension("empty.pcapng");
    std::fs::write(&empty, &bytes[..block(0) + block(block(0))]).unwrap();
    for (file, code, words) in [
        (&cut, 1, "cut short"),
        (&empty, 2, "holds no message of the run"),
    ] {
        let mut command = Command::new(hil_runtime_binary());
        command
            .args(["probe", "compare", "--limit", "100"])
            .arg(run);
        command.arg(file).arg(&captures[1]);
        let mut child = ChildGuard::spawn(&mut command).unwrap();
        let finished = child.wait_within(RUN_LIMIT).unwrap();
        assert_eq!(finished.status.code(), Some(code), "{finished:?}");
        assert!(finished.stderr.contains(words), "{finished:?}");
    }
}

fn try_ip(host: &LabHost, arguments: &str) -> Finished {
    let mut command = host.command("ip");
    command.args(arguments.split(' '));
    let mut child = ChildGuard::spawn(&mut command).unwrap();
    child.wait_within(START_LIMIT).unwrap()
}

fn ip(host: &LabHost, arguments: &str) -> String {
    let finished = try_ip(host, arguments);
    finished.assert_success();
    finished.stdout
}

#[test]
fn an_interface_that_goes_ends_the_capture_with_a_whole_file_and_its_own_exit_code() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let folder = RunFolder::new("probe-gone");
    std::fs::create_dir_all(folder.path()).unwrap();
    let output = folder.path().join("gone.pcapng");
    let host = lab.host(0);
    let start = |name: &str, more: &[&str]| {
        let mut command = host.command(hil_runtime_binary());
        command.args(["probe", "--interface", name, "--output"]);
        command.arg(&output).args(more);
        ChildGuard::spawn(&mut command).unwrap()
    };
    ip(host, "link add gone0 type veth peer name gone1");
    ip(host, "link set gone0 up");
    let mut probe = start("gone0", &[]);
    probe.wait_for_output("probing gone0", START_LIMIT).unwrap();
    // The card passes frames of other addresses as long as the probe runs.
    assert!(ip(host, "-d link show gone0").contains("promiscuity 1"));
    ip(host, "link del gone0");
    let finished = probe.wait_within(START_LIMIT).unwrap();
    assert_eq!(finished.status.code(), Some(1), "{finished:?}");
    assert!(finished.stderr.contains("gone0: "), "{finished:?}");
    assert!(finished.stderr.contains("it has gone"), "{finished:?}");
    let (report, code) = json(&[Path::new("analyse"), &output]);
    // It is whole, and there is nothing in it to analyse.
    assert_eq!(
        (code, &report["files"][0]["dropped_count"]),
        (Some(1), &0.into())
    );

    // The file stays unless told otherwise, and a tap leaves nothing behind.
    let before = std::fs::read(&output).unwrap();
    let finished = start(INTERFACE, &[]).wait_within(START_LIMIT).unwrap();
    assert_eq!(finished.status.code(), Some(2), "{finished:?}");
    assert!(
        finished.stderr.contains("exists; say --force"),
        "{finished:?}"
    );
    assert_eq!(std::fs::read(&output).unwrap(), before);
    let more = ["--force", "--duration", "100ms"];
    let finished = start(INTERFACE, &more).wait_within(START_LIMIT).unwrap();
    finished.assert_success();
    assert_ne!(std::fs::read(&output).unwrap(), before);
    let link = ip(host, &format!("-d link show {INTERFACE}"));
    assert!(link.contains("promiscuity 0"), "{link}");
}

/// What the captures say on their own.
fn check_analysis(captures: &[PathBuf; 2]) {
    let (report, code) = json(&[Path::new("analyse"), &captures[0], &captures[1]]);
    let joins = report["joins"].as_array().unwrap();
    // Stamps that a stalled machine stored out of order may look like those of a clock that was set.
    let is_set = joins.iter().any(|joined| {
        let steps = joined["figures"]["clock_steps"].as_array().unwrap();
        steps
            .iter()
            .any(|one| one.as_array().is_some_and(|steps| !steps.is_empty()))
    });
    println!("a clock was set: {is_set}");
    assert_eq!(code, Some(i32::from(is_set)), "{joins:#?}");
    for file in report["files"].as_array().unwrap() {
        assert_eq!(file["dropped_count"], 0, "{file:#}");
    }
    assert!(
        joins.len() >= 8,
        "two channels, each with messages, greetings, exchanges: {joins:#?}"
    );
    for joined in joins {
        // Two files of which nothing is said may be of two machines.
        assert_eq!(joined["clocks"], "unknown");
        assert_eq!(joined["delay_bound_ns"], Value::Null);
        let figures = &joined["figures"];
        assert_eq!(figures["order"], "packet_direction");
        assert_eq!(figures["loss"]["state"], "counted", "{joined:#}");
        assert_eq!(figures["loss"]["count"], 0, "{joined:#}");
        for count in ["duplicated_count", "unexplained_count", "edge_count"] {
            assert_eq!(figures[count], 0, "{count}: {joined:#}");
        }
        assert_eq!(figures["first_count"], figures["second_count"]);
    }
    let one_clock = Path::new("--one-clock");
    let (report, _) = json(&[Path::new("analyse"), &captures[0], &captures[1], one_clock]);
    assert_eq!(report["joins"][0]["clocks"], "declared_one");
    assert_eq!(report["joins"][0]["delay_bound_ns"], 0);
}

/// A capture cut off in the middle keeps what was there and is told apart by exit code and offset.
fn check_cut(captures: &[PathBuf; 2]) {
    let bytes = std::fs::read(&captures[0]).unwrap();
    let cut = captures[0].with_extension("cut.pcapng");
    std::fs::write(&cut, &bytes[..=bytes.len() / 2]).unwrap();
    let (report, code) = json(&[Path::new("analyse"), &cut]);
    assert_eq!(code, Some(1));
    let file = &report["files"][0];
    assert!(file["packet_count"].as_u64().unwrap() > 100, "{file:#}");
    let fault = file["faults"][0].as_str().unwrap();
    assert!(
        fault.contains("byte ") && fault.contains("cut short"),
        "{fault}"
    );
}

#[test]
fn what_cannot_be_tapped_or_read_is_refused_with_its_own_exit_code() {
    let folder = RunFolder::new("probe-refusals");
    std::fs::create_dir_all(folder.path()).unwrap();
    let foreign = folder.path().join("foreign.pcap");
    std::fs::write(&foreign, "this is no capture").unwrap();
    let output = folder.path().join("never.pcapng");
    let output = output.to_str().unwrap();
    for (arguments, code, words) in [
        (
            vec!["analyse", foreign.to_str().unwrap()],
            2,
            "byte 0: not a capture",
        ),
        (vec!["analyse", "/nonexistent.pcap"], 2, "/nonexistent.pcap"),
        (
            vec!["compare", "/nonexistent", foreign.to_str().unwrap()],
            2,
            "/nonexistent",
        ),
        (
            vec!["-i", "hil-none0", "-o", output],
            69,
            "no interface `hil-none0`",
        ),
        (
            vec!["-i", "lo", "-o", output, "--stamps", "card"],
            78,
            "the card of lo gives no stamps",
        ),
        (vec!["-i", "lo"], 2, "--output"),
        (vec!["-o", output], 2, "--interface"),
        (
            vec!["-i", "lo", "-i", "lo", "-o", output],
            2,
            "--interface lo is given twice",
        ),
        (
            vec!["-i", "lo", "-o", output, "--flow", "udp"],
            2,
            "would follow every datagram",
        ),
        (
            vec!["-i", "lo", "-o", output, "--duration", "soon"],
            2,
            "no number before its unit",
        ),
    ] {
        let mut command = Command::new(hil_runtime_binary());
        command.arg("probe").args(&arguments);
        let mut child = ChildGuard::spawn(&mut command).unwrap();
        let finished = child.wait_within(START_LIMIT).unwrap();
        assert_eq!(
            finished.status.code(),
            Some(code),
            "{arguments:?}: {finished:?}"
        );
        assert!(
            finished.stderr.contains(words),
            "{arguments:?}: {}",
            finished.stderr
        );
    }
}

#[test]
fn tags_and_datagrams_in_pieces_are_captured_whole() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("probe-pieces");
    std::fs::create_dir_all(record.path()).unwrap();
    let host = lab.host(0);
    ip(host, "link set lo up");
    // Not every kernel has VLANs.
    let has_vlans = [0, 1].map(|index| {
        let host = lab.host(index);
        let added = try_ip(host, "link add link eth0 name eth0.5 type vlan id 5");
        if !added.status.success() {
            return false;
        }
        let address = format!("address add 10.78.0.{}/24 dev eth0.5", index + 1);
        ip(host, &address);
        ip(host, "link set eth0.5 up");
        true
    });
    let is_tagged = has_vlans == [true; 2];
    println!("VLANs tried: {is_tagged}");
    let outputs =
        ["lo", INTERFACE].map(|name| (name, record.path().join(format!("{name}.pcapng"))));
    let mut probes = outputs
        .each_ref()
        .map(|(name, output)| start_probe(host, name, output, ""));
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
        probe.signal(Signal::SIGINT).unwrap();
        probe.wait_within(START_LIMIT).unwrap().assert_success();
    }
    let lengths: Vec<u32> = packets(&outputs[0].1).iter().map(|one| one.0).collect();
    assert_eq!(lengths, [20_042; 100], "fifty both ways");
    let tag = [0x81, 0, 0, 5];
    let on_wire = packets(&outputs[1].1);
    let tagged = on_wire.iter().filter(|(_, data)| data[12..16] == tag);
    assert_eq!(tagged.count(), if is_tagged { 50 } else { 0 });
}

/// Length on the wire and kept bytes of each packet of a capture.
fn packets(path: &Path) -> Vec<(u32, Vec<u8>)> {
    let mut reader = CaptureReader::default();
    reader.feed(&std::fs::read(path).unwrap());
    reader.end();
    let mut found = Vec::new();
    loop {
        match reader.next_step() {
            Step::Packet(packet) => found.push((packet.original_bytes, packet.data.to_vec())),
            Step::Ended => return found,
            other => panic!("{}: {other:?}", path.display()),
        }
    }
}

#[test]
fn what_found_no_room_is_in_the_report_and_in_the_file() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("probe-room");
    std::fs::create_dir_all(record.path()).unwrap();
    let host = lab.host(0);
    let output = record.path().join("full.pcapng");
    let more = "--flow udp:dport=7000 --ring 1 --snap-length 2048";
    let mut probe = start_probe(host, INTERFACE, &output, more);
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
    probe.signal(Signal::SIGINT).unwrap();
    let finished = probe.wait_within(START_LIMIT).unwrap();
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
    let filters = [PacketFilter {
        destination_port: Some(7000),
        ..PacketFilter::default()
    }];
    lab.host(0).on_network(|| {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).unwrap();
        let send = |count: u64| {
            for _ in 0..count {
                // Nobody listens there, and an answer that says so is no fault.
                let _refused = socket.send_to(b"", (lab.host(1).address(), 7000)).is_ok();
            }
        };
        let mut tap = PacketRing::open(INTERFACE, &filters, &settings).unwrap();
        let said = |tap: &mut PacketRing| {
            let counters = tap.counters().unwrap();
            (counters.matched_count, counters.dropped_count)
        };
        // More than there is room for, then less.
        for count in [2000, 30] {
            let (matched, dropped) = said(&mut tap);
            send(count);
            let (matched_now, dropped_now) = said(&mut tap);
            assert_eq!(matched_now - matched, count);
            assert_eq!(dropped_now > dropped, count == 2000);
            tap.begin().unwrap();
            assert_eq!(said(&mut tap), (0, 0));
        }
        send(40);
        let kept = (0..100).take_while(|_| tap.next_packet(|_| ())).count();
        assert_eq!((kept, said(&mut tap)), (40, (40, 0)));
    });
}
