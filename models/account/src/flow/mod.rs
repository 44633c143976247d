//! The frames of a channel by flow: which program spoke with which, counted, lost and delayed. A flow is what the
//! head of a frame says: addresses and ports of TCP and UDP, addresses of any other protocol over IP, and the
//! protocol of anything else. It appears by itself, one way at a time; a filter gives several of them a name.
//! Frames are not put together.

mod deadline;
mod filter;

pub use deadline::{DeadlineFold, DeadlineMetrics, FrameEnd, FramePassage};
pub use filter::{FilterError, FlowFilter};

use core::fmt;
use core::net::IpAddr;
use std::collections::BTreeMap;

use hil_core::record::{FrameRecord, stamp};
use hil_stats::histogram::Distribution;
use hil_stats::reordering::reordered;
use serde::{Deserialize, Serialize};

use crate::history::MessageHistory;
use crate::network::Crossing;
use crate::stage::MessageFate;
use crate::{AccountContext, PathProcess};

/// Flows of a channel that are told apart; what comes later is one.
pub const FLOWS_MAX: usize = 10_000;

/// VLAN tags that are passed over.
const TAGS_MAX: usize = 2;
const TCP: u8 = 6;
const UDP: u8 = 17;
const UNKNOWN: u32 = u32::MAX;

/// What a frame belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum FlowKey {
    /// IP.
    Ip {
        /// Number of the protocol in it.
        protocol: u8,
        /// Where from.
        source: IpAddr,
        /// Where to.
        destination: IpAddr,
        /// Source and destination port; `None` of a protocol without them, and of the later fragments of a
        /// datagram.
        ports: Option<[u16; 2]>,
    },
    /// Anything else, by its type.
    Other(u16),
    /// A frame too short to say what it is.
    TooShort,
    /// Of a flow beyond [`FLOWS_MAX`].
    Rest,
    /// Of a frame that left no record of its own, as the last ones of a process that was killed.
    Unrecorded,
}

/// A flow that has a name.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedFlow {
    /// It.
    pub name: String,
    /// Which frames it has.
    pub filter: FlowFilter,
    /// Within what time of each an answer must come back, nanoseconds.
    pub deadline_ns: Option<i64>,
}

impl FlowKey {
    /// Of a frame.
    pub fn of(record: &FrameRecord) -> Self {
        let head = record.head.get(..usize::from(record.head_bytes));
        Self::read(head.unwrap_or(&record.head)).unwrap_or(Self::TooShort)
    }

    const fn has_ports(&self) -> bool {
        matches!(self, Self::Ip { ports: Some(_), .. })
    }

    /// Of the frames that go back; `None` where these have no ends of their own, as behind frames to many.
    pub fn reversed(self) -> Option<Self> {
        let is_of_many = |address: IpAddr| match address {
            IpAddr::V4(address) => address.is_multicast() || address.is_broadcast(),
            IpAddr::V6(address) => address.is_multicast(),
        };
        match self {
            Self::Ip {
                protocol,
                source,
                destination,
                ports,
            } if !is_of_many(destination) => Some(Self::Ip {
                protocol,
                source: destination,
                destination: source,
                ports: ports.map(|[from, to]| [to, from]),
            }),
            Self::Ip { .. } | Self::Other(_) | Self::TooShort | Self::Rest | Self::Unrecorded => {
                None
            }
        }
    }

    fn read(frame: &[u8]) -> Option<Self> {
        let (kind, packet) = packet_of(frame)?;
        match kind {
            0x0800 => ipv4(packet),
            0x86dd => ipv6(packet),
            _ => Some(Self::Other(kind)),
        }
    }
}

/// Type and content of a frame behind its tags.
fn packet_of(frame: &[u8]) -> Option<(u16, &[u8])> {
    let mut at = 12;
    let mut kind = u16_at(frame, at)?;
    for _ in 0..TAGS_MAX {
        if matches!(kind, 0x8100 | 0x88a8 | 0x9100) {
            at += 4;
            kind = u16_at(frame, at)?;
        }
    }
    Some((kind, frame.get(at + 2..)?))
}

/// What a TCP segment brings to its stream (RFC 9293, section 3.1).
struct Segment {
    /// Number of its first byte.
    number: u32,
    /// How many.
    byte_count: u32,
    /// It begins a stream.
    begins: bool,
}

/// The segment of a whole IPv4 packet; over IPv6 the head that is kept of a frame is too short for one.
fn tcp_segment(frame: &[u8]) -> Option<Segment> {
    const SYN: u8 = 0x02;
    const FRAGMENT: u16 = 0x3fff;
    let (kind, packet) = packet_of(frame)?;
    if kind != 0x0800 || *packet.get(9)? != TCP || u16_at(packet, 6)? & FRAGMENT != 0 {
        return None;
    }
    let header_bytes = usize::from(packet.first()? & 0x0f) * 4;
    let segment = packet.get(header_bytes..)?;
    let data_at = header_bytes + usize::from(*segment.get(12)? >> 4) * 4;
    let byte_count = usize::from(u16_at(packet, 2)?).checked_sub(data_at)?;
    Some(Segment {
        number: u32::from_be_bytes(array_at(segment, 4)?),
        byte_count: u32::try_from(byte_count).ok()?,
        begins: segment.get(13)? & SYN != 0,
    })
}

fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_be_bytes(array_at(bytes, at)?))
}

fn array_at<const N: usize>(bytes: &[u8], at: usize) -> Option<[u8; N]> {
    bytes.get(at..at.checked_add(N)?)?.try_into().ok()
}

fn ipv4(packet: &[u8]) -> Option<FlowKey> {
    let header_bytes = usize::from(packet.first()? & 0x0f) * 4;
    let (protocol, is_later) = (*packet.get(9)?, u16_at(packet, 6)? & 0x1fff != 0);
    Some(FlowKey::Ip {
        protocol,
        source: array_at::<4>(packet, 12)?.into(),
        destination: array_at::<4>(packet, 16)?.into(),
        ports: ports(protocol, packet.get(header_bytes..)).filter(|_| !is_later),
    })
}

fn ipv6(packet: &[u8]) -> Option<FlowKey> {
    let (mut protocol, mut at, mut is_later) = (*packet.get(6)?, 40, false);
    // Hop-by-hop options, routing, fragment, destination options.
    while let (0 | 43 | 44 | 60, Some(header)) = (protocol, array_at::<4>(packet, at)) {
        if protocol == 44 {
            is_later = u16::from_be_bytes([header[2], header[3]]) & 0xfff8 != 0;
            at += 8;
        } else {
            at += 8 * (1 + usize::from(header[1]));
        }
        protocol = header[0];
    }
    Some(FlowKey::Ip {
        protocol,
        source: array_at::<16>(packet, 8)?.into(),
        destination: array_at::<16>(packet, 24)?.into(),
        ports: ports(protocol, packet.get(at..)).filter(|_| !is_later),
    })
}

fn ports(protocol: u8, segment: Option<&[u8]>) -> Option<[u16; 2]> {
    let segment = segment.filter(|_| matches!(protocol, TCP | UDP))?;
    Some([u16_at(segment, 0)?, u16_at(segment, 2)?])
}

impl fmt::Display for FlowKey {
    /// `udp 10.77.0.1:5000 → 10.77.0.2:6510`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Ip {
                protocol,
                source,
                destination,
                ports,
            } => {
                match protocol {
                    1 => f.write_str("icmp"),
                    2 => f.write_str("igmp"),
                    TCP => f.write_str("tcp"),
                    UDP => f.write_str("udp"),
                    58 => f.write_str("icmpv6"),
                    other => write!(f, "ip protocol {other}"),
                }?;
                match (ports, source) {
                    (Some([from, to]), IpAddr::V4(_)) => {
                        write!(f, " {source}:{from} → {destination}:{to}")
                    }
                    (Some([from, to]), IpAddr::V6(_)) => {
                        write!(f, " [{source}]:{from} → [{destination}]:{to}")
                    }
                    (None, _) => write!(f, " {source} → {destination}"),
                }?;
                if ports.is_none() && matches!(protocol, TCP | UDP) {
                    f.write_str(" (fragments without ports)")?;
                }
                Ok(())
            }
            Self::Other(0x0806) => f.write_str("arp"),
            Self::Other(kind) => write!(f, "ethernet type {kind:#06x}"),
            Self::TooShort => f.write_str("too short to tell"),
            Self::Rest => f.write_str("all other flows"),
            Self::Unrecorded => f.write_str("frames without a record of their own"),
        }
    }
}

/// One flow of a channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FlowMetrics {
    /// What it is, in words.
    pub name: String,
    /// Frames that the program sent.
    pub frame_count: u64,
    /// Their bytes.
    pub byte_count: u64,
    /// Frames that the other program's interface was given.
    pub taken_count: u64,
    /// Frames that got lost between the gateways.
    pub lost_by_network_count: u64,
    /// Frames that got lost on the link or for want of room on the receiving host, whose counts do not say which.
    #[serde(default)]
    pub lost_by_either_count: u64,
    /// Frames that got lost on a host: in a queue, a socket or a process of this program.
    pub lost_by_harness_count: u64,
    /// Frames whose fate is unknown, those under way at the end included.
    pub unknown_count: u64,
    /// Frames that came after a later one of the flow (RFC 4737, section 3.3); `None` where it is not known when frames
    /// came.
    pub reordered_count: Option<u64>,
    /// Largest extent of these: the places that a buffer needs to restore the order (section 4.2).
    #[serde(default)]
    pub reordered_extent_max: Option<u64>,
    /// Of TCP over IPv4: frames with bytes of the stream that one before had brought, so that the program's kernel
    /// sent them again.
    #[serde(default)]
    pub retransmitted_count: Option<u64>,
    /// From leaving the program's interface until the other's was given it.
    pub delay: Distribution,
}

/// Sums frames up by flow. Memory grows by 32 bytes a frame, and by as many again of flows with a deadline.
#[derive(Debug, Default)]
pub struct FlowFold<'a> {
    named: &'a [NamedFlow],
    indices: BTreeMap<FlowKey, u32>,
    /// The frames of a named flow whose keys are beyond the bound, by the place of its name.
    beyond: BTreeMap<usize, u32>,
    keyed: Vec<Keyed>,
    /// The numbers of the frames in order, each with the place of its key, by the start of its inlet.
    frames: BTreeMap<u32, Vec<(u64, u32)>>,
    flows: Vec<Flow>,
}

/// The frames of flows with a deadline and of those that go back; without any, [`FlowKey::Unrecorded`] where frames are that
/// may be of any of these.
pub type FlowPassages = BTreeMap<FlowKey, Vec<FramePassage>>;

/// Frames of one key.
#[derive(Debug)]
struct Keyed {
    key: FlowKey,
    /// Their flow; one with a name may have several keys.
    flow: usize,
    /// Where a deadline is about them.
    passages: Option<Vec<FramePassage>>,
    /// Of a TCP stream: the number after the last byte that was sent.
    next_byte: Option<u32>,
}

#[derive(Debug, Default)]
struct Flow {
    name: String,
    counts: [u64; 5],
    byte_count: u64,
    retransmitted_count: Option<u64>,
    /// When its frames came to the receiving gateway, in the order in which they were sent.
    arrivals_ns: Vec<i64>,
    delays_ns: Vec<i64>,
}

/// Fate of a frame, by its place among [`Flow::counts`].
const TAKEN: usize = 0;
const BY_NETWORK: usize = 1;
const BY_HARNESS: usize = 2;
const NOT_KNOWN: usize = 3;
const BY_EITHER: usize = 4;

const fn place_of(fate: MessageFate) -> usize {
    if matches!(fate, MessageFate::SupersededAtConsumer) {
        return BY_HARNESS;
    }
    match fate.crossing() {
        Crossing::Arrived => TAKEN,
        Crossing::LostByNetwork | Crossing::Unreachable => BY_NETWORK,
        Crossing::Doubtful => BY_EITHER,
        Crossing::Unknown => NOT_KNOWN,
        Crossing::LostByHost => BY_HARNESS,
    }
}

impl<'a> FlowFold<'a> {
    /// Of a channel; the first of `named` that takes a frame gives its flow the name.
    pub fn new(named: &'a [NamedFlow]) -> Self {
        Self {
            named,
            ..Self::default()
        }
    }

    /// Takes what is known of a frame itself; before [`FlowFold::add`] of its message.
    pub fn add_frame(&mut self, record: &FrameRecord) {
        let index = self.index_of(FlowKey::of(record));
        let frames = self.frames.entry(record.epoch).or_default();
        // An inlet numbers its frames as they come; others are of a damaged file.
        if frames
            .last()
            .is_some_and(|(last, _)| *last >= record.sequence)
        {
            return;
        }
        frames.push((record.sequence, index));
        let keyed = &mut self.keyed[index as usize];
        let flow = &mut self.flows[keyed.flow];
        flow.byte_count += u64::from(record.length_bytes);
        let head = record.head.get(..usize::from(record.head_bytes));
        let segment = head.filter(|_| keyed.key.has_ports()).and_then(tcp_segment);
        if let Some(segment) = segment {
            let count = flow.retransmitted_count.get_or_insert(0);
            if segment.begins {
                keyed.next_byte = None;
            }
            // Numbers come round.
            let is_before = |next: u32| segment.number.wrapping_sub(next).cast_signed() < 0;
            if segment.byte_count > 0 && keyed.next_byte.is_some_and(is_before) {
                *count += 1;
            } else if segment.byte_count > 0 {
                keyed.next_byte = Some(segment.number.wrapping_add(segment.byte_count));
            }
        }
    }

    fn index_of(&mut self, key: FlowKey) -> u32 {
        if let Some(index) = self.indices.get(&key) {
            return *index;
        }
        let named = self.named.iter().position(|one| one.filter.takes(&key));
        let is_beyond = self.indices.len() >= FLOWS_MAX;
        let is_timed = self.is_timed(key);
        // An answer is told by its ends, however many there are; otherwise those beyond the bound are not told apart.
        let next = u32::try_from(self.keyed.len()).unwrap_or(UNKNOWN);
        let (kept, index) = match named.filter(|_| !is_timed) {
            _ if !is_beyond || is_timed || key == FlowKey::Unrecorded => {
                (key, self.indices.entry(key).or_insert(next))
            }
            Some(named) => (FlowKey::Rest, self.beyond.entry(named).or_insert(next)),
            None => (
                FlowKey::Rest,
                self.indices.entry(FlowKey::Rest).or_insert(next),
            ),
        };
        let index = *index;
        if index == next {
            let name = match named {
                Some(named) => self.named[named].name.clone(),
                None if is_beyond && key != FlowKey::Unrecorded => FlowKey::Rest.to_string(),
                None => key.to_string(),
            };
            let is_shared = named.is_some() || is_beyond;
            let mut flows = self.flows.iter();
            let known = flows.position(|flow| is_shared && flow.name == name);
            let flow = known.unwrap_or_else(|| {
                self.flows.push(Flow {
                    name,
                    ..Flow::default()
                });
                self.flows.len() - 1
            });
            self.keyed.push(Keyed {
                key: kept,
                flow,
                passages: (is_timed || key == FlowKey::Unrecorded).then(Vec::new),
                next_byte: None,
            });
        }
        index
    }

    /// Whether a deadline is about frames of `key`, or about those that they may answer.
    fn is_timed(&self, key: FlowKey) -> bool {
        let mut timed = self.named.iter().filter(|one| one.deadline_ns.is_some());
        timed.any(|one| {
            let back = key.reversed();
            one.filter.takes(&key) || back.is_some_and(|back| one.filter.takes(&back))
        })
    }

    /// Takes the fate of a frame.
    pub fn add(&mut self, message: &MessageHistory, context: &AccountContext<'_>) {
        let path = context.path;
        let frames = self
            .frames
            .get(&message.epoch)
            .map_or(&[][..], Vec::as_slice);
        let found = frames.binary_search_by_key(&message.key.sequence, |(sequence, _)| *sequence);
        let index = match found {
            Ok(place) => frames[place].1,
            Err(_) => self.index_of(FlowKey::Unrecorded),
        };
        // Whether a program would have taken a frame that came after its end is unknown.
        let interruption = message
            .interruption_index
            .and_then(|index| context.interruptions.get(index));
        let is_after_end = interruption.is_some_and(|one| one.place == PathProcess::Consumer);
        let place = match message.fate {
            MessageFate::LostInInterruption if is_after_end => NOT_KNOWN,
            fate => place_of(fate),
        };
        let keyed = &mut self.keyed[index as usize];
        if keyed.key != FlowKey::Unrecorded
            && let (Some(passages), Some(sent_ns)) = (&mut keyed.passages, message.published_ns())
        {
            let given_ns = message.taken.and_then(|record| stamp(record.taken_ns));
            let end = match (place, given_ns) {
                (TAKEN, Some(given_ns)) => FrameEnd::Given {
                    at_ns: given_ns,
                    host_ns: message.host_time_ns(path),
                },
                (BY_NETWORK, _) => FrameEnd::LostByNetwork,
                (BY_HARNESS, _) => FrameEnd::LostByHarness,
                _ => FrameEnd::Unknown,
            };
            passages.push(FramePassage { sent_ns, end });
        }
        let flow = &mut self.flows[keyed.flow];
        flow.counts[place] = flow.counts[place].saturating_add(message.count);
        flow.arrivals_ns
            .extend(message.arrived().map(|record| record.received_ns));
        let delay = message.delay_ns(path);
        flow.delays_ns
            .extend(delay.map(|(delay_ns, _bound_ns)| delay_ns));
    }

    /// The flows, those of most frames first, and the frames of those that deadlines are about.
    pub fn finish(mut self) -> (Vec<FlowMetrics>, FlowPassages) {
        // Of a part of a flow's streams there is no figure of the flow.
        for index in self.beyond.values() {
            let flow = self.keyed[*index as usize].flow;
            self.flows[flow].retransmitted_count = None;
        }
        let metrics = |flow: Flow| {
            let [taken, by_network, by_harness, unknown, by_either] = flow.counts;
            let reason = if taken == 0 {
                "no frame was taken"
            } else {
                "the clocks of the hosts are not aligned"
            };
            let mut arrivals: Vec<(i64, u64)> = flow.arrivals_ns.into_iter().zip(0..).collect();
            arrivals.sort_unstable();
            let has_arrivals = !arrivals.is_empty();
            let (reordered, _) = reordered(arrivals.into_iter().map(|(_, number)| number));
            let extent_max = reordered.iter().map(|one| one.extent).max().unwrap_or(0);
            FlowMetrics {
                name: flow.name,
                frame_count: flow.counts.iter().copied().fold(0, u64::saturating_add),
                byte_count: flow.byte_count,
                taken_count: taken,
                lost_by_network_count: by_network,
                lost_by_either_count: by_either,
                lost_by_harness_count: by_harness,
                unknown_count: unknown,
                reordered_count: has_arrivals.then_some(reordered.len() as u64),
                reordered_extent_max: has_arrivals.then_some(extent_max),
                retransmitted_count: flow.retransmitted_count,
                delay: Distribution::of_samples(&flow.delays_ns, reason),
            }
        };
        let mut flows: Vec<FlowMetrics> = self.flows.into_iter().map(metrics).collect();
        flows.sort_by(|one, other| {
            let order = other.frame_count.cmp(&one.frame_count);
            order.then_with(|| one.name.cmp(&other.name))
        });
        let timed = self.keyed.into_iter();
        let timed = timed.filter_map(|one| Some((one.key, one.passages?)));
        (flows, timed.collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{Files, PERIOD_NS, TAKEN_NS, at, same_clock};
    use crate::{ChannelPath, Interruption, each_history};
    use hil_core::time::Instant;

    /// An Ethernet frame of this type with this packet in it.
    fn frame(kind: &[u8], packet: &[u8]) -> Vec<u8> {
        [&[0xff; 12], kind, packet].concat()
    }

    /// An IPv4 packet from 10.77.0.1 to 10.77.0.2.
    fn packet(protocol: u8, fragment: u16, segment: &[u8]) -> Vec<u8> {
        let mut header = vec![0x45, 0, 0, 40, 0, 1];
        header.extend(fragment.to_be_bytes());
        header.extend([64, protocol, 0, 0, 10, 77, 0, 1, 10, 77, 0, 2]);
        [header.as_slice(), segment].concat()
    }

    fn name(frame: &[u8]) -> String {
        FlowKey::of(&FrameRecord::new(0, 1, frame)).to_string()
    }

    #[test]
    fn the_head_of_a_frame_says_its_flow() {
        let ports = [0x13, 0x88, 0x19, 0x6e, 0, 0, 0, 0];
        let ip = [8, 0];
        let udp = "udp 10.77.0.1:5000 → 10.77.0.2:6510";
        assert_eq!(name(&frame(&ip, &packet(17, 0, &ports))), udp);
        assert_eq!(name(&frame(&ip, &packet(17, 0x2000, &ports))), udp);
        let tagged = [0x81, 0, 0, 7, 0x88, 0xa8, 0, 8, 8, 0];
        assert_eq!(name(&frame(&tagged, &packet(17, 0, &ports))), udp);
        assert_eq!(
            name(&frame(&ip, &packet(17, 0x0100, &ports))),
            "udp 10.77.0.1 → 10.77.0.2 (fragments without ports)"
        );
        assert_eq!(
            name(&frame(&ip, &packet(1, 0x0100, &ports))),
            "icmp 10.77.0.1 → 10.77.0.2"
        );
        assert_eq!(
            name(&frame(&ip, &packet(132, 0, &ports))),
            "ip protocol 132 10.77.0.1 → 10.77.0.2"
        );
        assert_eq!(name(&frame(&[8, 6], &[0; 28])), "arp");
        assert_eq!(name(&frame(&[0x88, 0xcc], &[])), "ethernet type 0x88cc");
        assert_eq!(name(&[0; 5]), "too short to tell");
        assert_eq!(name(&frame(&ip, &[0x45])), "too short to tell");
        let mut six = vec![0x60, 0, 0, 0, 0, 8, 6, 64];
        six.extend([0; 15].into_iter().chain([1]).chain([0; 15]).chain([2]));
        six.extend(ports);
        assert_eq!(
            name(&frame(&[0x86, 0xdd], &six)),
            "tcp [::1]:5000 → [::2]:6510"
        );
        six[6] = 0;
        six.splice(40..40, [58, 0, 5, 2, 0, 0, 0, 0]);
        assert_eq!(name(&frame(&[0x86, 0xdd], &six)), "icmpv6 ::1 → ::2");
    }

    #[test]
    fn every_frame_is_counted_once_in_its_flow_and_a_host_is_not_the_network() {
        use MessageFate as Fate;
        let fates = [
            Fate::Taken,
            Fate::Taken,
            Fate::LostOnWire,
            Fate::SupersededAtInput,
            Fate::SupersededAtConsumer,
            Fate::RefusedByKernel,
            Fate::Taken,
            Fate::Taken,
        ];
        let mut files = Files::default();
        let mut fold = FlowFold::default();
        for (sequence, fate) in (0_u64..).zip(fates) {
            files.write(at(7, sequence), fate);
            // The last frame left no record of its own.
            if sequence == 7 {
                continue;
            }
            // The first frame is of another flow.
            let kind = if sequence == 0 { [8, 6] } else { [8, 0] };
            let bytes = frame(&kind, &packet(1, 0, &[0; 20]));
            fold.add_frame(&FrameRecord::new(sequence, at(7, sequence).epoch, &bytes));
        }
        let context = same_clock(1_000_000_000);
        each_history(&files.records(), &context, |one| {
            fold.add(one, &context);
        });
        let (flows, _) = fold.finish();
        let [echoes, arp, unrecorded] = &flows[..] else {
            panic!("three flows: {flows:#?}");
        };
        assert_eq!((unrecorded.frame_count, unrecorded.byte_count), (1, 0));
        assert_eq!(
            (arp.name.as_str(), arp.frame_count, arp.taken_count),
            ("arp", 1, 1)
        );
        assert_eq!((echoes.frame_count, echoes.byte_count), (6, 6 * 54));
        let counts = [
            echoes.taken_count,
            echoes.lost_by_network_count,
            echoes.lost_by_harness_count,
            echoes.unknown_count,
        ];
        assert_eq!(counts, [2, 1, 3, 0]);
        assert_eq!(echoes.delay.measured().unwrap().p50_ns, TAKEN_NS);
    }

    #[test]
    fn what_came_after_the_end_of_the_receiving_program_is_unknown_and_in_a_gateway_down_it_is_the_harness()
     {
        for (place, lost, expected) in [
            (
                PathProcess::Consumer,
                MessageFate::SupersededAtConsumer,
                [6, 0, 0, 4],
            ),
            (
                PathProcess::ReceivingGateway,
                MessageFate::LostOnWire,
                [6, 0, 4, 0],
            ),
        ] {
            let mut files = Files::default();
            let mut fold = FlowFold::default();
            for sequence in 0..10_u64 {
                let fate = if sequence < 6 {
                    MessageFate::Taken
                } else {
                    lost
                };
                files.write(at(7, sequence), fate);
                let bytes = frame(&[8, 0], &packet(1, 0, &[0; 20]));
                fold.add_frame(&FrameRecord::new(sequence, at(7, sequence).epoch, &bytes));
            }
            let interruptions = [Interruption {
                process: "second".to_owned(),
                place,
                from: Instant::from_ns(6 * PERIOD_NS - 1),
                until: Instant::from_ns(10 * PERIOD_NS),
                cause: "killed by SIGSEGV".to_owned(),
            }];
            let context = same_clock(1_000 * PERIOD_NS).with_interruptions(&interruptions);
            each_history(&files.records(), &context, |one| fold.add(one, &context));
            let (flows, _) = fold.finish();
            let counts = [
                flows[0].taken_count,
                flows[0].lost_by_network_count,
                flows[0].lost_by_harness_count,
                flows[0].unknown_count,
            ];
            assert_eq!(counts, expected, "{place:?}");
        }
    }

    #[test]
    fn order_is_that_of_the_flow_and_not_of_the_channel() {
        let mut fold = FlowFold::default();
        let mut files = Files::default();
        for sequence in 0..6_u64 {
            files.write(at(7, sequence), MessageFate::Taken);
            let kind = if sequence % 2 == 0 { [8, 6] } else { [8, 0] };
            let bytes = frame(&kind, &packet(1, 0, &[0; 20]));
            fold.add_frame(&FrameRecord::new(sequence, at(7, sequence).epoch, &bytes));
        }
        // The frames of 0 and 1 change places, which are of two flows; 5 comes before 1 and 3.
        let arrivals = [1, 3, 2, 4, 5, 0].map(|place| 1_000 * place);
        for (record, arrival) in files.ingress.iter_mut().zip(arrivals) {
            record.received_ns = arrival;
        }
        let context = same_clock(1_000_000_000);
        each_history(&files.records(), &context, |one| {
            fold.add(one, &context);
        });
        let (flows, _) = fold.finish();
        let counts = |name: &str| {
            let flow = flows.iter().find(|flow| flow.name == name).unwrap();
            (flow.reordered_count, flow.reordered_extent_max)
        };
        assert_eq!(counts("arp"), (Some(0), Some(0)));
        assert_eq!(counts("icmp 10.77.0.1 → 10.77.0.2"), (Some(2), Some(2)));
    }

    #[test]
    fn bytes_of_a_stream_that_are_sent_again_are_counted() {
        const ACK: u8 = 0x10;
        const SYN: u8 = 0x02;
        let mut fold = FlowFold::default();
        let mut files = Files::default();
        let segments = [
            (u32::MAX - 9, 20_u16, ACK),
            (10, 30, ACK),
            // An acknowledgement alone, of an old number.
            (5, 0, ACK),
            (10, 30, ACK),
            (40, 5, ACK),
            (42, 8, ACK),
            // Another connection between the same ports.
            (7, 0, SYN),
            (8, 5, ACK),
        ];
        for (sequence, (number, length, flags)) in (0..).zip(segments) {
            files.write(at(7, sequence), MessageFate::Taken);
            let segment = [
                &[0, 1, 0, 2][..],
                &number.to_be_bytes(),
                &[0; 4],
                &[0x50, flags, 0, 0],
            ]
            .concat();
            let mut packet = packet(6, 0, &segment);
            packet[2..4].copy_from_slice(&(40 + length).to_be_bytes());
            let bytes = frame(&[8, 0], &packet);
            fold.add_frame(&FrameRecord::new(sequence, at(7, sequence).epoch, &bytes));
        }
        let context = same_clock(1_000_000_000);
        each_history(&files.records(), &context, |one| {
            fold.add(one, &context);
        });
        let (flows, _) = fold.finish();
        assert_eq!((flows.len(), flows[0].retransmitted_count), (1, Some(2)));
    }

    #[test]
    fn a_name_joins_flows_and_its_deadline_has_their_frames_and_those_that_go_back() {
        let named = [NamedFlow {
            name: "command".to_owned(),
            filter: "udp dst port 6510".parse().unwrap(),
            deadline_ns: Some(1),
        }];
        let mut fold = FlowFold::new(&named);
        let mut files = Files::default();
        let ports = [
            [0x13, 0x88, 0x19, 0x6e],
            [0x13, 0x89, 0x19, 0x6e],
            [0x19, 0x6e, 0x13, 0x88],
            [0, 1, 0, 2],
        ];
        for (sequence, ports) in (0..).zip(ports) {
            files.write(at(7, sequence), MessageFate::Taken);
            let bytes = frame(&[8, 0], &packet(17, 0, &[&ports[..], &[0; 4]].concat()));
            fold.add_frame(&FrameRecord::new(sequence, at(7, sequence).epoch, &bytes));
        }
        let context = same_clock(1_000_000_000);
        each_history(&files.records(), &context, |one| {
            fold.add(one, &context);
        });
        let (flows, passages) = fold.finish();
        let command = flows.iter().find(|flow| flow.name == "command").unwrap();
        assert_eq!((flows.len(), command.taken_count), (3, 2));
        let counts: Vec<usize> = passages.values().map(Vec::len).collect();
        assert_eq!(counts, [1, 1, 1]);
        let given = |one: &FramePassage| matches!(one.end, FrameEnd::Given { .. });
        assert!(passages.values().flatten().all(given));
    }

    #[test]
    fn all_time_of_a_path_that_crosses_nothing_is_the_hosts() {
        let context = AccountContext {
            path: ChannelPath::SharedMemory,
            ..same_clock(1_000_000_000)
        };
        let mut count = 0;
        each_history(&Files::delivered(3).records(), &context, |one| {
            let (whole_ns, _bound_ns) = one.delay_ns(context.path).unwrap();
            assert_eq!(one.host_time_ns(context.path), whole_ns);
            count += 1;
        });
        assert_eq!(count, 3);
    }

    /// A UDP frame between two ports.
    fn datagram(from: u16, to: u16) -> Vec<u8> {
        let ports = [&from.to_be_bytes()[..], &to.to_be_bytes(), &[0; 4]].concat();
        frame(&[8, 0], &packet(17, 0, &ports))
    }

    /// The same for a TCP segment of 100 bytes from `number` on.
    fn segment(from: u16, to: u16, number: u32) -> Vec<u8> {
        let mut header = [&from.to_be_bytes()[..], &to.to_be_bytes()].concat();
        header.extend(number.to_be_bytes());
        header.extend([0, 0, 0, 0, 0x50, 0x10, 0, 0, 0, 0, 0, 0]);
        let mut packet = packet(6, 0, &header);
        packet[2..4].copy_from_slice(&140_u16.to_be_bytes());
        frame(&[8, 0], &packet)
    }

    #[test]
    fn beyond_the_bound_answers_are_still_told_apart_and_streams_are_not_mixed() {
        let filter = |text: &str| text.parse().unwrap();
        let named = [
            NamedFlow {
                name: "requests".to_owned(),
                filter: filter("udp dst port 6510"),
                deadline_ns: Some(1_000_000),
            },
            NamedFlow {
                name: "pages".to_owned(),
                filter: filter("tcp dst port 80"),
                deadline_ns: None,
            },
        ];
        let mut fold = FlowFold::new(&named);
        let others = (20_000..).take(FLOWS_MAX).map(|port| datagram(port, 9));
        let timed = [datagram(7, 6510), datagram(6510, 7), datagram(8, 6510)];
        // Two streams take turns.
        let streams = (0..10).flat_map(|index| {
            [
                segment(11, 80, 1_000 + 100 * index),
                segment(12, 80, 900_000 - 200 * index),
            ]
        });
        for (sequence, bytes) in (0..).zip(others.chain(timed).chain(streams)) {
            fold.add_frame(&FrameRecord::new(sequence, 1, &bytes));
        }
        let pages = fold.flows.iter().find(|flow| flow.name == "pages").unwrap();
        assert_eq!(pages.retransmitted_count, None);
        let rest = FlowKey::Rest.to_string();
        let beyond = fold.flows[FLOWS_MAX..].iter().map(|flow| &flow.name);
        assert_eq!(beyond.collect::<Vec<_>>(), ["requests", &rest, "pages"]);
        // Requests of two ends, and the answers to the first.
        let unknown = fold.index_of(FlowKey::Unrecorded);
        assert_eq!(fold.keyed[unknown as usize].key, FlowKey::Unrecorded);
        let (_, mut passages) = fold.finish();
        assert_eq!(passages.remove(&FlowKey::Unrecorded), Some(Vec::new()));
        let keys: Vec<_> = passages.keys().map(ToString::to_string).collect();
        assert_eq!(
            keys,
            [
                "udp 10.77.0.1:7 → 10.77.0.2:6510",
                "udp 10.77.0.1:8 → 10.77.0.2:6510",
                "udp 10.77.0.1:6510 → 10.77.0.2:7",
            ]
        );
    }

    #[test]
    fn flows_beyond_the_bound_are_one() {
        let mut fold = FlowFold::default();
        for sequence in 0..FLOWS_MAX as u64 + 100 {
            let ports = [&sequence.to_be_bytes()[6..], &[0; 6]].concat();
            let bytes = frame(&[8, 0], &packet(17, 0, &ports));
            fold.add_frame(&FrameRecord::new(sequence, 1, &bytes));
        }
        assert_eq!(fold.flows.len(), FLOWS_MAX + 1);
        assert_eq!(fold.keyed.last().unwrap().key, FlowKey::Rest);
    }
}
