//! Two programs that speak IP on two hosts: the topology of the manual, over a real hop.

use std::thread;
use std::time::Duration;

use hil_account::flow::FlowMetrics;
use hil_report::summary::RunSummary;
use hil_tests::account::assert_every_message_is_accounted_for;
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::Trial;

const LIMIT: Duration = Duration::from_mins(1);
const HOSTS: [&str; 2] = ["control-pc", "robot-pc"];

/// `ping` from one program to the other with echoes of 1514 bytes on Ethernet, which go in pieces.
fn topology(addresses: [&str; 2], payload_bytes: u32) -> String {
    let [controller, robot] = addresses;
    format!(
        r#"
version = 1
name = "two-programs"
[hosts]
control-pc.address = "10.77.0.1"
robot-pc.address = "10.77.0.2"
[processes]
controller = {{ host = "control-pc", run = ["ping", "-c", "50", "-i", "0.02", "-s", "{payload_bytes}", "{robot}"], inside = "{controller}" }}
robot = {{ host = "robot-pc", run = ["sleep", "100"], inside = "{robot}" }}
[channels]
out = {{ from = "controller", to = "robot", link = "hop" }}
back = {{ from = "robot", to = "controller", link = "hop" }}
[links.hop]
via = "udp"
[security]
hops = "plain"
"#
    )
}

fn echoes<'a>(summary: &'a RunSummary, name: &str) -> &'a FlowMetrics {
    let mut flows = summary.flows.iter().flat_map(|one| &one.flows);
    flows.find(|one| one.name == name).unwrap()
}

/// Runs them and checks that each host's account has every echo and its answer.
fn check_echoes(lab: &Lab, label: &str, topology: &str, flows: [&str; 2]) {
    let record = RunFolder::new(label);
    let trial = Trial::of(&record.write("two-programs.toml", topology), record.path()).plain();
    let children = [0, 1].map(|index| trial.start_on(lab.host(index)));
    for mut child in children {
        child.wait_within(LIMIT).unwrap().assert_success();
    }
    for (index, host) in HOSTS.iter().enumerate() {
        let files = trial.folder(host, LIMIT);
        files.assert_nothing_left_on(lab.host(index));
        let summary = files.summary();
        assert_every_message_is_accounted_for(&summary);
        for name in flows {
            let flow = echoes(&summary, name);
            // Over IPv6 neighbours are looked for by ICMP as well.
            let other_count = flow.frame_count - 50;
            assert!(
                other_count == 0 || name.starts_with("icmpv6"),
                "{host}: {flow:?}"
            );
            assert_eq!(flow.taken_count, flow.frame_count, "{host}: {flow:?}");
            assert!(flow.byte_count >= 50 * 1514, "{host}: {flow:?}");
            assert!(flow.delay.measured().is_some(), "{host}: {flow:?}");
        }
    }
}

#[test]
fn programs_on_two_hosts_have_one_account_of_their_frames() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let flows = ["icmp 10.99.0.1 → 10.99.0.2", "icmp 10.99.0.2 → 10.99.0.1"];
    let addresses = ["10.99.0.1", "10.99.0.2"];
    check_echoes(&lab, "joined-hosts", &topology(addresses, 1472), flows);
}

#[test]
fn whole_frames_of_either_ip_pass_over_a_path_with_the_smallest_mtu() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    for host in [0, 1] {
        lab.host(host).set_mtu(1280);
    }
    let flows = ["icmp 10.99.0.1 → 10.99.0.2", "icmp 10.99.0.2 → 10.99.0.1"];
    let addresses = ["10.99.0.1", "10.99.0.2"];
    check_echoes(&lab, "joined-narrow", &topology(addresses, 1472), flows);
    let flows = ["icmpv6 fd99::1 → fd99::2", "icmpv6 fd99::2 → fd99::1"];
    let addresses = ["fd99::1", "fd99::2"];
    check_echoes(&lab, "joined-narrow-v6", &topology(addresses, 1452), flows);
}

#[test]
fn an_interface_of_a_host_that_is_down_is_a_loss_of_the_network_in_flows_as_well() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("joined-down");
    let text = topology(["10.99.0.1", "10.99.0.2"], 56).replace("\"50\"", "\"500\"");
    let trial = Trial::of(&record.write("two-programs.toml", &text), record.path())
        .plain()
        .set("run.duration=\"60 s\"");
    let mut children = [0, 1].map(|index| trial.start_on(lab.host(index)));
    // Progress is printed from the begin of the run on.
    children[0]
        .wait_for_output(" / 60 s", LIMIT)
        .unwrap_or_else(|reason| panic!("{reason}"));
    thread::sleep(Duration::from_secs(2));
    lab.host(0).set_link("eth0", "down");
    thread::sleep(Duration::from_secs(2));
    lab.host(0).set_link("eth0", "up");
    for child in &mut children {
        child.wait_within(LIMIT).unwrap().assert_success();
    }
    for (index, host) in HOSTS.iter().enumerate() {
        let files = trial.folder(host, LIMIT);
        files.assert_nothing_left_on(lab.host(index));
        let summary = files.summary();
        assert_every_message_is_accounted_for(&summary);
        let requests = echoes(&summary, "icmp 10.99.0.1 → 10.99.0.2");
        let replies = echoes(&summary, "icmp 10.99.0.2 → 10.99.0.1");
        println!("{host}: {requests:?}\n{replies:?}");
        assert_eq!(requests.frame_count, 500, "{host}");
        // 50 a second.
        assert!(requests.lost_by_network_count > 50, "{host}: {requests:?}");
        assert!(requests.taken_count > 250, "{host}: {requests:?}");
        for flow in [requests, replies] {
            assert_eq!(flow.lost_by_harness_count, 0, "{host}: {flow:?}");
        }
    }
}
