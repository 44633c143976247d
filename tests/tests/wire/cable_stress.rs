//! A cable under strain: more frames than are carried, more flows than are told apart, and an interface that its
//! program sets down.

use std::collections::BTreeMap;
use std::fs;
use std::process::Command;
use std::time::Duration;

use hil_account::flow::{FLOWS_MAX, FlowMetrics};
use hil_report::summary::{ChannelFlows, RunSummary};
use hil_tests::child::{ChildGuard, Finished};
use hil_tests::trial::processes_mentioning;

use super::joined_programs::{
    LIMIT, Place, assert_closed, assert_fates_add_up, flow, lacks, number_before,
};

/// Largest memory that a process of ours may have had, with the pages of its program and those that it shares,
/// in KiB: three times what gateways took in a storm.
const GATEWAY_MEMORY_KIB_MAX: u64 = 150 * 1024;
/// The same of the process that draws up the account, of some 100,000 frames or 20,000 flows.
const ACCOUNT_MEMORY_KIB_MAX: u64 = 300 * 1024;
/// Frames of the kernels' own that come between: neighbours looked for, groups joined.
const KERNEL_FRAMES_MAX: u64 = 50;

/// Waits for the end of `child`, a run of `place`, of which nothing is left, and checks the memory of each of its
/// processes.
fn end_within_memory(place: &Place, mut child: ChildGuard) -> Finished {
    let path = place.binary.to_str().unwrap().to_owned();
    let mut largest_kib = BTreeMap::new();
    while child.is_running() {
        for process in processes_mentioning(&path) {
            let read = |file: &str| fs::read_to_string(format!("/proc/{process}/{file}"));
            // One that ends meanwhile has been read before.
            let (Ok(status), Ok(line)) = (read("status"), read("cmdline")) else {
                continue;
            };
            let line = line.split('\0').find(|part| part.contains(".json"));
            let name = line.and_then(|line| line.rsplit('/').next());
            let name = name.unwrap_or("join").to_owned();
            if let Some(kib) = status.split("VmHWM:").nth(1) {
                let largest: &mut u64 = largest_kib.entry(name).or_default();
                *largest = number_before(kib, " kB").max(*largest);
            }
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    println!("{largest_kib:#?}");
    // The gateways, the processes that started the programs, and the one that started all.
    assert!(largest_kib.len() >= 5, "{largest_kib:?}");
    for (name, kib) in largest_kib {
        let kib_max = if name == "join" {
            ACCOUNT_MEMORY_KIB_MAX
        } else {
            GATEWAY_MEMORY_KIB_MAX
        };
        assert!(kib <= kib_max, "{name}: {kib} KiB of {kib_max} KiB");
    }
    let finished = child.wait_within(LIMIT).unwrap();
    place.assert_nothing_left();
    finished
}

/// What the first program sent, and the second.
fn channels(summary: &RunSummary) -> [&ChannelFlows; 2] {
    ["first/second", "second/first"].map(|name| {
        let mut flows = summary.flows.iter();
        flows.find(|one| one.channel == name).unwrap()
    })
}

#[test]
fn a_storm_of_broadcasts_both_ways_is_the_harness_and_ends_and_requests_are_answered_again() {
    if lacks("python3", "python3") {
        return;
    }
    let place = Place::new("cable-storm");
    let script = place.copy_of("stress.py");
    let script = script.to_str().unwrap();
    let storm = |other, more: &[&'static str]| {
        let arguments = ["--", "python3", script, "storm", other, "2"];
        [&arguments[..], more].concat()
    };
    let arguments = [storm("10.77.0.2", &["asks"]), storm("10.77.0.1", &[])].concat();
    let child = place.join(&arguments);
    end_within_memory(&place, child).assert_success();
    let summary = place.summary();
    assert_fates_add_up(&summary);
    for (channel, program) in channels(&summary).into_iter().zip(["first", "second"]) {
        let said = place.said_by(program);
        let sent =
            [" broadcasts sent", " multicasts sent"].map(|words| number_before(&said, words));
        let sent_count: u64 = sent.iter().sum();
        let storms = channel
            .flows
            .iter()
            .filter(|one| one.name.ends_with(":5000"));
        let storms: Vec<&FlowMetrics> = storms.collect();
        let carried_count: u64 = storms.iter().map(|one| one.frame_count).sum();
        let lost = channel.inlet_lost_count();
        println!("{program}: {sent_count} sent, {lost} lost at its inlet, {storms:#?}");
        assert!(sent_count > 1_000, "no storm: {said}");
        assert_eq!(storms.len(), 2);
        // What the inlet lost may be frames of the kernel's own.
        let all_count = carried_count + lost;
        assert!((sent_count..=sent_count + KERNEL_FRAMES_MAX).contains(&all_count));
        for one in &channel.flows {
            assert_eq!(one.lost_by_network_count, 0, "{one:?}");
        }
        assert!(storms.iter().all(|one| one.taken_count > 0), "{storms:?}");
    }
    let said = place.said_by("first");
    assert!(number_before(&said, " answered") > 90, "{said}");
}

#[test]
fn flows_beyond_ten_thousand_of_a_channel_are_one_and_all_frames_are_counted() {
    const PORT_COUNT: usize = FLOWS_MAX + 1_000;
    if lacks("python3", "python3") {
        return;
    }
    let place = Place::new("cable-flows");
    let script = place.copy_of("stress.py");
    let (script, count) = (script.to_str().unwrap(), PORT_COUNT.to_string());
    let from = ["--", "python3", script, "from_ports", "10.77.0.2", &count];
    let to = ["--", "python3", script, "to_ports", "10.77.0.1", &count];
    let child = place.join(&[from, to].concat());
    let finished = end_within_memory(&place, child);
    finished.assert_success();
    assert!(
        finished.stdout.contains("all other flows"),
        "{}",
        finished.stdout
    );
    let summary = place.summary();
    assert_fates_add_up(&summary);
    for (channel, program) in channels(&summary).into_iter().zip(["first", "second"]) {
        assert_eq!(channel.inlet_lost_count(), 0, "{:?}", channel.inlet_lost);
        assert_eq!(channel.flows.len(), FLOWS_MAX + 1);
        let said = place.said_by(program);
        let sent_count = number_before(&said, " datagrams sent");
        assert_eq!(sent_count, 2 * PORT_COUNT as u64, "{said}");
        let mut others = channel.flows.iter();
        let others = others.find(|one| one.name == "all other flows").unwrap();
        let apart = channel.flows.iter().filter(|one| {
            let port = if program == "first" {
                ":5000"
            } else {
                "10.77.0.1:"
            };
            one.name.starts_with("udp") && one.name.contains(port) && !one.name.contains(":5002")
        });
        let apart: Vec<&FlowMetrics> = apart.collect();
        println!("{program}: {} flows, {others:?}", apart.len());
        for one in &apart {
            assert_eq!(one.frame_count, 2, "{one:?}");
            assert_eq!(one.lost_by_network_count, 0, "{one:?}");
        }
        assert_eq!(others.lost_by_network_count, 0, "{others:?}");
        let all_count = 2 * apart.len() as u64 + others.frame_count;
        let expected = sent_count..=sent_count + KERNEL_FRAMES_MAX;
        assert!(expected.contains(&all_count), "{all_count}: {said}");
    }
}

#[test]
fn a_program_without_rights_cannot_set_its_interface_down() {
    if lacks("python3", "python3") || lacks("ip", "iproute2") {
        return;
    }
    let place = Place::new("cable-kept");
    let script = place.copy_of("stress.py");
    let script = script.to_str().unwrap();
    let downs = ["--", "python3", script, "talk", "10.77.0.2", "1", "downs"];
    let talks = ["--", "python3", script, "talk", "10.77.0.1", "1"];
    place.run(&[&downs[..], &talks].concat()).assert_success();
    let (summary, said) = (place.summary(), place.said_by("first"));
    assert_closed(&summary);
    assert!(said.contains("Operation not permitted"), "{said}");
    let sent = flow(&summary, "udp 10.77.0.1:5000");
    assert_eq!(sent.frame_count, number_before(&said, " sent"), "{said}");
    assert_eq!(number_before(&said, " refused"), 0, "{said}");
}

#[test]
fn frames_for_an_interface_that_its_program_set_down_are_lost_by_the_harness_and_flow_after() {
    if !nix::unistd::geteuid().is_root() {
        eprintln!("skipped: a program that may set its interface down is started by root");
        return;
    }
    if lacks("python3", "python3") || lacks("ip", "iproute2") {
        return;
    }
    let place = Place::new("cable-down");
    let script = place.copy_of("stress.py");
    let script = script.to_str().unwrap();
    let downs = ["--", "python3", script, "talk", "10.77.0.2", "3", "downs"];
    let talks = ["--", "python3", script, "talk", "10.77.0.1", "3"];
    // As the user of the tests, root.
    let mut command = Command::new(&place.binary);
    command
        .args(["join", "--quiet"])
        .args([&downs[..], &talks].concat());
    command.current_dir(place.folder.path());
    let mut child = ChildGuard::spawn(&mut command).unwrap();
    child.wait_within(LIMIT).unwrap().assert_success();
    place.assert_nothing_left();
    let summary = place.summary();
    assert_fates_add_up(&summary);
    let said = place.said_by("first");
    println!("{said}");
    let (to, from) = (
        flow(&summary, "udp 10.77.0.2:5000"),
        flow(&summary, "udp 10.77.0.1:5000"),
    );
    println!("{to:?}\n{from:?}");
    // Its own are refused before they are frames.
    assert!(number_before(&said, " refused") > 0, "{said}");
    assert_eq!(from.frame_count, number_before(&said, " sent"));
    // It is down for a third of the time; before its end it reads no more for a moment.
    assert!(5 * to.lost_by_harness_count > to.frame_count, "{to:?}");
    let received_count = number_before(&said, " received");
    let unread_count = to.taken_count.saturating_sub(received_count);
    assert!(5 * unread_count < to.frame_count, "{said} {to:?}");
    assert_eq!(to.lost_by_network_count, 0, "{to:?}");
    let [_, back] = channels(&summary);
    // None of them twice.
    assert!(back.inlet_lost_count() <= 2, "{:?}", back.inlet_lost);
}
