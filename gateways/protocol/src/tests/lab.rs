//! Two bridges in one thread, what lies between them, and a time that moves in steps. The hosts' clocks differ.
//! No socket, no clock; a fault is a panic.

use core::net::SocketAddr;
use core::time::Duration;
use std::collections::BTreeMap;

use hil_core::message::Envelope;
use hil_core::random::RandomStream;
use hil_core::time::Instant;

use crate::channel::{ChannelIdentity, FlowIdentity};
use crate::egress::{
    EgressBridge, EgressEvent, EgressSettings, LocalRefusal, RoundTrip, TransmitFailure,
};
use crate::ingress::{
    Delivery, Destination, Disposition, IngressBridge, IngressSettings, MessageInfo, Payload, Piece,
};
use crate::refusal::Refusal;
use crate::sequence::Order;
use crate::stamps::{ArrivalStamps, StampSource};
use crate::wire::{Header, Kind};

/// The egress host's clock reads this much more than the ingress host's.
pub const OFFSET_NS: i64 = 77_000_000_000;
const STEP_NS: i64 = 50_000;
/// What the kernel adds between handing over and transmission.
pub const TX_NS: i64 = 700;

/// A flow of one channel.
pub fn flow(size_max_bytes: u32) -> FlowIdentity {
    let channel = ChannelIdentity::new(3, "arm/command", "test.Command.v1", size_max_bytes, 8);
    FlowIdentity {
        flow: 65_535,
        name: "link/hop/forward".to_owned(),
        channels: vec![channel],
    }
}

/// Of [`flow`] over Ethernet, with a clock exchange every 20 ms.
pub fn egress_settings(session: u32, size_max_bytes: u32) -> EgressSettings {
    EgressSettings {
        flow: flow(size_max_bytes),
        session,
        domain: [1; 16],
        clock_id: 11,
        datagram_max_bytes: 1472,
        sync_period: Duration::from_millis(20),
    }
}

/// Of another host than [`egress_settings`].
pub fn ingress_settings(session: u32, size_max_bytes: u32) -> IngressSettings {
    IngressSettings::new(flow(size_max_bytes), session, [2; 16], 22)
}

/// Time under way, both directions together: `(t4 - t1) - (t3 - t2)`.
pub fn rtt_ns(one: &RoundTrip) -> i64 {
    one.t4_ns - one.t1_ns - (one.t3_ns - one.t2_ns)
}

/// Messages in pieces come together in memory of this process: for simulations, benches and tests. It allocates.
#[derive(Debug, Default)]
pub struct InMemory {
    /// By channel and slot.
    messages: BTreeMap<(usize, usize), Vec<u8>>,
}

impl InMemory {
    /// A destination that hands whole messages to `take`.
    pub fn with<F: FnMut(&Delivery, &[u8])>(&mut self, take: F) -> Taking<'_, F> {
        Taking { memory: self, take }
    }

    /// Puts a piece into the memory of its slot.
    pub fn store(&mut self, piece: &Piece<'_>) {
        let message = self
            .messages
            .entry((piece.channel, piece.slot))
            .or_default();
        if piece.is_first {
            message.clear();
        }
        let end = piece.offset_bytes + piece.payload.len();
        if message.len() < end {
            message.resize(end, 0);
        }
        message[piece.offset_bytes..end].copy_from_slice(piece.payload);
    }

    /// What is stored in a slot; nothing where nothing was.
    pub fn message(&self, channel: usize, slot: usize) -> &[u8] {
        self.messages
            .get(&(channel, slot))
            .map_or(&[], Vec::as_slice)
    }
}

/// An [`InMemory`] with who takes its messages.
#[derive(Debug)]
pub struct Taking<'a, F> {
    memory: &'a mut InMemory,
    take: F,
}

impl<F: FnMut(&Delivery, &[u8])> Destination for Taking<'_, F> {
    fn store(&mut self, piece: &Piece<'_>) -> bool {
        self.memory.store(piece);
        true
    }

    fn deliver(&mut self, delivery: &Delivery, payload: Payload<'_>) {
        let bytes = match payload {
            Payload::Datagram(bytes) => bytes,
            Payload::Stored { slot, .. } => self.memory.message(delivery.message.channel, slot),
        };
        (self.take)(delivery, bytes);
    }
}

/// Whereto a datagram goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
    /// To the ingress.
    There,
    /// To the egress.
    Back,
}

/// What lies between the bridges. Its time is the ingress host's.
pub trait Medium {
    /// Takes a datagram.
    fn send(&mut self, way: Way, now: Instant, datagram: &[u8]);

    /// The next datagram that has arrived by `now`.
    fn receive(&mut self, way: Way, now: Instant) -> Option<Arrived>;
}

/// A datagram at its end.
#[derive(Debug)]
pub struct Arrived {
    /// When, and from where.
    pub stamps: ArrivalStamps,
    /// What was sent.
    pub bytes: Vec<u8>,
}

/// What becomes of the datagrams one way.
#[derive(Debug, Clone, Copy, Default)]
pub struct Impairment {
    /// Of each, nanoseconds.
    pub delay_ns: i64,
    /// Added to it, uniformly from 0, nanoseconds.
    pub jitter_ns: i64,
    /// Share that is lost.
    pub loss_ratio: f64,
    /// Share that comes twice.
    pub duplicate_ratio: f64,
}

/// One direction of a [`Network`].
#[derive(Debug)]
pub struct Path {
    /// In force from now on.
    pub impairment: Impairment,
    random: RandomStream,
    in_flight: Vec<Arrived>,
}

impl Path {
    fn new(seed: u64, name: &str, impairment: Impairment) -> Self {
        Self {
            impairment,
            random: RandomStream::new(seed, name),
            in_flight: Vec::new(),
        }
    }

    fn offer(&mut self, now_ns: i64, from: SocketAddr, bytes: &[u8]) {
        let copies = 1 + u32::from(self.random.chance(self.impairment.duplicate_ratio));
        for _ in 0..copies {
            if self.random.chance(self.impairment.loss_ratio) {
                continue;
            }
            #[expect(clippy::cast_possible_truncation, reason = "jitter of milliseconds")]
            let jitter = (self.random.uniform() * self.impairment.jitter_ns as f64) as i64;
            self.in_flight.push(Arrived {
                stamps: ArrivalStamps {
                    received_ns: now_ns + self.impairment.delay_ns + jitter,
                    received_source: StampSource::KernelSoftware,
                    peer: Some(from),
                },
                bytes: bytes.to_vec(),
            });
        }
    }

    /// The first of what has arrived by now.
    fn take(&mut self, now_ns: i64) -> Option<Arrived> {
        let times = self.in_flight.iter().map(|one| one.stamps.received_ns);
        let (at_ns, index) = times.zip(0..).min()?;
        (at_ns <= now_ns).then(|| self.in_flight.remove(index))
    }
}

/// A network that loses, copies and reorders.
#[derive(Debug)]
pub struct Network {
    /// To the ingress.
    pub there: Path,
    /// To the egress.
    pub back: Path,
    /// Whom the ingress hears.
    pub egress_address: SocketAddr,
}

impl Medium for Network {
    fn send(&mut self, way: Way, now: Instant, datagram: &[u8]) {
        let (path, from) = match way {
            Way::There => (&mut self.there, self.egress_address),
            Way::Back => (&mut self.back, SocketAddr::from(([10, 0, 0, 2], 5000))),
        };
        path.offer(now.as_ns(), from, datagram);
    }

    fn receive(&mut self, way: Way, now: Instant) -> Option<Arrived> {
        let path = match way {
            Way::There => &mut self.there,
            Way::Back => &mut self.back,
        };
        path.take(now.as_ns())
    }
}

/// A message that the ingress delivered.
#[derive(Debug)]
pub struct Delivered {
    /// Which.
    pub message: MessageInfo,
    /// Its content.
    pub payload: Vec<u8>,
    /// Its place among the others.
    pub order: Order,
    /// Number and departure of an earlier one.
    pub follow_up: Option<(u64, i64)>,
}

/// Both hosts and what lies between them.
#[derive(Debug)]
pub struct Lab<M = Network> {
    /// On the ingress host's clock, nanoseconds.
    pub now_ns: i64,
    /// The egress host's clock minus the ingress host's, nanoseconds.
    pub offset_ns: i64,
    /// The sending bridge.
    pub egress: EgressBridge,
    /// The receiving bridge.
    pub ingress: IngressBridge,
    /// False while the ingress host is up and nobody listens, which the kernel tells the sender.
    pub is_listening: bool,
    /// What lies between.
    pub medium: M,
    /// Start of the producer.
    pub epoch: u32,
    /// Number of the producer's next message.
    pub next_sequence: u64,
    /// Length of its messages.
    pub payload_bytes: usize,
    /// Kind and channel number of each datagram to the ingress.
    pub datagrams: Vec<(Kind, u16)>,
    /// Where messages in pieces come together.
    pub memory: InMemory,
    /// In their order.
    pub delivered: Vec<Delivered>,
    /// What the ingress made of each datagram.
    pub dispositions: Vec<Result<Disposition, Refusal>>,
    /// What the egress made of each reply.
    pub events: Vec<Result<EgressEvent, Refusal>>,
}

impl Lab {
    /// One channel over a network.
    pub fn new(seed: u64, payload_bytes: u32, impairment: Impairment) -> Self {
        Self::of(seed, &flow(payload_bytes), impairment)
    }

    /// Any flow over a network; [`Lab::publish`] is for its first channel.
    pub fn of(seed: u64, flow: &FlowIdentity, impairment: Impairment) -> Self {
        Self::over(
            flow,
            Network {
                there: Path::new(seed, "there", impairment),
                back: Path::new(seed, "back", impairment),
                egress_address: SocketAddr::from(([10, 0, 0, 1], 4000)),
            },
        )
    }

    /// What a producer writes into its message of that number.
    pub fn payload(sequence: u64, length: usize) -> Vec<u8> {
        let mut random = RandomStream::new(sequence, "payload");
        (0..length)
            .map(|_| random.next_u64().to_le_bytes()[0])
            .collect()
    }
}

impl<M: Medium> Lab<M> {
    /// Over whatever it is.
    ///
    /// # Panics
    /// When the bridges refuse the flow.
    pub fn over(flow: &FlowIdentity, medium: M) -> Self {
        const FITS: &str = "a flow of a lab fits a bridge";
        let first = flow.channels.first();
        Self {
            now_ns: 1_000_000_000,
            offset_ns: OFFSET_NS,
            egress: EgressBridge::new(EgressSettings {
                flow: flow.clone(),
                ..egress_settings(100, 0)
            })
            .expect(FITS),
            ingress: IngressBridge::new(IngressSettings {
                flow: flow.clone(),
                ..ingress_settings(200, 0)
            })
            .expect(FITS),
            is_listening: true,
            medium,
            epoch: 1,
            next_sequence: 0,
            payload_bytes: first.map_or(0, |one| one.size_max_bytes as usize),
            datagrams: Vec::new(),
            memory: InMemory::default(),
            delivered: Vec::new(),
            dispositions: Vec::new(),
            events: Vec::new(),
        }
    }

    /// The time of the ingress host.
    pub fn now(&self) -> Instant {
        Instant::from_ns(self.now_ns)
    }

    /// The time of the egress host.
    pub fn egress_now(&self) -> Instant {
        Instant::from_ns(self.now_ns + self.offset_ns)
    }

    /// The producer of the first channel publishes its next message.
    ///
    /// # Errors
    /// The refusal of the egress.
    pub fn publish(&mut self) -> Result<(), LocalRefusal> {
        let (epoch, sequence) = (self.epoch, self.next_sequence);
        let payload = Lab::<Network>::payload(sequence, self.payload_bytes);
        self.next_sequence += 1;
        self.offer(0, epoch, sequence, &payload)
    }

    /// A producer publishes a message 2 us before the egress takes it.
    ///
    /// # Errors
    /// The refusal of the egress.
    pub fn offer(
        &mut self,
        channel: usize,
        epoch: u32,
        sequence: u64,
        payload: &[u8],
    ) -> Result<(), LocalRefusal> {
        let now = self.egress_now();
        let envelope = Envelope {
            sequence,
            published_ns: now.as_ns() - 2000,
            epoch,
            ..Envelope::default()
        };
        let result = self.egress.on_local(now, channel, &envelope, payload);
        self.drain_egress();
        result
    }

    /// Sends all that the egress has.
    ///
    /// # Panics
    /// When a datagram is too long to be sealed.
    pub fn drain_egress(&mut self) {
        let (now, egress_now) = (self.now(), self.egress_now());
        while let Some(transmit) = self.egress.poll_transmit(egress_now) {
            let (kind, key) = (transmit.key.kind, transmit.key);
            assert!(transmit.datagram.len() + 16 <= 1472);
            let is_last = transmit.is_last_fragment;
            if !self.is_listening {
                self.egress
                    .on_transmit_failed(egress_now, TransmitFailure::PeerUnreachable);
                continue;
            }
            let header = Header::read(transmit.datagram).expect("it is our own").0;
            self.datagrams.push((kind, header.channel));
            self.medium.send(Way::There, now, transmit.datagram);
            if is_last {
                self.egress.on_transmit_stamp(key, TX_NS);
            }
        }
    }

    fn step_ingress(&mut self) {
        let now = self.now();
        while let Some(Arrived { stamps, bytes }) = self.medium.receive(Way::There, now) {
            if !self.is_listening {
                continue;
            }
            let delivered = &mut self.delivered;
            let mut destination = self.memory.with(|one, payload| {
                delivered.push(Delivered {
                    message: one.message,
                    payload: payload.to_vec(),
                    order: one.order,
                    follow_up: one.follow_up.map(|f| (f.sequence, f.handed_to_tx_ns)),
                });
            });
            let disposition = self
                .ingress
                .on_datagram(now, stamps, &bytes, &mut destination);
            self.dispositions.push(disposition);
            let mut replies = 0;
            while let Some(reply) = self.ingress.poll_transmit(now) {
                assert!(reply.datagram.len() <= bytes.len());
                assert_eq!(reply.destination, stamps.peer);
                let (kind, sequence) = (reply.kind, reply.sequence);
                self.medium.send(Way::Back, now, reply.datagram);
                self.ingress.on_transmit_stamp(kind, sequence, TX_NS);
                replies += 1;
            }
            assert!(replies <= 1, "one request, one reply");
        }
        let counts = self.ingress.counts();
        assert_eq!(
            counts.datagram_count,
            counts.accepted_count() + self.ingress.refusals().total()
        );
    }

    /// Everything that is due goes over and is answered.
    ///
    /// # Panics
    /// When a bridge miscounts, or answers more than it was asked.
    pub fn exchange(&mut self) {
        self.drain_egress();
        self.step_ingress();
        let (now, egress_now) = (self.now(), self.egress_now());
        while let Some(mut arrived) = self.medium.receive(Way::Back, now) {
            arrived.stamps.received_ns += self.offset_ns;
            let event = self
                .egress
                .on_datagram(egress_now, arrived.stamps, &arrived.bytes);
            self.events.push(event);
        }
        let counts = self.egress.counts();
        let refused = self.egress.refusals().total();
        assert_eq!(counts.reply_count, counts.reply_accepted_count + refused);
        if self.payload_bytes == 0 {
            return;
        }
        let counts = self.egress.channel_counts(0);
        assert_eq!(
            counts.offered_count,
            counts.sent_count + counts.message_failed_count + counts.refused_count()
        );
    }

    /// As [`Lab::exchange`], 50 us later.
    pub fn step(&mut self) {
        self.now_ns += STEP_NS;
        self.exchange();
    }

    /// Steps for so long.
    pub fn run_ms(&mut self, ms: i64) {
        let end = self.now_ns + ms * 1_000_000;
        while self.now_ns < end {
            self.step();
        }
    }

    /// Publishes at 1 kHz; every refusal is only counted.
    pub fn publish_for_ms(&mut self, ms: i64) {
        for _ in 0..ms {
            let _refused = self.publish();
            self.run_ms(1);
        }
    }
}
