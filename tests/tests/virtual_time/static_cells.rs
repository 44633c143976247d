//! The seed paper's static network, loss 0 and 0.1 by delay 0, 10, 50 and 100 ms, from a shipped
//! topology in virtual time: the delay is exact, the losses are binomial.

use std::fs;
use std::process::Command;
use std::time::Duration;

use hil_account::MessageFate;
use hil_report::summary::RunSummary;
use hil_stats::statistics::clopper_pearson;
use hil_tests::binary::hil_runtime_binary;
use hil_tests::child::ChildGuard;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::shipped_topology;

const LIMIT: Duration = Duration::from_mins(3);
/// Each with the messages that a minute of the fleet sends on it at least: grants and missions are
/// few, states come all the time.
const CHANNELS: [(&str, u64); 3] = [
    ("fleet/authority", 250),
    ("fleet/mission", 10),
    ("fleet/state", 10_000),
];
/// Of each of some two dozen intervals: one in a thousand runs of this test would be at fault, and
/// the seed is fixed.
const CONFIDENCE: f64 = 0.99995;
/// From end to end of the interval of a cell's loss ratio: one that is off by a quarter shows.
const INTERVAL_MAX: f64 = 0.025;

fn simulate(delay_ms: u64, loss_ratio: f64) -> RunSummary {
    let record = RunFolder::new("static-cells");
    let folder = record.join("simulated");
    let topology = shipped_topology("static-cells.toml");
    let mut command = Command::new(hil_runtime_binary());
    command
        .args(["simulate", "--topology"])
        .arg(topology)
        .arg("--output")
        .arg(&folder);
    for set in [
        "run.duration=60 s".to_owned(),
        format!("links.hop.delay={delay_ms} ms"),
        format!("links.hop.loss_ratio={loss_ratio}"),
    ] {
        command.arg("--set").arg(set);
    }
    let mut child = ChildGuard::spawn(&mut command).unwrap();
    let finished = child.wait_within(LIMIT).unwrap();
    finished.assert_success();
    let text = fs::read_to_string(folder.join("summary.json")).unwrap();
    RunSummary::from_json(&text).unwrap()
}

#[test]
fn the_papers_static_cells_lose_and_delay_as_they_say() {
    for loss_ratio in [0.0, 0.1] {
        for delay_ms in [0, 10, 50, 100] {
            let summary = simulate(delay_ms, loss_ratio);
            let (mut offered_count, mut lost_count) = (0, 0);
            for (name, least_count) in CHANNELS {
                let (offered, lost) = check(&summary, name, least_count, delay_ms, loss_ratio);
                offered_count += offered;
                lost_count += lost;
            }
            let interval = clopper_pearson(lost_count, offered_count, CONFIDENCE).unwrap();
            println!("{delay_ms} ms, {loss_ratio}: {lost_count} of {offered_count}, {interval:?}");
            assert!(interval.high - interval.low < INTERVAL_MAX, "{interval:?}");
            assert!((interval.low..=interval.high).contains(&loss_ratio));
        }
    }
}

/// Checks one channel; gives how many messages it offered to the link and how many that lost.
fn check(
    summary: &RunSummary,
    name: &str,
    least_count: u64,
    delay_ms: u64,
    loss_ratio: f64,
) -> (u64, u64) {
    let channel = summary.channels.iter().find(|one| one.name == name);
    let channel = channel.unwrap();
    let account = channel.account.as_ref().unwrap();
    let counters = channel.ends.iter().flat_map(|one| &one.counters);
    let by_chance: Vec<u64> = counters
        .filter(|counter| counter.name == "link_chance_lost_count")
        .map(|counter| counter.count)
        .collect();
    let (offered_count, lost_count) = (account.published_count, account.fates.lost_count());
    let networks = &summary.network.as_ref().unwrap().channels;
    let network = networks.iter().find(|one| one.channel == name).unwrap();
    let delay = network.figures.delay.measured().unwrap();
    println!(
        "{delay_ms} ms, {loss_ratio}: {name} lost {lost_count} of {offered_count}, delay {} ns",
        delay.p50.value_ns
    );
    assert!(offered_count >= least_count, "{account:?}");
    assert_eq!(account.fates.total(), offered_count);
    assert_eq!(account.fates.of(MessageFate::LostOnWire), lost_count);
    assert_eq!(by_chance, [lost_count]);
    let expected_ns = i64::try_from(delay_ms * 1_000_000).unwrap();
    assert_eq!((delay.min_ns, delay.max_ns), (expected_ns, expected_ns));
    if loss_ratio > 0.0 {
        let interval = clopper_pearson(lost_count, offered_count, CONFIDENCE).unwrap();
        assert!(
            (interval.low..=interval.high).contains(&loss_ratio),
            "{lost_count} of {offered_count}"
        );
    } else {
        assert_eq!(lost_count, 0);
    }
    (offered_count, lost_count)
}
