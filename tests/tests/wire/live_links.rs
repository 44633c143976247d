//! Emulated links changed while a run goes on: messages meet the condition in force when the gateway
//! receives them, the report names every change, and whoever gives orders may die.

use core::ops::Range;
use std::path::Path;
use std::process::{Command, Output};
use std::thread;
use std::time::Duration;

use hil_core::record::{EgressRecord, IngressRecord, UNAVAILABLE};
use hil_link::condition::LinkConditionRecord;
use hil_report::link_change::ChangedTo;
use hil_report::summary::Outcome;
use hil_stats::statistics::clopper_pearson;
use hil_tests::account::assert_every_message_is_accounted_for;
use hil_tests::binary::{hil_recorder_binary, hil_runtime_binary};
use hil_tests::child::ChildGuard;
use hil_tests::mcap_file::{assert_code, read_back, recorder};
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::{emulated_shuttle, records, trace_of};
use hil_tests::trial::{RunFiles, Trial, wait_until};
use nix::sys::signal::Signal;
use prost::Message;
use serde_json::Value;

const LIMIT: Duration = Duration::from_mins(1);
const OWN_NS: i64 = 5_000_000;
const BY_HAND_NS: i64 = 40_000_000;
const LOSS_RATIO: f64 = 0.2;
const CONFIDENCE: f64 = 0.9999;
/// From the control PC to the robot and back; `between` names the control PC first.
const FORWARD: &str = "shuttle/command";
const BACKWARD: &str = "shuttle/status";

fn link(arguments: &[&str], run: &Path) -> Output {
    let mut command = Command::new(hil_runtime_binary());
    command.arg("link").args(arguments).arg(run);
    command.output().unwrap()
}

/// The words of an order that must succeed.
fn done(arguments: &[&str], run: &Path) -> String {
    let output = link(arguments, run);
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?}: {error}");
    println!("{}", text.trim());
    text
}

/// Starts a run over an emulated link of 5 ms and waits until messages pass.
fn started(record: &RunFolder, name: &str, more: &str) -> (Trial, ChildGuard) {
    let keys = format!("delay = \"5 ms\"\n{more}");
    let topology = record.write("live.toml", &emulated_shuttle(name, &keys));
    let trial = Trial::of(&topology, &record.join("runs"));
    let child = trial.start_here();
    (trial, child)
}

fn wait_for_messages(files: &RunFiles) {
    wait_until(LIMIT, "messages at the gateway", || {
        files.record_bytes("shuttle.status.ingress.") > 128 + 100 * 80
    });
}

/// The orders to one direction, by the gateway's own records.
fn orders(files: &RunFiles, way: &str) -> Vec<LinkConditionRecord> {
    let channel = format!("hil/link/hop/{way}");
    let mut found: Vec<LinkConditionRecord> = records(files, &channel, "link-condition");
    found.sort_by_key(|order| order.number);
    found
}

/// Delays that the model asked for, of messages received in `window_ns`.
fn requested(files: &RunFiles, channel: &str, window_ns: Range<i64>) -> Vec<i64> {
    let arrivals = records::<IngressRecord>(files, channel, "ingress").into_iter();
    let within = arrivals.filter(|one| one.emulated_ns != UNAVAILABLE);
    let within = within.filter(|one| window_ns.contains(&one.emulated_ns));
    within
        .map(|one| {
            assert!(one.received_ns >= one.due_ns, "never early");
            one.due_ns - one.emulated_ns
        })
        .collect()
}

#[test]
fn a_change_holds_for_messages_received_from_then_on_and_the_report_names_it() {
    let record = RunFolder::new("live-link");
    // It may have to be built first, and the run would not wait.
    let recorder_binary = hil_recorder_binary();
    let (trial, mut child) = started(&record, "live-link", "");
    let files = trial.folder("", LIMIT);
    wait_for_messages(&files);
    let live = record.join("live.mcap");
    let mut recorder = ChildGuard::spawn(
        Command::new(recorder_binary)
            .arg("record")
            .arg(files.root())
            .arg("-o")
            .arg(&live),
    )
    .unwrap();
    let run = files.root();
    let text = done(&["show"], run);
    assert!(
        text.contains("hop.backward: as the topology says"),
        "{text}"
    );
    let text = done(
        &["set", "hop.backward", "--delay", "40ms", "--loss", "0.2"],
        run,
    );
    assert!(text.contains("delay 40 ms, loss 0.2, confirmed by gateway-hop-control-pc"));
    check_refusals(run);
    thread::sleep(Duration::from_secs(4));
    done(&["set", "hop.backward", "--cut"], run);
    thread::sleep(Duration::from_secs(1));
    let shown: Value = serde_json::from_str(&done(&["show", "--json"], run)).unwrap();
    assert_eq!(shown[0]["direction"], "hop.backward");
    assert_eq!(shown[0]["condition"]["kind"], "cut");
    done(&["reset", "hop"], run);
    child.wait_within(LIMIT).unwrap().assert_success();
    files.assert_nothing_left_here();
    let over = link(&["reset", "hop"], run);
    assert_eq!(
        over.status.code(),
        Some(1),
        "a finished run takes no orders"
    );
    check_messages(&files);
    check_report(&files);
    recorder.wait_within(LIMIT).unwrap().assert_success();
    check_recordings(&files, &live, &record.join("converted.mcap"));
}

/// What we look at of an `hil.LinkCondition.v1`.
#[derive(Clone, PartialEq, Message)]
struct Condition {
    #[prost(uint64, tag = "1")]
    number: u64,
    #[prost(string, tag = "3")]
    link: String,
    #[prost(string, tag = "4")]
    direction: String,
    #[prost(string, tag = "5")]
    kind: String,
    #[prost(uint64, optional, tag = "6")]
    delay_ns: Option<u64>,
    #[prost(double, optional, tag = "7")]
    loss_ratio: Option<f64>,
    #[prost(bool, tag = "8")]
    is_in_force: bool,
    #[prost(int64, tag = "10")]
    from_ns: i64,
}

/// The changes are in a recording beside the messages that met them, live and converted alike.
fn check_recordings(files: &RunFiles, live: &Path, converted: &Path) {
    let output = recorder(&["convert", "--output"], &[converted, files.root()]);
    assert_code(&output, 0);
    for way in ["forward", "backward"] {
        let topic = format!("/net/hop/{way}/condition");
        let orders = orders(files, way);
        let read = [live, converted].map(|file| {
            let messages = read_back(file).remove(&topic).unwrap();
            let read = messages.iter().map(|one| {
                assert_eq!(one.channel.metadata["link"], "hop");
                let condition = Condition::decode(&*one.data).unwrap();
                // On the axis of the recording, whose offset is its own.
                let since_first = one.log_time - messages[0].log_time;
                (since_first, condition)
            });
            read.collect::<Vec<_>>()
        });
        assert_eq!(read[0], read[1], "{topic}");
        assert_eq!(read[0].len(), orders.len(), "{topic}");
        for ((since_first, found), order) in read[0].iter().zip(&orders) {
            assert_eq!((found.number, found.from_ns), (order.number, order.from_ns));
            assert_eq!(
                (found.link.as_str(), found.direction.as_str()),
                ("hop", way)
            );
            let since_ns = order.from_ns - orders[0].from_ns;
            assert_eq!(since_first.cast_signed(), since_ns);
            assert!(found.is_in_force);
        }
        let words: Vec<&str> = read[0].iter().map(|(_, one)| one.kind.as_str()).collect();
        if way == "backward" {
            assert_eq!(words, ["fixed", "cut", "topology"]);
            let first = &read[0][0].1;
            assert_eq!(first.delay_ns.map(u64::cast_signed), Some(BY_HAND_NS));
            assert_eq!(first.loss_ratio, Some(LOSS_RATIO));
        } else {
            assert_eq!(words, ["topology"]);
        }
    }
}

/// What cannot be done is refused with its reason, and with the exit code of wrong usage.
fn check_refusals(run: &Path) {
    for (arguments, words) in [
        (
            &["set", "hip", "--cut"][..],
            "no link `hip`; its links: hop (emulated)",
        ),
        (&["set", "hop", "--loss", "1.5"], "1.5 is outside 0 to 1"),
        (
            &["set", "hop", "--delay", "50"],
            "'50' for '--delay <TIME>': has no unit; allowed: h, min, s, ms, us, ns",
        ),
        (&["set", "hop", "--delay", "50s"], "room for 10."),
    ] {
        let output = link(arguments, run);
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {error}");
        assert!(error.contains(words), "{arguments:?}: {error}");
    }
}

fn check_messages(files: &RunFiles) {
    let orders = orders(files, "backward");
    assert_eq!(orders.len(), 3, "{orders:?}");
    let at: Vec<i64> = orders.iter().map(|order| order.from_ns).collect();
    let certain: Vec<i64> = orders.iter().map(|order| order.certain_ns).collect();
    let all = |delays: Vec<i64>, expected_ns: i64| {
        assert!(delays.len() > 30, "{}", delays.len());
        assert!(
            delays.iter().all(|delay| *delay == expected_ns),
            "{delays:?}"
        );
    };
    all(requested(files, BACKWARD, 0..at[0]), OWN_NS);
    all(requested(files, BACKWARD, certain[0]..at[1]), BY_HAND_NS);
    assert!(requested(files, BACKWARD, certain[1]..at[2]).is_empty());
    all(requested(files, BACKWARD, certain[2]..i64::MAX), OWN_NS);
    all(requested(files, FORWARD, 0..i64::MAX), OWN_NS);
    // Handed to the kernel of the same clock a moment before it is received.
    let margin_ns = 20_000_000;
    let within = |ns: i64| (certain[0]..at[1] - margin_ns).contains(&ns);
    let sent = records::<EgressRecord>(files, BACKWARD, "egress").into_iter();
    let sent: Vec<u64> = sent
        .filter(|one| within(one.handed_ns))
        .map(|one| one.sequence)
        .collect();
    let arrived = records::<IngressRecord>(files, BACKWARD, "ingress").into_iter();
    let arrived: Vec<u64> = arrived.map(|one| one.sequence).collect();
    let lost = sent
        .iter()
        .filter(|number| !arrived.contains(number))
        .count() as u64;
    let interval = clopper_pearson(lost, sent.len() as u64, CONFIDENCE).unwrap();
    println!("{lost} of {} lost, {interval:?}", sent.len());
    assert!(
        (interval.low..=interval.high).contains(&LOSS_RATIO),
        "{lost} of {}: {interval:?}",
        sent.len()
    );
}

fn check_report(files: &RunFiles) {
    let summary = files.summary();
    assert_eq!(summary.run.outcome, Outcome::Completed);
    assert_every_message_is_accounted_for(&summary);
    let changes = &summary.link_changes;
    assert_eq!(changes.len(), 4, "{changes:?}");
    let first = &changes[0];
    let expected = ChangedTo::Fixed {
        delay_s: 0.04,
        loss_ratio: LOSS_RATIO,
    };
    assert_eq!((first.link.as_str(), first.to), ("hop", expected));
    let at_s = first.at_s.unwrap();
    assert!((0.5..summary.run.duration_s).contains(&at_s), "{at_s}");
    let plain = |name: &str| {
        let text = files.read(name).replace('\u{a0}', " ");
        text.split_whitespace().collect::<Vec<_>>().join(" ")
    };
    let words = "link hop.backward changed by hand: delay 40.0 ms, loss 20.00 %";
    assert!(plain("report-full.txt").contains(words));
    let line = format!("{at_s:.6} notice {words}");
    assert!(plain("events.log").contains(&line), "{line}");
    let trace = trace_of(files, BACKWARD);
    assert_eq!(trace.header.link, "hop");
    assert_eq!(trace.header.link_change_count, 3);
    let page = files.root().join("page.html");
    let written = Command::new(hil_runtime_binary())
        .arg("report")
        .arg(files.root())
        .arg("-o")
        .arg(&page)
        .output()
        .unwrap();
    assert!(written.status.success());
    let page = std::fs::read_to_string(page)
        .unwrap()
        .replace('\u{a0}', " ");
    assert!(page.contains(words) && page.contains("class=\"change\""));
}

#[test]
fn whoever_gives_orders_may_die_and_a_restarted_gateway_keeps_the_condition() {
    let record = RunFolder::new("live-link-kill");
    let gateway = "[links.hop.gateway]\non_exit = \"restart\"";
    let (trial, mut child) = started(&record, "live-link-kill", gateway);
    let files = trial.folder("", LIMIT);
    wait_for_messages(&files);
    for step in 0..12 {
        let mut command = Command::new(hil_runtime_binary());
        command.args(["link", "set", "hop.backward", "--delay", "9ms"]);
        let mut setter = ChildGuard::spawn(command.arg(files.root())).unwrap();
        thread::sleep(Duration::from_millis(3 * step));
        let _may_have_ended = setter.signal(Signal::SIGKILL);
        setter.wait_within(LIMIT).unwrap();
    }
    done(&["set", "hop.backward", "--delay", "40ms"], files.root());
    let count = orders(&files, "backward").len();
    files.kill_process("gateway-hop-control-pc", 0, LIMIT);
    wait_until(LIMIT, "the restarted gateway's record", || {
        orders(&files, "backward").len() > count
    });
    let ingress = || files.record_bytes("shuttle.status.ingress.");
    let before = ingress();
    wait_until(LIMIT, "messages after the restart", || {
        ingress() > before + 128 + 150 * 80
    });
    child.signal(Signal::SIGINT).unwrap();
    child.wait_within(LIMIT).unwrap().assert_code(130);
    files.assert_nothing_left_here();
    let orders = orders(&files, "backward");
    let resumed = orders.last().unwrap();
    assert_eq!(resumed.request, orders[count - 1].request);
    let delays = requested(&files, BACKWARD, resumed.certain_ns..i64::MAX);
    assert!(delays.len() > 100, "{}", delays.len());
    assert!(delays.iter().all(|delay| *delay == BY_HAND_NS));
    assert_every_message_is_accounted_for(&files.summary());
}
