//! From a captured frame to the UDP datagram in it. Link layers: Ethernet, Linux cooked captures, BSD
//! loopback, PPP, 802.11 with or without radiotap, and bare IP; on top of them VLAN tags, `PPPoE`, MPLS
//! and LLC/SNAP; IPv4 with options, IPv6 with extension headers, IP and Ethernet within IP or, by [`UdpDatagram::inside`],
//! within UDP. A protocol that is neither read nor known to hold no datagram may hold any. Fragments are told apart, not put
//! together; checksums are not checked, since a capture on the sending host sees them unfinished. A
//! length of 0 in an IP or UDP header (segmentation offload, jumbograms) means: up to the frame's end.

use core::ops::ControlFlow;
use std::net::{IpAddr, SocketAddr};

use super::bytes::array_at;
use super::watch::{ProtocolSpace, Unread};
use hil_net::{Direction, link_type};

const UDP: u8 = 17;
/// IP within IP (RFC 2003, RFC 4213), generic routing encapsulation (RFC 2784), encrypted (RFC 4303) and
/// authenticated payload (RFC 4302), Ethernet within IP (RFC 3378, RFC 8986) and MPLS within IP (RFC 4023).
const IPV4_INSIDE: u8 = 4;
const IPV6_INSIDE: u8 = 41;
const GRE: u8 = 47;
const ESP: u8 = 50;
const AUTHENTICATION: u8 = 51;
const ETHER_IP: u8 = 97;
const MPLS_INSIDE: u8 = 137;
const ETHERNET_INSIDE: u8 = 143;

/// Behind an IP header with this protocol no UDP datagram lies: ICMP and `ICMPv6`, IGMP, TCP, EGP, IGRP, RDP, DCCP,
/// XTP, IDPR, RSVP, no next header, EIGRP, OSPF, PIM, VRRP, PGM, IS-IS, SCTP, Fibre Channel, mobility, UDP-Lite,
/// MANET, HIP, SHIM6 and pfsync.
const fn holds_no_udp(protocol: u8) -> bool {
    matches!(
        protocol,
        1 | 2
            | 6
            | 8
            | 9
            | 27
            | 33
            | 35
            | 36
            | 46
            | 58
            | 59
            | 88
            | 89
            | 103
            | 112
            | 113
            | 124
            | 132
            | 133
            | 135
            | 136
            | 138
            | 139
            | 140
            | 240
    )
}

/// Frames of this `EtherType` hold no IP packet.
const fn holds_no_ip(ether_type: u16) -> bool {
    matches!(
        ether_type,
        // XNS, X.25, ARP, wake-on-LAN, SRP, AVTP, IS-IS, CDP of Foundry, DECnet, RARP, AppleTalk, IPX.
        0x0600 | 0x0805 | 0x0806 | 0x0842 | 0x22ea | 0x22f0 | 0x22f4 | 0x2000 | 0x6000
            ..=0x6009 | 0x8035 | 0x809b | 0x80f3 | 0x8137 | 0x8138
            // QNX, Ethernet flow control, slow protocols (LACP), PPPoE discovery, HomePlug, EAPOL.
            | 0x8204 | 0x8808 | 0x8809 | 0x8863 | 0x887b | 0x888e
            // PROFINET, SCSI and ATA over Ethernet, EtherCAT, Powerlink, GOOSE, GSE, sampled values, 802.11 before
            // association, LLDP, SERCOS, WAVE, HomePlug AV, MRP, PTP, PRP supervision, faults (CFM), FCoE and FIP.
            | 0x8892 | 0x889a | 0x88a2 | 0x88a4 | 0x88ab | 0x88b8 | 0x88b9 | 0x88ba | 0x88c7 | 0x88cc | 0x88cd | 0x88dc | 0x88e1 | 0x88e3 | 0x88f5 | 0x88f6 | 0x88f7 | 0x88f8 | 0x88fb | 0x8902 | 0x8906 | 0x8914
            // 802.11 management over a link, CC-Link IE, RoCE, TTEthernet, EVB, IEEE 1905, loopback test.
            | 0x890d | 0x890f | 0x8915 | 0x891d | 0x8940 | 0x893a | 0x9000
    )
}

/// Why a frame of this `EtherType` holds no datagram that is read.
const fn not_read(ether_type: u16) -> NoDatagram {
    if holds_no_ip(ether_type) {
        NotIp
    } else {
        unknown(ProtocolSpace::EtherType, ether_type as u32)
    }
}

const fn unknown(space: ProtocolSpace, number: u32) -> NoDatagram {
    NoDatagram::Unread(Unread::Protocol { space, number })
}

/// Encrypted in UDP, by the port of either end: NAT traversal of `IPsec` (RFC 3948), `WireGuard` and its kin, `OpenVPN`,
/// `ZeroTier`, Nebula.
const SEALED_PORTS: [u16; 6] = [4500, 51820, 41641, 1194, 9993, 4242];
/// A tunnel that is not read: L2TP (RFC 2661), AMT (RFC 7450), Teredo (RFC 4380), LISP (RFC 9300), VXLAN-GPE,
/// CAPWAP (RFC 5415), GUE.
const TUNNEL_PORTS: [u16; 7] = [1701, 2268, 3544, 4341, 4790, 5247, 6080];

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
    /// Sequence number of its 802.11 frame; one that is sent again keeps it.
    pub radio_number: Option<u16>,
    /// Identification of its IP packet; 0 where it has none: of many senders that forbid fragments, and of IPv6.
    pub packet_number: u16,
    /// Bytes of its IP packet on the wire; of the first fragment when there are several.
    pub packet_bytes: usize,
    /// Bytes of the payload on the wire.
    pub payload_bytes: usize,
    /// What was captured of it; for the first fragment of several, what is in that fragment.
    pub payload: &'a [u8],
    /// What is here of it, when IP cut it up.
    pub fragment: Option<Fragment>,
}

/// A piece of an IP packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Fragment {
    /// Where from.
    pub source: IpAddr,
    /// Where to.
    pub destination: IpAddr,
    /// What the packet holds.
    pub protocol: u8,
    /// Number that all pieces bear.
    pub number: u32,
    /// Where in the packet it begins.
    pub from_bytes: usize,
    /// How much it holds.
    pub bytes: usize,
    /// None comes behind it in the packet.
    pub is_last: bool,
    /// Where it passed.
    pub place: FramePlace,
}

impl UdpDatagram<'_> {
    /// True when not all of the payload was captured.
    pub fn is_cut_short(&self) -> bool {
        self.payload.len() < self.payload_bytes
    }

    /// True for the first fragment of a datagram that IP cut up.
    pub const fn is_fragmented(&self) -> bool {
        self.fragment.is_some()
    }

    /// What a tunnel over UDP holds, known by its port; `None` for one that is none.
    ///
    /// # Errors
    /// Why there is no datagram in it.
    pub fn inside(&self) -> Option<Result<Self, NoDatagram>> {
        let (from, to) = (self.source.port(), self.destination.port());
        let is_of = |ports: &[u16]| ports.contains(&from) || ports.contains(&to);
        let sealed = |why| {
            let (source, destination) = (self.source.ip(), self.destination.ip());
            Some(Err(NoDatagram::Sealed {
                source,
                destination,
                why,
            }))
        };
        let mut walk = Walk {
            frame: self.payload,
            original_bytes: self.payload_bytes,
            at: 0,
            place: self.place,
            is_radio_retry: self.is_radio_retry,
            radio_number: self.radio_number,
        };
        let layer = match to {
            // VXLAN (RFC 7348), also by the port that Linux once chose.
            4789 | 8472 => walk.passes(8, Layer::Ethernet),
            6081 => walk.geneve(),
            // MPLS in UDP (RFC 7510).
            6635 => Ok(Layer::Mpls),
            2152 => walk.gtp(),
            // The key exchange beside it begins with zeros, and what keeps a NAT open is one byte.
            4500 if self.payload.starts_with(&[0; 4]) || self.payload_bytes == 1 => return None,
            _ if is_of(&SEALED_PORTS) => return sealed(Unread::Encrypted),
            _ => {
                let port = if TUNNEL_PORTS.contains(&to) { to } else { from };
                return is_of(&TUNNEL_PORTS)
                    .then(|| sealed(Unread::Tunnel { port }))
                    .flatten();
            }
        };
        if self.is_fragmented() {
            return Some(Err(NoDatagram::Unread(Unread::Fragmented)));
        }
        Some(layer.and_then(|layer| walk.follow(layer)))
    }
}

/// Why a frame holds no datagram to look at.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum NoDatagram {
    /// Not IP: ARP, for instance.
    NotIp,
    /// IP, but not UDP.
    NotUdp,
    /// A later fragment of a datagram, without the ports; of IP, which.
    LaterFragment(Option<Fragment>),
    /// It may hold any datagram between its ends, or of a tunnel between them.
    Sealed {
        /// Where from.
        source: IpAddr,
        /// Where to.
        destination: IpAddr,
        /// Encrypted, or of a tunnel that is not read.
        why: Unread,
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
    radio_number: Option<u16>,
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
        radio_number: None,
    };
    let layer = walk.link(link)?;
    walk.follow(layer)
}

impl<'a> Walk<'a> {
    /// From `layer` to the datagram.
    fn follow(&mut self, mut layer: Layer) -> Result<UdpDatagram<'a>, NoDatagram> {
        for _ in 0..NESTING_MAX {
            layer = match layer {
                Layer::EtherType(kind) => self.ether_type(kind)?,
                Layer::Ethernet => self.ethernet()?,
                Layer::Llc => self.llc()?,
                Layer::Ppp => self.ppp()?,
                Layer::Mpls => self.mpls()?,
                Layer::Gre => self.gre()?,
                Layer::Ip => match self.ip()? {
                    ControlFlow::Continue(layer) => layer,
                    ControlFlow::Break(datagram) => return Ok(datagram),
                },
            };
        }
        Err(MALFORMED)
    }

    /// A header of so many bytes before `layer`.
    fn passes(&mut self, header_bytes: usize, layer: Layer) -> Result<Layer, NoDatagram> {
        self.at += header_bytes;
        self.byte(0).map(|_| layer)
    }

    /// RFC 8926.
    fn geneve(&mut self) -> Result<Layer, NoDatagram> {
        let option_bytes = 4 * usize::from(self.byte(0)? & 0x3f);
        let layer = match self.word(2)? {
            0x6558 => Layer::Ethernet,
            kind => Layer::EtherType(kind.max(0x0600)),
        };
        self.passes(8 + option_bytes, layer)
    }

    /// The user plane of GTP version 1 (3GPP TS 29.281, section 5); its other messages hold no datagram.
    fn gtp(&mut self) -> Result<Layer, NoDatagram> {
        let [flags, kind] = self.peek(0)?;
        if kind != 255 || flags & 0xf0 != 0x30 {
            return Err(NotUdp);
        }
        let mut header_bytes = 8;
        if flags & 7 != 0 {
            header_bytes = 12;
            let mut next = if flags & 4 == 0 { 0 } else { self.byte(11)? };
            while next != 0 {
                // Words of four bytes; none is no header.
                let bytes = 4 * usize::from(self.byte(header_bytes)?.max(1));
                header_bytes += bytes;
                next = self.byte(header_bytes - 1)?;
            }
        }
        self.passes(header_bytes, Layer::Ip)
    }

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
                (cooked(self.word(14)?)?, 16)
            }
            link_type::LINUX_SLL2 => {
                self.place.direction = cooked_direction(self.byte(10)?.into());
                self.place.interface_number = Some(u32::from_be_bytes(self.peek(4)?));
                (cooked(self.word(0)?)?, 20)
            }
            link_type::NULL | link_type::LOOP => {
                let family: [u8; 4] = self.peek(0)?;
                let family = u32::from_le_bytes(family).min(u32::from_be_bytes(family));
                match family {
                    // IPv4, and IPv6 of Linux, Windows, NetBSD, FreeBSD and macOS.
                    2 | 10 | 23 | 24 | 28 | 30 => (Layer::Ip, 4),
                    // OSI and AppleTalk.
                    7 | 16 => return Err(NotIp),
                    other => return Err(unknown(ProtocolSpace::AddressFamily, other)),
                }
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
            // A provider's backbone (IEEE 802.1ah).
            0x88e7 => self.passes(4, Layer::Ethernet)?,
            // MACsec.
            0x88e5 => return Err(ENCRYPTED),
            0x0000..=0x05dc => Layer::Llc,
            _ => return Err(not_read(kind)),
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
            // A mirror port over IP (ERSPAN), with a header of its own where frames are numbered.
            0x88be => {
                let header_bytes = 8 * optional[2];
                self.passes(header_bytes, Layer::Ethernet)?
            }
            // What keeps a tunnel alive.
            0 => return Err(NotIp),
            kind => Layer::EtherType(kind.max(0x0600)),
        })
    }

    /// LLC with SNAP (RFC 1042 or IEEE 802.1H), or with IP (RFC 948).
    fn llc(&mut self) -> Result<Layer, NoDatagram> {
        let service: [u8; 3] = match self.peek(0) {
            Err(MALFORMED) => return Err(NotIp),
            other => other?,
        };
        match service {
            [0xaa, 0xaa, 3] => {}
            [6, 6, 3] => return self.passes(3, Layer::Ip),
            // Null, management, SNA, PROWAY, spanning trees, X.25 and its kin, IPX, NetBIOS, IPX as it was, OSI; and
            // exchange of identities and tests.
            [
                0x00 | 0x02 | 0x04 | 0x05 | 0x08 | 0x0c | 0x0e | 0x42 | 0x4e | 0x7e | 0x8e | 0xe0
                | 0xf0 | 0xf4 | 0xf8 | 0xfe | 0xff,
                ..,
            ]
            | [_, _, 0xaf | 0xbf | 0xe3 | 0xf3] => return Err(NotIp),
            [destination, ..] => {
                return Err(unknown(ProtocolSpace::Llc, destination.into()));
            }
        }
        let [_, _, _, a, b, c] = self.peek(0)?;
        let kind = self.word(6)?;
        self.at += 8;
        match [a, b, c] {
            [0, 0, 0 | 0xf8] => Ok(Layer::EtherType(kind.max(0x0600))),
            // Cisco's own (CDP, VTP, PVST), AppleTalk, and other neighbours' discovery: Extreme, Nortel, LLDP-MED.
            [0, 0, 0x0c | 0x81] | [8, 0, 7] | [0, 0xe0, 0x2b] | [0, 0x12, 0xbb] => Err(NotIp),
            // Bridged (RFC 2684): spanning trees.
            [0, 0x80, 0xc2] if kind == 0x000e => Err(NotIp),
            _ => Err(unknown(
                ProtocolSpace::Snap,
                u32::from_be_bytes([0, a, b, c]),
            )),
        }
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
            // An encrypted (RFC 1968) or compressed (RFC 1962) datagram, of all links or of one.
            0x53 | 0x55 | 0xfb | 0xfd => Err(ENCRYPTED),
            // TCP with short headers (RFC 1144).
            0x2d | 0x2f => Err(NotUdp),
            // Padding, OSI, XNS, DECnet, AppleTalk, IPX, Vines; spanning trees and discovery; and what controls a link.
            0x01 | 0x23..=0x2b | 0x35 | 0x0201..=0x0207 | 0x4000.. => Err(NotIp),
            _ => Err(unknown(ProtocolSpace::Ppp, protocol.into())),
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
        match self.peek(0)? {
            // An associated channel (RFC 5586).
            [0x10, 0] => return Err(NotIp),
            // An Ethernet pseudowire, with its control word or without (RFC 4448): an address may begin so too.
            [0, 0] if self.is_ethernet(4) && !self.is_ethernet(0) => self.at += 4,
            _ => {}
        }
        Ok(Layer::Ethernet)
    }

    /// True when an Ethernet frame with a type that is read begins `ahead`.
    fn is_ethernet(&self, ahead: usize) -> bool {
        let mut frame = Walk {
            at: self.at + ahead,
            ..*self
        };
        let Ok(Layer::EtherType(kind)) = frame.ethernet() else {
            return false;
        };
        match frame.ether_type(kind) {
            Ok(Layer::Llc) => frame.llc().is_ok(),
            Ok(_) | Err(ENCRYPTED) => true,
            Err(_) => false,
        }
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
        let sequence = self.word(22)?.swap_bytes();
        self.radio_number = Some(sequence >> 4);
        if sequence & 0x0f != 0 {
            return Err(LaterFragment(None));
        }
        if flags & 0x04 != 0 {
            return Err(NoDatagram::Unread(Unread::Fragmented));
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

    /// The datagram, or what else is in an IP packet.
    fn ip(&mut self) -> Result<ControlFlow<UdpDatagram<'a>, Layer>, NoDatagram> {
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
            LaterFragment(Some(fragment)) => LaterFragment(Some(Fragment {
                place: self.place,
                ..fragment
            })),
            other => other,
        };
        let network = network.map_err(short)?;
        let (layer, more_bytes) = match network.protocol {
            UDP => (None, 0),
            IPV4_INSIDE | IPV6_INSIDE => (Some(Layer::Ip), 0),
            GRE => (Some(Layer::Gre), 0),
            ETHER_IP => (Some(Layer::Ethernet), 2),
            ETHERNET_INSIDE => (Some(Layer::Ethernet), 0),
            MPLS_INSIDE => (Some(Layer::Mpls), 0),
            ESP => {
                return Err(NoDatagram::Sealed {
                    source: network.source,
                    destination: network.destination,
                    why: Unread::Encrypted,
                });
            }
            other => return Err(unknown(ProtocolSpace::Ip, other.into())),
        };
        if let Some(layer) = layer {
            if network.fragment.is_some() {
                return Err(NoDatagram::Unread(Unread::Fragmented));
            }
            self.at += network.header_bytes + more_bytes;
            return Ok(ControlFlow::Continue(layer));
        }
        let header: [u8; 8] = array_at(network.segment, 0).ok_or_else(|| short(CUT_SHORT))?;
        let word = |at: usize| u16::from_be_bytes([header[at], header[at + 1]]);
        let length_bytes = match usize::from(word(4)) {
            0 => network.segment_bytes,
            length => length,
        };
        let fits = length_bytes <= network.segment_bytes || network.fragment.is_some();
        if length_bytes < UDP_HEADER_BYTES || !fits {
            return Err(MALFORMED);
        }
        let end = length_bytes.min(network.segment.len());
        Ok(ControlFlow::Break(UdpDatagram {
            source: SocketAddr::new(network.source, word(0)),
            destination: SocketAddr::new(network.destination, word(2)),
            dscp: network.dscp,
            hop_limit: network.hop_limit,
            place: self.place,
            is_radio_retry: self.is_radio_retry,
            radio_number: self.radio_number,
            packet_number: network.packet_number,
            packet_bytes: network.header_bytes + network.segment_bytes,
            payload_bytes: length_bytes - UDP_HEADER_BYTES,
            payload: &network.segment[UDP_HEADER_BYTES..end],
            fragment: network.fragment.map(|fragment| Fragment {
                place: self.place,
                ..fragment
            }),
        }))
    }
}

/// What a cooked capture numbers as `EtherType`, or by numbers of Linux: LLC, and links without IP (CAN, for instance).
const fn cooked(kind: u16) -> Result<Layer, NoDatagram> {
    match kind {
        4 => Ok(Layer::Llc),
        0x0000..=0x05dc => Err(NotIp),
        kind => Ok(Layer::EtherType(kind)),
    }
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
    /// Without its place.
    fragment: Option<Fragment>,
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
    let cut = u16::from_be_bytes([fixed[6], fixed[7]]);
    let is_later = cut & 0x1fff != 0;
    let (source, destination) = (part::<4>(&fixed, 12).into(), part::<4>(&fixed, 16).into());
    let packet_number = u16::from_be_bytes([fixed[4], fixed[5]]);
    let fragment = (cut & 0x3fff != 0).then(|| Fragment {
        source,
        destination,
        protocol: fixed[9],
        number: packet_number.into(),
        from_bytes: usize::from(cut & 0x1fff) * 8,
        bytes: total_bytes - header_bytes,
        is_last: cut & 0x2000 == 0,
        place: FramePlace::default(),
    });
    let (mut protocol, mut at) = (fixed[9], header_bytes);
    if protocol == AUTHENTICATION && !is_later {
        let [next, words] = array_at(packet, at).ok_or(CUT_SHORT)?;
        (protocol, at) = (next, at + 4 * (usize::from(words) + 2));
    }
    if holds_no_udp(protocol) {
        return Err(NotUdp);
    }
    if is_later {
        return Err(LaterFragment(fragment));
    }
    let end = total_bytes.min(packet.len());
    Ok(Network {
        protocol,
        source,
        destination,
        dscp: fixed[1] >> 2,
        hop_limit: fixed[8],
        packet_number,
        header_bytes: at,
        segment: packet.get(at..end).ok_or(CUT_SHORT)?,
        segment_bytes: total_bytes.checked_sub(at).ok_or(MALFORMED)?,
        fragment,
    })
}

fn ipv6(packet: &[u8], original_bytes: usize) -> Result<Network<'_>, NoDatagram> {
    let fixed: [u8; 40] = array_at(packet, 0).ok_or(CUT_SHORT)?;
    let total_bytes = match u16::from_be_bytes([fixed[4], fixed[5]]) {
        0 => original_bytes,
        length => 40 + usize::from(length),
    };
    let traffic_class = (fixed[0] & 0x0f) << 4 | fixed[1] >> 4;
    let (source, destination) = (part::<16>(&fixed, 8).into(), part::<16>(&fixed, 24).into());
    let (mut next, mut at, mut fragment) = (fixed[6], 40, None);
    for _ in 0..NESTING_MAX {
        if holds_no_udp(next) {
            return Err(NotUdp);
        }
        if !matches!(next, 0 | 43 | 44 | AUTHENTICATION | 60) {
            let end = total_bytes.min(packet.len());
            return Ok(Network {
                protocol: next,
                source,
                destination,
                dscp: traffic_class >> 2,
                hop_limit: fixed[7],
                packet_number: 0,
                header_bytes: at,
                segment: packet.get(at..end).ok_or(CUT_SHORT)?,
                segment_bytes: total_bytes.checked_sub(at).ok_or(MALFORMED)?,
                fragment,
            });
        }
        let header: [u8; 8] = array_at(packet, at).ok_or(CUT_SHORT)?;
        at += 8;
        if next == 44 {
            let field = u16::from_be_bytes([header[2], header[3]]);
            let piece = Fragment {
                source,
                destination,
                protocol: header[0],
                number: u32::from_be_bytes([header[4], header[5], header[6], header[7]]),
                from_bytes: usize::from(field & 0xfff8),
                bytes: total_bytes.saturating_sub(at),
                is_last: field & 1 == 0,
                place: FramePlace::default(),
            };
            if field & 0xfff8 != 0 {
                return Err(LaterFragment(Some(piece)));
            }
            // One that was not cut may have such a header all the same.
            fragment = (!piece.is_last).then_some(piece).or(fragment);
        } else if next == AUTHENTICATION {
            at += 4 * usize::from(header[1]);
        } else {
            at += 8 * usize::from(header[1]);
        }
        next = header[0];
    }
    Err(MALFORMED)
}
