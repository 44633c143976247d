//! A bounded first-in-first-out buffer whose memory is there from the beginning. It decides
//! nothing about what becomes of what does not fit.

/// The buffer.
#[derive(Debug, Clone)]
pub(super) struct Ring<T> {
    slots: Box<[T]>,
    first: usize,
    len: usize,
}

impl<T: Copy> Ring<T> {
    /// Room for `capacity` values, all touched now by writing `blank`.
    pub(super) fn new(capacity: usize, blank: T) -> Self {
        Self {
            slots: vec![blank; capacity.max(1)].into_boxed_slice(),
            first: 0,
            len: 0,
        }
    }

    pub(super) fn len(&self) -> usize {
        self.len
    }

    pub(super) fn capacity(&self) -> usize {
        self.slots.len()
    }

    fn slot(&self, index: usize) -> usize {
        let slot = self.first + index;
        if slot < self.slots.len() {
            slot
        } else {
            slot - self.slots.len()
        }
    }

    /// Appends `value`; false when it does not fit.
    #[must_use]
    pub(super) fn push(&mut self, value: &T) -> bool {
        if self.len == self.slots.len() {
            return false;
        }
        self.slots[self.slot(self.len)] = *value;
        self.len += 1;
        true
    }

    pub(super) fn front(&self) -> Option<&T> {
        (self.len > 0).then(|| &self.slots[self.first])
    }

    pub(super) fn back(&self) -> Option<&T> {
        (self.len > 0).then(|| &self.slots[self.slot(self.len - 1)])
    }

    /// Forgets the oldest.
    pub(super) fn discard_front(&mut self) {
        if self.len > 0 {
            self.first = self.slot(1);
            self.len -= 1;
        }
        // Starting over at the front keeps a short queue within a few cache lines.
        if self.len == 0 {
            self.first = 0;
        }
    }

    pub(super) fn clear(&mut self) {
        (self.first, self.len) = (0, 0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_come_out_in_order_and_never_exceed_the_capacity() {
        let mut ring = Ring::new(3, 0);
        let (mut next_in, mut next_out) = (0, 0);
        for step in 0..100 {
            for _ in 0..step % 5 {
                let fits = ring.len() < 3;
                assert_eq!(ring.push(&next_in), fits);
                next_in += i32::from(fits);
            }
            assert_eq!(ring.back().copied(), (ring.len() > 0).then(|| next_in - 1));
            for _ in 0..step % 3 {
                assert_eq!(
                    ring.front().copied(),
                    (next_out < next_in).then_some(next_out)
                );
                next_out += i32::from(ring.front().is_some());
                ring.discard_front();
            }
        }
        ring.clear();
        assert_eq!((ring.front(), ring.len(), ring.capacity()), (None, 0, 3));
    }
}
