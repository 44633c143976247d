//! Messages above the path MTU: how they split, and where the pieces belong when they come together
//! again. The bytes are kept by the owner; no length from the network is trusted.
//!
//! Splitting is balanced: a message of `total` bytes that needs `count` datagrams is cut into
//! pieces of `ceil(total / count)` bytes, the last one shorter. A piece's place and length thus
//! follow from two numbers every fragment carries, so that pieces can neither overlap nor leave a
//! hole, and a receiver need not know the sender's MTU.

use core::ops::Range;
use core::time::Duration;

use hil_core::time::{Instant, RemoteInstant};

use super::ingress::{Incomplete, MessageInfo};
use super::refusal::Refusal;
use super::wire::Header;
use crate::counts;

/// Most datagrams of one message: enough for 16 MiB on a path of 576 bytes, with IPv6.
pub const FRAGMENT_COUNT_MAX: usize = 40_000;

/// How one message is cut.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FragmentPlan {
    total_bytes: usize,
    fragment_bytes: usize,
    count: u16,
}

impl FragmentPlan {
    /// Cuts `total_bytes` into pieces of at most `budget_bytes`; `None` when that takes more than
    /// [`FRAGMENT_COUNT_MAX`] or no budget is given.
    pub fn new(total_bytes: usize, budget_bytes: usize) -> Option<Self> {
        let count = total_bytes.checked_div(budget_bytes).map(|_| {
            let pieces = total_bytes.div_ceil(budget_bytes);
            pieces.max(1)
        })?;
        if count > FRAGMENT_COUNT_MAX {
            return None;
        }
        Some(Self {
            total_bytes,
            fragment_bytes: total_bytes.div_ceil(count),
            count: u16::try_from(count).ok()?,
        })
    }

    /// The cut that a header describes; `None` when no cut gives these numbers.
    pub fn from_wire(total_len: u32, fragment_count: u16) -> Option<Self> {
        let count = usize::from(fragment_count);
        let total_bytes = total_len as usize;
        if count == 0 || count > FRAGMENT_COUNT_MAX {
            return None;
        }
        let fragment_bytes = total_bytes.div_ceil(count);
        let is_last_empty = count > 1 && (count - 1) * fragment_bytes >= total_bytes;
        (!is_last_empty).then_some(Self {
            total_bytes,
            fragment_bytes,
            count: fragment_count,
        })
    }

    /// Datagrams the message takes, 1..=40000.
    pub const fn count(&self) -> u16 {
        self.count
    }

    /// Bytes of the whole message.
    pub const fn total_bytes(&self) -> usize {
        self.total_bytes
    }

    /// Bytes of every piece but the last.
    pub const fn fragment_bytes(&self) -> usize {
        self.fragment_bytes
    }

    /// Which bytes of the message piece `index` carries; `None` when there is no such piece.
    pub fn range(&self, index: u16) -> Option<Range<usize>> {
        let start = usize::from(index) * self.fragment_bytes;
        (index < self.count).then(|| start..(start + self.fragment_bytes).min(self.total_bytes))
    }
}

/// Where a piece belongs; [`Reassembler::stored`] takes it once the piece is there.
#[derive(Debug, PartialEq, Eq)]
pub struct Place {
    /// The slot of its message.
    pub slot: usize,
    /// Its message begins: whatever the slot had before is over.
    pub is_first: bool,
    /// Where it begins in its message, bytes.
    pub offset_bytes: usize,
    index: u16,
    handed_ns: i64,
}

/// A message of which every piece is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Assembled {
    /// Who it is.
    pub message: MessageInfo,
    /// Bytes of the whole message.
    pub length_bytes: usize,
}

counts! {
    /// What became of the messages that came in pieces.
    pub struct ReassemblyCounts {
        /// Messages of which a first piece came.
        started_count,
        /// Messages put together.
        completed_count,
        /// Incomplete messages that gave way to a newer one.
        evicted_count,
        /// Incomplete messages whose time was up.
        timed_out_count,
        /// Incomplete messages given up because their session was over.
        abandoned_count,
    }
}

/// Keeps account of the messages that come together in a fixed number of slots.
#[derive(Debug)]
pub struct Reassembler {
    channel: usize,
    slots: Box<[Slot]>,
    size_max_bytes: usize,
    timeout: Duration,
    /// Taken by the owner after every call.
    given_up: Vec<Incomplete>,
    counts: ReassemblyCounts,
}

#[derive(Debug, Clone)]
struct Slot {
    message: Option<MessageInfo>,
    total_len: u32,
    missing: u16,
    received: Box<[u64]>,
    started_at: Instant,
    /// When its last piece came.
    heard_at: Instant,
}

impl Reassembler {
    /// For `slot_count` messages of at most `size_max_bytes` of the channel with index `channel`; an incomplete one is
    /// given up `timeout` after its last piece.
    ///
    /// # Panics
    /// When `slot_count` is zero.
    pub fn new(
        channel: usize,
        slot_count: usize,
        size_max_bytes: usize,
        timeout: Duration,
    ) -> Self {
        assert!(slot_count > 0, "reassembly needs at least one slot");
        let empty = Slot {
            message: None,
            total_len: 0,
            missing: 0,
            // No message has more pieces than bytes.
            received: vec![0; size_max_bytes.clamp(1, FRAGMENT_COUNT_MAX).div_ceil(64)]
                .into_boxed_slice(),
            started_at: Instant::ZERO,
            heard_at: Instant::ZERO,
        };
        Self {
            channel,
            slots: vec![empty; slot_count].into_boxed_slice(),
            size_max_bytes,
            timeout,
            given_up: Vec::with_capacity(slot_count + 1),
            counts: ReassemblyCounts::default(),
        }
    }

    /// Where the piece of `piece_bytes` behind `header` belongs.
    ///
    /// # Errors
    /// [`Refusal::Oversize`], [`Refusal::FragmentInconsistent`], [`Refusal::LengthMismatch`] or
    /// [`Refusal::DuplicateFragment`]; the slots are then as they were.
    pub fn place(
        &mut self,
        now: Instant,
        header: &Header,
        piece_bytes: usize,
    ) -> Result<Place, Refusal> {
        if header.total_len as usize > self.size_max_bytes {
            return Err(Refusal::Oversize);
        }
        let range = FragmentPlan::from_wire(header.total_len, header.fragment_count)
            .and_then(|plan| plan.range(header.fragment_index))
            .ok_or(Refusal::FragmentInconsistent)?;
        if range.len() != piece_bytes {
            return Err(Refusal::LengthMismatch);
        }
        self.expire(now);
        let found = self.find(header)?;
        let slot = found.unwrap_or_else(|| self.open(now, header));
        self.slots[slot].heard_at = now;
        Ok(Place {
            slot,
            is_first: found.is_none(),
            offset_bytes: range.start,
            index: header.fragment_index,
            handed_ns: header.handed_ns,
        })
    }

    /// Notes that the bytes of a piece are at its place; gives its message once it is whole, whose slot is then
    /// free. Without this the piece is missing as if it had not come.
    #[expect(
        clippy::needless_pass_by_value,
        reason = "a place is filled once: it is neither copied nor used again"
    )]
    pub fn stored(&mut self, place: Place) -> Option<Assembled> {
        let slot = &mut self.slots[place.slot];
        slot.receive(&place);
        if slot.missing > 0 {
            return None;
        }
        let message = slot.message.take()?;
        self.counts.completed_count += 1;
        Some(Assembled {
            message,
            length_bytes: slot.total_len as usize,
        })
    }

    /// Gives up incomplete messages whose time is up.
    pub fn expire(&mut self, now: Instant) {
        for slot in &mut self.slots {
            if slot.message.is_some() && slot.heard_at + self.timeout <= now {
                self.given_up.extend(slot.give_up());
                self.counts.timed_out_count += 1;
            }
        }
    }

    /// Gives up every incomplete message.
    pub fn clear(&mut self) {
        for slot in &mut self.slots {
            if let Some(given_up) = slot.give_up() {
                self.given_up.push(given_up);
                self.counts.abandoned_count += 1;
            }
        }
    }

    /// When the next incomplete message is given up.
    pub fn next_expiry(&self) -> Option<Instant> {
        let open = self.slots.iter().filter(|slot| slot.message.is_some());
        open.map(|slot| slot.heard_at + self.timeout).min()
    }

    /// Incomplete messages.
    pub fn open_count(&self) -> usize {
        let open = self.slots.iter().filter(|slot| slot.message.is_some());
        open.count()
    }

    /// A message that was given up since this was asked last. Ask until `None` after every other call.
    pub fn next_given_up(&mut self) -> Option<Incomplete> {
        self.given_up.pop()
    }

    /// What became of the messages so far.
    pub const fn counts(&self) -> &ReassemblyCounts {
        &self.counts
    }

    fn find(&self, header: &Header) -> Result<Option<usize>, Refusal> {
        let wanted = (header.session, header.epoch, header.sequence);
        let is_wanted = |one: MessageInfo| (one.session, one.epoch, one.sequence) == wanted;
        let mut slots = self.slots.iter();
        let Some(index) = slots.position(|slot| slot.message.is_some_and(is_wanted)) else {
            return Ok(None);
        };
        let slot = &self.slots[index];
        let count = slot.message.map(|one| one.fragment_count);
        if (slot.total_len, count) != (header.total_len, Some(header.fragment_count)) {
            return Err(Refusal::FragmentInconsistent);
        }
        if slot.has(header.fragment_index) {
            return Err(Refusal::DuplicateFragment);
        }
        Ok(Some(index))
    }

    /// A slot for a new message: a free one, or that of the oldest incomplete message.
    fn open(&mut self, now: Instant, header: &Header) -> usize {
        let order = |slot: &Slot| slot.message.map(|_| slot.started_at);
        let (index, slot) = self
            .slots
            .iter_mut()
            .enumerate()
            .min_by_key(|(_, slot)| order(slot))
            .expect("there is at least one slot");
        self.counts.started_count += 1;
        if let Some(given_up) = slot.give_up() {
            self.given_up.push(given_up);
            self.counts.evicted_count += 1;
        }
        slot.message = Some(MessageInfo::of(self.channel, header));
        slot.total_len = header.total_len;
        slot.missing = header.fragment_count;
        slot.received[..usize::from(header.fragment_count).div_ceil(64)].fill(0);
        slot.started_at = now;
        index
    }
}

impl Slot {
    /// Empties it; what is known of its message, if it held one.
    fn give_up(&mut self) -> Option<Incomplete> {
        let message = self.message.take()?;
        Some(Incomplete {
            message: MessageInfo {
                fragment_count: message.fragment_count - self.missing,
                ..message
            },
            heard_at: self.heard_at,
        })
    }

    fn has(&self, index: u16) -> bool {
        self.received[usize::from(index) / 64] >> (index % 64) & 1 == 1
    }

    fn receive(&mut self, place: &Place) {
        let index = place.index;
        self.received[usize::from(index) / 64] |= 1 << (index % 64);
        self.missing -= 1;
        if let Some(message) = self.message.as_mut().filter(|_| index == 0) {
            message.handed = RemoteInstant::from_ns(place.handed_ns);
        }
    }
}
