//! The real binary with fleets of vehicles: controller and robots on two hosts, over a plain hop
//! and over one that loses commands. Nobody collides, the account closes, and what the network did
//! stands beside what the robots did.
//!
//! `HIL_FLEET_SECONDS=60` makes the runs as long as the acceptance asks for; the gate takes less.

use std::env;
use std::time::Duration;

use hil_account::MessageFate;
use hil_report::assessment::{Assessment, NetworkVerdict};
use hil_report::score_event::ExplainedMessage;
use hil_report::summary::{LinkKind, Outcome, RunSummary};
use hil_tests::account::{
    account, assert_accounts_close, assert_every_message_is_accounted_for, carried, channel,
    describe,
};
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::split::Split;
use hil_tests::trial::{Trial, wait_until};
use nix::sys::signal::Signal;

const START_LIMIT: Duration = Duration::from_mins(3);
const RUN_LIMIT: Duration = Duration::from_mins(6);

/// Lengthens the runs.
const SECONDS_VARIABLE: &str = "HIL_FLEET_SECONDS";
const SECONDS_IN_GATE: u64 = 12;

/// The three checkers of the referee.
const COLLISIONS: [&str; 3] = [
    "section_collisions_count",
    "overlaps_count",
    "outside_count",
];

fn duration() -> String {
    let seconds = env::var(SECONDS_VARIABLE).ok();
    let seconds = seconds.and_then(|text| text.parse().ok());
    format!("run.duration=\"{} s\"", seconds.unwrap_or(SECONDS_IN_GATE))
}

fn mode(mode: &str) -> String {
    format!("case.parameters.coordinator.mode=\"{mode}\"")
}

/// Runs four fleets on two hosts with these settings.
fn split(lab: &Lab, settings: &[&str]) -> [RunSummary; 2] {
    let record = RunFolder::new("fleet");
    let mut trial = Trial::shipped("fleet-split.toml", record.path()).set(&duration());
    for setting in settings {
        trial = trial.set(setting);
    }
    let mut split = Split::start(lab, &trial);
    for finished in split.ended() {
        finished.assert_success();
    }
    println!("{}", split.files[0].read("report-full.txt"));
    split.summaries()
}

fn figure(summary: &RunSummary, name: &str) -> f64 {
    let metric = summary.score.iter().find(|metric| metric.name == name);
    let metric = metric.unwrap_or_else(|| panic!("no {name} in {:?}", summary.score));
    let value = metric.value;
    value.unwrap_or_else(|| panic!("{name} is unavailable: {}", metric.method))
}

fn assert_accounted(summary: &RunSummary, link: LinkKind) {
    assert_eq!(summary.run.outcome, Outcome::Completed, "{:?}", summary.run);
    for channel in carried(summary) {
        println!(
            "{}",
            describe(&channel.name, account(summary, &channel.name))
        );
    }
    assert_every_message_is_accounted_for(summary);
    assert_accounts_close(summary);
    assert_eq!(channel(summary, "fleet/authority").link, link);
    assert_eq!(channel(summary, "fleet/mission").link, link);
    assert_eq!(
        channel(summary, "fleet/state").link,
        LinkKind::named("udp").unwrap()
    );
    let truth = channel(summary, "fleet/truth");
    assert_eq!(truth.link, LinkKind::RecordOnly);
    let recorded = truth.recorded.unwrap();
    assert!(recorded.message_count > 0, "{recorded:?}");
    assert_eq!(recorded.missing_count, 0, "{recorded:?}");
}

fn assert_nobody_collided(summary: &RunSummary) {
    for name in COLLISIONS {
        let count = figure(summary, name);
        assert!(count.abs() < f64::EPSILON, "{name}: {count}");
    }
}

#[test]
fn four_fleets_over_a_plain_hop_do_not_collide_and_every_message_is_accounted_for() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    for mode_name in ["safe", "legacy"] {
        println!("mode {mode_name}");
        for summary in &split(&lab, &[&mode(mode_name)]) {
            assert_accounted(summary, LinkKind::named("udp").unwrap());
            assert_nobody_collided(summary);
            let states = account(summary, "fleet/state").published_count;
            // 28 robots report 33 times a second; a host that overran reports less often.
            assert!(states > 28 * 10, "{states}");
            let robots = summary.processes.iter().find(|one| one.name == "robots");
            assert!(robots.unwrap().preparation_s.unwrap() > 0.0);
        }
    }
}

#[test]
fn a_lost_command_is_named_with_its_fate_beside_what_the_robot_did() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let lossy = [
        "links.commands.via=\"emulated\"",
        "links.commands.loss_ratio=0.1",
    ];
    for mode_name in ["safe", "legacy"] {
        println!("mode {mode_name}");
        let [mode, via, loss] = [&mode(mode_name), lossy[0], lossy[1]];
        for summary in &split(&lab, &[mode, via, loss]) {
            assert_accounted(summary, LinkKind::Emulated);
            if mode_name == "safe" {
                assert_nobody_collided(summary);
            }
            assert_losses_are_explained(summary);
        }
    }
}

/// The messages that events name.
fn named(summary: &RunSummary) -> impl Iterator<Item = &ExplainedMessage> {
    let events = summary.score_events.events.iter();
    events.flat_map(|event| &event.messages)
}

fn assert_losses_are_explained(summary: &RunSummary) {
    let lost_count = account(summary, "fleet/authority")
        .fates
        .of(MessageFate::LostOnWire);
    assert!(lost_count > 0, "the link loses every tenth");
    let lost: Vec<_> = named(summary)
        .filter(|message| message.fate == Some(MessageFate::LostOnWire))
        .collect();
    assert!(
        !lost.is_empty(),
        "{lost_count} authorities were lost, and no event names one: {:?}",
        summary.score_events
    );
    for message in lost {
        assert_eq!(message.words, "lost on link commands: emulated loss");
        assert_eq!(message.delay_s, None);
        assert!(message.published_at_s.is_some(), "{message:?}");
    }
    for message in named(summary) {
        assert!(message.fate.is_some(), "{message:?}");
    }
    for event in &summary.score_events.events {
        let at_s = event.at_s.unwrap();
        assert!(
            (0.0..summary.run.duration_s + 1.0).contains(&at_s),
            "{at_s}"
        );
        // What led to an event was sent before it, or while the robot read: the hosts' times
        // compare. The other host may have begun a moment before this one's zero.
        for message in &event.messages {
            let sent_s = message.published_at_s.unwrap();
            assert!(
                (-0.1..=at_s + 0.1).contains(&sent_s),
                "{sent_s} of {event:?}"
            );
        }
    }
    let verdict = Assessment::of(summary).network;
    assert_ne!(
        verdict,
        NetworkVerdict::NetworkResult,
        "commands went over an emulated link"
    );
}

/// Kills of the coordinator in one run.
const KILLS: u32 = 3;
/// What an authority takes in a record file, at least.
const AUTHORITY_BYTES: u64 = 48;

#[test]
fn a_safe_coordinator_killed_again_and_again_on_a_lossy_link_keeps_all_robots_apart() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("fleet-kills");
    let mut trial = Trial::shipped("fleet-split.toml", record.path());
    for setting in [
        mode("safe").as_str(),
        "run.duration=\"28 s\"",
        "processes.controller.on_exit=\"restart\"",
        "links.commands.via=\"emulated\"",
        "links.commands.loss_ratio=0.1",
        "links.states.via=\"emulated\"",
        "links.states.loss_ratio=0.1",
    ] {
        trial = trial.set(setting);
    }
    let mut split = Split::start(&lab, &trial);
    for kill in 0..=KILLS {
        // Robots have been given way since the coordinator was there (again), so that it is killed in the midst.
        let files = &split.files;
        let given = |before: u64| {
            let bytes = files[1].record_bytes("fleet.authority.taken.");
            (bytes >= before + 50 * AUTHORITY_BYTES).then_some(bytes)
        };
        let before = given(0).unwrap_or(0);
        wait_until(
            START_LIMIT,
            &format!("authorities after kill {kill}"),
            || given(before).is_some(),
        );
        if kill < KILLS {
            files[0].kill_process("controller", kill, START_LIMIT);
        }
    }
    for finished in split.ended() {
        finished.assert_success();
    }
    println!("{}", split.files[0].read("report-full.txt"));
    for summary in split.summaries() {
        assert_eq!(summary.run.outcome, Outcome::Completed, "{:?}", summary.run);
        assert_nobody_collided(&summary);
        let passed_count = figure(&summary, "critical_sections_count");
        println!("{passed_count} critical sections");
        assert!(passed_count > 0.0);
        let mut known = summary.processes.iter();
        let controller = known.find(|one| one.name == "controller").unwrap();
        assert_eq!(controller.restart_count, u64::from(KILLS), "{controller:?}");
        for kill in 1..=KILLS {
            let told = format!("was killed by SIGKILL; restart {kill} of at most 3");
            let mut events = summary.events.iter();
            assert!(
                events.any(|one| one.process == "controller" && one.what().contains(&told)),
                "{told}: {:?}",
                summary.events
            );
        }
    }
}

#[test]
fn an_interrupted_fleet_leaves_its_report() {
    let record = RunFolder::new("fleet-stop");
    let trial = Trial::shipped("fleet-emulated.toml", record.path())
        .on_own_ports(&["commands", "states"])
        .set("run.duration=\"10 min\"");
    let mut child = trial.start_here();
    let files = trial.folder("", START_LIMIT);
    wait_until(START_LIMIT, "a few hundred states", || {
        files.record_bytes("fleet.state.taken.") > 20_000
            && files.record_bytes("fleet.authority.published.") > 200
    });
    child.signal(Signal::SIGINT).unwrap();
    let finished = child.wait_within(RUN_LIMIT).unwrap();
    assert_eq!(finished.status.code(), Some(130), "{finished:?}");
    assert!(files.has_report());
    files.assert_nothing_left_here();
    let summary = files.summary();
    assert_eq!(summary.run.outcome, Outcome::Stopped);
    assert_every_message_is_accounted_for(&summary);
    assert_nobody_collided(&summary);
    let truth = channel(&summary, "fleet/truth");
    assert!(truth.recorded.unwrap().message_count > 0);
    let report = files.read("report-full.txt");
    assert!(report.contains("fleet/truth  robots · recorded only"));
}
