//! From packets to observations: which followed datagram was seen at which point, and when. A point
//! is an interface of a file, a port of a switch that names ports (ET2000), and a direction. What
//! was seen at two points is compared in [`super::join`].

use std::collections::BTreeMap;
use std::net::SocketAddr;

use serde::{Deserialize, Serialize};

use super::flow::{DatagramIdentity, FlowFilter, FlowKind, Unidentified};
use super::link::{NoDatagram, udp_datagram};
use super::{CaptureInterface, CapturedPacket, esl};
use hil_net::{Direction, link_type};

/// A place where datagrams were seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Point {
    /// Which file.
    pub file_index: usize,
    /// Which interface of it.
    pub interface_index: usize,
    /// Which port of an ET2000; its stamps are on that device's clock.
    pub esl_port: Option<u8>,
    /// Which way.
    pub direction: Direction,
}

/// Datagrams that go one way between two sockets and count together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Stream {
    /// Which of the filters it met first.
    pub flow_index: usize,
    /// Where from.
    pub source: SocketAddr,
    /// Where to.
    pub destination: SocketAddr,
    /// Of our own: channel number and kind.
    pub own: Option<(u16, u8)>,
}

impl Stream {
    /// The kind of our own datagrams, in the words of the wire format.
    pub fn kind_label(&self) -> Option<&'static str> {
        let (_, kind) = self.own?;
        Some(match kind {
            1 => "DATA",
            2 => "SYNC_REQ",
            3 => "SYNC_RSP",
            4 => "HELLO",
            5 => "HELLO_ACK",
            _ => "BYE",
        })
    }
}

/// A datagram seen at a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Observation {
    /// When, nanoseconds on the point's clock.
    pub stamp_ns: i64,
    /// Bytes of its UDP payload.
    pub payload_bytes: u32,
    /// By what it is known.
    pub identity: DatagramIdentity,
}

/// A time on a point's clock, nanoseconds, both ends included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Span {
    /// When it begins.
    pub first_ns: i64,
    /// When it ends.
    pub last_ns: i64,
}

/// What was seen at one point.
#[derive(Debug, Clone, Default)]
pub struct Seen {
    /// Stamps of the first and last packet of any kind, in time.
    pub span: Option<Span>,
    /// Observations by stream, in the order of the file.
    pub streams: BTreeMap<Stream, Vec<Observation>>,
}

/// What was met on the way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct PacketCounts {
    /// Packets in all.
    pub packet_count: u64,
    /// Of a followed flow.
    pub followed_count: u64,
    /// UDP of other flows.
    pub other_flow_count: u64,
    /// With the addresses of a flow, but of another protocol.
    pub foreign_count: u64,
    /// Of a flow, but captured too short to be known again.
    pub unidentified_count: u64,
    /// First fragments of a followed datagram: the time is that of the first piece.
    pub fragmented_count: u64,
    /// Not IP.
    pub not_ip_count: u64,
    /// Not UDP.
    pub not_udp_count: u64,
    /// Later fragments of any datagram.
    pub later_fragment_count: u64,
    /// Headers cut short or malformed, or of an unknown link layer.
    pub unreadable_count: u64,
    /// Without a time stamp.
    pub stampless_count: u64,
    /// Earlier than the packet before it at the same point: a file out of order.
    pub backward_stamp_count: u64,
    /// With the header of an ET2000.
    pub esl_count: u64,
    /// Of those, damaged according to the device (frame check sequence or alignment).
    pub esl_damaged_count: u64,
    /// Of those, with no port or several named.
    pub esl_port_unclear_count: u64,
}

/// Takes packets and keeps what is followed.
#[derive(Debug, Default)]
pub struct Observer {
    flows: Vec<FlowFilter>,
    seen: BTreeMap<Point, Seen>,
    counts: PacketCounts,
}

impl Observer {
    /// An observer of these flows; a datagram belongs to the first one it meets.
    pub fn new(flows: &[FlowFilter]) -> Self {
        Self {
            flows: flows.to_vec(),
            ..Self::default()
        }
    }

    /// Takes a packet of a file.
    pub fn take(&mut self, file_index: usize, packet: &CapturedPacket<'_>) {
        self.counts.packet_count += 1;
        let mut point = Point {
            file_index,
            interface_index: packet.interface_index,
            esl_port: None,
            direction: packet.direction,
        };
        let (mut frame, mut stamp_ns) = (packet.data, packet.stamp_ns);
        if packet.link_type == link_type::ETHERNET
            && let Some((header, inner)) = esl::split(frame)
        {
            self.counts.esl_count += 1;
            self.counts.esl_damaged_count += u64::from(header.is_damaged());
            self.counts.esl_port_unclear_count += u64::from(header.port_count() != 1);
            frame = inner;
            point.esl_port = header.port();
            stamp_ns = i64::try_from(header.stamp_ns).ok();
        }
        let counts = &mut self.counts;
        let Some(stamp_ns) = stamp_ns else {
            counts.stampless_count += 1;
            return;
        };
        let seen = self.seen.entry(point).or_default();
        let span = seen.span.get_or_insert(Span {
            first_ns: stamp_ns,
            last_ns: stamp_ns,
        });
        counts.backward_stamp_count += u64::from(stamp_ns < span.last_ns);
        span.first_ns = span.first_ns.min(stamp_ns);
        span.last_ns = span.last_ns.max(stamp_ns);
        let datagram = match udp_datagram(packet.link_type, frame) {
            Ok(datagram) => datagram,
            Err(reason) => {
                *match reason {
                    NoDatagram::NotIp => &mut counts.not_ip_count,
                    NoDatagram::NotUdp => &mut counts.not_udp_count,
                    NoDatagram::LaterFragment => &mut counts.later_fragment_count,
                    NoDatagram::UnknownLinkType | NoDatagram::CutShort | NoDatagram::Malformed => {
                        &mut counts.unreadable_count
                    }
                } += 1;
                return;
            }
        };
        let mut why = None;
        for (flow_index, flow) in self.flows.iter().enumerate() {
            if !flow.has_addresses_of(&datagram) {
                continue;
            }
            match flow.identify(&datagram) {
                Ok(identity) => {
                    counts.followed_count += 1;
                    counts.fragmented_count += u64::from(datagram.is_fragmented);
                    let stream = Stream {
                        flow_index,
                        source: datagram.source,
                        destination: datagram.destination,
                        own: identity.own.map(|own| (own.channel, own.kind as u8)),
                    };
                    seen.streams.entry(stream).or_default().push(Observation {
                        stamp_ns,
                        payload_bytes: u32::try_from(datagram.payload_bytes).unwrap_or(u32::MAX),
                        identity,
                    });
                    return;
                }
                // Following our own means looking at everything: what is not ours belongs to no flow.
                Err(Unidentified::Foreign) if flow.kind == FlowKind::Hil => {}
                Err(reason) => why = Some(reason),
            }
        }
        *match why {
            None => &mut counts.other_flow_count,
            Some(Unidentified::Foreign) => &mut counts.foreign_count,
            Some(Unidentified::CutShort) => &mut counts.unidentified_count,
        } += 1;
    }

    /// The flows followed.
    pub fn flows(&self) -> &[FlowFilter] {
        &self.flows
    }

    /// What was counted so far.
    pub const fn counts(&self) -> &PacketCounts {
        &self.counts
    }

    /// What was seen so far at each point.
    pub const fn seen(&self) -> &BTreeMap<Point, Seen> {
        &self.seen
    }

    /// Widens the time a point was watched to what its file says, after the last packet of the file;
    /// it may have been watching longer than its packets tell.
    /// An interface of which the file has no packet but tells how long it was watched has points too.
    pub fn widen(&mut self, file_index: usize, interfaces: &[CaptureInterface]) {
        for (interface_index, interface) in interfaces.iter().enumerate() {
            let (Some(start), Some(end)) = (interface.start_ns, interface.end_ns) else {
                continue;
            };
            // Its packets are those of another interface once more, on another clock.
            if interface.has_nic_clock() {
                continue;
            }
            let has_other_points = self.seen.keys().any(|one| {
                (one.file_index, one.interface_index) == (file_index, interface_index)
                    && (one.esl_port.is_some() || one.direction == Direction::Unknown)
            });
            if has_other_points {
                continue;
            }
            for direction in [Direction::Inbound, Direction::Outbound] {
                let point = Point {
                    file_index,
                    interface_index,
                    esl_port: None,
                    direction,
                };
                let seen = self.seen.entry(point).or_default();
                seen.span.get_or_insert(Span {
                    first_ns: start,
                    last_ns: end,
                });
            }
        }
        for (point, seen) in &mut self.seen {
            if point.file_index == file_index
                && point.esl_port.is_none()
                && let Some(interface) = interfaces.get(point.interface_index)
                && let Some(span) = &mut seen.span
            {
                span.first_ns = span.first_ns.min(interface.start_ns.unwrap_or(i64::MAX));
                span.last_ns = span.last_ns.max(interface.end_ns.unwrap_or(i64::MIN));
            }
        }
    }
}
