//! The real binary over an emulated link: it loses and delays what it was told to, and the account
//! shows it.

use std::time::Duration;

use hil_account::{ChannelAccount, MessageFate, Stage};
use hil_report::summary::{ChannelSummary, LinkKind, Outcome};
use hil_stats::statistics::clopper_pearson;
use hil_tests::account::{
    account, assert_accounts_close, assert_every_message_is_accounted_for, carried, channel,
    describe,
};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::Trial;

const LIMIT: Duration = Duration::from_mins(1);
/// The channels with a message per frame or cycle; the motion server's have a few per run.
const CROSSING: [&str; 4] = [
    "egm/right/command",
    "egm/left/command",
    "egm/right/feedback",
    "egm/left/feedback",
];
const LOSS_RATIO: f64 = 0.1;
const DELAY_NS: i64 = 50_000_000;
const CONFIDENCE: f64 = 0.999;

#[test]
fn an_emulated_link_loses_and_delays_what_it_was_told_to() {
    let record = RunFolder::new("emulated");
    let trial = Trial::shipped("emulated.toml", record.path())
        .on_own_ports(&["hop"])
        .set("run.duration=\"6 s\"");
    let mut child = trial.start_here();
    child.wait_within(LIMIT).unwrap().assert_success();
    let files = trial.folder("", LIMIT);
    files.assert_nothing_left_here();
    let summary = files.summary();
    assert_eq!(summary.run.outcome, Outcome::Completed);
    for channel in carried(&summary) {
        println!(
            "{}",
            describe(&channel.name, account(&summary, &channel.name))
        );
    }
    assert_every_message_is_accounted_for(&summary);
    assert_accounts_close(&summary);
    assert_eq!(account(&summary, "human/frame").fates.lost_count(), 0);
    for name in CROSSING {
        let channel = channel(&summary, name);
        assert_eq!(channel.link, LinkKind::Emulated);
        check_loss(channel, account(&summary, name));
        check_delay(name, account(&summary, name));
    }
}

/// Losses are those of the link model, and as many as its ratio allows.
fn check_loss(channel: &ChannelSummary, account: &ChannelAccount) {
    let counters = channel.ends.iter().flat_map(|one| &one.counters);
    let count_of = |name: &str| -> u64 {
        let chosen = counters.clone().filter(|counter| counter.label() == name);
        chosen.map(|counter| counter.count).sum()
    };
    let emulated_count = count_of("socket: link_lost_count");
    let offered_count = emulated_count + count_of("delivered_count");
    let interval = clopper_pearson(emulated_count, offered_count, CONFIDENCE).unwrap();
    println!(
        "{}: {emulated_count} of {offered_count} lost on the emulated link: {:.4} [{:.4}, {:.4}]",
        channel.name,
        emulated_count as f64 / offered_count as f64,
        interval.low,
        interval.high
    );
    assert!(
        (interval.low..=interval.high).contains(&LOSS_RATIO),
        "{LOSS_RATIO} is not in {interval:?}"
    );
    assert_eq!(count_of("socket: link_overflow_count"), 0);
    // A message lost just before the end may still have been under way, for all the account knows.
    let lost_count = account.fates.of(MessageFate::LostOnWire);
    let in_flight_count = account.fates.of(MessageFate::InFlight);
    assert!(
        (lost_count..=lost_count + in_flight_count).contains(&emulated_count),
        "{emulated_count} emulated, {lost_count} lost, {in_flight_count} in flight"
    );
}

/// The model holds a datagram back between the kernel's stamp and its delivery to the gateway.
fn check_delay(name: &str, account: &ChannelAccount) {
    let ends = (Stage::RxSoftware, Stage::Received);
    let mut segments = account.segments.iter();
    let held = segments.find(|segment| (segment.from, segment.to) == ends);
    let held = held.and_then(|segment| segment.distribution.measured());
    let end_to_end = account.end_to_end.distribution.measured();
    for (what, figures) in [("held back", held), ("end to end", end_to_end)] {
        let figures = figures.unwrap_or_else(|| panic!("{name} has no figures of {what}"));
        println!(
            "{name} {what}: {} to {} ns, median {} ns",
            figures.min_ns, figures.max_ns, figures.p50_ns
        );
        // Histograms keep three digits and round down; stamps of two clocks differ by a microsecond.
        assert!(figures.min_ns >= DELAY_NS - DELAY_NS / 500, "{figures:?}");
    }
}
