//! A gateway pair in one thread, with a network between them that does what the input says: loses,
//! copies, reorders, delays, damages, and lets strangers speak. Producer and sending gateway may
//! start anew.
//!
//! As long as nobody forges or damages anything, no message is delivered twice, each is delivered as
//! it was published, and at the end everything sent is accounted for. Whatever happens, each datagram
//! is counted once, and no answer is longer than what it answers.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::time::Duration;

use hil_core::message::Envelope;
use hil_core::time::Instant;
use hil_protocol::wire::decode;
use hil_protocol::{
    ArrivalStamps, ChannelIdentity, EgressBridge, EgressSettings, FlowIdentity, InMemory,
    IngressBridge, IngressSettings, lab,
};

use crate::Verdict;
use crate::input::Input;

const SENDER: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::new(10, 0, 0, 1)), 9);
const RECEIVER: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::new(10, 0, 0, 2)), 9);
const SIZE_MAX_BYTES: u32 = 3000;
const SIZE_SHORT_BYTES: u32 = 400;
/// Datagrams under way one way; more are lost.
const PATH_LENGTH: usize = 32;
/// More steps than any interesting input has.
const STEPS_MAX: usize = 512;

/// Makes bridges as a gateway would for the same flow: a channel whose messages may come in pieces, and one
/// whose never do.
fn flow() -> FlowIdentity {
    FlowIdentity {
        flow: 65_535,
        name: "hil/link/hop/forward".to_owned(),
        channels: vec![
            ChannelIdentity::new(3, "arm/command", "test.Command.v1", SIZE_MAX_BYTES, 8),
            ChannelIdentity::new(5, "arm/mode", "test.Mode.v1", SIZE_SHORT_BYTES, 8),
        ],
    }
}

pub(crate) fn egress(session: u32) -> EgressBridge {
    let settings = EgressSettings {
        flow: flow(),
        ..lab::egress_settings(session, SIZE_MAX_BYTES)
    };
    EgressBridge::new(settings).expect("the settings are fixed")
}

pub(crate) fn ingress() -> IngressBridge {
    let settings = IngressSettings {
        flow: flow(),
        ..lab::ingress_settings(200, SIZE_MAX_BYTES)
    };
    IngressBridge::new(settings).expect("the settings are fixed")
}

struct Conversation {
    now: Instant,
    egress: EgressBridge,
    ingress: IngressBridge,
    memory: InMemory,
    forward: VecDeque<Vec<u8>>,
    backward: VecDeque<Vec<u8>>,
    session: u32,
    epoch: u32,
    sequence: u64,
    /// What was published, by channel, start of the producer and number.
    published: BTreeMap<(usize, u32, u64), Vec<u8>>,
    delivered: BTreeSet<(usize, u32, u64)>,
    /// Bytes came that no gateway made.
    is_forged: bool,
    handed_to_ingress: u64,
    handed_to_egress: u64,
}

impl Conversation {
    fn new() -> Self {
        Self {
            now: Instant::from_ns(50_000_000_000),
            egress: egress(100),
            ingress: ingress(),
            memory: InMemory::default(),
            forward: VecDeque::new(),
            backward: VecDeque::new(),
            session: 100,
            epoch: 1,
            sequence: 0,
            published: BTreeMap::new(),
            delivered: BTreeSet::new(),
            is_forged: false,
            handed_to_ingress: 0,
            handed_to_egress: 0,
        }
    }

    fn step(&mut self, input: &mut Input<'_>) {
        let code = input.byte();
        let argument = usize::from(input.byte());
        match code % 12 {
            0 | 1 => self.publish(argument),
            2 => self.now = self.now + Duration::from_micros(10 << (argument % 14)),
            3 => self.arrive_forward(argument, false),
            4 => self.arrive_backward(argument, false),
            5 => self.arrive_forward(argument, true),
            6 => self.arrive_backward(argument, true),
            7 => drop(self.forward.pop_front()),
            8 => drop(self.backward.pop_front()),
            9 => self.damage(argument, input),
            10 => self.inject(argument, input),
            _ => self.restart(argument),
        }
        self.exchange_pending();
    }

    fn publish(&mut self, argument: usize) {
        // Most fit into a datagram, some take two or three; every third goes to the other channel, which
        // refuses what is too long for it.
        let channel = usize::from(argument.is_multiple_of(3));
        let length = if argument < 200 {
            argument
        } else {
            argument * 12
        };
        let payload: Vec<u8> = (0..length)
            .map(|at| (at as u64 ^ self.sequence ^ u64::from(self.epoch)).to_le_bytes()[0])
            .collect();
        let envelope = Envelope {
            sequence: self.sequence,
            published_ns: self.now.as_ns(),
            epoch: self.epoch,
            ..Envelope::default()
        };
        let key = (channel, self.epoch, self.sequence);
        self.sequence += 1;
        // A refusal is counted by the bridge; then nothing leaves.
        let staged = self.egress.on_local(self.now, channel, &envelope, &payload);
        if staged.is_ok() {
            self.published.insert(key, payload);
        }
    }

    /// What either bridge wants to send goes onto its path.
    fn exchange_pending(&mut self) {
        for _ in 0..8 {
            let Some(transmit) = self.egress.poll_transmit(self.now) else {
                break;
            };
            let key = transmit.key;
            let bytes = transmit.datagram.to_vec();
            assert!(decode(&bytes).is_ok(), "a gateway sends what is refused");
            self.egress.on_transmit_stamp(key, 700);
            if self.forward.len() < PATH_LENGTH {
                self.forward.push_back(bytes);
            }
        }
        while let Some(reply) = self.ingress.poll_transmit(self.now) {
            assert!(
                decode(reply.datagram).is_ok(),
                "a gateway answers what is refused"
            );
            if self.backward.len() < PATH_LENGTH {
                self.backward.push_back(reply.datagram.to_vec());
            }
        }
    }

    /// The datagram at `place` arrives, whatever its turn; `is_copied`: and stays on its way.
    fn arrive_forward(&mut self, place: usize, is_copied: bool) {
        let Some(bytes) = pick(&mut self.forward, place, is_copied) else {
            return;
        };
        self.offer_ingress(&bytes);
    }

    fn arrive_backward(&mut self, place: usize, is_copied: bool) {
        let Some(bytes) = pick(&mut self.backward, place, is_copied) else {
            return;
        };
        self.offer_egress(&bytes);
    }

    fn offer_ingress(&mut self, bytes: &[u8]) {
        self.handed_to_ingress += 1;
        let arrival = ArrivalStamps {
            peer: Some(SENDER),
            ..ArrivalStamps::application(self.now.as_ns())
        };
        let (published, delivered) = (&self.published, &mut self.delivered);
        let is_forged = self.is_forged;
        let mut destination = self.memory.with(|delivery, payload| {
            assert!(payload.len() <= SIZE_MAX_BYTES as usize);
            let message = delivery.message;
            let key = (message.channel, message.epoch, message.sequence);
            if is_forged {
                return;
            }
            assert!(delivered.insert(key), "{key:?} was delivered twice");
            let sent = published.get(&key).map(Vec::as_slice);
            assert_eq!(Some(payload), sent, "{key:?} is another message");
        });
        let taken = self
            .ingress
            .on_datagram(self.now, arrival, bytes, &mut destination);
        // Either is counted by the bridge, which is checked at the end.
        let (Ok(_) | Err(_)) = taken;
        while let Some(reply) = self.ingress.poll_transmit(self.now) {
            assert!(reply.datagram.len() <= bytes.len(), "an answer amplifies");
            self.backward.push_back(reply.datagram.to_vec());
        }
        self.backward.truncate(PATH_LENGTH);
    }

    fn offer_egress(&mut self, bytes: &[u8]) {
        self.handed_to_egress += 1;
        let arrival = ArrivalStamps {
            peer: Some(RECEIVER),
            ..ArrivalStamps::application(self.now.as_ns())
        };
        let _counted = self.egress.on_datagram(self.now, arrival, bytes);
    }

    fn damage(&mut self, place: usize, input: &mut Input<'_>) {
        let (path, at, value) = (place & 1, usize::from(input.short()), input.byte());
        let path = [&mut self.forward, &mut self.backward][path].front_mut();
        if let Some(bytes) = path {
            let at = at % bytes.len().max(1);
            bytes[at] ^= value.max(1);
            self.is_forged = true;
        }
    }

    fn inject(&mut self, place: usize, input: &mut Input<'_>) {
        let length = usize::from(input.short()) % 200;
        let bytes = input.take(length);
        self.is_forged = true;
        if place & 1 == 0 {
            self.offer_ingress(bytes);
        } else {
            self.offer_egress(bytes);
        }
    }

    fn restart(&mut self, what: usize) {
        if what & 1 == 0 {
            // A producer: its numbers begin again under another start.
            self.epoch += 1;
            self.sequence = 0;
            return;
        }
        if what & 2 != 0 {
            self.egress.bye();
            self.exchange_pending();
        }
        self.settle_egress();
        self.session += 1;
        self.egress = egress(self.session);
        self.handed_to_egress = 0;
        // A process takes longer to start than anything stays on this cable.
        self.now = self.now + Duration::from_millis(1);
    }

    fn settle_egress(&self) {
        let counts = *self.egress.counts();
        assert_eq!(counts.reply_count, self.handed_to_egress);
        let refused = self.egress.refusals().total();
        assert_eq!(counts.reply_count, counts.reply_accepted_count + refused);
    }

    fn settle(mut self) -> Verdict {
        self.settle_egress();
        let counts = *self.ingress.counts();
        assert_eq!(counts.datagram_count, self.handed_to_ingress);
        let refused = self.ingress.refusals().total();
        assert_eq!(counts.datagram_count, counts.accepted_count() + refused);
        self.ingress.finish();
        let mut delivered_count = 0;
        for channel in 0..flow().channels.len() {
            let counts = *self.ingress.channel_counts(channel);
            delivered_count += counts.delivered_count;
            if !self.is_forged {
                let seen = self.ingress.sequence_counts(channel).received_count;
                assert_eq!(seen, counts.delivered_count, "received and not delivered");
            }
        }
        if !self.is_forged {
            assert_eq!(delivered_count, self.delivered.len() as u64);
        }
        Verdict::of(delivered_count > 0)
    }
}

fn pick(path: &mut VecDeque<Vec<u8>>, place: usize, is_copied: bool) -> Option<Vec<u8>> {
    let place = place % path.len().max(1);
    if is_copied {
        path.get(place).cloned()
    } else {
        path.remove(place)
    }
}

/// See the file's documentation.
pub(crate) fn conversation(bytes: &[u8]) -> Verdict {
    let mut input = Input::new(bytes);
    let mut conversation = Conversation::new();
    for _ in 0..STEPS_MAX {
        if input.is_empty() {
            break;
        }
        conversation.step(&mut input);
    }
    conversation.settle()
}
