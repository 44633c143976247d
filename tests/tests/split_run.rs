//! The real binary on two hosts: the teleoperated arm over a real UDP hop, started once on each.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::time::Duration;

use hil_tests::binary::{hil_runtime_binary, workspace_folder};
use hil_tests::child::ChildGuard;
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;

#[test]
fn a_split_run_accounts_for_every_message() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let folder = RunFolder::new("split");
    let topology = workspace_folder().join("deploy/topologies/split.toml");
    let start = |index: usize| {
        let mut command = lab.host(index).command(hil_runtime_binary());
        command.arg("--topology").arg(&topology);
        command.arg("--set").arg("run.duration=\"10 s\"");
        command
            .arg("--set")
            .arg(format!("run.record=\"{}\"", folder.path().display()));
        ChildGuard::spawn(&mut command).unwrap()
    };
    let mut hosts = [start(0), start(1)];
    for host in &mut hosts {
        let finished = host.wait_within(Duration::from_secs(60)).unwrap();
        println!("{finished:?}");
        finished.assert_success();
    }
    for index in 0..2 {
        assert!(lab.host(index).shared_memory_leftovers().is_empty());
    }
}
