//! Runs that never were, replayed by a case of two channels.

use core::sync::atomic::{AtomicU32, Ordering};

use super::*;
use hil_core::case_study::{CaseStudy, ChannelSpec, ParameterError, Score};
use hil_core::component::Role;
use hil_core::message::Envelope;
use hil_core::run_log::RunLog;
use hil_core::time::Instant;
use hil_shuttle::{Shuttle, ShuttleCommand, ShuttleStatus};

use hil_rundir::record::{RecordKind, Recorder};

/// Replays a robot that reports twice of what it heard.
#[derive(Debug)]
struct Doubler;

impl CaseStudy for Doubler {
    const NAME: &'static str = "doubler";
    const SUMMARY: &'static str = "reports twice of what it heard";
    const ROLES: &'static [&'static str] = &["robot", "controller"];
    const CHANNELS: &'static [ChannelSpec] = &[
        ChannelSpec::of::<ShuttleStatus>("status", "robot", "controller"),
        ChannelSpec::recorded::<ShuttleCommand>("heard", "robot"),
    ];
    type Parameters = Shuttle;

    fn new(_parameters: Shuttle, _seed: u64) -> Result<Self, ParameterError> {
        Ok(Self)
    }

    fn role(&self, _name: &str) -> Option<Box<dyn Role>> {
        None
    }

    fn score(&self, _log: &RunLog) -> Score {
        Score::default()
    }

    fn replay(&self, log: &RunLog) -> Option<Replay> {
        let mut replay = Replay {
            method: "twice of each".to_owned(),
            ..Replay::default()
        };
        let mut reported = log.messages::<ShuttleStatus>("status");
        for (at, heard) in log.messages::<ShuttleCommand>("heard") {
            replay.input_count += 1;
            let Some((_, status)) = reported.next() else {
                continue;
            };
            replay.compared_count += 1;
            let expected = 2.0 * heard.speed_mps;
            if expected.to_bits() != status.position_m.to_bits() {
                replay.different_count += 1;
                let words = format!("{expected}, not {}, at {at}", status.position_m);
                replay.first_difference.get_or_insert(words);
            }
        }
        Some(replay)
    }
}

static RUNS: AtomicU32 = AtomicU32::new(0);

struct Run {
    folder: RunFolder,
}

impl Run {
    /// A run's folder with a manifest of `case` and nothing else.
    fn of(case: &str) -> Self {
        let number = RUNS.fetch_add(1, Ordering::Relaxed);
        let root = format!("hil-replay-{}-{number}", std::process::id());
        let folder = RunFolder::existing(&std::env::temp_dir().join(root));
        fs::create_dir_all(folder.records()).unwrap();
        let manifest = json!({
            "schema_version": 1,
            "program": { "name": "hil-runtime", "version": "1" },
            "seed": 7,
            "topology": { "case": { "name": case, "parameters": { "gain_per_s": 2.5 } } },
        });
        fs::write(folder.manifest(), manifest.to_string()).unwrap();
        Self { folder }
    }

    /// Records one double per message of `channel`, those of the `given` numbers only.
    fn record(&self, channel: &str, size: usize, given: &[u64], value: impl Fn(u64) -> f64) {
        let mut recorder = Recorder::new(&self.folder.records(), "robot", 0);
        let bytes = size_of::<Envelope>() + size;
        let mut sink = recorder
            .sink(RecordKind::Message, channel, bytes, 1_000)
            .unwrap();
        for sequence in given {
            let envelope = Envelope {
                sequence: *sequence,
                epoch: 1,
                published_ns: Instant::ZERO.as_ns(),
                ..Envelope::default()
            };
            let mut payload = vec![0; size];
            payload[..8].copy_from_slice(&value(*sequence).to_le_bytes());
            sink.push_message(&envelope, &payload);
        }
        recorder.start().unwrap();
        assert_eq!(recorder.finish().dropped_count, 0);
    }

    fn replay(&self) -> Result<Replayed, ReplayError> {
        let mut registry = Registry::default();
        registry.add::<Doubler>();
        registry.add::<Shuttle>();
        replay(&self.folder, &registry, &|_, _| {})
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        let _gone = fs::remove_dir_all(self.folder.root()).is_ok();
    }
}

const ALL: [u64; 5] = [0, 1, 2, 3, 4];

#[test]
fn a_run_that_comes_out_the_same_is_identical() {
    let run = Run::of("doubler");
    run.record("heard", 16, &ALL, |sequence| sequence as f64);
    run.record("status", 8, &ALL, |sequence| 2.0 * sequence as f64);
    let replayed = run.replay().unwrap();
    assert!(replayed.is_identical(), "{replayed:?}");
    let text = replayed.text(100);
    assert!(text.starts_with("doubler · hil-replay-"), "{text}");
    assert!(text.contains(": identical\n"), "{text}");
    assert!(text.contains("  method        twice of each\n"), "{text}");
    assert!(
        text.contains("  compared      5 messages, none differs\n"),
        "{text}"
    );
    let value: serde_json::Value = serde_json::from_str(&replayed.json()).unwrap();
    assert_eq!(value["is_identical"], true);
    assert_eq!(value["replay"]["compared_count"], 5);
}

#[test]
fn a_single_bit_is_a_difference_and_is_shown() {
    let run = Run::of("doubler");
    run.record("heard", 16, &ALL, |sequence| sequence as f64);
    run.record("status", 8, &ALL, |sequence| {
        let exact = 2.0 * sequence as f64;
        if sequence == 3 {
            exact.next_up()
        } else {
            exact
        }
    });
    let replayed = run.replay().unwrap();
    assert!(!replayed.is_identical());
    let text = replayed.text(100);
    assert!(text.contains(": DIFFERENT\n"), "{text}");
    assert!(text.contains("5 messages, 1 differs\n"), "{text}");
    assert!(text.contains("  first difference 6, not 6.00"), "{text}");
}

#[test]
fn a_missing_record_is_a_gap_and_no_proof() {
    let run = Run::of("doubler");
    run.record("heard", 16, &[0, 1, 2, 4], |sequence| sequence as f64);
    run.record("status", 8, &[0, 1, 2], |sequence| 2.0 * sequence as f64);
    let replayed = run.replay().unwrap();
    assert!(!replayed.is_identical());
    let text = replayed.text(100);
    assert!(text.contains(": records are missing\n"), "{text}");
    let gap = "  gaps          heard: 1 missing in its record\n";
    assert!(text.contains(gap), "{text}");

    let deaf = Run::of("doubler");
    deaf.record("status", 8, &ALL, |_| 0.0);
    let text = deaf.replay().unwrap().text(100);
    assert!(text.contains(": nothing was compared\n"), "{text}");
    assert!(text.contains("heard: no record is at hand\n"), "{text}");
}

#[test]
fn what_cannot_be_replayed_is_said_to_be_so() {
    let error = |run: &Run| run.replay().unwrap_err().to_string();
    let run = Run::of("shuttle");
    assert!(error(&run).contains("no messages are recorded here"));
    run.record("shuttle/command", 16, &ALL, |_| 0.0);
    let expected = "case shuttle has no replay; `hil-runtime cases` lists what each case offers";
    assert_eq!(error(&run), expected);
    let unknown = "the run is of case submarine, which this program does not know";
    assert_eq!(error(&Run::of("submarine")), unknown);
    fs::remove_file(run.folder.manifest()).unwrap();
    assert!(error(&run).contains("manifest.json: not a run's folder: "));
    let manifest = json!({
        "schema_version": 1,
        "program": { "name": "hil-runtime", "version": "1" },
    });
    fs::write(run.folder.manifest(), manifest.to_string()).unwrap();
    assert_eq!(
        error(&run),
        "the run is of no case; only a case can be replayed"
    );
}

#[test]
fn a_manifest_without_the_name_of_its_case_is_damaged() {
    let run = Run::of("doubler");
    for case in [
        json!({ "parameters": {} }),
        json!({ "name": 7 }),
        json!("doubler"),
    ] {
        let manifest = json!({
            "schema_version": 1,
            "program": { "name": "hil-runtime", "version": "1" },
            "topology": { "case": case },
        });
        fs::write(run.folder.manifest(), manifest.to_string()).unwrap();
        let error = run.replay().unwrap_err().to_string();
        let expected = "manifest.json: not a run's folder: topology.case.name is ";
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn a_long_method_wraps_within_the_page() {
    let replay = Replay {
        method: "twice of each and nothing but that ".repeat(8),
        ..Replay::default()
    };
    let replayed = Replayed {
        run: "run".to_owned(),
        case: "doubler".to_owned(),
        replay,
    };
    let text = replayed.text(100);
    let widths = text.lines().map(|line| line.chars().count());
    assert!(widths.max().is_some_and(|width| width <= 100), "{text}");
    assert!(text.lines().count() > 4, "{text}");
}
