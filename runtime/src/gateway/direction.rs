//! One channel direction of a gateway from its launch description to its final counters: opens
//! the socket in the normal thread, the shared-memory port in the pinned one.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::time::Duration;

use hil_gateways::protocol::wire::{self, Kind};
use hil_gateways::protocol::{EgressBridge, EgressSettings, IngressBridge, IngressSettings};
use hil_gateways::transport::DatagramReceiver;
use hil_gateways::transport::emulated::{EmulatedReceiver, EmulatedSettings};
use hil_gateways::transport::timestamping::TimestampMode;
use hil_gateways::transport::udp::{GrantedOptions, PathMtu, UdpReceiver, UdpSender, UdpSettings};
use hil_models::link::bernoulli::BernoulliLink;
use hil_models::measure::record::{EgressRecord, FollowUpRecord, IngressRecord};
use hil_models::random::RandomStream;

use super::counters;
use super::egress::{Armed, Attention, Egress, Line};
use super::ingress::{Ingress, Notes};
use super::kernel_clock::KernelClock;
use super::{GatewayError, Surroundings};
use crate::channel::{RawInput, RawOutput, Waiter};
use crate::clock::MonotonicClock;
use crate::process::launch::{DirectionLaunch, EmulationLaunch, Side};
use crate::process::pipe::DirectionReport;
use crate::record::{RecordKind, RecordSink, Recorder};
use crate::topology::Timestamps;
use crate::wait::{WaitMode, WaitStrategy};

/// Records a ring holds.
const RING_RECORDS: usize = 16_384;
/// Time between clock exchanges: frequent enough for a round-trip distribution, rare enough to
/// be a fraction of any control channel's traffic.
const SYNC_PERIOD: Duration = Duration::from_millis(100);
/// IP and UDP headers of a datagram.
const IPV4_HEADERS: usize = 20 + 8;
const IPV6_HEADERS: usize = 40 + 8;

type Sinks = (RecordSink, RecordSink);

/// A direction whose socket and files are open and whose port is not.
#[derive(Debug)]
pub struct Opened {
    socket: Socket,
    sinks: Sinks,
    count: Arc<AtomicU64>,
    is_established: Arc<AtomicBool>,
    facts: Vec<(String, String)>,
}

#[derive(Debug)]
enum Socket {
    Sender(Box<UdpSender>),
    Receiver(Box<dyn DatagramReceiver>),
}

/// A direction at work.
#[derive(Debug)]
pub struct Direction {
    way: Way,
    facts: Vec<(String, String)>,
}

#[derive(Debug)]
enum Way {
    Egress(Box<Egress>),
    Ingress(Box<Ingress>),
}

/// Opens the socket and the record files of `launch`; call it from a thread of normal priority.
///
/// # Errors
/// When the kernel refuses a socket option or a file cannot be made.
pub fn open<'a>(
    launch: &'a DirectionLaunch,
    recorder: &mut Recorder,
) -> Result<(&'a DirectionLaunch, Opened), GatewayError> {
    let settings = socket_settings(launch);
    let sinks = open_sinks(launch, recorder)?;
    let (socket, granted) = match launch.side {
        Side::Egress => {
            let sender = UdpSender::open(&settings)?;
            let granted = sender.granted();
            (Socket::Sender(Box::new(sender)), granted)
        }
        Side::Ingress => {
            let receiver = UdpReceiver::open(&settings)?;
            let granted = receiver.granted();
            (Socket::Receiver(emulate(receiver, launch)?), granted)
        }
    };
    let mut facts = socket_facts(&settings, granted);
    if let Some(EmulationLaunch {
        delay, loss_ratio, ..
    }) = launch.emulation
    {
        let text = format!(
            "{} ms delay (part of RX stamp → received by gateway), loss ratio {loss_ratio}",
            delay.as_secs_f64() * 1e3
        );
        facts.push(("link model behind the socket".to_owned(), text));
    }
    Ok((
        launch,
        Opened {
            socket,
            sinks,
            count: Arc::default(),
            // A receiver has nobody to wait for: it takes what comes.
            is_established: Arc::new(AtomicBool::new(launch.side == Side::Ingress)),
            facts,
        },
    ))
}

fn open_sinks(launch: &DirectionLaunch, recorder: &mut Recorder) -> Result<Sinks, GatewayError> {
    let channel = &launch.channel;
    let mut sink = |kind, size| recorder.sink(kind, channel, size, RING_RECORDS);
    Ok(match launch.side {
        Side::Egress => (
            sink(RecordKind::Egress, size_of::<EgressRecord>())?,
            sink(RecordKind::RoundTrip, 2 * size_of::<i64>())?,
        ),
        Side::Ingress => (
            sink(RecordKind::Ingress, size_of::<IngressRecord>())?,
            sink(RecordKind::FollowUp, size_of::<FollowUpRecord>())?,
        ),
    })
}

fn socket_settings(launch: &DirectionLaunch) -> UdpSettings {
    let socket = &launch.socket;
    UdpSettings {
        local: launch.local,
        peer: launch.peer,
        interface: socket.interface.clone(),
        // 0 is the kernel's default; setting it would only reset the priority.
        dscp: (socket.dscp > 0).then_some(socket.dscp),
        priority: socket.priority,
        send_buffer_bytes: Some(socket.send_buffer_bytes),
        receive_buffer_bytes: Some(socket.receive_buffer_bytes),
        timestamps: timestamp_mode(socket.timestamps),
    }
}

pub(crate) const fn timestamp_mode(asked: Timestamps) -> TimestampMode {
    match asked {
        Timestamps::Off => TimestampMode::Off,
        Timestamps::Software => TimestampMode::Software,
        Timestamps::Hardware => TimestampMode::Hardware,
    }
}

fn socket_facts(settings: &UdpSettings, granted: GrantedOptions) -> Vec<(String, String)> {
    let mut facts = vec![
        (
            "socket".to_owned(),
            format!("{} to or from {}", settings.local, settings.peer),
        ),
        (
            "send buffer granted".to_owned(),
            format!("{} bytes", granted.send_buffer_bytes),
        ),
        (
            "receive buffer granted".to_owned(),
            format!("{} bytes", granted.receive_buffer_bytes),
        ),
    ];
    let shortfalls = granted.shortfalls(settings);
    facts.extend(
        shortfalls
            .into_iter()
            .map(|text| ("socket option".to_owned(), text)),
    );
    facts
}

/// Room for everything that is under way at once, up to 4000 datagrams per second.
fn emulated_capacity(delay: Duration) -> usize {
    EmulatedSettings::default().capacity_count + delay.as_millis() as usize * 4
}

/// Puts the receiver behind the launch's link model, if it has one. Greetings and clock exchanges
/// pass freely: the model stands for what happens to the robot's messages.
fn emulate(
    receiver: UdpReceiver,
    launch: &DirectionLaunch,
) -> Result<Box<dyn DatagramReceiver>, GatewayError> {
    let Some(emulation) = launch.emulation else {
        return Ok(Box::new(receiver));
    };
    let stream = RandomStream::new(emulation.seed, &launch.channel);
    let link = BernoulliLink::new(emulation.delay, emulation.loss_ratio, stream)?;
    let settings = EmulatedSettings {
        capacity_count: emulated_capacity(emulation.delay),
        datagram_bytes_max: launch.socket.path_mtu_bytes,
        clock: Some(MonotonicClock::now),
    };
    let is_exempt =
        |bytes: &[u8]| wire::decode(bytes).is_ok_and(|datagram| datagram.header.kind != Kind::Data);
    Ok(Box::new(EmulatedReceiver::new(
        receiver,
        Box::new(link),
        is_exempt,
        settings,
    )))
}

/// What a datagram may carry: as much as the topology says, but no more than the path takes.
fn datagram_bytes_max(launch: &DirectionLaunch, path: PathMtu) -> usize {
    let headers = match launch.peer.ip() {
        IpAddr::V4(_) => IPV4_HEADERS,
        IpAddr::V6(_) => IPV6_HEADERS,
    };
    let configured = launch.socket.path_mtu_bytes.saturating_sub(headers);
    if path.is_assumed {
        return configured;
    }
    configured.min(usize::try_from(path.datagram_bytes).unwrap_or(configured))
}

impl Opened {
    /// Messages carried so far.
    pub fn count(&self) -> Arc<AtomicU64> {
        Arc::clone(&self.count)
    }

    /// True while the peer takes this direction's messages.
    pub fn is_established(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.is_established)
    }

    /// Joins the local channel; call it in the thread that will carry the messages.
    ///
    /// # Errors
    /// When the channel does not appear or is of another type.
    pub fn connect(
        self,
        launch: &DirectionLaunch,
        surroundings: &Surroundings,
    ) -> Result<Direction, GatewayError> {
        let mut facts = self.facts;
        let way = match self.socket {
            Socket::Sender(sender) => {
                let mtu = sender.path_mtu();
                facts.push((
                    "path MTU".to_owned(),
                    format!(
                        "{} bytes, {} configured",
                        mtu.packet_bytes, launch.socket.path_mtu_bytes
                    ),
                ));
                Way::Egress(Box::new(egress(
                    sender,
                    self.sinks,
                    (self.count, self.is_established),
                    (launch, surroundings),
                )?))
            }
            Socket::Receiver(receiver) => Way::Ingress(Box::new(ingress(
                receiver,
                self.sinks,
                self.count,
                (launch, surroundings),
            )?)),
        };
        Ok(Direction { way, facts })
    }
}

fn egress(
    sender: Box<UdpSender>,
    sinks: Sinks,
    (count, is_established): (Arc<AtomicU64>, Arc<AtomicBool>),
    (launch, around): (&DirectionLaunch, &Surroundings),
) -> Result<Egress, GatewayError> {
    let bridge = EgressBridge::new(EgressSettings {
        channel: Surroundings::identity(launch),
        session: around.session,
        domain: around.fingerprint,
        clock_id: around.clock_id,
        datagram_max_bytes: datagram_bytes_max(launch, sender.path_mtu()),
        sync_period: SYNC_PERIOD,
    })?;
    let mode = timestamp_mode(launch.socket.timestamps);
    let armed = Armed {
        software: mode != TimestampMode::Off,
        hardware: mode == TimestampMode::Hardware,
    };
    let waiter = (launch.wait != WaitMode::Spin)
        .then(|| Waiter::open(&around.domain, &[launch.channel.as_str()]))
        .transpose()?;
    Ok(Egress {
        input: RawInput::open(&around.domain, &launch.channel, launch.depth)?,
        waiter,
        bridge,
        line: Line::new(sender, sinks, around.session, armed)?,
        wait: WaitStrategy::new(launch.wait),
        sent: count,
        stop: Arc::clone(&around.stop),
        attention: Attention::default(),
        is_established,
    })
}

fn ingress(
    receiver: Box<dyn DatagramReceiver>,
    sinks: Sinks,
    count: Arc<AtomicU64>,
    (launch, around): (&DirectionLaunch, &Surroundings),
) -> Result<Ingress, GatewayError> {
    let identity = Surroundings::identity(launch);
    let settings = IngressSettings::new(
        identity,
        around.session,
        around.fingerprint,
        around.clock_id,
    );
    let (messages, follow_ups) = sinks;
    Ok(Ingress {
        receiver,
        is_emulated: launch.emulation.is_some(),
        bridge: IngressBridge::new(settings)?,
        output: RawOutput::open(&around.domain, &launch.channel, true)?,
        wait: WaitStrategy::new(launch.wait),
        peer: launch.peer,
        notes: Notes {
            messages,
            follow_ups,
        },
        received: count,
        stop: Arc::clone(&around.stop),
        foreign_count: 0,
        clock: KernelClock::read()?,
        buffer: vec![0; usize::from(u16::MAX)].into_boxed_slice(),
    })
}

impl Direction {
    /// Carries messages until told to stop.
    ///
    /// # Errors
    /// When the channel or the socket itself breaks, or the peer refuses the channel for good.
    pub fn run(&mut self) -> Result<(), GatewayError> {
        match &mut self.way {
            Way::Egress(egress) => egress.run(),
            Way::Ingress(ingress) => ingress.run(),
        }
    }

    /// Does what there is to do now, without waiting; false when there was nothing.
    ///
    /// # Errors
    /// As [`Direction::run`].
    pub fn step(&mut self) -> Result<bool, GatewayError> {
        match &mut self.way {
            Way::Egress(egress) => egress.step(),
            Way::Ingress(ingress) => ingress.step(),
        }
    }

    /// Waits for the next thing to do, as its waiting strategy says.
    ///
    /// # Errors
    /// When waiting itself fails.
    pub fn rest(&mut self) -> Result<(), GatewayError> {
        match &mut self.way {
            Way::Egress(egress) => egress.rest(),
            Way::Ingress(ingress) => ingress.rest(),
        }
    }

    /// Every counter of the direction.
    pub fn report(&self, launch: &DirectionLaunch) -> DirectionReport {
        let (direction, peer_state, counters) = match &self.way {
            Way::Egress(egress) => (
                "egress",
                counters::egress_state(egress),
                counters::of_egress(egress),
            ),
            Way::Ingress(ingress) => (
                "ingress",
                counters::ingress_state(ingress),
                counters::of_ingress(ingress),
            ),
        };
        DirectionReport {
            channel: launch.channel.clone(),
            direction: direction.to_owned(),
            peer_state,
            counters,
            facts: self.facts.clone(),
        }
    }
}

/// Where a transmit probe of this direction may go: the peer's discard port.
pub(crate) fn probe_target(launch: &DirectionLaunch) -> SocketAddr {
    SocketAddr::new(
        launch.peer.ip(),
        hil_gateways::transport::probe::DISCARD_PORT,
    )
}
