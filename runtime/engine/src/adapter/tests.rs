//! One arm of each adapter against a plain socket that plays the foreign program: what goes out, what
//! comes in, and what is a state instead of an error.

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::path::PathBuf;
use std::time::Duration;
use std::{env, fs, process, thread};

use bytemuck::{Zeroable, bytes_of};
use hil_arm::egm::adapter::{
    Axes, RobotAdapter, RobotAdapterSettings, RobotWare, SendPolicy, SensorAdapter,
    SensorAdapterSettings,
};
use hil_arm::egm::messages::{EgmCommand, EgmFeedback, SessionState, Side};
use hil_arm::egm::wire::Cause;
use hil_arm::yumi::arm::{Arm as Chain, RIGHT_START_RAD};
use hil_core::endpoint::InputPort;
use hil_core::message::MessageType;
use hil_core::time::Instant;

use super::{JoinedArm, OpenedArm};
use hil_platform::clock::MonotonicClock;
use hil_platform::realtime::RealtimeRequest;
use hil_platform::wait::WaitMode;
use hil_rundir::launch::{AdapterSettings, ArmLaunch};
use hil_rundir::pipe::AdapterRefusal;
use hil_rundir::record::Recorder;
use hil_shm::{ChannelHolder, ChannelSettings, Domain, OutputSettings, ShmInput, ShmOutput};
use hil_topology::{AdapterKind, EgmAdapter, RoleChannel};

const FEEDBACK: &str = "egm/right/feedback";
const COMMAND: &str = "egm/right/command";
const DEPTH: usize = 16;

/// An adapter with one arm, the ports of our own role, and the foreign program's socket.
struct Bench {
    joined: JoinedArm,
    output: ShmOutput,
    input: ShmInput,
    foreign: UdpSocket,
    recorder: Recorder,
    _holders: Vec<ChannelHolder>,
    _domains: [Domain; 2],
    folder: PathBuf,
}

impl Bench {
    fn new(kind: AdapterKind, name: &str) -> Self {
        let folder = env::temp_dir().join(format!("hil-face-{name}-{}", process::id()));
        fs::create_dir_all(&folder).unwrap();
        let owner = Domain::create(&folder.join("domain")).unwrap();
        let feedback = MessageType::of::<EgmFeedback>();
        let command = MessageType::of::<EgmCommand>();
        let hold = |name, message| {
            let settings = ChannelSettings {
                depth_max: DEPTH,
                ..ChannelSettings::of(name, message)
            };
            ChannelHolder::create(&owner, &settings).unwrap()
        };
        let holders = vec![hold(FEEDBACK, &feedback), hold(COMMAND, &command)];
        let foreign = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        foreign
            .set_read_timeout(Some(Duration::from_secs(10)))
            .unwrap();
        let address = match kind {
            AdapterKind::Robot => foreign.local_addr().unwrap(),
            AdapterKind::Sensor => {
                let free = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
                free.local_addr().unwrap()
            }
        };
        let adapter = settings(kind, address);
        let mut recorder = Recorder::new(&folder, "face", 0);
        let opened = OpenedArm::open(&adapter, &adapter.arms[0], &mut recorder).unwrap();
        let member = Domain::open(owner.address()).unwrap();
        let joined = opened.connect(&adapter, &adapter.arms[0], &member).unwrap();
        let (out, back) = match kind {
            AdapterKind::Robot => ((FEEDBACK, feedback), (COMMAND, command)),
            AdapterKind::Sensor => ((COMMAND, command), (FEEDBACK, feedback)),
        };
        Self {
            output: ShmOutput::open(&owner, out.0, &out.1, OutputSettings::default()).unwrap(),
            input: ShmInput::open(&owner, back.0, &back.1, DEPTH).unwrap(),
            joined,
            foreign,
            recorder,
            _holders: holders,
            _domains: [member, owner],
            folder,
        }
    }

    /// Where a sensor adapter listens.
    fn listens_at(&self) -> SocketAddr {
        let facts = self.joined.report().facts;
        let listens = facts
            .iter()
            .find_map(|(_, text)| text.strip_prefix("listens at "));
        listens.unwrap().parse().unwrap()
    }

    fn publish(&mut self, message: &[u8]) {
        self.output.publish(MonotonicClock::now(), message).unwrap();
    }

    /// Lets the adapter work until `look` finds something.
    fn until<T>(&mut self, mut look: impl FnMut(&mut Self) -> Option<T>) -> T {
        for _ in 0..20_000 {
            while self.joined.turn().unwrap() {}
            if let Some(found) = look(self) {
                return found;
            }
            thread::sleep(Duration::from_micros(500));
        }
        panic!("nothing came: {:?}", self.joined.report());
    }

    /// The next message our own role gets.
    fn next<M: bytemuck::AnyBitPattern>(&mut self) -> M {
        self.until(|bench| {
            let mut message = None;
            let mut take = |_: &_, payload: &[u8]| {
                message = Some(bytemuck::pod_read_unaligned(payload));
            };
            bench.input.receive(Instant::ZERO, &mut take).unwrap();
            message
        })
    }

    fn count(&self, name: &str) -> u64 {
        let counters = self.joined.report().counters;
        let found = counters.iter().find(|counter| counter.label() == name);
        found.map_or(0, |counter| counter.count)
    }

    fn refused(&self, cause: AdapterRefusal) -> u64 {
        let refusals = self.joined.report().refusals;
        let found = refusals.iter().find(|refusal| refusal.cause == cause);
        found.map_or(0, |refusal| refusal.count)
    }

    fn finish(self) {
        let Self {
            recorder, folder, ..
        } = self;
        assert_eq!(recorder.finish().dropped_count, 0);
        fs::remove_dir_all(folder).unwrap();
    }
}

fn settings(kind: AdapterKind, address: SocketAddr) -> AdapterSettings {
    let channel = |name: &str, message: MessageType| RoleChannel {
        name: name.to_owned(),
        message_name: message.name.to_owned(),
        message_size_bytes: message.size_bytes,
        message_alignment_bytes: message.alignment_bytes,
        depth: DEPTH,
        is_recorded_only: false,
    };
    let feedback = channel(FEEDBACK, MessageType::of::<EgmFeedback>());
    let command = channel(COMMAND, MessageType::of::<EgmCommand>());
    let (input, output) = match kind {
        AdapterKind::Robot => (feedback, command),
        AdapterKind::Sensor => (command, feedback),
    };
    AdapterSettings {
        role: "test".to_owned(),
        egm: EgmAdapter {
            kind,
            ..EgmAdapter::TEMPLATE
        },
        cycle_ns: 4_000_000,
        planned_lead_ns: 16_000_000,
        wait: WaitMode::Spin,
        interface: None,
        arms: vec![ArmLaunch {
            arm: Side::Right,
            address,
            input,
            output,
            realtime: RealtimeRequest::default(),
        }],
        spare: Vec::new(),
    }
}

fn feedback(cycle: u64) -> EgmFeedback {
    EgmFeedback {
        cycle_index: cycle,
        measured_rad: RIGHT_START_RAD,
        planned_rad: RIGHT_START_RAD,
        tool: Chain::right().tool(&RIGHT_START_RAD).into(),
        clock_ms: u32::try_from(4 * cycle).unwrap(),
        session: 1,
        state: SessionState::Running as u32,
        ..Zeroable::zeroed()
    }
}

fn command(offset_rad: f64) -> EgmCommand {
    EgmCommand {
        position_rad: RIGHT_START_RAD.map(|q| q + offset_rad),
        ..Zeroable::zeroed()
    }
}

fn foreign_robot() -> RobotAdapter {
    RobotAdapter::new(RobotAdapterSettings {
        side: Side::Right,
        axes: Axes::Seven,
        robotware: RobotWare::Six,
        cycle: Duration::from_millis(4),
        planned_lead: Duration::from_millis(16),
    })
}

#[test]
fn each_feedback_goes_out_at_once_and_only_proper_answers_come_in() {
    let mut bench = Bench::new(AdapterKind::Robot, "out");
    let mut sensor = SensorAdapter::new(SensorAdapterSettings {
        axes: Axes::Seven,
        held_rad: 0.0,
        policy: SendPolicy::Coupled {
            patience: Duration::ZERO,
        },
    });
    let (mut buffer, mut answer) = ([0; 2048], Vec::new());
    for cycle in 0..3 {
        bench.publish(bytes_of(&feedback(cycle)));
        while bench.joined.turn().unwrap() {}
        let (length, adapter) = bench.foreign.recv_from(&mut buffer).unwrap();
        let now = MonotonicClock::now();
        let seen = sensor.decode(now, &buffer[..length]).unwrap();
        assert_eq!(u64::from(seen.seqno), cycle);
        bench.foreign.send_to(b"no protobuf", adapter).unwrap();
        sensor.command(&command(0.01)).unwrap();
        assert!(sensor.poll_transmit(now, &mut answer));
        bench.foreign.send_to(&answer, adapter).unwrap();
        let taken: EgmCommand = bench.next();
        let wanted = command(0.01).position_rad;
        let pairs = taken.position_rad.iter().zip(&wanted);
        assert!(pairs.into_iter().all(|(a, b)| (a - b).abs() < 1e-12));
    }
    // A stranger is not heard: the socket is connected.
    assert_eq!(bench.count("commands published"), 3);
    assert_eq!(bench.count("datagrams received"), 6);
    assert_eq!(
        bench.refused(AdapterRefusal::Protocol(Cause::NotProtobuf)),
        3
    );
    assert_eq!(bench.count("socket: sent_count"), 3);
    bench.until(|bench| (bench.count("socket: stamp_count") == 3).then_some(()));
    bench.finish();
}

#[test]
fn a_client_that_is_not_there_is_a_state_and_may_come_later() {
    let mut bench = Bench::new(AdapterKind::Robot, "later");
    let address = bench.foreign.local_addr().unwrap();
    bench.foreign = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let mut cycle = 0;
    bench.until(|bench| {
        cycle += 1;
        bench.publish(bytes_of(&feedback(cycle)));
        // Counted, and none of them costs a datagram.
        (bench.count("socket: ignored_report_count") > 2).then_some(())
    });
    assert_eq!(bench.joined.report().peer_state, "never answered");
    bench.foreign = UdpSocket::bind(address).unwrap();
    bench.foreign.set_nonblocking(true).unwrap();
    bench.until(|bench| {
        cycle += 1;
        bench.publish(bytes_of(&feedback(cycle)));
        bench.foreign.recv(&mut [0; 2048]).ok()
    });
    bench.finish();
}

#[test]
fn a_sensor_answers_where_the_robot_speaks_from_and_to_one_robot_at_a_time() {
    let mut bench = Bench::new(AdapterKind::Sensor, "answers");
    let (mut robot, mut datagram, mut buffer) = (foreign_robot(), Vec::new(), [0; 2048]);
    let adapter = bench.listens_at();
    assert!(robot.encode(&feedback(1), Duration::from_secs(1), &mut datagram));
    bench.foreign.send_to(&datagram, adapter).unwrap();
    let seen: EgmFeedback = bench.next();
    assert_eq!(seen.session_state(), Some(SessionState::Running));
    bench.publish(bytes_of(&command(0.02)));
    let sent = |bench: &mut Bench| (bench.count("socket: sent_count") > 0).then_some(());
    bench.until(sent);
    let (length, from) = bench.foreign.recv_from(&mut buffer).unwrap();
    assert_eq!(from, adapter);
    let taken = robot.decode(&buffer[..length]).unwrap();
    assert!((taken.position_rad[6] - RIGHT_START_RAD[6] - 0.02).abs() < 1e-12);

    // Another robot is refused while the first one speaks, and served once it is silent.
    let other = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    robot.encode(&feedback(2), Duration::from_secs(1), &mut datagram);
    bench.foreign.send_to(&datagram, adapter).unwrap();
    let _seen: EgmFeedback = bench.next();
    robot.encode(&feedback(3), Duration::from_secs(1), &mut datagram);
    other.send_to(&datagram, adapter).unwrap();
    bench.until(|bench| {
        let refused = bench.refused(AdapterRefusal::ForeignAddress);
        let changed = bench.count("changes of the robot's address");
        (refused + changed == 1).then_some(())
    });
    thread::sleep(Duration::from_millis(1_100));
    robot.encode(&feedback(50), Duration::from_secs(1), &mut datagram);
    other.send_to(&datagram, adapter).unwrap();
    bench.until(|bench| (bench.count("changes of the robot's address") == 1).then_some(()));
    // The first one has its place back as soon as it speaks, and the answers with it.
    robot.encode(&feedback(51), Duration::from_secs(1), &mut datagram);
    bench.foreign.send_to(&datagram, adapter).unwrap();
    bench.until(|bench| (bench.count("changes of the robot's address") == 2).then_some(()));
    other.send_to(&datagram, adapter).unwrap();
    let refused = bench.refused(AdapterRefusal::ForeignAddress);
    bench.until(|bench| {
        (bench.refused(AdapterRefusal::ForeignAddress) == refused + 1).then_some(())
    });
    bench.finish();
}

#[test]
fn a_sensor_falls_silent_soon_after_its_controller() {
    let mut bench = Bench::new(AdapterKind::Sensor, "silent");
    let (mut robot, mut datagram) = (foreign_robot(), Vec::new());
    let adapter = bench.listens_at();
    let mut cycle = 0;
    let mut speak = |bench: &mut Bench| {
        cycle += 1;
        robot.encode(&feedback(cycle), Duration::from_secs(1), &mut datagram);
        bench.foreign.send_to(&datagram, adapter).unwrap();
        let _seen: EgmFeedback = bench.next();
    };
    speak(&mut bench);
    bench.publish(bytes_of(&command(0.0)));
    bench.until(|bench| (bench.count("socket: sent_count") == 1).then_some(()));
    thread::sleep(Duration::from_millis(60));
    for _ in 0..5 {
        speak(&mut bench);
        thread::sleep(Duration::from_millis(4));
        while bench.joined.turn().unwrap() {}
    }
    assert_eq!(bench.count("socket: sent_count"), 1);
    assert_eq!(bench.count("answers withheld, no command for 50 ms"), 5);
    // The next command goes out as if nothing had been.
    bench.publish(bytes_of(&command(0.01)));
    bench.until(|bench| (bench.count("socket: sent_count") >= 2).then_some(()));
    bench.finish();
}
