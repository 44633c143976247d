//! From a captured frame to the UDP datagram in it: Ethernet with VLAN tags, Linux cooked captures
//! and bare IP; IPv4 with options, IPv6 with extension headers. Fragments are told apart, not put
//! together; checksums are not checked, since a capture on the sending host sees them unfinished.

use std::net::{IpAddr, SocketAddr};

use super::bytes::array_at;
use hil_net::link_type;

const UDP: u8 = 17;
const UDP_HEADER_BYTES: usize = 8;
/// VLAN tags and IPv6 extension headers that are followed before a frame counts as malformed.
const NESTING_MAX: usize = 8;

/// A UDP datagram as far as it was captured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UdpDatagram<'a> {
    /// Where from.
    pub source: SocketAddr,
    /// Where to.
    pub destination: SocketAddr,
    /// Differentiated services code point, 0..=63.
    pub dscp: u8,
    /// Innermost VLAN, 0..=4095.
    pub vlan: Option<u16>,
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
    /// A link layer that is not read.
    UnknownLinkType,
    /// Not IP: ARP, for instance.
    NotIp,
    /// IP, but not UDP.
    NotUdp,
    /// A later fragment of a datagram, without the ports.
    LaterFragment,
    /// Captured too short to hold the headers.
    CutShort,
    /// Lengths or versions that cannot be.
    Malformed,
}

/// Looks for a UDP datagram in a frame of the given [`link_type`].
///
/// # Errors
/// Why there is none.
pub fn udp_datagram(link: u16, frame: &[u8]) -> Result<UdpDatagram<'_>, NoDatagram> {
    let net_u16 = |at| {
        let word = array_at(frame, at).map(u16::from_be_bytes);
        word.ok_or(NoDatagram::CutShort)
    };
    let (mut protocol, mut at) = match link {
        link_type::ETHERNET => (net_u16(12)?, 14),
        link_type::LINUX_SLL => (net_u16(14)?, 16),
        link_type::LINUX_SLL2 => (net_u16(0)?, 20),
        link_type::RAW | link_type::IPV4 | link_type::IPV6 => return ip(frame, None),
        _ => return Err(NoDatagram::UnknownLinkType),
    };
    let mut vlan = None;
    for _ in 0..NESTING_MAX {
        match protocol {
            0x8100 | 0x88a8 | 0x9100 => {
                vlan = Some(net_u16(at)? & 0x0fff);
                protocol = net_u16(at + 2)?;
                at += 4;
            }
            0x0800 | 0x86dd => return ip(frame.get(at..).ok_or(NoDatagram::CutShort)?, vlan),
            _ => return Err(NoDatagram::NotIp),
        }
    }
    Err(NoDatagram::Malformed)
}

fn ip(packet: &[u8], vlan: Option<u16>) -> Result<UdpDatagram<'_>, NoDatagram> {
    let network = match packet.first().map(|byte| byte >> 4) {
        Some(4) => ipv4(packet)?,
        Some(6) => ipv6(packet)?,
        Some(_) => return Err(NoDatagram::Malformed),
        None => return Err(NoDatagram::CutShort),
    };
    let header: [u8; 8] = array_at(network.segment, 0).ok_or(NoDatagram::CutShort)?;
    let word = |at: usize| u16::from_be_bytes([header[at], header[at + 1]]);
    let length_bytes = usize::from(word(4));
    let fits = length_bytes <= network.segment_bytes || network.is_fragmented;
    if length_bytes < UDP_HEADER_BYTES || !fits {
        return Err(NoDatagram::Malformed);
    }
    let end = length_bytes.min(network.segment.len());
    Ok(UdpDatagram {
        source: SocketAddr::new(network.source, word(0)),
        destination: SocketAddr::new(network.destination, word(2)),
        dscp: network.dscp,
        vlan,
        payload_bytes: length_bytes - UDP_HEADER_BYTES,
        payload: &network.segment[UDP_HEADER_BYTES..end],
        is_fragmented: network.is_fragmented,
    })
}

/// What the IP layer tells of the UDP part behind it.
struct Network<'a> {
    source: IpAddr,
    destination: IpAddr,
    dscp: u8,
    /// The UDP header and payload, without what pads the frame.
    segment: &'a [u8],
    /// Bytes of `segment` on the wire.
    segment_bytes: usize,
    is_fragmented: bool,
}

/// `N` bytes of a header that is there.
fn part<const N: usize>(header: &[u8], at: usize) -> [u8; N] {
    array_at(header, at).unwrap_or([0; N])
}

fn ipv4(packet: &[u8]) -> Result<Network<'_>, NoDatagram> {
    let fixed: [u8; 20] = array_at(packet, 0).ok_or(NoDatagram::CutShort)?;
    let header_bytes = usize::from(fixed[0] & 0x0f) * 4;
    let total_bytes = usize::from(u16::from_be_bytes([fixed[2], fixed[3]]));
    if header_bytes < 20 || total_bytes < header_bytes {
        return Err(NoDatagram::Malformed);
    }
    if fixed[9] != UDP {
        return Err(NoDatagram::NotUdp);
    }
    let fragment = u16::from_be_bytes([fixed[6], fixed[7]]);
    if fragment & 0x1fff != 0 {
        return Err(NoDatagram::LaterFragment);
    }
    let end = total_bytes.min(packet.len());
    Ok(Network {
        source: part::<4>(&fixed, 12).into(),
        destination: part::<4>(&fixed, 16).into(),
        dscp: fixed[1] >> 2,
        segment: packet.get(header_bytes..end).ok_or(NoDatagram::CutShort)?,
        segment_bytes: total_bytes - header_bytes,
        is_fragmented: fragment & 0x2000 != 0,
    })
}

fn ipv6(packet: &[u8]) -> Result<Network<'_>, NoDatagram> {
    let fixed: [u8; 40] = array_at(packet, 0).ok_or(NoDatagram::CutShort)?;
    let total_bytes = 40 + usize::from(u16::from_be_bytes([fixed[4], fixed[5]]));
    let traffic_class = (fixed[0] & 0x0f) << 4 | fixed[1] >> 4;
    let (mut next, mut at, mut is_fragmented) = (fixed[6], 40, false);
    for _ in 0..NESTING_MAX {
        if next == UDP {
            let end = total_bytes.min(packet.len());
            return Ok(Network {
                source: part::<16>(&fixed, 8).into(),
                destination: part::<16>(&fixed, 24).into(),
                dscp: traffic_class >> 2,
                segment: packet.get(at..end).ok_or(NoDatagram::CutShort)?,
                segment_bytes: total_bytes.checked_sub(at).ok_or(NoDatagram::Malformed)?,
                is_fragmented,
            });
        }
        if !matches!(next, 0 | 43 | 44 | 60) {
            return Err(NoDatagram::NotUdp);
        }
        let header: [u8; 8] = array_at(packet, at).ok_or(NoDatagram::CutShort)?;
        at += 8;
        if next == 44 {
            let field = u16::from_be_bytes([header[2], header[3]]);
            if field & 0xfff8 != 0 {
                return Err(NoDatagram::LaterFragment);
            }
            is_fragmented |= field & 1 != 0;
        } else {
            at += 8 * usize::from(header[1]);
        }
        next = header[0];
    }
    Err(NoDatagram::Malformed)
}
