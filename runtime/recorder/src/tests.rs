//! Made-up run folders and damaged files: what a recording keeps of them, and what it says is gone.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::{fs, process};

use bytemuck::Zeroable;
use hil_core::message::Envelope;
use hil_core::random::RandomStream;
use hil_rundir::manifest::{ChannelDescription, FieldDescription, KindDescription};
use hil_rundir::record::RecordKind;
use hil_rundir::record::file::RecordHeader;
use serde_json::json;

use crate::convert::convert;
use crate::failure::{Exit, Failure};
use crate::record::Recorded;
use crate::recover::{Recovered, recover};
use crate::scan::scan;

/// Messages of each made-up channel: enough for several chunks.
const MESSAGE_COUNT: u64 = 60_000;

struct Folder(PathBuf);

impl Folder {
    fn new() -> Self {
        static NEXT: AtomicUsize = AtomicUsize::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let name = format!("hil-recorder-{}-{number}", process::id());
        let path = std::env::temp_dir().join(name);
        fs::create_dir_all(path.join("run/records")).unwrap();
        Self(path)
    }

    fn at(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// A record file of `channel` with these messages of 64 bytes.
    fn record(&self, channel: &str, sequences: impl Iterator<Item = u64>) -> PathBuf {
        let header = RecordHeader {
            kind: RecordKind::Message,
            channel: channel.to_owned(),
            record_bytes: 128,
            instance: 0,
        };
        let path = self.at("run/records").join(header.file_name("robot"));
        let mut bytes = header.encode(&path).unwrap().to_vec();
        for sequence in sequences {
            let envelope = Envelope {
                sequence,
                published_ns: 1_000_000_000 + i64::try_from(sequence).unwrap() * 1_000_000,
                ..Envelope::zeroed()
            };
            bytes.extend_from_slice(bytemuck::bytes_of(&envelope));
            for word in 0..8_u64 {
                // Noise, so that chunks do not shrink to nothing.
                let noise = (sequence + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (word << 56);
                bytes.extend_from_slice(&noise.to_le_bytes());
            }
        }
        fs::write(&path, bytes).unwrap();
        path
    }

    fn manifest(&self, channels: &[ChannelDescription]) {
        let manifest = json!({
            "schema_version": 1,
            "program": { "name": "hil-runtime", "version": "0" },
            "hosts_here": ["here"],
            "realtime_minus_monotonic_ns": 1_700_000_000_000_000_000_i64,
            "channels": channels,
        });
        fs::write(self.at("run/manifest.json"), manifest.to_string()).unwrap();
    }

    fn convert(&self) -> Result<Recorded, Failure> {
        convert(&self.at("run"), &self.at("run.mcap"), true, &mut |_, _| {
            None
        })
    }

    fn recover(&self, bytes: &[u8]) -> Result<Recovered, String> {
        fs::write(self.at("broken.mcap"), bytes).unwrap();
        let (from, to) = (self.at("broken.mcap"), self.at("whole.mcap"));
        recover(&from, &to, &mut |_| None).map_err(|error| error.to_string())
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        drop(fs::remove_dir_all(&self.0));
    }
}

fn described(name: &str, kind: KindDescription, count: usize) -> ChannelDescription {
    ChannelDescription {
        name: name.to_owned(),
        message: "my.Message.v1".to_owned(),
        size_bytes: 64,
        fields: vec![FieldDescription {
            name: "words".to_owned(),
            kind,
            count: Some(count),
            offset_bytes: 0,
        }],
        from_host: Some("here".to_owned()),
        to_host: None,
    }
}

/// What the container's own reader finds in a whole file.
#[derive(Debug, Default)]
struct Held {
    /// By topic: its schema, messages, and the time of the first.
    topics: BTreeMap<String, (String, Vec<u64>)>,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
}

impl Held {
    fn of(path: &Path) -> Self {
        let bytes = fs::read(path).unwrap();
        let mut held = Self::default();
        let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
        let channels: BTreeMap<_, _> = summary.channels.into_iter().collect();
        for channel in channels.values() {
            let schema = channel.schema.as_ref().unwrap().name.clone();
            held.topics
                .insert(channel.topic.clone(), (schema, Vec::new()));
        }
        for message in mcap::MessageStream::new(&bytes).unwrap() {
            let message = message.unwrap();
            let (_, times) = held.topics.get_mut(&message.channel.topic).unwrap();
            times.push(message.log_time);
        }
        for record in mcap::read::LinearReader::new(&bytes).unwrap() {
            if let mcap::records::Record::Metadata(one) = record.unwrap() {
                held.metadata.insert(one.name, one.metadata);
            }
        }
        held
    }

    fn schemas(&self) -> BTreeMap<&str, (&str, usize)> {
        let topics = self.topics.iter();
        topics
            .map(|(topic, (schema, times))| (topic.as_str(), (schema.as_str(), times.len())))
            .collect()
    }

    fn first_ns(&self, topic: &str) -> Option<u64> {
        self.topics[topic].1.iter().min().copied()
    }

    fn message_count(&self) -> usize {
        self.topics.values().map(|(_, times)| times.len()).sum()
    }
}

#[test]
fn a_folder_with_nothing_but_records_is_kept_as_bytes() {
    let folder = Folder::new();
    folder.record("a/b", 0..3);
    folder.record("/a/b", 0..2);
    folder.record("", 0..0);
    let converted = folder.convert().unwrap();
    assert_eq!(converted.message_count, 5);
    // A missing manifest is a gap of the run's folder.
    assert!(converted.has_gaps);
    let info = Held::of(&folder.at("run.mcap"));
    let bytes = "google.protobuf.BytesValue";
    let expected = [
        ("/", (bytes, 0)),
        ("/a/b", (bytes, 2)),
        ("/a/b_2", (bytes, 3)),
    ];
    assert_eq!(info.schemas(), BTreeMap::from(expected));
    let gaps = &info.metadata["hil.recording"];
    assert_eq!(gaps["unreadable_file_count"], "1");
    assert_eq!(gaps["renamed /a/b_2"], "/a/b was taken");
    let clocks = &info.metadata["hil.clocks"];
    assert_eq!(clocks["has_one_clock"], "unknown");
    let basis = &clocks["(unknown host)/basis"];
    assert!(basis.starts_with("monotonic"), "{basis}");
    assert_eq!(info.first_ns("/a/b"), Some(1_000_000_000));
}

#[test]
fn layouts_that_do_not_fit_cost_types_and_no_messages() {
    let folder = Folder::new();
    let good = described("good", KindDescription::U64, 8);
    let short = described("short", KindDescription::U64, 7);
    let mut other = described("other", KindDescription::U64, 9);
    other.size_bytes = 72;
    let unknown = ChannelDescription {
        fields: Vec::new(),
        ..described("unknown", KindDescription::U8, 64)
    };
    folder.manifest(&[good, short, other, unknown]);
    for name in ["good", "short", "other", "unknown"] {
        folder.record(name, 0..4);
    }
    let converted = folder.convert().unwrap();
    assert_eq!((converted.message_count, converted.has_gaps), (16, false));
    let words = converted.words.join("\n");
    for part in [
        "end at byte 56, and it has 64",
        "72 bytes by the manifest",
        "not known",
    ] {
        assert!(words.contains(part), "{words}");
    }
    let info = Held::of(&folder.at("run.mcap"));
    assert_eq!(info.schemas()["/good"], ("my.Message.v1", 4));
    assert_eq!(info.schemas()["/short"].0, "google.protobuf.BytesValue");
    assert_eq!(info.metadata["hil.clocks"]["has_one_clock"], "true");
    // By the read of both clocks that the manifest has.
    assert_eq!(info.first_ns("/good"), Some(1_700_000_001_000_000_000));
}

#[test]
fn what_is_cut_short_is_counted() {
    let folder = Folder::new();
    folder.manifest(&[described("a", KindDescription::U64, 8)]);
    let path = folder.record("a", [0, 2, 3, 4].into_iter());
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() - 1]).unwrap();
    fs::write(folder.at("run/records/b.taken.x.0.rec"), "").unwrap();
    fs::write(folder.at("run/summary.json"), "{").unwrap();
    let converted = folder.convert().unwrap();
    assert_eq!((converted.message_count, converted.has_gaps), (3, true));
    let gaps = &Held::of(&folder.at("run.mcap")).metadata["hil.recording"];
    assert_eq!(gaps["truncated_bytes"], "127");
    assert_eq!(gaps["unreadable_file_count"], "2");
    assert_eq!(gaps["missing a"], "1");
    assert!(gaps["gap_0002"].contains("half a record"), "{gaps:?}");
}

#[test]
fn a_signal_leaves_no_file() {
    let folder = Folder::new();
    folder.record("a", 0..9000);
    for wanted in ["reading", "writing"] {
        let mut stop = |_: Option<f64>, words: &str| words.starts_with(wanted).then_some("Ctrl-C");
        let stopped = convert(&folder.at("run"), &folder.at("run.mcap"), true, &mut stop);
        let interrupted = Failure::interrupted("ended by Ctrl-C; no file was written");
        assert_eq!(stopped.unwrap_err(), interrupted);
        assert_eq!(fs::read_dir(&folder.0).unwrap().count(), 1);
    }
    assert!(folder.convert().is_ok());
    let (from, to) = (folder.at("run.mcap"), folder.at("b.mcap"));
    assert!(recover(&from, &to, &mut |_| Some("SIGTERM")).is_err());
    assert_eq!(fs::read_dir(&folder.0).unwrap().count(), 2);
}

#[test]
fn other_folders_and_files_are_named_as_such() {
    let folder = Folder::new();
    fs::remove_dir(folder.at("run/records")).unwrap();
    let refused = |words: &str| {
        let failure = folder.convert().unwrap_err();
        assert_eq!(failure.exit, Exit::Usage);
        assert!(failure.words.contains(words), "{failure}");
    };
    refused("run/records: not a run's folder: No such file");
    fs::write(folder.at("run/summary.json"), "{}").unwrap();
    refused("a folder of `simulate` has no records");
    assert!(!folder.at("run.mcap").exists());
    for bytes in [&b""[..], b"\x89MCAP0\r", b"HILREC01 and more"] {
        assert!(
            folder
                .recover(bytes)
                .unwrap_err()
                .contains("not an MCAP file")
        );
    }
    let missing = recover(&folder.at("none"), &folder.at("whole.mcap"), &mut |_| None);
    let missing = missing.unwrap_err();
    assert_eq!(missing.exit, Exit::Failed);
    assert!(missing.words.contains("cannot read"), "{missing}");
}

/// A whole file of [`MESSAGE_COUNT`] messages, and where its chunks begin and end.
fn whole(folder: &Folder) -> (Vec<u8>, Vec<(usize, usize)>) {
    folder.manifest(&[described("a", KindDescription::U64, 8)]);
    folder.record("a", 0..MESSAGE_COUNT);
    assert_eq!(folder.convert().unwrap().message_count, MESSAGE_COUNT);
    let bytes = fs::read(folder.at("run.mcap")).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let chunks = summary.chunk_indexes.iter().map(|chunk| {
        let start = usize::try_from(chunk.chunk_start_offset).unwrap();
        (start, start + usize::try_from(chunk.chunk_length).unwrap())
    });
    (bytes, chunks.collect())
}

#[test]
fn cut_anywhere_all_before_is_kept() {
    let folder = Folder::new();
    let (bytes, chunks) = whole(&folder);
    assert!(chunks.len() > 4, "{}", chunks.len());
    let recovered = folder.recover(&bytes).unwrap();
    assert_eq!(recovered.message_count, MESSAGE_COUNT);
    assert!(recovered.end.is_complete && recovered.end.losses.is_empty());
    assert_eq!(recovered.lost_count(), Some(0));
    let mut last_count = 0;
    for &(start, end) in &chunks[1..] {
        let middle = usize::midpoint(start, end);
        for cut in [start, start + 5, start + 30, middle, end] {
            let recovered = folder.recover(&bytes[..cut]).unwrap();
            assert_eq!(recovered.end.losses.len(), 1, "{:?}", recovered.end.losses);
            assert!(recovered.message_count >= last_count);
            // Less than a block of the compression is in there: 128 KiB.
            if cut == middle && end - start > 300_000 {
                let kept_count = recovered.message_count - last_count;
                assert!(kept_count > 0, "nothing of a chunk cut at {cut}");
            }
            let info = Held::of(&folder.at("whole.mcap"));
            assert_eq!(info.message_count() as u64, recovered.message_count);
            last_count = recovered.message_count;
        }
    }
    assert_eq!(last_count, MESSAGE_COUNT);
}

#[test]
fn damage_in_the_middle_costs_its_chunk_only() {
    let folder = Folder::new();
    let (mut bytes, chunks) = whole(&folder);
    let (start, end) = chunks[2];
    bytes[usize::midpoint(start, end)] ^= 0x55;
    let recovered = folder.recover(&bytes).unwrap();
    let losses = &recovered.end.losses;
    assert_eq!((losses.len(), losses[0].offset), (1, start as u64));
    let lost = losses[0].message_count.unwrap();
    assert!(lost > 0);
    assert_eq!(recovered.message_count + lost, MESSAGE_COUNT);
    assert_eq!(recovered.lost_count(), Some(lost));
    let words = &Held::of(&folder.at("whole.mcap")).metadata["hil.recovery"];
    assert!(
        words["loss_0001"].starts_with(&format!("byte {start}, ")),
        "{words:?}"
    );
}

#[test]
fn topics_are_found_in_the_summary_when_their_chunk_is_damaged() {
    let folder = Folder::new();
    let (mut bytes, chunks) = whole(&folder);
    let (start, end) = chunks[0];
    bytes[usize::midpoint(start, end)] ^= 0x55;
    let recovered = folder.recover(&bytes).unwrap();
    assert_eq!(recovered.message_count, MESSAGE_COUNT);
    assert_eq!(
        (recovered.homeless_count, recovered.end.losses.len()),
        (0, 1)
    );
    let info = Held::of(&folder.at("whole.mcap"));
    assert_eq!(info.schemas()["/a"], ("my.Message.v1", 60_000));
    // Without the summary nobody knows what the messages are.
    let cut = chunks.last().unwrap().1;
    let recovered = folder.recover(&bytes[..cut]).unwrap();
    assert_eq!(
        (recovered.message_count, recovered.homeless_count),
        (0, MESSAGE_COUNT)
    );
}

#[test]
fn a_tail_of_zeros_and_a_writer_that_never_came_back_are_read() {
    let folder = Folder::new();
    let (bytes, chunks) = whole(&folder);
    let (start, end) = chunks[3];
    let mut zeros = bytes[..start].to_vec();
    zeros.extend_from_slice(&[0; 5000]);
    let recovered = folder.recover(&zeros).unwrap();
    assert_eq!(recovered.end.losses[0].offset, start as u64);
    let before = recovered.message_count;
    // A writer fills in sizes when a chunk ends; until then they are all ones.
    let mut unfinished = bytes[..end - 100].to_vec();
    unfinished[start + 1..start + 9].fill(0xff);
    unfinished[start + 9 + 16..start + 9 + 28].fill(0xff);
    unfinished[start + 9 + 36..start + 9 + 44].fill(0xff);
    let recovered = folder.recover(&unfinished).unwrap();
    assert!(
        recovered.message_count > before,
        "{:?}",
        recovered.end.losses
    );
    assert_eq!(recovered.lost_count(), None);
}

fn below(stream: &mut RandomStream, count: usize) -> usize {
    usize::try_from(stream.next_u64()).unwrap() % count
}

#[test]
fn no_damaged_byte_brings_the_reader_down() {
    let folder = Folder::new();
    folder.manifest(&[described("a", KindDescription::U64, 8)]);
    folder.record("a", 0..40);
    folder.convert().unwrap();
    let bytes = fs::read(folder.at("run.mcap")).unwrap();
    let mut stream = RandomStream::new(7, "damage");
    for _ in 0..400 {
        let mut damaged = bytes.clone();
        for _ in 0..3 {
            let at = below(&mut stream, damaged.len());
            damaged[at] = u8::try_from(below(&mut stream, 256)).unwrap();
        }
        let cut = below(&mut stream, damaged.len());
        for bytes in [&damaged[..], &damaged[..cut]] {
            if let Ok(recovered) = folder.recover(bytes) {
                assert!(recovered.message_count <= 40);
                let end = scan(&folder.at("whole.mcap"), &mut |_, _| true);
                assert!(end.unwrap().is_complete);
            }
        }
    }
}
