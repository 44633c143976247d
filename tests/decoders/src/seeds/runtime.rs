//! Seeds of what the processes and hosts of a run leave for each other.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use hil_arm::egm::messages::{EgmCommand, EgmFeedback};
use hil_core::layout::Field;
use hil_core::message::Message;
use hil_core::time::Instant;
use hil_engine::supervisor::frame::{PeerHello, PeerMessage, Resumed, write_chunk, write_message};
use hil_engine::supervisor::peer_status::HostTicks;
use hil_report::summary::{Fact, Outcome, RunFacts, RunSummary};
use hil_rundir::event::{Event, EventKind, HostHistory, Interruption, ProcessHistory, ProcessKind};
use hil_rundir::file_fault::{GapCause, RecordGap};
use hil_rundir::manifest::describe_fields;
use hil_rundir::record::RecordKind;
use hil_rundir::record::file::RecordHeader;
use hil_rundir::run_result::Outcome as RunOutcome;
use hil_shuttle::{ShuttleCommand, ShuttleStatus};
use hil_topology::load;
use serde_json::json;

use super::{behind, numbered};
use crate::topology::known;
use crate::{Seed, package_folder};

fn shipped(name: &str) -> PathBuf {
    package_folder().join("../../deploy/topologies").join(name)
}

/// Topologies that ship, with all their defaults, and a short one as a person writes it.
pub(crate) fn topologies() -> Vec<Seed> {
    const SHORT: &str = r#"version = 1
name = "short"
run = { duration = "2 min", seed = 7 }
case = { name = "shuttle", parameters = { rate_hz = 125 } }
hosts = { a = { address = "10.77.0.1" }, b = { address = "::1" } }
[processes]
controller = { host = "a", role = "controller", cpu = [1, 2] }
robot = { host = "b", role = "robot", on_exit = "restart", restart_limit = 2 }
[channels]
"shuttle/command" = { depth = 4, link = "hop" }
"shuttle/status".link = "hop"
[links.hop]
via = "emulated"
between = ["b", "a"]
delay = "50 ms"
backward.loss_ratio = 0.1
outages = { mean = "500 ms", per_hour = 100, buffered = true }
gateway.wait = "hybrid"
"#;
    let mut seeds = vec![("short".to_owned(), SHORT.as_bytes().to_vec())];
    for name in [
        "bad-link",
        "egm-robot",
        "fleet-emulated",
        "shuttle-split",
        "shuttle-tcp",
        "wifi6",
    ] {
        let path = shipped(&format!("{name}.toml"));
        let topology = load(&path, &[], &known());
        let topology = topology.unwrap_or_else(|errors| panic!("{errors}"));
        seeds.push((name.to_owned(), topology.to_toml().into_bytes()));
    }
    seeds
}

pub(crate) fn record_files() -> Vec<Seed> {
    let file = |kind, record_bytes: u32, body: usize| {
        let header = RecordHeader {
            kind,
            channel: "arm/command".to_owned(),
            record_bytes,
            instance: 2,
        };
        let head = header.encode(Path::new("seed")).expect("a short name");
        let body = (0..body).map(|at| (at % 251).to_le_bytes()[0]);
        head.into_iter().chain(body).collect::<Vec<u8>>()
    };
    let inputs = [
        file(RecordKind::Published, 24, 48),
        file(RecordKind::Ingress, 104, 150),
        file(RecordKind::Message, 88, 264),
        file(RecordKind::Taken, 40, 0),
    ];
    numbered("records", inputs)
}

pub(crate) fn peer_frames() -> Vec<Seed> {
    let at = Instant::from_ns;
    let story = HostHistory {
        hosts: vec!["robot-pc".to_owned()],
        span: (at(5), at(9)),
        events: vec![Event {
            at: at(7),
            host: "robot-pc".to_owned(),
            process: "robot".to_owned(),
            kind: EventKind::EndedRun {
                end: "was killed by SIGKILL".to_owned(),
            },
            interruption: Some(Interruption {
                from: at(6),
                until: None,
            }),
        }],
        discipline: None,
        processes: vec![ProcessHistory {
            name: "robot".to_owned(),
            host: "robot-pc".to_owned(),
            kind: ProcessKind::Component,
            role: Some("robot".to_owned()),
            end: "ended".to_owned(),
            restart_count: 1,
            report: None,
        }],
        cards: Vec::new(),
    };
    let hello = PeerHello {
        version: "0.1.0".to_owned(),
        topology_hash: 7,
        host: "robot-pc".to_owned(),
        clock_id: 9,
        domain: [3; 16],
        has_fast_aes: true,
        resumed: Some(Resumed {
            of: [6; 16],
            come_count: 7,
        }),
    };
    let messages = [
        PeerMessage::Hello(hello),
        PeerMessage::Refused("another topology".to_owned()),
        PeerMessage::Ready,
        PeerMessage::Start {
            has_one_clock: true,
        },
        PeerMessage::Alive,
        PeerMessage::Acknowledged {
            taken_count: 9,
            moved_count: 4,
        },
        PeerMessage::Leaving,
        PeerMessage::Stop(RunOutcome::Interrupted("Ctrl-C".to_owned())),
        PeerMessage::Taken(vec![RecordGap {
            host: "robot-pc".to_owned(),
            of: vec!["control-pc".to_owned()],
            cause: GapCause::Connection("closed".to_owned()),
        }]),
        PeerMessage::Quiet,
    ];
    let mut inputs: Vec<Vec<u8>> = messages
        .iter()
        .map(|message| {
            let mut wire = Vec::new();
            write_message(&mut wire, message).expect("memory takes it");
            wire
        })
        .collect();
    let mut file = Vec::new();
    let (name, size_bytes) = ("a.taken.robot.0.rec".to_owned(), 5);
    write_message(&mut file, &PeerMessage::File { name, size_bytes }).expect("memory takes it");
    write_chunk(&mut file, &[1, 2, 3, 4, 5]).expect("memory takes it");
    write_message(&mut file, &PeerMessage::Done).expect("memory takes it");
    inputs.push(file);
    let mut report = Vec::new();
    let body = serde_json::to_vec(&story).expect("a history always serialises");
    let size_bytes = body.len() as u64;
    write_message(&mut report, &PeerMessage::Report { size_bytes }).expect("memory takes it");
    write_chunk(&mut report, &body).expect("memory takes it");
    inputs.push(report);
    inputs.push(b"arm.command.taken.robot.0.rec".to_vec());
    inputs.push(ticks());
    numbered("frames", inputs)
}

/// What supervisors say of ticks.
fn ticks() -> Vec<u8> {
    let mut wire = Vec::new();
    let told = vec![HostTicks {
        host: "robot-pc".to_owned(),
        age_ms: 250,
        processes: vec![("robot".to_owned(), Some(3)), ("other".to_owned(), None)],
        left_out_count: 1,
    }];
    write_message(&mut wire, &PeerMessage::Ticks(told)).expect("memory takes it");
    wire
}

pub(crate) fn summaries() -> Vec<Seed> {
    let summary = RunSummary::new(RunFacts {
        name: "seed".to_owned(),
        case: "shuttle".to_owned(),
        topology_file: "shuttle-split.toml".to_owned(),
        topology_hash: "0123456789abcdef".to_owned(),
        links: Vec::new(),
        seed: 1,
        host: "control-pc".to_owned(),
        security: None,
        started: "2026-01-02T03:04:05Z".to_owned(),
        starts_ns: BTreeMap::from([("control-pc".to_owned(), 5)]),
        duration_s: 2.5,
        outcome: Outcome::Completed,
        exit_reason: "as planned".to_owned(),
        folder: "runs/1".to_owned(),
        files: vec![Fact::new("records", "all")],
        is_virtual: false,
        repeat_command: "hil-runtime --topology a.toml".to_owned(),
    });
    let text = summary.to_json().expect("plain facts").into_bytes();
    let newer = br#"{"schema_version": 999}"#.to_vec();
    numbered("summary", [text, newer])
}

/// As a kernel with simulated radios gave them.
pub(crate) fn radio_answers() -> Vec<Seed> {
    macro_rules! recorded {
        ($($name:literal),*) => {[$(
            include_bytes!(concat!("../../../../runtime/nic/src/radio/recorded/", $name, ".netlink"))
                .to_vec(),
        )*]};
    }
    numbered(
        "answer",
        recorded!("station", "disconnect", "family", "interfaces"),
    )
}

/// An input that `runtime::split_layout` takes apart.
pub(super) fn with_layout(fields: &[Field], size_bytes: usize, message: &[u8]) -> Vec<u8> {
    let layout = json!({ "fields": describe_fields(fields), "size_bytes": size_bytes });
    let json = layout.to_string();
    let length = u16::try_from(json.len()).expect("layouts are short");
    [&length.to_le_bytes()[..], json.as_bytes(), message].concat()
}

pub(super) fn bytes_of(size_bytes: usize) -> Vec<u8> {
    let bytes = (0..size_bytes).map(|at| (at * 37 % 256).to_le_bytes()[0]);
    bytes.collect()
}

pub(super) fn message_inputs(make: impl Fn(&'static [Field], usize) -> Vec<u8>) -> Vec<Vec<u8>> {
    vec![
        make(ShuttleCommand::FIELDS, size_of::<ShuttleCommand>()),
        make(ShuttleStatus::FIELDS, size_of::<ShuttleStatus>()),
        make(EgmCommand::FIELDS, size_of::<EgmCommand>()),
        make(EgmFeedback::FIELDS, size_of::<EgmFeedback>()),
    ]
}

pub(crate) fn layouts() -> Vec<Seed> {
    let inputs = message_inputs(|fields, size| with_layout(fields, size, &bytes_of(size)));
    numbered("layout", inputs)
}

pub(crate) fn words() -> Vec<Seed> {
    let chrony = "0A630401,10.99.4.1,11,1795338139.876353805,-0.000002356,-0.000000850,0.000001875,\
                  0.011,0.002,0.268,0.000009866,0.000002140,1.0,Normal\n";
    let ntp = "associd=0 status=0615 leap_none, sync_ntp, stratum=2, rootdelay=12.5, rootdisp=3.25, \
               refid=10.0.0.1, offset=-0.125, sys_jitter=0.01\n";
    let ptp = "\tRESPONSE MANAGEMENT TIME_STATUS_NP\n\t\tmaster_offset -519\n\t\tgmPresent true\n\
               \t\tgmIdentity 622b0d.fffe.8ca8c0\n\t\tmeanPathDelay 1291.0\n";
    let inputs = [
        behind(0, b"40 ms"),
        behind(0, b"1.5 h"),
        behind(1, b"h01234567_@/run/hil/1"),
        behind(2, b"hil"),
        behind(2, b"egm:port=6510,src=10.0.0.1,dst=10.0.0.2"),
        behind(2, b"udp:dport=7000,id=3+4le"),
        behind(3, chrony.as_bytes()),
        behind(4, ntp.as_bytes()),
        behind(5, ptp.as_bytes()),
    ];
    numbered("words", inputs)
}
