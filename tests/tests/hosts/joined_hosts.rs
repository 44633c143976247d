//! Two programs that speak IP on two hosts: the topology of the manual, over a real hop.

use std::time::Duration;

use hil_account::flow::FlowMetrics;
use hil_report::summary::RunSummary;
use hil_tests::account::assert_every_message_is_accounted_for;
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::Trial;

const LIMIT: Duration = Duration::from_mins(1);
const HOSTS: [&str; 2] = ["control-pc", "robot-pc"];

/// Frames of 1514 bytes, which go in two datagrams each.
const TOPOLOGY: &str = r#"
version = 1
name = "two-programs"
[hosts]
control-pc.address = "10.77.0.1"
robot-pc.address = "10.77.0.2"
[processes]
controller = { host = "control-pc", run = ["ping", "-c", "50", "-i", "0.02", "-s", "1472", "10.99.0.2"], inside = "10.99.0.1" }
robot = { host = "robot-pc", run = ["sleep", "100"], inside = "10.99.0.2" }
[channels]
out = { from = "controller", to = "robot", link = "hop" }
back = { from = "robot", to = "controller", link = "hop" }
[links.hop]
via = "udp"
[security]
hops = "plain"
"#;

fn echoes<'a>(summary: &'a RunSummary, name: &str) -> &'a FlowMetrics {
    let mut flows = summary.flows.iter().flat_map(|one| &one.flows);
    flows.find(|one| one.name == name).unwrap()
}

#[test]
fn programs_on_two_hosts_have_one_account_of_their_frames() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("joined-hosts");
    let trial = Trial::of(&record.write("two-programs.toml", TOPOLOGY), record.path()).plain();
    let children = [0, 1].map(|index| trial.start_on(lab.host(index)));
    for mut child in children {
        child.wait_within(LIMIT).unwrap().assert_success();
    }
    for (index, host) in HOSTS.iter().enumerate() {
        let files = trial.folder(host, LIMIT);
        files.assert_nothing_left_on(lab.host(index));
        let summary = files.summary();
        assert_every_message_is_accounted_for(&summary);
        for name in ["icmp 10.99.0.1 → 10.99.0.2", "icmp 10.99.0.2 → 10.99.0.1"] {
            let flow = echoes(&summary, name);
            assert_eq!(
                (flow.frame_count, flow.taken_count),
                (50, 50),
                "{host}: {flow:?}"
            );
            assert_eq!(flow.byte_count, 50 * 1514, "{host}: {flow:?}");
            assert!(flow.delay.measured().is_some(), "{host}: {flow:?}");
        }
    }
}
