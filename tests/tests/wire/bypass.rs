//! A channel whose two ends share memory bypasses the network it is to measure. Whoever could be
//! deceived notices: the bridges, the gateway processes; and supervisors never share a domain.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddr, TcpListener, UdpSocket};
use std::time::Duration;

use hil_account::MessageFate;
use hil_core::message::{Envelope, MessageType};
use hil_core::time::Instant;
use hil_platform::realtime::RealtimeRequest;
use hil_platform::wait::WaitMode;
use hil_protocol::body::HelloStatus;
use hil_protocol::{
    ArrivalStamps, ChannelIdentity, EgressBridge, EgressEvent, EgressSettings, FlowIdentity,
    InMemory, IngressBridge, IngressSettings, LocalRefusal, PeerState, Refusal,
};
use hil_rundir::launch::{
    ChannelLaunch, DirectionLaunch, GatewayWork, Side, SocketLaunch, Work, WorkerLaunch, write,
};
use hil_shm::{ChannelHolder, ChannelSettings, Domain};
use hil_shuttle::ShuttleCommand;
use hil_tests::account::{account, assert_every_message_is_accounted_for};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{Trial, wait_until};
use hil_tests::worker::Worker;
use hil_topology::{SocketOptions, Timestamps};

const CHANNEL: &str = "shuttle/command";
const FLOW: &str = "hil/link/hop/forward";
const LIMIT: Duration = Duration::from_mins(1);
const REASON: &str = "one shared-memory domain, so messages would bypass the network";

/// Lets an egress with `domain` greet an ingress with domain 2; gives the answer.
fn greet(domain: u8) -> (EgressBridge, IngressBridge, EgressEvent) {
    let channel = ChannelIdentity::new(1, CHANNEL, "hil.ShuttleCommand.v1", 16, 8);
    let flow = FlowIdentity {
        flow: 65_535,
        name: FLOW.to_owned(),
        channels: vec![channel],
    };
    let ingress = IngressSettings::new(flow.clone(), 7, [2; 16], 22);
    let egress = EgressSettings {
        flow,
        session: 5,
        domain: [domain; 16],
        clock_id: 11,
        datagram_max_bytes: 1472,
        sync_period: Duration::from_millis(100),
    };
    let mut ingress = IngressBridge::new(ingress).unwrap();
    let mut egress = EgressBridge::new(egress).unwrap();
    let now = Instant::from_ns(1_000);
    let arrival = ArrivalStamps::application(1_000);
    let hello = egress.poll_transmit(now).unwrap().datagram.to_vec();
    let _refused = ingress.on_datagram(
        now,
        arrival,
        &hello,
        &mut InMemory::default().with(|_, _| {}),
    );
    let answer = ingress.poll_transmit(now).unwrap().datagram.to_vec();
    let event = egress.on_datagram(now, arrival, &answer).unwrap();
    (egress, ingress, event)
}

#[test]
fn two_bridges_of_one_domain_refuse_each_other() {
    let (mut egress, ingress, event) = greet(2);
    assert_eq!(event, EgressEvent::Refused(HelloStatus::SharedDomain));
    let refused = PeerState::Refused(HelloStatus::SharedDomain);
    assert_eq!(egress.peer_state(), refused);
    assert_eq!(ingress.refusals().get(Refusal::SharedDomain), 1);
    assert_eq!(ingress.session(), None);
    let envelope = Envelope::default();
    let staged = egress.on_local(Instant::from_ns(2_000), 0, &envelope, &[0; 16]);
    assert_eq!(staged, Err(LocalRefusal::ChannelRefused));
    assert!(HelloStatus::SharedDomain.label().contains(REASON));

    let (egress, _, event) = greet(1);
    assert!(matches!(event, EgressEvent::Accepted { .. }), "{event:?}");
    assert_eq!(egress.peer_state(), PeerState::Established);
}

/// Two free ports of the loopback interface.
fn free_ports() -> [SocketAddr; 2] {
    let sockets = [(); 2].map(|()| UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap());
    sockets.map(|socket| socket.local_addr().unwrap())
}

fn direction(side: Side, [local, peer]: [SocketAddr; 2]) -> DirectionLaunch {
    let message = MessageType::of::<ShuttleCommand>();
    DirectionLaunch {
        flow: FLOW.to_owned(),
        flow_number: 65_535,
        side,
        local,
        peer,
        socket: SocketLaunch {
            transport: "udp".to_owned(),
            options: BTreeMap::new(),
            interface: None,
            common: SocketOptions {
                send_buffer_bytes: 1 << 16,
                receive_buffer_bytes: 1 << 16,
                timestamps: Timestamps::Off,
                ..SocketOptions::TEMPLATE
            },
        },
        wait: WaitMode::Block,
        realtime: RealtimeRequest::default(),
        channels: vec![ChannelLaunch {
            channel: CHANNEL.to_owned(),
            channel_id: 1,
            message: message.name.to_owned(),
            size_bytes: message.size_bytes,
            alignment_bytes: message.alignment_bytes,
            depth: 1,
            emulation: None,
        }],
    }
}

/// A domain with the channel in it, as a supervisor makes one.
fn domain(folder: &RunFolder, name: &str) -> (ChannelHolder, Domain) {
    let domain = Domain::create(&folder.join(name)).unwrap();
    let settings = ChannelSettings::of(CHANNEL, &MessageType::of::<ShuttleCommand>());
    let holder = ChannelHolder::create(&domain, &settings).unwrap();
    (holder, domain)
}

fn launch(folder: &RunFolder, name: &str, domain: &Domain, direction: DirectionLaunch) -> Worker {
    let records = folder.join(format!("records-{name}"));
    std::fs::create_dir(&records).unwrap();
    let launch = WorkerLaunch {
        process: name.to_owned(),
        instance: 0,
        domain: domain.address().to_string(),
        records,
        is_sealed: false,
        work: Work::Gateway(GatewayWork {
            directions: vec![direction],
            ready_within: None,
        }),
    };
    let path = folder.join(format!("{name}.json"));
    write(&path, &launch).unwrap();
    Worker::start(&path)
}

#[test]
fn a_gateway_process_refuses_a_peer_that_shares_its_memory_and_says_why() {
    let folder = RunFolder::new("bypass");
    let (_holder, domain) = domain(&folder, "one");
    let [sender, receiver] = free_ports();
    let mut egress = launch(
        &folder,
        "sending",
        &domain,
        direction(Side::Egress, [sender, receiver]),
    );
    let mut ingress = launch(
        &folder,
        "receiving",
        &domain,
        direction(Side::Ingress, [receiver, sender]),
    );
    wait_until(LIMIT, "the refusal", || !egress.is_running());
    assert!(ingress.is_running(), "the refused one ends, not the other");
    let (code, words) = egress.end(LIMIT);
    assert_eq!(code, Some(1), "{words}");
    assert!(words.contains(REASON), "{words}");
    let (code, words) = ingress.end(LIMIT);
    assert_eq!(code, Some(0), "{words}");
    assert!(words.contains("shared domain"), "{words}");
}

#[test]
fn gateway_processes_with_memory_of_their_own_accept_each_other() {
    let folder = RunFolder::new("no-bypass");
    let (_first_holder, first) = domain(&folder, "one");
    let (_second_holder, second) = domain(&folder, "two");
    let [sender, receiver] = free_ports();
    let mut ingress = launch(
        &folder,
        "receiving",
        &second,
        direction(Side::Ingress, [receiver, sender]),
    );
    let mut egress = launch(
        &folder,
        "sending",
        &first,
        direction(Side::Egress, [sender, receiver]),
    );
    // Greeted means that clock exchanges go on; their records show it from outside.
    let exchanges = folder.join("records-sending");
    wait_until(LIMIT, "a clock exchange", || {
        assert!(egress.is_running() && ingress.is_running());
        let files = std::fs::read_dir(&exchanges).unwrap().flatten();
        let exchange_file = files
            .filter(|file| file.file_name().to_string_lossy().contains("round-trip"))
            .find_map(|file| file.metadata().ok());
        exchange_file.is_some_and(|data| data.len() > 256)
    });
    for gateway in [egress, ingress] {
        let (code, words) = gateway.end(LIMIT);
        assert_eq!(code, Some(0), "{words}");
    }
}

/// Two supervisors on one machine share `/dev/shm` whatever they do. Even with one folder for
/// their domains each makes its own, so everything between them goes through the gateways.
#[test]
fn two_supervisors_with_one_domain_folder_keep_their_memory_apart() {
    let record = RunFolder::new("one-root");
    let control = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let control_port = control.local_addr().unwrap().port();
    drop(control);
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
