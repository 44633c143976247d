//! A run that is started a second time on one host is refused before it touches anything, told which run goes
//! on there, and costs that one nothing.

use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use hil_report::summary::Outcome;
use hil_tests::account::account;
use hil_tests::child::{ChildGuard, Finished};
use hil_tests::lab::{INTERFACE, Lab};
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::CHANNELS;
use hil_tests::split::{HOSTS, Split, count, direction};
use hil_tests::trial::Trial;
use nix::sys::signal::Signal;

const LIMIT: Duration = Duration::from_mins(1);
/// Second starts on each host while messages flow.
const STARTS: usize = 2;

fn ended(child: &mut ChildGuard) -> Finished {
    let ended = child.wait_within(LIMIT);
    ended.unwrap_or_else(|reason| panic!("{reason}"))
}

/// Starts what goes on as `first` in `folder` again, which must be refused because of `key`.
fn start_again(again: &mut ChildGuard, first: &ChildGuard, folder: &Path, key: &str) {
    let begun = Instant::now();
    let refused = ended(again);
    let (pid, folder) = (first.pid(), folder.display());
    let words = format!("is held by hil-runtime (process {pid}), the run in {folder};");
    println!(
        "refused within {:?}: {}",
        begun.elapsed(),
        refused.stderr.lines().next().unwrap_or_default()
    );
    refused.assert_code(75);
    assert!(refused.stderr.contains(&words), "{}", refused.stderr);
    assert!(refused.stderr.contains(key), "{}", refused.stderr);
}

fn folder_count(record: &Path) -> usize {
    let entries = fs::read_dir(record).unwrap().flatten();
    entries.filter(|entry| entry.path().is_dir()).count()
}

#[test]
fn a_second_start_is_refused_and_costs_the_first_run_no_message_and_no_connection() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    for topology in ["shuttle-tcp.toml", "shuttle-split.toml"] {
        let record = RunFolder::new("again");
        let trial = Trial::shipped(topology, record.path())
            .set("run.duration=\"10 min\"")
            .set("channels.\"shuttle/command\".depth=256")
            .set("channels.\"shuttle/status\".depth=256");
        // It waits for the other host and has bound no port.
        let robot = trial.start_on(lab.host(1));
        let files = trial.folder("-robot-pc", LIMIT);
        let mut again = trial.start_on(lab.host(1));
        start_again(&mut again, &robot, files.root(), "control_port");
        let split = Split::of(&lab, &trial, [trial.start_on(lab.host(0)), robot]);
        split.wait_for_messages("the begin of the run");
        for _ in 0..STARTS {
            for index in 0..2 {
                let mut again = trial.start_on(lab.host(index));
                let folder = split.files[index].root();
                start_again(&mut again, &split.hosts[index], folder, "links.hop.port");
            }
        }
        let summaries = split.stop();
        for (summary, name) in summaries
            .iter()
            .flat_map(|one| CHANNELS.map(|name| (one, name)))
        {
            assert_eq!(account(summary, name).fates.lost_count(), 0, "{name}");
            let egress = direction(summary, name, "egress");
            assert_eq!(count(egress, "transport: reconnect_count"), 0, "{name}");
        }
        assert_eq!(folder_count(record.path()), HOSTS.len());
    }
}

/// Other ports, another meeting, the same card. A cable of a lab has none that stamps; what a run sets up there is
/// claimed all the same.
#[test]
fn a_run_that_wants_the_card_of_another_one_is_refused_and_one_without_it_runs_beside_it() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("card");
    let trial = |name: &str, port: u16, stamps: &str| {
        Trial::shipped("shuttle-split.toml", &record.join(name))
            .set(&format!("links.hop.port={port}"))
            .set(&format!("hosts.control-pc.control_port={}", port + 9))
            .set(&format!("links.hop.timestamps=\"{stamps}\""))
            .set("channels.\"shuttle/command\".depth=256")
            .set("channels.\"shuttle/status\".depth=256")
    };
    let first = trial("first", 7_930, "hardware").set("run.duration=\"10 min\"");
    let first = Split::start(&lab, &first);
    first.wait_for_messages("the begin of the run");
    let others = trial("second", 7_950, "hardware");
    for (index, host) in HOSTS.iter().enumerate() {
        let mut again = others.start_on(lab.host(index));
        let refused = ended(&mut again);
        println!("{}", refused.stderr);
        refused.assert_code(75);
        let (pid, folder) = (first.hosts[index].pid(), first.files[index].root());
        for words in [
            format!("hosts.{host}.address"),
            format!("card {INTERFACE} is held by hil-runtime (process {pid}), the run in "),
            format!("{};", folder.display()),
        ] {
            assert!(
                refused.stderr.contains(&words),
                "{words}: {}",
                refused.stderr
            );
        }
        let keys = ["links.hop.port", "control_port"];
        assert!(keys.iter().all(|key| !refused.stderr.contains(key)));
    }
    let beside = trial("third", 7_970, "software").set("run.duration=\"2 s\"");
    let mut beside = Split::start(&lab, &beside);
    for host in &mut beside.hosts {
        ended(host).assert_success();
    }
    for summary in [first.stop(), beside.summaries()].concat() {
        for name in CHANNELS {
            assert_eq!(account(&summary, name).fates.lost_count(), 0, "{name}");
        }
    }
    assert_eq!(folder_count(&record.join("second")), 0);
}

#[test]
fn a_run_starts_after_the_one_before_it_was_killed() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("killed-before");
    let trial = |name: &str| {
        Trial::shipped("shuttle-split.toml", &record.join(name)).set("run.duration=\"2 s\"")
    };
    let first = Split::start(&lab, &trial("first").set("run.duration=\"60 s\""));
    first.wait_for_messages("the begin of the run");
    let mut killed = first.hosts;
    for host in &mut killed {
        host.signal(Signal::SIGKILL).unwrap();
        ended(host);
    }
    let second = Split::start(&lab, &trial("second"));
    for summary in second.finish() {
        assert_eq!(summary.run.outcome, Outcome::Completed);
    }
}
