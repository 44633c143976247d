//! A run's folder as an MCAP file: what `hil-recorder` writes is read back by programs that share no
//! code with it, and is what the run recorded. The container's own reader in Rust always; with
//! `HIL_MCAP_PYTHON`, which names a Python with `tests/mcap_reader/requirements.txt`, the Python
//! packages `mcap` and `mcap-protobuf-support` as well.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;
use std::process::{Command, Output};
use std::time::Duration;

use hil_account::MessageFate;
use hil_arm::egm::messages::EgmFeedback;
use hil_core::message::Envelope;
use hil_report::summary::RunSummary;
use hil_rundir::record::RecordFile;
use hil_tests::binary::hil_recorder_binary;
use hil_tests::child::ChildGuard;
use hil_tests::mcap_file::{assert_code, metadata, python, read_back, recorder, words};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{RunFiles, Trial, wait_until_it_heeds_interrupts};
use nix::sys::signal::Signal;
use nix::sys::stat::Mode;
use nix::unistd::mkfifo;
use prost::Message;
use serde_json::Value;

const LIMIT: Duration = Duration::from_mins(1);
const FEEDBACK: &str = "egm/right/feedback";

/// What we look at of an `hil.EgmFeedback.v1`, by the positions of its fields.
#[derive(Message)]
struct Feedback {
    #[prost(uint64, tag = "1")]
    cycle_index: u64,
    #[prost(sint64, tag = "3")]
    reference_age_ns: i64,
    #[prost(double, repeated, tag = "4")]
    measured_rad: Vec<f64>,
    #[prost(uint32, tag = "7")]
    clock_ms: u32,
    #[prost(uint32, tag = "12")]
    flags: u32,
}

/// What we look at of an `hil.MessageLatency.v1`.
#[derive(Message)]
#[allow(clippy::struct_field_names, reason = "the names of the schema")]
struct Latency {
    #[prost(int64, optional, tag = "3")]
    published_ns: Option<i64>,
    #[prost(int64, optional, tag = "12")]
    forwarded_ns: Option<i64>,
    #[prost(int64, optional, tag = "14")]
    taken_ns: Option<i64>,
    #[prost(int64, optional, tag = "15")]
    delay_ns: Option<i64>,
}

fn convert(run: &Path, to: &Path) -> Output {
    recorder(&["convert", "--output"], &[to, run])
}

/// Starts a run on this machine and waits for its end.
fn run(trial: &Trial) -> RunFiles {
    let finished = trial.start_here().wait_within(LIMIT).unwrap();
    assert!(finished.status.success(), "{}", finished.stderr);
    trial.folder("", LIMIT)
}

/// The messages of a channel as its one record file has them.
fn recorded(run: &RunFiles, channel: &str) -> Vec<(Envelope, EgmFeedback)> {
    let start = format!("{}.message.", channel.replace('/', "."));
    let entries = fs::read_dir(run.root().join("records")).unwrap();
    let mut paths = entries.map(|entry| entry.unwrap().path());
    let of_channel = |path: &Path| {
        path.file_name()
            .is_some_and(|name| name.to_string_lossy().starts_with(&start))
    };
    let path = paths.find(|path| of_channel(path)).unwrap();
    let file = RecordFile::read(&path).unwrap();
    (0..file.record_count())
        .map(|index| file.message(index).unwrap())
        .map(|(envelope, payload)| (envelope, bytemuck::pod_read_unaligned(payload)))
        .collect()
}

/// Messages of each channel by the run's own account.
fn counts(summary: &RunSummary) -> BTreeMap<String, u64> {
    let channels = summary.channels.iter();
    let counted = channels.map(|channel| {
        let published = channel.account.as_ref().map(|account| {
            account.published_count - account.published_unrecorded_count.unwrap_or(0)
        });
        let recorded = channel.recorded.map(|figures| figures.message_count);
        let count = published.or(recorded).unwrap_or(0);
        (format!("/{}", channel.name), count)
    });
    counted.filter(|(_, count)| *count > 0).collect()
}

#[test]
fn a_run_becomes_a_file_that_others_read() {
    let folder = RunFolder::new("mcap");
    let trial = Trial::shipped("emulated.toml", folder.path())
        .set("run.duration=\"3 s\"")
        .on_own_ports(&["hop"]);
    let run = run(&trial);
    let file = folder.join("run.mcap");
    assert_code(&convert(run.root(), &file), 0);
    let topics = read_back(&file);
    let summary = run.summary();
    for (topic, count) in counts(&summary) {
        assert_eq!(topics[&topic].len() as u64, count, "{topic}");
    }
    check_feedback(&topics[&format!("/{FEEDBACK}")], &recorded(&run, FEEDBACK));
    let latencies = &topics[&format!("/net/{FEEDBACK}/latency")];
    let latencies = latencies
        .iter()
        .map(|one| Latency::decode(&*one.data).unwrap());
    let mut taken_count = 0;
    for one in latencies {
        assert!(one.published_ns.is_some());
        let taken = one.taken_ns.zip(one.published_ns);
        assert_eq!(
            one.delay_ns,
            taken.map(|(taken, published)| taken - published)
        );
        // Messages that a newer one replaced were forwarded and not taken.
        assert!(one.taken_ns.is_none() || one.forwarded_ns.is_some());
        taken_count += u64::from(one.taken_ns.is_some());
    }
    let channel = summary.channels.iter().find(|one| one.name == FEEDBACK);
    let account = channel.and_then(|one| one.account.as_ref()).unwrap();
    assert_eq!(taken_count, account.fates.of(MessageFate::Taken));
    let joints = &topics[&format!("/joints/{FEEDBACK}")];
    let schema = joints[0].channel.schema.as_ref().unwrap();
    assert_eq!(schema.name, "foxglove.JointStates");
    let link = &topics[&format!("/net/{FEEDBACK}/link")];
    assert_eq!(link.len() as u64, account.published_count);
    check_in_python(&file, &topics, &recorded(&run, FEEDBACK));
    let seed = &metadata(&file)["hil.run"]["seed"];
    assert_eq!(*seed, summary.run.seed.to_string());
}

fn check_feedback(read: &[mcap::Message<'_>], recorded: &[(Envelope, EgmFeedback)]) {
    assert_eq!(read.len(), recorded.len());
    // All publications of a run on one offset: differences of times are those of the clock.
    let first = (read[0].log_time, recorded[0].0.published_ns);
    for (message, (envelope, expected)) in read.iter().zip(recorded) {
        let schema = message.channel.schema.as_ref().unwrap();
        assert_eq!(schema.name, "hil.EgmFeedback.v1");
        assert_eq!(u64::from(message.sequence), envelope.sequence);
        let since_first = envelope.published_ns - first.1;
        assert_eq!(
            message.log_time.cast_signed() - first.0.cast_signed(),
            since_first
        );
        let found = Feedback::decode(&*message.data).unwrap();
        assert_eq!(found.cycle_index, expected.cycle_index);
        assert_eq!(found.reference_age_ns, expected.reference_age_ns);
        let bits = |values: &[f64]| values.iter().map(|one| one.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&found.measured_rad), bits(&expected.measured_rad));
        assert_eq!(
            (found.clock_ms, found.flags),
            (expected.clock_ms, expected.flags)
        );
    }
}

fn check_in_python(
    file: &Path,
    topics: &BTreeMap<String, Vec<mcap::Message<'static>>>,
    recorded: &[(Envelope, EgmFeedback)],
) {
    let feedback = format!("/{FEEDBACK}");
    let Some(read) = python(file, &[&feedback, "/scene", "/tf"]) else {
        return;
    };
    check_arms_in_python(&read);
    let found = read["topics"].as_object().unwrap();
    assert_eq!(found.len(), topics.len());
    for (topic, messages) in topics {
        assert_eq!(found[topic]["count"], messages.len(), "{topic}");
    }
    let messages = found[&feedback]["messages"].as_array().unwrap();
    for (message, (envelope, expected)) in messages.iter().zip(recorded) {
        assert_eq!(message["sequence"], envelope.sequence);
        let fields = &message["fields"];
        // What is zero is not there; 64-bit numbers are texts in protobuf's JSON.
        let cycle = fields["cycle_index"].as_str().unwrap_or("0");
        assert_eq!(cycle, expected.cycle_index.to_string());
        let list = |values: &Value| {
            let values = values.as_array().unwrap().iter();
            values
                .map(|one| one.as_f64().unwrap().to_bits())
                .collect::<Vec<_>>()
        };
        let bits = |values: &[f64]| values.iter().map(|one| one.to_bits()).collect::<Vec<_>>();
        assert_eq!(list(&fields["measured_rad"]), bits(&expected.measured_rad));
        let tool = &fields["tool"];
        let rotation = expected.tool.quaternion_wxyz;
        assert_eq!(list(&tool["quaternion_wxyz"]), bits(&rotation));
    }
    assert_eq!(read["metadata"]["hil.clocks"]["has_one_clock"], "true");
    let attachments = read["attachments"].as_array().unwrap();
    for name in ["summary.json", "yumi.urdf"] {
        assert!(attachments.contains(&Value::from(name)), "{name}");
    }
}

/// Frames move, and the shapes of the arms with them.
fn check_arms_in_python(read: &Value) {
    let topics = &read["topics"];
    assert_eq!(topics["/scene"]["schema"], "foxglove.SceneUpdate");
    assert_eq!(topics["/tf"]["schema"], "foxglove.FrameTransforms");
    let tools = |motion: &str| {
        let name = format!("right/{motion}/tool");
        let messages = topics["/tf"]["messages"].as_array().unwrap().iter();
        let places = messages.filter_map(|one| {
            let all = one["fields"]["transforms"].as_array()?;
            let frame = all
                .iter()
                .find(|one| one["child_frame_id"] == name.as_str())?;
            assert_eq!(frame["parent_frame_id"], "body");
            Some(frame["translation"].to_string())
        });
        places.collect::<BTreeSet<_>>()
    };
    for motion in ["desired", "measured"] {
        assert!(tools(motion).len() > 10, "{:?}", tools(motion));
    }
    let last = topics["/scene"]["messages"].as_array().unwrap().last();
    let entities = last.unwrap()["fields"]["entities"].as_array().unwrap();
    let measured = entities.iter().find(|one| one["id"] == "left arm measured");
    assert!(measured.unwrap()["cylinders"].as_array().unwrap().len() >= 5);
}

/// What we look at of a `foxglove.SceneUpdate`.
#[derive(Message)]
struct Scene {
    #[prost(message, repeated, tag = "2")]
    entities: Vec<Entity>,
}

#[derive(Message)]
struct Entity {
    #[prost(string, tag = "2")]
    frame_id: String,
    #[prost(string, tag = "3")]
    id: String,
}

#[test]
fn a_fleets_file_has_a_scene_whose_robots_move() {
    let folder = RunFolder::new("mcap-fleet");
    let trial = Trial::shipped("fleet-emulated.toml", folder.path())
        .set("run.duration=\"8 s\"")
        .set("case.parameters.fleets=2")
        .on_own_ports(&["commands", "states"]);
    let run = run(&trial);
    let (file, bare) = (folder.join("run.mcap"), folder.join("bare.mcap"));
    assert_code(&convert(run.root(), &file), 0);
    assert_code(
        &recorder(&["convert", "--no-scene", "--output"], &[&bare, run.root()]),
        0,
    );
    let (topics, without) = (read_back(&file), read_back(&bare));
    for (topic, count) in counts(&run.summary()) {
        assert_eq!(topics[&topic].len() as u64, count, "{topic}");
        assert_eq!(without[&topic].len() as u64, count, "{topic}");
    }
    assert!(!without.contains_key("/scene") && !without.contains_key("/scene/ground"));
    let scenes = &topics["/scene"];
    let apart = scenes
        .windows(2)
        .map(|two| two[1].log_time - two[0].log_time);
    assert!(
        apart.clone().all(|apart_ns| apart_ns == 50_000_000),
        "{:?}",
        apart.max()
    );
    let last = Scene::decode(&*scenes.last().unwrap().data).unwrap();
    let robot = last.entities.iter().find(|one| one.id == "fleet 1 robot 0");
    assert_eq!(robot.unwrap().frame_id, "map_1");
    assert!(!topics["/scene/ground"].is_empty());
    check_scene_in_python(&file);
}

/// Robots go somewhere, and sections say who may pass.
fn check_scene_in_python(file: &Path) {
    let Some(read) = python(file, &["/scene"]) else {
        return;
    };
    let scenes = read["topics"]["/scene"]["messages"].as_array().unwrap();
    let mut places: BTreeMap<&str, BTreeSet<String>> = BTreeMap::new();
    let mut section_count = 0;
    for entity in scenes
        .iter()
        .flat_map(|one| one["fields"]["entities"].as_array().unwrap())
    {
        let id = entity["id"].as_str().unwrap();
        if id.contains("section") {
            section_count += 1;
            assert_eq!(entity["metadata"][1]["key"], "may_pass");
            assert!(entity["lines"][0]["points"].as_array().unwrap().len() > 2);
        } else if id.contains("robot") {
            let place = entity["cubes"][0]["pose"]["position"].to_string();
            places.entry(id).or_default().insert(place);
        }
    }
    let moved = places.values().filter(|places| places.len() > 10).count();
    assert!(moved >= 4, "{moved} of {} robots move", places.len());
    assert!(section_count > 0);
}

#[test]
fn what_a_killed_writer_left_becomes_whole_again() {
    let folder = RunFolder::new("mcap-broken");
    let trial = Trial::shipped("shuttle-local.toml", folder.path()).set("run.duration=\"2 s\"");
    let run = run(&trial);
    let file = folder.join("run.mcap");
    assert_code(&convert(run.root(), &file), 0);
    // What exists is left alone unless one says otherwise.
    let before = fs::read(&file).unwrap();
    assert_code(&convert(run.root(), &file), 2);
    assert_code(&convert(&folder.join("none"), &folder.join("x.mcap")), 2);
    assert!(!folder.join("x.mcap").exists());
    let whole = read_back(&file);
    let (broken, mended) = (folder.join("broken.mcap"), folder.join("mended.mcap"));
    for (kept, force) in [(before.len() / 3, false), (before.len() - 20, true)] {
        fs::write(&broken, &before[..kept]).unwrap();
        assert!(mcap::Summary::read(&before[..kept]).is_err());
        let flags: &[&str] = if force {
            &["recover", "--force", "--output"]
        } else {
            &["recover", "--output"]
        };
        let recovered = recorder(flags, &[&mended, &broken]);
        assert_code(&recovered, 0);
        assert!(
            words(&recovered).contains("lost: byte "),
            "{}",
            words(&recovered)
        );
        let found = read_back(&mended);
        for (topic, messages) in &found {
            let expected = &whole[topic][..messages.len()];
            assert!(messages.iter().zip(expected).all(|(a, b)| a.data == b.data));
        }
        // Without its end a file has lost nothing but its summary.
        assert!(!force || found.len() == whole.len());
        assert!(metadata(&mended).contains_key("hil.recovery"));
    }
    let foreign = folder.write("foreign.mcap", "something else");
    assert_code(
        &recorder(&["recover", "--output"], &[&folder.join("y"), &foreign]),
        2,
    );
    assert!(!folder.join("y").exists());
}

/// Work that looks for no signal, as reading a large file in one piece, does not keep Ctrl-C waiting: here
/// a file that never ends being opened.
#[test]
fn an_interrupted_conversion_ends_whatever_it_does_and_leaves_no_file() {
    let folder = RunFolder::new("mcap-interrupted");
    let trial = Trial::shipped("shuttle-local.toml", folder.path()).set("run.duration=\"1 s\"");
    let run = run(&trial);
    let records = fs::read_dir(run.root().join("records")).unwrap();
    let mut paths = records.map(|entry| entry.unwrap().path());
    let path = paths.find(|path| path.to_string_lossy().contains(".taken."));
    let path = path.unwrap();
    fs::remove_file(&path).unwrap();
    mkfifo(&path, Mode::S_IRUSR | Mode::S_IWUSR).unwrap();
    let output = folder.join("output");
    fs::create_dir(&output).unwrap();
    let mut command = Command::new(hil_recorder_binary());
    command.arg("convert").arg(run.root()).arg("--output");
    command.arg(output.join("run.mcap"));
    let mut converting = ChildGuard::spawn(&mut command).unwrap();
    wait_until_it_heeds_interrupts(&converting, LIMIT);
    converting.signal(Signal::SIGINT).unwrap();
    let finished = converting.wait_within(LIMIT).unwrap();
    assert_eq!(finished.status.code(), Some(130), "{finished:?}");
    let words = "ended by Ctrl-C (SIGINT); no file was written";
    assert!(finished.stderr.contains(words), "{finished:?}");
    assert_eq!(fs::read_dir(&output).unwrap().count(), 0);
}
