//! Bodies of greetings, answers and clock exchanges. The header before them is in
//! [`super::wire`]; what they mean for a session is decided by the bridges.
//!
//! Offsets count from the end of the header; all numbers are little-endian.
//!
//! **HELLO** (42 bytes and two names):
//!
//! | offset | bytes | field | meaning |
//! |-------:|------:|-------|---------|
//! | 0 | 16 | domain | fingerprint of the sender's shared-memory domain |
//! | 16 | 8 | `clock_id` | equal ids: both hosts read one monotonic clock |
//! | 24 | 4 | `size_max_bytes` | largest payload |
//! | 28 | 4 | `alignment_bytes` | in shared memory |
//! | 32 | 8 | reserved | 0; makes every HELLO longer than its answer |
//! | 40 | 1 + n | channel name | length byte 1..=255, then UTF-8 |
//! | 41 + n | 1 + m | type name | length byte 1..=255, then UTF-8 |
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
//! **`SYNC_REQ`** (80 bytes): all 0, so that the response is never longer than the request. Its
//! header's `handed_ns` is t1.
//!
//! **`SYNC_RSP`** (80 bytes):
//!
//! | offset | bytes | field | meaning |
//! |-------:|------:|-------|---------|
//! | 0 | 8 | t1_ns | the request's handed_ns, repeated; an application stamp of the requester |
//! | 8 | 8 | t2_ns | request's arrival, responder's monotonic clock |
//! | 16 | 8 | t3_ns | response handed to the kernel, responder's monotonic clock; an application stamp, refined by the follow-up of a later response |
//! | 24 | 8 | newest | newest sequence received |
//! | 32 | 32 | bitmap | bit i of the 256 (byte i / 8, bit i mod 8): newest − i was received |
//! | 64 | 4 | epoch | producer's start the window counts |
//! | 68 | 4 | sync_received_count | requests received in this session, this one included; wraps |
//! | 72 | 1 | t2_source | [`StampSource`]: 0 application, 1 kernel software, 2 hardware |
//! | 73 | 1 | window_valid | 0: no message received yet, newest, bitmap and epoch are 0; 1 |
//! | 74 | 6 | reserved | 0 |

use bytemuck::checked::try_cast;

use super::refusal::Refusal;
use super::stamps::StampSource;
use super::wire::{array_at, i64_at, u32_at, u64_at, write};

/// Longest channel or type name.
pub const NAME_BYTES_MAX: usize = 255;
/// Bytes of a `SYNC_REQ` or `SYNC_RSP` body.
pub const SYNC_BODY_BYTES: usize = 80;
/// Bytes of a `HELLO_ACK` body.
pub const HELLO_ACK_BODY_BYTES: usize = 40;
const HELLO_FIXED_BYTES: usize = 40;

/// Who greets and what it wants to send.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Hello<'a> {
    /// Fingerprint of the sender's shared-memory domain.
    pub domain: [u8; 16],
    /// Names the sender's monotonic clock.
    pub clock_id: u64,
    /// Largest payload.
    pub size_max_bytes: u32,
    /// Alignment of the payload.
    pub alignment_bytes: u32,
    /// Name of the channel.
    pub channel_name: &'a str,
    /// Name of the message type.
    pub type_name: &'a str,
}

impl<'a> Hello<'a> {
    /// Bytes of the body.
    pub const fn encoded_bytes(&self) -> usize {
        HELLO_FIXED_BYTES + 2 + self.channel_name.len() + self.type_name.len()
    }

    /// Writes the body to the start of `buffer` and returns its length.
    ///
    /// # Panics
    /// When `buffer` is shorter than [`Hello::encoded_bytes`] or a name is outside 1..=255 bytes.
    pub fn encode(&self, buffer: &mut [u8]) -> usize {
        write(buffer, 0, self.domain);
        write(buffer, 16, self.clock_id.to_le_bytes());
        write(buffer, 24, self.size_max_bytes.to_le_bytes());
        write(buffer, 28, self.alignment_bytes.to_le_bytes());
        write(buffer, 32, [0; 8]);
        let mut offset = HELLO_FIXED_BYTES;
        for name in [self.channel_name, self.type_name] {
            let length = u8::try_from(name.len()).unwrap_or(0);
            assert!(
                length > 0,
                "a name of {} bytes is outside 1 to 255",
                name.len()
            );
            buffer[offset] = length;
            buffer[offset + 1..][..name.len()].copy_from_slice(name.as_bytes());
            offset += 1 + name.len();
        }
        offset
    }

    pub(crate) fn decode(body: &'a [u8]) -> Result<Self, Refusal> {
        if body.len() < HELLO_FIXED_BYTES {
            return Err(Refusal::MalformedBody);
        }
        let (channel_name, rest) = split_name(&body[HELLO_FIXED_BYTES..])?;
        let (type_name, rest) = split_name(rest)?;
        if !rest.is_empty() {
            return Err(Refusal::MalformedBody);
        }
        if u64_at(body, 32) != 0 {
            return Err(Refusal::ReservedNotZero);
        }
        Ok(Self {
            domain: array_at(body, 0),
            clock_id: u64_at(body, 16),
            size_max_bytes: u32_at(body, 24),
            alignment_bytes: u32_at(body, 28),
            channel_name,
            type_name,
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

/// How a greeting was answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, bytemuck::CheckedBitPattern)]
#[repr(u8)]
pub enum HelloStatus {
    /// Messages will be taken.
    Accepted = 0,
    /// The message types differ.
    TypeMismatch = 1,
    /// Size or alignment differ.
    SizeMismatch = 2,
    /// Both ends of the channel lie in one shared-memory domain: messages would bypass the hop.
    SharedDomain = 3,
    /// The channel is not carried there.
    UnknownChannel = 4,
    /// The two gateways speak different versions.
    VersionMismatch = 5,
    /// The session is not known there, probably because the answering gateway restarted.
    GreetAgain = 6,
}

impl HelloStatus {
    /// The words a report prints.
    pub const fn label(self) -> &'static str {
        match self {
            Self::Accepted => "accepted",
            Self::TypeMismatch => "the message types differ; use the same build on both hosts",
            Self::SizeMismatch => "size or alignment of the messages differ",
            Self::SharedDomain => {
                "both ends are in one shared-memory domain, so messages would bypass the network"
            }
            Self::UnknownChannel => "the channel is not carried there",
            Self::VersionMismatch => "the gateways speak different versions of the protocol",
            Self::GreetAgain => "the session is not known there",
        }
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

/// The newest 256 sequence numbers as the receiver saw them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReceivedWindow {
    /// Producer's start.
    pub epoch: u32,
    /// Newest sequence received.
    pub newest: u64,
    /// Bit i: `newest - i` was received; bit i is bit i mod 64 of word i / 64.
    pub bitmap: [u64; 4],
}

impl ReceivedWindow {
    /// Sequence numbers a window covers.
    pub const LENGTH: u64 = 256;

    /// Whether `sequence` was received; `None` outside the window.
    pub fn contains(&self, sequence: u64) -> Option<bool> {
        let age = self.newest.checked_sub(sequence)?;
        let word = usize::try_from(age / 64).ok()?;
        Some(self.bitmap.get(word)? >> (age % 64) & 1 == 1)
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
    /// What the responder received; `None` before the first message.
    pub window: Option<ReceivedWindow>,
    /// Requests received in this session, this one included; wraps.
    pub sync_received_count: u32,
}

impl SyncResponse {
    /// Writes the body to the start of `buffer` and returns its length.
    ///
    /// # Panics
    /// When `buffer` is shorter than [`SYNC_BODY_BYTES`].
    pub fn encode(&self, buffer: &mut [u8]) -> usize {
        let window = self.window.unwrap_or(ReceivedWindow {
            epoch: 0,
            newest: 0,
            bitmap: [0; 4],
        });
        write(buffer, 0, self.t1_ns.to_le_bytes());
        write(buffer, 8, self.t2_ns.to_le_bytes());
        write(buffer, 16, self.t3_ns.to_le_bytes());
        write(buffer, 24, window.newest.to_le_bytes());
        for (index, word) in window.bitmap.iter().enumerate() {
            write(buffer, 32 + 8 * index, word.to_le_bytes());
        }
        write(buffer, 64, window.epoch.to_le_bytes());
        write(buffer, 68, self.sync_received_count.to_le_bytes());
        write(
            buffer,
            72,
            [self.t2_source as u8, u8::from(self.window.is_some())],
        );
        write(buffer, 74, [0; 6]);
        SYNC_BODY_BYTES
    }

    pub(crate) fn decode(body: &[u8]) -> Result<Self, Refusal> {
        if body.len() != SYNC_BODY_BYTES {
            return Err(Refusal::MalformedBody);
        }
        if body[74..] != [0; 6] {
            return Err(Refusal::ReservedNotZero);
        }
        let window = ReceivedWindow {
            epoch: u32_at(body, 64),
            newest: u64_at(body, 24),
            bitmap: core::array::from_fn(|word| u64_at(body, 32 + 8 * word)),
        };
        let is_empty = window.newest == 0 && window.epoch == 0 && window.bitmap == [0; 4];
        let window = match (body[73], window.bitmap[0] & 1) {
            (0, _) if is_empty => None,
            (1, 1) => Some(window),
            _ => return Err(Refusal::MalformedBody),
        };
        Ok(Self {
            t1_ns: i64_at(body, 0),
            t2_ns: i64_at(body, 8),
            t3_ns: i64_at(body, 16),
            t2_source: try_cast(body[72]).map_err(|_unknown| Refusal::MalformedBody)?,
            window,
            sync_received_count: u32_at(body, 68),
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
