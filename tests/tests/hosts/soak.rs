//! A long run: eight channels at 1 kHz between two hosts, and whether any process grows meanwhile.
//!
//! `HIL_SOAK_MINUTES=60 cargo test --package hil-tests --test hosts soak:: -- --ignored --nocapture`

use std::collections::BTreeMap;
use std::path::Path;
use std::time::{Duration, Instant};
use std::{env, fs, thread};

use hil_account::MessageFate;
use hil_tests::account::{account, assert_every_message_is_accounted_for, carried, describe};
use hil_tests::child::ChildGuard;
use hil_tests::lab::{Lab, LabHost};
use hil_tests::run_folder::RunFolder;
use hil_tests::soak::held::{Held, shared_memory};
use hil_tests::soak::trend::{Growth, Slope};
use hil_tests::trial::{RunFiles, Trial, load_average};
use nix::unistd::Pid;

/// Length of the soak, minutes.
const MINUTES_VARIABLE: &str = "HIL_SOAK_MINUTES";
const MINUTES_DEFAULT: f64 = 3.0;
/// Where the records go; they take about 10 MB a second.
const FOLDER_VARIABLE: &str = "HIL_SOAK_FOLDER";
const HOSTS: [&str; 2] = ["control-pc", "robot-pc"];
/// Each has two channels.
const RUN_COUNT: usize = 4;
const RATE_HZ: u32 = 1000;
/// Buffers set aside for records of ten a second are touched for the first time during the first
/// quarter of an hour: a soak that is to tell a leak from that takes an hour.
const WARM_UP_RATIO: f64 = 0.3;
/// The rings of a kilohertz take their first turn within it.
const WARM_UP_S_MIN: f64 = 60.0;
const SAMPLE_PERIOD_MAX: Duration = Duration::from_secs(10);
/// Memory of its own that a process may gain: 2 MiB an hour. A leak of one byte a message of
/// one channel would be 3.4.
const GROWTH_BYTES_PER_S: f64 = 2.0 * 1_048_576.0 / 3600.0;
/// The same where that first touching is not over when the warm-up is.
const GROWTH_SHORT_BYTES_PER_S: f64 = 3.0 * GROWTH_BYTES_PER_S;
const LONG: Duration = Duration::from_mins(50);
const LIMIT: Duration = Duration::from_mins(2);
/// How long the account of an hour may take on a busy machine.
const CONCLUDE_LIMIT: Duration = Duration::from_mins(40);

/// One run on both hosts.
struct Soak {
    supervisors: [ChildGuard; 2],
    files: [RunFiles; 2],
}

/// Everything seen of one process.
#[derive(Default)]
struct History {
    samples: Vec<(f64, Held)>,
    peak_bytes: u64,
}

fn start(lab: &Lab, record: &RunFolder, index: usize, duration: Duration) -> Soak {
    let folder = record.join(index.to_string());
    fs::create_dir(&folder).unwrap();
    let trial = Trial::shipped("shuttle-split.toml", &folder)
        .set(&format!("name=\"soak-{index}\""))
        .set(&format!("run.duration=\"{} ms\"", duration.as_millis()))
        .set(&format!("case.parameters.rate_hz={RATE_HZ}"))
        .set(&format!("hosts.control-pc.control_port={}", 7399 - index))
        .set(&format!("links.hop.port={}", 7400 + 10 * index));
    let supervisors = [0, 1].map(|host| trial.start_on(lab.host(host)));
    let files = HOSTS.map(|host| trial.folder(&format!("-{host}"), LIMIT));
    Soak { supervisors, files }
}

/// The processes of a run with names that tell them apart.
fn processes(index: usize, soak: &Soak) -> Vec<(String, Pid)> {
    let mut found = Vec::new();
    for (host, files) in soak.files.iter().enumerate() {
        let name = HOSTS[host];
        found.push((
            format!("{index} supervisor of {name}"),
            soak.supervisors[host].pid(),
        ));
        for process in files.processes() {
            let line = fs::read_to_string(format!("/proc/{process}/cmdline")).unwrap_or_default();
            let launch = line.split('\0').find(|word| {
                Path::new(word)
                    .extension()
                    .is_some_and(|kind| kind == "json")
            });
            let short = launch.and_then(|path| path.rsplit('/').next());
            if let Some(short) = short {
                found.push((
                    format!("{index} {}", short.trim_end_matches(".json")),
                    process,
                ));
            }
        }
    }
    found
}

#[test]
#[ignore = "takes HIL_SOAK_MINUTES (3 by default) and more, and the machine for itself"]
fn eight_channels_at_a_kilohertz_leave_every_process_as_large_as_it_was() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let minutes = env::var(MINUTES_VARIABLE).map_or(MINUTES_DEFAULT, |text| {
        let minutes = text
            .parse::<f64>()
            .ok()
            .filter(|minutes| *minutes >= MINUTES_DEFAULT);
        minutes.unwrap_or_else(|| {
            panic!("{MINUTES_VARIABLE} is {text:?}, at least {MINUTES_DEFAULT} expected")
        })
    });
    if let Some(folder) = env::var_os(FOLDER_VARIABLE) {
        assert!(fs::create_dir_all(&folder).is_ok(), "{folder:?}");
    }
    let record = match env::var_os(FOLDER_VARIABLE) {
        Some(parent) => RunFolder::below(parent.as_ref(), "soak"),
        None => RunFolder::new("soak"),
    };
    let duration = Duration::from_secs_f64(60.0 * minutes);
    // One after the other: an account at the end takes processors from the runs that go on.
    let longer = |index: usize| duration + duration.mul_f64(index as f64 / 16.0);
    let mut soaks: Vec<Soak> = (0..RUN_COUNT)
        .map(|index| start(&lab, &record, index, longer(index)))
        .collect();
    let (stories, shared) = watch(&lab, &soaks, duration);
    let peaks = finish(&mut soaks);
    let verdicts = judge(&stories, &shared, duration);
    for (name, bytes) in &peaks {
        println!(
            "{name}: at most {:.1} MiB in use while it drew up the account",
            mib(*bytes)
        );
    }
    for (index, soak) in soaks.iter().enumerate() {
        check_accounts(index, soak, lab.host(0), lab.host(1));
    }
    assert!(verdicts.is_empty(), "\n{}", verdicts.join("\n"));
}

type Shared = Vec<(f64, [(u64, u64); 2])>;

/// Samples everything until the shortest run is about to end.
fn watch(lab: &Lab, soaks: &[Soak], duration: Duration) -> (BTreeMap<String, History>, Shared) {
    let period = SAMPLE_PERIOD_MAX.min(duration / 60);
    let began = Instant::now();
    let mut stories: BTreeMap<String, History> = BTreeMap::new();
    let mut shared = Vec::new();
    // The last moments belong to the end of the run.
    while began.elapsed() + period < duration {
        thread::sleep(period);
        let at_s = began.elapsed().as_secs_f64();
        for (index, soak) in soaks.iter().enumerate() {
            for (name, process) in processes(index, soak) {
                if let Some(held) = Held::of(process) {
                    let story = stories.entry(name).or_default();
                    story.samples.push((at_s, held));
                    story.peak_bytes = held.peak_bytes;
                }
            }
        }
        let of_host = |host: usize| shared_memory(&lab.host(host).locate("/dev/shm"));
        shared.push((at_s, [of_host(0), of_host(1)]));
    }
    (stories, shared)
}

/// Waits for the end of all runs; gives the most memory each supervisor had in use.
fn finish(soaks: &mut [Soak]) -> BTreeMap<String, u64> {
    let deadline = Instant::now() + CONCLUDE_LIMIT;
    let mut peaks: BTreeMap<String, u64> = BTreeMap::new();
    loop {
        let mut is_running = false;
        for (index, soak) in soaks.iter_mut().enumerate() {
            for (host, supervisor) in soak.supervisors.iter_mut().enumerate() {
                if !supervisor.is_running() {
                    continue;
                }
                is_running = true;
                if let Some(held) = Held::of(supervisor.pid()) {
                    let name = format!("{index} supervisor of {}", HOSTS[host]);
                    peaks.insert(name, held.peak_bytes);
                }
            }
        }
        if !is_running {
            break;
        }
        assert!(Instant::now() < deadline, "a run does not end");
        thread::sleep(Duration::from_millis(100));
    }
    for soak in soaks {
        for supervisor in &mut soak.supervisors {
            supervisor.wait_within(LIMIT).unwrap().assert_success();
        }
    }
    peaks
}

fn mib(bytes: u64) -> f64 {
    bytes as f64 / 1_048_576.0
}

/// Prints what was seen and gives what is wrong with it.
fn judge(stories: &BTreeMap<String, History>, shared: &Shared, duration: Duration) -> Vec<String> {
    let from_s = WARM_UP_S_MIN.max(WARM_UP_RATIO * duration.as_secs_f64());
    let allowed = if duration >= LONG {
        GROWTH_BYTES_PER_S
    } else {
        GROWTH_SHORT_BYTES_PER_S
    };
    println!(
        "after a warm-up of {from_s:.0} s; slope of {} block means with Student's 95 % interval; \
         allowed {:.0} KiB an hour; load {}",
        hil_tests::soak::trend::BLOCK_COUNT,
        allowed * 3600.0 / 1024.0,
        load_average()
    );
    println!(
        "{:34} {:>7} {:>9} {:>9} {:>30} {:>9} {:>9}",
        "process", "samples", "RSS MiB", "own MiB", "own, KiB an hour", "files", "threads"
    );
    let mut wrong = Vec::new();
    for (name, story) in stories {
        let samples: Vec<&(f64, Held)> =
            story.samples.iter().filter(|one| one.0 >= from_s).collect();
        let (Some(first), Some(last)) = (samples.first(), samples.last()) else {
            wrong.push(format!("{name} was not there after the warm-up"));
            continue;
        };
        let own = samples
            .iter()
            .map(|one| (one.0, one.1.anonymous_bytes as f64));
        let slope = Slope::of(&own.collect::<Vec<_>>());
        let range = |pick: fn(&Held) -> u64| {
            let values = samples.iter().map(|one| pick(&one.1));
            (values.clone().min().unwrap_or(0), values.max().unwrap_or(0))
        };
        let (files, threads) = (
            range(|held| held.file_count),
            range(|held| held.thread_count),
        );
        println!(
            "{name:34} {:>7} {:>9.2} {:>9.2} {:>30} {:>9} {:>9}",
            samples.len(),
            mib(last.1.resident_bytes),
            mib(last.1.anonymous_bytes),
            words(slope),
            format!("{}..{}", files.0, files.1),
            format!("{}..{}", threads.0, threads.1),
        );
        if slope.is_some_and(|slope| slope.judge(allowed) == Growth::Grows) {
            wrong.push(format!("{name} grows: {}", words(slope)));
        }
        let (before, after) = (first.1, last.1);
        if after.file_count > before.file_count + 2 || after.thread_count > before.thread_count + 1
        {
            wrong.push(format!(
                "{name} gained files or threads: {before:?}, {after:?}"
            ));
        }
    }
    wrong.extend(judge_shared(shared, from_s, allowed));
    wrong
}

fn judge_shared(shared: &Shared, from_s: f64, allowed: f64) -> Vec<String> {
    let mut wrong = Vec::new();
    for (host, name) in HOSTS.iter().enumerate() {
        let mut late = shared.iter().filter(|one| one.0 >= from_s);
        let bytes = late.clone().map(|one| (one.0, one.1[host].0 as f64));
        let slope = Slope::of(&bytes.collect::<Vec<_>>());
        let last = late.next_back().map_or((0, 0), |one| one.1[host]);
        println!(
            "shared memory of {name}: {:.2} MiB in {} files; {} KiB an hour",
            mib(last.0),
            last.1,
            words(slope)
        );
        if slope.is_some_and(|slope| slope.judge(allowed) == Growth::Grows) {
            wrong.push(format!("shared memory of {name} grows: {}", words(slope)));
        }
    }
    wrong
}

/// In KiB an hour.
fn words(slope: Option<Slope>) -> String {
    let hourly = |per_s: f64| per_s * 3600.0 / 1024.0;
    slope.map_or("too few samples".to_owned(), |slope| {
        format!(
            "{:.1} ({:.1} to {:.1})",
            hourly(slope.per_s),
            hourly(slope.low_per_s),
            hourly(slope.high_per_s)
        )
    })
}

fn check_accounts(index: usize, soak: &Soak, control: &LabHost, robot: &LabHost) {
    for (files, host) in soak.files.iter().zip([control, robot]) {
        files.assert_nothing_left_on(host);
        let summary = files.summary();
        for channel in carried(&summary) {
            let figures = account(&summary, &channel.name);
            println!("{index} {}", describe(&channel.name, figures));
            let closing = figures.closing.checked().unwrap();
            let taken_count = figures.fates.of(MessageFate::Taken);
            assert_eq!(closing.checked_count, taken_count, "{}", channel.name);
            assert_eq!(closing.negative_segment_count, 0, "{}", channel.name);
        }
        assert_every_message_is_accounted_for(&summary);
    }
}
