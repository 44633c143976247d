//! From a captured frame to the UDP datagram in it. Link layers: Ethernet, Linux cooked captures, BSD
//! loopback, PPP, 802.11 with or without radiotap, and bare IP; on top of them VLAN tags, `PPPoE`, MPLS
//! and LLC/SNAP; IPv4 with options, IPv6 with extension headers, IP and Ethernet within IP. Fragments are told apart, not put
//! together; checksums are not checked, since a capture on the sending host sees them unfinished. A
//! length of 0 in an IP or UDP header (segmentation offload, jumbograms) means: up to the frame's end.

use std::net::{IpAddr, SocketAddr};

use super::bytes::array_at;
use super::watch::Unread;
use hil_net::{Direction, link_type};

const UDP: u8 = 17;
/// IP within IP (RFC 2003, RFC 4213), generic routing encapsulation (RFC 2784), encrypted (RFC 4303) and
/// authenticated payload (RFC 4302).
const IPV4_INSIDE: u8 = 4;
const IPV6_INSIDE: u8 = 41;
const GRE: u8 = 47;
const ESP: u8 = 50;
const AUTHENTICATION: u8 = 51;

/// Behind an IP header with this protocol a UDP datagram may lie.
const fn may_hold_udp(protocol: u8) -> bool {
    matches!(protocol, UDP | IPV4_INSIDE | IPV6_INSIDE | GRE | ESP)
}
const UDP_HEADER_BYTES: usize = 8;
/// Headers that are followed before a frame counts as malformed.
const NESTING_MAX: usize = 8;

/// What the headers in front of the IP packet say of where and which way the frame passed. Frames of one
/// interface that differ in it passed different points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct FramePlace {
    /// By the packet type of a Linux cooked capture.
    pub direction: Direction,
    /// Number of the interface: a capture on `any` (SLL2).
    pub interface_number: Option<u32>,
    /// Outer and innermost VLAN, 1..=4095; 0 for none (number 0 is a priority without a VLAN).
    pub vlans: [u16; 2],
    /// For which station of the link it is: of Ethernet.
    pub station: [u8; 6],
    /// A cooked capture that may be of several interfaces and does not say which.
    pub is_of_any: bool,
    /// Leg of an 802.11 frame: to the access point, from it, or neither (`ToDS`, `FromDS`).
    pub radio_leg: Option<(bool, bool)>,
}

/// A UDP datagram as far as it was captured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UdpDatagram<'a> {
    /// Where from.
    pub source: SocketAddr,
    /// Where to.
    pub destination: SocketAddr,
    /// Differentiated services code point, 0..=63.
    pub dscp: u8,
    /// Time to live, or hop limit.
    pub hop_limit: u8,
    /// Where it passed.
    pub place: FramePlace,
    /// An 802.11 frame sent again for want of an acknowledgement.
    pub is_radio_retry: bool,
    /// Identification of its IP packet; 0 where it has none: of many senders that forbid fragments, and of IPv6.
    pub packet_number: u16,
    /// Bytes of its IP packet on the wire; of the first fragment when there are several.
    pub packet_bytes: usize,
    /// Bytes of the payload on the wire.
    pub payload_bytes: usize,
    /// What was captured of it; for the first fragment of several, what is in that fragment.
    pub payload: &'a [u8],
    /// True for the first fragment of a datagram that IP cut up.
    pub is_fragmented: bool,
}

impl UdpDatagram<'_> {
    /// True when not all of the payload was captured.
    pub fn is_cut_short(&self) -> bool {
        self.payload.len() < self.payload_bytes
    }
}

/// Why a frame holds no datagram to look at.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum NoDatagram {
    /// Not IP: ARP, for instance.
    NotIp,
    /// IP, but not UDP.
    NotUdp,
    /// A later fragment of a datagram, without the ports.
    LaterFragment,
    /// Encrypted (RFC 4303): it may hold any datagram between its ends, or of a tunnel between them.
    Sealed {
        /// Where from.
        source: IpAddr,
        /// Where to.
        destination: IpAddr,
    },
    /// It may hold any datagram.
    Unread(Unread),
}

use NoDatagram::{LaterFragment, NotIp, NotUdp};

const CUT_SHORT: NoDatagram = NoDatagram::Unread(Unread::CutShort);
const MALFORMED: NoDatagram = NoDatagram::Unread(Unread::Malformed);
const ENCRYPTED: NoDatagram = NoDatagram::Unread(Unread::Encrypted);

/// What begins at a place in a frame.
#[derive(Debug, Clone, Copy)]
enum Layer {
    /// What an `EtherType` says, or below 0x0600 the length of an LLC frame.
    EtherType(u16),
    Ethernet,
    Llc,
    Ppp,
    Mpls,
    Gre,
    Ip,
}

/// A frame, and how far its headers have been read.
struct Walk<'a> {
    frame: &'a [u8],
    /// Bytes on the wire.
    original_bytes: usize,
    at: usize,
    place: FramePlace,
    is_radio_retry: bool,
}

/// Looks for a UDP datagram in a frame of the given [`link_type`] that had `original_bytes` on the wire.
///
/// # Errors
/// Why there is none.
pub fn udp_datagram(
    link: u16,
    frame: &[u8],
    original_bytes: usize,
) -> Result<UdpDatagram<'_>, NoDatagram> {
    let mut walk = Walk {
        frame,
        original_bytes: original_bytes.max(frame.len()),
        at: 0,
        place: FramePlace::default(),
        is_radio_retry: false,
    };
    let mut layer = walk.link(link)?;
    for _ in 0..NESTING_MAX {
        layer = match layer {
            Layer::EtherType(kind) => walk.ether_type(kind)?,
            Layer::Ethernet => walk.ethernet()?,
            Layer::Llc => walk.llc()?,
            Layer::Ppp => walk.ppp()?,
            Layer::Mpls => walk.mpls()?,
            Layer::Gre => walk.gre()?,
            Layer::Ip => match walk.ip()? {
                Inside::Layer(layer) => layer,
                Inside::Datagram(datagram) => return Ok(datagram),
            },
        };
    }
    Err(MALFORMED)
}

impl<'a> Walk<'a> {
    /// `N` bytes from `ahead` on.
    fn peek<const N: usize>(&self, ahead: usize) -> Result<[u8; N], NoDatagram> {
        array_at(self.frame, self.at + ahead).ok_or_else(|| self.too_short())
    }

    fn byte(&self, ahead: usize) -> Result<u8, NoDatagram> {
        self.peek(ahead).map(|[byte]| byte)
    }

    fn word(&self, ahead: usize) -> Result<u16, NoDatagram> {
        self.peek(ahead).map(u16::from_be_bytes)
    }

    /// A header that is not all there: not captured, or never sent.
    fn too_short(&self) -> NoDatagram {
        if self.frame.len() < self.original_bytes {
            CUT_SHORT
        } else {
            MALFORMED
        }
    }

    fn link(&mut self, link: u16) -> Result<Layer, NoDatagram> {
        let (layer, length) = match link {
            link_type::ETHERNET => {
                self.place.station = self.peek(0)?;
                (Layer::Ethernet, 0)
            }
            link_type::LINUX_SLL => {
                self.place.is_of_any = true;
                self.place.direction = cooked_direction(self.word(0)?);
                (Layer::EtherType(self.word(14)?), 16)
            }
            link_type::LINUX_SLL2 => {
                self.place.direction = cooked_direction(self.byte(10)?.into());
                self.place.interface_number = Some(u32::from_be_bytes(self.peek(4)?));
                (Layer::EtherType(self.word(0)?), 20)
            }
            link_type::NULL | link_type::LOOP => {
                let family: [u8; 4] = self.peek(0)?;
                let family = u32::from_le_bytes(family).min(u32::from_be_bytes(family));
                // IPv4, and IPv6 of Linux, Windows, NetBSD, FreeBSD and macOS.
                if !matches!(family, 2 | 10 | 23 | 24 | 28 | 30) {
                    return Err(NotIp);
                }
                (Layer::Ip, 4)
            }
            link_type::PPP | link_type::PPP_SERIAL => (Layer::Ppp, 0),
            link_type::PPP_ETHER => (Layer::Ppp, 6),
            link_type::RADIOTAP => {
                let is_padded = self.radiotap()?;
                return self.radio(is_padded);
            }
            link_type::IEEE802_11 => return self.radio(false),
            link_type::RAW
            | link_type::RAW_12
            | link_type::RAW_14
            | link_type::IPV4
            | link_type::IPV6 => (Layer::Ip, 0),
            link_type => return Err(NoDatagram::Unread(Unread::LinkType { link_type })),
        };
        self.at += length;
        Ok(layer)
    }

    fn ether_type(&mut self, kind: u16) -> Result<Layer, NoDatagram> {
        Ok(match kind {
            // IPv4, IPv6.
            0x0800 | 0x86dd => Layer::Ip,
            // VLAN tags.
            0x8100 | 0x88a8 | 0x9100 | 0x9200 | 0x9300 => {
                let vlan = self.word(0)? & 0x0fff;
                if vlan != 0 {
                    self.place.vlans = [self.place.vlans[1], vlan];
                }
                let inner = self.word(2)?;
                self.at += 4;
                Layer::EtherType(inner)
            }
            0x8847 | 0x8848 => Layer::Mpls,
            // HSR (IEC 62439-3) and redundancy (IEEE 802.1CB) tags.
            0x892f | 0xf1c1 => {
                let inner = self.word(4)?;
                self.at += 6;
                Layer::EtherType(inner)
            }
            // A PPPoE session.
            0x8864 => {
                self.at += 6;
                Layer::Ppp
            }
            // MACsec.
            0x88e5 => return Err(ENCRYPTED),
            // LLC: by a length, or as Linux cooked captures number it.
            0x0000..=0x05dc => Layer::Llc,
            _ => return Err(NotIp),
        })
    }

    fn ethernet(&mut self) -> Result<Layer, NoDatagram> {
        let kind = self.word(12)?;
        self.at += 14;
        Ok(Layer::EtherType(kind))
    }

    /// Without its optional fields (RFC 2784, RFC 2890).
    fn gre(&mut self) -> Result<Layer, NoDatagram> {
        let (flags, kind) = (self.word(0)?, self.word(2)?);
        let optional = [0x8000, 0x2000, 0x1000].map(|bit| usize::from(flags & bit != 0));
        self.at += 4 + 4 * optional.iter().sum::<usize>();
        Ok(match kind {
            0x6558 => Layer::Ethernet,
            kind => Layer::EtherType(kind.max(0x0600)),
        })
    }

    /// LLC with SNAP: RFC 1042 or IEEE 802.1H. Anything else carries no IP.
    fn llc(&mut self) -> Result<Layer, NoDatagram> {
        let header: [u8; 8] = match self.peek(0) {
            Err(MALFORMED) => return Err(NotIp),
            other => other?,
        };
        let (snap, kind) = header.split_at(6);
        if !matches!(snap, [0xaa, 0xaa, 3, 0, 0, 0 | 0xf8]) {
            return Err(NotIp);
        }
        self.at += 8;
        let kind = u16::from_be_bytes([kind[0], kind[1]]);
        Ok(Layer::EtherType(kind.max(0x0600)))
    }

    /// RFC 1661, with address and control (RFC 1662) or without, the protocol in one or two bytes.
    fn ppp(&mut self) -> Result<Layer, NoDatagram> {
        if self.peek(0)? == [0xff, 0x03] {
            self.at += 2;
        }
        let first = self.byte(0)?;
        let (protocol, length) = if first & 1 == 1 {
            (first.into(), 1)
        } else {
            (self.word(0)?, 2)
        };
        self.at += length;
        match protocol {
            0x21 | 0x57 => Ok(Layer::Ip),
            0x0281 | 0x0283 => Ok(Layer::Mpls),
            // An encrypted (RFC 1968) or compressed (RFC 1962) datagram.
            0x53 | 0xfd => Err(ENCRYPTED),
            _ => Err(NotIp),
        }
    }

    /// RFC 3032: labels until the bottom of the stack; what is below shows in its first nibble.
    fn mpls(&mut self) -> Result<Layer, NoDatagram> {
        while self.byte(2)? & 1 == 0 {
            self.at += 4;
        }
        self.at += 4;
        if matches!(self.byte(0)? >> 4, 4 | 6) {
            return Ok(Layer::Ip);
        }
        // An Ethernet pseudowire, with its control word or without (RFC 4448).
        if self.peek(0)? == [0, 0] {
            self.at += 4;
        }
        Ok(Layer::Ethernet)
    }

    /// Passes the radiotap header; its flags tell of frames whose check sequence is wrong, and whether the
    /// 802.11 header is padded to a multiple of four bytes.
    fn radiotap(&mut self) -> Result<bool, NoDatagram> {
        let fixed: [u8; 8] = self.peek(0)?;
        let mut flags_at = 8;
        let mut present = u32::from_le_bytes([fixed[4], fixed[5], fixed[6], fixed[7]]);
        let first = present;
        while present & 1 << 31 != 0 {
            present = u32::from_le_bytes(self.peek(flags_at)?);
            flags_at += 4;
        }
        if first & 1 != 0 {
            flags_at = flags_at.next_multiple_of(8) + 8;
        }
        let flags = if first & 2 == 0 {
            0
        } else {
            self.byte(flags_at)?
        };
        self.at += usize::from(u16::from_le_bytes([fixed[2], fixed[3]]));
        if flags & 0x40 != 0 {
            Err(MALFORMED)
        } else {
            Ok(flags & 0x20 != 0)
        }
    }

    /// A data frame of 802.11 (IEEE 802.11-2020, section 9.3.2).
    fn radio(&mut self, is_padded: bool) -> Result<Layer, NoDatagram> {
        let begin = self.at;
        let [control, flags] = self.peek(0)?;
        let is_data = control & 0x0c == 0x08;
        if !is_data || control & 0x40 != 0 {
            // Management and control; and data frames without data.
            return Err(NotIp);
        }
        let leg = (flags & 1 != 0, flags & 2 != 0);
        self.place.radio_leg = Some(leg);
        self.is_radio_retry = flags & 0x08 != 0;
        if flags & 0x40 != 0 {
            return Err(ENCRYPTED);
        }
        if self.word(22)? & 0x0f00 != 0 {
            return Err(LaterFragment);
        }
        self.at += 24 + if leg == (true, true) { 6 } else { 0 };
        if control & 0x80 != 0 {
            let quality = self.byte(0)?;
            self.at += 2 + if flags & 0x80 != 0 { 4 } else { 0 };
            if quality & 0x80 != 0 {
                return Err(NoDatagram::Unread(Unread::Aggregate));
            }
        }
        if is_padded {
            self.at = begin + (self.at - begin).next_multiple_of(4);
        }
        Ok(Layer::Llc)
    }

    fn ip(&mut self) -> Result<Inside<'a>, NoDatagram> {
        let packet = self.frame.get(self.at..).unwrap_or_default();
        let original_bytes = self.original_bytes.saturating_sub(self.at);
        let is_cut = packet.len() < original_bytes;
        let network = match packet.first().map(|byte| byte >> 4) {
            Some(4) => ipv4(packet, original_bytes),
            Some(6) => ipv6(packet, original_bytes),
            Some(_) => Err(MALFORMED),
            None => Err(CUT_SHORT),
        };
        let short = |reason| match reason {
            // All of the frame is there.
            CUT_SHORT if !is_cut => MALFORMED,
            other => other,
        };
        let network = network.map_err(short)?;
        let layer = match network.protocol {
            IPV4_INSIDE | IPV6_INSIDE => Some(Layer::Ip),
            GRE => Some(Layer::Gre),
            ESP => {
                return Err(NoDatagram::Sealed {
                    source: network.source,
                    destination: network.destination,
                });
            }
            _ => None,
        };
        if let Some(layer) = layer {
            self.at += network.header_bytes;
            return Ok(Inside::Layer(layer));
        }
        let header: [u8; 8] = array_at(network.segment, 0).ok_or_else(|| short(CUT_SHORT))?;
        let word = |at: usize| u16::from_be_bytes([header[at], header[at + 1]]);
        let length_bytes = match usize::from(word(4)) {
            0 => network.segment_bytes,
            length => length,
        };
        let fits = length_bytes <= network.segment_bytes || network.is_fragmented;
        if length_bytes < UDP_HEADER_BYTES || !fits {
            return Err(MALFORMED);
        }
        let end = length_bytes.min(network.segment.len());
        Ok(Inside::Datagram(UdpDatagram {
            source: SocketAddr::new(network.source, word(0)),
            destination: SocketAddr::new(network.destination, word(2)),
            dscp: network.dscp,
            hop_limit: network.hop_limit,
            place: self.place,
            is_radio_retry: self.is_radio_retry,
            packet_number: network.packet_number,
            packet_bytes: network.header_bytes + network.segment_bytes,
            payload_bytes: length_bytes - UDP_HEADER_BYTES,
            payload: &network.segment[UDP_HEADER_BYTES..end],
            is_fragmented: network.is_fragmented,
        }))
    }
}

/// What is in an IP packet.
enum Inside<'a> {
    Layer(Layer),
    Datagram(UdpDatagram<'a>),
}

/// By the packet type of a cooked capture: 4 is sent by this host, all else came in.
const fn cooked_direction(packet_type: u16) -> Direction {
    match packet_type {
        0..=3 => Direction::Inbound,
        4 => Direction::Outbound,
        _ => Direction::Unknown,
    }
}

/// What the IP layer tells of what is behind it.
struct Network<'a> {
    protocol: u8,
    source: IpAddr,
    destination: IpAddr,
    dscp: u8,
    hop_limit: u8,
    /// See [`UdpDatagram::packet_number`].
    packet_number: u16,
    /// Bytes before `segment`.
    header_bytes: usize,
    /// What is behind its headers, without what pads the frame.
    segment: &'a [u8],
    /// Bytes of `segment` on the wire.
    segment_bytes: usize,
    is_fragmented: bool,
}

/// `N` bytes of a header that is there.
fn part<const N: usize>(header: &[u8], at: usize) -> [u8; N] {
    array_at(header, at).unwrap_or([0; N])
}

fn ipv4(packet: &[u8], original_bytes: usize) -> Result<Network<'_>, NoDatagram> {
    let fixed: [u8; 20] = array_at(packet, 0).ok_or(CUT_SHORT)?;
    let header_bytes = usize::from(fixed[0] & 0x0f) * 4;
    let total_bytes = match u16::from_be_bytes([fixed[2], fixed[3]]) {
        0 => original_bytes,
        length => length.into(),
    };
    if header_bytes < 20 || total_bytes < header_bytes {
        return Err(MALFORMED);
    }
    let fragment = u16::from_be_bytes([fixed[6], fixed[7]]);
    let is_later = fragment & 0x1fff != 0;
    let (mut protocol, mut at) = (fixed[9], header_bytes);
    if protocol == AUTHENTICATION && !is_later {
        let [next, words] = array_at(packet, at).ok_or(CUT_SHORT)?;
        (protocol, at) = (next, at + 4 * (usize::from(words) + 2));
    }
    if !may_hold_udp(protocol) {
        return Err(NotUdp);
    }
    if is_later {
        return Err(LaterFragment);
    }
    let end = total_bytes.min(packet.len());
    Ok(Network {
        protocol,
        source: part::<4>(&fixed, 12).into(),
        destination: part::<4>(&fixed, 16).into(),
        dscp: fixed[1] >> 2,
        hop_limit: fixed[8],
        packet_number: u16::from_be_bytes([fixed[4], fixed[5]]),
        header_bytes: at,
        segment: packet.get(at..end).ok_or(CUT_SHORT)?,
        segment_bytes: total_bytes.checked_sub(at).ok_or(MALFORMED)?,
        is_fragmented: fragment & 0x2000 != 0,
    })
}

fn ipv6(packet: &[u8], original_bytes: usize) -> Result<Network<'_>, NoDatagram> {
    let fixed: [u8; 40] = array_at(packet, 0).ok_or(CUT_SHORT)?;
    let total_bytes = match u16::from_be_bytes([fixed[4], fixed[5]]) {
        0 => original_bytes,
        length => 40 + usize::from(length),
    };
    let traffic_class = (fixed[0] & 0x0f) << 4 | fixed[1] >> 4;
    let (mut next, mut at, mut is_fragmented) = (fixed[6], 40, false);
    for _ in 0..NESTING_MAX {
        if may_hold_udp(next) {
            let end = total_bytes.min(packet.len());
            return Ok(Network {
                protocol: next,
                source: part::<16>(&fixed, 8).into(),
                destination: part::<16>(&fixed, 24).into(),
                dscp: traffic_class >> 2,
                hop_limit: fixed[7],
                packet_number: 0,
                header_bytes: at,
                segment: packet.get(at..end).ok_or(CUT_SHORT)?,
                segment_bytes: total_bytes.checked_sub(at).ok_or(MALFORMED)?,
                is_fragmented,
            });
        }
        if !matches!(next, 0 | 43 | 44 | AUTHENTICATION | 60) {
            return Err(NotUdp);
        }
        let header: [u8; 8] = array_at(packet, at).ok_or(CUT_SHORT)?;
        at += 8;
        if next == 44 {
            let field = u16::from_be_bytes([header[2], header[3]]);
            if field & 0xfff8 != 0 {
                return Err(LaterFragment);
            }
            is_fragmented |= field & 1 != 0;
        } else if next == AUTHENTICATION {
            at += 4 * usize::from(header[1]);
        } else {
            at += 8 * usize::from(header[1]);
        }
        next = header[0];
    }
    Err(MALFORMED)
}
