//! Watching a run that the tests make up: a domain and a folder, without any process of a run.

use std::collections::BTreeMap;
use std::fs::{self, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use bytemuck::bytes_of;
use hil_core::message::Envelope;
use hil_core::message::TypeInfo;
use hil_core::random::RandomStream;
use hil_core::record::{IngressRecord, PublishedRecord, UNAVAILABLE};

use super::*;
use hil_platform::clock::MonotonicClock;
use hil_platform::own_folder::OwnFolder;
use hil_rundir::announcement::withdraw_abandoned;
use hil_rundir::live_run::{LIVE_VERSION, LiveChannel, LiveRun, Source, start_ticks};
use hil_rundir::record::RecordKind;
use hil_rundir::record::file::RecordHeader;
use hil_rundir::select::{SelectError, running_runs_below, select};
use hil_shm::{ChannelHolder, ChannelSettings, Domain, RawOutput, observer_depth};

/// A folder of the test's own, and a short name for a domain below it.
struct Place(PathBuf);

impl Place {
    fn new(label: &str) -> Self {
        let path = std::env::temp_dir().join(format!("hw-{label}-{}", std::process::id()));
        fs::create_dir_all(path.join("run/records")).unwrap();
        Self(path)
    }

    fn run(&self) -> PathBuf {
        self.0.join("run")
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        drop(fs::remove_dir_all(&self.0));
    }
}

pub(crate) fn header(kind: RecordKind, channel: &str, record_bytes: usize) -> RecordHeader {
    RecordHeader {
        kind,
        channel: channel.to_owned(),
        record_bytes: u32::try_from(record_bytes).unwrap(),
        instance: 0,
    }
}

pub(crate) fn append(folder: &Path, header: &RecordHeader, writer: &str, bytes: &[u8]) {
    let path = folder.join(header.file_name(writer));
    let mut file = OpenOptions::new()
        .create(true)
        .append(true)
        .open(&path)
        .unwrap();
    if file.metadata().unwrap().len() == 0 {
        file.write_all(&header.encode(&path).unwrap()).unwrap();
    }
    file.write_all(bytes).unwrap();
}

fn published(sequence: u64) -> PublishedRecord {
    PublishedRecord {
        sequence,
        published_ns: 5,
        epoch: 1,
        reserved: 0,
    }
}

#[test]
fn a_growing_file_is_given_out_in_whole_records_wherever_it_is_cut() {
    let place = Place::new("cut");
    let folder = place.run().join("records");
    let mut random = RandomStream::new(3, "cuts");
    let header = header(
        RecordKind::Published,
        "arm/command",
        size_of::<PublishedRecord>(),
    );
    let path = folder.join(header.file_name("robot"));
    let mut bytes = header.encode(&path).unwrap().to_vec();
    (0..2000).for_each(|sequence| bytes.extend_from_slice(bytes_of(&published(sequence))));
    let mut follower = RecordFollower::new(&folder);
    let mut found = Vec::new();
    let mut file = OpenOptions::new()
        .create(true)
        .append(true)
        .open(&path)
        .unwrap();
    let mut rest = bytes.as_slice();
    while !rest.is_empty() {
        let length = usize::try_from(random.next_u64() % 97)
            .unwrap()
            .min(rest.len());
        file.write_all(&rest[..length]).unwrap();
        rest = &rest[length..];
        // One piece at most, and every whole record of it.
        follower.poll(1, &mut |batch| {
            assert_eq!((batch.writer, batch.header), ("robot", &header));
            found.extend(batch.records::<PublishedRecord>().map(|one| one.sequence));
        });
    }
    while follower.poll(1, &mut |batch| {
        found.extend(batch.records::<PublishedRecord>().map(|one| one.sequence));
    }) {}
    assert!(found.iter().copied().eq(0..2000), "{}", found.len());
}

#[test]
fn new_files_are_found_and_a_foreign_one_is_said_once() {
    let place = Place::new("new");
    let folder = place.run().join("records");
    let mut follower = RecordFollower::new(&folder);
    let count = |follower: &mut RecordFollower| {
        let mut count = 0;
        follower.look_again();
        while follower.poll(1, &mut |batch| {
            count += batch.records::<PublishedRecord>().count();
        }) {}
        count
    };
    assert_eq!(count(&mut follower), 0);
    let header = header(RecordKind::Published, "c", size_of::<PublishedRecord>());
    append(&folder, &header, "one", bytes_of(&published(0)));
    append(
        &folder,
        &header,
        "two",
        bytes_of(&[published(0), published(1)]),
    );
    fs::write(folder.join("x.rec"), [7; 200]).unwrap();
    assert_eq!(count(&mut follower), 3);
    assert_eq!(follower.take_problems().len(), 1);
    append(&folder, &header, "two", bytes_of(&published(2)));
    assert_eq!(count(&mut follower), 1);
    assert!(follower.take_problems().is_empty());
    append(&folder, &header, "two", bytes_of(&published(3)));
    append(&folder, &header, "three", bytes_of(&published(0)));
    follower.skip_to_end();
    assert_eq!(count(&mut follower), 0);
    append(&folder, &header, "three", bytes_of(&published(1)));
    assert_eq!(count(&mut follower), 1);
}

#[test]
fn files_of_larger_and_smaller_records_are_caught_up_with_abreast() {
    const COUNT: usize = 5000;
    let place = Place::new("abreast");
    let folder = place.run().join("records");
    let small = header(RecordKind::Published, "c", size_of::<PublishedRecord>());
    let large = header(RecordKind::Ingress, "c", size_of::<IngressRecord>());
    let all: Vec<PublishedRecord> = (0..COUNT as u64).map(published).collect();
    append(&folder, &small, "robot", bytemuck::cast_slice(&all));
    let all: Vec<IngressRecord> = (0..COUNT as u64).map(ingress).collect();
    append(&folder, &large, "gateway", bytemuck::cast_slice(&all));
    let mut follower = RecordFollower::new(&folder);
    let (mut small_count, mut large_count) = (0_usize, 0_usize);
    // One piece at a time.
    while follower.poll(1, &mut |batch| {
        small_count += batch.records::<PublishedRecord>().count();
        large_count += batch.records::<IngressRecord>().count();
    }) {
        assert!(small_count.abs_diff(large_count) <= follow::PIECE_RECORDS);
    }
    assert_eq!((small_count, large_count), (COUNT, COUNT));
}

#[test]
fn what_a_process_wrote_before_it_was_started_again_comes_first() {
    const COUNT: u64 = 1500;
    let place = Place::new("instances");
    let folder = place.run().join("records");
    let mut file = header(RecordKind::Published, "c", size_of::<PublishedRecord>());
    for instance in [10, 0, 2] {
        file.instance = instance;
        let first = u64::from(instance) * COUNT;
        let all: Vec<PublishedRecord> = (first..first + COUNT).map(published).collect();
        append(&folder, &file, "robot", bytemuck::cast_slice(&all));
    }
    let mut follower = RecordFollower::new(&folder);
    let mut found = Vec::new();
    // One piece at a time.
    while follower.poll(1, &mut |batch| {
        found.extend(batch.records::<PublishedRecord>().map(|one| one.sequence));
    }) {}
    assert_eq!(found.len() as u64, 3 * COUNT);
    assert!(found.is_sorted());
}

const CHANNELS: [&str; 3] = ["own", "forwarded", "elsewhere"];

/// A domain and a run's folder that announce a run with one channel of each source.
fn announced(place: &Place) -> (Domain, Vec<ChannelHolder>, LiveRun) {
    let domain = Domain::create(&place.0.join("d")).unwrap();
    let holders = CHANNELS[..2].iter().map(|name| {
        let settings = ChannelSettings {
            name: (*name).to_owned(),
            message: TypeInfo {
                name: "test.Eight.v1".to_owned(),
                size_bytes: 8,
                alignment_bytes: 8,
            },
            depth_max: observer_depth(8),
            writers_max: 2,
            readers_max: 6,
            assembled_max: 0,
        };
        ChannelHolder::create(&domain, &settings).unwrap()
    });
    let holders = holders.collect();
    let described = CHANNELS.map(|name| {
        serde_json::json!({ "name": name, "message": "test.Eight.v1", "size_bytes": 8,
            "fields": [], "from_host": "a", "to_host": "b" })
    });
    let manifest = serde_json::json!({ "schema_version": 1, "channels": described,
        "program": { "name": "test", "version": "0" } });
    fs::write(place.run().join("manifest.json"), manifest.to_string()).unwrap();
    let shared = |name: &str, is_forwarded| LiveChannel {
        name: name.to_owned(),
        source: Source::SharedMemory {
            host: "b".to_owned(),
            is_forwarded,
        },
        noted: Vec::new(),
        comes_again: is_forwarded,
    };
    let run = LiveRun {
        schema_version: LIVE_VERSION,
        name: "run".to_owned(),
        topology: "made-up".to_owned(),
        folder: place.run(),
        pid: std::process::id(),
        pid_start_ticks: start_ticks(std::process::id()),
        since: String::new(),
        has_one_clock: Some(true),
        domains: BTreeMap::from([("b".to_owned(), domain.address().to_string())]),
        processes: vec!["gateway".to_owned()],
        channels: vec![shared("own", false), shared("forwarded", true)],
    };
    let text = serde_json::to_string(&run).unwrap();
    for folder in [place.0.join("d"), place.run()] {
        fs::write(folder.join(LiveRun::FILE_NAME), &text).unwrap();
    }
    (domain, holders, run)
}

fn envelope(sequence: u64, flags: u32) -> Envelope {
    Envelope {
        sequence,
        published_ns: MonotonicClock::now().as_ns(),
        epoch: 1,
        flags,
        ..Envelope::default()
    }
}

/// What a feed said, in short.
#[derive(Debug, Default)]
struct Heard {
    messages: Vec<(String, Origin, u64)>,
    words: Vec<&'static str>,
}

impl Heard {
    fn poll(&mut self, feed: &mut Feed) -> Poll {
        feed.poll(&mut |event| match event {
            Event::Message {
                channel,
                origin,
                envelope,
                ..
            } => {
                let name = channel.description.name.clone();
                self.messages.push((name, origin, envelope.sequence));
            }
            Event::Record { .. } => self.words.push("record"),
            Event::Problem(text) => panic!("{text}"),
            Event::Silent => self.words.push("silent"),
            Event::Ended { .. } => self.words.push("ended"),
        })
    }

    fn of(&self, channel: &str) -> Vec<(Origin, u64)> {
        let mine = self.messages.iter().filter(|(name, ..)| name == channel);
        mine.map(|(_, origin, sequence)| (*origin, *sequence))
            .collect()
    }
}

#[test]
fn a_run_is_found_while_its_supervisor_holds_it_and_not_when_it_was_killed() {
    let place = Place::new("find");
    let (domain, holders, run) = announced(&place);
    let text = fs::read_to_string(place.run().join(LiveRun::FILE_NAME)).unwrap();
    assert_eq!(running_runs_below(&place.0), std::slice::from_ref(&run));
    let folder = place.run();
    assert_eq!(select(folder.to_str()).unwrap(), run);
    withdraw_abandoned(&OwnFolder::open(&place.0.join("d")).unwrap());
    assert!(run.is_announced());
    drop(holders);
    domain.remove();
    // What a killed supervisor leaves: the file, and nobody who holds the lock.
    fs::create_dir(place.0.join("d")).unwrap();
    fs::write(place.0.join("d").join(LiveRun::FILE_NAME), text).unwrap();
    assert!(run.is_announced() && running_runs_below(&place.0).is_empty());
    assert!(matches!(
        select(folder.to_str()),
        Err(SelectError::Over { .. })
    ));
    withdraw_abandoned(&OwnFolder::open(&place.0.join("d")).unwrap());
    assert!(!run.is_announced());
}

#[test]
fn messages_come_once_from_memory_or_from_records_and_what_was_missed_is_counted() {
    let place = Place::new("feed");
    let (domain, holders, run) = announced(&place);
    let other = Domain::open(domain.address()).unwrap();
    let mut own = RawOutput::open(&other, "own", false).unwrap();
    let mut forwarded = RawOutput::open(&other, "forwarded", false).unwrap();
    own.publish(&envelope(0, 0), &[0; 8]).unwrap();
    let mut feed = Feed::open(run).unwrap();
    assert_eq!(domain.observer_count(), 1);
    let mut heard = Heard::default();
    for sequence in 1..4 {
        own.publish(&envelope(sequence, 0), &[1; 8]).unwrap();
    }
    // Number 2 is lost in the network, number 3 comes late.
    for sequence in [0, 1, 4, 3] {
        let envelope = envelope(sequence, Envelope::FORWARDED);
        forwarded.publish(&envelope, &[2; 8]).unwrap();
    }
    while heard.poll(&mut feed) == Poll::Busy {}
    let from_memory = |sequence| (Origin::SharedMemory, sequence);
    assert_eq!(heard.of("own"), [1, 2, 3].map(from_memory));
    assert_eq!(heard.of("forwarded"), [0, 1, 4, 3].map(from_memory));
    assert_eq!(feed.counters("own").unwrap().earlier_count, 1);
    // More than the buffer holds: the oldest are gone, and counted.
    let depth = observer_depth(8) as u64;
    for sequence in 4..4 + depth + 10 {
        own.publish(&envelope(sequence, 0), &[3; 8]).unwrap();
    }
    while heard.poll(&mut feed) == Poll::Busy {}
    assert_eq!(heard.of("own").len() as u64, 3 + depth);
    assert_eq!(
        (feed.missed_count("own"), feed.missed_count("forwarded")),
        (10, 0)
    );
    // The gateway noted one message more than came out of the memory; the other host's records
    // have the one that the network lost as well.
    let records = place.run().join("records");
    let noted = header(RecordKind::Ingress, "forwarded", size_of::<IngressRecord>());
    for sequence in [0, 1, 4, 3, 5] {
        append(&records, &noted, "gateway", bytes_of(&ingress(sequence)));
    }
    let kept = header(RecordKind::Message, "forwarded", size_of::<Envelope>() + 8);
    for sequence in 0..6 {
        append(&records, &kept, "robot", bytes_of(&envelope(sequence, 0)));
        append(&records, &kept, "robot", &[2; 8]);
    }
    let elsewhere = header(RecordKind::Message, "elsewhere", size_of::<Envelope>() + 8);
    append(&records, &elsewhere, "robot", bytes_of(&envelope(0, 0)));
    append(&records, &elsewhere, "robot", &[2; 8]);
    for folder in [place.0.join("d"), place.run()] {
        fs::remove_file(folder.join(LiveRun::FILE_NAME)).unwrap();
    }
    while !heard.words.contains(&"silent") {
        heard.poll(&mut feed);
    }
    assert_eq!(domain.observer_count(), 0);
    let late: Vec<_> = heard.of("forwarded").split_off(4);
    assert_eq!(late, [2, 5].map(|sequence| (Origin::OtherHost, sequence)));
    assert_eq!(heard.of("elsewhere"), [(Origin::OtherHost, 0)]);
    assert_eq!(feed.missed_count("forwarded"), 1);
    for name in ["summary.json", "report.txt"] {
        fs::write(place.run().join(name), "").unwrap();
    }
    while heard.poll(&mut feed) != Poll::Over {}
    assert_eq!(heard.words.last(), Some(&"ended"));
    drop((own, forwarded, holders));
    drop(other);
    assert_eq!(domain.remove().remained, [] as [PathBuf; 0]);
}

#[test]
fn who_looks_from_now_on_gets_of_other_hosts_what_came_since() {
    let place = Place::new("now");
    let (domain, holders, run) = announced(&place);
    let other = Domain::open(domain.address()).unwrap();
    let mut forwarded = RawOutput::open(&other, "forwarded", false).unwrap();
    let mut feed = Feed::open(run).unwrap();
    feed.skip_to_now();
    // Three were published before; number 4 is lost in the network.
    for sequence in [3, 5] {
        let envelope = envelope(sequence, Envelope::FORWARDED);
        forwarded.publish(&envelope, &[2; 8]).unwrap();
    }
    let mut heard = Heard::default();
    while heard.poll(&mut feed) == Poll::Busy {}
    let records = place.run().join("records");
    let kept = header(RecordKind::Message, "forwarded", size_of::<Envelope>() + 8);
    let noted = header(
        RecordKind::Published,
        "forwarded",
        size_of::<PublishedRecord>(),
    );
    for sequence in 0..6 {
        append(&records, &kept, "robot", bytes_of(&envelope(sequence, 0)));
        append(&records, &kept, "robot", &[2; 8]);
        append(&records, &noted, "robot", bytes_of(&published(sequence)));
    }
    for folder in [place.0.join("d"), place.run()] {
        fs::remove_file(folder.join(LiveRun::FILE_NAME)).unwrap();
    }
    while !heard.words.contains(&"silent") {
        heard.poll(&mut feed);
    }
    let heard_numbers = heard.of("forwarded").into_iter();
    let heard_numbers: Vec<u64> = heard_numbers.map(|(_, sequence)| sequence).collect();
    assert_eq!(heard_numbers, [3, 5, 4]);
    assert_eq!(heard.words, ["record", "record", "record", "silent"]);
    drop((forwarded, holders));
    drop(other);
    assert_eq!(domain.remove().remained, [] as [PathBuf; 0]);
}

fn ingress(sequence: u64) -> IngressRecord {
    IngressRecord {
        sequence,
        published_ns: 1,
        handed_ns: 1,
        rx_hardware_ns: UNAVAILABLE,
        rx_software_ns: UNAVAILABLE,
        received_ns: MonotonicClock::now().as_ns(),
        forwarded_ns: MonotonicClock::now().as_ns(),
        realtime_offset_ns: 0,
        emulated_ns: UNAVAILABLE,
        due_ns: UNAVAILABLE,
        follow_up_sequence: 0,
        follow_up_ns: UNAVAILABLE,
        epoch: 1,
        session: 0,
        flags: 0,
        fragment_count: 1,
    }
}
