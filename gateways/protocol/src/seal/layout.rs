//! Where the seal's own fields lie in a datagram, and the two datagrams that are its own. It keeps no
//! state and knows no key.

use super::counts::SealRefusal;
use super::keys::{SALT_BYTES, Salt};
use crate::wire::{
    FLAG_AUTHENTICATED, HEADER_BYTES, Header, Kind, MAGIC, TAG_BYTES, VERSION, array_at, u16_at,
    u32_at, u64_at, write,
};

const FLAGS_AT: usize = 6;
const NUMBER_AT: usize = 68;
const MAC_BYTES: usize = 32;
const ABOUT_AT: usize = 32;
const ABOUT_BYTES: usize = 8;
/// Header and salt: what the code of a key exchange covers.
const COVERED_BYTES: usize = HEADER_BYTES + SALT_BYTES;
/// Bytes of a `KEY_REQ` or `KEY_ANS`.
pub const KEY_EXCHANGE_BYTES: usize = COVERED_BYTES + MAC_BYTES;

/// What the seal reads of a header before it knows whether it is authentic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct SealFields {
    pub(super) kind: Kind,
    pub(super) session: u32,
    /// Low 8 bits of the key's generation.
    pub(super) generation: u8,
    pub(super) number: u32,
    fragment: u16,
}

impl SealFields {
    /// Reads what must be right before a key is chosen.
    pub(super) fn read(datagram: &[u8], flow: u16) -> Result<Self, SealRefusal> {
        if datagram.len() >= 4 && u32_at(datagram, 0) != MAGIC {
            return Err(SealRefusal::BadMagic);
        }
        if datagram.len() < 16 {
            return Err(SealRefusal::TooShort);
        }
        if datagram[4] != VERSION {
            return Err(SealRefusal::WrongVersion);
        }
        let flags = u16_at(datagram, FLAGS_AT);
        if flags & FLAG_AUTHENTICATED == 0 {
            return Err(SealRefusal::NotSealed);
        }
        if datagram.len() < HEADER_BYTES + TAG_BYTES {
            return Err(SealRefusal::TooShort);
        }
        let kind = Kind::from_wire(datagram[5]).ok_or(SealRefusal::BadHeader)?;
        let [low, generation] = flags.to_le_bytes();
        if low != FLAG_AUTHENTICATED.to_le_bytes()[0]
            || usize::from(u16_at(datagram, 14)) != HEADER_BYTES
        {
            return Err(SealRefusal::BadHeader);
        }
        // What is about a channel of the flow is under the flow's keys.
        let is_key_exchange = matches!(kind, Kind::KeyRequest | Kind::KeyAnswer);
        if is_key_exchange && u16_at(datagram, 12) != flow {
            return Err(SealRefusal::ForeignFlow);
        }
        Ok(Self {
            kind,
            session: u32_at(datagram, 8),
            generation,
            number: u32_at(datagram, NUMBER_AT),
            fragment: u16_at(datagram, 60),
        })
    }

    /// Of a datagram that a bridge made.
    pub(super) fn of_plain(datagram: &[u8], generation: u8, number: u32) -> Self {
        Self {
            kind: kind_of(datagram),
            session: u32_at(datagram, 8),
            generation,
            number,
            fragment: u16_at(datagram, 60),
        }
    }

    /// Unique under a key because the number is; kind and fragment are in it so that two datagrams
    /// that differ in them could not meet even if it were not.
    pub(super) fn nonce(self) -> [u8; 12] {
        let mut nonce = [0; 12];
        nonce[0] = self.kind as u8;
        write(&mut nonce, 2, self.fragment.to_le_bytes());
        write(&mut nonce, 8, self.number.to_le_bytes());
        nonce
    }

    /// Writes the seal's fields into a header.
    pub(super) fn write(self, datagram: &mut [u8]) {
        let [low, _] = FLAG_AUTHENTICATED.to_le_bytes();
        write(datagram, FLAGS_AT, [low, self.generation]);
        write(datagram, NUMBER_AT, self.number.to_le_bytes());
    }
}

/// The first bytes of a salt, which tell of several starts of a gateway the one that is meant.
pub(super) fn about(salt: &Salt) -> [u8; ABOUT_BYTES] {
    array_at(salt, 0)
}

/// Takes the seal's fields out again, so that a bridge reads what the other one wrote.
pub(super) fn clear_marks(datagram: &mut [u8]) {
    write(datagram, FLAGS_AT, [0; 2]);
    write(datagram, NUMBER_AT, [0; 4]);
}

/// What a datagram of a bridge is for.
pub(super) fn kind_of(datagram: &[u8]) -> Kind {
    Kind::from_wire(datagram[5]).expect("a bridge makes datagrams of known kinds")
}

/// When a datagram was handed over, by its sender's clock.
pub(super) fn handed_ns_of(datagram: &[u8]) -> i64 {
    i64::from_le_bytes(array_at(datagram, 40))
}

/// A `KEY_REQ` or `KEY_ANS`, read but not yet believed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct KeyExchange {
    pub(super) kind: Kind,
    pub(super) session: u32,
    pub(super) flow: u16,
    /// Number of the request, which the answer repeats.
    pub(super) request: u64,
    /// Generation of the key under which this end seals.
    pub(super) generation: u32,
    /// The request's time of handing over, which the answer repeats.
    pub(super) handed_ns: i64,
    pub(super) salt: Salt,
    /// Of a request: the first bytes of the receiver's salt that `generation` belongs to; 0 without.
    pub(super) about: [u8; ABOUT_BYTES],
}

impl KeyExchange {
    pub(super) fn read(datagram: &[u8]) -> Result<Self, SealRefusal> {
        if datagram.len() != KEY_EXCHANGE_BYTES {
            return Err(SealRefusal::BadTag);
        }
        Ok(Self {
            kind: kind_of(datagram),
            session: u32_at(datagram, 8),
            flow: u16_at(datagram, 12),
            request: u64_at(datagram, 16),
            generation: u32_at(datagram, 64),
            handed_ns: handed_ns_of(datagram),
            salt: array_at(datagram, HEADER_BYTES),
            about: array_at(datagram, ABOUT_AT),
        })
    }

    /// Header and salt; the code over [`covered`] is still to come.
    pub(super) fn write(&self, datagram: &mut [u8; KEY_EXCHANGE_BYTES]) {
        let mut header = Header::new(self.kind, self.session, self.flow);
        header.sequence = self.request;
        header.handed_ns = self.handed_ns;
        header.epoch = self.generation;
        header.total_len = BODY_LEN;
        header.encode(datagram);
        write(datagram, FLAGS_AT, FLAG_AUTHENTICATED.to_le_bytes());
        write(datagram, HEADER_BYTES, self.salt);
        write(datagram, ABOUT_AT, self.about);
    }
}

#[expect(clippy::cast_possible_truncation, reason = "48 fits")]
const BODY_LEN: u32 = (KEY_EXCHANGE_BYTES - HEADER_BYTES) as u32;

/// What the code of a key exchange covers, and the code.
pub(super) fn covered(datagram: &[u8]) -> (&[u8], &[u8]) {
    datagram.split_at(COVERED_BYTES)
}

/// Where the code goes.
pub(super) fn code_place(datagram: &mut [u8; KEY_EXCHANGE_BYTES]) -> &mut [u8] {
    &mut datagram[COVERED_BYTES..]
}
