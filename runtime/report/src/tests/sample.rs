//! A summary of a run that never was, and the rendered reports that are checked in. To renew
//! them after a deliberate change: `HIL_BLESS=1 cargo test -p hil-report`, then read the
//! difference.

use hil_core::interval::{Interval, IntervalMethod, Spread};
use std::collections::BTreeMap;
use std::time::Duration;

use hil_account::flow::FlowMetrics;
use hil_account::{
    AccountContext, ChannelAccount, ChannelPath, ChannelRecords, Coverage, Demand, DemandMetrics,
    FateCounts, MessageFate, SegmentMetrics, Stage, account,
};
use hil_arm::egm::messages::Side as ArmSide;
use hil_core::time::Alignment;

use super::sample_events::{few_events, many_events, recorded_channel};
use super::sample_network::network;
use super::sample_records::Files;
use crate::adapter::{AdapterSummary, Answers};
use crate::assessment::{Assessment, HostLoss, NetworkVerdict};
use crate::summary::{
    Absence, ChannelSummary, CountByName, CounterGroup, DirectionSummary, Fact, LinkKind, Outcome,
    ProcessSummary, RadioChange, RealtimeFacts, RunEvent, RunEventKind, RunFacts, RunSummary,
    ScoreMetric, SummaryError,
};
use crate::terminal::{Style, render};
use hil_link::condition::flow_name;
use hil_link::spec::Way;
use hil_platform::host_facts::{self, HostFact, HostFacts};
use hil_rundir::event::{EventKind, ProcessKind};
use hil_rundir::launch::Side;
use hil_stats::histogram::{Distribution, DurationBin};
use hil_topology::AdapterKind;

fn run_facts() -> RunFacts {
    RunFacts {
        name: "swing-split".to_owned(),
        case: "teleoperation".to_owned(),
        topology_file: "deploy/topologies/split.toml".to_owned(),
        topology_hash: "5d1c9a70e2b34f18".to_owned(),
        links: Vec::new(),
        seed: 42,
        security: None,
        host: "operator".to_owned(),
        started: "2026-03-14 09:26:53 +01:00".to_owned(),
        starts_ns: BTreeMap::new(),
        duration_s: 20.0,
        outcome: Outcome::Completed,
        exit_reason: "ran its 20 s".to_owned(),
        folder: "runs/2026-03-14T092653-swing-split".to_owned(),
        files: vec![
            Fact::new("summary.json", "everything in this report, for programs"),
            Fact::new("records/", "one fixed-size record per message and stage"),
        ],
        is_virtual: false,
        repeat_command: "hil-runtime --topology deploy/topologies/split.toml --seed 42".to_owned(),
    }
}

fn process(name: &str, kind: ProcessKind, skipped_tick_count: Option<u64>) -> ProcessSummary {
    let is_component = kind == ProcessKind::Component;
    ProcessSummary {
        name: name.to_owned(),
        host: "operator".to_owned(),
        kind,
        role: is_component.then(|| name.to_owned()),
        exit: "ended by itself, code 0".to_owned(),
        restart_count: 0,
        preparation_s: is_component.then_some(0.812),
        tick_count: skipped_tick_count.map(|_| 5_000),
        skipped_tick_count,
        cpu_time_s: Some(1.234),
        voluntary_switch_count: Some(10_021),
        involuntary_switch_count: Some(17),
        malformed_count: Some(0),
        outbox_drop_count: Some(0),
        recorder_drop_count: Some(0),
    }
}

fn metric(label: &str, value: Option<f64>, unit: &str, method: &str) -> ScoreMetric {
    ScoreMetric {
        name: label.replace(' ', "_"),
        label: label.to_owned(),
        value,
        interval: value.map(|value| {
            let method = IntervalMethod::EffectiveMean;
            Spread::Known(Interval::new(0.9 * value, 1.1 * value, method))
        }),
        unit: unit.to_owned(),
        method: method.to_owned(),
        note: String::new(),
    }
}

/// The kind called so in a summary.
pub(super) fn link(word: &str) -> LinkKind {
    LinkKind::named(word).unwrap()
}

fn channel(
    name: &str,
    roles: [&str; 2],
    link: LinkKind,
    account: ChannelAccount,
) -> ChannelSummary {
    ChannelSummary {
        name: name.to_owned(),
        from: roles[0].to_owned(),
        to: Some(roles[1].to_owned()),
        link,
        account: Some(account),
        outages: None,
        demand: None,
        emulation: None,
        trace_replay: None,
        recorded: None,
        ends: Vec::new(),
    }
}

/// One channel over the network on one clock, one between unaligned hosts, one direct.
fn channels() -> Vec<ChannelSummary> {
    let files = Files::sample();
    let (there, back) = (["controller", "robot"], ["robot", "controller"]);
    let exact = files.account(Some(Alignment::SAME_CLOCK));
    let mut command = channel("arm/command", there, link("udp"), exact);
    command.outages = Some(files.outages());
    let status = channel("arm/status", back, link("udp"), files.account(None));
    let human = ["operator", "controller"];
    let motion = channel(
        "human/motion",
        human,
        LinkKind::SharedMemory,
        files.direct(),
    );
    vec![command, status, motion, recorded_channel()]
}

/// A demand of `arm/command` on one clock, judged, of 4 ms and 12 ms.
pub(crate) fn demand(availability: f64) -> DemandMetrics {
    let demand = Demand {
        latency_max: Duration::from_millis(1),
        survival_time: Duration::from_millis(12),
        interval: Duration::from_millis(4),
        availability,
    };
    Files::sample().demand(&demand, Some(Alignment::SAME_CLOCK))
}

/// The gateway that receives what goes over the network one way.
fn directions() -> Vec<DirectionSummary> {
    vec![DirectionSummary {
        flow: flow_name("hop", Way::Forward),
        process: "robot gateway".to_owned(),
        direction: Side::Ingress,
        channels: vec!["arm/command".to_owned()],
        peer_state: "said farewell".to_owned(),
        counters: vec![CountByName {
            group: CounterGroup::Refused,
            name: "type hash differs".to_owned(),
            count: 3,
        }],
        facts: vec![Fact::new("receive buffer granted", "425984 bytes")],
        stalls: None,
    }]
}

/// A whole report.
pub(crate) fn full() -> RunSummary {
    let mut killed = process("robot gateway", ProcessKind::Gateway, None);
    killed.restart_count = 1;
    killed.cpu_time_s = None;
    killed.exit = "first killed by signal 9, then ended by itself, code 0".to_owned();
    let mut score_events = few_events();
    let network = network(["arm/command", "arm/status"], &mut score_events);
    RunSummary {
        host_facts: HostFacts {
            facts: [
                ("processor", "2 × a virtual core"),
                ("kernel", "6.18, PREEMPT_DYNAMIC"),
            ]
            .map(|(label, value)| HostFact {
                label: label.to_owned(),
                value: host_facts::Fact::Available(value.to_owned()),
            })
            .to_vec(),
        },
        realtime: RealtimeFacts {
            granted: vec![Fact::new("controller", "SCHED_FIFO 50 on core 0")],
            refused: vec![Fact::new("robot gateway", "spin: core 1 is not isolated")],
        },
        processes: vec![
            process("controller", ProcessKind::Component, Some(2)),
            process("robot", ProcessKind::Component, Some(0)),
            killed,
        ],
        events: vec![RunEvent {
            at_s: Some(8.0),
            process: "robot gateway".to_owned(),
            kind: RunEventKind::Process(EventKind::Restarted {
                end: "was killed by SIGKILL".to_owned(),
                restart: 1,
                limit: 3,
            }),
            absence: Some(Absence {
                length_s: Some(0.757),
            }),
        }],
        channels: channels(),
        directions: directions(),
        score: vec![
            metric(
                "joint error, root mean square",
                Some(0.002_134),
                "rad",
                "commanded against reached joint angles at each status, both arms",
            ),
            metric(
                "motion loops",
                Some(4.0),
                "1",
                "whole swings of the recorded arm",
            ),
            metric("tracking lag", None, "s", "no swing was complete"),
        ],
        score_events,
        network: Some(network),
        ..RunSummary::new(run_facts())
    }
}

/// Names longer than any column, hostile characters, an overrun host, processes without figures.
pub(crate) fn awkward() -> RunSummary {
    let long = "an-exceedingly-long-name-that-someone-will-surely-choose-one-day".repeat(2);
    let mut summary = full();
    summary.run.name.clone_from(&long);
    summary.run.folder.clone_from(&long);
    summary.run.outcome = Outcome::Failed;
    summary.run.exit_reason = format!("process {long} ended with code 1\u{1b}[2J");
    summary.processes = vec![
        ProcessSummary {
            name: long.clone(),
            role: Some(long.clone()),
            host: long.clone(),
            recorder_drop_count: Some(12_345),
            ..process("", ProcessKind::Component, Some(308))
        },
        process("robot", ProcessKind::Component, None),
    ];
    summary.channels.truncate(1);
    summary.channels[0].name.clone_from(&long);
    summary.channels[0].from.clone_from(&long);
    summary.score[0].label.clone_from(&long);
    summary.score[0].value = Some(-123_456_789.123);
    summary.events[0].process.clone_from(&long);
    summary.score_events = many_events(&long);
    summary.network = Some(network([&long, "arm/status"], &mut summary.score_events));
    summary
}

/// Nothing ran, nothing is known.
pub(crate) fn empty() -> RunSummary {
    let mut run = run_facts();
    run.outcome = Outcome::Stopped;
    run.exit_reason = "stopped by a person while waiting for host robot".to_owned();
    run.duration_s = 0.0;
    run.files.clear();
    let mut summary = RunSummary::new(run);
    let nothing = account(
        &ChannelRecords::default(),
        &AccountContext::new(ChannelPath::Gateway { alignment: None }),
    );
    for (name, account) in [("arm/command", Some(nothing)), ("arm/status", None)] {
        summary.channels.push(ChannelSummary {
            name: name.to_owned(),
            from: "controller".to_owned(),
            to: Some("robot".to_owned()),
            link: link("udp"),
            account,
            outages: None,
            demand: None,
            emulation: None,
            trace_replay: None,
            recorded: None,
            ends: Vec::new(),
        });
    }
    summary
}

/// A flow that lost so many frames to the network and to the harness.
pub(crate) fn flow(name: &str, frame_count: u64, lost: [u64; 2]) -> FlowMetrics {
    FlowMetrics {
        name: name.to_owned(),
        frame_count,
        byte_count: 64 * frame_count,
        taken_count: frame_count - lost[0] - lost[1],
        lost_by_network_count: lost[0],
        lost_by_either_count: 0,
        lost_by_harness_count: lost[1],
        unknown_count: 0,
        reordered_count: Some(0),
        reordered_extent_max: Some(0),
        retransmitted_count: None,
        delay: Distribution::of_samples(&[5_000_000], ""),
    }
}

pub(super) fn check_golden(actual: &str, file: &str, expected: &str) {
    if std::env::var_os("HIL_BLESS").is_some() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/src/testdata");
        std::fs::write(format!("{folder}/{file}"), actual).unwrap();
        return;
    }
    for (index, (actual, expected)) in actual.lines().zip(expected.lines()).enumerate() {
        assert_eq!(actual, expected, "line {} of {file}", index + 1);
    }
    assert_eq!(
        actual.lines().count(),
        expected.lines().count(),
        "length of {file}"
    );
}

#[test]
fn a_full_report_reads_as_checked_in() {
    let text = render(&full(), 100, Style::Plain);
    check_golden(
        &text,
        "full_100.txt",
        include_str!("../testdata/full_100.txt"),
    );
}

#[test]
fn a_report_of_awkward_names_keeps_its_columns() {
    let text = render(&awkward(), 80, Style::Plain);
    check_golden(
        &text,
        "awkward_80.txt",
        include_str!("../testdata/awkward_80.txt"),
    );
}

#[test]
fn a_report_of_nothing_says_so() {
    let text = render(&empty(), 80, Style::Plain);
    check_golden(
        &text,
        "empty_80.txt",
        include_str!("../testdata/empty_80.txt"),
    );
}

#[test]
fn no_line_exceeds_the_page_and_no_control_character_gets_through() {
    for summary in [full(), awkward(), empty()] {
        for width in [0, 80, 97, 120, 500] {
            let text = render(&summary, width, Style::Plain);
            let limit = width.clamp(80, 120);
            for line in text.lines() {
                assert!(line.chars().count() <= limit, "beyond {limit}: {line}");
            }
            assert!(text.chars().all(|c| c == '\n' || !c.is_control()));
        }
    }
}

#[test]
fn colours_change_nothing_but_colours() {
    let coloured = render(&full(), 100, Style::Coloured);
    let mut plain = String::new();
    let mut rest = coloured.as_str();
    while let Some((before, after)) = rest.split_once('\u{1b}') {
        plain.push_str(before);
        rest = after.split_once('m').unwrap().1;
    }
    plain.push_str(rest);
    let expected = render(&full(), 100, Style::Plain);
    // Padding before a sequence cannot be trimmed, so ends of lines are compared without it.
    for (plain, expected) in plain.lines().zip(expected.lines()) {
        assert_eq!(plain.trim_end(), expected);
    }
}

#[test]
fn a_summary_survives_its_json() {
    for summary in [full(), awkward(), empty()] {
        let text = summary.to_json().unwrap();
        // The JSON reader may differ by one unit in the last place of a float, so the texts
        // people read are compared, and every count.
        let read = RunSummary::from_json(&text).unwrap();
        assert_eq!(
            render(&read, 120, Style::Plain),
            render(&summary, 120, Style::Plain)
        );
        for (read, written) in read.channels.iter().zip(&summary.channels) {
            let counts = |channel: &ChannelSummary| {
                let account = channel.account.clone();
                account.map(|a| (a.fates, a.gaps.longest, a.coverage, a.loss_bursts))
            };
            assert_eq!(counts(read), counts(written));
        }
        assert!(text.contains("\"assessment\""));
    }
}

#[test]
fn another_schema_is_refused_by_its_number() {
    for version in [1, 7] {
        let text = format!("{{\"schema_version\": {version}, \"runs\": []}}");
        let error = RunSummary::from_json(&text).unwrap_err();
        assert!(matches!(error, SummaryError::OtherSchema { found } if found == version));
        let words = format!("schema version {version} is not 3, the one that is read");
        assert_eq!(error.to_string(), words);
    }
    assert!(matches!(
        RunSummary::from_json("{}"),
        Err(SummaryError::Decode(_))
    ));
}

#[test]
fn an_incomplete_message_is_put_down_to_what_carried_it() {
    let fate = MessageFate::Incomplete;
    let emulated = LinkKind::Emulated.fate_label(fate);
    assert_eq!(emulated, "incomplete: lost by the emulated link");
    assert_eq!(link("udp").fate_label(fate), fate.label());
}

#[test]
fn a_warning_says_how_many_messages_found_no_room() {
    let mut summary = full();
    let account = summary.channels[0].account.as_mut().unwrap();
    account.fates = FateCounts::default();
    account.fates.add(MessageFate::LostByHarness, 1);
    account.fates.add(MessageFate::LostOnWireOrByHarness, 3);
    summary.directions[0].counters.push(CountByName {
        group: CounterGroup::Socket,
        name: "kernel_drop_count".to_owned(),
        count: 5,
    });
    let warnings = Assessment::of(&summary).warnings;
    let words = "and lost 1 message so and perhaps 3 more";
    assert!(
        warnings.iter().any(|one| one.contains(words)),
        "{warnings:?}"
    );
}

#[test]
fn what_a_witness_took_is_said_to_be_taken_by_it() {
    let says_so = |summary: &RunSummary| {
        let text = render(summary, 120, Style::Plain);
        let words: Vec<&str> = text.split_whitespace().collect();
        let words = words.join(" ");
        words.contains("Taken: when the witness beside the program had the message")
    };
    let mut summary = full();
    summary.processes[1].kind = ProcessKind::OwnProgram;
    assert!(!says_so(&summary), "nobody records for the robot");
    let witness = process("witness-operator", ProcessKind::Witness, None);
    summary.processes.push(witness);
    assert!(says_so(&summary));
    summary.processes[1].kind = ProcessKind::Component;
    assert!(!says_so(&summary), "the robot records itself");
}

#[test]
fn a_host_that_overran_is_not_a_network_result() {
    let mut summary = full();
    // 0.1 % of 5 000 due ticks is 5: at the limit it still counts.
    for (skipped, ran, is_result) in [(5, 4_995, true), (6, 4_994, false), (308, 692, false)] {
        summary.processes[1].tick_count = Some(ran);
        summary.processes[1].skipped_tick_count = Some(skipped);
        let assessment = Assessment::of(&summary);
        assert_eq!(
            assessment.network == NetworkVerdict::NetworkResult,
            is_result,
            "{skipped}"
        );
        let text = render(&summary, 120, Style::Plain);
        assert_eq!(text.contains("NOT VALID"), !is_result);
        assert_eq!(text.contains("the network is not to blame"), !is_result);
    }
    for process in &mut summary.processes {
        process.tick_count = None;
        process.skipped_tick_count = None;
    }
    // Without a count of ticks the gateways' counters are left, where every start of theirs left some.
    assert_eq!(
        Assessment::of(&summary).network,
        NetworkVerdict::HostUnknown
    );
    summary.processes[2].restart_count = 0;
    summary.processes[2].cpu_time_s = Some(1.0);
    assert_eq!(
        Assessment::of(&summary).network,
        NetworkVerdict::NetworkResult
    );
    summary.directions.clear();
    assert_eq!(
        Assessment::of(&summary).network,
        NetworkVerdict::HostUnknown
    );
    summary.channels.truncate(0);
    assert_eq!(Assessment::of(&summary).network, NetworkVerdict::NoNetwork);
}

#[test]
fn an_event_keeps_its_kind_and_numbers_in_json() {
    let radio = RunEvent {
        at_s: None,
        process: "robot gateway".to_owned(),
        kind: RunEventKind::Radio {
            interface: "wlan0".to_owned(),
            change: RadioChange::StationLeft,
            station: Some("02:00:00:00:00:01".to_owned()),
            code: Some(3),
        },
        absence: None,
    };
    for (event, kind) in [
        (&full().events[0], ["process", "restarted"]),
        (&radio, ["radio", "station_left"]),
    ] {
        let json = serde_json::to_value(event).unwrap();
        let found = json.get("kind").or(json.get("change")).unwrap();
        assert_eq!([&json["source"], found], kind);
        assert_eq!(&serde_json::from_value::<RunEvent>(json).unwrap(), event);
    }
    let what = "robot gateway: wlan0 station left (02:00:00:00:00:01)";
    assert_eq!(radio.what(), what);
    assert_eq!(radio.cause().unwrap(), "802.11 code 3");
}

#[test]
fn only_a_lost_count_of_ticks_leaves_the_verdict_open() {
    for (kind, expected) in [
        (ProcessKind::Component, NetworkVerdict::TicksUnknown),
        (ProcessKind::Gateway, NetworkVerdict::NetworkResult),
        (ProcessKind::ClockPath, NetworkVerdict::NetworkResult),
        (ProcessKind::Adapter, NetworkVerdict::NetworkResult),
        (ProcessKind::OwnProgram, NetworkVerdict::NetworkResult),
    ] {
        let mut summary = full();
        let mut silent = process("silent", kind, None);
        silent.cpu_time_s = None;
        summary.processes.push(silent);
        assert_eq!(Assessment::of(&summary).network, expected, "{kind:?}");
    }
}

#[test]
fn what_had_no_room_in_a_receive_buffer_is_not_put_down_to_the_network() {
    let mut summary = full();
    let account = summary.channels[0].account.as_mut();
    account.unwrap().published_count = 5_000;
    // 0.1 % of 5 000 messages is 5: at the limit it still counts, and is told.
    for (count, is_result) in [(0, true), (5, true), (6, false)] {
        summary.directions[0].counters.push(CountByName {
            group: CounterGroup::Socket,
            name: "kernel_drop_count".to_owned(),
            count,
        });
        let assessment = Assessment::of(&summary);
        let expected = if is_result {
            NetworkVerdict::NetworkResult
        } else {
            NetworkVerdict::ReceiverLate {
                channels: vec!["hop/forward".to_owned()],
                loss: HostLoss {
                    lost_count: count,
                    of_count: 5_000,
                },
            }
        };
        assert_eq!(assessment.network, expected, "{count}");
        let text = render(&summary, 120, Style::Plain);
        assert_eq!(text.contains("NOT VALID"), !is_result);
        assert_eq!(text.contains("because the receiving gateway"), count > 0);
        summary.directions[0].counters.pop();
    }
}

#[test]
fn a_gateway_that_was_late_is_not_the_network() {
    let of = |superseded: u64, held: u64, via: &str| {
        let mut summary = full();
        let channel = &mut summary.channels[0];
        channel.link = link(via);
        let account = channel.account.as_mut().unwrap();
        account.published_count = 5_000;
        account.fates = FateCounts::default();
        account.fates.add(MessageFate::Taken, 5_000 - superseded);
        account
            .fates
            .add(MessageFate::SupersededAtInput, superseded);
        let is_reception = |one: &&mut SegmentMetrics| one.to == Stage::Received;
        let reception = account.segments.iter_mut().find(is_reception).unwrap();
        reception.bins = vec![DurationBin {
            until_ns: 2_000_000_000,
            count: held,
        }];
        Assessment::of(&summary).network
    };
    let network =
        |superseded, held, is_stream| of(superseded, held, if is_stream { "tcp" } else { "udp" });
    let late = |lost_count| NetworkVerdict::GatewayLate {
        channels: vec!["arm/command".to_owned()],
        loss: HostLoss {
            lost_count,
            of_count: 5_000,
        },
    };
    assert_eq!(network(5, 0, false), NetworkVerdict::NetworkResult);
    assert_eq!(network(6, 0, false), late(6));
    assert_eq!(network(0, 6, false), late(6));
    assert_eq!(network(3, 3, false), late(6));
    // Before a stream, messages wait for the network too.
    assert_eq!(network(600, 0, true), NetworkVerdict::NetworkResult);
    assert_eq!(network(600, 6, true), late(6));
    // Behind an emulated link they wait because its model says so.
    let emulated = |superseded, held| of(superseded, held, "emulated");
    assert_eq!(emulated(5, 600), NetworkVerdict::EmulatedLink);
    assert_eq!(emulated(6, 600), late(6));
}

#[test]
fn a_run_whose_adapter_nobody_answered_does_not_claim_a_foreign_program() {
    let mut summary = full();
    summary.channels.truncate(0);
    summary.faces.push(AdapterSummary {
        process: "client".to_owned(),
        host: "local".to_owned(),
        kind: AdapterKind::Robot,
        arm: ArmSide::Right,
        address: "127.0.0.1:6510".to_owned(),
        peer_state: "never answered".to_owned(),
        cycle_ns: Some(4_000_000),
        answers: Answers::default(),
        segments: Vec::new(),
        refusals: Vec::new(),
        counters: Vec::new(),
        facts: Vec::new(),
    });
    let assessment = Assessment::of(&summary);
    assert_eq!(assessment.network, NetworkVerdict::NoForeignProgram);
    let told = |words: &str| assessment.warnings.iter().any(|one| one.contains(words));
    assert!(told("no foreign program answered"), "{assessment:?}");
    let text = render(&summary, 120, Style::Plain);
    assert!(!text.contains("took part"), "{text}");
    summary.faces[0].answers.attended_count = 1;
    let network = Assessment::of(&summary).network;
    assert_eq!(network, NetworkVerdict::ForeignProgram);
}

#[test]
fn a_stream_is_not_blamed_for_stamps_it_cannot_have() {
    let mut summary = full();
    let stamped = |summary: &RunSummary| {
        let warnings = Assessment::of(summary).warnings;
        warnings.iter().any(|one| one.contains("kernel TX stamp"))
    };
    for channel in &mut summary.channels {
        if let Some(account) = &mut channel.account {
            account.coverage.tx_software = Some(Coverage {
                stamped_count: 0,
                eligible_count: 100,
            });
        }
    }
    assert!(stamped(&summary));
    for channel in &mut summary.channels {
        channel.link = link("tcp");
    }
    assert!(!stamped(&summary));
    assert_eq!(
        Assessment::of(&summary).network,
        NetworkVerdict::NetworkResult
    );
}

#[test]
fn writing_replaces_the_file_whole_and_names_it_when_it_cannot() {
    let folder = std::env::temp_dir().join(format!("hil-report-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let path = folder.join("summary.json");
    full().write(&path).unwrap();
    empty().write(&path).unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    assert_eq!(RunSummary::from_json(&text).unwrap().run, empty().run);
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1);
    std::fs::remove_dir_all(&folder).unwrap();
    let error = full().write(&path).unwrap_err();
    assert!(error.to_string().contains("summary.json"), "{error}");
}
