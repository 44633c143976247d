//! The real binary on two hosts: the teleoperated arm over a real UDP hop, started once on each,
//! compared with the same arm on one host.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;
use std::time::Duration;

use hil_account::ChannelAccount;
use hil_report::summary::{LinkKind, Outcome, RunSummary};
use hil_tests::account::{
    account, assert_accounts_close, assert_both_ends_are_stamped,
    assert_every_message_is_accounted_for, carried, channel, describe,
};
use hil_tests::binary::hil_runtime_binary;
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::split::{ARM_CHANNELS, Split, direction};
use hil_tests::trial::{RunFiles, Trial, wait_until};

/// The channels with a message per frame or cycle; the motion server's have a few per run.
const CROSSING: [&str; 4] = [
    "egm/right/command",
    "egm/left/command",
    "egm/right/feedback",
    "egm/left/feedback",
];
const START_LIMIT: Duration = Duration::from_mins(1);
const RUN_LIMIT: Duration = Duration::from_mins(2);

/// What a component is: the file it executes and the card it was given.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Component {
    program: Program,
    card: String,
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct Program {
    device: u64,
    inode: u64,
    length_bytes: u64,
    modified_ns: i64,
}

/// The file that the running component executes, found through the kernel, and its card.
fn component(files: &RunFiles, name: &str) -> Component {
    let mut path = None;
    wait_until(START_LIMIT, &format!("the {name}"), || {
        path = files
            .process(name, 0)
            .map(|pid| PathBuf::from(format!("/proc/{pid}/exe")));
        path.is_some()
    });
    let data = fs::metadata(path.unwrap()).unwrap();
    Component {
        program: Program {
            device: data.dev(),
            inode: data.ino(),
            length_bytes: data.len(),
            modified_ns: data.mtime_nsec(),
        },
        card: files.read(&format!("cards/{name}.json")),
    }
}

fn components(files: [&RunFiles; 2]) -> [Component; 2] {
    [
        component(files[0], "controller"),
        component(files[1], "robot"),
    ]
}

/// Runs the arm on two hosts.
fn split(record: &RunFolder) -> Option<([RunSummary; 2], [Component; 2])> {
    let lab = Lab::two_hosts_or_skip()?;
    let trial = Trial::shipped("split.toml", record.path()).set("run.duration=\"12 s\"");
    let split = Split::start(&lab, &trial).carrying(ARM_CHANNELS);
    let components = components(split.files.each_ref());
    Some((split.finish(), components))
}

/// Runs the arm on this machine alone.
fn local(record: &RunFolder) -> (RunSummary, [Component; 2]) {
    let trial = Trial::shipped("local.toml", record.path()).set("run.duration=\"2 s\"");
    let mut child = trial.start_here();
    let files = trial.folder("", START_LIMIT);
    let components = components([&files, &files]);
    child.wait_within(RUN_LIMIT).unwrap().assert_success();
    files.assert_nothing_left_here();
    (files.summary(), components)
}

#[test]
fn a_split_run_accounts_for_every_message_with_the_programs_of_a_local_run() {
    let record = RunFolder::new("split");
    let Some((summaries, split_components)) = split(&record) else {
        return;
    };
    for summary in &summaries {
        check_account(summary);
    }
    check_agreement(&summaries);

    let record = RunFolder::new("local");
    let (summary, local_components) = local(&record);
    assert_every_message_is_accounted_for(&summary);
    assert_accounts_close(&summary);
    assert_eq!(local_components, split_components);
    let binary = fs::metadata(hil_runtime_binary()).unwrap();
    assert_eq!(local_components[0].program.inode, binary.ino());
    assert_eq!(local_components[0].program, local_components[1].program);
}

fn check_account(summary: &RunSummary) {
    assert_eq!(summary.run.outcome, Outcome::Completed, "{:?}", summary.run);
    assert!(summary.run.duration_s >= 10.0, "{}", summary.run.duration_s);
    for channel in carried(summary) {
        println!(
            "{}: {}",
            summary.run.host,
            describe(&channel.name, account(summary, &channel.name))
        );
    }
    assert_every_message_is_accounted_for(summary);
    assert_accounts_close(summary);
    assert_eq!(channel(summary, "human/frame").link, LinkKind::SharedMemory);
    for name in CROSSING {
        let channel = channel(summary, name);
        assert_eq!(channel.link, LinkKind::named("udp").unwrap());
        assert_both_ends_are_stamped(name, account(summary, name));
        assert_eq!(channel.ends.len(), 2, "{:?}", channel.ends);
        for side in ["egress", "ingress"] {
            let direction = direction(summary, name, side);
            let states = [
                "established",
                "said farewell",
                "left after the last message",
            ];
            assert!(
                states.contains(&direction.peer_state.as_str()),
                "{direction:?}"
            );
            let facts = &direction.facts;
            assert!(
                facts.iter().any(|fact| fact.label == "kernel stamps"),
                "{facts:?}"
            );
        }
        let round_trip = account(summary, name).round_trip.measured();
        assert!(round_trip.is_some_and(|figures| figures.count > 10));
    }
}

/// Both hosts know all records, so they come to one account; only what refers to a host's own
/// begin and end of the run may differ.
fn check_agreement([first, second]: &[RunSummary; 2]) {
    assert_eq!(first.run.topology_hash, second.run.topology_hash);
    assert_eq!(first.processes.len(), second.processes.len());
    for channel in carried(first) {
        let accounts = [first, second].map(|summary| account(summary, &channel.name));
        let [first, second] = accounts.map(same_on_both_hosts);
        assert_eq!(first, second, "{}", channel.name);
    }
}

/// The counts and figures that do not depend on when a host began and ended its run.
fn same_on_both_hosts(account: &ChannelAccount) -> ChannelAccount {
    let mut account = account.clone();
    account.gaps.last_taken_to_run_end_ns = None;
    for gap in [
        &mut account.gaps.longest,
        &mut account.gaps.longest_unattributed,
    ] {
        *gap = gap.map(|gap| hil_account::Gap { start_ns: 0, ..gap });
    }
    account
}
