//! A robot's and a controller's application with three ways between them: one shared memory, our
//! gateways, and both EGM adapters. The adapters and gateways are the product's own; here is only what a
//! supervisor would do around them, and the stop-watch.

use std::fs;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use bytemuck::{Zeroable, bytes_of};
use hil_arm::egm::messages::{EgmCommand, EgmFeedback, SessionState, Side as ArmSide};
use hil_arm::yumi::arm::{Arm, RIGHT_START_RAD};
use hil_core::endpoint::InputPort;
use hil_core::message::MessageType;
use hil_core::time::Instant;
use hil_engine::adapter::OpenedArm;
use hil_platform::clock::{MonotonicClock, Wake};
use hil_platform::domain_address::DomainAddress;
use hil_platform::realtime::RealtimeRequest;
use hil_platform::wait::WaitMode;
use hil_report::adapter_metrics::{AdapterMetrics, metrics};
use hil_rundir::launch::{AdapterSettings, ArmLaunch};
use hil_rundir::record::{RecordFile, Recorder};
use hil_shm::{
    ChannelHolder, ChannelSettings, Domain, OutputSettings, ShmInput, ShmOutput, Waiter,
};
use hil_topology::{AdapterKind, EgmAdapter, RoleChannel};

use crate::gateway::hosts::{Hosts, Joint, Plan, SetupError};
use crate::gateway::network::Network;
use crate::gateway::parties::claim;

const FEEDBACK: &str = "egm/right/feedback";
const COMMAND: &str = "egm/right/command";
const DEPTH: usize = 16;
/// A message that has not come by then is lost.
const PATIENCE: Duration = Duration::from_millis(500);
const WRITERS: [&str; 2] = ["robot-face", "sensor-face"];

/// Payloads of the two ways that know no types are as long as a feedback.
const fn plan(name: &'static str) -> Plan {
    Plan {
        name,
        size_bytes: size_of::<EgmFeedback>(),
        wait: WaitMode::Block,
        is_stamped: true,
        depth: DEPTH,
    }
}

/// One message there and one back.
#[derive(Debug, Clone, Copy)]
pub struct Exchange {
    /// From the robot's publication to the controller's taking.
    pub out_ns: u64,
    /// From the controller's publication to the robot's taking.
    pub back_ns: u64,
}

/// What is left when all is over.
#[derive(Debug)]
pub struct Finished {
    /// Of robot adapter and sensor adapter.
    pub figures: [AdapterMetrics; 2],
    /// Real-time settings the kernel refused the threads.
    pub refusals: Vec<String>,
    /// What could not be removed.
    pub left: Vec<String>,
}

/// When the controller took and published, per way.
#[derive(Debug, Default)]
struct FarTimes {
    taken_ns: [AtomicI64; 3],
    published_ns: [AtomicI64; 3],
}

/// The ports of one application on one way.
struct Way {
    output: ShmOutput,
    input: ShmInput,
    payload: Vec<u8>,
}

/// Everything between robot and controller, and the robot's application.
pub struct Pair {
    ways: [Way; 3],
    /// One for each way.
    waiters: [Waiter; 3],
    far: Arc<FarTimes>,
    due: Instant,
    cycle: u64,
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<Result<(), String>>>,
    refused: Receiver<Vec<String>>,
    recorders: Vec<Recorder>,
    folder: PathBuf,
    holders: Vec<ChannelHolder>,
    domains: [Domain; 2],
    hosts: Hosts,
}

impl core::fmt::Debug for Pair {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Pair")
            .field("hosts", &self.hosts)
            .finish_non_exhaustive()
    }
}

impl Pair {
    /// Builds the three ways and starts everything but the robot's application, which is the
    /// caller.
    ///
    /// # Errors
    /// When the kernel or iceoryx2 refuses something.
    pub fn start() -> Result<Self, SetupError> {
        let mut hosts = Hosts::create(Network::open())?;
        let joints = hosts.add(plan("gateways"))?;
        hosts.create_channels(&plan("direct"))?;
        let addresses = [0, 1].map(|host| hosts.address(host).clone());
        let domains = [Domain::open(&addresses[0])?, Domain::open(&addresses[1])?];
        let mut holders = Vec::new();
        for domain in &domains {
            for (name, message) in typed() {
                let settings = ChannelSettings {
                    depth_max: DEPTH,
                    ..ChannelSettings::of(name, &message)
                };
                holders.push(ChannelHolder::create(domain, &settings)?);
            }
        }
        let folder = std::env::temp_dir().join(format!("hil-face-{}", std::process::id()));
        fs::create_dir_all(&folder)?;
        let far = Arc::new(FarTimes::default());
        let stop = Arc::new(AtomicBool::new(false));
        let (ready, refused) = channel();
        let context = ThreadContext {
            stop: &stop,
            refused: &ready,
        };
        let mut threads = Vec::new();
        let mut recorders = Vec::new();
        let listens_at = hosts.network.free_address(1)?;
        for host in 0..2 {
            let settings = settings(host, listens_at);
            let mut recorder = Recorder::new(&folder, WRITERS[host], 0);
            let opened = hosts.network.on(host, || {
                OpenedArm::open(&settings, &settings.arms[0], &mut recorder)
            })?;
            recorder.start()?;
            recorders.push(recorder);
            threads.push(adapter(settings, opened, host, &addresses[host], context));
        }
        hosts.start_recording()?;
        for joint in joints {
            threads.extend(gateways(joint, context));
        }
        threads.push(controller(&addresses[1], &far, context));
        let ways = [
            Way::open(&domains[1], ["direct/out", "direct/back"], untyped())?,
            Way::open(&domains[0], ["gateways/out", "gateways/back"], untyped())?,
            Way::open(&domains[0], [FEEDBACK, COMMAND], typed().map(|one| one.1))?,
        ];
        let waiters = [
            Waiter::open(&domains[1], &["direct/back"])?,
            Waiter::open(&domains[0], &["gateways/back"])?,
            Waiter::open(&domains[0], &[COMMAND])?,
        ];
        Ok(Self {
            ways,
            waiters,
            far,
            due: MonotonicClock::now(),
            cycle: 0,
            stop,
            threads,
            refused,
            recorders,
            folder,
            holders,
            domains,
            hosts,
        })
    }

    /// What the datagrams cross.
    pub fn network_note(&self) -> &str {
        self.hosts.network.note()
    }

    /// Exchanges until every way has carried a message: gateways must greet each other first.
    ///
    /// # Errors
    /// When a way stays shut.
    pub fn warm_up(&mut self, pause: Duration) -> Result<(), SetupError> {
        for way in 0..3 {
            let mut left = 20;
            while let Err(error) = self.exchange(way, pause) {
                left -= 1;
                if left == 0 {
                    return Err(error);
                }
            }
        }
        Ok(())
    }

    /// One message there and one back by `way` (0 shared memory, 1 gateways, 2 adapters), `pause`
    /// after the last exchange was due.
    ///
    /// # Errors
    /// When a message is lost or a channel breaks.
    pub fn exchange(&mut self, way: usize, pause: Duration) -> Result<Exchange, SetupError> {
        self.due = (self.due + pause).max(MonotonicClock::now());
        while MonotonicClock::sleep_until(self.due) == Wake::Interrupted {}
        self.cycle += 1;
        let port = &mut self.ways[way];
        if way == 2 {
            port.payload
                .copy_from_slice(bytes_of(&feedback(self.cycle)));
        }
        let published = MonotonicClock::now();
        port.output.publish(published, &port.payload)?;
        let deadline = published + PATIENCE;
        let mut taken = None;
        while taken.is_none() {
            port.input.receive(Instant::ZERO, &mut |_, _| {
                taken = Some(MonotonicClock::now());
            })?;
            if taken.is_none() {
                self.waiters[way].wait_until(Some(deadline))?;
            }
            if MonotonicClock::now() > deadline {
                return Err(format!("way {way} lost a message").into());
            }
        }
        let far_taken = self.far.taken_ns[way].load(Ordering::Acquire);
        let far_published = self.far.published_ns[way].load(Ordering::Acquire);
        let back_ns = taken.map_or(0, Instant::as_ns) - far_published;
        Ok(Exchange {
            out_ns: u64::try_from(far_taken - published.as_ns())?,
            back_ns: u64::try_from(back_ns)?,
        })
    }

    /// Ends everything and reads what the adapters noted.
    ///
    /// # Errors
    /// When a thread failed or the records cannot be read.
    pub fn finish(self) -> Result<Finished, SetupError> {
        self.stop.store(true, Ordering::Release);
        for thread in self.threads {
            thread.join().map_err(|_panic| "a thread panicked")??;
        }
        for recorder in self.recorders {
            recorder.finish();
        }
        let refusals = self.refused.try_iter().flatten().collect();
        let kinds = [AdapterKind::Robot, AdapterKind::Sensor];
        let mut each = Vec::new();
        for (kind, writer) in kinds.into_iter().zip(WRITERS) {
            let (out, back) = match kind {
                AdapterKind::Robot => (FEEDBACK, COMMAND),
                AdapterKind::Sensor => (COMMAND, FEEDBACK),
            };
            let file = |channel: &str, what: &str| {
                let channel = channel.replace('/', ".");
                RecordFile::read(&self.folder.join(format!("{channel}.{what}.{writer}.0.rec")))
            };
            let sent: Vec<_> = file(out, "face-sent")?.records().collect();
            let received: Vec<_> = file(back, "face-received")?.records().collect();
            each.push(metrics(kind, &sent, &received));
        }
        drop((self.ways, self.waiters, self.holders, self.domains));
        let mut hosts = self.hosts;
        hosts.finish_recording();
        let mut left = hosts.remove();
        if let Err(error) = fs::remove_dir_all(&self.folder) {
            left.push(format!("{}: {error}", self.folder.display()));
        }
        let figures = <[AdapterMetrics; 2]>::try_from(each)
            .map_err(|_other_count| "two adapters were noted")?;
        Ok(Finished {
            figures,
            refusals,
            left,
        })
    }
}

impl Way {
    fn open(
        domain: &Domain,
        [outward, homeward]: [&str; 2],
        [out, back]: [MessageType; 2],
    ) -> Result<Self, SetupError> {
        let settings = OutputSettings::default();
        Ok(Self {
            output: ShmOutput::open(domain, outward, &out, settings)?,
            input: ShmInput::open(domain, homeward, &back, DEPTH)?,
            payload: vec![7; out.size_bytes],
        })
    }
}

/// Both channels of the adapters with what they carry, as the robot sees them: out, then back.
fn typed() -> [(&'static str, MessageType); 2] {
    [
        (FEEDBACK, MessageType::of::<EgmFeedback>()),
        (COMMAND, MessageType::of::<EgmCommand>()),
    ]
}

const fn untyped() -> [MessageType; 2] {
    [plan("direct").message(), plan("direct").message()]
}

fn feedback(cycle: u64) -> EgmFeedback {
    EgmFeedback {
        cycle_index: cycle,
        measured_rad: RIGHT_START_RAD,
        planned_rad: RIGHT_START_RAD,
        tool: Arm::right().tool(&RIGHT_START_RAD).into(),
        clock_ms: u32::try_from(cycle * 4 % (1 << 32)).unwrap_or(0),
        session: 1,
        state: SessionState::Running as u32,
        ..Zeroable::zeroed()
    }
}

fn settings(host: usize, listens_at: std::net::SocketAddr) -> AdapterSettings {
    let channel = |(name, message): (&str, MessageType)| RoleChannel {
        name: name.to_owned(),
        message_name: message.name.to_owned(),
        message_size_bytes: message.size_bytes,
        message_alignment_bytes: message.alignment_bytes,
        depth: DEPTH,
        is_recorded_only: false,
    };
    let [feedback, command] = typed().map(channel);
    let (kind, input, output) = if host == 0 {
        (AdapterKind::Robot, feedback, command)
    } else {
        (AdapterKind::Sensor, command, feedback)
    };
    AdapterSettings {
        role: "bench".to_owned(),
        egm: EgmAdapter {
            kind,
            ..EgmAdapter::TEMPLATE
        },
        cycle_ns: 4_000_000,
        planned_lead_ns: 16_000_000,
        wait: WaitMode::Block,
        interface: None,
        arms: vec![ArmLaunch {
            arm: ArmSide::Right,
            address: listens_at,
            input,
            output,
            realtime: RealtimeRequest::default(),
        }],
        spare: Vec::new(),
    }
}

/// What every thread is told.
#[derive(Clone, Copy)]
struct ThreadContext<'a> {
    /// Set when the threads are to stop.
    stop: &'a Arc<AtomicBool>,
    /// Takes what the kernel refused a thread.
    refused: &'a Sender<Vec<String>>,
}

/// A thread of its own on the CPU of its host.
fn party(
    cpu: usize,
    context: ThreadContext<'_>,
    work: impl FnOnce(&AtomicBool) -> Result<(), SetupError> + Send + 'static,
) -> JoinHandle<Result<(), String>> {
    let (stop, refused) = (Arc::clone(context.stop), context.refused.clone());
    thread::spawn(move || {
        // Nobody listens any more once the bench is over.
        let _over = refused.send(claim(cpu)).is_err();
        work(&stop).map_err(|error| error.to_string())
    })
}

fn adapter(
    settings: AdapterSettings,
    opened: OpenedArm,
    cpu: usize,
    address: &DomainAddress,
    context: ThreadContext<'_>,
) -> JoinHandle<Result<(), String>> {
    let address = address.clone();
    party(cpu, context, move |stop| {
        let domain = Domain::open(&address)?;
        let mut joined = opened.connect(&settings, &settings.arms[0], &domain)?;
        while !stop.load(Ordering::Acquire) {
            if !joined.step()? {
                joined.rest()?;
            }
        }
        Ok(joined.finish()?)
    })
}

fn gateways(joint: Joint, context: ThreadContext<'_>) -> [JoinHandle<Result<(), String>>; 2] {
    let cpu = joint.host;
    joint.split().map(|loose| {
        party(cpu, context, move |stop| {
            let (_launch, mut direction) = loose.connect()?;
            while !stop.load(Ordering::Acquire) {
                if !direction.step()? {
                    direction.rest()?;
                }
            }
            Ok(())
        })
    })
}

/// The controller's application: answers each message by the way it came.
fn controller(
    address: &DomainAddress,
    times: &Arc<FarTimes>,
    context: ThreadContext<'_>,
) -> JoinHandle<Result<(), String>> {
    let (address, times) = (address.clone(), Arc::clone(times));
    party(1, context, move |stop| {
        let domain = Domain::open(&address)?;
        let [feedback, command] = typed().map(|one| one.1);
        let mut ways = [
            Way::open(&domain, ["direct/back", "direct/out"], untyped())?,
            Way::open(&domain, ["gateways/back", "gateways/out"], untyped())?,
            Way::open(&domain, [COMMAND, FEEDBACK], [command, feedback])?,
        ];
        let answer = EgmCommand {
            position_rad: RIGHT_START_RAD,
            ..Zeroable::zeroed()
        };
        ways[2].payload.copy_from_slice(bytes_of(&answer));
        let mut waiter = Waiter::open(&domain, &["direct/out", "gateways/out", FEEDBACK])?;
        while !stop.load(Ordering::Acquire) {
            for (index, way) in ways.iter_mut().enumerate() {
                let mut taken = None;
                way.input.receive(Instant::ZERO, &mut |_, _| {
                    taken = Some(MonotonicClock::now());
                })?;
                let Some(taken) = taken else { continue };
                times.taken_ns[index].store(taken.as_ns(), Ordering::Release);
                let published = MonotonicClock::now();
                times.published_ns[index].store(published.as_ns(), Ordering::Release);
                way.output.publish(published, &way.payload)?;
            }
            waiter.wait(Duration::from_millis(20))?;
        }
        Ok(())
    })
}
