//! Recorders of a run that are killed: each takes a moment's messages with it, and harms nothing else.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;
use std::{fs, thread};

use hil_core::random::RandomStream;
use hil_core::record::PublishedRecord;
use hil_platform::clock::MonotonicClock;
use hil_report::summary::Outcome;
use hil_rundir::record::RecordFile;
use hil_tests::account::{assert_accounts_close, assert_every_message_is_accounted_for};
use hil_tests::child::ChildGuard;
use hil_tests::latency::assert_undisturbed;
use hil_tests::mcap_file::{assert_code, partial, read_back, record, recorder};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{RunFiles, Trial, wait_until};
use nix::sys::signal::Signal;

const LIMIT: Duration = Duration::from_mins(2);
/// What a kill of the recorder may lose of the messages: `--flush` unless told otherwise.
const LOST_NS_MAX: i64 = 1_000_000_000;
/// For how much longer the stamps of messages are held back to come in order.
const HELD_NS: i64 = 300_000_000;

/// How long the run goes on after the last kill.
const AFTERWARDS: Duration = Duration::from_millis(1500);

/// A recorder that was killed.
struct Killed {
    file: PathBuf,
    at_ns: i64,
    /// How long it could have run and had no processor.
    starved_ns: i64,
}

/// How long the main thread of a process that was killed had been without a processor in its life.
fn starved_ns(process: &ChildGuard) -> i64 {
    let read = |name: &str| fs::read_to_string(format!("/proc/{}/{name}", process.pid())).unwrap();
    // Until it has ended, what it waits for now is not counted.
    wait_until(LIMIT, "the end of a recorder", || {
        let stat = read("stat");
        let state = stat.rsplit_once(')').unwrap().1.trim_start();
        state.starts_with('Z')
    });
    let schedstat = read("schedstat");
    schedstat
        .split_whitespace()
        .nth(1)
        .unwrap()
        .parse()
        .unwrap()
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
    let starved_ns = starved_ns(&child);
    child.wait_within(LIMIT).unwrap();
    Killed {
        file: partial,
        at_ns,
        starved_ns,
    }
}

/// Numbers on a topic, with the instants of their publication.
type Published = BTreeMap<String, Vec<(u32, i64)>>;

/// When each message whose stamps are noted was published, by topic of the stamps: of the channels on
/// which messages keep coming, for the last one of any other is waited for.
fn stamped(run: &RunFiles) -> Published {
    let mut topics = Published::new();
    for entry in fs::read_dir(run.root().join("records")).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if !name.starts_with("egm.") || !name.contains(".published.") {
            continue;
        }
        let file = RecordFile::read(&path).unwrap();
        let of_file = topics.entry(format!("/net/{}/latency", file.header.channel));
        let records = file.records::<PublishedRecord>();
        let records = records.map(|one| (u32::try_from(one.sequence).unwrap(), one.published_ns));
        of_file.or_default().extend(records);
    }
    assert!(topics.len() >= 4, "{:?}", topics.keys());
    topics
}

/// When each message of a channel was published, by number.
fn messages(run: &RunFiles) -> Published {
    let mut channels = Published::new();
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

/// How much of what had been published at the kill is not in the recovered file, nanoseconds: of
/// messages, and of their stamps.
fn lost_ns(killed: &Killed, run: &RunFiles) -> [i64; 2] {
    let mended = killed.file.with_extension("mended");
    assert_code(
        &recorder(&["recover", "--output"], &[&mended, &killed.file]),
        0,
    );
    let found = read_back(&mended);
    assert!(!found.is_empty(), "nothing was recovered");
    let bytes = fs::read(&mended).unwrap();
    let index = mcap::Summary::read(&bytes).unwrap().unwrap();
    let mut attachments = index.attachment_indexes.iter();
    assert!(attachments.any(|one| one.name == "yumi.urdf"));
    [messages(run), stamped(run)].map(|published| lost_of(&found, published, killed.at_ns))
}

/// From the first missing message of any of the topics to the last one published by then.
fn lost_of(
    found: &BTreeMap<String, Vec<mcap::Message<'static>>>,
    published: Published,
    until_ns: i64,
) -> i64 {
    let (mut first_missing_ns, mut last_ns) = (i64::MAX, i64::MIN);
    for (topic, all) in published {
        let mut there: Vec<u32> = found
            .get(&topic)
            .into_iter()
            .flatten()
            .map(|one| one.sequence)
            .collect();
        there.sort_unstable();
        let before = all
            .iter()
            .filter(|(_, published_ns)| *published_ns <= until_ns);
        for (sequence, published_ns) in before {
            last_ns = last_ns.max(*published_ns);
            if there.binary_search(sequence).is_err() {
                first_missing_ns = first_missing_ns.min(*published_ns);
            }
        }
    }
    last_ns.saturating_sub(first_missing_ns).max(0)
}

#[test]
fn killed_recorders_lose_what_was_not_flushed_and_the_run_nothing() {
    kill_recorders(2);
}

#[test]
#[ignore = "takes most of a minute"]
fn ten_killed_recorders_at_full_length() {
    kill_recorders(5);
}

/// Kills `count` recorders and as many beside them, one after the other, in a run that is stopped then.
fn kill_recorders(count: usize) {
    let folder = RunFolder::new("live-kills");
    let output = RunFolder::new("live-killed");
    let name = format!("kills-{}", std::process::id());
    let trial = Trial::shipped("local.toml", folder.path())
        .set(&format!("name=\"{name}\""))
        .set("run.duration=\"10 min\"");
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
                (0..count).map(one).collect::<Vec<Killed>>()
            })
        });
        let series = series.into_iter();
        series.flat_map(|one| one.join().unwrap()).collect()
    });
    assert!(child.is_running(), "the run ended before the last kill");
    // Messages of after the last kill as well.
    thread::sleep(AFTERWARDS);
    child.signal(Signal::SIGINT).unwrap();
    child.wait_within(LIMIT).unwrap().assert_code(130);
    files.assert_nothing_left_here();
    let summary = files.summary();
    assert_eq!(summary.run.outcome, Outcome::Stopped);
    assert_every_message_is_accounted_for(&summary);
    assert_accounts_close(&summary);
    let kills_ns: Vec<i64> = killed.iter().map(|one| one.at_ns).collect();
    assert_undisturbed(files.root(), &kills_ns);
    for one in &killed {
        let [lost_ns, stamps_lost_ns] = lost_ns(one, &files);
        let (file, starved_ns) = (one.file.display(), one.starved_ns);
        println!(
            "seed {seed}: {file} lost {lost_ns} ns, of stamps {stamps_lost_ns} ns, after \
             {starved_ns} ns without a processor"
        );
        // How much time the machine leaves it is not the recorder's doing.
        let most_ns = LOST_NS_MAX + starved_ns;
        assert!(lost_ns <= most_ns, "{lost_ns} ns, seed {seed}");
        assert!(
            stamps_lost_ns <= most_ns + HELD_NS,
            "{stamps_lost_ns} ns, seed {seed}"
        );
    }
}
