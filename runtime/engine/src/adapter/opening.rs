//! Opens what one arm of an adapter needs: socket and record files in a thread of normal priority, the
//! shared-memory ports in the thread that uses them. It moves nothing.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use hil_arm::egm::messages::{EgmCommand, EgmFeedback};
use hil_core::message::{Envelope, MessageType};
use hil_core::record::{PublishedRecord, TakenRecord};
use hil_net::timestamping::TimestampMode;
use hil_transport::DatagramSender;
use hil_transport::socket::{GrantedOptions, SocketSettings};
use hil_transport::udp::UdpSender;

use super::arm::{Arm, Attention, DATAGRAM_BYTES_MAX, Work};
use super::line::Line;
use super::robot::RobotWork;
use super::sensor::SensorWork;
use crate::gateway::socket::timestamp_mode;
use crate::process::recording::{Destination, RecordedInput, RecordedOutput, output_settings};
use crate::process::worker::WorkerError;
use hil_platform::wait::{WaitMode, WaitStrategy};
use hil_rundir::adapter_record::{AdapterReceivedRecord, AdapterSentRecord};
use hil_rundir::launch::{AdapterSettings, ArmLaunch};
use hil_rundir::pipe::{AdapterReport, CountByName, CounterGroup};
use hil_rundir::record::{RecordKind, RecordSink, Recorder};
use hil_shm::{Domain, ShmInput, ShmOutput, Waiter};
use hil_topology::AdapterKind;

/// Records a ring holds.
const RING_RECORDS: usize = 16_384;

/// An arm whose socket and files are open and whose ports are not.
#[derive(Debug)]
pub struct OpenedArm {
    line: Line,
    taken: RecordSink,
    published: RecordSink,
    messages: RecordSink,
    /// Messages taken from and published to shared memory so far.
    pub(super) counts: [Arc<AtomicU64>; 2],
    /// What was granted, in words.
    pub(super) facts: Vec<(String, String)>,
}

impl OpenedArm {
    /// Opens the socket and the record files of `arm`; call it from a thread of normal priority,
    /// as kernel stamps are switched on by a worker.
    ///
    /// # Errors
    /// When the kernel refuses a socket option or a file cannot be made.
    pub fn open(
        adapter: &AdapterSettings,
        arm: &ArmLaunch,
        recorder: &mut Recorder,
    ) -> Result<Self, WorkerError> {
        let settings = socket_settings(adapter, arm);
        let (socket, what) = match adapter.egm.kind {
            AdapterKind::Robot => {
                let socket = UdpSender::open_ignoring_reports(&settings)?;
                let from = socket.local_address().map_err(WorkerError::Address)?;
                let what = format!("from port {} to {}", from.port(), settings.peer);
                (socket, what)
            }
            AdapterKind::Sensor => {
                let what = format!("listens at {}", settings.local);
                (UdpSender::open_answering(&settings)?, what)
            }
        };
        let granted = socket.granted();
        let mut sink = |kind, channel: &str, size| recorder.sink(kind, channel, size, RING_RECORDS);
        let (input, output) = (arm.input.name.as_str(), arm.output.name.as_str());
        let sent = sink(
            RecordKind::AdapterSent,
            input,
            size_of::<AdapterSentRecord>(),
        )?;
        let size = size_of::<AdapterReceivedRecord>();
        let received = sink(RecordKind::AdapterReceived, output, size)?;
        let message_size = size_of::<Envelope>() + arm.output.message_size_bytes;
        let has_stamps = settings.timestamps != TimestampMode::Off;
        Ok(Self {
            line: Line::new(socket, sent, received, has_stamps)?,
            taken: sink(RecordKind::Taken, input, size_of::<TakenRecord>())?,
            published: sink(RecordKind::Published, output, size_of::<PublishedRecord>())?,
            messages: sink(RecordKind::Message, output, message_size)?,
            counts: [Arc::default(), Arc::default()],
            facts: facts(&settings, granted, what),
        })
    }

    /// Joins the channels; call it in the thread that will carry the messages.
    ///
    /// # Errors
    /// When a channel does not appear or is of another type.
    pub fn connect(
        self,
        adapter: &AdapterSettings,
        arm: &ArmLaunch,
        domain: &Domain,
    ) -> Result<JoinedArm, WorkerError> {
        let report = AdapterReport {
            arm: arm.arm,
            outgoing: arm.input.name.clone(),
            incoming: arm.output.name.clone(),
            peer_state: String::new(),
            counters: Vec::new(),
            refusals: Vec::new(),
            facts: self.facts.clone(),
        };
        Ok(JoinedArm {
            arm: self.join(adapter, arm, domain)?,
            work: match adapter.egm.kind {
                AdapterKind::Robot => Box::new(RobotWork::new(adapter, arm.arm)),
                AdapterKind::Sensor => Box::new(SensorWork::new(adapter, arm.arm)),
            },
            report,
        })
    }

    fn join(
        self,
        adapter: &AdapterSettings,
        arm: &ArmLaunch,
        domain: &Domain,
    ) -> Result<Arm, WorkerError> {
        let command = MessageType::of::<EgmCommand>();
        let feedback = MessageType::of::<EgmFeedback>();
        let (outgoing, incoming) = match adapter.egm.kind {
            AdapterKind::Robot => (feedback, command),
            AdapterKind::Sensor => (command, feedback),
        };
        let [taken, given] = self.counts;
        let waiter = (adapter.wait != WaitMode::Spin)
            .then(|| Waiter::open(domain, &[arm.input.name.as_str()]))
            .transpose()?;
        Ok(Arm {
            input: RecordedInput {
                port: ShmInput::open(domain, &arm.input.name, &outgoing, arm.input.depth)?,
                sink: self.taken,
                taken,
                wait: WaitStrategy::new(adapter.wait, arm.realtime.cpu),
            },
            output: RecordedOutput {
                destination: Destination::Channel {
                    port: Box::new(ShmOutput::open(
                        domain,
                        &arm.output.name,
                        &incoming,
                        output_settings(),
                    )?),
                    sink: self.published,
                },
                messages: self.messages,
                given,
            },
            waiter,
            line: self.line,
            wait: WaitStrategy::new(adapter.wait, arm.realtime.cpu),
            buffer: Box::new([0; DATAGRAM_BYTES_MAX]),
            attention: Attention::default(),
            early_count: 0,
        })
    }
}

/// An arm at work.
#[derive(Debug)]
pub struct JoinedArm {
    arm: Arm,
    work: Box<dyn Work>,
    report: AdapterReport,
}

impl JoinedArm {
    /// Moves what waits, without waiting for more; false when nothing waited.
    ///
    /// # Errors
    /// When a channel or the socket itself breaks.
    pub fn step(&mut self) -> Result<bool, WorkerError> {
        self.arm.step(self.work.as_mut())
    }

    /// Waits for the next thing to do, as its waiting strategy says.
    ///
    /// # Errors
    /// When waiting itself fails.
    pub fn rest(&mut self) -> Result<(), WorkerError> {
        self.arm.rest(self.work.next_due())
    }

    /// Takes what still waits at the end.
    ///
    /// # Errors
    /// As [`JoinedArm::step`].
    pub fn finish(&mut self) -> Result<(), WorkerError> {
        self.arm.finish(self.work.as_mut())
    }

    /// Drops what came before the run.
    pub(super) fn clear(&mut self) -> Result<(), WorkerError> {
        self.arm.clear()
    }

    /// Everything it counted so far.
    pub fn report(&self) -> AdapterReport {
        let mut counters = self.work.counters();
        let socket = self.arm.line.socket.counters();
        counters.extend(CountByName::all(CounterGroup::Socket, socket.iter()));
        let own = [
            ("datagrams before the run, dropped", self.arm.early_count),
            ("clock_step_count", self.arm.line.clock.step_count()),
        ];
        counters.extend(CountByName::all(CounterGroup::Own, own));
        AdapterReport {
            peer_state: self.work.peer_state(),
            counters,
            refusals: self.work.refusals(),
            ..self.report.clone()
        }
    }
}

fn socket_settings(adapter: &AdapterSettings, arm: &ArmLaunch) -> SocketSettings {
    let any: IpAddr = if arm.address.is_ipv4() {
        Ipv4Addr::UNSPECIFIED.into()
    } else {
        Ipv6Addr::UNSPECIFIED.into()
    };
    let local = match adapter.egm.kind {
        AdapterKind::Robot => SocketAddr::new(any, 0),
        AdapterKind::Sensor => arm.address,
    };
    SocketSettings {
        interface: adapter.interface.clone(),
        // 0 is the kernel's default; setting it would only reset the priority.
        dscp: (adapter.egm.dscp > 0).then_some(adapter.egm.dscp),
        timestamps: timestamp_mode(adapter.egm.timestamps),
        ..SocketSettings::new(local, arm.address)
    }
}

fn facts(
    settings: &SocketSettings,
    granted: GrantedOptions,
    what: String,
) -> Vec<(String, String)> {
    let mut facts = vec![
        ("socket".to_owned(), what),
        (
            "receive buffer granted".to_owned(),
            format!("{} bytes", granted.receive_buffer_bytes),
        ),
    ];
    let shortfalls = granted.shortfalls(settings).into_iter();
    facts.extend(shortfalls.map(|text| ("socket option".to_owned(), text)));
    facts
}
