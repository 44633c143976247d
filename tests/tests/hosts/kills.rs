//! `kill -9` during a split run: of each gateway and component in turn, of the robot when its end
//! is to end the run, and of a whole supervisor.

use std::process::Command;
use std::time::Duration;
use std::{fs, thread};

use hil_account::{InterruptionMetrics, MessageFate};
use hil_platform::text::grouped;
use hil_report::assessment::{Assessment, NetworkVerdict};
use hil_report::summary::{Outcome, RunEvent, RunSummary};
use hil_tests::account::{account, assert_every_message_is_accounted_for, carried, describe};
use hil_tests::binary::hil_runtime_binary;
use hil_tests::child::ChildGuard;
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::split::{ARM_CHANNELS, HOSTS, Split, direction};
use hil_tests::trial::{Trial, load_average, wait_until};
use nix::sys::signal::{Signal, kill};

const LIMIT: Duration = Duration::from_mins(1);
const RUN_LIMIT: Duration = Duration::from_mins(2);
/// What the runtime promises of a restart.
const RECOVERY_AIM_NS: i64 = 1_000_000_000;
/// What fails the test: a machine that stalls for a second must not.
const RECOVERY_MAX_NS: i64 = 3_000_000_000;
/// Records of 32 bytes: half a second of commands.
const FLOWING_BYTES: u64 = 60 * 32;

/// Starts `trial` on the two hosts of `lab` and waits until messages flow both ways.
fn start<'a>(lab: &'a Lab, trial: &Trial) -> Split<'a> {
    let split = Split::start(lab, trial).carrying(ARM_CHANNELS);
    split.wait_for_messages("the begin of the run");
    split
}

fn event(summary: &RunSummary, process: &str) -> String {
    let mut events = summary.events.iter();
    let found = events.find(|event| event.process == process);
    let found = found.unwrap_or_else(|| panic!("no event of {process} in {:?}", summary.events));
    found.what()
}

fn interruption<'a>(
    summary: &'a RunSummary,
    channel: &str,
    process: &str,
) -> &'a InterruptionMetrics {
    let all = &account(summary, channel).interruptions;
    let found = all.iter().find(|one| one.process == process);
    found.unwrap_or_else(|| panic!("{channel} knows no interruption of {process}: {all:?}"))
}

#[test]
fn killed_gateways_and_components_come_back_and_their_loss_is_put_down_to_them() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("kills");
    let trial = Trial::shipped("split.toml", record.path())
        .set("run.duration=\"10 min\"")
        .set("processes.controller.on_exit=\"restart\"")
        .set("processes.robot.on_exit=\"restart\"");
    let split = start(&lab, &trial);
    let killed = [
        (0, "gateway-hop-control-pc"),
        (1, "gateway-hop-robot-pc"),
        (0, "controller"),
        (1, "robot"),
    ];
    for (index, process) in killed {
        split.kill(index, process);
    }
    for summary in split.stop() {
        for (_, process) in killed {
            check_recovery(&summary, process);
        }
    }
}

/// Checks what a host says of one kill, and prints how long messages stayed away.
fn check_recovery(summary: &RunSummary, process: &str) {
    let what = event(summary, process);
    assert!(
        what.contains("was killed by SIGKILL; restart 1 of at most 3"),
        "{what}"
    );
    let mut known = summary.processes.iter().filter(|one| one.name == process);
    assert_eq!(known.next().map(|one| one.restart_count), Some(1));
    for channel in ["egm/right/command", "egm/right/feedback"] {
        let figures = interruption(summary, channel, process);
        let silence_ns = figures.gap.map(|gap| gap.length_ns);
        println!(
            "{} of {}: {process} killed, {channel} silent for {:.0} ms ({} the {} ms aimed at), \
             {} messages lost to it; load {}",
            summary.run.host,
            summary.run.name,
            silence_ns.unwrap_or(-1) as f64 * 1e-6,
            if silence_ns.is_some_and(|ns| ns <= RECOVERY_AIM_NS) {
                "within"
            } else {
                "NOT within"
            },
            RECOVERY_AIM_NS / 1_000_000,
            figures.lost_count,
            load_average()
        );
        assert!(figures.cause.contains("SIGKILL"), "{figures:?}");
        assert!(
            silence_ns.is_some_and(|ns| ns > 0 && ns <= RECOVERY_MAX_NS),
            "{channel}: {figures:?}"
        );
    }
    // Whatever carries or takes messages loses some; a producer that is not there publishes none.
    let loses = match process {
        "controller" => "egm/right/feedback",
        _ => "egm/right/command",
    };
    let figures = interruption(summary, loses, process);
    assert!(figures.lost_count > 0, "{loses}: {figures:?}");
}

#[test]
fn a_sender_that_learns_late_of_a_killed_receiver_blames_no_wire() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    // As behind a firewall: the kernel does not say that nobody listens, and the sender goes on with keys
    // that the new gateway does not know.
    let mut silence = lab.host(1).command("sh");
    silence.args(["-c", "echo 1000000000 > /proc/sys/net/ipv4/icmp_ratelimit"]);
    let mut silence = ChildGuard::spawn(&mut silence).unwrap();
    silence.wait_within(LIMIT).unwrap().assert_success();
    let record = RunFolder::new("kills-unheard");
    let trial = Trial::shipped("split.toml", record.path()).set("run.duration=\"10 min\"");
    let split = start(&lab, &trial);
    let process = "gateway-hop-robot-pc";
    split.kill(1, process);
    for summary in split.stop() {
        let channel = "egm/right/command";
        let figures = interruption(&summary, channel, process);
        let said = describe(channel, account(&summary, channel));
        println!("{said}; {figures:?}");
        assert!(figures.lost_count > 0, "{said}");
        // What is lost to a start that takes longer is put down to the network.
        let is_long = figures.gap.is_none_or(|gap| gap.length_ns > 2_000_000_000);
        let lost_count = account(&summary, channel).fates.of(MessageFate::LostOnWire);
        assert!(lost_count == 0 || is_long, "{said}; {figures:?}");
    }
}

#[test]
fn a_receiver_that_stood_still_is_no_network_result() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("kills-late");
    let trial = Trial::shipped("shuttle-split.toml", record.path())
        .set("run.duration=\"10 min\"")
        .set("case.parameters.rate_hz=1000.0");
    let split = Split::start(&lab, &trial);
    split.wait_for_messages("the begin of the run");
    let gateway = split.files[1].process("gateway-hop-robot-pc", 0).unwrap();
    kill(gateway, Signal::SIGSTOP).unwrap();
    thread::sleep(Duration::from_millis(1500));
    kill(gateway, Signal::SIGCONT).unwrap();
    // What had room is taken first.
    split.wait_for_messages("the receiver stood still");
    for summary in split.stop() {
        let channel = "shuttle/command";
        let said = describe(channel, account(&summary, channel));
        let no_room = direction(&summary, channel, "ingress").no_room_count();
        let fates = &account(&summary, channel).fates;
        let lost = fates.of(MessageFate::LostByHarness);
        // Where the counts differ, as by a datagram that is no message, nobody can say.
        let doubtful = fates.of(MessageFate::LostOnWireOrByHarness);
        println!("{said}; {no_room} datagrams without room");
        assert!(
            (1..=no_room).contains(&(lost + doubtful)),
            "{lost} and {doubtful} of {no_room}: {said}"
        );
        assert_eq!(fates.of(MessageFate::LostOnWire), 0, "{said}");
        let assessment = Assessment::of(&summary);
        assert!(
            matches!(
                assessment.network,
                NetworkVerdict::ReceiverLate { .. } | NetworkVerdict::HostOverran { .. }
            ),
            "{assessment:?}"
        );
        let warnings = assessment.warnings.join("\n");
        assert!(
            lost == 0 || warnings.contains(&format!("lost {} messages so", grouped(lost))),
            "{warnings}"
        );
    }
}

#[test]
fn a_killed_robot_ends_the_run_on_both_hosts_with_a_complete_report() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("robot-killed");
    // Long, so that only the kill can end it in time.
    let trial = Trial::shipped("split.toml", record.path()).set("run.duration=\"10 min\"");
    let mut split = start(&lab, &trial);
    split.files[1].kill_process("robot", 0, LIMIT);
    let finished = split.ended();
    for finished in &finished {
        finished.assert_code(1);
    }
    let [control, robot] = split.summaries();
    assert_eq!(robot.run.outcome, Outcome::Failed);
    assert_eq!(control.run.outcome, Outcome::Failed);
    for summary in [control, robot] {
        let reason = &summary.run.exit_reason;
        assert!(
            reason.contains("process robot was killed by SIGKILL"),
            "{reason}"
        );
        assert_eq!(
            event(&summary, "robot"),
            "robot: was killed by SIGKILL; policy: end the run"
        );
        for channel in carried(&summary) {
            let account = account(&summary, &channel.name);
            println!("{}", describe(&channel.name, account));
            assert!(account.end_to_end.distribution.measured().is_some());
        }
        assert_every_message_is_accounted_for(&summary);
    }
}

#[test]
fn a_killed_supervisor_takes_its_processes_along_and_the_other_host_says_who_vanished() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    // First the host that joins, then the one that is joined.
    kill_supervisor(&lab, 1);
    kill_supervisor(&lab, 0);

    // The hosts are as good as before, and the next run sweeps what the dead one left.
    let record = RunFolder::new("after-the-kill");
    let trial = Trial::shipped("split.toml", record.path()).set("run.duration=\"2 s\"");
    let mut next = start(&lab, &trial);
    for finished in next.ended() {
        finished.assert_success();
    }
    for summary in next.summaries() {
        assert_every_message_is_accounted_for(&summary);
    }
}

/// Starts a run, kills the supervisor of host `victim`, and checks what the other one makes of it.
fn kill_supervisor(lab: &Lab, victim: usize) {
    let other = 1 - victim;
    let record = RunFolder::new("supervisor-killed");
    let trial = Trial::shipped("split.toml", record.path())
        .set("run.duration=\"10 min\"")
        .set("run.peer_timeout=\"2 s\"");
    let mut split = start(lab, &trial);
    assert!(split.files[victim].processes().len() >= 2);
    split.hosts[victim].signal(Signal::SIGKILL).unwrap();
    wait_until(LIMIT, "the end of the dead supervisor's processes", || {
        split.files[victim].processes().is_empty()
    });
    let survivor = split.hosts[other].wait_within(RUN_LIMIT).unwrap();
    survivor.assert_code(69);
    split.files[other].assert_nothing_left_on(lab.host(other));
    let summary = split.files[other].summary();
    assert_eq!(summary.run.outcome, Outcome::Failed);
    let vanished = format!("another host vanished: {}", HOSTS[victim]);
    let reason = &summary.run.exit_reason;
    assert!(reason.contains(&vanished), "{reason}");
    assert!(split.files[other].has_report());
    let warnings = summary.warnings.join("\n");
    assert!(warnings.contains(HOSTS[victim]), "{warnings}");
    for channel in carried(&summary) {
        let account = channel.account.as_ref();
        let said = account.map(|account| describe(&channel.name, account));
        println!("{} alone: {said:?}", HOSTS[other]);
    }
    assert!(account(&summary, "egm/right/command").published_count > 0);
    let page = record.join("page.html");
    let made = Command::new(hil_runtime_binary())
        .arg("report")
        .arg(split.files[other].root())
        .arg("-o")
        .arg(&page)
        .output()
        .unwrap();
    assert!(made.status.success(), "{made:?}");
    let page = fs::read_to_string(page).unwrap();
    assert!(page.contains(&vanished) && page.len() < 3_000_000);
}

#[test]
fn an_interrupted_host_ends_the_run_on_both_with_complete_reports() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("one-interrupted");
    let trial = Trial::shipped("split.toml", record.path()).set("run.duration=\"10 min\"");
    let mut split = start(&lab, &trial);
    split.hosts[1].signal(Signal::SIGINT).unwrap();
    let [control, robot] = split.ended();
    control.assert_code(1);
    robot.assert_code(130);
    let [control, robot] = split.summaries();
    assert_eq!(robot.run.exit_reason, "interrupted by Ctrl-C (SIGINT)");
    let reason = &control.run.exit_reason;
    assert!(
        reason.contains("robot-pc interrupted by Ctrl-C"),
        "{reason}"
    );
    for summary in [control, robot] {
        assert_eq!(summary.run.outcome, Outcome::Stopped);
        assert_every_message_is_accounted_for(&summary);
    }
}

#[test]
fn a_process_that_dies_too_often_ends_the_run() {
    let record = RunFolder::new("too-often");
    let trial = Trial::shipped("shuttle-local.toml", record.path())
        .set("run.duration=\"10 min\"")
        .set("processes.robot.on_exit=\"restart\"")
        .set("processes.robot.restart_limit=1");
    let mut child = trial.start_here();
    let files = trial.folder("", LIMIT);
    for instance in 0..2 {
        let taken = format!("shuttle.command.taken.robot.{instance}.");
        wait_until(LIMIT, &taken, || files.record_bytes(&taken) > FLOWING_BYTES);
        files.kill_process("robot", instance, LIMIT);
    }
    let finished = child.wait_within(RUN_LIMIT).unwrap();
    finished.assert_code(1);
    files.assert_nothing_left_here();
    let summary = files.summary();
    let events: Vec<String> = summary.events.iter().map(RunEvent::what).collect();
    let expected = [
        "robot: was killed by SIGKILL; restart 1 of at most 1",
        "robot: was killed by SIGKILL; policy: end the run",
    ];
    assert_eq!(events, expected);
    assert_every_message_is_accounted_for(&summary);
    let status = account(&summary, "shuttle/status");
    assert_eq!(status.producer_restart_count, 1);
}
