//! The real binary asked for hardware stamps on a cable without a card: what is not there is said,
//! and nothing else of the run suffers. Cards that stamp need emulated PCs:
//! `tests/lab/hardware-stamps.sh`.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::time::Duration;

use hil_runtime::report::summary::Outcome;
use hil_tests::account::{account, assert_accounts_close, assert_every_message_is_accounted_for};
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::Trial;

const START_LIMIT: Duration = Duration::from_mins(1);
const RUN_LIMIT: Duration = Duration::from_mins(2);

#[test]
fn on_a_veth_the_missing_card_is_said_and_software_stamps_carry_the_run() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("hardware-stamps");
    let trial = Trial::shipped("shuttle-split.toml", record.path())
        .set("run.duration=\"3 s\"")
        .set("links.hop.timestamps=\"hardware\"");
    let mut hosts = [0, 1].map(|index| trial.start_on(lab.host(index)));
    let files = trial.folder("-control-pc", START_LIMIT);
    for host in &mut hosts {
        host.wait_within(RUN_LIMIT).unwrap().assert_success();
    }
    let summary = files.summary();
    assert_eq!(summary.run.outcome, Outcome::Completed, "{:?}", summary.run);
    assert_every_message_is_accounted_for(&summary);
    assert_accounts_close(&summary);

    let stamps = summary.hardware_stamps.as_ref().unwrap();
    let hosts: Vec<&str> = stamps
        .cards
        .iter()
        .map(|card| card.story.host.as_str())
        .collect();
    assert_eq!(hosts, ["control-pc", "robot-pc"]);
    for card in &stamps.cards {
        assert!(!card.story.is_armed, "{card:?}");
        assert!(card.story.arming.contains("veth"), "{card:?}");
        assert!(card.story.clock.contains("no clock of its own"), "{card:?}");
        assert_eq!(card.clock, None);
    }
    assert_eq!(stamps.channels.len(), 2);
    for channel in &stamps.channels {
        let counted = [channel.tx_hardware_count, channel.rx_hardware_count];
        assert_eq!(counted, [0, 0], "{channel:?}");
        assert!(channel.rx_reason.contains("not armed"), "{channel:?}");
        assert!(channel.sent_count > 0, "{channel:?}");
        let unavailable = channel
            .segments
            .iter()
            .all(|segment| segment.distribution.measured().is_none());
        assert!(unavailable, "{channel:?}");
        let software = account(&summary, &channel.channel).coverage.tx_software;
        assert_ne!(software.unwrap().stamped_count, 0, "{channel:?}");
    }
    assert!(files.read("report.txt").contains("Hardware stamps"));
}
