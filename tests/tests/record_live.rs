//! Recording a run while it goes: what the live file holds is what `convert` makes of the folder
//! afterwards, and what the run's own account says; a recorder that is killed takes a second with it
//! and harms nothing else.
#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "tests")]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread;
use std::time::Duration;

use hil_models::random::RandomStream;
use hil_runtime::clock::MonotonicClock;
use hil_runtime::record::RecordFile;
use hil_runtime::report::summary::{Outcome, RunSummary};
use hil_tests::account::{assert_accounts_close, assert_every_message_is_accounted_for};
use hil_tests::binary::hil_recorder_binary;
use hil_tests::child::ChildGuard;
use hil_tests::lab::Lab;
use hil_tests::latency::assert_undisturbed;
use hil_tests::mcap_file::{assert_code, counts, info, python, read_back, recorder, words};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{RunFiles, Trial, wait_until};
use nix::sys::signal::Signal;

const LIMIT: Duration = Duration::from_mins(2);
const HOSTS: [&str; 2] = ["control-pc", "robot-pc"];
/// What a kill of the recorder may lose of the messages: `--flush` unless told otherwise.
const LOST_NS_MAX: i64 = 1_000_000_000;

/// A name that no other test's run bears.
fn unique(name: &str) -> String {
    format!("{name}-{}", std::process::id())
}

fn record(arguments: &[&str], output: &Path) -> ChildGuard {
    let mut command = Command::new(hil_recorder_binary());
    command.arg("record").args(arguments).arg("-o").arg(output);
    ChildGuard::spawn(&mut command).unwrap()
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

/// A recorder on one of two hosts hears of the first message from there only if it came.
const PICTURES_OFF_MAX: u64 = 5;

fn check_same(found: &BTreeMap<String, u64>, run: &RunFiles, converted: &BTreeMap<String, u64>) {
    let mut found = found.clone();
    for topic in PICTURES {
        let (live, later) = (found[topic], converted[topic]);
        assert!(
            live > 20 && live.abs_diff(later) <= PICTURES_OFF_MAX,
            "{topic}: {live}, {later}"
        );
        found.insert(topic.to_owned(), later);
    }
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
        .set("links.hop.port=48721");
    let output = RunFolder::new("live-files");
    let (whole, parts) = (output.join("live.mcap"), output.join("part.mcap"));
    let mut recorders = [
        record(&[&name, "--wait"], &whole),
        record(
            &[
                &name,
                "--wait",
                "--split-time",
                "1s",
                "--split-size",
                "1GiB",
            ],
            &parts,
        ),
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
    let expected = converted(&files, &output.join("converted.mcap"));
    let found = counts(&whole);
    check_same(&found, &files, &expected);
    for topic in PICTURES {
        assert_eq!(found[topic], expected[topic], "{topic}");
    }

    check_parts(&output, &expected);

    let said = info(&whole);
    let seed = files.summary().run.seed.to_string();
    assert_eq!(said["metadata"]["hil.run"]["seed"], seed);
    assert_eq!(said["metadata"]["hil.recording"]["mode"], "live");
    if let Some(read) = python(&whole, &[]) {
        for (topic, count) in &expected {
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
        let said = info(&part);
        assert!(
            said["metadata"]["hil.topology"]["json"].is_string(),
            "{said}"
        );
        assert_eq!(
            said["metadata"]["hil.recording"]["file_number"],
            number.to_string()
        );
    }
    assert!(count > 2, "{count} files");
    assert_eq!(&sum, expected);
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

/// A recorder that was killed.
struct Killed {
    file: PathBuf,
    at_ns: i64,
}

/// Starts a recorder and kills it after so long.
fn record_and_kill(run: &str, file: &Path, after: Duration) -> Killed {
    let mut child = record(&[run], file);
    let partial = partial(file);
    // It says so after its first flush: from then on a kill loses a second, not all there was before.
    wait_until(LIMIT, "the first words of a recorder", || {
        child.stderr_so_far().contains("messages/s")
    });
    thread::sleep(after);
    assert!(child.is_running(), "{}", child.stderr_so_far());
    child.signal(Signal::SIGKILL).unwrap();
    let at_ns = MonotonicClock::now().as_ns();
    child.wait_within(LIMIT).unwrap();
    Killed {
        file: partial,
        at_ns,
    }
}

fn partial(file: &Path) -> PathBuf {
    let name = file.file_name().unwrap().to_string_lossy();
    file.with_file_name(format!("{name}.partial"))
}

/// When each message of a channel was published, by number.
fn messages(run: &RunFiles) -> BTreeMap<String, Vec<(u32, i64)>> {
    let mut channels: BTreeMap<String, Vec<(u32, i64)>> = BTreeMap::new();
    for entry in fs::read_dir(run.root().join("records")).unwrap() {
        let path = entry.unwrap().path();
        if !path.to_string_lossy().contains(".message.") {
            continue;
        }
        let file = RecordFile::read(&path).unwrap();
        let of_file = channels
            .entry(format!("/{}", file.header.channel))
            .or_default();
        for index in 0..file.record_count() {
            let (envelope, _) = file.message(index).unwrap();
            of_file.push((
                u32::try_from(envelope.sequence).unwrap(),
                envelope.published_ns,
            ));
        }
    }
    channels
}

/// How much of what had been published at the kill is not in the recovered file, nanoseconds: from
/// the first missing message of any channel to the last one published.
fn lost_ns(killed: &Killed, run: &RunFiles) -> i64 {
    let mended = killed.file.with_extension("mended");
    assert_code(
        &recorder(&["recover", "--output"], &[&mended, &killed.file]),
        0,
    );
    let found = read_back(&mended);
    let (mut first_missing_ns, mut last_ns) = (i64::MAX, i64::MIN);
    for (topic, all) in messages(run) {
        let mut there: Vec<u32> = found
            .get(&topic)
            .into_iter()
            .flatten()
            .map(|one| one.sequence)
            .collect();
        there.sort_unstable();
        let before = all
            .iter()
            .filter(|(_, published_ns)| *published_ns <= killed.at_ns);
        for (sequence, published_ns) in before {
            last_ns = last_ns.max(*published_ns);
            if there.binary_search(sequence).is_err() {
                first_missing_ns = first_missing_ns.min(*published_ns);
            }
        }
    }
    assert!(!found.is_empty(), "nothing was recovered");
    last_ns.saturating_sub(first_missing_ns).max(0)
}

#[test]
fn ten_killed_recorders_lose_a_second_each_and_the_run_nothing() {
    let folder = RunFolder::new("live-kills");
    let output = RunFolder::new("live-killed");
    let name = unique("kills");
    let trial = Trial::shipped("local.toml", folder.path())
        .set(&format!("name=\"{name}\""))
        .set("run.duration=\"20 s\"");
    let mut child = trial.start_here();
    let files = trial.folder("", LIMIT);
    wait_until(LIMIT, "the first records", || {
        files.record_bytes("egm.right.feedback.message") > 1000
    });
    let seed = 20_261_122;
    // Two at a time, one after the other.
    let killed: Vec<Killed> = thread::scope(|scope| {
        let series = ["first", "second"].map(|series| {
            let (name, output) = (&name, &output);
            scope.spawn(move || {
                let mut random = RandomStream::new(seed, series);
                let one = |index: usize| {
                    let after = Duration::from_millis(500 + random.next_u64() % 1000);
                    record_and_kill(name, &output.join(format!("{series}-{index}.mcap")), after)
                };
                (0..5).map(one).collect::<Vec<Killed>>()
            })
        });
        let series = series.into_iter();
        series.flat_map(|one| one.join().unwrap()).collect()
    });
    assert!(child.is_running(), "the run ended before the last kill");
    child.wait_within(LIMIT).unwrap().assert_success();
    files.assert_nothing_left_here();
    let summary = files.summary();
    assert_eq!(summary.run.outcome, Outcome::Completed);
    assert_every_message_is_accounted_for(&summary);
    assert_accounts_close(&summary);
    let kills_ns: Vec<i64> = killed.iter().map(|one| one.at_ns).collect();
    assert_undisturbed(files.root(), &kills_ns);
    for one in &killed {
        let lost_ns = lost_ns(one, &files);
        println!("seed {seed}: {} lost {lost_ns} ns", one.file.display());
        assert!(lost_ns <= LOST_NS_MAX, "{lost_ns} ns, seed {seed}");
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
    assert!(words(&recorder(&["info"], &[&file])).contains("hil.end"));
}
