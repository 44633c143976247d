//! What was sent and waits for the stamps of its departure. It knows neither sockets nor records.

use hil_core::time::Instant;
use hil_net::TxToken;

/// Datagrams whose stamps may be outstanding; a power of two.
const PENDING: usize = 256;
/// A stamp that has not come by then does not come: drivers deliver within a millisecond or so,
/// and a record must not wait for ever.
pub(crate) const STAMP_PATIENCE_NS: i64 = 20_000_000;

/// The datagrams of one socket whose stamps are still to come, with what is noted of each.
#[derive(Debug)]
pub(crate) struct StampTracker<T> {
    slots: Box<[Option<Sent<T>>]>,
    count: usize,
    /// At or before the slot of the oldest that is pending: tokens go round the slots in order.
    oldest: usize,
}

#[derive(Debug, Clone, Copy)]
struct Sent<T> {
    token: TxToken,
    handed: Instant,
    note: T,
}

impl<T: Copy> StampTracker<T> {
    /// Of a socket that has sent nothing.
    pub(crate) fn new() -> Self {
        Self {
            slots: vec![None; PENDING].into_boxed_slice(),
            count: 0,
            oldest: 0,
        }
    }

    /// True while nothing is to come.
    pub(crate) const fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Expects a stamp of the datagram `token`, handed over at `handed`; the note of the one that it
    /// displaces, which came too long ago.
    pub(crate) fn expect(&mut self, token: TxToken, handed: Instant, note: T) -> Option<T> {
        let slot = slot_of(token);
        let old = self.take_slot(slot);
        if self.count == 0 {
            self.oldest = slot;
        } else if self.oldest == slot {
            // Gone round once: the newest takes this slot, and the oldest is in a later one.
            self.oldest = (slot + 1) % PENDING;
        }
        self.slots[slot] = Some(Sent {
            token,
            handed,
            note,
        });
        self.count += 1;
        old
    }

    /// The note of the datagram `token`; `None` when nothing is expected of it any more.
    pub(crate) fn find(&mut self, token: TxToken) -> Option<&mut T> {
        let sent = self.slots[slot_of(token)].as_mut();
        sent.filter(|one| one.token == token)
            .map(|one| &mut one.note)
    }

    /// Expects nothing more of the datagram `token`; its note.
    pub(crate) fn take(&mut self, token: TxToken) -> Option<T> {
        self.find(token)?;
        self.take_slot(slot_of(token))
    }

    /// Expects nothing more of the oldest that was handed over longer than `patience_ns` before `now`;
    /// its note.
    pub(crate) fn take_overdue(&mut self, now: Instant, patience_ns: i64) -> Option<T> {
        // Something is pending, so the walk ends within one round.
        while self.count > 0 {
            match &self.slots[self.oldest] {
                Some(one) if now.ns_since(one.handed) <= patience_ns => return None,
                Some(_) => return self.take_slot(self.oldest),
                None => self.oldest = (self.oldest + 1) % PENDING,
            }
        }
        None
    }

    fn take_slot(&mut self, slot: usize) -> Option<T> {
        let sent = self.slots[slot].take()?;
        self.count -= 1;
        Some(sent.note)
    }
}

fn slot_of(token: TxToken) -> usize {
    token.0 as usize % PENDING
}

#[cfg(test)]
mod tests {
    use super::*;

    fn expire(tracker: &mut StampTracker<u32>, now: Instant) {
        while tracker.take_overdue(now, STAMP_PATIENCE_NS).is_some() {}
    }

    #[test]
    fn what_is_overdue_goes_and_the_rest_stays_however_often_tokens_go_round() {
        let mut tracker = StampTracker::new();
        let spacing_ns = 1_000_000;
        let kept = usize::try_from(STAMP_PATIENCE_NS / spacing_ns).unwrap() + 1;
        // Past the wrap of the tokens, and of the slots many times.
        let first = u32::MAX - 700;
        for step in 0..2_000_u32 {
            let now = Instant::from_ns(i64::from(step) * spacing_ns);
            let token = TxToken(first.wrapping_add(step));
            assert_eq!(tracker.expect(token, now, step), None, "step {step}");
            // Every third is stamped at once, and for a while all are.
            if step % 3 == 0 || (800..1_200).contains(&step) {
                assert_eq!(tracker.find(token), Some(&mut step.clone()));
                assert_eq!(tracker.take(token), Some(step));
                assert_eq!(tracker.take(token), None);
            }
            expire(&mut tracker, now);
            let left = tracker.slots.iter().flatten();
            let is_timely = |one: &Sent<u32>| now.ns_since(one.handed) <= STAMP_PATIENCE_NS;
            assert!(left.clone().all(is_timely), "step {step}");
            assert_eq!(left.count(), tracker.count, "step {step}");
            assert!(tracker.count <= kept);
        }
        assert!(tracker.count > kept / 2, "{}", tracker.count);
        // Without a look in between the slots go round over what waits; the end takes it all.
        for step in 2_000..2_600_u32 {
            let token = TxToken(first.wrapping_add(step));
            let now = Instant::from_ns(i64::from(step) * spacing_ns);
            let displaced = tracker.expect(token, now, step);
            assert!(step < 2_256 || displaced == Some(step - 256), "step {step}");
        }
        assert_eq!(tracker.count, PENDING);
        expire(
            &mut tracker,
            Instant::from_ns((2_599 - 9) * spacing_ns + STAMP_PATIENCE_NS),
        );
        assert_eq!(tracker.count, 10, "the oldest went first");
        expire(&mut tracker, Instant::from_ns(i64::MAX));
        assert!(tracker.is_empty());
    }
}
