//! Which numbers of one key have been taken: each once. It knows nothing of messages, and it is asked
//! only about datagrams that are authentic.

use super::counts::SealRefusal;

/// Numbers a window remembers; a datagram that this many others overtook is refused.
pub const WINDOW_LENGTH: u32 = 2048;
const WORDS: usize = 32;
const _: () = assert!(WORDS * 64 == WINDOW_LENGTH as usize);

/// The window of one key; the default one is that of a key not used yet.
#[derive(Debug, Clone, Default)]
pub struct ReplayWindow {
    /// One past the newest number taken.
    end: u32,
    /// Bit `number % 2048`: taken.
    taken: [u64; WORDS],
}

impl ReplayWindow {
    /// Takes `number`, once.
    ///
    /// # Errors
    /// [`SealRefusal::Replayed`], or [`SealRefusal::TooOld`] when that cannot be told any more; the
    /// window is then as it was.
    pub fn take(&mut self, number: u32) -> Result<(), SealRefusal> {
        if number < self.end {
            if self.end - number > WINDOW_LENGTH {
                return Err(SealRefusal::TooOld);
            }
            let (word, bit) = place(number);
            if self.taken[word] & bit != 0 {
                return Err(SealRefusal::Replayed);
            }
            self.taken[word] |= bit;
            return Ok(());
        }
        if number - self.end >= WINDOW_LENGTH {
            self.taken = [0; WORDS];
        } else {
            for entering in self.end..number {
                let (word, bit) = place(entering);
                self.taken[word] &= !bit;
            }
        }
        let (word, bit) = place(number);
        self.taken[word] |= bit;
        // The number after the last is never sent: keys rotate long before.
        self.end = number.saturating_add(1);
        Ok(())
    }
}

const fn place(number: u32) -> (usize, u64) {
    let slot = number % WINDOW_LENGTH;
    ((slot / 64) as usize, 1 << (slot % 64))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use hil_core::random::RandomStream;

    use super::*;

    #[test]
    fn in_any_order_each_number_is_taken_once_and_the_old_are_refused() {
        for seed in 0..20 {
            let mut random = RandomStream::new(seed, "window");
            let mut window = ReplayWindow::default();
            let mut taken = BTreeSet::new();
            let mut newest: u32 = 0;
            for _ in 0..20_000 {
                let step = u32::try_from(random.next_u64() % 6_000).unwrap();
                // Mostly near the newest, sometimes far ahead or behind.
                let number = match random.next_u64() % 10 {
                    0 => newest.saturating_add(step),
                    1..=3 => newest.saturating_sub(step),
                    _ => newest.saturating_sub(step % 64) + step % 3,
                };
                let expected = if taken.contains(&number) && newest - number < WINDOW_LENGTH {
                    Err(SealRefusal::Replayed)
                } else if newest >= number && newest - number >= WINDOW_LENGTH {
                    Err(SealRefusal::TooOld)
                } else {
                    Ok(())
                };
                // Before the first, nothing is old.
                assert_eq!(window.take(number), expected, "{number} after {newest}");
                if expected.is_ok() {
                    assert!(taken.insert(number));
                    newest = newest.max(number);
                }
            }
            assert!(taken.len() > 1_000);
        }
    }

    #[test]
    fn the_last_number_there_is_can_be_taken_once() {
        let mut window = ReplayWindow::default();
        assert_eq!(window.take(u32::MAX - 1), Ok(()));
        assert_eq!(window.take(u32::MAX - 1), Err(SealRefusal::Replayed));
        assert_eq!(window.take(0), Err(SealRefusal::TooOld));
    }
}
