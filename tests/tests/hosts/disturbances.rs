//! What a run does when the hosts or the network change beneath it: the cable, the address and the
//! packet size of its link, a second supervisor that claims the same host, a host that never comes
//! and one that goes for good, a record folder that does not answer. `docs/robustness.md` has the table.

use std::fs::{self, File};
use std::io::Read;
use std::thread;
use std::time::Duration;

use hil_account::MessageFate;
use hil_report::summary::{Outcome, RunEvent, RunEventKind, RunSummary};
use hil_rundir::event::EventKind;
use hil_tests::account::{account, assert_every_message_is_accounted_for, describe};
use hil_tests::child::ChildGuard;
use hil_tests::lab::{BRIDGE_PORTS, INTERFACE, Lab};
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::CHANNELS;
use hil_tests::split::{HOSTS, Split};
use hil_tests::trial::{Trial, hop_key, wait_until};
use nix::sys::stat::Mode;
use nix::unistd::mkfifo;

use super::many_channels;

const LIMIT: Duration = Duration::from_mins(1);
const RUN_LIMIT: Duration = Duration::from_mins(2);
/// How long a disturbance lasts: below the least silence after which a peer counts as gone.
const DISTURBED: Duration = Duration::from_millis(1200);
/// Exit codes, as `--help` lists them.
const PEER_ABSENT: i32 = 69;
const TRY_AGAIN: i32 = 75;
/// Below the length of a shuttle command's datagram, above what the kernel takes for IPv4.
const TINY_MTU: u16 = 80;

/// Starts `trial` on both hosts and waits until messages flow both ways.
fn start<'a>(lab: &'a Lab, trial: &Trial) -> Split<'a> {
    let split = Split::start(lab, trial);
    split.wait_for_messages("the begin of the run");
    split
}

/// What neither the consumer took nor a newer message replaced.
fn missing(summary: &RunSummary, channel: &str) -> u64 {
    let fates = &account(summary, channel).fates;
    [
        MessageFate::RefusedByKernel,
        MessageFate::LostOnWire,
        MessageFate::SupersededAtInput,
        MessageFate::SupersededAtConsumer,
    ]
    .into_iter()
    .map(|fate| fates.of(fate))
    .sum()
}

#[test]
fn cable_address_and_packet_size_change_under_a_run_and_it_goes_on() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("disturbed");
    let trial = Trial::shipped("shuttle-split.toml", record.path()).set("run.duration=\"10 min\"");
    let split = start(&lab, &trial);
    let robot = lab.host(1);

    robot.set_link(INTERFACE, "down");
    thread::sleep(DISTURBED);
    robot.set_link(INTERFACE, "up");
    split.wait_for_messages("the cable was out");

    robot.take_address();
    thread::sleep(DISTURBED);
    robot.give_address();
    split.wait_for_messages("the address was gone");

    for index in [0, 1] {
        lab.host(index).set_mtu(TINY_MTU);
    }
    thread::sleep(DISTURBED);
    for index in [0, 1] {
        lab.host(index).set_mtu(1500);
    }
    split.wait_for_messages("the packets were to be small");

    // A second supervisor that says it is the robot's host: the run has its two hosts already.
    let second = trial.clone().set("run.start_timeout=\"1 s\"");
    let mut double = second.start_on(robot);
    let double = double.wait_within(RUN_LIMIT).unwrap();
    double.assert_code(TRY_AGAIN);
    assert!(
        double.stderr.contains("is held by hil-runtime"),
        "{double:?}"
    );
    split.wait_for_messages("a second robot-pc");
    let mut double = second.start_on(lab.host(0));
    let double = double.wait_within(RUN_LIMIT).unwrap();
    double.assert_code(TRY_AGAIN);
    split.wait_for_messages("a second control-pc");

    for summary in split.stop() {
        for channel in CHANNELS {
            assert!(missing(&summary, channel) > 0, "{channel} felt nothing");
        }
    }
}

#[test]
fn a_gateway_that_comes_back_while_the_path_is_away_waits_for_it() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("path-away");
    let trial = Trial::shipped("shuttle-split.toml", record.path())
        .set("run.duration=\"10 min\"")
        // The supervisors' connection leads over the same cable.
        .set("run.peer_timeout=\"60 s\"");
    let split = start(&lab, &trial);
    let robot = lab.host(1);
    for instance in [0, 1] {
        let is_cable = instance == 0;
        if is_cable {
            robot.set_link(INTERFACE, "down");
        } else {
            robot.set_mtu(TINY_MTU);
        }
        split.files[1].kill_process("gateway-hop-robot-pc", instance, LIMIT);
        wait_until(LIMIT, "that it waits", || {
            let told = split.hosts[1].stderr_so_far();
            told.matches("waiting for the link").count() > usize::from(!is_cable)
        });
        if is_cable {
            robot.set_link(INTERFACE, "up");
        } else {
            robot.set_mtu(1500);
        }
        split.wait_for_messages("a gateway came back without a path");
    }
    for summary in split.stop() {
        let mut events = summary.events.iter();
        assert!(events.any(|event| event.what().contains("waiting for the link")));
    }
}

#[test]
fn a_host_that_never_comes_and_one_that_goes_for_good_are_named() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("gone");
    let trial = Trial::shipped("shuttle-split.toml", record.path())
        .set("run.duration=\"10 min\"")
        .set("run.peer_timeout=\"2 s\"");

    // In a folder of its own: runs that did not come about leave one too.
    let absent = RunFolder::new("never-came");
    let alone =
        Trial::shipped("shuttle-split.toml", absent.path()).set("run.start_timeout=\"1 s\"");
    for index in [0, 1] {
        let mut child = alone.start_on(lab.host(index));
        let finished = child.wait_within(RUN_LIMIT).unwrap();
        finished.assert_code(PEER_ABSENT);
        let words = format!("{} did not appear within 1 s", HOSTS[1 - index]);
        assert!(finished.stderr.contains(&words), "{finished:?}");
        assert!(lab.host(index).shared_memory_leftovers().is_empty());
    }

    let mut split = start(&lab, &trial);
    lab.host(1).set_link(INTERFACE, "down");
    for (index, finished) in split.ended().iter().enumerate() {
        finished.assert_code(PEER_ABSENT);
        let summary = split.files[index].summary();
        assert_eq!(summary.run.outcome, Outcome::Failed);
        let words = format!("{} has been silent for 2 s", HOSTS[1 - index]);
        let reason = &summary.run.exit_reason;
        assert!(reason.contains(&words), "{reason}");
        assert!(split.files[index].has_report());
    }
}

/// A pipe in the place of a file that the supervisor writes anew twice a second: whoever opens it to write
/// waits for a reader, as for a disk that others write gigabytes to.
#[test]
fn a_disk_that_does_not_answer_makes_no_host_silent() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("slow-disk");
    let trial = Trial::shipped("shuttle-split.toml", record.path())
        .set("run.duration=\"10 min\"")
        .set("run.peer_timeout=\"2 s\"");
    let split = start(&lab, &trial);
    let pipe = split.files[0].root().join("status.json.new");
    wait_until(LIMIT, "a moment without the file", || {
        mkfifo(&pipe, Mode::S_IRWXU).is_ok()
    });
    thread::sleep(Duration::from_millis(3_500));
    split.wait_for_messages("more than the silence that is borne");
    // The disk answers again.
    let mut held_back = String::new();
    let mut reader = File::open(&pipe).unwrap();
    reader.read_to_string(&mut held_back).unwrap();
    assert!(held_back.contains("\"phase\":\"running\""), "{held_back}");
    let status = split.files[0].root().join("status.json");
    wait_until(LIMIT, "the file itself", || {
        fs::symlink_metadata(&status).is_ok_and(|data| data.is_file())
    });
    split.stop();
}

/// A path that drops what passes without a word: no reset, no report, and the cable stays in. A third of the silence that
/// is borne, and longer than the supervisors wait for a byte.
const SILENT_FOR: Duration = Duration::from_secs(5);
const SILENCE_BORNE: &str = "run.peer_timeout=\"15 s\"";
/// What the hosts' network is slowed to after the run, so that the exchange of records takes seconds.
const SLOW: &str = "tbf rate 2mbit burst 64kb limit 1mb";

/// What leaves these hosts meets the queue `what`, the kernel's own where it is empty.
fn set_queue(lab: &Lab, hosts: &[usize], what: &str) {
    for host in hosts {
        let words = if what.is_empty() {
            format!("qdisc delete dev {INTERFACE} root")
        } else {
            format!("qdisc replace dev {INTERFACE} root {what}")
        };
        let mut command = lab.host(*host).command("tc");
        let status = command.args(words.split(' ')).status().unwrap();
        assert!(status.success(), "tc {words}");
    }
}

#[test]
fn a_path_that_drops_everything_silently_for_less_than_a_host_may_be_away_ends_nothing() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("silent-path");
    let trial = Trial::shipped("shuttle-split.toml", record.path())
        .set("case.parameters.rate_hz=200.0")
        .set("run.duration=\"10 min\"")
        .set(SILENCE_BORNE);
    let mut split = start(&lab, &trial);
    // Both ways, and either alone.
    let both = [0, 1];
    let silences = [&both[..], &both[..1], &both[1..]];
    for (number, silent) in silences.into_iter().enumerate() {
        set_queue(&lab, silent, "blackhole");
        thread::sleep(SILENT_FOR);
        set_queue(&lab, silent, "");
        wait_until(LIMIT, "the supervisors' connection", || {
            let mut told = split.hosts.iter().map(ChildGuard::stderr_so_far);
            told.all(|text| text.matches("is back after").count() > number)
        });
        split.wait_for_messages("a silent path");
    }
    set_queue(&lab, &both, SLOW);
    split.interrupt();
    wait_until(LIMIT, "records of the other host", || {
        split.files[0].record_bytes("shuttle.command.taken.") > 0
    });
    set_queue(&lab, &both, "blackhole");
    thread::sleep(SILENT_FOR);
    set_queue(&lab, &both, SLOW);
    for summary in split.stopped() {
        let cuts: Vec<String> = summary
            .events
            .iter()
            .filter(|event| {
                matches!(
                    event.kind,
                    RunEventKind::Process(EventKind::Reconnected { .. })
                )
            })
            .map(|event| format!("at {:?} s, {}", event.at_s, event.what()))
            .collect();
        println!("{}: {cuts:#?}", summary.run.host);
        assert!(cuts.len() >= 4, "{cuts:?}");
        assert_every_message_is_accounted_for(&summary);
    }
}

/// Of the narrow path between two switches, bytes; a datagram of it, with room for the headers of IPv6.
const NARROW_MTU: u16 = 1280;
const NARROW_DATAGRAM: usize = 1232;

/// A bridge tells nobody what it does not forward, as a path behind a filter does not.
#[test]
fn a_path_that_takes_less_than_its_interfaces_is_found_before_the_first_message() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    lab.put_bridge_between();
    let mut narrow = lab.host(0).command("ip");
    narrow.args([
        "link",
        "set",
        BRIDGE_PORTS[1],
        "mtu",
        &NARROW_MTU.to_string(),
    ]);
    assert!(narrow.status().unwrap().success());
    for is_sealed in [false, true] {
        let record = RunFolder::new("narrow");
        let path = many_channels::topology(&record, 2, 100, Duration::from_secs(4));
        let mut trial = Trial::of(&path, record.path());
        if is_sealed {
            let key = hop_key(record.path());
            trial = trial
                .set("security.hops=\"sealed\"")
                .set(&format!("security.key=\"{}\"", key.display()));
        }
        for name in ["there/0", "back/1"] {
            trial = trial.set(&format!("channels.\"{name}\".message.size_bytes=4000"));
        }
        let mut split = Split::start(&lab, &trial);
        for finished in split.ended() {
            finished.assert_success();
        }
        for summary in split.summaries() {
            for name in ["there/0", "back/1"] {
                let account = account(&summary, name);
                println!("sealed {is_sealed}: {}", describe(name, account));
                assert_eq!(account.fates.of(MessageFate::LostOnWire), 0);
                assert!(account.fates.of(MessageFate::Taken) > 200);
            }
            let words = format!("takes no datagrams above {NARROW_DATAGRAM} bytes");
            let is_told = |event: &RunEvent| event.what().contains(&words);
            assert!(summary.events.iter().any(is_told), "{:?}", summary.events);
        }
    }
}
