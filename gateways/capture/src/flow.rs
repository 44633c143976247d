//! Which datagrams a probe follows, and by what it knows one of them again at another point. The
//! words of the command line are read here; nothing is captured or counted.
//!
//! `hil`, `egm` or `udp`, then `:` and conditions with commas between: `port=N` (either end),
//! `sport=N`, `dport=N`, `src=ADDRESS`, `dst=ADDRESS`, and for `udp` also `id=OFFSET+BYTES[le]`, a
//! number of 1 to 8 bytes in the payload that counts up. Without `id` the whole payload is hashed.

use core::fmt;
use core::str::FromStr;
use std::collections::BTreeSet;
use std::net::{IpAddr, SocketAddr};

use hil_arm::egm::wire;
use hil_core::message::{FNV_OFFSET, fnv1a};
use thiserror::Error;

use super::link::UdpDatagram;
use super::observe::Stream;
use hil_net::filter::PacketFilter;
use hil_protocol::wire::{HEADER_BYTES, Header, Kind};

/// What our own datagrams begin with.
const MAGIC: [u8; 4] = *b"HILG";
/// Bits of a number that does not come again while one datagram passes a host's links.
const UNIQUE_BITS: u8 = 32;
/// Bytes of a frame before the payload of a UDP datagram at most, with a tag and IP options.
const BEFORE_PAYLOAD_BYTES: usize = 18 + 60 + 8;

/// What a flow's datagrams hold, and by what one of them is known again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FlowKind {
    /// Our own.
    Hil,
    /// Externally guided motion, either direction.
    Egm,
    /// Anything, known by its whole payload.
    Payload,
    /// Anything, known by a number in it.
    Number(NumberField),
}

/// A number in a payload that counts up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NumberField {
    /// First byte, from the start of the payload.
    offset: u16,
    /// 1..=8.
    bytes: u8,
    /// Lowest byte first.
    is_little_endian: bool,
}

/// One flow to follow.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FlowFilter {
    /// What it holds.
    pub kind: FlowKind,
    /// Which packets are of it, as far as a tap can tell.
    pub packets: PacketFilter,
}

/// Why words of the command line name no flow.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum FlowError {
    /// Unknown first word.
    #[error("`{0}` is no flow; use hil, egm or udp, e.g. udp:dport=5004,id=2+2")]
    Kind(String),
    /// Unknown condition.
    #[error("`{0}` is no condition; use port, sport, dport, src, dst or, with udp, id")]
    Condition(String),
    /// A value that cannot be.
    #[error("{key}={value}: {expected}")]
    Value {
        /// Which condition.
        key: &'static str,
        /// What was given.
        value: String,
        /// What it should be.
        expected: &'static str,
    },
    /// A condition given twice.
    #[error("`{0}` is given twice; a second --flow follows another flow")]
    Repeated(String),
    /// Nothing but `udp` or `egm`: that would follow everything.
    #[error("`{0}` needs a port or an address: otherwise it would follow every datagram")]
    Everything(String),
    /// IPv4 and IPv6 mixed.
    #[error("src and dst are of different address families")]
    Families,
}

impl FromStr for FlowFilter {
    type Err = FlowError;

    fn from_str(text: &str) -> Result<Self, FlowError> {
        let (kind, conditions) = text.split_once(':').unwrap_or((text, ""));
        let mut filter = Self::of(match kind {
            "hil" => FlowKind::Hil,
            "egm" => FlowKind::Egm,
            "udp" => FlowKind::Payload,
            other => return Err(FlowError::Kind(other.to_owned())),
        });
        let mut keys = BTreeSet::new();
        for condition in conditions.split(',').filter(|part| !part.is_empty()) {
            let unknown = || FlowError::Condition(condition.to_owned());
            let (key, value) = condition.split_once('=').ok_or_else(unknown)?;
            if !keys.insert(key) {
                return Err(FlowError::Repeated(key.to_owned()));
            }
            match (key, &mut filter.kind) {
                ("port", _) => filter.packets.port = Some(port("port", value)?),
                ("sport", _) => filter.packets.source_port = Some(port("sport", value)?),
                ("dport", _) => filter.packets.destination_port = Some(port("dport", value)?),
                ("src", _) => filter.packets.source = Some(address("src", value)?),
                ("dst", _) => filter.packets.destination = Some(address("dst", value)?),
                ("id", kind @ (FlowKind::Payload | FlowKind::Number(_))) => *kind = number(value)?,
                _ => return Err(unknown()),
            }
        }
        let ends = filter.packets.source.zip(filter.packets.destination);
        if ends.is_some_and(|(from, to)| from.is_ipv4() != to.is_ipv4()) {
            return Err(FlowError::Families);
        }
        if filter.kind != FlowKind::Hil && filter == Self::of(filter.kind) {
            return Err(FlowError::Everything(kind.to_owned()));
        }
        Ok(filter)
    }
}

impl FlowError {
    fn value(key: &'static str, value: &str, expected: &'static str) -> Self {
        Self::Value {
            key,
            value: value.to_owned(),
            expected,
        }
    }
}

fn port(key: &'static str, value: &str) -> Result<u16, FlowError> {
    let parsed = value.parse().ok().filter(|port| *port != 0);
    parsed.ok_or_else(|| FlowError::value(key, value, "a port is 1 to 65535"))
}

fn address(key: &'static str, value: &str) -> Result<IpAddr, FlowError> {
    let expected = "an IPv4 or IPv6 address without port";
    let parsed = value.parse().ok();
    parsed.ok_or_else(|| FlowError::value(key, value, expected))
}

fn number(value: &str) -> Result<FlowKind, FlowError> {
    let expected = "`payload`, or OFFSET+BYTES[le] with 0 to 1400 and 1 to 8, e.g. 2+2";
    let wrong = || FlowError::value("id", value, expected);
    if value == "payload" {
        return Ok(FlowKind::Payload);
    }
    let digits = value.strip_suffix("le");
    let (offset, bytes) = digits.unwrap_or(value).split_once('+').ok_or_else(wrong)?;
    let offset = offset.parse().ok().filter(|at| *at <= 1400);
    let bytes = bytes.parse().ok().filter(|count| (1..=8).contains(count));
    Ok(FlowKind::Number(NumberField {
        offset: offset.ok_or_else(wrong)?,
        bytes: bytes.ok_or_else(wrong)?,
        is_little_endian: digits.is_some(),
    }))
}

impl fmt::Display for FlowFilter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (word, field) = match self.kind {
            FlowKind::Hil => ("hil", None),
            FlowKind::Egm => ("egm", None),
            FlowKind::Payload => ("udp", None),
            FlowKind::Number(field) => ("udp", Some(field)),
        };
        let packets = &self.packets;
        let conditions = [
            packets.port.map(|port| format!("port={port}")),
            packets.source_port.map(|port| format!("sport={port}")),
            packets.destination_port.map(|port| format!("dport={port}")),
            packets.source.map(|address| format!("src={address}")),
            packets.destination.map(|address| format!("dst={address}")),
            field.map(|field| {
                let order = if field.is_little_endian { "le" } else { "" };
                format!("id={}+{}{order}", field.offset, field.bytes)
            }),
        ];
        let conditions: Vec<String> = conditions.into_iter().flatten().collect();
        let colon = if conditions.is_empty() { "" } else { ":" };
        write!(f, "{word}{colon}{}", conditions.join(","))
    }
}

/// What a followed datagram is known by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DatagramIdentity {
    /// Equal at two points for the same datagram, otherwise different but for chance (2^-64).
    pub key: u64,
    /// What it counts, and within which count; `None` when it counts nothing.
    pub number: Option<Numbered>,
    /// Its header, when it is ours.
    pub own: Option<OwnHeader>,
}

impl DatagramIdentity {
    /// No other datagram of the stream has it within seconds: it is a number wide enough.
    pub(super) fn is_unique(&self) -> bool {
        let bits = self.number.map(|number| number.bits.unwrap_or(u8::MAX));
        bits >= Some(UNIQUE_BITS)
    }
}

/// A sequence number and the series it belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Numbered {
    /// Differs when the counting begins anew: another session or producer.
    pub series: u64,
    /// The number.
    pub number: u64,
    /// Bits it has on the wire, 8..=64: behind the highest number comes 0. `None` for one that never
    /// wraps, and whose `series` is always another when it begins anew.
    pub bits: Option<u8>,
    /// True when further datagrams bear the same number: pieces of a message.
    pub is_piece: bool,
}

/// What a report needs of our own header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OwnHeader {
    /// What it is for.
    pub kind: Kind,
    /// Start of the sending-side gateway.
    pub session: u32,
    /// Number of the channel.
    pub channel: u16,
    /// Producer's start.
    pub epoch: u32,
    /// Its number.
    pub sequence: u64,
    /// When it was handed to the kernel, sender's monotonic clock, nanoseconds.
    pub handed_ns: i64,
    /// Pieces of the message.
    pub fragment_count: u16,
}

/// Why a datagram that meets a filter's conditions cannot be followed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Unidentified {
    /// The capture cut it off before its identity ended.
    CutShort,
    /// Only its first fragment is known, and its identity is all of it.
    Fragmented,
    /// It is not of the protocol.
    Foreign,
}

impl FlowFilter {
    fn of(kind: FlowKind) -> Self {
        let packets = PacketFilter {
            magic: (kind == FlowKind::Hil).then_some(MAGIC),
            ..PacketFilter::default()
        };
        Self { kind, packets }
    }

    /// Our own datagrams, whatever their addresses.
    pub fn hil() -> Self {
        Self::of(FlowKind::Hil)
    }

    /// True when addresses and ports are as asked.
    pub fn has_addresses_of(&self, datagram: &UdpDatagram<'_>) -> bool {
        self.has_ends(datagram.source, datagram.destination)
    }

    /// True when a tap with this filter keeps the datagrams of a stream.
    pub(super) fn keeps(&self, stream: &Stream) -> bool {
        let is_of_kind = self.kind != FlowKind::Hil || stream.own.is_some();
        is_of_kind && self.has_ends(stream.source, stream.destination)
    }

    fn has_ends(&self, from: SocketAddr, to: SocketAddr) -> bool {
        let wanted = &self.packets;
        let is_port = |wanted: Option<u16>, port| wanted.is_none_or(|one| one == port);
        let is_address = |wanted: Option<IpAddr>, address| wanted.is_none_or(|one| one == address);
        (is_port(wanted.port, from.port()) || is_port(wanted.port, to.port()))
            && is_port(wanted.source_port, from.port())
            && is_port(wanted.destination_port, to.port())
            && is_address(wanted.source, from.ip())
            && is_address(wanted.destination, to.ip())
    }

    /// By what the datagram is known again.
    ///
    /// # Errors
    /// When it is of another protocol, or too little of it was captured.
    pub fn identify(&self, datagram: &UdpDatagram<'_>) -> Result<DatagramIdentity, Unidentified> {
        match self.kind {
            FlowKind::Hil => own(datagram),
            FlowKind::Egm => whole(datagram, egm),
            FlowKind::Payload => whole(datagram, |_| Ok(None)),
            FlowKind::Number(field) => numbered(datagram, field),
        }
    }

    /// Bytes of a frame that are enough to identify its datagram.
    pub fn snap_bytes(&self) -> usize {
        match self.kind {
            FlowKind::Hil => BEFORE_PAYLOAD_BYTES + HEADER_BYTES,
            FlowKind::Number(field) => BEFORE_PAYLOAD_BYTES + field.end(),
            FlowKind::Egm | FlowKind::Payload => BEFORE_PAYLOAD_BYTES + 1472,
        }
    }
}

impl NumberField {
    /// Behind its last byte.
    fn end(self) -> usize {
        usize::from(self.offset) + usize::from(self.bytes)
    }
}

fn own(datagram: &UdpDatagram<'_>) -> Result<DatagramIdentity, Unidentified> {
    let payload = datagram.payload;
    if payload.len() >= MAGIC.len() && !payload.starts_with(&MAGIC) {
        return Err(Unidentified::Foreign);
    }
    let Some(bytes) = payload.get(..HEADER_BYTES) else {
        return Err(if datagram.is_cut_short() {
            Unidentified::CutShort
        } else {
            Unidentified::Foreign
        });
    };
    // A sealed header is as readable as a plain one.
    let (header, _is_sealed) = Header::read(bytes).map_err(|_refusal| Unidentified::Foreign)?;
    let series = [
        header.session.to_le_bytes(),
        header.epoch.to_le_bytes(),
        (u32::from(header.channel) << 8 | header.kind as u32).to_le_bytes(),
    ];
    Ok(DatagramIdentity {
        key: hash(bytes),
        number: Some(Numbered {
            series: hash(series.as_flattened()),
            number: header.sequence,
            bits: None,
            is_piece: header.fragment_count > 1,
        }),
        own: Some(OwnHeader {
            kind: header.kind,
            session: header.session,
            channel: header.channel,
            epoch: header.epoch,
            sequence: header.sequence,
            handed_ns: header.handed_ns,
            fragment_count: header.fragment_count,
        }),
    })
}

/// The identity by a hash of the whole payload, with the number that it counts with 32 bits.
fn whole(
    datagram: &UdpDatagram<'_>,
    count: impl FnOnce(&[u8]) -> Result<Option<u32>, Unidentified>,
) -> Result<DatagramIdentity, Unidentified> {
    if datagram.is_fragmented() {
        return Err(Unidentified::Fragmented);
    }
    if datagram.is_cut_short() {
        return Err(Unidentified::CutShort);
    }
    let number = count(datagram.payload)?;
    Ok(DatagramIdentity {
        key: hash(datagram.payload),
        number: number.map(|number| Numbered::in_one_series(number.into(), 32)),
        own: None,
    })
}

impl Numbered {
    const fn in_one_series(number: u64, bits: u8) -> Self {
        Self {
            series: 0,
            number,
            bits: Some(bits),
            is_piece: false,
        }
    }
}

/// The count of an EGM message.
fn egm(payload: &[u8]) -> Result<Option<u32>, Unidentified> {
    // Robot and sensor messages both carry the header in field 1, so the wrong one may decode.
    let header = match wire::message_type(payload) {
        Some(wire::MessageType::Data) => wire::decode_robot(payload).ok().and_then(|m| m.header),
        Some(wire::MessageType::Correction) => {
            wire::decode_sensor(payload).ok().and_then(|m| m.header)
        }
        Some(wire::MessageType::PathCorrection) => {
            let message = wire::decode_path_correction(payload).ok();
            message.and_then(|m| m.header)
        }
        _ => None,
    };
    Ok(header.ok_or(Unidentified::Foreign)?.seqno)
}

fn numbered(
    datagram: &UdpDatagram<'_>,
    field: NumberField,
) -> Result<DatagramIdentity, Unidentified> {
    if datagram.payload_bytes < field.end() {
        return Err(Unidentified::Foreign);
    }
    let bytes = datagram.payload.get(usize::from(field.offset)..field.end());
    let bytes = bytes.ok_or(Unidentified::CutShort)?;
    let add = |sum: u64, byte: &u8| sum << 8 | u64::from(*byte);
    let number = if field.is_little_endian {
        bytes.iter().rev().fold(0, add)
    } else {
        bytes.iter().fold(0, add)
    };
    Ok(DatagramIdentity {
        key: number,
        number: Some(Numbered::in_one_series(number, 8 * field.bytes)),
        own: None,
    })
}

fn hash(bytes: &[u8]) -> u64 {
    fnv1a(FNV_OFFSET, bytes)
}
