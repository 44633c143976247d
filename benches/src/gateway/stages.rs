//! The stages of one hop taken apart: each is done for a batch of messages with the product's own
//! types, one stage after the other, in one thread. Nothing waits.

use std::time::Instant as Stopwatch;

use bytemuck::Zeroable;
use hil_core::endpoint::InputPort;
use hil_core::message::Envelope;
use hil_core::record::{EgressRecord, IngressRecord};
use hil_core::time::Instant;
use hil_platform::clock::MonotonicClock;
use hil_protocol::{
    ArrivalStamps, ChannelIdentity, EgressBridge, EgressSettings, FlowIdentity, InMemory,
    IngressBridge, IngressSettings,
};
use hil_rundir::record::RecordSink;
use hil_shm::{Domain, RawInput, RawOutput};
use hil_transport::udp::{UdpReceiver, UdpSender};
use hil_transport::{DatagramReceiver, DatagramSender};

use super::hosts::{Hosts, Plan, Ports, SetupError};
use super::side::EchoSide;

/// Messages per batch: the clock is read twice per batch, so its cost hardly shows.
pub const BATCH: usize = 16;

/// A stage of the hop.
#[derive(Debug, Clone, Copy)]
pub struct Stage {
    /// Name in the table.
    pub name: &'static str,
    /// A system call on a socket; the rest is what the gateway adds.
    pub is_socket_call: bool,
    /// Work of iceoryx2, which any program on such a channel has done.
    pub is_shared_memory: bool,
    /// How often a hop does it.
    pub per_hop: u64,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Whose {
    Socket,
    SharedMemory,
    Own,
}

const fn stage(name: &'static str, whose: Whose, per_hop: u64) -> Stage {
    Stage {
        name,
        is_socket_call: matches!(whose, Whose::Socket),
        is_shared_memory: matches!(whose, Whose::SharedMemory),
        per_hop,
    }
}

/// All stages in the order of the way. The clock is read when a message is taken, handed to the
/// kernel, received and published. A look at the empty channel is waiting and no part of a hop.
pub const STAGES: [Stage; 10] = [
    stage("receive from shared memory", Whose::SharedMemory, 1),
    stage("look at the empty channel", Whose::SharedMemory, 0),
    stage("bridge: take and encode", Whose::Own, 1),
    stage("send call", Whose::Socket, 1),
    stage("error queue read (TX stamp)", Whose::Socket, 1),
    stage("receive call", Whose::Socket, 1),
    stage("bridge: decode and window", Whose::Own, 1),
    stage("loan and publish", Whose::SharedMemory, 1),
    stage("record pushes, both ends", Whose::Own, 1),
    stage("clock read", Whose::Own, 4),
];

/// What the stages work with.
#[derive(Debug)]
pub struct Workbench {
    near: Ports,
    far: Ports,
    raw_input: RawInput,
    raw_output: RawOutput,
    egress: EgressBridge,
    ingress: IngressBridge,
    memory: InMemory,
    sender: UdpSender,
    receiver: UdpReceiver,
    sinks: [RecordSink; 2],
    payload: Vec<u8>,
    messages: Vec<(Envelope, Vec<u8>)>,
    datagrams: Vec<Vec<u8>>,
    buffer: Vec<u8>,
    _domains: [Domain; 2],
}

impl Workbench {
    /// Opens everything for the channels of `plan`; `hosts` must not be recording yet.
    ///
    /// # Errors
    /// When the machine refuses something.
    pub fn open(hosts: &mut Hosts, plan: Plan) -> Result<Self, SetupError> {
        hosts.create_channels(&plan)?;
        let addresses = [hosts.address(0).clone(), hosts.address(1).clone()];
        let near = Ports::open(&addresses[0], &plan, 0, false)?;
        let far = Ports::open(&addresses[1], &plan, 1, false)?;
        let domains = [Domain::open(&addresses[0])?, Domain::open(&addresses[1])?];
        let channel = plan.channel_of(0);
        let (egress, ingress) = bridges(&plan, &domains)?;
        let [near_echo, far_echo] = EchoSide::pair(&hosts.network, plan)?;
        let ((sender, _), (_, receiver)) = (near_echo.into_sockets(), far_echo.into_sockets());
        let empty = (Envelope::default(), vec![0; plan.size_bytes]);
        Ok(Self {
            raw_input: RawInput::open(&domains[0], &channel, plan.depth)?,
            raw_output: RawOutput::open(&domains[1], &channel, true)?,
            sinks: hosts.sinks(&plan)?,
            near,
            far,
            egress,
            ingress,
            memory: InMemory::default(),
            sender,
            receiver,
            payload: vec![7; plan.size_bytes],
            messages: vec![empty; BATCH],
            datagrams: (0..BATCH).map(|_| Vec::with_capacity(2048)).collect(),
            buffer: vec![0; 2048],
            _domains: domains,
        })
    }

    /// Takes one batch through all stages; nanoseconds per message and stage.
    ///
    /// # Errors
    /// When a message got lost between two stages.
    pub fn batch(&mut self) -> Result<[u64; STAGES.len()], SetupError> {
        for _ in 0..BATCH {
            self.near.output.publish(Instant::ZERO, &self.payload)?;
        }
        let taken = self.take()?;
        let looked = timed(|| {
            self.raw_input
                .receive(&mut |_, _| {})
                .is_ok_and(|some| !some)
        });
        let encoded = self.encode();
        let sent = self.send();
        let stamped = timed(|| self.sender.next_stamp().is_some());
        let received = self.receive();
        let decoded = self.decode();
        let published = self.publish();
        while self.far.input.receive(Instant::ZERO, &mut |_, _| {})? {}
        let recorded = self.record();
        let read = timed(|| MonotonicClock::now() > Instant::ZERO);
        let all = [
            taken, looked, encoded, sent, stamped, received, decoded, published, recorded, read,
        ];
        for (done, stage) in all.iter().zip(STAGES) {
            if done.1 != BATCH {
                return Err(format!("{}: {} of {BATCH} came through", stage.name, done.1).into());
            }
        }
        Ok(all.map(|(ns, _)| ns))
    }

    fn take(&mut self) -> Result<Timed, SetupError> {
        let Self {
            raw_input,
            messages,
            ..
        } = self;
        let mut slots = messages.iter_mut();
        let mut take = |envelope: &Envelope, payload: &[u8]| {
            if let Some((kept, bytes)) = slots.next() {
                *kept = *envelope;
                bytes.copy_from_slice(payload);
            }
        };
        let mut broken = None;
        let done = timed(|| {
            raw_input.receive(&mut take).unwrap_or_else(|error| {
                broken = Some(error);
                false
            })
        });
        broken.map_or(Ok(done), |error| Err(error.into()))
    }

    fn encode(&mut self) -> Timed {
        let Self {
            egress,
            messages,
            datagrams,
            ..
        } = self;
        let mut slots = messages.iter().zip(datagrams);
        let now = MonotonicClock::now();
        timed(|| {
            let Some(((envelope, payload), datagram)) = slots.next() else {
                return false;
            };
            if egress.on_local(now, 0, envelope, payload).is_err() {
                return false;
            }
            let Some(transmit) = egress.poll_transmit(now) else {
                return false;
            };
            datagram.clear();
            datagram.extend_from_slice(transmit.datagram);
            true
        })
    }

    fn send(&mut self) -> Timed {
        let Self {
            sender, datagrams, ..
        } = self;
        let mut slots = datagrams.iter();
        timed(|| {
            slots
                .next()
                .is_some_and(|datagram| sender.send(datagram).is_ok())
        })
    }

    fn receive(&mut self) -> Timed {
        let Self {
            receiver, buffer, ..
        } = self;
        timed(|| matches!(receiver.receive(Instant::ZERO, buffer), Ok(Some(_))))
    }

    fn decode(&mut self) -> Timed {
        let Self {
            ingress,
            memory,
            datagrams,
            ..
        } = self;
        let mut slots = datagrams.iter();
        let now = MonotonicClock::now();
        let arrival = ArrivalStamps::application(now.as_ns());
        timed(|| {
            let mut is_delivered = false;
            if let Some(datagram) = slots.next() {
                let mut deliver = memory.with(|_, _| is_delivered = true);
                ingress
                    .on_datagram(now, arrival, datagram, &mut deliver)
                    .ok();
            }
            is_delivered
        })
    }

    fn publish(&mut self) -> Timed {
        let Self {
            raw_output,
            messages,
            ..
        } = self;
        let mut slots = messages.iter();
        timed(|| {
            let message = slots.next();
            message.is_some_and(|(envelope, payload)| {
                let envelope = Envelope {
                    flags: Envelope::FORWARDED,
                    ..*envelope
                };
                raw_output.publish_with(payload, || envelope).is_ok()
            })
        })
    }

    fn record(&mut self) -> Timed {
        let [egress, ingress] = &mut self.sinks;
        timed(|| {
            egress.push(&EgressRecord::zeroed());
            ingress.push(&IngressRecord::zeroed());
            true
        })
    }
}

/// Nanoseconds per message, and messages that came through.
type Timed = (u64, usize);

fn timed(mut work: impl FnMut() -> bool) -> Timed {
    let started = Stopwatch::now();
    let mut done = 0;
    for _ in 0..BATCH {
        done += usize::from(work());
    }
    let elapsed = started.elapsed().as_nanos();
    let each = u64::try_from(elapsed).unwrap_or(u64::MAX) / BATCH as u64;
    (each, done)
}

/// A pair of bridges that have greeted each other.
fn bridges(
    plan: &Plan,
    domains: &[Domain; 2],
) -> Result<(EgressBridge, IngressBridge), SetupError> {
    let size = u32::try_from(plan.size_bytes)?;
    let channel = ChannelIdentity::new(1, &plan.channel_of(0), plan.message().name, size, 8);
    let flow = FlowIdentity {
        flow: u16::MAX,
        name: "hil/link/bench/forward".to_owned(),
        channels: vec![channel],
    };
    let clock_id = hil_shm::clock_id()?;
    let now = MonotonicClock::now();
    let mut egress = EgressBridge::new(EgressSettings {
        flow: flow.clone(),
        session: 1,
        domain: domains[0].fingerprint()?,
        clock_id,
        datagram_max_bytes: 1472,
        // The stages are of messages; an exchange in between would disturb them.
        sync_period: core::time::Duration::from_hours(1),
    })?;
    let fingerprint = domains[1].fingerprint()?;
    let mut ingress = IngressBridge::new(IngressSettings::new(flow, 2, fingerprint, clock_id))?;
    let arrival = ArrivalStamps::application(now.as_ns());
    let hello = egress
        .poll_transmit(now)
        .ok_or("no greeting")?
        .datagram
        .to_vec();
    let greeted = ingress.on_datagram(
        now,
        arrival,
        &hello,
        &mut InMemory::default().with(|_, _| {}),
    );
    greeted.map_err(|refusal| format!("{refusal:?}"))?;
    let answer = ingress
        .poll_transmit(now)
        .ok_or("no answer")?
        .datagram
        .to_vec();
    let accepted = egress.on_datagram(now, arrival, &answer);
    accepted.map_err(|refusal| format!("{refusal:?}"))?;
    while egress.poll_transmit(MonotonicClock::now()).is_some() {}
    Ok((egress, ingress))
}
