//! Good topologies: what they become, how they are written back, and what a process is told.
//! Faulty ones are in `tests/faulty.rs`.

mod adapter;
mod clock_path;
mod faulty;
mod fitted;
mod fleet;
mod frames;
mod hosts;
mod layers;
mod links;
mod misspelt;
mod recorded;
mod relations;
mod security;
mod wifi;

use core::time::Duration;
use std::path::{Path, PathBuf};

use hil_core::case_study::{CaseStudy, ChannelSpec, ParameterError, Score};
use hil_core::component::Role;
use hil_core::run_log::RunLog;
use hil_fleet::Fleet;
use hil_link::delay::DelayLaw;
use hil_link::loss::LossLaw;
use hil_link::spec::LinkSpec;
use hil_shuttle::Shuttle;
use serde::Deserialize;

use super::*;

hil_core::message! {
    struct Frame = "test.Frame.v1" { joints_rad: [f64; 7] }
}

hil_core::options! {
    struct TeleoperationParameters {
        rate_hz: f64 = 0.0, in 0.0..=1000.0;
        mirrored: bool = false;
        servo: ServoParameters;
    }
}

hil_core::options! {
    struct ServoParameters {
        gain_per_s: f64 = 0.0, in 0.0..=20.0;
        cycle_us: u32 = 0, in 0..=100_000;
    }
}

/// A case of three roles and three channels, without models; the shipped one of this name has
/// more of both.
#[derive(Debug)]
struct Teleoperation;

impl CaseStudy for Teleoperation {
    const NAME: &'static str = "teleoperation";
    const SUMMARY: &'static str = "test";
    const ROLES: &'static [&'static str] = &["human", "controller", "robot"];
    const CHANNELS: &'static [ChannelSpec] = &[
        ChannelSpec::of::<Frame>("human/frame", "human", "controller"),
        ChannelSpec::of::<Frame>("arm/command", "controller", "robot"),
        ChannelSpec::of::<Frame>("arm/status", "robot", "controller"),
    ];
    type Parameters = TeleoperationParameters;

    fn new(parameters: Self::Parameters, _seed: u64) -> Result<Self, ParameterError> {
        parameters.check().map(|()| Self)
    }

    fn role(&self, _name: &str) -> Option<Box<dyn Role>> {
        None
    }

    fn score(&self, _log: &RunLog) -> Score {
        Score::default()
    }
}

fn known() -> KnownCases {
    KnownCases::new()
        .with::<Fleet>()
        .with::<Shuttle>()
        .with::<Teleoperation>()
}

fn shipped(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../deploy/topologies")
        .join(name)
}

fn load_shipped(name: &str, overrides: &[&str]) -> Topology {
    let overrides: Vec<_> = overrides.iter().map(|&text| text.to_owned()).collect();
    load(&shipped(name), &overrides, &shipped_cases()).unwrap_or_else(|errors| panic!("{errors}"))
}

/// As the program knows them.
fn shipped_cases() -> KnownCases {
    KnownCases::new()
        .with::<Fleet>()
        .with::<Shuttle>()
        .with::<hil_teleoperation::Teleoperation>()
}

fn parse_good(text: &str) -> Topology {
    parse("good.toml", text, &[], &known()).unwrap_or_else(|errors| panic!("{errors}"))
}

const SHIPPED: &[&str] = &[
    "local.toml",
    "split.toml",
    "emulated.toml",
    "outages.toml",
    "split-outages.toml",
    "static-cells.toml",
    "bad-link.toml",
    "wifi6.toml",
    "egm-client.toml",
    "egm-robot.toml",
    "shuttle-local.toml",
    "shuttle-split.toml",
    "shuttle-tcp.toml",
];

/// Uses every key there is.
const EVERYTHING: &str = r#"
version = 1
name = "everything"
run = { duration = "2 min", seed = 7, record = "out", start_timeout = "5 s" }
security = { hops = "sealed", key = "keys/hop.key" }
[case]
name = "teleoperation"
[case.parameters]
rate_hz = 125
mirrored = true
servo = { gain_per_s = 5.5, cycle_us = 4032 }
[hosts]
robot-pc = { address = "10.77.0.2", clock_address = "10.78.0.2" }
[hosts.control-pc]
address = "10.77.0.1"
interface = "eth0"
control_port = 7001
clock_address = "10.78.0.1"
clock_interface = "eth1"
clock_port = 7500
[processes.human]
host = "control-pc"
role = "human"
cpu = 2
scheduling = "fifo"
priority = 41
lock_memory = true
timer_slack = "2 us"
wait = "spin"
on_exit = "restart"
restart_limit = 2
[processes.controller]
host = "control-pc"
role = "controller"
run = ["./my-controller", "--fast"]
env = { RUST_LOG = "debug" }
[processes.robot]
host = "robot-pc"
role = "robot"
[processes.camera]
host = "robot-pc"
run = ["camera"]
cpu = [0, 1]
[processes.viewer]
host = "control-pc"
run = ["viewer"]
[channels."arm/command"]
depth = 4
link = "hop"
[channels."arm/command".demand]
latency_max = "20 ms"
survival_time = "24 ms"
interval = "16 ms"
availability = 0.9999
[channels."arm/status"]
link = "hop"
[channels."camera/image"]
message = { name = "lab.Image.v1", size_bytes = 4096, alignment_bytes = 16 }
from = "camera"
to = "viewer"
link = "wire"
[links.hop]
via = "emulated"
between = ["robot-pc", "control-pc"]
port = 8000
dscp = 46
socket_priority = 6
send_buffer_bytes = 65536
receive_buffer_bytes = 131072
timestamps = "hardware"
path_mtu_bytes = 1400
delay = "50 ms"
loss_ratio = 0.1
outages = { mean = "1.5 s", per_hour = 12.5, buffered = true }
[links.hop.backward]
loss_ratio = 0
[links.hop.gateway]
cpu = [4, 5]
scheduling = "fifo"
wait = "hybrid"
on_exit = "end-run"
[links.wire]
via = "udp"
port = 9000
[links.spare]
via = "shared-memory"
"#;

#[test]
fn what_a_file_leaves_out_has_the_documented_default() {
    let topology = load_shipped("shuttle-local.toml", &[]);
    assert_eq!(topology.run().duration, Duration::from_secs(20));
    assert_eq!(topology.run().seed, 1);
    assert_eq!(topology.run().record, "runs");
    assert_eq!(topology.run().start_timeout, Duration::from_secs(30));
    let [host] = topology.hosts() else {
        panic!("one implicit host");
    };
    assert_eq!(host.name, "local");
    assert!(topology.is_all_local());
    let robot = topology.process("robot").unwrap();
    assert_eq!(robot.execution.scheduling(), Scheduling::Other);
    assert_eq!(robot.execution.wait, Wait::Block);
    assert_eq!(robot.execution.timer_slack, Duration::from_micros(1));
    assert_eq!(robot.restarts.on_exit(), OnExit::EndRun);
    assert!(
        topology
            .channels()
            .iter()
            .all(|channel| channel.depth == 16)
    );
    assert_eq!(topology.crossings().count(), 0);
    // A parameter the file does not say is the case's own default.
    let parameters = &topology.case().unwrap().parameters;
    let parameters = Shuttle::deserialize(parameters.clone()).unwrap();
    assert_eq!(parameters, Shuttle::default());
}

#[test]
fn every_key_of_a_process_reaches_the_checked_topology() {
    let topology = parse_good(EVERYTHING);
    let human = topology.process("human").unwrap();
    assert_eq!(human.execution.cpu, [2]);
    assert_eq!(
        human.execution.scheduling(),
        Scheduling::Fifo { priority: 41 }
    );
    assert!(human.execution.lock_memory);
    assert_eq!(human.execution.wait, Wait::Spin);
    assert_eq!(human.restarts.on_exit(), OnExit::Restart { limit: 2 });
    let Program::Command {
        role,
        command,
        environment,
        inside,
    } = &topology.process("controller").unwrap().program
    else {
        panic!("the controller is the user's own program");
    };
    assert_eq!(role.as_deref(), Some("controller"));
    assert_eq!(command, &["./my-controller", "--fast"]);
    assert_eq!(environment["RUST_LOG"], "debug");
    assert_eq!(*inside, None);
}

#[test]
fn every_key_of_a_channel_and_its_link_reaches_the_checked_topology() {
    let topology = parse_good(EVERYTHING);
    let ids: Vec<_> = topology
        .channels()
        .iter()
        .map(|channel| channel.channel_id)
        .collect();
    assert_eq!(ids, [0, 1, 2, 3]);
    let crossings: Vec<_> = topology.crossings().collect();
    let names: Vec<_> = crossings
        .iter()
        .map(|crossing| crossing.channel.name.as_str())
        .collect();
    assert_eq!(names, ["arm/command", "arm/status", "camera/image"]);
    let [command, status, image] = &crossings[..] else {
        panic!("three crossings");
    };
    // `between` starts at the robot, so commands go backward.
    assert_eq!(command.direction, hil_link::spec::Way::Backward);
    assert_eq!(
        command.ports,
        LinkPorts {
            sender: 8001,
            receiver: 8001
        }
    );
    assert_eq!(
        status.ports,
        LinkPorts {
            sender: 8000,
            receiver: 8000
        }
    );
    assert_eq!(
        image.ports,
        LinkPorts {
            sender: 9001,
            receiver: 9001
        }
    );
    let delay = Duration::from_millis(50);
    let outages = command.spec.unwrap().outages;
    let expected = |loss_ratio| LinkSpec {
        outages,
        ..LinkSpec::fixed(delay, loss_ratio)
    };
    assert_eq!(command.spec, Some(&expected(0.0)));
    assert_eq!(status.spec, Some(&expected(0.1)));
    assert_eq!(image.spec, None);
    assert_eq!(image.from_host.name, "robot-pc");
    assert_eq!(
        command.hop.gateway.execution.scheduling(),
        Scheduling::Fifo { priority: 40 }
    );
    assert_eq!(command.hop.gateway.restarts.on_exit(), OnExit::EndRun);
    assert_eq!(
        image.hop.gateway.restarts.on_exit(),
        OnExit::Restart { limit: 3 }
    );
    assert_eq!(topology.link("spare").unwrap().between, None);
    assert_eq!(
        topology.hosts()[0]
            .control_address()
            .map(|address| address.to_string()),
        Some("10.77.0.1:7001".to_owned())
    );
}

#[test]
fn a_written_topology_reads_back_as_the_same() {
    let shipped = SHIPPED.iter().map(|name| load_shipped(name, &[]));
    let mut topologies: Vec<_> = shipped.map(|one| (one, shipped_cases())).collect();
    topologies.push((parse_good(EVERYTHING), known()));
    for (topology, cases) in topologies {
        let again = parse("good.toml", &topology.to_toml(), &[], &cases);
        let again = again.unwrap_or_else(|errors| panic!("{errors}"));
        assert_eq!(again, topology);
        assert_eq!(again.hash(), topology.hash());
    }
}

#[test]
fn the_manifest_form_is_the_resolved_file() {
    let topology = parse_good(EVERYTHING);
    let json = serde_json::to_value(&topology).unwrap();
    assert_eq!(json["links"]["hop"]["backward"]["delay"], "50 ms");
    assert_eq!(json["processes"]["human"]["priority"], 41);
    assert_eq!(json["case"]["parameters"]["rate_hz"], 125.0);
}

#[test]
fn the_hash_changes_with_every_meaning_and_with_no_spelling() {
    let hash = |overrides: &[&str]| load_shipped("split.toml", overrides).hash();
    let base = hash(&[]);
    assert_eq!(hash(&["run.duration=20000 ms"]), base);
    // Each host has its own.
    assert_eq!(hash(&["run.record=elsewhere/runs"]), base);
    assert_eq!(hash(&["processes.robot.wait=\"block\""]), base);
    for different in [
        "run.seed=2",
        "links.hop.dscp=0",
        "case.parameters.rate_hz=100",
        "processes.robot.cpu=3",
        "name=other",
    ] {
        assert_ne!(hash(&[different]), base, "{different}");
    }
}

#[test]
fn a_process_is_told_the_same_in_every_deployment() {
    let bytes = |file: &str, process: &str| {
        let card = load_shipped(file, &[]).role_spec(process).unwrap();
        serde_json::to_string_pretty(&card).unwrap()
    };
    for process in ["human", "controller", "robot"] {
        let local = bytes("local.toml", process);
        assert_eq!(bytes("split.toml", process), local);
        assert_eq!(bytes("emulated.toml", process), local);
        for secret in [
            "10.77",
            "control-pc",
            "hop",
            "gateway",
            "host",
            "link",
            "port\"",
        ] {
            assert!(!local.contains(secret), "{secret} in {local}");
        }
    }
    let robot = bytes("shuttle-local.toml", "robot");
    assert_eq!(bytes("shuttle-split.toml", "robot"), robot);
}

#[test]
fn a_role_spec_lists_the_ports_of_its_role_in_order_and_survives_the_trip() {
    let topology = parse_good(EVERYTHING);
    let card = topology.role_spec("controller").unwrap();
    let inputs: Vec<_> = card
        .inputs
        .iter()
        .map(|channel| channel.name.as_str())
        .collect();
    assert_eq!(inputs, ["human/frame", "arm/status"]);
    assert_eq!(card.outputs[0].name, "arm/command");
    assert_eq!(card.outputs[0].depth, 4);
    let json = serde_json::to_string(&card).unwrap();
    assert_eq!(serde_json::from_str::<RoleSpec>(&json).unwrap(), card);

    let viewer = topology.role_spec("viewer").unwrap();
    assert_eq!((viewer.case, viewer.role), (None, None));
    assert!(viewer.parameters.is_empty());
    assert_eq!(viewer.inputs[0].message_name, "lab.Image.v1");
    assert_eq!(topology.role_spec("nobody"), None);
}

#[test]
fn overrides_need_no_quotes_and_the_last_one_wins() {
    let topology = load_shipped(
        "emulated.toml",
        &[
            "links.hop.delay=20 ms",
            "links.hop.loss_ratio=0.5",
            "channels.\"egm/right/command\".depth = 2",
            "processes.robot.cpu=[1, 2]",
            "links.hop.delay=10 ms",
        ],
    );
    let crossing = topology.crossings().next().unwrap();
    let spec = crossing.spec.unwrap();
    assert_eq!(spec.delay, DelayLaw::fixed(Duration::from_millis(10)));
    assert_eq!(spec.loss, LossLaw::bernoulli(0.5));
    assert_eq!(crossing.channel.depth, 2);
    assert_eq!(topology.process("robot").unwrap().execution.cpu, [1, 2]);
}

#[test]
fn a_split_collapses_to_one_host_when_its_link_is_shared_memory() {
    let text = "
version = 1
name = 'one'
case.name = 'shuttle'
processes.controller.role = 'controller'
processes.robot.role = 'robot'
channels.'shuttle/status'.link = 'hop'
links.hop.via = 'shared-memory'
";
    let topology = parse_good(text);
    assert_eq!(topology.crossings().count(), 0);
    assert!(!topology.channel("shuttle/status").unwrap().is_carried);
}

#[test]
fn a_file_without_case_runs_the_users_own_programs() {
    let text = "
version = 1
name = 'own'
[processes]
a.run = ['./a']
b.run = ['./b']
[channels.'a/b']
message = { name = 'x.v1', size_bytes = 8 }
from = 'a'
to = 'b'
";
    let topology = parse_good(text);
    assert_eq!(topology.case(), None);
    assert_eq!(topology.channels()[0].message.alignment_bytes, 8);
}
