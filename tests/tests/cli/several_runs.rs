//! Runs side by side on one PC: none sees another, whatever their names.

use std::time::Duration;

use hil_report::summary::Outcome;
use hil_tests::account::{account, assert_accounts_close, assert_every_message_is_accounted_for};
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::emulated_shuttle;
use hil_tests::trial::{RunFiles, Trial};

const LIMIT: Duration = Duration::from_mins(1);

/// All three bear one name and begin in one second, so even the names of their folders are equal;
/// two have the same channels, the third has channels of the same case at another rate.
#[test]
fn runs_side_by_side_do_not_see_each_other() {
    let records = ["first", "second", "third"].map(RunFolder::new);
    let trial = |index: usize| {
        let trial = Trial::shipped("local.toml", records[index].path());
        trial.set("run.duration=\"3 s\"")
    };
    let trials = [
        trial(0),
        trial(1),
        trial(2).set("case.parameters.rate_hz=50.0"),
    ];
    let mut children = trials.clone().map(|trial| trial.start_here());
    for child in &mut children {
        child.wait_within(LIMIT).unwrap().assert_success();
    }
    let files = trials.map(|trial| trial.folder("", LIMIT));
    let mut domains: Vec<String> = files
        .iter()
        .flat_map(RunFiles::domains)
        .map(|domain| domain.to_string())
        .collect();
    domains.sort();
    domains.dedup();
    assert_eq!(domains.len(), 3, "{domains:?}");
    for files in &files {
        let summary = files.summary();
        assert_eq!(summary.run.outcome, Outcome::Completed);
        assert_every_message_is_accounted_for(&summary);
        assert_accounts_close(&summary);
        // A stranger's messages would make two epochs of one channel, or more taken than ticked.
        for (channel, role) in [("human/frame", "human"), ("egm/right/feedback", "robot")] {
            let account = account(&summary, channel);
            assert_eq!(account.producer_restart_count, 0, "{channel}");
            let mut processes = summary.processes.iter();
            let producer = processes.find(|process| process.name == role).unwrap();
            let tick_count = producer.tick_count.unwrap();
            println!("{}: {channel}, {tick_count} ticks", files.root().display());
            assert!(account.published_count <= tick_count + 1, "{account:?}");
        }
        files.assert_nothing_left_here();
    }
}

#[test]
fn of_two_topologies_with_one_port_the_second_is_refused_with_the_key_to_change() {
    let record = RunFolder::new("one-port");
    let text = emulated_shuttle("first", "").replace("12 s", "6 s");
    let files = [text.clone(), text.replace("first", "second")];
    let [first, second] = files.map(|text| {
        let name = if text.contains("first") {
            "first"
        } else {
            "second"
        };
        let topology = record.write(format!("{name}.toml"), &text);
        Trial::of(&topology, &record.join(name))
    });
    let mut running = first.start_here();
    let files = first.folder("", LIMIT);
    for trial in [&second, &first] {
        let refused = trial.start_here().wait_within(LIMIT).unwrap();
        println!("{}", refused.stderr);
        refused.assert_code(75);
        let (root, process) = (files.root().display(), running.pid());
        let told = format!("is held by hil-runtime (process {process}), the run in {root};");
        assert!(
            refused.stderr.contains("links.hop.port"),
            "{}",
            refused.stderr
        );
        assert!(refused.stderr.contains(&told), "{}", refused.stderr);
    }
    running.wait_within(LIMIT).unwrap().assert_success();
    let summary = files.summary();
    assert_eq!(summary.run.outcome, Outcome::Completed);
    assert_every_message_is_accounted_for(&summary);
    assert!(!record.join("second").exists());
    let own = second
        .set("links.hop.port=24999")
        .set("run.duration=\"1 s\"");
    own.start_here()
        .wait_within(LIMIT)
        .unwrap()
        .assert_success();
}
