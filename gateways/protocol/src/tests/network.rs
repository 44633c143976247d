//! Two bridges in one thread, a network between them that loses, copies and reorders, and a time
//! that moves in steps. The hosts' clocks differ.

use core::net::SocketAddr;
use core::time::Duration;

use hil_core::message::Envelope;
use hil_core::random::RandomStream;
use hil_core::time::Instant;

use crate::channel::{ChannelIdentity, FlowIdentity};
use crate::egress::{EgressBridge, EgressEvent, EgressSettings, LocalRefusal, TransmitFailure};
use crate::ingress::{Disposition, InMemory, IngressBridge, IngressSettings, MessageInfo};
use crate::refusal::Refusal;
use crate::sequence::Order;
use crate::stamps::{ArrivalStamps, StampSource};

/// The egress host's clock reads this much more than the ingress host's.
pub(super) const OFFSET_NS: i64 = 77_000_000_000;
pub(super) const STEP_NS: i64 = 50_000;
/// What the fake kernel adds between handing over and transmission.
pub(super) const TX_NS: i64 = 700;

pub(super) fn channel(size_max_bytes: u32) -> ChannelIdentity {
    ChannelIdentity::new(3, "arm/command", "test.Command.v1", size_max_bytes, 8)
}

/// A flow of that one channel.
pub(super) fn flow(size_max_bytes: u32) -> FlowIdentity {
    FlowIdentity {
        flow: 65_535,
        name: "link/hop/forward".to_owned(),
        channels: vec![channel(size_max_bytes)],
    }
}

pub(super) fn egress_settings(session: u32, size_max_bytes: u32) -> EgressSettings {
    EgressSettings {
        flow: flow(size_max_bytes),
        session,
        domain: [1; 16],
        clock_id: 11,
        datagram_max_bytes: 1472,
        sync_period: Duration::from_millis(20),
    }
}

pub(super) fn ingress_settings(session: u32, size_max_bytes: u32) -> IngressSettings {
    IngressSettings::new(flow(size_max_bytes), session, [2; 16], 22)
}

#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Impairment {
    pub(super) delay_ns: i64,
    pub(super) jitter_ns: i64,
    pub(super) loss_ratio: f64,
    pub(super) duplicate_ratio: f64,
}

#[derive(Debug)]
struct InFlight {
    at_ns: i64,
    from: SocketAddr,
    bytes: Vec<u8>,
}

/// One direction of the network.
#[derive(Debug)]
pub(super) struct Path {
    pub(super) impairment: Impairment,
    random: RandomStream,
    in_flight: Vec<InFlight>,
    pub(super) longest_bytes: usize,
}

impl Path {
    fn new(seed: u64, name: &str, impairment: Impairment) -> Self {
        Self {
            impairment,
            random: RandomStream::new(seed, name),
            in_flight: Vec::new(),
            longest_bytes: 0,
        }
    }

    fn offer(&mut self, now_ns: i64, from: SocketAddr, bytes: &[u8]) {
        self.longest_bytes = self.longest_bytes.max(bytes.len());
        let copies = 1 + u32::from(self.random.chance(self.impairment.duplicate_ratio));
        for _ in 0..copies {
            if self.random.chance(self.impairment.loss_ratio) {
                continue;
            }
            #[expect(clippy::cast_possible_truncation, reason = "test jitter")]
            let jitter = (self.random.uniform() * self.impairment.jitter_ns as f64) as i64;
            self.in_flight.push(InFlight {
                at_ns: now_ns + self.impairment.delay_ns + jitter,
                from,
                bytes: bytes.to_vec(),
            });
        }
    }

    /// What has arrived by now, oldest first.
    fn take(&mut self, now_ns: i64) -> Vec<InFlight> {
        self.in_flight.sort_by_key(|datagram| datagram.at_ns);
        let due = self
            .in_flight
            .partition_point(|datagram| datagram.at_ns <= now_ns);
        self.in_flight.drain(..due).collect()
    }
}

#[derive(Debug)]
pub(super) struct Delivered {
    pub(super) message: MessageInfo,
    pub(super) payload: Vec<u8>,
    pub(super) order: Order,
    pub(super) follow_up: Option<(u64, i64)>,
}

/// Both hosts and the network.
#[derive(Debug)]
pub(super) struct Lab {
    pub(super) now_ns: i64,
    pub(super) egress: EgressBridge,
    pub(super) ingress: Option<IngressBridge>,
    memory: InMemory,
    pub(super) there: Path,
    pub(super) back: Path,
    pub(super) epoch: u32,
    pub(super) next_sequence: u64,
    pub(super) payload_bytes: usize,
    pub(super) egress_address: SocketAddr,
    pub(super) delivered: Vec<Delivered>,
    pub(super) dispositions: Vec<Result<Disposition, Refusal>>,
    pub(super) events: Vec<Result<EgressEvent, Refusal>>,
}

impl Lab {
    pub(super) fn new(seed: u64, payload_bytes: u32, impairment: Impairment) -> Self {
        Self {
            now_ns: 1_000_000_000,
            egress: EgressBridge::new(egress_settings(100, payload_bytes)).unwrap(),
            ingress: Some(IngressBridge::new(ingress_settings(200, payload_bytes)).unwrap()),
            memory: InMemory::default(),
            there: Path::new(seed, "there", impairment),
            back: Path::new(seed, "back", impairment),
            epoch: 1,
            next_sequence: 0,
            payload_bytes: payload_bytes as usize,
            egress_address: "10.0.0.1:4000".parse().unwrap(),
            delivered: Vec::new(),
            dispositions: Vec::new(),
            events: Vec::new(),
        }
    }

    pub(super) fn egress_now(&self) -> Instant {
        Instant::from_ns(self.now_ns + OFFSET_NS)
    }

    pub(super) fn payload(sequence: u64, length: usize) -> Vec<u8> {
        let mut random = RandomStream::new(sequence, "payload");
        (0..length)
            .map(|_| random.next_u64().to_le_bytes()[0])
            .collect()
    }

    /// The producer publishes its next message.
    pub(super) fn publish(&mut self) -> Result<(), LocalRefusal> {
        let envelope = Envelope {
            sequence: self.next_sequence,
            published_ns: self.egress_now().as_ns() - 2000,
            epoch: self.epoch,
            ..Envelope::default()
        };
        let payload = Self::payload(self.next_sequence, self.payload_bytes);
        self.next_sequence += 1;
        let result = self
            .egress
            .on_local(self.egress_now(), 0, &envelope, &payload);
        self.drain_egress();
        result
    }

    pub(super) fn drain_egress(&mut self) {
        let now = self.egress_now();
        while let Some(transmit) = self.egress.poll_transmit(now) {
            let (kind, channel, sequence) = (transmit.kind, transmit.channel, transmit.sequence);
            assert!(transmit.datagram.len() + 16 <= 1472);
            let is_last = transmit.is_last_fragment;
            if self.ingress.is_none() {
                // The host is up but nobody listens: the kernel says so.
                self.egress
                    .on_transmit_failed(now, TransmitFailure::PeerUnreachable);
                continue;
            }
            let bytes = transmit.datagram;
            self.there.offer(self.now_ns, self.egress_address, bytes);
            if is_last {
                self.egress
                    .on_transmit_stamp(kind, channel, sequence, TX_NS);
            }
        }
    }

    fn step_ingress(&mut self) {
        let now = Instant::from_ns(self.now_ns);
        let arrived = self.there.take(self.now_ns);
        let Some(ingress) = &mut self.ingress else {
            return;
        };
        for datagram in arrived {
            let arrival = ArrivalStamps {
                received_ns: datagram.at_ns,
                received_source: StampSource::KernelSoftware,
                peer: Some(datagram.from),
            };
            let delivered = &mut self.delivered;
            let mut destination = self.memory.with(|one, payload| {
                delivered.push(Delivered {
                    message: one.message,
                    payload: payload.to_vec(),
                    order: one.order,
                    follow_up: one.follow_up.map(|f| (f.sequence, f.handed_to_tx_ns)),
                });
            });
            let disposition = ingress.on_datagram(now, arrival, &datagram.bytes, &mut destination);
            self.dispositions.push(disposition);
            let mut replies = 0;
            while let Some(reply) = ingress.poll_transmit(now) {
                assert!(reply.datagram.len() <= datagram.bytes.len());
                assert_eq!(reply.destination, Some(datagram.from));
                let from = "10.0.0.2:5000".parse().unwrap();
                let (kind, sequence) = (reply.kind, reply.sequence);
                self.back.offer(self.now_ns, from, reply.datagram);
                ingress.on_transmit_stamp(kind, sequence, TX_NS);
                replies += 1;
            }
            assert!(replies <= 1, "one request, one reply");
        }
        let counts = ingress.counts();
        assert_eq!(
            counts.datagram_count,
            counts.accepted_count() + ingress.refusals().total()
        );
    }

    pub(super) fn step(&mut self) {
        self.now_ns += STEP_NS;
        self.drain_egress();
        self.step_ingress();
        for datagram in self.back.take(self.now_ns) {
            let arrival = ArrivalStamps {
                received_ns: datagram.at_ns + OFFSET_NS,
                received_source: StampSource::KernelSoftware,
                peer: Some(datagram.from),
            };
            let now = self.egress_now();
            let event = self.egress.on_datagram(now, arrival, &datagram.bytes);
            self.events.push(event);
        }
        let counts = self.egress.counts();
        let refused = self.egress.refusals().total();
        assert_eq!(counts.reply_count, counts.reply_accepted_count + refused);
        let counts = self.egress.channel_counts(0);
        assert_eq!(
            counts.offered_count,
            counts.sent_count + counts.message_failed_count + counts.refused_count()
        );
    }

    pub(super) fn run_ms(&mut self, ms: i64) {
        let end = self.now_ns + ms * 1_000_000;
        while self.now_ns < end {
            self.step();
        }
    }

    /// Publishes at 1 kHz; every refusal is only counted.
    pub(super) fn publish_for_ms(&mut self, ms: i64) {
        for _ in 0..ms {
            let _refused = self.publish();
            self.run_ms(1);
        }
    }

    pub(super) fn ingress(&self) -> &IngressBridge {
        self.ingress.as_ref().unwrap()
    }
}
