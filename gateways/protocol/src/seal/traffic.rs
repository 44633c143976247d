//! One way of an agreed association: sealing under a key that rotates, and opening under the keys that
//! may be in use. It draws no random number and reads no clock: time is what the datagrams say.

use super::counts::{SealCounts, SealRefusal};
use super::keys::{Generation, SealKey};
use super::layout::{SealFields, clear_marks, handed_ns_of};
use super::window::ReplayWindow;
use crate::wire::{HEADER_BYTES, TAG_BYTES};

/// Generations that a receiver goes ahead at most when an authentic key exchange says how far the
/// sender is: at one in five minutes, eight days of silence.
const CATCH_UP_MAX: u32 = 2_304;

/// How long a key serves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rotation {
    /// Datagrams sealed under one key at most; below 2^32, which the number holds.
    pub datagram_count: u32,
    /// Time between its first and last datagram at most, by the sender's clock, nanoseconds.
    pub period_ns: i64,
    /// How long after the first datagram of a generation one of the generation before is taken, by
    /// the sender's clock, nanoseconds.
    pub grace_ns: i64,
}

impl Default for Rotation {
    /// 2^20 datagrams or five minutes: RFC 9001, section 6.6, allows AES-GCM 2^23 packets of 64 KiB
    /// and either cipher 2^36 forgeries under a key.
    fn default() -> Self {
        Self {
            datagram_count: 1 << 20,
            period_ns: 300_000_000_000,
            grace_ns: 2_000_000_000,
        }
    }
}

/// The end that seals.
#[derive(Debug)]
pub(super) struct SealingWay {
    generation: Generation,
    key: SealKey,
    /// How many came before it.
    index: u32,
    number: u32,
    /// When its first datagram was handed over.
    since_ns: Option<i64>,
    rotation: Rotation,
}

impl SealingWay {
    pub(super) fn new(generation: Generation, rotation: Rotation) -> Self {
        Self {
            key: generation.key(),
            generation,
            index: 0,
            number: 0,
            since_ns: None,
            rotation,
        }
    }

    /// Generation in use.
    pub(super) const fn index(&self) -> u32 {
        self.index
    }

    /// Seals the plain datagram at the start of `datagram`, whose last 16 bytes take the tag.
    pub(super) fn seal(&mut self, datagram: &mut [u8], counts: &mut SealCounts) {
        let handed_ns = handed_ns_of(datagram);
        let since_ns = *self.since_ns.get_or_insert(handed_ns);
        if self.number >= self.rotation.datagram_count
            || handed_ns.saturating_sub(since_ns) >= self.rotation.period_ns
        {
            self.rotate(handed_ns);
            counts.rotation_count += 1;
        }
        let fields = SealFields::of_plain(datagram, low_byte(self.index), self.number);
        self.number += 1;
        fields.write(datagram);
        self.key.seal(fields.nonce(), datagram);
        counts.sealed_count += 1;
    }

    fn rotate(&mut self, handed_ns: i64) {
        self.generation = self.generation.next();
        self.key = self.generation.key();
        self.index = self.index.wrapping_add(1);
        self.number = 0;
        self.since_ns = Some(handed_ns);
    }
}

#[derive(Debug)]
struct OpeningKey {
    key: SealKey,
    window: ReplayWindow,
}

impl OpeningKey {
    fn new(generation: &Generation) -> Self {
        Self {
            key: generation.key(),
            window: ReplayWindow::default(),
        }
    }

    /// Authenticity first, then whether it is new.
    fn open(&mut self, fields: SealFields, datagram: &mut [u8]) -> Result<(), SealRefusal> {
        if !self.key.open(fields.nonce(), datagram) {
            return Err(SealRefusal::BadTag);
        }
        self.window.take(fields.number)
    }
}

/// The end that opens.
#[derive(Debug)]
pub(super) struct OpeningWay {
    index: u32,
    previous: Option<OpeningKey>,
    current: OpeningKey,
    next: OpeningKey,
    /// The generation of `next`.
    next_generation: Generation,
    /// When the first datagram of the current generation was handed over.
    since_ns: i64,
    grace_ns: i64,
}

impl OpeningWay {
    pub(super) fn new(generation: &Generation, rotation: Rotation) -> Self {
        let next_generation = generation.next();
        Self {
            index: 0,
            previous: None,
            current: OpeningKey::new(generation),
            next: OpeningKey::new(&next_generation),
            next_generation,
            since_ns: i64::MIN,
            grace_ns: rotation.grace_ns,
        }
    }

    /// Opens a datagram in place; what is left is the plain datagram, whose length it gives.
    pub(super) fn open(
        &mut self,
        fields: SealFields,
        datagram: &mut [u8],
        counts: &mut SealCounts,
    ) -> Result<usize, SealRefusal> {
        let ahead = fields.generation.wrapping_sub(low_byte(self.index));
        match (ahead, &mut self.previous) {
            (0, _) => self.current.open(fields, datagram)?,
            (1, _) => {
                self.next.open(fields, datagram)?;
                self.turn(handed_ns_of(datagram), counts);
            }
            (u8::MAX, Some(previous)) => previous.open(fields, datagram)?,
            _ => return Err(SealRefusal::StaleEpoch),
        }
        let handed_ns = handed_ns_of(datagram);
        if self.previous.is_some() && handed_ns.saturating_sub(self.since_ns) > self.grace_ns {
            self.previous = None;
        }
        clear_marks(datagram);
        debug_assert!(
            datagram.len() >= HEADER_BYTES + TAG_BYTES,
            "checked with the marks"
        );
        counts.opened_count += 1;
        Ok(datagram.len() - TAG_BYTES)
    }

    /// The next generation becomes the current one.
    fn turn(&mut self, handed_ns: i64, counts: &mut SealCounts) {
        self.next_generation = self.next_generation.next();
        let after = OpeningKey::new(&self.next_generation);
        let new = core::mem::replace(&mut self.next, after);
        self.previous = Some(core::mem::replace(&mut self.current, new));
        self.index = self.index.wrapping_add(1);
        self.since_ns = handed_ns;
        counts.rotation_count += 1;
    }

    /// Goes to generation `index`, of which an authentic key exchange tells: the datagrams that would
    /// have told of the ones between were lost.
    pub(super) fn catch_up(&mut self, index: u32, handed_ns: i64, counts: &mut SealCounts) {
        let ahead = index.wrapping_sub(self.index);
        if !(2..=CATCH_UP_MAX).contains(&ahead) {
            return;
        }
        for _ in 0..ahead {
            self.turn(handed_ns, counts);
        }
        self.previous = None;
    }
}

const fn low_byte(index: u32) -> u8 {
    index.to_le_bytes()[0]
}
