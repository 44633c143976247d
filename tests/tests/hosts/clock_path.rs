//! Clocks exchanged over a cable of their own, beside a data link that is slow or whole, and what
//! becomes of a run whose second cable is cut. The second host's clock is ahead by a known time.

use std::process::Command;
use std::time::Duration;

use hil_clock::{ClockMetrics, StampKind};
use hil_report::clock_summary::{ClockPathSummary, ClockRung, HostPairClock};
use hil_report::summary::{RunEventKind, RunSummary};
use hil_rundir::event::EventKind;
use hil_tests::binary::hil_runtime_binary;
use hil_tests::child::ChildGuard;
use hil_tests::lab::{BRIDGE_PORTS, Lab, SECOND_ADDRESSES, SECOND_INTERFACE};
use hil_tests::run_folder::RunFolder;
use hil_tests::split::{HOSTS, Split};
use hil_tests::trial::{Trial, shipped_topology, wait_until};

/// The processes at the ends of the clock path, by host.
const ENDS: [&str; 2] = ["clock-robot-pc-control-pc", "clock-control-pc-robot-pc"];
const AHEAD_S: u32 = 100_000;
/// `robot-pc = control-pc + truth`, to the nanosecond.
const TRUTH_NS: i64 = AHEAD_S as i64 * 1_000_000_000;
const LIMIT: Duration = Duration::from_mins(1);
/// Twice the time without an exchange that a report tells of.
const WITHOUT_EXCHANGE: Duration = Duration::from_secs(2);
/// Less than a channel of the link and its exchanges ask for, some 140 kbit/s, so that a queue stands,
/// tens of milliseconds long.
const THROTTLE: &str = "tbf rate 60kbit burst 1600 limit 1000";

/// A split run whose topology has a clock path.
fn start<'a>(lab: &'a Lab, record: &RunFolder, duration: &str) -> Split<'a> {
    let trial = Trial::shipped("shuttle-split.toml", record.path())
        .set(&format!("run.duration=\"{duration}\""));
    let ends = HOSTS.iter().zip(SECOND_ADDRESSES);
    let trial = ends.fold(trial, |trial, (host, address)| {
        trial
            .set(&format!("hosts.{host}.clock_address=\"{address}\""))
            .set(&format!(
                "hosts.{host}.clock_interface=\"{SECOND_INTERFACE}\""
            ))
    });
    Split::start(lab, &trial)
}

/// Both summaries, which must agree on the clocks.
fn finish(split: Split<'_>) -> [RunSummary; 2] {
    agreed(split.finish())
}

fn agreed(summaries: [RunSummary; 2]) -> [RunSummary; 2] {
    assert_eq!(pair(&summaries[0]), pair(&summaries[1]));
    summaries
}

fn pair(summary: &RunSummary) -> &HostPairClock {
    let [pair] = &summary.clocks.as_ref().unwrap().pairs[..] else {
        panic!("{:?}", summary.clocks);
    };
    assert_eq!((pair.from.as_str(), pair.to.as_str()), (HOSTS[0], HOSTS[1]));
    assert_eq!(pair.contradiction, None);
    assert_eq!(pair.rung, ClockRung::Exchanges, "{pair:?}");
    pair
}

fn path(pair: &HostPairClock) -> &ClockPathSummary {
    let path = pair.clock_path.as_ref().unwrap();
    assert_eq!(path.name, "clock/control-pc-robot-pc");
    assert_eq!(
        path.describe(),
        "clock path 10.78.0.1 (eth1) <-> 10.78.0.2 (eth1)"
    );
    path
}

/// Holds `figures` against the truth; gives the width of what is guaranteed in mid-run, nanoseconds.
fn width_ns(what: &str, figures: &ClockMetrics) -> i64 {
    let (offset, bound) = (figures.offset.unwrap(), figures.bound.unwrap());
    println!(
        "{what}: {} exchanges, stamps {:?}, estimate off by {} ns, guaranteed {} to {} ns about the \
         truth, bound median {} ns, largest {} ns, smallest round trip {:?} ns",
        figures.exchange_count,
        figures.stamp_counts,
        offset.estimate_ns - TRUTH_NS,
        offset.lowest_ns - TRUTH_NS,
        offset.highest_ns - TRUTH_NS,
        bound.median_ns,
        bound.largest_ns,
        figures.rtt_min_ns,
    );
    assert!((offset.lowest_ns..=offset.highest_ns).contains(&TRUTH_NS));
    assert_eq!(figures.steps, [], "no clock was stepped");
    offset.highest_ns - offset.lowest_ns
}

fn warnings<'a>(summary: &'a RunSummary, words: &str) -> Vec<&'a String> {
    let all = summary.warnings.iter();
    all.filter(|warning| warning.contains(words)).collect()
}

fn throttle(lab: &Lab, what: &str) {
    for port in BRIDGE_PORTS {
        let mut command: Command = lab.host(0).command("tc");
        let words = format!("qdisc {what} dev {port} root");
        let words = if what == "add" {
            format!("{words} {THROTTLE}")
        } else {
            words
        };
        let status = command.args(words.split(' ')).status().unwrap();
        assert!(status.success(), "tc {words}");
    }
}

#[test]
fn a_slow_data_link_leaves_the_bound_as_narrow_as_the_clock_path() {
    let Some(lab) = Lab::with_clock_ahead_or_skip(Some(AHEAD_S)) else {
        return;
    };
    let record = RunFolder::new("clock-path");
    lab.put_bridge_between();
    lab.lay_second_cable();
    let split = start(&lab, &record, "8 s");
    split.wait_for_messages("the begin of the run");
    throttle(&lab, "add");
    std::thread::sleep(Duration::from_secs(6));
    // The records must not go through it.
    throttle(&lab, "delete");
    let report = split.files[0].clone();
    for summary in &finish(split) {
        let pair = pair(summary);
        let path = path(pair);
        let figures = path.exchanges.as_ref().unwrap();
        let both_ns = width_ns("both paths", pair.exchanges.as_ref().unwrap());
        let path_ns = width_ns("clock path alone", figures);
        let data_ns = width_ns("data path alone", path.data_path.as_ref().unwrap());
        for narrow_ns in [both_ns, path_ns] {
            assert!(narrow_ns * 8 < data_ns, "{narrow_ns} and {data_ns} ns");
        }
        assert!(figures.exchange_count > 300, "{figures:?}");
        let count = |kind| figures.stamp_counts.get(&kind).copied().unwrap_or(0);
        let kernel_count = count(StampKind::KernelSoftware);
        // With one place missing it would be three quarters.
        assert!(
            kernel_count * 100 >= figures.exchange_count * 4 * 85,
            "{figures:?}"
        );
        assert_eq!(warnings(summary, "gave no exchange"), [] as [&String; 0]);
        assert!(pair.basis.starts_with("system clocks give no bound"));
    }
    let report = report.read("report-full.txt");
    for words in [
        "exchanges over the clock path, and beside the data:",
        "clock path 10.78.0.1 (eth1) <-> 10.78.0.2 (eth1); ",
        "over the clock path,",
    ] {
        assert!(report.contains(words), "{words:?} is missing:\n{report}");
    }
}

#[test]
fn without_its_cable_a_clock_path_is_given_up_and_the_report_says_so() {
    let Some(lab) = Lab::with_clock_ahead_or_skip(Some(AHEAD_S)) else {
        return;
    };
    let record = RunFolder::new("clock-none");
    let summaries = finish(start(&lab, &record, "2 s"));
    for summary in &summaries {
        let pair = pair(summary);
        let path = path(pair);
        assert!(!path.has_exchanges(), "{path:?}");
        let data = path.data_path.as_ref().unwrap();
        assert_eq!(Some(data), pair.exchanges.as_ref());
        width_ns("data path", data);
        let given_up = pair.basis.contains("the data path's alone");
        assert!(given_up, "{}", pair.basis);
        let told = warnings(
            summary,
            "gave no exchange (process clock-robot-pc-control-pc ended",
        );
        assert_eq!(told.len(), 1, "{:?}", summary.warnings);
        for end in ENDS {
            let events = summary.events.iter().filter(|event| {
                let is_given_up =
                    matches!(event.kind, RunEventKind::Process(EventKind::GivenUp { .. }));
                event.process == end && is_given_up
            });
            assert_eq!(events.count(), 1, "{:?}", summary.events);
        }
    }
}

#[test]
fn a_cable_that_is_never_plugged_in_delays_the_run_and_does_not_stop_it() {
    let Some(lab) = Lab::with_clock_ahead_or_skip(Some(AHEAD_S)) else {
        return;
    };
    let record = RunFolder::new("clock-unplugged");
    lab.lay_second_cable();
    lab.host(1).set_link(SECOND_INTERFACE, "down");
    for summary in &finish(start(&lab, &record, "2 s")) {
        let pair = pair(summary);
        assert!(!path(pair).has_exchanges(), "{pair:?}");
        let told = warnings(summary, "gave no exchange");
        assert_eq!(told.len(), 1, "{:?}", summary.warnings);
        let waited = summary
            .events
            .iter()
            .filter(|event| event.process == ENDS[0] && event.what().contains("no answer"));
        assert_eq!(waited.count(), 1, "{:?}", summary.events);
    }
}

#[test]
fn a_killed_end_comes_back_and_a_cable_pulled_in_the_run_leaves_a_gap_that_is_told() {
    let Some(lab) = Lab::with_clock_ahead_or_skip(Some(AHEAD_S)) else {
        return;
    };
    let record = RunFolder::new("clock-killed");
    lab.lay_second_cable();
    let split = start(&lab, &record, "10 min");
    split.wait_for_messages("the begin of the run");
    for (index, end) in ENDS.iter().enumerate() {
        split.kill(index, end);
    }
    let exchanged =
        || split.files[0].record_bytes(&format!("clock.{}-{}.round", HOSTS[0], HOSTS[1]));
    let before = exchanged();
    wait_until(LIMIT, "exchanges after the restarts", || {
        exchanged() > before + 48 * 20
    });
    lab.host(0).set_link(SECOND_INTERFACE, "down");
    std::thread::sleep(WITHOUT_EXCHANGE);
    let files = split.files[0].root().join("records");
    for summary in &agreed(split.stop()) {
        let pair = pair(summary);
        let path = path(pair);
        assert!(path.has_exchanges(), "{path:?}");
        width_ns("both paths", pair.exchanges.as_ref().unwrap());
        assert!(path.longest_gap_ns.unwrap() > 1_000_000_000, "{path:?}");
        let told = warnings(summary, "was without an exchange for");
        assert_eq!(told.len(), 1, "{:?}", summary.warnings);
        for end in ENDS {
            let restarts = summary.processes.iter().find(|process| process.name == end);
            assert_eq!(restarts.unwrap().restart_count, 1);
            let events = summary.events.iter().filter(|event| {
                let is_restart = matches!(
                    event.kind,
                    RunEventKind::Process(EventKind::Restarted { restart: 1, .. })
                );
                event.process == end && is_restart
            });
            assert_eq!(events.count(), 1, "{:?}", summary.events);
        }
    }
    // Two starts of each end, and nothing of messages that there are none of.
    let names = std::fs::read_dir(files).unwrap().map(|entry| {
        let name = entry.unwrap().file_name();
        name.to_string_lossy().into_owned()
    });
    let mut names: Vec<String> = names.filter(|name| name.starts_with("clock.")).collect();
    names.sort();
    let path = "clock.control-pc-robot-pc";
    let of_ends = [
        "no-room.clock-control-pc-robot-pc",
        "round-trip.clock-robot-pc-control-pc",
    ];
    let files = of_ends.map(|end| [0, 1].map(|start| format!("{path}.{end}.{start}.rec")));
    assert_eq!(names, files.concat());
}

#[test]
fn a_check_and_the_doctor_tell_of_a_clock_path() {
    let folder = RunFolder::new("clock-words");
    let base = shipped_topology("shuttle-split.toml");
    let text = format!(
        "extends = \"{}\"\n[hosts.control-pc]\nclock_address = \"127.0.0.1\"\n[hosts.robot-pc]\n\
         clock_address = \"10.78.0.2\"\nclock_interface = \"eth1\"\nclock_port = 7500\n",
        base.display()
    );
    let path = folder.write("with-clocks.toml", &text);
    let path = path.to_str().unwrap();
    let run = |arguments: &[&str]| {
        let mut command = Command::new(hil_runtime_binary());
        command.args(arguments).env_remove("HIL_HOST");
        let mut child = ChildGuard::spawn(&mut command).unwrap();
        let finished = child.wait_within(LIMIT).unwrap();
        finished.assert_success();
        finished.stdout
    };
    let checked = run(&["--topology", path, "--check"]);
    for words in [
        "clock_interface = \"eth1\"",
        "# clock path 127.0.0.1 <-> 10.78.0.2 (eth1), UDP ports 7390 and 7500",
    ] {
        assert!(checked.contains(words), "{words:?} is missing:\n{checked}");
    }
    let examined = |host| run(&["doctor", "--json", "--topology", path, "--host", host]);
    let here = examined("control-pc");
    assert!(
        here.contains("127.0.0.1 on lo, UDP from port 7390"),
        "{here}"
    );
    let missing = examined("robot-pc");
    assert!(missing.contains("no interface has 10.78.0.2"), "{missing}");
    assert!(!run(&["doctor", "--json"]).contains("clock_path"));
}
