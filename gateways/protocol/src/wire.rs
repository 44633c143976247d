//! The datagram: 72 bytes of header, then payload or body, then a 16-byte tag or room for it. Bodies
//! are in [`super::body`]; nothing here knows sessions, windows, keys or state.
//!
//! All numbers are little-endian and unaligned. A **flow** is what one link carries one way: its channels share
//! addresses, sessions, seal and clock exchanges, and DATA and BYE name the channel they are about. Version 2:
//!
//! | offset | bytes | field | meaning |
//! |-------:|------:|-------|---------|
//! | 0 | 4 | magic | `48 49 4c 47`, the letters `HILG` |
//! | 4 | 1 | version | 2 |
//! | 5 | 1 | kind | 1 DATA, 2 `SYNC_REQ`, 3 `SYNC_RSP`, 4 HELLO, 5 `HELLO_ACK`, 6 BYE; 7 `KEY_REQ`, 8 `KEY_ANS` of the seal; 9 `PIECE_ACK` |
//! | 6 | 2 | flags | bit 0: sealed, what follows the header is encrypted and ends in a tag; then bits 8..16: low 8 bits of the key's generation; others 0 |
//! | 8 | 4 | session | start of the *sending-side* gateway; replies repeat the request's |
//! | 12 | 2 | channel | DATA: number of the channel between the two hosts; BYE: of the channel, or of the flow; otherwise of the flow |
//! | 14 | 2 | `header_len` | 72 |
//! | 16 | 8 | sequence | DATA: the producer's; `SYNC_REQ`, HELLO: own count; replies repeat the request's; BYE: one past the channel's last message taken for sending, 0 for the flow |
//! | 24 | 8 | `type_hash` | DATA, BYE of a channel: hash over message type name, size and alignment; otherwise digest over all channels of the flow |
//! | 32 | 8 | `published_ns` | DATA: producer's stamp, sender's monotonic clock, `i64::MIN` when it has none; otherwise 0 |
//! | 40 | 8 | `handed_ns` | just before the send call, sender's monotonic clock |
//! | 48 | 4 | `follow_up_sequence` | low 32 bits of an *earlier* sequence of this kind |
//! | 52 | 4 | `follow_up_delta_ns` | that datagram's kernel transmit stamp minus its `handed_ns`; `ff ff ff ff` none |
//! | 56 | 4 | `total_len` | DATA: bytes of the whole message; otherwise bytes of the body |
//! | 60 | 2 | `fragment_index` | 0-based; 0 unless DATA |
//! | 62 | 2 | `fragment_count` | 1..=40000; 1 unless DATA |
//! | 64 | 4 | epoch | DATA, BYE of a channel: producer's start; otherwise 0 |
//! | 68 | 4 | number | sealed: of the datagram under its key; otherwise 0 |
//! | 72 | n | payload or body | |
//! | 72 + n | 0 or 16 | tag | only with flag bit 0 |
//!
//! Bytes 0..16 keep their place in every version, so that two versions can tell each other apart.
//! The follow-up is the two-step idea of IEEE 1588 (clause 9.5.10): a transmit stamp exists only
//! after its datagram has left, so it rides on a later one. A fragment's length follows from
//! `total_len` and `fragment_count` alone ([`super::fragment`]), so overlaps cannot be expressed.
//!
//! Numbers of flows are counted down from 65535, where no channel's is. A **clock path** is a flow
//! without channels over addresses of its own, called `clock/` with the names of both hosts. Nothing in
//! a datagram tells it from another flow.
//!
//! Sealing a hop is the business of [`super::seal`], which lies between bridges and transport: a bridge
//! refuses a set bit 0. The room for the tag is kept free on a plain hop too, so that both fragment
//! alike. `KEY_REQ` and `KEY_ANS` are the seal's own: header, 16 bytes of salt, 32 of HMAC-SHA256 over
//! both. Their sequence is the request's number, their epoch the generation of the sender's key, and of
//! a request `published_ns` the first bytes of the salt that generation belongs to.

use super::body::{Hello, HelloAck, PieceAck, SyncResponse, check_sync_request};
use super::fragment::{FRAGMENT_COUNT_MAX, FragmentPlan};
use super::refusal::Refusal;

/// First four bytes of every datagram, as a little-endian number.
pub const MAGIC: u32 = u32::from_le_bytes(*b"HILG");
/// Version of the layout in the module documentation.
pub const VERSION: u8 = 2;
/// Bytes before the payload.
pub const HEADER_BYTES: usize = 72;
/// Bytes kept free after the payload for an authentication tag.
pub const TAG_BYTES: usize = 16;
/// Flag bit: sealed, and a tag follows the payload.
pub const FLAG_AUTHENTICATED: u16 = 1;
/// Flag bits: low 8 bits of the generation of the key.
pub const FLAGS_GENERATION: u16 = 0xff00;
/// Largest payload or body of one datagram on a path that carries `datagram_max_bytes`.
pub const fn payload_budget_bytes(datagram_max_bytes: usize) -> usize {
    datagram_max_bytes.saturating_sub(HEADER_BYTES + TAG_BYTES)
}

/// What a datagram is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, bytemuck::CheckedBitPattern)]
#[repr(u8)]
pub enum Kind {
    /// A message or a fragment of one.
    Data = 1,
    /// Asks for a clock exchange.
    SyncRequest = 2,
    /// Answers it.
    SyncResponse = 3,
    /// Opens or confirms a session.
    Hello = 4,
    /// Accepts, refuses or asks for a greeting.
    HelloAck = 5,
    /// The session ends.
    Bye = 6,
    /// The seal asks for keys.
    KeyRequest = 7,
    /// And gets them.
    KeyAnswer = 8,
    /// A piece of a long message has come.
    PieceAck = 9,
}

impl Kind {
    pub(crate) fn from_wire(code: u8) -> Option<Self> {
        bytemuck::checked::try_cast(code).ok()
    }
}

/// A transmit stamp that rides on a later datagram of the same kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FollowUpField {
    /// Low 32 bits of the earlier sequence.
    pub sequence_low: u32,
    /// Kernel transmit stamp minus `handed_ns` of that datagram; below `u32::MAX`.
    pub handed_to_tx_ns: u32,
}

impl FollowUpField {
    /// The stamp of the datagram `sequence`.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "the low half is what travels"
    )]
    pub(crate) const fn new(sequence: u64, handed_to_tx_ns: u32) -> Self {
        Self {
            sequence_low: sequence as u32,
            handed_to_tx_ns,
        }
    }

    /// The full sequence it belongs to, given the sequence of the datagram it rode on; `None`
    /// when it would lie before zero.
    pub const fn sequence(self, carried_by: u64) -> Option<u64> {
        #[expect(
            clippy::cast_possible_truncation,
            reason = "the low half is what travels"
        )]
        let back = (carried_by as u32).wrapping_sub(self.sequence_low);
        carried_by.checked_sub(back as u64)
    }
}

/// The header's fields that are not fixed by the version.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Header {
    /// What the datagram is for.
    pub kind: Kind,
    /// Start of the sending-side gateway.
    pub session: u32,
    /// Number of the channel or of the flow.
    pub channel: u16,
    /// See the table: message, request or reply number.
    pub sequence: u64,
    /// Message type, or digest of the flow.
    pub type_hash: u64,
    /// Producer's stamp, nanoseconds on the sender's monotonic clock.
    pub published_ns: i64,
    /// Just before the send call, nanoseconds on the sender's monotonic clock.
    pub handed_ns: i64,
    /// Transmit stamp of an earlier datagram.
    pub follow_up: Option<FollowUpField>,
    /// Bytes of the whole message or of the body.
    pub total_len: u32,
    /// 0-based fragment.
    pub fragment_index: u16,
    /// Datagrams of the message.
    pub fragment_count: u16,
    /// Producer's start.
    pub epoch: u32,
}

impl Header {
    /// A header with everything at rest but kind, session and channel.
    pub const fn new(kind: Kind, session: u32, channel: u16) -> Self {
        Self {
            kind,
            session,
            channel,
            sequence: 0,
            type_hash: 0,
            published_ns: 0,
            handed_ns: 0,
            follow_up: None,
            total_len: 0,
            fragment_index: 0,
            fragment_count: 1,
            epoch: 0,
        }
    }

    /// Writes the header to the start of `buffer`.
    ///
    /// # Panics
    /// When `buffer` is shorter than [`HEADER_BYTES`].
    pub fn encode(&self, buffer: &mut [u8]) {
        let (sequence_low, delta) = match self.follow_up {
            Some(field) => (field.sequence_low, field.handed_to_tx_ns),
            None => (0, u32::MAX),
        };
        write(buffer, 0, MAGIC.to_le_bytes());
        write(buffer, 4, [VERSION, self.kind as u8]);
        write(buffer, 6, 0_u16.to_le_bytes());
        write(buffer, 8, self.session.to_le_bytes());
        write(buffer, 12, self.channel.to_le_bytes());
        write(buffer, 14, HEADER_LEN.to_le_bytes());
        write(buffer, 16, self.sequence.to_le_bytes());
        write(buffer, 24, self.type_hash.to_le_bytes());
        write(buffer, 32, self.published_ns.to_le_bytes());
        write(buffer, 40, self.handed_ns.to_le_bytes());
        write(buffer, 48, sequence_low.to_le_bytes());
        write(buffer, 52, delta.to_le_bytes());
        write(buffer, 56, self.total_len.to_le_bytes());
        write(buffer, 60, self.fragment_index.to_le_bytes());
        write(buffer, 62, self.fragment_count.to_le_bytes());
        write(buffer, 64, self.epoch.to_le_bytes());
        write(buffer, 68, 0_u32.to_le_bytes());
    }

    pub(crate) fn decode(bytes: &[u8]) -> Result<Self, Refusal> {
        match Self::read(bytes)? {
            (_, true) => Err(Refusal::AuthenticationNotConfigured),
            (header, false) => Ok(header),
        }
    }

    /// The header of a datagram as anyone on the wire can read it, and whether it is sealed: then only
    /// the holder of the key can tell whether it is true.
    ///
    /// # Errors
    /// The first [`Refusal`] that the header alone can show.
    pub fn read(bytes: &[u8]) -> Result<(Self, bool), Refusal> {
        let Some(prefix) = Prefix::decode(bytes) else {
            let known = bytes.len() < 4 || u32_at(bytes, 0) == MAGIC;
            return Err(if known {
                Refusal::TooShort
            } else {
                Refusal::BadMagic
            });
        };
        if prefix.version != VERSION {
            return Err(Refusal::UnsupportedVersion);
        }
        if bytes.len() < HEADER_BYTES {
            return Err(Refusal::TooShort);
        }
        let kind = prefix.kind.ok_or(Refusal::UnknownKind)?;
        if u16_at(bytes, 14) != HEADER_LEN {
            return Err(Refusal::BadHeaderLength);
        }
        let flags = u16_at(bytes, 6);
        let is_sealed = flags & FLAG_AUTHENTICATED != 0;
        let known = if is_sealed {
            FLAG_AUTHENTICATED | FLAGS_GENERATION
        } else {
            0
        };
        if flags & !known != 0 {
            return Err(Refusal::UnknownFlags);
        }
        if !is_sealed && u32_at(bytes, 68) != 0 {
            return Err(Refusal::ReservedNotZero);
        }
        let delta = u32_at(bytes, 52);
        let header = Self {
            kind,
            session: prefix.session,
            channel: prefix.channel,
            sequence: u64_at(bytes, 16),
            type_hash: u64_at(bytes, 24),
            published_ns: i64_at(bytes, 32),
            handed_ns: i64_at(bytes, 40),
            follow_up: (delta != u32::MAX).then(|| FollowUpField {
                sequence_low: u32_at(bytes, 48),
                handed_to_tx_ns: delta,
            }),
            total_len: u32_at(bytes, 56),
            fragment_index: u16_at(bytes, 60),
            fragment_count: u16_at(bytes, 62),
            epoch: u32_at(bytes, 64),
        };
        Ok((header, is_sealed))
    }

    /// Checks the length and fragment fields against the bytes after the header.
    fn check_lengths(&self, payload: &[u8]) -> Result<(), Refusal> {
        let expected = if self.kind == Kind::Data {
            if usize::from(self.fragment_count) > FRAGMENT_COUNT_MAX {
                return Err(Refusal::FragmentInconsistent);
            }
            FragmentPlan::from_wire(self.total_len, self.fragment_count)
                .and_then(|plan| plan.range(self.fragment_index))
                .ok_or(Refusal::FragmentInconsistent)?
                .len()
        } else if (self.fragment_index, self.fragment_count) == (0, 1) {
            self.total_len as usize
        } else {
            return Err(Refusal::FragmentInconsistent);
        };
        if payload.len() == expected {
            Ok(())
        } else {
            Err(Refusal::LengthMismatch)
        }
    }
}

/// The first 16 bytes, whose layout no version changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Prefix {
    pub(crate) version: u8,
    pub(crate) kind: Option<Kind>,
    pub(crate) session: u32,
    pub(crate) channel: u16,
}

impl Prefix {
    /// `None` when too short or not of this protocol.
    pub(crate) fn decode(bytes: &[u8]) -> Option<Self> {
        (bytes.len() >= 16 && u32_at(bytes, 0) == MAGIC).then(|| Self {
            version: bytes[4],
            kind: Kind::from_wire(bytes[5]),
            session: u32_at(bytes, 8),
            channel: u16_at(bytes, 12),
        })
    }
}

/// A datagram whose bytes have been checked as far as bytes alone allow.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Datagram<'a> {
    /// The header.
    pub header: Header,
    /// What follows it.
    pub body: Body<'a>,
}

/// What follows the header, by kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Body<'a> {
    /// The message, or the fragment the header names.
    Data(&'a [u8]),
    /// Padding only, as long as the response.
    SyncRequest,
    /// The responder's stamps.
    SyncResponse(SyncResponse),
    /// Who greets and what it wants to send.
    Hello(Hello<'a>),
    /// The answer.
    HelloAck(HelloAck),
    /// Which piece has come.
    PieceAck(PieceAck),
    /// Nothing.
    Bye,
}

/// Checks and reads one datagram.
///
/// # Errors
/// The first [`Refusal`] that bytes alone can show; sessions, channels and windows are checked by
/// the bridges.
pub fn decode(bytes: &[u8]) -> Result<Datagram<'_>, Refusal> {
    let header = Header::decode(bytes)?;
    let payload = &bytes[HEADER_BYTES..];
    header.check_lengths(payload)?;
    let body = match header.kind {
        Kind::Data => Body::Data(payload),
        Kind::SyncRequest => {
            check_sync_request(payload)?;
            Body::SyncRequest
        }
        Kind::SyncResponse => Body::SyncResponse(SyncResponse::decode(payload)?),
        Kind::Hello => Body::Hello(Hello::decode(payload)?),
        Kind::HelloAck => Body::HelloAck(HelloAck::decode(payload)?),
        Kind::PieceAck => Body::PieceAck(PieceAck::decode(payload)?),
        Kind::Bye if payload.is_empty() => Body::Bye,
        Kind::Bye => return Err(Refusal::MalformedBody),
        // The seal takes its own out before a bridge sees them.
        Kind::KeyRequest | Kind::KeyAnswer => return Err(Refusal::UnexpectedKind),
    };
    Ok(Datagram { header, body })
}

#[expect(clippy::cast_possible_truncation, reason = "72 fits")]
const HEADER_LEN: u16 = HEADER_BYTES as u16;

pub(crate) fn write<const N: usize>(buffer: &mut [u8], offset: usize, bytes: [u8; N]) {
    buffer[offset..offset + N].copy_from_slice(&bytes);
}

pub(crate) fn array_at<const N: usize>(bytes: &[u8], offset: usize) -> [u8; N] {
    let mut array = [0; N];
    array.copy_from_slice(&bytes[offset..offset + N]);
    array
}

pub(crate) fn u16_at(bytes: &[u8], offset: usize) -> u16 {
    u16::from_le_bytes(array_at(bytes, offset))
}

pub(crate) fn u32_at(bytes: &[u8], offset: usize) -> u32 {
    u32::from_le_bytes(array_at(bytes, offset))
}

pub(crate) fn u64_at(bytes: &[u8], offset: usize) -> u64 {
    u64::from_le_bytes(array_at(bytes, offset))
}

pub(crate) fn i64_at(bytes: &[u8], offset: usize) -> i64 {
    i64::from_le_bytes(array_at(bytes, offset))
}
