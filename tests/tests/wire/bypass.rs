//! A channel whose two ends share memory bypasses the network it is to measure. Whoever could be
//! deceived notices, and supervisors never share a domain.

use std::net::SocketAddr;
use std::time::Duration;

use hil_account::MessageFate;
use hil_core::message::MessageType;
use hil_rundir::launch::{DirectionLaunch, Side};
use hil_shm::{ChannelHolder, ChannelSettings, Domain};
use hil_shuttle::ShuttleCommand;
use hil_tests::account::{account, assert_every_message_is_accounted_for};
use hil_tests::ports::{own_addresses, own_ports};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{Trial, wait_until};
use hil_tests::worker::{self, Worker};

const CHANNEL: &str = "shuttle/command";
const LIMIT: Duration = Duration::from_mins(1);
const REASON: &str = "one shared-memory domain, so messages would bypass the network";

fn direction(side: Side, addresses: [SocketAddr; 2]) -> DirectionLaunch {
    let message = MessageType::of::<ShuttleCommand>();
    let channel = worker::channel(1, CHANNEL, &message, 1);
    worker::direction(side, addresses, vec![channel])
}

/// A domain with the channel in it, as a supervisor makes one.
fn domain(folder: &RunFolder, name: &str) -> (ChannelHolder, Domain) {
    let domain = Domain::create(&folder.join(name)).unwrap();
    let settings = ChannelSettings::of(CHANNEL, &MessageType::of::<ShuttleCommand>());
    let holder = ChannelHolder::create(&domain, &settings).unwrap();
    (holder, domain)
}

#[test]
fn a_gateway_process_refuses_a_peer_that_shares_its_memory_and_says_why() {
    let folder = RunFolder::new("bypass");
    let (_holder, domain) = domain(&folder, "one");
    let addresses = own_addresses();
    let mut ends = [("sending", Side::Egress), ("receiving", Side::Ingress)].map(|(name, side)| {
        let launch = worker::gateway(folder.path(), name, &domain, direction(side, addresses));
        Worker::start(&launch)
    });
    let [egress, ingress] = &mut ends;
    wait_until(LIMIT, "the refusal", || !egress.is_running());
    assert!(ingress.is_running(), "the refused one ends, not the other");
    let [egress, ingress] = ends;
    let (code, words) = egress.end(LIMIT);
    assert_eq!(code, Some(1), "{words}");
    assert!(words.contains(REASON), "{words}");
    let (code, words) = ingress.end(LIMIT);
    assert_eq!(code, Some(0), "{words}");
    assert!(words.contains("shared domain"), "{words}");
}

/// Two supervisors on one machine share `/dev/shm` whatever they do. Even with one folder for
/// their domains each makes its own, so everything between them goes through the gateways.
#[test]
fn two_supervisors_with_one_domain_folder_keep_their_memory_apart() {
    let record = RunFolder::new("one-root");
    let control_port = own_ports();
    let root = record.join("domains");
    let trial = Trial::shipped("shuttle-split.toml", record.path())
        .set("run.duration=\"2 s\"")
        .set("hosts.control-pc.address=\"127.0.0.1\"")
        .set("hosts.robot-pc.address=\"127.0.0.2\"")
        .set(&format!("hosts.control-pc.control_port={control_port}"))
        .on_own_ports(&["hop"]);
    let mut hosts = ["control-pc", "robot-pc"].map(|host| {
        let mut command = trial.command_here();
        command.arg("--host").arg(host);
        command.arg("--domain-root").arg(&root);
        hil_tests::child::ChildGuard::spawn(&mut command).unwrap()
    });
    for host in &mut hosts {
        host.wait_within(LIMIT).unwrap().assert_success();
    }
    let files = ["-control-pc", "-robot-pc"].map(|suffix| trial.folder(suffix, LIMIT));
    let [first, second] = [files[0].domains(), files[1].domains()];
    assert_eq!((first.len(), second.len()), (1, 1));
    assert_ne!(first[0].root_path(), second[0].root_path());
    assert_ne!(first[0].prefix(), second[0].prefix());
    for files in &files {
        let summary = files.summary();
        assert_every_message_is_accounted_for(&summary);
        for channel in &summary.channels {
            let account = account(&summary, &channel.name);
            let taken_count = account.fates.of(MessageFate::Taken);
            let received = account.coverage.rx_software.unwrap();
            assert!(
                taken_count > 0 && received.eligible_count >= taken_count,
                "{account:?}"
            );
        }
        files.assert_nothing_left_here();
    }
}
