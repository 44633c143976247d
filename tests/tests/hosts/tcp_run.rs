//! The real binary on two hosts with its channels over TCP: every message accounted for, a link
//! that stands still, and a gateway that is killed.

use std::process::Command;
use std::thread;
use std::time::Duration;

use hil_account::MessageFate;
use hil_report::summary::{DirectionSummary, LinkKind, Outcome, RunSummary};
use hil_tests::account::{
    account, assert_accounts_close, assert_every_message_is_accounted_for, channel, describe,
};
use hil_tests::child::ChildGuard;
use hil_tests::lab::{INTERFACE, Lab, LabHost};
use hil_tests::run_folder::RunFolder;
use hil_tests::split::direction;
use hil_tests::trial::{RunFiles, Trial, wait_until};

const HOSTS: [&str; 2] = ["control-pc", "robot-pc"];
const CHANNELS: [&str; 2] = ["shuttle/command", "shuttle/status"];
const LIMIT: Duration = Duration::from_mins(1);
const RUN_LIMIT: Duration = Duration::from_mins(2);
/// Records of 32 bytes: half a second of commands.
const FLOWING_BYTES: u64 = 50 * 32;
/// How long the link stands still.
const STANDSTILL: Duration = Duration::from_millis(700);

struct Split {
    hosts: [ChildGuard; 2],
    files: [RunFiles; 2],
    lab: Lab,
}

impl Split {
    fn start(record: &RunFolder, duration: &str) -> Option<Self> {
        let lab = Lab::two_hosts_or_skip()?;
        // Deep enough for all that comes at once after a standstill.
        let trial = Trial::shipped("shuttle-tcp.toml", record.path())
            .set(&format!("run.duration=\"{duration}\""))
            .set("channels.\"shuttle/command\".depth=256")
            .set("channels.\"shuttle/status\".depth=256");
        let hosts = [0, 1].map(|index| trial.start_on(lab.host(index)));
        let files = HOSTS.map(|host| trial.folder(&format!("-{host}"), LIMIT));
        Some(Self { hosts, files, lab })
    }

    /// Waits until both ends have taken half a second's messages from now on.
    fn wait_for_messages(&self, after: &str) {
        let taken = || {
            let commands = self.files[1].record_bytes("shuttle.command.taken.");
            let statuses = self.files[0].record_bytes("shuttle.status.taken.");
            [commands, statuses]
        };
        let before = taken();
        wait_until(LIMIT, &format!("messages both ways after {after}"), || {
            let now = taken();
            (0..2).all(|way| now[way] >= before[way] + FLOWING_BYTES)
        });
    }

    fn finish(mut self) -> [RunSummary; 2] {
        for host in &mut self.hosts {
            let finished = host.wait_within(RUN_LIMIT).unwrap();
            finished.assert_success();
        }
        let summaries = [0, 1].map(|index| self.files[index].summary());
        for (index, files) in self.files.iter().enumerate() {
            files.assert_nothing_left_on(self.lab.host(index));
        }
        for summary in &summaries {
            assert_eq!(summary.run.outcome, Outcome::Completed, "{:?}", summary.run);
            assert_every_message_is_accounted_for(summary);
            for name in CHANNELS {
                assert_eq!(channel(summary, name).link, LinkKind::named("tcp").unwrap());
                let said = describe(name, account(summary, name));
                println!("{}: {said}", summary.run.host);
            }
        }
        summaries
    }
}

fn count(direction: &DirectionSummary, name: &str) -> u64 {
    let mut all = direction.counters.iter();
    let found = all.find(|one| one.label() == name);
    found
        .unwrap_or_else(|| panic!("no {name} in {:?}", direction.counters))
        .count
}

fn fact<'a>(direction: &'a DirectionSummary, label: &str) -> &'a str {
    let mut all = direction.facts.iter();
    let found = all.find(|one| one.label == label);
    &found
        .unwrap_or_else(|| panic!("no {label} in {:?}", direction.facts))
        .value
}

#[test]
fn a_run_over_tcp_accounts_for_every_message_and_loses_none() {
    let record = RunFolder::new("tcp");
    let Some(split) = Split::start(&record, "8 s") else {
        return;
    };
    let page = split.files[0].clone();
    for summary in &split.finish() {
        assert_accounts_close(summary);
        for name in CHANNELS {
            let account = account(summary, name);
            assert_eq!(account.fates.lost_count(), 0);
            assert_eq!(account.reordered_count, Some(0));
            assert_eq!(account.duplicated_count, Some(0));
            let coverage = account.coverage;
            for stamps in [coverage.tx_software, coverage.rx_software] {
                let ratio = stamps.and_then(|stamps| stamps.ratio());
                assert!(ratio.is_none_or(|ratio| ratio < f64::EPSILON), "{stamps:?}");
            }
            let egress = direction(summary, name, "egress");
            assert_eq!(count(egress, "transport: connection_count"), 1);
            assert_eq!(count(egress, "transport: reconnect_count"), 0);
            assert!(fact(egress, "kernel stamps").starts_with("unavailable over TCP"));
            assert!(egress.stalls.unwrap().threshold_ns > 50_000_000);
            println!("{name}: {:?}", egress.facts);
            let ingress = direction(summary, name, "ingress");
            assert_eq!(count(ingress, "transport: bad_frame_count"), 0);
            assert_eq!(count(ingress, "transport: foreign_connection_count"), 0);
            let round_trip = account.round_trip.measured();
            assert!(round_trip.is_some_and(|figures| figures.count > 10));
        }
    }
    let report = page.read("report-full.txt");
    assert!(report.contains("controller → robot · TCP"), "{report}");
    assert!(report.contains("\n  stalls "), "{report}");
}

fn traffic_control(host: &LabHost, words: &str) {
    let mut command: Command = host.command("tc");
    let status = command.args(words.split(' ')).status().unwrap();
    assert!(status.success(), "tc {words}");
}

#[test]
fn a_link_that_stands_still_shows_as_a_stall_and_loses_nothing() {
    let record = RunFolder::new("tcp-stall");
    let Some(split) = Split::start(&record, "8 s") else {
        return;
    };
    split.wait_for_messages("the begin of the run");
    let host = split.lab.host(0);
    // A queue without room: nothing leaves, as on a radio without reception.
    traffic_control(
        host,
        &format!("qdisc add dev {INTERFACE} root pfifo limit 0"),
    );
    thread::sleep(STANDSTILL);
    traffic_control(host, &format!("qdisc del dev {INTERFACE} root"));
    split.wait_for_messages("the standstill");
    for summary in &split.finish() {
        assert_accounts_close(summary);
        for name in CHANNELS {
            assert_eq!(account(summary, name).fates.lost_count(), 0);
            let egress = direction(summary, name, "egress");
            println!("{name}: {:?}", egress.facts);
            assert_eq!(count(egress, "transport: reconnect_count"), 0);
            // The way out stands still, and so do the acknowledgements of what came in.
            assert!(count(egress, "transport: stall_count") >= 1, "{egress:?}");
            let longest_us = u128::from(count(egress, "transport: stall_longest_us"));
            assert!(
                longest_us >= STANDSTILL.as_micros() * 9 / 10,
                "{longest_us}"
            );
        }
        let egress = direction(summary, CHANNELS[0], "egress");
        assert!(count(egress, "transport: waiting_bytes_max") > 1_000);
        let end_to_end = account(summary, CHANNELS[0])
            .end_to_end
            .distribution
            .measured();
        let longest_ns = end_to_end.unwrap().max_ns;
        assert!(longest_ns >= 500_000_000, "{longest_ns}");
    }
}

#[test]
fn a_killed_gateway_comes_back_and_what_was_under_way_is_counted_as_lost() {
    let record = RunFolder::new("tcp-kill");
    let Some(split) = Split::start(&record, "12 s") else {
        return;
    };
    split.wait_for_messages("the begin of the run");
    let killed = "gateway-hop-robot-pc";
    split.files[1].kill_process(killed, 0, LIMIT);
    wait_until(LIMIT, "the restart", || {
        split.files[1].process(killed, 1).is_some()
    });
    split.wait_for_messages("the restart");
    for summary in &split.finish() {
        let commands = account(summary, CHANNELS[0]);
        assert!(commands.fates.lost_count() > 0, "{:?}", commands.fates);
        assert_eq!(
            commands.fates.of(MessageFate::LostOnWire),
            0,
            "{:?}",
            commands.fates
        );
        let mut interruptions = commands.interruptions.iter();
        let own = interruptions.find(|one| one.process == killed).unwrap();
        println!("{own:?}");
        assert!(own.cause.contains("SIGKILL"));
        let egress = direction(summary, CHANNELS[0], "egress");
        println!("{}: {:?}", CHANNELS[0], egress.facts);
        assert_eq!(count(egress, "transport: reconnect_count"), 1);
        let told = |words: &str| {
            summary
                .events
                .iter()
                .any(|event| event.what().contains(words))
        };
        assert!(told("and is back (reconnect 1)"), "{:?}", summary.events);
    }
}
