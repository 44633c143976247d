//! The real binary on two hosts with its channels over TCP: every message accounted for.

use hil_report::summary::{DirectionSummary, LinkKind};
use hil_tests::account::{account, assert_accounts_close, channel};
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::CHANNELS;
use hil_tests::split::{Split, direction};
use hil_tests::trial::Trial;

fn count(direction: &DirectionSummary, name: &str) -> u64 {
    let mut all = direction.counters.iter();
    let found = all.find(|one| one.label() == name);
    found
        .unwrap_or_else(|| panic!("no {name} in {:?}", direction.counters))
        .count
}

fn fact<'a>(direction: &'a DirectionSummary, label: &str) -> &'a str {
    let mut all = direction.facts.iter();
    let found = all.find(|one| one.label == label);
    &found
        .unwrap_or_else(|| panic!("no {label} in {:?}", direction.facts))
        .value
}

#[test]
fn a_run_over_tcp_accounts_for_every_message_and_loses_none() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("tcp");
    // Deep enough for all that comes at once after a standstill.
    let trial = Trial::shipped("shuttle-tcp.toml", record.path())
        .set("run.duration=\"5 s\"")
        .set("channels.\"shuttle/command\".depth=256")
        .set("channels.\"shuttle/status\".depth=256");
    let split = Split::start(&lab, &trial);
    let page = split.files[0].clone();
    for summary in &split.finish() {
        assert_accounts_close(summary);
        for name in CHANNELS {
            assert_eq!(channel(summary, name).link, LinkKind::named("tcp").unwrap());
            let account = account(summary, name);
            assert_eq!(account.fates.lost_count(), 0);
            assert_eq!(account.reordered_count, Some(0));
            assert_eq!(account.duplicated_count, Some(0));
            let coverage = account.coverage;
            for stamps in [coverage.tx_software, coverage.rx_software] {
                let ratio = stamps.and_then(|stamps| stamps.ratio());
                assert!(ratio.is_none_or(|ratio| ratio < f64::EPSILON), "{stamps:?}");
            }
            let egress = direction(summary, name, "egress");
            assert_eq!(count(egress, "transport: connection_count"), 1);
            assert_eq!(count(egress, "transport: reconnect_count"), 0);
            assert!(fact(egress, "kernel stamps").starts_with("unavailable over TCP"));
            assert!(egress.stalls.unwrap().threshold_ns > 50_000_000);
            println!("{name}: {:?}", egress.facts);
            let ingress = direction(summary, name, "ingress");
            assert_eq!(count(ingress, "transport: bad_frame_count"), 0);
            assert_eq!(count(ingress, "transport: foreign_connection_count"), 0);
            let round_trip = account.round_trip.measured();
            assert!(round_trip.is_some_and(|figures| figures.count > 10));
        }
    }
    let report = page.read("report-full.txt");
    assert!(report.contains("controller → robot · TCP"), "{report}");
    assert!(report.contains("\n  stalls "), "{report}");
}
