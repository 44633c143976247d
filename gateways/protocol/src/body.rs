//! Bodies of greetings, clock exchanges and answers. The header before them is in
//! [`super::wire`]; what they mean for a session is decided by the bridges.
//!
//! Offsets count from the end of the header; all numbers are little-endian.
//!
//! **HELLO** (41 bytes, a name, and zeros up to the length of datagram that is under test):
//!
//! | offset | bytes | field | meaning |
//! |-------:|------:|-------|---------|
//! | 0 | 16 | domain | fingerprint of the sender's shared-memory domain |
//! | 16 | 8 | `clock_id` | equal ids: both hosts read one monotonic clock |
//! | 24 | 2 | `channel_count` | channels of the flow; the header's `type_hash` is the digest over all of them |
//! | 26 | 14 | reserved | 0; makes every HELLO longer than its answer |
//! | 40 | 1 + n | flow name | length byte 1..=255, then UTF-8 |
//!
//! **`HELLO_ACK`** (40 bytes):
//!
//! | offset | bytes | field | meaning |
//! |-------:|------:|-------|---------|
//! | 0 | 1 | status | [`HelloStatus`] |
//! | 1 | 3 | reserved | 0 |
//! | 4 | 4 | session | start of the *answering* gateway |
//! | 8 | 8 | `clock_id` | of the answering host |
//! | 16 | 16 | domain | of the answering host |
//! | 32 | 8 | `answers_handed_ns` | `handed_ns` of the datagram answered |
//!
//! **`SYNC_REQ`** (40 bytes): all 0, so that neither the response nor a request for a greeting is ever
//! longer than the request. Its header's `handed_ns` is t1.
//!
//! **`SYNC_RSP`** (40 bytes):
//!
//! | offset | bytes | field | meaning |
//! |-------:|------:|-------|---------|
//! | 0 | 8 | `t1_ns` | the request's `handed_ns`, repeated; an application stamp of the requester |
//! | 8 | 8 | `t2_ns` | request's arrival, responder's monotonic clock |
//! | 16 | 8 | `t3_ns` | response handed to the kernel, responder's monotonic clock; an application stamp, refined by the follow-up of a later response |
//! | 24 | 1 | `t2_source` | [`StampSource`]: 0 application, 1 kernel software, 2 hardware |
//! | 25 | 15 | reserved | 0 |
//!
//! **`PIECE_ACK`** (8 bytes), for every 16th piece of a message above 64 KiB and its last one:
//!
//! | offset | bytes | field | meaning |
//! |-------:|------:|-------|---------|
//! | 0 | 8 | `answers_handed_ns` | `handed_ns` of the piece |

use bytemuck::checked::try_cast;

use super::refusal::Refusal;
use super::stamps::StampSource;
use super::wire::{array_at, i64_at, u16_at, u32_at, u64_at, write};

/// Longest name of a flow, channel or type.
pub const NAME_BYTES_MAX: usize = 255;
/// Bytes of a `SYNC_REQ` or `SYNC_RSP` body.
pub const SYNC_BODY_BYTES: usize = 40;
/// Bytes of a `HELLO_ACK` body.
pub const HELLO_ACK_BODY_BYTES: usize = 40;
/// Bytes of a `PIECE_ACK` body.
pub const PIECE_ACK_BODY_BYTES: usize = 8;
const HELLO_FIXED_BYTES: usize = 40;

/// Who greets and what it wants to send.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Hello<'a> {
    /// Fingerprint of the sender's shared-memory domain.
    pub domain: [u8; 16],
    /// Names the sender's monotonic clock.
    pub clock_id: u64,
    /// Channels of the flow.
    pub channel_count: u16,
    /// Name of the flow.
    pub flow_name: &'a str,
}

impl<'a> Hello<'a> {
    /// Bytes of the body.
    pub const fn encoded_bytes(&self) -> usize {
        HELLO_FIXED_BYTES + 1 + self.flow_name.len()
    }

    /// Writes the body to the start of `buffer` and returns its length.
    ///
    /// # Panics
    /// When `buffer` is shorter than [`Hello::encoded_bytes`] or the name is outside 1..=255 bytes.
    pub fn encode(&self, buffer: &mut [u8]) -> usize {
        let name = self.flow_name.as_bytes();
        let length = u8::try_from(name.len()).unwrap_or(0);
        assert!(
            length > 0,
            "a name of {} bytes is outside 1 to 255",
            name.len()
        );
        write(buffer, 0, self.domain);
        write(buffer, 16, self.clock_id.to_le_bytes());
        write(buffer, 24, self.channel_count.to_le_bytes());
        write(buffer, 26, [0; 14]);
        buffer[HELLO_FIXED_BYTES] = length;
        buffer[HELLO_FIXED_BYTES + 1..][..name.len()].copy_from_slice(name);
        self.encoded_bytes()
    }

    pub(crate) fn decode(body: &'a [u8]) -> Result<Self, Refusal> {
        if body.len() < HELLO_FIXED_BYTES {
            return Err(Refusal::MalformedBody);
        }
        let (flow_name, padding) = split_name(&body[HELLO_FIXED_BYTES..])?;
        if body[26..HELLO_FIXED_BYTES] != [0; 14] || padding.iter().any(|byte| *byte != 0) {
            return Err(Refusal::ReservedNotZero);
        }
        Ok(Self {
            domain: array_at(body, 0),
            clock_id: u64_at(body, 16),
            channel_count: u16_at(body, 24),
            flow_name,
        })
    }
}

fn split_name(bytes: &[u8]) -> Result<(&str, &[u8]), Refusal> {
    let (&length, rest) = bytes.split_first().ok_or(Refusal::MalformedBody)?;
    let length = usize::from(length);
    if length == 0 || length > rest.len() {
        return Err(Refusal::MalformedBody);
    }
    let (name, rest) = rest.split_at(length);
    match core::str::from_utf8(name) {
        Ok(name) => Ok((name, rest)),
        Err(_) => Err(Refusal::MalformedBody),
    }
}

hil_core::labelled! {
    /// How a greeting was answered.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, bytemuck::CheckedBitPattern)]
    #[repr(u8)]
    pub enum HelloStatus, label {
        /// Messages will be taken.
        Accepted: 0 = "accepted",
        /// The channels differ: in number, names, types, sizes or alignments.
        ChannelsDiffer: 1 = "the channels of the link differ; use the same topology and the same build on both hosts",
        /// Both ends of the flow lie in one shared-memory domain: messages would bypass the hop.
        SharedDomain: 2 = "both ends are in one shared-memory domain, so messages would bypass the network",
        /// The flow is not carried there.
        UnknownFlow: 3 = "another link ends there",
        /// The two gateways speak different versions.
        VersionMismatch: 4 = "the gateways speak different versions of the protocol",
        /// The session is not known there, probably because the answering gateway restarted.
        GreetAgain: 5 = "the session is not known there",
    }
}

/// The answer to a greeting, or a request for one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HelloAck {
    /// The answer.
    pub status: HelloStatus,
    /// Start of the answering gateway.
    pub session: u32,
    /// Names the answering host's monotonic clock.
    pub clock_id: u64,
    /// Fingerprint of the answering host's shared-memory domain.
    pub domain: [u8; 16],
    /// `handed_ns` of the datagram answered, so that an old answer is known as old.
    pub answers_handed_ns: i64,
}

impl HelloAck {
    /// Writes the body to the start of `buffer` and returns its length.
    ///
    /// # Panics
    /// When `buffer` is shorter than [`HELLO_ACK_BODY_BYTES`].
    pub fn encode(&self, buffer: &mut [u8]) -> usize {
        write(buffer, 0, [self.status as u8, 0, 0, 0]);
        write(buffer, 4, self.session.to_le_bytes());
        write(buffer, 8, self.clock_id.to_le_bytes());
        write(buffer, 16, self.domain);
        write(buffer, 32, self.answers_handed_ns.to_le_bytes());
        HELLO_ACK_BODY_BYTES
    }

    pub(crate) fn decode(body: &[u8]) -> Result<Self, Refusal> {
        if body.len() != HELLO_ACK_BODY_BYTES {
            return Err(Refusal::MalformedBody);
        }
        if body[1..4] != [0; 3] {
            return Err(Refusal::ReservedNotZero);
        }
        Ok(Self {
            status: try_cast(body[0]).map_err(|_unknown| Refusal::MalformedBody)?,
            session: u32_at(body, 4),
            clock_id: u64_at(body, 8),
            domain: array_at(body, 16),
            answers_handed_ns: i64_at(body, 32),
        })
    }
}

/// The responder's half of a clock exchange.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SyncResponse {
    /// The request's `handed_ns`, repeated.
    pub t1_ns: i64,
    /// Arrival of the request, responder's monotonic clock.
    pub t2_ns: i64,
    /// Just before sending the response, responder's monotonic clock.
    pub t3_ns: i64,
    /// What kind of stamp t2 is; t1 and t3 are application stamps.
    pub t2_source: StampSource,
}

impl SyncResponse {
    /// Writes the body to the start of `buffer` and returns its length.
    ///
    /// # Panics
    /// When `buffer` is shorter than [`SYNC_BODY_BYTES`].
    pub fn encode(&self, buffer: &mut [u8]) -> usize {
        write(buffer, 0, self.t1_ns.to_le_bytes());
        write(buffer, 8, self.t2_ns.to_le_bytes());
        write(buffer, 16, self.t3_ns.to_le_bytes());
        write(buffer, 24, [self.t2_source as u8]);
        write(buffer, 25, [0; 15]);
        SYNC_BODY_BYTES
    }

    pub(crate) fn decode(body: &[u8]) -> Result<Self, Refusal> {
        if body.len() != SYNC_BODY_BYTES {
            return Err(Refusal::MalformedBody);
        }
        if body[25..] != [0; 15] {
            return Err(Refusal::ReservedNotZero);
        }
        Ok(Self {
            t1_ns: i64_at(body, 0),
            t2_ns: i64_at(body, 8),
            t3_ns: i64_at(body, 16),
            t2_source: try_cast(body[24]).map_err(|_unknown| Refusal::MalformedBody)?,
        })
    }
}

/// The receiver has taken a piece of a long message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PieceAck {
    /// `handed_ns` of the piece.
    pub answers_handed_ns: i64,
}

impl PieceAck {
    /// Writes the body to the start of `buffer` and returns its length.
    ///
    /// # Panics
    /// When `buffer` is shorter than [`PIECE_ACK_BODY_BYTES`].
    pub fn encode(&self, buffer: &mut [u8]) -> usize {
        write(buffer, 0, self.answers_handed_ns.to_le_bytes());
        PIECE_ACK_BODY_BYTES
    }

    pub(crate) fn decode(body: &[u8]) -> Result<Self, Refusal> {
        if body.len() != PIECE_ACK_BODY_BYTES {
            return Err(Refusal::MalformedBody);
        }
        Ok(Self {
            answers_handed_ns: i64_at(body, 0),
        })
    }
}

pub(crate) fn check_sync_request(body: &[u8]) -> Result<(), Refusal> {
    if body.len() != SYNC_BODY_BYTES {
        return Err(Refusal::MalformedBody);
    }
    if body.iter().any(|&byte| byte != 0) {
        return Err(Refusal::ReservedNotZero);
    }
    Ok(())
}
