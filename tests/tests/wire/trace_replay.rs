//! The loop closes: a live run over a link with bursts leaves its traces, and the same case in
//! virtual time over those traces loses the same messages and comes to the same score. And what
//! `hil-runtime trace` says of traces that are whole, damaged or none.

use std::path::Path;
use std::process::{Command, Output};
use std::time::Duration;
use std::{env, fs};

use hil_core::interval::Spread;
use hil_report::summary::{RunSummary, ScoreMetric};
use hil_tests::account::{account, assert_every_message_is_accounted_for, describe};
use hil_tests::binary::hil_runtime_binary;
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::{CHANNELS, emulated_shuttle, forwarded, trace_of};
use hil_tests::trial::{RunFiles, Trial};
use hil_trace::{Trace, TraceFate, TraceHeader, TraceRecord, wire};
use serde_json::Value;

/// Names how long the live runs last, e.g. 60.
const SECONDS_VARIABLE: &str = "HIL_TRACE_SECONDS";
/// The channels with a message per frame or cycle, each with the messages per second that it carries
/// at least: four in five of what a punctual process publishes.
const TELEOPERATION_CHANNELS: [(&str, u64); 4] = [
    ("egm/right/command", 100),
    ("egm/left/command", 100),
    ("egm/right/feedback", 200),
    ("egm/left/feedback", 200),
];
/// A few messages per run, as many as the arms ask for.
const RARE_CHANNELS: [&str; 2] = ["motion/request", "motion/response"];
/// What the servo makes of the commands over a perfect channel: by definition no link has a share in
/// it. It depends on where in its cycle the robot was when the human began, which live is chance and
/// in virtual time is not, and over a minute its interval is narrow enough to tell.
const NOT_OF_THE_LINK: &str = "joint_error_controller_rad_rms";
/// A link with bursts and outages.
const BURSTS: &str = r#"delay = "5 ms"
outages = { mean = "300 ms", per_hour = 600 }
[links.hop.loss]
law = "gilbert-elliott"
to_bad = 0.02
to_good = 0.2
bad_loss_ratio = 0.9
good_loss_ratio = 0.005
"#;
/// Virtual time goes on for so much longer than the live run, so that every record of its traces is
/// met, whatever the live processes missed.
const LONGER_S: u64 = 3;

fn seconds(default: u64) -> u64 {
    let asked = env::var(SECONDS_VARIABLE).ok();
    asked.map_or(default, |text| text.parse().unwrap())
}

fn run(arguments: &[&str]) -> Output {
    let mut command = Command::new(hil_runtime_binary());
    command.args(arguments).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// The live run.
fn live(trial: &Trial, limit: Duration) -> RunFiles {
    let mut child = trial.start_here();
    child.wait_within(limit).unwrap().assert_success();
    let files = trial.folder("", limit);
    files.assert_nothing_left_here();
    assert_every_message_is_accounted_for(&files.summary());
    files
}

/// `seconds` of virtual time over the traces of `files`, its messages matched by `matching`.
fn replayed(trial: &Trial, files: &RunFiles, matching: &str, seconds: u64) -> Value {
    let output_folder = RunFolder::new("trace-replayed");
    let simulated = output_folder.join("simulated");
    let folder = files.root().join("traces");
    let replay = trial
        .clone()
        .set(&format!("run.duration=\"{seconds} s\""))
        .set(&format!("links.hop.trace.folder=\"{}\"", folder.display()))
        .set(&format!("links.hop.trace.match=\"{matching}\""))
        .set("links.hop.trace.end=\"perfect\"");
    let mut simulate = Command::new(hil_runtime_binary());
    simulate
        .arg("simulate")
        .args(replay.arguments())
        .arg("--output")
        .arg(&simulated);
    let output = simulate.output().unwrap();
    assert!(output.status.success(), "{}", text(&output.stderr));
    serde_json::from_slice(&fs::read(simulated.join("summary.json")).unwrap()).unwrap()
}

/// One channel of a summary.
fn channel_of<'a>(summary: &'a Value, channel: &str) -> &'a Value {
    let mut channels = summary["channels"].as_array().unwrap().iter();
    channels.find(|one| one["name"] == channel).unwrap()
}

/// Equal counts for the same departures: every message that the live run published is met once, and
/// what the link delivered and lost live it delivers and loses in virtual time. `least_count` is how
/// many there must be of them.
fn check_counts(files: &RunFiles, virtual_time: &Value, channel: &str, least_count: u64) {
    let summary = files.summary();
    let live = account(&summary, channel);
    println!("live {}", describe(channel, live));
    let trace = trace_of(files, channel);
    let counts = trace.counts();
    let forwarded_count = forwarded(files, channel).len() as u64;
    assert_eq!(trace.records.len() as u64, live.published_count);
    assert_eq!(counts.delivered_count, forwarded_count, "{channel}");
    assert!(live.published_count >= least_count, "{channel}");
    let virtually = channel_of(virtual_time, channel);
    let replay = &virtually["trace_replay"];
    let met = |key: &str| replay[key].as_u64().unwrap();
    let published_count = virtually["account"]["published_count"].as_u64().unwrap();
    let fates = &virtually["account"]["fates"];
    let lost_virtually = fates["lost_on_wire"].as_u64().unwrap_or(0);
    println!(
        "{channel} by {}: live {} published, {forwarded_count} delivered, {} lost, {} unknown; in \
         virtual time {published_count} published, {} met a record, {} delivered, {} lost, {} \
         unknown, {} at ticks nobody published at, {} at one for the second time, {} after the end",
        replay["matching"],
        live.published_count,
        counts.lost_count(),
        counts.unknown_count,
        met("met_count"),
        met("delivered_count"),
        met("lost_count"),
        met("unknown_count"),
        met("unpublished_count"),
        met("repeated_count"),
        met("beyond_end_count")
    );
    assert_eq!(met("offered_count"), published_count);
    assert!(met("beyond_end_count") > 0, "{replay}");
    assert_eq!(met("repeated_count"), 0, "{replay}");
    // By tick, of two that a host held up for long published as one only the first may be met.
    let unmet_count = live.published_count - met("met_count");
    let is_by_tick = replay["matching"] == "tick";
    assert!(
        unmet_count
            <= if is_by_tick {
                live.published_count / 100
            } else {
                0
            }
    );
    for (what, live_count) in [
        ("delivered_count", forwarded_count),
        ("lost_count", counts.lost_count()),
        ("unknown_count", counts.unknown_count),
    ] {
        let expected = live_count.saturating_sub(unmet_count)..=live_count;
        assert!(
            expected.contains(&met(what)),
            "{what} of {replay}, live {live_count}"
        );
    }
    // What the driver of virtual time counted, against what the link says it did: nothing is lost
    // after the end of the trace.
    let lost_count = met("lost_count") + met("unknown_count") + met("unpublished_count");
    assert_eq!(lost_virtually, lost_count);
}

/// The same of a channel that is asked for a message now and then: virtual time may ask more or less
/// often, and the n-th message of both meets the same.
fn check_rare(files: &RunFiles, virtual_time: &Value, channel: &str) {
    let trace = trace_of(files, channel);
    let replay = &channel_of(virtual_time, channel)["trace_replay"];
    println!("{channel}: {} live; {replay}", trace.records.len());
    let met = |key: &str| replay[key].as_u64().unwrap();
    let same_count = met("offered_count").min(trace.records.len() as u64);
    assert!(same_count > 0, "{replay}");
    assert_eq!(met("met_count"), same_count);
    let same = &trace.records[..usize::try_from(same_count).unwrap()];
    let of = |is: fn(TraceFate) -> bool| same.iter().filter(|one| is(one.fate)).count() as u64;
    let delivered_count = of(|fate| fate == TraceFate::Delivered);
    assert_eq!(met("delivered_count"), delivered_count);
    assert_eq!(met("lost_count"), of(TraceFate::is_loss));
}

/// Of two scores with intervals, live and in virtual time, one lies in the interval of the other.
fn check_scores(summary: &RunSummary, virtual_time: &Value) {
    let simulated = virtual_time["score"].as_array().unwrap();
    for metric in &summary.score {
        let other = simulated.iter().find(|one| one["name"] == metric.name);
        let other = other.unwrap_or_else(|| panic!("no {} in virtual time", metric.name));
        let ScoreMetric {
            name,
            value,
            interval,
            ..
        } = metric;
        let other_value = other["value"].as_f64();
        let [low, high] = ["low", "high"].map(|end| other["interval"][end].as_f64());
        let other_interval = low.zip(high);
        let interval = interval.and_then(Spread::known);
        let interval = interval.map(|one| (one.low, one.high));
        println!("{name}: live {value:?} {interval:?}, virtual {other_value:?} {other_interval:?}");
        let (Some(live), Some(virtually)) = (*value, other_value) else {
            continue;
        };
        let (Some(of_live), Some(of_virtual)) = (interval, other_interval) else {
            continue;
        };
        if name == NOT_OF_THE_LINK {
            continue;
        }
        let is_inside = |x: f64, (low, high): (f64, f64)| (low..=high).contains(&x);
        let agree = is_inside(live, of_virtual) || is_inside(virtually, of_live);
        assert!(agree, "{name}: the replay does not agree with the run");
    }
}

#[test]
fn a_live_shuttle_run_and_its_replay_agree() {
    let record = RunFolder::new("trace-shuttle");
    let topology = record.write("bursts.toml", &emulated_shuttle("bursts", BURSTS));
    let duration = seconds(12);
    let trial =
        Trial::of(&topology, &record.join("runs")).set(&format!("run.duration=\"{duration} s\""));
    let limit = Duration::from_secs(60 + 2 * duration);
    let files = live(&trial, limit);
    for matching in ["index", "tick"] {
        let virtual_time = replayed(&trial, &files, matching, duration + LONGER_S);
        for channel in CHANNELS {
            let replay = &channel_of(&virtual_time, channel)["trace_replay"];
            assert_eq!(replay["matching"], matching);
            // Four in five of what a punctual process publishes.
            check_counts(&files, &virtual_time, channel, 80 * duration);
        }
    }
    for channel in CHANNELS {
        let counts = trace_of(&files, channel).counts();
        assert!(counts.lost_count() > 4 * duration, "{counts:?}");
        assert!(counts.delivered_count > 50 * duration, "{counts:?}");
    }
    let by_tick = replayed(&trial, &files, "tick", duration);
    // Without an interval the cart's error says nothing here: when in a period of the controller the robot ticks
    // is chance in a live run, and shifts the error by as much as the link makes it.
    check_scores(&files.summary(), &by_tick);
    let folder = files.root().display().to_string();
    let info = run(&["trace", "info", &folder]);
    assert!(info.status.success(), "{}", text(&info.stderr));
    println!("{}", text(&info.stdout));
    let fit = run(&["trace", "fit", &folder]);
    assert!(fit.status.success(), "{}", text(&fit.stderr));
    println!("{}{}", text(&fit.stderr), text(&fit.stdout));
    let report = files.read("report-full.txt");
    assert!(report.contains("traces/"), "{report}");
}

#[test]
fn a_live_teleoperation_run_and_its_replay_agree() {
    let record = RunFolder::new("trace-teleoperation");
    let duration = seconds(15);
    let trial = Trial::shipped("outages.toml", record.path())
        .set(&format!("run.duration=\"{duration} s\""))
        .set("run.seed=11")
        .on_own_ports(&["hop"])
        .set("links.hop.outages.mean=\"400 ms\"")
        .set("links.hop.outages.per_hour=900");
    let limit = Duration::from_secs(60 + 2 * duration);
    let files = live(&trial, limit);
    let by_index = replayed(&trial, &files, "index", duration + LONGER_S);
    let by_tick = replayed(&trial, &files, "tick", duration + LONGER_S);
    for (channel, least_count) in TELEOPERATION_CHANNELS {
        check_counts(&files, &by_index, channel, least_count * duration);
        let counts = trace_of(&files, channel).counts();
        assert!(
            counts.lost_count() > least_count * duration / 50,
            "{channel}: {counts:?}"
        );
    }
    for channel in ["egm/right/command", "egm/left/command"] {
        assert_eq!(
            channel_of(&by_tick, channel)["trace_replay"]["matching"],
            "tick"
        );
        check_counts(&files, &by_tick, channel, 100 * duration);
    }
    for channel in RARE_CHANNELS {
        check_rare(&files, &by_index, channel);
    }
    let by_tick = replayed(&trial, &files, "tick", duration);
    // Of a quarter of a minute no score has an interval.
    check_scores(&files.summary(), &by_tick);
}

/// A trace of 300 messages, a third of them lost.
fn written(folder: &RunFolder) -> std::path::PathBuf {
    let record = |index: u64| {
        let published_ns = i64::try_from(index).unwrap() * 10_000_000;
        let mut record = TraceRecord::published(published_ns, index, 16);
        if index.is_multiple_of(3) {
            record.fate = TraceFate::LostInNetwork;
        } else {
            record = record.delivered(5_000_000 + published_ns % 7_000, 0);
        }
        record
    };
    let trace = Trace {
        header: TraceHeader::new("shuttle/command"),
        records: (0..300).map(record).collect(),
    };
    let path = folder.join("shuttle.command.trace");
    fs::write(&path, wire::encode(&trace).unwrap()).unwrap();
    path
}

fn name(path: &Path) -> String {
    path.display().to_string()
}

#[test]
fn a_damaged_trace_is_shown_up_to_the_offset_of_its_fault() {
    let folder = RunFolder::new("trace-damaged");
    let path = written(&folder);
    let good = fs::read(&path).unwrap();
    let info = |bytes: &[u8]| {
        let path = folder.join("damaged.trace");
        fs::write(&path, bytes).unwrap();
        run(&["trace", "info", "--json", &name(&path)])
    };
    let mut swapped = good.clone();
    swapped[384 + 64 * 7..384 + 64 * 9].rotate_left(64);
    let mut flipped = good.clone();
    flipped[384 + 64 * 20 + 3] ^= 1;
    for (bytes, offset, kept) in [
        (&good[..good.len() - 5], 384 + 64 * 299, 299),
        (&swapped[..], 384 + 64 * 7 + 56, 7),
        (&flipped[..], 384 + 64 * 20, 20),
    ] {
        let output = info(bytes);
        assert_eq!(output.status.code(), Some(1), "{}", text(&output.stderr));
        let complaint = text(&output.stderr);
        assert!(
            complaint.contains(&format!("byte {offset}: ")),
            "{complaint}"
        );
        let shown: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(shown[0]["figures"]["counts"]["message_count"], kept);
    }
    let foreign = info(&[0xd4, 0xc3, 0xb2, 0xa1, 2, 0, 4, 0].repeat(60));
    assert_eq!(foreign.status.code(), Some(2));
    let complaint = text(&foreign.stderr);
    assert!(complaint.contains("byte 0: not a trace"), "{complaint}");
    assert_eq!(
        run(&["trace", "info", "/no/such.trace"]).status.code(),
        Some(2)
    );
}

#[test]
fn a_trace_goes_to_csv_and_back_without_a_change_and_says_what_other_forms_lose() {
    let folder = RunFolder::new("trace-convert");
    let path = written(&folder);
    let (csv, back) = (folder.join("a.csv"), folder.join("b.trace"));
    for (from, into) in [(&path, &csv), (&csv, &back)] {
        let output = run(&["trace", "convert", &name(from), &name(into)]);
        assert!(output.status.success(), "{}", text(&output.stderr));
    }
    assert_eq!(fs::read(&path).unwrap(), fs::read(&back).unwrap());
    let again = run(&["trace", "convert", &name(&path), &name(&csv)]);
    assert_eq!(again.status.code(), Some(2), "an existing file is kept");
    let mahimahi = folder.join("a.mahimahi");
    let output = run(&["trace", "convert", &name(&path), &name(&mahimahi)]);
    assert!(
        text(&output.stderr).contains("not kept: delays"),
        "{output:?}"
    );
    assert_eq!(fs::read_to_string(&mahimahi).unwrap().lines().count(), 200);
    let info = run(&["trace", "info", &name(&mahimahi)]);
    assert!(text(&info.stdout).contains("200 published"), "{info:?}");
    let plots = folder.join("plots");
    let output = run(&["trace", "plot", &name(&path), "--output", &name(&plots)]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert!(plots.join("shuttle.command/cdf.csv").is_file());
    let fit = run(&["trace", "fit", &name(&path), "--link", "wlan"]);
    assert!(text(&fit.stdout).contains("[links.wlan"), "{fit:?}");
}

#[test]
fn a_topology_with_a_missing_or_damaged_trace_starts_nothing() {
    let folder = RunFolder::new("trace-missing");
    let with = "\n[links.hop.trace]\nfolder = \"traces\"\n";
    let text_of = emulated_shuttle("replay", &format!("{BURSTS}{with}"));
    let topology = folder.write("replay.toml", &text_of);
    let check = run(&["--topology", &name(&topology), "--check"]);
    assert_eq!(check.status.code(), Some(2));
    let complaint = text(&check.stderr);
    assert!(
        complaint.contains("links.hop.trace.folder cannot be used: trace ")
            && complaint.contains("replay.toml:25:10")
            && complaint.contains("traces/shuttle.command.trace"),
        "{complaint}"
    );
    fs::create_dir(folder.join("traces")).unwrap();
    let good = fs::read(written(&folder)).unwrap();
    for channel in ["shuttle.command", "shuttle.status"] {
        let path = folder.join(format!("traces/{channel}.trace"));
        fs::write(path, &good[..good.len() - 64]).unwrap();
    }
    let simulate = run(&["simulate", "--topology", &name(&topology)]);
    assert_eq!(simulate.status.code(), Some(2));
    let complaint = text(&simulate.stderr);
    assert!(
        complaint.contains("ends after 299 of 300 records"),
        "{complaint}"
    );
}
