//! From packets to observations: which followed datagram was seen at which point, and when. A point
//! is a direction at an interface of a file, at a port of a switch that names ports (ET2000), and at
//! whatever the frame's own headers tell apart: interface of a capture on `any`, VLAN, radio leg. What
//! was seen at two points is compared in [`super::join`]; what a tap could have seen is in
//! [`super::watch`].

use core::cmp::Reverse;
use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::net::{IpAddr, SocketAddr};

use serde::{Deserialize, Serialize};

use super::flow::{DatagramIdentity, FlowFilter, FlowKind, Unidentified};
use super::link::{FramePlace, NoDatagram, UdpDatagram, udp_datagram};
use super::pieces::{Begun, Fragments};
use super::watch::{Tap, Unread, Watch};
use super::{CaptureInterface, CapturedPacket, esl};
use hil_net::{Direction, link_type};

/// A place where datagrams were seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct Point {
    /// Which file.
    pub file_index: usize,
    /// Which interface of it.
    pub interface_index: usize,
    /// Which port of an ET2000; its stamps are on that device's clock.
    pub esl_port: Option<u8>,
    /// Which interface of the host, where one capture is of several.
    pub interface_number: Option<u32>,
    /// In which outer and innermost VLAN, 1..=4095; 0 for none.
    pub vlans: [u16; 2],
    /// Which leg over an access point (`ToDS`, `FromDS`).
    pub radio_leg: Option<(bool, bool)>,
    /// Which way.
    pub direction: Direction,
}

impl Point {
    /// What captured it, on one clock.
    pub const fn tap(&self) -> Tap {
        Tap {
            file_index: self.file_index,
            interface_index: self.interface_index,
            is_esl: self.esl_port.is_some(),
        }
    }

    fn add(&mut self, place: &FramePlace) {
        if self.direction == Direction::Unknown {
            self.direction = place.direction;
        }
        self.interface_number = place.interface_number.or(self.interface_number);
        self.vlans = place.vlans;
        self.radio_leg = place.radio_leg;
    }

    /// The same place, whichever way.
    pub(super) fn place(&self) -> Self {
        Self {
            direction: Direction::Unknown,
            ..*self
        }
    }
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
#[expect(
    clippy::struct_excessive_bools,
    reason = "each is a statement of its own, and any of them may hold"
)]
pub struct Observation {
    /// When, nanoseconds on the point's clock; of a neighbour in the file when it is not sound.
    pub stamp_ns: i64,
    /// False for a stamp that lies by itself, far from all others of its tap.
    pub is_stamp_sound: bool,
    /// The same as if the clock had not been set meanwhile; see [`Watch::steps`].
    pub steady_ns: i64,
    /// Level of its tap's stamps.
    pub(super) level: usize,
    /// Bytes of its UDP payload.
    pub payload_bytes: u32,
    /// Bytes of its IP packet; of the first fragment when there are several.
    pub packet_bytes: u32,
    /// See [`UdpDatagram::packet_number`](super::link::UdpDatagram::packet_number).
    pub packet_number: u16,
    /// Time to live, or hop limit.
    pub hop_limit: u8,
    /// For which station of the link it was.
    pub station: [u8; 6],
    /// See [`UdpDatagram::radio_number`].
    pub radio_number: Option<u16>,
    /// Its later fragments are none of what the capture kept.
    pub lacks_pieces: bool,
    /// In a capture that may be of several links and does not say which: one that is equal passed another link, or
    /// is a duplicate.
    pub is_of_any: bool,
    /// Such a one was seen, and left out.
    pub has_copy: bool,
    /// By what it is known.
    pub identity: DatagramIdentity,
}

/// What was seen at one point: observations by stream, in the order of the file.
pub type Seen = BTreeMap<Stream, Vec<Observation>>;

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
    /// Of a flow, but captured too short, or in fragments, to be known again.
    pub unidentified_count: u64,
    /// Followed datagrams in fragments: the time is that of the first piece.
    pub fragmented_count: u64,
    /// Of those, such as lack a piece while others of their stream came whole: they are not counted as seen.
    pub incomplete_count: u64,
    /// Damaged on the wire, as the file or the device that captured says: they count as not arrived (RFC 7680 section 2.5).
    pub damaged_count: u64,
    /// Not IP.
    pub not_ip_count: u64,
    /// Not UDP.
    pub not_udp_count: u64,
    /// Later fragments of any datagram.
    pub later_fragment_count: u64,
    /// Headers cut short or malformed, sealed, several datagrams in one, or of an unknown link layer.
    pub unreadable_count: u64,
    /// Without a time stamp.
    pub stampless_count: u64,
    /// Sent again by a radio for want of an acknowledgement, and seen before.
    pub radio_retry_count: u64,
    /// Seen just before, for another station or in a cooked capture that does not name interfaces: once
    /// more on another link, not twice on this one. Only by a number of at least 32 bits, or in an IP packet of the
    /// same identification; where packets bear none, by a hop limit that a router changed.
    pub elsewhere_count: u64,
    /// Earlier than the packet before it at the same point: a file out of order.
    pub backward_stamp_count: u64,
    /// With the header of an ET2000.
    pub esl_count: u64,
    /// Of those, damaged according to the device (frame check sequence or alignment); in `damaged_count` too.
    pub esl_damaged_count: u64,
    /// Of those, with no port or several named.
    pub esl_port_unclear_count: u64,
}

/// Tunnels over UDP within one another.
const TUNNEL_DEPTH_MAX: usize = 4;
/// Datagrams among which one that was seen before is looked for.
const COPY_COUNT_MAX: usize = 256;
/// Longest time between two sightings of one datagram on the links of one host, and of one radio frame.
const ELSEWHERE_MAX_NS: u64 = 100_000_000;

/// Takes packets and keeps what is followed.
#[derive(Debug, Default)]
pub struct Observer {
    flows: Vec<FlowFilter>,
    seen: BTreeMap<Point, Seen>,
    watches: BTreeMap<Tap, Watch>,
    /// Packets that a file holds and that could not be read out of it.
    broken: BTreeMap<usize, u64>,
    fragments: Fragments,
    counts: PacketCounts,
    /// Datagrams of no followed flow, by the port they went to.
    other_ports: BTreeMap<u16, u64>,
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
            interface_number: packet.interface_number,
            direction: packet.direction,
            ..Point::default()
        };
        let (mut frame, mut stamp_ns) = (packet.data, packet.stamp_ns);
        let mut original_bytes = packet.original_bytes as usize;
        let mut is_esl_damaged = false;
        if packet.link_type == link_type::ETHERNET
            && let Some((header, inner)) = esl::split(frame)
        {
            self.counts.esl_count += 1;
            is_esl_damaged = header.is_damaged();
            self.counts.esl_damaged_count += u64::from(is_esl_damaged);
            self.counts.esl_port_unclear_count += u64::from(header.port_count() != 1);
            frame = inner;
            original_bytes = original_bytes.saturating_sub(esl::HEADER_BYTES);
            point.esl_port = header.port();
            stamp_ns = i64::try_from(header.stamp_ns).ok();
        }
        let counts = &mut self.counts;
        let watch = self.watches.entry(point.tap()).or_default();
        let Some(stamp_ns) = stamp_ns else {
            counts.stampless_count += 1;
            watch.miss(Unread::NoStamp);
            self.seen.entry(point).or_default();
            return;
        };
        counts.backward_stamp_count += u64::from(watch.stamp(stamp_ns));
        if packet.is_damaged || is_esl_damaged {
            counts.damaged_count += 1;
            self.seen.entry(point).or_default();
            return;
        }
        let flows = &self.flows;
        let is_followed = |datagram: &UdpDatagram<'_>| {
            let mut of_addresses = flows.iter().filter(|flow| flow.has_addresses_of(datagram));
            // Ours may have any address.
            of_addresses.any(|flow| {
                flow.kind != FlowKind::Hil || flow.identify(datagram) != Err(Unidentified::Foreign)
            })
        };
        let mut found = udp_datagram(packet.link_type, frame, original_bytes);
        // Of a tunnel that is not followed itself, what it holds.
        for _ in 0..TUNNEL_DEPTH_MAX {
            let outer = found.ok().filter(|datagram| !is_followed(datagram));
            let Some(inside) = outer.and_then(|datagram| datagram.inside()) else {
                break;
            };
            found = inside;
        }
        let datagram = match found {
            Ok(datagram) => datagram,
            Err(reason) => {
                *match reason {
                    NoDatagram::NotIp => &mut counts.not_ip_count,
                    NoDatagram::NotUdp => &mut counts.not_udp_count,
                    NoDatagram::LaterFragment(fragment) => {
                        if let Some(fragment) = fragment {
                            let mut point = point;
                            point.add(&fragment.place);
                            self.fragments.take(point, &fragment, stamp_ns, None);
                        }
                        &mut counts.later_fragment_count
                    }
                    NoDatagram::Sealed {
                        source,
                        destination,
                        why,
                    } => {
                        watch.miss_sealed(source, destination, why);
                        &mut counts.unreadable_count
                    }
                    NoDatagram::Unread(why) => {
                        watch.miss(why);
                        &mut counts.unreadable_count
                    }
                } += 1;
                self.seen.entry(point).or_default();
                return;
            }
        };
        point.add(&datagram.place);
        let seen = self.seen.entry(point).or_default();
        let mut why = None;
        for (flow_index, flow) in self.flows.iter().enumerate() {
            if !flow.has_addresses_of(&datagram) {
                continue;
            }
            let (source, destination) = (datagram.source, datagram.destination);
            match flow.identify(&datagram) {
                Ok(identity) => {
                    let stream = Stream {
                        flow_index,
                        source,
                        destination,
                        own: identity.own.map(|own| (own.channel, own.kind as u8)),
                    };
                    let list = seen.entry(stream).or_default();
                    let place = &datagram.place;
                    // Another datagram may say the same.
                    let is_doubtful = !identity.is_unique();
                    let number = datagram.packet_number;
                    let is_near =
                        |one: &Observation| stamp_ns.abs_diff(one.stamp_ns) <= ELSEWHERE_MAX_NS;
                    let is_equal = |one: &Observation| one.identity.key == identity.key;
                    if datagram.is_radio_retry
                        && list.iter().rev().take(COPY_COUNT_MAX).any(|one| {
                            is_equal(one)
                                && one.radio_number == datagram.radio_number
                                && is_near(one)
                        })
                    {
                        counts.radio_retry_count += 1;
                        return;
                    }
                    let is_known = |one: &Observation| {
                        is_equal(one) && (!is_doubtful || one.packet_number == number)
                    };
                    let is_elsewhere = |known: &Observation| {
                        let is_routed = !place.is_of_any && datagram.hop_limit != known.hop_limit;
                        (place.is_of_any || place.station != known.station)
                            && (!is_doubtful || number != 0 || is_routed)
                            && is_near(known)
                    };
                    let mut newest = list.iter_mut().rev().take(COPY_COUNT_MAX);
                    let known = newest.find(|one| is_known(one));
                    if let Some(known) = known.filter(|known| is_elsewhere(known)) {
                        known.has_copy |= place.is_of_any;
                        counts.elsewhere_count += 1;
                        return;
                    }
                    counts.followed_count += 1;
                    counts.fragmented_count += u64::from(datagram.is_fragmented());
                    if let Some(fragment) = &datagram.fragment {
                        let begun = Begun {
                            point,
                            stream,
                            index: list.len(),
                            first_ns: stamp_ns,
                            length_ns: None,
                        };
                        let fragments = &mut self.fragments;
                        fragments.take(point, fragment, stamp_ns, Some(begun));
                    }
                    let bytes = |count| u32::try_from(count).unwrap_or(u32::MAX);
                    list.push(Observation {
                        stamp_ns,
                        is_stamp_sound: true,
                        steady_ns: stamp_ns,
                        level: watch.level(),
                        payload_bytes: bytes(datagram.payload_bytes),
                        packet_bytes: bytes(datagram.packet_bytes),
                        packet_number: datagram.packet_number,
                        hop_limit: datagram.hop_limit,
                        station: place.station,
                        is_of_any: place.is_of_any,
                        radio_number: datagram.radio_number,
                        lacks_pieces: false,
                        has_copy: false,
                        identity,
                    });
                    return;
                }
                // Following our own means looking at everything: what is not ours belongs to no flow.
                Err(Unidentified::Foreign) if flow.kind == FlowKind::Hil => {}
                Err(reason) => {
                    let unread = match reason {
                        Unidentified::CutShort => Some(Unread::CutShort),
                        Unidentified::Fragmented => Some(Unread::Fragmented),
                        Unidentified::Foreign => None,
                    };
                    if let Some(unread) = unread {
                        watch.miss_of(flow_index, source, destination, unread);
                        // Of ours the channel would be of its name.
                        if flow.kind != FlowKind::Hil {
                            let stream = Stream {
                                flow_index,
                                source,
                                destination,
                                own: None,
                            };
                            seen.entry(stream).or_default();
                        }
                    }
                    why = Some(reason);
                }
            }
        }
        *match why {
            None => {
                let port = datagram.destination.port();
                *self.other_ports.entry(port).or_default() += 1;
                &mut counts.other_flow_count
            }
            Some(Unidentified::Foreign) => &mut counts.foreign_count,
            Some(Unidentified::CutShort | Unidentified::Fragmented) => {
                &mut counts.unidentified_count
            }
        } += 1;
    }

    /// A packet or block of a file could not be read; what follows it could.
    pub fn take_broken(&mut self, file_index: usize) {
        *self.broken.entry(file_index).or_default() += 1;
    }

    /// The flows followed.
    pub fn flows(&self) -> &[FlowFilter] {
        &self.flows
    }

    /// What was counted so far.
    pub const fn counts(&self) -> &PacketCounts {
        &self.counts
    }

    /// Ports to which most datagrams went that are of no followed flow, with how many.
    pub fn busiest_other_ports(&self) -> Vec<(u16, u64)> {
        let mut ports: Vec<(u16, u64)> = self.other_ports.iter().map(|(a, b)| (*a, *b)).collect();
        ports.sort_by_key(|(_, count)| Reverse(*count));
        ports
    }

    /// Streams of a merged interface most of whose datagrams are there twice: two captures became one point.
    pub fn folded(&self) -> impl Iterator<Item = (&Point, &Stream)> {
        let merged = self.seen.iter().filter(|(point, _)| {
            let watch = self.watches.get(&point.tap());
            watch.is_some_and(|watch| watch.is_merged)
        });
        let streams = merged.flat_map(|(point, seen)| seen.iter().map(move |one| (point, one)));
        let folded = streams.filter(|(_, (_, list))| {
            let identity = |one: &Observation| (one.identity.key, one.packet_number);
            let different: BTreeSet<(u64, u16)> = list.iter().map(identity).collect();
            3 * (list.len() - different.len()) > list.len()
        });
        folded.map(|(point, (stream, _))| (point, stream))
    }

    /// What was seen so far at each point.
    pub const fn seen(&self) -> &BTreeMap<Point, Seen> {
        &self.seen
    }

    /// What each tap could have seen; complete after [`Self::finish`].
    pub const fn watches(&self) -> &BTreeMap<Tap, Watch> {
        &self.watches
    }

    /// Settles what the taps of a file could have seen, after its last packet. An interface of which the
    /// file has no packet but tells how long it was watched has points too, and so has a file of which
    /// nothing could be read; one that a later section of the
    /// file describes again, at another time, is the same.
    pub fn finish(&mut self, file_index: usize, interfaces: &[CaptureInterface]) {
        for (interface_index, interface) in interfaces.iter().enumerate() {
            let tap = Tap {
                file_index,
                interface_index,
                is_esl: false,
            };
            let is_watched = interface.watch.iter().any(Option::is_some);
            // A card's packets are those of another interface once more, on another clock.
            if is_watched && !interface.has_nic_clock() {
                self.watches.entry(tap).or_default();
                self.add_silent_points(tap);
            }
        }
        if !self.seen.keys().any(|one| one.file_index == file_index) {
            let point = Point {
                file_index,
                ..Point::default()
            };
            self.seen.insert(point, Seen::new());
            self.watches.entry(point.tap()).or_default();
        }
        self.settle_fragments(file_index);
        let broken = self.broken.get(&file_index).copied();
        for (tap, watch) in &mut self.watches {
            if tap.file_index == file_index {
                for _ in 0..broken.unwrap_or(0) {
                    watch.miss(Unread::Malformed);
                }
                let interface = interfaces.get(tap.interface_index);
                let dropped_count = interface.and_then(|one| one.dropped_count);
                watch.dropped_count = dropped_count.unwrap_or(0);
                // An interface's times are not of the device's clock.
                watch.settle(interface.filter(|_| !tap.is_esl));
            }
        }
        for (point, seen) in &mut self.seen {
            if point.file_index == file_index
                && let Some(watch) = self.watches.get(&point.tap())
            {
                let observations = seen.values_mut().flatten();
                observations.for_each(|one| watch.settle_observation(one));
            }
        }
        for (interface_index, interface) in interfaces.iter().enumerate() {
            if let Some(first) = interface.repeats {
                self.join_sections(file_index, first, interface_index);
            }
        }
    }

    /// A datagram that lacks a fragment did not come; unless the capture keeps later ones of no datagram of its
    /// stream, or ended too soon.
    fn settle_fragments(&mut self, file_index: usize) {
        let all = self.fragments.finish(file_index);
        let mut longest: BTreeMap<(Tap, IpAddr, IpAddr), u64> = BTreeMap::new();
        let ends = |one: &Begun| {
            let Stream {
                source,
                destination,
                ..
            } = one.stream;
            (one.point.tap(), source.ip(), destination.ip())
        };
        for one in &all {
            if let Some(length_ns) = one.length_ns {
                let known = longest.entry(ends(one)).or_default();
                *known = length_ns.max(*known);
            }
        }
        let mut missing: BTreeMap<(Point, Stream), BTreeSet<usize>> = BTreeMap::new();
        for one in all.iter().filter(|one| one.length_ns.is_none()) {
            let last_ns = self.watches.get(&one.point.tap()).and_then(Watch::last_ns);
            let may_come = last_ns.map(|last_ns| last_ns.abs_diff(one.first_ns));
            let is_judged =
                longest.get(&ends(one)).copied() < may_come && longest.contains_key(&ends(one));
            if is_judged {
                let places = missing.entry((one.point, one.stream)).or_default();
                places.insert(one.index);
            } else if let Some(seen) = self.seen.get_mut(&one.point)
                && let Some(list) = seen.get_mut(&one.stream)
            {
                list[one.index].lacks_pieces = true;
            }
        }
        for ((point, stream), places) in missing {
            self.counts.incomplete_count += places.len() as u64;
            self.counts.followed_count -= places.len() as u64;
            let seen = self.seen.entry(point).or_default();
            let list = seen.entry(stream).or_default();
            let mut index = 0;
            list.retain(|_| {
                index += 1;
                !places.contains(&(index - 1))
            });
        }
    }

    fn add_silent_points(&mut self, tap: Tap) {
        let mut points = self.seen.keys().filter(|point| point.tap() == tap);
        if points.any(|one| one.interface_number.is_some() || one.direction == Direction::Unknown) {
            return;
        }
        let is_esl = |one: &Point| {
            (one.file_index, one.interface_index) == (tap.file_index, tap.interface_index)
                && one.esl_port.is_some()
        };
        if self.seen.keys().any(is_esl) {
            return;
        }
        for direction in [Direction::Inbound, Direction::Outbound] {
            let point = Point {
                file_index: tap.file_index,
                interface_index: tap.interface_index,
                direction,
                ..Point::default()
            };
            self.seen.entry(point).or_default();
        }
    }

    /// Takes a later section's interface for an earlier one's, unless both were watched at one time: then
    /// they are of two hosts.
    fn join_sections(&mut self, file_index: usize, first: usize, later: usize) {
        for is_esl in [false, true] {
            let tap = |interface_index| Tap {
                file_index,
                interface_index,
                is_esl,
            };
            let Some(watch) = self.watches.get(&tap(later)) else {
                continue;
            };
            let earlier = self.watches.get(&tap(first));
            if earlier.is_some_and(|earlier| !earlier.is_apart_from(watch)) {
                continue;
            }
            let watch = self.watches.remove(&tap(later)).unwrap_or_default();
            match self.watches.entry(tap(first)) {
                Entry::Occupied(mut earlier) => earlier.get_mut().absorb(watch),
                Entry::Vacant(none) => {
                    none.insert(watch);
                }
            }
            let is_of = |point: &Point, _: &mut Seen| point.tap() == tap(later);
            let points: Vec<(Point, Seen)> = self.seen.extract_if(.., is_of).collect();
            for (point, seen) in points {
                let point = Point {
                    interface_index: first,
                    ..point
                };
                let known = self.seen.entry(point).or_default();
                for (stream, observations) in seen {
                    known.entry(stream).or_default().extend(observations);
                }
            }
        }
    }
}
