//! Recording a run while it goes: what the live file holds is what `convert` makes of the folder
//! afterwards, and what the run's own account says.

use std::collections::BTreeMap;
use std::path::Path;
use std::thread;
use std::time::Duration;

use hil_report::summary::RunSummary;
use hil_tests::account::{assert_accounts_close, assert_every_message_is_accounted_for};
use hil_tests::binary::hil_recorder_binary;
use hil_tests::child::ChildGuard;
use hil_tests::lab::Lab;
use hil_tests::mcap_file::{
    assert_code, counts, metadata, partial, python, read_back, record, recorder,
};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{RunFiles, Trial, wait_until};
use nix::sys::signal::Signal;
use prost::Message as _;

const LIMIT: Duration = Duration::from_mins(2);
const HOSTS: [&str; 2] = ["control-pc", "robot-pc"];

/// A name that no other test's run bears.
fn unique(name: &str) -> String {
    format!("{name}-{}", std::process::id())
}

/// The same run as `convert` has it, by topic.
fn converted(run: &RunFiles, to: &Path) -> BTreeMap<String, u64> {
    let output = recorder(&["convert", "--output"], &[to, run.root()]);
    assert_code(&output, 0);
    counts(to)
}

/// Messages of each channel by the run's own account.
fn published(summary: &RunSummary) -> BTreeMap<String, u64> {
    let channels = summary.channels.iter();
    let counted = channels.map(|channel| {
        let account = channel.account.as_ref();
        let published = account.map(|one| {
            assert_eq!(one.published_unrecorded_count.unwrap_or(0), 0);
            one.published_count
        });
        let recorded = channel.recorded.map(|figures| figures.message_count);
        (
            format!("/{}", channel.name),
            published.or(recorded).unwrap_or(0),
        )
    });
    counted.filter(|(_, count)| *count > 0).collect()
}

/// Pictures of the scene, at an even pace from the first message of the arms that was heard of.
const PICTURES: [&str; 2] = ["/scene", "/tf"];

/// The pace begins with the first message that was heard of: on one of two hosts one that came, on a
/// busy host one that was written in time.
const PICTURES_OFF_MAX: u64 = 5;

/// Counts with as many pictures as another file has, if they are about as many.
fn with_pictures_of(
    found: &BTreeMap<String, u64>,
    expected: &BTreeMap<String, u64>,
) -> BTreeMap<String, u64> {
    let mut found = found.clone();
    for topic in PICTURES {
        let (live, later) = (found[topic], expected[topic]);
        assert!(
            live > 20 && live.abs_diff(later) <= PICTURES_OFF_MAX,
            "{topic}: {live}, {later}"
        );
        found.insert(topic.to_owned(), later);
    }
    found
}

/// What we look at of an `hil.LinkDecision.v1`.
#[derive(prost::Message)]
struct Decision {
    #[prost(bool, tag = "6")]
    is_reordered: bool,
}

/// Stamps come in the order of publication although the network changed that of the messages and some
/// were never taken; those that do not are counted.
fn check_order(live: &Path, converted: &Path) {
    let is_reordered = |one: &mcap::Message<'_>| Decision::decode(&*one.data).unwrap().is_reordered;
    let decisions = read_back(converted).into_iter();
    let decisions = decisions.filter(|(topic, _)| topic.ends_with("/link"));
    let reordered_count = decisions
        .flat_map(|(_, messages)| messages)
        .filter(is_reordered)
        .count();
    let mut behind_count = 0;
    for (topic, messages) in read_back(live) {
        if topic.starts_with("/net/") && topic.ends_with("/latency") {
            let pairs = messages.windows(2);
            behind_count += pairs
                .filter(|two| two[1].log_time < two[0].log_time)
                .count();
        }
    }
    let said = &metadata(live)["hil.recording"]["unordered_latency_count"];
    println!("{reordered_count} reordered; {behind_count} stamps behind, {said:?} said");
    assert!(reordered_count > 20, "{reordered_count}");
    let said_count: usize = said.parse().unwrap();
    assert!(
        behind_count <= said_count,
        "{behind_count} of {said_count} are said"
    );
    assert!(
        said_count * 100 <= reordered_count,
        "{said_count} of {reordered_count}"
    );
}

fn check_same(found: &BTreeMap<String, u64>, run: &RunFiles, converted: &BTreeMap<String, u64>) {
    let found = with_pictures_of(found, converted);
    assert_eq!(&found, converted);
    for (topic, count) in published(&run.summary()) {
        assert_eq!(found.get(&topic), Some(&count), "{topic}");
    }
}

#[test]
fn a_live_file_holds_what_convert_makes_of_the_folder_whole_or_split() {
    let folder = RunFolder::new("live");
    let name = unique("live");
    let trial = Trial::shipped("emulated.toml", folder.path())
        .set(&format!("name=\"{name}\""))
        .set("run.duration=\"4 s\"")
        .set("links.hop.reordering={ ratio = 0.2, hold = \"40 ms\" }")
        .on_own_ports(&["hop"]);
    let output = RunFolder::new("live-files");
    let (whole, parts) = (output.join("live.mcap"), output.join("part.mcap"));
    let mut recorders = [
        record(&[&name, "--wait"], &whole),
        record(&[&name, "--wait", "--split-size", "100kB"], &parts),
    ];
    trial
        .start_here()
        .wait_within(LIMIT)
        .unwrap()
        .assert_success();
    for recorder in &mut recorders {
        let finished = recorder.wait_within(LIMIT).unwrap();
        println!("{}", finished.stdout);
        finished.assert_success();
        assert!(finished.stdout.contains("missed 0"), "{}", finished.stdout);
    }
    let files = trial.folder("", LIMIT);
    files.assert_nothing_left_here();
    assert_accounts_close(&files.summary());
    let later = output.join("converted.mcap");
    let expected = converted(&files, &later);
    let found = counts(&whole);
    check_same(&found, &files, &expected);
    check_order(&whole, &later);

    check_parts(&output, &expected);

    let said = metadata(&whole);
    let seed = files.summary().run.seed.to_string();
    assert_eq!(said["hil.run"]["seed"], seed);
    assert_eq!(said["hil.recording"]["mode"], "live");
    if let Some(read) = python(&whole, &[]) {
        for (topic, count) in &found {
            assert_eq!(read["topics"][topic]["count"], *count, "{topic}");
        }
        assert_eq!(read["metadata"]["hil.clocks"]["has_one_clock"], "true");
    }
}

/// Each part is whole by itself, and all of them together are the run.
fn check_parts(output: &RunFolder, expected: &BTreeMap<String, u64>) {
    let mut sum = BTreeMap::new();
    let mut count = 0;
    for number in 1.. {
        let part = output.join(format!("part_{number:04}.mcap"));
        if !part.exists() {
            break;
        }
        count = number;
        for (topic, count) in counts(&part) {
            *sum.entry(topic).or_default() += count;
        }
        let said = metadata(&part);
        assert!(said["hil.topology"].contains_key("json"), "{said:?}");
        assert_eq!(said["hil.recording"]["file_number"], number.to_string());
    }
    assert!(count > 2, "{count} files");
    assert_eq!(&with_pictures_of(&sum, expected), expected);
}

#[test]
fn both_hosts_of_a_split_run_record_all_of_it() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let folder = RunFolder::new("live-split");
    let output = RunFolder::new("live-split-files");
    let trial = Trial::shipped("split.toml", folder.path()).set("run.duration=\"7 s\"");
    let outputs = HOSTS.map(|host| output.join(format!("{host}.mcap")));
    let start = |index: usize, file: &Path| {
        let mut command = lab.host(index).command(hil_recorder_binary());
        command.args(["record", "--wait", "-o"]).arg(file);
        ChildGuard::spawn(&mut command).unwrap()
    };
    let mut recorders = [0, 1].map(|index| start(index, &outputs[index]));
    let mut hosts = [0, 1].map(|index| trial.start_on(lab.host(index)));
    // Killed with a hold on the shared memory of each host, several times: whatever such a recorder
    // had is freed, and those that come after it find room.
    for round in 0..3 {
        let files = [0, 1].map(|index| output.join(format!("killed-{index}-{round}.mcap")));
        let mut killed = [0, 1].map(|index| start(index, &files[index]));
        for file in &files {
            wait_until(LIMIT, "a recorder's file", || partial(file).is_file());
        }
        thread::sleep(Duration::from_millis(300));
        for one in &mut killed {
            assert!(one.is_running(), "{}", one.stderr_so_far());
            one.signal(Signal::SIGKILL).unwrap();
            one.wait_within(LIMIT).unwrap();
        }
    }
    for host in &mut hosts {
        host.wait_within(LIMIT).unwrap().assert_success();
    }
    for recorder in &mut recorders {
        let finished = recorder.wait_within(LIMIT).unwrap();
        println!("{}", finished.stdout);
        finished.assert_success();
    }
    for (index, host) in HOSTS.iter().enumerate() {
        let files = trial.folder(&format!("-{host}"), LIMIT);
        files.assert_nothing_left_on(lab.host(index));
        let summary = files.summary();
        assert_every_message_is_accounted_for(&summary);
        assert_accounts_close(&summary);
        let expected = converted(&files, &output.join(format!("{host}-converted.mcap")));
        check_same(&counts(&outputs[index]), &files, &expected);
    }
}

#[test]
fn an_interrupted_recorder_leaves_a_whole_file_and_names_what_runs() {
    let folder = RunFolder::new("live-interrupted");
    let output = RunFolder::new("live-interrupted-file");
    let name = unique("interrupted");
    let none = record(&[&name], &output.join("none.mcap"))
        .wait_within(LIMIT)
        .unwrap();
    assert_eq!(none.status.code(), Some(2), "{}", none.stderr);
    assert!(none.stderr.contains("--wait"), "{}", none.stderr);
    let trial = Trial::shipped("shuttle-local.toml", folder.path())
        .set(&format!("name=\"{name}\""))
        .set("run.duration=\"5 s\"");
    let mut run = trial.start_here();
    let file = output.join("live.mcap");
    let mut recording = record(&[&name, "--wait"], &file);
    let partial = partial(&file);
    wait_until(LIMIT, "the file", || partial.is_file());
    thread::sleep(Duration::from_millis(1500));
    let wrong = record(&["no-such-run"], &output.join("x.mcap"))
        .wait_within(LIMIT)
        .unwrap();
    assert_eq!(wrong.status.code(), Some(2));
    assert!(wrong.stderr.contains(&name), "{}", wrong.stderr);
    recording.signal(Signal::SIGINT).unwrap();
    let finished = recording.wait_within(LIMIT).unwrap();
    assert_eq!(finished.status.code(), Some(130), "{}", finished.stderr);
    assert!(!partial.exists());
    assert!(counts(&file).values().sum::<u64>() > 0);
    let again = record(&[&name], &file).wait_within(LIMIT).unwrap();
    assert_eq!(again.status.code(), Some(2), "{}", again.stderr);
    run.wait_within(LIMIT).unwrap().assert_success();
    assert!(metadata(&file).contains_key("hil.end"));
}
