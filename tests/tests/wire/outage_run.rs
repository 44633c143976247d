//! Outages of an emulated link: a run of the real binary and one in virtual time lose the same
//! spans when their seeds are equal.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use hil_account::MessageFate;
use hil_core::random::RandomStream;
use hil_core::record::{IngressRecord, PublishedRecord};
use hil_core::time::Instant;
use hil_link::outages::{Outage, OutageSchedule, Outages};
use hil_report::summary::{LinkKind, RunSummary};
use hil_tests::account::{account, assert_every_message_is_accounted_for, channel, describe};
use hil_tests::binary::hil_runtime_binary;
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::{CHANNELS, PERIOD_NS, SEED, emulated_shuttle, records};
use hil_tests::trial::{RunFiles, Trial};

const LIMIT: Duration = Duration::from_mins(1);
/// What one message may be off by: its period, and the time a process needs to begin.
const SLACK_NS: i64 = PERIOD_NS + 15_000_000;
const OUTAGES: Outages = Outages {
    mean_s: 0.3,
    per_hour: 2_400.0,
    buffered: false,
};
const LINK: &str = r#"delay = "5 ms"
outages = { mean = "300 ms", per_hour = 2400, buffered = false }"#;

/// The outages of the run, counted from its start.
fn outages(end: Instant) -> Vec<Outage> {
    let stream = RandomStream::new(SEED, "links.hop.outages");
    let schedule = OutageSchedule::new(OUTAGES, stream, Instant::ZERO).unwrap();
    schedule.take_while(|outage| outage.begin < end).collect()
}

/// When each message was published, counted from the first, and whether it came through.
fn lived(files: &RunFiles, channel: &str) -> Vec<(i64, bool)> {
    let published: Vec<PublishedRecord> = records(files, channel, "published");
    let received: Vec<IngressRecord> = records(files, channel, "ingress");
    let came: BTreeSet<u64> = received.iter().map(|one| one.sequence).collect();
    let first_ns = published.iter().map(|one| one.published_ns).min().unwrap();
    let at = |one: &PublishedRecord| one.published_ns - first_ns;
    let all = published.iter();
    all.map(|one| (at(one), came.contains(&one.sequence)))
        .collect()
}

/// True within an outage that is `by_ns` longer at both ends; shorter when negative.
fn is_within(outages: &[Outage], at_ns: i64, by_ns: i64) -> bool {
    outages
        .iter()
        .any(|outage| (outage.begin.as_ns() - by_ns..outage.end.as_ns() + by_ns).contains(&at_ns))
}

#[test]
fn a_live_run_loses_the_spans_that_virtual_time_loses() {
    let record = RunFolder::new("outages");
    let topology = record.write("outages.toml", &emulated_shuttle("outages", LINK));
    let trial = Trial::of(&topology, &record.join("runs"));
    let mut child = trial.start_here();
    child.wait_within(LIMIT).unwrap().assert_success();
    let files = trial.folder("", LIMIT);
    files.assert_nothing_left_here();
    let summary = files.summary();
    assert_every_message_is_accounted_for(&summary);
    let outages = outages(Instant::from_ns(11_500_000_000));
    assert!(outages.len() >= 4, "{outages:?}");
    let virtual_time = simulated(&trial, &record.join("simulated"), &[]);
    let simulated_network = serde_json::to_value(virtual_time.network.as_ref().unwrap()).unwrap();
    // Twelve seconds are too short to look for lags.
    let longer = ["--set", "run.duration=\"200 s\""];
    let longer = simulated(&trial, &record.join("longer"), &longer);
    assert_the_error_follows_the_silence(&longer);
    let live = serde_json::to_value(summary.network.as_ref().unwrap()).unwrap();
    for name in CHANNELS {
        assert_the_report_shows_what_preceded_what(&live, name);
        assert_the_report_shows_what_preceded_what(&simulated_network, name);
        let file = format!("series/network-{}.csv", name.replace('/', "-"));
        let table = fs::read_to_string(files.root().join(file)).unwrap();
        assert!(table.lines().count() > 100, "{table}");
        let account = account(&summary, name);
        println!("{}", describe(name, account));
        assert_eq!(channel(&summary, name).link, LinkKind::Emulated);
        let messages = lived(&files, name);
        let mut certain_count = 0;
        for &(at_ns, has_come) in messages.iter().filter(|(at_ns, _)| *at_ns < 11_500_000_000) {
            if is_within(&outages, at_ns, -SLACK_NS) {
                certain_count += 1;
                assert!(!has_come, "{name} at {at_ns} came through an outage");
            } else if !is_within(&outages, at_ns, SLACK_NS) {
                assert!(has_come, "{name} at {at_ns} was lost outside every outage");
            }
        }
        assert!(certain_count > 50, "{certain_count}");
        let lost_count = messages.iter().filter(|(_, has_come)| !has_come).count() as u64;
        let virtually = hil_tests::account::account(&virtual_time, name);
        let lost_virtually = virtually.fates.lost_count();
        let counters = channel(&summary, name).ends.iter();
        let emulated_count: u64 = counters
            .flat_map(|one| &one.counters)
            .filter(|one| one.label() == "socket: link_lost_count")
            .map(|one| one.count)
            .sum();
        println!(
            "{name}: {} of {} messages lost live, {emulated_count} of them by the model; {} of {} \
             in virtual time; {} outages",
            lost_count,
            messages.len(),
            lost_virtually,
            virtually.published_count,
            outages.len()
        );
        // One message at each end of each outage, and what was under way at the end.
        let tolerance = 2 * outages.len() as u64 + 2;
        assert!(lost_count.abs_diff(lost_virtually) <= tolerance);
        assert!(account.fates.of(MessageFate::LostOnWire) <= emulated_count);
        let carriers = summary.directions.iter();
        let facts = carriers
            .filter(|one| one.channels.iter().any(|channel| channel == name))
            .flat_map(|one| &one.facts);
        let told = facts.filter(|fact| {
            fact.value
                .contains("outages of 300 ms on average, 2400 per hour")
        });
        assert_eq!(told.count(), 1);
    }
}

/// The run in virtual time.
fn simulated(trial: &Trial, folder: &Path, settings: &[&str]) -> RunSummary {
    let mut command = Command::new(hil_runtime_binary());
    command.arg("simulate").args(trial.arguments());
    let output = command
        .args(settings)
        .arg("--output")
        .arg(folder)
        .output()
        .unwrap();
    assert!(output.status.success(), "{output:?}");
    let text = fs::read_to_string(folder.join("summary.json")).unwrap();
    RunSummary::from_json(&text).unwrap()
}

fn assert_the_error_follows_the_silence(summary: &RunSummary) {
    let network = serde_json::to_value(summary.network.as_ref().unwrap()).unwrap();
    let pair = pair_of(&network, "shuttle/command");
    println!("{pair}");
    let of = |key: &str| pair[key].as_f64().unwrap();
    // The cart drives on as it was told last until the silence is over.
    assert!((0.0..=1.0).contains(&of("lag_s")), "{pair}");
    assert!(of("coefficient") > 0.15, "{pair}");
    // The same figure each time: virtual time depends on nothing but the seed.
    assert!(of("p_family") <= 0.05, "{pair}");
}

/// `account` closes; what is shown here is what the report makes of it: which outage went before
/// the robot's error, and how long after it the error came.
fn assert_the_report_shows_what_preceded_what(network: &serde_json::Value, name: &str) {
    let figures = network["channels"]
        .as_array()
        .unwrap()
        .iter()
        .find(|one| one["channel"] == name)
        .unwrap();
    let figures = &figures["figures"];
    let delay_ns = figures["delay"]["p50"]["value_ns"].as_i64().unwrap();
    assert!(delay_ns >= 5_000_000, "{figures}");
    let loss = &figures["loss"];
    assert!(loss["ratio"].as_f64().unwrap() > 0.0, "{loss}");
    // Outages are too few for an interval, and it says so.
    assert!(loss["interval"]["needed"].is_u64(), "{loss}");
    let events = network["events"].as_array().unwrap().iter();
    let outages = events.filter(|one| one["channel"] == name && one["kind"] == "outage");
    assert!(outages.count() >= 3, "{}", network["events"]);
}

/// The tested pair of the cart's speed and the silence on `name`.
fn pair_of<'a>(network: &'a serde_json::Value, name: &str) -> &'a serde_json::Value {
    let pairs = network["correlation"]["pairs"].as_array().unwrap();
    let wanted = |one: &&serde_json::Value| {
        let is_speed = one["robot"] == "error of the cart's speed";
        is_speed && one["network"] == "silence" && one["channel"] == name
    };
    pairs.iter().find(wanted).unwrap()
}
