//! The real binary on two hosts over each transport of the registry: sealed, with a gateway that is killed in the
//! middle. What one transport promises beyond the others is tested elsewhere.

use std::time::Duration;

use hil_account::MessageFate;
use hil_protocol::transport::IpProtocol;
use hil_report::summary::{LinkKind, RunSummary};
use hil_tests::account::{account, channel};
use hil_tests::binary::hil_runtime_binary;
use hil_tests::child::ChildGuard;
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::CHANNELS;
use hil_tests::split::{HOSTS, Split, count, direction};
use hil_tests::trial::Trial;
use hil_transport::registry;
use serde_json::Value;

const LIMIT: Duration = Duration::from_mins(1);
const KILLED: &str = "gateway-hop-robot-pc";

/// Nothing that the doctor finds about the link of `trial` is an error.
fn assert_doctor_is_content(lab: &Lab, trial: &Trial) {
    for (index, host) in HOSTS.iter().enumerate() {
        let mut command = lab.host(index).command(hil_runtime_binary());
        command.args(["doctor", "--json", "--host", host]);
        let mut doctor = ChildGuard::spawn(command.args(trial.arguments())).unwrap();
        let finished = doctor.wait_within(LIMIT).unwrap();
        finished.assert_success();
        let report: Value = serde_json::from_str(&finished.stdout).unwrap();
        for finding in report["findings"].as_array().unwrap() {
            let is_of_link = ["mtu", "ports", "peer"].contains(&finding["id"].as_str().unwrap());
            let is_error = finding["severity"] == "error";
            assert!(!(is_of_link && is_error), "{host}: {finding}");
        }
    }
}

/// What was under way when a connection ended is lost to the gateway and not to the wire.
fn assert_is_connected_again(summary: &RunSummary) {
    let commands = account(summary, CHANNELS[0]);
    let fates = &commands.fates;
    assert!(fates.lost_count() > 0, "{fates:?}");
    assert_eq!(fates.of(MessageFate::LostOnWire), 0, "{fates:?}");
    let mut interruptions = commands.interruptions.iter();
    let own = interruptions.find(|one| one.process == KILLED).unwrap();
    assert!(own.cause.contains("SIGKILL"), "{own:?}");
    let egress = direction(summary, CHANNELS[0], "egress");
    assert_eq!(count(egress, "transport: reconnect_count"), 1);
    let mut events = summary.events.iter();
    let is_told = events.any(|event| event.what().contains("and is back (reconnect 1)"));
    assert!(is_told, "{:?}", summary.events);
}

#[test]
fn every_transport_carries_a_sealed_run_with_a_kill() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    for transport in registry::ALL {
        let transport = transport.description();
        let record = RunFolder::new(&format!("transport-{}", transport.name));
        let trial = Trial::shipped("shuttle-split.toml", record.path())
            .set(&format!("links.hop.via=\"{}\"", transport.name))
            .set("run.duration=\"8 s\"");
        assert_doctor_is_content(&lab, &trial);
        let split = Split::start(&lab, &trial);
        split.wait_for_messages("the begin of the run");
        split.kill(1, KILLED);
        let files = split.files[1].clone();
        for summary in &split.finish() {
            for name in CHANNELS {
                let link = channel(summary, name).link;
                assert_eq!(link, LinkKind::Network(transport));
                let ingress = direction(summary, name, "ingress");
                assert!(count(ingress, "seal: opened_count") > 100, "{ingress:?}");
            }
            if transport.capabilities.receiver_port == Some(IpProtocol::Tcp) {
                assert_is_connected_again(summary);
            }
        }
        let report = files.read("report-full.txt");
        let words = format!("controller → robot · {}", transport.label);
        assert!(report.contains(&words), "{words}: {report}");
    }
}
